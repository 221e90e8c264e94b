// SPDX-License-Identifier: GPL-3.0-or-later
//! Pins and buses: whether they are there, whether Pinion may open them, and which processes hold the lines. Also the
//! firmware's report about the computer's power.

#![forbid(unsafe_code)]

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::cli::computer::device::Port;
use crate::cli::computer::{Access, Computer, Who, output};
use crate::cli::finding::Finding;
use crate::cli::settings::BoardName;
use pinion_linux::Inventory;
use pinion_linux::foreign::word;
use pinion_linux::gpio::{Chip, FastGpio, LINK_REMEDY, never_sleeps};
use pinion_linux::pins::{Names, line_number};
use pinion_linux::throttled;

use super::instance::Instance;
use super::printer::line_of;
use super::{INSTALL, REINSTALL};

/// A kind of devices.
struct Class {
    check: &'static str,
    name: &'static str,
    access: Access,
    /// udev's subsystem.
    subsystem: &'static str,
    /// The line of a Raspberry Pi's config.txt that enables it, and the beginnings of other lines that do.
    enabled_by: Option<(&'static str, &'static [&'static str])>,
    /// The files that Pinion has to open.
    nodes: &'static str,
}

const CLASSES: [Class; 6] = [
    Class {
        check: "gpio",
        name: "GPIO",
        access: Access::READ_WRITE,
        subsystem: "gpio",
        enabled_by: None,
        nodes: "/dev/gpiochip*",
    },
    Class {
        check: "adc",
        name: "ADC",
        access: Access::READ,
        subsystem: "iio",
        enabled_by: None,
        nodes: "/sys/bus/iio/devices/iio:device*/in_voltage*_raw",
    },
    Class {
        check: "pwm",
        name: "PWM",
        access: Access::WRITE,
        subsystem: "pwm",
        enabled_by: Some(("dtoverlay=pwm-2chan", &["dtoverlay=pwm"])),
        nodes: "/sys/class/pwm/pwmchip*/export",
    },
    Class {
        check: "spi",
        name: "SPI",
        access: Access::READ_WRITE,
        subsystem: "spidev",
        enabled_by: Some(("dtparam=spi=on", &["dtparam=spi", "dtoverlay=spi"])),
        nodes: "/dev/spidev*",
    },
    Class {
        check: "i2c",
        name: "I2C",
        access: Access::READ_WRITE,
        subsystem: "i2c-dev",
        enabled_by: Some(("dtparam=i2c_arm=on", &["dtparam=i2c", "dtoverlay=i2c"])),
        nodes: "/dev/i2c-*",
    },
    Class {
        check: "w1",
        name: "1-Wire",
        access: Access::READ,
        subsystem: "w1",
        enabled_by: Some(("dtoverlay=w1-gpio", &["dtoverlay=w1-gpio"])),
        nodes: "/sys/bus/w1/devices/28-*/w1_slave",
    },
];

/// The registers of GPIO chips.
const FAST: Class = Class {
    check: "fast_gpio",
    name: "fast lines",
    access: Access::READ_WRITE,
    subsystem: "*gpiomem*",
    enabled_by: None,
    nodes: "/dev/gpiomem*",
};

/// The kernel's policy for the sleep of PCIe links.
const ASPM_POLICY: &str = "/sys/module/pcie_aspm/parameters/policy";

/// Whether the users that Pinion runs as may open the devices, and these serial ports. Without a service it judges the
/// caller.
pub(super) fn permissions(computer: &Computer, instances: &[Instance], ports: &BTreeSet<&str>) -> Vec<Finding> {
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
        let found = "there is no user pinion: the service is not installed, and what it may open is unknown";
        return vec![Finding::warning("user", found, INSTALL)];
    }
    users.iter().flat_map(|(user, instances)| permissions_of(computer, instances, user, ports)).collect()
}

/// Whether `user` may open the devices. These instances run as `user`.
fn permissions_of(computer: &Computer, instances: &[&Instance], user: &Who, ports: &BTreeSet<&str>) -> Vec<Finding> {
    let units: Vec<&str> = instances.iter().filter_map(|instance| instance.unit.as_deref()).collect();
    let anew = match &units[..] {
        [] => "log in anew, and start Pinion anew".to_owned(),
        units => format!("sudo systemctl restart {}", units.iter().map(word).collect::<Vec<_>>().join(" ")),
    };
    let permission = |class: &Class| permission(computer, user, &anew, class, &computer.matching(class.nodes));
    let mut findings: Vec<Finding> = CLASSES.iter().filter_map(permission).collect();
    const SERIAL: Class = Class {
        check: "serial",
        name: "serial port",
        access: Access::READ_WRITE,
        subsystem: "tty",
        enabled_by: None,
        nodes: "/dev",
    };
    let there = ports.iter().filter_map(|name| match computer.port(name) {
        Port::There(port) => Some(computer.path(format!("/dev/{port}"))),
        Port::Missing | Port::Other => None,
    });
    let ports: Vec<PathBuf> = there.collect();
    findings.extend(self::permission(computer, user, &anew, &SERIAL, &ports));
    if instances.iter().any(|instance| instance.settings.watchdog) {
        const WATCHDOG: Class = Class {
            check: "watchdog",
            name: "watchdog",
            access: Access::WRITE,
            subsystem: "misc",
            enabled_by: None,
            nodes: "/dev/watchdog",
        };
        findings.extend(permission(&WATCHDOG));
    }
    let wants = |wish| instances.iter().any(|instance| instance.settings.fast_gpio == wish);
    if wants(FastGpio::On) {
        findings.push(permission(&FAST).unwrap_or_else(|| {
            let found = "fast lines: fast_gpio is on, and there is no /dev/gpiomem: lines go through the kernel";
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
    // A node that vanishes meanwhile does not count.
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
pub(super) fn presence(computer: &Computer) -> Vec<Finding> {
    CLASSES.iter().map(|class| present(computer, class)).collect()
}

fn present(computer: &Computer, class: &Class) -> Finding {
    let Class { check, name, .. } = *class;
    let nodes = computer.matching(class.nodes);
    if let Some((node, other)) = nodes.iter().find_map(|node| Some((node, other_subsystem(computer, class, node)?))) {
        let node = computer.name(node);
        let (shown, subsystem) = (node.display(), class.subsystem);
        let found = format!("{name}: {shown} is no {subsystem} device, but one of {other}");
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
        return Finding::warning(check, "I2C: there are buses, and no /dev/i2c-*: i2c-dev is not loaded", remedy);
    }
    let off = format!("{name}: none");
    let Some((line, beginnings)) = class.enabled_by else {
        return Finding::ok(check, off).or("if there is one, load its driver (a device tree overlay, as a rule)");
    };
    let Some(config) = is_pi(computer).then(|| pi_config(computer)).flatten() else {
        return Finding::ok(check, off).or("if it is wanted, enable it in the device tree, and reboot");
    };
    let text = computer.text(config).unwrap_or_default();
    let is_on = |line: &str| {
        let line = line.trim();
        let off = ["=off", "=0", "=false"].iter().any(|end| line.ends_with(end));
        !off && beginnings.iter().any(|beginning| line.starts_with(beginning))
    };
    match text.lines().any(is_on) {
        true if check == "w1" => Finding::warning(
            check,
            "1-Wire: on, and no DS18B20 answers",
            "check its wires and the pull-up resistor (4.7 kOhm)",
        ),
        true => Finding::warning(check, format!("{name}: on in {config}, and not there"), "sudo reboot"),
        false => Finding::ok(check, format!("{name}: off"))
            .or(format!("if it is wanted: printf '[all]\\n{line}\\n' | sudo tee -a {config}, and reboot")),
    }
}

fn model(computer: &Computer) -> String {
    computer.text("/proc/device-tree/model").unwrap_or_default()
}

/// The subsystem of a node in /dev that is another device than its name says, such as a null device.
fn other_subsystem(computer: &Computer, class: &Class, node: &Path) -> Option<String> {
    let about = fs::metadata(node).ok().filter(|about| about.file_type().is_char_device())?;
    // If it is unknown, the node counts as right.
    let subsystem = computer.subsystem(&about)?;
    (subsystem != class.subsystem).then_some(subsystem)
}

pub(super) fn is_pi(computer: &Computer) -> bool {
    model(computer).contains("Raspberry Pi")
}

/// Whether this is a Raspberry Pi 5, 500 or Compute Module 5.
pub(super) fn is_pi5(computer: &Computer) -> bool {
    let model = model(computer);
    ["Raspberry Pi 5", "Raspberry Pi Compute Module 5"].iter().any(|name| model.starts_with(name))
}

/// A Raspberry Pi's config.txt.
pub(super) fn pi_config(computer: &Computer) -> Option<&'static str> {
    computer.first(&["/boot/firmware/config.txt", "/boot/config.txt"])
}

/// How the VPU's clock of some Raspberry Pis is held. The SPI clock is made from it.
struct Vpu {
    models: &'static [&'static str],
    /// How the sections of config.txt begin that apply only to these models.
    sections: &'static [&'static str],
    core_freq: u32,
    /// The value of `core_freq_min` if config.txt does not set it.
    slowest: u32,
    lines: &'static str,
}

const VPUS: [Vpu; 3] = [
    Vpu {
        models: &["Pi 4", "Module 4"],
        sections: &["pi4", "cm4"],
        core_freq: 500,
        slowest: 200,
        lines: "core_freq=500\\ncore_freq_min=500",
    },
    Vpu {
        models: &["Pi 3", "Module 3"],
        sections: &["pi3", "cm3"],
        core_freq: 400,
        slowest: 250,
        lines: "core_freq=250",
    },
    Vpu { models: &["Pi Zero"], sections: &["pi0"], core_freq: 400, slowest: 250, lines: "core_freq=250" },
];

impl Vpu {
    /// Whether config.txt keeps the clock from changing. Sections whose condition is not the model count.
    fn is_held(&self, config: &str) -> bool {
        let (mut core_freq, mut slowest, mut is_forced, mut applies) = (self.core_freq, self.slowest, false, true);
        for line in config.lines().map(str::trim) {
            if let Some(section) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
                let is_model = ["pi", "cm"].iter().any(|model| section.starts_with(model));
                let is_own = self.sections.iter().any(|own| section.starts_with(own));
                applies = section != "none" && (!is_model || is_own);
            }
            let Some((key, value)) = line.split_once('=').filter(|_| applies) else { continue };
            let Ok(value) = value.trim().parse() else { continue };
            match key.trim() {
                "core_freq" => core_freq = value,
                "core_freq_min" => slowest = value,
                "force_turbo" => is_forced = value == 1,
                _ => {}
            }
        }
        is_forced || slowest >= core_freq
    }
}

/// Whether the SPI clock of a Raspberry Pi can drive LEDs on these pins.
pub(super) fn leds(computer: &Computer, pins: &BTreeSet<&str>) -> Vec<Finding> {
    const CHECK: &str = "leds";
    let model = model(computer);
    let of = |vpu: &&Vpu| vpu.models.iter().any(|name| model.contains(name));
    let Some(vpu) = VPUS.iter().find(of).filter(|_| is_pi(computer)) else { return Vec::new() };
    let Some(first) = pins.first() else { return Vec::new() };
    let text = pi_config(computer).and_then(|config| Some((config, computer.text(config)?)));
    let Some((config, text)) = text else { return Vec::new() };
    let lines = vpu.lines;
    let clock = match vpu.is_held(&text) {
        true => Finding::ok(CHECK, format!("LEDs: {config} holds the clock of SPI")),
        false => Finding::warning(
            CHECK,
            format!("LEDs: nothing in {config} holds the clock of SPI, so at times all LEDs of {first} may be white"),
            format!("printf '[all]\\n{lines}\\n' | sudo tee -a {config}, and reboot"),
        ),
    };
    let without_dma = pins.iter().find(|pin| ["spidev1.", "spidev2."].iter().any(|bus| pin.contains(bus)));
    let bus = without_dma.map(|pin| {
        let found = format!("LEDs: the SPI bus of {pin} has no DMA and pauses amid a frame");
        Finding::warning(CHECK, found, "connect them to the data output of SPI0 (pin 19), and pin: host:spidev0.0")
    });
    [Some(clock), bus].into_iter().flatten().collect()
}

/// Whether the GPIO chip is a Raspberry Pi 5's: its registers have a node with a number.
fn is_rp1(computer: &Computer) -> bool {
    computer.path("/dev/gpiomem0").exists()
}

/// Whether LEDs on these pins are on fast lines, and not refused. Each pin has the link to its MCU.
pub(super) fn line_leds(computer: &Computer, instances: &[Instance], pins: &BTreeSet<(&Path, &str)>) -> Vec<Finding> {
    let own = |link: &Path| {
        let mut own = instances.iter().filter(|instance| instance.settings.board == BoardName::Linux);
        own.find(|instance| instance.link.as_deref() == Some(link))
    };
    let pins = pins.iter().filter_map(|(link, pin)| Some((own(link)?, pin)));
    pins.map(|(instance, pin)| line_led(computer, instance, pin)).collect()
}

fn line_led(computer: &Computer, instance: &Instance, pin: &str) -> Finding {
    const CHECK: &str = "leds";
    let refused = |why: &str, remedy: String| Finding::error(CHECK, format!("LEDs: {pin} is refused: {why}"), remedy);
    let set = |value: &str| format!("fast_gpio = \"{value}\" in {}, then {}", instance.config(), instance.restart());
    const TO_SPI: &str = "connect them to the data output of SPI0 (pin 19), and pin: host:spidev0.0";
    if is_rp1(computer) {
        return refused("the RP1 is behind PCIe, which may shorten or join their pulses", TO_SPI.into());
    }
    let nodes = computer.matching(FAST.nodes);
    let wish = instance.settings.fast_gpio;
    if wish == FastGpio::Off && !nodes.is_empty() {
        return refused("fast_gpio is off", set("auto"));
    }
    let Some(node) = nodes.first().filter(|_| wish != FastGpio::Off) else {
        if wish == FastGpio::DevMem {
            return Finding::ok(CHECK, format!("LEDs: {pin} is written through /dev/mem"));
        }
        return refused("this computer has no fast lines (no /dev/gpiomem)", TO_SPI.into());
    };
    let node = computer.name(node);
    let mut about = fs::metadata(computer.path(&node)).ok().zip(instance.user(computer)).into_iter();
    if let Some((_, user)) = about.find(|(about, user)| wish != FastGpio::DevMem && !user.may(FAST.access, about)) {
        let why = format!("{} may not open {}", user.name, node.display());
        return refused(&why, set("on") + ": pinion doctor then says what is missing");
    }
    Finding::ok(
        CHECK,
        format!("LEDs: {pin} is on a fast line, if it is one of the processor's own ({})", node.display()),
    )
}

/// The pins whose MCU is one of these instances, and has this computer's lines.
pub(super) fn of_instances<'a>(instances: &[Instance], pins: &BTreeSet<(&Path, &'a str)>) -> BTreeSet<&'a str> {
    let links = instances.iter().filter(|instance| instance.settings.board == BoardName::Linux);
    let links: Vec<&Path> = links.filter_map(|instance| instance.link.as_deref()).collect();
    pins.iter().filter(|(link, _)| links.contains(link)).map(|(_, pin)| *pin).collect()
}

