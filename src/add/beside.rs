// SPDX-License-Identifier: GPL-3.0-or-later
//! The files that pinion add has beside printer.cfg: which of them a device needs, and which of them an undo takes away.
//!
//! A device has a file of its own in the folder `pinion`, and all of them share one `[include pinion/*.cfg]`. Nothing else
//! in printer.cfg is touched. The head of each file says that pinion add has written it, with a checksum of the rest: so a
//! file that the user has changed is known.

use std::path::{Path, PathBuf};

use glob::Pattern;
use pinion_printer_config::{Limit, Section, included};

use pinion_system::printer::LINK;

use super::catalog::{Catalog, Device};
use super::edit::{Edit, Editor, MARK};
use super::printer::Target;

/// How high above the bed resonances are measured, in millimeters (docs/Measuring_Resonances.md of Klipper).
const PROBE_Z_MM: f64 = 20.0;
/// The file of this computer's MCU, without `.cfg`.
pub(super) const MCU: &str = "host-mcu";
/// The file of `[resonance_tester]`.
pub(super) const RESONANCES: &str = "resonance_tester";
/// The line that includes the folder. A line of the user's own has no such comment.
const INCLUDE: &str = "[include pinion/*.cfg] # by pinion add";

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

/// The middle of the bed.
fn probe_point(target: &Target) -> Option<String> {
    let number = |section: &str, key: &str| target.config().section(section)?.number(key, Limit::Any).ok()?;
    let middle = |axis: &str| {
        let section = format!("stepper_{axis}");
        let (from, to) = (number(&section, "position_min").unwrap_or(0.0), number(&section, "position_max")?);
        // A negative minimum is beside the bed.
        Some((from.max(0.0) + to) / 2.0)
    };
    if target.config().section("stepper_a").is_some() {
        // The middle of a delta printer is its origin.
        return Some(format!("0, 0, {PROBE_Z_MM}"));
    }
    Some(format!("{:.0}, {:.0}, {PROBE_Z_MM}", middle("x")?, middle("y")?))
}

