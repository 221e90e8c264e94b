// SPDX-License-Identifier: GPL-3.0-or-later
//! The host: which klippy there is, whether its user can open the terminal, and whether its messages are
//! those that Pinion speaks.

#![forbid(unsafe_code)]

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::cli::finding::Finding;
use crate::cli::run::Settings;
use crate::feature::FEATURES;
use crate::klippy::Checkout;
use crate::mcu::DialectName;

use super::machine::{Access, Machine, Running, Who};
use super::service::UNIT_FOLDERS;

/// klippy takes a path for a pseudo terminal's only if it begins so (klippy/serialhdl.py).
const HOST_PATHS: &str = "/tmp/klipper_host_";
/// Where the service has its link for klippy, whatever it tells the program.
const HOST_PATH: &str = "/tmp/klipper_host_mcu";

/// A klippy, running or set up.
pub(super) struct Klippy {
    who: Who,
    /// klippy's folder, that of klippy.py.
    folder: Option<PathBuf>,
    /// How it was found.
    found_by: String,
    /// It has the groups of the time when it was started.
    is_running: bool,
}

/// Finds klippy by its process, or by its unit.
pub(super) fn klippy(machine: &Machine) -> Option<Klippy> {
    let process = machine.processes().into_iter().find(|process| process.is_klippy());
    if let Some(process) = process
        && let Some(who) = machine.user_of(process.pid)
    {
        return Some(Klippy {
            who,
            folder: process.klippy_folder(&machine.path("/proc")).map(|folder| reachable(machine, folder)),
            found_by: format!("process {}", process.pid),
            is_running: true,
        });
    }
    UNIT_FOLDERS.iter().find_map(|folder| {
        machine
            .names(folder)
            .into_iter()
            .filter(|name| name.starts_with("klipper") && name.ends_with(".service"))
            .find_map(|name| {
                let unit = machine.text(format!("{folder}/{name}"))?;
                let folder = program_folder(machine, &unit)?;
                let user = value(&unit, "User").unwrap_or("root");
                let who = machine.user(user).unwrap_or_else(|| match user {
                    "root" => Who { name: "root".into(), uid: 0, gids: vec![0] },
                    // Somebody of whom nothing is known.
                    _ => Who { name: user.to_owned(), uid: u32::MAX, gids: vec![] },
                });
                Some(Klippy { who, folder: Some(machine.path(folder)), found_by: name, is_running: false })
            })
    })
}

/// A folder as the process calls it, where this program finds it.
fn reachable(machine: &Machine, folder: PathBuf) -> PathBuf {
    if folder.starts_with(machine.path("/proc")) { folder } else { machine.path(folder) }
}

/// A setting of a unit.
fn value<'a>(unit: &'a str, key: &str) -> Option<&'a str> {
    let values = unit.lines().filter_map(|line| line.trim().strip_prefix(key)?.trim_start().strip_prefix('='));
    values.map(str::trim).rfind(|value| !value.is_empty())
}

/// The folder of klippy.py, from a unit's command or the file that has its arguments.
fn program_folder(machine: &Machine, unit: &str) -> Option<PathBuf> {
    let file = value(unit, "EnvironmentFile").map(|file| file.trim_start_matches('-'));
    let texts = [value(unit, "ExecStart").map(str::to_owned), file.and_then(|file| machine.text(file))];
    texts.into_iter().flatten().find_map(|text| {
        let words = text.split([' ', '\t', '\n', '"', '\'', '=']);
        let program = words.map(Path::new).find(|word| word.is_absolute() && word.ends_with("klippy.py"))?;
        Some(program.parent()?.to_owned())
    })
}

