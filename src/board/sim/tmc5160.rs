// SPDX-License-Identifier: GPL-3.0-or-later
//! The stepper driver TMC5160 in its step and direction mode, after its data sheet (Trinamic,
//! TMC5160A, rev. 1.14: "SPI Interface", "Register Mapping", "Sine-Wave Look-up Table").
//!
//! A datagram has 40 bits: an address, with bit 7 set to write, and 32 bits of data. What comes
//! back is a status byte, and what the datagram *before* this one asked for. The chip keeps what it
//! was told until its power is off, whatever the machine is reset.
//!
//! Simulated: every register with its access and its reset value, the microstep counter and the
//! currents of the wave table, standstill and the time between steps, the inputs. The motor is
//! simulated by its [`Axis`], which turns whether the chip's power stage is on or not and however
//! many microsteps the chip is told to make, so that a host may do without the chip; of the set-up
//! only the edges that are steps (DEDGE) are the axis's, too. Not simulated: loads, temperatures
//! and faults, the automatic tuning of StealthChop, and the ramp generator and encoder (their
//! registers keep what is written).

#![forbid(unsafe_code)]

use std::sync::Arc;

use serde::Deserialize;

use super::config::{PinName, SimConfig, SimError, wrong};
use super::part::{Part, Socket, Workshop};
use super::physics::Axis;
use super::printer_cfg::{Layout, Sections};
use super::spi::SpiChip;
use crate::time::{CLOCK_FREQ, Clock, TimeSource};

/// CPOL and CPHA are 1.
const MODE: u8 = 3;
/// The internal clock.
const CLOCK_HZ: u64 = 12_000_000;
/// TSTEP at standstill; also the clocks without a step after which the motor stands still.
const STANDSTILL: u32 = 0xf_ffff;
const DATAGRAM_BYTES: usize = 5;
const WRITE: u8 = 0x80;

const GCONF: u8 = 0x00;
const GSTAT: u8 = 0x01;
const IOIN: u8 = 0x04;
const IHOLD_IRUN: u8 = 0x10;
const TSTEP: u8 = 0x12;
const MSLUT: u8 = 0x60;
const MSLUTSEL: u8 = 0x68;
const MSLUTSTART: u8 = 0x69;
const MSCNT: u8 = 0x6a;
const MSCURACT: u8 = 0x6b;
const CHOPCONF: u8 = 0x6c;
const DRV_STATUS: u8 = 0x6f;
const PWMCONF: u8 = 0x70;
const PWM_AUTO: u8 = 0x72;

/// FCLKTRIM as the factory wrote it to the chip.
const OTP: u32 = 0x0f;
/// IOIN: VERSION, and SD_MODE, which is wired high for steps and directions.
const VERSION: u32 = 0x30 << 24;
const SD_MODE: u32 = 1 << 6;
const GCONF_EN_PWM_MODE: u32 = 1 << 2;
const GCONF_SHAFT: u32 = 1 << 4;
const GSTAT_DRV_ERR: u32 = 1 << 1;
const CHOPCONF_DEDGE: u32 = 1 << 29;

/// What the host may do with a register.
#[derive(Clone, Copy, PartialEq)]
enum Access {
    /// It reads as zero.
    Write,
    Read,
    ReadWrite,
    /// Ones that are written clear their bits.
    ReadClear,
}

/// A register: its address, access, the bits that it has, and its value at power-up.
struct Register(u8, Access, u32, u32);

use Access::{Read as R, ReadClear as C, ReadWrite as RW, Write as W};

