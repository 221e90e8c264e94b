// SPDX-License-Identifier: GPL-3.0-or-later
//! The UART of Trinamic's stepper drivers (TMC2208, TMC2209 and similar), bit by bit on one wire or two. klippy writes
//! the start and stop bits itself, checks those of the reply, and asks again.
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

use crate::board::{Bias, Direction, Line, Pin};
use crate::mcu::{
    Back, Command, Done, Errand, Feature, Next, Object, Oid, Response, Safe, Slot, Timer, Turn, WorkerId, command,
    response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::pace::Pace;

pub(super) const FEATURE: Feature = Feature {
    commands: &[CONFIG_TMCUART, TMCUART_SEND],
    responses: &[UartResponse::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `tmcuart_send` with more than ten bytes to send or to read.
    DATA_TOO_LARGE = "tmcuart data too large";
}

response! {
    /// A message was sent. `read` has the bits of the reply, from its first start bit on. It is empty if no reply was
    /// requested or none came.
    "tmcuart_response oid=%c read=%*s"
    pub(super) struct UartResponse<'a> { oid: Oid, read: &'a [u8] }
}

/// All UARTs share a worker, because klippy talks to one at a time (`PrinterTMCUartMutexes` in tmc_uart.py).
const WORKER: &str = "tmcuart";
/// Highest number of bytes in a message, with start and stop bits: eight bytes of ten bits.
const DATA_MAX: usize = 10;
/// How long the line is quiet between the command and the first edge, as in the firmware. A driver wants a quiet line
/// between messages.
const QUIET: Ticks = Ticks::from_us(200);
/// How long to wait after a message before looking for the reply, in bits.
const TURN_BITS: u32 = 4;
/// How long to look for the reply, in bits.
const REPLY_BITS: u32 = 65;
/// A byte with its start and its stop bit.
const FRAME_BITS: usize = 10;
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

const TIMER: Timer = Timer::exact(0);

/// The two ends of the UART.
#[derive(Clone)]
struct Wires {
    tx: Arc<dyn Line>,
    rx: Arc<dyn Line>,
    /// The resistor of a single wire while it listens. `None`: there are two wires.
    single: Option<Bias>,
}

impl Wires {
    /// Drives the line high, its level between messages.
    fn idle(&self) -> Result<(), Shutdown> {
        match self.single {
            Some(_) => self.tx.turn(Direction::Output { level: true, shutdown_value: true }),
            None => self.tx.write(true),
        }
    }

    fn listen(&self) -> Result<(), Shutdown> {
        self.single.map_or(Ok(()), |bias| self.rx.turn(Direction::Input(bias)))
    }
}

/// A message and its reply. Each UART has one box for them.
struct Exchange {
    pace: Pace,
    wires: Wires,
    /// The configured length of a bit.
    bit: Ticks,
    /// The bits to send. The first bit is the lowest.
    data: [u8; DATA_MAX],
    write_len: usize,
    reply: [u8; DATA_MAX],
    read_len: usize,
    /// Whether a reply came.
    replied: bool,
    /// Whether a bit was late enough to be taken for another.
    spoilt: bool,
}

impl Errand for Exchange {
    type Answer = ();
    type Failure = Shutdown;

    fn run(&mut self) -> Result<(), Shutdown> {
        self.replied = false;
        let exchanged = self.exchange();
        exchanged.and(self.wires.idle())
    }
}

impl Exchange {
    /// Reading a register changes nothing in the driver, so it is retried here. klippy repeats a write, and counts the
    /// writes that arrived.
    fn exchange(&mut self) -> Result<(), Shutdown> {
        for _ in 0..TRIES {
            self.spoilt = false;
            // The first call is slower than the others. Without this one, the first bit would be longer.
            self.wires.tx.write(true)?;
            let Some((end, bit)) = self.send(self.pace.now())? else { break };
            if self.read_len == 0 {
                break;
            }
            self.wires.listen()?;
            self.replied = self.receive(end, bit)?;
            if !self.spoilt {
                break;
            }
            self.wires.idle()?;
            if !self.pace.until(self.pace.now() + QUIET) {
                break;
            }
        }
        Ok(())
    }

    fn reply(&self) -> &[u8] {
        if self.replied { &self.reply[..self.read_len] } else { &[] }
    }

    /// Sends the bits, from `at` on. Returns when the last one ended, and the length of a bit. `None`: it was stopped.
    fn send(&mut self, mut at: Clock) -> Result<Option<(Clock, Ticks)>, Shutdown> {
        let mut bit = self.bit;
        let mut first_late = 0;
        let synced = self.data[..self.write_len].first().is_some_and(|first| first & SYNC_MASK == SYNC);
        let mut line = true;
        // The first bit is a start bit, whatever the host says.
        for place in 0..(8 * self.write_len).max(1) {
            let level = place > 0 && self.data[place / 8] >> (place % 8) & 1 != 0;
            if level != line {
                if !self.pace.until(at) {
                    return Ok(None);
                }
                self.wires.tx.write(level)?;
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
    fn receive(&mut self, end: Clock, bit: Ticks) -> Result<bool, Shutdown> {
        let from = end + bits(bit, TURN_BITS);
        if !self.pace.until(from) {
            return Ok(false);
        }
        let Some(mut at) = self.start_bit(from, from + bits(bit, REPLY_BITS), bit)? else { return Ok(false) };
        for place in 0..8 * self.read_len {
            if place > 0 && place % FRAME_BITS == 0 {
                // Each start bit shows again where the bits are.
                at = self.start_bit(self.pace.now(), at, bit)?.unwrap_or(at);
            }
            if !self.pace.until(at) {
                return Ok(false);
            }
            let (byte, mask) = (&mut self.reply[place / 8], 1 << (place % 8));
            *byte = if self.wires.rx.read()? { *byte | mask } else { *byte & !mask };
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
            if !self.wires.rx.read()? {
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
            let level = self.wires.rx.read()?;
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

struct TmcUart {
    worker: WorkerId,
    pace: Pace,
    exchange: Slot<Exchange>,
    /// Whether the host still expects an answer.
    asked: bool,
}

impl TmcUart {
    fn send(&mut self, turn: &mut Turn, write: &[u8], read_len: u8) -> Result<(), Shutdown> {
        // As in the firmware: a busy UART ignores the command, and the host asks again.
        let Some(exchange) = self.exchange.here().filter(|_| !self.asked) else { return Ok(()) };
        let read_len = usize::from(read_len);
        if write.len() > DATA_MAX || read_len > DATA_MAX {
            return Err(Shutdown::by_host(
                DATA_TOO_LARGE,
                format_args!("tmcuart_send wants {} bytes sent and {read_len} read, of {DATA_MAX} each", write.len()),
            ));
        }
        exchange.data[..write.len()].copy_from_slice(write);
        exchange.write_len = write.len();
        exchange.read_len = read_len;
        self.asked = true;
        let at = turn.now() + QUIET;
        turn.go_on(TIMER, at);
        Ok(())
    }
}

impl Object for TmcUart {
    fn kind(&self) -> &'static str {
        "TMC UART"
    }

    /// Sends the message from a timer, so that no command waits for it.
    fn event(&mut self, turn: &mut Turn, _timer: Timer, _at: Clock) -> Result<Next, Shutdown> {
        self.exchange.send(turn, self.worker)?;
        Ok(Next::Done)
    }

    fn returned(&mut self, turn: &mut Turn, done: &mut Done) -> Result<(), Shutdown> {
        let Some(Back { result, .. }) = self.exchange.back(done) else { return Ok(()) };
        let result = result.map_err(Shutdown::clone);
        self.pace.resume();
        if std::mem::take(&mut self.asked)
            && result.is_ok()
            && let Some(exchange) = self.exchange.here()
        {
            turn.send(UartResponse { oid: turn.oid(), read: exchange.reply() });
        }
        match result {
            Ok(()) => {
                turn.is_safe();
                Ok(())
            }
            Err(failure) => turn.device_failed(self.kind(), failure),
        }
    }

    fn shutdown(&mut self, _turn: &mut Turn) {
        self.asked = false;
    }

    /// Aborts a message under way. The errand then leaves the line idle.
    fn make_safe(&mut self, _turn: &mut Turn) -> Result<Safe, Shutdown> {
        match self.exchange.here() {
            Some(exchange) => exchange.wires.idle().map(|()| Safe::Now),
            None => {
                self.pace.stop();
                Ok(Safe::Later)
            }
        }
    }
}

const CONFIG_TMCUART: Command = command!(
    "config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u",
    |mcu, oid: Oid, rx_pin: Pin, pull_up: bool, tx_pin: Pin, bit_time: Ticks| {
        mcu.vacant(oid)?;
        let bias = if pull_up { Bias::PullUp } else { Bias::None };
        let worker = mcu.worker(WORKER)?;
        let rx = mcu.prompt_line(rx_pin, "UART", Direction::Input(bias))?;
        let wires = if rx_pin == tx_pin {
            Wires { tx: rx.clone(), rx, single: Some(bias) }
        } else {
            let idle = Direction::Output { level: true, shutdown_value: true };
            Wires { tx: mcu.prompt_line(tx_pin, "UART", idle)?, rx, single: None }
        };
        wires.idle()?;
        let pace = Pace::new(mcu);
        let exchange = Slot::new(Exchange {
            pace: pace.clone(),
            wires,
            bit: bit_time,
            data: [0; DATA_MAX],
            write_len: 0,
            reply: [0; DATA_MAX],
            read_len: 0,
            replied: false,
            spoilt: false,
        });
        mcu.assign_on(tx_pin, oid, TmcUart { worker, pace, exchange, asked: false })
    }
);

const TMCUART_SEND: Command =
    command!("tmcuart_send oid=%c write=%*s read=%c", TmcUart, |uart, turn, write: &[u8], read: u8| uart
        .send(turn, write, read));

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
            Ok(into < 0 || bit_of(&self.reply, (into / i64::from(BIT.0)) as usize))
        }

        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    fn bit_of(bytes: &[u8], place: usize) -> bool {
        bytes.get(place / 8).is_none_or(|byte| byte >> (place % 8) & 1 != 0)
    }

    /// klippy's message to read a register (`_encode_read(0xf5, 0, 2)` of tmc_uart.py), and a reply.
    const MESSAGE: [u8; 5] = [0xea, 0x03, 0x48, 0x20, 0xe4];
    /// The message's edges, and those back to idle.
    const EDGES: usize = 16;
    const REPLY: [u8; 10] = [0x0a, 0xfa, 0x4f, 0x20, 0x80, 0x00, 0x02, 0xe8, 0x20, 0xf1];

    fn exchange(clock: Arc<dyn TimeSource>, at_edge: impl Fn(usize) + Send + Sync + 'static) -> (Arc<Wire>, Exchange) {
        let wire = Arc::new(Wire {
            clock: clock.clone(),
            edges: Mutex::new(Vec::with_capacity(100)),
            reply: REPLY.into(),
            at_edge: Box::new(at_edge),
        });
        let mut data = [0; DATA_MAX];
        data[..MESSAGE.len()].copy_from_slice(&MESSAGE);
        let exchange = Exchange {
            pace: Pace::of(clock),
            wires: Wires { tx: wire.clone(), rx: wire.clone(), single: None },
            bit: BIT,
            data,
            write_len: MESSAGE.len(),
            reply: [0; DATA_MAX],
            read_len: REPLY.len(),
            replied: false,
            spoilt: false,
        };
        (wire, exchange)
    }

    #[test]
    fn a_message_is_broken_off_amid_its_bits() {
        let pace = Arc::new(Mutex::new(None::<Pace>));
        let stopper = pace.clone();
        let (wire, mut exchange) = exchange(Arc::new(VirtualClock::at(Clock::EPOCH)), move |edge| {
            if edge == 4 {
                stopper.lock().unwrap().as_ref().unwrap().stop();
            }
        });
        *pace.lock().unwrap() = Some(exchange.pace.clone());
        exchange.run().unwrap();
        assert!(exchange.reply().is_empty());
        let levels: Vec<bool> = wire.edges.lock().unwrap().iter().map(|(_, level)| *level).collect();
        assert_eq!(levels, [true, false, true, false, true], "and left high");
    }

    #[test]
    fn bits_are_as_long_as_the_driver_measured_them() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let late = clock.clone();
        // The last edge of the sync nibble comes 80 ticks late.
        let (wire, mut exchange) = exchange(Arc::new(clock), move |edge| {
            if edge == 6 {
                late.set(late.now() + Ticks(80));
            }
        });
        exchange.read_len = 0;
        exchange.run().unwrap();
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
            let (wire, mut exchange) = exchange(Arc::new(clock), move |edge| {
                if edge == 7 {
                    late.set(late.now() + Ticks(BIT.0 / 2));
                }
            });
            exchange.read_len = read_len;
            exchange.run().unwrap();
            assert_eq!(exchange.reply(), &REPLY[..read_len]);
            let falls = wire.edges.lock().unwrap().windows(2).filter(|pair| pair[0].1 && !pair[1].1).count();
            assert_eq!(falls, messages * EDGES / 2, "{read_len}");
        }
    }

    #[test]
    fn it_is_asked_for_three_times_at_most() {
        let clock = VirtualClock::at(Clock::EPOCH);
        let late = clock.clone();
        let (wire, mut exchange) = exchange(Arc::new(clock), move |edge| {
            if edge.is_multiple_of(7) {
                late.set(late.now() + BIT);
            }
        });
        exchange.run().unwrap();
        let falls = wire.edges.lock().unwrap().windows(2).filter(|pair| pair[0].1 && !pair[1].1).count();
        assert_eq!(falls, 3 * EDGES / 2);
    }
}
