// SPDX-License-Identifier: GPL-3.0-or-later
//! Data of others: files that may be anything, and names that may contain anything.
//!
//! A host, its checkout, other processes and devices choose their own names. Their files are read with [`read`]. Their
//! names leave the program only after [`plain`], [`plain_json`] or [`plain_xml`], and stand in a command as a [`word`].

#![forbid(unsafe_code)]

use std::borrow::Cow;
use std::fmt::Display;
use std::fs::{File, Metadata, OpenOptions};
use std::io::{self, Read};
use std::ops::RangeInclusive;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use nix::fcntl::OFlag;

/// Opens a regular file to read it.
///
/// # Errors
///
/// It cannot be opened. [`io::ErrorKind::InvalidInput`]: it is not a regular file.
pub fn open(path: &Path) -> io::Result<(File, Metadata)> {
    // With O_PATH nothing is opened yet: a FIFO cannot block, and no device notices (a watchdog starts when it is
    // opened). The second open is of that very file, even if the path leads elsewhere by then.
    let place = OpenOptions::new().read(true).custom_flags(OFlag::O_PATH.bits()).open(path)?;
    let about = place.metadata()?;
    if !about.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is not a regular file"));
    }
    let flags = (OFlag::O_NONBLOCK | OFlag::O_NOCTTY).bits();
    let same = format!("/proc/self/fd/{}", place.as_raw_fd());
    Ok((OpenOptions::new().read(true).custom_flags(flags).open(same)?, about))
}

/// Reads the first `bytes_max` bytes of a regular file.
///
/// # Errors
///
/// The errors of [`open`] and of reading.
pub fn read(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.0.take(bytes_max).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The characters that no reader sees and that change what a reader sees: Unicode's bidirectional controls, its line and
/// paragraph separators, its annotation marks, and all other characters that it calls default ignorable. Two names that
/// differ only in these look the same.
const UNSEEN: [RangeInclusive<char>; 18] = [
    '\u{ad}'..='\u{ad}',
    '\u{34f}'..='\u{34f}',
    '\u{61c}'..='\u{61c}',
    '\u{115f}'..='\u{1160}',
    '\u{17b4}'..='\u{17b5}',
    '\u{180b}'..='\u{180f}',
    '\u{200b}'..='\u{200f}',
    '\u{2028}'..='\u{202e}',
    '\u{2060}'..='\u{206f}',
    '\u{3164}'..='\u{3164}',
    '\u{fe00}'..='\u{fe0f}',
    '\u{feff}'..='\u{feff}',
    '\u{ffa0}'..='\u{ffa0}',
    '\u{fff0}'..='\u{fffb}',
    '\u{13430}'..='\u{1343f}',
    '\u{1bca0}'..='\u{1bca3}',
    '\u{1d173}'..='\u{1d17a}',
    '\u{e0000}'..='\u{e0fff}',
];

/// Whether a character of a name may not be shown. The C0 and C1 controls and DEL have meanings to terminals. A line
/// feed would begin a line that passes for one of ours. A mark such as U+202E shows the rest of the line backwards.
pub fn is_unseen(c: char) -> bool {
    // The ranges begin above ASCII, which most characters are.
    c.is_control() || (!c.is_ascii() && UNSEEN.iter().any(|range| range.contains(&c)))
}

/// A text as part of one line for a terminal or a log. Each character that is not seen is replaced.
pub fn plain(text: &str) -> Cow<'_, str> {
    if text.contains(is_unseen) { text.replace(is_unseen, "?").into() } else { text.into() }
}

/// A text as one word of a command that a reader gives to a shell. A usual path or name stays as it is.
pub fn word(text: impl Display) -> String {
    let text = text.to_string();
    let is_usual = |c: char| c.is_ascii_alphanumeric() || "/._-+,:@%=".contains(c);
    match !text.is_empty() && text.chars().all(is_usual) {
        true => text,
        false => format!("'{}'", text.replace('\'', "'\\''")),
    }
}

/// The same for JSON, whose lines are separated by line feeds. Inside its strings, line feeds and other characters
/// below 0x20 are escaped already. The remaining ones are escaped here.
pub fn plain_json(json: &str) -> String {
    let mut plain = String::with_capacity(json.len());
    for c in json.chars() {
        match c {
            '\n' => plain.push(c),
            c if is_unseen(c) => {
                c.encode_utf16(&mut [0; 2]).iter().for_each(|unit| plain += &format!("\\u{unit:04x}"));
            }
            c => plain.push(c),
        }
    }
    plain
}

