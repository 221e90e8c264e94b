// SPDX-License-Identifier: GPL-3.0-or-later
//! The core's thread: its scheduling, and its rings to the link.

use std::sync::Arc;
use std::thread::{self, JoinHandle};

use log::warn;
use rtrb::RingBuffer;

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{Dialect, EdgeRecorder, Mcu, Tolerances};
use pinion_firmware::time::Timing;
use pinion_firmware::trouble::Trouble;
use pinion_linux::parker::Parker;
use pinion_shm::progress::Progress;

use crate::core::heartbeat::Heartbeat;
use crate::core::responses::{self, LinkWake};
use crate::core::wakeup::{MarginLimits, Waiter};
use crate::core::workers::Threads;
use crate::core::{Core, OutputState, Parts};
use crate::link::core_end::CoreEnd;
use crate::link::ledger::Ledger;
use crate::process::realtime::{self, Processors, Role, Scheduling};
use crate::recorder::{Recording, TraceWriter};
use crate::status::SnapshotWriter;
use crate::trouble::started;

/// Highest number of blocks between link and core: four times the blocks that a host may have under way.
pub(crate) const REQUESTS: usize = 256;

/// Everything that the core's thread needs.
pub(crate) struct CoreThread {
    pub(crate) board: Box<dyn Board>,
    /// Set if the edges of outputs are recorded.
    pub(crate) edges: Option<Arc<dyn EdgeRecorder>>,
    pub(crate) timing: Timing,
    /// The dialect that the MCU speaks before a host comes.
    pub(crate) dialect: Arc<Dialect>,
    /// The devices whose failures the user tolerates.
    pub(crate) tolerances: Tolerances,
    pub(crate) wake: Arc<LinkWake>,
    pub(crate) heartbeat: Heartbeat,
    pub(crate) snapshots: SnapshotWriter,
    pub(crate) recording: Recording,
    pub(crate) trace_writer: TraceWriter,
    pub(crate) processors: Processors,
    pub(crate) margin: MarginLimits,
    pub(crate) realtime: bool,
}

impl CoreThread {
    /// Starts the thread, and returns the link's end of it.
    pub(crate) fn start(self) -> Result<(JoinHandle<OutputState>, CoreEnd), Trouble> {
        let (wake, progress) = (self.wake.clone(), Arc::new(Progress::default()));
        let (response_ring, reader) = responses::response_ring(wake.clone(), progress.clone());
        let (requests, inbox) = RingBuffer::new(REQUESTS);
        // Count the processors before the core is confined to one.
        let may_poll = thread::available_parallelism().is_ok_and(|count| count.get() > 1);
        let parker = Arc::new(Parker::default());
        let (core_progress, core_parker) = (progress.clone(), parker.clone());
        let core = started(thread::Builder::new().name("core".into()).spawn(move || {
            let CoreThread { timing, heartbeat, processors, realtime, snapshots, trace_writer, .. } = self;
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
            let workers =
                Threads::new(core_parker.clone(), prepare, clock.clone(), heartbeat, self.recording, may_poll);
            let mut mcu = Mcu::new(self.dialect, self.board, timing, Box::new(workers), Box::new(response_ring));
            mcu.tolerate(self.tolerances);
            self.edges.into_iter().for_each(|edges| mcu.record_edges(edges));
            let waiter = Waiter::new(clock, core_parker, self.margin, scheduling, processors);
            let (requests, progress, wake) = (inbox, core_progress, self.wake);
            Core::new(Parts { mcu, requests, waiter, heartbeat, progress, wake, snapshots, trace_writer, may_poll })
                .run()
        }))?;
        let ledger = Ledger::default();
        Ok((core, CoreEnd { requests, parker, reader, progress, wake, ledger, asked_at: None, may_poll }))
    }
}
