// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer ADXL345: complete samples in order, statuses that match them, and the effect of a missing chip.

use std::sync::{Arc, Mutex};

use pinion_testbench::board::SPI_CHIPS;
use pinion_testbench::rig::Rig;

const CONFIG: &[&str] = &[
    "config_spi_without_cs oid=0",
    "config_adxl345 oid=1 spi_oid=0",
    "spi_set_bus oid=0 spi_bus=0 mode=3 rate=5000000",
];

/// Ticks per sample at 3200 Hz.
const SAMPLE_TICKS: u64 = 15_625;
/// The value of klippy: four samples.
const REST_TICKS: u64 = 4 * SAMPLE_TICKS;

/// The chip measures from `start` on. The value of each sample is its number.
#[derive(Default)]
struct Chip {
    period: u64,
    start: u64,
    /// Samples that were read, and samples that the full FIFO dropped.
    taken: u64,
    dropped: u64,
    /// If set, the chip sends this byte instead of an answer.
    rubbish: Option<u8>,
}

impl Chip {
    /// Samples ready to be read. According to the data sheet, the FIFO holds 32 and the output registers hold one.
    fn available(&mut self, at: u64) -> u64 {
        let made = (at.saturating_sub(self.start) / self.period).min(1 << 40);
        let available = made - self.taken - self.dropped;
        self.dropped += available.saturating_sub(33);
        available.min(33)
    }

    fn exchange(&mut self, at: u64, bytes: &mut [u8]) {
        if let Some(rubbish) = self.rubbish {
            bytes.fill(rubbish);
            return;
        }
        let entries = self.available(at).min(32) as u8;
        match (bytes[0], bytes.len()) {
            (0xf2, 9) => {
                let n = self.taken + self.dropped;
                let [low, high] = ((n % 4096) as u16).to_le_bytes();
                bytes[1..].copy_from_slice(&[low, high, (n / 4096 % 256) as u8, 0, 0xff, 0xff, 0x90, entries]);
                self.taken += u64::from(entries > 0);
            }
            (0xb9, 2) => bytes[1] = entries,
            other => panic!("{other:02x?}"),
        }
    }
}

fn plug(rig: &Rig, chip: Chip) -> Arc<Mutex<Chip>> {
    let chip = Arc::new(Mutex::new(chip));
    let plugged = chip.clone();
    rig.bench.plug_spi(0, move |at, bytes| plugged.lock().unwrap().exchange(at, bytes));
    chip
}

fn measuring(period: u64) -> Chip {
    Chip { period, ..Chip::default() }
}

/// The value of a parameter in a response's text.
fn field<'a>(response: &'a str, name: &str) -> &'a str {
    let mut words = response.split(' ').filter_map(|word| word.split_once('='));
    words.find(|(key, _)| *key == name).unwrap_or_else(|| panic!("{response}")).1
}

/// The samples' numbers in a message; `None` for an error.
fn samples(response: &str) -> Vec<Option<u64>> {
    let data = field(response, "data");
    let bytes: Vec<u8> =
        (0..data.len()).step_by(2).map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap()).collect();
    bytes
        .chunks(5)
        .map(|sample| {
            let [x, y, _, xz, yz] = sample.try_into().unwrap();
            (yz & 0x80 == 0).then(|| u64::from(x) + 256 * u64::from(xz & 0x1f) + 4096 * u64::from(y))
        })
        .collect()
}

#[test]
fn a_message_is_ten_samples_byte_for_byte() {
    let mut rig = Rig::configured(CONFIG);
    plug(&rig, measuring(1000));
    rig.send("query_adxl345 oid=1 rest_ticks=10500");
    rig.sends_until(10_499, &[]);
    rig.run_until(10_500);
    let data: String = (0..10).map(|n| format!("{n:02x}00ffe060")).collect();
    assert_eq!(rig.responses(), [format!("sensor_bulk_data oid=1 sequence=0 data={data}")]);
    rig.sends_until(10_500 + 9_400, &[]);
    rig.run_until(40_000);
    let reports = rig.responses();
    assert_eq!(field(&reports[0], "sequence"), "1");
    assert_eq!(samples(&reports[0]), (10..20).map(Some).collect::<Vec<_>>());
}

#[test]
fn the_fifo_is_looked_at_after_its_rest_and_read_until_one_is_left() {
    let mut rig = Rig::configured(CONFIG);
    plug(&rig, measuring(1000));
    rig.send("query_adxl345 oid=1 rest_ticks=3000");
    rig.run_until(6_500);
    let at: Vec<u64> = rig.bench.transfers().iter().map(|transfer| transfer.at).collect();
    assert_eq!(at, [3000, 3000, 3000, 6000, 6000, 6000]);
}

