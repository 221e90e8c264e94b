// SPDX-License-Identifier: GPL-3.0-or-later
//! Graphic displays with an ST7920, on its serial interface.
//!
//! A message begins with a synchronizing byte, which says whether commands or data follow. Each byte then becomes two,
//! with its upper and its lower four bits in front (Sitronix' data sheet, "Serial interface"). The display executes a
//! byte when its second half ends. So the time that the display needs passes before that.

use crate::board::Pin;
use crate::mcu::{Command, Feature, Oid, command};
use crate::shutdown::Shutdown;
use crate::time::Ticks;

use super::display::{Busy, Display, Panel, Register, Wire, hold};
use super::pace::Pace;

pub(super) const FEATURE: Feature = Feature {
    serves: "ST7920 displays",
    commands: &[CONFIG_ST7920, ST7920_SEND_CMDS, ST7920_SEND_DATA],
    ..Feature::EMPTY
};

/// Shortest time that SCLK is high, and low: 200 ns.
const HALF_CLOCK: Ticks = Ticks(10);
const SYNC_COMMANDS: u8 = 0xf8;
const SYNC_DATA: u8 = 0xfa;

struct St7920 {
    busy: Busy,
    /// Delay from a message's last byte to the first byte of the next.
    sync_delay: Ticks,
    /// Delay between the bytes of a message.
    delay: Ticks,
    sclk: Wire,
    sid: Wire,
}

impl St7920 {
    /// Writes a byte. The display reads a bit when SCLK rises.
    fn byte(&mut self, byte: u8) -> Result<(), Shutdown> {
        for place in (0..8).rev() {
            self.sid.set(byte >> place & 1 != 0)?;
            hold(&self.busy.pace, HALF_CLOCK);
            self.sclk.set(true)?;
            hold(&self.busy.pace, HALF_CLOCK);
            self.sclk.set(false)?;
        }
        Ok(())
    }
}

impl Panel for St7920 {
    fn write(&mut self, register: Register, bytes: &[u8]) -> Result<(), Shutdown> {
        self.byte(match register {
            Register::Commands => SYNC_COMMANDS,
            Register::Data => SYNC_DATA,
        })?;
        let mut delay = self.sync_delay;
        for byte in bytes {
            self.byte(byte & 0xf0)?;
            if !self.busy.over(delay) {
                break;
            }
            self.byte(byte << 4)?;
            self.busy.begin();
            delay = self.delay;
        }
        Ok(())
    }

    fn idle(&mut self) -> Result<(), Shutdown> {
        [&mut self.sclk, &mut self.sid].map(Wire::idle).into_iter().fold(Ok(()), Result::and)
    }
}

type Screen = Display<St7920>;

const CONFIG_ST7920: Command = command!(
    "config_st7920 oid=%c cs_pin=%u sclk_pin=%u sid_pin=%u sync_delay_ticks=%u cmd_delay_ticks=%u",
    |context, oid: Oid, cs_pin: Pin, sclk_pin: Pin, sid_pin: Pin, sync_delay_ticks: Ticks, cmd_delay_ticks: Ticks| {
        context.vacant(oid)?;
        let pace = Pace::new(context);
        let panel = St7920 {
            busy: Busy::new(pace.clone()),
            sync_delay: sync_delay_ticks,
            delay: cmd_delay_ticks,
            sclk: Wire::claim(context, sclk_pin)?,
            sid: Wire::claim(context, sid_pin)?,
        };
        // The display is selected from now on, even in a stopped MCU.
        context.shared_output(cs_pin, true)?;
        let display = Display::new(context, "ST7920 display", pace, panel)?;
        context.assign_on(sclk_pin, oid, display)
    }
);

const ST7920_SEND_CMDS: Command = command!(
    "st7920_send_cmds oid=%c cmds=%*s",
    Screen,
    |display, context, cmds: &[u8]| display.write(context, Register::Commands, cmds)
);

const ST7920_SEND_DATA: Command = command!(
    "st7920_send_data oid=%c data=%*s",
    Screen,
    |display, context, data: &[u8]| display.write(context, Register::Data, data)
);
