// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run --check`: whether a configuration can be served on this computer. Nothing is changed: no link is made
//! and no output is touched. The hardware watchdog is not opened, because opening it would start it.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use nix::unistd::{AccessFlags, access, geteuid};

use pinion_firmware::mcu::{Dialect, DialectName};
use pinion_firmware::trouble::Trouble;
use pinion_linux::Inventory;
use pinion_linux::can;
use pinion_linux::clock::Monotonic;
use pinion_linux::foreign::word;
use pinion_linux::gpio::{Chip, FastGpio};
use pinion_linux::uart;
use pinion_runtime::FIRMWARE;
use pinion_runtime::klippy::{HOST_PATHS, is_host_path};
use pinion_runtime::realtime::{self, Processors};
use pinion_runtime::{CLOSED, CanbusUuid, LinkName, Place, TerminalGroup, can_open, can_uuid, stdio_can_use};

use super::board::open;
use super::quietly;
use super::report::{self, Group};
use super::simulator::Open;
use pinion_system::Computer;
use pinion_system::finding::{Finding, Level};
use pinion_system::manager::{SYSTEMCTL, watchdog_of_systemd};
use pinion_system::settings::{BoardName, Settings, WATCHDOG, WATCHDOG_REMEDY};

/// Checks, and prints the findings. `file` is the configuration file, which has been read.
pub(crate) fn run(settings: &Settings, file: Option<&Path>, simulated: Open) -> ExitCode {
    let mut findings = Vec::new();
    if let Some(file) = file {
        findings.push(Finding::ok("config", format!("{} can be read", file.display())));
    }
    findings.extend(board(settings, simulated));
    match &settings.link {
        LinkName::Pty(symlink) => {
            findings.push(link(symlink));
            findings.push(group(settings.access.group.as_deref()));
        }
        LinkName::Stdio => findings.push(match stdio_can_use() {
            Ok(()) => wire(&LinkName::Stdio),
            Err(trouble) => Finding::of("link", Level::Error, trouble),
        }),
        other => findings.push(wire(other)),
    }
    findings.extend(real_time(settings));
    if settings.watchdog {
        let taken = watchdog_of_systemd(&Computer::at(Path::new("/")), Some(Path::new(SYSTEMCTL)));
        findings.push(watchdog(Path::new(WATCHDOG), taken));
    }
    let groups = [Group::new("configuration", findings)];
    report::finish(&report::text(&groups), &groups)
}

/// Whether the board opens, its devices may be opened, and the dialect can be made from its pins.
fn board(settings: &Settings, simulated: Open) -> Vec<Finding> {
    let mut findings = Vec::new();
    if settings.board == BoardName::Linux {
        // The board would log these problems, and serve the rest.
        let Inventory { problems, chips, .. } = Inventory::scan();
        findings.extend(problems.into_iter().map(|problem| Finding::of("devices", Level::Error, problem)));
        findings.extend(fast_gpio(settings.fast_gpio, &chips));
    }
    // Its problems are among the findings already.
    let board = quietly(|| open(&settings.board, Arc::new(Monotonic::start()), simulated));
    let board = match board {
        Ok((board, _)) => board,
        Err(error) => {
            findings.push(Finding::of("board", Level::Error, error));
            return findings;
        }
    };
    findings.push(Finding::ok("board", format!("board {}", board.describe())));
    let name = settings.dialect.unwrap_or(DialectName::Union);
    findings.push(match Dialect::new(&FIRMWARE, &*board, name) {
        Ok(_) => match settings.dialect {
            Some(name) => Finding::ok("dialect", format!("dialect {name}")),
            None => Finding::ok("dialect", "messages of any host"),
        },
        Err(error) => Finding::error("dialect", format!("dialect {name}: {error}"), "choose another"),
    });
    findings
}

/// Whether the chips that never sleep have registers for fast lines. With `auto` only those that have some are listed.
fn fast_gpio(wish: FastGpio, chips: &[Chip]) -> Vec<Finding> {
    let native = chips.iter().filter(|chip| !chip.sleeps);
    let found = native.filter_map(|chip| match (wish, chip.registers(wish)) {
        (FastGpio::Off, _) | (FastGpio::Auto, Err(_)) => None,
        (_, Ok(registers)) => {
            let node = registers.node();
            let leds = if registers.is_posted() { "but not for LEDs" } else { "for LEDs too" };
            Some(Finding::ok("fast_gpio", format!("gpiochip{}: fast lines, through {node}, {leds}", chip.number)))
        }
        (_, Err(why)) => {
            Some(Finding::of("fast_gpio", Level::Warning, why.of(format_args!("gpiochip{}", chip.number))))
        }
    });
    found.collect()
}

