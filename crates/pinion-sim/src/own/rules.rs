// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's rules for the options of sections that stand for things: what must be there, and its range. A rule is here if
//! Klipper and Kalico share it. klippy itself knows all others.

use pinion_printer_config::pins::{MAIN, Pin};
use pinion_printer_config::{Config, Limit, Section, Trouble};

use super::known::{Kind, is_left_over, kind_of, motor_of};

/// The value of an option.
#[derive(Clone, Copy)]
enum Rule {
    Text,
    Number(Limit),
    /// At least this.
    Whole(i64),
    /// From 0 to this.
    UpTo(i64),
    Truth,
    Choice(&'static [&'static str]),
    /// A list of this many numbers.
    Numbers(usize),
    /// Rows of this many numbers.
    Rows(usize),
}

use Rule::{Choice, Number, Numbers, Rows, Text, Truth, UpTo, Whole};

const ABOVE_0: Rule = Number(Limit::Above(0.0));
const ANY: Rule = Number(Limit::Any);
/// The current of the drivers without transistors of their own, in amperes.
const CURRENT: Rule = Number(Limit::AboveTo(0.0, 2.0));
const COLD: Rule = Number(Limit::Min(-273.15));
/// Full power, or a part of it.
const TO_1: Rule = Number(Limit::AboveTo(0.0, 1.0));
const FROM_0_TO_1: Rule = Number(Limit::Between(0.0, 1.0));
const MICROSTEPS: Rule = Choice(&["1", "2", "4", "8", "16", "32", "64", "128", "256"]);

/// Options that must be there: the section's class, the option, its rule.
const MUST: &[(&str, &str, Rule)] = &[
    ("printer", "kinematics", Text),
    ("printer", "max_velocity", ABOVE_0),
    ("printer", "max_accel", ABOVE_0),
    ("heater", "min_temp", COLD),
    ("heater", "max_temp", ANY),
    ("heater", "control", Choice(&["watermark", "pid", "pid_v", "mpc", "dual_loop_pid"])),
    ("heater", "sensor_type", Text),
    ("heater", "heater_pin", Text),
    ("extruder", "nozzle_diameter", ABOVE_0),
    ("extruder", "filament_diameter", ANY),
    ("temperature_fan", "min_temp", COLD),
    ("temperature_fan", "max_temp", ANY),
    ("temperature_fan", "control", Text),
    ("temperature_fan", "sensor_type", Text),
    ("temperature_sensor", "sensor_type", Text),
    ("fan", "pin", Text),
    ("fan_generic", "pin", Text),
    ("heater_fan", "pin", Text),
    ("controller_fan", "pin", Text),
    ("temperature_fan", "pin", Text),
    ("output_pin", "pin", Text),
    ("servo", "pin", Text),
    ("neopixel", "pin", Text),
    ("dotstar", "data_pin", Text),
    ("dotstar", "clock_pin", Text),
    ("gcode_button", "pin", Text),
    ("probe", "pin", Text),
    ("probe", "z_offset", ANY),
    ("bltouch", "sensor_pin", Text),
    ("bltouch", "control_pin", Text),
    ("bltouch", "z_offset", ANY),
    ("filament_switch_sensor", "switch_pin", Text),
    ("filament_motion_sensor", "switch_pin", Text),
    ("filament_motion_sensor", "extruder", Text),
    ("extruder_stepper", "extruder", Text),
    ("safe_z_home", "home_xy_position", Numbers(2)),
    ("z_tilt", "z_positions", Rows(2)),
    ("quad_gantry_level", "gantry_corners", Rows(2)),
    ("homing_override", "gcode", Text),
    ("delayed_gcode", "gcode", Text),
    ("virtual_sdcard", "path", Text),
    ("save_variables", "filename", Text),
    ("multi_pin", "pins", Text),
    ("duplicate_pin_override", "pins", Text),
    ("static_digital_output", "pins", Text),
    ("resonance_tester", "probe_points", Rows(3)),
    ("delta_calibrate", "radius", ABOVE_0),
    ("thermistor", "temperature1", COLD),
    ("thermistor", "resistance1", Number(Limit::Min(0.0))),
    ("adc_scaled", "vref_pin", Text),
    ("adc_scaled", "vssa_pin", Text),
    ("display", "lcd_type", Text),
    ("tmc_uart", "uart_pin", Text),
    ("tmc_spi", "cs_pin", Text),
];

