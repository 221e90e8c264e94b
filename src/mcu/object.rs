// SPDX-License-Identifier: GPL-3.0-or-later
//! What the host configures under an oid, and the table of all.

#![forbid(unsafe_code)]

use std::any::Any;

use crate::board::Pin;
use crate::shutdown::{Shutdown, reason};
use crate::time::Clock;

use super::{Bus, Done, Mcu, Oid, TimerId};

/// What becomes of a timer after its event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// It runs again at that instant.
    At(Clock),
    /// It is done.
    Done,
}

/// Whether an object's outputs are where they belong in a stopped machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Safe {
    /// They are.
    Now,
    /// They were told to go there; the object says so when they are ([`Mcu::is_safe`]).
    Later,
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

    /// An errand of this object is back.
    fn returned(&mut self, _mcu: &mut Mcu, _oid: Oid, _done: Done) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The trsync that this object waits for was triggered.
    fn triggered(&mut self, _mcu: &mut Mcu, _oid: Oid) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The machine stops: timers are gone, whatever was queued is dropped.
    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {}

    /// The machine has stopped: drives the outputs to their shutdown values. What fails is tried
    /// again every [`super::RETRY_TICKS`]; the guardian takes over if that takes too long.
    fn make_safe(&mut self, _mcu: &mut Mcu, _oid: Oid) -> Result<Safe, Shutdown> {
        Ok(Safe::Now)
    }

    /// The bus device that this object is; none before its bus is set.
    fn bus(&self) -> Option<&Bus> {
        None
    }
}

impl Mcu {
    /// Takes an object out of the table, for as long as one of its methods runs.
    #[inline]
    pub(super) fn take(&mut self, oid: Oid) -> Option<Box<dyn Object>> {
        self.objects.get_mut(oid.index()).and_then(Option::take)
    }

    #[inline]
    pub(super) fn put_back(&mut self, oid: Oid, object: Box<dyn Object>) {
        if let Some(slot) = self.objects.get_mut(oid.index()) {
            *slot = Some(object);
        }
    }

    /// Lends an object of type `T` to `f`, or says that the oid is out of range or of another
    /// kind.
    ///
    /// # Errors
    ///
    /// "Invalid oid type", and whatever `f` returns.
    #[inline]
    pub fn with<T: Object, R>(
        &mut self,
        oid: Oid,
        f: impl FnOnce(&mut T, &mut Mcu) -> Result<R, Shutdown>,
    ) -> Result<R, Shutdown> {
        let Some(mut object) = self.take(oid) else { return Err(not_configured(oid)) };
        let any: &mut dyn Any = &mut *object;
        let result = match any.downcast_mut::<T>() {
            Some(inner) => f(inner, self).map_err(|stop| self.blame(stop, object.kind(), oid)),
            None => Err(not_configured(oid)),
        };
        self.put_back(oid, object);
        result
    }

    /// The one object of type `T` that belongs to a feature rather than to an oid, such as the
    /// lines that `set_digital_out` holds; made at its first use.
    pub fn own<T: Object + Default>(&mut self) -> Oid {
        let is_it = |object: &Option<Box<dyn Object>>| {
            let any = object.as_ref().map(|object| -> &dyn Any { &**object });
            any.is_some_and(|any| any.is::<T>())
        };
        let place = self.objects.iter().skip(Oid::FIRST_OWN).position(is_it);
        let index = place.map_or(self.objects.len().max(Oid::FIRST_OWN), |place| Oid::FIRST_OWN + place);
        if place.is_none() {
            self.objects.resize_with(index, || None);
            self.objects.push(Some(Box::new(T::default())));
        }
        Oid::at(index)
    }

    /// The bus device of an object.
    pub(super) fn lend(&self, oid: Oid) -> Result<Bus, Shutdown> {
        let object = self.objects.get(oid.index()).and_then(Option::as_ref);
        object.and_then(|object| object.bus()).cloned().ok_or_else(|| not_configured(oid))
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
        match self.take(oid) {
            Some(mut object) => {
                let result = object.triggered(self, oid);
                self.put_back(oid, object);
                result
            }
            None => Ok(()),
        }
    }

    /// Says whether a new object may be put under `oid`: to be asked before a pin is claimed, as
    /// nothing would drive back at a shutdown an output that has no object.
    ///
    /// # Errors
    ///
    /// "Can't assign oid".
    pub fn vacant(&self, oid: Oid) -> Result<(), Shutdown> {
        let taken =
            |why: &str| Err(Shutdown::by_host(reason::CANNOT_ASSIGN_OID, format_args!("oid {} is {why}", oid.index())));
        match self.objects.get(oid.index()) {
            _ if self.is_finalized() => taken("assigned after finalize_config"),
            _ if oid.index() >= self.oid_count => taken("not below the count of allocate_oids"),
            Some(Some(_)) => taken("assigned twice"),
            _ => Ok(()),
        }
    }

    /// Puts a new object under `oid`.
    ///
    /// # Errors
    ///
    /// "Can't assign oid".
    pub fn assign(&mut self, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.vacant(oid)?;
        self.put_back(oid, Box::new(object));
        Ok(())
    }

    /// Puts a new object under `oid` that the log knows by its pin: an oid tells a user nothing.
    ///
    /// # Errors
    ///
    /// "Can't assign oid".
    pub fn assign_on(&mut self, pin: Pin, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.assign(oid, object)?;
        self.pins.push((oid, pin));
        Ok(())
    }

    /// Says which object a stop was about.
    #[cold]
    pub(super) fn blame(&self, stop: Shutdown, kind: &str, oid: Oid) -> Shutdown {
        stop.of(&self.name_object(kind, oid))
    }

    /// What the log calls an object.
    pub(super) fn name_object(&self, kind: &str, oid: Oid) -> String {
        match self.pins.iter().find(|(of, _)| *of == oid) {
            _ if oid.index() >= Oid::FIRST_OWN => kind.to_owned(),
            Some((_, pin)) => format!("{kind} oid {} ({})", oid.index(), self.name(*pin)),
            None => format!("{kind} oid {}", oid.index()),
        }
    }
}

#[cold]
fn not_configured(oid: Oid) -> Shutdown {
    Shutdown::because(
        reason::INVALID_OID,
        format!(
            "oid {} is not configured, or as something else: the host's configuration is not this machine's; FIRMWARE_RESTART",
            oid.index()
        ),
    )
}
