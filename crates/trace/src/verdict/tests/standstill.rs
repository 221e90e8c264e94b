// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion, the guardian or the whole computer stands still.

use super::*;

const ALL_STOOD: &str =
    "everything stood still for 380.0 ms: find out who stopped Pinion, or paused or suspended the computer";

#[test]
fn a_standstill_is_named_with_the_threads_that_went_on() {
    const OURS: [&str; 3] = ["core", "link", "sampler"];
    let past = "Rescheduled timer in the past";
    let stood = |threads: &[&str]| {
        Scene::calm()
            .silent(threads, STOP - 900_000..STOP)
            .and("core", STOP - 1, woke(950, 850))
            .account(Watched::Core, 3, 0)
            .stop(7, STOP - 850_000)
    };
    stood(&OURS).judged(
        past,
        Culprit::Standstill,
        "Pinion stood still for 850.0 ms, and the guardian went on: find out who stopped it (SIGSTOP, a frozen control group)",
    );
    stood(&["core", "link", "sampler", "guardian"]).judged(
        past,
        Culprit::Standstill,
        "Pinion and its guardian stood still for 850.0 ms: find out who stopped both (a frozen control group), or paused or suspended the computer",
    );
    // The guardian would not have listened in so short a time.
    Scene::calm()
        .silent(&["core", "link", "sampler", "guardian"], STOP - 400_000..STOP)
        .and("core", STOP - 1, woke(400, 400))
        .account(Watched::Core, 3, 0)
        .stop(7, STOP - 380_000)
        .judged(past, Culprit::Standstill, ALL_STOOD);
    // A calm program is sampled less often, and the sampler does not miss its time.
    let calm = |stood_from: u64| {
        let scene = Scene::calm().silent(&["sampler"], STOP - 1_200_000..STOP);
        let scene = scene.and("sampler", STOP - 400_000, processor(Watched::Core, 3, 0));
        let scene = scene.and("sampler", STOP - 400_000, looked(500));
        scene.silent(&["core", "link", "guardian"], stood_from..STOP).account(Watched::Core, 3, 0)
    };
    calm(STOP - 390_000).and("core", STOP - 1, woke(390, 380)).stop(7, STOP - 380_000).judged(
        past,
        Culprit::Standstill,
        ALL_STOOD,
    );
    // The link still sent something.
    let late = calm(STOP - 390_000).and("core", STOP - 1, woke(390, 380));
    late.and("link", STOP - 200_000, Event::Out(9)).stop(7, STOP - 380_000).judged(
        past,
        Culprit::Driver,
        "the kernel woke the core 380.0 ms late, though it did not wait for a processor: use a PREEMPT_RT kernel, and look for what blocks interrupts, such as a hypervisor",
    );
    // The core notices it by itself: then no event is the cause.
    let end = |trouble: &str| End::Shutdown { reason: past.into(), trouble: trouble.into() };
    let noticed = |from: u64, threads: &[&str]| {
        let scene = Scene::calm().silent(threads, from..STOP).and("core", STOP - 1, woke(5000, 4900));
        let scene = scene.account(Watched::Core, 3, 0).and("core", STOP, Event::Stopped { block: 7 });
        scene.silent(&["core"], STOP + 1..LATEST)
    };
    noticed(STOP - 5 * SECOND, &OURS).ends(
        end("Pinion stood still for 5000 ms"),
        Culprit::Standstill,
        "Pinion stood still for 4.9 s, and the guardian went on: find out who stopped it (SIGSTOP, a frozen control group)",
    );
    // The clock stood still, too.
    noticed(STOP - 1, &[]).ends(
        end("the computer was suspended for 60000 ms with outputs in use: keep it from that"),
        Culprit::Standstill,
        "everything stood still: the computer was suspended for 60000 ms with outputs in use: keep it from that",
    );
    // A virtual machine that did not get a processor.
    let stolen = Scene::calm().and("core", STOP - 1, woke(50, 12)).account(Watched::Core, 3, 1);
    let mut often = stolen.clone();
    for at in (60_000..STOP + SECOND / 2).step_by(250_000) {
        often = often.and("sampler", at, Event::Stolen(ms(14)));
    }
    often.stop(7, STOP - 12_000).judged("Stepper too far in past", Culprit::Driver, WOKEN_LATE);
    stolen.and("sampler", STOP + 10_000, Event::Stolen(ms(14))).stop(7, STOP - 12_000).judged(
        "Stepper too far in past",
        Culprit::Standstill,
        "a hypervisor took 14.0 ms of processor time while an event waited: give this virtual machine processors of its own",
    );
}
