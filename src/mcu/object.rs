// SPDX-License-Identifier: GPL-3.0-or-later
//! What the host configures under an oid, and the table of all.

#![forbid(unsafe_code)]

use std::any::Any;

use crate::board::{Buffer, Pin};
use crate::shutdown::{Reason, Shutdown};
use crate::time::Clock;

use super::{Mcu, Oid, Ticket, TimerId};

/// What becomes of a timer after its event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// It runs again at that instant.
    At(Clock),
    /// It is done.
    Done,
}

/// An object that the host configured under an oid. Its methods run in the core: once
/// configured they must not allocate, lock, log or block.
pub trait Object: Any + Send {
    /// What it is, for the configuration's summary: `stepper`, `digital output`.
    fn kind(&self) -> &'static str;

    /// A timer of this object is due since `at`.
    fn event(&mut self, _mcu: &mut Mcu, _timer: TimerId, _at: Clock) -> Result<Next, Shutdown> {
        Ok(Next::Done)
    }

    /// A device of this object answered.
    fn completed(
        &mut self,
        _mcu: &mut Mcu,
        _ticket: Ticket,
        _result: Result<Buffer, Shutdown>,
    ) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The trsync that this object waits for was triggered.
    fn triggered(&mut self, _mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The machine stops: timers are gone, outputs go to their shutdown values.
    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        Ok(())
    }
}

impl Mcu {
    #[inline]
    pub(super) fn put_back(&mut self, oid: Oid, object: Box<dyn Object>) {
        if let Some(slot) = self.objects.get_mut(usize::from(oid.0)) {
            *slot = Some(object);
        }
    }

    /// Lends an object of type `T` to `f`, or says that the oid is out of range or of another
    /// kind.
    #[inline]
    pub fn with<T: Object, R>(
        &mut self,
        oid: Oid,
        f: impl FnOnce(&mut T, &mut Mcu) -> Result<R, Shutdown>,
    ) -> Result<R, Shutdown> {
        let slot = self.objects.get_mut(usize::from(oid.0));
        let Some(mut object) = slot.and_then(Option::take) else { return Err(not_configured(oid)) };
        let any: &mut dyn Any = &mut *object;
        let result = match any.downcast_mut::<T>() {
            Some(inner) => f(inner, self).map_err(|stop| self.blame(stop, object.kind(), oid)),
            None => Err(not_configured(oid)),
        };
        self.put_back(oid, object);
        result
    }

    /// The objects of type `T` for which `f` holds.
    pub fn any<T: Object>(&self, mut f: impl FnMut(&T) -> bool) -> bool {
        self.objects.iter().flatten().any(|object| {
            let any: &dyn Any = &**object;
            any.downcast_ref::<T>().is_some_and(&mut f)
        })
    }

    /// Passes a trsync's trigger on to an object.
    pub fn trigger(&mut self, oid: Oid) -> Result<(), Shutdown> {
        match self.objects.get_mut(usize::from(oid.0)).and_then(Option::take) {
            Some(mut object) => {
                let result = object.triggered(self, oid);
                self.put_back(oid, object);
                result
            }
            None => Ok(()),
        }
    }

    /// Says whether a new object may be put under `oid`: to be asked before a pin is claimed. To
    /// claim one opens files, for which the steps of a configured machine would wait, and nothing
    /// would drive back at the shutdown an output that has no object.
    pub fn vacant(&self, oid: Oid) -> Result<(), Shutdown> {
        let taken = |why: &str| Err(Shutdown::by_host(Reason::CannotAssignOid, format_args!("oid {} is {why}", oid.0)));
        match self.objects.get(usize::from(oid.0)) {
            _ if self.is_finalized() => taken("assigned after finalize_config"),
            Some(None) => Ok(()),
            Some(Some(_)) => taken("assigned twice"),
            None => taken("not below the count of allocate_oids"),
        }
    }

    /// Puts a new object under `oid`.
    pub fn assign(&mut self, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.vacant(oid)?;
        self.put_back(oid, Box::new(object));
        Ok(())
    }

    /// Puts a new object under `oid` that the log knows by its pin: an oid tells a user nothing.
    pub fn assign_on(&mut self, pin: Pin, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.assign(oid, object)?;
        self.pins.push((oid, pin));
        Ok(())
    }

    /// Says which object a stop was about.
    #[cold]
    pub(super) fn blame(&self, stop: Shutdown, kind: &str, oid: Oid) -> Shutdown {
        match self.pins.iter().find(|(of, _)| *of == oid) {
            Some((_, pin)) => stop.of(kind, format_args!("{} ({})", oid.0, self.name(*pin))),
            None => stop.of(kind, oid.0),
        }
    }
}

#[cold]
fn not_configured(oid: Oid) -> Shutdown {
    Shutdown::because(
        Reason::InvalidOid,
        format!(
            "oid {} is not configured, or as something else: the host's configuration is not this machine's; FIRMWARE_RESTART",
            oid.0
        ),
    )
}
