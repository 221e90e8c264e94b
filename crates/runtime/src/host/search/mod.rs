// SPDX-License-Identifier: GPL-3.0-or-later
//! Finds the forms of messages that the host looks up. It looks for the process that has the pty open, and for its sources.
//!
//! That takes capabilities that open every file and every process of the computer. And it reads files that a host has
//! written. So a process of its own does it, forked before the program has threads. That process keeps only these
//! capabilities. Its only descriptor is the socket to the program. The kernel lets it read files and nothing more
//! (`sys/filter.rs`). It gets a terminal's number. It answers with forms, the host that it found, and lines for the
//! log. The program keeps none of those capabilities, and trusts no answer.
//!
//! This file is the program's side. `looker.rs` is the process. `message.rs` has the messages between them.

mod looker;
mod message;

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::thread;

use log::{Level, log, warn};
use nix::errno::Errno;
use nix::sys::socket::{AddressFamily, MsgFlags, SockFlag, SockType, recv, send, setsockopt, socketpair, sockopt};
use nix::sys::time::{TimeVal, TimeValLike as _};

use crate::host::klippy::terminal::Terminal;
use pinion_firmware::mcu::{DialectName, Forms};
use pinion_firmware::trouble::Trouble;
use pinion_linux::sys;

use crate::core::responses::LinkWake;
use crate::process::forked::THREADS_MAX;
use crate::status::HostStatus;
use crate::trouble::{NO_PROCESS, refused};
use message::{Answer, Hello, MESSAGE_BYTES_MAX, Question};

pub(crate) use looker::NAME;
#[cfg(fuzzing)]
pub(crate) use message::fuzz;

/// How long the new process may take to be ready, in seconds.
const START_S: i64 = 5;

/// The search, before its first question.
pub struct HostSearch(OwnedFd);

impl HostSearch {
    /// Forks the process. Call it before any thread starts.
    pub(crate) fn start() -> Result<HostSearch, Trouble> {
        let started = HostSearch::try_start();
        started.map_err(|error| refused("the search for the host cannot be started", error).remedy(NO_PROCESS))
    }

    fn try_start() -> io::Result<HostSearch> {
        let (socket, theirs) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, SockFlag::SOCK_CLOEXEC)?;
        setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::seconds(START_S))?;
        sys::fork(THREADS_MAX, move || {
            looker::live(&theirs);
            0
        })?;
        let mut message = vec![0; MESSAGE_BYTES_MAX];
        let hello = match receive(&socket, &mut message) {
            Ok(hello) => serde_json::from_slice::<Hello>(hello).map_err(io::Error::other)?,
            Err(Errno::EAGAIN) => return Err(io::Error::other(format!("it is not ready within {START_S} s"))),
            Err(error) => return Err(error.into()),
        };
        if let Some(why) = hello.unconfined {
            warn!(
                "the search for the host is not confined, and may do more than it needs: {why}: use a kernel with seccomp filters"
            );
        }
        setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::seconds(0))?;
        Ok(HostSearch(socket))
    }
}

/// The next message, if it is not too long.
fn receive<'a>(socket: &OwnedFd, message: &'a mut [u8]) -> nix::Result<&'a [u8]> {
    loop {
        return match recv(socket.as_raw_fd(), message, MsgFlags::MSG_TRUNC) {
            Err(Errno::EINTR) => continue,
            Err(error) => Err(error),
            Ok(0) => Err(Errno::ECONNRESET),
            Ok(len) => message.get(..len).ok_or(Errno::EMSGSIZE),
        };
    }
}

/// What the search found out about a host.
pub(crate) struct FoundHost {
    /// The forms of messages for it.
    pub(crate) forms: Forms,
    /// The process of the host before is gone, and this is another one.
    pub(crate) is_other: bool,
}

impl FoundHost {
    /// Nothing is known.
    const NOTHING: FoundHost = FoundHost { forms: Forms::Dialect(DialectName::Union), is_other: false };
}

/// The link's way to the search. A thread receives the answers.
pub(crate) struct HostFinder {
    socket: Arc<OwnedFd>,
    terminal: Terminal,
    board: Arc<HostStatus>,
    answers: Receiver<(u32, FoundHost)>,
    /// The number of the last question.
    asked: u32,
    /// The last question waits until the search has answered the one before it. A host may come and go at any rate, and
    /// the search must not answer all of them before the last one.
    waits: bool,
    is_busy: bool,
}

