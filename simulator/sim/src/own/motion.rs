// SPDX-License-Identifier: GPL-3.0-or-later
//! Motors, their kinematics, and endstops at the positions that the configuration has.

use std::collections::HashMap;

use pinion_printer_config::{Limit, Section, Trouble};

use super::description::Entry;
use super::known::simulated_kinematics;
use super::translator::Translator;

/// Where a rail begins, in front of its endstop.
const BEFORE_ENDSTOP_MM: f64 = 15.0;
/// How high the nozzle begins over the bed.
const START_HEIGHT_MM: f64 = 8.0;
/// How far motors of one z axis are apart at first, if klippy can level them: along x and along y. They are in a plane.
const TILT_MM: [f64; 2] = [-0.3, 0.4];
/// A motor without an end of its own.
const FREE_MM: f64 = 1000.0;

/// Room behind an endstop.
const OVERTRAVEL_MM: f64 = 3.0;
/// How long a motor runs on when an endstop at another MCU triggers: klippy's `TRSYNC_TIMEOUT` is 25 ms, and the block with
/// the stop is under way, too.
const STOP_S: f64 = 0.04;

/// A rail's travel and its endstop.
struct Rail {
    min: f64,
    max: f64,
    endstop: f64,
    at_max: bool,
    /// How far it goes behind its endstop while it homes.
    overtravel: f64,
}

impl Rail {
    /// A place in front of the endstop.
    fn before_endstop(&self) -> f64 {
        let room = BEFORE_ENDSTOP_MM.min((self.max - self.min) / 3.0);
        if self.at_max { self.endstop - room } else { self.endstop + room }
    }
}

/// The kind of an endstop's pin.
enum Endstop {
    /// A switch at a pin of an MCU.
    Switch(String),
    /// The driver sees the motor stall.
    Sensorless,
    /// The probe, or nothing.
    Other,
}

impl<'a> Translator<'a> {
    pub(super) fn motion(&mut self) -> Result<(), Trouble> {
        let Some(printer) = self.config.section("printer") else {
            let cause = "Option 'kinematics' in section 'printer' must be specified";
            return Err(Trouble::new(cause).remedy("add [printer]"));
        };
        let named = printer.required("kinematics")?;
        let Some(kind) = simulated_kinematics(named) else {
            let cause = format!("Error loading kinematics '{named}'");
            return Err(printer.trouble("kinematics", cause).remedy("name one of Klipper's kinematics"));
        };
        if kind != named {
            let cause = format!("has the kinematics {named} of a plugin, which are simulated as {kind}");
            self.note(printer, &cause, "compare what it shows with your printer");
        }
        match kind {
            "cartesian" | "corexy" | "corexz" | "hybrid_corexy" | "hybrid_corexz" | "limited_cartesian"
            | "limited_corexy" | "limited_corexz" => {
                for axis in ["x", "y", "z"] {
                    self.rail(axis)?;
                }
                self.dual_carriage()?;
                let kind = kind.strip_prefix("limited_").unwrap_or(kind);
                self.out.set("kinematics", Entry::default().set("kind", kind));
            }
            "generic_cartesian" => self.generic()?,
            "delta" => self.delta(printer)?,
            "deltesian" => self.deltesian()?,
            "polar" => self.polar()?,
            "rotary_delta" => self.rotary_delta(printer)?,
            "winch" => self.winch()?,
            _ => self.out.set("kinematics", Entry::default().set("kind", "none")),
        }
        self.other_motors()
    }

    /// Steps for each millimeter, or for each radian of a motor without `rotation_distance`.
    fn steps_per_mm(section: &Section) -> Result<f64, Trouble> {
        let mut gear = 1.0;
        for ratio in section.list("gear_ratio", ',') {
            let numbers = ratio
                .split_once(':')
                .and_then(|(a, b)| Some((a.trim().parse::<f64>().ok()?, b.trim().parse::<f64>().ok()?)));
            let Some((driven, driving)) = numbers.filter(|(a, b)| *a > 0.0 && *b > 0.0) else {
                let cause = match ratio.split(':').count() {
                    2 => format!("Unable to parse option 'gear_ratio' in section '{}'", section.name),
                    _ => format!("Option 'gear_ratio' in section '{}' must have 2 elements", section.name),
                };
                return Err(section.trouble("gear_ratio", cause).remedy("write it as 80:16"));
            };
            gear *= driven / driving;
        }
        let distance = section.number("rotation_distance", Limit::Above(0.0))?;
        if distance.is_none() && section.text("gear_ratio").is_none() {
            section.required("rotation_distance")?;
        }
        section.required("microsteps")?;
        let microsteps = section.whole("microsteps", 1)?.unwrap_or(16);
        let full = section.whole("full_steps_per_rotation", 1)?.unwrap_or(200);
        Ok((full as f64) * (microsteps as f64) * gear / distance.unwrap_or(std::f64::consts::TAU))
    }

