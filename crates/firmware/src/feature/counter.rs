// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters of a pin's edges, for example of a fan's tachometer.
//!
//! Klipper's C polls the pin. Pinion polls it only where nothing better is available. If the board has interrupts, the
//! kernel timestamps the edges and a worker reads them. The core then runs 20 timers per second instead of a thousand.
//!
//! Polling rarely sees a pulse much shorter than `poll_ticks`, for example noise on a fan's wire. An interrupt sees
//! each one. So a level counts only after it has lasted a part of that time. The kernel can debounce a line too. But it
//! mostly uses a timer in jiffies of 1 to 10 ms. A fan at 10,000 rpm has levels of 1.5 ms.

use std::sync::Arc;

use crate::board::{Edge, Edges, Pin};
use crate::mcu::{
    Back, Command, Context, DeviceId, DeviceWarning, Feature, Finished, InputLine, Job, JobSlot, Next, Object, Oid,
    Response, Sample, Timer, WireClock, command, response,
};
use crate::shutdown::Shutdown;
use crate::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

use super::bias;

pub(super) const FEATURE: Feature = Feature {
    serves: "tachometers of fans",
    commands: &[CONFIG_COUNTER, QUERY_COUNTER],
    responses: &[State::FORM],
    ..Feature::EMPTY
};

response! {
    /// The edges so far, the time of the next sample, and the time of the last edge. klippy assumes that the count was
    /// taken one `poll_ticks` before `next_clock`.
    "counter_state oid=%c next_clock=%u count=%u count_clock=%u"
    pub(super) struct State { oid: Oid, next_clock: Clock, count: u32, count_clock: Clock }
}

/// Highest rate of interrupts that a tachometer may have. 20,000 rpm with two pulses are 1333 edges per second. A
/// pin with a higher rate floats or oscillates. Each interrupt costs the kernel 10 us or more, and delays everything
/// else on this computer.
const EDGES_PER_S_MAX: u32 = 20_000;
/// Shortest time over which this rate is measured, so that a bouncing contact does not exceed it.
const STORM_TICKS: Ticks = Ticks::from_us(100_000);

/// How often the worker reads the edges. The kernel keeps 1024, and [`EDGES_PER_S_MAX`] makes 1000 in this time.
const TAKE_TICKS: Ticks = Ticks::from_us(50_000);
/// A level counts if it lasts `poll_ticks` divided by this. klippy's documentation wants a `tachometer_poll_interval`
/// below the time of one level at the highest speed. So at that speed all pulses count if the shorter level takes an
/// eighth of a pulse or more. At twice the speed they count if it takes a quarter or more.
const SETTLE_DIVISOR: u32 = 4;

const TIMER: Timer = Timer::sampling(0);

/// Counts the edges of a line, and ignores glitches.
#[derive(Debug)]
struct Settling {
    /// The last level that lasted long enough.
    level: bool,
    /// Since when the line has had the other level.
    left: Option<Clock>,
    /// Edges, modulo 2^32.
    count: u32,
    /// The time of the last counted edge.
    last: Option<Clock>,
}

impl Settling {
    fn new(level: bool) -> Settling {
        Settling { level, left: None, count: 0, last: None }
    }

    /// Processes an edge. The line was at `level` after it.
    fn see(&mut self, at: Clock, level: bool, settle: Ticks) {
        self.pass(at, settle);
        self.left = (level != self.level).then_some(at);
    }

    /// Processes dropped edges. The line was at `level` after the next edge. Nothing is known about the dropped edges,
    /// nor how long the level before them lasted. So all of them count.
    fn lose(&mut self, edges: u32, level: bool) {
        self.last = self.left.or(self.last);
        self.count = self.count.wrapping_add(edges).wrapping_add(self.left.take().is_some().into());
        self.level = !level;
    }

    /// Processes the time until `now`, without an edge.
    fn pass(&mut self, now: Clock, settle: Ticks) {
        if let Some(at) = self.left.filter(|at| now.since(*at) >= i64::from(settle.0)) {
            self.level = !self.level;
            self.left = None;
            self.last = Some(at);
            self.count = self.count.wrapping_add(1);
        }
    }
}

/// The first word of each warning.
const SUBJECT: &str = "counter";

