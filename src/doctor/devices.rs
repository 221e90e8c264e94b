// SPDX-License-Identifier: GPL-3.0-or-later
//! Pins and buses: whether they are there, and whether Pinion may open them.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

use pinion_linux::foreign::word;
use pinion_linux::gpio::{FastGpio, LINK_REMEDY, never_sleeps};
use pinion_system::board::{append, is_pi, pi_config};
use pinion_system::device::Port;
use pinion_system::finding::Finding;
use pinion_system::settings::BoardName;
use pinion_system::uses::boot::ConfigTxt;
use pinion_system::{Access, Computer, Who};

use super::{INSTALL, REINSTALL};
use pinion_system::instance::Instance;

/// A kind of devices.
pub(super) struct Class {
    check: &'static str,
    name: &'static str,
    pub(super) access: Access,
    /// udev's subsystem.
    subsystem: &'static str,
    /// The line of a Raspberry Pi's config.txt that enables it, and how the overlays and parameters that do so begin.
    enabled_by: Option<(&'static str, &'static str)>,
    /// The files that Pinion has to open.
    pub(super) nodes: &'static str,
}

impl Class {
    const fn new(
        (check, name): (&'static str, &'static str),
        access: Access,
        subsystem: &'static str,
        nodes: &'static str,
        enabled_by: Option<(&'static str, &'static str)>,
    ) -> Class {
        Class { check, name, access, subsystem, enabled_by, nodes }
    }
}

const ADC: &str = "/sys/bus/iio/devices/iio:device*/in_voltage*_raw";
const PWM: &str = "/sys/class/pwm/pwmchip*/export";
const W1: &str = "/sys/bus/w1/devices/28-*/w1_slave";

const CLASSES: [Class; 6] = [
    Class::new(("gpio", "GPIO"), Access::READ_WRITE, "gpio", "/dev/gpiochip*", None),
    Class::new(("adc", "ADC"), Access::READ, "iio", ADC, None),
    Class::new(("pwm", "PWM"), Access::WRITE, "pwm", PWM, Some(("dtoverlay=pwm-2chan", "pwm"))),
    Class::new(("spi", "SPI"), Access::READ_WRITE, "spidev", "/dev/spidev*", Some(("dtparam=spi=on", "spi"))),
    Class::new(("i2c", "I2C"), Access::READ_WRITE, "i2c-dev", "/dev/i2c-*", Some(("dtparam=i2c_arm=on", "i2c"))),
    Class::new(("w1", "1-Wire"), Access::READ, "w1", W1, Some(("dtoverlay=w1-gpio", "w1-gpio"))),
];
/// The registers of GPIO chips.
pub(super) const FAST: Class =
    Class::new(("fast_gpio", "fast lines"), Access::READ_WRITE, "*gpiomem*", "/dev/gpiomem*", None);
const SERIAL: Class = Class::new(("serial", "serial port"), Access::READ_WRITE, "tty", "/dev", None);
const WATCHDOG: Class = Class::new(("watchdog", "watchdog"), Access::WRITE, "misc", "/dev/watchdog", None);

/// The kernel's policy for the sleep of PCIe links.
const ASPM_POLICY: &str = "/sys/module/pcie_aspm/parameters/policy";

/// Whether the users that Pinion runs as may open the devices, and these serial ports. Without a service it judges the
/// caller.
pub(super) fn permissions(computer: &Computer, instances: &[Instance], ports: &BTreeSet<String>) -> Vec<Finding> {
    let on_pins = instances.iter().filter(|instance| instance.settings.board == BoardName::Linux);
    let mut users: Vec<(Who, Vec<&Instance>)> = Vec::new();
    for (who, instance) in on_pins.filter_map(|instance| Some((instance.user(computer)?, instance))) {
        match users.iter_mut().find(|(user, _)| *user == who) {
            Some((_, instances)) => instances.push(instance),
            None => users.push((who, vec![instance])),
        }
    }
    if users.is_empty() {
        users.extend(computer.caller().map(|caller| (caller, Vec::new())));
    }
    if users.is_empty() {
        let found = "there is no user pinion: the service is not installed, so what it may open is unknown";
        return vec![Finding::warning("user", found, INSTALL)];
    }
    users.iter().flat_map(|(user, instances)| permissions_of(computer, instances, user, ports)).collect()
}

