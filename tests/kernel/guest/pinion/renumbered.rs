// SPDX-License-Identifier: GPL-3.0-or-later
//! Chips whose numbers are not what they were, as after a kernel update.

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, run};

const OUTPUT: &str = "config_digital_out oid=0 pin=gpio17 value=0 default_value=0 max_duration=0";

/// The header of a Raspberry Pi 5, and no gpiochip0.
fn header() -> GpioSim {
    let _first = GpioSim::new("first", 8);
    let header = GpioSim::builder("pinctrl-rp1", 32).name(17, "GPIO17").build();
    assert_ne!(header.chip_name(), "gpiochip0");
    header
}

/// A chip with the number 0: this test's VM has had no chip that keeps it.
fn chip_0() -> GpioSim {
    let chip = GpioSim::new("expander", 32);
    assert_eq!(chip.chip_name(), "gpiochip0");
    chip
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn a_number_that_no_chip_has_means_the_header_until_a_chip_has_it() {
        let header = header();
        let program = Program::start();
        let mut client = program.connect();
        configure(&mut client, 2, &[OUTPUT, &OUTPUT.replace("oid=0 pin=gpio17", "oid=1 pin=GPIO17")]);
        program.wait_for_line(&[
            "gpio17: this kernel has no gpiochip0, so this is line 17 of the 40-pin header",
            &format!("({}, pinctrl-rp1)", header.chip_name()),
            "write GPIO17 in printer.cfg",
        ]);
        for (oid, value) in [(0, 1), (1, 0), (1, 1), (0, 0)] {
            run(&mut client, &format!("update_digital_out oid={oid} value={value}"));
            assert_eq!(header.level(17), value == 1, "both names are one line");
        }
        // A chip that comes has the number from the next host on.
        let other = chip_0();
        client.reset().expect("a reset");
        configure(&mut client, 1, &[OUTPUT]);
        run(&mut client, "update_digital_out oid=0 value=1");
        assert!(header.level(17) && !other.level(17), "this host's line stays");
        client.reset().expect("a reset");
        drop(client);
        let mut client = program.connect();
        configure(&mut client, 1, &[OUTPUT]);
        run(&mut client, "update_digital_out oid=0 value=1");
        assert!(other.level(17), "it means the chip with this number, as ever");
        let warnings = program.log().matches("this kernel has no gpiochip0").count();
        assert_eq!(warnings, 1, "the log says so once");
    }

    #[test]
    fn the_list_of_pins_has_the_former_names() {
        let header = header();
        let output = std::process::Command::new("pinion").args(["pins", "--json", "gpio17"]).output().expect("pinion");
        let list: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let line = &list["gpio"][0]["lines"][0];
        let own = format!("{}/gpio17", header.chip_name());
        let pins = ["GPIO17", &own, "pinctrl-rp1/gpio17", "gpio17", "gpiochip0/gpio17", "gpiochip4/gpio17"];
        assert_eq!(line["pins"], serde_json::json!(pins), "{list:#}");
    }
}
