// SPDX-License-Identifier: GPL-3.0-or-later
//! The core owns the MCU. It runs due timers first, then commands while no timer is near. Otherwise it waits.

pub(crate) mod budget;
pub(crate) mod busy_poll;
mod calls;
mod commands;
pub(crate) mod heartbeat;
pub(crate) mod monitors;
mod request;
pub(crate) mod responses;
pub(crate) mod start;
pub mod wakeup;
pub(crate) mod workers;

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use rtrb::Consumer;

use pinion_firmware::mcu::Mcu;
use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks};
use pinion_linux::clock::monotonic;
use pinion_shm::progress::Progress;

use crate::core::busy_poll::PollBudget;
use crate::core::heartbeat::{BEAT, Heartbeat};
use crate::core::responses::LinkWake;
use crate::core::wakeup::{Waiter, WakeReason};
use crate::recorder::TraceWriter;
use crate::status::SnapshotWriter;

use calls::Calls;
pub(crate) use request::{Payload, Request};

/// No command starts if a timer is due within this span. A command takes one or two microseconds.
const NEAR: Ticks = Ticks::from_us(5);
/// Before a timer farther away than this, the core naps. Before a nearer one it needs no heartbeat.
const FAR_TICKS: i64 = (BEAT.as_nanos() / NS_PER_TICK as u128) as i64;
/// Work that can wait is done only if no timer is due within this span. To wake the link takes some microseconds. To
/// publish a part of the status takes one, or several if nothing of it is in the cache.
const SOON: Ticks = Ticks::from_us(30);
/// Highest number of waiting requests at which a core held by a bus wakes the link for finished blocks. To acknowledge
/// each block costs as much as to run it.
const FEW: usize = 3;
/// How long the core polls for the next command before it sleeps. Hosts send in bursts. A wake-up takes as long: 20 to
/// 50 us on the computers measured.
const NEXT_COMMAND: Ticks = Ticks::from_us(30);
/// How long the core polls for the answer of a bus that a command waits for.
const ANSWER: Ticks = Ticks::from_us(100);
/// Longest time that another thread keeps the processor after a yield. 3.5 ms were measured.
const SLICE: Ticks = Ticks::from_ms(5);
/// A command runs after it has yielded to this many timers.
const YIELDS_MAX: u32 = 20;
/// How long an ending program waits until its outputs have their shutdown values. The guardian acts earlier.
const LAST_WRITES: Duration = Duration::from_millis(1500);

pub(crate) struct Core {
    mcu: Mcu,
    requests: Consumer<Request>,
    waiter: Waiter,
    heartbeat: Heartbeat,
    progress: Arc<Progress>,
    wake: Arc<LinkWake>,
    /// The present block, and the offset of its next command.
    block: Option<(Payload, usize)>,
    yielded: u32,
    /// How many of the link's stop requests the core has taken.
    stops_taken: u32,
    /// The link was not yet woken for some finished blocks.
    untold: bool,
    polling: PollBudget,
    /// The output whose shutdown value is pending, as the guardian knows.
    pending: Option<String>,
    snapshots: SnapshotWriter,
    trace_writer: TraceWriter,
}

/// The parts of the core.
pub(crate) struct Parts {
    pub(crate) mcu: Mcu,
    pub(crate) requests: Consumer<Request>,
    pub(crate) waiter: Waiter,
    pub(crate) heartbeat: Heartbeat,
    pub(crate) progress: Arc<Progress>,
    pub(crate) wake: Arc<LinkWake>,
    pub(crate) snapshots: SnapshotWriter,
    pub(crate) trace_writer: TraceWriter,
    /// There is a second processor, so that the core may poll.
    pub(crate) may_poll: bool,
}

/// The result of a turn for commands.
enum Turn {
    Done,
    Idle,
    Quit,
}

/// The state of the outputs after the program was asked to end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum OutputState {
    /// At their shutdown values.
    Safe,
    /// This output is not at its shutdown value, as far as is known.
    Pending(String),
}

impl Core {
    pub(crate) fn new(parts: Parts) -> Core {
        let Parts { mcu, requests, waiter, heartbeat, progress, wake, snapshots, trace_writer, may_poll } = parts;
        Core {
            untold: false,
            polling: PollBudget::new(may_poll, mcu.last_read()),
            mcu,
            requests,
            waiter,
            heartbeat,
            progress,
            wake,
            block: None,
            yielded: 0,
            stops_taken: 0,
            pending: None,
            snapshots,
            trace_writer,
        }
    }

