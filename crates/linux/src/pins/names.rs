// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of this computer's pins.
//!
//! `gpio17` stands for `gpiochip0/gpio17`. The computer's own names are also published: `GPIO17` (the device tree's
//! name for a line), `pinctrl-rp1/gpio17` (with the chip's label), `mcp3208/voltage3` and `fe20c000.pwm/pwm0` (with the
//! chip's device). So are the links to serial ports: `serial0`. A name is left out if two things share it, or if it looks
//! like a numeric name. A name that klippy cannot read from a configuration is also left out.

#![forbid(unsafe_code)]

use std::collections::HashMap;

use super::number::{
    ANALOG, ANALOG_CHANNELS, ANALOG_CHIP, ANALOG_LINE, CHIP_LINES, CHIPS, MISO, MOSI, MOSI_NODES, PWM,
    PWM_CHIP_CHANNELS, PWM_CHIPS, channel_number, line_number, pwm_number, serial_number,
};
use crate::Inventory;
use pinion_firmware::board::Range;

/// The names of this computer that the C program does not have, each with its number.
#[derive(Debug, Default)]
pub struct Names(Vec<(String, u32)>);

impl Names {
    /// The names of the devices in `inventory`.
    pub fn of(inventory: &Inventory) -> Names {
        let mut numeric = Vec::new();
        let mut own = Vec::new();
        for chip in &inventory.chips {
            for (offset, line) in (0..).zip(&chip.lines) {
                let Some(number) = line_number(chip.number, offset) else {
                    continue;
                };
                if chip.number >= CHIPS || offset >= CHIP_LINES {
                    numeric.push((format!("gpiochip{}/gpio{offset}", chip.number), number));
                }
                own.push((format!("{}/gpio{offset}", chip.label), number));
                own.extend(line.name.clone().map(|name| (name, number)));
            }
        }
        for adc in &inventory.adcs {
            for (position, channel) in adc.channels.iter().enumerate() {
                let Some(number) = channel_number(adc.number, position, &channel.id) else {
                    continue;
                };
                let holders = [Some(&adc.name), adc.label.as_ref()];
                for holder in holders.into_iter().flatten() {
                    own.push((format!("{holder}/{}", channel.id), number));
                }
                // The driver's name alone does not distinguish two devices of one type.
                own.push((format!("iio{}/{}", adc.number, channel.id), number));
            }
        }
        for chip in &inventory.pwm {
            let Some(device) = &chip.device else { continue };
            for channel in 0..chip.channels {
                own.extend(pwm_number(chip.number, channel).map(|n| (format!("{device}/pwm{channel}"), n)));
            }
        }
        for node in &inventory.spi {
            if let Some(number) = node.number().filter(|number| *number < MOSI_NODES) {
                numeric.push((node.to_string(), MOSI + number));
                numeric.push((format!("{node}/miso"), MISO + number));
            }
        }
        for uart in &inventory.uarts {
            let Some(number) = serial_number(uart.device) else {
                continue;
            };
            own.push((uart.name.clone(), number));
            own.extend(uart.links.iter().map(|link| (link.clone(), number)));
        }
        own.retain(|(name, _)| writable(name) && !numeric_name(name));
        let mut names = unshared(own);
        names.append(&mut numeric);
        Names(names)
    }

    /// The names of one pin: the line's own name first, then the names with the chip in front.
    pub fn of_pin(&self, number: u32) -> Vec<&str> {
        let mut names: Vec<&str> = self.0.iter().filter(|(_, n)| *n == number).map(|(name, _)| name.as_str()).collect();
        // A line's own name has no slash, so it sorts first.
        names.sort_by_key(|name| name.contains('/'));
        names
    }

    /// The dictionary's enumeration `pin`: the ranges of the C program, and these names.
    pub(crate) fn ranges(&self) -> Vec<Range> {
        let range = |name: String, first, count| Range { name, first, count };
        let mut ranges = vec![range("gpio0".into(), 0, CHIP_LINES)];
        for chip in 0..CHIPS {
            let (from, to) = (ANALOG_LINE, ANALOG_LINE + ANALOG_CHANNELS);
            let parts = if chip == ANALOG_CHIP { &[0, from, to, CHIP_LINES][..] } else { &[0, CHIP_LINES] };
            for part in parts.windows(2) {
                let first = line_number(chip, part[0]);
                ranges.extend(first.map(|n| range(format!("gpiochip{chip}/gpio{}", part[0]), n, part[1] - part[0])));
            }
        }
        ranges.push(range("analog0".into(), ANALOG, ANALOG_CHANNELS));
        for chip in 0..PWM_CHIPS {
            let name = format!("pwmchip{chip}/pwm0");
            ranges.push(range(name, PWM + chip * PWM_CHIP_CHANNELS, PWM_CHIP_CHANNELS));
        }
        ranges.extend(runs(&self.0));
        ranges
    }
}

