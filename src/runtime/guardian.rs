// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian: a second process that drives the outputs to their shutdown values if the
//! program dies or its core hangs.
//!
//! It is forked before any thread starts, and is given a copy of every output's descriptor with
//! the shutdown value: a line keeps its state as long as a descriptor of it is open. It acts
//!
//! - when the program's end of their socket closes without a goodbye, or its pidfd says that it
//!   is gone: SIGKILL, a crash, the OOM killer;
//! - when the core leaves no heartbeat in a page that both share, while outputs are held.
//!
//! It drives the outputs, kills the program if that still lives (so that a core which comes back
//! can not drive them again; what it drove meanwhile is driven back), says so in the log, and
//! ends, which frees the lines for a restart. It has a session of its own and ignores the signals
//! that ask a program to end, as a terminal and a service manager send them to both processes:
//! it ends when the program says goodbye.
//!
//! The heartbeat's limit is what the core asks for: while the machine runs, half a second
//! ([`RUNNING`]); else half a minute ([`IDLE`]), as opening a device or ending a bus worker may
//! take its time, and outputs stand at their start or shutdown values then. Silence counts only
//! as far as the guardian itself was awake to hear it, so a suspended or frozen machine is not
//! taken for a core that hangs. The core looks up at least every [`BEAT`].
//!
//! Who kills the guardian stops the machine: the link notices, the machine shuts down as
//! "Guardian process lost", and the program ends with status 1, so that the service manager
//! starts both anew: a second guardian can not be forked from a program with threads.
//!
//! For tests: with `PINION_TEST_HANG` in the environment SIGUSR2 makes the core hang.

#![forbid(unsafe_code)]

use std::io::{self, IoSlice};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use log::{error, warn};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::prctl;
use nix::sys::signal::{Signal, kill};
use nix::sys::socket::{
    AddressFamily, ControlMessage, MsgFlags, SockFlag, SockType, recv, send, sendmsg, setsockopt, socketpair, sockopt,
};
use nix::sys::time::TimeVal;
use nix::sys::uio::pwrite;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::{Pid, alarm, chdir, getpid, getppid, setsid};

use crate::board::Guard;
use crate::sys;
use crate::time::monotonic;

use super::realtime;

/// How long the core may be silent while the machine runs. With [`BEAT`] and [`SLICE`] outputs
/// are driven 450 to 550 ms after the last heartbeat.
const RUNNING: Duration = Duration::from_millis(450);
/// How long the core may be silent while the machine is being configured or is shut down.
const IDLE: Duration = Duration::from_secs(30);
/// A core with nothing to do looks up this often.
pub(super) const BEAT: Duration = Duration::from_millis(200);
/// The guardian looks for a heartbeat this often, while it holds outputs.
const SLICE: Duration = Duration::from_millis(100);
/// How long the program waits for the guardian's answer.
const ANSWER_S: i64 = 5;
/// How long a killed program may take to be gone.
const END: Duration = Duration::from_secs(2);
/// The most that is written to a file.
const FILE_BYTES: usize = 64;

/// The core's heartbeat, in memory that the guardian sees.
#[derive(Clone, Copy)]
pub(super) struct Pulse {
    beats: &'static AtomicU32,
    patience_ms: &'static AtomicU32,
}

impl Pulse {
    pub(super) fn new() -> io::Result<Pulse> {
        let [beats, patience_ms, ..] = sys::shared_words()?;
        let pulse = Pulse { beats, patience_ms };
        pulse.set_patience(IDLE);
        Ok(pulse)
    }

    fn set_patience(&self, patience: Duration) {
        self.patience_ms.store(patience.as_millis() as u32, Ordering::Relaxed);
    }

