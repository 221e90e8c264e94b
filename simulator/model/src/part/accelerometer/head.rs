// SPDX-License-Identifier: GPL-3.0-or-later
//! The head that an accelerometer sits on, at the pace of the chip's clock, and the chip's FIFO.
//!
//! Each axis of the chip feels a mass on a spring. A motor moves the other end of the spring step by step:
//! `x'' = w^2 (u - x) - 2 d w x'` with the motor's position `u`, the resonance `w` as an angular frequency and the
//! damping ratio `d`. Between two steps `u` is constant, so the solution is exact. A sample is the mean acceleration
//! since the sample before, which is the difference of two speeds. This simulates the chip's own low-pass. Without it
//! the steps, far above the sampling rate, would appear as beats.

use std::collections::VecDeque;
use std::sync::Arc;

use super::AccelerometerConfig;
use crate::engine::noise::Noise;
use crate::engine::ring::Ring;
use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

/// The first sample comes this time and one period after the start of the measurement.
pub(super) const TURN_ON_S: f64 = 0.0011;
/// The noise of the z axis is this many times the noise of the others (ADXL345: 1.1 to 0.75 LSB).
const Z_NOISE: f64 = 1.1 / 0.75;
/// The rate at which the noise is specified. It grows with the square root of the bandwidth.
const NOISE_RATE_HZ: f64 = 100.0;
/// LSB of the configured noise.
const NOISE_LSB_PER_G: f64 = 256.0;
pub(super) const G_MM_PER_S2: f64 = 9806.65;

/// How long after a step the chip feels it. A computer is rarely as late. So the chip feels a step as if it had come at
/// its due time.
pub(super) const DELAY_TICKS: u64 = Ticks::from_ms(100).0 as u64;

/// The chip's clock.
struct Sampling {
    /// When the first period began.
    start: Clock,
    /// Without its error.
    rate_hz: f64,
    period_ticks: f64,
    /// Number of samples taken.
    taken: u64,
}

impl Sampling {
    fn instant(&self, sample: u64) -> Clock {
        // A few years at most, far below 2^53 ticks.
        Clock::from_ticks(self.start.ticks() + (sample as f64 * self.period_ticks) as u64)
    }
}

/// The samples that nobody has read, the oldest first.
pub(super) struct Fifo {
    pub(super) samples: VecDeque<[i16; 3]>,
    /// The last sample that was read.
    pub(super) shown: [i16; 3],
    /// A sample was lost.
    pub(super) overrun: bool,
    /// Bytes of the oldest sample that were read, in a chip that gives its FIFO byte by byte.
    taken: usize,
}

/// Bytes of a sample.
pub(super) const SAMPLE: usize = 6;

impl Fifo {
    pub(super) fn new(room: usize) -> Fifo {
        Fifo { samples: VecDeque::with_capacity(room), shown: [0; 3], overrun: false, taken: 0 }
    }

    pub(super) fn clear(&mut self) {
        self.samples.clear();
        self.overrun = false;
        self.taken = 0;
    }

    /// Bytes that nobody has read.
    pub(super) fn bytes(&self) -> u16 {
        (self.samples.len() * SAMPLE - self.taken) as u16
    }

    /// The next byte. `halves` is the order of a value's two bytes. An empty FIFO repeats the last sample's first one.
    pub(super) fn next_byte(&mut self, halves: fn(i16) -> [u8; 2]) -> u8 {
        let byte = halves(self.front()[self.taken / 2])[self.taken % 2];
        if !self.samples.is_empty() {
            self.taken = (self.taken + 1) % SAMPLE;
            if self.taken == 0 {
                self.pop();
            }
        }
        byte
    }

    /// The sample that a host reads now.
    pub(super) fn front(&self) -> [i16; 3] {
        self.samples.front().copied().unwrap_or(self.shown)
    }

    /// The oldest sample has been read.
    pub(super) fn pop(&mut self) {
        if let Some(sample) = self.samples.pop_front() {
            self.shown = sample;
            self.overrun = false;
        }
    }
}