/// Leaves out names that stand for several pins, and repetitions of a name with the same pin.
fn unshared(names: Vec<(String, u32)>) -> Vec<(String, u32)> {
    let mut owner: HashMap<String, Option<u32>> = HashMap::new();
    for (name, number) in &names {
        owner.entry(name.clone()).and_modify(|one| *one = one.filter(|one| one == number)).or_insert(Some(*number));
    }
    let mut names = names;
    // If a name occurs twice for one pin, the first is kept: `remove` finds nothing for the second.
    names.retain(|(name, _)| owner.remove(name).flatten().is_some());
    names
}

/// Whether klippy reads this name from a configuration unchanged.
fn writable(name: &str) -> bool {
    !name.starts_with('/')
        && name.chars().any(|c| c.is_ascii_alphanumeric())
        && name.chars().all(|c| c.is_ascii_graphic() && !":!^~,#;".contains(c))
}

/// Whether this looks like a numeric name (`gpio17`, `analog3`), whatever its number.
fn numeric_name(name: &str) -> bool {
    let digits = |s: &str| !s.is_empty() && s.bytes().all(|c| c.is_ascii_digit());
    let counted = |s: &str, word: &str| s.strip_prefix(word).is_some_and(digits);
    match name.split_once('/') {
        None => counted(name, "gpio") || counted(name, "analog"),
        Some((chip, line)) => {
            counted(chip, "gpiochip") && counted(line, "gpio") || counted(chip, "pwmchip") && counted(line, "pwm")
        }
    }
}

/// Joins names into ranges if their numbers count up together with their values.
fn runs(names: &[(String, u32)]) -> Vec<Range> {
    let mut names: Vec<(&str, Option<u64>, u32, &str)> = names
        .iter()
        .map(|(name, value)| {
            let root = name.trim_end_matches(|c: char| c.is_ascii_digit());
            let digits = &name[root.len()..];
            let counts = digits == "0" || !digits.starts_with('0');
            let number = digits.parse().ok().filter(|_| counts);
            (root, number, *value, name.as_str())
        })
        .collect();
    names.sort_unstable();
    let mut ranges: Vec<Range> = Vec::new();
    let mut next = None;
    for (root, number, value, name) in names {
        match ranges.last_mut() {
            Some(range) if number.is_some() && next == Some((root, number, value)) => {
                range.count += 1;
            }
            _ => ranges.push(Range { name: name.to_owned(), first: value, count: 1 }),
        }
        next = Some((root, number.map(|n| n.saturating_add(1)), value.saturating_add(1)));
    }
    ranges
}

#[cfg(test)]
mod tests {
    use super::super::number::Target;
    use super::*;
    use crate::adc::{Channel, IioDevice};
    use crate::gpio::{Chip, LineInfo};
    use crate::pwm;
    use crate::spi::Node;
    use crate::uart::Uart;
    use pinion_firmware::board::Pin;
    use proptest::prelude::*;

    fn chip(number: u32, label: &str, names: &[&str]) -> Chip {
        let line = |name: &&str| LineInfo { name: (!name.is_empty()).then(|| name.to_string()), ..LineInfo::default() };
        Chip { number, label: label.into(), sleeps: false, lines: names.iter().map(line).collect() }
    }

    fn adc(number: u32, name: &str, ids: &[&str]) -> IioDevice {
        let channel = |id: &&str| Channel { id: id.to_string(), format: None };
        IioDevice { number, name: name.into(), label: None, channels: ids.iter().map(channel).collect() }
    }

    fn names(chips: Vec<Chip>, adcs: Vec<IioDevice>) -> Vec<(String, u32)> {
        let inventory = Inventory { chips, adcs, ..Inventory::default() };
        Names::of(&inventory).0
    }

    /// The names that klippy reads from the ranges (klippy/msgproto.py, `fill_enumerations`).
    fn expanded(ranges: &[Range]) -> Vec<(String, u32)> {
        let mut names = Vec::new();
        for range in ranges {
            if range.count == 1 {
                names.push((range.name.clone(), range.first));
                continue;
            }
            let root = range.name.trim_end_matches(|c: char| c.is_ascii_digit());
            let start: u32 = range.name[root.len()..].parse().unwrap_or(0);
            for i in 0..range.count {
                names.push((format!("{root}{}", start + i), range.first + i));
            }
        }
        names
    }

