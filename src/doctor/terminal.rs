// SPDX-License-Identifier: GPL-3.0-or-later
//! The terminal: whether klippy finds it at the link in its configuration, and whether klippy's user can open it.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::check;
use pinion_linux::foreign::word;
use pinion_runtime::Place;
use pinion_runtime::klippy::{HOST_PATHS, is_host_path};
use pinion_system::finding::{Finding, Level};
use pinion_system::klippy::Klippy;
use pinion_system::printer::Printer;
use pinion_system::{Access, Computer, Who};

use super::host::printers;
use pinion_system::instance::{Instance, unit_for};

const CHECK: &str = "terminal";

/// For each terminal: whether its klippy finds it and may open it.
pub(super) fn terminals(computer: &Computer, instances: &[Instance], klippys: &[Klippy]) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut links: Vec<&Path> = Vec::new();
    for instance in instances {
        if !instance.settings.link.is_local() {
            findings.push(check::wire(&instance.settings.link));
            continue;
        }
        let Some(link) = &instance.link else {
            let found = format!("klippy does not take {} for a pseudo terminal", instance.settings.symlink.display());
            findings.push(Finding::ok(CHECK, found).or(format!("for klippy: pinion run -I {HOST_PATHS}NAME")));
            continue;
        };
        if links.contains(&link.as_path()) {
            let found =
                format!("{} is configured for the link {}, but another Pinion has it", instance.name(), link.display());
            findings.push(Finding::error(CHECK, found, "stop one, or give one of them another link with -I"));
            continue;
        }
        links.push(link);
        findings.extend(terminal(computer, link, Some(instance), klippys));
    }
    let named = printers(klippys).flat_map(Printer::serials);
    let others: BTreeSet<PathBuf> = named.filter(|path| !links.contains(&path.as_path())).collect();
    for path in &others {
        if is_host_path(path) {
            findings.extend(terminal(computer, path, None, klippys));
        } else if let Some(instance) = instances.iter().find(|instance| instance.settings.symlink == *path) {
            let found = format!("klippy's configuration names {}, which it takes for a serial port", path.display());
            let link = instance.link.as_ref().map_or(Path::new("/tmp/klipper_host_NAME"), PathBuf::as_path);
            findings.push(Finding::error(CHECK, found, format!("serial: {}", link.display())));
        }
    }
    findings
}

/// Whether the klippys that open a link find a terminal there, and may open it. The link is `instance`'s, or one that a
/// klippy's configuration names and no instance has.
fn terminal(computer: &Computer, path: &Path, instance: Option<&Instance>, klippys: &[Klippy]) -> Vec<Finding> {
    let shown = path.display();
    let opening: Vec<&Klippy> = klippys.iter().filter(|klippy| klippy.opens(path)).collect();
    let restart =
        instance.map_or_else(|| format!("sudo systemctl restart {}", word(unit_for(path))), Instance::restart);
    let place = Place::of(&computer.path(path));
    if let Some(obstacle) = place.obstacle(path) {
        let clear = match place {
            // The folder may have something in it.
            Place::Folder => format!("sudo mv -T {0} {0}.old", word(shown)),
            _ => format!("sudo rm {}", word(shown)),
        };
        return vec![Finding::error(CHECK, obstacle, format!("{clear} && {restart}"))];
    }
    let Ok(link) = fs::symlink_metadata(computer.path(path)) else {
        return vec![no_link(path, instance, &opening)];
    };
    let pid = instance.and_then(|instance| instance.pid);
    let Ok(way) = computer.follow(path) else {
        let target = fs::read_link(computer.path(path)).unwrap_or_default();
        let found = format!("{shown} leads to {}, which does not exist", target.display());
        return vec![match pid {
            None => Finding::warning(CHECK, found, format!("sudo systemctl start {}", word(unit_for(path)))),
            Some(_) => Finding::error(CHECK, found, restart),
        }];
    };
    let (device, about) = match way.last().map(|device| (computer.name(device), fs::metadata(device))) {
        Some((device, Ok(about))) => (device, about),
        _ => return vec![Finding::error(CHECK, format!("{shown} leads nowhere"), restart)],
    };
    // Any user can make a link in /tmp to any file, and the remedies below are about the file.
    if !computer.is_terminal(&device, &about) {
        let found = format!("{shown} leads to {}, which is not a pseudo terminal", device.display());
        return vec![Finding::error(CHECK, found, format!("sudo rm {} && {restart}", word(shown)))];
    }
    let leads = format!("{shown} leads to {}, which is {}", device.display(), computer.ownership(&about));
    if opening.is_empty() {
        let unknown = match klippys {
            [] => Finding::ok(CHECK, "klippy's user is unknown: no klippy runs, and no unit starts a klippy"),
            _ => Finding::ok(CHECK, format!("no klippy's configuration names {shown}"))
                .or(format!("in printer.cfg: [mcu host] and below it serial: {shown}")),
        };
        return vec![Finding::ok(CHECK, leads), unknown];
    }
    let terminal = Terminal { path, link: &link, way: &way, about: &about, leads: &leads };
    let opened = opening.iter().map(|klippy| access(computer, &terminal, instance, klippy));
    opened.chain(wanted_by_several(path, &opening)).collect()
}

