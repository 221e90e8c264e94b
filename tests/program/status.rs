// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion status`: the state of a running MCU. A request does not disturb the MCU.

use std::fs;
use std::io::{Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Instant;

use nix::sys::signal::Signal;
use nix::sys::socket::{AddressFamily, Backlog, SockFlag, SockType, UnixAddr};
use nix::sys::termios::{FlowArg, tcflow};
use pinion_client::Client;
use pinion_testkit::process::Running;
use pinion_testkit::{here, wait};
use serde_json::{Value, json};

use crate::process::{Pinion, WAIT_MAX, as_nobody, exists, pinion_path, printed, program_in};
use crate::terminal::AtTerminal;

/// An answer of a stopped MCU.
const RECORDED: &[u8] = include_bytes!("../../crates/runtime/src/status/recorded.json");

pub fn socket(pinion: &Pinion) -> PathBuf {
    pinion.link().with_file_name("tty.sock")
}

fn ask(pinion: &Pinion, args: &[&str]) -> std::process::Output {
    let link = pinion.link();
    Command::new(pinion_path()).arg("status").args(args).arg("-I").arg(link).output().unwrap()
}

/// The same as text, with the MCU's part: see [`status`].
fn page_of(pinion: &Pinion, args: &[&str]) -> String {
    let whole = || {
        let page = String::from_utf8(ask(pinion, args).stdout).unwrap();
        (!["unknown: the core", "state=\"unknown\"} 1"].iter().any(|late| page.contains(late))).then_some(page)
    };
    wait::until_some(whole, || format!("the MCU's part; the log:\n{}", pinion.log()))
}

/// The whole state. An answer comes without the MCU's part if the core takes over a second for it.
pub fn status(pinion: &Pinion) -> Value {
    let socket = socket(pinion);
    let answer = || {
        let mut text = String::new();
        UnixStream::connect(&socket).ok()?.read_to_string(&mut text).ok()?;
        let status: Value = serde_json::from_str(&text).ok()?;
        status["objects"].is_array().then_some(status)
    };
    wait::until_some(answer, || format!("an answer of {}; the log:\n{}", socket.display(), pinion.log()))
}

pub fn line<'a>(status: &'a Value, pin: &str) -> &'a Value {
    let lines = status["lines"].as_array().unwrap();
    lines.iter().find(|line| line["pin"] == pin).unwrap_or_else(|| panic!("no {pin} in {lines:?}"))
}

const CONFIGURATION: &[&str] = &[
    "config_digital_out oid=0 pin=led value=0 default_value=0 max_duration=0",
    "config_endstop oid=1 pin=x_endstop pull_up=1",
    "config_analog_in oid=2 pin=bed_sensor",
    "config_stepper oid=3 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100",
];

/// A client that has configured the MCU and got a measurement after some seconds.
fn measured(pinion: &Pinion, seconds: f64) -> Client {
    let mut client = pinion.configured(CONFIGURATION);
    client.send_line("update_digital_out oid=0 value=1").unwrap();
    let clock = client.clock_in(seconds).unwrap().wire();
    // An edge, for which the core must be awake.
    client.send_line(&format!("queue_digital_out oid=0 clock={clock} on_ticks=1")).unwrap();
    client.send_line(&format!("query_analog_in oid=2 clock={clock} sample_ticks=0 sample_count=1 rest_ticks=500000 bytes_per_report=4 min_value=0 max_value=65535 range_check_count=0")).unwrap();
    assert!(client.status().unwrap().is_config);
    assert!(client.wait("analog_in_state", Some(2), Instant::now() + WAIT_MAX).unwrap().is_some());
    client
}

