// SPDX-License-Identifier: GPL-3.0-or-later
//! I2C devices: transfers to a chip, the report of a missing answer, and the commands that wait for the answer.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::BusStatus;
use pinion_firmware::time::Ticks;

use pinion_testbench::rig::Rig;

const DEVICE: &[&str] = &["config_i2c oid=0", "i2c_set_bus oid=0 i2c_bus=1 rate=400000 address=72"];

/// The transfers to a chip: the written bytes, and the number of bytes read after them.
type Heard = Arc<Mutex<Vec<(Vec<u8>, usize)>>>;

/// A chip at 0x48 of bus 1. Its data counts up from the first written byte. Its first transfers fail with these
/// statuses, all later ones succeed.
fn plug(rig: &Rig, statuses: &[BusStatus]) -> Heard {
    let heard = Heard::default();
    let log = heard.clone();
    let mut left: Vec<BusStatus> = statuses.iter().rev().copied().collect();
    rig.bench.plug_i2c(1, 0x48, move |_, write, read| {
        log.lock().unwrap().push((write.to_vec(), read.len()));
        let first = write.first().copied().unwrap_or(0xa0);
        read.iter_mut().zip(0..).for_each(|(byte, n)| *byte = first.wrapping_add(n));
        left.pop().map_or(Ok(()), Err)
    });
    heard
}

fn heard(heard: &Heard) -> Vec<(Vec<u8>, usize)> {
    std::mem::take(&mut heard.lock().unwrap())
}

#[test]
fn a_register_is_written_and_read_as_one_message() {
    let mut rig = Rig::configured(DEVICE);
    let chip = plug(&rig, &[]);
    for (command, response) in [
        ("write=1020 read_len=0", ""),
        ("write=10 read_len=3", "101112"),
        ("write=1122 read_len=1", "11"),
        ("write= read_len=2", "a0a1"),
        ("write= read_len=0", ""),
    ] {
        let answer = rig.ask(&format!("i2c_transfer oid=0 {command}"));
        assert_eq!(answer, format!("i2c_response oid=0 i2c_bus_status=0 response={response}"), "{command}");
    }
    let expected = [(vec![0x10, 0x20], 0), (vec![0x10], 3), (vec![0x11, 0x22], 1), (vec![], 2), (vec![], 0)];
    assert_eq!(heard(&chip), expected);
}

#[test]
fn each_failure_has_its_status_and_the_mcu_goes_on() {
    for (status, number) in
        [(BusStatus::Nack, 1), (BusStatus::Timeout, 2), (BusStatus::StartNack, 3), (BusStatus::StartReadNack, 4)]
    {
        let mut rig = Rig::configured(DEVICE);
        let chip = plug(&rig, &[status]);
        let answer = rig.ask("i2c_transfer oid=0 write=10 read_len=0");
        assert_eq!(answer, format!("i2c_response oid=0 i2c_bus_status={number} response="));
        assert_eq!(heard(&chip).len(), 1, "what writes is not written twice");
        let answer = rig.ask("i2c_transfer oid=0 write=10 read_len=1");
        assert_eq!(answer, "i2c_response oid=0 i2c_bus_status=0 response=10");
        assert_eq!(rig.shutdown(), None);
    }
    let rig = Rig::new();
    let names = &rig.dictionary().enumerations["i2c_bus_status"];
    let expected = serde_json::json!({
        "SUCCESS": 0, "NACK": 1, "BUS_TIMEOUT": 2, "START_NACK": 3, "START_READ_NACK": 4
    });
    assert_eq!(*names, expected);
    assert_eq!(rig.dictionary().enumerations["i2c_bus"], serde_json::json!({"i2c.0": [0, 2]}));
}

#[test]
fn only_a_plain_read_is_tried_again_and_not_for_ever() {
    use BusStatus::{Nack, StartReadNack, Timeout};
    for (command, statuses, tries, status) in [
        ("write= read_len=2", &[Nack, StartReadNack][..], 3, 0),
        ("write= read_len=2", &[Nack, Nack, Nack], 3, 1),
        // Noise that takes a bus from its master ends at once.
        ("write= read_len=2", &[Timeout], 2, 0),
        // The MCU does not retry, because a command would run twice. klippy decides.
        ("write=10 read_len=2", &[Nack], 1, 1),
        ("write= read_len=0", &[Nack], 1, 1),
    ] {
        let mut rig = Rig::configured(DEVICE);
        let chip = plug(&rig, statuses);
        let answer = rig.ask(&format!("i2c_transfer oid=0 {command}"));
        assert!(answer.starts_with(&format!("i2c_response oid=0 i2c_bus_status={status} ")), "{command}: {answer}");
        assert_eq!(heard(&chip).len(), tries, "{command} {statuses:?}");
    }
}

