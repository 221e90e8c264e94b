// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of pins, as klippy reads them (klippy/pins.py), and `[board_pins]`.

use std::collections::HashMap;
use std::fmt;

use crate::{Config, Trouble};

/// The name of the main MCU.
pub const MAIN: &str = "mcu";

/// The section of an MCU.
pub fn section_of(mcu: &str) -> String {
    if mcu == MAIN { mcu.to_owned() } else { format!("mcu {mcu}") }
}

/// A pin in an option.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Pin {
    /// The MCU, or a chip such as `probe` or `tmc2209_stepper_x`.
    pub chip: String,
    /// Its name there.
    pub name: String,
    /// Whether it has a `!`.
    pub inverted: bool,
    /// 1 with a `^`, -1 with a `~`.
    pub pull: i8,
}

impl Pin {
    /// Reads a pin. Where klippy permits no `^`, `~` or `!`, it refuses the name because of them.
    ///
    /// # Errors
    ///
    /// klippy's words.
    pub fn parse(text: &str, can_invert: bool, can_pull: bool) -> Result<Pin, String> {
        let mut rest = text.trim();
        let (mut pull, mut inverted) = (0, false);
        if can_pull && let Some(behind) = rest.strip_prefix(['^', '~']) {
            pull = if rest.starts_with('^') { 1 } else { -1 };
            rest = behind.trim();
        }
        if can_invert && let Some(behind) = rest.strip_prefix('!') {
            inverted = true;
            rest = behind.trim();
        }
        let (chip, name) = rest.split_once(':').unwrap_or((MAIN, rest));
        let (chip, name) = (chip.trim(), name.trim());
        if name.contains(['^', '~', '!', ':']) || name.contains(char::is_whitespace) {
            let pull = if can_pull { "[^~] " } else { "" };
            let invert = if can_invert { "[!] " } else { "" };
            return Err(format!(
                "Invalid pin description '{}': Format is: {pull}{invert}[chip_name:] pin_name",
                text.escape_debug()
            ));
        }
        Ok(Pin { chip: chip.to_owned(), name: name.to_owned(), inverted, pull })
    }
}

impl fmt::Display for Pin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.inverted { "!" } else { "" })?;
        if self.chip != MAIN {
            write!(f, "{}:", self.chip)?;
        }
        f.write_str(&self.name)
    }
}

/// `[board_pins]`: other names of pins, for each MCU.
#[derive(Clone, Debug, Default)]
pub struct Aliases {
    /// By MCU and alias.
    pins: HashMap<(String, String), String>,
    /// Pins that no section may use, and why.
    reserved: HashMap<(String, String), String>,
}

impl Aliases {
    /// All aliases of a configuration.
    ///
    /// # Errors
    ///
    /// klippy's words, with the line.
    pub fn read(config: &Config) -> Result<Aliases, Trouble> {
        let mut aliases = Aliases::default();
        for section in config.of_kind("board_pins") {
            let mcus = match section.list("mcu", ',') {
                none if none.is_empty() => vec![MAIN],
                named => named,
            };
            let is_list = |key: &str| key == "aliases" || key.starts_with("aliases_");
            for setting in section.settings().iter().filter(|setting| is_list(&setting.key)) {
                let pairs = setting.value.split(',').map(str::trim).filter(|pair| !pair.is_empty());
                for pair in pairs {
                    let (alias, pin) = pair.split_once('=').filter(|(_, pin)| !pin.contains('=')).ok_or_else(|| {
                        let cause =
                            format!("Option '{}' in section '{}' must have 2 elements", setting.key, section.name);
                        section.trouble(&setting.key, cause).remedy("write `alias=pin`")
                    })?;
                    for mcu in &mcus {
                        let added = aliases.add(mcu, alias.trim(), pin.trim());
                        added.map_err(|cause| section.trouble(&setting.key, cause).remedy("remove one of them"))?;
                    }
                }
            }
        }
        Ok(aliases)
    }

    fn add(&mut self, mcu: &str, alias: &str, pin: &str) -> Result<(), String> {
        let key = |name: &str| (mcu.to_owned(), name.to_owned());
        if pin.starts_with('<') && pin.ends_with('>') {
            self.reserved.insert(key(alias), pin.to_owned());
            return Ok(());
        }
        if let Some(known) = self.pins.get(&key(alias)).filter(|known| *known != pin) {
            return Err(format!("Alias {alias} mapped to {known} - can't alias to {pin}"));
        }
        if pin.contains(['^', '~', '!', ':']) || pin.contains(char::is_whitespace) {
            return Err(format!("Invalid pin alias '{}'", pin.escape_debug()));
        }
        let pin = self.pins.get(&key(pin)).cloned().unwrap_or_else(|| pin.to_owned());
        self.pins.values_mut().filter(|other| *other == alias).for_each(|other| pin.clone_into(other));
        self.pins.insert(key(alias), pin);
        Ok(())
    }

    /// The pin of the MCU that a name stands for.
    pub fn resolve(&self, pin: &Pin) -> Pin {
        let name = self.pins.get(&(pin.chip.clone(), pin.name.clone())).unwrap_or(&pin.name);
        Pin { name: name.clone(), ..pin.clone() }
    }

    /// Why no section may use this pin.
    pub fn reserved(&self, pin: &Pin) -> Option<&str> {
        self.reserved.get(&(pin.chip.clone(), pin.name.clone())).map(String::as_str)
    }
}
