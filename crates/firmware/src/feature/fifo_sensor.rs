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
    Back, Conversation, Done, Enumeration, Feature, Generation::V0_13, Mcu, Next, Object, Oid, Slot, Talk, Timer, Turn,
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

const TIMER: Timer = Timer::sampling(0);

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

    /// Reads registers of a chip that takes bit 7 of a register's number on SPI for a read. What else a
    /// chip wants in the number is in `register` already. Up to [`DATA_MAX`] bytes. Reading must not change the
    /// registers: I2C may read twice.
    pub(super) fn read_register(self, chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
        match self {
            BusType::Spi => exchange_register(chip, register, into),
            BusType::I2c => chip.read_register(&[register], into),
        }
    }

    /// The same where reading changes them: a FIFO, or flags.
    pub(super) fn read_once(self, chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
        match self {
            BusType::Spi => exchange_register(chip, register, into),
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

fn exchange_register(chip: &mut dyn BusDevice, register: u8, into: &mut [u8]) -> Result<(), BusError> {
    let mut message = [0; 1 + DATA_MAX];
    let message = &mut message[..=into.len()];
    message[0] = register | 0x80;
    chip.exchange(message)?;
    into.copy_from_slice(&message[1..]);
    Ok(())
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
#[derive(Clone, Copy)]
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
    type Answer = Reading;

    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<Reading, BusError> {
        self.chip.read(chip, &mut self.reading)?;
        Ok(self.reading)
    }
}

/// Asks how full the FIFO is.
struct LookAtFill<C>(C);

impl<C: FifoChip> Talk for LookAtFill<C> {
    type Answer = Option<Fill>;

    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<Option<Fill>, BusError> {
        self.0.fill(chip)
    }
}

/// Asks for overflows, where that is a register of its own. A conversation of its own too, as the
/// time of a status is that of the question for the fill alone.
struct LookForOverflow<C>(C);

impl<C: FifoChip> Talk for LookForOverflow<C> {
    type Answer = bool;

    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        self.0.overflowed(chip)
    }
}

/// Switches the sensor on or off.
struct Switch<C> {
    chip: C,
    on: bool,
}

impl<C: FifoChip> Talk for Switch<C> {
    /// Whether it is on now.
    type Answer = bool;

    fn talk(&mut self, chip: &mut dyn BusDevice) -> Result<bool, BusError> {
        if self.on { self.chip.switch_on(chip) } else { self.chip.switch_off(chip) }?;
        Ok(self.on)
    }
}

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
/// A sensor.
pub(super) struct FifoSensor<C: FifoChip> {
    chip: C,
    device: Oid,
    bulk: SensorBulk,
    rest_ticks: Ticks,
    phase: Phase,
    switch: Slot<Conversation<Switch<C>>>,
    read: Slot<Conversation<Read<C>>>,
    /// Whether a reading is due as soon as the one that is under way is over.
    waiting: bool,
    fill: Slot<Conversation<LookAtFill<C>>>,
    overflow: Slot<Conversation<LookForOverflow<C>>>,
}

impl<C: FifoChip> FifoSensor<C> {
    /// What is told of a FIFO that makes no sense: more samples than any has, so the host asks again.
    const NONSENSE_BYTES: u32 = 0x7f * C::SAMPLE_BYTES as u32;

    /// Has samples read, as soon as an earlier reading is over.
    fn read(&mut self, turn: &mut Turn) -> Result<(), Shutdown> {
        let Some(Conversation { talk: Read { reading, .. }, .. }) = self.read.here() else {
            self.waiting = true;
            return Ok(());
        };
        (reading.len, reading.room, reading.overflows) = (0, self.bulk.room(), 0);
        self.read.converse(turn, self.device)
    }

    fn has_read(&mut self, turn: &mut Turn, reading: Reading, ended: Clock) -> Result<(), Shutdown> {
        self.bulk.count_overflows(reading.overflows);
        for sample in reading.samples[..reading.len].chunks(C::SAMPLE_BYTES) {
            self.bulk.add(turn, sample);
        }
        match self.phase {
            // Nothing further is read before it is off.
            Phase::Ends(None, _) => Ok(()),
            Phase::Ends(Some(_), _) => self.ask_status(turn),
            _ if reading.more => self.read(turn),
            _ => {
                turn.go_on(TIMER, ended + self.rest_ticks);
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

    /// The chip has so many bytes. A reading that is under way knows better.
    fn has_pending(&mut self, bytes: u16) {
        if let Some(read) = self.read.here() {
            read.talk.reading.pending = bytes;
        }
    }

    fn failed(&mut self, turn: &mut Turn, error: BusError) -> Result<(), Shutdown> {
        let failure = self.chip.bus_type().failed(turn, error);
        turn.device_failed(C::NAME, failure)
    }

    fn switch(&mut self, turn: &mut Turn, on: bool) -> Result<(), Shutdown> {
        // One after the other: what is wanted by then follows.
        let Some(switch) = self.switch.here() else { return Ok(()) };
        switch.talk.on = on;
        self.switch.converse(turn, self.device)
    }

    /// The sensor is on, or off.
    fn switched(&mut self, turn: &mut Turn, on: bool, span: (Clock, Clock)) -> Result<(), Shutdown> {
        match self.phase {
            // That was for an earlier query.
            Phase::Idle | Phase::Begins => Ok(()),
            Phase::SwitchesOn if !on => self.switch(turn, true),
            Phase::SwitchesOn => {
                self.phase = Phase::Idle;
                turn.go_on(TIMER, span.1 + self.rest_ticks);
                Ok(())
            }
            Phase::Ends(..) if on => self.switch(turn, false),
            Phase::Ends(..) => {
                self.phase = Phase::Ends(Some(span), LAST_READS);
                self.ask_status(turn)
            }
        }
    }

    /// Measures, for a host up to v0.12: from `clock` on, the sensor is switched on and off by the MCU, and its end is
    /// answered by the number of samples. `rest_ticks` of 0 ends it.
    pub(super) fn query_at(&mut self, turn: &mut Turn, clock: WireClock, rest_ticks: Ticks) -> Result<(), Shutdown> {
        if rest_ticks == Ticks(0) {
            return self.stop(turn);
        }
        let at = turn.instant(clock);
        turn.cancel(TIMER);
        self.end();
        self.rest_ticks = rest_ticks;
        self.bulk.reset();
        self.phase = Phase::Begins;
        turn.schedule(TIMER, at)
    }

    /// Switches the sensor off, sends what there is, and tells the host how much that was. What is being
    /// read counts.
    fn stop(&mut self, turn: &mut Turn) -> Result<(), Shutdown> {
        turn.cancel(TIMER);
        self.waiting = false;
        self.phase = Phase::Ends(None, LAST_READS);
        self.switch(turn, false)
    }

    /// The chip has said how full its FIFO is; `None` makes no sense.
    fn has_filled(&mut self, turn: &mut Turn, fill: Option<Fill>, span: (Clock, Clock)) -> Result<(), Shutdown> {
        if let Phase::Ends(Some(off), reads) = self.phase {
            return self.ended(turn, off, fill, reads);
        }
        match fill {
            Some(Fill { bytes, overflowed }) => {
                self.bulk.count_overflows(overflowed.into());
                self.has_pending(bytes);
                self.bulk.send_status(turn, span, bytes.into());
            }
            None if C::OWN_WORDS.is_some() && !turn.speaks::<BulkData<'_>>() => {
                self.bulk.send_status(turn, span, Self::NONSENSE_BYTES);
            }
            // Without an answer klippy asks again, since v0.13.
            None => {}
        }
        Ok(())
    }

    /// The same after the sensor was switched off.
    fn ended(&mut self, turn: &mut Turn, off: (Clock, Clock), fill: Option<Fill>, reads: u8) -> Result<(), Shutdown> {
        let bytes = fill.map(|fill| fill.bytes);
        // What makes no sense is asked again, as samples may be left.
        if C::KEEPS_SAMPLES && bytes != Some(0) && reads > 0 {
            self.phase = Phase::Ends(Some(off), reads - 1);
            return if bytes.is_none() { self.ask_status(turn) } else { self.read(turn) };
        }
        self.phase = Phase::Idle;
        self.bulk.flush(turn);
        self.bulk.send_status(turn, off, bytes.map_or(Self::NONSENSE_BYTES, u32::from));
        Ok(())
    }

    /// Measures, with `rest_ticks` between two looks into the FIFO; 0 ends it.
    pub(super) fn query(&mut self, turn: &mut Turn, rest_ticks: Ticks) -> Result<(), Shutdown> {
        turn.cancel(TIMER);
        self.end();
        if rest_ticks == Ticks(0) {
            return Ok(());
        }
        self.rest_ticks = rest_ticks;
        self.bulk.reset();
        let at = turn.now() + rest_ticks;
        turn.go_on(TIMER, at);
        Ok(())
    }

    /// Asks the sensor how many samples it has.
    pub(super) fn ask_status(&mut self, turn: &mut Turn) -> Result<(), Shutdown> {
        if !C::HAS_OVERFLOW_REGISTER {
            return self.ask_fill(turn);
        }
        self.overflow.here().ok_or_else(status_amid_status)?;
        self.overflow.converse(turn, self.device)
    }

    fn ask_fill(&mut self, turn: &mut Turn) -> Result<(), Shutdown> {
        self.fill.here().ok_or_else(status_amid_status)?;
        self.fill.converse(turn, self.device)
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

    fn event(&mut self, turn: &mut Turn, _timer: Timer, _at: Clock) -> Result<Next, Shutdown> {
        if self.phase == Phase::Begins {
            self.phase = Phase::SwitchesOn;
            self.switch(turn, true)?;
        } else {
            self.read(turn)?;
        }
        Ok(Next::Done)
    }

    fn returned(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        let error = if let Some(Back { result, counts, ended, .. }) = self.read.back(done) {
            let result = result.map_err(BusError::clone);
            if !counts {
                self.has_pending(0);
            }
            match result {
                Ok(reading) if counts => return self.has_read(turn, reading, ended),
                Ok(_) => return if std::mem::take(&mut self.waiting) { self.read(turn) } else { Ok(()) },
                Err(error) => error,
            }
        } else if let Some(Back { result, began, ended, .. }) = self.switch.back(done) {
            match result {
                Ok(on) => return self.switched(turn, on, (began, ended)),
                Err(error) => error.clone(),
            }
        } else if let Some(Back { result, .. }) = self.overflow.back(done) {
            match result {
                Ok(overflowed) => {
                    self.bulk.count_overflows(overflowed.into());
                    return self.ask_fill(turn);
                }
                Err(error) => error.clone(),
            }
        } else if let Some(Back { result, began, ended, .. }) = self.fill.back(done) {
            match result {
                Ok(fill) => return self.has_filled(turn, fill, (began, ended)),
                Err(error) => error.clone(),
            }
        } else {
            return Ok(());
        };
        self.failed(turn, error)
    }

    fn shutdown(&mut self, _turn: &mut Turn) {
        self.end();
    }
}

/// Puts a sensor under `oid` that is the bus device `device`.
pub(super) fn configure<C: FifoChip>(mcu: &mut Mcu, oid: Oid, device: Oid, chip: C) -> Result<(), Shutdown> {
    match chip.bus_type() {
        BusType::Spi => mcu.require::<Spi>(device)?,
        BusType::I2c => mcu.require::<I2c>(device)?,
    }
    let sensor = FifoSensor {
        chip,
        device,
        bulk: C::OWN_WORDS.map_or_else(SensorBulk::new, |own| SensorBulk::with_own(mcu, own)),
        rest_ticks: Ticks(0),
        phase: Phase::Idle,
        switch: Slot::talking(Switch { chip, on: false }),
        read: Slot::talking(Read { chip, reading: Reading::new() }),
        waiting: false,
        fill: Slot::talking(LookAtFill(chip)),
        overflow: Slot::talking(LookForOverflow(chip)),
    };
    mcu.assign(oid, sensor)
}