/// Whether these pins, which name the number of their chip, mean lines of the 40-pin header of a Raspberry Pi. Kernels
/// have numbered its chip differently.
pub(super) fn header(computer: &Computer, inventory: &Inventory, pins: &BTreeSet<&str>) -> Vec<Finding> {
    const CHECK: &str = "gpio_numbers";
    let chips = &inventory.chips;
    let Some(header) = inventory.header() else {
        if !is_pi(computer) || chips.is_empty() {
            return Vec::new();
        }
        let found = "this kernel has no driver for the lines of the 40-pin header";
        return vec![Finding::warning(CHECK, found, "boot the kernel of Raspberry Pi OS")];
    };
    let names = Names::of(inventory);
    let own_name = |offset: u32| {
        let number = line_number(header.number, offset)?;
        names.of_pin(number).first().map(|name| (*name).to_owned())
    };
    // The header has had these numbers. On a Pi 5 a chip of the processor may have them. Any other chip was connected on
    // purpose.
    let is_other = |number: u32| {
        let chip = chips.iter().find(|chip| chip.number == number && [0, 4].contains(&number));
        chip.is_some_and(|chip| chip.label.starts_with("gpio-brcmstb"))
    };
    let (mut former, mut other) = (Vec::new(), Vec::new());
    for pin in pins {
        let Some((chip, offset)) = line_of(pin) else { continue };
        let Some(name) = own_name(offset) else { continue };
        match () {
            () if inventory.renumbered(chip).is_some() => former.push((*pin, name)),
            () if is_other(chip) => other.push((*pin, name)),
            () => {}
        }
    }
    let write = |pins: &[(&str, String)]| {
        let pins: Vec<String> = pins.iter().map(|(pin, name)| format!("{name} for {pin}")).collect();
        format!("in printer.cfg write {}", pins.join(", "))
    };
    let shown = format!("gpiochip{} ({})", header.number, header.label);
    let list = |pins: &[(&str, String)]| pins.iter().map(|(pin, _)| *pin).collect::<Vec<_>>().join(", ");
    let mut findings = Vec::new();
    if !former.is_empty() {
        let found = format!(
            "the header is {shown}, and the numbers in printer.cfg are those of another kernel: Pinion takes {} for its lines",
            list(&former)
        );
        findings.push(Finding::warning(CHECK, found, write(&former)));
    }
    if !other.is_empty() {
        let found = format!("the header is {shown}, and these pins are lines of another chip: {}", list(&other));
        findings.push(Finding::warning(CHECK, found, write(&other) + ", if you mean lines of the header"));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(CHECK, format!("the 40-pin header is {shown}")));
    }
    findings
}

