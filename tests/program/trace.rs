// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion trace`: recordings from files, from the folders, and from a running Pinion.

use std::fs;
use std::io::Write;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::thread;

use pinion::trace::event::Event;
use pinion::trace::file::{End, Head, Names, Thread, Trace};
use pinion_firmware::time::{Clock, Ticks};
use serde_json::Value;
use tempfile::TempDir;

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
    let mut command = Command::new(env!("CARGO_BIN_EXE_pinion"));
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
    assert!(lines.next().unwrap().contains("Zero is the end of the recording"), "{shown}");
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
    assert!(lines[0].starts_with("2026-11-22 14:27:14 UTC") && lines[0].contains("not known why"), "{listed}");
    assert!(lines[1].starts_with("2026-11-22 14:26:14 UTC") && lines[1].ends_with(VERDICT), "{listed}");
    assert!(lines[2].starts_with("cannot be read") && lines[2].ends_with("it is no trace of Pinion"), "{listed}");

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
    assert!(said.contains(&format!("{}: it is no trace of Pinion", path.display())), "{said}");
    let said = complaint(&trace(folder.path(), &["/nonexistent/x"]));
    assert!(said.contains("/nonexistent/x: No such file"), "{said}");
    let said = complaint(&trace(folder.path(), &["/dev/null"]));
    assert!(said.contains("/dev/null: it is no regular file"), "{said}");
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
    // What was late before is not told.
    assert!(shown.starts_with("verdict: nobody was late; the core was never later than 0.1 ms\n"), "{shown}");

    let refused = trace(folder.path(), &["--live", "60"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("a recording lasts 1 to 10 seconds"), "{refused:?}");
}
