// SPDX-License-Identifier: GPL-3.0-or-later
//! One order, as a host on the pty and a chip at its pins see it. The client retries as klippy does. The simulated bus
//! takes time and records its transfers.

use std::fs;
use std::io::Write;
use std::path::PathBuf;

use nix::sys::signal::Signal;
use pinion_client::{Arg, Client, Error};

use crate::process::{Pinion, WAIT_MAX, printed};

/// A printer with buses that need this time for a transfer, and the record of its first bus, a loop.
fn slow_printer(delay_ms: u64) -> (Pinion, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let (toml, trace) = (folder.path().join("slow.toml"), folder.path().join("trace"));
    let printer = printed(&["sim", "--print-board"]);
    let slow =
        printer.replace("name = \"spidev0.0\"\n", &format!("name = \"spidev0.0\"\ndelay_us = {}\n", 1000 * delay_ms));
    assert_ne!(slow, printer, "the built-in printer's bus has another name");
    fs::write(&toml, slow).unwrap();
    let [board, record] = [&toml, &trace].map(|path| path.to_str().unwrap());
    let pinion = Pinion::start_in(folder, &["sim", board, "--spi-trace", record]);
    pinion.wait_for_link();
    (pinion, trace)
}

const SPI: u8 = 0;
const DISPLAY: &[&str] = &[
    "config_spi_without_cs oid=0",
    "spi_set_bus oid=0 spi_bus=spidev0.0 mode=0 rate=1000000",
    "config_digital_out oid=1 pin=beeper value=0 default_value=0 max_duration=0",
];

/// Asks the device to send this number back.
fn transfer(client: &mut Client, number: u8) -> Result<Vec<u8>, Error> {
    let args = [("oid", SPI.into()), ("data", Arg::Bytes(&[number]))];
    let answer = client.query("spi_transfer", &args, "spi_transfer_response", Some(SPI))?;
    Ok(answer.bytes("response")?.to_vec())
}

/// The bytes that the chip received in each transfer, in hex.
fn heard(trace: &PathBuf) -> Vec<String> {
    let trace = fs::read_to_string(trace).unwrap();
    let sent =
        |line: &str| line.split(' ').find_map(|field| field.strip_prefix("sent=")).expect("its bytes").to_owned();
    trace.lines().map(sent).collect()
}

/// The client sends a block again that is not acknowledged in time.
#[test]
fn transfers_of_400_ms_happen_once_and_have_their_own_answers() {
    let (pinion, trace) = slow_printer(400);
    let mut client = pinion.configured(DISPLAY);
    for number in 0..5 {
        assert_eq!(transfer(&mut client, number).unwrap(), [number]);
    }
    assert_eq!(heard(&trace), ["00", "01", "02", "03", "04"]);
}

/// An MCU with a bus that hangs, and a command that waits for the bus.
fn hanging() -> (Pinion, Client) {
    let (pinion, trace) = slow_printer(60_000);
    let mut client = pinion.configured(DISPLAY);
    client.send_line("spi_transfer oid=0 data=01").unwrap();
    client.send_line("update_digital_out oid=1 value=1").unwrap();
    // The answer shows that the MCU has also received the transfer.
    client.query("get_clock", &[], "clock", None).unwrap();
    assert!(heard(&trace).is_empty());
    (pinion, client)
}

#[test]
fn the_clock_is_answered_beside_a_transfer() {
    let (_pinion, mut client) = hanging();
    let clocks = [(); 3].map(|()| client.query("get_clock", &[], "clock", None).unwrap().u32("clock").unwrap());
    assert!(clocks.is_sorted_by(|a, b| b.wrapping_sub(*a) as i32 > 0), "{clocks:?}");
}

#[test]
fn an_emergency_stop_gets_past_a_bus_that_hangs() {
    let (_pinion, mut client) = hanging();
    client.send_line("emergency_stop").unwrap();
    assert_eq!(client.wait_shutdown(WAIT_MAX).unwrap().as_deref(), Some("Command request"));
    // A stopped MCU acknowledges the commands after the transfer.
    client.link().settle().unwrap();
}

#[test]
fn a_forced_shutdown_gets_past_a_bus_that_hangs() {
    let (pinion, mut client) = hanging();
    fs::OpenOptions::new().write(true).open(pinion.link()).unwrap().write_all(b"FORCE_SHUTDOWN\n").unwrap();
    assert_eq!(client.wait_shutdown(WAIT_MAX).unwrap().as_deref(), Some("Force shutdown command"));
}

#[test]
fn a_signal_gets_past_a_bus_that_hangs() {
    let (mut pinion, _client) = hanging();
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
    assert!(pinion.log().contains("shutdown: Force shutdown command: "), "{}", pinion.log());
    assert!(pinion.log().contains("spi0 does not answer"), "{}", pinion.log());
}
