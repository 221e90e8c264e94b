// SPDX-License-Identifier: GPL-3.0-or-later
//! The bytes of Klipper's micro-controller protocol, as in its docs/Protocol.md. There is no I/O and no state of an
//! MCU.
//!
//! - [`vlq`]: integers and byte strings of a message
//! - [`mod@format`]: a message's format, for example `get_clock` or `clock clock=%u`
//! - [`block`]: the numbered and checked blocks that carry messages
//! - [`dictionary`]: the description of an MCU: its messages, constants and names
//! - [`clock`]: times of an MCU's clock; 32 bits of a time go over the wire
//!
//! # A client that talks to any Klipper MCU
//!
//! It reads the MCU's dictionary and asks for the time. (It asks once. A real client asks again if a block was lost.)
//!
//! ```no_run
//! use std::fs::File;
//! use std::io::{self, Read, Write};
//!
//! use pinion_protocol::block::{Resynced, Resync, Sequence, frame};
//! use pinion_protocol::dictionary::{Dictionary, IDENTIFY_ID, IDENTIFY_RESPONSE_ID};
//! use pinion_protocol::vlq::{Reader, Writer};
//!
//! struct Client {
//!     tty: File,
//!     received: Vec<u8>,
//!     resync: Resync,
//!     sent: u32,
//! }
//!
//! impl Client {
//!     /// Sends a command, and returns the parameters of the response with this id.
//!     fn ask(&mut self, command: &[u32], response: i64) -> io::Result<Vec<u8>> {
//!         let mut message = Writer::default();
//!         command.iter().for_each(|int| message.int(*int));
//!         let mut block = Vec::new();
//!         frame(message.payload().unwrap_or_default(), Sequence::after(self.sent), &mut block);
//!         self.sent += 1;
//!         self.tty.write_all(&block)?;
//!         loop {
//!             let mut bytes = [0; 4096];
//!             let length = self.tty.read(&mut bytes)?;
//!             self.received.extend_from_slice(&bytes[..length]);
//!             loop {
//!                 let (length, found) = self.resync.next(&self.received);
//!                 let answer = match found {
//!                     Resynced::Nothing => break,
//!                     Resynced::Garbage { .. } => None,
//!                     Resynced::Block(_, payload) => {
//!                         let mut reader = Reader::new(payload);
//!                         let id = reader.int().map(|id| i64::from(id as i32));
//!                         (id == Ok(response)).then(|| reader.rest().to_vec())
//!                     }
//!                 };
//!                 self.received.drain(..length);
//!                 if let Some(answer) = answer {
//!                     return Ok(answer);
//!                 }
//!             }
//!         }
//!     }
//! }
//!
//! fn main() -> io::Result<()> {
//!     let tty = File::options().read(true).write(true).open("/tmp/klipper_host_mcu")?;
//!     let mut client = Client { tty, received: Vec::new(), resync: Resync::default(), sent: 0 };
//!
//!     let cut = |_| io::Error::other("a message ends early");
//!     let mut compressed = Vec::new();
//!     loop {
//!         // identify offset=%u count=%c; identify_response offset=%u data=%.*s
//!         let command = [IDENTIFY_ID as u32, compressed.len() as u32, 40];
//!         let answer = client.ask(&command, IDENTIFY_RESPONSE_ID.into())?;
//!         let mut answer = Reader::new(&answer);
//!         answer.int().map_err(cut)?;
//!         match answer.bytes().map_err(cut)? {
//!             [] => break,
//!             piece => compressed.extend_from_slice(piece),
//!         }
//!     }
//!     let dictionary = Dictionary::decompress(&compressed)?;
//!     println!("{} has {} commands", dictionary.version, dictionary.commands.len());
//!
//!     let id = |of: &serde_json::Value| of.as_i64().ok_or_else(|| io::Error::other("an id is no number"));
//!     let get_clock = id(&dictionary.commands["get_clock"])?;
//!     let answer = client.ask(&[get_clock as u32], id(&dictionary.responses["clock clock=%u"])?)?;
//!     println!("its clock is {}", Reader::new(&answer).int().map_err(cut)?);
//!     Ok(())
//! }
//! ```

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod block;
pub mod clock;
mod crc;
pub mod dictionary;
pub mod format;
pub mod vlq;

/// The bytes end before the message does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;
