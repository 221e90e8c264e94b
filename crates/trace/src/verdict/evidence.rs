// SPDX-License-Identifier: GPL-3.0-or-later
//! The evidence of a trace about a span of time: who ran, who waited, who was silent.
//!
//! Times are ticks after the stop, so that those before it are negative. Spans are ticks.

use pinion_firmware::time::Clock;
use pinion_protocol::block::Refusal;

use crate::event::{Event, PowerFault, Watched};
use crate::file::Trace;
pub(super) use crate::history::TICKS_PER_MS as MS;
use crate::ring::WINDOW;

/// How late a sample may be while nothing is wrong.
const LOOK_LATE: i64 = 100 * MS;
/// Longest time between two signs of the guardian, and a little more.
const LISTENS: i64 = 700 * MS;
/// Longest time that a core works without an event. The lateness of a turn is recorded at the turn's end.
pub(super) const QUIET: i64 = 15 * MS;
/// The core is within its budget again after a shorter time.
const UNUSED: i64 = 3000 * MS;
/// A time farther away is taken for this one. The difference of any two fits into 64 bits.
const FAR: i64 = 1 << 56;
/// How far back the lateness of the timers is of interest.
const RECENT: i64 = 10_000 * MS;

/// From, to.
pub(super) type Span = (i64, i64);

/// The common part of two spans; negative if they are apart.
fn common(a: Span, b: Span) -> i64 {
    a.1.min(b.1) - a.0.max(b.0)
}

/// The kernel's account of a thread.
pub(super) struct Account {
    pub(super) ran: i64,
    pub(super) waited: i64,
    /// Time that is neither run, wait nor intended sleep; `None` if the record does not reach back so far.
    pub(super) lost: Option<i64>,
}

/// A job of a worker.
pub(super) struct Job<'a> {
    pub(super) bus: &'a str,
    pub(super) oid: Option<u8>,
    pub(super) span: Span,
    pub(super) is_open: bool,
}

/// When a block came.
pub(super) struct Arrival {
    pub(super) at: i64,
    /// Whether this is the block's own time. Otherwise a later block came then.
    pub(super) is_exact: bool,
}

/// How the core was scheduled.
pub(super) enum Scheduling {
    RealTime,
    /// As SCHED_OTHER for a moment, to stay within the kernel's budget.
    UsedUp,
    /// As SCHED_OTHER all the time.
    Refused,
}

/// The stop of the MCU.
#[derive(Default)]
pub(super) struct Stop {
    /// The block that the core had begun last.
    pub(super) block: Option<u32>,
    /// The time that the stop was about.
    pub(super) due: Option<i64>,
}

/// The thread of an event.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Thread<'a> {
    Core,
    Link,
    Sampler,
    Guardian,
    /// The worker of a bus, by the name of the bus; the edges, too.
    Other(&'a str),
}

impl Thread<'_> {
    fn of(name: &str) -> Thread<'_> {
        match name {
            "core" => Thread::Core,
            "link" => Thread::Link,
            "sampler" => Thread::Sampler,
            "guardian" => Thread::Guardian,
            other => Thread::Other(other),
        }
    }
}

/// All events of a trace in their order.
pub(super) struct Record<'a> {
    pub(super) trace: &'a Trace,
    pub(super) stop: Stop,
    events: Vec<(i64, Thread<'a>, Event)>,
    /// When the core did something. It may have done more in between.
    busy: Vec<Span>,
}

