// SPDX-License-Identifier: GPL-3.0-or-later
//! The inductance converter LDC1612 on I2C with a coil beside the nozzle (Texas Instruments SNOSCY9, "Register Maps",
//! "Functional Description"). Closer metal of the bed gives the coil less inductance, and a higher frequency of
//! oscillation.
//!
//! A conversion takes 16 RCOUNT0 + 4 clocks. The first one after a start takes 16 SETTLECOUNT0 more. The result is
//! `f / FIN_DIVIDER0 / fREF * 2^28`, minus the offset. Reading STATUS clears its flags and sets INTB high. Reading the
//! data of channel 0 clears UNREADCONV0.
//!
//! Simulated: these registers, channel 0 by the clock, sleep, reset, the errors (frequency too high, amplitude, no
//! oscillation), the drive current that the chip finds by itself, INTB. The amplitude is proportional to the drive
//! current. A conversion gives the frequency at the time of the read, not during the conversion before. Not simulated:
//! channel 1 and the sequence of channels, the filter of the input (its register keeps what is written), the time of
//! the search for the drive current.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::ready::{Conversions, ReadyLine, ready_pin};
use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Bound, Trouble, check, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::bed::Bed;
use crate::engine::noise::Noise;
use crate::engine::register_map::Access::{Read, ReadWrite, Write};
use crate::engine::register_map::{OnBus, Register, RegisterChip, RegisterMap};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource};

/// The clock at CLKIN, as klippy assumes.
const EXTERNAL_CLOCK_HZ: f64 = 12e6;
const INTERNAL_CLOCK_HZ: f64 = 43.3e6;

/// Highest value of IDRIVE0, which has five bits.
const MAX_CURRENT: u16 = 31;

const DATA0_MSB: u8 = 0x00;
const DATA0_LSB: u8 = 0x01;
const RCOUNT0: u8 = 0x08;
const OFFSET0: u8 = 0x0c;
const SETTLECOUNT0: u8 = 0x10;
const CLOCK_DIVIDERS0: u8 = 0x14;
const STATUS: u8 = 0x18;
const ERROR_CONFIG: u8 = 0x19;
const CONFIG: u8 = 0x1a;
const MUX_CONFIG: u8 = 0x1b;
const RESET_DEV: u8 = 0x1c;
const DRIVE_CURRENT0: u8 = 0x1e;
const MANUFACTURER_ID: u8 = 0x7e;
const DEVICE_ID: u8 = 0x7f;

const SLEEP_MODE_EN: u16 = 1 << 13;
const RP_OVERRIDE_EN: u16 = 1 << 12;
const AUTO_AMP_DIS: u16 = 1 << 10;
const REF_CLK_SRC: u16 = 1 << 9;
const INTB_DIS: u16 = 1 << 7;
const RESET_DEV_BIT: u16 = 1 << 15;
const DRDY_2INT: u16 = 1;
const STATUS_DRDY: u16 = 1 << 6;
const STATUS_UNREADCONV0: u16 = 1 << 3;
/// The flags in the highest four bits of DATA0: over range, watchdog, amplitude.
const ERR_OR: u32 = 1 << 30;
const ERR_WD: u32 = 1 << 29;
const ERR_AE: u32 = 1 << 28;
/// The bits of ERROR_CONFIG that let these flags into DATA0.
const OR_ERR2OUT: u16 = 1 << 14;
const WD_ERR2OUT: u16 = 1 << 13;
const AH_ERR2OUT: u16 = 1 << 12;
const AL_ERR2OUT: u16 = 1 << 11;

