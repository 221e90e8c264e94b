// SPDX-License-Identifier: GPL-3.0-or-later
//! The description: the refused values and their errors, and whether its documentation is complete.

use super::*;

/// The error of the default printer with its first `from` replaced by `to`.
fn error_of(from: &str, to: &str) -> String {
    assert!(DEFAULT.contains(from), "{from}");
    let text = DEFAULT.replacen(from, to, 1);
    match SimConfig::parse(&text, "my.toml") {
        Ok(_) => panic!("accepted {to}"),
        Err(error) => error.to_string(),
    }
}

const DOCUMENTATION: &str = include_str!("../../../../docs/guide/simulated-printer.md");

/// An example of the documentation: alone, or appended to the built-in description as the example says.
pub(crate) fn example(heading: &str) -> String {
    let (_, section) = DOCUMENTATION.split_once(&format!("\n### {heading}\n")).unwrap();
    let (_, example) = section.split_once("\n```toml\n").unwrap();
    let (example, _) = example.split_once("```\n").unwrap();
    if example.starts_with("[delta]") {
        return example.to_owned();
    }
    if example.starts_with("corexy") {
        return format!("{example}{DEFAULT}");
    }
    let mut text = DEFAULT.to_owned();
    if example.contains("name = \"z\"\n") {
        let (before, z) = DEFAULT.split_once("[[axis]]\nname = \"z\"\n").unwrap();
        text = format!("{before}{}", z.split_once("\n\n").unwrap().1);
    }
    format!("{text}\n{example}")
}

#[test]
fn the_default_printer_is_sound() {
    let config = SimConfig::default_printer();
    assert_eq!(config.axes.len(), 4);
    assert_eq!(config.heaters.len(), 2);
}

#[test]
fn an_error_is_one_line_with_file_key_and_remedy() {
    for (from, to, key, cause) in [
        ("travel_mm = 220.0", "travel = 220.0", "`travel`", "unknown field"),
        ("steps_per_mm = 80.0\n", "", "`steps_per_mm`", "missing field"),
        ("steps_per_mm = 80.0", "steps_per_mm = \"many\"", "`steps_per_mm`", "invalid type"),
        ("steps_per_mm = 80.0", "steps_per_mm = -80.0", "`steps_per_mm`", "not above zero"),
        ("steps_per_mm = 80.0", "steps_per_mm = nan", "`steps_per_mm`", "out of range"),
        ("microsteps = 16", "microsteps = 0", "`microsteps`", "not above zero"),
        ("start_mm = 60.0", "start_mm = 600.0", "`start_mm`", "out of its reach"),
        ("travel_mm = 220.0\n", "", "`travel_mm`", "an axis with an endstop needs it"),
        ("\"y_step\"", "\"x_step\"", "`step_pin`", "`x_step` already has a use"),
        ("\"x_step\"", "\"x step\"", "`step_pin`", "not a pin name"),
        ("\"x_step\"", "\"^x_step\"", "`step_pin`", "not a pin name"),
        ("name = \"y\"", "name = \"x\"", "`name`", "two have the name `x`"),
        ("endstop_at = \"min\"", "endstop_at = \"left\"", "`endstop_at`", "unknown variant"),
        ("\"hotend_sensor\"", "\"!hotend_sensor\"", "`sensor_pin`", "no polarity"),
        ("sensor_lag_s = 1.0", "sensor_lag_s = 60.0", "`sensor_lag_s`", "slower than"),
        ("max_celsius = 280.0", "max_celsius = -1", "`max_celsius`", "not above min"),
        ("beta_k = 3950.0\n", "", "`beta_k`", "one point"),
        ("beta_k = 3950.0", "beta_k = 0.0", "`beta_k`", "above zero"),
        (", [150.0, 1641.9]", "", "`points_celsius_ohm`", "two"),
        ("1641.9", "-1", "`points_celsius_ohm`", "above zero"),
        ("[25.0, 100000.0]", "[25.0, true]", "`points_celsius_ohm`", "invalid type"),
        ("bus = \"spidev1.0\"", "bus = \"spidev2.0\"", "`bus`", "no `spidev2.0`"),
        ("bus = \"spidev1.0\"", "bus = \"spidev0.0\"", "`select_pin`", "not the only chip"),
        ("uart_pin = \"y_uart\"\n", "", "`uart_pin`", "it has none"),
        (
            "uart_pin = \"y_uart\"",
            "uart_pin = \"y_uart\"\nuart_port = \"ttyAMA1\"",
            "`uart_port`",
            "also has a uart_pin",
        ),
        ("uart_pin = \"y_uart\"", "uart_port = \"y_step\"", "`uart_port`", "already has a use"),
        ("uart_pin = \"y_uart\"", "uart_port = \"!ttyAMA1\"", "`uart_port`", "cannot invert a UART"),
        ("\"z_cs\"", "\"!z_cs\"", "`select_pin`", "low level only"),
        ("\"z_cs\"", "\"z_dir\"", "`select_pin`", "already has a use"),
        ("axis = \"z\"", "axis = \"w\"", "`axis`", "no `w`"),
        ("kind = \"tmc5160\"", "kind = \"tmc9\"", "", "unknown variant `tmc9`"),
        ("axis = \"z\"", "axes = \"z\"", "", "unknown field `axes`"),
        ("axis = \"x\", hz", "axis = \"w\", hz", "`axis`", "no `w`"),
        ("hz = 43.5", "hz = 0.0", "`y`", "not above zero"),
        ("heater = \"extruder\"", "heater = \"oven\"", "`heater`", "no `oven`"),
        ("name = \"arm\"", "name = \"an arm\"", "`name`", "`an arm` is not a name"),
        ("name = \"dots\"", "name = \"\"", "`name`", "`` is not a name"),
        ("count = 8", "count = 1001", "`count`", "too many"),
        ("count = 4", "count = 1001", "`count`", "too many"),
        ("drive_current = 16", "drive_current = 32", "`drive_current`", "not a current"),
        ("yielding = 0.9", "yielding = 1.1", "`yielding`", "more than all"),
        ("conversion_ms = 750", "conversion_ms = 1000000001", "`conversion_ms`", "out of range"),
        ("damping_ratio = 0.1", "damping_ratio = 1.0", "`x`", "does not ring"),
        ("rate_off_percent = 0.4", "rate_off_percent = 40.0", "`rate_off_percent`", "so far off"),
        ("encoder_mm = 1.44", "encoder_mm = 0.0", "`encoder_mm`", "not above zero"),
        ("max_pulse_us = 2000.0", "max_pulse_us = 900.0", "`max_pulse_us`", "not above min_pulse_us"),
        ("name = \"spidev1.0\"", "name = \"spidev0.0\"", "`name`", "two have the name `spidev0.0`"),
        (
            "name = \"spidev1.0\"",
            "name = \"spidev1.0\"\ntrace_pins = [\"x_dir\"]",
            "`trace_pins`",
            "`x_dir` is not a pin",
        ),
        ("seed = 1", "seed = = 1", "`seed`", ""),
        ("[[25.0, 100000.0], [150", "[[25.0, 100000.0],\n[true", "`points_celsius_ohm`", ""),
    ] {
        let error = error_of(from, to);
        assert!(error.starts_with("my.toml"), "{error}");
        assert!(error.contains(key), "{error}");
        assert!(error.contains(cause), "{error}");
        assert!(!error.contains('\n'), "{error}");
    }
}

