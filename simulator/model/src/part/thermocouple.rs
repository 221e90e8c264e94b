// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI converters for thermocouples and for a platinum resistor. The sensor is in a heater. The chips are the MAX31855
//! (data sheet 19-5793), MAX6675 (19-2235), MAX31856 (19-7534) and MAX31865 (19-6478).
//!
//! Simulated: words and registers with their resolution and range, the duration and the start of a conversion, faults
//! of the wires and what each chip notices of them. A thermocouple is as linear as the chips assume. A platinum
//! resistor follows the equation of Callendar and Van Dusen (IEC 60751). Not simulated: noise, averaging, the cold
//! junction's limits and offset, the MAX31865's fault detection cycle.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Bound, Trouble, check, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::description::whole;
use crate::engine::physics::Heater;
use crate::engine::spi::SpiChip;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{Clock, Ticks, TimeSource};

/// A converter's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThermocoupleConfig {
    /// For example `nozzle`.
    pub name: String,
    /// Which chip it is.
    pub chip: Converter,
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// The heater that its sensor is in.
    pub heater: String,
    /// Temperature of the chip itself.
    #[serde(default = "whole::<25, _>")]
    pub chip_celsius: f64,
    /// The fault of the sensor, if it has one.
    pub fault: Option<SensorFault>,
    /// The platinum resistor's resistance at 0 °C (MAX31865).
    #[serde(default = "whole::<100, _>")]
    pub rtd_ohm: f64,
    /// The reference resistor (MAX31865).
    #[serde(default = "whole::<430, _>")]
    pub reference_ohm: f64,
}

/// The chips.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Converter {
    /// Thermocouple, 14 bits, faults in the word.
    Max31855,
    /// Thermocouple type K, 12 bits.
    Max6675,
    /// Thermocouple, 19 bits, registers.
    Max31856,
    /// Platinum resistor, 15 bits, registers.
    Max31865,
}

/// The faults that a sensor's wires can have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SensorFault {
    /// A wire is off.
    Open,
    /// The two wires touch.
    Shorted,
    /// A wire touches ground.
    ShortToGround,
    /// A wire touches the supply.
    ShortToSupply,
}

use Converter::{Max6675, Max31855, Max31856, Max31865};

impl Converter {
    /// klippy's name for it.
    fn name(self) -> &'static str {
        match self {
            Max31855 => "MAX31855",
            Max6675 => "MAX6675",
            Max31856 => "MAX31856",
            Max31865 => "MAX31865",
        }
    }

    /// The longest conversion. For chips with a mains filter, at 60 Hz.
    fn conversion(self) -> Ticks {
        Ticks::from_us(match self {
            Max31855 => 100_000,
            Max6675 => 220_000,
            Max31856 => 90_000,
            Max31865 => 17_600,
        })
    }

    /// Whether the chip's data sheet mentions this fault.
    fn knows(self, fault: SensorFault) -> bool {
        match self {
            Max31855 => true,
            Max6675 => matches!(fault, SensorFault::Open | SensorFault::Shorted),
            Max31856 | Max31865 => fault != SensorFault::ShortToGround,
        }
    }
}

impl Part for ThermocoupleConfig {
    fn name(&self) -> String {
        format!("thermocouple {}", self.name)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        printer.check_heater(whose, &self.heater)?;
        if self.fault.is_some_and(|fault| !self.chip.knows(fault)) {
            let cause = format!("a {} has no known answer to this fault", self.chip.name());
            return wrong(whose, "fault", &cause, "choose `open` or `shorted`");
        }
        check(whose, "chip_celsius", self.chip_celsius, Bound::Any)?;
        check(whose, "rtd_ohm", self.rtd_ohm, Bound::AboveZero)?;
        check(whose, "reference_ohm", self.reference_ohm, Bound::AboveZero)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(heater) = workshop.heater(&self.heater) {
            workshop.solder_spi(self, Chip::new(self.clone(), heater, workshop.clock.clone()));
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("temperature_sensor {}", self.name));
        cfg.key("sensor_type", self.chip.name());
        match &self.select_pin {
            Some(pin) => cfg.key("sensor_pin", pin),
            None => cfg.key("sensor_pin", "None"),
        }
        cfg.key("spi_bus", &self.bus);
        if self.chip == Max31865 {
            cfg.key("rtd_nominal_r", self.rtd_ohm);
            cfg.key("rtd_reference_r", self.reference_ohm);
        }
        if let Some(heater) = layout.printer.heaters.iter().find(|heater| heater.name == self.heater) {
            cfg.key("min_temp", heater.min_celsius);
            cfg.key("max_temp", heater.max_celsius);
        }
    }
}

