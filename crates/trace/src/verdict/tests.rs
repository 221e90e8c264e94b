// SPDX-License-Identifier: GPL-3.0-or-later
//! A verdict for each cause, over made-up recordings.

use std::ops::Range;

use pinion_firmware::time::Clock;
use pinion_protocol::block::Refusal;
use proptest::prelude::*;

use super::*;
use crate::event::{Event, PowerFault, Watched};
use crate::file::SSH;
use crate::file::tests::trace;

/// When the MCU stops, in microseconds.
const STOP: u64 = 10_000_000;
const LATEST: u64 = 11_000_000;
const SECOND: u64 = 1_000_000;
/// The number of the block that the core runs then.
const BLOCK: u32 = 500;
const STEP: Event = Event::Command { id: 5, more: 0 };
const TOO_CLOSE: &str = "Timer too close";
const MISSED_PWM: &str = "Missed scheduling of next hard pwm event";
const TROUBLE: &str = "stepper oid 3: some trouble: do something";

fn ms(ms: u32) -> Ticks {
    Ticks::from_ms(ms)
}

fn late(ms: u32) -> Event {
    Event::Late { oid: Some(3), late: Ticks::from_ms(ms) }
}

fn woke(slept: u32, late: u32) -> Event {
    Event::Woke { slept: ms(slept), late: ms(late) }
}

fn due(us: u64) -> Event {
    Event::Due(Clock::from_ticks(us * 50))
}

fn processor(thread: Watched, ran: u32, waited: u32) -> Event {
    Event::Processor { thread, ran: ms(ran), waited: ms(waited) }
}

fn looked(again: u32) -> Event {
    Event::Looked { again: ms(again), all: true }
}

