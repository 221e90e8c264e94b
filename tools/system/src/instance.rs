// SPDX-License-Identifier: GPL-3.0-or-later
//! The instances of Pinion: the running ones, and those whose units are enabled.

use std::path::{Path, PathBuf};

use crate::config::{self, SYSTEM_FILE};
use crate::finding::Finding;
use crate::settings::{BoardName, Given, Settings, run_args};
use pinion_linux::foreign::word;
use pinion_runtime::klippy::{HOST_PATHS, is_host_path};

use super::running::{Running, named_config};
use super::units::{self, setting};
use super::{Computer, Who};

/// The unit of the usual instance.
const UNIT: &str = "pinion-mcu";
/// The configuration that the package delivers.
const DELIVERED: &str = "/usr/share/pinion-mcu/pinion.toml";
/// The unit that makes this link: the reverse of [`Files`].
pub fn unit_for(link: &Path) -> String {
    match link.to_string_lossy().strip_prefix(HOST_PATHS) {
        None | Some("mcu") => UNIT.to_owned(),
        Some(name) => format!("{UNIT}@{name}"),
    }
}

/// A Pinion that runs, or that will run.
pub struct Instance {
    /// The unit that starts it, without `.service`. `None` if it was started by hand.
    pub unit: Option<String>,
    /// Its process, if it runs.
    pub pid: Option<u32>,
    /// The configuration file that it reads, if any.
    config: Option<String>,
    /// Its settings, as far as they can be read.
    pub settings: Settings,
    /// Where klippy finds it. `None` if klippy does not find it.
    pub link: Option<PathBuf>,
}

/// The names of the files that belong to a unit.
struct Files {
    config: String,
    options: String,
    /// The unit's program makes `symlink`, and `link` leads klippy there.
    symlink: PathBuf,
    link: PathBuf,
}

impl Files {
    /// The files of systemd/pinion-mcu.service and pinion-mcu@.service. `None` for another unit.
    fn of(unit: &str) -> Option<Files> {
        let name = match unit.strip_prefix(UNIT)? {
            "" => None,
            name => Some(name.strip_prefix('@')?),
        };
        let named = name.unwrap_or("mcu");
        Some(Files {
            config: name.map_or_else(|| SYSTEM_FILE.to_owned(), |name| format!("/etc/pinion/{name}.toml")),
            options: format!("/etc/default/{UNIT}{}", name.map_or_else(String::new, |name| format!("-{name}"))),
            symlink: format!("/run/pinion/klipper_host_{named}").into(),
            link: format!("{HOST_PATHS}{named}").into(),
        })
    }
}

impl Instance {
    /// Its name for people.
    pub fn name(&self) -> String {
        match (&self.unit, self.pid) {
            (Some(unit), _) => unit.clone(),
            (None, Some(pid)) => format!("process {pid}"),
            (None, None) => UNIT.to_owned(),
        }
    }

    /// Whether klippy finds this computer's own pins at a link of this path.
    pub fn serves(&self, link: &Path) -> bool {
        self.settings.board == BoardName::Linux && self.link.as_deref() == Some(link)
    }

    /// How to restart it.
    pub fn restart(&self) -> String {
        match &self.unit {
            Some(unit) => format!("sudo systemctl restart {}", word(unit)),
            None => "restart Pinion".to_owned(),
        }
    }

    /// The user that it runs as, or will run as. `None` if unknown.
    pub fn user(&self, computer: &Computer) -> Option<Who> {
        if let Some(who) = self.pid.and_then(|pid| computer.user_of(pid)) {
            return Some(who);
        }
        let unit = self.unit.as_deref()?;
        // An instance of a template has no text of its own.
        let text =
            units::text(computer, unit).filter(|_| Files::of(unit).is_none()).unwrap_or_else(|| "User=pinion".into());
        let mut who = computer.user(setting(&text, "User").unwrap_or("root"))?;
        let groups = setting(&text, "SupplementaryGroups").unwrap_or_default().split_whitespace();
        who.gids.extend(groups.filter_map(|group| computer.gid_of(group)));
        Some(who)
    }

    /// Where to change its settings.
    pub fn config(&self) -> &str {
        self.config.as_deref().unwrap_or("its command line")
    }
}

