// SPDX-License-Identifier: GPL-3.0-or-later
//! The meaning of each section of a printer.cfg.

use std::fs;

use pinion_model::SimConfig;
use pinion_printer_config::Config;
use toml::{Table, Value};

use super::plugins::LeftOut;
use super::translate::check;
use super::{Pace, Translated, translate};

const PRINTER: &str = include_str!("../../../../tests/support/testkit/two-boards.cfg");

fn translated(text: &str) -> Result<Translated, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("printer.cfg");
    fs::write(&path, text).unwrap();
    let config = Config::read(&path).unwrap();
    let folder = format!("{}/", folder.path().display());
    translate(&config, Pace::Fast, &LeftOut::default()).map_err(|trouble| trouble.to_string().replace(&folder, ""))
}

/// The same without a klippy, and as a whole description. Returns the notes.
fn served(more: &str) -> Result<Vec<String>, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("printer.cfg");
    fs::write(&path, format!("{PRINTER}\n{more}")).unwrap();
    let config = Config::read(&path).unwrap();
    check(&config).map_err(|trouble| trouble.to_string())?;
    let Translated { description, notes, .. } = translated(&format!("{PRINTER}\n{more}"))?;
    SimConfig::parse(&toml::to_string(&description).unwrap(), "this test").map_err(|trouble| trouble.to_string())?;
    Ok(notes.iter().map(ToString::to_string).collect())
}

/// Each of these works on a real printer, with one of the hosts.
#[test]
fn what_some_klippy_takes_is_no_mistake() {
    let chip = |name: &str| format!("[temperature_sensor {name}]\nsensor_type: BME280\ni2c_bus: i2c1\n");
    let alone = |name: &str, bus: &str| {
        format!("[temperature_sensor {name}]\nsensor_type: MAX31855\nsensor_pin: tool:None\nspi_bus: spi{bus}\n")
    };
    for (name, more) in [
        ("AHT", ["AHT1X", "AHT2X", "AHT3X"].map(|kind| format!("[temperature_sensor {kind}]\nsensor_type: {kind}\ni2c_bus: {kind}\n")).concat()),
        ("beta", "[temperature_sensor a]\nsensor_type: NTC 100K beta 3950\nsensor_pin: PA2\n".into()),
        ("mcp4018", "[mcp4018 a]\nscl_pin: PD5\nsda_pin: PD6\nwiper: 1\n[mcp4018 b]\nscl_pin: PD5\nsda_pin: PD7\nwiper: 1\n".into()),
        ("timeout", "[idle_timeout]\ntimeout: 0\n".into()),
        ("None", [alone("a", "1"), alone("b", "2")].concat()),
        ("one chip", [chip("a"), chip("b")].concat()),
        ("one motor", "[duplicate_pin_override]\npins: PB9, PC2\n[manual_stepper a]\nstep_pin: PB9\ndir_pin: !PC2\nmicrosteps: 16\nrotation_distance: 40\n".into()),
        ("own sections", "[query_adc]\n[pid_calibrate]\n[print_stats]\n[gcode_move]\n[heaters]\n[buttons]\n[statistics]\n[indx]\n".into()),
    ] {
        let notes = served(&more).unwrap_or_else(|why| panic!("{name}: {why}"));
        assert_eq!(notes, [""; 0], "{name}");
    }
    for (more, note) in [
        (
            "[load_cell]\nsensor_type: ads131m02\ncs_pin: PA4\n",
            "[load_cell] has the chip ads131m02, which is not simulated",
        ),
        (
            "[tca9548a a]\n[temperature_sensor b]\nsensor_type: AHT2X_TCA\n",
            "[temperature_sensor b] has the sensor AHT2X_TCA of a plugin",
        ),
    ] {
        let notes = served(more).unwrap();
        assert!(notes.iter().any(|found| found.contains(note)), "{notes:?}");
    }
}

#[test]
fn kinematics_of_a_plugin_are_those_that_their_name_ends_with() {
    let with = |kinematics: &str| PRINTER.replace("kinematics: cartesian", &format!("kinematics: {kinematics}"));
    let kind = |kinematics: &str| {
        let found = translated(&with(kinematics))?;
        Ok::<_, String>((found.description["kinematics"]["kind"].as_str().unwrap().to_owned(), found.notes.len()))
    };
    assert_eq!(kind("ratos_hybrid_corexy"), Ok(("hybrid_corexy".into(), 1)));
    assert_eq!(kind("my_corexy"), Ok(("corexy".into(), 1)));
    assert_eq!(kind("limited_corexy"), Ok(("corexy".into(), 0)));
    assert!(kind("cube").unwrap_err().contains("Error loading kinematics 'cube'"));
}

