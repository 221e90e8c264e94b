// SPDX-License-Identifier: GPL-3.0-or-later
//! The host: which klippys there are, and whether Pinion speaks their messages.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::cli::computer::units::{self, setting};
use crate::cli::computer::{Computer, Who};
use crate::cli::finding::{Finding, Level};
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::DialectName;
use pinion_firmware::trouble::Trouble;
use pinion_linux::foreign::word;
use pinion_runtime::klippy::command_line::{self, klippy_config};
use pinion_runtime::klippy::process::Process;
use pinion_runtime::klippy::{self as host, Checkout};

use super::UPGRADE;
use super::instance::Instance;
use super::klipper;
use super::printer::{self, Printer};

/// A klippy that runs or is set up.
pub(in crate::cli) struct Klippy {
    pub(super) who: Who,
    /// The folder of klippy.py.
    folder: Option<PathBuf>,
    /// The path of its configuration, if the command line has all of it.
    pub(in crate::cli) config: Option<PathBuf>,
    /// Its configuration, or why the doctor cannot use it. `None` if its path is not known.
    printer: Option<Result<Printer, Trouble>>,
    /// How it was found.
    pub(super) found_by: String,
    /// The unit that starts it, without `.service`.
    pub(super) unit: Option<String>,
    /// A running klippy has the groups of the time when it was started.
    pub(super) is_running: bool,
}

impl Klippy {
    /// Its configuration, if the doctor can use it.
    pub(super) fn printer(&self) -> Option<&Printer> {
        self.printer.as_ref()?.as_ref().ok()
    }

    /// Whether it opens this link, as far as is known.
    pub(super) fn opens(&self, link: &Path) -> bool {
        self.printer().is_none_or(|printer| printer.serials.contains(link))
    }

    pub(super) fn restart(&self) -> String {
        format!("sudo systemctl restart {}", word(self.unit.as_deref().unwrap_or("klipper")))
    }
}

/// Each klippy: the running ones that no stranger has started, and those whose units are enabled. If there is none: the
/// installed ones.
pub(in crate::cli) fn klippys(computer: &Computer) -> Vec<Klippy> {
    let processes = computer.processes(Process::is_klippy);
    let mut klippys: Vec<Klippy> = processes.filter_map(|(process, unit)| running(computer, &process, unit)).collect();
    let runs: BTreeSet<String> = klippys.iter().filter_map(|klippy| klippy.unit.clone()).collect();
    let units = units::enabled(computer, |unit| !runs.contains(unit));
    klippys.extend(units.iter().filter_map(|unit| set_up(computer, unit)));
    if klippys.is_empty() {
        klippys.extend(units::all(computer).iter().filter_map(|unit| set_up(computer, unit)));
    }
    klippys
}

fn running(computer: &Computer, process: &Process, unit: Option<String>) -> Option<Klippy> {
    let proc = computer.path("/proc");
    let config = process.klippy_config(&proc).map(|config| computer.name(&config));
    let named = klippy_config(&process.arguments).filter(|config| config.is_absolute()).map(Path::to_owned);
    Some(Klippy {
        who: computer.user_of(process.pid)?,
        config: named,
        folder: process.klippy_folder(&proc).map(|folder| reachable(computer, folder)),
        printer: config.map(|config| printer::read(computer, &config)),
        found_by: format!("process {}", process.pid),
        unit,
        is_running: true,
    })
}

/// The klippy that a unit starts. `None` if it starts something else.
fn set_up(computer: &Computer, unit: &str) -> Option<Klippy> {
    let text = units::text(computer, unit)?;
    let arguments = arguments(computer, &text)?;
    let folder = command_line::klippy(&arguments).filter(|folder| folder.is_absolute())?;
    let user = setting(&text, "User").unwrap_or("root");
    let who = computer.user(user).unwrap_or_else(|| match user {
        "root" => Who { name: "root".into(), uid: 0, gids: vec![0] },
        // Nothing is known about this user.
        _ => Who { name: user.to_owned(), uid: u32::MAX, gids: vec![] },
    });
    Some(Klippy {
        who,
        folder: Some(computer.path(folder)),
        config: klippy_config(&arguments).filter(|config| config.is_absolute()).map(Path::to_owned),
        printer: klippy_config(&arguments).map(|config| printer::read(computer, config)),
        found_by: format!("{unit}.service"),
        unit: Some(unit.to_owned()),
        is_running: false,
    })
}

