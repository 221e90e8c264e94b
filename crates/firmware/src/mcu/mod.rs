// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU: oids, timers, move queue, shutdown.
//!
//! It does no I/O of its own. It reads the time from a given clock and calls the board's traits. It leaves its
//! responses in an outbox. So all of it also runs in virtual time.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::Board;
use crate::time::Timing;

pub mod base;
mod batch;
mod bus;
mod calls;
mod command;
mod configuration;
mod dialect;
mod errand;
mod generation;
mod hold;
mod lines;
mod messages;
mod moves;
mod object;
mod outbox;
mod parameters;
mod remote;
mod schedule;
mod slot;
mod snapshot;
mod stats;
mod stop;
mod timers;
mod turn;
mod wire;

pub use crate::{command, response};
pub use batch::Batch;
pub use bus::{Bus, Conversation, Talk};
pub use calls::{Calls, UNREAD_LIMIT, Unread};
pub use command::{Command, Constant, ConstantValue, Enumeration, Feature, Form, Handler, Response, place_of_response};
pub use dialect::{Dialect, Firmware};
pub use errand::{Completion, Done, Errand, Job, Parcel, Refused, WorkerId, Workers};
pub use generation::{DialectName, Generation, Generations, only, since, until};
pub use hold::Hold;
pub use lines::{InputLine, Look, OutputLine, PromptLine};
pub use moves::{MOVE_COUNT, MovePool, MoveQueue};
pub use object::{Next, Object, Safe};
pub use outbox::{Note, Outbox};
pub use parameters::{Oid, WireClock};
pub use remote::{Remote, Settable};
pub use schedule::{Latest, SPIN_MAX};
pub use slot::{Back, Slot};
pub use snapshot::{BusCounts, LineState, LineUse, ObjectState, Present, QueueState, Report, Snapshot};
pub use stop::RETRY_TICKS;
pub use timers::Timer;
pub use turn::Turn;
pub use wire::{CANBUS_UUID_BYTES, CanHealth, CanNode, CanState, Wire};

use configuration::{Configuration, OBJECTS_MAX};
use hold::Holds;
use messages::Spoken;
use schedule::Schedule;
use stop::Stop;
use timers::TimerId;

/// The MCU's own responses come first in the list of all responses.
const fn response_index(format: &str) -> usize {
    place_of_response(&[base::FEATURE], format)
}

/// The MCU.
pub struct Mcu {
    /// Counts the free moves.
    pub moves: MovePool,
    schedule: Schedule,
    board: Box<dyn Board>,
    workers: Box<dyn Workers>,
    outbox: Box<dyn Outbox>,
    spoken: Spoken,
    configuration: Configuration,
    holds: Holds,
    stop: Stop,
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
        let mut mcu = Mcu {
            moves: MovePool::default(),
            schedule: Schedule::new(timing),
            board,
            workers,
            outbox,
            spoken: Spoken { dialect, next: None },
            configuration: Configuration::default(),
            holds: Holds::default(),
            stop: Stop::default(),
        };
        mcu.send(base::Starting {});
        mcu
    }
}
