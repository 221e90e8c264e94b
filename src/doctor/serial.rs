// SPDX-License-Identifier: GPL-3.0-or-later
//! Serial ports for the UARTs of stepper drivers: whether they are there, and who else uses them.

use std::collections::BTreeSet;

use pinion_runtime::klippy::process::Process;
use pinion_system::board::{append, is_pi, is_pi5, pi_config};
use pinion_system::device::Port;
use pinion_system::finding::Finding;
use pinion_system::{Computer, units};

const CHECK: &str = "serial";
/// Programs that set up a Bluetooth chip on a serial port.
const BLUETOOTH: [&str; 2] = ["hciattach", "btattach"];
/// Programs that offer a login.
const LOGIN: [&str; 3] = ["agetty", "getty", "login"];

/// Judges the ports that klippy's configuration names.
pub(super) fn ports(computer: &Computer, names: &BTreeSet<String>) -> Vec<Finding> {
    names.iter().flat_map(|name| port(computer, name)).collect()
}

/// A port, by its name in /dev.
fn port(computer: &Computer, named: &str) -> Vec<Finding> {
    let node = format!("/dev/{named}");
    let name = &match computer.port(named) {
        Port::There(name) => name,
        Port::Missing => {
            let found = format!("TMC UART: there is no {node}");
            return vec![Finding::error(CHECK, found, missing(computer, named))];
        }
        Port::Other => {
            let found = format!("TMC UART: {named} is not a serial port");
            return vec![Finding::error(CHECK, found, "another uart_pin in printer.cfg (pinion pins lists the ports)")];
        }
    };
    let mut findings = Vec::new();
    let is_port = |word: &str| word.rsplit('/').next().is_some_and(|word| word == name || word == named);
    if console(computer, name, named) {
        let found = format!("TMC UART: the kernel writes its messages to {node}");
        let remedy = match is_pi(computer) {
            true => "sudo raspi-config nonint do_serial_cons 1, and reboot".to_owned(),
            false => format!("remove console={name} from the kernel's command line, and reboot"),
        };
        findings.push(Finding::error(CHECK, found, remedy));
    }
    let getty = format!("serial-getty@{name}");
    let mut login = units::enabled(computer, |unit| unit == getty).first().map(|_| format!("{getty}.service"));
    let program = |process: &Process| {
        let program = process.program().unwrap_or_default().to_string_lossy();
        program.trim_start_matches('-').to_owned()
    };
    let uses_it = |process: &Process| {
        let is_known = LOGIN.iter().chain(&BLUETOOTH).any(|known| *known == program(process));
        is_known && process.arguments.iter().skip(1).any(|word| is_port(&word.to_string_lossy()))
    };
    for (process, _) in computer.processes(uses_it) {
        let program = program(&process);
        if LOGIN.contains(&&*program) {
            login = Some(format!("{program} (process {})", process.pid));
            continue;
        }
        let found = format!("TMC UART: {node} is the port of Bluetooth: {program} (process {})", process.pid);
        let remedy = match is_pi(computer) {
            true => no_bluetooth(computer),
            false => format!("end process {}, or choose another port", process.pid),
        };
        findings.push(Finding::error(CHECK, found, remedy));
    }
    // serial0 often leads to one of these.
    if is_pi5(computer) && name == "ttyAMA10" {
        let found = format!("TMC UART: {node} is the connector for debugging, not pins 8 and 10 of the header");
        findings.push(Finding::warning(CHECK, found, header_of_pi5(computer) + ", and uart_pin: host:ttyAMA0"));
    } else if is_pi(computer) && name == "ttyS0" {
        let found =
            format!("TMC UART: {node} is the mini-UART, whose rate follows the clock of the graphics processor");
        findings.push(Finding::warning(CHECK, found, no_bluetooth(computer) + ", and uart_pin: host:ttyAMA0"));
    }
    if let Some(login) = login {
        let found = format!("TMC UART: {node} offers a login, which takes the drivers' answers: {login}");
        findings.push(Finding::error(CHECK, found, format!("sudo systemctl disable --now {getty}.service")));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(CHECK, format!("TMC UART: {node}")));
    }
    findings
}

