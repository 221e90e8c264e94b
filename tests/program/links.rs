// SPDX-License-Identifier: GPL-3.0-or-later
//! The ways to a host on another computer: a serial line and standard input.

use std::fs;
use std::io::Read;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};

use nix::fcntl::OFlag;
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::signal::Signal;
use nix::unistd::geteuid;
use pinion_client::Client;
use pinion_client::serial::{BlockLink, Port};
use pinion_testkit::wait;
use tempfile::TempDir;

use crate::process::{Pinion, WAIT_MAX, pinion_path};
use crate::slow::cut::begin;
use crate::terminal::AtTerminal;

/// A pseudo terminal in place of a serial port. The test has the host's end. The port's name is a link, so that the
/// next one may have the same name.
pub fn plug_in(folder: &TempDir) -> PtyMaster {
    let host = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC).unwrap();
    grantpt(&host).unwrap();
    unlockpt(&host).unwrap();
    symlink(ptsname_r(&host).unwrap(), folder.path().join("ttyPort")).unwrap();
    host
}

/// Takes the port away. First its name, because the kernel gives the terminal's number to the next one that is opened.
pub fn pull_out(folder: &TempDir, host: Client) {
    fs::remove_file(folder.path().join("ttyPort")).unwrap();
    drop(host);
}

pub fn client(host: impl Into<OwnedFd>) -> Client {
    let port = Port::from_fd(host.into(), "the host's end").unwrap();
    Client::new(BlockLink::new(port, WAIT_MAX).unwrap()).unwrap()
}

fn on_serial(folder: TempDir, more: &[&str]) -> Pinion {
    let link = format!("serial:{}", folder.path().join("ttyPort").display());
    Pinion::start_in(folder, &[&["run", "--board", "sim", "--link", &link], more].concat())
}

/// The host's end of a serial line, and the program at the other end.
pub fn plugged(more: &[&str]) -> (PtyMaster, Pinion) {
    let folder = tempfile::tempdir().unwrap();
    (plug_in(&folder), on_serial(folder, more))
}

fn uptime(client: &mut Client) {
    client.query("get_uptime", &[], "uptime", None).unwrap();
}

#[test]
fn a_host_at_the_other_end_of_a_serial_line_is_served() {
    let folder = tempfile::tempdir().unwrap();
    let host = plug_in(&folder);
    let link = format!("serial:{},500000", folder.path().join("ttyPort").display());
    let pinion = Pinion::start_in(folder, &["run", "--board", "sim", "--link", &link]);
    pinion.logged("ttyPort (500000 baud)");
    pinion.logged("it gets the union of v0.13, master and Kalico");
    let mut client = client(host);
    assert_eq!(client.constant("SERIAL_BAUD").unwrap(), 500_000.0);
    // Nothing of the host's computer can be read, so all get the union.
    assert!(
        client
            .dictionary()
            .commands
            .contains_key("config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u")
    );
    uptime(&mut client);
    pinion.logged("host attached");
    // There is no terminal of our own.
    assert!(fs::symlink_metadata(pinion.link()).is_err());
}

#[test]
fn a_serial_port_that_goes_and_comes_back_is_served_again() {
    let (host, pinion) = plugged(&[]);
    pinion.logged("ttyPort (250000 baud)");
    let mut first = client(host);
    uptime(&mut first);
    pull_out(pinion.folder(), first);
    pinion.logged("ttyPort is gone");
    pinion.logged("host gone");
    let host = plug_in(pinion.folder());
    pinion.logged("ttyPort is there");
    let mut second = client(host);
    uptime(&mut second);
}

#[test]
fn a_host_that_is_silent_counts_as_gone_and_may_go_on() {
    let (host, pinion) = plugged(&[]);
    let mut client = client(host);
    uptime(&mut client);
    pinion.logged("host attached");
    // It has the line open, and says nothing.
    pinion.logged("host gone");
    uptime(&mut client);
    pinion.until("the host's return", || pinion.log().matches("host attached").count() >= 2);
}

