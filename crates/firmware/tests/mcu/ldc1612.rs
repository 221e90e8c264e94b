// SPDX-License-Identifier: GPL-3.0-or-later
//! An eddy current probe: LDC1612 with and without its INTB line, from its data sheet.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::BusStatus;

use pinion_testbench::board::Bench;
use pinion_testbench::rig::Rig;

const INTB: u32 = 10;
const ADDRESS: u8 = 0x2a;
/// Ticks between two samples: 400 samples a second.
const PERIOD: u64 = 125_000;
const QUERY: &str = "query_ldc1612 oid=1 rest_ticks=62500";
const STATUS: &str = "query_status_ldc1612 oid=1";
const WITHOUT: &str = "config_ldc1612 oid=1 i2c_oid=0";
const WITH_INTB: &str = "config_ldc1612_with_intb oid=1 i2c_oid=0 intb_pin=10";

struct Ldc {
    /// Returns the sample with this number.
    words: fn(u64) -> u32,
    /// The last sample that was read, and the last sample that STATUS reported.
    read: u64,
    reported: u64,
    /// Registers that fail, with the number of failures left.
    nacks: Vec<(u8, u32)>,
}

fn plug(bench: &Bench, words: fn(u64) -> u32) -> Arc<Mutex<Ldc>> {
    let ldc = Arc::new(Mutex::new(Ldc { words, read: 0, reported: 0, nacks: Vec::new() }));
    let (on_i2c, on_line) = (ldc.clone(), ldc.clone());
    bench.plug_i2c(0, ADDRESS, move |at, write, read| {
        let mut ldc = on_i2c.lock().unwrap();
        let [register] = *write else { panic!("the MCU only reads: {write:02x?}") };
        if let Some((_, times)) = ldc.nacks.iter_mut().find(|(of, times)| *of == register && *times > 0) {
            *times -= 1;
            return Err(BusStatus::Nack);
        }
        let now = at / PERIOD;
        let words = (ldc.words)(now);
        let word = match register {
            0x00 => words >> 16,
            0x01 => {
                ldc.read = now;
                words & 0xffff
            }
            0x18 => {
                ldc.reported = now;
                if ldc.read < now { 1 << 3 | 1 << 6 } else { 0 }
            }
            _ => panic!("register 0x{register:02x} is klippy's"),
        };
        read.copy_from_slice(&(word as u16).to_be_bytes());
        Ok(())
    });
    bench.plug_line(INTB, move |at, _| on_line.lock().unwrap().reported == at / PERIOD);
    ldc
}

/// The n-th sample.
fn good(n: u64) -> u32 {
    0x0100_0000 + n as u32
}

fn rig(sensor: &str, words: fn(u64) -> u32, answer_ticks: u32) -> (Rig, Arc<Mutex<Ldc>>) {
    let mut rig = Rig::new();
    let ldc = plug(&rig.bench, words);
    rig.bench.state().answer_ticks = answer_ticks;
    configure(&mut rig, sensor);
    (rig, ldc)
}

fn configure(rig: &mut Rig, sensor: &str) {
    rig.configure(&[
        "config_i2c oid=0",
        sensor,
        "i2c_set_bus oid=0 i2c_bus=0 rate=400000 address=42",
        "config_sos_filter oid=2 max_sections=0",
        "config_trigger_analog oid=3 sos_filter_oid=2",
        "config_trsync oid=4",
    ]);
}

fn samples(rig: &Rig) -> Vec<u32> {
    samples_from(rig, 0)
}

/// The samples of the messages, whose sequence counts up from `first`.
fn samples_from(rig: &Rig, first: usize) -> Vec<u32> {
    let mut samples = Vec::new();
    for (message, sequence) in rig.responses().iter().filter(|it| it.starts_with("sensor_bulk_data")).zip(first..) {
        let data = message.strip_prefix(&format!("sensor_bulk_data oid=1 sequence={sequence} data=")).unwrap();
        assert_eq!(data.len(), 2 * 48, "twelve samples");
        samples.extend((0..data.len()).step_by(8).map(|at| u32::from_str_radix(&data[at..at + 8], 16).unwrap()));
    }
    samples
}

#[test]
fn every_sample_arrives_once() {
    for sensor in [WITHOUT, WITH_INTB] {
        let (mut rig, _ldc) = rig(sensor, good, 2000);
        rig.send(QUERY);
        rig.run_until(25 * PERIOD);
        assert_eq!(samples(&rig), (1..=24).map(good).collect::<Vec<_>>(), "{sensor}");
        rig.send("query_ldc1612 oid=1 rest_ticks=0");
        rig.sends_until(60 * PERIOD, &[]);
    }
}

