// SPDX-License-Identifier: GPL-3.0-or-later
//! Random numbers from a seed, for tests that can be repeated.

/// A small generator of numbers, with the same sequence for the same seed.
pub struct Dice(pub u64);

impl Dice {
    /// The next number.
    pub fn roll(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as u32
    }

    /// A number from 0 up to `end`, without `end`.
    pub fn below(&mut self, end: usize) -> usize {
        self.roll() as usize % end.max(1)
    }

    /// One of these values.
    pub fn of<T: Clone>(&mut self, values: &[T]) -> T {
        values[self.below(values.len())].clone()
    }
}
