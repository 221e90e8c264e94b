// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg that matches a simulated printer.

#![forbid(unsafe_code)]

use std::fmt::{self, Display, Write};

use super::config::{AxisConfig, End, FanConfig, HeaterConfig, InputConfig, PinName, SimConfig};

/// Full steps in a turn of the usual stepper motor.
pub(super) const FULL_STEPS: f64 = 200.0;

/// The printer.cfg that matches a board, for a klippy of today's Klipper with `pty` as its serial
/// port.
///
/// The axes `x`, `y` and `z` with endstops make a cartesian printer, a heater `extruder` and an
/// axis `extruder` its hot end; what has other names becomes a `manual_stepper`, a
/// `heater_generic`, a `fan_generic`.
pub fn printer_cfg(config: &SimConfig, pty: &str) -> String {
    let mut cfg = Sections::default();
    cfg.comment("Printed by Pinion for its simulated printer: every number is the simulation's.");
    cfg.comment("");
    cfg.comment("Any section but [mcu], [printer] and the steppers may be taken out, with those that say that");
    cfg.comment(
        "they need it. Sections with a # before each line are offered: the words before tell what they replace.",
    );
    cfg.section("mcu");
    cfg.key("serial", pty);

    cfg.section("virtual_sdcard");
    cfg.comment("Kalico's filament sensors need it.");
    cfg.key("path", "~/printer_data/gcodes");

    let layout = Layout::of(config);
    cfg.motion(&layout);
    for heater in &config.heaters {
        cfg.thermistor(heater);
        cfg.heater(heater, &layout);
    }
    for fan in &config.fans {
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
    for part in &config.parts {
        part.part().printer_cfg(&mut cfg, &layout);
    }
    cfg.inputs(&config.inputs);
    cfg.text
}

/// The name of klippy's section that has both the hot end's heater and its stepper.
pub(super) const HOT_END: &str = "extruder";

/// Which of klippy's sections the axes belong to.
pub(super) struct Layout<'a> {
    pub(super) config: &'a SimConfig,
    /// Whether the axes `x`, `y` and `z` can be homed, as klippy's cartesian kinematics wants.
    pub(super) is_cartesian: bool,
    has_hot_end: bool,
}

impl<'a> Layout<'a> {
    fn of(config: &'a SimConfig) -> Layout<'a> {
        let can_home = |name| config.axes.iter().any(|axis| axis.name == name && axis.endstop_pin.is_some());
        Layout {
            config,
            is_cartesian: ["x", "y", "z"].into_iter().all(can_home),
            has_hot_end: config.heaters.iter().any(|heater| heater.name == HOT_END),
        }
    }

    /// The section of an axis' stepper.
    pub(super) fn stepper(&self, axis: &str) -> String {
        match axis {
            "x" | "y" | "z" if self.is_cartesian => format!("stepper_{axis}"),
            HOT_END if self.has_hot_end => HOT_END.to_owned(),
            name => format!("manual_stepper {name}"),
        }
    }
}

/// A printer.cfg as it grows.
#[derive(Default)]
pub(super) struct Sections {
    text: String,
    /// Whether what comes is only offered: a `#` stands before each line.
    offered: bool,
    /// Whether there is a section of a probe, of which klippy takes one.
    has_probe: bool,
}

impl Sections {
    /// Adds a line. Writing to a String does not fail.
    fn line(&mut self, line: fmt::Arguments<'_>) {
        let mark = if self.offered { "#" } else { "" };
        let written = self.text.write_fmt(format_args!("{mark}{line}\n"));
        debug_assert!(written.is_ok());
    }

    /// Adds sections that take the place of others: a `#` before each of their lines keeps them out
    /// of use.
    pub(super) fn offer(&mut self, sections: impl FnOnce(&mut Sections)) {
        self.offered = true;
        sections(self);
        self.offered = false;
    }

