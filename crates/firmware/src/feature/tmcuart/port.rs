// SPDX-License-Identifier: GPL-3.0-or-later
//! A TMC UART on a serial port of the computer. The port's controller times the bits.
//!
//! klippy's bits become bytes, and the bytes of the reply become bits again. With the usual cabling, RX is connected to
//! the driver's only wire, and TX through a resistor. So the port also receives its own bytes: the echo. It comes before
//! the reply, and is removed. With other cabling there is no echo. The received bytes themselves show it: an echo
//! repeats the message from its first byte on. A reply cannot be taken for an echo. It begins with 05 FF, and FF is no
//! driver's address.
//!
//! A reply that does not come, or is not whole, is empty, as in Klipper's C. klippy then asks again. This is also the
//! answer if the port fails. klippy stops the printer if it needed the answer.

use std::time::Duration;

use crate::board::SerialPort;
use crate::mcu::DeviceWarning;
use crate::time::{NS_PER_TICK, Ticks};
use crate::trouble::Trouble;

use super::{DATA_MAX, FRAME_BITS, Message, REPLY_BITS, TURN_BITS, bit_of};

/// Highest number of bytes in a message.
const BYTES_MAX: usize = 8 * DATA_MAX / FRAME_BITS;
/// How late a byte may be. A driver of a port passes bytes on late. The adapters of FTDI wait for 16 ms.
const LATE_MAX: Duration = Duration::from_millis(50);
/// The first bytes of each reply: the sync nibble, and the host's address.
const REPLY_HEAD: [u8; 2] = [0x05, 0xff];
/// How many reads it takes at most until a port is quiet that receives garbage.
const QUIET_READS: u32 = 16;

/// The received bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Arrived {
    /// The reply, or the echo of a message without a reply.
    All,
    /// The echo alone.
    Echo,
    Nothing,
    Garbage,
}

/// The first words of each warning.
const SUBJECT: &str = "TMC UART";

/// The port.
pub(super) struct Port {
    device: Box<dyn SerialPort>,
    /// Its name in the log.
    name: String,
    /// How long to wait for the next byte.
    limit: Duration,
    /// Whether the port received its own messages so far.
    echoes: bool,
    /// The faults that it has warned of, each with the driver's address.
    warned: Vec<(Arrived, u8)>,
    /// Whether there was a warning that the port failed.
    failed: bool,
    /// A warning for the log.
    pub(super) warning: Option<DeviceWarning>,
}

impl Port {
    /// A port with bits of this length. `name` is its name in the log.
    pub(super) fn new(device: Box<dyn SerialPort>, name: String, bit: Ticks) -> Port {
        let bits = u64::from(TURN_BITS + REPLY_BITS) + FRAME_BITS as u64;
        let limit = Duration::from_nanos(bits * u64::from(bit.0) * NS_PER_TICK) + LATE_MAX;
        Port { device, name, limit, echoes: true, warned: Vec::new(), failed: false, warning: None }
    }

    /// Sends a message, and receives its reply.
    pub(super) fn exchange(&mut self, message: &mut Message) {
        let (sent, len) = bytes_of(message.bits());
        let sent = &sent[..len];
        match self.converse(sent, message) {
            Ok(heard) => self.warn(heard, sent.get(1).copied().unwrap_or_default()),
            Err(trouble) => {
                if !std::mem::replace(&mut self.failed, true) {
                    let trouble = trouble.of(format_args!("TMC UART {}", self.name));
                    self.warning = Some(DeviceWarning::new(SUBJECT, trouble));
                }
            }
        }
    }

    fn converse(&mut self, sent: &[u8], message: &mut Message) -> Result<Arrived, Trouble> {
        let reply_len = (8 * message.read_len).div_ceil(FRAME_BITS);
        self.device.send(sent)?;
        // The echo of a message without a reply is also awaited. It could come after the next message is sent.
        if reply_len == 0 && !self.echoes {
            return Ok(Arrived::All);
        }
        let mut buffer = [0; 2 * BYTES_MAX];
        let mut len = 0;
        let (is_echo, from) = loop {
            let is_echo = buffer[..len].iter().zip(sent).all(|(received, sent)| received == sent);
            let from = if is_echo { sent.len() } else { 0 };
            let missing = (from + reply_len).saturating_sub(len);
            let came =
                if missing == 0 { 0 } else { self.device.receive(&mut buffer[len..len + missing], self.limit)? };
            if came == 0 {
                break (is_echo, from);
            }
            len += came;
        };
        let reply = buffer.get(from..len).unwrap_or_default();
        let heard = match len {
            0 => Arrived::Nothing,
            _ if is_echo && len < sent.len() => Arrived::Garbage,
            _ if is_echo && reply.is_empty() && reply_len > 0 => Arrived::Echo,
            _ if !is_echo && reply_len == 0 => Arrived::Garbage,
            _ if reply.iter().zip(REPLY_HEAD).any(|(received, head)| *received != head) => Arrived::Garbage,
            _ if reply.len() < reply_len => Arrived::Garbage,
            _ => Arrived::All,
        };
        match heard {
            Arrived::All => self.echoes = is_echo,
            Arrived::Garbage => self.await_quiet()?,
            Arrived::Echo | Arrived::Nothing => {}
        }
        message.replied = reply_len > 0 && reply.len() == reply_len;
        bits_of(reply, &mut message.reply[..message.read_len]);
        Ok(heard)
    }

