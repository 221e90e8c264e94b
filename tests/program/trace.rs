// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion trace`: recordings from files, from the folders, and from a running Pinion.

use std::collections::HashMap;
use std::fs;
use std::io::Write;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::thread;

use pinion_firmware::time::{Clock, Ticks};
use pinion_trace::event::Event;
use pinion_trace::file::{End, Head, Names, Thread, Trace};
use serde_json::Value;
use tempfile::TempDir;

use crate::process::{Pinion, WAIT_MAX, pinion_path};

/// When the recording ended, in ticks.
const END: u64 = 10 * SECOND;
const SECOND: u64 = 50_000_000;
/// The same instant, 2026-11-22 14:26:14 UTC.
const UTC_MS: u64 = 1_795_357_574_321;
/// The host's block came 38 ms after the step that it was for.
const VERDICT: &str = "the host's block came 38.0 ms after the step it was for; the core was never later than 12.0 ms: look at the host's load";

fn at(before_ms: u64) -> Clock {
    Clock::from_ticks(END - before_ms * SECOND / 1000)
}

fn late_host() -> Trace {
    let core = vec![
        (at(5000), Event::Late { oid: Some(3), late: Ticks::from_ms(12) }),
        (at(20), Event::Pace { worst: Ticks(2000) }),
        (at(0), Event::Block(7)),
        (at(0), Event::Command { id: 5, more: 0 }),
        (at(0), Event::Stopped { block: 7 }),
        (at(0), Event::Due(at(38))),
    ];
    let head = Head {
        version: "pinion-test".into(),
        link: "/tmp/klipper_host_mcu".into(),
        wire: None,
        end: End::Shutdown { reason: "Timer too close".into(), trouble: "stepper oid 3: too late".into() },
        ended_at: at(0).to_bits(),
        utc_ms: UTC_MS,
        realtime: true,
        processors: 4,
        kernel: "6.12.0".into(),
        names: Names { commands: [(5, "queue_step".to_owned())].into(), ..Names::default() },
    };
    let thread = |name: &str, events| Thread { name: name.into(), events };
    Trace { head, threads: vec![thread("core", core), thread("link", vec![(at(0), Event::BlockIn(7))])] }
}

/// A working Pinion, which was late five seconds ago.
fn working() -> Trace {
    let mut trace = late_host();
    trace.head.end = End::Asked;
    trace.threads[0].events.truncate(2);
    trace
}

fn bytes(trace: &Trace) -> Vec<u8> {
    let mut bytes = Vec::new();
    trace.write(&mut bytes).unwrap();
    bytes
}

/// Runs `pinion trace` where its recordings are in this folder.
fn trace(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(pinion_path());
    command.arg("trace").args(args).env("STATE_DIRECTORY", folder).env("HOME", folder).env_remove("XDG_STATE_HOME");
    command.output().unwrap()
}

fn out(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn complaint(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// A folder with a recording of this name.
fn kept(name: &str, trace: &Trace) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes(trace)).unwrap();
    (folder, path)
}

#[test]
fn a_recording_is_judged_and_shown() {
    let (folder, path) = kept("x", &late_host());
    let shown = out(&trace(folder.path(), &[path.to_str().unwrap()]));
    let mut lines = shown.lines();
    assert_eq!(lines.next(), Some(format!("verdict: {VERDICT}").as_str()));
    let about = format!("{}: pinion-test at /tmp/klipper_host_mcu, until 2026-11-22 14:26:14 UTC", path.display());
    assert_eq!(lines.next(), Some(about.as_str()));
    assert_eq!(lines.next(), Some(""));
    assert!(lines.next().unwrap().contains("Zero is when the MCU stopped"), "{shown}");
    assert!(lines.clone().count() > 3 && lines.any(|line| line.contains("queue_step")), "{shown}");
}

