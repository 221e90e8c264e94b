// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor`: what works, what does not, and how to fix it.
//!
//! Each check reads files below a root, so that a test can make them. It reports its findings, and calls unknown
//! whatever it cannot know. Nothing is changed.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::SystemTime;

use clap::{Args, ValueHint};

use pinion_linux::Inventory;
use pinion_runtime::latency::{self, Assessment, Fitness};

use super::add;
use super::page::Page;
use super::report::{self, Group};
use super::{failed, quietly};
use pinion_system::Computer;
use pinion_system::board::{self, Board};
use pinion_system::complete::offering;
use pinion_system::finding::Finding;
use pinion_system::instance;
use pinion_system::klippy::klippys;
use pinion_system::manager::SYSTEMCTL;
use pinion_system::printer::Printer;
use pinion_system::uses::Uses;

mod devices;
mod host;
mod kernel;
mod klipper;
mod last_stop;
mod leds;
mod lines;
mod outputs;
mod power;
mod serial;
mod service;
mod terminal;
mod uses;

/// How to get the package.
const INSTALL: &str = "sudo apt install pinion-mcu, from the repository that docs/guide/install.md sets up (or in a folder with Pinion's sources: sudo make install)";
/// How to install its files again.
const REINSTALL: &str =
    "sudo apt install --reinstall pinion-mcu (or in a folder with Pinion's sources: sudo make install)";
/// How to get a newer version.
const UPGRADE: &str = "sudo apt update && sudo apt install pinion-mcu (or in the folder with Pinion's sources: git pull && sudo make install)";

/// Options of `pinion doctor`.
#[derive(Args, Clone, Debug)]
pub(super) struct DoctorArgs {
    /// Also check a checkout of Klipper or Kalico: does this Pinion serve that host? Ask before you restart
    /// the host
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    klipper: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Leave out the latency, which takes two seconds
    #[arg(long)]
    no_latency: bool,
    /// Check the system whose files are below DIR, for example a mounted card
    #[arg(long, value_name = "DIR", default_value = "/", value_hint = ValueHint::DirPath)]
    root: PathBuf,
    /// The board, if its device tree is not there, as on a mounted card
    #[arg(long, value_name = "BOARD", value_parser = offering::<String>(&board::NAMES), hide_possible_values = true)]
    board: Option<String>,
}

/// Prints the findings. Fails if something does not work.
pub(super) fn run(args: &DoctorArgs) -> ExitCode {
    let checkout = match args.klipper.as_deref().map(klipper::read).transpose() {
        Ok(checkout) => checkout,
        Err(error) => return failed(error),
    };
    let (computer, board) = match Computer::named(&args.root, args.board.as_deref()) {
        Ok(found) => found,
        Err(why) => return failed(why),
    };
    let mut groups = quietly(|| examine(&computer, board.as_ref(), !args.no_latency));
    if let Some(checkout) = &checkout {
        groups.push(Group::new("checkout", vec![klipper::finding(checkout)]));
    }
    if args.json {
        return report::finish(&report::json(&groups), &groups);
    }
    let mut page = Page::default();
    if let Some(checkout) = &checkout {
        klipper::report(checkout, &mut page);
        page.line("");
    }
    page.append(&report::text(&groups));
    report::finish(&page, &groups)
}

