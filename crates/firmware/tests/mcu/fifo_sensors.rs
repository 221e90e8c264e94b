// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometers with a FIFO that is read in blocks (LIS2DW, LIS3DH, MPU9250, ICM20948, BMI160), on SPI and on
//! I2C. The ADXL345's tests cover the rest.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::BusStatus;

use pinion_testbench::board::SPI_CHIPS;
use pinion_testbench::rig::Rig;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Model {
    Lis2dw,
    Lis3dh,
    Mpu9250,
    Icm20948,
    Bmi160,
}

use Model::{Bmi160, Icm20948, Lis2dw, Lis3dh, Mpu9250};

/// A sensor on a bus.
#[derive(Clone, Copy, Debug)]
struct Setup {
    model: Model,
    spi: bool,
}

const SETUPS: [Setup; 8] = [
    Setup { model: Lis2dw, spi: true },
    Setup { model: Lis2dw, spi: false },
    Setup { model: Lis3dh, spi: true },
    Setup { model: Lis3dh, spi: false },
    Setup { model: Mpu9250, spi: false },
    Setup { model: Icm20948, spi: false },
    Setup { model: Bmi160, spi: true },
    Setup { model: Bmi160, spi: false },
];

const ADDRESS: u8 = 0x19;

impl Setup {
    /// The name in the commands.
    fn name(self) -> &'static str {
        match self.model {
            Lis2dw | Lis3dh => "lis2dw",
            Mpu9250 => "mpu9250",
            Icm20948 => "icm20948",
            Bmi160 => "bmi160",
        }
    }

    fn config(self) -> Vec<&'static str> {
        let bus: &[&str] = match self.spi {
            true => &["config_spi_without_cs oid=0", "spi_set_bus oid=0 spi_bus=0 mode=3 rate=5000000"],
            false => &["config_i2c oid=0", "i2c_set_bus oid=0 i2c_bus=1 rate=400000 address=25"],
        };
        let sensor = match (self.model, self.spi) {
            (Lis2dw, true) => "config_lis2dw oid=1 bus_oid=0 bus_oid_type=0 lis_chip_type=0",
            (Lis2dw, false) => "config_lis2dw oid=1 bus_oid=0 bus_oid_type=1 lis_chip_type=0",
            (Lis3dh, true) => "config_lis2dw oid=1 bus_oid=0 bus_oid_type=0 lis_chip_type=1",
            (Lis3dh, false) => "config_lis2dw oid=1 bus_oid=0 bus_oid_type=1 lis_chip_type=1",
            (Mpu9250, _) => "config_mpu9250 oid=1 i2c_oid=0",
            (Icm20948, _) => "config_icm20948 oid=1 i2c_oid=0",
            (Bmi160, true) => "config_bmi160 oid=1 bus_oid=0 bus_oid_type=0",
            (Bmi160, false) => "config_bmi160 oid=1 bus_oid=0 bus_oid_type=1",
        };
        // klippy configures the sensor first and its bus afterwards.
        vec![bus[0], sensor, bus[1]]
    }

    /// Ticks per sample at the rate that klippy sets.
    fn period(self) -> u64 {
        50_000_000
            / match self.model {
                Lis2dw | Bmi160 => 1600,
                Lis3dh => 1344,
                Mpu9250 => 4000,
                Icm20948 => 4500,
            }
    }

    /// Number of samples that the FIFO holds.
    fn depth(self) -> u64 {
        match self.model {
            Lis2dw | Lis3dh => 32,
            Mpu9250 | Icm20948 => 512 / 6,
            Bmi160 => 1024 / 6,
        }
    }

    fn query(self, rest_ticks: u64) -> String {
        format!("query_{} oid=1 rest_ticks={rest_ticks}", self.name())
    }

    fn status(self) -> String {
        format!("query_{}_status oid=1", self.name())
    }

    fn plug(self, rig: &Rig, period: u64) -> Arc<Mutex<Chip>> {
        let chip = Chip { setup: self, period, taken: 0, dropped: 0, overflowed: false, fails: None, rubbish: None };
        let chip = Arc::new(Mutex::new(chip));
        let plugged = chip.clone();
        if self.spi {
            rig.bench.plug_spi(0, move |at, bytes| {
                let (register, read) = bytes.split_first_mut().unwrap();
                assert!(*register & 0x80 != 0, "a write");
                plugged.lock().unwrap().read(at, *register, read);
            });
        } else {
            rig.bench.plug_i2c(1, ADDRESS, move |at, write, read| {
                let mut chip = plugged.lock().unwrap();
                let [register] = write else { panic!("{write:02x?}") };
                chip.read(at, *register, read);
                chip.fails.map_or(Ok(()), Err)
            });
        }
        chip
    }
}

