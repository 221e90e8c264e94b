// SPDX-License-Identifier: GPL-3.0-or-later
//! The guardian: a second process that drives the outputs to their shutdown values if the
//! program dies or its core hangs.
//!
//! It is forked before any thread starts, and is given a copy of every output's descriptor with
//! the shutdown value: a line keeps its state as long as a descriptor of it is open. It acts
//!
//! - when the program's end of their socket closes without a goodbye, or its pidfd says that it
//!   is gone: SIGKILL, a crash, the OOM killer;
//! - when the core leaves no heartbeat in a page that both share (`pulse.rs`), while outputs are
//!   held: within 600 ms of its last one while the machine runs.
//!
//! It drives the outputs, kills the program if that still lives (so that a core which comes back
//! can not drive them again; what it drove meanwhile is driven back), says so in the log, and
//! ends, which frees the lines for a restart. It has a session of its own and ignores the signals
//! that ask a program to end, as a terminal and a service manager send them to both processes:
//! it ends when the program says goodbye.
//!
//! Who kills the guardian stops the machine: the link notices, the machine shuts down as
//! "Guardian process lost", and the program ends with status 1, so that the service manager
//! starts both anew: a second guardian can not be forked from a program with threads.
//!
//! For tests: with `PINION_TEST_HANG` in the environment SIGUSR2 makes the core hang.

#![forbid(unsafe_code)]

use std::io::{self, IoSlice};
use std::iter;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
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

use crate::board::linux::Guard;
use crate::sys;
use crate::time::{Monotonic, monotonic};

use super::pulse::{Ear, Pulse};
use super::realtime;

/// How long the program waits for the guardian's answer.
const ANSWER_S: i64 = 5;
/// How long a killed program may take to be gone.
const END: Duration = Duration::from_secs(2);
/// How long a driver may take to let the guardian write.
const DRIVER: Duration = Duration::from_secs(1);
/// The most that is written to a file.
const FILE_BYTES: usize = 64;

