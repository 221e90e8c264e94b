// SPDX-License-Identifier: GPL-3.0-or-later
//! A user's probes on the simulated printer: homing, probing, the mesh of the bed.

use serde_json::Value;

use super::checkout;
use super::klippy::{with, without};
use super::printer::Printer;

/// Length of a step of the z axis.
pub const STEP_MM: f64 = 1.0 / 400.0;
/// The travel of the x and y axis.
const TRAVEL_MM: f64 = 220.0;

/// The height of the default printer's bed. By `[bed]` it changes by 0.12 mm along x and by -0.08 mm along y. It is 0.1
/// mm lower at the corners than in the middle, which is at 0.
pub fn bed_mm(x_mm: f64, y_mm: f64) -> f64 {
    let (u, v) = (x_mm / TRAVEL_MM - 0.5, y_mm / TRAVEL_MM - 0.5);
    0.12 * u - 0.08 * v - 0.2 * (u * u + v * v)
}

/// The configuration with the z axis homed by the probe, in the middle of the bed.
fn homed_by_probe(config: &str) -> String {
    let config = config.replace("endstop_pin: z_endstop", "endstop_pin: probe:z_virtual_endstop");
    let (before, z) = config.split_once("[stepper_z]\n").unwrap();
    let z = z.replacen("position_endstop: 0\n", "", 1);
    format!("{before}[stepper_z]\n{z}\n[safe_z_home]\nhome_xy_position: 110, 110\nz_hop: 10\n")
}

/// The number after a text.
fn number(said: &str, before: &str) -> f64 {
    let (_, after) = said.split_once(before).unwrap_or_else(|| panic!("no `{before}` in\n{said}"));
    let end = after.find(|c: char| !(c.is_ascii_digit() || ".-".contains(c))).unwrap_or(after.len());
    after[..end].parse().unwrap_or_else(|_| panic!("no number behind `{before}` in\n{said}"))
}

/// The result of a PROBE of the bed: place and height.
pub fn probed(printer: &mut Printer, probe: &str) -> [f64; 3] {
    printer.gcode(probe);
    let position = printer.object("probe")["last_probe_position"].clone();
    // klippy calculates them from steps.
    [0, 1, 2].map(|axis| (position[axis].as_f64().unwrap() * 1e6).round() / 1e6)
}

/// The largest distance between the points of the probed mesh and the bed.
fn mesh_fault_mm(printer: &mut Printer) -> f64 {
    let mesh = printer.object("bed_mesh");
    let corner = |key: &str| [0, 1].map(|axis| mesh[key][axis].as_f64().unwrap());
    let (min, max) = (corner("mesh_min"), corner("mesh_max"));
    let rows: Vec<Vec<f64>> = mesh["probed_matrix"].as_array().unwrap().iter().map(numbers).collect();
    assert_eq!((rows.len(), rows[0].len()), (5, 5));
    let place = |axis: usize, point: usize| min[axis] + (max[axis] - min[axis]) * point as f64 / 4.0;
    let points = (0..5).flat_map(|y| (0..5).map(move |x| (x, y)));
    points.fold(0.0, |worst: f64, (x, y)| worst.max((rows[y][x] - bed_mm(place(0, x), place(1, y))).abs()))
}

pub fn numbers(list: &Value) -> Vec<f64> {
    list.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
}

