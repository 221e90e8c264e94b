// SPDX-License-Identifier: GPL-3.0-or-later
//! The phases of a print: the printer heats, homes, levels, prints or is paused.

/// A part of a print.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    Heating,
    Homing,
    Leveling,
    Printing,
    Paused,
}

impl Phase {
    pub(super) const ALL: [Phase; 5] = [Phase::Heating, Phase::Homing, Phase::Leveling, Phase::Printing, Phase::Paused];

    pub(super) fn name(self) -> &'static str {
        match self {
            Phase::Heating => "heating",
            Phase::Homing => "homing",
            Phase::Leveling => "leveling",
            Phase::Printing => "printing",
            Phase::Paused => "paused",
        }
    }
}

/// The printer at an instant.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sight<'a> {
    /// The line of the file that klippy runs.
    pub(super) line: &'a str,
    pub(super) is_paused: bool,
    /// klippy moves something.
    pub(super) moves: bool,
    /// A heater is colder than it should be.
    pub(super) is_cold: bool,
    /// klippy has homed x, y and z.
    pub(super) is_homed: bool,
    /// Filament was laid.
    pub(super) has_begun: bool,
}

/// Commands that find out where the bed or the gantry is.
const LEVEL: [&str; 8] = [
    "BED_MESH_CALIBRATE",
    "BED_TILT_CALIBRATE",
    "Z_TILT_ADJUST",
    "QUAD_GANTRY_LEVEL",
    "DELTA_CALIBRATE",
    "SCREWS_TILT_CALCULATE",
    "PROBE_CALIBRATE",
    "PROBE",
];

impl Phase {
    /// The phase of an instant. A macro may do anything, so what the printer does counts more than the line.
    pub(super) fn of(sight: Sight<'_>) -> Phase {
        let command = sight.line.split([' ', ';']).next().unwrap_or_default().to_uppercase();
        if sight.is_paused {
            Phase::Paused
        } else if !sight.moves && sight.is_cold {
            Phase::Heating
        } else if command == "G28" {
            Phase::Homing
        } else if LEVEL.contains(&command.as_str()) {
            Phase::Leveling
        } else if sight.has_begun {
            Phase::Printing
        } else if !sight.is_homed {
            Phase::Homing
        } else if command.starts_with(['G', 'M', 'T']) {
            Phase::Printing
        } else {
            // A macro, before anything is printed.
            Phase::Leveling
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_printer_does_says_more_than_the_line() {
        let start = Sight { line: "START_PRINT BED=60", is_homed: true, moves: true, ..Sight::default() };
        let cold = Sight { is_cold: true, ..start };
        for (sight, phase) in [
            (start, Phase::Leveling),
            (Sight { is_homed: false, ..start }, Phase::Homing),
            // It homes while it heats.
            (Sight { is_homed: false, ..cold }, Phase::Homing),
            (Sight { moves: false, ..cold }, Phase::Heating),
            (Sight { line: "M109 S200", moves: false, ..cold }, Phase::Heating),
            (Sight { line: "G28 ; all", ..start }, Phase::Homing),
            (Sight { line: "G28", has_begun: true, ..start }, Phase::Homing),
            (Sight { line: "bed_mesh_calibrate", ..start }, Phase::Leveling),
            (Sight { line: "G1 X10", ..start }, Phase::Printing),
            (Sight { line: "LINE_PURGE", has_begun: true, ..start }, Phase::Printing),
            (Sight { line: "PAUSE", is_paused: true, ..cold }, Phase::Paused),
        ] {
            assert_eq!(Phase::of(sight), phase, "{sight:?}");
        }
    }
}
