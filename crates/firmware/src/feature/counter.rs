// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters of a pin's edges, such as a fan's tachometer.
//!
//! The firmware polls the pin, and so do we where nothing else can be had. Where the board has
//! interrupts, the kernel dates the edges and a worker takes them: the core has 20 timers in a second to
//! run instead of a thousand.
//!
//! Polling hardly ever sees a pulse much shorter than `poll_ticks`, such as noise on a fan's wire. An
//! interrupt sees each, so a level counts here only once it has lasted a part of that time. The kernel
//! can debounce a line, too, but most often by a timer in jiffies of 1 to 10 ms: a fan of 10,000 rpm
//! has levels of 1.5 ms.

#![forbid(unsafe_code)]

use std::sync::Arc;

use log::warn;

use crate::board::{Edge, Edges, Pin};
use crate::mcu::{
    Back, Command, Done, Errand, Feature, InputLine, Look, Next, Object, Oid, Response, Slot, Timer, Turn, WireClock,
    WorkerId, command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

use super::bias;

pub(super) const FEATURE: Feature = Feature {
    name: "counter",
    commands: &[CONFIG_COUNTER, QUERY_COUNTER],
    responses: &[State::FORM],
    ..Feature::EMPTY
};

response! {
    /// The edges so far, and the instants of the next look and of the last edge. klippy takes the
    /// count for that of one `poll_ticks` before `next_clock`.
    "counter_state oid=%c next_clock=%u count=%u count_clock=%u"
    pub(super) struct State { oid: Oid, next_clock: Clock, count: u32, count_clock: Clock }
}

/// More interrupts than these are none of a tachometer (20,000 rpm with two pulses are 1333 edges a
/// second), but of a pin that floats or oscillates. Each costs the kernel 10 us and more, and whatever
/// else this computer does comes after them.
const EDGES_PER_S_MAX: u32 = 20_000;
/// The time over which they are counted, at least: a contact that bounces is no such pin.
const STORM_TICKS: Ticks = Ticks::from_us(100_000);

/// How often the edges are taken. The kernel keeps 1024, and [`EDGES_PER_S_MAX`] are 1000 in this time.
const TAKE_TICKS: Ticks = Ticks::from_us(50_000);
/// A level counts if it lasts `poll_ticks` divided by this. klippy's documentation wants a
/// `tachometer_poll_interval` below the time of one level at the highest speed. So all pulses count at
/// that speed if the shorter level takes an eighth of a pulse or more, and at twice the speed if it takes
/// a quarter.
const SETTLE_DIVISOR: u32 = 4;

const TIMER: Timer = Timer::sampling(0);

/// Counts the edges of a line, but for those of glitches.
#[derive(Debug)]
struct Settling {
    /// The level that lasted last.
    level: bool,
    /// Since when the line has had the other one.
    left: Option<Clock>,
    /// Edges, modulo 2^32.
    count: u32,
    /// When the last one was.
    last: Option<Clock>,
}

impl Settling {
    fn new(level: bool) -> Settling {
        Settling { level, left: None, count: 0, last: None }
    }

    /// Takes in an edge, after which the line was at `level`.
    fn see(&mut self, at: Clock, level: bool, settle: Ticks) {
        self.pass(at, settle);
        self.left = (level != self.level).then_some(at);
    }

    /// Takes in that edges were dropped, before one after which the line was at `level`. Nothing is known of
    /// them, nor how long the level before them lasted: so all count.
    fn lose(&mut self, edges: u32, level: bool) {
        self.last = self.left.or(self.last);
        self.count = self.count.wrapping_add(edges).wrapping_add(self.left.take().is_some().into());
        self.level = !level;
    }

    /// Takes in that no edge came until now.
    fn pass(&mut self, now: Clock, settle: Ticks) {
        if let Some(at) = self.left.filter(|at| now.since(*at) >= i64::from(settle.0)) {
            self.level = !self.level;
            self.left = None;
            self.last = Some(at);
            self.count = self.count.wrapping_add(1);
        }
    }
}

/// A worker's look at the edges that the kernel has dated.
struct Reading {
    edges: Box<dyn Edges>,
    clock: Arc<dyn TimeSource>,
    /// What the log calls the pin.
    name: String,
    settling: Settling,
    /// How long a level must last to count.
    settle: Ticks,
    /// Since when edges are counted in order to see whether there are too many.
    since: Clock,
    /// How many there were since then, glitches too.
    interrupts: u32,
    /// Whether there were, so that there are no more interrupts.
    given_up: bool,
}

impl Errand for Reading {
    /// How many edges there were, and when the last one was.
    type Answer = (u32, Option<Clock>);
    type Failure = Shutdown;

    fn run(&mut self) -> Result<(u32, Option<Clock>), Shutdown> {
        // The kernel has all edges up to now.
        let now = self.clock.now();
        let Reading { edges, clock, settling, settle, interrupts, .. } = self;
        edges.take(&mut |Edge { at, level, dropped }| {
            if dropped > 0 {
                settling.lose(dropped, level);
            }
            settling.see(clock.instant_of(at), level, *settle);
            *interrupts = interrupts.saturating_add(dropped).saturating_add(1);
        })?;
        settling.pass(now, *settle);
        let ticks = now.since(self.since).unsigned_abs();
        if ticks >= u64::from(STORM_TICKS.0) {
            self.since = now;
            let per_s = u64::from(std::mem::take(&mut self.interrupts)) * u64::from(CLOCK_FREQ) / ticks;
            if per_s > u64::from(EDGES_PER_S_MAX) {
                self.edges.end()?;
                self.given_up = true;
                warn!("{}", too_many(&self.name, per_s));
            }
        }
        Ok((self.settling.count, self.settling.last))
    }
}

/// For the log: a pin has so many edges in a second that its interrupts were given up.
fn too_many(name: &str, per_s: u64) -> String {
    format!(
        "counter ({name}): {per_s} edges a second are none of a fan, and their interrupts slow this computer down: it is polled from now on; does the pin float? Connect it, or give it a pull-up (^)"
    )
}

/// For the log: nothing counts a pin's edges.
fn polled(name: &str, why: &str) -> String {
    format!("counter ({name}): {why}, so it is polled: pulses shorter than its poll_interval are missed")
}

/// The edges that the kernel dates, and who takes them.
struct Counted {
    worker: WorkerId,
    reading: Slot<Reading>,
}

struct Counter {
    pin: InputLine,
    /// None where the pin is polled.
    counted: Option<Counted>,
    poll_ticks: Ticks,
    sample_ticks: Ticks,
    /// The count is told at the first look after this, or of a worker's looks at the first from this on.
    next_sample: Clock,
    /// Edges, modulo 2^32. While the pin is polled it is odd as long as that is high.
    count: u32,
    /// When the last edge was seen; before the first one, when counting began (the firmware says 0,
    /// which klippy takes for some instant that may lie ahead).
    count_clock: Clock,
    /// Whether what a worker does is for the present query.
    counts: bool,
}

impl Counter {
    /// Takes in the level at an instant.
    fn look(&mut self, turn: &mut Turn, level: bool, at: Clock) {
        if level != (self.count % 2 == 1) {
            self.count = self.count.wrapping_add(1);
            self.count_clock = at;
        }
        if self.next_sample < at {
            self.next_sample = at + self.sample_ticks;
            self.tell(turn, at);
        }
    }

    /// Tells the count that was right at an instant.
    fn tell(&mut self, turn: &mut Turn, at: Clock) {
        let next_clock = at + self.poll_ticks;
        turn.send(State { oid: turn.oid(), next_clock, count: self.count, count_clock: self.count_clock });
    }

    /// Takes in what the worker has seen of the edges.
    fn has_read(
        &mut self,
        turn: &mut Turn,
        edges: Result<(u32, Option<Clock>), Shutdown>,
        ended: Clock,
    ) -> Result<(), Shutdown> {
        let counts = std::mem::take(&mut self.counts);
        match edges {
            Ok((count, last)) => {
                self.count = count;
                self.count_clock = last.unwrap_or(self.count_clock);
                if counts {
                    self.tell(turn, ended);
                }
                Ok(())
            }
            Err(failure) => turn.try_shut_down(failure),
        }
    }
}

impl Object for Counter {
    fn kind(&self) -> &'static str {
        "counter"
    }

    fn event(&mut self, turn: &mut Turn, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if let Some(Counted { worker, reading }) = &mut self.counted
            && !reading.here().is_some_and(|reading| reading.given_up)
        {
            if self.next_sample <= at {
                self.next_sample = at + self.sample_ticks.max(self.poll_ticks);
                self.counts = true;
            }
            // A worker that still reads misses this turn.
            if let Some(ready) = reading.here() {
                ready.settle = Ticks(self.poll_ticks.0 / SETTLE_DIVISOR);
                reading.send(turn, *worker)?;
            }
            return Ok(Next::At(self.next_sample.min(at + TAKE_TICKS)));
        }
        // So does an expander that still looks.
        if self.pin.is_looking() {
            self.pin.awaited(turn)?;
        } else {
            match self.pin.read(turn)? {
                Some(level) => self.look(turn, level, at),
                None => self.counts = true,
            }
        }
        Ok(Next::At(at + self.poll_ticks))
    }

    /// A worker has read the count, or looked at an expander's pin.
    fn returned(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        if let Some(counted) = &mut self.counted
            && let Some(Back { result, ended, .. }) = counted.reading.back(done)
        {
            let edges = result.map_err(Shutdown::clone);
            return self.has_read(turn, edges, ended);
        }
        let Some(look) = self.pin.sampled(turn, done) else { return Ok(()) };
        let Look { level, ended, .. } = look?;
        if std::mem::take(&mut self.counts) {
            // A pin that could not be looked at keeps its last level.
            self.look(turn, level.unwrap_or(self.count % 2 == 1), ended);
        }
        Ok(())
    }

    fn shutdown(&mut self, _turn: &mut Turn) {
        self.counts = false;
    }
}

