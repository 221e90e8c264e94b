// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian is a second process. It drives the outputs to their shutdown values if the program dies or its core
//! hangs.
//!
//! It is forked before any thread starts. It gets a copy of every output's descriptor, with the shutdown value. While
//! it has the descriptor of a line open, the kernel keeps that line's level. It acts
//!
//! - when the program's end of their socket closes without a goodbye, or its pidfd says that it is gone: SIGKILL, a
//!   crash, the OOM killer;
//! - when the core leaves no heartbeat in a page that both share (`heartbeat.rs`), while outputs are held: within 600 ms of
//!   the last heartbeat while the MCU runs.
//!
//! Then it drives the outputs, and kills the program if it still lives. It drives the outputs once more: the core may
//! have come back and driven them before it was killed. It logs the result and ends, which frees the lines for a
//! restart.
//!
//! It has a session of its own and ignores the signals that ask a program to end. A terminal or service manager sends
//! them to both processes. The guardian must not end before the program, which says goodbye to it.
//!
//! If the guardian itself is killed, stopped or hangs, the link notices. The MCU shuts down as "Guardian process lost".
//! The program ends with status 1, so that the service manager starts both again. (The program cannot fork another
//! guardian, because it has threads by then.)
//!
//! This file is the program's side. `watcher.rs` is the second process. `message.rs` has the messages between them.
//!
//! For tests: with `PINION_TEST_HANG` in the environment SIGUSR2 makes the core hang.

mod message;
mod outputs;
mod program;
mod rescue;
mod watcher;

use std::io::{self, IoSlice};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::sync::Arc;
use std::time::Duration;

use log::warn;
use nix::errno::Errno;
use nix::sys::signal::{Signal, kill};
use nix::sys::socket::{
    AddressFamily, ControlMessage, MsgFlags, SockFlag, SockType, recv, send, sendmsg, setsockopt, socketpair, sockopt,
};
use nix::sys::time::{TimeVal, TimeValLike as _};
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::{Pid, getpid};

use pinion_firmware::board::ShutdownValue;
use pinion_firmware::trouble::Trouble;
use pinion_linux::Guard;
use pinion_linux::clock::{monotonic, wait_until};
use pinion_linux::sys;

use crate::core::heartbeat::Heartbeat;
use crate::core::monitors::GuardianMonitor;
use crate::process::forked::THREADS_MAX;
use crate::recorder::Recording;
use crate::trouble::{NO_PROCESS, refused};

use message::{Message, TAKEN};
use program::{END_LIMIT, Program};
use watcher::Watcher;

pub(crate) use watcher::NAME;
#[cfg(fuzzing)]
pub(crate) use watcher::fuzz;

/// How long the program waits for the guardian's answer, in seconds.
const ANSWER_S: i64 = 5;

/// The program's side of the guardian. If it is dropped without [`Guardian::goodbye`], the guardian
/// drives the outputs that it holds.
pub struct Guardian {
    socket: Arc<OwnedFd>,
    pid: Pid,
    heartbeat: Heartbeat,
}

impl Guardian {
    /// Forks the guardian. Call it before any thread starts. In real time the guardian's priority is above the core's.
    /// It keeps the recording if the program cannot.
    ///
    /// # Errors
    ///
    /// There are threads already, or the kernel has no room for a process, a socket or a page.
    pub fn start(recording: &Recording) -> Result<Guardian, Trouble> {
        Guardian::try_start(recording)
            .map_err(|error| refused("the guardian cannot be started", error).remedy(NO_PROCESS))
    }