fn examine(computer: &Computer, board: Option<&Board>, measures: bool) -> Vec<Group> {
    let (instances, configurations) = instance::instances(computer);
    let klippys = klippys(computer);
    let uarts = host::of_all(&klippys, Printer::uarts);
    let program = |path: &'static str| computer.is_this().then_some(Path::new(path));
    let inventory = computer.is_this().then(Inventory::scan);
    let uses = Uses::find(computer, board, None, inventory.as_ref());
    let mut groups = vec![
        Group::new("last stop", vec![last_stop::finding(computer, SystemTime::now())]),
        Group::new("kernel", kernel::findings(computer, &instances)),
        Group::new("service", [configurations, service::findings(computer, &instances)].concat()),
        Group::new("watchdog", service::watchdog(computer, &instances, program(SYSTEMCTL))),
        Group::new("terminal", terminal::terminals(computer, &instances, &klippys)),
        Group::new(
            "host",
            host::dialects(computer, &instances, &klippys).into_iter().chain(host::strangers(computer)).collect(),
        ),
        Group::new(
            "pins and buses",
            [
                devices::presence(computer, &uses.config_txt),
                host::unchecked(&klippys),
                outputs::released(computer),
                leds::leds(computer, &uses.config_txt, &host::of_all(&klippys, Printer::spi_leds)),
                leds::line_leds(computer, &instances, &host::of_all(&klippys, Printer::line_leds)),
                serial::ports(computer, &uarts),
                uses::conflicts(&uses),
                uses::no_lines(&uses),
                uses::slow_buses(computer, &uses),
                uses::numpy(computer, &klippys),
                add::missing(computer, &uses),
            ]
            .concat(),
        ),
        Group::new("permissions", devices::permissions(computer, &instances, &uarts)),
        Group::new("power", power::power(computer, program("/usr/bin/vcgencmd"))),
    ];
    if let Some(inventory) = &inventory {
        let is_serving = instances.iter().any(|instance| instance.pid.is_some());
        let pins = host::of_all(&klippys, Printer::numbered);
        let pins = lines::of_instances(&instances, &pins);
        groups.insert(7, Group::new("lines", lines::header(computer, inventory, &pins)));
        groups.extend(measures.then(|| Group::new("latency", vec![latency(latency::sample(is_serving))])));
    }
    groups
}

