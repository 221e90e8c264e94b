// SPDX-License-Identifier: GPL-3.0-or-later
//! PCA9685 outputs, on a chip that keeps its registers.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::BusStatus;

use pinion_testbench::rig::Rig;

const ADDRESS: u8 = 0x40;
/// 50 Hz, with a limit of 2 ms.
const OUTPUT: &str =
    "config_pca9685 oid=0 bus=1 addr=64 channel=2 cycle_ticks=1000000 value=0 default_value=0 max_duration=100000";
const FREE: &str =
    "config_pca9685 oid=1 bus=1 addr=64 channel=15 cycle_ticks=1000000 value=2048 default_value=4096 max_duration=0";

/// The bytes that a chip received, with their times.
type Heard = Arc<Mutex<Vec<(u64, Vec<u8>)>>>;

fn plug(rig: &Rig) -> Heard {
    let heard = Heard::default();
    let log = heard.clone();
    rig.bench.plug_i2c(1, ADDRESS, move |at, write, read| {
        assert!(read.is_empty(), "nothing is read");
        log.lock().unwrap().push((at, write.to_vec()));
        Ok(())
    });
    heard
}

/// The bytes that the chip received since the last call.
fn heard(heard: &Heard) -> Vec<(u64, Vec<u8>)> {
    std::mem::take(&mut heard.lock().unwrap())
}

fn bytes(heard_: &Heard) -> Vec<Vec<u8>> {
    heard(heard_).into_iter().map(|(_, bytes)| bytes).collect()
}

fn rig(answer_ticks: u32, commands: &[&str]) -> (Rig, Heard) {
    let mut rig = Rig::new();
    rig.bench.state().answer_ticks = answer_ticks;
    let chip = plug(&rig);
    rig.configure(commands);
    (rig, chip)
}

#[test]
fn a_chip_is_set_up_once_and_its_outputs_get_their_values() {
    let (mut rig, chip) = rig(0, &[OUTPUT, FREE]);
    let set_up = [
        vec![0, 0x31],
        vec![0xfe, 121],
        vec![0, 0x21],
        vec![0xfa, 0, 0, 0, 0x10],
        // Channel 15 is at half. Channel 2 is already off.
        vec![66, 0, 0, 0, 8],
    ];
    assert_eq!(bytes(&chip), set_up);
    assert_eq!(rig.dictionary().config["PCA9685_MAX"], 4096);
    // FIRMWARE_RESTART sets up the chip again.
    rig.send_all(&["emergency_stop", "config_reset"]);
    bytes(&chip);
    rig.forget_responses();
    rig.configure(&[FREE]);
    assert_eq!(bytes(&chip), set_up);
}

/// The chip's set-up takes 25,000 ticks, for its oscillator.
#[test]
fn queued_values_go_to_the_chip_at_their_instants() {
    let (mut rig, chip) = rig(0, &[OUTPUT, FREE]);
    bytes(&chip);
    for (at, value) in [(26_000, 4096), (50_000, 1), (90_000, 0)] {
        rig.send(&format!("queue_pca9685_out oid=0 clock=@{at} value={value}"));
    }
    rig.run_until(1_000_000);
    assert_eq!(
        heard(&chip),
        [(26_000, vec![14, 0, 0x10, 0, 0]), (50_000, vec![14, 0, 0, 1, 0]), (90_000, vec![14, 0, 0, 0, 0x10])]
    );
    assert_eq!(rig.shutdown(), None, "its default value may stay");
}

#[test]
fn a_host_that_is_silent_or_plans_too_far_ahead_stops_the_mcu() {
    for (commands, text) in [
        (&["queue_pca9685_out oid=0 clock=@26000 value=9"][..], "Missed scheduling of next pca9685 event"),
        (
            &["queue_pca9685_out oid=0 clock=@26000 value=9", "queue_pca9685_out oid=0 clock=@126001 value=0"],
            "Scheduled pca9685 event will exceed max_duration",
        ),
        (&["queue_pca9685_out oid=0 clock=@26000 value=4097"], "Invalid pca9685 value"),
    ] {
        let (mut rig, chip) = rig(0, &[OUTPUT, FREE]);
        bytes(&chip);
        rig.send_all(commands);
        rig.stops_by(200_000, text);
        // Both outputs have their shutdown values: off, and on.
        let sent = bytes(&chip);
        let last = |register: u8| sent.iter().rfind(|bytes| bytes[0] == register);
        assert_eq!(last(14), Some(&vec![14, 0, 0, 0, 0x10]));
        assert_eq!(last(66), Some(&vec![66, 0, 0x10, 0, 0]));
        assert!(!rig.mcu.has_pending_values());
    }
}

