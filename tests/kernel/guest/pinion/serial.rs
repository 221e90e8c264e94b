// SPDX-License-Identifier: GPL-3.0-or-later
//! The UART of stepper drivers on a serial port of the driver 8250. The port's hardware loops, so it hears its own
//! message, as on the one wire. The test plays the stepper driver.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use nix::fcntl::{Flock, FlockArg};
use pinion_client::Client;

use crate::program::{Program, configure, refusal};
use crate::uapi;

/// A read of register 2 of driver 0 (f5 00 02 c8), with start and stop bits.
const SENT: [u8; 5] = [0xea, 0x03, 0x48, 0x20, 0xe4];
/// The driver's reply, and the same with start and stop bits.
const REPLY: [u8; 8] = [0x05, 0xff, 0x02, 0x00, 0x00, 0x00, 0x02, 0x8b];
const HEARD: [u8; 10] = [0x0a, 0xfa, 0x4f, 0x20, 0x80, 0x00, 0x02, 0x48, 0xa0, 0xc5];

fn config(port: &str) -> String {
    format!("config_tmcuart oid=0 rx_pin={port} pull_up=1 tx_pin={port} bit_time=1250")
}

fn port() -> File {
    OpenOptions::new().read(true).write(true).open("/dev/ttyS1").expect("a second serial port")
}

/// Sends a read, then the driver's reply, and returns the answer to the host.
fn ask(client: &mut Client, driver: Option<&mut File>) -> Vec<u8> {
    let args = [("oid", 0_u8.into()), ("write", SENT[..].into()), ("read", 10_u8.into())];
    client.send("tmcuart_send", &args).expect("a session");
    if let Some(driver) = driver {
        thread::sleep(Duration::from_millis(10));
        driver.write_all(&REPLY).expect("the port takes it");
    }
    let until = Instant::now() + Duration::from_secs(10);
    let reply = client.wait("tmcuart_response", Some(0), until).expect("a session").expect("a response");
    reply.bytes("read").expect("bytes").to_vec()
}

#[test]
fn a_message_its_echo_and_a_reply_go_over_the_port() {
    let mut port = port();
    uapi::loop_back(&port, true);
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 1, &[config("ttyS1")]);
    for _ in 0..200 {
        assert_eq!(ask(client, Some(&mut port)), HEARD);
    }
    assert!(!program.log().contains("TMC UART ttyS1"), "{}", program.log());
    assert_eq!(ask(client, None), [0_u8; 0]);
    program.wait_for_line(&["TMC UART ttyS1: no driver answers at address 0"]);
    assert_eq!(ask(client, Some(&mut port)), HEARD);
    uapi::loop_back(&port, false);
    assert_eq!(ask(client, None), [0_u8; 0]);
    program.wait_for_line(&["TMC UART ttyS1: it receives nothing, not even its own message"]);
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_port_in_use_and_the_console_are_refused() {
        let program = Program::start();
        let client = &mut program.connect();
        assert_eq!(refusal(client, 1, &[config("ttyS0")]), "Unable to open serial port");
        program.wait_for_line(&["/dev/ttyS0: the kernel writes its messages to it: remove its console="]);
        let other = Flock::lock(port(), FlockArg::LockExclusiveNonblock).expect("nobody uses it");
        assert_eq!(refusal(client, 1, &[config("ttyS1")]), "Unable to open serial port");
        program.wait_for_line(&["/dev/ttyS1: another program uses it: end that program"]);
        drop(other);
        configure(client, 1, &[config("ttyS1")]);
        // Its lock is free again with the next configuration.
        configure(client, 1, &[config("ttyS1")]);
        let list = Command::new("pinion").args(["pins", "serial"]).output().expect("a program");
        let list = String::from_utf8(list.stdout).expect("text");
        assert!(list.contains("uart_pin: ttyS1") && list.contains("/dev/ttyS0  none: the kernel writes"), "{list}");
    }
}