#[test]
fn klippy_probes_the_bed_and_its_mesh_is_the_shape_of_the_bed() {
    let Some(checkout) = checkout("klippy_probes_the_bed_and_its_mesh_is_the_shape_of_the_bed") else { return };
    let mut printer = Printer::start(&checkout);
    printer.gcode("G28\nG1 Z8 F600\nQUERY_PROBE");
    assert_eq!(printer.object("probe")["last_query"], 0);
    for (x, y) in [(40.0, 60.0), (150.0, 30.0)] {
        printer.gcode(&format!("G1 X{x} Y{y} Z8 F9000"));
        let [at_x, at_y, z] = probed(&mut printer, "PROBE");
        assert_eq!([at_x, at_y], [x + 24.0, y - 8.0]);
        assert!((z - bed_mm(at_x, at_y)).abs() < 2.0 * STEP_MM, "{z} {}", bed_mm(at_x, at_y));
        printer.gcode("QUERY_PROBE");
        assert_eq!(printer.object("probe")["last_query"], 1, "it stands on the bed");
        printer.gcode("G1 Z8 F600");
    }
    let said = printer.gcode("PROBE_ACCURACY SAMPLES=5");
    let range = number(&said, "range ");
    assert!(range < 2.0 * STEP_MM, "{said}");
    let said = printer.gcode("BED_MESH_CALIBRATE");
    let fault = mesh_fault_mm(&mut printer);
    assert!(fault < 2.0 * STEP_MM, "{fault}\n{said}\n{}", printer.log());
}

#[test]
fn klippy_homes_the_z_axis_by_the_probe() {
    let Some(checkout) = checkout("klippy_homes_the_z_axis_by_the_probe") else { return };
    let mut printer = Printer::start_with(&checkout, |config| homed_by_probe(&config));
    printer.gcode("G28\nG1 Z8 F600");
    // The height is 0 at the place of homing, so all other heights have this offset.
    let datum = bed_mm(110.0 + 24.0, 110.0 - 8.0);
    printer.gcode("G1 X20 Y180 F9000");
    let [x, y, z] = probed(&mut printer, "PROBE");
    assert!((z - (bed_mm(x, y) - datum)).abs() < 3.0 * STEP_MM, "{z} {}", bed_mm(x, y) - datum);
}

#[test]
fn klippy_homes_and_probes_with_a_bltouch() {
    let Some(checkout) = checkout("klippy_homes_and_probes_with_a_bltouch") else { return };
    let mut printer =
        Printer::start_with(&checkout, |config| homed_by_probe(&with(&without(&config, "probe"), "bltouch", "")));
    printer.gcode("BLTOUCH_DEBUG COMMAND=pin_up\nBLTOUCH_DEBUG COMMAND=touch_mode\nQUERY_PROBE");
    assert_eq!(printer.object("probe")["last_query"], 1, "in touch mode the line tells that the pin is up");
    printer.gcode("BLTOUCH_DEBUG COMMAND=pin_down\nBLTOUCH_DEBUG COMMAND=touch_mode\nQUERY_PROBE");
    assert_eq!(printer.object("probe")["last_query"], 0, "and down");
    printer.gcode("BLTOUCH_DEBUG COMMAND=reset");
    printer.gcode("G28\nG1 Z8 F600");
    let datum = bed_mm(110.0 - 28.0, 110.0 + 12.0);
    for (x, y) in [(200.0, 20.0), (60.0, 190.0)] {
        printer.gcode(&format!("G1 X{x} Y{y} Z8 F9000"));
        let [at_x, at_y, z] = probed(&mut printer, "PROBE");
        assert_eq!([at_x, at_y], [x - 28.0, y + 12.0]);
        assert!((z - (bed_mm(at_x, at_y) - datum)).abs() < 3.0 * STEP_MM, "{z} {}", bed_mm(at_x, at_y) - datum);
    }
    let said = printer.gcode("G1 Z8 F600\nPROBE_ACCURACY SAMPLES=3");
    assert!(number(&said, "range ") < 2.0 * STEP_MM, "{said}");
    assert!(!printer.host_log().contains("BLTouch failed"));
}

#[test]
fn klippy_tells_a_bltouch_whose_pin_is_stuck() {
    let Some(checkout) = checkout("klippy_tells_a_bltouch_whose_pin_is_stuck") else { return };
    for (jam, error) in [("up", "Probe triggered prior to movement"), ("down", "BLTouch failed to verify sensor state")]
    {
        let stuck =
            |board: String| board.replace("kind = \"bltouch\"\n", &format!("kind = \"bltouch\"\njams = \"{jam}\"\n"));
        let mut printer = Printer::start_on(&checkout, stuck, |config| with(&without(&config, "probe"), "bltouch", ""));
        printer.gcode("G28\nG1 Z8 F600");
        let said = printer.refused("PROBE");
        assert!(said.contains(error), "{jam}: {said}");
        assert_eq!(printer.state(), "ready");
    }
}

