// SPDX-License-Identifier: GPL-3.0-or-later
//! Asks a device over its bus whether it is there, and explains a wrong answer.

use std::thread;
use std::time::Duration;

use pinion_firmware::board::{Board as _, BusDevice, BusError, BusStatus, I2cConfig, SpiConfig};
use pinion_linux::LinuxBoard;
use pinion_linux::gpio::FastGpio;

use super::catalog::{Catalog, Check, Detect, Fault, Read, Wiring};
use pinion_system::board::Kind;

/// How often a register is read. A loose wire answers differently each time.
const READS: usize = 8;
/// Rate of I2C transfers. The kernel's driver has its own.
const I2C_RATE_HZ: u32 = 100_000;
/// The temperatures that a thermometer can report, in degrees Celsius.
const TEMPERATURES: std::ops::RangeInclusive<f64> = -40.0..=150.0;
/// The bit of an SPI chip's register address that means reading. The MAX31856 and MAX31865 write with it.
const HIGH_BIT: u8 = 0x80;

/// The answers of a device.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Answer {
    /// In words, for a reader.
    pub(super) text: String,
    /// The I2C address that it has.
    pub(super) address: Option<u8>,
}

/// The known answers on a bus.
pub(super) trait Buses {
    /// Opens the SPI device.
    ///
    /// # Errors
    ///
    /// One line with cause and remedy.
    fn spi(&mut self, way: &Wiring) -> Result<Box<dyn BusDevice>, String>;

    /// Opens an I2C address.
    ///
    /// # Errors
    ///
    /// One line with cause and remedy.
    fn i2c(&mut self, address: u8) -> Result<Box<dyn BusDevice>, String>;

    /// Gives a chip time.
    fn wait(&mut self, time: Duration) {
        thread::sleep(time);
    }
}

/// The buses of this computer.
pub(super) struct Live {
    board: LinuxBoard,
    /// The bus's number on the wire.
    bus: u32,
}

impl Live {
    /// The bus of a node, such as `spidev0.0` or `i2c-1`.
    pub(super) fn of(node: &str) -> Option<Live> {
        let bus = match node.strip_prefix("spidev") {
            Some(numbers) => {
                let (bus, select) = numbers.split_once('.')?;
                pinion_linux::spi::Node { bus: bus.parse().ok()?, select: select.parse().ok()? }.number()?
            }
            None => node.strip_prefix("i2c-")?.parse().ok()?,
        };
        Some(Live { board: LinuxBoard::new(None, FastGpio::Off), bus })
    }
}

impl Buses for Live {
    fn spi(&mut self, way: &Wiring) -> Result<Box<dyn BusDevice>, String> {
        let config = SpiConfig { bus: self.bus, mode: way.mode, rate_hz: way.rate_hz, chip_select: None };
        self.board.spi(config).map(|opened| opened.device).map_err(|failure| failure.trouble.to_string())
    }

    fn i2c(&mut self, address: u8) -> Result<Box<dyn BusDevice>, String> {
        let config = I2cConfig { bus: self.bus, address, rate_hz: I2C_RATE_HZ };
        self.board.i2c(config).map(|opened| opened.device).map_err(|failure| failure.trouble.to_string())
    }
}