#[test]
fn the_newest_recording_is_found_and_all_are_listed() {
    let (folder, _) = kept("mcu-20261122T142614.000Z.trace", &late_host());
    let mut other = working();
    other.head.utc_ms += 60_000;
    fs::write(folder.path().join("b-20261122T142714.000Z.trace"), bytes(&other)).unwrap();
    fs::write(folder.path().join("b-20261122T142514.000Z.trace"), "x").unwrap();
    for args in [&["-I", "/tmp/klipper_host_mcu"][..], &["--last", "-I", "/run/pinion/mcu"]] {
        assert!(out(&trace(folder.path(), args)).starts_with(&format!("verdict: {VERDICT}\n")));
    }
    assert!(out(&trace(folder.path(), &[])).contains("b-20261122T142714.000Z.trace"));
    let listed = out(&trace(folder.path(), &["--list"]));
    let lines: Vec<&str> = listed.lines().collect();
    assert_eq!(lines.len(), 3, "{listed}");
    assert!(lines[0].starts_with("2026-11-22 14:27:14 UTC") && lines[0].contains("it is unknown why"), "{listed}");
    assert!(lines[1].starts_with("2026-11-22 14:26:14 UTC") && lines[1].ends_with(VERDICT), "{listed}");
    assert!(lines[2].starts_with("cannot be read") && lines[2].ends_with("it is not a trace of Pinion"), "{listed}");

    let empty = tempfile::tempdir().unwrap();
    for args in [&[][..], &["--list"], &["-I", "/tmp/klipper_host_other"]] {
        let complaint = complaint(&trace(empty.path(), args));
        assert!(complaint.contains("there is no recording in ") && complaint.contains("--live"), "{complaint}");
    }
}

#[test]
fn a_file_that_is_no_recording_is_refused() {
    let (folder, path) = kept("x", &late_host());
    fs::write(&path, "x").unwrap();
    let said = complaint(&trace(folder.path(), &[path.to_str().unwrap()]));
    assert!(said.contains(&format!("{}: it is not a trace of Pinion", path.display())), "{said}");
    let said = complaint(&trace(folder.path(), &["/nonexistent/x"]));
    assert!(said.contains("/nonexistent/x: No such file"), "{said}");
    let said = complaint(&trace(folder.path(), &["/dev/null"]));
    assert!(said.contains("/dev/null: it is not a regular file"), "{said}");
}

#[test]
fn files_for_other_programs_are_written() {
    let (folder, path) = kept("x", &late_host());
    let file = |name: &str| folder.path().join(name).display().to_string();
    let (vcd, json, svg) = (file("vcd"), file("json"), file("svg"));
    let args = [path.to_str().unwrap(), "--vcd", &vcd, "--perfetto", &json, "--svg", &svg];
    let shown = out(&trace(folder.path(), &args));
    assert_eq!(shown.lines().count(), 2, "the verdict without the timeline: {shown}");
    assert!(fs::read_to_string(vcd).unwrap().contains("$enddefinitions"));
    serde_json::from_slice::<Value>(&fs::read(json).unwrap()).unwrap();
    assert!(fs::read_to_string(svg).unwrap().trim_end().ends_with("</svg>"));
    let said = complaint(&trace(folder.path(), &[path.to_str().unwrap(), "--svg", "/nonexistent/x"]));
    assert!(said.contains("/nonexistent/x cannot be written: No such file"), "{said}");
}

/// A motor, a heater and a fan run until the host stops the MCU.
const RUNNING: [&str; 6] = [
    "config_stepper oid=0 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100",
    "config_digital_out oid=1 pin=x_enable value=1 default_value=1 max_duration=0",
    "config_digital_out oid=2 pin=hotend_heater value=0 default_value=0 max_duration=0",
    "config_digital_out oid=3 pin=fan value=0 default_value=0 max_duration=0",
    "config_digital_out oid=4 pin=led value=0 default_value=1 max_duration=0",
    "config_buttons oid=5 button_count=1",
];

/// The last value and the last change of each wire in a VCD.
fn wires(vcd: &str) -> HashMap<String, (char, u64)> {
    let (mut names, mut wires, mut now) = (HashMap::new(), HashMap::new(), 0);
    for line in vcd.lines() {
        if let ["$var", "wire", "1", id, name, "$end"] = line.split(' ').collect::<Vec<_>>()[..] {
            names.insert(id.to_owned(), name.to_owned());
        } else if let Some(at) = line.strip_prefix('#') {
            now = at.parse().unwrap();
        } else if let Some(name) = line.get(1..).and_then(|id| names.get(id)) {
            wires.insert(name.clone(), (line.chars().next().unwrap(), now));
        }
    }
    wires
}

