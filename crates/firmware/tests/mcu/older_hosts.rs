// SPDX-License-Identifier: GPL-3.0-or-later
//! Commands of the hosts before Klipper's master, and the answers to them. The dictionary of master no longer has these
//! forms. Kalico developed from v0.13 and also has many of them.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::BusStatus;
use pinion_firmware::mcu::DialectName::{self, Kalico, V0_11, V0_12, V0_13};

use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::Rig;

fn configured(dialect: DialectName, commands: &[&str]) -> Rig {
    let mut rig = Rig::of(dialect);
    rig.configure(commands);
    rig
}

// ---- analog inputs

#[test]
fn each_sum_of_readings_is_a_report() {
    for dialect in [V0_11, V0_12, V0_13, Kalico] {
        let mut rig = configured(dialect, &["config_analog_in oid=0 pin=400"]);
        rig.bench.script_adc(ANALOG, &[4095, 4095, 4095, 4094, 1, 2, 3, 4, 2000]);
        rig.send(
            "query_analog_in oid=0 clock=@5000 sample_ticks=1000 sample_count=4 rest_ticks=100000 min_value=0 \
             max_value=7999 range_check_count=2",
        );
        rig.run_until(8000);
        assert_eq!(rig.responses(), ["analog_in_state oid=0 next_clock=@105000 value=16379"], "{dialect}");
        rig.sends_until(108_000, &["analog_in_state oid=0 next_clock=@205000 value=10"]);
        // 8000 is out of range. The second value out of range in a row stops the MCU.
        rig.sends_until(307_999, &["analog_in_state oid=0 next_clock=@305000 value=8000"]);
        rig.run_until(308_000);
        assert_eq!(rig.shutdown().as_deref(), Some("ADC out of range"), "{dialect}");
    }
}

// ---- I2C

/// The commands that make oid 0 the chip at 0x48 of bus 1.
fn device(dialect: DialectName) -> &'static [&'static str] {
    match dialect {
        V0_11 => &["config_i2c oid=0 i2c_bus=1 rate=400000 address=72"],
        _ => &["config_i2c oid=0", "i2c_set_bus oid=0 i2c_bus=1 rate=400000 address=72"],
    }
}

type Heard = Arc<Mutex<Vec<(Vec<u8>, usize)>>>;

/// A chip that counts up from the first byte written to it. It answers with `status` once `after` transfers are
/// over.
fn plug_i2c(rig: &Rig, after: usize, status: Result<(), BusStatus>) -> Heard {
    let heard = Heard::default();
    let log = heard.clone();
    rig.bench.plug_i2c(1, 0x48, move |_, write, read| {
        let mut log = log.lock().unwrap();
        log.push((write.to_vec(), read.len()));
        let first = write.first().copied().unwrap_or(0xa0);
        read.iter_mut().zip(0..).for_each(|(byte, n)| *byte = first.wrapping_add(n));
        if log.len() > after { status } else { Ok(()) }
    });
    heard
}

#[test]
fn registers_are_written_and_read_without_a_status() {
    for dialect in [V0_11, V0_12, V0_13, Kalico] {
        let mut rig = configured(dialect, device(dialect));
        let heard = plug_i2c(&rig, 0, Ok(()));
        assert_eq!(rig.ask("i2c_write oid=0 data=1020"), "", "{dialect}");
        assert_eq!(rig.ask("i2c_read oid=0 reg=10 read_len=3"), "i2c_read_response oid=0 response=101112");
        assert_eq!(rig.ask("i2c_read oid=0 reg= read_len=2"), "i2c_read_response oid=0 response=a0a1");
        assert_eq!(*heard.lock().unwrap(), [(vec![0x10, 0x20], 0), (vec![0x10], 3), (vec![], 2)]);
        assert!(rig.dialect().command_id("i2c_transfer oid=%c write=%*s read_len=%u").is_none());
    }
}

