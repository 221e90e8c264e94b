// SPDX-License-Identifier: GPL-3.0-or-later
//! The near end: a pty for the host, and ssh to the far end.
//!
//! There is always a connection, or an attempt, also without a host. So the log reports an error early, and a host
//! does not wait for ssh. The host's first bytes stay in the pty until the far end has its terminal open.

use std::io;
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::time::Duration;

use log::{info, warn};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, poll};
use nix::unistd::getegid;

use pinion_firmware::trouble::Trouble;
use pinion_linux::LOOK_AT_LOG;
use pinion_linux::clock::{monotonic, poll_timeout};

use super::round_trip::RoundTrips;
use super::ssh::{Ssh, Target};
use super::{Flow, Incoming, SYNC};
use crate::process::notify::Notify;
use crate::process::signals::{Signal, Signals};
use crate::transport::pty::{Access, Pty};
use crate::transport::{Input, Transport};
use crate::trouble::{no_room, refused};

/// The pauses between attempts to connect. Each is twice the one before.
const PAUSE_MIN: Duration = Duration::from_secs(1);
const PAUSE_MAX: Duration = Duration::from_secs(8);
/// How long an attempt may take.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// How often the round trips are logged.
const REPORT_EVERY: Duration = Duration::from_secs(60);

/// Carries hosts that open `link` to `target`, until SIGTERM, SIGINT or SIGHUP.
///
/// # Errors
///
/// The link cannot be made, or the kernel refuses something.
pub fn link(link: &Path, target: Target) -> Result<(), Trouble> {
    // This comes first: a process that sees the link may send a signal, and the signal must not leave the link behind.
    let mut signals = Signals::new().map_err(no_room)?;
    let notify = Notify::from_env()?;
    // The host runs as the same user.
    let pty = Pty::open(link, &Access { mode: 0o600, group: Some(getegid().to_string()) })?;
    info!("serving on {} ({}), by ssh to {}", link.display(), pty.detail(), target.host);
    let mut near = Near {
        link: link.to_owned(),
        pty,
        target,
        notify,
        is_attached: false,
        state: State::Waiting { until: Duration::ZERO },
        pause: PAUSE_MIN,
        logged: String::new(),
        to_host: Flow::new(),
        trips: RoundTrips::default(),
        report_at: Duration::MAX,
    };
    near.notify.send("READY=1");
    loop {
        near.work()?;
        let is_signal = near.wait(signals.event())?;
        while is_signal && let Some(signal) = signals.next() {
            match signal {
                Signal::End => {
                    near.report();
                    return Ok(());
                }
                Signal::Report => near.report(),
                Signal::Hang => {}
            }
        }
    }
}

/// The connection to the far end.
enum State {
    /// There is none. When to try again.
    Waiting { until: Duration },
    /// ssh has been started.
    Connecting { ssh: Ssh, since: Duration },
    /// The far end has its terminal open.
    Up { ssh: Ssh },
}

struct Near {
    link: PathBuf,
    pty: Pty,
    target: Target,
    notify: Notify,
    is_attached: bool,
    state: State,
    pause: Duration,
    /// The last log line about a lost connection. Each attempt may fail in the same way.
    logged: String,
    to_host: Flow,
    trips: RoundTrips,
    report_at: Duration,
}

impl Near {
    /// Does the work that is due.
    fn work(&mut self) -> Result<(), Trouble> {
        let now = monotonic();
        let is_lost = match &mut self.state {
            State::Waiting { until } if now < *until => false,
            State::Waiting { .. } => match self.target.connect() {
                Ok(ssh) => {
                    self.state = State::Connecting { ssh, since: now };
                    self.publish("connecting");
                    false
                }
                Err(trouble) => {
                    self.retry(trouble);
                    false
                }
            },
            State::Connecting { since, .. } => now >= *since + CONNECT_MAX,
            State::Up { ssh } => {
                let listens = self.to_host.has_room();
                ssh.wire().is_none_or(|wire| {
                    if !listens {
                        wire.forgive_silence();
                    }
                    wire.is_silent() || wire.give_sign().is_err()
                })
            }
        };
        if is_lost {
            self.lose()?;
        }
        if now >= self.report_at {
            self.report();
        }
        self.pty.restore();
        let pty = &mut self.pty;
        self.to_host.drain(|bytes| pty.write(bytes)).map_err(|error| lost_pty(&self.link, error))
    }