/// The finding for a missing link.
fn no_link(path: &Path, instance: Option<&Instance>, opening: &[&Klippy]) -> Finding {
    let shown = path.display();
    match instance.map(|instance| (instance, instance.pid)) {
        Some((_, None)) => Finding::ok(CHECK, format!("{shown} does not exist, because Pinion does not run")),
        Some((instance, Some(pid))) => Finding::error(
            CHECK,
            format!("klippy opens {shown}, which does not exist, although Pinion runs (process {pid})"),
            format!("{}, or pinion run -I {shown}", instance.restart()),
        ),
        None => {
            let found =
                format!("klippy's configuration names {shown}{}, which does not exist: no Pinion has it", by(opening));
            match opening.iter().any(|klippy| klippy.unit.is_some()) {
                true => {
                    let remedy = format!(
                        "sudo systemctl enable --now {} (on another computer: pinion link), or another serial",
                        word(unit_for(path))
                    );
                    Finding::error(CHECK, found, remedy)
                }
                false => Finding::warning(CHECK, found, STRANGER),
            }
        }
    }
}

/// The finding if the configurations of several klippys name one link.
fn wanted_by_several(path: &Path, opening: &[&Klippy]) -> Option<Finding> {
    let sure: Vec<&Klippy> = opening.iter().copied().filter(|klippy| klippy.printer().is_some()).collect();
    let shown = path.display();
    let found = format!("several klippys' configurations name {shown}{}, but only one klippy can open it", by(&sure));
    let remedy = "another serial for one of them: an instance of its own (man pinion-mcu.service)";
    (sure.len() > 1).then(|| Finding::error(CHECK, found, remedy))
}

fn by(klippys: &[&Klippy]) -> String {
    let names: Vec<&str> = klippys.iter().map(|klippy| klippy.found_by.as_str()).collect();
    format!(" ({})", names.join(", "))
}

/// A terminal that exists.
struct Terminal<'a> {
    path: &'a Path,
    link: &'a fs::Metadata,
    /// All paths from the link to the device.
    way: &'a [PathBuf],
    about: &'a fs::Metadata,
    /// Where the link leads, in words.
    leads: &'a str,
}

/// The remedy for a process that is called like klippy and that no unit started. Any user can have one, and its needs
/// are no affair of the administrator.
const STRANGER: &str = "no service has started that process: if it is your klippy, have a service start it";

/// Whether a klippy's user may open a terminal. Only a service's klippy gets advice about users.
fn access(computer: &Computer, terminal: &Terminal<'_>, instance: Option<&Instance>, klippy: &Klippy) -> Finding {
    let judged = judged(computer, terminal, instance, klippy);
    if klippy.unit.is_some() || judged.status == Level::Ok {
        return judged;
    }
    Finding::warning(CHECK, judged.trouble, STRANGER)
}

