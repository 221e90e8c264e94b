// SPDX-License-Identifier: GPL-3.0-or-later
//! The service: its configuration, whether it runs, and in real time; and what stands in its way.

#![forbid(unsafe_code)]

use std::path::Path;

use crate::cli::config::{self, SYSTEM_FILE};
use crate::cli::finding::Finding;
use crate::cli::run::{Given, Settings, WATCHDOG};
use crate::cli::run_args;

use super::machine::{Machine, Running};

/// Where units stand, those of the administrator first (systemd.unit(5)).
pub(super) const UNIT_FOLDERS: [&str; 4] =
    ["/etc/systemd/system", "/usr/local/lib/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system"];
const OPTIONS_FILE: &str = "/etc/default/pinion-mcu";
/// SCHED_FIFO (linux/sched.h).
const SCHED_FIFO: &str = "1";

/// What the service runs by, and what is wrong with the files that say so.
pub(super) fn settings(machine: &Machine, running: Option<&Running>) -> (Settings, Vec<Finding>) {
    let mut findings = Vec::new();
    let mut given = Given::default();
    match options(machine) {
        Ok(options) => given = given.or(options),
        Err(error) => findings.push(Finding::error(
            "options",
            format!("{OPTIONS_FILE}: {error}"),
            format!("sudo nano {OPTIONS_FILE}, then sudo systemctl restart pinion-mcu"),
        )),
    }
    let file = machine.path(SYSTEM_FILE);
    if file.exists() {
        match config::load(&file) {
            Ok(file) => {
                findings.push(Finding::ok("config", format!("{SYSTEM_FILE} has no mistake")));
                given = given.or(file);
            }
            Err(error) => {
                let error = error.replacen(&*file.to_string_lossy(), SYSTEM_FILE, 1);
                let remedy = format!("sudo nano {SYSTEM_FILE}, then sudo systemctl restart pinion-mcu");
                findings.push(Finding::error("config", error, remedy));
            }
        }
    }
    // The one that runs knows best.
    let settings = running.and_then(|running| running.settings.clone()).unwrap_or_else(|| given.settings());
    (settings, findings)
}

/// The options that the unit takes from the environment.
fn options(machine: &Machine) -> Result<Given, String> {
    let text = machine.text(OPTIONS_FILE).unwrap_or_default();
    // The last one counts (systemd.exec(5)).
    let Some(value) = text.lines().rev().find_map(|line| line.trim().strip_prefix("PINION_OPTIONS=")) else {
        return Ok(Given::default());
    };
    let words = value.trim().trim_matches(['"', '\'']).split_whitespace();
    match run_args(["pinion", "run"].into_iter().chain(words).map(Into::into)) {
        Ok(args) => Ok(args.map_or_else(Given::default, |args| args.into_parts().0)),
        Err(error) => {
            let text = error.to_string();
            Err(text.lines().next().unwrap_or_default().trim_start_matches("error: ").to_owned())
        }
    }
}

pub(super) fn findings(machine: &Machine, running: Option<&Running>) -> Vec<Finding> {
    let mut findings = vec![state(machine, running)];
    findings.extend(running.and_then(|running| real_time(machine, running)));
    findings.extend(c_program(machine));
    findings
}

/// The folder of a unit, if it is installed and not masked.
fn unit(machine: &Machine, name: &str) -> Option<&'static str> {
    let is_there = |folder: &&&str| {
        let path = machine.path(folder).join(name);
        path.exists() && std::fs::read_link(&path).map_or(true, |target| target != Path::new("/dev/null"))
    };
    UNIT_FOLDERS.iter().find(is_there).copied()
}

/// Whether a unit is started at boot: some target wants it.
fn is_enabled(machine: &Machine, name: &str) -> bool {
    let folders = machine
        .names("/etc/systemd/system")
        .into_iter()
        .filter(|folder| [".wants", ".requires"].iter().any(|kind| folder.ends_with(kind)));
    folders
        .into_iter()
        .any(|folder| machine.names(format!("/etc/systemd/system/{folder}")).iter().any(|unit| unit == name))
}

