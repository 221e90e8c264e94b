// SPDX-License-Identifier: GPL-3.0-or-later
//! A configuration from its files: includes and the SAVE_CONFIG block.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::files::{Disk, Files, NAMES_MAX, is_pattern, matching};
use crate::parse::{Line, included, uncommented};
use crate::{Config, Include, Place, SourceFile, Trouble};

/// Highest number of files, each counted as often as it is included.
const FILES_MAX: usize = 500;
/// Highest number of includes, also of those that find no file: each searches a folder.
const INCLUDES_MAX: usize = 1000;
/// Highest number of bytes in all files.
const BYTES_MAX: usize = 16 << 20;
/// The head of the block that klippy's SAVE_CONFIG writes.
const SAVED: &str = "\n#*# <---------------------- SAVE_CONFIG ---------------------->\n\
                     #*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n";

impl Config {
    /// Reads a printer.cfg with all files that it includes.
    ///
    /// # Errors
    ///
    /// The first thing that klippy would refuse, or that is beyond a limit.
    pub fn read(path: &Path) -> Result<Config, Trouble> {
        Config::read_from(&Disk, path)
    }

    /// The same, with files from somewhere.
    ///
    /// # Errors
    ///
    /// Those of [`Config::read`].
    pub fn read_from(files: &dyn Files, path: &Path) -> Result<Config, Trouble> {
        Config::read_with(files, path, None).map(|(config, _)| config)
    }

    /// Reads a printer.cfg whose included files may be missing: a copy may lack the files of other programs. In the
    /// place of such a file comes the text that `stand_in` gives for its path. Returns a trouble for each, too.
    ///
    /// # Errors
    ///
    /// All others of [`Config::read`].
    pub fn read_present(path: &Path, stand_in: StandIn) -> Result<(Config, Vec<Trouble>), Trouble> {
        Config::read_with(&Disk, path, Some(stand_in))
    }

    fn read_with(files: &dyn Files, path: &Path, stand_in: Option<StandIn>) -> Result<(Config, Vec<Trouble>), Trouble> {
        let (config, within, missing) = (Config::default(), Vec::new(), Vec::new());
        let mut reader =
            Reader { files, config, within, stand_in, missing, opened: 0, bytes: 0, names_left: NAMES_MAX };
        let text = reader.text(path)?;
        let (usual, saved) = match text.find(SAVED).map(|at| text.split_at(at)) {
            Some((usual, block)) => match saved_lines(&block[SAVED.len()..]) {
                Some(lines) if !usual.contains("\n#*# ") => (usual, lines),
                // klippy ignores a block that somebody edited.
                _ => (text.as_str(), Vec::new()),
            },
            None => (text.as_str(), Vec::new()),
        };
        let file: Arc<Path> = path.into();
        reader.include(&file, usual)?;
        let mut config = reader.config;
        config.add_saved(&file, usual.matches('\n').count(), &saved)?;
        for setting in config.sections.iter_mut().flat_map(|section| &mut section.settings) {
            setting.value.truncate(setting.value.trim_end().len());
        }
        config.files.insert(0, SourceFile { path: file, text });
        Ok((config, reader.missing))
    }

    /// The text of the main file without the lines of these sections in its SAVE_CONFIG block.
    pub fn without_saved(&self, text: &str, sections: &[&str]) -> String {
        let Some(main) = self.files.first() else { return text.to_owned() };
        let Some(at) = main.text.find(SAVED) else { return text.to_owned() };
        let first = main.text[..at].matches('\n').count() + SAVED.matches('\n').count();
        let mut is_gone = false;
        let kept = text.split_inclusive('\n').enumerate().filter(|(number, line)| {
            let line = line.strip_prefix("#*# ").unwrap_or("");
            if *number >= first && line.starts_with('[') {
                is_gone = crate::parse::header(line.trim_end()).is_some_and(|name| sections.contains(&name));
            }
            *number < first || !is_gone
        });
        kept.map(|(_, line)| line).collect()
    }

    /// Adds the options of the SAVE_CONFIG block that the files do not set. klippy comments the others out.
    fn add_saved(&mut self, file: &Arc<Path>, before: usize, lines: &[&str]) -> Result<(), Trouble> {
        let mut section = String::new();
        let mut is_set = false;
        let mut kept = Vec::new();
        // The head of the block has three lines, after an empty one.
        for (number, text) in (before + 5..).zip(lines) {
            let pruned = text.find(['#', ';']).map_or(*text, |at| &text[..at]).trim_end();
            if let Some(first) = pruned.chars().next().filter(|first| !first.is_whitespace()) {
                is_set = false;
                if first == '[' {
                    section = pruned[1..].trim_end_matches(']').trim().to_owned();
                } else {
                    let word = |c: char| c.is_ascii_alphanumeric() || c == '_';
                    let key = pruned.split(|c| !word(c)).next().unwrap_or_default().to_lowercase();
                    is_set = self.section(&section).is_some_and(|section| section.setting(&key).is_some());
                }
            }
            kept.push(Line { number, text: if is_set { "" } else { uncommented(text) } });
        }
        self.add(file, &kept)
    }
}

