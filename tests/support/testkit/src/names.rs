// SPDX-License-Identifier: GPL-3.0-or-later
//! Names that others chose, and what is printed of them.

use pinion_linux::foreign::is_unseen;

/// Any text, often with characters that are not seen: the regular expression of a strategy of proptest.
pub fn any_name() -> &'static str {
    "(\\PC|[\\x00-\\x1f\\x7f-\\x9f]|[\u{202a}-\u{202e}\u{2028}\u{200b}\u{feff}\u{e0041}]|\x1b\\[31m|\n<0>){0,12}"
}

/// Asserts that only lines leave a printer, and no more of them than with harmless names.
#[track_caller]
pub fn assert_plain(text: &str, lines: usize) {
    let unseen = text.chars().find(|c| is_unseen(*c) && *c != '\n');
    assert_eq!(unseen, None, "{text:?}");
    assert_eq!(text.matches('\n').count(), lines, "{text:?}");
}