#[test]
fn bits_of_registers_are_cleared_and_set() {
    for dialect in [V0_11, V0_12] {
        let mut rig = configured(dialect, device(dialect));
        let heard = plug_i2c(&rig, 0, Ok(()));
        // Two registers, which read 0x35 and 0x36: clear f0 and 02, set 80 and 01.
        assert_eq!(rig.ask("i2c_modify_bits oid=0 reg=35 clear_set_bits=f0028001"), "");
        let expected = [(vec![0x35], 2), (vec![0x35, 0x85, 0x35], 0)];
        assert_eq!(*heard.lock().unwrap(), expected);
        rig.stops_on("i2c_modify_bits oid=0 reg=35 clear_set_bits=f002ff", "i2c_modify_bits: Odd number of bits!");
        assert_eq!(heard.lock().unwrap().len(), 2);
    }
}

#[test]
fn a_chip_that_does_not_answer_stops_the_mcu_in_the_words_of_its_time() {
    use BusStatus::{Nack, StartNack, StartReadNack, Timeout};
    const WRITE: &str = "i2c_write oid=0 data=1020";
    const READ: &str = "i2c_read oid=0 reg=10 read_len=1";
    const MODIFY: &str = "i2c_modify_bits oid=0 reg=10 clear_set_bits=0101";
    for (dialect, command, status, text) in [
        (V0_11, WRITE, StartNack, "Unable write i2c device"),
        (V0_12, WRITE, Nack, "Unable write i2c device"),
        (V0_11, READ, StartReadNack, "Unable to read i2c device"),
        (V0_11, READ, StartNack, "Unable write i2c device"),
        (V0_11, "i2c_read oid=0 reg= read_len=1", StartNack, "Unable to read i2c device"),
        (V0_12, READ, Timeout, "Unable to read i2c device"),
        (V0_12, MODIFY, Nack, "Unable to read i2c device"),
        (V0_13, WRITE, Nack, "I2C NACK"),
        (V0_13, WRITE, StartNack, "I2C START NACK"),
        (V0_13, READ, StartReadNack, "I2C START READ NACK"),
        (Kalico, READ, Timeout, "I2C Timeout"),
    ] {
        let mut rig = configured(dialect, device(dialect));
        let heard = plug_i2c(&rig, 0, Err(status));
        rig.send(command);
        let responses = rig.responses();
        assert_eq!(responses.len(), 1, "no answer: {responses:?}");
        assert!(responses[0].ends_with(&format!("static_string_id={text}")), "{dialect} {command}: {responses:?}");
        // Only a transfer that writes nothing is retried.
        let tries = if command.contains("reg= ") { 3 } else { 1 };
        assert_eq!(heard.lock().unwrap().len(), tries);
        assert!(rig.notes().iter().any(|note| note.contains("I2C device oid 0")), "the log names the device");
    }
    // The transfer that writes back the changed bytes fails.
    let mut rig = configured(V0_12, device(V0_12));
    plug_i2c(&rig, 1, Err(Nack));
    rig.stops_on(MODIFY, "Unable write i2c device");
    // Without a bus.
    let mut rig = configured(V0_12, &["config_i2c oid=0"]);
    rig.stops_on("i2c_read oid=0 reg=10 read_len=1", "Unable to read i2c device");
}

#[test]
fn lines_are_an_i2c_bus_of_100_khz_whatever_the_rate() {
    for (dialect, text) in [(V0_12, "soft_i2c NACK"), (V0_13, "I2C START NACK")] {
        let mut rig = configured(
            dialect,
            &["config_i2c oid=0", "i2c_set_software_bus oid=0 scl_pin=50 sda_pin=51 rate=400000 address=72"],
        );
        rig.bench.script_input(50, &[(0, 1)]);
        rig.bench.script_input(51, &[(0, 1)]);
        rig.edges(50);
        rig.send("i2c_write oid=0 data=10");
        assert_eq!(rig.shutdown().as_deref(), Some(text), "nobody is there");
        let rises: Vec<u64> = rig.edges(50).into_iter().filter(|(_, level)| *level == 1).map(|(at, _)| at).collect();
        // The start, the nine bits of the address, the stop.
        assert_eq!(rises.len(), 11, "{rises:?}");
        assert!(rises[1..10].windows(2).all(|pair| pair[1] - pair[0] == 500), "{rises:?}");
    }
}

