// SPDX-License-Identifier: GPL-3.0-or-later
//! Finds the messages that a checkout of klippy looks up, from the strings in its sources.
//!
//! klippy writes each message that it exchanges with an MCU as a string. The string has the message's name and its
//! parameters, often in pieces:
//!
//! ```python
//! self.query_cmd = mcu.lookup_command("query_adxl345 oid=%c"
//!                                     " rest_ticks=%u")
//! ```

use std::collections::{BTreeSet, VecDeque};
use std::fs;
use std::io::{self, Read};
use std::path::Path;
use std::time::SystemTime;

use pinion_linux::foreign;

#[cfg(fuzzing)]
#[path = "../../../tests/support/sources_fuzz.rs"]
pub mod fuzz;

/// Highest numbers that are read of a checkout: names in its folders, files, bytes of one file and of all files,
/// messages. klippy's own come first. Further ones, of a plugin that brings much along, are left out.
const NAMES_MAX: usize = 20_000;
const FILES_MAX: usize = 2000;
const FILE_BYTES_MAX: u64 = 1 << 20;
const BYTES_MAX: u64 = 32 << 20;
const SHAPES_MAX: usize = 10_000;
/// Longest message. klippy's have at most 150 bytes.
const SHAPE_BYTES_MAX: usize = 1000;
/// Highest depth of folders: klippy's own folder, `extras`, and packages in there.
const DEPTH_MAX: usize = 3;

/// A message as a host looks it up: its name and its parameters' names, in order. An example is
/// `query_adxl345 oid rest_ticks`. The conversions are left out, because klippy writes the parameters of `config_`
/// commands with Python's conversions.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Shape(String);

impl Shape {
    /// The shape of a format. `None` for a text that is not a format with parameters. A parameter's value is a
    /// conversion, a part of a Python f-string, or a number.
    pub fn of(format: &str) -> Option<Shape> {
        let is_word = |word: &str| {
            word.starts_with(|c: char| c.is_ascii_lowercase())
                && word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        };
        let (name, mut rest) = format.split_once(' ')?;
        if !is_word(name) {
            return None;
        }
        let mut shape = name.to_owned();
        loop {
            let (key, value) = rest.split_once('=')?;
            if !is_word(key) {
                return None;
            }
            shape.push(' ');
            shape.push_str(key);
            let end = value_end(value)?;
            match value[end..].strip_prefix(' ') {
                Some(more) => rest = more,
                None if end == value.len() => return Some(Shape(shape)),
                None => return None,
            }
        }
    }

    /// The message's name.
    pub fn name(&self) -> &str {
        self.0.split(' ').next().unwrap_or_default()
    }

    /// The names of its parameters.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.0.split(' ').skip(1)
    }

    /// Name and parameters, for people.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Where a parameter's value ends.
fn value_end(value: &str) -> Option<usize> {
    let word = value.find(' ').unwrap_or(value.len());
    match value.as_bytes().first()? {
        b'%' => Some(word),
        b'{' => {
            let mut depth = 0;
            let mut ends = value.bytes().enumerate().filter_map(|(at, byte)| {
                depth += i32::from(byte == b'{') - i32::from(byte == b'}');
                (depth == 0).then_some(at + 1)
            });
            ends.next()
        }
        _ => value[..word].parse::<i64>().is_ok().then_some(word),
    }
}

/// The contents of a folder of sources.
#[derive(Debug)]
pub struct Sources {
    /// The shapes of all messages.
    pub shapes: BTreeSet<Shape>,
    /// The wanted words that stand alone in a string.
    pub words: BTreeSet<String>,
    /// When the newest file was written.
    pub newest: SystemTime,
    /// The first part that could not be read, if any.
    pub unread: Option<String>,
    bytes: u64,
}

impl Default for Sources {
    fn default() -> Sources {
        let (shapes, words) = (BTreeSet::new(), BTreeSet::new());
        Sources { shapes, words, newest: SystemTime::UNIX_EPOCH, unread: None, bytes: 0 }
    }
}