    fn try_start(recording: &Recording) -> io::Result<Guardian> {
        let heartbeat = Heartbeat::new(recording.clock())?;
        let (socket, theirs) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, SockFlag::SOCK_CLOEXEC)?;
        setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::seconds(ANSWER_S))?;
        let program = Program::new(getpid());
        let pid = sys::fork(THREADS_MAX, move || {
            watcher::settle(recording.is_realtime(), &theirs, &program);
            Watcher::new(theirs, program, heartbeat, recording.clone()).watch();
            0
        })?;
        // The guardian answers once it ignores the signals that end a program.
        answer(&socket)?;
        Ok(Guardian { socket: Arc::new(socket), pid, heartbeat })
    }

    /// The board gives its outputs to this.
    pub fn guard(&self) -> Box<dyn Guard> {
        Box::new(Lifeline { socket: self.socket.clone(), heartbeat: self.heartbeat, lost: false })
    }

    pub(super) fn heartbeat(&self) -> Heartbeat {
        self.heartbeat
    }

    /// Its process.
    pub(super) fn pid(&self) -> u32 {
        self.pid.as_raw().unsigned_abs()
    }

    /// The link watches this to notice that the guardian is lost.
    pub(super) fn watch(&self) -> GuardianWatch {
        GuardianWatch { socket: self.socket.clone(), monitor: GuardianMonitor::new(self.heartbeat) }
    }

    /// Ends the guardian. The outputs must be at their shutdown values.
    pub fn goodbye(self) {
        if self.report_goodbye().is_err() {
            return;
        }
        let has_ended = || !matches!(waitpid(self.pid, Some(WaitPidFlag::WNOHANG)), Ok(WaitStatus::StillAlive));
        if !wait_until(monotonic() + END_LIMIT, has_ended) {
            warn!("the guardian (process {}) is stopped or hangs, and would keep the lines: Pinion kills it", self.pid);
            // The guardian is our child and was not waited for yet. So the kernel cannot have given its process number
            // to another process.
            let _ = kill(self.pid, Signal::SIGKILL);
        }
    }

    fn report_goodbye(&self) -> io::Result<()> {
        let message = Message::Goodbye.encode().ok_or(io::ErrorKind::InvalidInput)?;
        send(self.socket.as_raw_fd(), &message, MsgFlags::MSG_NOSIGNAL)?;
        Ok(())
    }
}

/// The link's view of the guardian.
pub(super) struct GuardianWatch {
    socket: Arc<OwnedFd>,
    monitor: GuardianMonitor,
}

impl GuardianWatch {
    /// A socket that hangs up (POLLHUP) once the guardian is gone.
    pub(super) fn socket(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// When to call [`GuardianWatch::hangs`] next (CLOCK_MONOTONIC). `None` while no outputs are held.
    pub(super) fn due(&self) -> Option<Duration> {
        self.monitor.due()
    }

    /// Whether the guardian is stopped or hangs at `now` (CLOCK_MONOTONIC).
    pub(super) fn hangs(&mut self, now: Duration) -> bool {
        self.monitor.is_lost(now)
    }
}

/// The board's way to the guardian.
struct Lifeline {
    socket: Arc<OwnedFd>,
    heartbeat: Heartbeat,
    /// An answer has failed to come. Then nothing is asked any more: a late answer would pass for the answer to the
    /// next message.
    lost: bool,
}

impl Lifeline {
    fn ask(&mut self, message: &Message<'_>, descriptor: Option<RawFd>) -> io::Result<()> {
        if self.lost {
            return Err(io::Error::other("it is lost"));
        }
        let message = message.encode().ok_or(io::ErrorKind::InvalidInput)?;
        if self.converse(&message, descriptor)? {
            return Ok(());
        }
        Err(io::Error::other("it has no room for another descriptor (raise LimitNOFILE)"))
    }

    /// Sends a message, and returns whether the guardian has carried it out. Without an answer the guardian counts as
    /// lost.
    fn converse(&mut self, message: &[u8], descriptor: Option<RawFd>) -> io::Result<bool> {
        let fds: Vec<RawFd> = descriptor.into_iter().collect();
        let rights = [ControlMessage::ScmRights(&fds)];
        let control = if fds.is_empty() { &[][..] } else { &rights[..] };
        let socket = self.socket.as_raw_fd();
        let sent = sendmsg::<()>(socket, &[IoSlice::new(message)], control, MsgFlags::MSG_NOSIGNAL, None);
        sent.map_err(io::Error::from).and_then(|_| answer(&self.socket)).inspect_err(|_| {
            self.lost = true;
            self.heartbeat.miss_answer();
        })
    }
}

/// Waits for the guardian's answer, and returns whether that is [`TAKEN`].
fn answer(socket: &OwnedFd) -> io::Result<bool> {
    let mut answer = [0];
    loop {
        return match recv(socket.as_raw_fd(), &mut answer, MsgFlags::empty()) {
            Err(Errno::EINTR) => continue,
            Err(Errno::EAGAIN) => Err(io::Error::other(format!("it gave no answer within {ANSWER_S} s"))),
            Err(error) => Err(error.into()),
            Ok(1) => Ok(answer == [TAKEN]),
            Ok(_) => Err(io::Error::other("it is gone")),
        };
    }
}

impl Guard for Lifeline {
    fn output(
        &mut self,
        name: &str,
        line: RawFd,
        shutdown_value: ShutdownValue<bool>,
        sleeping: Option<&str>,
    ) -> io::Result<()> {
        self.ask(&Message::Line { name, shutdown_value: shutdown_value.get(), sleeping }, Some(line))
    }

    fn files(&mut self, name: &str, shutdown: &[(RawFd, &[u8])]) -> io::Result<()> {
        let Some(((file, bytes), others)) = shutdown.split_last() else { return Ok(()) };
        others.iter().try_for_each(|(file, bytes)| self.ask(&Message::File(bytes), Some(*file)))?;
        self.ask(&Message::LastFile { name, bytes }, Some(*file))
    }

