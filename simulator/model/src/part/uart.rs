// SPDX-License-Identifier: GPL-3.0-or-later
//! The UART of Trinamic's drivers on one wire, after the data sheet of the TMC2209 ("UART Single Wire
//! Interface"). The other end is two lines or one, and the chip hears their edges. Or it is a serial port, and the chip
//! hears bytes.

use std::sync::{Arc, Mutex, TryLockError};

use crate::description::check::{Trouble, wrong};
use crate::description::pin::PinName;
use crate::engine::crc;
use crate::engine::serial::SerialChip;
use crate::engine::wire::{Kind, LevelLine, Wire};
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock};

/// The low nibble of a message's first byte. The high nibble may have any value.
pub(crate) const SYNC: u8 = 0x05;
/// The address in an answer: the host.
pub(crate) const HOST: u8 = 0xff;
pub(crate) const WRITE: u8 = 0x80;
const READ_LEN: usize = 4;
pub(crate) const WRITE_LEN: usize = 8;
/// Bits of a byte with its start and its stop bit.
const FRAME_BITS: u64 = 10;
/// A new message begins after a pause of `PAUSE_BITS` bit times between two start bits. After a fault it begins after
/// `RECOVERY_BITS` bit times of silence.
const PAUSE_BITS: u64 = 63;
const RECOVERY_BITS: u64 = 12;
/// The longest bit that the chip understands: its baud rates are 9000 to its clock / 16.
const LONGEST_BIT: u64 = CLOCK_FREQ as u64 / 9000;

/// CRC8-ATM, each byte from its lowest bit on ("CRC Calculation").
pub(crate) fn crc8(bytes: &[u8]) -> u8 {
    crc::crc8(0x07, 0, bytes.iter().map(|byte| byte.reverse_bits()))
}

/// Whether these are all bytes of a message.
fn is_whole(bytes: &[u8]) -> bool {
    bytes.get(2).is_some_and(|register| bytes.len() >= if register & WRITE == 0 { READ_LEN } else { WRITE_LEN })
}

/// Whether the check sum of a message is right.
fn is_sound(message: &[u8]) -> bool {
    message.split_last().is_some_and(|(last, checked)| crc8(checked) == *last)
}

/// A chip's UART at the wire of a serial port.
pub(crate) struct PortUart(pub(crate) Box<dyn UartChip>);

impl SerialChip for PortUart {
    /// After a fault the chip waits for silence, so the rest is not heard.
    fn hear(&mut self, bytes: &[u8], rate_hz: u32, now: Clock) -> Vec<u8> {
        let is_too_slow = u64::from(CLOCK_FREQ) > LONGEST_BIT * u64::from(rate_hz);
        let len = (0..=bytes.len()).find(|len| is_whole(&bytes[..*len]));
        match len.map(|len| &bytes[..len]) {
            Some(message) if !is_too_slow && message[0] & 0x0f == SYNC && is_sound(message) => {
                self.0.hear(message, now).map_or_else(Vec::new, Vec::from)
            }
            _ => Vec::new(),
        }
    }
}

/// The event that the chip's receiver waits for.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Expects {
    /// The start bit of a message.
    Message,
    /// The next edges of the sync nibble; this many have come after the first one.
    Sync(u32),
    /// The middle of this bit of a byte (0 is the start bit).
    Bit(u64),
    /// The start bit of the next byte.
    Byte,
    /// Silence, because the bits so far were no message.
    Silence,
}

/// A chip with a UART.
pub(crate) trait UartChip: Send {
    fn address(&self) -> u8;

    /// The value of a register.
    fn read_register(&mut self, register: u8, now: Clock) -> u32;

    fn write_register(&mut self, register: u8, data: u32);

    /// Bit times from a message to its answer.
    fn send_delay(&self) -> u64;

    /// Takes a message in and returns the answer.
    fn hear(&mut self, message: &[u8], now: Clock) -> Option<[u8; WRITE_LEN]> {
        let &[_, address, register, ref rest @ ..] = message else { return None };
        if address != self.address() {
            return None;
        }
        if let &[d3, d2, d1, d0, _] = rest {
            self.write_register(register & !WRITE, u32::from_be_bytes([d3, d2, d1, d0]));
            return None;
        }
        let [d3, d2, d1, d0] = self.read_register(register, now).to_be_bytes();
        let answer = [SYNC, HOST, register, d3, d2, d1, d0];
        let [a, b, c, d, e, f, g] = answer;
        Some([a, b, c, d, e, f, g, crc8(&answer)])
    }
}

