// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion link` and `pinion attach`: a host on another computer, over ssh. Here a script is in the place of ssh. It
//! drops ssh's options and the host, and runs the command on this computer.

use std::fs;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::Client;

use crate::process::{Pinion, WAIT_MAX, exists, pinion_path};

/// A script in the place of ssh. `before` runs first, for example `exit 255`.
fn fake_ssh(folder: &Path, before: &str) -> PathBuf {
    let program = pinion_path().parent().unwrap();
    let script = format!(
        "#!/bin/sh\n{before}\nwhile [ \"$1\" != -- ]; do shift; done\nshift 2\nPATH='{}':$PATH exec sh -c \"$*\"\n",
        program.display()
    );
    let path = folder.join("ssh");
    // A program that is being written cannot be started. Another name becomes the script in one step.
    let fresh = folder.join("ssh.fresh");
    fs::write(&fresh, script).unwrap();
    fs::set_permissions(&fresh, fs::Permissions::from_mode(0o755)).unwrap();
    fs::rename(&fresh, &path).unwrap();
    path
}

/// `pinion link` to a Pinion of this computer.
pub fn near(remote: &Path, before: &str) -> Pinion {
    let folder = tempfile::tempdir().unwrap();
    let ssh = fake_ssh(folder.path(), before);
    let link = ["link", "pi@toolhead", "--ssh", ssh.to_str().unwrap(), "--remote", remote.to_str().unwrap()];
    Pinion::start_in(folder, &link)
}

/// A simulated printer, and `pinion link` to it.
pub fn pair() -> (Pinion, Pinion) {
    let far = Pinion::simulated(&[]);
    let near = near(&far.link(), "");
    (far, near)
}

fn uptime(client: &mut Client) {
    client.query("get_uptime", &[], "uptime", None).unwrap();
}

/// The processes that carry bytes to this link.
pub fn attached(remote: &Path) -> Vec<i32> {
    let pids = fs::read_dir("/proc").unwrap().filter_map(|entry| entry.unwrap().file_name().to_str()?.parse().ok());
    let is_it = |pid: &i32| {
        let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let words: Vec<&[u8]> = line.split(|byte| *byte == 0).collect();
        matches!(words[..], [_, b"attach", b"-I", path, b""] if path == remote.as_os_str().as_encoded_bytes())
    };
    pids.filter(is_it).collect()
}

/// Waits until the line has come this often.
fn times(pinion: &Pinion, line: &str, count: usize) {
    pinion.until(&format!("\"{line}\" {count} times"), || pinion.log().matches(line).count() >= count);
}

#[test]
fn a_host_is_carried_to_the_other_computer_and_each_sees_the_other_go() {
    let (far, near) = pair();
    near.logged("connected to pi@toolhead within");
    let mut client = near.client();
    uptime(&mut client);
    far.logged("host attached");
    // Its klippy is not on that computer.
    let line = far.logged("pinion attach");
    assert!(line.contains("the host is on another computer") && line.contains("--dialect"), "{line}");
    near.signal(Signal::SIGUSR1);
    let line = near.logged("round trip to pi@toolhead: ");
    assert!(line.contains(" ms for half of ") && line.contains("jitter"), "{line}");
    drop(client);
    near.logged("host gone");
    far.logged("host gone");
    // The next host has a connection of its own.
    times(&near, "connected to", 2);
    uptime(&mut near.client());
}

#[test]
fn a_host_sees_that_the_connection_is_lost_and_the_next_one_is_served() {
    let (far, near) = pair();
    let mut client = near.client();
    uptime(&mut client);
    let [pid] = attached(&far.link())[..] else { panic!("no attach, or several") };
    kill(Pid::from_raw(pid), Signal::SIGKILL).unwrap();
    let end = Instant::now() + WAIT_MAX;
    while client.query("get_uptime", &[], "uptime", None).is_ok() {
        assert!(Instant::now() < end, "the host sees nothing");
    }
    drop(client);
    far.logged("host gone");
    near.logged("tried again until it works");
    times(&near, "connected to", 2);
    uptime(&mut near.client());
}

#[test]
fn a_service_that_is_started_anew_is_found_again() {
    let (mut far, near) = pair();
    let mut client = near.client();
    uptime(&mut client);
    far.signal(Signal::SIGTERM);
    far.end();
    let line = near.logged("Pinion has ended");
    assert!(line.contains("pi@toolhead: ") && line.contains("start Pinion there"), "{line}");
    let (folder, link) = far.into_folder();
    near.logged("No such file");
    let again = Pinion::start_in(folder, &["run", "--board", "sim"]);
    assert_eq!(again.link(), link);
    times(&near, "connected to", 2);
    uptime(&mut near.client());
}