/// Whether the way to a host on another computer is there. If it is not yet, Pinion waits for it.
pub(crate) fn wire(link: &LinkName) -> Finding {
    match link {
        LinkName::Serial(port, _) => {
            let path = port.display();
            if !port.exists() {
                let remedy = "plug it in, load its driver, or name another (pinion pins lists them)";
                return Finding::warning("link", format!("there is no {path}, so Pinion waits for it"), remedy);
            }
            if let Err(trouble) = uart::find_line(port) {
                Finding::of("link", Level::Error, trouble)
            } else if access(port.as_path(), AccessFlags::R_OK | AccessFlags::W_OK).is_err() {
                let remedy = "run Pinion as another user, or add this user to the port's group (ls -l /dev shows it)";
                Finding::error("link", format!("{path} may not be opened by this user"), remedy)
            } else {
                Finding::ok("link", format!("{link}: {path} is there"))
            }
        }
        LinkName::Can(interface, uuid) => can_bus(interface, *uuid),
        other => Finding::ok("link", other.to_string()),
    }
}

/// Whether a CAN interface is up, and what a host calls the node.
fn can_bus(interface: &str, uuid: Option<CanbusUuid>) -> Finding {
    let uuid = match can_open(interface).and_then(|()| uuid.map_or_else(can_uuid, Ok)) {
        Ok(uuid) => uuid,
        Err(trouble) => return Finding::of("link", Level::Error, trouble),
    };
    let up = format!("sudo ip link set {} up type can bitrate 1000000 restart-ms 100", word(interface));
    match can::interface(interface) {
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let remedy = "plug in its adapter, or load its overlay";
            Finding::warning("link", format!("there is no CAN interface {interface}, so Pinion waits for it"), remedy)
        }
        Err(error) => Finding::warning("link", format!("{interface}: {error}"), "look at ip -details link"),
        Ok(found) if !found.is_up => Finding::warning("link", format!("{interface} is down"), up),
        Ok(found) if found.is_off => {
            let remedy = format!("look at its wiring, its two resistors of 120 ohms and its bitrate, then {up}");
            Finding::warning("link", format!("{interface} is off the bus after too many errors"), remedy)
        }
        Ok(found) => {
            let rate = found.bitrate.map_or_else(String::new, |bitrate| format!(" at {bitrate} bit/s"));
            Finding::ok("link", format!("{interface} is up{rate}; printer.cfg: canbus_uuid: {uuid}"))
        }
    }
}

/// Whether the link can be put in place.
fn link(symlink: &Path) -> Finding {
    let path = symlink.display();
    let folder = match symlink.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let Ok(about_folder) = fs::metadata(folder) else {
        let remedy = format!("sudo mkdir {}, or choose another path (symlink)", word(folder.display()));
        return Finding::error("symlink", format!("{path}: there is no folder {}", folder.display()), remedy);
    };
    if access(folder, AccessFlags::W_OK | AccessFlags::X_OK).is_err() {
        let remedy = "run Pinion as another user, or choose another path (symlink)";
        return Finding::error("symlink", format!("{path}: this user may not write in {}", folder.display()), remedy);
    }
    // As a rule, this is the program that is about to be restarted.
    if let Some(served) = pinion_runtime::served(symlink)
        && !leads_to_ours(symlink)
    {
        return Finding::ok("symlink", format!("no second program can serve there: {served}"));
    }
    let place = Place::of(symlink);
    if let Some(obstacle) = place.obstacle(symlink) {
        let remedy = match place {
            Place::Folder => "choose another path, such as one in that folder (symlink)".to_owned(),
            _ => format!("sudo rm {}", word(&path)),
        };
        return Finding::error("symlink", obstacle, remedy);
    }
    if !is_host_path(symlink) && !is_linked(symlink) {
        let found = format!("{path}: klippy takes it for a serial port, because it does not begin with {HOST_PATHS}");
        return Finding::warning(
            "symlink",
            found,
            format!("-I {HOST_PATHS}NAME, or a link of that name that leads to it"),
        );
    }
    match fs::symlink_metadata(symlink) {
        Ok(_) if leads_to_ours(symlink) => {
            Finding::ok("symlink", format!("{path} is the service's link, which root puts in place for it"))
        }
        // In a folder such as /tmp, only the owners of a file and of the folder may replace the file.
        Ok(there) if about_folder.mode() & 0o1000 != 0 && !is_one_of(&[there.uid(), about_folder.uid()]) => {
            Finding::error("symlink", format!("{path} is another user's link"), format!("sudo rm {}", word(&path)))
        }
        Ok(_) => Finding::ok("symlink", format!("{path} is a link, which will be replaced")),
        Err(_) => Finding::ok("symlink", format!("{path} can be created")),
    }
}

/// Whether klippy may find this path by another link: the service makes one to its own link.
fn is_linked(symlink: &Path) -> bool {
    let links = Computer::at(Path::new("/")).matching(format!("{HOST_PATHS}*"));
    let is_service_s = symlink.starts_with("/run/pinion");
    is_service_s || links.iter().any(|link| fs::read_link(link).is_ok_and(|target| target == symlink))
}

/// Whether a link leads into a folder of this user, as the service has it. klippy could not follow this user's own link
/// in /tmp (systemd/link).
fn leads_to_ours(symlink: &Path) -> bool {
    let target = fs::read_link(symlink).ok();
    let folder = target.as_deref().and_then(Path::parent).and_then(|folder| fs::metadata(folder).ok());
    folder.is_some_and(|folder| folder.uid() == geteuid().as_raw() && !geteuid().is_root())
}

