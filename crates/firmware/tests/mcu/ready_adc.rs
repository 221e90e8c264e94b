// SPDX-License-Identifier: GPL-3.0-or-later
//! Load cells on SPI: ADS1220 and ADS131M0x, which pull a line low when a sample is ready.

use std::sync::{Arc, Mutex};

use pinion_testbench::board::{Bench, SPI_CHIPS};
use pinion_testbench::rig::Rig;

const READY: u32 = 10;
const PERIOD: u64 = 100_000;

/// A chip that has a sample every [`PERIOD`]. Each sample can be read once.
#[derive(Default)]
struct Adc {
    read: u64,
    /// The frame of a sample, by its number.
    frame: Option<fn(u64) -> Vec<u8>>,
    /// The bytes that it received.
    heard: Vec<Vec<u8>>,
}

fn plug(bench: &Bench, frame: fn(u64) -> Vec<u8>) -> Arc<Mutex<Adc>> {
    let adc = Arc::new(Mutex::new(Adc { frame: Some(frame), ..Adc::default() }));
    let (on_spi, on_line) = (adc.clone(), adc.clone());
    bench.plug_spi(0, move |at, bytes| {
        let mut adc = on_spi.lock().unwrap();
        adc.heard.push(bytes.to_vec());
        adc.read = at / PERIOD;
        let frame = adc.frame.unwrap()(adc.read);
        assert_eq!(frame.len(), bytes.len());
        bytes.copy_from_slice(&frame);
    });
    bench.plug_line(READY, move |at, _| on_line.lock().unwrap().read == at / PERIOD);
    adc
}

const ADS1220: &str = "config_ads1220 oid=1 spi_oid=0 data_ready_pin=10";
const ADS131M02: &str = "config_ads131m0x oid=1 spi_oid=0 channel=1 num_channels=2 data_ready_pin=10";

/// The n-th sample is 1000 * n, below zero.
fn ads1220(n: u64) -> Vec<u8> {
    (-1000 * n as i32).to_be_bytes()[1..].to_vec()
}

fn crc(words: &[u8]) -> u16 {
    let mut crc = 0xffff;
    for bit in words.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 != 0)) {
        let carry = (crc & 0x8000 != 0) != bit;
        crc = crc << 1 ^ if carry { 0x1021 } else { 0 };
    }
    crc
}

/// The same sample in channel 1. Channel 0 has something else.
fn ads131m02(n: u64) -> Vec<u8> {
    let mut frame = vec![0x05 & !4, 0x03, 0, 0x12, 0x34, 0x56];
    frame.extend(ads1220(n));
    let crc = crc(&frame);
    frame.extend(crc.to_be_bytes());
    frame.push(0);
    frame
}

/// The chip is reset after five samples.
fn reset_after_five(n: u64) -> Vec<u8> {
    let mut frame = ads131m02(n);
    if n == 6 {
        frame[0] |= 4;
    }
    let crc = crc(&frame[..9]).to_be_bytes();
    frame[9..11].copy_from_slice(&crc);
    frame
}

/// The sixth sample is damaged on its way.
fn damaged(n: u64) -> Vec<u8> {
    let mut frame = ads131m02(n);
    if n == 6 {
        frame[8] ^= 1;
    }
    frame
}

fn rig(sensor: &str, frame: fn(u64) -> Vec<u8>, answer_ticks: u32) -> (Rig, Arc<Mutex<Adc>>) {
    let mut rig = Rig::new();
    let adc = plug(&rig.bench, frame);
    rig.bench.state().answer_ticks = answer_ticks;
    rig.configure(&[
        "config_spi_without_cs oid=0",
        sensor,
        "spi_set_bus oid=0 spi_bus=0 mode=1 rate=512000",
        "config_sos_filter oid=2 max_sections=0",
        "config_trigger_analog oid=3 sos_filter_oid=2",
        "config_trsync oid=4",
    ]);
    (rig, adc)
}

/// The query of a sensor, which is read every tenth of [`PERIOD`].
fn query(sensor: &str) -> String {
    format!("query_{} oid=1 rest_ticks=10000", name(sensor))
}

fn name(sensor: &str) -> &str {
    if sensor == ADS1220 { "ads1220" } else { "ads131m0x" }
}

fn samples(rig: &Rig) -> Vec<i32> {
    let mut samples = Vec::new();
    for (message, sequence) in rig.responses().iter().filter(|it| it.starts_with("sensor_bulk_data")).zip(0..) {
        let data = message.strip_prefix(&format!("sensor_bulk_data oid=1 sequence={sequence} data=")).unwrap();
        assert_eq!(data.len(), 2 * 48, "twelve samples");
        for at in (0..data.len()).step_by(8) {
            samples.push(u32::from_str_radix(&data[at..at + 8], 16).unwrap().swap_bytes() as i32);
        }
    }
    samples
}

