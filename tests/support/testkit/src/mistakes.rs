// SPDX-License-Identifier: GPL-3.0-or-later
//! A printer.cfg, and mistakes in it that klippy refuses.

/// A printer of two boards without a mistake.
pub const PRINTER: &str = include_str!("../two-boards.cfg");

/// A mistake: a text of [`PRINTER`] that is replaced once.
#[derive(Clone, Copy, Debug)]
pub struct Mistake {
    from: &'static str,
    to: &'static str,
    /// The line that a report has to name.
    line: &'static str,
    /// klippy's words.
    pub words: &'static str,
    /// Whether klippy sees it before it asks an MCU.
    pub is_early: bool,
    /// Whether only klippy sees it.
    pub is_klippys: bool,
}

impl Mistake {
    /// The printer.cfg with this mistake.
    pub fn text(&self) -> String {
        let text = PRINTER.replacen(self.from, self.to, 1);
        assert_ne!(text, PRINTER, "{:?} is not there", self.from);
        text
    }

    /// The number of the line that a report has to name.
    pub fn line(&self) -> usize {
        let text = self.text();
        let found = text.lines().position(|line| line == self.line);
        1 + found.unwrap_or_else(|| panic!("{:?} is no line of\n{text}", self.line))
    }
}

const fn early(from: &'static str, to: &'static str, line: &'static str, words: &'static str) -> Mistake {
    Mistake { from, to, line, words, is_early: true, is_klippys: false }
}

const fn late(from: &'static str, to: &'static str, line: &'static str, words: &'static str) -> Mistake {
    Mistake { from, to, line, words, is_early: false, is_klippys: false }
}

/// A mistake that only klippy sees.
const fn judged(mistake: Mistake) -> Mistake {
    Mistake { is_klippys: true, ..mistake }
}

/// A line that becomes another one.
const fn wrong(from: &'static str, to: &'static str, words: &'static str) -> Mistake {
    early(from, to, to, words)
}

/// A value of an option, in klippy's usual words.
macro_rules! value {
    ($section:literal, $option:literal, $from:literal => $to:literal, $must:literal) => {
        wrong(
            concat!($option, ": ", $from),
            concat!($option, ": ", $to),
            concat!("Option '", $option, "' in section '", $section, "' ", $must),
        )
    };
}

/// An option without which a section is refused, and the line that is left out or becomes another one.
macro_rules! missing {
    ($line:literal, $section:literal, $option:literal) => {
        missing!(@ $line, "", $section, $option)
    };
    ($line:literal => $other:literal, $section:literal, $option:literal) => {
        missing!(@ $line, concat!($other, "\n"), $section, $option)
    };
    (@ $line:literal, $to:expr, $section:literal, $option:literal) => {
        early(
            concat!($line, "\n"),
            $to,
            concat!("[", $section, "]"),
            concat!("Option '", $option, "' in section '", $section, "' must be specified"),
        )
    };
}