/// The counts of the default printer's load cell per gram.
const COUNTS_PER_GRAM: f64 = 420.0;
/// Its counts without the nozzle on the bed: -21000, and 85 g for the hot end.
const TARE_COUNTS: f64 = -21_000.0 + 85.0 * COUNTS_PER_GRAM;
/// The force of the nozzle in the bed, per millimeter.
const GRAMS_PER_MM: f64 = 4000.0;

#[test]
fn klippy_calibrates_a_load_cell() {
    let Some(checkout) = checkout("klippy_calibrates_a_load_cell") else { return };
    // klippy does not know the calibration.
    let mut printer = Printer::start_with(&checkout, |config| {
        let lines = config
            .lines()
            .filter(|line| !line.starts_with("counts_per_gram") && !line.starts_with("reference_tare_counts"));
        lines.collect::<Vec<&str>>().join("\n")
    });
    let said = printer.gcode("LOAD_CELL_DIAGNOSTIC");
    let rate = number(&said, "Measured samples per second: ");
    assert!((79.0..81.0).contains(&rate), "{said}");
    assert!(said.contains("Saturated samples: 0"), "{said}");
    assert!(number(&said, "Unique values: ") > 100.0, "{said}");
    // The other ADC, on SPI: the computer times none of its lines.
    let said = printer.gcode("LOAD_CELL_DIAGNOSTIC LOAD_CELL=ads1220");
    let rate = number(&said, "Measured samples per second: ");
    assert!((40.0..46.0).contains(&rate) && said.contains("reported no errors"), "{said}");
    let said = printer.gcode("LOAD_CELL_READ LOAD_CELL=ads1220");
    assert!(said.contains("(0.14%)"), "12000 of 2^23 counts: {said}");
    printer.gcode("G28\nG1 X110 Y110 Z5 F6000\nM400\nLOAD_CELL_CALIBRATE");
    let tare = number(&printer.gcode("TARE"), "% (");
    assert!((tare - TARE_COUNTS).abs() < 60.0, "{tare}");
    // A kilogram of force: the nozzle is a quarter of a millimeter deep in the bed.
    let depth_mm = 0.25;
    let z = bed_mm(110.0, 110.0) - depth_mm;
    // klippy's average has the samples of the last batch (0.1 s) before the command too: the nozzle rests first.
    let rest = "G4 P500\nM400";
    printer.gcode(&format!("G1 Z{z} F60\n{rest}"));
    printer.gcode(&format!("CALIBRATE GRAMS={}", GRAMS_PER_MM * depth_mm));
    printer.gcode("ACCEPT");
    let cell = printer.object("load_cell");
    let counts_per_gram = cell["counts_per_gram"].as_f64().unwrap();
    // The depth is correct to two steps of the z axis: one for homing, and one for the move.
    assert!((counts_per_gram / COUNTS_PER_GRAM - 1.0).abs() < 2.0 * STEP_MM / depth_mm, "{counts_per_gram}");
    let read = |printer: &mut Printer| {
        let said = printer.gcode("LOAD_CELL_READ");
        said.trim_start_matches("// ").split('g').next().unwrap().parse::<f64>().unwrap()
    };
    let grams = read(&mut printer);
    assert!((grams - 1000.0).abs() < 1.0, "{grams}");
    printer.gcode(&format!("G1 Z5 F600\n{rest}"));
    let grams = read(&mut printer);
    assert!(grams.abs() < 1.0, "{grams}");
}

