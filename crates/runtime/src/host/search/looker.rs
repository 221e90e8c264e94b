// SPDX-License-Identifier: GPL-3.0-or-later
//! The search's process. It answers one question after the other until the program is gone.

use std::ffi::CStr;
use std::fs;
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use nix::errno::Errno;
use nix::sys::prctl;
use nix::sys::resource::{Resource, rlim_t, setrlimit};
use nix::sys::signal::Signal;
use nix::sys::socket::{MsgFlags, recv, send};
use nix::unistd::{SysconfVar, sysconf};
use serde::Serialize;

use crate::host::klippy::process::{self, Process};
use crate::host::klippy::terminal::{Search, Terminal, find};
use crate::host::klippy::{Checkout, names, parts_without};
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{Forms, HostForms};
use pinion_linux::foreign;
use pinion_linux::sys;

use super::message::{Answer, Hello, Line, MESSAGE_BYTES_MAX, Question};
use crate::process::forked;
use crate::status::FoundHost;

/// The kernel's name of its process (proc_pid_comm(5)). Its command line is the program's.
pub(crate) const NAME: &CStr = c"pinion-search";
const PROC: &str = "/proc";
/// Highest number of bytes of memory that it may write to. klippy's sources take 3 MB.
const MEMORY_BYTES_MAX: rlim_t = 64 << 20;
/// When memory is short, the kernel kills it before the program. The program does not need it to continue.
const OOM_SCORE: &str = "500";
/// Longest part of /proc/stat that is read. It has a number for each interrupt.
const STAT_BYTES_MAX: u64 = 1 << 20;

/// The remedy for a host that cannot be inspected.
const REMEDY: &str = "for an older one name its --dialect, or give Pinion the capabilities CAP_SYS_PTRACE and CAP_DAC_READ_SEARCH, as pinion-mcu.service has them";

/// Looks for hosts until the program closes its end of the socket.
pub(super) fn live(socket: &OwnedFd) {
    let unconfined = settle(socket).err().map(|error| error.to_string());
    if !say(socket, &Hello { unconfined }) {
        return;
    }
    let mut looker = Looker::default();
    let mut message = vec![0; MESSAGE_BYTES_MAX];
    loop {
        let question = match recv(socket.as_raw_fd(), &mut message, MsgFlags::empty()) {
            Err(Errno::EINTR) => continue,
            Ok(0) | Err(_) => return,
            Ok(len) => serde_json::from_slice(&message[..len]),
        };
        let Ok(Question { number, terminal }) = question else { return };
        let (forms, host) = looker.look(terminal);
        let lines = std::mem::take(&mut looker.say.0);
        if !say(socket, &Answer::new(number, forms.as_ref(), looker.is_other, host, lines)) {
            return;
        }
        // The next host may come in a month.
        let _ = sys::give_back_unused();
    }
}

/// Sends a message. False if nobody is there any more.
fn say(socket: &OwnedFd, message: &impl Serialize) -> bool {
    let message = serde_json::to_vec(message).unwrap_or_default();
    send(socket.as_raw_fd(), &message, MsgFlags::MSG_NOSIGNAL).is_ok()
}

/// Leaves the new process only the rights and files that it needs to read and to answer.
///
/// # Errors
///
/// Why it cannot give up the rest.
fn settle(socket: &OwnedFd) -> io::Result<()> {
    let _ = fs::write("/proc/self/oom_score_adj", OOM_SCORE);
    let _ = setrlimit(Resource::RLIMIT_DATA, MEMORY_BYTES_MAX, MEMORY_BYTES_MAX);
    let _ = setrlimit(Resource::RLIMIT_CORE, 0, 0);
    // The program may have been started in real time.
    let _ = sys::set_other();
    forked::settle(NAME, &[socket.as_raw_fd()]);
    sys::keep_only(sys::LOOK_INTO_OTHERS)?;
    // The process ends with the program's first thread, even while the process waits. That thread lives as long as the
    // program.
    prctl::set_pdeathsig(Signal::SIGKILL)?;
    sys::allow_only_reading()
}

/// Lines for the program's log.
#[derive(Default)]
struct Say(Vec<Line>);

impl Say {
    fn info(&mut self, text: String) {
        self.0.push(Line { is_warning: false, text });
    }

    fn warn(&mut self, text: String) {
        self.0.push(Line { is_warning: true, text });
    }
}

