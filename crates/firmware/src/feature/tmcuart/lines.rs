// SPDX-License-Identifier: GPL-3.0-or-later
//! A TMC UART on GPIO lines, bit by bit.
//!
//! The firmware has a timer for each bit. Here an errand times a whole message on a worker. At 40 kbaud a message is up
//! to 5 ms of edges 25 us apart, which would keep the core awake. `benches/bits.rs` measures how late bits are
//! in both cases (docs/develop/performance.md).
//!
//! The firmware samples a reply anywhere within a bit, wherever its timer happens to be. Here the start bit of each
//! byte is found, and bits are read in their middle. So half a bit of lateness does no harm. A start bit that is high
//! again in its middle is a glitch and does not count.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::board::{Bias, Direction, Line};
use crate::feature::pace::Pace;
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::{FRAME_BITS, Message, QUIET, REPLY_BITS, TURN_BITS, bit_of};

/// How often the line is read in each bit while waiting for an edge.
const LOOKS: u32 = 16;
/// How often a register is read if a bit was late. klippy itself asks five times. It cannot know whether the driver or
/// this computer was late.
const TRIES: u32 = 3;
/// A message begins with a start bit and a sync nibble. The driver takes its rate from them.
const SYNC: u8 = 0b10_1010;
const SYNC_MASK: u8 = 0b11_1111;
/// The bits between the first and the last falling edge of these.
const SYNC_BITS: usize = 4;

/// The two ends of the UART, and the time of its bits.
pub(super) struct Lines {
    pub(super) tx: Arc<dyn Line>,
    pub(super) rx: Arc<dyn Line>,
    /// The resistor of a single wire while it listens. `None`: there are two wires.
    pub(super) single: Option<Bias>,
    pub(super) pace: Pace,
    /// The configured length of a bit.
    pub(super) bit: Ticks,
    /// Whether a bit was late enough to be taken for another.
    pub(super) spoilt: bool,
}

impl Lines {
    /// Drives the line high, its level between messages.
    pub(super) fn idle(&self) -> Result<(), Shutdown> {
        match self.single {
            Some(_) => self.tx.turn(Direction::Output { level: true, shutdown_value: true }),
            None => self.tx.write(true),
        }
    }

    fn listen(&self) -> Result<(), Shutdown> {
        self.single.map_or(Ok(()), |bias| self.rx.turn(Direction::Input(bias)))
    }

    /// Sends a message, receives its reply, and leaves the line idle.
    pub(super) fn exchange(&mut self, message: &mut Message) -> Result<(), Shutdown> {
        let exchanged = self.converse(message);
        exchanged.and(self.idle())
    }

    /// Reading a register changes nothing in the driver, so it is retried here. klippy repeats a write, and counts the
    /// writes that arrived.
    fn converse(&mut self, message: &mut Message) -> Result<(), Shutdown> {
        for _ in 0..TRIES {
            self.spoilt = false;
            // The first call is slower than the others. Without this one, the first bit would be longer.
            self.tx.write(true)?;
            let Some((end, bit)) = self.send(message.bits(), self.pace.now())? else { break };
            if message.read_len == 0 {
                break;
            }
            self.listen()?;
            message.replied = self.receive(&mut message.reply[..message.read_len], end, bit)?;
            if !self.spoilt {
                break;
            }
            self.idle()?;
            if !self.pace.until(self.pace.now() + QUIET) {
                break;
            }
        }
        Ok(())
    }

    /// Sends the bits, from `at` on. Returns when the last one ended, and the length of a bit. `None`: it was stopped.
    fn send(&mut self, data: &[u8], mut at: Clock) -> Result<Option<(Clock, Ticks)>, Shutdown> {
        let mut bit = self.bit;
        let mut first_late = 0;
        let synced = data.first().is_some_and(|first| first & SYNC_MASK == SYNC);
        let mut line = true;
        // The first bit is a start bit, whatever the host says.
        for place in 0..(8 * data.len()).max(1) {
            let level = place > 0 && bit_of(data, place);
            if level != line {
                if !self.pace.until(at) {
                    return Ok(None);
                }
                self.tx.write(level)?;
                line = level;
                let late = self.pace.now().since(at);
                // A fault of the sync nibble's four bits is 2.5 times as large at the end of a byte.
                let fault = bit.0 / if place == SYNC_BITS && synced { 16 } else { 4 };
                self.spoilt |= place > 0 && (late - first_late).abs() > i64::from(fault);
                match place {
                    0 => first_late = late,
                    // The driver has measured these bits, and expects the others to have the same length.
                    SYNC_BITS if synced => {
                        let longer = late - first_late;
                        bit = longer_by(bit, div_round(longer, SYNC_BITS as i64));
                        at = at.displaced(longer as u32);
                    }
                    _ => {}
                }
            }
            at = at + bit;
        }
        Ok(self.pace.until(at).then_some((at, bit)))
    }

