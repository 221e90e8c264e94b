// SPDX-License-Identifier: GPL-3.0-or-later
//! A thermistor below a pull-up resistor, read by a 12-bit ADC.
//!
//! The equations are klippy's (`klippy/extras/thermistor.py`), so that the host reads back the
//! temperature that was put in:
//!
//! - Steinhart and Hart, 1968: `1/T = c1 + c2 ln R + c3 (ln R)^3`; a beta is `c3 = 0`,
//!   `c2 = 1/beta`
//! - its inverse by Cardano's formula
//! - the divider: `R / (pull-up + R)` of the reference

use super::config::HeaterConfig;

/// The largest count, as the dictionary tells the host (`ADC_MAX`).
pub const ADC_MAX: u16 = 4095;

/// The coefficients of a thermistor, and its pull-up resistor.
#[derive(Clone, Copy, Debug)]
pub struct Thermistor {
    c1: f64,
    c2: f64,
    c3: f64,
    pullup_ohm: f64,
}

/// Key, cause and remedy of coefficients that make no thermistor.
type Fault = (&'static str, &'static str, &'static str);

impl Thermistor {
    /// 0 °C in kelvin.
    pub const KELVIN: f64 = 273.15;

    /// The thermistor of a heater.
    pub fn new(heater: &HeaterConfig) -> Result<Thermistor, Fault> {
        const POINTS: &str = "points_celsius_ohm";
        let pullup_ohm = heater.pullup_ohm;
        let sound = |&(celsius, ohm): &(f64, f64)| {
            celsius > -Thermistor::KELVIN && celsius.is_finite() && ohm > 0.0 && ohm.is_finite()
        };
        if !heater.points_celsius_ohm.iter().all(sound) {
            return Err((POINTS, "kelvins and resistances are above zero", "take the points from the data sheet"));
        }
        let inverse = |celsius: f64| 1.0 / (celsius + Thermistor::KELVIN);
        match (heater.points_celsius_ohm.as_slice(), heater.beta_k) {
            (&[(celsius, ohm)], Some(beta_k)) => {
                if !(beta_k > 0.0 && beta_k.is_finite()) {
                    return Err(("beta_k", "a beta is above zero", "such as 3950.0"));
                }
                let c2 = 1.0 / beta_k;
                Ok(Thermistor { c1: inverse(celsius) - c2 * ohm.ln(), c2, c3: 0.0, pullup_ohm })
            }
            (&[_], None) => Err(("beta_k", "one point needs a beta", "add it, or three points")),
            (&[(t1, r1), (t2, r2), (t3, r3)], None) => {
                let (y1, y2, y3) = (inverse(t1), inverse(t2), inverse(t3));
                let (l1, l2, l3) = (r1.ln(), r2.ln(), r3.ln());
                let (l12, l13) = (l1 - l2, l1 - l3);
                let (cube12, cube13) = (l1.powi(3) - l2.powi(3), l1.powi(3) - l3.powi(3));
                let ratio = l12 / l13;
                let c3 = (y1 - y2 - (y1 - y3) * ratio) / (cube12 - cube13 * ratio);
                let c2 = (y1 - y2 - c3 * cube12) / l12;
                if !(c3 > 0.0 && c3.is_finite() && c2 > 0.0 && c2.is_finite()) {
                    return Err((
                        POINTS,
                        "no thermistor has these three",
                        "take others from the data sheet, or one and `beta_k`",
                    ));
                }
                Ok(Thermistor { c1: y1 - c2 * l1 - c3 * l1.powi(3), c2, c3, pullup_ohm })
            }
            (_, Some(_)) => Err((POINTS, "with `beta_k` there is one point", "keep one")),
            (_, None) => Err((POINTS, "none, two or more than three points", "give three, or one and `beta_k`")),
        }
    }

    /// The voltage at the ADC as a fraction of its reference.
    pub fn fraction(&self, celsius: f64) -> f64 {
        let inverse = 1.0 / (celsius + Thermistor::KELVIN);
        let ln_ohm = if self.c3 > 0.0 {
            let y = (self.c1 - inverse) / (2.0 * self.c3);
            let x = ((self.c2 / (3.0 * self.c3)).powi(3) + y * y).sqrt();
            (x - y).cbrt() - (x + y).cbrt()
        } else {
            (inverse - self.c1) / self.c2
        };
        // The logistic function of ln(R / pull-up): R / (pull-up + R) without an overflow.
        1.0 / (1.0 + (self.pullup_ohm.ln() - ln_ohm).exp())
    }

    /// The count that the ADC tells at a temperature, `noise_counts` off.
    pub fn counts(&self, celsius: f64, noise_counts: f64) -> u16 {
        let max = f64::from(ADC_MAX);
        // A float's `as` saturates; the range makes it exact.
        (self.fraction(celsius) * max + noise_counts).round().clamp(0.0, max) as u16
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::sim::SimConfig;

    /// klippy's `calc_temp`, for the way back.
    fn calc_temp(thermistor: &Thermistor, counts: f64) -> f64 {
        let adc = counts / f64::from(ADC_MAX);
        let ln_r = (thermistor.pullup_ohm * adc / (1.0 - adc)).ln();
        let inv_t = thermistor.c1 + thermistor.c2 * ln_r + thermistor.c3 * ln_r.powi(3);
        1.0 / inv_t - Thermistor::KELVIN
    }

    fn default_thermistors() -> Vec<(HeaterConfig, Thermistor)> {
        let thermistor = |heater: HeaterConfig| {
            let thermistor = Thermistor::new(&heater).unwrap();
            (heater, thermistor)
        };
        let heaters = SimConfig::default_printer().heaters;
        heaters.into_iter().map(thermistor).collect()
    }

    #[test]
    fn the_points_lie_on_the_curve() {
        for (heater, thermistor) in default_thermistors() {
            for (celsius, ohm) in heater.points_celsius_ohm {
                let expected = ohm / (heater.pullup_ohm + ohm);
                assert!((thermistor.fraction(celsius) - expected).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn klippy_reads_back_the_temperature_to_half_a_kelvin() {
        for (heater, thermistor) in default_thermistors() {
            let mut celsius = heater.min_celsius;
            while celsius <= heater.max_celsius {
                let exact = calc_temp(&thermistor, thermistor.fraction(celsius) * 4095.0);
                assert!((exact - celsius).abs() < 1e-6, "{celsius} {exact}");
                let read = calc_temp(&thermistor, thermistor.counts(celsius, 0.0).into());
                assert!((read - celsius).abs() < 0.5, "{celsius} {read}");
                celsius += 0.1;
            }
        }
    }

    #[test]
    fn a_reading_stays_within_the_range_of_the_adc() {
        for (_, thermistor) in default_thermistors() {
            assert_eq!(thermistor.counts(-273.0, 0.0), ADC_MAX);
            assert_eq!(thermistor.counts(1e9, 0.0).min(100), thermistor.counts(1e9, 0.0));
            assert_eq!(thermistor.counts(25.0, 1e9), ADC_MAX);
            assert_eq!(thermistor.counts(25.0, -1e9), 0);
        }
    }
}
