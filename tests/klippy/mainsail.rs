// SPDX-License-Identifier: GPL-3.0-or-later
//! `scripts/mainsail`: Klipper, Moonraker, Mainsail and the simulated printer by one command.

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use crate::klippy::python;

/// The script in a folder of its own. On ports that no other test has.
fn script(folder: &Path) -> Command {
    let mut command = Command::new(python());
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/mainsail")).arg(folder);
    command.env("PINION", env!("CARGO_BIN_EXE_pinion")).env("PORT", "18410");
    for copy in ["KLIPPER_DIR", "MOONRAKER_DIR", "MAINSAIL_DIR"] {
        command.env_remove(copy);
    }
    command
}

#[test]
fn mainsail_says_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    // Nothing is downloaded here: git finds no network.
    let says = |name: &str, value: &str| {
        let mut command = script(&folder.path().join("stack"));
        command.envs([("GIT_CONFIG_COUNT", "1"), ("GIT_CONFIG_KEY_0", "url./none/.insteadOf")]);
        command.env("GIT_CONFIG_VALUE_0", "https://github.com/");
        let ended = command.env(name, value).output().unwrap();
        assert!(!ended.status.success());
        let error = String::from_utf8(ended.stderr).unwrap();
        error.lines().last().unwrap().to_owned()
    };
    assert_eq!(
        says("LANG", "C"),
        "mainsail: downloading https://github.com/Klipper3d/klipper: git failed: is there a network? KLIPPER_DIR names a copy"
    );
    assert_eq!(says("KLIPPER_DIR", "/none"), "mainsail: KLIPPER_DIR: there is no folder /none");
    assert_eq!(
        says("PINION", "/none/pinion"),
        "mainsail: there is no /none/pinion: run make build, or make mainsail, which does this first"
    );
    let camera = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = camera.local_addr().unwrap().port();
    assert_eq!(
        says("PORT", &port.to_string()),
        format!("mainsail: port {port}: Address already in use: another program has it, maybe another run of this one")
    );
    // Nothing half-done remains that a later run would take for whole.
    let left: Vec<_> = fs::read_dir(folder.path().join("stack")).unwrap().collect();
    assert!(left.is_empty(), "{left:?}");
}
