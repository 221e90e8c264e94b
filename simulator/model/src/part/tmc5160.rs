// SPDX-License-Identifier: GPL-3.0-or-later
//! The stepper driver TMC5160 in its step and direction mode, after its data sheet (Trinamic, TMC5160A, rev. 1.14: "SPI
//! Interface", "Register Mapping", "Sine-Wave Look-up Table").
//!
//! A datagram has 40 bits: an address, with bit 7 set to write, and 32 bits of data. The answer is a status byte and
//! the data that the *previous* datagram asked for. The chip keeps its settings until its power is off, even if the MCU
//! is reset.
//!
//! Simulated: every register with its access and its reset value, the microstep counter and the currents of the wave
//! table, standstill and the time between steps, the inputs, StallGuard, DIAG0 and DIAG1 (`trinamic/`). The [`Axis`]
//! simulates the motor. It turns whether or not the chip's power stage is on, and for any microstep setting. So a host
//! can omit the chip's section. Only one setting affects the axis: which edges are steps (DEDGE).
//!
//! Not simulated: CoolStep, temperatures and faults, the automatic tuning of StealthChop, and the ramp generator
//! and encoder (their registers keep what is written).

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::trinamic::registers::{
    CHOPCONF, COOLCONF, DRV_STATUS, GCONF, GSTAT, IFCNT, MSCNT, MSCURACT, MSLUT, MSLUTSEL, MSLUTSTART, PWM_AUTO,
    SLAVECONF, SPI_IOIN as IOIN, TCOOLTHRS, TPWMTHRS, TSTEP, current, has_both_edges, mres, of_model, pwm_auto,
};
use super::trinamic::{
    FULL_LOAD, Motor, STANDSTILL, StallOutput, StallRule, Wave, may_be_left_out, offer_sensorless_homing,
};
use super::uart::{UartChip, check_pins, select_keys, send_delay};
use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Trouble, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::motion::Axis;
use crate::engine::register_map::RegisterMap;
use crate::engine::spi::{ShiftRegister, SpiChip};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{Clock, TimeSource};

/// CPOL and CPHA are 1.
const MODE: u8 = 3;
const WRITE: u8 = 0x80;

/// IOIN: VERSION, and SD_MODE, which is wired high for the step and direction mode.
const VERSION: u32 = 0x30 << 24;
const VERSION_2130: u32 = 0x11 << 24;
const VERSION_2240: u32 = 0x40 << 24;
const SD_MODE: u32 = 1 << 6;
const GCONF_EN_PWM_MODE: u32 = 1 << 2;
const GCONF_SHAFT: u32 = 1 << 4;
/// Of DIAG0 and DIAG1.
const GCONF_DIAG_STALL: [u32; 2] = [1 << 7, 1 << 8];
const GCONF_DIAG_PUSHPULL: [u32; 2] = [1 << 12, 1 << 13];
const GSTAT_DRV_ERR: u32 = 1 << 1;
const DRV_STATUS_STALLGUARD: u32 = 1 << 24;

/// SG_RESULT of a free motor with SGT at 0, its decrease at full load, and its increase with each step of SGT. These
/// are values of a common motor: the data sheet gives no formula.
const SG_FREE: i32 = 200;
const SG_FALL: i32 = 300;
const SG_PER_SGT: i32 = 10;
/// Longest chain of drivers.
const CHAIN_MAX: usize = 32;

