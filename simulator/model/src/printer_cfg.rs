// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg that matches a simulated printer.

use super::config::SimConfig;
use super::description::axes::{AxisConfig, DeltaConfig, End};
use super::description::heater::{FanConfig, HeaterConfig};
use super::description::outputs::{InputConfig, LedConfig};
use super::description::printer::Kinematics;
use super::klippy::layout::{CLEAR_MM, FULL_STEPS, Layout, WITHIN_REACH, rounded};
use super::klippy::sections::Sections;

mod software;
#[cfg(test)]
mod tests;

/// The printer.cfg that matches a board, for a klippy of the current Klipper with `pty` as its serial port.
///
/// The axes `x`, `y` and `z` with endstops make a cartesian printer. `z1` is another motor of its z axis. A heater
/// `extruder` and an axis `extruder` make its hot end. Other names become a `manual_stepper`, a `heater_generic` or a
/// `fan_generic`.
pub fn printer_cfg(config: &SimConfig, pty: &str) -> String {
    let mut cfg = Sections::default();
    cfg.comment("Printed by Pinion for its simulated printer: every number is the simulation's.");
    cfg.comment("");
    cfg.comment("Any section but [mcu], [printer] and the steppers may be taken out, with those that say that");
    cfg.comment(
        "they need it. Sections with a # before each line are offered: the words before say what they replace.",
    );
    cfg.section("mcu");
    cfg.key("serial", pty);
    for mcu in config.mcus.iter().skip(1) {
        cfg.section(format_args!("mcu {}", mcu.name));
        cfg.key("serial", format_args!("{pty}_{}", mcu.name));
    }

    cfg.section("virtual_sdcard");
    cfg.comment("Kalico's filament sensors need it. Make the folder, or name one that exists:");
    cfg.comment("mkdir -p ~/printer_data/gcodes");
    cfg.key("path", "~/printer_data/gcodes");

    let layout = Layout::of(config.printer());
    cfg.motion(&layout);
    for heater in &config.heaters {
        cfg.thermistor(heater);
        cfg.heater(heater, &layout);
    }
    for fan in &config.fans {
        cfg.fan(fan, &layout);
    }
    for led in &config.leds {
        cfg.led(led);
    }
    for output in &config.outputs {
        cfg.section(format_args!("output_pin {}", output.name));
        cfg.key("pin", &output.pin);
    }
    for part in &config.parts {
        part.part().printer_cfg(&mut cfg, &layout);
    }
    cfg.inputs(&config.inputs);
    cfg.software(&layout);
    cfg.text
}

impl Sections {
    /// `[printer]`, and a section for each axis except the hot ends' axes.
    fn motion(&mut self, layout: &Layout<'_>) {
        let limits = &layout.printer.limits;
        self.section("printer");
        self.key(
            "kinematics",
            match layout.kinematics {
                Kinematics::Cartesian => "cartesian",
                Kinematics::CoreXy => "corexy",
                Kinematics::CoreXz => "corexz",
                Kinematics::HybridCoreXy => "hybrid_corexy",
                Kinematics::HybridCoreXz => "hybrid_corexz",
                Kinematics::Delta(_) => "delta",
                // Their sections are the user's own.
                Kinematics::Generic
                | Kinematics::Deltesian(_)
                | Kinematics::Polar
                | Kinematics::RotaryDelta(_)
                | Kinematics::Winch(_)
                | Kinematics::None => "none",
            },
        );
        self.key("max_velocity", limits.velocity_mm_per_s);
        self.key("max_accel", limits.accel_mm_per_s2);
        match layout.kinematics {
            _ if layout.has_rails() => {
                // klippy refuses a z axis that is faster than the head.
                self.key("max_z_velocity", limits.z_velocity_mm_per_s.min(limits.velocity_mm_per_s));
                self.key("max_z_accel", limits.z_accel_mm_per_s2.min(limits.accel_mm_per_s2));
            }
            Kinematics::Delta(delta) => {
                self.key("delta_radius", delta.radius_mm);
                self.key("print_radius", delta.bed_radius_mm);
                self.comment("A nozzle that is a probe goes below the bed.");
                self.key("minimum_z_position", -CLEAR_MM);
            }
            _ => {}
        }
        for axis in layout.printer.axes {
            if !layout.is_hot_end(&axis.name) {
                self.axis(axis, layout);
            }
        }
        match layout.kinematics {
            _ if layout.has_rails() => self.leveling(layout),
            Kinematics::Delta(delta) => {
                self.section("delta_calibrate");
                self.key("radius", rounded(WITHIN_REACH * delta.bed_radius_mm));
                self.key("horizontal_move_z", CLEAR_MM);
                self.key("speed", limits.velocity_mm_per_s);
            }
            _ => {}
        }
    }

