// SPDX-License-Identifier: GPL-3.0-or-later
//! Round trips and commands a second, measured at the terminal by a client that does as little
//! as possible.
//!
//! It is an ordinary process. As a real-time one it would not be kept from running by others,
//! but it would itself keep the kernel's worker from running that carries bytes through a
//! terminal.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};
use pinion_client::serial::WINDOW;
use pinion_protocol::block::{Found, PAYLOAD_MAX, Resync, Sequence, frame};

use super::rig::Running;

/// The program is given this long to go to sleep before the next round trip.
const PAUSE: Duration = Duration::from_micros(300);
const SILENCE: Duration = Duration::from_secs(2);

/// Sends blocks whose bytes were made beforehand.
struct Bare {
    tty: File,
    input: Vec<u8>,
    resync: Resync,
    expected: Sequence,
}

impl Bare {
    fn open(tty: &Path) -> Result<Bare, String> {
        let failed = |error: std::io::Error| format!("{}: {error}", tty.display());
        let flags = (OFlag::O_NOCTTY | OFlag::O_NONBLOCK).bits();
        let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(tty).map_err(failed)?;
        let mut raw = tcgetattr(&file).map_err(|error| failed(error.into()))?;
        cfmakeraw(&mut raw);
        tcsetattr(&file, SetArg::TCSANOW, &raw).map_err(|error| failed(error.into()))?;
        let input = Vec::with_capacity(8192);
        let mut bare = Bare { tty: file, input, resync: Resync::default(), expected: Sequence::default() };
        // An empty block, expected or not, is answered by the number of the next.
        let mut hello = Vec::new();
        frame(&[], Sequence::default(), &mut hello);
        bare.write(&hello)?;
        let until = Instant::now() + Duration::from_millis(100);
        while Instant::now() < until {
            bare.read()?;
            while bare.block().is_some() {}
        }
        Ok(bare)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), String> {
        self.tty.write_all(bytes).map_err(|error| format!("writing to the terminal: {error}"))
    }

    /// Takes in what is there.
    fn read(&mut self) -> Result<(), String> {
        let mut bytes = [0; 4096];
        match self.tty.read(&mut bytes) {
            Ok(len) => self.input.extend_from_slice(&bytes[..len]),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => return Err(format!("reading from the terminal: {error}")),
        }
        Ok(())
    }

    /// The next block that came in: whether it has a payload. Its number is kept.
    fn block(&mut self) -> Option<bool> {
        loop {
            let (taken, found) = self.resync.next(&self.input);
            let block = match found {
                Found::Nothing => return None,
                Found::Block(sequence, payload) => Some((sequence, !payload.is_empty())),
                Found::Garbage { .. } => None,
            };
            self.input.drain(..taken);
            if let Some((sequence, payload)) = block {
                self.expected = sequence;
                return Some(payload);
            }
        }
    }
}

/// Times in nanoseconds from the write of a command to the read of its response, sorted.
pub fn round_trips(running: &Running, command: &str, count: usize) -> Result<Vec<i64>, String> {
    let payload = running.client()?.messages().encode(command, &[]).map_err(|error| error.to_string())?;
    let mut bare = Bare::open(running.tty())?;
    let mut times = Vec::with_capacity(count);
    let mut block = Vec::new();
    for _ in 0..count {
        block.clear();
        frame(&payload, bare.expected, &mut block);
        let start = Instant::now();
        bare.write(&block)?;
        while !{
            bare.read()?;
            bare.block() == Some(true)
        } {
            if start.elapsed() > SILENCE {
                return Err(format!("no answer to {command}"));
            }
        }
        times.push(start.elapsed().as_nanos() as i64);
        let end = Instant::now() + PAUSE;
        while Instant::now() < end {
            bare.read()?;
            while bare.block().is_some() {}
        }
    }
    times.sort_unstable();
    Ok(times)
}

/// How many `debug_nop` a program takes in a second: blocks full of them, as many under way as
/// klippy has at most.
pub fn commands_a_second(running: &Running, span: Duration) -> Result<f64, String> {
    let nop = running.client()?.messages().encode("debug_nop", &[]).map_err(|error| error.to_string())?;
    let in_block = PAYLOAD_MAX / nop.len();
    let mut bare = Bare::open(running.tty())?;
    let payload = nop.repeat(in_block);
    let mut numbers = vec![bare.expected];
    for at in 0..15 {
        numbers.push(Sequence::next(numbers[at]));
    }
    let blocks: Vec<Vec<u8>> = numbers.iter().map(|number| framed(&payload, *number)).collect();
    let (mut sent, mut taken) = (0u64, 0u64);
    let mut bytes = Vec::new();
    let start = Instant::now();
    let mut heard = start;
    while heard.duration_since(start) < span {
        bytes.clear();
        while sent - taken < WINDOW as u64 {
            bytes.extend_from_slice(&blocks[(sent & 15) as usize]);
            sent += 1;
        }
        if !bytes.is_empty() {
            bare.write(&bytes)?;
        }
        bare.read()?;
        while bare.block().is_some() {
            let number = numbers.iter().position(|number| *number == bare.expected).unwrap_or(0) as u64;
            taken += number.wrapping_sub(taken) & 15;
            heard = Instant::now();
        }
        if heard.elapsed() > SILENCE {
            return Err("the blocks are not acknowledged".into());
        }
    }
    Ok(taken as f64 * in_block as f64 / heard.duration_since(start).as_secs_f64())
}

fn framed(payload: &[u8], number: Sequence) -> Vec<u8> {
    let mut block = Vec::new();
    frame(payload, number, &mut block);
    block
}
