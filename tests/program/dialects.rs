// SPDX-License-Identifier: GPL-3.0-or-later
//! Hosts of several dialects, recognized by their sources. A shell with klippy's name has the pty open, and our own
//! client sends klippy's messages.

use std::fs;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::Client;
use pinion_client::config::Config;
use pinion_testkit::process::Running;
use pinion_testkit::{here, wait};
use serde_json::Value;
use tempfile::TempDir;

use crate::process::{Pinion, output};
use crate::search::{field, search_of};

/// The form of `query_analog_in` up to v0.13, and the present form.
const ONE_VALUE: &str = "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u min_value=%hu max_value=%hu range_check_count=%c";
const MANY_VALUES: &str = "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c min_value=%hu max_value=%hu range_check_count=%c";

/// A checkout that looks up the messages of a dialect's dictionary.
struct Checkout(TempDir);

impl Checkout {
    fn of(dialect: &str) -> Checkout {
        let checkout = Checkout(tempfile::tempdir().unwrap());
        checkout.change(dialect, |formats| formats);
        checkout
    }

    /// Replaces these sources by those of another host.
    fn change(&self, dialect: &str, change: impl Fn(String) -> String) {
        let dictionary = output(&["dict", "--board", "sim", "--dialect", dialect]).stdout;
        let dictionary: Value = serde_json::from_slice(&dictionary).unwrap();
        let formats = ["commands", "responses"].iter().flat_map(|kind| dictionary[kind].as_object().unwrap().keys());
        let lookups: Vec<String> = formats.map(|format| format!("lookup(\"{format}\")\n")).collect();
        fs::create_dir_all(self.program().parent().unwrap()).unwrap();
        fs::write(self.program(), "# A shell opens this and does nothing with it.\n").unwrap();
        fs::write(self.program().with_file_name("mcu.py"), change(lookups.concat())).unwrap();
    }

    fn program(&self) -> PathBuf {
        self.0.path().join("klippy/klippy.py")
    }
}

/// A process with klippy's name. Each input line makes it open or close the pty.
struct Host(Running);

impl Host {
    fn start(pinion: &Pinion, checkout: &Checkout) -> Host {
        let script = format!(
            "while true; do read line; exec 3<>{tty}; echo open; read line; exec 3>&-; echo closed; done",
            tty = pinion.link().display()
        );
        let child = Command::new("/bin/sh")
            .args(["-c", &script, "python3"])
            .arg(checkout.program())
            .arg("printer.cfg")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut host = Host(Running(child));
        host.turn("open");
        host
    }

    /// Opens or closes the pty, and waits for the result.
    fn turn(&mut self, done: &str) {
        use std::io::{BufRead, BufReader};
        writeln!(self.0.0.stdin.as_mut().unwrap()).unwrap();
        let mut answer = String::new();
        BufReader::new(self.0.0.stdout.as_mut().unwrap()).read_line(&mut answer).unwrap();
        assert_eq!(answer.trim_end(), done);
    }

    /// A client that got the host's dictionary. If the computer stalls for seconds, the search is late and the client
    /// gets the union: the host opens the pty once more then, as klippy's RESTART does.
    fn client(&mut self, pinion: &Pinion) -> Client {
        loop {
            let client = pinion.client();
            let log = pinion.log();
            if !log.rsplit("host gone").next().unwrap().contains("the host's messages were not found within") {
                return client;
            }
            until_once_more(pinion, "host gone", || {
                drop(client);
                self.turn("closed");
            });
            self.turn("open");
        }
    }
}

/// Counts a text in the log, and waits for one more after `act`.
fn until_once_more<T>(pinion: &Pinion, text: &str, act: impl FnOnce() -> T) -> T {
    let count = || pinion.log().matches(text).count();
    let before = count();
    let result = act();
    pinion.until(text, || count() > before);
    result
}

