// SPDX-License-Identifier: GPL-3.0-or-later
//! The log: one line on stderr for each event.
//!
//! While the program serves a host, no thread may block because nobody reads stderr. A journal may stall, and Ctrl-S
//! may stop a terminal. So lines go through a bounded queue to a thread that writes them. Before the guardian is forked
//! there can be no thread, and the guardian has none. There, a line is written at once, and dropped if nobody reads it
//! for a second.
//!
//! A host or a client can cause some lines as often as it likes. So lines of one kind have a limit. Lines above it are
//! counted, and one line reports them.

use std::collections::VecDeque;
use std::fmt;
use std::fs::File;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::MetadataExt;
use std::sync::{Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread;
use std::time::Duration;

use log::{Level, LevelFilter, Log, Metadata, Record};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::unistd::write;

use pinion_linux::clock::monotonic;
use pinion_linux::foreign::plain;

use crate::started;

/// Highest number of lines that may wait to be written. Further ones are dropped and counted.
const LINES_MAX: usize = 512;
/// How long the program's end waits until the queue is written.
const FAREWELL: Duration = Duration::from_secs(1);
/// How long a line that is written at once may wait for a reader, in milliseconds.
const WRITE_TIMEOUT_MS: u16 = 1000;
/// How many bytes a pipe takes without blocking once poll(2) says that it can be written (`PIPE_BUF`).
const PIECE_BYTES: usize = 4096;

/// Highest number of lines of one kind within [`PERIOD`]. Further ones are left out and counted. Each of a printer's
/// outputs may have a line at a stop.
const KIND_LINES_MAX: u32 = 50;
/// How long the lines of a kind are counted.
const PERIOD: Duration = Duration::from_secs(60);

static STDERR: Stderr = Stderr { style: OnceLock::new(), queue: Mutex::new(Queue::new()), changed: Condvar::new() };

struct Stderr {
    style: OnceLock<Style>,
    queue: Mutex<Queue>,
    /// Notified when a line comes, and when the queue has been written.
    changed: Condvar,
}

/// Lines on their way to the thread that writes them.
struct Queue {
    lines: VecDeque<String>,
    /// How many lines were dropped since the log last said so.
    lost: u64,
    /// Whether there is a thread that writes.
    has_writer: bool,
    /// Whether that thread is writing a line, which is no longer in the queue.
    is_writing: bool,
    /// The kinds of lines so far.
    kinds: Vec<Kind>,
}

/// Lines from one place of the program, or about one thing.
struct Kind {
    target: String,
    place: Option<u32>,
    /// How many lines have come since `since` (CLOCK_MONOTONIC).
    lines: u32,
    since: Duration,
    /// How many of these were left out.
    left_out: u64,
    /// The last line that was not left out.
    level: Level,
    text: String,
}

impl Queue {
    const fn new() -> Queue {
        Queue { lines: VecDeque::new(), lost: 0, has_writer: false, is_writing: false, kinds: Vec::new() }
    }

    /// Appends a line if there are not too many of its kind already.
    fn take(&mut self, record: &Record<'_>, style: Style, now: Duration) {
        self.report(style, now);
        if record.level() > Level::Info {
            // A user who asks for details gets all of them.
            return self.push(style.line(record.level(), *record.args()));
        }
        let (target, place) = (record.target(), record.line());
        let known = self.kinds.iter().position(|kind| kind.target == target && kind.place == place);
        let kind = known.unwrap_or(self.kinds.len());
        if known.is_none() {
            let (target, text) = (target.to_owned(), String::new());
            self.kinds.push(Kind { target, place, lines: 0, since: now, left_out: 0, level: Level::Info, text });
        }
        let kind = &mut self.kinds[kind];
        if now >= kind.since + PERIOD {
            (kind.lines, kind.since) = (0, now);
        }
        if kind.lines == KIND_LINES_MAX {
            kind.left_out += 1;
            return;
        }
        kind.lines += 1;
        kind.level = record.level();
        kind.text = record.args().to_string();
        let line = style.line(kind.level, *record.args());
        self.push(line);
    }

    /// Reports the lines that were left out, of each kind whose period is over.
    fn report(&mut self, style: Style, now: Duration) {
        for kind in 0..self.kinds.len() {
            let kind = &mut self.kinds[kind];
            if kind.left_out > 0 && now >= kind.since + PERIOD {
                let were = if kind.left_out == 1 { "line like this was" } else { "lines like this were" };
                let left_out = std::mem::take(&mut kind.left_out);
                let line = style.line(kind.level, format_args!("{left_out} more {were} left out: {}", kind.text));
                self.push(line);
            }
        }
    }

    /// When to report lines that were left out (CLOCK_MONOTONIC).
    fn due(&self) -> Option<Duration> {
        self.kinds.iter().filter(|kind| kind.left_out > 0).map(|kind| kind.since + PERIOD).min()
    }

    /// Appends a line, or counts it as lost if there is no room.
    fn push(&mut self, line: String) {
        if self.lines.len() < LINES_MAX {
            self.lines.push_back(line);
        } else {
            self.lost += 1;
        }
    }

    /// The next line to write. After the last one comes a line with the number of lost lines.
    fn pop(&mut self, style: Style) -> Option<String> {
        self.lines.pop_front().or_else(|| {
            let lost = std::mem::take(&mut self.lost);
            let were = if lost == 1 { "line of the log was" } else { "lines of the log were" };
            (lost > 0).then(|| style.line(Level::Warn, format_args!("{lost} {were} lost, because nobody read the log")))
        })
    }

    fn is_done(&self) -> bool {
        self.lines.is_empty() && self.lost == 0 && !self.is_writing
    }
}

/// The form of a line.
#[derive(Clone, Copy, Debug)]
enum Style {
    /// For the journal: with the level as a prefix (sd-daemon(3)).
    Journal,
    /// For people: with the level and the time in seconds of CLOCK_MONOTONIC. The MCU's own clock runs by it too.
    Plain,
    /// For the user of a command that serves no host: with the level, as an error in the command line has it.
    Command,
}

impl Style {
    /// The journal's, or this one.
    fn for_stderr(other: Style) -> Style {
        let is_journal = std::env::var("JOURNAL_STREAM").is_ok_and(|journal| is_same(&journal, io::stderr().as_fd()));
        if is_journal { Style::Journal } else { other }
    }

    fn line(self, level: Level, text: fmt::Arguments<'_>) -> String {
        let text = text.to_string();
        // A line feed in a name would begin a new line, and with `<0>` a line of any priority.
        let text = plain(&text);
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
                let now = monotonic().as_secs_f64();
                format!("[{now:12.6}] {level:5} {text}\n")
            }
            Style::Command => format!("{}: {text}\n", level.as_str().to_lowercase()),
        }
    }
}