/// Whether `user` may open the devices. These instances run as `user`.
fn permissions_of(computer: &Computer, instances: &[&Instance], user: &Who, ports: &BTreeSet<String>) -> Vec<Finding> {
    let units: Vec<&str> = instances.iter().filter_map(|instance| instance.unit.as_deref()).collect();
    let anew = match &units[..] {
        [] => "log in again, then restart Pinion".to_owned(),
        units => format!("sudo systemctl restart {}", units.iter().map(word).collect::<Vec<_>>().join(" ")),
    };
    let permission = |class: &Class| permission(computer, user, &anew, class, &computer.matching(class.nodes));
    let mut findings: Vec<Finding> = CLASSES.iter().filter_map(permission).collect();
    let there = ports.iter().filter_map(|name| match computer.port(name) {
        Port::There(port) => Some(computer.path(format!("/dev/{port}"))),
        Port::Missing | Port::Other => None,
    });
    let ports: Vec<PathBuf> = there.collect();
    findings.extend(self::permission(computer, user, &anew, &SERIAL, &ports));
    if instances.iter().any(|instance| instance.settings.watchdog) {
        findings.extend(permission(&WATCHDOG));
    }
    let wants = |wish| instances.iter().any(|instance| instance.settings.fast_gpio == wish);
    if wants(FastGpio::On) {
        findings.push(permission(&FAST).unwrap_or_else(|| {
            let found = "fast lines: fast_gpio is on, but there is no /dev/gpiomem: lines go through the kernel";
            let remedy = "only Raspberry Pi's own kernel has this node: install it, or set fast_gpio to auto";
            Finding::warning("fast_gpio", found, remedy)
        }));
        if is_rp1(computer) && !never_sleeps(&computer.path(ASPM_POLICY)) {
            let found = "fast lines: the PCIe link of the RP1 may sleep: lines go through the kernel";
            findings.push(Finding::warning("fast_gpio", found, LINK_REMEDY));
        }
    }
    if wants(FastGpio::DevMem) && user.uid != 0 {
        let found = format!("fast lines: {} may not open /dev/mem: lines go through the kernel", user.name);
        findings.push(Finding::warning("fast_gpio", found, "set fast_gpio to on, or run Pinion as root"));
    }
    findings
}

/// `None` if there is nothing to open. `anew` is the remedy that makes the user's new groups count.
fn permission(computer: &Computer, user: &Who, anew: &str, class: &Class, nodes: &[PathBuf]) -> Option<Finding> {
    // A node that vanishes before it is read does not count.
    let nodes: Vec<_> = nodes.iter().filter_map(|node| Some((node, fs::metadata(node).ok()?))).collect();
    let refused: Vec<_> = nodes.iter().filter(|(_, about)| !user.may(class.access, about)).collect();
    let (name, who) = (class.name, &user.name);
    let Some((node, about)) = refused.first() else {
        let first = computer.name(nodes.first()?.0);
        return Some(Finding::ok(class.check, format!("{name}: {who} may open {}", with_others(&first, nodes.len()))));
    };
    let found = format!(
        "{name}: {who} may not open {}, which is {} ({} of {} refused)",
        computer.name(node).display(),
        computer.ownership(about),
        refused.len(),
        nodes.len()
    );
    let group = computer.common_group(about).filter(|_| class.access.is_given_to_group(about));
    let remedy = if let Some(group) = group {
        format!("sudo usermod -aG {} {}, then {anew}", word(group), word(who))
    } else if rules_are_there(computer) {
        format!(
            "sudo udevadm control --reload && sudo udevadm trigger --action=add --subsystem-match={}",
            class.subsystem
        )
    } else {
        format!("install the udev rules: {REINSTALL}")
    };
    Some(Finding::error(class.check, found, remedy))
}

/// The first path, and how many more there are.
fn with_others(first: &Path, count: usize) -> String {
    let more = if count > 1 { format!(" and {} more", count - 1) } else { String::new() };
    format!("{}{more}", first.display())
}

fn rules_are_there(computer: &Computer) -> bool {
    let folders = ["/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d"];
    folders.iter().any(|folder| !computer.matching(format!("{folder}/*pinion-mcu.rules")).is_empty())
}

/// Which pins and buses there are, and how to enable the missing ones.
pub(super) fn presence(computer: &Computer, config_txt: &ConfigTxt) -> Vec<Finding> {
    CLASSES.iter().map(|class| present(computer, config_txt, class)).collect()
}

