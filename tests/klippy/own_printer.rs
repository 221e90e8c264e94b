// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim printer.cfg --try` on configurations of Klipper's own repository, as they are and with a mistake.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use pinion_testkit::here;
use pinion_testkit::mistakes::{MISTAKES, PRINTER};
use serde_json::Value;

use crate::checkout;
use crate::klippy::{batch, pinion_path, python};

/// Tries a printer.cfg, and returns the results of its steps.
fn tried(checkout: &Path, cfg: &Path, steps: &[&str]) -> (bool, Vec<Value>) {
    tried_on(checkout, cfg, cfg, steps, tempfile::tempdir().unwrap().path())
}

/// The same on the printer of another printer.cfg, in a folder.
fn tried_on(checkout: &Path, cfg: &Path, printer: &Path, steps: &[&str], folder: &Path) -> (bool, Vec<Value>) {
    // Of root's trials, another user runs klippy.
    for file in [folder, cfg.parent().unwrap()] {
        let _ = fs::set_permissions(file, fs::Permissions::from_mode(0o755));
    }
    let mut command = Command::new(pinion_path());
    command.arg("sim").arg(cfg).args(["--try", "--json", "--klipper"]).arg(checkout);
    command.arg("--built-like").arg(printer).args(["--python", &python(), "--folder"]).arg(folder.join("sim"));
    steps.iter().for_each(|step| _ = command.args(["--only", step]));
    let done = command.output().unwrap();
    let log = String::from_utf8_lossy(&done.stderr);
    let report: Value = serde_json::from_slice(&done.stdout).unwrap_or_else(|error| panic!("{error}\n{log}"));
    let passed = report["passed"].as_bool().unwrap();
    assert_eq!(done.status.success(), passed, "{report}\n{log}");
    (passed, report["steps"].as_array().unwrap().clone())
}

/// A cartesian printer, one with drivers on a UART and a probe, CoreXY on SPI, and a delta printer.
const PRINTERS: [&str; 4] = [
    "printer-creality-ender3-v2-2020.cfg",
    "printer-artillery-genius-pro-2022.cfg",
    "generic-bigtreetech-skr-v1.4.cfg",
    "printer-anycubic-kossel-2016.cfg",
];

#[test]
fn printers_of_klippers_own_repository_home_and_print() {
    let Some(checkout) = klippers("printers_of_klippers_own_repository_home_and_print") else { return };
    for name in PRINTERS {
        let (passed, steps) = tried(&checkout, &checkout.join("config").join(name), &["homed", "printed"]);
        assert!(passed, "{name}: {steps:?}");
        let names: Vec<&str> = steps.iter().map(|step| step["step"].as_str().unwrap()).collect();
        assert_eq!(names, ["ready", "homed", "printed"]);
    }
}

#[test]
fn a_printer_of_two_boards_is_leveled_and_prints() {
    let Some(checkout) = checkout("a_printer_of_two_boards_is_leveled_and_prints") else { return };
    let home = tempfile::tempdir().unwrap();
    let cfg = home.path().join("printer.cfg");
    fs::write(&cfg, PRINTER).unwrap();
    let (passed, steps) = tried_on(&checkout, &cfg, &cfg, &[], home.path());
    assert!(passed, "{steps:?}");
    let ended = |result: &str| -> Vec<&str> {
        let steps = steps.iter().filter(|step| step["result"] == result);
        steps.map(|step| step["step"].as_str().unwrap()).collect()
    };
    assert_eq!(ended("skipped"), ["carriage", "shaper"]);
    let leveled = steps.iter().find(|step| step["step"] == "leveled").unwrap();
    assert_eq!(leveled["text"], "Z_TILT_ADJUST, SCREWS_TILT_CALCULATE, BED_MESH_CALIBRATE");
    for name in ["klippy.log", "picture.jpg", "path.svg"] {
        assert!(fs::metadata(home.path().join("sim").join(name)).unwrap().len() > 1000, "{name}");
    }
}

#[test]
fn printers_of_the_kind_that_users_have_pass_every_step() {
    let Some(checkout) = klippers("printers_of_the_kind_that_users_have_pass_every_step") else { return };
    let printers = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/support/testkit/printers");
    for (name, count) in [("voron-2.4", 11), ("ender-3", 10), ("mk3", 9), ("ratrig", 12), ("kossel", 9), ("idex", 8)] {
        let (passed, steps) = tried(&checkout, &printers.join(format!("{name}.cfg")), &[]);
        assert!(passed, "{name}: {steps:?}");
        let tried = steps.iter().filter(|step| step["result"] == "passed").count();
        assert_eq!(tried, count, "{name}: {steps:?}");
    }
}