    /// The pins of a motor. `name` is the axis of the description.
    pub(super) fn motor(&mut self, section: &Section, name: &str) -> Result<Entry, Trouble> {
        let steps_per_mm = Translator::steps_per_mm(section)?;
        section.required("step_pin")?;
        section.required("dir_pin")?;
        let mut entry = Entry::default().set("name", name).set("steps_per_mm", steps_per_mm);
        entry = entry.set("microsteps", section.whole("microsteps", 1)?.unwrap_or(16));
        for key in ["step_pin", "dir_pin"] {
            let pin = self.pin(section, key)?;
            let taken = pin.as_ref().and_then(|pin| self.take_pin(section, pin));
            let Some(text) = taken else {
                let named = pin.map(|pin| pin.name).unwrap_or_default();
                let is_known = self.pin(section, key)?.is_some_and(|pin| self.is_real(&pin));
                let cause = match is_known {
                    true => format!("pin {named} used multiple times in config"),
                    false => format!("Unknown pin chip name in '{}'", section.text(key).unwrap_or_default()),
                };
                return Err(section.trouble(key, cause).remedy("name a pin of its own"));
            };
            entry = entry.set(key, text);
        }
        self.axes.insert(section.name.clone(), name.to_owned());
        Ok(entry.set_if("enable_pin", self.take_enable(section, "enable_pin")?))
    }

    /// The endstop at a rail's `endstop_pin`.
    fn endstop(&mut self, section: &Section) -> Result<Endstop, Trouble> {
        let Some(pin) = self.pin(section, "endstop_pin")? else { return Ok(Endstop::Other) };
        if pin.chip.starts_with("tmc") {
            return Ok(Endstop::Sensorless);
        }
        Ok(self.take_pin(section, &pin).map_or(Endstop::Other, Endstop::Switch))
    }

    /// The travel of a rail, as klippy's `GenericPrinterRail` reads it.
    fn travel(&mut self, section: &Section) -> Result<Rail, Trouble> {
        let min = section.number("position_min", Limit::Any)?.unwrap_or(0.0);
        section.required("position_max")?;
        let max = section.number("position_max", Limit::Above(min))?.unwrap_or(min + 1.0);
        let by_probe = self.pin(section, "endstop_pin")?.is_some_and(|pin| pin.chip == "probe");
        let endstop = match section.number("position_endstop", Limit::Any)? {
            // klippy takes the probe's z_offset, whatever is written here.
            _ if by_probe => 0.0f64.clamp(min, max),
            Some(endstop) => endstop,
            None => section.required("position_endstop").map(|_| 0.0)?,
        };
        if endstop < min || endstop > max {
            let cause =
                format!("position_endstop in section '{}' must be between position_min and position_max", section.name);
            return Err(section.trouble("position_endstop", cause).remedy("correct one of them"));
        }
        let at_max = match section.truth("homing_positive_dir")? {
            Some(positive) => positive,
            None if endstop <= min + (max - min) / 4.0 => false,
            None if endstop >= max - (max - min) / 4.0 => true,
            None => {
                let cause = format!("Unable to infer homing_positive_dir in section '{}'", section.name);
                return Err(section.trouble("position_endstop", cause).remedy("add homing_positive_dir"));
            }
        };
        let speed = section.number("homing_speed", Limit::Any)?.unwrap_or(5.0);
        let overtravel = f64::max(OVERTRAVEL_MM, speed * STOP_S);
        Ok(Rail { min, max, endstop, at_max, overtravel })
    }