// ---- SPI on lines

#[test]
fn lines_are_an_spi_bus_of_the_rate() {
    for dialect in [V0_11, V0_12, V0_13] {
        let mut rig = configured(
            dialect,
            &[
                "config_spi oid=0 pin=40 cs_active_high=0",
                "spi_set_software_bus oid=0 miso_pin=30 mosi_pin=31 sclk_pin=32 mode=0 rate=500000",
                "config_spi oid=1 pin=41 cs_active_high=0",
                "spi_set_software_bus oid=1 miso_pin=30 mosi_pin=31 sclk_pin=32 mode=0 rate=0",
            ],
        );
        rig.bench.script_input(30, &[(0, 1)]);
        assert_eq!(rig.ask("spi_transfer oid=0 data=a5"), "spi_transfer_response oid=0 response=ff");
        let clock = rig.edges(32);
        assert_eq!(clock.len(), 16);
        assert!(clock.windows(2).all(|pair| pair[1].0 - pair[0].0 == 50), "{clock:?}");
        assert_eq!(rig.ask("spi_transfer oid=1 data=a5"), "spi_transfer_response oid=1 response=ff");
    }
}

// ---- accelerometers

/// An ADXL345 that measures one sample every 1000 ticks while it is on. A sample is its own number.
#[derive(Default)]
struct Adxl345 {
    on_since: Option<u64>,
    /// Samples made before it was switched off, and samples that were read.
    made: u64,
    read: u64,
    /// How many more times it reports nonsense about its FIFO.
    rubbish: usize,
    /// The bytes written to it, with their times.
    written: Vec<(u64, [u8; 2])>,
}

impl Adxl345 {
    fn exchange(&mut self, at: u64, bytes: &mut [u8]) {
        let made = self.made + self.on_since.map_or(0, |since| (at - since) / 1000);
        let entries = if self.rubbish > 0 { 0x7f } else { (made - self.read) as u8 };
        match *bytes {
            [0x2d, value] => {
                self.written.push((at, [0x2d, value]));
                self.made = made;
                self.on_since = (value == 0x08).then_some(at);
            }
            [0xf2, ..] => {
                bytes[1..].copy_from_slice(&[self.read as u8, 0, 0, 0, 0, 0, 0x90, entries]);
                self.read += u64::from(entries > 0);
            }
            [0xb9, _] => {
                bytes[1] = entries;
                self.rubbish = self.rubbish.saturating_sub(1);
            }
            _ => panic!("{bytes:02x?}"),
        }
    }
}

const ADXL345: &[&str] = &[
    "config_spi_without_cs oid=0",
    "config_adxl345 oid=1 spi_oid=0",
    "spi_set_bus oid=0 spi_bus=0 mode=3 rate=5000000",
];

/// The chip, behind a bus that needs this time for a transfer.
fn adxl345(dialect: DialectName, answer_ticks: u32) -> (Rig, Arc<Mutex<Adxl345>>) {
    let rig = configured(dialect, ADXL345);
    let chip = Arc::new(Mutex::new(Adxl345::default()));
    let plugged = chip.clone();
    rig.bench.plug_spi(0, move |at, bytes| plugged.lock().unwrap().exchange(at, bytes));
    rig.bench.state().answer_ticks = answer_ticks;
    (rig, chip)
}

/// The chip on a slow bus, measured since 5000.
fn measuring() -> (Rig, Arc<Mutex<Adxl345>>) {
    let (mut rig, chip) = adxl345(V0_12, 300);
    rig.send("query_adxl345 oid=1 clock=@5000 rest_ticks=2000");
    (rig, chip)
}

