// SPDX-License-Identifier: GPL-3.0-or-later
//! A person's view of the simulated printer while a real klippy drives it: lights, the display, temperatures.

use std::path::Path;
use std::process::Command;

use crate::checkout;
use pinion_model::Look;

use crate::klippy::python;
use crate::printer::Printer;

/// klippy's own font: 16 rows for each of its characters.
fn font(checkout: &Path) -> Vec<Vec<u8>> {
    let script = "import font8x14\nfor glyph in font8x14.VGA_FONT: print(glyph.hex())";
    let printed = Command::new(python())
        .args(["-c", script])
        .env("PYTHONPATH", checkout.join("klippy/extras/display"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .unwrap();
    let hex = String::from_utf8(printed.stdout).unwrap();
    let byte = |line: &str, n: usize| u8::from_str_radix(&line[2 * n..2 * n + 2], 16).unwrap();
    hex.lines().map(|line| (0..16).map(|n| byte(line, n)).collect()).collect()
}

/// The text of a display, in rows of 16 characters. A shape that is not a printable character is `?`.
fn text(look: &Look, font: &[Vec<u8>]) -> Vec<String> {
    let Look::Pixels { width: 128, height: 64, is_on: true, lit } = look else { return Vec::new() };
    let glyph = |row: usize, column: usize| -> Vec<u8> {
        let byte =
            |y: usize| (0..8).fold(0, |byte, x| byte << 1 | u8::from(lit[128 * (16 * row + y) + 8 * column + x]));
        (0..16).map(byte).collect()
    };
    let character = |row, column| {
        let glyph = glyph(row, column);
        (b' '..b'\x7f').find(|c| font[usize::from(*c)] == glyph).map_or('?', char::from)
    };
    (0..4).map(|row| (0..16).map(|column| character(row, column)).collect()).collect()
}

fn last_row(look: &Look, font: &[Vec<u8>]) -> String {
    text(look, font).pop().unwrap_or_default().trim_end().to_owned()
}

/// The colors of a strip's lights.
fn colours(printer: &mut Printer, strip: &str) -> String {
    printer.sight(strip).to_string()
}

#[test]
fn lights_have_the_colours_that_klippy_gives_them() {
    let Some(checkout) = checkout("lights_have_the_colours_that_klippy_gives_them") else { return };
    let mut printer = Printer::start_on(
        &checkout,
        |board| board,
        |config| {
            let template = "[display_template glow]\nparam_red: 0.2\ntext: {param_red}, 0.0, {printer.toolhead.max_velocity / 600}";
            format!("{config}\n{template}, 0.0\n")
        },
    );
    assert_eq!(colours(&mut printer, "strip"), "off off off off off off off off");
    printer.gcode("SET_LED LED=strip RED=1 GREEN=0.5 BLUE=0 INDEX=2");
    assert_eq!(colours(&mut printer, "strip"), "off #ff8000 off off off off off off");
    printer.gcode("SET_LED LED=strip BLUE=1 INDEX=8 TRANSMIT=0\nSET_LED LED=strip GREEN=0.01 INDEX=1");
    assert_eq!(colours(&mut printer, "strip"), "#000300 #ff8000 off off off off off #0000ff");
    printer.gcode("SET_LED LED=strip RED=1 GREEN=1 BLUE=1");
    assert_eq!(colours(&mut printer, "strip"), ["#ffffff"; 8].join(" "));
    printer.gcode("SET_LED_TEMPLATE LED=strip TEMPLATE=glow param_red=0.4 INDEX=3");
    assert_eq!(colours(&mut printer, "strip").split(' ').nth(2), Some("#660080"));
    // klippy drives these lines bit by bit, in messages of 20 bytes.
    printer.gcode("SET_LED LED=dots RED=0.2 INDEX=1\nSET_LED LED=dots BLUE=1 INDEX=4");
    assert_eq!(colours(&mut printer, "dots"), "#330000 off off #0000ff");
    printer.gcode("SET_LED LED=light WHITE=0.5\nG4 P500");
    let light = |printer: &mut Printer| {
        printer.sleep(std::time::Duration::from_secs(1));
        printer.probe().output("light").unwrap().brightness
    };
    assert!((light(&mut printer) - 0.5).abs() < 0.1, "{}", light(&mut printer));
    printer.gcode("SET_LED LED=light WHITE=1");
    assert_eq!(light(&mut printer), 1.0);
}

#[test]
fn the_display_shows_what_klippy_writes() {
    let Some(checkout) = checkout("the_display_shows_what_klippy_writes") else { return };
    let font = font(&checkout);
    let mut printer = Printer::start_on(
        &checkout,
        |board| board,
        |config| {
            let data = "[display_data mine first]\nposition: 1, 3\ntext: { \"%.1f\" % printer.gcode_move.speed }";
            format!("{config}\n{data}\n[force_move]\nenable_force_move: True\n")
        },
    );
    assert_eq!(last_row(&printer.sight("display"), &font), "Ready");
    // Icons, which are not text, with their values beside them.
    let status = ["?? 25?    ??  0%", "?? 25?    ??100%", "?????????? 00:00", "Ready           "];
    assert_eq!(text(&printer.sight("display"), &font), status);
    printer.gcode("M117 Pinion: 42 <ok>");
    assert_eq!(last_row(&printer.sight("display"), &font), "Pinion: 42 <ok>");
    printer.gcode("M117\nG1 F2250\nSET_DISPLAY_GROUP GROUP=mine");
    let picture = printer.sight("display");
    assert!(text(&picture, &font).iter().map(|row| row.trim_end()).eq(["", "   2250.0", "", ""]), "{picture}");
    // The axis was at 60 mm.
    printer.gcode("FORCE_MOVE STEPPER=stepper_x DISTANCE=-22.5 VELOCITY=50\nM400");
    assert_eq!(printer.probe().axis("x").unwrap().position_mm, 37.5);
    printer.gcode("M117 there\nSET_DISPLAY_GROUP GROUP=_default_16x4");
    assert_eq!(last_row(&printer.sight("display"), &font), "there");
    // A restart does not reset the display. klippy writes all of it again.
    printer.restart("FIRMWARE_RESTART");
    printer.gcode("M117 again");
    assert_eq!(last_row(&printer.sight("display"), &font), "again");
}

/// Adds a converter in the bed to the existing ones.
fn with_converter(board: String, chip: &str, fault: &str) -> String {
    let part = format!("[[part]]\nkind = \"thermocouple\"\nname = \"{chip}\"\nchip = \"{chip}\"\n{fault}");
    format!("{board}\n{part}bus = \"spidev1.0\"\nselect_pin = \"{chip}_cs\"\nheater = \"heater_bed\"\n")
}

#[test]
fn converters_read_what_the_heater_has() {
    const CHIPS: [&str; 4] = ["max31855", "max6675", "max31856", "max31865"];
    let Some(checkout) = checkout("converters_read_what_the_heater_has") else { return };
    // The bed is hot and cools.
    let hot = |board: String| {
        let hot = board.replace("name = \"heater_bed\"\n", "name = \"heater_bed\"\nstart_celsius = 90.0\n");
        CHIPS.iter().fold(hot, |board, chip| with_converter(board, chip, ""))
    };
    let mut printer = Printer::start_on(&checkout, hot, |config| config);
    let celsius = |printer: &Printer| printer.probe().heater("heater_bed").unwrap().celsius;
    let mut last = f64::INFINITY;
    for _ in 0..2 {
        printer.gcode("G4 P8000");
        let bed = celsius(&printer);
        assert!(bed > 50.0 && bed < last - 1.0, "{bed} after {last}");
        last = bed;
        for chip in CHIPS {
            let read = printer.object(&format!("temperature_sensor {chip}"))["temperature"].as_f64().unwrap();
            // klippy smooths over a second.
            assert!((read - bed).abs() < 1.5, "{chip}: {read} of {bed}");
        }
    }
    // The hot end is cold.
    let nozzle = printer.object("temperature_sensor nozzle")["temperature"].as_f64().unwrap();
    assert_eq!(nozzle, 25.0);
}

#[test]
fn a_broken_sensor_stops_the_mcu_at_its_third_bad_value() {
    let Some(checkout) = checkout("a_broken_sensor_stops_the_mcu_at_its_third_bad_value") else { return };
    for (chip, fault, told) in [
        ("max31855", "open", "MAX31855 : Open Circuit"),
        ("max31855", "short_to_supply", "MAX31855 : Short to Vcc"),
        ("max6675", "open", "Max6675 : Thermocouple Open Fault"),
        ("max31856", "short_to_supply", "Max31856: Over/Under Voltage Fault"),
        ("max31865", "open", "Max31865 RTD input is disconnected"),
    ] {
        let broken = |board: String| with_converter(board, chip, &format!("fault = \"{fault}\"\n"));
        let mut printer = Printer::launch(&checkout, broken, |config| config);
        printer.until_state("shutdown");
        let log = printer.host_log();
        let times = log.matches(told).count();
        assert_eq!(times, 3, "{told}: {log}");
        assert!(printer.log().contains("reports fault bits"), "{}", printer.log());
    }
}