fn state(machine: &Machine, running: Option<&Running>) -> Finding {
    const CHECK: &str = "service";
    const START: &str = "sudo systemctl enable --now pinion-mcu";
    let (is_installed, is_enabled) =
        (unit(machine, "pinion-mcu.service").is_some(), is_enabled(machine, "pinion-mcu.service"));
    match (running, is_installed, is_enabled) {
        (Some(Running { pid, .. }), _, true) => Finding::ok(CHECK, format!("Pinion runs as process {pid}")),
        (Some(Running { pid, .. }), true, false) => {
            Finding::ok(CHECK, format!("Pinion runs as process {pid}, and is not started at boot")).or(START)
        }
        (Some(Running { pid, .. }), false, false) => {
            Finding::ok(CHECK, format!("Pinion runs as process {pid}; its service is not installed"))
        }
        (None, _, true) => Finding::error(
            CHECK,
            "Pinion does not run, though its service is enabled",
            "sudo systemctl restart pinion-mcu; journalctl -u pinion-mcu says why it ended",
        ),
        (None, true, false) => Finding::warning(CHECK, "Pinion does not run", START),
        (None, false, false) => Finding::warning(
            CHECK,
            "Pinion does not run, and its service is not installed",
            "sudo apt install pinion-mcu, or sudo make install",
        ),
    }
}

/// Whether the Pinion that runs got the real time that it asked for; none if it did not ask.
fn real_time(machine: &Machine, running: &Running) -> Option<Finding> {
    const CHECK: &str = "realtime";
    let pid = running.pid;
    if running.settings.as_ref().is_some_and(|settings| !settings.realtime) {
        let found = format!("Pinion (process {pid}) was not asked to run in real time");
        return Some(Finding::warning(CHECK, found, "use the service, or pinion run -r"));
    }
    let threads = machine.names(format!("/proc/{pid}/task"));
    let policies = threads.iter().filter_map(|thread| {
        let stat = machine.text(format!("/proc/{pid}/task/{thread}/stat"))?;
        // The second field, the name in parentheses, may hold anything; policy is the 41st (proc(5)).
        Some(stat.rsplit_once(')')?.1.split_whitespace().nth(38)? == SCHED_FIFO)
    });
    let policies: Vec<bool> = policies.collect();
    Some(match (policies.is_empty(), policies.contains(&true)) {
        (true, _) => Finding::ok(CHECK, format!("whether Pinion (process {pid}) runs in real time is unknown")),
        (_, true) => Finding::ok(CHECK, format!("Pinion (process {pid}) runs in real time")),
        _ => Finding::warning(
            CHECK,
            format!("Pinion (process {pid}) does not run in real time: it is not permitted"),
            "use the service; its log says what keeps it from that: journalctl -u pinion-mcu",
        ),
    })
}

/// Klipper's own program, which wants the same link and the same pins.
fn c_program(machine: &Machine) -> Vec<Finding> {
    const CHECK: &str = "klipper_mcu";
    const STOP: &str = "sudo systemctl disable --now klipper-mcu";
    let mut findings = Vec::new();
    let is_it = |name: &std::ffi::OsStr| name == "klipper_mcu";
    let process = machine
        .processes()
        .into_iter()
        .find(|process| process.arguments.first().and_then(|program| program.file_name()).is_some_and(is_it));
    if let Some(process) = process {
        let found = format!("Klipper's own klipper_mcu runs (process {}): it has the link and the pins", process.pid);
        findings.push(Finding::error(CHECK, found, STOP));
    }
    let services = ["klipper-mcu.service", "klipper_mcu.service"];
    if let Some(service) = services.into_iter().find(|service| is_enabled(machine, service)) {
        let found = format!("{service} is enabled: at boot it is started beside Pinion, and stops it");
        findings.push(Finding::error(CHECK, found, format!("sudo systemctl disable --now {service}")));
    }
    // A script of System V's, as Klipper's documentation had it once.
    let script = machine.names("/etc").into_iter().filter(|name| name.starts_with("rc")).find_map(|folder| {
        let names = machine.names(format!("/etc/{folder}")).into_iter();
        names.into_iter().find(|name| name.starts_with('S') && name.ends_with("klipper_mcu"))
    });
    if script.is_some() {
        let found = "/etc/init.d/klipper_mcu starts Klipper's own program at boot";
        findings.push(Finding::error(CHECK, found, "sudo update-rc.d -f klipper_mcu remove"));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(CHECK, "Klipper's own klipper_mcu neither runs nor is enabled"));
    }
    findings
}