fn adxl345_data(sequence: u16, numbers: std::ops::Range<u8>) -> String {
    let data: String = numbers.map(|n| format!("{n:02x}00000000")).collect();
    format!("adxl345_data oid=1 sequence={sequence} data={data}")
}

#[test]
fn an_adxl345_is_switched_on_at_its_clock_and_off_with_all_its_samples_sent() {
    for dialect in [V0_11, V0_12] {
        let (mut rig, chip) = adxl345(dialect, 0);
        rig.send("query_adxl345 oid=1 clock=@5000 rest_ticks=4000");
        rig.run_until(4999);
        assert_eq!(chip.lock().unwrap().written, []);
        rig.run_until(17_500);
        assert_eq!(chip.lock().unwrap().written, [(5000, [0x2d, 0x08])]);
        // Ten samples of five bytes. Two more were there at the last read, at 17000.
        assert_eq!(rig.responses(), [adxl345_data(0, 0..10)], "{dialect}");
        let status = "adxl345_status oid=1 clock=@17500 query_ticks=0 next_sequence=1 buffered=10 fifo=0 limit_count=0";
        assert_eq!(rig.ask("query_adxl345_status oid=1"), status);
        rig.run_until(20_000);
        rig.send("query_adxl345 oid=1 clock=0 rest_ticks=0");
        assert_eq!(chip.lock().unwrap().written[1..], [(20_000, [0x2d, 0x00])]);
        let status = "adxl345_status oid=1 clock=@20000 query_ticks=0 next_sequence=2 buffered=0 fifo=0 limit_count=0";
        assert_eq!(rig.responses(), [adxl345_data(1, 10..15), status.to_owned()], "{dialect}");
        rig.run_until(100_000);
        assert_eq!(rig.responses(), [""; 0], "it has ended");
        // The same once more, from the beginning.
        rig.send("query_adxl345 oid=1 clock=@110000 rest_ticks=4000");
        rig.run_until(122_500);
        assert_eq!(rig.responses(), [adxl345_data(0, 15..25)]);
    }
}

#[test]
fn an_adxl345_that_is_read_as_it_is_to_end_loses_no_sample() {
    let (mut rig, chip) = adxl345(V0_12, 700);
    rig.send("query_adxl345 oid=1 clock=@5000 rest_ticks=4000");
    // It is switched on from 5000 to 5700. The reading of 9700 is under way.
    rig.run_until(9800);
    rig.send("query_adxl345 oid=1 clock=0 rest_ticks=0");
    let responses = rig.responses();
    let made = chip.lock().unwrap().made as u8;
    assert!(made >= 4, "{made}");
    assert_eq!(responses[0], adxl345_data(0, 0..made));
    assert!(responses[1].starts_with("adxl345_status oid=1 clock=@") && responses.len() == 2, "{responses:?}");
    assert!(responses[1].contains(" query_ticks=700 next_sequence=1 buffered=0 fifo=0 "), "{responses:?}");
}

#[test]
fn an_adxl345_that_makes_no_sense_is_reported_so_and_ends() {
    let (mut rig, chip) = adxl345(V0_12, 0);
    rig.send("query_adxl345 oid=1 clock=@5000 rest_ticks=4000");
    rig.run_until(6000);
    chip.lock().unwrap().rubbish = usize::MAX;
    // klippy asks again if there are more than 32.
    let status = rig.ask("query_adxl345_status oid=1");
    assert!(status.contains(" fifo=127 "), "{status}");
    let status = rig.ask("query_adxl345 oid=1 clock=0 rest_ticks=0");
    assert!(status.starts_with("adxl345_status ") && status.contains(" fifo=127 "), "{status}");
    rig.sends_until(100_000, &[]);
}

