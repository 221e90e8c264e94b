// SPDX-License-Identifier: GPL-3.0-or-later
//! The shared state of a translation of a printer.cfg: pins (only one section can take each), buses, and notes.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use pinion_model::{MCUS_MAX, is_klippy_name};
use pinion_printer_config::pins::{Aliases, MAIN, Pin, section_of};
use pinion_printer_config::{Config, Section, Trouble};

use super::chips;
use super::description::{Description, Entry};
use super::plugins::LeftOut;

/// How fast the heaters are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    /// As fast as the section's control stands.
    Fast,
    /// As a real printer's.
    Real,
}

/// The pins that a configuration names, by MCU.
pub(crate) type Pins = BTreeMap<String, BTreeSet<String>>;

/// The names of the MCUs.
pub(super) fn mcus(config: &Config) -> Result<Vec<String>, Trouble> {
    if config.section(MAIN).is_none() {
        return Err(Trouble::new("Option 'serial' in section 'mcu' must be specified").remedy("add [mcu]"));
    }
    // klippy's copy has other ways to the MCUs, so klippy does not miss these.
    for section in config.of_kind(MAIN).filter(|section| section.text("canbus_uuid").is_none()) {
        section.required("serial")?;
    }
    let others = config.of_kind(MAIN).filter_map(Section::own_name).map(str::to_owned);
    let mcus: Vec<String> = std::iter::once(MAIN.to_owned()).chain(others).collect();
    if mcus.len() > MCUS_MAX {
        let cause = format!("it has {} MCUs, and at most {MCUS_MAX} are simulated", mcus.len());
        return Err(Trouble::new(cause).remedy("leave some [mcu ...] out"));
    }
    Ok(mcus)
}

/// A translation under way.
pub(super) struct Translator<'a> {
    pub(super) config: &'a Config,
    pub(super) left_out: &'a LeftOut,
    aliases: Aliases,
    pub(super) mcus: Vec<String>,
    /// The pins with something at them, and the section with that thing.
    taken: HashMap<(String, String), String>,
    /// Pins that power several motors.
    enables: BTreeSet<String>,
    /// The axes by the names of their steppers in klippy.
    pub(super) axes: HashMap<String, String>,
    /// The steppers whose endstops have the phases that are saved for them.
    pub(super) in_phase: BTreeSet<String>,
    /// The heaters by their names in klippy.
    pub(super) heaters: HashMap<String, String>,
    pub(super) out: Description,
    pub(super) notes: Vec<Trouble>,
    pub(super) pace: Pace,
}

impl<'a> Translator<'a> {
    pub(super) fn new(config: &'a Config, left_out: &'a LeftOut, pace: Pace) -> Result<Translator<'a>, Trouble> {
        Ok(Translator {
            config,
            left_out,
            aliases: Aliases::read(config)?,
            mcus: mcus(config)?,
            taken: HashMap::new(),
            enables: BTreeSet::new(),
            axes: HashMap::new(),
            heaters: HashMap::new(),
            in_phase: BTreeSet::new(),
            out: Description::default(),
            notes: Vec::new(),
            pace,
        })
    }
}

