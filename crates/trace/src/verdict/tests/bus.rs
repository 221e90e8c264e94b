// SPDX-License-Identifier: GPL-3.0-or-later
//! Buses that take long or hang.

use super::*;

const BUS_LATE: &str = "spi0 took 41.0 ms for one job (stepper oid 3), and the host's commands waited for it: use a higher rate, or another bus for the device";

#[test]
fn a_bus_for_which_a_block_waits_is_named() {
    let scene = |came: u64| {
        Scene::calm()
            .and("link", came, Event::BlockIn(BLOCK))
            .and("core", STOP - 50_000, Event::Held)
            .and("spi0", STOP - 50_000, Event::JobBegan { oid: Some(3), waited: Ticks(0) })
            .and("core", STOP - 9_000, Event::Released)
            .and("spi0", STOP - 9_000, Event::JobEnded { oid: Some(3), took: ms(41) })
            .and("core", STOP - 100, Event::Block(BLOCK))
            .stop(BLOCK, STOP - 20_000)
    };
    scene(STOP - 60_000).judged(TOO_CLOSE, Culprit::Bus, BUS_LATE);
    // The core had no room for the block, because it was held: the host had sent it in time.
    scene(STOP - 8_000).and("link", STOP - 45_000, Event::Full).judged(TOO_CLOSE, Culprit::Bus, BUS_LATE);
    // The host sent it when the bus was free again, because it had waited for an acknowledgement.
    scene(STOP - 8_000).judged(TOO_CLOSE, Culprit::Bus, BUS_LATE);
    // It could have sent it earlier, as it did while the bus was busy.
    scene(STOP - 12_000).judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came 8.0 ms after the step it was for; the core was never later than 0.1 ms: look at the host's load",
    );
}

#[test]
fn a_bus_that_hangs_is_named() {
    let hangs = Scene::calm()
        .and("core", STOP - 5 * SECOND, Event::Held)
        .and("spi0", STOP - 5 * SECOND, Event::JobBegan { oid: Some(3), waited: Ticks(0) })
        .and("i2c1", STOP - 6 * SECOND, Event::JobBegan { oid: Some(4), waited: Ticks(0) })
        .and("i2c1", STOP - 5 * SECOND, Event::JobEnded { oid: Some(4), took: ms(1000) });
    let text =
        "spi0 has not answered for 5.0 s (stepper oid 3): check the power and the wires of its devices, and dmesg";
    let stopped = hangs.clone().and("core", STOP, Event::Stopped { block: 7 });
    stopped.judged("Bus does not answer", Culprit::Bus, text);
    hangs.clone().silent(&["core", "sampler", "guardian"], STOP + 1..LATEST).ends(End::Asked, Culprit::Bus, text);
    // An output waits for its refresh behind it.
    hangs.and("link", STOP - 4 * SECOND, Event::BlockIn(8)).stop(7, STOP - 1000).judged(MISSED_PWM, Culprit::Bus, text);
    let stopped = Scene::calm().and("core", STOP, Event::Stopped { block: 7 });
    stopped.judged("Bus does not answer", Culprit::Bus, &format!("a bus did not answer: {TROUBLE}"));
}
