// SPDX-License-Identifier: GPL-3.0-or-later
//! ADCs for load cells that pull a line low when a sample is ready. This is the shared code of HX711, ADS1220 and
//! ADS131M0x. Each [`ReadyChip`] has the differences.
//!
//! A timer reads the line every `rest_ticks` (klippy: ten times per sample). A worker reads a sample that is ready. The
//! timer then leaves the chip alone for 8 `rest_ticks`. A reading that is not back by then may have cost the next
//! sample. It is counted as a possible overflow.
//!
//! The core cannot read the line if it is the data input of an SPI controller. Then the worker polls as often, and reads
//! the sample if there is one.

use std::sync::Arc;

use crate::board::{Bias, BusError, Direction, Line, Pin};
use crate::mcu::{Back, Chip, Context, Finished, Job, JobSlot, Next, Object, Oid, Timer};
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::sensor_bulk::SensorBulk;
use super::spi::Spi;
use super::trigger_analog::Attached;

const TIMER: Timer = Timer::sampling(0);
/// The number of the job that reads a sample.
const READING: u8 = 0;

/// The result of a reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sample {
    /// There was none: the worker only polled.
    NotReady,
    /// A value.
    Value(i32),
    /// An error, and the number in place of the value.
    Error {
        /// The sensor's number of the error, if homing ends with it.
        code: Option<u8>,
        /// klippy recognizes the error by this value.
        value: i32,
    },
    /// One value for each sampled channel, or klippy's error value in its place.
    Channels {
        /// One for each channel.
        values: [i32; CHANNELS_MAX],
        /// How many channels there are.
        count: usize,
        /// The value for homing. `None`: an error.
        sum: Option<i32>,
    },
}

/// Highest number of sampled channels of a chip.
pub(super) const CHANNELS_MAX: usize = 4;

/// The differences between the chips.
pub(super) trait ReadyChip: Send + Sized + 'static {
    /// The chip's name in the log.
    const NAME: &'static str;
    /// Reads a sample on a worker.
    type Reading: Job;

    /// Starts to read a sample.
    fn read(&mut self, context: &mut Context, reading: &mut JobSlot<Self::Reading>) -> Result<(), Shutdown>;

    /// The shutdown for a chip that could not be read.
    fn stop(failure: &<Self::Reading as Job>::Failure) -> Shutdown;

    /// Converts the answer of a reading that counts. `late` says that the reading was not back in time.
    fn sample(&mut self, answer: <Self::Reading as Job>::Out, late: bool) -> Sample;

    /// How many values make a sample.
    fn channels(&self) -> usize {
        1
    }

    /// Begins measurements, or ends them.
    fn switch(&mut self, context: &mut Context, on: bool) -> Result<(), Shutdown> {
        let _ = (context, on);
        Ok(())
    }

    /// A job of the chip's own has finished. Its number is not [`READING`].
    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let _ = (context, number, finished);
        Ok(())
    }
}

const VALUE_BYTES: usize = 4;

/// How the sensor learns that a sample is ready.
pub(super) enum Ready {
    /// This line is low.
    Line(Arc<dyn Line>),
    /// The worker polls. `waits` counts the `rest_ticks` since the poll began. `fresh`: it has just read a sample.
    Poll { waits: u32, fresh: bool },
}

impl Ready {
    /// The worker polls.
    pub(super) const POLL: Ready = Ready::Poll { waits: 0, fresh: false };
}

/// How many `rest_ticks` the timer leaves the chip alone after it has begun to read a sample.
const READING_RESTS: u32 = 8;

/// A sensor.
pub(super) struct ReadyAdc<C: ReadyChip> {
    chip: C,
    ready: Ready,
    reading: JobSlot<C::Reading>,
    /// Whether the reading under way is late.
    late: bool,
    rest_ticks: Ticks,
    bulk: SensorBulk,
    /// The object that homes or probes with the samples.
    pub(super) attached: Attached,
}

impl<C: ReadyChip> ReadyAdc<C> {
    /// A sensor.
    pub(super) fn new(chip: C, ready: Ready, reading: C::Reading) -> ReadyAdc<C> {
        ReadyAdc {
            chip,
            ready,
            reading: JobSlot::numbered(READING, reading),
            late: false,
            rest_ticks: Ticks(0),
            bulk: SensorBulk::new(),
            attached: Attached::default(),
        }
    }

    /// Discards a reading under way.
    fn restart(&mut self) {
        self.reading.drop_pending();
        self.late = false;
        if let Ready::Poll { fresh, .. } = &mut self.ready {
            *fresh = false;
        }
    }

    /// Begins measurements. `rest_ticks` of 0 ends them.
    pub(super) fn query(&mut self, context: &mut Context, rest_ticks: Ticks) -> Result<(), Shutdown> {
        context.cancel(TIMER);
        self.restart();
        let on = rest_ticks != Ticks(0);
        self.chip.switch(context, on)?;
        self.rest_ticks = rest_ticks;
        if !on {
            return Ok(());
        }
        self.bulk.reset();
        let at = context.now() + rest_ticks;
        context.schedule(TIMER, at)
    }

