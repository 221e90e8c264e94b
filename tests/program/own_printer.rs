// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim printer.cfg`: the copy for klippy, the board that is served, mistakes and exit statuses.

use std::fs;

use pinion_testkit::mistakes::{MISTAKES, PRINTER};

use crate::process::{Pinion, folder_with, texts};

/// Runs `pinion` to its end: its exit code, its output and its log.
fn output(args: &[&str]) -> (Option<i32>, String, String) {
    texts(&crate::process::output(args))
}

#[test]
fn a_printer_cfg_is_served_and_klippy_gets_a_copy() {
    let (home, cfg) = folder_with("printer.cfg", PRINTER);
    let folder = home.path().join("sim");
    let mut pinion = Pinion::start_in(
        tempfile::tempdir().unwrap(),
        &["sim", cfg.to_str().unwrap(), "--folder", folder.to_str().unwrap()],
    );
    pinion.wait_for_link();
    let copy = fs::read_to_string(folder.join("printer.cfg")).unwrap();
    let link = pinion.link().display().to_string();
    assert!(copy.contains(&format!("[mcu]\nserial: {link}\nrestart_method: command\n# serial: /dev/serial")), "{copy}");
    assert!(copy.contains(&format!("[mcu tool]\nserial: {link}_tool\n")), "{copy}");
    assert!(copy.contains("# baud: 250000") && copy.contains("# canbus_uuid: 0123456789ab"), "{copy}");
    assert!(
        copy.contains(&format!("path: {}\n", fs::canonicalize(folder.join("gcodes")).unwrap().display())),
        "{copy}"
    );
    assert_eq!(fs::read_to_string(&cfg).unwrap(), PRINTER, "the original");
    let host_temperature = fs::canonicalize(&folder).unwrap().join("host_temperature");
    assert!(copy.contains(&format!("sensor_path: {}\n", host_temperature.display())), "{copy}");
    assert_eq!(fs::read_to_string(host_temperature).unwrap(), "45000\n", "in millidegrees");
    let client = pinion.client();
    let pins = format!("{:?}", client.dictionary());
    for pin in ["PB9", "PC2", "PA7"] {
        assert!(pins.contains(&format!("\"{pin}\"")), "{pin} is missing");
    }
    assert!(!pins.contains("gpio5"), "it is a pin of the other MCU");
    drop(client);
    pinion.signal(nix::sys::signal::Signal::SIGINT);
    assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
    assert!(pinion.out().contains("klippy/klippy.py"), "{}", pinion.out());
}

#[test]
fn a_mistake_is_one_line_with_its_place_in_klippys_words() {
    for mistake in MISTAKES.iter().filter(|mistake| !mistake.is_klippys) {
        let (_home, cfg) = folder_with("printer.cfg", &mistake.text());
        let (status, out, log) = output(&["sim", cfg.to_str().unwrap(), "--print-board"]);
        assert_eq!((status, out.as_str()), (Some(1), ""), "{mistake:?}: {log}");
        let place = format!("{}:{}: ", cfg.display(), mistake.line());
        let said = log.lines().filter(|line| line.contains(&place)).collect::<Vec<&str>>();
        assert!(said.len() == 1 && said[0].contains(mistake.words), "{mistake:?}: {place}: {log}");
        assert!(said[0].split(mistake.words).nth(1).unwrap().contains(": "), "no remedy in {log}");
    }
}

#[test]
fn without_plugins_a_copy_does_without_the_files_of_other_programs() {
    let (home, cfg) = folder_with("printer.cfg", &format!("[include mainsail.cfg]\n{PRINTER}"));
    let (cfg, folder) = (cfg.to_str().unwrap(), home.path().join("sim"));
    let (status, _, log) = output(&["sim", cfg, "--print-board"]);
    assert_eq!(status, Some(1));
    assert!(log.contains("printer.cfg:1: Include file '") && log.contains("mainsail.cfg' does not exist: "), "{log}");
    let pinion = Pinion::start_in(
        tempfile::tempdir().unwrap(),
        &["sim", cfg, "--without-plugins", "--folder", folder.to_str().unwrap()],
    );
    pinion.logged("mainsail.cfg' does not exist: klippy's copy is without its macros");
    pinion.wait_for_link();
    let copy = fs::read_to_string(folder.join("mainsail.cfg")).unwrap();
    assert!(copy.contains("\n[pause_resume]\n") && !copy.contains("macro"), "{copy}");
}

