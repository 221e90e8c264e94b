// SPDX-License-Identifier: GPL-3.0-or-later
//! ADCs for load cells that pull a line low when a sample is ready: what HX711, ADS1220 and ADS131M0x
//! have in common. What differs is a [`ReadyChip`] each.
//!
//! A timer looks at the line every `rest_ticks` (klippy: ten times a sample), and has a worker read the
//! sample that is ready. It then leaves the chip alone for 8 `rest_ticks`; a reading that is not back by
//! then may have cost the next sample, and is counted as a possible overflow.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::{Bias, BusDevice, BusError, Direction, Line, Pin};
use crate::mcu::{Conversation, Done, Errand, Mcu, Next, Object, Oid, Talk, Ticket, TimerId};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::sensor_bulk::SensorBulk;
use super::spi::{Spi, spi_shutdown};
use super::trigger_analog::Attached;

/// What a reading came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sample {
    /// A value.
    Value(i32),
    /// An error, and what stands in the place of the value.
    Error {
        /// The sensor's number of the error, if homing ends with it.
        code: Option<u8>,
        /// What klippy knows the error by.
        value: i32,
    },
    /// A value of each channel that is sampled, or in its place what klippy knows an error by.
    Channels {
        /// As many as there are channels.
        values: [i32; CHANNELS_MAX],
        /// How many channels there are.
        count: usize,
        /// What they come to for homing; none if that is an error.
        sum: Option<i32>,
    },
}

/// How many channels of a chip may be sampled.
pub(super) const CHANNELS_MAX: usize = 4;

/// What one kind of chip has of its own.
pub(super) trait ReadyChip: Send + Sized + 'static {
    /// What the log calls it.
    const NAME: &'static str;
    /// Reads a sample on a worker.
    type Reading: Errand;

    /// Has a sample read.
    fn read(&mut self, mcu: &mut Mcu, ticket: Ticket, reading: Box<Self::Reading>) -> Result<(), Shutdown>;

    /// Whether the chip could be read.
    fn result(reading: &mut Self::Reading) -> Result<(), Shutdown>;

    /// What a reading that counts came to. `late` says that it was not back when it should have been.
    fn sample(&mut self, reading: &Self::Reading, late: bool) -> Sample;

    /// How many values make a sample.
    fn channels(&self) -> usize {
        1
    }

    /// Measurements begin anew, or end. Errands for that have the tag [`SWITCH`].
    fn switch(&mut self, mcu: &mut Mcu, oid: Oid, on: bool) -> Result<(), Shutdown> {
        let _ = (mcu, oid, on);
        Ok(())
    }

    /// An errand of [`ReadyChip::switch`] is back.
    fn switched(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let _ = (mcu, oid, done);
        Ok(())
    }
}

// The errands.
const READ: u8 = 0;
pub(super) const SWITCH: u8 = 1;

const VALUE_BYTES: usize = 4;

/// A sensor.
pub(super) struct ReadyAdc<C: ReadyChip> {
    chip: C,
    ready: Arc<dyn Line>,
    /// Here while no reading is under way.
    reading: Option<Box<C::Reading>>,
    /// Whether the reading under way is of an earlier query, and counts no more.
    stale: bool,
    /// Whether the reading under way is not back in time.
    late: bool,
    rest_ticks: Ticks,
    bulk: SensorBulk,
    attached: Attached,
}

impl<C: ReadyChip> ReadyAdc<C> {
    /// A sensor whose line `ready` is low while a sample is ready.
    pub(super) fn new(chip: C, ready: Arc<dyn Line>, reading: Box<C::Reading>) -> ReadyAdc<C> {
        ReadyAdc {
            chip,
            ready,
            reading: Some(reading),
            stale: false,
            late: false,
            rest_ticks: Ticks(0),
            bulk: SensorBulk::new(),
            attached: Attached::default(),
        }
    }

    /// Whether a sample that counts is being read.
    fn is_pending(&self) -> bool {
        self.reading.is_none() && !self.stale
    }

    /// Lets a reading under way count no more.
    fn restart(&mut self) {
        self.stale = self.reading.is_none();
        self.late = false;
    }
}