/// Where this program finds a folder that the process names.
fn reachable(computer: &Computer, folder: PathBuf) -> PathBuf {
    if folder.starts_with(computer.path("/proc")) { folder } else { computer.path(folder) }
}

/// klippy's command line, from a unit's command or from the file with its arguments.
fn arguments(computer: &Computer, unit: &str) -> Option<Vec<PathBuf>> {
    let file = setting(unit, "EnvironmentFile").map(|file| file.trim_start_matches('-'));
    let texts = [setting(unit, "ExecStart").map(str::to_owned), file.and_then(|file| computer.text(file))];
    texts.into_iter().flatten().find_map(|text| {
        let words = text.split([' ', '\t', '\n', '"', '\'', '=']).filter(|word| !word.is_empty());
        let words: Vec<PathBuf> = words.map(PathBuf::from).collect();
        command_line::klippy(&words).is_some().then_some(words)
    })
}

/// The checks that are left out because a klippy's configuration cannot be used.
pub(super) fn unchecked(klippys: &[Klippy]) -> Vec<Finding> {
    let refused = klippys.iter().filter_map(|klippy| klippy.printer.as_ref()?.as_ref().err());
    let finding = |trouble: &Trouble| {
        let cause = format!("{}, so its LEDs, UARTs, pins and devices are not checked", trouble.cause);
        Finding::of("printer_cfg", Level::Warning, Trouble { cause: cause.into(), ..trouble.clone() })
    };
    let mut findings: Vec<Finding> = refused.map(finding).collect();
    findings.dedup();
    findings
}

pub(super) fn printers(klippys: &[Klippy]) -> impl Iterator<Item = &Printer> {
    klippys.iter().filter_map(Klippy::printer)
}

/// The pins of LEDs on SPI buses in the klippys' configurations.
pub(super) fn leds(klippys: &[Klippy]) -> BTreeSet<&str> {
    printers(klippys).flat_map(|printer| &printer.leds).map(String::as_str).collect()
}

/// The pins of other LEDs in the klippys' configurations, with the link to their MCU.
pub(super) fn line_leds(klippys: &[Klippy]) -> BTreeSet<(&Path, &str)> {
    printers(klippys).flat_map(|printer| &printer.line_leds).map(|(link, pin)| (link.as_path(), pin.as_str())).collect()
}

/// The pins by the number of their chip in the klippys' configurations, with the link to their MCU.
pub(super) fn numbered_pins(klippys: &[Klippy]) -> BTreeSet<(&Path, &str)> {
    printers(klippys).flat_map(|printer| &printer.numbered).map(|(link, pin)| (link.as_path(), pin.as_str())).collect()
}

/// The serial ports of drivers in the klippys' configurations.
pub(super) fn uarts(klippys: &[Klippy]) -> BTreeSet<&str> {
    printers(klippys).flat_map(|printer| &printer.uarts).map(|pin| printer::name_of(pin)).collect()
}

/// Whether Pinion speaks the messages of each host.
pub(super) fn dialects(computer: &Computer, instances: &[Instance], klippys: &[Klippy]) -> Vec<Finding> {
    if klippys.is_empty() {
        let found = "which host comes is unknown: no klippy runs, and no unit starts one";
        return vec![Finding::ok(DIALECT, found).or("pinion doctor --klipper DIR looks at a checkout")];
    }
    klippys.iter().flat_map(|klippy| dialect(computer, instances, klippy)).collect()
}

