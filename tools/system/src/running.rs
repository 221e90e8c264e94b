// SPDX-License-Identifier: GPL-3.0-or-later
//! The processes of the computer: their users, the units that started them, and the Pinions among them.

use std::ffi::OsString;
use std::fs;
use std::os::unix::fs::MetadataExt;

use crate::config;
use crate::settings::{BoardName, Settings, run_args};
use pinion_linux::foreign::word;
use pinion_runtime::helpers;
use pinion_runtime::klippy::HOST_PATHS;
use pinion_runtime::klippy::process::{self, Ids, Process};
use pinion_runtime::klippy::terminal::{self, Search};

use super::units::{self, setting};
use super::{Computer, Who};

/// A Pinion process that serves hosts.
pub struct Running {
    /// The number of the process.
    pub pid: u32,
    /// The unit that has started it, without `.service`.
    pub unit: Option<String>,
    /// The configuration file that its command line names.
    pub config: Option<String>,
    /// Its settings, as far as its command line and its configuration file can be read.
    pub settings: Option<Settings>,
}

/// Who started a process. Any user can have a process with any command line. So the findings and their remedies are
/// only about the processes of a service, of root and of the caller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Starter {
    /// This unit of the system, without `.service`. It starts a Pinion or a klippy.
    Unit(String),
    /// Root, or the user that has called this program.
    Administrator,
    /// Anybody else.
    Stranger,
}

impl Starter {
    /// The unit, if a unit started it.
    pub fn unit(self) -> Option<String> {
        match self {
            Starter::Unit(unit) => Some(unit),
            Starter::Administrator | Starter::Stranger => None,
        }
    }
}

impl Computer {
    /// The user of a process, with the process's groups. A process has the groups of the time when it was started.
    pub fn user_of(&self, pid: u32) -> Option<Who> {
        let ids = self.ids_of(pid)?;
        Some(Who { name: self.user_name(ids.user()), uid: ids.user(), gids: ids.gids })
    }

    fn ids_of(&self, pid: u32) -> Option<Ids> {
        Ids::of(&self.text(format!("/proc/{pid}/status"))?)
    }

    /// All processes, in the order in which they were started.
    pub fn all_processes(&self) -> Vec<Process> {
        let mut processes = process::all(&self.path("/proc")).unwrap_or_default();
        processes.sort_by_key(|process| (process.started, process.pid));
        processes
    }

    /// The processes like this that no stranger has started, each with its unit.
    pub fn processes(&self, is_wanted: impl Fn(&Process) -> bool) -> impl Iterator<Item = (Process, Option<String>)> {
        self.all_processes().into_iter().filter(is_wanted).filter_map(|process| match self.starter_of(process.pid) {
            Starter::Stranger => None,
            starter => Some((process, starter.unit())),
        })
    }

    /// The running Pinions that no stranger has started, without their helpers.
    pub fn running(&self) -> Vec<Running> {
        let pinions = self.all_processes().into_iter().filter(|process| self.is_pinion(process));
        let ours = pinions.filter_map(|process| match self.starter_of_pinion(process.pid) {
            Starter::Stranger => None,
            starter => Some(self.pinion(&process, starter.unit())),
        });
        ours.collect()
    }

    /// The processes of strangers that are called like a Pinion or a klippy.
    pub fn strangers(&self) -> Vec<Process> {
        let mut processes = self.all_processes();
        processes.retain(|process| match self.is_pinion(process) {
            true => self.starter_of_pinion(process.pid) == Starter::Stranger,
            false => process.is_klippy() && self.starter_of(process.pid) == Starter::Stranger,
        });
        processes
    }

    /// Whether a process has the name of a Pinion that serves hosts, and not that of a helper.
    fn is_pinion(&self, process: &Process) -> bool {
        let is_helper = |name: String| helpers::NAMES.iter().any(|helper| name.as_bytes() == helper.to_bytes());
        process.is_pinion()
            && !self.text(format!("/proc/{}/comm", process.pid)).is_some_and(is_helper)
            // Another version's command line is not understood.
            && run_args(words(process)).map_or(true, |args| args.is_some())
    }

