// SPDX-License-Identifier: GPL-3.0-or-later
//! Watchdogs: the hardware's, which resets the machine (`-w`), and the service manager's, which
//! starts the program anew. Both are fed only while the core, the link and every worker get on.
//!
//! The link feeds them, so that it gets on needs no proof. The core has its heartbeat, with the
//! limits of the guardian. A worker gets on unless one job takes longer than [`JOB`].

#![forbid(unsafe_code)]

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use log::{error, info, warn};

use crate::sys;
use crate::time::monotonic;

use super::guardian::{BEAT, Ear, Pulse};
use super::notify::Notify;

/// The longest that one job of a worker may take.
const JOB: Duration = Duration::from_secs(10);
/// The limit of a hardware watchdog that does not tell it.
const USUAL_LIMIT: Duration = Duration::from_secs(10);

/// When a worker began its present job: nanoseconds of CLOCK_MONOTONIC, 0 while it has none.
pub(super) struct JobClock {
    bus: String,
    since: AtomicU64,
}

impl JobClock {
    /// A job begins.
    pub(super) fn begin(&self) {
        self.since.store(monotonic().as_nanos() as u64, Ordering::Relaxed);
    }

    /// It is done.
    pub(super) fn end(&self) {
        self.since.store(0, Ordering::Relaxed);
    }
}

/// The clocks of the workers that there are.
#[derive(Clone, Default)]
pub(super) struct JobClocks(Arc<Mutex<Vec<Weak<JobClock>>>>);

impl JobClocks {
    /// The clock of a new worker, which is forgotten once it is dropped.
    pub(super) fn add(&self, bus: &str) -> Arc<JobClock> {
        let clock = Arc::new(JobClock { bus: bus.into(), since: AtomicU64::new(0) });
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(Arc::downgrade(&clock));
        clock
    }

    /// The bus of a worker that has been at one job for too long.
    fn stuck(&self, now: Duration) -> Option<String> {
        let mut clocks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        clocks.retain(|clock| clock.strong_count() > 0);
        clocks.iter().filter_map(Weak::upgrade).find_map(|clock| {
            let since = clock.since.load(Ordering::Relaxed);
            let taken = now.saturating_sub(Duration::from_nanos(since));
            (since != 0 && taken > JOB).then(|| clock.bus.clone())
        })
    }
}

/// A hardware watchdog. Dropped without [`Watchdog::close`] it goes on and resets the machine.
pub(super) struct Watchdog {
    file: File,
    limit: Duration,
}

impl Watchdog {
    /// Opens the device, which starts it.
    pub(super) fn open(path: &Path) -> io::Result<Watchdog> {
        let file = File::options().write(true).open(path).map_err(|error| cannot_open(path, &error))?;
        let limit = match sys::watchdog_timeout_s(file.as_fd()) {
            Ok(seconds) if seconds > 0 => Duration::from_secs(seconds.unsigned_abs().into()),
            _ => USUAL_LIMIT,
        };
        info!("{} resets this machine {} s after Pinion hangs", path.display(), limit.as_secs());
        Ok(Watchdog { file, limit })
    }

    fn feed(&mut self) {
        if let Err(error) = self.file.write_all(b"\0") {
            warn!("the watchdog can not be fed: {error}: this machine is about to be reset");
        }
    }

    /// Stops it: the program ends in order.
    fn close(mut self) {
        if let Err(error) = self.file.write_all(b"V") {
            warn!("the watchdog can not be stopped: {error}: this machine is about to be reset");
        }
    }
}

fn cannot_open(path: &Path, error: &io::Error) -> io::Error {
    let remedy = match error.raw_os_error() {
        Some(libc::ENOENT) => {
            "this machine has no watchdog, or its driver is not loaded: on a Raspberry Pi set \"dtparam=watchdog=on\" in config.txt, elsewhere modprobe softdog, or leave out -w"
        }
        Some(libc::EBUSY) => {
            "another program feeds it: unset RuntimeWatchdogSec in /etc/systemd/system.conf or stop the watchdog daemon, or leave out -w"
        }
        Some(libc::EACCES | libc::EPERM) => {
            "run as root, or let a udev rule give the device to Pinion's user or group, or leave out -w"
        }
        _ => "look at the kernel's log (dmesg), or leave out -w",
    };
    io::Error::new(error.kind(), format!("-w: {} can not be opened: {error}: {remedy}", path.display()))
}

/// Feeds the watchdogs, as long as all get on.
pub(super) struct Vigil {
    watchdog: Option<Watchdog>,
    notify: Notify,
    /// How often they are fed; none without a watchdog.
    interval: Option<Duration>,
    due: Duration,
    ear: Ear,
    jobs: JobClocks,
    starving: bool,
}

impl Vigil {
    /// `notify_interval` is how often the service manager wants to be fed, if at all.
    pub(super) fn new(
        watchdog: Option<Watchdog>,
        notify: Notify,
        notify_interval: Option<Duration>,
        pulse: Pulse,
        jobs: JobClocks,
    ) -> Vigil {
        let intervals = [watchdog.as_ref().map(|watchdog| watchdog.limit / 3), notify_interval];
        // An idle core has to get a beat in between.
        let interval = intervals.into_iter().flatten().min().map(|interval| interval.max(BEAT * 3 / 2));
        let now = monotonic();
        let ear = Ear::new(pulse, Duration::MAX, now);
        Vigil { watchdog, notify, interval, due: now, ear, jobs, starving: false }
    }

