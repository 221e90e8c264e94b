// SPDX-License-Identifier: GPL-3.0-or-later
//! The programs under test, as an archive in the memory of a VM's PCI device (QEMU's ivshmem). So they come into a VM that
//! has booted, with the same instructions on every computer, and another program needs no other boot.

use std::fs::{self, File};
use std::hash::{DefaultHasher, Hasher};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use super::guest_program::GuestProgram;
use pinion_testkit::cache::{self, Cache};

/// A power of two, as any memory of a PCI device. It is the same in every VM of a snapshot.
const SIZE: u64 = 128 << 20;

pub struct Programs(Vec<u8>);

impl Programs {
    /// Makes the archive, unless the cache has it. The caller has the cache's lock.
    pub fn prepare(program: &GuestProgram<'_>, cache: &Cache) -> Result<Programs, String> {
        let mut hasher = DefaultHasher::new();
        program.hash_programs(&mut hasher)?;
        let path = cache::made(cache.root(), "programs-", hasher.finish(), |path| {
            fs::write(path, program.programs()?).map_err(|error| format!("cannot write {}: {error}", path.display()))
        })?;
        let archive = fs::read(&path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
        match archive.len() as u64 {
            size if size > SIZE => Err(format!("the programs have {size} bytes, and the VM's device has {SIZE}")),
            _ => Ok(Programs(archive)),
        }
    }

    /// Puts them into the memory of the VM of this folder. It is empty in a snapshot, which a VM reads first.
    pub fn put_into(&self, folder: &Path) -> Result<(), String> {
        let path = memory(folder);
        let write = || File::options().write(true).open(&path)?.write_all_at(&self.0, 0);
        write().map_err(|error| format!("cannot write {}: {error}", path.display()))
    }
}

/// The emulator's options for the device of a VM, whose memory is still empty.
pub fn device(folder: &Path) -> Result<[String; 4], String> {
    let path = memory(folder);
    let make = || File::create(&path)?.set_len(SIZE);
    make().map_err(|error| format!("cannot make {}: {error}", path.display()))?;
    // The emulator reads a doubled comma as one.
    let path = path.display().to_string().replace(',', ",,");
    let memory = format!("memory-backend-file,id=programs,share=on,size={SIZE},mem-path={path}");
    // Without `master` the emulator makes no snapshot.
    Ok(["-object".into(), memory, "-device".into(), "ivshmem-plain,memdev=programs,master=on".into()])
}

fn memory(folder: &Path) -> PathBuf {
    folder.join("programs")
}
