// SPDX-License-Identifier: GPL-3.0-or-later
//! Accelerometers that measure at their own pace into a FIFO. This is the shared code of ADXL345, LIS2DW, MPU9250,
//! ICM20948 and BMI160. Each [`FifoChip`] has the differences.
//!
//! A reading takes the samples that are there, at most as many as fit in a message. So other devices on the bus get
//! their turn. If the chip has more, the next reading follows at once, otherwise after `rest_ticks`. For hosts up to
//! v0.12 the MCU switches the sensor on and off (`query_at`, `stop`). One worker runs all jobs of a bus in order, and
//! returns them in order. So the FIFO's fill level in a status matches the samples that the MCU has by then.

use crate::board::{BusDevice, BusError};
use crate::mcu::DialectName::{Kalico, Master, V0_13};
use crate::mcu::{
    Back, Chip, Context, Enumeration, Feature, Finished, Job, JobSlot, Next, Object, Oid, Timer, WireClock,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{Clock, Ticks};

use super::i2c::{I2c, i2c_shutdown};
use super::named;
use super::sensor_bulk::{BulkData, DATA_MAX, SensorBulk, Words};
use super::spi::{Spi, spi_shutdown};

pub(super) const FEATURE: Feature = Feature {
    serves: "accelerometers",

    enumerations: &[Enumeration::new("bus_oid_type", |_| named(&[("spi", 0), ("i2c", 1)])).of(&[V0_13, Master, Kalico])],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A `bus_oid_type` outside the enumeration.
    INVALID_BUS_TYPE = "bus_type invalid";
}

const TIMER: Timer = Timer::sampling(0);

// The numbers of the jobs.
const READ: u8 = 0;
const SWITCH: u8 = 1;
const OVERFLOW: u8 = 2;
const FILL: u8 = 3;

/// The kind of bus that a chip is on (`bus_oid_type`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BusType {
    Spi,
    I2c,
}

impl BusType {
    /// The kind with this number.
    ///
    /// # Errors
    ///
    /// "bus_type invalid".
    pub(super) fn of(number: u8) -> Result<BusType, Shutdown> {
        match number {
            0 => Ok(BusType::Spi),
            1 => Ok(BusType::I2c),
            _ => Err(Shutdown::by_host(INVALID_BUS_TYPE, format_args!("bus_oid_type {number} is neither spi nor i2c"))),
        }
    }

    /// Reads up to [`DATA_MAX`] bytes of registers. On SPI the chip must take bit 7 of a register's number for a read.
    /// `register` already has all other bits that the chip wants. Reading must not change the registers, because I2C
    /// may read twice.
    pub(super) fn read_register(self, chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
        match self {
            BusType::Spi => exchange_register(chip, register, into),
            BusType::I2c => chip.read_register(&[register], into),
        }
    }

    /// The same for registers that reading changes: a FIFO, or flags.
    pub(super) fn read_once(self, chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
        match self {
            BusType::Spi => exchange_register(chip, register, into),
            BusType::I2c => chip.write_read(&[register], into),
        }
    }

    /// The shutdown for a sensor's failed job.
    pub(super) fn failed(self, context: &Context, error: BusError) -> Shutdown {
        match self {
            BusType::Spi => spi_shutdown(error),
            BusType::I2c => i2c_shutdown(context, error),
        }
    }
}

fn exchange_register(chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
    let mut message = [0; 1 + DATA_MAX];
    let message = &mut message[..=into.len()];
    message[0] = register | 0x80;
    chip.exchange(message)?;
    into.copy_from_slice(&message[1..]);
    Ok(())
}

/// A chip's answer about its FIFO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Fill {
    /// Bytes in the FIFO.
    pub(super) bytes: u16,
    /// Whether samples may have been dropped.
    pub(super) overflowed: bool,
}

