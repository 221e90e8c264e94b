// SPDX-License-Identifier: GPL-3.0-or-later
//! Features that only Kalico has: ignored limits, probing by load cells, and moves of high precision.

use std::sync::{Arc, Mutex};

use pinion_firmware::mcu::DialectName::{Kalico, Master, V0_13};

use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::{Rig, hex};
use proptest::prelude::*;

const MS: u64 = 50_000;

#[test]
fn a_ds18b20_may_ignore_its_limits() {
    for (ignores, ends) in [(0, true), (1, false)] {
        let mut rig = Rig::of(Kalico);
        rig.bench.script_ds18b20("28-1", &[Some(90_000), Some(91_000)]);
        let serial = hex(b"28-1");
        rig.configure(&[&format!("config_ds18b20 oid=0 serial={serial} max_error_count=4 ignore_limits={ignores}")]);
        rig.send("query_ds18b20 oid=0 clock=@1000 rest_ticks=150000000 min_value=0 max_value=80000");
        rig.run_until(1000 * MS);
        let responses = rig.responses();
        assert!(responses[0].starts_with("ds18b20_result oid=0 ") && responses[0].contains(" value=90000 "));
        assert_eq!(rig.mcu.is_shutdown(), ends);
        assert_eq!(responses.iter().any(|response| response.ends_with("=DS18B20 out of range")), ends);
    }
}

#[test]
fn a_thermocouple_without_a_count_of_invalid_values_never_stops_the_mcu() {
    for (dialect, count, ends) in [(Kalico, 0, false), (Kalico, 1, true), (Master, 0, true)] {
        let mut rig = Rig::of(dialect);
        // The chip reports a fault, and the value is out of range.
        rig.bench.plug_spi(0, |_, bytes| bytes.fill(0xff));
        rig.configure(&[
            "config_spi_without_cs oid=0",
            "config_thermocouple oid=1 spi_oid=0 thermocouple_type=0",
            "spi_set_bus oid=0 spi_bus=0 mode=0 rate=4000000",
        ]);
        let query = "query_thermocouple oid=1 clock=@1000 rest_ticks=10000 min_value=1 max_value=2 max_invalid_count=";
        rig.send(&format!("{query}{count}"));
        rig.run_until(50_000);
        assert_eq!(rig.mcu.is_shutdown(), ends, "{dialect} {count}");
        assert!(rig.responses()[0].starts_with("thermocouple_result "));
    }
}

#[test]
fn an_analog_input_without_a_count_of_invalid_readings_never_stops_the_mcu() {
    for (dialect, count, ends) in [(Kalico, 0, false), (Kalico, 2, true), (V0_13, 0, true)] {
        let mut rig = Rig::of(dialect);
        rig.configure(&["config_analog_in oid=0 pin=400"]);
        rig.bench.script_adc(ANALOG, &[4095; 20]);
        rig.send(&format!(
            "query_analog_in oid=0 clock=@5000 sample_ticks=1000 sample_count=2 rest_ticks=10000 min_value=1 \
             max_value=2 range_check_count={count}"
        ));
        rig.run_until(30_000);
        assert_eq!(rig.mcu.is_shutdown(), ends, "{dialect} {count}");
        if !ends {
            assert_eq!(rig.responses()[0], "analog_in_state oid=0 next_clock=@15000 value=8190");
        }
    }
}

// ---- load cells

const READY: u32 = 10;
/// Ticks between two samples. The line is checked ten times as often.
const PERIOD: u64 = 100_000;

/// The channels of the sample with this number. An ADS131M04 has four, an ADS1220 one.
type Values = fn(u64) -> Vec<i32>;

fn crc(words: &[u8]) -> u16 {
    words.iter().fold(0xffff, |crc, byte| {
        (0..8).rev().fold(crc, |crc, bit| {
            let carry = (crc & 0x8000 != 0) != (byte >> bit & 1 != 0);
            crc << 1 ^ if carry { 0x1021 } else { 0 }
        })
    })
}

