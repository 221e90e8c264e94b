// SPDX-License-Identifier: GPL-3.0-or-later
//! Accelerometers that measure at their own pace into a FIFO, which is read every so often: what
//! ADXL345, LIS2DW, MPU9250, ICM20948 and BMI160 have in common. What differs is a [`FifoChip`] each.
//!
//! A reading takes what there is, at most one message's samples, so that others on the bus have
//! their turn; if the chip has more, the next reading follows at once, and otherwise `rest_ticks`
//! later. Hosts up to v0.12 have the sensor itself switched on and off (`query_at`, `stop`). As one worker has
//! all conversations of a bus in order, and gives them back in order, what the chip says of its FIFO in a status
//! fits the samples that the machine has by then.

#![forbid(unsafe_code)]

use crate::board::{BusDevice, BusError};
use crate::mcu::{
    Conversation, Done, Enumeration, Feature, Generation::V0_13, Mcu, Next, Object, Oid, Talk, Ticket, TimerId,
    WireClock, since,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{Clock, Ticks};

use super::i2c::{I2c, i2c_shutdown};
use super::named;
use super::sensor_bulk::{BulkData, DATA_MAX, SensorBulk, Words};
use super::spi::{Spi, spi_shutdown};

pub(super) const FEATURE: Feature = Feature {
    name: "fifo_sensor",
    enumerations: &[Enumeration::new("bus_oid_type", |_| named(&[("spi", 0), ("i2c", 1)])).of(since(V0_13))],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A `bus_oid_type` that the enumeration does not have.
    INVALID_BUS_TYPE = "bus_type invalid";
}

/// Which kind of bus a chip is on (`bus_oid_type`).
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

    /// Reads registers of a chip that takes bit 7 of a register's number on SPI for a read; what a
    /// chip wants else in the number is in `register` already. Up to [`DATA_MAX`] bytes.
    pub(super) fn read(self, chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
        match self {
            BusType::Spi => {
                let mut message = [0; 1 + DATA_MAX];
                let message = &mut message[..=into.len()];
                message[0] = register | 0x80;
                chip.exchange(message)?;
                into.copy_from_slice(&message[1..]);
                Ok(())
            }
            BusType::I2c => chip.write_read(&[register], into),
        }
    }

    /// The stop that a conversation that failed is for a sensor.
    pub(super) fn failed(self, mcu: &Mcu, error: BusError) -> Shutdown {
        match self {
            BusType::Spi => spi_shutdown(error),
            BusType::I2c => i2c_shutdown(mcu, error),
        }
    }
}

/// What a chip says of its FIFO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Fill {
    /// Bytes that are in there.
    pub(super) bytes: u16,
    /// Whether samples may have been dropped.
    pub(super) overflowed: bool,
}

/// What one kind of chip has of its own. Its methods run on a worker.
pub(super) trait FifoChip: Copy + Send + 'static {
    /// Its name.
    const NAME: &'static str;
    /// Bytes of a sample, as the host gets them.
    const SAMPLE_BYTES: usize;
    /// Whether there is a register of its own that tells of overflows.
    const HAS_OVERFLOW_REGISTER: bool = false;

    /// Its messages with hosts up to v0.12, if those know it.
    const OWN_WORDS: Option<&'static Words> = None;
    /// Whether a sensor that was switched off gives away what its FIFO has.
    const KEEPS_SAMPLES: bool = false;

    /// Switches the sensor on, for a host that leaves this to the machine.
    fn switch_on(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        let _ = chip;
        Ok(())
    }

    /// Switches the sensor off; by one transfer, as the host is told when it was.
    fn switch_off(self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        let _ = chip;
        Ok(())
    }

    /// The bus that it is on.
    fn bus_type(self) -> BusType;

    /// Reads samples.
    fn read(self, chip: &mut dyn BusDevice, reading: &mut Reading) -> Result<(), BusError>;

    /// Asks how full the FIFO is; none if the answer makes no sense.
    fn fill(self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError>;

    /// Asks whether the FIFO has overflowed since the last time.
    fn overflowed(self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        let _ = chip;
        Ok(false)
    }
}