/// What is at no address here reads as zero.
const REGISTERS: &[Register] = &[
    Register(GCONF, RW, 18, 0x0000_0008),
    Register(GSTAT, C, 3, 0x0000_0001),
    Register(0x02, R, 8, 0),            // IFCNT: of the UART, which is not in use
    Register(0x03, W, 12, 0),           // SLAVECONF
    Register(IOIN, R, 32, 0),           // computed
    Register(0x05, W, 32, 0),           // X_COMPARE
    Register(0x06, W, 16, 0),           // OTP_PROG: is done in a factory, not here
    Register(0x07, R, 8, OTP),          // OTP_READ
    Register(0x08, RW, 5, OTP),         // FACTORY_CONF: starts as the OTP has it
    Register(0x09, W, 19, 0x0001_0606), // SHORT_CONF
    Register(0x0a, W, 22, 0x0008_0400), // DRV_CONF
    Register(0x0b, W, 8, 0),            // GLOBALSCALER
    Register(0x0c, R, 16, 0),           // OFFSET_READ
    Register(IHOLD_IRUN, W, 20, 0),
    Register(0x11, W, 8, 10),           // TPOWERDOWN
    Register(TSTEP, R, 20, 0),          // computed
    Register(0x13, W, 20, 0),           // TPWMTHRS
    Register(0x14, W, 20, 0),           // TCOOLTHRS
    Register(0x15, W, 20, 0),           // THIGH
    Register(0x20, RW, 2, 0),           // RAMPMODE
    Register(0x21, RW, 32, 0),          // XACTUAL
    Register(0x22, R, 24, 0),           // VACTUAL
    Register(0x23, W, 18, 0),           // VSTART
    Register(0x24, W, 16, 0),           // A1
    Register(0x25, W, 20, 0),           // V1
    Register(0x26, W, 16, 0),           // AMAX
    Register(0x27, W, 23, 0),           // VMAX
    Register(0x28, W, 16, 0),           // DMAX
    Register(0x2a, W, 16, 0),           // D1
    Register(0x2b, W, 18, 1),           // VSTOP
    Register(0x2c, W, 16, 0),           // TZEROWAIT
    Register(0x2d, RW, 32, 0),          // XTARGET
    Register(0x33, W, 23, 0),           // VDCMIN
    Register(0x34, RW, 12, 0),          // SW_MODE
    Register(0x35, C, 14, 0),           // RAMP_STAT
    Register(0x36, R, 32, 0),           // XLATCH
    Register(0x38, RW, 11, 0),          // ENCMODE
    Register(0x39, RW, 32, 0),          // X_ENC
    Register(0x3a, W, 32, 0x0001_0000), // ENC_CONST
    Register(0x3b, C, 2, 0),            // ENC_STATUS
    Register(0x3c, R, 32, 0),           // ENC_LATCH
    Register(0x3d, W, 20, 0),           // ENC_DEVIATION
    Register(MSLUT, W, 32, 0xaaaa_b554),
    Register(0x61, W, 32, 0x4a95_54aa), // MSLUT1 to 7
    Register(0x62, W, 32, 0x2449_2929),
    Register(0x63, W, 32, 0x1010_4222),
    Register(0x64, W, 32, 0xfbff_ffff),
    Register(0x65, W, 32, 0xb5bb_777d),
    Register(0x66, W, 32, 0x4929_5556),
    Register(0x67, W, 32, 0x0040_4222),
    Register(MSLUTSEL, W, 32, 0xffff_8056),
    Register(MSLUTSTART, W, 24, 0x00f7_0000),
    Register(MSCNT, R, 10, 0),    // computed
    Register(MSCURACT, R, 25, 0), // computed
    Register(CHOPCONF, RW, 32, 0x1041_0150),
    Register(0x6d, W, 25, 0),       // COOLCONF
    Register(0x6e, W, 24, 0),       // DCCTRL
    Register(DRV_STATUS, R, 32, 0), // computed
    Register(PWMCONF, W, 32, 0xc40c_001e),
    Register(0x71, R, 25, 0),     // PWM_SCALE
    Register(PWM_AUTO, R, 24, 0), // computed
    Register(0x73, R, 20, 0),     // LOST_STEPS: counts in DcStep mode only
];

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tmc5160Config {
    /// Its SPI bus.
    pub bus: String,
    /// Low selects it; without it, it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// The axis whose motor it drives.
    pub axis: String,
}

