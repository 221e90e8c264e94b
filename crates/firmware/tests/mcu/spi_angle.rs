// SPDX-License-Identifier: GPL-3.0-or-later
//! Angle sensors: one entry each time one is due, from the sensor's bytes and with its time.

use pinion_testbench::board::SPI_CHIPS;
use pinion_testbench::rig::Rig;

const A1333: u8 = 0;
const AS5047D: u8 = 1;
const TLE5012B: u8 = 2;
const MT6816: u8 = 3;
const MT6826S: u8 = 4;
const CS: u32 = 40;

fn config(chip: u8) -> Vec<String> {
    vec![
        "config_spi oid=0 pin=40 cs_active_high=0".into(),
        format!("config_spi_angle oid=1 spi_oid=0 spi_angle_type={chip}"),
        "spi_set_bus oid=0 spi_bus=0 mode=3 rate=10000000".into(),
    ]
}

fn rig(chip: u8, byte_ticks: u32, answer_ticks: u32) -> Rig {
    let mut rig = Rig::new();
    rig.bench.state().byte_ticks = byte_ticks;
    rig.bench.state().answer_ticks = answer_ticks;
    rig.configure(&config(chip).iter().map(String::as_str).collect::<Vec<_>>());
    rig
}

/// The answers of each kind of sensor at half a turn.
fn plug(rig: &Rig, chip: u8) {
    rig.bench.plug_spi(0, move |_, bytes| {
        let answer: &[u8] = match (chip, bytes.len()) {
            (_, 0) => &[],
            (A1333, 2) => &[0x40, 0x00],
            (AS5047D, 2) => &[0xa0, 0x00],
            (TLE5012B, 10) => &[0x84, 0x23, 0xc0, 0x00, 0, 0, 0x0a, 0, 0x10, 0x8e],
            (TLE5012B, 4) => &[1, 2, 3, 4],
            (MT6816, 3) => &[0, 0x80, 0x01],
            (MT6826S, 6) => &[0, 0, 0x80, 0x00, 0x00, 0x0b],
            other => panic!("{other:?}"),
        };
        bytes.copy_from_slice(answer);
    });
}

/// The entries of three bytes in the messages since the last call.
fn entries(rig: &Rig) -> Vec<String> {
    let responses = rig.responses();
    let data = responses.iter().filter_map(|response| response.split_once("data=")).map(|(_, data)| data);
    data.flat_map(|data| {
        assert_eq!(data.len(), 2 * 51);
        (0..17).map(|n| data[6 * n..6 * n + 6].to_owned())
    })
    .collect()
}

#[test]
fn each_sensor_is_asked_in_its_way_and_its_angle_reported_with_its_time() {
    // Half a turn is 0x8000, low byte first. A byte takes 10 ticks, and the shift is 2. A sensor that latches at the
    // beginning is 0 late. The others are late by their bytes.
    for (chip, words, entry) in [
        (A1333, vec!["3200"], "000080"),
        (AS5047D, vec!["7ffe", "c000"], "050080"),
        // The entry has the chip's own clock.
        (TLE5012B, vec!["", "84230000000000000000"], "050080"),
        (MT6816, vec!["830000"], "080080"),
        (MT6826S, vec!["300300000000"], "0f0080"),
    ] {
        let mut rig = rig(chip, 10, 0);
        plug(&rig, chip);
        rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=20000 time_shift=2");
        rig.sends_until(1000 + 16 * 20_000, &[]);
        rig.run_until(1000 + 17 * 20_000 - 1);
        let sent: Vec<String> =
            rig.bench.transfers().iter().map(|transfer| pinion_testbench::rig::hex(&transfer.data)).collect();
        assert_eq!(sent[..words.len()], words);
        assert_eq!(sent.len(), 17 * words.len());
        assert_eq!(entries(&rig), vec![entry; 17], "chip {chip}");
        // The sensor is selected once for each word.
        assert_eq!(rig.edges(CS).len(), 2 * 17 * words.len());
    }
}

/// The TLE5012B latches at the end of a pulse of 1 us on its select line, without a clock during the pulse.
#[test]
fn a_tle5012b_is_selected_for_a_microsecond_before_it_is_read() {
    let mut rig = rig(TLE5012B, 0, 1);
    plug(&rig, TLE5012B);
    rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=20000 time_shift=2");
    rig.run_until(2000);
    let edges = rig.edges(CS);
    assert_eq!(edges[..2], [(1001, 0), (1051, 1)]);
    assert_eq!(edges.len(), 4);
    let latched = rig.bench.transfers()[0].at;
    assert_eq!(latched, 1051);
}

