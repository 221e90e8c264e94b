// SPDX-License-Identifier: GPL-3.0-or-later
//! One order: commands wait for the jobs that commands began.
//!
//! Klipper's C runs a command to its end before it reads the next one. It acknowledges a block after the block's
//! last command. klippy relies on both. So a job that a command sends *holds*: the core runs no further command
//! until the job is back, and does not acknowledge the block ([`Mcu::is_held`]). Timers go on, and jobs that they
//! send hold nothing. A stopped MCU is not held.
//!
//! A command without an answer (`spi_send`) lets other commands to its object join ([`Mcu::may_run`]). Their jobs
//! follow its own on the same bus, in their order. Its block is finished at once. All other commands wait for the last
//! of these jobs. So a display costs one wake-up for several messages.

use crate::shutdown::{Shutdown, reason};
use crate::time::Ticks;

use pinion_protocol::vlq::Reader;

use super::{Mcu, Oid, State, TimerId};

/// How long commands may wait for a job before the MCU stops. klippy also gives up waiting for an answer after five
/// seconds (`SerialRetryCommand` in serialhdl.py). Without this limit, a bus that hangs would keep the host from
/// stopping the MCU. Once the host's window of unacknowledged blocks is full, the host cannot even send an
/// `emergency_stop`.
const HOLD_LIMIT: Ticks = Ticks::from_ms(5000);

/// The holds that make commands wait.
#[derive(Default)]
pub(super) struct Barrier {
    /// Whether a command runs now, or the MCU takes back a job that a command sent.
    is_commanded: bool,
    /// Jobs that commands wait for.
    count: u32,
    /// The object that sent the last of them.
    holder: Option<Oid>,
    /// Highest number of jobs, if the holder lets others join; else 0.
    join_limit: u32,
}

/// Makes commands wait until it is [released](super::Context::release). It has no effect if no command asked for it.
#[must_use]
pub struct Hold(pub(super) bool);

impl Barrier {
    #[inline]
    pub(super) fn begin_command(&mut self) {
        self.is_commanded = true;
    }

    #[inline]
    pub(super) fn end_command(&mut self) {
        self.is_commanded = false;
    }

    /// A job is back. If a command sent it, the jobs that its object sends now also belong to the command.
    pub(super) fn take_back(&mut self, holds: bool) {
        self.is_commanded = holds;
    }

    /// See [`Context::let_join`](super::Context::let_join).
    pub(super) fn let_join(&mut self, limit: u32) {
        self.join_limit = limit;
    }

    /// Whether commands wait for jobs.
    #[inline]
    fn is_closed(&self) -> bool {
        self.count > 0
    }
}

impl State {
    /// See [`Context::hold`](super::Context::hold).
    pub(super) fn hold(&mut self, holder: Oid) -> Hold {
        let is_commanded = self.barrier.is_commanded;
        if is_commanded {
            self.limit_hold();
            self.barrier.count += 1;
            self.barrier.holder = Some(holder);
            self.barrier.join_limit = 0;
        }
        Hold(is_commanded)
    }

    /// Starts the time of [`HOLD_LIMIT`] again. The MCU stops if commands still wait after it.
    fn limit_hold(&mut self) {
        self.scheduler.cancel(TimerId::HOLD);
        let limit = self.scheduler.now() + HOLD_LIMIT;
        self.scheduler.start(TimerId::HOLD, limit);
    }

    /// See [`Context::release`](super::Context::release).
    pub(super) fn release(&mut self, Hold(waits): Hold) {
        if !waits {
            return;
        }
        self.barrier.is_commanded = false;
        self.barrier.count = self.barrier.count.saturating_sub(1);
        if !self.barrier.is_closed() {
            self.scheduler.cancel(TimerId::HOLD);
        } else if self.is_held() {
            self.limit_hold();
        }
    }

    #[inline]
    pub(super) fn is_held(&self) -> bool {
        // The core asks in each of its turns: without branches this takes half the time.
        self.barrier.is_closed() & !self.phase.is_stopped() | self.phase.is_reset_due()
    }

    /// Called after a stop. A job from before the stop holds commands again, and its limit may have passed.
    pub(super) fn hold_again(&mut self) {
        if self.barrier.is_closed() {
            self.limit_hold();
        }
    }
}

impl Mcu {
    /// Whether no further command may run now. Either a command's job is on its way, or a `config_reset` waits for
    /// the outputs.
    #[inline]
    pub fn is_held(&self) -> bool {
        self.state.is_held()
    }

    /// Whether the last command keeps its block unacknowledged until commands may run again.
    #[inline]
    pub fn keeps_block(&self) -> bool {
        self.is_held() && (self.state.barrier.join_limit == 0 || self.state.phase.is_reset_due())
    }

    /// Whether the first command of this payload may run now: commands do not [wait](Mcu::is_held), or it joins the
    /// command that they wait for.
    #[inline]
    pub fn may_run(&self, payload: &[u8]) -> bool {
        !self.is_held() || self.joins(payload)
    }

    fn joins(&self, payload: &[u8]) -> bool {
        if self.keeps_block() || self.state.barrier.count >= self.state.barrier.join_limit {
            return false;
        }
        let mut reader = Reader::new(payload);
        let command = reader.int().ok().and_then(|id| self.heard().command(id).ok());
        command.is_some_and(|command| command.joins)
            && reader
                .int()
                .is_ok_and(|oid| self.state.barrier.holder.is_some_and(|holder| holder.index() == oid as usize))
    }

    /// Runs when the timer of [`HOLD_LIMIT`] is due: commands have waited too long for a job.
    pub(super) fn held_too_long(&mut self) {
        if self.is_held() {
            let holder = self.state.barrier.holder.and_then(|oid| Some((oid, self.state.objects.get(oid)?.kind())));
            let what = holder.map_or_else(|| "a device".to_owned(), |(oid, kind)| self.state.name_object(kind, oid));
            let cause = format!("{what} has not answered for {} s", HOLD_LIMIT.0 / crate::time::CLOCK_FREQ);
            let stop = Shutdown::because(reason::BUS_HANGS, cause);
            self.shut_down(stop.remedy("check its power and wiring, and look at the kernel's log (dmesg)"));
        }
    }
}