/// The holders of GPIO lines.
pub(super) fn holders(computer: &Computer, chips: &[Chip]) -> Vec<Finding> {
    const CHECK: &str = "gpio_lines";
    /// `pinion pins` lists more.
    const SHOWN: usize = 8;
    let chip = |chip: &Chip| {
        let held = (0u32..).zip(&chip.lines).filter(|(_, line)| line.held);
        let mut held: Vec<String> = held
            .map(|(offset, line)| format!("{offset} by \"{}\"", line.consumer.as_deref().unwrap_or("the kernel")))
            .collect();
        let count = held.len();
        held.truncate(SHOWN);
        let more = if count > SHOWN { ", ... (pinion pins lists all)" } else { "" };
        let colon = if count > 0 { ": " } else { "" };
        let (number, label, lines) = (chip.number, &chip.label, chip.lines.len());
        let list = held.join(", ");
        Finding::ok(CHECK, format!("gpiochip{number} {label}: {count} of {lines} lines are held{colon}{list}{more}"))
    };
    let mut findings: Vec<Finding> = chips.iter().map(chip).collect();
    let programs: Vec<String> = computer
        .all_processes()
        .iter()
        .filter(|process| {
            let folder = computer.path(format!("/proc/{}/fd", process.pid));
            let files = fs::read_dir(folder).into_iter().flatten().flatten();
            let mut targets = files.filter_map(|file| fs::read_link(file.path()).ok());
            // The target is of one line, of several lines, or of a line with edges (drivers/gpio/gpiolib-cdev.c).
            targets.any(|target| target.to_string_lossy().starts_with("anon_inode:gpio"))
        })
        .map(|process| {
            let program = process.arguments.first().and_then(|program| program.file_name());
            format!("{} (process {})", program.unwrap_or_default().to_string_lossy(), process.pid)
        })
        .collect();
    if !programs.is_empty() {
        findings.push(Finding::ok(CHECK, format!("programs that hold lines: {}", programs.join(", "))));
    }
    findings
}