#[test]
fn a_read_that_took_its_time_to_fail_is_not_tried_again() {
    let mut rig = Rig::configured(DEVICE);
    let (bench, tries) = (rig.bench.clone(), Arc::new(Mutex::new(0)));
    let count = tries.clone();
    rig.bench.plug_i2c(1, 0x48, move |_, _, _| {
        *count.lock().unwrap() += 1;
        // 25 ms.
        bench.pass(Ticks(1_250_000));
        Err(BusStatus::Timeout)
    });
    assert_eq!(rig.ask("i2c_transfer oid=0 write= read_len=2"), "i2c_response oid=0 i2c_bus_status=2 response=0000");
    assert_eq!(*tries.lock().unwrap(), 1);
}

#[test]
fn a_chip_that_is_unplugged_is_reported_once_and_is_there_when_it_is_back() {
    let mut rig = Rig::configured(DEVICE);
    rig.notes();
    for _ in 0..5 {
        let answer = rig.ask("i2c_transfer oid=0 write=10 read_len=2");
        assert_eq!(answer, "i2c_response oid=0 i2c_bus_status=3 response=0000");
    }
    assert_eq!(rig.notes(), ["warning: I2C START NACK: I2C device oid 0: nothing answers at 0x48: check the wiring"]);
    plug(&rig, &[]);
    assert_eq!(rig.ask("i2c_transfer oid=0 write=10 read_len=2"), "i2c_response oid=0 i2c_bus_status=0 response=1011");
    rig.bench.unplug_i2c(1, 0x48);
    rig.send("i2c_transfer oid=0 write=10 read_len=2");
    assert_eq!(rig.notes().len(), 1);
}

#[test]
fn the_next_command_waits_for_a_slow_chip_and_steps_do_not() {
    let mut rig = Rig::with_workers(
        5_000_000,
        &[
            DEVICE,
            &[
                "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0",
                "config_digital_out oid=2 pin=20 value=0 default_value=0 max_duration=0",
            ],
        ]
        .concat(),
    );
    plug(&rig, &[]);
    rig.send_all(&["reset_step_clock oid=1 clock=@0", "queue_step oid=1 interval=1000 count=6000 add=0"]);
    // This takes 100 ms.
    rig.begin("i2c_transfer oid=0 write=10 read_len=1");
    assert!(rig.mcu.is_held());
    rig.run_until(4_999_000);
    assert!(rig.mcu.is_held() && rig.responses().is_empty());
    rig.run_until(5_000_000);
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.responses(), ["i2c_response oid=0 i2c_bus_status=0 response=10"]);
    assert!(rig.edges(1).iter().zip(1..).all(|((at, _), n)| *at == 1000 * n));
}

#[test]
fn an_answer_holds_what_a_message_has_room_for() {
    let mut rig = Rig::configured(DEVICE);
    let chip = plug(&rig, &[]);
    for (read_len, read, answered) in [(53, 53, 53), (54, 54, 53), (255, 255, 53), (256, 0, 0), (300, 44, 44)] {
        let answer = rig.ask(&format!("i2c_transfer oid=0 write=10 read_len={read_len}"));
        let (_, response) = answer.split_once("response=").unwrap();
        assert_eq!((heard(&chip)[0].1, response.len() / 2), (read, answered), "{read_len}");
    }
}

#[test]
fn an_address_has_seven_bits_and_a_device_without_a_bus_acknowledges_nothing() {
    let mut rig = Rig::configured(&[
        "config_i2c oid=0",
        "i2c_set_bus oid=0 i2c_bus=1 rate=400000 address=200",
        "config_i2c oid=1",
    ]);
    plug(&rig, &[]);
    assert_eq!(rig.ask("i2c_transfer oid=0 write=10 read_len=1"), "i2c_response oid=0 i2c_bus_status=0 response=10");
    assert_eq!(rig.ask("i2c_transfer oid=1 write=10 read_len=1"), "i2c_response oid=1 i2c_bus_status=1 response=00");
}

#[test]
fn a_bus_is_set_in_the_configuration_and_has_to_be_there() {
    Rig::new()
        .refuses(&["config_i2c oid=0", "i2c_set_bus oid=0 i2c_bus=2 rate=1 address=1"], "Unable to open i2c device");
    let mut rig = Rig::configured(&["config_i2c oid=0"]);
    rig.stops_on("i2c_set_bus oid=0 i2c_bus=0 rate=1 address=1", "Can't assign oid");
}

#[test]
fn a_stopped_mcu_ends_what_is_under_way_and_starts_anew() {
    let mut rig = Rig::with_workers(50_000, DEVICE);
    plug(&rig, &[]);
    rig.begin("i2c_transfer oid=0 write=10 read_len=1");
    rig.send("emergency_stop");
    rig.sends_until(
        100_000,
        &["shutdown clock=@0 static_string_id=Command request", "i2c_response oid=0 i2c_bus_status=0 response=10"],
    );
    assert_eq!(rig.ask("i2c_transfer oid=0 write=10 read_len=1"), "is_shutdown static_string_id=Command request");
    rig.send("config_reset");
    rig.configure(DEVICE);
    assert_eq!(rig.ask("i2c_transfer oid=0 write=10 read_len=1"), "i2c_response oid=0 i2c_bus_status=0 response=10");
}