/// Options that may be there.
const MAY: &[(&str, &str, Rule)] = &[
    ("printer", "max_z_velocity", ABOVE_0),
    ("printer", "max_z_accel", ABOVE_0),
    ("printer", "square_corner_velocity", Number(Limit::Min(0.0))),
    ("rail", "homing_speed", ABOVE_0),
    ("rail", "second_homing_speed", ABOVE_0),
    ("rail", "homing_retract_speed", ABOVE_0),
    ("rail", "homing_retract_dist", Number(Limit::Min(0.0))),
    ("rail", "homing_positive_dir", Truth),
    ("heater", "max_power", TO_1),
    ("heater", "smooth_time", ABOVE_0),
    ("heater", "pullup_resistor", ABOVE_0),
    ("extruder", "pressure_advance", Number(Limit::Min(0.0))),
    ("extruder", "max_extrude_only_distance", Number(Limit::Min(0.0))),
    ("extruder", "max_extrude_cross_section", ABOVE_0),
    ("extruder", "min_extrude_temp", ANY),
    ("fan", "max_power", TO_1),
    ("heater_fan", "max_power", TO_1),
    ("fan_generic", "max_power", TO_1),
    ("controller_fan", "max_power", TO_1),
    ("heater_fan", "fan_speed", FROM_0_TO_1),
    ("heater_fan", "heater_temp", ANY),
    ("probe", "speed", ABOVE_0),
    ("probe", "samples", Whole(1)),
    ("probe", "samples_result", Choice(&["median", "average"])),
    ("probe", "x_offset", ANY),
    ("probe", "y_offset", ANY),
    ("bltouch", "speed", ABOVE_0),
    ("bltouch", "samples", Whole(1)),
    ("bltouch", "samples_result", Choice(&["median", "average"])),
    ("bltouch", "x_offset", ANY),
    ("bltouch", "y_offset", ANY),
    ("bltouch", "pin_move_time", ABOVE_0),
    ("bltouch", "stow_on_each_sample", Truth),
    ("bed_mesh", "mesh_radius", ABOVE_0),
    ("bed_mesh", "mesh_min", Numbers(2)),
    ("bed_mesh", "mesh_max", Numbers(2)),
    ("bed_mesh", "speed", ABOVE_0),
    ("z_tilt", "points", Rows(2)),
    ("z_tilt", "speed", ABOVE_0),
    ("z_tilt", "retries", Whole(0)),
    ("quad_gantry_level", "points", Rows(2)),
    ("quad_gantry_level", "speed", ABOVE_0),
    ("quad_gantry_level", "retries", Whole(0)),
    ("quad_gantry_level", "max_adjust", ABOVE_0),
    ("safe_z_home", "speed", ABOVE_0),
    ("safe_z_home", "z_hop", ANY),
    ("safe_z_home", "z_hop_speed", ABOVE_0),
    ("safe_z_home", "move_to_previous", Truth),
    ("idle_timeout", "timeout", ABOVE_0),
    ("delayed_gcode", "initial_duration", Number(Limit::Min(0.0))),
    ("filament_switch_sensor", "pause_on_runout", Truth),
    ("filament_motion_sensor", "pause_on_runout", Truth),
    ("filament_motion_sensor", "detection_length", ABOVE_0),
    ("neopixel", "chain_count", Whole(1)),
    ("output_pin", "pwm", Truth),
    ("output_pin", "scale", ABOVE_0),
    ("dual_carriage", "axis", Choice(&["x", "y"])),
    ("verify_heater", "max_error", Number(Limit::Min(0.0))),
    ("verify_heater", "hysteresis", Number(Limit::Min(0.0))),
    ("verify_heater", "heating_gain", ABOVE_0),
    ("input_shaper", "shaper_freq_x", Number(Limit::Min(0.0))),
    ("input_shaper", "shaper_freq_y", Number(Limit::Min(0.0))),
    ("tmc2209", "uart_address", UpTo(3)),
    ("tmc_uart", "run_current", CURRENT),
    ("tmc2130", "run_current", CURRENT),
    ("tmc_uart", "stealthchop_threshold", Number(Limit::Min(0.0))),
    ("tmc_spi", "stealthchop_threshold", Number(Limit::Min(0.0))),
    ("tmc_uart", "interpolate", Truth),
    ("tmc_spi", "interpolate", Truth),
];