    /// Reads the reply to a message that ended at `end`. Returns false if none came.
    fn receive(&mut self, reply: &mut [u8], end: Clock, bit: Ticks) -> Result<bool, Shutdown> {
        let from = end + bits(bit, TURN_BITS);
        if !self.pace.until(from) {
            return Ok(false);
        }
        let Some(mut at) = self.start_bit(from, from + bits(bit, REPLY_BITS), bit)? else { return Ok(false) };
        for place in 0..8 * reply.len() {
            if place > 0 && place % FRAME_BITS == 0 {
                // Each start bit shows again where the bits are.
                at = self.start_bit(self.pace.now(), at, bit)?.unwrap_or(at);
            }
            if !self.pace.until(at) {
                return Ok(false);
            }
            let (byte, mask) = (&mut reply[place / 8], 1 << (place % 8));
            *byte = if self.rx.read()? { *byte | mask } else { *byte & !mask };
            self.spoilt |= self.pace.now().since(at) > i64::from(bit.0 / 4);
            at = at + bit;
        }
        Ok(true)
    }

    /// Looks for a start bit until `limit`, and returns its middle. If the line falls and is high again in the middle,
    /// it was a glitch.
    fn start_bit(&mut self, from: Clock, limit: Clock, bit: Ticks) -> Result<Option<Clock>, Shutdown> {
        let mut last = from;
        while let Some(edge) = self.falling_edge(last, limit, bit)? {
            let middle = edge + Ticks(bit.0 / 2);
            if !self.pace.until(middle) {
                return Ok(None);
            }
            if !self.rx.read()? {
                return Ok(Some(middle));
            }
            last = self.pace.now();
            self.spoilt |= last.since(middle) > i64::from(bit.0 / 4);
        }
        Ok(None)
    }

    /// Reads the line until it falls. `None`: it does not fall until `limit`. `last` is when the line was last read, or
    /// the time before which it need not be read.
    fn falling_edge(&mut self, mut last: Clock, limit: Clock, bit: Ticks) -> Result<Option<Clock>, Shutdown> {
        let pause = Ticks((bit.0 / LOOKS).max(1));
        let mut was_high = false;
        loop {
            let level = self.rx.read()?;
            let now = self.pace.now();
            // An edge may have been missed.
            let gap = now.since(last);
            self.spoilt |= gap > i64::from(bit.0 / 4);
            last = now;
            if level {
                was_high = true;
            } else if was_high {
                // The edge lies between two reads.
                return Ok(Some(now - Ticks(gap as u32 / 2)));
            }
            if now >= limit || !self.pace.until(now + pause) {
                return Ok(None);
            }
        }
    }
}

/// The length of `count` bits. A rate that no driver has may last until a shutdown, but does not overflow.
fn bits(bit: Ticks, count: u32) -> Ticks {
    Ticks(bit.0.saturating_mul(count))
}

fn longer_by(bit: Ticks, by: i64) -> Ticks {
    Ticks((i64::from(bit.0) + by).clamp(0, i64::from(u32::MAX)) as u32)
}