/// The registers.
const REGISTERS: &[Register<u16>] = &[
    Register(RCOUNT0, ReadWrite, 0xffff, 0x0080),
    Register(0x09, ReadWrite, 0xffff, 0x0080), // RCOUNT1
    Register(OFFSET0, ReadWrite, 0xffff, 0),
    Register(0x0d, ReadWrite, 0xffff, 0), // OFFSET1
    Register(SETTLECOUNT0, ReadWrite, 0xffff, 0),
    Register(0x11, ReadWrite, 0xffff, 0), // SETTLECOUNT1
    Register(CLOCK_DIVIDERS0, ReadWrite, 0xffff, 0),
    Register(0x15, ReadWrite, 0xffff, 0), // CLOCK_DIVIDERS1
    Register(ERROR_CONFIG, ReadWrite, 0xffff, 0),
    Register(CONFIG, ReadWrite, 0xffff, 0x2801),
    Register(MUX_CONFIG, ReadWrite, 0xffff, 0x020f),
    Register(RESET_DEV, Write, RESET_DEV_BIT, 0),
    // The chip itself writes INIT_IDRIVE.
    Register(DRIVE_CURRENT0, ReadWrite, 0xf800, 0),
    Register(0x1f, ReadWrite, 0xf800, 0), // DRIVE_CURRENT1
    Register(MANUFACTURER_ID, Read, 0, 0x5449),
    Register(DEVICE_ID, Read, 0, 0x3055),
];

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ldc1612Config {
    /// Its I2C bus.
    pub bus: String,
    /// Its address: 42 or 43, by its ADDR pin.
    #[serde(default = "default_address")]
    pub address: u8,
    /// Low while an unread conversion waits.
    pub intb_pin: Option<PinName>,
    /// How far the coil stands from the nozzle along the x axis.
    #[serde(default)]
    pub x_offset_mm: f64,
    /// How far the coil stands from the nozzle along the y axis.
    #[serde(default)]
    pub y_offset_mm: f64,
    /// How far the coil is above the nozzle's tip.
    pub coil_mm: f64,
    /// The frequency far from any metal.
    pub far_hz: f64,
    /// How much higher the frequency is right at the metal.
    pub near_hz: f64,
    /// The distance over which the increase falls to 1/e.
    pub fade_mm: f64,
    /// Standard deviation of a conversion.
    #[serde(default)]
    pub noise_hz: f64,
    /// The drive current (0 to 31) that suits the coil.
    pub drive_current: u16,
    /// How far the bed gives way, as a share of the nozzle's further travel after contact.
    #[serde(default = "default_yielding")]
    pub yielding: f64,
}

fn default_address() -> u8 {
    0x2a
}

fn default_yielding() -> f64 {
    0.9
}

impl Part for Ldc1612Config {
    fn name(&self) -> String {
        "ldc1612".into()
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::I2c { bus: &self.bus, address: self.address })
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("intb_pin", self.intb_pin.as_ref())]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        use Bound::{AboveZero, Any, NotNegative};
        for (key, value, bound) in [
            ("x_offset_mm", self.x_offset_mm, Any),
            ("y_offset_mm", self.y_offset_mm, Any),
            ("coil_mm", self.coil_mm, NotNegative),
            ("far_hz", self.far_hz, AboveZero),
            ("near_hz", self.near_hz, NotNegative),
            ("fade_mm", self.fade_mm, AboveZero),
            ("noise_hz", self.noise_hz, NotNegative),
            ("yielding", self.yielding, NotNegative),
        ] {
            check(whose, key, value, bound)?;
        }
        if self.drive_current > MAX_CURRENT {
            let cause = format!("{} is not a current of the chip", self.drive_current);
            return wrong(whose, "drive_current", &cause, &format!("give 0 to {MAX_CURRENT}"));
        }
        if self.yielding > 1.0 {
            return wrong(whose, "yielding", "the bed cannot give way by more than all", "give a share of 1");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let intb = ReadyLine::new("interrupt of ldc1612");
        workshop.wire(self.intb_pin.as_ref(), ready_pin(intb.clone()));
        let coil = Coil { config: self.clone(), bed: workshop.bed(), noise: workshop.noise(self) };
        workshop.solder_i2c(self, OnBus::new(Ldc1612::new(coil, intb, workshop.clock.clone())));
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.probe(layout, |cfg| {
            cfg.section("probe_eddy_current coil");
            cfg.key("sensor_type", "ldc1612");
            cfg.key("i2c_address", self.address);
            cfg.key("i2c_bus", &self.bus);
            cfg.key_if("intb_pin", self.intb_pin.as_ref());
            cfg.key("x_offset", self.x_offset_mm);
            cfg.key("y_offset", self.y_offset_mm);
            cfg.key("descend_z", 0.5);
            cfg.key("reg_drive_current", self.drive_current);
        });
    }
}

/// The coil over the bed.
struct Coil {
    config: Ldc1612Config,
    bed: Bed,
    noise: Noise,
}

impl Coil {
    /// The frequency of oscillation, with noise.
    fn hz(&mut self) -> f64 {
        let Ldc1612Config { x_offset_mm, y_offset_mm, coil_mm, far_hz, near_hz, fade_mm, .. } = self.config;
        // The nozzle pushes the bed in front of it.
        let depth_mm = (-self.bed.clearance_mm([0.0; 3])).max(0.0);
        let distance_mm = self.bed.clearance_mm([x_offset_mm, y_offset_mm, coil_mm]) + self.config.yielding * depth_mm;
        let near_hz = near_hz * (-distance_mm.max(0.0) / fade_mm).exp();
        far_hz + near_hz + self.noise.draw() * self.config.noise_hz
    }
}