/// The recording of a program that works, with a host that is there.
#[derive(Clone, Default)]
struct Scene(Vec<(&'static str, u64, Event)>);

impl Scene {
    fn calm() -> Scene {
        let mut scene = Scene::default();
        for at in (50_000..LATEST).step_by(100_000) {
            scene.0.push(("core", at, woke(100, 0)));
            scene.0.push(("core", at, Event::Pace { worst: Ticks::from_us(80) }));
        }
        for at in (60_000..LATEST).step_by(250_000) {
            scene.0.push(("sampler", at, processor(Watched::Core, 3, 0)));
            scene.0.push(("sampler", at, processor(Watched::Link, 1, 0)));
            scene.0.push(("sampler", at, looked(250)));
        }
        for at in (550_000..LATEST).step_by(550_000) {
            scene.0.push(("guardian", at, Event::Listened));
        }
        // A host asks for the clock.
        for (number, at) in (600_000..STOP - SECOND / 2).step_by(SECOND as usize).enumerate() {
            scene.0.push(("link", at, Event::BlockIn(number as u32)));
            scene.0.push(("core", at, Event::Block(number as u32)));
        }
        scene
    }

    /// The same without the events of these threads in this span.
    fn silent(mut self, threads: &[&str], span: Range<u64>) -> Scene {
        self.0.retain(|(thread, at, _)| !threads.contains(thread) || !span.contains(at));
        self
    }

    fn and(mut self, thread: &'static str, at: u64, event: Event) -> Scene {
        self.0.push((thread, at, event));
        self
    }

    /// The kernel's account of a thread in the first sample after a time.
    fn account_at(mut self, time: u64, thread: Watched, ran: u32, waited: u32) -> Scene {
        let is_sample = |event: &Event| matches!(event, Event::Processor { thread: of, .. } if *of == thread);
        let mut samples = self.0.iter_mut().filter(|(_, at, event)| *at >= time && is_sample(event));
        samples.next().unwrap().2 = processor(thread, ran, waited);
        self
    }

    /// The same in the sample that covers the stop.
    fn account(self, thread: Watched, ran: u32, waited: u32) -> Scene {
        self.account_at(STOP, thread, ran, waited)
    }

    /// The MCU stops because of an event that was due then.
    fn stop(self, block: u32, at: u64) -> Scene {
        let mut scene = self.and("core", STOP, Event::Stopped { block }).and("core", STOP, due(at));
        scene.0.retain(|(thread, at, _)| *at <= STOP || ["sampler", "guardian"].contains(thread));
        scene
    }

    /// The block came, and the core began it and ran a step of it.
    fn block(self, came: u64, begun: u64) -> Scene {
        self.and("link", came, Event::BlockIn(BLOCK)).and("core", begun, Event::Block(BLOCK)).and("core", begun, STEP)
    }

    fn trace(mut self, end: End) -> Trace {
        self.0.sort_by_key(|(_, at, _)| *at);
        let mut threads: Vec<(&str, Vec<(u64, Event)>)> = Vec::new();
        for (thread, at, event) in self.0 {
            match threads.iter_mut().find(|(name, _)| *name == thread) {
                Some((_, events)) => events.push((at, event)),
                None => threads.push((thread, vec![(at, event)])),
            }
        }
        let threads: Vec<(&str, &[(u64, Event)])> =
            threads.iter().map(|(name, events)| (*name, events.as_slice())).collect();
        trace(end, &threads)
    }

    #[track_caller]
    fn judged_over(self, wire: &str, culprit: Culprit, text: &str) {
        self.judged_for_over(MISSED_PWM, wire, culprit, text);
    }

    #[track_caller]
    fn judged_for_over(self, reason: &str, wire: &str, culprit: Culprit, text: &str) {
        let mut trace = self.trace(End::Shutdown { reason: reason.into(), trouble: TROUBLE.into() });
        trace.head.wire = Some(wire.into());
        let told = verdict(&trace);
        assert_eq!((told.culprit, told.text.as_str()), (culprit, text));
    }

    #[track_caller]
    fn judged(self, reason: &str, culprit: Culprit, text: &str) {
        let end = End::Shutdown { reason: reason.into(), trouble: TROUBLE.into() };
        self.told(end, culprit, text);
    }

    #[track_caller]
    fn told(self, end: End, culprit: Culprit, text: &str) {
        let told = verdict(&self.trace(end));
        assert_eq!((told.culprit, told.text.as_str()), (culprit, text));
    }
}

#[test]
fn a_host_that_is_late_is_accused() {
    let came = |came: u64, at: u64| Scene::calm().block(came, STOP - 100).stop(BLOCK, at);
    came(STOP - 200, STOP - 38_200).judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms: look at the host's load",
    );
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
fn a_link_that_waits_for_a_processor_makes_a_block_late() {
    let scene = || Scene::calm().block(STOP - 200, STOP - 100).account(Watched::Core, 2, 1).stop(BLOCK, STOP - 38_200);
    scene().account(Watched::Link, 1, 37).judged(
        TOO_CLOSE,
        Culprit::Processors,
        "the link to the host waited 37.0 ms for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
    );
    scene().account(Watched::Link, 1, 5).judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms: look at the host's load",
    );
}

#[test]
fn a_block_that_waits_for_a_bus_is_told_with_the_bus() {
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
    scene(STOP - 60_000).judged(
        TOO_CLOSE,
        Culprit::Bus,
        "spi0 took 41.0 ms for one job (stepper oid 3), and the host's commands waited for it: use a higher rate, or another bus for the device",
    );
    // The core had no room for the block, because it was held: the host had sent it in time.
    scene(STOP - 8_000).and("link", STOP - 45_000, Event::Full).judged(
        TOO_CLOSE,
        Culprit::Bus,
        "spi0 took 41.0 ms for one job (stepper oid 3), and the host's commands waited for it: use a higher rate, or another bus for the device",
    );
    // The host sent it when the bus was free again, because it had waited for an acknowledgement.
    scene(STOP - 8_000).judged(
        TOO_CLOSE,
        Culprit::Bus,
        "spi0 took 41.0 ms for one job (stepper oid 3), and the host's commands waited for it: use a higher rate, or another bus for the device",
    );
    // It could have sent it earlier, as it did while the bus was busy.
    scene(STOP - 12_000).judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came 8.0 ms after the step it was for; the core was never later than 0.1 ms: look at the host's load",
    );
}

#[test]
fn a_core_that_waits_for_a_processor_is_told_with_the_reason() {
    let scene = || {
        Scene::calm()
            .and("core", STOP - 1, woke(50, 12))
            .and("core", STOP - 1, late(12))
            .account(Watched::Core, 3, 12)
            .stop(7, STOP - 12_000)
    };
    let past = "Stepper too far in past";
    scene().judged(
        past,
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
    );
    scene().and("core", STOP - 30_000, Event::Scheduling { fifo: false }).judged(
        past,
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: it had used up its real-time share: lower the speed, or free it of the limit (sysctl kernel.sched_rt_runtime_us=-1)",
    );
    // Back in time.
    scene()
        .and("core", STOP - 40_000, Event::Scheduling { fifo: false })
        .and("core", STOP - 30_000, Event::Scheduling { fifo: true })
        .judged(
            past,
            Culprit::Processors,
            "the core waited 12.0 ms for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
        );
    scene().and("core", SECOND, Event::Scheduling { fifo: false }).judged(
        past,
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: it may not run in real time: do what the log's warning about real time says",
    );
    let ordinary = scene().and("core", STOP - 30_000, Event::Scheduling { fifo: false });
    let mut ordinary = ordinary.trace(End::Shutdown { reason: past.into(), trouble: TROUBLE.into() });
    ordinary.head.realtime = false;
    let told = verdict(&ordinary);
    assert_eq!(
        told.text,
        "the core waited 12.0 ms for a processor: it does not run in real time: run Pinion in real time (-r, as the service does)"
    );
    // A block that came in time waits as well.
    scene().block(STOP - 13_000, STOP - 1).stop(BLOCK, STOP - 11_000).judged(
        TOO_CLOSE,
        Culprit::Processors,
        "the core waited 12.0 ms for a processor: other real-time work had it: look for that (ps -eLo rtprio,comm), or give the core a processor of its own",
    );
}