/// The error of an example of the documentation with its first `from` replaced by `to`.
fn error_of_example(heading: &str, from: &str, to: &str) -> String {
    let text = example(heading);
    assert!(text.contains(from), "{from}");
    SimConfig::parse(&text.replacen(from, to, 1), "my.toml").map_or_else(|error| error.to_string(), |_| String::new())
}

#[test]
fn what_the_examples_have_is_checked_as_well() {
    let (quad, delta) = ("Four Z motors", "A delta printer");
    let (chamber, led) = ("A chamber with a fan", "An RGBW strip");
    for (heading, from, to, key, cause) in [
        (quad, "at_mm = [-30.0, 230.0]\n", "", "`at_mm`", "the other motors of the z axis have one"),
        (quad, "name = \"z3\"", "name = \"lift\"", "`at_mm`", "only a motor of the z axis"),
        (quad, "[-30.0, 230.0]", "[nan, 230.0]", "`at_mm`", "out of range"),
        (delta, "arm_mm = 215.0", "arm_mm = 100.0", "`arm_mm`", "does not reach"),
        (delta, "radius_mm = 105.0", "radius_mm = 0", "`radius_mm`", "not above zero"),
        (delta, "[delta]", "[delta]\nangles_degrees = [90, 210, 91]", "`angles_degrees`", "at one place"),
        (delta, "name = \"c\"", "name = \"d\"", "", "there is no axis `c`"),
        (delta, "endstop_at = \"max\"\n", "", "`endstop_at`", "upper ends"),
        (delta, "travel_mm = 420.0\nstart_mm = 380.0", "travel_mm = 150.0", "`travel_mm`", "carriages are at 187.6"),
        (chamber, "cools = \"chamber\"", "cools = \"oven\"", "`cools`", "no `oven`"),
        (chamber, "cools = \"chamber\"\n", "", "`cooling_w_per_k`", "cools nothing"),
        (chamber, "cools = \"extruder\"", "cools = \"chamber\"", "`cools`", "two fans cool `chamber`"),
        (chamber, "pin = \"bed_heater\"\n", "", "`pin`", "klippy's heater of this name has one"),
        (led, "pin = \"led\"\n", "", "`pin`", "it has none"),
        (led, "\"shelf_red\"", "\"shelf_blue\"", "`blue_pin`", "already has a use"),
    ] {
        let error = error_of_example(heading, from, to);
        assert!(error.starts_with("my.toml") && error.contains(key) && error.contains(cause), "{cause}: {error}");
    }
}

