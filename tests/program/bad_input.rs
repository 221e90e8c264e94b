// SPDX-License-Identifier: GPL-3.0-or-later
//! Invalid input. From a host, each case ends in the shutdown text of Klipper's C, and in a log line with the cause and the
//! remedy. The process is ready for the next FIRMWARE_RESTART. A wrong file ends the command with one line.

use std::fs::{self, File};
use std::time::Instant;

use pinion_client::Client;
use pinion_client::serial::Port;
use pinion_protocol::block::Sequence;

use crate::process::{Pinion, WAIT_MAX, limited};

/// Sends the lines to an MCU with eight ids. It must stop for `reason` and log all of `words` in one line. Then a reset
/// must make it ready again.
#[track_caller]
fn stops(pinion: &Pinion, lines: &[&str], reason: &str, words: &[&str]) {
    let mut client = pinion.client();
    if client.status().unwrap().is_shutdown || client.status().unwrap().is_config {
        client.reset().unwrap();
    }
    client.send_line("allocate_oids count=8").unwrap();
    for line in lines {
        let line = timed(&mut client, line);
        client.send_line(&line).unwrap();
    }
    let stop = client.wait_shutdown(WAIT_MAX).unwrap();
    assert_eq!(stop.as_deref(), Some(reason), "{:?}", lines.last());
    let line = || pinion.logged(&format!("shutdown: {reason}: "));
    pinion.until(&format!("a line with {words:?}"), || words.iter().all(|word| line().contains(word)));
    restarts(&mut client);
}

/// The line with a clock for its `@3`: three seconds after the line is sent.
fn timed(client: &mut Client, line: &str) -> String {
    let Some((before, after)) = line.split_once('@') else { return line.into() };
    let (seconds, after) = after.split_once(' ').unwrap_or((after, ""));
    let clock = client.clock_in(seconds.parse().unwrap()).unwrap().wire();
    format!("{before}{clock} {after}")
}

#[track_caller]
fn restarts(client: &mut Client) {
    client.reset().unwrap();
    let status = client.status().unwrap();
    assert!(!status.is_shutdown && !status.is_config);
}

const OUTPUT: &str = "config_digital_out oid=0 pin=led value=0 default_value=0 max_duration=50000000";
const STEPPER: &str = "config_stepper oid=1 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100";

#[test]
fn wrong_pins() {
    let pinion = Pinion::simulated(&[]);
    stops(
        &pinion,
        &["config_digital_out oid=0 pin=4711 value=0 default_value=0 max_duration=0"],
        "Not an output pin",
        &["4711"],
    );
    stops(&pinion, &["config_endstop oid=0 pin=x_step pull_up=1"], "Not an input pin", &["x_step"]);
    stops(&pinion, &["config_analog_in oid=0 pin=led"], "Unable to open adc device", &["led"]);
}

#[test]
fn a_chip_that_is_missing() {
    let pinion = Pinion::start(&["run"]);
    pinion.wait_for_link();
    let line = "config_digital_out oid=0 pin=gpiochip7/gpio5 value=0 default_value=0 max_duration=0";
    stops(&pinion, &[line], "GPIO chip device not found", &["gpiochip7"]);
}

#[test]
fn wrong_oids() {
    let pinion = Pinion::simulated(&[]);
    stops(&pinion, &["update_digital_out oid=3 value=1"], "Invalid oid type", &["oid 3"]);
    stops(&pinion, &[OUTPUT, "queue_step oid=0 interval=1 count=1 add=0"], "Invalid oid type", &["oid 0"]);
    let beyond = "config_digital_out oid=8 pin=led value=0 default_value=0 max_duration=0";
    stops(&pinion, &[beyond], "Can't assign oid", &["oid 8"]);
}

#[test]
fn wrong_times() {
    let pinion = Pinion::simulated(&[]);
    let configured = [OUTPUT, STEPPER, "finalize_config crc=1"];
    let past = ["queue_digital_out oid=0 clock=@-1 on_ticks=1"];
    stops(&pinion, &[&configured[..], &past].concat(), "Timer too close", &["us after its time"]);
    let past = ["reset_step_clock oid=1 clock=@-1", "queue_step oid=1 interval=10 count=1 add=0"];
    stops(&pinion, &[&configured[..], &past].concat(), "Timer too close", &["overloaded"]);
    let far = ["reset_step_clock oid=1 clock=@30"];
    let many = ["queue_step oid=1 interval=50000 count=1 add=0"; 1026];
    stops(&pinion, &[&configured[..], &far, &many].concat(), "Move queue overflow", &[]);
}

