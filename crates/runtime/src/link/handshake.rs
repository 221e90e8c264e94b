// SPDX-License-Identifier: GPL-3.0-or-later
//! Finds the dictionary for a new host: its forms of messages, and the board's present devices. The host's first bytes
//! wait for that.

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
use crate::host::search::{FoundHost, HostFinder, HostSearch};
use crate::link::survey::{self, Surveyor};
use crate::status::HostStatus;
use crate::trouble::started;

/// How long the host's first bytes wait. After that the host gets the union dialect. Shortly after the computer's
/// start, a card may take more than a second to read the few hundred files. klippy gives up after five seconds
/// (`_start_session` in serialhdl.py).
const FIND_LIMIT: Duration = Duration::from_secs(3);

/// Finds the facts about a host.
pub(crate) struct Handshake {
    /// The dialect that is spoken before a host comes, and to a host about which nothing was found in time.
    first: Arc<Dialect>,
    /// The dialects that the core may have. They stay here, so that the core never frees one.
    kept: Vec<Arc<Dialect>>,
    /// `None` if the dialect does not depend on the host.
    finder: Option<HostFinder>,
    /// `None` in a test without a board.
    surveyor: Option<Surveyor>,
    /// The end of the wait of the host's first bytes (CLOCK_MONOTONIC). `None` while none wait.
    until: Option<Duration>,
    /// The search for the host has to answer.
    is_finding: bool,
    /// The bytes have waited too long, and the answer is still missing.
    is_overdue: bool,
    /// Somebody stopped the MCU since the host came, so the host has to see that.
    is_stopped: bool,
}

/// The state of a handshake.
pub(crate) enum Step {
    /// The host's bytes have to wait.
    Wait,
    /// The process that configured the MCU is gone, and another one has come.
    Renew,
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
        let firmware = Firmware { wire, ..FIRMWARE };
        let first = survey::dialect(&firmware, board, only.unwrap_or(DialectName::Union).into())?;
        let search = search.filter(|_| only.is_none()).zip(terminal);
        let finder = search.map(|(search, terminal)| HostFinder::start(search, terminal, wake.clone(), shown.clone()));
        let finder = finder.map(started).transpose()?;
        let surveyor = Some(started(Surveyor::start(firmware, board, first.clone(), wake.clone()))?);
        Ok(Handshake { surveyor, finder, ..Handshake::of(first) })
    }

    /// Every host speaks this dialect, and the board never changes.
    pub(crate) fn of(first: Arc<Dialect>) -> Handshake {
        let kept = vec![first.clone()];
        Handshake {
            first,
            kept,
            finder: None,
            surveyor: None,
            until: None,
            is_finding: false,
            is_overdue: false,
            is_stopped: false,
        }
    }

    /// The dialect that is spoken before a host comes.
    pub(crate) fn first_dialect(&self) -> Arc<Dialect> {
        self.first.clone()
    }

    /// A host has come, and has `terminal` open.
    pub(crate) fn begin(&mut self, terminal: Option<&Path>) {
        let Some(surveyor) = &mut self.surveyor else { return };
        surveyor.look();
        self.is_stopped = false;
        self.until = Some(monotonic() + FIND_LIMIT);
        if let Some(finder) = &mut self.finder {
            finder.ask(terminal);
            self.is_finding = true;
            self.is_overdue = false;
        }
    }

    /// Somebody stops the MCU. The present host is to see that, even if it is another than before.
    pub(crate) fn stop(&mut self) {
        self.is_stopped = true;
    }

    /// The host is gone.
    pub(crate) fn end(&mut self) {
        self.until = None;
    }

    /// Goes on as far as it can. Call it again until it is [`Step::Wait`] or [`Step::Done`].
    pub(crate) fn step(&mut self) -> Step {
        let (Some(until), Some(surveyor)) = (self.until, &mut self.surveyor) else {
            return self.late_answer();
        };
        if self.is_finding
            && let Some(FoundHost { forms, is_other }) = self.finder.as_mut().and_then(HostFinder::answer)
        {
            self.is_finding = false;
            surveyor.make(forms);
            if is_other && !self.is_stopped {
                return Step::Renew;
            }
        }
        let is_late = monotonic() >= until;
        if !is_late && (self.is_finding || !surveyor.is_done()) {
            return Step::Wait;
        }
        self.until = None;
        let found = surveyor.take();
        if self.is_finding || self.finder.is_some() && !surveyor.is_done() {
            warn!(
                "the host's messages were not found within {FIND_LIMIT:?}, so it gets the union of v0.13, master and Kalico: send RESTART, or set its dialect"
            );
            self.is_overdue = self.is_finding;
            return self.speak(self.first.clone());
        }
        found.map_or(Step::Done, |dialect| self.speak(dialect))
    }

    fn speak(&mut self, dialect: Arc<Dialect>) -> Step {
        self.kept.retain(|kept| Arc::strong_count(kept) > 1);
        self.kept.push(dialect.clone());
        Step::Speak(dialect)
    }

    /// Takes an answer that came after the host had read another dictionary, which it keeps.
    fn late_answer(&mut self) -> Step {
        let answer = self.finder.as_mut().filter(|_| self.is_overdue).and_then(HostFinder::answer);
        let Some(FoundHost { forms, .. }) = answer else { return Step::Done };
        self.is_overdue = false;
        if forms != *self.first.forms() {
            warn!("the host's messages were found too late: send RESTART to use them");
        }
        // The same dialect: the link notes who the host is when it speaks.
        Step::Speak(self.first.clone())
    }
}
