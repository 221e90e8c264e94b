// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --toolpath` and `--compare`: files, errors and exit statuses.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::symlink;

use nix::sys::signal::Signal;
use pinion_testkit::wait;

use crate::process::{Pinion, folder_with, limited, output};

/// The x axis, with 80 steps per millimeter.
const X_AXIS: &[&str] = &[
    "config_stepper oid=0 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100",
    "config_digital_out oid=1 pin=x_enable value=0 default_value=0 max_duration=0",
];

#[test]
fn the_path_is_written_when_the_program_ends() {
    for (name, signal, parts) in [
        ("path.svg", Signal::SIGINT, ["<svg xmlns", "<g id=\"layer-0\">", "</svg>"]),
        ("path.gcode", Signal::SIGTERM, ["G90\n", "G0 X60.0000 Y45.0000 Z12.0000", "G1 X62.5000 Y45.0000 Z12.0000"]),
        ("path.stl", Signal::SIGINT, ["filament laid", "", ""]),
    ] {
        wait::in_time(|seconds| {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join(name);
            let mut pinion = Pinion::start_in(folder, &["sim", "-r", "--toolpath", path.to_str().unwrap()]);
            pinion.wait_for_link();
            let mut client = pinion.configured(X_AXIS);
            client.send_line("set_next_step_dir oid=0 dir=1").unwrap();
            let clock = client.clock_in(seconds).unwrap().wire();
            client.send_line(&format!("reset_step_clock oid=0 clock={clock}")).unwrap();
            client.send_line("queue_step oid=0 interval=25000 count=200 add=0").unwrap();
            wait::until("the end of the move", || {
                let oid = [("oid", 0_u8.into())];
                let position = client.query("stepper_get_position", &oid, "stepper_position", Some(0)).unwrap();
                position.int("pos").unwrap() == 200
            });
            drop(client);
            pinion.signal(signal);
            assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
            let written = fs::read(&path).unwrap();
            let text = String::from_utf8_lossy(&written);
            parts.iter().for_each(|part| assert!(text.contains(part), "no {part} in {name}:\n{text}"));
            assert!(pinion.out().contains(name), "{}", pinion.out());
        });
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
        (&["--spi-trace", "/nonexistent/spi"], "/nonexistent/spi cannot be written: "),
        (&["--compare", gcode, "--within", "0"], "--within 0 is not a distance: give millimeters above 0"),
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

#[test]
fn a_small_file_takes_no_more_memory_than_a_print() {
    for (arc, words) in [
        ("G2 I99999999999\n", "part.gcode:2: `I99999999999` is out of range: correct it"),
        ("G2 I90000\n", ": the path up to here is too long to be compared: correct its places and arcs"),
    ] {
        let (folder, gcode) = folder_with("part.gcode", &format!("G1 X1 Y1 Z1\n{}", arc.repeat(2000)));
        let (code, said) = limited(&["sim", "--compare", gcode.to_str().unwrap()]);
        assert_eq!((code, said.lines().count()), (Some(1), 1), "{said}");
        assert!(said.contains(words), "{said}");
        drop(folder);
    }
}

#[test]
fn a_file_that_is_read_is_never_replaced() {
    let text = "G1 X1 Y1 Z1\nG1 X2\n";
    let (folder, gcode) = folder_with("part.gcode", text);
    let board = folder.path().join("printer.gcode");
    fs::write(&board, "").unwrap();
    let name = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    fs::hard_link(&gcode, name("hard.gcode")).unwrap();
    symlink("part.gcode", name("soft.gcode")).unwrap();
    let part = name("part.gcode");
    for other in ["part.gcode", "./part.gcode", "hard.gcode", "soft.gcode", "printer.gcode"] {
        for option in ["--toolpath", "--spi-trace"] {
            let (code, said) = limited(&["sim", &name("printer.gcode"), "--compare", &part, option, &name(other)]);
            assert_eq!((code, said.lines().count()), (Some(1), 1), "{said}");
            assert!(said.contains(" is the same file as "), "{said}");
            assert_eq!(fs::read_to_string(&gcode).unwrap(), text, "{option} {other}");
        }
    }
    let (_, said) = limited(&["dict", "--board", &format!("sim:{}", board.display()), "-o", &name("./printer.gcode")]);
    assert!(said.contains(" is the same file as "), "{said}");
}

#[test]
fn a_start_that_fails_leaves_no_file() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let folder = tempfile::tempdir().unwrap();
    let [path, spi] = ["path.svg", "spi"].map(|name| folder.path().join(name).to_str().unwrap().to_owned());
    let mut pinion = Pinion::start(&["sim", "--camera", &address, "--toolpath", &path, "--spi-trace", &spi]);
    assert_eq!(pinion.end().code(), Some(1), "{}", pinion.log());
    // A link that cannot be made is found last.
    let said = output(&["sim", "--toolpath", &path, "--spi-trace", &spi, "-I", "/nonexistent/tty"]);
    assert_eq!(said.status.code(), Some(1));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}
