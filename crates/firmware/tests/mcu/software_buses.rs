// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI and I2C on GPIO lines, as a host configures them. `crates/firmware/src/board/soft_spi.rs` and `soft_i2c.rs` test
//! the bits on the wires.

use pinion_firmware::board::{Bias, Direction};

use pinion_testbench::board::SleepyLink;
use pinion_testbench::rig::Rig;

const MISO: u32 = 30;
const MOSI: u32 = 31;
const SCLK: u32 = 32;
const CS: u32 = 40;
const SCL: u32 = 50;
const SDA: u32 = 51;

const SPI: &[&str] = &[
    "config_spi oid=0 pin=40 cs_active_high=0",
    "spi_set_sw_bus oid=0 miso_pin=30 mosi_pin=31 sclk_pin=32 mode=0 pulse_ticks=100",
];
const I2C: &[&str] = &["config_i2c oid=1", "i2c_set_sw_bus oid=1 scl_pin=50 sda_pin=51 pulse_ticks=100 address=72"];

#[test]
fn spi_lines_are_driven_at_the_hosts_pace() {
    let mut rig = Rig::configured(SPI);
    rig.bench.script_input(MISO, &[(0, 1)]);
    assert_eq!(rig.ask("spi_transfer oid=0 data=a5"), "spi_transfer_response oid=0 response=ff");
    let clock = rig.edges(SCLK);
    // It idles for a pulse. Each bit is low for a half, then high for a half.
    let expected: Vec<_> = (0..16).map(|n| (150 + 50 * n, u8::from(n % 2 == 0))).collect();
    assert_eq!(clock, expected);
    // 1010 0101, each bit at its beginning.
    assert_eq!(rig.edges(MOSI), [(150, 1), (250, 0), (350, 1), (450, 0), (650, 1), (750, 0), (850, 1)]);
    assert_eq!(rig.edges(CS), [(100, 0), (900, 1)]);
}

/// Behind PCIe an edge may come later than its write. A bit still has its times.
#[test]
fn spi_lines_wait_for_a_bus_that_holds_writes_back() {
    let mut rig = Rig::new();
    rig.bench.state().link = Some(SleepyLink::new(40, 45));
    rig.configure(SPI);
    rig.bench.script_input(MISO, &[(0, 1)]);
    assert_eq!(rig.ask("spi_transfer oid=0 data=a5"), "spi_transfer_response oid=0 response=ff");
    let clock = rig.edges(SCLK);
    assert_eq!(clock.len(), 16);
    assert!(clock.windows(2).all(|two| two[1].0 - two[0].0 >= 50), "{clock:?}");
}

#[test]
fn chips_share_lines_and_keep_their_modes() {
    let mut rig = Rig::configured(
        &[
            SPI,
            &[
                "config_spi oid=2 pin=41 cs_active_high=1",
                "spi_set_sw_bus oid=2 miso_pin=30 mosi_pin=31 sclk_pin=32 mode=3 pulse_ticks=10",
                // A Dotstar's lines: nothing comes back.
                "config_spi_without_cs oid=3",
                "spi_set_sw_bus oid=3 miso_pin=33 mosi_pin=33 sclk_pin=32 mode=0 pulse_ticks=10",
            ],
        ]
        .concat(),
    );
    for (oid, idle) in [(0, false), (2, true), (0, false), (3, false)] {
        rig.send(&format!("spi_send oid={oid} data=ff"));
        assert_eq!(rig.bench.level(SCLK), idle, "oid {oid}");
    }
    assert!(rig.bench.level(33), "it is an output");
    assert_eq!(rig.bench.state().directions[&MISO], Direction::Input(Bias::PullUp));
}

#[test]
fn what_spi_can_not_be_is_refused() {
    for refused in [
        "spi_set_sw_bus oid=0 miso_pin=30 mosi_pin=31 sclk_pin=32 mode=4 pulse_ticks=1",
        "spi_set_sw_bus oid=0 miso_pin=30 mosi_pin=31 sclk_pin=32 mode=0 pulse_ticks=1",
    ] {
        let mut rig = Rig::configured(if refused.contains("mode=4") { &SPI[..1] } else { SPI });
        rig.send(refused);
        assert_eq!(rig.shutdown().as_deref(), Some("Invalid spi config"), "{refused}");
    }
}

#[test]
fn an_i2c_wire_is_an_open_drain_and_an_empty_bus_acknowledges_nothing() {
    let mut rig = Rig::configured(I2C);
    for pin in [SCL, SDA] {
        assert_eq!(rig.bench.state().directions[&pin], Direction::OpenDrain);
        rig.bench.script_input(pin, &[(0, 1)]);
    }
    assert_eq!(rig.ask("i2c_transfer oid=1 write=10 read_len=0"), "i2c_response oid=1 i2c_bus_status=3 response=");
    assert!(rig.bench.level(SCL) && rig.bench.level(SDA), "both are let go");
    let notes = rig.notes();
    let named = |note: &String| ["scl gpio50", "sda gpio51", "0x48", "wiring"].iter().all(|word| note.contains(word));
    assert!(notes.iter().any(named), "{notes:?}");
    // The address is 1001 000, then 0 for a write. The clock has nine pulses, and two more for start and stop.
    let rises = rig.edges(SCL).iter().filter(|(_, level)| *level == 1).count();
    assert_eq!(rises, 9 + 2);
}

#[test]
fn a_wire_that_stays_low_is_a_timeout_and_the_mcu_goes_on() {
    for (high, held) in [(SDA, "SCL stays low"), (SCL, "SDA stays low")] {
        let mut rig = Rig::configured(I2C);
        rig.bench.script_input(high, &[(0, 1)]);
        assert_eq!(
            rig.ask("i2c_transfer oid=1 write=10 read_len=1"),
            "i2c_response oid=1 i2c_bus_status=2 response=00"
        );
        assert!(rig.now() < 10_000_000, "{}", rig.now());
        let notes = rig.notes();
        assert!(notes.iter().any(|note| note.starts_with("warning: I2C Timeout") && note.contains(held)), "{notes:?}");
        assert_eq!(rig.shutdown(), None);
        assert!(rig.bench.level(SCL) && rig.bench.level(SDA), "both are let go");
    }
}
