// SPDX-License-Identifier: GPL-3.0-or-later
//! Thermocouple converters are read at intervals, and bad readings stop the MCU.

use std::sync::{Arc, Mutex};

use pinion_testbench::board::SPI_CHIPS;
use pinion_testbench::rig::Rig;

const MAX31855: u8 = 0;
const MAX31856: u8 = 1;
const MAX31865: u8 = 2;
const MAX6675: u8 = 3;

/// Reads every 10000 ticks from 1000 on. Three bad values in a row stop the MCU.
const QUERY: &str =
    "query_thermocouple oid=1 clock=@1000 rest_ticks=10000 min_value=100 max_value=4294967040 max_invalid_count=3";

/// A chip that takes `answer_ticks` for a job. `chip` answers each transfer.
fn rig(kind: u8, answer_ticks: u32, mut chip: impl FnMut(&mut [u8]) + Send + 'static) -> Rig {
    let mut rig = Rig::new();
    rig.bench.state().answer_ticks = answer_ticks;
    rig.bench.plug_spi(0, move |_, bytes| chip(bytes));
    // klippy configures the sensor before it sets the bus.
    rig.configure(&[
        "config_spi oid=0 pin=40 cs_active_high=0",
        &format!("config_thermocouple oid=1 spi_oid=0 thermocouple_type={kind}"),
        "spi_set_bus oid=0 spi_bus=0 mode=0 rate=4000000",
    ]);
    rig
}

fn reading(next_clock: u64, value: u32, fault: u8) -> String {
    format!("thermocouple_result oid=1 next_clock=@{next_clock} value={value} fault={fault}")
}

#[test]
fn the_types_have_the_firmware_s_numbers() {
    let rig = Rig::new();
    let types = &rig.dictionary().enumerations["thermocouple_type"];
    let numbers = ["MAX31855", "MAX31856", "MAX31865", "MAX6675"].map(|name| types[name].as_u64());
    assert_eq!(numbers, [0, 1, 2, 3].map(Some));
}

#[test]
fn queries_to_a_chip_and_reports_to_the_host() {
    let cases: [(u8, &[&[u8]], u32, u8); 4] = [
        (MAX31855, &[&[0, 0, 0, 0]], 0x1122_3344, 4),
        (MAX31856, &[&[0x0c, 0, 0, 0], &[0x0f, 0]], 0x22_3344, 0x22),
        (MAX31865, &[&[0x01, 0, 0], &[0x07, 0]], 0x2233, 0x21),
        (MAX6675, &[&[0, 0]], 0x1122, 2),
    ];
    for (kind, sent, value, fault) in cases {
        let mut rig = rig(kind, 0, |bytes| {
            let answer = [0x11, 0x22, 0x33, 0x44];
            bytes.copy_from_slice(&answer[..bytes.len()]);
        });
        rig.send(QUERY);
        rig.run_until(1000);
        assert_eq!(rig.responses(), [reading(11_000, value, fault)]);
        let transfers: Vec<Vec<u8>> = rig.bench.transfers().into_iter().map(|transfer| transfer.data).collect();
        assert_eq!(transfers, sent);
        // The chip is selected once for each message.
        assert_eq!(rig.edges(40).len(), 2 * sent.len());
    }
}

/// A MAX6675 with this word.
fn with_word(answer_ticks: u32, word: u16) -> (Rig, Arc<Mutex<u16>>) {
    let shared = Arc::new(Mutex::new(word));
    let chip = shared.clone();
    (rig(MAX6675, answer_ticks, move |bytes| bytes.copy_from_slice(&chip.lock().unwrap().to_be_bytes())), shared)
}

#[test]
fn the_third_bad_value_in_a_row_stops_the_mcu() {
    // One value is below the range, the other has a fault bit.
    for (bad, fault) in [(96, 0), (404, 4)] {
        let (mut rig, word) = with_word(0, 400);
        rig.send(QUERY);
        rig.run_until(1000);
        let set = |value: u16| *word.lock().unwrap() = value;
        set(bad);
        rig.run_until(21_000);
        // After one good value, the count begins again.
        set(400);
        rig.run_until(31_000);
        set(bad);
        rig.run_until(51_000);
        assert_eq!(rig.responses().len(), 6);
        rig.run_until(61_000);
        assert_eq!(
            rig.responses(),
            [
                reading(71_000, bad.into(), fault),
                "shutdown clock=@61000 static_string_id=Thermocouple reader fault".to_owned()
            ]
        );
        let note = rig.notes().pop().unwrap();
        assert!(note.contains("MAX6675") && note.contains("3 times in a row"), "{note}");
        rig.sends_until(1_000_000, &[]);
    }
}

