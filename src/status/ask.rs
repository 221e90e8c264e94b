// SPDX-License-Identifier: GPL-3.0-or-later
//! Asks a running Pinion for its status.

use std::io::{self, Read};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use serde::Deserialize;

use crate::not_permitted;
use pinion_runtime::socket_paths;
use pinion_runtime::status::connect;
use pinion_runtime::status::form::{self as status, Status};

use super::StatusArgs;

/// Longest wait for the answer. The server gives its core a second.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(5);
/// Longest answer that is read.
const ANSWER_MAX: usize = 4 << 20;

/// A Pinion's answer.
pub struct Answer {
    /// Its answer.
    pub status: Status,
    /// One line about the fields that this version does not know.
    pub(super) notice: Option<String>,
}

/// Asks the first socket that answers.
pub(super) fn ask(args: &StatusArgs) -> Result<Answer, String> {
    let paths = args.socket.clone().map_or_else(|| socket_paths(&args.symlink), |path| vec![path]);
    ask_at(&paths, &args.symlink)
}

/// Asks the first of these sockets that answers. They are of the instance with this link.
pub fn ask_at(paths: &[PathBuf], link: &Path) -> Result<Answer, String> {
    let (path, document) = fetch(paths, link, ANSWER_MAX)?;
    answer(&path, &document)
}

/// The answer of the first of these sockets that answers, and its path. They are of the instance with this link.
pub(crate) fn fetch(paths: &[PathBuf], link: &Path, bytes_max: usize) -> Result<(PathBuf, Vec<u8>), String> {
    let mut missing = Vec::new();
    for path in paths {
        match document_at(path, bytes_max) {
            Ok(document) => return Ok((path.clone(), document)),
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused) => {
                missing.push(path.display().to_string());
            }
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
                return Err(not_permitted(path, path));
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                return Err(format!(
                    "too many programs ask {} for its status at once: end some of them (sudo ss -xp names them)",
                    path.display()
                ));
            }
            Err(error) => {
                return Err(format!("{} gives no answer: {error}: look at Pinion's log", path.display()));
            }
        }
    }
    Err(format!(
        "no Pinion answers on {}: start it (sudo systemctl start pinion-mcu), or name its link with -I if that is not {}",
        missing.join(" or "),
        link.display()
    ))
}

/// Reads a document.
fn answer(path: &Path, document: &[u8]) -> Result<Answer, String> {
    /// The part that every version's document has.
    #[derive(Deserialize)]
    struct Sender {
        version: String,
    }
    let path = path.display();
    let own = pinion_runtime::VERSION;
    match status::read(document) {
        Ok((status, unknown)) => {
            let notice = (!unknown.is_empty()).then(|| {
                format!(
                    "{path}: Pinion {} reports fields that pinion {own} does not know and does not show: {}: use the pinion of that version",
                    status.version,
                    unknown.join(", ")
                )
            });
            Ok(Answer { status, notice })
        }
        Err(error) => Err(match serde_json::from_slice::<Sender>(document) {
            Ok(Sender { version }) => format!(
                "{path}: pinion {own} cannot read the status of Pinion {version}: {error}: use the pinion of that version"
            ),
            Err(_) => {
                format!("{path}: the answer is not a status: {error}: is it a Pinion? (--socket)")
            }
        }),
    }
}

/// The document from a socket.
fn document_at(path: &Path, bytes_max: usize) -> io::Result<Vec<u8>> {
    let until = Instant::now() + ANSWER_WAIT_MAX;
    // Other clients may ask as well. Then it takes a while until there is room for one more.
    let mut socket = loop {
        match connect(path) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock && Instant::now() < until => {
                thread::sleep(Duration::from_millis(10));
            }
            connected => break connected?,
        }
    };
    let (mut document, mut piece) = (Vec::new(), [0; 16384]);
    loop {
        match socket.read(&mut piece) {
            Ok(0) => return Ok(document),
            Ok(read) if document.len() + read <= bytes_max => document.extend_from_slice(&piece[..read]),
            Ok(_) => return Err(io::Error::other("the answer is too long")),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                let left = until.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return Err(io::ErrorKind::TimedOut.into());
                }
                let mut fds = [PollFd::new(socket.as_fd(), PollFlags::POLLIN)];
                let _ = poll(&mut fds, PollTimeout::try_from(left).unwrap_or(PollTimeout::MAX));
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn answered(document: &serde_json::Value) -> Result<Answer, String> {
        answer(Path::new("/run/pinion/mcu.sock"), document.to_string().as_bytes())
    }

    #[test]
    fn a_document_of_another_version_is_read_as_far_as_it_is_known_or_refused_by_name() {
        let status = status::read(include_bytes!("../../crates/runtime/src/status/recorded.json")).unwrap().0;
        let mut document = json!(status);
        let same = answered(&document).unwrap();
        assert_eq!((&same.status, &same.notice), (&status, &None));
        document["colour"] = json!("red");
        let more = answered(&document).unwrap();
        assert_eq!(more.status, status);
        let notice = more.notice.unwrap();
        assert!(notice.contains(&format!("Pinion {}", status.version)) && notice.contains(": colour: use"), "{notice}");
        document["form"] = json!(null);
        let error = answered(&document).map(|_| ()).unwrap_err();
        assert!(
            error.contains(&format!("of Pinion {}: ", status.version)) && error.contains("use the pinion"),
            "{error}"
        );
        let error = answered(&json!({ "HTTP": 1.1 })).map(|_| ()).unwrap_err();
        assert!(error.starts_with("/run/pinion/mcu.sock: the answer is not a status: "), "{error}");
    }
}
