// SPDX-License-Identifier: GPL-3.0-or-later
//! The flight recorder: each stop leaves a trace and a verdict.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::{PermissionsExt, chown, symlink};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::signal::Signal;
use pinion_protocol::block::{Refusal, Sequence, frame};
use pinion_testkit::{here, wait};
use pinion_trace::event::Event;
use pinion_trace::file::{End, Trace};

use crate::guardian::guardian;
use crate::process::{Pinion, WAIT_MAX, configure, pinion_path};
use crate::search::is_gone;

/// The user `nobody`.
const NOBODY: u32 = 65534;

/// The traces that the program has kept.
fn kept(pinion: &Pinion) -> Vec<PathBuf> {
    let entries = fs::read_dir(pinion.state()).into_iter().flatten();
    entries.map(|entry| entry.unwrap().path()).collect()
}

fn read(path: &PathBuf) -> Trace {
    Trace::read(File::open(path).unwrap()).unwrap()
}

const OUTPUT: &str = "config_digital_out oid=0 pin=led value=0 default_value=0 max_duration=0";

/// Waits for the verdict with these words, and reads the trace that it names.
#[track_caller]
fn verdict(pinion: &Pinion, words: &str) -> Trace {
    let line = pinion.logged("(pinion trace ");
    assert!(line.contains(words), "{line}");
    let (_, file) = line.split_once("(pinion trace ").unwrap_or_else(|| panic!("{line}"));
    let file = PathBuf::from(file.trim_end_matches(')'));
    assert_eq!(kept(pinion), std::slice::from_ref(&file));
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o644);
    read(&file)
}

/// Stops a new MCU that is at least this old by a command that is late by half of the MCU's age.
fn late_by_half_of_its_age(age: Duration) -> (Pinion, f64) {
    let pinion = Pinion::simulated(&["--trace-edges"]);
    let mut client = pinion.configured(&[OUTPUT]);
    client.send_line("update_digital_out oid=0 value=1").unwrap();
    thread::sleep(age);
    let now = client.query("get_clock", &[], "clock", None).unwrap().u32("clock").unwrap();
    let late = now / 2;
    client.send_line(&format!("queue_digital_out oid=0 clock={late} on_ticks=1")).unwrap();
    assert_eq!(client.wait_shutdown(WAIT_MAX).unwrap().as_deref(), Some("Timer too close"));
    (pinion, f64::from(now - late) / client.frequency_hz() * 1000.0)
}

#[test]
fn a_host_that_is_late_is_named() {
    wait::in_time(|_| {
        // No event lies before the MCU's birth, so a young MCU's host cannot be late by much. Then a busy computer has had a
        // larger part in it than the host, and the verdict says so: the next host is later than this computer.
        let ages = [0, 1, 4, 16].map(Duration::from_secs);
        let mut stops = ages.into_iter().map(late_by_half_of_its_age);
        let names_host = |pinion: &Pinion| pinion.logged("(pinion trace ").contains("look at the host's load");
        let stop = stops.find(|(pinion, _)| names_host(pinion));
        let (pinion, least_ms) = stop.expect("a verdict that names the host, 8 s late at last");
        let trace = verdict(&pinion, "look at the host's load");
        let line = pinion.logged("look at the host's load");
        let (_, figure) = line.split_once("the host's block came ").unwrap_or_else(|| panic!("{line}"));
        let (figure, rest) = figure.split_once(' ').unwrap();
        let unit_ms = if rest.starts_with("ms") { 1.0 } else { 1000.0 };
        // The verdict rounds its figure.
        assert!(figure.parse::<f64>().unwrap() * unit_ms >= 0.9 * least_ms, "{line}; at least {least_ms} ms");
        assert!(matches!(&trace.head.end, End::Shutdown { reason, .. } if reason == "Timer too close"));
        assert_eq!(trace.head.names.objects[&0], "digital output oid 0 (led)");
        assert!(trace.head.names.commands.values().any(|name| name == "queue_digital_out"));
        for thread in ["core", "link", "sampler"] {
            assert!(trace.of(thread).count() > 0, "{thread}");
        }
        let levels: Vec<bool> = trace
            .of("edges")
            .filter_map(|(_, event)| if let Event::Edge { level, .. } = event { Some(level) } else { None })
            .collect();
        assert_eq!(levels, [false, true, false], "off, on, and its shutdown value");
        assert_eq!(trace.head.names.pins.values().next().map(String::as_str), Some("led"));
    });
}