#[test]
fn each_host_gets_the_dictionary_of_its_dialect() {
    let pinion = Pinion::simulated(&[]);
    for dialect in ["v0.11", "v0.12", "v0.13", "master", "kalico"] {
        let checkout = Checkout::of(dialect);
        let mut host = Host::start(&pinion, &checkout);
        let client = host.client(&pinion);
        let commands = &client.dictionary().commands;
        let wanted = if dialect == "master" { MANY_VALUES } else { ONE_VALUE };
        assert!(commands.contains_key(wanted), "{dialect}: {commands:?}");
        assert_eq!(commands.contains_key("config_lis2dw oid=%c spi_oid=%c"), dialect == "v0.12");
        let folder = checkout.0.path().to_str().unwrap();
        let line = pinion.logged(&format!("the host is klippy of {folder}, process {}", host.0.0.id()));
        assert!(line.contains(": it gets each message that it looks up (found in "), "{line}");
        until_once_more(&pinion, "host gone", || drop((client, host)));
    }
}

#[test]
fn a_host_that_is_no_klippy_gets_what_most_hosts_take() {
    let pinion = Pinion::simulated(&[]);
    let client = pinion.client();
    // The host is this process.
    let pid = std::process::id();
    pinion
        .logged(&format!("the host, process {pid}, is not a klippy: it is served as Klipper v0.13, master and Kalico"));
    // Today's hosts also accept the older form.
    assert!(client.dictionary().commands.contains_key(ONE_VALUE));
    until_once_more(&pinion, "host gone", || drop(client));
    let checkout = Checkout::of("v0.12");
    fs::remove_file(checkout.program().with_file_name("mcu.py")).unwrap();
    let mut host = Host::start(&pinion, &checkout);
    pinion.client();
    pinion.logged("it does not hold klippy's sources: it is served as Klipper v0.13, master and Kalico");
    // A process that was unknown once is examined again.
    until_once_more(&pinion, "host gone", || host.turn("closed"));
    checkout.change("v0.12", |sources| sources);
    host.turn("open");
    let client = host.client(&pinion);
    assert!(client.dictionary().commands.contains_key("config_lis2dw oid=%c spi_oid=%c"), "{}", pinion.log());
}

#[test]
fn a_host_that_is_named_for_mischief_gets_its_dialect_and_no_line_of_its_own() {
    let pinion = Pinion::simulated(&[]);
    let folder = tempfile::Builder::new().prefix("x\n<0>forged\x1b[2J\u{9b}31m\r").tempdir().unwrap();
    let checkout = Checkout(folder);
    checkout.change("v0.12", |formats| formats);
    // Git's file is a pipe without a writer.
    fs::create_dir(checkout.0.path().join(".git")).unwrap();
    nix::unistd::mkfifo(&checkout.0.path().join(".git/HEAD"), nix::sys::stat::Mode::S_IRWXU).unwrap();
    let mut host = Host::start(&pinion, &checkout);
    assert!(host.client(&pinion).dictionary().commands.contains_key("config_lis2dw oid=%c spi_oid=%c"));
    let line = pinion.logged("the host is klippy of ");
    assert!(line.contains("/x?<0>forged?[2J?31m?") && line.contains("it gets each message"), "{line}");
    let log = pinion.log();
    assert!(!log.contains(|c: char| c.is_control() && c != '\n'), "{log:?}");
    assert!(!log.lines().any(|line| line.starts_with("<0>")), "{log:?}");
}

#[test]
fn a_dialect_that_is_named_is_spoken_whoever_comes() {
    let pinion = Pinion::simulated(&["--dialect", "v0.12"]);
    let checkout = Checkout::of("master");
    let _host = Host::start(&pinion, &checkout);
    let client = pinion.client();
    assert!(client.dictionary().commands.contains_key(ONE_VALUE));
    assert!(client.dictionary().commands.values().all(|id| (-32..96).contains(&id.as_i64().unwrap())));
}