#[test]
fn an_adxl345_that_makes_no_sense_once_at_its_end_sends_all_its_samples() {
    for samples in [3, 0] {
        let (mut rig, chip) = adxl345(V0_12, 0);
        rig.send("query_adxl345 oid=1 clock=@5000 rest_ticks=40000");
        let end = 5000 + u64::from(samples) * 1000;
        rig.run_until(end);
        chip.lock().unwrap().rubbish = 1;
        rig.send("query_adxl345 oid=1 clock=0 rest_ticks=0");
        let mut responses = rig.responses();
        let sequence = u8::from(samples > 0);
        let status = format!("adxl345_status oid=1 clock=@{end} query_ticks=0 next_sequence={sequence} ");
        assert_eq!(responses.pop().unwrap(), status + "buffered=0 fifo=0 limit_count=0");
        let data = (samples > 0).then(|| adxl345_data(0, 0..samples));
        assert_eq!(responses, Vec::from_iter(data), "no sample is lost, and none made up");
    }
}

#[test]
fn a_lis2dw_on_spi_sends_messages_of_eight_samples() {
    let mut rig = configured(
        V0_12,
        &[
            "config_spi_without_cs oid=0",
            "config_lis2dw oid=1 spi_oid=0",
            "spi_set_bus oid=0 spi_bus=0 mode=3 rate=5000000",
        ],
    );
    let heard: Arc<Mutex<Vec<[u8; 2]>>> = Arc::default();
    let written = heard.clone();
    rig.bench.plug_spi(0, move |_, bytes| match *bytes {
        [0x2e, value] => written.lock().unwrap().push([0x2e, value]),
        [0xaf, _] => bytes[1] = 9,
        [0xa8, ..] => bytes[1..].fill(0x11),
        _ => panic!("{bytes:02x?}"),
    });
    rig.send("query_lis2dw oid=1 clock=@5000 rest_ticks=4000");
    rig.run_until(9000);
    let data = "11".repeat(48);
    assert_eq!(rig.responses(), [format!("lis2dw_data oid=1 sequence=0 data={data}")]);
    let status = "lis2dw_status oid=1 clock=@9000 query_ticks=0 next_sequence=1 buffered=0 fifo=9 limit_count=0";
    assert_eq!(rig.ask("query_lis2dw_status oid=1"), status);
    assert_eq!(rig.ask("query_lis2dw oid=1 clock=0 rest_ticks=0"), status);
    assert_eq!(*heard.lock().unwrap(), [[0x2e, 0xc0], [0x2e, 0x00]]);
    rig.sends_until(100_000, &[]);
}

fn mpu9250(dialect: DialectName) -> Vec<&'static str> {
    [device(dialect), &["config_mpu9250 oid=1 i2c_oid=0"]].concat()
}

#[test]
fn an_mpu9250_has_its_fifo_emptied_at_the_beginning_and_reports_overflows() {
    for dialect in [V0_11, V0_12] {
        let mut rig = Rig::of(dialect);
        let written: Heard = Arc::default();
        let log = written.clone();
        rig.bench.plug_i2c(1, 0x48, move |_, write, read| {
            match *write {
                [0x3a] => read[0] = 0x10,
                [0x72] => read.copy_from_slice(&[0, 51]),
                [0x74] => read.fill(0x22),
                _ => log.lock().unwrap().push((write.to_vec(), read.len())),
            }
            Ok(())
        });
        rig.configure(&mpu9250(dialect));
        rig.send("query_mpu9250 oid=1 clock=@5000 rest_ticks=4000");
        rig.run_until(9000);
        let on = [vec![0x23, 0], vec![0x6a, 0x04], vec![0x6a, 0x40], vec![0x23, 0x08]];
        assert_eq!(*written.lock().unwrap(), on.map(|bytes| (bytes, 0)));
        assert_eq!(rig.responses(), [format!("mpu9250_data oid=1 sequence=0 data={}", "22".repeat(48))]);
        let status = rig.ask("query_mpu9250 oid=1 clock=0 rest_ticks=0");
        let expected = "mpu9250_status oid=1 clock=@9000 query_ticks=0 next_sequence=1 buffered=0 fifo=8 limit_count=1";
        assert_eq!(status, expected, "{dialect}");
        assert_eq!(written.lock().unwrap().last(), Some(&(vec![0x23, 0], 0)));
    }
}

