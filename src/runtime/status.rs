// SPDX-License-Identifier: GPL-3.0-or-later
//! Tells whoever asks how the machine is (`pinion status`), on a socket in the file system.
//!
//! A thread of its own serves the socket: who connects is sent one JSON document, and nothing is read, so
//! that there is nothing to get wrong. For the machine's part the thread sends the core an empty
//! [`Snapshot`] through a ring, and looks for its return every few milliseconds. The core is not woken
//! for it: it fills the snapshot in when it next passes by with no timer near. So an answer may take as long as
//! the core's nap, and costs the core a look at the ring each time that it is idle anyway.

#![forbid(unsafe_code)]

use std::fs;
use std::io::{self, PipeReader, PipeWriter, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt, chown};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use log::{info, warn};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, UnixAddr, socket};
use rtrb::{Consumer, Producer, RingBuffer};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::board::{ADC_MAX, Board, PWM_MAX, Pin, Range};
use crate::foreign::plain_json;
use crate::lateness::{Lateness, us};
use crate::mcu::{BusCounts, LineUse, Mcu, Present, Snapshot};
use crate::time::{NS_PER_TICK, Ticks};

/// How long the core has for an answer: more than its longest nap.
const PATIENCE: Duration = Duration::from_millis(1000);
/// How often to look for it.
const LOOK: Duration = Duration::from_millis(2);
/// At least so much time is between two questions to the core, however many ask.
const PAUSE: Duration = Duration::from_millis(50);
/// So many clients are answered at once. Others wait in the kernel's queue.
const CLIENTS_MAX: usize = 32;
/// The version of the document's form.
const FORM: u32 = 1;

/// What the core sends with the machine's snapshot.
#[derive(Default)]
struct Answer {
    machine: Snapshot,
    /// Requests that wait for the core.
    waiting: usize,
    /// How early it wakes for a timer.
    margin: Ticks,
}

/// The core's end.
pub(super) struct Teller {
    asked: Consumer<Box<Answer>>,
    told: Producer<Box<Answer>>,
    /// The one that is being filled in.
    at_work: Option<Box<Answer>>,
}

/// The other end.
pub(super) struct Asker {
    ask: Producer<Box<Answer>>,
    answers: Consumer<Box<Answer>>,
    /// The answer while the core does not have it.
    spare: Option<Box<Answer>>,
}

/// Makes both ends.
pub(super) fn ends() -> (Teller, Asker) {
    let (ask, asked) = RingBuffer::new(1);
    let (told, answers) = RingBuffer::new(1);
    (Teller { asked, told, at_work: None }, Asker { ask, answers, spare: Some(Box::default()) })
}

impl Teller {
    /// Whether somebody waits for an answer.
    #[inline]
    pub(super) fn is_asked(&self) -> bool {
        self.at_work.is_some() || !self.asked.is_empty()
    }

    /// Tells the next part of the answer: to be called while no timer is near. `waiting` requests wait for the
    /// core, which wakes `margin` before a timer.
    #[cold]
    pub(super) fn tell(&mut self, mcu: &Mcu, waiting: usize, margin: Ticks) {
        let Some(mut answer) = self.at_work.take().or_else(|| self.asked.pop().ok()) else { return };
        if mcu.tell(&mut answer.machine) {
            (answer.waiting, answer.margin) = (waiting, margin);
            // There is room: no more than this one is ever under way.
            let _ = self.told.push(answer);
        } else {
            self.at_work = Some(answer);
        }
    }
}

impl Asker {
    /// Asks the core, and waits for the answer; none if it does not come in time.
    fn ask(&mut self) -> Option<&Answer> {
        let until = Instant::now() + PATIENCE;
        // One that came too late for the last question.
        if let Ok(late) = self.answers.pop() {
            self.spare = Some(late);
        }
        if let Some(mut answer) = self.spare.take() {
            answer.machine.clear();
            if let Err(rtrb::PushError::Full(answer)) = self.ask.push(answer) {
                self.spare = Some(answer);
            }
        }
        while Instant::now() < until {
            if let Ok(answer) = self.answers.pop() {
                return Some(self.spare.insert(answer));
            }
            thread::sleep(LOOK);
        }
        None
    }
}

/// What is known of the host, as the threads that find it out leave it.
#[derive(Default)]
pub(super) struct HostBoard {
    /// Whether a host has the terminal open. The link says so.
    attached: AtomicBool,
    found: Mutex<Option<FoundHost>>,
}

/// The host that was found.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct FoundHost {
    pub(super) pid: u32,
    /// Whether it is sure that this process is the host.
    pub(super) is_sure: bool,
    /// The checkout that it runs from, if it is a klippy whose sources can be read.
    pub(super) checkout: Option<String>,
    pub(super) commit: Option<String>,
}

