// SPDX-License-Identifier: GPL-3.0-or-later
//! Thermometers and hygrometers on I2C, after their data sheets: Bosch BME280 (rev. 1.23, "Compensation formulas"), TE
//! HTU21D ("Communication protocol", "CRC checksum"), Sensirion SHT3x, Aosong AHT10, TI LM75A.
//!
//! Simulated: identification, calibration values, measurements with their checksums, and the status. A measurement is
//! ready at once. Not simulated: heaters, alarms, oversampling and filters, a BME280's sleep. The humidity and the pressure
//! of the air never change.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::Trouble;
use crate::description::printer::Printer;
use crate::engine::crc;
use crate::engine::i2c::I2cChip;
use crate::engine::physics::Heater;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::TimeSource;

/// Relative humidity of the air.
const HUMIDITY: f64 = 0.45;

/// A chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum I2cSensorChip {
    /// Also measures pressure.
    Bme280,
    /// The same as SI7021 and SHT21.
    Htu21d,
    /// SHT30, SHT31, SHT35.
    Sht3x,
    /// AHT10, AHT15, AHT20.
    Aht10,
    /// Measures only the temperature.
    Lm75,
}

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct I2cSensorConfig {
    /// For example `chamber`.
    pub name: String,
    /// The kind of chip.
    pub chip: I2cSensorChip,
    /// Its I2C bus.
    pub bus: String,
    /// Its address on the bus.
    pub address: u8,
    /// It has the temperature of this heater.
    pub heater: String,
}

impl Part for I2cSensorConfig {
    fn name(&self) -> String {
        format!("i2c_sensor {}", self.name)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::I2c { bus: &self.bus, address: self.address })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        printer.check_heater(whose, &self.heater)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(heater) = workshop.heater(&self.heater) {
            let sensor = Sensor::new(self.chip, heater, workshop.clock.clone());
            workshop.solder_i2c(self, sensor);
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section(format_args!("temperature_sensor {}", self.name));
        let kind = match self.chip {
            I2cSensorChip::Bme280 => "BME280",
            I2cSensorChip::Htu21d => "HTU21D",
            I2cSensorChip::Sht3x => "SHT3X",
            I2cSensorChip::Aht10 => "AHT10",
            I2cSensorChip::Lm75 => "LM75",
        };
        cfg.key("sensor_type", kind);
        cfg.key("i2c_address", self.address);
        cfg.key("i2c_bus", &self.bus);
    }
}

struct Sensor {
    chip: I2cSensorChip,
    heater: Arc<Heater>,
    clock: Arc<dyn TimeSource>,
    /// The bytes since the start of the message.
    written: Vec<u8>,
    /// The bytes that it sends next.
    answer: Vec<u8>,
    sent: usize,
    /// The last command.
    command: Vec<u8>,
    /// The bytes that the host wrote to registers (BME280, HTU21D, LM75).
    registers: [u8; 256],
}

impl Sensor {
    fn new(chip: I2cSensorChip, heater: Arc<Heater>, clock: Arc<dyn TimeSource>) -> Sensor {
        let mut registers = [0; 256];
        match chip {
            I2cSensorChip::Bme280 => bme280_calibration(&mut registers),
            // The user register of an HTU21D: 14 bits, and its heater off.
            I2cSensorChip::Htu21d => registers[0xe6] = 0x02,
            // THYST is 75 degrees Celsius, TOS is 80.
            I2cSensorChip::Lm75 => (registers[2], registers[3]) = (75, 80),
            _ => {}
        }
        Sensor { chip, heater, clock, written: Vec::new(), answer: Vec::new(), sent: 0, command: Vec::new(), registers }
    }

    fn measure(&self) -> f64 {
        self.heater.at(self.clock.now()).sensor_celsius
    }

    /// The answer to the last command.
    fn answer(&self) -> Vec<u8> {
        let celsius = self.measure();
        match (self.chip, self.command.as_slice()) {
            (I2cSensorChip::Bme280, [register, ..]) => {
                let mut registers = self.registers;
                bme280_measured(&mut registers, celsius);
                registers[usize::from(*register)..].to_vec()
            }
            (I2cSensorChip::Htu21d, [0xe3 | 0xf3]) => checked(((celsius + 46.85) / 175.72, 0), 0),
            // The status bits say that it is the humidity.
            (I2cSensorChip::Htu21d, [0xe5 | 0xf5]) => checked(((HUMIDITY + 0.06) / 1.25, 2), 0),
            (I2cSensorChip::Htu21d, [0xe7]) => vec![self.registers[0xe6]],
            // The second part of the serial number begins with the kind of chip.
            (I2cSensorChip::Htu21d, [0xfc, 0xc9]) => vec![0x32, 0x00, 0x00, 0x00, 0x00, 0x00],
            (I2cSensorChip::Sht3x, [0xf3, 0x2d]) => {
                let status = [0, 0];
                [status.as_slice(), &[crc8(&status, 0xff)]].concat()
            }
            (I2cSensorChip::Sht3x, _) => {
                [checked(((celsius + 45.0) / 175.0, 0), 0xff), checked((HUMIDITY, 0), 0xff)].concat()
            }
            (I2cSensorChip::Aht10, _) => {
                let twenty_bits = |share: f64| (share * f64::from(1 << 20)).round().clamp(0.0, 1_048_575.0) as u32;
                let (humidity, heat) = (twenty_bits(HUMIDITY), twenty_bits((celsius + 50.0) / 200.0));
                let word = u64::from(humidity) << 20 | u64::from(heat);
                let [_, _, _, bytes @ ..] = word.to_be_bytes();
                // Calibrated, and not busy.
                [[0x18].as_slice(), &bytes].concat()
            }
            (I2cSensorChip::Lm75, [register, ..]) => {
                let halves = (celsius * 2.0).round().clamp(-110.0, 250.0) as i16;
                match register {
                    0 => (halves << 7).to_be_bytes().to_vec(),
                    // PRODID
                    7 => vec![0xa1],
                    other => vec![self.registers[usize::from(*other)], 0],
                }
            }
            _ => Vec::new(),
        }
    }

