// SPDX-License-Identifier: GPL-3.0-or-later
//! The socket of the status: its path, and the thread that serves it.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::fs::{self, OpenOptions};
use std::io::{self, PipeReader, PipeWriter, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt, PermissionsExt, chown};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use log::{info, warn};
use nix::fcntl::OFlag;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{AddressFamily, Backlog, SockFlag, SockType, UnixAddr, bind, listen, socket};

use pinion_linux::clock::{monotonic, poll_timeout};

use pinion_linux::foreign::plain_json;
use pinion_linux::own_folder::{OwnFolder, below};
use pinion_trace::folder::name_of;

use super::SnapshotReader;
use super::document::{Facts, HostStatus, Reporter};

/// Shortest time between two questions to the core, however many clients ask, and how long a client may take to read.
const MANNERS: ClientLimits = ClientLimits { pause: Duration::from_millis(50), limit: Duration::from_secs(5) };
/// Highest number of clients that get one answer. Others wait in the kernel's queue.
const CLIENTS_MAX: usize = 32;
/// Highest number of answers that are being read. Another one drops the oldest, and its clients.
const ANSWERS_MAX: usize = 4;

/// How a socket treats its clients.
#[derive(Clone, Copy)]
pub(crate) struct ClientLimits {
    /// Shortest time between two answers.
    pub(crate) pause: Duration,
    /// How long a client may take to read its answer.
    pub(crate) limit: Duration,
}

/// The status's socket. When this is dropped, the socket is removed and its thread ends.
pub(crate) struct StatusSocket {
    _place: Place,
    _thread: PipeWriter,
}

/// A socket's place in the file system. When this is dropped, the socket is removed.
pub(crate) struct Place {
    path: PathBuf,
    folder: OwnFolder,
    name: OsString,
    /// Device and inode of our own socket.
    id: (u64, u64),
}

impl StatusSocket {
    /// Opens the socket at the first of these paths where that is possible, and serves it.
    pub(crate) fn start(
        paths: &[PathBuf],
        terminal: Option<&Path>,
        facts: Facts,
        host: Arc<HostStatus>,
        snapshot_reader: SnapshotReader,
    ) -> Option<StatusSocket> {
        let (listener, place) = open(paths, terminal, |errors| warn!("pinion status will not be answered: {errors}"))?;
        info!("status on {}", place.path.display());
        let mut reporter = Reporter::new(snapshot_reader, facts, host);
        let served = serve_on(listener, "status", MANNERS, move || match serde_json::to_string(&reporter.status()) {
            Ok(document) => Some(plain_json(&document).into_bytes()),
            Err(error) => {
                warn!("pinion status is not answered: {error}: this is a bug in Pinion, please report it");
                None
            }
        });
        let started = served.inspect_err(|error| {
            warn!("pinion status will not be answered: no thread can be started: {error}: raise TasksMax or ulimit -u")
        });
        Some(StatusSocket { _place: place, _thread: started.ok()? })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let path = self.folder.at(&self.name);
        if fs::symlink_metadata(&path).is_ok_and(|found| (found.dev(), found.ino()) == self.id) {
            let _ = fs::remove_file(path);
        }
    }
}

/// Opens a socket at the first of these paths where that is possible. Users who may open the host's terminal may
/// connect: the socket gets the terminal's group. Without a terminal it keeps our own group. A path where another
/// instance answers is not taken over. If it is possible nowhere, `complain` gets the errors.
pub(crate) fn open(
    paths: &[PathBuf],
    terminal: Option<&Path>,
    complain: impl FnOnce(&str),
) -> Option<(UnixListener, Place)> {
    let mut errors = Vec::new();
    for path in paths {
        match open_at(path, terminal) {
            Ok(opened) => return Some(opened),
            Err(error) => errors.push(format!("{}: {error}", path.display())),
        }
    }
    if !errors.is_empty() {
        complain(&errors.join("; "));
    }
    None
}

/// The possible paths of the socket of the instance with this link, the best first.
///
/// The socket is named after the link: the file's name without `klipper_host_`, and `.sock`. For a link in `/tmp` or
/// `/run/pinion` it stands in `/run/pinion`, the service's folder. If that folder is missing or another user's, it is
/// `pinion-NAME.sock` in `$XDG_RUNTIME_DIR`, or else in `/tmp`. For a link anywhere else it stands beside the link.
pub fn socket_paths(link: &Path) -> Vec<PathBuf> {
    let name = name_of(link);
    let folder = link.parent().unwrap_or(Path::new(""));
    if folder != Path::new("/tmp") && folder != Path::new("/run/pinion") {
        return vec![folder.join(format!("{name}.sock"))];
    }
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|folder| folder.is_absolute());
    let own = own.unwrap_or_else(|| "/tmp".into());
    vec![Path::new("/run/pinion").join(format!("{name}.sock")), own.join(format!("pinion-{name}.sock"))]
}

