// SPDX-License-Identifier: GPL-3.0-or-later
//! The files that a command line names: to read, and to write.
//!
//! The files may come from anybody. Only regular files are opened, so no FIFO blocks and no device notices. An output
//! replaces the file at its place when it is whole: a command that fails leaves the old file, or none.

#![forbid(unsafe_code)]

use std::fmt::Display;
use std::fs::{self, File, Metadata, OpenOptions, Permissions};
use std::io::{self, BufWriter, Read};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use nix::fcntl::OFlag;
use nix::unistd::{AccessFlags, access};

use pinion_linux::foreign;

const MIB: u64 = 1 << 20;
/// How many names of a new file are tried.
const TRIES: u32 = 100;

/// Opens a regular file of at most this size to read it.
///
/// # Errors
///
/// The errors of [`foreign::open`]. [`io::ErrorKind::FileTooLarge`]: it is longer.
pub fn open(path: &Path, mib_max: u64) -> io::Result<impl Read> {
    let (file, about) = foreign::open(path)?;
    if about.len() > mib_max * MIB {
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, format!("it is longer than {mib_max} MiB")));
    }
    // It may grow from now on, and files in /proc have no length.
    Ok(file.take(mib_max * MIB))
}

/// Reads a regular file of at most this size.
///
/// # Errors
///
/// The errors of [`open`] and of reading.
pub fn read(path: &Path, mib_max: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path, mib_max)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// A file to write. There is none until it is written.
pub struct Output {
    /// As the command line names it.
    path: PathBuf,
    /// The same, without symbolic links.
    place: PathBuf,
}

impl Output {
    /// Checks that the file can be written, so that no long work is lost at its end. `inputs` are the files that the
    /// command reads: it must not replace them.
    ///
    /// # Errors
    ///
    /// One line with the file, the cause and the remedy.
    pub fn check(path: &Path, inputs: &[&Path]) -> Result<Output, String> {
        let (place, there) = Output::find(path).map_err(|error| unwritable(path, &error))?;
        let is_there = |input: &&&Path| match (&there, fs::metadata(input)) {
            (Some(there), Ok(input)) => (there.dev(), there.ino()) == (input.dev(), input.ino()),
            _ => false,
        };
        if let Some(input) = inputs.iter().find(is_there) {
            let input = input.display();
            return Err(format!("{} is the same file as {input}, which is read: name another file", path.display()));
        }
        Ok(Output { path: path.to_owned(), place })
    }

    /// The place of the file, and what is there.
    fn find(path: &Path) -> io::Result<(PathBuf, Option<Metadata>)> {
        let (place, there) = match fs::metadata(path) {
            Ok(there) if !there.is_file() => return Err(io::Error::other("it is no regular file")),
            Ok(there) => (fs::canonicalize(path)?, Some(there)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => (path.to_owned(), None),
            Err(error) => return Err(error),
        };
        access(folder(&place), AccessFlags::W_OK | AccessFlags::X_OK)?;
        Ok((place, there))
    }

    /// Writes the file: beside its place, then over it. If it cannot replace what is there, it stays beside it.
    ///
    /// # Errors
    ///
    /// One line with the file, the cause and the remedy.
    pub fn write<T>(&self, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<T>) -> Result<T, String> {
        let failed = |error: io::Error| unwritable(&self.path, &error);
        let (fresh, file) = beside(&self.place).map_err(failed)?;
        let put = || {
            let mut out = BufWriter::new(file);
            let written = write(&mut out)?;
            let file = out.into_inner()?;
            if let Ok(there) = fs::metadata(&self.place) {
                file.set_permissions(Permissions::from_mode(there.mode() & 0o777))?;
            }
            Ok(written)
        };
        let written = put().inspect_err(|_| drop(fs::remove_file(&fresh))).map_err(failed)?;
        fs::rename(&fresh, &self.place).map_err(|error| {
            let (place, fresh) = (self.path.display(), fresh.display());
            format!("{place} cannot be replaced: {error}: take what is in {fresh}")
        })?;
        Ok(written)
    }

    /// Makes the file now, empty, for what comes bit by bit.
    ///
    /// # Errors
    ///
    /// One line with the file, the cause and the remedy.
    pub fn make(&self) -> Result<File, String> {
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).custom_flags(OFlag::O_NONBLOCK.bits());
        options.open(&self.place).map_err(|error| unwritable(&self.path, &error))
    }

    /// The file, as the command line names it.
    pub fn path(&self) -> impl Display {
        self.path.display()
    }
}

/// A new file in the same folder. A program that was killed may have left some.
fn beside(place: &Path) -> io::Result<(PathBuf, File)> {
    let mut tries = 0;
    loop {
        let fresh = folder(place).join(format!(".pinion.{}.{tries}", std::process::id()));
        match OpenOptions::new().write(true).create_new(true).open(&fresh) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && tries < TRIES => tries += 1,
            opened => return opened.map(|file| (fresh, file)),
        }
    }
}

/// The folder of a file.
fn folder(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn unwritable(path: &Path, error: &io::Error) -> String {
    format!("{} cannot be written: {error}: name a file in a folder of yours", path.display())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::os::unix::fs::symlink;

    #[test]
    fn an_output_replaces_the_file_only_when_it_is_whole() {
        let folder = tempfile::tempdir().unwrap();
        let [path, link] = ["a", "link"].map(|name| folder.path().join(name));
        let names = || fs::read_dir(folder.path()).unwrap().count();
        let new = Output::check(&path, &[]).unwrap();
        assert_eq!(names(), 0, "a check makes no file");
        new.write(|out| out.write_all(b"old")).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o640)).unwrap();
        symlink("a", &link).unwrap();
        let output = Output::check(&link, &[]).unwrap();
        let failed = output.write(|out| out.write_all(b"half").and(Err::<(), _>(io::ErrorKind::StorageFull.into())));
        assert!(failed.unwrap_err().starts_with(&format!("{} cannot be written: ", link.display())));
        assert_eq!((fs::read(&path).unwrap(), names()), (b"old".to_vec(), 2));
        output.write(|out| out.write_all(b"new")).unwrap();
        assert_eq!((fs::read(&path).unwrap(), names()), (b"new".to_vec(), 2));
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
    }

    #[test]
    fn an_input_is_no_output_under_any_name() {
        let folder = tempfile::tempdir().unwrap();
        let [path, hard, soft] = ["a", "hard", "soft"].map(|name| folder.path().join(name));
        fs::write(&path, "old").unwrap();
        fs::hard_link(&path, &hard).unwrap();
        symlink("./a", &soft).unwrap();
        for name in [&path, &hard, &soft, &folder.path().join("./a")] {
            let error = Output::check(name, &[Path::new("/nonexistent"), &path]).map(drop).unwrap_err();
            assert!(error.contains(" is the same file as "), "{error}");
        }
        assert!(Output::check(&folder.path().join("b"), &[&path]).is_ok());
    }

    #[test]
    fn only_regular_files_of_some_length_are_used() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        File::create(&path).unwrap().set_len(2 * MIB).unwrap();
        assert_eq!(read(&path, 2).unwrap().len() as u64, 2 * MIB);
        assert_eq!(read(&path, 1).unwrap_err().to_string(), "it is longer than 1 MiB");
        assert_eq!(read(Path::new("/dev/zero"), 1).unwrap_err().to_string(), "it is no regular file");
        for path in ["/dev/null", "/nonexistent/a", "/"] {
            let error = Output::check(Path::new(path), &[]).map(drop).unwrap_err();
            assert!(error.starts_with(&format!("{path} cannot be written: ")), "{error}");
        }
    }
}