    fn axis(&mut self, axis: &AxisConfig, layout: &Layout<'_>) {
        let name = axis.name.as_str();
        let section = layout.stepper(name);
        let is_manual = section.starts_with("manual_stepper ");
        self.section(section);
        if layout.is_dual_carriage(name) {
            self.key("axis", "x");
        }
        self.stepper(axis);
        self.key_if("endstop_pin", axis.endstop_pin.as_ref());
        match layout.kinematics {
            _ if is_manual => self.key("velocity", axis.homing_mm_per_s),
            Kinematics::Delta(delta) => self.tower(axis, delta),
            _ if layout.is_homed(name) => {
                self.rail(axis);
                if name == "z" {
                    // A nozzle that is a probe moves below the endstop.
                    self.key("position_min", axis.min_mm - axis.overtravel_mm);
                }
            }
            // Another motor of an axis. The axis has the other keys.
            _ => {}
        }
    }

    fn tower(&mut self, axis: &AxisConfig, delta: &DeltaConfig) {
        // Only the first motor of each tower has these.
        let Some(tower) = DeltaConfig::TOWERS.iter().position(|tower| *tower == axis.name) else { return };
        let endstop_mm = axis.travel_mm.unwrap_or(0.0) - delta.lowest_mm();
        self.key("position_endstop", format_args!("{endstop_mm:.6}"));
        self.key("homing_speed", axis.homing_mm_per_s);
        self.key("arm_length", delta.arm_mm);
        self.key("angle", delta.angles_degrees[tower]);
    }

    /// The section that levels the gantry, or the bed, with the motors of the z axis.
    fn leveling(&mut self, layout: &Layout<'_>) {
        let at_mm: Vec<[f64; 2]> = layout.printer.motors("z").filter_map(|motor| motor.at_mm).collect();
        if at_mm.len() < 2 {
            return;
        }
        // As near to each motor as a probe beside the nozzle can reach.
        let [low, high] = [1.0 - WITHIN_REACH, WITHIN_REACH].map(|share| layout.place_mm(share, share));
        let near = |at: &[f64; 2]| [0, 1].map(|axis| at[axis].clamp(low[axis], high[axis].max(low[axis])));
        match at_mm[..] {
            // Clockwise from the front left, in klippy's order.
            [[x0, y0], [x1, y1], [x2, y2], [x3, y3]]
                if x0 == x1 && x2 == x3 && x0 < x2 && y0 == y3 && y1 == y2 && y0 < y1 =>
            {
                self.section("quad_gantry_level");
                self.places("gantry_corners", [at_mm[0], at_mm[2]]);
            }
            _ => {
                self.section("z_tilt");
                self.places("z_positions", at_mm.iter().copied());
            }
        }
        self.places("points", at_mm.iter().map(near));
        self.key("horizontal_move_z", CLEAR_MM);
        self.key("speed", layout.printer.limits.velocity_mm_per_s);
        self.key("retries", 5);
        self.key("retry_tolerance", 0.01);
    }

    fn stepper(&mut self, axis: &AxisConfig) {
        self.key("step_pin", &axis.step_pin);
        self.key("dir_pin", &axis.dir_pin);
        self.key_if("enable_pin", axis.enable_pin.as_ref());
        self.key("microsteps", axis.microsteps);
        // klippy steps on both edges only for a driver that it configures itself. For any other driver it makes a
        // pulse. A pulse has two edges, so it is two steps of this motor.
        let pulses_per_mm = axis.steps_per_mm / if axis.step_both_edges { 2.0 } else { 1.0 };
        let rotation_distance = FULL_STEPS * f64::from(axis.microsteps) / pulses_per_mm;
        self.key("rotation_distance", rotation_distance);
    }

    fn rail(&mut self, axis: &AxisConfig) {
        let travel_mm = axis.travel_mm.unwrap_or(0.0);
        let endstop = match axis.endstop_at {
            End::Min => axis.min_mm,
            End::Max => travel_mm,
        };
        self.key("position_endstop", axis.endstop_mm.unwrap_or(endstop));
        if axis.min_mm != 0.0 && axis.name != "z" {
            self.key("position_min", axis.min_mm);
        }
        self.key("position_max", travel_mm);
        self.key("homing_speed", axis.homing_mm_per_s);
    }