/// The report of a Raspberry Pi's firmware about its power and temperature. `vcgencmd` is the program that asks the
/// firmware, if it may be started.
pub(super) fn power(computer: &Computer, vcgencmd: Option<&Path>) -> Vec<Finding> {
    const CHECK: &str = "power";
    let Some(bits) = throttled_bits(computer, vcgencmd) else {
        return match is_pi(computer) {
            true => {
                vec![Finding::warning(CHECK, "whether the power is good is unknown", "sudo vcgencmd get_throttled")]
            }
            false => vec![Finding::ok(CHECK, "whether the power is good is unknown: this is no Raspberry Pi")],
        };
    };
    let states = [
        (0, "the voltage is too low", "use a better power supply and a short, thick cable"),
        (1, "the processors' frequency is capped", "use a better power supply, or cool the computer"),
        (2, "the processors are throttled", "use a better power supply, or cool the computer"),
        (3, "the processors are at their temperature limit", "cool the computer"),
    ];
    let mut findings = Vec::new();
    for (bit, what, remedy) in states {
        let is = |bit: u32| bits >> bit & 1 == 1;
        if is(bit) {
            findings.push(Finding::error(CHECK, format!("{what}: steps are late and outputs fail"), remedy));
        } else if is(16 + bit) {
            findings.push(Finding::warning(CHECK, format!("since it was started, at times {what}"), remedy));
        }
    }
    if findings.is_empty() {
        findings.push(Finding::ok(CHECK, "voltage and temperature were good since the computer was started"));
    }
    findings
}