/// The same for the text and the attributes of XML.
pub fn plain_xml(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => plain.push_str("&amp;"),
            '<' => plain.push_str("&lt;"),
            '>' => plain.push_str("&gt;"),
            '"' => plain.push_str("&quot;"),
            // XML has no place for these two.
            '\u{fffe}' | '\u{ffff}' => plain.push(' '),
            c if is_unseen(c) => plain.push(' '),
            c => plain.push(c),
        }
    }
    plain
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_testkit::names::any_name;
    use proptest::prelude::*;
    use std::fs;

    #[test]
    fn only_regular_files_are_read_and_not_for_ever() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        let kind = || read(&path, 10).unwrap_err().kind();
        assert_eq!(kind(), io::ErrorKind::NotFound);
        fs::create_dir(&path).unwrap();
        assert_eq!(kind(), io::ErrorKind::InvalidInput);
        fs::remove_dir(&path).unwrap();
        nix::unistd::mkfifo(&path, nix::sys::stat::Mode::S_IRWXU).unwrap();
        assert_eq!(kind(), io::ErrorKind::InvalidInput);
        fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
        assert_eq!(kind(), io::ErrorKind::InvalidInput);
        fs::remove_file(&path).unwrap();
        fs::write(&path, "0123456789abc").unwrap();
        assert_eq!(read(&path, 10).unwrap(), b"0123456789");
        // Files in /proc have no length.
        assert!(!read(Path::new("/proc/self/stat"), 4096).unwrap().is_empty());
    }

    #[test]
    fn a_name_cannot_turn_its_line_around_or_hide_in_it() {
        // As in "Trojan Source": the words after the mark are shown from right to left.
        for mark in "\u{202a}\u{202b}\u{202c}\u{202d}\u{202e}\u{2066}\u{2067}\u{2068}\u{2069}\u{200e}\u{200f}\u{61c}\u{2028}\u{2029}\u{200b}\u{200d}\u{2060}\u{feff}\u{ad}\u{3164}\u{fe0f}\u{e0041}".chars() {
            let name = format!("a{mark}b");
            assert_eq!(plain(&name), "a?b", "U+{:04X}", u32::from(mark));
            assert!(plain_json(&format!("\"{name}\"")).is_ascii() && plain_xml(&name) == "a b");
        }
        assert_eq!(plain_json("\"\u{e0041}\""), "\"\\udb40\\udc41\"");
        // Letters of all languages stay, with their accents.
        for name in ["Grüße", "e\u{301}", "打印机", "מדפסת", "طابعة", "프린터", "µ°½€"] {
            assert_eq!(plain(name), name);
        }
    }

    #[test]
    fn a_word_of_a_command_is_one_word() {
        for usual in ["/tmp/klipper_host_mcu", "pinion-mcu@b-2.service", "/dev/serial/by-id/usb-1a86:7523"] {
            assert_eq!(word(usual), usual);
        }
        for name in ["", "a b", "$(reboot)", "a;b", "`id`", "it's", "a\\x2db", "~root", "#", "*", "a\nb", "a&b|c>d"] {
            let echoed = std::process::Command::new("sh").arg("-c").arg(format!("printf %s {}", word(name))).output();
            assert_eq!(String::from_utf8(echoed.unwrap().stdout).unwrap(), name);
        }
    }

    proptest! {
        #[test]
        fn nothing_unseen_is_left(text in any_name()) {
            let shown = plain(&text);
            prop_assert!(!shown.contains(is_unseen));
            prop_assert_eq!(shown.chars().count(), text.chars().count());
            let json = plain_json(&serde_json::json!({ &text: [&text] }).to_string());
            prop_assert!(!json.contains(is_unseen));
            let xml = format!("<a>{}</a>", plain_xml(&text));
            prop_assert!(!xml.contains(is_unseen));
            prop_assert_eq!(roxmltree::Document::parse(&xml).unwrap().descendants().count(), 2 + usize::from(!text.is_empty()));
            prop_assert_eq!(&serde_json::from_str::<serde_json::Value>(&json).unwrap()[&text][0], &text);
        }
    }
}