#[test]
fn an_mcu_reports_its_state_in_each_phase() {
    wait::in_time(|seconds| {
        let mut pinion = Pinion::simulated(&["--dialect", "master"]);
        let socket = socket(&pinion);
        pinion.until("the socket", || exists(&socket));
        let waiting = status(&pinion);
        assert_eq!(waiting["state"], "waiting");
        assert_eq!(waiting["pid"], pinion.pid());
        let version = printed(&["--version"]);
        assert_eq!(
            waiting["version"],
            version.trim().strip_prefix("pinion ").unwrap(),
            "the build's, not the package's"
        );
        assert_eq!(waiting["link"], pinion.link().to_str().unwrap());
        assert_eq!((&waiting["host"]["attached"], &waiting["shutdown"]), (&json!(false), &Value::Null));
        assert_eq!(waiting["guardian"]["present"], false, "the simulated printer needs none");
        assert_eq!(waiting["dialect"], "master");

        let mut client = measured(&pinion, seconds);
        client.send_line("endstop_query_state oid=1").unwrap();
        client.link().settle().unwrap();
        let configured = status(&pinion);
        assert_eq!(configured["state"], "configured");
        assert_eq!(configured["host"]["attached"], true);
        assert_eq!(*line(&configured, "led"), json!({ "pin": "led", "use": "output", "level": 1, "bus": null }));
        assert_eq!(*line(&configured, "x_step"), json!({ "pin": "x_step", "use": "output", "level": 0, "bus": null }));
        let stop = line(&configured, "x_endstop");
        assert_eq!(stop["use"], "input");
        assert!(stop["level"].is_u64(), "it was sampled: {stop}");
        let objects = configured["objects"].as_array().unwrap();
        assert_eq!(objects.len(), 4);
        assert_eq!(objects[0]["kind"], "digital output");
        assert_eq!((&objects[2]["oid"], &objects[2]["pin"]), (&json!(2), &json!("bed_sensor")));
        let share = objects[2]["value"]["adc"].as_f64().unwrap();
        assert!(share > 0.0 && share < 1.0, "{share}");
        assert!(objects[2]["bus"]["transfers"].as_u64().is_some_and(|transfers| transfers > 0), "{}", objects[2]);
        assert_eq!(objects[3]["value"]["steps"], 0);
        assert_eq!(configured["queues"]["moves"], json!({ "waiting": 0, "size": 1024 }));
        let timers = configured["lateness"]["timers"].as_u64().unwrap();
        let buckets = configured["lateness"]["buckets_us"].as_array().unwrap();
        assert_eq!(buckets.iter().map(|bucket| bucket[1].as_u64().unwrap()).sum::<u64>(), timers);
        assert_eq!(timers, 1, "the edge, and none of the samples");

        client.emergency_stop().unwrap();
        let stopped = status(&pinion);
        assert_eq!(stopped["state"], "shutdown");
        assert_eq!(stopped["shutdown"]["reason"], "Command request");
        // The log has the same text.
        let logged = pinion.logged("shutdown: Command request: ");
        assert!(logged.ends_with(stopped["shutdown"]["detail"].as_str().unwrap()), "{logged}\n{stopped}");
        assert_eq!(line(&stopped, "led")["level"], 0);
        let page = page_of(&pinion, &[]);
        let (_, since) = page.split_once("SHUT DOWN ").unwrap_or_else(|| panic!("{page}"));
        let (seconds, reason) = since.split_once(" s ago: ").unwrap_or_else(|| panic!("{page}"));
        assert!(seconds.parse::<u32>().is_ok() && reason.starts_with("Command request: "), "{page}");
        let metrics = page_of(&pinion, &["--prometheus"]);
        assert!(metrics.contains("\npinion_state{state=\"shutdown\"} 1\n"), "{metrics}");

        assert_eq!(fs::metadata(&socket).unwrap().permissions().mode() & 0o777, 0o660);
        pinion.signal(Signal::SIGTERM);
        assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
        assert!(!exists(&socket));
        let gone = ask(&pinion, &[]);
        assert_eq!(gone.status.code(), Some(1));
        assert!(String::from_utf8_lossy(&gone.stderr).contains("no Pinion answers on"), "{gone:?}");
    });
}

#[test]
fn each_of_two_instances_has_a_socket_and_none_takes_the_others() {
    let first = Pinion::simulated(&[]);
    first.until("the socket", || exists(&socket(&first)));
    let path = socket(&first);
    let second = Pinion::simulated(&["--socket", path.to_str().unwrap()]);
    let refused = second.logged("pinion status will not be answered");
    assert!(refused.contains("another Pinion answers there"), "{refused}");
    second.client().status().unwrap();
    assert_eq!(status(&first)["pid"], first.pid());
    let third = Pinion::simulated(&[]);
    third.until("the socket", || exists(&socket(&third)));
    assert_eq!(status(&third)["pid"], third.pid());
    assert_eq!(status(&first)["pid"], first.pid());
}

