// SPDX-License-Identifier: GPL-3.0-or-later
//! The pty, its link, hosts that come and go, signals.

use std::fs;
use std::io::{BufRead, BufReader, PipeReader, PipeWriter, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::path::Path;
use std::process::Stdio;
use std::time::Instant;

use nix::fcntl::{AT_FDCWD, FcntlArg, FdFlag, OFlag, fcntl};
use nix::pty::openpty;
use nix::sys::signal::Signal;
use nix::sys::stat::{UtimensatFlags, utimensat};
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};
use nix::sys::time::{TimeSpec, TimeValLike as _};
use nix::unistd::{getegid, ttyname};
use pinion_client::config::Config;
use pinion_client::serial::Received;
use pinion_protocol::block::{PAYLOAD_MAX, Sequence, frame};
use pinion_testkit::wait;

use crate::process::{Pinion, WAIT_MAX, exists, last_reason, late_for_the_farewell, output};

#[test]
fn a_stale_link_is_replaced_and_ours_is_removed_at_the_end() {
    let folder = tempfile::tempdir().unwrap();
    symlink("/dev/pts/no-longer-there", folder.path().join("tty")).unwrap();
    let mut pinion = Pinion::simulated_in(folder);
    let link = pinion.link();
    assert!(fs::metadata(&link).is_ok(), "the link leads to a terminal");
    pinion.client();
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(0));
    assert!(!exists(&link));
}

#[test]
fn a_link_that_a_running_pinion_serves_is_refused_and_left_alone() {
    let pinion = Pinion::simulated(&[]);
    let target = fs::read_link(pinion.link()).unwrap();
    let mut client = pinion.client();
    let refusal = format!(
        "{} leads to {}, which Pinion serves (process {}): stop it (sudo kill {}), or choose another path with -I",
        pinion.link().display(),
        target.display(),
        pinion.pid(),
        pinion.pid()
    );
    let refused = |args: &[&str], as_nobody: bool| {
        let (status, log) = pinion.beside(args, as_nobody);
        assert_eq!(status, Some(1), "{log}");
        assert!(log.contains(&refusal), "{log}");
        assert_eq!(fs::read_link(pinion.link()).unwrap(), target);
    };
    refused(&["run", "--board", "sim"], false);
    refused(&["-r", "--board", "sim"], false);
    refused(&["sim", "--show"], false);
    if nix::unistd::geteuid().is_root() {
        // A user who may not inspect the other's process, in a folder such as /tmp, gets the same answer.
        let folder = pinion.link().parent().unwrap().to_owned();
        fs::set_permissions(&folder, fs::Permissions::from_mode(0o1777)).unwrap();
        refused(&["run", "--board", "sim"], true);
    }
    // A later change of the terminal's mode makes no difference.
    fs::set_permissions(&target, fs::Permissions::from_mode(0o666)).unwrap();
    made_an_hour_ago(&pinion.link());
    refused(&["run", "--board", "sim"], false);
    assert!(client.status().is_ok(), "the host keeps its MCU");
    // The configuration can be checked while the program runs, for example before a restart.
    let (status, _) = pinion.beside(&["run", "--board", "sim", "--check"], false);
    assert_eq!(status, Some(0));
}

/// Makes a link look older than it is.
fn made_an_hour_ago(link: &Path) {
    let then = TimeSpec::seconds(fs::symlink_metadata(link).unwrap().mtime() - 3600);
    utimensat(AT_FDCWD, link, &then, &then, UtimensatFlags::NoFollowSymlink).unwrap();
}

#[test]
fn a_link_that_a_killed_pinion_left_is_replaced_though_a_login_may_have_its_terminal() {
    // The terminal's number is free again, and another test's program may have it by now. It may name no link.
    let is_served = |pinion: &Pinion| {
        pinion
            .until("its start", || ["serving on", "which Pinion serves"].iter().any(|end| pinion.log().contains(end)));
        pinion.log().contains("serving on")
    };
    let mut tries = (0..10).map(|_| {
        let mut killed = Pinion::simulated(&[]);
        killed.signal(Signal::SIGKILL);
        killed.end();
        assert!(exists(&killed.link()), "it is left");
        Pinion::start_in(killed.into_folder().0, &["run", "--board", "sim"])
    });
    let mut pinion = tries.find(is_served).expect("a number that is free");
    pinion.client().status().unwrap();
    pinion.signal(Signal::SIGKILL);
    pinion.end();
    // Its number goes to the next process that opens a terminal.
    let login = openpty(None, None).unwrap();
    // No program of another test may inherit it.
    fcntl(&login.master, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC)).unwrap();
    let (folder, link) = pinion.into_folder();
    fs::remove_file(&link).unwrap();
    symlink(ttyname(&login.slave).unwrap(), &link).unwrap();
    made_an_hour_ago(&link);
    let pinion = Pinion::simulated_in(folder);
    pinion.client().status().unwrap();
}

