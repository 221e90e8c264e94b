// SPDX-License-Identifier: GPL-3.0-or-later
//! Finds out which dialect the host speaks: from the process that has the pty open, and the sources
//! that it runs from.

#![forbid(unsafe_code)]

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use log::{info, warn};
use nix::unistd::{SysconfVar, sysconf};

use crate::klippy::Checkout;
use crate::klippy::process::{Process, Search, find};
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::DialectName;

use super::outlet::LinkWake;
use super::status::{FoundHost, HostBoard};

const PROC: &str = "/proc";

/// What to do about a host that can not be looked into.
const REMEDY: &str = "for an older one name its --dialect, or give Pinion the capabilities CAP_SYS_PTRACE and CAP_DAC_READ_SEARCH, as pinion-mcu.service has them";

/// The thread that looks for the host: it reads a few hundred files, which the link must not wait for
/// without an end.
pub(super) struct HostFinder {
    asks: Sender<u32>,
    answers: Receiver<(u32, DialectName)>,
    /// The number of the last question.
    asked: u32,
}

impl HostFinder {
    /// Starts the thread, for the host on the terminal `device`. It wakes the link with each answer, and shows on
    /// `board` whom it found.
    pub(super) fn start(device: &Path, wake: Arc<LinkWake>, board: Arc<HostBoard>) -> io::Result<HostFinder> {
        let (asks, questions) = channel();
        let (replies, answers) = channel();
        let mut looker = Looker { device: device.to_owned(), last: None, host: None, board };
        thread::Builder::new().name("host".into()).spawn(move || {
            for number in questions {
                let told = replies.send((number, looker.look()));
                wake.wake();
                if told.is_err() {
                    return;
                }
            }
        })?;
        Ok(HostFinder { asks, answers, asked: 0 })
    }

    /// Asks which dialect the host speaks that came just now.
    pub(super) fn ask(&mut self) {
        self.asked = self.asked.wrapping_add(1);
        // The thread ends only with its questions.
        let _ = self.asks.send(self.asked);
    }

    /// The answer to the last question, once it is there.
    pub(super) fn answer(&self) -> Option<DialectName> {
        self.answers.try_iter().find(|(number, _)| *number == self.asked).map(|(_, name)| name)
    }
}

/// Looks at hosts, one after the other.
struct Looker {
    device: PathBuf,
    /// The host that was seen last. A process goes on with the sources that it has loaded, whatever becomes
    /// of the files: klippy's RESTART keeps the process. One whose sources could not be read is looked at anew.
    last: Option<(Process, DialectName)>,
    /// The same for whoever asks.
    host: Option<FoundHost>,
    board: Arc<HostBoard>,
}

impl Looker {
    fn look(&mut self) -> DialectName {
        let began = Instant::now();
        self.board.found(None);
        let (process, is_sure) = match find(Path::new(PROC), &self.device) {
            Ok(Search::Found(process)) => (process, true),
            // Whichever of these it is, it runs from those sources.
            Ok(Search::Hidden(mut processes)) if same_folder(&processes) => (processes.remove(0), false),
            Ok(Search::Hidden(processes)) => {
                let pids: Vec<String> = processes.iter().map(|process| process.pid.to_string()).collect();
                let pids = pids.join(", ");
                warn!("several klippys run (processes {pids}) and none may be looked into: {}", union(REMEDY));
                return DialectName::Union;
            }
            Ok(Search::Nobody) => {
                info!("the host is no klippy that could be found: {}", union(""));
                return DialectName::Union;
            }
            Err(error) => {
                warn!("the host can not be looked for: {error}: {}", union(REMEDY));
                return DialectName::Union;
            }
        };
        if let Some((last, dialect)) = &self.last
            && (last.pid, last.started) == (process.pid, process.started)
        {
            info!("the host is the one of before, process {}: dialect {dialect}", process.pid);
            self.board.found(self.host.clone());
            return *dialect;
        }
        let mut host = FoundHost { pid: process.pid, is_sure, checkout: None, commit: None };
        let found = tell(&process, &mut host, began);
        self.host = Some(host);
        self.board.found(self.host.clone());
        self.last = found.map(|dialect| (process, dialect));
        found.unwrap_or(DialectName::Union)
    }
}

/// Whether there are processes, all of which run from one folder.
fn same_folder(processes: &[Process]) -> bool {
    let folders: Vec<_> = processes.iter().map(|process| process.klippy_folder(Path::new(PROC))).collect();
    folders.first().is_some_and(|first| first.is_some() && folders.iter().all(|folder| folder == first))
}

/// Says that the host gets the union, and what else may be done.
fn union(remedy: &str) -> String {
    let stop = if remedy.is_empty() { "" } else { "; " };
    format!("it is served as Klipper v0.13, master and Kalico{stop}{remedy}")
}

/// The dialect of a process, none if it can not be told, and a line in the log that says why. Adds to
/// `host` where it runs from.
fn tell(process: &Process, host: &mut FoundHost, began: Instant) -> Option<DialectName> {
    let pid = process.pid;
    let Some(folder) = process.klippy_folder(Path::new(PROC)) else {
        info!("the host, process {pid}, is no klippy: {}", union(""));
        return None;
    };
    let checkout = match Checkout::read(&folder, FEATURES) {
        Ok(checkout) => checkout,
        Err(error) => {
            warn!(
                "the sources of the host, process {pid}, can not be read in {}: {error}: {}",
                folder.display(),
                union(REMEDY)
            );
            return None;
        }
    };
    if let Some(unread) = &checkout.unread {
        warn!("not all of the host's sources can be read, and what those need may not work: {unread}");
    }
    let best = checkout.best();
    let inside = checkout.folder.strip_prefix(format!("{PROC}/{pid}/root")).unwrap_or(&checkout.folder);
    let inside = Path::new("/").join(inside);
    (host.checkout, host.commit) = (Some(inside.clone()), checkout.commit.clone());
    info!(
        "the host is {}klippy of {}{}, process {pid}: dialect {}, which has {} of the {} messages that it looks up (found in {} ms)",
        if host.is_sure { "" } else { "probably the " },
        inside.display(),
        checkout.commit.as_ref().map_or(String::new(), |commit| format!(" ({commit})")),
        best.generation,
        best.served.len(),
        best.served.len() + best.other.len(),
        began.elapsed().as_millis(),
    );
    let unknown: Vec<&str> = checkout.unknown().map(|shape| shape.as_str()).collect();
    if !unknown.is_empty() {
        warn!(
            "the host is newer than Pinion, which does not know these forms of messages: {}: what needs them will not work; update Pinion (pinion doctor --klipper DIR says more)",
            unknown.join("; ")
        );
    }
    if started(process).is_some_and(|started| started < checkout.newest) {
        warn!("the host's sources are newer than its process {pid}: restart klipper, so that both are one");
    }
    Some(DialectName::Of(best.generation))
}

/// When a process was started, by the clock on the wall.
fn started(process: &Process) -> Option<SystemTime> {
    let stat = std::fs::read_to_string(Path::new(PROC).join("stat")).ok()?;
    let boot_s: u64 = stat.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()?;
    let per_s = u64::try_from(sysconf(SysconfVar::CLK_TCK).ok()??).ok()?;
    // One second for the rounding of the time of the boot.
    Some(SystemTime::UNIX_EPOCH + Duration::from_secs(boot_s + process.started / per_s.max(1) + 1))
}
