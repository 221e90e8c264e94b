// SPDX-License-Identifier: GPL-3.0-or-later
//! printer.cfg: its sections, and the ones that a device adds.
//!
//! A device has a file of its own in the folder `pinion` beside printer.cfg, and all of them share one
//! `[include pinion/*.cfg]`. Nothing else in printer.cfg is touched.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use glob::Pattern;
use pinion_printer_config::{Config, Files, Limit, Section, Setting, included};

use crate::cli::computer::Computer;
use crate::cli::doctor::host::klippys;
use crate::cli::doctor::printer::{mcu_of, name_of, pins};
use pinion_linux::foreign::word;
use pinion_runtime::klippy::HOST_PATHS;

use super::catalog::{Device, Kind};
use super::change::{Change, Side};
use super::splice::Splice;

/// Where klippy's configuration is if no klippy runs or is set up.
const USUAL: [&str; 3] =
    ["/home/*/printer_data/config/printer.cfg", "/home/*/klipper_config/printer.cfg", "/home/*/printer.cfg"];
/// The usual link to this computer's MCU.
const LINK: &str = "/tmp/klipper_host_mcu";
/// The key of the change that includes the folder.
const INCLUDE: &str = "include";
/// The key of the change that adds the MCU.
const MCU: &str = "mcu";
/// How high above the bed resonances are measured, in millimeters (docs/Measuring_Resonances.md of Klipper).
const PROBE_Z_MM: f64 = 20.0;

/// klippy's configuration.
#[derive(Debug)]
pub(super) struct Printer {
    /// printer.cfg as klippy names it, as a path of the computer. klippy looks for includes in its folder.
    path: PathBuf,
    /// The file itself: klippy may name it by a link.
    file: PathBuf,
    /// Its owner and group.
    pub(super) owner: (u32, u32),
    /// The contents of printer.cfg itself.
    text: String,
    config: Config,
}

/// The files of a configuration, as far as they can be read: another user's do not count.
struct Readable<'a> {
    computer: &'a Computer,
    /// printer.cfg and its contents.
    main: (&'a Path, &'a str),
}

impl Files for Readable<'_> {
    fn text(&self, path: &Path) -> io::Result<String> {
        let (main, text) = self.main;
        Ok(if path == main { text.to_owned() } else { Files::text(self.computer, path).unwrap_or_default() })
    }

    fn matching(&self, pattern: &Path) -> io::Result<Vec<PathBuf>> {
        Ok(self.computer.matching(pattern).iter().map(|file| self.computer.name(file)).collect())
    }

    fn whole(&self, path: &Path) -> PathBuf {
        self.computer.whole(path)
    }
}

