// SPDX-License-Identifier: GPL-3.0-or-later
//! The host, its wire and its blocks.

use super::*;

const SILENT_BUT_ASKS: &str = "the host sent no commands for 4.4 s, but it still asked for the clock; the core was never later than 0.1 ms: look at its log, and at its load";

#[test]
fn a_host_that_is_late_is_accused() {
    let came = |came: u64, at: u64| Scene::calm().block(came, STOP - 100).stop(BLOCK, at);
    came(STOP - 200, STOP - 38_200).judged(TOO_CLOSE, Culprit::Host, HOST_LATE);
    let again = Scene::calm().block(STOP - 200, STOP - 100);
    again.and("link", STOP - 50_000, Event::Refused(Refusal::Repeated)).stop(BLOCK, STOP - 38_200).judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came 38.0 ms after the step it was for; it sent a block again, without an acknowledgement in time; the core was never later than 0.1 ms: look at the host's load",
    );
    // It came before its time, but the core needs some time, too.
    came(STOP - 900, STOP - 400).judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came only 0.5 ms before the step it was for; the core was never later than 0.1 ms: look at the host's load",
    );
}

#[test]
fn a_host_that_is_silent_or_gone_is_accused() {
    let missed = |scene: Scene| scene.stop(9, STOP - 100);
    missed(Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP)).judged(
        MISSED_PWM,
        Culprit::Host,
        "the host sent no commands for 4.4 s; the core was never later than 0.1 ms: look at its log, and at its load",
    );
    let silent = || Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP);
    missed(silent().and("link", STOP - SECOND, Event::Answered { id: 4 })).judged(
        MISSED_PWM,
        Culprit::Host,
        SILENT_BUT_ASKS,
    );
    let again = Event::Refused(Refusal::Repeated);
    missed(silent().and("link", STOP - 2 * SECOND, again).and("link", STOP - SECOND, again)).judged(
        MISSED_PWM,
        Culprit::Host,
        "the host sent no commands for 4.4 s; it sent 2 blocks again, without acknowledgements in time; the core was never later than 0.1 ms: look at its log, and at its load",
    );
    missed(Scene::calm().and("link", STOP - 3 * SECOND, Event::HostGone)).judged(
        MISSED_PWM,
        Culprit::Host,
        "the host closed the terminal 3.0 s before the stop: its log says why it ended",
    );
    missed(Scene::calm().and("link", STOP - 40_000, Event::BlockIn(9))).judged(
        MISSED_PWM,
        Culprit::Host,
        "the host sent its last block 40.0 ms before the stop, but did not refresh an output in time; the core was never later than 0.1 ms: stepper oid 3: some trouble: do something",
    );
    // The link did not run.
    let starved = Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP).account(Watched::Link, 1, 3900);
    missed(starved).judged(
        MISSED_PWM,
        Culprit::Processors,
        "the link to the host waited 3.9 s for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
    );
}

#[test]
fn a_wire_that_is_cut_is_named() {
    const LOOK: &str = "look at the wire, and whether the computer at its other end is on";
    let silent = || Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP).stop(9, STOP - 100);
    silent().judged_over(
        "can:can0",
        Culprit::Wire,
        &format!("nothing came over can:can0 for 4.4 s; the core was never later than 0.1 ms: {LOOK}"),
    );
    silent().and("link", STOP - 2 * SECOND, Event::Refused(Refusal::Garbage)).judged_over(
        "serial:/dev/ttyAMA0,250000",
        Culprit::Wire,
        &format!(
            "only garbage came over serial:/dev/ttyAMA0,250000 for 4.4 s; the core was never later than 0.1 ms: {LOOK}"
        ),
    );
    silent().and("link", STOP - 3 * SECOND, Event::HostGone).judged_over(
        "serial:/dev/ttyGS0",
        Culprit::Wire,
        &format!("the host was gone from serial:/dev/ttyGS0 3.0 s before the stop: {LOOK}"),
    );
    // The wire is whole: the host says something.
    silent().and("link", STOP - SECOND, Event::Answered { id: 4 }).judged_over(
        "can:can0",
        Culprit::Host,
        SILENT_BUT_ASKS,
    );
}

#[test]
fn a_network_that_is_gone_is_no_host_that_hangs() {
    const LOOK: &str = "look at the network, and at the log of pinion link on the host's computer";
    let silent = || Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP).stop(9, STOP - 100);
    silent().judged_over(
        SSH,
        Culprit::Wire,
        &format!("nothing came over SSH for 4.4 s; the core was never later than 0.1 ms: {LOOK}"),
    );
    silent().and("link", STOP - 3 * SECOND, Event::HostGone).judged_over(
        SSH,
        Culprit::Wire,
        &format!("the host was gone from SSH 3.0 s before the stop: {LOOK}"),
    );
    silent().and("link", STOP - SECOND, Event::Alive).judged_over(
        SSH,
        Culprit::Host,
        "the host sent no commands for 4.4 s, but its computer sent keepalives; the core was never later than 0.1 ms: look at its log, and at its load",
    );
    // It had sent a block again before it hung.
    let again = silent().and("link", STOP - 4 * SECOND, Event::Refused(Refusal::Repeated));
    again.and("link", STOP - SECOND, Event::Alive).judged_over(
        SSH,
        Culprit::Host,
        "the host sent no commands for 4.4 s, but its computer sent keepalives; it sent a block again, without an acknowledgement in time; the core was never later than 0.1 ms: look at its log, and at its load",
    );
}

#[test]
fn a_wire_that_was_silent_makes_a_block_late() {
    let came = |scene: Scene| scene.block(STOP - 200, STOP - 100).stop(BLOCK, STOP - 38_200);
    let silent = || came(Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP));
    silent().judged_for_over(
        TOO_CLOSE,
        "can:can0",
        Culprit::Wire,
        "nothing came over can:can0 for 4.4 s, and then a block 38.0 ms after the step it was for; the core was never later than 0.1 ms: look at the wire, and whether the computer at its other end is on",
    );
    let late = "the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms";
    let remedy = "look at the host's load, and at the wire (can:can0)";
    // The silence was short, or over before the step's time.
    for heard in [SECOND, 10_000] {
        silent().and("link", STOP - heard, Event::Answered { id: 4 }).judged_for_over(
            TOO_CLOSE,
            "can:can0",
            Culprit::Host,
            &format!("{late}: {remedy}"),
        );
    }
    // A host on this computer has no wire.
    silent().judged(TOO_CLOSE, Culprit::Host, &format!("{late}: look at the host's load"));
}

#[test]
fn an_input_that_ends_says_whether_anything_came_before() {
    let lost = |scene: Scene, text: &str| {
        let scene = scene.and("core", STOP, Event::Stopped { block: 9 });
        scene.judged_for_over(reason::HOST_LOST.text(), "stdio", Culprit::Wire, text);
    };
    lost(
        Scene::calm().and("link", STOP - 1000, Event::BlockIn(10)),
        "the program that carries the host's bytes closed standard input; the core was never later than 0.1 ms: look at its log, and at the network",
    );
    lost(
        Scene::calm().silent(&["link"], STOP - 4 * SECOND..STOP),
        "nothing came over standard input for 4.4 s, and then it ended; the core was never later than 0.1 ms: look at its log, and at the network",
    );
}