impl Sources {
    /// Reads klippy's folder, which holds `klippy.py`.
    ///
    /// # Errors
    ///
    /// The folder itself cannot be read. Files in it that cannot be read are left out: they may be a plugin's.
    pub fn read(klippy: &Path, is_wanted: &dyn Fn(&str) -> bool) -> io::Result<Sources> {
        let mut sources = Sources::default();
        sources.read_folder(klippy, "py", DEPTH_MAX, is_wanted)?;
        Ok(sources)
    }

    /// The messages in the C sources of a firmware for Linux. Nothing is found if they cannot be read: they are needed
    /// only to build that firmware.
    pub fn of_firmware(src: &Path) -> BTreeSet<Shape> {
        let mut sources = Sources::default();
        for folder in [src.to_owned(), src.join("linux")] {
            // `Err` is a checkout without these sources.
            let _ = sources.read_folder(&folder, "c", 1, &|_| false);
        }
        sources.shapes
    }

    fn read_folder(
        &mut self,
        folder: &Path,
        extension: &str,
        depth_max: usize,
        is_wanted: &dyn Fn(&str) -> bool,
    ) -> io::Result<()> {
        let (mut names, mut files) = (0, 0);
        let mut folders = VecDeque::from([(folder.to_owned(), 1)]);
        while let Some((folder, depth)) = folders.pop_front() {
            let entries = match fs::read_dir(&folder) {
                Err(error) if depth > 1 => {
                    self.leave_out(&folder, &error);
                    continue;
                }
                entries => entries?,
            };
            for entry in entries {
                // The checkout may change while it is read: an update, or a plugin that is installed.
                let entry = match entry {
                    Err(error) => {
                        self.leave_out(&folder, &error);
                        break;
                    }
                    Ok(entry) => entry,
                };
                let path = entry.path();
                if names == NAMES_MAX || files == FILES_MAX || self.bytes >= BYTES_MAX {
                    self.unread.get_or_insert_with(|| format!("{} has too many files", folder.display()));
                    return Ok(());
                }
                names += 1;
                if path.extension().is_some_and(|found| found == extension) {
                    files += 1;
                    if let Err(error) = self.add(&path, is_wanted) {
                        self.leave_out(&path, &error);
                    }
                } else if depth < depth_max && entry.file_type().is_ok_and(|kind| !kind.is_file()) && path.is_dir() {
                    folders.push_back((path, depth + 1));
                }
            }
        }
        Ok(())
    }

    fn add(&mut self, path: &Path, is_wanted: &dyn Fn(&str) -> bool) -> io::Result<()> {
        let (file, metadata) = match foreign::open(path) {
            // A link that leads nowhere is a removed plugin, and klippy does not load it. klippy also does not load
            // things that are not files, such as a FIFO.
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::InvalidInput) => {
                return Ok(());
            }
            opened => opened?,
        };
        if metadata.len() > FILE_BYTES_MAX {
            return Ok(());
        }
        let mut text = Vec::with_capacity(metadata.len() as usize + 1);
        file.take(FILE_BYTES_MAX).read_to_end(&mut text)?;
        self.bytes += text.len() as u64;
        self.newest = self.newest.max(metadata.modified()?);
        // Most files have no message, and need not be read as Python.
        if text.windows(2).any(|pair| pair == b"=%" || pair == b"={") {
            strings(&text, |string| match Shape::of(string).filter(|_| string.len() <= SHAPE_BYTES_MAX) {
                Some(shape) if self.shapes.len() < SHAPES_MAX => {
                    self.shapes.insert(shape);
                }
                Some(shape) if !self.shapes.contains(&shape) => {
                    self.unread.get_or_insert_with(|| format!("{} has too many messages", path.display()));
                }
                None if is_wanted(string) => {
                    self.words.insert(string.to_owned());
                }
                _ => {}
            });
        }
        Ok(())
    }

    fn leave_out(&mut self, path: &Path, error: &io::Error) {
        self.unread.get_or_insert_with(|| format!("{}: {error}", path.display()));
    }
}

