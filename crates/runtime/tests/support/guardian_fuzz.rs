// SPDX-License-Identifier: GPL-3.0-or-later
//! A guardian under any messages, for `fuzz/`.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::IoSlice;
use std::sync::LazyLock;

use nix::sys::socket::{AddressFamily, ControlMessage, SockFlag, SockType, recv, sendmsg, socketpair};
use pinion_linux::clock::Monotonic;

use nix::unistd::getppid;

use super::*;

/// A page that is shared with the guardian is never freed, so there is only one.
static HEARTBEAT: LazyLock<Heartbeat> = LazyLock::new(|| Heartbeat::new(Monotonic::start()).expect("a page"));
/// The same for the memory of a recording.
static RECORDING: LazyLock<Recording> = LazyLock::new(Recording::of_a_test);

/// Gives a guardian messages. Each has two bytes before it: whether a descriptor comes with it, and its length. The
/// guardian answers each as the messages' description says, and holds the outputs with these names.
pub fn guardian(mut bytes: &[u8]) {
    let kind = SockType::SeqPacket;
    let (ours, theirs) = socketpair(AddressFamily::Unix, kind, None, SockFlag::SOCK_CLOEXEC).expect("sockets");
    let file = File::open("/dev/null").expect("a file");
    let mut watcher = Watcher::new(theirs, Program { pid: getppid(), pidfd: None }, *HEARTBEAT, RECORDING.clone());
    let (mut names, mut files) = (BTreeSet::new(), 0);
    while let Some((&[head, len], rest)) = bytes.split_first_chunk() {
        let (message, rest) = rest.split_at(usize::from(len).min(rest.len()));
        bytes = rest;
        // An empty message is the end of the socket.
        if message.is_empty() {
            continue;
        }
        let has_file = head % 4 != 0;
        let descriptors = [file.as_raw_fd()];
        let rights = [ControlMessage::ScmRights(&descriptors)];
        let control = if has_file { &rights[..] } else { &[] };
        let data = [IoSlice::new(message)];
        sendmsg::<()>(ours.as_raw_fd(), &data, control, MsgFlags::empty(), None).expect("room");
        let incoming = watcher.take_message();
        let decoded = Message::decode(message);
        let is_taken = match decoded {
            Some(Message::Goodbye) => return assert!(matches!(incoming, Incoming::Goodbye)),
            Some(Message::Release) => {
                names.clear();
                files = 0;
                true
            }
            Some(Message::Forget { name }) => {
                names.remove(name);
                true
            }
            Some(Message::File(_)) => {
                files += usize::from(has_file);
                has_file
            }
            Some(Message::Line { name, .. }) if has_file => {
                names.insert(name);
                true
            }
            Some(Message::LastFile { name, .. }) if has_file => {
                names.insert(name);
                files = 0;
                true
            }
            _ => false,
        };
        if let Some(decoded) = decoded {
            assert_eq!(decoded.encode().as_deref(), Some(message));
        }
        let mut answer = [0];
        assert_eq!(recv(ours.as_raw_fd(), &mut answer, MsgFlags::MSG_DONTWAIT), Ok(1));
        assert_eq!(answer, [if is_taken { TAKEN } else { REFUSED }]);
        let apart = watcher.held.apart.iter().flat_map(|group| &group.outputs);
        let held: Vec<&str> = watcher.held.native.iter().chain(apart).map(|output| &*output.outcome.name).collect();
        assert!(held.len() == names.len() && held.iter().all(|name| names.contains(name)), "{held:?} {names:?}");
        assert_eq!(watcher.files.len(), files);
    }
}