    /// The keys of a rail's travel and endstop.
    fn with_rail(entry: Entry, rail: &Rail, endstop: &Endstop, start: f64) -> Entry {
        let end = if rail.at_max { "max" } else { "min" };
        let (mut min, mut max) = (rail.min, rail.max);
        let mut overtravel = rail.overtravel;
        match endstop {
            Endstop::Switch(_) => {}
            // The stop is where klippy believes it to be.
            Endstop::Sensorless if rail.at_max => {
                (max, overtravel) = (rail.endstop, 0.0);
            }
            Endstop::Sensorless => (min, overtravel) = (rail.endstop, 0.0),
            Endstop::Other => overtravel = overtravel.max(5.0),
        }
        let entry = entry.set("min_mm", min).set("travel_mm", max).set("overtravel_mm", overtravel);
        let entry = entry.set("start_mm", start.clamp(min, max));
        match endstop {
            Endstop::Switch(pin) => {
                entry.set("endstop_pin", pin.as_str()).set("endstop_at", end).set("endstop_mm", rail.endstop)
            }
            _ => entry,
        }
    }

    /// A start near `start` from which the motor meets its endstop in the phase that is saved for it (`[endstop_phase]`).
    /// klippy counts the phase from the motor's place when the MCU or the driver starts.
    fn in_phase(&mut self, section: &Section, rail: &Rail, endstop: &Endstop, start: f64) -> Result<f64, Trouble> {
        let saved = self.config.section(&format!("endstop_phase {}", section.name));
        let saved = saved.and_then(|saved| saved.text("trigger_phase")?.split_once('/'));
        let saved = saved.and_then(|(phase, of)| Some((phase.trim().parse().ok()?, of.trim().parse().ok()?)));
        let (Endstop::Switch(_), Some((phase, of))) = (endstop, saved) else { return Ok(start) };
        let (phase, of): (f64, f64) = (phase, of);
        let steps_per_mm = Translator::steps_per_mm(section)?;
        let phases = 4 * section.whole("microsteps", 1)?.unwrap_or(16);
        // As klippy rounds it (`convert_phase`).
        let wanted = (phase / of * phases as f64 + 0.5) as i64;
        let [from, to] = [start, rail.endstop].map(|mm| (mm * steps_per_mm).round() as i64);
        let missing = (wanted - (to - from)).rem_euclid(phases);
        let from = if rail.at_max { from - missing } else { from + (phases - missing) % phases };
        self.in_phase.insert(section.name.clone());
        Ok(from as f64 / steps_per_mm)
    }

