// SPDX-License-Identifier: GPL-3.0-or-later
//! An accelerometer on a ringing head, and klippy's search for its resonances.

use std::path::{Path, PathBuf};
use std::process;
use std::time::{Duration, Instant};
use std::{fs, thread};

use super::checkout;
use super::klippy::{UNHOMED, WHERE_IT_STANDS, rest};
use super::printer::Printer;

/// The resonances of the built-in printer.
const RESONANCES_HZ: [(&str, f64); 2] = [("x", 57.0), ("y", 43.5)];
/// The chip's own sample rate: 400 samples a second and 0.4 % more.
const RATE_HZ: f64 = 400.0 * 1.004;
const G: f64 = 9806.65;

/// A printer with a chip that takes 400 samples a second, far more than the resonances need.
fn start(checkout: &Path) -> Printer {
    Printer::start_with(checkout, |config| config.replace("[adxl345]\n", "[adxl345]\nrate: 400\n") + UNHOMED)
}

/// A unique name for klippy's files, which it writes to /tmp.
fn name(what: &str) -> String {
    format!("pinion_{what}_{}", process::id())
}

/// A file of klippy's, moved away from /tmp: the names of its columns, and its lines.
fn table(file: String) -> (Vec<String>, Vec<Vec<f64>>) {
    let path = PathBuf::from(file);
    // A separate process writes it. It is complete when it stops growing behind a whole line.
    let end = Instant::now() + Duration::from_secs(60);
    let (mut text, mut before) = (String::new(), usize::MAX);
    while text.len() != before || !text.ends_with('\n') {
        assert!(Instant::now() < end, "{} is not written", path.display());
        thread::sleep(Duration::from_millis(500));
        before = text.len();
        text = fs::read_to_string(&path).unwrap_or_default();
    }
    fs::remove_file(&path).unwrap();
    let mut lines = text.lines();
    let columns = lines.next().unwrap().trim_start_matches('#').split(',').map(str::to_owned).collect();
    let numbers = |line: &str| line.split(',').map_while(|number| number.parse().ok()).collect();
    (columns, lines.map(numbers).collect())
}

/// The maximum of a column of a spectrum: between the bins, on the parabola through three of them.
pub fn peak(file: String, column: &str) -> f64 {
    let (columns, lines) = table(file);
    let column = columns.iter().position(|name| name == column).unwrap();
    let power = |bin: usize| lines[bin][column].ln();
    let top = (1..lines.len() - 1).max_by(|a, b| power(*a).total_cmp(&power(*b))).unwrap();
    let (left, middle, right) = (power(top - 1), power(top), power(top + 1));
    let bin_hz = lines[top + 1][0] - lines[top][0];
    lines[top][0] + bin_hz * (left - right) / (left - 2.0 * middle + right) / 2.0
}

/// The G-code of a test around a resonance, 12 Hz to either side of it. It takes twelve seconds.
pub fn sweep(hz: f64) -> String {
    format!("FREQ_START={} FREQ_END={} HZ_PER_SEC=2", hz - 12.0, hz + 12.0)
}

