// SPDX-License-Identifier: GPL-3.0-or-later
//! The program and its guardian, from outside.

use std::fs::{self, File};
use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};
use std::time::Instant;

use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, getgid};
use pinion_client::Client;
use pinion_testkit::process::Running;
use pinion_testkit::{here, wait};

use crate::process::{Pinion, WAIT_MAX, exists, last_reason, pinion_path};
use crate::search::is_gone;
use crate::status::{socket, status};

fn start() -> Pinion {
    let pinion = Pinion::start(&["run", "-g", &getgid().to_string()]);
    pinion.wait_for_link();
    pinion
}

pub fn guardian(pinion: &Pinion) -> u32 {
    let pid = pinion.pid();
    let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap();
    let named = |pid: &&str| fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|c| c == "pinion-guardian\n");
    children.split_whitespace().find(named).expect("a guardian").parse().unwrap()
}

fn signal(pid: u32, signal: Signal) {
    kill(Pid::from_raw(pid as i32), signal).unwrap();
}

#[test]
fn a_program_without_its_guardian_shuts_down_and_fails() {
    let mut pinion = start();
    signal(guardian(&pinion), Signal::SIGKILL);
    assert_eq!(pinion.end().code(), Some(1), "{}", pinion.log());
    let reason = "shutdown: Guardian process lost: somebody killed the guardian";
    assert!(pinion.log().contains(reason), "{}", pinion.log());
}

#[test]
fn a_host_can_read_that_the_guardian_is_lost_even_if_it_is_busy_for_a_moment() {
    wait::in_time(|_| {
        let pinion = start();
        let mut client = pinion.client();
        let killed = Instant::now();
        signal(guardian(&pinion), Signal::SIGKILL);
        pinion.logged("shutdown: Guardian process lost: ");
        assert_eq!(last_reason(&mut client, killed).as_deref(), Some("Guardian process lost"));
    });
}

/// As systemd reads it for `systemctl status`.
#[test]
fn the_service_manager_knows_what_the_program_does() {
    let folder = tempfile::tempdir().unwrap();
    let [path, link] = ["notify", "tty"].map(|name| folder.path().join(name));
    let manager = UnixDatagram::bind(&path).unwrap();
    manager.set_read_timeout(Some(WAIT_MAX)).unwrap();
    let mut run = Command::new(pinion_path());
    run.args(["run", "-g", &getgid().to_string(), "-I"]).arg(&link);
    run.env("NOTIFY_SOCKET", &path).env("STATE_DIRECTORY", folder.path());
    let program = Running(run.stderr(Stdio::null()).spawn().unwrap());
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
    let client = Client::connect(&link, WAIT_MAX).unwrap();
    hear("a host is attached");
    drop(client);
    hear("no host is attached");
    signal(program.0.id(), Signal::SIGTERM);
    hear("STOPPING=1");
}

#[test]
fn the_status_names_the_guardians_process() {
    let pinion = start();
    pinion.until("the socket", || exists(&socket(&pinion)));
    assert_eq!(status(&pinion)["guardian"]["pid"], guardian(&pinion));
}

#[test]
fn a_signal_to_both_processes_ends_both_in_order() {
    wait::in_time(|_| {
        // As from a service manager, and as from keys that stop programs. A stopped program would not end.
        for signals in [&[Signal::SIGTERM][..], &[Signal::SIGTSTP, Signal::SIGTTIN, Signal::SIGTTOU, Signal::SIGTERM]] {
            let mut pinion = start();
            let guardian = guardian(&pinion);
            for sent in signals {
                signal(guardian, *sent);
                pinion.signal(*sent);
            }
            assert!(pinion.end().success(), "{signals:?}: {}", pinion.log());
            if pinion.log().contains("Pinion kills it") {
                wait::was_late("so was the guardian");
            }
            assert!(is_gone(guardian), "{signals:?}");
            assert!(!pinion.log().contains("guardian"), "{signals:?}: {}", pinion.log());
        }
    });
}

#[test]
fn the_guardian_ends_with_a_killed_program() {
    let pinion = start();
    let guardian = guardian(&pinion);
    pinion.signal(Signal::SIGKILL);
    pinion.until("the guardian's end", || is_gone(guardian));
}

#[test]
fn a_guardian_that_is_stopped_does_not_outlive_the_program() {
    let mut pinion = start();
    let guardian = guardian(&pinion);
    signal(guardian, Signal::SIGSTOP);
    pinion.signal(Signal::SIGTERM);
    assert!(pinion.end().success(), "{}", pinion.log());
    let line = "is stopped or hangs, and would keep the lines: Pinion kills it";
    assert!(pinion.log().contains(line), "{}", pinion.log());
    pinion.until("the guardian's end", || is_gone(guardian));
}

/// A container with process numbers of its own. The kernel then kills the guardian with the first process.
#[test]
fn a_program_that_takes_its_guardian_along_says_so() {
    if !here::is_root() {
        return;
    }
    const WARNING: &str = "start the container with --pid=host";
    let mut pinion = start();
    pinion.signal(Signal::SIGTERM);
    pinion.end();
    assert!(!pinion.log().contains(WARNING), "{}", pinion.log());

    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let child = Command::new("unshare")
        .args(["--pid", "--fork", "--kill-child"])
        .arg(pinion_path())
        .args(["run", "-g", "0", "-I"])
        .arg(folder.path().join("tty"))
        .stderr(File::create(&log).unwrap())
        .spawn();
    let _child = Running(child.unwrap());
    // A thread writes the log. A killed program loses what was not written yet.
    wait::until("the warning", || fs::read_to_string(&log).unwrap().contains(WARNING));
}
