// SPDX-License-Identifier: GPL-3.0-or-later
//! The core's thread: its scheduling, and its rings to the link.

#![forbid(unsafe_code)]

use std::sync::Arc;
use std::thread::{self, JoinHandle};

use log::warn;
use rtrb::RingBuffer;

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{Dialect, Mcu};
use pinion_firmware::time::Timing;
use pinion_firmware::trouble::Trouble;
use pinion_sync::calls::Progress;

use super::core::{Core, Left, Parts};
use super::core_end::CoreEnd;
use super::ledger::Ledger;
use super::outlet::{self, LinkWake};
use super::pulse::Pulse;
use super::realtime::{self, Processors, Role, Scheduling};
use super::recorder::{Recording, Tape};
use super::started;
use super::status::Teller;
use super::wakeup::{MarginLimits, Waiter};
use super::workers::Threads;

/// Highest number of blocks between link and core: four times the blocks that a host may have under way.
pub(super) const REQUESTS: usize = 256;

/// Everything that the core's thread needs.
pub(super) struct CoreThread {
    pub(super) board: Box<dyn Board>,
    pub(super) timing: Timing,
    /// The dialect that the MCU speaks before a host comes.
    pub(super) dialect: Arc<Dialect>,
    pub(super) wake: Arc<LinkWake>,
    pub(super) pulse: Pulse,
    pub(super) teller: Teller,
    pub(super) recording: Recording,
    pub(super) tape: Tape,
    pub(super) processors: Processors,
    pub(super) margin: MarginLimits,
    pub(super) realtime: bool,
}

impl CoreThread {
    /// Starts the thread, and returns the link's end of it.
    pub(super) fn start(self) -> Result<(JoinHandle<Left>, CoreEnd), Trouble> {
        let (wake, progress) = (self.wake.clone(), Arc::new(Progress::default()));
        let (outlet, inlet) = outlet::outlet(wake.clone(), progress.clone());
        let (requests, inbox) = RingBuffer::new(REQUESTS);
        // Count the processors before the core is confined to one.
        let may_poll = thread::available_parallelism().is_ok_and(|count| count.get() > 1);
        let core_progress = progress.clone();
        let core = started(thread::Builder::new().name("core".into()).spawn(move || {
            let CoreThread {
                board,
                timing,
                dialect,
                wake,
                pulse,
                teller,
                recording,
                tape,
                processors,
                margin,
                realtime,
            } = self;
            if let Err(error) = processors.confine() {
                warn!(
                    "--cpu: the core is not bound to its processor, and runs on any: {error}: choose another processor"
                );
            }
            let scheduling = if realtime { realtime::enter(Role::Core) } else { Scheduling::Ordinary };
            let prepare = Arc::new(move || {
                // A thread inherits the processors of the thread that starts it.
                processors.free();
                if realtime {
                    realtime::enter(Role::Worker);
                }
            });
            let clock = timing.clock.clone();
            let workers = Threads::new(thread::current(), prepare, clock.clone(), pulse, recording, may_poll);
            let mcu = Mcu::new(dialect, board, timing, Box::new(workers), Box::new(outlet));
            let waiter = Waiter::new(clock.clone(), margin, scheduling, processors);
            let (requests, progress) = (inbox, core_progress);
            Core::new(Parts { mcu, clock, requests, waiter, pulse, progress, wake, teller, tape, may_poll }).run()
        }))?;
        let thread = core.thread().clone();
        let ledger = Ledger::default();
        Ok((core, CoreEnd { requests, thread, inlet, progress, wake, ledger, may_poll }))
    }
}