/// What a reading brings.
pub(super) struct Reading {
    samples: [u8; DATA_MAX],
    len: usize,
    /// Bytes that there is room for.
    room: usize,
    overflows: u16,
    /// Bytes that the chip had left when it last told of its FIFO.
    pending: u16,
    /// Whether there is more to be read at once.
    more: bool,
}

/// Samples that are read at once from a FIFO that is read in blocks: so many bytes of 6 fill a
/// message.
pub(super) const BLOCK_BYTES: usize = 48;

impl Reading {
    fn new() -> Reading {
        Reading { samples: [0; DATA_MAX], len: 0, room: DATA_MAX, overflows: 0, pending: 0, more: false }
    }

    /// Whether another sample of so many bytes finds room.
    pub(super) fn has_room(&self, bytes: usize) -> bool {
        self.len + bytes <= self.room
    }

    /// Appends a sample; `filled` is how many samples the FIFO held with it, `limit` from how many on
    /// it may have dropped some.
    pub(super) fn push(&mut self, sample: &[u8], filled: u8, limit: u8) {
        self.samples[self.len..self.len + sample.len()].copy_from_slice(sample);
        self.len += sample.len();
        self.overflows += u16::from(filled >= limit);
        self.more = filled > 1;
    }

    /// Whether there is more to be read.
    pub(super) fn has_more(&self) -> bool {
        self.more
    }

    /// Reads a block, if the FIFO has one. `fill` asks the chip how much it has; that is done only if
    /// nothing is known of a whole block.
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

impl<C: FifoChip> Talk for Read<C> {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        self.chip.read(chip, &mut self.reading)
    }
}

/// Asks how full the FIFO is.
struct LookAtFill<C> {
    chip: C,
    fill: Option<Fill>,
}

impl<C: FifoChip> Talk for LookAtFill<C> {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        self.fill = self.chip.fill(chip)?;
        Ok(())
    }
}

/// Asks for overflows, where that is a register of its own. A conversation of its own too, as the
/// time of a status is that of the question for the fill alone.
struct LookForOverflow<C> {
    chip: C,
    overflowed: bool,
}

impl<C: FifoChip> Talk for LookForOverflow<C> {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        self.overflowed = self.chip.overflowed(chip)?;
        Ok(())
    }
}

/// Switches the sensor on or off.
struct Switch<C> {
    chip: C,
    on: bool,
}

impl<C: FifoChip> Talk for Switch<C> {
    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<(), BusError> {
        if self.on { self.chip.switch_on(chip) } else { self.chip.switch_off(chip) }
    }
}

// The errands.
const READ: u8 = 0;
const FILL: u8 = 1;
const OVERFLOW: u8 = 2;
const SWITCH: u8 = 3;

/// What a measurement of a host up to v0.12 is at.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// None.
    Idle,
    /// The sensor is to be switched on by the timer.
    Begins,
    /// It is being switched on.
    SwitchesOn,
    /// The sensor is being switched off, or was at these instants: the host is told so with the number of
    /// samples, once the FIFO is read, which may be done so many times more.
    Ends(Option<(Clock, Clock)>, u8),
}

/// How often a FIFO of 32 samples is read after the end, so that one that never gets empty ends, too.
const LAST_READS: u8 = 33;
/// What is told of a FIFO that makes no sense, in samples: more than any has, so the host asks again.
const NONSENSE: u32 = 0x7f;

/// A sensor.
struct FifoSensor<C> {
    chip: C,
    device: Oid,
    bulk: SensorBulk,
    rest_ticks: Ticks,
    phase: Phase,
    /// Here while the sensor is not being switched.
    switch: Option<Box<Conversation<Switch<C>>>>,
    /// Here while no reading is under way.
    read: Option<Box<Conversation<Read<C>>>>,
    /// Whether the reading under way is of an earlier query, and counts no more.
    stale: bool,
    /// Whether a reading is due as soon as that one is over.
    waiting: bool,
    /// Here while no status is asked for.
    fill: Option<Box<Conversation<LookAtFill<C>>>>,
    overflow: Option<Box<Conversation<LookForOverflow<C>>>>,
}