fn judged(computer: &Computer, terminal: &Terminal<'_>, instance: Option<&Instance>, klippy: &Klippy) -> Finding {
    let Klippy { who, found_by, is_running, .. } = klippy;
    let Terminal { path, link, way, about, leads } = *terminal;
    let (name, leads) = (&who.name, format!("{leads}, for klippy's user {} ({found_by})", who.name));
    if let Some(owner) = link_is_refused(computer, path, link, who) {
        let shown = path.display();
        let found = format!("{name} may not follow {shown}, a link of user {owner} (fs.protected_symlinks)");
        let remedy = format!("use the service, or run Pinion as {name}");
        return Finding::error(CHECK, found, remedy);
    }
    let closed = way.iter().filter_map(|path| path.parent()).find_map(|folder| {
        let about = fs::metadata(folder).ok()?;
        (!who.may(Access::SEARCH, &about)).then(|| (computer.name(folder), computer.ownership(&about)))
    });
    if let Some((folder, ownership)) = closed {
        let found = format!("{name} may not enter {}, which is {ownership}", folder.display());
        return Finding::error(CHECK, found, format!("sudo chmod o+x {}", word(folder.display())));
    }
    if who.may(Access::READ_WRITE, about) {
        return Finding::ok(CHECK, leads);
    }
    let group = computer.common_group(about);
    let is_member = computer.user(name).is_some_and(|user| user.gids.contains(&about.gid()));
    let remedy = match (instance, group) {
        (Some(instance), group) if group.is_none() || !Access::READ_WRITE.is_given_to_group(about) => {
            format!("mode = \"0660\" and group = \"tty\" in {}, then {}", instance.config(), instance.restart())
        }
        (None, None) => format!("let the program that serves {} give it to the group tty", path.display()),
        _ if is_member && *is_running => {
            format!("{}, because the user became a member after it was started", klippy.restart())
        }
        (_, group) => {
            format!("sudo usermod -aG {} {} && {}", word(group.unwrap_or_default()), word(name), klippy.restart())
        }
    };
    Finding::error(CHECK, format!("{name}, klippy's user ({found_by}), may not open it: {leads}"), remedy)
}

/// The owner of a link that the kernel refuses to follow.
fn link_is_refused(computer: &Computer, path: &Path, link: &fs::Metadata, who: &Who) -> Option<String> {
    let is_on = computer.text("/proc/sys/fs/protected_symlinks").is_some_and(|text| text == "1");
    let folder = fs::metadata(computer.path(path.parent()?)).ok()?;
    let refused = is_on && is_protected(folder.mode(), folder.uid(), link.uid(), who.uid);
    refused.then(|| computer.ownership(link).split(':').next().unwrap_or_default().to_owned())
}