    /// The core is alive; `running` is whether its machine is configured and not shut down. Only
    /// the core calls this.
    #[inline]
    pub(super) fn beat(&self, running: bool) {
        self.set_patience(if running { RUNNING } else { IDLE });
        self.beats.store(self.beats.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    }
}

/// Listens to a heartbeat.
pub(super) struct Ear {
    pulse: Pulse,
    /// What one look can add to the silence: a listener that slept through more has not heard
    /// whether there was a beat.
    longest: Duration,
    beats: u32,
    silence: Duration,
    looked: Duration,
}

impl Ear {
    /// Listens from `now` on.
    pub(super) fn new(pulse: Pulse, longest: Duration, now: Duration) -> Ear {
        Ear { pulse, longest, beats: pulse.beats.load(Ordering::Relaxed), silence: Duration::ZERO, looked: now }
    }

    /// Begins anew at `now`.
    fn reset(&mut self, now: Duration) {
        *self = Ear::new(self.pulse, self.longest, now);
    }

    fn patience(&self) -> Duration {
        Duration::from_millis(self.pulse.patience_ms.load(Ordering::Relaxed).into())
    }

    /// Whether the heartbeat is missing at `now`.
    pub(super) fn is_silent(&mut self, now: Duration) -> bool {
        let beats = self.pulse.beats.load(Ordering::Relaxed);
        if beats == self.beats {
            self.silence += now.saturating_sub(self.looked).min(self.longest);
        } else {
            self.silence = Duration::ZERO;
        }
        (self.beats, self.looked) = (beats, now);
        self.silence >= self.patience()
    }

    /// When to look again.
    fn next_look(&self) -> Duration {
        self.patience().saturating_sub(self.silence).min(self.longest)
    }
}

/// An output in the guardian's hands.
enum Held {
    /// A GPIO line handle.
    Line { line: OwnedFd, value: bool },
    /// A file, and what is to be written at its beginning: the duty cycle of a PWM.
    File { file: OwnedFd, bytes: Box<[u8]> },
}

impl Held {
    fn drive(&self) -> io::Result<()> {
        match self {
            Held::Line { line, value } => sys::set_line(line.as_fd(), *value),
            Held::File { file, bytes } => match pwrite(file, bytes, 0)? {
                written if written == bytes.len() => Ok(()),
                _ => Err(io::ErrorKind::WriteZero.into()),
            },
        }
    }
}

/// What driving the outputs came to.
#[derive(Default)]
struct Driven {
    outputs: usize,
    failures: usize,
    error: Option<io::Error>,
}

/// Drives every output, whatever becomes of the others. Does not allocate.
fn drive(outputs: &[Held]) -> Driven {
    let mut driven = Driven::default();
    for output in outputs {
        match output.drive() {
            Ok(()) => driven.outputs += 1,
            Err(error) => {
                driven.failures += 1;
                driven.error.get_or_insert(error);
            }
        }
    }
    driven
}

// Messages to the guardian: a kind, and with the first two a descriptor.
const LINE: u8 = 1; // then the value
const FILE: u8 = 2; // then the bytes
const RELEASE: u8 = 3;
const GOODBYE: u8 = 4;
/// The guardian's answers to all but the last.
const TAKEN: u8 = b'+';
const REFUSED: u8 = b'-';

/// The program's end of the guardian. Dropped without [`Guardian::goodbye`] it makes the guardian
/// drive what it holds.
pub struct Guardian {
    socket: Arc<OwnedFd>,
    pid: Pid,
    pulse: Pulse,
}

impl Guardian {
    /// Forks the guardian: before any thread is started. With `realtime` it runs above the core.
    pub fn start(realtime: bool) -> io::Result<Guardian> {
        let about =
            |error: io::Error| io::Error::new(error.kind(), format!("the guardian can not be started: {error}"));
        let pulse = Pulse::new().map_err(about)?;
        let flags = SockFlag::SOCK_CLOEXEC;
        let (socket, theirs) =
            socketpair(AddressFamily::Unix, SockType::SeqPacket, None, flags).map_err(|error| about(error.into()))?;
        setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::new(ANSWER_S, 0))
            .map_err(|error| about(error.into()))?;
        let program = getpid();
        // Before Linux 5.3 the socket alone tells the program's end.
        let pidfd = sys::pidfd(program).ok();
        let ours = socket.as_raw_fd();
        let pid = sys::fork(move || {
            // The program's end, or ours would never see it close.
            let _ = nix::unistd::close(ours);
            settle(realtime);
            let _ = send(theirs.as_raw_fd(), &[TAKEN], MsgFlags::MSG_NOSIGNAL);
            Watcher { socket: theirs, program, pidfd, pulse, outputs: Vec::new() }.watch();
            0
        })
        .map_err(about)?;
        // From here on signals can not harm it.
        answer(&socket).map_err(about)?;
        Ok(Guardian { socket: Arc::new(socket), pid, pulse })
    }