#[test]
fn a_slow_chip_gets_the_newest_value_and_its_shutdown_value_last() {
    // Each write takes 1 ms.
    let (mut rig, chip) = rig(50_000, &[FREE]);
    bytes(&chip);
    let now = rig.now();
    for n in 1..=10 {
        rig.send(&format!("queue_pca9685_out oid=1 clock=@{} value={n}", now + 1000 * n));
    }
    rig.run_until(now + 40_000);
    rig.send("emergency_stop");
    assert!(rig.mcu.has_pending_values());
    rig.run_until(now + 200_000);
    assert!(!rig.mcu.has_pending_values());
    assert_eq!(bytes(&chip), [vec![66, 0, 0, 1, 0], vec![66, 0, 0x10, 0, 0]]);
}

#[test]
fn an_output_without_an_object_is_set_and_goes_off_at_a_shutdown() {
    let (mut rig, chip) = rig(0, &["set_pca9685_out bus=1 addr=64 channel=0 cycle_ticks=1000000 value=4096"]);
    assert_eq!(bytes(&chip).last().unwrap(), &[6, 0, 0x10, 0, 0]);
    rig.send("set_pca9685_out bus=1 addr=64 channel=1 cycle_ticks=1000000 value=7");
    assert_eq!(bytes(&chip), [[10, 0, 0, 7, 0]]);
    rig.send("emergency_stop");
    rig.run_until(1);
    assert_eq!(bytes(&chip), [[6, 0, 0, 0, 0x10], [10, 0, 0, 0, 0x10]]);
}

#[test]
fn what_can_not_be_is_refused() {
    let other_cycle = FREE.replace("cycle_ticks=1000000", "cycle_ticks=1");
    for (commands, text) in [
        (&[OUTPUT, &other_cycle][..], "All PCA9685 channels must have the same cycle_ticks"),
        (&[&OUTPUT.replace("channel=2", "channel=16")], "Invalid pca9685 channel or value"),
        (&[&OUTPUT.replace("default_value=0", "default_value=4097")], "Invalid pca9685 channel or value"),
        (&["set_pca9685_out bus=1 addr=64 channel=0 cycle_ticks=1 value=4097"], "Invalid pca9685 channel or value"),
        // There is no bus with this number.
        (&[&OUTPUT.replace("bus=1", "bus=2")], "Unable to open and init PCA9685 device"),
        // There is no chip at this address.
        (&[&OUTPUT.replace("addr=64", "addr=65")], "Unable to open and init PCA9685 device"),
    ] {
        let mut rig = Rig::new();
        plug(&rig);
        rig.send("allocate_oids count=2");
        rig.send_all(commands);
        assert_eq!(rig.shutdown().as_deref(), Some(text), "{commands:?}");
        // The chip works in the next configuration.
        rig.run_until(1_000_000);
        rig.send("config_reset");
        rig.forget_responses();
        rig.configure(&[OUTPUT]);
    }
    let mut rig = Rig::new();
    for address in 0..17 {
        rig.bench.plug_i2c(0, address, |_, _, _| Ok(()));
        rig.send(&format!("set_pca9685_out bus=0 addr={address} channel=15 cycle_ticks=1 value=1"));
    }
    assert_eq!(rig.shutdown().as_deref(), Some("Too many i2c devices"));
}

#[test]
fn a_chip_that_goes_silent_stops_the_mcu_and_is_tried_until_it_answers() {
    let (mut rig, _) = rig(1000, &[OUTPUT, FREE]);
    rig.bench.plug_i2c(1, ADDRESS, |_, _, _| Err(BusStatus::Nack));
    let now = rig.now();
    rig.send(&format!("queue_pca9685_out oid=1 clock=@{} value=1", now + 1000));
    rig.stops_by(now + 20_000_000, "Unable to update PCA9685 value");
    assert_eq!(rig.mcu.pending_value(), Some("PCA9685"));
    let chip = plug(&rig);
    rig.run_until(now + 40_000_000);
    assert!(!rig.mcu.has_pending_values());
    assert_eq!(bytes(&chip), [[14, 0, 0, 0, 0x10], [66, 0, 0x10, 0, 0]]);
    rig.send("config_reset");
    rig.forget_responses();
    rig.configure(&[OUTPUT]);
}

