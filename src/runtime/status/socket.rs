// SPDX-License-Identifier: GPL-3.0-or-later
//! The socket of the status: its path, and the thread that serves it.

#![forbid(unsafe_code)]

use std::fs;
use std::io::{self, PipeReader, PipeWriter, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt, chown};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use log::{info, warn};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, UnixAddr, socket};

use crate::foreign::plain_json;
use crate::trace::folder::name_of;

use super::Asker;
use super::document::{Facts, HostBoard, Reporter};

/// Shortest time between two questions to the core, however many clients ask.
const PAUSE: Duration = Duration::from_millis(50);
/// Highest number of clients that are answered at once. Others wait in the kernel's queue.
const CLIENTS_MAX: usize = 32;

/// The status's socket. When this is dropped, the socket is removed and its thread ends.
pub(in crate::runtime) struct StatusSocket {
    _place: Place,
    _thread: PipeWriter,
}

/// A socket's place in the file system. When this is dropped, the socket is removed.
pub(in crate::runtime) struct Place {
    path: PathBuf,
    /// Device and inode of our own socket.
    id: (u64, u64),
}

impl StatusSocket {
    /// Opens the socket at the first of these paths where that is possible, and serves it.
    pub(in crate::runtime) fn start(
        paths: &[PathBuf],
        terminal: Option<&Path>,
        facts: Facts,
        host: Arc<HostBoard>,
        asker: Asker,
    ) -> Option<StatusSocket> {
        let (listener, place) = open(paths, terminal, |errors| warn!("pinion status will not be answered: {errors}"))?;
        info!("status on {}", place.path.display());
        let served = serve_on(listener, Reporter::new(asker, facts, host));
        let started = served.inspect_err(|error| {
            warn!("pinion status will not be answered: no thread can be started: {error}: raise TasksMax or ulimit -u")
        });
        Some(StatusSocket { _place: place, _thread: started.ok()? })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if fs::symlink_metadata(&self.path).is_ok_and(|found| (found.dev(), found.ino()) == self.id) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Opens a socket at the first of these paths where that is possible. Users who may open the host's terminal may
/// connect: the socket gets the terminal's group. Without a terminal it keeps our own group. A path where another instance answers is not taken over. If it
/// is possible nowhere, `complain` gets the errors.
pub(in crate::runtime) fn open(
    paths: &[PathBuf],
    terminal: Option<&Path>,
    complain: impl FnOnce(&str),
) -> Option<(UnixListener, Place)> {
    let mut errors = Vec::new();
    for path in paths {
        match open_at(path, terminal) {
            Ok((listener, id)) => return Some((listener, Place { path: path.clone(), id })),
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

/// Opens the socket at a path, and returns it with its device and inode.
fn open_at(path: &Path, terminal: Option<&Path>) -> io::Result<(UnixListener, (u64, u64))> {
    match fs::symlink_metadata(path) {
        Ok(found) if !found.file_type().is_socket() => {
            return Err(io::Error::other("there is something else: remove it, or choose another --socket"));
        }
        Ok(_) => match connect(path) {
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
    let mut fresh = path.as_os_str().to_owned();
    fresh.push(format!(".{}", std::process::id()));
    let fresh = PathBuf::from(fresh);
    let _ = fs::remove_file(&fresh);
    let listener = UnixListener::bind(&fresh)?;
    let placed = (|| {
        listener.set_nonblocking(true)?;
        if let Some(terminal) = terminal {
            let gid = fs::metadata(terminal)?.gid();
            // Only root and the group's members may do this. Without it only our own user and root may ask.
            let _ = chown(&fresh, None, Some(gid));
        }
        fs::set_permissions(&fresh, fs::Permissions::from_mode(0o660))?;
        let ours = fs::symlink_metadata(&fresh)?;
        fs::rename(&fresh, path)?;
        Ok((ours.dev(), ours.ino()))
    })();
    placed.map(|id| (listener, id)).inspect_err(|_: &io::Error| drop(fs::remove_file(&fresh)))
}

/// Connects to the socket of an instance. It does not wait for an instance that hangs.
pub(crate) fn connect(path: &Path) -> io::Result<UnixStream> {
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    let socket = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
    nix::sys::socket::connect(socket.as_raw_fd(), &UnixAddr::new(path)?)?;
    Ok(UnixStream::from(socket))
}

/// Starts the thread. It ends when the returned value is dropped.
fn serve_on(listener: UnixListener, mut reporter: Reporter) -> io::Result<PipeWriter> {
    let (end, alive) = io::pipe()?;
    thread::Builder::new().name("status".into()).spawn(move || serve(&listener, &end, &mut reporter))?;
    Ok(alive)
}

fn serve(listener: &UnixListener, end: &PipeReader, reporter: &mut Reporter) {
    loop {
        let mut fds = [PollFd::new(listener.as_fd(), PollFlags::POLLIN), PollFd::new(end.as_fd(), PollFlags::empty())];
        let _ = poll(&mut fds, PollTimeout::NONE);
        if fds[1].any().unwrap_or(true) {
            return;
        }
        let clients: Vec<UnixStream> =
            std::iter::from_fn(|| Some(listener.accept().ok()?.0)).take(CLIENTS_MAX).collect();
        if !clients.is_empty() {
            match serde_json::to_string(&reporter.status()) {
                Ok(document) => {
                    let document = plain_json(&document);
                    clients.into_iter().for_each(|client| give(client, document.as_bytes()));
                }
                Err(error) => {
                    warn!("pinion status is not answered: {error}: this is a bug in Pinion, please report it")
                }
            }
        }
        thread::sleep(PAUSE);
    }
}

/// Sends the document. A client that does not read gets as much of it as there is room for.
fn give(mut client: UnixStream, mut document: &[u8]) {
    if client.set_nonblocking(true).is_err() {
        return;
    }
    while let Ok(written @ 1..) = client.write(document) {
        document = &document[written..];
    }
}

#[cfg(test)]
mod tests {
    use super::super::ends;
    use super::*;
    use crate::status::{self, State};
    use std::io::Read;

    fn facts() -> Facts {
        Facts {
            link: "/tmp/klipper_host_mcu".into(),
            terminal: "/dev/pts/3".into(),
            board: "a board".into(),
            pins: Vec::new(),
            view: None,
            guardian: None,
            requests: 256,
            recorder: status::Recorder { bytes: 0, folder: None },
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
        let socket = StatusSocket::start(std::slice::from_ref(&path), None, facts(), Arc::default(), asker).unwrap();
        for _ in 0..2 {
            let mut text = String::new();
            UnixStream::connect(&path).unwrap().read_to_string(&mut text).unwrap();
            let (status, _) = status::read(text.as_bytes()).unwrap();
            assert_eq!((status.state, status.board.as_str(), status.mcu), (State::Unknown, "a board", None));
        }
        assert!(teller.is_asked());
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
}
