// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices on buses: a worker calls them.

use std::time::Duration;

use pinion_firmware::board::{Adc, BusDevice, BusError, BusStatus, I2cConfig, Pwm, SerialPort, SpiConfig, Thermometer};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{CLOCK_FREQ, NS_PER_TICK, Ticks};
use pinion_firmware::trouble::Trouble;

use super::bench::{Bench, MESSAGE_MAX, SPI_CHIPS};
use crate::memory::uncounted;

pub(super) struct FakeSerial {
    pub(super) bench: Bench,
    pub(super) pin: u32,
    pub(super) rate_hz: u32,
    pub(super) received: Vec<u8>,
}

impl SerialPort for FakeSerial {
    fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        self.bench.broken(self.pin, reason::SERIAL_OPEN).map_err(Shutdown::into_trouble)?;
        self.bench.pass(Ticks(CLOCK_FREQ / self.rate_hz * 10 * bytes.len() as u32));
        // The state is not locked while the other end answers, because it may read the bench.
        let end = self.bench.state().serial_ends.remove(&self.pin);
        self.received.clear();
        if let Some(mut end) = end {
            self.received = end(self.bench.ticks(), bytes);
            self.bench.state().serial_ends.insert(self.pin, end);
        }
        Ok(())
    }

    fn receive(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, Trouble> {
        let count = bytes.len().min(self.received.len());
        if count == 0 {
            self.bench.pass(Ticks((limit.as_nanos() as u64 / NS_PER_TICK) as u32));
        }
        self.bench.pass(Ticks(CLOCK_FREQ / self.rate_hz * 10 * count as u32));
        bytes[..count].copy_from_slice(&self.received[..count]);
        self.received.drain(..count);
        Ok(count)
    }
}

pub(super) struct FakeThermometer {
    pub(super) bench: Bench,
    pub(super) serial: Vec<u8>,
}

impl Thermometer for FakeThermometer {
    fn read(&mut self) -> Result<i32, Trouble> {
        let mut state = self.bench.state();
        let values = state.thermometers.get_mut(&self.serial).unwrap();
        let value = if values.len() > 1 { values.pop_front().unwrap() } else { values[0] };
        value.ok_or_else(|| Trouble::new("the sensor on the bench has a wrong CRC").remedy("check the wires"))
    }
}

pub(super) struct FakePwm {
    pub(super) bench: Bench,
    pub(super) pin: u32,
}

impl Pwm for FakePwm {
    fn set(&mut self, value: u16) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, reason::PWM_WRITE)?;
        let at = self.bench.ticks();
        uncounted(|| self.bench.state().pwm_values.push((self.pin, at, value)));
        Ok(())
    }

    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        self.bench.state().pwm_cycles.insert(self.pin, cycle.0);
        self.set(value)
    }
}

pub(super) struct FakeAdc {
    pub(super) bench: Bench,
    pub(super) pin: u32,
}

impl Adc for FakeAdc {
    fn read(&mut self) -> Result<u16, Shutdown> {
        self.bench.broken(self.pin, reason::ADC_READ)?;
        let mut state = self.bench.state();
        Ok(match state.readings.get_mut(&self.pin) {
            Some(readings) if readings.len() > 1 => readings.pop_front().unwrap(),
            Some(readings) => readings.front().copied().unwrap_or(0),
            None => 0,
        })
    }
}

/// The device at an I2C address: a chip from a test, or nothing.
pub(super) struct FakeI2c {
    pub(super) bench: Bench,
    pub(super) config: I2cConfig,
}

impl BusDevice for FakeI2c {
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        let I2cConfig { bus, address, .. } = self.config;
        // An address byte precedes the written bytes, and another precedes the bytes to read.
        let addresses = usize::from(!write.is_empty()) + usize::from(!read.is_empty());
        let at = self.bench.bus_ticks(write.len() + read.len() + addresses);
        // The state is not locked while the chip answers, because the chip may read the bench.
        let chip = self.bench.state().i2c_chips.remove(&(bus, address));
        let Some(mut chip) = chip else {
            let trouble = Trouble::new(format!("nothing answers at 0x{address:02x}")).remedy("check the wiring");
            return Err(BusError::new(BusStatus::StartNack, trouble));
        };
        let answer = chip(at, write, read);
        self.bench.state().i2c_chips.insert((bus, address), chip);
        answer.map_err(|status| {
            BusError::new(status, Trouble::new("the chip on the bench says no").remedy("ask it again"))
        })
    }
}

/// A chip from a test, or one that returns the complement of each byte.
pub(super) struct FakeSpi {
    pub(super) bench: Bench,
    pub(super) config: SpiConfig,
}

impl FakeSpi {
    fn converse(&mut self, bytes: &mut [u8], read: bool) -> Result<(), BusError> {
        let SpiConfig { bus, mode, rate_hz, .. } = self.config;
        self.bench.gate.pass();
        self.bench.broken(SPI_CHIPS + bus, reason::LINE_READ)?;
        match &self.config.chip_select {
            Some(line) if bytes.is_empty() => line.pulse()?,
            Some(line) => line.select(true)?,
            None => {}
        }
        let mut message = ([0; MESSAGE_MAX], bytes.len());
        message.0[..bytes.len()].copy_from_slice(bytes);
        let at = self.bench.bus_ticks(bytes.len());
        uncounted(|| self.bench.state().transfers.push((at, bus, mode, rate_hz, message, read)));
        let chip = self.bench.state().spi_chips.remove(&bus);
        match chip {
            Some(mut chip) => {
                chip(at, bytes);
                self.bench.state().spi_chips.insert(bus, chip);
            }
            None => bytes.iter_mut().for_each(|byte| *byte = !*byte),
        }
        match &self.config.chip_select {
            Some(line) if !bytes.is_empty() => line.select(false).map_err(BusError::from),
            _ => Ok(()),
        }
    }
}

impl BusDevice for FakeSpi {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        self.converse(bytes, true)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        let mut copy = [0; MESSAGE_MAX];
        let copy = &mut copy[..bytes.len()];
        copy.copy_from_slice(bytes);
        self.converse(copy, false)
    }
}