    fn forget(&mut self, name: &str) -> io::Result<()> {
        self.ask(&Message::Forget { name }, None)
    }

    fn release(&mut self) -> io::Result<()> {
        self.ask(&Message::Release, None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::sys::resource::{Resource, setrlimit};
    use std::fs::{self, File};
    use std::io::{BufRead, BufReader};
    use std::os::unix::process::ExitStatusExt;
    use std::process::{Child, Command, Stdio};
    use std::thread;

    const MS: Duration = Duration::from_millis(1);

    /// A core that continues to run, with a shutdown value that is pending forever.
    fn stop_with_pending(heartbeat: Heartbeat) {
        for beats in 0.. {
            if beats == 10 {
                heartbeat.set_pending("pwmchip7/pwm0", heartbeat.now());
            }
            // This is the beat of a stopped MCU, which has a wider limit: a busy computer may delay a beat.
            heartbeat.beat(heartbeat.now(), false);
            thread::sleep(10 * MS);
        }
    }

    /// A guarded program: this test program itself, with an output in a file. It is killed when its test fails.
    struct Guarded {
        program: Child,
        guardian: u32,
        folder: tempfile::TempDir,
    }

    impl Guarded {
        /// Starts it, kills it, and waits until its guardian has ended.
        fn killed(script: &str) -> Guarded {
            let mut guarded = Guarded::start(script);
            guarded.kill();
            guarded
        }

        fn start(script: &str) -> Guarded {
            let folder = tempfile::tempdir().unwrap();
            let file = folder.path().join("output");
            fs::write(&file, "on ").unwrap();
            let mut program = Command::new(std::env::current_exe().unwrap())
                .args(["--ignored", "--exact", "guardian::tests::guarded_program"])
                .args(["--test-threads=1", "--nocapture"])
                .env("GUARDED_SCRIPT", script)
                .env("GUARDED_FILE", file)
                .stdout(Stdio::piped())
                .stderr(File::create(folder.path().join("log")).unwrap())
                .spawn()
                .unwrap();
            let lines = BufReader::new(program.stdout.as_mut().unwrap()).lines();
            let guardian = lines.map_while(Result::ok).find_map(|line| line.strip_prefix("guardian ")?.parse().ok());
            Guarded { program, guardian: guardian.expect("the guarded program says who guards it"), folder }
        }

        /// Kills the program, and waits until its guardian has ended.
        fn kill(&mut self) {
            self.program.kill().unwrap();
            self.wait_for_the_guardian();
        }

        fn wait_for_the_guardian(&mut self) {
            let until = monotonic() + Duration::from_secs(60);
            while !is_gone(self.guardian) {
                assert!(monotonic() < until, "the guardian does not end");
                thread::sleep(5 * MS);
            }
        }

        /// Waits for the program's end, and returns the signal that ended it.
        fn signal(&mut self) -> Option<i32> {
            self.program.wait().unwrap().signal()
        }

        fn output(&self) -> String {
            fs::read_to_string(self.folder.path().join("output")).unwrap()
        }

        fn log(&self) -> String {
            fs::read_to_string(self.folder.path().join("log")).unwrap()
        }
    }

    impl Drop for Guarded {
        fn drop(&mut self) {
            let _ = self.program.kill();
            let _ = self.program.wait();
        }
    }

    fn is_gone(pid: u32) -> bool {
        // An orphan's zombie may wait for an init that does not care.
        fs::read_to_string(format!("/proc/{pid}/stat")).map_or(true, |stat| stat.contains(") Z "))
    }

    #[test]
    #[ignore = "started by other tests"]
    fn guarded_program() {
        let (Ok(script), Ok(path)) = (std::env::var("GUARDED_SCRIPT"), std::env::var("GUARDED_FILE")) else { return };
        env_logger::Builder::new().filter_level(log::LevelFilter::Info).init();
        let recording = Recording::of_a_test();
        if script == "cramped" {
            // Less than the stack of one more thread.
            let pages: nix::sys::resource::rlim_t =
                fs::read_to_string("/proc/self/statm").unwrap().split(' ').next().unwrap().parse().unwrap();
            let limit = pages * 4096 + (1 << 20);
            setrlimit(Resource::RLIMIT_AS, limit, limit).unwrap();
        }
        let guardian = Guardian::start(&recording).unwrap();
        let heartbeat = guardian.heartbeat();
        let mut guard = guardian.guard();
        let file = File::options().read(true).write(script != "readonly").open(path).unwrap();
        let shutdown: [(RawFd, &[u8]); 2] = [(file.as_raw_fd(), b"on?"), (file.as_raw_fd(), b"off")];
        if script == "again" {
            // A value that is then replaced.
            guard.files("pwmchip7/pwm0", &[(file.as_raw_fd(), b"old"), (file.as_raw_fd(), b"bad")]).unwrap();
        }
        guard.files("pwmchip7/pwm0", &shutdown).unwrap();
        if script == "release" {
            guard.release().unwrap();
        }
        // This comes before a beat that may be the last.
        println!("\nguardian {}", guardian.pid);
        heartbeat.beat(heartbeat.now(), script == "hang");
        match script.as_str() {
            "abort" => std::process::abort(),
            "goodbye" => guardian.goodbye(),
            "pending" => stop_with_pending(heartbeat),
            _ => loop {
                thread::sleep(Duration::from_secs(1));
            },
        }
    }

    #[test]
    fn a_killed_program_s_outputs_go_to_their_shutdown_values() {
        let mut guarded = Guarded::start("sleep");
        let comm = fs::read_to_string(format!("/proc/{}/comm", guarded.guardian)).unwrap();
        assert_eq!(comm, "pinion-guardian\n");
        assert_eq!(guarded.output(), "on ");
        guarded.kill();
        assert_eq!(guarded.output(), "off");
    }

    /// An output that is given again goes to the later value. A guardian without memory for threads drives it all the
    /// same.
    #[test]
    fn an_output_goes_to_its_last_shutdown_value_also_without_memory_for_threads() {
        for script in ["again", "cramped"] {
            let guarded = Guarded::killed(script);
            assert_eq!(guarded.output(), "off", "{script}");
            assert!(guarded.log().contains("all 1 outputs are driven"), "{script}: {}", guarded.log());
        }
    }

    #[test]
    fn an_output_that_can_not_be_driven_is_named() {
        let guarded = Guarded::killed("readonly");
        let log = guarded.log();
        assert!(
            log.contains(
                "not yet at its shutdown value, trying for 2 s: pwmchip7/pwm0: Bad file descriptor (os error 9)"
            ),
            "{log}"
        );
        assert!(log.contains("only 0 of 1 outputs are driven") && log.contains("switch the power off"), "{log}");
    }

    #[test]
    fn an_aborted_program_s_outputs_go_to_their_shutdown_values() {
        let mut guarded = Guarded::start("abort");
        guarded.wait_for_the_guardian();
        assert_eq!(guarded.output(), "off");
    }

    #[test]
    fn a_program_that_hangs_is_killed_and_its_outputs_driven() {
        let mut guarded = Guarded::start("hang");
        assert_eq!(guarded.signal(), Some(9));
        guarded.wait_for_the_guardian();
        assert_eq!(guarded.output(), "off");
    }

    #[test]
    fn an_output_that_does_not_get_its_shutdown_value_is_named_and_the_program_killed() {
        let mut guarded = Guarded::start("pending");
        assert_eq!(guarded.signal(), Some(9));
        guarded.wait_for_the_guardian();
        assert_eq!(guarded.output(), "off");
        let log = guarded.log();
        assert!(log.contains("pwmchip7/pwm0 is not at its shutdown value within 1000 ms:"), "{log}");
        // Two files are one output.
        assert!(log.contains("all 1 outputs are driven to their shutdown values"), "{log}");
    }

    #[test]
    fn signals_that_ask_a_program_to_end_leave_the_guardian_alone() {
        let mut guarded = Guarded::start("sleep");
        for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT] {
            kill(Pid::from_raw(guarded.guardian as i32), signal).unwrap();
        }
        // One of them would have ended it before it sees this.
        guarded.kill();
        assert_eq!(guarded.output(), "off");
    }

    #[test]
    fn outputs_that_were_given_back_stay_as_they_are() {
        let guarded = Guarded::killed("release");
        assert_eq!(guarded.output(), "on ");
    }

    #[test]
    fn after_a_goodbye_outputs_stay_as_they_are() {
        let mut guarded = Guarded::start("goodbye");
        assert!(guarded.program.wait().unwrap().success());
        // The program kills a guardian that is slow to end, and does not wait for that.
        guarded.wait_for_the_guardian();
        assert_eq!(guarded.output(), "on ");
    }

    #[test]
    fn a_program_with_threads_can_not_be_guarded() {
        // libtest runs tests in threads by default.
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let other = thread::spawn(move || stopped.recv());
        let error = Guardian::start(&Recording::of_a_test()).err().unwrap();
        assert_eq!(error.found(), "the guardian cannot be started: threads have been started already");
        drop(stop);
        let _ = other.join();
    }
}
