// SPDX-License-Identifier: GPL-3.0-or-later
//! Compares the users of this computer's parts: pins that two of them want, pins that do not exist, buses that are too slow.

use std::collections::BTreeSet;
use std::fs;

use pinion_system::Computer;
use pinion_system::board::{append, is_pi};
use pinion_system::finding::Finding;
use pinion_system::klippy::Klippy;
use pinion_system::printer::Printer;
use pinion_system::uses::{A_PROGRAM, Resource, Source, Use, Uses};

/// The lowest clock of I2C at which an accelerometer loses no samples (docs/Measuring_Resonances.md of Klipper).
const ACCELEROMETER_HZ: u32 = 400_000;
/// The accelerometers that may be on I2C.
const ACCELEROMETERS: [&str; 5] = ["mpu9250", "icm20948", "lis2dw", "lis3dh", "bmi160"];

/// Parts that a section of printer.cfg and somebody else use.
pub(super) fn conflicts(uses: &Uses) -> Vec<Finding> {
    const CHECK: &str = "used_twice";
    let sections = uses.all.iter().filter(|one| matches!(one.source, Source::Printer(_)) && is_alone(&one.what));
    let mut told = BTreeSet::new();
    let mut findings = Vec::new();
    for one in sections {
        let rival = |other: &&Use| {
            let is_same =
                other.what == one.what || takes_all(&other.what, &one.what) || takes_all(&one.what, &other.what);
            let is_bus = one.function.is_some() && one.function == other.function;
            // The program that has exported a channel may be Pinion, for this section.
            let is_export = matches!(other.what, Resource::Pwm(_)) && other.user == A_PROGRAM;
            // klippy itself says if a printer.cfg uses a pin twice.
            is_same && !is_bus && !is_export && other.source != one.source
        };
        for other in uses.all.iter().filter(rival) {
            let mut pair = [(&one.user, &one.place), (&other.user, &other.place)];
            pair.sort();
            if !told.insert(format!("{:?}", pair)) {
                continue;
            }
            let pin = match (&one.what, &uses.board) {
                (Resource::Line(line), Some(board)) => uses.names.pin(board, line),
                _ => None,
            };
            let pin = pin.map_or(String::new(), |pin| format!(" (pin {pin})"));
            let found = format!(
                "{}{pin} is used twice: by {} ({}) and by {} ({})",
                one.what, one.user, one.place, other.user, other.place
            );
            let select = one.function.is_none().then_some(other.function.as_deref()).flatten();
            let remedy = match select.and_then(|function| function.strip_prefix("spi")) {
                Some(bus) => {
                    let mcu = match &one.source {
                        Source::Printer(path) => uses.printers.get(path).and_then(|(_, own)| own.keys().next()),
                        _ => None,
                    };
                    let mcu = mcu.map_or("", String::as_str);
                    format!(
                        "if that pin is the chip select: cs_pin: {mcu}:None and spi_bus: spidev{bus}.0 in printer.cfg; otherwise another pin (pinion pins --used)"
                    )
                }
                None => "choose another pin for one of them: pinion pins --used shows the used pins".into(),
            };
            findings.push(Finding::error(CHECK, found, remedy));
        }
    }
    findings
}

/// Whether one user has a part for itself.
fn is_alone(what: &Resource) -> bool {
    !matches!(what, Resource::I2c(_, None) | Resource::Unknown(_) | Resource::Device(_))
}

/// Whether the user of one part takes the other part, too.
fn takes_all(one: &Resource, other: &Resource) -> bool {
    matches!((one, other), (Resource::Controller(bus), Resource::Select(own, _)) if bus == own)
}

/// Pins in printer.cfg that are no lines of this computer.
pub(super) fn no_lines(uses: &Uses) -> Vec<Finding> {
    const CHECK: &str = "no_such_pin";
    let finding = |pin: &pinion_system::uses::NoLine| {
        let found =
            format!("[{}] ({}) names the pin {}, which this computer does not have", pin.section, pin.place, pin.pin);
        match &pin.meant {
            Some(meant) => {
                let chip = pin.pin.split_once(':').map_or(String::new(), |(chip, _)| format!("{chip}:"));
                Finding::error(CHECK, found, format!("write {chip}{meant}"))
            }
            None => Finding::error(CHECK, found, "pinion pins lists the names"),
        }
    };
    uses.no_lines.iter().map(finding).collect()
}

/// Buses whose clock is too slow for an accelerometer.
pub(super) fn slow_buses(computer: &Computer, uses: &Uses) -> Vec<Finding> {
    const CHECK: &str = "i2c_clock";
    let finding = |one: &Use| {
        let section = uses.section(one).filter(|section| ACCELEROMETERS.contains(&section.kind()))?;
        let Resource::I2c(number, _) = one.what else { return None };
        let file = format!("/sys/class/i2c-adapter/i2c-{number}/of_node/clock-frequency");
        let rate_hz = u32::from_be_bytes(fs::read(computer.path(file)).ok()?.try_into().ok()?);
        let found = format!("[{}] loses samples: the clock of i2c.{number} is {} kHz", section.name, rate_hz / 1000);
        let remedy = match is_pi(computer) {
            true => format!("{}, and reboot", append(computer, "dtparam=i2c_arm_baudrate=400000")),
            false => "set the clock of the bus to 400000 in the device tree".into(),
        };
        (rate_hz < ACCELEROMETER_HZ).then(|| Finding::warning(CHECK, found, remedy))
    };
    uses.all.iter().filter_map(finding).collect()
}

/// `[resonance_tester]` without numpy in klippy's Python.
pub(super) fn numpy(computer: &Computer, klippys: &[Klippy]) -> Vec<Finding> {
    const CHECK: &str = "numpy";
    let has_tester = |printer: &Printer| printer.config.section("resonance_tester").is_some();
    let tested = klippys.iter().filter(|klippy| klippy.printer().is_some_and(has_tester));
    let finding = |klippy: &Klippy| {
        let found = format!("SHAPER_CALIBRATE fails: klippy's Python has no numpy ({})", klippy.found_by);
        Some(Finding::warning(CHECK, found, klippy.install_numpy(computer)?))
    };
    tested.filter_map(finding).collect()
}