/// Passes each string of a Python source to `found`. Adjacent literals are one string.
fn strings(source: &[u8], mut found: impl FnMut(&str)) {
    let mut at = 0;
    // The bytes of the literals so far, if the last token was one.
    let mut string: Option<Vec<u8>> = None;
    while let Some(&byte) = source.get(at) {
        match byte {
            b' ' | b'\t' | b'\r' | b'\n' | b'\\' => at += 1,
            b'#' => at += source[at..].iter().take_while(|byte| **byte != b'\n').count(),
            b'"' | b'\'' => at = literal(source, at, string.get_or_insert_default()),
            _ if byte.is_ascii_alphanumeric() || byte == b'_' => {
                let is_word = |byte: &&u8| byte.is_ascii_alphanumeric() || **byte == b'_';
                let end = at + source[at..].iter().take_while(is_word).count();
                // `r"..."` and the like: the letters belong to the literal.
                let is_prefix = end - at <= 2 && matches!(source.get(end), Some(b'"' | b'\''));
                if !is_prefix {
                    flush(&mut string, &mut found);
                }
                at = end;
            }
            _ => {
                flush(&mut string, &mut found);
                at += 1;
            }
        }
    }
    flush(&mut string, &mut found);
}

fn flush(string: &mut Option<Vec<u8>>, found: &mut impl FnMut(&str)) {
    if let Some(Ok(string)) = string.take().map(String::from_utf8) {
        found(&string);
    }
}