#[test]
fn what_a_killed_instance_left_is_replaced() {
    let kept = tempfile::tempdir().unwrap();
    let path = kept.path().join("s.sock");
    drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
    let pinion = Pinion::simulated(&["--socket", path.to_str().unwrap()]);
    pinion.logged("status on");
    assert!(fs::metadata(&path).unwrap().file_type().is_socket());
    UnixStream::connect(&path).unwrap();
}

#[test]
fn clients_that_do_not_read_or_talk_rubbish_or_are_many_disturb_nobody() {
    let pinion = Pinion::simulated(&[]);
    let path = socket(&pinion);
    pinion.until("the socket", || exists(&path));
    let mut client = pinion.configured(CONFIGURATION);
    // None of these clients reads, some send data, some leave at once.
    let mut silent = Vec::new();
    for n in 0..200 {
        let Ok(mut socket) = UnixStream::connect(&path) else { continue };
        if n % 3 == 0 {
            let _ = socket.write_all(&[0xff; 5000]);
        }
        if n % 2 == 0 {
            silent.push(socket);
        }
    }
    let files = fs::read_dir(format!("/proc/{}/fd", pinion.pid())).unwrap().count();
    assert!(files < 100, "{files} files are open");
    assert_eq!(status(&pinion)["state"], "configured");
    let status = client.status().unwrap();
    assert!(status.is_config && !status.is_shutdown);
    // The unread status is still there, and complete.
    let mut last = String::new();
    silent.pop().unwrap().read_to_string(&mut last).ok();
    assert!(last.is_empty() || serde_json::from_str::<Value>(&last).is_ok(), "{last}");
}

fn watch(pinion: &Pinion) -> Command {
    pinion.until("the socket", || exists(&socket(pinion)));
    let mut command = Command::new(pinion_path());
    command.args(["status", "--watch", "-I"]).arg(pinion.link());
    command
}

/// `pinion status --watch` at a terminal, as soon as it shows a page.
fn watch_at_terminal(pinion: &Pinion) -> AtTerminal {
    let mut terminal = AtTerminal::start(&mut watch(pinion), 40, None);
    terminal.until("q ends");
    terminal
}

#[test]
fn watching_goes_on_until_q_and_gives_the_terminal_back() {
    let pinion = Pinion::simulated(&[]);
    let mut watch = watch_at_terminal(&pinion);
    watch.until("waiting for a host's configuration");
    assert!(watch.gives_keys());
    watch.press("q");
    assert!(watch.ended().success() && watch.is_given_back());
    assert!(watch.shown().ends_with("\x1b[?7h\x1b[?25h\x1b[?1049l"), "{:?}", watch.shown());
}

#[test]
fn a_page_that_is_longer_than_the_terminal_is_scrolled_by_keys() {
    let pinion = Pinion::simulated(&[]);
    let mut watch = AtTerminal::start(&mut watch(&pinion), 5, None);
    watch.until("lines 1 to 4 of ");
    for (key, shown) in [
        ("\x1b[B", "lines 2 to 5 of "),
        ("\x1b[A", "lines 1 to 4 of "),
        ("\x1b[6~", "lines 4 to 7 of "),
        ("\x1b[H", "lines 1 to 4 of "),
        ("q", "\x1b[?1049l"),
    ] {
        watch.press(key);
        watch.until(shown);
    }
    assert!(watch.ended().success());
}

#[test]
fn keys_that_arrive_together_all_count() {
    let pinion = Pinion::simulated(&[]);
    let mut watch = AtTerminal::start(&mut watch(&pinion), 5, None);
    watch.until("lines 1 to 4 of ");
    watch.press("jjj");
    watch.until("lines 4 to 7 of ");
    watch.press("\x1b[A\x1b[Akq");
    assert!(watch.ended().success());
    assert!(watch.shown().contains("lines 3 to 6 of "), "the keys before q, too: {:?}", watch.shown());
}

