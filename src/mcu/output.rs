// SPDX-License-Identifier: GPL-3.0-or-later
//! Output lines and hardware PWM channels: who has them, and those that the host sets without
//! an object.

#![forbid(unsafe_code)]

use crate::board::{Buffer, Output, Pin, PwmConfig};
use crate::shutdown::{Reason, Shutdown};

use super::{DeviceId, Mcu, Oid, Ticket};

/// An output line and its present level.
pub struct Line {
    output: Box<dyn Output>,
    level: bool,
}

impl Line {
    /// Drives the line.
    #[inline]
    pub fn write(&mut self, level: bool) -> Result<(), Shutdown> {
        self.level = level;
        self.output.write(level)
    }

    /// Inverts the line.
    #[inline]
    pub fn toggle(&mut self) -> Result<(), Shutdown> {
        self.write(!self.level)
    }

    /// Gives the line away.
    pub fn into_output(self) -> Box<dyn Output> {
        self.output
    }
}

impl Mcu {
    /// Claims an output line. One that `set_digital_out` holds is taken over, if it belongs where
    /// it was set to.
    pub fn output(&mut self, pin: Pin, value: bool, shutdown_value: bool) -> Result<Line, Shutdown> {
        let set = self.set_lines.iter().position(|(held, belongs, _)| *held == pin && *belongs == shutdown_value);
        if let Some(set) = set {
            let (_, _, mut line) = self.set_lines.swap_remove(set);
            line.write(value)?;
            return Ok(line);
        }
        let output = self.board.output(pin, value, shutdown_value)?;
        Ok(Line { output, level: value })
    }

    /// Drives a line that no object owns, and holds it until an object claims it.
    ///
    /// The firmware takes this at any time, and so does this machine for a line that it holds.
    /// To claim one opens files and waits for the guardian: that is refused after
    /// `finalize_config`, as it would keep steps waiting. klippy sets its lines before.
    pub fn set_line(&mut self, pin: Pin, value: bool) -> Result<(), Shutdown> {
        if let Some((_, _, line)) = self.set_lines.iter_mut().find(|(held, ..)| *held == pin) {
            return line.write(value);
        }
        if self.is_finalized() {
            return Err(self.set_too_late(Reason::OutputLine, "set_digital_out", pin));
        }
        let line = self.output(pin, value, value)?;
        self.set_lines.push((pin, value, line));
        Ok(())
    }

    /// Claims a hardware PWM channel for an object.
    pub fn pwm(&mut self, owner: Oid, config: PwmConfig) -> Result<DeviceId, Shutdown> {
        if let Some((first, _)) = self.channel(config.pin) {
            return Err(self.channel_taken(config.pin, first, owner));
        }
        let attachment = self.board.pwm(config)?;
        let device = self.attach(attachment)?;
        self.channels.push((config.pin, owner, device));
        Ok(device)
    }

    /// Sets a hardware PWM channel that no object owns: it keeps its value, at a shutdown too.
    ///
    /// As with [`Mcu::set_line`] a channel that is held may be set anew at any time, by the
    /// worker that has its files; others are refused after `finalize_config`.
    pub fn set_pwm(&mut self, config: PwmConfig) -> Result<(), Shutdown> {
        match self.channel(config.pin) {
            Some((Oid::NOBODY, device)) => {
                let [v0, v1] = config.value.to_le_bytes();
                let [c0, c1, c2, c3] = config.cycle.0.to_le_bytes();
                self.submit(device, Ticket { oid: Oid::NOBODY, tag: 0 }, Buffer::new(&[v0, v1, c0, c1, c2, c3]))
            }
            None if self.is_finalized() => Err(self.set_too_late(Reason::PwmConfig, "set_pwm_out", config.pin)),
            _ => self.pwm(Oid::NOBODY, config).map(drop),
        }
    }

    /// Whose a channel is, if it is in use.
    fn channel(&self, pin: Pin) -> Option<(Oid, DeviceId)> {
        self.channels.iter().find(|(held, ..)| *held == pin).map(|(_, owner, device)| (*owner, *device))
    }

    #[cold]
    fn channel_taken(&self, pin: Pin, first: Oid, second: Oid) -> Shutdown {
        let user = |oid: Oid| match oid {
            Oid::NOBODY => "set_pwm_out".to_owned(),
            Oid(oid) => format!("PWM output oid {oid}"),
        };
        let (name, first, second) = (self.name(pin), user(first), user(second));
        let detail =
            format!("{name} is claimed twice: by {first} and by {second}: change one of the two to another pin");
        Shutdown::because(Reason::PwmConfig, detail)
    }

    #[cold]
    fn set_too_late(&self, reason: Reason, command: &str, pin: Pin) -> Shutdown {
        let name = self.name(pin);
        Shutdown::by_host(
            reason,
            format_args!("{command} wants {name} after finalize_config, and did not set it before"),
        )
    }

    /// What the dictionary calls a pin.
    pub(super) fn name(&self, pin: Pin) -> String {
        self.board.pins().iter().find_map(|range| range.name_of(pin.0)).unwrap_or(format!("pin number {}", pin.0))
    }
}