/// Appends the literal whose quote stands at `at`, and returns where it ends.
fn literal(source: &[u8], at: usize, string: &mut Vec<u8>) -> usize {
    let quote = source[at];
    let is_long = source[at..].starts_with(&[quote; 3]);
    let (mut at, end): (usize, &[u8]) = if is_long { (at + 3, &[quote; 3]) } else { (at + 1, &[quote]) };
    let begin = at;
    let (text_end, end) = loop {
        match source.get(at) {
            None => break (source.len(), source.len()),
            Some(byte) if *byte == quote && source[at..].starts_with(end) => break (at, at + end.len()),
            Some(b'\n') if !is_long => break (at, at),
            Some(b'\\') => at += 2,
            Some(_) => at += 1,
        }
    };
    string.extend_from_slice(&source[begin..text_end]);
    end
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strings_of(source: &str) -> Vec<String> {
        let mut strings_of = Vec::new();
        strings(source.as_bytes(), |string| strings_of.push(string.to_owned()));
        strings_of
    }

    #[test]
    fn adjacent_literals_are_one_string() {
        assert_eq!(strings_of("f('a' \"b\"\n  # not \"this\"\n  r'c', 'd')"), ["abc", "d"]);
        assert_eq!(strings_of("x = \"a\" \\\n 'b'\ny = 'c' % (1,)"), ["ab", "c"]);
        assert_eq!(strings_of("'it\\'s' + \"so\""), ["it\\'s", "so"]);
        assert_eq!(strings_of("\"\"\"a \"long\" one\n'\"\"\" 'b'"), ["a \"long\" one\n'b"]);
        assert_eq!(strings_of("word'a'"), ["a"], "no Python, and no reason to fail");
        assert_eq!(strings_of("'open\n'b'"), ["openb"]);
        assert_eq!(strings_of("'ends with \\"), ["ends with \\"]);
    }

    #[test]
    fn a_shape_is_name_and_parameters() {
        let shape = |format| Shape::of(format).map(|shape| shape.0);
        assert_eq!(shape("query_adxl345 oid=%c rest_ticks=%u").as_deref(), Some("query_adxl345 oid rest_ticks"));
        assert_eq!(shape("config_spi oid=%d pin=%s").as_deref(), Some("config_spi oid pin"));
        assert_eq!(shape("i2c_write oid=%c data=%*s").as_deref(), Some("i2c_write oid data"));
        assert_eq!(
            shape("q_x oid={self.oid} i2c_oid={ {'a b': 1}[k] } rest=0").as_deref(),
            Some("q_x oid i2c_oid rest")
        );
        for text in [
            "get_clock",
            "speed=%d",
            "a b={c",
            "a b={c}d",
            "a b=1.5",
            "a b=c",
            "Speed limit=%d",
            "a b",
            "a b= c=%d",
            "a  b=%d",
            "a b=%d, c=%d is wrong",
        ] {
            assert_eq!(shape(text), None, "{text}");
        }
    }

    #[test]
    fn a_checkout_may_change_while_it_is_read() {
        use std::sync::atomic::{AtomicBool, Ordering};
        const ROUNDS: usize = 50;
        let folder = tempfile::tempdir().unwrap();
        let here = folder.path();
        fs::write(here.join("mcu.py"), "a('trsync_start oid=%c report_clock=%u')").unwrap();
        let is_over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let (extras, file) = (here.join("extras"), here.join("extras/bus.py"));
                while !is_over.load(Ordering::Relaxed) {
                    // A file that appears, grows, shrinks, becomes a link, and goes with its folder.
                    let _ = fs::create_dir(&extras);
                    let _ = fs::write(&file, "b = 'i2c_write oid=%c data=%*s'".repeat(1000));
                    let _ = fs::write(&file, "b = 'i2c_wr");
                    let _ = fs::remove_file(&file);
                    let _ = std::os::unix::fs::symlink("../mcu.py", &file);
                    let _ = fs::rename(&extras, here.join("gone"));
                    let _ = fs::remove_dir_all(here.join("gone"));
                    let _ = std::os::unix::fs::symlink("/nonexistent", &extras);
                    let _ = fs::remove_file(&extras);
                }
            });
            let sources: Vec<_> = (0..ROUNDS).map(|_| Sources::read(here, &|_| false)).collect();
            is_over.store(true, Ordering::Relaxed);
            for sources in sources {
                let shapes = sources.unwrap().shapes;
                assert!(shapes.contains(&Shape("trsync_start oid report_clock".into())), "{shapes:?}");
            }
        });
    }

    #[test]
    fn a_folder_is_read_with_its_packages_but_not_forever() {
        let folder = tempfile::tempdir().unwrap();
        let put = |path: &str, text: &str| {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        put("mcu.py", "a('trsync_start oid=%c' ' report_clock=%u')");
        put("extras/bus.py", "b = \"i2c_write oid=%c data=%*s\", 'STEPPER_STEP_BOTH_EDGE', 'other'");
        put("extras/display/hd44780.py", "c('hd44780_send_cmds oid=%c cmds=%*s')");
        put("a/b/c/deep.py", "d('too_deep oid=%c')");
        put("notes.txt", "'no_python oid=%c'");
        let link = |target: &str, path: &str| std::os::unix::fs::symlink(target, folder.path().join(path)).unwrap();
        link("/nonexistent", "extras/gone.py");
        link("..", "extras/round");
        link("self.py", "extras/self.py");
        nix::unistd::mkfifo(&folder.path().join("extras/fifo.py"), nix::sys::stat::Mode::S_IRWXU).unwrap();
        let sources = Sources::read(folder.path(), &|word| word == "STEPPER_STEP_BOTH_EDGE").unwrap();
        let shapes: Vec<&str> = sources.shapes.iter().map(Shape::as_str).collect();
        assert_eq!(shapes, ["hd44780_send_cmds oid cmds", "i2c_write oid data", "trsync_start oid report_clock"]);
        assert_eq!(sources.words.into_iter().collect::<Vec<_>>(), ["STEPPER_STEP_BOTH_EDGE"]);
        // A file that cannot be read loses nothing else. Here it is a link that leads to itself: root may read any
        // file.
        let unread = sources.unread.unwrap();
        assert!(unread.contains("extras/self.py: "), "{unread}");
        assert!(Sources::read(&folder.path().join("none"), &|_| false).is_err());
    }
}
