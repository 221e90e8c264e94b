// SPDX-License-Identifier: GPL-3.0-or-later
//! The flight recorder. Each thread writes 16-byte events into a ring of its own (`memory.rs`, `tape.rs`). A thread of
//! low priority reads the kernel's accounts some times a second (`computer.rs`). At each stop of the MCU it keeps the
//! rings in a file, and logs who was late. If the program dies or hangs, the guardian does that.

#![forbid(unsafe_code)]

mod computer;
mod edges;
mod memory;
mod tape;

use std::collections::BTreeMap;
use std::fs::{self, File, Permissions};
use std::io::{self, PipeReader, PipeWriter};
use std::os::fd::AsFd;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, SystemTime};

use log::{info, warn};
use nix::poll::{PollFd, PollFlags, poll};
use nix::sys::eventfd::{EfdFlags, EventFd};
use nix::sys::utsname::uname;
use nix::unistd::{Pid, gettid};
use rtrb::{Consumer, RingBuffer};

use pinion_firmware::board::Board;
use pinion_firmware::mcu::Dialect;
use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks, TimeSource};
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::{Monotonic, monotonic, poll_timeout, wait_until};
use pinion_protocol::format;
use pinion_shared::ring::Ring;

use crate::trace::event::{Event, Watched};
use crate::trace::file::{End, Head, Names, SSH, Thread, Trace};
use crate::trace::folder;
use crate::trace::ring::Writer;
use crate::trace::verdict::verdict;
use crate::{FIRMWARE, status};

use super::link::LinkName;
use super::status::Place;

use computer::Computer;
use edges::{EdgeBoard, EdgeTape};
use memory::Memory;
use tape::News;
pub use tape::Sleep;
pub(super) use tape::Tape;

/// How long the recorder waits after a stop, so that the events of all threads are there.
const SETTLE: Duration = Duration::from_millis(20);
/// Highest number of files that are kept for an instance.
const KEPT_MAX: usize = 10;
/// How long a client may take to read a recording.
const CLIENT_LIMIT: Duration = Duration::from_secs(5);
/// How long the end of the program waits until the last stop is kept.
const END_LIMIT: Duration = Duration::from_secs(1);
/// How many news of the core may wait.
const NEWS: usize = 16;

/// A recording: its memory, and how its files are made.
#[derive(Clone)]
pub struct Recording {
    memory: Memory,
    clock: Monotonic,
    link: PathBuf,
    wire: Option<String>,
    realtime: bool,
    folders: Vec<PathBuf>,
}

impl Recording {
    /// An empty recording of the instance with this link. `clock` is the core's. Files go into the first of `folders`
    /// that takes them; without a folder nothing is kept.
    ///
    /// # Errors
    ///
    /// The kernel has no memory for it.
    pub fn new(clock: Monotonic, link: &Path, realtime: bool, folders: Vec<PathBuf>) -> Result<Recording, Trouble> {
        let memory = Memory::new().map_err(super::no_room)?;
        Ok(Recording { memory, clock, link: link.to_owned(), wire: None, realtime, folders })
    }

    /// The recording of an instance that serves its host over this link.
    pub fn over(self, link: &LinkName) -> Recording {
        Recording { wire: (!link.is_local()).then(|| link.to_string()), ..self }
    }

    #[cfg(any(test, fuzzing))]
    #[allow(clippy::expect_used)]
    pub(super) fn of_a_test() -> Recording {
        Recording::new(Monotonic::start(), Path::new("/tmp/klipper_host_test"), false, Vec::new()).expect("memory")
    }

    /// The clock of the core and of the events.
    pub(super) fn clock(&self) -> Monotonic {
        self.clock
    }

    /// Whether the core is asked to run in real time.
    pub(super) fn is_realtime(&self) -> bool {
        self.realtime
    }

    /// Its description for the status.
    pub(super) fn status(&self) -> status::Recorder {
        status::Recorder {
            bytes: self.memory.bytes(),
            folder: self.folders.first().map(|folder| folder.display().to_string()),
        }
    }

    /// The writer of a worker.
    pub(super) fn worker(&self, bus: &str) -> Option<Writer> {
        self.memory.worker(bus)
    }

    /// The guardian's writer.
    pub(super) fn guardian(&self) -> Option<Writer> {
        self.memory.guardian()
    }