#[test]
fn an_accelerometer_is_asked_and_measures_without_a_gap() {
    const SECONDS: f64 = 10.0;
    let Some(checkout) = checkout("an_accelerometer_is_asked_and_measures_without_a_gap") else { return };
    let mut printer = start(&checkout);
    let answer = printer.gcode("ACCELEROMETER_QUERY");
    let said = rest(&answer, "accelerometer values (x, y, z): ");
    let values: Vec<f64> = said.split(", ").map(|value| value.parse().unwrap()).collect();
    // The noise of a sample is 60 to 90 mm/s^2, and at most three and a half times that.
    let expected = [0.0, 0.0, G];
    assert!(values.iter().zip(expected).all(|(value, g)| (value - g).abs() < 320.0), "{said}");

    let name = name("measure");
    printer.gcode("ACCELEROMETER_MEASURE");
    printer.gcode(&format!("G4 P{}", SECONDS * 1000.0));
    printer.gcode(&format!("ACCELEROMETER_MEASURE NAME={name}"));
    let (columns, samples) = table(format!("/tmp/adxl345-{name}.csv"));
    assert_eq!(columns, ["time", "accel_x", "accel_y", "accel_z"]);
    let times: Vec<f64> = samples.iter().map(|sample| sample[0]).collect();
    let seconds = times[times.len() - 1] - times[0];
    assert!(seconds >= SECONDS - 0.1, "{seconds}");
    // klippy measures the chip's own sample rate. A lost sample would lower it.
    let rate_hz = (times.len() - 1) as f64 / seconds;
    assert!((rate_hz / RATE_HZ - 1.0).abs() < 0.001, "{rate_hz}");
    let widest = times.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
    assert!(widest < 1.5 / RATE_HZ, "a gap of {widest} s");
    let mean_z = samples.iter().map(|sample| sample[3]).sum::<f64>() / samples.len() as f64;
    assert!((mean_z / G - 1.0).abs() < 0.005, "{mean_z}");
}

#[test]
fn klippy_sees_each_axis_ring_at_its_resonance() {
    let Some(checkout) = checkout("klippy_sees_each_axis_ring_at_its_resonance") else { return };
    let mut printer = start(&checkout);
    printer.gcode(WHERE_IT_STANDS);
    for (axis, hz) in RESONANCES_HZ {
        let name = name("test");
        printer.gcode(&format!("TEST_RESONANCES AXIS={axis} NAME={name} {}", sweep(hz)));
        let found_hz = peak(format!("/tmp/resonances_{axis}_{name}.csv"), &format!("psd_{axis}"));
        assert!((found_hz - hz).abs() < 1.0, "{axis}: {found_hz} Hz, not {hz}");
    }
}

#[test]
fn klippy_calibrates_its_input_shaper_for_the_resonances() {
    let Some(checkout) = checkout("klippy_calibrates_its_input_shaper_for_the_resonances") else { return };
    let mut printer = start(&checkout);
    printer.gcode(WHERE_IT_STANDS);
    for (axis, hz) in RESONANCES_HZ {
        let name = name("calibrate");
        let said = printer.gcode(&format!("SHAPER_CALIBRATE AXIS={axis} NAME={name} {}", sweep(hz)));
        // The frequency of a shaper is the resonance for which it is made (extras/shaper_defs.py). Of klippy's fitted
        // shapers, "mzv" has one notch, which is on the resonance. Shapers with several notches have them beside the
        // resonance.
        let fitted = rest(&said, "Fitted shaper 'mzv' frequency = ");
        let fitted_hz: f64 = fitted.split(' ').next().unwrap().parse().unwrap();
        let found_hz = peak(format!("/tmp/calibration_data_{axis}_{name}.csv"), &format!("psd_{axis}"));
        let recommended = rest(&said, &format!("Recommended shaper_type_{axis} = "));
        assert!((found_hz - hz).abs() < 1.0, "{axis}: {found_hz} Hz, not {hz}");
        assert!((fitted_hz - hz).abs() < 1.0, "{axis}: {fitted_hz} Hz, not {hz}");
        // klippy uses its recommendation.
        let (shaper, shaper_hz) = recommended.split_once(&format!(", shaper_freq_{axis} = ")).unwrap();
        let shaper_hz: f64 = shaper_hz.trim_end_matches(" Hz").parse().unwrap();
        let in_use = printer.gcode("SET_INPUT_SHAPER");
        let in_use = rest(&in_use, &format!("shaper_type_{axis}:{shaper} shaper_freq_{axis}:"));
        let in_use_hz: f64 = in_use.split(' ').next().unwrap().parse().unwrap();
        assert!((in_use_hz - shaper_hz).abs() < 0.06, "{in_use}, not {recommended}");
    }
}
