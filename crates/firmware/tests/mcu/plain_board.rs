// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that has only what every board must have. It refuses the rest, and the log says why.

use pinion_firmware::board::{
    Adc, Board, BusDevice, ClaimedLine, Direction, I2cConfig, OnWorker, Pin, Pwm, PwmConfig, Range, SpiConfig,
};
use pinion_firmware::shutdown::Shutdown;
use pinion_testbench::board::FakeBoard;
use pinion_testbench::rig::{Rig, hex};

struct PlainBoard(FakeBoard);

impl Board for PlainBoard {
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
        self.0.line(pin, direction)
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

fn rig() -> Rig {
    Rig::on_board(0, |bench| PlainBoard(FakeBoard(bench)))
}

/// Configures an object. Returns the text for the host, and the log's lines.
fn refusal(object: &str) -> (Option<String>, String) {
    let mut rig = rig();
    rig.send("allocate_oids count=1");
    rig.send(object);
    (rig.shutdown(), rig.notes().concat())
}

#[test]
fn a_board_without_one_wire_refuses_a_thermometer() {
    let sensor = format!("config_ds18b20 oid=0 serial={} max_error_count=4", hex(b"28-0000"));
    let (text, log) = refusal(&sensor);
    assert_eq!(text.as_deref(), Some("Invalid DS18B20 serial id, could not open for reading"));
    assert!(log.contains("\"28-0000\": this board has no one-wire bus"), "{log}");
}

#[test]
fn a_board_without_an_output_for_leds_refuses_them() {
    let (text, log) = refusal("config_neopixel oid=0 pin=5 data_size=6 bit_max_ticks=200 reset_min_ticks=2500");
    assert_eq!(text.as_deref(), Some("Not an output pin"));
    assert!(log.contains("gpio5 cannot drive LEDs") && log.contains("connect them to the data output"), "{log}");
}

#[test]
fn a_board_without_events_of_edges_polls_its_counters() {
    let mut rig = rig();
    rig.configure(&["config_counter oid=0 pin=30 pull_up=1"]);
    rig.bench.script_input(30, &[(12_500, 1), (15_000, 0), (17_500, 1)]);
    rig.send("query_counter oid=0 clock=@10000 poll_ticks=1000 sample_ticks=20000");
    rig.run_until(40_000);
    assert_eq!(rig.responses()[1], "counter_state oid=0 next_clock=@33000 count=3 count_clock=@18000");
}