    /// Reports to the host how many samples there are. A sample that is being read counts as one in the chip. If the
    /// worker has to poll, a sample in the chip does not count yet.
    pub(super) fn query_status(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        let now = context.now();
        let ready = match &self.ready {
            Ready::Line(line) => self.reading.is_pending() || !line.read()?,
            Ready::Poll { .. } => false,
        };
        let bytes = (self.chip.channels() * VALUE_BYTES) as u32;
        self.bulk.send_status(context, (now, now), if ready { bytes } else { 0 });
        Ok(())
    }
}

impl<C: ReadyChip> Object for ReadyAdc<C> {
    fn kind(&self) -> &'static str {
        C::NAME
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let is_pending = self.reading.is_pending();
        let (reads, rests) = match &mut self.ready {
            Ready::Line(_) if is_pending => (false, 4),
            Ready::Line(line) if line.read()? => (false, 1),
            Ready::Line(_) => (true, READING_RESTS),
            Ready::Poll { waits, .. } if is_pending => {
                *waits += 1;
                (false, if *waits < READING_RESTS { 1 } else { 4 })
            }
            // The next poll begins 8 `rest_ticks` after the one that read a sample.
            Ready::Poll { waits, fresh } if *fresh && *waits + 1 < READING_RESTS => {
                *fresh = false;
                (false, READING_RESTS - 1 - *waits)
            }
            Ready::Poll { waits, .. } => {
                *waits = 0;
                (true, 1)
            }
        };
        if is_pending && rests > 1 {
            self.bulk.count_overflows(1);
            self.late = true;
        }
        // Otherwise the reading of an earlier query is still under way.
        let rests = if !reads {
            rests
        } else if self.reading.is_here() {
            self.late = false;
            self.chip.read(context, &mut self.reading)?;
            rests
        } else {
            1
        };
        Ok(Next::At(at + Ticks(self.rest_ticks.0.wrapping_mul(rests))))
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        if number != READING {
            return self.chip.finished(context, number, finished);
        }
        let Some(Back { result, is_wanted, ended: read_at, .. }) = self.reading.back(finished) else { return Ok(()) };
        let answer = match result {
            Ok(answer) if is_wanted => answer,
            Ok(_) => return Ok(()),
            Err(failure) => return context.try_shut_down(C::stop(failure)),
        };
        let mut bytes = [0; CHANNELS_MAX * VALUE_BYTES];
        let mut put = |values: &[i32]| {
            for (place, value) in bytes.chunks_exact_mut(VALUE_BYTES).zip(values) {
                place.copy_from_slice(&value.to_le_bytes());
            }
            values.len() * VALUE_BYTES
        };
        let sample = self.chip.sample(answer, self.late);
        if let Ready::Poll { fresh, .. } = &mut self.ready {
            *fresh = sample != Sample::NotReady;
        }
        let len = match sample {
            Sample::NotReady => return Ok(()),
            Sample::Value(value) => {
                self.attached.update(context, value, read_at)?;
                put(&[value])
            }
            Sample::Error { code, value } => {
                if let Some(code) = code {
                    self.attached.note_error(context, code)?;
                }
                put(&[value])
            }
            Sample::Channels { values, count, sum } => {
                if let Some(sum) = sum {
                    self.attached.update(context, sum, read_at)?;
                }
                put(&values[..count.min(CHANNELS_MAX)])
            }
        };
        self.bulk.add(context, &bytes[..len]);
        Ok(())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.restart();
    }
}

/// Bytes that a chip on SPI sends while it receives zeros, up to `N`.
#[derive(Clone, Copy)]
pub(super) struct Frame<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> Frame<N> {
    /// The bytes that were received.
    pub(super) fn received(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl<const N: usize> Job for Frame<N> {
    type Device = Chip;
    type Out = Frame<N>;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<Frame<N>, BusError> {
        self.bytes = [0; N];
        chip.exchange(&mut self.bytes[..self.len])?;
        Ok(*self)
    }
}

/// Makes a sensor with this `oid`. It is read over SPI in frames of `len` bytes.
pub(super) fn configure_spi<const N: usize, C: ReadyChip<Reading = Frame<N>>>(
    context: &mut Context,
    oid: Oid,
    (spi, ready_pin): (Oid, Pin),
    chip: C,
    len: usize,
) -> Result<(), Shutdown> {
    context.vacant(oid)?;
    context.require::<Spi>(spi)?;
    let ready = context.prompt_line(ready_pin, "data_ready", Direction::Input(Bias::None))?;
    context.assign_on(ready_pin, oid, ReadyAdc::new(chip, Ready::Line(ready), Frame { bytes: [0; N], len: len.min(N) }))
}

/// Converts 24 bits in two's complement, the highest byte first.
pub(super) fn signed_24([high, middle, low]: [u8; 3]) -> i32 {
    i32::from_be_bytes([high, middle, low, 0]) >> 8
}
