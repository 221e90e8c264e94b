// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs go to their shutdown values in every kind of stop of the MCU.

use std::fs;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::pty::{grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::signal::Signal;
use pinion_client::Client;
use pinion_client::serial::{BlockLink, Port};

use super::outputs::Outputs;
use crate::program::{Program, shutdown_of};
use crate::trace::Trace;

fn force_shutdown(link: &Path) {
    fs::write(link, "FORCE_SHUTDOWN\n").expect("the pty");
}

#[test]
fn an_emergency_stop_and_a_word_on_the_pty_and_a_signal() {
    let outputs = Outputs::new();
    let mut program = Program::start();
    let client = &mut program.connect();

    outputs.switch_on(client, 0);
    let trace = Trace::start();
    outputs.wait_until_on();
    assert_eq!(client.emergency_stop().expect("a session").as_deref(), Some("Command request"));
    outputs.assert_safe(&trace);
    drop(trace);

    outputs.switch_on(client, 0);
    let trace = Trace::start();
    outputs.wait_until_on();
    force_shutdown(program.link());
    assert_eq!(shutdown_of(client), "Force shutdown command");
    outputs.assert_safe(&trace);
    program.wait_for_line(&["Force shutdown command", "somebody wrote FORCE_SHUTDOWN"]);
    drop(trace);

    outputs.switch_on(client, 0);
    let trace = Trace::start();
    outputs.wait_until_on();
    program.signal(Signal::SIGTERM);
    assert!(program.wait().success());
    outputs.assert_safe(&trace);
    assert!(!program.link().exists());
}

#[test]
fn a_host_that_says_nothing_any_more_or_is_gone() {
    let outputs = Outputs::new();
    let mut program = Program::start();
    let silent: &dyn Fn(Client) = &|mut client| {
        assert_eq!(shutdown_of(&mut client), "Missed scheduling of next digital out event");
    };
    for host in [silent, &drop] {
        let mut client = program.connect();
        let began = Instant::now();
        outputs.switch_on(&mut client, 500);
        let trace = Trace::start();
        outputs.wait_until_on();
        println!("all on after {:?}", began.elapsed());
        host(client);
        outputs.assert_safe(&trace);
    }
    program.wait_for_line(&["was not refreshed within its max_duration of 500 ms"]);
    assert!(program.is_running());
}

fn client_of(host: impl Into<OwnedFd>) -> Client {
    let port = Port::from_fd(host.into(), "the host's end").expect("a descriptor");
    Client::new(BlockLink::new(port, Duration::from_secs(10)).expect("a session")).expect("an MCU")
}

#[test]
fn a_serial_port_that_is_pulled_out() {
    let outputs = Outputs::new();
    let host = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC).expect("a port");
    grantpt(&host).expect("a port");
    unlockpt(&host).expect("a port");
    let mut program = Program::on_link(&format!("serial:{}", ptsname_r(&host).expect("its name")));
    program.wait_for_line(&["serving on"]);
    let mut client = client_of(host);
    outputs.switch_on(&mut client, 500);
    let trace = Trace::start();
    outputs.wait_until_on();
    drop(client);
    outputs.assert_safe(&trace);
    program.wait_for_line(&["is gone, and the host with it"]);
    assert!(program.is_running());
}

#[test]
fn an_input_that_ends() {
    let outputs = Outputs::new();
    let (host, ours) = UnixStream::pair().expect("sockets");
    let mut program = Program::on_stdio(ours);
    let mut client = client_of(host);
    // No output has a time. The program ends with its input, and leaves nothing on.
    outputs.switch_on(&mut client, 0);
    let trace = Trace::start();
    outputs.wait_until_on();
    drop(client);
    outputs.assert_safe(&trace);
    assert!(program.wait().success(), "{}", program.log());
}