impl<C: FifoChip> FifoSensor<C> {
    /// Has samples read, as soon as an earlier reading is over.
    fn read(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        let Some(mut read) = self.read.take() else {
            self.waiting = true;
            return Ok(());
        };
        let Reading { len, room, overflows, .. } = &mut read.talk.reading;
        (*len, *room, *overflows) = (0, self.bulk.room(), 0);
        mcu.converse(self.device, Ticket { oid, tag: READ }, read)
    }

    fn take_in(
        &mut self,
        mcu: &mut Mcu,
        oid: Oid,
        mut read: Box<Conversation<Read<C>>>,
        ended: Clock,
    ) -> Result<(), Shutdown> {
        let result = std::mem::replace(&mut read.result, Ok(()));
        let Reading { samples, len, overflows, pending, more, .. } = &mut read.talk.reading;
        let (samples, len, overflows, more) = (*samples, *len, *overflows, *more);
        let stale = std::mem::take(&mut self.stale);
        if stale {
            *pending = 0;
        }
        self.read = Some(read);
        if let Err(error) = result {
            return self.failed(mcu, oid, error);
        }
        if stale {
            return if std::mem::take(&mut self.waiting) { self.read(mcu, oid) } else { Ok(()) };
        }
        self.bulk.count_overflows(overflows);
        for sample in samples[..len].chunks(C::SAMPLE_BYTES) {
            self.bulk.add(mcu, oid, sample);
        }
        match self.phase {
            // Nothing further is read before it is off.
            Phase::Ends(None, _) => return Ok(()),
            Phase::Ends(Some(_), _) => return self.ask_status(mcu, oid),
            _ if more => return self.read(mcu, oid),
            _ => {}
        }
        mcu.go_on(TimerId::sampling(oid, 0), ended + self.rest_ticks);
        Ok(())
    }

    /// Ends the measurement.
    fn end(&mut self) {
        self.stale = self.read.is_none();
        self.waiting = false;
        self.phase = Phase::Idle;
        if let Some(read) = &mut self.read {
            read.talk.reading.pending = 0;
        }
    }

    fn failed(&mut self, mcu: &mut Mcu, oid: Oid, error: BusError) -> Result<(), Shutdown> {
        let failure = self.chip.bus_type().failed(mcu, error);
        mcu.device_failed(oid, C::NAME, failure)
    }

    fn switch(&mut self, mcu: &mut Mcu, oid: Oid, on: bool) -> Result<(), Shutdown> {
        // One after the other: what is wanted by then follows.
        let Some(mut switch) = self.switch.take() else { return Ok(()) };
        switch.talk.on = on;
        mcu.converse(self.device, Ticket { oid, tag: SWITCH }, switch)
    }

    /// The sensor is on, or off.
    fn switched(&mut self, mcu: &mut Mcu, oid: Oid, on: bool, span: (Clock, Clock)) -> Result<(), Shutdown> {
        match self.phase {
            // That was for an earlier query.
            Phase::Idle | Phase::Begins => Ok(()),
            Phase::SwitchesOn if !on => self.switch(mcu, oid, true),
            Phase::SwitchesOn => {
                self.phase = Phase::Idle;
                mcu.go_on(TimerId::sampling(oid, 0), span.1 + self.rest_ticks);
                Ok(())
            }
            Phase::Ends(..) if on => self.switch(mcu, oid, false),
            Phase::Ends(..) => {
                self.phase = Phase::Ends(Some(span), LAST_READS);
                self.ask_status(mcu, oid)
            }
        }
    }

