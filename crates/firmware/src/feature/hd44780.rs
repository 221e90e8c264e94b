// SPDX-License-Identifier: GPL-3.0-or-later
//! Text displays with an HD44780, on four data lines.
//!
//! The times are from Hitachi's data sheet at 5 V (HD44780U, "Bus timing characteristics"), as in Klipper's C. The
//! host says how long the display needs after a byte.

use crate::board::Pin;
use crate::mcu::{Command, Context, Feature, Oid, command};
use crate::shutdown::Shutdown;
use crate::time::Ticks;

use super::display::{Busy, Display, Panel, Register, Wire, hold};
use super::pace::Pace;

pub(super) const FEATURE: Feature = Feature {
    serves: "HD44780 displays",
    commands: &[CONFIG_HD44780, HD44780_SEND_CMDS, HD44780_SEND_DATA],
    ..Feature::EMPTY
};

/// Shortest time that E is high: 230 ns, rounded up to ticks of 20 ns.
const PULSE: Ticks = Ticks(12);
/// How long E is then low: the rest of a cycle of 500 ns.
const PAUSE: Ticks = Ticks(14);

struct Hd44780 {
    busy: Busy,
    /// How long the display needs after each byte.
    delay: Ticks,
    rs: Wire,
    e: Wire,
    /// D4 to D7.
    data: [Wire; 4],
}

impl Hd44780 {
    fn claim(context: &mut Context, pace: Pace, pins: [Pin; 6], delay: Ticks) -> Result<Hd44780, Shutdown> {
        let [rs, e, data @ ..] = pins;
        let [d4, d5, d6, d7] = data;
        Ok(Hd44780 {
            busy: Busy::new(pace),
            delay,
            rs: Wire::claim(context, rs)?,
            e: Wire::claim(context, e)?,
            data: [
                Wire::claim(context, d4)?,
                Wire::claim(context, d5)?,
                Wire::claim(context, d6)?,
                Wire::claim(context, d7)?,
            ],
        })
    }

    /// Writes the lower four bits. The display reads them when E falls.
    fn nibble(&mut self, bits: u8) -> Result<(), Shutdown> {
        for (place, wire) in self.data.iter_mut().enumerate() {
            wire.set(bits >> place & 1 != 0)?;
        }
        self.e.set(true)?;
        hold(&self.busy.pace, PULSE);
        self.e.set(false)
    }
}

impl Panel for Hd44780 {
    fn write(&mut self, register: Register, bytes: &[u8]) -> Result<(), Shutdown> {
        self.rs.set(register == Register::Data)?;
        for byte in bytes {
            if !self.busy.over(self.delay) {
                break;
            }
            self.nibble(byte >> 4)?;
            hold(&self.busy.pace, PAUSE);
            self.nibble(byte & 0xf)?;
            self.busy.begin();
        }
        Ok(())
    }

    fn idle(&mut self) -> Result<(), Shutdown> {
        let wires = [&mut self.rs, &mut self.e].into_iter().chain(&mut self.data);
        wires.map(Wire::idle).fold(Ok(()), Result::and)
    }
}

type Screen = Display<Hd44780>;

const CONFIG_HD44780: Command = command!(
    "config_hd44780 oid=%c rs_pin=%u e_pin=%u d4_pin=%u d5_pin=%u d6_pin=%u d7_pin=%u delay_ticks=%u",
    |context,
     oid: Oid,
     rs_pin: Pin,
     e_pin: Pin,
     d4_pin: Pin,
     d5_pin: Pin,
     d6_pin: Pin,
     d7_pin: Pin,
     delay_ticks: Ticks| {
        context.vacant(oid)?;
        let pace = Pace::new(context);
        let pins = [rs_pin, e_pin, d4_pin, d5_pin, d6_pin, d7_pin];
        let panel = Hd44780::claim(context, pace.clone(), pins, delay_ticks)?;
        let display = Display::new(context, "HD44780 display", pace, panel)?;
        context.assign_on(e_pin, oid, display)
    }
);

const HD44780_SEND_CMDS: Command = command!(
    "hd44780_send_cmds oid=%c cmds=%*s",
    Screen,
    |display, context, cmds: &[u8]| display.write(context, Register::Commands, cmds)
);

const HD44780_SEND_DATA: Command = command!(
    "hd44780_send_data oid=%c data=%*s",
    Screen,
    |display, context, data: &[u8]| display.write(context, Register::Data, data)
);
