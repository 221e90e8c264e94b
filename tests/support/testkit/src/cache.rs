// SPDX-License-Identifier: GPL-3.0-or-later
//! The folder for results that are expensive to make. Deleting it is always safe.

use std::env;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use nix::fcntl::{Flock, FlockArg};
use tempfile::TempDir;

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

/// Cargo's target folder. The running harness is in `debug/deps` there.
fn target() -> Result<PathBuf, String> {
    let harness = env::current_exe().map_err(|error| format!("it is unknown which program this is: {error}"))?;
    let target = harness.ancestors().nth(3).map(Path::to_owned);
    target.ok_or_else(|| format!("{} is not in cargo's target folder: set PINION_VM_CACHE", harness.display()))
}