impl HostBoard {
    pub(super) fn attach(&self, attached: bool) {
        self.attached.store(attached, Ordering::Relaxed);
    }

    pub(super) fn found(&self, host: Option<FoundHost>) {
        *self.found.lock().unwrap_or_else(PoisonError::into_inner) = host;
    }

    fn json(&self) -> Value {
        let attached = self.attached.load(Ordering::Relaxed);
        let found = self.found.lock().unwrap_or_else(PoisonError::into_inner).clone().filter(|_| attached);
        json!({
            "attached": attached,
            "pid": found.as_ref().map(|host| host.pid),
            "sure": found.as_ref().map(|host| host.is_sure),
            "checkout": found.as_ref().and_then(|host| host.checkout.as_ref()),
            "commit": found.as_ref().and_then(|host| host.commit.as_ref()),
        })
    }
}

/// What is told besides what the core and the host say.
pub(super) struct Facts {
    pub(super) link: PathBuf,
    pub(super) device: PathBuf,
    /// What the board is.
    pub(super) board: String,
    /// What its pins are called.
    pub(super) pins: Vec<Range>,
    /// Where both are to be asked for anew, as chips come and go; none if nothing does.
    pub(super) view: Option<Box<dyn Board>>,
    /// The guardian's process.
    pub(super) guardian: Option<u32>,
    /// How many requests to the core there is room for.
    pub(super) requests: usize,
}

/// The socket in the file system. Dropped, it is removed and its thread ends.
pub(super) struct StatusSocket {
    path: PathBuf,
    /// Device and inode by which ours is known.
    id: (u64, u64),
    _thread: PipeWriter,
}

impl StatusSocket {
    /// Opens the socket of the first of these paths where that can be done, and serves it. Who may open the
    /// terminal may ask: the socket gets its group. A path where another instance answers is not taken over.
    pub(super) fn start(paths: &[PathBuf], facts: Facts, host: Arc<HostBoard>, asker: Asker) -> Option<StatusSocket> {
        let mut errors = Vec::new();
        for path in paths {
            match open(path, &facts.device) {
                Ok((listener, id)) => {
                    info!("status on {}", path.display());
                    let served = serve_on(listener, Server { asker, facts, host, begun: Instant::now() });
                    let started =
                        served.inspect_err(|error| warn!("pinion status will not be answered: no thread can be started: {error}: raise TasksMax or ulimit -u"));
                    return Some(StatusSocket { path: path.clone(), id, _thread: started.ok()? });
                }
                Err(error) => errors.push(format!("{}: {error}", path.display())),
            }
        }
        if !paths.is_empty() {
            warn!("pinion status will not be answered: {}", errors.join("; "));
        }
        None
    }
}

