// SPDX-License-Identifier: GPL-3.0-or-later
//! The boards of a simulated printer: each has a link, a recording and threads of its own, in one process.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use pinion::end;
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::Monotonic;
use pinion_linux::sys;
use pinion_model::{SimBoard, SimConfig};
use pinion_runtime::{Helpers, LinkName, Options, Recording};

/// How long all boards have to open their links.
const START: Duration = Duration::from_secs(10);

/// The paths of the links: the first board's, and behind its name those of the others.
pub(crate) fn links(first: &Path, config: &SimConfig) -> Vec<PathBuf> {
    links_of(first, config.mcus.iter().map(|mcu| mcu.name.as_str()))
}

/// The same for boards with these names.
pub(crate) fn links_of<'a>(first: &Path, names: impl Iterator<Item = &'a str>) -> Vec<PathBuf> {
    let beside = |name: &str| {
        let mut path = first.as_os_str().to_owned();
        path.push(format!("_{name}"));
        PathBuf::from(path)
    };
    std::iter::once(first.to_owned()).chain(names.skip(1).map(beside)).collect()
}

/// The helper processes of a board, which start before the program has threads.
pub(crate) type Started = (PathBuf, Recording, Helpers);

/// Starts the helper processes of each board. Recordings of stops go into the first of these folders that takes them. Call
/// it before any thread starts.
///
/// # Errors
///
/// There are threads already, or the kernel has no room.
pub(crate) fn start(
    links: &[PathBuf],
    clock: Monotonic,
    realtime: bool,
    folders: &[PathBuf],
) -> Result<Vec<Started>, Trouble> {
    let start = |link: &PathBuf| {
        let recording = Recording::new(clock, link, realtime, folders.to_vec())?;
        let helpers = Helpers::start(&recording, false, true, sys::SERVE)?;
        Ok((link.clone(), recording, helpers))
    };
    links.iter().map(start).collect()
}

/// The boards beside the first.
pub(crate) struct Others(Vec<JoinHandle<Result<(), Trouble>>>);

impl Others {
    /// Serves these boards on threads of their own, with the first board's options. Returns when a host may come to each
    /// of them. If one of them ends, all end.
    ///
    /// # Errors
    ///
    /// The kernel has no room for a thread.
    pub(crate) fn serve(boards: Vec<SimBoard>, started: Vec<Started>, options: &Options) -> Result<Others, Trouble> {
        let (ready, count) = (Arc::new(AtomicUsize::new(0)), boards.len());
        let mut threads = Vec::new();
        for (board, (link, recording, helpers)) in boards.into_iter().zip(started) {
            let sockets = pinion_runtime::socket_paths(&link);
            let options = Options { link: LinkName::Pty(link), sockets, ..options.clone() };
            let ready = ready.clone();
            let name = format!("board {}", board.name());
            let serve = move || {
                let timing = board.timing();
                let served = || {
                    ready.fetch_add(1, Ordering::SeqCst);
                };
                let ended =
                    pinion_runtime::run(&options, Box::new(board), timing, recording, helpers, Some(Box::new(served)));
                if let Err(trouble) = &ended {
                    log::error!("{trouble}");
                }
                end();
                ended
            };
            threads.push(pinion_runtime::started(thread::Builder::new().name(name).spawn(serve))?);
        }
        let others = Others(threads);
        let step = Duration::from_millis(5);
        let mut waited = Duration::ZERO;
        while ready.load(Ordering::SeqCst) < count && waited < START && !others.0.iter().any(JoinHandle::is_finished) {
            thread::sleep(step);
            waited += step;
        }
        Ok(others)
    }

    /// Ends them, and says whether all ended in order. The first board has ended.
    pub(crate) fn end(self) -> bool {
        if !self.0.is_empty() {
            end();
        }
        // All are joined, also after one that failed.
        let failed = self.0.into_iter().map(JoinHandle::join).filter(|ended| !matches!(ended, Ok(Ok(()))));
        failed.count() == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_board_has_a_link_beside_the_first() {
        let config = SimConfig::parse("[[mcu]]\nname = \"mcu\"\n[[mcu]]\nname = \"toolhead\"\n", "test").unwrap();
        let paths = links(Path::new("/tmp/printer"), &config);
        assert_eq!(paths, [Path::new("/tmp/printer"), Path::new("/tmp/printer_toolhead")]);
        assert_eq!(links(Path::new("/tmp/a"), &SimConfig::default_printer()), [Path::new("/tmp/a")]);
    }
}
