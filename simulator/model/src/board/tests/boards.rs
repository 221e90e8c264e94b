// SPDX-License-Identifier: GPL-3.0-or-later
//! Printers with several boards, and every kinematics, by the pins of their motors.

use super::*;
use crate::board::SimWorld;
use crate::engine::bed::BedShape;
use proptest::prelude::*;

/// An axis with pins on a board, 100 steps for each millimeter.
fn axis(name: &str, more: &str) -> String {
    format!(
        "[[axis]]\nname = \"{name}\"\nstep_pin = \"{name}_step\"\ndir_pin = \"{name}_dir\"\nsteps_per_mm = 100.0\n{more}\n"
    )
}

fn rail(name: &str) -> String {
    axis(name, &format!("travel_mm = 200.0\nstart_mm = 50.0\nendstop_pin = \"{name}_endstop\""))
}

/// Steps a motor by this way of its belt.
fn go(bench: &mut Bench, axis: &str, mm: f64) {
    let (step, dir) = (bench.output(&format!("{axis}_step"), false), bench.output(&format!("{axis}_dir"), mm > 0.0));
    let _ = dir;
    for _ in 0..(mm.abs() * 100.0).round() as u32 {
        pulse(&*step);
    }
}

fn printer(text: &str) -> Bench {
    Bench::new(SimConfig::parse(text, "test").unwrap_or_else(|error| panic!("{error}\n{text}")))
}

fn assert_at(bench: &Bench, expected: [f64; 3]) {
    let nozzle_mm = bench.probe.nozzle_mm();
    for i in 0..3 {
        assert!((nozzle_mm[i] - expected[i]).abs() < 1e-6, "{nozzle_mm:?} {expected:?}");
    }
}

const BOARDS: &str = r#"
[[mcu]]
name = "mcu"
chip = "stm32f103xe"
pins = ["PC13"]
[mcu.constants]
BUS_PINS_spi1 = "PA6,PA7,PA5"

[[mcu]]
name = "toolhead"
chip = "rp2040"
drift_ppm = 30.0

[[spi_bus]]
name = "spi1"

[[spi_bus]]
name = "toolhead:spi1"

[[axis]]
name = "x"
step_pin = "PA0"
dir_pin = "mcu:PA1"
steps_per_mm = 100.0
min_mm = -5.0
travel_mm = 200.0
endstop_pin = "!toolhead:gpio3"
endstop_mm = -2.0
"#;

#[test]
fn an_endstop_of_one_board_feels_the_motor_of_another() {
    let clock = VirtualClock::at(Clock::from_ticks(0));
    let config = SimConfig::parse(BOARDS, "boards").unwrap();
    assert_eq!(SimConfig::parse(&toml::to_string(&config).unwrap(), "again").unwrap(), config);
    let SimWorld { boards, probe } = SimWorld::new(config, Arc::new(clock.clone())).unwrap();
    let mut benches = boards.into_iter().map(|board| Bench { board, probe: probe.clone(), clock: clock.clone() });
    let (mut main, mut tool) = (benches.next().unwrap(), benches.next().unwrap());
    assert_eq!((main.board.name(), tool.board.name()), ("mcu", "toolhead"));
    let names = |bench: &Bench| bench.board.pins().into_iter().map(|range| range.name).collect::<Vec<_>>();
    assert_eq!(names(&main), ["PA0", "PA1", "spi1", "PC13"]);
    assert_eq!(names(&tool), ["gpio3", "spi1"]);
    assert_eq!(main.board.constants()[0], ("MCU".into(), "stm32f103xe".into()));
    assert_eq!(main.board.constants()[1], ("BUS_PINS_spi1".into(), "PA6,PA7,PA5".into()));
    assert_eq!(tool.board.spi_buses()[0].name, "spi1");

    let (step, _dir) = (main.output("PA0", false), main.output("PA1", false));
    let endstop = tool.input("gpio3");
    for steps in 0..200 {
        assert!(endstop.read().unwrap(), "{steps}");
        pulse(&*step);
    }
    assert!(!endstop.read().unwrap(), "closed at -2 mm, and inverted");
    (0..600).for_each(|_| pulse(&*step));
    let x = probe.axis("x").unwrap();
    assert_eq!((x.position_mm, x.min_mm, x.lost_steps), (-7.0, -5.0, 100));
    // A free pin takes anything.
    assert!(main.input("PC13").read().unwrap());
    main.output("PC13", true).write(false).unwrap();
}

