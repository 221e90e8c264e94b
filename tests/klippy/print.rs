// SPDX-License-Identifier: GPL-3.0-or-later
//! A print from the virtual SD card, with the G-code of slicers.

use super::checkout;
use super::printer::Printer;

/// The printer.cfg of a user who prints in this way, with an extruder that works cold.
fn configure(config: String) -> String {
    let cold = config.replace("min_extrude_temp: 170", "min_extrude_temp: 0\npressure_advance: 0.03");
    assert_ne!(cold, config);
    format!(
        "{cold}\n[virtual_sdcard]\npath: .\n\n[pause_resume]\n\n[gcode_arcs]\nresolution: 0.2\n\n\
         [firmware_retraction]\nretract_length: 0.8\nretract_speed: 40\nunretract_extra_length: 0.1\n\
         unretract_speed: 20\n\n[skew_correction]\n\n[exclude_object]\n"
    )
}

/// The bed's diagonals AC and BD and its side AD, measured on a printed square. The square is askew by 0.6 degrees.
const SKEW: [f64; 3] = [140.7, 142.1, 100.0];

/// How far x must move for each mm of y (`calc_skew_factor` of extras/skew_correction.py): the cotangent of the angle
/// between AD and AB, by the law of cosines.
fn skew_factor([ac, bd, ad]: [f64; 3]) -> f64 {
    let ab = (2.0 * ac * ac + 2.0 * bd * bd - 4.0 * ad * ad).sqrt() / 2.0;
    let cosine = (ac * ac - ab * ab - ad * ad) / (2.0 * ab * ad);
    cosine.asin().tan()
}

/// A square of 20 mm at a place: four lines with 0.7 mm of filament each.
fn square(x: f64, y: f64) -> String {
    let corner = |dx: f64, dy: f64| format!("G1 X{} Y{} E0.7 F4800\n", x + dx, y + dy);
    format!("G0 X{x} Y{y} F9000\nG11\n")
        + &corner(20.0, 0.0)
        + &corner(20.0, 20.0)
        + &corner(0.0, 20.0)
        + &corner(0.0, 0.0)
        + "G10\n"
}

/// A full circle, with two arcs in each direction.
fn circle(x: f64, y: f64) -> String {
    let right = x + 20.0;
    format!(
        "G0 X{x} Y{y} F9000\nG11\nG2 X{right} Y{y} I10 J0 E1.1 F4800\nG3 X{x} Y{y} I-10 J0 E1.1\n\
         G2 X{right} Y{y} I10 J0 E1.1\nG2 X{x} Y{y} I-10 J0 E1.1\nG10\n"
    )
}

const LAYERS: usize = 3;
/// The layer with the pause, which comes after the square.
const PAUSED_IN: usize = 1;

#[test]
fn a_print_from_the_virtual_sd_card_ends_at_the_exact_place() {
    let Some(checkout) = checkout("a_print_from_the_virtual_sd_card_ends_at_the_exact_place") else { return };
    let mut printer = Printer::start_on(&checkout, |board| board, configure);
    let [ac, bd, ad] = SKEW;
    let mut part = format!(
        "EXCLUDE_OBJECT_DEFINE NAME=SQUARE CENTER=50,50\nEXCLUDE_OBJECT_DEFINE NAME=CIRCLE CENTER=120,100\n\
         EXCLUDE_OBJECT_DEFINE NAME=TOWER CENTER=160,60\nG28\nSET_SKEW XY={ac},{bd},{ad}\n\
         SET_PRESSURE_ADVANCE ADVANCE=0.06 SMOOTH_TIME=0.04\nM83\nG10\n"
    );
    for layer in 0..LAYERS {
        part += &format!("G1 Z{:.2} F600\n", 0.3 + 0.2 * layer as f64);
        for (name, outline) in [
            ("SQUARE", square(40.0, 40.0) + &square(45.0, 45.0)),
            ("CIRCLE", circle(110.0, 100.0)),
            ("TOWER", square(150.0, 50.0)),
        ] {
            part += &format!("EXCLUDE_OBJECT_START NAME={name}\n{outline}EXCLUDE_OBJECT_END NAME={name}\n");
            if (layer, name) == (PAUSED_IN, "SQUARE") {
                part += "PAUSE\n";
            }
        }
    }
    part += "G11\nG1 X180 Y123 Z20 F6000\n";
    printer.write("part.gcode", &part);
    printer.gcode("SDCARD_PRINT_FILE FILENAME=part.gcode");

    printer.until_object("pause_resume", "is_paused", true);
    assert_eq!(printer.object("print_stats")["state"], "paused");
    // The user looks at the nozzle and gives up the tower.
    printer.gcode("G90\nG1 Z30 F900\nG1 X10 Y200 F9000\nG1 E-2 F1200\nG1 E2 F1200\nM400");
    printer.gcode("EXCLUDE_OBJECT NAME=TOWER");
    assert_eq!(printer.probe().axis("z").unwrap().position_mm, 30.0);
    printer.gcode("RESUME");
    printer.until_object("print_stats", "state", "complete");
    printer.gcode("M400");

    let excluded = printer.object("exclude_object")["excluded_objects"].clone();
    assert_eq!(excluded, serde_json::json!(["TOWER"]));
    let x = 180.0 - 123.0 * skew_factor(SKEW);
    assert!((180.0 - x).abs() > 1.0, "there is no skew to be seen");
    // Each layer has two squares and a circle; the first layer also has the tower. G11 returns each outline's filament
    // with
    // 0.1 mm more (also once at the end, for the first G10). The tower's other outlines are omitted.
    let outlines = 3 * LAYERS + 1;
    let filament = LAYERS as f64 * (8.0 * 0.7 + 4.0 * 1.1) + 4.0 * 0.7 + 0.1 * (outlines + 1) as f64;
    for (name, mm, step_mm) in
        [("x", x, 0.0125), ("y", 123.0, 0.0125), ("z", 20.0, 0.0025), ("extruder", filament, 0.01)]
    {
        let axis = printer.probe().axis(name).unwrap();
        assert!((axis.position_mm - mm).abs() <= step_mm, "{name}: {} mm, not {mm}", axis.position_mm);
        assert_eq!(axis.lost_steps, 0, "{name}");
    }
    // The endstops agree: they close at the place from which the print was counted.
    printer.gcode("SET_SKEW CLEAR=1\nG28\nG1 X40 Y40 Z10 F6000\nM400");
    for (name, mm, step_mm) in [("x", 40.0, 0.0125), ("y", 40.0, 0.0125), ("z", 10.0, 0.0025)] {
        let position_mm = printer.probe().axis(name).unwrap().position_mm;
        assert!((position_mm - mm).abs() <= step_mm, "{name}: {position_mm} mm");
    }
}