/// The classes of a section. A heater with the heater of another one has none of its own.
fn classes(section: &Section) -> Vec<&str> {
    let kind = section.kind();
    let is_extruder = kind.strip_prefix("extruder").is_some_and(|n| n.chars().all(|c| c.is_ascii_digit()));
    let is_heater = is_extruder && section.text("shared_heater").is_none();
    match kind {
        _ if is_heater => vec!["extruder", "heater"],
        "heater_bed" | "heater_generic" => vec!["heater"],
        "dual_carriage" if section.own_name().is_none() => vec!["rail", "dual_carriage"],
        _ if kind.starts_with("stepper_") => vec!["rail"],
        "tmc2208" | "tmc2209" => vec!["tmc_uart", kind],
        "tmc2130" | "tmc2660" | "tmc5160" if section.text("uart_pin").is_none() => vec!["tmc_spi", kind],
        // [display_data] and others have other first words. A second display has the same rules.
        "dual_carriage" => vec![],
        kind => vec![kind],
    }
}

/// Checks all sections.
///
/// # Errors
///
/// The first one that klippy refuses, too.
pub(super) fn check(config: &Config) -> Result<(), Trouble> {
    for section in config.sections().iter().filter(|section| !is_left_over(config, section)) {
        let classes = classes(section);
        for (_, key, rule) in MUST.iter().filter(|(class, ..)| classes.contains(class)) {
            section.required(key)?;
            obeyed(section, key, *rule)?;
        }
        for (_, key, rule) in MAY.iter().filter(|(class, ..)| classes.contains(class)) {
            obeyed(section, key, *rule)?;
        }
        beside(config, section)?;
    }
    Ok(())
}

fn obeyed(section: &Section, key: &str, rule: Rule) -> Result<(), Trouble> {
    let counted = |rows: Option<Vec<Vec<f64>>>, count: usize| match rows {
        Some(rows) if rows.iter().any(|row| row.len() != count) => {
            let cause = format!("Option '{key}' in section '{}' must have {count} elements", section.name);
            Err(section.trouble(key, cause).remedy("correct its value"))
        }
        _ => Ok(()),
    };
    match rule {
        Text => Ok(()),
        Number(limit) => section.number(key, limit).map(drop),
        Whole(min) => section.whole(key, min).map(drop),
        UpTo(max) => match section.whole(key, 0)? {
            Some(number) if number > max => {
                let cause = format!("Option '{key}' in section '{}' must have maximum of {max}", section.name);
                Err(section.trouble(key, cause).remedy("correct its value"))
            }
            _ => Ok(()),
        },
        Truth => section.truth(key).map(drop),
        Choice(choices) => chosen(section, key, choices),
        Numbers(count) => counted(section.numbers(key)?.map(|row| vec![row]), count),
        Rows(count) => counted(section.rows(key)?, count),
    }
}

fn chosen(section: &Section, key: &str, choices: &[&str]) -> Result<(), Trouble> {
    let Some(choice) = section.text(key).filter(|choice| !choices.contains(choice)) else { return Ok(()) };
    let cause = format!("Choice '{choice}' for option '{key}' in section '{}' is not a valid choice", section.name);
    Err(section.trouble(key, cause).remedy(format!("name one of {}", choices.join(", "))))
}