/// The lines of a SAVE_CONFIG block without their mark; `None` if a line has none.
fn saved_lines(block: &str) -> Option<Vec<&str>> {
    let strip = |line: &'_ str| -> Option<usize> {
        (line.starts_with("#*#") && (line.len() < 4 || line.starts_with("#*# "))).then(|| line.len().min(4))
    };
    block.trim_end().lines().map(|line| strip(line).map(|mark| &line[mark..])).collect()
}

/// The remedy for a file that cannot be read.
fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::NotFound => "correct its name",
        io::ErrorKind::PermissionDenied => "let this user read it, or use sudo",
        _ => "name a readable printer.cfg",
    }
}

/// The text in the place of a missing file.
pub type StandIn = fn(&Path) -> &'static str;

struct Reader<'a> {
    files: &'a dyn Files,
    config: Config,
    /// The files that are being read: each includes the next one.
    within: Vec<PathBuf>,
    /// The text in the place of a missing file; `None` if the first one ends the reading.
    stand_in: Option<StandIn>,
    missing: Vec<Trouble>,
    opened: usize,
    bytes: usize,
    /// How many more names the patterns may look at.
    names_left: usize,
}

impl Reader<'_> {
    fn text(&mut self, path: &Path) -> Result<String, Trouble> {
        let refused = |cause: String, remedy: &str| Trouble::new(cause).of(path.display()).remedy(remedy);
        self.opened += 1;
        if self.opened > FILES_MAX {
            return Err(refused(format!("more than {FILES_MAX} files are included"), "include fewer"));
        }
        let text = self
            .files
            .text(path)
            .map_err(|error| refused(format!("Unable to open config file: {error}"), remedy(&error)))?;
        self.bytes += text.len();
        if self.bytes > BYTES_MAX {
            return Err(refused(format!("the files have more than {} MiB", BYTES_MAX >> 20), "include fewer"));
        }
        Ok(text.replace("\r\n", "\n").replace('\r', "\n"))
    }

    /// Reads a text and the files that it includes.
    fn include(&mut self, file: &Arc<Path>, text: &str) -> Result<(), Trouble> {
        let whole = self.files.whole(file);
        if self.within.contains(&whole) {
            let cause = format!("Recursive include of config file '{}'", file.display());
            return Err(Trouble::new(cause).remedy("remove the line"));
        }
        self.within.push(whole);
        let mut lines = Vec::new();
        for (number, text) in (1..).zip(text.split('\n')) {
            let Some(pattern) = included(text) else {
                lines.push(Line { number, text: uncommented(text) });
                continue;
            };
            self.config.add(file, &lines)?;
            lines.clear();
            let place = Place { file: file.clone(), line: number };
            self.matching(&place, pattern).map_err(|trouble| trouble.of(&place))?;
        }
        self.config.add(file, &lines)?;
        self.within.pop();
        Ok(())
    }

    /// Reads the files of an include.
    fn matching(&mut self, place: &Place, pattern: &str) -> Result<(), Trouble> {
        if self.config.includes.len() == INCLUDES_MAX {
            return Err(
                Trouble::new(format!("there are more than {INCLUDES_MAX} includes")).remedy("include fewer files")
            );
        }
        let pattern = place.file.parent().unwrap_or(Path::new("")).join(pattern);
        let found = matching(self.files, &pattern, &mut self.names_left).map_err(|error| {
            Trouble::new(format!("Include file '{}': {error}", pattern.display())).remedy("name fewer files")
        })?;
        let found = match self.stand_in {
            Some(_) if found.is_empty() && !is_pattern(&pattern.to_string_lossy()) => vec![pattern],
            None if found.is_empty() && !is_pattern(&pattern.to_string_lossy()) => return Err(missing(&pattern)),
            _ => found,
        };
        let found: Vec<Arc<Path>> = found.into_iter().map(Into::into).collect();
        self.config.includes.push(Include { place: place.clone(), found: found.clone() });
        for path in found {
            let text = match self.stand_in {
                // A link may lead nowhere.
                Some(stand_in) if !path.exists() => {
                    self.missing.push(missing(&path).of(place));
                    stand_in(&path).to_owned()
                }
                _ => self.text(&path)?,
            };
            if !self.config.files.iter().any(|file| file.path == path) {
                self.config.files.push(SourceFile { path: path.clone(), text: text.clone() });
            }
            self.include(&path, &text)?;
        }
        Ok(())
    }
}

/// An included file is not there.
fn missing(path: &Path) -> Trouble {
    let cause = format!("Include file '{}' does not exist", path.display());
    Trouble::new(cause).remedy("correct its name, or remove the line")
}