impl<'a> Record<'a> {
    /// The record of a trace. Time zero is the last stop if `stopped`, or else the end of the trace.
    pub(super) fn of(trace: &'a Trace, stopped: bool) -> Record<'a> {
        let all = trace.timeline();
        let is_stop = |(_, thread, event): &&(Clock, &str, Event)| {
            *thread == "core" && matches!(event, Event::Stopped { .. }) && stopped
        };
        let last = all.iter().rev().find(is_stop).map(|(at, _, event)| (*at, *event));
        let zero = last.map_or(trace.ended_at(), |(at, _)| at);
        let since = |at: Clock| at.since(zero).clamp(-FAR, FAR);
        // The clock may be so far off that its order is lost.
        let mut events: Vec<_> =
            all.iter().map(|(at, thread, event)| (since(*at), Thread::of(thread), *event)).collect();
        events.sort_by_key(|(at, ..)| *at);
        let mut stop = Stop::default();
        if let Some((_, Event::Stopped { block })) = last {
            stop.block = Some(block);
            stop.due = events
                .iter()
                .filter(|(at, thread, _)| *at >= 0 && *thread == Thread::Core)
                .find_map(|(.., event)| if let Event::Due(due) = event { Some(since(*due)) } else { None });
        }
        let busy = busy(trace, since);
        Record { trace, stop, events, busy }
    }

    /// The events of a thread.
    fn thread(&self, thread: Thread<'a>) -> impl DoubleEndedIterator<Item = (i64, Event)> {
        self.events.iter().filter(move |(_, of, _)| *of == thread).map(|(at, _, event)| (*at, *event))
    }

    /// The events of a thread within a span.
    fn within(&self, thread: Thread<'a>, span: Span) -> impl DoubleEndedIterator<Item = (i64, Event)> {
        self.thread(thread).filter(move |(at, _)| (span.0..=span.1).contains(at))
    }

    /// When the link read a block before the stop.
    pub(super) fn arrived(&self, block: u32) -> Option<Arrival> {
        self.within(Thread::Link, (-FAR, 0)).find_map(|(at, event)| match event {
            Event::BlockIn(number) if number.wrapping_sub(block) as i32 >= 0 => {
                Some(Arrival { at, is_exact: number == block })
            }
            _ => None,
        })
    }

    /// When the link read the first block behind a block, while the core had not begun it.
    pub(super) fn pending(&self) -> Option<i64> {
        let next = self.stop.block?.wrapping_add(1);
        let read = self.thread(Thread::Link).find(|(_, event)| *event == Event::BlockIn(next));
        read.map(|(at, _)| at).filter(|at| *at < 0)
    }

    /// When the link last read a block for the core before the stop.
    pub(super) fn last_block(&self) -> Option<i64> {
        let mut blocks = self.within(Thread::Link, (-FAR, 0));
        blocks.rfind(|(_, event)| matches!(event, Event::BlockIn(_))).map(|(at, _)| at)
    }

    /// When something came from the host or its computer last before a time.
    pub(super) fn last_heard(&self, until: i64) -> Option<i64> {
        let mut heard = self.within(Thread::Link, (-FAR, until - 1));
        heard.rfind(|(_, event)| is_heard(event)).map(|(at, _)| at)
    }

    /// Whether the host's computer sent a keepalive in a span, for a host that was silent.
    pub(super) fn was_alive(&self, span: Span) -> bool {
        self.within(Thread::Link, span).any(|(_, event)| event == Event::Alive)
    }

    /// How many blocks the host sent again within a span.
    pub(super) fn blocks_again(&self, span: Span) -> usize {
        self.within(Thread::Link, span).filter(|(_, event)| *event == Event::Refused(Refusal::Repeated)).count()
    }

    /// Whether the host asked within a span for something that the link answers.
    pub(super) fn asked(&self, span: Span) -> bool {
        self.within(Thread::Link, span).any(|(_, event)| matches!(event, Event::Answered { .. }))
    }

    /// Whether garbage came from the host in a span.
    pub(super) fn has_garbage(&self, span: Span) -> bool {
        self.within(Thread::Link, span).any(|(_, event)| event == Event::Refused(Refusal::Garbage))
    }

    /// When the last host was gone, if none has come since.
    pub(super) fn host_gone(&self) -> Option<i64> {
        let mut hosts =
            self.thread(Thread::Link).filter(|(_, event)| matches!(event, Event::HostCame | Event::HostGone));
        hosts.rfind(|(at, _)| *at <= 0).filter(|(_, event)| *event == Event::HostGone).map(|(at, _)| at)
    }

    /// When the core first had no room for the host's blocks in a span.
    pub(super) fn full(&self, span: Span) -> Option<i64> {
        self.within(Thread::Link, span).find(|(_, event)| *event == Event::Full).map(|(at, _)| at)
    }

    /// The name of the command that the core ran last.
    pub(super) fn last_command(&self) -> Option<&'a str> {
        let mut commands = self.thread(Thread::Core).filter(|(at, _)| *at <= 0);
        let id = commands.rfind(|(_, event)| matches!(event, Event::Command { .. }));
        let Some((_, Event::Command { id, .. })) = id else { return None };
        self.trace.head.names.commands.get(&id).map(String::as_str)
    }