#[test]
fn all_exports_show_what_the_stop_did() {
    let pinion = Pinion::simulated(&["--trace-edges"]);
    let mut client = pinion.configured(&RUNNING);
    let ack = "buttons_ack oid=%c count=%c";
    assert!(client.dictionary().commands[ack].as_i64().unwrap() < 0, "it does not test negative ids");
    for _ in 0..9 {
        client.send_line("buttons_ack oid=5 count=0").unwrap();
    }
    for line in ["oid=1 value=0", "oid=2 value=1", "oid=3 value=1"] {
        client.send_line(&format!("update_digital_out {line}")).unwrap();
    }
    assert!(client.status().unwrap().is_config);
    client.send_line("emergency_stop").unwrap();
    assert!(client.wait_shutdown(WAIT_MAX).unwrap().is_some());
    let log = pinion.logged("(pinion trace ");
    let (_, path) = log.split_once("(pinion trace ").unwrap();
    let path = path.trim_end_matches(')');

    let folder = pinion.folder().path();
    let [vcd, json, svg] = ["a.vcd", "a.json", "a.svg"].map(|name| folder.join(name));
    let [to_vcd, to_json, to_svg] = [&vcd, &json, &svg].map(|path| path.to_str().unwrap());
    out(&trace(folder, &[path, "--vcd", to_vcd, "--perfetto", to_json, "--svg", to_svg]));

    let timeline = out(&trace(folder, &[path]));
    assert!(timeline.contains("buttons_ack "), "{timeline}");

    let mut levels = HashMap::new();
    let json: Value = serde_json::from_slice(&fs::read(json).unwrap()).unwrap();
    let events = json["traceEvents"].as_array().unwrap();
    for event in events {
        let name = event["name"].as_str().unwrap();
        assert!(!name.starts_with("command "), "{name}");
        if let Some(level) = event["args"]["level"].as_f64() {
            levels.insert(name.to_owned(), level);
        }
    }
    assert!(events.iter().any(|event| event["name"] == "buttons_ack"));

    let wires = wires(&fs::read_to_string(vcd).unwrap());
    let expected = [("x_enable", 1.0), ("hotend_heater", 0.0), ("fan", 0.0), ("led", 1.0), ("x_step", 0.0)];
    for (name, level) in expected {
        assert_eq!(levels[name], level, "{name}");
    }
    for (name, level) in levels {
        let (value, at) = wires[&name];
        assert_eq!(value, if level > 0.5 { '1' } else { '0' }, "{name}");
        let is_switched = ["x_enable", "hotend_heater", "fan", "led"].contains(&name.as_str());
        assert_eq!(at >= wires["mcu_stopped"].1, is_switched, "{name}");
    }

    let svg = fs::read_to_string(svg).unwrap();
    let document = roxmltree::Document::parse(&svg).unwrap();
    let texts: Vec<&str> =
        document.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).collect();
    for name in ["x_step", "x_enable", "hotend_heater", "fan", "led"] {
        assert!(texts.contains(&name), "{name}");
    }
    let words: Vec<&str> = texts.iter().flat_map(|text| text.split_whitespace()).collect();
    let verdict = timeline.lines().next().unwrap();
    assert!(words.join(" ").contains(verdict), "{verdict}");
}

#[test]
fn names_from_a_recording_stay_in_their_lines() {
    let mut hostile = late_host();
    let name = "a\n\x1b[2J\u{9b}b";
    (hostile.head.version, hostile.head.link) = (name.into(), name.into());
    hostile.head.end = End::Shutdown { reason: name.into(), trouble: name.into() };
    hostile.head.names.commands = [(5, name.to_owned())].into();
    hostile.threads[1].name = name.into();
    hostile.threads[0].events.truncate(4);
    let (folder, path) = kept("mcu-20261122T142614.000Z.trace", &hostile);
    for args in [&[path.to_str().unwrap()][..], &["--list"]] {
        let shown = out(&trace(folder.path(), args));
        assert_eq!(shown.chars().find(|c| c.is_control() && *c != '\n'), None, "{shown:?}");
    }
    assert_eq!(out(&trace(folder.path(), &["--list"])).lines().count(), 1);
}

#[test]
fn a_running_pinion_is_asked_for_the_last_seconds() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("klipper_host_b");
    let args = ["--live", "1s", "-I", link.to_str().unwrap()];
    let said = complaint(&trace(folder.path(), &args));
    assert!(said.contains("no Pinion answers on ") && said.contains("b.trace"), "{said}");
    // A stand-in for it.
    let listener = UnixListener::bind(folder.path().join("b.trace")).unwrap();
    let server = thread::spawn(move || listener.accept().unwrap().0.write_all(&bytes(&working())).unwrap());
    let shown = out(&trace(folder.path(), &args));
    server.join().unwrap();
    // Earlier late events are not reported.
    assert!(shown.starts_with("verdict: nobody was late; the core was never later than 0.1 ms\n"), "{shown}");

    let refused = trace(folder.path(), &["--live", "60"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("a recording lasts 1 to 10 seconds"), "{refused:?}");
}
