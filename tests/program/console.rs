// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion console`: scripts, a person at a terminal, and refused clients.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use nix::pty::openpty;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::config::Config;
use pinion_testkit::wait;

use crate::process::{Pinion, folder_with, pinion_path, program, texts};
use crate::terminal::AtTerminal;

/// Runs a script in a console to its end: its status, its output and its log.
fn console(args: &[&str], script: &str) -> (Option<i32>, String, String) {
    let mut child = Command::new(pinion_path())
        .arg("console")
        .args(args)
        .env_remove("JOURNAL_STREAM")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // The console may have been refused before it reads.
    let _ = child.stdin.take().unwrap().write_all(script.as_bytes());
    texts(&child.wait_with_output().unwrap())
}

const OUTPUT: &str = "\
# A light.
allocate_oids count=1
config_digital_out oid=0 pin=led value=0 default_value=0 max_duration=2s
finalize_config crc=1
";

#[test]
fn a_script_configures_a_simulated_mcu_and_sets_an_output() {
    // However long the script takes.
    let output = OUTPUT.replace("max_duration=2s", "max_duration=0");
    let script =
        format!("{output}update_digital_out oid=0 value=1\nget_clock\nget_config\ndelay 0.1\nquit\nnonsense\n");
    let (code, out, log) = console(&["--board", "sim"], &script);
    assert_eq!(code, Some(0), "{out}\n{log}");
    assert!(out.contains("> update_digital_out oid=0 value=1\n"), "{out}");
    let clock = out.lines().find(|line| line.contains("] clock clock=")).unwrap();
    let (stamp, ticks) = clock.strip_prefix('[').unwrap().split_once("] clock clock=").unwrap();
    // The stamp is the MCU's own time in seconds, with 50 million ticks each.
    let apart = stamp.trim().parse::<f64>().unwrap() - ticks.parse::<f64>().unwrap() / 50e6;
    assert!((-0.01..5.0).contains(&apart), "{clock}");
    assert!(out.contains("] config is_config=1 crc=1 is_shutdown=0 move_count=1024\n"), "{out}");
    assert!(!out.contains("nonsense") && !out.contains("] stats "), "{out}");
}

#[test]
fn a_script_ends_at_its_first_error_and_names_the_line() {
    let (code, out, log) = console(&["--board", "sim"], "get_uptime\n\nget_clok\nget_uptime\n");
    assert_eq!(code, Some(1));
    assert!(log.contains("line 3: there is no command get_clok; did you mean get_clock?"), "{log}");
    assert_eq!(out.matches("] uptime ").count(), 1);

    // The console stops reading at 1 MiB.
    let longest = "x".repeat((1 << 20) - 1);
    for (line, trouble) in [(format!("{longest}\n"), " is too long"), (longest, ": there is no command xxx")] {
        let (_, _, log) = console(&["--board", "sim"], &format!("get_uptime\n{line}"));
        assert!(log.contains(&format!("line 2{trouble}")), "{}", &log[..log.len().min(300)]);
    }

    let (_folder, file) = folder_with("script", "get_uptime\nconfig_endstop oid=0 pin=x_endstp pull_up=1\n");
    let (code, _, log) = console(&["--board", "sim", "-f", file.to_str().unwrap()], "");
    assert!(log.contains(&format!("{}: line 2: `x_endstp` is not a value of pin", file.display())), "{log}");
    assert!(log.contains("did you mean x_endstop?"), "{log}");
    assert_eq!(code, Some(1));
}