impl HostFinder {
    /// Lets the search look for the host on the terminal `device`. Each answer wakes the link, and `board` shows the
    /// host that was found.
    pub(crate) fn start(
        search: HostSearch,
        device: &Path,
        wake: Arc<LinkWake>,
        board: Arc<HostStatus>,
    ) -> io::Result<HostFinder> {
        let terminal = Terminal::of(device)?;
        let socket = Arc::new(search.0);
        let (sender, answers) = channel();
        let (monitor, shown) = (socket.clone(), board.clone());
        thread::Builder::new().name("host".into()).spawn(move || {
            let mut message = vec![0; MESSAGE_BYTES_MAX];
            // This ends when nobody asks any more.
            while let Ok(bytes) = receive(&monitor, &mut message) {
                let Some(answer) = Answer::decode(bytes) else { break };
                for line in &answer.lines {
                    log!(if line.is_warning { Level::Warn } else { Level::Info }, "{}", line.text);
                }
                let found = FoundHost { forms: answer.forms(), is_other: answer.is_other };
                shown.found(answer.host);
                let sent = sender.send((answer.number, found));
                wake.wake();
                if sent.is_err() {
                    return;
                }
            }
            warn!("the search for the host has ended or sent invalid data, so every host gets the union of v0.13, master and Kalico: restart Pinion when no print runs");
            drop(sender);
            wake.wake();
        })?;
        Ok(HostFinder { socket, terminal, board, answers, asked: 0, waits: false, is_busy: false })
    }

    /// Asks for the forms of the host that came just now, on the terminal `device`.
    pub(crate) fn ask(&mut self, device: Option<&Path>) {
        if let Some(Ok(terminal)) = device.map(Terminal::of) {
            self.terminal = terminal;
        }
        self.asked = self.asked.wrapping_add(1);
        self.board.found(None);
        self.waits = true;
        // The answers to earlier questions are of no use now.
        let _ = self.answer();
    }

    /// The answer to the last question, if it has come.
    pub(crate) fn answer(&mut self) -> Option<FoundHost> {
        loop {
            match self.answers.try_recv() {
                Ok((number, found)) => {
                    self.is_busy = false;
                    if number == self.asked {
                        return Some(found);
                    }
                }
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return Some(FoundHost::NOTHING),
            }
        }
        if self.waits && !self.is_busy {
            let question = Question { number: self.asked, terminal: self.terminal };
            // If the search hangs, the link waits as long as for an answer. If the search is gone, it gives no answer.
            let flags = MsgFlags::MSG_NOSIGNAL | MsgFlags::MSG_DONTWAIT;
            let sent = send(self.socket.as_raw_fd(), &serde_json::to_vec(&question).unwrap_or_default(), flags);
            (self.waits, self.is_busy) = (false, sent.is_ok());
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_many_hosts_that_come_and_go_only_the_last_one_waits_for_an_answer() {
        let (socket, search) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, SockFlag::empty()).unwrap();
        let wake = Arc::new(LinkWake::new().unwrap());
        let mut finder = HostFinder::start(HostSearch(socket), Path::new("/dev/null"), wake, Arc::default()).unwrap();
        (0..1000).for_each(|_| finder.ask(None));
        let mut message = vec![0; MESSAGE_BYTES_MAX];
        let mut number = || {
            let question: Question = serde_json::from_slice(receive(&search, &mut message).unwrap()).unwrap();
            question.number
        };
        let answer = |number: u32| {
            let answer = Answer::new(number, None, true, None, Vec::new());
            send(search.as_raw_fd(), &serde_json::to_vec(&answer).unwrap(), MsgFlags::empty()).unwrap();
        };
        assert_eq!(number(), 1);
        answer(1);
        while finder.is_busy && finder.waits {
            assert!(finder.answer().is_none());
            thread::yield_now();
        }
        assert_eq!(number(), 1000);
        answer(1000);
        let found = std::iter::repeat_with(|| finder.answer()).find_map(|found| found).unwrap();
        assert!(found.is_other, "it is the search's answer");
    }
}
