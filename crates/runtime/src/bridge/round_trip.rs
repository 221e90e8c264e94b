// SPDX-License-Identifier: GPL-3.0-or-later
//! How long a block of the host takes to its acknowledgement: the round trip of the connection, and the MCU's time for
//! the block.

use std::collections::VecDeque;
use std::fmt;
use std::time::Duration;

use pinion_firmware::lateness::{Lateness, us};
use pinion_firmware::time::{CLOCK_FREQ, Ticks};
use pinion_protocol::block::{Resync, Resynced, Sequence};

/// Highest number of blocks without an acknowledgement. The host sends at most 12.
const UNACKNOWLEDGED_MAX: usize = 15;

/// Watches the blocks in both directions.
#[derive(Default)]
pub(super) struct RoundTrips {
    to_mcu: Blocks,
    from_mcu: Blocks,
    /// Blocks without an acknowledgement, and when they were sent.
    sent: VecDeque<(Sequence, Duration)>,
    times: Lateness,
}

impl RoundTrips {
    /// The host has sent these bytes.
    pub(super) fn sent(&mut self, bytes: &[u8], now: Duration) {
        let RoundTrips { to_mcu, sent, .. } = self;
        to_mcu.find(bytes, |sequence| {
            // A block that is sent again does not count: the acknowledgement may belong to the first copy.
            if sent.len() == UNACKNOWLEDGED_MAX || sent.iter().any(|(earlier, _)| *earlier == sequence) {
                sent.clear();
            } else {
                sent.push_back((sequence, now));
            }
        });
    }

    /// The MCU has sent these bytes.
    pub(super) fn received(&mut self, bytes: &[u8], now: Duration) {
        let RoundTrips { from_mcu, sent, times, .. } = self;
        from_mcu.find(bytes, |expected| {
            let Some(last) = sent.iter().position(|(sequence, _)| sequence.next() == expected) else { return };
            if let Some((_, at)) = sent.drain(..=last).next_back() {
                let ticks = now.saturating_sub(at).as_secs_f64() * f64::from(CLOCK_FREQ);
                times.record(Ticks(ticks as u32));
            }
        });
    }

    /// The times since the last call.
    pub(super) fn take(&mut self) -> Times {
        Times(std::mem::take(&mut self.times))
    }
}

/// Finds blocks in a stream that comes in pieces.
#[derive(Default)]
struct Blocks {
    resync: Resync,
    kept: Vec<u8>,
}

impl Blocks {
    fn find(&mut self, bytes: &[u8], mut found: impl FnMut(Sequence)) {
        self.kept.extend_from_slice(bytes);
        let mut taken = 0;
        loop {
            let (bytes, next) = self.resync.next(&self.kept[taken..]);
            match next {
                Resynced::Nothing => break,
                Resynced::Block(sequence, _) => found(sequence),
                Resynced::Garbage { .. } => {}
            }
            taken += bytes;
        }
        self.kept.drain(..taken);
    }
}

/// Round trips.
pub(super) struct Times(Lateness);

impl Times {
    pub(super) fn is_empty(&self) -> bool {
        self.0.samples() == 0
    }
}

impl fmt::Display for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Times(times) = self;
        let ms = |ticks| us(ticks) / 1000.0;
        let [half, most] = [0.5, 0.99].map(|share| ms(times.quantile(share)));
        let longest = ms(times.max());
        let jitter = most - half;
        write!(
            f,
            "{half:.1} ms for half of {} blocks, {most:.1} ms for 99 % (jitter {jitter:.1} ms), {longest:.1} ms at most",
            times.samples()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_protocol::block::{BLOCK_MAX, frame};

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn block(payload: &[u8], number: u32) -> Vec<u8> {
        let mut bytes = Vec::new();
        frame(payload, Sequence::after(number), &mut bytes);
        bytes
    }

    #[test]
    fn a_round_trip_ends_with_the_acknowledgement_of_its_block() {
        let mut trips = RoundTrips::default();
        trips.sent(&block(b"first", 0), ms(0));
        let second = block(b"second", 1);
        trips.sent(&second[..4], ms(1));
        trips.sent(&second[4..], ms(2));
        trips.sent(&[super::super::SYNC], ms(3));
        assert!(trips.take().is_empty());
        // It acknowledges both. The later one counts.
        trips.received(&block(b"answer", 2), ms(7));
        let text = trips.take().to_string();
        assert_eq!(text, "5.0 ms for half of 1 blocks, 5.0 ms for 99 % (jitter 0.0 ms), 5.0 ms at most");
        assert!(trips.take().is_empty());
    }

    #[test]
    fn a_block_that_is_sent_again_counts_for_nothing() {
        let mut trips = RoundTrips::default();
        for at in [0, 100] {
            trips.sent(&block(b"again", 5), ms(at));
        }
        trips.received(&block(&[], 6), ms(101));
        assert!(trips.take().is_empty());
        // The next one counts again, though a refusal comes first.
        trips.sent(&block(b"next", 6), ms(200));
        trips.received(&block(&[], 6), ms(210));
        trips.received(&block(&[], 7), ms(220));
        assert!(trips.take().to_string().starts_with("20.0 ms for half of 1 blocks"));
    }

    #[test]
    fn garbage_is_not_kept() {
        let mut trips = RoundTrips::default();
        for _ in 0..100 {
            trips.received(&[0xff; 4096], ms(0));
        }
        assert!(trips.from_mcu.kept.len() < BLOCK_MAX);
    }
}