#[test]
fn a_wrong_chip_is_found_beside_a_plugin() {
    let refused = served("[shaketune]\n[output_pin x]\npin: nozle:PA1\n").unwrap_err();
    assert!(refused.contains("Unknown pin chip name 'nozle'"), "{refused}");
    served("[beacon]\nserial: x\n[output_pin x]\npin: beacon:PA1\n").unwrap();
}

#[test]
fn a_display_has_its_own_controller() {
    for chip in ["ssd1306", "sh1106"] {
        let text = format!("{PRINTER}\n[display]\nlcd_type: {chip}\ni2c_bus: i2c1\n");
        let Translated { description, .. } = translated(&text).unwrap();
        assert_eq!(named(&description, "part", "kind", "ssd1306")["chip"].as_str(), Some(chip));
    }
}

#[test]
fn a_pin_that_no_chip_has_is_a_mistake() {
    for (from, to) in [("step_pin: PB9", "step_pin: PB130"), ("pin: PA7", "pin: PX3")] {
        let refused = translated(&PRINTER.replacen(from, to, 1)).unwrap_err();
        let pin = to.split(' ').nth(1).unwrap();
        assert!(
            refused.contains(&format!("Pin '{pin}' is not a valid pin name on mcu 'mcu': correct it")),
            "{refused}"
        );
    }
}

#[test]
fn a_max_temp_that_is_no_limit_insulates_nothing() {
    let loss = |max: &str| {
        let text = PRINTER.replace("max_temp: 110", &format!("max_temp: {max}"));
        let Translated { description, .. } = translated(&text).unwrap();
        let bed = named(&description, "heater", "name", "heater_bed");
        bed["loss_w_per_k"].as_float().unwrap() / bed["heater_watts"].as_float().unwrap()
    };
    let text = PRINTER.replace("max_temp: 250", "max_temp: 2600");
    let notes = translated(&text).unwrap().notes;
    assert!(notes.len() == 1 && notes[0].to_string().contains("[extruder] has max_temp 2600"), "{notes:?}");
    assert!(loss("9999") > loss("110") / 2.0, "{} {}", loss("9999"), loss("110"));
}

fn tables<'a>(description: &'a Table, kind: &str) -> Vec<&'a Table> {
    description[kind].as_array().unwrap().iter().map(|table| table.as_table().unwrap()).collect()
}

fn named<'a>(description: &'a Table, kind: &str, key: &str, name: &str) -> &'a Table {
    tables(description, kind).into_iter().find(|table| table.get(key).and_then(Value::as_str) == Some(name)).unwrap()
}

#[test]
fn motors_have_their_pins_their_steps_and_their_endstops() {
    let Translated { description, mcus, .. } = translated(PRINTER).unwrap();
    assert_eq!(mcus, ["mcu", "tool"]);
    let [x, y, z] = ["x", "y", "z"].map(|name| named(&description, "axis", "name", name));
    assert_eq!(x["dir_pin"].as_str(), Some("!PC2"));
    assert_eq!(x["endstop_pin"].as_str(), Some("!tool:gpio5"));
    assert_eq!((x["endstop_mm"].as_float(), x["endstop_at"].as_str()), (Some(-5.0), Some("min")));
    assert_eq!((x["min_mm"].as_float(), x["travel_mm"].as_float()), (Some(-5.0), Some(235.0)));
    assert_eq!(x["steps_per_mm"].as_float(), Some(80.0));
    assert_eq!(y["step_pin"].as_str(), Some("PB8"), "by its alias");
    assert_eq!(y["steps_per_mm"].as_float(), Some(480.0));
    assert_eq!((y["enable_pin"].as_str(), x["enable_pin"].as_str()), (Some("!PC3"), Some("!PC3")));
    // The motor stalls where klippy believes the end to be.
    assert!(y.get("endstop_pin").is_none());
    assert_eq!((y["travel_mm"].as_float(), y["overtravel_mm"].as_float()), (Some(235.0), Some(0.0)));
    assert_eq!((z["step_pin"].as_str(), z.get("endstop_pin")), (Some("tool:gpio1"), None));
}

