// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg with which a klippy finds on the board what the description put there.

use std::fmt::{self, Display, Write};

use super::config::{AxisConfig, ChipConfig, End, FanConfig, HeaterConfig, PinName, SimConfig};

/// Full steps in a turn of the usual stepper motor.
const FULL_STEPS: f64 = 200.0;

/// The printer.cfg that matches a board, for a klippy of today's Klipper with `pty` as its serial
/// port.
///
/// The axes `x`, `y` and `z` with endstops make a cartesian printer, a heater `extruder` and an
/// axis `extruder` its hot end; what has other names becomes a `manual_stepper`, a
/// `heater_generic`, a `fan_generic`.
pub fn printer_cfg(config: &SimConfig, pty: &str) -> String {
    let mut cfg = Sections::default();
    cfg.comment("Printed by Pinion for its simulated printer: every number is the simulation's.");
    cfg.section("mcu");
    cfg.key("serial", pty);

    let axis = |name: &str| config.axes.iter().find(|axis| axis.name == name);
    let rail = |name: &str| axis(name).is_some_and(|axis| axis.endstop_pin.is_some());
    let cartesian = rail("x") && rail("y") && rail("z");
    let limits = &config.limits;
    cfg.section("printer");
    cfg.key("kinematics", if cartesian { "cartesian" } else { "none" });
    cfg.key("max_velocity", limits.velocity_mm_per_s);
    cfg.key("max_accel", limits.accel_mm_per_s2);
    if cartesian {
        // klippy refuses a z axis that outruns the head.
        let velocity = limits.z_velocity_mm_per_s.min(limits.velocity_mm_per_s);
        let accel = limits.z_accel_mm_per_s2.min(limits.accel_mm_per_s2);
        cfg.key("max_z_velocity", velocity);
        cfg.key("max_z_accel", accel);
    }

    let hot_end = |name: &str| name == "extruder";
    let has_hot_end = config.heaters.iter().any(|heater| hot_end(&heater.name));
    let stepper = |name: &str| match name {
        "x" | "y" | "z" if cartesian => format!("stepper_{name}"),
        "extruder" if has_hot_end => "extruder".to_owned(),
        name => format!("manual_stepper {name}"),
    };
    for axis in &config.axes {
        match axis.name.as_str() {
            "x" | "y" | "z" if cartesian => {
                cfg.section(stepper(&axis.name));
                cfg.stepper(axis);
                cfg.rail(axis);
            }
            // Goes into the hot end's section.
            "extruder" if has_hot_end => {}
            name => {
                cfg.section(stepper(name));
                cfg.stepper(axis);
                cfg.key("velocity", axis.homing_mm_per_s);
                cfg.key_if("endstop_pin", axis.endstop_pin.as_ref());
            }
        }
    }
    for heater in &config.heaters {
        cfg.thermistor(heater);
        match heater.name.as_str() {
            "extruder" => {
                cfg.section("extruder");
                if let Some(axis) = axis("extruder") {
                    cfg.stepper(axis);
                }
                cfg.key("nozzle_diameter", 0.4);
                cfg.key("filament_diameter", 1.75);
                let min_extrude = 170f64.clamp(heater.min_celsius, heater.max_celsius);
                cfg.key("min_extrude_temp", min_extrude);
            }
            "heater_bed" => cfg.section("heater_bed"),
            name => cfg.section(format_args!("heater_generic {name}")),
        }
        cfg.heater(heater);
    }
    for fan in &config.fans {
        match fan.name.as_str() {
            "fan" => cfg.section("fan"),
            name => cfg.section(format_args!("fan_generic {name}")),
        }
        cfg.fan(fan);
    }
    for led in &config.leds {
        cfg.section(format_args!("led {}", led.name));
        cfg.key("white_pin", &led.pin);
    }
    for output in &config.outputs {
        cfg.section(format_args!("output_pin {}", output.name));
        cfg.key("pin", &output.pin);
    }
    for chip in &config.chips {
        match chip {
            // No section of klippy's is for it.
            ChipConfig::Loopback { .. } => {}
            ChipConfig::Tmc5160 { bus, select_pin, axis } => {
                cfg.section(format_args!("tmc5160 {}", stepper(axis)));
                cfg.comment("May be left out, as the motor turns without; then start Pinion anew: the chip keeps");
                cfg.comment("what it was told.");
                cfg.chip(bus, select_pin.as_ref());
                cfg.key("run_current", 0.8);
                cfg.key("sense_resistor", 0.075);
            }
        }
    }
    if !config.inputs.is_empty() {
        cfg.section_break();
        cfg.comment("Inputs at a fixed level, for whatever watches one:");
        for input in &config.inputs {
            let level = if input.level { "on" } else { "off" };
            cfg.comment(format_args!("  {}: {} ({level})", input.name, input.pin));
        }
    }
    cfg.0
}

/// A printer.cfg as it grows.
#[derive(Default)]
struct Sections(String);

impl Sections {
    /// Adds a line. A String takes everything that is written to it.
    fn line(&mut self, line: fmt::Arguments<'_>) {
        let written = self.0.write_fmt(format_args!("{line}\n"));
        debug_assert!(written.is_ok());
    }