#[test]
fn a_shutdown_is_reported_with_its_text_and_reset_ends_it() {
    let script = "allocate_oids count=1\nallocate_oids count=1\nget_clock\n";
    let (code, out, log) = console(&["--board", "sim"], script);
    assert_eq!(code, Some(1), "{out}\n{log}");
    assert!(log.contains("line 2: the MCU shut down: oids already allocated"), "{log}");
    assert!(!out.contains("] clock "), "{out}");
    // A requested stop is not an error.
    let script = format!("{OUTPUT}emergency_stop\nreset\n{OUTPUT}get_config\n");
    let (code, out, log) = console(&["--board", "sim"], &script);
    assert_eq!(code, Some(0), "{out}\n{log}");
    assert!(out.contains("static_string_id=Command request\n"), "{out}");
    assert!(out.ends_with("] config is_config=1 crc=1 is_shutdown=0 move_count=1024\n"), "{out}");
}

#[test]
fn an_output_follows_an_instant_that_is_given_from_now() {
    // Nobody refreshes the output, so the MCU stops two seconds after it went on.
    let (out, on_after_s) = wait::in_time(|seconds| {
        let queue = format!("queue_digital_out oid=0 clock=@clock+{seconds}s on_ticks=1");
        let (_, out, log) = console(&["--board", "sim"], &format!("{OUTPUT}get_clock\n{queue}\ndelay 120\n"));
        assert!(log.contains("line 7: the MCU shut down: Missed scheduling of next digital out event"), "{log}");
        (out, seconds as u64)
    });
    let clock = |before: &str| -> u64 {
        let number = out.split_once(before).unwrap_or_else(|| panic!("{out}")).1;
        number.split(|c: char| !c.is_ascii_digit()).next().unwrap().parse().unwrap()
    };
    let after = clock("] shutdown clock=") - clock("] clock clock=");
    assert!(after >= (on_after_s + 2) * 50_000_000, "{after} ticks of 50 MHz");
}

#[test]
fn a_running_mcu_is_spoken_to_and_one_with_a_host_is_not() {
    let pinion = Pinion::simulated(&[]);
    let link = pinion.link();
    let link = link.to_str().unwrap();
    let (code, out, log) = console(&[link], "get_config\n");
    assert!(code == Some(0) && out.contains("] config is_config=0 "), "{out}\n{log}");
    // Another process has the terminal open. This process's own client also counts as another process for the console.
    let mut client = pinion.client();
    Config::default().apply(&mut client).unwrap();
    let (code, _, log) = console(&[link], "emergency_stop\n");
    assert_eq!(code, Some(1));
    assert!(log.contains(&format!("process {} (", std::process::id())) && log.contains("stop it first"), "{log}");
    assert!(!client.status().unwrap().is_shutdown);
    let (_, _, log) = console(&["/tmp/no-such-link"], "");
    assert!(log.contains("start Pinion, or name its link"), "{log}");
}

#[test]
fn what_is_no_terminal_is_left_as_it_is() {
    let (_folder, file) = folder_with("passwd", "root:x:0:0:root:/root:/bin/bash\n");
    for path in [file.to_str().unwrap(), "/dev/null"] {
        let (code, _, log) = console(&[path], "get_config\n");
        assert!(code == Some(1) && log.contains(&format!("{path} is not a terminal")), "{log}");
    }
    assert_eq!(fs::read_to_string(&file).unwrap(), "root:x:0:0:root:/root:/bin/bash\n");
}

/// A console at a terminal.
fn person(args: &[&str], state: &Path) -> AtTerminal {
    let mut command = program();
    command.arg("console").args(args).env("XDG_STATE_HOME", state).env("TERM", "xterm");
    AtTerminal::start(&mut command, 40, None)
}

#[test]
fn at_a_terminal_tab_completes_and_lines_are_remembered() {
    let pinion = Pinion::simulated(&[]);
    let state = tempfile::tempdir().unwrap();
    let link = pinion.link();
    for times in [1, 2] {
        let mut person = person(&[link.to_str().unwrap()], state.path());
        person.until("help lists them");
        person.until("> ");
        if times == 1 {
            person.press("get_up\t\r");
        } else {
            // The line before, by the up key.
            person.press("\x1b[A\x1b[A\r");
        }
        person.until("] uptime high=");
        person.press("helo\r");
        person.until("!! there is no command helo; did you mean help?");
        person.press("quit\r");
        assert!(person.ended().success() && person.is_given_back(), "{}", person.shown());
        let kept = fs::read_to_string(state.path().join("pinion/console_history")).unwrap();
        assert!(kept.lines().any(|line| line == "get_uptime"), "{kept}");
        // The second time, the up key goes past "quit" and "helo".
        fs::write(state.path().join("pinion/console_history"), "#V2\nget_uptime\nhelo\n").unwrap();
    }
}