#[test]
fn every_sample_arrives_once() {
    for (sensor, frame) in [(ADS1220, ads1220 as fn(u64) -> Vec<u8>), (ADS131M02, ads131m02)] {
        let (mut rig, adc) = rig(sensor, frame, 2000);
        rig.send(&query(sensor));
        rig.run_until(25 * PERIOD);
        let expected: Vec<i32> = (1..=24).map(|n| -1000 * n).collect();
        assert_eq!(samples(&rig), expected, "{sensor}");
        let heard = adc.lock().unwrap().heard.clone();
        assert!(heard.iter().flatten().all(|byte| *byte == 0), "a command would change the chip");
    }
}

#[test]
fn a_status_counts_every_sample_once() {
    for (sensor, frame) in [(ADS1220, ads1220 as fn(u64) -> Vec<u8>), (ADS131M02, ads131m02)] {
        let (mut rig, _adc) = rig(sensor, frame, 2000);
        rig.send(&query(sensor));
        let status = format!("query_{}_status oid=1", name(sensor));
        // At any time, the status counts as many samples as the chip has made.
        for at in (5000..11 * PERIOD).step_by(777) {
            rig.run_until(at);
            let expected = format!("next_sequence=0 buffered={} possible_overflows=0", 4 * (at / PERIOD));
            let answer = rig.ask(&status);
            assert!(
                answer.contains(&format!("clock=@{at} query_ticks=0")) && answer.ends_with(&expected),
                "{at}: {answer}"
            );
        }
    }
}

#[test]
fn a_bus_that_is_too_slow_is_counted() {
    for (sensor, frame) in [(ADS1220, ads1220 as fn(u64) -> Vec<u8>), (ADS131M02, ads131m02)] {
        let (mut rig, _adc) = rig(sensor, frame, 150_000);
        rig.send(&query(sensor));
        rig.run_until(26 * PERIOD);
        let values = samples(&rig);
        assert_eq!(values.len(), 12, "every other sample");
        let status = rig.ask(&format!("query_{}_status oid=1", name(sensor)));
        let overflows = status.split_once("possible_overflows=").unwrap().1;
        assert!(overflows.parse::<u32>().unwrap() >= 12, "{status}");
    }
}

#[test]
fn a_probe_triggers_when_its_sample_was_read() {
    for (sensor, frame) in [(ADS1220, ads1220 as fn(u64) -> Vec<u8>), (ADS131M02, ads131m02)] {
        let (mut rig, _adc) = rig(sensor, frame, 2000);
        rig.send_all(&[
            &format!("{}_attach_trigger_analog oid=1 trigger_analog_oid=3", name(sensor)),
            "sos_filter_set_offset_scale oid=2 offset=0 scale=1 scale_frac_bits=0 auto_offset=0",
            "trigger_analog_set_raw_range oid=3 raw_min=-8388608 raw_max=8388607",
            "trigger_analog_set_trigger oid=3 trigger_analog_type=0 trigger_value=5000",
            &query(sensor),
            "trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=2",
            "trigger_analog_home oid=3 trsync_oid=4 trigger_reason=1 error_reason=40 clock=@50000 monitor_ticks=100000 monitor_max=3",
        ]);
        rig.sends_until(5 * PERIOD + 1999, &[]);
        rig.sends_until(5 * PERIOD + 2000, &["trsync_state oid=4 can_trigger=0 trigger_reason=1 clock=@502000"]);
        assert_eq!(
            rig.ask("trigger_analog_query_state oid=3"),
            "trigger_analog_state oid=3 homing=0 homing_clock=@502000"
        );
    }
}

#[test]
fn a_frame_that_is_damaged_and_a_chip_that_was_reset_are_errors_that_end_homing() {
    let rig = Rig::new();
    assert_eq!(
        rig.dictionary().enumerations["ads131m0x_error:"].to_string(),
        r#"{"SENSOR_ERROR_CRC":1,"SENSOR_ERROR_RESET":2}"#
    );
    for (frame, code, lasts) in [(damaged as fn(u64) -> Vec<u8>, 1, false), (reset_after_five, 2, true)] {
        let (mut rig, _adc) = self::rig(ADS131M02, frame, 0);
        rig.send_all(&[
            "ads131m0x_attach_trigger_analog oid=1 trigger_analog_oid=3",
            "sos_filter_set_offset_scale oid=2 offset=0 scale=1 scale_frac_bits=0 auto_offset=0",
            "trigger_analog_set_raw_range oid=3 raw_min=-8388608 raw_max=8388607",
            "trigger_analog_set_trigger oid=3 trigger_analog_type=1 trigger_value=5000",
            &query(ADS131M02),
            "trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=2",
            "trigger_analog_home oid=3 trsync_oid=4 trigger_reason=1 error_reason=40 clock=@50000 monitor_ticks=100000 monitor_max=3",
        ]);
        rig.run_until(6 * PERIOD);
        // The numbers of the sensor's errors follow those of trigger_analog_error.
        let report = format!("trsync_state oid=4 can_trigger=0 trigger_reason={} clock=@600000", 40 + 3 + code);
        assert_eq!(rig.responses(), [report]);
        rig.run_until(12 * PERIOD);
        let values = samples(&rig);
        assert_eq!(values[..5], [-1000, -2000, -3000, -4000, -5000]);
        assert_eq!(values[5], code << 24);
        assert_eq!(values[6], if lasts { code << 24 } else { -7000 });
        // klippy sets up the chip and queries it again.
        rig.send(&query(ADS131M02));
        rig.run_until(24 * PERIOD);
        assert_eq!(samples(&rig), (13..=24).map(|n| -1000 * n).collect::<Vec<i32>>());
    }
}

