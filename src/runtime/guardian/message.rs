// SPDX-License-Identifier: GPL-3.0-or-later
//! What program and guardian say to each other, over a socket that keeps messages whole.
//!
//! A message is a byte that tells its kind, and what [`Message`] says of it. Those about a line or
//! a file come with its descriptor. To each but the last the guardian answers [`TAKEN`] or
//! [`REFUSED`].

#![forbid(unsafe_code)]

/// No message is longer.
pub(super) const MESSAGE_BYTES: usize = 256;

/// The guardian has done what it was told.
pub(super) const TAKEN: u8 = b'+';
/// It has not.
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
    /// A line to hold.
    Line {
        /// The output's name.
        name: &'a str,
        /// Where it belongs.
        shutdown_value: bool,
        /// Its chip, if calls of that may sleep.
        sleeping: Option<&'a str>,
    },
    /// A file of an output that has more of them, and what is to be written to it.
    File(&'a [u8]),
    /// The last or only file of an output, and what is to be written to it. Only with this one the
    /// output is held, so that none is held by half.
    LastFile {
        /// The output's name.
        name: &'a str,
        /// What is to be written.
        bytes: &'a [u8],
    },
    /// Give back an output, which is none any more.
    Forget {
        /// The output's name.
        name: &'a str,
    },
    /// Give everything back.
    Release,
    /// The program ends in order.
    Goodbye,
}

impl<'a> Message<'a> {
    /// Its bytes; none if they are too many.
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

    /// The message that these bytes are, if they are one.
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

/// A text that something follows: its length and itself.
fn text(text: &str) -> Option<Vec<u8>> {
    let length = u8::try_from(text.len()).ok()?;
    Some([&[length], text.as_bytes()].concat())
}

/// The text at the beginning, and what follows it.
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
