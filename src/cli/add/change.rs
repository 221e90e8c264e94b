// SPDX-License-Identifier: GPL-3.0-or-later
//! Changes of files: planned, shown, made, recorded and taken back.
//!
//! A file is replaced as a whole, by a rename: a program that is killed leaves the old file or the new one. Files are
//! reached below the descriptor of their folder ([`OwnFolder`]), never through a link in their place. What is printer.cfg's
//! owner's is written with the rights of that user, so no file of anybody else can be behind it.
//!
//! A change is a splice: the text that it has replaced, and the new text. So it can be taken back after others have
//! changed the file elsewhere. The record of all splices of a device is written before the first of them is made.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};

use nix::unistd::geteuid;
use serde::{Deserialize, Serialize};

use super::rights::Rights;
use super::splice::Splice;
use crate::cli::computer::Computer;
use pinion_linux::foreign::{self, word};
use pinion_linux::own_folder::OwnFolder;

/// Longest file that is changed. A printer.cfg has some 100 kB at most.
const BYTES_MAX: u64 = 4 << 20;

/// A change of one file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Change {
    /// Its purpose. Several devices may need the same.
    pub(super) key: String,
    /// The file, as a path of the computer.
    pub(super) file: PathBuf,
    /// Whether the file is made.
    pub(super) makes: bool,
    pub(super) splice: Splice,
}

/// A device's changes, and the changes of others that it needs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) changes: Vec<Change>,
    /// The keys of all that it needs, also of earlier changes.
    pub(super) needs: Vec<String>,
}

impl Record {
    /// Adds the changes of a later call. One of the same key replaces that of an earlier call, which was not made.
    pub(super) fn extend(&mut self, later: Record) {
        self.changes
            .retain(|change| !later.changes.iter().any(|new| (&new.key, &new.file) == (&change.key, &change.file)));
        self.changes.extend(later.changes);
        self.needs.extend(later.needs);
        self.needs.sort();
        self.needs.dedup();
    }
}

/// A side of the computer where files are changed: root's, or that of printer.cfg's owner.
pub(super) struct Side<'a> {
    pub(super) computer: &'a Computer,
    /// User and group whose files these are. `None`: the caller's.
    pub(super) owner: Option<(u32, u32)>,
    /// The folder with the records.
    pub(super) records: PathBuf,
}

