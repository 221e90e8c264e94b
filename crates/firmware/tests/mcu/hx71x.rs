// SPDX-License-Identifier: GPL-3.0-or-later
//! Load cells on an HX711: a model of the chip from its data sheet, at 80 samples a second.

use std::sync::{Arc, Mutex};

use pinion_testbench::board::{Bench, MISO, MOSI, SPI_CHIPS};
use pinion_testbench::rig::Rig;

const DOUT: u32 = 10;
const SCLK: u32 = 11;
/// Ticks between two samples of the chip.
const PERIOD: u64 = 625_000;
/// As klippy configures it: a tenth of `PERIOD`.
const QUERY: &str = "query_hx71x oid=0 rest_ticks=62500";
const END: &str = "query_hx71x oid=0 rest_ticks=0";
const STATUS: &str = "query_hx71x_status oid=0";
/// Clock pulses for which the data line carries a bit.
const BITS: u32 = 24;
/// Longest high time of the clock in ticks: 60 us.
const HIGH_MAX: u64 = 3000;

#[derive(Default)]
struct Hx711 {
    /// The next value; it counts up with each sample.
    value: i32,
    measured: u32,
    /// When the next sample is ready; `None` while the chip is off.
    next: Option<u64>,
    ready: bool,
    pulses: u32,
    rose: u64,
    high: bool,
    /// The number of pulses of each reading.
    counts: Vec<u32>,
    stuck_low: bool,
}

impl Hx711 {
    fn pass(&mut self, at: u64) {
        if self.high && at > self.rose + HIGH_MAX {
            (self.next, self.ready) = (None, false);
        }
        while self.next.is_some_and(|next| next <= at) {
            self.next = self.next.map(|next| next + PERIOD);
            if self.pulses > 0 {
                self.counts.push(self.pulses);
            }
            (self.ready, self.pulses) = (true, 0);
            self.measured = self.value as u32 & 0xff_ffff;
            self.value += 1;
        }
    }

    fn clock(&mut self, at: u64, level: bool) {
        self.pass(at);
        self.high = level;
        if level {
            self.rose = at;
            self.pulses += u32::from(self.next.is_some());
        } else if self.next.is_none() {
            // A reset. The chip needs four samples to settle.
            (self.next, self.pulses) = (Some(at + 4 * PERIOD), 0);
        }
    }

    fn data(&mut self, at: u64) -> bool {
        self.pass(at);
        match self.pulses {
            _ if self.stuck_low => false,
            _ if self.next.is_none() => true,
            0 => !self.ready,
            1..=BITS => self.measured >> (BITS - self.pulses) & 1 != 0,
            _ => true,
        }
    }
}

fn plug(bench: &Bench, value: i32) -> Arc<Mutex<Hx711>> {
    let chip = Arc::new(Mutex::new(Hx711 { value, high: true, ..Hx711::default() }));
    let plugged = chip.clone();
    bench.plug_line(DOUT, move |at, edge| {
        let mut chip = plugged.lock().unwrap();
        match edge {
            Some((SCLK, level)) => chip.clock(at, level),
            Some(_) => {}
            None => return chip.data(at),
        }
        true
    });
    chip
}

/// Puts the chip on the data lines of SPI bus 0. Its clock is the data output, whose bits last 2 us.
fn plug_spi(bench: &Bench, value: i32) -> Arc<Mutex<Hx711>> {
    const BIT: u64 = 100;
    let chip = Arc::new(Mutex::new(Hx711 { value, high: true, ..Hx711::default() }));
    let plugged = chip.clone();
    bench.plug_spi(0, move |at, bytes| {
        let mut chip = plugged.lock().unwrap();
        for (byte, n) in bytes.iter_mut().zip(0u64..) {
            let sent = *byte;
            *byte = (0..8).fold(0, |received, place| {
                let begin = at + (8 * n + place) * BIT;
                let level = sent >> (7 - place) & 1 != 0;
                if level != chip.high {
                    chip.clock(begin, level);
                }
                received << 1 | u8::from(chip.data(begin + BIT / 2))
            });
        }
    });
    chip
}