/// Reads the edges that the kernel has timestamped.
struct Reading {
    clock: Arc<dyn TimeSource>,
    /// The pin's name in the log.
    name: String,
    settling: Settling,
    /// How long a level must last to count.
    settle: Ticks,
    /// When the count in `interrupts` began. A count that is too high ends the interrupts.
    since: Clock,
    /// How many edges came since then, including glitches.
    interrupts: u32,
    /// Whether there were too many, so that the interrupts are switched off.
    given_up: bool,
    warning: Option<DeviceWarning>,
}

impl Job for Reading {
    type Device = dyn Edges;
    /// The number of edges, and the time of the last one.
    type Out = (u32, Option<Clock>);
    type Failure = Shutdown;

    fn run(&mut self, edges: &mut Self::Device) -> Result<(u32, Option<Clock>), Shutdown> {
        // Take the time first. The kernel already has all edges up to it.
        let now = self.clock.now();
        let Reading { clock, settling, settle, interrupts, .. } = self;
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
                edges.end()?;
                self.given_up = true;
                self.warning = Some(DeviceWarning::new(SUBJECT, too_many(&self.name, per_s)));
            }
        }
        Ok((self.settling.count, self.settling.last))
    }

    fn take_warning(&mut self) -> Option<DeviceWarning> {
        self.warning.take()
    }
}

/// For the log: a pin has `per_s` edges per second, so its interrupts were switched off.
fn too_many(name: &str, per_s: u64) -> String {
    format!(
        "counter ({name}): {per_s} edges a second are not from a fan, and their interrupts slow this computer down, so it is polled from now on: connect the pin, or give it a pull-up (^)"
    )
}

/// For the log: nothing else counts a pin's edges, so it is polled.
fn polled(name: &str, why: &str) -> String {
    format!("counter ({name}): {why}, so it is polled: pulses shorter than its poll_interval are missed")
}

/// The kernel's edges, and the job that reads them.
struct Counted {
    edges: DeviceId<dyn Edges>,
    reading: JobSlot<Reading>,
}

/// The number of the job that reads the kernel's edges. The pin's own reads have 0.
const READING: u8 = 1;

struct Counter {
    pin: InputLine,
    /// `None`: the pin is polled.
    counted: Option<Counted>,
    poll_ticks: Ticks,
    sample_ticks: Ticks,
    /// When the next report is due. A polled pin reports at the first sample after this time. A worker's read reports at
    /// this time or later.
    next_sample: Clock,
    /// Edges, modulo 2^32. While the pin is polled, the count is odd if the pin is high.
    count: u32,
    /// When the last edge was seen. Before the first edge: when counting began. Klipper's C reports 0 there, and
    /// klippy takes 0 for some time that may lie in the future.
    count_clock: Clock,
    /// Whether the worker's result is for the current query.
    counts: bool,
}

impl Counter {
    /// Processes the level at a given time.
    fn sample(&mut self, context: &mut Context, level: bool, at: Clock) {
        if level != (self.count % 2 == 1) {
            self.count = self.count.wrapping_add(1);
            self.count_clock = at;
        }
        if self.next_sample < at {
            self.next_sample = at + self.sample_ticks;
            self.send_state(context, at);
        }
    }

    /// Reports the count as it was at a given time.
    fn send_state(&mut self, context: &mut Context, at: Clock) {
        let next_clock = at + self.poll_ticks;
        context.send(State { oid: context.oid(), next_clock, count: self.count, count_clock: self.count_clock });
    }

    /// Processes the edges that the worker has read.
    fn has_read(
        &mut self,
        context: &mut Context,
        edges: Result<(u32, Option<Clock>), Shutdown>,
        ended: Clock,
    ) -> Result<(), Shutdown> {
        let counts = std::mem::take(&mut self.counts);
        match edges {
            Ok((count, last)) => {
                self.count = count;
                self.count_clock = last.unwrap_or(self.count_clock);
                if counts {
                    self.send_state(context, ended);
                }
                Ok(())
            }
            Err(failure) => context.try_shut_down(failure),
        }
    }
}

