// SPDX-License-Identifier: GPL-3.0-or-later
//! Any bytes from a socket, and what `pinion status` prints of them.

use pinion::status::FORMS;
use pinion_runtime::status::form::read;

pub fn run(bytes: &[u8]) {
    let Ok((status, _)) = read(bytes) else { return };
    let pages = FORMS.map(|form| form(&status).to_string());
    for page in &pages {
        assert!(!page.contains(|c: char| c.is_control() && c != '\n'), "{page:?}");
    }
    // A status that is read, written and read again is the same.
    let again = read(pages[FORMS.len() - 1].as_bytes());
    assert_eq!(again.map(|(again, _)| again).ok(), Some(status));
}