/// Finds printer.cfg: the named one, the one of the only klippy, or the only one in a home folder.
///
/// # Errors
///
/// One line: there is none, or there are several.
pub(super) fn find(computer: &Computer, named: Option<&Path>) -> Result<PathBuf, String> {
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

/// The configurations of the computer's klippys, or those in the usual places.
fn configs(computer: &Computer) -> BTreeSet<PathBuf> {
    let of_klippys: BTreeSet<PathBuf> = klippys(computer).into_iter().filter_map(|klippy| klippy.config).collect();
    if !of_klippys.is_empty() {
        return of_klippys;
    }
    let usual = USUAL.iter().map(|pattern| computer.matching(pattern)).find(|found| !found.is_empty());
    usual.unwrap_or_default().iter().map(|path| computer.name(path)).collect()
}

/// The file behind a path, as a path of the computer.
fn behind(computer: &Computer, path: &Path) -> Option<PathBuf> {
    let file = computer.follow(path).ok()?.pop()?;
    Some(computer.name(&file.canonicalize().ok()?))
}

/// The link by which klippy names this file.
fn link_to(computer: &Computer, file: &Path) -> Option<PathBuf> {
    let file = behind(computer, file)?;
    let is_it =
        |config: &PathBuf| computer.path(config).is_symlink() && behind(computer, config).as_ref() == Some(&file);
    configs(computer).into_iter().find(is_it)
}

/// Whether a section uses this node of a bus.
fn uses(section: &Section, kind: Kind, node: &str) -> bool {
    let name = node.replacen("i2c-", "i2c.", 1);
    section.settings().iter().any(|setting| {
        let value = name_of(&setting.value);
        // The driver of an ADC takes the first chip select.
        kind == Kind::W1 && setting.key == "serial_no"
            || value == name
            || value.strip_prefix(name.as_str()).is_some_and(|rest| rest.starts_with('/'))
            || node == "spidev0.0" && value.starts_with("mcp3208/")
    })
}

impl Printer {
    /// Finds printer.cfg as [`find`] does, and reads it. klippy may name a file by a link.
    ///
    /// # Errors
    ///
    /// One line: there is none, there are several, or it cannot be read.
    pub(super) fn find(computer: &Computer, named: Option<&Path>) -> Result<Printer, String> {
        let file = find(computer, named)?;
        let link = named.and_then(|_| link_to(computer, &file));
        Printer::read_as(computer, &file, link.as_deref().unwrap_or(&file))
    }

    /// Reads the file that klippy names so, with the files that it includes. A file that cannot be read, such as another
    /// user's, does not count.
    ///
    /// # Errors
    ///
    /// One line: printer.cfg itself cannot be read, is a link, or has a line that klippy refuses.
    pub(super) fn read(computer: &Computer, path: &Path) -> Result<Printer, String> {
        Printer::read_as(computer, path, path)
    }

    fn read_as(computer: &Computer, path: &Path, named: &Path) -> Result<Printer, String> {
        let about = std::fs::symlink_metadata(computer.path(path));
        let about = about.map_err(|error| format!("{}: {error}: name yours with --config FILE", path.display()))?;
        if about.is_symlink() {
            let file = behind(computer, path).map_or("FILE".into(), |file| word(file.display()));
            return Err(format!("{}: it is a link: name the file that it leads to: --config {file}", path.display()));
        }
        let owner = (about.uid(), about.gid());
        let side = Side { computer, owner: Some(owner), records: PathBuf::new() };
        let text = side.read(path)?.unwrap_or_default();
        let config = Config::read_from(&Readable { computer, main: (named, &text) }, named);
        let config = config.map_err(|trouble| trouble.to_string())?;
        Ok(Printer { path: named.to_owned(), file: path.to_owned(), owner, text, config })
    }

    /// The sections with a bus or a sensor of this computer that is not there, with its file.
    pub(super) fn absent(&self, computer: &Computer) -> Vec<(&str, Option<&str>, String)> {
        let file = |setting: &Setting| {
            let name = name_of(&setting.value);
            let is_number = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_digit() || c == '.');
            match (setting.key.as_str(), name.strip_prefix("spidev"), name.strip_prefix("i2c.")) {
                ("spi_bus" | "pin", Some(number), _) if is_number(number) => Some(format!("/dev/{name}")),
                ("i2c_bus", _, Some(number)) if is_number(number) => Some(format!("/dev/i2c-{number}")),
                ("serial_no", ..) if name.chars().all(|c| c.is_ascii_hexdigit() || c == '-') => {
                    Some(format!("/sys/bus/w1/devices/{name}"))
                }
                _ => None,
            }
        };
        let absent = self.config.sections().iter().filter_map(|section| {
            let file = section.settings().iter().find_map(file).filter(|file| !computer.path(file).exists())?;
            Some((section.name.as_str(), section.text("sensor_type"), file))
        });
        absent.collect()
    }

    /// The folder of the devices' files.
    pub(super) fn folder(&self) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("/")).join("pinion")
    }

    /// The file of a device.
    pub(super) fn file(&self, device: &str) -> PathBuf {
        self.folder().join(format!("{device}.cfg"))
    }

    /// A file other than the device's own that has this section.
    pub(super) fn elsewhere(&self, device: &Device) -> Option<&Path> {
        let own = self.file(device.name);
        self.config.files_of(&device.section).find(|file| *file != own)
    }

    /// The sections that are not in the device's own file.
    fn others(&self, device: &Device) -> impl Iterator<Item = &Section> {
        let own = self.file(device.name);
        let is_own = move |section: &Section| self.config.files_of(&section.name).any(|file| file == own);
        self.config.sections().iter().filter(move |section| !is_own(section))
    }

    /// The pins of this computer that printer.cfg uses, without those of the device's own file.
    pub(super) fn taken(&self, device: &Device) -> BTreeSet<String> {
        let mcus = self.mcus();
        // Another MCU may have pins of the same names.
        let is_own = |pin: &&str| mcu_of(pin).is_some_and(|mcu| mcus.contains_key(mcu.as_str()));
        self.others(device).flat_map(pins).filter(is_own).map(|pin| name_of(pin).to_owned()).collect()
    }

    /// The section other than the device's own that uses this node of a bus.
    pub(super) fn user(&self, device: &Device, kind: Kind, node: &str) -> Option<String> {
        self.others(device).find(|section| uses(section, kind, node)).map(|section| section.name.clone())
    }

    /// Whether the device's own file, which an earlier call has written, uses this node of a bus.
    pub(super) fn has_placed(&self, device: &Device, kind: Kind, node: &str) -> bool {
        let own = self.file(device.name);
        let mut sections = self.config.sections().iter();
        sections.any(|section| self.config.files_of(&section.name).any(|file| file == own) && uses(section, kind, node))
    }

    /// The serial numbers that thermometers of printer.cfg have, without the device's own.
    pub(super) fn serials(&self, device: &Device) -> BTreeSet<&str> {
        self.others(device).filter_map(|section| section.text("serial_no")).collect()
    }

    /// The MCUs of this computer, with their sections. The main one is called `mcu`.
    fn mcus(&self) -> BTreeMap<&str, &Section> {
        let own = self.config.of_kind("mcu").filter_map(|section| {
            section.text("serial").filter(|serial| serial.starts_with(HOST_PATHS))?;
            Some((section.name.strip_prefix("mcu ").map_or("mcu", str::trim), section))
        });
        own.collect()
    }

    /// The name of this computer's MCU, and whether it has to be added.
    pub(super) fn mcu(&self) -> (String, bool) {
        self.mcus().keys().next().map_or(("host".into(), true), |name| ((*name).to_owned(), false))
    }

    /// The link by which klippy finds this computer's MCU.
    pub(super) fn link(&self) -> &Path {
        let serial = self.mcus().values().find_map(|section| section.text("serial"));
        serial.map_or(Path::new(LINK), Path::new)
    }

    /// The middle of the bed.
    fn probe_point(&self) -> Option<String> {
        let number = |section: &str, key: &str| self.config.section(section)?.number(key, Limit::Any).ok()?;
        let middle = |axis: &str| {
            let section = format!("stepper_{axis}");
            let (from, to) = (number(&section, "position_min").unwrap_or(0.0), number(&section, "position_max")?);
            // A negative minimum is beside the bed.
            Some((from.max(0.0) + to) / 2.0)
        };
        if self.config.section("stepper_a").is_some() {
            // The middle of a delta printer is its origin.
            return Some(format!("0, 0, {PROBE_Z_MM}"));
        }
        Some(format!("{:.0}, {:.0}, {PROBE_Z_MM}", middle("x")?, middle("y")?))
    }

    /// The changes that add these sections for a device, and the keys of all that it needs.
    ///
    /// # Errors
    ///
    /// One line: a file in the way is not ours.
    pub(super) fn plan(
        &self,
        side: &Side,
        device: &Device,
        sections: &str,
    ) -> Result<(Vec<Change>, Vec<String>), String> {
        let mut changes = Vec::new();
        let mut needs = vec![INCLUDE.to_owned()];
        let mut make = |key: &str, file: PathBuf, text: String| -> Result<(), String> {
            // A file that is there is left as it is: the user may have changed it.
            if side.read(&file)?.is_none() {
                changes.push(Change { key: key.to_owned(), file, makes: true, splice: Splice::insert(0, text) });
            }
            Ok(())
        };
        let (mcu, is_missing) = self.mcu();
        if is_missing {
            let text =
                format!("# Written by pinion add. This computer's pins and buses.\n[mcu {mcu}]\nserial: {LINK}\n");
            make(MCU, self.file("host-mcu"), text)?;
        }
        needs.push(MCU.to_owned());
        let mut text = format!("# Written by pinion add {}. {}\n{}", device.name, device.title, sections.trim_start());
        if device.resonance && !self.others(device).any(|section| section.name == "resonance_tester") {
            text += &match self.probe_point() {
                Some(point) => format!(
                    "\n[resonance_tester]\naccel_chip: {}\n# The middle of the bed, and {PROBE_Z_MM} mm above it\nprobe_points: {point}\n",
                    device.section
                ),
                None => "\n# [resonance_tester] needs your probe point: see docs/Measuring_Resonances.md of Klipper\n"
                    .into(),
            };
        }
        make(device.name, self.file(device.name), text)?;
        let folder = self.folder();
        let includes = self.text.lines().filter_map(included);
        let is_included = includes.map(|pattern| self.path.with_file_name(pattern)).any(|pattern| {
            let pattern = pattern.to_str().and_then(|pattern| Pattern::new(pattern).ok());
            pattern.is_some_and(|pattern| pattern.matches_path(&folder.join("any-name.cfg")))
        });
        if !is_included {
            changes.push(Change { key: INCLUDE.into(), file: self.file.clone(), makes: false, splice: self.include() });
        }
        Ok((changes, needs))
    }

    /// The include, behind the last one at the top of printer.cfg, or at its head. No option can stand behind an
    /// include, so it never comes between a section and its options.
    fn include(&self) -> Splice {
        let end = if self.text.contains("\r\n") { "\r\n" } else { "\n" };
        let mut at = 0;
        let mut place = 0;
        for line in self.text.split_inclusive('\n') {
            at += line.len();
            if included(line).is_some() {
                place = at;
            }
        }
        let is_open = !self.text[..place].is_empty() && !self.text[..place].ends_with('\n');
        let before = if is_open { end } else { "" };
        Splice::insert(place, format!("{before}[include pinion/*.cfg]{end}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::add::catalog::Catalog;
    use crate::cli::computer::tests::Tree;

    const CONFIG: &str = "/home/pi/printer_data/config/printer.cfg";

    fn read(files: &[(&str, &str)]) -> (Tree, Printer) {
        let tree = Tree::new();
        for (name, text) in files {
            tree.put(&format!("home/pi/printer_data/config/{name}"), text);
        }
        let path = find(&tree.computer(), None).unwrap();
        assert_eq!(path, Path::new(CONFIG));
        let printer = Printer::read(&tree.computer(), &path).unwrap();
        (tree, printer)
    }

    fn plan(tree: &Tree, printer: &Printer, device: &str) -> Vec<(String, String)> {
        let catalog = Catalog::read().unwrap();
        let device = catalog.device(device).unwrap();
        let computer = tree.computer();
        let side = Side { computer: &computer, owner: None, records: printer.folder() };
        let (changes, _) = printer.plan(&side, device, "[x]\n").unwrap();
        let name =
            |change: &Change| change.file.strip_prefix("/home/pi/printer_data/config").unwrap().display().to_string();
        changes.iter().map(|change| (name(change), change.splice.new.clone())).collect()
    }

    #[test]
    fn a_device_has_its_file_and_one_include_for_all() {
        let (tree, printer) = read(&[(
            "printer.cfg",
            "# mine\n[mcu]\nserial: /dev/x\n[stepper_x]\nposition_max: 250 # mm\n[stepper_y]\nposition_min: -5\nposition_max: 210\n",
        )]);
        let changes = plan(&tree, &printer, "adxl345");
        let names: Vec<&str> = changes.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["pinion/host-mcu.cfg", "pinion/adxl345.cfg", "printer.cfg"]);
        assert!(changes[0].1.ends_with("[mcu host]\nserial: /tmp/klipper_host_mcu\n"));
        assert!(
            changes[1].1.ends_with(
                "accel_chip: adxl345\n# The middle of the bed, and 20 mm above it\nprobe_points: 125, 105, 20\n"
            ),
            "{}",
            changes[1].1
        );
        assert_eq!(changes[2].1, "[include pinion/*.cfg]\n");
        assert_eq!(printer.include().at, 0);
    }

    #[test]
    fn what_printer_cfg_has_already_is_not_written_again() {
        let (tree, printer) = read(&[
            (
                "printer.cfg",
                "[include pinion/*.cfg]\n[include other.cfg]\n[stepper_a]\n[fan]\npin: !rpi:GPIO17, rpi:gpio27\n",
            ),
            ("other.cfg", "[mcu rpi]\nserial: /tmp/klipper_host_mcu\n[resonance_tester]\naccel_chip: x\n[adxl345]\n"),
            ("pinion/relay.cfg", "[output_pin relay]\npin: rpi:GPIO22\n"),
        ]);
        assert_eq!(printer.mcu(), ("rpi".into(), false));
        assert_eq!(printer.link(), Path::new("/tmp/klipper_host_mcu"));
        let changes = plan(&tree, &printer, "lis2dw");
        assert_eq!(
            changes,
            [("pinion/lis2dw.cfg".into(), "# Written by pinion add lis2dw. accelerometer LIS2DW12\n[x]\n".into())]
        );
        assert_eq!(plan(&tree, &printer, "relay"), [], "its file is there");
        let catalog = Catalog::read().unwrap();
        let elsewhere = printer.elsewhere(catalog.device("adxl345").unwrap()).unwrap();
        assert!(elsewhere.ends_with("other.cfg"));
        assert_eq!(printer.elsewhere(catalog.device("relay").unwrap()), None);
        let taken = |device: &str| printer.taken(catalog.device(device).unwrap()).into_iter().collect::<Vec<_>>();
        assert_eq!(taken("light"), ["GPIO17", "GPIO22", "gpio27"]);
        assert_eq!(taken("relay"), ["GPIO17", "gpio27"], "a second call chooses the same line");
        assert_eq!(printer.probe_point().unwrap(), "0, 0, 20");
    }

    #[test]
    fn pins_of_another_mcu_are_not_this_computer_s() {
        let taken = |text: &str| {
            let catalog = Catalog::read().unwrap();
            let (_tree, printer) = read(&[("printer.cfg", text)]);
            let taken = printer.taken(catalog.device("relay").unwrap());
            (printer.mcu().0, taken.into_iter().collect::<Vec<_>>())
        };
        // A main board whose pins have a Raspberry Pi's names.
        let pico = "[mcu]\nserial: /dev/serial/by-id/x\n[fan]\npin: gpio17\n[mcu pi]\nserial: /tmp/klipper_host_mcu\n\
                    [output_pin a]\npin: !pi:gpio27\n";
        assert_eq!(taken(pico), ("pi".into(), vec!["gpio27".into()]));
        // Any path that klippy takes for a pseudo terminal.
        let folder = "[mcu rpi]\nserial: /tmp/klipper_host_mine/tty\n[fan]\npin: rpi:GPIO17\n";
        assert_eq!(taken(folder), ("rpi".into(), vec!["GPIO17".into()]));
        // Pinion as the only MCU.
        let alone = "[mcu]\nserial: /tmp/klipper_host_mcu\n[fan]\npin: !GPIO17\n[x]\na_pins: mcu:GPIO5, ^ebb:GPIO6\n";
        assert_eq!(taken(alone), ("mcu".into(), vec!["GPIO17".into(), "GPIO5".into()]));
    }

    #[test]
    fn the_include_comes_where_no_section_is_cut() {
        for (text, at, new) in [
            ("[include a.cfg]\n[fan]\npin: x\n[include b.cfg]\n\n[x]\n", 45, "[include pinion/*.cfg]\n"),
            ("[fan]\r\npin: x\r\n", 0, "[include pinion/*.cfg]\r\n"),
            ("[include a.cfg]", 15, "\n[include pinion/*.cfg]\n"),
            ("", 0, "[include pinion/*.cfg]\n"),
            ("#[include a.cfg]\n", 0, "[include pinion/*.cfg]\n"),
        ] {
            let (_tree, printer) = read(&[("printer.cfg", text)]);
            let splice = printer.include();
            assert_eq!((splice.at, &*splice.new), (at, new), "{text:?}");
        }
    }

    /// klippy looks for includes beside the link.
    #[test]
    fn the_device_s_files_are_where_klippy_looks_for_them() {
        let tree = Tree::new();
        tree.put("home/pi/dotfiles/printer.cfg", "[include other.cfg]\n[fan]\npin: a\n");
        tree.put("home/pi/printer_data/config/other.cfg", "[adxl345]\n");
        tree.link("home/pi/printer_data/config/printer.cfg", "../../dotfiles/printer.cfg");
        let error = Printer::read(&tree.computer(), Path::new(CONFIG)).unwrap_err();
        let file = "/home/pi/dotfiles/printer.cfg";
        assert!(error.ends_with(&format!("--config {file}")), "{error}");
        let printer = Printer::find(&tree.computer(), Some(Path::new(file))).unwrap();
        assert!(printer.config.section("adxl345").is_some(), "{printer:?}");
        let computer = tree.computer();
        let side = Side { computer: &computer, owner: None, records: printer.folder() };
        let catalog = Catalog::read().unwrap();
        let (changes, _) = printer.plan(&side, catalog.device("relay").unwrap(), "[x]\n").unwrap();
        let files: Vec<&str> = changes.iter().map(|change| change.file.to_str().unwrap()).collect();
        let folder = "/home/pi/printer_data/config/pinion";
        assert_eq!(files, [&*format!("{folder}/host-mcu.cfg"), &*format!("{folder}/relay.cfg"), file]);
    }

    #[test]
    fn of_several_hosts_one_is_named_and_a_link_is_none() {
        let tree = Tree::new();
        assert!(find(&tree.computer(), None).unwrap_err().contains("--config"));
        tree.put("home/a/printer_data/config/printer.cfg", "");
        tree.put("home/b/printer_data/config/printer.cfg", "");
        assert!(find(&tree.computer(), None).unwrap_err().contains("several hosts"));
        tree.put("etc/shadow", "x");
        tree.link("home/c/printer.cfg", "../../etc/shadow");
        let error = Printer::read(&tree.computer(), Path::new("/home/c/printer.cfg")).unwrap_err();
        assert!(error.ends_with("it is a link: name the file that it leads to: --config /etc/shadow"), "{error}");
        // A file that includes itself, or everything.
        let path = Path::new("/home/a/printer_data/config/printer.cfg");
        for (text, refusal) in [
            ("[include *.cfg]\n", "printer.cfg:1: Recursive include of config file"),
            ("[include /*/*]\n", "/etc/shadow:1: File contains no section headers."),
        ] {
            tree.put("home/a/printer_data/config/printer.cfg", text);
            let error = Printer::read(&tree.computer(), path).unwrap_err();
            assert!(error.contains(refusal), "{error}");
        }
    }
}
