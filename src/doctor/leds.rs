// SPDX-License-Identifier: GPL-3.0-or-later
//! Whether LEDs on a data line of SPI, or on a fast line, get a clock that they understand.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use pinion_linux::gpio::FastGpio;
use pinion_system::Computer;
use pinion_system::board::{self, Clock, Kind, append, pi_config};
use pinion_system::finding::Finding;
use pinion_system::uses::boot::ConfigTxt;

use super::devices::{FAST, is_rp1};
use pinion_system::instance::Instance;

const TO_SPI: &str = "connect them to the data output of SPI0 (pin 19), and pin: host:spidev0.0";

/// Whether the SPI clock of a Raspberry Pi can drive LEDs on these pins.
pub(super) fn leds(computer: &Computer, config_txt: &ConfigTxt, pins: &BTreeSet<String>) -> Vec<Finding> {
    const CHECK: &str = "leds";
    let (Some(first), Some(config)) = (pins.first(), pi_config(computer)) else { return Vec::new() };
    let has = |clock: &Clock| clock.sections.iter().any(|own| config_txt.sections.contains(&own.as_str()));
    let boards = board::all().unwrap_or_default();
    let Some(board) = boards.iter().find(|board| board.clock.as_ref().is_some_and(has)) else { return Vec::new() };
    let clock = match is_held(config_txt, board.clock.as_ref()) {
        true => Finding::ok(CHECK, format!("LEDs: {config} holds the clock of SPI")),
        false => {
            let lines = board.bus.get(&Kind::Leds).map(|bus| &bus.enable[..]).unwrap_or_default();
            let lines: Vec<&str> = lines.iter().map(String::as_str).filter(|line| !line.starts_with("dt")).collect();
            Finding::warning(
                CHECK,
                format!(
                    "LEDs: nothing in {config} holds the clock of SPI, so at times all LEDs of {first} may be white"
                ),
                format!("{}, and reboot", append(computer, &lines.join("\\n"))),
            )
        }
    };
    let without_dma = pins.iter().find(|pin| ["spidev1.", "spidev2."].iter().any(|bus| pin.contains(bus)));
    let bus = without_dma.map(|pin| {
        let found = format!("LEDs: the SPI bus of {pin} has no DMA and pauses within a frame");
        Finding::warning(CHECK, found, TO_SPI)
    });
    [Some(clock), bus].into_iter().flatten().collect()
}

/// Whether config.txt keeps this clock from changing.
fn is_held(config_txt: &ConfigTxt, clock: Option<&Clock>) -> bool {
    let number = |key: &str| config_txt.value(key)?.parse::<u32>().ok();
    let is_steady = |clock: &Clock| {
        number("core_freq_min").unwrap_or(clock.slowest_mhz) >= number("core_freq").unwrap_or(clock.usual_mhz)
    };
    number("force_turbo") == Some(1) || clock.is_none_or(is_steady)
}

/// Whether LEDs on these pins are on fast lines, and not refused. Each pin has the link to its MCU.
pub(super) fn line_leds(
    computer: &Computer,
    instances: &[Instance],
    pins: &BTreeSet<(PathBuf, String)>,
) -> Vec<Finding> {
    let own = |link: &Path| instances.iter().find(|instance| instance.serves(link));
    let pins = pins.iter().filter_map(|(link, pin)| Some((own(link)?, pin)));
    pins.map(|(instance, pin)| line_led(computer, instance, pin)).collect()
}

fn line_led(computer: &Computer, instance: &Instance, pin: &str) -> Finding {
    const CHECK: &str = "leds";
    let refused = |why: &str, remedy: String| Finding::error(CHECK, format!("LEDs: {pin} is refused: {why}"), remedy);
    let set = |value: &str| format!("fast_gpio = \"{value}\" in {}, then {}", instance.config(), instance.restart());
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
        return refused(&why, set("on") + ": pinion doctor then names the missing permission");
    }
    Finding::ok(CHECK, format!("LEDs: {pin} is on a fast line, if it is a GPIO of the processor ({})", node.display()))
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok as Fine, Warning};
    use pinion_system::instance::instances;

    #[test]
    fn leds_on_a_pi_need_a_clock_that_is_held() {
        let judged = |model: &str, config: &str, pin: &str| {
            let tree = Tree::empty();
            tree.put("proc/device-tree/model", model);
            tree.put("boot/firmware/config.txt", config);
            leds(&tree.computer(), &ConfigTxt::read(&tree.computer(), None), &[pin.to_owned()].into())
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
                says(
                    &judged(model, config, "host:spidev0.0"),
                    "leds",
                    Fine,
                    "/boot/firmware/config.txt holds the clock",
                );
            }
            for config in loose {
                let findings = judged(model, config, "host:spidev0.0");
                assert!(
                    says(&findings, "leds", Warning, "of host:spidev0.0 may be white").contains(remedy),
                    "{config}"
                );
                assert_eq!(findings.len(), 1);
            }
        }
        let findings = judged("Raspberry Pi 4", "force_turbo=1", "host:spidev1.0");
        assert!(says(&findings, "leds", Warning, "of host:spidev1.0 has no DMA").contains("SPI0"));
        assert!(judged("Raspberry Pi 5 Model B", "", "host:spidev0.0").is_empty(), "its SPI has a clock of its own");
        assert!(judged("Raspberry Pi 2", "", "host:spidev0.0").is_empty(), "its VPU has one clock");
        assert!(judged("Pine64", "", "host:spidev0.0").is_empty());
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", "Raspberry Pi 4");
        tree.put("boot/config.txt", "");
        let config_txt = ConfigTxt::read(&tree.computer(), None);
        assert!(leds(&tree.computer(), &config_txt, &BTreeSet::new()).is_empty(), "there are no LEDs");
    }

    #[test]
    fn leds_on_a_line_need_registers() {
        let judged = |nodes: &[(&str, u32)], settings: &str, pin: &str| {
            let tree = Tree::empty();
            tree.put("etc/passwd", "pinion:x:54321:54321::/:/bin/sh\n");
            tree.put("etc/pinion/pinion.toml", settings);
            nodes.iter().for_each(|(node, mode)| tree.put_mode(node, "", *mode));
            let pins = [("/tmp/klipper_host_mcu", pin), ("/dev/board", "PA1")];
            let pins = pins.map(|(link, pin)| (PathBuf::from(link), pin.to_owned()));
            line_leds(&tree.computer(), &instances(&tree.computer()).0, &pins.into())
        };
        let refused = |nodes: &[(&str, u32)], settings: &str, why: &str| {
            let findings = judged(nodes, settings, "host:gpio18");
            assert_eq!(findings.len(), 1, "{findings:?}");
            says(&findings, "leds", Error, &format!("host:gpio18 is refused: {why}"))
        };
        let (pi_4, pi_5) = (("dev/gpiomem", 0o666), ("dev/gpiomem0", 0o666));
        says(&judged(&[pi_4], "", "host:gpio18"), "leds", Fine, "host:gpio18 is on a fast line");
        says(&judged(&[], "fast_gpio = \"/dev/mem\"\n", "host:gpio18"), "leds", Fine, "through /dev/mem");
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
}