    /// The section of a motor that the kinematics need.
    fn stepper(&self, axis: &str) -> Result<&'a Section, Trouble> {
        let config = self.config;
        config.section(&format!("stepper_{axis}")).ok_or_else(|| {
            let cause = format!("Option 'step_pin' in section 'stepper_{axis}' must be specified");
            Trouble::new(cause).remedy(format!("add [stepper_{axis}]"))
        })
    }

    /// An axis whose endstop is at its highest place.
    fn axis_below(&mut self, name: &str, section: &Section, min: f64, highest: f64, start: f64) -> Result<(), Trouble> {
        let entry = self.motor(section, name)?;
        let endstop = self.endstop(section)?;
        let rail = Rail { min, max: highest, endstop: highest, at_max: true, overtravel: OVERTRAVEL_MM };
        let start = self.in_phase(section, &rail, &endstop, start)?;
        self.out.add("axis", Translator::with_rail(entry, &rail, &endstop, start));
        Ok(())
    }

    /// An axis of a cartesian printer, with all of its motors.
    fn rail(&mut self, axis: &str) -> Result<(), Trouble> {
        let section = self.stepper(axis)?;
        let rail = self.travel(section)?;
        let entry = self.motor(section, axis)?;
        let endstop = self.endstop(section)?;
        let start = match (axis, rail.at_max) {
            ("z", false) => rail.min.max(0.0) + START_HEIGHT_MM,
            _ => rail.before_endstop(),
        };
        let start = self.in_phase(section, &rail, &endstop, start)?;
        let others: Vec<&Section> =
            (1..100).map_while(|n| self.config.section(&format!("stepper_{axis}{n}"))).collect();
        let places = if axis == "z" { self.z_places(1 + others.len())? } else { None };
        let tilts_mm = places.as_deref().map(tilts_mm).unwrap_or_default();
        let place = |entry: Entry, n: usize| match places.as_ref().and_then(|places| places.get(n)) {
            Some([x, y]) => entry.numbers("at_mm", [*x, *y]),
            None => entry,
        };
        self.out.add("axis", place(Translator::with_rail(entry, &rail, &endstop, start), 0));
        for (n, section) in (1..).zip(others) {
            let entry = self.motor(section, &format!("{axis}{n}"))?;
            let endstop = match section.text("endstop_pin") {
                Some(_) => self.endstop(section)?,
                None => Endstop::Other,
            };
            let start = start + tilts_mm.get(n).copied().unwrap_or_default();
            self.out.add("axis", place(Translator::with_rail(entry, &rail, &endstop, start), n));
        }
        Ok(())
    }

    /// Where the motors of the z axis hold the bed or the gantry.
    fn z_places(&self, motors: usize) -> Result<Option<Vec<[f64; 2]>>, Trouble> {
        let pair = |row: &Vec<f64>| match row[..] {
            [x, y, ..] => Some([x, y]),
            _ => None,
        };
        for kind in ["z_tilt", "z_tilt_ng"] {
            if let Some(rows) = self.config.section(kind).map(|section| section.rows("z_positions")).transpose()? {
                let places: Vec<[f64; 2]> = rows.iter().flatten().filter_map(pair).collect();
                return Ok((places.len() == motors && motors > 1).then_some(places));
            }
        }
        if let Some(rows) = self.config.section("quad_gantry_level").map(|section| section.rows("gantry_corners")) {
            let corners: Vec<[f64; 2]> = rows?.iter().flatten().filter_map(pair).collect();
            if let ([[left, front], [right, rear]], 4) = (&corners[..], motors) {
                return Ok(Some(vec![[*left, *front], [*left, *rear], [*right, *rear], [*right, *front]]));
            }
        }
        Ok(None)
    }

    /// The second carriage of a printer with two.
    fn dual_carriage(&mut self) -> Result<(), Trouble> {
        let Some(section) = self.config.section("dual_carriage") else { return Ok(()) };
        let rail = self.travel(section)?;
        let entry = self.motor(section, "dual_carriage")?;
        let endstop = self.endstop(section)?;
        let entry = Translator::with_rail(entry, &rail, &endstop, rail.before_endstop());
        let entry = if section.text("axis") == Some("y") { entry.set("along", "y") } else { entry };
        self.out.add("axis", entry);
        Ok(())
    }

    fn generic(&mut self) -> Result<(), Trouble> {
        self.out.set("kinematics", Entry::default().set("kind", "generic_cartesian"));
        let carriages = |kind| self.config.of_kind(kind).collect::<Vec<&Section>>();
        let all: Vec<&Section> = ["carriage", "dual_carriage", "extra_carriage"].map(carriages).concat();
        let mut names = HashMap::new();
        for section in all {
            let own = section.own_name().unwrap_or_default();
            let primary = section.text("primary_carriage");
            let along = section.text("axis").or(primary.and_then(|name| names.get(name).copied())).unwrap_or(own);
            // The first carriage of an axis has the axis's name in a description.
            let name = if section.kind() == "carriage" { along } else { own };
            names.insert(own, name);
            // An extra carriage goes where the primary one goes, and has an endstop of its own.
            let with_travel = match primary.filter(|_| section.kind() == "extra_carriage") {
                Some(name) => ["carriage", "dual_carriage"].map(|kind| self.config.section(&format!("{kind} {name}"))),
                None => [Some(section), None],
            };
            let rail = self.travel(with_travel.into_iter().flatten().next().unwrap_or(section))?;
            let endstop = self.endstop(section)?;
            let start = match (along, rail.at_max) {
                ("z", false) => rail.min.max(0.0) + START_HEIGHT_MM,
                _ => rail.before_endstop(),
            };
            let entry = Entry::default().set("name", name);
            self.out.add("carriage", Translator::with_rail(entry, &rail, &endstop, start));
        }
        for section in self.config.of_kind("stepper") {
            let name = section.own_name().unwrap_or_default();
            let entry = self.motor(section, name)?;
            let mut carriages = toml::Table::new();
            // For example `x-y` or `0.5*x`.
            let terms = section.required("carriages")?.replace('-', "+-").replace(char::is_whitespace, "");
            for term in terms.split('+').filter(|term| !term.is_empty()) {
                let (sign, term) = term.strip_prefix('-').map_or((1.0, term), |rest| (-1.0, rest));
                let (factor, carriage) = match term.split_once('*') {
                    Some((a, b)) => a.parse().map(|a: f64| (a, b)).or_else(|_| b.parse().map(|b: f64| (b, a))),
                    None => Ok((1.0, term)),
                }
                .map_err(|_| section.trouble("carriages", format!("Invalid term '{term}'")).remedy("correct it"))?;
                let carriage = names.get(carriage).copied().unwrap_or(carriage);
                carriages.insert(carriage.to_owned(), (sign * factor).into());
            }
            self.out.add("axis", entry.set("carriages", carriages));
        }
        Ok(())
    }

    /// The three sections of a delta printer.
    fn towers(&self) -> Result<[&'a Section; 3], Trouble> {
        Ok([self.stepper("a")?, self.stepper("b")?, self.stepper("c")?])
    }

    /// An option of three towers. The first one's value is the default of the others.
    fn of_towers(towers: [&Section; 3], key: &str) -> Result<[f64; 3], Trouble> {
        towers[0].required(key)?;
        let first = towers[0].number(key, Limit::Any)?.unwrap_or(0.0);
        let value = |tower: &Section| tower.number(key, Limit::Any).map(|number| number.unwrap_or(first));
        Ok([first, value(towers[1])?, value(towers[2])?])
    }

    fn angles(towers: [&Section; 3], defaults: [f64; 3]) -> Result<[f64; 3], Trouble> {
        let mut angles = defaults;
        for (angle, tower) in angles.iter_mut().zip(towers) {
            *angle = tower.number("angle", Limit::Any)?.unwrap_or(*angle);
        }
        Ok(angles)
    }

    fn delta(&mut self, printer: &Section) -> Result<(), Trouble> {
        let towers = self.towers()?;
        printer.required("delta_radius")?;
        let radius = printer.number("delta_radius", Limit::Above(0.0))?.unwrap_or(1.0);
        let bed_radius = printer.number("print_radius", Limit::Above(0.0))?.unwrap_or(radius);
        let arms = Translator::of_towers(towers, "arm_length")?;
        let endstops = Translator::of_towers(towers, "position_endstop")?;
        let angles = Translator::angles(towers, [210.0, 330.0, 90.0])?;
        for (n, (name, section)) in ["a", "b", "c"].into_iter().zip(towers).enumerate() {
            let highest = endstops[n] + (arms[n] * arms[n] - radius * radius).max(0.0).sqrt();
            self.axis_below(name, section, 0.0, highest, highest - BEFORE_ENDSTOP_MM)?;
        }
        let entry = Entry::default()
            .set("kind", "delta")
            .set("radius_mm", radius)
            .set("arm_mm", arms[0])
            .set("bed_radius_mm", bed_radius);
        let entry = entry.numbers("arms_mm", arms).numbers("angles_degrees", angles);
        self.out.set("kinematics", entry);
        Ok(())
    }

    fn deltesian(&mut self) -> Result<(), Trouble> {
        let sides = [self.stepper("left")?, self.stepper("right")?];
        let of = |key: &str| {
            sides[0].required(key)?;
            let left = sides[0].number(key, Limit::Any)?.unwrap_or(1.0);
            Ok::<_, Trouble>([left, sides[1].number(key, Limit::Any)?.unwrap_or(left)])
        };
        let (arms, arm_x, endstops) = (of("arm_length")?, of("arm_x_length")?, of("position_endstop")?);
        for (n, (name, section)) in ["left", "right"].into_iter().zip(sides).enumerate() {
            let highest = endstops[n] + (arms[n] * arms[n] - arm_x[n] * arm_x[n]).max(0.0).sqrt();
            self.axis_below(name, section, 0.0, highest, highest - BEFORE_ENDSTOP_MM)?;
        }
        self.rail("y")?;
        let entry = Entry::default().set("kind", "deltesian").numbers("arms_mm", arms).numbers("arm_x_mm", arm_x);
        self.out.set("kinematics", entry);
        Ok(())
    }

    fn polar(&mut self) -> Result<(), Trouble> {
        let entry = self.motor(self.stepper("bed")?, "bed")?;
        self.out.add("axis", entry);
        let arm = self.stepper("arm")?;
        let rail = self.travel(arm)?;
        let entry = self.motor(arm, "arm")?;
        let endstop = self.endstop(arm)?;
        let start = if rail.at_max { rail.endstop - BEFORE_ENDSTOP_MM } else { rail.endstop + BEFORE_ENDSTOP_MM };
        self.out.add("axis", Translator::with_rail(entry, &rail, &endstop, start));
        self.rail("z")?;
        self.out.set("kinematics", Entry::default().set("kind", "polar"));
        Ok(())
    }

    fn rotary_delta(&mut self, printer: &Section) -> Result<(), Trouble> {
        let towers = self.towers()?;
        let number = |key: &str| {
            printer.required(key)?;
            printer.number(key, Limit::Above(0.0)).map(|number| number.unwrap_or(1.0))
        };
        let (radius, height) = (number("shoulder_radius")?, number("shoulder_height")?);
        let upper = Translator::of_towers(towers, "upper_arm_length")?;
        let lower = Translator::of_towers(towers, "lower_arm_length")?;
        let endstops = Translator::of_towers(towers, "position_endstop")?;
        let angles = Translator::angles(towers, [30.0, 150.0, 270.0])?;
        for (n, (name, section)) in ["a", "b", "c"].into_iter().zip(towers).enumerate() {
            // The arm's angle while the nozzle is in the middle, at the endstop's height. The elbow is at the upper arm's
            // length from the shoulder, at the lower arm's length from the nozzle, and outside (rotary_delta.py).
            let (u, l, h) = (upper[n], lower[n], height - endstops[n]);
            let distance = radius.hypot(h);
            let share = (l * l - distance * distance - u * u) / (2.0 * u * distance);
            let angle = h.atan2(radius) - share.clamp(-1.0, 1.0).acos();
            self.axis_below(name, section, angle - 2.0, angle, angle - 0.1)?;
        }
        let entry = Entry::default().set("kind", "rotary_delta").set("shoulder_radius_mm", radius);
        let entry = entry.set("shoulder_height_mm", height).numbers("upper_arms_mm", upper);
        let entry = entry.numbers("lower_arms_mm", lower).numbers("angles_degrees", angles);
        self.out.set("kinematics", entry.set("bed_radius_mm", radius));
        Ok(())
    }

    fn winch(&mut self) -> Result<(), Trouble> {
        let config = self.config;
        let mut anchors = Vec::new();
        for name in ('a'..='z').map(String::from) {
            let Some(section) = config.section(&format!("stepper_{name}")) else { break };
            let mut anchor = [0.0; 3];
            for (place, key) in anchor.iter_mut().zip(["anchor_x", "anchor_y", "anchor_z"]) {
                section.required(key)?;
                *place = section.number(key, Limit::Any)?.unwrap_or(0.0);
            }
            let length = anchor.iter().map(|mm| mm * mm).sum::<f64>().sqrt();
            let entry = self.motor(section, &name)?;
            self.out.add("axis", entry.set("start_mm", length));
            anchors.push(anchor);
        }
        self.out.set("kinematics", Entry::default().set("kind", "winch").rows("anchors_mm", anchors));
        Ok(())
    }

    /// Extruders, and motors that belong to no axis.
    fn other_motors(&mut self) -> Result<(), Trouble> {
        for section in self.config.sections() {
            let kind = section.kind();
            let is_extruder = kind.strip_prefix("extruder").is_some_and(|n| n.chars().all(|c| c.is_ascii_digit()));
            if is_extruder || kind == "extruder_stepper" || kind == "manual_stepper" {
                if is_extruder && section.text("step_pin").is_none() {
                    continue;
                }
                // Two sections may drive one motor.
                if let Some(axis) = self.owner(section, "step_pin")?.and_then(|owner| self.axes.get(owner)).cloned() {
                    self.axes.insert(section.name.clone(), axis);
                    continue;
                }
                let name = self.out.name("axis", section.own_name().unwrap_or(&section.name));
                let entry = self.motor(section, &name)?;
                let entry = match (kind, section.text("endstop_pin")) {
                    ("manual_stepper", Some(_)) => {
                        let endstop = self.endstop(section)?;
                        let rail = Rail {
                            min: -FREE_MM,
                            max: FREE_MM,
                            endstop: 0.0,
                            at_max: false,
                            overtravel: OVERTRAVEL_MM,
                        };
                        Translator::with_rail(entry, &rail, &endstop, BEFORE_ENDSTOP_MM)
                    }
                    _ => entry,
                };
                self.out.add("axis", entry);
            }
        }
        Ok(())
    }
}

/// How much higher each motor of a z axis begins than the first one. They hold a plane, which klippy can level.
fn tilts_mm(places: &[[f64; 2]]) -> Vec<f64> {
    let along = |axis: usize| {
        let mms = || places.iter().map(move |place| place[axis]);
        let span = mms().fold(f64::MIN, f64::max) - mms().fold(f64::MAX, f64::min);
        mms().map(move |mm| if span > 0.0 { TILT_MM[axis] * (mm - places[0][axis]) / span } else { 0.0 })
    };
    along(0).zip(along(1)).map(|(x, y)| x + y).collect()
}
