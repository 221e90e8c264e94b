// SPDX-License-Identifier: GPL-3.0-or-later
//! Hosts and clients of the terminal that do harm, on purpose or not, and low limits.

use std::fs::{self, File};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::signal::Signal;
use nix::sys::termios::{FlowArg, InputFlags, LocalFlags, SetArg, tcflow, tcgetattr, tcsetattr};
use pinion_linux::sys;
use pinion_protocol::block::{Sequence, frame};
use pinion_protocol::vlq::Writer;
use pinion_testkit::process::Running;
use pinion_testkit::wait;
use tempfile::TempDir;

use crate::process::{Pinion, as_nobody, pinion_path, program};
use crate::terminal::AtTerminal;

/// A member of the terminal's group that has it open.
fn client_of(pinion: &Pinion) -> File {
    let mut options = File::options();
    options.read(true).write(true).custom_flags((OFlag::O_NOCTTY | OFlag::O_NONBLOCK).bits());
    options.open(pinion.link()).unwrap()
}

/// The client writes a byte and leaves.
fn wrote_and_left(pinion: &Pinion, mut client: File) {
    client.write_all(b"~").unwrap();
    pinion.logged("host attached");
    drop(client);
    pinion.logged("host gone");
}

/// Whether an ordinary user can open the terminal.
fn is_open_to_others(pinion: &Pinion) -> bool {
    let mut command = Command::new("sh");
    command.args(["-c", ": <>\"$0\""]).arg(pinion.link()).stderr(Stdio::null());
    as_nobody(&mut command).status().unwrap().success()
}

#[test]
fn a_terminal_that_a_client_closed_to_others_is_replaced_when_the_client_leaves() {
    let pinion = Pinion::start_as_nobody(&["-m", "0666"]);
    let before = fs::read_link(pinion.link()).unwrap();
    let client = client_of(&pinion);
    sys::make_exclusive(&client).unwrap();
    wrote_and_left(&pinion, client);
    let replaced = pinion.logged("can no longer be used");
    assert!(replaced.contains("resource busy") && replaced.contains("hosts find it there"), "{replaced}");
    assert!(is_open_to_others(&pinion));
    let mut host = pinion.client();
    host.status().unwrap();
    // All parts of the program know the new terminal.
    let now = fs::read_link(pinion.link()).unwrap();
    assert_ne!(now, before);
    let status = Command::new(pinion_path()).args(["status", "--json", "-I"]).arg(pinion.link()).output();
    let status = String::from_utf8(status.unwrap().stdout).unwrap();
    assert!(status.contains(&format!("\"{}\"", now.display())), "{status}");
    assert!(status.contains("\"attached\":true") || status.contains("\"attached\": true"), "{status}");
}

#[test]
fn a_link_that_another_program_took_stays_when_the_terminal_is_replaced() {
    let pinion = Pinion::start_as_nobody(&["-m", "0666"]);
    let client = client_of(&pinion);
    sys::make_exclusive(&client).unwrap();
    fs::remove_file(pinion.link()).unwrap();
    std::os::unix::fs::symlink("/dev/null", pinion.link()).unwrap();
    wrote_and_left(&pinion, client);
    pinion.logged("can no longer be used");
    assert_eq!(fs::read_link(pinion.link()).unwrap().to_str(), Some("/dev/null"));
}

#[test]
fn a_terminal_that_a_silent_client_closed_to_others_is_opened_again() {
    let pinion = Pinion::start_as_nobody(&["-m", "0666"]);
    let client = client_of(&pinion);
    sys::make_exclusive(&client).unwrap();
    drop(client);
    pinion.until("the terminal is open to others", || is_open_to_others(&pinion));
    pinion.client().status().unwrap();
    assert!(!pinion.log().contains("can no longer be used"), "{}", pinion.log());
}

#[test]
fn a_terminal_is_restored_after_each_client() {
    for is_silent in [true, false] {
        let pinion = Pinion::start_as_nobody(&["-m", "0666"]);
        let client = client_of(&pinion);
        let before = tcgetattr(&client).unwrap();
        let mut cooked = before.clone();
        cooked.local_flags |= LocalFlags::ICANON | LocalFlags::ECHO | LocalFlags::ISIG;
        cooked.input_flags |= InputFlags::IXON | InputFlags::ISTRIP;
        // A byte passes only before the client stops the output.
        let mut other = client_of(&pinion);
        if !is_silent {
            other.write_all(b"~").unwrap();
            pinion.logged("host attached");
        }
        tcsetattr(&client, SetArg::TCSANOW, &cooked).unwrap();
        tcflow(&client, FlowArg::TCOOFF).unwrap();
        drop((client, other));
        pinion.until("the terminal's settings are restored", || tcgetattr(client_of(&pinion)).unwrap() == before);
        pinion.client().status().unwrap();
    }
}

/// Sets the limit of open files of a running program. `None`: no further file.
fn limit_files(pinion: &Pinion, limit: Option<usize>) {
    let pid = pinion.pid().to_string();
    // The kernel gives the lowest free number, which must be below the limit.
    let is_free = |number: &usize| fs::symlink_metadata(format!("/proc/{pid}/fd/{number}")).is_err();
    let limit = limit.or_else(|| (0..).find(is_free)).unwrap();
    // The soft limit: an ordinary user may raise that again.
    let mut command = Command::new("prlimit");
    command.args(["--pid", &pid, &format!("--nofile={limit}:")]);
    assert!(as_nobody(&mut command).status().unwrap().success());
}

