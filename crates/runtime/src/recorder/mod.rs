// SPDX-License-Identifier: GPL-3.0-or-later
//! The flight recorder. Each thread writes 16-byte events into a ring of its own (`memory.rs`, `trace_writer.rs`). A
//! thread of low priority reads the kernel's accounts some times a second (`computer.rs`). At each stop of the MCU it
//! keeps the rings in a file, and logs who was late. If the program dies or hangs, the guardian does that.

mod computer;
mod edges;
mod memory;
mod pace;
mod trace_writer;

use std::collections::BTreeMap;
use std::fs::{self, Permissions};
use std::io::{self, PipeReader, PipeWriter};
use std::os::fd::AsFd;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
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

use pinion_firmware::mcu::{Dialect, EdgeRecorder};
use pinion_firmware::shutdown::reason;
use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks, TimeSource};
use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::{Monotonic, monotonic, poll_timeout, wait_until};
use pinion_protocol::format;
use pinion_shm::ring::Ring;

use crate::FIRMWARE;
use crate::status::form;
use pinion_trace::event::{Event, Watched};
use pinion_trace::file::{End, Head, Names, SSH, Thread, Trace};
use pinion_trace::folder;
use pinion_trace::ring::Writer;
use pinion_trace::verdict::{Culprit, Verdict, verdict};

use crate::status::{ClientLimits, Place, serve_on};
use crate::transport::LinkName;

use computer::Computer;
use edges::EdgeWriter;
use memory::Memory;
use pace::Pace;
use trace_writer::News;
pub use trace_writer::Sleep;
pub(super) use trace_writer::TraceWriter;

/// How long the recorder waits after a stop, so that the events of all threads are there.
const SETTLE: Duration = Duration::from_millis(20);
/// Each answer to clients copies all rings, so there are few.
const CLIENTS: ClientLimits = ClientLimits { pause: Duration::from_millis(500), limit: Duration::from_secs(30) };
/// A host that stops the MCU again and again must not keep the disk busy.
const RECORDINGS: Pace = Pace::new(5, Duration::from_secs(60));
/// The same for stops that the host asked for. Only the last of them stays.
const ASKED_RECORDINGS: Pace = Pace::new(1, Duration::from_secs(60));
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
        let memory = Memory::new().map_err(crate::trouble::no_room)?;
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
    pub(super) fn status(&self) -> form::RecorderStatus {
        form::RecorderStatus {
            bytes: self.memory.bytes(),
            folder: self.folder().map(|folder| folder.display().to_string()),
        }
    }

    /// The folder of the next file, as far as that is known before.
    fn folder(&self) -> Option<&PathBuf> {
        self.folders.iter().find(|path| folder::is_ours(path))
    }

    /// The writer of a worker.
    pub(super) fn worker(&self, bus: &str) -> Option<Writer> {
        self.memory.worker(bus)
    }

    /// The guardian's writer.
    pub(super) fn guardian(&self) -> Option<Writer> {
        self.memory.guardian()
    }

    /// The present text of the recording.
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

    /// Keeps the trace of a stop in a file, and logs who was late. `paces` bound how often.
    fn keep_stop(&self, trace: &Trace, paces: &mut Paces) {
        if self.folders.is_empty() {
            return;
        }
        let found = verdict(trace);
        let is_asked = is_asked(trace, &found);
        let (pace, kind) = match is_asked {
            true => (&mut paces.asked, "such a stop"),
            false => (&mut paces.others, "a stop"),
        };
        if pace.admits(monotonic()) {
            self.keep(trace, &found, is_asked);
        } else {
            info!("{} (no trace: {kind} was recorded less than a minute before)", found.text);
        }
    }

    fn keep(&self, trace: &Trace, found: &Verdict, is_asked: bool) {
        match self.write(trace, is_asked) {
            Ok(path) => info!("{} (pinion trace {})", found.text, path.display()),
            Err(error) => {
                info!("{}", found.text);
                warn!(
                    "the trace of this stop is not kept: {error}: make room on the disk, or a folder of this user (XDG_STATE_HOME)"
                );
            }
        }
    }

    /// Keeps the recording of a program that died or hung. It leaves out a program that no host had configured.
    pub(super) fn keep_of_the_dead(&self, end: End) {
        let trace = self.trace(end, self.clock.now());
        let mut events = trace.threads.iter().flat_map(|thread| &thread.events);
        let is_used = events.any(|(_, event)| matches!(event, Event::Configured | Event::BlockIn(_)));
        if is_used && !self.folders.is_empty() {
            self.keep(&trace, &verdict(&trace), false);
        }
    }

    fn write(&self, trace: &Trace, is_asked: bool) -> io::Result<PathBuf> {
        let mut errors = Vec::new();
        for folder in &self.folders {
            match self.write_into(folder, trace, is_asked) {
                Ok(path) => return Ok(path),
                Err(error) => errors.push(format!("{}: {error}", folder.display())),
            }
        }
        Err(io::Error::other(errors.join("; ")))
    }

    fn write_into(&self, path: &Path, trace: &Trace, is_asked: bool) -> io::Result<PathBuf> {
        let folder = folder::open(path)?;
        let (here, instance) = (folder.at(""), folder::name_of(&self.link));
        let name = folder::new_name(&here, &instance, trace.head.utc_ms, is_asked);
        // A rename puts only a whole file in place. A full disk or a power cut leaves none.
        let fresh = format!(".{instance}.{}", std::process::id());
        let written = folder.create(&fresh).and_then(|file| {
            // Everybody may read when the MCU moved which line.
            file.set_permissions(Permissions::from_mode(0o644))?;
            trace.write(file)
        });
        let (fresh, placed) = (folder.at(&fresh), folder.at(&name));
        written.and_then(|()| fs::rename(&fresh, placed)).inspect_err(|_| drop(fs::remove_file(&fresh)))?;
        for old in folder::surplus(&here, &instance) {
            let _ = fs::remove_file(old);
        }
        Ok(path.join(name))
    }
}

