// SPDX-License-Identifier: GPL-3.0-or-later
//! `-w` on the kernel's software watchdog.

use std::fs::File;
use std::io::Write;
use std::process::Command;
use std::thread;
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::program::{Program, configure};
use crate::{sysfs, uapi};

/// How long the watchdog waits before it would reset the computer.
const LIMIT_S: u32 = 10;
/// A long wait costs nothing here: the time jumps while the guest is idle.
const LONGER: Duration = Duration::from_secs(15);

fn is_active() -> bool {
    sysfs::read("/sys/class/watchdog/watchdog0/state") == "active"
}

/// Whether it would have reset the computer since this test began.
fn has_fired() -> bool {
    let log = Command::new("dmesg").output().expect("busybox").stdout;
    String::from_utf8_lossy(&log).contains("Triggered - Reboot ignored")
}

/// The watchdog. It is stopped at the end if it still runs.
struct Watchdog;

impl Watchdog {
    fn new() -> Watchdog {
        let mut device = File::create("/dev/watchdog").expect("the watchdog");
        uapi::set_watchdog_timeout(&device, LIMIT_S);
        device.write_all(b"V").expect("closing");
        Watchdog
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        let _ = File::create("/dev/watchdog").and_then(|mut device| device.write_all(b"V"));
    }
}

#[test]
fn it_is_fed_while_the_program_gets_on_and_stopped_when_that_ends() {
    let _watchdog = Watchdog::new();
    let mut program = Program::with(&["-r", "-w"], &[]);
    program.wait_for_line(&["/dev/watchdog resets this computer 10 s after Pinion hangs"]);
    let client = &mut program.connect();
    configure(client, 1, &["config_spi_without_cs oid=0", "spi_set_bus oid=0 spi_bus=spidev0.0 mode=0 rate=1000000"]);
    thread::sleep(LONGER);
    assert!(is_active() && !has_fired());

    // A bus that is stuck for a while.
    let delay = sysfs::set("/sys/devices/platform/mock-spi/delay_ms", "25000", "0");
    client.send_line("spi_send oid=0 data=01").expect("a session");
    thread::sleep(LONGER);
    drop(delay);
    program.wait_for_line(&["a transfer on spi0 takes more than 10 s, so the watchdogs are not fed"]);
    thread::sleep(LONGER);
    program.wait_for_line(&["the watchdogs are fed again"]);
    assert!(has_fired());

    program.signal(Signal::SIGTERM);
    assert!(program.wait().success());
    assert!(!is_active());
}

#[test]
fn a_core_that_hangs_and_a_program_that_dies_do_not_feed_it() {
    let _watchdog = Watchdog::new();
    let mut program = Program::with(&["-r", "-w"], &[("PINION_TEST_HANG", "1")]);
    // Without outputs the guardian does not kill it.
    configure(&mut program.connect(), 0, &[""; 0]);
    program.signal(Signal::SIGUSR2);
    thread::sleep(LONGER);
    program.wait_for_line(&["the core hangs, so the watchdogs are not fed"]);
    assert!(has_fired());
    program.kill();
    assert!(is_active(), "nobody stopped it");
}

#[test]
fn a_watchdog_that_is_taken_is_refused() {
    let _watchdog = Watchdog::new();
    let held = File::create("/dev/watchdog").expect("the watchdog");
    let output = Command::new("pinion").args(["run", "-w", "-g", "0", "-I", "/tmp/never"]).output().expect("pinion");
    drop(held);
    let log = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{log}");
    assert!(log.contains("-w: /dev/watchdog cannot be opened") && log.contains("another program feeds it"), "{log}");
}
