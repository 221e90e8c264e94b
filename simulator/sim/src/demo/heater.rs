// SPDX-License-Identifier: GPL-3.0-or-later
//! One heater. A sensor's readings become temperatures, an output is pulsed in software, and a proportional-integral
//! loop connects them.

use std::time::{Duration, Instant};

use pinion_client::config::Config;
use pinion_client::{Client, Error, Params};
use pinion_model::{HeaterConfig, PinName, Thermistor};
use pinion_protocol::clock::Clock;

/// The output's period, in seconds.
const CYCLE_S: f64 = 0.1;
/// The output's `max_duration`, in seconds. After this time without a new value the MCU shuts down.
const MAX_DURATION_S: f64 = 3.0;
const REPORT_S: f64 = 0.3;
const SAMPLE_S: f64 = 0.001;
const SAMPLES: u8 = 8;
/// How many readings in a row may be out of range before the MCU shuts down.
const RANGE_CHECKS: u8 = 4;
/// How far ahead a new value of the output takes effect, in seconds.
const LEAD_S: f64 = 0.25;
/// How long to wait for a reading.
const READING_TIMEOUT: Duration = Duration::from_secs(3);

/// How far above its surroundings the heater heats. The built-in bed takes half a minute to get there.
const RISE_C: f64 = 20.0;
/// How far off the temperature may be.
pub const TOLERANCE_C: f64 = 1.0;
/// How long it must stay within the tolerance, in seconds.
pub const HOLD_S: f64 = 3.0;
/// When to give up.
const TIMEOUT: Duration = Duration::from_secs(180);

/// A heater as configured.
pub struct Heater<'a> {
    heater: &'a HeaterConfig,
    pin: &'a PinName,
    sensor_pin: &'a PinName,
    thermistor: Thermistor,
    sensor: u8,
    output: u8,
    last: Option<Clock>,
}

impl<'a> Heater<'a> {
    /// Adds a heater to a configuration. `None` if nothing heats it, or if its sensor is not a thermistor. Fails if there
    /// are too many objects.
    pub fn configure(
        client: &Client,
        config: &mut Config,
        heater: &'a HeaterConfig,
    ) -> Option<Result<Heater<'a>, Error>> {
        let (pin, sensor_pin) = (heater.pin.as_ref()?, heater.sensor_pin.as_ref()?);
        let thermistor = heater.thermistor().ok()?;
        let oids = config.oid().and_then(|sensor| Ok((sensor, config.oid()?)));
        Some(oids.map(|(sensor, output)| {
            let (off, name, max) = (u8::from(pin.inverted), &pin.name, client.ticks(MAX_DURATION_S));
            config.add(format!("config_analog_in oid={sensor} pin={}", sensor_pin.name));
            config.add(format!(
                "config_digital_out oid={output} pin={name} value={off} default_value={off} max_duration={max}"
            ));
            config.add(format!("set_digital_out_pwm_cycle oid={output} cycle_ticks={}", client.ticks(CYCLE_S)));
            Heater { heater, pin, sensor_pin, thermistor, sensor, output, last: None }
        }))
    }

    /// Its name for people.
    pub fn name(&self) -> &str {
        &self.heater.name
    }

    /// The temperature to reach.
    pub fn target_c(&self) -> f64 {
        self.heater.ambient_celsius + RISE_C
    }

    /// Heats until the target is reached and held. Then it switches off and returns the last temperature. `seen` gets each
    /// temperature and the power that follows from it, 0 to 1. Fails if the target is not reached in time.
    pub fn heat(&mut self, client: &mut Client, seen: &mut dyn FnMut(f64, f64)) -> Result<f64, Error> {
        self.query(client, SAMPLES)?;
        let result = self.pursue(client, seen);
        // After a shutdown the output is off, and the error to return is the shutdown's.
        if client.check().is_ok() {
            self.set(client, 0.0)?;
            self.query(client, 0)?;
            client.link().settle()?;
        }
        result
    }

    fn pursue(&mut self, client: &mut Client, seen: &mut dyn FnMut(f64, f64)) -> Result<f64, Error> {
        let until = Instant::now() + TIMEOUT;
        let target_c = self.target_c();
        let mut control = Control::default();
        let mut there_since: Option<Clock> = None;
        loop {
            let (clock, celsius) = self.read(client)?;
            let power = control.power(target_c - celsius, REPORT_S);
            self.set(client, power)?;
            seen(celsius, power);
            if (celsius - target_c).abs() <= TOLERANCE_C {
                let since = *there_since.get_or_insert(clock);
                if clock.since(since) as f64 >= HOLD_S * client.frequency_hz() {
                    return Ok(celsius);
                }
            } else {
                there_since = None;
            }
            if Instant::now() >= until {
                return Err(Error::Plan {
                    subject: self.pin.name.clone(),
                    why: format!(
                        "{celsius:.1} °C after {} s instead of {target_c:.1} °C; check heater and sensor",
                        TIMEOUT.as_secs()
                    ),
                });
            }
        }
    }

    /// Starts readings, or stops them with no samples.
    fn query(&self, client: &mut Client, samples: u8) -> Result<(), Error> {
        let full = client.constant("ADC_MAX")? * f64::from(SAMPLES);
        let limit = |celsius: f64| self.thermistor.fraction(celsius) * full;
        let mut args = vec![
            ("oid", self.sensor.into()),
            ("clock", client.clock_in(LEAD_S)?.into()),
            ("sample_ticks", client.ticks(SAMPLE_S).into()),
            ("sample_count", samples.into()),
            ("rest_ticks", client.ticks(REPORT_S).into()),
            ("min_value", (limit(self.heater.max_celsius).floor() as i64).into()),
            ("max_value", (limit(self.heater.min_celsius).ceil() as i64).into()),
            ("range_check_count", RANGE_CHECKS.into()),
        ];
        if client.messages().has_parameter("query_analog_in", "bytes_per_report") {
            args.push(("bytes_per_report", 2u8.into()));
        }
        client.send("query_analog_in", &args)
    }

    fn read(&self, client: &mut Client) -> Result<(Clock, f64), Error> {
        let until = Instant::now() + READING_TIMEOUT;
        let state = client.wait("analog_in_state", Some(self.sensor), until)?.ok_or_else(|| Error::Timeout {
            waiting_for: format!("reading of {}", self.sensor_pin.name),
            after: READING_TIMEOUT,
        })?;
        let full = client.constant("ADC_MAX")? * f64::from(SAMPLES);
        let celsius = self.thermistor.celsius(value(&state)? / full);
        let next = client.widen(state.u32("next_clock")?);
        let clock = next.displaced(client.ticks(REPORT_S).wrapping_neg());
        Ok((clock, celsius))
    }

    fn set(&mut self, client: &mut Client, power: f64) -> Result<(), Error> {
        let cycle = client.ticks(CYCLE_S);
        let part = if self.pin.inverted { 1.0 - power } else { power };
        let on_ticks = (part.clamp(0.0, 1.0) * f64::from(cycle)).round() as u32;
        // Each value must take effect after the one before.
        let clock = client.clock_in(LEAD_S)?;
        let clock = self.last.map_or(clock, |last| clock.max(last.displaced(1)));
        self.last = Some(clock);
        client.send(
            "queue_digital_out",
            &[("oid", self.output.into()), ("clock", clock.into()), ("on_ticks", on_ticks.into())],
        )
    }
}