#[test]
fn a_serial_port_that_is_not_there_yet_is_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let pinion = on_serial(folder, &[]);
    pinion.logged("there is no ");
    pinion.logged("waiting for ");
    assert!(!pinion.log().contains("serving on"), "{}", pinion.log());
    let host = plug_in(pinion.folder());
    pinion.logged("ttyPort is there");
    uptime(&mut client(host));
}

#[test]
fn a_link_that_run_refuses_is_an_error_of_the_check() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("ttyPort");
    fs::write(&file, "").unwrap();
    let folder_itself = format!("serial:{}", folder.path().display());
    // No kernel has CAN on `lo`.
    let file = format!("serial:{}", file.display());
    for link in [&*file, &folder_itself, "serial:/dev/null", "can:lo,0123456789ab"] {
        let run = |more: &[&str]| {
            let own = folder.path().join("klipper_host_refused");
            let args = [&["run", "--board", "sim", "--link", link, "-I", own.to_str().unwrap()], more].concat();
            Command::new(pinion_path()).args(args).stdin(Stdio::null()).output().unwrap()
        };
        let (refused, checked) = (run(&[]), run(&["--check"]));
        let log = String::from_utf8(refused.stderr).unwrap();
        let page = String::from_utf8(checked.stdout).unwrap();
        assert_eq!((refused.status.code(), checked.status.code()), (Some(1), Some(1)), "{link}: {log}{page}");
        // With the same words.
        let found = page.lines().find_map(|line| line.trim().strip_prefix("error")).unwrap().trim();
        assert!(log.contains(found), "{log}{page}");
    }
}

#[test]
fn a_port_whose_other_end_stays_is_free_after_a_kill() {
    let (host, mut pinion) = plugged(&[]);
    pinion.logged("serving on");
    let port = fs::canonicalize(pinion.folder().path().join("ttyPort")).unwrap();
    pinion.signal(Signal::SIGKILL);
    pinion.end();
    // For root the kernel would make an exception.
    let mut command = Command::new("sh");
    command.args(["-c", ": <>\"$0\""]).arg(&port);
    if geteuid().is_root() {
        fs::set_permissions(&port, fs::Permissions::from_mode(0o666)).unwrap();
        command.uid(65534);
    }
    assert!(command.status().unwrap().success());
    drop(host);
}

#[test]
fn a_serial_port_that_another_program_uses_is_an_error_of_one_line() {
    let (_host, first) = plugged(&[]);
    first.logged("serving on");
    let port = format!("serial:{}", first.folder().path().join("ttyPort").display());
    let (status, log) = first.beside(&["run", "--board", "sim", "--link", &port], false);
    assert_eq!(status, Some(1), "{log}");
    assert!(log.contains("another program uses it"), "{log}");
}

/// A host comes over standard input and leaves. `is_in_use`: it configures the MCU and switches everything on. Returns
/// the log.
fn log_of_stdio(is_in_use: bool) -> String {
    let folder = tempfile::tempdir().unwrap();
    let (ours, theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    let mut child = Command::new(pinion_path())
        .args(["run", "--board", "sim", "--link", "stdio", "-I"])
        .arg(folder.path().join("tty"))
        .env("STATE_DIRECTORY", folder.path())
        .stdin(OwnedFd::from(theirs.try_clone().unwrap()))
        .stdout(OwnedFd::from(theirs))
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut client = client(ours);
    uptime(&mut client);
    if is_in_use {
        begin(&mut client, 0.0);
    }
    drop(client);
    // The input has ended: so does the program, in order.
    let mut log = String::new();
    child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(0), "{log}");
    assert!(log.contains("host gone"), "{log}");
    log
}

#[test]
fn standard_input_and_output_carry_a_host_until_they_end() {
    // A host that only looks at the MCU is not missed.
    let log = log_of_stdio(false);
    assert!(log.contains("the program ends") && !log.contains("ERROR") && !log.contains(".trace"), "{log}");
}