/// A sample of two seconds proves nothing, so its result is no error.
fn latency(sample: Result<Assessment, String>) -> Finding {
    const CHECK: &str = "latency";
    match sample {
        Err(error) => Finding::warning(CHECK, format!("the latency is unknown: {error}"), "pinion latency"),
        Ok(Assessment { fitness, why, remedy }) => {
            let found = format!("{fitness}: {why} (in two seconds; pinion latency measures for longer)");
            match (fitness, remedy) {
                (Fitness::Steppers, None) => Finding::ok(CHECK, found),
                (_, remedy) => Finding::warning(CHECK, found, remedy.unwrap_or_else(|| "pinion latency".into())),
            }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level;
    use std::fs;

    /// Asserts that a check has found something with these words, and returns the remedy.
    #[track_caller]
    pub(crate) fn says(findings: &[Finding], check: &str, status: Level, words: &str) -> String {
        let is_it = |finding: &&Finding| {
            finding.check == check && finding.status == status && finding.trouble.found().contains(words)
        };
        let found = findings.iter().find(is_it);
        assert!(found.is_some(), "no {status:?} of {check} with \"{words}\" in {findings:#?}");
        found.and_then(|finding| finding.trouble.remedy.clone()).unwrap_or_default().into()
    }

    #[test]
    fn a_computer_without_any_files_has_no_errors() {
        let tree = Tree::empty();
        let groups = examine(&tree.computer(), None, true);
        let errors: Vec<&Finding> =
            groups.iter().flat_map(|group| &group.findings).filter(|finding| finding.status == Level::Error).collect();
        assert!(errors.is_empty(), "{errors:?}");
        assert!(groups.iter().all(|group| !group.findings.is_empty()), "{groups:?}");
    }

    #[test]
    fn files_that_are_something_else_are_no_reason_to_hang_or_panic() {
        let tree = Tree::empty();
        let text = "\0\u{fffd} 99999999999999999999 : = [ ) (";
        for path in [
            "proc/version",
            "proc/1/cmdline",
            "proc/1/stat",
            "proc/1/status",
            "proc/sys/kernel/sched_rt_runtime_us",
            "proc/sys/kernel/sched_rt_period_us",
            "sys/devices/system/cpu/isolated",
            "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
            "etc/passwd",
            "etc/group",
            "etc/default/pinion-mcu",
            "etc/systemd/system/klipper.service",
            "boot/config.txt",
            "proc/device-tree/model",
        ] {
            tree.put(path, text);
        }
        examine(&tree.computer(), None, true);
        // A pipe without a writer, and a folder in a file's place.
        let pipe = tree.computer().path("/sys/kernel/realtime");
        fs::create_dir_all(pipe.parent().unwrap()).unwrap();
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
        fs::create_dir_all(tree.computer().path("/etc/pinion/pinion.toml")).unwrap();
        // Processes that call themselves Pinion and klippy, and name the pipe.
        tree.process(7, &["/tmp/pinion", "run", "--config", "/sys/kernel/realtime"], 65534, &[]);
        tree.process(8, &["python3", "/tmp/klippy.py", "/sys/kernel/realtime"], 65534, &[]);
        examine(&tree.computer(), None, true);
        examine(&tree.called_by(65534), None, true);
    }

    #[test]
    fn names_that_hold_anything_stay_in_their_lines() {
        let tree = Tree::empty();
        let name = "a\n  error    forged\n<0>b\x1b[2Jc\r\u{9b}d";
        let config = format!("/home/{name}/printer.cfg");
        let klippy = format!("/home/{name}/klippy/klippy.py");
        for pid in [7, 8] {
            tree.process(pid, &["python3", &klippy, &config], 65534, &[]);
            tree.process(pid + 10, &["/tmp/pinion", "run", "-I", &format!("/tmp/klipper_host_{name}")], 65534, &[]);
        }
        for (pid, unit) in
            [(7, "klipper"), (8, "klippy\\x20\x1b\u{202e};reboot"), (17, "pinion-mcu"), (18, "pinion $(id)")]
        {
            tree.put(&format!("proc/{pid}/cgroup"), format!("0::/system.slice/{unit}.service\n"));
        }
        tree.put(&config[1..], format!("[mcu]\nserial: /tmp/klipper_host_{}\n", name.replace('\n', "")));
        tree.put(&format!("etc/systemd/system/multi-user.target.wants/pinion-mcu@{name}.service"), "");
        tree.put("etc/default/pinion-mcu", "PINION_OPTIONS=\"--cpux\x1b[2J\"");
        tree.put("etc/pinion/pinion.toml", "symlink\x1b[2J = 1\n");
        tree.put("proc/sys/kernel/osrelease", name);
        tree.put("proc/device-tree/model", name);
        tree.put("sys/devices/system/cpu/isolated", name);
        tree.link("tmp/klipper_host_mcu", &format!("/dev/{name}"));
        let groups = examine(&tree.computer(), None, true);
        let page = report::text(&groups);
        pinion_testkit::names::assert_plain(&page.to_string(), page.lines().count());
        let is_ours = |line: &str| {
            ["  ok       ", "  warning  ", "  error    ", "           -> "].iter().any(|head| line.starts_with(head))
                || groups.iter().any(|group| group.name == line)
        };
        let foreign: Vec<&str> = page.lines().filter(|line| !is_ours(line)).collect();
        assert_eq!(foreign.len(), 1, "all but the last line: {foreign:#?}");
        assert!(!page.lines().any(|line| line.starts_with("  error    forged")), "{page}");
        assert!(page.to_string().contains("a?  error    forged?<0>b?[2Jc?"), "{page}");
        // Nor does a name leave its word in a command.
        assert!(page.to_string().contains("systemctl enable --now 'pinion $(id)'\n"), "{page}");
    }

    #[test]
    fn a_sample_is_no_error() {
        let verdict = |fitness, remedy: Option<&str>| {
            latency(Ok(Assessment { fitness, why: "x".into(), remedy: remedy.map(str::to_owned) }))
        };
        assert_eq!(verdict(Fitness::Steppers, None).status, Level::Ok);
        assert_eq!(verdict(Fitness::Steppers, Some("run it as root")).status, Level::Warning);
        assert_eq!(verdict(Fitness::Nothing, Some("isolate")).trouble.remedy.as_deref(), Some("isolate"));
        assert_eq!(latency(Err("no thread".into())).status, Level::Warning);
    }
}
