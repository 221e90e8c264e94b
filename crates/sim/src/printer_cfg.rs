// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg that matches a simulated printer.

#![forbid(unsafe_code)]

use std::fmt::{self, Display, Write};

use super::config::{
    AxisConfig, DeltaConfig, End, FanConfig, HeaterConfig, InputConfig, Kinematics, LedConfig, PinName, SimConfig,
};

mod software;
#[cfg(test)]
mod tests;

/// Full steps in a turn of the usual stepper motor.
pub(super) const FULL_STEPS: f64 = 200.0;

/// The printer.cfg that matches a board, for a klippy of today's Klipper with `pty` as its serial
/// port.
///
/// The axes `x`, `y` and `z` with endstops make a cartesian printer, `z1` is one more motor of its z axis,
/// a heater `extruder` and an axis `extruder` make its hot end; what has other names becomes a
/// `manual_stepper`, a `heater_generic`, a `fan_generic`.
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
    cfg.comment("Kalico's filament sensors need it. Make the folder, or name one that exists:");
    cfg.comment("mkdir -p ~/printer_data/gcodes");
    cfg.key("path", "~/printer_data/gcodes");

    let layout = Layout::of(config);
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

/// The second carriage of the x axis.
const DUAL_CARRIAGE: &str = "dual_carriage";

/// Which of klippy's sections the axes belong to.
pub(super) struct Layout<'a> {
    pub(super) config: &'a SimConfig,
    kinematics: Kinematics<'a>,
}

