// SPDX-License-Identifier: GPL-3.0-or-later
//! The pins that sections claim, by klippy's rules (`lookup_pin` of klippy/pins.py): one owner each, unless both share it
//! in the same way.

use std::collections::{HashMap, HashSet};

use pinion_printer_config::pins::{Aliases, Pin};
use pinion_printer_config::{Config, Section, Setting, Trouble};

use super::known::{Kind, kind_of};

/// How klippy looks an option's pin up.
#[derive(Clone, Copy)]
struct Role<'a> {
    can_invert: bool,
    can_pull: bool,
    /// Others with the same word may have the pin, too.
    share: Option<&'a str>,
}

const PLAIN: Role<'static> = Role { can_invert: false, can_pull: false, share: None };
const OUTPUT: Role<'static> = Role { can_invert: true, ..PLAIN };
const INPUT: Role<'static> = Role { can_invert: true, can_pull: true, ..PLAIN };

impl<'a> Role<'a> {
    fn shared(self, share: &'a str) -> Role<'a> {
        Role { share: Some(share), ..self }
    }

    /// The role of an option. `None` if klippy may leave the pin alone.
    fn of(section: &'a Section, key: &str) -> Option<Role<'a>> {
        let kind = section.kind();
        let is_extruder = kind.starts_with("extruder");
        let is_motor = is_extruder || kind.starts_with("stepper_") || kind == "manual_stepper";
        let has_sensor = is_extruder || kind.starts_with("heater_") || kind.starts_with("temperature_");
        let is_fan = ["fan", "heater_fan", "controller_fan", "fan_generic", "temperature_fan"].contains(&kind);
        let is_analog = |option: &str| section.text(option).is_some();
        Some(match (kind, key) {
            (_, "step_pin" | "dir_pin") if is_motor => OUTPUT,
            (_, "enable_pin") if is_motor => OUTPUT.shared("stepper_enable"),
            // The motors of a rail may have one endstop.
            (_, "endstop_pin") if kind.starts_with("stepper_") => INPUT.shared(rail(kind)),
            (_, "endstop_pin") if is_motor => INPUT,
            (_, "sensor_pin") if has_sensor => PLAIN,
            (_, "heater_pin") if has_sensor => OUTPUT,
            (_, "pin" | "enable_pin") if is_fan => OUTPUT,
            (_, "tachometer_pin") if is_fan => Role { can_pull: true, ..PLAIN },
            ("output_pin" | "pwm_tool" | "pwm_cycle_time" | "servo", "pin") => OUTPUT,
            ("static_digital_output", "pins") => OUTPUT,
            ("led", "red_pin" | "green_pin" | "blue_pin" | "white_pin") => OUTPUT,
            ("neopixel", "pin") | ("dotstar", "data_pin" | "clock_pin") => PLAIN,
            ("probe" | "smart_effector" | "dockable_probe", "pin") | ("bltouch", "sensor_pin") => INPUT,
            ("bltouch", "control_pin") => OUTPUT,
            ("filament_switch_sensor" | "filament_motion_sensor", "switch_pin") => INPUT,
            ("gcode_button", "pin") if is_analog("analog_range") => PLAIN.shared("adc button"),
            ("gcode_button", "pin") => INPUT,
            ("display", "encoder_pins") => INPUT,
            ("display", "click_pin" | "back_pin" | "up_pin" | "down_pin" | "kill_pin") => {
                if is_analog(&format!("analog_range_{key}")) { PLAIN.shared("adc button") } else { INPUT }
            }
            ("tmc2208" | "tmc2209", "uart_pin") => Role { can_pull: true, ..PLAIN }.shared("tmc_uart_rx"),
            ("tmc2208" | "tmc2209", "tx_pin") => PLAIN.shared("tmc_uart_tx"),
            ("tmc2130" | "tmc5160" | "tmc2660", "cs_pin") if section.text("chain_length").is_none() => PLAIN,
            _ => return None,
        })
    }
}

/// The first motor of a rail: `stepper_z` for `stepper_z1`.
fn rail(kind: &str) -> &str {
    kind.trim_end_matches(|c: char| c.is_ascii_digit())
}

/// A pin that a section has.
struct Claim {
    pin: Pin,
    share: Option<String>,
}

/// The pins of a whole configuration.
struct Claims<'a> {
    config: &'a Config,
    aliases: &'a Aliases,
    mcus: &'a [String],
    /// The pins of `[duplicate_pin_override]`.
    free: HashSet<(String, String)>,
    claims: HashMap<(String, String), Claim>,
}

/// Checks that each pin has one owner.
///
/// # Errors
///
/// The first pin that klippy refuses, too.
pub(super) fn check(config: &Config, aliases: &Aliases, mcus: &[String]) -> Result<(), Trouble> {
    let overrides =
        config.section("duplicate_pin_override").map(|section| section.list("pins", ',')).unwrap_or_default();
    let place = |pin: Pin| (pin.chip, pin.name);
    let free = overrides.iter().filter_map(|text| Pin::parse(text, false, false).ok()).map(place).collect();
    let mut claims = Claims { config, aliases, mcus, free, claims: HashMap::new() };
    for section in config.sections() {
        for setting in section.settings() {
            let Some(role) = Role::of(section, &setting.key) else { continue };
            let texts = setting.value.split(',').map(str::trim).filter(|text| !text.is_empty());
            for text in texts {
                claims.claim(section, setting, text, role)?;
            }
        }
    }
    Ok(())
}

impl Claims<'_> {
    fn claim(&mut self, section: &Section, setting: &Setting, text: &str, role: Role<'_>) -> Result<(), Trouble> {
        let refused = |cause: String, remedy: &str| Err(section.trouble(&setting.key, cause).remedy(remedy));
        let pin = match Pin::parse(text, role.can_invert, role.can_pull) {
            Ok(pin) => pin,
            Err(cause) => return refused(cause, "correct the name"),
        };
        if !self.mcus.contains(&pin.chip) {
            if !self.is_chip(&pin.chip) {
                let cause = format!("Unknown pin chip name '{}'", pin.chip);
                return refused(cause, "correct it, or add the section of the chip");
            }
            return Ok(());
        }
        // `host:None` is no pin, and names the MCU of a chip that is alone on its bus.
        if pin.name == "None" {
            return Ok(());
        }
        // Two names may be those of one pin.
        let pin = self.aliases.resolve(&pin);
        let place = (pin.chip.clone(), pin.name.clone());
        if let Some(known) = self.claims.get(&place).filter(|_| !self.free.contains(&place)) {
            if role.share.is_none() || role.share != known.share.as_deref() {
                return refused(format!("pin {} used multiple times in config", pin.name), "name a pin of its own");
            }
            if (pin.inverted, pin.pull) != (known.pin.inverted, known.pin.pull) {
                return refused(format!("Shared pin {} must have same polarity", pin.name), "write it in the same way");
            }
            return Ok(());
        }
        self.claims.insert(place, Claim { pin, share: role.share.map(str::to_owned) });
        Ok(())
    }

    /// Whether some section may be a chip with this name. A plugin's has a name like its section's.
    fn is_chip(&self, chip: &str) -> bool {
        let is_probe = |kind: &str| kind.contains("probe") || kind == "bltouch" || kind == "smart_effector";
        self.config.sections().iter().any(|section| {
            let kind = section.kind();
            let is_plugins = kind_of(kind) == Kind::Strange;
            is_plugins && (chip == "probe" || section.name.contains(chip) || chip.contains(kind))
                || section.own_name() == Some(chip)
                || kind == chip
                || section.name.replace(' ', "_") == chip
                || (chip == "probe" && is_probe(kind))
        })
    }
}
