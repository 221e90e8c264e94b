// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian process. It watches the program, and drives the outputs when the program cannot.

#![forbid(unsafe_code)]

use std::ffi::CStr;
use std::io;
use std::iter;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use log::error;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::signal::{Signal, kill};
use nix::sys::socket::{MsgFlags, send};
use nix::sys::uio::pwrite;
use nix::unistd::{Pid, alarm, getppid};

use pinion_linux::clock::{monotonic, poll_timeout, wait_until};
use pinion_linux::sys;

use super::message::{MESSAGE_BYTES, Message, REFUSED, TAKEN};
use crate::core::heartbeat::{Heartbeat, HeartbeatMonitor};
use crate::process::forked;
use crate::process::realtime;
use crate::recorder::Recording;
use pinion_trace::event::Event;
use pinion_trace::file::End;

#[cfg(fuzzing)]
#[allow(clippy::expect_used)]
pub(crate) mod fuzz;

/// The kernel's name of the guardian's process (proc_pid_comm(5)). Its command line is the program's.
pub(crate) const NAME: &CStr = c"pinion-guardian";
/// How long to wait for the end of a process that was asked to end, or was killed.
pub(super) const END_LIMIT: Duration = Duration::from_secs(2);
/// How long to retry an output that cannot be driven, and how long to wait for a driver that hangs.
const TRY_FOR: Duration = Duration::from_secs(2);
/// Pause between two attempts to drive an output.
const TRY_EVERY: Duration = Duration::from_millis(50);
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
    // When memory is short, the kernel now kills other processes first. Only root may ask for this.
    let _ = std::fs::write("/proc/self/oom_score_adj", "-1000");
    let _ = sys::keep_only(sys::SERVE);
    if realtime {
        realtime::enter_guardian();
    }
    // A first call, without outputs, reads the code from the disk, and so the code is locked in memory too. When it is
    // needed, the disk might hang.
    drive(&mut []);
}

/// Drives an output to its shutdown value.
type Drive = Box<dyn Fn() -> io::Result<()> + Send>;

/// Whether an output could be driven.
struct Outcome {
    name: String,
    /// The result of the last attempt. `None` until the first attempt has returned.
    result: Option<io::Result<()>>,
}

impl Outcome {
    fn is_driven(&self) -> bool {
        matches!(self.result, Some(Ok(())))
    }

    /// For the log: the output's name and its fault.
    fn complaint(&self) -> String {
        match &self.result {
            Some(Err(error)) => format!("{}: {error}", self.name),
            _ => format!("{}: its driver hangs (dmesg)", self.name),
        }
    }
}

/// An output that the guardian holds.
struct Output {
    drive: Drive,
    outcome: Outcome,
}

impl Output {
    fn new(name: &str, drive: Drive) -> Output {
        Output { drive, outcome: Outcome { name: name.into(), result: None } }
    }

    fn line(name: &str, line: OwnedFd, value: bool) -> Output {
        Output::new(name, Box::new(move || sys::set_line(&line, value)))
    }

    /// A line of a chip that may sleep. It is driven in a way that reports whether the chip has answered.
    fn sleeping_line(name: &str, line: OwnedFd, value: bool) -> Output {
        Output::new(name, Box::new(move || sys::set_line_checked(&line, sys::OUTPUT, value)))
    }

    /// An output that is set by files, such as a PWM. Each file has the bytes to write at its beginning.
    fn files(name: &str, files: Vec<(OwnedFd, Box<[u8]>)>) -> Output {
        let drive = move || {
            files.iter().try_for_each(|(file, bytes)| match pwrite(file, bytes, 0)? {
                written if written == bytes.len() => Ok(()),
                _ => Err(io::ErrorKind::WriteZero.into()),
            })
        };
        Output::new(name, Box::new(drive))
    }
}

/// Drives every output, even if others fail. Does not allocate.
fn drive(outputs: &mut [Output]) {
    for Output { drive, outcome } in outputs {
        outcome.result = Some(drive());
    }
}

/// Outputs that one thread drives: a PWM, or the lines of a chip whose driver may sleep.
struct Group {
    chip: String,
    outputs: Vec<Output>,
}

