// SPDX-License-Identifier: GPL-3.0-or-later
//! The package's script that runs before it is unpacked.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

/// Runs the script for a package of this architecture, on a computer whose kernel calls its processor `machine`.
fn preinst(architecture: &str, machine: &str) -> Output {
    let folder = tempfile::tempdir().unwrap();
    let uname = folder.path().join("uname");
    fs::write(&uname, format!("#!/bin/sh\necho {machine}\n")).unwrap();
    fs::set_permissions(&uname, fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("debian/preinst");
    let mut run = Command::new("sh");
    run.arg(script).arg("install").env("PATH", path).env("DPKG_MAINTSCRIPT_ARCH", architecture);
    run.output().unwrap()
}

/// dpkg itself takes the package: Raspberry Pi OS calls its system for ARMv6 armhf, too.
#[test]
fn the_package_refuses_the_original_zero() {
    let refused = preinst("armhf", "armv6l");
    let words = String::from_utf8(refused.stderr).unwrap();
    assert!(!refused.status.success() && words.contains("ARMv6") && words.contains("Use a Zero 2"), "{words}");
    for (architecture, machine) in
        [("armhf", "armv7l"), ("armhf", "aarch64"), ("arm64", "aarch64"), ("amd64", "x86_64"), ("armel", "armv6l")]
    {
        let taken = preinst(architecture, machine);
        assert!(taken.status.success() && taken.stderr.is_empty(), "{architecture} {machine}: {taken:?}");
    }
}
