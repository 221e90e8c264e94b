// SPDX-License-Identifier: GPL-3.0-or-later
//! The core: owns the machine; runs due timers, then commands while no timer is near, then
//! waits.

#![forbid(unsafe_code)]

use std::hint;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use rtrb::Consumer;

use crate::mcu::Mcu;
use crate::shutdown::{Reason, Shutdown};
use crate::time::{Clock, NS_PER_TICK, Ticks, TimeSource};
use crate::wire::block::PAYLOAD_MAX;
use crate::wire::vlq::Reader;

use super::outlet::{LinkWake, Progress};
use super::pulse::{BEAT, Pulse};
use super::wakeup::{Waiter, Woken};

/// The payload of a message block on its way to the core.
#[derive(Clone, Copy)]
pub(super) struct Payload {
    len: u8,
    bytes: [u8; PAYLOAD_MAX],
}

impl Payload {
    /// A copy of `payload`, which is that of a block.
    pub(super) fn new(payload: &[u8]) -> Payload {
        let len = payload.len().min(PAYLOAD_MAX);
        let mut bytes = [0; PAYLOAD_MAX];
        bytes[..len].copy_from_slice(&payload[..len]);
        Payload { len: len as u8, bytes }
    }

    fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// What the link asks of the core.
pub(super) enum Request {
    /// Run the commands of a block.
    Run(Payload),
    /// Stop the machine.
    Shutdown(Shutdown),
    /// Say how late timers were.
    Report,
    /// Stop the machine and end.
    Quit,
    /// Never come back, for a test.
    Hang,
}

/// A command takes a microsecond or two: within this span of a timer none is begun.
const NEAR: Ticks = Ticks::from_us(5);
/// A timer beyond this leaves time for a nap; for a nearer one there is no heartbeat in between.
const FAR: i64 = (BEAT.as_nanos() / NS_PER_TICK as u128) as i64;
/// So long the core looks for the next command before it sleeps: hosts send in bursts, and to be
/// woken takes as long (20 to 50 us on the machines measured). A lone processor is the host's.
const LINGER: Ticks = Ticks::from_us(30);
/// So often commands give way to timers that are near, then one gets its turn.
const PATIENCE: u32 = 20;

pub(super) struct Core {
    mcu: Mcu,
    clock: Arc<dyn TimeSource>,
    requests: Consumer<Request>,
    waiter: Waiter,
    pulse: Pulse,
    progress: Arc<Progress>,
    wake: Arc<LinkWake>,
    /// The block whose commands are run, and how far they were.
    block: Option<(Payload, usize)>,
    gave_way: u32,
    linger: Ticks,
    /// Until when to look for the next command.
    linger_until: Clock,
}

/// What the core is made of.
pub(super) struct Parts {
    pub(super) mcu: Mcu,
    pub(super) clock: Arc<dyn TimeSource>,
    pub(super) requests: Consumer<Request>,
    pub(super) waiter: Waiter,
    pub(super) pulse: Pulse,
    pub(super) progress: Arc<Progress>,
    pub(super) wake: Arc<LinkWake>,
}

/// What a turn for commands came to.
enum Turn {
    Done,
    Idle,
    Quit,
}

impl Core {
    pub(super) fn new(parts: Parts) -> Core {
        let Parts { mcu, clock, requests, waiter, pulse, progress, wake } = parts;
        let linger_until = clock.now();
        let linger = if thread::available_parallelism().is_ok_and(|count| count.get() > 1) { LINGER } else { Ticks(0) };
        let (block, gave_way) = (None, 0);
        Core { mcu, clock, requests, waiter, pulse, progress, wake, block, gave_way, linger, linger_until }
    }