/// The outputs that the guardian holds.
#[derive(Default)]
struct HeldOutputs {
    /// Lines of chips whose drivers never sleep.
    native: Vec<Output>,
    apart: Vec<Group>,
}

impl HeldOutputs {
    fn is_empty(&self) -> bool {
        self.native.is_empty() && self.apart.is_empty()
    }

    /// Holds an output, in place of one with the same name. With `chip` that chip's thread drives it. Without a chip it
    /// is driven with the native lines.
    fn hold(&mut self, chip: Option<&str>, output: Output) {
        self.forget(&output.outcome.name);
        match chip {
            None => self.native.push(output),
            Some(chip) => match self.apart.iter_mut().find(|group| group.chip == chip) {
                Some(group) => group.outputs.push(output),
                None => self.apart.push(Group { chip: chip.into(), outputs: vec![output] }),
            },
        }
    }

    /// Drops the output of this name.
    fn forget(&mut self, name: &str) {
        let others = self.apart.iter_mut().map(|group| &mut group.outputs);
        for outputs in iter::once(&mut self.native).chain(others) {
            outputs.retain(|held| *held.outcome.name != *name);
        }
        self.apart.retain(|group| !group.outputs.is_empty());
    }
}

/// The guarded program.
#[derive(Debug)]
pub(super) struct Program {
    pid: Pid,
    pidfd: Option<OwnedFd>,
}

impl Program {
    /// The process `pid`, which must be our parent.
    pub(super) fn new(pid: Pid) -> Program {
        // Linux before 5.3 has no pidfd. There only the socket shows that the program has ended.
        Program { pid, pidfd: sys::pidfd(pid).ok() }
    }

    fn has_ended(&self) -> bool {
        match &self.pidfd {
            Some(pidfd) => is_readable(pidfd.as_fd()),
            None => getppid() != self.pid,
        }
    }

    fn kill(&self) {
        // While it is our parent, its process number has not been given to another process.
        if getppid() == self.pid {
            let _ = kill(self.pid, Signal::SIGKILL);
        }
    }

    fn wait_for_end(&self) {
        wait_until(monotonic() + END_LIMIT, || self.has_ended());
    }
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
            error!("guardian: after {seconds} s still not at its shutdown value: {}", outcome.complaint());
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

/// For the log: how many outputs could be driven, and the faults of the others.
fn summary(outcomes: &[&Outcome]) -> String {
    let all = outcomes.len();
    let complaints: Vec<_> =
        outcomes.iter().filter(|outcome| !outcome.is_driven()).map(|outcome| outcome.complaint()).collect();
    match complaints.len() {
        0 => format!("all {all} outputs are driven to their shutdown values, start Pinion again"),
        failed => format!(
            "only {} of {all} outputs are driven to their shutdown values ({}): switch the power off",
            all - failed,
            complaints.join(", ")
        ),
    }
}

/// A thread's report after each attempt to drive an output: the output's number, and the result.
type Attempt = (usize, io::Result<()>);

/// Threads that each drive a group of outputs. So a driver that hangs delays neither the other groups nor this process.
struct RescueThreads {
    outcome_to: Sender<Attempt>,
    outcomes_from: Receiver<Attempt>,
    /// Indexed by the outputs' numbers.
    outcomes: Vec<Outcome>,
    /// Work without a thread: none could be started because memory is short.
    left: Vec<Work>,
}

impl Default for RescueThreads {
    fn default() -> RescueThreads {
        let (outcome_to, outcomes_from) = mpsc::channel();
        RescueThreads { outcome_to, outcomes_from, outcomes: Vec::new(), left: Vec::new() }
    }
}

impl RescueThreads {
    /// Starts a thread that drives these outputs, and retries those that fail until `try_for` is over. With `survivor`,
    /// the program still lives and may drive them too. Then they are driven at once, and again when it has ended.
    fn employ(&mut self, outputs: Vec<Output>, survivor: Option<Arc<Program>>, try_for: Duration) {
        let mut drives = Vec::new();
        for Output { drive, outcome } in outputs {
            drives.push((self.outcomes.len(), drive));
            self.outcomes.push(Outcome { result: None, ..outcome });
        }
        // If the thread cannot be started, its closure is dropped with all that it owns. So it shares the work with
        // this function, which can then take the work back.
        let work = Arc::new(Mutex::new(Some(Work { drives, survivor, try_for })));
        let (theirs, outcome_to) = (work.clone(), self.outcome_to.clone());
        let run = move || {
            if let Some(work) = take(&theirs) {
                // Sending fails once `wait` has returned. Nobody needs the result then.
                work.run(|report| drop(outcome_to.send(report)));
            }
        };
        if thread::Builder::new().spawn(run).is_err() {
            self.left.extend(take(&work));
        }
    }

