// SPDX-License-Identifier: GPL-3.0-or-later
//! The noise of sensors.

/// Noise with a normal distribution. The same seed gives the same noise.
#[derive(Clone, Debug)]
pub struct Noise(u64);

impl Noise {
    /// SplitMix64 adds this for each draw.
    const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

    /// The noise of one part or pin. With the same seed each part has different noise.
    pub fn of(whose: &str, seed: u64) -> Noise {
        whose.bytes().fold(Noise(seed), |noise, byte| Noise((noise.0 ^ u64::from(byte)).wrapping_mul(Noise::STEP)))
    }

    /// The draw with this number, for a caller that keeps no noise between two draws.
    pub fn nth(&self, draw: u64) -> f64 {
        Noise(self.0.wrapping_add(draw.wrapping_mul(Noise::STEP))).draw()
    }

    /// A draw with mean 0 and standard deviation 1: the sum of four uniform draws. It is within 3.5 and close to
    /// normal. The bits come from SplitMix64 (Steele, Lea, Flood, 2014).
    pub fn draw(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(Noise::STEP);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^= bits >> 31;
        let sum: u64 = (0..4).map(|quarter| (bits >> (16 * quarter)) & 0xffff).sum();
        // Each uniform draw has variance 1/12, and their sum has 1/3.
        (sum as f64 / 65_536.0 - 2.0) * 3f64.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_normal_and_the_same_each_time() {
        let draws = |whose, seed| {
            let mut noise = Noise::of(whose, seed);
            (0..100_000).map(|_| noise.draw()).collect::<Vec<f64>>()
        };
        let first = draws("cell", 7);
        assert_eq!(first, draws("cell", 7));
        assert!([draws("cell", 8), draws("coil", 7)].iter().all(|other| other[0] != first[0] && other[1] != first[1]));
        assert_eq!(Noise::of("cell", 7).nth(41), first[41]);
        let mean = first.iter().sum::<f64>() / first.len() as f64;
        let variance = first.iter().map(|x| x * x).sum::<f64>() / first.len() as f64;
        assert!(mean.abs() < 0.02, "{mean}");
        assert!((variance - 1.0).abs() < 0.02, "{variance}");
    }
}
