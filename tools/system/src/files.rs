// SPDX-License-Identifier: GPL-3.0-or-later
//! The files that a command line names: to read, and to write.
//!
//! The files may come from anybody. Only regular files are opened, so no FIFO blocks and no device notices. An output
//! replaces the file at its place when it is whole: a command that fails, or is killed, leaves the old file, or none. A link
//! of another user leads no output anywhere: root's command would change that user's choice of files.

use std::ffi::{OsStr, OsString};
use std::fmt::Display;
use std::fs::{self, File, Metadata, OpenOptions, Permissions};
use std::io::{self, BufWriter, Read};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};

use nix::unistd::{AccessFlags, access, geteuid};

use pinion_linux::foreign;
use pinion_linux::own_folder::{PathEnd, below, end_of_path};
use pinion_printer_config::{NAMES_MAX, names_in};

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
///
/// The file is reached below the descriptor of its folder. Otherwise a user who may rename files on the way to it, as
/// every user may in /tmp, could make another user replace a file elsewhere.
pub struct Output {
    /// As the command line names it.
    path: PathBuf,
    folder: OwnedFd,
    name: OsString,
    /// Our own file that it replaces.
    old: Option<Metadata>,
}

impl Output {
    /// Checks that the file can be written, so that no long work is lost at its end. `inputs` are the files that the
    /// command reads: it must not replace them.
    ///
    /// # Errors
    ///
    /// One line with the file, the cause and the remedy.
    pub fn check(path: &Path, inputs: &[&Path]) -> Result<Output, String> {
        let (output, there) = Output::find(path).map_err(|error| unwritable(path, &error))?;
        let is_there = |input: &&&Path| match (&there, fs::metadata(input)) {
            (Some(there), Ok(input)) => (there.dev(), there.ino()) == (input.dev(), input.ino()),
            _ => false,
        };
        if let Some(input) = inputs.iter().find(is_there) {
            let input = input.display();
            return Err(format!("{} is the same file as {input}, which is read: name another file", path.display()));
        }
        Ok(output)
    }

    /// The file without the symbolic links that lead to it, and what is there.
    fn find(path: &Path) -> io::Result<(Output, Option<Metadata>)> {
        let PathEnd { folder, name, there } = end_of_path(path)?;
        let there = there.map(|there| File::from(there).metadata()).transpose()?;
        if there.as_ref().is_some_and(|there| !there.is_file()) {
            return Err(io::Error::other("it is not a regular file"));
        }
        // Another user's file is replaced by ours. Its permissions are that user's choice.
        let old = there.clone().filter(|there| there.uid() == geteuid().as_raw());
        let output = Output { path: path.to_owned(), folder, name, old };
        access(&below(&output.folder), AccessFlags::W_OK | AccessFlags::X_OK)?;
        Ok((output, there))
    }

    /// Writes the file: beside its place, then over it. If it cannot replace what is there, it stays beside it.
    ///
    /// # Errors
    ///
    /// One line with the file, the cause and the remedy.
    pub fn write<T>(&self, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<T>) -> Result<T, String> {
        replace(&below(&self.folder), &self.name, self.old.as_ref(), write).map_err(|unwritten| match unwritten {
            Unwritten::Failed(error) => unwritable(&self.path, &error),
            Unwritten::Beside(name, error) => {
                format!("{} cannot be replaced: {error}: take what is in {name} beside it", self.path.display())
            }
        })
    }

    /// Makes the file now, empty, for what comes bit by bit.
    ///
    /// # Errors
    ///
    /// One line with the file, the cause and the remedy.
    pub fn make(&self) -> Result<File, String> {
        let folder = below(&self.folder);
        let made = beside(&folder, &self.name, None).and_then(|(name, file)| {
            let renamed = fs::rename(folder.join(&name), folder.join(&self.name));
            renamed.inspect_err(|_| drop(fs::remove_file(folder.join(&name)))).map(|()| file)
        });
        made.map_err(|error| unwritable(&self.path, &error))
    }

    /// The file, as the command line names it.
    pub fn path(&self) -> impl Display {
        self.path.display()
    }
}

/// Why a file was not replaced.
pub enum Unwritten {
    /// It is as it was.
    Failed(io::Error),
    /// The new contents are in this file beside it.
    Beside(String, io::Error),
}

/// Writes a file beside its place in a folder, then over it. The owner, the group and the permissions of `old` stay.
pub fn replace<T>(
    folder: &Path,
    name: &OsStr,
    old: Option<&Metadata>,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<T>,
) -> Result<T, Unwritten> {
    let (fresh, file) = beside(folder, name, old).map_err(Unwritten::Failed)?;
    let put = || {
        let mut out = BufWriter::new(file);
        let written = write(&mut out)?;
        let file = out.into_inner()?;
        if let Some(old) = old {
            // A FAT file system has neither owners nor modes to set.
            let _ = fchown(&file, Some(old.uid()), Some(old.gid()));
            let _ = file.set_permissions(Permissions::from_mode(old.mode() & 0o777));
        }
        file.sync_all()?;
        Ok(written)
    };
    let written = put().inspect_err(|_| drop(fs::remove_file(folder.join(&fresh)))).map_err(Unwritten::Failed)?;
    if let Err(error) = fs::rename(folder.join(&fresh), folder.join(name)) {
        return Err(Unwritten::Beside(fresh, error));
    }
    // The file is written, whether or not the name outlasts a loss of power.
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
    Ok(written)
}