impl Part for Tmc5160Config {
    fn name(&self) -> String {
        format!("tmc5160 {}", self.axis)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn validate(&self, whose: &str, printer: &SimConfig) -> Result<(), SimError> {
        if !printer.axes.iter().any(|axis| axis.name == self.axis) {
            return wrong(whose, "axis", &format!("there is no `{}`", self.axis), "name an [[axis]]");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), SimError> {
        if let Some(axis) = workshop.axis(&self.axis) {
            workshop.solder_spi(self, Tmc5160::new(axis, workshop.time.clone()));
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("tmc5160 {}", layout.stepper(&self.axis)));
        cfg.comment("May be left out, as the motor turns without; then start Pinion anew: the chip keeps");
        cfg.comment("what it was told.");
        cfg.spi(&self.bus, self.select_pin.as_ref());
        cfg.key("run_current", 0.8);
        cfg.key("sense_resistor", 0.075);
    }
}

/// The chip.
struct Tmc5160 {
    axis: Arc<Axis>,
    clock: Arc<dyn TimeSource>,
    /// By address.
    registers: [u32; 128],
    /// The shift register of 40 bits, and the bytes that came in since the chip was selected.
    shift: u64,
    bytes: usize,
    /// What the next datagram brings back.
    reply: u32,
    /// Where the microstep counter stood at a step of the axis; it goes on from there.
    origin: (i64, u32),
    /// When which step of the axis was seen, and the clocks between two of 256 microsteps.
    seen: (Clock, i64),
    tstep: u32,
}

impl Tmc5160 {
    /// The driver of an axis, at power-up.
    fn new(axis: Arc<Axis>, clock: Arc<dyn TimeSource>) -> Tmc5160 {
        let mut registers = [0; 128];
        for Register(address, _, _, value) in REGISTERS {
            registers[usize::from(*address)] = *value;
        }
        let step = axis.turned_steps();
        let seen = (clock.now(), step);
        Tmc5160 { axis, clock, registers, shift: 0, bytes: 0, reply: 0, origin: (step, 0), seen, tstep: STANDSTILL }
    }

    fn get(&self, address: u8) -> u32 {
        self.registers[usize::from(address & !WRITE)]
    }

    fn is_set(&self, address: u8, bit: u32) -> bool {
        self.get(address) & bit != 0
    }

    /// What a host reads.
    fn read(&self, address: u8) -> u32 {
        match address {
            IOIN => {
                let inputs = [self.axis.is_stepped(), self.axis.is_dir_high()].map(u32::from);
                // DRV_ENN switches the power stage off.
                let off = u32::from(!self.axis.is_enabled());
                VERSION | SD_MODE | off << 4 | inputs[1] << 1 | inputs[0]
            }
            TSTEP => self.tstep,
            MSCNT => self.mscnt(),
            MSCURACT => {
                let current = |microstep| self.wave(microstep) as u32 & 0x1ff;
                current(self.mscnt() + 256) << 16 | current(self.mscnt())
            }
            DRV_STATUS => {
                let stealth = u32::from(self.is_set(GCONF, GCONF_EN_PWM_MODE));
                let current = self.get(IHOLD_IRUN) >> if self.stands_still() { 0 } else { 8 } & 0x1f;
                u32::from(self.stands_still()) << 31 | current << 16 | stealth << 14
            }
            // PWM_GRAD and PWM_OFS, from which the tuning starts.
            PWM_AUTO => (self.get(PWMCONF) >> 8 & 0xff) << 16 | self.get(PWMCONF) & 0xff,
            _ => match REGISTERS.iter().find(|register| register.0 == address) {
                Some(Register(_, R | RW | C, ..)) => self.get(address),
                _ => 0,
            },
        }
    }

    fn write(&mut self, address: u8, data: u32) {
        let Some(Register(_, access, bits, _)) = REGISTERS.iter().find(|register| register.0 == address) else {
            return;
        };
        // What follows may change the counter's pace.
        self.origin = (self.axis.turned_steps(), self.mscnt());
        let value = &mut self.registers[usize::from(address)];
        match access {
            R => {}
            W | RW => *value = data & (u32::MAX >> (32 - bits)),
            C => *value &= !data,
        }
        if address == CHOPCONF {
            self.axis.set_both_edges(self.is_set(CHOPCONF, CHOPCONF_DEDGE));
        }
    }

    /// The size of a step as a power of two of 256th full steps (MRES).
    fn mres(&self) -> u32 {
        (self.get(CHOPCONF) >> 24 & 0xf).min(8)
    }

    /// The place in the wave table, 1024 to four full steps: it goes up while DIR is low.
    fn mscnt(&self) -> u32 {
        let (step, mscnt) = self.origin;
        let went = self.axis.turned_steps().wrapping_sub(step) << self.mres();
        let went = if self.is_set(GCONF, GCONF_SHAFT) { went.wrapping_neg() } else { went };
        i64::from(mscnt).wrapping_add(went) as u32 & 0x3ff
    }

    /// The wave's value, -255 to 255, at a place in the wave table. The table has the increments
    /// from each place of the first quarter to the next, in four segments of their own widths.
    fn wave(&self, microstep: u32) -> i32 {
        let (quarter, place) = (microstep >> 8 & 3, microstep & 0xff);
        let place = if quarter & 1 == 0 { place } else { 256 - place };
        let select = self.get(MSLUTSEL);
        let bounds = [select >> 8, select >> 16, select >> 24].map(|bound| bound & 0xff);
        let increment = |at: u32| {
            let segment = bounds.iter().filter(|bound| at >= **bound).count() as u32;
            let width = select >> (2 * segment) & 3;
            let bit = self.get(MSLUT + (at / 32) as u8) >> (at % 32) & 1;
            (width + bit) as i32 - 1
        };
        let start = self.get(MSLUTSTART);
        let value = match place {
            256 => (start >> 16 & 0xff) as i32,
            _ => (start & 0xff) as i32 + (0..place).map(increment).sum::<i32>(),
        };
        if quarter < 2 { value } else { -value }
    }

    fn stands_still(&self) -> bool {
        self.tstep == STANDSTILL
    }

    /// Looks how far the motor went since the last look.
    fn look(&mut self) {
        let (now, step) = (self.clock.now(), self.axis.turned_steps());
        let (at, from) = self.seen;
        let ticks = now.since(at).max(0) as u64;
        let clocks = ticks.saturating_mul(CLOCK_HZ) / u64::from(CLOCK_FREQ);
        let microsteps = step.abs_diff(from).saturating_mul(1 << self.mres());
        if let Some(each) = clocks.checked_div(microsteps) {
            self.tstep = u32::try_from(each).unwrap_or(STANDSTILL).min(STANDSTILL);
            self.seen = (now, step);
        } else if clocks > u64::from(STANDSTILL) {
            self.tstep = STANDSTILL;
        }
    }

    fn status(&self) -> u8 {
        let driver_error = self.is_set(GSTAT, GSTAT_DRV_ERR);
        u8::from(self.stands_still()) << 3 | u8::from(driver_error) << 1 | u8::from(self.is_set(GSTAT, 1))
    }
}

impl SpiChip for Tmc5160 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == MODE
    }

