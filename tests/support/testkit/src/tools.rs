// SPDX-License-Identifier: GPL-3.0-or-later
//! The programs that VMs need on the computer.

use std::env;
use std::process::Command;

use super::process;

/// Programs with their Debian packages. The kernel determines the compiler: see [`super::kernel`].
const TOOLS: [(&str, &str); 6] = [
    ("qemu-system-x86_64", "qemu-system-x86"),
    ("make", "make"),
    ("strip", "binutils"),
    ("tar", "tar"),
    ("xz", "xz-utils"),
    ("ldd", "libc-bin"),
];

/// Makes sure that every program is installed.
pub fn ensure() -> Result<(), String> {
    if !cfg!(target_arch = "x86_64") {
        return Err("the VM is x86-64 and runs this computer's own programs: \
             build for x86_64 to run the tests in it"
            .into());
    }
    if !has("apt-get") || !has("dpkg-deb") {
        return Err("the tests take their kernels out of Debian 12's packages, \
             and this computer has no apt-get and dpkg-deb"
            .into());
    }
    install(&TOOLS)
}

/// Installs the packages of the missing programs.
pub fn install(tools: &[(&str, &str)]) -> Result<(), String> {
    let missing: Vec<&str> = tools.iter().filter(|(program, _)| !has(program)).map(|(_, package)| *package).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let packages = missing.join(" ");
    if !nix::unistd::geteuid().is_root() {
        return Err(format!("the tests in VMs need: sudo apt-get install {packages}"));
    }
    eprintln!("installing {packages}");
    update_package_lists()?;
    process::run(
        Command::new("apt-get")
            .args(["install", "-qq", "-y", "--no-install-recommends"])
            .args(missing)
            .env("DEBIAN_FRONTEND", "noninteractive"),
    )
    .map_err(|cause| format!("the tests in VMs need the packages {packages}: {cause}"))
}

/// apt's lists may be older than its archives.
pub fn update_package_lists() -> Result<(), String> {
    process::run(Command::new("apt-get").args(["update", "-qq"]))
}

fn has(program: &str) -> bool {
    let path = env::var_os("PATH").unwrap_or_default();
    env::split_paths(&path).any(|folder| folder.join(program).exists())
}
