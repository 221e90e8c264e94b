// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --show`: the output while a host drives the printer.

use std::fs::File;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nix::sys::signal::Signal;
use pinion_client::Client;
use tempfile::TempDir;

use crate::life::full_pipe;
use crate::process::{Pinion, WAIT_MAX, closed_pipe, configure, exists, output, pinion_path, printed};
use crate::terminal::AtTerminal;

const STRIP: &[&str] = &[
    "config_digital_out oid=0 pin=led value=0 default_value=0 max_duration=0",
    "config_neopixel oid=1 pin=spidev3.0 data_size=24 bit_max_ticks=200 reset_min_ticks=2500",
];

/// Switches the light on, and the strip's first two lights to red and a dark blue.
fn drive(link: &Path) -> Client {
    let mut client = Client::connect(link, WAIT_MAX).unwrap();
    configure(&mut client, STRIP);
    client.send_line("update_digital_out oid=0 value=1").unwrap();
    client.send_line("neopixel_update oid=1 pos=0 data=00ff00000020").unwrap();
    client.send_line("neopixel_send oid=1").unwrap();
    client
}

#[test]
fn each_change_is_a_line() {
    let mut pinion = Pinion::start(&["sim", "-r", "--show"]);
    for line in [
        "x: 60.00 mm",
        "axis extruder: 0.00 mm",
        "heater extruder: 25.0 C",
        "fan: 0 rpm",
        "light: off",
        "display: dark",
    ] {
        pinion.until(line, || pinion.out().contains(&format!("] {line}\n")));
        let shown = pinion.out();
        assert_eq!(shown.matches(&format!("] {line}\n")).count(), 1, "{line}\n{shown}");
    }
    assert!(matches!(pinion.scheduling("show")[..], [(0, _)]), "to show something is no hurry (SCHED_OTHER)");
    let mut client = drive(&pinion.link());
    pinion.until("the light", || pinion.out().contains("] light: on\n"));
    let strip = "] strip: red#ff0000 blue#000020 off off off off off off\n";
    pinion.until("the strip", || pinion.out().contains(strip));
    assert!(!client.status().unwrap().is_shutdown);
    assert_eq!(pinion.out().matches("] dots: ").count(), 1, "what does not change is shown once");
    assert!(!pinion.out().contains('\x1b'), "nothing for a terminal");
    drop(client);
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
    assert!(!exists(&pinion.link()));
}

/// `pinion sim --show` at a terminal, with its link in this folder.
fn show(folder: &TempDir) -> (AtTerminal, PathBuf) {
    let link = folder.path().join("tty");
    let mut command = Command::new(pinion_path());
    (AtTerminal::start(command.args(["sim", "--show", "-I"]).arg(&link), 40, Some(Stdio::null())), link)
}

#[test]
fn on_a_terminal_there_is_a_picture_and_the_terminal_is_given_back() {
    let folder = tempfile::tempdir().unwrap();
    let (mut pinion, link) = show(&folder);
    // The command to connect is printed as soon as a host can connect.
    pinion.until("--print-config > printer.cfg");
    let client = drive(&link);
    // The colors themselves.
    let (red, blue) = ("\x1b[48;2;255;0;0m   \x1b[m", "\x1b[48;2;0;0;32m   \x1b[m");
    pinion.until(&format!("{red} {blue} off off"));
    pinion.until("light on");
    // The picture has its own rows below the rows that scroll.
    let regions: Vec<String> = pinion.shown().split("\x1b[1;").skip(1).map(|rest| rest[..2].to_owned()).collect();
    assert_eq!(regions.len(), 1, "{regions:?}");
    drop(client);
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.ended().code(), Some(0));
    let text = pinion.shown();
    assert!(text.ends_with("\x1b[r\x1b[999;1H\r\n"), "{:?}", &text[text.len() - 200..]);
}

