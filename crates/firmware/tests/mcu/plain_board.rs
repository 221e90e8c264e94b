// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that has only what every board must have. It refuses the rest, and the log says why.

use std::sync::Arc;

use pinion_firmware::board::{Board, BusDevice, BusError, BusStatus, ClaimedLine, Direction, Line};
use pinion_firmware::shutdown::Shutdown;
use pinion_testbench::board::{Bench, FakeBoard, MISO, MOSI, PlainBoard, SERIAL};
use pinion_testbench::rig::{Rig, hex};

struct PlainLine(Arc<dyn Line>);

impl Line for PlainLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.0.write(level)
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.0.read()
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        self.0.set_direction(direction)
    }
}

/// A chip that returns the complement of each byte.
struct SpiChip;

impl BusDevice for SpiChip {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        bytes.iter_mut().for_each(|byte| *byte = !*byte);
        Ok(())
    }
}

/// A chip that returns the number of its register.
struct I2cChip;

impl BusDevice for I2cChip {
    fn write_read(&mut self, write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
        read.fill(write[0]);
        Ok(())
    }
}

fn board(bench: Bench) -> impl Board {
    PlainBoard(FakeBoard(bench), |board: &mut FakeBoard, pin, direction| {
        let ClaimedLine { line, sleeps_on } = board.line(pin, direction)?;
        Ok(ClaimedLine { line: Arc::new(PlainLine(line)), sleeps_on })
    })
}

fn rig() -> Rig {
    Rig::on_board(0, board)
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

#[test]
fn a_board_without_serial_ports_takes_lines_for_them() {
    // The bench would have ports and controllers at these numbers.
    for (object, pin) in [
        (format!("config_tmcuart oid=0 rx_pin={SERIAL} pull_up=0 tx_pin={SERIAL} bit_time=1250"), SERIAL),
        (format!("config_hx71x oid=0 gain_channel=1 dout_pin={MISO} sclk_pin={MOSI}"), MISO),
    ] {
        let (text, log) = refusal(&object);
        assert!(matches!(text.as_deref(), Some("Not an input pin" | "Not an output pin")), "{text:?}");
        assert!(log.contains(&pin.to_string()), "{log}");
    }
}

/// The chip on the wire is heard only while the line is an input.
#[test]
fn a_plain_line_turns_round_in_a_message() {
    let converse = |mut rig: Rig| {
        rig.configure(&["config_tmcuart oid=0 rx_pin=10 pull_up=1 tx_pin=10 bit_time=1250"]);
        let reply = 100_000;
        rig.bench.script_input(10, &[(0, 1), (reply, 0), (reply + 9 * 1250, 1)]);
        rig.send("tmcuart_send oid=0 write=ea03 read=2");
        rig.run_until(10_000_000);
        (rig.responses(), rig.edges(10))
    };
    let (heard, sent) = converse(rig());
    assert_eq!(heard.len(), 1);
    assert_ne!(heard, ["tmcuart_response oid=0 read="]);
    assert_eq!((heard, sent), converse(Rig::new()));
}

#[test]
fn a_board_where_nothing_comes_or_goes_has_no_view() {
    let mut board = board(rig().bench);
    assert!(board.view().is_none() && !board.look_again());
}

#[test]
fn a_chip_knows_one_kind_of_bus() {
    let mut bytes = [0x0f; 2];
    SpiChip.send(&bytes).unwrap();
    SpiChip.exchange(&mut bytes).unwrap();
    assert_eq!(bytes, [0xf0; 2]);
    I2cChip.read_register(&[7], &mut bytes).unwrap();
    assert_eq!(bytes, [7; 2]);
    for (failure, words) in [
        (SpiChip.write_read(&[1], &mut bytes), "the host asked for an I2C transfer on an SPI device"),
        (SpiChip.read_register(&[1], &mut bytes), "the host asked for an I2C transfer on an SPI device"),
        (I2cChip.exchange(&mut [1]), "the host asked for an SPI transfer on an I2C device"),
        (I2cChip.send(&[1]), "the host asked for an SPI transfer on an I2C device"),
    ] {
        let failure = failure.unwrap_err();
        assert_eq!(failure.status, BusStatus::Nack);
        assert!(failure.trouble.to_string().contains(words), "{}", failure.trouble);
    }
}