/// Whether the kernel writes its messages to a port, now or after the next boot.
fn console(computer: &Computer, name: &str, named: &str) -> bool {
    let active = computer.text("/sys/class/tty/console/active").unwrap_or_default();
    // The firmware of a Raspberry Pi replaces serial0 by the port's name.
    let lines = ["/boot/firmware/cmdline.txt", "/boot/cmdline.txt"].iter().filter_map(|file| computer.text(file));
    let words = lines.flat_map(|line| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>());
    let mut named_there = words.filter_map(|word| Some(word.strip_prefix("console=")?.split(',').next()?.to_owned()));
    active.split_whitespace().any(|console| console == name) || named_there.any(|port| port == name || port == named)
}

fn missing(computer: &Computer, named: &str) -> String {
    // A Bluetooth chip that the device tree describes takes its port away: there is no terminal then.
    let is_taken = !computer.matching("/sys/bus/serial/devices/serial*-*").is_empty();
    match is_pi(computer) {
        true if is_pi5(computer) && ["ttyAMA0", "serial0"].contains(&named) => header_of_pi5(computer),
        true if is_taken && ["ttyAMA0", "serial0", "serial1"].contains(&named) => no_bluetooth(computer),
        true => {
            let config = pi_config(computer).unwrap_or("config.txt");
            format!(
                "add the overlay of a UART to {config} (/usr/share/doc/pinion-mcu/guide/pins.md lists them), and reboot"
            )
        }
        false => "plug its adapter in, or enable it in the device tree (pinion pins lists the ports)".to_owned(),
    }
}

/// How a Raspberry Pi 5 gets the port of pins 8 and 10.
fn header_of_pi5(computer: &Computer) -> String {
    format!("{}, reboot", append(computer, "dtoverlay=uart0-pi5"))
}