const CONFIG_COUNTER: Command =
    command!("config_counter oid=%c pin=%u pull_up=%c", |mcu, oid: Oid, pin: Pin, pull_up: i8| {
        mcu.vacant(oid)?;
        let (line, edges) = mcu.counted_input(pin, bias(pull_up))?;
        let name = mcu.name(pin);
        let counted = match edges {
            Ok((worker, edges)) => {
                let level = line.prompt_level()?.unwrap_or_default();
                let reading = Reading {
                    edges,
                    clock: mcu.clock(),
                    name,
                    settling: Settling::new(level),
                    settle: Ticks(0),
                    since: mcu.now(),
                    interrupts: 0,
                    given_up: false,
                };
                Some(Counted { worker, reading: Slot::new(reading) })
            }
            Err(why) => {
                warn!("{}", polled(&name, &why));
                None
            }
        };
        let counter = Counter {
            pin: line,
            counted,
            poll_ticks: Ticks(0),
            sample_ticks: Ticks(0),
            next_sample: Clock::EPOCH,
            count: 0,
            count_clock: Clock::EPOCH,
            counts: false,
        };
        mcu.assign_on(pin, oid, counter)
    });

const QUERY_COUNTER: Command = command!(
    "query_counter oid=%c clock=%u poll_ticks=%u sample_ticks=%u",
    Counter,
    |counter, turn, clock: WireClock, poll_ticks: Ticks, sample_ticks: Ticks| {
        let at = turn.instant(clock);
        turn.cancel(TIMER);
        counter.poll_ticks = poll_ticks;
        counter.sample_ticks = sample_ticks;
        counter.next_sample = at;
        if counter.count == 0 {
            counter.count_clock = at;
        }
        counter.counts = false;
        turn.schedule(TIMER, at)
    }
);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SETTLE: Ticks = Ticks(100);

    /// Lets a line see levels that each last for so many ticks, of which some edges are dropped.
    fn seen(levels: &[u64], dropped: std::ops::Range<usize>) -> Settling {
        let (mut settling, mut at, mut level) = (Settling::new(false), 1000, false);
        let mut lost = 0;
        for (n, lasts) in levels.iter().enumerate() {
            level = !level;
            if dropped.contains(&n) {
                lost += 1;
            } else {
                if lost > 0 {
                    settling.lose(std::mem::take(&mut lost), level);
                }
                settling.see(Clock::from_ticks(at), level, SETTLE);
            }
            at += lasts;
        }
        settling.pass(Clock::from_ticks(at), SETTLE);
        settling
    }

    proptest! {
        /// Pulses count exactly, also where some edges were dropped amid them.
        #[test]
        fn levels_that_last_all_count(
            levels in proptest::collection::vec(100u64..5000, 1..50), from in 0usize..60, count in 0usize..20,
        ) {
            let all = levels.len();
            // The last edge is seen.
            let dropped = from.min(all - 1)..(from + count).min(all - 1);
            let settling = seen(&levels, dropped);
            prop_assert_eq!(settling.count, all as u32);
            let last: u64 = 1000 + levels[..all - 1].iter().sum::<u64>();
            prop_assert_eq!(settling.last, Some(Clock::from_ticks(last)));
        }

        /// Of a line that mostly rests, nothing that is shorter counts, however often it comes.
        #[test]
        fn glitches_count_never(glitches in proptest::collection::vec((1u64..100, 100u64..5000), 0..50)) {
            let levels: Vec<u64> = glitches.iter().flat_map(|(glitch, rest)| [*glitch, *rest]).collect();
            let settling = seen(&levels, 0..0);
            prop_assert_eq!((settling.count, settling.last), (0, None));
        }

        /// An interrupt may find a pulse over: then both edges tell the same level.
        #[test]
        fn pulses_that_were_over_count_never(at in proptest::collection::vec(1u64..5000, 0..50)) {
            let (mut settling, mut now) = (Settling::new(true), 1000);
            for ticks in at {
                now += ticks;
                settling.see(Clock::from_ticks(now), true, SETTLE);
                settling.see(Clock::from_ticks(now + 1), true, SETTLE);
            }
            settling.pass(Clock::from_ticks(now + 1000), SETTLE);
            prop_assert_eq!(settling.count, 0);
        }
    }
}
