// SPDX-License-Identifier: GPL-3.0-or-later
//! Other programs, with errors that include the command and its output.

use std::fs::File;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Output, Stdio};
use std::time::Duration;

use nix::time::ClockId;
use nix::unistd::Pid;
use pinion_linux::sys::set_nice;

/// The command's output. An error contains its output and standard error.
pub fn output(command: &mut Command) -> Result<String, String> {
    let output = finished(command)?;
    String::from_utf8(output.stdout).map_err(|_| format!("{command:?} did not print text"))
}

/// Runs the command for its effect.
pub fn run(command: &mut Command) -> Result<(), String> {
    finished(command).map(drop)
}

/// The program writes in no language but English, as its output may be read.
fn finished(command: &mut Command) -> Result<Output, String> {
    let output = command
        .env("LC_ALL", "C.UTF-8")
        .stdin(Stdio::null())
        .output()
        .map_err(|error| format!("cannot run {command:?}: {error}"))?;
    if output.status.success() {
        return Ok(output);
    }
    Err(format!(
        "{command:?} failed, {}\n{}{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    ))
}

/// Starts an emulator, for a conversation over its standard input and output. Its standard error goes to the file
/// `qemu` of the folder.
pub fn start_emulator(command: &mut Command, folder: &Path) -> Result<(Child, ChildStdin, ChildStdout), String> {
    let log = File::create(folder.join("qemu")).map_err(|error| error.to_string())?;
    let mut emulator = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(log)
        .spawn()
        .map_err(|error| format!("cannot start the emulator: {error}"))?;
    let input = emulator.stdin.take().expect("a pipe was asked for");
    let output = emulator.stdout.take().expect("a pipe was asked for");
    Ok((emulator, input, output))
}

/// Has the emulator's main thread run at once, whenever it has work. It advances the time while the guest is idle.
pub fn put_main_thread_first(emulator: &Child) -> Result<(), String> {
    // Only for this thread: -R excludes the threads that it starts.
    run(Command::new("chrt").args(["-R", "-f", "-p", "1", &emulator.id().to_string()]))
}

/// The processor time of a running child so far. An emulator that a busy computer stops uses none.
pub fn processor_time(child: &Child) -> Result<Duration, String> {
    let time = ClockId::pid_cpu_clock_id(Pid::from_raw(child.id().cast_signed())).and_then(ClockId::now);
    time.map(Duration::from).map_err(|error| format!("the emulator's processor time is unknown: {error}"))
}

/// Runs a shell pipeline. It fails if any part of the pipeline fails. The words are passed as `$1`, `$2` and so on, and
/// need no quotes.
pub fn pipeline(script: &str, words: &[&str]) -> Result<(), String> {
    let mut bash = Command::new("bash");
    bash.args(["-o", "pipefail", "-euc", script, "tests"]).args(words);
    run(&mut bash)
}

/// Lets the calling thread, and all that it starts, run before the other programs of a busy computer. Only root may
/// request it. The core of an MCU that waits 0.1 s for a processor stops, as it should.
pub fn run_first() {
    let _ = set_nice(-15);
}

/// A process that is killed when this is dropped, for example when its test fails.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