/// Adds an ADS131M04 (`is_ads131`) or an ADS1220 with a sample every [`PERIOD`]. The returned `status` is the first
/// byte of an ADS131M04's frame.
fn plug(rig: &Rig, is_ads131: bool, values: Values) -> Arc<Mutex<u8>> {
    let status = Arc::new(Mutex::new(0));
    let (read, shown_status) = (Arc::new(Mutex::new(0)), status.clone());
    let on_spi = read.clone();
    rig.bench.plug_spi(0, move |at, bytes| {
        *on_spi.lock().unwrap() = at / PERIOD;
        let words = values(at / PERIOD).into_iter().flat_map(|value| value.to_be_bytes()[1..].to_vec());
        let frame: Vec<u8> = if is_ads131 {
            let mut frame: Vec<u8> = [*shown_status.lock().unwrap(), 0, 0].into_iter().chain(words).collect();
            let crc = crc(&frame).to_be_bytes();
            frame.extend([crc[0], crc[1], 0]);
            frame
        } else {
            words.collect()
        };
        bytes.copy_from_slice(&frame);
    });
    rig.bench.plug_line(READY, move |at, _| *read.lock().unwrap() == at / PERIOD);
    status
}

const ADS1220: &str = "config_ads1220 oid=1 spi_oid=0 data_ready_pin=10";
/// Channels 1 and 3 of the four.
const ADS131M04: &str = "config_ads131m0x oid=1 spi_oid=0 data_ready_pin=10 sensor_channel_count=4 channel_mask=10";

/// An MCU with a sensor and a probe: half a gram per count, tared at 100.
fn rig(sensor: &str, values: Values) -> (Rig, Arc<Mutex<u8>>) {
    let mut rig = Rig::of(Kalico);
    let status = plug(&rig, sensor == ADS131M04, values);
    let name = if sensor == ADS131M04 { "ads131m0x" } else { "ads1220" };
    rig.configure(&[
        "config_spi_without_cs oid=0",
        sensor,
        "spi_set_bus oid=0 spi_bus=0 mode=1 rate=512000",
        "config_sos_filter oid=2 max_sections=1",
        "config_load_cell_probe oid=3 sos_filter_oid=2",
        "config_trsync oid=4",
    ]);
    rig.send_all(&[
        "sos_filter_set_active oid=2 n_sections=0 coeff_int_bits=2",
        &format!("{name}_attach_load_cell_probe oid=1 load_cell_probe_oid=3"),
        &set_range(-10_000, 10_000, 50, 1 << 28),
        &format!("query_{name} oid=1 rest_ticks=10000"),
    ]);
    (rig, status)
}

fn set_range(min: i32, max: i32, trigger_grams: u32, grams_per_count: i32) -> String {
    format!(
        "load_cell_probe_set_range oid=3 safety_counts_min={min} safety_counts_max={max} tare_counts=100 \
         trigger_grams={trigger_grams} grams_per_count={grams_per_count}"
    )
}

/// Homes from the fifth sample on. Reason 1 is a trigger; 40 and above are errors.
fn home(rig: &mut Rig) {
    rig.send_all(&[
        "trsync_start oid=4 report_clock=@0 report_ticks=0 expire_reason=2",
        "load_cell_probe_home oid=3 trsync_oid=4 trigger_reason=1 error_reason=40 clock=@450000 rest_ticks=100000 timeout=3",
    ]);
}

/// The reason and the time of the trigger, if it came by the thirtieth sample.
fn triggered(rig: &mut Rig) -> Option<(u32, u64)> {
    rig.run_until(30 * PERIOD);
    let responses = rig.responses();
    let state = responses.iter().find(|response| response.starts_with("trsync_state oid=4 can_trigger=0 "))?;
    let field = |name: &str| state.split_once(name).unwrap().1.split(' ').next().unwrap();
    Some((field("trigger_reason=").parse().unwrap(), field(" clock=@").parse().unwrap()))
}

const STATE: &str = "load_cell_probe_query_state oid=3";

#[test]
fn a_probe_triggers_at_its_force_either_way_once_homing_has_begun() {
    // 200 counts from the tare are 100 g, more than the 50 g of the trigger. Before the fifth sample that does not
    // count.
    let cases: [(Values, Option<u64>); 4] = [
        (|n| vec![if !(5..8).contains(&n) { 200 } else { 199 }], Some(8)),
        (|n| vec![if n >= 8 { 0 } else { 1 }], Some(8)),
        (|n| vec![if n == 4 { 5000 } else { 199 }], None),
        (|_| vec![200], Some(5)),
    ];
    for (values, sample) in cases {
        let (mut rig, _) = rig(ADS1220, values);
        home(&mut rig);
        let trigger = triggered(&mut rig);
        assert_eq!(trigger.map(|(reason, at)| (reason, at / PERIOD)), sample.map(|n| (1, n)));
        let state = rig.ask(STATE);
        let is_triggered = u8::from(sample.is_some());
        assert!(
            state.starts_with(&format!("load_cell_probe_state oid=3 is_homing_trigger={is_triggered} ")),
            "{state}"
        );
        assert_eq!(sample.is_none(), state.ends_with("trigger_ticks=0"), "{state}");
    }
}

