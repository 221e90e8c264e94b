// SPDX-License-Identifier: GPL-3.0-or-later
//! A Raspberry Pi under QEMU, and the conversation with it over its serial console.

use std::fs;
use std::io::{self, BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use tempfile::TempDir;

use super::board::Board;
use super::debian::{Emulator, Kernel};
use super::gpio::{Gpio, LINES, Trigger};
use pinion_testkit::cache::Cache;
use pinion_testkit::process;

/// Longest silence, in processor time of the emulator: more than a boot or a test takes. A busy computer stops this time
/// and the guest.
const SILENCE_MAX: Duration = Duration::from_secs(240);
/// Longest silence by the computer's clock, for an emulator that uses no processor time.
const STALL_MAX: Duration = Duration::from_secs(3600);
/// How often the silence is measured.
const MEASURE_INTERVAL: Duration = Duration::from_secs(1);

/// The guest's time: an instruction takes 4 ns. `init.sh` keeps the guest from idling, so nothing else advances the
/// time. When the computer stops the emulator, the guest's time stops too. By the computer's clock, steps would often
/// be too late, and homing would end because no news arrives.
const TIME: [&str; 2] = ["-icount", "shift=2"];

/// The start of each message from the guest's init and tests: see `init.sh` and `guest/outside.rs`. Everything else on
/// the console is other output.
const MARK: &str = "raspberry-pi: ";

/// `/dev/mem` may map the registers of the GPIO chip although a driver uses them (`iomem`).
/// A panic is not followed by silence. Otherwise the kernel prints nothing: its messages would be in the middle of the
/// tests' messages.
const COMMAND_LINE: &str = "loglevel=1 panic=-1 cryptomgr.notests iomem=relaxed";

/// The progress of the guest.
pub enum News {
    /// The tests that it will run.
    Planned(Vec<String>),
    /// A test's exit status, and its output.
    Ended { test: String, status: String, output: String },
    /// The last test has ended.
    Done,
}

/// The parts of a VM.
pub struct Parts<'a> {
    pub board: &'static Board,
    pub emulator: &'a Emulator,
    pub kernel: &'a Kernel,
    pub initramfs: &'a [u8],
}

impl Parts<'_> {
    /// The common command of all runs, without its console: the second serial port.
    fn command(&self, folder: &Path, more: &str) -> Result<Command, String> {
        let root = folder.join("initramfs");
        fs::write(&root, self.initramfs).map_err(|error| format!("cannot write {}: {error}", root.display()))?;
        let Board { machine, baud, command_line, chip, lines, .. } = self.board;
        let mut command = self.emulator.command();
        command
            .args(["-M", machine, "-accel", "tcg", "-display", "none", "-no-reboot", "-serial", "null"])
            .args(TIME)
            .arg("-kernel")
            .arg(self.kernel.image())
            .arg("-dtb")
            .arg(self.kernel.device_tree(self.board))
            .arg("-initrd")
            .arg(root)
            .arg("-append")
            // The kernel hands unknown words to the guest's init, in its environment.
            .arg(format!(
                "console=ttyS1,{baud} {COMMAND_LINE} {command_line} GPIO_CHIP={chip} GPIO_LINES={lines} {more}"
            ));
        Ok(command)
    }
}

/// A running VM. It ends when this is dropped.
pub struct Vm {
    qemu: Child,
    gpio: Gpio,
    input: ChildStdin,
    lines: Receiver<String>,
    /// The whole console output.
    console: String,
    /// The output since the test began.
    output: String,
    folder: TempDir,
}

impl Vm {
    pub fn boot(parts: &Parts, cache: &Cache) -> Result<Vm, String> {
        let folder = cache.run_folder()?;
        let qtest = folder.path().join("qtest");
        let mut command = parts.command(folder.path(), "")?;
        command.arg("-qtest").arg(format!("unix:{},server=on,wait=off", qtest.display())).args([
            "-qtest-log",
            "none",
            "-serial",
            "stdio",
            "-monitor",
            "none",
        ]);
        let (mut qemu, input, output) = process::start_emulator(&mut command, folder.path())?;
        match Gpio::connect(&qtest, parts.board.registers) {
            Ok(gpio) => Ok(Vm {
                qemu,
                gpio,
                input,
                lines: follow(output),
                console: String::new(),
                output: String::new(),
                folder,
            }),
            Err(cause) => {
                let _ = qemu.kill();
                let _ = qemu.wait();
                let said = fs::read_to_string(folder.path().join("qemu")).unwrap_or_default();
                Err(format!("{cause}\n{said}"))
            }
        }
    }