    /// What a board gives its outputs to.
    pub fn guard(&self) -> Box<dyn Guard> {
        Box::new(Lifeline { socket: self.socket.clone(), lost: false })
    }

    pub(super) fn pulse(&self) -> Pulse {
        self.pulse
    }

    /// Hangs up (POLLHUP) once the guardian is gone.
    pub(super) fn socket(&self) -> Arc<OwnedFd> {
        self.socket.clone()
    }

    /// Ends the guardian: the outputs are where they belong.
    pub fn goodbye(self) {
        if send(self.socket.as_raw_fd(), &[GOODBYE], MsgFlags::MSG_NOSIGNAL).is_err() {
            return;
        }
        let until = monotonic() + END;
        while let Ok(WaitStatus::StillAlive) = waitpid(self.pid, Some(WaitPidFlag::WNOHANG)) {
            if monotonic() > until {
                warn!("the guardian (process {}) does not end: is it stopped? kill -CONT it", self.pid);
                return;
            }
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// The board's end of the guardian.
struct Lifeline {
    socket: Arc<OwnedFd>,
    /// After an answer that did not come, later ones might be taken for it.
    lost: bool,
}

impl Lifeline {
    fn ask(&mut self, message: &[u8], descriptor: Option<RawFd>) -> io::Result<()> {
        if self.lost {
            return Err(io::Error::other("it is lost"));
        }
        let asked = self.converse(message, descriptor);
        self.lost = asked.is_err();
        asked
    }

    fn converse(&self, message: &[u8], descriptor: Option<RawFd>) -> io::Result<()> {
        let socket = self.socket.as_raw_fd();
        let fds: Vec<RawFd> = descriptor.into_iter().collect();
        let rights = [ControlMessage::ScmRights(&fds)];
        let control = if fds.is_empty() { &[][..] } else { &rights[..] };
        sendmsg::<()>(socket, &[IoSlice::new(message)], control, MsgFlags::MSG_NOSIGNAL, None)?;
        answer(&self.socket)
    }
}

/// Waits for the guardian's answer.
fn answer(socket: &OwnedFd) -> io::Result<()> {
    let mut answer = [0];
    loop {
        return match recv(socket.as_raw_fd(), &mut answer, MsgFlags::empty()) {
            Err(Errno::EINTR) => continue,
            Err(Errno::EAGAIN) => Err(io::Error::other(format!("it gave no answer within {ANSWER_S} s"))),
            Err(error) => Err(error.into()),
            Ok(1) if answer == [TAKEN] => Ok(()),
            Ok(1) => Err(io::Error::other("it has no room for another descriptor (raise LimitNOFILE)")),
            Ok(_) => Err(io::Error::other("it is gone")),
        };
    }
}

impl Guard for Lifeline {
    fn output(&mut self, line: RawFd, shutdown_value: bool) -> io::Result<()> {
        self.ask(&[LINE, shutdown_value.into()], Some(line))
    }

    fn file(&mut self, file: RawFd, shutdown_bytes: &[u8]) -> io::Result<()> {
        if shutdown_bytes.len() > FILE_BYTES {
            return Err(io::ErrorKind::InvalidInput.into());
        }
        self.ask(&[&[FILE], shutdown_bytes].concat(), Some(file))
    }

    fn release(&mut self) -> io::Result<()> {
        self.ask(&[RELEASE], None)
    }
}

// ---- in the second process

/// Makes the process itself: its name, session, signals and priority.
fn settle(realtime: bool) {
    // None of these can fail where it matters, and there is nobody to tell.
    let _ = prctl::set_name(c"pinion-guardian");
    let _ = setsid();
    let _ = chdir("/");
    for ignored in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT, Signal::SIGUSR1, Signal::SIGUSR2]
    {
        let _ = sys::ignore(ignored);
    }
    // As root: the last to be picked when memory is short.
    let _ = std::fs::write("/proc/self/oom_score_adj", "-1000");
    if realtime {
        realtime::enter_guardian();
    }
    // Whatever driving takes is in memory from now on.
    drop(drive(&[]));
}

struct Watcher {
    socket: OwnedFd,
    program: Pid,
    pidfd: Option<OwnedFd>,
    pulse: Pulse,
    outputs: Vec<Held>,
}

/// Why the outputs are driven.
enum Cause {
    Died,
    Hangs,
}

impl Watcher {
    /// Watches until the program says goodbye or needs help.
    fn watch(mut self) {
        let mut ear = Ear::new(self.pulse, SLICE, monotonic());
        let cause = loop {
            let holding = !self.outputs.is_empty();
            let timeout = holding.then(|| ear.next_look());
            let (message, ended) = self.wait(timeout);
            if message {
                match self.take_message() {
                    Some(true) if !holding => ear.reset(monotonic()),
                    Some(true) => {}
                    Some(false) => return,
                    None => break Cause::Died,
                }
            } else if ended {
                break Cause::Died;
            }
            if holding && ear.is_silent(monotonic()) {
                break Cause::Hangs;
            }
        };
        self.rescue(&cause);
    }

    /// Sleeps; then whether there is a message, and whether the program has ended.
    fn wait(&self, timeout: Option<Duration>) -> (bool, bool) {
        let timeout = timeout.map_or(PollTimeout::NONE, in_ms);
        let pidfd = self.pidfd.as_ref().map_or(self.socket.as_fd(), AsFd::as_fd);
        let mut fds = [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN), PollFd::new(pidfd, PollFlags::POLLIN)];
        if poll(&mut fds, timeout).is_err() {
            return (false, false);
        }
        let [message, ended] = fds.map(|fd| fd.revents().is_some_and(|events| !events.is_empty()));
        (message, ended)
    }

    /// Takes a message in: false is the goodbye, and none the program's end.
    fn take_message(&mut self) -> Option<bool> {
        let mut message = [0; FILE_BYTES + 1];
        let (len, descriptor) = match sys::receive(self.socket.as_fd(), &mut message) {
            Ok((0, _)) => return None,
            Ok(received) => received,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => return Some(true),
            // Most likely out of descriptors.
            Err(_) => {
                self.answer(REFUSED);
                return Some(true);
            }
        };
        match (&message[..len], descriptor) {
            ([GOODBYE], _) => return Some(false),
            ([RELEASE], _) => self.outputs.clear(),
            ([LINE, value], Some(line)) => self.outputs.push(Held::Line { line, value: *value != 0 }),
            ([FILE, bytes @ ..], Some(file)) => self.outputs.push(Held::File { file, bytes: bytes.into() }),
            _ => {
                self.answer(REFUSED);
                return Some(true);
            }
        }
        self.answer(TAKEN);
        Some(true)
    }

    fn answer(&self, answer: u8) {
        // The program that does not hear it is dead, which the next look tells.
        let _ = send(self.socket.as_raw_fd(), &[answer], MsgFlags::MSG_NOSIGNAL);
    }

    fn rescue(&self, cause: &Cause) {
        if self.outputs.is_empty() {
            return;
        }
        let mut driven = drive(&self.outputs);
        if !self.has_ended() {
            // Its pid is its own as long as it is our parent.
            if getppid() == self.program {
                let _ = kill(self.program, Signal::SIGKILL);
            }
            let until = monotonic() + END;
            while !self.has_ended() && monotonic() < until {
                thread::sleep(Duration::from_millis(1));
            }
            driven = drive(&self.outputs);
        }
        // A log that nobody reads must not keep the lines.
        alarm::set(2);
        let what = match cause {
            Cause::Died => format!("Pinion (process {}) died: was it killed, or did it crash?", self.program),
            Cause::Hangs => format!(
                "the core gave no sign of life for {} ms: Pinion (process {}) is killed",
                self.pulse.patience_ms.load(Ordering::Relaxed),
                self.program
            ),
        };
        let Driven { outputs, failures, error } = driven;
        let all = outputs + failures;
        match error {
            None => {
                error!("guardian: {what}; all {all} outputs are driven to their shutdown values, start Pinion again")
            }
            Some(error) => error!(
                "guardian: {what}; only {outputs} of {all} outputs are driven to their shutdown values ({error}): \
                 switch the power off"
            ),
        }
    }

    fn has_ended(&self) -> bool {
        match &self.pidfd {
            Some(pidfd) => is_readable(pidfd.as_fd()),
            None => getppid() != self.program,
        }
    }
}

fn is_readable(fd: BorrowedFd<'_>) -> bool {
    let mut fds = [PollFd::new(fd, PollFlags::POLLIN)];
    poll(&mut fds, PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}

/// A poll's timeout, rounded up.
pub(super) fn in_ms(timeout: Duration) -> PollTimeout {
    let ms = timeout.as_nanos().div_ceil(1_000_000);
    PollTimeout::try_from(ms).unwrap_or(PollTimeout::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{self, File};
    use std::io::{BufRead, BufReader};
    use std::path::Path;
    use std::process::{Child, Command, Stdio};

    const MS: Duration = Duration::from_millis(1);

    fn ear(pulse: Pulse) -> Ear {
        Ear::new(pulse, SLICE, Duration::ZERO)
    }

    #[test]
    fn a_core_that_beats_is_not_silent() {
        let pulse = Pulse::new().unwrap();
        let mut ear = ear(pulse);
        for look in 1..100 {
            if look % 4 == 0 {
                pulse.beat(true);
            }
            assert!(!ear.is_silent(look * 100 * MS), "look {look}");
        }
    }

    #[test]
    fn a_running_core_may_be_silent_for_450_ms() {
        let pulse = Pulse::new().unwrap();
        let mut ear = ear(pulse);
        pulse.beat(true);
        let mut now = Duration::ZERO;
        let silent_at = loop {
            now += ear.next_look();
            if ear.is_silent(now) {
                break now;
            }
        };
        assert_eq!(silent_at, 550 * MS);
    }

    #[test]
    fn a_core_that_is_configured_may_take_its_time() {
        let pulse = Pulse::new().unwrap();
        let mut ear = ear(pulse);
        pulse.beat(false);
        let silent_at = (1..1000).map(|look| look * 100 * MS).find(|now| ear.is_silent(*now));
        assert_eq!(silent_at, Some(IDLE + SLICE));
    }

    #[test]
    fn what_the_listener_slept_through_is_no_silence() {
        let pulse = Pulse::new().unwrap();
        let mut ear = ear(pulse);
        pulse.beat(true);
        assert!(!ear.is_silent(100 * MS));
        // The machine stood still for a minute.
        assert!(!ear.is_silent(Duration::from_secs(60)));
        assert_eq!(ear.silence, SLICE);
        // A guardian that never gets its turn in time still hears a core that hangs.
        let looks = (61..70).take_while(|s| !ear.is_silent(Duration::from_secs(*s))).count();
        assert_eq!(looks, 3);
    }

    /// This test program itself, as a program that is guarded.
    fn start(script: &str, file: &Path) -> (Child, u32) {
        fs::write(file, "on ").unwrap();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "runtime::guardian::tests::guarded_program"])
            .args(["--test-threads=1", "--nocapture"])
            .env("GUARDED_SCRIPT", script)
            .env("GUARDED_FILE", file)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.as_mut().unwrap()).lines();
        let guardian = lines.map_while(Result::ok).find_map(|line| line.strip_prefix("guardian ")?.parse().ok());
        (child, guardian.expect("the guarded program says who guards it"))
    }