#[test]
fn a_value_that_is_not_acknowledged_is_written_again() {
    let (mut rig, chip) = rig(0, &[FREE]);
    bytes(&chip);
    let (log, mut nacks) = (chip.clone(), 2);
    rig.bench.plug_i2c(1, ADDRESS, move |at, write, _| {
        log.lock().unwrap().push((at, write.to_vec()));
        nacks -= 1;
        if nacks >= 0 { Err(BusStatus::Nack) } else { Ok(()) }
    });
    rig.send("queue_pca9685_out oid=1 clock=@26000 value=1");
    rig.run_until(27_000);
    assert_eq!(rig.shutdown(), None);
    assert_eq!(bytes(&chip), [[66, 0, 0, 1, 0]; 3]);
}

#[test]
fn a_chip_that_was_never_set_up_gets_nothing_from_a_stop() {
    let mut rig = Rig::new();
    rig.bench.plug_i2c(1, ADDRESS, |_, _, _| Err(BusStatus::Nack));
    rig.send_all(&["allocate_oids count=1", OUTPUT, "finalize_config crc=1"]);
    rig.run_until(1_000_000);
    assert!(rig.shutdown().is_some());
    let chip = plug(&rig);
    rig.run_until(10_000_000);
    assert_eq!(bytes(&chip), [[0; 0]; 0]);
}

#[test]
fn a_chip_that_stays_silent_does_not_keep_the_mcu_from_the_next_configuration() {
    let says_nothing = |_: u64, _: &[u8], _: &mut [u8]| Err(BusStatus::Nack);
    let (mut rig, _) = rig(1000, &[OUTPUT, FREE]);
    rig.bench.plug_i2c(1, ADDRESS, says_nothing);
    let now = rig.now();
    rig.send(&format!("queue_pca9685_out oid=1 clock=@{} value=1", now + 1000));
    rig.send(&format!("queue_pca9685_out oid=1 clock=@{} value=2", now + 9000));
    // The guardian takes over after a second without a heartbeat. There is no heartbeat while this value is pending.
    rig.run_until(now + 24_000_000);
    assert_eq!(rig.mcu.pending_value(), Some("PCA9685"));
    rig.run_until(now + 30_000_000);
    assert_eq!(rig.mcu.pending_value(), None);
    let notes = rig.notes();
    let given_up = notes.iter().filter(|note| note.contains("PCA9685 has not accepted its shutdown values for 500 ms"));
    assert_eq!(given_up.count(), 1, "{notes:?}");

    // It is still retried, and reported when it works.
    let chip = plug(&rig);
    rig.run_until(now + 40_000_000);
    assert_eq!(bytes(&chip), [[14, 0, 0, 0, 0x10], [66, 0, 0x10, 0, 0]]);
    assert_eq!(rig.notes(), ["safe: PCA9685"]);

    // The chip is silent again. The MCU can be configured, but not this chip.
    rig.bench.plug_i2c(1, ADDRESS, says_nothing);
    rig.send("config_reset");
    rig.forget_responses();
    rig.refuses(&[OUTPUT], "Unable to open and init PCA9685 device");
    let now = rig.now();
    rig.run_until(now + 30_000_000);
    rig.send("config_reset");
    rig.forget_responses();
    rig.configure(&[]);
}

#[test]
fn a_config_reset_waits_for_a_silent_chip_and_no_longer_than_that() {
    // Each write takes a second: the bus's driver waits until it gives up.
    let (mut rig, _) = rig(1000, &[OUTPUT, FREE]);
    rig.bench.state().answer_ticks = 50_000_000;
    let now = rig.now();
    rig.send("emergency_stop");
    rig.begin("config_reset");
    rig.run_until(now + 24_000_000);
    assert!(rig.mcu.is_held());
    rig.run_until(now + 30_000_000);
    assert!(!rig.mcu.is_held());
    rig.forget_responses();
    rig.bench.state().answer_ticks = 0;
    rig.configure(&[FREE]);
}
