// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that has only what every board must have.

use pinion_firmware::board::{
    Adc, Board, BusDevice, ClaimedLine, Direction, I2cConfig, OnWorker, Pin, Pwm, PwmConfig, Range, SpiConfig,
};
use pinion_firmware::shutdown::Shutdown;

use super::FakeBoard;

/// The bench's board without what a board may leave out. `F` makes its lines.
pub struct PlainBoard<F>(pub FakeBoard, pub F);

impl<F> Board for PlainBoard<F>
where
    F: FnMut(&mut FakeBoard, Pin, Direction) -> Result<ClaimedLine, Shutdown> + Send,
{
    fn describe(&self) -> String {
        self.0.describe()
    }

    fn pins(&self) -> Vec<Range> {
        self.0.pins()
    }

    fn spi_buses(&self) -> Vec<Range> {
        self.0.spi_buses()
    }

    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        (self.1)(&mut self.0, pin, direction)
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        self.0.adc(pin)
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        self.0.spi(config)
    }

    fn i2c_buses(&self) -> Vec<Range> {
        self.0.i2c_buses()
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        self.0.i2c(config)
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        self.0.pwm(config)
    }

    fn reset(&mut self) {
        self.0.reset();
    }
}