#[test]
fn a_driver_pulls_its_stall_output_low_whatever_the_configuration_says() {
    for text in ["^!PK1", "PK1"] {
        let driver = format!("[tmc5160 stepper_x]\ncs_pin: PG4\ndiag1_pin: {text}\nrun_current: 1\ndriver_SGT: 3\n");
        let Translated { description, .. } = translated(&format!("{PRINTER}{driver}")).unwrap();
        let driver = named(&description, "part", "kind", "tmc5160");
        assert_eq!((driver["diag1_pin"].as_str(), driver["sg_free"].as_integer()), (Some("PK1"), Some(170)));
    }
}

#[test]
fn a_tmc2240_has_one_of_two_buses() {
    let text = "[tmc2240 stepper_x]\nuart_pin: PG4\nuart_address: 3\nrun_current: 1\ndiag1_pin: ^!PK1\ndriver_SGT: 3\n\
                [tmc2240 extruder]\ncs_pin: PG5\nrun_current: 1\n";
    let Translated { description, .. } = translated(&format!("{PRINTER}{text}")).unwrap();
    let x = named(&description, "part", "kind", "tmc2240_uart");
    assert_eq!(
        (x["axis"].as_str(), x["uart_pin"].as_str(), x["address"].as_integer()),
        (Some("x"), Some("PG4"), Some(3))
    );
    assert_eq!((x["diag1_pin"].as_str(), x["sg_free"].as_integer()), (Some("PK1"), Some(170)));
    assert_eq!(named(&description, "part", "kind", "tmc2240")["select_pin"].as_str(), Some("PG5"));
}

#[test]
fn sensors_of_the_filaments_width_see_the_usual_one() {
    let text = "[hall_filament_width_sensor]\nadc1: PA4\nadc2: PA5\nRaw_dia1: 9000\nRaw_dia2: 11000\n\
                default_nominal_filament_diameter: 1.75\nmeasurement_delay: 70\n[tsl1401cl_filament_width_sensor]\n\
                pin: PA6\ndefault_nominal_filament_diameter: 1.75\nmeasurement_delay: 70\n";
    let Translated { description, notes, .. } = translated(&format!("{PRINTER}{text}")).unwrap();
    assert!(notes.is_empty(), "{notes:?}");
    let share = |pin: &str| named(&description, "analog", "pin", pin)["fraction"].as_float();
    assert_eq!([share("PA4"), share("PA5"), share("PA6")], [Some(0.5), Some(0.5), Some(0.35)]);
}

#[test]
fn a_min_temp_of_absolute_zero_is_klippys_lowest() {
    let text = PRINTER.replace("min_temp: 0\nmax_temp: 250\n", "min_temp: -273.15\nmax_temp: 250\n");
    assert_ne!(text, PRINTER);
    let Translated { description, .. } = translated(&text).unwrap();
    SimConfig::parse(&toml::to_string(&description).unwrap(), "this test").unwrap();
}

#[test]
fn everything_else_becomes_what_it_is_and_each_pin_exists() {
    let text = format!("{PRINTER}[beacon]\nprobe_pin: PD1\n");
    let Translated { description, notes, .. } = translated(&text).unwrap();
    let driver = named(&description, "part", "kind", "tmc2209");
    assert_eq!((driver["axis"].as_str(), driver["address"].as_integer()), (Some("y"), Some(1)));
    assert_eq!((driver["diag_pin"].as_str(), driver["sg_free"].as_integer()), (Some("PC12"), Some(360)));
    let probe = named(&description, "part", "kind", "probe");
    assert_eq!((probe["pin"].as_str(), probe["z_offset_mm"].as_float()), (Some("tool:gpio9"), Some(1.5)));
    let hot = named(&description, "heater", "name", "extruder");
    assert_eq!(hot["points_celsius_ohm"].as_array().unwrap().len(), 3);
    let rate = hot["heater_watts"].as_float().unwrap() / hot["heat_capacity_j_per_k"].as_float().unwrap();
    assert!((4.0..5.0).contains(&rate), "{rate}: as fast as 114 for pid_Kd permits");
    let boards = tables(&description, "mcu");
    assert_eq!((boards[0]["chip"].as_str(), boards[1]["chip"].as_str()), (Some("stm32f103xe"), Some("rp2040")));
    assert_eq!(boards[0]["pins"].as_array().unwrap(), &["PD1".into()]);
    assert_eq!(notes.len(), 1);
    let line = PRINTER.lines().count() + 1;
    let words = "is not a section of Klipper or Kalico: klippy needs its module, or give --without-plugins; its pins exist, \
                 and nothing is at them";
    let note = notes[0].to_string();
    assert!(note.ends_with(&format!("printer.cfg:{line}: [beacon] {words}")), "{note}");
}