    /// A Pinion that is this process.
    fn pinion(&self, process: &Process, unit: Option<String>) -> Running {
        let settings = run_args(words(process)).ok().flatten().and_then(|args| {
            let file = args.config.map_or_else(
                || Ok(Default::default()),
                |file| config::load_foreign(&self.path(&file), &file.to_string_lossy()),
            );
            file.ok().map(|file| args.given.or(file).settings())
        });
        let words: Vec<_> = process.arguments.iter().map(|word| word.to_string_lossy()).collect();
        let config = named_config(words.iter().map(AsRef::as_ref));
        Running { pid: process.pid, unit, config, settings }
    }

    /// Who started a process.
    pub fn starter_of(&self, pid: u32) -> Starter {
        self.starter_among(pid, &["pinion", "klippy", "klipper"])
    }

    /// The same for a Pinion. klippy's unit starts none: a host that calls a process of its own so is no Pinion whose
    /// user needs more groups.
    fn starter_of_pinion(&self, pid: u32) -> Starter {
        self.starter_among(pid, &["pinion"])
    }

    /// Who started a process, if only units with one of these words count.
    fn starter_among(&self, pid: u32, programs: &[&str]) -> Starter {
        let groups = self.text(format!("/proc/{pid}/cgroup")).unwrap_or_default();
        let unit = process::unit(&groups);
        if let Some(unit) = unit.filter(|unit| self.starts(unit, programs)) {
            return Starter::Unit(unit.to_owned());
        }
        let Some(Ids { uids, .. }) = self.ids_of(pid) else { return Starter::Stranger };
        // A program with the set-user-ID bit keeps its caller's user in one of them, at least at first.
        let is_wholly = |user: u32| uids.iter().all(|uid| *uid == user);
        // Such a program may then become root wholly, with a command line of its caller's choice. Only root may look at
        // another user's program. For others the process has to be a service's.
        let program = fs::metadata(self.path(format!("/proc/{pid}/exe")));
        let is_root_s = || program.map_or(unit.is_some(), |program| program.mode() & 0o6000 == 0);
        match self.caller {
            Some(caller) if caller != 0 && is_wholly(caller) => Starter::Administrator,
            _ if is_wholly(0) && is_root_s() => Starter::Administrator,
            _ => Starter::Stranger,
        }
    }

    /// Whether a unit starts one of these programs, so that a restart of the unit starts it again. Any user may have
    /// processes in other units, such as cron's.
    fn starts(&self, unit: &str, programs: &[&str]) -> bool {
        // systemd makes some units without a file in these folders, from scripts of System V. Then the name counts.
        let text = units::text(self, unit).or_else(|| units::text(self, &units::template(unit)?));
        let command = text.and_then(|text| setting(&text, "ExecStart").map(str::to_lowercase));
        let command = command.unwrap_or_else(|| unit.split('@').next().unwrap_or_default().to_lowercase());
        programs.iter().any(|program| command.contains(program))
    }
}

fn words(process: &Process) -> impl Iterator<Item = OsString> {
    process.arguments.iter().map(|argument| argument.clone().into_os_string())
}

/// The configuration file that a command line of any version of Pinion names.
pub fn named_config<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<String> {
    while let Some(word) = words.next() {
        match word.strip_prefix("--config") {
            Some("") => return words.next().map(str::to_owned),
            Some(value) => return value.strip_prefix('=').map(str::to_owned),
            None => {}
        }
    }
    None
}

