// SPDX-License-Identifier: GPL-3.0-or-later
//! Objects: what the host configures under an oid, and the table of all of them.

#![forbid(unsafe_code)]

use std::any::Any;

use crate::board::Pin;
use crate::shutdown::{Shutdown, reason};
use crate::time::Clock;

use super::{Bus, BusCounts, Done, Mcu, Oid, Report, Timer, Turn};

/// What an event answers: what becomes of its timer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// The timer runs again at this instant.
    At(Clock),
    /// The timer stops.
    Done,
}

/// Whether an object's outputs are at their shutdown values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Safe {
    /// They are.
    Now,
    /// A worker is to write them. The object calls [`Turn::is_safe`] once that is done.
    Later,
}

/// An object that the host configured under an oid. Its methods run in the core: once
/// configured they must not allocate, lock, log or block.
pub trait Object: Any + Send {
    /// What people call such an object, for the log: `stepper`, `digital output`.
    fn kind(&self) -> &'static str;

    /// A timer of this object runs, which was due at `at`. An error stops the MCU.
    fn event(&mut self, _turn: &mut Turn, _timer: Timer, _at: Clock) -> Result<Next, Shutdown> {
        Ok(Next::Done)
    }

    /// An errand of this object has come back from its worker. An error stops the MCU.
    fn returned(&mut self, _turn: &mut Turn, _done: &mut Done) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The trsync that this object waits for was triggered. An error stops the MCU.
    fn triggered(&mut self, _turn: &mut Turn) -> Result<(), Shutdown> {
        Ok(())
    }

    /// The MCU stops and has removed all timers: the object drops whatever it had queued.
    fn shutdown(&mut self, _turn: &mut Turn) {}

    /// Drives the outputs to their shutdown values, after [`Object::shutdown`]. As long as this fails
    /// it is called again every [`super::RETRY_TICKS`]; if it fails for too long, the guardian drives
    /// the outputs and ends the program.
    fn make_safe(&mut self, _turn: &mut Turn) -> Result<Safe, Shutdown> {
        Ok(Safe::Now)
    }

    /// Whether the guardian process, too, can drive the outputs to their shutdown values.
    fn is_guarded(&self) -> bool {
        true
    }

    /// The chip that this object stands for, if it is a bus device whose bus is set.
    fn bus(&self) -> Option<&Bus> {
        None
    }

    /// The calls to its device, if a worker makes them.
    fn counts(&self) -> Option<BusCounts> {
        self.bus().map(Bus::counts)
    }

    /// What it tells to whoever asks for the MCU's status.
    fn report(&self) -> Report {
        Report::default()
    }
}

impl Mcu {
    /// Takes an object out of the table, for as long as one of its methods runs.
    #[inline]
    pub(super) fn take(&mut self, oid: Oid) -> Option<Box<dyn Object>> {
        self.configuration.objects.get_mut(oid.index()).and_then(Option::take)
    }

    #[inline]
    pub(super) fn put_back(&mut self, oid: Oid, object: Box<dyn Object>) {
        if let Some(slot) = self.configuration.objects.get_mut(oid.index()) {
            *slot = Some(object);
        }
    }

    /// Gives the object of type `T` under `oid` a turn: `f` runs with it.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if there is no object, or one of another type; whatever `f` returns.
    #[inline]
    pub fn with<T: Object, R>(
        &mut self,
        oid: Oid,
        f: impl FnOnce(&mut T, &mut Turn) -> Result<R, Shutdown>,
    ) -> Result<R, Shutdown> {
        let Some(mut object) = self.take(oid) else { return Err(not_configured(oid)) };
        let any: &mut dyn Any = &mut *object;
        let result = match any.downcast_mut::<T>() {
            Some(inner) => f(inner, &mut Turn::new(self, oid)).map_err(|stop| self.blame(stop, object.kind(), oid)),
            None => Err(not_configured(oid)),
        };
        self.put_back(oid, object);
        result
    }

    /// Checks that there is an object of type `T` under `oid`.
    ///
    /// # Errors
    ///
    /// "Invalid oid type".
    pub fn require<T: Object>(&mut self, oid: Oid) -> Result<(), Shutdown> {
        self.with::<T, _>(oid, |_, _| Ok(()))
    }

