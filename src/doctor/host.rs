// SPDX-License-Identifier: GPL-3.0-or-later
//! The host: which klippys there are, and whether Pinion speaks their messages.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::DialectName;
use pinion_firmware::trouble::Trouble;
use pinion_runtime::klippy::{self as host, Checkout};
use pinion_system::Computer;
use pinion_system::finding::{Finding, Level};
use pinion_system::klippy::Klippy;
use pinion_system::printer::Printer;

use super::UPGRADE;
use super::klipper;
use pinion_system::instance::Instance;

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

/// The things of one kind that these configurations name.
pub(super) fn of_all<T: Ord>(klippys: &[Klippy], kind: fn(&Printer) -> BTreeSet<T>) -> BTreeSet<T> {
    printers(klippys).flat_map(kind).collect()
}

/// Whether Pinion speaks the messages of each host.
pub(super) fn dialects(computer: &Computer, instances: &[Instance], klippys: &[Klippy]) -> Vec<Finding> {
    if klippys.is_empty() {
        let found = "the host is unknown: no klippy runs, and no unit starts a klippy";
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
        "processes of other users are called like a Pinion or a klippy, and do not count here: {}{more}",
        pids.join(", ")
    );
    (!strangers.is_empty())
        .then(|| Finding::ok("strangers", found).or("if one of them is yours, have a service start it"))
}

const DIALECT: &str = "dialect";

fn dialect(computer: &Computer, instances: &[Instance], klippy: &Klippy) -> Vec<Finding> {
    let Klippy { folder, found_by, .. } = klippy;
    let Some(folder) = folder else {
        let found = format!("klippy's sources ({found_by}) are unknown: this user may not read klippy's folder");
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
                "the host is newer than Pinion: Pinion does not have these messages{}: {}",
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
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_firmware::mcu::{DialectName, Forms, Part, entries};
    use pinion_system::finding::Level::{Error, Ok, Warning};
    use pinion_system::instance::instances;
    use pinion_system::klippy::klippys;

    #[test]
    fn the_host_s_dialect() {
        let tree = Tree::empty();
        let look = || {
            let computer = tree.computer();
            dialects(&computer, &instances(&computer).0, &klippys(&computer))
        };
        says(&look(), "dialect", Ok, "the host is unknown");
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