impl Translator<'_> {
    /// The pin of an option, without its aliases. A pin of several (`multi_pin`) is the first of them.
    pub(super) fn pin(&self, section: &Section, key: &str) -> Result<Option<Pin>, Trouble> {
        match section.text(key).map(str::trim).filter(|text| !text.is_empty()) {
            Some(text) => self.pin_of(section, key, text).map(Some),
            None => Ok(None),
        }
    }

    /// The pin of a text in an option.
    pub(super) fn pin_of(&self, section: &Section, key: &str, text: &str) -> Result<Pin, Trouble> {
        let parsed = Pin::parse(text, true, true);
        let pin = parsed.map_err(|cause| section.trouble(key, cause).remedy("correct the name"))?;
        if pin.chip == "multi_pin" {
            let several = self.config.section(&format!("multi_pin {}", pin.name));
            let first = several.and_then(|several| several.list("pins", ',').first().map(|first| (several, *first)));
            let Some((several, first)) = first else {
                return Err(section.trouble(key, format!("multi_pin {} not configured", pin.name)).remedy("add it"));
            };
            let mut first = self.pin_of(several, "pins", first)?;
            first.inverted ^= pin.inverted;
            return Ok(first);
        }
        if let Some(scaled) = self.config.section(&format!("adc_scaled {}", pin.chip)) {
            let reference = self.pin(scaled, "vref_pin")?;
            return Ok(self.aliases.resolve(&Pin { chip: reference.map_or(MAIN.into(), |pin| pin.chip), ..pin }));
        }
        let pin = self.aliases.resolve(&pin);
        let mcu = self.config.section(&section_of(&pin.chip)).filter(|_| self.is_real(&pin));
        // klippy does not see this: the simulated MCUs have each pin that the configuration names.
        if let Some(names) = mcu.and_then(|mcu| chips::lacks(mcu.text("serial").unwrap_or_default(), &pin.name)) {
            let cause = format!("Pin '{}' is not a valid pin name on mcu '{}'", pin.name, pin.chip);
            return Err(section.trouble(key, cause).remedy(format!("correct it: this chip has at most {names}")));
        }
        Ok(pin)
    }

    /// Whether a pin is one of an MCU, and no virtual one.
    pub(super) fn is_real(&self, pin: &Pin) -> bool {
        self.mcus.contains(&pin.chip)
    }

    /// Takes a pin for a thing of this section. `None` if it is no pin of an MCU, or has something at it already. The
    /// text is the description's.
    pub(super) fn take(&mut self, section: &Section, key: &str) -> Result<Option<String>, Trouble> {
        let Some(pin) = self.pin(section, key)? else { return Ok(None) };
        Ok(self.take_pin(section, &pin))
    }

    pub(super) fn take_pin(&mut self, section: &Section, pin: &Pin) -> Option<String> {
        if !self.is_real(pin) {
            return None;
        }
        let place = (pin.chip.clone(), pin.name.clone());
        if self.taken.contains_key(&place) {
            return None;
        }
        self.taken.insert(place, section.name.clone());
        Some(pin.to_string())
    }

    /// The section that has taken the pin of an option.
    pub(super) fn owner(&self, section: &Section, key: &str) -> Result<Option<&str>, Trouble> {
        let place = self.pin(section, key)?.map(|pin| (pin.chip, pin.name));
        Ok(place.and_then(|place| self.taken.get(&place)).map(String::as_str))
    }

    /// Takes a pin that several motors may share.
    pub(super) fn take_enable(&mut self, section: &Section, key: &str) -> Result<Option<String>, Trouble> {
        let Some(pin) = self.pin(section, key)? else { return Ok(None) };
        let text = pin.to_string();
        if self.enables.contains(&text) {
            return Ok(Some(text));
        }
        let taken = self.take_pin(section, &pin);
        self.enables.extend(taken.clone());
        Ok(taken)
    }

    /// The name of something on an MCU, in the description: without the main MCU's name.
    pub(super) fn on(mcu: &str, name: &str) -> String {
        if mcu == MAIN { name.to_owned() } else { format!("{mcu}:{name}") }
    }

    /// The SPI bus of a chip, and its select pin.
    pub(super) fn spi(&mut self, section: &Section, key: &str) -> Result<Option<(String, Option<String>)>, Trouble> {
        let select = self.pin(section, key)?;
        // `rpi:None` names the MCU of a chip that is alone on its bus.
        let mcu = select.as_ref().map_or(MAIN.to_owned(), |pin| pin.chip.clone());
        let select = select.filter(|pin| pin.name != "None");
        if select.as_ref().is_some_and(|pin| !self.is_real(pin)) {
            return Ok(None);
        }
        let soft = ["sclk", "mosi", "miso"].map(|line| format!("spi_software_{line}_pin"));
        let bus = if section.text(&soft[0]).is_some() {
            let [sclk, mosi, miso] = [0, 1, 2].map(|n| self.pin(section, &soft[n]));
            let [sclk, mosi, miso] = [sclk?, mosi?, miso?].map(|pin| pin.map(|pin| pin.to_string()));
            self.soft_bus(section, "spi_bus", [("sclk_pin", sclk), ("mosi_pin", mosi), ("miso_pin", miso)])
        } else {
            let name = Translator::on(&mcu, section.text("spi_bus").unwrap_or("spi"));
            self.out.bus("spi_bus", &name.clone(), || Entry::default().set("name", name))
        };
        let select = select.and_then(|pin| self.take_pin(section, &pin));
        Ok(Some((bus, select)))
    }

    /// The part of a chip on SPI. `None` if its select pin is no pin of an MCU.
    pub(super) fn chip_on_spi(&mut self, section: &Section, key: &str, kind: &str) -> Result<Option<Entry>, Trouble> {
        let found = self.spi(section, key)?;
        Ok(found.map(|(bus, select)| Entry::of_kind(kind).set("bus", bus).set_if("select_pin", select)))
    }

    /// The part of a chip on I2C. `None` if another section has made it.
    pub(super) fn chip_on_i2c(&mut self, section: &Section, usual: i64, kind: &str) -> Result<Option<Entry>, Trouble> {
        let (bus, address) = (self.i2c(section)?, section.whole("i2c_address", 0)?.unwrap_or(usual));
        let is_new = self.out.is_new_chip(&bus, address);
        Ok(is_new.then(|| Entry::of_kind(kind).set("bus", bus).set("address", address)))
    }

    /// The I2C bus of a chip.
    pub(super) fn i2c(&mut self, section: &Section) -> Result<String, Trouble> {
        let mcu = section.text("i2c_mcu").unwrap_or(MAIN).to_owned();
        // The MCP4018 had other names for its lines until v0.13.
        let lines = [["i2c_software_scl_pin", "i2c_software_sda_pin"], ["scl_pin", "sda_pin"]];
        if let Some(keys) = lines.into_iter().find(|[scl, _]| section.text(scl).is_some()) {
            let [scl, sda] = keys.map(|key| self.pin(section, key));
            let [scl, sda] = [scl?, sda?].map(|pin| pin.map(|pin| Translator::on(&mcu, &pin.name)));
            return Ok(self.soft_bus(section, "i2c_bus", [("scl_pin", scl), ("sda_pin", sda)]));
        }
        let name = Translator::on(&mcu, section.text("i2c_bus").unwrap_or("i2c"));
        Ok(self.out.bus("i2c_bus", &name.clone(), || Entry::default().set("name", name)))
    }

    /// A bus on bare lines: one for each set of lines.
    fn soft_bus<const N: usize>(
        &mut self,
        section: &Section,
        kind: &str,
        lines: [(&str, Option<String>); N],
    ) -> String {
        let key: Vec<&str> = lines.iter().map(|(_, pin)| pin.as_deref().unwrap_or("-")).collect();
        let key = key.join(" ");
        let name = self.out.name(kind, "lines");
        for (_, pin) in &lines {
            if let Some(pin) = pin.as_ref().and_then(|pin| Pin::parse(pin, true, true).ok()) {
                self.taken.entry((pin.chip, pin.name)).or_insert_with(|| section.name.clone());
            }
        }
        self.out.bus(kind, &key, || {
            lines.into_iter().fold(Entry::default().set("name", name), |entry, (key, pin)| entry.set_if(key, pin))
        })
    }

    /// Says what a user should know.
    pub(super) fn note(&mut self, section: &Section, cause: &str, remedy: &str) {
        let trouble = Trouble::new(format!("[{}] {cause}", section.name)).of(&section.place);
        self.notes.push(trouble.remedy(remedy));
    }

    /// The boards, with the pins that have nothing at them. Returns all pins.
    pub(super) fn boards(&mut self) -> Pins {
        let mut all = Pins::new();
        for (chip, pin) in self.taken.keys() {
            all.entry(chip.clone()).or_default().insert(pin.clone());
        }
        for pin in self.named_pins() {
            all.entry(pin.chip).or_default().insert(pin.name);
        }
        for (number, mcu) in self.mcus.iter().enumerate() {
            let names: Vec<String> = all.get(mcu).into_iter().flatten().cloned().collect();
            let is_free = |pin: &&String| !self.taken.contains_key(&(mcu.clone(), (*pin).clone()));
            let free: Vec<toml::Value> = names.iter().filter(is_free).map(|pin| pin.as_str().into()).collect();
            // Crystals differ by some ppm.
            let drift_ppm = [0.0, 12.0, 5.0, 17.0, 9.0][number % 5];
            let board = Entry::default().set("name", mcu.as_str()).set("chip", chip_of(mcu, &names));
            self.out.add("mcu", board.set("drift_ppm", drift_ppm).set("pins", free));
        }
        all
    }

    /// The chip of an MCU, as far as its pins show it.
    pub(super) fn chip(&self, mcu: &str) -> &'static str {
        let pins = self.named_pins().filter(|pin| pin.chip == mcu);
        chip_of(mcu, &pins.map(|pin| pin.name).collect::<Vec<String>>())
    }

    /// The pins of MCUs in all options. Other texts there have an alias before a `=`, or no pin at all: klippy decides.
    fn named_pins(&self) -> impl Iterator<Item = Pin> {
        let sections = self.config.sections().iter().filter(|section| !has_no_pins(section.kind()));
        let settings = sections.flat_map(|section| section.settings().iter().map(move |setting| (section, setting)));
        let texts = settings.filter(|(_, setting)| is_pin(&setting.key)).flat_map(|(section, setting)| {
            let texts = setting.value.split([',', '\n']).map(str::trim).filter(|text| !text.is_empty());
            texts.map(move |text| (section, setting, text))
        });
        let pins = texts.filter_map(|(section, setting, text)| self.pin_of(section, &setting.key, text).ok());
        pins.filter(|pin| self.is_real(pin) && is_klippy_name(&pin.name))
    }
}

