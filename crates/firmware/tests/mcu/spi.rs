// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices, on a bus that answers at once and on one that takes its time.

use pinion_testbench::board::{SPI_CHIPS, Transfer};
use pinion_testbench::rig::Rig;

const CS: u32 = 40;

#[test]
fn a_device_without_a_bus_echoes() {
    let mut rig = Rig::configured(&["config_spi oid=0 pin=40 cs_active_high=0", "config_spi_without_cs oid=1"]);
    for oid in [0, 1] {
        let answer = rig.ask(&format!("spi_transfer oid={oid} data=0102ff"));
        assert_eq!(answer, format!("spi_transfer_response oid={oid} response=0102ff"));
        assert_eq!(rig.ask(&format!("spi_send oid={oid} data=0102ff")), "");
    }
    assert_eq!(rig.edges(CS), []);
}

#[test]
fn a_transfer_has_the_devices_mode_and_rate_and_its_answer() {
    let mut rig = Rig::configured(&["config_spi_without_cs oid=0", "spi_set_bus oid=0 spi_bus=1 mode=3 rate=5000000"]);
    assert_eq!(rig.ask("spi_transfer oid=0 data=00ff0f"), "spi_transfer_response oid=0 response=ff00f0");
    assert_eq!(rig.ask("spi_transfer oid=0 data="), "spi_transfer_response oid=0 response=");
    assert_eq!(rig.ask("spi_send oid=0 data=aa"), "");
    let transfer = |data: &[u8], read| Transfer { at: 0, bus: 1, mode: 3, rate_hz: 5_000_000, data: data.into(), read };
    // The reply to a `spi_send` is not read: a controller with one data line could not do both.
    let expected = [transfer(&[0, 0xff, 0x0f], true), transfer(&[], true), transfer(&[0xaa], false)];
    assert_eq!(rig.bench.transfers(), expected);
}

/// A transfer that no worker takes stays with its device. Commands do not wait for it.
#[test]
fn a_transfer_that_no_worker_takes_is_not_lost() {
    let mut rig = Rig::configured(&["config_spi_without_cs oid=0", "spi_set_bus oid=0 spi_bus=1 mode=3 rate=5000000"]);
    rig.bench.state().refuses = true;
    rig.stops_on("spi_transfer oid=0 data=00", "Bus worker queue overflow");
    rig.bench.state().refuses = false;
    rig.forget_responses();
    rig.send("clear_shutdown");
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.ask("spi_transfer oid=0 data=00ff0f"), "spi_transfer_response oid=0 response=ff00f0");
}

#[test]
fn the_chip_select_idles_and_is_driven_for_the_transfer() {
    for (active_high, selected) in [(0, 0), (1, 1)] {
        let mut rig = Rig::configured(&[
            &format!("config_spi oid=0 pin=40 cs_active_high={active_high}"),
            "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
        ]);
        assert_eq!(rig.bench.level(CS), active_high == 0);
        assert_eq!(rig.bench.shutdown_value(CS), active_high == 0);
        rig.send("spi_send oid=0 data=01");
        assert_eq!(rig.edges(CS), [(0, selected), (0, 1 - selected)]);
    }
}

#[test]
fn a_device_gets_its_message_at_a_shutdown_and_says_nothing() {
    for answer_ticks in [0, 500] {
        let mut rig = Rig::new();
        rig.bench.state().answer_ticks = answer_ticks;
        rig.configure(&[
            "config_spi oid=0 pin=40 cs_active_high=0",
            "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
            "config_spi_shutdown oid=1 spi_oid=0 shutdown_msg=deadbeef",
            // A device without a bus gets no message.
            "config_spi_without_cs oid=2",
            "config_spi_shutdown oid=3 spi_oid=2 shutdown_msg=01",
        ]);
        rig.send("emergency_stop");
        rig.run_until(10_000);
        let sent: Vec<(Vec<u8>, bool)> =
            rig.bench.transfers().into_iter().map(|transfer| (transfer.data, transfer.read)).collect();
        assert_eq!(sent, [(vec![0xde, 0xad, 0xbe, 0xef], false)]);
        assert_eq!(rig.responses(), ["shutdown clock=@0 static_string_id=Command request"]);
        assert!(rig.bench.level(CS));
    }
}

#[test]
fn a_message_that_can_not_be_sent_keeps_no_one_from_the_next_configuration() {
    let mut rig = Rig::configured(&[
        "config_spi_without_cs oid=0",
        "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
        "config_spi_shutdown oid=1 spi_oid=0 shutdown_msg=01",
    ]);
    rig.bench.state().broken.insert(SPI_CHIPS);
    rig.send("emergency_stop");
    rig.begin("config_reset");
    rig.run_until(24_000_000);
    assert!(rig.mcu.is_held() && rig.mcu.has_pending_values());
    rig.run_until(30_000_000);
    assert!(!rig.mcu.is_held());
    assert!(rig.notes().iter().any(|note| note.contains("SPI shutdown message oid 1 has not accepted")));
    rig.forget_responses();
    rig.configure(&[]);
}

#[test]
fn a_wrong_mode_or_a_second_bus_is_refused() {
    for mode in [4, 255, 256, 4_294_967_295u32] {
        let mut rig = Rig::configured(&["config_spi_without_cs oid=0"]);
        rig.send(&format!("spi_set_bus oid=0 spi_bus=0 mode={mode} rate=1000000"));
        assert_eq!(rig.shutdown().as_deref(), Some("Invalid spi config"), "mode {mode}");
    }
    let mut rig = Rig::configured(&["config_spi_without_cs oid=0", "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000"]);
    rig.stops_on("spi_set_bus oid=0 spi_bus=1 mode=0 rate=1000000", "Invalid spi config");
}

#[test]
fn a_shutdown_message_needs_a_device() {
    Rig::new().refuses(&["config_spi_shutdown oid=1 spi_oid=0 shutdown_msg=01"], "Invalid oid type");
}

#[test]
fn a_chip_select_that_fails_stops_the_mcu() {
    let mut rig = Rig::configured(&[
        "config_spi oid=0 pin=40 cs_active_high=0",
        "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
    ]);
    rig.bench.state().broken.insert(CS);
    rig.send("spi_transfer oid=0 data=01");
    assert_eq!(rig.responses(), ["shutdown clock=@0 static_string_id=Unable to issue spi ioctl"]);
}