#[test]
fn a_stop_leaves_no_memory_behind() {
    wait::in_time(|_| {
        let pinion = Pinion::simulated(&[]);
        let mut client = pinion.configured(&[OUTPUT]);
        (0..20_000).for_each(|_| client.send_line("debug_nop").unwrap());
        client.status().unwrap();
        let before = pinion.memory_kib("RssAnon");
        client.send_line("emergency_stop").unwrap();
        pinion.logged("(pinion trace ");
        pinion.until("its memory again", || pinion.memory_kib("RssAnon") <= before + 1024);
    });
}

/// SIGSTOP stops all threads, as a frozen control group does.
#[test]
fn a_program_that_was_stopped_is_distinguished_from_a_late_host() {
    let pinion = Pinion::simulated(&[]);
    let mut client = pinion.configured(&[OUTPUT]);
    pinion.signal(Signal::SIGSTOP);
    thread::sleep(Duration::from_millis(1500));
    pinion.signal(Signal::SIGCONT);
    assert_eq!(client.wait_shutdown(WAIT_MAX).unwrap().as_deref(), Some("Rescheduled timer in the past"));
    verdict(&pinion, "stood still");
    assert!(!pinion.log().contains("look at the host's load"));
}

/// The guardian keeps the recording of the program.
#[test]
fn a_program_that_was_killed_leaves_its_trace() {
    let pinion = Pinion::start(&["run"]);
    pinion.wait_for_link();
    pinion.configured(&[]);
    pinion.signal(Signal::SIGKILL);
    let trace = verdict(&pinion, "Pinion died");
    assert_eq!(trace.head.end, End::Died);
    assert!(trace.of("core").any(|(_, event)| event == Event::Configured));
    assert!(trace.of("guardian").count() > 0);
    assert!(trace.head.names.commands.values().any(|name| name == "finalize_config"));
}

#[test]
fn a_normal_end_and_an_unused_program_leave_no_trace() {
    let mut pinion = Pinion::simulated(&[]);
    pinion.configured(&[OUTPUT]);
    pinion.signal(Signal::SIGTERM);
    pinion.end();
    assert!(kept(&pinion).is_empty());
    let pinion = Pinion::start(&["run"]);
    pinion.wait_for_link();
    let guardian = guardian(&pinion);
    pinion.signal(Signal::SIGKILL);
    pinion.until("the end of the guardian, which would keep it", || is_gone(guardian));
    assert!(kept(&pinion).is_empty());
}

#[test]
fn a_running_program_gives_its_recording() {
    let pinion = Pinion::simulated(&[]);
    pinion.configured(&[OUTPUT]);
    pinion.until("the MCU's names", || {
        let live = UnixStream::connect(pinion.link().with_extension("trace")).unwrap();
        let trace = Trace::read(live).unwrap();
        assert_eq!(trace.head.end, End::Asked);
        trace.head.names.objects.contains_key(&0)
    });
    let status = Command::new(pinion_path()).args(["status", "-I"]).arg(pinion.link()).output().unwrap();
    let page = String::from_utf8(status.stdout).unwrap();
    assert!(page.contains("\nrecorder  up to "), "{page}");
}

/// Causes of a host's "retransmit" and "Lost communication".
#[test]
fn the_links_answers_and_what_it_refuses_are_recorded() {
    let pinion = Pinion::simulated(&[]);
    let client = pinion.client();
    // Of two blocks with one number, the second came before. Of two blocks behind garbage, one is the expected one at most.
    let mut bytes = Vec::new();
    (0..2).for_each(|_| frame(&[], Sequence::after(0), &mut bytes));
    for number in [9, 3] {
        bytes.extend(b"garbage\x7e");
        frame(&[], Sequence::after(number), &mut bytes);
    }
    fs::OpenOptions::new().write(true).open(pinion.link()).unwrap().write_all(&bytes).unwrap();
    let wanted = [Refusal::Repeated, Refusal::Garbage, Refusal::Lost].map(Event::Refused);
    pinion.until("the refused blocks", || {
        let trace = Trace::read(UnixStream::connect(pinion.link().with_extension("trace")).unwrap()).unwrap();
        let events: Vec<Event> = trace.of("link").map(|(_, event)| event).collect();
        let answered = |name: &str| {
            let is_named = |id| trace.head.names.commands.get(&id).is_some_and(|its| its == name);
            events.iter().any(|event| matches!(event, Event::Answered { id } if is_named(*id)))
        };
        assert!(answered("identify") && answered("get_clock"), "{events:?}");
        events.contains(&Event::Nak) && wanted.iter().all(|event| events.contains(event))
    });
    drop(client);
}

