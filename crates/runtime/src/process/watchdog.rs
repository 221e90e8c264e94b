// SPDX-License-Identifier: GPL-3.0-or-later
//! Watchdogs: the hardware's resets the computer (`-w`), and the service manager's restarts the program. Both are fed
//! only while neither the core, nor the link, nor a worker hangs.
//!
//! The link feeds them, so a link that hangs does not feed them. The core hangs if its heartbeat is missing for as long
//! as the guardian allows. A worker hangs if one job takes longer than [`JOB_LIMIT`].

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::path::Path;
use std::time::Duration;

use log::{error, info, warn};

use pinion_firmware::trouble::Trouble;
use pinion_linux::LOOK_AT_LOG;
use pinion_linux::clock::monotonic;
use pinion_linux::sys;

use crate::core::heartbeat::{BEAT, Heartbeat};
use crate::process::notify::Notify;

/// Longest time that one job of a worker may take.
const JOB_LIMIT: Duration = Duration::from_secs(10);
/// Limit that is assumed for a hardware watchdog that does not report its own.
const USUAL_LIMIT: Duration = Duration::from_secs(10);

/// A hardware watchdog. If it is dropped without [`Watchdog::close`], it continues to run and resets the computer.
pub(crate) struct Watchdog {
    file: File,
    limit: Duration,
}

impl Watchdog {
    /// Opens the device, which starts it.
    pub(crate) fn open(path: &Path) -> Result<Watchdog, Trouble> {
        let file = File::options().write(true).open(path).map_err(|error| cannot_open(path, &error))?;
        let limit = limit(sys::watchdog_timeout_s(file.as_fd()));
        info!("{} resets this computer {} s after Pinion hangs", path.display(), limit.as_secs());
        Ok(Watchdog { file, limit })
    }

    fn feed(&mut self) {
        if let Err(error) = self.file.write_all(b"\0") {
            warn!("the watchdog cannot be fed, and is about to reset this computer: {error}: {LOOK_AT_LOG}");
        }
    }

    /// Stops the watchdog, because the program ends in order. Its driver wants a "V" for that
    /// (Documentation/watchdog/watchdog-api.rst, "magic close").
    fn close(mut self) {
        if let Err(error) = self.file.write_all(b"V") {
            warn!("the watchdog cannot be stopped, and is about to reset this computer: {error}: {LOOK_AT_LOG}");
        }
    }
}

/// The limit of a hardware watchdog, from the seconds that it reports.
fn limit(reported: io::Result<i32>) -> Duration {
    match reported {
        Ok(seconds @ 1..) => Duration::from_secs(seconds.unsigned_abs().into()),
        _ => USUAL_LIMIT,
    }
}

fn cannot_open(path: &Path, error: &io::Error) -> Trouble {
    let remedy = match error.raw_os_error() {
        Some(libc::ENOENT) => {
            "this computer has no watchdog, or its driver is not loaded: on a Raspberry Pi set \"dtparam=watchdog=on\" in config.txt, elsewhere modprobe softdog, or leave out -w"
        }
        Some(libc::EBUSY) => {
            "another program feeds it, on Raspberry Pi OS systemd: \"sudo pinion doctor\" has the command that stops systemd's feeding; or stop the watchdog daemon, or leave out -w"
        }
        Some(libc::EACCES | libc::EPERM) => {
            "run as root, or let a udev rule give the device to Pinion's user or group, or leave out -w"
        }
        _ => "look at the kernel's log (dmesg), or leave out -w",
    };
    Trouble::new(format!("{} cannot be opened: {error}", path.display())).remedy(remedy).of("-w")
}

/// Feeds the watchdogs as long as nothing hangs.
pub(crate) struct Vigil {
    watchdog: Option<Watchdog>,
    notify: Notify,
    /// How often the watchdogs are fed. `None` if there are none.
    interval: Option<Duration>,
    due: Duration,
    heartbeat: Heartbeat,
    starving: bool,
}

impl Vigil {
    /// `notify_interval` is how often the service manager wants to be fed, if at all.
    pub(crate) fn new(notify: Notify, notify_interval: Option<Duration>, heartbeat: Heartbeat) -> Vigil {
        // Between two heartbeats of the core nothing new is known. So feeding more often is of no use.
        let interval = notify_interval.map(|interval| interval.max(BEAT));
        Vigil { watchdog: None, notify, interval, due: monotonic(), heartbeat, starving: false }
    }

    /// Feeds a hardware watchdog as well.
    pub(crate) fn feed(&mut self, watchdog: Watchdog) {
        let interval = (watchdog.limit / 3).max(BEAT);
        self.interval = Some(self.interval.map_or(interval, |present| present.min(interval)));
        self.watchdog = Some(watchdog);
    }

    /// When to call [`Vigil::tick`] next (CLOCK_MONOTONIC).
    pub(crate) fn due(&self) -> Option<Duration> {
        self.interval.map(|_| self.due)
    }