/// Asks the device, on I2C at these addresses.
///
/// # Errors
///
/// One line: the answer, its meaning and the remedy.
pub(super) fn ask(catalog: &Catalog, way: &Wiring, addresses: &[u8], buses: &mut dyn Buses) -> Result<Answer, String> {
    let Some(check) = &way.check else {
        return Ok(Answer { text: "it cannot be asked: try it out".into(), address: None });
    };
    if way.addresses.is_empty() {
        let mut device = buses.spi(way)?;
        return match check {
            Check::Id { register, ids } => {
                let mut read = || exchange(&mut *device, &[register | HIGH_BIT], 1).map(|bytes| bytes[0]);
                // A chip that speaks I2C until the first edge of its chip select answers nothing here.
                read()?;
                let answers = (0..READS).map(|_| read()).collect::<Result<Vec<u8>, String>>()?;
                judge(catalog, Kind::Spi, *register, ids, &answers).map(|text| Answer { text, address: None })
            }
            Check::Fixed { register, mask, bits, faults, detect } => {
                let answer = exchange(&mut *device, register.as_slice(), mask.len())?;
                let text = fixed(&answer, mask, bits, faults)?;
                detect.iter().try_for_each(|detect| detected(buses, &mut *device, detect))?;
                Ok(Answer { text, address: None })
            }
            _ => Ok(Answer { text: "it cannot be asked over SPI: try it out".into(), address: None }),
        };
    }
    let mut others = Vec::new();
    let mut wrong = None;
    for address in addresses {
        let mut device = buses.i2c(*address)?;
        match asked(catalog, check, buses, &mut *device) {
            Ok(text) => {
                return Ok(Answer { text: format!("{text} at address {address:#04x}"), address: Some(*address) });
            }
            Err(Failure::Nobody) => {}
            Err(Failure::Bus(why)) => return Err(why),
            Err(Failure::Wrong(why)) => {
                others.push(*address);
                wrong.get_or_insert(format!("at address {address:#04x}: {why}"));
            }
        }
    }
    if let Some(wrong) = wrong {
        return Err(wrong);
    }
    let asked: Vec<String> = addresses.iter().map(|address| format!("{address:#04x}")).collect();
    Err(format!("no chip answers at {}: check power, ground, and that SDA and SCL are not swapped", asked.join(" or ")))
}

/// Why an I2C chip is not the expected one.
enum Failure {
    /// No chip has the address.
    Nobody,
    /// The bus does not work.
    Bus(String),
    /// Another answer than expected.
    Wrong(String),
}

fn asked(
    catalog: &Catalog,
    check: &Check,
    buses: &mut dyn Buses,
    device: &mut dyn BusDevice,
) -> Result<String, Failure> {
    let mut read = |write: &[u8], count: usize| {
        let mut bytes = vec![0; count];
        device.write_read(write, &mut bytes).map(|()| bytes).map_err(|error: BusError| match error.status {
            BusStatus::StartNack | BusStatus::Nack => Failure::Nobody,
            _ => Failure::Bus(error.trouble.to_string()),
        })
    };
    match check {
        Check::Id { register, ids } => {
            let answers: Vec<u8> =
                (0..READS).map(|_| read(&[*register], 1).map(|bytes| bytes[0])).collect::<Result<_, _>>()?;
            judge(catalog, Kind::I2c, *register, ids, &answers).map_err(Failure::Wrong)
        }
        Check::Reads { reads } => {
            for own in reads {
                let answer = match own.wait_ms {
                    0 => read(&own.write, own.mask.len())?,
                    wait_ms => {
                        read(&own.write, 0)?;
                        buses.wait(Duration::from_millis(wait_ms));
                        read(&[], own.mask.len())?
                    }
                };
                known(own, &answer).map_err(Failure::Wrong)?;
            }
            Ok("it answers as its data sheet says".into())
        }
        Check::Temperature { write, bytes } => {
            let answer = read(write, *bytes)?;
            if let Some(why) = silence(Kind::I2c, &answer) {
                return Err(Failure::Wrong(why));
            }
            let high = answer.first().copied().unwrap_or_default();
            let low = answer.get(1).copied().unwrap_or_default();
            let degrees = f64::from(i16::from_be_bytes([high, low])) / 256.0;
            // None of these chips measures less than 1/16 degree.
            match TEMPERATURES.contains(&degrees) && low & 0x0f == 0 {
                true => Ok(format!("it measures {degrees:.1} degrees")),
                false => {
                    Err(Failure::Wrong(format!("{degrees:.1} degrees is not a value of this chip: it is another chip")))
                }
            }
        }
        Check::Fixed { .. } | Check::W1 | Check::Iio { .. } => Ok("it cannot be asked over I2C: try it out".into()),
    }
}

/// Sends bytes to an SPI chip, and returns the bytes that follow.
fn exchange(device: &mut dyn BusDevice, head: &[u8], count: usize) -> Result<Vec<u8>, String> {
    let mut bytes = head.to_vec();
    bytes.resize(head.len() + count, 0);
    device.exchange(&mut bytes).map_err(|error| error.trouble.to_string())?;
    Ok(bytes.split_off(head.len()))
}