    fn comment(&mut self, text: impl Display) {
        self.line(format_args!("# {text}"));
    }

    fn section_break(&mut self) {
        self.line(format_args!(""));
    }

    fn section(&mut self, name: impl Display) {
        self.section_break();
        self.line(format_args!("[{name}]"));
    }

    fn key(&mut self, key: impl Display, value: impl Display) {
        self.line(format_args!("{key}: {value}"));
    }

    fn key_if(&mut self, key: &str, value: Option<impl Display>) {
        if let Some(value) = value {
            self.key(key, value);
        }
    }

    fn stepper(&mut self, axis: &AxisConfig) {
        self.key("step_pin", &axis.step_pin);
        self.key("dir_pin", &axis.dir_pin);
        self.key_if("enable_pin", axis.enable_pin.as_ref());
        self.key("microsteps", axis.microsteps);
        // klippy steps on both edges for a driver that it sets up itself only; elsewhere it makes
        // a pulse, which is two steps of such a motor.
        let pulses_per_mm = axis.steps_per_mm / if axis.step_both_edges { 2.0 } else { 1.0 };
        let rotation_distance = FULL_STEPS * f64::from(axis.microsteps) / pulses_per_mm;
        self.key("rotation_distance", rotation_distance);
    }

    fn rail(&mut self, axis: &AxisConfig) {
        let travel_mm = axis.travel_mm.unwrap_or(0.0);
        self.key_if("endstop_pin", axis.endstop_pin.as_ref());
        let endstop = match axis.endstop_at {
            End::Min => 0.0,
            End::Max => travel_mm,
        };
        self.key("position_endstop", endstop);
        self.key("position_max", travel_mm);
        self.key("homing_speed", axis.homing_mm_per_s);
    }

    fn thermistor(&mut self, heater: &HeaterConfig) {
        self.section(format_args!("thermistor sim_{}", heater.name));
        for (i, (celsius, ohm)) in (1..).zip(&heater.points_celsius_ohm) {
            self.key(format_args!("temperature{i}"), celsius);
            self.key(format_args!("resistance{i}"), ohm);
        }
        self.key_if("beta", heater.beta_k);
    }

    fn heater(&mut self, heater: &HeaterConfig) {
        self.key("heater_pin", &heater.pin);
        self.key("sensor_type", format_args!("sim_{}", heater.name));
        self.key("sensor_pin", &heater.sensor_pin);
        self.key("pullup_resistor", heater.pullup_ohm);
        self.key("min_temp", heater.min_celsius);
        self.key("max_temp", heater.max_celsius);
        let gains = Gains::of(heater);
        self.key("control", "pid");
        self.key("pid_Kp", format_args!("{:.3}", gains.kp));
        self.key("pid_Ki", format_args!("{:.3}", gains.ki));
        self.key("pid_Kd", format_args!("{:.3}", gains.kd));
    }

    fn chip(&mut self, bus: &str, select_pin: Option<&PinName>) {
        match select_pin {
            Some(pin) => self.key("cs_pin", pin),
            None => self.key("cs_pin", "None"),
        }
        self.key("spi_bus", bus);
    }

    fn fan(&mut self, fan: &FanConfig) {
        self.key("pin", &fan.pin);
        self.key_if("enable_pin", fan.enable_pin.as_ref());
        if let Some(pin) = &fan.tachometer_pin {
            self.comment("The tachometer needs an MCU that counts edges (config_counter):");
            self.comment(format_args!("tachometer_pin: {pin}"));
            self.comment(format_args!("tachometer_ppr: {}", fan.pulses_per_revolution));
        }
    }
}

/// klippy's PID parameters.
#[derive(Clone, Copy, Debug)]
pub struct Gains {
    /// Full power is 255 of it for each kelvin too cold.
    pub kp: f64,
    /// The same for each kelvin and second.
    pub ki: f64,
    /// The same for each kelvin a second.
    pub kd: f64,
}

impl Gains {
    /// The gains for a heater by the SIMC rules (Skogestad, 2003): the loop is to be as quick as
    /// its delay. The delay is klippy's (a reading is half of 0.3 s old, its answer waits for
    /// 0.3 s, the soft PWM has 0.1 s) and the sensor's lag. The derivative cancels half of it.
    /// Full power is never less than 2 K away: a finer loop would follow the sensor's noise.
    pub fn of(heater: &HeaterConfig) -> Gains {
        const PID_PARAM_BASE: f64 = 255.0;
        const FINEST_BAND_K: f64 = 2.0;
        let delay_s = 0.5 + heater.sensor_lag_s;
        let gain_k_per_s = heater.heater_watts / heater.heat_capacity_j_per_k;
        let time_constant_s = heater.heat_capacity_j_per_k / heater.loss_w_per_k;
        let kp = PID_PARAM_BASE / (gain_k_per_s * 2.0 * delay_s).max(FINEST_BAND_K);
        Gains { kp, ki: kp / time_constant_s.min(8.0 * delay_s), kd: kp * delay_s / 2.0 }
    }
}