impl Side<'_> {
    /// The bytes of a file. `None` if there is none.
    ///
    /// # Errors
    ///
    /// One line: a link or another kind of file is in its place, it is no text, or it cannot be read.
    pub(super) fn read(&self, file: &Path) -> Result<Option<String>, String> {
        let _rights = Rights::of(self.owner).map_err(|error| failed(file, &error))?;
        match self.folder(file, false) {
            Ok((folder, name)) => read_in(&folder, &name).map_err(|error| failed(file, &error)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(failed(file, &error)),
        }
    }

    fn folder(&self, file: &Path, makes: bool) -> io::Result<(OwnFolder, String)> {
        let name = file.file_name().and_then(|name| name.to_str());
        let name = name.ok_or_else(|| io::Error::other("its name is not usable"))?;
        let folder = self.computer.path(file.parent().unwrap_or(Path::new("/")));
        let folder = if makes { OwnFolder::make(&folder)? } else { OwnFolder::open(&folder)? };
        Ok((folder, name.to_owned()))
    }

    /// Puts a text in a file's place. Its owner and mode stay.
    fn write(&self, file: &Path, text: &str) -> Result<(), String> {
        let write = || {
            let _rights = Rights::of(self.owner)?;
            let (folder, name) = self.folder(file, true)?;
            replace(&folder, &name, text.as_bytes())
        };
        write().map_err(|error: io::Error| failed(file, &error))
    }

    /// Fails if somebody has protected the file: a rename would replace it all the same.
    fn refuse_read_only(&self, file: &Path) -> Result<(), String> {
        let _rights = Rights::of(self.owner).map_err(|error| failed(file, &error))?;
        match fs::symlink_metadata(self.computer.path(file)) {
            Ok(about) if about.mode() & 0o200 == 0 => {
                let path = file.display();
                Err(format!("{path} is read-only: chmod u+w {}, then call this again", word(&path)))
            }
            _ => Ok(()),
        }
    }

    fn remove(&self, file: &Path) -> Result<(), String> {
        let remove = || {
            let _rights = Rights::of(self.owner)?;
            let (folder, name) = self.folder(file, false)?;
            fs::remove_file(folder.at(name))
        };
        remove().map_err(|error: io::Error| failed(file, &error))
    }

    /// Removes a folder that has become empty.
    fn tidy(&self, folder: &Path) {
        if let Ok(_rights) = Rights::of(self.owner)
            && let Ok((parent, name)) = self.folder(folder, false)
        {
            // It may hold other files, or be gone.
            let _ = fs::remove_dir(parent.at(name));
        }
    }

    fn record_of(&self, device: &str) -> PathBuf {
        self.records.join(format!(".add-{device}.json"))
    }

    /// The record of a device.
    ///
    /// # Errors
    ///
    /// One line: the record cannot be read.
    pub(super) fn record(&self, device: &str) -> Result<Option<Record>, String> {
        let file = self.record_of(device);
        let Some(text) = self.read(&file)? else { return Ok(None) };
        serde_json::from_str(&text)
            .map(Some)
            .map_err(|error| format!("{}: it is no record of pinion add: {error}: remove it", file.display()))
    }

    fn write_record(&self, device: &str, record: &Record) -> Result<(), String> {
        let text = serde_json::to_string_pretty(record).map_err(|error| error.to_string())?;
        self.write(&self.record_of(device), &(text + "\n"))
    }

    /// Makes the changes, and records them first. Each file that is changed is copied before, byte for byte.
    ///
    /// # Errors
    ///
    /// One line with the file and the cause. The changes made until then are recorded.
    pub(super) fn make(&self, device: &str, new: &Record) -> Result<(), String> {
        for file in files(&new.changes) {
            self.refuse_read_only(&file)?;
        }
        let old = self.record(device)?;
        let mut record = old.clone().unwrap_or_default();
        record.extend(new.clone());
        if old.as_ref() != Some(&record) {
            self.write_record(device, &record)?;
        }
        for file in files(&new.changes) {
            let own = new.changes.iter().filter(|change| change.file == file);
            let mut text = self.read(&file)?.unwrap_or_default();
            let before = text.clone();
            for Change { splice, .. } in own.clone() {
                if !text.get(splice.at..).is_some_and(|rest| rest.starts_with(&splice.old)) {
                    return Err(format!("{} has changed meanwhile: call pinion add again", file.display()));
                }
                splice.apply(&mut text);
            }
            let copy = copy_of(&file, device);
            if own.clone().all(|change| !change.makes) && self.read(&copy)?.is_none() {
                self.write(&copy, &before)?;
            }
            self.write(&file, &text)?;
        }
        Ok(())
    }

    /// Takes a device's changes back. A change that one of the `heirs`, other devices with the keys that they need, needs
    /// becomes that device's. A change whose key is in `in_use`, with its user, stays this device's. Returns a line for
    /// each thing that was left.
    ///
    /// # Errors
    ///
    /// One line with the file and the cause. Another call takes the others back.
    pub(super) fn undo(
        &self,
        device: &str,
        heirs: &[(&str, BTreeSet<String>)],
        in_use: &BTreeMap<String, String>,
    ) -> Result<Vec<String>, String> {
        let mut left = Vec::new();
        let Some(record) = self.record(device)? else { return Ok(left) };
        for file in files(&record.changes) {
            self.refuse_read_only(&file)?;
        }
        let all = files(&record.changes);
        let mut rest = record.changes;
        for (heir, needs) in heirs {
            let inherited: Vec<Change> = rest.extract_if(.., |change| needs.contains(&change.key)).collect();
            if !inherited.is_empty() {
                // The heir found them made, so its own changes are the later ones.
                let mut record = Record { changes: inherited, needs: Vec::new() };
                record.extend(self.record(heir)?.unwrap_or_default());
                self.write_record(heir, &record)?;
            }
        }
        let stays: Vec<Change> = rest.extract_if(.., |change| in_use.contains_key(&change.key)).collect();
        for Change { key, file, splice, .. } in &stays {
            let (file, user) = (file.display(), in_use.get(key).map_or("", String::as_str));
            let line = splice.new.trim().lines().next_back().unwrap_or_default();
            left.push(format!("{file} keeps \"{line}\": {user} needs it. Call this again when it does not"));
        }
        for file in all {
            let own: Vec<&Change> = rest.iter().filter(|change| change.file == file).collect();
            let before = left.len();
            self.undo_file(&file, &own, &mut left)?;
            if !stays.iter().any(|change| change.file == file) {
                self.drop_copy(&file, device, left.len() == before, &mut left)?;
            }
        }
        if stays.is_empty() {
            self.remove(&self.record_of(device))?;
            self.tidy(&self.records);
        } else {
            self.write_record(device, &Record { changes: stays, needs: record.needs })?;
        }
        Ok(left)
    }

    fn undo_file(&self, file: &Path, own: &[&Change], left: &mut Vec<String>) -> Result<(), String> {
        let shown = file.display();
        let Some(text) = self.read(file)? else { return Ok(()) };
        if let Some(made) = own.iter().find(|change| change.makes) {
            if text == made.splice.new {
                return self.remove(file);
            }
            left.push(format!("{shown} was changed since: remove it if you do not need it"));
            return Ok(());
        }
        let mut reverted = text.clone();
        for change in own.iter().rev() {
            if let Err(why) = change.splice.revert(&mut reverted) {
                left.push(format!("{shown}: {why}"));
            }
        }
        if reverted != text {
            self.write(file, &reverted)?;
        }
        Ok(())
    }

    /// Removes a device's copy of a file, if the device's changes there were found and taken back.
    fn drop_copy(&self, file: &Path, device: &str, is_clean: bool, left: &mut Vec<String>) -> Result<(), String> {
        let copy = copy_of(file, device);
        if self.read(&copy)?.is_none() {
            return Ok(());
        }
        if is_clean {
            return self.remove(&copy);
        }
        left.push(format!("{} is {} as it was before", copy.display(), file.display()));
        Ok(())
    }
}