/// The reading of a thermistor, with a dialect's message.
fn read_temperature(pinion: &Pinion, host: &mut Host, query: &str) -> String {
    wait::in_time(|seconds| {
        let mut client = host.client(pinion);
        let mut config = Config::default();
        let oid = config.oid().unwrap();
        config.add(format!("config_analog_in oid={oid} pin=bed_sensor"));
        // klippy finds out that another host configured the MCU as this client does: from the checksum. It then resets
        // the MCU.
        config.apply(&mut client).unwrap();
        let clock = client.clock_in(seconds).unwrap();
        client.send_line(&format!("query_analog_in oid={oid} clock={} {query}", clock.wire())).unwrap();
        let state = client.wait("analog_in_state", Some(oid), std::time::Instant::now() + crate::process::WAIT_MAX);
        format!("{:?}", state.unwrap().unwrap())
    })
}

#[test]
fn a_host_that_was_updated_is_served_at_its_next_start_though_the_mcu_is_configured() {
    let pinion = Pinion::simulated(&[]);
    let checkout = Checkout::of("v0.13");
    let mut host = Host::start(&pinion, &checkout);
    let state = read_temperature(
        &pinion,
        &mut host,
        "sample_ticks=5000 sample_count=4 rest_ticks=500000 min_value=0 max_value=20000 range_check_count=4",
    );
    assert!(state.contains("\"value\"") || state.contains("value:"), "{state}");
    until_once_more(&pinion, "host gone", || drop(host));
    checkout.change("master", |sources| sources);
    let mut host = Host::start(&pinion, &checkout);
    let state = read_temperature(
        &pinion,
        &mut host,
        "sample_ticks=5000 sample_count=4 rest_ticks=500000 bytes_per_report=2 min_value=0 max_value=20000 range_check_count=4",
    );
    assert!(state.contains("values"), "{state}");
}

#[test]
fn a_process_goes_on_with_the_sources_that_it_has_loaded() {
    let pinion = Pinion::simulated(&[]);
    let checkout = Checkout::of("v0.13");
    let mut host = Host::start(&pinion, &checkout);
    assert!(host.client(&pinion).dictionary().commands.contains_key(ONE_VALUE));
    // klippy's RESTART closes the pty and opens it again, after an update of the files.
    until_once_more(&pinion, "host gone", || host.turn("closed"));
    checkout.change("master", |sources| sources);
    host.turn("open");
    assert!(host.client(&pinion).dictionary().commands.contains_key(ONE_VALUE));
    pinion.logged(&format!("the host is the one of before, process {}", host.0.0.id()));
}

/// Configures the MCU, and stops it.
fn configure_and_stop(pinion: &Pinion) {
    let mut client = pinion.client();
    let mut config = Config::default();
    let oid = config.oid().unwrap();
    config.add(format!("config_analog_in oid={oid} pin=bed_sensor"));
    config.apply(&mut client).unwrap();
    until_once_more(pinion, "shutdown: ", || client.send_line("emergency_stop").unwrap());
}

fn is_shutdown(pinion: &Pinion) -> bool {
    pinion.client().status().unwrap().is_shutdown
}

#[test]
fn a_new_process_of_the_host_finds_a_fresh_mcu_and_the_same_one_does_not() {
    wait::in_time(|_| {
        const RENEWED: &str = "the host's process is gone and another has come: the MCU is reset for it";
        let pinion = Pinion::simulated(&[]);
        let checkout = Checkout::of("master");
        let mut host = Host::start(&pinion, &checkout);
        configure_and_stop(&pinion);
        until_once_more(&pinion, "host gone", || host.turn("closed"));
        host.turn("open");
        assert!(is_shutdown(&pinion), "RESTART keeps the process");
        assert!(!pinion.log().contains(RENEWED));
        until_once_more(&pinion, "host gone", || drop(host));
        let mut host = Host::start(&pinion, &checkout);
        assert!(!is_shutdown(&pinion), "a new process");
        pinion.logged(RENEWED);
        // A process that looks in while the host lives changes nothing.
        configure_and_stop(&pinion);
        until_once_more(&pinion, "host gone", || host.turn("closed"));
        let other = Host::start(&pinion, &checkout);
        assert!(is_shutdown(&pinion), "the host lives");
        until_once_more(&pinion, "host gone", || drop(other));
        host.turn("open");
        assert!(is_shutdown(&pinion), "the host of before");
    });
}