/// A driver TMC5160.
pub type Tmc5160Config = SpiDriverConfig<5160>;
/// A driver TMC2130.
pub type Tmc2130Config = SpiDriverConfig<2130>;
/// A driver TMC2240.
pub type Tmc2240Config = SpiDriverConfig<2240>;

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpiDriverConfig<const MODEL: u16> {
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// The axis with the motor that it drives.
    pub axis: String,
    /// DIAG1, an open drain with a pull-up resistor: low while the motor is stalled.
    pub diag1_pin: Option<PinName>,
    /// DIAG0, an open drain too, with the same meaning if the host asks for it.
    pub diag0_pin: Option<PinName>,
    /// Its place in a chain of drivers with one select pin; 1 is the one at the data output.
    pub chain_position: Option<usize>,
    /// The number of drivers in that chain.
    pub chain_length: Option<usize>,
    /// SG_RESULT of a free motor with SGT at 0. Each step of SGT adds 10. A motor with full load has 300 less.
    #[serde(default = "default_sg_free")]
    pub sg_free: i32,
}

fn default_sg_free() -> i32 {
    SG_FREE
}

impl<const MODEL: u16> SpiDriverConfig<MODEL> {
    /// The `sg_free` of a motor for which this SGT is right: with it, a free motor has the usual SG_RESULT.
    pub fn free_with_sgt(sgt: i32) -> i32 {
        SG_FREE - SG_PER_SGT * sgt
    }
}

impl<const MODEL: u16> Part for SpiDriverConfig<MODEL> {
    fn name(&self) -> String {
        format!("tmc{MODEL} {}", self.axis)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("diag1_pin", self.diag1_pin.as_ref()), ("diag0_pin", self.diag0_pin.as_ref())]
    }

    fn chain(&self) -> Option<(usize, usize)> {
        Some((self.chain_position?.checked_sub(1)?, self.chain_length?))
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        let is_right = |place: usize, length: usize| (1..=length).contains(&place) && length <= CHAIN_MAX;
        match (self.chain_position, self.chain_length) {
            (None, None) => {}
            (Some(place), Some(length)) if is_right(place, length) && self.select_pin.is_some() => {}
            _ => {
                let remedy = format!("give both, 1 to {CHAIN_MAX}, and a select_pin");
                return wrong(whose, "chain_position", "it needs a place within chain_length", &remedy);
            }
        }
        check_sg_free(whose, self.sg_free)?;
        printer.check_axis(whose, &self.axis)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(axis) = workshop.axis(&self.axis) {
            let chip = Tmc5160::new(self.name(), (MODEL, self.sg_free), axis, workshop.clock.clone());
            chip.wire_diags(workshop, [&self.diag0_pin, &self.diag1_pin]);
            workshop.solder_spi(self, chip);
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("tmc{MODEL} {}", layout.stepper(&self.axis)));
        may_be_left_out(cfg);
        cfg.spi(&self.bus, self.select_pin.as_ref());
        cfg.key_if("chain_position", self.chain_position);
        cfg.key_if("chain_length", self.chain_length);
        cfg.key("run_current", 0.8);
        match MODEL {
            2240 => cfg.key("rref", 12000),
            2130 => cfg.key("sense_resistor", 0.11),
            _ => cfg.key("sense_resistor", 0.075),
        }
        stall_output(cfg, layout, &format!("tmc{MODEL}"), &self.axis, self.diag1_pin.as_ref());
    }
}

/// A driver TMC2240 on its UART.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tmc2240UartConfig {
    /// The wire for both directions; with `tx_pin` it is the board's receiving end.
    pub uart_pin: PinName,
    /// The board's sending end, joined to the wire by a resistor.
    pub tx_pin: Option<PinName>,
    /// The lines of a multiplexer that connect it to the wire, each at its level: `!` for low.
    #[serde(default)]
    pub select_pins: Vec<PinName>,
    /// Its address, 0 to 7, by its pins.
    #[serde(default)]
    pub address: u8,
    /// The axis with the motor that it drives.
    pub axis: String,
    /// DIAG1, an open drain with a pull-up resistor: low while the motor is stalled.
    pub diag1_pin: Option<PinName>,
    /// DIAG0, an open drain too, with the same meaning if the host asks for it.
    pub diag0_pin: Option<PinName>,
    /// SG_RESULT of a free motor with SGT at 0. Each step of SGT adds 10. A motor with full load has 300 less.
    #[serde(default = "default_sg_free")]
    pub sg_free: i32,
}