/// The file with `[resonance_tester]` for this accelerometer.
fn resonances(target: &Target, section: &str) -> String {
    let rest = match probe_point(target) {
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
    target: &Target,
    editor: &Editor,
    device: &Device,
    name: Option<&str>,
    sections: &str,
    mcu: Option<&str>,
) -> Result<Vec<Edit>, String> {
    let mut edits = Vec::new();
    let mut make = |name: &str, text: String| -> Result<(), String> {
        let file = target.file(name);
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
    if device.resonance && target.config().section(RESONANCES).is_none() {
        make(RESONANCES, resonances(target, &device.section(name)))?;
    }
    let folder = target.folder();
    let includes = target.text.lines().filter_map(included);
    let is_included = includes.map(|pattern| target.path.with_file_name(pattern)).any(|pattern| {
        let pattern = pattern.to_str().and_then(|pattern| Pattern::new(pattern).ok());
        pattern.is_some_and(|pattern| pattern.matches_path(&folder.join("any-name.cfg")))
    });
    if !is_included {
        edits.push(Edit {
            file: target.file.clone(),
            old: Some(target.text.clone()),
            new: Some(with_include(&target.text)),
        });
    }
    Ok(edits)
}

/// printer.cfg with the include, behind the last one at the top, or at its head. No option can stand behind an include,
/// so it never comes between a section and its options.
fn with_include(text: &str) -> String {
    let end = if text.contains("\r\n") { "\r\n" } else { "\n" };
    let mut at = 0;
    let mut place = 0;
    for line in text.split_inclusive('\n') {
        at += line.len();
        if included(line).is_some() {
            place = at;
        }
    }
    let (before, after) = text.split_at(place);
    let is_open = !before.is_empty() && !before.ends_with('\n');
    format!("{before}{}{INCLUDE}{end}{after}", if is_open { end } else { "" })
}

/// The changes that take a device out of the printer, and a line in `left` for each thing that stays.
///
/// # Errors
///
/// One line: a file cannot be read.
pub(super) fn plan_undo(
    target: &Target,
    editor: &Editor,
    catalog: &Catalog,
    device: &Device,
    name: Option<&str>,
    left: &mut Vec<String>,
) -> Result<Vec<Edit>, String> {
    let own = target.file(&device.file(name));
    let stays = target.others(&own).collect();
    let mut undo = Undo { target, editor, own: &own, stays, edits: Vec::new(), left };
    undo.own_file()?;
    undo.resonances(catalog, &device.section(name))?;
    undo.mcu()?;
    undo.printer_cfg()?;
    Ok(undo.edits)
}

/// An undo while it is planned.
struct Undo<'a> {
    target: &'a Target,
    editor: &'a Editor<'a>,
    /// The device's file.
    own: &'a Path,
    /// The sections that remain.
    stays: Vec<&'a Section>,
    edits: Vec<Edit>,
    left: &'a mut Vec<String>,
}

impl Undo<'_> {
    fn remove(&mut self, file: &Path, text: String) {
        self.edits.push(Edit { file: file.to_owned(), old: Some(text), new: None });
    }

    /// The text of a file that is as pinion add wrote it.
    fn unchanged(&self, file: &Path) -> Result<Option<String>, String> {
        Ok(self.editor.read(file)?.filter(|text| is_ours(text) == Some(true)))
    }

    /// The files in the folder `pinion`.
    fn files(&self) -> Vec<PathBuf> {
        let computer = self.editor.computer;
        computer.matching(self.target.folder().join("*.cfg")).iter().map(|path| computer.name(path)).collect()
    }

    /// A file that the user has changed is kept under another name, which klippy does not read.
    fn own_file(&mut self) -> Result<(), String> {
        let file = self.own;
        let Some(text) = self.editor.read(file)? else { return Ok(()) };
        match is_ours(&text) {
            None => self.left.push(format!("{} was not written by pinion add, so it stays", file.display())),
            Some(true) => self.remove(file, text),
            Some(false) => {
                let kept = file.with_extension("cfg.removed");
                let old = self.editor.read(&kept)?;
                self.remove(file, text.clone());
                self.left.push(format!("{} was changed later: {} keeps it", file.display(), kept.display()));
                self.edits.push(Edit { file: kept, old, new: Some(text) });
            }
        }
        Ok(())
    }

    /// Another accelerometer goes on measuring resonances. `chip` is the section of the device that goes.
    fn resonances(&mut self, catalog: &Catalog, chip: &str) -> Result<(), String> {
        let file = self.target.file(RESONANCES);
        let Some(text) = self.unchanged(&file)? else { return Ok(()) };
        let used = self.target.config().section(RESONANCES).and_then(|section| section.text("accel_chip"));
        let is_other =
            |section: &&&Section| catalog.devices.iter().any(|other| other.resonance && other.is_chip_of(section));
        match self.stays.iter().find(is_other) {
            // It is this other one's already.
            Some(_) if used.is_some_and(|used| used != chip) => {}
            Some(other) => {
                let new = Some(resonances(self.target, &other.name)).filter(|new| *new != text);
                self.edits.extend(new.map(|new| Edit { file, old: Some(text), new: Some(new) }));
            }
            None => {
                self.remove(&file, text);
                self.stays.retain(|section| !self.target.is_in(section, &file));
            }
        }
        Ok(())
    }

    /// The MCU of this computer stays while another section uses it.
    fn mcu(&mut self) -> Result<(), String> {
        let target = self.target;
        let file = target.file(MCU);
        let Some(text) = self.unchanged(&file)? else { return Ok(()) };
        let own = target.config().of_kind("mcu").find(|section| target.is_in(section, &file));
        let mcu = own.map_or("", |section| section.name.trim_start_matches("mcu ").trim());
        let uses_it = |section: &&&Section| {
            let named = section.settings().iter().filter(|setting| setting.key.contains("mcu"));
            let is_listed = named.flat_map(|setting| setting.value.split(',')).any(|own| own.trim() == mcu);
            let is_pin = |text: &str| text.trim_start_matches(['^', '~', '!', ' ']).starts_with(&format!("{mcu}:"));
            let has_pin = section.settings().iter().flat_map(|setting| setting.value.split([',', '\n'])).any(is_pin);
            section.kind() != "mcu" && (is_listed || has_pin)
        };
        let shared = [&*file, &*target.file(RESONANCES), self.own];
        match self.stays.iter().find(uses_it) {
            Some(user) if !target.is_pinion_s(user) => {
                self.left.push(format!("{} stays: [{}] uses [mcu {mcu}]", file.display(), user.name));
            }
            Some(_) => {}
            // Without its include, klippy does not read the others now.
            None if own.is_some() || self.files().iter().all(|other| shared.contains(&&**other)) => {
                self.remove(&file, text);
            }
            None => {}
        }
        Ok(())
    }

    /// printer.cfg without its include, if no file needs it, and without what klippy has saved of the device.
    fn printer_cfg(&mut self) -> Result<(), String> {
        let target = self.target;
        let (file, text) = (&target.file, &target.text);
        let goes = |file: &Path| self.edits.iter().any(|edit| edit.file == file && edit.new.is_none());
        // What klippy would still find of the device would be a section without its options.
        let sections = target.config().sections().iter();
        let saved = sections.filter(|section| goes(self.own) && target.is_in(section, self.own));
        let saved: Vec<&str> = saved.map(|section| section.name.as_str()).collect();
        let mut new = target.config().without_saved(text, &saved);
        if new != *text {
            let sections = saved.join("], [");
            self.left.push(format!("the lines of [{sections}] in the SAVE_CONFIG block of {} go, too", file.display()));
        }
        if text.contains(INCLUDE) || text.contains("[include pinion/") {
            let is_include = |line: &&str| line.trim_end() == INCLUDE;
            match self.files().into_iter().find(|file| !goes(file)) {
                Some(other) => {
                    if self.editor.read(&other)?.is_none_or(|text| is_ours(&text).is_none()) {
                        self.left.push(format!("{} keeps its include: {} is there", file.display(), other.display()));
                    }
                }
                None if text.lines().any(|line| is_include(&line)) => {
                    new = new.split_inclusive('\n').filter(|line| !is_include(line)).collect();
                }
                None if self.edits.is_empty() => {}
                None => {
                    let cause = "pinion add has not written this line";
                    self.left.push(format!("{} keeps its include: {cause}", file.display()));
                }
            }
        }
        match new == *text {
            true => self.edits.extend(self.editor.needless_copy(file, text)?),
            false => self.edits.push(Edit { file: file.clone(), old: Some(text.clone()), new: Some(new) }),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::printer::tests::{CONFIG, read};
    use super::*;
    use crate::tree::Tree;

    /// The files that a device without sections of its own changes, with their new texts.
    fn plan(tree: &Tree, target: &Target, device: &str) -> Vec<(String, String)> {
        let catalog = Catalog::read().unwrap();
        let device = catalog.device(device).unwrap();
        let computer = tree.computer();
        let editor = Editor::new(&computer, None);
        let (mcu, _, is_missing) = target.mcu(None).unwrap();
        let edits = super::plan(target, &editor, device, None, "[x]\n", is_missing.then_some(&*mcu)).unwrap();
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
        assert_eq!(probe_point(&target).unwrap(), "0, 0, 20");
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
            assert_eq!(with_include(&target.text), new.replace("NEW", include), "{text:?}");
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
}
