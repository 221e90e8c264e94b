// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices whose failures a user tolerates for a time: an I2C chip, a DS18B20.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use pinion_firmware::board::BusStatus;
use pinion_firmware::mcu::{DialectName, Tolerances};
use pinion_testbench::rig::{Rig, hex};

const MS: u64 = 50_000;
const DEVICE: &[&str] = &["config_i2c oid=0", "i2c_set_bus oid=0 i2c_bus=1 rate=400000 address=72"];

fn tolerances(devices: &[(&str, &str)]) -> Tolerances {
    devices.iter().map(|(device, limit)| (device.parse().unwrap(), limit.parse().unwrap())).collect()
}

/// An MCU whose host gets no status, and a chip that fails while the flag is set. Its data are a count of its reads.
fn with_chip(devices: &[(&str, &str)]) -> (Rig, Arc<AtomicBool>) {
    let mut rig = Rig::of(DialectName::V0_13);
    rig.mcu.tolerate(tolerances(devices));
    rig.configure(DEVICE);
    let fails = Arc::new(AtomicBool::new(false));
    let (flag, mut count) = (fails.clone(), 0);
    rig.bench.plug_i2c(1, 0x48, move |_, _, read| {
        if flag.load(Ordering::Relaxed) {
            return Err(BusStatus::StartNack);
        }
        count += u8::from(!read.is_empty());
        read.fill(count);
        Ok(())
    });
    (rig, fails)
}

fn read(rig: &mut Rig) -> String {
    rig.ask("i2c_read oid=0 reg=10 read_len=2")
}

#[test]
fn a_chip_that_fails_repeats_its_last_answer_until_the_time_is_over() {
    let (mut rig, fails) = with_chip(&[("i2c.1/0x48", "2s")]);
    assert_eq!(read(&mut rig), "i2c_read_response oid=0 response=0101");
    assert_eq!(rig.ask("i2c_read oid=0 reg=20 read_len=1"), "i2c_read_response oid=0 response=02");
    fails.store(true, Ordering::Relaxed);
    for ms in [100, 1000, 2000] {
        rig.run_until(ms * MS);
        assert_eq!(read(&mut rig), "i2c_read_response oid=0 response=0101", "{ms}");
        // Each question has its own answer, and a write has none.
        assert_eq!(rig.ask("i2c_read oid=0 reg=20 read_len=1"), "i2c_read_response oid=0 response=02");
        rig.send("i2c_write oid=0 data=3040");
    }
    let warnings = || rig.notes().into_iter().filter(|note| note.starts_with("warning: ")).collect::<Vec<_>>();
    let [begins] = &warnings()[..] else { panic!("{:?}", rig.notes()) };
    assert!(begins.contains("its last answers are repeated for up to 2 s (tolerate)"), "{begins}");
    assert_eq!(rig.shutdown(), None);
    rig.run_until(2200 * MS);
    rig.stops_on("i2c_read oid=0 reg=10 read_len=2", "I2C START NACK");
}

#[test]
fn a_chip_that_answers_again_has_its_whole_time_for_the_next_failure() {
    let (mut rig, fails) = with_chip(&[("i2c.1/72", "2s")]);
    read(&mut rig);
    for begin in [0, 3000] {
        fails.store(true, Ordering::Relaxed);
        for ms in [begin + 100, begin + 1900] {
            rig.run_until(ms * MS);
            assert!(read(&mut rig).contains("response="));
        }
        fails.store(false, Ordering::Relaxed);
        rig.run_until((begin + 2500) * MS);
        read(&mut rig);
        assert!(rig.notes().last().unwrap().contains("it answers again, after 2400 ms"), "{:?}", rig.notes());
    }
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn a_question_without_an_answer_and_a_device_that_is_not_read_stop_the_mcu() {
    let (mut rig, fails) = with_chip(&[("i2c.1/0x48", "30s")]);
    rig.send("i2c_write oid=0 data=3040");
    fails.store(true, Ordering::Relaxed);
    rig.stops_on("i2c_write oid=0 data=3040", "I2C START NACK");
    assert!(rig.notes().last().unwrap().contains("tolerate is only for a device that is read"), "{:?}", rig.notes());
    let (mut rig, fails) = with_chip(&[("i2c.1/0x48", "30s")]);
    read(&mut rig);
    fails.store(true, Ordering::Relaxed);
    rig.stops_on("i2c_read oid=0 reg=11 read_len=2", "I2C START NACK");
}

#[test]
fn nobody_else_s_failure_is_tolerated() {
    for others in [&[][..], &[("i2c.1/0x49", "30s")], &[("i2c.0/0x48", "30s")], &[("28-0000", "30s")]] {
        let (mut rig, fails) = with_chip(others);
        read(&mut rig);
        fails.store(true, Ordering::Relaxed);
        rig.stops_on("i2c_read oid=0 reg=10 read_len=2", "I2C START NACK");
    }
}

#[test]
fn an_output_is_refused() {
    let mut rig = Rig::new();
    rig.mcu.tolerate(tolerances(&[("i2c.1/0x40", "30s")]));
    rig.refuses(
        &["config_pca9685 oid=0 bus=1 addr=64 channel=0 cycle_ticks=500000 value=0 default_value=0 max_duration=0"],
        "Unable to open and init PCA9685 device",
    );
    assert!(rig.notes().last().unwrap().contains("remove it from tolerate"), "{:?}", rig.notes());
}

#[test]
fn a_ds18b20_repeats_its_last_temperature() {
    const SERIAL: &str = "28-00000000100f";
    for (limit, ends) in [("30s", false), ("2s", true)] {
        let mut rig = Rig::new();
        rig.bench.script_ds18b20(SERIAL, &[Some(20_000), None, None, Some(21_000)]);
        rig.bench.state().answer_ticks = 750 * MS as u32;
        rig.mcu.tolerate(tolerances(&[(SERIAL, limit)]));
        rig.configure(&[&format!("config_ds18b20 oid=0 serial={} max_error_count=0", hex(SERIAL.as_bytes()))]);
        rig.send(&format!(
            "query_ds18b20 oid=0 clock=@{} rest_ticks={} min_value=0 max_value=100000",
            100 * MS,
            3000 * MS
        ));
        rig.run_until(11_000 * MS);
        if ends {
            assert_eq!(rig.shutdown().as_deref(), Some("Error reading DS18B20 sensor"));
        } else {
            let reading = |(value, n): (i32, u64)| {
                format!("ds18b20_result oid=0 next_clock=@{} value={value} fault=0", (100 + 3000 * n) * MS)
            };
            let expected = [(20_000, 1), (20_000, 2), (20_000, 3), (21_000, 4)].map(reading);
            assert_eq!(rig.responses(), expected);
        }
    }
}