/// The differences between the chips. The methods run on a worker.
pub(super) trait FifoChip: Copy + Send + 'static {
    /// The chip's name.
    const NAME: &'static str;
    /// Bytes of a sample in the host's format.
    const SAMPLE_BYTES: usize;
    /// Whether a separate register reports overflows.
    const HAS_OVERFLOW_REGISTER: bool = false;

    /// The chip's own messages for hosts up to v0.12, if they know the chip.
    const OWN_WORDS: Option<&'static Words> = None;
    /// Whether a sensor still gives out the samples in its FIFO after it was switched off.
    const KEEPS_SAMPLES: bool = false;

    /// Switches the sensor on, for a host that leaves this to the MCU.
    fn switch_on(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        let _ = chip;
        Ok(())
    }

    /// Switches the sensor off, in a single transfer: the host gets the time of it.
    fn switch_off(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        let _ = chip;
        Ok(())
    }

    /// The bus that the chip is on.
    fn bus_type(self) -> BusType;

    /// Reads samples.
    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError>;

    /// Asks how full the FIFO is. `None`: the answer makes no sense.
    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError>;

    /// Asks whether the FIFO has overflowed since the last time.
    fn overflowed(self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        let _ = chip;
        Ok(false)
    }
}

/// The result of a reading.
#[derive(Clone, Copy)]
pub(super) struct Reading {
    samples: [u8; DATA_MAX],
    len: usize,
    /// Highest number of bytes of samples.
    room: usize,
    overflows: u16,
    /// Bytes left in the chip when it last reported its fill level.
    pending: u16,
    /// Whether the next reading follows at once.
    more: bool,
}

/// Bytes that are read at once from a FIFO that is read in blocks. With samples of 6 bytes, a block fills a message.
pub(super) const BLOCK_BYTES: usize = 48;

impl Reading {
    fn new() -> Reading {
        Reading { samples: [0; DATA_MAX], len: 0, room: DATA_MAX, overflows: 0, pending: 0, more: false }
    }

    /// Whether there is room for another sample with this many bytes.
    pub(super) fn has_room(&self, bytes: usize) -> bool {
        self.len + bytes <= self.room
    }

    /// Appends a sample. `filled` is how many samples the FIFO held, including this one. From `limit` on it may have
    /// dropped some.
    pub(super) fn push(&mut self, sample: &[u8], filled: u8, limit: u8) {
        self.samples[self.len..self.len + sample.len()].copy_from_slice(sample);
        self.len += sample.len();
        self.overflows += u16::from(filled >= limit);
        self.more = filled > 1;
    }

    /// Whether there is more to read.
    pub(super) fn has_more(&self) -> bool {
        self.more
    }

    /// Reads a block, if the FIFO has one. `fill` asks the chip how much it has. It is called only if no whole block is
    /// known to be there.
    pub(super) fn block(
        &mut self,
        chip: &mut dyn BusDevice,
        fill: impl FnOnce(&mut dyn BusDevice) -> Result<Fill, BusError>,
        read: impl FnOnce(&mut dyn BusDevice, &mut [u8]) -> Result<(), BusError>,
    ) -> Result<(), BusError> {
        const BLOCK: u16 = BLOCK_BYTES as u16;
        if self.pending < BLOCK {
            let Fill { bytes, overflowed } = fill(chip)?;
            self.pending = bytes;
            self.overflows += u16::from(overflowed);
        }
        if self.pending >= BLOCK {
            read(chip, &mut self.samples[..BLOCK_BYTES])?;
            self.len = BLOCK_BYTES;
            self.pending -= BLOCK;
        }
        self.more = self.pending >= BLOCK;
        Ok(())
    }
}

/// Reads samples.
struct Read<C> {
    chip: C,
    reading: Reading,
}

impl<C: FifoChip> Job for Read<C> {
    type Device = Chip;
    type Out = Reading;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<Reading, BusError> {
        self.chip.read(chip, &mut self.reading)?;
        Ok(self.reading)
    }
}

/// Asks how full the FIFO is.
struct LookAtFill<C>(C);