/// All instances, or, if there are none, the one that the service would be. Also the errors in the files with their
/// settings.
pub fn instances(computer: &Computer) -> (Vec<Instance>, Vec<Finding>) {
    let running = computer.running();
    let mut units = units::enabled(computer, |unit| is_ours(computer, unit));
    units.retain(|unit| !running.iter().any(|running| running.unit.as_ref() == Some(unit)));
    if running.is_empty() && units.is_empty() {
        units.push(UNIT.to_owned());
    }
    let mut findings = Vec::new();
    let mut instances = Vec::new();
    for mut running in running {
        let unit = running.unit.take();
        instances.push(instance(computer, unit, Some(running), &mut findings));
    }
    for unit in units {
        instances.push(instance(computer, Some(unit), None, &mut findings));
    }
    (instances, findings)
}

/// Whether a unit starts Pinion: one of ours, or the one of Klipper's own program with Pinion in its place.
fn is_ours(computer: &Computer, unit: &str) -> bool {
    let is_pinion = || {
        let text = units::text(computer, unit).unwrap_or_default();
        let program = setting(&text, "ExecStart").and_then(|command| command.split_whitespace().next());
        program.is_some_and(|program| Path::new(program).file_name().is_some_and(|name| name == "pinion"))
    };
    Files::of(unit).is_some() || units::of_klipper_mcu(unit) && is_pinion()
}

/// Whether a unit starts Klipper's own program.
pub fn is_klipper_s(computer: &Computer, unit: &str) -> bool {
    units::of_klipper_mcu(unit) && !is_ours(computer, unit)
}

fn instance(
    computer: &Computer,
    unit: Option<String>,
    running: Option<Running>,
    findings: &mut Vec<Finding>,
) -> Instance {
    let files = unit.as_deref().and_then(Files::of);
    let (pid, config, settings) = match running {
        Some(Running { pid, config, settings, .. }) => (Some(pid), config, settings),
        None => (None, unit.as_deref().and_then(|unit| config_of(computer, unit)), None),
    };
    let given = match (&unit, &files) {
        (Some(unit), Some(files)) => given(computer, unit, files, config.as_deref(), findings),
        _ => Given::default(),
    };
    // The running process knows best. If its command line is another version's and not understood, real time is
    // expected.
    let settings = settings.unwrap_or_else(|| Given { realtime: Some(true), ..given }.settings());
    let link = if is_host_path(&settings.symlink) {
        Some(settings.symlink.clone())
    } else {
        // The unit's own link, or one that somebody has made.
        files.map(|files| files.link).or_else(|| link_to(computer, &settings.symlink))
    };
    Instance { unit, pid, config, settings, link }
}

/// The configuration file that a unit's program reads.
fn config_of(computer: &Computer, unit: &str) -> Option<String> {
    match setting(&units::text(computer, unit).unwrap_or_default(), "ExecStart") {
        Some(command) => named_config(command.split_whitespace()),
        // The unit is not installed, or it is an instance of a template.
        None => Files::of(unit).map(|files| files.config),
    }
}

/// A link that klippy takes and that leads to this path.
fn link_to(computer: &Computer, path: &Path) -> Option<PathBuf> {
    let mut links = computer.matching(format!("{HOST_PATHS}*")).into_iter().map(|link| computer.name(&link));
    links.find(|link| is_host_path(link) && computer.follow(link).is_ok_and(|way| way.contains(&computer.path(path))))
}

/// The settings in the files of a unit.
fn given(computer: &Computer, unit: &str, files: &Files, config: Option<&str>, findings: &mut Vec<Finding>) -> Given {
    let Files { options: options_name, symlink, .. } = files;
    let restart = format!("sudo systemctl restart {}", word(unit));
    let mut given = Given::default();
    match options(computer, options_name) {
        Ok(options) => given = given.or(options),
        Err(error) => findings.push(Finding::error(
            "options",
            format!("{options_name}: {error}"),
            format!("sudo nano {}, then {restart}", word(options_name)),
        )),
    }
    // This is on the unit's command line, before the options.
    given.symlink.get_or_insert_with(|| symlink.clone());
    let Some(config_name) = config else { return given };
    let file = computer.path(config_name);
    if file.exists() {
        match config::load_foreign(&file, config_name) {
            Ok(file) => {
                findings.push(Finding::ok("config", format!("{config_name} has no mistake")));
                given = given.or(file);
            }
            Err(error) => {
                let remedy = format!("sudo nano {}, then {restart}", word(config_name));
                findings.push(Finding::error("config", error.to_string(), remedy));
            }
        }
    } else if units::is_installed(computer, unit) {
        let remedy = match config_name {
            SYSTEM_FILE if computer.path(DELIVERED).exists() => {
                format!("sudo install -D -m 644 {DELIVERED} {SYSTEM_FILE}, then {restart}")
            }
            SYSTEM_FILE => "sudo make install".into(),
            name => format!("sudo cp {SYSTEM_FILE} {}, then {restart}", word(name)),
        };
        findings.push(Finding::error(
            "config",
            format!("there is no {config_name}, without which {unit} does not start"),
            remedy,
        ));
    }
    given
}

