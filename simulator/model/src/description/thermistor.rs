// SPDX-License-Identifier: GPL-3.0-or-later
//! A thermistor below a pull-up resistor, read by a 12-bit ADC.
//!
//! The equations are klippy's (`klippy/extras/thermistor.py`), so the host reads back the simulated temperature:
//!
//! - Steinhart and Hart, 1968: `1/T = c1 + c2 ln R + c3 (ln R)^3`; a beta means `c3 = 0`, `c2 = 1/beta`
//! - its inverse by Cardano's formula
//! - the divider: `R / (pull-up + R)` of the reference

use pinion_firmware::board::ADC_MAX;

/// 0 °C in kelvin.
pub(crate) const KELVIN: f64 = 273.15;
/// Highest temperature of a reading. A short circuit counts as this hot.
const HOTTEST_KELVIN: f64 = 1000.0;

/// The coefficients of a thermistor, and its pull-up resistor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Thermistor {
    c1: f64,
    c2: f64,
    c3: f64,
    pullup_ohm: f64,
}

/// Why points and a beta do not describe a thermistor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoThermistor {
    /// A point is at or below 0 K or 0 ohm, or not a finite number.
    PointOutOfRange,
    /// The beta is at or below 0 K, or not a finite number.
    BetaOutOfRange,
    /// One point without a beta.
    BetaMissing,
    /// A beta with any number of points except one.
    PointsBesideBeta,
    /// No beta, and any number of points except three.
    PointCount,
    /// No thermistor's curve passes through these three points.
    PointsOnNoCurve,
}

impl Thermistor {
    /// A thermistor from its resistance at three temperatures, or at one temperature with its beta.
    ///
    /// `points_celsius_ohm` are pairs of a temperature in °C and a resistance in ohm; `beta_k` is in
    /// kelvin.
    ///
    /// # Errors
    ///
    /// No thermistor has these values.
    pub fn new(
        points_celsius_ohm: &[(f64, f64)],
        beta_k: Option<f64>,
        pullup_ohm: f64,
    ) -> Result<Thermistor, NoThermistor> {
        let sound =
            |&(celsius, ohm): &(f64, f64)| celsius > -KELVIN && celsius.is_finite() && ohm > 0.0 && ohm.is_finite();
        if !points_celsius_ohm.iter().all(sound) {
            return Err(NoThermistor::PointOutOfRange);
        }
        let inverse = |celsius: f64| 1.0 / (celsius + KELVIN);
        match (points_celsius_ohm, beta_k) {
            (&[(celsius, ohm)], Some(beta_k)) => {
                if !(beta_k > 0.0 && beta_k.is_finite()) {
                    return Err(NoThermistor::BetaOutOfRange);
                }
                let c2 = 1.0 / beta_k;
                Ok(Thermistor { c1: inverse(celsius) - c2 * ohm.ln(), c2, c3: 0.0, pullup_ohm })
            }
            (&[_], None) => Err(NoThermistor::BetaMissing),
            (&[(t1, r1), (t2, r2), (t3, r3)], None) => {
                let (y1, y2, y3) = (inverse(t1), inverse(t2), inverse(t3));
                let (l1, l2, l3) = (r1.ln(), r2.ln(), r3.ln());
                let (l12, l13) = (l1 - l2, l1 - l3);
                let (cube12, cube13) = (l1.powi(3) - l2.powi(3), l1.powi(3) - l3.powi(3));
                let ratio = l12 / l13;
                let c3 = (y1 - y2 - (y1 - y3) * ratio) / (cube12 - cube13 * ratio);
                let c2 = (y1 - y2 - c3 * cube12) / l12;
                if !(c3 > 0.0 && c3.is_finite() && c2 > 0.0 && c2.is_finite()) {
                    return Err(NoThermistor::PointsOnNoCurve);
                }
                Ok(Thermistor { c1: y1 - c2 * l1 - c3 * l1.powi(3), c2, c3, pullup_ohm })
            }
            (_, Some(_)) => Err(NoThermistor::PointsBesideBeta),
            (_, None) => Err(NoThermistor::PointCount),
        }
    }

    fn ln_ohm(&self, celsius: f64) -> f64 {
        let inverse = 1.0 / (celsius + KELVIN);
        if self.c3 > 0.0 {
            let y = (self.c1 - inverse) / (2.0 * self.c3);
            let x = ((self.c2 / (3.0 * self.c3)).powi(3) + y * y).sqrt();
            (x - y).cbrt() - (x + y).cbrt()
        } else {
            (inverse - self.c1) / self.c2
        }
    }

