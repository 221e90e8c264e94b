// SPDX-License-Identifier: GPL-3.0-or-later
//! Fans, lights and servos do what a command says.

use std::time::Duration;

use super::{Seen, skipped};
use crate::attempt::trial::{LONG, SOON, Trial};

pub(super) fn fans(trial: &mut Trial<'_>) -> Seen {
    let mut fans: Vec<(String, String, String)> = Vec::new();
    if trial.has("fan") {
        fans.push(("fan".into(), "M106 S255".into(), "M106 S0".into()));
    }
    for name in trial.named("fan_generic") {
        let set = |speed| format!("SET_FAN_SPEED FAN={name} SPEED={speed}");
        fans.push((name.clone(), set(1), set(0)));
    }
    if fans.is_empty() {
        return skipped("there is no fan that a command switches");
    }
    for (name, on, off) in &fans {
        trial.gcode(on, LONG)?;
        let until = trial.host.now() + SOON;
        while trial.probe.fan(name).is_some_and(|fan| fan.rpm < 500.0) {
            if trial.host.now() > until {
                let place = trial.place(name).or_else(|| trial.place(&format!("fan_generic {name}")));
                return Err(trial.failed(format!("{on}: the fan stands still"), place));
            }
            trial.sleep(Duration::from_millis(50));
        }
        trial.gcode(off, LONG)?;
    }
    let names: Vec<&str> = fans.iter().map(|(name, ..)| name.as_str()).collect();
    Ok(names.join(", "))
}

pub(super) fn lights(trial: &mut Trial<'_>) -> Seen {
    let kinds = ["led", "neopixel", "dotstar", "pca9533", "pca9632"];
    let colors = ["RED=1 GREEN=0.5 BLUE=0", "RED=0 GREEN=0 BLUE=0"];
    each(trial, "light", &kinds, |name| colors.map(|color| format!("SET_LED LED={name} {color}")))
}

pub(super) fn servo(trial: &mut Trial<'_>) -> Seen {
    each(trial, "servo", &["servo"], |name| [90, 0].map(|angle| format!("SET_SERVO SERVO={name} ANGLE={angle}")))
}

/// Gives two commands to each object of these kinds.
fn each(trial: &mut Trial<'_>, what: &str, kinds: &[&str], commands: impl Fn(&str) -> [String; 2]) -> Seen {
    let names: Vec<String> = kinds.iter().flat_map(|kind| trial.named(kind)).collect();
    if names.is_empty() {
        return skipped(format!("there is no {what}"));
    }
    for command in names.iter().flat_map(|name| commands(name)) {
        trial.gcode(&command, LONG)?;
    }
    Ok(names.join(", "))
}