#[test]
fn a_reading_out_of_range() {
    let pinion = Pinion::simulated(&[]);
    let query = "query_analog_in oid=2 clock=@3 sample_ticks=50000 sample_count=4 rest_ticks=5000000 \
                 min_value=0 max_value=1 range_check_count=2";
    let lines = ["config_analog_in oid=2 pin=bed_sensor", "finalize_config crc=1", query];
    stops(&pinion, &lines, "ADC out of range", &["oid 2", "sensor"]);
}

#[test]
fn memory_is_not_poked() {
    let pinion = Pinion::simulated(&[]);
    let reason = "Memory access is not available on Linux";
    stops(&pinion, &["debug_read order=2 addr=0"], reason, &["debug_read"]);
    stops(&pinion, &["debug_write order=2 addr=0 val=1"], reason, &["debug_write"]);
}

#[test]
fn commands_that_are_none_and_commands_cut_short() {
    let pinion = Pinion::simulated(&[]);
    // An unknown command number, and identify without its count.
    for (payload, reason) in [(&[0x9f, 0x7f][..], "Invalid command"), (&[0x01, 0x00][..], "Command parser error")] {
        let mut client = pinion.client();
        client.link().send(payload).unwrap();
        assert_eq!(client.wait_shutdown(WAIT_MAX).unwrap().as_deref(), Some(reason));
        pinion.logged(&format!("shutdown: {reason}: "));
        restarts(&mut client);
    }
}

#[test]
fn garbage_truncated_and_endless_blocks_are_answered_by_a_nak_and_overcome() {
    let pinion = Pinion::simulated(&[]);
    let mut client = pinion.client();
    client.status().unwrap();
    for noise in [
        &b"\x40\x10 a block that promises more than it holds"[..],
        &[0xff; 5000],
        &[0x7e; 300],
        b"\x05\x10\x00\x00\x7e",
        b"FORCE_SHUTDOWN",
    ] {
        client.link().port().queue(noise);
        // A sync byte ends any block that the noise began.
        client.link().port().queue(&[0x7e; 64]);
        assert!(!client.status().unwrap().is_shutdown);
    }
}

#[test]
fn a_block_out_of_order_is_answered_by_a_nak() {
    let pinion = Pinion::simulated(&[]);
    let mut port = pinion.port();
    // No block was sent before, so the MCU expects number 0.
    let (expected, next) = (Sequence::default(), Sequence::default().next());
    port.queue_block(&[], next);
    // A new MCU sends `starting`.
    let empty = |port: &mut Port| loop {
        let block = port.wait_block(Instant::now() + WAIT_MAX).unwrap();
        let (sequence, payload) = block.expect("an acknowledgement");
        if payload.is_empty() {
            break sequence;
        }
    };
    assert_eq!(empty(&mut port), expected);
    port.queue_block(&[], expected);
    assert_eq!(empty(&mut port), next, "one NAK");
}

#[test]
fn a_file_of_any_kind_ends_the_command_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let name = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let [fifo, directory, sparse] = ["fifo.svg", "directory.svg", "sparse"].map(name);
    nix::unistd::mkfifo(&*fifo, nix::sys::stat::Mode::S_IRWXU).unwrap();
    fs::create_dir(&directory).unwrap();
    File::create(&sparse).unwrap().set_len(5 << 30).unwrap();
    let ends = |args: &[&str], cause: &str| {
        let (code, said) = limited(args);
        assert_eq!(code, Some(1), "{args:?}: {said}");
        assert!(said.contains(cause), "{args:?}: {said}");
    };
    let irregular = "it is not a regular file";
    for (file, cause) in
        [(&*fifo, irregular), (&*directory, irregular), ("/dev/zero", irregular), (&*sparse, "longer than")]
    {
        let board = &format!("sim:{file}");
        for args in [
            &["run", "--config", file][..],
            &["run", "--check", "--config", file],
            &["run", "--check", "--board", board],
            &["dict", "--board", board],
            &["sim", file, "--print-config"],
            &["sim", "--compare", file],
            &["console", "--board", "sim", "-f", file],
        ] {
            ends(args, cause);
        }
        ends(&["trace", file], if file == sparse { "it is not a trace of Pinion" } else { irregular });
    }
    for file in [&*fifo, &*directory] {
        for args in [
            &["sim", "--toolpath", file][..],
            &["sim", "--spi-trace", file],
            &["dict", "--board", "sim", "-o", file],
            &["latency", "--seconds", "2", "--svg", file],
        ] {
            ends(args, irregular);
        }
    }
}
