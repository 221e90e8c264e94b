// SPDX-License-Identifier: GPL-3.0-or-later
//! Root's commands in a folder of another user, and programs in another user's printer.cfg.

use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt, lchown, symlink};
use std::path::Path;
use std::process::{Command, Stdio};

use pinion_testkit::mistakes::PRINTER;
use pinion_testkit::process::Running;
use pinion_testkit::{here, wait};
use tempfile::TempDir;

use crate::process::{folder_with, pinion_path, program_in, texts};
use crate::search::is_gone;

/// The other user.
const MALLORY: u32 = 65_534;

fn give(path: &Path) {
    lchown(path, Some(MALLORY), Some(MALLORY)).unwrap();
}

/// A folder that everybody may enter.
fn open_folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), Permissions::from_mode(0o755)).unwrap();
    folder
}

#[test]
fn links_of_another_user_lead_no_output_of_root_anywhere() {
    if !here::is_root() {
        return;
    }
    let root = open_folder();
    let [secret, home] = ["secret", "home"].map(|name| root.path().join(name));
    fs::write(&secret, "root's").unwrap();
    fs::create_dir(&home).unwrap();
    give(&home);
    // A link to the file, one to its folder, and a folder that looks like one of ours.
    let [link, folder, false_folder] = ["link.svg", "folder", "false"].map(|name| home.join(name));
    symlink(&secret, &link).unwrap();
    symlink(root.path(), &folder).unwrap();
    fs::create_dir(&false_folder).unwrap();
    fs::write(false_folder.join(".pinion-sim"), "").unwrap();
    symlink(&secret, false_folder.join("variables.cfg")).unwrap();
    [&link, &folder, &false_folder].into_iter().for_each(|path| give(path));
    let (_cfg, cfg) = folder_with("printer.cfg", PRINTER);
    let (_in_place, in_place) = folder_with(
        "printer.cfg",
        &PRINTER.replacen("[mcu]\n", &format!("[mcu]\nserial: {}/link.svg\n# ", home.display()), 1),
    );
    let through = folder.join("secret");
    let [cfg, in_place, link, through, false_folder] =
        [&cfg, &in_place, &link, &through, &false_folder].map(|path| path.to_str().unwrap());
    for args in [
        &["dict", "--board", "sim", "-o", link][..],
        &["dict", "--board", "sim", "-o", through],
        &["sim", "--toolpath", link],
        &["sim", "--spi-trace", through],
        &["latency", "--svg", link],
        &["sim", cfg, "--folder", through],
        &["sim", cfg, "--folder", false_folder],
        &["sim", in_place, "--in-place-pty"],
    ] {
        let (code, _, log) = texts(&Command::new(pinion_path()).args(args).output().unwrap());
        assert_eq!(code, Some(1), "{args:?}: {log}");
        assert!(log.contains("belongs to another user"), "{args:?}: {log}");
        assert_eq!(log.to_lowercase().matches("error").count(), 1, "{args:?}: {log}");
    }
    assert_eq!(fs::read_to_string(&secret).unwrap(), "root's");
    assert!(fs::symlink_metadata(link).unwrap().is_symlink(), "it is left");
}

#[test]
fn a_printer_with_too_many_mcus_is_refused_before_any_starts() {
    let many: String = (1..800).map(|n| format!("\n[mcu m{n}]\nserial: /dev/ttyACM{n}\n")).collect();
    let (_folder, cfg) = folder_with("printer.cfg", &format!("{PRINTER}{many}"));
    let (_toml, toml) =
        folder_with("many.toml", &(0..17).map(|n| format!("[[mcu]]\nname = \"m{n}\"\n")).collect::<String>());
    for file in [cfg, toml] {
        let (code, _, log) = texts(&Command::new(pinion_path()).arg("sim").arg(&file).output().unwrap());
        assert!(code == Some(1) && log.contains("MCUs, and at most 16 are simulated"), "{log}");
    }
}

#[test]
fn copies_are_as_secret_as_their_sources() {
    let (home, cfg) = folder_with("printer.cfg", &format!("{PRINTER}\n[save_variables]\nfilename: HOME/saved.cfg\n"));
    let text = fs::read_to_string(&cfg).unwrap().replace("HOME", home.path().to_str().unwrap());
    fs::write(&cfg, text).unwrap();
    fs::write(home.path().join("saved.cfg"), "[Variables]\n").unwrap();
    for file in [&cfg, &home.path().join("saved.cfg")] {
        fs::set_permissions(file, Permissions::from_mode(0o600)).unwrap();
    }
    let folder = home.path().join("sim");
    let mut sim = Command::new(pinion_path());
    sim.arg("sim").arg(&cfg).arg("--folder").arg(&folder).stdout(Stdio::null()).stderr(Stdio::null());
    let _sim = Running(sim.spawn().unwrap());
    for copy in ["printer.cfg", "variables.cfg"].map(|name| folder.join(name)) {
        wait::until("the copy", || copy.exists());
        assert_eq!(fs::metadata(&copy).unwrap().permissions().mode() & 0o777, 0o600, "{}", copy.display());
    }
}

/// A klippy that writes who it is, and then hangs.
const KLIPPY: &str = "#!/bin/sh\ncat /proc/self/status >\"$(dirname \"$1\")/who\"\nexec sleep 1000\n";

#[test]
fn a_trial_that_root_starts_runs_klippy_without_rights_and_takes_it_along() {
    if !here::is_root() {
        return;
    }
    let root = open_folder();
    let program = program_in(root.path());
    let klippy = root.path().join("klipper/klippy");
    fs::create_dir_all(&klippy).unwrap();
    fs::write(klippy.join("klippy.py"), KLIPPY).unwrap();
    let home = root.path().join("home");
    fs::create_dir(&home).unwrap();
    let cfg = home.join("printer.cfg");
    fs::write(&cfg, PRINTER).unwrap();
    [&home, &cfg].into_iter().for_each(|path| give(path));
    // In root's folder: it is made for the trial's user.
    let folder = root.path().join("sim");
    let mut trial = Command::new(&program);
    trial
        .arg("sim")
        .arg(&cfg)
        .args(["--try", "--real-time", "--python", "/bin/sh", "--klipper"])
        .arg(root.path().join("klipper"));
    trial.arg("--folder").arg(&folder).env_remove("SUDO_UID").stdout(Stdio::null()).stderr(Stdio::null());
    let mut trial = Running(trial.spawn().unwrap());
    let who = wait::until_some(
        || fs::read_to_string(folder.join("who")).ok().filter(|who| who.contains("NoNewPrivs")),
        || "klippy".into(),
    );
    let field = |name: &str| {
        let line = who.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_else(|| panic!("{name}: {who}"));
        line.split_whitespace().nth(1).unwrap().to_owned()
    };
    assert_eq!(field("Uid"), MALLORY.to_string(), "{who}");
    let none = "0".repeat(16);
    assert_eq!((field("CapPrm"), field("CapEff"), field("CapAmb")), (none.clone(), none.clone(), none), "{who}");
    assert_eq!(field("NoNewPrivs"), "1", "{who}");
    assert_eq!(fs::metadata(&folder).unwrap().uid(), MALLORY);
    // Whatever kills the program: klippy does not stay.
    let klippy: u32 = field("Pid").parse().unwrap();
    trial.0.kill().unwrap();
    trial.0.wait().unwrap();
    wait::until("klippy's end", || is_gone(klippy));
}
