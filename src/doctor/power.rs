// SPDX-License-Identifier: GPL-3.0-or-later
//! The firmware's report about a Raspberry Pi's power and temperature.

use std::path::Path;
use std::process::Command;

use pinion_linux::throttled;
use pinion_system::board::is_pi;
use pinion_system::finding::Finding;
use pinion_system::{Computer, output};

/// The report of a Raspberry Pi's firmware about its power and temperature. `vcgencmd` is the program that asks the
/// firmware, if it may be started.
pub(super) fn power(computer: &Computer, vcgencmd: Option<&Path>) -> Vec<Finding> {
    const CHECK: &str = "power";
    let Some(bits) = throttled_bits(computer, vcgencmd) else {
        return match is_pi(computer) {
            true => {
                vec![Finding::warning(CHECK, "whether the power is good is unknown", "sudo vcgencmd get_throttled")]
            }
            false => vec![Finding::ok(CHECK, "whether the power is good is unknown: this is not a Raspberry Pi")],
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
    let bits = output(Command::new(vcgencmd?).arg("get_throttled"))?;
    throttled::bits(bits.trim().strip_prefix("throttled=")?)
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok as Fine, Warning};

    #[test]
    fn a_pi_reports_its_power() {
        let tree = Tree::empty();
        says(&power(&tree.computer(), None), "power", Fine, "unknown: this is not a Raspberry Pi");
        tree.put("proc/device-tree/model", "Raspberry Pi 3");
        says(&power(&tree.computer(), None), "power", Warning, "unknown");
        let file = "sys/devices/platform/soc/soc:firmware/get_throttled";
        tree.put(file, "0\n");
        says(&power(&tree.computer(), None), "power", Fine, "were good");
        tree.put(file, "50001\n");
        let findings = power(&tree.computer(), None);
        says(&findings, "power", Error, "the voltage is too low");
        says(&findings, "power", Warning, "at times the processors are throttled");
        assert_eq!(findings.len(), 2);
    }

    #[test]
    fn a_pi_s_program_is_asked_where_the_kernel_does_not_say_and_not_waited_for() {
        let tree = Tree::empty();
        let bits_by = |script: &str| power(&tree.computer(), Some(&tree.program("vcgencmd", script)));
        // A busy computer may start the program later than it is waited for.
        let mut asked = (0..5).map(|_| bits_by("#!/bin/sh\necho throttled=0x80000\n"));
        let is_known = |findings: &Vec<Finding>| !findings[0].trouble.found().contains("unknown");
        let good = asked.find(is_known).expect("an answer");
        says(&good, "power", Warning, "at times the processors are at their temperature limit");
        tree.put("proc/device-tree/model", "Raspberry Pi 3");
        for script in ["#!/bin/sh\nexec sleep 1000\n", "#!/bin/sh\necho nonsense\n", "not a program"] {
            says(&bits_by(script), "power", Warning, "unknown");
        }
        says(&power(&tree.computer(), Some(Path::new("/nonexistent"))), "power", Warning, "unknown");
    }
}