impl<C: FifoChip> Job for LookAtFill<C> {
    type Device = Chip;
    type Out = Option<Fill>;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<Option<Fill>, BusError> {
        self.0.fill(chip)
    }
}

/// Asks for overflows, if a separate register reports them. This is a separate job: the time of a status is
/// the time of the question for the fill level alone.
struct LookForOverflow<C>(C);

impl<C: FifoChip> Job for LookForOverflow<C> {
    type Device = Chip;
    type Out = bool;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<bool, BusError> {
        self.0.overflowed(chip)
    }
}

/// Switches the sensor on or off.
struct Switch<C> {
    chip: C,
    on: bool,
}

impl<C: FifoChip> Job for Switch<C> {
    type Device = Chip;
    /// Whether the sensor is on now.
    type Out = bool;
    type Failure = BusError;

    fn run(&mut self, chip: &mut Chip) -> Result<bool, BusError> {
        if self.on { self.chip.switch_on(chip) } else { self.chip.switch_off(chip) }?;
        Ok(self.on)
    }
}

/// The state of a measurement for a host up to v0.12.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// No measurement.
    Idle,
    /// The timer will switch the sensor on.
    Begins,
    /// The sensor is being switched on.
    SwitchesOn,
    /// The sensor is being switched off (`None`), or was switched off at these times. The host gets these times and the
    /// number of samples after the FIFO was read. The FIFO may be read this many more times.
    Ends(Option<(Clock, Clock)>, u8),
}

/// Highest number of reads of a FIFO of 32 samples after the end. So the end also comes if the FIFO never becomes
/// empty.
const LAST_READS: u8 = 33;
/// A sensor.
pub(super) struct FifoSensor<C: FifoChip> {
    chip: C,
    device: Oid,
    bulk: SensorBulk,
    rest_ticks: Ticks,
    phase: Phase,
    switch: JobSlot<Switch<C>>,
    read: JobSlot<Read<C>>,
    /// Whether a reading is due as soon as the one under way is over.
    waiting: bool,
    fill: JobSlot<LookAtFill<C>>,
    overflow: JobSlot<LookForOverflow<C>>,
}

impl<C: FifoChip> FifoSensor<C> {
    /// The fill level that is reported if the FIFO's own makes no sense. No FIFO has this many samples, so the host
    /// asks again.
    const NONSENSE_BYTES: u32 = 0x7f * C::SAMPLE_BYTES as u32;

    /// Starts a reading, or makes one follow the reading under way.
    fn read(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        let Some(Read { reading, .. }) = self.read.here() else {
            self.waiting = true;
            return Ok(());
        };
        (reading.len, reading.room, reading.overflows) = (0, self.bulk.room(), 0);
        self.read.send_to(context, self.device)
    }

    fn has_read(&mut self, context: &mut Context, reading: Reading, ended: Clock) -> Result<(), Shutdown> {
        self.bulk.count_overflows(reading.overflows);
        for sample in reading.samples[..reading.len].chunks(C::SAMPLE_BYTES) {
            self.bulk.add(context, sample);
        }
        match self.phase {
            // Nothing more is read before the sensor is off.
            Phase::Ends(None, _) => Ok(()),
            Phase::Ends(Some(_), _) => self.ask_status(context),
            _ if reading.more => self.read(context),
            _ => {
                context.go_on(TIMER, ended + self.rest_ticks);
                Ok(())
            }
        }
    }

    /// Ends the measurement.
    fn end(&mut self) {
        self.read.drop_pending();
        self.has_pending(0);
        self.waiting = false;
        self.phase = Phase::Idle;
    }

    /// Notes how many bytes the chip has. A reading under way has a newer count, and keeps it.
    fn has_pending(&mut self, bytes: u16) {
        if let Some(read) = self.read.here() {
            read.reading.pending = bytes;
        }
    }