#[test]
fn a_bus_that_fails_stops_the_mcu_and_it_can_be_configured_anew() {
    for (sensor, frame) in [(ADS1220, ads1220 as fn(u64) -> Vec<u8>), (ADS131M02, ads131m02)] {
        let (mut rig, _adc) = rig(sensor, frame, 2000);
        rig.send(&query(sensor));
        rig.run_until(3 * PERIOD);
        rig.bench.state().broken.insert(SPI_CHIPS);
        rig.stops_by(5 * PERIOD, "Unable to issue spi ioctl");
        let note = rig.notes().pop().unwrap();
        assert!(note.contains("oid 1 (gpio10)") && note.contains("plug it in again"), "{note}");
        rig.bench.state().broken.clear();
        rig.send("config_reset");
        rig.configure(&["config_spi_without_cs oid=0", sensor, "spi_set_bus oid=0 spi_bus=0 mode=1 rate=512000"]);
        rig.send(&query(sensor));
        rig.run_until(20 * PERIOD);
        assert_eq!(samples(&rig).len(), 12);
    }
}

#[test]
fn measurements_that_begin_anew_amid_a_reading_have_none_of_it() {
    let (mut rig, _adc) = rig(ADS1220, ads1220, 50_000);
    rig.send(&query(ADS1220));
    rig.run_until(PERIOD + 20_000);
    rig.send(&query(ADS1220));
    rig.run_until(PERIOD + 60_000);
    assert!(rig.ask("query_ads1220_status oid=1").contains("buffered=0"));
    rig.run_until(16 * PERIOD);
    assert_eq!(samples(&rig)[0], -2000);
    // After the end of the query nothing more comes.
    rig.run_until(17 * PERIOD + 20_000);
    rig.send("query_ads1220 oid=1 rest_ticks=0");
    rig.run_until(60 * PERIOD);
    assert_eq!(samples(&rig), [0; 0]);
}

#[test]
fn a_reading_that_a_stop_overtakes_sends_nothing() {
    let (mut rig, _adc) = rig(ADS1220, ads1220, 2000);
    rig.send(&query(ADS1220));
    // The twelfth sample would fill a message.
    rig.run_until(12 * PERIOD + 1000);
    rig.send("emergency_stop");
    rig.run_until(14 * PERIOD);
    assert_eq!(samples(&rig), [0; 0]);
}

#[test]
fn channels_that_no_chip_has_are_refused() {
    for (channel, num_channels) in [(0, 0), (0, 1), (2, 2), (0, 5), (4, 4), (255, 4)] {
        Rig::new().refuses(
            &[
                "config_spi_without_cs oid=0",
                &format!(
                    "config_ads131m0x oid=1 spi_oid=0 channel={channel} num_channels={num_channels} data_ready_pin=10"
                ),
            ],
            "Invalid ads131m0x channels configuration",
        );
    }
}

#[test]
fn a_sensor_needs_an_spi_device_and_a_line_that_can_be_looked_at() {
    Rig::new().refuses(&["config_trsync oid=0", ADS1220], "Invalid oid type");
    let mut rig = Rig::new();
    rig.bench.state().sleeping.insert(READY);
    rig.refuses(&["config_spi_without_cs oid=0", ADS131M02], "Unable to open in GPIO chip line");
}

#[test]
fn a_sample_that_is_being_read_counts_though_the_chip_has_none_any_more() {
    let (mut rig, _adc) = rig(ADS1220, ads1220, 2000);
    // The line goes high as the reading begins.
    rig.bench.plug_line(READY, |at, _| at != PERIOD);
    rig.send(&query(ADS1220));
    for at in [PERIOD, PERIOD + 1, PERIOD + 1999, PERIOD + 2000] {
        rig.run_until(at);
        assert!(rig.ask("query_ads1220_status oid=1").contains("next_sequence=0 buffered=4 "), "{at}");
    }
}