/// Inspects hosts, one after the other.
#[derive(Default)]
struct Looker {
    /// The host that was seen last. A process continues with the sources that it has loaded, even if the files change.
    /// klippy's RESTART keeps the process. A host whose sources could not be read is inspected again.
    last: Option<(Process, HostForms)>,
    /// The processes that had the terminal open and may still live. Each may have configured the MCU.
    hosts: Vec<Process>,
    /// A process had the terminal open that could not be found.
    missed_one: bool,
    /// All former hosts are gone, and the present one is another.
    is_other: bool,
    /// The same host, for the status.
    host: Option<FoundHost>,
    say: Say,
}

impl Looker {
    /// Notes whether every process that had the terminal open before is gone. A process that was not found may live.
    fn meet(&mut self, process: &Process) {
        let is_new = !self.hosts.iter().any(|host| is_same(host, process));
        let had_host = !self.hosts.is_empty();
        self.hosts.retain(|host| !is_gone(host));
        self.is_other = had_host && self.hosts.is_empty() && !self.missed_one;
        self.missed_one = false;
        if is_new {
            self.hosts.push(Process { arguments: Vec::new(), ..*process });
        }
    }

    fn look(&mut self, terminal: Terminal) -> (Option<HostForms>, Option<FoundHost>) {
        let began = Instant::now();
        let unknown = (None, None);
        self.is_other = false;
        let search = find(Path::new(PROC), terminal);
        match &search {
            // Each connection has its own `pinion attach`, and one klippy on another computer.
            Ok(Search::Found(process)) if !process.is_attach() => self.meet(process),
            _ => self.missed_one = true,
        }
        let say = &mut self.say;
        let (process, is_sure) = match search {
            Ok(Search::Found(process)) => (process, true),
            // The host is one of these, and all of them run from the same sources.
            Ok(Search::Hidden(mut processes)) if same_folder(&processes) => (processes.remove(0), false),
            Ok(Search::Hidden(processes)) => {
                let pids: Vec<String> = processes.iter().map(|process| process.pid.to_string()).collect();
                let pids = pids.join(", ");
                say.warn(format!(
                    "several klippys run (processes {pids}) and none may be looked into: {}",
                    union(REMEDY)
                ));
                return unknown;
            }
            Ok(Search::Nobody) => {
                say.info(format!("the host is not a klippy that Pinion can find: {}", union("")));
                return unknown;
            }
            Err(error) => {
                say.warn(format!("the host cannot be looked for: {error}: {}", union(REMEDY)));
                return unknown;
            }
        };
        if let Some((last, forms)) = &self.last
            && is_same(last, &process)
        {
            say.info(format!("the host is the one of before, process {}", process.pid));
            return (Some(forms.clone()), self.host.clone());
        }
        let mut host =
            FoundHost { pid: process.pid, is_sure, is_attach: process.is_attach(), checkout: None, commit: None };
        let forms = forms_of(&process, &mut host, began, say);
        self.host = Some(host);
        self.last = forms.clone().map(|forms| (process, forms));
        (forms, self.host.clone())
    }
}

/// Whether this is one process.
fn is_same(one: &Process, other: &Process) -> bool {
    (one.pid, one.started) == (other.pid, other.started)
}

/// Whether a process has ended. A process that nobody waits for has no command line.
fn is_gone(process: &Process) -> bool {
    process::of(Path::new(PROC), process.pid).is_none_or(|now| !is_same(&now, process) || now.arguments.is_empty())
}

/// Whether there are processes, and all of them run from one folder.
fn same_folder(processes: &[Process]) -> bool {
    let folders: Vec<_> = processes.iter().map(|process| process.klippy_folder(Path::new(PROC))).collect();
    folders.first().is_some_and(|first| first.is_some() && folders.iter().all(|folder| folder == first))
}

/// For the log: the host gets the union, and the user's other choices.
fn union(remedy: &str) -> String {
    let stop = if remedy.is_empty() { "" } else { "; " };
    format!("it is served as Klipper v0.13, master and Kalico{stop}{remedy}")
}

