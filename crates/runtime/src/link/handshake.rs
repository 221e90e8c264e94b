// SPDX-License-Identifier: GPL-3.0-or-later
//! Finds the dictionary for a new host: its dialect, and the board's present devices. The host's first bytes wait for
//! that.

use std::iter;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use log::warn;

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{Dialect, DialectName, Firmware, Wire};
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::monotonic;

use crate::FIRMWARE;

use crate::core::responses::LinkWake;
use crate::host::search::{HostFinder, HostSearch};
use crate::link::survey::{self, Surveyor};
use crate::status::HostStatus;
use crate::trouble::started;

/// How long the host's first bytes wait. After that the host gets the union dialect. Shortly after the computer's
/// start, a card may take more than a second to read the few hundred files. klippy gives up after five seconds
/// (`_start_session` in serialhdl.py).
const FIND_LIMIT: Duration = Duration::from_secs(3);

/// Finds the facts about a host.
pub(crate) struct Handshake {
    /// The dialects that a host may speak. The first one is spoken before a host comes.
    dialects: Vec<Arc<Dialect>>,
    /// The dialects before the last change of the board. They stay until the next change, so that the core never frees
    /// one.
    outdated: Vec<Arc<Dialect>>,
    /// `None` if the dialect does not depend on the host.
    finder: Option<HostFinder>,
    /// `None` if the board never changes.
    surveyor: Option<Surveyor>,
    /// The end of the wait of the host's first bytes (CLOCK_MONOTONIC). `None` while none wait.
    until: Option<Duration>,
    /// The bytes have waited too long, and the answer is still missing.
    is_overdue: bool,
}

/// The state of a handshake.
pub(crate) enum Step {
    /// The host's bytes have to wait.
    Wait,
    /// This dialect is spoken from now on.
    Speak(Arc<Dialect>),
    /// Everything is found.
    Done,
}

impl Handshake {
    /// Starts the threads that search. Call it before the link gets real-time priority, or they inherit it. `only` is
    /// the one dialect that is spoken, or `None`. `wire` is the host's wire, and `terminal` is the one that it has open.
    pub(crate) fn start(
        only: Option<DialectName>,
        board: &dyn Board,
        search: Option<HostSearch>,
        (wire, terminal): (Wire, Option<&Path>),
        wake: &Arc<LinkWake>,
        shown: &Arc<HostStatus>,
    ) -> Result<Handshake, Trouble> {
        let names = match only {
            Some(name) => vec![name],
            None => iter::once(DialectName::Union).chain(DialectName::OF_HOSTS).collect(),
        };
        let firmware = Firmware { wire, ..FIRMWARE };
        let dialects = survey::dialects(&firmware, board, &names)?;
        let search = search.filter(|_| only.is_none()).zip(terminal);
        let finder = search.map(|(search, terminal)| HostFinder::start(search, terminal, wake.clone(), shown.clone()));
        let finder = finder.map(started).transpose()?;
        let surveyor =
            board.view().map(|view| started(Surveyor::start(firmware, view, names, wake.clone()))).transpose()?;
        Ok(Handshake { dialects, outdated: Vec::new(), finder, surveyor, until: None, is_overdue: false })
    }

    /// Every host speaks this dialect, and the board never changes.
    #[cfg(fuzzing)]
    pub(crate) fn of(dialect: Arc<Dialect>) -> Handshake {
        let dialects = vec![dialect];
        Handshake { dialects, outdated: Vec::new(), finder: None, surveyor: None, until: None, is_overdue: false }
    }

    /// The dialect that is spoken before a host comes.
    pub(crate) fn first_dialect(&self) -> Arc<Dialect> {
        self.dialects[0].clone()
    }

    /// A host has come, and has `terminal` open.
    pub(crate) fn begin(&mut self, terminal: Option<&Path>) {
        if let Some(surveyor) = &mut self.surveyor {
            surveyor.ask();
        }
        if let Some(finder) = &mut self.finder {
            finder.ask(terminal);
            self.is_overdue = false;
        }
        if self.surveyor.is_some() || self.finder.is_some() {
            self.until = Some(monotonic() + FIND_LIMIT);
        }
    }

    /// The host is gone.
    pub(crate) fn end(&mut self) {
        self.until = None;
    }

    /// Goes on as far as it can. `spoken` is the present dialect. Call it again after [`Step::Speak`].
    pub(crate) fn step(&mut self, spoken: DialectName) -> Step {
        let Some(until) = self.until else {
            self.hear_late_answer();
            return Step::Done;
        };
        let is_late = monotonic() >= until;
        if let Some(surveyor) = &mut self.surveyor {
            if !surveyor.is_done() && !is_late {
                return Step::Wait;
            }
            if let Some(dialects) = surveyor.take() {
                self.outdated = std::mem::replace(&mut self.dialects, dialects);
                return self.speak(spoken);
            }
        }
        let Some(finder) = &mut self.finder else {
            self.until = None;
            return Step::Done;
        };
        let name = match finder.answer() {
            Some(name) => name,
            None if is_late => {
                warn!(
                    "the host's dialect was not found within {FIND_LIMIT:?}, so it gets the union of v0.13, master and Kalico: send RESTART, or set its dialect"
                );
                self.is_overdue = true;
                DialectName::Union
            }
            None => return Step::Wait,
        };
        self.until = None;
        self.speak(name)
    }

    fn speak(&self, name: DialectName) -> Step {
        let of_name = self.dialects.iter().find(|dialect| dialect.name() == name);
        of_name.map_or(Step::Done, |dialect| Step::Speak(dialect.clone()))
    }

    /// Hears an answer that came after the host had read another dictionary.
    fn hear_late_answer(&mut self) {
        let answer = self.finder.as_mut().filter(|_| self.is_overdue).and_then(HostFinder::answer);
        let Some(name) = answer else { return };
        self.is_overdue = false;
        if name != DialectName::Union {
            warn!("the host's dialect {name} was found too late: send RESTART to use it");
        }
    }
}
