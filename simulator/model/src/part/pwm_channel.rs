// SPDX-License-Identifier: GPL-3.0-or-later
//! A hardware PWM channel, with an output that it dims.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Trouble, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::look::Look;
use crate::engine::wire::{Kind, Wire};
use crate::engine::world::Sight;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::Clock;

/// The channel's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PwmChannelConfig {
    /// For example `laser`.
    pub name: String,
    /// The channel.
    pub pin: PinName,
}

impl Part for PwmChannelConfig {
    fn name(&self) -> String {
        format!("pwm_channel {}", self.name)
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("pin", Some(&self.pin))]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        if self.pin.inverted {
            return wrong(whose, "pin", "a PWM channel has no polarity here", "remove the `!`");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let channel = Arc::new(PwmChannel { name: self.name.clone(), share: AtomicU64::new(0) });
        workshop.wire_shared(Some(&self.pin), channel.clone());
        workshop.show(channel);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        cfg.section(format_args!("output_pin {}", self.name));
        cfg.key("pin", &self.pin);
        cfg.key("pwm", "True");
        cfg.key("hardware_pwm", "True");
        cfg.key("cycle_time", 0.001);
    }
}

struct PwmChannel {
    name: String,
    /// The share of time that it is on, in bits.
    share: AtomicU64,
}

impl Wire for PwmChannel {
    fn kind(&self) -> Kind {
        Kind::Pwm
    }

    fn describe(&self) -> String {
        format!("hardware PWM of {}", self.name)
    }

    fn dim(&self, share: f64, _at: Clock) -> Option<()> {
        self.share.store(share.to_bits(), Ordering::Relaxed);
        Some(())
    }
}

impl Sight for PwmChannel {
    fn name(&self) -> &str {
        &self.name
    }

    fn look(&self, _now: Clock) -> Look {
        Look::Power { share: f64::from_bits(self.share.load(Ordering::Relaxed)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::board::PWM_MAX;

    #[test]
    fn a_channel_shows_the_percent_that_klippy_set() {
        let channel = PwmChannel { name: "laser".into(), share: AtomicU64::new(0) };
        for percent in 0..=100 {
            // The value that klippy computes (klippy/mcu.py).
            let value = (f64::from(percent) / 100.0 * f64::from(PWM_MAX) + 0.5) as u16;
            channel.dim(f64::from(value) / f64::from(PWM_MAX), Clock::EPOCH);
            assert_eq!(channel.look(Clock::EPOCH).to_string(), format!("{percent} %"));
        }
    }
}
