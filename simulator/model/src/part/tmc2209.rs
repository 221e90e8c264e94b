// SPDX-License-Identifier: GPL-3.0-or-later
//! The stepper driver TMC2209 on its UART, after its data sheet (Trinamic, TMC2209, rev. 1.09: "UART
//! Single Wire Interface", "Register Map", "StallGuard4 Load Measurement").
//!
//! A message begins with a sync nibble, from which the chip measures the length of a bit. It then has the chip's
//! address, a register (with bit 7 set to write 32 bits to it), and a checksum. The chip answers a read after the bit
//! times of SENDDELAY. It counts the writes (IFCNT). It ignores a message that is for another address, or incomplete.
//!
//! Simulated: the UART by its edges; every register with its access and its reset value, the microstep counter and its
//! currents, standstill and the time between steps, the inputs, StallGuard and DIAG (`trinamic/`). The motor turns as
//! with a TMC5160 (`tmc5160.rs`). Not simulated: CoolStep, temperatures and faults, the automatic tuning of
//! StealthChop, the pulse generator (VACTUAL), INDEX, and the effects of the OTP memory.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::trinamic::registers::{
    CHOPCONF, DRV_STATUS, GCONF, IFCNT, MSCNT, MSCURACT, PWM_AUTO, SG_RESULT, SGTHRS, SLAVECONF, TCOOLTHRS, TPWMTHRS,
    TSTEP, UART_IOIN as IOIN, current, has_both_edges, mres, of_model, pwm_auto,
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
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::Clock;

/// IOIN: VERSION, and the level of PDN_UART, which is high after a message.
const VERSION: u32 = 0x21 << 24;
const VERSION_2208: u32 = 0x20 << 24;
const PDN_UART: u32 = 1 << 6;
const GCONF_EN_SPREADCYCLE: u32 = 1 << 2;
const GCONF_SHAFT: u32 = 1 << 3;
const GCONF_MSTEP_REG_SELECT: u32 = 1 << 7;

/// SG_RESULT of a free motor; the full load makes it 0. The data sheet gives no formula.
const SG_FREE: u32 = 250;
/// How far a free motor is above twice its SGTHRS, at least.
const SG_MARGIN: u32 = 100;
/// Highest SG_RESULT.
const SG_MAX: u32 = 511;
/// The SGTHRS at which a fifth of the full load counts as a stall.
const SGTHRS_FOR_HOMING: u32 = 100;

/// A driver TMC2209.
pub type Tmc2209Config = UartDriverConfig<2209>;
/// A driver TMC2208, TMC2220, TMC2224 or TMC2225. It has no address, no StallGuard and no CoolStep.
pub type Tmc2208Config = UartDriverConfig<2208>;

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UartDriverConfig<const MODEL: u16> {
    /// PDN_UART, the wire for both directions; with `tx_pin` it is the board's receiving end.
    pub uart_pin: Option<PinName>,
    /// The serial port at PDN_UART, in place of `uart_pin`. Drivers with other addresses may share it.
    pub uart_port: Option<PinName>,
    /// The board's sending end, joined to the wire by a resistor.
    pub tx_pin: Option<PinName>,
    /// The lines of a multiplexer that connect it to the wire, each at its level: `!` for low.
    #[serde(default)]
    pub select_pins: Vec<PinName>,
    /// Its address, 0 to 3, by MS1 and MS2.
    #[serde(default)]
    pub address: u8,
    /// The axis with the motor that it drives.
    pub axis: String,
    /// DIAG: high while the motor is stalled.
    pub diag_pin: Option<PinName>,
    /// SG_RESULT of a free motor. A motor with full load has 0. SGTHRS has to be below half of it.
    #[serde(default = "default_sg_free")]
    pub sg_free: u32,
}

fn default_sg_free() -> u32 {
    SG_FREE
}

