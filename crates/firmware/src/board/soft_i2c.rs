// SPDX-License-Identifier: GPL-3.0-or-later
//! I2C on GPIO lines, bit by bit (UM10204, "I2C-bus specification and user manual").
//!
//! Nothing is ever driven high. The lines are open drains ([`Direction::OpenDrain`]). Pull-ups take them high when all
//! chips have released them.
//!
//! [`Direction::OpenDrain`]: super::Direction::OpenDrain

use std::sync::Arc;

use super::{BusDevice, BusError, BusStatus, Line};
use crate::time::{Ticks, TimeSource};
use crate::trouble::Trouble;

/// How long a chip may hold the clock low in one message: 100 ms, as in the kernel's driver
/// (drivers/i2c/busses/i2c-gpio.c).
const STRETCH_MAX: Ticks = Ticks::from_ms(100);
/// The last bit of an address byte, set for a read.
const READ: u8 = 1;
/// A chip that was interrupted within a byte releases SDA after this many clocks (UM10204, 3.1.16).
const CLEAR_CLOCKS: u32 = 9;

/// A chip on lines that other chips may share.
pub struct SoftI2c {
    scl: Arc<dyn Line>,
    sda: Arc<dyn Line>,
    /// The address byte of a write.
    address: u8,
    /// The time between two changes of the lines: half a bit.
    pulse: Ticks,
    clock: Arc<dyn TimeSource>,
    /// The log's name for it.
    name: String,
    /// How long the chip may still hold the clock.
    stretch_left: Ticks,
}

/// A byte was not acknowledged.
struct NotAcknowledged;

impl SoftI2c {
    /// A chip with this 7-bit address. At least one `pulse` passes between two changes of the lines. The lines must be
    /// open drains.
    pub fn new(
        scl: Arc<dyn Line>,
        sda: Arc<dyn Line>,
        address: u8,
        pulse: Ticks,
        clock: Arc<dyn TimeSource>,
        name: String,
    ) -> SoftI2c {
        SoftI2c { scl, sda, address: address << 1, pulse, clock, name, stretch_left: STRETCH_MAX }
    }

    fn pause(&self) {
        self.clock.spin_until(self.clock.now() + self.pulse);
    }

    /// Releases the clock, and waits until the chip has released it too.
    fn clock_high(&mut self) -> Result<(), BusError> {
        self.scl.write(true)?;
        if self.scl.read()? {
            return Ok(());
        }
        let began = self.clock.now();
        let end = began + self.stretch_left;
        while !self.scl.read()? {
            let now = self.clock.now();
            if now >= end {
                self.stretch_left = Ticks(0);
                let cause = "SCL stays low: a chip or a short holds it, or it has no pull-up";
                return Err(BusError::new(BusStatus::Timeout, Trouble::new(cause).remedy("check the wiring")));
            }
            self.clock.spin_until(now + Ticks::from_us(1));
        }
        let stretched = self.clock.now().since(began);
        self.stretch_left = Ticks(self.stretch_left.0.saturating_sub(stretched.try_into().unwrap_or(u32::MAX)));
        Ok(())
    }

    /// Sends one bit and returns the level of the wire.
    fn bit(&mut self, bit: bool) -> Result<bool, BusError> {
        self.sda.write(bit)?;
        self.pause();
        self.clock_high()?;
        self.pause();
        let level = self.sda.read()?;
        self.scl.write(false)?;
        Ok(level)
    }

    fn send(&mut self, byte: u8) -> Result<Result<(), NotAcknowledged>, BusError> {
        for bit in (0..8).rev() {
            self.bit(byte >> bit & 1 != 0)?;
        }
        let high = self.bit(true)?;
        Ok(if high { Err(NotAcknowledged) } else { Ok(()) })
    }

    fn receive(&mut self, last: bool) -> Result<u8, BusError> {
        let mut byte = 0;
        for _ in 0..8 {
            byte = byte << 1 | u8::from(self.bit(true)?);
        }
        self.bit(last)?;
        Ok(byte)
    }