/// A chip that measures from tick 0 on. The value of each sample is its number in six bytes, high bytes first.
struct Chip {
    setup: Setup,
    period: u64,
    /// Samples that were read, and samples that the full FIFO dropped.
    taken: u64,
    dropped: u64,
    overflowed: bool,
    fails: Option<BusStatus>,
    rubbish: Option<u8>,
}

impl Chip {
    fn read(&mut self, at: u64, register: u8, into: &mut [u8]) {
        if let Some(rubbish) = self.rubbish {
            into.fill(rubbish);
            return;
        }
        let made = at / self.period - self.taken - self.dropped;
        let lost = made.saturating_sub(self.setup.depth());
        self.dropped += lost;
        let kept = made - lost;
        self.overflowed |= lost > 0;
        let Setup { model, spi } = self.setup;
        match (model, spi, register) {
            (Lis2dw, true, 0xaf) | (Lis2dw, false, 0x2f) => {
                into[0] = kept as u8 | u8::from(std::mem::take(&mut self.overflowed)) << 6;
            }
            (Lis3dh, true, 0xaf) | (Lis3dh, false, 0x2f) => {
                let empty = u8::from(kept == 0) << 5;
                into[0] = kept.min(31) as u8 | empty | u8::from(std::mem::take(&mut self.overflowed)) << 6;
            }
            (Mpu9250, _, 0x72) | (Icm20948, _, 0x70) => into.copy_from_slice(&(6 * kept as u16).to_be_bytes()),
            (Mpu9250, _, 0x3a) => into[0] = u8::from(std::mem::take(&mut self.overflowed)) << 4,
            (Icm20948, _, 0x1b) => into[0] = u8::from(std::mem::take(&mut self.overflowed)),
            (Bmi160, true, 0xa2) | (Bmi160, false, 0x22) => into.copy_from_slice(&(6 * kept as u16).to_le_bytes()),
            // The data. The LIS3DH needs a bit to advance to the next register, and I2C has another bit than SPI.
            (Lis2dw, true, 0xa8)
            | (Lis2dw, false, 0x28)
            | (Lis3dh, true, 0xe8)
            | (Lis3dh, false, 0xa8)
            | (Mpu9250, _, 0x74)
            | (Icm20948, _, 0x72)
            | (Bmi160, true, 0xa4)
            | (Bmi160, false, 0x24) => {
                assert_eq!(into.len(), 48);
                assert!(kept >= 8, "read beyond the FIFO's end");
                for (n, sample) in into.chunks_mut(6).enumerate() {
                    sample.copy_from_slice(&(self.taken + self.dropped + n as u64).to_be_bytes()[2..]);
                }
                self.taken += 8;
            }
            _ => panic!("register {register:#x} of {:?}", self.setup),
        }
    }
}

fn field<'a>(response: &'a str, name: &str) -> &'a str {
    let mut words = response.split(' ').filter_map(|word| word.split_once('='));
    words.find(|(key, _)| *key == name).unwrap_or_else(|| panic!("{response}")).1
}

fn number(response: &str, name: &str) -> u64 {
    field(response, name).trim_start_matches('@').parse().unwrap()
}

#[test]
fn at_full_rate_no_sample_is_lost_and_a_status_counts_those_of_its_instant() {
    for setup in SETUPS {
        let mut rig = Rig::new();
        // 10 us per byte on SPI, 400 kHz on I2C.
        rig.bench.state().byte_ticks = if setup.spi { 500 } else { 1125 };
        rig.configure(&setup.config());
        let period = setup.period();
        let chip = setup.plug(&rig, period);
        rig.send(&setup.query(4 * period));
        let (mut messages, mut next) = (0, 0u64);
        for n in 1..=200u64 {
            rig.run_until(n * 510_000 + n * 7_919 % 100_000);
            rig.send(&setup.status());
            for response in rig.responses() {
                if response.starts_with("sensor_bulk_data") {
                    let samples: String = (next..next + 8).map(|n| format!("{n:012x}")).collect();
                    assert_eq!(response, format!("sensor_bulk_data oid=1 sequence={messages} data={samples}"));
                    messages += 1;
                    next += 8;
                    continue;
                }
                let samples = number(&response, "next_sequence") * 8 + number(&response, "buffered") / 6;
                assert_eq!(samples, number(&response, "clock") / period, "{setup:?}: {response}");
                assert_eq!(number(&response, "possible_overflows"), 0);
                let bytes = match (setup.spi, setup.model) {
                    (true, Bmi160) => 3,
                    (true, _) => 2,
                    (false, Lis2dw | Lis3dh) => 4,
                    (false, _) => 5,
                };
                let byte_ticks = rig.bench.state().byte_ticks;
                assert_eq!(number(&response, "query_ticks"), bytes * u64::from(byte_ticks), "{setup:?}");
            }
        }
        assert!(next > 2 * 50_000_000 / period - 40, "{setup:?}: {next}");
        assert_eq!(chip.lock().unwrap().dropped, 0);
    }
}