    #[test]
    fn the_c_program_s_numbers() {
        assert_eq!(line_number(0, 17), Some(17));
        assert_eq!(line_number(8, 287), Some(2591));
        assert_eq!(line_number(15, 17), Some(15 * 288 + 17));
        assert_eq!(channel_number(0, 5, "voltage2"), Some(4098));
        let ranges = Names::default().ranges();
        assert_eq!(ranges.len(), 28);
        let has = |name: &str, first, count| ranges.contains(&Range { name: name.into(), first, count });
        assert!(has("gpio0", 0, 288));
        assert!(has("gpiochip8/gpio0", 2304, 288));
        assert!(has("gpiochip15/gpio0", 4320, 288));
        assert!(has("analog0", 4096, 8));
    }

    /// In Klipper's C a number of gpiochip14 also means an ADC channel.
    #[test]
    fn no_line_has_the_number_of_a_channel() {
        let published = Names::default().ranges();
        let names = expanded(&published);
        for chip in 0..16 {
            for offset in 0..288 {
                let name = format!("gpiochip{chip}/gpio{offset}");
                let numbers: Vec<u32> = names.iter().filter(|(n, _)| *n == name).map(|(_, number)| *number).collect();
                assert_eq!(numbers.len(), 1, "{name}");
                assert_eq!(Target::of(Pin(numbers[0])), Target::Line { chip, offset }, "{name}");
                let same = numbers[0] == chip * 288 + offset;
                assert_eq!(same, !(4096..4104).contains(&(chip * 288 + offset)), "{name}");
            }
        }
        // A chip with as many lines has each name once.
        let chips = vec![chip(14, "big", &[""; 290])];
        let names: Vec<String> = names_of(chips).into_iter().filter(|name| name.starts_with("gpiochip14/")).collect();
        assert_eq!(names.len(), 290);
        assert_eq!(names.iter().collect::<std::collections::HashSet<_>>().len(), 290);
    }

    /// All names that a host learns.
    fn names_of(chips: Vec<Chip>) -> Vec<String> {
        let names = Names::of(&Inventory { chips, ..Inventory::default() });
        expanded(&names.ranges()).into_iter().map(|(name, _)| name).collect()
    }

    #[test]
    fn a_pwm_channel_has_the_name_of_its_device() {
        let chip =
            |number, device: Option<&str>, channels| pwm::Chip { number, device: device.map(Into::into), channels };
        let names = |pwm: Vec<pwm::Chip>| Names::of(&Inventory { pwm, ..Inventory::default() });
        let pi5 = names(vec![chip(0, Some("1f00098000.pwm"), 4), chip(1, None, 2)]);
        assert_eq!(pi5.of_pin(65536 + 2), ["1f00098000.pwm/pwm2"]);
        assert_eq!(pi5.0.len(), 4);
        assert!(pi5.ranges().contains(&Range { name: "1f00098000.pwm/pwm0".into(), first: 65536, count: 4 }));
        assert!(names(vec![chip(0, Some("a"), 2), chip(1, Some("a"), 2)]).0.is_empty(), "two chips of one device");
        assert!(names(vec![chip(8, Some("a"), 2)]).0.is_empty(), "it has no number");
    }

    #[test]
    fn an_spi_device_has_names_if_its_bus_has_a_number() {
        let spi = vec![Node::of(0xffff), Node::of(0x1_0000)];
        let names = Names::of(&Inventory { spi, ..Inventory::default() }).0;
        let named = |name: &str, number| (name.to_string(), number);
        assert_eq!(
            names,
            [named("spidev255.255", (1 << 26) + 0xffff), named("spidev255.255/miso", (1 << 26) + (1 << 16) + 0xffff)]
        );
    }

    #[test]
    fn a_line_s_names() {
        let chips = vec![chip(4, "pinctrl-rp1", &["ID_SDA", "GPIO1", ""])];
        let found = names(chips, vec![]);
        let number = 4 * 288 + 1;
        assert!(found.contains(&("GPIO1".into(), number)));
        assert!(found.contains(&("pinctrl-rp1/gpio1".into(), number)));
        let names = Names(found);
        assert_eq!(names.of_pin(number), ["GPIO1", "pinctrl-rp1/gpio1"]);
    }

    #[test]
    fn a_shared_name_is_left_out() {
        let chips = vec![chip(0, "expander", &["NC", "A", "NC"]), chip(1, "expander", &["B"])];
        let found: Vec<String> = names(chips, vec![]).into_iter().map(|n| n.0).collect();
        // expander/gpio0 stands for two lines, each other name for one.
        assert_eq!(found, ["expander/gpio1", "A", "expander/gpio2", "B"]);
    }