/// Puts the default printer's load cell on an SPI bus of its own.
pub fn on_spi(board: String) -> String {
    let lines = "dout_pin = \"load_cell_dout\"\nsclk_pin = \"load_cell_sclk\"\n";
    assert!(board.contains(lines));
    board.replace(lines, "bus = \"spidev4.0\"\n") + "\n[[spi_bus]]\nname = \"spidev4.0\"\n"
}

#[test]
fn klippy_reads_a_load_cell_on_an_spi_bus() {
    let Some(checkout) = checkout("klippy_reads_a_load_cell_on_an_spi_bus") else { return };
    let mut printer = Printer::start_on(&checkout, on_spi, |config| {
        assert!(config.contains("\ndout_pin: spidev4.0/miso\nsclk_pin: spidev4.0\n"), "{config}");
        config
    });
    // Twice: klippy ends the measurements, and begins them anew.
    for _ in 0..2 {
        let said = printer.gcode("LOAD_CELL_DIAGNOSTIC");
        let rate = number(&said, "Measured samples per second: ");
        assert!((79.0..81.0).contains(&rate), "{said}");
        assert!(said.contains("reported no errors") && said.contains("Saturated samples: 0"), "{said}");
        assert!(number(&said, "Unique values: ") > 100.0, "{said}");
    }
    let said = printer.gcode("LOAD_CELL_READ");
    let percent = 100.0 * TARE_COUNTS / f64::from(1 << 23);
    assert!((number(&said, "g (") - percent).abs() < 0.01, "{said}");
}

/// The configuration with the load cell as its probe.
fn probed_by_the_nozzle(config: &str) -> String {
    with(&without(&without(config, "probe"), "load_cell"), "load_cell_probe", "")
}

/// Probes by taps. Heights count from `datum_mm`.
#[track_caller]
fn tap(printer: &mut Printer, datum_mm: f64, depths_mm: std::ops::Range<f64>) {
    for (x, y) in [(110.0, 110.0), (30.0, 170.0)] {
        printer.gcode(&format!("G1 X{x} Y{y} Z2 F6000\nM400"));
        printer.gcode("PROBE PROBE_SPEED=1");
        let position = printer.object("probe")["last_probe_position"].clone();
        let depth_mm = bed_mm(x, y) - datum_mm - position[2].as_f64().unwrap();
        assert!(depths_mm.contains(&depth_mm), "{depth_mm}");
    }
}

/// The trigger is at 75 g, 0.019 mm deep. At 1 mm/s there is a sample for each 0.0125 mm.
const TAP_MM: std::ops::Range<f64> = 0.010..0.060;

#[test]
fn klippy_probes_by_a_tap_of_the_nozzle_on_the_load_cell() {
    let Some(checkout) = checkout("klippy_probes_by_a_tap_of_the_nozzle_on_the_load_cell") else { return };
    let mut printer = Printer::start_with(&checkout, |config| probed_by_the_nozzle(&config));
    printer.gcode("G28");
    tap(&mut printer, 0.0, TAP_MM);
}

#[test]
fn klippy_homes_and_probes_by_taps_on_a_load_cell_on_an_spi_bus() {
    let Some(checkout) = checkout("klippy_homes_and_probes_by_taps_on_a_load_cell_on_an_spi_bus") else { return };
    let mut printer = Printer::start_on(&checkout, on_spi, |config| {
        let config = homed_by_probe(&probed_by_the_nozzle(&config));
        let config = config.replace("\n[stepper_z]\n", "\n[stepper_z]\nhoming_speed: 2\nsecond_homing_speed: 1\n");
        assert!(config.contains("\ndout_pin: spidev4.0/miso\nsclk_pin: spidev4.0\n"), "{config}");
        config
    });
    for _ in 0..2 {
        printer.gcode("G28\nG1 Z5 F600\nM400");
        // The height is 0 where the nozzle was homed: in the bed, as deep as a tap. A tap has the same depth.
        tap(&mut printer, bed_mm(110.0, 110.0), -0.050..0.050);
    }
    assert!(!printer.log().contains("HX71x sclk"), "{}", printer.log());
}