#[test]
fn the_limits_of_the_range_are_in_it() {
    for (word, ends) in [(96, true), (104, false), (200, false), (208, true)] {
        let (mut rig, _) = with_word(0, word);
        rig.send(
            "query_thermocouple oid=1 clock=@1000 rest_ticks=10000 min_value=104 max_value=200 max_invalid_count=1",
        );
        rig.run_until(1000);
        assert_eq!(rig.shutdown().is_some(), ends, "{word}");
    }
}

#[test]
fn a_slow_bus_delays_a_result_and_not_its_time() {
    let (mut rig, _) = with_word(3000, 400);
    rig.send(QUERY);
    rig.sends_until(3999, &[]);
    rig.run_until(24_000);
    assert_eq!(rig.responses(), [reading(11_000, 400, 0), reading(21_000, 400, 0), reading(31_000, 400, 0)]);
}

#[test]
fn a_bus_slower_than_the_interval_loses_turns() {
    let (mut rig, _) = with_word(15_000, 400);
    rig.send(QUERY);
    rig.run_until(60_000);
    assert_eq!(rig.responses(), [reading(11_000, 400, 0), reading(31_000, 400, 0), reading(51_000, 400, 0)]);
}

#[test]
fn an_answer_to_an_earlier_query_is_not_reported() {
    let (mut rig, _) = with_word(3000, 400);
    rig.send(QUERY);
    rig.run_until(2000);
    rig.send(&QUERY.replace("@1000", "@8000"));
    rig.run_until(12_000);
    assert_eq!(rig.responses(), [reading(18_000, 400, 0)]);
    // There is none after a stop either.
    rig.run_until(19_000);
    rig.send("emergency_stop");
    rig.sends_until(100_000, &["shutdown clock=@19000 static_string_id=Command request"]);
}

#[test]
fn a_query_without_rest_ends_it() {
    let (mut rig, _) = with_word(0, 400);
    rig.send(QUERY);
    rig.run_until(1000);
    rig.responses();
    rig.send("query_thermocouple oid=1 clock=@0 rest_ticks=0 min_value=0 max_value=0 max_invalid_count=0");
    rig.sends_until(1_000_000, &[]);
}

#[test]
fn a_bus_that_fails_stops_the_mcu_and_it_can_be_configured_anew() {
    let (mut rig, _) = with_word(500, 400);
    rig.send(QUERY);
    rig.bench.state().broken.insert(SPI_CHIPS);
    rig.sends_until(5000, &["shutdown clock=@1500 static_string_id=Unable to issue spi ioctl"]);
    rig.bench.state().broken.clear();
    rig.send("config_reset");
    rig.configure(&[
        "config_spi_without_cs oid=0",
        "spi_set_bus oid=0 spi_bus=0 mode=0 rate=4000000",
        "config_thermocouple oid=1 spi_oid=0 thermocouple_type=3",
    ]);
    rig.send(&QUERY.replace("@1000", "@20000"));
    rig.run_until(21_000);
    assert_eq!(rig.responses(), [reading(30_000, 400, 0)]);
}

#[test]
fn what_can_not_be_configured() {
    let refusal = |command: &str| {
        let mut rig = Rig::new();
        rig.send_all(&["allocate_oids count=3", "config_spi_without_cs oid=0", "config_trsync oid=2"]);
        rig.send(command);
        rig.shutdown().unwrap_or_default()
    };
    let config = |spi, kind| format!("config_thermocouple oid=1 spi_oid={spi} thermocouple_type={kind}");
    assert_eq!(refusal(&config(0, 4)), "Invalid thermocouple chip type");
    assert_eq!(refusal(&config(2, 0)), "Invalid oid type");
    // A device whose bus was never set.
    let mut rig = Rig::configured(&["config_spi_without_cs oid=0", &config(0, 0)]);
    rig.send(QUERY);
    rig.stops_by(2000, "Invalid oid type");
}
