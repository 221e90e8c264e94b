// SPDX-License-Identifier: GPL-3.0-or-later
//! How long klippy and the simulated MCUs waited because this computer did something else.
//!
//! klippy stops if it or an MCU is late. A busy computer is a reason that says nothing about a printer.cfg.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

/// Time between two reads of the kernel's accounts.
const READ: Duration = Duration::from_millis(50);
/// Beginnings of the names of the threads that must be in time: those that run an MCU, and their links to klippy.
const OURS: &[&str] = &["core", "pinion-sim", "board "];
/// All threads of another program.
const ALL: &[&str] = &[""];
/// The threads of this program.
const OWN: &str = "/proc/self/task";

/// Watches a klippy, until it is dropped.
pub(super) struct Stalls {
    longest_ns: Arc<AtomicU64>,
    _stop: mpsc::Sender<()>,
}

impl Stalls {
    /// Watches the klippy with this process number, and the MCUs of this program.
    pub(super) fn watch(klippy: u32) -> Stalls {
        let longest_ns = Arc::new(AtomicU64::new(0));
        let (stop, stopped) = mpsc::channel();
        let longest = longest_ns.clone();
        let watched = thread::Builder::new().name("stalls".into()).spawn(move || {
            let mut accounts = Accounts::default();
            let klippys = PathBuf::from(format!("/proc/{klippy}/task"));
            let mut since = Instant::now();
            while stopped.recv_timeout(READ) == Err(RecvTimeoutError::Timeout) {
                // If the whole computer stands still, only the clock shows it.
                let late = since.elapsed().saturating_sub(READ);
                since = Instant::now();
                let own = accounts.new_wait(Path::new("/proc/thread-self")).unwrap_or(late);
                let waits = [accounts.longest_wait(&klippys, ALL), accounts.longest_wait(Path::new(OWN), OURS)];
                let wait = waits.into_iter().flatten().fold(late.saturating_sub(own), Duration::max);
                longest.fetch_max(wait.as_nanos() as u64, Ordering::Relaxed);
            }
        });
        if let Err(error) = watched {
            log::warn!("it will not show how long klippy waits for a processor: no thread can be started: {error}");
        }
        Stalls { longest_ns, _stop: stop }
    }

    /// The longest wait since the last call.
    pub(super) fn take(&self) -> Duration {
        Duration::from_nanos(self.longest_ns.swap(0, Ordering::Relaxed))
    }
}

/// The kernel's accounts of threads (Documentation/scheduler/sched-stats.rst). Not every kernel has them.
#[derive(Default)]
struct Accounts {
    /// How long each thread has waited for a processor, in nanoseconds.
    waited_ns: HashMap<PathBuf, u64>,
}

impl Accounts {
    /// How long this thread has waited since the last call.
    fn new_wait(&mut self, thread: &Path) -> Option<Duration> {
        let account = fs::read_to_string(thread.join("schedstat")).ok()?;
        let now = account.split_whitespace().nth(1)?.parse().ok()?;
        let before = self.waited_ns.insert(thread.to_owned(), now).unwrap_or(now);
        Some(Duration::from_nanos(now.saturating_sub(before)))
    }

    /// The longest wait since the last call of a thread in this folder. Only names with one of these beginnings count.
    fn longest_wait(&mut self, folder: &Path, names: &[&str]) -> Option<Duration> {
        let threads = fs::read_dir(folder).ok()?.flatten().map(|thread| thread.path());
        let counts = |thread: &PathBuf| {
            let name = fs::read_to_string(thread.join("comm")).unwrap_or_default();
            names.iter().any(|beginning| name.starts_with(beginning))
        };
        threads.filter(counts).filter_map(|thread| self.new_wait(&thread)).max()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_wait_of_the_named_threads_counts() {
        let folder = tempfile::tempdir().unwrap();
        let thread = |id: &str, name: &str, account: &str| {
            let thread = folder.path().join(id);
            fs::create_dir_all(&thread).unwrap();
            fs::write(thread.join("comm"), format!("{name}\n")).unwrap();
            fs::write(thread.join("schedstat"), account).unwrap();
        };
        let mut accounts = Accounts::default();
        thread("7", "core", "900 1000 1");
        thread("8", "board tool", "900 1000 1");
        thread("9", "recorder", "900 1000 1");
        assert_eq!(accounts.longest_wait(folder.path(), ALL), Some(Duration::ZERO), "since when");
        thread("7", "core", "950 31000 1");
        thread("8", "board tool", "950 1500 1");
        thread("9", "recorder", "950 91000 1");
        assert_eq!(accounts.longest_wait(folder.path(), OURS), Some(Duration::from_nanos(30_000)));
        assert_eq!(accounts.longest_wait(folder.path(), ALL), Some(Duration::from_nanos(90_000)));
        assert_eq!(accounts.longest_wait(Path::new("/nonexistent"), ALL), None);
    }
}
