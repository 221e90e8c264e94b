// SPDX-License-Identifier: GPL-3.0-or-later
//! The stepper driver TMC2660 in its step and direction mode, after its data sheet (Trinamic, TMC2660C, rev. 1.05: "SPI
//! Interface").
//!
//! A datagram has 20 bits. Its first bits name one of five registers. The answer is a position or a load, by RDSEL, and
//! the status. Simulated: the registers that a host writes, the microstep counter, StallGuard's value and standstill. Not
//! simulated: CoolStep's current, faults, SG_TST. The motor turns as with a TMC5160 (`tmc5160.rs`).

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::trinamic::{FULL_LOAD, Motor, STANDSTILL};
use super::workshop::{Part, Socket, Workshop};
use crate::description::check::Trouble;
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::motion::Axis;
use crate::engine::spi::{ShiftRegister, SpiChip};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::TimeSource;

/// DRVCTRL: the size of a step, and whether both edges are steps.
const DRVCTRL_MRES: u32 = 0x0f;
const DRVCTRL_DEDGE: u32 = 1 << 8;
/// DRVCONF: what the answer has.
const DRVCONF_RDSEL: u32 = 4;
/// Of the status: the motor stands still.
const STATUS_STST: u32 = 1 << 7;
/// SG_VALUE of a free motor. The full load makes it 0.
const SG_FREE: u32 = 250;

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tmc2660Config {
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// The axis with the motor that it drives.
    pub axis: String,
}

impl Part for Tmc2660Config {
    fn name(&self) -> String {
        format!("tmc2660 {}", self.axis)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        printer.check_axis(whose, &self.axis)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        if let Some(axis) = workshop.axis(&self.axis) {
            workshop.solder_spi(self, Tmc2660::new(axis, workshop.clock.clone()));
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section(format_args!("tmc2660 {}", layout.stepper(&self.axis)));
        cfg.spi(&self.bus, self.select_pin.as_ref());
        cfg.key("run_current", 0.8);
        cfg.key("sense_resistor", 0.051);
    }
}

struct Tmc2660 {
    motor: Motor,
    time: Arc<dyn TimeSource>,
    rdsel: u32,
    /// Its 20 bits, and four more of its message's last byte.
    shift: ShiftRegister<3>,
}

impl Tmc2660 {
    fn new(axis: Arc<Axis>, time: Arc<dyn TimeSource>) -> Tmc2660 {
        Tmc2660 { motor: Motor::new(axis), time, rdsel: 0, shift: ShiftRegister::load([0; 3]) }
    }

    /// The 20 bits of the answer.
    fn answer(&self) -> u32 {
        let now = self.time.now();
        let stands = self.motor.tstep(now) == STANDSTILL;
        let load = SG_FREE - SG_FREE * self.motor.load(now) / FULL_LOAD;
        let value = match self.rdsel {
            0 => self.motor.mscnt(),
            1 => load,
            // The upper half of the load, and CoolStep's current.
            _ => load >> 5 << 5 | 0x1f,
        };
        value << 10 | if stands { STATUS_STST } else { 0 }
    }

    fn take(&mut self, datagram: u32) {
        match datagram >> 17 {
            // DRVCTRL has two bits for its name.
            0 | 1 => {
                self.motor.set_up(datagram & DRVCTRL_MRES, false);
                self.motor.axis.set_both_edges(datagram & DRVCTRL_DEDGE != 0);
            }
            0b111 => self.rdsel = datagram >> DRVCONF_RDSEL & 3,
            _ => {}
        }
    }
}

impl SpiChip for Tmc2660 {
    /// The data sheet asks for mode 3. In mode 0 the bits are read at the same edges.
    fn knows_mode(&self, mode: u8) -> bool {
        matches!(mode, 0 | 3)
    }

    fn select(&mut self, _rate_hz: u32) {
        let [_, answer @ ..] = (self.answer() << 4).to_be_bytes();
        self.shift = ShiftRegister::load(answer);
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.shift.exchange(byte)
    }

    fn deselect(&mut self) {
        if let Some([high, middle, low]) = self.shift.message() {
            self.take(u32::from_be_bytes([0, high & 0x0f, middle, low]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use pinion_firmware::time::{Clock, VirtualClock};

    fn send(chip: &mut Tmc2660, bytes: [u8; 3]) -> u32 {
        chip.select(1_000_000);
        let answer = bytes.map(|byte| chip.exchange(byte));
        chip.deselect();
        u32::from_be_bytes([0, answer[0], answer[1], answer[2]])
    }

    #[test]
    fn it_counts_the_steps_and_takes_both_edges() {
        let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
        axis.set_enabled(true);
        let mut chip = Tmc2660::new(axis.clone(), Arc::new(VirtualClock::at(Clock::EPOCH)));
        // DRVCTRL: 16 microsteps, both edges.
        send(&mut chip, [0x00, 0x01, 0x04]);
        axis.set_forward(true);
        for on in [true, false, true] {
            axis.edge(on, Clock::from_ticks(1000));
        }
        assert_eq!(axis.turned_steps().abs(), 3);
        // klippy's place of the field mstep, and the status.
        let read = send(&mut chip, [0x0e, 0x00, 0x00]);
        assert_eq!((read >> 14) as i32 & 0x3ff, (axis.turned_steps() as i32 * 16) & 0x3ff);
        // RDSEL 1: the load.
        send(&mut chip, [0x0e, 0x00, 0x10]);
        assert_eq!(send(&mut chip, [0x0e, 0x00, 0x10]) >> 14, SG_FREE);
    }
}