#[test]
fn samples_that_the_chip_drops_are_reported() {
    for setup in SETUPS {
        // The BMI160's count just stays at its maximum.
        if setup.model == Bmi160 {
            continue;
        }
        let mut rig = Rig::configured(&setup.config());
        setup.plug(&rig, 100);
        rig.send(&setup.query(100 * (setup.depth() + 1)));
        rig.run_until(100 * (setup.depth() + 2));
        let status = rig.ask(&setup.status());
        assert_eq!(field(&status, "possible_overflows"), "1", "{setup:?}: {status}");
        rig.send(&setup.query(0));
        rig.send(&setup.query(1_000_000));
        let status = rig.ask(&setup.status());
        assert_eq!(field(&status, "possible_overflows"), "0", "{setup:?}: {status}");
    }
}

#[test]
fn nothing_is_read_until_there_is_a_block_and_all_blocks_at_once() {
    for setup in SETUPS {
        let mut rig = Rig::configured(&setup.config());
        let chip = setup.plug(&rig, 1000);
        rig.send(&setup.query(7_500));
        rig.sends_until(7_500, &[]);
        rig.run_until(15_000);
        assert_eq!(rig.responses().len(), 1);
        rig.run_until(22_500);
        assert_eq!(rig.responses().len(), 1);
        rig.stall_until(49_000);
        rig.run_until(49_000);
        // 33 samples wait. The LIS3DH can report only 31.
        assert_eq!(rig.responses().len(), if setup.model == Lis3dh { 3 } else { 4 }, "{setup:?}");
        assert!(chip.lock().unwrap().taken % 8 == 0);
    }
}

#[test]
fn a_new_query_asks_the_chip_anew() {
    for setup in SETUPS {
        // During a reading, and between two readings.
        for answer_ticks in [0, 400] {
            let mut rig = Rig::with_workers(answer_ticks, &setup.config());
            let chip = setup.plug(&rig, 100);
            rig.send(&setup.query(2900));
            rig.run_until(3100);
            rig.send(&setup.query(0));
            // klippy empties the FIFO here.
            rig.run_until(5000);
            {
                let mut chip = chip.lock().unwrap();
                chip.taken = 50 - chip.dropped;
            }
            rig.forget_responses();
            rig.send(&setup.query(100));
            rig.run_until(5500);
            assert_eq!(rig.responses(), [""; 0], "{setup:?}");
            rig.run_until(7000);
            assert!(rig.responses()[0].starts_with("sensor_bulk_data oid=1 sequence=0 data=000000000032"), "{setup:?}");
        }
    }
}

#[test]
fn an_i2c_failure_stops_the_mcu_with_the_firmware_s_text() {
    for setup in SETUPS.iter().filter(|setup| !setup.spi) {
        for (status, text) in [
            (Some(BusStatus::Nack), "I2C NACK"),
            (Some(BusStatus::Timeout), "I2C Timeout"),
            (Some(BusStatus::StartNack), "I2C START NACK"),
            (Some(BusStatus::StartReadNack), "I2C START READ NACK"),
            // The chip is unplugged.
            (None, "I2C START NACK"),
        ] {
            for by_status in [false, true] {
                let mut rig = Rig::configured(&setup.config());
                let chip = setup.plug(&rig, 100);
                rig.send(&setup.query(1000));
                rig.run_until(500);
                chip.lock().unwrap().fails = status;
                if status.is_none() {
                    rig.bench.unplug_i2c(1, ADDRESS);
                }
                if by_status {
                    rig.send(&setup.status());
                } else {
                    rig.run_until(1000);
                }
                assert_eq!(rig.shutdown().as_deref(), Some(text), "{setup:?}");
                let notes = rig.notes();
                assert!(notes.iter().any(|note| note.contains(" oid 1: ")), "{notes:?}");
                rig.sends_until(10_000, &[]);

                rig.send("config_reset");
                rig.configure(&setup.config());
                setup.plug(&rig, 1000);
                rig.send(&setup.query(1000));
                rig.run_until(20_000);
                assert!(rig.responses()[0].starts_with("sensor_bulk_data oid=1 sequence=0"));
            }
        }
    }
}

