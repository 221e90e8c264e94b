// SPDX-License-Identifier: GPL-3.0-or-later
//! An MCU on a bench whose devices answer, and how time passes there.

#![forbid(unsafe_code)]

use std::sync::Arc;

use pinion_firmware::mcu::Dialect;
use pinion_firmware::time::{CLOCK_FREQ, Ticks};
use pinion_protocol::vlq::Reader;

use super::form::{EXPANDED, Form, PINS, Value};
use crate::board::{ANALOG, GPIOS};
use crate::memory;
use crate::rig::Rig;

const EXPANDED_LINES: u32 = 8;
/// How long an input is low, in ticks. On some pins it is up to 13 times as long. It is short, because a bus on lines
/// polls a clock that is low each microsecond, for 100 ms.
const LOW: u64 = 777;
/// Shortest turn of the MCU: events that come faster make it late.
const TURN: Ticks = Ticks::from_us(20);

/// An MCU with devices that answer.
pub(super) fn bench(dialect: &Arc<Dialect>) -> Rig {
    let rig = Rig::with_dialect(dialect.clone());
    for (bus, address) in (0..2).flat_map(|bus| (0..128).map(move |address| (bus, address))) {
        let mut count = address;
        rig.bench.plug_i2c(bus, address, move |_, _, read| {
            read.iter_mut().for_each(|byte| {
                count = count.wrapping_mul(5).wrapping_add(77);
                *byte = count;
            });
            Ok(())
        });
    }
    for channel in 0..3 {
        rig.bench.script_adc(ANALOG + channel, &[1000, 2000, 60_000, 0, 7]);
    }
    for pin in PINS {
        let low = LOW * u64::from(pin % 13 + 1);
        let changes: Vec<_> = (0..50).flat_map(|n| [(n * 100 * low, 0), ((n * 100 + 1) * low, 1)]).collect();
        rig.bench.script_input(*pin, &changes);
    }
    for pin in (0..GPIOS).filter(|pin| !PINS.contains(pin)) {
        rig.bench.script_input(pin, &[(0, 1)]);
    }
    rig.bench.script_ds18b20("28", &[Some(20_000), Some(-5000), Some(85_000)]);
    rig.bench.state().sleeping.extend(EXPANDED..EXPANDED + EXPANDED_LINES);
    rig
}

/// Lets the MCU run while `goes_on` is true. Returns how often it allocated or freed memory.
pub(super) fn pass(rig: &mut Rig, mut goes_on: impl FnMut(&Rig) -> bool) -> u64 {
    let mut allocations = 0;
    while goes_on(rig) {
        let now = rig.mcu.now();
        let mut next = None;
        allocations += memory::allocations(|| next = rig.turn());
        if goes_on(rig) {
            rig.jump(next.map_or(now + TURN, |next| next.max(now + TURN)));
        }
    }
    allocations
}

/// Lets the MCU run up to `ticks`, or for `turns` turns.
pub(super) fn pass_until(rig: &mut Rig, ticks: u64, turns: u32) -> u64 {
    let mut left = 2 * turns;
    pass(rig, |rig| {
        left = left.saturating_sub(1);
        left > 0 && rig.now() < ticks
    })
}

/// Runs a command to the end of its job. Returns how often the MCU allocated or freed memory.
pub(super) fn run(rig: &mut Rig, payload: &[u8]) -> u64 {
    let (mut reader, mut allocations) = (Reader::new(payload), 0);
    while !reader.is_empty() {
        allocations += memory::allocations(|| rig.mcu.execute(&mut reader));
        // Commands wait for a bus for at most five seconds.
        let limit = rig.now() + 6 * u64::from(CLOCK_FREQ);
        allocations += pass(rig, |rig| {
            assert!(rig.now() < limit, "commands are held for too long");
            rig.mcu.is_held()
        });
    }
    allocations
}

/// The same for a command as text.
pub(super) fn say(rig: &mut Rig, command: &str) {
    let payload = rig.encode(command);
    run(rig, &payload);
}

/// The shutdown text if the command stops the MCU, else `None`. It ends all activity that the command began.
pub(super) fn try_out(rig: &mut Rig, form: &Form, values: &[Value]) -> Option<String> {
    let payload = form.encode(rig, values);
    run(rig, &payload);
    let end = rig.now() + 100_000;
    pass_until(rig, end, if rig.mcu.is_shutdown() { 0 } else { 20 });
    let refused = rig.mcu.is_shutdown().then(|| rig.shutdown().unwrap_or_default());
    if refused.is_none() {
        say(rig, "emergency_stop");
    }
    settle(rig);
    say(rig, "clear_shutdown");
    rig.forget_responses();
    rig.notes();
    rig.bench.forget();
    refused
}

/// Waits until the outputs are at their shutdown values.
pub(super) fn settle(rig: &mut Rig) {
    let limit = rig.now() + u64::from(CLOCK_FREQ);
    pass(rig, |rig| {
        assert!(rig.now() < limit, "{:?} is not at its shutdown value", rig.mcu.pending_value());
        rig.mcu.has_pending_values()
    });
}