/// An MCU with the chip on an SPI bus, whose worker takes so long to answer.
fn spi_rig(value: i32, gain_channel: u8, answer_ticks: u32) -> (Rig, Arc<Mutex<Hx711>>) {
    let mut rig = Rig::new();
    let chip = plug_spi(&rig.bench, value);
    rig.bench.state().answer_ticks = answer_ticks;
    let pins = format!("dout_pin={MISO} sclk_pin={MOSI}");
    let objects = objects(gain_channel).map(|object| object.replace("dout_pin=10 sclk_pin=11", &pins));
    rig.configure(&objects.each_ref().map(String::as_str));
    (rig, chip)
}

fn objects(gain_channel: u8) -> [String; 5] {
    [
        format!("config_hx71x oid=0 gain_channel={gain_channel} dout_pin=10 sclk_pin=11"),
        "config_sos_filter oid=1 max_sections=0".into(),
        "config_trigger_analog oid=2 sos_filter_oid=1".into(),
        "config_trsync oid=3".into(),
        "config_stepper oid=4 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0".into(),
    ]
}

fn rig(value: i32, gain_channel: u8, answer_ticks: u32) -> (Rig, Arc<Mutex<Hx711>>) {
    let mut rig = Rig::new();
    let chip = plug(&rig.bench, value);
    rig.bench.state().answer_ticks = answer_ticks;
    let objects = objects(gain_channel);
    rig.configure(&objects.each_ref().map(String::as_str));
    (rig, chip)
}

/// The samples in the `sensor_bulk_data` messages. Their sequence must count up from `first`.
fn samples(rig: &Rig, first: u16) -> Vec<i32> {
    let mut samples = Vec::new();
    let responses = rig.responses();
    let messages = responses.iter().filter(|response| response.starts_with("sensor_bulk_data"));
    for (message, sequence) in messages.zip(first..) {
        let data = message.strip_prefix(&format!("sensor_bulk_data oid=0 sequence={sequence} data=")).unwrap();
        assert_eq!(data.len(), 2 * 48, "twelve samples");
        for at in (0..data.len()).step_by(8) {
            samples.push(u32::from_str_radix(&data[at..at + 8], 16).unwrap().swap_bytes() as i32);
        }
    }
    samples
}

#[test]
fn samples_arrive_in_messages_of_twelve() {
    for first in [-8_388_608, -5, 0, 8_388_607 - 30] {
        let (mut rig, _chip) = rig(first, 1, 0);
        rig.send(QUERY);
        rig.run_until(4 * PERIOD + 24 * PERIOD);
        assert_eq!(samples(&rig, 0), (first..first + 24).collect::<Vec<_>>());
    }
}

#[test]
fn gain_and_channel_are_chosen_by_pulses_after_the_sample() {
    for gain_channel in 1..=4 {
        let (mut rig, chip) = rig(0, gain_channel, 0);
        rig.send(QUERY);
        rig.run_until(20 * PERIOD);
        let counts = chip.lock().unwrap().counts.clone();
        assert_eq!(counts.len(), 16);
        assert!(counts.iter().all(|count| *count == 24 + u32::from(gain_channel)), "{counts:?}");
    }
}

#[test]
fn the_chip_is_off_while_nothing_is_measured() {
    let (mut rig, _chip) = rig(0, 1, 500);
    assert!(rig.bench.level(SCLK) && rig.bench.shutdown_value(SCLK));
    rig.send(QUERY);
    assert_eq!(rig.edges(SCLK), [(500, 0)], "a command is over before the next one runs");
    rig.run_until(10 * PERIOD);
    rig.edges(SCLK);
    rig.send(END);
    assert_eq!(rig.edges(SCLK), [(10 * PERIOD + 500, 1)]);
    rig.responses();
    rig.run_until(50 * PERIOD);
    assert_eq!(rig.edges(SCLK), []);
    assert_eq!(rig.responses(), [""; 0]);
}

#[test]
fn a_chip_that_cannot_be_switched_stops_the_mcu() {
    for command in [QUERY, END] {
        let (mut rig, _chip) = rig(0, 1, 500);
        rig.bench.state().broken.insert(SCLK);
        rig.send(command);
        rig.run_until(PERIOD);
        assert_eq!(rig.shutdown().as_deref(), Some("GPIO line write failed"), "{command}");
    }
}