/// The options that the unit takes from the environment.
fn options(computer: &Computer, file: &str) -> Result<Given, String> {
    let text = computer.text(file).unwrap_or_default();
    // The last one counts (systemd.exec(5)).
    let Some(value) = text.lines().rev().find_map(|line| line.trim().strip_prefix("PINION_OPTIONS=")) else {
        return Ok(Given::default());
    };
    let words = value.trim().trim_matches(['"', '\'']).split_whitespace();
    match run_args(["pinion", "run"].into_iter().chain(words).map(Into::into)) {
        Ok(args) => Ok(args.map_or_else(Given::default, |args| args.given)),
        Err(error) => {
            let text = error.to_string();
            Err(text.lines().next().unwrap_or_default().trim_start_matches("error: ").to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finding::Level::{self, Error, Ok};
    use crate::tree::Tree;
    use std::fs;

    /// Asserts that there is this finding, and returns its remedy.
    fn says(findings: &[Finding], check: &str, status: Level, words: &str) -> String {
        let is_it = |finding: &&Finding| {
            finding.check == check && finding.status == status && finding.trouble.found().contains(words)
        };
        let found =
            findings.iter().find(is_it).unwrap_or_else(|| panic!("no {check} with \"{words}\" in {findings:#?}"));
        found.trouble.remedy.clone().unwrap_or_default().into()
    }

    #[test]
    fn what_the_service_runs_by() {
        let tree = Tree::empty();
        let read = || {
            let (mut instances, findings) = instances(&tree.computer());
            assert_eq!(instances.len(), 1);
            (instances.remove(0), findings)
        };
        assert!(read().1.is_empty());
        tree.put("etc/pinion/pinion.toml", "cpu = 2\nwatchdog = true\n");
        tree.put(
            "etc/default/pinion-mcu",
            "PINION_OPTIONS=\"-m 0600\"\n#PINION_OPTIONS=\"-x\"\nPINION_OPTIONS=\"--cpu 3\"\n",
        );
        let (Instance { settings, .. }, findings) = read();
        assert_eq!((settings.cpu, settings.watchdog, settings.access.mode), (Some(3), true, 0o660));
        says(&findings, "config", Ok, "has no mistake");
        tree.put("etc/pinion/pinion.toml", "\ncpus = 2\n");
        tree.put("etc/default/pinion-mcu", "PINION_OPTIONS=\"--cpux 3\"\n");
        let (_, findings) = read();
        says(&findings, "config", Error, "/etc/pinion/pinion.toml:2:1: cpus: there is no such key: did you mean cpu?");
        says(&findings, "options", Error, "/etc/default/pinion-mcu: unexpected argument '--cpux' found");
        tree.process(9, &["/usr/bin/pinion", "run", "--cpu", "1"], 0, &[]);
        assert_eq!(read().0.settings.cpu, Some(1), "what runs counts");
    }

    #[test]
    fn each_instance_has_files_and_a_link_of_its_own() {
        let tree = Tree::empty();
        for unit in ["pinion-mcu.service", "pinion-mcu@second.service", "other.service"] {
            tree.link(&format!("etc/systemd/system/multi-user.target.wants/{unit}"), "/usr/lib/systemd/system/x");
        }
        tree.put("etc/pinion/second.toml", "cpu = 3\nmargn_us = 1\n");
        tree.put("usr/lib/systemd/system/pinion-mcu@.service", "");
        let (found, findings) = instances(&tree.computer());
        let names: Vec<String> = found.iter().map(Instance::name).collect();
        assert_eq!(names, ["pinion-mcu", "pinion-mcu@second"]);
        assert_eq!(found[0].link.as_deref(), Some(Path::new("/tmp/klipper_host_mcu")));
        assert_eq!(found[1].link.as_deref(), Some(Path::new("/tmp/klipper_host_second")));
        let remedy = says(&findings, "config", Error, "/etc/pinion/second.toml:2:1: margn_us");
        assert_eq!(remedy, "sudo nano /etc/pinion/second.toml, then sudo systemctl restart pinion-mcu@second");
        fs::remove_file(tree.computer().path("/etc/pinion/second.toml")).unwrap();
        let (_, findings) = instances(&tree.computer());
        let remedy = says(&findings, "config", Error, "there is no /etc/pinion/second.toml");
        assert!(remedy.starts_with("sudo cp /etc/pinion/pinion.toml /etc/pinion/second.toml"), "{remedy}");
        // For a running instance the process counts. Its guardian is no instance.
        tree.put("etc/pinion/second.toml", "cpu = 3\n");
        let command =
            ["/usr/bin/pinion", "run", "-I", "/run/pinion/klipper_host_second", "--config", "/etc/pinion/second.toml"];
        for pid in [20, 21] {
            tree.process(pid, &command, 990, &[]);
            tree.put(&format!("proc/{pid}/cgroup"), "0::/system.slice/system-pinion.slice/pinion-mcu@second.service\n");
        }
        tree.put("proc/21/comm", "pinion-guardian\n");
        let (found, _) = instances(&tree.computer());
        let facts: Vec<_> = found.iter().map(|it| (it.name(), it.pid, it.settings.cpu)).collect();
        assert_eq!(facts, [("pinion-mcu@second".to_owned(), Some(20), Some(3)), ("pinion-mcu".to_owned(), None, None)]);
        assert_eq!(found[0].link.as_deref(), Some(Path::new("/tmp/klipper_host_second")));
    }

    #[test]
    fn an_instance_that_was_started_by_hand_may_have_a_link_that_klippy_does_not_take() {
        let tree = Tree::empty();
        tree.process(30, &["pinion", "run", "--board", "sim", "-I", "/home/pi/sim"], 0, &[]);
        let link = || instances(&tree.computer()).0[0].link.clone();
        assert_eq!(link(), None);
        tree.put("dev/pts/4", "");
        tree.link("home/pi/sim", "/dev/pts/4");
        tree.link("tmp/klipper_host_sim", "/home/pi/sim");
        assert_eq!(link().as_deref(), Some(Path::new("/tmp/klipper_host_sim")));
    }

    #[test]
    fn the_file_to_change_is_the_one_that_the_instance_reads() {
        let tree = Tree::empty();
        let config = || instances(&tree.computer()).0[0].config().to_owned();
        assert_eq!(config(), "/etc/pinion/pinion.toml");
        // A unit that the user has written.
        tree.link("etc/systemd/system/multi-user.target.wants/klipper-mcu.service", "../klipper-mcu.service");
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion -r\n");
        assert_eq!(config(), "its command line");
        let command = "[Service]\nExecStart=/usr/bin/pinion run --config=/home/pi/pins.toml -r\n";
        tree.put("etc/systemd/system/klipper-mcu.service", command);
        assert_eq!(config(), "/home/pi/pins.toml");
        // A running process counts, also one of another version.
        tree.process(9, &["/usr/bin/pinion", "run", "--new", "--config", "/home/pi/other.toml"], 0, &[]);
        assert_eq!(config(), "/home/pi/other.toml");
        tree.process(9, &["/usr/bin/pinion", "run", "-r"], 0, &[]);
        tree.put("proc/9/cgroup", "0::/system.slice/pinion-mcu.service\n");
        tree.put("etc/pinion/pinion.toml", "cpus = 3\n");
        assert_eq!(config(), "its command line");
        assert!(instances(&tree.computer()).1.is_empty(), "nobody reads that file");
    }

    #[test]
    fn the_c_program_s_unit_with_pinion_in_it_is_an_instance() {
        let tree = Tree::empty();
        tree.link("etc/systemd/system/multi-user.target.wants/klipper-mcu.service", "../klipper-mcu.service");
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/local/bin/klipper_mcu -r\n");
        assert!(is_klipper_s(&tree.computer(), "klipper-mcu"));
        assert_eq!(instances(&tree.computer()).0[0].name(), "pinion-mcu");
        tree.put(
            "etc/systemd/system/klipper-mcu.service.d/override.conf",
            "[Service]\nExecStart=\nExecStart=/usr/bin/pinion -r\n",
        );
        assert!(!is_klipper_s(&tree.computer(), "klipper-mcu"));
        let (found, _) = instances(&tree.computer());
        assert_eq!((found.len(), found[0].name().as_str()), (1, "klipper-mcu"));
        assert_eq!(found[0].link.as_deref(), Some(Path::new("/tmp/klipper_host_mcu")));
    }
}
