// SPDX-License-Identifier: GPL-3.0-or-later
//! Sensors at an ADC: the temperature of a reading, as klippy calculates it.
//!
//! The numbers are those of Klipper's `klippy/extras/temperature_sensors.cfg` and `adc_temperature.py` (GPL-3.0). Each has
//! its origin there: the makers' data sheets.

use pinion_model::{NoThermistor, Thermistor};
use pinion_printer_config::{Config, Limit, Section, Trouble};

use super::description::Entry;

/// Points of a curve, in °C and ohm.
type Points = [(f64, f64)];

/// A thermistor: its name, its points, and its beta if there is one point.
const THERMISTORS: &[(&str, &Points, Option<f64>)] = &[
    ("ATC Semitec 104GT-2", &[(20.0, 126_800.0), (150.0, 1360.0), (300.0, 80.65)], None),
    ("ATC Semitec 104NT-4-R025H42G", &[(25.0, 100_000.0), (160.0, 1074.0), (300.0, 82.78)], None),
    ("EPCOS 100K B57560G104F", &[(25.0, 100_000.0), (150.0, 1641.9), (250.0, 226.15)], None),
    ("Generic 3950", &[(25.0, 100_000.0), (150.0, 1770.0), (250.0, 230.0)], None),
    ("SliceEngineering 450", &[(25.0, 500_000.0), (200.0, 3734.0), (400.0, 240.0)], None),
    ("TDK NTCG104LH104JT1", &[(25.0, 100_000.0), (50.0, 31_230.0), (125.0, 2066.0)], None),
    ("Honeywell 100K 135-104LAG-J01", &[(25.0, 100_000.0)], Some(3974.0)),
    // klippy had it until v0.12.
    ("NTC 100K beta 3950", &[(25.0, 100_000.0)], Some(3950.0)),
    ("NTC 100K MGB18-104F39050L32", &[(25.0, 100_000.0)], Some(4100.0)),
];

/// Amplifiers of thermocouples, in °C and volt.
const AMPLIFIERS: &[(&str, &Points)] = &[
    (
        "AD595",
        &[
            (0.0, 0.0027),
            (10.0, 0.101),
            (20.0, 0.2),
            (25.0, 0.25),
            (30.0, 0.3),
            (40.0, 0.401),
            (50.0, 0.503),
            (60.0, 0.605),
            (80.0, 0.81),
            (100.0, 1.015),
            (140.0, 1.42),
            (180.0, 1.817),
            (220.0, 2.213),
            (260.0, 2.614),
            (300.0, 3.022),
            (340.0, 3.434),
            (400.0, 4.057),
            (480.0, 4.896),
        ],
    ),
    (
        "AD597",
        &[
            (0.0, 0.0),
            (25.0, 0.245),
            (60.0, 0.598),
            (100.0, 1.005),
            (140.0, 1.407),
            (180.0, 1.801),
            (220.0, 2.194),
            (260.0, 2.592),
            (300.0, 2.996),
            (340.0, 3.406),
            (400.0, 4.024),
            (500.0, 5.066),
        ],
    ),
    (
        "AD8494",
        &[
            (0.0, 0.002),
            (25.0, 0.125),
            (60.0, 0.303),
            (100.0, 0.511),
            (140.0, 0.723),
            (200.0, 1.044),
            (260.0, 1.366),
            (300.0, 1.58),
            (400.0, 2.114),
            (500.0, 2.65),
        ],
    ),
    (
        "AD8495",
        &[
            (0.0, 0.003),
            (25.0, 0.125),
            (60.0, 0.301),
            (100.0, 0.504),
            (140.0, 0.705),
            (200.0, 0.999),
            (260.0, 1.295),
            (300.0, 1.497),
            (400.0, 2.01),
            (500.0, 2.529),
        ],
    ),
    (
        "AD8496",
        &[
            (0.0, 0.027),
            (25.0, 0.142),
            (60.0, 0.308),
            (100.0, 0.503),
            (140.0, 0.701),
            (200.0, 1.001),
            (260.0, 1.302),
            (300.0, 1.502),
            (400.0, 2.001),
            (500.0, 2.502),
        ],
    ),
    (
        "AD8497",
        &[
            (0.0, 0.003),
            (25.0, 0.126),
            (60.0, 0.301),
            (100.0, 0.505),
            (140.0, 0.705),
            (200.0, 0.999),
            (260.0, 1.296),
            (300.0, 1.498),
            (400.0, 2.01),
            (500.0, 2.53),
        ],
    ),
];