impl Part for Tmc2240UartConfig {
    fn name(&self) -> String {
        format!("tmc2240 {}", self.axis)
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("diag1_pin", self.diag1_pin.as_ref()), ("diag0_pin", self.diag0_pin.as_ref())]
    }

    fn select_pins(&self) -> &[PinName] {
        &self.select_pins
    }

    fn uart_pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("uart_pin", Some(&self.uart_pin)), ("tx_pin", self.tx_pin.as_ref())]
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        if self.address > 7 {
            return wrong(whose, "address", &format!("{} is not an address", self.address), "give 0 to 7");
        }
        check_pins(whose, self.uart_pins())?;
        check_sg_free(whose, self.sg_free)?;
        printer.check_axis(whose, &self.axis)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(axis) = workshop.axis(&self.axis) {
            let mut chip = Tmc5160::new(self.name(), (2240, self.sg_free), axis, workshop.clock.clone());
            chip.address = self.address;
            chip.wire_diags(workshop, [&self.diag0_pin, &self.diag1_pin]);
            workshop.solder_uart(self, chip);
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("tmc2240 {}", layout.stepper(&self.axis)));
        may_be_left_out(cfg);
        cfg.key("uart_pin", &self.uart_pin);
        cfg.key_if("tx_pin", self.tx_pin.as_ref());
        select_keys(cfg, &self.select_pins);
        cfg.key("uart_address", self.address);
        cfg.key("run_current", 0.8);
        cfg.key("rref", 12000);
        stall_output(cfg, layout, "tmc2240", &self.axis, self.diag1_pin.as_ref());
    }
}

/// The key for DIAG1, and homing by it.
fn stall_output(cfg: &mut Sections, layout: &Layout<'_>, driver: &str, axis: &str, diag1_pin: Option<&PinName>) {
    if let Some(pin) = diag1_pin {
        // An open drain: a low level reports a stall.
        let inverted = if pin.inverted { "" } else { "!" };
        cfg.key("diag1_pin", format_args!("^{inverted}{}", pin.name));
        offer_sensorless_homing(cfg, layout, driver, axis, ("driver_SGT", 0));
    }
}

fn check_sg_free(whose: &str, sg_free: i32) -> Result<(), Trouble> {
    match sg_free {
        -1000..=1000 => Ok(()),
        _ => wrong(whose, "sg_free", &format!("{sg_free} is not an SG_RESULT"), "give -1000 to 1000"),
    }
}

struct Tmc5160 {
    model: u16,
    /// SG_RESULT of the free motor with SGT at 0.
    sg_free: i32,
    motor: Motor,
    time: Arc<dyn TimeSource>,
    /// DIAG0 and DIAG1.
    diag: [Arc<StallOutput>; 2],
    registers: RegisterMap<u32>,
    shift: ShiftRegister<5>,
    /// The data that the next datagram returns.
    reply: u32,
    /// Its address on the UART, and the number of messages that wrote a register.
    address: u8,
    written: u8,
}

impl Tmc5160 {
    /// The driver of an axis, at power-up.
    fn new(name: String, (model, sg_free): (u16, i32), axis: Arc<Axis>, time: Arc<dyn TimeSource>) -> Tmc5160 {
        let registers = of_model(model);
        let diag = [0, 1]
            .map(|pin| Arc::new(StallOutput::new(name.clone(), axis.clone(), stall_rule(&registers, sg_free, pin))));
        let motor = Motor::new(axis);
        let (shift, reply, address, written) = (ShiftRegister::load([0; 5]), 0, 0, 0);
        let mut chip = Tmc5160 { model, sg_free, motor, time, diag, registers, shift, reply, address, written };
        chip.set_up_motor();
        chip
    }

