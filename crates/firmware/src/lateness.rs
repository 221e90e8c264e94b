// SPDX-License-Identifier: GPL-3.0-or-later
//! Distributions of delays. Recording a sample does not allocate.

use std::fmt;

use crate::time::{CLOCK_FREQ, Ticks};

/// Number of buckets in each octave (from a power of two to the next). So a bucket is at most as wide as an eighth of
/// its values.
const PARTS: usize = 8;
/// Enough buckets for 2^32 ticks (86 s), and as many as a byte has values. Longer delays count as 2^32 ticks.
const BUCKETS: usize = 256;

/// Counts samples by how late they were.
#[derive(Clone, Debug)]
pub struct Lateness {
    counts: [u64; BUCKETS],
    max: u32,
}

impl Default for Lateness {
    fn default() -> Lateness {
        Lateness { counts: [0; BUCKETS], max: 0 }
    }
}

/// The bucket of a value in ticks. Values below 16 have a bucket each. Larger values share the eight buckets of their
/// octave.
fn bucket(late: u32) -> u8 {
    let octave = (late | PARTS as u32).ilog2() - PARTS.ilog2();
    // The highest is 239.
    (octave * PARTS as u32 + (late >> octave)) as u8
}

/// The largest value of a bucket.
fn upper(bucket: usize) -> u32 {
    if bucket < PARTS {
        return bucket as u32;
    }
    let octave = bucket / PARTS - 1;
    let next = ((bucket % PARTS + PARTS + 1) as u64) << octave;
    u32::try_from(next - 1).unwrap_or(u32::MAX)
}

impl Lateness {
    /// Records a sample.
    #[inline]
    pub fn record(&mut self, late: Ticks) {
        self.count(late);
        self.note_longest(late);
    }

    /// Records a sample that is not the longest one.
    #[inline]
    pub(crate) fn count(&mut self, Ticks(late): Ticks) {
        self.counts[usize::from(bucket(late))] += 1;
    }

    /// A sample that was counted may be the longest one.
    #[inline]
    pub(crate) fn note_longest(&mut self, Ticks(late): Ticks) {
        self.max = self.max.max(late);
    }

    /// How many samples there are.
    pub fn samples(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// The longest delay.
    pub fn max(&self) -> Ticks {
        Ticks(self.max)
    }

    /// The longest delay of the best share `q` (0 to 1) of the samples. It is up to an eighth too high, because it is
    /// the upper end of a bucket.
    pub fn quantile(&self, q: f64) -> Ticks {
        let wanted = (q * self.samples() as f64).ceil() as u64;
        let mut seen = 0;
        for (bucket, count) in self.counts.iter().enumerate() {
            seen += count;
            if seen >= wanted && *count > 0 {
                return Ticks(upper(bucket).min(self.max));
            }
        }
        self.max()
    }

    /// The buckets with samples: the largest value of each, and its number of samples.
    pub fn buckets(&self) -> impl Iterator<Item = (Ticks, u64)> + '_ {
        let filled = self.counts.iter().enumerate().filter(|(_, count)| **count > 0);
        filled.map(|(bucket, count)| (Ticks(upper(bucket)), *count))
    }
}

/// Ticks as microseconds.
pub fn us(ticks: Ticks) -> f64 {
    f64::from(ticks.0) * 1e6 / f64::from(CLOCK_FREQ)
}

impl fmt::Display for Lateness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let samples = self.samples();
        if samples == 0 {
            return f.write_str("no events");
        }
        let q = |q| us(self.quantile(q));
        write!(
            f,
            "{samples} events, late by p50 {:.2} us, p99 {:.2} us, p99.9 {:.2} us, at most {:.2} us",
            q(0.5),
            q(0.99),
            q(0.999),
            us(self.max())
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_bucket_holds_what_is_put_in_it_and_is_narrow(late: u32) {
            let bucket = usize::from(bucket(late));
            prop_assert!(bucket < BUCKETS);
            prop_assert!(upper(bucket) >= late);
            prop_assert!(bucket == 0 || upper(bucket - 1) < late);
            prop_assert!(u64::from(upper(bucket)) <= u64::from(late) + u64::from(late) / 8);
        }
    }

    #[test]
    fn quantiles_of_a_known_distribution() {
        let mut lateness = Lateness::default();
        for late in 0..1000 {
            lateness.record(Ticks(late));
        }
        lateness.record(Ticks(0));
        for (q, exact) in [(0.5, 500.0), (0.99, 990.0), (0.1, 100.0)] {
            let got = f64::from(lateness.quantile(q).0);
            assert!((exact - 1.0..exact * 1.125 + 1.0).contains(&got), "{q}: {got}");
        }
        assert_eq!((lateness.samples(), lateness.max()), (1001, Ticks(999)));
    }

    #[test]
    fn nothing_is_said_of_how_late_nothing_was() {
        let mut lateness = Lateness::default();
        assert_eq!(lateness.to_string(), "no events");
        lateness.record(Ticks(50));
        assert!(lateness.to_string().starts_with("1 events, late by p50 1.00 us"), "{lateness}");
    }
}
