// SPDX-License-Identifier: GPL-3.0-or-later
//! An ADC's reading of a temperature: a thermistor's divider, or any other circuit by its curve.

use pinion_firmware::board::ADC_MAX;

use super::thermistor::Thermistor;

/// A sensor at an ADC.
#[derive(Clone, Debug)]
pub(crate) enum Sensor {
    Thermistor(Thermistor),
    /// Temperatures, rising, each with a fraction of the ADC's reference. It is linear between them.
    Curve(Vec<(f64, f64)>),
}

impl Sensor {
    /// The sensor of a curve. `None` if it has fewer than two points.
    pub(crate) fn of_curve(points: &[(f64, f64)]) -> Option<Sensor> {
        let mut points = points.to_vec();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        (points.len() >= 2).then_some(Sensor::Curve(points))
    }

    /// The ADC's reading at a temperature, with `noise_counts` added.
    pub(crate) fn counts(&self, celsius: f64, noise_counts: f64) -> u16 {
        let points = match self {
            Sensor::Thermistor(thermistor) => return thermistor.counts(celsius, noise_counts),
            Sensor::Curve(points) => points,
        };
        let max = f64::from(ADC_MAX);
        // The first and the last two points also say what comes before and behind them.
        let above = points.iter().position(|(at, _)| *at > celsius).unwrap_or(points.len());
        let above = above.clamp(1, points.len() - 1);
        let ((t0, f0), (t1, f1)) = (points[above - 1], points[above]);
        let fraction = if t1 > t0 { f0 + (celsius - t0) / (t1 - t0) * (f1 - f0) } else { f0 };
        // The clamp keeps the value in the range of a u16, so the cast loses nothing.
        (fraction * max + noise_counts).round().clamp(0.0, max) as u16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_linear_between_its_points_and_goes_on_behind_them() {
        let sensor = Sensor::of_curve(&[(100.0, 0.5), (0.0, 0.1), (200.0, 0.6)]).unwrap();
        let read = |celsius| f64::from(sensor.counts(celsius, 0.0)) / f64::from(ADC_MAX);
        for (celsius, fraction) in [(0.0, 0.1), (50.0, 0.3), (150.0, 0.55), (300.0, 0.7), (-20.0, 0.02), (-100.0, 0.0)]
        {
            assert!((read(celsius) - fraction).abs() < 2e-4, "{celsius}: {}", read(celsius));
        }
        assert_eq!(sensor.counts(100.0, 3.0) - sensor.counts(100.0, 0.0), 3);
        assert!(Sensor::of_curve(&[(0.0, 0.5)]).is_none());
    }
}
