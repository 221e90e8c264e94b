// SPDX-License-Identifier: GPL-3.0-or-later
//! The pages' blocks for `printer.cfg`, given to klippy in batch mode as a user copies them.

use std::collections::HashSet;
use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

use crate::checkout;
use crate::klippy::{pinion_path, python};
use pinion_testkit::markdown::{Page, pages};

/// The other sections that a printer needs.
const PRINTER: &str = "[mcu]\nserial: /dev/null\n[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n";
/// The pages' names of a computer's pins. This computer does not have them.
const PINS: [(&str, u32); 19] = [
    ("GPIO5", 5),
    ("GPIO6", 6),
    ("GPIO12", 12),
    ("GPIO13", 13),
    ("GPIO16", 16),
    ("GPIO17", 17),
    ("GPIO22", 22),
    ("GPIO23", 23),
    ("GPIO24", 24),
    ("GPIO25", 25),
    ("GPIO26", 26),
    ("pinctrl-bcm2711/gpio27", 27),
    ("ads1015/voltage0", 4096),
    ("mcp3208/voltage0", 4097),
    ("spidev0.0", 1 << 26),
    ("spidev0.1", (1 << 26) + 1),
    ("spidev0.1/miso", (1 << 26) + (1 << 16) + 1),
    ("ttyAMA3", 1 << 27),
    ("fe20c000.pwm/pwm0", 1 << 16),
];

/// A configuration and its place in the pages.
struct Config {
    place: String,
    text: String,
}

/// Every block for `printer.cfg`, as the paragraph before it says. Of a change, the old side is included too.
fn configs(page: &Page) -> Vec<Config> {
    let mut configs = Vec::new();
    for block in page.blocks() {
        let place = format!("{}:{}", page.name, block.line);
        match block.kind.as_str() {
            "ini" if block.before.contains("`printer.cfg`") => configs.push(Config { place, text: block.text }),
            "diff" if block.text.contains("[mcu") => {
                for (sign, when) in [('-', "before"), ('+', "after")] {
                    let side = block.text.lines().filter(|line| line.is_empty() || line.starts_with([' ', sign]));
                    let text = side.map(|line| format!("{}\n", line.get(1..).unwrap_or_default())).collect();
                    configs.push(Config { place: format!("{place}, {when}"), text });
                }
            }
            _ => {}
        }
    }
    configs
}

/// The names of the host's pins in a configuration.
fn pins(text: &str) -> HashSet<&str> {
    let ends = |c: char| c.is_whitespace() || c == ',';
    text.split("host:").skip(1).filter_map(|rest| rest.split(ends).next()).collect()
}

/// klippy's words if a chip that it asks while it starts answers nothing, as in batch mode. It has read all sections then.
const SILENT_CHIP: &str = "TypeError: 'NoneType' object is not subscriptable";

fn klippy_takes(checkout: &Path, config: &Config, dictionary: &Value) {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let instance = config.text.split("[mcu ").nth(1).and_then(|rest| rest.split(']').next()).unwrap_or("host");
    let own = if config.text.contains("[mcu ") { "" } else { "[mcu host]\nserial: /tmp/klipper_host_mcu\n" };
    fs::write(path("printer.cfg"), format!("{PRINTER}{own}{}", config.text)).unwrap();
    fs::write(path("dict"), dictionary.to_string()).unwrap();
    let gcode = if config.text.contains("[output_pin light]") { "SET_PIN PIN=light VALUE=1\n" } else { "M115\n" };
    fs::write(path("g.gcode"), gcode).unwrap();
    let batch = Command::new(python())
        .arg(checkout.join("klippy/klippy.py"))
        .arg(path("printer.cfg"))
        .arg("-i")
        .arg(path("g.gcode"))
        .arg("-o")
        .arg(path("out"))
        .arg("-d")
        .arg(path("dict"))
        .arg("-d")
        .arg(format!("{instance}={}", path("dict").display()))
        .output()
        .unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&batch.stdout), String::from_utf8_lossy(&batch.stderr));
    let is_silent = config.place.starts_with("pinion add ") && said.contains(SILENT_CHIP);
    assert!(
        is_silent || batch.status.success() && !said.contains("Error"),
        "{}: {said}\n{}",
        config.place,
        config.text
    );
}

