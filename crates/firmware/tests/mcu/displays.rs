// SPDX-License-Identifier: GPL-3.0-or-later
//! Displays on GPIO lines, with chips that read as their data sheets say.

use pinion_testbench::rig::{Rig, hex};

const RS: u32 = 10;
const E: u32 = 11;
const D4: u32 = 12;
const CS: u32 = 20;
const SCLK: u32 = 21;
const SID: u32 = 22;

/// 40 us after each byte, as in klippy.
const HD44780: &str =
    "config_hd44780 oid=0 rs_pin=10 e_pin=11 d4_pin=12 d5_pin=13 d6_pin=14 d7_pin=15 delay_ticks=2000";
/// Delays of 45 us and 20 us.
const ST7920: &str = "config_st7920 oid=0 cs_pin=20 sclk_pin=21 sid_pin=22 sync_delay_ticks=2250 cmd_delay_ticks=1000";

/// The levels of lines after their edges so far. All begin low.
#[derive(Default)]
struct Levels(std::collections::HashMap<u32, (u64, bool)>);

impl Levels {
    fn high(&self, pin: u32) -> bool {
        self.0.get(&pin).is_some_and(|(_, level)| *level)
    }

    fn since(&self, pin: u32) -> u64 {
        self.0.get(&pin).map_or(0, |(at, _)| *at)
    }
}

/// Reads like an HD44780 on four lines: the time, whether it is data, and four bits.
fn hear_hd44780(rig: &Rig) -> Vec<(u64, bool, u8)> {
    let mut levels = Levels::default();
    let mut heard = Vec::new();
    for (pin, (at, level)) in std::mem::take(&mut rig.bench.state().edges) {
        if pin == E && level == 0 {
            assert!(at - levels.since(E) >= 12, "E is high for less than 230 ns at {at}");
            let bits = (0..4).map(|n| u8::from(levels.high(D4 + n)) << n).sum();
            heard.push((at, levels.high(RS), bits));
        } else if pin == E {
            assert!(at - levels.since(E) >= 13 || at < 20, "E is low for less than 270 ns at {at}");
        } else {
            assert!(!levels.high(E), "pin {pin} changes at {at} while E is high");
        }
        levels.0.insert(pin, (at, level != 0));
    }
    heard
}

/// Reads like an ST7920: the end time of each byte, and the byte.
fn hear_st7920(rig: &Rig) -> Vec<(u64, u8)> {
    let mut levels = Levels::default();
    let mut heard = Vec::new();
    let (mut byte, mut count) = (0u8, 0);
    for (pin, (at, level)) in std::mem::take(&mut rig.bench.state().edges) {
        if pin == SCLK {
            assert!(at < 20 || at - levels.since(SCLK) >= 10, "SCLK changes within 200 ns at {at}");
            if level != 0 {
                byte = byte << 1 | u8::from(levels.high(SID));
                count += 1;
            } else if count == 8 {
                heard.push((at, byte));
                count = 0;
            }
        } else {
            assert!(!levels.high(SCLK), "SID changes at {at} while SCLK is high");
        }
        levels.0.insert(pin, (at, level != 0));
    }
    heard
}

/// Joins pairs of nibbles to bytes, with the time when each is complete.
fn bytes(nibbles: &[(u64, bool, u8)]) -> Vec<(u64, bool, u8)> {
    let byte = |pair: &[(u64, bool, u8)]| (pair[1].0, pair[0].1, pair[0].2 << 4 | pair[1].2);
    nibbles.chunks(2).map(byte).collect()
}

#[test]
fn an_hd44780_hears_commands_and_data_with_time_in_between() {
    let mut rig = Rig::configured(&[HD44780]);
    rig.send("hd44780_send_cmds oid=0 cmds=28280c");
    rig.send("hd44780_send_data oid=0 data=48616c6c6fff00");
    let heard = bytes(&hear_hd44780(&rig));
    let said: Vec<(bool, u8)> = heard.iter().map(|(_, data, byte)| (*data, *byte)).collect();
    let expected = [0x28, 0x28, 0x0c].map(|byte| (false, byte)).into_iter();
    assert_eq!(said, expected.chain(b"Hallo\xff\x00".map(|byte| (true, byte))).collect::<Vec<_>>());
    // The first nibble takes 26 ticks longer than the second.
    for pair in heard.windows(2) {
        assert!((2000..2060).contains(&(pair[1].0 - pair[0].0)), "{heard:?}");
    }
}