#[test]
fn what_is_wrong_is_one_line_with_a_remedy() {
    let far = Pinion::simulated(&[]);
    let nowhere = near(&far.folder().path().join("nowhere"), "");
    let line = nowhere.logged("nowhere");
    assert!(line.contains("No such file") && line.contains("start Pinion"), "{line}");
    let refused = near(&far.link(), "echo 'Permission denied (publickey).' >&2; exit 255");
    refused.logged("pi@toolhead: Permission denied (publickey): ssh-copy-id pi@toolhead, as this user");
    // Once right, it works. A host may come before.
    let mut port = refused.port();
    fake_ssh(refused.folder().path(), "echo welcome");
    refused.logged("connected to");
    port.queue_block(&[1, 0, 40], Default::default());
    assert!(port.wait_block(Instant::now() + WAIT_MAX).unwrap().is_some());
    // The same failure was logged once.
    assert_eq!(refused.log().matches("Permission denied").count(), 1, "{}", refused.log());
}

#[test]
fn a_terminal_is_for_one_host_only() {
    let (far, near_one) = pair();
    near_one.logged("connected to");
    let near_two = near(&far.link(), "");
    let line = near_two.logged("open: stop it first");
    assert!(line.contains("pinion attach"), "{line}");
    // The user of the other terminal sees none of it.
    uptime(&mut near_one.client());
}

/// `pinion attach` that has the terminal open, with pipes.
fn attach(far: &Pinion) -> Child {
    let mut child = Command::new(pinion_path())
        .args(["attach", "-I"])
        .arg(far.link())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut sign = [0; 1];
    child.stdout.as_mut().unwrap().read_exact(&mut sign).unwrap();
    assert_eq!(sign, *b"~");
    child
}

#[test]
fn an_attach_that_hears_nothing_gives_the_terminal_back() {
    let far = Pinion::simulated(&[]);
    let mut child = attach(&far);
    // A keepalive is no host.
    let mut input = child.stdin.take().unwrap();
    input.write_all(b"~").unwrap();
    let output = child.wait_with_output().unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(log.contains("the host's computer has said nothing for 5 s: look at the network"), "{log}");
    assert!(!far.log().contains("host attached"), "{}", far.log());
    drop(input);
}

#[test]
fn an_attach_gives_its_pipes_back_as_they_were() {
    let far = Pinion::simulated(&[]);
    for is_killed in [false, true] {
        let (input, writer) = io::pipe().unwrap();
        let (mut reader, output) = io::pipe().unwrap();
        let mut child = Command::new(pinion_path())
            .args(["attach", "-I"])
            .arg(far.link())
            .stdin(input.try_clone().unwrap())
            .stdout(output.try_clone().unwrap())
            .spawn()
            .unwrap();
        let waits = |fd: BorrowedFd<'_>| {
            let flags = fcntl(fd, FcntlArg::F_GETFL).unwrap();
            !OFlag::from_bits_retain(flags).contains(OFlag::O_NONBLOCK)
        };
        reader.read_exact(&mut [0; 1]).unwrap();
        assert!(!waits(input.as_fd()) && !waits(output.as_fd()), "it does not wait for its pipes");
        if is_killed {
            kill(Pid::from_raw(child.id() as i32), Signal::SIGTERM).unwrap();
        } else {
            drop(writer);
        }
        child.wait().unwrap();
        assert!(waits(input.as_fd()) && waits(output.as_fd()), "killed: {is_killed}");
    }
}

#[test]
fn a_person_stops_the_far_mcu_by_a_shell() {
    let (far, near) = pair();
    near.logged("connected to");
    fs::OpenOptions::new().write(true).open(near.link()).unwrap().write_all(b"FORCE_SHUTDOWN\n").unwrap();
    far.logged("FORCE_SHUTDOWN was written");
}

/// The computer is busy: when `pinion attach` goes on, the connection has already ended.
#[test]
fn a_stop_arrives_though_the_connection_ends_behind_it() {
    let far = Pinion::simulated(&[]);
    let mut child = attach(&far);
    let pid = Pid::from_raw(child.id() as i32);
    kill(pid, Signal::SIGSTOP).unwrap();
    child.stdin.take().unwrap().write_all(b"FORCE_SHUTDOWN\n").unwrap();
    drop(child.stdout.take());
    kill(pid, Signal::SIGCONT).unwrap();
    far.logged("FORCE_SHUTDOWN was written");
    assert!(child.wait().unwrap().success());
}

#[test]
fn the_end_takes_the_link_away_and_ends_ssh() {
    let (far, mut near) = pair();
    uptime(&mut near.client());
    near.signal(Signal::SIGTERM);
    assert_eq!(near.end().code(), Some(0), "{}", near.log());
    assert!(!exists(&near.link()));
    far.logged("host gone");
    far.until("the end of attach", || attached(&far.link()).is_empty());
}
