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

use pinion_trace::event::Event;
use pinion_trace::file::Names;
use pinion_trace::ring::Writer;

use super::locked;

/// A board that records the edges of its outputs. All else is the board's own. Who wants a view of the board takes it
/// from the board itself.
pub(super) struct EdgeBoard {
    pub(super) board: Box<dyn Board>,
    pub(super) trace_writer: Arc<EdgeWriter>,
    /// Where the names of the lines are noted.
    pub(super) names: Arc<Mutex<Names>>,
}

/// Where the edges are recorded. Core and workers write lines.
pub(super) struct EdgeWriter {
    pub(super) writer: Mutex<Writer>,
    pub(super) clock: Monotonic,
}

impl EdgeWriter {
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
    trace_writer: Arc<EdgeWriter>,
    pin: u32,
    level: AtomicU8,
}

impl EdgeLine {
    fn is_now(&self, level: bool) {
        if self.level.swap(level.into(), Ordering::Relaxed) != u8::from(level) {
            self.trace_writer.record(self.pin, level);
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

    fn flush(&self) {
        self.line.flush();
    }

    fn is_posted(&self) -> bool {
        self.line.is_posted()
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
        Arc::new(EdgeLine { line, trace_writer: self.trace_writer.clone(), pin: pin.0, level: AtomicU8::new(UNKNOWN) })
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

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
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
    use crate::recorder::Recording;
    use pinion_firmware::time::{Clock, VirtualClock};
    use pinion_testbench::board::{Bench, FakeBoard};
    use pinion_testbench::rig::{Rig, hex};

    fn edge_board(recording: &Recording, bench: Bench, names: &Arc<Mutex<Names>>) -> EdgeBoard {
        let trace_writer = EdgeWriter { writer: Mutex::new(recording.memory.edges().unwrap()), clock: recording.clock };
        EdgeBoard { board: Box::new(FakeBoard(bench)), trace_writer: Arc::new(trace_writer), names: names.clone() }
    }

    #[test]
    fn a_host_configures_all_that_the_board_has() {
        let names = Arc::default();
        let mut rig = Rig::on_board(0, |bench| edge_board(&Recording::of_a_test(), bench, &names));
        let (own, board) =
            (FakeBoard(rig.bench.clone()), edge_board(&Recording::of_a_test(), rig.bench.clone(), &names));
        assert_eq!((board.describe(), board.pins()), (own.describe(), own.pins()));
        assert_eq!((board.spi_buses(), board.i2c_buses()), (own.spi_buses(), own.i2c_buses()));
        rig.bench.script_ds18b20("28-0000", &[Some(21_000)]);
        rig.configure(&[
            "config_digital_out oid=0 pin=3 value=1 default_value=0 max_duration=0",
            "config_counter oid=1 pin=30 pull_up=1",
            "config_analog_in oid=2 pin=400",
            "config_spi_without_cs oid=3",
            "spi_set_bus oid=3 spi_bus=0 mode=0 rate=1000000",
            "config_i2c oid=4",
            "i2c_set_bus oid=4 i2c_bus=1 rate=400000 address=72",
            "config_pwm_out oid=5 pin=500 cycle_ticks=50000 value=0 default_value=0 max_duration=0",
            "config_neopixel oid=6 pin=700 data_size=6 bit_max_ticks=200 reset_min_ticks=2500",
            "config_hx71x oid=7 gain_channel=1 dout_pin=711 sclk_pin=701",
            "config_tmcuart oid=8 rx_pin=800 pull_up=0 tx_pin=800 bit_time=1250",
            &format!("config_ds18b20 oid=9 serial={} max_error_count=4", hex(b"28-0000")),
        ]);
        assert_eq!(rig.shutdown(), None);
        let lines: Vec<String> = names.lock().unwrap().pins.values().cloned().collect();
        assert_eq!(lines, ["gpio3"], "the kernel counts the edges of the other line");
        rig.send_all(&["emergency_stop", "config_reset"]);
        rig.responses();
        rig.configure(&["config_digital_out oid=0 pin=3 value=1 default_value=0 max_duration=0"]);
        assert_eq!(rig.shutdown(), None, "all lines were free again");
    }

    #[test]
    fn each_change_of_an_output_is_recorded_once() {
        let recording = Recording::of_a_test();
        let bench = Bench::new(VirtualClock::at(Clock::EPOCH), Clock::EPOCH);
        let names = Arc::default();
        let mut board = edge_board(&recording, bench.clone(), &names);
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