    /// Measures from `at` on, for a host that leaves it to the machine to switch the sensor on.
    fn query_at(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock, rest_ticks: Ticks) -> Result<(), Shutdown> {
        let timer = TimerId::sampling(oid, 0);
        mcu.cancel(timer);
        self.end();
        self.rest_ticks = rest_ticks;
        self.bulk.reset();
        self.phase = Phase::Begins;
        mcu.schedule(timer, at)
    }

    /// Switches the sensor off, sends what there is, and tells the host how much that was. What is being
    /// read counts.
    fn stop(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        mcu.cancel(TimerId::sampling(oid, 0));
        self.waiting = false;
        self.phase = Phase::Ends(None, LAST_READS);
        self.switch(mcu, oid, false)
    }

    /// The sensor that was switched off said how many bytes it has.
    fn ended(&mut self, mcu: &mut Mcu, oid: Oid, off: (Clock, Clock), bytes: u32, reads: u8) -> Result<(), Shutdown> {
        if C::KEEPS_SAMPLES && bytes > 0 && reads > 0 {
            self.phase = Phase::Ends(Some(off), reads - 1);
            return self.read(mcu, oid);
        }
        self.phase = Phase::Idle;
        self.bulk.flush(mcu, oid);
        self.bulk.send_status(mcu, oid, off, bytes);
        Ok(())
    }

    fn query(&mut self, mcu: &mut Mcu, oid: Oid, rest_ticks: Ticks) {
        let timer = TimerId::sampling(oid, 0);
        mcu.cancel(timer);
        self.end();
        if rest_ticks == Ticks(0) {
            return;
        }
        self.rest_ticks = rest_ticks;
        self.bulk.reset();
        let at = mcu.now() + rest_ticks;
        mcu.go_on(timer, at);
    }

    fn ask_status(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        if !C::HAS_OVERFLOW_REGISTER {
            return self.ask_fill(mcu, oid);
        }
        let overflow = self.overflow.take().ok_or_else(status_amid_status)?;
        mcu.converse(self.device, Ticket { oid, tag: OVERFLOW }, overflow)
    }

    fn ask_fill(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        let fill = self.fill.take().ok_or_else(status_amid_status)?;
        mcu.converse(self.device, Ticket { oid, tag: FILL }, fill)
    }
}

/// Commands wait for each other, so this is for a machine that was stopped amid a status.
#[cold]
fn status_amid_status() -> Shutdown {
    Shutdown::by_host(reason::WORKER_OVERFLOW, "a status was asked for amid another one")
}