    /// A start, or a repeated start within a message: SDA falls while the clock is high.
    fn start(&mut self) -> Result<(), BusError> {
        self.pause();
        self.sda.write(true)?;
        self.pause();
        self.clock_high()?;
        self.pause();
        for _ in 0..CLEAR_CLOCKS {
            if self.sda.read()? {
                break;
            }
            self.scl.write(false)?;
            self.pause();
            self.clock_high()?;
            self.pause();
        }
        if !self.sda.read()? {
            let trouble = Trouble::new("SDA stays low: a chip or a short holds it, or it has no pull-up")
                .remedy("check the wiring, switch the chip's power off and on");
            return Err(BusError::new(BusStatus::Timeout, trouble));
        }
        self.sda.write(false)?;
        self.pause();
        self.scl.write(false)?;
        Ok(())
    }

    /// A stop: SDA rises while the clock is high.
    fn stop(&mut self) -> Result<(), BusError> {
        self.sda.write(false)?;
        self.pause();
        let high = self.clock_high();
        self.pause();
        // Release SDA even if the clock stays low.
        self.sda.write(true)?;
        high
    }

    fn converse(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let nobody = |status| {
            let trouble = Trouble::new("no chip acknowledges the address");
            BusError::new(status, trouble.remedy("check its wiring, its power and i2c_address"))
        };
        if !write.is_empty() || read.is_empty() {
            self.start()?;
            self.send(self.address)?.map_err(|_| nobody(BusStatus::StartNack))?;
            for byte in write {
                self.send(*byte)?.map_err(|_| {
                    let trouble = Trouble::new("the chip does not acknowledge a byte");
                    BusError::new(BusStatus::Nack, trouble.remedy("check that it is the chip of this section"))
                })?;
            }
        }
        if read.is_empty() {
            return Ok(());
        }
        self.start()?;
        self.send(self.address | READ)?.map_err(|_| nobody(BusStatus::StartReadNack))?;
        let last = read.len() - 1;
        for (n, byte) in read.iter_mut().enumerate() {
            *byte = self.receive(n == last)?;
        }
        Ok(())
    }
}

impl BusDevice for SoftI2c {
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        self.stretch_left = STRETCH_MAX;
        let conversed = self.converse(write, read);
        // Stop after a failure too, so that the bus is free.
        let stopped = self.stop();
        conversed.and(stopped).map_err(|error| error.of(&self.name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Direction;
    use crate::shutdown::Shutdown;
    use crate::time::{Clock, VirtualClock};
    use proptest::prelude::*;
    use std::sync::Mutex;

    const ADDRESS: u8 = 0x48;

    /// A chip on the two wires as UM10204 describes it. It has 256 registers, and the first written byte selects the
    /// register. It logs what happens.
    #[derive(Default)]
    struct Wires {
        /// The levels from [`SoftI2c`]: released or low.
        scl: bool,
        sda: bool,
        /// Whether the chip pulls SDA low.
        chip_sda_low: bool,
        /// How long it holds the clock after each falling edge.
        hold_ticks: u64,
        held_until: u64,
        acknowledges: usize,
        /// Bits of the present byte.
        bits: Vec<bool>,
        state: State,
        register: u8,
        registers: Vec<u8>,
        writes: Vec<u8>,
        /// How many bytes the master has read and not acknowledged.
        last_bytes: u32,
        /// Clocks until it releases SDA at the beginning.
        stuck_clocks: u32,
        log: Vec<&'static str>,
        /// When lines changed.
        changes: Vec<u64>,
    }

    #[derive(Clone, Copy, Default, PartialEq, Debug)]
    enum State {
        #[default]
        Idle,
        Address,
        Write,
        Read,
    }

    impl Wires {
        fn level(&self, now: u64) -> (bool, bool) {
            (self.scl && now >= self.held_until, self.sda && !self.chip_sda_low && self.stuck_clocks == 0)
        }

        fn set_sda(&mut self, level: bool) {
            let changed = self.sda != level;
            self.sda = level;
            if changed && self.scl && self.stuck_clocks == 0 {
                self.log.push(if level { "stop" } else { "start" });
                self.state = if level { State::Idle } else { State::Address };
                self.bits.clear();
                self.chip_sda_low = false;
            }
        }

        fn set_scl(&mut self, level: bool, now: u64) {
            if level == self.scl {
                return;
            }
            self.scl = level;
            if level {
                self.rise();
            } else {
                self.fall();
                self.held_until = now + self.hold_ticks;
            }
        }

        fn rise(&mut self) {
            self.stuck_clocks = self.stuck_clocks.saturating_sub(1);
            if self.state != State::Idle {
                self.bits.push(self.sda);
            }
        }

        /// Puts the chip's next bit on the wire.
        fn fall(&mut self) {
            self.chip_sda_low = false;
            let count = self.bits.len();
            match self.state {
                State::Idle => {}
                State::Address | State::Write if count == 8 => {
                    let byte = self.bits.iter().fold(0, |byte, bit| byte << 1 | u8::from(*bit));
                    self.take(byte);
                }
                State::Read if count == 9 => {
                    self.register = self.register.wrapping_add(1);
                    // The master did not acknowledge, so it was the last byte.
                    if self.bits[8] {
                        self.last_bytes += 1;
                        self.state = State::Idle;
                        return;
                    }
                    self.bits.clear();
                    self.show();
                }
                State::Read if count < 8 => self.show(),
                State::Read => {}
                _ if count == 9 => {
                    let for_reading = self.state == State::Address && self.bits[7];
                    self.bits.clear();
                    self.state = if for_reading { State::Read } else { State::Write };
                    if for_reading {
                        self.show();
                    }
                }
                _ => {}
            }
        }

        fn show(&mut self) {
            let byte = self.registers[usize::from(self.register)];
            self.chip_sda_low = byte >> (7 - self.bits.len()) & 1 == 0;
        }

        fn take(&mut self, byte: u8) {
            let is_mine = self.state == State::Write || byte >> 1 == ADDRESS;
            if !is_mine || self.acknowledges == 0 {
                self.state = State::Idle;
                return;
            }
            self.acknowledges -= 1;
            self.chip_sda_low = true;
            if self.state == State::Write {
                if self.writes.is_empty() {
                    self.register = byte;
                } else {
                    self.registers[usize::from(self.register)] = byte;
                    self.register = self.register.wrapping_add(1);
                }
                self.writes.push(byte);
            }
        }
    }

    struct Wire {
        is_clock: bool,
        wires: Arc<Mutex<Wires>>,
        clock: VirtualClock,
    }

    impl Line for Wire {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let mut wires = self.wires.lock().unwrap();
            let now = self.clock.now().ticks();
            let before = (wires.scl, wires.sda);
            match self.is_clock {
                true => wires.set_scl(level, now),
                false => wires.set_sda(level),
            }
            if before != (wires.scl, wires.sda) {
                wires.changes.push(now);
            }
            Ok(())
        }

        fn read(&self) -> Result<bool, Shutdown> {
            let (scl, sda) = self.wires.lock().unwrap().level(self.clock.now().ticks());
            Ok(if self.is_clock { scl } else { sda })
        }

        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            panic!("the direction is set when the line is claimed");
        }
    }