/// Klipper's C asks the chip how much its FIFO has, but reports the value from the last reading. klippy dates samples
/// by this count. So here the status has the current count.
#[test]
fn a_status_of_an_mpu9250_counts_the_samples_of_its_instant() {
    const PERIOD: u64 = 12_500;
    for dialect in [V0_11, V0_12] {
        let mut rig = Rig::of(dialect);
        rig.bench.state().byte_ticks = 1125;
        let taken: Arc<Mutex<u64>> = Arc::default();
        let began: Arc<Mutex<u64>> = Arc::default();
        let (reads, switched) = (taken.clone(), began.clone());
        rig.bench.plug_i2c(1, 0x48, move |at, write, read| {
            let mut reads = reads.lock().unwrap();
            match *write {
                [0x72] => {
                    let samples = at / PERIOD - *switched.lock().unwrap() / PERIOD - *reads;
                    read.copy_from_slice(&(6 * samples as u16).to_be_bytes());
                }
                [0x74] => *reads += 8,
                [0x23, 8] => *switched.lock().unwrap() = at,
                _ => {}
            }
            Ok(())
        });
        rig.configure(&mpu9250(dialect));
        rig.send(&format!("query_mpu9250 oid=1 clock=@5000 rest_ticks={}", 4 * PERIOD));
        let number = |status: &str, name: &str| {
            let value = status.split_once(&format!(" {name}=")).unwrap().1.split(' ').next().unwrap();
            value.trim_start_matches('@').parse::<u64>().unwrap()
        };
        for at in (100_000..3_000_000).step_by(77_777) {
            rig.run_until(at);
            let status = rig.ask("query_mpu9250_status oid=1");
            assert_eq!(number(&status, "buffered"), 0);
            let reported = 8 * number(&status, "next_sequence") + number(&status, "fifo");
            let made = number(&status, "clock") / PERIOD - *began.lock().unwrap() / PERIOD;
            assert_eq!(reported, made, "{status}");
        }
        assert!(*taken.lock().unwrap() > 100);
    }
}

#[test]
fn a_sensor_whose_bus_fails_stops_the_mcu_in_the_words_of_its_time() {
    for (dialect, query, text) in [
        (V0_11, "query_mpu9250 oid=1 clock=@5000 rest_ticks=4000", "Unable to read i2c device"),
        (V0_12, "query_mpu9250 oid=1 clock=@5000 rest_ticks=4000", "Unable to read i2c device"),
        (V0_13, "query_mpu9250 oid=1 rest_ticks=4000", "I2C NACK"),
    ] {
        let mut rig = configured(dialect, &mpu9250(dialect));
        plug_i2c(&rig, 0, Err(BusStatus::Nack));
        rig.send(query);
        rig.run_until(20_000);
        assert_eq!(rig.shutdown().as_deref(), Some(text), "{dialect}");
    }
}

/// A host goes, comes back and starts a new measurement, at any time of a measurement.
#[test]
fn a_measurement_may_be_ended_and_begun_at_any_instant() {
    for stop_at in (4000..14_000).step_by(50) {
        let (mut rig, _) = measuring();
        rig.run_until(stop_at);
        rig.responses();
        rig.send("query_adxl345 oid=1 clock=0 rest_ticks=0");
        rig.run_until(stop_at + 50_000);
        let responses = rig.responses();
        assert!(responses.last().is_some_and(|last| last.starts_with("adxl345_status ")), "{stop_at}: {responses:?}");
        rig.send("query_adxl345 oid=1 clock=@100000 rest_ticks=2000");
        rig.run_until(130_000);
        let responses = rig.responses();
        assert!(
            responses.first().is_some_and(|first| first.starts_with("adxl345_data oid=1 sequence=0 ")),
            "{stop_at}"
        );
        assert!(!rig.mcu.is_shutdown());
    }
}

