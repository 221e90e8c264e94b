// SPDX-License-Identifier: GPL-3.0-or-later
//! The power supply.

use super::*;

#[test]
fn the_power_comes_first_if_it_was_bad_then() {
    let scene = |fault, at| {
        let scene = Scene::calm().block(STOP - 200, STOP - 100).and("sampler", at, Event::Power(Some(fault)));
        scene.stop(BLOCK, STOP - 38_200)
    };
    scene(PowerFault::Undervoltage, STOP - SECOND).judged(
        TOO_CLOSE,
        Culprit::Power,
        "the power supply's voltage was too low then; the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms: use a better power supply and a short, thick cable",
    );
    scene(PowerFault::Hot, STOP - 10_000).judged(
        TOO_CLOSE,
        Culprit::Power,
        "the processor was slowed down by heat then; the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms: cool it",
    );
    let over = scene(PowerFault::Undervoltage, STOP - 5 * SECOND).and("sampler", STOP - SECOND, Event::Power(None));
    over.judged(TOO_CLOSE, Culprit::Host, HOST_LATE);
    let mut slow = Scene::calm().and("sampler", STOP - SECOND, Event::Frequency { mhz: 600, max_mhz: 1500 });
    for at in (0..20_000).step_by(500) {
        slow = slow.and("core", STOP - 20_000 + at, late(1));
    }
    slow.account(Watched::Core, 240, 0).stop(7, STOP - 15_000).judged(
        "Stepper too far in past",
        Culprit::Power,
        "the core worked all the time and was 15.0 ms late, at 600 MHz of 1500 MHz: set the frequency governor to performance",
    );
}
