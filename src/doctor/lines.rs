// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO lines: which ones the pins of a printer.cfg mean.

use std::collections::BTreeSet;
use std::path::PathBuf;

use pinion_linux::Inventory;
use pinion_linux::pins::{Names, line_number};
use pinion_system::Computer;
use pinion_system::board::is_pi;
use pinion_system::finding::Finding;
use pinion_system::printer::line_of;

use pinion_system::instance::Instance;

/// The pins whose MCU is one of these instances, and has this computer's lines.
pub(super) fn of_instances<'a>(instances: &[Instance], pins: &'a BTreeSet<(PathBuf, String)>) -> BTreeSet<&'a str> {
    pins.iter().filter(|(link, _)| instances.iter().any(|one| one.serves(link))).map(|(_, pin)| pin.as_str()).collect()
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

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::boards::{self, TestBoard};
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Ok as Fine, Warning};
    use pinion_system::instance::instances;
    use std::path::Path;

    /// The findings about the header of a board, with these pins in printer.cfg.
    fn about_header(board: &TestBoard, pins: &[&str]) -> Vec<Finding> {
        let tree = board.tree();
        header(&tree.computer(), &board.inventory(&tree), &pins.iter().copied().collect())
    }

    #[test]
    fn a_header_whose_chip_has_another_number() {
        let numbered = ["gpio17", "gpiochip4/gpio33"];
        let remedy = says(
            &about_header(&boards::pi5(), &numbered),
            "gpio_numbers",
            Warning,
            "the header is gpiochip15 (pinctrl-rp1), and the numbers in printer.cfg are those of another kernel: Pinion \
             takes gpio17, gpiochip4/gpio33 for its lines",
        );
        assert_eq!(remedy, "in printer.cfg write GPIO17 for gpio17, pinctrl-rp1/gpio33 for gpiochip4/gpio33");
        for pins in [&[][..], &["gpiochip15/gpio17"], &["gpiochip11/gpio1"], &["gpio99"]] {
            let findings = about_header(&boards::pi5(), pins);
            assert!(findings.len() == 1 && findings[0].trouble.remedy.is_none(), "{findings:?}");
            says(&findings, "gpio_numbers", Fine, "the 40-pin header is gpiochip15 (pinctrl-rp1)");
        }
        // gpio17 is a line of the processor's own chip there.
        let findings = about_header(&boards::pi5_debian(), &numbered);
        let remedy = says(&findings, "gpio_numbers", Warning, "these pins are lines of another chip: gpio17");
        assert_eq!(remedy, "in printer.cfg write pinctrl-rp1/gpio17 for gpio17, if you mean lines of the header");
        assert_eq!(findings.len(), 1, "gpiochip4 is the header");
        let findings = about_header(&boards::pi5_without_header(), &[]);
        assert!(says(&findings, "gpio_numbers", Warning, "no driver for the lines").contains("Raspberry Pi OS"));
        says(&about_header(&boards::pi4(), &["gpio17"]), "gpio_numbers", Fine, "gpiochip0 (pinctrl-bcm2711)");
        says(&about_header(&boards::zero2(), &["gpio17"]), "gpio_numbers", Fine, "gpiochip0 (pinctrl-bcm2835)");
        for board in [boards::cb1(), boards::rk3566()] {
            assert_eq!(about_header(&board, &["gpio17"]), [], "it has no header of a Raspberry Pi");
        }
    }

    /// Only pins of an MCU that has this computer's lines count.
    #[test]
    fn pins_of_another_micro_controller() {
        let tree = Tree::empty();
        tree.put("etc/passwd", "pinion:x:54321:54321::/:/bin/sh\n");
        let (host, board) = (Path::new("/tmp/klipper_host_mcu"), Path::new("/dev/board"));
        let all = [(host, "gpio17"), (board, "gpio18")].map(|(link, pin)| (link.to_owned(), pin.to_owned())).into();
        let pins = || of_instances(&instances(&tree.computer()).0, &all);
        assert_eq!(pins(), ["gpio17"].into());
        tree.put("etc/pinion/pinion.toml", "board = \"sim\"\n");
        assert!(pins().is_empty());
    }
}