#[test]
fn a_shutdown_is_shown_until_the_host_restarts_the_mcu() {
    let mut pinion = Pinion::start(&["sim", "--show"]);
    pinion.wait_for_link();
    let mut client = drive(&pinion.link());
    pinion.until("its state", || pinion.out().contains("] mcu: runs\n"));
    client.emergency_stop().unwrap();
    pinion.until("the shutdown", || pinion.out().contains("] mcu: SHUT DOWN: Command request; the log says more\n"));
    client.reset().unwrap();
    pinion.until("the restart", || pinion.out().matches("] mcu: runs\n").count() == 2);
    drop(client);
    pinion.signal(Signal::SIGTERM);
    pinion.end();
}

#[test]
fn a_terminal_of_another_size_gets_the_picture_anew() {
    let folder = tempfile::tempdir().unwrap();
    let (mut pinion, link) = show(&folder);
    pinion.until("mcu");
    for (rows, columns) in [(30, 60), (30, 100), (50, 100)] {
        pinion.resize(rows, columns);
        // All rows scroll, the old picture below the cursor is deleted, and the picture has its own rows again.
        pinion.until("\x1b7\x1b[r\x1b8\x1b[999M");
        pinion.until("axes");
    }
    // On a small terminal a shutdown still has its row.
    pinion.resize(8, 100);
    let mut client = drive(&link);
    client.emergency_stop().unwrap();
    pinion.until("SHUT DOWN: Command request");
    drop(client);
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.ended().code(), Some(0));
}

#[test]
fn q_ends_the_program_and_gives_the_keys_back() {
    let folder = tempfile::tempdir().unwrap();
    let (mut pinion, link) = show(&folder);
    pinion.wait_for("keys", |pinion| pinion.gives_keys().then_some(()));
    pinion.press("xq");
    assert_eq!(pinion.ended().code(), Some(0));
    assert!(!exists(&link));
    assert!(pinion.is_given_back());
}

/// As with Ctrl-\\, or with a service manager when a program hangs.
#[test]
fn a_signal_that_kills_the_program_gives_the_terminal_back() {
    let folder = tempfile::tempdir().unwrap();
    let (mut pinion, _) = show(&folder);
    // The picture has its rows.
    pinion.until("\x1b[1;");
    pinion.signal(Signal::SIGQUIT);
    pinion.until("\x1b[r\x1b[999;1H");
    assert_eq!(pinion.ended().signal(), Some(Signal::SIGQUIT as i32));
    assert!(pinion.is_given_back());
}

#[test]
fn a_reader_that_goes_away_leaves_the_printer_serving() {
    let folder = tempfile::tempdir().unwrap();
    let log = File::create(folder.path().join("log")).unwrap();
    let mut pinion = Pinion::start_to(folder, &["sim", "--show"], closed_pipe(), log);
    pinion.wait_for_link();
    let mut client = drive(&pinion.link());
    assert!(!client.status().unwrap().is_shutdown);
    drop(client);
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(0));
    assert!(!pinion.log().contains("WARN  the printer is shown") && !pinion.log().contains("panicked"));
}

#[test]
fn a_terminal_that_takes_nothing_does_not_keep_the_program() {
    // A pipe without a reader fills up.
    let (_reader, writer) = full_pipe();
    let folder = tempfile::tempdir().unwrap();
    let log = File::create(folder.path().join("log")).unwrap();
    let mut pinion = Pinion::start_to(folder, &["sim", "--show"], writer, log);
    pinion.wait_for_link();
    let client = drive(&pinion.link());
    drop(client);
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.end().code(), Some(0));
}

#[test]
fn to_show_and_to_demonstrate_exclude_each_other() {
    let refused = output(&["sim", "--show", "--demo"]);
    assert_eq!(refused.status.code(), Some(2));
    let help = printed(&["sim", "--help"]);
    let words: Vec<&str> = help.split_whitespace().collect();
    assert!(
        words.join(" ").contains("--show Show the printer while a host drives it, instead of the demonstration"),
        "{help}"
    );
}