#[test]
fn a_status_counts_what_was_read_what_is_being_read_and_what_is_in_the_chip() {
    let (mut rig, _chip) = rig(0, 1, 1000);
    rig.send(QUERY);
    // The chip wakes at 1000 and has its first sample four periods later. The timer polls every 62500 ticks.
    let first = 1000 + 4 * PERIOD;
    let look = 41 * 62_500;
    let status = |at: u64, buffered: u32| {
        format!(
            "sensor_bulk_status oid=0 clock=@{at} query_ticks=0 next_sequence=0 buffered={buffered} possible_overflows=0"
        )
    };
    for (at, buffered) in [
        (first - 1, 0),
        (first, 4),
        (look + 1000 + 500, 4),
        (look + 1000 + 1000, 4),
        (first + PERIOD - 1, 4),
        (first + PERIOD, 8),
        (first + 2 * PERIOD, 12),
    ] {
        rig.run_until(at);
        assert_eq!(rig.ask(STATUS), status(at, buffered));
    }
}

#[test]
fn a_chip_that_does_not_answer_as_it_should_sends_errors_until_it_is_asked_anew() {
    let (mut rig, chip) = rig(7, 1, 0);
    rig.send(QUERY);
    rig.run_until(6 * PERIOD);
    chip.lock().unwrap().stuck_low = true;
    rig.run_until(7 * PERIOD);
    chip.lock().unwrap().stuck_low = false;
    rig.run_until(17 * PERIOD);
    let samples = samples(&rig, 0);
    let good = samples.iter().position(|sample| *sample == i32::MIN).unwrap();
    assert!(good >= 2 && samples[..good].iter().zip(7..).all(|(sample, value)| *sample == value), "{samples:?}");
    assert!(samples[good..].iter().all(|sample| *sample == i32::MIN), "{samples:?}");
    let value = chip.lock().unwrap().value;
    rig.send_all(&[END, QUERY]);
    let from = rig.now();
    rig.run_until(from + 17 * PERIOD);
    let samples = self::samples(&rig, 0);
    assert_eq!(samples[..12], (value..value + 12).collect::<Vec<_>>());
}

#[test]
fn a_reading_that_is_not_back_in_time_is_an_error_and_counted() {
    // It is back after 10 polls instead of 8.
    let (mut rig, _chip) = rig(7, 1, 600_000);
    rig.send(QUERY);
    rig.run_until(40 * PERIOD);
    let samples = samples(&rig, 0);
    assert!(samples.len() >= 12 && samples.iter().all(|sample| *sample == 1 << 30), "{samples:?}");
    let status = rig.ask(STATUS);
    assert!(!status.ends_with("possible_overflows=0"), "{status}");
}

#[test]
fn a_clock_that_may_have_switched_the_chip_off_is_an_error() {
    // A pulse is two writes, and a wait of 11 ticks. The real time may be a tick longer.
    for (write_ticks, good) in [(1494, true), (1495, false)] {
        let (mut rig, _chip) = rig(7, 1, 0);
        rig.send(QUERY);
        rig.bench.state().write_ticks = write_ticks;
        rig.run_until(20 * PERIOD);
        let samples = samples(&rig, 0);
        assert_eq!(samples[0], if good { 7 } else { 1 << 30 }, "{write_ticks}");
    }
}

#[test]
fn a_probe_triggers_at_its_sample_and_not_at_errors() {
    for stuck_low in [false, true] {
        let (mut rig, chip) = rig(-3, 1, 1000);
        rig.send_all(&[
            "hx71x_attach_trigger_analog oid=0 trigger_analog_oid=2",
            "sos_filter_set_offset_scale oid=1 offset=0 scale=1 scale_frac_bits=0 auto_offset=0",
            "trigger_analog_set_raw_range oid=2 raw_min=-8388608 raw_max=8388607",
            "trigger_analog_set_trigger oid=2 trigger_analog_type=1 trigger_value=0",
            QUERY,
        ]);
        rig.run_until(5 * PERIOD);
        chip.lock().unwrap().stuck_low = stuck_low;
        let now = rig.now();
        rig.send_all(&[
            "trsync_start oid=3 report_clock=@0 report_ticks=0 expire_reason=2",
            &format!("trigger_analog_home oid=2 trsync_oid=3 trigger_reason=1 error_reason=40 clock=@{} monitor_ticks=625000 monitor_max=3", now + 1000),
        ]);
        rig.run_until(20 * PERIOD);
        let reports = rig.responses();
        let report = reports.iter().find(|report| report.starts_with("trsync_state")).unwrap();
        // An error does not count as a sample, so the monitor finds the sensor silent.
        let reason = if stuck_low { 42 } else { 1 };
        assert!(report.contains(&format!("trigger_reason={reason} ")), "{report}");
    }
}