/// The meaning of a chip's answers to the question for its id.
fn judge(catalog: &Catalog, bus: Kind, register: u8, ids: &[u8], answers: &[u8]) -> Result<String, String> {
    let first = answers.first().copied().unwrap_or_default();
    if answers.iter().any(|answer| *answer != first) {
        return Err(format!(
            "its id changes from read to read ({}): a wire is loose, too long, or beside a motor's cable",
            hex(answers)
        ));
    }
    if ids.contains(&first) {
        return Ok(format!("its id is {first:#04x}"));
    }
    if let Some(why) = silence(bus, &[first]) {
        return Err(why);
    }
    let wanted = ids.first().copied().unwrap_or_default();
    let text = format!("its id is {first:#04x} instead of {wanted:#04x}");
    let is_shifted = ids.iter().any(|id| [id >> 1, id >> 1 | 0x80, id << 1, id << 1 | 1].contains(&first));
    if is_shifted {
        return Err(format!("{text}, shifted by a bit: shorten the wires, twist SCLK and CS each with ground"));
    }
    match catalog.with_id(register, first) {
        Some(other) => Err(format!("{text}, the id of another chip: pinion add {}", other.name)),
        None => Err(format!("{text}: it is another chip, or data wires are swapped")),
    }
}

/// The meaning of an answer in which some bits never change.
fn fixed(answer: &[u8], mask: &[u8], bits: &[u8], faults: &[Fault]) -> Result<String, String> {
    if let Some(why) = silence(Kind::Spi, answer) {
        return Err(why);
    }
    let text = format!("it answers {}", hex(answer));
    if !has_bits(answer, mask, bits) {
        return Err(format!("{text}, as this chip never does: it is another chip, or data wires are swapped"));
    }
    without(faults, answer).map(|()| text)
}

/// Has a chip look for faults, and leaves it as it was.
fn detected(buses: &mut dyn Buses, device: &mut dyn BusDevice, detect: &Detect) -> Result<(), String> {
    let old = exchange(device, &[detect.register], 1)?[0];
    let write = detect.register | HIGH_BIT;
    exchange(device, &[write, old | detect.set], 0)?;
    buses.wait(Duration::from_millis(detect.wait_ms));
    let status = exchange(device, &[detect.status], 1);
    exchange(device, &[write, old], 0)?;
    without(&detect.faults, &status?)
}

/// Fails with the first fault that the answer reports.
fn without(faults: &[Fault], answer: &[u8]) -> Result<(), String> {
    match faults.iter().find(|fault| answer.get(fault.byte).is_some_and(|byte| byte & fault.bit != 0)) {
        Some(fault) => Err(format!("it answers {}: {}", hex(answer), fault.meaning)),
        None => Ok(()),
    }
}

/// The meaning of an I2C chip's answer to a read.
fn known(read: &Read, answer: &[u8]) -> Result<(), String> {
    let has_bits = has_bits(answer, &read.mask, &read.bits);
    // The CRC of zeros may be zero.
    if let Some(why) = silence(Kind::I2c, answer).filter(|_| !has_bits || read.crc.is_some()) {
        return Err(why);
    }
    if !has_bits {
        return Err(format!("it answers {}, as this chip never does: it is another chip", hex(answer)));
    }
    match (read.crc, answer.split_last()) {
        (Some(start), Some((crc, bytes))) if crc8(start, bytes) != *crc => {
            Err(format!("{} has a wrong CRC: shorten the wires", hex(answer)))
        }
        _ => Ok(()),
    }
}

fn has_bits(answer: &[u8], mask: &[u8], bits: &[u8]) -> bool {
    answer.iter().zip(mask).zip(bits).all(|((answer, mask), bits)| answer & mask == *bits)
}

