// SPDX-License-Identifier: GPL-3.0-or-later
//! A trace as a person sees it: what each thread did, from when to when, in words. All exports are made from it.

use std::collections::{BTreeMap, HashMap};

use pinion_firmware::time::{CLOCK_FREQ, Ticks};
use pinion_protocol::block::Refusal;

use super::event::{Event, PowerFault};
use super::file::{End, Head, Trace};
use pinion_linux::foreign::plain;

/// Ticks in a millisecond.
pub(super) const TICKS_PER_MS: i64 = CLOCK_FREQ as i64 / 1000;

/// The deeds of each thread.
pub(super) struct History<'a> {
    head: &'a Head,
    /// The threads in the order of the trace. Each name comes once.
    pub lanes: Vec<Lane<'a>>,
    /// When the last event happened, or 0. The recording goes on after a stop, as outputs change then.
    pub last: i64,
}

/// The deeds of a thread, in the order in which they ended.
pub(super) struct Lane<'a> {
    /// Its name. It may contain anything.
    pub thread: &'a str,
    pub deeds: Vec<Deed>,
}

/// An output whose edges are recorded.
pub(super) struct Output {
    pub pin: u32,
    /// Whether the host sets its level, as that of a heater, a fan or the enable pin of a motor. The steps of a motor
    /// are not set one by one.
    pub is_set: bool,
    /// Its level is unknown before this time.
    pub known: i64,
    /// When it was high. The last span may have no end ([`i64::MAX`]).
    pub highs: Vec<(i64, i64)>,
    /// Its last edge.
    pub changed: i64,
}

/// Something that a thread did or met. Times are ticks, relative to the end of the recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Deed {
    /// Its beginning, at or before `to`. A late timer began at its due time, a block when it came from the host.
    pub from: i64,
    /// Its end.
    pub to: i64,
    /// The event at its end. The event at its beginning, if no event is its end.
    pub event: Event,
    /// How long it waited before it began.
    pub waited: Ticks,
}

impl Deed {
    /// How long it lasted.
    pub fn ticks(&self) -> u64 {
        self.to.abs_diff(self.from)
    }

    /// Whether no event is its end. It seems to last until the end of the recording.
    pub fn is_open(&self) -> bool {
        matches!(self.event, Event::Held | Event::JobBegan { .. })
    }
}