#[test]
fn a_pin_of_a_board_that_is_not_there_is_refused() {
    let error = SimConfig::parse(&BOARDS.replace("!toolhead:gpio3", "toolhed:gpio3"), "boards").unwrap_err();
    assert!(error.to_string().contains("pin `toolhed:gpio3` is on no board"), "{error}");
    let error = SimConfig::parse(&BOARDS.replace("mcu:PA1", "mcu:PA0"), "boards").unwrap_err();
    assert!(error.to_string().contains("already has a use"), "{error}");
}

#[test]
fn belts_move_the_head_as_klippys_kinematics_say() {
    // The move of the head for a millimeter of each motor's belt.
    let cases: [(&str, [[f64; 3]; 3]); 5] = [
        ("cartesian", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        ("corexy", [[0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.0, 1.0]]),
        ("corexz", [[0.5, 0.0, 0.5], [0.0, 1.0, 0.0], [0.5, 0.0, -0.5]]),
        ("hybrid_corexy", [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        ("hybrid_corexz", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]),
    ];
    for (kind, ways) in cases {
        let text = format!("[kinematics]\nkind = \"{kind}\"\n{}{}{}", rail("x"), rail("y"), rail("z"));
        let mut bench = printer(&text);
        let mut at = [50.0; 3];
        assert_at(&bench, at);
        for (motor, way) in ["x", "y", "z"].into_iter().zip(ways) {
            go(&mut bench, motor, 10.0);
            (0..3).for_each(|i| at[i] += 10.0 * way[i]);
            assert_at(&bench, at);
        }
    }
}

#[test]
fn four_motors_of_a_corexy_drive_two_belts() {
    let text = ["x", "y", "z", "x1", "y1"].map(rail).concat();
    let mut bench = printer(&format!("[kinematics]\nkind = \"corexy\"\n{text}"));
    // To the far end of both belts, which is farther than any rail.
    for _ in 0..10 {
        ["x", "x1"].into_iter().for_each(|motor| go(&mut bench, motor, 20.0));
    }
    assert_at(&bench, [150.0, 150.0, 50.0]);
    for _ in 0..10 {
        ["y", "y1"].into_iter().for_each(|motor| go(&mut bench, motor, -10.0));
    }
    assert_at(&bench, [100.0, 200.0, 50.0]);
    assert!(bench.probe.axes().all(|axis| axis.lost_steps == 0));
    // Without its first motor, the second one goes no farther than a belt gives.
    go(&mut bench, "y1", 10.0);
    assert!(bench.axis("y1").lost_steps > 0);
}

#[test]
fn the_second_carriage_of_a_hybrid_corexy_has_a_belt_of_its_own() {
    let text = ["x", "y", "z", "dual_carriage"].map(rail).concat();
    let mut bench = printer(&format!("[kinematics]\nkind = \"hybrid_corexy\"\n{text}"));
    // Only y: both belts run along.
    go(&mut bench, "y", 10.0);
    go(&mut bench, "x", -10.0);
    go(&mut bench, "dual_carriage", 10.0);
    assert_at(&bench, [50.0, 60.0, 50.0]);
    assert!((bench.axis("dual_carriage").position_mm - 50.0).abs() < 1e-9);
}

#[test]
fn the_motors_of_generic_cartesian_kinematics_move_the_carriages_that_they_name() {
    let carriage = |name: &str| {
        format!(
            "[[carriage]]\nname = \"{name}\"\ntravel_mm = 200.0\nstart_mm = 50.0\nendstop_pin = \"{name}_endstop\"\n"
        )
    };
    let carriages = ["x", "y", "z"].map(carriage).concat();
    let text = format!(
        "[kinematics]\nkind = \"generic_cartesian\"\n{carriages}{}{}{}",
        axis("a", "carriages = { x = 1.0, y = 1.0 }"),
        axis("b", "carriages = { x = 1.0, y = -1.0 }"),
        axis("lift", "carriages = { z = 1.0 }"),
    );
    let mut bench = printer(&text);
    go(&mut bench, "a", -100.0);
    assert_at(&bench, [0.0, 0.0, 50.0]);
    assert!(bench.input("x_endstop").read().unwrap());
    go(&mut bench, "b", 4.0);
    go(&mut bench, "lift", 7.0);
    assert_at(&bench, [2.0, -2.0, 57.0]);
    assert_eq!(bench.axis("x").endstop, Some(false));
    let loose = text.replace("carriages = { z = 1.0 }", "travel_mm = 10.0");
    let error = SimConfig::parse(&loose, "test").unwrap_err();
    assert!(error.to_string().contains("carriage `z`: the motors leave it loose"), "{error}");
}

#[test]
fn a_second_motor_of_a_rail_that_runs_the_other_way_loses_its_steps() {
    let text = [rail("x"), rail("y"), rail("z"), axis("y1", "")].concat();
    let mut bench = printer(&text);
    for _ in 0..10 {
        go(&mut bench, "y", 1.0);
        go(&mut bench, "y1", 1.0);
    }
    assert_eq!(bench.axis("y1").lost_steps, 0);
    for _ in 0..10 {
        go(&mut bench, "y", 1.0);
        go(&mut bench, "y1", -1.0);
    }
    assert!(bench.axis("y1").lost_steps > 300, "{}", bench.axis("y1").lost_steps);
}

#[test]
fn a_polar_printer_turns_its_bed_under_the_arm() {
    let bed = "[[axis]]\nname = \"bed\"\nstep_pin = \"bed_step\"\ndir_pin = \"bed_dir\"\nsteps_per_mm = 1000.0\n";
    let mut bench = printer(&format!("[kinematics]\nkind = \"polar\"\n{bed}{}{}", rail("arm"), rail("z")));
    assert_at(&bench, [50.0, 0.0, 50.0]);
    // 1.57 radians, 1000 steps for each.
    go(&mut bench, "bed", 15.7);
    go(&mut bench, "arm", 10.0);
    assert_at(&bench, [60.0 * 1.57f64.cos(), 60.0 * 1.57f64.sin(), 50.0]);
    assert_eq!(bench.probe.space().unwrap().bed, BedShape::Disc { radius_mm: 200.0 });
}

proptest! {
    /// Any way of any motor of a hanging head keeps the place that its recorder sees.
    #[test]
    fn the_recorded_path_ends_where_the_motors_are(ways in prop::collection::vec((0usize..3, -3.0f64..3.0), 1..12)) {
        let kinematics = "[kinematics]\nkind = \"deltesian\"\narms_mm = [217.0, 217.0]\narm_x_mm = [120.0, 120.0]\n";
        let tower = |name| axis(name, "travel_mm = 400.0\nstart_mm = 250.0");
        let mut bench = printer(&format!("{kinematics}{}{}{}", tower("left"), tower("right"), rail("y")));
        let mut recorder = bench.probe.recorder();
        for (motor, mm) in ways {
            go(&mut bench, ["left", "right", "y"][motor], mm);
            bench.advance(0.2);
        }
        recorder.read(bench.probe.now());
        let end = recorder.points().last().unwrap().nozzle_mm;
        prop_assert_eq!(end, bench.probe.nozzle_mm());
    }
}