#[test]
fn klippy_takes_the_configuration_of_the_pages() {
    let Some(checkout) = checkout("klippy_takes_the_configuration_of_the_pages") else { return };
    let configs: Vec<Config> = pages().iter().flat_map(configs).collect();
    for (place, part) in [("README.md", "[temperature_sensor"), ("docs/guide/migrate.md", "adc_voltage")] {
        let found = configs.iter().any(|config| config.place.starts_with(place) && config.text.contains(part));
        assert!(found, "{place} has no such configuration any more");
    }
    let dictionary = Command::new(pinion_path()).arg("dict").output().unwrap().stdout;
    let mut dictionary: Value = serde_json::from_slice(&dictionary).unwrap();
    let named: HashSet<&str> = configs.iter().flat_map(|config| pins(&config.text)).collect();
    for (name, number) in PINS {
        assert!(named.contains(name), "no page names {name}");
        dictionary["enumerations"]["pin"][name] = json!(number);
    }
    // Klipper refuses what only Kalico knows.
    let is_kalico = checkout.join("klippy/extras/danger_options.py").exists();
    for config in configs.iter().filter(|config| is_kalico || !config.text.contains("is_non_critical")) {
        klippy_takes(&checkout, config, &dictionary);
    }
}

/// What `pinion add` writes for each device, on the card of a Raspberry Pi 4.
#[test]
fn klippy_takes_what_pinion_add_writes() {
    let Some(checkout) = checkout("klippy_takes_what_pinion_add_writes") else { return };
    let pinion = |args: &[&str]| Command::new(pinion_path()).args(args).output().unwrap();
    let mut dictionary: Value = serde_json::from_slice(&pinion(&["dict"]).stdout).unwrap();
    let lines = (5..28).map(|line| (format!("GPIO{line}"), line));
    let lines = lines.chain([("spidev0.0/miso".to_owned(), (1 << 26) + (1 << 16))]);
    let named = PINS.iter().map(|(name, number)| ((*name).to_owned(), *number));
    for (name, number) in named.chain(lines) {
        dictionary["enumerations"]["pin"][name] = json!(number);
    }
    let folder = tempfile::tempdir().unwrap();
    let list: Value =
        serde_json::from_slice(&pinion(&["add", "--json", "--root", folder.path().to_str().unwrap()]).stdout).unwrap();
    for device in list["devices"].as_array().unwrap() {
        let device = device["name"].as_str().unwrap();
        let card = tempfile::tempdir().unwrap();
        let put = |path: &str, text: &str| {
            let path = card.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
        put("boot/firmware/config.txt", "");
        put("sys/bus/w1/devices/28-0316a4f1ff27/w1_slave", "");
        put("home/pi/printer.cfg", "[stepper_x]\nposition_max: 200\n[stepper_y]\nposition_max: 200\n");
        let added = pinion(&["add", device, "--yes", "--root", card.path().to_str().unwrap()]);
        assert!(added.status.success(), "{device}: {added:?}");
        let text = fs::read_to_string(card.path().join(format!("home/pi/pinion/{device}.cfg"))).unwrap();
        klippy_takes(&checkout, &Config { place: format!("pinion add {device}"), text }, &dictionary);
    }
}

/// The voltage is the same on both sides of the change. klippy took the raw reading, of 4095, as a part of
/// `adc_voltage`. Now it takes the scaled reading as a part of the true full scale.
#[test]
fn the_change_for_an_adc_is_right() {
    let page = pages().into_iter().find(|page| page.name == "docs/guide/migrate.md").unwrap();
    let voltage = |config: &Config| {
        let line = config.text.lines().find_map(|line| line.strip_prefix("adc_voltage: ")).unwrap();
        line.parse::<f64>().unwrap()
    };
    let [before, after] = &configs(&page)[..] else { panic!("a change has two sides") };
    // An ADS1115 has 16 bits, signed.
    let raw = 20_000.0;
    let seen_before = raw / 4095.0 * voltage(before);
    let seen_after = (raw * 4095.0 / 32767.0_f64).round() / 4095.0 * voltage(after);
    // One count of 4095 is 1 mV.
    assert!((seen_before - seen_after).abs() < 0.002, "{seen_before} V, {seen_after} V");
}