#[test]
fn the_end_of_standard_input_stops_an_mcu_that_is_in_use_with_a_verdict() {
    wait::in_time(|_| {
        let log = log_of_stdio(true);
        assert!(
            log.contains("shutdown: Lost communication with host: standard input has ended: find out why"),
            "{log}"
        );
        assert!(!log.contains("Force shutdown command"), "{log}");
        // The program's end waits a second for its verdict.
        let verdict = log.lines().find(|line| line.contains("closed standard input"));
        let verdict = verdict.unwrap_or_else(|| wait::was_late(&log));
        assert!(verdict.contains("(pinion trace "), "{verdict}");
    });
}

#[test]
fn a_person_s_terminal_is_no_wire_and_a_program_s_may_be() {
    let folder = tempfile::tempdir().unwrap();
    let run = || {
        let mut command = Command::new(pinion_path());
        command.args(["run", "--board", "sim", "--link", "stdio", "-I"]).arg(folder.path().join("tty"));
        command
    };
    for more in [&[][..], &["--check"]] {
        let mut person = AtTerminal::start(run().args(more), 24, None);
        assert_eq!(person.ended().code(), Some(1), "{more:?}");
        assert!(person.shown().contains("--link stdio: this terminal shows the log"), "{}", person.shown());
        assert!(person.is_given_back());
    }
    // socat with its option `pty`: the log is not there.
    let log = folder.path().join("log");
    let _program = AtTerminal::start(&mut run(), 24, Some(fs::File::create(&log).unwrap().into()));
    wait::until("the program", || fs::read_to_string(&log).unwrap().contains("serving on standard input"));
}

#[test]
fn an_older_host_on_another_computer_gets_the_dialect_that_is_named() {
    let (host, pinion) = plugged(&["--dialect", "v0.11"]);
    pinion.logged("serving on");
    let client = client(host);
    // v0.11 knows no `app`.
    assert_eq!(client.dictionary().app, "");
}

#[test]
fn a_usb_gadget_has_the_name_that_a_host_looks_for() {
    let folder = tempfile::tempdir().unwrap();
    let at = |path: &str| folder.path().join(path);
    fs::create_dir_all(at("config/usb_gadget")).unwrap();
    fs::write(at("machine-id"), "b08dfa6083e7567a1921a715000001fb\n").unwrap();
    let up = || {
        Command::new(concat!(env!("CARGO_MANIFEST_DIR"), "/systemd/usb-gadget"))
            .arg("up")
            .env("CONFIGFS", at("config"))
            .env("UDCS", at("udc"))
            .env("MACHINE_ID", at("machine-id"))
            .output()
            .unwrap()
    };
    let refused = up();
    assert!(!refused.status.success());
    assert!(String::from_utf8_lossy(&refused.stderr).contains("dtoverlay=dwc2,dr_mode=peripheral"));
    fs::create_dir_all(at("udc/fe980000.usb")).unwrap();
    let made = up();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let text = |path: &str| fs::read_to_string(at("config/usb_gadget/pinion").join(path)).unwrap();
    assert_eq!(text("UDC"), "fe980000.usb\n");
    // /dev/serial/by-id/usb-Klipper_pinion_SERIAL-if00: the serial number is a hash, not the machine's id.
    assert_eq!((&*text("strings/0x409/manufacturer"), &*text("strings/0x409/product")), ("Klipper\n", "pinion\n"));
    let serial = text("strings/0x409/serialnumber");
    assert!(serial.trim().len() == 12 && !"b08dfa6083e7567a1921a715000001fb".contains(serial.trim()), "{serial}");
    let function = fs::read_link(at("config/usb_gadget/pinion/configs/c.1/acm.0")).unwrap();
    assert_eq!(function, at("config/usb_gadget/pinion/functions/acm.0"));
}
