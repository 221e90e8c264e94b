// SPDX-License-Identifier: GPL-3.0-or-later
//! The bounds of an answer of the search, and any bytes as one, for `fuzz/`.

use super::*;

impl Answer {
    /// Asserts that nothing in it is too long or may not be shown.
    pub(super) fn assert_bounded(&self) {
        assert!(self.lines.len() <= LINES_MAX);
        let checkout = self.host.iter().filter_map(|host| host.checkout.as_ref());
        for text in self.lines.iter().map(|line| &line.text).chain(checkout) {
            assert!(!text.contains(pinion_linux::foreign::is_unseen) && text.chars().count() <= LINE_CHARS_MAX);
        }
        let commit = self.host.iter().find_map(|host| host.commit.as_ref());
        assert!(commit.is_none_or(|commit| commit.len() <= 40 && commit.bytes().all(|b| b.is_ascii_hexdigit())));
        assert!(serde_json::to_vec(self).is_ok_and(|bytes| bytes.len() <= MESSAGE_BYTES_MAX));
    }
}

/// For `fuzz/`: any bytes over the socket, in either direction.
#[cfg(fuzzing)]
pub fn search(bytes: &[u8]) {
    if let Some(answer) = Answer::decode(bytes) {
        answer.assert_bounded();
        let _ = answer.forms();
    }
    let _ = serde_json::from_slice::<Question>(bytes);
    let _ = serde_json::from_slice::<Hello>(bytes);
}
