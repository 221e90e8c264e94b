// SPDX-License-Identifier: GPL-3.0-or-later
//! Objects: the host configures each under an oid. This file has the trait and the table.

use std::any::Any;
use std::mem;

use crate::board::Pin;
use crate::shutdown::{Shutdown, reason};
use crate::time::Clock;

use super::timers::NEVER;
use super::{Batch, Bus, BusCounts, Chip, Context, DeviceId, Finished, Mcu, Oid, Report, State, Timer};

/// The result of an event: when its timer runs next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// The timer runs again at this time.
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
    /// A worker will write them. The object calls [`Context::is_safe`] when that is finished.
    Later,
}

/// An object that the host configured under an oid. Its methods run in the core. After configuration they must not
/// allocate, lock, log or block.
pub trait Object: Any + Send {
    /// The name of this kind of object in the log, for example `stepper` or `digital output`.
    fn kind(&self) -> &'static str;

    /// Runs when a timer of this object, due at `at`, fires. An error stops the MCU.
    fn event(&mut self, _context: &mut Context, _timer: Timer, _at: Clock) -> Result<Next, Shutdown>
    where
        Self: Sized,
    {
        Ok(Next::Done)
    }

    /// Adds the edge with which this object's next event begins to a batch, if other edges may go out at the same time.
    /// True if it did: the edge is made before that event, and the time is read after it.
    fn join(&mut self, _batch: &mut Batch) -> bool {
        false
    }

    /// Runs when the job of this number returns from its worker. An error stops the MCU.
    fn finished(&mut self, _context: &mut Context, _number: u8, _finished: Finished) -> Result<(), Shutdown> {
        Ok(())
    }

    /// Runs when the trsync that this object waits for is triggered. An error stops the MCU.
    fn triggered(&mut self, _turn: &mut Context) -> Result<(), Shutdown> {
        Ok(())
    }

    /// Runs when the MCU stops, after all timers are removed. The object drops its queue.
    fn shutdown(&mut self, _turn: &mut Context) {}

    /// Drives the outputs to their shutdown values. It runs after [`Object::shutdown`]. If it fails, it runs again
    /// after [`super::RETRY_TICKS`]. If it fails for too long, the guardian drives the outputs and ends the program.
    fn make_safe(&mut self, _turn: &mut Context) -> Result<Safe, Shutdown> {
        Ok(Safe::Now)
    }

    /// Whether the guardian process can also drive the outputs to their shutdown values.
    fn is_guarded(&self) -> bool {
        true
    }

    /// The chip that this object represents, if it is a bus device and its bus is set.
    fn bus(&self) -> Option<&Bus> {
        None
    }

    /// The calls to its device, if a worker makes them.
    fn counts(&self) -> Option<BusCounts> {
        self.bus().map(Bus::counts)
    }

    /// This object's part of the MCU's status.
    fn report(&self) -> Report {
        Report::default()
    }
}

/// An object as the table has it.
pub(super) trait Kept: Object {
    /// Runs an event. Returns when the timer runs next, or [`NEVER`]: a processor returns this in registers, and the result
    /// of [`Object::event`] in memory.
    fn run_event(&mut self, context: &mut Context, timer: Timer, at: Clock) -> Result<Clock, Shutdown>;
}

impl<T: Object> Kept for T {
    fn run_event(&mut self, context: &mut Context, timer: Timer, at: Clock) -> Result<Clock, Shutdown> {
        self.event(context, timer, at).map(|next| match next {
            Next::At(at) => at,
            Next::Done => NEVER,
        })
    }
}

/// Highest number of objects with an oid.
pub(super) const OBJECTS_MAX: usize = 256;

/// The objects of the configuration.
#[derive(Default)]
pub(super) struct Objects {
    /// Indexed by oid; feature-owned objects follow.
    table: Vec<Option<Box<dyn Kept>>>,
    /// The objects that the log names by a pin.
    pins: Vec<(Oid, Pin)>,
}

impl Objects {
    /// Makes room for this many objects with an oid.
    pub(super) fn allocate(&mut self, count: usize) {
        if self.table.len() < count {
            self.table.resize_with(count, || None);
        }
    }

    /// Highest number of an object, plus one.
    pub(super) fn len(&self) -> usize {
        self.table.len()
    }

    /// The oids, also those without an object.
    pub(super) fn oids(&self) -> impl Iterator<Item = Oid> + use<> {
        (0..self.table.len()).map(Oid::at)
    }

    #[inline]
    pub(super) fn get(&self, oid: Oid) -> Option<&dyn Object> {
        Some(self.table.get(oid.index())?.as_deref()?)
    }

    #[inline]
    pub(super) fn get_mut(&mut self, oid: Oid) -> Option<&mut dyn Object> {
        Some(&mut **self.table.get_mut(oid.index())?.as_mut()?)
    }

    /// All objects.
    pub(super) fn iter(&self) -> impl Iterator<Item = &dyn Object> {
        self.table.iter().flatten().map(|object| -> &dyn Object { &**object })
    }

    /// The pin by which the log names an object.
    pub(super) fn pin(&self, oid: Oid) -> Option<Pin> {
        self.pins.iter().find(|(of, _)| *of == oid).map(|(_, pin)| *pin)
    }

    /// Takes an object out of the table while one of its methods runs.
    #[inline]
    pub(super) fn take(&mut self, oid: Oid) -> Option<Box<dyn Kept>> {
        self.table.get_mut(oid.index()).and_then(Option::take)
    }