impl<const MODEL: u16> UartDriverConfig<MODEL> {
    /// The `sg_free` of a motor for which this SGTHRS is right: a free motor is well above twice that.
    pub fn free_with_sgthrs(sgthrs: u32) -> u32 {
        (2 * sgthrs + SG_MARGIN).clamp(SG_FREE, SG_MAX)
    }
}

impl<const MODEL: u16> Part for UartDriverConfig<MODEL> {
    fn name(&self) -> String {
        format!("tmc{MODEL} {}", self.axis)
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("diag_pin", self.diag_pin.as_ref())]
    }

    fn select_pins(&self) -> &[PinName] {
        &self.select_pins
    }

    fn uart_pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("uart_pin", self.uart_pin.as_ref()), ("tx_pin", self.tx_pin.as_ref())]
    }

    fn socket(&self) -> Option<Socket<'_>> {
        self.uart_port.as_ref().map(|port| Socket::Serial { port, address: self.address })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        let (most, range) = if MODEL == 2209 { (3, "0 to 3") } else { (0, "0") };
        if self.address > most {
            return wrong(whose, "address", &format!("{} is not an address", self.address), &format!("give {range}"));
        }
        if !(1..=SG_MAX).contains(&self.sg_free) {
            return wrong(whose, "sg_free", &format!("{} is not an SG_RESULT", self.sg_free), "give 1 to 511");
        }
        match (&self.uart_pin, &self.uart_port) {
            (None, None) => return wrong(whose, "uart_pin", "it has none", "add it, or `uart_port`"),
            (Some(_), Some(_)) => return wrong(whose, "uart_port", "it also has a uart_pin", "remove one of them"),
            _ => {}
        }
        if self.uart_port.is_some() && self.tx_pin.is_some() {
            return wrong(whose, "tx_pin", "a serial port sends and receives", "remove it");
        }
        check_pins(whose, self.uart_pins().into_iter().chain([("uart_port", self.uart_port.as_ref())]))?;
        printer.check_axis(whose, &self.axis)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let Some(axis) = workshop.axis(&self.axis) else { return Ok(()) };
        let chip = Tmc2209::new(&self.name(), MODEL, (self.address, self.sg_free), axis);
        workshop.wire_shared(self.diag_pin.as_ref(), chip.diag.clone());
        workshop.solder_uart(self, chip);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("tmc{MODEL} {}", layout.stepper(&self.axis)));
        may_be_left_out(cfg);
        cfg.key_if("uart_pin", self.uart_pin.as_ref());
        cfg.key_if("uart_pin", self.uart_port.as_ref());
        cfg.key_if("tx_pin", self.tx_pin.as_ref());
        select_keys(cfg, &self.select_pins);
        if MODEL == 2209 {
            cfg.key("uart_address", self.address);
        }
        cfg.key("run_current", 0.8);
        cfg.key("sense_resistor", 0.11);
        if let Some(pin) = self.diag_pin.as_ref().filter(|_| MODEL == 2209) {
            cfg.key("diag_pin", pin);
            offer_sensorless_homing(cfg, layout, "tmc2209", &self.axis, ("driver_SGTHRS", SGTHRS_FOR_HOMING));
        }
    }
}

struct Tmc2209 {
    model: u16,
    address: u8,
    /// SG_RESULT of the free motor.
    sg_free: u32,
    motor: Motor,
    diag: Arc<StallOutput>,
    registers: RegisterMap<u32>,
    /// Number of messages that wrote a register.
    written: u8,
}

impl Tmc2209 {
    /// The driver of an axis, at power-up.
    fn new(name: &str, model: u16, (address, sg_free): (u8, u32), axis: Arc<Axis>) -> Tmc2209 {
        let registers = of_model(model);
        let rule = stall_rule(&registers, sg_free, 0);
        let diag = Arc::new(StallOutput::new(name.to_owned(), axis.clone(), rule));
        let mut chip = Tmc2209 { model, address, sg_free, motor: Motor::new(axis), diag, registers, written: 0 };
        chip.set_up();
        chip
    }