#[test]
fn mistakes_have_klippys_own_words() {
    let Some(checkout) = checkout("mistakes_have_klippys_own_words") else { return };
    let dictionary = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/dictionaries/klipper-master.json");
    for mistake in MISTAKES.iter().filter(|mistake| mistake.is_early) {
        let said = batch(&checkout, &dictionary, &mistake.text(), "").unwrap_err();
        assert!(is_kalico(&checkout) || said.contains(mistake.words), "{mistake:?}: {said}");
    }
}

#[test]
fn every_configuration_of_a_printer_in_the_checkout_is_served() {
    let Some(checkout) = checkout("every_configuration_of_a_printer_in_the_checkout_is_served") else { return };
    let mut count = 0;
    for file in fs::read_dir(checkout.join("config")).unwrap() {
        let path = file.unwrap().path();
        // The others are pieces.
        if !fs::read_to_string(&path).is_ok_and(|text| text.contains("\n[printer]\n") && text.contains("\n[mcu]\n")) {
            continue;
        }
        let done = Command::new(pinion_path()).arg("sim").arg(&path).arg("--print-board").output().unwrap();
        let log = String::from_utf8_lossy(&done.stderr);
        // Kalico refuses some of its own files: a display needs [virtual_sdcard] there.
        assert!(done.status.success() || log.contains("klippy refuses it"), "{}: {log}", path.display());
        count += usize::from(done.status.success());
    }
    assert!(count > 120, "{count}");
}

/// A checkout of Klipper, not of Kalico.
fn klippers(test: &str) -> Option<PathBuf> {
    let checkout = checkout(test)?;
    if is_kalico(&checkout) {
        here::not_run(
            "Kalico refuses some of these printers: a display without [virtual_sdcard], a driver without sense_resistor",
        );
        return None;
    }
    Some(checkout)
}

/// Kalico refuses the same, partly in other words.
fn is_kalico(checkout: &Path) -> bool {
    checkout.join("klippy/extras/danger_options.py").exists()
}

/// The rules that only klippy knows: it is asked before the printer is served.
#[test]
fn a_klippy_that_is_there_judges_the_printer_cfg() {
    let Some(checkout) = checkout("a_klippy_that_is_there_judges_the_printer_cfg") else { return };
    let home = tempfile::tempdir().unwrap();
    fs::set_permissions(home.path(), fs::Permissions::from_mode(0o755)).unwrap();
    let cfg = home.path().join("printer.cfg");
    let read = |text: &str| {
        fs::write(&cfg, text).unwrap();
        let mut pinion = as_a_user();
        pinion.arg("sim").arg(&cfg).args(["--print-board", "--klipper"]).arg(&checkout);
        let done = pinion.args(["--python", &python()]).output().unwrap();
        (done.status.success(), String::from_utf8(done.stderr).unwrap())
    };
    let (accepted, log) = read(PRINTER);
    if log.contains("cannot be asked") {
        return here::not_run("klippy's Python or its checkout may not be read by the user nobody");
    }
    assert!(accepted && log.is_empty(), "{log}");
    let mut without_line = Vec::new();
    for mistake in MISTAKES.iter().filter(|mistake| mistake.is_klippys) {
        let (accepted, log) = read(&mistake.text());
        assert!(!accepted && (is_kalico(&checkout) || log.contains(mistake.words)), "{mistake:?}: {log}");
        if !log.contains(&format!("{}:", cfg.display())) {
            without_line.push(log);
        }
    }
    // These words name nothing of the file.
    assert!(without_line.len() <= 2, "{without_line:#?}");
}

