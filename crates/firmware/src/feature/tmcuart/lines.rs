// SPDX-License-Identifier: GPL-3.0-or-later
//! A TMC UART on GPIO lines, bit by bit.
//!
//! Klipper's C has a timer for each bit. Here a job times a whole message on a worker. At 40 kbaud a message is up
//! to 5 ms of edges 25 us apart, which would keep the core awake. `benches/bits.rs` measures how late bits are
//! in both cases (docs/develop/performance.md).
//!
//! Klipper's C samples a reply anywhere within a bit, wherever its timer happens to be. Here the start bit of each
//! byte is found, and bits are read in their middle. So half a bit of lateness does no harm. A start bit that is high
//! again in its middle is a glitch and does not count.
//!
//! A message begins between two ticks of the kernel, if there is time enough. They are 4 ms apart on most computers.
//!
//! The bits of a message count from the start bit of their byte, as the driver counts them. So a late start bit does no
//! harm. If another bit is late, the message is aborted. A driver forgets a message after a pause of 63 bits. It
//! obeys a message only after its last byte, the checksum. So a write can be sent again too, unless the end of that byte
//! was a little late. The answer to a read counts only if none of its bits was late. So a late computer never reads a
//! register wrong.

use std::sync::Arc;

use crate::board::{Bias, Direction, Line};
use crate::feature::pace::Pace;
use crate::shutdown::Shutdown;
use crate::time::{Clock, Ticks};

use super::{FRAME_BITS, Message, QUIET, REPLY_BITS, TURN_BITS, bit_of};

/// How often the line is read in each bit while waiting for an edge.
const LOOKS: u32 = 16;
/// How often a message is sent if a bit was late. klippy itself asks five times. It cannot know whether the driver or
/// this computer was late.
const TRIES: u32 = 16;
/// How long the line is quiet after an aborted message: 63 bits until the driver gives it up, and 12 until it
/// takes another (TMC2209 data sheet, section 4.1.1: "reset by a pause of longer than 63 bit times"), and some.
const RECOVERY_BITS: u32 = 80;
/// A message begins with a start bit and a sync nibble. The driver takes its rate from them.
const SYNC: u8 = 0b10_1010;
const SYNC_MASK: u8 = 0b11_1111;
/// The bits between the first and the last falling edge of these.
const SYNC_BITS: usize = 4;

/// The sending end of the UART.
#[derive(Clone)]
pub(super) struct Wire {
    pub(super) tx: Arc<dyn Line>,
    /// The resistor of a single wire while it listens. `None`: there are two wires.
    pub(super) single: Option<Bias>,
}

impl Wire {
    /// Drives the line high, its level between messages.
    pub(super) fn idle(&self) -> Result<(), Shutdown> {
        match self.single {
            Some(_) => self.tx.turn(Direction::at_rest(true)),
            None => self.tx.write(true),
        }
    }
}

/// The two ends of the UART, and the time of its bits.
pub(super) struct Lines {
    pub(super) wire: Wire,
    pub(super) rx: Arc<dyn Line>,
    pub(super) pace: Pace,
    /// The configured length of a bit.
    pub(super) bit: Ticks,
    /// Whether a bit was late enough to be taken for another.
    pub(super) spoilt: bool,
}

/// The sent part of a message.
enum Sent {
    /// All bits. The last one ended at `end`. A bit was this long.
    All { end: Clock, bit: Ticks },
    /// It was aborted before its last byte, because a bit was late.
    Part,
    /// The MCU stopped.
    Stopped,
}

impl Lines {
    fn listen(&self) -> Result<(), Shutdown> {
        self.wire.single.map_or(Ok(()), |bias| self.rx.turn(Direction::Input(bias)))
    }

    /// Sends a message, receives its reply, and leaves the line idle.
    pub(super) fn exchange(&mut self, message: &mut Message) -> Result<(), Shutdown> {
        let exchanged = self.converse(message);
        exchanged.and(self.wire.idle())
    }

    fn converse(&mut self, message: &mut Message) -> Result<(), Shutdown> {
        for _ in 0..TRIES {
            self.spoilt = false;
            self.pace.until_between_ticks(bits(self.bit, message.bits_max()));
            // The first call is slower than the others. Without this one, the first bit would be longer.
            self.wire.tx.write(true)?;
            let pause = match self.send(message.bits(), self.pace.now())? {
                Sent::All { .. } if message.read_len == 0 => break,
                Sent::All { end, bit } => {
                    self.listen()?;
                    let replied = self.receive(&mut message.reply[..message.read_len], end, bit)?;
                    message.replied = replied && !self.spoilt;
                    if !self.spoilt {
                        break;
                    }
                    self.wire.idle()?;
                    QUIET
                }
                Sent::Part => bits(self.bit, RECOVERY_BITS),
                Sent::Stopped => break,
            };
            if !self.pace.until(self.pace.now() + pause) {
                break;
            }
        }
        Ok(())
    }