fn no_bluetooth(computer: &Computer) -> String {
    format!(
        "choose another UART, or do without Bluetooth: {} && sudo systemctl disable hciuart, and reboot",
        append(computer, "dtoverlay=disable-bt")
    )
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok as Fine, Warning};

    fn judged(tree: &Tree, name: &str) -> Vec<Finding> {
        ports(&tree.computer(), &[name.to_owned()].into())
    }

    fn tree(pi: bool) -> Tree {
        let tree = Tree::empty();
        tree.put("dev/ttyAMA0", "");
        tree.put("dev/ttyAMA1", "");
        tree.link("dev/serial0", "ttyAMA0");
        if pi {
            tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
            tree.put("boot/firmware/config.txt", "");
        }
        tree
    }

    #[test]
    fn a_free_port_is_fine_and_a_missing_one_is_not() {
        let tree = tree(true);
        for name in ["ttyAMA1", "serial0"] {
            says(&judged(&tree, name), "serial", Fine, &format!("/dev/{name}"));
        }
        assert!(says(&judged(&tree, "ttyAMA2"), "serial", Error, "there is no /dev/ttyAMA2").contains("overlay"));
        // The chip for Bluetooth has it.
        tree.put("sys/bus/serial/devices/serial0-0/uevent", "");
        assert!(says(&judged(&tree, "serial1"), "serial", Error, "there is no").contains("disable-bt"));
        assert!(says(&judged(&self::tree(false), "ttyUSB0"), "serial", Error, "there is no").contains("adapter"));
        assert!(ports(&tree.computer(), &BTreeSet::new()).is_empty(), "nothing is said of what is not used");
    }

    #[test]
    fn serial0_is_not_always_the_good_port_of_the_header() {
        let tree = Tree::empty();
        tree.put("boot/firmware/config.txt", "");
        tree.put("dev/ttyAMA10", "");
        tree.link("dev/serial0", "ttyAMA10");
        for model in
            ["Raspberry Pi 5 Model B Rev 1.0", "Raspberry Pi Compute Module 5 Rev 1.0", "Raspberry Pi 500 Rev 1.0"]
        {
            tree.put("proc/device-tree/model", model);
            let remedy =
                says(&judged(&tree, "serial0"), "serial", Warning, "/dev/serial0 is the connector for debugging");
            assert!(remedy.contains("dtoverlay=uart0-pi5") && remedy.ends_with("uart_pin: host:ttyAMA0"), "{remedy}");
            assert!(says(&judged(&tree, "ttyAMA0"), "serial", Error, "there is no").contains("dtoverlay=uart0-pi5"));
        }
        tree.put("dev/ttyAMA0", "");
        says(&judged(&tree, "ttyAMA0"), "serial", Fine, "/dev/ttyAMA0");
        let tree = self::tree(true);
        tree.put("dev/ttyS0", "");
        let remedy = says(&judged(&tree, "ttyS0"), "serial", Warning, "/dev/ttyS0 is the mini-UART");
        assert!(remedy.contains("dtoverlay=disable-bt") && remedy.ends_with("uart_pin: host:ttyAMA0"), "{remedy}");
        let pc = self::tree(false);
        pc.put("dev/ttyS0", "");
        says(&judged(&pc, "ttyS0"), "serial", Fine, "/dev/ttyS0");
    }

    #[test]
    fn a_console_takes_a_port() {
        for name in ["ttyAMA0", "serial0"] {
            let tree = tree(true);
            tree.put("boot/firmware/cmdline.txt", "console=serial0,115200 console=tty1 root=/dev/mmcblk0p2\n");
            assert_eq!(judged(&tree, name).len(), 1);
            // The firmware has replaced it for the running kernel.
            tree.put("sys/class/tty/console/active", "tty1 ttyAMA0\n");
            let remedy = says(&judged(&tree, name), "serial", Error, "the kernel writes its messages to");
            assert!(remedy.contains("do_serial_cons 1"), "{remedy}");
        }
        let tree = tree(false);
        tree.put("sys/class/tty/console/active", "ttyAMA1\n");
        let remedy = says(&judged(&tree, "ttyAMA1"), "serial", Error, "the kernel writes");
        assert!(remedy.contains("console=ttyAMA1"), "{remedy}");
        says(&judged(&tree, "ttyAMA0"), "serial", Fine, "ttyAMA0");
    }

    #[test]
    fn a_login_takes_the_answers() {
        let tree = tree(true);
        let remedy = "sudo systemctl disable --now serial-getty@ttyAMA0.service";
        tree.put("lib/systemd/system/serial-getty@.service", "");
        let wants = "etc/systemd/system/getty.target.wants/serial-getty@ttyAMA0.service";
        tree.link(wants, "/lib/systemd/system/serial-getty@.service");
        assert_eq!(says(&judged(&tree, "serial0"), "serial", Error, "serial-getty@ttyAMA0.service"), remedy);
        std::fs::remove_file(tree.computer().path(format!("/{wants}"))).unwrap();
        tree.process(30, &["/sbin/agetty", "--noreset", "115200", "ttyAMA0", "vt220"], 0, &[]);
        assert_eq!(says(&judged(&tree, "serial0"), "serial", Error, "agetty (process 30)"), remedy);
        says(&judged(&tree, "ttyAMA1"), "serial", Fine, "ttyAMA1");
    }

    #[test]
    fn bluetooth_takes_a_port() {
        let tree = tree(true);
        tree.process(31, &["/usr/bin/hciattach", "/dev/ttyAMA0", "bcm43xx", "921600"], 0, &[]);
        let remedy = says(&judged(&tree, "ttyAMA0"), "serial", Error, "the port of Bluetooth: hciattach");
        assert!(remedy.contains("dtoverlay=disable-bt") && remedy.contains("hciuart"), "{remedy}");
    }
}