    /// What the recording says now.
    fn trace(&self, end: End, ended_at: Clock) -> Trace {
        let thread = |ring: Ring<'_>| Thread {
            name: ring.name(),
            events: ring.newest().into_iter().filter_map(Event::decode).collect(),
        };
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let ago = Duration::from_nanos(self.clock.now().since(ended_at).max(0).unsigned_abs() * NS_PER_TICK);
        let names = self.memory.names();
        let head = Head {
            version: FIRMWARE.version.to_owned(),
            link: self.link.display().to_string(),
            wire: self.wire.clone().or_else(|| names.is_carried.then(|| SSH.to_owned())),
            end,
            ended_at: ended_at.to_bits(),
            utc_ms: now.saturating_sub(ago).as_millis() as u64,
            realtime: self.realtime,
            processors: thread::available_parallelism().map_or(1, usize::from),
            kernel: uname().map(|name| name.release().to_string_lossy().into_owned()).unwrap_or_default(),
            names,
        };
        Trace { head, threads: self.memory.rings().map(thread).collect() }
    }

    /// Keeps a trace in a file, and logs who was late.
    fn keep(&self, trace: &Trace) {
        if self.folders.is_empty() {
            return;
        }
        let found = verdict(trace);
        match self.write(trace) {
            Ok(path) => info!("{} (pinion trace {})", found.text, path.display()),
            Err(error) => {
                info!("{}", found.text);
                warn!("the trace of this stop is not kept: {error}: make room on the disk, or the folder");
            }
        }
    }

    /// Keeps the recording of a program that died or hung. It leaves out a program that no host had configured.
    pub(super) fn keep_of_the_dead(&self, end: End) {
        let trace = self.trace(end, self.clock.now());
        let mut events = trace.threads.iter().flat_map(|thread| &thread.events);
        if events.any(|(_, event)| matches!(event, Event::Configured | Event::BlockIn(_))) {
            self.keep(&trace);
        }
    }

    fn write(&self, trace: &Trace) -> io::Result<PathBuf> {
        let mut errors = Vec::new();
        for folder in &self.folders {
            match self.write_into(folder, trace) {
                Ok(path) => return Ok(path),
                Err(error) => errors.push(format!("{}: {error}", folder.display())),
            }
        }
        Err(io::Error::other(errors.join("; ")))
    }

    fn write_into(&self, folder: &Path, trace: &Trace) -> io::Result<PathBuf> {
        folder::make(folder)?;
        let name = folder::name_of(&self.link);
        let path = folder::new_file(folder, &name, trace.head.utc_ms);
        // A rename puts only a whole file in place. A full disk or a power cut leaves none.
        let fresh = folder.join(format!(".{name}.{}", std::process::id()));
        let written = File::create(&fresh).and_then(|file| {
            // Everybody may read when the MCU moved which line.
            file.set_permissions(Permissions::from_mode(0o644))?;
            trace.write(file)
        });
        written.and_then(|()| fs::rename(&fresh, &path)).inspect_err(|_| drop(fs::remove_file(&fresh)))?;
        // After the clock was set back, the others seem newer.
        let others = folder::kept(folder, &name).into_iter().filter(|other| *other != path);
        for old in others.skip(KEPT_MAX - 1) {
            let _ = fs::remove_file(old);
        }
        Ok(path)
    }
}

/// The span from a time to a later one.
pub(super) fn span(from: Clock, to: Clock) -> Ticks {
    Ticks(to.since(from).clamp(0, u32::MAX.into()) as u32)
}

/// The names, for a moment.
fn locked(names: &Mutex<Names>) -> MutexGuard<'_, Names> {
    names.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The names of the host's commands.
fn commands(dialect: &Dialect) -> BTreeMap<u16, String> {
    let commands = dialect.dictionary().commands.iter();
    let named = commands.filter_map(|(form, id)| Some((id.as_i64()?.try_into().ok()?, format::name(form).to_owned())));
    named.collect()
}

/// The program's side of the recorder's thread. The thread ends when this is dropped.
pub(super) struct Recorder {
    recording: Recording,
    names: Arc<Mutex<Names>>,
    wake: Arc<EventFd>,
    news: Option<Consumer<News>>,
    thread: Option<(PipeWriter, JoinHandle<()>, Option<Place>)>,
}

impl Recorder {
    /// A recorder whose thread has not started, and the core's tape.
    pub(super) fn new(recording: Recording) -> io::Result<(Recorder, Tape)> {
        let wake = Arc::new(EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?);
        let (producer, news) = RingBuffer::new(NEWS);
        let writers = recording.memory.core().ok_or_else(|| io::Error::other("the recording has another core"))?;
        recording.memory.touch();
        let tape = Tape::new(writers, producer, wake.clone());
        Ok((Recorder { recording, names: Arc::default(), wake, news: Some(news), thread: None }, tape))
    }

    /// Names the commands of the host's dialect.
    pub(super) fn speak(&self, dialect: &Dialect) {
        locked(&self.names).commands = commands(dialect);
        let _ = self.wake.write(1);
    }

    /// Notes whether the present host is on another computer, and `pinion attach` carries it.
    pub(super) fn carry(&self, is_carried: bool) {
        if std::mem::replace(&mut locked(&self.names).is_carried, is_carried) != is_carried {
            let _ = self.wake.write(1);
        }
    }

    /// The same board, which also records the edges of its outputs.
    pub(super) fn with_edges(&self, board: Box<dyn Board>) -> Box<dyn Board> {
        let Some(writer) = self.recording.memory.edges() else { return board };
        let tape = Arc::new(EdgeTape { writer: Mutex::new(writer), clock: self.recording.clock });
        Box::new(EdgeBoard { board, tape, names: self.names.clone() })
    }

