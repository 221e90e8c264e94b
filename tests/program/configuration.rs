// SPDX-License-Identifier: GPL-3.0-or-later
//! The configuration file, and `pinion run --check`.

use std::fs;
use std::os::unix::fs::PermissionsExt;

use crate::process::{Pinion, exists, folder_with, output, printed, texts};

/// `pinion run --check` with a file of this text, and more arguments.
fn checked(config: &str, args: &[&str]) -> (Option<i32>, String, String) {
    let (folder, path) = folder_with("pinion.toml", config);
    let link = folder.path().join("tty");
    let fixed = ["run", "--check", "--config", path.to_str().unwrap(), "-I", link.to_str().unwrap()];
    let checked = output(&[&fixed[..], args].concat());
    assert!(!exists(&link), "nothing is changed");
    texts(&checked)
}

#[test]
fn the_file_says_what_the_command_line_leaves_open() {
    let (folder, path) = folder_with(
        "pinion.toml",
        "board = \"sim\"\ndialect = \"v0.13\"\nmode = \"0604\"\nlog_level = \"warn\"\nsymlink = \"/nonexistent/tty\"\n",
    );
    // The harness passes -I, which overrides the file's symlink.
    let pinion = Pinion::start_in(folder, &["run", "--config", path.to_str().unwrap(), "-m", "0600"]);
    pinion.wait_for_link();
    let dictionary = pinion.client().dictionary().json().unwrap();
    assert_eq!(dictionary, output(&["dict", "--board", "sim", "--dialect", "v0.13"]).stdout);
    let mode = fs::metadata(pinion.link()).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600, "the command line's");
    assert!(!pinion.log().contains(" INFO "), "{}", pinion.log());
}

#[test]
fn the_command_line_may_say_a_thing_twice_as_the_unit_and_its_options_do() {
    let pinion = Pinion::start(&["run", "--board", "linux", "-m", "0604", "--board", "sim", "-m", "0640"]);
    pinion.wait_for_link();
    assert_eq!(fs::metadata(pinion.link()).unwrap().permissions().mode() & 0o777, 0o640);
    let twice = output(&["run", "-r", "-w", "-r", "-w", "--check", "--board", "sim", "--cpu", "9", "--cpu", "100000"]);
    let (_, out, _) = texts(&twice);
    assert!(out.contains("--cpu 100000: there is no such processor"), "{out}");
}

#[test]
fn a_file_with_a_mistake_is_not_served_and_the_mistake_is_shown() {
    for (config, words) in [
        ("board = \"sim\"\nreal_time = true\n", ":2:1: real_time: there is no such key: did you mean realtime?"),
        ("board = \"sim\"\ncpu = one\n", ":2:7: "),
        ("board = \"toaster\"\n", ":1:9: board: there are the boards linux, sim and sim:FILE.toml"),
    ] {
        let (folder, path) = folder_with("pinion.toml", config);
        let mut pinion = Pinion::start_in(folder, &["run", "--config", path.to_str().unwrap()]);
        assert_eq!(pinion.end().code(), Some(1));
        let log = pinion.log();
        assert!(log.contains(&format!("{}{words}", path.display())), "{log}");
        assert_eq!(log.lines().count(), 1, "{log}");
        let (code, _, log) = checked(config, &[]);
        assert!(code == Some(1) && log.contains(words), "{log}");
    }
    let (code, _, log) = texts(&output(&["run", "--config", "/nonexistent/pinion.toml"]));
    assert!(code == Some(1) && log.contains("/nonexistent/pinion.toml: No such file"), "{log}");
}

#[test]
fn a_check_says_what_can_be_served_and_serves_nothing() {
    let (code, out, log) = checked("board = \"sim\"\ndialect = \"kalico\"\n", &["-g", "0"]);
    let root = nix::unistd::geteuid().is_root();
    assert_eq!(code, Some(i32::from(!root)), "only root may give the group away:\n{out}{log}");
    for line in ["  ok       board sim", "  ok       dialect kalico", "tty: klippy takes it for a serial port"] {
        assert!(out.contains(line), "no \"{line}\" in:\n{out}");
    }
    assert_eq!(out.contains("\n0 errors"), root, "{out}");
}

#[test]
fn a_check_says_what_can_not_be_served() {
    let (code, out, _) =
        checked("board = \"sim:/nonexistent.toml\"\ngroup = \"no_such_group\"\n", &["--cpu", "100000"]);
    assert_eq!(code, Some(1), "{out}");
    for line in ["error    /nonexistent.toml", "error    there is no group no_such_group", "error    --cpu 100000"] {
        assert!(out.contains(line), "no \"{line}\" in:\n{out}");
    }
    assert!(out.contains("3 errors"), "{out}");
    let (folder, file) = folder_with("tty", "no link");
    let refused = output(&["run", "--check", "--board", "sim", "-I", file.to_str().unwrap()]);
    let (code, out, _) = texts(&refused);
    assert!(code == Some(1) && out.contains(&format!("-> sudo rm {}", file.display())), "{out}");
    drop(folder);
}

#[test]
fn a_bare_run_reads_no_file() {
    // Otherwise a file for the service would change a program that a user starts by hand.
    let help = printed(&["run", "--help"]);
    assert!(help.contains("--config <FILE>") && !help.contains("[default: /etc"), "{help}");
}

#[test]
fn a_description_from_elsewhere_opens_no_file() {
    let (folder, own) = folder_with("own", "keep");
    let toml = folder.path().join("printer.toml");
    fs::write(&toml, format!("[[spi_bus]]\nname = \"spidev0.0\"\ntrace_file = {own:?}\n")).unwrap();
    let (toml, board) = (toml.to_str().unwrap(), format!("sim:{}", toml.display()));
    let link = folder.path().join("tty");
    for args in [
        &["run", "--check", "--board", &board, "-I", link.to_str().unwrap()][..],
        &["dict", "--board", &board],
        &["console", "--board", &board],
        &["sim", toml, "--print-config"],
        &["sim", toml, "--show"],
    ] {
        let (code, out, log) = texts(&output(args));
        assert_eq!(fs::read_to_string(&own).unwrap(), "keep", "{args:?} emptied the file");
        assert!(
            code == Some(1) && (out + &log).contains("printer.toml:3:1: unknown field `trace_file`"),
            "{args:?}: {log}"
        );
    }
}