    fn failed(&mut self, context: &mut Context, error: BusError) -> Result<(), Shutdown> {
        let failure = self.chip.bus_type().failed(context, error);
        context.device_failed(C::NAME, failure)
    }

    fn switch(&mut self, context: &mut Context, on: bool) -> Result<(), Shutdown> {
        // A switch is under way. At its end `switched` compares the sensor's state with the wanted one.
        let Some(switch) = self.switch.here() else { return Ok(()) };
        switch.on = on;
        self.switch.send_to(context, self.device)
    }

    /// The sensor is now on, or off.
    fn switched(&mut self, context: &mut Context, on: bool, span: (Clock, Clock)) -> Result<(), Shutdown> {
        match self.phase {
            // It was switched for an earlier query.
            Phase::Idle | Phase::Begins => Ok(()),
            Phase::SwitchesOn if !on => self.switch(context, true),
            Phase::SwitchesOn => {
                self.phase = Phase::Idle;
                context.go_on(TIMER, span.1 + self.rest_ticks);
                Ok(())
            }
            Phase::Ends(..) if on => self.switch(context, false),
            Phase::Ends(..) => {
                self.phase = Phase::Ends(Some(span), LAST_READS);
                self.ask_status(context)
            }
        }
    }

    /// Measures from `clock` on, for a host up to v0.12. The MCU switches the sensor on and off. The number of samples
    /// answers the end. `rest_ticks` of 0 ends the measurement.
    pub(super) fn query_at(
        &mut self,
        context: &mut Context,
        clock: WireClock,
        rest_ticks: Ticks,
    ) -> Result<(), Shutdown> {
        if rest_ticks == Ticks(0) {
            return self.stop(context);
        }
        let at = context.instant(clock);
        context.cancel(TIMER);
        self.end();
        self.rest_ticks = rest_ticks;
        self.bulk.reset();
        self.phase = Phase::Begins;
        context.schedule(TIMER, at)
    }

    /// Switches the sensor off, sends the remaining samples, and reports their number to the host. A reading under way
    /// counts.
    fn stop(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        context.cancel(TIMER);
        self.waiting = false;
        self.phase = Phase::Ends(None, LAST_READS);
        self.switch(context, false)
    }

    /// Processes the chip's answer about its FIFO. `None`: the answer makes no sense.
    fn has_filled(&mut self, context: &mut Context, fill: Option<Fill>, span: (Clock, Clock)) -> Result<(), Shutdown> {
        if let Phase::Ends(Some(off), reads) = self.phase {
            return self.ended(context, off, fill, reads);
        }
        match fill {
            Some(Fill { bytes, overflowed }) => {
                self.bulk.count_overflows(overflowed.into());
                self.has_pending(bytes);
                self.bulk.send_status(context, span, bytes.into());
            }
            None if C::OWN_WORDS.is_some() && !context.speaks::<BulkData<'_>>() => {
                self.bulk.send_status(context, span, Self::NONSENSE_BYTES);
            }
            // Since v0.13, klippy asks again if it gets no answer.
            None => {}
        }
        Ok(())
    }

    /// The same after the sensor was switched off.
    fn ended(
        &mut self,
        context: &mut Context,
        off: (Clock, Clock),
        fill: Option<Fill>,
        reads: u8,
    ) -> Result<(), Shutdown> {
        let bytes = fill.map(|fill| fill.bytes);
        // After an answer that makes no sense the chip is asked again, because samples may be left.
        if C::KEEPS_SAMPLES && bytes != Some(0) && reads > 0 {
            self.phase = Phase::Ends(Some(off), reads - 1);
            return if bytes.is_none() { self.ask_status(context) } else { self.read(context) };
        }
        self.phase = Phase::Idle;
        self.bulk.flush(context);
        self.bulk.send_status(context, off, bytes.map_or(Self::NONSENSE_BYTES, u32::from));
        Ok(())
    }

    /// Measures, with `rest_ticks` between two polls of the FIFO. `rest_ticks` of 0 ends the measurement.
    pub(super) fn query(&mut self, context: &mut Context, rest_ticks: Ticks) -> Result<(), Shutdown> {
        context.cancel(TIMER);
        self.end();
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        self.rest_ticks = rest_ticks;
        self.bulk.reset();
        let at = context.now() + rest_ticks;
        context.go_on(TIMER, at);
        Ok(())
    }

    /// Asks the sensor how many samples it has.
    pub(super) fn ask_status(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        if !C::HAS_OVERFLOW_REGISTER {
            return self.ask_fill(context);
        }
        self.overflow.here().ok_or_else(status_amid_status)?;
        self.overflow.send_to(context, self.device)
    }

    fn ask_fill(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        self.fill.here().ok_or_else(status_amid_status)?;
        self.fill.send_to(context, self.device)
    }
}