    /// Sends the bits, from `at` on, until one is late.
    fn send(&mut self, data: &[u8], mut at: Clock) -> Result<Sent, Shutdown> {
        let mut bit = self.bit;
        // How long a write and a read of the clock take.
        let mut cost = 0;
        let synced = data.first().is_some_and(|first| first & SYNC_MASK == SYNC);
        let mut line = true;
        // The first bit is sent as a start bit, even if the host gave another one.
        for place in 0..(8 * data.len()).max(1) {
            let level = place > 0 && bit_of(data, place);
            if level != line {
                if !self.pace.until(at) {
                    return Ok(Sent::Stopped);
                }
                let begins = self.pace.now();
                self.wire.tx.write(level)?;
                line = level;
                let ended = self.pace.now();
                if place % FRAME_BITS == 0 {
                    // The driver counts the bits of a byte from here.
                    at = begins;
                }
                if place == 0 {
                    cost = ended.since(begins);
                }
                let late = ended.since(at) - cost;
                // A fault of the sync nibble's four bits is 2.5 times as large at the end of a byte.
                let fault = bit.0 / if place == SYNC_BITS && synced { 16 } else { 4 };
                if late.abs() > i64::from(fault) {
                    self.spoilt = true;
                    if self.break_off(data, place, at, bit)? {
                        return Ok(Sent::Part);
                    }
                }
                if place == SYNC_BITS && synced {
                    // The driver has measured these bits, and expects the others to have the same length.
                    bit = longer_by(bit, div_round(late, SYNC_BITS as i64));
                    at = at.displaced(late as u32);
                }
            }
            at = at + bit;
        }
        Ok(if self.pace.until(at) { Sent::All { end: at, bit } } else { Sent::Stopped })
    }