#[test]
fn a_narrow_terminal_shows_the_whole_reason_of_a_shutdown() {
    let pinion = Pinion::simulated(&[]);
    let mut client = pinion.configured(CONFIGURATION);
    client.emergency_stop().unwrap();
    let detail = status(&pinion)["shutdown"]["detail"].as_str().unwrap().to_owned();
    let mut watch = AtTerminal::start(&mut watch(&pinion), 60, None);
    watch.resize(60, 40);
    // The foot has no line feed.
    let page = watch.wait_for("a page of the new size", |watch| {
        let shown = watch.shown();
        let pages: Vec<&str> = shown.split("\x1b[1;1H").collect();
        let page = pages[..pages.len() - 1].last()?.replace("\x1b[0K", "");
        let rows: Vec<&str> = page.lines().map(|row| row.trim_end_matches('\r')).collect();
        (pages.len() > 2 && rows.iter().all(|row| row.chars().count() <= 40)).then_some(page.clone())
    });
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words(&page).contains(&words(&detail)), "{page}");
}

#[test]
fn what_is_measured_is_first_and_pins_are_last() {
    wait::in_time(|seconds| {
        let pinion = Pinion::simulated(&["--dialect", "master"]);
        let _client = measured(&pinion, seconds);
        let page = page_of(&pinion, &[]);
        let row =
            |text: &str| page.lines().position(|line| line.contains(text)).unwrap_or_else(|| panic!("{text}: {page}"));
        assert_eq!(row("objects "), row("bed_sensor"), "{page}");
        assert!(row("bed_sensor") < row("digital output") && row("x_dir") > row("lines "), "{page}");
        assert!(row("lines ") > row("stepper"), "{page}");
    });
}

#[test]
fn the_folder_is_the_one_that_takes_recordings() {
    let folder = tempfile::tempdir().unwrap();
    let (none, state) = (folder.path().join("none"), folder.path().join("state"));
    // A file is no folder, even for root.
    fs::write(&none, "").unwrap();
    fs::create_dir(&state).unwrap();
    let link = folder.path().join("tty");
    let child = Command::new(pinion_path())
        .args(["run", "--board", "sim", "-I"])
        .arg(&link)
        .env("STATE_DIRECTORY", format!("{}:{}", none.display(), state.display()))
        .stderr(Stdio::null())
        .spawn();
    let _child = Running(child.unwrap());
    wait::until("the socket", || exists(&link.with_file_name("tty.sock")));
    let asked = Command::new(pinion_path()).args(["status", "--json", "-I"]).arg(&link).output().unwrap();
    let status: Value = serde_json::from_slice(&asked.stdout).unwrap();
    assert_eq!(status["recorder"]["folder"], state.to_str().unwrap());
}

/// Any user can make such a link in /tmp, where the socket is if nobody has made a better place.
#[test]
fn a_link_to_another_socket_makes_nobody_a_member_of_its_group() {
    if !here::is_root() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
    let [other, link] = ["docker.sock", "pinion-mcu.sock"].map(|name| folder.path().join(name));
    let _listener = UnixListener::bind(&other).unwrap();
    // The group `disk`.
    std::os::unix::fs::chown(&other, None, Some(6)).unwrap();
    fs::set_permissions(&other, fs::Permissions::from_mode(0o660)).unwrap();
    std::os::unix::fs::symlink(&other, &link).unwrap();
    let mut status = Command::new(program_in(folder.path()));
    let refused = as_nobody(status.args(["status", "--socket"]).arg(&link)).output().unwrap();
    let log = String::from_utf8_lossy(&refused.stderr);
    assert!(
        log.contains("may not be opened by this user: name the link of a Pinion") && !log.contains("sudo"),
        "{log}"
    );
}