    /// When to tick next.
    pub(super) fn due(&self) -> Option<Duration> {
        self.interval.map(|_| self.due)
    }

    /// Feeds the watchdogs if it is time.
    pub(super) fn tick(&mut self, now: Duration) {
        let Some(interval) = self.interval.filter(|_| now >= self.due) else { return };
        self.due = now + interval;
        let silent = self.ear.is_silent(now);
        let stuck = self.jobs.stuck(now);
        if !silent && stuck.is_none() {
            if std::mem::take(&mut self.starving) {
                warn!("Pinion gets on: the watchdogs are fed again");
            }
            if let Some(watchdog) = &mut self.watchdog {
                watchdog.feed();
            }
            self.notify.send("WATCHDOG=1");
        } else if !std::mem::replace(&mut self.starving, true) {
            match stuck {
                Some(bus) => error!(
                    "a transfer on {bus} takes more than {} s: the watchdogs are not fed; check the chip's wiring",
                    JOB.as_secs()
                ),
                None => error!("the core hangs: the watchdogs are not fed"),
            }
        }
    }

    /// The line that `systemctl status` shows.
    pub(super) fn status(&self, status: &str) {
        self.notify.status(status);
    }

    /// The program serves.
    pub(super) fn ready(&self) {
        self.notify.send("READY=1");
    }

    /// The program begins to end.
    pub(super) fn stopping(&self) {
        self.notify.send("STOPPING=1\nSTATUS=shutting down");
    }

    /// The program has ended in order.
    pub(super) fn end(self) {
        if let Some(watchdog) = self.watchdog {
            watchdog.close();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn vigil(path: &Path, jobs: &JobClocks) -> (Vigil, Pulse) {
        let pulse = Pulse::new().unwrap();
        let watchdog = Watchdog::open(path).unwrap();
        let notify = Notify::from_env().unwrap();
        (Vigil::new(Some(watchdog), notify, None, pulse, jobs.clone()), pulse)
    }

    fn food(path: &Path) -> String {
        fs::read_to_string(path).unwrap().replace('\0', ".")
    }

    #[test]
    fn fed_while_the_core_beats_and_stopped_at_an_orderly_end() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let (mut vigil, pulse) = vigil(file.path(), &JobClocks::default());
        let interval = vigil.interval.unwrap();
        assert_eq!(interval, USUAL_LIMIT / 3);
        let mut now = vigil.due().unwrap();
        for _ in 0..3 {
            pulse.beat(true);
            vigil.tick(now);
            vigil.tick(now + interval / 2);
            now += interval;
        }
        assert_eq!(food(file.path()), "...");
        // No beat since the last meal.
        vigil.tick(now);
        assert_eq!(food(file.path()), "...");
        pulse.beat(true);
        vigil.tick(now + interval);
        vigil.end();
        assert_eq!(food(file.path()), "....V");
    }

    #[test]
    fn not_fed_while_a_job_takes_too_long_and_not_stopped_by_a_crash() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let jobs = JobClocks::default();
        let clock = jobs.add("spi0");
        let (mut vigil, pulse) = vigil(file.path(), &jobs);
        let interval = vigil.interval.unwrap();
        clock.begin();
        let start = vigil.due().unwrap();
        for tick in 0..5 {
            pulse.beat(true);
            vigil.tick(start + tick * interval);
        }
        // At 0, 3.3, 6.7 and 10 seconds, less what passed before the job began.
        assert!(["...", "...."].contains(&food(file.path()).as_str()));
        clock.end();
        let before = food(file.path()).len();
        pulse.beat(true);
        vigil.tick(start + 5 * interval);
        drop(clock);
        assert_eq!(jobs.stuck(start + 1000 * interval), None);
        drop(vigil);
        assert_eq!(food(file.path()).len(), before + 1);
    }

    #[test]
    fn a_core_that_is_configured_may_take_its_time() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let (mut vigil, pulse) = vigil(file.path(), &JobClocks::default());
        let (start, interval) = (vigil.due().unwrap(), vigil.interval.unwrap());
        pulse.beat(false);
        for tick in 0..12 {
            vigil.tick(start + tick * interval);
        }
        // The beat is heard at once, and 30 seconds are nine intervals.
        assert_eq!(food(file.path()), "..........");
    }

    #[test]
    fn a_watchdog_that_can_not_be_opened() {
        let path = Path::new("/nowhere/watchdog");
        let error = Watchdog::open(path).err().unwrap();
        assert!(error.to_string().starts_with("-w: /nowhere/watchdog can not be opened:"), "{error}");
        let text = |code| cannot_open(path, &io::Error::from_raw_os_error(code)).to_string();
        assert!(text(libc::ENOENT).contains("modprobe softdog"));
        assert!(text(libc::EBUSY).contains("RuntimeWatchdogSec"));
        assert!(text(libc::EACCES).contains("udev rule"));
    }
}
