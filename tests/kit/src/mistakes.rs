// SPDX-License-Identifier: GPL-3.0-or-later
//! A printer.cfg, and mistakes in it that klippy refuses.

#![forbid(unsafe_code)]

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
    Mistake { from, to, line, words, is_early: true }
}

const fn late(from: &'static str, to: &'static str, line: &'static str, words: &'static str) -> Mistake {
    Mistake { from, to, line, words, is_early: false }
}

/// The mistakes.
pub const MISTAKES: &[Mistake] = &[
    // Lines and files.
    early("[printer]\n", "printer]\n", "printer]", "Source contains parsing errors"),
    early("max_accel: 3000", "max_accel 3000", "max_accel 3000", "Source contains parsing errors"),
    early("[fan]\n", "[include none.cfg]\n[fan]\n", "[include none.cfg]", "none.cfg' does not exist"),
    // Options that must be there.
    early("kinematics: cartesian\n", "", "[printer]", "Option 'kinematics' in section 'printer' must be specified"),
    early("max_velocity: 300\n", "", "[printer]", "Option 'max_velocity' in section 'printer' must be specified"),
    early("max_accel: 3000\n", "", "[printer]", "Option 'max_accel' in section 'printer' must be specified"),
    early("step_pin: PB9\n", "", "[stepper_x]", "Option 'step_pin' in section 'stepper_x' must be specified"),
    early("dir_pin: PB7\n", "", "[stepper_y]", "Option 'dir_pin' in section 'stepper_y' must be specified"),
    early(
        "rotation_distance: 8\n",
        "rotation_distanc: 8\n",
        "[stepper_z]",
        "Option 'rotation_distance' in section 'stepper_z' must be specified",
    ),
    early("microsteps: 16\n", "", "[stepper_x]", "Option 'microsteps' in section 'stepper_x' must be specified"),
    early(
        "position_endstop: -5\n",
        "",
        "[stepper_x]",
        "Option 'position_endstop' in section 'stepper_x' must be specified",
    ),
    early("position_max: 250\n", "", "[stepper_z]", "Option 'position_max' in section 'stepper_z' must be specified"),
    early("uart_pin: PC11\n", "", "[tmc2209 stepper_y]", "Option 'uart_pin' in section 'tmc2209 stepper_y' must be"),
    early(
        "nozzle_diameter: 0.4\n",
        "",
        "[extruder]",
        "Option 'nozzle_diameter' in section 'extruder' must be specified",
    ),
    early("max_temp: 250\n", "", "[extruder]", "Option 'max_temp' in section 'extruder' must be specified"),
    early("control: watermark\n", "", "[heater_bed]", "Option 'control' in section 'heater_bed' must be specified"),
    early("pid_Kd: 114\n", "", "[extruder]", "Option 'pid_Kd' in section 'extruder' must be specified"),
    early("sensor_pin: PA1\n", "", "[heater_bed]", "Option 'sensor_pin' in section 'heater_bed' must be specified"),
    early("pin: PA7\n", "", "[fan]", "Option 'pin' in section 'fan' must be specified"),
    early("z_offset: 1.5\n", "", "[probe]", "Option 'z_offset' in section 'probe' must be specified"),
    early(
        "home_xy_position: 100, 100\n",
        "speed: 50\n",
        "[safe_z_home]",
        "Option 'home_xy_position' in section 'safe_z_home' must be specified",
    ),
    early("mesh_max: 200, 200\n", "", "[bed_mesh]", "Option 'mesh_max' in section 'bed_mesh' must be specified"),
    early(
        "switch_pin: ^PB2\n",
        "pause_on_runout: True\n",
        "[filament_switch_sensor filament]",
        "Option 'switch_pin' in section 'filament_switch_sensor filament' must be specified",
    ),
    early(
        "path: ~/printer_data/gcodes\n",
        "",
        "[virtual_sdcard]",
        "Option 'path' in section 'virtual_sdcard' must be specified",
    ),
    early("serial: /dev/serial/by-id/usb-a\n", "", "[mcu]", "Option 'serial' in section 'mcu' must be specified"),
    // Values.
    early(
        "max_velocity: 300",
        "max_velocity: fast",
        "max_velocity: fast",
        "Unable to parse option 'max_velocity' in section 'printer'",
    ),
    early(
        "max_accel: 3000",
        "max_accel: 0",
        "max_accel: 0",
        "Option 'max_accel' in section 'printer' must be above 0.0",
    ),
    early(
        "rotation_distance: 40",
        "rotation_distance: -40",
        "rotation_distance: -40",
        "Option 'rotation_distance' in section 'stepper_x' must be above 0.0",
    ),
    early(
        "microsteps: 16",
        "microsteps: 16.5",
        "microsteps: 16.5",
        "Unable to parse option 'microsteps' in section 'stepper_x'",
    ),
    early(
        "rotation_distance: 40\ngear_ratio: 3:1, 2:1",
        "rotation_distance: 40\ngear_ratio: 3",
        "gear_ratio: 3",
        "Option 'gear_ratio' in section 'stepper_y' must have 2 elements",
    ),
    early(
        "microsteps: 16\nrotation_distance: 40\ngear",
        "microsteps: 12\nrotation_distance: 40\ngear",
        "microsteps: 12",
        "Choice '12' for option 'microsteps' in section 'stepper_y' is not a valid choice",
    ),
    early(
        "filament_diameter: 1.75",
        "filament_diameter: 0.3",
        "filament_diameter: 0.3",
        "Option 'filament_diameter' in section 'extruder' must have minimum of 0.4",
    ),
    early(
        "max_temp: 110",
        "max_temp: -110",
        "max_temp: -110",
        "Option 'max_temp' in section 'heater_bed' must be above 0.0",
    ),
    early(
        "pin: PA7\n",
        "pin: PA7\nmax_power: 255\n",
        "max_power: 255",
        "Option 'max_power' in section 'fan' must have maximum of 1.0",
    ),
    early(
        "home_xy_position: 100, 100",
        "home_xy_position: 100",
        "home_xy_position: 100",
        "Option 'home_xy_position' in section 'safe_z_home' must have 2 elements",
    ),
    early(
        "run_current: 0.8",
        "run_current: 800",
        "run_current: 800",
        "Option 'run_current' in section 'tmc2209 stepper_y' must have maximum of 2.0",
    ),
    early(
        "uart_address: 1",
        "uart_address: 4",
        "uart_address: 4",
        "Option 'uart_address' in section 'tmc2209 stepper_y' must have maximum of 3",
    ),
    early("chain_count: 3", "color_order: GXB", "color_order: GXB", "Invalid color_order 'GXB'"),
    early(
        "sensor_type: Generic 3950",
        "sensor_type: Generic 3590",
        "sensor_type: Generic 3590",
        "Unknown temperature sensor 'Generic 3590'",
    ),
    early("kinematics: cartesian", "kinematics: cube", "kinematics: cube", "Error loading kinematics 'cube'"),
    early(
        "control: watermark",
        "control: bang",
        "control: bang",
        "Choice 'bang' for option 'control' in section 'heater_bed' is not a valid choice",
    ),
    // Options beside others.
    early(
        "position_endstop: -5",
        "position_endstop: 100",
        "position_endstop: 100",
        "Unable to infer homing_positive_dir in section 'stepper_x'",
    ),
    early(
        "position_endstop: -5",
        "position_endstop: -6",
        "position_endstop: -6",
        "position_endstop in section 'stepper_x' must be between position_min and position_max",
    ),
    early("mesh_max: 200, 200", "mesh_max: 200, 20", "mesh_max: 200, 20", "bed_mesh: invalid min/max points"),
    early("screw3: 110, 200\n", "", "screw1: 30, 30", "screws_tilt_adjust: Must have at least three screws"),
    early(
        "[servo arm]\n",
        "[homing_override]\ngcode: G28\n[servo arm]\n",
        "home_xy_position: 100, 100",
        "homing_override and safe_z_homing cannot be used simultaneously",
    ),
    late("  250,110\n", "", "z_positions: -20,110", "z_tilt z_positions needs exactly 2 items"),
    late("heater: extruder", "heater: extruder2", "heater: extruder2", "Unknown heater 'extruder2'"),
    // Pins.
    early("dir_pin: PB7", "dir_pin: PB9", "dir_pin: PB9", "pin PB9 used multiple times in config"),
    early("pin: PA8", "pin: !PA7", "pin: !PA7", "pin PA7 used multiple times in config"),
    early("pin: PA9", "pin: PC8", "pin: PC8", "pin PC8 used multiple times in config"),
    early(
        "enable_pin: !PC3\nmicrosteps: 16\nrotation_distance: 40\ngear",
        "enable_pin: PC3\nmicrosteps: 16\nrotation_distance: 40\ngear",
        "enable_pin: PC3",
        "Shared pin PC3 must have same polarity",
    ),
    early("step_pin: PB9", "step_pin: ^PB9", "step_pin: ^PB9", "Invalid pin description '^PB9'"),
    early("sensor_pin: PA0", "sensor_pin: !PA0", "sensor_pin: !PA0", "Invalid pin description '!PA0'"),
    early("pin: PB1\n", "pin: P B1\n", "pin: P B1", "Invalid pin description 'P B1'"),
    early("step_pin: tool:gpio1", "step_pin: tol:gpio1", "step_pin: tol:gpio1", "Unknown pin chip name 'tol'"),
    early(
        "diag_pin: ^PC12\n",
        "",
        "endstop_pin: tmc2209_stepper_y:virtual_endstop",
        "tmc virtual endstop requires diag pin config",
    ),
    early(
        "endstop_pin: tmc2209_stepper_y:virtual_endstop",
        "endstop_pin: ^tmc2209_stepper_y:virtual_endstop",
        "endstop_pin: ^tmc2209_stepper_y:virtual_endstop",
        "Can not pullup/invert tmc virtual pin",
    ),
    late("pin: PA9", "pin: PB8", "pin: PB8", "pin PB8 is an alias for EXP_Y"),
    late("pin: PA9", "pin: EXP_GND", "pin: EXP_GND", "pin EXP_GND is reserved for <GND>"),
    // Sections that need another one.
    early(
        "[tmc2209 stepper_y]",
        "[tmc2209 stepper_q]",
        "[tmc2209 stepper_q]",
        "Could not find config section '[stepper_q]' required by tmc driver",
    ),
    early(
        "[probe]\npin: ^tool:gpio9\nx_offset: 20\nz_offset: 1.5\n",
        "",
        "endstop_pin: probe:z_virtual_endstop",
        "Unknown pin chip name 'probe'",
    ),
    early(
        "sensor_type: Generic 3950\nsensor_pin: PA1\n",
        "sensor_type: Bed\nsensor_pin: PA1\n[thermistor Bed]\ntemperature1: 25\nresistance1: 100000\nbeta: 3950\n[heater_bed]\n",
        "sensor_type: Bed",
        "Unknown temperature sensor 'Bed'",
    ),
    early(
        "step_pin: tool:gpio3",
        "step_pin: PD2",
        "step_pin: PD2",
        "Multi-mcu homing not supported on multi-mcu shared axis",
    ),
];
