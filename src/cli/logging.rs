// SPDX-License-Identifier: GPL-3.0-or-later
//! The log: one line an event on stderr.
//!
//! While the program serves a host no thread waits for whoever reads stderr, be it a journal that
//! stalls or a terminal stopped by Ctrl-S: lines go through a bounded queue to a thread that writes
//! them. Without that thread (it can not be there before the guardian is forked, nor in the guardian)
//! a line is written at once, or given up if nobody reads for a while.

#![forbid(unsafe_code)]

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::os::fd::AsFd;
use std::sync::{Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread;
use std::time::Duration;

use log::{Level, LevelFilter, Log, Metadata, Record};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::unistd::write;

/// Lines that wait to be written; what does not fit is lost and counted.
const LINES_MAX: usize = 512;
/// How long at most the program's end waits for a reader.
const FAREWELL: Duration = Duration::from_secs(1);
/// How long at most a line that is written at once waits for one.
const PATIENCE_MS: u16 = 1000;
/// So many bytes a pipe that is ready to be written to takes without blocking (`PIPE_BUF`).
const PIECE_BYTES: usize = 4096;

static STDERR: Stderr = Stderr { style: OnceLock::new(), queue: Mutex::new(Queue::new()), changed: Condvar::new() };

struct Stderr {
    style: OnceLock<Style>,
    queue: Mutex<Queue>,
    /// A line came, or the last one was written.
    changed: Condvar,
}

/// Lines on their way to the thread that writes them.
struct Queue {
    lines: VecDeque<String>,
    /// Lines that did not fit since this was last told.
    lost: u64,
    /// Whether there is a thread that writes.
    has_writer: bool,
    /// Whether it has a line in hand.
    is_writing: bool,
}

impl Queue {
    const fn new() -> Queue {
        Queue { lines: VecDeque::new(), lost: 0, has_writer: false, is_writing: false }
    }

    /// Takes a line in, or counts it as lost.
    fn push(&mut self, line: String) {
        if self.lines.len() < LINES_MAX {
            self.lines.push_back(line);
        } else {
            self.lost += 1;
        }
    }

    /// The next line to write. Lost lines are told of once those before them are written.
    fn pop(&mut self, style: Style) -> Option<String> {
        self.lines.pop_front().or_else(|| {
            let lost = std::mem::take(&mut self.lost);
            let were = if lost == 1 { "line of the log was" } else { "lines of the log were" };
            (lost > 0).then(|| style.line(Level::Warn, format_args!("{lost} {were} lost, as nobody read it")))
        })
    }

    fn is_done(&self) -> bool {
        self.lines.is_empty() && self.lost == 0 && !self.is_writing
    }
}

/// How lines look.
#[derive(Clone, Copy, Debug)]
enum Style {
    /// With their levels' prefixes (sd-daemon(3)).
    Journal,
    /// For people, with the seconds since the kernel's start, which are the machine's own clock.
    Plain,
}

impl Style {
    fn line(self, level: Level, text: fmt::Arguments<'_>) -> String {
        match self {
            Style::Journal => {
                let priority = match level {
                    Level::Error => 3,
                    Level::Warn => 4,
                    Level::Info => 6,
                    Level::Debug | Level::Trace => 7,
                };
                format!("<{priority}>{text}\n")
            }
            Style::Plain => {
                let now = crate::time::monotonic().as_secs_f64();
                format!("[{now:12.6}] {level:5} {text}\n")
            }
        }
    }
}

impl Stderr {
    fn style(&self) -> Style {
        let for_journal = || std::env::var_os("JOURNAL_STREAM").is_some();
        *self.style.get_or_init(|| if for_journal() { Style::Journal } else { Style::Plain })
    }

    /// The lock is held for moments only, and by nobody who writes. A panic does not spoil a queue.
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes lines as they come, for ever.
    fn write_on(&self) {
        let mut queue = self.queue();
        loop {
            match queue.pop(self.style()) {
                Some(line) => {
                    queue.is_writing = true;
                    drop(queue);
                    put(&line, PollTimeout::NONE);
                    queue = self.queue();
                    queue.is_writing = false;
                }
                None => {
                    self.changed.notify_all();
                    queue = self.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
    }
}

impl Log for Stderr {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.level() <= log::max_level()
    }

    fn log(&self, record: &Record<'_>) {
        if !self.enabled(record.metadata()) {
            return;
        }
        let line = self.style().line(record.level(), *record.args());
        let mut queue = self.queue();
        if queue.has_writer {
            queue.push(line);
            self.changed.notify_all();
        } else {
            drop(queue);
            put(&line, PATIENCE_MS.into());
        }
    }

    fn flush(&self) {}
}

/// Writes a line to stderr. What nobody reads within `patience` is given up, and so is what can not
/// be written: there is nobody to tell.
fn put(line: &str, patience: PollTimeout) {
    let stderr = io::stderr();
    let mut rest = line.as_bytes();
    while !rest.is_empty() {
        let mut fds = [PollFd::new(stderr.as_fd(), PollFlags::POLLOUT)];
        match poll(&mut fds, patience) {
            Err(Errno::EINTR) => continue,
            Ok(0) | Err(_) => return,
            Ok(_) => {}
        }
        match write(&stderr, &rest[..rest.len().min(PIECE_BYTES)]) {
            Ok(written) => rest = &rest[written..],
            Err(Errno::EINTR | Errno::EAGAIN) => {}
            Err(_) => return,
        }
    }
}

/// From now on what is logged comes out, if it is at `level` or graver.
pub(super) fn start(level: LevelFilter) {
    // Whoever has set another logger, as a test may, keeps it.
    let _ = log::set_logger(&STDERR);
    log::set_max_level(level);
}

/// From now on no thread waits for whoever reads stderr. To be called once everything is forked: a
/// thread is not.
pub(super) fn detach() {
    match thread::Builder::new().name("log".into()).spawn(|| STDERR.write_on()) {
        Ok(_) => STDERR.queue().has_writer = true,
        Err(error) => log::warn!("a log that nobody reads will stop the machine: no thread can be started: {error}"),
    }
}

/// Waits for what was logged to be read, for a second at most. What comes later is written at once.
pub(super) fn finish() {
    let mut queue = STDERR.queue();
    if queue.has_writer {
        let waited = STDERR.changed.wait_timeout_while(queue, FAREWELL, |queue| !queue.is_done());
        queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        queue.has_writer = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_is_counted_and_told_of_after_what_did() {
        let mut queue = Queue::new();
        (0..LINES_MAX + 3).for_each(|n| queue.push(n.to_string()));
        let lines: Vec<String> = std::iter::from_fn(|| queue.pop(Style::Plain)).collect();
        let (told, kept) = lines.split_last().unwrap();
        assert_eq!(kept, (0..LINES_MAX).map(|n| n.to_string()).collect::<Vec<_>>());
        assert!(told.ends_with("WARN  3 lines of the log were lost, as nobody read it\n"), "{told}");
        assert!(queue.is_done());
    }

    #[test]
    fn the_journal_gets_priorities() {
        let line = |level| Style::Journal.line(level, format_args!("the bed is hot"));
        assert_eq!(line(Level::Error), "<3>the bed is hot\n");
        assert_eq!(line(Level::Warn), "<4>the bed is hot\n");
        assert_eq!(line(Level::Info), "<6>the bed is hot\n");
        assert_eq!(line(Level::Debug), "<7>the bed is hot\n");
    }
}
