// SPDX-License-Identifier: GPL-3.0-or-later
//! The service: its configuration, whether it runs and in real time, and the obstacles to it.

use std::fs;
use std::path::Path;

use pinion_linux::foreign::word;
use pinion_linux::proc::stat_field;
use pinion_system::finding::{Finding, Level};
use pinion_system::manager::watchdog_of_systemd;
use pinion_system::settings::{BoardName, WATCHDOG, WATCHDOG_REMEDY};
use pinion_system::{Computer, units};

use super::INSTALL;
use pinion_system::instance::{Instance, is_klipper_s};

/// Number of the field in /proc/PID/stat that has the scheduling class.
const POLICY: usize = 41;
/// SCHED_FIFO (linux/sched.h).
const SCHED_FIFO: &str = "1";

pub(super) fn findings(computer: &Computer, instances: &[Instance]) -> Vec<Finding> {
    let of_each = instances
        .iter()
        .flat_map(|instance| {
            [
                Some(state(computer, instance)),
                former(computer, instance),
                board(instance),
                real_time(computer, instance),
            ]
        })
        .flatten();
    of_each.chain(c_program(computer, instances)).collect()
}

/// Whether an instance runs, and is started at boot.
fn state(computer: &Computer, instance: &Instance) -> Finding {
    const CHECK: &str = "service";
    let runs = |pid: u32| format!("Pinion runs as process {pid}");
    let Some(unit) = &instance.unit else {
        let by_hand = "no service has started it, and no service starts it at boot";
        return Finding::ok(CHECK, format!("{}: {by_hand}", runs(instance.pid.unwrap_or_default())));
    };
    let is_enabled = !units::enabled(computer, |name| name == unit).is_empty();
    let is_installed = units::is_installed(computer, unit);
    let word = word(unit);
    let enable = format!("sudo systemctl enable --now {word}");
    match (instance.pid, is_enabled) {
        (Some(pid), true) => Finding::ok(CHECK, format!("{} ({unit})", runs(pid))),
        (Some(pid), false) => {
            Finding::ok(CHECK, format!("{} ({unit}), but does not start at boot", runs(pid))).or(enable)
        }
        (None, true) => Finding::error(
            CHECK,
            format!("Pinion does not run, although its service is enabled ({unit})"),
            format!("sudo systemctl restart {word}; journalctl -u {word} says why it ended"),
        ),
        (None, false) if is_installed => Finding::warning(CHECK, "Pinion does not run", enable),
        (None, false) => Finding::warning(CHECK, "Pinion does not run, and its service is not installed", INSTALL),
    }
}

/// A program that an update has replaced, and that still runs. `None` also if the caller may not see the program.
fn former(computer: &Computer, instance: &Instance) -> Option<Finding> {
    let pid = instance.pid?;
    let program = fs::read_link(computer.path(format!("/proc/{pid}/exe"))).ok()?;
    // The kernel's words for a file that another one has replaced.
    program.to_str()?.strip_suffix(" (deleted)")?;
    let found = format!("an update has replaced the program of process {pid}, which still runs: a restart is due");
    Some(Finding::warning("version", found, format!("when no print runs: {}", instance.restart())))
}

/// `None` for an instance that has this computer's pins, as it should be.
fn board(instance: &Instance) -> Option<Finding> {
    const CHECK: &str = "board";
    let name = instance.name();
    match (&instance.settings.board, &instance.unit) {
        (BoardName::Linux, _) => None,
        (BoardName::Sim(_), None) => Some(Finding::ok(CHECK, format!("{name} has a simulated printer"))),
        (BoardName::Sim(_), Some(_)) => Some(Finding::warning(
            CHECK,
            format!("{name} has a simulated printer: no pin of this computer moves, whatever the host says"),
            format!(
                "leave out --board in PINION_OPTIONS and board in {}, then {}",
                instance.config(),
                instance.restart()
            ),
        )),
    }
}

