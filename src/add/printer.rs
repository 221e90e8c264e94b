// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg to which a device is added, and the files that pinion add has beside it.
//!
//! A device has a file of its own in the folder `pinion` beside printer.cfg, and all of them share one
//! `[include pinion/*.cfg]`. Nothing else in printer.cfg is touched. The head of each file says that pinion add has written
//! it, with a checksum of the rest: so a file that the user has changed is known.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use glob::Pattern;
use pinion_printer_config::{Config, Limit, Section, included};

use pinion_linux::foreign::word;
use pinion_system::Computer;
use pinion_system::klippy::{Klippy, configs, klippys};
use pinion_system::printer::{LINK, Printer};
use pinion_system::uses::Use;

use super::catalog::{Catalog, Device, Wiring};
use super::edit::{Edit, Editor, MARK};

/// How high above the bed resonances are measured, in millimeters (docs/Measuring_Resonances.md of Klipper).
const PROBE_Z_MM: f64 = 20.0;
/// The file of this computer's MCU, without `.cfg`.
pub(super) const MCU: &str = "host-mcu";
/// The file of `[resonance_tester]`.
pub(super) const RESONANCES: &str = "resonance_tester";
/// Where Moonraker answers, if nothing says otherwise.
const MOONRAKER_PORT: &str = "7125";

/// klippy's configuration.
pub(super) struct Target {
    /// printer.cfg as klippy names it, as a path of the computer. klippy looks for includes in its folder.
    pub(super) path: PathBuf,
    /// The file itself: klippy may name it by a link.
    file: PathBuf,
    /// Its owner and group.
    pub(super) owner: (u32, u32),
    /// The contents of printer.cfg itself.
    text: String,
    printer: Printer,
    /// The MCUs of this computer, with their links.
    mcus: BTreeMap<String, PathBuf>,
}

/// Finds printer.cfg: the named one, the one of the only klippy, or the only one in a home folder.
fn find(computer: &Computer, named: Option<&Path>) -> Result<PathBuf, String> {
    if let Some(named) = named {
        let absolute = if computer.is_this() { std::path::absolute(named) } else { Ok(Path::new("/").join(named)) };
        return absolute.map_err(|error| format!("{}: {error}", named.display()));
    }
    let mut found = configs(computer).into_iter();
    match (found.next(), found.next()) {
        (Some(path), None) => Ok(path),
        (None, _) => Err("there is no printer.cfg: name yours with --config FILE".into()),
        (Some(path), Some(other)) => Err(format!(
            "there are several hosts, with {} and {}: name one with --config FILE",
            path.display(),
            other.display()
        )),
    }
}

/// The file behind a path, as a path of the computer.
fn behind(computer: &Computer, path: &Path) -> Option<PathBuf> {
    Some(computer.name(&computer.resolve(path).ok()?.canonicalize().ok()?))
}

/// The link by which klippy names this file.
fn link_to(computer: &Computer, file: &Path) -> Option<PathBuf> {
    let file = behind(computer, file)?;
    let is_it =
        |config: &PathBuf| computer.path(config).is_symlink() && behind(computer, config).as_ref() == Some(&file);
    configs(computer).into_iter().find(is_it)
}

/// A file of pinion add.
pub(super) fn written(name: &str, title: &str, rest: &str) -> String {
    format!("# Written by {MARK} {name} ({:08x}): {title}\n{rest}", checksum(rest))
}

/// Whether pinion add has written a file, and whether it is still as it was written.
pub(super) fn is_ours(text: &str) -> Option<bool> {
    let (head, rest) = text.split_once('\n')?;
    let sum = head.strip_prefix("# Written by ")?.strip_prefix(MARK)?.split_once('(')?.1.split_once(')')?.0;
    Some(sum == format!("{:08x}", checksum(rest)))
}