impl<'a> Layout<'a> {
    fn of(config: &'a SimConfig) -> Layout<'a> {
        Layout { config, kinematics: config.kinematics() }
    }

    /// Whether klippy moves a head over the bed.
    pub(super) fn has_head(&self) -> bool {
        self.kinematics != Kinematics::None
    }

    /// Whether an axis has klippy's keys of an axis that is homed.
    pub(super) fn is_homed(&self, axis: &str) -> bool {
        self.kinematics == Kinematics::Cartesian
            && (self.kinematics.rails().contains(&axis) || self.is_dual_carriage(axis))
    }

    fn is_dual_carriage(&self, axis: &str) -> bool {
        let config = self.config.axis(axis).filter(|_| axis == DUAL_CARRIAGE);
        self.kinematics == Kinematics::Cartesian && config.is_some_and(|axis| axis.endstop_pin.is_some())
    }

    /// Whether there is a hot end of this name: klippy has its heater and its stepper in one section.
    pub(super) fn is_hot_end(&self, name: &str) -> bool {
        self.config.hot_ends().any(|heater| heater.name == name)
    }

    /// The section of an axis' stepper.
    pub(super) fn stepper(&self, axis: &str) -> String {
        let is_of = |rail: &&str| self.config.motors(rail).any(|motor| motor.name == axis);
        if self.kinematics.rails().iter().any(is_of) {
            format!("stepper_{axis}")
        } else if self.is_hot_end(axis) || self.is_dual_carriage(axis) {
            axis.to_owned()
        } else {
            format!("manual_stepper {axis}")
        }
    }

    /// The section of a heater, or of the sensor in what nobody switches.
    fn heater(&self, heater: &HeaterConfig) -> String {
        match heater.name.as_str() {
            "heater_bed" => "heater_bed".to_owned(),
            name if self.is_hot_end(name) => name.to_owned(),
            name if heater.pin.is_some() => format!("heater_generic {name}"),
            name => format!("temperature_sensor {name}"),
        }
    }

    /// A place on the bed: 0 is where x and y start, 1 is where they end.
    pub(super) fn place_mm(&self, x: f64, y: f64) -> [f64; 2] {
        let travel_mm = |name| self.config.axis(name).and_then(|axis| axis.travel_mm).unwrap_or(0.0);
        match self.kinematics {
            // The square in the circle.
            Kinematics::Delta(delta) => [x, y].map(|share| (2.0 * share - 1.0) * delta.bed_radius_mm / 2f64.sqrt()),
            _ => [x * travel_mm("x"), y * travel_mm("y")],
        }
    }

    /// The highest that the nozzle goes.
    pub(super) fn height_mm(&self) -> f64 {
        let travel_mm = |name| self.config.axis(name).and_then(|axis| axis.travel_mm).unwrap_or(0.0);
        match self.kinematics {
            Kinematics::Delta(delta) => travel_mm("a") - delta.lowest_mm(),
            _ => travel_mm("z"),
        }
    }
}

/// What a probe beside the nozzle reaches: up to this share of the bed, and from the rest of it on.
const WITHIN_REACH: f64 = 0.8;
/// Above the bed by so much no probe touches it.
const CLEAR_MM: f64 = 5.0;

/// To a micrometre, without what a fraction of two adds.
fn rounded(mm: f64) -> f64 {
    (mm * 1000.0).round() / 1000.0 + 0.0
}

/// A place on the bed, as klippy reads it.
struct Place([f64; 2]);

impl Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x_mm, y_mm] = self.0.map(rounded);
        write!(f, "{x_mm}, {y_mm}")
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
        if !layout.has_head() {
            return;
        }
        if std::mem::replace(&mut self.has_probe, true) {
            self.section_break();
            self.comment("Another probe, in place of the one that is in use:");
            return self.offer(section);
        }
        section(self);
        self.section("bed_mesh");
        match layout.kinematics {
            Kinematics::Delta(delta) => {
                self.key("mesh_radius", rounded(WITHIN_REACH * delta.bed_radius_mm));
                self.key("round_probe_count", 5);
            }
            _ => {
                self.key("mesh_min", Place(layout.place_mm(1.0 - WITHIN_REACH, 1.0 - WITHIN_REACH)));
                self.key("mesh_max", Place(layout.place_mm(WITHIN_REACH, WITHIN_REACH)));
                self.key("probe_count", "5, 5");
            }
        }
        self.key("horizontal_move_z", CLEAR_MM);
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

    /// A key with a line for each place.
    fn places(&mut self, key: &str, places: impl IntoIterator<Item = [f64; 2]>) {
        self.line(format_args!("{key}:"));
        places.into_iter().for_each(|place| self.line(format_args!("  {}", Place(place))));
    }

    /// `[printer]`, and a section for each axis but the hot ends'.
    fn motion(&mut self, layout: &Layout<'_>) {
        let limits = &layout.config.limits;
        self.section("printer");
        self.key(
            "kinematics",
            match layout.kinematics {
                Kinematics::Cartesian => "cartesian",
                Kinematics::Delta(_) => "delta",
                Kinematics::None => "none",
            },
        );
        self.key("max_velocity", limits.velocity_mm_per_s);
        self.key("max_accel", limits.accel_mm_per_s2);
        match layout.kinematics {
            Kinematics::Cartesian => {
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
            Kinematics::None => {}
        }
        for axis in &layout.config.axes {
            if !layout.is_hot_end(&axis.name) {
                self.axis(axis, layout);
            }
        }
        match layout.kinematics {
            Kinematics::Cartesian => self.leveling(layout),
            Kinematics::Delta(delta) => {
                self.section("delta_calibrate");
                self.key("radius", rounded(WITHIN_REACH * delta.bed_radius_mm));
                self.key("horizontal_move_z", CLEAR_MM);
                self.key("speed", limits.velocity_mm_per_s);
            }
            Kinematics::None => {}
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
                    // A nozzle that is a probe goes below the endstop.
                    self.key("position_min", -axis.overtravel_mm);
                }
            }
            // One more motor of an axis, which has the axis' other keys.
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

    /// What levels the gantry, or the bed, by the motors of the z axis.
    fn leveling(&mut self, layout: &Layout<'_>) {
        let at_mm: Vec<[f64; 2]> = layout.config.motors("z").filter_map(|motor| motor.at_mm).collect();
        if at_mm.len() < 2 {
            return;
        }
        // As near to each motor as a probe beside the nozzle reaches.
        let [low, high] = [1.0 - WITHIN_REACH, WITHIN_REACH].map(|share| layout.place_mm(share, share));
        let near = |at: &[f64; 2]| [0, 1].map(|axis| at[axis].clamp(low[axis], high[axis].max(low[axis])));
        match at_mm[..] {
            // From the front left on clockwise, as klippy wants them.
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
        self.key("speed", layout.config.limits.velocity_mm_per_s);
        self.key("retries", 5);
        self.key("retry_tolerance", 0.01);
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
        let fan = layout.config.fan_of(&heater.name);
        if heater.pin.is_none() && fan.is_some() {
            // The fan's section has its keys.
            return;
        }
        self.section(layout.heater(heater));
        if layout.is_hot_end(&heater.name) {
            if let Some(axis) = layout.config.axis(&heater.name) {
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
        self.needs(format_args!("thermistor sim_{}", heater.name));
        self.key("sensor_type", format_args!("sim_{}", heater.name));
        self.key("sensor_pin", &heater.sensor_pin);
        self.key("pullup_resistor", heater.pullup_ohm);
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
        let config = layout.config;
        let cooled = config.heaters.iter().find(|heater| fan.cools.as_ref() == Some(&heater.name));
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