#[test]
fn a_link_that_was_left_is_replaced_though_another_pinion_has_the_terminal_of_its_number() {
    let other = Pinion::start(&["run", "--board", "sim"]);
    other.logged("serving on");
    let folder = tempfile::tempdir().unwrap();
    symlink(fs::read_link(other.link()).unwrap(), folder.path().join("tty")).unwrap();
    let pinion = Pinion::simulated_in(folder);
    pinion.client().status().unwrap();
    other.client().status().unwrap();
}

#[test]
fn a_signal_at_the_first_sight_of_the_link_ends_the_program_in_order() {
    for _ in 0..10 {
        let mut pinion = Pinion::start(&["run", "--board", "sim"]);
        let end = Instant::now() + WAIT_MAX;
        while !exists(&pinion.link()) {
            assert!(Instant::now() < end, "no link; the log:\n{}", pinion.log());
            // Without a pause: a pause would give the program time to become ready.
            std::thread::yield_now();
        }
        pinion.signal(Signal::SIGTERM);
        assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
        assert!(!exists(&pinion.link()));
    }
}

#[test]
fn a_regular_file_in_the_links_place_is_an_error_and_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("tty"), "mine").unwrap();
    let mut pinion = Pinion::start_in(folder, &["run", "--board", "sim"]);
    assert_eq!(pinion.end().code(), Some(1));
    assert!(pinion.log().contains("not a symbolic link"), "{}", pinion.log());
    assert_eq!(fs::read_to_string(pinion.link()).unwrap(), "mine");
}

#[test]
fn a_link_that_was_taken_over_is_left_alone() {
    let mut pinion = Pinion::simulated(&[]);
    fs::remove_file(pinion.link()).unwrap();
    symlink("/dev/null", pinion.link()).unwrap();
    pinion.signal(Signal::SIGHUP);
    assert_eq!(pinion.end().code(), Some(0));
    assert!(exists(&pinion.link()));
}

#[test]
fn the_command_line_of_klipper_mcu_works_as_it_is() {
    let mut pinion = Pinion::start(&["-r", "--board", "sim"]);
    pinion.wait_for_link();
    pinion.client().status().unwrap();
    pinion.signal(Signal::SIGINT);
    assert_eq!(pinion.end().code(), Some(0));
}

#[test]
fn mode_and_group_of_the_pty_are_as_asked() {
    let group = nix::unistd::getegid().to_string();
    let pinion = Pinion::simulated(&["-m", "0606", "-g", &group]);
    let device = fs::metadata(pinion.link()).unwrap();
    assert_eq!(device.mode() & 0o777, 0o606);
    assert_eq!(device.gid().to_string(), group);

    let mut refused = Pinion::start(&["run", "--board", "sim", "-g", "no-such-group"]);
    assert_eq!(refused.end().code(), Some(1));
    assert!(refused.log().contains("no group no-such-group"), "{}", refused.log());
}

#[test]
fn a_link_in_a_folder_that_does_not_exist_is_refused_with_the_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("none/tty");
    let refused = output(&["run", "--board", "sim", "-I", link.to_str().unwrap()]);
    assert_eq!(refused.status.code(), Some(1));
    let log = String::from_utf8_lossy(&refused.stderr);
    assert!(log.contains("cannot be made") && log.contains("make its folder"), "{log}");
}

#[test]
fn a_user_whom_tty_is_not_open_to_is_served_as_by_the_c_program() {
    Pinion::start_as_nobody(&[]);
}

#[test]
fn a_host_that_goes_away_and_comes_back_finds_the_mcu_as_it_left_it() {
    let pinion = Pinion::simulated(&[]);
    let mut client = pinion.client();
    Config::default().apply(&mut client).unwrap();
    pinion.logged("host attached");
    drop(client);
    pinion.logged("host gone");
    assert!(pinion.client().status().unwrap().is_config);
}

#[test]
fn force_shutdown_stops_the_mcu_and_a_reset_starts_it_anew() {
    let pinion = Pinion::simulated(&[]);
    let mut client = pinion.client();
    fs::OpenOptions::new().write(true).open(pinion.link()).unwrap().write_all(b"FORCE_SHUTDOWN\n").unwrap();
    let reason = client.wait_shutdown(WAIT_MAX).unwrap();
    assert_eq!(reason.as_deref(), Some("Force shutdown command"));
    client.reset().unwrap();
    assert!(!client.status().unwrap().is_shutdown);
}

