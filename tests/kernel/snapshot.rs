// SPDX-License-Identifier: GPL-3.0-or-later
//! A file with a VM that has booted and loaded its modules. Tests continue from there. An emulated boot takes longer
//! than a dozen tests. The programs under test come later (`programs.rs`).

use std::fs::File;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::os::fd::AsRawFd;
use std::path::Path;
use std::process::Command;

use serde_json::json;

use super::emulator::Emulator;
use super::guest_program::GuestProgram;
use super::vm;
use pinion_testkit::cache::{self, Cache};
use pinion_testkit::kernel::Kernel;
use pinion_testkit::process;

pub struct Snapshot(File);

impl Snapshot {
    /// Boots the kernel, unless the snapshot exists. The caller has the cache's lock.
    pub fn prepare(kernel: &Kernel, program: &GuestProgram<'_>, cache: &Cache) -> Result<Snapshot, String> {
        let path = cache::made(kernel.folder(), "booted-", key(kernel, program)?, |path| {
            eprintln!("booting Linux {}", kernel.release);
            make(kernel, program, cache, path)
        })?;
        File::open(&path).map(Snapshot).map_err(|error| format!("cannot read {}: {error}", path.display()))
    }

    /// A VM's source for the snapshot. A run of another checkout may remove the file's name. A path in the emulator's
    /// command would need quotes.
    pub fn source(&self) -> String {
        format!("exec:cat {}", name_of(&self.0))
    }
}

fn make(kernel: &Kernel, program: &GuestProgram<'_>, cache: &Cache, path: &Path) -> Result<(), String> {
    let folder = cache.run_folder()?;
    let file = File::create(path).map_err(|error| format!("cannot create {}: {error}", path.display()))?;
    let mut emulator = Emulator::start(vm::booting(kernel, &program.base()?, folder.path())?, folder.path())?;
    // init stops the VM when the VM is ready for tests.
    emulator.wait_until(|status| status == "guest-panicked")?;
    emulator.ask(json!({"execute": "migrate-set-parameters", "arguments": {"max-bandwidth": 1_u64 << 40}}))?;
    emulator.ask(json!({"execute": "migrate", "arguments": {"uri": format!("exec:cat >{}", name_of(&file))}}))?;
    emulator.wait_until(|status| status == "postmigrate")?;
    emulator.ask(json!({"execute": "quit"})).map(drop)
}

/// A name of the open file for other programs.
fn name_of(file: &File) -> String {
    format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd())
}

/// Changes with everything that makes a booted VM.
fn key(kernel: &Kernel, program: &GuestProgram<'_>) -> Result<u64, String> {
    let mut hasher = DefaultHasher::new();
    process::output(Command::new(vm::EMULATOR).arg("--version"))?.hash(&mut hasher);
    kernel.folder().hash(&mut hasher);
    for source in
        [include_str!("vm.rs"), include_str!("snapshot.rs"), include_str!("emulator.rs"), include_str!("programs.rs")]
    {
        source.hash(&mut hasher);
    }
    program.hash_base(&mut hasher)?;
    Ok(hasher.finish())
}