/// Rules about several options, or about other sections.
fn beside(config: &Config, section: &Section) -> Result<(), Trouble> {
    let refused = |key: &str, cause: String, remedy: &str| Err(section.trouble(key, cause).remedy(remedy));
    let has = |name: &str| config.section(name).is_some();
    let kinematics = config.section("printer").and_then(|printer| printer.text("kinematics"));
    match section.kind() {
        "printer" if kinematics == Some("generic_cartesian") => {
            for axis in ["x", "y", "z"] {
                let along = |carriage: &&Section| carriage.text("axis").or(carriage.own_name()) == Some(axis);
                let found: Vec<&str> = config.of_kind("carriage").filter(along).filter_map(Section::own_name).collect();
                let cause = match found[..] {
                    [] => format!("No carriage defined for axis '{axis}'"),
                    [_] => continue,
                    _ => format!("Axis '{axis}' is set for multiple primary carriages ({})", found.join(", ")),
                };
                return refused("kinematics", cause, "give each of x, y and z one [carriage]");
            }
        }
        "mcu" if section.text("canbus_uuid").is_none() => {
            section.required("serial")?;
        }
        kind if kind.starts_with("stepper_") && section.text("endstop_pin").is_none() => {
            let mcu = |section: &Section| {
                let chip = Pin::parse(section.text("step_pin")?, true, true).ok()?.chip;
                (chip == MAIN || has(&format!("mcu {chip}"))).then_some(chip)
            };
            // stepper_z for stepper_z1: its endstop stops both.
            let first = kind.get(..9).and_then(|name| config.section(name)).and_then(mcu);
            if mcu(section).zip(first).is_some_and(|(own, first)| own != first) {
                let cause = "Multi-mcu homing not supported on multi-mcu shared axis";
                return refused("step_pin", cause.into(), "put all motors of the axis on one MCU");
            }
        }
        kind if kind.starts_with("tmc") && kind_of(kind) == Kind::Known => {
            let stepper = motor_of(section);
            let Some(stepper) = config.section(stepper) else {
                let cause = format!("Could not find config section '[{stepper}]' required by tmc driver");
                return refused("", cause, "add it, or remove the driver");
            };
            obeyed(stepper, "microsteps", MICROSTEPS)?;
        }
        "safe_z_home" if has("homing_override") => {
            let cause = "homing_override and safe_z_homing cannot be used simultaneously";
            return refused("home_xy_position", cause.into(), "remove one of them");
        }
        "heater_fan" => {
            for heater in section.list("heater", ',') {
                let mut named = config.sections().iter().filter(|other| other.text("heater_pin").is_some());
                if !named.any(|other| other.own_name().unwrap_or(&other.name) == heater) {
                    return refused("heater", format!("Unknown heater '{heater}'"), "name a heater of this printer");
                }
            }
        }
        "neopixel" => {
            let right = |order: &str| {
                let mut letters: Vec<char> = order.chars().collect();
                letters.sort_unstable();
                ["BGR", "BGRW"].contains(&letters.iter().collect::<String>().as_str())
            };
            if let Some(order) = section.list("color_order", ',').into_iter().find(|order| !right(order)) {
                return refused("color_order", format!("Invalid color_order '{order}'"), "write it as GRB");
            }
        }
        // [bed_mesh default] is a saved mesh.
        "bed_mesh" if section.own_name().is_none() && section.text("mesh_radius").is_none() => {
            section.required("mesh_min")?;
            section.required("mesh_max")?;
            let (min, max) = (section.numbers("mesh_min")?, section.numbers("mesh_max")?);
            if min.into_iter().flatten().zip(max.into_iter().flatten()).any(|(min, max)| max <= min) {
                return refused("mesh_max", "bed_mesh: invalid min/max points".into(), "correct one of them");
            }
        }
        "quad_gantry_level" if section.rows("points")?.is_some_and(|points| points.len() != 4) => {
            let cause = "Need exactly 4 probe points for quad_gantry_level";
            return refused("points", cause.into(), "name the four corners");
        }
        // With other kinematics more motors move z.
        "z_tilt" if ["cartesian", "corexy"].iter().any(|kind| kinematics == Some(*kind)) => {
            let motors = 1 + (1..).take_while(|n| has(&format!("stepper_z{n}"))).count();
            if section.rows("z_positions")?.is_some_and(|places| places.len() != motors) {
                let cause = format!("z_tilt z_positions needs exactly {motors} items");
                return refused("z_positions", cause, "name the place of each z motor");
            }
        }
        "screws_tilt_adjust" if section.text("screw3").is_none() => {
            let cause = "screws_tilt_adjust: Must have at least three screws";
            return refused("screw1", cause.into(), "add screw1 to screw3");
        }
        _ => {}
    }
    // klippy reads the sections in their order, and extruders after all others.
    if let Some(sensor) = section.text("sensor_type").filter(|_| !section.kind().starts_with("extruder")) {
        let own = ["thermistor", "adc_temperature"].map(|kind| format!("{kind} {sensor}"));
        let mut later = config.sections().iter().skip_while(|other| other.name != section.name);
        if let Some(own) = later.find(|other| own.contains(&other.name)) {
            let cause = format!("Unknown temperature sensor '{sensor}'");
            return refused("sensor_type", cause, &format!("move [{}] above this section", own.name));
        }
    }
    if let Some(nozzle) = section.number("nozzle_diameter", Limit::Any)? {
        section.number("filament_diameter", Limit::Min(nozzle))?;
    }
    if section.text("heater_pin").is_some() {
        let min = section.number("min_temp", Limit::Any)?.unwrap_or(f64::MIN);
        section.number("max_temp", Limit::Above(min))?;
    }
    if section.text("control") == Some("pid") && !config.sections().iter().any(|other| other.kind() == "pid_profile") {
        for key in ["pid_kp", "pid_ki", "pid_kd"] {
            let named = format!("pid_K{}", &key[5..]);
            if section.text(key).is_none() {
                let cause = format!("Option '{named}' in section '{}' must be specified", section.name);
                return refused(key, cause, "add it, or calibrate the heater with PID_CALIBRATE");
            }
            section.number(key, Limit::Any)?;
        }
    }
    Ok(())
}