/// Whether a running instance got the real time that it asked for. `None` if it does not run.
fn real_time(computer: &Computer, instance: &Instance) -> Option<Finding> {
    const CHECK: &str = "realtime";
    let pid = instance.pid?;
    if !instance.settings.realtime {
        let found = format!("Pinion (process {pid}) was not asked to run in real time");
        return Some(Finding::warning(CHECK, found, "use the service, or pinion run -r"));
    }
    let threads = computer.matching(format!("/proc/{pid}/task/*/stat"));
    let policies = threads.iter().filter_map(|thread| {
        let stat = computer.text(computer.name(thread))?;
        Some(stat_field(stat.as_bytes(), POLICY)? == SCHED_FIFO)
    });
    let policies: Vec<bool> = policies.collect();
    let log = instance.unit.as_ref().map_or(String::new(), |unit| format!(": journalctl -u {}", word(unit)));
    if !policies.is_empty()
        && !policies.contains(&true)
        && let Some((why, remedy)) = no_real_time(computer, pid)
    {
        let found = format!("Pinion (process {pid}) does not run in real time: {why}");
        return Some(Finding::warning(CHECK, found, remedy));
    }
    Some(match (policies.is_empty(), policies.contains(&true)) {
        (true, _) => Finding::ok(CHECK, format!("whether Pinion (process {pid}) runs in real time is unknown")),
        (_, true) => Finding::ok(CHECK, format!("Pinion (process {pid}) runs in real time")),
        _ => Finding::warning(
            CHECK,
            format!("Pinion (process {pid}) does not run in real time: it is not permitted"),
            format!("use the service; its log says what prevents real time{log}"),
        ),
    })
}

/// Why a process gets no real time although it is permitted: the kernel's groups, or a container without the capability.
fn no_real_time(computer: &Computer, pid: u32) -> Option<(&'static str, String)> {
    // With CONFIG_RT_GROUP_SCHED each group has a share of its own, and a new group's is 0.
    let groups = computer.text(format!("/proc/{pid}/cgroup")).unwrap_or_default();
    let has_none = groups.lines().any(|line| {
        let mut fields = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(group)) = (fields.next(), fields.next()) else { return false };
        let share = computer.text(format!("/sys/fs/cgroup/{controllers}{group}/cpu.rt_runtime_us"));
        controllers.split(',').any(|controller| controller == "cpu") && share.is_some_and(|share| share == "0")
    });
    if has_none {
        let why = "the kernel (RT_GROUP_SCHED) gives its control group no share of real time";
        return Some((
            why,
            "sudo sysctl kernel.sched_rt_runtime_us=-1, or boot a kernel without RT_GROUP_SCHED".into(),
        ));
    }
    let marks = ["/.dockerenv", "/run/.containerenv", "/run/systemd/container"];
    let is_container = marks.iter().any(|file| computer.exists(file));
    is_container.then(|| {
        let why = "the container has no right to real time";
        (why, "start the container with --cap-add=sys_nice --ulimit rtprio=99".into())
    })
}

/// Klipper's own program. It wants the same link and the same pins.
fn c_program(computer: &Computer, instances: &[Instance]) -> Vec<Finding> {
    const CHECK: &str = "klipper_mcu";
    const STOP: &str = "sudo systemctl disable --now klipper-mcu";
    const SCRIPT: &str = "/etc/init.d/klipper_mcu";
    // Klipper's scripts/flash-linux.sh starts whatever it finds, enabled or not.
    const STARTED_BY_FLASH: &str = "Klipper's make flash starts it, and that stops Pinion, even during a print";
    let mut findings = Vec::new();
    let is_it = |name: &std::ffi::OsStr| name == "klipper_mcu";
    let process = computer.processes(|process| process.program().is_some_and(is_it)).next();
    if let Some((process, _)) = process {
        let found = format!("Klipper's own klipper_mcu runs (process {}): it has the link and the pins", process.pid);
        findings.push(Finding::error(CHECK, found, STOP));
    }
    let is_enabled = |unit: &str| instances.iter().any(|instance| instance.unit.as_deref() == Some(unit));
    let is_pinion_enabled = !units::enabled(computer, is_enabled).is_empty();
    let enabled = units::enabled(computer, |unit| is_klipper_s(computer, unit));
    if !enabled.is_empty() {
        let names: Vec<String> = enabled.iter().map(|unit| format!("{unit}.service")).collect();
        let (is, it) = if let [_] = names[..] { ("is", "it is") } else { ("are", "they are") };
        let found = format!("{} {is} enabled: {it} started at boot, which stops Pinion", names.join(" and "));
        findings.push(Finding::error(CHECK, found, format!("sudo systemctl disable --now {}", names.join(" "))));
    } else if is_pinion_enabled
        && let Some((unit, file)) = units::all(computer).into_iter().find_map(|unit| {
            let file = units::file(computer, &unit).filter(|_| is_klipper_s(computer, &unit))?;
            Some((unit, file))
        })
    {
        // `systemctl mask` would make a link to /dev/null in the place of a file in that folder.
        let remedy = match file.starts_with(units::ADMINISTRATOR_S) {
            true => {
                let old = format!("{file}.before-pinion");
                format!("sudo mv {} {} && sudo systemctl daemon-reload", word(&file), word(old))
            }
            false => format!("sudo systemctl mask {}", word(&unit)),
        };
        findings.push(Finding::warning(CHECK, format!("{file} is still there: {STARTED_BY_FLASH}"), remedy));
    }
    // A System V script, as Klipper's documentation once had it.
    let is_started_at_boot = !computer.matching("/etc/rc*/S*klipper_mcu").is_empty();
    if !is_started_at_boot && is_pinion_enabled && computer.path(SCRIPT).exists() {
        let found = format!("{SCRIPT} is still there: {STARTED_BY_FLASH}");
        findings.push(Finding::warning(CHECK, found, format!("sudo mv {SCRIPT} /etc/klipper_mcu.before-pinion")));
    }
    if is_started_at_boot {
        let found = "/etc/init.d/klipper_mcu starts Klipper's own program at boot";
        findings.push(Finding::error(CHECK, found, "sudo update-rc.d -f klipper_mcu remove"));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(CHECK, "Klipper's own klipper_mcu neither runs nor is enabled"));
    }
    findings
}

