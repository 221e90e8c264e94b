// SPDX-License-Identifier: GPL-3.0-or-later
//! A G-code file, and the lines at its offsets.

use std::path::{Path, PathBuf};

use pinion::cli::files;
use pinion_printer_config::Trouble;

/// Longest file.
const MIB_MAX: u64 = 1024;
/// Longest part of a line that is shown.
const SHOWN_MAX: usize = 60;

/// A file to print.
pub(super) struct GcodeFile {
    pub(super) path: PathBuf,
    pub(super) bytes: Vec<u8>,
    /// The offset of each line.
    starts: Vec<usize>,
}

impl GcodeFile {
    /// Reads a file.
    ///
    /// # Errors
    ///
    /// It cannot be read, or is too long.
    pub(super) fn read(path: &Path) -> Result<GcodeFile, Trouble> {
        let bytes = files::read(path, MIB_MAX).map_err(|error| Trouble::new(error.to_string()).of(path.display()))?;
        let ends = bytes.iter().enumerate().filter(|(_, byte)| **byte == b'\n').map(|(at, _)| at + 1);
        let starts = std::iter::once(0).chain(ends).filter(|start| *start < bytes.len()).collect();
        Ok(GcodeFile { path: path.to_owned(), bytes, starts })
    }

    /// The name without its folder.
    pub(super) fn name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// The number of the line at an offset, from 1 on.
    pub(super) fn line_at(&self, offset: u64) -> usize {
        self.starts.partition_point(|start| *start as u64 <= offset).max(1)
    }

    /// The text of a line, as far as it is shown.
    pub(super) fn text(&self, line: usize) -> String {
        let from = self.starts.get(line - 1).copied().unwrap_or(self.bytes.len());
        let rest = &self.bytes[from..];
        let line = &rest[..rest.iter().position(|byte| *byte == b'\n').unwrap_or(rest.len()).min(SHOWN_MAX)];
        String::from_utf8_lossy(line).trim().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_offset_has_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gcode");
        std::fs::write(&path, "G28\r\n\nG1 X1 ; first\nM400").unwrap();
        let file = GcodeFile::read(&path).unwrap();
        let lines: Vec<usize> = [0, 4, 5, 6, 19, 20, 24, 99].map(|offset| file.line_at(offset)).into();
        assert_eq!(lines, [1, 1, 2, 3, 3, 4, 4, 4]);
        assert_eq!([1, 2, 3, 4, 5].map(|line| file.text(line)), ["G28", "", "G1 X1 ; first", "M400", ""]);
        assert_eq!(file.name(), "a.gcode");
    }
}