    /// Wires DIAG0 and DIAG1.
    fn wire_diags(&self, workshop: &mut Workshop<'_>, pins: [&Option<PinName>; 2]) {
        for (pin, diag) in pins.into_iter().zip(&self.diag) {
            workshop.wire_shared(pin.as_ref(), diag.clone());
        }
    }

    fn set_up_motor(&mut self) {
        self.motor.set_up(mres(&self.registers), self.registers.is_set(GCONF, GCONF_SHAFT));
    }

    /// The value that a host reads.
    fn read(&mut self, address: u8) -> u32 {
        let now = self.time.now();
        match address {
            IOIN => {
                let inputs = [self.motor.axis.is_stepped(), self.motor.axis.is_dir_high()].map(u32::from);
                // DRV_ENN switches the power stage off.
                let off = u32::from(!self.motor.axis.is_enabled());
                let version = match self.model {
                    2130 => VERSION_2130,
                    2240 => VERSION_2240,
                    _ => VERSION,
                };
                version | SD_MODE | off << 4 | inputs[1] << 1 | inputs[0]
            }
            IFCNT => self.written.into(),
            TSTEP => self.motor.tstep(now),
            MSCNT => self.motor.mscnt(),
            MSCURACT => {
                let increments = std::array::from_fn(|n| self.registers.get(MSLUT + n as u8));
                let [segments, start] = [MSLUTSEL, MSLUTSTART].map(|address| self.registers.get(address));
                self.motor.currents(&Wave { increments, segments, start })
            }
            DRV_STATUS => self.drv_status(now),
            PWM_AUTO if self.model != 2130 => pwm_auto(&self.registers),
            _ => self.registers.read(address),
        }
    }

    fn write(&mut self, address: u8, data: u32) {
        self.registers.write(address, data);
        if matches!(address, GCONF | CHOPCONF) {
            self.set_up_motor();
            self.motor.axis.set_both_edges(has_both_edges(&self.registers));
        }
        for (pin, diag) in self.diag.iter().enumerate() {
            diag.set(stall_rule(&self.registers, self.sg_free, pin));
        }
    }

    fn drv_status(&self, now: Clock) -> u32 {
        let tstep = self.motor.tstep(now);
        let stands = tstep == STANDSTILL;
        let stealth = self.registers.is_set(GCONF, GCONF_EN_PWM_MODE) && tstep >= self.registers.get(TPWMTHRS);
        let mut status = u32::from(stands) << 31 | current(&self.registers, stands) << 16 | u32::from(stealth) << 14;
        // Only SpreadCycle measures the load.
        if !stealth && !stands {
            let fall = SG_FALL * self.motor.load(now) as i32 / FULL_LOAD as i32;
            let result = (self.sg_free + SG_PER_SGT * sgt(&self.registers) - fall).clamp(0, 0x3ff) as u32;
            status |= result | if result == 0 { DRV_STATUS_STALLGUARD } else { 0 };
        }
        status
    }

    fn status(&self) -> u8 {
        let now = self.time.now();
        let stalled = self.drv_status(now) & DRV_STATUS_STALLGUARD != 0;
        let driver_error = self.registers.is_set(GSTAT, GSTAT_DRV_ERR);
        let stands = self.motor.tstep(now) == STANDSTILL;
        let reset = self.registers.is_set(GSTAT, 1);
        u8::from(stands) << 3 | u8::from(stalled) << 2 | u8::from(driver_error) << 1 | u8::from(reset)
    }
}

/// SGT of COOLCONF, a signed number.
fn sgt(registers: &RegisterMap<u32>) -> i32 {
    let bits = (registers.get(COOLCONF) >> 16 & 0x7f) as i32;
    if bits < 0x40 { bits } else { bits - 0x80 }
}