impl Stderr {
    fn style(&self) -> Style {
        *self.style.get_or_init(|| Style::for_stderr(Style::Plain))
    }

    /// Locks the queue. Nobody holds the lock while writing to stderr, so this does not wait for long.
    /// A panic of another holder leaves the queue in order.
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes lines as they come. Does not return.
    fn write_on(&self) {
        let mut queue = self.queue();
        loop {
            queue.report(self.style(), monotonic());
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
                    let pause = queue.due().map_or(Duration::MAX, |due| due.saturating_sub(monotonic()));
                    let waited = self.changed.wait_timeout(queue, pause);
                    queue = waited.unwrap_or_else(PoisonError::into_inner).0;
                }
            }
        }
    }
}

/// Whether a descriptor is of the file that `named` gives by its device and inode, as `JOURNAL_STREAM` does
/// (systemd.exec(5)). Every program that a service starts inherits the variable, though its stderr may be another file.
fn is_same(named: &str, descriptor: BorrowedFd<'_>) -> bool {
    let file = descriptor.try_clone_to_owned().and_then(|descriptor| File::from(descriptor).metadata());
    file.is_ok_and(|file| named == format!("{}:{}", file.dev(), file.ino()))
}

impl Log for Stderr {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.level() <= log::max_level()
    }

    fn log(&self, record: &Record<'_>) {
        if !self.enabled(record.metadata()) {
            return;
        }
        let style = self.style();
        let mut queue = self.queue();
        if queue.has_writer {
            queue.take(record, style, monotonic());
            self.changed.notify_all();
        } else {
            drop(queue);
            put(&style.line(record.level(), *record.args()), WRITE_TIMEOUT_MS.into());
        }
    }

    fn flush(&self) {
        finish();
    }
}