/// The sum of a report's samples: one number, or the first of a row of 16-bit numbers.
fn value(state: &Params) -> Result<f64, Error> {
    if state.get("value").is_some() {
        return Ok(state.int("value")? as f64);
    }
    match state.bytes("values")? {
        [low, high, ..] => Ok(f64::from(u16::from_le_bytes([*low, *high]))),
        _ => Err(Error::Message { message: state.name.clone(), why: "the report has no value".to_owned() }),
    }
}

/// A proportional-integral controller. Far below the target it gives full power. Near the target the power is in
/// proportion to the error and its integral.
#[derive(Debug, Default)]
struct Control {
    integral: f64,
}

impl Control {
    /// Degrees below the target at which power begins to fall.
    const BAND_C: f64 = 4.0;
    /// The time constant of the integral, in seconds.
    const INTEGRAL_S: f64 = 30.0;

    fn power(&mut self, error_c: f64, elapsed_s: f64) -> f64 {
        let proportional = error_c / Control::BAND_C;
        if proportional.abs() < 1.0 {
            self.integral = (self.integral + proportional * elapsed_s / Control::INTEGRAL_S).clamp(0.0, 1.0);
        }
        (proportional + self.integral).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loop_settles_on_the_target_without_going_far_beyond() {
        // A bed of 500 J/K that loses 4 W/K, with 300 W.
        let (mut control, mut celsius, mut most) = (Control::default(), 21.0, 0.0f64);
        for _ in 0..4000 {
            let power = control.power(60.0 - celsius, REPORT_S);
            assert!((0.0..=1.0).contains(&power));
            celsius += REPORT_S * (300.0 * power - 4.0 * (celsius - 21.0)) / 500.0;
            most = most.max(celsius);
        }
        assert!((celsius - 60.0).abs() < 0.2, "{celsius}");
        assert!(most < 62.0, "{most}");
    }
}