/// When DIAG0 or DIAG1 reports a stall: SG_RESULT is 0, the velocity is at least TCOOLTHRS, and SpreadCycle is in use.
fn stall_rule(registers: &RegisterMap<u32>, sg_free: i32, pin: usize) -> StallRule {
    let is_set = |bit| registers.is_set(GCONF, bit);
    // The lowest load at which SG_RESULT is 0.
    let load = (sg_free + SG_PER_SGT * sgt(registers)) * FULL_LOAD as i32;
    let load = (load.max(0) as u32).div_ceil(SG_FALL as u32);
    let stealth_from = if is_set(GCONF_EN_PWM_MODE) { registers.get(TPWMTHRS) } else { STANDSTILL };
    StallRule {
        least_load: (is_set(GCONF_DIAG_STALL[pin]) && load <= FULL_LOAD && stealth_from > 0).then_some(load),
        fastest: 0,
        slowest: registers.get(TCOOLTHRS).min(stealth_from.saturating_sub(1)),
        mres: mres(registers).min(8),
        push_pull: is_set(GCONF_DIAG_PUSHPULL[pin]),
    }
}

/// A TMC2240's.
impl UartChip for Tmc5160 {
    fn address(&self) -> u8 {
        self.address
    }

    fn read_register(&mut self, register: u8, _now: Clock) -> u32 {
        self.read(register)
    }

    fn write_register(&mut self, register: u8, data: u32) {
        self.write(register, data);
        self.written = self.written.wrapping_add(1);
    }

    fn send_delay(&self) -> u64 {
        send_delay(self.registers.get(SLAVECONF))
    }
}