/// How many samples fit, and what becomes of the next one.
#[derive(Clone, Copy)]
pub(super) struct Room {
    pub(super) samples: usize,
    /// It replaces the oldest. Otherwise it is lost.
    pub(super) replaces: bool,
}

/// The acceleration at the chip.
pub(super) struct Head {
    clock: Arc<dyn TimeSource>,
    rings: [Option<Ring>; 3],
    noise: Noise,
    pub(super) noise_lsb: f64,
    rate_off: f64,
    sampling: Option<Sampling>,
    /// The speeds at the previous sample.
    speeds: [f64; 3],
}

impl Head {
    pub(super) fn new(
        config: &AccelerometerConfig,
        rings: [Option<Ring>; 3],
        noise: Noise,
        clock: Arc<dyn TimeSource>,
    ) -> Head {
        Head {
            clock,
            rings,
            noise,
            noise_lsb: config.noise_lsb,
            rate_off: 1.0 + config.rate_off_percent / 100.0,
            sampling: None,
            speeds: [0.0; 3],
        }
    }

    /// Measures from now on, at this rate; `None` stops it.
    pub(super) fn measure(&mut self, rate_hz: Option<f64>) {
        let ticks = f64::from(CLOCK_FREQ);
        let start = Clock::from_ticks(self.clock.now().ticks() + (TURN_ON_S * ticks) as u64);
        self.sampling = rate_hz.map(|rate_hz| Sampling {
            start,
            rate_hz,
            period_ticks: ticks / (rate_hz * self.rate_off),
            taken: 0,
        });
        self.feel(start);
    }

    /// The speeds at an instant.
    fn feel(&mut self, at: Clock) {
        let felt = Clock::from_ticks(at.ticks().saturating_sub(DELAY_TICKS));
        for (speed, ring) in self.speeds.iter_mut().zip(&mut self.rings) {
            *speed = ring.as_mut().map_or(0.0, |ring| ring.speed_at(felt));
        }
    }

    /// Takes the samples that have become due. `digitize` makes a register's values of an acceleration in g.
    pub(super) fn catch_up(&mut self, fifo: &mut Fifo, room: Room, digitize: impl Fn([f64; 3]) -> [i16; 3]) {
        let now = self.clock.now();
        let Some(mut sampling) = self.sampling.take() else { return };
        let elapsed = now.since(sampling.start).max(0) as f64;
        let due = (elapsed / sampling.period_ticks) as u64;
        if due - sampling.taken > 2 * room.samples as u64 && room.replaces {
            // Skip the samples that the host will never read.
            sampling.taken = due - room.samples as u64 - 1;
            fifo.overrun = true;
            self.feel(sampling.instant(sampling.taken));
        }
        while sampling.taken < due {
            sampling.taken += 1;
            let before = self.speeds;
            self.feel(sampling.instant(sampling.taken));
            let g = self.acceleration_g(before, &sampling);
            if fifo.samples.len() >= room.samples {
                fifo.overrun = true;
                if !room.replaces {
                    // The later samples do not fit either.
                    sampling.taken = due;
                    self.feel(sampling.instant(due));
                    break;
                }
                fifo.samples.pop_front();
                fifo.taken = 0;
            }
            fifo.samples.push_back(digitize(g));
        }
        self.sampling = Some(sampling);
    }

    /// The mean acceleration of a period, with gravity and noise.
    fn acceleration_g(&mut self, before: [f64; 3], sampling: &Sampling) -> [f64; 3] {
        let seconds = sampling.period_ticks / f64::from(CLOCK_FREQ);
        let noise_g = self.noise_lsb / NOISE_LSB_PER_G * (sampling.rate_hz / NOISE_RATE_HZ).sqrt();
        [0, 1, 2].map(|i| {
            let (gravity, share) = if i == 2 { (1.0, Z_NOISE) } else { (0.0, 1.0) };
            gravity + (self.speeds[i] - before[i]) / seconds / G_MM_PER_S2 + noise_g * share * self.noise.draw()
        })
    }
}

/// The value of a register for an acceleration, at a resolution of this many of its 16 bits.
pub(super) fn value(lsb: f64, bits: u32) -> i16 {
    (lsb.round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16) & (u16::MAX << (16 - bits)) as i16
}