#[test]
fn an_st7920_hears_messages_with_time_before_each_byte_is_complete() {
    let mut rig = Rig::configured(&[ST7920]);
    assert!(rig.bench.level(CS) && rig.bench.shutdown_value(CS));
    rig.send("st7920_send_cmds oid=0 cmds=24a5");
    rig.send("st7920_send_data oid=0 data=ff");
    rig.send("st7920_send_data oid=0 data=");
    let heard = hear_st7920(&rig);
    let said: Vec<u8> = heard.iter().map(|(_, byte)| *byte).collect();
    assert_eq!(hex(&said), "f8204 0a050 faf0f0 fa".replace(' ', ""));
    // A byte takes 160 ticks. The host's delay and half a byte are between the ends of two bytes.
    let ends: Vec<u64> = heard.iter().map(|(at, _)| *at).collect();
    assert_eq!(ends[4] - ends[2], 1000 + 160, "{ends:?}");
    assert_eq!(ends[7] - ends[4], 2250 + 160, "{ends:?}");
    assert!(rig.bench.level(CS));
}

#[test]
fn the_next_command_waits_and_steps_do_not() {
    let stepper = "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100";
    for (config, command) in
        [(HD44780, "hd44780_send_data oid=0 data=3031323334"), (ST7920, "st7920_send_data oid=0 data=3031323334")]
    {
        let mut rig = Rig::configured(&[config, stepper]);
        rig.send_all(&["reset_step_clock oid=1 clock=@0", "queue_step oid=1 interval=500 count=100 add=0"]);
        rig.begin(command);
        rig.run_until(3000);
        assert!(rig.mcu.is_held(), "{command}");
        rig.run_until(100_000);
        assert!(!rig.mcu.is_held(), "{command}");
        assert!(rig.edges(1).iter().step_by(2).zip(1..=100).all(|((at, _), n)| *at == 500 * n));
    }
}

#[test]
fn a_shutdown_drives_the_lines_low_and_the_display_starts_anew() {
    let lines: [(&str, &str, Vec<u32>); 2] = [
        (HD44780, "hd44780_send_data oid=0 data=ffff", (RS..RS + 6).collect()),
        (ST7920, "st7920_send_data oid=0 data=ffff", vec![SCLK, SID]),
    ];
    for (config, command, pins) in lines {
        let mut rig = Rig::configured(&[config]);
        rig.begin(command);
        rig.run_until(1);
        rig.send("emergency_stop");
        rig.run_until(100_000);
        assert!(!rig.mcu.has_pending_values());
        for pin in &pins {
            assert!(!rig.bench.level(*pin), "pin {pin}");
            assert!(!rig.bench.shutdown_value(*pin), "pin {pin}");
        }
        rig.responses();
        rig.send("clear_shutdown");
        rig.bench.forget_edges();
        rig.send(command);
        let bytes: Vec<u8> = match pins.len() {
            2 => hear_st7920(&rig).iter().map(|(_, byte)| *byte).collect(),
            _ => bytes(&hear_hd44780(&rig)).iter().map(|(_, _, byte)| *byte).collect(),
        };
        assert_eq!(bytes.last(), Some(if pins.len() == 2 { &0xf0 } else { &0xff }));
        assert_eq!(rig.shutdown(), None);
    }
}

#[test]
fn a_display_is_there_for_the_next_configuration() {
    let mut rig = Rig::configured(&[HD44780]);
    rig.send_all(&["emergency_stop", "config_reset"]);
    rig.responses();
    rig.configure(&[ST7920]);
    rig.send("st7920_send_cmds oid=0 cmds=01");
    assert_eq!(hear_st7920(&rig).len(), 3);
    rig.stops_on("hd44780_send_cmds oid=0 cmds=01", "Invalid oid type");
}

#[test]
fn a_line_that_is_gone_stops_the_mcu_and_is_tried_again() {
    for (config, command, pin) in
        [(HD44780, "hd44780_send_cmds oid=0 cmds=01", E), (ST7920, "st7920_send_cmds oid=0 cmds=01", SCLK)]
    {
        let mut rig = Rig::configured(&[config]);
        rig.bench.state().broken.insert(pin);
        rig.stops_on(command, "GPIO line write failed");
        rig.run_until(10_000_000);
        assert!(rig.mcu.has_pending_values());
        rig.bench.state().broken.clear();
        rig.run_until(20_000_000);
        assert!(!rig.mcu.has_pending_values() && !rig.bench.level(pin));
    }
}

#[test]
fn a_display_behind_an_expander_works() {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.extend(RS..RS + 6);
    rig.configure(&[HD44780]);
    rig.send("hd44780_send_data oid=0 data=41");
    assert_eq!(bytes(&hear_hd44780(&rig))[0].2, 0x41);
    rig.send("emergency_stop");
    rig.run_until(100_000);
    assert!(!rig.mcu.has_pending_values());
}

#[test]
fn a_display_that_takes_forever_stops_the_mcu() {
    let mut rig = Rig::configured(&[&HD44780.replace("=2000", "=4000000000")]);
    rig.begin("hd44780_send_data oid=0 data=4142");
    rig.stops_by(300_000_000, "Bus does not answer");
}
