// SPDX-License-Identifier: GPL-3.0-or-later
//! The sections of Klipper and Kalico: the names of their modules in `klippy/extras` and `klippy/kinematics`.

use std::path::Path;

use pinion_printer_config::{Config, Section};

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
const NOT_SIMULATED: &[&str] =
    &["ads131m0x", "ads1x1x", "belay", "dockable_probe", "mcp4728", "palette2", "replicape", "trad_rack"];

/// All others.
const KNOWN: &[&str] = &[
    "ad5206",
    "adc_scaled",
    "adc_temperature",
    "ads1220",
    "adxl345",
    "aht10",
    "angle",
    "axis_twist_compensation",
    "bed_mesh",
    "bed_screws",
    "bed_tilt",
    "bltouch",
    "bme280",
    "bmi160",
    "board_pins",
    "bus",
    "carriage",
    "constants",
    "controller_fan",
    "dac084S085",
    "danger_options",
    "delayed_gcode",
    "delta_calibrate",
    "display",
    "display_data",
    "display_glyph",
    "display_status",
    "display_template",
    "dotstar",
    "ds18b20",
    "dual_carriage",
    "duplicate_pin_override",
    "endstop_phase",
    "exclude_object",
    "extra_carriage",
    "extruder_stepper",
    "fan",
    "fan_generic",
    "filament_motion_sensor",
    "filament_switch_sensor",
    "firmware_retraction",
    "force_move",
    "gcode_arcs",
    "gcode_button",
    "gcode_macro",
    "gcode_shell_command",
    "hall_filament_width_sensor",
    "hx71x",
    "heated_fan",
    "heater_bed",
    "heater_fan",
    "heater_generic",
    "homing_heaters",
    "homing_override",
    "htu21d",
    "icm20948",
    "idle_timeout",
    "include",
    "input_shaper",
    "led",
    "lis2dw",
    "lis3dh",
    "lm75",
    "load_cell",
    "load_cell_probe",
    "manual_probe",
    "manual_stepper",
    "mcp4018",
    "mcp4451",
    "mcu",
    "menu",
    "mpu9250",
    "mixing_extruder",
    "multi_pin",
    "neopixel",
    "nozzle_cleanup",
    "output_pin",
    "pause_resume",
    "pca9533",
    "pca9632",
    "pid_profile",
    "printer",
    "probe",
    "probe_eddy_current",
    "pwm_cycle_time",
    "pwm_tool",
    "quad_gantry_level",
    "resonance_tester",
    "respond",
    "safe_z_home",
    "samd_sercom",
    "save_variables",
    "screws_tilt_adjust",
    "sdcard_loop",
    "servo",
    "sht3x",
    "skew_correction",
    "smart_effector",
    "static_digital_output",
    "static_pwm_clock",
    "stepper",
    "sx1509",
    "telemetry",
    "temperature_combined",
    "temperature_fan",
    "temperature_host",
    "temperature_probe",
    "temperature_sensor",
    "thermistor",
    "tools_calibrate",
    "tsl1401cl_filament_width_sensor",
    "tuning_tower",
    "verify_heater",
    "virtual_sdcard",
    "z_calibration",
    "z_thermal_adjust",
    "z_tilt",
    "z_tilt_ng",
];

fn is_numbered(word: &str, prefix: &str) -> bool {
    word.strip_prefix(prefix).is_some_and(|number| number.chars().all(|digit| digit.is_ascii_digit()))
}

/// The meaning of sections with this first word.
pub(crate) fn kind_of(word: &str) -> Kind {
    match word {
        _ if NOT_SIMULATED.contains(&word) => Kind::NotSimulated,
        _ if KNOWN.contains(&word) || word.starts_with("stepper_") || is_numbered(word, "extruder") => Kind::Known,
        "tmc2130" | "tmc2208" | "tmc2209" | "tmc2240" | "tmc2660" | "tmc5160" => Kind::Known,
        _ => Kind::Strange,
    }
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
    let has = |folder: &str| {
        let module = klipper.join("klippy").join(folder).join(word);
        module.with_extension("py").exists() || module.join("__init__.py").exists()
    };
    !is_built_in && !["extras", "plugins"].into_iter().any(has)
}

/// Whether klippy loads nothing for this `[probe]`, because a section before it has made the probe. SAVE_CONFIG leaves such
/// sections behind. A section of somebody's module may have made it.
pub(super) fn is_left_over(config: &Config, section: &Section) -> bool {
    const PROBES: [&str; 4] = ["bltouch", "load_cell_probe", "probe_eddy_current", "smart_effector"];
    let has_made_it = |other: &Section| {
        let is_strange = kind_of(other.kind()) == Kind::Strange && section.text("pin").is_none();
        PROBES.contains(&other.kind()) || is_strange
    };
    section.name == "probe" && config.sections().iter().take_while(|other| other.name != "probe").any(has_made_it)
}

/// The name of the section of a driver's motor.
pub(super) fn motor_of(driver: &Section) -> &str {
    driver.name.split_once(' ').map_or("", |(_, motor)| motor.trim())
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
}