/// Whether klippy finds the terminal, and may open it.
pub(super) fn terminal(
    machine: &Machine,
    settings: &Settings,
    running: Option<&Running>,
    klippy: Option<&Klippy>,
) -> Vec<Finding> {
    const CHECK: &str = "terminal";
    const RESTART: &str = "sudo systemctl restart pinion-mcu";
    let path = match settings.symlink.to_string_lossy().starts_with(HOST_PATHS) {
        true => &settings.symlink,
        false => Path::new(HOST_PATH),
    };
    let shown = path.display();
    let Ok(link) = fs::symlink_metadata(machine.path(path)) else {
        return vec![match running {
            None => Finding::ok(CHECK, format!("{shown} is not there, as Pinion does not run")),
            Some(running) => Finding::error(
                CHECK,
                format!("there is no {shown}, which klippy opens, though Pinion runs (process {})", running.pid),
                format!("{RESTART}, or pinion run -I {shown}"),
            ),
        }];
    };
    if !link.file_type().is_symlink() {
        let found = format!("{shown} is a file that something else has written, and no link");
        return vec![Finding::error(CHECK, found, format!("sudo rm {shown} && {RESTART}"))];
    }
    let Ok(way) = machine.follow(path) else {
        let target = fs::read_link(machine.path(path)).unwrap_or_default();
        let found = format!("{shown} leads to {}, which is not there", target.display());
        return vec![match running {
            None => Finding::warning(CHECK, found, "sudo systemctl start pinion-mcu"),
            Some(_) => Finding::error(CHECK, found, RESTART),
        }];
    };
    let (device, about) = match way.last().map(|device| (machine.name(device), fs::metadata(device))) {
        Some((device, Ok(about))) => (device, about),
        _ => return vec![Finding::error(CHECK, format!("{shown} leads nowhere"), RESTART)],
    };
    let told = format!("{shown} leads to {}, which is {}", device.display(), machine.ownership(&about));
    let Some(Klippy { who, found_by, is_running, .. }) = klippy else {
        let unknown = "who klippy is, is unknown: none runs, and no unit starts one";
        return vec![Finding::ok(CHECK, told), Finding::ok(CHECK, unknown)];
    };
    let (name, told) = (&who.name, format!("{told}, for klippy's user {} ({found_by})", who.name));
    if let Some(owner) = link_is_refused(machine, path, &link, who) {
        let found = format!("the kernel lets {name} not follow {shown}, a link of {owner}'s (fs.protected_symlinks)");
        let remedy = format!("use the service, or run Pinion as {name}");
        return vec![Finding::error(CHECK, found, remedy)];
    }
    let closed = way.iter().filter_map(|path| path.parent()).find_map(|folder| {
        let about = fs::metadata(folder).ok()?;
        (!who.may(Access::SEARCH, &about)).then(|| (machine.name(folder), machine.ownership(&about)))
    });
    if let Some((folder, ownership)) = closed {
        let found = format!("{name} may not enter {}, which is {ownership}", folder.display());
        return vec![Finding::error(CHECK, found, format!("sudo chmod o+x {}", folder.display()))];
    }
    if who.may(Access::READ_WRITE, &about) {
        return vec![Finding::ok(CHECK, told)];
    }
    let group = machine.group_name(about.gid());
    let is_member = machine.user(name).is_some_and(|user| user.gids.contains(&about.gid()));
    let remedy = match () {
        () if !Access::READ_WRITE.is_given_to_group(&about) => {
            "mode = \"0660\" and group = \"tty\" in /etc/pinion/pinion.toml, then sudo systemctl restart pinion-mcu"
                .to_owned()
        }
        () if is_member && *is_running => {
            "sudo systemctl restart klipper, as the user was made a member after it was started".into()
        }
        () => format!("sudo usermod -aG {group} {name} && sudo systemctl restart klipper"),
    };
    vec![Finding::error(CHECK, format!("{name}, klippy's user ({found_by}), may not open it: {told}"), remedy)]
}

/// Whose link it is, should the kernel refuse to follow it.
fn link_is_refused(machine: &Machine, path: &Path, link: &fs::Metadata, who: &Who) -> Option<String> {
    let is_on = machine.text("/proc/sys/fs/protected_symlinks").is_some_and(|text| text == "1");
    let folder = fs::metadata(machine.path(path.parent()?)).ok()?;
    let refused = is_on && is_protected(folder.mode(), folder.uid(), link.uid(), who.uid);
    refused.then(|| machine.ownership(link).split(':').next().unwrap_or_default().to_owned())
}

/// Whether a link in a folder of this mode and owner is one that this user may not follow: in a folder that
/// all write to and that is sticky, only its owner may, unless it is the folder's owner's
/// (proc_sys_fs(5), `protected_symlinks`).
fn is_protected(folder_mode: u32, folder_uid: u32, link_uid: u32, uid: u32) -> bool {
    folder_mode & 0o1002 == 0o1002 && link_uid != uid && link_uid != folder_uid
}

