// SPDX-License-Identifier: GPL-3.0-or-later
//! The way to stdout: pages of whole lines.
//!
//! The text of a line may come from anywhere: a host, a process, a file, a device. In a [`Page`] it stays in its line,
//! and has nothing that a terminal takes for a command. The log does the same (`logging.rs`).

use std::fmt::{self, Display, Write as _};
use std::fs::File;
use std::io::{self, Write as _};
use std::os::fd::{AsFd, BorrowedFd};

use pinion_linux::foreign::{plain, plain_json};

/// Lines, each with its line feed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Page(String);

impl Page {
    /// A text whose line feeds are ours.
    pub fn text(text: &str) -> Page {
        let mut page = Page::default();
        text.lines().for_each(|line| page.line(line));
        page
    }

    /// JSON as serde_json writes it: it escapes the line feeds that are not its own.
    pub fn json(json: &str) -> Page {
        Page(plain_json(json))
    }

    /// Adds a line.
    pub fn line(&mut self, line: impl Display) {
        // A String takes everything that is written to it.
        let _ = writeln!(self.0, "{}", plain(&line.to_string()));
    }

    /// Adds the lines of another page.
    pub fn append(&mut self, other: &Page) {
        self.0 += &other.0;
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The lines, without their line feeds.
    pub fn lines(&self) -> impl Iterator<Item = &str> {
        self.0.lines()
    }
}

impl Display for Page {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The rows of a table as lines: each column is as wide as its widest cell, with two spaces between columns.
pub fn aligned(rows: &[Vec<String>]) -> Vec<String> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max();
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
    let line = |row: &Vec<String>| -> String {
        // A width in a format may be 65535 at most, and a cell may be longer.
        let pad = |cell: &String, width: &usize| " ".repeat(width - cell.chars().count());
        let cells: Vec<String> =
            row.iter().zip(&widths).map(|(cell, width)| cell.clone() + &pad(cell, width)).collect();
        cells.join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect()
}

/// Prints on stdout. A reader that has closed it, such as `head`, is no failure: the program continues with its other
/// work.
pub fn print(page: &Page) -> Result<(), String> {
    match draw(&page.0) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(format!("stdout cannot be written: {error}")),
        _ => Ok(()),
    }
}

/// Writes text on stdout that moves the cursor and paints. The names in it come from a page or from [`plain`].
pub fn draw(text: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.flush()?;
    write_at_once(out.as_fd(), text)
}

/// Writes all of it in one call, as far as the reader takes it. The standard library's stdout makes a call for the text up
/// to the last newline and another for the rest. A line of the log between the two would be written where the picture is
/// drawn, because the log is written by another thread.
fn write_at_once(out: BorrowedFd, text: &str) -> io::Result<()> {
    File::from(out.try_clone_to_owned()?).write_all(text.as_bytes())
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixDatagram;

    use super::*;
    use pinion_testkit::names::{any_name, assert_plain};
    use proptest::prelude::*;

    #[test]
    fn a_picture_is_written_in_one_call() {
        // Each call is a datagram.
        let (out, reader) = UnixDatagram::pair().unwrap();
        let text = format!("\n\n{}\n\x1b[2;1Hend", "x".repeat(3000));
        write_at_once(out.as_fd(), &text).unwrap();
        let mut read = [0; 4000];
        assert_eq!(reader.recv(&mut read).unwrap(), text.len());
    }

    #[test]
    fn a_table_has_room_for_the_longest_cell() {
        let long = "x".repeat(70_000);
        let rows = [vec!["a".to_owned(), "b".to_owned()], vec![long.clone(), "d".to_owned()]];
        assert_eq!(aligned(&rows), [format!("a{}b", " ".repeat(70_001)), format!("{long}  d")]);
    }

    proptest! {
        #[test]
        fn a_line_stays_one(name in any_name()) {
            let mut page = Page::default();
            page.line(format_args!("the host {name}"));
            assert_plain(&page.to_string(), 1);
            let json = serde_json::to_string_pretty(&[&name]).unwrap();
            assert_plain(&Page::json(&json).to_string(), 2);
        }
    }
}