#[test]
fn a_signal_ends_it_and_the_terminal_is_as_it_was() {
    let pinion = Pinion::simulated(&[]);
    let link = pinion.link();
    let state = tempfile::tempdir().unwrap();
    for args in [&[link.to_str().unwrap()] as &[&str], &["--board", "sim"]] {
        for signal in [Signal::SIGTERM, Signal::SIGHUP, Signal::SIGQUIT] {
            let mut person = person(args, state.path());
            person.until("help lists them");
            // The line editor has the terminal, and the person has begun a line.
            person.until("> ");
            person.press("get_upt");
            person.until("get_upt");
            assert!(!person.is_given_back());
            person.signal(signal);
            let status = person.ended();
            assert_eq!(status.signal(), Some(signal as i32), "{args:?} {signal}: {status}");
            assert!(person.is_given_back(), "{args:?} {signal}");
            // Pastes are no longer marked.
            person.until("\x1b[?2004l");
        }
    }
    // The signal also ends a script.
    let mut script = console_with(Signal::SIGTERM, program());
    // `wait` closes stdin. The end of the input could come before the signal.
    let _open = script.stdin.take();
    let script = script.wait().unwrap();
    assert_eq!(script.signal(), Some(Signal::SIGTERM as i32), "{script}");
}

/// A console that gets this signal after the first line of its script.
fn console_with(signal: Signal, mut pinion: Command) -> Child {
    pinion.args(["console", "--board", "sim"]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = pinion.spawn().unwrap();
    child.stdin.as_mut().unwrap().write_all(b"get_uptime\n").unwrap();
    child.stdout.as_mut().unwrap().read_exact(&mut [0; 4]).unwrap();
    kill(Pid::from_raw(child.id() as i32), signal).unwrap();
    child
}

#[test]
fn started_by_nohup_it_outlives_its_terminal() {
    let mut nohup = Command::new("nohup");
    nohup.arg(pinion_path());
    let mut child = console_with(Signal::SIGHUP, nohup);
    child.stdin.take().unwrap().write_all(b"get_uptime\nget_config\nquit\n").unwrap();
    let (code, out, _) = texts(&child.wait_with_output().unwrap());
    assert!(code == Some(0) && out.contains("] config is_config="), "{out}");
}

#[test]
fn lines_are_taken_from_a_terminal_while_the_output_goes_elsewhere() {
    let terminal = openpty(None, None).unwrap();
    let child = Command::new(pinion_path())
        .args(["console", "--board", "sim"])
        .stdin(Stdio::from(terminal.slave))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    File::from(terminal.master.try_clone().unwrap()).write_all(b"get_uptime\nquit\n").unwrap();
    let (code, out, log) = texts(&child.wait_with_output().unwrap());
    assert!(code == Some(0) && out.contains("] uptime high="), "{out}\n{log}");
}

#[test]
fn what_the_mcu_says_meanwhile_is_printed_at_once() {
    let state = tempfile::tempdir().unwrap();
    let mut person = person(&["--board", "sim"], state.path());
    person.until("help lists them");
    for line in OUTPUT.lines() {
        person.press(&format!("{line}\r"));
    }
    person.press("update_digital_out oid=0 value=1\r");
    // Nobody refreshes the output, and nobody types.
    person.until("!! the MCU shut down: Missed scheduling of next digital out event");
    person.press("\x04");
    assert!(person.ended().success(), "{}", person.shown());
}
