// SPDX-License-Identifier: GPL-3.0-or-later
//! Chains of WS2812 LEDs on an SPI controller's data output.

use pinion_testbench::board::{MESSAGE_MAX, MOSI, SPI_CHIPS, SleepyLink, Transfer};
use pinion_testbench::rig::Rig;

/// 300 us at 3.2 MHz.
const RESET_BYTES: usize = 120;
/// Two LEDs, and klippy's reset time of 50 us, which is too short for newer LEDs.
const CHAIN: &str = "config_neopixel oid=0 pin=700 data_size=6 bit_max_ticks=200 reset_min_ticks=2500";

fn sent(rig: &Rig) -> Vec<Vec<u8>> {
    rig.bench.transfers().into_iter().map(|transfer| transfer.data).collect()
}

/// An LED chain's view of the line: a pulse of two bits or more is a 1.
fn colours(wire: &[u8]) -> Vec<u8> {
    let bits: Vec<u8> = wire.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1)).collect();
    let pulses = bits.split(|bit| *bit == 0).filter(|pulse| !pulse.is_empty());
    let data: Vec<u8> = pulses.map(|pulse| u8::from(pulse.len() > 1)).collect();
    data.chunks(8).map(|byte| byte.iter().fold(0, |value, bit| value << 1 | bit)).collect()
}

#[test]
fn a_chain_gets_its_colours_between_two_resets() {
    let mut rig = Rig::configured(&[CHAIN]);
    rig.send_all(&["neopixel_update oid=0 pos=0 data=ff00a5", "neopixel_update oid=0 pos=4 data=0180"]);
    assert_eq!(rig.responses(), [""; 0]);
    assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=1");
    // The host sends only the bytes that change. The chain gets all of them, and nothing that came in is sent again.
    rig.send("neopixel_update oid=0 pos=5 data=81");
    assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=1");
    let Transfer { bus, mode, rate_hz, read, .. } = rig.bench.transfers().remove(0);
    assert_eq!((bus, mode, rate_hz, read), (0, 0, 3_200_000, false));
    let messages = sent(&rig);
    for message in &messages {
        assert_eq!(message.len(), RESET_BYTES + 24 + RESET_BYTES);
        assert!(message[..RESET_BYTES].iter().chain(&message[RESET_BYTES + 24..]).all(|byte| *byte == 0));
    }
    assert_eq!(colours(&messages[0]), [0xff, 0, 0xa5, 0, 0x01, 0x80]);
    assert_eq!(colours(&messages[1]), [0xff, 0, 0xa5, 0, 0x01, 0x81]);
}

#[test]
fn a_send_is_over_before_the_next_command() {
    let mut rig = Rig::with_workers(5000, &[CHAIN]);
    rig.begin("neopixel_send oid=0");
    assert!(rig.mcu.is_held());
    rig.sends_until(4999, &[]);
    rig.sends_until(5000, &["neopixel_result oid=0 success=1"]);
    assert!(!rig.mcu.is_held());
    rig.begin("neopixel_send oid=0");
    rig.mcu.shut_down(pinion_firmware::shutdown::Shutdown::because(
        pinion_firmware::shutdown::reason::FORCE_SHUTDOWN,
        "test",
    ));
    assert!(!rig.mcu.is_held());
}

#[test]
fn a_bus_that_fails_is_reported_once_and_stops_nothing() {
    let mut rig = Rig::configured(&[CHAIN]);
    rig.notes();
    let warnings = |rig: &Rig| rig.notes().iter().filter(|note| note.starts_with("warning: ")).count();
    for _ in 0..2 {
        rig.bench.state().broken.insert(SPI_CHIPS);
        for _ in 0..8 {
            assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=0");
        }
        assert_eq!(warnings(&rig), 1);
        rig.bench.state().broken.clear();
        assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=1");
    }
    assert_eq!(warnings(&rig), 0);
    assert!(!rig.mcu.is_shutdown());
}

#[test]
fn an_update_past_the_chain_is_refused() {
    for (pos, data) in [(6, "01"), (5, "0102"), (7, ""), (0x8000, ""), (65_535, "01")] {
        let mut rig = Rig::configured(&[CHAIN]);
        rig.send("neopixel_update oid=0 pos=6 data=");
        assert_eq!(rig.shutdown(), None);
        rig.send(&format!("neopixel_update oid=0 pos={pos} data={data}"));
        assert_eq!(rig.shutdown().as_deref(), Some("Invalid neopixel update command"), "{pos}");
    }
}