/// The forms that a process looks up, or `None` if they are unknown. It logs a line that says why, and notes in `host`
/// where the process runs from.
fn forms_of(process: &Process, host: &mut FoundHost, began: Instant, say: &mut Say) -> Option<HostForms> {
    let pid = process.pid;
    let Some(folder) = process.klippy_folder(Path::new(PROC)) else {
        let remedy = "for an older one name its --dialect";
        say.info(match process.is_attach() {
            true => format!(
                "the host is on another computer (process {pid} is pinion attach), its sources cannot be read: {}",
                union(remedy)
            ),
            false => format!("the host, process {pid}, is not a klippy: {}", union("")),
        });
        return None;
    };
    let checkout = match Checkout::read(&folder, FEATURES) {
        Ok(checkout) => checkout,
        Err(error) => {
            say.warn(format!(
                "the sources of the host, process {pid}, cannot be read in {}: {error}: {}",
                folder.display(),
                union(REMEDY)
            ));
            return None;
        }
    };
    if let Some(unread) = &checkout.unread {
        say.warn(format!("not all of the host's sources can be read, and what those need may not work: {unread}"));
    }
    let inside = checkout.folder.strip_prefix(format!("{PROC}/{pid}/root")).unwrap_or(&checkout.folder);
    let inside = Path::new("/").join(inside);
    (host.checkout, host.commit) = (Some(inside.display().to_string()), checkout.commit.clone());
    let missing = checkout.missing(&Forms::Host(checkout.forms.clone()), FEATURES);
    let gets = match missing.len() {
        0 => "each message".to_owned(),
        missing => format!("all but {missing} messages"),
    };
    say.info(format!(
        "the host is {}klippy of {}{}, process {pid}: it gets {gets} that it looks up (found in {} ms)",
        if host.is_sure { "" } else { "probably the " },
        inside.display(),
        checkout.commit.as_ref().map_or(String::new(), |commit| format!(" ({commit})")),
        began.elapsed().as_millis(),
    ));
    if !missing.is_empty() {
        let parts = parts_without(&missing);
        let parts = if parts.is_empty() { String::new() } else { format!(" for {parts}") };
        say.warn(format!(
            "the host is newer than Pinion and does not get messages that it needs{parts}: {}: update Pinion (pinion doctor --klipper DIR says more)",
            names(&missing)
        ));
    }
    if started(process).is_some_and(|started| started < checkout.newest) {
        say.warn(format!("the host's sources are newer than its process {pid}: restart klipper, so that both are one"));
    }
    Some(checkout.forms)
}

/// When a process was started, in wall-clock time.
fn started(process: &Process) -> Option<SystemTime> {
    let stat = String::from_utf8(foreign::read(&Path::new(PROC).join("stat"), STAT_BYTES_MAX).ok()?).ok()?;
    let boot_s: u64 = stat.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()?;
    let per_s = u64::try_from(sysconf(SysconfVar::CLK_TCK).ok()??).ok()?;
    // One second is for the rounding of the boot time.
    Some(SystemTime::UNIX_EPOCH + Duration::from_secs(boot_s + process.started / per_s.max(1) + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::{Child, Command, Stdio};

    /// Another process that looks in, and lives until it is killed.
    fn guest() -> (Child, Process) {
        let guest = Command::new("cat").stdin(Stdio::piped()).spawn().unwrap();
        // For a moment a process that has become another program has no command line yet.
        loop {
            match process::of(Path::new(PROC), guest.id()) {
                Some(process) if !process.arguments.is_empty() => return (guest, process),
                _ => std::thread::yield_now(),
            }
        }
    }

    fn end((mut guest, _): (Child, Process)) {
        guest.kill().unwrap();
        guest.wait().unwrap();
    }

    fn is_other(looker: &mut Looker, process: &Process) -> bool {
        looker.meet(process);
        looker.is_other
    }

    #[test]
    fn a_host_is_another_one_when_all_before_it_are_gone() {
        let mut looker = Looker::default();
        let (klippy, next) = (guest(), guest());
        assert!(!is_other(&mut looker, &klippy.1) && !is_other(&mut looker, &klippy.1));
        assert!(!is_other(&mut looker, &next.1), "klippy lives");
        end(next);
        assert!(!is_other(&mut looker, &klippy.1));
        end(klippy);
        let next = guest();
        assert!(is_other(&mut looker, &next.1) && !is_other(&mut looker, &next.1));
        end(next);
    }

    #[test]
    fn a_klippy_that_lives_is_not_another_one_after_a_guest_or_an_unknown_process() {
        let (klippy, early, late) = (guest(), guest(), guest());
        let mut looker = Looker::default();
        // The guest had the terminal open before klippy came.
        assert!(!is_other(&mut looker, &early.1) && !is_other(&mut looker, &klippy.1));
        end(early);
        assert!(!is_other(&mut looker, &klippy.1));
        looker.missed_one = true;
        assert!(!is_other(&mut looker, &late.1));
        end(late);
        assert!(!is_other(&mut looker, &klippy.1));
        // A process that was not found may have configured the MCU, and may live.
        end(klippy);
        looker.missed_one = true;
        let next = guest();
        assert!(!is_other(&mut looker, &next.1));
        end(next);
    }
}