    /// A message that only writes is complete.
    fn take(&mut self) {
        match (self.chip, self.written.as_slice()) {
            (I2cSensorChip::Bme280, [register, data @ ..]) => {
                // More bytes come as pairs of a register and its value.
                let mut register = Some(*register);
                let mut data = data.iter();
                while let (Some(at), Some(value)) = (register, data.next()) {
                    if matches!(at, 0xf2 | 0xf4 | 0xf5) {
                        self.registers[usize::from(at)] = *value;
                    }
                    register = data.next().copied();
                }
            }
            (I2cSensorChip::Htu21d, [0xe6, value]) => self.registers[0xe6] = *value,
            (I2cSensorChip::Lm75, [register @ 1..=3, value, ..]) => self.registers[usize::from(*register)] = *value,
            _ => {}
        }
    }
}

impl I2cChip for Sensor {
    fn start(&mut self, read: bool) -> bool {
        if read {
            if !self.written.is_empty() {
                self.command = std::mem::take(&mut self.written);
            }
            self.answer = self.answer();
            self.sent = 0;
        } else {
            self.written.clear();
        }
        true
    }

    fn write(&mut self, byte: u8) -> bool {
        // No message of these chips is longer.
        if self.written.len() < 16 {
            self.written.push(byte);
        }
        true
    }

    fn read(&mut self) -> u8 {
        let byte = self.answer.get(self.sent).copied().unwrap_or(0xff);
        self.sent += 1;
        byte
    }

    fn stop(&mut self) {
        if !self.written.is_empty() {
            self.take();
            self.command = std::mem::take(&mut self.written);
        }
    }
}

/// A value with 16 bits and its checksum. The last two bits are a status.
fn checked((share, status): (f64, u16), start: u8) -> Vec<u8> {
    // The clamp keeps the value in the range of a u16, so the cast loses nothing.
    let value = (share * 65536.0).round().clamp(0.0, 65535.0) as u16 & !3 | status;
    let bytes = value.to_be_bytes();
    [bytes.as_slice(), &[crc8(&bytes, start)]].concat()
}

/// x^8 + x^5 + x^4 + 1
fn crc8(bytes: &[u8], start: u8) -> u8 {
    crc::crc8(0x31, start, bytes)
}

/// Calibration values of a BME280: dig_T1 to dig_T3, then those of the pressure, from Bosch's example.
const BME280_T: [u16; 3] = [27504, 26435, -1000i16 as u16];
const BME280_P: [u16; 9] = [36477, -10685i16 as u16, 3024, 2855, 140, -7i16 as u16, 15500, -14600i16 as u16, 6000];
/// Bosch's example reads 1006.5 hPa for it.
const BME280_PRESSURE: u32 = 415_148;
/// About half of the humidity's range.
const BME280_HUMIDITY: u16 = 27_000;

fn bme280_calibration(registers: &mut [u8; 256]) {
    for (at, value) in (0x88..).step_by(2).zip(BME280_T.into_iter().chain(BME280_P)) {
        registers[at..at + 2].copy_from_slice(&value.to_le_bytes());
    }
    // dig_H1 to dig_H6: 75, 362, 0, 313, 50, 30
    registers[0xa1] = 75;
    registers[0xe1..0xe8].copy_from_slice(&[0x6a, 0x01, 0x00, 0x13, 0x29, 0x03, 0x1e]);
    registers[0xd0] = 0x60;
}

/// The temperature of a BME280's reading ("Compensation formulas").
fn bme280_celsius(raw: f64) -> f64 {
    let [t1, t2, t3] = [f64::from(BME280_T[0]), f64::from(BME280_T[1] as i16), f64::from(BME280_T[2] as i16)];
    let first = (raw / 16384.0 - t1 / 1024.0) * t2;
    let second = (raw / 131_072.0 - t1 / 8192.0).powi(2) * t3;
    (first + second) / 5120.0
}

