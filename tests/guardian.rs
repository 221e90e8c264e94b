// SPDX-License-Identifier: GPL-3.0-or-later
//! The program and its guardian, from outside.

use std::fs::{self, File};
use std::io::Read;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::Client;
use pinion_testkit::here;

struct Program {
    child: Child,
    link: PathBuf,
    _folder: tempfile::TempDir,
}

impl Program {
    fn start() -> Program {
        Program::start_with(&[])
    }

    fn start_with(environment: &[(&str, &Path)]) -> Program {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("pty");
        let group = nix::unistd::getgid().to_string();
        let child = Command::new(env!("CARGO_BIN_EXE_pinion"))
            .args(["run", "-g", &group, "-I"])
            .arg(&link)
            .envs(environment.iter().copied())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let program = Program { child, link, _folder: folder };
        wait_until("the link appears", || program.link.exists());
        program
    }

    fn pid(&self) -> Pid {
        Pid::from_raw(self.child.id() as i32)
    }

    fn guardian(&self) -> Pid {
        let pid = self.child.id();
        let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap();
        let named =
            |pid: &&str| fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|c| c == "pinion-guardian\n");
        Pid::from_raw(children.split_whitespace().find(named).expect("a guardian").parse().unwrap())
    }

    fn end(mut self) -> (ExitStatus, String) {
        let mut log = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        (self.child.wait().unwrap(), log)
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // After a failed assertion the program still runs.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let until = Instant::now() + Duration::from_secs(60);
    while !condition() {
        assert!(Instant::now() < until, "waited in vain: {what}");
        thread::sleep(Duration::from_millis(5));
    }
}

fn exists(pid: Pid) -> bool {
    fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| !stat.contains(") Z "))
}

#[test]
fn a_program_without_its_guardian_shuts_down_and_fails() {
    let program = Program::start();
    kill(program.guardian(), Signal::SIGKILL).unwrap();
    let (status, log) = program.end();
    assert_eq!(status.code(), Some(1), "{log}");
    assert!(log.contains("shutdown: Guardian process lost: somebody killed the guardian"), "{log}");
}

#[test]
fn a_host_can_read_that_the_guardian_is_lost_even_if_it_is_busy_for_a_moment() {
    let program = Program::start();
    let mut client = Client::connect(&program.link, Duration::from_secs(20)).unwrap();
    kill(program.guardian(), Signal::SIGKILL).unwrap();
    thread::sleep(Duration::from_millis(300));
    assert_eq!(client.wait_shutdown(Duration::from_secs(20)).unwrap().as_deref(), Some("Guardian process lost"));
}

/// As systemd reads it for `systemctl status`.
#[test]
fn the_service_manager_is_told_what_the_program_does() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notify");
    let manager = UnixDatagram::bind(&path).unwrap();
    manager.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let program = Program::start_with(&[("NOTIFY_SOCKET", &path)]);
    let hear = |words: &str| {
        let mut heard = Vec::new();
        while !heard.iter().any(|message: &String| message.contains(words)) {
            let mut message = [0; 1024];
            let length = manager.recv(&mut message).unwrap_or_else(|error| panic!("{words}: {error}: {heard:?}"));
            heard.push(String::from_utf8_lossy(&message[..length]).into_owned());
        }
    };
    hear("READY=1");
    hear("no host is attached");
    let client = Client::connect(&program.link, Duration::from_secs(20)).unwrap();
    hear("a host is attached");
    drop(client);
    hear("no host is attached");
    kill(program.pid(), Signal::SIGTERM).unwrap();
    hear("STOPPING=1");
}

#[test]
fn the_status_names_the_guardians_process() {
    let program = Program::start();
    let status = || {
        let mut status = Command::new(env!("CARGO_BIN_EXE_pinion"));
        status.args(["status", "--json", "-I"]).arg(&program.link);
        serde_json::from_slice::<serde_json::Value>(&status.output().unwrap().stdout).unwrap_or_default()
    };
    wait_until("the status", || !status().is_null());
    assert_eq!(status()["guardian"]["pid"], program.guardian().as_raw());
}

#[test]
fn a_signal_to_both_processes_ends_both_in_order() {
    let program = Program::start();
    let guardian = program.guardian();
    // As a service manager does.
    kill(guardian, Signal::SIGTERM).unwrap();
    kill(program.pid(), Signal::SIGTERM).unwrap();
    let (status, log) = program.end();
    assert!(status.success(), "{log}");
    assert!(!exists(guardian));
    assert!(!log.contains("guardian"), "{log}");
}

#[test]
fn the_guardian_ends_with_a_killed_program() {
    let program = Program::start();
    let guardian = program.guardian();
    kill(program.pid(), Signal::SIGKILL).unwrap();
    program.end();
    wait_until("the guardian ends", || !exists(guardian));
}

#[test]
fn a_key_that_stops_programs_does_not_stop_this_one() {
    let program = Program::start();
    for signal in [Signal::SIGTSTP, Signal::SIGTTIN, Signal::SIGTTOU] {
        kill(program.pid(), signal).unwrap();
        kill(program.guardian(), signal).unwrap();
    }
    // A stopped program would not end.
    kill(program.pid(), Signal::SIGTERM).unwrap();
    wait_until("the program ends", || !exists(program.pid()));
    let (status, log) = program.end();
    assert!(status.success(), "{log}");
    assert!(!log.contains("guardian"), "{log}");
}

#[test]
fn a_guardian_that_is_stopped_does_not_outlive_the_program() {
    let program = Program::start();
    let guardian = program.guardian();
    kill(guardian, Signal::SIGSTOP).unwrap();
    kill(program.pid(), Signal::SIGTERM).unwrap();
    let (status, log) = program.end();
    assert!(status.success(), "{log}");
    assert!(log.contains("is stopped or hangs, and would keep the lines: Pinion kills it"), "{log}");
    wait_until("the guardian is gone", || !exists(guardian));
}

/// A container with process numbers of its own. The kernel then kills the guardian with the first process.
#[test]
fn a_program_that_takes_its_guardian_along_says_so() {
    if !here::is_root() {
        return;
    }
    const WARNING: &str = "start the container with --pid=host";
    let program = Program::start();
    kill(program.pid(), Signal::SIGTERM).unwrap();
    assert!(!program.end().1.contains(WARNING));

    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let mut child = Command::new("unshare")
        .args(["--pid", "--fork", "--kill-child", env!("CARGO_BIN_EXE_pinion"), "run", "-g", "0", "-I"])
        .arg(folder.path().join("pty"))
        .stderr(File::create(&log).unwrap())
        .spawn()
        .unwrap();
    // A thread writes the log. A killed program loses what was not written yet.
    wait_until("the warning", || fs::read_to_string(&log).unwrap().contains(WARNING));
    kill(Pid::from_raw(child.id() as i32), Signal::SIGKILL).unwrap();
    child.wait().unwrap();
}