/// Refuses UART pins with a `!`.
pub(crate) fn check_pins<'a>(
    whose: &str,
    pins: impl IntoIterator<Item = (&'static str, Option<&'a PinName>)>,
) -> Result<(), Trouble> {
    let inverted = pins.into_iter().find(|(_, pin)| pin.is_some_and(|pin| pin.inverted));
    inverted.map_or(Ok(()), |(key, _)| wrong(whose, key, "klippy cannot invert a UART", "remove the `!`"))
}

/// The keys for the lines of a multiplexer.
pub(crate) fn select_keys(cfg: &mut Sections, select_pins: &[PinName]) {
    if !select_pins.is_empty() {
        let pins: Vec<String> = select_pins.iter().map(ToString::to_string).collect();
        cfg.key("select_pins", pins.join(", "));
    }
}

/// The delay that SENDDELAY of SLAVECONF (NODECONF) asks for: 8, 24, 40 ... 120, one for each pair of values.
pub(crate) fn send_delay(slaveconf: u32) -> u64 {
    8 * u64::from(slaveconf >> 8 & 0xf | 1)
}

/// A chip that hears the wire while lines have their levels.
pub(crate) struct Selected<C> {
    pub(crate) chip: C,
    pub(crate) by: Vec<(Arc<LevelLine>, bool)>,
}

impl<C: UartChip> UartChip for Selected<C> {
    fn address(&self) -> u8 {
        self.chip.address()
    }

    fn read_register(&mut self, register: u8, now: Clock) -> u32 {
        self.chip.read_register(register, now)
    }

    fn write_register(&mut self, register: u8, data: u32) {
        self.chip.write_register(register, data);
    }

    fn send_delay(&self) -> u64 {
        self.chip.send_delay()
    }

    fn hear(&mut self, message: &[u8], now: Clock) -> Option<[u8; WRITE_LEN]> {
        let is_selected = self.by.iter().all(|(line, high)| line.is_high() == *high);
        if is_selected { self.chip.hear(message, now) } else { None }
    }
}

/// The UART of the chips on a wire. They hear the same. The wire is high when nothing drives it low.
pub(crate) struct Uart {
    chips: Vec<Box<dyn UartChip>>,
    expects: Expects,
    /// The wire's level as the MCU drives it; the next field is since when.
    high: bool,
    since: Clock,
    /// Ticks of a bit; 0 before the first sync nibble.
    bit: u64,
    /// The start bit of the current or the last byte.
    start: Clock,
    bytes: [u8; WRITE_LEN],
    len: usize,
    answer: Option<Answer>,
}

#[derive(Clone, Copy)]
struct Answer {
    at: Clock,
    bit: u64,
    bytes: [u8; WRITE_LEN],
}

impl Answer {
    /// The level of the wire at an instant.
    fn level(&self, now: Clock) -> bool {
        let Ok(into) = u64::try_from(now.since(self.at)) else { return true };
        let place = into / self.bit;
        let byte = usize::try_from(place / FRAME_BITS).ok().and_then(|byte| self.bytes.get(byte));
        byte.is_none_or(|byte| match place % FRAME_BITS {
            0 => false,
            9 => true,
            bit => byte >> (bit - 1) & 1 != 0,
        })
    }
}

impl Uart {
    pub(crate) fn new(chip: Box<dyn UartChip>) -> Uart {
        Uart {
            chips: vec![chip],
            expects: Expects::Message,
            high: true,
            since: Clock::EPOCH,
            bit: 0,
            start: Clock::EPOCH,
            bytes: [0; WRITE_LEN],
            len: 0,
            answer: None,
        }
    }

    /// Puts another chip on the wire.
    pub(crate) fn solder(&mut self, chip: Box<dyn UartChip>) {
        self.chips.push(chip);
    }

    /// The MCU drives the wire, or releases it. A released wire is pulled up.
    fn set(&mut self, high: bool, at: Clock) {
        self.look(at);
        if high == self.high {
            return;
        }
        let silent = at.since(self.since).max(0) as u64;
        (self.high, self.since) = (high, at);
        let since_start = at.since(self.start).max(0) as u64;
        match self.expects {
            Expects::Sync(edges) => self.sync(edges, at),
            Expects::Silence if silent < RECOVERY_BITS * self.bit => {}
            Expects::Byte if !high && since_start <= PAUSE_BITS * self.bit => {
                self.start = at;
                self.expects = Expects::Bit(0);
            }
            Expects::Message | Expects::Byte | Expects::Silence if !high => {
                self.start = at;
                self.len = 0;
                self.answer = None;
                self.expects = Expects::Sync(0);
            }
            _ => {}
        }
    }