    /// Applies the registers.
    fn set_up(&mut self) {
        let mres = if self.registers.is_set(GCONF, GCONF_MSTEP_REG_SELECT) {
            mres(&self.registers)
        } else {
            // 8, 32, 64 and 16 microsteps by MS1 and MS2; 8, 2, 4 and 16 of a TMC2208.
            let by_pins = if self.model == 2208 { [5, 7, 6, 4] } else { [5, 3, 2, 4] };
            by_pins[usize::from(self.address & 3)]
        };
        self.motor.set_up(mres, self.registers.is_set(GCONF, GCONF_SHAFT));
        let mut rule = stall_rule(&self.registers, self.sg_free, self.motor.mres());
        rule.least_load = rule.least_load.filter(|_| self.model == 2209);
        self.diag.set(rule);
    }

    /// The value that a host reads at this instant.
    fn read(&mut self, address: u8, now: Clock) -> u32 {
        let stands = self.motor.tstep(now) == STANDSTILL;
        match address {
            IFCNT => self.written.into(),
            IOIN => {
                let axis = &self.motor.axis;
                let [off, step, dir] = [!axis.is_enabled(), axis.is_stepped(), axis.is_dir_high()].map(u32::from);
                let [ms1, ms2] = [self.address & 1, self.address >> 1].map(u32::from);
                let diag = u32::from(self.diag.is_stalled(now));
                let version = if self.model == 2208 { VERSION_2208 } else { VERSION };
                version | PDN_UART | dir << 9 | step << 7 | diag << 4 | ms2 << 3 | ms1 << 2 | off
            }
            TSTEP => self.motor.tstep(now),
            SG_RESULT if stands || self.model == 2208 => 0,
            SG_RESULT => self.sg_free - self.sg_free * self.motor.load(now) / FULL_LOAD,
            MSCNT => self.motor.mscnt(),
            MSCURACT => self.motor.currents(&Wave::DEFAULT),
            DRV_STATUS => {
                let spread = self.registers.is_set(GCONF, GCONF_EN_SPREADCYCLE);
                let stealth = !spread && self.motor.tstep(now) >= self.registers.get(TPWMTHRS);
                u32::from(stands) << 31 | u32::from(stealth) << 30 | current(&self.registers, stands) << 16
            }
            PWM_AUTO => pwm_auto(&self.registers),
            _ => self.registers.read(address),
        }
    }

    fn write(&mut self, address: u8, data: u32) {
        self.written = self.written.wrapping_add(1);
        self.registers.write(address, data);
        self.set_up();
        if address == CHOPCONF {
            self.motor.axis.set_both_edges(has_both_edges(&self.registers));
        }
    }
}

impl UartChip for Tmc2209 {
    fn address(&self) -> u8 {
        self.address
    }

    fn read_register(&mut self, register: u8, now: Clock) -> u32 {
        self.read(register, now)
    }

    fn write_register(&mut self, register: u8, data: u32) {
        self.write(register, data);
    }

    fn send_delay(&self) -> u64 {
        send_delay(self.registers.get(SLAVECONF))
    }
}

/// When DIAG reports a stall: SG_RESULT is at most twice SGTHRS, and the velocity is from TCOOLTHRS up to the start of
/// SpreadCycle.
fn stall_rule(registers: &RegisterMap<u32>, sg_free: u32, mres: u32) -> StallRule {
    let fall = sg_free.saturating_sub(2 * registers.get(SGTHRS));
    let stealth = !registers.is_set(GCONF, GCONF_EN_SPREADCYCLE);
    StallRule {
        least_load: stealth.then_some((fall * FULL_LOAD).div_ceil(sg_free)),
        fastest: registers.get(TPWMTHRS),
        slowest: registers.get(TCOOLTHRS),
        mres,
        push_pull: true,
    }
}