/// The paths of the socket of `pinion trace --live`, beside those of the status.
pub fn trace_socket_paths(status: &[PathBuf]) -> Vec<PathBuf> {
    status.iter().map(|path| path.with_extension("trace")).collect()
}

/// Opens the socket at a path.
fn open_at(path: &Path, terminal: Option<&Path>) -> io::Result<(UnixListener, Place)> {
    // A client has to connect by this path.
    UnixAddr::new(path)?;
    let name = path.file_name().ok_or(io::ErrorKind::IsADirectory)?.to_owned();
    let folder = OwnFolder::open(path.parent().unwrap_or(Path::new("")))?;
    let placed = folder.at(&name);
    match fs::symlink_metadata(&placed) {
        Ok(found) if !found.file_type().is_socket() => {
            return Err(io::Error::other("there is something else: remove it, or choose another --socket"));
        }
        Ok(_) => match connect(&placed) {
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
            // A socket whose queue is full is alive too.
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
            _ => {
                let live = "another Pinion answers there: choose another -I, or --socket";
                return Err(io::Error::other(live));
            }
        },
        Err(_) => {}
    }
    // A rename puts the socket in place with its permissions, and replaces a stale one, in one step.
    let mut fresh = name.clone();
    fresh.push(format!(".{}", std::process::id()));
    let fresh = folder.at(fresh);
    let _ = fs::remove_file(&fresh);
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    let listener = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
    bind(listener.as_raw_fd(), &UnixAddr::new(&fresh)?)?;
    let put = (|| {
        let flags = (OFlag::O_PATH | OFlag::O_NOFOLLOW).bits();
        let file = OpenOptions::new().read(true).custom_flags(flags).open(&fresh)?;
        let (ours, same) = (file.metadata()?, below(&file));
        if let Some(terminal) = terminal {
            let gid = fs::metadata(terminal)?.gid();
            // Only root and the group's members may do this. Without it only our own user and root may ask.
            let _ = chown(&same, None, Some(gid));
        }
        fs::set_permissions(&same, fs::Permissions::from_mode(0o660))?;
        // Nobody connects before the permissions are set.
        listen(&listener, Backlog::MAXCONN)?;
        fs::rename(&fresh, &placed)?;
        Ok((ours.dev(), ours.ino()))
    })();
    let id = put.inspect_err(|_: &io::Error| drop(fs::remove_file(&fresh)))?;
    Ok((UnixListener::from(listener), Place { path: path.to_owned(), folder, name, id }))
}

/// Connects to the socket of an instance. It does not wait for an instance that hangs.
pub fn connect(path: &Path) -> io::Result<UnixStream> {
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
    nix::sys::socket::connect(socket.as_raw_fd(), &UnixAddr::new(path)?)?;
    Ok(UnixStream::from(socket))
}

/// Starts a thread that gives each client an answer. It ends when the returned value is dropped. `answer` is called for
/// all clients that wait.
pub(crate) fn serve_on(
    listener: UnixListener,
    thread: &str,
    manners: ClientLimits,
    answer: impl FnMut() -> Option<Vec<u8>> + Send + 'static,
) -> io::Result<PipeWriter> {
    let (end, alive) = io::pipe()?;
    thread::Builder::new().name(thread.into()).spawn(move || serve(&listener, &end, manners, answer))?;
    Ok(alive)
}

/// An answer, and the clients that still read it.
struct Answer {
    bytes: Vec<u8>,
    /// Each with the number of bytes that it has.
    clients: Vec<(UnixStream, usize)>,
    until: Duration,
}

impl Answer {
    /// Sends as much as the clients take now. Those that have it all, or have gone, are let go.
    fn send(&mut self) {
        self.clients.retain_mut(|(client, sent)| {
            loop {
                match client.write(&self.bytes[*sent..]) {
                    Ok(written @ 1..) => *sent += written,
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => return true,
                    _ => return false,
                }
            }
        });
    }
}