/// A measurement as klippy makes it. At 10 us a byte, a sample takes 90 us of its 312 us.
#[test]
fn no_sample_is_lost_at_3200_hz_beside_steppers_and_steps_are_on_their_ticks() {
    const SECONDS: u64 = 15;
    let mut rig = Rig::new();
    rig.bench.state().byte_ticks = 500;
    let steppers = [2, 3, 4];
    let mut config: Vec<String> = CONFIG.iter().map(|command| (*command).to_owned()).collect();
    for oid in steppers {
        config.push(format!(
            "config_stepper oid={oid} step_pin={oid} dir_pin={} invert_step=-1 step_pulse_ticks=0",
            10 + oid
        ));
    }
    rig.configure(&config.iter().map(String::as_str).collect::<Vec<_>>());
    let chip = plug(&rig, measuring(SAMPLE_TICKS));
    rig.send(&format!("query_adxl345 oid=1 rest_ticks={REST_TICKS}"));
    for oid in steppers {
        rig.send(&format!("reset_step_clock oid={oid} clock=@0"));
        for _ in 0..SECONDS / 5 {
            rig.send(&format!("queue_step oid={oid} interval=5000 count=50000 add=0"));
        }
    }
    let mut next = 0;
    let mut messages = 0u16;
    let mut steps = 0;
    for tenth in 1..=10 * SECONDS {
        // klippy asks ten times a second, at any time.
        let until = tenth * 5_000_000 - tenth * 7_919 % 100_000;
        rig.run_until(until);
        rig.send("query_adxl345_status oid=1");
        for response in rig.responses() {
            if response.starts_with("sensor_bulk_status") {
                assert_eq!(field(&response, "possible_overflows"), "0");
                assert_eq!(field(&response, "query_ticks"), "1000");
                continue;
            }
            assert_eq!(field(&response, "sequence"), messages.to_string());
            messages += 1;
            for sample in samples(&response) {
                assert_eq!(sample, Some(next % (1 << 20)));
                next += 1;
            }
        }
        let edges = steppers.map(|pin| rig.edges(pin));
        assert!(edges.iter().all(|edges| edges.iter().zip(steps + 1..).all(|((at, _), n)| *at == 5000 * n)));
        steps += edges[0].len() as u64;
        assert!(edges.iter().all(|edges| edges.len() > 9000 / 10));
    }
    assert!(steps > SECONDS * 10_000 - 100, "{steps} steps");
    assert!(next > SECONDS * 3200 - 20, "{next} samples");
    assert_eq!(chip.lock().unwrap().dropped, 0);
}

/// klippy computes a sample's time from the status. It must have the exact number of samples at its time.
#[test]
fn a_status_counts_the_samples_of_its_instant() {
    let mut rig = Rig::new();
    rig.bench.state().byte_ticks = 500;
    rig.configure(CONFIG);
    plug(&rig, measuring(SAMPLE_TICKS));
    rig.send(&format!("query_adxl345 oid=1 rest_ticks={REST_TICKS}"));
    for n in 0..500u64 {
        // At any time, also during a reading.
        rig.run_until(n * 23_456);
        rig.send("query_adxl345_status oid=1");
        let responses = rig.responses();
        let status = responses.iter().find(|response| response.starts_with("sensor_bulk_status")).unwrap();
        let number = |name| field(status, name).parse::<u64>().unwrap();
        let clock: u64 = field(status, "clock")[1..].parse().unwrap();
        let samples = number("next_sequence") * 10 + number("buffered") / 5;
        assert_eq!(samples, clock / SAMPLE_TICKS, "{status}");
    }
}

#[test]
fn a_status_is_that_of_the_question_and_not_of_the_wait_for_the_bus() {
    let mut rig = Rig::with_workers(2000, CONFIG);
    plug(&rig, measuring(SAMPLE_TICKS));
    rig.begin("spi_transfer oid=0 data=f20000000000000000");
    rig.run_until(1500);
    // After the transfer, which takes until 2000.
    rig.send("query_adxl345_status oid=1");
    assert_eq!(
        rig.responses().pop().unwrap(),
        "sensor_bulk_status oid=1 clock=@2000 query_ticks=2000 next_sequence=0 buffered=0 possible_overflows=0"
    );
}

#[test]
fn a_fifo_of_31_and_more_counts_as_an_overflow() {
    for (full, overflows) in [(30, 0), (31, 1), (32, 2), (33, 3), (100, 3)] {
        let mut rig = Rig::configured(CONFIG);
        let chip = plug(&rig, measuring(1000));
        rig.send(&format!("query_adxl345 oid=1 rest_ticks={}", full * 1000));
        rig.run_until(full * 1000 + 500);
        let status = rig.ask("query_adxl345_status oid=1");
        assert_eq!(field(&status, "possible_overflows"), overflows.to_string(), "{full}");
        assert_eq!(chip.lock().unwrap().dropped, u64::from(full == 100) * 67);
    }
}