    /// Carries out the guest's requests until there is news. An error describes the end of the VM.
    pub fn next(&mut self) -> Result<News, String> {
        loop {
            let line = self.line()?;
            self.console += &line;
            self.console.push('\n');
            // A test may have printed text before this without a new line.
            let Some((before, words)) = line.split_once(MARK) else {
                self.output += &line;
                self.output.push('\n');
                continue;
            };
            self.output += before;
            let words: Vec<&str> = words.split_ascii_whitespace().collect();
            match words[..] {
                ["plan", ref tests @ ..] => {
                    return Ok(News::Planned(tests.iter().map(|&test| test.to_owned()).collect()));
                }
                ["begin", _] => {
                    self.output.clear();
                    self.gpio.clear()?;
                }
                ["end", test, status] => {
                    let output = std::mem::take(&mut self.output);
                    return Ok(News::Ended { test: test.to_owned(), status: status.to_owned(), output });
                }
                ["done"] => return Ok(News::Done),
                _ => {
                    let answer = self.obey(&words)?;
                    writeln!(self.input, "{answer}").map_err(|error| format!("the console takes nothing: {error}"))?;
                }
            }
        }
    }

    /// The console's next line.
    fn line(&self) -> Result<String, String> {
        let (since, spent) = (Instant::now(), process::processor_time(&self.qemu)?);
        loop {
            match self.lines.recv_timeout(MEASURE_INTERVAL) {
                Ok(line) => return Ok(line),
                Err(RecvTimeoutError::Disconnected) => return Err("the VM ended too early".to_owned()),
                Err(RecvTimeoutError::Timeout) => {
                    let silence = process::processor_time(&self.qemu)?.saturating_sub(spent);
                    if silence > SILENCE_MAX || since.elapsed() > STALL_MAX {
                        return Err(format!(
                            "nothing came from it for {} s, with {} s of processor time",
                            since.elapsed().as_secs(),
                            silence.as_secs()
                        ));
                    }
                }
            }
        }
    }

    /// The whole output of the guest and the emulator.
    pub fn console(&self) -> String {
        let emulator = fs::read_to_string(self.folder.path().join("qemu")).unwrap_or_default();
        format!("--- console\n{}--- emulator\n{emulator}", self.console)
    }

    /// Carries out a test's request, and returns the answer.
    fn obey(&self, words: &[&str]) -> Result<String, String> {
        let misunderstood = || format!("the guest asked for {words:?}");
        let number = |word: &str| word.parse::<usize>().map_err(|_| misunderstood());
        let line =
            |word: &str| number(word).and_then(|line| if line < LINES { Ok(line) } else { Err(misunderstood()) });
        let digit = |level: bool| if level { '1' } else { '0' };
        Ok(match *words {
            ["level", at] => digit(self.gpio.level(line(at)?)?).to_string(),
            ["drive", at, level] => {
                self.gpio.drive(line(at)?, level == "1")?;
                "ok".to_owned()
            }
            ["drive", at, level, "after", count, "rises", "of", watched] => {
                self.gpio.set_trigger(Trigger {
                    line: line(at)?,
                    level: level == "1",
                    after: number(count)?,
                    watched: line(watched)?,
                });
                "ok".to_owned()
            }
            ["edges", at] => self.gpio.edges(line(at)?)?.into_iter().map(digit).collect(),
            _ => return Err(misunderstood()),
        })
    }
}

impl Drop for Vm {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

/// A shell in the guest, on this terminal.
pub fn shell(parts: &Parts, cache: &Cache) -> Result<(), String> {
    let folder = cache.run_folder()?;
    let mut qemu = parts
        .command(folder.path(), "GUEST_SHELL=1")?
        .args(["-serial", "mon:stdio"])
        .spawn()
        .map_err(|error| format!("cannot start the emulator: {error}"))?;
    qemu.wait().map(drop).map_err(|error| error.to_string())
}

/// The console's lines, read when they arrive.
fn follow(output: ChildStdout) -> Receiver<String> {
    let (sender, lines) = channel();
    thread::spawn(move || -> io::Result<()> {
        for line in BufReader::new(output).split(b'\n') {
            let line = line?;
            let line = String::from_utf8_lossy(&line);
            if sender.send(line.trim_end_matches('\r').to_owned()).is_err() {
                break;
            }
        }
        Ok(())
    });
    lines
}