/// The words that an error offers instead of an unknown word.
fn offered(toml: &str) -> Vec<String> {
    let Err(error) = SimConfig::parse(toml, "my.toml") else { panic!("accepted {toml}") };
    let error = error.to_string();
    let Some((_, offered)) = error.split_once(", expected ") else { panic!("{error}") };
    offered.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

#[test]
fn the_documentation_has_every_kind_and_every_key() {
    // A section ends at the next heading.
    let has = |heading: &str, key: &str| {
        let Some((_, section)) = DOCUMENTATION.split_once(&format!("\n{heading}\n")) else {
            panic!("there is no `{heading}`");
        };
        let section = section.split("\n##").next().unwrap_or_default();
        let mut words = section.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
        assert!(words.any(|word| word == key), "{key} is not in `{heading}`");
    };
    for key in offered("nobody = 1") {
        has("## Description files", &key);
    }
    for (table, heading) in [
        ("[limits]", "### `[limits]`"),
        ("[[axis]]", "### `[[axis]]`"),
        ("[[heater]]", "### `[[heater]]`"),
        ("[[fan]]", "### `[[fan]]`"),
        ("[[led]]", "### `[[led]]`, `[[output]]`, `[[input]]`, `[[analog]]`"),
        ("[[input]]", "### `[[led]]`, `[[output]]`, `[[input]]`, `[[analog]]`"),
        ("[[analog]]", "### `[[led]]`, `[[output]]`, `[[input]]`, `[[analog]]`"),
        ("[[mcu]]", "### `[[mcu]]`"),
        ("[[carriage]]", "### `[[carriage]]`"),
        ("[kinematics]\nkind = \"deltesian\"", "### `[kinematics]`"),
        ("[kinematics]\nkind = \"rotary_delta\"", "### `[kinematics]`"),
        ("[kinematics]\nkind = \"winch\"", "### `[kinematics]`"),
        ("[delta]", "### `[delta]`"),
        ("[bed]", "### `[bed]`"),
        ("[[spi_bus]]", "### `[[spi_bus]]`, `[[i2c_bus]]`"),
        ("[[i2c_bus]]", "### `[[spi_bus]]`, `[[i2c_bus]]`"),
        ("[[part]]\nkind = \"accelerometer\"\n[part.x]", "### accelerometer"),
        ("[[part]]\nkind = \"hx71x\"\n[part.cell]", "### hx71x"),
    ] {
        offered(&format!("{table}\nnobody = 1")).iter().for_each(|key| has(heading, key));
    }
    for kind in offered("[kinematics]\nkind = \"nobody\"") {
        has("### `[kinematics]`", &kind);
    }
    let kinds = offered("[[part]]\nkind = \"nobody\"");
    assert!(kinds.len() > 10, "{kinds:?}");
    // An older name of an accelerometer.
    for kind in kinds.into_iter().filter(|kind| kind != "adxl345") {
        let keys = offered(&format!("[[part]]\nkind = \"{kind}\"\nnobody = 1"));
        // The head of the chapter describes the keys for a chip's bus.
        let own = keys.iter().filter(|key| !["bus", "select_pin"].contains(&key.as_str()));
        own.for_each(|key| has(&format!("### {kind}"), key));
    }
    has("## Parts", "bus");
    has("## Parts", "select_pin");
}

#[test]
fn corexy_needs_three_homed_axes() {
    let refused =
        |text: &str| SimConfig::parse(text, "my.toml").map_or_else(|error| error.to_string(), |_| "accepted".into());
    let corexy = example("A CoreXY printer");
    assert_eq!(refused(&corexy), "accepted");
    for (from, to, part) in [
        ("name = \"z\"", "name = \"w\"", "key `corexy`: there is no axis `z` with an `endstop_pin`: add it"),
        ("endstop_pin = \"x_endstop\"\n", "", "key `corexy`: there is no axis `x` with an `endstop_pin`: add it"),
    ] {
        assert!(corexy.contains(from), "{from}");
        let error = refused(&corexy.replacen(from, to, 1));
        assert!(error.contains(part), "{error}");
    }
    let delta = refused(&format!("corexy = true\n{}", example("A delta printer")));
    assert!(delta.contains("remove `[delta]`"), "{delta}");
}

#[test]
fn an_empty_description_is_a_board_without_pins() {
    let config = SimConfig::parse("", "empty.toml");
    assert!(config.is_ok_and(|config| config.axes.is_empty()));
}

#[test]
fn a_description_of_too_many_parts_is_refused_at_once() {
    let part = |n| format!("[[spi_bus]]\nname = \"b{n}\"\n[[part]]\nkind = \"loopback\"\nbus = \"b{n}\"\n");
    let parts = |count: u32| (0..count).map(part).collect::<String>();
    assert!(SimConfig::parse(&parts(100), "my.toml").is_ok());
    let error = SimConfig::parse(&parts(1001), "my.toml").map(drop).unwrap_err();
    assert_eq!(error.to_string(), "my.toml: there are 1001 parts: 1000 at most");
}