#[test]
fn measurements_that_begin_anew_amid_a_reading_have_none_of_it() {
    let (mut rig, chip) = rig(7, 1, 30_000);
    rig.send(QUERY);
    // The clock falls at 30000. The first poll that finds a sample is at 2562500.
    rig.run_until(2_580_000);
    assert_eq!(chip.lock().unwrap().pulses, 0, "the reading is on its way");
    rig.send(QUERY);
    rig.run_until(2_700_000);
    assert!(rig.ask(STATUS).contains("buffered=0"), "the sample belongs to what was before");
    rig.run_until(20 * PERIOD);
    assert_eq!(samples(&rig, 0)[0], 8);
}

#[test]
fn what_is_wrong_with_it_is_refused() {
    for gain_channel in [0, 5, 255] {
        let mut rig = Rig::new();
        rig.send("allocate_oids count=1");
        rig.stops_on(
            &format!("config_hx71x oid=0 gain_channel={gain_channel} dout_pin=10 sclk_pin=11"),
            "HX71x gain/channel out of range 1-4",
        );
    }
    for (pin, text) in [(DOUT, "Unable to open in GPIO chip line"), (SCLK, "Unable to open out GPIO chip line")] {
        let mut rig = Rig::new();
        rig.bench.state().sleeping.insert(pin);
        rig.refuses(&["config_hx71x oid=0 gain_channel=1 dout_pin=10 sclk_pin=11"], text);
        assert!(rig.notes().pop().unwrap().contains("choose a pin of the processor itself"));
    }
}

#[test]
fn lines_that_fail_stop_the_mcu_and_it_can_be_configured_anew() {
    for (pin, text) in [(DOUT, "GPIO line read failed"), (SCLK, "GPIO line write failed")] {
        let (mut rig, chip) = rig(7, 1, 1000);
        rig.send(QUERY);
        rig.run_until(6 * PERIOD);
        rig.responses();
        rig.bench.state().broken.insert(pin);
        rig.stops_by(8 * PERIOD, text);
        assert!(rig.notes().pop().unwrap().contains("HX71x oid 0 (gpio10)"));
        rig.bench.state().broken.clear();
        rig.send("config_reset");
        rig.configure(&objects(1).each_ref().map(String::as_str));
        // Long enough for the chip to power down.
        rig.run_until(9 * PERIOD);
        rig.send(QUERY);
        let (from, value) = (rig.now(), chip.lock().unwrap().value);
        rig.run_until(from + 17 * PERIOD);
        let samples = samples(&rig, 0);
        assert!(samples.len() == 12 && samples.windows(2).all(|pair| pair[1] == pair[0] + 1), "{samples:?}");
        assert_eq!(samples[0], value);
    }
}

#[test]
fn a_shutdown_amid_a_reading_ends_the_samples() {
    let (mut rig, _chip) = rig(7, 1, 30_000);
    rig.send(QUERY);
    rig.run_until(2_580_000);
    rig.send("emergency_stop");
    rig.sends_until(60 * PERIOD, &["shutdown clock=@2580000 static_string_id=Command request"]);
}

#[test]
fn samples_arrive_over_spi_with_pulses_of_one_bit() {
    for (first, gain_channel, answer_ticks) in
        [(-8_388_608, 1, 0), (-5, 2, 1000), (8_388_607 - 30, 3, 30_000), (0, 4, 0)]
    {
        let (mut rig, chip) = spi_rig(first, gain_channel, answer_ticks);
        rig.send(QUERY);
        rig.run_until(4 * PERIOD + 25 * PERIOD);
        assert_eq!(samples(&rig, 0), (first..first + 24).collect::<Vec<_>>());
        let counts = chip.lock().unwrap().counts.clone();
        assert!(counts.iter().all(|count| *count == 24 + u32::from(gain_channel)), "{counts:?}");
        let transfers = rig.bench.transfers();
        assert!(transfers.iter().all(|transfer| (transfer.mode, transfer.rate_hz) == (0, 500_000)));
        // The first one starts the chip. All others are polls and readings, and each byte ends low.
        assert_eq!(transfers[0].data, [&[0xff; 8][..], &[0]].concat());
        for transfer in &transfers[1..] {
            assert!(
                matches!(transfer.data.len(), 1 | 7) && transfer.data.iter().all(|byte| byte & 1 == 0),
                "{transfer:?}"
            );
        }
        let looks = transfers.iter().filter(|transfer| transfer.data.len() == 1).count();
        assert!(looks < 40 + 25 * 5, "{looks}");
    }
}

