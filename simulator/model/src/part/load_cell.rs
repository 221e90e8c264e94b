// SPDX-License-Identifier: GPL-3.0-or-later
//! A load cell under the hot end. It bends when the nozzle presses into the bed, or when a weight hangs on it. The
//! chips that measure it are separate parts.

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Bound, Trouble, check};
use crate::engine::bed::Bed;
use crate::engine::noise::Noise;
use crate::klippy::sections::Sections;

/// The cell's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellConfig {
    /// The force for each millimeter that the nozzle is below the bed's surface.
    pub stiffness_g_per_mm: f64,
    /// The chip's counts per gram.
    pub counts_per_gram: f64,
    /// The chip's counts without any force.
    #[serde(default)]
    pub zero_counts: f64,
    /// A weight that hangs on it.
    #[serde(default)]
    pub weight_g: f64,
    /// Standard deviation of a reading.
    #[serde(default)]
    pub noise_counts: f64,
}

impl CellConfig {
    /// Checks the values.
    pub(crate) fn validate(&self, whose: &str) -> Result<(), Trouble> {
        for (key, value, bound) in [
            ("stiffness_g_per_mm", self.stiffness_g_per_mm, Bound::AboveZero),
            ("counts_per_gram", self.counts_per_gram, Bound::AboveZero),
            ("zero_counts", self.zero_counts, Bound::Any),
            ("weight_g", self.weight_g, Bound::Any),
            ("noise_counts", self.noise_counts, Bound::NotNegative),
        ] {
            check(whose, key, value, bound)?;
        }
        Ok(())
    }

    /// The keys of a section with a calibrated cell.
    pub(crate) fn calibration(&self, cfg: &mut Sections) {
        cfg.key("counts_per_gram", self.counts_per_gram);
        let tare = self.zero_counts + self.weight_g * self.counts_per_gram;
        cfg.key("reference_tare_counts", tare.round());
    }
}

pub(crate) struct Cell {
    config: CellConfig,
    bed: Bed,
    noise: Noise,
}

impl Cell {
    /// The cell of a chip.
    pub(crate) fn new(config: &CellConfig, workshop: &Workshop<'_>, chip: &dyn Part) -> Cell {
        Cell { config: config.clone(), bed: workshop.bed(), noise: workshop.noise(chip) }
    }

    #[cfg(test)]
    pub(crate) fn over(config: CellConfig, bed: Bed) -> Cell {
        Cell { config, bed, noise: Noise::of("cell", 0) }
    }

    /// The present load.
    fn grams(&self) -> f64 {
        let depth_mm = (-self.bed.clearance_mm([0.0; 3])).max(0.0);
        self.config.weight_g + self.config.stiffness_g_per_mm * depth_mm
    }

    /// The reading with this number from a 24-bit chip. `gain` is relative to the gain in the description.
    pub(crate) fn counts(&self, gain: f64, reading: u64) -> i32 {
        const MAX: f64 = 0x7f_ffff as f64;
        let noise = self.noise.nth(reading) * self.config.noise_counts;
        let signal = self.config.zero_counts + self.config.counts_per_gram * self.grams();
        // A chip beyond its range stays at the limit.
        (signal * gain + noise).round().clamp(-MAX - 1.0, MAX) as i32
    }
}