#[test]
fn messages_are_counted_from_zero_in_each_query() {
    let mut rig = rig(A1333, 1, 0);
    plug(&rig, A1333);
    for start in [0, 1_000_000] {
        rig.run_until(start);
        rig.send(&format!("query_spi_angle oid=1 clock=@{} rest_ticks=1000 time_shift=0", start + 1000));
        rig.run_until(start + 40_000);
        let sequences: Vec<String> =
            rig.responses().iter().map(|response| response.split(' ').nth(2).unwrap().to_owned()).collect();
        assert_eq!(sequences, ["sequence=0", "sequence=1"]);
        rig.send("query_spi_angle oid=1 clock=@0 rest_ticks=0 time_shift=0");
        rig.sends_until(start + 900_000, &[]);
    }
}

/// klippy counts entries: one for each due time, however slow the bus is.
#[test]
fn what_there_was_no_time_for_is_an_entry_too() {
    let mut rig = rig(A1333, 0, 2400);
    plug(&rig, A1333);
    rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=1000 time_shift=4");
    rig.run_until(1000 + 1000 * 1700);
    let entries = entries(&rig);
    // The only missing entries are under way, or in a message that is not full.
    assert!((1700 - 20..=1700).contains(&entries.len()), "{}", entries.len());
    let overflows = entries.iter().filter(|entry| *entry == "ff0000").count();
    assert!(overflows * 10 > entries.len() * 5 && overflows * 10 < entries.len() * 7, "{overflows} overflows");
    assert_eq!(entries[..5], ["000080", "ff0000", "190080", "ff0000", "320080"]);
}

#[test]
fn a_transfer_above_50_us_gives_no_time_and_no_angle() {
    for chip in [A1333, AS5047D, MT6816, MT6826S] {
        for (answer_ticks, fits) in [(2500, true), (2501, false)] {
            let mut rig = rig(chip, 0, answer_ticks);
            plug(&rig, chip);
            rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=20000 time_shift=9");
            rig.run_until(1000 + 17 * 20_000);
            let entries = entries(&rig);
            assert_eq!(entries.len(), 17);
            assert!(entries.iter().all(|entry| (entry == "ff0200") != fits), "{chip} {entries:?}");
        }
    }
}

#[test]
fn rubbish_is_an_error_each_time() {
    for chip in [A1333, AS5047D, TLE5012B, MT6816, MT6826S] {
        let mut rig = rig(chip, 0, 0);
        rig.bench.plug_spi(0, |_, bytes| bytes.fill(0xff));
        rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=1000 time_shift=0");
        rig.run_until(18_500);
        let entries = entries(&rig);
        assert_eq!(entries.len(), 17);
        assert!(entries.iter().all(|entry| entry == "ff0300" || entry == "ff0500"), "{chip} {entries:?}");
    }
}

#[test]
fn a_transfer_of_the_host_s_has_the_clock_of_its_latch() {
    for (chip, clock) in [(A1333, 5000), (AS5047D, 5020), (MT6816, 5000), (MT6826S, 5000)] {
        let mut rig = rig(chip, 10, 0);
        rig.bench.plug_spi(0, |_, bytes| bytes.fill(0x5a));
        rig.run_until(5000);
        let answer = rig.ask("spi_angle_transfer oid=1 data=8442");
        assert_eq!(answer, format!("spi_angle_transfer_response oid=1 clock=@{clock} response=5a5a"));
    }
    // This transfer is too slow to give a time.
    let mut slow = rig(MT6816, 0, 2501);
    let answer = slow.ask("spi_angle_transfer oid=1 data=8442");
    assert_eq!(answer, "spi_angle_transfer_response oid=1 clock=@0 response=");
    // The TLE5012B's time is the end of the empty transfer with its microsecond, however long the next transfer takes.
    let mut tle = rig(TLE5012B, 0, 2501);
    plug(&tle, TLE5012B);
    let answer = tle.ask("spi_angle_transfer oid=1 data=84420000");
    assert_eq!(answer, "spi_angle_transfer_response oid=1 clock=@2551 response=01020304");
}