#[test]
fn a_status_reports_the_instants_and_counts_every_sample_once() {
    for (sensor, takes) in [(WITHOUT, 2000), (WITH_INTB, 0)] {
        let (mut rig, _ldc) = rig(sensor, good, 2000);
        rig.send(QUERY);
        for at in (5000..11 * PERIOD).step_by(7777) {
            rig.run_until(at);
            let answer = rig.ask(STATUS);
            // If a reading is on its way, it ends first.
            let began = answer.split_once("clock=@").unwrap().1.split(' ').next().unwrap().parse::<u64>().unwrap();
            assert!((at..=at + takes).contains(&began), "{at}: {answer}");
            assert!(answer.contains(&format!(" query_ticks={takes} ")), "{at}: {answer}");
            let made = (began + takes) / PERIOD;
            let expected = format!("next_sequence=0 buffered={} possible_overflows=0", 4 * made);
            assert!(answer.ends_with(&expected), "{at}: {answer} and not {expected}");
        }
    }
}

#[test]
fn a_bus_that_is_too_slow_is_counted() {
    for sensor in [WITHOUT, WITH_INTB] {
        let mut rig = Rig::new();
        let _ldc = plug(&rig.bench, good);
        rig.bench.state().byte_ticks = 150_000 / 15;
        configure(&mut rig, sensor);
        rig.send(QUERY);
        rig.run_until(60 * PERIOD);
        assert!(!samples(&rig).is_empty());
        let status = rig.ask(STATUS);
        let overflows = status.split_once("possible_overflows=").unwrap().1;
        assert!(overflows.parse::<u32>().unwrap() >= 12, "{status}");
    }
}

/// Three registers take 1.7 ms, as at 100 kHz on a busy controller. A turn comes every 1.25 ms. If a turn comes during
/// a reading, it follows that reading. No sample is lost, and no overflow is reported.
#[test]
fn a_reading_that_is_longer_than_a_turn_loses_nothing() {
    for sensor in [WITHOUT, WITH_INTB] {
        let mut rig = Rig::new();
        let _ldc = plug(&rig.bench, good);
        rig.bench.state().byte_ticks = 85_000 / 15;
        configure(&mut rig, sensor);
        rig.send(QUERY);
        let mut all = Vec::new();
        for period in 1..=120 {
            rig.run_until(period * PERIOD);
            all.extend(samples_from(&rig, all.len() / 12));
        }
        assert_eq!(all, (1..=all.len() as u64).map(good).collect::<Vec<_>>(), "{sensor}");
        assert_eq!(all.len(), 9 * 12, "{sensor}");
        let status = rig.ask(STATUS);
        assert!(status.ends_with(" possible_overflows=0"), "{sensor}: {status}");
    }
}

/// Homes, and returns the reports with the trigger's reason and time.
fn home(rig: &mut Rig) -> Vec<String> {
    let home = format!(
        "trigger_analog_home oid=3 trsync_oid=4 trigger_reason=1 error_reason=40 clock=@{} monitor_ticks=125000 monitor_max=3",
        rig.now() + 1000
    );
    rig.send_all(&[
        "ldc1612_attach_trigger_analog oid=1 trigger_analog_oid=3",
        "sos_filter_set_offset_scale oid=2 offset=-16777216 scale=1 scale_frac_bits=0 auto_offset=0",
        "trigger_analog_set_raw_range oid=3 raw_min=0 raw_max=268435455",
        "trigger_analog_set_trigger oid=3 trigger_analog_type=1 trigger_value=4",
        QUERY,
        "trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=2",
        &home,
    ]);
    rig.run_until(8 * PERIOD);
    rig.responses()
}

#[test]
fn a_probe_triggers_when_its_sample_was_read() {
    for sensor in [WITHOUT, WITH_INTB] {
        let (mut rig, _ldc) = rig(sensor, good, 2000);
        assert_eq!(home(&mut rig), ["trsync_state oid=4 can_trigger=0 trigger_reason=1 clock=@627000"]);
        let state = rig.ask("trigger_analog_query_state oid=3");
        assert_eq!(state, "trigger_analog_state oid=3 homing=0 homing_clock=@627000");
    }
}