/// The nearest whole quotient.
fn div_round(value: i64, by: i64) -> i64 {
    (value + value.signum() * by / 2) / by
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    use crate::time::{TimeSource, VirtualClock};

    /// 40 kbaud.
    const BIT: Ticks = Ticks::from_us(25);

    /// A wire that records the time of each edge. Its other end sends `reply` some time after the last edge.
    struct Wire {
        clock: Arc<dyn TimeSource>,
        edges: Mutex<Vec<(Clock, bool)>>,
        reply: Vec<u8>,
        /// Called at each edge, with the number of edges so far.
        at_edge: Box<dyn Fn(usize) + Send + Sync>,
    }

    /// Time from the last edge of a message to its reply: the end of its last byte, eight bits and a little.
    const REPLY_AFTER: i64 = 20 * BIT.0 as i64 + 333;

    impl Line for Wire {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let mut edges = self.edges.lock().unwrap();
            edges.push((self.clock.now(), level));
            (self.at_edge)(edges.len());
            Ok(())
        }

        fn read(&self) -> Result<bool, Shutdown> {
            let last = self.edges.lock().unwrap().last().map_or(Clock::EPOCH, |(at, _)| *at);
            let into = self.clock.now().since(last) - REPLY_AFTER;
            let place = (into / i64::from(BIT.0)) as usize;
            Ok(into < 0 || place >= 8 * self.reply.len() || bit_of(&self.reply, place))
        }

        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    /// klippy's message to read a register (`_encode_read(0xf5, 0, 2)` of tmc_uart.py), and a reply.
    const MESSAGE: [u8; 5] = [0xea, 0x03, 0x48, 0x20, 0xe4];
    /// The message's edges, and those back to idle.
    const EDGES: usize = 16;
    const REPLY: [u8; 10] = [0x0a, 0xfa, 0x4f, 0x20, 0x80, 0x00, 0x02, 0xe8, 0x20, 0xf1];

    fn uart(
        clock: Arc<dyn TimeSource>,
        at_edge: impl Fn(usize) + Send + Sync + 'static,
    ) -> (Arc<Wire>, Lines, Message) {
        let wire = Arc::new(Wire {
            clock: clock.clone(),
            edges: Mutex::new(Vec::with_capacity(100)),
            reply: REPLY.into(),
            at_edge: Box::new(at_edge),
        });
        let lines =
            Lines { tx: wire.clone(), rx: wire.clone(), single: None, pace: Pace::of(clock), bit: BIT, spoilt: false };
        let mut message = Message::default();
        message.data[..MESSAGE.len()].copy_from_slice(&MESSAGE);
        message.write_len = MESSAGE.len();
        message.read_len = REPLY.len();
        (wire, lines, message)
    }

    #[test]
    fn a_message_is_broken_off_amid_its_bits() {
        let pace = Arc::new(Mutex::new(None::<Pace>));
        let stopper = pace.clone();
        let (wire, mut lines, mut message) = uart(Arc::new(VirtualClock::at(Clock::EPOCH)), move |edge| {
            if edge == 4 {
                stopper.lock().unwrap().as_ref().unwrap().stop();
            }
        });
        *pace.lock().unwrap() = Some(lines.pace.clone());
        lines.exchange(&mut message).unwrap();
        assert!(message.reply().is_empty());
        let levels: Vec<bool> = wire.edges.lock().unwrap().iter().map(|(_, level)| *level).collect();
        assert_eq!(levels, [true, false, true, false, true], "and left high");
    }

    #[test]
    fn bits_are_as_long_as_the_driver_measured_them() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let late = clock.clone();
        // The last edge of the sync nibble comes 80 ticks late.
        let (wire, mut lines, mut message) = uart(Arc::new(clock), move |edge| {
            if edge == 6 {
                late.set(late.now() + Ticks(80));
            }
        });
        message.read_len = 0;
        lines.exchange(&mut message).unwrap();
        let edges = wire.edges.lock().unwrap()[1..].to_vec();
        let edges: Vec<i64> = edges.iter().map(|(at, _)| at.since(edges[0].0)).collect();
        let bit = i64::from(BIT.0);
        assert_eq!(edges[..5], [0, bit, 2 * bit, 3 * bit, 4 * bit]);
        assert_eq!(edges[5], 4 * bit + 80 + bit + 20);
        assert!(edges[6..edges.len() - 1].iter().all(|at| (at - 4 * bit - 80) % (bit + 20) == 0), "{edges:?}");
    }

    #[test]
    fn quotients_are_rounded() {
        assert_eq!([-6, -5, -2, -1, 0, 1, 2, 5, 6].map(|n| div_round(n, 4)), [-2, -1, -1, 0, 0, 0, 1, 1, 2]);
    }

    /// A register is read again if its reply came while the worker had no processor. A write is not repeated.
    #[test]
    fn a_register_is_read_again_if_this_computer_was_late() {
        for (read_len, messages) in [(REPLY.len(), 2), (0, 1)] {
            let clock = VirtualClock::at(Clock::EPOCH);
            let late = clock.clone();
            let (wire, mut lines, mut message) = uart(Arc::new(clock), move |edge| {
                if edge == 7 {
                    late.set(late.now() + Ticks(BIT.0 / 2));
                }
            });
            message.read_len = read_len;
            lines.exchange(&mut message).unwrap();
            assert_eq!(message.reply(), &REPLY[..read_len]);
            let falls = wire.edges.lock().unwrap().windows(2).filter(|pair| pair[0].1 && !pair[1].1).count();
            assert_eq!(falls, messages * EDGES / 2, "{read_len}");
        }
    }

    #[test]
    fn it_is_asked_for_three_times_at_most() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let late = clock.clone();
        let (wire, mut lines, mut message) = uart(Arc::new(clock), move |edge| {
            if edge.is_multiple_of(7) {
                late.set(late.now() + BIT);
            }
        });
        lines.exchange(&mut message).unwrap();
        let falls = wire.edges.lock().unwrap().windows(2).filter(|pair| pair[0].1 && !pair[1].1).count();
        assert_eq!(falls, 3 * EDGES / 2);
    }
}