#[test]
fn a_heater_whose_integral_part_is_slow_holds_its_target_by_its_gain() {
    let text = PRINTER.replace("pid_Kp: 22\npid_Ki: 1\n", "pid_Kp: 20\npid_Ki: 0.02\n");
    assert_ne!(text, PRINTER);
    let Translated { description, .. } = translated(&text).unwrap();
    let hot = named(&description, "heater", "name", "extruder");
    let number = |key: &str| hot[key].as_float().unwrap();
    // The power that holds 200 degrees, as klippy's PID gives it with an error of this many kelvin.
    let power = (200.0 - 25.0) * number("loss_w_per_k") / number("heater_watts");
    assert!(255.0 * power / 20.0 < 3.0, "{power}");
}

#[test]
fn a_heater_that_is_controlled_by_a_model_is_as_its_model() {
    let heater = |capacity: &str| {
        let control = format!("control: mpc\nheater_power: 120\nambient_transfer: 0.0738\n{capacity}");
        let Translated { description, .. } = translated(&PRINTER.replacen("control: pid\n", &control, 1)).unwrap();
        let hot = named(&description, "heater", "name", "extruder");
        ["heater_watts", "heat_capacity_j_per_k", "loss_w_per_k"].map(|key| hot[key].as_float().unwrap())
    };
    assert_eq!(heater("block_heat_capacity: 24.45\n"), [120.0, 24.45, 0.0738]);
    assert_ne!(heater("")[0], 120.0, "it is not calibrated");
}

#[test]
fn motors_of_z_begin_on_a_plane_that_klippy_can_level() {
    let start = |text: &str| -> Vec<f64> {
        let Translated { description, .. } = translated(text).unwrap();
        let names = ["z", "z1", "z2", "z3"].into_iter();
        names.map(|name| named(&description, "axis", "name", name)["start_mm"].as_float().unwrap()).collect()
    };
    let more: String = (2..4)
        .map(|n| {
            let pins = format!("step_pin: tool:gpio1{n}\ndir_pin: tool:gpio2{n}");
            format!("[stepper_z{n}]\n{pins}\nmicrosteps: 16\nrotation_distance: 8\n")
        })
        .collect();
    // Not in klippy's order of the corners for [quad_gantry_level].
    let corners = "z_positions: 0,0\n  200,0\n  0,300\n  200,300\n";
    let text = PRINTER.replace("z_positions: -20,110\n  250,110\n", corners);
    let [z, z1, z2, z3] = start(&format!("{text}{more}"))[..] else { unreachable!() };
    assert!((z1 - z - -0.3).abs() < 1e-9 && (z2 - z - 0.4).abs() < 1e-9 && (z3 - z - 0.1).abs() < 1e-9);
}

#[test]
fn a_motor_meets_its_endstop_in_the_phase_that_is_saved() {
    let steps = |phase: &str| {
        let text = format!("{PRINTER}[endstop_phase stepper_x]\ntrigger_phase: {phase}\n");
        let Translated { description, in_phase, .. } = translated(&text).unwrap();
        assert_eq!(in_phase.into_iter().collect::<Vec<_>>(), ["stepper_x"]);
        let x = named(&description, "axis", "name", "x");
        let [from, to, steps_per_mm] = ["start_mm", "endstop_mm", "steps_per_mm"].map(|key| x[key].as_float().unwrap());
        let steps = (to - from) * steps_per_mm;
        assert!((steps - steps.round()).abs() < 1e-6 && (to - from).abs() > 5.0, "{steps}");
        (steps.round() as i64).rem_euclid(64)
    };
    assert_eq!(["0/64", "7/64", "63/64", "5/16"].map(steps), [0, 7, 63, 20]);
}

#[test]
fn a_chip_without_a_select_pin_is_on_the_bus_of_its_mcu() {
    let text = format!("{PRINTER}[adxl345]\ncs_pin: tool:None\nspi_bus: spidev2.0\n");
    let Translated { description, .. } = translated(&text).unwrap();
    let chip = named(&description, "part", "kind", "accelerometer");
    assert_eq!((chip["bus"].as_str(), chip.get("select_pin")), (Some("tool:spidev2.0"), None));
}

