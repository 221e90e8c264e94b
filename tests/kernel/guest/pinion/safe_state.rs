// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs go to their shutdown values in every kind of stop of the MCU.

use std::fs;
use std::path::Path;

use nix::sys::signal::Signal;
use pinion_client::Client;

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
        outputs.switch_on(&mut client, 500);
        let trace = Trace::start();
        outputs.wait_until_on();
        host(client);
        outputs.assert_safe(&trace);
    }
    program.wait_for_line(&["was not refreshed within its max_duration of 500 ms"]);
    assert!(program.is_running());
}
