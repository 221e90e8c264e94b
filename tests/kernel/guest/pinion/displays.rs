// SPDX-License-Identifier: GPL-3.0-or-later
//! Displays on lines of a GPIO chip: each edge as the display sees it, in the kernel's order.

use std::collections::HashMap;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, run};
use crate::trace::{Trace, Write};

const RS: u32 = 0;
const E: u32 = 1;
const D4: u32 = 2;
const SCLK: u32 = 1;
const SID: u32 = 2;

/// Replays the writes to the chip's lines. `see` gets each write with its offset and the levels before it.
fn replay(sim: &GpioSim, trace: &Trace, mut see: impl FnMut(u32, Write, &HashMap<u32, Write>)) {
    let first = sim.kernel_number(0);
    let mut levels = HashMap::new();
    for write in trace.writes() {
        let offset = write.line - first;
        see(offset, write, &levels);
        levels.insert(offset, write);
    }
}

fn is_high(levels: &HashMap<u32, Write>, offset: u32) -> bool {
    levels.get(&offset).is_some_and(|write| write.level)
}

#[test]
fn an_hd44780_takes_in_its_bytes_with_time_in_between() {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    configure(
        client,
        1,
        &[
            "config_hd44780 oid=0 rs_pin=lab/gpio0 e_pin=lab/gpio1 d4_pin=lab/gpio2 d5_pin=lab/gpio3 d6_pin=lab/gpio4 d7_pin=lab/gpio5 delay_ticks=2000",
        ],
    );
    let trace = Trace::start();
    run(client, "hd44780_send_cmds oid=0 cmds=28280c");
    run(client, "hd44780_send_data oid=0 data=48616c6c6f");
    let mut nibbles: Vec<(bool, u8, u64)> = Vec::new();
    replay(&sim, &trace, |offset, write, levels| {
        if offset != E {
            assert!(!is_high(levels, E), "line {offset} changes while E is high");
        } else if !write.level {
            assert!(write.at_ns - levels[&E].at_ns >= 230, "E is high for too short a time");
            let bits = (0..4).map(|place| u8::from(is_high(levels, D4 + place)) << place).sum();
            nibbles.push((is_high(levels, RS), bits, write.at_ns));
        }
    });
    let bytes: Vec<(bool, u8)> = nibbles.chunks(2).map(|pair| (pair[0].0, pair[0].1 << 4 | pair[1].1)).collect();
    let expected = [0x28, 0x28, 0x0c].map(|byte| (false, byte)).into_iter();
    assert_eq!(bytes, expected.chain(b"Hallo".map(|byte| (true, byte))).collect::<Vec<_>>());
    // 40 us from the end of a byte to the end of the next one's first half.
    let ends: Vec<u64> = nibbles.iter().map(|nibble| nibble.2).collect();
    assert!(ends[1..].chunks_exact(2).all(|pair| pair[1] - pair[0] >= 40_000), "{ends:?}");
}

#[test]
fn an_st7920_takes_in_its_messages_and_goes_low_at_a_shutdown() {
    let sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    configure(
        client,
        1,
        &[
            "config_st7920 oid=0 cs_pin=lab/gpio0 sclk_pin=lab/gpio1 sid_pin=lab/gpio2 sync_delay_ticks=2250 cmd_delay_ticks=1000",
        ],
    );
    assert!(sim.level(0), "it is not selected");
    let trace = Trace::start();
    run(client, "st7920_send_cmds oid=0 cmds=24a5");
    run(client, "st7920_send_data oid=0 data=ff");
    let (mut bits, mut bytes) = (Vec::new(), Vec::new());
    replay(&sim, &trace, |offset, write, levels| match offset {
        SCLK => {
            let since = levels.get(&SCLK).map_or(0, |before| before.at_ns);
            assert!(write.at_ns - since >= 200, "SCLK changes within 200 ns");
            if write.level {
                bits.push(u8::from(is_high(levels, SID)));
            } else if bits.len() == 8 {
                bytes.push((bits.drain(..).fold(0, |byte: u8, bit| byte << 1 | bit), write.at_ns));
            }
        }
        _ => assert!(!is_high(levels, SCLK), "line {offset} changes while SCLK is high"),
    });
    let said: Vec<u8> = bytes.iter().map(|(byte, _)| *byte).collect();
    assert_eq!(said, [0xf8, 0x20, 0x40, 0xa0, 0x50, 0xfa, 0xf0, 0xf0]);
    // 20 us between two bytes of a message, and 45 us between two messages.
    assert!(bytes[4].1 - bytes[2].1 >= 20_000 && bytes[7].1 - bytes[4].1 >= 45_000, "{bytes:?}");
    run(client, "emergency_stop");
    assert!(!sim.level(SCLK) && !sim.level(SID));
}
