// SPDX-License-Identifier: GPL-3.0-or-later
//! Records the edges of outputs, if somebody asks for it: a board whose lines note each change.

#![forbid(unsafe_code)]

use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};

use pinion_firmware::board::{
    Adc, Bias, Board, BusDevice, ClaimedLine, CountedLine, Direction, I2cConfig, Line, Mosi, OnWorker, Pin, Pwm,
    PwmConfig, Range, SerialPort, SpiConfig, Thermometer,
};
use pinion_firmware::shutdown::Shutdown;
use pinion_firmware::time::TimeSource;
use pinion_linux::clock::Monotonic;

use crate::trace::event::Event;
use crate::trace::file::Names;
use crate::trace::ring::Writer;

use super::locked;

/// A board that records the edges of its outputs. All else is the board's own. Who wants a view of the board takes it
/// from the board itself.
pub(super) struct EdgeBoard {
    pub(super) board: Box<dyn Board>,
    pub(super) tape: Arc<EdgeTape>,
    /// Where the names of the lines are noted.
    pub(super) names: Arc<Mutex<Names>>,
}

/// Where the edges are recorded. Core and workers write lines.
pub(super) struct EdgeTape {
    pub(super) writer: Mutex<Writer>,
    pub(super) clock: Monotonic,
}

impl EdgeTape {
    /// No thread waits for another one here. If two change lines at the same time, one edge is missing.
    fn record(&self, pin: u32, level: bool) {
        if let Ok(mut writer) = self.writer.try_lock() {
            writer.write(self.clock.now(), Event::Edge { pin, level });
        }
    }
}

/// No level is known.
const UNKNOWN: u8 = 2;

/// A line that records its edges.
struct EdgeLine {
    line: Arc<dyn Line>,
    tape: Arc<EdgeTape>,
    pin: u32,
    level: AtomicU8,
}

impl EdgeLine {
    fn is_now(&self, level: bool) {
        if self.level.swap(level.into(), Ordering::Relaxed) != u8::from(level) {
            self.tape.record(self.pin, level);
        }
    }
}

impl Line for EdgeLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.line.write(level)?;
        self.is_now(level);
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.line.read()
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.set_direction(direction)?;
        self.turned(direction);
        Ok(())
    }

    fn is_fast(&self) -> bool {
        self.line.is_fast()
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.line.turn(direction)?;
        self.turned(direction);
        Ok(())
    }
}

impl EdgeLine {
    fn turned(&self, direction: Direction) {
        match direction {
            Direction::Output { level, .. } => self.is_now(level),
            Direction::OpenDrain => self.is_now(true),
            // Somebody else sets its level.
            Direction::Input(_) => self.level.store(UNKNOWN, Ordering::Relaxed),
        }
    }
}

impl EdgeBoard {
    fn recorded(&self, pin: Pin, line: Arc<dyn Line>) -> Arc<EdgeLine> {
        let name = pin.name_in(&self.board.pins());
        locked(&self.names).pins.insert(pin.0, name);
        Arc::new(EdgeLine { line, tape: self.tape.clone(), pin: pin.0, level: AtomicU8::new(UNKNOWN) })
    }
}

impl Board for EdgeBoard {
    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let ClaimedLine { line, sleeps_on } = self.board.line(pin, direction)?;
        let line = self.recorded(pin, line);
        line.turned(direction);
        Ok(ClaimedLine { line, sleeps_on })
    }

    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        self.board.counted_line(pin, bias)
    }

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

    fn canonical(&self, pin: Pin) -> Pin {
        self.board.canonical(pin)
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        self.board.adc(pin)
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        self.board.spi(config)
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        self.board.i2c(config)
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        self.board.pwm(config)
    }

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Mosi, Shutdown> {
        self.board.mosi(pin, rate_hz)
    }

    fn mosi_of(&self, miso: Pin) -> Option<Pin> {
        self.board.mosi_of(miso)
    }

    fn serial(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<OnWorker<dyn SerialPort>>, Shutdown> {
        self.board.serial(pin, rate_hz)
    }

    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        self.board.ds18b20(serial)
    }

    fn reset(&mut self) {
        self.board.reset();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::recorder::Recording;
    use pinion_firmware::time::{Clock, VirtualClock};
    use pinion_testbench::board::{Bench, FakeBoard};

    #[test]
    fn each_change_of_an_output_is_recorded_once() {
        let recording = Recording::of_a_test();
        let bench = Bench::new(VirtualClock::at(Clock::EPOCH), Clock::EPOCH);
        let names = Arc::new(Mutex::new(Names::default()));
        let tape = EdgeTape { writer: Mutex::new(recording.memory.edges().unwrap()), clock: recording.clock };
        let mut board =
            EdgeBoard { board: Box::new(FakeBoard(bench.clone())), tape: Arc::new(tape), names: names.clone() };
        let direction = Direction::Output { level: true, shutdown_value: false };
        let line = board.line(Pin(3), direction).unwrap().line;
        for level in [true, false, false, true] {
            line.write(level).unwrap();
        }
        assert!(bench.level(3));
        line.set_direction(Direction::Input(Bias::None)).unwrap();
        line.turn(direction).unwrap();
        let events = recording.memory.rings().next().unwrap().newest();
        let levels: Vec<bool> = events
            .into_iter()
            .map(|words| match Event::decode(words) {
                Some((_, Event::Edge { pin: 3, level })) => level,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(levels, [true, false, true, true]);
        assert_eq!(names.lock().unwrap().pins[&3], "gpio3");
    }
}