    /// Runs until it is asked to quit.
    pub(crate) fn run(mut self) -> OutputState {
        self.trace_writer.start();
        let mut busy_since = self.mcu.now();
        let mut was_shutdown = false;
        loop {
            if self.mcu.is_shutdown() != was_shutdown {
                was_shutdown = !was_shutdown;
                if was_shutdown {
                    self.mcu.report_lateness(self.waiter.margin());
                }
            }
            let behind = self.mcu.run_timers();
            if let Some(standstill) = self.heartbeat.standstill(self.mcu.last_read()) {
                self.mcu.shut_down(standstill);
            }
            self.heartbeat.beat(self.mcu.last_read(), self.mcu.is_running());
            self.mcu.run_workers();
            self.tell_pending();
            self.waiter.ran(self.mcu.last_read());
            if behind {
                self.record();
            }
            if self.mcu.is_held() && !self.mcu.is_shutdown() && self.progress.stops_handed() != self.stops_taken {
                self.stop_ahead();
            }
            let near = self.mcu.next_timer().is_some_and(|next| next < self.mcu.last_read() + NEAR);
            if behind || !near || self.yielded >= YIELDS_MAX {
                match self.run_commands(behind) {
                    Turn::Done => {
                        let span = if self.mcu.is_held() { ANSWER } else { NEXT_COMMAND };
                        self.polling.expect(self.mcu.last_read(), span);
                        continue;
                    }
                    Turn::Quit => {
                        if !was_shutdown {
                            self.mcu.report_lateness(self.waiter.margin());
                        }
                        return self.end();
                    }
                    Turn::Idle => {}
                }
            }
            let deadline = self.mcu.next_timer();
            // The timers have just read it, if none is due.
            let now = self.mcu.last_read();
            if deadline.is_some_and(|deadline| deadline <= now) {
                self.yielded += 1;
                continue;
            }
            self.record();
            if self.do_spare_work(now, deadline) {
                continue;
            }
            self.mcu.account(Ticks(now.since(busy_since) as u32));
            busy_since = self.wait(now, deadline);
        }
    }

    /// Does a piece of the work that can wait: a part of the status, a wake-up of the link, a poll. Returns false if
    /// there is none, or if a timer is near.
    #[inline]
    fn do_spare_work(&mut self, now: Clock, deadline: Option<Clock>) -> bool {
        let is_soon = deadline.is_some_and(|deadline| deadline <= now + SOON);
        if self.snapshots.is_asked() && !is_soon {
            self.snapshots.publish(&self.mcu, self.requests.slots(), self.waiter.margin());
            return true;
        }
        if self.untold && self.mcu.is_held() && self.requests.slots() <= FEW && !is_soon {
            self.untold = false;
            self.wake.wake();
            return true;
        }
        if self.polling.goes_on(now)
            && self.waiter.has_time_to_spare()
            && may_yield(self.waiter.is_realtime(), now, deadline)
        {
            thread::yield_now();
            return true;
        }
        false
    }

    /// Waits until a timer is due, or for a call. Before a far timer the core sleeps without spinning at the end, so that
    /// the heartbeat continues. Returns the time now.
    #[inline]
    fn wait(&mut self, now: Clock, deadline: Option<Clock>) -> Clock {
        let Core { waiter, progress, stops_taken, yielded, mcu, block, requests, .. } = self;
        let calls = Calls { core: progress, stops_taken: *stops_taken, mcu, block: block.as_ref(), requests };
        let to_go = deadline.map_or(2 * FAR_TICKS, |deadline| deadline.since(now));
        let Some(deadline) = deadline.filter(|_| to_go <= FAR_TICKS) else {
            // Sleep half the way: this leaves room for a late wake-up.
            let end = now + Ticks(FAR_TICKS.min(to_go / 2) as u32);
            return if calls.any() { now } else { waiter.nap(now, end) };
        };
        let exact = calls.mcu.next_exact_timer();
        // Near a timer, calls have to wait.
        match waiter.wait(now, deadline, exact, |now| deadline >= now + NEAR && calls.any()) {
            // The edge must not wait for another read of the clock.
            WakeReason::Due(now) => {
                mcu.saw(now);
                *yielded += 1;
                now
            }
            WakeReason::Called(now) => now,
        }
    }

    /// Records the last sleep, and the MCU's changes. The core does this when no timer is due, before it polls or
    /// sleeps.
    #[inline]
    fn record(&mut self) {
        if let Some(sleep) = self.waiter.take_sleep() {
            self.trace_writer.woke(sleep);
        }
        self.trace_writer.turn(&mut self.mcu, !self.waiter.is_realtime());
    }

    /// Gives the guardian the name of an output with a pending shutdown value.
    fn tell_pending(&mut self) {
        if !self.mcu.has_pending_values() {
            if self.pending.take().is_some() {
                self.heartbeat.clear_pending(self.mcu.last_read());
            }
            return;
        }
        let pending = self.mcu.pending_value();
        if pending != self.pending.as_deref() {
            self.heartbeat.set_pending(pending.unwrap_or_default(), self.mcu.last_read());
            self.pending = pending.map(str::to_owned);
        }
    }

    /// Waits until the outputs have their shutdown values.
    fn end(mut self) -> OutputState {
        let deadline = monotonic() + LAST_WRITES;
        while self.mcu.has_pending_values() && monotonic() < deadline {
            self.mcu.run_timers();
            self.mcu.run_workers();
            self.tell_pending();
            self.heartbeat.beat(self.mcu.now(), false);
            thread::sleep(Duration::from_millis(1));
        }
        let left =
            self.mcu.pending_value().map_or(OutputState::Safe, |pending| OutputState::Pending(pending.to_owned()));
        // This beat gives workers and devices time to end.
        self.heartbeat.beat(self.mcu.now(), false);
        left
    }
}

/// Whether a yield cannot delay a timer. After a yield, an ordinary thread may be without a processor for the slices of
/// other threads. A thread that wakes up gets its turn.
fn may_yield(realtime: bool, now: Clock, deadline: Option<Clock>) -> bool {
    realtime || deadline.is_none_or(|deadline| deadline > now + SLICE)
}

#[cfg(test)]
mod tests;