/// The sensors that are chips of their own.
pub(super) const CHIPS: [&str; 19] = [
    "MAX6675",
    "MAX31855",
    "MAX31856",
    "MAX31865",
    "DS18B20",
    "BME280",
    "HTU21D",
    "SHT21",
    "SI7013",
    "SI7020",
    "SI7021",
    "SHT3X",
    "AHT10",
    "AHT1X",
    "AHT2X",
    "AHT3X",
    "LM75",
    "temperature_mcu",
    "temperature_host",
];

/// Whether a sensor is one that Klipper or Kalico has, or that the configuration describes.
pub(super) fn is_known(config: &Config, name: &str) -> bool {
    let described =
        ["thermistor", "adc_temperature"].iter().any(|kind| config.section(&format!("{kind} {name}")).is_some());
    let others = ["PT1000", "PT100 INA826", "temperature_combined", "mpc_block_temperature", "mpc_ambient_temperature"];
    described
        || THERMISTORS.iter().any(|(known, ..)| *known == name)
        || AMPLIFIERS.iter().any(|(known, _)| *known == name)
        || CHIPS.contains(&name)
        || others.contains(&name)
        || config.section(name).is_some()
}

/// 0 °C in kelvin.
const KELVIN: f64 = 273.15;
/// The pull-up resistor that klippy assumes.
const PULLUP_OHM: f64 = 4700.0;

/// A platinum resistor of 1 ohm at 0 °C, by Callendar and Van Dusen.
fn platinum(celsius: f64) -> f64 {
    1.0 + 3.9083e-3 * celsius - 5.775e-7 * celsius * celsius
}

/// Every 10 °C from 0 to 490 °C, as klippy's tables have it.
fn tens() -> impl Iterator<Item = f64> {
    (0..50).map(|n| f64::from(n) * 10.0)
}

