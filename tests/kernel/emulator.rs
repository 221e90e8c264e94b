// SPDX-License-Identifier: GPL-3.0-or-later
//! A running QEMU and the conversation with its monitor, QMP.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use pinion_testkit::process;

/// Longest wait for a state: more than a boot takes on a computer that leaves the emulator a tenth of a processor.
const WAIT_MAX: Duration = Duration::from_secs(600);
const POLL_INTERVAL: Duration = Duration::from_millis(10);

/// It ends when this is dropped.
pub struct Emulator {
    qemu: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    folder: PathBuf,
}

impl Emulator {
    /// Runs the command. The output of the command and of the VM goes to files of the folder. The VM's first serial port
    /// is its console. Nothing is connected to the second.
    pub fn start(mut vm: Command, folder: &Path) -> Result<Emulator, String> {
        vm.arg("-serial")
            .arg(format!("file:{}", folder.join("console").display()))
            .args(["-serial", "null", "-qmp", "stdio"]);
        let (qemu, input, output) = process::start_emulator(&mut vm, folder)?;
        let mut emulator = Emulator { qemu, input, output: BufReader::new(output), folder: folder.to_owned() };
        emulator.ask(json!({"execute": "qmp_capabilities"}))?;
        emulator.settle_order();
        Ok(emulator)
    }

    /// Makes the emulator's main thread run before its processor thread, whenever the main thread has work. Both are on
    /// one processor of the computer (see `at_once`). The main thread advances the time while the guest is idle. It may
    /// wake at the moment when the guest becomes idle. Instructions that are not yet accounted for would then be added
    /// to the passed time: up to several microseconds. Two runs would then not be the same.
    fn settle_order(&self) {
        if let Err(cause) = process::put_main_thread_first(&self.qemu) {
            eprintln!("figures may differ from one run to the next in the fourth digit: {cause}");
        }
    }

    /// Sends a command to the monitor, and returns its answer.
    pub fn ask(&mut self, command: Value) -> Result<Value, String> {
        let failed = |cause: String, emulator: &Emulator| format!("{command}: {cause}\n{}", emulator.said());
        // In one piece: the monitor quits at the last brace, before a line end that comes later.
        let line = format!("{command}\n");
        self.input.write_all(line.as_bytes()).map_err(|error| failed(error.to_string(), self))?;
        loop {
            let mut line = String::new();
            self.output.read_line(&mut line).map_err(|error| failed(error.to_string(), self))?;
            if line.is_empty() {
                return Err(failed("the emulator ended".into(), self));
            }
            let message: Value = serde_json::from_str(&line).map_err(|error| failed(error.to_string(), self))?;
            if let Some(error) = message.get("error") {
                return Err(failed(error.to_string(), self));
            }
            // A greeting and events come between the answers.
            if let Some(answer) = message.get("return") {
                return Ok(answer.clone());
            }
        }
    }

    /// Waits until the VM is in this state, one of QMP's `RunState`.
    pub fn wait_until(&mut self, reached: impl Fn(&str) -> bool) -> Result<(), String> {
        let started = Instant::now();
        loop {
            let answer = self.ask(json!({"execute": "query-status"}))?;
            let status = answer["status"].as_str().unwrap_or_default();
            if reached(status) {
                return Ok(());
            }
            if started.elapsed() > WAIT_MAX {
                return Err(format!("the VM is {status} for too long\n{}", self.said()));
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Its status; `None` if it has not ended.
    pub fn ended(&mut self) -> Result<Option<ExitStatus>, String> {
        self.qemu.try_wait().map_err(|error| error.to_string())
    }

    /// Its processor time so far.
    pub fn processor_time(&self) -> Result<Duration, String> {
        process::processor_time(&self.qemu)
    }

    /// The VM's console output.
    pub fn console(&self) -> String {
        self.read("console")
    }

    /// The whole output of the VM and the emulator.
    pub fn said(&self) -> String {
        format!("--- console\n{}\n--- emulator\n{}", self.console(), self.read("qemu"))
    }

    fn read(&self, name: &str) -> String {
        String::from_utf8_lossy(&fs::read(self.folder.join(name)).unwrap_or_default()).into_owned()
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}
