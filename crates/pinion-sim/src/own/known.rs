// SPDX-License-Identifier: GPL-3.0-or-later
//! The sections of Klipper and Kalico: the names of their modules in `klippy/extras` and `klippy/kinematics`.

use pinion_printer_config::Section;

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
const NOT_SIMULATED: &[&str] = &[
    "ads131m0x",
    "ads1x1x",
    "belay",
    "bmi160",
    "dockable_probe",
    "hall_filament_width_sensor",
    "icm20948",
    "lis2dw",
    "lis3dh",
    "mcp4728",
    "mpu9250",
    "palette2",
    "replicape",
    "trad_rack",
    "tsl1401cl_filament_width_sensor",
];

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
    "hx71x",
    "heated_fan",
    "heater_bed",
    "heater_fan",
    "heater_generic",
    "homing_heaters",
    "homing_override",
    "htu21d",
    "idle_timeout",
    "include",
    "input_shaper",
    "led",
    "lm75",
    "load_cell",
    "load_cell_probe",
    "manual_probe",
    "manual_stepper",
    "mcp4018",
    "mcp4451",
    "mcu",
    "menu",
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
    "tuning_tower",
    "verify_heater",
    "virtual_sdcard",
    "z_calibration",
    "z_thermal_adjust",
    "z_tilt",
    "z_tilt_ng",
];

/// The meaning of sections with this first word.
pub(crate) fn kind_of(word: &str) -> Kind {
    let is_numbered = |prefix: &str| {
        word.strip_prefix(prefix).is_some_and(|number| number.chars().all(|digit| digit.is_ascii_digit()))
    };
    match word {
        _ if NOT_SIMULATED.contains(&word) => Kind::NotSimulated,
        _ if KNOWN.contains(&word) || word.starts_with("stepper_") || is_numbered("extruder") => Kind::Known,
        "tmc2130" | "tmc2208" | "tmc2209" | "tmc2240" | "tmc2660" | "tmc5160" => Kind::Known,
        _ => Kind::Strange,
    }
}

/// The name of the section of a driver's motor.
pub(super) fn motor_of(driver: &Section) -> &str {
    driver.name.split_once(' ').map_or("", |(_, motor)| motor.trim())
}