#[test]
fn a_try_reports_a_mistake_that_is_found_before_klippy_starts() {
    let mistake = MISTAKES.iter().rfind(|mistake| !mistake.is_klippys).unwrap();
    let (_home, cfg) = folder_with("printer.cfg", &mistake.text());
    let cfg = cfg.to_str().unwrap();
    let (status, out, log) = output(&["sim", cfg, "--try", "--klipper", "/nonexistent", "--json"]);
    assert_eq!(status, Some(1), "{log}");
    let report: serde_json::Value = serde_json::from_str(&out).expect(&log);
    assert_eq!((&report["passed"], &report["folder"]), (&false.into(), &serde_json::Value::Null));
    let step = &report["steps"][0];
    assert_eq!((&step["step"], &step["result"]), (&"read".into(), &"failed".into()));
    assert_eq!((&step["file"], &step["line"]), (&cfg.into(), &mistake.line().into()));
    let text = step["text"].as_str().unwrap();
    assert!(text.contains(mistake.words) && !text.contains(cfg), "{text}");
    let (status, out, _) = output(&["sim", cfg, "--try", "--klipper", "/nonexistent"]);
    assert_eq!(status, Some(1));
    assert!(out.starts_with(&format!("FAIL  read         {cfg}:{}: ", mistake.line())), "{out}");
    assert!(out.contains("does NOT work here: read failed"), "{out}");
}

#[test]
fn printers_of_the_kind_that_users_have_are_served_without_a_complaint() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/testkit/printers");
    let mut count = 0;
    for file in fs::read_dir(folder).unwrap() {
        let path = file.unwrap().path();
        if path.ends_with("voron-macros.cfg") {
            continue;
        }
        let (status, _, log) = output(&["sim", path.to_str().unwrap(), "--print-board"]);
        assert_eq!((status, log.as_str()), (Some(0), ""), "{}", path.display());
        count += 1;
    }
    assert!(count >= 6, "{count}");
}

#[test]
fn files_that_include_each_other_are_refused() {
    let (_home, cfg) = folder_with("printer.cfg", &PRINTER.replace("[printer]", "[include printer.cfg]\n[printer]"));
    let (status, _, log) = output(&["sim", cfg.to_str().unwrap()]);
    assert_eq!(status, Some(1));
    assert!(log.contains("Recursive include of config file"), "{log}");
}

#[test]
fn the_description_of_a_printer_cfg_is_a_description() {
    let (home, cfg) = folder_with("printer.cfg", PRINTER);
    let (status, printed, log) = output(&["sim", cfg.to_str().unwrap(), "--print-board"]);
    assert_eq!(status, Some(0), "{log}");
    let board = home.path().join("board.toml");
    fs::write(&board, &printed).unwrap();
    let (status, again, log) = output(&["sim", board.to_str().unwrap(), "--print-config"]);
    assert_eq!(status, Some(0), "{log}");
    assert!(again.contains("[stepper_x]") && again.contains("tool:gpio5"), "{again}");
    let over = home.path().join("over.toml");
    fs::write(&over, "[[axis]]\nname = \"x\"\nstart_mm = 77.0\n").unwrap();
    let (_, laid, _) = output(&["sim", cfg.to_str().unwrap(), "--print-board", "--with", over.to_str().unwrap()]);
    assert!(laid.contains("start_mm = 77.0") && laid.matches("name = \"x\"").count() == 1, "{laid}");
}