/// Writes a line to stderr. The rest of it is dropped if nobody reads for `patience`, or if it cannot be written: there
/// is no other place to report that.
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

/// Turns the log on, for lines at `level` or graver.
pub fn start(level: LevelFilter) {
    // This fails if another logger is set already, for example by a test. That one stays.
    let _ = log::set_logger(&STDERR);
    log::set_max_level(level);
}

/// The same for a command that serves no host.
pub fn start_command(level: LevelFilter) {
    let _ = STDERR.style.set(Style::for_stderr(Style::Command));
    start(level);
}

/// Starts the thread that writes, so that no other thread waits for a reader of stderr. Call it after the guardian is
/// forked, because a process with threads cannot be forked.
pub fn detach() {
    match started(thread::Builder::new().name("log".into()).spawn(|| STDERR.write_on())) {
        Ok(_) => STDERR.queue().has_writer = true,
        Err(trouble) => log::warn!("a log that nobody reads will stop Pinion: {trouble}"),
    }
}

/// Waits up to a second until the queue is written. Later lines are written at once.
pub fn finish() {
    let mut queue = STDERR.queue();
    if queue.has_writer {
        queue.report(STDERR.style(), Duration::MAX);
        STDERR.changed.notify_all();
        let waited = STDERR.changed.wait_timeout_while(queue, FAREWELL, |queue| !queue.is_done());
        queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        queue.has_writer = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_testkit::names::any_name;
    use pinion_testkit::names::assert_plain;
    use proptest::prelude::*;

    #[test]
    fn lines_that_do_not_fit_are_counted_and_reported_after_the_others() {
        let mut queue = Queue::new();
        (0..LINES_MAX + 3).for_each(|n| queue.push(n.to_string()));
        let lines: Vec<String> = std::iter::from_fn(|| queue.pop(Style::Plain)).collect();
        let (loss, kept) = lines.split_last().unwrap();
        assert_eq!(kept, (0..LINES_MAX).map(|n| n.to_string()).collect::<Vec<_>>());
        assert!(loss.ends_with("WARN  3 lines of the log were lost, because nobody read the log\n"), "{loss}");
        assert!(queue.is_done());
    }

    #[test]
    fn only_a_stderr_that_is_the_journal_counts_as_it() {
        let (stderr, other) = (tempfile::tempfile().unwrap(), tempfile::tempfile().unwrap());
        let journal = stderr.metadata().unwrap();
        let journal = format!("{}:{}", journal.dev(), journal.ino());
        assert!(is_same(&journal, stderr.as_fd()) && !is_same(&journal, other.as_fd()) && !is_same("", stderr.as_fd()));
    }

    #[test]
    fn a_flood_of_lines_is_counted_and_does_not_hide_other_lines() {
        let mut queue = Queue::new();
        let at = |queue: &mut Queue, target: &str, text: &str, now_s: u64| {
            let args = format_args!("{text}");
            let record = Record::builder().target(target).line(Some(7)).level(Level::Error).args(args).build();
            queue.take(&record, Style::Journal, Duration::from_secs(now_s));
            std::iter::from_fn(|| queue.pop(Style::Journal)).collect::<Vec<_>>()
        };
        let max = u64::from(KIND_LINES_MAX);
        let kept = (0..1000).flat_map(|n| at(&mut queue, "host", &format!("bad {n}"), 5)).collect::<Vec<_>>();
        assert_eq!(kept, (0..max).map(|n| format!("<3>bad {n}\n")).collect::<Vec<_>>());
        assert_eq!(at(&mut queue, "core", "stop", 6), ["<3>stop\n"]);
        assert_eq!(queue.due(), Some(Duration::from_secs(65)));
        let next = at(&mut queue, "host", "bad again", 65);
        let report = format!("<3>{} more lines like this were left out: bad {}\n", 1000 - max, max - 1);
        assert_eq!(next, [report, "<3>bad again\n".to_owned()]);
        assert_eq!(queue.due(), None);
    }

    proptest! {
        #[test]
        fn a_line_is_one_line_whatever_is_named_in_it(name in any_name()) {
            for style in [Style::Journal, Style::Plain, Style::Command] {
                assert_plain(&style.line(Level::Warn, format_args!("the host is klippy of {name}")), 1);
            }
        }
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
