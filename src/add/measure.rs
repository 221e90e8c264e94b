// SPDX-License-Identifier: GPL-3.0-or-later
//! Restarts the host, and asks it for a device's first value.

use std::thread;
use std::time::{Duration, Instant};

use serde_json::json;

use super::moonraker::{Host, LEAVE_TIMEOUT, Moonraker};
use super::work::Work;

/// How long a fan may take until its tachometer counts. klippy reports a speed each second.
const SPIN_UP: Duration = Duration::from_secs(6);
/// How long a sensor may take until the host has its first value. A DS18B20 takes 3 s.
const FIRST_VALUE: Duration = Duration::from_secs(8);

impl Work<'_> {
    /// Restarts the host, and asks it for a first value.
    pub(super) fn measure(&mut self, moonraker: &str, is_changed: bool) -> Result<(), String> {
        let moonraker = Moonraker(moonraker);
        let left = match moonraker.host() {
            Host::Rests => None,
            Host::Prints => Some("the host prints: run FIRMWARE_RESTART after the print".to_owned()),
            Host::Unknown(why) => Some(format!("{why}: run FIRMWARE_RESTART in the host")),
        };
        self.report.set("warning", json!(left));
        if let Some(left) = left {
            self.report.line(left);
            return Ok(());
        }
        let restarted = if is_changed { moonraker.restart(LEAVE_TIMEOUT) } else { Ok(()) };
        let measured = restarted.and_then(|()| self.first_value(&moonraker))?;
        self.report.line(&measured);
        self.report.set("measured", json!(measured));
        Ok(())
    }

    /// The host's first measurement with the device, in words.
    fn first_value(&self, moonraker: &Moonraker) -> Result<String, String> {
        let section = &self.section();
        if self.device.resonance {
            let chip = section.rsplit(' ').next().unwrap_or_default();
            let lines = moonraker.run(&format!("ACCELEROMETER_QUERY CHIP={chip}"))?;
            let values = lines.iter().find_map(|line| acceleration(line));
            return values.ok_or_else(|| "ACCELEROMETER_QUERY answers no values: see klippy.log".to_owned())?;
        }
        if let Some(fan) = section.strip_prefix("fan_generic ") {
            return turns(moonraker, section, fan);
        }
        if let Some(strip) = section.strip_prefix("neopixel ") {
            moonraker.run(&format!("SET_LED LED={strip} RED=0.5 GREEN=0 BLUE=0"))?;
            let line = "the strip should be red now. If it is green, write color_order: RGB into its section. If it is \
                        dark, check its 5 V, its ground, and that the wire goes to DIN";
            return Ok(line.into());
        }
        if section.starts_with("temperature_sensor ") {
            let degrees = temperature(moonraker, section)?;
            return match (-40.0..=150.0).contains(&degrees) {
                true => Ok(format!("the host reads {degrees:.1} degrees")),
                false => Err(format!("the host reads {degrees:.1} degrees: check the sensor's wires and type")),
            };
        }
        if let Some(command) = &self.device.measure {
            let command = self.device.named(command, self.name());
            let lines = moonraker.run(&command)?;
            let lines: Vec<&str> = lines.iter().map(|line| line.trim_start_matches("// ")).collect();
            return Ok(format!("{command}: {}", lines.join("; ")));
        }
        Ok("the host has restarted with the device".into())
    }
}

/// A sensor's first temperature. klippy says 0 until it has one.
fn temperature(moonraker: &Moonraker, section: &str) -> Result<f64, String> {
    let end = Instant::now() + FIRST_VALUE;
    loop {
        let degrees = moonraker.value(section, "temperature")?;
        if degrees != 0.0 {
            return Ok(degrees);
        }
        if Instant::now() >= end {
            return Err("the host has read no temperature yet: see klippy.log".into());
        }
        thread::sleep(Duration::from_millis(500));
    }
}

/// Lets a fan run at full speed until its tachometer counts.
fn turns(moonraker: &Moonraker, section: &str, fan: &str) -> Result<String, String> {
    let speed = |speed: &str| moonraker.run(&format!("SET_FAN_SPEED FAN={fan} SPEED={speed}"));
    let end = Instant::now() + SPIN_UP;
    speed("1")?;
    let counted = loop {
        let rpm = moonraker.value(section, "rpm");
        if rpm.as_ref().is_ok_and(|rpm| *rpm > 0.0) || Instant::now() >= end {
            break rpm;
        }
        thread::sleep(Duration::from_millis(500));
    };
    speed("0")?;
    match counted? {
        rpm if rpm > 0.0 => Ok(format!("the tachometer counts {rpm:.0} turns a minute at full speed")),
        _ => {
            Err("the tachometer counts nothing at full speed: check that the fan runs, and check the tachometer's wire"
                .into())
        }
    }
}

/// The acceleration in klippy's answer to ACCELEROMETER_QUERY, judged: at rest it is gravity's.
fn acceleration(line: &str) -> Option<Result<String, String>> {
    const GRAVITY_MM_S2: f64 = 9806.65;
    let values = line.split_once("accelerometer values (x, y, z): ")?.1;
    let values: Vec<f64> = values.split(',').filter_map(|value| value.trim().parse().ok()).collect();
    let [x, y, z] = values[..] else { return None };
    let total = (x * x + y * y + z * z).sqrt();
    let found = format!("it measures {x:.0}, {y:.0}, {z:.0} mm/s2: {:.2} of gravity", total / GRAVITY_MM_S2);
    Some(match (0.7..=1.3).contains(&(total / GRAVITY_MM_S2)) {
        true => Ok(found),
        false => Err(format!("{found}: at rest it should be 1: check its wires, its power, and that nothing moves")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_measurement_at_rest_is_gravity() {
        let judged = |line: &str| acceleration(line);
        assert_eq!(judged("// ok"), None);
        assert_eq!(judged("accelerometer values (x, y, z): a, b"), None);
        let good = judged("accelerometer values (x, y, z): 470.719200, 941.438400, 9728.196800").unwrap().unwrap();
        assert_eq!(good, "it measures 471, 941, 9728 mm/s2: 1.00 of gravity");
        assert!(judged("accelerometer values (x, y, z): 0.0, 0.0, 0.0").unwrap().unwrap_err().contains("at rest"));
    }
}