    /// Adds the section of a probe: klippy takes one, so the first is in use, and the others are offered.
    pub(super) fn probe(&mut self, layout: &Layout<'_>, section: impl FnOnce(&mut Sections)) {
        if !layout.is_cartesian {
            return;
        }
        if std::mem::replace(&mut self.has_probe, true) {
            self.section_break();
            self.comment("Another probe, in place of the one that is in use:");
            return self.offer(section);
        }
        section(self);
        // Within reach of whatever stands beside the nozzle.
        let travel_mm = |name| layout.config.axes.iter().find(|axis| axis.name == name)?.travel_mm;
        let [x_mm, y_mm] = ["x", "y"].map(|name| travel_mm(name).unwrap_or(0.0));
        self.section("bed_mesh");
        self.key("mesh_min", format_args!("{}, {}", x_mm * 0.2, y_mm * 0.2));
        self.key("mesh_max", format_args!("{}, {}", x_mm * 0.8, y_mm * 0.8));
        self.key("probe_count", "5, 5");
        self.key("horizontal_move_z", 5);
        self.key("speed", layout.config.limits.velocity_mm_per_s);
    }

    /// The keys of a probe that stands off the nozzle by so much.
    pub(super) fn offsets(&mut self, [x_mm, y_mm, z_mm]: [f64; 3]) {
        self.key("x_offset", x_mm);
        self.key("y_offset", y_mm);
        self.key("z_offset", z_mm);
    }

    /// The keys of a chip on an SPI bus.
    pub(super) fn spi(&mut self, bus: &str, select_pin: Option<&PinName>) {
        match select_pin {
            Some(pin) => self.key("cs_pin", pin),
            None => self.key("cs_pin", "None"),
        }
        self.key("spi_bus", bus);
    }

    /// Adds a line for people.
    pub(super) fn comment(&mut self, text: impl Display) {
        let text = text.to_string();
        self.line(format_args!("#{}{text}", if text.is_empty() { "" } else { " " }));
    }

    /// Tells that klippy takes this section only beside another one.
    pub(super) fn needs(&mut self, section: impl Display) {
        self.comment(format_args!("Needs [{section}]."));
    }

    fn section_break(&mut self) {
        self.text.push('\n');
    }

    pub(super) fn section(&mut self, name: impl Display) {
        self.section_break();
        self.line(format_args!("[{name}]"));
    }

    pub(super) fn key(&mut self, key: impl Display, value: impl Display) {
        self.line(format_args!("{key}: {value}"));
    }

    pub(super) fn key_if(&mut self, key: &str, value: Option<impl Display>) {
        if let Some(value) = value {
            self.key(key, value);
        }
    }

    /// `[printer]`, and a section for each axis but the hot end's.
    fn motion(&mut self, layout: &Layout<'_>) {
        let limits = &layout.config.limits;
        self.section("printer");
        self.key("kinematics", if layout.is_cartesian { "cartesian" } else { "none" });
        self.key("max_velocity", limits.velocity_mm_per_s);
        self.key("max_accel", limits.accel_mm_per_s2);
        if layout.is_cartesian {
            // klippy refuses a z axis that is faster than the head.
            self.key("max_z_velocity", limits.z_velocity_mm_per_s.min(limits.velocity_mm_per_s));
            self.key("max_z_accel", limits.z_accel_mm_per_s2.min(limits.accel_mm_per_s2));
        }
        for axis in &layout.config.axes {
            match axis.name.as_str() {
                "x" | "y" | "z" if layout.is_cartesian => {
                    self.section(layout.stepper(&axis.name));
                    self.stepper(axis);
                    self.rail(axis);
                    if axis.name == "z" {
                        // A nozzle that is a probe goes below the endstop.
                        self.key("position_min", -axis.overtravel_mm);
                    }
                }
                // Its keys stand in the section of the hot end's heater.
                HOT_END if layout.has_hot_end => {}
                name => {
                    self.section(layout.stepper(name));
                    self.stepper(axis);
                    self.key("velocity", axis.homing_mm_per_s);
                    self.key_if("endstop_pin", axis.endstop_pin.as_ref());
                }
            }
        }
    }