    fn chip(address: u8, pulse: u32) -> (SoftI2c, Arc<Mutex<Wires>>) {
        let clock = VirtualClock::at(Clock::EPOCH);
        let wires = Wires {
            scl: true,
            sda: true,
            acknowledges: usize::MAX,
            registers: (0..=255).map(|n: u8| n ^ 0x5a).collect(),
            ..Wires::default()
        };
        let wires = Arc::new(Mutex::new(wires));
        let wire =
            |is_clock| -> Arc<dyn Line> { Arc::new(Wire { is_clock, wires: wires.clone(), clock: clock.clone() }) };
        let name = "scl gpio2 sda gpio3 address 0x48".to_owned();
        let i2c = SoftI2c::new(wire(true), wire(false), address, Ticks(pulse), Arc::new(clock.clone()), name);
        (i2c, wires)
    }

    proptest! {
        #[test]
        fn what_is_written_and_read_is_what_a_chip_takes_and_has(
            pulse in 0u32..1000,
            hold_ticks in 0u64..200,
            write in proptest::collection::vec(any::<u8>(), 1..20),
            read_len in 0usize..40,
        ) {
            let (mut i2c, wires) = chip(ADDRESS, pulse);
            wires.lock().unwrap().hold_ticks = hold_ticks;
            let mut read = vec![0; read_len];
            prop_assert_eq!(i2c.write_read(&write, &mut read), Ok(()));
            let wires = wires.lock().unwrap();
            prop_assert_eq!(&wires.writes, &write);
            let first = usize::from(write[0]) + write.len() - 1;
            let expected: Vec<u8> = (first..first + read_len).map(|n| wires.registers[n % 256]).collect();
            prop_assert_eq!(read, expected);
            let expected: &[&str] =
                if read_len == 0 { &["start", "stop"] } else { &["start", "start", "stop"] };
            prop_assert_eq!(&wires.log[..], expected);
            prop_assert_eq!((wires.scl, wires.sda), (true, true), "the bus is free");
            prop_assert_eq!(wires.last_bytes, u32::from(read_len > 0), "the last byte is not acknowledged");
        }
    }

