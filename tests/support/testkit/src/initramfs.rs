// SPDX-License-Identifier: GPL-3.0-or-later
//! The archive for the guest's root folder, in cpio's "newc" form. It is not compressed, because a guest unpacks
//! slowly. Linux accepts several archives in a row.

use std::collections::HashSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// This file. Its archives are made again when it changes.
pub const SOURCE: &str = include_str!("initramfs.rs");

const FOLDER: u32 = 0o040_755;
const PROGRAM: u32 = 0o100_755;
const FILE: u32 = 0o100_644;
const SYMLINK: u32 = 0o120_777;

/// An archive that is being written. Paths are absolute in the guest. Their parent folders are made automatically.
#[derive(Default)]
pub struct Archive {
    bytes: Vec<u8>,
    paths: HashSet<String>,
}

impl Archive {
    /// The common content of every VM: folders, busybox, and the first part of init.
    pub fn with_busybox(busybox: &Path) -> Result<Archive, String> {
        let mut archive = Archive::default();
        for folder in ["/dev", "/proc", "/sys", "/tmp", "/run", "/root", "/etc"] {
            archive.folder(folder);
        }
        archive.copy("/bin/busybox", busybox)?;
        archive.symlink("/bin/sh", "busybox");
        archive.file("/tests/start.sh", include_bytes!("start.sh"));
        Ok(archive)
    }

    /// Adds a folder.
    pub fn folder(&mut self, path: &str) {
        self.add(path, FOLDER, b"");
    }

    /// Adds a file that everybody may read.
    pub fn file(&mut self, path: &str, content: &[u8]) {
        self.add(path, FILE, content);
    }

    /// Adds a file that everybody may run.
    pub fn program(&mut self, path: &str, content: &[u8]) {
        self.add(path, PROGRAM, content);
    }

    /// Adds a symbolic link.
    pub fn symlink(&mut self, path: &str, target: &str) {
        self.add(path, SYMLINK, target.as_bytes());
    }

    /// A file of the computer, executable if it is executable there.
    pub fn copy(&mut self, path: &str, from: &Path) -> Result<(), String> {
        let describe = |error| format!("cannot read {}: {error}", from.display());
        let mode = fs::metadata(from).map_err(describe)?.permissions().mode();
        let content = fs::read(from).map_err(describe)?;
        self.add(path, if mode & 0o111 == 0 { FILE } else { PROGRAM }, &content);
        Ok(())
    }

    /// The complete archive.
    pub fn finish(mut self) -> Vec<u8> {
        self.append("TRAILER!!!", 0, b"");
        self.bytes
    }

    fn add(&mut self, path: &str, mode: u32, content: &[u8]) {
        let path = path.trim_start_matches('/');
        if path.is_empty() || !self.paths.insert(path.to_owned()) {
            return;
        }
        if let Some((parent, _)) = path.rsplit_once('/') {
            self.add(parent, FOLDER, b"");
        }
        self.append(path, mode, content);
    }

    fn append(&mut self, path: &str, mode: u32, content: &[u8]) {
        let inode = self.paths.len();
        let size = content.len();
        let name_size = path.len() + 1;
        // Magic, inode, mode, owner, group, links, time, size, major and minor numbers of the device and of the special
        // file, size of the name, checksum.
        let header = format!(
            "070701{inode:08x}{mode:08x}{0:08x}{0:08x}{1:08x}{0:08x}{size:08x}\
             {0:08x}{0:08x}{0:08x}{0:08x}{name_size:08x}{0:08x}",
            0, 1
        );
        self.bytes.extend_from_slice(header.as_bytes());
        self.bytes.extend_from_slice(path.as_bytes());
        self.bytes.push(0);
        self.align();
        self.bytes.extend_from_slice(content);
        self.align();
    }

    fn align(&mut self) {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
    }
}
