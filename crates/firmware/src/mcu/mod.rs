// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU: oids, timers, move queue, shutdown.
//!
//! It does no I/O of its own. It reads the time from a given clock and calls the board's traits. It leaves its
//! responses in an outbox. So all of it also runs in virtual time.

use std::sync::Arc;

use crate::board::Board;
use crate::time::Timing;

mod barrier;
pub mod base;
mod batch;
mod bus;
mod calls;
mod claims;
mod command;
mod configuration;
mod context;
mod dialect;
mod dialects;
mod forms;
mod inputs;
mod job;
mod job_slot;
mod level;
mod lines;
mod messages;
mod moves;
mod objects;
mod outbox;
mod outputs;
mod parameters;
mod phase;
mod remote;
mod scheduler;
mod snapshot;
mod stats;
mod stop;
mod timers;
mod tolerance;
mod wire;

pub use crate::{command, response};
pub use barrier::Hold;
pub use batch::Batch;
pub use bus::{Bus, Chip};
pub use calls::{Calls, UNREAD_LIMIT, Unread};
pub use command::{Command, Constant, ConstantValue, Enumeration, Feature, Form, Handler, Response, place_of_response};
pub use context::Context;
pub use dialect::{Dialect, Firmware, Names};
pub use dialects::DialectName;
pub use forms::{Entry, Forms, HostForms, Hosts, Item, Part, entries};
pub use inputs::{InputLine, Sample};
pub use job::{AnyJob, DeviceId, Devices, Finished, Job, SentJob, WorkerId, Workers};
pub use job_slot::{Back, JobSlot};
pub use level::EdgeRecorder;
pub use moves::{MOVE_COUNT, MovePool, MoveQueue};
pub use objects::{Next, Object, Safe};
pub use outbox::{DeviceWarning, Note, Outbox};
pub use outputs::{OutputLine, PromptLine};
pub use parameters::{Oid, WireClock};
pub use remote::{Remote, Settable};
pub use scheduler::{Latest, SPIN_MAX};
pub use snapshot::{BusCounts, LineState, LineUse, ObjectState, Present, QueueState, Report, Snapshot};
pub use stop::RETRY_TICKS;
pub use timers::Timer;
pub use tolerance::{Device, Limit, Tolerance, Tolerances};
pub use wire::{CANBUS_UUID_BYTES, CanHealth, CanNode, CanState, Wire};

use barrier::Barrier;
use claims::Lines;
use messages::HostWire;
use objects::{OBJECTS_MAX, Objects};
use phase::Phase;
use scheduler::Scheduler;
use stop::PendingValues;
use timers::TimerId;

/// The MCU's own responses come first in the list of all responses.
const fn response_index(format: &str) -> usize {
    place_of_response(&[base::FEATURE], format)
}

/// The MCU, for the program that runs it: it runs timers, commands and finished jobs.
pub struct Mcu {
    state: State,
}

/// The state of the MCU. A feature sees it through its [`Context`]: it cannot run timers or commands.
struct State {
    phase: Phase,
    scheduler: Scheduler,
    objects: Objects,
    lines: Lines,
    barrier: Barrier,
    pending: PendingValues,
    moves: MovePool,
    wire: HostWire,
    board: Box<dyn Board>,
    workers: Box<dyn Workers>,
    /// The devices whose failures the user tolerates.
    tolerances: Tolerances,
    /// Set if somebody records the edges of outputs.
    recorder: Option<Arc<dyn EdgeRecorder>>,
}

impl Mcu {
    /// Creates an MCU that waits for its configuration, and sends `starting`.
    pub fn new(
        dialect: Arc<Dialect>,
        board: Box<dyn Board>,
        timing: Timing,
        workers: Box<dyn Workers>,
        outbox: Box<dyn Outbox>,
    ) -> Mcu {
        let mut state = State {
            phase: Phase::default(),
            scheduler: Scheduler::new(timing),
            objects: Objects::default(),
            lines: Lines::default(),
            barrier: Barrier::default(),
            pending: PendingValues::default(),
            moves: MovePool::default(),
            wire: HostWire::new(dialect, outbox),
            board,
            workers,
            tolerances: Tolerances::new(),
            recorder: None,
        };
        state.wire.send(base::Starting {});
        Mcu { state }
    }

    /// Tolerates the failures of these devices, if a host configures them from now on.
    pub fn tolerate(&mut self, tolerances: Tolerances) {
        self.state.tolerances = tolerances;
    }

    /// Records the edges of the outputs that a host claims from now on.
    pub fn record_edges(&mut self, recorder: Arc<dyn EdgeRecorder>) {
        self.state.recorder = Some(recorder);
    }

    /// The context of a command to the MCU itself. A handler that [`command!`] makes passes it on.
    pub fn context(&mut self) -> Context<'_> {
        Context::new(&mut self.state, Oid::NONE)
    }
}