/// Somebody writes FORCE_SHUTDOWN while the search still looks at the new host.
#[test]
fn a_new_process_of_the_host_sees_a_stop_that_came_after_it() {
    let pinion = Pinion::simulated(&[]);
    let checkout = Checkout::of("master");
    let host = Host::start(&pinion, &checkout);
    let client = pinion.configured(&["config_analog_in oid=0 pin=bed_sensor"]);
    until_once_more(&pinion, "host gone", || drop((client, host)));
    let search = Pid::from_raw(search_of(pinion.pid()).unwrap() as i32);
    kill(search, Signal::SIGSTOP).unwrap();
    let host = Host::start(&pinion, &checkout);
    until_once_more(&pinion, "FORCE_SHUTDOWN was written", || {
        fs::OpenOptions::new().write(true).open(pinion.link()).unwrap().write_all(b"FORCE_SHUTDOWN\n").unwrap();
        kill(search, Signal::SIGCONT).unwrap();
    });
    assert!(is_shutdown(&pinion), "{}", pinion.log());
    drop(host);
}

#[test]
fn what_a_newer_host_will_miss_is_named_by_the_log_and_by_the_doctor() {
    let pinion = Pinion::simulated(&[]);
    let checkout = Checkout::of("master");
    checkout.change("master", |sources| {
        sources.replace("query_adxl345 oid=%c rest_ticks=%u", "query_adxl345 oid=%c rest_ticks=%u range=%c")
    });
    let mut host = Host::start(&pinion, &checkout);
    assert!(host.client(&pinion).dictionary().commands.contains_key(MANY_VALUES), "the others work");
    pinion.logged(": it gets all but 1 messages that it looks up (found in ");
    let line = pinion.logged("the host is newer than Pinion");
    assert!(line.contains(" for ADXL345 accelerometers: query_adxl345 oid rest_ticks range: "), "{line}");
    // An empty root, so that no file of this computer counts.
    let system = tempfile::tempdir().unwrap();
    let root = system.path().to_str().unwrap();
    let doctor = |folder: &Path| output(&["doctor", "--root", root, "--klipper", folder.to_str().unwrap()]);
    let newer = doctor(checkout.0.path());
    let report = String::from_utf8_lossy(&newer.stdout).into_owned();
    assert_eq!(newer.status.code(), Some(1), "{report}");
    assert!(report.contains("\n  ADXL345 accelerometers\n    query_adxl345 oid rest_ticks range\n"), "{report}");
    checkout.change("v0.12", |sources| sources);
    let known = doctor(checkout.program().parent().unwrap());
    let report = String::from_utf8_lossy(&known.stdout).into_owned();
    assert_eq!(known.status.code(), Some(0), "{report}");
    assert!(
        report.contains("ok: this host gets each message that it looks up, in a form that it looks up"),
        "{report}"
    );
    let none = doctor(Path::new("/nonexistent"));
    assert_eq!(none.status.code(), Some(1));
    let error = String::from_utf8_lossy(&none.stderr).into_owned();
    assert!(error.contains("/nonexistent") && error.contains("name a checkout of Klipper or Kalico"), "{error}");
}

/// All capabilities that any thread of a process has, could take or would pass on.
fn capabilities(pid: u32) -> u64 {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).unwrap().map(|thread| thread.unwrap().path());
    threads
        .flat_map(|thread| ["CapEff", "CapPrm", "CapInh", "CapAmb"].map(|set| field(&thread, set)))
        .fold(0, |all, set| all | u64::from_str_radix(&set, 16).unwrap())
}