/// A sensor of a section: the keys that it adds to its heater's description; `None` if no ADC reads it.
///
/// # Errors
///
/// A number that klippy would refuse, or a sensor that it does not know.
pub(super) fn sensor(config: &Config, section: &Section, entry: Entry) -> Result<Option<Entry>, Trouble> {
    let name = section.required("sensor_type")?;
    let number = |section: &Section, key: &str, default: f64| {
        section.number(key, Limit::Any).map(|number| number.unwrap_or(default))
    };
    let pullup_ohm = section.number("pullup_resistor", Limit::Above(0.0))?.unwrap_or(PULLUP_OHM);
    let inline_ohm = section.number("inline_resistor", Limit::Min(0.0))?.unwrap_or(0.0);
    let thermistor = |entry: Entry, points: &Points, beta: Option<f64>| match Thermistor::new(points, beta, pullup_ohm)
    {
        Ok(curve) if inline_ohm > 0.0 => {
            let ohms = |celsius: f64| curve.ohm(celsius) + inline_ohm;
            fractions(entry, (-50..400).step_by(5).map(f64::from).map(|c| (c, ohms(c) / (pullup_ohm + ohms(c)))))
        }
        _ => entry
            .set("pullup_ohm", pullup_ohm)
            .rows("points_celsius_ohm", points.iter().map(|(celsius, ohm)| [*celsius, *ohm]))
            .set_if("beta_k", beta),
    };
    let volts = |entry: Entry, points: &mut dyn Iterator<Item = (f64, f64)>| {
        let volt = number(section, "adc_voltage", 5.0)?;
        let offset = number(section, "voltage_offset", 0.0)?;
        Ok(fractions(entry, points.map(|(celsius, volts)| (celsius, (volts - offset) / volt))))
    };
    if let Some(own) = config.section(&format!("thermistor {name}")) {
        let mut points = Vec::new();
        let beta = own.number("beta", Limit::Above(0.0))?;
        for n in 1..=if beta.is_some() { 1 } else { 3 } {
            let (celsius, ohm) = (format!("temperature{n}"), format!("resistance{n}"));
            own.required(&celsius).and(own.required(&ohm))?;
            points.push((number(own, &celsius, 0.0)?, number(own, &ohm, 0.0)?));
        }
        let (points, beta) = as_klippy_takes_them(&points, beta);
        return Ok(Some(thermistor(entry, points, beta)));
    }
    if let Some(own) = config.section(&format!("adc_temperature {name}")) {
        let of = |kind: &str| {
            let mut points = Vec::new();
            for n in 1..1000 {
                let Some(celsius) = own.number(&format!("temperature{n}"), Limit::Any)? else { break };
                let value = own.number(&format!("{kind}{n}"), Limit::Any)?;
                points.extend(value.map(|value| (celsius, value)));
            }
            Ok::<_, Trouble>(points)
        };
        let by_volts = of("voltage")?;
        if !by_volts.is_empty() {
            return volts(entry, &mut by_volts.into_iter()).map(Some);
        }
        let by_ohms = of("resistance")?;
        return Ok(Some(fractions(entry, by_ohms.into_iter().map(|(c, ohm)| (c, ohm / (pullup_ohm + ohm))))));
    }
    if let Some((_, points, beta)) = THERMISTORS.iter().find(|(known, ..)| *known == name) {
        return Ok(Some(thermistor(entry, points, *beta)));
    }
    if let Some((_, points)) = AMPLIFIERS.iter().find(|(known, _)| *known == name) {
        return volts(entry, &mut points.iter().copied()).map(Some);
    }
    match name {
        "PT1000" => {
            let ohm = |celsius| 1000.0 * platinum(celsius);
            Ok(Some(fractions(entry, tens().map(|celsius| (celsius, ohm(celsius) / (pullup_ohm + ohm(celsius)))))))
        }
        // 4400 ohm to 5 V, and a gain of 10.
        "PT100 INA826" => {
            let volt = |celsius| 50.0 * 100.0 * platinum(celsius) / (4400.0 + 100.0 * platinum(celsius));
            volts(entry, &mut tens().map(|celsius| (celsius, volt(celsius)))).map(Some)
        }
        _ => Ok(None),
    }
}

/// The points that count. Through some three points no thermistor's curve leads, and klippy takes the first one with the
/// beta between the first and the last (`thermistor.py`).
fn as_klippy_takes_them(points: &Points, beta: Option<f64>) -> (&Points, Option<f64>) {
    match (points, Thermistor::new(points, beta, PULLUP_OHM)) {
        ([(t1, r1), _, (t3, r3)], Err(NoThermistor::PointsOnNoCurve)) => {
            let inverse = |celsius: f64| 1.0 / (celsius + KELVIN);
            (&points[..1], Some((r1.ln() - r3.ln()) / (inverse(*t1) - inverse(*t3))))
        }
        _ => (points, beta),
    }
}

/// A curve as fractions of the ADC's reference, as far as the ADC measures them.
fn fractions(entry: Entry, points: impl Iterator<Item = (f64, f64)>) -> Entry {
    let points = points.filter(|(_, fraction)| (0.0..=1.0).contains(fraction));
    entry.rows("points_celsius_fraction", points.map(|(celsius, fraction)| [celsius, fraction]))
}

/// The fraction that an MCU's own sensor reads at 40 °C, by klippy's formula for this chip (`temperature_mcu.py`).
pub(super) fn mcu_at_40(chip: &str) -> f64 {
    match chip {
        "rp2040" => (0.706 - 0.001_721 * (40.0 - 27.0)) / 3.3,
        chip if chip.starts_with("sam3") => (0.8 + 0.002_65 * (40.0 - 27.0)) / 3.3,
        chip if chip.starts_with("sam4") => (1.44 + 0.004_7 * (40.0 - 27.0)) / 3.3,
        _ => (1.43 - 0.0043 * (40.0 - 25.0)) / 3.3,
    }
}