fn bme280_measured(registers: &mut [u8; 256], celsius: f64) {
    // The reading rises with the temperature.
    let (mut low, mut high) = (0u32, (1 << 20) - 1);
    while low < high {
        let middle = (low + high) / 2;
        if bme280_celsius(f64::from(middle)) < celsius { low = middle + 1 } else { high = middle }
    }
    let twenty_bits = |value: u32| {
        let [_, bytes @ ..] = (value << 4).to_be_bytes();
        bytes
    };
    registers[0xf7..0xfa].copy_from_slice(&twenty_bits(BME280_PRESSURE));
    registers[0xfa..0xfd].copy_from_slice(&twenty_bits(low));
    registers[0xfd..0xff].copy_from_slice(&BME280_HUMIDITY.to_be_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use pinion_firmware::time::{Clock, VirtualClock};

    /// A chip at 60 degrees Celsius.
    fn sensor(chip: I2cSensorChip) -> Sensor {
        let mut config = DefaultPrinter::read().heaters[0].clone();
        config.start_celsius = Some(60.0);
        config.ambient_celsius = 60.0;
        let clock = VirtualClock::at(Clock::EPOCH);
        let heater = Arc::new(Heater::new(&config, config.sensor().unwrap(), 0.0, clock.now()));
        Sensor::new(chip, heater, Arc::new(clock))
    }

    fn talk(sensor: &mut Sensor, write: &[u8], count: usize) -> Vec<u8> {
        if !write.is_empty() {
            assert!(sensor.start(false));
            assert!(write.iter().all(|byte| sensor.write(*byte)));
        }
        if count > 0 {
            assert!(sensor.start(true));
        }
        let read = (0..count).map(|_| sensor.read()).collect();
        sensor.stop();
        read
    }

    #[test]
    fn a_bme280_reads_the_temperature_by_boschs_formula() {
        let chip = &mut sensor(I2cSensorChip::Bme280);
        assert_eq!(talk(chip, &[0xd0], 1), [0x60]);
        assert_eq!(talk(chip, &[0x88], 4), [0x70, 0x6b, 0x43, 0x67]);
        talk(chip, &[0xf2, 0x01, 0xf4, 0x25], 0);
        assert_eq!((talk(chip, &[0xf2], 1), talk(chip, &[0xf4], 1)), (vec![0x01], vec![0x25]));
        let data = talk(chip, &[0xf7], 8);
        let raw = u32::from(data[3]) << 12 | u32::from(data[4]) << 4 | u32::from(data[5]) >> 4;
        // The formula for integers.
        let (t1, t2, t3) = (27504i64, 26435i64, -1000i64);
        let adc = i64::from(raw);
        let first = (((adc >> 3) - (t1 << 1)) * t2) >> 11;
        let half = (adc >> 4) - t1;
        let second = (((half * half) >> 12) * t3) >> 14;
        let hundredths = ((first + second) * 5 + 128) >> 8;
        assert!((hundredths - 6000).abs() <= 1, "{hundredths}");
    }

    #[test]
    fn an_htu21d_and_an_sht3x_send_checksums() {
        let chip = &mut sensor(I2cSensorChip::Htu21d);
        talk(chip, &[0xfe], 0);
        assert_eq!(talk(chip, &[0xfc, 0xc9], 1), [0x32]);
        talk(chip, &[0xf3], 0);
        let read = talk(chip, &[], 3);
        let celsius = f64::from(u16::from_be_bytes([read[0], read[1]]) & !3) * 175.72 / 65536.0 - 46.85;
        assert!((celsius - 60.0).abs() < 0.02, "{celsius}");
        assert_eq!(crc8(&read, 0), 0, "a value with its checksum");
        // The data sheet's example.
        assert_eq!(crc8(&[0x68, 0x3a], 0), 0x7c);

        let chip = &mut sensor(I2cSensorChip::Sht3x);
        let read = talk(chip, &[0x2c, 0x06], 6);
        let celsius = f64::from(u16::from_be_bytes([read[0], read[1]])) * 175.0 / 65535.0 - 45.0;
        assert!((celsius - 60.0).abs() < 0.02, "{celsius}");
        // The data sheet's example.
        assert_eq!(crc8(&[0xbe, 0xef], 0xff), 0x92);
    }

    #[test]
    fn an_aht10_and_an_lm75_read_the_temperature() {
        let chip = &mut sensor(I2cSensorChip::Aht10);
        talk(chip, &[0xac, 0x33, 0x00], 0);
        let read = talk(chip, &[], 6);
        assert_eq!(read[0] & 0x88, 0x08);
        let raw = u32::from(read[3] & 0x0f) << 16 | u32::from(read[4]) << 8 | u32::from(read[5]);
        assert!((f64::from(raw) * 200.0 / f64::from(1 << 20) - 50.0 - 60.0).abs() < 0.01);
        assert_eq!(talk(&mut sensor(I2cSensorChip::Lm75), &[0], 2), [60, 0]);
    }
}
