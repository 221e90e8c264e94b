// SPDX-License-Identifier: GPL-3.0-or-later
//! The printer.cfg to which a device is added: where it is, whose it is, and what it has.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use pinion_printer_config::{Config, Section};

use pinion_linux::foreign::word;
use pinion_system::Computer;
use pinion_system::klippy::{Klippy, configs, klippys};
use pinion_system::printer::{LINK, Printer};
use pinion_system::uses::Use;

use super::beside::{MCU, RESONANCES};
use super::catalog::{Device, Wiring};
use super::edit::Editor;

/// Where Moonraker answers, if nothing says otherwise.
const MOONRAKER_PORT: &str = "7125";

/// klippy's configuration.
pub(super) struct Target {
    /// printer.cfg as klippy names it, as a path of the computer. klippy looks for includes in its folder.
    pub(super) path: PathBuf,
    /// The file itself: klippy may name it by a link.
    pub(super) file: PathBuf,
    /// Its owner and group.
    pub(super) owner: (u32, u32),
    /// The contents of printer.cfg itself.
    pub(super) text: String,
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
                && let Some(pin) = self.printer.pins_of(section).find(|named| named.setting.key == key)
            {
                found.insert(role.to_owned(), pin.pin.name);
            }
        }
        found
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

#[cfg(test)]
pub(super) mod tests {
    use super::super::catalog::Catalog;
    use super::*;
    use crate::tree::Tree;

    pub(crate) const CONFIG: &str = "/home/pi/printer_data/config/printer.cfg";

    pub(crate) fn read(files: &[(&str, &str)]) -> (Tree, Target) {
        let tree = Tree::empty();
        for (name, text) in files {
            tree.put(&format!("home/pi/printer_data/config/{name}"), text);
        }
        let target = Target::find(&tree.computer(), None, None).unwrap();
        assert_eq!(target.path, Path::new(CONFIG));
        (tree, target)
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