    /// Runs until it is asked to quit.
    pub(super) fn run(mut self) {
        let mut busy_since = self.clock.now();
        let mut was_shutdown = false;
        loop {
            if self.mcu.is_shutdown() != was_shutdown {
                was_shutdown = !was_shutdown;
                if was_shutdown {
                    self.mcu.report_lateness(self.waiter.margin());
                }
            }
            let next = self.mcu.run_timers();
            self.pulse.beat(self.mcu.last_read(), self.mcu.is_running());
            self.mcu.run_workers();
            self.waiter.ran(self.mcu.last_read());
            let near = next.is_some_and(|next| next < self.mcu.last_read() + NEAR);
            if !near || self.gave_way >= PATIENCE {
                match self.run_command() {
                    Turn::Done => {
                        self.linger_until = self.mcu.last_read() + self.linger;
                        continue;
                    }
                    Turn::Quit => {
                        // Workers and devices may take their time to end.
                        self.pulse.beat(self.mcu.now(), false);
                        if !was_shutdown {
                            self.mcu.report_lateness(self.waiter.margin());
                        }
                        return;
                    }
                    Turn::Idle => {}
                }
            }
            let deadline = self.mcu.next_timer();
            let now = self.mcu.now();
            if deadline.is_some_and(|deadline| deadline <= now) {
                self.gave_way += 1;
                continue;
            }
            if now < self.linger_until {
                hint::spin_loop();
                continue;
            }
            self.mcu.account(Ticks(now.since(busy_since) as u32));
            let (requests, mcu, pending) = (&self.requests, &self.mcu, self.block.is_some());
            let to_go = deadline.map_or(2 * FAR, |deadline| deadline.since(now));
            if to_go > FAR {
                // Half the way leaves room for a late wake-up.
                self.nap(BEAT.min(Duration::from_nanos(to_go as u64 / 2 * NS_PER_TICK)));
                busy_since = self.clock.now();
                continue;
            }
            let woken = self.waiter.wait(deadline, || {
                // Within reach of a timer a call has to wait its turn.
                !near && (pending || !requests.is_empty() || mcu.has_completion())
            });
            busy_since = self.clock.now();
            if woken == Woken::Due {
                self.gave_way += 1;
            }
        }
    }

    /// Sleeps for a span in which no timer is due, or until it is called, so that the heartbeat
    /// goes on. Unlike the wait for a timer it ends without spinning.
    fn nap(&mut self, longest: Duration) {
        if self.block.is_none() && self.requests.is_empty() && !self.mcu.has_completion() {
            self.waiter.nap(longest);
        }
    }

    /// How many commands have time before the next timer, if each takes as long as is near.
    fn room(&self) -> i64 {
        let to_go = |next: Clock| next.since(self.mcu.last_read()) / i64::from(NEAR.0);
        self.mcu.next_timer().map_or(i64::MAX, to_go).max(1)
    }

    /// Runs the commands of a block that have time, or takes in what the link asks.
    #[inline]
    fn run_command(&mut self) -> Turn {
        self.gave_way = 0;
        let (payload, mut at) = match self.block.take() {
            Some(block) => block,
            None => match self.requests.pop() {
                Ok(Request::Run(payload)) => {
                    self.progress.begin();
                    (payload, 0)
                }
                Ok(Request::Shutdown(shutdown)) => {
                    self.mcu.shut_down(shutdown);
                    return Turn::Done;
                }
                Ok(Request::Report) => {
                    self.mcu.report_lateness(self.waiter.margin());
                    return Turn::Done;
                }
                Ok(Request::Quit) => {
                    self.mcu.shut_down(Shutdown::because(
                        Reason::ForceShutdown,
                        "the program was asked to end; the host sees the connection close",
                    ));
                    return Turn::Quit;
                }
                Ok(Request::Hang) => loop {
                    thread::park();
                },
                Err(_) => return Turn::Idle,
            },
        };
        let bytes = payload.as_slice();
        let mut reader = Reader::new(&bytes[at..]);
        for _ in 0..self.room() {
            if reader.is_empty() {
                break;
            }
            self.mcu.execute(&mut reader);
        }
        at = bytes.len() - reader.rest().len();
        if at < bytes.len() {
            self.block = Some((payload, at));
        } else {
            self.progress.finish();
            // The next block's end will do, if there is one.
            if self.requests.is_empty() {
                self.wake.wake();
            }
        }
        Turn::Done
    }
}