#[test]
fn a_kernel_that_wakes_the_core_late_is_told_from_a_busy_processor() {
    Scene::calm()
        .and("core", STOP - 1, woke(50, 12))
        .account(Watched::Core, 3, 0)
        .stop(7, STOP - 12_000)
        .judged(
            "Stepper too far in past",
            Culprit::Driver,
            "the kernel woke the core 12.0 ms late, though it did not wait for a processor: use a PREEMPT_RT kernel, and look for what blocks interrupts, such as a hypervisor",
        );
}

#[test]
fn a_call_that_takes_long_is_told_from_a_flood_of_work() {
    let past = "Rescheduled timer in the past";
    let busy = |ran| Scene::calm().silent(&["core"], STOP - 149_999..STOP).account(Watched::Core, ran, 1);
    busy(150).and("core", STOP - 150_000, STEP).and("core", STOP - 1, late(120)).stop(7, STOP - 120_000).judged(
        past,
        Culprit::Driver,
        "one call to a driver or the kernel kept the core for 120.0 ms: look for its device in dmesg",
    );
    // A call that sleeps, while the link goes on.
    busy(2).and("core", STOP - 150_000, STEP).and("link", STOP - 80_000, Event::Out(9)).stop(7, STOP - 120_000).judged(
        past,
        Culprit::Driver,
        "one call to a driver or the kernel kept the core for 120.0 ms: look for its device in dmesg",
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
        .judged(
            past,
            Culprit::Standstill,
            "everything stood still for 380.0 ms: find out who stopped Pinion, or paused or suspended the computer",
        );
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
        "everything stood still for 380.0 ms: find out who stopped Pinion, or paused or suspended the computer",
    );
    // Something went on meanwhile.
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
    noticed(STOP - 5 * SECOND, &OURS).told(
        end("Pinion stood still for 5000 ms"),
        Culprit::Standstill,
        "Pinion stood still for 4.9 s, and the guardian went on: find out who stopped it (SIGSTOP, a frozen control group)",
    );
    // The clock stood still, too.
    noticed(STOP - 1, &[]).told(
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
    often.stop(7, STOP - 12_000).judged(
        "Stepper too far in past",
        Culprit::Driver,
        "the kernel woke the core 12.0 ms late, though it did not wait for a processor: use a PREEMPT_RT kernel, and look for what blocks interrupts, such as a hypervisor",
    );
    stolen.and("sampler", STOP + 10_000, Event::Stolen(ms(14))).stop(7, STOP - 12_000).judged(
        "Stepper too far in past",
        Culprit::Standstill,
        "a hypervisor took 14.0 ms of processor time while an event waited: give this virtual machine processors of its own",
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
    hangs.clone().silent(&["core", "sampler", "guardian"], STOP + 1..LATEST).told(End::Asked, Culprit::Bus, text);
    // An output waits for its refresh behind it.
    hangs.and("link", STOP - 4 * SECOND, Event::BlockIn(8)).stop(7, STOP - 1000).judged(MISSED_PWM, Culprit::Bus, text);
    let told = Scene::calm().and("core", STOP, Event::Stopped { block: 7 });
    told.judged("Bus does not answer", Culprit::Bus, &format!("a bus did not answer: {TROUBLE}"));
}

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
    over.judged(
        TOO_CLOSE,
        Culprit::Host,
        "the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms: look at the host's load",
    );
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

#[test]
fn a_host_that_is_silent_or_gone_is_told() {
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
        "the host sent no commands for 4.4 s, but it still asked for the clock; the core was never later than 0.1 ms: look at its log, and at its load",
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
fn a_wire_that_is_cut_is_told_by_its_name() {
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
        "the host sent no commands for 4.4 s, but it still asked for the clock; the core was never later than 0.1 ms: look at its log, and at its load",
    );
}

#[test]
fn a_network_that_is_gone_is_told_from_a_host_that_hangs() {
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
fn an_input_that_ends_tells_whether_anything_came_before() {
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
fn a_program_that_is_gone_is_told_with_what_it_did_last() {
    let scene = |from: u64| {
        let scene = Scene::calm().and("core", STOP - SECOND, STEP);
        scene.silent(&["core", "link", "sampler"], from..LATEST).silent(&["guardian"], STOP + 1..LATEST)
    };
    scene(STOP - 1).and("guardian", STOP, Event::Listened).told(
        End::Died,
        Culprit::Death,
        "Pinion died at most 50.0 ms after the core's last event (the last command was queue_step): look for a panic in its log, and for who killed it (dmesg: out of memory)",
    );
    let hung = |scene: Scene, culprit, text: &str| {
        let diagnosis = "the core had no heartbeat for 1000 ms".to_owned();
        scene.and("guardian", STOP, Event::Listened).told(End::Hung { diagnosis }, culprit, text);
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
fn a_program_that_works_is_told_with_its_latest_timer() {
    let asked = |scene: Scene, culprit, text: &str| {
        scene.silent(&["core", "link", "sampler", "guardian"], STOP + 1..LATEST).told(End::Asked, culprit, text);
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
        "not known why a timer was 12.0 ms late (5.0 s before the end of the recording)",
    );
    asked(Scene::default(), Culprit::Unknown, "no timer is in the recording: nobody can have been late");
}

/// Without what proves it, nobody is accused.
#[test]
fn a_verdict_needs_evidence() {
    let bare = |at: u64| Scene::default().stop(BLOCK, at);
    bare(STOP - 12_000).judged(
        TOO_CLOSE,
        Culprit::Unknown,
        "an event was asked for 12.0 ms after its time; not known when its block came",
    );
    // Only a later block is known: it proves that this one came in time, but not that it came late.
    let later = |came| bare(STOP - 12_000).and("link", came, Event::BlockIn(BLOCK + 1));
    later(STOP - 1_000).judged(
        TOO_CLOSE,
        Culprit::Unknown,
        "an event was asked for 12.0 ms after its time; not known when its block came",
    );
    later(STOP - 30_000).judged(
        TOO_CLOSE,
        Culprit::Unknown,
        "not known who was late: the host's block came 18.0 ms before its event, and the core ran it 12.0 ms after the event",
    );
    for reason in ["Stepper too far in past", "Rescheduled timer in the past"] {
        bare(STOP - 12_000).judged(
            reason,
            Culprit::Unknown,
            &format!("not known why an event was 12.0 ms late: {TROUBLE}"),
        );
    }
    bare(STOP - 100).judged(
        MISSED_PWM,
        Culprit::Unknown,
        &format!("not known when the host sent something: {TROUBLE}"),
    );
    // The events of the rings' beginnings are lost, and with them the time.
    for reason in [TOO_CLOSE, MISSED_PWM] {
        Scene::calm().judged(reason, Culprit::Unknown, &format!("not known who was late: {TROUBLE}"));
    }
}

fn any_end() -> impl Strategy<Value = End> {
    let texts = ["Timer too close", MISSED_PWM, "Rescheduled timer in the past", "Bus does not answer", "x"];
    let shutdown = proptest::sample::select(texts.to_vec())
        .prop_map(|reason| End::Shutdown { reason: reason.into(), trouble: "t".into() });
    prop_oneof![shutdown, Just(End::Died), Just(End::Hung { diagnosis: "d".into() }), Just(End::Asked)]
}

fn any_events() -> impl Strategy<Value = Vec<(Clock, Event)>> {
    let near = (1u64 << 32)..(1 << 32) + 2_000_000_000;
    let at = prop_oneof![3 => near.clone(), 1 => 0u64..1 << 56];
    let payload =
        prop_oneof![any::<u64>(), near, (0u64..3, 0u64..100_000_000).prop_map(|(low, high)| low | high << 32)];
    let event = (at, 0u64..61, payload).prop_map(|(at, kind, payload)| Event::decode([at << 8 | kind, payload]));
    prop::collection::vec(event, 0..60).prop_map(|events| events.into_iter().flatten().collect())
}

proptest! {
    /// Any events get a verdict of one line.
    #[test]
    fn no_events_make_it_panic(
        end in any_end(),
        ended_at in prop_oneof![any::<u64>(), (1u64 << 32)..(1 << 33)],
        threads in prop::collection::vec(
            (proptest::sample::select(vec!["core", "link", "sampler", "guardian", "spi0"]), any_events()),
            0..6,
        ),
    ) {
        let mut trace = trace(end, &[]);
        trace.head.ended_at = ended_at;
        trace.threads = threads.into_iter()
            .map(|(name, events)| crate::file::Thread { name: name.into(), events })
            .collect();
        let verdict = verdict(&trace);
        prop_assert!(!verdict.text.is_empty() && !verdict.text.contains('\n'));
    }
}