/// The firmware's bits, from sysfs or from vcgencmd.
fn throttled_bits(computer: &Computer, vcgencmd: Option<&Path>) -> Option<u32> {
    let files = computer.matching(throttled::FILES);
    if let Some(bits) = files.iter().find_map(|file| computer.text(computer.name(file))) {
        return throttled::bits(&bits);
    }
    let told = output(Command::new(vcgencmd?).arg("get_throttled"))?;
    throttled::bits(told.trim().strip_prefix("throttled=")?)
}

#[cfg(test)]
mod tests {
    use super::super::instance::instances;
    use super::super::tests::told;
    use super::*;
    use crate::cli::boards::{self, Board};
    use crate::cli::computer::tests::Tree;
    use crate::cli::finding::Level::{Error, Ok as Fine, Warning};
    use pinion_linux::gpio::LineInfo;
    use std::os::unix::fs::MetadataExt;

    fn permitted(tree: &Tree, user: &Who) -> Vec<Finding> {
        let instances = instances(&tree.computer()).0;
        permissions_of(&tree.computer(), &instances.iter().collect::<Vec<_>>(), user, &["ttyAMA1"].into())
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
        let tree = Tree::new();
        NODES.iter().for_each(|(_, path)| tree.put_mode(path, "", 0o660));
        let gid = fs::metadata(tree.computer().path("/dev/gpiochip0")).unwrap().gid();
        tree.put("etc/group", format!("gpio:x:{gid}:\n"));
        tree.put("etc/pinion/pinion.toml", "watchdog = true\nfast_gpio = \"on\"\n");
        let findings = permitted(&tree, &stranger(vec![gid]));
        assert_eq!(findings.len(), NODES.len());
        NODES.iter().for_each(|(check, _)| drop(told(&findings, check, Fine, "pinion may open /")));
        let findings = permitted(&tree, &stranger(vec![gid + 1]));
        for (check, path) in NODES {
            let remedy = told(&findings, check, Error, &format!("pinion may not open /{path}, which is "));
            assert_eq!(remedy, "sudo usermod -aG gpio pinion, then sudo systemctl restart pinion-mcu");
        }
    }

    #[test]
    fn fast_lines_that_were_asked_for_and_cannot_be_had() {
        let tree = Tree::new();
        let wish = |wish: &str| {
            tree.put("etc/pinion/pinion.toml", format!("fast_gpio = \"{wish}\"\n"));
            permitted(&tree, &stranger(vec![]))
        };
        let remedy = told(&wish("on"), "fast_gpio", Warning, "there is no /dev/gpiomem");
        assert!(remedy.starts_with("only Raspberry Pi's own kernel has this node"), "{remedy}");
        assert_eq!(
            told(&wish("/dev/mem"), "fast_gpio", Warning, "pinion may not open /dev/mem"),
            "set fast_gpio to on, or run Pinion as root"
        );
        assert_eq!(wish("auto"), [], "nobody asked for it");
    }

    #[test]
    fn fast_lines_of_an_rp1_need_a_link_that_never_sleeps() {
        let tree = Tree::new();
        tree.put("etc/pinion/pinion.toml", "fast_gpio = \"on\"\n");
        tree.put_mode("dev/gpiomem0", "", 0o666);
        let with_policy = |policies: &str| {
            tree.put("sys/module/pcie_aspm/parameters/policy", policies);
            permitted(&tree, &stranger(vec![]))
        };
        let remedy =
            told(&with_policy("[default] performance\n"), "fast_gpio", Warning, "the PCIe link of the RP1 may");
        assert!(remedy.contains("pcie_aspm.policy=performance, and not pcie_aspm=off"), "{remedy}");
        let findings = with_policy("default [performance] powersave\n");
        told(&findings, "fast_gpio", Fine, "may open /dev/gpiomem0");
        assert_eq!(findings.len(), 1, "{findings:?}");
    }

    #[test]
    fn the_users_are_judged_that_pinion_runs_as() {
        let tree = Tree::new();
        let look = || permissions(&tree.computer(), &instances(&tree.called_by(54_321)).0, &BTreeSet::new());
        assert_eq!(told(&look(), "user", Warning, "there is no user pinion"), INSTALL);
        tree.put_mode("dev/gpiochip0", "", 0o660);
        let gid = fs::metadata(tree.computer().path("/dev/gpiochip0")).unwrap().gid();
        let passwd = "root:x:0:0:::\npinion:x:54321:54321:::\npi:x:54322:54322:::\n";
        tree.put("etc/passwd", passwd);
        tree.put("etc/group", format!("gpio:x:{gid}:pi\n"));
        // The service would run as pinion.
        told(&look(), "gpio", Error, "pinion may not open");
        // A running process counts, with its groups.
        tree.process(10, &["/usr/bin/pinion", "run"], 54_321, &[gid]);
        told(&look(), "gpio", Fine, "pinion may open");
        // A stranger's does not.
        tree.process(9, &["/usr/bin/pinion", "run"], 54_322, &[]);
        assert_eq!(look().len(), 1, "{:?}", look());
        // Two users, one from a unit of its own.
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion -r\nUser=pi\n");
        tree.link("etc/systemd/system/multi-user.target.wants/klipper-mcu.service", "../klipper-mcu.service");
        let findings = look();
        assert_eq!(findings.len(), 2, "{findings:?}");
        told(&findings, "gpio", Fine, "pi may open");
        tree.put("etc/group", format!("gpio:x:{gid}:\n"));
        let remedy = told(&look(), "gpio", Error, "pi may not open");
        assert_eq!(remedy, "sudo usermod -aG gpio pi, then sudo systemctl restart klipper-mcu");
        let unit = "[Service]\nExecStart=/usr/bin/pinion -r\nUser=pi\nSupplementaryGroups=gpio\n";
        tree.put("etc/systemd/system/klipper-mcu.service", unit);
        told(&look(), "gpio", Fine, "pi may open");
        tree.put("etc/systemd/system/klipper-mcu.service", "[Service]\nExecStart=/usr/bin/pinion -r\n");
        told(&look(), "gpio", Fine, "root may open");
        // The simulated printer opens nothing.
        fs::remove_file(tree.computer().path("/etc/systemd/system/multi-user.target.wants/klipper-mcu.service"))
            .unwrap();
        tree.process(10, &["/usr/bin/pinion", "run", "--board", "sim"], 54_321, &[]);
        told(&look(), "user", Warning, "there is no user pinion");
    }