    /// The id of the one object of type `T` that belongs to a feature rather than to an oid of the
    /// host, such as the lines that `set_digital_out` holds. It is made at its first use.
    pub fn own<T: Object + Default>(&mut self) -> Oid {
        let is_it = |object: &Option<Box<dyn Object>>| {
            let any = object.as_ref().map(|object| -> &dyn Any { &**object });
            any.is_some_and(|any| any.is::<T>())
        };
        let place = self.configuration.objects.iter().skip(Oid::FIRST_OWN).position(is_it);
        let index = place.map_or(self.configuration.objects.len().max(Oid::FIRST_OWN), |place| Oid::FIRST_OWN + place);
        if place.is_none() {
            self.configuration.objects.resize_with(index, || None);
            self.configuration.objects.push(Some(Box::new(T::default())));
        }
        Oid::at(index)
    }

    /// The chip that an object stands for.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if it stands for none, or its bus is not set.
    pub(super) fn lend(&self, oid: Oid) -> Result<Bus, Shutdown> {
        let object = self.configuration.objects.get(oid.index()).and_then(Option::as_ref);
        object.and_then(|object| object.bus()).cloned().ok_or_else(|| not_configured(oid))
    }

    /// Whether `f` holds for any object of type `T`.
    pub fn any<T: Object>(&self, mut f: impl FnMut(&T) -> bool) -> bool {
        self.configuration.objects.iter().flatten().any(|object| {
            let any: &dyn Any = &**object;
            any.downcast_ref::<T>().is_some_and(&mut f)
        })
    }

    /// Passes a trsync's trigger on to an object that waits for it.
    ///
    /// # Errors
    ///
    /// Whatever [`Object::triggered`] returns.
    pub fn trigger(&mut self, oid: Oid) -> Result<(), Shutdown> {
        match self.take(oid) {
            Some(mut object) => {
                let result = object.triggered(&mut Turn::new(self, oid));
                self.put_back(oid, object);
                result
            }
            None => Ok(()),
        }
    }

    /// Checks that a new object may be put under `oid`. To be called before its pins are claimed: an
    /// output that was claimed for no object would not be driven to its shutdown value.
    ///
    /// # Errors
    ///
    /// "Can't assign oid" if it has an object, is out of range, or the configuration is complete.
    pub fn vacant(&self, oid: Oid) -> Result<(), Shutdown> {
        let taken =
            |why: &str| Err(Shutdown::by_host(reason::CANNOT_ASSIGN_OID, format_args!("oid {} is {why}", oid.index())));
        match self.configuration.objects.get(oid.index()) {
            _ if self.is_finalized() => taken("assigned after finalize_config"),
            _ if self.configuration.oid_count.is_none_or(|count| oid.index() >= count) => {
                taken("not below the count of allocate_oids")
            }
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

    /// Puts a new object under `oid`. The log names it by its pin, too, as a user does not know oids.
    ///
    /// # Errors
    ///
    /// "Can't assign oid".
    pub fn assign_on(&mut self, pin: Pin, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.assign(oid, object)?;
        self.configuration.pins.push((oid, pin));
        Ok(())
    }

    /// Says which object a stop was about.
    #[cold]
    pub(super) fn blame(&self, stop: Shutdown, kind: &str, oid: Oid) -> Shutdown {
        stop.of(&self.name_object(kind, oid))
    }

    /// What the log calls an object.
    pub(super) fn name_object(&self, kind: &str, oid: Oid) -> String {
        match self.configuration.pins.iter().find(|(of, _)| *of == oid) {
            _ if oid.index() >= Oid::FIRST_OWN => kind.to_owned(),
            Some((_, pin)) => format!("{kind} oid {} ({})", oid.index(), self.name(*pin)),
            None => format!("{kind} oid {}", oid.index()),
        }
    }
}

#[cold]
fn not_configured(oid: Oid) -> Shutdown {
    let cause = format!(
        "oid {} is not configured, or as something else: the host's configuration is not this MCU's",
        oid.index()
    );
    Shutdown::because(reason::INVALID_OID, cause).remedy("FIRMWARE_RESTART")
}
