// SPDX-License-Identifier: GPL-3.0-or-later
//! Slots: an object's places for its errands.
//!
//! An errand in a slot cannot be lost. It is here, or a worker has it. If it cannot be sent, it stays here.

#![forbid(unsafe_code)]

use std::any::Any;
use std::mem;

use crate::shutdown::Shutdown;
use crate::time::Clock;

use super::errand::{Parcel, Refused, SentJob};
use super::{Context, Done, Errand, Hold, WorkerId};

/// The place of an errand. The errand is here or with a worker.
pub struct Slot<E: Errand> {
    place: Place<E>,
    /// The place of the output that the errand belongs to; `None` if it belongs to an object.
    output: Option<usize>,
}

enum Place<E: Errand> {
    Here(Box<Packed<E>>),
    Away {
        /// The box's address in memory. The slot recognizes its errand by it.
        address: usize,
        /// Whether the object still wants the result.
        counts: bool,
    },
}

/// An errand in the box in which it travels, with its last result.
struct Packed<E: Errand> {
    errand: E,
    outcome: Option<Result<E::Answer, E::Failure>>,
}

impl<E: Errand> Parcel for Packed<E> {
    fn run(&mut self) {
        self.outcome = Some(self.errand.run());
    }
}

/// The result of an errand that has returned.
pub struct Back<'a, E: Errand> {
    /// The answer. A failure stays in the slot, because otherwise the core would have to free its memory.
    pub result: Result<E::Answer, &'a E::Failure>,
    /// False if the object [has dropped](Slot::drop_pending) the result.
    pub counts: bool,
    /// When the worker began the work.
    pub began: Clock,
    /// When the worker finished the work.
    pub ended: Clock,
}

fn address(parcel: &dyn Parcel) -> usize {
    (&raw const *parcel).addr()
}

impl<E: Errand> Slot<E> {
    /// Creates a slot with its errand. This allocates, so objects call it at configuration.
    pub fn new(errand: E) -> Slot<E> {
        Slot { place: Place::Here(Box::new(Packed { errand, outcome: None })), output: None }
    }

    /// The same for an errand of an output.
    pub(super) fn of_output(place: usize, errand: E) -> Slot<E> {
        Slot { output: Some(place), ..Slot::new(errand) }
    }

    /// The errand, to prepare it; `None` while it is away.
    pub fn here(&mut self) -> Option<&mut E> {
        match &mut self.place {
            Place::Here(packed) => Some(&mut packed.errand),
            Place::Away { .. } => None,
        }
    }

    /// Whether the errand is here.
    pub fn is_here(&self) -> bool {
        matches!(self.place, Place::Here(_))
    }

    /// Whether the errand is away and the object still wants its result.
    pub fn is_pending(&self) -> bool {
        matches!(self.place, Place::Away { counts: true, .. })
    }

    /// Drops the result of an errand that is away.
    pub fn drop_pending(&mut self) {
        if let Place::Away { counts, .. } = &mut self.place {
            *counts = false;
        }
    }

    /// Sends the errand to a worker, if it is here. It returns to [`Object::returned`](super::Object::returned).
    ///
    /// If a command sends it, further commands wait until it is back. They also wait if an object sends it at the
    /// return of an errand that held commands.
    ///
    /// # Errors
    ///
    /// "Bus worker queue overflow".
    pub fn send(&mut self, context: &mut Context, worker: WorkerId) -> Result<(), Shutdown> {
        if !self.is_here() {
            return Ok(());
        }
        let hold = context.hold();
        self.send_with(context, worker, hold)
    }

    /// The same, with a hold that the sender already has.
    pub(super) fn send_with(&mut self, context: &mut Context, worker: WorkerId, hold: Hold) -> Result<(), Shutdown> {
        let Place::Here(packed) = &self.place else { return Ok(()) };
        let away = Place::Away { address: address(&**packed), counts: true };
        let Place::Here(parcel) = mem::replace(&mut self.place, away) else { return Ok(()) };
        match context.submit(worker, SentJob::new(context.oid(), parcel, hold.0).to_output(self.output)) {
            Ok(()) => Ok(()),
            Err(Refused { job, why }) => {
                self.put_back(job.into_parcel());
                context.release(hold);
                Err(why)
            }
        }
    }

    /// Takes a finished errand, if it is this slot's.
    pub fn back(&mut self, done: &mut Done) -> Option<Back<'_, E>> {
        let Place::Away { address: own, counts } = self.place else { return None };
        let parcel = done.parcel.take_if(|parcel| address(&**parcel) == own)?;
        self.put_back(parcel);
        let Place::Here(packed) = &self.place else { return None };
        let result = packed.outcome.as_ref()?.as_ref().map(|answer| *answer);
        Some(Back { result, counts, began: done.began, ended: done.ended })
    }

    fn put_back(&mut self, parcel: Box<dyn Parcel>) {
        let any: Box<dyn Any> = parcel;
        if let Ok(packed) = any.downcast() {
            self.place = Place::Here(packed);
        }
    }
}