    /// A link to a device of this computer, in the place of a node: a test cannot make nodes.
    #[test]
    fn a_node_of_another_kind_is_no_chip() {
        let tree = Tree::new();
        tree.link("dev/gpiochip0", "/dev/null");
        told(&presence(&tree.computer()), "gpio", Fine, "GPIO: /dev/gpiochip0");
        tree.link("sys/dev/char/1:3/subsystem", "../../../../class/mem");
        let remedy =
            told(&presence(&tree.computer()), "gpio", Error, "/dev/gpiochip0 is no gpio device, but one of mem");
        assert!(remedy.starts_with("sudo rm /dev/gpiochip0 && sudo udevadm trigger"), "{remedy}");
        fs::remove_file(tree.computer().path("/sys/dev/char/1:3/subsystem")).unwrap();
        tree.link("sys/dev/char/1:3/subsystem", "../../../../bus/gpio");
        told(&presence(&tree.computer()), "gpio", Fine, "GPIO: /dev/gpiochip0");
    }

    #[test]
    fn devices_that_are_root_s_alone_want_the_rules() {
        let tree = Tree::new();
        tree.put_mode("dev/spidev0.0", "", 0o600);
        let find = || permitted(&tree, &stranger(vec![]));
        assert!(told(&find(), "spi", Error, "0600 (1 of 1 refused)").contains("apt install --reinstall"));
        tree.put("usr/lib/udev/rules.d/60-pinion-mcu.rules", "");
        assert!(told(&find(), "spi", Error, "may not open").ends_with("--subsystem-match=spidev"));
        assert_eq!(find().len(), 1, "nothing is said of what is not there");
    }

    #[test]
    fn what_is_there_and_how_to_enable_the_rest() {
        let tree = Tree::new();
        let findings = presence(&tree.computer());
        told(&findings, "gpio", Warning, "no GPIO chip");
        assert!(told(&findings, "spi", Fine, "SPI: none").contains("device tree"));
        tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
        tree.put("boot/firmware/config.txt", "#dtparam=spi=on\ndtparam=i2c_arm=on\ndtoverlay=w1-gpio\n");
        let findings = presence(&tree.computer());
        let remedy = told(&findings, "spi", Fine, "SPI: off");
        assert!(remedy.contains("dtparam=spi=on") && remedy.contains("/boot/firmware/config.txt"), "{remedy}");
        assert_eq!(told(&findings, "i2c", Warning, "on in /boot/firmware/config.txt, and not there"), "sudo reboot");
        told(&findings, "w1", Warning, "no DS18B20 answers");
        assert!(told(&findings, "pwm", Fine, "PWM: off").contains("dtoverlay=pwm-2chan"));
        tree.put("sys/bus/i2c/devices/i2c-1/name", "");
        assert!(told(&presence(&tree.computer()), "i2c", Warning, "not loaded").contains("modprobe i2c-dev"));
        NODES.iter().for_each(|(_, path)| tree.put(path, ""));
        let findings = presence(&tree.computer());
        assert!(findings.iter().all(|finding| finding.status == Fine && finding.told.remedy.is_none()), "{findings:?}");
        told(&findings, "i2c", Fine, "I2C: /dev/i2c-1");
    }