    /// Waits until all outputs are driven, or `limit` is over, and returns the outcomes. It calls `complain` once for
    /// each output whose first attempt fails.
    fn wait(self, limit: Duration, mut complain: impl FnMut(&Outcome)) -> Vec<Outcome> {
        let RescueThreads { outcome_to, outcomes_from, mut outcomes, left } = self;
        // Without this sender the channel closes when the last thread is done, and ends the wait.
        drop(outcome_to);
        let mut note = |(number, result): Attempt| {
            let outcome: &mut Outcome = &mut outcomes[number];
            let first = outcome.result.is_none();
            outcome.result = Some(result);
            if first && !outcome.is_driven() {
                complain(outcome);
            }
        };
        let until = monotonic() + limit;
        while let Ok(report) = outcomes_from.recv_timeout(until.saturating_sub(monotonic())) {
            note(report);
        }
        // This comes last, because a driver that hangs would block this thread.
        for work in left {
            work.run(&mut note);
        }
        outcomes
    }
}

fn take<T>(from: &Mutex<Option<T>>) -> Option<T> {
    from.lock().unwrap_or_else(PoisonError::into_inner).take()
}

/// The work of one thread: see [`RescueThreads::employ`].
struct Work {
    drives: Vec<(usize, Drive)>,
    survivor: Option<Arc<Program>>,
    try_for: Duration,
}

impl Work {
    fn run(self, mut report: impl FnMut(Attempt)) {
        let Work { mut drives, survivor, try_for } = self;
        if let Some(program) = survivor {
            for (_, drive) in &drives {
                // Not reported: they are driven again below.
                let _ = drive();
            }
            program.wait_for_end();
        }
        let until = monotonic() + try_for;
        loop {
            drives.retain(|(number, drive)| {
                let result = drive();
                let failed = result.is_err();
                report((*number, result));
                failed
            });
            if drives.is_empty() || monotonic() >= until {
                return;
            }
            thread::sleep(TRY_EVERY);
        }
    }
}

fn is_readable(fd: BorrowedFd<'_>) -> bool {
    let mut fds = [PollFd::new(fd, PollFlags::POLLIN)];
    poll(&mut fds, PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::errno::Errno;
    use std::cell::Cell;
    use std::sync::atomic::{AtomicU32, Ordering};

    /// Far longer than anything takes.
    const LONG: Duration = Duration::from_secs(60);

    thread_local! {
        /// Dropped when the thread ends, and so after it has reported its results.
        static ALIVE: Cell<Option<Sender<()>>> = const { Cell::new(None) };
    }

    fn output(name: &str, drive: impl Fn() -> io::Result<()> + Send + 'static) -> Output {
        Output::new(name, Box::new(drive))
    }

    /// An output that notes when the thread that drove it ends.
    fn noted(name: &str, alive: &Sender<()>, errno: Option<Errno>) -> Output {
        let alive = alive.clone();
        output(name, move || {
            ALIVE.set(Some(alive.clone()));
            errno.map_or(Ok(()), |errno| Err(errno.into()))
        })
    }

    fn error_code(outcome: &Outcome) -> Option<i32> {
        outcome.result.as_ref()?.as_ref().err()?.raw_os_error()
    }

    /// Its first attempt was made before the program was killed, which nobody complained of.
    #[test]
    fn an_output_that_failed_before_is_complained_of_when_it_fails_again() {
        let mut failing = vec![output("gpiochip0 line 5", || Err(Errno::EIO.into()))];
        drive(&mut failing);
        let mut rescue = RescueThreads::default();
        rescue.employ(failing, None, Duration::ZERO);
        let mut complaints = Vec::new();
        rescue.wait(LONG, |outcome| complaints.push(outcome.complaint()));
        assert_eq!(complaints, ["gpiochip0 line 5: Input/output error (os error 5)"]);
    }

    #[test]
    fn a_driver_that_hangs_keeps_nobody_else() {
        let (_release, hangs) = mpsc::channel::<()>();
        let hangs = Mutex::new(hangs);
        let (alive, ended) = mpsc::channel();
        let stuck = output("gpiochip3 line 5", move || hangs.lock().unwrap().recv().map_err(io::Error::other));
        let mut rescue = RescueThreads::default();
        // A line behind the one that hangs, of the same chip, is lost with it.
        rescue.employ(vec![stuck, output("gpiochip3 line 6", || Ok(()))], None, Duration::ZERO);
        rescue.employ(vec![noted("pwmchip0/pwm0", &alive, Some(Errno::ENODEV))], None, Duration::ZERO);
        rescue.employ(vec![noted("pwmchip0/pwm1", &alive, None)], None, Duration::ZERO);
        drop(alive);
        assert!(ended.recv().is_err(), "both of the others are done");
        let mut complaints = Vec::new();
        let outcomes = rescue.wait(Duration::from_millis(1), |outcome| complaints.push(outcome.complaint()));
        assert!(outcomes[0].result.is_none() && outcomes[1].result.is_none());
        assert_eq!(error_code(&outcomes[2]), Some(libc::ENODEV));
        assert!(outcomes[3].is_driven());
        assert_eq!(complaints, ["pwmchip0/pwm0: No such device (os error 19)"]);
        let summary = summary(&outcomes.iter().collect::<Vec<_>>());
        let begin = "only 1 of 4 outputs are driven to their shutdown values (gpiochip3 line 5: its driver hangs";
        assert!(summary.starts_with(begin) && summary.ends_with("switch the power off"), "{summary}");
    }

    #[test]
    fn an_output_that_fails_is_tried_again_and_those_beside_it_wait_for_nothing() {
        let (tries, others) = (Arc::new(AtomicU32::new(0)), Arc::new(AtomicU32::new(0)));
        let (theirs, of_others) = (tries.clone(), others.clone());
        let failing = output("pwmchip0/pwm0", move || match theirs.fetch_add(1, Ordering::SeqCst) {
            0..3 => Err(Errno::EIO.into()),
            _ => Ok(()),
        });
        let other = output("pwmchip0/pwm1", move || {
            of_others.fetch_add(1, Ordering::SeqCst);
            Ok(())
        });
        let mut rescue = RescueThreads::default();
        rescue.employ(vec![failing, other], None, LONG);
        let mut complaints = 0;
        let outcomes = rescue.wait(LONG, |outcome| {
            assert_eq!(error_code(outcome), Some(libc::EIO));
            complaints += 1;
        });
        assert!(outcomes.iter().all(Outcome::is_driven));
        assert_eq!((complaints, tries.load(Ordering::SeqCst), others.load(Ordering::SeqCst)), (1, 4, 1));
    }

    #[test]
    fn an_output_that_keeps_failing_is_given_up() {
        let mut rescue = RescueThreads::default();
        rescue.employ(vec![output("pwmchip0/pwm0", || Err(Errno::EIO.into()))], None, Duration::from_millis(1));
        let outcomes = rescue.wait(LONG, |_| ());
        assert_eq!(error_code(&outcomes[0]), Some(libc::EIO));
    }

    #[test]
    fn an_output_that_is_given_again_replaces_itself() {
        let value = Arc::new(AtomicU32::new(0));
        let set = |to| {
            let value = value.clone();
            output("gpiochip0 line 5", move || {
                value.store(to, Ordering::SeqCst);
                Ok(())
            })
        };
        let mut held = HeldOutputs::default();
        held.hold(None, set(1));
        held.hold(None, output("gpiochip0 line 6", || Ok(())));
        held.hold(None, set(2));
        held.hold(Some("gpiochip3"), output("gpiochip3 line 5", || Ok(())));
        held.hold(Some("gpiochip3"), output("gpiochip3 line 6", || Ok(())));
        held.hold(Some("gpiochip3"), output("gpiochip3 line 5", || Ok(())));
        assert_eq!((held.native.len(), held.apart.len(), held.apart[0].outputs.len()), (2, 1, 2));
        drive(&mut held.native);
        assert_eq!(value.load(Ordering::SeqCst), 2);
    }
}