/// A client that does not read keeps neither this thread nor another client. It gets as much as there is room for.
fn serve(
    listener: &UnixListener,
    end: &PipeReader,
    manners: ClientLimits,
    mut answer: impl FnMut() -> Option<Vec<u8>>,
) {
    // The oldest one is the first.
    let mut answers: VecDeque<Answer> = VecDeque::new();
    let mut next = Duration::ZERO;
    loop {
        let now = monotonic();
        let pause = next.checked_sub(now).filter(|pause| !pause.is_zero());
        let asked = if pause.is_some() { PollFlags::empty() } else { PollFlags::POLLIN };
        let mut fds = vec![PollFd::new(end.as_fd(), PollFlags::empty()), PollFd::new(listener.as_fd(), asked)];
        let reading = answers.iter().flat_map(|answer| &answer.clients);
        fds.extend(reading.map(|(client, _)| PollFd::new(client.as_fd(), PollFlags::POLLOUT)));
        let left = answers.front().map(|oldest| oldest.until.saturating_sub(now));
        let _ = poll(&mut fds, pause.into_iter().chain(left).min().map_or(PollTimeout::NONE, poll_timeout));
        if fds[0].any().unwrap_or(true) {
            return;
        }
        let is_asked = fds[1].any().unwrap_or(false);
        answers.iter_mut().for_each(Answer::send);
        let now = monotonic();
        answers.retain(|answer| !answer.clients.is_empty() && answer.until > now);
        if !is_asked {
            continue;
        }
        let clients = std::iter::from_fn(|| Some(listener.accept().ok()?.0)).take(CLIENTS_MAX);
        let clients = clients.filter(|client| client.set_nonblocking(true).is_ok());
        let clients: Vec<_> = clients.map(|client| (client, 0)).collect();
        if !clients.is_empty()
            && let Some(bytes) = answer()
        {
            let mut given = Answer { bytes, clients, until: monotonic() + manners.limit };
            given.send();
            answers.extend((!given.clients.is_empty()).then_some(given));
        }
        if answers.len() > ANSWERS_MAX {
            answers.pop_front();
        }
        next = monotonic() + manners.pause;
    }
}

#[cfg(test)]
mod tests {
    use super::super::ends;
    use super::*;
    use crate::status::form::{self, State};
    use std::io::Read;

    fn facts() -> Facts {
        Facts {
            link: "/tmp/klipper_host_mcu".into(),
            board: "a board".into(),
            pins: Vec::new(),
            view: None,
            guardian: None,
            requests: 256,
            recorder: form::RecorderStatus { bytes: 0, folder: None },
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
        let (snapshots, snapshot_reader) = ends();
        let socket =
            StatusSocket::start(std::slice::from_ref(&path), None, facts(), Arc::default(), snapshot_reader).unwrap();
        for _ in 0..2 {
            let mut text = String::new();
            UnixStream::connect(&path).unwrap().read_to_string(&mut text).unwrap();
            let (status, _) = form::read(text.as_bytes()).unwrap();
            assert_eq!((status.state, status.board.as_str(), status.mcu), (State::Unknown, "a board", None));
        }
        assert!(snapshots.is_asked());
        drop(socket);
        assert!(!path.exists());
    }

    #[test]
    fn neither_a_live_socket_nor_another_file_is_taken_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mcu.sock");
        let start = || StatusSocket::start(std::slice::from_ref(&path), None, facts(), Arc::default(), ends().1);
        fs::write(&path, "mine").unwrap();
        assert!(start().is_none());
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        fs::remove_file(&path).unwrap();
        // A killed program leaves this.
        drop(UnixListener::bind(&path).unwrap());
        let first = start().unwrap();
        assert!(start().is_none());
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o660);
        // A socket that another program has put there since is not ours to remove.
        fs::remove_file(&path).unwrap();
        let _other = UnixListener::bind(&path).unwrap();
        drop(first);
        assert!(path.exists());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else is left");
    }

    /// A socket whose clients get `bytes`.
    fn served(limit: Duration, bytes: usize) -> (tempfile::TempDir, PipeWriter, impl Fn() -> UnixStream) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s");
        let listener = UnixListener::bind(&path).unwrap();
        listener.set_nonblocking(true).unwrap();
        let manners = ClientLimits { pause: Duration::from_millis(1), limit };
        let thread = serve_on(listener, "test", manners, move || Some(vec![7; bytes])).unwrap();
        // A client that is in the kernel's queue is not being served yet; its first byte shows that it is.
        let client = move || {
            let client = UnixStream::connect(&path).unwrap();
            let mut fds = [PollFd::new(client.as_fd(), PollFlags::POLLIN)];
            poll(&mut fds, PollTimeout::NONE).unwrap();
            client
        };
        (folder, thread, client)
    }

    fn read(mut client: UnixStream) -> usize {
        let mut bytes = Vec::new();
        client.read_to_end(&mut bytes).unwrap();
        bytes.len()
    }

    /// More than the kernel keeps for a client.
    const LARGE: usize = 8 << 20;

    #[test]
    fn clients_that_do_not_read_keep_nobody_and_the_oldest_is_let_go() {
        let (_folder, thread, client) = served(Duration::from_secs(3600), LARGE);
        let clients: Vec<UnixStream> = (0..ANSWERS_MAX + 2).map(|_| client()).collect();
        let got: Vec<bool> = clients.into_iter().map(|client| read(client) == LARGE).collect();
        assert_eq!(got, [false, false, true, true, true, true]);
        drop(thread);
    }

    #[test]
    fn a_slow_client_is_let_go_after_its_time() {
        let (_folder, thread, client) = served(Duration::from_millis(50), LARGE);
        let (mut slow, mut got) = (client(), 0);
        loop {
            match slow.read(&mut [0; 100]).unwrap() {
                0 => break,
                read => got += read,
            }
            thread::sleep(Duration::from_millis(1));
        }
        assert!(got < LARGE, "it got all");
        drop(thread);
    }
}