    /// Aborts a message after the edge of the bit at `place`, which was due `at` and late. Returns false if the driver
    /// may have the whole message.
    fn break_off(&self, data: &[u8], place: usize, at: Clock, bit: Ticks) -> Result<bool, Shutdown> {
        let places = 8 * data.len();
        let late = self.pace.now().since(at);
        if place + 1 == places {
            // The driver has read the stop bit as low, and drops the byte.
            return Ok(late > i64::from(bit.0 / 4 * 3));
        }
        if place + FRAME_BITS >= places {
            // The last byte is the checksum. One wrong bit makes the message void.
            let ahead = 1 + usize::try_from(late / i64::from(bit.0.max(1))).unwrap_or_default();
            let begins = at + bits(bit, ahead as u32);
            if place + ahead + 1 >= places || !self.pace.until(begins) {
                return Ok(false);
            }
            self.wire.tx.write(!bit_of(data, place + ahead))?;
            if self.pace.now().since(begins) > i64::from(bit.0 / 4) || !self.pace.until(begins + bit) {
                return Ok(false);
            }
        }
        self.wire.tx.write(true)?;
        Ok(true)
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
    use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};
    use std::time::Duration;

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
        let lines = Lines {
            wire: super::Wire { tx: wire.clone(), single: None },
            rx: wire.clone(),
            pace: Pace::of(clock),
            bit: BIT,
            spoilt: false,
        };
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
        // The last edge of the sync nibble comes 60 ticks late.
        let (wire, mut lines, mut message) = uart(Arc::new(clock), move |edge| {
            if edge == 6 {
                late.set(late.now() + Ticks(60));
            }
        });
        message.read_len = 0;
        lines.exchange(&mut message).unwrap();
        let edges = wire.edges.lock().unwrap()[1..].to_vec();
        let edges: Vec<i64> = edges.iter().map(|(at, _)| at.since(edges[0].0)).collect();
        let bit = i64::from(BIT.0);
        assert_eq!(edges[..5], [0, bit, 2 * bit, 3 * bit, 4 * bit]);
        assert_eq!(edges[5], 4 * bit + 60 + bit + 15);
        assert!(edges[6..edges.len() - 1].iter().all(|at| (at - 4 * bit - 60) % (bit + 15) == 0), "{edges:?}");
    }

    #[test]
    fn quotients_are_rounded() {
        assert_eq!([-6, -5, -2, -1, 0, 1, 2, 5, 6].map(|n| div_round(n, 4)), [-2, -1, -1, 0, 0, 0, 1, 1, 2]);
    }

    /// A clock on which some waits end late, by this time. `is_late` gets the number of the wait and its length.
    struct Late<F> {
        clock: VirtualClock,
        waits: AtomicUsize,
        by: Ticks,
        is_late: F,
    }

    impl<F: Fn(usize, i64) -> bool + Send + Sync> TimeSource for Late<F> {
        fn now(&self) -> Clock {
            self.clock.now()
        }
        fn instant_of(&self, monotonic: Duration) -> Clock {
            self.clock.instant_of(monotonic)
        }
        fn duration_of(&self, clock: Clock) -> Duration {
            self.clock.duration_of(clock)
        }
        fn spin_until(&self, end: Clock) {
            let length = end.since(self.now());
            let late = (self.is_late)(self.waits.fetch_add(1, SeqCst), length);
            self.clock.set(if late { end + self.by } else { end });
        }
    }

    /// The edges of an exchange and its reply.
    fn exchange_with(
        read_len: usize,
        is_late: impl Fn(usize, i64) -> bool + Send + Sync + 'static,
    ) -> (Vec<(Clock, bool)>, Vec<u8>) {
        exchange_late(&MESSAGE, read_len, Ticks(BIT.0 / 2), is_late)
    }

    /// The same with another message of this length, and other waits.
    fn exchange_late(
        data: &[u8; MESSAGE.len()],
        read_len: usize,
        by: Ticks,
        is_late: impl Fn(usize, i64) -> bool + Send + Sync + 'static,
    ) -> (Vec<(Clock, bool)>, Vec<u8>) {
        let clock = Late { clock: VirtualClock::at(Clock::EPOCH), waits: AtomicUsize::new(1), by, is_late };
        let (wire, mut lines, mut message) = uart(Arc::new(clock), |_| ());
        message.data[..data.len()].copy_from_slice(data);
        message.read_len = read_len;
        lines.exchange(&mut message).unwrap();
        let edges = wire.edges.lock().unwrap()[1..].to_vec();
        (edges, message.reply().to_vec())
    }

    fn falls(edges: &[(Clock, bool)]) -> usize {
        edges.windows(2).filter(|pair| pair[0].1 && !pair[1].1).count() + 1
    }

    #[test]
    fn a_message_with_a_late_bit_is_broken_off_and_sent_again() {
        // The n-th wait is that for the n-th edge after the first one. Some are start bits: these only move their byte.
        for (late, is_start) in [(1, false), (4, false), (6, true), (7, false), (8, true), (11, false), (12, true)] {
            for read_len in [0, REPLY.len()] {
                let (edges, reply) = exchange_with(read_len, move |wait, _| wait == late);
                assert_eq!(reply, REPLY[..read_len]);
                assert_eq!(falls(&edges) > EDGES / 2, !is_start, "edge {late}: {edges:?}");
                let at = |n: usize| edges[n].0;
                if is_start {
                    assert_eq!(at(late + 1).since(at(late)) % i64::from(BIT.0), 0, "its bits are as long as others");
                } else {
                    // High, and high once more before the next one.
                    let again = at(late + 2).since(at(late + 1));
                    assert!(again >= 75 * i64::from(BIT.0), "the driver gives up the first one: {edges:?}");
                }
            }
        }
    }

    /// A late bit of the checksum makes another bit of it wrong. If it was the last one, the driver may have the message.
    #[test]
    fn a_write_is_sent_again_if_its_checksum_was_late() {
        // The last edges: bits 4, 5 and 7 of the last byte, whose bit 8 is the last before the stop bit.
        for late in [13, 14, 15] {
            let (edges, _) = exchange_with(0, move |wait, _| wait == late);
            assert!(falls(&edges) > EDGES / 2, "{edges:?}");
            let level = |at: Clock| edges.iter().rev().find(|(from, _)| *from <= at).is_none_or(|(_, level)| *level);
            let bit = |n: u32| level(edges[12].0 + Ticks(n * BIT.0 + BIT.0 / 2));
            assert!((0..8).any(|n| bit(n + 1) != bit_of(&MESSAGE, 31 + n as usize)), "{edges:?}");
        }
    }

    /// A driver reads the stop bit in its middle, more or less. If that was low for certain, it has dropped the message.
    /// Otherwise it may have it.
    #[test]
    fn a_write_is_sent_again_if_its_stop_bit_was_low() {
        // The bytes f5, 00, 06 and 3c: the last edge begins the stop bit.
        const WRITE: [u8; MESSAGE.len()] = [0xea, 0x03, 0xc8, 0x20, 0x9e];
        const STOP: usize = 15;
        for (late_percent, again) in [(20, false), (50, false), (70, false), (80, true), (300, true)] {
            let by = Ticks(BIT.0 * late_percent / 100);
            let (edges, _) = exchange_late(&WRITE, 0, by, |wait, _| wait == STOP);
            assert_eq!(edges[STOP].0.since(edges[0].0), i64::from(39 * BIT.0 + by.0), "{edges:?}");
            assert_eq!(falls(&edges), if again { 16 } else { 8 }, "{late_percent} % of a bit: {edges:?}");
        }
    }

    /// A reply that came while the worker had no processor counts as none.
    #[test]
    fn a_register_is_asked_for_sixteen_times_at_most_and_never_read_wrong() {
        let half = i64::from(BIT.0 / 2);
        // The waits for the middle of a start bit.
        let (edges, reply) = exchange_with(REPLY.len(), move |_, length| (half - 100..=half).contains(&length));
        assert!(reply.is_empty());
        assert_eq!(falls(&edges), TRIES as usize * EDGES / 2);
    }
}