/// FNV-1a: it only has to notice an editor.
fn checksum(text: &str) -> u32 {
    text.bytes().fold(0x811c_9dc5, |sum, byte| (sum ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

impl Target {
    /// Finds printer.cfg, and reads it with the files that it includes.
    ///
    /// # Errors
    ///
    /// One line: there is none, there are several, it cannot be read, is a link, or has a line that klippy refuses.
    pub(super) fn find(computer: &Computer, named: Option<&Path>, mcu: Option<&str>) -> Result<Target, String> {
        let file = find(computer, named)?;
        let path = named.and_then(|_| link_to(computer, &file)).unwrap_or_else(|| file.clone());
        let about = computer.unfollowed(&file).and_then(std::fs::symlink_metadata);
        let about = about.map_err(|error| format!("{}: {error}: name yours with --config FILE", file.display()))?;
        if about.is_symlink() {
            let target = behind(computer, &file).map_or("FILE".into(), |file| word(file.display()));
            return Err(format!("{}: it is a link: name the file that it leads to: --config {target}", file.display()));
        }
        let owner = (about.uid(), about.gid());
        let editor = Editor::new(computer, Some(owner));
        let text = editor.read(&file)?.unwrap_or_default();
        let printer = Printer::read(computer, &path).map_err(|trouble| trouble.to_string())?;
        let mcus = printer.own_mcus(computer, mcu);
        Ok(Target { path, file, owner, text, printer, mcus })
    }

    /// Its Moonraker's address. Without a moonraker.conf beside it, the usual one, if this is the only host.
    ///
    /// # Errors
    ///
    /// One line: it is not known which Moonraker is this host's.
    pub(super) fn moonraker(&self, computer: &Computer) -> Result<String, String> {
        let Ok(config) = computer.config(&self.path.with_file_name("moonraker.conf")) else {
            return match configs(computer).len() {
                0 | 1 => Ok(format!("127.0.0.1:{MOONRAKER_PORT}")),
                _ => Err("there are several hosts: name the Moonraker of this one with --moonraker ADDRESS".into()),
            };
        };
        let value = |key: &str| config.section("server").and_then(|section| section.text(key));
        let host = value("host").filter(|host| !["0.0.0.0", "::", "all"].contains(host)).unwrap_or("127.0.0.1");
        let host = if host.contains(':') { format!("[{host}]") } else { host.to_owned() };
        Ok(format!("{host}:{}", value("port").unwrap_or(MOONRAKER_PORT)))
    }

    /// Its klippy.
    pub(super) fn klippy(&self, computer: &Computer) -> Option<Klippy> {
        let mut all = klippys(computer);
        let at = all.iter().position(|klippy| klippy.config.as_ref() == Some(&self.path));
        match (at, all.len()) {
            (Some(at), _) => Some(all.swap_remove(at)),
            (None, 1) => all.pop(),
            _ => None,
        }
    }

    /// The folder of the devices' files.
    pub(super) fn folder(&self) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("/")).join("pinion")
    }

    /// A file in that folder, named without `.cfg`.
    pub(super) fn file(&self, name: &str) -> PathBuf {
        self.folder().join(format!("{name}.cfg"))
    }

    pub(super) fn config(&self) -> &Config {
        &self.printer.config
    }

    /// Whether a file has a line of a section.
    pub(super) fn is_in(&self, section: &Section, file: &Path) -> bool {
        self.config().files_of(&section.name).any(|own| own == file)
    }

    /// The sections that are not in this file.
    pub(super) fn others<'a>(&'a self, own: &'a Path) -> impl Iterator<Item = &'a Section> {
        self.config().sections().iter().filter(|section| !self.is_in(section, own))
    }

    /// The MCU of a section.
    pub(super) fn mcu_of(&self, section: &Section) -> String {
        self.printer.mcu_of(section)
    }

    /// Whether a section is on an MCU of this computer.
    pub(super) fn is_here(&self, section: &Section) -> bool {
        self.printer.is_on(section, &self.mcus)
    }

    /// The MCU of this computer, with its link, and whether it has to be added.
    ///
    /// # Errors
    ///
    /// One line: there are several, and none has the usual link.
    pub(super) fn mcu(&self, wanted: Option<&str>) -> Result<(String, PathBuf, bool), String> {
        let names = || self.mcus.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
        if let Some(wanted) = wanted {
            let link = self.mcus.get(wanted);
            let link = link.ok_or_else(|| {
                format!("--mcu: \"{wanted}\" is not an MCU of this computer: printer.cfg has {}", names())
            })?;
            return Ok((wanted.to_owned(), link.clone(), false));
        }
        let usual = self.mcus.iter().find(|(_, link)| *link == Path::new(LINK));
        match (usual, self.mcus.len()) {
            (Some((name, link)), _) => Ok((name.clone(), link.clone(), false)),
            (None, 0) => {
                let is_free = |name: &String| self.config().section(&format!("mcu {name}")).is_none();
                let mut more = (2..).map(|number| format!("host{number}"));
                let name = Some("host".to_owned()).filter(is_free).or_else(|| more.find(is_free)).unwrap_or_default();
                Ok((name, LINK.into(), true))
            }
            (None, 1) => {
                Ok(self.mcus.iter().next().map(|(name, link)| (name.clone(), link.clone(), false)).unwrap_or_default())
            }
            _ => Err(format!("this computer has several MCUs in printer.cfg: choose one with --mcu NAME: {}", names())),
        }
    }

    /// The values of a device's file that an earlier call has written, by the roles in its template.
    pub(super) fn written_pins(&self, device: &Device, way: &Wiring, name: Option<&str>) -> BTreeMap<String, String> {
        let own = self.file(&device.file(name));
        let template = device.named(&way.config, name);
        let mut section: Option<&Section> = None;
        let mut found = BTreeMap::new();
        for line in template.lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
                section = self.config().section(name).filter(|section| self.is_in(section, &own));
            }
            let Some((key, value)) = line.split_once(": ") else { continue };
            let role = value.rsplit_once('{').and_then(|(_, rest)| rest.strip_suffix('}'));
            if let (Some(role), Some(section)) = (role, section)
                && let Some(pin) = self
                    .printer
                    .pins_of(section)
                    .find(|named| section.text(key).is_some_and(|text| text.trim() == named.text))
            {
                found.insert(role.to_owned(), pin.pin.name);
            }
        }
        found
    }

    /// The middle of the bed.
    fn probe_point(&self) -> Option<String> {
        let number = |section: &str, key: &str| self.config().section(section)?.number(key, Limit::Any).ok()?;
        let middle = |axis: &str| {
            let section = format!("stepper_{axis}");
            let (from, to) = (number(&section, "position_min").unwrap_or(0.0), number(&section, "position_max")?);
            // A negative minimum is beside the bed.
            Some((from.max(0.0) + to) / 2.0)
        };
        if self.config().section("stepper_a").is_some() {
            // The middle of a delta printer is its origin.
            return Some(format!("0, 0, {PROBE_Z_MM}"));
        }
        Some(format!("{:.0}, {:.0}, {PROBE_Z_MM}", middle("x")?, middle("y")?))
    }

    /// The file with `[resonance_tester]` for this accelerometer.
    fn resonances(&self, section: &str) -> String {
        let rest = match self.probe_point() {
            Some(point) => format!(
                "[resonance_tester]\naccel_chip: {section}\n# The middle of the bed, and {PROBE_Z_MM} mm above it\nprobe_points: {point}\n"
            ),
            None => "# [resonance_tester] needs your probe point: see docs/Measuring_Resonances.md of Klipper\n".into(),
        };
        written(RESONANCES, "resonances", &rest)
    }

    /// The changes that add these sections for a device.
    ///
    /// # Errors
    ///
    /// One line: a file in the way cannot be read.
    pub(super) fn plan(
        &self,
        editor: &Editor,
        device: &Device,
        name: Option<&str>,
        sections: &str,
        mcu: Option<&str>,
    ) -> Result<Vec<Edit>, String> {
        let mut edits = Vec::new();
        let mut make = |name: &str, text: String| -> Result<(), String> {
            let file = self.file(name);
            // A file that is there is left as it is: the user may have changed it.
            if editor.read(&file)?.is_none() {
                edits.push(Edit { file, old: None, new: Some(text) });
            }
            Ok(())
        };
        if let Some(mcu) = mcu {
            let text = format!("[mcu {mcu}]\nserial: {LINK}\n");
            make(MCU, written(MCU, "this computer's pins and buses", &text))?;
        }
        let own = device.file(name);
        make(&own, written(&own, &device.title, sections.trim_start()))?;
        if device.resonance && self.config().section(RESONANCES).is_none() {
            make(RESONANCES, self.resonances(&device.section(name)))?;
        }
        let folder = self.folder();
        let includes = self.text.lines().filter_map(included);
        let is_included = includes.map(|pattern| self.path.with_file_name(pattern)).any(|pattern| {
            let pattern = pattern.to_str().and_then(|pattern| Pattern::new(pattern).ok());
            pattern.is_some_and(|pattern| pattern.matches_path(&folder.join("any-name.cfg")))
        });
        if !is_included {
            edits.push(Edit { file: self.file.clone(), old: Some(self.text.clone()), new: Some(self.with_include()) });
        }
        Ok(edits)
    }

    /// printer.cfg with the include, behind the last one at the top, or at its head. No option can stand behind an include,
    /// so it never comes between a section and its options.
    fn with_include(&self) -> String {
        let end = if self.text.contains("\r\n") { "\r\n" } else { "\n" };
        let mut at = 0;
        let mut place = 0;
        for line in self.text.split_inclusive('\n') {
            at += line.len();
            if included(line).is_some() {
                place = at;
            }
        }
        let (before, after) = self.text.split_at(place);
        let is_open = !before.is_empty() && !before.ends_with('\n');
        format!("{before}{}{INCLUDE}{end}{after}", if is_open { end } else { "" })
    }

    /// The changes that take a device out, and a line for each thing that stays.
    ///
    /// # Errors
    ///
    /// One line: a file cannot be read.
    pub(super) fn plan_undo(
        &self,
        editor: &Editor,
        catalog: &Catalog,
        device: &Device,
        name: Option<&str>,
        left: &mut Vec<String>,
    ) -> Result<Vec<Edit>, String> {
        let mut edits = Vec::new();
        let stem = device.file(name);
        let file = self.file(&stem);
        let gone = |file: &Path, text: &str| Edit { file: file.to_owned(), old: Some(text.to_owned()), new: None };
        let text = editor.read(&file)?;
        match text.as_deref().map(|text| (text, is_ours(text))) {
            Some((text, Some(is_unchanged))) => {
                edits.push(gone(&file, text));
                if !is_unchanged {
                    // klippy does not read it under this name.
                    let kept = file.with_extension("cfg.removed");
                    let old = editor.read(&kept)?;
                    edits.push(Edit { file: kept.clone(), old, new: Some(text.to_owned()) });
                    left.push(format!("{} was changed later: {} keeps it", file.display(), kept.display()));
                }
            }
            Some((_, None)) => left.push(format!("{} was not written by pinion add, so it stays", file.display())),
            None => {}
        }
        let mut stays: Vec<&Section> = self.others(&file).collect();
        // Another accelerometer goes on measuring resonances.
        let resonances = self.file(RESONANCES);
        let shared = [self.file(MCU), resonances.clone(), file.clone()];
        let others = editor.computer.matching(self.folder().join("*.cfg"));
        let others: Vec<PathBuf> =
            others.iter().map(|path| editor.computer.name(path)).filter(|path| !shared.contains(path)).collect();
        if let Some(text) = editor.read(&resonances)?.filter(|text| is_ours(text) == Some(true)) {
            let chip = self.config().section(RESONANCES).and_then(|section| section.text("accel_chip"));
            let is_other =
                |section: &&&Section| catalog.devices.iter().any(|other| other.resonance && other.is_chip_of(section));
            match stays.iter().find(is_other) {
                // It is this other one's already.
                Some(_) if chip.is_some_and(|chip| chip != device.section(name)) => {}
                Some(other) => {
                    let new = Some(self.resonances(&other.name)).filter(|new| *new != text);
                    edits.extend(new.map(|new| Edit { file: resonances.clone(), old: Some(text), new: Some(new) }));
                }
                None => {
                    edits.push(gone(&resonances, &text));
                    stays.retain(|section| !self.is_in(section, &resonances));
                }
            }
        }
        let mcu_file = self.file(MCU);
        if let Some(text) = editor.read(&mcu_file)?.filter(|text| is_ours(text) == Some(true)) {
            let own = self.config().of_kind("mcu").find(|section| self.is_in(section, &mcu_file));
            let mcu = own.map_or("", |section| section.name.trim_start_matches("mcu ").trim());
            let names_it = |section: &&&Section| {
                let named = section.settings().iter().filter(|setting| setting.key.contains("mcu"));
                let is_listed = named.flat_map(|setting| setting.value.split(',')).any(|own| own.trim() == mcu);
                let is_pin = |text: &str| text.trim_start_matches(['^', '~', '!', ' ']).starts_with(&format!("{mcu}:"));
                let has_pin =
                    section.settings().iter().flat_map(|setting| setting.value.split([',', '\n'])).any(is_pin);
                section.kind() != "mcu" && (is_listed || has_pin)
            };
            match stays.iter().find(names_it) {
                Some(user) if !self.is_pinion_s(user) => {
                    left.push(format!("{} stays: [{}] uses [mcu {mcu}]", mcu_file.display(), user.name));
                }
                Some(_) => {}
                // Without its include, klippy does not read the others now.
                None if own.is_some() || others.is_empty() => edits.push(gone(&mcu_file, &text)),
                None => {}
            }
        }
        let goes = |file: &Path| edits.iter().any(|edit| edit.file == file && edit.new.is_none());
        let remaining = editor.computer.matching(self.folder().join("*.cfg"));
        let mut remaining = remaining.iter().map(|path| editor.computer.name(path)).filter(|path| !goes(path));
        // What klippy would still find of the device would be a section without its options.
        let saved: Vec<&str> = self
            .config()
            .sections()
            .iter()
            .filter(|section| goes(&file) && self.is_in(section, &file))
            .map(|section| section.name.as_str())
            .collect();
        let mut printer_cfg = self.config().without_saved(&self.text, &saved);
        if printer_cfg != self.text {
            left.push(format!(
                "the lines of [{}] in the SAVE_CONFIG block of {} go, too",
                saved.join("], ["),
                self.file.display()
            ));
        }
        if self.text.contains(INCLUDE) || self.text.contains("[include pinion/") {
            let is_include = |line: &&str| line.trim_end() == INCLUDE;
            match remaining.next() {
                Some(other) => {
                    if editor.read(&other)?.is_none_or(|text| is_ours(&text).is_none()) {
                        left.push(format!("{} keeps its include: {} is there", self.file.display(), other.display()));
                    }
                }
                None if self.text.lines().any(|line| is_include(&line)) => {
                    printer_cfg = printer_cfg.split_inclusive('\n').filter(|line| !is_include(line)).collect();
                }
                None if edits.is_empty() => {}
                None => left
                    .push(format!("{} keeps its include: pinion add has not written this line", self.file.display())),
            }
        }
        match printer_cfg == self.text {
            true => edits.extend(editor.needless_copy(&self.file, &self.text)?),
            false => edits.push(Edit { file: self.file.clone(), old: Some(self.text.clone()), new: Some(printer_cfg) }),
        }
        Ok(edits)
    }

    /// Whether a section is in a file of the folder `pinion`.
    pub(super) fn is_pinion_s(&self, section: &Section) -> bool {
        self.config().files_of(&section.name).any(|file| file.starts_with(self.folder()))
    }

    /// Whether a use is one of this file.
    pub(super) fn is_use_of(one: &Use, file: &Path) -> bool {
        one.place.rsplit_once(':').is_some_and(|(path, _)| Path::new(path) == file)
    }

    /// The files that pinion add may have left half-written.
    pub(super) fn files(&self) -> impl Iterator<Item = PathBuf> {
        [self.file.clone(), self.file(MCU), self.file(RESONANCES)].into_iter()
    }
}