/// What klippy takes, and Pinion once refused, or left klippy without.
#[test]
fn what_klippy_takes_is_served() {
    let Some(checkout) = checkout("what_klippy_takes_is_served") else { return };
    let home = tempfile::tempdir().unwrap();
    fs::set_permissions(home.path(), fs::Permissions::from_mode(0o755)).unwrap();
    let probe = "[probe]\npin: ^tool:gpio9\nx_offset: 20\nz_offset: 1.5\n";
    let with = |more: &str| format!("{PRINTER}\n{more}");
    let chip = |name: &str| format!("[temperature_sensor {name}]\nsensor_type: BME280\ni2c_bus: i2c1\n");
    for (name, text) in [
        ("aht", with("[temperature_sensor a]\nsensor_type: AHT10\ni2c_bus: i2c1\n")),
        ("two sections for one chip", with(&[chip("a"), chip("b")].concat())),
        ("Klipper's own", with("[query_adc]\n[print_stats]\n[heaters]\n[statistics]\n")),
        ("a plugin's probe", PRINTER.replace(probe, "[beacon]\nserial: /dev/x\nx_offset: 20\n")),
        (
            "a plugin's steppers",
            with(
                "[mmu_machine]\n[stepper_mmu_gear]\nstep_pin: PD0\ndir_pin: PD1\nrotation_distance: 22\nmicrosteps: 16\n\
                 [tmc2209 stepper_mmu_gear]\nuart_pin: PD4\nrun_current: 0.5\n",
            ),
        ),
        (
            "a plugin's command",
            with("[zcalib]\n[gcode_macro ZCALIB]\nrename_existing: OLD_ZCALIB\ngcode: OLD_ZCALIB\n"),
        ),
        ("a plugin's sensor", with("[tca9548a a]\n[temperature_sensor b]\nsensor_type: AHT2X_TCA9548A\n")),
    ] {
        let cfg = home.path().join("printer.cfg");
        fs::write(&cfg, &text).unwrap();
        let mut pinion = as_a_user();
        pinion.arg("sim").arg(&cfg).args(["--print-board", "--without-plugins", "--klipper"]).arg(&checkout);
        let done = pinion.args(["--python", &python()]).output().unwrap();
        let log = String::from_utf8(done.stderr).unwrap();
        if log.contains("cannot be asked") {
            return here::not_run("klippy's Python or its checkout may not be read by the user nobody");
        }
        assert!(done.status.success(), "{name}: {log}");
    }
}

/// `pinion`, as nobody if the tests run as root: klippy never runs as root.
fn as_a_user() -> Command {
    if !here::is_root() {
        return Command::new(pinion_path());
    }
    let mut command = Command::new("setpriv");
    command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]).arg(pinion_path());
    command
}

/// Changes that klippy takes and that do not fit the printer: the step that fails, and a part of its text.
const MISFITS: [(&str, &str, &str, &str); 9] = [
    ("dir_pin: PB9", "dir_pin: !PB9", "homed", "No trigger on stepper_x after full movement"),
    ("dir_pin: !PB5", "dir_pin: PB5", "homed", "No trigger on stepper_z after full movement"),
    ("endstop_pin: ^PA5", "endstop_pin: ^!PA5", "homed", "Endstop stepper_x still triggered after retract"),
    // Nothing is at this pin, so its pull-up counts.
    ("endstop_pin: ^PA5", "endstop_pin: ^PA4", "homed", "Endstop stepper_x still triggered after retract"),
    ("position_endstop: 0\n", "position_endstop: 4\n", "homed", "the nozzle is"),
    ("sensor_type: EPCOS 100K B57560G104F", "sensor_type: SliceEngineering 450", "heated", ""),
    ("sensor_pin: PC5", "sensor_pin: PC6", "heated", ""),
    // The motor goes twice as far, and to the end of its travel.
    ("rotation_distance: 40", "rotation_distance: 20", "printed", ""),
    ("rotation_distance: 8\n", "rotation_distance: 80\n", "printed", "mm apart, not 0.200 mm"),
];

#[test]
fn a_change_that_does_not_fit_the_printer_fails() {
    let Some(checkout) = checkout("a_change_that_does_not_fit_the_printer_fails") else { return };
    let printer = checkout.join("config/printer-creality-ender3-v2-2020.cfg");
    let text = fs::read_to_string(&printer).unwrap();
    for (from, to, step, words) in MISFITS {
        let changed = text.replacen(from, to, 1);
        assert_ne!(changed, text, "{from}");
        let home = tempfile::tempdir().unwrap();
        let cfg = home.path().join("printer.cfg");
        fs::write(&cfg, changed).unwrap();
        let (_, steps) = tried_on(&checkout, &cfg, &printer, &["homed", step], home.path());
        let failed =
            steps.iter().find(|found| found["result"] == "failed").unwrap_or_else(|| panic!("{to}: {steps:?}"));
        // Kalico leaves the endstop after homing.
        let step = if is_kalico(&checkout) && to == "rotation_distance: 20" { "homed" } else { step };
        assert_eq!(failed["step"], step, "{to}: {failed}");
        // Kalico names the rail without "stepper_".
        let words = if is_kalico(&checkout) { words.replace("stepper_", "") } else { words.to_owned() };
        assert!(failed["text"].as_str().unwrap().contains(&words), "{to}: {failed}");
    }
}

/// Sections that a print of a file needs. A template is a program: that of HANG waits for itself.
const MORE: &str = "[pause_resume]
[gcode_macro HANG]
gcode:
  {% set lock = cycler.__init__.__globals__.__builtins__.__import__('threading').Lock() %}
  {% set once = lock.acquire() %}
  {% set twice = lock.acquire() %}