/// Why this computer must not be kept busy: a host may be printing through a Pinion on its pins. A simulated printer
/// has nothing to spoil. A process of another user does not count: with one, any user could keep all others from
/// measuring. [`print_of_another`] reports it.
pub fn print_at_risk(computer: &Computer) -> Option<String> {
    let proc = computer.path("/proc");
    computer.running().into_iter().filter(|pinion| !is_simulated(pinion)).find_map(|pinion| {
        let who = match &pinion.unit {
            Some(unit) => format!("Pinion (process {}, {unit})", pinion.pid),
            None => format!("Pinion (process {})", pinion.pid),
        };
        if let Some(by) = &pinion.settings
            && !by.link.is_local()
        {
            return Some(format!(
                "a host on another computer may print through {who}, and measuring keeps every processor busy, which makes steps late: stop this Pinion, when no print runs"
            ));
        }
        let link = pinion.settings.map_or_else(|| HOST_PATHS.to_owned() + "mcu", |by| by.symlink.display().to_string());
        // An absolute link replaces the folder before it.
        let link = proc.join(format!("{}/cwd", pinion.pid)).join(&link);
        let terminal = fs::canonicalize(&link).and_then(|device| terminal::Terminal::of(&device));
        let found = terminal.and_then(|terminal| terminal::find(&proc, terminal));
        let (host, is) = match found {
            Ok(Search::Nobody) => return None,
            Ok(Search::Found(host)) => (host, "is"),
            Ok(Search::Hidden(klippys)) => (klippys.into_iter().next()?, "may be"),
            Err(error) => {
                return Some(format!(
                    "whether a host is attached to {who} is unknown: {}: {error}: stop this Pinion, or try with sudo",
                    link.display()
                ));
            }
        };
        let name = if host.is_klippy() { "klippy" } else { "a host" };
        let stop = match computer.starter_of(host.pid).unit().filter(|_| host.is_klippy()) {
            Some(unit) => format!("sudo systemctl stop {}", word(unit)),
            None => format!("end process {}", host.pid),
        };
        Some(format!(
            "{name} (process {}) {is} attached to {who}, and measuring keeps every processor busy, which makes steps late: wait until the print is done, then {stop}; pinion doctor measures gently",
            host.pid
        ))
    })
}

/// Whose print may suffer while this computer is kept busy: a Pinion of another user runs, or a process that is called
/// so.
pub fn print_of_another(computer: &Computer) -> Option<String> {
    let pinions = computer.strangers().into_iter().filter(|process| computer.is_pinion(process));
    let mut pinions = pinions.map(|process| computer.pinion(&process, None)).filter(|pinion| !is_simulated(pinion));
    pinions.next().map(|pinion| {
        format!(
            "process {} may be a Pinion of another user: if a host prints through it, this makes its steps late",
            pinion.pid
        )
    })
}