#[test]
fn what_goes_wrong_has_its_reason() {
    // Out of the safe range, which excludes its limits. Then grams that overflow.
    let (mut rig_, _) = rig(ADS1220, |n| vec![if n == 7 { 10_000 } else { 100 }]);
    home(&mut rig_);
    assert_eq!(triggered(&mut rig_).map(|(reason, at)| (reason, at / PERIOD)), Some((40, 7)));
    let (mut rig_, _) = rig(ADS1220, |n| vec![if n == 7 { 8_000_000 } else { 100 }]);
    rig_.send(&set_range(-8_388_608, 8_388_607, 50, 1 << 28));
    home(&mut rig_);
    assert_eq!(triggered(&mut rig_).map(|(reason, at)| (reason, at / PERIOD)), Some((41, 7)));
    // A sensor that becomes silent. The error comes at its fifth turn, because three turns without a sample are
    // allowed.
    let (mut rig_, _) = rig(ADS1220, |_| vec![100]);
    home(&mut rig_);
    rig_.run_until(700_000);
    rig_.bench.plug_line(READY, |_, _| true);
    let (reason, at) = triggered(&mut rig_).unwrap();
    assert_eq!(reason, 42);
    assert!((1_000_000..1_300_000).contains(&at), "{at}");
}

#[test]
fn a_homing_that_is_over_pulls_nothing_and_says_so() {
    let (mut rig, _) = rig(ADS1220, |_| vec![1000]);
    home(&mut rig);
    rig.send("load_cell_probe_home oid=3 trsync_oid=4 trigger_reason=0 error_reason=0 clock=0 rest_ticks=0 timeout=0");
    assert_eq!(triggered(&mut rig), None);
    assert_eq!(rig.ask(STATE), "load_cell_probe_state oid=3 is_homing_trigger=0 trigger_ticks=0");
}

#[test]
fn a_filter_must_be_active_and_must_not_overflow() {
    let (mut inactive, _) = rig(ADS1220, |_| vec![100]);
    inactive.send("sos_filter_set_section oid=2 section_idx=0 sos0=0 sos1=0 sos2=0 sos3=0 sos4=0");
    home(&mut inactive);
    inactive.run_until(10 * PERIOD);
    assert_eq!(inactive.shutdown().as_deref(), Some("sos_filter not property initialized"));
    // This doubles each value, with 29 fractional bits.
    let doubling = [
        "sos_filter_set_section oid=2 section_idx=0 sos0=1073741824 sos1=0 sos2=0 sos3=0 sos4=0",
        "sos_filter_set_active oid=2 n_sections=1 coeff_int_bits=2",
    ];
    // 26 g become 52 g. 24 g become 48 g, below the trigger's 50 g.
    for (counts, reason) in [(152, Some(1)), (148, None)] {
        let values: Values = if counts == 152 { |_| vec![152] } else { |_| vec![148] };
        let (mut rig, _) = rig(ADS1220, values);
        rig.send_all(&doubling);
        home(&mut rig);
        assert_eq!(triggered(&mut rig).map(|(reason, _)| reason), reason, "{counts}");
    }
    let (mut overflowing, _) = rig(ADS1220, |n| vec![if n == 6 { 100_000 } else { 100 }]);
    overflowing.send(&set_range(-8_388_608, 8_388_607, 60_000, 1 << 28));
    overflowing.send_all(&doubling);
    home(&mut overflowing);
    overflowing.run_until(10 * PERIOD);
    assert_eq!(overflowing.shutdown().as_deref(), Some("fixed_mul: overflow"));
}