    #[test]
    fn names_that_a_configuration_cannot_hold_are_left_out() {
        for name in [
            "a:b",
            "!a",
            "^a",
            "~a",
            "a b",
            "a,b",
            "a#b",
            "a;b",
            "-",
            "",
            "/gpio0",
            "gpio300",
            "analog1",
            "gpiochip1/gpio2",
            "pwmchip0/pwm1",
            "Größe",
        ] {
            assert!(!writable(name) || numeric_name(name), "{name}");
        }
        for name in ["GPIO17", "ID_SDA", "PIN.3", "gpio_led", "gpio-line1", "analog", "a/gpio1"] {
            assert!(writable(name) && !numeric_name(name), "{name}");
        }
    }

    #[test]
    fn chips_and_channels_beyond_the_c_ranges_have_numbers_of_their_own() {
        let chips = vec![chip(16, "usb", &["a", "b"]), chip(0, "big", &[""; 290])];
        let adcs =
            vec![adc(0, "ads1115", &["voltage0-voltage1", "voltage0"]), adc(3, "mcp3008", &["voltage0", "voltage1"])];
        let found = names(chips, adcs);
        let number = |name: &str| found.iter().find(|(n, _)| n == name).map(|n| Pin(n.1));
        let target = |name: &str| number(name).map(Target::of);
        assert_eq!(target("gpiochip16/gpio1"), Some(Target::Line { chip: 16, offset: 1 }));
        assert_eq!(target("usb/gpio1"), target("b"));
        assert_eq!(target("gpiochip0/gpio289"), Some(Target::Line { chip: 0, offset: 289 }));
        assert_eq!(target("gpiochip0/gpio287"), None, "the range has it");
        assert_eq!(number("ads1115/voltage0"), Some(Pin(4096)));
        assert_eq!(target("ads1115/voltage0-voltage1"), Some(Target::Channel { device: 0, position: 0 }));
        assert_eq!(target("mcp3008/voltage1"), Some(Target::Channel { device: 3, position: 1 }));
        assert_eq!(target("iio3/voltage1"), target("mcp3008/voltage1"));
    }

    #[test]
    fn two_adcs_of_one_name_are_distinguished_by_number() {
        let adcs = vec![adc(0, "ads1115", &["voltage0"]), adc(1, "ads1115", &["voltage0"])];
        let found: Vec<String> = names(vec![], adcs).into_iter().map(|n| n.0).collect();
        assert_eq!(found, ["iio0/voltage0", "iio1/voltage0"]);
    }

    #[test]
    fn a_serial_port_has_the_number_of_its_device() {
        let port = |name: &str, device, links: &[&str]| Uart {
            name: name.into(),
            device,
            links: links.iter().map(|link| (*link).to_owned()).collect(),
            is_console: false,
        };
        let links = ["serial0", "serial/by-id/usb-port0", "serial/by-id/usb:1"];
        let uarts = vec![port("ttyAMA1", (204, 65), &links), port("ttyUSB9", (4096, 0), &[])];
        let names = Names::of(&Inventory { uarts, ..Inventory::default() });
        let number = serial_number((204, 65)).unwrap();
        assert_eq!(Target::of(Pin(number)), Target::Serial(204, 65));
        assert_eq!(names.of_pin(number), ["ttyAMA1", "serial0", "serial/by-id/usb-port0"]);
        assert_eq!(names.0.len(), 3, "there is no room for the other one");
    }

    #[test]
    fn names_that_count_up_make_one_range() {
        let named: Vec<(String, u32)> =
            [("A1", 1), ("A2", 2), ("A3", 9), ("B07", 3), ("B08", 4)].map(|(n, v)| (n.to_owned(), v)).into();
        let ranges = runs(&named);
        let counts: Vec<(&str, u32)> = ranges.iter().map(|r| (r.name.as_str(), r.count)).collect();
        assert_eq!(counts, [("A1", 2), ("A3", 1), ("B07", 1), ("B08", 1)]);
    }

    proptest! {
        #[test]
        fn ranges_expand_to_the_names(
            named in prop::collection::hash_map("[AB/]{0,2}[0-9]{0,3}", 0u32..40, 0..60)
        ) {
            let mut named: Vec<(String, u32)> = named.into_iter().collect();
            let mut back = expanded(&runs(&named));
            named.sort();
            back.sort();
            prop_assert_eq!(named, back);
        }
    }
}