/// A query during the one before: the sensor is switched on at the later query's clock, and only one timer reads it.
#[test]
fn a_measurement_that_is_asked_for_anew_begins_at_its_own_clock() {
    for again_at in (4900..6000).step_by(50) {
        let (mut rig, chip) = measuring();
        rig.run_until(again_at);
        rig.begin("query_adxl345 oid=1 clock=@20000 rest_ticks=2000");
        rig.run_until(19_000);
        let (transfers, written) = (rig.bench.transfers().len(), chip.lock().unwrap().written.len());
        rig.run_until(20_299);
        assert_eq!(rig.bench.transfers().len(), transfers, "{again_at}");
        rig.run_until(40_000);
        assert_eq!(chip.lock().unwrap().written[written..], [(20_300, [0x2d, 0x08])], "{again_at}");
        assert!(!rig.mcu.is_shutdown());
    }
}

/// The sensor is then on, however soon after its end.
#[test]
fn a_measurement_may_begin_amid_the_end_of_another() {
    let (mut rig, chip) = measuring();
    rig.run_until(20_000);
    rig.begin("query_adxl345 oid=1 clock=0 rest_ticks=0");
    rig.begin("query_adxl345 oid=1 clock=@20100 rest_ticks=2000");
    rig.run_until(40_000);
    let written: Vec<u8> = chip.lock().unwrap().written.iter().map(|(_, [_, value])| *value).collect();
    assert_eq!(written, [0x08, 0x00, 0x08]);
    assert!(!rig.responses().is_empty());
}

#[test]
fn an_mcu_that_stops_amid_a_measurement_measures_no_more() {
    for stop_at in (4900..9000).step_by(100) {
        let (mut rig, _) = measuring();
        rig.run_until(stop_at);
        rig.send("emergency_stop");
        rig.run_until(stop_at + 1000);
        let transfers = rig.bench.transfers().len();
        rig.run_until(200_000);
        assert_eq!(rig.bench.transfers().len(), transfers, "{stop_at}");
    }
}

// ---- angle sensors

#[test]
fn an_angle_sensor_sends_sixteen_entries_a_message_and_its_end() {
    for dialect in [V0_11, V0_12] {
        let mut rig = configured(
            dialect,
            &[
                "config_spi oid=0 pin=40 cs_active_high=0",
                "config_spi_angle oid=1 spi_oid=0 spi_angle_type=0",
                "spi_set_bus oid=0 spi_bus=0 mode=3 rate=10000000",
            ],
        );
        rig.bench.plug_spi(0, |_, bytes| bytes.copy_from_slice(&[0x40, 0x00]));
        rig.send("query_spi_angle oid=1 clock=@1000 rest_ticks=20000 time_shift=2");
        rig.run_until(1000 + 18 * 20_000);
        let data =
            |sequence, entries| format!("spi_angle_data oid=1 sequence={sequence} data={}", "000080".repeat(entries));
        assert_eq!(rig.responses(), [data(0, 16)]);
        rig.send("query_spi_angle oid=1 clock=0 rest_ticks=0 time_shift=0");
        assert_eq!(rig.responses(), [data(1, 3), "spi_angle_end oid=1 sequence=2".into()], "{dialect}");
        let types = rig.dictionary().enumerations["spi_angle_type"].as_object().unwrap();
        assert_eq!(types.keys().collect::<Vec<_>>(), ["a1333", "as5047d", "tle5012b"]);
    }
}

// ---- the eddy current probe

