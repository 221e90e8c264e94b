// SPDX-License-Identifier: GPL-3.0-or-later
//! Searches the board and the wire again when a host comes. A chip may have appeared since the program started: its
//! driver was loaded late at boot, or somebody has plugged it in. So the host reads the present names.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use log::{error, info};

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{Dialect, DialectName, Firmware};
use pinion_firmware::trouble::Trouble;

use crate::core::responses::LinkWake;
use crate::trouble::refused;

/// The dialects of these names, for the board as it is now.
pub(crate) fn dialects(
    firmware: &Firmware,
    board: &dyn Board,
    names: &[DialectName],
) -> Result<Vec<Arc<Dialect>>, Trouble> {
    let made = names.iter().map(|name| Dialect::new(firmware, board, *name).map(Arc::new)).collect::<io::Result<_>>();
    made.map_err(|error| {
        refused("the board's dictionary cannot be made", error).remedy("report it, and restart Pinion")
    })
}

/// The thread that searches the board. It opens devices, and the link must not wait for them without an end.
pub(crate) struct Surveyor {
    asks: Sender<()>,
    answers: Receiver<Option<Vec<Arc<Dialect>>>>,
    /// Questions that are not answered yet.
    pending: usize,
    found: Option<Vec<Arc<Dialect>>>,
}

impl Surveyor {
    /// Starts the thread, on a view of the board. It wakes the link with each answer.
    pub(crate) fn start(
        firmware: Firmware,
        mut view: Box<dyn Board>,
        names: Vec<DialectName>,
        wake: Arc<LinkWake>,
    ) -> io::Result<Surveyor> {
        let (asks, questions) = channel();
        let (replies, answers) = channel();
        thread::Builder::new().name("survey".into()).spawn(move || {
            let mut rate = firmware.wire.rate();
            for () in questions {
                let is_other_board = view.look_again();
                if is_other_board {
                    info!("the board has changed: {}", view.describe());
                }
                let is_other_rate = firmware.wire.rate() != rate;
                rate = firmware.wire.rate();
                let found = (is_other_board || is_other_rate).then(|| dialects(&firmware, &*view, &names));
                let found = found.transpose().unwrap_or_else(|trouble| {
                    error!("the host gets the board's former names: {trouble}");
                    None
                });
                let sent = replies.send(found);
                wake.wake();
                if sent.is_err() {
                    return;
                }
            }
        })?;
        Ok(Surveyor { asks, answers, pending: 0, found: None })
    }

    /// Asks for the board's present devices.
    pub(crate) fn ask(&mut self) {
        // A host may come and go at any rate. A question behind the first one is not begun yet, so its answer is new.
        let _ = self.is_done();
        if self.pending > 1 {
            return;
        }
        // The thread ends only with its questions.
        self.pending += usize::from(self.asks.send(()).is_ok());
    }

    /// Whether every question is answered.
    pub(crate) fn is_done(&mut self) -> bool {
        for answer in self.answers.try_iter() {
            self.pending -= 1;
            self.found = answer.or(self.found.take());
        }
        self.pending == 0
    }

    /// The dialects for the board as it is now, if it has changed.
    pub(crate) fn take(&mut self) -> Option<Vec<Arc<Dialect>>> {
        self.found.take()
    }
}