/// The hardware watchdog, as far as it is not a matter of permissions.
pub(super) fn watchdog(machine: &Machine, settings: &Settings) -> Vec<Finding> {
    const CHECK: &str = "watchdog_device";
    let is_there = machine.path(WATCHDOG).exists();
    if !settings.watchdog {
        let found = "Pinion does not feed the hardware watchdog";
        let finding =
            Finding::ok(CHECK, if is_there { found } else { "Pinion feeds no hardware watchdog, and there is none" });
        let wanted = "if a computer that hangs is to be reset: watchdog = true in /etc/pinion/pinion.toml";
        return vec![if is_there { finding.or(wanted) } else { finding }];
    }
    if !is_there {
        let remedy = "sudo modprobe softdog; on a Raspberry Pi dtparam=watchdog=on in config.txt, and reboot";
        return vec![Finding::error(CHECK, format!("there is no {WATCHDOG}, which Pinion is to feed"), remedy)];
    }
    let drop_ins = machine.names("/etc/systemd/system.conf.d").into_iter();
    let files = drop_ins.map(|name| format!("/etc/systemd/system.conf.d/{name}"));
    let other = std::iter::once("/etc/systemd/system.conf".to_owned()).chain(files).find(|file| {
        let text = machine.text(file).unwrap_or_default();
        let mut values = text.lines().filter_map(|line| line.trim().strip_prefix("RuntimeWatchdogSec="));
        values.next_back().is_some_and(|value| !["", "0", "off"].contains(&value.trim()))
    });
    vec![match other {
        Some(file) => Finding::error(
            CHECK,
            format!("{file} has systemd feed {WATCHDOG}, which only one program can do"),
            format!("sudo nano {file}: RuntimeWatchdogSec=off, and reboot"),
        ),
        None => Finding::ok(CHECK, format!("{WATCHDOG} is there")),
    }]
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Tree, told};
    use super::*;
    use crate::cli::finding::Level::{Error, Ok, Warning};

    fn found(tree: &Tree) -> Vec<Finding> {
        let machine = tree.machine();
        findings(&machine, machine.running().as_ref())
    }

    #[test]
    fn what_the_service_runs_by() {
        let tree = Tree::new();
        let read = || settings(&tree.machine(), tree.machine().running().as_ref());
        assert!(read().1.is_empty());
        tree.put("etc/pinion/pinion.toml", "cpu = 2\nwatchdog = true\n");
        tree.put(
            "etc/default/pinion-mcu",
            "PINION_OPTIONS=\"-m 0600\"\n#PINION_OPTIONS=\"-x\"\nPINION_OPTIONS=\"--cpu 3\"\n",
        );
        let (settings, findings) = read();
        assert_eq!((settings.cpu, settings.watchdog, settings.access.mode), (Some(3), true, 0o660));
        told(&findings, "config", Ok, "has no mistake");
        tree.put("etc/pinion/pinion.toml", "\ncpus = 2\n");
        tree.put("etc/default/pinion-mcu", "PINION_OPTIONS=\"--cpux 3\"\n");
        let (_, findings) = read();
        told(&findings, "config", Error, "/etc/pinion/pinion.toml:2:1: cpus: there is no such key: did you mean cpu?");
        told(&findings, "options", Error, "/etc/default/pinion-mcu: unexpected argument '--cpux' found");
        tree.process(9, &["/usr/bin/pinion", "run", "--cpu", "1"], 0, &[]);
        assert_eq!(read().0.cpu, Some(1), "what runs counts");
    }

    #[test]
    fn a_service_that_runs_or_not() {
        let tree = Tree::new();
        told(&found(&tree), "service", Warning, "not installed");
        tree.put("usr/lib/systemd/system/pinion-mcu.service", "");
        assert_eq!(told(&found(&tree), "service", Warning, "does not run"), "sudo systemctl enable --now pinion-mcu");
        tree.link("etc/systemd/system/multi-user.target.wants/pinion-mcu.service", "/usr/lib/systemd/system/x");
        told(&found(&tree), "service", Error, "though its service is enabled");
        tree.process(9, &["pinion", "doctor"], 0, &[]);
        told(&found(&tree), "service", Error, "does not run");
        tree.process(10, &["/usr/bin/pinion", "run", "-r"], 990, &[]);
        told(&found(&tree), "service", Ok, "Pinion runs as process 10");
    }

    #[test]
    fn real_time_that_was_had_or_not() {
        let tree = Tree::new();
        tree.process(10, &["/usr/bin/pinion", "run", "-r"], 990, &[]);
        told(&found(&tree), "realtime", Ok, "unknown");
        let stat = |policy: &str| format!("11 (co) re) S {} {policy} 0", vec!["0"; 37].join(" "));
        tree.put("proc/10/task/11/stat", &stat("0"));
        told(&found(&tree), "realtime", Warning, "not permitted");
        tree.put("proc/10/task/12/stat", &stat("1"));
        told(&found(&tree), "realtime", Ok, "runs in real time");
        tree.process(10, &["/usr/bin/pinion", "run"], 990, &[]);
        told(&found(&tree), "realtime", Warning, "was not asked");
    }

    #[test]
    fn the_c_program_is_in_the_way() {
        let tree = Tree::new();
        told(&found(&tree), "klipper_mcu", Ok, "neither runs nor is enabled");
        tree.link("etc/systemd/system/multi-user.target.wants/klipper-mcu.service", "/etc/systemd/system/x");
        assert_eq!(
            told(&found(&tree), "klipper_mcu", Error, "is enabled"),
            "sudo systemctl disable --now klipper-mcu.service"
        );
        tree.process(20, &["/usr/local/bin/klipper_mcu", "-r"], 0, &[]);
        told(&found(&tree), "klipper_mcu", Error, "runs (process 20)");
        let tree = Tree::new();
        tree.link("etc/rc2.d/S01klipper_mcu", "../init.d/klipper_mcu");
        told(&found(&tree), "klipper_mcu", Error, "/etc/init.d/klipper_mcu");
    }

    #[test]
    fn a_watchdog_that_is_fed() {
        let tree = Tree::new();
        let (fed, not) = (Given { watchdog: Some(true), ..Given::default() }.settings(), Given::default().settings());
        told(&watchdog(&tree.machine(), &not), "watchdog_device", Ok, "there is none");
        told(&watchdog(&tree.machine(), &fed), "watchdog_device", Error, "there is no /dev/watchdog");
        tree.put("dev/watchdog", "");
        assert!(
            told(&watchdog(&tree.machine(), &not), "watchdog_device", Ok, "does not feed").contains("watchdog = true")
        );
        tree.put("etc/systemd/system.conf", "#RuntimeWatchdogSec=20\n");
        told(&watchdog(&tree.machine(), &fed), "watchdog_device", Ok, "is there");
        tree.put("etc/systemd/system.conf.d/a.conf", "[Manager]\nRuntimeWatchdogSec=20\n");
        told(&watchdog(&tree.machine(), &fed), "watchdog_device", Error, "/etc/systemd/system.conf.d/a.conf");
    }
}