    #[test]
    fn half_a_bit_takes_a_pulse_at_least() {
        let (mut i2c, wires) = chip(ADDRESS, 250);
        i2c.write_read(&[0x55], &mut [0]).unwrap();
        let changes = &wires.lock().unwrap().changes;
        // The clock falls and the data changes at the same time. All other changes are at least a pulse apart.
        let distinct: Vec<u64> = changes.iter().copied().fold(Vec::new(), |mut distinct, at| {
            if distinct.last() != Some(&at) {
                distinct.push(at);
            }
            distinct
        });
        assert!(distinct.windows(2).all(|pair| pair[1] - pair[0] >= 250), "{distinct:?}");
        // This message takes at least 29 bits of two halves each.
        assert!(distinct.last().unwrap() - distinct.first().unwrap() >= 29 * 2 * 250);
    }

    #[test]
    fn an_empty_register_is_one_read_and_nothing_at_all_an_address() {
        let (mut i2c, wires) = chip(ADDRESS, 10);
        let mut read = [0; 2];
        i2c.write_read(&[], &mut read).unwrap();
        assert_eq!(read, [0x5a, 0x5b]);
        i2c.write_read(&[], &mut []).unwrap();
        assert_eq!(wires.lock().unwrap().log, ["start", "stop", "start", "stop"]);
    }

    #[test]
    fn each_silence_has_its_status() {
        for (address, acknowledges, status) in [
            (0x20, usize::MAX, BusStatus::StartNack),
            (ADDRESS, 0, BusStatus::StartNack),
            (ADDRESS, 1, BusStatus::Nack),
            (ADDRESS, 2, BusStatus::StartReadNack),
        ] {
            let (mut i2c, wires) = chip(address, 10);
            wires.lock().unwrap().acknowledges = acknowledges;
            let error = i2c.write_read(&[1], &mut [0]).unwrap_err();
            assert_eq!(error.status, status, "{acknowledges}");
            assert!(error.trouble.to_string().starts_with("scl gpio2 sda gpio3 address 0x48: "), "{error:?}");
            let wires = wires.lock().unwrap();
            assert_eq!(wires.log.last(), Some(&"stop"));
            assert_eq!((wires.scl, wires.sda), (true, true), "the bus is free for the next chip");
        }
    }

    #[test]
    fn a_clock_that_is_held_is_waited_for_but_not_for_ever() {
        let (mut i2c, wires) = chip(ADDRESS, 10);
        // 27 bits of 3 ms each.
        wires.lock().unwrap().hold_ticks = Ticks::from_ms(3).0.into();
        assert_eq!(i2c.write_read(&[1, 2], &mut []), Ok(()));
        for hold_us in [4000, 1_000_000] {
            let (mut i2c, wires) = chip(ADDRESS, 10);
            wires.lock().unwrap().hold_ticks = Ticks::from_us(hold_us).0.into();
            let error = i2c.write_read(&[1, 2], &mut []).unwrap_err();
            assert_eq!(error.status, BusStatus::Timeout);
            assert!(error.trouble.cause.contains("SCL stays low"), "{error:?}");
            let wires = wires.lock().unwrap();
            assert_eq!((wires.scl, wires.sda), (true, true), "we hold nothing");
            let waited = i2c.clock.now().since(Clock::EPOCH) as u64;
            assert!(waited < 2 * u64::from(STRETCH_MAX.0), "{waited}");
        }
    }

    #[test]
    fn a_chip_that_was_left_amid_a_byte_is_clocked_until_it_lets_go() {
        for clocks in 1..=9 {
            let (mut i2c, wires) = chip(ADDRESS, 10);
            wires.lock().unwrap().stuck_clocks = clocks;
            assert_eq!(i2c.write_read(&[7], &mut []), Ok(()), "{clocks}");
            assert_eq!(wires.lock().unwrap().writes, [7]);
        }
        let (mut i2c, wires) = chip(ADDRESS, 10);
        wires.lock().unwrap().stuck_clocks = 1000;
        let error = i2c.write_read(&[7], &mut []).unwrap_err();
        assert_eq!(error.status, BusStatus::Timeout);
        assert!(error.trouble.cause.contains("SDA stays low"), "{error:?}");
    }
}