#[test]
fn sigterm_informs_the_host_and_drives_outputs_to_their_shutdown_values() {
    wait::in_time(|_| {
        let mut pinion = Pinion::simulated(&[]);
        let mut client =
            pinion.configured(&["config_digital_out oid=0 pin=led value=0 default_value=0 max_duration=0"]);
        client.send_line("update_digital_out oid=0 value=1").unwrap();
        client.link().settle().unwrap();
        let signaled = Instant::now();
        pinion.signal(Signal::SIGTERM);
        // The terminal stays open until the host has read the news, even if the host is busy for a moment.
        pinion.logged("shutdown: Force shutdown command: ");
        assert_eq!(last_reason(&mut client, signaled).as_deref(), Some("Force shutdown command"));
        drop(client);
        assert_eq!(pinion.end().code(), Some(0));
    });
}

#[test]
fn a_host_that_was_slow_to_read_still_reads_why_the_program_ended() {
    wait::in_time(|_| {
        let mut pinion = Pinion::simulated(&[]);
        let mut client = pinion.client();
        let query = client.messages().encode_line("identify offset=0 count=40").unwrap();
        let stop = client.messages().encode_line("emergency_stop").unwrap();
        // More answers than the terminal can hold, and fewer than the program drops.
        let queries = query.repeat(PAYLOAD_MAX / query.len());
        let answers_bytes = PAYLOAD_MAX / query.len() * 40;
        let blocks = (terminal_bytes() + 20 * 1024) / answers_bytes;
        let mut sequence = Sequence::default();
        let mut tty = fs::OpenOptions::new().write(true).open(pinion.link()).unwrap();
        // The expected number is unknown: the first fifteen blocks find it. The others continue from there.
        for _ in 0..15 + blocks {
            let mut block = Vec::new();
            frame(&queries, sequence, &mut block);
            tty.write_all(&block).unwrap();
            sequence = sequence.next();
        }
        let mut block = Vec::new();
        frame(&stop, sequence, &mut block);
        tty.write_all(&block).unwrap();
        pinion.logged("shutdown: Command request");
        let signaled = Instant::now();
        pinion.signal(Signal::SIGTERM);
        let until = Instant::now() + WAIT_MAX;
        let mut last = Vec::new();
        while let Ok(Some((_, payload))) = client.link().port().wait_block(until) {
            last = client.messages().decode(&Received { payload, at: Instant::now() });
            if last.iter().any(|params| params.name == "shutdown") {
                break;
            }
        }
        let reasons: Vec<String> = last.iter().filter_map(|params| params.text("static_string_id").ok()).collect();
        if reasons.is_empty() {
            late_for_the_farewell(signaled);
        }
        assert_eq!(reasons, ["Command request"], "{last:?}");
        drop((client, tty));
        assert_eq!(pinion.end().code(), Some(0));
    });
}

/// Number of bytes that a terminal holds for a host that does not read.
fn terminal_bytes() -> usize {
    let terminal = openpty(None, None).unwrap();
    let mut attributes = tcgetattr(&terminal.slave).unwrap();
    cfmakeraw(&mut attributes);
    tcsetattr(&terminal.slave, SetArg::TCSANOW, &attributes).unwrap();
    fcntl(&terminal.master, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).unwrap();
    let mut master = fs::File::from(terminal.master);
    std::iter::from_fn(|| master.write(&[b'.'; 256]).ok()).sum()
}

#[test]
fn sigusr1_logs_how_late_timers_were() {
    let pinion = Pinion::simulated(&[]);
    pinion.logged("serving on");
    pinion.signal(Signal::SIGUSR1);
    assert!(pinion.logged("timers:").contains("no events; the core wakes"));
    pinion.client().status().unwrap();
}

#[test]
fn a_host_that_never_reads_neither_blocks_the_mcu_nor_makes_it_grow() {
    // One query for the core, and two that the link answers itself.
    for query in ["get_uptime", "get_clock", "identify offset=0 count=40"] {
        let pinion = Pinion::simulated(&[]);
        let payload = pinion.client().messages().encode_line(query).unwrap();
        let before = pinion.memory_kib("RssAnon");
        let mut tty = fs::OpenOptions::new().write(true).open(pinion.link()).unwrap();
        let (done, finished) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            // A host that does not read does not know the expected number. It tries all sixteen in turn.
            let (mut blocks, mut sequence) = (Vec::new(), Sequence::default());
            for _ in 0..16 {
                frame(&payload, sequence, &mut blocks);
                sequence = sequence.next();
            }
            for _ in 0..5_000 {
                tty.write_all(&blocks).unwrap();
            }
            done.send(()).unwrap();
            // The terminal stays open: a host that hangs is not gone.
            std::thread::park();
        });
        finished.recv_timeout(WAIT_MAX).expect("the MCU takes commands in");
        let grown = pinion.memory_kib("RssAnon").saturating_sub(before);
        assert!(grown < 2048, "{query}: grew by {grown} kB; the log:\n{}", pinion.log());
        // The reason for the MCU's stop is in the log anyway. (It counts only if it is read separately from the
        // blocks.)
        pinion.until("the reason of the stop in the log", || {
            fs::write(pinion.link(), "FORCE_SHUTDOWN\n").unwrap();
            pinion.log().contains("shutdown: Force shutdown command: ")
        });
        // A host that reads is served.
        let mut client = pinion.client();
        client.reset().unwrap();
        assert!(!client.status().unwrap().is_shutdown);
    }
}