// Messages to the guardian: a kind, and with the first three a descriptor.
const LINE: u8 = 1; // then the value
const FILE: u8 = 2; // then the bytes
const MORE: u8 = 3; // the same, of a further file of the same output
const RELEASE: u8 = 4;
const GOODBYE: u8 = 5;
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
    /// Forks the guardian: before any thread is started. `clock` is the core's. With `realtime`
    /// it runs above the core.
    pub fn start(clock: Monotonic, realtime: bool) -> io::Result<Guardian> {
        let about =
            |error: io::Error| io::Error::new(error.kind(), format!("the guardian can not be started: {error}"));
        let pulse = Pulse::new(clock).map_err(about)?;
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
            Watcher::new(theirs, Program { pid: program, pidfd }, pulse).watch();
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
    fn output(&mut self, _name: &str, line: RawFd, shutdown_value: bool, _sleeping: Option<&str>) -> io::Result<()> {
        self.ask(&[LINE, shutdown_value.into()], Some(line))
    }

    fn forget(&mut self, _name: &str) -> io::Result<()> {
        Ok(())
    }

    fn files(&mut self, _name: &str, shutdown: &[(RawFd, &[u8])]) -> io::Result<()> {
        if shutdown.iter().any(|(_, bytes)| bytes.len() > FILE_BYTES) {
            return Err(io::ErrorKind::InvalidInput.into());
        }
        let kinds = iter::once(FILE).chain(iter::repeat(MORE));
        kinds.zip(shutdown).try_for_each(|(kind, (file, bytes))| self.ask(&[&[kind], *bytes].concat(), Some(*file)))
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

/// A GPIO line handle, and where the line belongs.
struct Line {
    line: OwnedFd,
    value: bool,
}

/// What driving the outputs came to.
#[derive(Default)]
struct Driven {
    outputs: usize,
    failures: usize,
    error: Option<io::Error>,
}

impl Driven {
    fn count(&mut self, result: io::Result<()>) {
        match result {
            Ok(()) => self.outputs += 1,
            Err(error) => {
                self.failures += 1;
                self.error.get_or_insert(error);
            }
        }
    }
}

/// Drives every line, whatever becomes of the others. Does not allocate.
fn drive(lines: &[Line]) -> Driven {
    let mut driven = Driven::default();
    for Line { line, value } in lines {
        driven.count(sys::set_line(line.as_fd(), *value));
    }
    driven
}

/// An output that is driven by files, a PWM, and what is to be written at the beginning of each.
struct Device(Vec<(OwnedFd, Box<[u8]>)>);

impl Device {
    fn drive(&self) -> io::Result<()> {
        self.0.iter().try_for_each(|(file, bytes)| match pwrite(file, bytes, 0)? {
            written if written == bytes.len() => Ok(()),
            _ => Err(io::ErrorKind::WriteZero.into()),
        })
    }
}

/// Calls each in a thread of its own: one that never comes back keeps neither the others nor us.
/// What they told is heard until `limit` after `meanwhile` is over. What gets no thread, as memory
/// is short, is called last.
fn apart<F>(calls: Vec<F>, meanwhile: impl FnOnce(), limit: Duration) -> Driven
where
    F: FnOnce() -> io::Result<()> + Send + 'static,
{
    let (tell, told) = mpsc::channel();
    let mut count = calls.len();
    let mut left = Vec::new();
    for call in calls {
        let (tell, call) = (tell.clone(), Arc::new(Mutex::new(Some(call))));
        let theirs = call.clone();
        if thread::Builder::new().spawn(move || take(&theirs).map(|call| tell.send(call()))).is_err() {
            left.push(call);
            count -= 1;
        }
    }
    meanwhile();
    drop(tell);
    let (mut driven, end) = (Driven::default(), monotonic() + limit);
    for _ in 0..count {
        let answer = told.recv_timeout(end.saturating_sub(monotonic()));
        driven.count(answer.unwrap_or_else(|_| Err(io::Error::other("a driver hangs (dmesg)"))));
    }
    left.iter().filter_map(|call| take(call)).for_each(|call| driven.count(call()));
    driven
}

fn take<T>(from: &Mutex<Option<T>>) -> Option<T> {
    from.lock().unwrap_or_else(PoisonError::into_inner).take()
}

/// The guarded program.
struct Program {
    pid: Pid,
    pidfd: Option<OwnedFd>,
}

impl Program {
    fn has_ended(&self) -> bool {
        match &self.pidfd {
            Some(pidfd) => is_readable(pidfd.as_fd()),
            None => getppid() != self.pid,
        }
    }

    fn kill(&self) {
        // Its pid is its own as long as it is our parent.
        if getppid() == self.pid {
            let _ = kill(self.pid, Signal::SIGKILL);
        }
    }

    fn wait_for_end(&self) {
        let until = monotonic() + END;
        while !self.has_ended() && monotonic() < until {
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// Why the outputs are driven.
enum Cause {
    Died,
    Hangs,
}

struct Watcher {
    socket: OwnedFd,
    program: Program,
    pulse: Pulse,
    lines: Vec<Line>,
    devices: Vec<Device>,
}

impl Watcher {
    fn new(socket: OwnedFd, program: Program, pulse: Pulse) -> Watcher {
        Watcher { socket, program, pulse, lines: Vec::new(), devices: Vec::new() }
    }

    fn holds_nothing(&self) -> bool {
        self.lines.is_empty() && self.devices.is_empty()
    }

    /// Watches until the program says goodbye or needs help.
    fn watch(mut self) {
        // While outputs are held.
        let mut ear: Option<Ear> = None;
        let cause = loop {
            let pause = match &mut ear {
                Some(ear) => match ear.listen(self.pulse.now()) {
                    Some(pause) => Some(pause),
                    None => break Cause::Hangs,
                },
                None => None,
            };
            let (message, ended) = self.wait(pause);
            if message {
                match self.take_message() {
                    Some(true) if self.holds_nothing() => ear = None,
                    Some(true) => drop(ear.get_or_insert_with(|| Ear::new(self.pulse, self.pulse.now()))),
                    Some(false) => return,
                    None => break Cause::Died,
                }
            } else if ended {
                break Cause::Died;
            }
        };
        self.rescue(&cause);
    }

    /// Sleeps; then whether there is a message, and whether the program has ended.
    fn wait(&self, timeout: Option<Duration>) -> (bool, bool) {
        let timeout = timeout.map_or(PollTimeout::NONE, in_ms);
        let pidfd = self.program.pidfd.as_ref().map_or(self.socket.as_fd(), AsFd::as_fd);
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
            ([RELEASE], _) => {
                self.lines.clear();
                self.devices.clear();
            }
            ([LINE, value], Some(line)) => self.lines.push(Line { line, value: *value != 0 }),
            ([kind @ (FILE | MORE), bytes @ ..], Some(file)) => {
                let write = (file, bytes.into());
                match self.devices.last_mut().filter(|_| *kind == MORE) {
                    Some(Device(writes)) => writes.push(write),
                    None => self.devices.push(Device(vec![write])),
                }
            }
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

    fn rescue(self, cause: &Cause) {
        if self.holds_nothing() {
            return;
        }
        let Watcher { program, pulse, lines, devices, .. } = self;
        // Lines first: they never keep us.
        let mut driven = drive(&lines);
        let diagnosis = pulse.diagnosis();
        let program = Arc::new(program);
        let survived = !program.has_ended();
        let calls = devices.into_iter().map(|device| {
            let program = program.clone();
            move || {
                let first = device.drive();
                if !survived {
                    return first;
                }
                // What the program did meanwhile is undone.
                program.wait_for_end();
                device.drive()
            }
        });
        let of_devices = apart(
            calls.collect(),
            || {
                if survived {
                    program.kill();
                    program.wait_for_end();
                    driven = drive(&lines);
                }
            },
            DRIVER,
        );
        // A log that nobody reads must not keep the lines.
        alarm::set(2);
        let pid = program.pid;
        let what = match cause {
            Cause::Died => format!("Pinion (process {pid}) died: was it killed, or did it crash?"),
            Cause::Hangs => format!("{diagnosis}: Pinion (process {pid}) is killed"),
        };
        let outputs = driven.outputs + of_devices.outputs;
        let all = outputs + driven.failures + of_devices.failures;
        match driven.error.or(of_devices.error) {
            None => {
                error!("guardian: {what}; all {all} outputs are driven to their shutdown values, start Pinion again")
            }
            Some(error) => error!(
                "guardian: {what}; only {outputs} of {all} outputs are driven to their shutdown values ({error}): \
                 switch the power off"
            ),
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
    use crate::board::Buffer;
    use crate::mcu::{Job, Oid, Ticket, Workers};
    use crate::runtime::workers::Threads;
    use crate::shutdown::Shutdown;
    use nix::sys::resource::{Resource, setrlimit};
    use std::cell::Cell;
    use std::fs::{self, File};
    use std::io::{BufRead, BufReader};
    use std::path::{Path, PathBuf};
    use std::process::{Child, Command, Stdio};

    const MS: Duration = Duration::from_millis(1);

    thread_local! {
        /// Dropped when the thread ends, and so after it has told what its call came to.
        static ALIVE: Cell<Option<mpsc::Sender<()>>> = const { Cell::new(None) };
    }

    #[test]
    fn a_driver_that_hangs_keeps_nobody_else() {
        let (_release, hangs) = mpsc::channel::<()>();
        let (alive, ended) = mpsc::channel();
        let also_alive = alive.clone();
        let calls: Vec<Box<dyn FnOnce() -> io::Result<()> + Send>> = vec![
            Box::new(move || hangs.recv().map_err(io::Error::other)),
            Box::new(move || {
                ALIVE.set(Some(alive));
                Err(Errno::ENODEV.into())
            }),
            Box::new(move || {
                ALIVE.set(Some(also_alive));
                Ok(())
            }),
        ];
        let driven = apart(calls, || assert!(ended.recv().is_err()), MS);
        assert_eq!((driven.outputs, driven.failures), (1, 2));
        assert_eq!(driven.error.unwrap().raw_os_error(), Some(libc::ENODEV));
    }

    /// A device that never is done.
    struct Stuck;

    impl crate::board::Device for Stuck {
        fn run(&mut self, _: &mut Buffer) -> Result<(), Shutdown> {
            loop {
                thread::park();
            }
        }
    }

    /// A core that gets on while a worker does not, and then stops.
    fn stop_with_a_stuck_worker(pulse: Pulse) {
        let mut workers = Threads::new(thread::current(), Arc::new(|| ()), pulse);
        let device = workers.attach("pwmchip7", Box::new(Stuck)).unwrap();
        let job = |stopping| Job { device, ticket: Ticket { oid: Oid(0), tag: 0 }, data: Buffer::new(&[0]), stopping };
        workers.submit(job(false)).unwrap();
        for beats in 0.. {
            if beats == 10 {
                workers.submit(job(true)).unwrap();
            }
            // Never as a machine that runs, of which a busy computer could miss a beat.
            pulse.beat(pulse.now(), false);
            thread::sleep(10 * MS);
        }
    }

    /// A guarded program, which is killed with a test that fails.
    struct Guarded(Child);

    impl Drop for Guarded {
        fn drop(&mut self) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }

    /// This test program itself, as a program that is guarded.
    fn start(script: &str, file: &Path) -> (Guarded, u32) {
        fs::write(file, "on ").unwrap();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "runtime::guardian::tests::guarded_program"])
            .args(["--test-threads=1", "--nocapture"])
            .env("GUARDED_SCRIPT", script)
            .env("GUARDED_FILE", file)
            .stdout(Stdio::piped())
            .stderr(File::create(log_of(file)).unwrap())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.as_mut().unwrap()).lines();
        let guardian = lines.map_while(Result::ok).find_map(|line| line.strip_prefix("guardian ")?.parse().ok());
        (Guarded(child), guardian.expect("the guarded program says who guards it"))
    }

    #[test]
    #[ignore = "started by other tests"]
    fn guarded_program() {
        let (Ok(script), Ok(path)) = (std::env::var("GUARDED_SCRIPT"), std::env::var("GUARDED_FILE")) else { return };
        env_logger::Builder::new().filter_level(log::LevelFilter::Info).init();
        if script == "cramped" {
            // Less than the stack of one more thread.
            let pages: u64 =
                fs::read_to_string("/proc/self/statm").unwrap().split(' ').next().unwrap().parse().unwrap();
            let limit = pages * 4096 + (1 << 20);
            setrlimit(Resource::RLIMIT_AS, limit, limit).unwrap();
        }
        let guardian = Guardian::start(Monotonic::start(), false).unwrap();
        let pulse = guardian.pulse();
        let mut guard = guardian.guard();
        let file = File::options().write(true).open(path).unwrap();
        guard.files(&[(file.as_raw_fd(), b"on?"), (file.as_raw_fd(), b"off")]).unwrap();
        if script == "release" {
            guard.release().unwrap();
        }
        // Before a beat that may be the last.
        println!("\nguardian {}", guardian.pid);
        pulse.beat(pulse.now(), script == "hang");
        match script.as_str() {
            "abort" => std::process::abort(),
            "goodbye" => guardian.goodbye(),
            "stuck" => stop_with_a_stuck_worker(pulse),
            _ => loop {
                thread::sleep(Duration::from_secs(1));
            },
        }
    }

    fn wait_until(what: &str, condition: impl Fn() -> bool) {
        let until = monotonic() + Duration::from_secs(60);
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

    /// A file, in a folder that goes with it.
    fn file() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("output");
        (folder, file)
    }

    fn log_of(file: &Path) -> PathBuf {
        file.with_extension("log")
    }

    #[test]
    fn a_killed_program_s_outputs_go_to_their_shutdown_values() {
        let (_folder, file) = file();
        let (mut program, guardian) = start("sleep", &file);
        let comm = fs::read_to_string(format!("/proc/{guardian}/comm")).unwrap();
        assert_eq!(comm, "pinion-guardian\n");
        assert_eq!(content(&file), "on ");
        program.0.kill().unwrap();
        wait_until("driven", || content(&file) == "off");
        wait_until("the guardian ends", || is_gone(guardian));
        program.0.wait().unwrap();
    }

    #[test]
    fn a_guardian_without_memory_for_threads_drives_the_outputs_all_the_same() {
        let (_folder, file) = file();
        let (mut program, guardian) = start("cramped", &file);
        program.0.kill().unwrap();
        wait_until("the guardian ends", || is_gone(guardian));
        assert_eq!(content(&file), "off");
        assert!(content(&log_of(&file)).contains("all 1 outputs are driven"));
        program.0.wait().unwrap();
    }

    #[test]
    fn an_aborted_program_s_outputs_go_to_their_shutdown_values() {
        let (_folder, file) = file();
        let (mut program, guardian) = start("abort", &file);
        wait_until("driven", || content(&file) == "off");
        wait_until("the guardian ends", || is_gone(guardian));
        program.0.wait().unwrap();
    }

    #[test]
    fn a_program_that_hangs_is_killed_and_its_outputs_driven() {
        use std::os::unix::process::ExitStatusExt;
        let (_folder, file) = file();
        let (mut program, guardian) = start("hang", &file);
        wait_until("driven", || content(&file) == "off");
        assert_eq!(program.0.wait().unwrap().signal(), Some(9));
        wait_until("the guardian ends", || is_gone(guardian));
    }

    #[test]
    fn a_worker_that_does_not_set_the_shutdown_state_is_named_and_the_program_killed() {
        use std::os::unix::process::ExitStatusExt;
        let (_folder, file) = file();
        let (mut program, guardian) = start("stuck", &file);
        wait_until("driven", || content(&file) == "off");
        assert_eq!(program.0.wait().unwrap().signal(), Some(9));
        wait_until("the guardian ends", || is_gone(guardian));
        let log = content(&log_of(&file));
        assert!(log.contains("the worker of pwmchip7 did not set the shutdown state within 1000 ms:"), "{log}");
        // Two files are one output.
        assert!(log.contains("all 1 outputs are driven to their shutdown values"), "{log}");
    }

    #[test]
    fn signals_that_ask_a_program_to_end_leave_the_guardian_alone() {
        let (_folder, file) = file();
        let (mut program, guardian) = start("sleep", &file);
        for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT] {
            kill(Pid::from_raw(guardian as i32), signal).unwrap();
        }
        thread::sleep(50 * MS);
        assert!(!is_gone(guardian));
        program.0.kill().unwrap();
        wait_until("driven", || content(&file) == "off");
        program.0.wait().unwrap();
    }

    #[test]
    fn outputs_that_were_given_back_stay_as_they_are() {
        let (_folder, file) = file();
        let (mut program, guardian) = start("release", &file);
        program.0.kill().unwrap();
        wait_until("the guardian ends", || is_gone(guardian));
        assert_eq!(content(&file), "on ");
        program.0.wait().unwrap();
    }

    #[test]
    fn after_a_goodbye_outputs_stay_as_they_are() {
        let (_folder, file) = file();
        let (mut program, guardian) = start("goodbye", &file);
        assert!(program.0.wait().unwrap().success());
        assert!(is_gone(guardian));
        assert_eq!(content(&file), "on ");
    }

    #[test]
    fn a_program_with_threads_can_not_be_guarded() {
        // libtest runs tests in threads, unless told otherwise.
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let other = thread::spawn(move || stopped.recv());
        let error = Guardian::start(Monotonic::start(), false).err().unwrap();
        assert_eq!(error.to_string(), "the guardian can not be started: threads have been started already");
        drop(stop);
        let _ = other.join();
    }
}
