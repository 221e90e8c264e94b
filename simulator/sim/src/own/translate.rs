// SPDX-License-Identifier: GPL-3.0-or-later
//! A printer.cfg becomes the description of a simulated printer.
//!
//! A section that stands for a thing becomes that thing. All other pins of the configuration exist, too, with nothing at
//! them: so klippy finds each pin that it asks for.

use std::collections::BTreeSet;

use pinion_printer_config::pins::Aliases;
use pinion_printer_config::{Config, Trouble};
use toml::Table;

use super::claims;
use super::description::Entry;
use super::known::{Kind, kind_of};
use super::plugins::LeftOut;
use super::rules;
use super::translator::{Pace, Pins, Translator, mcus};

/// A printer.cfg as a description.
#[derive(Debug)]
pub(crate) struct Translated {
    /// The description.
    pub(crate) description: Table,
    /// The MCUs in the order of the description, the main one first.
    pub(crate) mcus: Vec<String>,
    /// All pins of the MCUs.
    pub(crate) pins: Pins,
    /// Notes for the user: sections that are not simulated, and sections that klippy will refuse.
    pub(crate) notes: Vec<Trouble>,
    /// The steppers whose endstops have the phases that are saved for them.
    pub(crate) in_phase: BTreeSet<String>,
}

/// Checks a configuration where no klippy can be asked.
///
/// # Errors
///
/// The first mistake that klippy refuses, too.
pub(super) fn check(config: &Config) -> Result<(), Trouble> {
    rules::check(config)?;
    claims::check(config, &Aliases::read(config)?, &mcus(config)?)
}

/// Translates a configuration. The printer has all of it. A plain probe takes the place of a plugin's.
///
/// # Errors
///
/// The first thing that klippy refuses, too, and without which there is no printer.
pub(super) fn translate(config: &Config, pace: Pace, left_out: &LeftOut) -> Result<Translated, Trouble> {
    let mut translator = Translator::new(config, left_out, pace)?;
    translator.motion()?;
    translator.heat()?;
    translator.devices()?;
    translator.drivers()?;
    translator.bare_buses()?;
    translator.strips()?;
    translator.strangers();
    let pins = translator.boards();
    let Translator { out, mcus, notes, in_phase, .. } = translator;
    Ok(Translated { description: out.into_table(), mcus, pins, notes, in_phase })
}

impl Translator<'_> {
    /// The buses of chips that are not simulated: klippy looks for them.
    fn bare_buses(&mut self) -> Result<(), Trouble> {
        for section in self.config.sections() {
            let on_spi = ["cs_pin", "latch_pin"].into_iter().find(|key| section.text(key).is_some());
            let has_lines = section.kind() == "display" && section.text("lcd_type") == Some("st7920");
            if let Some(key) = on_spi.filter(|_| !has_lines && section.text("spi_software_sclk_pin").is_none()) {
                let Some(pin) = self.pin(section, key)?.filter(|pin| self.is_real(pin)) else { continue };
                let name = Translator::on(&pin.chip, section.text("spi_bus").unwrap_or("spi"));
                self.out.bus("spi_bus", &name.clone(), || Entry::default().set("name", name));
            }
            let on_i2c = ["i2c_bus", "i2c_mcu", "i2c_address"].iter().any(|key| section.text(key).is_some());
            if on_i2c && section.text("i2c_software_scl_pin").is_none() {
                self.i2c(section)?;
            }
        }
        Ok(())
    }

    /// Names the sections that stand for nothing here.
    fn strangers(&mut self) {
        let mut named = BTreeSet::new();
        for section in self.config.sections() {
            if self.left_out.sections.contains(&section.name) || !named.insert(section.kind()) {
                continue;
            }
            match kind_of(section.kind()) {
                Kind::Known => {}
                Kind::NotSimulated => {
                    self.note(section, "is not simulated", "its pins exist, and nothing is at them");
                }
                Kind::Strange => {
                    let remedy =
                        "klippy needs its module, or give --without-plugins; its pins exist, and nothing is at them";
                    self.note(section, "is not a section of Klipper or Kalico", remedy);
                }
            }
        }
    }
}