/// Commands wait for each other, so this happens only if the MCU was stopped during a status.
#[cold]
fn status_amid_status() -> Shutdown {
    Shutdown::by_host(reason::WORKER_OVERFLOW, "the host asks for a status during another one")
}

impl<C: FifoChip> Object for FifoSensor<C> {
    fn kind(&self) -> &'static str {
        C::NAME
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, _at: Clock) -> Result<Next, Shutdown> {
        if self.phase == Phase::Begins {
            self.phase = Phase::SwitchesOn;
            self.switch(context, true)?;
        } else {
            self.read(context)?;
        }
        Ok(Next::Done)
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let error = match number {
            SWITCH => {
                let Some(Back { result, began, ended, .. }) = self.switch.back(finished) else { return Ok(()) };
                match result {
                    Ok(on) => return self.switched(context, on, (began, ended)),
                    Err(error) => error.clone(),
                }
            }
            OVERFLOW => {
                let Some(Back { result, .. }) = self.overflow.back(finished) else { return Ok(()) };
                match result {
                    Ok(overflowed) => {
                        self.bulk.count_overflows(overflowed.into());
                        return self.ask_fill(context);
                    }
                    Err(error) => error.clone(),
                }
            }
            FILL => {
                let Some(Back { result, began, ended, .. }) = self.fill.back(finished) else { return Ok(()) };
                match result {
                    Ok(fill) => return self.has_filled(context, fill, (began, ended)),
                    Err(error) => error.clone(),
                }
            }
            _ => {
                let Some(Back { result, is_wanted, ended, .. }) = self.read.back(finished) else { return Ok(()) };
                let result = result.map_err(BusError::clone);
                if !is_wanted {
                    self.has_pending(0);
                }
                match result {
                    Ok(reading) if is_wanted => return self.has_read(context, reading, ended),
                    Ok(_) => return if std::mem::take(&mut self.waiting) { self.read(context) } else { Ok(()) },
                    Err(error) => error,
                }
            }
        };
        self.failed(context, error)
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.end();
    }
}

/// Makes a sensor with this `oid`, on the bus device `device`.
pub(super) fn configure<C: FifoChip>(context: &mut Context, oid: Oid, device: Oid, chip: C) -> Result<(), Shutdown> {
    match chip.bus_type() {
        BusType::Spi => context.require::<Spi>(device)?,
        BusType::I2c => context.require::<I2c>(device)?,
    }
    let sensor = FifoSensor {
        chip,
        device,
        bulk: C::OWN_WORDS.map_or_else(SensorBulk::new, |own| SensorBulk::with_own(context, own)),
        rest_ticks: Ticks(0),
        phase: Phase::Idle,
        switch: JobSlot::numbered(SWITCH, Switch { chip, on: false }),
        read: JobSlot::numbered(READ, Read { chip, reading: Reading::new() }),
        waiting: false,
        fill: JobSlot::numbered(FILL, LookAtFill(chip)),
        overflow: JobSlot::numbered(OVERFLOW, LookForOverflow(chip)),
    };
    context.assign(oid, sensor)
}