/// The line that includes the folder. A line of the user's own has no such comment.
const INCLUDE: &str = "[include pinion/*.cfg] # by pinion add";

/// Whether a folder of klippy lacks this module. `None` if it cannot be read.
pub(super) fn lacks(klippy: &Klippy, module: &str) -> Option<PathBuf> {
    let folder = klippy.folder.as_ref()?;
    let extras = folder.join("extras");
    let is_there = ["extras", "plugins"].iter().any(|place| {
        let place = folder.join(place);
        place.join(format!("{module}.py")).exists() || place.join(module).is_dir()
    });
    (extras.join("bus.py").exists() && !is_there).then(|| folder.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    const CONFIG: &str = "/home/pi/printer_data/config/printer.cfg";

    fn read(files: &[(&str, &str)]) -> (Tree, Target) {
        let tree = Tree::empty();
        for (name, text) in files {
            tree.put(&format!("home/pi/printer_data/config/{name}"), text);
        }
        let target = Target::find(&tree.computer(), None, None).unwrap();
        assert_eq!(target.path, Path::new(CONFIG));
        (tree, target)
    }

    /// The files that a device without sections of its own changes, with their new texts.
    fn plan(tree: &Tree, target: &Target, device: &str) -> Vec<(String, String)> {
        let catalog = Catalog::read().unwrap();
        let device = catalog.device(device).unwrap();
        let computer = tree.computer();
        let editor = Editor::new(&computer, None);
        let (mcu, _, is_missing) = target.mcu(None).unwrap();
        let edits = target.plan(&editor, device, None, "[x]\n", is_missing.then_some(&*mcu)).unwrap();
        let name = |edit: &Edit| edit.file.strip_prefix("/home/pi").unwrap_or(&edit.file).display().to_string();
        edits.iter().map(|edit| (name(edit).replace("printer_data/config/", ""), edit.new.clone().unwrap())).collect()
    }

    #[test]
    fn a_device_has_its_file_and_one_include_for_all() {
        let (tree, target) = read(&[(
            "printer.cfg",
            "# mine\n[mcu]\nserial: /dev/x\n[stepper_x]\nposition_max: 250 # mm\n[stepper_y]\nposition_min: -5\nposition_max: 210\n",
        )]);
        let changes = plan(&tree, &target, "adxl345");
        let names: Vec<&str> = changes.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["pinion/host-mcu.cfg", "pinion/adxl345.cfg", "pinion/resonance_tester.cfg", "printer.cfg"]);
        assert!(changes[0].1.ends_with("[mcu host]\nserial: /tmp/klipper_host_mcu\n"));
        let tester = "accel_chip: adxl345\n# The middle of the bed, and 20 mm above it\nprobe_points: 125, 105, 20\n";
        assert!(changes[2].1.ends_with(tester), "{}", changes[2].1);
        assert!(changes[3].1.starts_with("[include pinion/*.cfg] # by pinion add\n# mine\n"));
        for (_, text) in &changes[..3] {
            assert_eq!(is_ours(text), Some(true));
            assert_eq!(
                is_ours(&text.replace("serial", "Serial").replace("[x]", "[y]").replace("x: ", "")),
                Some(!text.contains("serial") && !text.contains("[x]"))
            );
        }
        assert_eq!(is_ours("[x]\n"), None);
    }

    #[test]
    fn what_printer_cfg_has_already_is_not_written_again() {
        let (tree, target) = read(&[
            (
                "printer.cfg",
                "[include pinion/*.cfg]\n[include other.cfg]\n[stepper_a]\n[fan]\npin: !rpi:GPIO17, rpi:gpio27\n",
            ),
            ("other.cfg", "[mcu rpi]\nserial: /tmp/klipper_host_mcu\n[resonance_tester]\naccel_chip: x\n[adxl345]\n"),
            ("pinion/relay.cfg", "[output_pin relay]\npin: rpi:GPIO22\n"),
        ]);
        assert_eq!(target.mcu(None).unwrap(), ("rpi".into(), LINK.into(), false));
        let changes = plan(&tree, &target, "lis2dw");
        assert_eq!(changes.len(), 1, "{changes:?}");
        assert!(changes[0].1.ends_with(": accelerometer LIS2DW12\n[x]\n"), "{changes:?}");
        assert_eq!(plan(&tree, &target, "relay"), [], "its file is there");
        assert_eq!(target.probe_point().unwrap(), "0, 0, 20");
    }

    /// An MCU of another computer, or of another board, is not this one's, whatever its name.
    #[test]
    fn the_mcu_of_this_computer_is_the_one_that_is_served_here() {
        let mcu =
            |text: &str| read(&[("printer.cfg", text)]).1.mcu(None).map(|(name, _, is_missing)| (name, is_missing));
        let bed = "[mcu bedpi]\nserial: /tmp/klipper_host_bedpi\n";
        let own = "[mcu zz]\nserial: /tmp/klipper_host_mcu\n";
        assert_eq!(mcu(""), Ok(("host".into(), true)));
        assert_eq!(mcu(bed), Ok(("host".into(), true)), "pinion link has this one");
        assert_eq!(mcu(&format!("{bed}{own}")), Ok(("zz".into(), false)));
        assert_eq!(mcu("[mcu host]\nserial: /dev/serial/by-id/usb-pico\n"), Ok(("host2".into(), true)));
        assert_eq!(mcu("[mcu host]\ncanbus_uuid: 1\n[mcu host2]\nserial: /dev/x\n"), Ok(("host3".into(), true)));
        let (tree, target) = read(&[("printer.cfg", &format!("{bed}[mcu x]\nserial: /dev/x\n"))]);
        let named = Target::find(&tree.computer(), None, Some("bedpi")).unwrap();
        assert_eq!(named.mcu(Some("bedpi")).unwrap().0, "bedpi", "the user knows better");
        assert!(target.mcu(Some("x")).unwrap_err().starts_with("--mcu: \"x\" is not an MCU of this computer"));
    }

    #[test]
    fn the_include_comes_where_no_section_is_cut() {
        let include = INCLUDE;
        for (text, new) in [
            (
                "[include a*.cfg]\n[fan]\npin: x\n[include b*.cfg]\n\n[x]\n",
                "[include a*.cfg]\n[fan]\npin: x\n[include b*.cfg]\nNEW\n\n[x]\n",
            ),
            ("[fan]\r\npin: x\r\n", "NEW\r\n[fan]\r\npin: x\r\n"),
            ("[include a*.cfg]", "[include a*.cfg]\nNEW\n"),
            ("", "NEW\n"),
            ("#[include a.cfg]\n", "NEW\n#[include a.cfg]\n"),
        ] {
            let (_tree, target) = read(&[("printer.cfg", text)]);
            assert_eq!(target.with_include(), new.replace("NEW", include), "{text:?}");
        }
        assert_eq!(included(include), Some("pinion/*.cfg"), "klippy reads it");
    }

    /// klippy looks for includes beside the link.
    #[test]
    fn the_device_s_files_are_where_klippy_looks_for_them() {
        let tree = Tree::empty();
        tree.put("home/pi/dotfiles/printer.cfg", "[include other.cfg]\n[fan]\npin: a\n");
        tree.put("home/pi/printer_data/config/other.cfg", "[adxl345]\n");
        tree.link("home/pi/printer_data/config/printer.cfg", "../../dotfiles/printer.cfg");
        let computer = tree.computer();
        let error = Target::find(&computer, Some(Path::new(CONFIG)), None).err().unwrap();
        let file = "/home/pi/dotfiles/printer.cfg";
        assert!(error.ends_with(&format!("--config {file}")), "{error}");
        let target = Target::find(&computer, Some(Path::new(file)), None).unwrap();
        assert!(target.config().section("adxl345").is_some());
        let names: Vec<String> = plan(&tree, &target, "relay").into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["pinion/host-mcu.cfg", "pinion/relay.cfg", "dotfiles/printer.cfg"]);
    }

    #[test]
    fn of_several_hosts_one_is_named_and_a_link_is_none() {
        let tree = Tree::empty();
        assert!(find(&tree.computer(), None).unwrap_err().contains("--config"));
        tree.put("home/a/printer_data/config/printer.cfg", "");
        tree.put("home/b/printer_data/config/printer.cfg", "");
        assert!(find(&tree.computer(), None).unwrap_err().contains("several hosts"));
        tree.put("etc/shadow", "x");
        tree.link("home/c/printer.cfg", "../../etc/shadow");
        let error = Target::find(&tree.computer(), Some(Path::new("/home/c/printer.cfg")), None).err().unwrap();
        assert!(error.ends_with("it is a link: name the file that it leads to: --config /etc/shadow"), "{error}");
        // A file that includes itself, or everything.
        let path = Path::new("/home/a/printer_data/config/printer.cfg");
        for (text, refusal) in [
            ("[include *.cfg]\n", "printer.cfg:1: Recursive include of config file"),
            ("[a]\nno value\n", "printer.cfg:2: Source contains parsing errors"),
        ] {
            tree.put("home/a/printer_data/config/printer.cfg", text);
            let error = Target::find(&tree.computer(), Some(path), None).err().unwrap();
            assert!(error.contains(refusal), "{error}");
        }
    }

    /// Each printer has its own.
    #[test]
    fn moonraker_is_the_one_beside_the_configuration() {
        let (tree, target) = read(&[("printer.cfg", "")]);
        let computer = tree.computer();
        let address = |target: &Target| target.moonraker(&computer);
        assert_eq!(address(&target), Ok("127.0.0.1:7125".into()));
        tree.put("home/pi/printer_2_data/config/printer.cfg", "");
        assert!(address(&target).unwrap_err().contains("--moonraker ADDRESS"));
        tree.put("home/pi/printer_2_data/config/moonraker.conf", "[server]\nhost: 0.0.0.0\nport: 7126\n");
        let second =
            Target::find(&computer, Some(Path::new("/home/pi/printer_2_data/config/printer.cfg")), None).unwrap();
        assert_eq!(address(&second), Ok("127.0.0.1:7126".into()));
        tree.put("home/pi/printer_2_data/config/moonraker.conf", "[server]\nhost: ::1\n");
        assert_eq!(address(&second), Ok("[::1]:7125".into()));
    }

    #[test]
    fn the_lines_of_an_earlier_call_are_found_by_the_template() {
        let catalog = Catalog::read().unwrap();
        let driver = "[manual_stepper feeder]\nstep_pin: host:GPIO17\ndir_pin: !host:GPIO27\nenable_pin: !host:GPIO6\n[tmc2209 manual_stepper feeder]\nuart_pin: host:ttyAMA3\n";
        let (_tree, target) = read(&[
            ("printer.cfg", "[include pinion/*.cfg]\n[mcu host]\nserial: /tmp/klipper_host_mcu\n"),
            ("pinion/tmc2209.cfg", driver),
            ("pinion/relay-bed.cfg", "[output_pin bed]\npin: !host:GPIO5\n"),
        ]);
        let written = |device: &str, name: Option<&str>| {
            let device = catalog.device(device).unwrap();
            target
                .written_pins(device, &device.way[0], name)
                .into_iter()
                .map(|(role, pin)| format!("{role} {pin}"))
                .collect::<Vec<_>>()
        };
        assert_eq!(written("tmc2209", None), ["line GPIO17", "line2 GPIO27", "uart ttyAMA3", "up GPIO6"]);
        assert_eq!(written("relay", Some("bed")), ["line GPIO5"]);
        assert_eq!(written("relay", None), [""; 0]);
    }
}