#[test]
fn accelerometers_have_names_and_one_of_two_buses() {
    let text = "[adxl345 t0]\ncs_pin: PE1\n[adxl345 t1]\ncs_pin: PE2\n[lis2dw]\ncs_pin: PE3\n\
                [lis3dh bed]\ni2c_mcu: tool\ni2c_bus: i2c1a\n[mpu9250]\ni2c_address: 105\ni2c_bus: i2c1\n";
    let Translated { description, notes, .. } = translated(&format!("{PRINTER}{text}")).unwrap();
    assert!(notes.is_empty(), "{notes:?}");
    assert_eq!(named(&description, "part", "name", "t0")["select_pin"].as_str(), Some("PE1"));
    assert_eq!(named(&description, "part", "name", "t1")["select_pin"].as_str(), Some("PE2"));
    let lis2dw = named(&description, "part", "chip", "lis2dw");
    assert_eq!((lis2dw["select_pin"].as_str(), lis2dw.get("address")), (Some("PE3"), None));
    let lis3dh = named(&description, "part", "name", "bed");
    assert_eq!((lis3dh["bus"].as_str(), lis3dh["address"].as_integer()), (Some("tool:i2c1a"), Some(0x19)));
    assert_eq!(named(&description, "part", "chip", "mpu9250")["address"].as_integer(), Some(105));
}

#[test]
fn a_probe_that_save_config_left_behind_is_none() {
    let bltouch = "[bltouch]\nsensor_pin: PD5\ncontrol_pin: PD6\nz_offset: 2\n";
    let left = "[probe]\nz_offset: 0.4\n";
    let (before, after) = PRINTER.split_once("[probe]\n").unwrap();
    let after = after.split_once("\n[").map_or(String::new(), |(_, after)| format!("[{after}"));
    let text = |sections: &[&str]| format!("{before}{after}\n{}", sections.concat());
    translated(&text(&[bltouch, left])).unwrap();
    translated(&text(&["[beacon]\nserial: x\n", left])).unwrap();
    assert!(translated(&text(&[left])).unwrap_err().contains("Option 'pin' in section 'probe' must be specified"));
}

#[test]
fn a_probe_as_endstop_leaves_position_endstop_without_a_meaning() {
    let text = PRINTER.replace("probe:z_virtual_endstop\n", "probe:z_virtual_endstop\nposition_endstop: -13.35\n");
    assert_ne!(text, PRINTER);
    translated(&text).unwrap();
}

#[test]
fn a_heater_with_a_combined_sensor_heats_the_first_sensor_that_it_can_heat() {
    let sensor = "[temperature_sensor box]\nsensor_type: EPCOS 100K B57560G104F\nsensor_pin: PA4\n\
                  [temperature_sensor pi]\nsensor_type: temperature_host\n";
    let heater = |name: &str, pin: &str, sensors: &str| {
        format!(
            "[heater_generic {name}]\nheater_pin: {pin}\nmax_power: 0.5\nsensor_type: temperature_combined\n\
             sensor_list: {sensors}\ncombination_method: mean\nmaximum_deviation: 50\ncontrol: watermark\n\
             min_temp: 0\nmax_temp: 90\n"
        )
    };
    let named = |text: String, pin: &str| {
        let description = translated(&PRINTER.replace("[extruder]", &(text + "[extruder]"))).unwrap().description;
        let heaters = description["heater"].as_array().unwrap().iter().filter_map(Value::as_table);
        let found: Vec<_> = heaters.filter(|heater| heater.get("pin") == Some(&Value::from(pin))).collect();
        let [heater] = found[..] else { panic!("{pin}: {description}") };
        assert!(heater["heater_watts"].as_float().unwrap() > 0.0);
        heater["name"].as_str().unwrap().to_owned()
    };
    let both = "temperature_sensor box,\n  temperature_sensor pi";
    assert_eq!(named(sensor.to_owned() + &heater("dryer", "PD9", both), "PD9"), "box");
    let host_first = "temperature_sensor pi, temperature_sensor box";
    assert_eq!(named(sensor.to_owned() + &heater("dryer", "PD9", host_first), "PD9"), "box");
    // A heater that can heat none of its sensors, because the box has one, or the bed has its own.
    let two = || sensor.to_owned() + &heater("dryer", "PD9", both) + &heater("chamber", "PD10", both);
    assert_eq!([named(two(), "PD9"), named(two(), "PD10")], ["box", "chamber"]);
    for sensors in ["temperature_sensor pi", "extruder, temperature_sensor pi"] {
        assert_eq!(named(sensor.to_owned() + &heater("dryer", "PD9", sensors), "PD9"), "dryer");
    }
    let of_extruder = PRINTER.split("[extruder]").nth(1).unwrap().split("heater_pin:").nth(1).unwrap();
    let of_extruder = of_extruder.lines().next().unwrap().trim();
    assert_eq!(named(sensor.to_owned() + &heater("dryer", "PD9", "extruder"), of_extruder), "extruder");
}

