// SPDX-License-Identifier: GPL-3.0-or-later
//! One heater. A sensor's readings become temperatures, an output is pulsed in software, and a proportional-integral
//! loop connects them.

use std::time::{Duration, Instant};

use pinion_client::config::Config;
use pinion_client::{Client, Error, Params};
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

/// A heater's pins and limits.
#[derive(Clone, Debug, PartialEq)]
pub struct Wiring {
    /// The output's pin.
    pub heater_pin: String,
    /// Whether the output is low when it heats.
    pub invert: bool,
    /// The sensor's pin.
    pub sensor_pin: String,
    /// The MCU shuts down below this, in degrees Celsius.
    pub min_c: f64,
    /// The MCU shuts down above this, in degrees Celsius.
    pub max_c: f64,
}

/// A reading, and the output that follows from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// When the samples began.
    pub clock: Clock,
    /// Degrees Celsius.
    pub celsius: f64,
    /// The output from then on, 0 to 1.
    pub power: f64,
}

/// A heater as configured.
pub struct Heater {
    sensor: u8,
    output: u8,
    wiring: Wiring,
    celsius: Box<dyn Fn(f64) -> f64>,
    last: Option<Clock>,
}

/// The goal of a heater.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Goal {
    /// Degrees Celsius.
    pub target_c: f64,
    /// How far off the temperature may be, in degrees.
    pub tolerance_c: f64,
    /// How long it must stay within the tolerance, in seconds.
    pub hold_s: f64,
    /// When to give up, in seconds.
    pub timeout_s: f64,
}

impl Heater {
    /// Adds a heater to a configuration. `celsius` converts a reading, as a part of the full scale, to degrees. The
    /// degrees must fall as the reading rises. Fails if there are too many objects.
    pub fn configure(
        client: &Client,
        config: &mut Config,
        wiring: Wiring,
        celsius: Box<dyn Fn(f64) -> f64>,
    ) -> Result<Heater, Error> {
        let (sensor, output) = (config.oid()?, config.oid()?);
        let off = u8::from(wiring.invert);
        config.add(format!("config_analog_in oid={sensor} pin={}", wiring.sensor_pin));
        config.add(format!(
            "config_digital_out oid={output} pin={} value={off} default_value={off} \
             max_duration={}",
            wiring.heater_pin,
            client.ticks(MAX_DURATION_S)
        ));
        config.add(format!("set_digital_out_pwm_cycle oid={output} cycle_ticks={}", client.ticks(CYCLE_S)));
        Ok(Heater { sensor, output, wiring, celsius, last: None })
    }

    /// Heats until the goal is reached and held. Then it switches off and returns the last reading. Fails if the goal
    /// is not reached in time.
    pub fn heat(&mut self, client: &mut Client, goal: Goal, seen: &mut dyn FnMut(Reading)) -> Result<Reading, Error> {
        self.query(client, SAMPLES)?;
        let result = self.pursue(client, goal, seen);
        // After a shutdown the output is off, and the error to return is the shutdown's.
        if client.check().is_ok() {
            self.set(client, 0.0)?;
            self.query(client, 0)?;
            client.link().settle()?;
        }
        result
    }

    fn pursue(&mut self, client: &mut Client, goal: Goal, seen: &mut dyn FnMut(Reading)) -> Result<Reading, Error> {
        let until = Instant::now() + seconds(goal.timeout_s);
        let mut control = Control::default();
        let mut there_since: Option<Clock> = None;
        loop {
            let (clock, celsius) = self.read(client)?;
            let power = control.power(goal.target_c - celsius, REPORT_S);
            self.set(client, power)?;
            let reading = Reading { clock, celsius, power };
            seen(reading);
            if (celsius - goal.target_c).abs() <= goal.tolerance_c {
                let since = *there_since.get_or_insert(clock);
                if clock.since(since) as f64 >= goal.hold_s * client.frequency_hz() {
                    return Ok(reading);
                }
            } else {
                there_since = None;
            }
            if Instant::now() >= until {
                return Err(Error::Plan {
                    subject: self.wiring.heater_pin.clone(),
                    why: format!(
                        "{celsius:.1} °C after {:.0} s instead of {:.1} °C; check heater and \
                         sensor, or give it more time",
                        goal.timeout_s, goal.target_c
                    ),
                });
            }
        }
    }

    /// Starts readings, or stops them with no samples.
    fn query(&self, client: &mut Client, samples: u8) -> Result<(), Error> {
        let full = client.constant("ADC_MAX")? * f64::from(SAMPLES);
        let limit = |celsius: f64| self.fraction(celsius) * full;
        let mut args = vec![
            ("oid", self.sensor.into()),
            ("clock", client.clock_in(LEAD_S)?.into()),
            ("sample_ticks", client.ticks(SAMPLE_S).into()),
            ("sample_count", samples.into()),
            ("rest_ticks", client.ticks(REPORT_S).into()),
            ("min_value", (limit(self.wiring.max_c).floor() as i64).into()),
            ("max_value", (limit(self.wiring.min_c).ceil() as i64).into()),
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
            waiting_for: format!("reading of {}", self.wiring.sensor_pin),
            after: READING_TIMEOUT,
        })?;
        let full = client.constant("ADC_MAX")? * f64::from(SAMPLES);
        let celsius = (self.celsius)(value(&state)? / full);
        let next = client.widen(state.u32("next_clock")?);
        let clock = next.displaced(client.ticks(REPORT_S).wrapping_neg());
        Ok((clock, celsius))
    }

    fn set(&mut self, client: &mut Client, power: f64) -> Result<(), Error> {
        let cycle = client.ticks(CYCLE_S);
        let part = if self.wiring.invert { 1.0 - power } else { power };
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

    /// The reading at a temperature, as a part of the full scale, by bisection.
    fn fraction(&self, celsius: f64) -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..32 {
            let middle = (low + high) / 2.0;
            if (self.celsius)(middle) > celsius {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
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

fn seconds(span: f64) -> Duration {
    Duration::try_from_secs_f64(span).unwrap_or(Duration::MAX / 4)
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