#[test]
fn ranges_that_make_no_sense_are_refused() {
    for (range, text) in [
        (set_range(5, 4, 50, 1 << 28), "Safety range reversed"),
        (set_range(0, 0, 65_536, 1 << 28), "trigger_grams too large"),
        (set_range(0, 0, 65_535, -1), "grams_per_count is invalid"),
        (set_range(0, 0, 65_535, 1 << 29), "grams_per_count is invalid"),
    ] {
        let (mut rig, _) = rig(ADS1220, |_| vec![100]);
        rig.send(&range);
        assert_eq!(rig.shutdown().as_deref(), Some(text), "{range}");
        let note = rig.notes().pop().unwrap();
        assert!(note.contains("load cell probe oid 3"), "{note}");
    }
}

#[test]
fn an_ads131m04_sends_the_channels_of_its_mask_and_is_probed_by_their_sum() {
    let (mut rig, status) = rig(ADS131M04, |n| vec![7_000_000, 15 * n as i32, 7_000_000, 20 * n as i32]);
    home(&mut rig);
    // The sum of the two is 35 n. The sixth sample passes 200, which is 50 g.
    rig.run_until(6 * PERIOD + PERIOD / 2);
    let responses = rig.responses();
    let triggered = |it: &String| it.starts_with("trsync_state oid=4 can_trigger=0 trigger_reason=1 clock=@6");
    assert!(responses.iter().any(triggered), "{responses:?}");
    let data: Vec<&String> = responses.iter().filter(|it| it.starts_with("sensor_bulk_data")).collect();
    let expected: String = (1..=6).flat_map(|n: i32| [15 * n, 20 * n]).map(|value| hex(&value.to_le_bytes())).collect();
    assert_eq!(data, [&format!("sensor_bulk_data oid=1 sequence=0 data={expected}")]);
    let pending = rig.ask("query_ads131m0x_status oid=1");
    assert!(pending.contains(" next_sequence=1 buffered=0 "), "{pending}");
    // A reset of the chip is reported in each channel's place, until the measurements start again.
    *status.lock().unwrap() = 4;
    rig.run_until(7 * PERIOD + PERIOD / 2);
    *status.lock().unwrap() = 0;
    rig.run_until(12 * PERIOD + PERIOD / 2);
    assert_eq!(rig.responses().pop().unwrap().split_once("data=").unwrap().1, "00000040".repeat(12));
    rig.run_until(13 * PERIOD + 5);
    let ready = rig.ask("query_ads131m0x_status oid=1");
    assert!(ready.contains(" buffered=8 "), "two channels: {ready}");
}

#[test]
fn an_ads131m0x_with_channels_that_it_does_not_have_is_refused() {
    for (count, mask, text) in [
        (0, 1, "ads131m0x invalid sensor_channel_count"),
        (5, 1, "ads131m0x invalid sensor_channel_count"),
        (2, 0, "ads131m0x invalid channel_mask"),
        (2, 4, "ads131m0x invalid channel_mask"),
    ] {
        let chip = format!(
            "config_ads131m0x oid=1 spi_oid=0 data_ready_pin=10 sensor_channel_count={count} channel_mask={mask}"
        );
        Rig::of(Kalico).refuses(&["config_spi_without_cs oid=0", &chip], text);
    }
}

/// A move of `queue_step_hp`: interval, count, add, add2, shift.
type Move = (u32, u16, i16, i16, i8);

/// Each edge is a step, and has no shortest time.
const EDGES: &str = "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0";

fn queue(rig: &mut Rig, (interval, count, add, add2, shift): Move) {
    rig.send(&format!("queue_step_hp oid=0 interval={interval} count={count} add={add} add2={add2} shift={shift}"));
}

fn steps_of(moves: &[Move], until: u64) -> Vec<u64> {
    let mut rig = Rig::of(Kalico);
    rig.configure(&[EDGES]);
    rig.send("reset_step_clock oid=0 clock=@0");
    moves.iter().for_each(|item| queue(&mut rig, *item));
    rig.run_until(until);
    assert_eq!(rig.shutdown(), None);
    rig.edges(1).into_iter().map(|(at, _)| at).collect()
}

/// The steps of a move, in ticks after the step before it. The n-th interval is `interval + n add + n (n - 1) / 2 add2`.
/// The sum of the intervals is rounded to ticks, half a tick up.
fn exact((interval, count, add, add2, shift): Move) -> Vec<u64> {
    let (interval, add, add2) = (i128::from(interval), i128::from(add), i128::from(add2));
    let intervals = (0..i128::from(count)).map(|n| interval + n * add + n * (n - 1) / 2 * add2);
    let sums = intervals.scan(0, |sum, interval| {
        *sum += interval;
        Some(*sum)
    });
    let ticks = sums.map(|sum| if shift > 0 { (sum + (1 << (shift - 1))) >> shift } else { sum << -shift });
    ticks.map(|ticks| ticks as u64).collect()
}