    /// Waits for something to do, and takes in the bytes that have come. True if there is a signal.
    fn wait(&mut self, signal: BorrowedFd<'_>) -> Result<bool, Trouble> {
        let flag = |is_wanted: bool, flag| if is_wanted { flag } else { PollFlags::empty() };
        let pty = &self.pty;
        let mut fds = vec![PollFd::new(signal, PollFlags::POLLIN)];
        let mut due = pty.due().map_or(self.report_at, |at| at.min(self.report_at));
        let mut takes_from_host = false;
        match &mut self.state {
            State::Waiting { until } => due = due.min(*until),
            State::Connecting { since, .. } => due = due.min(*since + CONNECT_MAX),
            State::Up { ssh } => {
                if let Some(wire) = ssh.wire() {
                    due = due.min(wire.due());
                    takes_from_host = wire.outward.has_room();
                }
            }
        }
        // A host that is there is heard once the connection is up. Its end is always reported.
        let listens = takes_from_host || !self.is_attached;
        let events = flag(listens, PollFlags::POLLIN) | flag(!self.to_host.is_empty(), PollFlags::POLLOUT);
        let is_up = matches!(self.state, State::Up { .. });
        let mut input_at = None;
        let mut messages_at = None;
        if let State::Connecting { ssh, .. } | State::Up { ssh } = &mut self.state {
            let output_events = ssh.wire().map_or(PollFlags::empty(), |wire| wire.output_events());
            // A descriptor that nobody waits for may hang up, again and again. So it is left out.
            if let Some([input, output]) = ssh.events() {
                if self.to_host.has_room() {
                    input_at = Some(fds.len());
                    fds.push(PollFd::new(input, PollFlags::POLLIN));
                }
                if !output_events.is_empty() {
                    fds.push(PollFd::new(output, output_events));
                }
            }
            if let Some(messages) = ssh.messages() {
                messages_at = Some(fds.len());
                fds.push(PollFd::new(messages, PollFlags::POLLIN));
            }
        }
        let host_at = (listens || !is_up).then_some(fds.len());
        if host_at.is_some()
            && let Some(event) = pty.event()
        {
            fds.push(PollFd::new(event, events));
        }
        match poll(&mut fds, poll_timeout(due.saturating_sub(monotonic()))) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(error) => return Err(refused("waiting", error).remedy(LOOK_AT_LOG)),
        }
        let seen: Vec<PollFlags> = fds.iter().map(|fd| fd.revents().unwrap_or(PollFlags::empty())).collect();
        let at = |at: Option<usize>| at.and_then(|at| seen.get(at)).copied().unwrap_or(PollFlags::empty());
        let (host, input) = (at(host_at), at(input_at));
        if !at(messages_at).is_empty()
            && let State::Connecting { ssh, .. } | State::Up { ssh } = &mut self.state
        {
            ssh.listen();
        }
        if host.intersects(PollFlags::POLLIN | PollFlags::POLLHUP) {
            self.hear_host(host.contains(PollFlags::POLLHUP))?;
        }
        if !input.is_empty() {
            self.hear_far_end()?;
        }
        Ok(!seen[0].is_empty())
    }

    /// Reads the host's bytes, if the connection is up. `hung_up`: the host has gone.
    fn hear_host(&mut self, hung_up: bool) -> Result<(), Trouble> {
        let about = |error: io::Error| lost_pty(&self.link, error);
        let pty = &mut self.pty;
        if !self.is_attached {
            self.is_attached = pty.meet_host();
            if self.is_attached {
                info!("host attached");
                self.report_at = monotonic() + REPORT_EVERY;
            }
        }
        let wire = match &mut self.state {
            State::Up { ssh } => ssh.wire(),
            _ => None,
        };
        let mut bytes = 0;
        match wire {
            Some(wire) => {
                let (_, read) = wire
                    .outward
                    .fill(|buffer| {
                        Ok(match pty.read(buffer, false)? {
                            Input::Bytes(bytes) => Incoming::Bytes(bytes),
                            Input::Gone | Input::Over => Incoming::Over,
                        })
                    })
                    .map_err(about)?;
                bytes = read.len();
                self.trips.sent(read, monotonic());
                // It may be gone. Then its end is reported.
                let _ = wire.write();
            }
            // Somebody wrote and has left.
            None if !self.is_attached => {
                warn!("{} is not connected: what was written to {} is lost", self.target.host, self.link.display());
                let mut lost = [0; 4096];
                while pty.read(&mut lost, false).map_err(about)? != Input::Bytes(0) {}
            }
            None => {}
        }
        // Bytes that the host wrote before it went come first.
        if hung_up && bytes == 0 && self.is_attached {
            self.part();
        }
        Ok(())
    }

    /// The host is gone. The far end has to see that, so the connection ends, and the next one begins.
    fn part(&mut self) {
        info!("host gone");
        self.report();
        self.report_at = Duration::MAX;
        self.is_attached = false;
        self.to_host.clear();
        self.pty.part_from_host();
        if let State::Up { .. } = self.state
            && let State::Up { ssh } = std::mem::replace(&mut self.state, State::Waiting { until: Duration::ZERO })
        {
            ssh.end();
        }
    }

    /// Reads the far end's bytes.
    fn hear_far_end(&mut self) -> Result<(), Trouble> {
        let (State::Connecting { ssh, .. } | State::Up { ssh }) = &mut self.state else { return Ok(()) };
        let Some(wire) = ssh.wire() else { return Ok(()) };
        let before = self.to_host.0.len();
        let Ok((Incoming::Bytes(_), bytes)) = wire.read(&mut self.to_host) else { return self.lose() };
        let now = monotonic();
        self.trips.received(bytes, now);
        if let State::Connecting { since, .. } = self.state {
            // A shell there may greet first, which is not for the host.
            let Some(sign) = bytes.iter().position(|byte| *byte == SYNC) else {
                self.to_host.clear();
                return Ok(());
            };
            self.to_host.0.drain(..=before + sign);
            let took_s = now.saturating_sub(since).as_secs_f64();
            info!("connected to {} within {took_s:.1} s", self.target.host);
            self.publish("connected");
            self.logged.clear();
            self.pause = PAUSE_MIN;
            if let State::Connecting { ssh, .. } =
                std::mem::replace(&mut self.state, State::Waiting { until: Duration::ZERO })
            {
                self.state = State::Up { ssh };
            }
        }
        if !self.is_attached {
            self.to_host.clear();
        }
        Ok(())
    }

    /// The connection is lost, or there is none. A host that is there has to see it, as it sees an MCU that is gone.
    fn lose(&mut self) -> Result<(), Trouble> {
        let state = std::mem::replace(&mut self.state, State::Waiting { until: Duration::ZERO });
        let was_up = matches!(state, State::Up { .. });
        if was_up && self.is_attached {
            self.pty.replace()?;
            self.is_attached = false;
            self.report();
            self.report_at = Duration::MAX;
        }
        self.to_host.clear();
        if let State::Connecting { ssh, .. } | State::Up { ssh } = state {
            let trouble = ssh.verdict(&self.target);
            self.retry(trouble);
        }
        Ok(())
    }

    /// Logs why there is no connection, and when the next try is.
    fn retry(&mut self, trouble: Trouble) {
        let line = trouble.to_string();
        if line != self.logged {
            warn!("{line} (tried again until it works)");
            self.logged = line;
        }
        self.publish("not connected");
        self.state = State::Waiting { until: monotonic() + self.pause };
        self.pause = (2 * self.pause).min(PAUSE_MAX);
    }

    /// Logs the round trips since the last time.
    fn report(&mut self) {
        let times = self.trips.take();
        if !times.is_empty() {
            info!("round trip to {}: {times}", self.target.host);
        }
        if self.report_at != Duration::MAX {
            self.report_at = monotonic() + REPORT_EVERY;
        }
    }

    fn publish(&self, state: &str) {
        self.notify.status(&format!("serving on {}, {state}: {}", self.link.display(), self.target.host));
    }
}

fn lost_pty(link: &Path, error: io::Error) -> Trouble {
    refused(link.display(), error).remedy(LOOK_AT_LOG)
}
