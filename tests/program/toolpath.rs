// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --toolpath` and `--compare`: files, errors and exit statuses.

use std::fs;
use std::thread;
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::process::{Pinion, folder_with, output};

/// Moves the x axis forward by 200 steps of 1/80 mm.
const MOVE: &[&str] = &[
    "allocate_oids count=2",
    "config_stepper oid=0 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100",
    "config_digital_out oid=1 pin=x_enable value=0 default_value=0 max_duration=0",
    "finalize_config crc=1",
    "set_next_step_dir oid=0 dir=1",
];

#[test]
fn the_path_is_written_when_the_program_ends() {
    for (name, signal, parts) in [
        ("path.svg", Signal::SIGINT, ["<svg xmlns", "<g id=\"layer-0\">", "</svg>"]),
        ("path.gcode", Signal::SIGTERM, ["G90\n", "G0 X60.0000 Y45.0000 Z12.0000", "G1 X62.5000 Y45.0000 Z12.0000"]),
        ("path.stl", Signal::SIGINT, ["filament laid", "", ""]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        let mut pinion = Pinion::start_in(folder, &["sim", "--toolpath", path.to_str().unwrap()]);
        pinion.wait_for_link();
        let mut client = pinion.client();
        MOVE.iter().for_each(|line| client.send_line(line).unwrap());
        let clock = client.clock_in(0.2).unwrap().wire();
        client.send_line(&format!("reset_step_clock oid=0 clock={clock}")).unwrap();
        client.send_line("queue_step oid=0 interval=25000 count=200 add=0").unwrap();
        thread::sleep(Duration::from_millis(800));
        drop(client);
        pinion.signal(signal);
        assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
        let written = fs::read(&path).unwrap();
        let text = String::from_utf8_lossy(&written);
        parts.iter().for_each(|part| assert!(text.contains(part), "no {part} in {name}:\n{text}"));
        assert!(pinion.out().contains(name), "{}", pinion.out());
    }
}

#[test]
fn a_wrong_file_is_one_line_before_the_printer_starts() {
    let (folder, gcode) = folder_with("part.gcode", "G1 X1 Y1 Z1\nG1 X2\n");
    let bad = folder.path().join("bad.gcode");
    fs::write(&bad, "G1 X1 Y1 Z1\nG1 X1.2.3\n").unwrap();
    let [gcode, bad] = [&gcode, &bad].map(|path| path.to_str().unwrap());
    for (args, part) in [
        (&["--toolpath", "path.png"][..], "path.png: the extension says no form: name it .svg, .stl or .gcode"),
        (&["--toolpath", "/nonexistent/path.svg"], "/nonexistent/path.svg cannot be written: "),
        (&["--compare", "/nonexistent/part.gcode"], "/nonexistent/part.gcode: No such file"),
        (&["--compare", bad], "bad.gcode:2: `X1.2.3` has no number: correct it"),
        (&["--compare", gcode, "--within", "0"], "--within 0 is no distance: give millimeters above 0"),
    ] {
        let output = output(&[&["sim"], args].concat());
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), said.lines().count()), (Some(1), 1), "{said}");
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn a_file_that_was_not_printed_is_an_error_at_the_end() {
    let (folder, gcode) = folder_with("part.gcode", "G1 X1 Y1 Z1\nG1 X99\n");
    let mut pinion = Pinion::start_in(folder, &["sim", "--compare", gcode.to_str().unwrap()]);
    pinion.wait_for_link();
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(1), "{}", pinion.log());
    assert!(pinion.log().contains("part.gcode: the motors never went along the path of this file"), "{}", pinion.log());
}