    /// Feeds the watchdogs if it is time at `now` (CLOCK_MONOTONIC).
    pub(crate) fn tick(&mut self, now: Duration) {
        let Some(interval) = self.interval.filter(|_| now >= self.due) else { return };
        self.due = now + interval;
        let clock = self.heartbeat.at(now);
        let silent = self.heartbeat.is_silent(clock);
        let stuck = self.heartbeat.stuck(clock, JOB_LIMIT);
        if !silent && stuck.is_none() {
            if std::mem::take(&mut self.starving) {
                warn!("Pinion hangs no longer: the watchdogs are fed again");
            }
            if let Some(watchdog) = &mut self.watchdog {
                watchdog.feed();
            }
            self.notify.send("WATCHDOG=1");
        } else if !std::mem::replace(&mut self.starving, true) {
            match stuck {
                Some(bus) => error!(
                    "a transfer on {bus} takes more than {} s, so the watchdogs are not fed: check the chip's wiring",
                    JOB_LIMIT.as_secs()
                ),
                None => error!(
                    "the core hangs, so the watchdogs are not fed, and the guardian or the service manager may end Pinion: report it with the lines above"
                ),
            }
        }
    }

    /// The line that `systemctl status` shows.
    pub(crate) fn status(&self, status: &str) {
        self.notify.status(status);
    }

    /// Informs the service manager that the program has started.
    pub(crate) fn ready(&self) {
        self.notify.send("READY=1");
    }

    /// Informs the service manager that the program begins to end.
    pub(crate) fn stopping(&self) {
        self.notify.send("STOPPING=1\nSTATUS=shutting down");
    }

    /// Stops the hardware watchdog, because the program has ended in order.
    pub(crate) fn end(self) {
        if let Some(watchdog) = self.watchdog {
            watchdog.close();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_linux::clock::Monotonic;
    use std::fs;

    fn vigil(path: &Path) -> (Vigil, Heartbeat) {
        let heartbeat = Heartbeat::new(Monotonic::start()).unwrap();
        let watchdog = Watchdog::open(path).unwrap();
        let notify = Notify::from_env().unwrap();
        let mut vigil = Vigil::new(notify, None, heartbeat);
        vigil.feed(watchdog);
        (vigil, heartbeat)
    }

    fn food(path: &Path) -> String {
        fs::read_to_string(path).unwrap().replace('\0', ".")
    }

    #[test]
    fn fed_while_the_core_beats_and_stopped_at_an_orderly_end() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let (mut vigil, heartbeat) = vigil(file.path());
        let interval = vigil.interval.unwrap();
        assert_eq!(interval, USUAL_LIMIT / 3);
        let mut now = vigil.due().unwrap();
        for _ in 0..3 {
            heartbeat.beat(heartbeat.at(now), true);
            vigil.tick(now);
            vigil.tick(now + interval / 2);
            now += interval;
        }
        assert_eq!(food(file.path()), "...");
        // The core has not given a heartbeat since the watchdog was last fed.
        vigil.tick(now);
        assert_eq!(food(file.path()), "...");
        heartbeat.beat(heartbeat.at(now + interval), true);
        vigil.tick(now + interval);
        vigil.end();
        assert_eq!(food(file.path()), "....V");
    }

    #[test]
    fn not_fed_while_a_job_takes_too_long_and_not_stopped_by_a_crash() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let (mut vigil, heartbeat) = vigil(file.path());
        let clock = heartbeat.worker("spi0").unwrap();
        let interval = vigil.interval.unwrap();
        clock.begin();
        // A busy computer may take long to begin the job.
        let start = monotonic();
        let mut tick = |n| {
            let now = start + n * interval;
            heartbeat.beat(heartbeat.at(now), true);
            vigil.tick(now);
        };
        (0..5).for_each(&mut tick);
        // At 0, 3.3, 6.7 and 10 seconds, plus the moment since the job began.
        assert!(["...", "...."].contains(&food(file.path()).as_str()));
        clock.end();
        let before = food(file.path()).len();
        tick(5);
        drop(vigil);
        assert_eq!(food(file.path()).len(), before + 1);
    }

    #[test]
    fn a_core_that_is_configured_may_take_its_time() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let (mut vigil, heartbeat) = vigil(file.path());
        let (start, interval) = (vigil.due().unwrap(), vigil.interval.unwrap());
        heartbeat.beat(heartbeat.at(start + Duration::from_millis(10)), false);
        for tick in 0..12 {
            vigil.tick(start + tick * interval);
        }
        // The first is before the beat, and 30 seconds are nine intervals.
        assert_eq!(food(file.path()), "..........");
    }

    #[test]
    fn the_limit_that_a_watchdog_reports_counts_if_it_is_one() {
        assert_eq!(limit(Ok(60)), Duration::from_secs(60));
        assert_eq!(limit(Ok(1)), Duration::from_secs(1));
        assert_eq!(limit(Ok(0)), USUAL_LIMIT);
        assert_eq!(limit(Ok(-1)), USUAL_LIMIT);
        assert_eq!(limit(Err(io::ErrorKind::Unsupported.into())), USUAL_LIMIT);
    }

    #[test]
    fn a_watchdog_that_can_not_be_opened() {
        let path = Path::new("/nowhere/watchdog");
        let error = Watchdog::open(path).err().unwrap();
        assert!(error.to_string().starts_with("-w: /nowhere/watchdog cannot be opened:"), "{error}");
        let text = |code| cannot_open(path, &io::Error::from_raw_os_error(code)).to_string();
        assert!(text(libc::ENOENT).contains("modprobe softdog"));
        assert!(text(libc::EBUSY).contains("on Raspberry Pi OS systemd: \"sudo pinion doctor\""));
        assert!(text(libc::EACCES).contains("udev rule"));
    }
}