    /// The link's writer.
    pub(super) fn link(&self) -> Option<Writer> {
        self.recording.memory.link()
    }

    /// Starts the thread. The calling thread is the link. `socket` is where `pinion trace --live` asks.
    pub(super) fn start(&mut self, socket: Option<(UnixListener, Place)>) -> io::Result<()> {
        let Some(news) = self.news.take() else { return Ok(()) };
        let (end, alive) = io::pipe()?;
        let (listener, place) = socket.unzip();
        let link = gettid();
        let (recording, names, wake) = (self.recording.clone(), self.names.clone(), self.wake.clone());
        let thread = thread::Builder::new().name("recorder".into()).spawn(move || {
            let keeper = Keeper { recording, names, wake, news, listener, end };
            keeper.run(link);
        })?;
        self.thread = Some((alive, thread, place));
        Ok(())
    }
}

impl Drop for Recorder {
    /// Lets the thread keep the last stop.
    fn drop(&mut self) {
        let Some((alive, thread, _place)) = self.thread.take() else { return };
        drop(alive);
        wait_until(monotonic() + END_LIMIT, || thread.is_finished());
    }
}

/// The recorder's thread.
struct Keeper {
    recording: Recording,
    names: Arc<Mutex<Names>>,
    wake: Arc<EventFd>,
    news: Consumer<News>,
    listener: Option<UnixListener>,
    end: PipeReader,
}

impl Keeper {
    fn run(mut self, link: Pid) {
        let Some(writer) = self.recording.memory.sampler() else { return };
        let mut computer = Computer::new("/".into(), writer);
        computer.watch(Watched::Link, link, self.recording.memory.thread(Watched::Link));
        let mut next = monotonic();
        self.publish();
        loop {
            if monotonic() >= next {
                next = monotonic() + computer.look(self.recording.clock.now(), false);
            }
            while let Ok(news) = self.news.pop() {
                match news {
                    News::Started(thread) => {
                        computer.watch(Watched::Core, thread, self.recording.memory.thread(Watched::Core));
                    }
                    News::Configured(objects) => {
                        locked(&self.names).objects = objects.into_iter().collect();
                        // At once: a stop may be the next news.
                        self.publish();
                    }
                    News::Stopped { at, reason, trouble } => {
                        thread::sleep(SETTLE);
                        // The accounts at the stop tell more than those before it.
                        next = monotonic() + computer.look(self.recording.clock.now(), true);
                        let end = End::Shutdown { reason: reason.to_owned(), trouble };
                        self.recording.keep(&self.recording.trace(end, at));
                    }
                }
            }
            let listener = self.listener.as_ref().map_or(self.end.as_fd(), AsFd::as_fd);
            let mut fds = [
                PollFd::new(self.end.as_fd(), PollFlags::empty()),
                PollFd::new(self.wake.as_fd(), PollFlags::POLLIN),
                PollFd::new(listener, PollFlags::POLLIN),
            ];
            let _ = poll(&mut fds, poll_timeout(next.saturating_sub(monotonic())));
            let [ended, woken, asked] = fds.map(|fd| fd.any().unwrap_or(true));
            if woken {
                let _ = self.wake.read();
                self.publish();
            }
            if ended && self.news.is_empty() {
                return;
            }
            if asked && let Some(Ok((client, _))) = self.listener.as_ref().map(UnixListener::accept) {
                self.give(client);
            }
        }
    }

    /// Puts the names where the guardian finds them, too.
    fn publish(&self) {
        let names = locked(&self.names).clone();
        self.recording.memory.set_names(&names);
    }

    /// Gives a client what is recorded.
    fn give(&self, client: UnixStream) {
        let trace = self.recording.trace(End::Asked, self.recording.clock.now());
        // A client that does not read must not keep the thread.
        let limited = client.set_nonblocking(false).and_then(|()| client.set_write_timeout(Some(CLIENT_LIMIT)));
        let _ = limited.and_then(|()| trace.write(client));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The clock of a computer may stand still, or be set back.
    #[test]
    fn each_stop_keeps_its_file_and_the_last_ten_stay() {
        let folder = tempfile::tempdir().unwrap();
        let link = Path::new("/tmp/klipper_host_test");
        let recording = Recording::new(Monotonic::start(), link, false, vec![folder.path().to_owned()]).unwrap();
        let mut trace = recording.trace(End::Died, Clock::EPOCH);
        trace.head.utc_ms = 1_795_357_574_999;
        let mut written: Vec<PathBuf> = (0..KEPT_MAX + 2).map(|_| recording.write(&trace).unwrap()).collect();
        written.reverse();
        written.truncate(KEPT_MAX);
        assert_eq!(folder::kept(folder.path(), "test"), written);
        trace.head.utc_ms -= 3_600_000;
        let back = recording.write(&trace).unwrap();
        written.truncate(KEPT_MAX - 1);
        written.push(back);
        assert_eq!(folder::kept(folder.path(), "test"), written);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), KEPT_MAX);
    }
}
