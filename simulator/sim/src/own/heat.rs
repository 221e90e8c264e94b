// SPDX-License-Identifier: GPL-3.0-or-later
//! Heaters, their sensors, and fans.

use pinion_printer_config::{Config, Limit, Section, Trouble};

use super::description::Entry;
use super::sensors::{is_known, mcu_at_40, sensor};
use super::translator::{Pace, Translator};

/// Temperature of the surroundings.
const AMBIENT_CELSIUS: f64 = 25.0;
/// Full power could heat this much above the highest permitted temperature, as a share of it.
const RESERVE: f64 = 1.3;
/// The highest temperatures that full power reaches without [`RESERVE`], of a bed and of others. A `max_temp` above any
/// real one only switches klippy's check off.
const REAL_MAX_CELSIUS: [f64; 2] = [150.0, 500.0];
/// No heater of a printer is as hot as this.
const UNREAL_CELSIUS: f64 = 1000.0;
/// Heat that a heater's mass stores. Only its ratio to the power counts.
const J_PER_K: f64 = 15.0;
/// klippy's PID parameters are for a power of 0 to this.
const PID_BASE: f64 = 255.0;
/// An integral part with a longer time than this adds nothing before klippy's verify_heater looks, after 20 s.
const SLOW_INTEGRAL_S: f64 = 120.0;
/// How far below its target a heater may stay by its proportional part alone. verify_heater allows 5.
const BELOW_KELVIN: f64 = 3.0;

/// The kinds of a section with a sensor, and their highest temperatures if the section has none.
fn has_sensor(kind: &str) -> bool {
    let is_extruder = kind.strip_prefix("extruder").is_some_and(|rest| rest.chars().all(|c| c.is_ascii_digit()));
    is_extruder
        || [
            "heater_bed",
            "heater_generic",
            "temperature_sensor",
            "temperature_fan",
            "z_thermal_adjust",
            "temperature_probe",
        ]
        .contains(&kind)
}

/// Whether klippy measures this section's temperature at a thing of the printer that a heater can heat.
fn is_heated(section: &Section) -> bool {
    let is_other = |kind: &str| {
        let others = ["temperature_mcu", "temperature_host", "temperature_combined"];
        others.contains(&kind) || kind.starts_with("mpc_")
    };
    section.text("heater_pin").is_none() && section.text("sensor_type").is_some_and(|kind| !is_other(kind))
}

/// The section of a combined sensor that a heater with that sensor heats: the first one that it can heat.
fn heated_by<'a>(config: &'a Config, heater: &Section) -> Option<&'a Section> {
    let is_combined = heater.text("heater_pin").is_some() && heater.text("sensor_type") == Some("temperature_combined");
    let names = heater.list("sensor_list", ',').into_iter().filter(|_| is_combined);
    names.filter_map(|name| config.section(name)).find(|section| is_heated(section))
}

/// The heater that heats this sensor, and has it in its combined one.
fn heater_of<'a>(config: &'a Config, sensor: &Section) -> Option<&'a Section> {
    let is_it = |heater: &&Section| heated_by(config, heater).is_some_and(|heated| heated.name == sensor.name);
    config.sections().iter().find(is_it)
}

/// The watts, heat capacity and loss that a calibrated heater's control by a model has (Kalico's `control: mpc`). With
/// others, the model would find an impossible temperature of the surroundings.
fn mpc_model(section: &Section) -> Result<Option<[f64; 3]>, Trouble> {
    if section.text("control") != Some("mpc") {
        return Ok(None);
    }
    let number = |key: &str| section.number(key, Limit::Any).map(|number| number.filter(|number| *number > 0.0));
    let (watts, j_per_k) = (number("heater_power")?, number("block_heat_capacity")?);
    let loss = number("ambient_transfer")?;
    Ok(watts.zip(j_per_k).zip(loss).map(|((watts, j_per_k), loss)| [watts, j_per_k, loss]))
}

