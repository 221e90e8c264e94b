// SPDX-License-Identifier: GPL-3.0-or-later
//! The messages between program and guardian. Their socket (SOCK_SEQPACKET) keeps each in one piece.
//!
//! The first byte of a message is the kind of [`Message`]. A message about a line or a file comes with its
//! descriptor. The guardian answers each with [`TAKEN`] or [`REFUSED`], except for [`Message::Goodbye`].

/// Longest message.
pub(super) const MESSAGE_BYTES: usize = 256;

/// The guardian's answer if it has carried out the message.
pub(super) const TAKEN: u8 = b'+';
/// The guardian's answer if it has not carried out the message.
pub(super) const REFUSED: u8 = b'-';

const LINE: u8 = 1;
const FILE: u8 = 2;
const LAST_FILE: u8 = 3;
const RELEASE: u8 = 4;
const GOODBYE: u8 = 5;
const FORGET: u8 = 6;

/// A message to the guardian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Message<'a> {
    /// Hold a GPIO line.
    Line {
        /// The output's name.
        name: &'a str,
        /// The level to drive it to.
        shutdown_value: bool,
        /// The name of its chip, if calls to the chip may block.
        sleeping: Option<&'a str>,
    },
    /// A file of an output that has several, and the bytes to write to it. The last file follows in
    /// [`Message::LastFile`].
    File(&'a [u8]),
    /// Hold an output of files: this is its last or only file. Nothing is held before this message. So no output is
    /// ever held with only some of its files.
    LastFile {
        /// The output's name.
        name: &'a str,
        /// The bytes to write.
        bytes: &'a [u8],
    },
    /// Drop a line that is no output any more.
    Forget {
        /// The output's name.
        name: &'a str,
    },
    /// Drop everything that is held.
    Release,
    /// End, as the program ends in order.
    Goodbye,
}

impl<'a> Message<'a> {
    /// The message as bytes. `None` if they are more than [`MESSAGE_BYTES`].
    pub(super) fn encode(&self) -> Option<Vec<u8>> {
        let message = match *self {
            Message::Line { name, shutdown_value, sleeping } => {
                [&[LINE, shutdown_value.into()], &*text(sleeping.unwrap_or(""))?, name.as_bytes()].concat()
            }
            Message::File(bytes) => [&[FILE], bytes].concat(),
            Message::LastFile { name, bytes } => [&[LAST_FILE], &*text(name)?, bytes].concat(),
            Message::Forget { name } => [&[FORGET], name.as_bytes()].concat(),
            Message::Release => vec![RELEASE],
            Message::Goodbye => vec![GOODBYE],
        };
        (message.len() <= MESSAGE_BYTES).then_some(message)
    }

    /// The message in these bytes, if they are a message.
    pub(super) fn decode(message: &'a [u8]) -> Option<Message<'a>> {
        let (kind, rest) = message.split_first()?;
        Some(match (*kind, rest) {
            (LINE, [value @ (0 | 1), rest @ ..]) => {
                let (chip, name) = split_text(rest)?;
                Message::Line {
                    name: std::str::from_utf8(name).ok()?,
                    shutdown_value: *value != 0,
                    sleeping: Some(chip).filter(|chip| !chip.is_empty()),
                }
            }
            (FILE, bytes) => Message::File(bytes),
            (LAST_FILE, rest) => {
                let (name, bytes) = split_text(rest)?;
                Message::LastFile { name, bytes }
            }
            (FORGET, name) => Message::Forget { name: std::str::from_utf8(name).ok()? },
            (RELEASE, []) => Message::Release,
            (GOODBYE, []) => Message::Goodbye,
            _ => return None,
        })
    }
}

/// A text that is followed by something: one byte with its length, then the text.
fn text(text: &str) -> Option<Vec<u8>> {
    let length = u8::try_from(text.len()).ok()?;
    Some([&[length], text.as_bytes()].concat())
}

/// Splits a result of [`text`] from the bytes that follow it.
fn split_text(bytes: &[u8]) -> Option<(&str, &[u8])> {
    let (length, rest) = bytes.split_first()?;
    let (text, rest) = rest.split_at_checked((*length).into())?;
    Some((std::str::from_utf8(text).ok()?, rest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_message_is_taken_for_what_it_is(
            kind in 0..6, name in ".{0,80}", chip in ".{0,80}", value: bool, bytes: Vec<u8>,
        ) {
            let message = match kind {
                0 => {
                    let sleeping = Some(&*chip).filter(|chip| !chip.is_empty());
                    Message::Line { name: &name, shutdown_value: value, sleeping }
                }
                1 => Message::File(&bytes),
                2 => Message::LastFile { name: &name, bytes: &bytes },
                3 => Message::Release,
                4 => Message::Forget { name: &name },
                _ => Message::Goodbye,
            };
            match message.encode() {
                Some(encoded) => {
                    prop_assert!(encoded.len() <= MESSAGE_BYTES);
                    prop_assert_eq!(Message::decode(&encoded), Some(message));
                }
                None => prop_assert!(name.len() + chip.len() + bytes.len() > MESSAGE_BYTES - 3),
            }
        }

        #[test]
        fn bytes_that_are_no_message_are_refused(bytes: Vec<u8>) {
            if let Some(message) = Message::decode(&bytes) {
                prop_assert!(message.encode().is_none_or(|encoded| encoded == bytes));
            }
        }
    }
}