#[test]
fn a_program_that_can_open_no_further_file_serves_on_and_the_next_host_when_it_can() {
    let pinion = Pinion::start_as_nobody(&["-m", "0666"]);
    let mut host = pinion.client();
    host.status().unwrap();
    limit_files(&pinion, None);
    host.status().unwrap();
    drop(host);
    let refused = pinion.logged("can no longer be used");
    assert!(refused.contains("Too many open files") && refused.contains("raise LimitNOFILE"), "{refused}");
    // While the program can open no file, nobody gets an answer on these sockets.
    let _status = std::os::unix::net::UnixStream::connect(pinion.link().with_extension("sock"));
    let _trace = std::os::unix::net::UnixStream::connect(pinion.link().with_extension("trace"));
    limit_files(&pinion, Some(256));
    pinion.client().status().unwrap();
}

#[test]
fn a_host_that_sends_bad_commands_to_a_stopped_mcu_does_not_fill_the_log() {
    let mut pinion = Pinion::simulated(&[]);
    let mut host = pinion.client();
    let mut bad = Writer::default();
    (0..20).for_each(|_| bad.int(5000));
    let bad = bad.payload().unwrap();
    host.send_line("emergency_stop").unwrap();
    pinion.logged("shutdown: Command request");
    let mut tty = fs::OpenOptions::new().write(true).open(pinion.link()).unwrap();
    let mut sequence = Sequence::default();
    for _ in 0..5_000 {
        let mut block = Vec::new();
        frame(bad, sequence, &mut block);
        tty.write_all(&block).unwrap();
        sequence = sequence.next();
    }
    pinion.logged("while shut down: ");
    // Another kind of line gets through.
    drop((host, tty));
    pinion.logged("host gone");
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(0));
    let log = pinion.log();
    assert!(log.lines().count() < 150, "{} lines:\n{}", log.lines().count(), &log[..4096]);
    let left_out = log.lines().find(|line| line.contains(" more lines like this were left out: ")).expect(&log);
    assert!(left_out.contains("while shut down: "), "{left_out}");
}

#[test]
fn a_client_that_comes_and_goes_at_will_does_not_fill_the_log() {
    let mut pinion = Pinion::simulated(&[]);
    let comes = || File::options().write(true).open(pinion.link()).unwrap();
    for _ in 0..300 {
        comes().write_all(b"FORCE_SHUTDOWN\n").unwrap();
        thread::sleep(Duration::from_millis(1));
    }
    pinion.client().status().unwrap();
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(0));
    let log = pinion.log();
    assert!(log.lines().count() < 400, "{} lines:\n{log}", log.lines().count());
}

/// Starts three programs at one link at once. Their processes and logs.
fn three_at_once(folder: &TempDir) -> Vec<(Running, PathBuf)> {
    let start = |number: usize| {
        let log = folder.path().join(format!("log{number}"));
        let child = Command::new(pinion_path())
            .args(["run", "--board", "sim", "-I"])
            .arg(folder.path().join("tty"))
            .args(["--socket".as_ref(), folder.path().join(format!("sock{number}")).as_os_str()])
            .env_remove("JOURNAL_STREAM")
            .env("STATE_DIRECTORY", folder.path())
            .stderr(File::create(&log).unwrap())
            .spawn();
        (Running(child.unwrap()), log)
    };
    (0..3).map(start).collect()
}

#[test]
fn of_programs_that_start_at_one_link_at_once_exactly_one_serves() {
    for round in 0..8 {
        let folder = tempfile::tempdir().unwrap();
        let mut programs = three_at_once(&folder);
        let log = |path: &Path| fs::read_to_string(path).unwrap();
        let is_decided = |(child, path): &mut (Running, PathBuf)| {
            child.0.try_wait().unwrap().is_some() || log(path).contains("serving on")
        };
        wait::until(&format!("round {round}"), || programs.iter_mut().all(is_decided));
        let logs = programs.iter().map(|(_, path)| log(path)).collect::<Vec<_>>().join("\n");
        let (serving, mut refused): (Vec<_>, Vec<_>) =
            programs.into_iter().partition(|(_, path)| log(path).contains("serving on"));
        assert_eq!(serving.len(), 1, "round {round}:\n{logs}");
        for (child, path) in &mut refused {
            assert_eq!(child.0.wait().unwrap().code(), Some(1));
            // Not whose process it is: root's Pinion may not look into another one, and names the oldest at this link.
            assert!(log(path).contains("which Pinion serves (process "), "round {round}:\n{logs}");
        }
    }
}

#[test]
fn a_lock_on_the_links_folder_that_another_user_holds_prevents_no_start() {
    let folder = tempfile::tempdir().unwrap();
    let lock =
        nix::fcntl::Flock::lock(File::open(folder.path()).unwrap(), nix::fcntl::FlockArg::LockExclusive).unwrap();
    let _pinion = Pinion::simulated_in(folder);
    drop(lock);
}

#[test]
fn standard_input_and_output_are_given_back_as_they_were() {
    let folder = tempfile::tempdir().unwrap();
    for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT, Signal::SIGALRM, Signal::SIGXCPU] {
        let log = folder.path().join(signal.as_str());
        let mut command = program();
        command.args(["run", "--board", "sim", "--link", "stdio", "-I"]).arg(folder.path().join("tty"));
        let mut program = AtTerminal::start(&mut command, 24, Some(File::create(&log).unwrap().into()));
        program.wait_for("the program", |_| fs::read_to_string(&log).unwrap().contains("serving on").then_some(()));
        assert!(!program.is_given_back(), "{signal}: it is raw");
        program.signal(signal);
        program.ended();
        assert!(program.is_given_back(), "{signal}");
        let flags = OFlag::from_bits_retain(fcntl(program.slave(), FcntlArg::F_GETFL).unwrap());
        assert!(!flags.contains(OFlag::O_NONBLOCK), "{signal}");
    }
}
