// SPDX-License-Identifier: GPL-3.0-or-later
//! Units of systemd, from their files. Their names here are without `.service`.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use glob::Pattern;

use super::Computer;

/// The folders of units, the administrator's first (systemd.unit(5)).
const FOLDERS: [&str; 4] =
    [ADMINISTRATOR_S, "/usr/local/lib/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system"];
/// The folder of the administrator's units.
pub const ADMINISTRATOR_S: &str = "/etc/systemd/system";
const ENDING: &str = ".service";

/// Whether a unit is installed and not masked. An instance of a template is installed if the template is.
pub fn is_installed(computer: &Computer, unit: &str) -> bool {
    file(computer, unit).or_else(|| file(computer, &template(unit)?)).is_some()
}

/// The template of an instance.
pub fn template(unit: &str) -> Option<String> {
    unit.split_once('@').map(|(name, _)| format!("{name}@"))
}

/// The file of a unit that is not masked.
pub fn file(computer: &Computer, unit: &str) -> Option<String> {
    let mut files = FOLDERS.iter().map(|folder| format!("{folder}/{unit}{ENDING}"));
    let file = files.find(|file| fs::symlink_metadata(computer.path(file)).is_ok())?;
    let is_masked = fs::read_link(computer.path(&file)).is_ok_and(|target| target == Path::new("/dev/null"));
    (!is_masked).then_some(file)
}

/// The units that a target starts at boot, in order, if they are `wanted`.
pub fn enabled(computer: &Computer, wanted: impl Fn(&str) -> bool) -> Vec<String> {
    let kinds = ["wants", "requires"].into_iter();
    let units = named(kinds.flat_map(|kind| computer.matching(format!("{ADMINISTRATOR_S}/*.{kind}/*{ENDING}"))));
    units.into_iter().filter(|unit| wanted(unit)).collect()
}

/// All installed units, in order.
pub fn all(computer: &Computer) -> BTreeSet<String> {
    named(FOLDERS.iter().flat_map(|folder| computer.matching(format!("{folder}/*{ENDING}"))))
}

/// The units that these files are named after.
fn named(files: impl Iterator<Item = PathBuf>) -> BTreeSet<String> {
    files.filter_map(|file| Some(file.file_name()?.to_str()?.strip_suffix(ENDING)?.to_owned())).collect()
}

/// The text of a unit, with the texts of the files that add to it.
pub fn text(computer: &Computer, unit: &str) -> Option<String> {
    let file = FOLDERS.iter().find_map(|folder| computer.text(format!("{folder}/{unit}{ENDING}")))?;
    // The administrator's files come last.
    let unit = Pattern::escape(unit);
    let added = FOLDERS.iter().rev().flat_map(|folder| computer.matching(format!("{folder}/{unit}{ENDING}.d/*.conf")));
    let added = added.filter_map(|file| computer.text(computer.name(&file)));
    Some(std::iter::once(file).chain(added).collect::<Vec<_>>().join("\n"))
}

/// A setting in a unit's text. The last one counts.
pub fn setting<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let values = text.lines().filter_map(|line| line.trim().strip_prefix(key)?.trim_start().strip_prefix('='));
    values.map(str::trim).rfind(|value| !value.is_empty())
}

/// Whether this is the name of a unit of Klipper's own MCU program.
pub fn of_klipper_mcu(unit: &str) -> bool {
    ["klipper-mcu", "klipper_mcu"].contains(&unit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    #[test]
    fn what_is_installed_masked_or_an_instance() {
        let tree = Tree::empty();
        let is = |unit: &str| is_installed(&tree.computer(), unit);
        ["pinion-mcu@", "pinion-mcu"]
            .iter()
            .for_each(|unit| tree.put(&format!("usr/lib/systemd/system/{unit}.service"), ""));
        assert!(is("pinion-mcu@second") && is("pinion-mcu") && !is("pinion"));
        tree.link("etc/systemd/system/pinion-mcu.service", "/dev/null");
        assert!(!is("pinion-mcu"), "it is masked");
    }

    #[test]
    fn what_is_added_to_a_unit_counts() {
        let tree = Tree::empty();
        assert_eq!(text(&tree.computer(), "a"), None);
        tree.put("lib/systemd/system/a.service", "User=lib\nGroup=lib\n");
        tree.put("lib/systemd/system/a.service.d/z.conf", "User=lib.d\n");
        tree.put("etc/systemd/system/a.service.d/a.conf", "User = etc.d\n");
        tree.put("etc/systemd/system/a.service.d/b.conf~", "User=backup\n");
        let text = text(&tree.computer(), "a").unwrap();
        assert_eq!((setting(&text, "User"), setting(&text, "Group")), (Some("etc.d"), Some("lib")));
        assert_eq!(setting(&text, "ExecStart"), None);
    }
}
