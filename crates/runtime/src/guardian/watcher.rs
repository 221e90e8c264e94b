// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian process. It watches the program, and drives the outputs when the program cannot.

use std::ffi::CStr;
use std::io;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::sync::Arc;
use std::time::Duration;

use log::error;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{MsgFlags, send};
use nix::unistd::alarm;

use pinion_linux::clock::poll_timeout;
use pinion_linux::sys;

use super::message::{MESSAGE_BYTES, Message, REFUSED, TAKEN};
use super::outputs::{Group, HeldOutputs, Output, drive};
use super::program::Program;
use super::rescue::{RescueThreads, summary};
use crate::core::heartbeat::Heartbeat;
use crate::core::monitors::HeartbeatMonitor;
use crate::process::forked;
use crate::process::realtime;
use crate::recorder::Recording;
use pinion_trace::event::Event;
use pinion_trace::file::End;

#[cfg(fuzzing)]
#[allow(clippy::expect_used)]
#[path = "../../tests/support/guardian_fuzz.rs"]
pub(crate) mod fuzz;

/// The kernel's name of the guardian's process (proc_pid_comm(5)). Its command line is the program's.
pub(crate) const NAME: &CStr = c"pinion-guardian";
/// How long to retry an output that cannot be driven, and how long to wait for a driver that hangs.
const TRY_FOR: Duration = Duration::from_secs(2);
/// How long writing to the log may take, in seconds.
const LOG_S: u32 = 2;
/// How long it may take to keep the recording, in seconds.
const KEEP_S: u32 = 10;

/// Gives the new process its name, session, signals, rights and priority.
pub(super) fn settle(realtime: bool, socket: &OwnedFd, program: &Program) {
    // The program's ends of its sockets are not kept: the guardian and the search would not notice that it closes them.
    let kept = [0, 1, 2, socket.as_raw_fd()].into_iter().chain(program.pidfd.as_ref().map(AsRawFd::as_raw_fd));
    forked::settle(NAME, &kept.collect::<Vec<_>>());
    // Failures are ignored here: without any of these the guardian can still do its work.
    // When memory is short, the kernel now kills other processes only. Root may ask for this, and a service that starts
    // with this score.
    let _ = std::fs::write("/proc/self/oom_score_adj", "-1000");
    let _ = sys::keep_only(sys::SERVE);
    if realtime {
        realtime::enter_guardian();
    }
    // A first call, without outputs, reads the code from the disk, and so the code is locked in memory too. When it is
    // needed, the disk might hang.
    drive(&mut []);
}

/// Why the outputs are driven.
enum Cause {
    Died,
    Hangs,
}

/// The result of reading the socket.
enum Incoming {
    /// A message. It was answered.
    Message,
    Goodbye,
    /// Nothing: the program has closed its end.
    Closed,
}

/// The guardian process.
pub(super) struct Watcher {
    socket: OwnedFd,
    program: Program,
    heartbeat: Heartbeat,
    recording: Recording,
    held: HeldOutputs,
    /// The files so far of an output whose last file has not come yet.
    files: Vec<(OwnedFd, Box<[u8]>)>,
}

impl Watcher {
    pub(super) fn new(socket: OwnedFd, program: Program, heartbeat: Heartbeat, recording: Recording) -> Watcher {
        Watcher { socket, program, heartbeat, recording, held: HeldOutputs::default(), files: Vec::new() }
    }

    /// Reports to the program that it is ready. It watches until the program says goodbye, dies or hangs. In the last
    /// two cases it drives the outputs.
    pub(super) fn watch(mut self) {
        self.answer(TAKEN);
        // This listens to the core's heartbeat. It exists only while outputs are held.
        let mut monitor: Option<HeartbeatMonitor> = None;
        let mut trace_writer = self.recording.guardian();
        let cause = loop {
            let pause = match &mut monitor {
                Some(monitor) => match monitor.listen(self.heartbeat.now()) {
                    Some(pause) => Some(pause),
                    None => break Cause::Hangs,
                },
                None => None,
            };
            if let Some(trace_writer) = &mut trace_writer {
                trace_writer.write(self.heartbeat.now(), Event::Listened);
            }
            let (message, ended) = self.wait(pause);
            if message {
                match self.take_message() {
                    Incoming::Message if self.held.is_empty() => monitor = None,
                    Incoming::Message => {
                        monitor.get_or_insert_with(|| HeartbeatMonitor::new(self.heartbeat, self.heartbeat.now()));
                    }
                    Incoming::Goodbye => return,
                    Incoming::Closed => break Cause::Died,
                }
            } else if ended {
                break Cause::Died;
            }
        };
        let recording = self.recording.clone();
        let end = match cause {
            Cause::Died => End::Died,
            Cause::Hangs => End::Hung { diagnosis: self.heartbeat.diagnosis() },
        };
        if !self.held.is_empty() {
            self.rescue(&cause);
        }
        // The lines are free. If the disk or the log hangs, the alarm ends this process.
        alarm::set(KEEP_S);
        recording.keep_of_the_dead(end);
    }

