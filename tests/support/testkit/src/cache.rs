// SPDX-License-Identifier: GPL-3.0-or-later
//! The folder for results that are expensive to make. Deleting it is always safe.

use std::env;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use nix::fcntl::{Flock, FlockArg};
use tempfile::TempDir;

use super::describe;

/// `$PINION_VM_CACHE`, or `vm` in cargo's target folder.
pub struct Cache {
    root: PathBuf,
}

impl Cache {
    /// Opens the cache, and creates its folder if necessary.
    pub fn open() -> Result<Cache, String> {
        let root = match env::var_os("PINION_VM_CACHE") {
            Some(folder) => PathBuf::from(folder),
            None => target()?.join("vm"),
        };
        let runs = root.join("runs");
        fs::create_dir_all(&runs).map_err(|error| format!("cannot create {}: {error}", runs.display()))?;
        // The kernel's makefiles run in another folder, so the path must be absolute.
        let root = root.canonicalize().map_err(|error| error.to_string())?;
        Ok(Cache { root })
    }

    /// The folder of the cache.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// A lock for making something, so that two runs do not make it at the same time.
    pub fn lock(&self) -> Result<Flock<File>, String> {
        let path = self.root.join("lock");
        let file = File::create(&path).map_err(|error| format!("cannot create {}: {error}", path.display()))?;
        Flock::lock(file, FlockArg::LockExclusive)
            .map_err(|(_, error)| format!("cannot lock {}: {error}", path.display()))
    }

    /// A folder for one VM's files. It is removed when it is dropped.
    pub fn run_folder(&self) -> Result<TempDir, String> {
        tempfile::tempdir_in(self.root.join("runs"))
            .map_err(|error| format!("cannot create a folder for the run: {error}"))
    }
}

/// The file or folder `prefix` with this key. If it is not there, `make` gets the path to make it at; the others with this
/// prefix, also what a run did not finish, are removed first. The caller has the cache's lock.
pub fn made(
    folder: &Path,
    prefix: &str,
    key: u64,
    make: impl FnOnce(&Path) -> Result<(), String>,
) -> Result<PathBuf, String> {
    let path = folder.join(format!("{prefix}{key:016x}"));
    if !path.exists() {
        remove_others(folder, prefix, &path)?;
        let partial = path.with_extension("partial");
        make(&partial)?;
        fs::rename(&partial, &path).map_err(|error| describe("rename", &partial, &error))?;
    }
    Ok(path)
}

/// Removes the files and folders of earlier versions.
pub(super) fn remove_others(folder: &Path, prefix: &str, keep: &Path) -> Result<(), String> {
    let entries = fs::read_dir(folder).map_err(|error| describe("read", folder, &error))?;
    for entry in entries {
        let entry = entry.map_err(|error| describe("read", folder, &error))?;
        if entry.path() != keep && entry.file_name().to_string_lossy().starts_with(prefix) {
            remove(&entry.path())?;
        }
    }
    Ok(())
}

/// Removes a file or a whole folder, if it exists.
pub fn remove(path: &Path) -> Result<(), String> {
    let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    match removed {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(describe("remove", path, &error)),
        _ => Ok(()),
    }
}

/// Cargo's target folder. The running harness is in `debug/deps` there.
fn target() -> Result<PathBuf, String> {
    let harness = env::current_exe().map_err(|error| format!("it is unknown which program this is: {error}"))?;
    let target = harness.ancestors().nth(3).map(Path::to_owned);
    target.ok_or_else(|| format!("{} is not in cargo's target folder: set PINION_VM_CACHE", harness.display()))
}