    /// Its resistance.
    pub fn ohm(&self, celsius: f64) -> f64 {
        self.ln_ohm(celsius).exp()
    }

    /// The voltage at the ADC as a fraction of its reference.
    pub fn fraction(&self, celsius: f64) -> f64 {
        // The logistic function of ln(R / pull-up): R / (pull-up + R) without an overflow.
        1.0 / (1.0 + (self.pullup_ohm.ln() - self.ln_ohm(celsius)).exp())
    }

    /// The temperature in °C at which the ADC reads this fraction of its reference.
    pub fn celsius(&self, fraction: f64) -> f64 {
        let fraction = fraction.clamp(0.000_01, 0.999_99);
        let ln_ohm = (self.pullup_ohm * fraction / (1.0 - fraction)).ln();
        let inverse = self.c1 + self.c2 * ln_ohm + self.c3 * ln_ohm.powi(3);
        // Without the limit a short circuit would give a negative inverse.
        1.0 / inverse.max(1.0 / HOTTEST_KELVIN) - KELVIN
    }

    /// The ADC's reading at a temperature: 0 to [`ADC_MAX`] counts, with `noise_counts` added.
    pub(crate) fn counts(&self, celsius: f64, noise_counts: f64) -> u16 {
        let max = f64::from(ADC_MAX);
        // The clamp keeps the value in the range of a u16, so the cast loses nothing.
        (self.fraction(celsius) * max + noise_counts).round().clamp(0.0, max) as u16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// klippy's `calc_temp`, for the conversion back.
    fn calc_temp(thermistor: &Thermistor, counts: f64) -> f64 {
        let adc = counts / f64::from(ADC_MAX);
        let ln_r = (thermistor.pullup_ohm * adc / (1.0 - adc)).ln();
        let inv_t = thermistor.c1 + thermistor.c2 * ln_r + thermistor.c3 * ln_r.powi(3);
        1.0 / inv_t - KELVIN
    }

    /// A hot end's thermistor, defined by three points.
    const HOT_END: &[(f64, f64)] = &[(25.0, 100_000.0), (150.0, 1641.9), (250.0, 226.15)];
    /// A bed's thermistor, defined by one point and this beta.
    const BED: &[(f64, f64)] = &[(25.0, 100_000.0)];
    const BED_BETA_K: f64 = 3950.0;
    const PULLUP_OHM: f64 = 4700.0;

    fn thermistors() -> [Thermistor; 2] {
        [(HOT_END, None), (BED, Some(BED_BETA_K))]
            .map(|(points, beta_k)| Thermistor::new(points, beta_k, PULLUP_OHM).unwrap())
    }

    #[test]
    fn the_points_lie_on_the_curve() {
        for (points, thermistor) in [HOT_END, BED].into_iter().zip(thermistors()) {
            for (celsius, ohm) in points {
                let expected = ohm / (PULLUP_OHM + ohm);
                assert!((thermistor.fraction(*celsius) - expected).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_reading_stands_for_the_temperature_that_it_was_made_at() {
        for (points, thermistor) in [HOT_END, BED].into_iter().zip(thermistors()) {
            for (celsius, ohm) in points {
                assert!((thermistor.celsius(ohm / (PULLUP_OHM + ohm)) - celsius).abs() < 1e-6);
            }
            let all: Vec<f64> = (0..=1000).map(|i| thermistor.celsius(f64::from(i) / 1000.0)).collect();
            assert!(all.iter().all(|celsius| celsius.is_finite()));
            assert!(all.is_sorted_by(|a, b| a >= b));
        }
    }

    #[test]
    fn klippy_reads_back_the_temperature_to_half_a_kelvin() {
        for (thermistor, max_celsius) in thermistors().into_iter().zip([280.0, 120.0]) {
            let mut celsius = 0.0;
            while celsius <= max_celsius {
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
        for thermistor in thermistors() {
            assert_eq!(thermistor.counts(-273.0, 0.0), ADC_MAX);
            assert_eq!(thermistor.counts(1e9, 0.0).min(100), thermistor.counts(1e9, 0.0));
            assert_eq!(thermistor.counts(25.0, 1e9), ADC_MAX);
            assert_eq!(thermistor.counts(25.0, -1e9), 0);
        }
    }
}
