// SPDX-License-Identifier: GPL-3.0-or-later
//! The boards of a description, and the pins in use on them.

use std::collections::{BTreeMap, HashMap};

use serde::{Deserialize, Serialize};

use super::check::{Bound, Trouble, check, unique, wrong};
use super::pin::{PinName, on_board};

/// A board: an MCU with pins and a clock of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct McuConfig {
    /// The name in printer.cfg: `mcu` for `[mcu]`, `toolhead` for `[mcu toolhead]`.
    pub name: String,
    /// The chip that it stands for: the constant `MCU` of its dictionary.
    #[serde(default = "default_chip")]
    pub chip: String,
    /// How far its clock may be from the others, in millionths. The clock is fast and slow by turns, over hours.
    #[serde(default)]
    pub drift_ppm: f64,
    /// Pins with nothing connected. The host may use them for anything.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub pins: Vec<String>,
    /// More constants of its dictionary.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub constants: BTreeMap<String, ConstantValue>,
}

/// The value of a constant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ConstantValue {
    /// A number.
    Number(i64),
    /// A text.
    Text(String),
}

fn default_chip() -> String {
    "linux".into()
}

/// Highest drift. No crystal is so bad.
const DRIFT_PPM_MAX: f64 = 200.0;
/// Highest number of MCUs of a printer. Each has six threads.
pub const MCUS_MAX: usize = 16;

/// The boards of a description. Without any there is one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Boards<'a>(pub(crate) &'a [McuConfig]);

impl Boards<'_> {
    /// The number of the board in the name of a pin or a bus; `None` if there is no such board.
    pub(crate) fn of(&self, name: &str) -> Option<usize> {
        match on_board(name).0 {
            None => Some(0),
            Some("mcu") if self.0.is_empty() => Some(0),
            Some(board) => self.0.iter().position(|mcu| mcu.name == board),
        }
    }

    pub(crate) fn validate(&self) -> Result<(), Trouble> {
        if self.0.len() > MCUS_MAX {
            let cause = format!("it has {} MCUs, and at most {MCUS_MAX} are simulated", self.0.len());
            return Err(Trouble::new(cause).remedy("leave some out"));
        }
        unique("[[mcu]]", self.0.iter().map(|mcu| &mcu.name))?;
        self.0.iter().try_for_each(|mcu| {
            let whose = &format!("mcu `{}`", mcu.name);
            check(whose, "drift_ppm", mcu.drift_ppm, Bound::NotNegative)?;
            if mcu.drift_ppm > DRIFT_PPM_MAX {
                let remedy = format!("{DRIFT_PPM_MAX} at most");
                return wrong(whose, "drift_ppm", "no clock is so far off", &remedy);
            }
            Ok(())
        })
    }
}

impl McuConfig {
    /// Its pins with nothing connected, by their full names.
    pub(crate) fn free_pins(&self) -> Result<Vec<PinName>, Trouble> {
        let names = self.pins.iter().map(|pin| {
            let name = PinName::try_from(format!("{}:{pin}", self.name));
            name.map_err(|cause| {
                Trouble::new(cause).remedy("correct it").of(format_args!("mcu `{}`, key `pins`", self.name))
            })
        });
        names.collect()
    }
}

/// The pins that are already in use, by name.
pub(crate) struct UsedPins<'a> {
    boards: Boards<'a>,
    /// By the board and the name there: what may share the pin.
    used: HashMap<(usize, String), Option<&'static str>>,
}

impl<'a> UsedPins<'a> {
    /// All pins of these boards are free.
    pub(crate) fn of(boards: Boards<'a>) -> UsedPins<'a> {
        UsedPins { boards, used: HashMap::new() }
    }

    /// Marks a pin as used, if there is one. Fails if the pin is already in use.
    pub(crate) fn claim(&mut self, whose: &str, key: &str, pin: Option<&PinName>) -> Result<(), Trouble> {
        self.claim_for(None, whose, key, pin)
    }

    /// Marks a pin that several of `sharers` may use.
    pub(crate) fn claim_for(
        &mut self,
        sharers: Option<&'static str>,
        whose: &str,
        key: &str,
        pin: Option<&PinName>,
    ) -> Result<(), Trouble> {
        let Some(pin) = pin else { return Ok(()) };
        let Some(board) = self.boards.of(&pin.name) else {
            let cause = format!("pin `{}` is on no board", pin.name);
            return wrong(whose, key, &cause, "add an [[mcu]] of this name");
        };
        let before = self.used.insert((board, on_board(&pin.name).1.to_owned()), sharers);
        if before.is_some_and(|others| others.is_none() || others != sharers) {
            return wrong(whose, key, &format!("pin `{}` already has a use", pin.name), "give every pin its own name");
        }
        Ok(())
    }
}
