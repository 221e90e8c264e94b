// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of pins that the chips of Klipper's micro-controllers have (Klipper's `src/*/gpio.c` and their Kconfig).

/// The chips by the beginning of their names, with the highest port and the highest number of its pins. `P` and a port
/// make a name: `PB13`.
const PORTS: [(&str, char, u32); 8] = [
    ("stm32", 'K', 15),
    ("gd32", 'K', 15),
    ("n32", 'K', 15),
    ("hc32", 'H', 15),
    ("sam", 'E', 31),
    ("same", 'D', 31),
    ("atmega", 'L', 7),
    ("at90", 'F', 7),
];
/// The highest port and number of all of them.
const ANY: (char, u32) = ('L', 31);

/// Why an MCU with this `serial` has no pin of this name: the names that it has. `None` if it may have it.
pub(super) fn lacks(serial: &str, pin: &str) -> Option<String> {
    let chip = serial.split_once("Klipper_").or_else(|| serial.split_once("klipper_")).map_or("", |(_, chip)| chip);
    if let Some(number) = pin.strip_prefix("gpio").and_then(|number| number.parse::<u32>().ok()) {
        return (chip.starts_with("rp2040") && number > 29).then(|| "gpio0 to gpio29".to_owned());
    }
    let mut letters = pin.strip_prefix('P')?.chars();
    let port = letters.next().filter(char::is_ascii_uppercase)?;
    let number: u32 = letters.as_str().parse().ok()?;
    let known = PORTS.iter().rev().find(|(name, ..)| chip.starts_with(name));
    let (last, highest) = known.map_or(ANY, |(_, port, number)| (*port, *number));
    (port > last || number > highest).then(|| format!("PA0 to P{last}{highest}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pin_that_no_chip_has_is_known() {
        let f4 = "/dev/serial/by-id/usb-Klipper_stm32f446xx_1D0039-if00";
        let pico = "/dev/serial/by-id/usb-Klipper_rp2040_E6605481DB318D34-if00";
        for (serial, pin, lacks_it) in [
            ("", "PB130", true),
            ("", "PX3", true),
            ("", "PA31", false),
            (f4, "PA16", true),
            (f4, "PK15", false),
            (pico, "gpio30", true),
            (pico, "gpio29", false),
            ("", "gpio45", false),
            ("/dev/serial/by-id/usb-Klipper_sam3x8e_5-if00", "PC29", false),
            ("/dev/serial/by-id/usb-Klipper_lpc1769_1-if00", "P1.30", false),
            (f4, "EXP1_3", false),
            (f4, "PINION", false),
            ("", "ar21", false),
        ] {
            assert_eq!(lacks(serial, pin).is_some(), lacks_it, "{serial} {pin}");
        }
    }
}