impl Drop for StatusSocket {
    fn drop(&mut self) {
        if fs::symlink_metadata(&self.path).is_ok_and(|found| (found.dev(), found.ino()) == self.id) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// The paths where the socket of the instance with this link is looked for, the best first.
///
/// It is named for the link: the file's name without `klipper_host_`, and `.sock`. For a link in `/tmp` or
/// `/run/pinion` it stands in `/run/pinion`, which is the service's, or, where that is not there or another
/// user's, as `pinion-NAME.sock` in `$XDG_RUNTIME_DIR` or else `/tmp`. For a link anywhere else it stands beside
/// the link.
pub fn socket_paths(link: &Path) -> Vec<PathBuf> {
    let file = link.file_name().unwrap_or_default().to_string_lossy();
    let name = file.strip_prefix("klipper_host_").unwrap_or(&file);
    let folder = link.parent().unwrap_or(Path::new(""));
    if folder != Path::new("/tmp") && folder != Path::new("/run/pinion") {
        return vec![folder.join(format!("{name}.sock"))];
    }
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|folder| folder.is_absolute());
    let own = own.unwrap_or_else(|| "/tmp".into());
    vec![Path::new("/run/pinion").join(format!("{name}.sock")), own.join(format!("pinion-{name}.sock"))]
}

/// Opens the socket at a path, and returns by which device and inode it is known.
fn open(path: &Path, device: &Path) -> io::Result<(UnixListener, (u64, u64))> {
    match fs::symlink_metadata(path) {
        Ok(found) if !found.file_type().is_socket() => {
            return Err(io::Error::other("there is something else: remove it, or choose another --socket"));
        }
        Ok(_) => match connect(path) {
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
            // One whose queue is full is alive, too.
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
            _ => {
                let live = "another Pinion answers there: choose another -I, or --socket";
                return Err(io::Error::other(live));
            }
        },
        Err(_) => {}
    }
    // A rename puts it in place with its permissions, and replaces a stale one, in one step.
    let mut fresh = path.as_os_str().to_owned();
    fresh.push(format!(".{}", std::process::id()));
    let fresh = PathBuf::from(fresh);
    let _ = fs::remove_file(&fresh);
    let listener = UnixListener::bind(&fresh)?;
    let placed = (|| {
        listener.set_nonblocking(true)?;
        let gid = fs::metadata(device)?.gid();
        // Only root and the group's members may. Without it only our own user asks, and root.
        let _ = chown(&fresh, None, Some(gid));
        fs::set_permissions(&fresh, fs::Permissions::from_mode(0o660))?;
        let ours = fs::symlink_metadata(&fresh)?;
        fs::rename(&fresh, path)?;
        Ok((ours.dev(), ours.ino()))
    })();
    placed.map(|id| (listener, id)).inspect_err(|_: &io::Error| drop(fs::remove_file(&fresh)))
}

/// Connects to the socket of an instance, without waiting for one that hangs.
pub(crate) fn connect(path: &Path) -> io::Result<UnixStream> {
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
    nix::sys::socket::connect(socket.as_raw_fd(), &UnixAddr::new(path)?)?;
    Ok(UnixStream::from(socket))
}

/// Starts the thread. It ends once what this returns is dropped.
fn serve_on(listener: UnixListener, mut server: Server) -> io::Result<PipeWriter> {
    let (end, alive) = io::pipe()?;
    thread::Builder::new().name("status".into()).spawn(move || server.serve(&listener, &end))?;
    Ok(alive)
}

struct Server {
    asker: Asker,
    facts: Facts,
    host: Arc<HostBoard>,
    begun: Instant,
}

impl Server {
    fn serve(&mut self, listener: &UnixListener, end: &PipeReader) {
        loop {
            let mut fds =
                [PollFd::new(listener.as_fd(), PollFlags::POLLIN), PollFd::new(end.as_fd(), PollFlags::empty())];
            let _ = poll(&mut fds, PollTimeout::NONE);
            if fds[1].any().unwrap_or(true) {
                return;
            }
            let clients: Vec<UnixStream> =
                std::iter::from_fn(|| Some(listener.accept().ok()?.0)).take(CLIENTS_MAX).collect();
            if !clients.is_empty() {
                let document = plain_json(&self.document().to_string());
                for client in clients {
                    give(client, document.as_bytes());
                }
            }
            thread::sleep(PAUSE);
        }
    }