";

/// What `pinion latency --pin GPIO17 --json` writes.
const EDGE: &str = r#"{ "form": 1, "version": "0.1.0", "computer": "a board",
                        "edge": { "line": "GPIO17", "kernel_ns": 2000.0, "registers_ns": null } }"#;

/// A print of a file on the built-in printer: whether it passed, and its report.
fn printed(checkout: &Path, gcode: &str) -> Value {
    let home = tempfile::tempdir().unwrap();
    // Of root's print, another user runs everything.
    let _ = fs::set_permissions(home.path(), fs::Permissions::from_mode(0o777));
    let place = |name: &str| home.path().join(name);
    let config = Command::new(pinion_path()).args(["sim", "--print-config"]).output().unwrap().stdout;
    fs::write(place("printer.cfg"), [config, MORE.into()].concat()).unwrap();
    fs::write(place("a.gcode"), gcode).unwrap();
    fs::write(place("edge.json"), EDGE).unwrap();
    let mut command = Command::new(pinion_path());
    command.arg("sim").arg(place("printer.cfg")).arg("--print").arg(place("a.gcode")).arg("--json");
    command.arg("--klipper").arg(checkout).args(["--python", &python(), "--plot"]).arg(place("plot.svg"));
    command.arg("--latency").arg(place("edge.json"));
    let done = command.output().unwrap();
    let log = String::from_utf8_lossy(&done.stderr);
    let mut report: Value = serde_json::from_slice(&done.stdout).unwrap_or_else(|error| panic!("{error}\n{log}"));
    assert_eq!(done.status.success(), report["passed"] == true, "{report}");
    assert!(fs::read_to_string(place("plot.svg")).unwrap().contains("extruder"));
    for key in ["folder", "printer", "real_seconds"] {
        report.as_object_mut().unwrap().remove(key);
    }
    report
}

#[test]
fn a_file_is_printed_and_each_time_the_same() {
    let Some(checkout) = checkout("a_file_is_printed_and_each_time_the_same") else { return };
    let gcode = "M104 S200\nG28\nM109 S200\nM83\nG1 X50 Y50 Z0.2 F6000\nG1 X90 E2 F1200\nPAUSE\nG1 Y90 E2\n\
                 G1 Z0.4\nG1 X50 E2\nG1 Y50 E2\nM104 S0\n";
    let report = printed(&checkout, gcode);
    assert_eq!((&report["passed"], &report["pauses"]), (&true.into(), &1.into()), "{report}");
    assert_eq!(report["layers"].as_array().unwrap().len(), 2, "{report}");
    assert!((report["filament_mm"].as_f64().unwrap() - 8.0).abs() < 0.2, "{report}");
    assert!(report["phases"]["heating"].as_f64().unwrap() > 10.0, "{report}");
    assert!(report["phases"]["paused"].as_f64().unwrap() > 25.0, "{report}");
    let x = report["motors"].as_array().unwrap().iter().find(|motor| motor["name"] == "x").unwrap();
    assert!((x["mm_per_s"].as_f64().unwrap() - 20.0).abs() < 2.0, "{x}");
    let steps_per_s: f64 =
        report["motors"].as_array().unwrap().iter().map(|motor| motor["steps_per_s"].as_f64().unwrap()).sum();
    let share = report["limits"]["edges_share"].as_f64().unwrap();
    // Two edges a step. The report has whole steps.
    assert!((share - steps_per_s * 4e-6).abs() < 1e-5, "{report}");
    assert_eq!(printed(&checkout, gcode), report);
}

#[test]
fn a_print_that_stops_says_at_which_line() {
    let Some(checkout) = checkout("a_print_that_stops_says_at_which_line") else { return };
    for (gcode, line, why) in [
        ("G28\n; cold\nG1 X50 E2\nM400\n", 3, "Extrude below minimum temp"),
        ("G28\nG1 X5000\n", 2, "Move out of range"),
        ("G28\nM112\n", 2, "Shutdown due to M112 command"),
        ("TEMPERATURE_WAIT SENSOR=extruder MINIMUM=100\n", 1, "nothing has moved for 60 min"),
        ("HANG\n", 1, "it has not answered for 30 s of the printer: it waits at <template>, line"),
    ] {
        let report = printed(&checkout, gcode);
        let stopped = &report["stopped"];
        assert_eq!(stopped["line"], line, "{report}");
        assert!(stopped["why"].as_str().unwrap().contains(why), "{report}");
        assert_eq!(report["passed"], false);
    }
}
