// SPDX-License-Identifier: GPL-3.0-or-later
//! The settings of systemd itself, from the running one and from its files.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use pinion_firmware::trouble::Trouble;

use super::units::setting;
use super::{Computer, output};
use crate::settings::WATCHDOG;

/// The program that asks the running systemd.
pub const SYSTEMCTL: &str = "/usr/bin/systemctl";
/// The folders of system.conf and of its drop-ins. A file hides those of the same name in the folders after it
/// (systemd-system.conf(5)).
const FOLDERS: [&str; 5] =
    ["/etc/systemd", "/run/systemd", "/usr/local/lib/systemd", "/usr/lib/systemd", "/lib/systemd"];
/// The drop-in that switches systemd's watchdog off. Raspberry Pi OS has 40-rpi-enable-watchdog.conf, and the last one
/// counts, in whichever folder it is.
const DROP_IN: &str = "99-pinion.conf";
const REREAD: &str = "sudo systemctl daemon-reexec";
const LEAVE_IT: &str = "or watchdog = false: systemd also resets a computer that hangs";

/// Why systemd has the hardware watchdog, and how to take it from systemd. `None` if systemd leaves it alone. `systemctl`
/// is the program that asks the running systemd, if it may be started.
pub fn watchdog_of_systemd(computer: &Computer, systemctl: Option<&Path>) -> Option<Trouble> {
    let is_on = |value: &str| !["0", "off"].contains(&value);
    let said =
        systemctl.and_then(|systemctl| output(Command::new(systemctl).args(["show", "-p", "RuntimeWatchdogUSec"])));
    let running = said.as_deref().and_then(|said| setting(said, "RuntimeWatchdogUSec")).filter(|value| is_on(value));
    let set = runtime_watchdog(computer).filter(|(_, value)| is_on(value));
    let (how, remedy) = match (set, running) {
        (Some((file, value)), _) => {
            let name = drop_in_after(&file);
            let write = format!(
                "printf '[Manager]\\nRuntimeWatchdogSec=off\\n' | sudo install -D -m 644 /dev/stdin /etc/systemd/system.conf.d/{name}"
            );
            (format!("RuntimeWatchdogSec={value} in {file}"), format!("{write} && {REREAD}"))
        }
        (None, Some(value)) => (format!("RuntimeWatchdogUSec={value} in the running one"), REREAD.to_owned()),
        (None, None) => return None,
    };
    Some(
        Trouble::new(format!("systemd feeds {WATCHDOG}, which only one program can do: {how}"))
            .remedy(format!("{remedy}; {LEAVE_IT}")),
    )
}

/// The file that sets RuntimeWatchdogSec=, and the value. The last file that sets it counts.
fn runtime_watchdog(computer: &Computer) -> Option<(String, String)> {
    let names = FOLDERS.map(|folder| format!("{folder}/system.conf"));
    let main = computer.first(&names.each_ref().map(String::as_str)).map(str::to_owned);
    let mut drop_ins = BTreeMap::new();
    for folder in FOLDERS.iter().rev() {
        for file in computer.matching(format!("{folder}/system.conf.d/*.conf")) {
            let name = file.file_name().unwrap_or_default().to_owned();
            drop_ins.insert(name, computer.name(&file).display().to_string());
        }
    }
    let files = main.into_iter().chain(drop_ins.into_values());
    let mut set = files.filter_map(|file| {
        let text = computer.text(&file)?;
        let value = setting(&text, "RuntimeWatchdogSec")?.to_owned();
        Some((file, value))
    });
    set.next_back()
}

