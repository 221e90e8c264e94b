// SPDX-License-Identifier: GPL-3.0-or-later
//! Probes, lights, sensors, displays and other things.

use pinion_printer_config::{Limit, Section, Trouble};

use super::description::Entry;
use super::known::is_left_over;
use super::plugins::{PIN, StandIn};
use super::translator::Translator;

/// How high a coil is above the nozzle's tip.
const COIL_MM: f64 = 2.5;

/// The frequency of a coil over the bed: `far_hz + near_hz * exp(-distance / fade_mm)`.
#[derive(Debug, PartialEq)]
struct Curve {
    far_hz: f64,
    near_hz: f64,
    fade_mm: f64,
}

impl Curve {
    const USUAL: Curve = Curve { far_hz: 3_100_000.0, near_hz: 300_000.0, fade_mm: 3.0 };

    /// The curve through the first, the middle and the last point that klippy saved: pairs of a height and a frequency.
    fn through(saved: &str) -> Option<Curve> {
        let pair = |text: &str| {
            let (height, hz) = text.split_once(':')?;
            Some((height.trim().parse::<f64>().ok()?, hz.trim().parse::<f64>().ok()?))
        };
        let mut points = saved.split(',').map(pair).collect::<Option<Vec<(f64, f64)>>>()?;
        points.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        let middle = points.len().saturating_sub(1) / 2;
        let (&(low_mm, at_low), &(_, at_middle), &(high_mm, at_high)) =
            (points.first()?, points.get(middle)?, points.last()?);
        let (near_part, far_part) = (at_low - at_middle, at_middle - at_high);
        if !(0.0 < far_part && far_part < near_part && low_mm < high_mm) {
            return None;
        }
        let ratio = far_part / near_part;
        let fade_mm = -(high_mm - low_mm) / 2.0 / ratio.ln();
        let at_low_mm = near_part / (1.0 - ratio);
        let near_hz = at_low_mm * ((low_mm + COIL_MM) / fade_mm).exp();
        Some(Curve { far_hz: at_low - at_low_mm, near_hz, fade_mm })
    }
}

/// How stiff a hot end on a load cell is.
const CELL_G_PER_MM: f64 = 4000.0;
/// The gain of a load cell without a calibration.
const COUNTS_PER_GRAM: f64 = 400.0;