#[test]
fn klippy_calibrates_an_eddy_current_probe_and_probes_with_it() {
    let Some(checkout) = checkout("klippy_calibrates_an_eddy_current_probe_and_probes_with_it") else { return };
    let on = |config: String| with(&without(&config, "probe"), "probe_eddy_current coil", "");
    let mut printer = Printer::start_with(&checkout, on);
    printer.gcode("G28\nG1 X110 Y110 Z10 F6000\nM400");
    let said = printer.gcode("LDC_CALIBRATE_DRIVE_CURRENT CHIP=coil");
    assert_eq!(number(&said, "reg_drive_current: "), 16.0);
    // A person lowers the nozzle until it grips a sheet of paper. The test uses the known height of the bed.
    let down = bed_mm(110.0, 110.0) - 1.0;
    printer.gcode("G1 X110 Y110 Z1 F600\nPROBE_EDDY_CURRENT_CALIBRATE CHIP=coil");
    printer.gcode(&format!("TESTZ Z={down}"));
    let said = printer.gcode("ACCEPT");
    let faults = ["Frequency stops", "too noisy", "Failed calibration"];
    assert!(!faults.iter().any(|fault| said.contains(fault)), "{said}");
    let pending = printer.object("configfile")["save_config_pending_items"]["probe_eddy_current coil"].clone();
    let table = pending["calibrate"].as_str().unwrap().to_owned();
    let pairs: Vec<[f64; 2]> = table
        .split(',')
        .map(|pair| pair.trim().split_once(':').unwrap())
        .map(|(mm, hz)| [mm.parse().unwrap(), hz.parse().unwrap()])
        .collect();
    assert!(pairs.len() > 90, "{table}");
    assert!(pairs.windows(2).all(|pair| pair[0][0] < pair[1][0] && pair[0][1] > pair[1][1]), "{table}");
    // The coil is 2.5 mm above the nozzle, and beside it, where the bed has another height.
    for [mm, hz] in &pairs {
        let distance = mm + 2.5;
        let expected = 2_900_000.0 + 400_000.0 * (-distance / 2.5).exp();
        assert!((hz - expected).abs() < 2_500.0, "{mm} mm: {hz} {expected}");
    }

    // With the table, and homed by the coil.
    let table = table.replace('\n', "");
    drop(printer);
    let mut printer = Printer::start_with(&checkout, |config| {
        let keys = format!("calibrate: {table}");
        homed_by_probe(&with(&without(&config, "probe"), "probe_eddy_current coil", &keys))
    });
    let datum = bed_mm(110.0 + 20.0, 110.0 + 18.0);
    printer.gcode("G28\nG1 Z5 F600\nM400");
    for (x, y) in [(110.0, 110.0), (30.0, 170.0), (180.0, 60.0)] {
        printer.gcode(&format!("G1 X{x} Y{y} Z5 F6000\nM400"));
        printer.gcode("PROBE");
        let position = printer.object("probe")["last_probe_position"].clone();
        let [at_x, at_y, z] = [0, 1, 2].map(|axis| position[axis].as_f64().unwrap());
        let expected = bed_mm(at_x, at_y) - datum;
        assert!((z - expected).abs() < 0.02, "{x} {y}: {z} {expected}");
    }
    // By a tap: the bed yields to the nozzle, and the frequency stops rising.
    for (x, y) in [(110.0, 110.0), (40.0, 150.0)] {
        printer.gcode(&format!("G1 X{x} Y{y} Z4 F6000\nM400"));
        printer.gcode("PROBE METHOD=tap TAP_THRESHOLD=20000");
        let z = printer.object("probe")["last_probe_position"][2].as_f64().unwrap();
        let expected = bed_mm(x, y) - datum;
        assert!((z - expected).abs() < 0.03, "{x} {y}: {z} {expected}");
    }
}
