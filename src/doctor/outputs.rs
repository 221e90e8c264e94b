// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs after the death of both processes: whether the kernel keeps a level that nobody drives any more.

use std::path::Path;

use pinion_system::Computer;
use pinion_system::board::append;
use pinion_system::finding::Finding;

/// The parameter of a Raspberry Pi's pin drivers. It is "Y" by default in the Raspberry Pi's own kernel, and missing in
/// older ones.
const PARAMETERS: &str = "/sys/module/pinctrl_*/parameters/persist_gpio_outputs";

/// Whether the kernel keeps the level of an output that is released, for each driver that has pins.
pub(super) fn released(computer: &Computer) -> Vec<Finding> {
    let parameters = computer.matching(PARAMETERS).into_iter();
    parameters.filter_map(|parameter| released_by(computer, &computer.name(&parameter))).collect()
}

/// `None` for a driver without pins: a kernel for all Raspberry Pis has several.
fn released_by(computer: &Computer, parameter: &Path) -> Option<Finding> {
    const CHECK: &str = "released_outputs";
    let module = parameter.ancestors().nth(2)?.file_name()?.to_str()?;
    let driver = format!("/sys/bus/platform/drivers/{}", module.replace('_', "-"));
    if computer.path(&driver).exists() && computer.matching(format!("{driver}/*.gpio")).is_empty() {
        return None;
    }
    let keeps = ["Y", "1"].contains(&&*computer.text(parameter)?);
    if !keeps {
        let found = "the kernel makes an output an input when no program holds it any longer: its resistor then decides the level";
        return Some(Finding::ok(CHECK, found));
    }
    Some(Finding::warning(
        CHECK,
        format!(
            "a heater stays on if Pinion and its guardian die together: the kernel keeps the levels of outputs ({module}.persist_gpio_outputs)"
        ),
        format!(
            "a resistor that keeps each heater's gate off, and {}, and reboot; outputs then also fall at each restart: /usr/share/doc/pinion-mcu/guide/safety.md",
            append(computer, "dtparam=strict_gpiod")
        ),
    ))
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Ok, Warning};

    const CHECK: &str = "released_outputs";

    #[test]
    fn the_kernel_may_keep_the_levels_of_released_outputs() {
        let tree = Tree::empty();
        assert!(released(&tree.computer()).is_empty(), "this kernel does not say");
        let parameter = |module: &str, value: &str| {
            tree.put(&format!("sys/module/{module}/parameters/persist_gpio_outputs"), format!("{value}\n"));
        };
        parameter("pinctrl_bcm2835", "Y");
        tree.put("boot/firmware/config.txt", "");
        let remedy = says(&released(&tree.computer()), CHECK, Warning, "(pinctrl_bcm2835.persist_gpio_outputs)");
        let config = tree.computer().path("/boot/firmware/config.txt");
        let command = format!("\\n[all]\\ndtparam=strict_gpiod\\n' | sudo tee -a {}, and", config.display());
        assert!(remedy.contains(&command), "{remedy}");
        assert!(remedy.contains("gate") && remedy.contains("at each restart"), "{remedy}");
        // A Raspberry Pi 5 has both drivers, and pins of one. strict_gpiod is for that one.
        tree.put("sys/bus/platform/drivers/pinctrl-bcm2835/bind", "");
        tree.put("sys/bus/platform/drivers/pinctrl-rp1/1f000d0000.gpio/uevent", "");
        parameter("pinctrl_rp1", "Y");
        let findings = released(&tree.computer());
        says(&findings, CHECK, Warning, "pinctrl_rp1.persist_gpio_outputs");
        assert_eq!(findings.len(), 1);
        parameter("pinctrl_rp1", "N");
        let findings = released(&tree.computer());
        says(&findings, CHECK, Ok, "makes an output an input");
        assert_eq!(findings.len(), 1);
    }
}