/// Whether the host's messages are those that Pinion speaks.
pub(super) fn dialect(machine: &Machine, settings: &Settings, klippy: Option<&Klippy>) -> Vec<Finding> {
    const CHECK: &str = "dialect";
    let Some(Klippy { folder, found_by, .. }) = klippy else {
        let found = "which host comes is unknown: no klippy runs, and no unit starts one";
        return vec![Finding::ok(CHECK, found).or("pinion doctor --klipper DIR looks at a checkout")];
    };
    let Some(folder) = folder else {
        let found = format!("klippy's sources ({found_by}) are not known: its folder may not be looked into");
        return vec![Finding::warning(CHECK, found, "sudo pinion doctor")];
    };
    let shown = machine.name(folder);
    // /proc/PID/root is the process's own root.
    let own: PathBuf = shown.components().skip(4).collect();
    let shown = if shown.starts_with("/proc") { Path::new("/").join(own) } else { shown };
    let checkout = match Checkout::read(folder, FEATURES) {
        Ok(checkout) => checkout,
        Err(error) => {
            let found = format!("klippy's sources in {} ({found_by}) can not be read: {error}", shown.display());
            return vec![Finding::warning(CHECK, found, "sudo pinion doctor, or pinion doctor --klipper DIR")];
        }
    };
    let best = checkout.best();
    let commit = checkout.commit.as_ref().map_or(String::new(), |commit| format!(", commit {commit}"));
    let host = format!("the host is klippy of {}{commit} ({found_by})", shown.display());
    let mut findings = vec![match settings.dialect {
        None => Finding::ok(CHECK, format!("{host}: it is served in the dialect {}", best.generation)),
        Some(DialectName::Of(generation)) if generation == best.generation => {
            Finding::ok(CHECK, format!("{host}: dialect {generation}, as Pinion is told"))
        }
        Some(name) => Finding::warning(
            CHECK,
            format!("{host}: its dialect is {}, and Pinion is told to speak {name}", best.generation),
            "dialect = \"auto\" in /etc/pinion/pinion.toml, then sudo systemctl restart pinion-mcu",
        ),
    }];
    let unknown: Vec<&str> = checkout.unknown().map(|shape| shape.as_str()).collect();
    if !unknown.is_empty() {
        findings.push(Finding::error(
            CHECK,
            format!("the host is newer than Pinion, which does not know: {}", unknown.join("; ")),
            "sudo apt install --only-upgrade pinion-mcu",
        ));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Tree, told};
    use super::*;
    use crate::cli::finding::Level::{Error, Ok, Warning};
    use crate::cli::run::Given;
    use crate::mcu::Generation;

    const PI: u32 = 54_321;

    fn settings() -> Settings {
        Given { symlink: Some("/run/pinion/klipper_host_mcu".into()), ..Given::default() }.settings()
    }

    /// A machine with a terminal that the service has made, of this mode, and a user of klippy's.
    fn with_terminal(mode: u32) -> (Tree, u32) {
        let tree = Tree::new();
        tree.put_mode("dev/pts/3", "", mode);
        tree.link("run/pinion/klipper_host_mcu", "/dev/pts/3");
        tree.link("tmp/klipper_host_mcu", "/run/pinion/klipper_host_mcu");
        ["", "tmp", "run", "run/pinion", "dev/pts"].iter().for_each(|folder| tree.mode(folder, 0o755));
        let gid = fs::metadata(tree.machine().path("/dev/pts/3")).unwrap().gid();
        tree.put("etc/group", &format!("tty:x:{gid}:\n"));
        tree.put("etc/passwd", &format!("root:x:0:0::/root:/bin/sh\npi:x:{PI}:{PI}::/home/pi:/bin/sh\n"));
        (tree, gid)
    }

    fn looked(tree: &Tree) -> Vec<Finding> {
        let machine = tree.machine();
        terminal(&machine, &settings(), machine.running().as_ref(), klippy(&machine).as_ref())
    }

    const KLIPPY: [&str; 2] = ["/home/pi/klippy-env/bin/python", "/home/pi/klipper/klippy/klippy.py"];

    #[test]
    fn a_terminal_that_klippy_s_user_may_open_or_not() {
        let (tree, gid) = with_terminal(0o660);
        let findings = looked(&tree);
        told(&findings, "terminal", Ok, "leads to /dev/pts/3");
        told(&findings, "terminal", Ok, "who klippy is, is unknown");
        tree.process(8, &KLIPPY, PI, &[gid]);
        told(&looked(&tree), "terminal", Ok, "for klippy's user pi (process 8)");
        tree.process(8, &KLIPPY, PI, &[]);
        assert_eq!(
            told(&looked(&tree), "terminal", Error, "pi, klippy's user (process 8), may not open it"),
            "sudo usermod -aG tty pi && sudo systemctl restart klipper"
        );
        tree.put("etc/group", &format!("tty:x:{gid}:other,pi\n"));
        assert!(told(&looked(&tree), "terminal", Error, "may not open").starts_with("sudo systemctl restart klipper"));
        tree.mode("dev/pts/3", 0o600);
        assert!(told(&looked(&tree), "terminal", Error, "may not open").starts_with("mode = "));
        tree.mode("run/pinion", 0o700);
        told(&looked(&tree), "terminal", Error, "may not enter /run/pinion");
    }

    #[test]
    fn a_link_of_another_user_s_in_tmp() {
        let (tree, gid) = with_terminal(0o660);
        tree.process(8, &KLIPPY, PI, &[gid]);
        tree.mode("tmp", 0o1777);
        tree.put("proc/sys/fs/protected_symlinks", "1\n");
        // The link's owner is the folder's here: that is root's link in root's folder.
        told(&looked(&tree), "terminal", Ok, "for klippy's user pi");
        let tmp = 0o1777;
        assert!(is_protected(tmp, 0, 990, PI), "a link of Pinion's user");
        assert!(is_protected(tmp, 0, 990, 0), "root neither");
        assert!(!is_protected(tmp, 0, PI, PI) && !is_protected(tmp, 0, 0, PI) && !is_protected(0o755, 0, 990, PI));
    }

    #[test]
    fn a_link_that_is_none_or_leads_nowhere() {
        let tree = Tree::new();
        told(&looked(&tree), "terminal", Ok, "as Pinion does not run");
        tree.process(10, &["/usr/bin/pinion", "run"], 990, &[]);
        told(&looked(&tree), "terminal", Error, "there is no /tmp/klipper_host_mcu");
        tree.link("tmp/klipper_host_mcu", "/run/pinion/klipper_host_mcu");
        told(&looked(&tree), "terminal", Error, "which is not there");
        let tree = Tree::new();
        tree.link("tmp/klipper_host_mcu", "klipper_host_mcu");
        told(&looked(&tree), "terminal", Warning, "which is not there");
        let tree = Tree::new();
        tree.put("tmp/klipper_host_mcu", "FORCE_SHUTDOWN\n");
        let remedy = told(&looked(&tree), "terminal", Error, "no link");
        assert!(remedy.starts_with("sudo rm /tmp/klipper_host_mcu"), "{remedy}");
    }

    #[test]
    fn klippy_is_found_by_its_unit() {
        let tree = Tree::new();
        assert!(klippy(&tree.machine()).is_none());
        tree.put("etc/passwd", &format!("pi:x:{PI}:{PI}::/home/pi:/bin/sh\n"));
        tree.put("etc/systemd/system/klipper-mcu.service", "ExecStart=/usr/local/bin/klipper_mcu -r\n");
        let unit = "[Service]\nUser=pi\nEnvironmentFile=-/home/pi/klipper.env\nExecStart=/home/pi/env/bin/python $KLIPPER_ARGS\n";
        tree.put("etc/systemd/system/klipper.service", unit);
        assert!(klippy(&tree.machine()).is_none(), "no program is named");
        tree.put("home/pi/klipper.env", "KLIPPER_ARGS=\"/home/pi/klipper/klippy/klippy.py /home/pi/printer.cfg\"\n");
        let found = klippy(&tree.machine()).unwrap();
        assert_eq!((found.who.uid, found.found_by.as_str()), (PI, "klipper.service"));
        assert_eq!(found.folder.unwrap(), tree.machine().path("/home/pi/klipper/klippy"));
    }

    #[test]
    fn the_host_s_dialect() {
        let tree = Tree::new();
        let look = |settings: &Settings| dialect(&tree.machine(), settings, klippy(&tree.machine()).as_ref());
        told(&look(&settings()), "dialect", Ok, "which host comes is unknown");
        let command = "ExecStart=/usr/bin/python3 /home/pi/klipper/klippy/klippy.py /home/pi/printer.cfg\n";
        tree.put("lib/systemd/system/klipper.service", command);
        told(&look(&settings()), "dialect", Warning, "/home/pi/klipper/klippy (klipper.service) can not be read");
        let forms: Vec<String> = crate::klippy::tests::forms(Generation::V0_12)
            .iter()
            .map(|form| {
                let (name, parameters) = form.split_once(' ').unwrap();
                let parameters: Vec<String> = parameters.split(' ').map(|name| format!("{name}=%u")).collect();
                format!("mcu.lookup_command(\"{name} {}\")\n", parameters.join(" "))
            })
            .collect();
        tree.put("home/pi/klipper/klippy/mcu.py", &forms.concat());
        told(&look(&settings()), "dialect", Ok, "it is served in the dialect v0.12");
        let named = |name: &str| Given { dialect: Some(name.parse().unwrap()), ..Given::default() }.settings();
        told(&look(&named("v0.12")), "dialect", Ok, "as Pinion is told");
        told(&look(&named("kalico")), "dialect", Warning, "its dialect is v0.12, and Pinion is told to speak kalico");
        tree.put("home/pi/klipper/klippy/new.py", "mcu.lookup_command(\"query_adxl345 oid=%c wings=%u\")\n");
        told(&look(&settings()), "dialect", Error, "query_adxl345 oid wings");
    }
}