fn is_one_of(owners: &[u32]) -> bool {
    geteuid().is_root() || owners.contains(&geteuid().as_raw())
}

/// Whether the terminal may be given to the group.
fn group(name: Option<&str>) -> Finding {
    let trouble = match TerminalGroup::find(name) {
        Ok(group) if group.is_ours() => return Finding::ok("group", format!("the terminal goes to the group {group}")),
        Ok(group) => group.refusal("this user is not a member"),
        Err(missing) => missing,
    };
    match name {
        Some(_) => Finding::of("group", Level::Error, trouble),
        // The program then continues with the user's own group.
        None => Finding::of("group", Level::Warning, trouble.of(CLOSED)),
    }
}

/// Whether the processor is there. If real time is asked for, whether it is permitted.
fn real_time(settings: &Settings) -> Vec<Finding> {
    let mut findings = Vec::new();
    match (settings.cpu, Processors::new(settings.cpu)) {
        (Some(cpu), Ok(_)) => findings.push(Finding::ok("cpu", format!("the core stays on processor {cpu}"))),
        (None, Ok(_)) => {}
        (_, Err(trouble)) => findings.push(Finding::of("cpu", Level::Error, trouble)),
    }
    if settings.realtime {
        findings.push(match realtime::is_permitted() {
            Ok(()) => Finding::ok("realtime", "real time is permitted"),
            Err(why) => {
                Finding::of("realtime", Level::Warning, why.of("no real-time scheduling, so steps may be late"))
            }
        });
    }
    findings
}

/// Whether the watchdog is there and may be opened. `taken`: why systemd has it.
fn watchdog(device: &Path, taken: Option<Trouble>) -> Finding {
    let path = device.display();
    if !device.exists() {
        return Finding::error("watchdog", format!("there is no {path}"), WATCHDOG_REMEDY);
    }
    if let Some(taken) = taken {
        return Finding::of("watchdog", Level::Error, taken);
    }
    match access(device, AccessFlags::W_OK) {
        Ok(()) => Finding::ok("watchdog", format!("{path} is there")),
        Err(_) => Finding::error(
            "watchdog",
            format!("{path} may not be opened by this user"),
            "sudo udevadm trigger --subsystem-match=misc --action=add, or run Pinion as its service does",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::unistd::getegid;

    #[test]
    fn a_link_can_be_made_where_nothing_else_stands() {
        let own = Path::new("/tmp").join(format!("klipper_host_check{}", std::process::id()));
        assert_eq!(link(&own).status, Level::Ok);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tty");
        // klippy would not find it, unless a link of the right name leads there.
        let warned = link(&path);
        assert_eq!(warned.status, Level::Warning);
        assert!(warned.trouble.cause.ends_with("it does not begin with /tmp/klipper_host_"), "{warned:?}");
        std::os::unix::fs::symlink(&path, &own).unwrap();
        assert_eq!(link(&path).status, Level::Ok);
        std::os::unix::fs::symlink("/dev/pts/99", &path).unwrap();
        assert!(link(&path).trouble.cause.ends_with("is a link, which will be replaced"));
        fs::remove_file(&own).unwrap();
        fs::remove_file(&path).unwrap();
        fs::write(&path, "").unwrap();
        let refused = link(&path);
        assert_eq!(refused.status, Level::Error);
        assert_eq!(refused.trouble.remedy.as_deref(), Some(&*format!("sudo rm {}", path.display())));
        let refused = link(folder.path());
        assert!(
            refused.trouble.remedy.as_ref().is_some_and(|remedy| remedy.starts_with("choose another path")),
            "{refused:?}"
        );
        let refused = link(&folder.path().join("none/tty"));
        assert!(refused.status == Level::Error && refused.trouble.cause.contains("there is no folder"), "{refused:?}");
    }

    #[test]
    fn a_wire_that_is_not_there_yet_is_a_warning() {
        let finding = |link: &str| wire(&link.parse().unwrap());
        let port = finding("serial:/dev/none");
        assert!(port.status == Level::Warning && port.trouble.cause.contains("there is no /dev/none"), "{port:?}");
        let bus = finding("can:none,0123456789ab");
        match can_open("none") {
            Ok(()) => assert!(bus.trouble.cause.contains("there is no CAN interface none"), "{bus:?}"),
            // This kernel has no CAN.
            Err(trouble) => assert_eq!((bus.status, bus.trouble), (Level::Error, trouble)),
        }
        assert_eq!(finding("stdio").status, Level::Ok);
    }

    #[test]
    fn groups_and_watchdogs_that_are_not_there() {
        assert_eq!(group(Some("no_such_group")).status, Level::Error);
        assert_eq!(group(Some(&getegid().to_string())).status, Level::Ok);
        let folder = tempfile::tempdir().unwrap();
        let device = folder.path().join("watchdog");
        assert_eq!(watchdog(&device, None).status, Level::Error);
        fs::write(&device, "").unwrap();
        assert_eq!(watchdog(&device, None).status, Level::Ok);
        assert_eq!(watchdog(&device, Some(Trouble::new("systemd has it"))).status, Level::Error);
    }
}
