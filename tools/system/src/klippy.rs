// SPDX-License-Identifier: GPL-3.0-or-later
//! The klippys of the computer: those that run, and those that a unit starts.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use pinion_firmware::trouble::Trouble;
use pinion_linux::foreign::word;
use pinion_runtime::klippy::command_line::{self, klippy_config};
use pinion_runtime::klippy::process::Process;

use super::printer::Printer;
use super::units::{self, setting};
use super::{Computer, Who};

/// Where klippy's configuration is if no klippy runs or is set up.
const USUAL: [&str; 5] = [
    "/home/*/printer_data/config/printer.cfg",
    "/home/*/printer_*_data/config/printer.cfg",
    "/home/*/klipper_config/printer.cfg",
    "/home/*/printer.cfg",
    "/root/printer_data/config/printer.cfg",
];
/// A klippy that runs or is set up.
pub struct Klippy {
    /// The user that it runs as.
    pub who: Who,
    /// The folder of klippy.py.
    pub folder: Option<PathBuf>,
    /// The path of its configuration, if the command line has all of it.
    pub config: Option<PathBuf>,
    /// Its configuration, or why the doctor cannot use it. `None` if its path is not known.
    pub printer: Option<Result<Printer, Trouble>>,
    /// How it was found.
    pub found_by: String,
    /// The unit that starts it, without `.service`.
    pub unit: Option<String>,
    /// The Python that runs it, as its process or its unit names it.
    pub python: Option<PathBuf>,
    /// A running klippy has the groups of the time when it was started.
    pub is_running: bool,
}

impl Klippy {
    /// The command that installs numpy for a klippy that has none. `None` also if that is not known.
    pub fn install_numpy(&self, computer: &Computer) -> Option<String> {
        let python = self.python.as_deref().filter(|python| computer.exists(python))?;
        // A virtual environment has its packages beside its Python. It may also use the system's.
        let home = python.parent()?.parent()?;
        let settings = computer.text(home.join("pyvenv.cfg"))?;
        let has = |home: &Path| {
            let folders = [
                "lib/python3*/site-packages/numpy",
                "lib/python3*/dist-packages/numpy",
                "lib/python3/dist-packages/numpy",
            ];
            folders.iter().any(|folder| {
                computer.matching(home.join(folder)).iter().any(|path| computer.exists(computer.name(path)))
            })
        };
        let is_system_s = settings.lines().any(|line| line.replace(' ', "") == "include-system-site-packages=true");
        if has(home) || is_system_s && [Path::new("/usr"), Path::new("/usr/local")].into_iter().any(has) {
            return None;
        }
        let pip: PathBuf = home.join("bin/pip");
        Some(format!("sudo -u {} {} install numpy", word(&self.who.name), word(pip.display())))
    }

    /// Its folder, if this module is missing there. `None` also if it cannot be read.
    pub fn folder_without(&self, module: &str) -> Option<PathBuf> {
        let folder = self.folder.as_ref().filter(|folder| has_module(folder, "bus") && !has_module(folder, module));
        folder.cloned()
    }

    /// Its configuration, if the doctor can use it.
    pub fn printer(&self) -> Option<&Printer> {
        self.printer.as_ref()?.as_ref().ok()
    }

    /// Whether it opens this link, as far as is known.
    pub fn opens(&self, link: &Path) -> bool {
        self.printer().is_none_or(|printer| printer.serials().contains(link))
    }

    /// The command that restarts it.
    pub fn restart(&self) -> String {
        format!("sudo systemctl restart {}", word(self.unit.as_deref().unwrap_or("klipper")))
    }
}

/// Whether a folder of klippy.py has the module of a section with this first word.
pub fn has_module(klippy: &Path, word: &str) -> bool {
    ["extras", "plugins"].into_iter().any(|folder| {
        let module = klippy.join(folder).join(word);
        module.with_extension("py").exists() || module.join("__init__.py").exists()
    })
}

/// Each klippy: the running ones that no stranger has started, and those whose units are enabled. If there is none: the
/// installed ones.
pub fn klippys(computer: &Computer) -> Vec<Klippy> {
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

/// The configurations of the computer's klippys, or those in the usual places.
pub fn configs(computer: &Computer) -> BTreeSet<PathBuf> {
    let of_klippys: BTreeSet<PathBuf> = klippys(computer).into_iter().filter_map(|klippy| klippy.config).collect();
    if !of_klippys.is_empty() {
        return of_klippys;
    }
    let found = USUAL.iter().flat_map(|pattern| computer.matching(pattern)).map(|path| computer.name(&path));
    found.filter(|path| computer.exists(path)).collect()
}

fn running(computer: &Computer, process: &Process, unit: Option<String>) -> Option<Klippy> {
    let proc = computer.path("/proc");
    let config = process.klippy_config(&proc).map(|config| computer.name(&config));
    let named = klippy_config(&process.arguments).filter(|config| config.is_absolute()).map(Path::to_owned);
    Some(Klippy {
        who: computer.user_of(process.pid)?,
        config: named,
        folder: process.klippy_folder(&proc).map(|folder| reachable(computer, folder)),
        printer: config.map(|config| Printer::read(computer, &config)),
        found_by: format!("process {}", process.pid),
        python: process.arguments.first().filter(|python| python.is_absolute()).cloned(),
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
        printer: klippy_config(&arguments).map(|config| Printer::read(computer, config)),
        found_by: format!("{unit}.service"),
        python: setting(&text, "ExecStart")
            .and_then(|command| command.split_whitespace().next())
            .map(PathBuf::from)
            .filter(|python| python.is_absolute()),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    const PI: u32 = 54_321;

    #[test]
    fn klippy_is_found_by_its_unit() {
        let tree = Tree::empty();
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
        assert_eq!((found.who.uid, found.found_by.as_str(), found.printer().is_none()), (PI, "klipper.service", true));
        assert_eq!(found.folder.unwrap(), tree.computer().path("/home/pi/klipper/klippy"));
        tree.put("home/pi/printer.cfg", "[mcu]\nserial: /tmp/klipper_host_mcu\n");
        let found = klippys(&tree.computer()).remove(0);
        assert_eq!(found.printer().unwrap().serials(), [PathBuf::from("/tmp/klipper_host_mcu")].into());
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
}