#[test]
fn a_print_says_what_it_needs() {
    let (home, cfg) = folder_with("printer.cfg", PRINTER);
    let cfg = cfg.to_str().unwrap();
    let gcode = home.path().join("a.gcode");
    fs::write(&gcode, "G28\n").unwrap();
    let gcode = gcode.to_str().unwrap();
    for (arguments, status, words) in [
        (&["--print", "/nonexistent.gcode", "--klipper", "/nonexistent"][..], 1, "/nonexistent.gcode"),
        (&["--print", gcode, "--klipper", "/nonexistent"], 1, "there is no klippy: name a checkout"),
        (&["--print", gcode, "--klipper", "/nonexistent", "--plot", cfg], 1, "printer.cfg"),
        (&["--print", gcode, "--try"], 2, "cannot be used with"),
        (&["--layers"], 2, "--print"),
        (&["--speed", "0"], 2, "a number from 0.01 to 1000"),
    ] {
        let (code, _, log) = output(&[&["sim", cfg], arguments].concat());
        assert_eq!(code, Some(status), "{arguments:?}: {log}");
        assert!(log.contains(words), "{arguments:?}: {log}");
    }
    assert!(fs::read_to_string(cfg).unwrap().contains("[printer]"), "the plot has replaced it");
    let (_home, wrong) = folder_with("printer.cfg", &PRINTER.replace("[printer]", "[printer]\n[include no.cfg]"));
    let (code, out, log) = output(&["sim", wrong.to_str().unwrap(), "--print", gcode, "--klipper", "/", "--json"]);
    let report: serde_json::Value = serde_json::from_str(&out).expect(&log);
    assert_eq!(
        (code, &report["passed"], &report["stopped"]["line"]),
        (Some(1), &false.into(), &serde_json::Value::Null)
    );
    assert!(report["stopped"]["why"].as_str().unwrap().contains("no.cfg"), "{report}");
}

/// A step that is misspelled would try nothing, and pass.
#[test]
fn an_unknown_step_of_a_try_is_refused() {
    let (_home, cfg) = folder_with("printer.cfg", PRINTER);
    let (status, _, log) = output(&["sim", cfg.to_str().unwrap(), "--try", "--only", "homed,haeted"]);
    assert_eq!(status, Some(2), "{log}");
    assert!(log.contains("haeted") && log.contains("heated"), "{log}");
}

#[test]
fn a_try_without_a_klippy_says_what_to_name() {
    let (_home, cfg) = folder_with("printer.cfg", PRINTER);
    let cfg = cfg.to_str().unwrap();
    let (status, out, log) = output(&["sim", cfg, "--try", "--klipper", "/nonexistent", "--json"]);
    assert_eq!(status, Some(1), "{log}");
    let report: serde_json::Value = serde_json::from_str(&out).expect(&log);
    assert_eq!((&report["passed"], &report["steps"][0]["step"]), (&false.into(), &"ready".into()));
    let text = report["steps"][0]["text"].as_str().unwrap();
    assert!(text.contains("there is no klippy: name a checkout of Klipper or Kalico with --klipper DIR"), "{text}");
    let (status, _, log) = output(&["sim", "--try"]);
    assert_eq!(status, Some(1));
    assert!(log.contains("need a printer.cfg: name yours"), "{log}");
}

#[test]
fn the_printer_of_another_file_stays_as_that_file_says() {
    let (home, printer) = folder_with("printer.cfg", PRINTER);
    let changed = home.path().join("new.cfg");
    let board = |text: &str| {
        fs::write(&changed, text).unwrap();
        let like = printer.to_str().unwrap();
        output(&["sim", changed.to_str().unwrap(), "--built-like", like, "--print-board"])
    };
    let text = PRINTER.replace("dir_pin: PB7", "dir_pin: !PB7").replace("pin: PA9", "pin: PA10");
    let (status, printed, log) = board(&text);
    assert_eq!(status, Some(0), "{log}");
    assert!(printed.contains("dir_pin = \"PB7\"") && !printed.contains("!PB7"), "{printed}");
    assert!(printed.contains("pin = \"PA9\""), "{printed}");
    let free = printed.lines().find(|line| line.starts_with("pins = ") && line.contains("PA10"));
    assert!(free.is_some(), "the changed file's pin exists, too: {printed}");
    let (status, _, log) = board(&format!("{PRINTER}\n[mcu third]\nserial: /dev/third\n"));
    assert_eq!(status, Some(1), "{log}");
    assert!(log.contains("printer.cfg: it has the MCUs mcu, tool, and "), "{log}");
}
