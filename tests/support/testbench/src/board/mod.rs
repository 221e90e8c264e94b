// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that records what the MCU does to its pins. A test plays the devices.

use std::sync::Arc;

use pinion_firmware::board::{
    Adc, Bias, Board, BusDevice, ClaimedLine, CountedLine, Direction, Edges, I2cConfig, Line, Mosi, OnWorker, Pin, Pwm,
    PwmConfig, Range, SerialPort, SpiConfig, Thermometer,
};
use pinion_firmware::shutdown::{Shutdown, reason};

mod bench;
mod devices;
mod lines;
mod plain;
mod workers;

pub use bench::{
    ANALOG, Bench, Edge, GPIOS, I2cChip, LineChip, MESSAGE_MAX, MISO, MOSI, PWM, SERIAL, SPI_CHIPS, SerialEnd,
    SleepyLink, SpiChip, State, Transfer,
};
use bench::{ANALOGS, I2C_BUSES, PWMS, SERIALS, SPI_BUSES};
use devices::{FakeAdc, FakeI2c, FakePwm, FakeSerial, FakeSpi, FakeThermometer};
use lines::{FakeBank, FakeEdges, FakeLine};
pub use plain::PlainBoard;
pub use workers::FakeWorkers;

/// The chip that has the lines that may sleep.
const EXPANDER: &str = "gpiochip1";

/// The board. The bench is the test's side of it.
pub struct FakeBoard(pub Bench);

impl Board for FakeBoard {
    fn describe(&self) -> String {
        "a test bench".into()
    }

    fn pins(&self) -> Vec<Range> {
        vec![
            Range { name: "gpio0".into(), first: 0, count: GPIOS },
            Range { name: "analog0".into(), first: ANALOG, count: ANALOGS },
            Range { name: "pwm0".into(), first: PWM, count: PWMS },
            Range { name: "spidev0".into(), first: MOSI, count: SPI_BUSES },
            Range { name: "miso0".into(), first: MISO, count: SPI_BUSES },
            Range { name: "ttyS0".into(), first: SERIAL, count: SERIALS },
        ]
    }

    fn spi_buses(&self) -> Vec<Range> {
        vec![Range { name: "spi0".into(), first: 0, count: SPI_BUSES }]
    }

    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let Pin(number) = pin;
        if number >= GPIOS {
            let unknown = match direction {
                Direction::Output { .. } | Direction::OpenDrain => reason::NOT_OUTPUT,
                Direction::Input(_) => reason::NOT_INPUT,
            };
            let remedy = format!("choose one of 0 to {}", GPIOS - 1);
            return Err(Shutdown::because(unknown, format!("the bench has no pin {number}")).remedy(remedy));
        }
        if !self.0.state().held.insert(number) {
            return Err(Shutdown::because(reason::INPUT_LINE, format!("pin {number} is in use")).remedy("free it"));
        }
        let is_first = self.0.state().has_bank && self.0.state().bank.is_none();
        if is_first {
            let bank = Box::leak(Box::new(FakeBank(self.0.clone())));
            self.0.state().bank = Some(bank);
        }
        let line = FakeLine { bench: self.0.clone(), pin: number };
        line.set_direction(direction)?;
        let sleeps_on = self.0.state().sleeping.contains(&number).then(|| EXPANDER.to_owned());
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on })
    }

    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        let line = self.line(pin, Direction::Input(bias))?;
        let edges = match self.0.state().counted.contains(&pin.0) {
            true => {
                let edges = FakeEdges { bench: self.0.clone(), pin: pin.0, taken: 0 };
                Ok(OnWorker { bus: "edges".into(), device: Box::new(edges) as Box<dyn Edges> })
            }
            false => Err("this pin has no interrupt".into()),
        };
        Ok(CountedLine { line, edges })
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let pin = self.0.claim(pin, ANALOG..ANALOG + ANALOGS, reason::ADC_OPEN)?;
        Ok(OnWorker { bus: "iio".into(), device: Box::new(FakeAdc { bench: self.0.clone(), pin }) })
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        if config.bus >= SPI_BUSES {
            let cause = format!("the bench has no SPI bus {}", config.bus);
            return Err(Shutdown::because(reason::SPI_OPEN, cause).remedy("choose spi0 or spi1"));
        }
        let bus = format!("spi{}", config.bus);
        Ok(OnWorker { bus, device: Box::new(FakeSpi { bench: self.0.clone(), config }) })
    }

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
        let Some(bus) = pin.0.checked_sub(MOSI).filter(|bus| *bus < SPI_BUSES) else { return Ok(None) };
        let line = self.spi(SpiConfig { bus, mode: 0, rate_hz, chip_select: None })?;
        Ok(Some(Mosi { line, message_max: MESSAGE_MAX, pauses: None }))
    }

    fn mosi_of(&self, miso: Pin) -> Option<Pin> {
        let bus = miso.0.checked_sub(MISO).filter(|bus| *bus < SPI_BUSES)?;
        Some(Pin(MOSI + bus))
    }

    fn serial(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<OnWorker<dyn SerialPort>>, Shutdown> {
        if !(SERIAL..SERIAL + SERIALS).contains(&pin.0) {
            return Ok(None);
        }
        self.0.broken(pin.0, reason::SERIAL_OPEN)?;
        let port = FakeSerial { bench: self.0.clone(), pin: pin.0, rate_hz, received: Vec::new() };
        Ok(Some(OnWorker { bus: format!("ttyS{}", pin.0 - SERIAL), device: Box::new(port) }))
    }

    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        if !self.0.state().thermometers.contains_key(serial) {
            let cause = format!("the bench has no {}", String::from_utf8_lossy(serial));
            return Err(Shutdown::because(reason::DS18B20_OPEN, cause).remedy("plug it in"));
        }
        let device = FakeThermometer { bench: self.0.clone(), serial: serial.into() };
        Ok(OnWorker { bus: "w1".into(), device: Box::new(device) })
    }

    fn i2c_buses(&self) -> Vec<Range> {
        vec![Range { name: "i2c.0".into(), first: 0, count: I2C_BUSES }]
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        if config.bus >= I2C_BUSES {
            let cause = format!("the bench has no I2C bus {}", config.bus);
            return Err(Shutdown::because(reason::I2C_OPEN, cause).remedy("choose i2c.0 or i2c.1"));
        }
        let bus = format!("i2c{}", config.bus);
        Ok(OnWorker { bus, device: Box::new(FakeI2c { bench: self.0.clone(), config }) })
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let pin = self.0.claim(config.pin, PWM..PWM + PWMS, reason::PWM_CONFIG)?;
        let mut pwm = FakePwm { bench: self.0.clone(), pin };
        self.0.state().pwm_shutdown_values.insert(pin, config.shutdown_value.get());
        pwm.set_cycle(config.cycle, config.value)?;
        Ok(OnWorker { bus: "pwm".into(), device: Box::new(pwm) })
    }

    fn reset(&mut self) {
        let mut state = self.0.state();
        state.claimed.clear();
        state.directions.clear();
    }
}