    #[test]
    fn leds_on_a_pi_need_a_clock_that_is_held() {
        let judged = |model: &str, config: &str, pin: &str| {
            let tree = Tree::new();
            tree.put("proc/device-tree/model", model);
            tree.put("boot/firmware/config.txt", config);
            leds(&tree.computer(), &[pin].into())
        };
        for (model, held, loose, remedy) in [
            (
                "Raspberry Pi 4 Model B Rev 1.4\0",
                &["core_freq=500\ncore_freq_min=500\n", "[pi4]\ncore_freq_min = 500\n", "force_turbo=1\n"][..],
                &["", "core_freq=500\n", "[pi3]\ncore_freq_min=500\n", "#core_freq_min=500\n", "[none]\nforce_turbo=1"]
                    [..],
                "core_freq=500\\ncore_freq_min=500",
            ),
            (
                "Raspberry Pi 3 Model B Plus Rev 1.3\0",
                &["core_freq=250\n", "[pi3+]\ncore_freq=250\n", "[pi4]\n[all]\ncore_freq=250"][..],
                &["", "core_freq=400\n", "[pi4]\ncore_freq=250\n"][..],
                "core_freq=250",
            ),
            ("Raspberry Pi Zero 2 W Rev 1.0\0", &["core_freq=250\n"][..], &[""][..], "core_freq=250"),
        ] {
            for config in held {
                told(
                    &judged(model, config, "host:spidev0.0"),
                    "leds",
                    Fine,
                    "/boot/firmware/config.txt holds the clock",
                );
            }
            for config in loose {
                let findings = judged(model, config, "host:spidev0.0");
                assert!(
                    told(&findings, "leds", Warning, "of host:spidev0.0 may be white").contains(remedy),
                    "{config}"
                );
                assert_eq!(findings.len(), 1);
            }
        }
        let findings = judged("Raspberry Pi 4", "force_turbo=1", "host:spidev1.0");
        assert!(told(&findings, "leds", Warning, "of host:spidev1.0 has no DMA").contains("SPI0"));
        assert!(judged("Raspberry Pi 5 Model B", "", "host:spidev0.0").is_empty(), "its SPI has a clock of its own");
        assert!(judged("Raspberry Pi 2", "", "host:spidev0.0").is_empty(), "its VPU has one clock");
        assert!(judged("Pine64", "", "host:spidev0.0").is_empty());
        let tree = Tree::new();
        tree.put("proc/device-tree/model", "Raspberry Pi 4");
        tree.put("boot/config.txt", "");
        assert!(leds(&tree.computer(), &BTreeSet::new()).is_empty(), "there are no LEDs");
    }

    #[test]
    fn leds_on_a_line_need_registers() {
        let judged = |nodes: &[(&str, u32)], settings: &str, pin: &str| {
            let tree = Tree::new();
            tree.put("etc/passwd", "pinion:x:54321:54321::/:/bin/sh\n");
            tree.put("etc/pinion/pinion.toml", settings);
            nodes.iter().for_each(|(node, mode)| tree.put_mode(node, "", *mode));
            let pins = [(Path::new("/tmp/klipper_host_mcu"), pin), (Path::new("/dev/board"), "PA1")];
            line_leds(&tree.computer(), &instances(&tree.computer()).0, &pins.into())
        };
        let refused = |nodes: &[(&str, u32)], settings: &str, why: &str| {
            let findings = judged(nodes, settings, "host:gpio18");
            assert_eq!(findings.len(), 1, "{findings:?}");
            told(&findings, "leds", Error, &format!("host:gpio18 is refused: {why}"))
        };
        let (pi_4, pi_5) = (("dev/gpiomem", 0o666), ("dev/gpiomem0", 0o666));
        told(&judged(&[pi_4], "", "host:gpio18"), "leds", Fine, "host:gpio18 is on a fast line");
        told(&judged(&[], "fast_gpio = \"/dev/mem\"\n", "host:gpio18"), "leds", Fine, "through /dev/mem");
        assert!(refused(&[], "", "this computer has no fast lines").contains("spidev0.0"));
        assert!(refused(&[], "fast_gpio = \"off\"\n", "this computer has no fast lines").contains("spidev0.0"));
        assert!(
            refused(&[pi_4], "fast_gpio = \"off\"\n", "fast_gpio is off").contains("fast_gpio = \"auto\" in /etc/")
        );
        for settings in ["", "fast_gpio = \"on\"\n", "fast_gpio = \"off\"\n", "fast_gpio = \"/dev/mem\"\n"] {
            assert!(refused(&[pi_5], settings, "the RP1 is behind PCIe").contains("spidev0.0"));
        }
        refused(&[("dev/gpiomem", 0o600)], "", "pinion may not open /dev/gpiomem");
        assert!(judged(&[], "board = \"sim\"\n", "host:gpio18").is_empty(), "the simulated printer has any LEDs");
    }

    /// The findings about the header of a board, with these pins in printer.cfg.
    fn about_header(board: &Board, pins: &[&str]) -> Vec<Finding> {
        let tree = board.tree();
        header(&tree.computer(), &board.inventory(&tree), &pins.iter().copied().collect())
    }

    #[test]
    fn a_header_whose_chip_has_another_number() {
        let numbered = ["gpio17", "gpiochip4/gpio33"];
        let remedy = told(
            &about_header(&boards::pi5(), &numbered),
            "gpio_numbers",
            Warning,
            "the header is gpiochip15 (pinctrl-rp1), and the numbers in printer.cfg are those of another kernel: Pinion \
             takes gpio17, gpiochip4/gpio33 for its lines",
        );
        assert_eq!(remedy, "in printer.cfg write GPIO17 for gpio17, pinctrl-rp1/gpio33 for gpiochip4/gpio33");
        for pins in [&[][..], &["gpiochip15/gpio17"], &["gpiochip11/gpio1"], &["gpio99"]] {
            let findings = about_header(&boards::pi5(), pins);
            assert!(findings.len() == 1 && findings[0].told.remedy.is_none(), "{findings:?}");
            told(&findings, "gpio_numbers", Fine, "the 40-pin header is gpiochip15 (pinctrl-rp1)");
        }
        // gpio17 is a line of the processor's own chip there.
        let findings = about_header(&boards::pi5_debian(), &numbered);
        let remedy = told(&findings, "gpio_numbers", Warning, "these pins are lines of another chip: gpio17");
        assert_eq!(remedy, "in printer.cfg write pinctrl-rp1/gpio17 for gpio17, if you mean lines of the header");
        assert_eq!(findings.len(), 1, "gpiochip4 is the header");
        let findings = about_header(&boards::pi5_without_header(), &[]);
        assert!(told(&findings, "gpio_numbers", Warning, "no driver for the lines").contains("Raspberry Pi OS"));
        told(&about_header(&boards::pi4(), &["gpio17"]), "gpio_numbers", Fine, "gpiochip0 (pinctrl-bcm2711)");
        told(&about_header(&boards::zero2(), &["gpio17"]), "gpio_numbers", Fine, "gpiochip0 (pinctrl-bcm2835)");
        for board in [boards::cb1(), boards::rk3566()] {
            assert_eq!(about_header(&board, &["gpio17"]), [], "it has no header of a Raspberry Pi");
        }
    }