impl<C: ReadyChip> Object for ReadyAdc<C> {
    fn kind(&self) -> &'static str {
        C::NAME
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        let rests = if self.is_pending() {
            self.bulk.count_overflows(1);
            self.late = true;
            4
        } else if self.ready.read()? {
            1
        } else if let Some(reading) = self.reading.take() {
            self.late = false;
            self.chip.read(mcu, Ticket { oid, tag: READ }, reading)?;
            8
        } else {
            // The reading of an earlier query is still under way.
            1
        };
        Ok(Next::At(at + Ticks(self.rest_ticks.0.wrapping_mul(rests))))
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        if done.tag == SWITCH {
            return self.chip.switched(mcu, oid, done);
        }
        let read_at = done.ended;
        let Some(mut reading) = done.errand::<C::Reading>() else { return Ok(()) };
        let result = C::result(&mut reading);
        let reading = self.reading.insert(reading);
        if std::mem::take(&mut self.stale) || result.is_err() {
            return result.or_else(|failure| mcu.try_shut_down(failure));
        }
        let mut bytes = [0; CHANNELS_MAX * VALUE_BYTES];
        let mut put = |values: &[i32]| {
            for (place, value) in bytes.chunks_exact_mut(VALUE_BYTES).zip(values) {
                place.copy_from_slice(&value.to_le_bytes());
            }
            values.len() * VALUE_BYTES
        };
        let len = match self.chip.sample(reading, self.late) {
            Sample::Value(value) => {
                self.attached.update(mcu, value, read_at)?;
                put(&[value])
            }
            Sample::Error { code, value } => {
                if let Some(code) = code {
                    self.attached.note_error(mcu, code)?;
                }
                put(&[value])
            }
            Sample::Channels { values, count, sum } => {
                if let Some(sum) = sum {
                    self.attached.update(mcu, sum, read_at)?;
                }
                put(&values[..count.min(CHANNELS_MAX)])
            }
        };
        self.bulk.add(mcu, oid, &bytes[..len]);
        Ok(())
    }

    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {
        self.restart();
    }
}

/// Begins measurements, or with `rest_ticks` of 0 ends them.
pub(super) fn query<C: ReadyChip>(mcu: &mut Mcu, oid: Oid, rest_ticks: Ticks) -> Result<(), Shutdown> {
    mcu.with::<ReadyAdc<C>, _>(oid, |sensor, mcu| {
        let timer = TimerId::sampling(oid, 0);
        mcu.cancel(timer);
        sensor.restart();
        let on = rest_ticks != Ticks(0);
        sensor.chip.switch(mcu, oid, on)?;
        sensor.rest_ticks = rest_ticks;
        if !on {
            return Ok(());
        }
        sensor.bulk.reset();
        let at = mcu.now() + rest_ticks;
        mcu.schedule(timer, at)
    })
}

/// Tells the host how many samples there are. One that is being read counts as one in the chip.
pub(super) fn query_status<C: ReadyChip>(mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
    mcu.with::<ReadyAdc<C>, _>(oid, |sensor, mcu| {
        let now = mcu.now();
        let ready = sensor.is_pending() || !sensor.ready.read()?;
        let bytes = (sensor.chip.channels() * VALUE_BYTES) as u32;
        sensor.bulk.send_status(mcu, oid, (now, now), if ready { bytes } else { 0 });
        Ok(())
    })
}

/// Lets the samples be homed by.
pub(super) fn attach<C: ReadyChip>(mcu: &mut Mcu, oid: Oid, trigger_analog: Oid) -> Result<(), Shutdown> {
    mcu.with::<ReadyAdc<C>, _>(oid, |sensor, mcu| sensor.attached.attach(mcu, trigger_analog))
}

/// Lets the samples be probed by.
pub(super) fn attach_probe<C: ReadyChip>(mcu: &mut Mcu, oid: Oid, probe: Oid) -> Result<(), Shutdown> {
    mcu.with::<ReadyAdc<C>, _>(oid, |sensor, mcu| sensor.attached.attach_probe(mcu, probe))
}

/// Bytes that a chip on SPI sends while it is sent zeros; up to `N`.
pub(super) struct Frame<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> Frame<N> {
    /// A conversation in which so many bytes come.
    pub(super) fn new(len: usize) -> Box<Conversation<Frame<N>>> {
        Conversation::new(Frame { bytes: [0; N], len: len.min(N) })
    }

    /// The bytes that came.
    pub(super) fn received(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl<const N: usize> Talk for Frame<N> {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        self.bytes = [0; N];
        chip.exchange(&mut self.bytes[..self.len])
    }
}

/// Puts a sensor that is read in frames of `len` bytes over SPI under `oid`.
pub(super) fn configure_spi<const N: usize, C: ReadyChip<Reading = Conversation<Frame<N>>>>(
    mcu: &mut Mcu,
    oid: Oid,
    (spi, ready_pin): (Oid, Pin),
    chip: C,
    len: usize,
) -> Result<(), Shutdown> {
    mcu.vacant(oid)?;
    mcu.with::<Spi, _>(spi, |_, _| Ok(()))?;
    let ready = mcu.prompt_line(ready_pin, "data_ready", Direction::Input(Bias::None))?;
    mcu.assign_on(ready_pin, oid, ReadyAdc::new(chip, ready, Frame::new(len)))
}

/// Takes the result of a conversation over SPI.
pub(super) fn spi_result<T: Talk>(conversation: &mut Conversation<T>) -> Result<(), Shutdown> {
    std::mem::replace(&mut conversation.result, Ok(())).map_err(spi_shutdown)
}

/// The number that 24 bits in two's complement stand for, the highest byte first.
pub(super) fn signed_24([high, middle, low]: [u8; 3]) -> i32 {
    i32::from_be_bytes([high, middle, low, 0]) >> 8
}