    #[test]
    #[ignore = "started by other tests"]
    fn guarded_program() {
        let (Ok(script), Ok(path)) = (std::env::var("GUARDED_SCRIPT"), std::env::var("GUARDED_FILE")) else { return };
        let guardian = Guardian::start(false).unwrap();
        let pulse = guardian.pulse();
        let mut guard = guardian.guard();
        let file = File::options().write(true).open(path).unwrap();
        guard.file(file.as_raw_fd(), b"off").unwrap();
        if script == "release" {
            guard.release().unwrap();
        }
        pulse.beat(script == "hang");
        println!("\nguardian {}", guardian.pid);
        match script.as_str() {
            "abort" => std::process::abort(),
            "goodbye" => guardian.goodbye(),
            _ => loop {
                thread::sleep(Duration::from_secs(1));
            },
        }
    }

    fn wait_until(what: &str, condition: impl Fn() -> bool) {
        let until = monotonic() + Duration::from_secs(20);
        while !condition() {
            assert!(monotonic() < until, "waited in vain: {what}");
            thread::sleep(5 * MS);
        }
    }

    fn is_gone(pid: u32) -> bool {
        // An orphan's zombie may wait for an init that does not care.
        fs::read_to_string(format!("/proc/{pid}/stat")).map_or(true, |stat| stat.contains(") Z "))
    }