#[test]
fn errors_stand_in_a_samples_place_and_end_homing() {
    let numbers = Rig::new().dictionary().enumerations["ldc1612_error:"].to_string();
    let expected = r#"{"SENSOR_REPORTS_ERROR":0,"I2C_STATUS_ERROR":1,"I2C_DATA_ERROR":2,"INVALID_READ_DATA":3}"#;
    assert_eq!(numbers, expected);
    let flagged: fn(u64) -> u32 = |n| if n == 2 { 0x8000_0001 } else { good(n) };
    let rubbish: fn(u64) -> u32 = |n| if n == 2 { 0xffff_ffff } else { good(n) };
    // An amplitude outside its best range is reported, and homing uses the sample.
    let amplitude: fn(u64) -> u32 = |n| good(n) | 0x1000_0000;
    for (words, nack, code, sample) in [
        (flagged, None, Some(0), 0x8000_0001),
        (good, Some(0x18), Some(1), 0xffff_0001),
        (good, Some(0x00), Some(2), 0xffff_0002),
        (good, Some(0x01), Some(2), 0xffff_0002),
        (rubbish, None, Some(3), 0xffff_0003),
        (amplitude, None, None, amplitude(2)),
    ] {
        let (mut rig, ldc) = rig(WITHOUT, words, 0);
        rig.send(QUERY);
        rig.run_until(PERIOD + 1);
        // The MCU tries three times before it reports an error.
        ldc.lock().unwrap().nacks.extend(nack.map(|register| (register, 3)));
        rig.notes();
        let reports = home(&mut rig);
        if let Some(code) = code {
            let reason = format!("trigger_reason={}", 40 + 3 + code);
            assert!(reports.iter().any(|report| report.contains(&reason)), "{reason}: {reports:?}");
        }
        rig.run_until(20 * PERIOD);
        let notes = rig.notes();
        assert_eq!(notes.len(), usize::from(nack.is_some()), "{notes:?}");
        let all = samples(&rig);
        assert!(all.contains(&sample), "{sample:08x}: {all:08x?}");
        assert!(all.contains(&words(9)), "it goes on: {all:08x?}");
    }
}

#[test]
fn a_register_that_is_not_acknowledged_twice_is_no_error() {
    let (mut rig, ldc) = rig(WITH_INTB, good, 0);
    ldc.lock().unwrap().nacks = vec![(0x18, 2), (0x00, 2), (0x01, 2)];
    rig.send(QUERY);
    rig.run_until(13 * PERIOD);
    assert_eq!(samples(&rig), (1..=12).map(good).collect::<Vec<_>>());
}

#[test]
fn a_chip_that_is_unplugged_is_reported_once_and_goes_on_when_it_is_back() {
    let (mut rig, _ldc) = rig(WITHOUT, good, 0);
    rig.send(QUERY);
    rig.run_until(2 * PERIOD + 1);
    rig.notes();
    rig.bench.unplug_i2c(0, ADDRESS);
    assert_eq!(rig.ask(STATUS), "", "klippy asks again");
    rig.run_until(20 * PERIOD);
    let notes = rig.notes();
    assert!(notes.len() == 1 && notes[0].contains("check the wiring"), "{notes:?}");
    assert!(samples(&rig).contains(&0xffff_0001));
    plug(&rig.bench, good);
    rig.run_until(60 * PERIOD);
    assert_eq!(rig.shutdown(), None);
    assert!(rig.ask(STATUS).starts_with("sensor_bulk_status"));
}

#[test]
fn a_shutdown_amid_a_reading_ends_the_samples_and_it_can_be_configured_anew() {
    for sensor in [WITHOUT, WITH_INTB] {
        let (mut rig, _ldc) = rig(sensor, good, 20_000);
        rig.send(QUERY);
        rig.run_until(PERIOD + 10_000);
        rig.send("emergency_stop");
        rig.sends_until(60 * PERIOD, &["shutdown clock=@135000 static_string_id=Command request"]);
        rig.send("config_reset");
        configure(&mut rig, sensor);
        rig.send(QUERY);
        rig.run_until(80 * PERIOD);
        assert_eq!(samples(&rig).len(), 12);
    }
}

#[test]
fn measurements_that_begin_anew_amid_a_reading_have_none_of_it() {
    let (mut rig, _ldc) = rig(WITH_INTB, good, 50_000);
    rig.send(QUERY);
    rig.run_until(PERIOD + 20_000);
    rig.send(QUERY);
    rig.run_until(PERIOD + 60_000);
    assert!(rig.ask(STATUS).contains("buffered=0"));
    rig.run_until(16 * PERIOD);
    assert_eq!(samples(&rig)[0], good(2));
}

#[test]
fn a_sensor_needs_an_i2c_device_and_a_line_that_can_be_looked_at() {
    Rig::new().refuses(&["config_trsync oid=0", WITHOUT], "Invalid oid type");
    let mut rig = Rig::new();
    rig.bench.state().sleeping.insert(INTB);
    rig.refuses(&["config_i2c oid=0", WITH_INTB], "Unable to open in GPIO chip line");
}