#[test]
fn a_klicky_is_in_its_dock_a_weak_heater_heats_and_a_fast_carriage_has_room() {
    let klicky =
        "[gcode_macro _User_Variables]\nvariable_docklocation_x: -21\nvariable_docklocation_y: 370.5 \ngcode:\n";
    let text = |more: &str| PRINTER.replace("[probe]", &format!("{klicky}[probe]")).replace("[extruder]", more);
    let of = |text: &str, kind: &str, key: &str, value: &str| -> Table {
        let description = translated(text).unwrap().description;
        let mut all = description[kind].as_array().unwrap().iter().filter_map(Value::as_table);
        let has = |table: &&Table| table.get(key).and_then(Value::as_str) == Some(value);
        all.find(has).cloned().unwrap()
    };
    let probe = of(&text("[extruder]"), "part", "kind", "probe");
    assert_eq!(probe["dock_mm"].as_array().unwrap(), &[Value::from(-21.0), Value::from(370.5)]);
    let euclid = "[gcode_macro EuclidProbe]\nvariable_position_dock: [ 52, 355 ] # dock\ngcode:\n[probe]";
    let kalicos = "[dockable_probe]\ndock_position: 295, 350.5, 4";
    for (text, [x, y]) in [(euclid, [52.0, 355.0]), (kalicos, [295.0, 350.5])] {
        let probe = of(&PRINTER.replace("[probe]", text), "part", "kind", "probe");
        assert_eq!(probe["dock_mm"].as_array().unwrap(), &[Value::from(x), Value::from(y)], "{text}");
    }
    let watts = |more: &str| of(&text(more), "heater", "name", "extruder")["heater_watts"].as_float().unwrap();
    assert!((watts("[extruder]\nmax_power: 0.4") * 0.4 - watts("[extruder]")).abs() < 1e-9);
    let room = |text: &str| of(text, "axis", "name", "x")["overtravel_mm"].as_float().unwrap();
    assert_eq!(room(&PRINTER.replace("[stepper_x]", "[stepper_x]\nhoming_speed: 150")), 6.0);
}

#[test]
fn a_thermistor_reads_as_klippy_calculates_it() {
    let of = |more: &str| {
        let sensor = "[temperature_sensor own]\nsensor_pin: PA2\nmin_temp: 0\nmax_temp: 100\n";
        let description = translated(&format!("{PRINTER}\n{sensor}{more}")).unwrap().description;
        let heaters = description["heater"].as_array().unwrap().iter().filter_map(Value::as_table);
        let found: Vec<Table> =
            heaters.filter(|heater| heater.get("name") == Some(&Value::from("own"))).cloned().collect();
        found.into_iter().next().unwrap()
    };
    let rows = |table: &Table, key: &str| -> Vec<Vec<f64>> { table[key].clone().try_into().unwrap() };
    // The resistor in series adds to the thermistor, also between its points.
    let inline = of("sensor_type: Generic 3950\ninline_resistor: 1000\n");
    let fraction_at = |celsius: f64| {
        let found = rows(&inline, "points_celsius_fraction").into_iter().find(|point| point[0] == celsius);
        found.unwrap()[1]
    };
    assert!((fraction_at(25.0) - 101_000.0 / 105_700.0).abs() < 1e-9);
    assert!((fraction_at(150.0) - 2770.0 / 7470.0).abs() < 1e-9);
    // By klippy's thermistor.py.
    assert!((fraction_at(100.0) - 0.626_166_716_577).abs() < 1e-9, "{}", fraction_at(100.0));
    // No curve leads through these points: klippy takes the beta between the first and the last.
    let points = "temperature1: 25\nresistance1: 100000\ntemperature2: 100\nresistance2: 1000\n\
                  temperature3: 200\nresistance3: 100\n";
    let beta = of(&format!("sensor_type: mine\n[thermistor mine]\n{points}"));
    assert_eq!(rows(&beta, "points_celsius_ohm"), [[25.0, 100_000.0]]);
    assert!((beta["beta_k"].as_float().unwrap() - 5_568.427_285).abs() < 1e-6, "{}", beta["beta_k"]);
}