    /// An edge of the sync nibble, 1010. The chip measures four bits, from the falling edge of the start bit to the
    /// last falling edge.
    fn sync(&mut self, edges: u32, at: Clock) {
        let edges = edges + 1;
        self.expects = Expects::Sync(edges);
        if edges == 4 {
            self.bit = at.since(self.start).max(0) as u64 / 4;
            let fits = (1..=LONGEST_BIT).contains(&self.bit);
            if !fits {
                self.bit = LONGEST_BIT;
            }
            self.bytes[0] = SYNC;
            self.expects = if fits { Expects::Bit(5) } else { Expects::Silence };
        }
    }

    /// The middle of a bit of the current byte.
    fn middle(&self, bit: u64) -> Clock {
        Clock::from_ticks(self.start.ticks() + bit * self.bit + self.bit / 2)
    }

    /// Reads the bits until now. The wire kept its level during this time.
    fn look(&mut self, now: Clock) {
        while let Expects::Bit(bit) = self.expects {
            let middle = self.middle(bit);
            if now <= middle {
                return;
            }
            self.expects = Expects::Bit(bit + 1);
            let mask = 1u8.checked_shl(bit.wrapping_sub(1) as u32).unwrap_or(0);
            match bit {
                0 if self.high => self.expects = Expects::Silence,
                0 => self.bytes[self.len] = 0,
                9 if !self.high => self.expects = Expects::Silence,
                9 => self.byte(middle),
                _ if self.high => self.bytes[self.len] |= mask,
                _ => {}
            }
        }
    }

    /// A byte is complete, in the middle of its stop bit.
    fn byte(&mut self, now: Clock) {
        self.len += 1;
        self.expects = Expects::Byte;
        let message = &self.bytes[..self.len];
        if !is_whole(message) {
            return;
        }
        if !is_sound(message) {
            self.expects = Expects::Silence;
            return;
        }
        self.expects = Expects::Message;
        let answers = self.chips.iter_mut().filter_map(|chip| Some((chip.hear(message, now)?, chip.send_delay())));
        // Two chips with one address answer the same.
        let answer = answers.fold(None, |first, answer| first.or(Some(answer)));
        self.answer = answer.map(|(bytes, delay)| {
            let end = self.start.ticks() + (FRAME_BITS + delay) * self.bit;
            Answer { at: Clock::from_ticks(end), bit: self.bit, bytes }
        });
    }

    /// The level of the wire when the MCU does not drive it.
    fn level(&mut self, now: Clock) -> bool {
        self.look(now);
        self.answer.is_none_or(|answer| answer.level(now))
    }
}

/// The role of one end of the UART.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Role {
    /// Sends and receives, by turns.
    Both,
    Sender,
    Receiver,
}

/// The board's end of the wire, or one of its two ends.
pub(crate) struct UartPin {
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) uart: Arc<Mutex<Uart>>,
}

impl UartPin {
    /// An access to the wire. One thread at a time drives it. The chip does not hear an access of another thread at the
    /// same time.
    fn on_wire<T>(&self, happens: impl FnOnce(&mut Uart) -> T) -> Option<T> {
        match self.uart.try_lock() {
            Ok(mut uart) => Some(happens(&mut uart)),
            Err(TryLockError::Poisoned(uart)) => Some(happens(&mut uart.into_inner())),
            Err(TryLockError::WouldBlock) => None,
        }
    }
}

impl Wire for UartPin {
    fn kind(&self) -> Kind {
        match self.role {
            Role::Both => Kind::Shared,
            Role::Sender => Kind::Output,
            Role::Receiver => Kind::Input,
        }
    }

    fn describe(&self) -> String {
        format!("UART of {}", self.name)
    }

    fn drive(&self, on: bool, at: Clock) {
        self.on_wire(|uart| uart.set(on, at));
    }

    fn release(&self, at: Clock) {
        self.on_wire(|uart| uart.set(true, at));
    }

    /// The MCU's own low level is also on the wire.
    fn sense(&self, _driven: bool, at: Clock) -> bool {
        self.on_wire(|uart| uart.level(at) && uart.high).unwrap_or(true)
    }
}