/// Whether this user may not follow a link in a folder of this mode and owner. In a sticky folder that all may write
/// to, only the link's owner may follow it. A link of the folder's owner is an exception: everybody may follow it
/// (proc_sys_fs(5), `protected_symlinks`).
fn is_protected(folder_mode: u32, folder_uid: u32, link_uid: u32, uid: u32) -> bool {
    folder_mode & 0o1002 == 0o1002 && link_uid != uid && link_uid != folder_uid
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok, Warning};
    use pinion_system::instance::instances;
    use pinion_system::klippy::klippys;

    const PI: u32 = 54_321;

    /// A computer with a terminal of this mode that the service has made, and with klippy's user.
    fn with_terminal(mode: u32) -> (Tree, u32) {
        let tree = Tree::empty();
        tree.put_mode("dev/pts/3", "", mode);
        tree.link("run/pinion/klipper_host_mcu", "/dev/pts/3");
        tree.link("tmp/klipper_host_mcu", "/run/pinion/klipper_host_mcu");
        ["", "tmp", "run", "run/pinion", "dev/pts"].iter().for_each(|folder| tree.mode(folder, 0o755));
        let gid = fs::metadata(tree.computer().path("/dev/pts/3")).unwrap().gid();
        tree.put("etc/group", format!("tty:x:{gid}:\n"));
        tree.put("etc/passwd", format!("root:x:0:0::/root:/bin/sh\npi:x:{PI}:{PI}::/home/pi:/bin/sh\n"));
        (tree, gid)
    }

    fn looked(tree: &Tree) -> Vec<Finding> {
        let computer = tree.called_by(PI);
        terminals(&computer, &instances(&computer).0, &klippys(&computer))
    }

    const KLIPPY: [&str; 2] = ["/home/pi/klippy-env/bin/python", "/home/pi/klipper/klippy/klippy.py"];

    #[test]
    fn a_terminal_that_klippy_s_user_may_open_or_not() {
        let (tree, gid) = with_terminal(0o660);
        let findings = looked(&tree);
        says(&findings, "terminal", Ok, "leads to /dev/pts/3");
        says(&findings, "terminal", Ok, "klippy's user is unknown");
        tree.process(8, &KLIPPY, PI, &[gid]);
        says(&looked(&tree), "terminal", Ok, "for klippy's user pi (process 8)");
        tree.process(8, &KLIPPY, PI, &[]);
        // Advice about users is only for a service's klippy.
        let remedy = says(&looked(&tree), "terminal", Warning, "pi, klippy's user (process 8), may not open it");
        assert!(!remedy.contains("sudo"), "{remedy}");
        tree.put("proc/8/cgroup", "0::/system.slice/klipper.service\n");
        assert_eq!(
            says(&looked(&tree), "terminal", Error, "pi, klippy's user (process 8), may not open it"),
            "sudo usermod -aG tty pi && sudo systemctl restart klipper"
        );
        tree.put("etc/group", format!("tty:x:{gid}:other,pi\n"));
        assert!(says(&looked(&tree), "terminal", Error, "may not open").starts_with("sudo systemctl restart klipper"));
        tree.mode("dev/pts/3", 0o600);
        assert!(says(&looked(&tree), "terminal", Error, "may not open").starts_with("mode = "));
        tree.mode("run/pinion", 0o700);
        says(&looked(&tree), "terminal", Error, "may not enter /run/pinion");
    }

    #[test]
    fn nobody_is_made_a_member_of_root_s_group() {
        let (tree, gid) = with_terminal(0o660);
        tree.put("etc/group", format!("root:x:{gid}:\n"));
        tree.process(8, &KLIPPY, PI, &[]);
        tree.put("proc/8/cgroup", "0::/system.slice/klipper.service\n");
        let remedy = says(&looked(&tree), "terminal", Error, "may not open it");
        assert!(remedy.starts_with("mode = \"0660\" and group = \"tty\" in "), "{remedy}");
    }

    #[test]
    fn a_link_of_another_user_s_in_tmp() {
        let (tree, gid) = with_terminal(0o660);
        tree.process(8, &KLIPPY, PI, &[gid]);
        tree.mode("tmp", 0o1777);
        tree.put("proc/sys/fs/protected_symlinks", "1\n");
        // The link's owner is the folder's owner here, as for root's link in root's folder.
        says(&looked(&tree), "terminal", Ok, "for klippy's user pi");
        let tmp = 0o1777;
        assert!(is_protected(tmp, 0, 990, PI), "a link of Pinion's user");
        assert!(is_protected(tmp, 0, 990, 0), "root neither");
        assert!(!is_protected(tmp, 0, PI, PI) && !is_protected(tmp, 0, 0, PI) && !is_protected(0o755, 0, 990, PI));
    }

    #[test]
    fn a_link_that_is_none_or_leads_nowhere() {
        let tree = Tree::empty();
        says(&looked(&tree), "terminal", Ok, "because Pinion does not run");
        tree.process(10, &["/usr/bin/pinion", "run"], 0, &[]);
        says(&looked(&tree), "terminal", Error, "klippy opens /tmp/klipper_host_mcu, which does not exist");
        tree.link("tmp/klipper_host_mcu", "/run/pinion/klipper_host_mcu");
        says(&looked(&tree), "terminal", Error, "which does not exist");
        let tree = Tree::empty();
        tree.link("tmp/klipper_host_mcu", "klipper_host_mcu");
        says(&looked(&tree), "terminal", Warning, "which does not exist");
        let tree = Tree::empty();
        tree.put("tmp/klipper_host_mcu/file", "");
        let remedy = says(&looked(&tree), "terminal", Error, "/tmp/klipper_host_mcu is a folder");
        assert!(remedy.starts_with("sudo mv -T /tmp/klipper_host_mcu /tmp/klipper_host_mcu.old && "), "{remedy}");
        let tree = Tree::empty();
        tree.put("tmp/klipper_host_mcu", "FORCE_SHUTDOWN\n");
        let remedy = says(&looked(&tree), "terminal", Error, "exists but is not a symbolic link");
        assert!(remedy.starts_with("sudo rm /tmp/klipper_host_mcu"), "{remedy}");
    }

    /// Two printers, for the users pi and other. Each has a running klippy, a configuration and an instance.
    fn two_printers() -> (Tree, u32) {
        let (tree, gid) = with_terminal(0o660);
        tree.put_mode("dev/pts/4", "", 0o660);
        tree.link("run/pinion/klipper_host_b", "/dev/pts/4");
        tree.link("tmp/klipper_host_b", "/run/pinion/klipper_host_b");
        let users = format!("pi:x:{PI}:{PI}::/home/pi:/bin/sh\nother:x:{0}:{0}::/home/other:/bin/sh\n", PI + 1);
        tree.put("etc/passwd", &users);
        for (pid, name, unit) in [(11, "mcu", "pinion-mcu"), (12, "b", "pinion-mcu@b")] {
            let link = format!("/run/pinion/klipper_host_{name}");
            let config = format!("/etc/pinion/{name}.toml");
            tree.process(pid, &["/usr/bin/pinion", "run", "-r", "-I", &link, "--config", &config], 990, &[]);
            tree.put(&config[1..], "");
            tree.put(&format!("proc/{pid}/cgroup"), format!("0::/system.slice/{unit}.service\n"));
        }
        for (pid, user, unit, serial) in [(21, "pi", "klipper", "mcu"), (22, "other", "klipper-2", "b")] {
            let (script, config) =
                (format!("/home/{user}/klipper/klippy/klippy.py"), format!("/home/{user}/printer.cfg"));
            tree.put(&config[1..], format!("[mcu host]\nserial: /tmp/klipper_host_{serial}\n"));
            tree.process(pid, &["/usr/bin/python3", &script, &config], PI + pid - 21, &[gid]);
            tree.put(&format!("proc/{pid}/cgroup"), format!("0::/system.slice/{unit}.service\n"));
        }
        (tree, gid)
    }

    #[test]
    fn each_of_two_printers_klippys_is_judged_by_the_link_that_it_opens() {
        let (tree, gid) = two_printers();
        let findings = looked(&tree);
        assert_eq!(findings.len(), 2, "{findings:#?}");
        says(&findings, "terminal", Ok, "/tmp/klipper_host_mcu leads to /dev/pts/3");
        says(&findings, "terminal", Ok, "/dev/pts/4, which is");
        says(&findings, "terminal", Ok, "for klippy's user other (process 22)");
        // The second user is not in the group.
        tree.process(
            22,
            &["/usr/bin/python3", "/home/other/klipper/klippy/klippy.py", "/home/other/printer.cfg"],
            PI + 1,
            &[],
        );
        let findings = looked(&tree);
        says(&findings, "terminal", Ok, "for klippy's user pi (process 21)");
        let remedy = says(&findings, "terminal", Error, "other, klippy's user (process 22), may not open it");
        assert_eq!(remedy, "sudo usermod -aG tty other && sudo systemctl restart klipper-2");
        // The second instance's terminal is closed to its klippy.
        tree.mode("dev/pts/4", 0o600);
        tree.process(
            22,
            &["/usr/bin/python3", "/home/other/klipper/klippy/klippy.py", "/home/other/printer.cfg"],
            PI + 1,
            &[gid],
        );
        let remedy = says(&looked(&tree), "terminal", Error, "other, klippy's user");
        assert!(remedy.ends_with("in /etc/pinion/b.toml, then sudo systemctl restart pinion-mcu@b"), "{remedy}");
    }

    #[test]
    fn links_that_two_want_or_that_nobody_has() {
        let (tree, _) = two_printers();
        tree.put("home/other/printer.cfg", "[mcu]\nserial: /tmp/klipper_host_mcu\n");
        let findings = looked(&tree);
        says(
            &findings,
            "terminal",
            Error,
            "name /tmp/klipper_host_mcu (process 21, process 22), but only one klippy can open it",
        );
        assert!(
            says(&findings, "terminal", Ok, "no klippy's configuration names /tmp/klipper_host_b").contains("serial: ")
        );
        tree.put("home/other/printer.cfg", "[mcu]\nserial: /tmp/klipper_host_c\n");
        let remedy = says(&looked(&tree), "terminal", Error, "klippy's configuration names /tmp/klipper_host_c");
        assert!(remedy.starts_with("sudo systemctl enable --now pinion-mcu@c"), "{remedy}");
        tree.put("home/other/printer.cfg", "[mcu]\nserial: /run/pinion/klipper_host_b\n");
        let remedy = says(&looked(&tree), "terminal", Error, "names /run/pinion/klipper_host_b, which it takes");
        assert_eq!(remedy, "serial: /tmp/klipper_host_b");
        tree.put("home/other/printer.cfg", "[mcu]\nserial: /tmp/klipper_host_c\n");
        tree.put("proc/22/cgroup", "0::/user.slice/user-1000.slice/session-2.scope\n");
        assert!(!format!("{:?}", looked(&tree)).contains("klipper_host_c"), "a stranger's klippy");
        let script = "/home/other/klipper/klippy/klippy.py";
        tree.process(22, &["/usr/bin/python3", script, "/home/other/printer.cfg"], PI, &[]);
        let remedy = says(&looked(&tree), "terminal", Warning, "klippy's configuration names /tmp/klipper_host_c");
        assert!(!remedy.contains("sudo"), "{remedy}");
        tree.process(13, &["/usr/bin/pinion", "run", "-I", "/tmp/klipper_host_b"], 0, &[]);
        says(&looked(&tree), "terminal", Error, "process 13 is configured for the link /tmp/klipper_host_b, but");
    }
}