    #[inline]
    pub(super) fn put_back(&mut self, oid: Oid, object: Box<dyn Kept>) {
        if let Some(slot) = self.table.get_mut(oid.index()) {
            // The place is empty, so nothing has to be dropped.
            mem::forget(slot.replace(object));
        }
    }

    /// The id of the object of type `T` that a feature owns. It is created at its first use.
    fn own<T: Object + Default>(&mut self) -> Oid {
        let is_it = |object: &Option<Box<dyn Kept>>| {
            let any = object.as_ref().map(|object| -> &dyn Any { &**object });
            any.is_some_and(|any| any.is::<T>())
        };
        let place = self.table.iter().skip(Oid::FIRST_OWN).position(is_it);
        let index = place.map_or(self.table.len().max(Oid::FIRST_OWN), |place| Oid::FIRST_OWN + place);
        if place.is_none() {
            self.table.resize_with(index, || None);
            self.table.push(Some(Box::new(T::default())));
        }
        Oid::at(index)
    }

    /// Whether `f` is true for any object of type `T`.
    pub(super) fn any<T: Object>(&self, mut f: impl FnMut(&T) -> bool) -> bool {
        self.iter().any(|object| {
            let any: &dyn Any = object;
            any.downcast_ref::<T>().is_some_and(&mut f)
        })
    }
}

impl State {
    /// See [`Context::with`].
    #[inline]
    pub(super) fn with<T: Object, R>(
        &mut self,
        oid: Oid,
        f: impl FnOnce(&mut T, &mut Context) -> Result<R, Shutdown>,
    ) -> Result<R, Shutdown> {
        let Some(mut object) = self.objects.take(oid) else { return Err(not_configured(oid)) };
        let any: &mut dyn Any = &mut *object;
        let result = match any.downcast_mut::<T>() {
            Some(inner) => f(inner, &mut Context::new(self, oid)).map_err(|stop| self.blame(stop, object.kind(), oid)),
            None => Err(not_configured(oid)),
        };
        self.objects.put_back(oid, object);
        result
    }

    /// The chip that an object represents.
    ///
    /// # Errors
    ///
    /// "Invalid oid type" if it represents none, or its bus is not set.
    pub(super) fn lend(&self, oid: Oid) -> Result<DeviceId<Chip>, Shutdown> {
        self.objects.get(oid).and_then(|object| object.bus()).map(Bus::chip).ok_or_else(|| not_configured(oid))
    }

    /// Adds the object's name to a shutdown.
    #[cold]
    pub(super) fn blame(&self, stop: Shutdown, kind: &str, oid: Oid) -> Shutdown {
        stop.of(&self.name_object(kind, oid))
    }

    /// The log's name for an object.
    pub(super) fn name_object(&self, kind: &str, oid: Oid) -> String {
        match self.objects.pin(oid) {
            _ if oid.index() >= Oid::FIRST_OWN => kind.to_owned(),
            Some(pin) => format!("{kind} oid {} ({})", oid.index(), pin.name_in(&self.board.pins())),
            None => format!("{kind} oid {}", oid.index()),
        }
    }
}

impl Context<'_> {
    /// The id of a feature's own object of type `T`, for example the lines that `set_digital_out` holds. It has no oid
    /// of the host. It is created at its first use.
    pub fn own<T: Object + Default>(&mut self) -> Oid {
        self.state.objects.own::<T>()
    }

    /// Checks that a new object may be put under `oid`, and makes it the object of this context. Call it before
    /// claiming the object's pins.
    ///
    /// # Errors
    ///
    /// "Can't assign oid" if it already has an object, is out of range, or the configuration is complete.
    pub fn vacant(&mut self, oid: Oid) -> Result<(), Shutdown> {
        let taken =
            |why: &str| Err(Shutdown::by_host(reason::CANNOT_ASSIGN_OID, format_args!("oid {} is {why}", oid.index())));
        match self.state.objects.get(oid) {
            _ if self.is_finalized() => taken("assigned after finalize_config"),
            _ if oid.index() >= self.state.phase.oids() => taken("not below the count of allocate_oids"),
            Some(_) => taken("assigned twice"),
            None => {
                self.set_oid(oid);
                Ok(())
            }
        }
    }

    /// Puts a new object under `oid`.
    ///
    /// # Errors
    ///
    /// "Can't assign oid".
    pub fn assign(&mut self, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.vacant(oid)?;
        self.state.objects.put_back(oid, Box::new(object));
        Ok(())
    }

    /// Puts a new object under `oid`. The log also names it by its pin, because a user does not know oids.
    ///
    /// # Errors
    ///
    /// "Can't assign oid".
    pub fn assign_on(&mut self, pin: Pin, oid: Oid, object: impl Object) -> Result<(), Shutdown> {
        self.assign(oid, object)?;
        self.state.objects.pins.push((oid, pin));
        Ok(())
    }
}

impl Mcu {
    /// The objects with an oid, and the log's names for them. This allocates.
    pub fn object_names(&self) -> Vec<(u8, String)> {
        let State { objects, .. } = &self.state;
        let named = objects.oids().filter_map(|oid| Some((oid.number()?, oid, objects.get(oid)?.kind())));
        named.map(|(number, oid, kind)| (number, self.state.name_object(kind, oid))).collect()
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