fn is_simulated(pinion: &Running) -> bool {
    matches!(&pinion.settings, Some(by) if matches!(by.board, BoardName::Sim(_)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    const MALLORY: u32 = 54_321;

    #[test]
    fn the_unit_of_a_process_is_the_one_that_starts_it_again() {
        let tree = Tree::empty();
        tree.process(7, &["pinion"], MALLORY, &[]);
        let unit = |group: &str| {
            tree.put("proc/7/cgroup", format!("0::{group}\n"));
            tree.computer().starter_of(7).unit()
        };
        assert_eq!(unit("/system.slice/system-pinion.slice/pinion-mcu@b.service").as_deref(), Some("pinion-mcu@b"));
        assert_eq!(unit("/user.slice/user-1000.slice/session-2.scope"), None);
        assert_eq!(unit("/user.slice/user-1000.slice/user@1000.service"), None);
        assert_eq!(unit("/user.slice/user-1000.slice/user@1000.service/app.slice/klipper.service"), None);
        tree.put("lib/systemd/system/cron.service", "[Service]\nExecStart=/usr/sbin/cron -f -P $EXTRA_OPTS\n");
        assert_eq!(unit("/system.slice/cron.service"), None);
        // The program's name may stand only in a variable.
        tree.put("etc/systemd/system/klipper.service", "[Service]\nExecStart=/home/pi/env/bin/python $KLIPPER_ARGS\n");
        assert_eq!(unit("/system.slice/klipper.service").as_deref(), Some("klipper"));
        tree.put("etc/systemd/system/mine.service", "[Service]\nExecStart=/usr/bin/pinion -r\n");
        assert_eq!(unit("/system.slice/mine.service").as_deref(), Some("mine"));
        // Its text is the template's.
        tree.put("lib/systemd/system/sshd@.service", "[Service]\nExecStart=-/usr/sbin/sshd -i\n");
        assert_eq!(unit("/system.slice/system-sshd.slice/sshd@1-klipper:22.service"), None);
        assert_eq!(unit("/system.slice/atd.service"), None, "a unit without a file, and of another name");
        assert_eq!(unit("/system.slice/x@klipper.service"), None, "others may choose the name of an instance");
        assert_eq!(unit("/printer.slice/klipper.service/worker").as_deref(), Some("klipper"), "a slice of the system");
    }

    #[test]
    fn a_group_that_a_user_or_a_container_has_made_is_no_unit() {
        let tree = Tree::empty();
        tree.process(7, &["pinion"], MALLORY, &[]);
        for groups in [
            "0::/user.slice/user-1000.slice/user@1000.service/app.slice/system.slice/klipper.service\n",
            "0::/user.slice/user-1000.slice/user@1000.service/klipper.service\n",
            "0::/user.slice/klipper.service\n",
            // Groups that others than systemd have made, in containers and in other hierarchies.
            "0::/machine.slice/systemd-nspawn@a.service/payload/system.slice/klipper.service\n",
            "0::/machine.slice/klipper.service\n",
            "0::/docker/0123/system.slice/klipper.service\n",
            "0::/system.slice/docker-0123.scope/system.slice/klipper.service\n",
            "0::/../system.slice/klipper.service\n",
            "5:name=lxc:/system.slice/klipper.service\n1:name=systemd:/user.slice/user-1000.slice/session-1.scope\n0::/\n",
            "3:freezer:/klipper.service\n",
            "0::/system.slice/.service\n",
            "0::/system.slice/session.scope/klipper.service\n",
        ] {
            tree.put("proc/7/cgroup", groups);
            assert_eq!(tree.computer().starter_of(7), Starter::Stranger, "{groups}");
        }
        tree.put("proc/7/cgroup", "4:pids:/\n1:name=systemd:/system.slice/klipper.service\n0::/\n");
        assert_eq!(tree.computer().starter_of(7), Starter::Unit("klipper".into()));
    }

    /// The host is trusted with the pins, and not with more groups.
    #[test]
    fn a_false_pinion_of_the_host_is_none() {
        let tree = Tree::empty();
        tree.put("proc/7/cgroup", "0::/system.slice/klipper.service\n");
        tree.process(7, &["pinion", "run"], MALLORY, &[]);
        let pids = |computer: &Computer| computer.running().iter().map(|pinion| pinion.pid).collect::<Vec<_>>();
        let strangers =
            |computer: &Computer| computer.strangers().iter().map(|process| process.pid).collect::<Vec<_>>();
        assert_eq!((pids(&tree.computer()), strangers(&tree.computer())), (vec![], vec![7]));
        assert_eq!(pids(&tree.called_by(MALLORY)), [7], "the caller's own");
        // Pinion in the place of Klipper's own program.
        tree.put("proc/7/cgroup", "0::/system.slice/klipper-mcu.service\n");
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion run -r\n");
        assert_eq!((pids(&tree.computer()), strangers(&tree.computer())), (vec![7], vec![]));
    }

    #[test]
    fn a_false_process_of_another_user_keeps_nobody_from_measuring() {
        let tree = Tree::empty();
        tree.put("proc/7/cgroup", "0::/user.slice/user-1000.slice/session-2.scope\n");
        tree.process(7, &["pinion"], MALLORY, &[]);
        assert_eq!(print_at_risk(&tree.computer()), None);
        let line = print_of_another(&tree.computer()).unwrap();
        assert!(line.starts_with("process 7 may be a Pinion of another user"), "{line}");
        tree.process(7, &["pinion"], 0, &[]);
        assert!(print_at_risk(&tree.computer()).is_some());
        assert_eq!(print_of_another(&tree.computer()), None);
    }

    #[test]
    fn a_program_with_the_set_user_id_bit_is_its_caller_s() {
        let tree = Tree::empty();
        tree.put("proc/7/cgroup", "0::/user.slice/user-1000.slice/session-2.scope\n");
        let starter = |uids: &str, mode: u32| {
            tree.process(7, &["pinion"], 0, &[]);
            tree.put("proc/7/status", format!("Uid:\t{uids}\nGid:\t0\t0\t0\t0\nGroups:\t\n"));
            tree.mode("proc/7/exe", mode);
            tree.computer().starter_of(7)
        };
        assert_eq!(starter("0\t0\t0\t0", 0o755), Starter::Administrator);
        // As su and passwd are while they ask for a password.
        assert_eq!(starter("54321\t0\t0\t0", 0o755), Starter::Stranger);
        assert_eq!(starter("54321\t54321\t54321\t54321", 0o755), Starter::Stranger);
        // As sudo is.
        assert_eq!(starter("0\t0\t0\t0", 0o4755), Starter::Stranger);
    }
}