    fn stepper(&mut self, axis: &AxisConfig) {
        self.key("step_pin", &axis.step_pin);
        self.key("dir_pin", &axis.dir_pin);
        self.key_if("enable_pin", axis.enable_pin.as_ref());
        self.key("microsteps", axis.microsteps);
        // klippy steps on both edges only for a driver that it sets up itself. For any other it makes a
        // pulse, which has two edges and so is two steps of this motor.
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

    fn heater(&mut self, heater: &HeaterConfig, layout: &Layout<'_>) {
        match heater.name.as_str() {
            HOT_END => {
                self.section(HOT_END);
                if let Some(axis) = layout.config.axes.iter().find(|axis| axis.name == HOT_END) {
                    self.stepper(axis);
                }
                self.key("nozzle_diameter", 0.4);
                self.key("filament_diameter", 1.75);
                let min_extrude = 170f64.clamp(heater.min_celsius, heater.max_celsius);
                self.key("min_extrude_temp", min_extrude);
            }
            "heater_bed" => self.section("heater_bed"),
            name => self.section(format_args!("heater_generic {name}")),
        }
        self.needs(format_args!("thermistor sim_{}", heater.name));
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

    fn inputs(&mut self, inputs: &[InputConfig]) {
        if inputs.is_empty() {
            return;
        }
        self.section_break();
        self.comment("Inputs at a fixed level, for whatever watches one:");
        for input in inputs {
            let level = if input.level { "on" } else { "off" };
            self.comment(format_args!("  {}: {} ({level})", input.name, input.pin));
        }
    }

    fn fan(&mut self, fan: &FanConfig) {
        match fan.name.as_str() {
            "fan" => self.section("fan"),
            name => self.section(format_args!("fan_generic {name}")),
        }
        self.key("pin", &fan.pin);
        self.key_if("enable_pin", fan.enable_pin.as_ref());
        if let Some(pin) = &fan.tachometer_pin {
            self.key("tachometer_pin", pin);
            self.key("tachometer_ppr", fan.pulses_per_revolution);
        }
    }
}

/// klippy's PID parameters. 255 of each stand for full power.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gains {
    /// Power for each kelvin that the heater is too cold.
    pub(super) kp: f64,
    /// Power for each kelvin too cold and each second that this has lasted.
    pub(super) ki: f64,
    /// Power for each kelvin a second at which the temperature falls.
    pub(super) kd: f64,
}

impl Gains {
    /// The gains for a heater by the SIMC rules (Skogestad, 2003), which make the loop as quick as
    /// its delay allows. That delay is klippy's 0.5 s and the sensor's lag: a reading is 0.15 s old on
    /// average (klippy takes one in 0.3 s), its answer takes effect 0.3 s later, and the soft PWM's cycle
    /// of 0.1 s adds half of that. The derivative term cancels half of the delay. Full power is reached no closer
    /// than 2 K below the target, as a stronger gain would make power follow the sensor's noise.
    pub(super) fn of(heater: &HeaterConfig) -> Gains {
        const PID_PARAM_BASE: f64 = 255.0;
        const FINEST_BAND_K: f64 = 2.0;
        let delay_s = 0.5 + heater.sensor_lag_s;
        let gain_k_per_s = heater.heater_watts / heater.heat_capacity_j_per_k;
        let time_constant_s = heater.heat_capacity_j_per_k / heater.loss_w_per_k;
        let kp = PID_PARAM_BASE / (gain_k_per_s * 2.0 * delay_s).max(FINEST_BAND_K);
        Gains { kp, ki: kp / time_constant_s.min(8.0 * delay_s), kd: kp * delay_s / 2.0 }
    }
}
