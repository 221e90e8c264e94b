// SPDX-License-Identifier: GPL-3.0-or-later
//! The core's trace writer. It costs a few stores for each turn of the core. It neither allocates nor calls the kernel,
//! except when the MCU is configured or stops.

use std::sync::Arc;

use nix::sys::eventfd::EventFd;
use nix::unistd::{Pid, gettid};
use rtrb::Producer;

use pinion_firmware::mcu::{Latest, Mcu};
use pinion_firmware::time::{Clock, Ticks};
use pinion_protocol::vlq::Reader;

use pinion_trace::event::Event;
use pinion_trace::ring::Writer;

use super::span;

/// A timer that is later than this gets an event of its own.
const LATE: Ticks = Ticks::from_us(100);
/// How often the core's pace is recorded.
const PACE: Ticks = Ticks::from_ms(10);

/// News of the core for the recorder.
pub(super) enum News {
    /// The core's thread has started.
    Started(Pid),
    /// The MCU is configured with these objects.
    Configured(Vec<(u8, String)>),
    /// The MCU has stopped.
    Stopped {
        /// When.
        at: Clock,
        /// The text that the host shows.
        reason: &'static str,
        /// The text of the log.
        trouble: String,
    },
}

/// The recording of the core.
pub(crate) struct TraceWriter {
    recent: Writer,
    lasting: Writer,
    news: Producer<News>,
    wake: Arc<EventFd>,
    before: State,
    /// How many blocks the core has begun.
    block: u32,
    /// The latest timer until `pace_at`.
    worst: Ticks,
    pace_at: Clock,
}

/// The core's state at the last call: a bit for each of these conditions. So one comparison finds a change.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
struct State(u8);

impl State {
    const HELD: u8 = 1;
    const CONFIGURED: u8 = 2;
    const STOPPED: u8 = 4;
    const ORDINARY: u8 = 8;

    #[inline]
    fn of(mcu: &Mcu, is_ordinary: bool) -> State {
        State(
            u8::from(mcu.is_held())
                | u8::from(mcu.is_finalized()) << 1
                | u8::from(mcu.is_shutdown()) << 2
                | u8::from(is_ordinary) << 3,
        )
    }

    fn is(self, bit: u8) -> bool {
        self.0 & bit != 0
    }
}

/// A sleep of the core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sleep {
    /// When it began.
    pub from: Clock,
    /// When it ended.
    pub to: Clock,
    /// When it should have ended.
    pub until: Clock,
}

impl TraceWriter {
    pub(super) fn new((recent, lasting): (Writer, Writer), news: Producer<News>, wake: Arc<EventFd>) -> TraceWriter {
        let (before, pace_at) = (State::default(), Clock::EPOCH);
        TraceWriter { recent, lasting, news, wake, before, block: 0, worst: Ticks(0), pace_at }
    }

    /// The core's thread, which calls this, has started.
    pub(crate) fn start(&mut self) {
        self.send(News::Started(gettid()));
    }

    /// The core has slept.
    #[inline]
    pub(crate) fn woke(&mut self, Sleep { from, to, until }: Sleep) {
        self.recent.write(to, Event::Woke { slept: span(from, to), late: span(until, to) });
    }

    /// The core has begun the next block of the host.
    #[inline]
    pub(crate) fn began(&mut self, at: Clock, block: u32) {
        self.block = block;
        self.recent.write(at, Event::Block(block));
    }

    /// The core has run this many commands from the beginning of `payload`.
    #[inline]
    pub(crate) fn ran(&mut self, at: Clock, payload: &[u8], count: u32) {
        if count == 0 {
            return;
        }
        let id = Reader::new(payload).int().unwrap_or(0) as i16;
        self.recent.write(at, Event::Command { id, more: (count - 1).min(u8::MAX.into()) as u8 });
    }

    /// Records the changes since the last call. The core calls it when no timer is due, and while it is behind.
    #[inline]
    pub(crate) fn turn(&mut self, mcu: &mut Mcu, is_ordinary: bool) {
        let at = mcu.last_read();
        let latest = mcu.latest();
        if latest.late > self.worst {
            self.is_later(at, latest);
        }
        let state = State::of(mcu, is_ordinary);
        if state != self.before {
            self.changed(at, state, mcu);
        }
        if at >= self.pace_at {
            self.pace(at);
            mcu.forget_latest();
        }
    }

    #[cold]
    fn is_later(&mut self, at: Clock, Latest { late, oid }: Latest) {
        self.worst = late;
        if late > LATE {
            // After a late timer, others that were due during the delay are late as well.
            self.lasting.write(at, Event::Late { oid, late });
        }
    }

    #[cold]
    fn pace(&mut self, at: Clock) {
        let worst = std::mem::take(&mut self.worst);
        self.pace_at = at + PACE;
        // Each timer is a little late. Without one, nothing is written: the recorder samples a calm core less often.
        if worst.0 > 0 {
            self.lasting.write(at, Event::Pace { worst });
        }
    }

    #[cold]
    fn changed(&mut self, at: Clock, state: State, mcu: &Mcu) {
        let before = std::mem::replace(&mut self.before, state);
        let changed = State(state.0 ^ before.0);
        if changed.is(State::HELD) {
            self.lasting.write(at, if state.is(State::HELD) { Event::Held } else { Event::Released });
        }
        if changed.is(State::ORDINARY) {
            self.lasting.write(at, Event::Scheduling { fifo: !state.is(State::ORDINARY) });
        }
        if changed.is(State::CONFIGURED) {
            let configured = state.is(State::CONFIGURED);
            self.lasting.write(at, if configured { Event::Configured } else { Event::Reset });
            if configured {
                self.send(News::Configured(mcu.object_names()));
            }
        }
        if changed.is(State::STOPPED)
            && let Some((stop, stopped_at)) = mcu.last_stop()
        {
            self.lasting.write(stopped_at, Event::Stopped { block: self.block });
            if let Some(due) = stop.due {
                self.lasting.write(stopped_at, Event::Due(due));
            }
            let (reason, trouble) = (stop.reason.text(), stop.trouble.to_string());
            self.send(News::Stopped { at: stopped_at, reason, trouble });
        }
    }

    fn send(&mut self, news: News) {
        // News without room are dropped: the recorder has enough to write.
        if self.news.push(news).is_ok() {
            let _ = self.wake.write(1);
        }
    }
}
