// SPDX-License-Identifier: GPL-3.0-or-later
//! A verdict for each cause, over made-up recordings. Each kind of cause has a file, as in the code.

mod bus;
mod death;
mod host;
mod power;
mod processors;
mod standstill;

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
const HOST_LATE: &str = "the host's block came 38.0 ms after the step it was for; the core was never later than 0.1 ms: look at the host's load";
const WOKEN_LATE: &str = "the kernel woke the core 12.0 ms late, though it did not wait for a processor: use a PREEMPT_RT kernel, and look for what blocks interrupts, such as a hypervisor";
const BLOCK_UNKNOWN: &str = "the host asked for an event 12.0 ms after its time; it is unknown when its block came";

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
        let found = verdict(&trace);
        assert_eq!((found.culprit, found.text.as_str()), (culprit, text));
    }

    #[track_caller]
    fn judged(self, reason: &str, culprit: Culprit, text: &str) {
        let end = End::Shutdown { reason: reason.into(), trouble: TROUBLE.into() };
        self.ends(end, culprit, text);
    }

    #[track_caller]
    fn ends(self, end: End, culprit: Culprit, text: &str) {
        let found = verdict(&self.trace(end));
        assert_eq!((found.culprit, found.text.as_str()), (culprit, text));
    }
}

/// Without evidence the verdict accuses nobody.
#[test]
fn a_verdict_needs_evidence() {
    let bare = |at: u64| Scene::default().stop(BLOCK, at);
    bare(STOP - 12_000).judged(TOO_CLOSE, Culprit::Unknown, BLOCK_UNKNOWN);
    // Only a later block is known: it proves that this one came in time, but not that it came late.
    let later = |came| bare(STOP - 12_000).and("link", came, Event::BlockIn(BLOCK + 1));
    later(STOP - 1_000).judged(TOO_CLOSE, Culprit::Unknown, BLOCK_UNKNOWN);
    later(STOP - 30_000).judged(
        TOO_CLOSE,
        Culprit::Unknown,
        "it is unknown who was late: the host's block came 18.0 ms before its event, and the core ran it 12.0 ms after the event",
    );
    for reason in ["Stepper too far in past", "Rescheduled timer in the past"] {
        bare(STOP - 12_000).judged(
            reason,
            Culprit::Unknown,
            &format!("it is unknown why an event was 12.0 ms late: {TROUBLE}"),
        );
    }
    bare(STOP - 100).judged(
        MISSED_PWM,
        Culprit::Unknown,
        &format!("it is unknown when the host sent something: {TROUBLE}"),
    );
    // The events of the rings' beginnings are lost, and with them the time.
    for reason in [TOO_CLOSE, MISSED_PWM] {
        Scene::calm().judged(reason, Culprit::Unknown, &format!("it is unknown who was late: {TROUBLE}"));
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