/// A worker that is late by a part of a sample loses none. One that is late by more is noticed.
#[test]
fn a_late_worker_on_spi_is_an_error_only_if_it_may_have_lost_a_sample() {
    for (answer_ticks, good) in [(200_000, true), (600_000, false)] {
        let (mut rig, _chip) = spi_rig(7, 1, answer_ticks);
        rig.send(QUERY);
        rig.run_until(40 * PERIOD);
        let samples = samples(&rig, 0);
        let status = rig.ask(STATUS);
        if good {
            assert_eq!(samples[..24], (7..31).collect::<Vec<_>>());
        } else {
            assert!(samples.iter().all(|sample| *sample == 1 << 30), "{samples:?}");
        }
        assert_eq!(status.ends_with("possible_overflows=0"), good, "{status}");
    }
}

#[test]
fn a_disturbed_bit_on_spi_is_an_error_until_it_is_asked_anew() {
    let (mut rig, _chip) = spi_rig(7, 1, 0);
    rig.send(QUERY);
    rig.run_until(6 * PERIOD);
    let plugged = plug_spi(&rig.bench, 7);
    plugged.lock().unwrap().next = Some(rig.now());
    // Another chip on the wire pulls one reading of a bit low.
    let disturbed = plugged.clone();
    rig.bench.plug_spi(0, move |at, bytes| {
        disturbed.lock().unwrap().pass(at);
        let is_wave = bytes.len() == 7;
        bytes.fill(if is_wave { 0xff } else { 0 });
        if is_wave {
            bytes[2] = 0b1111_0111;
        }
    });
    rig.run_until(30 * PERIOD);
    let samples = samples(&rig, 0);
    let good = samples.iter().position(|sample| *sample == i32::MIN).unwrap();
    assert!(samples[..good].iter().zip(7..).all(|(sample, value)| *sample == value), "{samples:?}");
    assert!(samples[good..].iter().all(|sample| *sample == i32::MIN), "{samples:?}");
    rig.bench.plug_spi(0, |_, bytes| bytes.fill(if bytes.len() == 7 { 0xff } else { 0 }));
    rig.responses();
    rig.send_all(&[END, QUERY]);
    let from = rig.now();
    rig.run_until(from + 20 * PERIOD);
    assert_eq!(self::samples(&rig, 0)[..12], [-1; 12]);
}

/// The output stays high at the end. Even if the controller lowers it, the next start restarts the chip.
#[test]
fn the_chip_on_spi_is_switched_off_and_started_again() {
    let (mut rig, chip) = spi_rig(7, 3, 0);
    for _ in 0..2 {
        rig.send(QUERY);
        let from = rig.now();
        rig.run_until(from + 8 * PERIOD);
        rig.send(END);
        assert_eq!(rig.bench.transfers().last().unwrap().data, [0xff; 8]);
        rig.run_until(from + 20 * PERIOD);
        let mut chip = chip.lock().unwrap();
        chip.pass(from + 20 * PERIOD);
        assert!(chip.high && chip.next.is_none(), "off");
    }
}

#[test]
fn a_shutdown_or_a_failure_of_the_bus_ends_the_samples() {
    let (mut rig, _chip) = spi_rig(7, 1, 0);
    rig.send(QUERY);
    rig.run_until(6 * PERIOD);
    rig.bench.state().broken.insert(SPI_CHIPS);
    rig.stops_by(8 * PERIOD, "Unable to issue spi ioctl");
    rig.bench.state().broken.clear();
    rig.responses();
    rig.sends_until(30 * PERIOD, &[]);
}

#[test]
fn the_two_pins_on_spi_belong_together() {
    for (pins, words) in [
        (format!("dout_pin={MISO} sclk_pin={}", MOSI + 1), "write sclk_pin: spidev0"),
        (format!("dout_pin={MISO} sclk_pin=11"), "miso0 has another clock than gpio11"),
        (format!("dout_pin=10 sclk_pin={MOSI}"), "no pin 700"),
    ] {
        let mut rig = Rig::new();
        rig.refuses(&[&format!("config_hx71x oid=0 gain_channel=1 {pins}")], "Not an output pin");
        let notes = rig.notes();
        assert!(notes.iter().any(|note| note.contains(words)), "{notes:?}");
    }
}