// Registers of the MAX31856.
const CR0: usize = 0x00;
const CR0_AUTOMATIC: u8 = 0x80;
const CR0_ONE_SHOT: u8 = 0x40;
const CR0_OPEN_DETECTION: u8 = 0x30;
const LIMIT_HIGH: usize = 0x05;
const LIMIT_LOW: usize = 0x07;
const COLD_JUNCTION: usize = 0x0a;
const LINEARIZED: usize = 0x0c;
const SR: usize = 0x0f;
/// Power-up values.
const MAX31856_REGISTERS: [u8; 16] = [0, 0x03, 0xff, 0x7f, 0xc0, 0x7f, 0xff, 0x80, 0, 0, 0, 0, 0, 0, 0, 0];

// Registers of the MAX31865.
const CONFIGURATION: usize = 0x00;
const BIAS: u8 = 0x80;
const AUTOMATIC: u8 = 0x40;
const ONE_SHOT: u8 = 0x20;
const CLEAR_FAULTS: u8 = 0x02;
const RTD: usize = 0x01;
const HIGH_THRESHOLD: usize = 0x03;
const LOW_THRESHOLD: usize = 0x05;
const FAULT_STATUS: usize = 0x07;
const MAX31865_REGISTERS: [u8; 16] = [0, 0, 0, 0xff, 0xff, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

struct Chip {
    config: ThermocoupleConfig,
    heater: Arc<Heater>,
    clock: Arc<dyn TimeSource>,
    registers: [u8; 16],
    /// The word of a chip without registers.
    word: [u8; 4],
    /// Since when it converts; `None` if it does not.
    since: Option<Clock>,
    /// Bytes since the chip was selected; the next field is the address from the first byte.
    bytes: usize,
    address: u8,
}

impl Chip {
    fn new(config: ThermocoupleConfig, heater: Arc<Heater>, clock: Arc<dyn TimeSource>) -> Chip {
        let (registers, since) = match config.chip {
            Max31855 | Max6675 => ([0; 16], Some(clock.now())),
            Max31856 => (MAX31856_REGISTERS, None),
            Max31865 => (MAX31865_REGISTERS, None),
        };
        Chip { config, heater, clock, registers, word: [0; 4], since, bytes: 0, address: 0 }
    }

    fn has(&self, fault: SensorFault) -> bool {
        self.config.fault == Some(fault)
    }

    /// The temperature that a thermocouple measures. Without a voltage, for example if its wires touch, it is the
    /// temperature of the chip.
    fn celsius(&self, now: Clock) -> f64 {
        match self.config.fault {
            None => self.heater.at(now).celsius,
            Some(_) => self.config.chip_celsius,
        }
    }

    /// Ends the current conversion if its time is over.
    fn convert(&mut self, now: Clock) {
        let done = self.since.is_some_and(|since| now.since(since) >= i64::from(self.config.chip.conversion().0));
        if !done {
            return;
        }
        match self.config.chip {
            Max31855 => self.word = self.max31855(now).to_be_bytes(),
            Max6675 => self.word = (self.max6675(now) << 16).to_be_bytes(),
            Max31856 => self.max31856(now),
            Max31865 => self.max31865(now),
        }
    }

    /// The word: 14 bits of 0.25 C, any fault, 12 bits of 0.0625 C for the chip's own temperature, the faults (table
    /// 2).
    fn max31855(&self, now: Clock) -> u32 {
        let faults = u32::from(self.has(SensorFault::Open))
            | u32::from(self.has(SensorFault::ShortToGround)) << 1
            | u32::from(self.has(SensorFault::ShortToSupply)) << 2;
        let sensor = if faults == 0 { counts(self.celsius(now), 4.0, -0x2000, 0x1fff) } else { 0x1fff };
        let chip = counts(self.config.chip_celsius, 16.0, -0x800, 0x7ff);
        sensor << 18 | u32::from(faults != 0) << 16 | (chip & 0xfff) << 4 | faults
    }

    /// The word: 12 bits of 0.25 C from bit 3 on, and bit 2 for an open thermocouple (table 2).
    fn max6675(&self, now: Clock) -> u32 {
        match self.config.fault {
            Some(SensorFault::Open) => 0xfff << 3 | 1 << 2,
            _ => counts(self.celsius(now), 4.0, 0, 0xfff) << 3,
        }
    }

    fn max31856(&mut self, now: Clock) {
        let signed = |high: u8, low: u8| i32::from(i16::from_be_bytes([high, low]));
        let registers = &self.registers;
        // 16ths of a degree.
        let high = signed(registers[LIMIT_HIGH], registers[LIMIT_HIGH + 1]);
        let low = signed(registers[LIMIT_LOW], registers[LIMIT_LOW + 1]);
        let open = self.has(SensorFault::Open) && registers[CR0] & CR0_OPEN_DETECTION != 0;
        let over = self.has(SensorFault::ShortToSupply);
        let celsius = self.celsius(now);
        let sixteenths = (celsius * 16.0).round() as i32;
        // 19 bits of 1/128 C and 14 bits of 1/64 C, both left-aligned. An input above the supply stops the conversions.
        if !over {
            let [_, linearized @ ..] = (counts(celsius, 128.0, -0x40000, 0x3ffff) << 5).to_be_bytes();
            self.registers[LINEARIZED..LINEARIZED + 3].copy_from_slice(&linearized);
        }
        let [.., c1, c0] = (counts(self.config.chip_celsius, 64.0, -0x2000, 0x1fff) << 2).to_be_bytes();
        self.registers[COLD_JUNCTION..COLD_JUNCTION + 2].copy_from_slice(&[c1, c0]);
        // Type K.
        let out_of_range = !(-200.0..=1372.0).contains(&celsius);
        let bits = [open, over, sixteenths < low, sixteenths > high, false, false, out_of_range];
        self.registers[SR] = bits.iter().zip(0..).fold(0, |all, (bit, place)| all | u8::from(*bit) << place);
    }

    fn max31865(&mut self, now: Clock) {
        const FULL_SCALE: f64 = 32768.0;
        let biased = self.registers[CONFIGURATION] & BIAS != 0;
        let ohm = match self.config.fault {
            Some(SensorFault::Open) => f64::INFINITY,
            Some(_) => 0.0,
            None => self.config.rtd_ohm * relative_resistance(self.heater.at(now).celsius),
        };
        let ratio = if biased { ohm / self.config.reference_ohm } else { 0.0 };
        let code = (ratio * FULL_SCALE).round().clamp(0.0, FULL_SCALE - 1.0) as u16;
        let threshold = |at: usize| u16::from_be_bytes([self.registers[at], self.registers[at + 1]]) >> 1;
        let high = code >= threshold(HIGH_THRESHOLD);
        let low = code <= threshold(LOW_THRESHOLD);
        let over = self.has(SensorFault::ShortToSupply);
        // Faults stay until they are cleared.
        self.registers[FAULT_STATUS] |= u8::from(high) << 7 | u8::from(low) << 6 | u8::from(over) << 2;
        let fault = u16::from(self.registers[FAULT_STATUS] != 0);
        self.registers[RTD..RTD + 2].copy_from_slice(&(code << 1 | fault).to_be_bytes());
    }

    fn write(&mut self, at: usize, value: u8, now: Clock) {
        let starts = |automatic: u8, one_shot: u8| value & (automatic | one_shot) != 0;
        match (self.config.chip, at) {
            (Max31856, CR0) => {
                self.registers[CR0] = value & !(CR0_ONE_SHOT | 0x02);
                let was = self.since;
                self.since = starts(CR0_AUTOMATIC, CR0_ONE_SHOT).then(|| was.unwrap_or(now));
            }
            (Max31856, 0x01..0x0c) => self.registers[at] = value,
            (Max31865, CONFIGURATION) => {
                self.registers[CONFIGURATION] = value & !(ONE_SHOT | CLEAR_FAULTS);
                let was = self.since;
                self.since = starts(AUTOMATIC, ONE_SHOT).then(|| was.unwrap_or(now));
                if value & CLEAR_FAULTS != 0 {
                    self.registers[FAULT_STATUS] = 0;
                    self.registers[RTD + 1] &= !1;
                }
            }
            (Max31865, HIGH_THRESHOLD..FAULT_STATUS) => self.registers[at] = value,
            _ => {}
        }
    }
}

/// Converts degrees Celsius to counts, clamped to the converter's range, in two's complement.
fn counts(celsius: f64, per_kelvin: f64, min: i32, max: i32) -> u32 {
    ((celsius * per_kelvin).round() as i32).clamp(min, max) as u32 & (max as u32 * 2 + 1)
}

/// A platinum resistor's resistance relative to its resistance at 0 °C.
fn relative_resistance(celsius: f64) -> f64 {
    const A: f64 = 3.9083e-3;
    const B: f64 = -5.775e-7;
    const C: f64 = -4.183e-12;
    let below = if celsius < 0.0 { C * (celsius - 100.0) * celsius.powi(3) } else { 0.0 };
    1.0 + A * celsius + B * celsius * celsius + below
}

impl SpiChip for Chip {
    fn knows_mode(&self, mode: u8) -> bool {
        match self.config.chip {
            Max31855 | Max6675 => mode == 0,
            // CPHA is 1. The chip detects the clock's idle level.
            Max31856 | Max31865 => mode == 1 || mode == 3,
        }
    }

    fn select(&mut self, _rate_hz: u32) {
        self.bytes = 0;
        self.convert(self.clock.now());
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let n = self.bytes;
        self.bytes += 1;
        if matches!(self.config.chip, Max31855 | Max6675) {
            return self.word.get(n).copied().unwrap_or(0);
        }
        if n == 0 {
            self.address = byte;
            return 0xff;
        }
        // The address increments by itself.
        let at = (usize::from(self.address & 0x7f) + n - 1) % self.registers.len();
        if self.address & 0x80 != 0 {
            self.write(at, byte, self.clock.now());
            return 0xff;
        }
        self.registers[at]
    }

    /// Chips without registers stop converting while they are selected, and start again here.
    fn deselect(&mut self) {
        if matches!(self.config.chip, Max31855 | Max6675) {
            self.since = Some(self.clock.now());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use pinion_firmware::time::{CLOCK_FREQ, VirtualClock};

    struct Bench {
        clock: VirtualClock,
        chip: Chip,
    }

    impl Bench {
        /// A chip with its sensor in a mass of this temperature.
        fn new(chip: Converter, celsius: f64, fault: Option<SensorFault>) -> Bench {
            let clock = VirtualClock::at(Clock::from_ticks(1_000_000));
            let mut printer = DefaultPrinter::read();
            let heater = &mut printer.heaters[0];
            (heater.ambient_celsius, heater.start_celsius) = (celsius, Some(celsius));
            let heater = Heater::new(heater, heater.sensor().unwrap(), 0.0, clock.now());
            let config = ThermocoupleConfig {
                name: "nozzle".into(),
                chip,
                bus: "spi".into(),
                select_pin: None,
                heater: "extruder".into(),
                chip_celsius: 25.0,
                fault,
                rtd_ohm: 100.0,
                reference_ohm: 400.0,
            };
            let chip = Chip::new(config, Arc::new(heater), Arc::new(clock.clone()));
            Bench { clock, chip }
        }

        fn transfer(&mut self, bytes: &[u8]) -> Vec<u8> {
            self.chip.select(4_000_000);
            let answer = bytes.iter().map(|byte| self.chip.exchange(*byte)).collect();
            self.chip.deselect();
            answer
        }

        fn wait_ms(&self, ms: u64) {
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + ms * u64::from(CLOCK_FREQ) / 1000));
        }

        fn word(&mut self, bytes: usize) -> Vec<u8> {
            self.wait_ms(250);
            self.transfer(&vec![0; bytes])
        }
    }

    /// Words of the data sheets' tables.
    #[test]
    fn words_of_the_chips_without_registers() {
        for (celsius, word) in [
            (1600.0, [0x64, 0, 0x19, 0]),
            (100.75, [0x06, 0x4c, 0x19, 0]),
            (-0.25, [0xff, 0xfc, 0x19, 0]),
            (-250.0, [0xf0, 0x60, 0x19, 0]),
            (9999.0, [0x7f, 0xfc, 0x19, 0]),
        ] {
            assert_eq!(Bench::new(Max31855, celsius, None).word(4), word, "{celsius}");
        }
        for (fault, low) in [(SensorFault::Open, 1), (SensorFault::ShortToGround, 2), (SensorFault::ShortToSupply, 4)] {
            assert_eq!(Bench::new(Max31855, 200.0, Some(fault)).word(4), [0x7f, 0xfd, 0x19, low]);
        }
        assert_eq!(Bench::new(Max31855, 200.0, Some(SensorFault::Shorted)).word(4), [0x01, 0x90, 0x19, 0]);
        assert_eq!(Bench::new(Max6675, 1023.75, None).word(2), [0x7f, 0xf8]);
        assert_eq!(Bench::new(Max6675, 25.25, None).word(2), [0x03, 0x28]);
        assert_eq!(Bench::new(Max6675, -10.0, None).word(2), [0, 0]);
        assert_eq!(Bench::new(Max6675, 100.0, Some(SensorFault::Open)).word(2)[1] & 0b110, 0b100);
    }

    #[test]
    fn a_chip_that_is_asked_too_often_does_not_get_to_convert() {
        let mut bench = Bench::new(Max6675, 100.0, None);
        for _ in 0..10 {
            bench.wait_ms(200);
            assert_eq!(bench.transfer(&[0; 2]), [0, 0]);
        }
        bench.wait_ms(220);
        assert_eq!(bench.transfer(&[0; 2]), [0x0c, 0x80]);
    }

    #[test]
    fn the_max31856_converts_on_command_and_has_limits() {
        let mut bench = Bench::new(Max31856, 100.5, None);
        bench.wait_ms(200);
        assert_eq!(bench.transfer(&[0; 17])[1..], MAX31856_REGISTERS);
        bench.transfer(&[0x80, 0x80, 0x03, 0xfc]);
        assert_eq!(bench.transfer(&[0x0c, 0, 0, 0])[1..], [0, 0, 0]);
        bench.wait_ms(100);
        assert_eq!(bench.transfer(&[0x0a, 0, 0, 0, 0, 0, 0])[1..], [0x19, 0, 0x06, 0x48, 0, 0]);
        // A limit of 100 C, and registers that are read-only.
        bench.transfer(&[0x85, 0x06, 0x40]);
        bench.transfer(&[0x8c, 1, 1, 1, 1]);
        assert_eq!(bench.transfer(&[0x0c, 0, 0, 0, 0])[1..], [0x06, 0x48, 0, 0x08]);
    }

    #[test]
    fn the_max31856_looks_for_an_open_wire_only_if_that_is_on() {
        let mut bench = Bench::new(Max31856, 200.0, Some(SensorFault::Open));
        bench.transfer(&[0x80, 0x80]);
        bench.wait_ms(100);
        assert_eq!(bench.transfer(&[0x0c, 0, 0, 0, 0])[1..], [0x01, 0x90, 0, 0], "the chip's own temperature");
        bench.transfer(&[0x80, 0x90]);
        assert_eq!(bench.transfer(&[0x0f, 0])[1], 0x01);
        let mut bench = Bench::new(Max31856, 200.0, Some(SensorFault::ShortToSupply));
        bench.transfer(&[0x80, 0x80]);
        bench.wait_ms(100);
        assert_eq!(bench.transfer(&[0x0f, 0])[1], 0x02);
    }

    #[test]
    fn the_max31865_compares_resistors_and_keeps_faults_until_they_are_cleared() {
        // 138.5055 ohm at 100 C (IEC 60751) of 400: 11346.4 of 32768.
        let mut bench = Bench::new(Max31865, 100.0, None);
        bench.wait_ms(20);
        assert_eq!(bench.transfer(&[0x01, 0, 0])[1..], [0, 0], "does not convert yet");
        bench.transfer(&[0x80, 0xc2]);
        bench.wait_ms(20);
        assert_eq!(bench.transfer(&[0x00, 0, 0, 0])[1..], [0xc0, 0x58, 0xa4]);
        assert_eq!(bench.transfer(&[0x07, 0])[1], 0);
        // A high threshold exactly at the code.
        bench.transfer(&[0x83, 0x58, 0xa4]);
        assert_eq!(bench.transfer(&[0x01, 0, 0])[1..], [0x58, 0xa5]);
        bench.transfer(&[0x83, 0xff, 0xff]);
        assert_eq!(bench.transfer(&[0x07, 0])[1], 0x80);
        bench.transfer(&[0x80, 0xc2]);
        assert_eq!(bench.transfer(&[0x07, 0])[1], 0);
        for (fault, code, status) in [
            (SensorFault::Open, [0xff, 0xff], 0x80),
            (SensorFault::Shorted, [0, 1], 0x40),
            (SensorFault::ShortToSupply, [0, 1], 0x44),
        ] {
            let mut bench = Bench::new(Max31865, 100.0, Some(fault));
            bench.transfer(&[0x80, 0xc2]);
            bench.wait_ms(20);
            assert_eq!(bench.transfer(&[0x01, 0, 0])[1..], code);
            assert_eq!(bench.transfer(&[0x07, 0])[1], status);
        }
    }

    #[test]
    fn a_platinum_resistor() {
        // IEC 60751, table of Pt100.
        for (celsius, ohm) in [(-100.0, 60.26), (0.0, 100.0), (100.0, 138.51), (250.0, 194.10)] {
            assert!((relative_resistance(celsius) * 100.0 - ohm).abs() < 0.006, "{celsius}");
        }
    }
}
