// SPDX-License-Identifier: GPL-3.0-or-later
//! `scripts/mainsail`: Klipper, Moonraker, Mainsail and the simulated printer by one command.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_testkit::{browser, here};

use crate::checkout;
use crate::klippy::{pinion_path, python};

/// The script in a folder of its own. On ports that no other test has.
fn script(folder: &Path) -> Command {
    let mut command = Command::new(python());
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/mainsail")).arg(folder);
    command.env("PINION", pinion_path()).env("PORT", "18410");
    for copy in ["KLIPPER_DIR", "MOONRAKER_DIR", "MAINSAIL_DIR"] {
        command.env_remove(copy);
    }
    command
}

#[test]
fn mainsail_says_what_is_missing() {
    let has_venv = Command::new(python()).args(["-c", "import ensurepip"]).stderr(Stdio::null()).status();
    if !has_venv.is_ok_and(|ended| ended.success()) {
        return here::not_run("it needs python3 with venv (apt install python3-venv)");
    }
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

/// A run of the script.
struct Stack(Child);

impl Drop for Stack {
    fn drop(&mut self) {
        let _ = kill(Pid::from_raw(self.0.id() as i32), Signal::SIGINT);
        let _ = self.0.wait();
    }
}

/// The color of the simulated printer's head in the light. Mainsail has none like it.
const HEAD: [u8; 3] = [248, 140, 32];
/// The title bar of Mainsail's panel "Missing configuration" (orange darken-2 of Vuetify).
const MISSING: [u8; 3] = [0xf5, 0x7c, 0x00];

#[test]
fn mainsail_shows_the_camera() {
    const TEST: &str = "mainsail_shows_the_camera";
    let Some(klipper) = checkout(TEST) else { return };
    let copies = ["MOONRAKER_DIR", "MAINSAIL_DIR"].map(std::env::var_os);
    let [Some(moonraker), Some(mainsail)] = copies else {
        let _ = writeln!(std::io::stderr(), "\nSKIPPED {TEST}: MOONRAKER_DIR and MAINSAIL_DIR are not set");
        return;
    };
    // Python's packages stay for the next run. A path that fits a socket.
    let folder = Path::new("/tmp/pinion-test-mainsail");
    let mut command = script(folder);
    command.env("KLIPPER_DIR", klipper).env("MOONRAKER_DIR", moonraker).env("MAINSAIL_DIR", mainsail);
    let mut stack = Stack(command.stdout(Stdio::piped()).spawn().unwrap());
    let mut lines = BufReader::new(stack.0.stdout.take().unwrap()).lines().map(Result::unwrap);
    let urls: Vec<String> = lines.by_ref().skip_while(|line| !line.starts_with("Mainsail: ")).take(2).collect();
    assert_eq!(urls, ["Mainsail: http://127.0.0.1:18411", "Camera:   http://127.0.0.1:18410"]);
    let Some(pixels) = browser::screenshot(TEST, "http://127.0.0.1:18411", Duration::from_secs(15)) else { return };
    let is_head = |pixel: &&[u8; 3]| pixel.iter().zip(HEAD).all(|(a, b): (&u8, u8)| a.abs_diff(b) < 12);
    let head = pixels.iter().filter(is_head).count();
    assert!(head > 100, "{head} pixels are the head's");
    assert!(!pixels.contains(&MISSING), "Mainsail says that something is missing in printer.cfg");
}
