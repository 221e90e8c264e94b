// SPDX-License-Identifier: GPL-3.0-or-later
//! The processes of the computer: their users, the units that started them, and the Pinions among them.

#![forbid(unsafe_code)]

use std::fs;

use crate::cli::settings::{BoardName, Settings};
use crate::cli::{config, run_args};
use crate::klippy::HOST_PATHS;
use crate::klippy::process::{self, Process, Search};
use crate::proc::status_field;
use crate::runtime::helpers;

use super::units::{self, setting};
use super::{Computer, Who};

/// A Pinion process that serves hosts.
pub(in crate::cli) struct Running {
    pub(in crate::cli) pid: u32,
    /// The unit that has started it, without `.service`.
    pub(in crate::cli) unit: Option<String>,
    /// The configuration file that its command line names.
    pub(in crate::cli) config: Option<String>,
    /// Its settings, as far as its command line and its configuration file can be read.
    pub(in crate::cli) settings: Option<Settings>,
}

impl Computer {
    /// The user of a process, with the process's groups. A process has the groups of the time when it was started.
    pub(in crate::cli) fn user_of(&self, pid: u32) -> Option<Who> {
        let status = self.text(format!("/proc/{pid}/status"))?;
        let numbers = |field: &str| -> Vec<u32> {
            let numbers = status_field(&status, field).unwrap_or_default().split_whitespace();
            numbers.filter_map(|number| number.parse().ok()).collect()
        };
        // The second number is the effective one.
        let uid = *numbers("Uid").get(1)?;
        let gids = numbers("Gid").get(1).copied().into_iter().chain(numbers("Groups")).collect();
        Some(Who { name: self.user_name(uid), uid, gids })
    }

    /// The processes, in the order in which they were started.
    pub(in crate::cli) fn processes(&self) -> Vec<Process> {
        let mut processes = process::all(&self.path("/proc")).unwrap_or_default();
        processes.sort_by_key(|process| (process.started, process.pid));
        processes
    }

    /// The running Pinions, without their helpers.
    pub(in crate::cli) fn running(&self) -> Vec<Running> {
        let running = |process: Process| {
            let program = process.arguments.first()?;
            let pid = process.pid;
            let is_helper = |name: String| helpers::NAMES.iter().any(|helper| name.as_bytes() == helper.to_bytes());
            if program.file_name()? != "pinion" || self.text(format!("/proc/{pid}/comm")).is_some_and(is_helper) {
                return None;
            }
            let arguments = process.arguments.iter().map(|argument| argument.clone().into_os_string());
            let settings = match run_args(arguments) {
                Ok(args) => {
                    let (given, file) = args?.into_parts();
                    let file = file.map_or_else(
                        || Ok(Default::default()),
                        |file| config::load_foreign(&self.path(&file), &file.to_string_lossy()),
                    );
                    file.ok().map(|file| given.or(file).settings())
                }
                // This is another version of Pinion.
                Err(_) => None,
            };
            let words: Vec<_> = process.arguments.iter().map(|word| word.to_string_lossy()).collect();
            let config = named_config(words.iter().map(AsRef::as_ref));
            Some(Running { pid, unit: self.unit_of(pid), config, settings })
        };
        self.processes().into_iter().filter_map(running).collect()
    }

    /// The unit that started a process of ours or klippy's, without `.service`. It is the unit of its control group
    /// (systemd.resource-control(5)). `None` if the process was started from a user's session or manager, which
    /// `sudo systemctl` does not reach. `None` also if another service's program started it, such as cron.
    pub(in crate::cli) fn unit_of(&self, pid: u32) -> Option<String> {
        let groups = self.text(format!("/proc/{pid}/cgroup"))?;
        let unit = process::unit(&groups)?;
        // The folders of units may not have the unit, such as an instance of a template. Then its name counts.
        let text = units::text(self, unit).unwrap_or_default();
        let starts_it = setting(&text, "ExecStart").is_none_or(|command| {
            let command = command.to_lowercase();
            ["pinion", "klippy", "klipper"].iter().any(|program| command.contains(program))
        });
        starts_it.then(|| unit.to_owned())
    }
}

/// The configuration file that a command line of any version of Pinion names.
pub(in crate::cli) fn named_config<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<String> {
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
/// has nothing to spoil.
pub(in crate::cli) fn print_at_risk(computer: &Computer) -> Option<String> {
    let proc = computer.path("/proc");
    let is_simulated = |pinion: &Running| matches!(&pinion.settings, Some(by) if matches!(by.board, BoardName::Sim(_)));
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
        let terminal = fs::canonicalize(&link).and_then(|device| process::Terminal::of(&device));
        let found = terminal.and_then(|terminal| process::find(&proc, terminal));
        let (host, is) = match found {
            Ok(Search::Nobody) => return None,
            Ok(Search::Found(host)) => (host, "is"),
            Ok(Search::Hidden(klippys)) => (klippys.into_iter().next()?, "may be"),
            Err(error) => {
                return Some(format!(
                    "whether a host is attached to {who} cannot be told: {}: {error}: stop this Pinion, or try with sudo",
                    link.display()
                ));
            }
        };
        let name = if host.is_klippy() { "klippy" } else { "a host" };
        let stop = match computer.unit_of(host.pid).filter(|_| host.is_klippy()) {
            Some(unit) => format!("sudo systemctl stop {unit}"),
            None => format!("end process {}", host.pid),
        };
        Some(format!(
            "{name} (process {}) {is} attached to {who}, and measuring keeps every processor busy, which makes steps late: wait until the print is done, then {stop}; pinion doctor measures gently meanwhile",
            host.pid
        ))
    })
}

#[cfg(test)]
mod tests {
    use crate::cli::computer::tests::Tree;

    #[test]
    fn the_unit_of_a_process_is_the_one_that_starts_it_again() {
        let tree = Tree::new();
        let unit = |group: &str| {
            tree.put("proc/7/cgroup", &format!("0::{group}\n"));
            tree.computer().unit_of(7)
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
    }
}