/// The beginning of the names of new files beside a file.
fn fresh(name: &OsStr) -> String {
    format!(".{}.pinion.", name.to_string_lossy())
}

/// A new file beside another one, with its name. Nobody else may read it before it has the permissions of `old`.
pub fn beside(folder: &Path, name: &OsStr, old: Option<&Metadata>) -> io::Result<(String, File)> {
    let mode = if old.is_some() { 0o600 } else { 0o666 };
    let mut tries = 0;
    loop {
        let name = format!("{}{}.{tries}", fresh(name), std::process::id());
        match OpenOptions::new().write(true).create_new(true).mode(mode).open(folder.join(&name)) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && tries < TRIES => tries += 1,
            opened => return opened.map(|file| (name, file)),
        }
    }
}

/// Removes the new files that killed programs have left beside a file.
pub fn sweep(folder: &Path, name: &OsStr) {
    let beginning = fresh(name);
    for name in names_in(folder, NAMES_MAX).iter().filter(|name| name.starts_with(&beginning)) {
        // As a rule there is none.
        let _ = fs::remove_file(folder.join(name));
    }
}

fn unwritable(path: &Path, error: &io::Error) -> String {
    format!("{} cannot be written: {error}: name a file in a folder of yours", path.display())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::os::unix::fs::{lchown, symlink};

    use nix::unistd::User;
    use pinion_testkit::here;

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

    /// Another user may do this in /tmp, and in a folder of their own, between the check and the write.
    #[test]
    fn a_file_that_was_checked_stays_where_it_was() {
        let root = tempfile::tempdir().unwrap();
        let [folder, moved, victim] = ["folder", "moved", "victim"].map(|name| root.path().join(name));
        fs::create_dir(&folder).unwrap();
        fs::create_dir(&victim).unwrap();
        let path = folder.join("a");
        let kept = victim.join("a");
        for file in [&path, &kept] {
            fs::write(file, "old").unwrap();
        }
        let output = Output::check(&path, &[]).unwrap();
        // A link in the file's place.
        fs::remove_file(&path).unwrap();
        symlink(&kept, &path).unwrap();
        output.make().unwrap().write_all(b"made").unwrap();
        assert_eq!((fs::read(&kept).unwrap(), fs::read(&path).unwrap()), (b"old".to_vec(), b"made".to_vec()));
        // A link in the folder's place.
        fs::rename(&folder, &moved).unwrap();
        symlink(&victim, &folder).unwrap();
        output.write(|out| out.write_all(b"new")).unwrap();
        assert_eq!((fs::read(&kept).unwrap(), fs::read(moved.join("a")).unwrap()), (b"old".to_vec(), b"new".to_vec()));
    }

    /// Root's command in a user's folder, where that user has put links and hard links.
    #[test]
    fn a_link_of_another_user_leads_no_output_anywhere() {
        if !geteuid().is_root() {
            return here::not_run("only root can make links for another user");
        }
        const MALLORY: u32 = 65_534;
        let root = tempfile::tempdir().unwrap();
        let [secret, folder] = ["secret", "folder"].map(|name| root.path().join(name));
        fs::write(&secret, "root's").unwrap();
        fs::create_dir(&folder).unwrap();
        let own = |path: &Path| lchown(path, Some(MALLORY), Some(MALLORY)).unwrap();
        own(&folder);
        let links = ["file", "folder"].map(|name| folder.join(name));
        symlink(&secret, &links[0]).unwrap();
        symlink(root.path(), &links[1]).unwrap();
        links.iter().for_each(|link| own(link));
        let name = User::from_uid(MALLORY.into()).unwrap().map_or_else(|| MALLORY.to_string(), |user| user.name);
        for path in [links[0].clone(), links[1].join("secret"), links[1].join("new")] {
            let error = Output::check(&path, &[]).map(drop).unwrap_err();
            let expected = format!("cannot be written: a link on the way to it belongs to another user, {name}: ");
            assert!(error.contains(&expected), "{error}");
        }
        // A hard link is replaced, and gives its permissions to nobody.
        let hard = folder.join("hard");
        fs::hard_link(&secret, &hard).unwrap();
        Output::check(&hard, &[]).unwrap().make().unwrap().write_all(b"new").unwrap();
        let users = folder.join("users");
        fs::write(&users, "").unwrap();
        own(&users);
        fs::set_permissions(&users, Permissions::from_mode(0o666)).unwrap();
        Output::check(&users, &[]).unwrap().write(|out| out.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&secret).unwrap(), b"root's");
        assert_eq!(fs::metadata(&users).unwrap().permissions().mode() & 0o022, 0);
        // Links of our own are followed.
        let link = root.path().join("link");
        symlink(&secret, &link).unwrap();
        Output::check(&link, &[]).unwrap().write(|out| out.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&secret).unwrap(), b"new");
    }

    #[test]
    fn only_regular_files_of_some_length_are_used() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        File::create(&path).unwrap().set_len(2 * MIB).unwrap();
        assert_eq!(read(&path, 2).unwrap().len() as u64, 2 * MIB);
        assert_eq!(read(&path, 1).unwrap_err().to_string(), "it is longer than 1 MiB");
        assert_eq!(read(Path::new("/dev/zero"), 1).unwrap_err().to_string(), "it is not a regular file");
        for path in ["/dev/null", "/nonexistent/a", "/"] {
            let error = Output::check(Path::new(path), &[]).map(drop).unwrap_err();
            assert!(error.starts_with(&format!("{path} cannot be written: ")), "{error}");
        }
    }
}
