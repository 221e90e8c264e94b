// SPDX-License-Identifier: GPL-3.0-or-later
//! The world outside the Pi's GPIO chip, simulated with QEMU's qtest. qtest reports each change of an output at once,
//! and reads and writes the chip's registers.
//!
//! The emulated chip keeps one level for each line. The outside drives a line as the driver would: it writes to the
//! registers that set and clear.

use std::collections::VecDeque;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant};

/// Lines that the emulator drives. The chip of a Raspberry Pi 4 has four more.
pub const LINES: usize = 54;
const CHIP: &str = "/machine/soc/peripherals/gpio";
/// Offsets of registers.
const SET: u32 = 0x1c;
const CLEAR: u32 = 0x28;
const LEVEL: u32 = 0x34;
/// These are long, because the computer may be busy.
const START_TIMEOUT: Duration = Duration::from_secs(60);
const ANSWER_TIMEOUT: Duration = Duration::from_secs(300);

/// The physical address of the chip's registers.
#[derive(Clone, Copy)]
pub struct Registers(pub u32);

impl Registers {
    fn write_command(self, line: usize, level: bool) -> String {
        let first = if level { SET } else { CLEAR };
        format!("writel {:#x} {:#x}", self.of(first, line), 1u32 << (line % 32))
    }

    /// Each register has 32 lines. The next register has the remaining lines.
    fn of(self, first: u32, line: usize) -> u32 {
        self.0 + first + if line < 32 { 0 } else { 4 }
    }
}

/// Drives a line after another line has risen this many times.
#[derive(Clone, Copy)]
pub struct Trigger {
    pub line: usize,
    pub level: bool,
    pub after: usize,
    pub watched: usize,
}

/// The chip, seen from outside.
pub struct Gpio {
    registers: Registers,
    state: Arc<Mutex<State>>,
    answers: Receiver<String>,
}

struct State {
    registers: Registers,
    socket: UnixStream,
    /// For each command without an answer yet: whether the answer is needed.
    asked: VecDeque<bool>,
    /// All levels of each output, in order.
    edges: Vec<Vec<bool>>,
    trigger: Option<Trigger>,
}

impl Gpio {
    /// Connects to an emulator that is starting. Its messages must be read all the time, because it waits for the
    /// reader.
    pub fn connect(path: &Path, registers: Registers) -> Result<Gpio, String> {
        let until = Instant::now() + START_TIMEOUT;
        let socket = loop {
            match UnixStream::connect(path) {
                Ok(socket) => break socket,
                Err(_) if Instant::now() < until => thread::sleep(Duration::from_millis(10)),
                Err(error) => return Err(format!("the emulator offers no qtest: {error}")),
            }
        };
        let reader = socket.try_clone().map_err(|error| error.to_string())?;
        let state = State { registers, socket, asked: VecDeque::new(), edges: vec![Vec::new(); LINES], trigger: None };
        let state = Arc::new(Mutex::new(state));
        let (sender, answers) = channel();
        let shared = Arc::clone(&state);
        thread::spawn(move || drain(BufReader::new(reader), &shared, &sender));
        let gpio = Gpio { registers, state, answers };
        gpio.ask(&format!("irq_intercept_out {CHIP}"))?;
        Ok(gpio)
    }

    /// The level of a line, whatever drives it.
    pub fn level(&self, line: usize) -> Result<bool, String> {
        let answer = self.ask(&format!("readl {:#x}", self.registers.of(LEVEL, line)))?;
        let levels = answer.trim().trim_start_matches("0x");
        let levels = u64::from_str_radix(levels, 16).map_err(|_| format!("qtest read {answer:?}"))?;
        Ok(levels >> (line % 32) & 1 != 0)
    }

    /// Drives an input.
    pub fn drive(&self, line: usize, level: bool) -> Result<(), String> {
        self.ask(&self.registers.write_command(line, level)).map(drop)
    }

    /// Forgets the edges and the trigger.
    pub fn clear(&self) -> Result<(), String> {
        // An answer comes after all edges before it.
        self.level(0)?;
        let mut state = self.lock();
        state.edges.iter_mut().for_each(Vec::clear);
        state.trigger = None;
        Ok(())
    }

    /// The levels of an output since the last clear.
    pub fn edges(&self, line: usize) -> Result<Vec<bool>, String> {
        self.level(0)?;
        Ok(self.lock().edges[line].clone())
    }

    /// Sets the trigger. It works once.
    pub fn set_trigger(&self, trigger: Trigger) {
        self.lock().trigger = Some(trigger);
    }

    fn ask(&self, command: &str) -> Result<String, String> {
        self.lock().send(command, true).map_err(|error| format!("qtest took no {command:?}: {error}"))?;
        let answer =
            self.answers.recv_timeout(ANSWER_TIMEOUT).map_err(|_| format!("qtest gave no answer to {command:?}"))?;
        match answer.strip_prefix("OK") {
            Some(rest) => Ok(rest.to_owned()),
            None => Err(format!("qtest answered {answer:?} to {command:?}")),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("the reader does not panic")
    }
}

impl State {
    fn send(&mut self, command: &str, wanted: bool) -> io::Result<()> {
        self.asked.push_back(wanted);
        self.socket.write_all(format!("{command}\n").as_bytes())
    }

    fn edge(&mut self, line: usize, level: bool) -> io::Result<()> {
        let Some(edges) = self.edges.get_mut(line) else { return Ok(()) };
        edges.push(level);
        let rises = || edges.iter().filter(|level| **level).count();
        match self.trigger {
            Some(trigger) if level && trigger.watched == line && rises() >= trigger.after => {
                self.trigger = None;
                self.send(&self.registers.write_command(trigger.line, trigger.level), false)
            }
            _ => Ok(()),
        }
    }
}

/// Reads until the emulator ends.
fn drain(messages: BufReader<UnixStream>, state: &Mutex<State>, answers: &Sender<String>) {
    for message in messages.lines() {
        let Ok(message) = message else { return };
        let mut state = state.lock().expect("nobody panics with it");
        let words: Vec<&str> = message.split_ascii_whitespace().collect();
        let done = match words[..] {
            ["IRQ", change, line] => match line.parse() {
                Ok(line) => state.edge(line, change == "raise"),
                Err(_) => Ok(()),
            },
            _ if state.asked.pop_front() == Some(true) => answers.send(message).map_err(io::Error::other),
            _ => Ok(()),
        };
        if done.is_err() {
            return;
        }
    }
}
