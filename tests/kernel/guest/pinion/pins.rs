// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion pins` on real chips.

use std::process::Command;

use gpio_cdev::{Chip, LineRequestFlags};

use crate::gpio_sim::GpioSim;
use crate::mock::adc;
use crate::sysfs;

fn pins(args: &[&str]) -> String {
    let output = Command::new("pinion").arg("pins").args(args).output().expect("pinion");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

/// The row of a line, as words.
fn row(list: &str, offset: u32) -> Vec<&str> {
    let words = list.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    words.into_iter().find(|words| words.first() == Some(&offset.to_string().as_str())).expect("a row for the line")
}

#[test]
fn names_directions_and_holders_are_listed() {
    let sim = GpioSim::builder("pinctrl-lab", 64).name(17, "GPIO17").name(63, "LAST").hog(6, "spi0 CS1").build();
    let line = Chip::new(sim.path()).and_then(|mut chip| chip.get_line(17)).expect("the line");
    let held = line.request(LineRequestFlags::OUTPUT, 0, "octoprint").expect("a free line");
    let chip = sim.chip_name();
    let number = |offset| match chip {
        "gpiochip0" => format!("gpio{offset}"),
        _ => format!("{chip}/gpio{offset}"),
    };

    let list = pins(&["pinctrl-lab"]);
    assert!(list.contains(&format!("{chip} pinctrl-lab, 64 lines")), "{list}");
    let by_label = |offset| format!("pinctrl-lab/gpio{offset},");
    assert_eq!(row(&list, 0), ["0", "-", "in", "free", &by_label(0), &number(0)]);
    assert_eq!(row(&list, 6), ["6", "-", "in", "spi0", "CS1", &by_label(6), &number(6)]);
    assert_eq!(row(&list, 17), ["17", "GPIO17", "out", "octoprint", "GPIO17,", &number(17)]);
    assert_eq!(row(&list, 63), ["63", "LAST", "in", "free", "LAST,", &number(63)]);

    let free = pins(&["--free", "pinctrl-lab"]);
    assert!(!free.contains("GPIO17") && !free.contains("spi0 CS1") && free.contains("LAST"), "{free}");
    drop(held);
    assert!(pins(&["--free", "gpio17"]).contains("GPIO17"));
}

#[test]
fn adcs_are_listed_with_resolution_and_reading() {
    let _adcs = adc::Adcs::new();
    sysfs::write(adc::raw("mock-adc10", 3), "341");
    let list = pins(&["mock-adc10"]);
    assert!(list.contains("mock-adc10, 8 channels"), "{list}");
    let line = list.lines().find(|line| line.contains("voltage3")).expect("its channel");
    assert!(line.contains("10 bits") && line.contains("341 (1365 of 4095)"), "{line}");
    assert!(line.contains("mock-adc10/voltage3"), "{line}");
    assert!(pins(&["mock-adc-s16/voltage1"]).contains("signed 16 bits"));
    assert!(pins(&["mock-adc-plain"]).contains("12 bits assumed"));
    let list = pins(&["spidev"]);
    assert!(list.contains("spi_bus: spidev0.0") && list.contains("spi_bus: spidev0.1"), "{list}");
}
