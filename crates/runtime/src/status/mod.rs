// SPDX-License-Identifier: GPL-3.0-or-later
//! Answers `pinion status` on a socket in the file system.
//!
//! A thread of its own serves the socket (`socket.rs`). It sends one JSON document (`form.rs`) to each client and
//! reads nothing. For the MCU's part it sends the core an empty [`Snapshot`] through a ring. It looks for its return
//! every few milliseconds. The core is not woken. It fills in the snapshot when it next passes by with no timer near.
//! So an answer may take as long as the core's nap. It costs the core one check of the ring each time that it is idle
//! anyway.

use std::thread;
use std::time::{Duration, Instant};

use rtrb::{Consumer, Producer, RingBuffer};

use pinion_firmware::mcu::{Mcu, Snapshot};
use pinion_firmware::time::Ticks;

mod document;
pub mod form;
mod socket;

pub(super) use document::{Facts, FoundHost, HostStatus};
pub use socket::connect;
pub(super) use socket::{ClientLimits, Place, StatusSocket, open as open_socket, serve_on};
pub use socket::{socket_paths, trace_socket_paths};

/// Longest wait for the core's answer. It is longer than the core's longest nap.
const ANSWER_WAIT_MAX: Duration = Duration::from_millis(1000);
/// Time between two checks for the answer.
const LOOK: Duration = Duration::from_millis(2);

/// The core's own figures, sent with the MCU's snapshot.
#[derive(Default)]
struct Answer {
    mcu: Snapshot,
    /// Requests that wait for the core.
    waiting: usize,
    /// How early the core wakes for a timer.
    margin: Ticks,
}

/// The core's end.
pub(super) struct SnapshotWriter {
    asked: Consumer<Box<Answer>>,
    answered: Producer<Box<Answer>>,
    /// The answer that is being filled in.
    at_work: Option<Box<Answer>>,
}

/// The status thread's end.
pub(super) struct SnapshotReader {
    ask: Producer<Box<Answer>>,
    answers: Consumer<Box<Answer>>,
    /// The answer while the core does not have it.
    spare: Option<Box<Answer>>,
}

/// Makes both ends.
pub(super) fn ends() -> (SnapshotWriter, SnapshotReader) {
    let (ask, asked) = RingBuffer::new(1);
    let (answered, answers) = RingBuffer::new(1);
    (SnapshotWriter { asked, answered, at_work: None }, SnapshotReader { ask, answers, spare: Some(Box::default()) })
}

impl SnapshotWriter {
    /// Whether somebody waits for an answer.
    #[inline]
    pub(super) fn is_asked(&self) -> bool {
        self.at_work.is_some() || !self.asked.is_empty()
    }

    /// Fills in the next part of the answer. Call it while no timer is near. `waiting` is how many requests wait for
    /// the core. `margin` is how early the core wakes for a timer.
    #[cold]
    pub(super) fn publish(&mut self, mcu: &Mcu, waiting: usize, margin: Ticks) {
        let Some(mut answer) = self.at_work.take().or_else(|| self.asked.pop().ok()) else { return };
        if mcu.fill(&mut answer.mcu) {
            (answer.waiting, answer.margin) = (waiting, margin);
            // There is room: at most one answer is under way.
            let _ = self.answered.push(answer);
        } else {
            self.at_work = Some(answer);
        }
    }
}

impl SnapshotReader {
    /// Asks the core, and waits for the answer. `None` if it does not come in time.
    fn ask(&mut self) -> Option<&Answer> {
        let until = Instant::now() + ANSWER_WAIT_MAX;
        // This answer came too late for the last question.
        if let Ok(late) = self.answers.pop() {
            self.spare = Some(late);
        }
        if let Some(mut answer) = self.spare.take() {
            answer.mcu.clear();
            if let Err(rtrb::PushError::Full(answer)) = self.ask.push(answer) {
                self.spare = Some(answer);
            }
        }
        while Instant::now() < until {
            if let Ok(answer) = self.answers.pop() {
                return Some(self.spare.insert(answer));
            }
            thread::sleep(LOOK);
        }
        None
    }
}