#[test]
fn a_host_of_another_user_is_read_where_that_is_permitted_and_else_the_log_says_what_it_takes() {
    if !nix::unistd::geteuid().is_root() {
        return here::not_run("only root can start a host of another user");
    }
    wait::in_time(|_| {
        /// CAP_DAC_READ_SEARCH and CAP_SYS_PTRACE.
        const LOOKS: u64 = 1 << 2 | 1 << 19;
        for may_look in [true, false] {
            // A user's home that nobody else may enter, with a klippy.
            let checkout = Checkout::of("v0.12");
            for path in [checkout.0.path(), checkout.program().parent().unwrap()] {
                std::os::unix::fs::chown(path, Some(12_345), Some(12_345)).unwrap();
            }
            fs::set_permissions(checkout.0.path(), fs::Permissions::from_mode(0o700)).unwrap();
            let folder = tempfile::tempdir().unwrap();
            fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o777)).unwrap();
            let program = crate::process::program_in(folder.path());
            let tty = folder.path().join("tty");
            let log = folder.path().join("log");
            let capabilities_given = if may_look { "+sys_ptrace,+dac_read_search" } else { "-all" };
            let pinion = Command::new("setpriv")
                .args(["--reuid=65534", "--regid=65534", "--clear-groups"])
                .arg(format!("--inh-caps={capabilities_given}"))
                .arg(format!("--ambient-caps={capabilities_given}"))
                .arg(&program)
                .args(["run", "--board", "sim", "-m", "0666", "-I"])
                .arg(&tty)
                .stdout(Stdio::null())
                .stderr(fs::File::create(&log).unwrap())
                .spawn();
            let pinion = Running(pinion.unwrap());
            let log = || fs::read_to_string(&log).unwrap();
            let until = |what: &str| {
                let line = || log().lines().find(|line| line.contains(what)).map(str::to_owned);
                wait::until_some(line, || format!("{what}:\n{}", log()))
            };
            until("serving on");
            let script = format!("exec 3<>{}; echo open; read line", tty.display());
            let host = Command::new("setpriv")
                .args(["--reuid=12345", "--regid=12345", "--clear-groups", "/bin/sh", "-c", &script, "python3"])
                .arg(checkout.program())
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn();
            let mut host = Running(host.unwrap());
            std::io::Read::read_exact(host.0.stdout.as_mut().unwrap(), &mut [0; 4]).unwrap();
            // The test's own client belongs to root, so it is hidden too. It is not klippy.
            let client = pinion_client::Client::connect(&tty, crate::process::WAIT_MAX).unwrap();
            let has_it = client.dictionary().commands.contains_key("config_lis2dw oid=%c spi_oid=%c");
            assert_eq!(has_it, may_look, "{}", log());
            if may_look {
                let line = until("the host is klippy of ");
                assert!(line.contains(&format!("process {}: it gets each message", host.0.id())), "{line}");
                let search = search_of(pinion.0.id()).unwrap();
                assert_eq!((capabilities(pinion.0.id()), capabilities(search)), (0, LOOKS));
                // Another process of its user cannot get at them through its memory: the kernel asks for the same rights.
                let other = Command::new("setpriv")
                    .args(["--reuid=65534", "--regid=65534", "--clear-groups", "dd", "count=1", "of=/dev/null"])
                    .arg(format!("if=/proc/{search}/environ"))
                    .output()
                    .unwrap();
                assert!(String::from_utf8_lossy(&other.stderr).contains("Permission denied"), "{other:?}");
            } else {
                // Other klippys may run here, and they are hidden as well.
                until("CAP_SYS_PTRACE and CAP_DAC_READ_SEARCH, as pinion-mcu.service has them");
            }
        }
    });
}