/// Moves as klippy may send them (klippy/chelper/stepcompress_hp.c). They have no negative interval.
fn a_move() -> impl Strategy<Value = Move> {
    (-8i8..=16, 1u16..200, 20u32..100_000, -1000i64..=1000, -1000i64..=1000).prop_map(
        |(shift, count, ticks, add, add2)| {
            let units = if shift > 0 { u64::from(ticks) << shift } else { u64::from(ticks) >> -shift };
            let interval = units.clamp(1, 0x3ff_ffff) as i64;
            let part = |of: i64, thousandths: i64, most: i64| (interval / of).min(most) * thousandths / 1000;
            let count_ = i64::from(count);
            let add = part(4 * count_, add, i16::MAX.into()) as i16;
            (interval as u32, count, add, part(2 * count_ * count_, add2, 0xfff) as i16, shift)
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn moves_of_high_precision_are_exact_to_the_tick(moves in prop::collection::vec(a_move(), 1..4)) {
        let mut expected = Vec::new();
        for item in &moves {
            let before = expected.last().copied().unwrap_or(0);
            expected.extend(exact(*item).into_iter().map(|ticks| before + ticks));
        }
        let end = expected.last().copied().unwrap_or(0) + 1;
        prop_assert_eq!(steps_of(&moves, end), expected);
    }
}

/// The times are those of Kalico's own code (src/stepper.c of bleeding-edge-v2), compiled for this computer. The
/// intervals overflow 32 bits, and the rest overflows 16 bits.
#[test]
fn numbers_that_overflow_do_so_as_in_the_firmware() {
    let moves = [(3_510_139_707, 5, 26_700, -7539, 24), (13_043, 7, 22_714, -8570, -9)];
    let expected = [
        209,
        418,
        627,
        836,
        1045,
        6_679_061,
        24_986_645,
        50_535_957,
        78_939_157,
        105_808_405,
        126_755_861,
        137_393_685,
    ];
    assert_eq!(steps_of(&moves, 140_000_000), expected);
    let moves = [(7176, 1, -10_357, 23_610, -22), (89_119, 5, -3808, -16_340, 9), (4_230_905_078, 2, 16_239, 6726, 17)];
    let expected = [33_554_432, 33_554_606, 33_554_773, 33_554_900, 33_554_956, 41_943_517, 41_975_796, 42_008_075];
    assert_eq!(steps_of(&moves, 50_000_000), expected);
}

#[test]
fn a_move_of_high_precision_may_follow_an_ordinary_one_and_counts_alike() {
    let mut rig = Rig::of(Kalico);
    rig.configure(&["config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100"]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "set_next_step_dir oid=0 dir=1"]);
    rig.send("queue_step oid=0 interval=5000 count=2 add=100");
    // 1000.5 ticks, then 0.25 more each time.
    queue(&mut rig, (4002, 4, 1, 0, 2));
    rig.send("queue_step oid=0 interval=3000 count=2 add=0");
    rig.run_until(100_000);
    let rising: Vec<u64> = rig.edges(1).into_iter().filter(|(_, level)| *level == 1).map(|(at, _)| at).collect();
    assert_eq!(rising, [5000, 10_100, 11_101, 12_101, 13_102, 14_104, 17_104, 20_104]);
    assert_eq!(rig.ask("stepper_get_position oid=0"), "stepper_position oid=0 pos=8");
}

#[test]
fn a_move_of_high_precision_that_has_no_meaning_stops_the_mcu() {
    for (item, stops) in [
        ((1000, 0, 0, 0, 0), true),
        ((1000, 0x8000, 0, 0, 0), true),
        ((1000, 0x7fff, 0, 0, 0), false),
        ((1000, 1, 0, 0, 32), true),
        ((1000, 1, 0, 0, -32), true),
        ((1000, 1, 0, 0, -31), false),
    ] {
        let mut rig = Rig::of(Kalico);
        rig.configure(&[EDGES]);
        rig.send("reset_step_clock oid=0 clock=@0");
        queue(&mut rig, item);
        assert_eq!(rig.shutdown().as_deref(), stops.then_some("Invalid count parameter"), "{item:?}");
    }
}
