// SPDX-License-Identifier: GPL-3.0-or-later
//! Measures round trips and commands a second, at the terminal, with a client that does as little as possible.
//!
//! The client is an ordinary process. Others would not keep a real-time process from running. But it would keep the
//! kernel's worker that carries bytes through a terminal from running.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};
use pinion_client::Arg;
use pinion_client::serial::WINDOW;
use pinion_protocol::block::{Found, PAYLOAD_MAX, Resync, Sequence, frame};

use super::rig::Running;

/// How long the program has to go to sleep before the next round trip.
const PAUSE: Duration = Duration::from_micros(300);
const SILENCE: Duration = Duration::from_secs(2);

/// Sends blocks that were made beforehand.
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
        // An empty block, expected or not, is answered with the number of the next block.
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

    /// Takes in the bytes that are there.
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

/// A command with its arguments.
pub type Command<'a> = (&'a str, &'a [(&'a str, Arg<'a>)]);

fn encoded(running: &Running, (command, args): Command<'_>) -> Result<Vec<u8>, String> {
    running.client()?.messages().encode(command, args).map_err(|error| error.to_string())
}

/// Times in nanoseconds from the write of a command to the read of its response, sorted.
pub fn round_trips(running: &Running, command: Command<'_>, count: usize) -> Result<Vec<i64>, String> {
    let payload = encoded(running, command)?;
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
                return Err(format!("no answer to {}", command.0));
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

/// How many `debug_nop` commands a program takes in a second, in full blocks.
pub fn commands_a_second(running: &Running, span: Duration) -> Result<f64, String> {
    let nop = encoded(running, ("debug_nop", &[]))?;
    let in_block = PAYLOAD_MAX / nop.len();
    let mut stream = Stream::open(running, &nop.repeat(in_block))?;
    let start = Instant::now();
    let mut blocks = 0;
    while start.elapsed() < span {
        blocks += stream.acknowledged()?;
    }
    Ok(blocks as f64 * in_block as f64 / start.elapsed().as_secs_f64())
}

/// How long, in nanoseconds, each of `count` commands takes with one command a block: the mean of each hundred, sorted.
pub fn each_alone(running: &Running, command: Command<'_>, count: usize) -> Result<Vec<i64>, String> {
    const HUNDRED: u64 = 100;
    let mut stream = Stream::open(running, &encoded(running, command)?)?;
    let mut each = Vec::new();
    for _ in 0..count as u64 / HUNDRED {
        let (start, mut blocks) = (Instant::now(), 0);
        while blocks < HUNDRED {
            blocks += stream.acknowledged()?;
        }
        each.push(start.elapsed().as_nanos() as i64 / blocks as i64);
    }
    each.sort_unstable();
    Ok(each)
}

/// Blocks of one payload. As many are under way as klippy has at most.
struct Stream {
    bare: Bare,
    numbers: Vec<Sequence>,
    blocks: Vec<Vec<u8>>,
    sent: u64,
    taken: u64,
}

impl Stream {
    fn open(running: &Running, payload: &[u8]) -> Result<Stream, String> {
        let bare = Bare::open(running.tty())?;
        let mut numbers = vec![bare.expected];
        for at in 0..15 {
            numbers.push(Sequence::next(numbers[at]));
        }
        let blocks = numbers.iter().map(|number| framed(payload, *number)).collect();
        Ok(Stream { bare, numbers, blocks, sent: 0, taken: 0 })
    }

    /// Sends as many blocks as it may, and waits until further blocks are acknowledged. Returns how many.
    fn acknowledged(&mut self) -> Result<u64, String> {
        let mut bytes = Vec::new();
        while self.sent - self.taken < WINDOW as u64 {
            bytes.extend_from_slice(&self.blocks[(self.sent & 15) as usize]);
            self.sent += 1;
        }
        if !bytes.is_empty() {
            self.bare.write(&bytes)?;
        }
        let (start, before) = (Instant::now(), self.taken);
        while self.taken == before {
            self.bare.read()?;
            while self.bare.block().is_some() {
                let number = self.numbers.iter().position(|number| *number == self.bare.expected).unwrap_or(0) as u64;
                self.taken += number.wrapping_sub(self.taken) & 15;
            }
            if start.elapsed() > SILENCE {
                return Err("the blocks are not acknowledged".into());
            }
        }
        Ok(self.taken - before)
    }
}

fn framed(payload: &[u8], number: Sequence) -> Vec<u8> {
    let mut block = Vec::new();
    frame(payload, number, &mut block);
    block
}
