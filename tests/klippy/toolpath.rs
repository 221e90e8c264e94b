// SPDX-License-Identifier: GPL-3.0-or-later
//! The path that the motors went beside the path that a G-code file asks for.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use super::checkout;
use super::klippy::{example, pinion_path, python};

const MICROSTEP_MM: f64 = 1.0 / 80.0;

/// Two layers: squares, a circle, a retraction.
fn part() -> String {
    let mut part = "G28\nG90\nM83\nG1 X20 Y20 Z5 F6000\n".to_owned();
    for z in ["0.3", "0.5"] {
        part += &format!("G1 Z{z} F600\nG0 X40 Y40 F9000\n");
        part += "G1 X80 Y40 E1.3 F4800\nG1 X80 Y80 E1.3\nG1 X40 Y80 E1.3\nG1 X40 Y40 E1.3\n";
        part += "G1 E-0.8 F2400\nG0 X110 Y60 F9000\nG1 E0.8 F2400\nG3 X110 Y60 I15 J0 E3 F3600\nG1 E-0.8 F2400\n";
        part += "G0 X40 Y40 F9000\nG1 E0.8 F2400\n";
    }
    part + "G1 X60 Y33 Z5 F6000\n"
}

/// The result of the comparison.
struct Said {
    code: Option<i32>,
    /// Its output and its log.
    text: String,
    greatest_mm: f64,
    mean_mm: f64,
    /// On average, by axis.
    ringing_mm: Vec<f64>,
}

/// Prints a file on the built-in printer, and lets the program compare the motors' path with that of a part.
fn print(checkout: &Path, corexy: bool, cfg: &str, part: &str, printed: &str) -> Said {
    let home = tempfile::tempdir().unwrap();
    // Of root's print, another user runs everything.
    let _ = fs::set_permissions(home.path(), fs::Permissions::from_mode(0o777));
    let place = |name: &str| home.path().join(name);
    let sim = |arguments: &[&OsStr]| Command::new(pinion_path()).arg("sim").args(arguments).output().unwrap();
    let board = String::from_utf8(sim(&["--print-board".as_ref()]).stdout).unwrap();
    fs::write(place("board.toml"), if corexy { example(&board, "A CoreXY printer") } else { board }).unwrap();
    let config = String::from_utf8(sim(&[place("board.toml").as_ref(), "--print-config".as_ref()]).stdout).unwrap();
    let config = config.replace("min_extrude_temp: 170", "min_extrude_temp: 0").replace("[input_shaper]\n", "");
    fs::write(place("printer.cfg"), config + "\n[gcode_arcs]\nresolution: 0.1\n\n[input_shaper]\n" + cfg).unwrap();
    fs::write(place("part.gcode"), part).unwrap();
    fs::write(place("printed.gcode"), printed).unwrap();
    let (printer_cfg, printed, part) = (place("printer.cfg"), place("printed.gcode"), place("part.gcode"));
    let (path, python) = (place("path.svg"), python());
    let done = sim(&[
        printer_cfg.as_ref(),
        "--print".as_ref(),
        printed.as_ref(),
        "--compare".as_ref(),
        part.as_ref(),
        "--toolpath".as_ref(),
        path.as_ref(),
        "--klipper".as_ref(),
        checkout.as_ref(),
        "--python".as_ref(),
        python.as_ref(),
    ]);
    let [out, log] = [done.stdout, done.stderr].map(|text| String::from_utf8(text).unwrap());
    let svg = fs::read_to_string(place("path.svg")).unwrap_or_else(|error| panic!("{error}\n{out}\n{log}"));
    assert!(svg.contains("<g id=\"layer-2\">") && svg.ends_with("</svg>\n"), "{svg}");
    let all = out.lines().find(|line| line.starts_with("all ")).unwrap_or_else(|| panic!("{out}\n{log}"));
    let numbers: Vec<f64> = all.split_whitespace().skip(1).map(|number| number.parse().unwrap()).collect();
    let rings = out.lines().filter(|line| line.starts_with("behind a move the head rings"));
    let mean = |line: &str| line.rsplit_once(" mm on average").unwrap().0.rsplit_once(' ').unwrap().1.parse().unwrap();
    Said {
        code: done.status.code(),
        greatest_mm: numbers[0],
        mean_mm: numbers[2],
        ringing_mm: rings.map(mean).collect(),
        text: out.clone() + &log,
    }
}

#[test]
fn the_motors_go_along_the_path_of_the_file() {
    let Some(checkout) = checkout("the_motors_go_along_the_path_of_the_file") else { return };
    // klippy and Pinion take commands without spaces, too.
    for (corexy, part) in [(false, part()), (true, part().replace(' ', ""))] {
        let said = print(&checkout, corexy, "", &part, &part);
        assert!(said.greatest_mm < 4.0 * MICROSTEP_MM && said.mean_mm < MICROSTEP_MM, "{}", said.text);
        assert_eq!(said.code, Some(0), "{}", said.text);
    }
}

#[test]
fn an_input_shaper_makes_the_head_ring_less() {
    let Some(checkout) = checkout("an_input_shaper_makes_the_head_ring_less") else { return };
    let plain = print(&checkout, false, "", &part(), &part());
    let shaper = "shaper_type: mzv\nshaper_freq_x: 57\nshaper_freq_y: 43.5\n";
    let shaped = print(&checkout, false, shaper, &part(), &part());
    for axis in 0..2 {
        assert!(shaped.ringing_mm[axis] < 0.8 * plain.ringing_mm[axis], "{}\n{}", plain.text, shaped.text);
    }
    // It rounds corners, and --compare says how much.
    assert!(shaped.mean_mm > plain.mean_mm, "{}\n{}", plain.text, shaped.text);
}

#[test]
fn an_axis_that_ran_into_its_end_shows() {
    let Some(checkout) = checkout("an_axis_that_ran_into_its_end_shows") else { return };
    // klippy is made to believe that x is elsewhere, and drives the head 3 mm into the end of the axis.
    let crash = "SET_KINEMATIC_POSITION X=50\nG0 X5 F3000\n";
    let printed = part().replace("G1 Z0.5", &format!("{crash}G1 Z0.5"));
    let force = "\n[force_move]\nenable_force_move: True\n";
    let said = print(&checkout, false, force, &part(), &printed);
    assert_eq!(said.code, Some(1), "{}", said.text);
    assert!(said.text.contains("axis x lost "), "{}", said.text);
    assert!(said.greatest_mm > 1.0, "{}", said.text);
}