    /// Waits for up to `timeout`. Returns whether a message has come, and whether the program has ended.
    fn wait(&self, timeout: Option<Duration>) -> (bool, bool) {
        let timeout = timeout.map_or(PollTimeout::NONE, poll_timeout);
        let pidfd = self.program.pidfd.as_ref().map_or(self.socket.as_fd(), AsFd::as_fd);
        let mut fds = [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN), PollFd::new(pidfd, PollFlags::POLLIN)];
        if poll(&mut fds, timeout).is_err() {
            return (false, false);
        }
        let [message, ended] = fds.map(|fd| fd.revents().is_some_and(|events| !events.is_empty()));
        (message, ended)
    }

    fn take_message(&mut self) -> Incoming {
        let mut bytes = [0; MESSAGE_BYTES];
        let (len, descriptor) = match sys::receive(self.socket.as_fd(), &mut bytes) {
            Ok((0, _)) => return Incoming::Closed,
            Ok(received) => received,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => return Incoming::Message,
            // Most likely there was no room for one more descriptor.
            Err(_) => {
                self.answer(REFUSED);
                return Incoming::Message;
            }
        };
        let message = Message::decode(&bytes[..len]);
        if message == Some(Message::Goodbye) {
            return Incoming::Goodbye;
        }
        let taken = message.is_some_and(|message| self.take(message, descriptor));
        self.answer(if taken { TAKEN } else { REFUSED });
        Incoming::Message
    }

    /// Carries out a message. False if it makes no sense, for example because it lacks its descriptor.
    fn take(&mut self, message: Message<'_>, descriptor: Option<OwnedFd>) -> bool {
        match (message, descriptor) {
            (Message::Release, _) => {
                self.held = HeldOutputs::default();
                self.files.clear();
            }
            (Message::Line { name, shutdown_value, sleeping }, Some(line)) => {
                let make = if sleeping.is_some() { Output::sleeping_line } else { Output::line };
                self.held.hold(sleeping, make(name, line, shutdown_value));
            }
            (Message::Forget { name }, _) => self.held.forget(name),
            (Message::File(bytes), Some(file)) => self.files.push((file, bytes.into())),
            (Message::LastFile { name, bytes }, Some(file)) => {
                let mut files = std::mem::take(&mut self.files);
                files.push((file, bytes.into()));
                self.held.hold(Some(name), Output::files(name, files));
            }
            _ => return false,
        }
        true
    }

    fn answer(&self, answer: u8) {
        // If this fails, the program is dead, and the next poll shows it.
        let _ = send(self.socket.as_raw_fd(), &[answer], MsgFlags::MSG_NOSIGNAL);
    }

    /// Drives all outputs, kills the program, and logs which outputs could be driven and which could not.
    fn rescue(self, cause: &Cause) {
        let Watcher { program, heartbeat, held: HeldOutputs { mut native, apart }, .. } = self;
        // Native lines come first, because writing to them never blocks.
        drive(&mut native);
        let diagnosis = heartbeat.diagnosis();
        let program = Arc::new(program);
        let survivor = (!program.has_ended()).then(|| program.clone());
        let mut rescue = RescueThreads::default();
        for Group { outputs, .. } in apart {
            rescue.employ(outputs, survivor.clone(), TRY_FOR);
        }
        if let Some(program) = &survivor {
            program.kill();
            program.wait_for_end();
            // The core may have driven them again before it was killed.
            drive(&mut native);
        }
        let (driven, failed): (Vec<_>, Vec<_>) = native.into_iter().partition(|output| output.outcome.is_driven());
        rescue.employ(failed, None, TRY_FOR);
        // If nobody reads the log, writing to it blocks, and this process would keep the lines in use forever. Then the
        // alarm ends it (SIGALRM).
        alarm::set(2 * TRY_FOR.as_secs() as u32 + LOG_S);
        let of_threads = rescue.wait(TRY_FOR, |outcome| {
            let seconds = TRY_FOR.as_secs();
            error!("guardian: not yet at its shutdown value, trying for {seconds} s: {}", outcome.complaint());
        });
        alarm::set(LOG_S);
        let pid = program.pid;
        let what = match cause {
            Cause::Died => format!("Pinion (process {pid}) died: was it killed, or did it crash?"),
            Cause::Hangs => format!("{diagnosis}: Pinion (process {pid}) is killed"),
        };
        let outcomes: Vec<_> = driven.iter().map(|output| &output.outcome).chain(&of_threads).collect();
        error!("guardian: {what}; {}", summary(&outcomes));
    }
}
