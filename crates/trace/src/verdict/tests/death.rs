// SPDX-License-Identifier: GPL-3.0-or-later
//! Programs that are gone or hang, and recordings without a culprit.

use super::*;

#[test]
fn a_stop_for_another_reason_accuses_nobody() {
    let stop = |scene: Scene| scene.and("core", STOP, Event::Stopped { block: 7 });
    for reason in ["Command request", "ADC out of range", "Not an output pin"] {
        stop(Scene::calm()).judged(reason, Culprit::Nobody, &format!("nobody was late: {TROUBLE}"));
    }
    let before = Scene::calm().and("core", STOP - 2 * SECOND, woke(50, 12)).and("core", STOP - 2 * SECOND, late(12));
    let before = before.account_at(STOP - 2 * SECOND, Watched::Core, 3, 12);
    stop(before).judged(
        "Command request",
        Culprit::Nobody,
        &format!("{TROUBLE}; 2.0 s before, the core waited 12.0 ms for a processor: other real-time work had it, which did not stop it"),
    );
}

#[test]
fn a_program_that_is_gone_is_reported_with_its_last_command() {
    let scene = |from: u64| {
        let scene = Scene::calm().and("core", STOP - SECOND, STEP);
        scene.silent(&["core", "link", "sampler"], from..LATEST).silent(&["guardian"], STOP + 1..LATEST)
    };
    scene(STOP - 1).and("guardian", STOP, Event::Listened).ends(
        End::Died,
        Culprit::Death,
        "Pinion died at most 50.0 ms after the core's last event (the last command was queue_step): look for a panic in its log, and for who killed it (dmesg: out of memory)",
    );
    let hung = |scene: Scene, culprit, text: &str| {
        let diagnosis = "the core had no heartbeat for 1000 ms".to_owned();
        scene.and("guardian", STOP, Event::Listened).ends(End::Hung { diagnosis }, culprit, text);
    };
    // It was stopped, and so was everything of it.
    hung(
        scene(STOP - 900_000),
        Culprit::Standstill,
        "Pinion hung: Pinion stood still for 950.0 ms, and the guardian went on: find out who stopped it (SIGSTOP, a frozen control group), or which real-time work had all processors",
    );
    let core_only = Scene::calm().and("core", STOP - SECOND, STEP).silent(&["core"], STOP - 990_000..LATEST);
    let core_only = core_only.silent(&["link", "sampler", "guardian"], STOP + 1..LATEST);
    hung(
        core_only,
        Culprit::Driver,
        "Pinion hung: one call to a driver or the kernel kept the core for 1.0 s: look for its device in dmesg",
    );
    let pending = Scene::calm().silent(&["core", "link", "sampler", "guardian"], STOP + 1..LATEST);
    hung(pending, Culprit::Death, "Pinion hung: the core had no heartbeat for 1000 ms: report it with its log");
}

#[test]
fn a_program_that_works_is_reported_with_its_latest_timer() {
    let asked = |scene: Scene, culprit, text: &str| {
        scene.silent(&["core", "link", "sampler", "guardian"], STOP + 1..LATEST).ends(End::Asked, culprit, text);
    };
    asked(Scene::calm(), Culprit::Nobody, "nobody was late; the core was never later than 0.1 ms");
    let late = Scene::calm().and("core", 5 * SECOND, woke(50, 12)).and("core", 5 * SECOND, late(12));
    asked(
        late.clone().account_at(5 * SECOND, Watched::Core, 3, 12),
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: other real-time work had it (5.0 s before the end of the recording): look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
    );
    asked(
        late.silent(&["sampler"], 0..LATEST),
        Culprit::Unknown,
        "it is unknown why a timer was 12.0 ms late (5.0 s before the end of the recording)",
    );
    asked(Scene::default(), Culprit::Unknown, "no timer is in the recording: nobody can have been late");
}