    #[test]
    fn only_a_raspberry_pi_has_a_config_txt() {
        for board in [boards::cb1(), boards::rk3566()] {
            let findings = presence(&board.tree().computer());
            told(&findings, "gpio", Fine, "GPIO: /dev/gpiochip0 and ");
            for finding in findings {
                assert_eq!(finding.status, Fine, "{finding:?}");
                let text = format!("{finding:?}");
                assert!(!["config.txt", "raspi-config", "dtparam"].iter().any(|word| text.contains(word)), "{text}");
            }
        }
        for board in boards::all() {
            told(&presence(&board.tree().computer()), "gpio", Fine, "GPIO: /dev/gpiochip");
        }
    }

    /// Only pins of an MCU that has this computer's lines count.
    #[test]
    fn pins_of_another_micro_controller() {
        let tree = Tree::new();
        tree.put("etc/passwd", "pinion:x:54321:54321::/:/bin/sh\n");
        let (host, board) = (Path::new("/tmp/klipper_host_mcu"), Path::new("/dev/board"));
        let pins = || of_instances(&instances(&tree.computer()).0, &[(host, "gpio17"), (board, "gpio18")].into());
        assert_eq!(pins(), ["gpio17"].into());
        tree.put("etc/pinion/pinion.toml", "board = \"sim\"\n");
        assert!(pins().is_empty());
    }

    #[test]
    fn who_holds_which_line() {
        let tree = Tree::new();
        let line = |consumer: Option<&str>, held| LineInfo {
            held,
            consumer: consumer.map(str::to_owned),
            ..LineInfo::default()
        };
        let chip = Chip {
            number: 0,
            label: "pinctrl".into(),
            sleeps: false,
            lines: vec![line(Some("spi0 CS0"), true), line(None, false), line(None, true)],
        };
        let findings = holders(&tree.computer(), std::slice::from_ref(&chip));
        told(
            &findings,
            "gpio_lines",
            Fine,
            "gpiochip0 pinctrl: 2 of 3 lines are held: 0 by \"spi0 CS0\", 2 by \"the kernel\"",
        );
        assert_eq!(findings.len(), 1);
        tree.process(77, &["/usr/bin/gpiomon", "17"], 1000, &[]);
        tree.link("proc/77/fd/3", "anon_inode:gpio-line");
        tree.process(78, &["/usr/bin/other"], 1000, &[]);
        tree.link("proc/78/fd/3", "/dev/null");
        told(&holders(&tree.computer(), &[]), "gpio_lines", Fine, "programs that hold lines: gpiomon (process 77)");
        let many = Chip { lines: vec![line(Some("a"), true); 20], ..chip };
        told(&holders(&tree.computer(), &[many]), "gpio_lines", Fine, "20 of 20 lines are held: 0 by \"a\"");
    }

    #[test]
    fn a_pi_tells_of_its_power() {
        let tree = Tree::new();
        told(&power(&tree.computer(), None), "power", Fine, "unknown: this is no Raspberry Pi");
        tree.put("proc/device-tree/model", "Raspberry Pi 3");
        told(&power(&tree.computer(), None), "power", Warning, "unknown");
        let file = "sys/devices/platform/soc/soc:firmware/get_throttled";
        tree.put(file, "0\n");
        told(&power(&tree.computer(), None), "power", Fine, "were good");
        tree.put(file, "50001\n");
        let findings = power(&tree.computer(), None);
        told(&findings, "power", Error, "the voltage is too low");
        told(&findings, "power", Warning, "at times the processors are throttled");
        assert_eq!(findings.len(), 2);
    }

    #[test]
    fn a_pi_s_program_is_asked_where_the_kernel_does_not_tell_and_not_waited_for() {
        let tree = Tree::new();
        let told_by = |script: &str| power(&tree.computer(), Some(&tree.program("vcgencmd", script)));
        let good = told_by("#!/bin/sh\necho throttled=0x80000\n");
        told(&good, "power", Warning, "at times the processors are at their temperature limit");
        tree.put("proc/device-tree/model", "Raspberry Pi 3");
        for script in ["#!/bin/sh\nexec sleep 1000\n", "#!/bin/sh\necho nonsense\n", "not a program"] {
            told(&told_by(script), "power", Warning, "unknown");
        }
        told(&power(&tree.computer(), Some(Path::new("/nonexistent"))), "power", Warning, "unknown");
    }
}