struct Ldc1612 {
    coil: Coil,
    clock: Arc<dyn TimeSource>,
    intb: Arc<ReadyLine>,
    conversions: Conversions,
    /// Number of conversions that were read.
    read: u64,
    registers: RegisterMap<u16>,
    /// DATA0_LSB belongs to the last DATA0_MSB that was read.
    lsb: u16,
    /// The register whose first byte a message has.
    word: u16,
}

impl Ldc1612 {
    fn new(coil: Coil, intb: Arc<ReadyLine>, clock: Arc<dyn TimeSource>) -> Ldc1612 {
        let (conversions, registers) = (Conversions::NONE, RegisterMap::new(REGISTERS));
        let mut chip = Ldc1612 { coil, clock, intb, conversions, read: 0, registers, lsb: 0, word: 0 };
        chip.start_over();
        chip
    }

    fn reference_hz(&self) -> f64 {
        let external = self.registers.get(CONFIG) & REF_CLK_SRC != 0;
        let divider = (self.registers.get(CLOCK_DIVIDERS0) & 0x3ff).max(1);
        if external { EXTERNAL_CLOCK_HZ / f64::from(divider) } else { INTERNAL_CLOCK_HZ / f64::from(divider) }
    }

    /// Conversions start again, or stop.
    fn start_over(&mut self) {
        let ticks = |clocks: f64| clocks / self.reference_hz() * f64::from(CLOCK_FREQ);
        let conversion = ticks(16.0 * f64::from(self.registers.get(RCOUNT0)) + 4.0);
        let settling = ticks(16.0 * f64::from(self.registers.get(SETTLECOUNT0)));
        let asleep = self.registers.get(CONFIG) & SLEEP_MODE_EN != 0;
        let first = self.clock.now().ticks() + (settling + conversion) as u64;
        self.conversions = Conversions {
            first: Clock::from_ticks(first),
            period: if asleep { 0.0 } else { conversion },
            seen: 0,
            reported: self.registers.get(ERROR_CONFIG) & DRDY_2INT != 0 && self.registers.get(CONFIG) & INTB_DIS == 0,
        };
        self.read = 0;
        self.intb.set(self.conversions);
        if !asleep && self.registers.get(CONFIG) & AUTO_AMP_DIS == 0 {
            // INIT_IDRIVE: the current that the chip found.
            let found = self.coil.config.drive_current << 6;
            self.registers.set(DRIVE_CURRENT0, self.registers.get(DRIVE_CURRENT0) & 0xf800 | found);
        }
    }

    /// DATA0 of a finished conversion.
    fn convert(&mut self) -> u32 {
        let errors = self.registers.get(ERROR_CONFIG);
        let suits = self.coil.config.drive_current;
        let current = if self.registers.get(CONFIG) & RP_OVERRIDE_EN != 0 {
            self.registers.get(DRIVE_CURRENT0) >> 11
        } else {
            suits
        };
        let let_out = |flag: u32, bits: u16| if errors & bits != 0 { flag } else { 0 };
        // Without a current the coil does not oscillate. Half to twice the suitable current is enough for it.
        if current == 0 {
            return let_out(ERR_WD, WD_ERR2OUT);
        }
        let mut flags = 0;
        if 2 * current < suits {
            flags |= let_out(ERR_AE, AL_ERR2OUT);
        }
        if current > 2 * suits {
            flags |= let_out(ERR_AE, AH_ERR2OUT);
        }
        let divider = (self.registers.get(CLOCK_DIVIDERS0) >> 12).max(1);
        let share = self.coil.hz() / f64::from(divider) / self.reference_hz();
        // The input must be below a quarter of the reference.
        if share >= 0.25 {
            flags |= let_out(ERR_OR, OR_ERR2OUT);
        }
        let offset = f64::from(self.registers.get(OFFSET0)) * 4096.0;
        let data = (share * 268_435_456.0 - offset).round().clamp(0.0, 268_435_455.0);
        flags | data as u32
    }

    /// The value that a host reads.
    fn fetch(&mut self, address: u8) -> u16 {
        let over = self.conversions.over(self.clock.now());
        match address {
            DATA0_MSB => {
                if over > self.read {
                    self.read = over;
                }
                let data = if over == 0 { 0 } else { self.convert() };
                self.lsb = data as u16;
                (data >> 16) as u16
            }
            DATA0_LSB => self.lsb,
            STATUS => {
                let ready = if over > self.conversions.seen { STATUS_DRDY } else { 0 };
                let unread = if over > self.read { STATUS_UNREADCONV0 } else { 0 };
                self.conversions.seen = over;
                self.intb.set(self.conversions);
                ready | unread
            }
            _ => self.registers.read(address),
        }
    }