/// A disk that takes no file keeps neither the verdict from the log nor the program from its work.
#[test]
fn a_folder_that_takes_no_file_is_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("state"), "no folder").unwrap();
    let pinion = Pinion::simulated_in(folder);
    let mut client = pinion.configured(&[OUTPUT]);
    client.send_line("emergency_stop").unwrap();
    pinion.logged("nobody was late");
    pinion.logged("the trace of this stop is not kept: ");
    client.reset().unwrap();
    assert!(!client.status().unwrap().is_shutdown);
}

/// The user of the service may put links into its folder. Root's Pinion beside the service must not write through them.
#[test]
fn root_writes_nothing_into_a_folder_of_another_user() {
    if !here::is_root() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (state, victim) = (folder.path().join("state"), folder.path().join("victim"));
    fs::create_dir(&state).unwrap();
    chown(&state, Some(NOBODY), None).unwrap();
    fs::write(&victim, "root's").unwrap();
    let pinion = Pinion::simulated_in(folder);
    symlink(&victim, state.join(format!(".tty.{}", pinion.pid()))).unwrap();
    let mut client = pinion.configured(&[OUTPUT]);
    client.send_line("emergency_stop").unwrap();
    pinion.logged("nobody was late");
    assert_eq!(fs::read(&victim).unwrap(), b"root's");
    assert_eq!(kept(&pinion).len(), 1, "only the link is there");
    pinion.logged("state: the folder belongs to another user, nobody");
}

/// As users of the socket's group may do. A recording is larger than the kernel's buffer for a client.
#[test]
fn clients_that_do_not_read_keep_no_stop_from_its_recording() {
    wait::in_time(|_| {
        let pinion = Pinion::simulated(&["--trace-edges"]);
        let mut client = pinion.configured(&[OUTPUT]);
        let ask = || UnixStream::connect(pinion.link().with_extension("trace")).unwrap();
        let read = |mut stream: UnixStream| {
            let mut bytes = Vec::new();
            stream.read_to_end(&mut bytes).unwrap();
            bytes
        };
        while read(ask()).len() < 300_000 {
            for value in (0..20_000).map(|n| n % 2) {
                client.send_line(&format!("update_digital_out oid=0 value={value}")).unwrap();
            }
            client.status().unwrap();
        }
        let idle = [ask(), ask(), ask()];
        for stream in &idle {
            let mut fds = [PollFd::new(stream.as_fd(), PollFlags::POLLIN)];
            poll(&mut fds, PollTimeout::NONE).unwrap();
        }
        client.send_line("emergency_stop").unwrap();
        verdict(&pinion, "nobody was late");
        for stream in idle {
            let bytes = read(stream);
            // Their recordings would have been cut off by the time limit before the verdict.
            let mut all = Vec::new();
            flate2::read::GzDecoder::new(bytes.as_slice()).read_to_end(&mut all).unwrap();
        }
    });
}

/// Each FIRMWARE_RESTART is a stop that the host asks for.
#[test]
fn restarts_remove_no_recording_of_a_failure() {
    let pinion = Pinion::simulated(&[]);
    let mut client = pinion.configured(&[OUTPUT]);
    let late = client.clock_in(-2.0).unwrap().wire();
    client.send_line(&format!("queue_digital_out oid=0 clock={late} on_ticks=1")).unwrap();
    client.wait_shutdown(WAIT_MAX).unwrap();
    // A busy computer may have had a larger part in it than the host.
    pinion.logged("(pinion trace ");
    let failure = kept(&pinion);
    for count in 1..=12 {
        client.reset().unwrap();
        configure(&mut client, &[OUTPUT]);
        client.send_line("emergency_stop").unwrap();
        pinion.until("the verdict", || pinion.log().matches("nobody was late").count() == count);
    }
    let mut kept = kept(&pinion);
    kept.retain(|path| !path.to_string_lossy().ends_with("-asked.trace"));
    assert_eq!(kept, failure);
    assert_eq!(fs::read_dir(pinion.state()).unwrap().count(), 2);
    pinion.logged("(no trace: such a stop was recorded less than a minute before)");
}

/// A computer without a clock has a wrong time until its network is up.
#[test]
fn a_recording_with_a_time_in_the_future_is_not_the_newest_for_ever() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("state")).unwrap();
    fs::write(folder.path().join("state/tty-99981122T142614.321Z.trace"), "x").unwrap();
    let pinion = Pinion::simulated_in(folder);
    let mut client = pinion.configured(&[OUTPUT]);
    client.send_line("emergency_stop").unwrap();
    pinion.logged("(pinion trace ");
    let mut newest = Command::new(pinion_path());
    let newest = newest.arg("trace").env("STATE_DIRECTORY", pinion.state()).output().unwrap();
    let page = String::from_utf8_lossy(&newest.stdout);
    assert!(page.starts_with("verdict: nobody was late"), "{page}{}", String::from_utf8_lossy(&newest.stderr));
}