/// Whether the host or a signal had asked for the stop, and nobody was late.
fn is_asked(trace: &Trace, found: &Verdict) -> bool {
    let asked = [reason::COMMAND_REQUEST.text(), reason::FORCE_SHUTDOWN.text()];
    found.culprit == Culprit::Nobody
        && matches!(&trace.head.end, End::Shutdown { reason, .. } if asked.contains(&reason.as_str()))
}

/// How often files are made.
struct Paces {
    asked: Pace,
    others: Pace,
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
fn commands(dialect: &Dialect) -> BTreeMap<i16, String> {
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
    thread: Option<(PipeWriter, JoinHandle<()>)>,
    clients: Option<(PipeWriter, Place)>,
}

impl Recorder {
    /// A recorder whose thread has not started, and the core's trace writer.
    pub(super) fn new(recording: Recording) -> io::Result<(Recorder, TraceWriter)> {
        let wake = Arc::new(EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?);
        let (producer, news) = RingBuffer::new(NEWS);
        let writers = recording.memory.core().ok_or_else(|| io::Error::other("the recording has another core"))?;
        recording.memory.touch();
        let trace_writer = TraceWriter::new(writers, producer, wake.clone());
        Ok((
            Recorder { recording, names: Arc::default(), wake, news: Some(news), thread: None, clients: None },
            trace_writer,
        ))
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

    /// Records the edges of outputs.
    pub(super) fn edges(&self) -> Option<Arc<dyn EdgeRecorder>> {
        let writer = Mutex::new(self.recording.memory.edges()?);
        Some(Arc::new(EdgeWriter { writer, clock: self.recording.clock, names: self.names.clone() }))
    }

    /// The link's writer.
    pub(super) fn link(&self) -> Option<Writer> {
        self.recording.memory.link()
    }

    /// Starts the thread. The calling thread is the link. `socket` is where `pinion trace --live` asks. Its clients have a
    /// thread of their own: they must not keep the recorder from its samples, nor from a stop.
    pub(super) fn start(&mut self, socket: Option<(UnixListener, Place)>) -> io::Result<()> {
        let Some(news) = self.news.take() else { return Ok(()) };
        if let Some(folder) = self.recording.folder() {
            info!("traces in {}", folder.display());
        }
        let (end, alive) = io::pipe()?;
        let link = gettid();
        let (recording, names, wake) = (self.recording.clone(), self.names.clone(), self.wake.clone());
        let thread = thread::Builder::new().name("recorder".into()).spawn(move || {
            let paces = Paces { asked: ASKED_RECORDINGS, others: RECORDINGS };
            Keeper { recording, names, wake, news, paces, end }.run(link);
        })?;
        self.thread = Some((alive, thread));
        if let Some((listener, place)) = socket {
            let recording = self.recording.clone();
            let answer = move || {
                let mut bytes = Vec::new();
                recording.trace(End::Asked, recording.clock.now()).write(&mut bytes).ok().map(|()| bytes)
            };
            self.clients = Some((serve_on(listener, "trace", CLIENTS, answer)?, place));
        }
        Ok(())
    }
}

impl Drop for Recorder {
    /// Lets the thread keep the last stop.
    fn drop(&mut self) {
        drop(self.clients.take());
        let Some((alive, thread)) = self.thread.take() else { return };
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
    paces: Paces,
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
                next = monotonic() + computer.sample(self.recording.clock.now(), false);
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
                        // The accounts at the stop show more than those before it.
                        next = monotonic() + computer.sample(self.recording.clock.now(), true);
                        let end = End::Shutdown { reason: reason.to_owned(), trouble };
                        self.recording.keep_stop(&self.recording.trace(end, at), &mut self.paces);
                    }
                }
            }
            let mut fds =
                [PollFd::new(self.end.as_fd(), PollFlags::empty()), PollFd::new(self.wake.as_fd(), PollFlags::POLLIN)];
            let _ = poll(&mut fds, poll_timeout(next.saturating_sub(monotonic())));
            let [ended, woken] = fds.map(|fd| fd.any().unwrap_or(true));
            if woken {
                let _ = self.wake.read();
                self.publish();
            }
            if ended && self.news.is_empty() {
                return;
            }
        }
    }

    /// Puts the names where the guardian finds them, too.
    fn publish(&self) {
        let names = locked(&self.names).clone();
        self.recording.memory.set_names(&names);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(folders: Vec<PathBuf>) -> Recording {
        Recording::new(Monotonic::start(), Path::new("/tmp/klipper_host_test"), false, folders).unwrap()
    }

    fn names(folder: &Path) -> Vec<PathBuf> {
        folder::kept(&[folder.to_owned()], "test")
    }

    /// The clock of a computer may stand still, be set back, or be wrong at first.
    #[test]
    fn each_stop_keeps_its_file_and_the_last_ten_stay() {
        let folder = tempfile::tempdir().unwrap();
        let recording = recording(vec![folder.path().to_owned()]);
        let mut trace = recording.trace(End::Died, Clock::EPOCH);
        let mut write = |utc_ms| {
            trace.head.utc_ms = utc_ms;
            recording.write(&trace, false).unwrap()
        };
        let mut written = vec![write(4_102_444_800_000)];
        written.extend((0..11).map(|_| write(1_795_357_574_999)));
        written.push(write(1_795_353_974_999));
        written.reverse();
        written.truncate(10);
        assert_eq!(names(folder.path()), written);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 10);
        let mode = fs::metadata(&written[0]).unwrap().permissions().mode();
        assert_eq!(mode & 0o7777, 0o644);
    }

    fn stop(recording: &Recording, reason: &str) -> Trace {
        recording.trace(End::Shutdown { reason: reason.into(), trouble: "".into() }, Clock::EPOCH)
    }

    #[test]
    fn a_host_that_stops_again_and_again_makes_few_files_and_removes_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let recording = recording(vec![folder.path().to_owned()]);
        let mut paces = Paces { asked: ASKED_RECORDINGS, others: RECORDINGS };
        recording.keep_stop(&stop(&recording, "ADC out of range"), &mut paces);
        let first = names(folder.path());
        for asked in [reason::COMMAND_REQUEST, reason::FORCE_SHUTDOWN].iter().cycle().take(20) {
            recording.keep_stop(&stop(&recording, asked.text()), &mut paces);
        }
        let both = names(folder.path());
        assert_eq!(both.len(), 2, "{both:?}");
        assert_eq!(both[1..], first);
        (0..20).for_each(|_| recording.keep_stop(&stop(&recording, "ADC out of range"), &mut paces));
        assert_eq!(names(folder.path()).len(), 1 + 5);
    }

    /// The second folder is the user's own.
    #[test]
    fn a_folder_of_another_user_gets_no_file() {
        if !pinion_testkit::here::is_root() {
            return;
        }
        let root = tempfile::tempdir().unwrap();
        let (service, own) = (root.path().join("service"), root.path().join("own"));
        fs::create_dir(&service).unwrap();
        std::os::unix::fs::chown(&service, Some(65534), None).unwrap();
        let recording = recording(vec![service.clone(), own.clone()]);
        assert_eq!(recording.status().folder, Some(own.display().to_string()));
        let path = recording.write(&recording.trace(End::Died, Clock::EPOCH), false).unwrap();
        assert_eq!(names(&own), [path]);
        assert_eq!(fs::read_dir(service).unwrap().count(), 0);
    }
}