#[test]
fn hosts_that_come_and_go_by_the_thousand_do_not_hide_the_one_that_leaves() {
    let pinion = Pinion::simulated(&[]);
    for _ in 0..20_000 {
        drop(fs::File::open(pinion.link()).unwrap());
    }
    let mut client = pinion.client();
    client.status().unwrap();
    pinion.logged("host attached");
    // A client that has no answer for long opens the terminal again.
    let gone = || pinion.log().matches("host gone").count();
    let before = gone();
    // Another process that opens and closes the terminal at the same time takes no data from it.
    for _ in 0..20_000 {
        drop(fs::File::open(pinion.link()).unwrap());
    }
    client.status().unwrap();
    assert_eq!(gone(), before);
    drop(client);
    pinion.until("the host's end", || gone() == before + 1);
}

#[test]
fn what_the_host_and_the_service_manager_ask_for_is_no_warning() {
    wait::in_time(|_| {
        // A user outside the group tty would be warned of that.
        let mut pinion = Pinion::simulated(&["-g", &getegid().to_string()]);
        let mut client = pinion.client();
        Config::default().apply(&mut client).unwrap();
        client.reset().unwrap();
        pinion.signal(Signal::SIGTERM);
        assert_eq!(pinion.end().code(), Some(0));
        let log = pinion.log();
        assert!(log.contains("INFO  shutdown: Command request: "), "{log}");
        assert!(log.contains("INFO  shutdown: Force shutdown command: "), "{log}");
        assert!(!log.contains("WARN") && !log.contains("ERROR"), "{log}");
    });
}

/// A full pipe.
pub fn full_pipe() -> (PipeReader, PipeWriter) {
    let (reader, mut writer) = std::io::pipe().unwrap();
    fcntl(&writer, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).unwrap();
    while writer.write(&[b'.'; 4096]).is_ok() {}
    fcntl(&writer, FcntlArg::F_SETFL(OFlag::empty())).unwrap();
    (reader, writer)
}

/// A simulated printer whose log goes into a full pipe.
fn with_full_log() -> (PipeReader, Pinion) {
    let (reader, writer) = full_pipe();
    let folder = tempfile::tempdir().unwrap();
    let pinion = Pinion::start_to(folder, &["run", "--board", "sim"], Stdio::null(), writer);
    pinion.wait_for_link();
    (reader, pinion)
}

#[test]
fn a_log_that_nobody_reads_stops_neither_the_mcu_nor_its_end() {
    let (reader, mut pinion) = with_full_log();
    let mut client = pinion.client();
    Config::default().apply(&mut client).unwrap();
    client.reset().unwrap();
    assert!(!client.status().unwrap().is_shutdown);
    pinion.signal(Signal::SIGTERM);
    assert_eq!(pinion.end().code(), Some(0));
    assert!(!exists(&pinion.link()));
    drop(reader);
}

#[test]
fn a_log_that_is_read_again_says_how_much_of_it_was_left_out() {
    let (reader, mut pinion) = with_full_log();
    let mut client = pinion.client();
    let [stop, reset] = ["emergency_stop", "config_reset"].map(|line| client.messages().encode_line(line).unwrap());
    // Each stop gives two log lines. Of each kind that is more than the program writes in a minute.
    for _ in 0..80 {
        client.link().send(&stop).unwrap();
        client.link().send(&reset).unwrap();
    }
    client.link().settle().unwrap();
    let (sender, lines) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let lines = BufReader::new(reader).lines().map_while(Result::ok);
        lines.for_each(|line| drop(sender.send(line)));
    });
    let wait_for = |text: &str| {
        while !lines.recv_timeout(WAIT_MAX).unwrap_or_else(|_| panic!("no line with {text}")).contains(text) {}
    };
    wait_for("INFO  serving on ");
    pinion.signal(Signal::SIGTERM);
    wait_for("shutdown: Force shutdown command: ");
    wait_for(" more lines like this were left out: shutdown: Command request: ");
    assert_eq!(pinion.end().code(), Some(0));
}
