// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy at the other end of a serial line: two pseudo terminals, and a thread that carries the bytes between them. It
//! loses some.

use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};

use super::Printer;
use crate::checkout;

/// One byte in so many is lost.
const LOST: usize = 20_011;

/// One end of the line, and the terminal of the program there.
fn end() -> (PtyMaster, String) {
    let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC | OFlag::O_NONBLOCK;
    let end = posix_openpt(flags).unwrap();
    grantpt(&end).unwrap();
    unlockpt(&end).unwrap();
    let terminal = ptsname_r(&end).unwrap();
    (end, terminal)
}

/// Makes the line. The terminals of its two ends. It lives as long as the test's process.
fn line() -> [String; 2] {
    let ((mut host, at_host), (mut mcu, at_mcu)) = (end(), end());
    thread::spawn(move || {
        let mut carried = 0;
        let mut carry = |from: &mut PtyMaster, to: &mut PtyMaster| {
            let mut bytes = [0; 256];
            match from.read(&mut bytes) {
                Ok(len) => {
                    for byte in &bytes[..len] {
                        carried += 1;
                        if carried % LOST != 0 {
                            // A full line loses bytes, as a UART does.
                            let _ = to.write(&[*byte]);
                        }
                    }
                    len > 0
                }
                // Nobody has the terminal open.
                Err(error) if error.raw_os_error() == Some(libc::EIO) => false,
                Err(error) if error.kind() == ErrorKind::WouldBlock => false,
                Err(error) => panic!("{error}"),
            }
        };
        loop {
            let is_busy = carry(&mut host, &mut mcu) | carry(&mut mcu, &mut host);
            if !is_busy {
                thread::sleep(Duration::from_micros(200));
            }
        }
    });
    [at_host, at_mcu]
}

/// klippy takes the line for a UART.
fn as_uart(config: String) -> String {
    let line = config.lines().find(|line| line.starts_with("serial: ")).unwrap().to_owned();
    let terminal = fs::read_link(Path::new(line.strip_prefix("serial: ").unwrap())).unwrap();
    config.replace(&line, &format!("serial: {}\nbaud: 250000\nrestart_method: command", terminal.display()))
}

/// How long the print lasts, in minutes. Without this it is a short one.
const MINUTES: &str = "PINION_PRINT_MINUTES";

/// Prints, and ends at x and y of 70 mm.
pub(crate) fn print_a_while(printer: &mut Printer) {
    let minutes: f64 = std::env::var(MINUTES).map_or(0.2, |minutes| minutes.parse().unwrap());
    printer.gcode("G28\nG1 Z5 F600");
    let began = Instant::now();
    while began.elapsed().as_secs_f64() < 60.0 * minutes {
        // 45 degrees, and both motors of it busy.
        printer.gcode("G1 X40 Y40 F12000\nG1 X100 Y100\nG1 X100 Y40\nG1 X40 Y100\nG1 X70 Y70\nM400");
    }
}

#[test]
fn klippy_prints_over_a_serial_line_that_loses_bytes() {
    let Some(checkout) = checkout("klippy_prints_over_a_serial_line_that_loses_bytes") else { return };
    let [at_host, at_mcu] = line();
    let mut printer = Printer::start_here_on(
        &checkout,
        |board, _| board,
        as_uart,
        |folder| {
            symlink(at_host, folder.join("tty")).unwrap();
            format!("serial:{at_mcu}").parse().unwrap()
        },
    );
    // The wire's rate is klippy's own.
    assert!(printer.host_log("SERIAL_BAUD=250000", 1).contains("SERIAL_BAUD=250000"));
    print_a_while(&mut printer);
    for name in ["x", "y"] {
        let axis = printer.probe().axis(name).unwrap();
        assert!((axis.position_mm - 70.0).abs() <= 0.0125, "{name}: {} mm, not 70", axis.position_mm);
        assert_eq!(axis.lost_steps, 0, "{name}");
    }
    // klippy had to send blocks again, and nothing else happened.
    let log = printer.host_log("", 0);
    let resent = log.rsplit("bytes_retransmit=").next().unwrap().split(' ').next().unwrap();
    assert!(resent.parse::<u32>().unwrap() > 0, "{resent}");
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("G28 X");
}