/// The processes that are called like a Pinion or a klippy, and that are neither a service's nor root's nor the
/// caller's. Any user can have one, and no other finding is about them.
pub(super) fn strangers(computer: &Computer) -> Option<Finding> {
    /// A user can have thousands.
    const SHOWN: usize = 5;
    let strangers = computer.strangers();
    let pids: Vec<String> = strangers.iter().take(SHOWN).map(|process| process.pid.to_string()).collect();
    let more = strangers.len().checked_sub(SHOWN).filter(|more| *more > 0);
    let more = more.map_or(String::new(), |more| format!(" and {more} more"));
    let found = format!(
        "other users have processes with the names of a Pinion or a klippy, which do not count here: {}{more}",
        pids.join(", ")
    );
    (!strangers.is_empty())
        .then(|| Finding::ok("strangers", found).or("if one of them is yours, have a service start it"))
}

const DIALECT: &str = "dialect";

fn dialect(computer: &Computer, instances: &[Instance], klippy: &Klippy) -> Vec<Finding> {
    let Klippy { folder, found_by, .. } = klippy;
    let Some(folder) = folder else {
        let found = format!("klippy's sources ({found_by}) are not known: its folder may not be looked into");
        return vec![Finding::warning(DIALECT, found, "sudo pinion doctor")];
    };
    let shown = computer.name(folder);
    // /proc/PID/root is the process's own root.
    let own: PathBuf = shown.components().skip(4).collect();
    let shown = if shown.starts_with("/proc") { Path::new("/").join(own) } else { shown };
    let checkout = match Checkout::read(folder, FEATURES) {
        Ok(checkout) => checkout,
        Err(error) => {
            let found = format!("klippy's sources in {} ({found_by}) cannot be read: {error}", shown.display());
            return vec![Finding::warning(DIALECT, found, "sudo pinion doctor, or pinion doctor --klipper DIR")];
        }
    };
    let commit = checkout.commit.as_ref().map_or(String::new(), |commit| format!(", commit {commit}"));
    let host = format!("the host is klippy of {}{commit} ({found_by})", shown.display());
    let missing = klipper::missing(&checkout);
    let serves = |instance: &&Instance| instance.link.as_ref().is_some_and(|link| klippy.opens(link));
    let configured =
        instances.iter().filter(serves).filter_map(|instance| Some((instance, instance.settings.dialect?)));
    let configured: Vec<(&Instance, DialectName)> = configured.collect();
    // A dialect that is configured may lack messages that the host would get without it.
    let lacks = |name: DialectName| checkout.missing(&name.into(), FEATURES);
    let wrong = configured.iter().map(|(instance, name)| (instance, name, lacks(*name)));
    let wrong = wrong.max_by_key(|(_, _, lacks)| lacks.len()).filter(|(_, _, lacks)| lacks.len() > missing.len());
    let mut findings = vec![match (wrong, configured.first()) {
        (Some((instance, name, lacks)), _) => Finding::warning(
            DIALECT,
            format!(
                "{host}: Pinion's configuration names the dialect {name}, which lacks {} messages of this host{}",
                lacks.len(),
                klipper::for_parts(&lacks)
            ),
            format!("dialect = \"auto\" in {}, then {}", instance.config(), instance.restart()),
        ),
        (None, Some((_, name))) => Finding::ok(DIALECT, format!("{host}: dialect {name}, as configured")),
        (None, None) => Finding::ok(DIALECT, format!("{host}: it gets the messages that it looks up")),
    }];
    if !missing.is_empty() {
        findings.push(Finding::error(
            DIALECT,
            format!(
                "the host is newer than Pinion, which does not have these messages{}: {}",
                klipper::for_parts(&missing),
                host::names(&missing)
            ),
            UPGRADE,
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::super::instance::instances;
    use super::super::tests::says;
    use super::*;
    use crate::cli::computer::tests::Tree;
    use crate::cli::finding::Level::{Error, Ok, Warning};
    use pinion_firmware::mcu::{DialectName, Forms, Part, entries};

    const PI: u32 = 54_321;

    #[test]
    fn klippy_is_found_by_its_unit() {
        let tree = Tree::new();
        assert!(klippys(&tree.computer()).is_empty());
        tree.put("etc/passwd", format!("pi:x:{PI}:{PI}::/home/pi:/bin/sh\n"));
        tree.put("etc/systemd/system/klipper-mcu.service", "ExecStart=/usr/local/bin/klipper_mcu -r\n");
        let unit = "[Service]\nUser=pi\nEnvironmentFile=-/home/pi/klipper.env\nExecStart=/home/pi/env/bin/python $KLIPPER_ARGS\n";
        tree.put("etc/systemd/system/klipper.service", unit);
        assert!(klippys(&tree.computer()).is_empty(), "no program is named");
        tree.put(
            "home/pi/klipper.env",
            "KLIPPER_ARGS=\"/home/pi/klipper/klippy/klippy.py /home/pi/printer.cfg -l /home/pi/k.log\"\n",
        );
        let found = klippys(&tree.computer()).remove(0);
        assert_eq!((found.who.uid, found.found_by.as_str(), found.printer()), (PI, "klipper.service", None));
        assert_eq!(found.folder.unwrap(), tree.computer().path("/home/pi/klipper/klippy"));
        tree.put("home/pi/printer.cfg", "[mcu]\nserial: /tmp/klipper_host_mcu\n");
        let found = klippys(&tree.computer()).remove(0);
        assert_eq!(found.printer().unwrap().serials, [PathBuf::from("/tmp/klipper_host_mcu")].into());
        // An enabled unit counts, and a klippy that runs is not counted twice.
        tree.put(
            "etc/systemd/system/klipper-2.service",
            "ExecStart=/usr/bin/python3 /home/b/klipper/klippy/klippy.py b.cfg\n",
        );
        assert_eq!(klippys(&tree.computer()).len(), 2);
        tree.link("etc/systemd/system/multi-user.target.wants/klipper.service", "../klipper.service");
        assert_eq!(klippys(&tree.computer()).len(), 1);
        tree.process(8, &["/home/pi/env/bin/python", "/home/pi/klipper/klippy/klippy.py"], PI, &[]);
        tree.put("proc/8/cgroup", "0::/system.slice/klipper.service\n");
        let found: Vec<String> = klippys(&tree.computer()).into_iter().map(|klippy| klippy.found_by).collect();
        assert_eq!(found, ["process 8"]);
    }

    #[test]
    fn the_host_s_dialect() {
        let tree = Tree::new();
        let look = || {
            let computer = tree.computer();
            dialects(&computer, &instances(&computer).0, &klippys(&computer))
        };
        says(&look(), "dialect", Ok, "which host comes is unknown");
        let command = "ExecStart=/usr/bin/python3 /home/pi/klipper/klippy/klippy.py /home/pi/printer.cfg\n";
        tree.put("lib/systemd/system/klipper.service", command);
        says(&look(), "dialect", Warning, "/home/pi/klipper/klippy (klipper.service) cannot be read");
        let entries = entries(FEATURES);
        let parts = Forms::from(DialectName::V0_12).parts(&entries);
        let forms: Vec<String> = entries
            .iter()
            .zip(parts)
            .filter(|(entry, part)| entry.is_message() && *part == Part::Needed)
            .map(|(entry, _)| format!("mcu.lookup_command(\"{}\")\n", entry.text))
            .collect();
        tree.put("home/pi/klipper/klippy/mcu.py", forms.concat());
        says(&look(), "dialect", Ok, "it gets the messages that it looks up");
        let speak = |name: &str| tree.put("etc/pinion/pinion.toml", format!("dialect = \"{name}\"\n"));
        speak("v0.12");
        says(&look(), "dialect", Ok, "as configured");
        speak("kalico");
        says(&look(), "dialect", Warning, "names the dialect kalico, which lacks ");
        // This klippy is another instance's host.
        tree.put("home/pi/printer.cfg", "[mcu]\nserial: /tmp/klipper_host_b\n");
        says(&look(), "dialect", Ok, "it gets the messages that it looks up");
        tree.put("home/pi/klipper/klippy/new.py", "mcu.lookup_command(\"query_ads1220 oid=%c wings=%u\")\n");
        says(&look(), "dialect", Error, "for ADS1220 load cells: query_ads1220 oid wings");
    }
}
