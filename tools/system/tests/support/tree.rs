// SPDX-License-Identifier: GPL-3.0-or-later
//! For tests: a computer that a test has made of files.

use std::fs;
use std::io;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Duration;

use tempfile::TempDir;

// Of the library, or of its unit tests.
use super::Computer;

/// A computer that a test has made of files.
pub struct Tree(TempDir);

impl Tree {
    /// A computer without any files.
    pub fn empty() -> Tree {
        Tree(tempfile::tempdir().unwrap())
    }

    /// The computer, for a program that nobody has called.
    pub fn computer(&self) -> Computer {
        Computer::below(self.0.path(), None)
    }

    /// The same for a program that this user has called.
    pub fn called_by(&self, uid: u32) -> Computer {
        Computer::below(self.0.path(), Some(uid))
    }

    /// Writes a file, and makes its folders.
    pub fn put(&self, path: &str, content: impl AsRef<[u8]>) {
        let path = self.0.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    /// Sets a file's permission bits.
    pub fn mode(&self, path: &str, mode: u32) {
        fs::set_permissions(self.0.path().join(path), fs::Permissions::from_mode(mode)).unwrap();
    }

    /// Writes a file with these permission bits.
    pub fn put_mode(&self, path: &str, text: &str, mode: u32) {
        self.put(path, text);
        self.mode(path, mode);
    }

    /// A program made from this script.
    pub fn program(&self, path: &str, script: &str) -> PathBuf {
        self.put_mode(path, script, 0o755);
        let path = self.0.path().join(path);
        // A process that another test forked meanwhile may have it open for writing, until it becomes another
        // program.
        loop {
            match Command::new(&path).stdout(Stdio::null()).spawn() {
                Err(error) if error.kind() == io::ErrorKind::ExecutableFileBusy => {
                    std::thread::sleep(Duration::from_millis(1))
                }
                Ok(mut child) => {
                    let _ = child.kill();
                    let _ = child.wait();
                    return path;
                }
                Err(_) => return path,
            }
        }
    }

    /// Makes a symbolic link, and its folders.
    pub fn link(&self, path: &str, target: &str) {
        let path = self.0.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        symlink(target, path).unwrap();
    }

    /// A process of a user with these further groups.
    pub fn process(&self, pid: u32, arguments: &[&str], uid: u32, gids: &[u32]) {
        let gids: Vec<String> = gids.iter().map(u32::to_string).collect();
        self.put(&format!("proc/{pid}/cmdline"), &(arguments.join("\0") + "\0"));
        self.put(&format!("proc/{pid}/stat"), format!("{pid} (x) S {} 0", ["1"; 20].join(" ")));
        let ids = [uid; 4].map(|uid| uid.to_string()).join("\t");
        let status = format!("Name:\tx\nUid:\t{ids}\nGid:\t{ids}\nGroups:\t{}\n", gids.join(" "));
        self.put(&format!("proc/{pid}/status"), &status);
        self.put(&format!("proc/{pid}/exe"), "");
    }
}
