// SPDX-License-Identifier: GPL-3.0-or-later
//! Slots: an object's places for its errands.
//!
//! What is in a slot cannot be lost. It is here, or a worker has it. If it cannot be sent, it stays here.

#![forbid(unsafe_code)]

use std::any::Any;
use std::mem;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::errand::{Job, Parcel, Refused};
use super::{Done, Errand, Hold, Turn, WorkerId};

/// The place of an errand, which is here or away with a worker.
pub struct Slot<E: Errand>(Place<E>);

enum Place<E: Errand> {
    Here(Box<Packed<E>>),
    Away {
        /// Where the box is in memory: by that its slot knows it again.
        address: usize,
        /// Whether the object still wants what comes of it.
        counts: bool,
    },
}

/// An errand in the box in which it travels, with what came of it the last time.
struct Packed<E: Errand> {
    errand: E,
    outcome: Option<Result<E::Answer, E::Failure>>,
}

impl<E: Errand> Parcel for Packed<E> {
    fn run(&mut self) {
        self.outcome = Some(self.errand.run());
    }
}

/// What came of an errand that is back.
pub struct Back<'a, E: Errand> {
    /// The answer. A failure stays in the slot, as the core would free it.
    pub result: Result<E::Answer, &'a E::Failure>,
    /// False if the object [has dropped](Slot::drop_pending) it meanwhile.
    pub counts: bool,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker had done it.
    pub ended: Clock,
}

fn address(parcel: &dyn Parcel) -> usize {
    (&raw const *parcel).addr()
}

impl<E: Errand> Slot<E> {
    /// A slot with its errand. It allocates: objects make theirs at configuration.
    pub fn new(errand: E) -> Slot<E> {
        Slot(Place::Here(Box::new(Packed { errand, outcome: None })))
    }

    /// The errand, to be made ready; `None` while it is away.
    pub fn here(&mut self) -> Option<&mut E> {
        match &mut self.0 {
            Place::Here(packed) => Some(&mut packed.errand),
            Place::Away { .. } => None,
        }
    }

    /// Whether the errand is here.
    pub fn is_here(&self) -> bool {
        matches!(self.0, Place::Here(_))
    }

    /// Whether the errand is away, and what comes of it counts.
    pub fn is_pending(&self) -> bool {
        matches!(self.0, Place::Away { counts: true, .. })
    }

    /// Drops what comes of an errand that is away: it counts no more.
    pub fn drop_pending(&mut self) {
        if let Place::Away { counts, .. } = &mut self.0 {
            *counts = false;
        }
    }

    /// Sends the errand to a worker, if it is here. It comes back to [`Object::returned`](super::Object::returned). If
    /// a command sends it, further commands wait until it is back; likewise if an object sends it on the return of an
    /// errand for which commands wait.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn send(&mut self, turn: &mut Turn, worker: WorkerId) -> Result<(), Shutdown> {
        if !self.is_here() {
            return Ok(());
        }
        let hold = turn.hold();
        self.send_with(turn, worker, hold)
    }

    /// The same with a hold that the sender has already.
    pub(super) fn send_with(&mut self, turn: &mut Turn, worker: WorkerId, hold: Hold) -> Result<(), Shutdown> {
        let Place::Here(packed) = &self.0 else { return Ok(()) };
        let away = Place::Away { address: address(&**packed), counts: true };
        let Place::Here(parcel) = mem::replace(&mut self.0, away) else { return Ok(()) };
        match turn.submit(worker, Job { oid: turn.oid(), parcel, holds: hold.0 }) {
            Ok(()) => Ok(()),
            Err(Refused { job, why }) => {
                self.put_back(job.parcel);
                turn.release(hold);
                Err(why)
            }
        }
    }

    /// Takes the errand that is done, if it is this slot's.
    pub fn back(&mut self, done: &mut Done) -> Option<Back<'_, E>> {
        let Place::Away { address: own, counts } = self.0 else { return None };
        let parcel = done.parcel.take_if(|parcel| address(&**parcel) == own)?;
        self.put_back(parcel);
        let Place::Here(packed) = &self.0 else { return None };
        let result = packed.outcome.as_ref()?.as_ref().map(|answer| *answer);
        Some(Back { result, counts, began: done.began, ended: done.ended })
    }

    fn put_back(&mut self, parcel: Box<dyn Parcel>) {
        let any: Box<dyn Any> = parcel;
        if let Ok(packed) = any.downcast() {
            self.0 = Place::Here(packed);
        }
    }
}