#[test]
fn rubbish_is_reported_as_errors_and_a_status_of_rubbish_is_left_out() {
    for rubbish in [0x00, 0x55, 0xff] {
        let mut rig = Rig::configured(CONFIG);
        plug(&rig, Chip { rubbish: Some(rubbish), ..measuring(1000) });
        rig.send("query_adxl345 oid=1 rest_ticks=1000");
        rig.run_until(10_500);
        let reports = rig.responses();
        assert_eq!(reports.len(), 1, "one sample in each look: {reports:?}");
        assert_eq!(samples(&reports[0]), [None; 10]);
        let status = rig.ask("query_adxl345_status oid=1");
        assert_eq!(status.is_empty(), rubbish != 0, "{status}");
    }
}

#[test]
fn a_bus_that_fails_stops_the_mcu_and_the_next_configuration_measures() {
    for ask in ["", "query_adxl345_status oid=1"] {
        let mut rig = Rig::configured(CONFIG);
        plug(&rig, measuring(1000));
        rig.send("query_adxl345 oid=1 rest_ticks=1000");
        rig.run_until(500);
        rig.bench.state().broken.insert(SPI_CHIPS);
        if ask.is_empty() {
            rig.run_until(1500);
        } else {
            rig.send(ask);
        }
        assert_eq!(rig.shutdown().as_deref(), Some("Unable to issue spi ioctl"));
        assert!(rig.notes().iter().any(|note| note.contains("ADXL345 oid 1")));
        rig.bench.state().broken.clear();
        rig.run_until(100_000);
        assert_eq!(rig.responses(), [""; 0], "a stopped MCU does not measure");
        rig.send("config_reset");
        rig.configure(CONFIG);
        let start = rig.now();
        rig.send("query_adxl345 oid=1 rest_ticks=20000");
        rig.run_until(start + 20_000);
        assert_eq!(field(&rig.responses()[0], "sequence"), "0");
    }
}

#[test]
fn an_ended_query_says_nothing_more_and_the_next_begins_at_zero() {
    let mut rig = Rig::with_workers(5000, CONFIG);
    plug(&rig, measuring(500));
    rig.send("query_adxl345 oid=1 rest_ticks=20000");
    // During a reading.
    rig.run_until(22_000);
    rig.send("query_adxl345 oid=1 rest_ticks=0");
    rig.sends_until(100_000, &[]);
    assert_eq!(rig.turn(), rig.mcu.next_timer());

    rig.send("query_adxl345 oid=1 rest_ticks=20000");
    rig.run_until(160_000);
    assert!(field(rig.responses().last().unwrap(), "sequence") != "0");
    // Started again during a reading, and due before that reading ends.
    rig.run_until(162_000);
    rig.forget_responses();
    rig.send("query_adxl345 oid=1 rest_ticks=100");
    rig.run_until(180_000);
    let reports = rig.responses();
    assert_eq!(field(&reports[0], "sequence"), "0");
    assert_eq!(field(&reports[1], "sequence"), "1");
}

#[test]
fn a_sensor_needs_an_spi_device() {
    for command in ["config_adxl345 oid=1 spi_oid=0", "config_adxl345 oid=1 spi_oid=200"] {
        Rig::new().refuses(&["config_trsync oid=0", command], "Invalid oid type");
    }
}

/// A job that cannot be sent stays with its sensor. The sensor gets an error each time.
#[test]
fn a_sensor_whose_device_has_no_bus_loses_nothing() {
    let config =
        ["allocate_oids count=2", "config_spi oid=0 pin=17 cs_active_high=0", "config_adxl345 oid=1 spi_oid=0"];
    let mut rig = Rig::new();
    rig.send_all(&config);
    rig.send("finalize_config crc=7");
    for query in ["query_adxl345 oid=1 rest_ticks=1000", "query_adxl345_status oid=1", "query_adxl345_status oid=1"] {
        rig.forget_responses();
        rig.send(query);
        rig.run_until(rig.now() + 10_000);
        assert_eq!(rig.shutdown().as_deref(), Some("Invalid oid type"), "{query}");
        rig.send("clear_shutdown");
    }
}

#[test]
fn a_slow_chip_delays_nothing_but_itself() {
    let mut rig = Rig::with_workers(
        5_000_000,
        &[CONFIG, &["config_stepper oid=2 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0"]].concat(),
    );
    plug(&rig, measuring(SAMPLE_TICKS));
    rig.send("query_adxl345 oid=1 rest_ticks=62500");
    rig.send_all(&["reset_step_clock oid=2 clock=@0", "queue_step oid=2 interval=1000 count=20000 add=0"]);
    rig.run_until(10_000_000);
    assert_eq!(rig.ask("get_clock"), "clock clock=@10000000", "a reading holds no command");
    rig.run_until(20_000_000);
    assert!(rig.edges(1).iter().zip(1..).all(|((at, _), n)| *at == 1000 * n));
    assert_eq!(rig.shutdown(), None);
}