    /// The bytes that still come now do not belong to the next reply.
    fn await_quiet(&mut self) -> Result<(), Trouble> {
        for _ in 0..QUIET_READS {
            if self.device.receive(&mut [0; 64], self.limit)? == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Warns of each fault once for each driver.
    fn warn(&mut self, heard: Arrived, address: u8) {
        if heard == Arrived::All || self.warned.contains(&(heard, address)) {
            return;
        }
        self.warned.push((heard, address));
        let text = match heard {
            Arrived::All => return,
            Arrived::Nothing => "it receives nothing, not even its own message: connect RX to the driver's UART pin, and TX to it through 1 kOhm, or free the port if another program reads it (pinion doctor); said once".to_owned(),
            Arrived::Echo => format!(
                "no driver answers at address {address}: check uart_address, the driver's motor supply, and the resistor of 1 kOhm at TX; said once"
            ),
            Arrived::Garbage => {
                let faults = self.device.faults().unwrap_or_else(|| "the port counts no fault".to_owned());
                format!(
                    "the answer at address {address} is garbage ({faults}): check the wires, the resistor of 1 kOhm at TX, and that no other program uses the port (pinion doctor); said once"
                )
            }
        };
        let trouble = Trouble::new(text).of(format_args!("TMC UART {}", self.name));
        self.warning = Some(DeviceWarning::new(SUBJECT, trouble));
    }
}

/// The bytes between start and stop bits, and their number. High bits before a start bit count as a pause. A byte
/// without a stop bit ends the message, because a port cannot send it.
fn bytes_of(bits: &[u8]) -> ([u8; BYTES_MAX], usize) {
    let mut bytes = [0; BYTES_MAX];
    let (mut len, mut place) = (0, 0);
    while place + FRAME_BITS <= 8 * bits.len() {
        if bit_of(bits, place) {
            place += 1;
            continue;
        }
        if !bit_of(bits, place + FRAME_BITS - 1) {
            break;
        }
        bytes[len] = (1..9).fold(0, |byte, n| byte | u8::from(bit_of(bits, place + n)) << (n - 1));
        len += 1;
        place += FRAME_BITS;
    }
    (bytes, len)
}

/// Writes bytes with start and stop bits. The wire is high after them.
fn bits_of(bytes: &[u8], bits: &mut [u8]) {
    for (n, to) in bits.iter_mut().enumerate() {
        *to = (0..8).fold(0, |all, bit| {
            let place = 8 * n + bit;
            let byte = bytes.get(place / FRAME_BITS).map_or(u16::MAX, |byte| u16::from(*byte) << 1 | 1 << 9);
            all | u8::from(byte >> (place % FRAME_BITS) & 1 != 0) << bit
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn bytes_come_back_from_their_bits(bytes in proptest::collection::vec(any::<u8>(), 0..=BYTES_MAX)) {
            let mut bits = [0; DATA_MAX];
            bits_of(&bytes, &mut bits);
            let (back, len) = bytes_of(&bits);
            prop_assert_eq!(&back[..len], &bytes[..]);
            // Also from a message of only these bits, as klippy sends it.
            let (back, len) = bytes_of(&bits[..(FRAME_BITS * bytes.len()).div_ceil(8)]);
            prop_assert_eq!(&back[..len], &bytes[..]);
        }

        #[test]
        fn any_bits_are_some_bytes(bits in proptest::collection::vec(any::<u8>(), 0..=DATA_MAX)) {
            let (_, len) = bytes_of(&bits);
            prop_assert!(len * FRAME_BITS <= 8 * bits.len());
        }
    }

    /// The bytes of klippy's `_encode_read(0xf5, 0, 2)`.
    #[test]
    fn bits_are_klippy_s() {
        let (bytes, len) = bytes_of(&[0xea, 0x03, 0x48, 0x20, 0xe4]);
        assert_eq!(bytes[..len], [0xf5, 0x00, 0x02, 0xc8]);
        let mut bits = [0; 5];
        bits_of(&bytes[..len], &mut bits);
        assert_eq!(bits, [0xea, 0x03, 0x48, 0x20, 0xe4]);
    }
}