    fn put(&mut self, address: u8, value: u16) {
        self.registers.write(address, value);
        if self.registers.is_set(RESET_DEV, RESET_DEV_BIT) {
            self.registers = RegisterMap::new(REGISTERS);
            self.start_over();
        }
        if [RCOUNT0, SETTLECOUNT0, CLOCK_DIVIDERS0, ERROR_CONFIG, CONFIG].contains(&address) {
            self.start_over();
        }
    }
}

/// Each register has two bytes, at twice its address.
impl RegisterChip for Ldc1612 {
    fn register(&mut self, first: u8, _is_spi: bool) -> (u8, bool) {
        (first << 1, true)
    }

    fn read(&mut self, at: u8) -> u8 {
        if at & 1 == 0 {
            self.word = self.fetch(at >> 1);
        }
        self.word.to_be_bytes()[usize::from(at & 1)]
    }

    fn write(&mut self, at: u8, value: u8) {
        self.word = self.word << 8 | u16::from(value);
        if at & 1 != 0 {
            self.put(at >> 1, self.word);
        }
    }

    /// A message stays at its register.
    fn next(&mut self, at: u8) -> u8 {
        at ^ 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::i2c::I2cChip;
    use crate::engine::motion::Axis;
    use pinion_firmware::time::VirtualClock;

    struct Bench {
        z: Arc<Axis>,
        clock: VirtualClock,
        intb: Arc<ReadyLine>,
        chip: OnBus<Ldc1612>,
    }

    impl Bench {
        fn new() -> Bench {
            let z = Arc::new(Axis::new(&DefaultPrinter::read().axes[2]));
            z.set_enabled(true);
            let config = Ldc1612Config {
                bus: "i2c.1".into(),
                address: 0x2a,
                intb_pin: None,
                x_offset_mm: 0.0,
                y_offset_mm: 0.0,
                coil_mm: 2.0,
                far_hz: 3_000_000.0,
                near_hz: 300_000.0,
                fade_mm: 2.5,
                noise_hz: 0.0,
                drive_current: 15,
                yielding: 0.9,
            };
            let bed = Bed::under(Default::default(), None, None, Some(z.clone()));
            let clock = VirtualClock::at(Clock::from_ticks(0));
            let intb = ReadyLine::new("intb");
            let coil = Coil { config, bed, noise: Noise::of("coil", 1) };
            let chip = OnBus::new(Ldc1612::new(coil, intb.clone(), Arc::new(clock.clone())));
            Bench { z, clock, intb, chip }
        }

        /// The configuration for 400 conversions a second, at half the coil's frequency.
        fn set_up() -> Bench {
            let mut bench = Bench::new();
            for (address, value) in [
                (RCOUNT0, 1875),
                (SETTLECOUNT0, 3750),
                (CLOCK_DIVIDERS0, 2 << 12 | 1),
                (ERROR_CONFIG, 0x1f << 11 | 1),
                (CONFIG, 1 | RP_OVERRIDE_EN | AUTO_AMP_DIS | REF_CLK_SRC),
                (DRIVE_CURRENT0, 15 << 11),
            ] {
                bench.write(address, value);
            }
            bench
        }

        fn write(&mut self, address: u8, value: u16) {
            let [high, low] = value.to_be_bytes();
            assert!(self.chip.start(false));
            assert!([address, high, low].into_iter().all(|byte| self.chip.write(byte)));
            self.chip.stop();
        }

        fn read(&mut self, address: u8) -> u16 {
            assert!(self.chip.start(false) && self.chip.write(address) && self.chip.start(true));
            let word = u16::from_be_bytes([self.chip.read(), self.chip.read()]);
            self.chip.stop();
            word
        }

        fn data(&mut self) -> u32 {
            u32::from(self.read(DATA0_MSB)) << 16 | u32::from(self.read(DATA0_LSB))
        }

        fn hz(&mut self) -> f64 {
            let data = self.data();
            assert_eq!(data >> 28, 0, "no errors");
            f64::from(data) / 268_435_456.0 * 12e6 * 2.0
        }

        fn wait_us(&mut self, us: u64) {
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + us * 50));
        }

        fn intb(&self) -> bool {
            self.intb.level(self.clock.now())
        }

