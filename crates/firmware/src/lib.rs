// SPDX-License-Identifier: GPL-3.0-or-later
//! A Klipper micro-controller without I/O: its scheduler, its objects and its features.
//!
//! The MCU reads the time from a given clock and asks a [`Board`](board::Board) for pins and buses. It passes slow work
//! to [`Workers`](mcu::Workers) and leaves its responses in an [`Outbox`](mcu::Outbox). So a whole MCU runs in a test,
//! in virtual time and with the same result each time.
//!
//! - [`feature`]: one file per Klipper feature, and the list of them all
//! - [`mcu`]: the MCU: oids, timers, move queue, shutdown
//! - [`board`]: the MCU's requests to the hardware, and buses made of GPIO lines
//! - [`time`], [`shutdown`], [`lateness`]: types that the others share
//!
//! # An MCU with one feature of its own, in virtual time
//!
//! The feature answers `echo` with the number that it received and the time. The board is from the crate
//! `pinion-testbench`. It records the edges that an MCU makes on its pins.
//!
//! ```
//! use std::sync::{Arc, Mutex};
//!
//! use pinion_firmware::mcu::{
//!     Dialect, DialectName, Feature, Firmware, Mcu, Note, Outbox, Response, Wire, base, place_of_response,
//! };
//! use pinion_firmware::protocol::vlq::{Reader, Writer};
//! use pinion_firmware::time::{Clock, Timing, VirtualClock};
//! use pinion_testbench::board::{Bench, FakeBoard, FakeWorkers};
//!
//! mod echo {
//!     use pinion_firmware::mcu::{Command, Feature, Response, command, response};
//!     use pinion_firmware::time::Clock;
//!
//!     pub const FEATURE: Feature =
//!         Feature { commands: &[ECHO], responses: &[Echoed::FORM], ..Feature::EMPTY };
//!
//!     response! {
//!         /// Sent responses, with their times.
//!         "echoed number=%u clock=%u"
//!         pub struct Echoed { number: u32, clock: Clock }
//!     }
//!
//!     const ECHO: Command = command!("echo number=%u", |context, number: u32| {
//!         let clock = context.now();
//!         context.send(Echoed { number, clock });
//!         Ok(())
//!     });
//! }
//!
//! const FEATURES: &[Feature] = &[base::FEATURE, echo::FEATURE];
//! const fn response_index(format: &str) -> usize {
//!     place_of_response(FEATURES, format)
//! }
//!
//! /// Keeps the MCU's responses to its host.
//! #[derive(Clone, Default)]
//! struct Said(Arc<Mutex<Vec<Vec<u8>>>>);
//!
//! impl Outbox for Said {
//!     fn send(&mut self, payload: &[u8]) {
//!         self.0.lock().unwrap().push(payload.to_vec());
//!     }
//!     fn note(&mut self, _note: Note<'_>) {}
//! }
//!
//! fn main() {
//!     let clock = VirtualClock::at(Clock::from_ticks(1000));
//!     let bench = Bench::new(clock.clone(), Clock::EPOCH);
//!     let board = FakeBoard(bench.clone());
//!     let firmware =
//!         Firmware { features: FEATURES, app: "Echo", version: "1", build_versions: "", license: "", wire: Wire::Terminal };
//!     let dialect = Dialect::new(&firmware, &board, DialectName::Master).unwrap();
//!     let (dialect, said) = (Arc::new(dialect), Said::default());
//!     let workers = Box::new(FakeWorkers::new(bench));
//!     let timing = Timing::of(Arc::new(clock));
//!     let mut mcu = Mcu::new(dialect.clone(), Box::new(board), timing, workers, Box::new(said.clone()));
//!
//!     // A host sends the command's id and its parameter.
//!     let mut command = Writer::default();
//!     command.int(dialect.command_id("echo number=%u").unwrap());
//!     command.int(42);
//!     mcu.execute(&mut Reader::new(command.payload().unwrap()));
//!
//!     let answer = said.0.lock().unwrap().pop().unwrap();
//!     let mut answer = Reader::new(&answer);
//!     assert_eq!(answer.int().ok(), dialect.response_id::<echo::Echoed>());
//!     assert_eq!((answer.int().ok(), answer.int().ok()), (Some(42), Some(1000)));
//! }
//! ```

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

pub mod board;
pub mod feature;
pub mod lateness;
pub mod mcu;
pub mod shutdown;
pub mod time;
pub mod trouble;

pub use pinion_protocol as protocol;