    fn content(file: &Path) -> String {
        fs::read_to_string(file).unwrap()
    }

    fn file() -> tempfile::TempPath {
        tempfile::NamedTempFile::new().unwrap().into_temp_path()
    }

    #[test]
    fn a_killed_program_s_outputs_go_to_their_shutdown_values() {
        let file = file();
        let (mut program, guardian) = start("sleep", &file);
        let comm = fs::read_to_string(format!("/proc/{guardian}/comm")).unwrap();
        assert_eq!(comm, "pinion-guardian\n");
        assert_eq!(content(&file), "on ");
        program.kill().unwrap();
        wait_until("driven", || content(&file) == "off");
        wait_until("the guardian ends", || is_gone(guardian));
        program.wait().unwrap();
    }

    #[test]
    fn an_aborted_program_s_outputs_go_to_their_shutdown_values() {
        let file = file();
        let (mut program, guardian) = start("abort", &file);
        wait_until("driven", || content(&file) == "off");
        wait_until("the guardian ends", || is_gone(guardian));
        program.wait().unwrap();
    }

    #[test]
    fn a_program_that_hangs_is_killed_and_its_outputs_driven() {
        use std::os::unix::process::ExitStatusExt;
        let file = file();
        let (mut program, guardian) = start("hang", &file);
        wait_until("driven", || content(&file) == "off");
        assert_eq!(program.wait().unwrap().signal(), Some(9));
        wait_until("the guardian ends", || is_gone(guardian));
    }