        fn move_z(&mut self, mm: f64) {
            self.z.set_forward(mm > 0.0);
            for _ in 0..(mm.abs() * 400.0).round() as u32 {
                self.z.edge(true, self.clock.now());
            }
        }
    }

    #[test]
    fn it_wakes_with_the_data_sheet_s_values_and_asleep() {
        let mut bench = Bench::new();
        for (address, value) in [
            (MANUFACTURER_ID, 0x5449),
            (DEVICE_ID, 0x3055),
            (CONFIG, 0x2801),
            (MUX_CONFIG, 0x020f),
            (RCOUNT0, 0x0080),
            (STATUS, 0),
        ] {
            assert_eq!(bench.read(address), value, "{address:#x}");
        }
        bench.write(DEVICE_ID, 1);
        assert_eq!(bench.read(DEVICE_ID), 0x3055);
        bench.wait_us(1_000_000);
        assert_eq!((bench.read(STATUS), bench.intb()), (0, true));
        bench.write(RCOUNT0, 7);
        bench.write(RESET_DEV, RESET_DEV_BIT);
        assert_eq!(bench.read(RCOUNT0), 0x0080);
    }

    #[test]
    fn conversions_come_by_its_clock_and_each_is_reported_once() {
        let mut bench = Bench::set_up();
        // 5 ms to settle, then 2.5 ms.
        bench.wait_us(7_499);
        assert_eq!((bench.read(STATUS), bench.intb()), (0, true));
        bench.wait_us(2);
        assert!(!bench.intb());
        assert_eq!(bench.read(STATUS), STATUS_DRDY | STATUS_UNREADCONV0);
        assert!(bench.intb(), "reported");
        assert_eq!(bench.read(STATUS), STATUS_UNREADCONV0, "not yet read");
        bench.data();
        assert_eq!(bench.read(STATUS), 0);
        let mut ready = 0;
        for _ in 0..10_000 {
            bench.wait_us(100);
            if !bench.intb() {
                assert_eq!(bench.read(STATUS), STATUS_DRDY | STATUS_UNREADCONV0);
                bench.data();
                ready += 1;
            }
        }
        assert_eq!(ready, 399, "in a second, of 2500.33 us each");
    }

    #[test]
    fn the_frequency_follows_the_distance_and_the_bed_gives_way_to_the_nozzle() {
        let mut bench = Bench::set_up();
        bench.wait_us(10_000);
        let expected = |mm: f64| 3e6 + 3e5 * (-mm / 2.5).exp();
        let hz = bench.hz();
        assert!((hz - expected(14.0)).abs() < 0.1, "{hz}");
        bench.move_z(-12.0);
        let touching = bench.hz();
        assert!((touching - expected(2.0)).abs() < 0.1, "{touching}");
        bench.move_z(-0.1);
        let pressed = bench.hz();
        assert!((pressed - expected(1.99)).abs() < 0.1, "{pressed}");
        // DATA0_LSB still belongs to the DATA0_MSB before it.
        let high = bench.read(DATA0_MSB);
        bench.move_z(5.0);
        let data = u32::from(high) << 16 | u32::from(bench.read(DATA0_LSB));
        assert!((f64::from(data) / 268_435_456.0 * 24e6 - pressed).abs() < 0.2);
    }

    #[test]
    fn errors_stand_in_the_data() {
        let mut bench = Bench::set_up();
        bench.wait_us(10_000);
        bench.write(DRIVE_CURRENT0, 7 << 11);
        assert_eq!(bench.data() >> 28, 1, "amplitude too low");
        bench.write(DRIVE_CURRENT0, 31 << 11);
        assert_eq!(bench.data() >> 28, 1, "and too high");
        bench.write(DRIVE_CURRENT0, 0);
        assert_eq!(bench.data(), ERR_WD);
        bench.write(DRIVE_CURRENT0, 15 << 11);
        bench.write(CLOCK_DIVIDERS0, 1 << 12 | 1);
        bench.wait_us(10_000);
        assert_eq!(bench.data() >> 28, 4, "3 MHz of 12");
        bench.write(ERROR_CONFIG, 0);
        bench.wait_us(10_000);
        assert_eq!(bench.data() >> 28, 0, "nobody wants to know");
    }

    #[test]
    fn it_finds_the_drive_current_by_itself() {
        let mut bench = Bench::set_up();
        assert_eq!(bench.read(DRIVE_CURRENT0) >> 6 & 0x1f, 0);
        bench.write(CONFIG, 1 | REF_CLK_SRC);
        assert_eq!(bench.read(DRIVE_CURRENT0) >> 6 & 0x1f, 15);
    }
}