    /// All that there is to tell.
    fn document(&mut self) -> Value {
        let answer = self.asker.ask();
        let facts = &mut self.facts;
        if let Some(view) = &facts.view {
            (facts.board, facts.pins) = (view.describe(), view.pins());
        }
        let mut document = json!({
            "form": FORM,
            "version": env!("CARGO_PKG_VERSION"),
            "pid": std::process::id(),
            "uptime_s": rounded(self.begun.elapsed().as_secs_f64()),
            "link": facts.link.to_string_lossy(),
            "terminal": facts.device.to_string_lossy(),
            "board": facts.board,
            "state": "unknown",
            "host": self.host.json(),
            // Where it is lost the program ends.
            "guardian": { "present": facts.guardian.is_some(), "pid": facts.guardian },
        });
        if let (Some(document), Some(answer)) = (document.as_object_mut(), answer) {
            machine(answer, facts, document);
        }
        document
    }
}

/// Sends the document, or as much of it as a client that does not read has room for.
fn give(mut client: UnixStream, mut document: &[u8]) {
    if client.set_nonblocking(true).is_err() {
        return;
    }
    while let Ok(written @ 1..) = client.write(document) {
        document = &document[written..];
    }
}

fn rounded(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// What a pin is called.
fn pin_name(pins: &[Range], pin: Pin) -> String {
    pins.iter().find_map(|range| range.name_of(pin.0)).unwrap_or_else(|| format!("pin number {}", pin.0))
}

/// Adds what the core said.
fn machine(answer: &Answer, facts: &Facts, document: &mut serde_json::Map<String, Value>) {
    let machine = &answer.machine;
    let seconds = |ticks: i64| rounded(ticks as f64 * NS_PER_TICK as f64 / 1e9);
    let state = match (machine.stopped, machine.is_configured, machine.oids_allocated) {
        (Some(_), _, _) => "shutdown",
        (None, true, _) => "configured",
        (None, false, true) => "configuring",
        (None, false, false) => "waiting",
    };
    document["state"] = json!(state);
    let mut add = |key: &str, value: Value| document.insert(key.to_owned(), value);
    add(
        "shutdown",
        machine.stopped.map_or(Value::Null, |(reason, at)| {
            json!({
                "reason": reason.text(),
                "detail": machine.detail,
                "ago_s": seconds(machine.at.since(at)),
            })
        }),
    );
    add("owes", if machine.debtor.is_empty() { Value::Null } else { json!(machine.debtor) });
    add("dialect", json!(machine.dialect.map(|dialect| dialect.to_string())));
    let lines = machine.lines.iter().map(|line| {
        let use_ = match line.use_ {
            LineUse::Output => "output",
            LineUse::Input => "input",
            LineUse::OpenDrain => "open drain",
        };
        json!({
            "pin": pin_name(&facts.pins, line.pin),
            "use": use_,
            "level": line.level.map(u8::from),
            "bus": line.bus.map(bus),
        })
    });
    add("lines", lines.collect());
    let objects = machine.objects.iter().map(|object| {
        json!({
            "oid": object.oid,
            "kind": object.kind,
            "pin": object.pin.map(|pin| pin_name(&facts.pins, pin)),
            "queued": object.report.queued,
            "value": object.report.value.map(present),
            "bus": object.bus.map(bus),
        })
    });
    add("objects", objects.collect());
    add("lateness", lateness(&machine.lateness, answer.margin));
    let workers = machine.queues.iter().map(|queue| json!({ "name": queue.name(), "waiting": queue.waiting }));
    let (queued, room) = machine.moves;
    add(
        "queues",
        json!({
            "moves": { "waiting": queued, "size": room },
            "commands": { "waiting": answer.waiting, "size": facts.requests, "held": machine.is_held },
            "workers": workers.collect::<Vec<_>>(),
        }),
    );
}

fn present(value: Present) -> Value {
    match value {
        Present::Adc(counts) => json!({ "adc": rounded(f64::from(counts) / f64::from(ADC_MAX)) }),
        Present::Pwm(value) => json!({ "duty": rounded(f64::from(value) / f64::from(PWM_MAX)) }),
        Present::Steps(steps) => json!({ "steps": steps }),
    }
}

fn bus(counts: BusCounts) -> Value {
    json!({ "transfers": counts.transfers, "errors": counts.errors, "retries": counts.retries })
}

fn lateness(lateness: &Lateness, margin: Ticks) -> Value {
    let us = |ticks| rounded(us(ticks));
    let buckets = lateness.buckets().map(|(upper, count)| json!([us(upper), count]));
    json!({
        "timers": lateness.samples(),
        "p50_us": us(lateness.quantile(0.5)),
        "p99_us": us(lateness.quantile(0.99)),
        "p999_us": us(lateness.quantile(0.999)),
        "max_us": us(lateness.max()),
        "margin_us": us(margin),
        "buckets_us": buckets.collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;

    fn facts(device: &Path) -> Facts {
        Facts {
            link: "/tmp/klipper_host_mcu".into(),
            device: device.to_owned(),
            board: "a board".into(),
            pins: Vec::new(),
            view: None,
            guardian: None,
            requests: 256,
        }
    }

    #[test]
    fn a_socket_is_named_for_its_link() {
        let first = |link: &str| socket_paths(Path::new(link))[0].clone();
        for link in ["/tmp/klipper_host_mcu", "/run/pinion/klipper_host_mcu", "/run/pinion/mcu"] {
            assert_eq!(first(link), Path::new("/run/pinion/mcu.sock"), "{link}");
        }
        assert_eq!(socket_paths(Path::new("/home/pi/x/klipper_host_b")), [Path::new("/home/pi/x/b.sock")]);
        let [_, own] = &socket_paths(Path::new("/tmp/klipper_host_b"))[..] else { panic!() };
        assert_eq!(own.file_name().unwrap(), "pinion-b.sock");
    }

    #[test]
    fn a_core_that_does_not_answer_keeps_nobody() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mcu.sock");
        let (teller, asker) = ends();
        let socket =
            StatusSocket::start(std::slice::from_ref(&path), facts(folder.path()), Arc::default(), asker).unwrap();
        for _ in 0..2 {
            let mut text = String::new();
            UnixStream::connect(&path).unwrap().read_to_string(&mut text).unwrap();
            let document: Value = serde_json::from_str(&text).unwrap();
            assert_eq!((&document["state"], &document["board"]), (&json!("unknown"), &json!("a board")));
        }
        assert!(teller.is_asked());
        drop(socket);
        assert!(!path.exists());
    }

    #[test]
    fn neither_a_live_socket_nor_another_file_is_taken_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mcu.sock");
        let start = || StatusSocket::start(std::slice::from_ref(&path), facts(folder.path()), Arc::default(), ends().1);
        fs::write(&path, "mine").unwrap();
        assert!(start().is_none());
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        fs::remove_file(&path).unwrap();
        // What a program leaves that was killed.
        drop(UnixListener::bind(&path).unwrap());
        let first = start().unwrap();
        assert!(start().is_none());
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o660);
        // One that another program has put there since is not ours to remove.
        fs::remove_file(&path).unwrap();
        let _other = UnixListener::bind(&path).unwrap();
        drop(first);
        assert!(path.exists());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else is left");
    }
}