#[test]
fn what_can_not_be_configured() {
    let refusal = |pin: u32, size: u32, reset: u32| {
        let mut rig = Rig::new();
        rig.send("allocate_oids count=1");
        rig.send(&format!(
            "config_neopixel oid=0 pin={pin} data_size={size} bit_max_ticks=200 reset_min_ticks={reset}"
        ));
        let notes = rig.notes().join(" ");
        (rig.shutdown().unwrap_or_default(), notes)
    };
    const MOST: u32 = ((MESSAGE_MAX - 2 * RESET_BYTES) / 4) as u32;
    assert_eq!(refusal(MOSI, MOST, 2500).0, "");
    assert_eq!(refusal(MOSI, MOST, 15_000).0, "");
    // One byte more than the bench's bus takes at once, and a reset that is too long for the bus.
    for (size, reset) in [(MOST + 1, 2500), (MOST, 15_001), (0, u32::MAX)] {
        let (text, note) = refusal(MOSI, size, reset);
        assert_eq!(text, "Invalid neopixel data_size");
        assert!(note.contains("takes 512 at once") && note.contains("bufsiz"), "{note}");
    }
    assert_eq!(refusal(MOSI, 0x8000, 2500).0, "Invalid neopixel data_size");
    assert_eq!(refusal(5, 6, 2500).0, "Not an output pin");
}

/// A GPIO line that is written through registers.
const FAST: u32 = 18;
const CHAIN_ON_A_LINE: &str = "config_neopixel oid=0 pin=18 data_size=3 bit_max_ticks=200 reset_min_ticks=2500";

#[test]
fn a_fast_line_drives_leds_without_an_spi_controller() {
    let mut rig = Rig::new();
    rig.bench.state().fast.insert(FAST);
    rig.configure(&[CHAIN_ON_A_LINE]);
    rig.send("neopixel_update oid=0 pos=0 data=ff00a5");
    assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=1");
    let edges: Vec<_> = rig.bench.edges(FAST);
    let high = edges.chunks(2).map(|pulse| pulse[1].0 - pulse[0].0);
    let bits: Vec<u8> = high.map(|ticks| u8::from(ticks > 32)).collect();
    let bytes = |bits: &[u8]| bits.chunks(8).map(|byte| byte.iter().fold(0, |value, bit| value << 1 | bit)).collect();
    let bytes: Vec<u8> = bytes(&bits);
    assert_eq!(bytes, [0xff, 0, 0xa5]);
    assert!(rig.bench.transfers().is_empty());
    // An edge of the kernel takes longer than a short pulse.
    rig.bench.state().write_ticks = 50;
    for _ in 0..8 {
        assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=0");
    }
    rig.bench.state().write_ticks = 0;
    assert_eq!(rig.ask("neopixel_send oid=0"), "neopixel_result oid=0 success=1");
    assert!(!rig.mcu.is_shutdown());
}

/// Behind PCIe a measured pulse is no promise about the pin.
#[test]
fn a_fast_line_behind_a_bus_that_holds_writes_back_is_refused_with_other_ways() {
    let mut rig = Rig::new();
    rig.bench.state().fast.insert(FAST);
    rig.bench.state().link = Some(SleepyLink::new(90, 1000));
    rig.refuses(&[CHAIN_ON_A_LINE], "Not an output pin");
    let notes = rig.notes().join(" ");
    for words in ["gpio18 cannot drive LEDs: its chip is behind PCIe", "spidev0.0", "ws2812-pio"] {
        assert!(notes.contains(words), "{notes}");
    }
}

#[test]
fn a_line_that_is_not_fast_or_a_chain_that_is_too_long_is_refused() {
    for (fast, size, text, log) in [
        (false, 3, "Not an output pin", "gpio18 cannot drive LEDs: their pulses are too short"),
        (true, 501, "Invalid neopixel data_size", "a chain of 501 bytes is too long for a line, which takes 500"),
    ] {
        let mut rig = Rig::new();
        if fast {
            rig.bench.state().fast.insert(FAST);
        }
        rig.refuses(&[&CHAIN_ON_A_LINE.replace("data_size=3", &format!("data_size={size}"))], text);
        let notes = rig.notes().join(" ");
        assert!(notes.contains(log), "{notes}");
    }
}