    fn select(&mut self, _rate_hz: u32) {
        self.look();
        self.shift = u64::from(self.status()) << 32 | u64::from(self.reply);
        self.bytes = 0;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let [.., out, _, _, _, _] = self.shift.to_be_bytes();
        self.shift = self.shift << 8 | u64::from(byte);
        self.bytes += 1;
        out
    }

    /// Of a longer datagram the last 40 bits count (the others are those of chips behind this one
    /// in a chain); a shorter one is none.
    fn deselect(&mut self) {
        if self.bytes < DATAGRAM_BYTES {
            return;
        }
        let [.., address, d3, d2, d1, d0] = self.shift.to_be_bytes();
        let data = u32::from_be_bytes([d3, d2, d1, d0]);
        self.reply = if address & WRITE == 0 {
            self.read(address)
        } else {
            self.write(address & !WRITE, data);
            data
        };
    }
}

#[cfg(test)]
mod tests {
    use super::super::SimConfig;
    use super::*;
    use crate::time::VirtualClock;

    struct Bench {
        axis: Arc<Axis>,
        clock: VirtualClock,
        chip: Tmc5160,
    }

    impl Bench {
        fn new() -> Bench {
            let clock = VirtualClock::at(Clock::from_ticks(0));
            let axis = Arc::new(Axis::new(&SimConfig::default_printer().axes[2]));
            let chip = Tmc5160::new(axis.clone(), Arc::new(clock.clone()));
            Bench { axis, clock, chip }
        }

        fn transfer(&mut self, bytes: &[u8]) -> Vec<u8> {
            self.chip.select(1_000_000);
            let reply = bytes.iter().map(|byte| self.chip.exchange(*byte)).collect();
            self.chip.deselect();
            reply
        }

        fn datagram(&mut self, address: u8, data: u32) -> (u8, u32) {
            let [d3, d2, d1, d0] = data.to_be_bytes();
            let reply = self.transfer(&[address, d3, d2, d1, d0]);
            (reply[0], u32::from_be_bytes(reply[1..].try_into().unwrap()))
        }

        fn write(&mut self, address: u8, data: u32) {
            self.datagram(address | WRITE, data);
        }

        fn read(&mut self, address: u8) -> u32 {
            self.datagram(address, 0);
            self.datagram(address, 0).1
        }

