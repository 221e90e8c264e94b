// SPDX-License-Identifier: GPL-3.0-or-later
//! Where a klippy hangs: the lines of Python at which its threads are.
//!
//! Python prints them when it gets SIGABRT with PYTHONFAULTHANDLER set, whatever it computes or waits for
//! (docs.python.org/3/library/faulthandler.html). It ends then.

use std::fmt::{self, Display};
use std::fs;
use std::path::Path;
use std::process::Child;
use std::thread;
use std::time::Duration;

use nix::sys::signal::{self, Signal};
use nix::unistd::Pid;

use crate::process::await_end;

/// The environment's word that makes Python print them.
pub(crate) const PRINTS: &str = "PYTHONFAULTHANDLER=1";
/// How long, in real time, Python may take to print them.
const PRINT: Duration = Duration::from_secs(5);
/// Real time between two looks at what the process does.
const LOOK: Duration = Duration::from_millis(10);
/// Looks at what a process does. One that computes takes a lock for an instant now and then.
const LOOKS: usize = 10;
/// Highest number of threads that are named.
const THREADS_MAX: usize = 3;

/// How a klippy hangs, and at which lines.
#[derive(Debug, PartialEq, Eq)]
pub struct Hang {
    computes: bool,
    /// A place in the Python sources for each thread. The first one is that of the main thread.
    places: Vec<String>,
}

impl Display for Hang {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some((first, others)) = self.places.split_first() else {
            return f.write_str(if self.computes { "it computes" } else { "it waits" });
        };
        if self.computes {
            return write!(f, "it computes at {first}");
        }
        write!(f, "it waits at {first}")?;
        if !others.is_empty() {
            write!(f, "; other threads wait at {}", others.join(" and at "))?;
        }
        Ok(())
    }
}

impl Hang {
    /// Looks at what a klippy does, and ends it. `output` is the file of its output.
    pub(crate) fn examine(klippy: &mut Child, output: &Path) -> Hang {
        let computes = computes(klippy.id());
        let before = fs::metadata(output).map_or(0, |about| about.len() as usize);
        // It leads a group of its own, so a script that started Python gets it, too.
        let _ = signal::killpg(Pid::from_raw(klippy.id().cast_signed()), Signal::SIGABRT);
        await_end(klippy, PRINT);
        let said = fs::read(output).unwrap_or_default();
        let places = places(&String::from_utf8_lossy(said.get(before..).unwrap_or_default()));
        Hang { computes, places }
    }
}

/// Whether a process computes: one of its threads runs, or would if it had a processor (proc_pid_stat(5), the third field).
fn computes(pid: u32) -> bool {
    let runs = || {
        let tasks = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
        let stats = tasks.filter_map(|task| fs::read_to_string(task.path().join("stat")).ok());
        stats.into_iter().any(|stat| stat.rsplit_once(") ").is_some_and(|(_, rest)| rest.starts_with('R')))
    };
    let looks = (0..LOOKS).filter(|_| {
        thread::sleep(LOOK);
        runs()
    });
    looks.count() > LOOKS / 2
}

/// The places in what Python prints. Of each thread it is the innermost one outside of Python's own library.
fn places(said: &str) -> Vec<String> {
    let mut places = Vec::new();
    for thread in said.split("\n\n") {
        let frames: Vec<&str> = thread.lines().filter_map(|line| line.strip_prefix("  File ")).collect();
        let own = frames.iter().find(|frame| !frame.contains("/lib/python"));
        let Some(place) = own.or(frames.first()) else { continue };
        // "FILE", line NUMBER in FUNCTION
        let place = place.replace('"', "");
        if thread.contains("Current thread") { places.insert(0, place) } else { places.push(place) }
    }
    places.truncate(THREADS_MAX);
    places
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::os::unix::process::CommandExt as _;
    use std::process::{Command, Stdio};

    /// How a Python hangs that runs a script.
    fn examined(script: &str) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::write(path("plugin.py"), format!("import sys, threading, time\n{script}")).unwrap();
        let output = File::create(path("out")).unwrap();
        let mut python = Command::new("env");
        python.arg(PRINTS).arg("python3").arg(path("plugin.py")).process_group(0).stdin(Stdio::null());
        let mut child = python.stdout(output.try_clone().unwrap()).stderr(output).spawn().unwrap();
        while fs::read_to_string(path("out")).unwrap() != "begins\n" {
            assert!(child.try_wait().unwrap().is_none(), "it ended before");
            thread::sleep(LOOK);
        }
        let hang = Hang::examine(&mut child, &path("out"));
        assert!(child.try_wait().unwrap().is_some(), "it still runs");
        hang.to_string().replace(folder.path().to_str().unwrap(), "F")
    }

    #[test]
    fn an_endless_loop_is_named_by_its_line() {
        let script = "def spin():\n    print('begins', flush=True)\n    while True: pass\nspin()\n";
        assert_eq!(examined(script), "it computes at F/plugin.py, line 4 in spin");
    }

    #[test]
    fn threads_that_wait_for_each_other_are_named_by_their_lines() {
        // On a busy computer the other thread may come to its line late.
        let script = "\
a, b, met = threading.Lock(), threading.Lock(), threading.Barrier(2)
def other():
    with b:
        met.wait()
        with a: pass
t = threading.Thread(target=other); t.start()
with a:
    met.wait()
    while sys._current_frames()[t.ident].f_lineno != 6: time.sleep(0.01)
    print('begins', flush=True)
    with b: pass
";
        let text = examined(script);
        assert!(text.starts_with("it waits at F/plugin.py, line 12 in <module>; other threads wait at "), "{text}");
        assert!(text.ends_with("F/plugin.py, line 6 in other"), "{text}");
    }

    #[test]
    fn a_program_that_prints_no_places_is_only_described() {
        let hang = |computes| Hang { computes, places: places("Aborted\n") }.to_string();
        assert_eq!((hang(true), hang(false)), ("it computes".into(), "it waits".into()));
    }
}