impl Translator<'_> {
    pub(super) fn devices(&mut self) -> Result<(), Trouble> {
        for section in self.config.sections() {
            self.device(section)?;
        }
        self.stand_in();
        Ok(())
    }

    /// The plain probe in the place of a plugin's.
    fn stand_in(&mut self) {
        let Some(StandIn { section, offsets_mm }) = self.left_out.stand_in.clone() else { return };
        let part = Entry::of_kind("probe").set("pin", PIN);
        let offsets = ["x", "y", "z"].iter().zip(offsets_mm);
        self.out.add("part", offsets.fold(part, |part, (axis, mm)| part.set(&format!("{axis}_offset_mm"), mm)));
        if let Some(section) = self.config.section(&section) {
            self.note(section, "is left out", "a plain [probe] at its offsets takes its place");
        }
    }

    fn device(&mut self, section: &Section) -> Result<(), Trouble> {
        match section.kind() {
            _ if self.left_out.stand_in.is_some() && section.kind() == "probe" => Ok(()),
            "probe" if is_left_over(self.config, section) => Ok(()),
            "probe" | "smart_effector" | "dockable_probe" => self.probe(section),
            "bltouch" => self.bltouch(section),
            "probe_eddy_current" => self.eddy(section),
            "load_cell" | "load_cell_probe" => self.load_cell(section),
            "filament_switch_sensor" => self.filament_switch(section),
            "filament_motion_sensor" => self.filament_motion(section),
            "servo" => self.servo(section),
            "dotstar" => self.dotstar(section),
            "led" => self.led(section),
            "output_pin" | "pwm_tool" | "pwm_cycle_time" => self.output(section),
            "display" => self.display(section),
            "gcode_button" => self.button(section),
            "adxl345" | "bmi160" | "icm20948" | "lis2dw" | "lis3dh" | "mpu9250" => self.accelerometer(section),
            "angle" => self.angle(section),
            "adc_scaled" => self.scaled(section),
            "hall_filament_width_sensor" => self.hall_width(section),
            "tsl1401cl_filament_width_sensor" => self.line_width(section),
            "mcp4018" | "mcp4451" | "pca9533" | "pca9632" | "sx1509" => self.i2c_register(section),
            "ad5206" | "dac084S085" => self.dac(section),
            _ => Ok(()),
        }
    }

    fn name_of(&mut self, kind: &str, section: &Section) -> String {
        let wanted = section.own_name().unwrap_or(section.kind()).to_owned();
        self.out.name(kind, &wanted)
    }

    /// A probe's offsets from the nozzle along these axes.
    fn offsets(part: Entry, section: &Section, axes: &[&str]) -> Result<Entry, Trouble> {
        axes.iter().try_fold(part, |part, axis| {
            let mm = section.number(&format!("{axis}_offset"), Limit::Any)?.unwrap_or(0.0);
            Ok(part.set(&format!("{axis}_offset_mm"), mm))
        })
    }

    fn probe(&mut self, section: &Section) -> Result<(), Trouble> {
        if section.kind() == "probe" {
            section.required("z_offset")?;
        }
        let Some(pin) = self.take(section, "pin")? else { return section.required("pin").map(drop) };
        let mut part = Translator::offsets(Entry::of_kind("probe").set("pin", pin), section, &["x", "y", "z"])?;
        if let Some(dock_mm) = self.dock_mm(section) {
            part = part.numbers("dock_mm", dock_mm);
        }
        self.out.add("part", part);
        Ok(())
    }

    /// Where the nozzle is when it takes a probe up and puts it back: of Kalico's dockable probe, or of the macros of
    /// Klicky or Euclid.
    fn dock_mm(&self, probe: &Section) -> Option<[f64; 2]> {
        let of_macros = |key: &str| self.config.of_kind("gcode_macro").find_map(|section| section.text(key));
        let number = |text: &str| text.trim().parse::<f64>().ok();
        let pair = |text: &str| {
            let mut numbers = text.trim().trim_matches(['[', ']', '(', ')']).split(',').map(number);
            Some([numbers.next()??, numbers.next()??])
        };
        let klicky = || {
            let place = |axis: &str| of_macros(&format!("variable_docklocation_{axis}")).and_then(number);
            Some([place("x")?, place("y")?])
        };
        let own = probe.text("dock_position").and_then(pair);
        own.or_else(klicky).or_else(|| of_macros("variable_position_dock").and_then(pair))
    }

    fn bltouch(&mut self, section: &Section) -> Result<(), Trouble> {
        section.required("z_offset")?;
        let [sensor, control] = ["sensor_pin", "control_pin"].map(|key| self.take(section, key));
        let (Some(sensor), Some(control)) = (sensor?, control?) else {
            return section.required("sensor_pin").and(section.required("control_pin")).map(drop);
        };
        let part = Entry::of_kind("bltouch").set("sensor_pin", sensor).set("control_pin", control);
        self.out.add("part", Translator::offsets(part, section, &["x", "y", "z"])?);
        Ok(())
    }

    fn eddy(&mut self, section: &Section) -> Result<(), Trouble> {
        let Some(part) = self.chip_on_i2c(section, 42, "ldc1612")? else { return Ok(()) };
        let part = Translator::offsets(part, section, &["x", "y"])?;
        let part = part.set_if("intb_pin", self.take(section, "intb_pin")?);
        let Curve { far_hz, near_hz, fade_mm } =
            section.text("calibrate").and_then(Curve::through).unwrap_or(Curve::USUAL);
        let part = part.set("coil_mm", COIL_MM).set("far_hz", far_hz).set("near_hz", near_hz).set("fade_mm", fade_mm);
        let current = section.whole("reg_drive_current", 0)?.unwrap_or(16);
        self.out.add("part", part.set("drive_current", current));
        Ok(())
    }

    fn load_cell(&mut self, section: &Section) -> Result<(), Trouble> {
        let chip = section.required("sensor_type")?.to_owned();
        let number = |key: &str, default: f64| section.number(key, Limit::Any).map(|n| n.unwrap_or(default));
        let cell = Entry::default().set("stiffness_g_per_mm", CELL_G_PER_MM);
        let cell = cell.set("counts_per_gram", number("counts_per_gram", COUNTS_PER_GRAM)?);
        let cell = cell.set("zero_counts", number("reference_tare_counts", 0.0)?).0;
        let part = match chip.as_str() {
            "hx711" | "hx717" => {
                let [dout, sclk] = ["dout_pin", "sclk_pin"].map(|key| self.take(section, key));
                let (Some(dout), Some(sclk)) = (dout?, sclk?) else { return Ok(()) };
                let rate = section.whole("sample_rate", 1)?.unwrap_or(if chip == "hx711" { 80 } else { 320 });
                let part = Entry::of_kind("hx71x").set("chip", chip).set("dout_pin", dout);
                part.set("sclk_pin", sclk).set("samples_per_s", rate)
            }
            "ads1220" => {
                section.required("cs_pin")?;
                if self.out.name("part", "ads1220") != "ads1220" {
                    self.note(section, "is the second one with an ADS1220", "only the first one is simulated");
                    return Ok(());
                }
                let (Some(part), Some(ready)) =
                    (self.chip_on_spi(section, "cs_pin", "ads1220")?, self.take(section, "data_ready_pin")?)
                else {
                    return Ok(());
                };
                part.set("drdy_pin", ready)
            }
            chip => {
                let cause = format!("has the chip {chip}, which is not simulated");
                self.note(section, &cause, "its pins exist, and nothing is at them");
                return Ok(());
            }
        };
        self.out.add("part", part.set("cell", cell));
        Ok(())
    }

    fn filament_switch(&mut self, section: &Section) -> Result<(), Trouble> {
        // There is filament.
        self.level(section, "switch_pin", true)
    }

    fn filament_motion(&mut self, section: &Section) -> Result<(), Trouble> {
        let axis = section.text("extruder").and_then(|extruder| self.axes.get(extruder)).cloned();
        let Some(axis) = axis else { return self.level(section, "switch_pin", true) };
        let Some(pin) = self.take(section, "switch_pin")? else { return Ok(()) };
        let length = section.number("detection_length", Limit::Above(0.0))?.unwrap_or(7.0);
        let name = self.name_of("part", section);
        let part = Entry::of_kind("spool").set("name", name).set("axis", axis);
        let part = part.set("length_mm", 330_000.0).set("encoder_pin", pin).set("encoder_mm", length / 4.0);
        self.out.add("part", part);
        Ok(())
    }

    /// An input that stays at a level.
    fn level(&mut self, section: &Section, key: &str, level: bool) -> Result<(), Trouble> {
        if let Some(pin) = self.take(section, key)? {
            let name = self.name_of("input", section);
            self.out.add("input", Entry::default().set("name", name).set("pin", pin).set("level", level));
        }
        Ok(())
    }

    fn servo(&mut self, section: &Section) -> Result<(), Trouble> {
        let Some(pin) = self.take(section, "pin")? else { return section.required("pin").map(drop) };
        let us = |key: &str, default: f64| {
            section.number(key, Limit::Above(0.0)).map(|seconds| seconds.map_or(default, |seconds| seconds * 1e6))
        };
        let name = self.name_of("part", section);
        let part = Entry::of_kind("servo").set("name", name).set("pin", pin);
        let part = part.set("min_pulse_us", us("minimum_pulse_width", 1000.0)?);
        let part = part.set("max_pulse_us", us("maximum_pulse_width", 2000.0)?);
        let degrees = section.number("maximum_servo_angle", Limit::Above(0.0))?.unwrap_or(180.0);
        self.out.add("part", part.set("travel_degrees", degrees));
        Ok(())
    }

    fn dotstar(&mut self, section: &Section) -> Result<(), Trouble> {
        let [data, clock] = ["data_pin", "clock_pin"].map(|key| self.take(section, key));
        if let (Some(data), Some(clock)) = (data?, clock?) {
            let name = self.name_of("part", section);
            let count = section.whole("chain_count", 1)?.unwrap_or(1);
            let part = Entry::of_kind("apa102").set("name", name).set("count", count);
            self.out.add("part", part.set("data_pin", data).set("clock_pin", clock));
        }
        Ok(())
    }

    /// Strips on a data line each: an SPI bus with only its output in use. They come last, because klippy takes the
    /// first bus where a section names none.
    pub(super) fn strips(&mut self) -> Result<(), Trouble> {
        for section in self.config.of_kind("neopixel") {
            let Some(pin) = self.take(section, "pin")? else { continue };
            let name = self.name_of("part", section);
            let order = section.list("color_order", ',').first().map_or("GRB".to_owned(), |order| order.to_uppercase());
            let mut letters: Vec<char> = order.chars().collect();
            letters.sort_unstable();
            if !["BGR", "BGRW"].contains(&letters.iter().collect::<String>().as_str()) {
                let cause = format!("Invalid color_order '{order}'");
                return Err(section.trouble("color_order", cause).remedy("write it as GRB"));
            }
            let count = section.whole("chain_count", 1)?.unwrap_or(1);
            self.out.add("spi_bus", Entry::default().set("name", pin.as_str()));
            let part = Entry::of_kind("ws2812").set("name", name).set("count", count);
            self.out.add("part", part.set("bus", pin).set("color_order", order));
        }
        Ok(())
    }

    fn led(&mut self, section: &Section) -> Result<(), Trouble> {
        let keys = [("red_pin", "red_pin"), ("green_pin", "green_pin"), ("blue_pin", "blue_pin"), ("white_pin", "pin")];
        let name = self.name_of("led", section);
        let mut entry = Entry::default().set("name", name);
        for (klippys, ours) in keys {
            entry = entry.set_if(ours, self.take(section, klippys)?);
        }
        if entry.0.len() > 1 {
            self.out.add("led", entry);
        }
        Ok(())
    }

    fn output(&mut self, section: &Section) -> Result<(), Trouble> {
        if let Some(pin) = self.take(section, "pin")? {
            let name = self.name_of("output", section);
            self.out.add("output", Entry::default().set("name", name).set("pin", pin));
        }
        Ok(())
    }

    fn display(&mut self, section: &Section) -> Result<(), Trouble> {
        for key in ["click_pin", "back_pin", "up_pin", "down_pin", "kill_pin"] {
            // An analog button has a range of resistances, and is not pressed.
            match section.text(&format!("analog_range_{key}")) {
                Some(_) => self.fixed(section, key, 1.0)?,
                None => self.level(section, key, false)?,
            }
        }
        let kind = section.text("lcd_type").unwrap_or_default();
        if !["ssd1306", "sh1106"].contains(&kind) {
            return Ok(());
        }
        let found = match section.text("cs_pin") {
            None => self.chip_on_i2c(section, 60, "ssd1306")?,
            Some(_) => self.chip_on_spi(section, "cs_pin", "ssd1306")?,
        };
        let Some(mut part) = found else { return Ok(()) };
        part = part.set("chip", kind).set("name", self.name_of("part", section));
        for key in ["dc_pin", "reset_pin"] {
            part = part.set_if(key, self.take(section, key)?);
        }
        self.out.add("part", part);
        Ok(())
    }

    fn button(&mut self, section: &Section) -> Result<(), Trouble> {
        match section.text("analog_range") {
            Some(_) => self.fixed(section, "pin", 1.0),
            None => self.level(section, "pin", false),
        }
    }

    /// An ADC channel that reads a fixed fraction of its reference.
    fn fixed(&mut self, section: &Section, key: &str, fraction: f64) -> Result<(), Trouble> {
        if let Some(pin) = self.take(section, key)? {
            let name = self.name_of("analog", section);
            self.out.add("analog", Entry::default().set("name", name).set("pin", pin).set("fraction", fraction));
        }
        Ok(())
    }

    fn scaled(&mut self, section: &Section) -> Result<(), Trouble> {
        self.fixed(section, "vref_pin", 1.0)?;
        self.fixed(section, "vssa_pin", 0.0)
    }

    /// Two Hall sensors at the filament. klippy adds their readings, in steps of 1/10000, and knows two diameters.
    fn hall_width(&mut self, section: &Section) -> Result<(), Trouble> {
        let number = |key: &str, usual: f64| section.number(key, Limit::Any).map(|found| found.unwrap_or(usual));
        let (mm1, mm2) = (number("cal_dia1", 1.5)?, number("cal_dia2", 2.0)?);
        let (raw1, raw2) = (number("raw_dia1", 9500.0)?, number("raw_dia2", 10500.0)?);
        let sum = raw1 + (width_mm(section)? - mm1) * (raw2 - raw1) / (mm2 - mm1);
        let share = if sum.is_finite() { (sum / 2.0 / 10_000.0).clamp(0.0, 1.0) } else { 0.5 };
        self.fixed(section, "adc1", share)?;
        self.fixed(section, "adc2", share)
    }

    /// A row of light sensors across the filament: 5 mm are the ADC's whole range.
    fn line_width(&mut self, section: &Section) -> Result<(), Trouble> {
        self.fixed(section, "pin", (width_mm(section)? / 5.0).clamp(0.0, 1.0))
    }

    fn accelerometer(&mut self, section: &Section) -> Result<(), Trouble> {
        let chip = section.kind();
        // klippy's default addresses.
        let usual = match chip {
            "lis2dw" | "lis3dh" => Some(0x19),
            "mpu9250" | "icm20948" => Some(0x68),
            "bmi160" => Some(0x69),
            _ => None,
        };
        const KIND: &str = "accelerometer";
        let is_on_spi = section.text("cs_pin").is_some() && !matches!(chip, "mpu9250" | "icm20948");
        let found = match usual.filter(|_| !is_on_spi) {
            Some(usual) => self.chip_on_i2c(section, usual, KIND)?,
            None => {
                section.required("cs_pin")?;
                self.chip_on_spi(section, "cs_pin", KIND)?
            }
        };
        let Some(part) = found else { return Ok(()) };
        let mut part = part.set("chip", chip).set_if("name", section.own_name());
        let shaken =
            |axis: &str, hz: f64| Entry::default().set("axis", axis).set("hz", hz).set("damping_ratio", 0.06).0;
        for (axis, hz) in [("x", 52.0), ("y", 43.0)] {
            if self.axes.values().any(|name| name == axis) {
                part = part.set(axis, shaken(axis, hz));
            }
        }
        self.out.add("part", part);
        Ok(())
    }

    fn angle(&mut self, section: &Section) -> Result<(), Trouble> {
        let chip = section.required("sensor_type")?.to_owned();
        let Some(axis) = section.text("stepper").and_then(|stepper| self.axes.get(stepper)).cloned() else {
            return Ok(());
        };
        let Some(part) = self.chip_on_spi(section, "cs_pin", "angle_sensor")? else { return Ok(()) };
        self.out.add("part", part.set("chip", chip).set("axis", axis));
        Ok(())
    }

    fn i2c_register(&mut self, section: &Section) -> Result<(), Trouble> {
        let kind = section.kind();
        let usual = match kind {
            "mcp4018" => 0x2f,
            "pca9533" | "pca9632" => 98,
            _ => {
                section.required("i2c_address")?;
                0
            }
        };
        let Some(part) = self.chip_on_i2c(section, usual, "i2c_register")? else { return Ok(()) };
        let name = self.name_of("part", section);
        self.out.add("part", part.set("name", name).set("chip", kind));
        Ok(())
    }

    fn dac(&mut self, section: &Section) -> Result<(), Trouble> {
        section.required("enable_pin")?;
        let Some(part) = self.chip_on_spi(section, "enable_pin", "spi_dac")? else { return Ok(()) };
        let name = self.name_of("part", section);
        self.out.add("part", part.set("name", name).set("chip", section.kind().to_lowercase()));
        Ok(())
    }
}

/// The diameter of the filament, which is the one that klippy expects.
fn width_mm(section: &Section) -> Result<f64, Trouble> {
    section.required("default_nominal_filament_diameter")?;
    Ok(section.number("default_nominal_filament_diameter", Limit::Above(1.0))?.unwrap_or(1.75))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coil_has_the_curve_that_klippy_saved() {
        let Curve { far_hz, near_hz, fade_mm } = Curve::USUAL;
        let hz = |mm: f64| far_hz + near_hz * (-(mm + COIL_MM) / fade_mm).exp();
        let saved: Vec<String> = (0..=80).map(|n| f64::from(n) * 0.05).map(|mm| format!("{mm}:{}", hz(mm))).collect();
        let found = Curve::through(&saved.join(",")).unwrap();
        assert!((found.far_hz - far_hz).abs() < 1.0 && (found.near_hz - near_hz).abs() < 1.0, "{found:?}");
        assert!((found.fade_mm - fade_mm).abs() < 1e-4, "{found:?}");
        for nothing in ["", "1:2", "0:3,1:3,2:3", "0:x"] {
            assert_eq!(Curve::through(nothing), None, "{nothing}");
        }
    }
}