#[cfg(test)]
mod tests {
    use super::super::trinamic::registers::{GSTAT, IHOLD_IRUN};
    use std::sync::Mutex;

    use super::super::uart::{Role, Uart, UartPin, crc8};
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::wire::Wire;
    use pinion_firmware::time::Ticks;

    /// 40 kbaud.
    const BIT: u64 = 1250;

    struct Bench {
        axis: Arc<Axis>,
        pin: UartPin,
        bit: u64,
        now: Clock,
    }

    impl Bench {
        fn new(address: u8) -> Bench {
            let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[1]));
            let uart = Arc::new(Mutex::new(Uart::new(Box::new(Tmc2209::new(
                "tmc2209 y",
                2209,
                (address, SG_FREE),
                axis.clone(),
            )))));
            let pin = UartPin { name: "tmc2209 y".into(), role: Role::Both, uart };
            pin.settle(true, Clock::EPOCH);
            Bench { axis, pin, bit: BIT, now: Clock::EPOCH + Ticks(100_000) }
        }

        fn wait(&mut self, bits: u64) {
            self.now = Clock::from_ticks(self.now.ticks() + bits * self.bit);
        }

        /// Sends bytes, and then releases the wire.
        fn send(&mut self, bytes: &[u8]) {
            let mut level = true;
            for byte in bytes {
                for bit in 0..10 {
                    let next = (u32::from(*byte) << 1 | 0x200) >> bit & 1 != 0;
                    if next != level {
                        self.pin.drive(next, self.now);
                        level = next;
                    }
                    self.wait(1);
                }
            }
            self.pin.release(self.now);
        }

        /// The answer, and the number of bit times before it.
        fn receive(&mut self) -> Option<(u64, Vec<u8>)> {
            let silent = (0..200).find(|_| {
                let low = !self.pin.sense(true, self.now);
                self.wait(u64::from(!low));
                low
            })?;
            let from = self.now.ticks() + self.bit / 2;
            let bit = |place: u64| self.pin.sense(true, Clock::from_ticks(from + place * self.bit));
            let bytes = (0..8).map(|byte| {
                assert!(!bit(10 * byte) && bit(10 * byte + 9), "start and stop bits");
                (0..8).map(|n| u8::from(bit(10 * byte + 1 + n)) << n).sum()
            });
            let bytes = bytes.collect();
            assert!(bit(80) && bit(90), "silence");
            self.wait(90);
            Some((silent, bytes))
        }

        fn message(&mut self, bytes: &[u8]) {
            let crc = crc8(bytes);
            self.send(&[bytes, &[crc]].concat());
        }

        fn read(&mut self, register: u8) -> u32 {
            self.message(&[0xf5, 2, register]);
            let (_, bytes) = self.receive().expect("an answer");
            assert_eq!(bytes[..3], [0x05, 0xff, register]);
            assert_eq!(crc8(&bytes[..7]), bytes[7]);
            u32::from_be_bytes(bytes[3..7].try_into().unwrap())
        }

        fn write(&mut self, register: u8, value: u32) {
            let [d3, d2, d1, d0] = value.to_be_bytes();
            self.message(&[0xf5, 2, register | 0x80, d3, d2, d1, d0]);
            self.wait(12);
        }

        /// Pulses of the step pin, one every 250 us.
        fn steps(&mut self, count: u32) {
            self.axis.set_enabled(true);
            for _ in 0..count {
                self.now = self.now + Ticks::from_us(250);
                self.axis.edge(true, self.now);
                self.axis.edge(false, self.now);
            }
        }
    }

    #[test]
    fn chips_with_other_addresses_share_the_wire() {
        let mut bench = Bench::new(2);
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
        let other = Tmc2209::new("other", 2208, (0, SG_FREE), axis);
        bench.pin.uart.lock().unwrap().solder(Box::new(other));
        assert_eq!(bench.read(IOIN) >> 24, 0x21);
        bench.message(&[0xf5, 0, IOIN]);
        let (_, bytes) = bench.receive().expect("an answer");
        assert_eq!(bytes[3], 0x20, "a TMC2208");
        bench.message(&[0xf5, 1, IOIN]);
        assert!(bench.receive().is_none());
    }

    /// The data sheet's CRC and klippy agree on this example: a read of IFCNT.
    #[test]
    fn the_check_sum_is_crc8_atm() {
        assert_eq!(crc8(&[0x05, 0x00, 0x02]), 0x8f);
        assert_eq!(crc8(&[0xf5, 0x00, 0x02]), 0xc8);
    }

    #[test]
    fn registers_are_read_and_written_as_their_access_says() {
        for bit in [BIT, 5555, 100] {
            let mut bench = Bench::new(2);
            bench.bit = bit;
            assert_eq!(bench.read(GCONF), 0x101);
            bench.write(GCONF, 0xffff_f1c0);
            assert_eq!(bench.read(GCONF), 0x1c0, "it has ten bits");
            assert_eq!(bench.read(IFCNT), 1);
            assert_eq!(bench.read(GSTAT), 1);
            bench.write(GSTAT, 6);
            assert_eq!(bench.read(GSTAT), 1);
            bench.write(GSTAT, 1);
            assert_eq!((bench.read(GSTAT), bench.read(IFCNT)), (0, 3));
            bench.write(IHOLD_IRUN, 0x0008_1f08);
            assert_eq!(bench.read(IHOLD_IRUN), 0, "write only");
            assert_eq!(bench.read(DRV_STATUS), 0xc008_0000, "standstill at IHOLD in StealthChop");
            bench.write(GCONF, 0x1c4);
            assert_eq!(bench.read(DRV_STATUS), 0x8008_0000);
            bench.write(IOIN, 7);
            assert_eq!(bench.read(IOIN), 0x2100_0249, "DIR, PDN_UART, MS2 and ENN are high");
            assert_eq!(bench.read(0x7e), 0, "there is none");
            assert_eq!(bench.read(PWM_AUTO), 0x24);
            assert_eq!(bench.read(CHOPCONF), 0x1000_0053);
            assert_eq!(bench.read(MSCURACT), 0x00f7_0000);
            for _ in 0..250 {
                bench.write(0x11, 20);
            }
            assert_eq!(bench.read(IFCNT), 0, "it has eight bits");
        }
    }

    #[test]
    fn an_answer_comes_after_the_bit_times_of_senddelay() {
        for (delay, bits) in [(0, 8), (1, 8), (2, 24), (3, 24), (15, 120)] {
            let mut bench = Bench::new(2);
            bench.write(SLAVECONF, delay << 8);
            bench.message(&[0xf5, 2, IFCNT]);
            assert_eq!(bench.receive().unwrap().0, bits);
        }
    }

    #[test]
    fn what_is_not_whole_or_for_another_chip_is_not_heard() {
        let mut bench = Bench::new(2);
        bench.message(&[0xf5, 1, IFCNT]);
        assert_eq!(bench.receive(), None, "another address");
        bench.send(&[0xf5, 2, IFCNT, 0]);
        assert_eq!(bench.receive(), None, "a wrong check sum");
        bench.send(&[0xf5, 2, 0x80 | GSTAT, 0, 0]);
        assert_eq!(bench.receive(), None, "half of a message");
        bench.wait(64);
        assert_eq!((bench.read(GSTAT), bench.read(IFCNT)), (1, 0), "the next one is heard");
        // A bit that is too long makes a stop bit low.
        let now = bench.now;
        for (bit, level) in [(0, false), (1, true), (2, false), (3, true), (4, false), (20, true)] {
            bench.pin.drive(level, Clock::from_ticks(now.ticks() + bit * BIT));
        }
        bench.wait(40);
        assert_eq!(bench.read(GSTAT), 1);
    }

    /// The chip takes the length of a bit from the sync nibble. So it also understands a message that is 4 % too slow
    /// throughout.
    #[test]
    fn bits_are_read_in_their_middle() {
        let mut bench = Bench::new(2);
        let whole = [0xf5, 2, IFCNT, crc8(&[0xf5, 2, IFCNT])];
        // Each edge is up to 40 % of a bit late or early, in a fixed pattern. The edges of the sync nibble are exact.
        let mut level = true;
        let mut edges = 0u64;
        let begin = bench.now.ticks();
        for place in 0..40u64 {
            let next = (u32::from(whole[(place / 10) as usize]) << 1 | 0x200) >> (place % 10) & 1 != 0;
            if next != level {
                edges += 1;
                // A start bit restarts the clock. Each edge of a byte is at most this far off relative to it.
                let off = if place < 5 || place % 10 == 0 { 0 } else { [40i64, -40, 20][(edges % 3) as usize] };
                let at = (begin + place * BIT).wrapping_add_signed(off * BIT as i64 / 100);
                bench.pin.drive(next, Clock::from_ticks(at));
                level = next;
            }
        }
        bench.wait(40);
        bench.pin.release(bench.now);
        assert_eq!(bench.receive().unwrap().1[2], IFCNT);
    }

    #[test]
    fn the_motor_is_seen_to_move_and_to_stall() {
        let mut bench = Bench::new(2);
        bench.write(GCONF, GCONF_MSTEP_REG_SELECT);
        bench.write(CHOPCONF, 0x1000_0053 | 4 << 24);
        bench.write(SGTHRS, 100);
        bench.write(TCOOLTHRS, STANDSTILL);
        bench.bit = 100;
        bench.axis.set_forward(false);
        bench.steps(10);
        // 3000 clocks and 16 microsteps of 1/256. The message itself takes 80 us.
        assert_eq!(bench.read(TSTEP), 187);
        assert_eq!(bench.read(SG_RESULT), SG_FREE);
        // The direction line of this axis is high for backward.
        assert_eq!(bench.read(MSCNT), 1024 - 160);
        assert_eq!(bench.read(DRV_STATUS) >> 30, 1);
        assert_eq!(bench.read(IOIN) & 1 << 4, 0);
        // To its end at -2 mm, and 3 of 16 microsteps further.
        bench.steps(47 * 80 - 10 + 3);
        assert_eq!(bench.read(SG_RESULT), SG_FREE - 46);
        assert_eq!(bench.read(IOIN) & 1 << 4, 0);
        bench.steps(1);
        assert_eq!(bench.read(IOIN) & 1 << 4, 1 << 4, "SG_RESULT is below twice SGTHRS");
        bench.steps(50);
        assert_eq!(bench.read(SG_RESULT), 0);
        bench.write(GCONF, GCONF_MSTEP_REG_SELECT | GCONF_EN_SPREADCYCLE);
        assert_eq!(bench.read(IOIN) & 1 << 4, 0, "in StealthChop only");
        bench.write(GCONF, GCONF_MSTEP_REG_SELECT);
        bench.axis.set_forward(true);
        bench.steps(1);
        assert_eq!(bench.read(IOIN) & 1 << 4, 0, "free again");
    }

    #[test]
    fn with_two_wires_the_answer_comes_by_the_other_one() {
        let bench = Bench::new(2);
        let other = |role| UartPin { name: "y".into(), role, uart: bench.pin.uart.clone() };
        let receiver = other(Role::Receiver);
        let mut bench = Bench { pin: other(Role::Sender), ..bench };
        bench.message(&[0xf5, 2, GCONF]);
        bench.pin = receiver;
        assert_eq!(bench.receive().unwrap().1[..7], [0x05, 0xff, GCONF, 0, 0, 1, 1]);
    }
}