/// A latched measurement is read before the host's transfer latches a new one.
#[test]
fn a_transfer_waits_for_the_measurement_under_way() {
    let mut rig = rig(TLE5012B, 0, 1000);
    plug(&rig, TLE5012B);
    rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=50000 time_shift=0");
    rig.run_until(1500);
    rig.begin("spi_angle_transfer oid=1 data=84420000");
    assert!(rig.mcu.is_held());
    // There are two latches of a microsecond each.
    rig.run_until(5099);
    assert!(rig.mcu.is_held(), "commands wait for it");
    rig.run_until(5100);
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.responses(), ["spi_angle_transfer_response oid=1 clock=@4100 response=01020304"]);
    let lengths: Vec<usize> = rig.bench.transfers().iter().map(|transfer| transfer.data.len()).collect();
    assert_eq!(lengths, [0, 10, 0, 4]);
    // And the other way round.
    rig.run_until(50_500);
    rig.begin("spi_angle_transfer oid=1 data=84420000");
    rig.run_until(60_000);
    assert!(!rig.mcu.is_held());
    let lengths: Vec<usize> = rig.bench.transfers().iter().skip(4).map(|transfer| transfer.data.len()).collect();
    assert_eq!(lengths, [0, 4, 0, 10]);
}

/// A bus that is too slow for its measurements is never free. Commands wait for the host's transfer alone.
#[test]
fn measurements_without_a_pause_hold_no_commands() {
    let mut rig = rig(TLE5012B, 0, 10_000);
    plug(&rig, TLE5012B);
    rig.send("query_spi_angle oid=1 clock=@15000 rest_ticks=12000 time_shift=0");
    rig.begin("spi_angle_transfer oid=1 data=84420000");
    rig.run_until(19_000);
    assert!(rig.mcu.is_held());
    rig.run_until(21_000);
    assert_eq!(rig.responses().len(), 1);
    assert!(!rig.mcu.is_held());
    rig.run_until(200_000);
    assert_eq!(rig.bench.transfers().len(), 19, "the bus was busy all the time");
}

#[test]
fn an_mcu_that_stops_amid_everything_is_there_for_the_next_configuration() {
    for chip in [A1333, AS5047D, TLE5012B] {
        for stop_at in (1000..8000).step_by(500) {
            let mut rig = rig(chip, 0, 1500);
            rig.bench.plug_spi(0, |_, bytes| bytes.fill(0));
            rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=3000 time_shift=0");
            rig.run_until(stop_at.min(1700));
            rig.begin("spi_angle_transfer oid=1 data=8442");
            rig.run_until(stop_at.max(1700));
            rig.mcu.shut_down(pinion_firmware::shutdown::Shutdown::because(
                pinion_firmware::shutdown::reason::FORCE_SHUTDOWN,
                "a test",
            ));
            rig.run_until(20_000);
            assert_eq!(rig.turn(), rig.mcu.next_timer(), "nothing goes on");
            rig.send("clear_shutdown");
            assert!(!rig.mcu.is_held(), "{chip} {stop_at}");
            rig.forget_responses();
            assert!(rig.ask("spi_angle_transfer oid=1 data=8442").starts_with("spi_angle_transfer_response"));
            rig.send_all(&["emergency_stop", "config_reset"]);
            rig.forget_responses();
            rig.configure(&config(chip).iter().map(String::as_str).collect::<Vec<_>>());
            assert!(rig.ask("spi_angle_transfer oid=1 data=8442").starts_with("spi_angle_transfer_response"));
        }
    }
}

#[test]
fn a_bus_that_fails_stops_the_mcu() {
    for command in
        ["query_spi_angle oid=1 clock=@1000 rest_ticks=1000 time_shift=0", "spi_angle_transfer oid=1 data=8442"]
    {
        let mut rig = rig(TLE5012B, 0, 0);
        rig.bench.state().broken.insert(SPI_CHIPS);
        rig.send(command);
        rig.stops_by(2000, "Unable to issue spi ioctl");
        assert!(rig.notes().iter().any(|note| note.contains("angle sensor oid 1")));
    }
}

#[test]
fn what_can_not_be_is_refused() {
    for (device, chip, text) in [
        ("config_spi_without_cs oid=0", 0, "angle sensor requires cs pin"),
        ("config_spi oid=0 pin=40 cs_active_high=0", 5, "Invalid spi_angle chip type"),
        ("config_spi oid=0 pin=40 cs_active_high=0", 255, "Invalid spi_angle chip type"),
        ("config_trsync oid=0", 0, "Invalid oid type"),
    ] {
        let mut rig = Rig::new();
        let angle = format!("config_spi_angle oid=1 spi_oid=0 spi_angle_type={chip}");
        rig.refuses(&[device, &angle], text);
    }
    let mut rig = rig(A1333, 0, 0);
    rig.run_until(1000);
    rig.stops_on("query_spi_angle oid=1 clock=@999 rest_ticks=1000 time_shift=0", "Timer too close");
}