    fn thermistor(&mut self, heater: &HeaterConfig) {
        if !heater.points_celsius_fraction.is_empty() {
            // klippy's reference is 5 V.
            self.section(format_args!("adc_temperature sim_{}", heater.name));
            for (i, (celsius, fraction)) in (1..).zip(&heater.points_celsius_fraction) {
                self.key(format_args!("temperature{i}"), celsius);
                self.key(format_args!("voltage{i}"), fraction * 5.0);
            }
            return;
        }
        if heater.sensor_pin.is_none() {
            return;
        }
        self.section(format_args!("thermistor sim_{}", heater.name));
        for (i, (celsius, ohm)) in (1..).zip(&heater.points_celsius_ohm) {
            self.key(format_args!("temperature{i}"), celsius);
            self.key(format_args!("resistance{i}"), ohm);
        }
        self.key_if("beta", heater.beta_k);
    }

    fn heater(&mut self, heater: &HeaterConfig, layout: &Layout<'_>) {
        let fan = layout.printer.fan_of(&heater.name);
        if heater.pin.is_none() && fan.is_some() {
            // The fan's section has the heater's keys.
            return;
        }
        self.section(layout.heater(heater));
        if layout.is_hot_end(&heater.name) {
            if let Some(axis) = layout.printer.axis(&heater.name) {
                self.stepper(axis);
            }
            self.key("nozzle_diameter", 0.4);
            self.key("filament_diameter", 1.75);
            let min_extrude = 170f64.clamp(heater.min_celsius, heater.max_celsius);
            self.key("min_extrude_temp", min_extrude);
        }
        self.key_if("heater_pin", heater.pin.as_ref());
        self.sensor(heater);
        if heater.pin.is_some() {
            let gains = Gains::of(heater);
            self.key("control", "pid");
            self.key("pid_Kp", format_args!("{:.3}", gains.kp));
            self.key("pid_Ki", format_args!("{:.3}", gains.ki));
            self.key("pid_Kd", format_args!("{:.3}", gains.kd));
        }
    }

    /// The keys of a heater's thermistor.
    fn sensor(&mut self, heater: &HeaterConfig) {
        let is_curve = !heater.points_celsius_fraction.is_empty();
        let kind = if is_curve { "adc_temperature" } else { "thermistor" };
        self.needs(format_args!("{kind} sim_{}", heater.name));
        self.key("sensor_type", format_args!("sim_{}", heater.name));
        self.key_if("sensor_pin", heater.sensor_pin.as_ref());
        if !is_curve {
            self.key("pullup_resistor", heater.pullup_ohm);
        }
        self.key("min_temp", heater.min_celsius);
        self.key("max_temp", heater.max_celsius);
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

    fn fan(&mut self, fan: &FanConfig, layout: &Layout<'_>) {
        let printer = layout.printer;
        let cooled = printer.heaters.iter().find(|heater| fan.cools.as_ref() == Some(&heater.name));
        match cooled {
            _ if fan.name == "fan" => self.section("fan"),
            Some(heater) if heater.pin.is_some() => {
                self.section(format_args!("heater_fan {}", fan.name));
                self.needs(layout.heater(heater));
                self.key("heater", &heater.name);
            }
            Some(heater) => {
                self.section(format_args!("temperature_fan {}", fan.name));
                self.sensor(heater);
                self.key("control", "watermark");
            }
            None => self.section(format_args!("fan_generic {}", fan.name)),
        }
        self.key("pin", &fan.pin);
        self.key_if("enable_pin", fan.enable_pin.as_ref());
        if let Some(pin) = &fan.tachometer_pin {
            self.key("tachometer_pin", pin);
            self.key("tachometer_ppr", fan.pulses_per_revolution);
        }
    }

    fn led(&mut self, led: &LedConfig) {
        self.section(format_args!("led {}", led.name));
        for (key, pin) in led.pins() {
            self.key_if(if key == "pin" { "white_pin" } else { key }, pin);
        }
    }
}

/// klippy's PID parameters. 255 means full power.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gains {
    /// Power for each kelvin below the target.
    pub(super) kp: f64,
    /// Power for each kelvin below the target and each second of this deviation.
    pub(super) ki: f64,
    /// Power for each kelvin per second by which the temperature falls.
    pub(super) kd: f64,
}

impl Gains {
    /// The gains for a heater by the SIMC rules (Skogestad, 2003). They make the loop as quick as its delay allows. The
    /// delay is klippy's 0.5 s and the sensor's lag. klippy's part has three terms. A reading is 0.15 s old on average
    /// (klippy takes one every 0.3 s). klippy's answer takes effect 0.3 s later. The soft PWM's cycle of 0.1 s adds
    /// half of that. The derivative term cancels half of the delay. Full power is reached no closer than 2 K below the
    /// target: with a stronger gain the power would follow the sensor's noise.
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
