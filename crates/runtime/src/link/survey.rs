// SPDX-License-Identifier: GPL-3.0-or-later
//! Makes the dictionary of a new host. It searches the board and the wire again when a host comes. A chip may have
//! appeared since the program started: its driver was loaded late at boot, or somebody has plugged it in. So the host
//! reads the present names.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use log::{error, info};

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{Dialect, Firmware, Forms, Names};
use pinion_firmware::trouble::Trouble;

use crate::core::responses::LinkWake;
use crate::trouble::refused;

/// A question to the thread.
enum Ask {
    /// Whether the board has changed.
    Look,
    /// The dictionary of these forms.
    Make(Forms),
}

/// The thread's own state.
struct Maker {
    firmware: Firmware,
    names: Names,
    rate: Option<(&'static str, u32)>,
    /// `None` if the board never changes.
    view: Option<Box<dyn Board>>,
    made: Arc<Dialect>,
}

impl Maker {
    /// The dialect, if it is another than before.
    fn answer(&mut self, ask: Ask) -> Option<Arc<Dialect>> {
        let forms = match ask {
            Ask::Look if !self.has_changed() => return None,
            Ask::Make(forms) if forms == *self.made.forms() => return Some(self.made.clone()),
            Ask::Look => self.made.forms().clone(),
            Ask::Make(forms) => forms,
        };
        match made(Dialect::with_names(&self.firmware, &self.names, forms)) {
            Ok(dialect) => self.made = dialect,
            Err(trouble) => error!("the host gets the former dictionary: {trouble}"),
        }
        Some(self.made.clone())
    }

    /// Looks at the board and the wire again.
    fn has_changed(&mut self) -> bool {
        let rate = self.firmware.wire.rate();
        let is_other_rate = std::mem::replace(&mut self.rate, rate) != rate;
        let Some(view) = &mut self.view else { return is_other_rate };
        let is_other_board = view.look_again();
        if is_other_board {
            info!("the board has changed: {}", view.describe());
            self.names = Names::of(&self.firmware, &**view);
        }
        is_other_board || is_other_rate
    }
}

fn made(dialect: io::Result<Dialect>) -> Result<Arc<Dialect>, Trouble> {
    dialect.map(Arc::new).map_err(|error| {
        refused("the board's dictionary cannot be made", error).remedy("report it, and restart Pinion")
    })
}

/// The dialect of these forms, for the board as it is now.
pub(crate) fn dialect(firmware: &Firmware, board: &dyn Board, forms: Forms) -> Result<Arc<Dialect>, Trouble> {
    made(Dialect::new(firmware, board, forms))
}

/// The thread that searches the board and makes dictionaries. It opens devices, and the link must not wait for them
/// without an end.
pub(crate) struct Surveyor {
    asks: Sender<Ask>,
    answers: Receiver<Option<Arc<Dialect>>>,
    /// A look is asked for and has not begun.
    is_look_due: Arc<AtomicBool>,
    /// Questions that are not answered yet.
    pending: usize,
    found: Option<Arc<Dialect>>,
}

impl Surveyor {
    /// Starts the thread. It wakes the link with each answer. `first` is the dialect that was made for this board.
    pub(crate) fn start(
        firmware: Firmware,
        board: &dyn Board,
        first: Arc<Dialect>,
        wake: Arc<LinkWake>,
    ) -> io::Result<Surveyor> {
        let (asks, questions) = channel();
        let (replies, answers) = channel();
        let (names, rate) = (Names::of(&firmware, board), firmware.wire.rate());
        let mut maker = Maker { firmware, names, rate, view: board.view(), made: first };
        let is_look_due = Arc::new(AtomicBool::new(false));
        let due_look = is_look_due.clone();
        thread::Builder::new().name("survey".into()).spawn(move || {
            for ask in questions {
                if matches!(ask, Ask::Look) {
                    due_look.store(false, Ordering::SeqCst);
                }
                let sent = replies.send(maker.answer(ask));
                wake.wake();
                if sent.is_err() {
                    return;
                }
            }
        })?;
        Ok(Surveyor { asks, answers, is_look_due, pending: 0, found: None })
    }

    /// Asks for the board's present devices.
    pub(crate) fn look(&mut self) {
        // A host may come and go at any rate. A look that has not begun finds whatever is there now.
        if !self.is_look_due.swap(true, Ordering::SeqCst) {
            self.ask(Ask::Look);
        }
    }

    /// Asks for the dictionary of these forms.
    pub(crate) fn make(&mut self, forms: Forms) {
        self.ask(Ask::Make(forms));
    }

    fn ask(&mut self, ask: Ask) {
        // The thread ends only with its questions.
        self.pending += usize::from(self.asks.send(ask).is_ok());
    }

    /// Whether every question is answered.
    pub(crate) fn is_done(&mut self) -> bool {
        for answer in self.answers.try_iter() {
            self.pending -= 1;
            self.found = answer.or(self.found.take());
        }
        self.pending == 0
    }

    /// The dialect, if it has changed.
    pub(crate) fn take(&mut self) -> Option<Arc<Dialect>> {
        self.found.take()
    }
}