impl Object for Counter {
    fn kind(&self) -> &'static str {
        "counter"
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        if let Some(Counted { edges, reading }) = &mut self.counted
            && !reading.here().is_some_and(|reading| reading.given_up)
        {
            if self.next_sample <= at {
                self.next_sample = at + self.sample_ticks.max(self.poll_ticks);
                self.counts = true;
            }
            // A worker that is still reading misses this read.
            if let Some(ready) = reading.here() {
                ready.settle = Ticks(self.poll_ticks.0 / SETTLE_DIVISOR);
                reading.send(context, *edges)?;
            }
            return Ok(Next::At(self.next_sample.min(at + TAKE_TICKS)));
        }
        // An expander that is still being read also misses it.
        if self.pin.is_looking() {
            self.pin.awaited(context)?;
        } else {
            match self.pin.read(context)? {
                Some(level) => self.sample(context, level, at),
                None => self.counts = true,
            }
        }
        Ok(Next::At(at + self.poll_ticks))
    }

    /// A worker has read the count, or the pin of an expander.
    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        if number == READING {
            let back = self.counted.as_mut().and_then(|counted| counted.reading.back(finished));
            let Some(Back { result, ended, .. }) = back else { return Ok(()) };
            let edges = result.map_err(Shutdown::clone);
            return self.has_read(context, edges, ended);
        }
        let Some(sample) = self.pin.sampled(context, finished) else { return Ok(()) };
        let Sample { level, ended, .. } = sample?;
        if std::mem::take(&mut self.counts) {
            // A pin that could not be read keeps its last level.
            self.sample(context, level.unwrap_or(self.count % 2 == 1), ended);
        }
        Ok(())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.counts = false;
    }
}

const CONFIG_COUNTER: Command =
    command!("config_counter oid=%c pin=%u pull_up=%c", |context, oid: Oid, pin: Pin, pull_up: i8| {
        context.vacant(oid)?;
        let (line, edges) = context.counted_input(pin, bias(pull_up))?;
        let name = context.name(pin);
        let counted = match edges {
            Ok(edges) => {
                let level = line.prompt_level()?.unwrap_or_default();
                let reading = Reading {
                    clock: context.clock(),
                    name,
                    settling: Settling::new(level),
                    settle: Ticks(0),
                    since: context.now(),
                    interrupts: 0,
                    given_up: false,
                    warning: None,
                };
                Some(Counted { edges, reading: JobSlot::numbered(READING, reading) })
            }
            Err(why) => {
                context.warn_of_device(&DeviceWarning::new(SUBJECT, polled(&name, &why)));
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
        context.assign_on(pin, oid, counter)
    });

const QUERY_COUNTER: Command = command!(
    "query_counter oid=%c clock=%u poll_ticks=%u sample_ticks=%u",
    Counter,
    |counter, context, clock: WireClock, poll_ticks: Ticks, sample_ticks: Ticks| {
        let at = context.instant(clock);
        context.cancel(TIMER);
        counter.poll_ticks = poll_ticks;
        counter.sample_ticks = sample_ticks;
        counter.next_sample = at;
        if counter.count == 0 {
            counter.count_clock = at;
        }
        counter.counts = false;
        context.schedule(TIMER, at)
    }
);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SETTLE: Ticks = Ticks(100);

    /// Runs a line through `levels`, each with its length in ticks. The edges in `dropped` are lost.
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
        /// Pulses count exactly, even if some edges among them were dropped.
        #[test]
        fn levels_that_last_all_count(
            levels in proptest::collection::vec(100u64..5000, 1..50), from in 0usize..60, count in 0usize..20,
        ) {
            let all = levels.len();
            // The last edge is never dropped.
            let dropped = from.min(all - 1)..(from + count).min(all - 1);
            let settling = seen(&levels, dropped);
            prop_assert_eq!(settling.count, all as u32);
            let last: u64 = 1000 + levels[..all - 1].iter().sum::<u64>();
            prop_assert_eq!(settling.last, Some(Clock::from_ticks(last)));
        }

        /// Shorter pulses on a line that mostly rests never count, however often they come.
        #[test]
        fn glitches_count_never(glitches in proptest::collection::vec((1u64..100, 100u64..5000), 0..50)) {
            let levels: Vec<u64> = glitches.iter().flat_map(|(glitch, rest)| [*glitch, *rest]).collect();
            let settling = seen(&levels, 0..0);
            prop_assert_eq!((settling.count, settling.last), (0, None));
        }

        /// A pulse may be over before the interrupt reads the line. Then both edges report the same level.
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