#[test]
fn an_spi_failure_stops_the_mcu() {
    for setup in SETUPS.iter().filter(|setup| setup.spi) {
        let mut rig = Rig::configured(&setup.config());
        setup.plug(&rig, 100);
        rig.bench.state().broken.insert(SPI_CHIPS);
        rig.send(&setup.query(1000));
        rig.run_until(1000);
        assert_eq!(rig.shutdown().as_deref(), Some("Unable to issue spi ioctl"), "{setup:?}");
    }
}

#[test]
fn rubbish_keeps_the_mcu_from_nothing() {
    for setup in SETUPS {
        for rubbish in [0x00, 0xff] {
            let mut rig = Rig::new();
            rig.bench.state().byte_ticks = 50;
            let stepper = "config_stepper oid=2 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0";
            rig.configure(&[&setup.config()[..], &[stepper]].concat());
            setup.plug(&rig, 100).lock().unwrap().rubbish = Some(rubbish);
            rig.send(&setup.query(10_000));
            rig.send_all(&["reset_step_clock oid=2 clock=@0", "queue_step oid=2 interval=1000 count=1000 add=0"]);
            rig.run_until(1_000_000);
            assert_eq!(rig.ask("get_clock"), "clock clock=@1000000");
            let edges = rig.edges(1);
            assert!(edges.len() == 1000 && edges.iter().zip(1..).all(|((at, _), n)| *at == 1000 * n));
            let status = rig.ask(&setup.status());
            assert_eq!(field(&status, "possible_overflows") != "0", rubbish != 0, "{setup:?}: {status}");
        }
    }
}

/// 63 samples. Klipper's C counts their bytes in a `u8`.
#[test]
fn a_lis2dw_that_does_not_answer_takes_the_bus_for_two_blocks() {
    for setup in SETUPS.iter().filter(|setup| setup.model == Lis2dw) {
        let mut rig = Rig::configured(&setup.config());
        setup.plug(&rig, 100).lock().unwrap().rubbish = Some(0xff);
        rig.send(&setup.query(10_000));
        rig.run_until(10_000);
        assert_eq!(rig.responses().len(), 2, "{setup:?}");
        assert_eq!(field(&rig.ask(&setup.status()), "buffered"), "122");
    }
}

#[test]
fn what_a_sensor_can_not_be_is_refused() {
    for (command, text) in [
        ("config_lis2dw oid=1 bus_oid=0 bus_oid_type=2 lis_chip_type=0", "bus_type invalid"),
        ("config_lis2dw oid=1 bus_oid=0 bus_oid_type=0 lis_chip_type=2", "model type invalid"),
        ("config_bmi160 oid=1 bus_oid=0 bus_oid_type=255", "bus_type invalid"),
        ("config_bmi160 oid=1 bus_oid=9 bus_oid_type=0", "Invalid oid type"),
        ("config_bmi160 oid=1 bus_oid=0 bus_oid_type=1", "Invalid oid type"),
        ("config_icm20948 oid=1 i2c_oid=0", "Invalid oid type"),
    ] {
        Rig::new().refuses(&["config_spi_without_cs oid=0", command], text);
    }
    let mut rig = Rig::configured(&SETUPS[0].config());
    rig.stops_on("query_bmi160 oid=1 rest_ticks=1000", "Invalid oid type");
}

#[test]
fn the_dictionary_has_the_firmware_s_numbers() {
    let rig = Rig::new();
    let enumerations = &rig.dictionary().enumerations;
    assert_eq!(enumerations["bus_oid_type"], serde_json::json!({"spi": 0, "i2c": 1}));
    assert_eq!(enumerations["lis_chip_type"], serde_json::json!({"LIS2DW": 0, "LIS3DH": 1}));
    let angles = serde_json::json!({"a1333": 0, "as5047d": 1, "tle5012b": 2, "mt6816": 3, "mt6826s": 4});
    assert_eq!(enumerations["spi_angle_type"], angles);
}