        fn advance_ms(&self, ms: u64) {
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + ms * u64::from(CLOCK_FREQ) / 1000));
        }

        /// Pulses of the step pin.
        fn steps(&self, count: u32) {
            self.axis.set_enabled(true);
            for _ in 0..count {
                self.axis.edge(true, self.clock.now());
                self.axis.edge(false, self.clock.now());
            }
        }
    }

    #[test]
    fn a_read_comes_back_with_the_next_datagram_and_a_write_comes_back_itself() {
        let mut bench = Bench::new();
        assert_eq!(bench.datagram(IOIN, 0), (0x09, 0), "standstill and reset");
        assert_eq!(bench.datagram(CHOPCONF, 0).1, 0x3000_0050);
        assert_eq!(bench.datagram(GCONF | WRITE, 0x1234_5678).1, 0x1041_0150);
        assert_eq!(bench.datagram(GCONF, 0).1, 0x1234_5678, "what was written, though it has 18 bits");
        assert_eq!(bench.datagram(GCONF, 0).1, 0x0000_5678);
    }

    #[test]
    fn registers_are_read_and_written_as_their_access_says() {
        let mut bench = Bench::new();
        assert_eq!(bench.read(GSTAT), 1);
        bench.write(GSTAT, 0b110);
        assert_eq!(bench.read(GSTAT), 1);
        bench.write(GSTAT, 0b001);
        assert_eq!((bench.read(GSTAT), bench.datagram(GSTAT, 0).0), (0, 0x08));
        bench.write(IOIN, u32::MAX);
        assert_eq!(bench.read(IOIN), 0x3000_0050);
        bench.write(0x07, u32::MAX);
        assert_eq!(bench.read(0x07), OTP);
        bench.write(IHOLD_IRUN, 0x0006_1f08);
        assert_eq!(bench.read(IHOLD_IRUN), 0, "write only");
        assert_eq!(bench.read(DRV_STATUS), 0x8008_0000, "standstill at IHOLD");
        bench.write(0x7f, 5);
        assert_eq!(bench.read(0x7f), 0, "there is none");
        assert_eq!(bench.read(PWM_AUTO), 0x1e);
        bench.write(PWMCONF, 0x1234);
        assert_eq!(bench.read(PWM_AUTO), 0x0012_0034);
    }

    #[test]
    fn a_long_datagram_passes_on_and_a_short_one_is_none() {
        let mut bench = Bench::new();
        let reply = bench.transfer(&[1, 2, 3, 4, 5, GCONF | WRITE, 0, 0, 0, 4]);
        assert_eq!(reply, [0x09, 0, 0, 0, 0, 1, 2, 3, 4, 5], "to the next chip of the chain");
        assert_eq!(bench.read(GCONF), 4);
        bench.transfer(&[GCONF | WRITE, 0, 0, 0]);
        assert_eq!(bench.read(GCONF), 4);
    }

    #[test]
    fn the_motor_is_seen_to_move_and_to_stand() {
        let mut bench = Bench::new();
        bench.write(CHOPCONF, 0x1041_0150 | 4 << 24);
        bench.write(IHOLD_IRUN, 31 << 8 | 8);
        bench.axis.set_forward(true);
        bench.advance_ms(16);
        bench.steps(10);
        // 192000 clocks and 160 microsteps of 1/256.
        assert_eq!(bench.read(TSTEP), 1200);
        assert_eq!(bench.read(DRV_STATUS), 0x001f_0000);
        assert_eq!(bench.read(IOIN), 0x3000_0042);
        assert_eq!(bench.read(MSCNT), 1024 - 160, "DIR is high");
        // The counter goes on from there in steps of another size, and backwards.
        bench.write(CHOPCONF, 0x1041_0150 | 8 << 24);
        bench.steps(3);
        bench.write(GCONF, GCONF_SHAFT);
        bench.write(CHOPCONF, 0x1041_0150);
        bench.steps(5);
        assert_eq!(bench.read(MSCNT), 1024 - 160 - 3 * 256 + 5);
        bench.advance_ms(90);
        assert_eq!(bench.read(TSTEP), STANDSTILL);
        assert_eq!(bench.read(DRV_STATUS), 0x8008_0000);
    }

    #[test]
    fn with_dedge_each_edge_is_a_step() {
        let mut bench = Bench::new();
        let start = bench.axis.position_steps();
        bench.axis.set_forward(true);
        bench.steps(3);
        assert_eq!(bench.axis.position_steps(), start + 3);
        bench.write(CHOPCONF, 0x1041_0150 | CHOPCONF_DEDGE);
        bench.steps(3);
        assert_eq!(bench.axis.position_steps(), start + 9);
    }

    #[test]
    fn the_wave_table_of_power_up_is_a_sine() {
        let bench = Bench::new();
        for microstep in 0..1024 {
            let angle = f64::from(microstep) * std::f64::consts::TAU / 1024.0;
            let value = f64::from(bench.chip.wave(microstep));
            assert!((value - 247.5 * angle.sin()).abs() < 1.5, "{microstep}: {value}");
        }
        let peak = bench.chip.get(MSLUTSTART) >> 16;
        assert_eq!(bench.chip.read(MSCURACT), peak << 16, "START_SIN90, and a sine of 0");
    }
}