impl<C: FifoChip> Object for FifoSensor<C> {
    fn kind(&self) -> &'static str {
        C::NAME
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, _at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        if self.phase == Phase::Begins {
            self.phase = Phase::SwitchesOn;
            self.switch(mcu, oid, true)?;
        } else {
            self.read(mcu, oid)?;
        }
        Ok(Next::Done)
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let span = (done.began, done.ended);
        let result = match done.tag {
            READ => {
                let Some(read) = done.errand::<Conversation<Read<C>>>() else { return Ok(()) };
                return self.take_in(mcu, oid, read, span.1);
            }
            SWITCH => {
                let Some(mut switch) = done.errand::<Conversation<Switch<C>>>() else { return Ok(()) };
                let result = std::mem::replace(&mut switch.result, Ok(()));
                let on = switch.talk.on;
                self.switch = Some(switch);
                if result.is_ok() {
                    return self.switched(mcu, oid, on, span);
                }
                result
            }
            OVERFLOW => {
                let Some(mut overflow) = done.errand::<Conversation<LookForOverflow<C>>>() else { return Ok(()) };
                let result = std::mem::replace(&mut overflow.result, Ok(()));
                let overflowed = overflow.talk.overflowed;
                self.overflow = Some(overflow);
                if result.is_ok() {
                    self.bulk.count_overflows(overflowed.into());
                    return self.ask_fill(mcu, oid);
                }
                result
            }
            _ => {
                let Some(mut fill) = done.errand::<Conversation<LookAtFill<C>>>() else { return Ok(()) };
                let result = std::mem::replace(&mut fill.result, Ok(()));
                let told = fill.talk.fill;
                self.fill = Some(fill);
                if let (Ok(()), Phase::Ends(Some(off), reads)) = (&result, self.phase) {
                    // What makes no sense is asked again, as samples may be left.
                    if told.is_none() && C::KEEPS_SAMPLES && reads > 0 {
                        self.phase = Phase::Ends(Some(off), reads - 1);
                        return self.ask_status(mcu, oid);
                    }
                    let bytes = told.map_or(NONSENSE * C::SAMPLE_BYTES as u32, |fill| fill.bytes.into());
                    return self.ended(mcu, oid, off, bytes, reads);
                }
                if told.is_none() && result.is_ok() && C::OWN_WORDS.is_some() && !mcu.speaks::<BulkData<'_>>() {
                    self.bulk.send_status(mcu, oid, span, NONSENSE * C::SAMPLE_BYTES as u32);
                }
                // Without an answer klippy asks again, since v0.13.
                if let (Ok(()), Some(Fill { bytes, overflowed })) = (&result, told) {
                    self.bulk.count_overflows(overflowed.into());
                    // A reading under way knows better.
                    if let Some(read) = &mut self.read {
                        read.talk.reading.pending = bytes;
                    }
                    self.bulk.send_status(mcu, oid, span, bytes.into());
                }
                result
            }
        };
        result.or_else(|error| self.failed(mcu, oid, error))
    }

    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {
        self.end();
    }
}

/// Puts a sensor under `oid` that is the bus device `device`.
pub(super) fn configure<C: FifoChip>(mcu: &mut Mcu, oid: Oid, device: Oid, chip: C) -> Result<(), Shutdown> {
    match chip.bus_type() {
        BusType::Spi => mcu.with::<Spi, _>(device, |_, _| Ok(()))?,
        BusType::I2c => mcu.with::<I2c, _>(device, |_, _| Ok(()))?,
    }
    let sensor = FifoSensor {
        chip,
        device,
        bulk: C::OWN_WORDS.map_or_else(SensorBulk::new, |own| SensorBulk::with_own(mcu, own)),
        rest_ticks: Ticks(0),
        phase: Phase::Idle,
        switch: Some(Conversation::new(Switch { chip, on: false })),
        read: Some(Conversation::new(Read { chip, reading: Reading::new() })),
        stale: false,
        waiting: false,
        fill: Some(Conversation::new(LookAtFill { chip, fill: None })),
        overflow: Some(Conversation::new(LookForOverflow { chip, overflowed: false })),
    };
    mcu.assign(oid, sensor)
}

/// Measures, with `rest_ticks` between two looks into the FIFO; none ends it.
pub(super) fn query<C: FifoChip>(mcu: &mut Mcu, oid: Oid, rest_ticks: Ticks) -> Result<(), Shutdown> {
    mcu.with::<FifoSensor<C>, _>(oid, |sensor, mcu| {
        sensor.query(mcu, oid, rest_ticks);
        Ok(())
    })
}

/// The same as hosts up to v0.12 ask for it: from `at` on, the sensor is switched on and off by the machine,
/// and its end is answered by the number of samples.
pub(super) fn query_at<C: FifoChip>(mcu: &mut Mcu, oid: Oid, at: WireClock, rest_ticks: Ticks) -> Result<(), Shutdown> {
    let at = mcu.instant(at);
    mcu.with::<FifoSensor<C>, _>(oid, |sensor, mcu| match rest_ticks {
        Ticks(0) => sensor.stop(mcu, oid),
        _ => sensor.query_at(mcu, oid, at, rest_ticks),
    })
}

/// Asks the sensor how many samples it has.
pub(super) fn query_status<C: FifoChip>(mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
    mcu.with::<FifoSensor<C>, _>(oid, |sensor, mcu| sensor.ask_status(mcu, oid))
}