/// The name of a drop-in that counts more than this file.
fn drop_in_after(file: &str) -> String {
    let (folder, name) = file.rsplit_once('/').unwrap_or(("", file));
    match name.strip_suffix(".conf") {
        Some(stem) if folder.ends_with(".d") && name > DROP_IN => format!("{stem}.pinion.conf"),
        _ => DROP_IN.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;

    const RASPBERRY_PI_OS: &str = "usr/lib/systemd/system.conf.d/40-rpi-enable-watchdog.conf";

    /// The finding, and the remedy. Both are empty if systemd leaves the watchdog alone. `said` is the output of
    /// `systemctl show`.
    fn found(tree: &Tree, said: Option<&str>) -> (String, String) {
        let script = |said| format!("#!/bin/sh\n[ \"$*\" = 'show -p RuntimeWatchdogUSec' ] && echo {said}\n");
        let systemctl = said.map(|said| tree.program("systemctl", &script(said)));
        watchdog_of_systemd(&tree.computer(), systemctl.as_deref()).map_or_else(Default::default, |trouble| {
            (trouble.found().to_string(), trouble.remedy.unwrap_or_default().into())
        })
    }

    #[test]
    fn raspberry_pi_os_has_systemd_feed_it() {
        let tree = Tree::empty();
        assert_eq!(found(&tree, None).0, "");
        tree.put("etc/systemd/system.conf", "[Manager]\n#RuntimeWatchdogSec=off\n");
        assert_eq!(found(&tree, Some("RuntimeWatchdogUSec=0")).0, "");
        tree.put(RASPBERRY_PI_OS, "[Manager]\nRuntimeWatchdogSec=1m\nRebootWatchdogSec=2m\n");
        for said in [None, Some("RuntimeWatchdogUSec=1min"), Some("RuntimeWatchdogUSec=0")] {
            let (found, remedy) = found(&tree, said);
            assert_eq!(
                found,
                format!(
                    "systemd feeds /dev/watchdog, which only one program can do: RuntimeWatchdogSec=1m in /{RASPBERRY_PI_OS}"
                )
            );
            assert_eq!(
                remedy.split_once("; ").map(|(command, _)| command).unwrap_or_default(),
                "printf '[Manager]\\nRuntimeWatchdogSec=off\\n' | sudo install -D -m 644 /dev/stdin \
                 /etc/systemd/system.conf.d/99-pinion.conf && sudo systemctl daemon-reexec"
            );
        }
        // The remedy, before systemd has read it, and after.
        tree.put("etc/systemd/system.conf.d/99-pinion.conf", "[Manager]\nRuntimeWatchdogSec=off\n");
        // A busy computer may start the program later than it is waited for.
        let mut asked = (0..5).map(|_| found(&tree, Some("RuntimeWatchdogUSec=1min")));
        let (words, remedy) = asked.find(|(words, _)| !words.is_empty()).expect("an answer");
        assert!(words.ends_with("RuntimeWatchdogUSec=1min in the running one"), "{words}");
        assert!(remedy.starts_with("sudo systemctl daemon-reexec; or watchdog = false"), "{remedy}");
        assert_eq!(found(&tree, Some("RuntimeWatchdogUSec=0")).0, "");
        assert_eq!(found(&tree, None).0, "");
    }

    #[test]
    fn the_last_file_by_name_counts_in_whichever_folder_it_is() {
        let tree = Tree::empty();
        tree.put("etc/systemd/system.conf", "RuntimeWatchdogSec=off\n");
        tree.put("usr/lib/systemd/system.conf", "RuntimeWatchdogSec=3\n");
        assert_eq!(found(&tree, None).0, "", "/etc hides it");
        tree.put(RASPBERRY_PI_OS, "RuntimeWatchdogSec=1m\n");
        // The usual mistake: /etc does not come after /usr/lib.
        tree.put("etc/systemd/system.conf.d/10-watchdog.conf", "RuntimeWatchdogSec=off\n");
        assert!(found(&tree, None).0.ends_with("40-rpi-enable-watchdog.conf"));
        tree.put("etc/systemd/system.conf.d/40-rpi-enable-watchdog.conf", "");
        assert_eq!(found(&tree, None).0, "", "a file of the same name hides it");
        // The name of the remedy comes after any.
        tree.put("etc/systemd/system.conf.d/zz.conf", "RuntimeWatchdogSec=default\n");
        let (words, remedy) = found(&tree, None);
        assert!(words.ends_with("RuntimeWatchdogSec=default in /etc/systemd/system.conf.d/zz.conf"), "{words}");
        assert!(remedy.contains("/system.conf.d/zz.pinion.conf && "), "{remedy}");
        tree.put("etc/systemd/system.conf.d/zz.pinion.conf", "RuntimeWatchdogSec=off\n");
        assert_eq!(found(&tree, None).0, "");
    }
}