/// The mistakes.
pub const MISTAKES: &[Mistake] = &[
    // Lines and files.
    early("[printer]\n", "printer]\n", "printer]", "Source contains parsing errors"),
    wrong("max_accel: 3000", "max_accel 3000", "Source contains parsing errors"),
    early("[fan]\n", "[include none.cfg]\n[fan]\n", "[include none.cfg]", "none.cfg' does not exist"),
    // Options that must be there.
    missing!("kinematics: cartesian", "printer", "kinematics"),
    judged(missing!("max_velocity: 300", "printer", "max_velocity")),
    judged(missing!("max_accel: 3000", "printer", "max_accel")),
    missing!("step_pin: PB9", "stepper_x", "step_pin"),
    missing!("dir_pin: PB7", "stepper_y", "dir_pin"),
    missing!("rotation_distance: 8" => "rotation_distanc: 8", "stepper_z", "rotation_distance"),
    missing!("microsteps: 16", "stepper_x", "microsteps"),
    missing!("position_endstop: -5", "stepper_x", "position_endstop"),
    missing!("position_max: 250", "stepper_z", "position_max"),
    missing!("uart_pin: PC11", "tmc2209 stepper_y", "uart_pin"),
    judged(missing!("nozzle_diameter: 0.4", "extruder", "nozzle_diameter")),
    judged(missing!("max_temp: 250", "extruder", "max_temp")),
    judged(missing!("control: watermark", "heater_bed", "control")),
    judged(missing!("pid_Kd: 114", "extruder", "pid_Kd")),
    missing!("sensor_pin: PA1", "heater_bed", "sensor_pin"),
    missing!("pin: PA7", "fan", "pin"),
    missing!("z_offset: 1.5", "probe", "z_offset"),
    judged(missing!("home_xy_position: 100, 100" => "speed: 50", "safe_z_home", "home_xy_position")),
    judged(missing!("mesh_max: 200, 200", "bed_mesh", "mesh_max")),
    judged(missing!("switch_pin: ^PB2" => "pause_on_runout: True", "filament_switch_sensor filament", "switch_pin")),
    judged(missing!("path: ~/printer_data/gcodes", "virtual_sdcard", "path")),
    missing!("serial: /dev/serial/by-id/usb-a", "mcu", "serial"),
    // Values.
    judged(wrong(
        "max_velocity: 300",
        "max_velocity: fast",
        "Unable to parse option 'max_velocity' in section 'printer'",
    )),
    judged(value!("printer", "max_accel", "3000" => "0", "must be above 0.0")),
    value!("stepper_x", "rotation_distance", "40" => "-40", "must be above 0.0"),
    wrong("microsteps: 16", "microsteps: 16.5", "Unable to parse option 'microsteps' in section 'stepper_x'"),
    early(
        "rotation_distance: 40\ngear_ratio: 3:1, 2:1",
        "rotation_distance: 40\ngear_ratio: 3",
        "gear_ratio: 3",
        "Option 'gear_ratio' in section 'stepper_y' must have 2 elements",
    ),
    judged(early(
        "microsteps: 16\nrotation_distance: 40\ngear",
        "microsteps: 12\nrotation_distance: 40\ngear",
        "microsteps: 12",
        "Choice '12' for option 'microsteps' in section 'stepper_y' is not a valid choice",
    )),
    judged(value!("extruder", "filament_diameter", "1.75" => "0.3", "must have minimum of 0.4")),
    value!("heater_bed", "max_temp", "110" => "-110", "must be above 0.0"),
    judged(early(
        "pin: PA7\n",
        "pin: PA7\nmax_power: 255\n",
        "max_power: 255",
        "Option 'max_power' in section 'fan' must have maximum of 1.0",
    )),
    judged(value!("safe_z_home", "home_xy_position", "100, 100" => "100", "must have 2 elements")),
    judged(value!("tmc2209 stepper_y", "run_current", "0.8" => "800", "must have maximum of 2.0")),
    value!("tmc2209 stepper_y", "uart_address", "1" => "4", "must have maximum of 3"),
    wrong("chain_count: 3", "color_order: GXB", "Invalid color_order 'GXB'"),
    wrong("sensor_type: Generic 3950", "sensor_type: Generic 3590", "Unknown temperature sensor 'Generic 3590'"),
    wrong("kinematics: cartesian", "kinematics: cube", "Error loading kinematics 'cube'"),
    judged(wrong(
        "control: watermark",
        "control: bang",
        "Choice 'bang' for option 'control' in section 'heater_bed' is not a valid choice",
    )),
    // Options beside others.
    wrong(
        "position_endstop: -5",
        "position_endstop: 100",
        "Unable to infer homing_positive_dir in section 'stepper_x'",
    ),
    wrong(
        "position_endstop: -5",
        "position_endstop: -6",
        "position_endstop in section 'stepper_x' must be between position_min and position_max",
    ),
    judged(wrong("mesh_max: 200, 200", "mesh_max: 200, 20", "bed_mesh: invalid min/max points")),
    judged(early("screw3: 110, 200\n", "", "screw1: 30, 30", "screws_tilt_adjust: Must have at least three screws")),
    judged(early(
        "[servo arm]\n",
        "[homing_override]\ngcode: G28\n[servo arm]\n",
        "home_xy_position: 100, 100",
        "homing_override and safe_z_homing cannot be used simultaneously",
    )),
    judged(late("  250,110\n", "", "z_positions: -20,110", "z_tilt z_positions needs exactly 2 items")),
    late("heater: extruder", "heater: extruder2", "heater: extruder2", "Unknown heater 'extruder2'"),
    // Pins.
    wrong("dir_pin: PB7", "dir_pin: PB9", "pin PB9 used multiple times in config"),
    wrong("pin: PA8", "pin: !PA7", "pin PA7 used multiple times in config"),
    wrong("pin: PA9", "pin: PC8", "pin PC8 used multiple times in config"),
    early(
        "enable_pin: !PC3\nmicrosteps: 16\nrotation_distance: 40\ngear",
        "enable_pin: PC3\nmicrosteps: 16\nrotation_distance: 40\ngear",
        "enable_pin: PC3",
        "Shared pin PC3 must have same polarity",
    ),
    wrong("step_pin: PB9", "step_pin: ^PB9", "Invalid pin description '^PB9'"),
    wrong("sensor_pin: PA0", "sensor_pin: !PA0", "Invalid pin description '!PA0'"),
    early("pin: PB1\n", "pin: P B1\n", "pin: P B1", "Invalid pin description 'P B1'"),
    wrong("step_pin: tool:gpio1", "step_pin: tol:gpio1", "Unknown pin chip name 'tol'"),
    judged(early(
        "diag_pin: ^PC12\n",
        "",
        "endstop_pin: tmc2209_stepper_y:virtual_endstop",
        "tmc virtual endstop requires diag pin config",
    )),
    judged(wrong(
        "endstop_pin: tmc2209_stepper_y:virtual_endstop",
        "endstop_pin: ^tmc2209_stepper_y:virtual_endstop",
        "Can not pullup/invert tmc virtual pin",
    )),
    judged(late("pin: PA9", "pin: PB8", "pin: PB8", " is an alias for ")),
    judged(late("pin: PA9", "pin: EXP_GND", "pin: EXP_GND", "pin EXP_GND is reserved for <GND>")),
    // Sections that need another one.
    wrong(
        "[tmc2209 stepper_y]",
        "[tmc2209 stepper_q]",
        "Could not find config section '[stepper_q]' required by tmc driver",
    ),
    early(
        "[probe]\npin: ^tool:gpio9\nx_offset: 20\nz_offset: 1.5\n",
        "",
        "endstop_pin: probe:z_virtual_endstop",
        "Unknown pin chip name 'probe'",
    ),
    judged(early(
        "sensor_type: Generic 3950\nsensor_pin: PA1\n",
        "sensor_type: Bed\nsensor_pin: PA1\n[thermistor Bed]\ntemperature1: 25\nresistance1: 100000\nbeta: 3950\n[heater_bed]\n",
        "sensor_type: Bed",
        "Unknown temperature sensor 'Bed'",
    )),
    judged(wrong("step_pin: tool:gpio3", "step_pin: PD2", "Stepper dir pin must be on same mcu as step pin")),
];