/// Other clients also ask, more than fit into the socket's queue.
#[test]
fn a_crowd_is_waited_for_and_then_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mcu.sock");
    let socket_of = |flags| nix::sys::socket::socket(AddressFamily::Unix, SockType::Stream, flags, None).unwrap();
    let address = UnixAddr::new(&path).unwrap();
    let listener = socket_of(SockFlag::SOCK_CLOEXEC);
    nix::sys::socket::bind(listener.as_raw_fd(), &address).unwrap();
    nix::sys::socket::listen(&listener, Backlog::new(1).unwrap()).unwrap();
    let listener = UnixListener::from(listener);
    let crowd: Vec<_> = std::iter::from_fn(|| {
        let client = socket_of(SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK);
        nix::sys::socket::connect(client.as_raw_fd(), &address).is_ok().then_some(client)
    })
    .collect();
    let ask = || {
        let mut command = Command::new(pinion_path());
        command.args(["status", "--socket"]).arg(&path).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let refused = ask().wait_with_output().unwrap();
    let log = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && log.contains("mcu.sock for its status at once: end some of them"), "{log}");
    let waiting = ask();
    // It sleeps between its tries, and hardly before them.
    let switches = || {
        let status = fs::read_to_string(format!("/proc/{}/status", waiting.id())).unwrap();
        let count = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:")).unwrap();
        count.trim().parse::<u32>().unwrap()
    };
    wait::until("some tries", || switches() >= 20);
    for _ in 0..=crowd.len() {
        let (mut client, _) = listener.accept().unwrap();
        // The crowd does not read.
        let _ = client.write_all(RECORDED);
    }
    let answered = waiting.wait_with_output().unwrap();
    let page = String::from_utf8_lossy(&answered.stdout);
    assert!(answered.status.success() && page.contains("ago: Command request: "), "{page}");
}

#[test]
fn keys_that_the_kernel_makes_signals_of_leave_no_terminal_behind() {
    let pinion = Pinion::simulated(&[]);
    // Ctrl-C, and Ctrl-\\, which kills a program by default.
    for key in ["\x03", "\x1c"] {
        let mut watch = watch_at_terminal(&pinion);
        watch.press(key);
        assert!(watch.ended().success() && watch.is_given_back());
    }
}

#[test]
fn a_key_that_stops_it_gives_the_terminal_back_until_it_goes_on() {
    let pinion = Pinion::simulated(&[]);
    let mut watch = watch_at_terminal(&pinion);
    watch.press("\x1a");
    watch.until("\x1b[?1049l");
    let stat = format!("/proc/{}/stat", watch.pid());
    let is_stopped = || fs::read_to_string(&stat).unwrap().rsplit_once(") ").unwrap().1.starts_with('T');
    wait::until("the stop", is_stopped);
    assert!(watch.is_given_back());
    watch.signal(Signal::SIGCONT);
    watch.until("\x1b[?1049h");
    watch.press("q");
    assert!(watch.ended().success() && watch.is_given_back());
}

#[test]
fn a_terminal_that_is_gone_ends_it() {
    let pinion = Pinion::simulated(&[]);
    let mut watch = watch_at_terminal(&pinion);
    watch.hang_up();
    watch.ended();
}

#[test]
fn a_terminal_that_takes_no_output_does_not_keep_it_from_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mcu.sock");
    let listener = UnixListener::bind(&path).unwrap();
    let answer = || {
        let (mut client, _) = listener.accept().unwrap();
        client.write_all(RECORDED).unwrap();
    };
    let mut command = Command::new(pinion_path());
    let mut watch = AtTerminal::start(command.args(["status", "--watch", "--socket"]).arg(&path), 40, None);
    answer();
    watch.until("q ends");
    // As with Ctrl-S. The next page finds no room.
    tcflow(watch.slave(), FlowArg::TCOOFF).unwrap();
    answer();
    watch.signal(Signal::SIGTERM);
    assert_eq!(watch.ended().signal(), Some(Signal::SIGTERM as i32));
    assert!(watch.is_given_back());
}

#[test]
fn watching_into_a_pipe_is_a_page_each_second() {
    let pinion = Pinion::simulated(&[]);
    let mut watch = watch(&pinion).stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
    let mut out = watch.stdout.take().unwrap();
    let (mut shown, mut piece) = (String::new(), [0; 4096]);
    while shown.matches("\nstate ").count() < 2 {
        let read = out.read(&mut piece).unwrap();
        assert!(read > 0, "{shown}");
        shown += &String::from_utf8_lossy(&piece[..read]);
    }
    assert!(!shown.contains('\x1b'));
    // It ends when its reader has gone.
    drop(out);
    wait::until("its end", || watch.try_wait().unwrap().is_some());
}