/// The hardware watchdog, except for its permissions. `systemctl` is the program that asks the running systemd, if it
/// may be started.
pub(super) fn watchdog(computer: &Computer, instances: &[Instance], systemctl: Option<&Path>) -> Vec<Finding> {
    const CHECK: &str = "watchdog_device";
    let is_there = computer.path(WATCHDOG).exists();
    let feeding: Vec<&Instance> = instances.iter().filter(|instance| instance.settings.watchdog).collect();
    if feeding.is_empty() {
        let found = "Pinion does not feed the hardware watchdog";
        let finding = Finding::ok(CHECK, if is_there { found } else { "there is no hardware watchdog to feed" });
        let wanted = "to reset a computer that hangs: watchdog = true in /etc/pinion/pinion.toml";
        return vec![if is_there { finding.or(wanted) } else { finding }];
    }
    if !is_there {
        let found = format!("Pinion is configured to feed {WATCHDOG}, but there is none");
        return vec![Finding::error(CHECK, found, WATCHDOG_REMEDY)];
    }
    if let [first, second, ..] = feeding[..] {
        let found = format!(
            "{} and {} are both configured to feed {WATCHDOG}, but only one program can",
            first.name(),
            second.name()
        );
        let remedy = format!("watchdog = false in {}, then {}", second.config(), second.restart());
        return vec![Finding::error(CHECK, found, remedy)];
    }
    vec![match watchdog_of_systemd(computer, systemctl) {
        Some(taken) => Finding::of(CHECK, Level::Error, taken),
        None => Finding::ok(CHECK, format!("{WATCHDOG} is there")),
    }]
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok, Warning};
    use pinion_system::instance::instances;

    fn found(tree: &Tree) -> Vec<Finding> {
        let computer = tree.called_by(990);
        findings(&computer, &instances(&computer).0)
    }

    #[test]
    fn a_service_that_runs_or_not() {
        let tree = Tree::empty();
        says(&found(&tree), "service", Warning, "not installed");
        tree.put("usr/lib/systemd/system/pinion-mcu.service", "");
        assert_eq!(says(&found(&tree), "service", Warning, "does not run"), "sudo systemctl enable --now pinion-mcu");
        tree.process(10, &["/usr/bin/pinion", "run", "-r"], 990, &[]);
        tree.put("proc/10/cgroup", "0::/system.slice/pinion-mcu.service\n");
        assert_eq!(
            says(&found(&tree), "service", Ok, "Pinion runs as process 10 (pinion-mcu), but does not start at boot"),
            "sudo systemctl enable --now pinion-mcu"
        );
        tree.link("etc/systemd/system/multi-user.target.wants/pinion-mcu.service", "/usr/lib/systemd/system/x");
        says(&found(&tree), "service", Ok, "Pinion runs as process 10 (pinion-mcu)");
        // A process that somebody else has started is not the service's.
        tree.put("proc/10/cgroup", "0::/user.slice/user-1000.slice/session-1.scope\n");
        says(&found(&tree), "service", Ok, "Pinion runs as process 10: no service has started it");
        says(&found(&tree), "service", Error, "though its service is enabled");
        fs::remove_dir_all(tree.computer().path("/proc/10")).unwrap();
        tree.process(9, &["pinion", "doctor"], 0, &[]);
        let findings = found(&tree);
        says(&findings, "service", Error, "does not run, although its service is enabled (pinion-mcu)");
        assert_eq!(findings.iter().filter(|finding| finding.check == "service").count(), 1);
    }

    #[test]
    fn a_program_that_an_update_has_replaced_is_due_for_a_restart() {
        let tree = Tree::empty();
        tree.put("usr/lib/systemd/system/pinion-mcu.service", "");
        tree.process(10, &["/usr/bin/pinion", "run", "-r"], 990, &[]);
        tree.put("proc/10/cgroup", "0::/system.slice/pinion-mcu.service\n");
        let program = tree.computer().path("/proc/10/exe");
        let is_due = |target: &str| {
            fs::remove_file(&program).unwrap();
            tree.link("proc/10/exe", target);
            found(&tree).iter().any(|finding| finding.check == "version")
        };
        assert!(!is_due("/usr/bin/pinion"));
        assert!(is_due("/usr/bin/pinion (deleted)"));
        let remedy = says(&found(&tree), "version", Warning, "process 10, which still runs: a restart is due");
        assert_eq!(remedy, "when no print runs: sudo systemctl restart pinion-mcu");
    }

    #[test]
    fn a_service_with_the_simulated_printer_moves_nothing() {
        let tree = Tree::empty();
        tree.put("usr/lib/systemd/system/pinion-mcu.service", "");
        tree.link("etc/systemd/system/multi-user.target.wants/pinion-mcu.service", "x");
        tree.put("etc/pinion/pinion.toml", "");
        let is_told = || found(&tree).iter().any(|finding| finding.check == "board");
        assert!(!is_told());
        tree.put("etc/default/pinion-mcu", "PINION_OPTIONS=--board sim\n");
        let remedy = says(&found(&tree), "board", Warning, "pinion-mcu has a simulated printer: no pin");
        assert!(
            remedy.contains("board in /etc/pinion/pinion.toml, then sudo systemctl restart pinion-mcu"),
            "{remedy}"
        );
        tree.put("etc/default/pinion-mcu", "PINION_OPTIONS=--board linux\n");
        assert!(!is_told());
        // People try it by hand in this way.
        tree.process(10, &["pinion", "run", "--board", "sim"], 990, &[]);
        says(&found(&tree), "board", Ok, "process 10 has a simulated printer");
    }

    #[test]
    fn real_time_that_was_had_or_not() {
        let tree = Tree::empty();
        tree.process(10, &["/usr/bin/pinion", "run", "-r"], 990, &[]);
        says(&found(&tree), "realtime", Ok, "unknown");
        let stat = |policy: &str| format!("11 (co) re) S {} {policy} 0", vec!["0"; 37].join(" "));
        tree.put("proc/10/task/11/stat", stat("0"));
        says(&found(&tree), "realtime", Warning, "not permitted");
        // The cause, where it is known.
        tree.put("run/.containerenv", "");
        assert!(says(&found(&tree), "realtime", Warning, "the container has no right").contains("--cap-add=sys_nice"));
        tree.put("proc/10/cgroup", "3:cpu,cpuacct:/system.slice/x.service\n0::/x\n");
        tree.put("sys/fs/cgroup/cpu,cpuacct/system.slice/x.service/cpu.rt_runtime_us", "0\n");
        let remedy = says(&found(&tree), "realtime", Warning, "(RT_GROUP_SCHED) gives its control group no share");
        assert!(remedy.starts_with("sudo sysctl kernel.sched_rt_runtime_us=-1"), "{remedy}");
        tree.put("proc/10/task/12/stat", stat("1"));
        says(&found(&tree), "realtime", Ok, "runs in real time");
        // Each instance is judged.
        tree.process(12, &["/usr/bin/pinion", "run", "-I", "/tmp/klipper_host_b"], 990, &[]);
        let findings = found(&tree);
        says(&findings, "realtime", Ok, "Pinion (process 10) runs in real time");
        says(&findings, "realtime", Warning, "Pinion (process 12) was not asked");
    }

    #[test]
    fn the_c_program_is_in_the_way() {
        let tree = Tree::empty();
        says(&found(&tree), "klipper_mcu", Ok, "neither runs nor is enabled");
        tree.link("etc/systemd/system/multi-user.target.wants/klipper-mcu.service", "/etc/systemd/system/x");
        assert_eq!(
            says(&found(&tree), "klipper_mcu", Error, "is enabled"),
            "sudo systemctl disable --now klipper-mcu.service"
        );
        tree.link("etc/systemd/system/multi-user.target.wants/klipper_mcu.service", "/etc/systemd/system/x");
        assert_eq!(
            says(&found(&tree), "klipper_mcu", Error, "klipper-mcu.service and klipper_mcu.service are enabled"),
            "sudo systemctl disable --now klipper-mcu.service klipper_mcu.service"
        );
        let second = "/etc/systemd/system/multi-user.target.wants/klipper_mcu.service";
        fs::remove_file(tree.computer().path(second)).unwrap();
        tree.process(20, &["/usr/local/bin/klipper_mcu", "-r"], 0, &[]);
        says(&found(&tree), "klipper_mcu", Error, "runs (process 20)");
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion -r\n");
        assert_eq!(
            found(&tree).iter().filter(|finding| finding.check == "klipper_mcu").count(),
            1,
            "the unit starts Pinion, as the README says that it may"
        );
        let tree = Tree::empty();
        tree.link("etc/rc2.d/S01klipper_mcu", "../init.d/klipper_mcu");
        says(&found(&tree), "klipper_mcu", Error, "/etc/init.d/klipper_mcu");
    }

    #[test]
    fn a_unit_that_make_flash_would_start_is_in_the_way_though_it_is_not_enabled() {
        const UNIT: &str = "etc/systemd/system/klipper-mcu.service";
        let tree = Tree::empty();
        tree.put(UNIT, "[Service]\nExecStart=/usr/local/bin/klipper_mcu -r\n");
        says(&found(&tree), "klipper_mcu", Ok, "neither runs nor is enabled");
        tree.put("lib/systemd/system/pinion-mcu.service", "");
        tree.link("etc/systemd/system/multi-user.target.wants/pinion-mcu.service", "x");
        assert_eq!(
            says(&found(&tree), "klipper_mcu", Warning, &format!("/{UNIT} is still there")),
            format!("sudo mv /{UNIT} /{UNIT}.before-pinion && sudo systemctl daemon-reload")
        );
        fs::remove_file(tree.computer().path(UNIT)).unwrap();
        tree.put("lib/systemd/system/klipper-mcu.service", "");
        let remedy = says(&found(&tree), "klipper_mcu", Warning, "/lib/systemd/system/klipper-mcu.service is still");
        assert_eq!(remedy, "sudo systemctl mask klipper-mcu");
        tree.link(UNIT, "/dev/null");
        says(&found(&tree), "klipper_mcu", Ok, "neither runs nor is enabled");
        tree.put("etc/init.d/klipper_mcu", "");
        says(&found(&tree), "klipper_mcu", Warning, "/etc/init.d/klipper_mcu is still there");
    }

    #[test]
    fn a_watchdog_that_is_fed() {
        let tree = Tree::empty();
        let look = || watchdog(&tree.computer(), &instances(&tree.computer()).0, None);
        says(&look(), "watchdog_device", Ok, "there is no hardware watchdog to feed");
        tree.put("etc/pinion/pinion.toml", "watchdog = true\n");
        says(&look(), "watchdog_device", Error, "to feed /dev/watchdog, but there is none");
        tree.put("dev/watchdog", "");
        says(&look(), "watchdog_device", Ok, "is there");
        tree.put("etc/pinion/pinion.toml", "watchdog = false\n");
        assert!(says(&look(), "watchdog_device", Ok, "does not feed").contains("watchdog = true"));
        tree.put("etc/pinion/pinion.toml", "watchdog = true\n");
        tree.put("etc/systemd/system.conf", "#RuntimeWatchdogSec=20\n");
        says(&look(), "watchdog_device", Ok, "is there");
        tree.put("etc/systemd/system.conf.d/a.conf", "[Manager]\nRuntimeWatchdogSec=20\n");
        let remedy = says(&look(), "watchdog_device", Error, "/etc/systemd/system.conf.d/a.conf");
        assert!(remedy.contains("/etc/systemd/system.conf.d/a.pinion.conf"), "{remedy}");
        for unit in ["pinion-mcu", "pinion-mcu@b"] {
            tree.link(&format!("etc/systemd/system/multi-user.target.wants/{unit}.service"), "x");
        }
        tree.put("etc/default/pinion-mcu-b", "PINION_OPTIONS=-w\n");
        let remedy = says(&look(), "watchdog_device", Error, "pinion-mcu and pinion-mcu@b are both configured");
        assert!(remedy.contains("/etc/pinion/b.toml"), "{remedy}");
    }
}
