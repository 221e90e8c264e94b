// SPDX-License-Identifier: GPL-3.0-or-later
//! The process that searches for the host: its rights, and the end of it and of the program.

use std::fs;
use std::path::Path;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::process::Pinion;

/// A field of a process's status.
pub fn field(process: &Path, name: &str) -> String {
    let status = fs::read_to_string(process.join("status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(&format!("{name}:")));
    line.unwrap_or_else(|| panic!("{name} in {status}")).trim().to_owned()
}

/// The process that searches for the host of the program `pid`; `None` if there is none.
pub fn search_of(pid: u32) -> Option<u32> {
    let is_it = |pid_there: &u32| {
        let status = fs::read_to_string(format!("/proc/{pid_there}/status")).unwrap_or_default();
        status.contains("Name:\tpinion-search\n") && status.contains(&format!("PPid:\t{pid}\n"))
    };
    let pids = fs::read_dir("/proc").unwrap().filter_map(|entry| entry.unwrap().file_name().to_str()?.parse().ok());
    pids.into_iter().find(is_it)
}

/// Whether the process has ended.
pub fn is_gone(pid: u32) -> bool {
    // An orphan's zombie may wait for an init that does not collect it.
    fs::read_to_string(format!("/proc/{pid}/stat")).map_or(true, |stat| stat.contains(") Z "))
}

#[test]
fn the_search_has_nothing_but_its_socket_and_may_only_read() {
    let pinion = Pinion::simulated(&["-r"]);
    let search = search_of(pinion.pid()).unwrap();
    let process = Path::new("/proc").join(search.to_string());
    // It has filters, and cannot become another program with more rights.
    assert_eq!((field(&process, "Seccomp").as_str(), field(&process, "NoNewPrivs").as_str()), ("2", "1"));
    let files: Vec<_> = fs::read_dir(process.join("fd")).unwrap().map(|file| file.unwrap().path()).collect();
    let [socket] = &files[..] else { panic!("{files:?}") };
    assert!(fs::read_link(socket).unwrap().to_str().unwrap().starts_with("socket:"));
    // It has neither the program's memory lock nor its scheduling, and the kernel kills it first.
    assert_eq!(field(&process, "VmLck"), "0 kB");
    let stat = fs::read_to_string(process.join("stat")).unwrap();
    assert_eq!(stat.rsplit_once(')').unwrap().1.split_whitespace().nth(38), Some("0"), "SCHED_OTHER");
    assert_eq!(fs::read_to_string(process.join("oom_score_adj")).unwrap(), "500\n");
}

#[test]
fn the_search_ends_with_the_program_and_not_before() {
    let mut pinion = Pinion::simulated(&[]);
    let search = search_of(pinion.pid()).unwrap();
    // systemd and a terminal send these to every process.
    for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT] {
        kill(Pid::from_raw(search as i32), signal).unwrap();
    }
    let client = pinion.client();
    pinion.logged(&format!("the host, process {}, is not a klippy", std::process::id()));
    drop(client);
    pinion.signal(Signal::SIGKILL);
    pinion.end();
    pinion.until("the search's end", || is_gone(search));
    assert!(!pinion.log().contains("the search for the host has ended"), "{}", pinion.log());
}

#[test]
fn a_program_whose_search_is_killed_says_so_and_serves_on() {
    let mut pinion = Pinion::simulated(&[]);
    let search = search_of(pinion.pid()).unwrap();
    kill(Pid::from_raw(search as i32), Signal::SIGKILL).unwrap();
    pinion.logged("the search for the host has ended");
    let client = pinion.client();
    assert!(client.dictionary().commands.contains_key("get_clock"));
    drop(client);
    pinion.signal(Signal::SIGTERM);
    assert!(pinion.end().success());
}

#[test]
fn there_is_no_search_where_the_dialect_is_set() {
    let pinion = Pinion::simulated(&["--dialect", "master"]);
    assert_eq!(search_of(pinion.pid()), None);
}
