// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer with devices that fail when a test wants it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use pinion_firmware::board::{
    Adc, Bias, Board, BusDevice, BusError, BusStatus, ClaimedLine, CountedLine, Direction, I2cConfig, Line, Mosi,
    OnWorker, Pin, Pwm, PwmConfig, Range, SpiConfig, Thermometer,
};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{Ticks, TimeSource, VirtualClock};
use pinion_firmware::trouble::Trouble;
use pinion_model::SimBoard;
use pinion_testbench::memory::uncounted;

/// The output on an expander: a chip that may sleep, and that may go.
pub const EXPANDED: &str = "fan";
/// How long a chip that hangs takes to answer: longer than the MCU waits.
const HANGS: Ticks = Ticks::from_ms(6000);

/// Calls that fail from now on.
pub struct Failing(AtomicU32);

impl Failing {
    const fn none() -> Failing {
        Failing(AtomicU32::new(0))
    }

    /// This number of calls; `u32::MAX`: all of them.
    pub fn set(&self, calls: u32) {
        self.0.store(calls, Ordering::Relaxed);
    }

    fn now(&self) -> bool {
        let left = self.0.load(Ordering::Relaxed);
        self.set(if left == u32::MAX { left } else { left.saturating_sub(1) });
        left > 0
    }
}

/// The faults of the printer's devices.
pub struct Faults {
    pub adc: Failing,
    pub expander: Failing,
    pub i2c: Failing,
    pub spi: Failing,
    pub pwm: Failing,
    pub thermometer: Failing,
    pub i2c_hangs: AtomicBool,
    /// The wires of the thermistors are broken.
    pub open_circuit: AtomicBool,
}

impl Faults {
    pub fn none() -> Arc<Faults> {
        let none = Failing::none;
        let (adc, expander, i2c, spi, pwm, thermometer) = (none(), none(), none(), none(), none(), none());
        let (i2c_hangs, open_circuit) = (AtomicBool::new(false), AtomicBool::new(false));
        Arc::new(Faults { adc, expander, i2c, spi, pwm, thermometer, i2c_hangs, open_circuit })
    }

    /// Everything works again.
    pub fn mend(&self) {
        let Faults { adc, expander, i2c, spi, pwm, thermometer, .. } = self;
        [adc, expander, i2c, spi, pwm, thermometer].into_iter().for_each(|failing| failing.set(0));
        self.i2c_hangs.store(false, Ordering::Relaxed);
        self.open_circuit.store(false, Ordering::Relaxed);
    }
}

/// The simulated printer with its faults. What its devices allocate is not counted.
pub struct FaultyBoard {
    pub board: SimBoard,
    pub faults: Arc<Faults>,
    pub clock: VirtualClock,
}

struct Faulty<T: ?Sized> {
    device: Box<T>,
    faults: Arc<Faults>,
    clock: VirtualClock,
}

impl FaultyBoard {
    fn faulty<T: ?Sized>(&self, device: Box<T>) -> Faulty<T> {
        Faulty { device, faults: self.faults.clone(), clock: self.clock.clone() }
    }
}

struct ExpandedLine {
    line: Arc<dyn Line>,
    faults: Arc<Faults>,
}

impl Line for ExpandedLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        if self.faults.expander.now() {
            return Err(Shutdown::because(reason::LINE_WRITE, "the expander is gone").remedy("plug it in"));
        }
        self.line.write(level)
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.line.read()
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.set_direction(direction)
    }
}

impl Adc for Faulty<dyn Adc> {
    fn read(&mut self) -> Result<u16, Shutdown> {
        if self.faults.adc.now() {
            return Err(Shutdown::because(reason::ADC_READ, "the ADC is gone").remedy("plug it in"));
        }
        let counts = uncounted(|| self.device.read())?;
        Ok(if self.faults.open_circuit.load(Ordering::Relaxed) { 4095 } else { counts })
    }
}

impl Pwm for Faulty<dyn Pwm> {
    fn set(&mut self, value: u16) -> Result<(), Shutdown> {
        if self.faults.pwm.now() {
            return Err(Shutdown::because(reason::PWM_WRITE, "the controller is gone").remedy("load its driver"));
        }
        self.device.set(value)
    }

    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        self.device.set_cycle(cycle, value)
    }
}

impl Thermometer for Faulty<dyn Thermometer> {
    fn read(&mut self) -> Result<i32, Trouble> {
        if self.faults.thermometer.now() {
            return Err(Trouble::new("the sensor is gone").remedy("plug it in"));
        }
        self.device.read()
    }
}

fn no_answer() -> BusError {
    BusError::new(BusStatus::Nack, "the chip is gone")
}

/// A chip on SPI.
impl BusDevice for Faulty<dyn BusDevice> {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        if self.faults.spi.now() {
            return Err(no_answer());
        }
        uncounted(|| self.device.exchange(bytes))
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        uncounted(|| self.exchange(&mut bytes.to_vec()))
    }

    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        if self.faults.i2c_hangs.load(Ordering::Relaxed) {
            self.clock.spin_until(self.clock.now() + HANGS);
        }
        if self.faults.i2c.now() {
            return Err(no_answer());
        }
        uncounted(|| self.device.write_read(write, read))
    }
}

impl Board for FaultyBoard {
    fn describe(&self) -> String {
        self.board.describe()
    }

    fn pins(&self) -> Vec<Range> {
        self.board.pins()
    }

    fn spi_buses(&self) -> Vec<Range> {
        self.board.spi_buses()
    }

    fn i2c_buses(&self) -> Vec<Range> {
        self.board.i2c_buses()
    }

    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let claimed = self.board.line(pin, direction)?;
        if pin.name_in(&self.pins()) != EXPANDED {
            return Ok(claimed);
        }
        let line = ExpandedLine { line: claimed.line, faults: self.faults.clone() };
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on: Some("expander".to_owned()) })
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let OnWorker { bus, device } = self.board.adc(pin)?;
        Ok(OnWorker { bus, device: Box::new(self.faulty(device)) })
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        if self.faults.spi.now() {
            return Err(Shutdown::because(reason::SPI_OPEN, "the bus is gone").remedy("load its driver"));
        }
        let OnWorker { bus, device } = self.board.spi(config)?;
        Ok(OnWorker { bus, device: Box::new(self.faulty(device)) })
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let OnWorker { bus, device } = self.board.i2c(config)?;
        Ok(OnWorker { bus, device: Box::new(self.faulty(device)) })
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let OnWorker { bus, device } = self.board.pwm(config)?;
        Ok(OnWorker { bus, device: Box::new(self.faulty(device)) })
    }

    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        let OnWorker { bus, device } = self.board.ds18b20(serial)?;
        Ok(OnWorker { bus, device: Box::new(self.faulty(device)) })
    }

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
        let mosi = self.board.mosi(pin, rate_hz)?;
        Ok(mosi.map(|Mosi { line: OnWorker { bus, device }, message_max, pauses }| {
            let line = OnWorker { bus, device: Box::new(self.faulty(device)) as Box<dyn BusDevice> };
            Mosi { line, message_max, pauses }
        }))
    }

    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        self.board.counted_line(pin, bias)
    }

    fn reset(&mut self) {
        self.board.reset();
    }
}
