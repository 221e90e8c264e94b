// SPDX-License-Identifier: GPL-3.0-or-later
//! The sections of Klipper and Kalico: the names of their modules in `klippy/extras` and `klippy/kinematics`.

use std::path::Path;

use pinion_printer_config::{Config, Section};
use pinion_system::klippy::has_module;

/// The meaning of a section here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Simulated, or it needs no hardware.
    Known,
    /// Klipper's or Kalico's hardware without a simulation.
    NotSimulated,
    /// A module of somebody else, or a mistake.
    Strange,
}

/// Hardware without a simulation.
const NOT_SIMULATED: &[&str] = &["ads131m0x", "ads1x1x", "belay", "mcp4728", "palette2", "replicape", "trad_rack"];

/// All others.
const KNOWN: &str = include_str!("sections.txt");

fn known() -> impl Iterator<Item = &'static str> {
    KNOWN.lines().filter(|line| !line.starts_with('#')).flat_map(str::split_whitespace)
}

pub(super) fn is_numbered(word: &str, prefix: &str) -> bool {
    word.strip_prefix(prefix).is_some_and(|number| number.chars().all(|digit| digit.is_ascii_digit()))
}

/// The meaning of sections with this first word.
pub(crate) fn kind_of(word: &str) -> Kind {
    match word {
        _ if NOT_SIMULATED.contains(&word) => Kind::NotSimulated,
        _ if known().any(|own| own == word) || word.starts_with("stepper_") || is_numbered(word, "extruder") => {
            Kind::Known
        }
        _ => Kind::Strange,
    }
}

/// The known section whose name a first word misspells, by one letter or two that are swapped.
pub(super) fn near(word: &str) -> Option<&'static str> {
    // A short word of a plugin is near to many others.
    const LETTERS_MIN: usize = 5;
    known().find(|known| word.len() >= LETTERS_MIN && strsim::osa_distance(word, known) == 1)
}

/// Sections of klippy without a module of their own.
const WITHOUT_MODULE: &[&str] = &[
    "carriage",
    "constants",
    "display_data",
    "display_glyph",
    "display_template",
    "dual_carriage",
    "extra_carriage",
    "mcu",
    "menu",
    "pid_profile",
    "printer",
    "stepper",
];

/// Whether a klippy has no module for sections with this first word. Without a checkout, whether neither Klipper nor Kalico
/// has.
pub(super) fn lacks_module(word: &str, klipper: Option<&Path>) -> bool {
    let Some(klipper) = klipper else { return kind_of(word) == Kind::Strange };
    let is_built_in = WITHOUT_MODULE.contains(&word) || word.starts_with("stepper_") || is_numbered(word, "extruder");
    !is_built_in && !has_module(&klipper.join("klippy"), word)
}

/// klippy's sections that make the probe, beside `[probe]`.
pub(super) const MAKES_PROBE: [&str; 5] =
    ["bltouch", "dockable_probe", "load_cell_probe", "probe_eddy_current", "smart_effector"];

/// Whether klippy loads nothing for this `[probe]`, because a section before it has made the probe. SAVE_CONFIG leaves such
/// sections behind. A section of somebody's module may have made it.
pub(super) fn is_left_over(config: &Config, section: &Section) -> bool {
    let has_made_it = |other: &Section| {
        let is_strange = kind_of(other.kind()) == Kind::Strange && section.text("pin").is_none();
        MAKES_PROBE.contains(&other.kind()) || is_strange
    };
    section.name == "probe" && config.sections().iter().take_while(|other| other.name != "probe").any(has_made_it)
}

/// The name of the section of a driver's motor.
pub(super) fn motor_of(driver: &Section) -> &str {
    driver.name.split_once(' ').map_or("", |(_, motor)| motor.trim())
}

/// The kinematics of Klipper and Kalico. Of names within each other, the longer one comes first.
const KINEMATICS: [&str; 15] = [
    "limited_cartesian",
    "limited_corexy",
    "limited_corexz",
    "hybrid_corexy",
    "hybrid_corexz",
    "generic_cartesian",
    "rotary_delta",
    "cartesian",
    "corexy",
    "corexz",
    "deltesian",
    "delta",
    "polar",
    "winch",
    "none",
];

/// Whether klippy has these kinematics.
pub(super) fn has_kinematics(kinematics: &str) -> bool {
    KINEMATICS.contains(&kinematics)
}

/// The kinematics that stand for these: their own, or those that the name of a plugin's ends with.
pub(super) fn simulated_kinematics(kinematics: &str) -> Option<&'static str> {
    KINEMATICS
        .into_iter()
        .find(|known| kinematics == *known || kinematics.strip_suffix(known).is_some_and(|rest| rest.ends_with('_')))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_module_may_be_a_file_or_a_folder_of_extras_or_plugins() {
        let klipper = tempfile::tempdir().unwrap();
        let extras = klipper.path().join("klippy/extras");
        std::fs::create_dir_all(extras.join("display")).unwrap();
        std::fs::create_dir_all(klipper.path().join("klippy/plugins")).unwrap();
        for file in ["extras/bltouch.py", "extras/display/__init__.py", "plugins/beacon.py"] {
            std::fs::write(klipper.path().join("klippy").join(file), "").unwrap();
        }
        let lacks = |word: &str| lacks_module(word, Some(klipper.path()));
        for word in ["bltouch", "display", "beacon", "stepper_x", "extruder1", "mcu", "printer"] {
            assert!(!lacks(word), "{word}");
        }
        for word in ["shaketune", "gcode_shell_command", "extruder_fan"] {
            assert!(lacks(word), "{word}");
        }
        assert!(lacks_module("shaketune", None) && !lacks_module("gcode_shell_command", None));
    }

    #[test]
    fn a_misspelled_section_is_near_to_one() {
        for (word, meant) in [
            ("heater_fann", Some("heater_fan")),
            ("haeter_bed", Some("heater_bed")),
            ("bed_mash", Some("bed_mesh")),
            ("gcode_macr", Some("gcode_macro")),
            ("mmu", None),
            ("beacon", None),
            ("led_effect", None),
        ] {
            assert_eq!(near(word), meant, "{word}");
        }
    }

    #[test]
    fn klippers_own_sections_are_known() {
        for word in
            ["query_adc", "pid_calibrate", "print_stats", "gcode_move", "heaters", "buttons", "statistics", "indx"]
        {
            assert_eq!(kind_of(word), Kind::Known, "{word}");
        }
        assert_eq!([kind_of("ads1x1x"), kind_of("shaketune")], [Kind::NotSimulated, Kind::Strange]);
    }
}