impl Translator<'_> {
    pub(super) fn heat(&mut self) -> Result<(), Trouble> {
        for section in self.config.sections().iter().filter(|section| has_sensor(section.kind())) {
            self.heater(section)?;
        }
        for section in self.config.sections() {
            self.fan(section)?;
        }
        Ok(())
    }

    fn heater(&mut self, section: &Section) -> Result<(), Trouble> {
        let Some(kind) = section.text("sensor_type") else {
            // An extruder may use the heater of another one.
            return match section.text("heater_pin") {
                Some(_) => section.required("sensor_type").map(drop),
                None => Ok(()),
            };
        };
        let is_same = |other: &Section| other.name == section.name;
        if heated_by(self.config, section).and_then(|sensor| heater_of(self.config, sensor)).is_some_and(is_same) {
            // The heater is at that sensor.
            return Ok(());
        }
        let klippys = section.own_name().unwrap_or(&section.name).to_owned();
        let powered = heater_of(self.config, section).unwrap_or(section);
        let name = self.out.name("heater", &klippys);
        // A pin of another chip drives nothing here, and klippy needs one.
        let nothing = powered.text("heater_pin").map(|_| self.out.name("nothing", &format!("nothing_{name}")));
        let pin = self.take(powered, "heater_pin")?.or(nothing);
        let min = section.number("min_temp", Limit::Any)?.unwrap_or(0.0);
        let max = section.number("max_temp", Limit::Any)?.unwrap_or(100.0);
        if max > UNREAL_CELSIUS {
            self.note(
                section,
                &format!("has max_temp {max}, with which klippy checks nothing"),
                "write the highest safe one",
            );
        }
        let start = AMBIENT_CELSIUS.clamp(min.min(max), max.max(min));
        let mut entry = Entry::default().set("name", name.as_str()).set("min_celsius", min).set("max_celsius", max);
        if start != AMBIENT_CELSIUS {
            entry = entry.set("ambient_celsius", start);
        }
        entry = match &pin {
            Some(pin) => {
                let entry = entry.set("pin", pin.as_str());
                let [watts, j_per_k, loss] = match mpc_model(powered)? {
                    Some(model) => model,
                    None => self.usual_model(powered, max)?,
                };
                entry.set("heater_watts", watts).set("heat_capacity_j_per_k", j_per_k).set("loss_w_per_k", loss)
            }
            None => {
                let loss = J_PER_K / 60.0;
                entry.set("heater_watts", 0.0).set("heat_capacity_j_per_k", J_PER_K).set("loss_w_per_k", loss)
            }
        };
        if let Some(with) = sensor(self.config, section, Entry::default())? {
            let Some(sensor_pin) = self.take(section, "sensor_pin")? else {
                // Another section has the sensor already, or klippy refuses the pin.
                section.required("sensor_pin")?;
                return Ok(());
            };
            with.0.into_iter().for_each(|(key, value)| _ = entry.0.insert(key, value));
            self.heaters.insert(klippys, name);
            self.out.add("heater", entry.set("sensor_pin", sensor_pin));
            return Ok(());
        }
        match kind {
            "temperature_mcu" => self.mcu_thermometer(section),
            "temperature_host" | "temperature_combined" | "mpc_block_temperature" | "mpc_ambient_temperature" => {
                if pin.is_some() {
                    // klippy needs the pin.
                    self.out.add("heater", entry);
                }
                Ok(())
            }
            _ => {
                self.heaters.insert(klippys, name.clone());
                self.out.add("heater", entry);
                self.chip_thermometer(section, kind, &name)
            }
        }
    }

    /// The MCU's own thermometer: an ADC channel of the MCU.
    fn mcu_thermometer(&mut self, section: &Section) -> Result<(), Trouble> {
        let mcu = section.text("sensor_mcu").unwrap_or(pinion_printer_config::pins::MAIN).to_owned();
        let pin = self.pin_of(section, "sensor_mcu", &format!("{mcu}:ADC_TEMPERATURE"))?;
        let fraction = mcu_at_40(self.chip(&mcu));
        if let Some(pin) = self.take_pin(section, &pin) {
            let name = self.out.name("analog", &format!("{mcu}_celsius"));
            self.out.add("analog", Entry::default().set("name", name).set("pin", pin).set("fraction", fraction));
        }
        Ok(())
    }

    /// A sensor that is a chip of its own.
    fn chip_thermometer(&mut self, section: &Section, kind: &str, heater: &str) -> Result<(), Trouble> {
        let number = |key: &str, default: f64| section.number(key, Limit::Any).map(|n| n.unwrap_or(default));
        match kind {
            "MAX6675" | "MAX31855" | "MAX31856" | "MAX31865" => {
                let Some(part) = self.chip_on_spi(section, "sensor_pin", "thermocouple")? else { return Ok(()) };
                let name = self.out.name("part", heater);
                let part = part.set("heater", heater).set("chip", kind.to_lowercase()).set("name", name);
                let part = match kind {
                    "MAX31865" => {
                        let part = part.set("rtd_ohm", number("rtd_nominal_r", 100.0)?);
                        part.set("reference_ohm", number("rtd_reference_r", 430.0)?)
                    }
                    _ => part,
                };
                self.out.add("part", part);
            }
            "DS18B20" => {
                let serial = section.required("serial_no")?;
                let digits = serial.strip_prefix("28-").unwrap_or_default();
                if digits.len() != 12 || !digits.chars().all(|c| c.is_ascii_hexdigit()) {
                    let cause = format!("has serial_no {serial}, and the kernel gives a DS18B20 no such name");
                    self.note(section, &cause, "name one in /sys/bus/w1/devices, such as 28-0123456789ab");
                }
                let name = self.out.name("part", heater);
                let part = Entry::of_kind("ds18b20").set("heater", heater);
                self.out.add("part", part.set("name", name).set("serial", serial));
            }
            "BME280" | "HTU21D" | "SHT21" | "SI7013" | "SI7020" | "SI7021" | "SHT3X" | "AHT10" | "AHT1X" | "AHT2X"
            | "AHT3X" | "LM75" => {
                let (chip, address) = match kind {
                    "BME280" => ("bme280", 118),
                    "SHT3X" => ("sht3x", 68),
                    "AHT10" | "AHT1X" | "AHT2X" | "AHT3X" => ("aht10", 56),
                    "LM75" => ("lm75", 72),
                    _ => ("htu21d", 64),
                };
                let Some(part) = self.chip_on_i2c(section, address, "i2c_sensor")? else { return Ok(()) };
                let name = self.out.name("part", heater);
                self.out.add("part", part.set("heater", heater).set("name", name).set("chip", chip));
            }
            _ if is_known(self.config, kind) => {}
            _ => {
                let cause = format!("has the sensor {kind} of a plugin, which is not simulated");
                self.note(section, &cause, "klippy reads no temperature here");
            }
        }
        Ok(())
    }

    /// The watts, heat capacity and loss of a heater that its section's control can hold.
    fn usual_model(&self, section: &Section, max: f64) -> Result<[f64; 3], Trouble> {
        let watts = self.kelvin_per_second(section)? * J_PER_K;
        // A heater that never gets all of its power has more of it.
        let share = section.number("max_power", Limit::Above(0.0))?.unwrap_or(1.0).min(1.0);
        let real_max = max.min(REAL_MAX_CELSIUS[usize::from(section.kind() != "heater_bed")]);
        let reach = (RESERVE * (real_max - AMBIENT_CELSIUS)).max(50.0).max(self.reach_by_p(section, real_max)?);
        Ok([watts / share, J_PER_K, watts / reach])
    }

    /// How fast full power heats: as fast as the section's control can hold.
    fn kelvin_per_second(&self, section: &Section) -> Result<f64, Trouble> {
        let is_bed = section.kind() == "heater_bed";
        let usual = match (self.pace, is_bed) {
            (Pace::Real, true) => 0.5,
            (Pace::Real, false) => 2.5,
            (Pace::Fast, true) => 2.0,
            (Pace::Fast, false) => 8.0,
        };
        let slowest = if is_bed { 0.3 } else { 1.0 };
        let number = |key: &str| section.number(key, Limit::Any).map(|number| number.filter(|number| *number > 0.0));
        if section.text("control") != Some("pid") {
            return Ok(if self.pace == Pace::Fast { usual / 2.0 } else { usual });
        }
        // With klippy's delay of half a second, a stronger gain would swing.
        let by_p = number("pid_kp")?.map_or(usual, |kp| PID_BASE / kp);
        let by_d = number("pid_kd")?.map_or(usual, |kd| 2.0 * PID_BASE / kd);
        Ok(usual.min(by_p).min(by_d).max(slowest))
    }

    /// How far above the surroundings full power has to reach so that a PID whose integral part is slow holds its target.
    fn reach_by_p(&self, section: &Section, max: f64) -> Result<f64, Trouble> {
        let number = |key: &str| section.number(key, Limit::Any).map(|number| number.unwrap_or(0.0));
        let (kp, ki) = (number("pid_kp")?, number("pid_ki")?);
        let is_slow = section.text("control") == Some("pid") && kp > 0.0 && kp > SLOW_INTEGRAL_S * ki;
        Ok(if is_slow { (max - AMBIENT_CELSIUS) * PID_BASE / (kp * BELOW_KELVIN) } else { 0.0 })
    }

    fn fan(&mut self, section: &Section) -> Result<(), Trouble> {
        let kind = section.kind();
        if !["fan", "heater_fan", "controller_fan", "fan_generic", "temperature_fan", "heated_fan"].contains(&kind) {
            return Ok(());
        }
        let wanted = section.own_name().unwrap_or("fan").to_owned();
        let Some(pin) = self.take(section, "pin")? else {
            return section.required("pin").map(drop);
        };
        let name = self.out.name("fan", &wanted);
        let tachometer = self.take(section, "tachometer_pin")?;
        let entry = Entry::default().set("name", name).set("pin", pin).set("max_rpm", 5000.0);
        let entry = entry.set_if("enable_pin", self.take(section, "enable_pin")?);
        let entry = match tachometer {
            Some(pin) => entry
                .set("tachometer_pin", pin)
                .set("pulses_per_revolution", section.whole("tachometer_ppr", 1)?.unwrap_or(2)),
            None => entry,
        };
        let cools = self.heaters.get(&wanted).filter(|_| kind == "temperature_fan").cloned();
        let entry = match cools {
            Some(heater) => entry.set("cools", heater).set("cooling_w_per_k", 0.5),
            None => entry,
        };
        self.out.add("fan", entry);
        Ok(())
    }
}
