// SPDX-License-Identifier: GPL-3.0-or-later
//! All heaters get warm, and cool again when they are off.

use std::time::Duration;

use pinion_printer_config::Limit;
use serde_json::Value;

use super::{Seen, skipped};
use crate::attempt::report::Outcome;
use crate::attempt::trial::{LONG, Trial};

/// How long a heater may take.
const HEAT: Duration = Duration::from_secs(240);
/// How near a temperature has to be.
const NEAR_K: f64 = 4.0;

/// The heaters with klippy's name and a usual temperature of theirs.
pub(super) fn targets(trial: &mut Trial<'_>) -> Vec<(String, f64)> {
    let names = trial.host.heaters().unwrap_or_default();
    let target = |name: String| {
        let section = trial.config().section(&name)?;
        let number = |key| section.number(key, Limit::Any).ok().flatten();
        let max = number("max_temp")?;
        let usual = if section.kind().starts_with("extruder") {
            number("min_extrude_temp").unwrap_or(170.0).max(200.0)
        } else if section.kind() == "heater_bed" {
            60.0
        } else {
            50.0
        };
        Some((name, usual.min(max - 10.0)))
    };
    names.into_iter().filter_map(target).collect()
}

pub(super) fn heated(trial: &mut Trial<'_>) -> Seen {
    let targets = targets(trial);
    if targets.is_empty() {
        return skipped("there is no heater");
    }
    heat(trial, &targets)?;
    let objects: Vec<&str> = targets.iter().map(|(name, _)| name.as_str()).collect();
    // klippy's reading has to be the heater's temperature.
    let status = trial.host.query(&objects).unwrap_or_default();
    for name in objects {
        let read = celsius(&status, name);
        let heater = trial.probe.heater(own_name(name));
        if let Some(heater) = heater.filter(|heater| (heater.sensor_celsius - read).abs() > 3.0 * NEAR_K) {
            let section = trial.config().section(name);
            let place = section.map(|section| section.place_of("sensor_type").clone());
            return Err(trial.failed(format!("klippy reads {read:.0} C at {:.0} C", heater.sensor_celsius), place));
        }
    }
    let seen: Vec<String> = targets.iter().map(|(name, target)| format!("{name} {target:.0} C")).collect();
    Ok(seen.join(", "))
}

pub(super) fn cooled(trial: &mut Trial<'_>) -> Seen {
    let targets = targets(trial);
    if targets.is_empty() {
        return skipped("there is no heater");
    }
    let objects: Vec<&str> = targets.iter().map(|(name, _)| name.as_str()).collect();
    let read = |trial: &mut Trial<'_>| match trial.host.query(&objects) {
        Ok(status) => Ok(objects.iter().map(|name| celsius(&status, name)).collect::<Vec<f64>>()),
        Err(refused) => Err(trial.failed(format!("klippy does not answer: {refused}"), None)),
    };
    let hot = read(trial)?;
    trial.gcode("TURN_OFF_HEATERS", LONG)?;
    let until = trial.host.now() + HEAT;
    loop {
        trial.still_ready()?;
        let now = read(trial)?;
        let still = hot.iter().zip(&now).position(|(hot, now)| *hot > 45.0 && hot - now < 2.0);
        match still {
            None => return Ok("all heaters are off, and cool".into()),
            Some(n) if trial.host.now() > until => {
                return Err(trial.failed(format!("{} is off and does not cool", objects[n]), None));
            }
            Some(_) => trial.sleep(Duration::from_millis(500)),
        }
    }
}

/// Heats the extruder that prints. A macro may have chosen another one.
pub(super) fn heat_extruder(trial: &mut Trial<'_>) -> Result<(), Outcome> {
    let toolhead = trial.toolhead()?;
    let active = toolhead["extruder"].as_str().unwrap_or("extruder");
    let mut targets = targets(trial);
    targets.retain(|(name, _)| name == active);
    heat(trial, &targets)
}

/// Heats, and waits until all have their targets.
fn heat(trial: &mut Trial<'_>, targets: &[(String, f64)]) -> Result<(), Outcome> {
    for (name, target) in targets {
        trial.gcode(&format!("SET_HEATER_TEMPERATURE HEATER={} TARGET={target}", own_name(name)), LONG)?;
    }
    let until = trial.host.now() + HEAT;
    let objects: Vec<&str> = targets.iter().map(|(name, _)| name.as_str()).collect();
    loop {
        let status = match trial.host.query(&objects) {
            Ok(status) => status,
            Err(refused) => return Err(trial.failed(format!("klippy does not answer: {refused}"), None)),
        };
        let cold = targets.iter().find(|(name, target)| (celsius(&status, name) - target).abs() > NEAR_K);
        let Some((name, target)) = cold else { return Ok(()) };
        trial.still_ready()?;
        if trial.host.now() > until {
            let cause = format!("{name} is at {:.0} of {target} C", celsius(&status, name));
            return Err(trial.failed(cause, trial.place(name)));
        }
        trial.sleep(Duration::from_millis(500));
    }
}

/// The name of a heater without its kind, as commands take it.
fn own_name(object: &str) -> &str {
    object.rsplit(' ').next().unwrap_or(object)
}

/// klippy's reading.
fn celsius(status: &Value, object: &str) -> f64 {
    status[object]["temperature"].as_f64().unwrap_or_default()
}