/// An LDC1612 that always has a sample, with the value that the mutex holds, or fails. It homes from 50000 on.
fn ldc1612(dialect: DialectName) -> (Rig, Arc<Mutex<Result<u32, BusStatus>>>) {
    let mut rig = configured(
        dialect,
        &[
            "config_i2c oid=0",
            "i2c_set_bus oid=0 i2c_bus=1 rate=400000 address=72",
            "config_ldc1612 oid=1 i2c_oid=0",
            "config_trsync oid=2",
        ],
    );
    let value = Arc::new(Mutex::new(Ok(1000)));
    let plugged = value.clone();
    rig.bench.plug_i2c(1, 0x48, move |_, write, read| {
        let value = (*plugged.lock().unwrap())?;
        let word = match write {
            [0x00] => value >> 16,
            [0x01] => value & 0xffff,
            [0x18] => 1 << 3,
            _ => panic!("{write:02x?}"),
        };
        read.copy_from_slice(&(word as u16).to_be_bytes());
        Ok(())
    });
    rig.send_all(&[
        "trsync_start oid=2 report_clock=@0 report_ticks=0 expire_reason=2",
        "ldc1612_setup_home oid=1 clock=@50000 threshold=2000 trsync_oid=2 trigger_reason=1 error_reason=3",
        "query_ldc1612 oid=1 rest_ticks=10000",
    ]);
    (rig, value)
}

#[test]
fn an_eddy_current_probe_triggers_above_its_threshold() {
    for dialect in [V0_13, Kalico] {
        let (mut rig, value) = ldc1612(dialect);
        // A value above the threshold does not count before homing begins.
        *value.lock().unwrap() = Ok(2001);
        rig.run_until(45_000);
        *value.lock().unwrap() = Ok(2000);
        rig.run_until(75_000);
        assert_eq!(rig.ask("query_ldc1612_home_state oid=1"), "ldc1612_home_state oid=1 homing=1 trigger_clock=@50000");
        *value.lock().unwrap() = Ok(2001);
        rig.run_until(95_000);
        let responses = rig.responses();
        let trigger = "trsync_state oid=2 can_trigger=0 trigger_reason=1 clock=@80000";
        assert!(responses.iter().any(|response| response == trigger), "{dialect}: {responses:?}");
        assert_eq!(rig.ask("query_ldc1612_home_state oid=1"), "ldc1612_home_state oid=1 homing=0 trigger_clock=@80000");
    }
}

#[test]
fn an_eddy_current_probe_that_reports_an_error_ends_the_homing_and_one_that_is_silent_the_mcu() {
    for dialect in [V0_13, Kalico] {
        let (mut rig, value) = ldc1612(dialect);
        // An error counts even before homing begins.
        *value.lock().unwrap() = Ok(0x1000_0000);
        rig.run_until(15_000);
        let state = rig.responses().pop().unwrap();
        assert!(state.starts_with("trsync_state oid=2 can_trigger=0 trigger_reason=3 "), "{dialect}: {state}");
        assert_eq!(rig.ask("query_ldc1612_home_state oid=1"), "ldc1612_home_state oid=1 homing=0 trigger_clock=@50000");
        // Master reports this as INVALID_READ_DATA. Here it is an ordinary sample.
        *value.lock().unwrap() = Ok(0xffff_1234);
        rig.run_until(125_000);
        let data = rig.responses().pop().unwrap();
        assert!(data.ends_with("ffff1234"), "{data}");
        *value.lock().unwrap() = Err(BusStatus::StartNack);
        rig.run_until(135_000);
        assert_eq!(rig.shutdown().as_deref(), Some("I2C START NACK"), "{dialect}");
    }
}

#[test]
fn a_probe_that_is_no_longer_to_home_pulls_nothing() {
    let (mut rig, value) = ldc1612(V0_13);
    rig.send("ldc1612_setup_home oid=1 clock=0 threshold=0 trsync_oid=0 trigger_reason=0 error_reason=0");
    *value.lock().unwrap() = Ok(0x1000_0000);
    rig.run_until(95_000);
    assert!(rig.responses().iter().all(|response| !response.starts_with("trsync_state")));
}