/// The files of changes, each once, in order.
fn files(changes: &[Change]) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = Vec::new();
    for change in changes {
        if !files.contains(&change.file) {
            files.push(change.file.clone());
        }
    }
    files
}

/// Where a file is copied to before it is changed.
pub(super) fn copy_of(file: &Path, device: &str) -> PathBuf {
    let mut name = file.as_os_str().to_owned();
    name.push(format!(".before-add-{device}"));
    name.into()
}

fn read_in(folder: &OwnFolder, name: &str) -> io::Result<Option<String>> {
    let path = folder.at(name);
    match fs::symlink_metadata(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
        Ok(about) if about.is_symlink() => {
            return Err(io::Error::other("it is a link: name the file that it leads to"));
        }
        Ok(about) if about.len() > BYTES_MAX => return Err(io::ErrorKind::FileTooLarge.into()),
        Ok(_) => {}
    }
    let bytes = foreign::read(&path, BYTES_MAX)?;
    String::from_utf8(bytes).map(Some).map_err(|_| io::Error::other("it is not UTF-8: convert it first"))
}

/// Writes a file beside its place, then over it.
fn replace(folder: &OwnFolder, name: &str, bytes: &[u8]) -> io::Result<()> {
    let there = match fs::symlink_metadata(folder.at(name)) {
        Ok(about) if !about.is_file() => return Err(io::Error::other("it is no regular file")),
        Ok(about) => Some(about),
        Err(error) if error.kind() == io::ErrorKind::NotFound => None,
        Err(error) => return Err(error),
    };
    let fresh = format!(".{name}.pinion-add");
    let put = || -> io::Result<()> {
        let mut file = folder.create(&fresh)?;
        file.write_all(bytes)?;
        // A FAT file system has neither owners nor modes to set.
        let mode = there.as_ref().map_or(0o644, |about| about.mode() & 0o777);
        let _ = file.set_permissions(Permissions::from_mode(mode));
        if let Some(about) = &there {
            let _ = fchown(&file, Some(about.uid()), Some(about.gid()));
        }
        file.sync_all()?;
        fs::rename(folder.at(&fresh), folder.at(name))?;
        File::open(folder.at("."))?.sync_all()
    };
    put().inspect_err(|_| drop(fs::remove_file(folder.at(&fresh))))
}

