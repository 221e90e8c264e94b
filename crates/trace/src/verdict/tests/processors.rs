// SPDX-License-Identifier: GPL-3.0-or-later
//! Processors that others have, and work that takes long.

use super::*;

const CORE_WAITED: &str = "the core waited 12.0 ms for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own";
const LONG_CALL: &str = "one call to a driver or the kernel kept the core for 120.0 ms: look for its device in dmesg";

#[test]
fn a_link_that_waits_for_a_processor_makes_a_block_late() {
    let scene = || Scene::calm().block(STOP - 200, STOP - 100).account(Watched::Core, 2, 1).stop(BLOCK, STOP - 38_200);
    scene().account(Watched::Link, 1, 37).judged(
        TOO_CLOSE,
        Culprit::Processors,
        "the link to the host waited 37.0 ms for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
    );
    scene().account(Watched::Link, 1, 5).judged(TOO_CLOSE, Culprit::Host, HOST_LATE);
}

#[test]
fn a_core_that_waits_for_a_processor_says_why() {
    let scene = || {
        Scene::calm()
            .and("core", STOP - 1, woke(50, 12))
            .and("core", STOP - 1, late(12))
            .account(Watched::Core, 3, 12)
            .stop(7, STOP - 12_000)
    };
    let past = "Stepper too far in past";
    scene().judged(past, Culprit::Processors, CORE_WAITED);
    scene().and("core", STOP - 30_000, Event::Scheduling { fifo: false }).judged(
        past,
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: it had used up its real-time share: lower the speed, or free it of the limit (sysctl kernel.sched_rt_runtime_us=-1)",
    );
    // Back in time.
    scene()
        .and("core", STOP - 40_000, Event::Scheduling { fifo: false })
        .and("core", STOP - 30_000, Event::Scheduling { fifo: true })
        .judged(past, Culprit::Processors, CORE_WAITED);
    scene().and("core", SECOND, Event::Scheduling { fifo: false }).judged(
        past,
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: it may not run in real time: do what the log's warning about real time says",
    );
    let ordinary = scene().and("core", STOP - 30_000, Event::Scheduling { fifo: false });
    let mut ordinary = ordinary.trace(End::Shutdown { reason: past.into(), trouble: TROUBLE.into() });
    ordinary.head.realtime = false;
    let found = verdict(&ordinary);
    assert_eq!(
        found.text,
        "the core waited 12.0 ms for a processor: it does not run in real time: run Pinion in real time (-r, as the service does)"
    );
    // A block that came in time waits as well.
    scene().block(STOP - 13_000, STOP - 1).stop(BLOCK, STOP - 11_000).judged(
        TOO_CLOSE,
        Culprit::Processors,
        CORE_WAITED,
    );
}

#[test]
fn a_kernel_that_wakes_the_core_late_is_no_busy_processor() {
    Scene::calm().and("core", STOP - 1, woke(50, 12)).account(Watched::Core, 3, 0).stop(7, STOP - 12_000).judged(
        "Stepper too far in past",
        Culprit::Driver,
        WOKEN_LATE,
    );
}

#[test]
fn a_call_that_takes_long_is_no_flood_of_work() {
    let past = "Rescheduled timer in the past";
    let busy = |ran| Scene::calm().silent(&["core"], STOP - 149_999..STOP).account(Watched::Core, ran, 1);
    busy(150).and("core", STOP - 150_000, STEP).and("core", STOP - 1, late(120)).stop(7, STOP - 120_000).judged(
        past,
        Culprit::Driver,
        LONG_CALL,
    );
    // A call that sleeps, while the link goes on.
    busy(2).and("core", STOP - 150_000, STEP).and("link", STOP - 80_000, Event::Out(9)).stop(7, STOP - 120_000).judged(
        past,
        Culprit::Driver,
        LONG_CALL,
    );
    let mut flood = busy(240);
    for at in (0..150_000).step_by(1000) {
        flood = flood.and("core", STOP - 150_000 + at, late(at as u32 / 1250));
    }
    flood.stop(7, STOP - 120_000).judged(
        past,
        Culprit::Work,
        "the core worked all the time and was 120.0 ms late: fewer steps a second: lower the speed or the microsteps",
    );
    // Steps closer together than their pulses, on a core that is on time.
    let steps = Scene::calm().account(Watched::Core, 240, 0).and("link", STOP - 600, Event::Out(9));
    steps.stop(7, STOP - 1_200).judged(
        "Stepper too far in past",
        Culprit::Work,
        "steps were closer together than their pulses; the core was never later than 0.1 ms: stepper oid 3: some trouble: do something",
    );
}