impl SpiChip for Tmc5160 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == MODE
    }

    fn select(&mut self, _rate_hz: u32) {
        let [d3, d2, d1, d0] = self.reply.to_be_bytes();
        self.shift = ShiftRegister::load([self.status(), d3, d2, d1, d0]);
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.shift.exchange(byte)
    }

    /// Only the last 40 bits of a longer datagram count. The others belong to chips behind this one in a chain. A
    /// shorter datagram has no effect.
    fn deselect(&mut self) {
        let Some([address, d3, d2, d1, d0]) = self.shift.message() else { return };
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
    use super::super::trinamic::registers::{ADC_35_C, IHOLD_IRUN, OTP, PWMCONF};
    use super::super::uart::crc8;
    use super::*;
    use crate::description::default::DefaultPrinter;
    use pinion_firmware::time::{CLOCK_FREQ, VirtualClock};

    struct Bench {
        axis: Arc<Axis>,
        clock: VirtualClock,
        chip: Tmc5160,
    }

    impl Bench {
        fn new() -> Bench {
            Bench::of(5160)
        }

        fn of(model: u16) -> Bench {
            let clock = VirtualClock::at(Clock::from_ticks(0));
            let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[2]));
            let chip = Tmc5160::new("z".into(), (model, SG_FREE), axis.clone(), Arc::new(clock.clone()));
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

        /// Pulses of the step pin, one every `ms` milliseconds.
        fn steps(&self, count: u32, ms: u64) {
            self.axis.set_enabled(true);
            for _ in 0..count {
                self.advance_ms(ms);
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
    fn each_model_has_its_version_and_its_registers() {
        for (model, version, chopconf, temperature) in
            [(5160, 0x30, 0x1041_0150, 0), (2130, 0x11, 0, 0), (2240, 0x40, 0x1041_0150, ADC_35_C)]
        {
            let mut bench = Bench::of(model);
            assert_eq!(bench.read(IOIN) >> 24, version, "{model}");
            assert_eq!(bench.read(CHOPCONF), chopconf, "{model}");
            assert_eq!(bench.read(0x51), temperature, "{model}");
        }
    }

    #[test]
    fn reading_clears_the_flags_of_a_tmc2130_only() {
        for (model, again) in [(2130, 0), (5160, 1), (2240, 1)] {
            let mut bench = Bench::of(model);
            assert_eq!(bench.read(GSTAT), 1, "{model}");
            assert_eq!(bench.read(GSTAT), again, "{model}");
        }
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
        bench.steps(10, 2);
        // 24000 clocks for 16 microsteps of 1/256.
        assert_eq!(bench.read(TSTEP), 1500);
        assert_eq!(bench.read(DRV_STATUS), 0x001f_00c8);
        assert_eq!(bench.read(IOIN), 0x3000_0042);
        assert_eq!(bench.read(MSCNT), 1024 - 160, "DIR is high");
        // The counter continues in steps of another size, and backwards.
        bench.write(CHOPCONF, 0x1041_0150 | 8 << 24);
        bench.steps(3, 1);
        bench.write(GCONF, GCONF_SHAFT);
        bench.write(CHOPCONF, 0x1041_0150);
        bench.steps(5, 1);
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
        bench.steps(3, 1);
        assert_eq!(bench.axis.position_steps(), start + 3);
        bench.write(CHOPCONF, 0x1041_0150 | 1 << 29);
        bench.steps(3, 1);
        assert_eq!(bench.axis.position_steps(), start + 9);
    }

    /// Half a full step against the end of the axis gives half of the full load.
    #[test]
    fn a_load_makes_sg_result_fall_and_sgt_makes_it_rise() {
        let mut bench = Bench::new();
        bench.write(CHOPCONF, 0x1041_0150 | 4 << 24);
        bench.axis.set_forward(false);
        // It stands at 12 mm and moves 2 mm beyond its end.
        bench.steps(14 * 400 + 8, 1);
        assert_eq!(bench.read(DRV_STATUS) & 0x3ff, 50);
        assert_eq!(bench.datagram(DRV_STATUS, 0).0 & 4, 0);
        bench.write(COOLCONF, 0x7c << 16);
        assert_eq!(bench.read(DRV_STATUS) & 0x3ff, 10, "SGT of -4");
        bench.write(COOLCONF, 0);
        bench.write(GCONF, GCONF_DIAG_STALL[1] | GCONF_DIAG_PUSHPULL[1]);
        bench.write(TCOOLTHRS, STANDSTILL);
        assert!(!bench.chip.diag[1].is_stalled(bench.clock.now()));
        bench.steps(3, 1);
        assert_eq!(bench.read(DRV_STATUS) & 0x0100_03ff, DRV_STATUS_STALLGUARD);
        assert_eq!(bench.datagram(DRV_STATUS, 0).0 & 4, 4);
        assert!(bench.chip.diag[1].is_stalled(bench.clock.now()));
        // StealthChop has no StallGuard.
        bench.write(GCONF, GCONF_DIAG_STALL[1] | GCONF_EN_PWM_MODE);
        assert_eq!(bench.read(DRV_STATUS) & 0x0100_03ff, 0);
        assert!(!bench.chip.diag[1].is_stalled(bench.clock.now()));
        bench.advance_ms(90);
        bench.write(GCONF, GCONF_DIAG_STALL[1]);
        assert!(!bench.chip.diag[1].is_stalled(bench.clock.now()), "it stands still");
    }

    #[test]
    fn a_tmc2240_on_its_uart_counts_what_it_was_written() {
        let mut bench = Bench::of(2240);
        bench.chip.address = 3;
        let now = bench.clock.now();
        let mut hear = |bytes: &[u8]| {
            let message = [bytes, &[crc8(bytes)]].concat();
            bench.chip.hear(&message, now).map(|answer| u32::from_be_bytes(answer[3..7].try_into().unwrap()))
        };
        assert_eq!(hear(&[0x05, 3, IOIN]).unwrap() >> 24, 0x40);
        assert_eq!(hear(&[0x05, 0, IOIN]), None, "another chip's address");
        assert_eq!(hear(&[0x05, 3, IFCNT]), Some(0));
        assert_eq!(hear(&[0x05, 3, TCOOLTHRS | WRITE, 0, 0, 1, 2]), None);
        assert_eq!((hear(&[0x05, 3, IFCNT]), hear(&[0x05, 3, TCOOLTHRS])), (Some(1), Some(0x102)));
    }
}