    #[test]
    fn signals_that_ask_a_program_to_end_leave_the_guardian_alone() {
        let file = file();
        let (mut program, guardian) = start("sleep", &file);
        for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT] {
            kill(Pid::from_raw(guardian as i32), signal).unwrap();
        }
        thread::sleep(50 * MS);
        assert!(!is_gone(guardian));
        program.kill().unwrap();
        wait_until("driven", || content(&file) == "off");
        program.wait().unwrap();
    }

    #[test]
    fn outputs_that_were_given_back_stay_as_they_are() {
        let file = file();
        let (mut program, guardian) = start("release", &file);
        program.kill().unwrap();
        wait_until("the guardian ends", || is_gone(guardian));
        assert_eq!(content(&file), "on ");
        program.wait().unwrap();
    }

    #[test]
    fn after_a_goodbye_outputs_stay_as_they_are() {
        let file = file();
        let (mut program, guardian) = start("goodbye", &file);
        assert!(program.wait().unwrap().success());
        assert!(is_gone(guardian));
        assert_eq!(content(&file), "on ");
    }

    #[test]
    fn a_program_with_threads_can_not_be_guarded() {
        // libtest runs tests in threads, unless told otherwise.
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let other = thread::spawn(move || stopped.recv());
        let error = Guardian::start(false).err().unwrap();
        assert_eq!(error.to_string(), "the guardian can not be started: threads have been started already");
        drop(stop);
        let _ = other.join();
    }
}