/// The meaning of all zeros or all ones.
fn silence(bus: Kind, answer: &[u8]) -> Option<String> {
    let is_all = |value: u8| answer.iter().all(|byte| *byte == value);
    let why = match (bus, is_all(0), is_all(0xff)) {
        (Kind::I2c, true, _) => "all zeros: another chip holds SDA low, or this chip is broken",
        (Kind::I2c, _, true) => "all ones: its power or ground is loose, or it is another chip",
        (_, true, _) => {
            "all zeros: no power, the chip's data output (SDO, MISO) or CS is not connected, or the pin is still GPIO"
        }
        (_, _, true) => {
            "all ones: no ground, CS does not reach the chip, or its data input (SDA, MOSI) or clock is not connected"
        }
        _ => return None,
    };
    Some(format!("it answers {why}"))
}

/// The CRC of Sensirion's and TE's chips: polynomial 0x31 (data sheets of the SHT3x and HTU21D).
fn crc8(start: u8, bytes: &[u8]) -> u8 {
    bytes.iter().fold(start, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc, _| if crc & 0x80 != 0 { crc << 1 ^ 0x31 } else { crc << 1 })
    })
}

fn hex(bytes: &[u8]) -> String {
    let bytes: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    bytes.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::trouble::Trouble;
    use pinion_linux::clock::Monotonic;
    use pinion_model::{SimBoard, SimConfig};
    use proptest::prelude::*;
    use std::collections::BTreeMap;
    use std::sync::Arc;

    /// Chips that answer a register with these bytes, one after the other. SPI has the address 0.
    #[derive(Clone, Default)]
    struct Chips(BTreeMap<u8, Vec<u8>>);

    struct Chip {
        /// Whether an SPI transfer begins with a register.
        has_registers: bool,
        answers: Vec<u8>,
        next: usize,
        is_there: bool,
    }

    impl Chip {
        fn fill(&mut self, bytes: &mut [u8]) {
            for byte in bytes {
                *byte = self.answers[self.next % self.answers.len()];
                self.next += 1;
            }
        }
    }

    impl BusDevice for Chip {
        fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
            self.fill(&mut bytes[usize::from(self.has_registers)..]);
            Ok(())
        }

        fn write_read(&mut self, _write: &[u8], read: &mut [u8]) -> Result<(), BusError> {
            if !self.is_there {
                return Err(BusError::new(BusStatus::StartNack, Trouble::new("nobody")));
            }
            self.fill(read);
            Ok(())
        }
    }

    impl Buses for Chips {
        fn spi(&mut self, way: &Wiring) -> Result<Box<dyn BusDevice>, String> {
            let has_registers = !matches!(way.check, Some(Check::Fixed { register: None, .. }));
            Ok(Box::new(Chip { has_registers, answers: self.0[&0].clone(), next: 0, is_there: true }))
        }

        fn i2c(&mut self, address: u8) -> Result<Box<dyn BusDevice>, String> {
            let answers = self.0.get(&address).cloned();
            let is_there = answers.is_some();
            Ok(Box::new(Chip { has_registers: true, is_there, answers: answers.unwrap_or_default(), next: 0 }))
        }

        fn wait(&mut self, _time: Duration) {}
    }

    fn asked(device: &str, way: usize, chips: &[(u8, &[u8])]) -> Result<Answer, String> {
        let catalog = Catalog::read().unwrap();
        let way = &catalog.device(device).unwrap().way[way];
        let mut chips = Chips(chips.iter().map(|(address, bytes)| (*address, bytes.to_vec())).collect());
        ask(&catalog, way, &way.addresses, &mut chips)
    }

    #[test]
    fn a_chip_s_answer_is_read() {
        for (answer, words) in [
            (0xe5, None),
            (0x00, Some("all zeros: no power")),
            (0xff, Some("all ones: no ground")),
            // Both were reported by users of Klipper.
            (0xf2, Some("0xf2 instead of 0xe5, shifted by a bit")),
            (0x72, Some("0x72 instead of 0xe5, shifted by a bit")),
            (0xea, Some("the id of another chip: pinion add icm20948")),
            (0x42, Some("it is another chip")),
        ] {
            let result = asked("adxl345", 0, &[(0, &[answer])]);
            match words {
                None => assert_eq!(result.unwrap().text, "its id is 0xe5"),
                Some(words) => assert!(result.as_ref().unwrap_err().contains(words), "{result:?}"),
            }
        }
        let noise = asked("adxl345", 0, &[(0, &[0xe5, 0x12, 0xe5, 0xff])]).unwrap_err();
        assert!(noise.starts_with("its id changes from read to read (12 e5 ff"), "{noise}");
        assert_eq!(asked("lis2dw", 0, &[(0, &[0x33])]).unwrap_err().rsplit_once(": ").unwrap().1, "pinion add lis3dh");
    }

    #[test]
    fn a_thermocouple_amplifier_is_known_by_the_bits_that_never_change() {
        for (device, answer, words) in [
            ("max31855", &[0x01, 0x90, 0x19, 0x00][..], Ok("it answers 01 90 19 00")),
            ("max31855", &[0x00; 4], Err("all zeros")),
            ("max31855", &[0xff; 4], Err("all ones")),
            ("max31855", &[0x5a; 4], Err("5a 5a 5a 5a, as this chip never does: it is another chip")),
            ("max31855", &[0x00, 0x01, 0x19, 0x01], Err("no thermocouple is connected")),
            ("max31855", &[0x00, 0x01, 0x19, 0x02], Err("touches ground")),
            ("max31855", &[0x00, 0x01, 0x19, 0x04], Err("touches its supply")),
            ("max6675", &[0x0c, 0x80], Ok("it answers 0c 80")),
            ("max6675", &[0x0c, 0x84], Err("no thermocouple is connected")),
            ("max6675", &[0x8c, 0x80], Err("as this chip never does")),
            // The thresholds, the old settings, the new ones, the faults, the old settings.
            ("max31856", &[0x7f, 0xc0, 0x7f, 0xff, 0x80, 0x00, 0, 0, 0, 0], Ok("it answers 7f c0")),
            ("max31856", &[0x7f, 0xc0, 0x7f, 0xff, 0x80, 0x00, 0, 0, 1, 0], Err("no thermocouple is connected")),
            ("max31856", &[0xff; 6], Err("all ones")),
            // Shifted by a bit.
            ("max31856", &[0x3f, 0xe0, 0x3f, 0xff, 0xc0, 0x00], Err("as this chip never does")),
            ("max31865", &[0xff, 0xff, 0x00, 0x00, 0, 0, 0, 0], Ok("it answers ff ff 00 00")),
            ("max31865", &[0x7f, 0xff, 0x80, 0x00], Err("as this chip never does")),
        ] {
            let result = asked(device, 0, &[(0, answer)]);
            let result = result.as_ref().map(|answer| &*answer.text).map_err(|why| &**why);
            match (result, words) {
                (Ok(text), Ok(words)) | (Err(text), Err(words)) => assert!(text.contains(words), "{device}: {text}"),
                _ => panic!("{device} {answer:x?}: {result:?}"),
            }
        }
    }

    #[test]
    fn a_chip_is_found_at_its_other_address() {
        let answer = asked("bme280", 0, &[(0x77, &[0x60])]).unwrap();
        assert_eq!((answer.address, &*answer.text), (Some(0x77), "its id is 0x60 at address 0x77"));
        assert_eq!(asked("bme280", 0, &[(0x76, &[0x58]), (0x77, &[0x60])]).unwrap().address, Some(0x76));
        // A stranger at the first address does not hide the chip at the second.
        assert_eq!(asked("bme280", 0, &[(0x76, &[0x12]), (0x77, &[0x60])]).unwrap().address, Some(0x77));
        let error = asked("bme280", 0, &[]).unwrap_err();
        assert!(error.starts_with("no chip answers at 0x76 or 0x77: check power"), "{error}");
        let error = asked("mpu9250", 0, &[(0x69, &[0x19])]).unwrap_err();
        assert!(error.starts_with("at address 0x69: its id is 0x19 instead of 0x74"), "{error}");
        // It is on, off and on.
        assert_eq!(asked("ssd1306", 0, &[(0x3d, &[0x03, 0x43, 0x03])]).unwrap().address, Some(0x3d));
    }

    #[test]
    fn a_temperature_and_a_crc_are_checked() {
        assert_eq!(
            asked("lm75", 0, &[(0x48, &[0x19, 0x80])]).unwrap().text,
            "it measures 25.5 degrees at address 0x48"
        );
        assert_eq!(asked("lm75", 0, &[(0x4f, &[0xf6, 0])]).unwrap().text, "it measures -10.0 degrees at address 0x4f");
        assert!(
            asked("lm75", 0, &[(0x48, &[0xd7, 0])]).unwrap_err().contains("-41.0 degrees is not a value of this chip")
        );
        // The example of the SHT3x's data sheet.
        assert_eq!(crc8(0xff, &[0xbe, 0xef]), 0x92);
        assert!(asked("sht", 0, &[(0x44, &[0xbe, 0xef, 0x92])]).is_ok());
        assert!(asked("sht", 0, &[(0x45, &[0xbe, 0xef, 0x93])]).unwrap_err().contains("wrong CRC"));
    }

    /// Wrong answers of every chip that can be asked.
    #[test]
    fn no_device_of_the_catalog_is_taken_for_there_by_a_wrong_answer() {
        let catalog = Catalog::read().unwrap();
        let mut asked = 0;
        for device in &catalog.devices {
            for way in &device.way {
                let Some(check) = &way.check else { continue };
                let mut answers: Vec<(&str, Vec<u8>)> =
                    vec![("ones", vec![0xff; 8]), ("noise", vec![0x5a, 0xa7, 0x31])];
                match check {
                    Check::Id { ids, .. } => {
                        answers.push(("zeros", vec![0; 8]));
                        answers.extend(
                            ids.iter()
                                .flat_map(|id| [id >> 1, id >> 1 | 0x80, id << 1, id << 1 | 1])
                                .map(|shifted| ("shifted", vec![shifted])),
                        );
                        let others = catalog.devices.iter().flat_map(|other| &other.way);
                        let others = others.filter_map(|way| match &way.check {
                            Some(Check::Id { ids, .. }) => Some(ids),
                            _ => None,
                        });
                        let others = others.flatten().filter(|id| !ids.contains(id));
                        answers.extend(others.map(|id| ("another chip", vec![*id])));
                    }
                    _ if way.driver.is_some() => continue,
                    Check::Fixed { .. } | Check::Reads { .. } | Check::Temperature { .. } => {
                        answers.push(("zeros", vec![0; 8]));
                    }
                    Check::W1 | Check::Iio { .. } => continue,
                }
                for (what, answer) in answers {
                    let addresses = way.addresses.iter().copied().chain([0]);
                    let mut chips = Chips(addresses.map(|address| (address, answer.clone())).collect());
                    let text = ask(&catalog, way, &way.addresses, &mut chips);
                    assert!(text.is_err(), "{} by {:?}, {what} {answer:x?}: {text:?}", device.name, way.bus);
                    asked += 1;
                }
                if !way.addresses.is_empty() {
                    let text = ask(&catalog, way, &way.addresses, &mut Chips::default()).unwrap_err();
                    assert!(text.starts_with("no chip answers at 0x"), "{}: {text}", device.name);
                }
            }
        }
        assert!(asked > 100, "{asked}");
    }

    /// The chips of a simulated printer.
    struct Simulated(SimBoard);

    impl Simulated {
        /// The thermometers are on I2C, and nothing has the SPI bus of the header but what `change` puts there.
        fn with(change: impl Fn(String) -> String) -> Simulated {
            let described = concat!(env!("CARGO_MANIFEST_DIR"), "/simulator/model/src/default.toml");
            let described = std::fs::read_to_string(described).unwrap();
            let described = change(described.replace("bus = \"spidev0.0\"", "bus = \"spidev9.0\""));
            let sensors = [("aht10", 0x38), ("htu21d", 0x40), ("sht3x", 0x44), ("lm75", 0x48), ("bme280", 0x77)];
            let sensors = sensors.map(|(chip, address)| {
                format!(
                    "[[part]]\nkind = \"i2c_sensor\"\nname = \"{chip}\"\nchip = \"{chip}\"\nbus = \"i2c.1\"\n\
                     address = {address}\nheater = \"heater_bed\"\n"
                )
            });
            let bus = "\n[[spi_bus]]\nname = \"spidev9.0\"\n";
            let config = SimConfig::parse(&[&*described, bus, &sensors.concat()].concat(), "this test").unwrap();
            Simulated(SimBoard::new(config, Arc::new(Monotonic::start())).unwrap())
        }

        fn ask(&mut self, device: &str) -> Result<Answer, String> {
            let catalog = Catalog::read().unwrap();
            {
                let way = &catalog.device(device).unwrap().way[0];
                ask(&catalog, way, &way.addresses, self)
            }
        }
    }

    impl Buses for Simulated {
        fn spi(&mut self, way: &Wiring) -> Result<Box<dyn BusDevice>, String> {
            let bus = self.0.spi_buses().iter().find(|bus| bus.name == "spidev0.0").unwrap().first;
            let config = SpiConfig { bus, mode: way.mode, rate_hz: way.rate_hz, chip_select: None };
            self.0.spi(config).map(|opened| opened.device).map_err(|failure| failure.trouble.to_string())
        }

        fn i2c(&mut self, address: u8) -> Result<Box<dyn BusDevice>, String> {
            let bus = self.0.i2c_buses().first().unwrap().first;
            let config = I2cConfig { bus, address, rate_hz: I2C_RATE_HZ };
            self.0.i2c(config).map(|opened| opened.device).map_err(|failure| failure.trouble.to_string())
        }
    }

    #[test]
    fn the_simulated_printer_s_chips_are_known() {
        let mut chips = Simulated::with(|described| {
            described.replace(
                "kind = \"accelerometer\"\nbus = \"spidev1.0\"\nselect_pin = \"accel_cs\"",
                "kind = \"accelerometer\"\nbus = \"spidev0.0\"",
            )
        });
        assert_eq!(chips.ask("adxl345").unwrap().text, "its id is 0xe5");
        assert!(chips.ask("lis2dw").is_err());
        for (device, address) in
            [("ssd1306", 0x3c), ("aht", 0x38), ("htu21d", 0x40), ("sht", 0x44), ("lm75", 0x48), ("bme280", 0x77)]
        {
            assert_eq!(chips.ask(device).unwrap().address, Some(address), "{device}");
        }
        // It is an LM75.
        let error = chips.ask("ads1115").unwrap_err();
        assert!(error.starts_with("at address 0x48: it answers 4b 00, as this chip never does"), "{error}");
        assert!(chips.ask("mpu9250").unwrap_err().starts_with("no chip answers at 0x68 or 0x69"));
    }

    #[test]
    fn a_simulated_thermocouple_that_is_open_is_reported() {
        for device in ["max6675", "max31855", "max31856", "max31865"] {
            let with = |fault: &str| {
                let part = format!(
                    "[[part]]\nkind = \"thermocouple\"\nname = \"this\"\nchip = \"{device}\"\nbus = \"spidev0.0\"\n\
                     heater = \"heater_bed\"\n{fault}"
                );
                Simulated::with(|described| format!("{described}\n{part}"))
            };
            let mut chip = with("");
            // The first conversion of a MAX31855 and a MAX6675.
            thread::sleep(Duration::from_millis(250));
            chip.ask(device).unwrap();
            chip.ask(device).unwrap();
            let mut chip = with("fault = \"open\"\n");
            thread::sleep(Duration::from_millis(250));
            let error = chip.ask(device).unwrap_err();
            assert!(error.ends_with(" is connected"), "{device}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_answer_has_a_meaning(answers in prop::collection::vec(any::<u8>(), 1..8)) {
            let catalog = Catalog::read().unwrap();
            for device in &catalog.devices {
                for way in &device.way {
                    let addresses = way.addresses.iter().chain([&0]);
                    let mut chips = Chips(addresses.map(|address| (*address, answers.clone())).collect());
                    let _ = ask(&catalog, way, &way.addresses, &mut chips);
                }
            }
        }
    }
}