impl<'a> History<'a> {
    pub fn of(trace: &'a Trace) -> History<'a> {
        let end = trace.ended_at();
        let mut threads: Vec<(&str, Vec<(i64, Event)>)> = Vec::new();
        for thread in &trace.threads {
            let events = thread.events.iter().map(|(at, event)| (at.since(end), *event));
            match threads.iter_mut().find(|(name, _)| *name == thread.name) {
                Some((_, all)) => all.extend(events),
                None => threads.push((&thread.name, events.collect())),
            }
        }
        let mut came = HashMap::new();
        for (at, event) in threads.iter().flat_map(|(_, events)| events) {
            if let Event::BlockIn(number) = event {
                came.insert(*number, *at);
            }
        }
        let last = threads.iter().flat_map(|(_, events)| events).map(|(at, _)| *at).max().unwrap_or(0).max(0);
        let lanes = threads.into_iter().map(|(thread, mut events)| {
            events.sort_by_key(|(at, _)| *at);
            Lane { thread, deeds: deeds(&events, &came, last) }
        });
        History { head: &trace.head, lanes: lanes.collect(), last }
    }

    /// All deeds with the numbers of their lanes.
    pub fn deeds(&self) -> impl Iterator<Item = (usize, &Deed)> {
        self.lanes.iter().enumerate().flat_map(|(lane, all)| all.deeds.iter().map(move |deed| (lane, deed)))
    }

    /// When the core was awake: between its sleeps. Its next sleep is not recorded, so the last span ends at its last event.
    pub fn awake(&self) -> Vec<(i64, i64)> {
        let core = self.core();
        let sleeps: Vec<&Deed> = core.iter().filter(|deed| matches!(deed.event, Event::Woke { .. })).collect();
        let ends = sleeps.iter().skip(1).map(|next| next.from).chain(core.last().map(|deed| deed.to));
        sleeps.iter().zip(ends).map(|(sleep, end)| (sleep.to, end.max(sleep.to))).collect()
    }

    /// The lane of the core; empty if there is none.
    pub fn core(&self) -> &[Deed] {
        self.lanes.iter().find(|lane| lane.thread == "core").map_or(&[], |lane| &lane.deeds)
    }

    /// The outputs in the order of their pins.
    pub fn outputs(&self) -> Vec<Output> {
        let mut all: BTreeMap<u32, Vec<(i64, bool)>> = BTreeMap::new();
        for (_, deed) in self.deeds() {
            if let Event::Edge { pin, level } = deed.event {
                all.entry(pin).or_default().push((deed.to, level));
            }
        }
        let begin = all.values().flatten().map(|(at, _)| *at).min().unwrap_or(0);
        // The first edge of a line is its first level. It comes before the MCU is configured. Any other edge is a change.
        let configured = |deed: &&Deed| matches!(deed.event, Event::Configured | Event::Reset);
        let configured = self.core().iter().rfind(configured).map_or(i64::MIN, |deed| deed.to);
        let outputs = all.into_iter().map(|(pin, mut edges)| {
            edges.sort_by_key(|(at, _)| *at);
            let (first, level) = edges[0];
            let known = if first > configured { begin.max(configured) } else { first };
            if known < first {
                edges.insert(0, (known, !level));
            }
            let ends = edges.iter().skip(1).map(|(at, _)| *at).chain([i64::MAX]);
            let highs = edges.iter().zip(ends).filter(|((_, level), _)| *level);
            Output {
                pin,
                is_set: self.is_set(pin),
                known,
                highs: highs.map(|((at, _), end)| (*at, end.max(*at))).collect(),
                changed: edges.last().map_or(first, |(at, _)| *at),
            }
        });
        outputs.collect()
    }

    /// Whether a pin belongs to a digital output of the host.
    fn is_set(&self, pin: u32) -> bool {
        let Some(name) = self.head.names.pins.get(&pin) else { return false };
        let of_pin = format!(" ({name})");
        self.head
            .names
            .objects
            .values()
            .any(|object| object.starts_with("digital output ") && object.ends_with(&of_pin))
    }

    /// When the MCU stopped for the last time.
    pub fn stopped(&self) -> Option<i64> {
        self.core().iter().rfind(|deed| matches!(deed.event, Event::Stopped { .. })).map(|deed| deed.to)
    }

    /// The time that the last stop was about.
    pub fn due(&self) -> Option<i64> {
        let due = |deed: &Deed| match deed.event {
            Event::Due(at) => Some(at.to_bits().wrapping_sub(self.head.ended_at) as i64),
            _ => None,
        };
        self.core().iter().rev().find_map(due)
    }

    /// The name of an object, for one line. `None`: the MCU itself.
    pub fn object(&self, oid: Option<u8>) -> String {
        oid.map_or_else(|| "the MCU".to_owned(), |oid| named(self.head.names.objects.get(&oid), "oid", oid.into()))
    }

    /// The name of a command, for one line.
    pub fn command(&self, id: i16) -> String {
        named(self.head.names.commands.get(&id), "command", id.into())
    }

    /// The name of a pin, for one line.
    pub fn pin(&self, pin: u32) -> String {
        named(self.head.names.pins.get(&pin), "pin", pin.into())
    }

    /// The cause of the recording's end, in one line.
    pub fn end(&self) -> String {
        match &self.head.end {
            End::Shutdown { reason, .. } => format!("the MCU stopped: {}", cut(reason, REASON_MAX)),
            End::Died => "the program died".to_owned(),
            End::Hung { diagnosis } => format!("the core hung: {}", cut(diagnosis, REASON_MAX)),
            End::Asked => "somebody asked for the recording".to_owned(),
        }
    }

    /// A deed in words.
    pub fn words(&self, deed: &Deed) -> String {
        let span = ms(deed.ticks());
        match deed.event {
            Event::Omitted(count) => format!("{count} events came too fast and are not recorded"),
            Event::Woke { slept, late } => {
                format!("slept {} ms, woke {} ms late", ms(slept.0.into()), ms(late.0.into()))
            }
            Event::Late { oid, late } => format!("{} ran {} ms late", self.object(oid), ms(late.0.into())),
            Event::Pace { worst, .. } => format!("no timer was later than {} ms", ms(worst.0.into())),
            Event::Block(number) if deed.ticks() == 0 => format!("began block {number}"),
            Event::Block(number) => format!("began block {number}, which waited {span} ms"),
            Event::Command { id, more: 0 } => self.command(id),
            Event::Command { id, more } => format!("{} and {more} more commands", self.command(id)),
            Event::Held => format!("commands wait for a bus. They waited {span} ms until the recording ended"),
            Event::Released => format!("commands waited {span} ms for a bus"),
            Event::Configured => "a host configured the MCU".to_owned(),
            Event::Reset => "the MCU has no configuration".to_owned(),
            Event::Stopped { block } => format!("the MCU stopped in block {block}"),
            Event::Due(at) => {
                let at = at.to_bits().wrapping_sub(self.head.ended_at) as i64;
                format!("the stop was about an event that was due at {} ms", at_ms(at))
            }
            Event::Scheduling { fifo: true } => "runs in real time (SCHED_FIFO)".to_owned(),
            Event::Scheduling { fifo: false } => "runs without real time (SCHED_OTHER)".to_owned(),
            Event::BlockIn(number) => format!("block {number} came from the host"),
            Event::Out(bytes) => format!("wrote {bytes} bytes to the host"),
            Event::HostCame if self.head.wire.is_some() => "a host came".to_owned(),
            Event::HostGone if self.head.wire.is_some() => "the host is gone".to_owned(),
            Event::HostCame => "a host opened the terminal".to_owned(),
            Event::HostGone => "the host closed the terminal".to_owned(),
            Event::Refused(Refusal::Garbage) => "garbage came from the host".to_owned(),
            Event::Refused(Refusal::Lost) => "a block came after one that was lost in garbage".to_owned(),
            Event::Refused(Refusal::Repeated) => {
                "the host sent a block again, without an acknowledgement of it in time".to_owned()
            }
            Event::Nak => "asked the host to send again what it had refused (NAK)".to_owned(),
            Event::Answered { id } => format!("answered {} without the core", self.command(id)),
            Event::Alive => "the host's computer sent a keepalive".to_owned(),
            Event::Full => "the core has no room for the host's blocks".to_owned(),
            Event::JobBegan { oid, .. } => {
                format!("works for {}. It did not end within {span} ms, when the recording ended", self.object(oid))
            }
            Event::JobEnded { oid, .. } => {
                let waited = match deed.waited {
                    Ticks(0) => String::new(),
                    Ticks(ticks) => format!(", after {} ms in the queue", ms(ticks.into())),
                };
                format!("worked {span} ms for {}{waited}", self.object(oid))
            }
            Event::Processor { thread, ran, waited } => {
                format!(
                    "the {thread} ran {} ms and waited {} ms for a processor",
                    ms(ran.0.into()),
                    ms(waited.0.into())
                )
            }
            Event::Looked { .. } => "looked at the kernel's accounts".to_owned(),
            Event::Stolen(ticks) => format!("a hypervisor took {} ms", ms(ticks.0.into())),
            Event::Power(Some(PowerFault::Undervoltage)) => "the supply's voltage is too low".to_owned(),
            Event::Power(Some(PowerFault::Hot)) => "the processor is too hot and slowed down".to_owned(),
            Event::Power(None) => "voltage and temperature are good".to_owned(),
            Event::Frequency { mhz, max_mhz } => format!("the processor runs at {mhz} MHz of {max_mhz} MHz"),
            Event::Listened => "the guardian listened".to_owned(),
            Event::Edge { pin, level } => format!("{} = {}", self.pin(pin), u8::from(level)),
        }
    }
}

/// Longest name of a thing, and longest reason of a stop, in letters. They come from files.
const NAME_MAX: usize = 60;
const REASON_MAX: usize = 200;

/// A name for one line of text.
pub(super) fn short(name: &str) -> String {
    cut(name, NAME_MAX)
}

pub(super) fn cut(text: &str, letters: usize) -> String {
    plain(text).chars().take(letters).collect()
}

fn named(name: Option<&String>, kind: &str, number: i64) -> String {
    name.filter(|name| !name.is_empty()).map_or_else(|| format!("{kind} {number}"), |name| short(name))
}

/// A span in ms, with as many decimals as are of interest.
pub(super) fn ms(ticks: u64) -> String {
    let ms = ticks as f64 / TICKS_PER_MS as f64;
    let decimals = if ms < 1.0 { 3 } else { usize::from(ms < 100.0) };
    format!("{ms:.decimals$}")
}

/// A time in ms, relative to the end of the recording.
pub(super) fn at_ms(at: i64) -> String {
    let ms = at as f64 / TICKS_PER_MS as f64;
    // Adding zero makes a zero of "-0".
    format!("{:.2}", (ms * 100.0).round() / 100.0 + 0.0)
}

/// The deeds in these events of a thread. `came`: when each block came. `end`: when the last event of all
/// threads happened.
fn deeds(events: &[(i64, Event)], came: &HashMap<u32, i64>, end: i64) -> Vec<Deed> {
    let mut deeds = Vec::with_capacity(events.len());
    let mut held = None;
    let mut job: Option<Deed> = None;
    for &(at, event) in events {
        let after = |span: Ticks| at.saturating_sub(span.0.into());
        let mut waited = Ticks(0);
        let from = match event {
            Event::Woke { slept, .. } => after(slept),
            Event::Late { late, .. } => after(late),
            Event::Block(number) => came.get(&number).map_or(at, |came| at.min(*came)),
            Event::Held => {
                held.get_or_insert(at);
                continue;
            }
            Event::Released => held.take().unwrap_or(at),
            Event::JobBegan { waited, .. } => {
                let began = Deed { from: at, to: end, event, waited };
                if let Some(lost) = job.replace(began) {
                    deeds.push(Deed { to: at, ..lost });
                }
                continue;
            }
            Event::JobEnded { took, .. } => match job.take() {
                Some(began) => {
                    waited = began.waited;
                    began.from
                }
                None => after(took),
            },
            _ => at,
        };
        deeds.push(Deed { from, to: at, event, waited });
    }
    deeds.extend(held.map(|from| Deed { from, to: end, event: Event::Held, waited: Ticks(0) }));
    deeds.extend(job);
    deeds
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::event::Watched;
    use super::super::file::Thread;
    use super::super::file::tests::trace;
    use super::*;
    use pinion_firmware::time::Clock;
    use pinion_testkit::names::any_name;
    use proptest::prelude::*;
    use std::io;

    /// A host's pause of 60 ms: a block comes 38 ms after the step that it is for. Before it a bus is busy for 12 ms.
    /// The recording ends at 1 s.
    pub(crate) fn late_host() -> Trace {
        let ms = |ms: u32| u64::from(ms) * 1000;
        let (mut recent, mut lasting, mut link, mut bus) = (vec![], vec![], vec![], vec![]);
        for wake in (500..997_500u64).step_by(500) {
            let late = Ticks(150 + (wake % 7) as u32 * 40);
            recent.push((wake, Event::Woke { slept: Ticks::from_us(450), late }));
        }
        let blocks = (5..935).step_by(10).chain([995]);
        for (number, at) in blocks.enumerate() {
            let number = number as u32;
            link.push((ms(at), Event::BlockIn(number)));
            link.push((ms(at) + 90, Event::Out(7)));
            recent.push((ms(at) + 60, Event::Block(number)));
            recent.push((ms(at) + 70, Event::Command { id: 5, more: 2 }));
            recent.push((ms(at) + 80, Event::Command { id: 9, more: 0 }));
            if at < 935 {
                for step in 0..8 {
                    recent.push((ms(at) + 1000 + step * 1000, Event::Edge { pin: 17, level: true }));
                    recent.push((ms(at) + 1002 + step * 1000, Event::Edge { pin: 17, level: false }));
                }
            }
        }
        for at in (2..900).step_by(20) {
            let took = if at == 882 { 12_000 } else { 400 };
            bus.push((ms(at), Event::JobBegan { oid: Some(7), waited: Ticks::from_us(20) }));
            bus.push((ms(at) + took, Event::JobEnded { oid: Some(7), took: Ticks::from_us(took as u32) }));
            lasting.push((ms(at), Event::Held));
            lasting.push((ms(at) + took, Event::Released));
        }
        bus.push((ms(990), Event::JobBegan { oid: Some(7), waited: Ticks(0) }));
        lasting.insert(0, (10, Event::Configured));
        lasting.insert(1, (20, Event::Scheduling { fifo: true }));
        lasting.push((ms(910), Event::Late { oid: Some(3), late: Ticks::from_us(310) }));
        lasting.push((995_100, Event::Stopped { block: 93 }));
        lasting.push((995_101, Event::Due(Clock::from_ticks(957_000 * 50))));
        link.insert(0, (5, Event::HostCame));
        let sampler = [250, 500, 750, 999].map(|at| {
            let waited = if at == 500 { Ticks::from_ms(3) } else { Ticks(900) };
            (ms(at), Event::Processor { thread: Watched::Core, ran: Ticks::from_ms(9), waited })
        });
        let end = [(ms(1000), Event::Listened)];
        let reason = End::Shutdown { reason: "Timer too close".into(), trouble: String::new() };
        let threads: [(&str, &[(u64, Event)]); 6] = [
            ("core", &recent),
            ("core", &lasting),
            ("link", &link),
            ("spi0", &bus),
            ("sampler", &sampler),
            ("guardian", &end),
        ];
        let mut trace = trace(reason, &threads);
        trace.head.names.objects.insert(7, "adxl345 oid 7".to_owned());
        trace.head.names.commands.insert(9, "set_next_step_dir".to_owned());
        trace
    }

    /// A print that stops at 0, after 1 s. 18 motors step; the first ones step last. A heater has PWM pulses. The
    /// recording has forgotten the edge of the fan, which has been on all the time. The outputs change 20 to 78 us after it.
    pub(crate) fn stopped_print() -> Trace {
        const STOP: u64 = 1_000_000;
        let edge = |at: u64, pin: u32, level: bool| (at, Event::Edge { pin, level });
        let mut edges = Vec::new();
        for pin in 0..18 {
            let at = STOP - 100 * (18 + u64::from(pin));
            edges.extend([edge(at, pin, true), edge(at + 2, pin, false)]);
        }
        for pulse in (10_000..STOP).step_by(50_000) {
            edges.extend([edge(pulse, 19, true), edge(pulse + 20_000, 19, false)]);
        }
        edges.extend([edge(STOP + 20, 20, false), edge(STOP + 78, 18, true)]);
        edges.sort_by_key(|(at, _)| *at);
        let core = [(5, Event::Configured), (STOP, Event::Stopped { block: 3 })];
        let sampler = [(STOP + 20_000, Event::Looked { again: Ticks::from_ms(500), all: true })];
        let reason = End::Shutdown { reason: "Command request".into(), trouble: "the host stopped the MCU".into() };
        let mut trace = trace(reason, &[("core", &core), ("edges", &edges), ("sampler", &sampler)]);
        trace.head.ended_at = Clock::from_ticks(STOP * 50).to_bits();
        let names = &mut trace.head.names;
        names.pins = (0..18).map(|pin| (pin, format!("step{pin}"))).collect();
        for (oid, name) in [(18, "x_enable"), (19, "heater"), (20, "fan")] {
            names.pins.insert(oid.into(), name.to_owned());
            names.objects.insert(oid, format!("digital output oid {oid} ({name})"));
        }
        trace
    }

    /// The text of an export.
    pub(crate) fn text(write: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> String {
        let mut text = Vec::new();
        write(&mut text).unwrap();
        String::from_utf8(text).unwrap()
    }

    /// A trace as a file may contain it: any names, times and numbers.
    pub(crate) fn any_trace() -> impl Strategy<Value = Trace> {
        let kind = prop::sample::select((1u8..=60).collect::<Vec<_>>());
        let at = prop_oneof![0u64..3_000_000, Just(0), any::<u64>()];
        let payload = prop_oneof![any::<u64>(), 0u64..100_000, (0u64..4, 0u64..4).prop_map(|(a, b)| a | b << 32)];
        let words = (at, kind, payload).prop_map(|(at, kind, payload)| [at << 8 | u64::from(kind), payload]);
        let events = prop::collection::vec(words, 0..150);
        let events = events.prop_map(|words| words.into_iter().filter_map(Event::decode).collect());
        let name = prop_oneof![
            Just("core".to_owned()),
            Just("link".to_owned()),
            Just("spi0".to_owned()),
            any_name(),
            Just("\u{fffe}]]>".repeat(50))
        ];
        let threads = prop::collection::vec((name, events).prop_map(|(name, events)| Thread { name, events }), 0..8);
        let ended_at = prop_oneof![0u64..3_000_000, any::<u64>()];
        (threads, ended_at, any_name(), any_name(), any_name()).prop_map(|(threads, ended_at, reason, name, link)| {
            let mut trace = late_host();
            trace.head.end = End::Shutdown { reason: reason.clone(), trouble: reason };
            trace.head.names.objects = (0..3).map(|oid| (oid, name.clone())).collect();
            trace.head.names.commands = (0..3).map(|id| (id, name.clone())).collect();
            trace.head.names.pins = (0..3).map(|pin| (pin, name.clone())).collect();
            trace.head.version = name;
            trace.head.link = link;
            trace.head.ended_at = ended_at;
            trace.threads = threads;
            trace
        })
    }

    fn deed(from: i64, to: i64, event: Event, waited: u32) -> Deed {
        Deed { from: from * 50, to: to * 50, event, waited: Ticks(waited) }
    }

    #[test]
    fn a_deed_lasts_from_its_cause_to_its_end() {
        let (began, ended) = (
            Event::JobBegan { oid: Some(1), waited: Ticks(7) },
            Event::JobEnded { oid: Some(1), took: Ticks::from_us(3) },
        );
        let woke = Event::Woke { slept: Ticks::from_us(40), late: Ticks(0) };
        let core = [(100, woke), (110, Event::Block(1)), (200, Event::Held)];
        let lasting = [(120, Event::Held), (130, Event::Released)];
        let link = [(90, Event::BlockIn(1))];
        // The first job began before the recording; the third and the fourth have no event for their ends.
        let bus = [(10, ended), (20, began), (25, ended), (30, began), (60, began)];
        let trace = trace(End::Died, &[("core", &core), ("spi0", &bus), ("core", &lasting), ("link", &link)]);
        let history = History::of(&trace);
        assert_eq!(
            history.core(),
            [
                deed(-140, -100, woke, 0),
                deed(-110, -90, Event::Block(1), 0),
                deed(-80, -70, Event::Released, 0),
                deed(0, 0, Event::Held, 0),
            ]
        );
        assert_eq!(
            history.lanes[1].deeds,
            [
                deed(-193, -190, ended, 0),
                deed(-180, -175, ended, 7),
                deed(-170, -140, began, 7),
                deed(-140, 0, began, 7),
            ]
        );
    }

    #[test]
    fn an_output_has_its_level_before_its_first_change_but_not_before_it_was_configured() {
        let edge = |pin, level| Event::Edge { pin, level };
        let edges = [(10, edge(1, false)), (20, edge(2, true)), (60, edge(1, true)), (70, edge(3, false))];
        let core = [(50, Event::Configured), (100, Event::Stopped { block: 1 })];
        let trace = trace(End::Died, &[("core", &core), ("edges", &edges)]);
        let outputs = History::of(&trace).outputs();
        let found = outputs.iter().map(|output| (output.pin, output.known / 50, output.highs.clone()));
        assert_eq!(
            found.collect::<Vec<_>>(),
            [
                (1, -90, vec![(-40 * 50, i64::MAX)]),
                (2, -80, vec![(-80 * 50, i64::MAX)]),
                (3, -50, vec![(-50 * 50, -30 * 50)]),
            ]
        );
    }

    proptest! {
        #[test]
        fn no_deed_ends_before_it_began(trace in any_trace()) {
            let history = History::of(&trace);
            for (_, deed) in history.deeds() {
                prop_assert!(deed.from <= deed.to, "{deed:?}");
                let words = history.words(deed);
                prop_assert!(!words.contains(char::is_control) && words.len() < 800, "{words:?}");
            }
        }
    }
}