    /// When the core did something first, as far as the record reaches back.
    pub(super) fn first_of_core(&self) -> Option<i64> {
        self.busy.first().map(|busy| busy.0)
    }

    /// When the core did something last.
    pub(super) fn last_of_core(&self) -> Option<i64> {
        self.busy.iter().map(|busy| busy.1).max()
    }

    /// How long commands waited for a bus within a span.
    pub(super) fn held(&self, span: Span) -> i64 {
        let (mut held, mut since) = (0, None);
        let mut is_first = true;
        for (at, event) in self.thread(Thread::Core) {
            match event {
                Event::Held => since = Some(at),
                // The record does not reach back to its beginning.
                Event::Released => {
                    let since = since.take().or(is_first.then_some(-FAR));
                    held += since.map_or(0, |since| common((since, at), span).max(0));
                }
                _ => continue,
            }
            is_first = false;
        }
        held + since.map_or(0, |since| common((since, FAR), span).max(0))
    }

    /// Whether commands no longer had to wait for a bus within a span.
    pub(super) fn was_released(&self, span: Span) -> bool {
        self.within(Thread::Core, span).any(|(_, event)| event == Event::Released)
    }

    /// All jobs.
    fn jobs(&self) -> Vec<Job<'a>> {
        let mut open: Vec<Job> = Vec::new();
        let mut jobs = Vec::new();
        for (at, thread, event) in &self.events {
            let Thread::Other(bus) = thread else { continue };
            match *event {
                Event::JobBegan { oid, .. } => {
                    open.retain(|job| job.bus != *bus);
                    open.push(Job { bus, oid, span: (*at, FAR), is_open: true });
                }
                Event::JobEnded { oid, took } => {
                    open.retain(|job| job.bus != *bus);
                    jobs.push(Job { bus, oid, span: (at - i64::from(took.0), *at), is_open: false });
                }
                _ => {}
            }
        }
        jobs.extend(open);
        jobs
    }

    /// The job that took the most of a span.
    pub(super) fn longest_job(&self, span: Span) -> Option<Job<'a>> {
        let mut jobs = self.jobs();
        jobs.retain(|job| common(job.span, span) > 0);
        jobs.into_iter().max_by_key(|job| common(job.span, span))
    }

    /// The job that has been under way for the longest time.
    pub(super) fn hanging(&self) -> Option<Job<'a>> {
        let open = self.jobs().into_iter().filter(|job| job.is_open && job.span.0 < 0);
        open.min_by_key(|job| job.span.0)
    }

    /// The kernel's account of a thread in the samples that cover a span. `None` if they cover less than half of it.
    pub(super) fn account(&self, watched: Watched, span: Span) -> Option<Account> {
        let (mut before, mut covered) = (None, 0);
        let (mut ran_sum, mut waited_sum) = (0, 0);
        let mut samples: Option<Span> = None;
        for (at, event) in self.thread(Thread::Sampler) {
            let Event::Processor { thread, ran, waited } = event else { continue };
            if thread != watched {
                continue;
            }
            let Some(before) = before.replace(at) else { continue };
            let sample = (before, at);
            if common(sample, span) > 0 {
                covered += common(sample, span);
                ran_sum += i64::from(ran.0);
                waited_sum += i64::from(waited.0);
                samples = Some((samples.map_or(sample.0, |samples| samples.0), at));
            }
        }
        let samples = samples.filter(|_| covered * 2 >= span.1 - span.0)?;
        let slept = if watched == Watched::Core { self.slept(samples) } else { None };
        let lost = slept.map(|slept| samples.1 - samples.0 - ran_sum - waited_sum - slept);
        Some(Account { ran: ran_sum, waited: waited_sum, lost })
    }

    /// How long the core slept within a span as it wished. `None` if the record does not reach back so far.
    fn slept(&self, span: Span) -> Option<i64> {
        let is_short_lived =
            |event: &Event| matches!(event, Event::Woke { .. } | Event::Block(_) | Event::Command { .. });
        self.thread(Thread::Core).find(|(_, event)| is_short_lived(event)).filter(|(at, _)| *at <= span.0)?;
        let sleeps = self.thread(Thread::Core).filter_map(|(at, event)| match event {
            Event::Woke { slept, late } => Some((at - i64::from(slept.0), at - i64::from(late.0))),
            _ => None,
        });
        let slept: i64 = sleeps.map(|sleep| common(sleep, span).max(0)).sum();
        // It may have slept since its last event.
        let since = common((self.last_of_core().unwrap_or(FAR), FAR), span);
        Some(slept + since.max(0))
    }

    /// How much more processor time than usual a hypervisor took in the samples that cover a span.
    pub(super) fn stolen(&self, span: Span) -> i64 {
        // The time taken, and the time observed, in these samples and in the others.
        let (mut here, mut elsewhere) = ((0, 0), (0, 0));
        let (mut before, mut stolen) = (None, 0);
        for (at, event) in self.thread(Thread::Sampler) {
            match event {
                Event::Stolen(ticks) => stolen += i64::from(ticks.0),
                Event::Looked { all: true, .. } => {
                    let stolen = std::mem::take(&mut stolen);
                    let Some(before) = before.replace(at) else { continue };
                    let sum = if common((before, at), span) > 0 { &mut here } else { &mut elsewhere };
                    *sum = (sum.0 + stolen, sum.1 + (at - before));
                }
                _ => {}
            }
        }
        // The usual share of all processors' time may be the share of a single one.
        let usual = elsewhere.0 as f64 / elsewhere.1.max(1) as f64 * here.1 as f64;
        (here.0 - usual as i64).max(0)
    }

    /// The longest time within a span without anything of the core.
    pub(super) fn gap(&self, span: Span) -> Span {
        let (mut gap, mut from) = ((span.0, span.0), span.0);
        for (start, end) in self.busy.iter().copied().chain([(span.1, span.1)]) {
            let start = start.min(span.1);
            if start - from > gap.1 - gap.0 {
                gap = (from, start);
            }
            from = from.max(end);
        }
        gap
    }

    /// Whether another thread of the program did something well within a span.
    pub(super) fn others_went_on(&self, span: Span) -> bool {
        let edge = (span.1 - span.0) / 8;
        let inner = span.0 + edge..span.1 - edge;
        self.events
            .iter()
            .any(|(at, thread, _)| inner.contains(at) && !matches!(thread, Thread::Core | Thread::Guardian))
    }

    /// Whether the sampler missed its time in a span, because it did not run either. It says when its next sample is due.
    pub(super) fn sampler_missed(&self, span: Span) -> bool {
        // It may have been the last one to stop.
        let start = span.0 + (span.1 - span.0) / 8;
        let due = self.within(Thread::Sampler, (-FAR, start)).rev().find_map(|(at, event)| match event {
            Event::Looked { again, .. } => Some(at + i64::from(again.0)),
            _ => None,
        });
        due.is_some_and(|due| span.1 - due > LOOK_LATE)
            && self.within(Thread::Sampler, (start + 1, span.1 - 1)).next().is_none()
    }

    /// Whether the guardian went on in a span. `None` if the span is too short to decide, or nothing of the guardian is
    /// recorded.
    pub(super) fn guardian_went_on(&self, span: Span) -> Option<bool> {
        self.thread(Thread::Guardian).next()?;
        let edge = (span.1 - span.0) / 8;
        match self.within(Thread::Guardian, (span.0 + edge, span.1 - edge)).next() {
            Some(_) => Some(true),
            None => (span.1 - span.0 > LISTENS).then_some(false),
        }
    }

    /// How late the core woke at most within a span, as the kernel wakes a thread.
    pub(super) fn latest_wake(&self, span: Span) -> i64 {
        let late = self.within(Thread::Core, span).map(|(_, event)| match event {
            Event::Woke { late, .. } => i64::from(late.0),
            _ => 0,
        });
        late.max().unwrap_or(0)
    }

    /// Whether the core slept within a span.
    pub(super) fn did_sleep(&self, span: Span) -> bool {
        self.within(Thread::Core, span).any(|(_, event)| matches!(event, Event::Woke { .. }))
    }

    /// Number of the core's events in a span.
    pub(super) fn events_of_core(&self, span: Span) -> usize {
        self.within(Thread::Core, span).count()
    }

    /// The latest timer: when it ran, and how late. `None` if nothing of timers is recorded. `Late` alone has its own
    /// time. `Pace` is about the time since the one before.
    pub(super) fn latest_timer(&self) -> Option<Span> {
        let timers = self.within(Thread::Core, (-RECENT, QUIET)).filter_map(|(at, event)| match event {
            Event::Late { late, .. } | Event::Pace { worst: late, .. } => Some((at, i64::from(late.0))),
            _ => None,
        });
        timers.max_by_key(|(at, late)| (*late, -at))
    }

    /// How late a timer was at most within a span, measured from its due time.
    pub(super) fn latest_within(&self, span: Span) -> i64 {
        let late = self
            .within(Thread::Core, span)
            .map(|(_, event)| if let Event::Late { late, .. } = event { late.0 } else { 0 });
        late.max().unwrap_or(0).into()
    }

    /// How the core was scheduled in a span.
    pub(super) fn scheduling(&self, span: Span) -> Scheduling {
        let classes = |(at, event)| if let Event::Scheduling { fifo } = event { Some((at, fifo)) } else { None };
        let before = self.within(Thread::Core, (-FAR, span.0)).rev().find_map(classes);
        let mut classes = before.into_iter().chain(self.within(Thread::Core, span).filter_map(classes));
        match classes.find(|(_, fifo)| !fifo) {
            None => Scheduling::RealTime,
            Some((since, _)) if span.1 - since < UNUSED => Scheduling::UsedUp,
            Some(_) => Scheduling::Refused,
        }
    }

    /// The fault of the computer's power supply or temperature in a span.
    pub(super) fn power_fault(&self, span: Span) -> Option<PowerFault> {
        let faults = |(_, event)| if let Event::Power(fault) = event { Some(fault) } else { None };
        let before = self.within(Thread::Sampler, (-FAR, span.0)).rev().find_map(faults);
        let mut looks = self.within(Thread::Sampler, (span.1, FAR));
        let seen =
            looks.find(|(_, event)| matches!(event, Event::Looked { all: true, .. })).map_or(span.1, |(at, _)| at);
        before.into_iter().chain(self.within(Thread::Sampler, (span.0, seen)).filter_map(faults)).flatten().next()
    }

    /// The processors' frequency in a span, and the highest possible one, if it was less than half of that.
    pub(super) fn low_frequency(&self, span: Span) -> Option<(u16, u16)> {
        let mut until = self.within(Thread::Sampler, (-FAR, span.1)).rev();
        let frequency = until.find_map(|(_, event)| match event {
            Event::Frequency { mhz, max_mhz } => Some((mhz, max_mhz)),
            _ => None,
        });
        frequency.filter(|(mhz, max_mhz)| *mhz > 0 && *mhz < max_mhz / 2)
    }
}

/// Whether the link records this when something comes from the host, and no garbage.
fn is_heard(event: &Event) -> bool {
    match event {
        Event::Refused(why) => *why != Refusal::Garbage,
        event => matches!(event, Event::BlockIn(_) | Event::Answered { .. } | Event::Alive),
    }
}

/// When the core did something, in order.
fn busy(trace: &Trace, since: impl Fn(Clock) -> i64) -> Vec<Span> {
    let mut busy = Vec::new();
    for thread in trace.threads.iter().filter(|thread| thread.name == "core") {
        let mut before: Option<i64> = None;
        for (at, event) in &thread.events {
            let at = since(*at);
            // Omitted events came within the window of the event before.
            let until =
                before.filter(|_| matches!(event, Event::Omitted(_))).map(|from| (from + i64::from(WINDOW.0)).min(at));
            busy.extend(until.and_then(|until| Some((before?, until.max(before?)))));
            // A sleep is as good as work, until the core wanted to wake.
            if let Event::Woke { slept, late } = event {
                busy.push((at - i64::from(slept.0.max(late.0)), at - i64::from(late.0)));
            }
            busy.push((at, at));
            before = Some(at);
        }
    }
    busy.sort_unstable();
    busy
}