fn present(computer: &Computer, config_txt: &ConfigTxt, class: &Class) -> Finding {
    let Class { check, name, .. } = *class;
    let nodes = computer.matching(class.nodes);
    if let Some((node, other)) = nodes.iter().find_map(|node| Some((node, other_subsystem(computer, class, node)?))) {
        let node = computer.name(node);
        let (shown, subsystem) = (node.display(), class.subsystem);
        let found = format!("{name}: {shown} is not a {subsystem} device, but one of {other}");
        let remedy =
            format!("sudo rm {} && sudo udevadm trigger --action=add --subsystem-match={subsystem}", word(shown));
        return Finding::error(check, found, remedy);
    }
    if let Some(first) = nodes.first() {
        return Finding::ok(check, format!("{name}: {}", with_others(&computer.name(first), nodes.len())));
    }
    if check == "gpio" {
        let remedy = "connect an I/O board that the kernel knows, or try pinion run --board sim";
        return Finding::warning(check, "GPIO: this computer has no GPIO chip", remedy);
    }
    if check == "i2c" && !computer.matching("/sys/bus/i2c/devices/i2c-*").is_empty() {
        let remedy = "echo i2c-dev | sudo tee /etc/modules-load.d/i2c-dev.conf && sudo modprobe i2c-dev";
        return Finding::warning(check, "I2C: there are buses, but no /dev/i2c-*: i2c-dev is not loaded", remedy);
    }
    let off = format!("{name}: none");
    let Some((line, beginning)) = class.enabled_by else {
        return Finding::ok(check, off).or("if there is one, load its driver (a device tree overlay, as a rule)");
    };
    let Some(config) = is_pi(computer).then(|| pi_config(computer)).flatten() else {
        return Finding::ok(check, off).or("if it is wanted, enable it in the device tree, and reboot");
    };
    match config_txt.enables(beginning) {
        true if check == "w1" => Finding::warning(
            check,
            "1-Wire: on, but no DS18B20 answers",
            "check its wires and the pull-up resistor (4.7 kOhm)",
        ),
        true => Finding::warning(check, format!("{name}: on in {config}, but not there"), "sudo reboot"),
        false => Finding::ok(check, format!("{name}: off"))
            .or(format!("if it is wanted: {}, and reboot", append(computer, line))),
    }
}

/// The subsystem of a node in /dev that is another device than its name says, such as a null device.
fn other_subsystem(computer: &Computer, class: &Class, node: &Path) -> Option<String> {
    let about = fs::metadata(node).ok().filter(|about| about.file_type().is_char_device())?;
    // If it is unknown, the node counts as right.
    let subsystem = computer.subsystem(&about)?;
    (subsystem != class.subsystem).then_some(subsystem)
}