fn failed(file: &Path, error: &io::Error) -> String {
    let remedy = match error.kind() {
        io::ErrorKind::PermissionDenied if !geteuid().is_root() => ": call it with sudo",
        io::ErrorKind::PermissionDenied => {
            ": its owner may not write there: see ls -ld and lsattr of the file and its folder"
        }
        io::ErrorKind::ReadOnlyFilesystem => ": make the file system writable, then call it again",
        io::ErrorKind::StorageFull => ": make room, then call it again",
        _ => "",
    };
    format!("{}: {error}{remedy}", file.display())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::computer::tests::Tree;
    use proptest::prelude::*;
    use std::os::unix::fs::symlink;

    fn splice(at: usize, old: &str, new: &str) -> Splice {
        Splice { at, old: old.into(), new: new.into(), word: None }
    }

    fn change(key: &str, file: &str, makes: bool, at: usize, old: &str, new: &str) -> Change {
        Change { key: key.into(), file: file.into(), makes, splice: splice(at, old, new) }
    }

    /// All files below a folder with their bytes and modes.
    fn snapshot(root: &Path) -> Vec<(PathBuf, Vec<u8>, u32)> {
        let mut found = Vec::new();
        let mut folders = vec![root.to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let about = fs::symlink_metadata(&path).unwrap();
                if about.is_dir() {
                    folders.push(path);
                } else {
                    found.push((path.clone(), fs::read(&path).unwrap_or_default(), about.mode()));
                }
            }
        }
        found.sort();
        found
    }

    fn side<'a>(computer: &'a Computer) -> Side<'a> {
        Side { computer, owner: None, records: "/home/pinion".into() }
    }

    #[test]
    fn a_change_that_another_device_needs_stays_until_nobody_does() {
        let tree = Tree::new();
        tree.put_mode("home/printer.cfg", "[mcu]\n", 0o640);
        let before = snapshot(&tree.computer().path("/"));
        let computer = tree.computer();
        let side = side(&computer);
        let shared = change("include", "/home/printer.cfg", false, 0, "", "[include pinion/*.cfg]\n");
        let own = |name: &str| change(name, &format!("/home/pinion/{name}.cfg"), true, 0, "", name);
        let needs = || vec!["include".to_owned()];
        side.make("a", &Record { changes: vec![own("a"), shared.clone()], needs: needs() }).unwrap();
        side.make("b", &Record { changes: vec![own("b")], needs: needs() }).unwrap();
        assert_eq!(side.read(Path::new("/home/printer.cfg")).unwrap().unwrap(), "[include pinion/*.cfg]\n[mcu]\n");
        let none = BTreeMap::new();
        side.undo("a", &[("b", needs().into_iter().collect())], &none).unwrap();
        assert!(side.read(Path::new("/home/printer.cfg")).unwrap().unwrap().starts_with("[include"), "b needs it");
        assert!(side.read(Path::new("/home/pinion/a.cfg")).unwrap().is_none());
        // A section of the user's needs it.
        let left = side.undo("b", &[], &[("include".into(), "[x]".into())].into()).unwrap();
        let keeps =
            "/home/printer.cfg keeps \"[include pinion/*.cfg]\": [x] needs it. Call this again when it does not";
        assert_eq!(left, [keeps]);
        assert!(side.read(Path::new("/home/pinion/b.cfg")).unwrap().is_none());
        assert_eq!(side.undo("b", &[], &none), Ok(vec![]));
        assert_eq!(snapshot(&computer.path("/")), before);
        assert!(!computer.path("/home/pinion").exists());
        assert_eq!(side.undo("b", &[], &none), Ok(vec![]), "a second time does nothing");
    }

    #[test]
    fn what_the_user_has_changed_meanwhile_stays() {
        let tree = Tree::new();
        tree.put("home/printer.cfg", "[mcu]\n");
        let computer = tree.computer();
        let side = side(&computer);
        let record = Record {
            changes: vec![
                change("a", "/home/pinion/a.cfg", true, 0, "", "[a]\n"),
                change("i", "/home/printer.cfg", false, 0, "", "[i]\n"),
            ],
            needs: vec![],
        };
        side.make("a", &record).unwrap();
        tree.put("home/printer.cfg", "# mine\n[i]\n[mcu]\n#*# saved\n");
        tree.put("home/pinion/a.cfg", "[a]\nmine: 1\n");
        let left = side.undo("a", &[], &BTreeMap::new()).unwrap();
        assert_eq!(left.len(), 1, "{left:?}");
        assert!(left[0].starts_with("/home/pinion/a.cfg was changed since"), "{left:?}");
        assert!(!computer.path("/home/printer.cfg.before-add-a").exists());
        assert_eq!(side.read(Path::new("/home/printer.cfg")).unwrap().unwrap(), "# mine\n[mcu]\n#*# saved\n");
        let ours = splice(3, "", "\nours\n");
        for (text, left) in [("a=b\nours\n", "a=b"), ("a=b\nours\ntheirs\n", "a=b\ntheirs\n")] {
            let mut text = text.to_owned();
            assert_eq!(ours.revert(&mut text), Ok(true));
            assert_eq!(text, left);
        }
        let splice = splice(9, "", "x=1\n");
        assert!(splice.revert(&mut "x=1\nx=1\n".into()).unwrap_err().contains("several times"));
        assert_eq!(splice.revert(&mut "yx=1\n".into()), Ok(false), "it is part of another line");
    }

    #[test]
    fn nothing_is_read_or_written_through_a_link() {
        let tree = Tree::new();
        tree.put("etc/shadow", "secret\n");
        tree.put("home/real.cfg", "x\n");
        tree.link("home/printer.cfg", "../etc/shadow");
        let computer = tree.computer();
        let side = side(&computer);
        let file = Path::new("/home/printer.cfg");
        assert!(side.read(file).unwrap_err().contains("it is a link: name the file"));
        assert!(side.write(file, "y").unwrap_err().contains("no regular file"));
        // A link in the place of the new file, or of the copy.
        symlink("../etc/shadow", computer.path("/home/.real.cfg.pinion-add")).unwrap();
        side.write(Path::new("/home/real.cfg"), "new\n").unwrap();
        symlink("../etc/shadow", computer.path("/home/real.cfg.before-add-a")).unwrap();
        let record = Record { changes: vec![change("k", "/home/real.cfg", false, 0, "new", "newer")], needs: vec![] };
        assert!(side.make("a", &record).unwrap_err().contains("it is a link"));
        assert_eq!(fs::read(computer.path("/etc/shadow")).unwrap(), b"secret\n");
        assert_eq!(fs::read(computer.path("/home/real.cfg")).unwrap(), b"new\n");
        // A pipe and a folder.
        nix::unistd::mkfifo(&computer.path("/home/pipe"), nix::sys::stat::Mode::S_IRWXU).unwrap();
        assert!(side.read(Path::new("/home/pipe")).is_err() && side.read(Path::new("/home")).is_err());
    }

    #[test]
    fn a_file_that_somebody_has_protected_stays() {
        let tree = Tree::new();
        tree.put_mode("home/printer.cfg", "[mcu]\n", 0o444);
        let computer = tree.computer();
        let before = snapshot(&computer.path("/"));
        let side = side(&computer);
        let changes = vec![
            change("a", "/home/pinion/a.cfg", true, 0, "", "[a]\n"),
            change("i", "/home/printer.cfg", false, 0, "", "[i]\n"),
        ];
        let record = Record { changes, needs: vec![] };
        let refusal = "/home/printer.cfg is read-only: chmod u+w /home/printer.cfg, then call this again";
        assert_eq!(side.make("a", &record).unwrap_err(), refusal);
        assert_eq!(snapshot(&computer.path("/")), before, "nothing is half done");
        let printer_cfg = computer.path("/home/printer.cfg");
        fs::set_permissions(&printer_cfg, Permissions::from_mode(0o644)).unwrap();
        side.make("a", &record).unwrap();
        fs::set_permissions(&printer_cfg, Permissions::from_mode(0o444)).unwrap();
        assert_eq!(side.undo("a", &[], &BTreeMap::new()).unwrap_err(), refusal);
        assert!(side.record("a").unwrap().is_some());
    }

    proptest! {
        #[test]
        fn whatever_is_made_can_be_taken_back(
            text in "(\\PC|\n|\r\n){0,40}", new in "[a-z]{1,5}\n", at in 0usize..40, files in 1usize..3
        ) {
            let tree = Tree::new();
            let names: Vec<String> = (0..files).map(|number| format!("home/file{number}")).collect();
            names.iter().for_each(|name| tree.put(name, &text));
            let before = snapshot(&tree.computer().path("/"));
            let at = (0..=at.min(text.len())).rev().find(|at| text.is_char_boundary(*at)).unwrap_or(0);
            let changes = names.iter().map(|name| change("k", &format!("/{name}"), false, at, "", &new));
            let made = change("m", "/home/pinion/made", true, 0, "", &new);
            let record = Record { changes: changes.chain([made]).collect(), needs: vec![] };
            let computer = tree.computer();
            let side = side(&computer);
            side.make("a", &record).unwrap();
            prop_assert_eq!(side.undo("a", &[], &BTreeMap::new()).unwrap(), Vec::<String>::new());
            prop_assert_eq!(snapshot(&computer.path("/")), before);
        }
    }
}