/// Sections with options that look like pins, and are none.
fn has_no_pins(kind: &str) -> bool {
    ["board_pins", "gcode_macro", "delayed_gcode", "menu", "display_template", "display_data", "constants"]
        .contains(&kind)
}

/// Whether an option has a pin, or several.
fn is_pin(key: &str) -> bool {
    key == "pin" || key == "pins" || key.ends_with("_pin") || key.ends_with("_pins")
}

/// The chip that has pins with these names. Chips whose own thermometers klippy reads without their memory come first.
fn chip_of(mcu: &str, pins: &[String]) -> &'static str {
    let port = |pin: &str| {
        let rest = pin.strip_prefix('P')?;
        let port = rest.chars().next().filter(char::is_ascii_uppercase)?;
        rest[1..].parse::<u32>().ok().map(|number| (port, number))
    };
    let ports: Vec<(char, u32)> = pins.iter().filter_map(|pin| port(pin)).collect();
    let highest = ports.iter().map(|(_, number)| *number).max();
    let begins = |start: &str| pins.iter().any(|pin| pin.strip_prefix(start).is_some_and(|rest| !rest.is_empty()));
    match highest {
        _ if ["host", "rpi", "pi", "linux"].contains(&mcu) || begins("gpiochip") => "linux",
        Some(16..) => "sam3x8e",
        Some(8..) => "stm32f103xe",
        Some(_) if ports.iter().any(|(port, _)| ('D'..='L').contains(port)) && ports.len() > 8 => "atmega2560",
        Some(_) => "stm32f103xe",
        None if begins("gpio") => "rp2040",
        None if begins("P1.") || begins("P0.") || begins("P2.") => "lpc1769",
        None => "stm32f103xe",
    }
}