/// Whether the GPIO chip is a Raspberry Pi 5's: its registers have a node with a number.
pub(super) fn is_rp1(computer: &Computer) -> bool {
    computer.path("/dev/gpiomem0").exists()
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::boards;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok as Fine, Warning};
    use pinion_system::instance::instances;
    use std::os::unix::fs::MetadataExt;

    fn permitted(tree: &Tree, user: &Who) -> Vec<Finding> {
        let instances = instances(&tree.computer()).0;
        permissions_of(&tree.computer(), &instances.iter().collect::<Vec<_>>(), user, &["ttyAMA1".to_owned()].into())
    }

    fn present(tree: &Tree) -> Vec<Finding> {
        presence(&tree.computer(), &ConfigTxt::read(&tree.computer(), None))
    }

    /// A user other than root and other than the one that runs the tests.
    fn stranger(gids: Vec<u32>) -> Who {
        Who { name: "pinion".into(), uid: 54_321, gids }
    }

    const NODES: [(&str, &str); 9] = [
        ("gpio", "dev/gpiochip0"),
        ("adc", "sys/bus/iio/devices/iio:device0/in_voltage3_raw"),
        ("pwm", "sys/class/pwm/pwmchip0/export"),
        ("spi", "dev/spidev0.0"),
        ("i2c", "dev/i2c-1"),
        ("w1", "sys/bus/w1/devices/28-01/w1_slave"),
        ("serial", "dev/ttyAMA1"),
        ("watchdog", "dev/watchdog"),
        ("fast_gpio", "dev/gpiomem"),
    ];

    #[test]
    fn devices_that_the_group_has_may_be_opened_by_its_members() {
        let tree = Tree::empty();
        NODES.iter().for_each(|(_, path)| tree.put_mode(path, "", 0o660));
        let gid = fs::metadata(tree.computer().path("/dev/gpiochip0")).unwrap().gid();
        tree.put("etc/group", format!("gpio:x:{gid}:\n"));
        tree.put("etc/pinion/pinion.toml", "watchdog = true\nfast_gpio = \"on\"\n");
        let findings = permitted(&tree, &stranger(vec![gid]));
        assert_eq!(findings.len(), NODES.len());
        NODES.iter().for_each(|(check, _)| drop(says(&findings, check, Fine, "pinion may open /")));
        let findings = permitted(&tree, &stranger(vec![gid + 1]));
        for (check, path) in NODES {
            let remedy = says(&findings, check, Error, &format!("pinion may not open /{path}, which is "));
            assert_eq!(remedy, "sudo usermod -aG gpio pinion, then sudo systemctl restart pinion-mcu");
        }
    }

    #[test]
    fn fast_lines_that_were_asked_for_and_cannot_be_had() {
        let tree = Tree::empty();
        let wish = |wish: &str| {
            tree.put("etc/pinion/pinion.toml", format!("fast_gpio = \"{wish}\"\n"));
            permitted(&tree, &stranger(vec![]))
        };
        let remedy = says(&wish("on"), "fast_gpio", Warning, "there is no /dev/gpiomem");
        assert!(remedy.starts_with("only Raspberry Pi's own kernel has this node"), "{remedy}");
        assert_eq!(
            says(&wish("/dev/mem"), "fast_gpio", Warning, "pinion may not open /dev/mem"),
            "set fast_gpio to on, or run Pinion as root"
        );
        assert_eq!(wish("auto"), [], "nobody asked for it");
    }

    #[test]
    fn fast_lines_of_an_rp1_need_a_link_that_never_sleeps() {
        let tree = Tree::empty();
        tree.put("etc/pinion/pinion.toml", "fast_gpio = \"on\"\n");
        tree.put_mode("dev/gpiomem0", "", 0o666);
        let with_policy = |policies: &str| {
            tree.put("sys/module/pcie_aspm/parameters/policy", policies);
            permitted(&tree, &stranger(vec![]))
        };
        let remedy =
            says(&with_policy("[default] performance\n"), "fast_gpio", Warning, "the PCIe link of the RP1 may");
        assert!(remedy.contains("pcie_aspm.policy=performance, and not pcie_aspm=off"), "{remedy}");
        let findings = with_policy("default [performance] powersave\n");
        says(&findings, "fast_gpio", Fine, "may open /dev/gpiomem0");
        assert_eq!(findings.len(), 1, "{findings:?}");
    }

    #[test]
    fn the_users_are_judged_that_pinion_runs_as() {
        let tree = Tree::empty();
        let look = || permissions(&tree.computer(), &instances(&tree.called_by(54_321)).0, &BTreeSet::new());
        assert_eq!(says(&look(), "user", Warning, "there is no user pinion"), INSTALL);
        tree.put_mode("dev/gpiochip0", "", 0o660);
        let gid = fs::metadata(tree.computer().path("/dev/gpiochip0")).unwrap().gid();
        let passwd = "root:x:0:0:::\npinion:x:54321:54321:::\npi:x:54322:54322:::\n";
        tree.put("etc/passwd", passwd);
        tree.put("etc/group", format!("gpio:x:{gid}:pi\n"));
        // The service would run as pinion.
        says(&look(), "gpio", Error, "pinion may not open");
        // A running process counts, with its groups.
        tree.process(10, &["/usr/bin/pinion", "run"], 54_321, &[gid]);
        says(&look(), "gpio", Fine, "pinion may open");
        // A stranger's does not.
        tree.process(9, &["/usr/bin/pinion", "run"], 54_322, &[]);
        assert_eq!(look().len(), 1, "{:?}", look());
        // Two users, one from a unit of its own.
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion -r\nUser=pi\n");
        tree.link("etc/systemd/system/multi-user.target.wants/klipper-mcu.service", "../klipper-mcu.service");
        let findings = look();
        assert_eq!(findings.len(), 2, "{findings:?}");
        says(&findings, "gpio", Fine, "pi may open");
        tree.put("etc/group", format!("gpio:x:{gid}:\n"));
        let remedy = says(&look(), "gpio", Error, "pi may not open");
        assert_eq!(remedy, "sudo usermod -aG gpio pi, then sudo systemctl restart klipper-mcu");
        let unit = "[Service]\nExecStart=/usr/bin/pinion -r\nUser=pi\nSupplementaryGroups=gpio\n";
        tree.put("etc/systemd/system/klipper-mcu.service", unit);
        says(&look(), "gpio", Fine, "pi may open");
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion -r\n");
        says(&look(), "gpio", Fine, "root may open");
        // The simulated printer opens nothing.
        fs::remove_file(tree.computer().path("/etc/systemd/system/multi-user.target.wants/klipper-mcu.service"))
            .unwrap();
        tree.process(10, &["/usr/bin/pinion", "run", "--board", "sim"], 54_321, &[]);
        says(&look(), "user", Warning, "there is no user pinion");
    }

    /// A link to a device of this computer, in the place of a node: a test cannot make nodes.
    #[test]
    fn a_node_of_another_kind_is_no_chip() {
        let tree = Tree::empty();
        tree.link("dev/gpiochip0", "/dev/null");
        says(&present(&tree), "gpio", Fine, "GPIO: /dev/gpiochip0");
        tree.link("sys/dev/char/1:3/subsystem", "../../../../class/mem");
        let remedy = says(&present(&tree), "gpio", Error, "/dev/gpiochip0 is not a gpio device, but one of mem");
        assert!(remedy.starts_with("sudo rm /dev/gpiochip0 && sudo udevadm trigger"), "{remedy}");
        fs::remove_file(tree.computer().path("/sys/dev/char/1:3/subsystem")).unwrap();
        tree.link("sys/dev/char/1:3/subsystem", "../../../../bus/gpio");
        says(&present(&tree), "gpio", Fine, "GPIO: /dev/gpiochip0");
    }

    #[test]
    fn devices_that_are_root_s_alone_want_the_rules() {
        let tree = Tree::empty();
        tree.put_mode("dev/spidev0.0", "", 0o600);
        let find = || permitted(&tree, &stranger(vec![]));
        assert!(says(&find(), "spi", Error, "0600 (1 of 1 refused)").contains("apt install --reinstall"));
        tree.put("usr/lib/udev/rules.d/60-pinion-mcu.rules", "");
        assert!(says(&find(), "spi", Error, "may not open").ends_with("--subsystem-match=spidev"));
        assert_eq!(find().len(), 1, "nothing is said of what is not there");
    }

    #[test]
    fn what_is_there_and_how_to_enable_the_rest() {
        let tree = Tree::empty();
        let findings = present(&tree);
        says(&findings, "gpio", Warning, "no GPIO chip");
        assert!(says(&findings, "spi", Fine, "SPI: none").contains("device tree"));
        tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
        tree.put("boot/firmware/config.txt", "#dtparam=spi=on\ndtparam=i2c_arm=on\ndtoverlay=w1-gpio\n");
        let findings = present(&tree);
        let remedy = says(&findings, "spi", Fine, "SPI: off");
        assert!(remedy.contains("dtparam=spi=on") && remedy.contains("/boot/firmware/config.txt"), "{remedy}");
        assert_eq!(says(&findings, "i2c", Warning, "on in /boot/firmware/config.txt, but not there"), "sudo reboot");
        says(&findings, "w1", Warning, "no DS18B20 answers");
        assert!(says(&findings, "pwm", Fine, "PWM: off").contains("dtoverlay=pwm-2chan"));
        tree.put("sys/bus/i2c/devices/i2c-1/name", "");
        assert!(says(&present(&tree), "i2c", Warning, "not loaded").contains("modprobe i2c-dev"));
        NODES.iter().for_each(|(_, path)| tree.put(path, ""));
        let findings = present(&tree);
        assert!(
            findings.iter().all(|finding| finding.status == Fine && finding.trouble.remedy.is_none()),
            "{findings:?}"
        );
        says(&findings, "i2c", Fine, "I2C: /dev/i2c-1");
    }

    #[test]
    fn the_whole_config_txt_says_what_is_on() {
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
        for (text, is_on) in [
            ("dtparam=spi=on\n", true),
            ("dtparam=i2c_arm=on,spi=on\n", true),
            ("[pi4]\ndtparam=spi=on\n", true),
            ("include more.txt\n", true),
            ("dtoverlay=spi1-1cs\n", true),
            ("[pi5]\ndtparam=spi=on\n", false),
            ("dtparam=spi=on\ndtparam=spi=off\n", false),
        ] {
            tree.put("boot/firmware/config.txt", text);
            tree.put("boot/firmware/more.txt", "dtparam=spi=on\n");
            let findings = present(&tree);
            match is_on {
                true => drop(says(&findings, "spi", Warning, "on in /boot/firmware/config.txt, but not there")),
                false => drop(says(&findings, "spi", Fine, "SPI: off")),
            }
        }
    }

    #[test]
    fn only_a_raspberry_pi_has_a_config_txt() {
        for board in [boards::cb1(), boards::rk3566()] {
            let findings = present(&board.tree());
            says(&findings, "gpio", Fine, "GPIO: /dev/gpiochip0 and ");
            for finding in findings {
                assert_eq!(finding.status, Fine, "{finding:?}");
                let text = format!("{finding:?}");
                assert!(!["config.txt", "raspi-config", "dtparam"].iter().any(|word| text.contains(word)), "{text}");
            }
        }
        for board in boards::all() {
            says(&present(&board.tree()), "gpio", Fine, "GPIO: /dev/gpiochip");
        }
    }
}
