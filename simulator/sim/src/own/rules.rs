// SPDX-License-Identifier: GPL-3.0-or-later
//! The rules of klippy that help most where no klippy can be asked. klippy itself knows all others.

use pinion_printer_config::{Config, Limit, Section, Trouble};

use super::known::{Kind, has_kinematics, kind_of, motor_of, near};
use super::sensors::is_known;

/// Checks all sections.
///
/// # Errors
///
/// The first one that klippy refuses, too.
pub(super) fn check(config: &Config) -> Result<(), Trouble> {
    // A plugin may have sensors and kinematics, too.
    let has_plugin = config.sections().iter().any(|section| kind_of(section.kind()) == Kind::Strange);
    config.sections().iter().try_for_each(|section| checked(config, section, has_plugin))
}

fn checked(config: &Config, section: &Section, has_plugin: bool) -> Result<(), Trouble> {
    let kind = section.kind();
    let refused = |key: &str, cause: String, remedy: &str| Err(section.trouble(key, cause).remedy(remedy));
    if kind_of(kind) == Kind::Strange
        && let Some(near) = near(kind)
    {
        let cause = format!("Section '{}' is not a valid config section", section.name);
        return refused("", cause, &format!("did you mean [{near}]?"));
    }
    if kind.starts_with("tmc") && kind_of(kind) == Kind::Known && config.section(motor_of(section)).is_none() {
        let cause = format!("Could not find config section '[{}]' required by tmc driver", motor_of(section));
        return refused("", cause, "add it, or remove the driver");
    }
    if let Some(sensor) = section
        .text("sensor_type")
        .filter(|sensor| section.text("min_temp").is_some() && !has_plugin && !is_known(config, sensor))
    {
        let cause = format!("Unknown temperature sensor '{sensor}'");
        return refused("sensor_type", cause, "correct it, or add [thermistor] or [adc_temperature]");
    }
    if let Some(kinematics) = section.text("kinematics").filter(|named| !has_plugin && !has_kinematics(named)) {
        let cause = format!("Error loading kinematics '{kinematics}'");
        return refused("kinematics", cause, "name one of Klipper's kinematics");
    }
    if kind == "heater_fan" {
        for heater in section.list("heater", ',') {
            let mut named = config.sections().iter().filter(|other| other.text("heater_pin").is_some());
            if !named.any(|other| other.own_name().unwrap_or(&other.name) == heater) {
                return refused("heater", format!("Unknown heater '{heater}'"), "name a heater of this printer");
            }
        }
    }
    if section.text("heater_pin").is_some() {
        let min = section.number("min_temp", Limit::Any)?.unwrap_or(f64::MIN);
        section.number("max_temp", Limit::Above(min))?;
    }
    Ok(())
}
