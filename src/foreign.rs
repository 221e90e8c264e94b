// SPDX-License-Identifier: GPL-3.0-or-later
//! Data of others: files that may be anything, and names that may contain anything.
//!
//! A host, its checkout, other processes and devices choose their own names. Their files are read with [`read`]. Their
//! names leave the program only after [`plain`], [`plain_json`] or [`plain_xml`].

#![forbid(unsafe_code)]

use std::borrow::Cow;
use std::fs::{File, Metadata, OpenOptions};
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use nix::fcntl::OFlag;

/// Opens a regular file to read it.
///
/// # Errors
///
/// It cannot be opened. [`io::ErrorKind::InvalidInput`]: it is not a regular file.
pub(crate) fn open(path: &Path) -> io::Result<(File, Metadata)> {
    // With O_PATH nothing is opened yet: a FIFO cannot block, and no device notices (a watchdog starts when it is
    // opened). The second open is of that very file, even if the path leads elsewhere by then.
    let place = OpenOptions::new().read(true).custom_flags(OFlag::O_PATH.bits()).open(path)?;
    let about = place.metadata()?;
    if !about.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is no regular file"));
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
pub(crate) fn read(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.0.take(bytes_max).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// A text as part of one line for a terminal or a log. Each control character is replaced.
///
/// The C0 and C1 controls and DEL have meanings to terminals. A line feed would begin a line that passes for one of
/// ours.
pub(crate) fn plain(text: &str) -> Cow<'_, str> {
    if text.contains(char::is_control) { text.replace(char::is_control, "?").into() } else { text.into() }
}

/// The same for JSON, whose lines are separated by line feeds. Inside its strings, line feeds and other characters
/// below 0x20 are escaped already. The remaining control characters are escaped here.
pub(crate) fn plain_json(json: &str) -> String {
    let mut plain = String::with_capacity(json.len());
    for c in json.chars() {
        match c {
            '\n' => plain.push(c),
            c if c.is_control() => plain += &format!("\\u{:04x}", u32::from(c)),
            c => plain.push(c),
        }
    }
    plain
}

/// The same for the text and the attributes of XML.
pub(crate) fn plain_xml(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => plain.push_str("&amp;"),
            '<' => plain.push_str("&lt;"),
            '>' => plain.push_str("&gt;"),
            '"' => plain.push_str("&quot;"),
            // XML has no place for these two.
            '\u{fffe}' | '\u{ffff}' => plain.push(' '),
            c if c.is_control() => plain.push(' '),
            c => plain.push(c),
        }
    }
    plain
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::fs;

    /// Any text, often with control characters.
    pub(crate) fn any_name() -> impl Strategy<Value = String> {
        "(\\PC|[\\x00-\\x1f\\x7f-\\x9f]|\x1b\\[31m|\n<0>){0,12}"
    }

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

    proptest! {
        #[test]
        fn no_control_character_is_left(text in any_name()) {
            let shown = plain(&text);
            prop_assert!(!shown.contains(char::is_control));
            prop_assert_eq!(shown.chars().count(), text.chars().count());
            let json = plain_json(&serde_json::json!({ &text: [&text] }).to_string());
            prop_assert!(!json.contains(char::is_control));
            let xml = format!("<a>{}</a>", plain_xml(&text));
            prop_assert!(!xml.contains(char::is_control));
            prop_assert_eq!(roxmltree::Document::parse(&xml).unwrap().descendants().count(), 2 + usize::from(!text.is_empty()));
            prop_assert_eq!(&serde_json::from_str::<serde_json::Value>(&json).unwrap()[&text][0], &text);
        }
    }
}
