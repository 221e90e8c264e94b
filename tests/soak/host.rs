// SPDX-License-Identifier: GPL-3.0-or-later
//! A scripted host: it configures the MCU, heats, moves and homes, as klippy does in a print.

use std::collections::VecDeque;

use pinion_client::Arg;
use pinion_client::motion::{Profile, Run};

use crate::board::EXPANDED;
use crate::printer::{AXES, MS, Printer, SECOND};

/// How often the host sends something.
const TURN: u64 = 50 * MS;
/// How far ahead of its time a step is sent, and how soon the first step of a move may come.
const LOOKAHEAD: u64 = 400 * MS;
const LEAD: u64 = 150 * MS;
/// How often a heater's power is set, its period, and how long it may stay on without news.
const HEAT_EVERY: u64 = 300 * MS;
const CYCLE_TICKS: u32 = (100 * MS) as u32;
const MAX_DURATION: u32 = (5 * SECOND) as u32;
/// No heater gets hotter than the highest target allows.
const HOTTEST_CELSIUS: f64 = 260.0;
/// Ticks between two steps while homing.
const HOMING_INTERVAL: u32 = 10_000;
/// How far an axis travels while homing beyond its endstop, in steps: not as far as its hard limit.
const HOMING_BEYOND: i64 = 80;

pub const LED: u8 = 17;
const DISPLAY: u8 = 18;
const DRIVER: u8 = 21;
pub const HEATERS: [u8; 2] = [12, 13];
const ENDSTOPS: [u8; 3] = [4, 5, 6];
const TRSYNC: u8 = 7;
const ENABLES: [u8; 4] = [8, 9, 10, 11];
const SENSORS: [u8; 2] = [14, 15];
const FAN: u8 = 16;
const NOZZLE: u8 = 19;
const THERMOCOUPLE: u8 = 20;
const TACHOMETER: u8 = 22;
const LASER: u8 = 23;
const ACCELEROMETER: u8 = 24;
const ADXL345: u8 = 25;
const THERMOMETER: u8 = 26;
const BUTTONS: u8 = 27;
const STRIP: u8 = 28;
const OIDS: u8 = 29;
/// The thermometer under the bed.
const SERIAL: &[u8] = b"28-0316b5f6a2ff";

const STEP_PINS: [(&str, &str, &str); 4] = [
    ("x_step", "x_dir", "x_enable"),
    ("y_step", "y_dir", "y_enable"),
    ("z_step", "z_dir", "z_enable"),
    ("e_step", "e_dir", "e_enable"),
];
/// Per axis: the places where it moves, in steps; its highest speed and its acceleration in steps; the direction in
/// which the MCU counts up.
const MOTIONS: [(std::ops::Range<i64>, f64, f64, i64); 4] = [
    (0..17_600, 8000.0, 240_000.0, 1),
    (0..17_600, 8000.0, 240_000.0, -1),
    (0..4_000, 4000.0, 40_000.0, 1),
    (0..1 << 40, 1500.0, 100_000.0, 1),
];

fn oid(oid: u8) -> (&'static str, Arg<'static>) {
    ("oid", oid.into())
}

/// One axis, as the host knows it.
#[derive(Default)]
struct Axis {
    /// The printer's position when the MCU was configured, in steps.
    base: i64,
    /// The position after all steps that were sent.
    position: i64,
    direction: Option<bool>,
    /// When the last step that was sent is due.
    last: u64,
    /// The rest of the move, and when the next one begins.
    runs: VecDeque<Run>,
    next: u64,
    /// When the moves in the MCU's queue end.
    queued: VecDeque<u64>,
}

/// The host and its knowledge.
pub struct Host {
    axes: [Axis; 4],
    /// The temperature that each heater shall have, what its sensor said last, and the power of its last cycle.
    targets: [f64; 2],
    readings: [Option<f64>; 2],
    next_heat: u64,
    turns: u64,
    /// No new moves begin.
    rests: bool,
    homing: Option<Homing>,
    /// The text of the MCU's shutdown.
    pub stopped: Option<String>,
}

#[derive(PartialEq)]
enum Homing {
    Waits,
    Over(i64),
}

impl Host {
    /// Sends the configuration to an MCU that lacks a device. Returns the text of its shutdown.
    pub fn configure_in_vain(printer: &mut Printer) -> Option<String> {
        Host::send_objects(printer);
        let responses = printer.responses();
        let stop = responses.iter().find(|response| response.name == "shutdown");
        stop.map(|stop| stop.text("static_string_id").unwrap())
    }

    /// Configures the MCU, which has no configuration.
    pub fn configure(printer: &mut Printer) -> Host {
        Host::send_objects(printer);
        printer.send("finalize_config", &[("crc", 7.into())]);
        let config = printer.ask("get_config", &[], "config");
        assert_eq!((config.int("is_config").unwrap(), config.int("is_shutdown").unwrap()), (1, 0));
        let button = [("pos", 0.into()), ("pin", "filament_switch".into()), ("pull_up", 1.into())];
        printer.send("buttons_add", &[&[oid(BUTTONS)], &button[..]].concat());
        printer.is_strict = true;
        Host::begin(printer)
    }

    fn send_objects(printer: &mut Printer) {
        printer.send("allocate_oids", &[("count", OIDS.into())]);
        for (axis, (step, dir, enable)) in (0u8..).zip(STEP_PINS) {
            let pins = [("step_pin", step.into()), ("dir_pin", dir.into())];
            let rest = [oid(axis), ("invert_step", 0.into()), ("step_pulse_ticks", 100.into())];
            printer.send("config_stepper", &[&pins[..], &rest].concat());
            output(printer, ENABLES[usize::from(axis)], enable, true, 0);
        }
        for (endstop, pin) in ENDSTOPS.into_iter().zip(["x_endstop", "y_endstop", "z_endstop"]) {
            printer.send("config_endstop", &[oid(endstop), ("pin", pin.into()), ("pull_up", 1.into())]);
        }
        printer.send("config_trsync", &[oid(TRSYNC)]);
        for (heater, pin) in HEATERS.into_iter().zip(["hotend_heater", "bed_heater"]) {
            output(printer, heater, pin, false, MAX_DURATION);
        }
        output(printer, FAN, EXPANDED, false, MAX_DURATION);
        output(printer, LED, "led", false, 0);
        for pwm in [HEATERS[0], HEATERS[1], FAN, LED] {
            printer.send("set_digital_out_pwm_cycle", &[oid(pwm), ("cycle_ticks", CYCLE_TICKS.into())]);
        }
        for (sensor, pin) in SENSORS.into_iter().zip(["hotend_sensor", "bed_sensor"]) {
            printer.send("config_analog_in", &[oid(sensor), ("pin", pin.into())]);
        }
        let bus = [("i2c_bus", "i2c.1".into()), ("rate", 400_000.into()), ("address", 60.into())];
        if printer.has_parameter("config_i2c", "i2c_bus") {
            printer.send("config_i2c", &[&[oid(DISPLAY)], &bus[..]].concat());
        } else {
            printer.send("config_i2c", &[oid(DISPLAY)]);
            printer.send("i2c_set_bus", &[&[oid(DISPLAY)], &bus[..]].concat());
        }
        for (chip, pin, mode) in [(NOZZLE, "nozzle_cs", 0), (DRIVER, "z_cs", 3), (ACCELEROMETER, "accel_cs", 3)] {
            printer.send("config_spi", &[oid(chip), ("pin", pin.into()), ("cs_active_high", 0.into())]);
            let bus = [("spi_bus", "spidev1.0".into()), ("mode", mode.into()), ("rate", 4_000_000.into())];
            printer.send("spi_set_bus", &[&[oid(chip)], &bus[..]].concat());
        }
        let kind = [("spi_oid", NOZZLE.into()), ("thermocouple_type", "MAX31855".into())];
        printer.send("config_thermocouple", &[&[oid(THERMOCOUPLE)], &kind[..]].concat());
        printer.send("config_counter", &[oid(TACHOMETER), ("pin", "fan_tachometer".into()), ("pull_up", 1.into())]);
        printer.send("config_adxl345", &[oid(ADXL345), ("spi_oid", ACCELEROMETER.into())]);
        let limits = [("serial", SERIAL.into()), ("max_error_count", 4.into())];
        let ignore = printer.has_parameter("config_ds18b20", "ignore_limits");
        let ignore = if ignore { &[("ignore_limits", 0.into())][..] } else { &[] };
        printer.send("config_ds18b20", &[&[oid(THERMOMETER)], &limits[..], ignore].concat());
        printer.send("config_buttons", &[oid(BUTTONS), ("button_count", 1.into())]);
        let times = [("bit_max_ticks", 200.into()), ("reset_min_ticks", 2500.into())];
        printer.send(
            "config_neopixel",
            &[&[oid(STRIP), ("pin", "spidev3.0".into()), ("data_size", 24.into())], &times[..]].concat(),
        );
        let values = [("value", 0.into()), ("default_value", 0.into()), ("max_duration", MAX_DURATION.into())];
        let channel = [oid(LASER), ("pin", "pwm0".into()), ("cycle_ticks", 50_000.into())];
        printer.send("config_pwm_out", &[&channel[..], &values].concat());
    }

    /// Starts everything that a print needs.
    fn begin(printer: &mut Printer) -> Host {
        let now = printer.rig.now();
        let position = printer.positions();
        let axes = [0, 1, 2, 3].map(|axis| Axis {
            base: position[axis],
            position: position[axis],
            last: now,
            next: now + SECOND,
            ..Axis::default()
        });
        let targets = [[200.0, 60.0], [240.0, 90.0], [0.0, 50.0]];
        let targets = printer.dice.of(&targets);
        let (readings, homing, stopped) = ([None; 2], None, None);
        let host = Host { axes, targets, readings, next_heat: now, turns: 0, rests: false, homing, stopped };
        let soon = printer.wire(now + LEAD);
        for sensor in SENSORS {
            let bytes = printer.has_parameter("query_analog_in", "bytes_per_report");
            let bytes = if bytes { &[("bytes_per_report", 2.into())][..] } else { &[] };
            let limits = [("min_value", 160.into()), ("max_value", 32_400.into()), ("range_check_count", 4.into())];
            let samples = [("sample_ticks", 50_000.into()), ("sample_count", 8.into())];
            let times = [oid(sensor), ("clock", soon.into()), ("rest_ticks", ((300 * MS) as u32).into())];
            printer.send("query_analog_in", &[&times[..], &samples, bytes, &limits].concat());
        }
        let times = [oid(THERMOCOUPLE), ("clock", soon.into()), ("rest_ticks", (SECOND as u32).into())];
        let limits = [("min_value", 0.into()), ("max_value", u32::MAX.into()), ("max_invalid_count", 3.into())];
        printer.send("query_thermocouple", &[&times[..], &limits].concat());
        let times = [("clock", soon.into()), ("poll_ticks", 75_000.into()), ("sample_ticks", (SECOND as u32).into())];
        printer.send("query_counter", &[&[oid(TACHOMETER)], &times[..]].concat());
        let times = [oid(BUTTONS), ("clock", soon.into()), ("rest_ticks", ((2 * MS) as u32).into())];
        printer.send("buttons_query", &[&times[..], &[("retransmit_count", 50.into()), ("invert", 0.into())]].concat());
        let times = [oid(THERMOMETER), ("clock", soon.into()), ("rest_ticks", (SECOND as u32 / 2).into())];
        let limits = [("min_value", 0.into()), ("max_value", 125_000.into())];
        printer.send("query_ds18b20", &[&times[..], &limits].concat());
        // The chip measures into its FIFO, a hundred times a second.
        for register in [[0x2c, 0x0a], [0x31, 0x0b], [0x38, 0x80], [0x2d, 0x08]] {
            printer.send("spi_send", &[oid(ACCELEROMETER), ("data", (&register[..]).into())]);
        }
        let clock = printer.has_parameter("query_adxl345", "clock");
        let clock = if clock { &[("clock", soon.into())][..] } else { &[] };
        printer.send("query_adxl345", &[&[oid(ADXL345), ("rest_ticks", (SECOND as u32 / 50).into())], clock].concat());
        for (axis, enable) in (0u8..).zip(ENABLES) {
            printer.send("update_digital_out", &[oid(enable), ("value", 0.into())]);
            printer.send("reset_step_clock", &[oid(axis), ("clock", printer.wire(now).into())]);
        }
        host
    }

    /// Lets this many ticks pass and does a host's work meanwhile.
    pub fn work(&mut self, printer: &mut Printer, ticks: u64) {
        let end = printer.rig.now() + ticks;
        while printer.rig.now() < end && self.stopped.is_none() {
            self.turn(printer);
        }
    }

    fn turn(&mut self, printer: &mut Printer) {
        printer.pass(TURN);
        self.listen(printer);
        let now = printer.rig.now();
        self.turns += 1;
        if now >= self.next_heat {
            self.heat(printer);
        }
        for axis in 0..AXES.len() {
            self.plan(printer, axis);
        }
        if self.turns.is_multiple_of(20) {
            self.show(printer);
        }
        if self.turns.is_multiple_of(31) {
            printer.send("spi_transfer", &[oid(DRIVER), ("data", (&[0x6a, 0, 0, 0, 0][..]).into())]);
        }
        self.listen(printer);
        if self.turns.is_multiple_of(17) && self.stopped.is_none() {
            printer.compare_clocks();
        }
    }

    /// Writes to the display and the lights.
    fn show(&mut self, printer: &mut Printer) {
        let colors = [self.turns as u8; 6];
        printer.send("neopixel_update", &[oid(STRIP), ("pos", 3.into()), ("data", (&colors[..]).into())]);
        printer.send("neopixel_send", &[oid(STRIP)]);
        let line = [0x40, self.turns as u8, 0x55, 0xaa];
        if printer.has_parameter("i2c_transfer", "write") {
            printer.send("i2c_transfer", &[oid(DISPLAY), ("write", (&line[..]).into()), ("read_len", 0.into())]);
        } else {
            printer.send("i2c_write", &[oid(DISPLAY), ("data", (&line[..]).into())]);
        }
    }

    /// Takes the responses of the MCU.
    pub fn listen(&mut self, printer: &mut Printer) {
        for response in printer.responses() {
            match response.name.as_str() {
                "shutdown" => self.stopped = Some(response.text("static_string_id").unwrap()),
                "analog_in_state" => {
                    let sum = match response.bytes("values") {
                        Ok(values) => u32::from(values[0]) | u32::from(values[1]) << 8,
                        Err(_) => response.u32("value").unwrap(),
                    };
                    let sensor = usize::from(response.int("oid").unwrap() != i64::from(SENSORS[0]));
                    self.readings[sensor] = Some(f64::from(sum) / 8.0 / 4095.0);
                }
                "trsync_state" if response.int("can_trigger").unwrap() == 0 && self.homing == Some(Homing::Waits) => {
                    self.homing = Some(Homing::Over(response.int("trigger_reason").unwrap()));
                }
                "buttons_state" => printer.send("buttons_ack", &[oid(BUTTONS), ("count", 1.into())]),
                "sensor_bulk_data" | "adxl345_data" => printer.tally.measurements += 1,
                _ => {}
            }
        }
    }

    /// Sets the power of the heaters, the fan and the laser.
    fn heat(&mut self, printer: &mut Printer) {
        let at = self.next_heat.max(printer.rig.now()) + LEAD;
        self.next_heat = at - LEAD + HEAT_EVERY;
        let mut powers = [0.0; 3];
        for (n, thermistor) in printer.thermistors.iter().enumerate() {
            if let Some(fraction) = self.readings[n] {
                let celsius = thermistor.celsius(fraction);
                powers[n] = ((self.targets[n] - celsius) / 10.0).clamp(0.0, 1.0);
            }
        }
        assert!(printer.probe.heaters().all(|heater| heater.celsius < HOTTEST_CELSIUS));
        powers[2] = 0.5;
        for (output, power) in [HEATERS[0], HEATERS[1], FAN].into_iter().zip(powers) {
            self.set(printer, output, at, (power * f64::from(CYCLE_TICKS)) as u32);
        }
        let value = 1000 + printer.dice.below(30_000) as u32;
        let laser = [oid(LASER), ("clock", printer.wire(at).into()), ("value", value.into())];
        printer.send("queue_pwm_out", &laser);
    }

    /// Sets an output at a time.
    pub fn set(&mut self, printer: &mut Printer, output: u8, at: u64, on_ticks: u32) {
        let clock = printer.wire(at);
        printer.send("queue_digital_out", &[oid(output), ("clock", clock.into()), ("on_ticks", on_ticks.into())]);
    }

    /// Turns a heater on for the whole of each cycle.
    pub fn heat_up(&mut self, printer: &mut Printer) {
        self.set(printer, HEATERS[0], self.next_heat.max(printer.rig.now()) + LEAD, CYCLE_TICKS);
    }

    // ---- motion

    /// Sends the steps of the near future.
    fn plan(&mut self, printer: &mut Printer, number: usize) {
        let now = printer.rig.now();
        let (range, speed, acceleration, _) = MOTIONS[number].clone();
        let axis = &mut self.axes[number];
        while axis.queued.front().is_some_and(|end| *end < now) {
            axis.queued.pop_front();
        }
        while axis.last < now + LOOKAHEAD && axis.queued.len() < 200 {
            if let Some(run) = axis.runs.pop_front() {
                axis.last += run.ticks();
                axis.queued.push_back(axis.last);
                axis.position += i64::from(run.count) * if axis.direction == Some(true) { 1 } else { -1 };
                queue_step(printer, number as u8, run);
                printer.tally.steps += u64::from(run.count);
                continue;
            }
            if self.rests || axis.next > now + LOOKAHEAD {
                return;
            }
            // A new move.
            let target = match number {
                3 => axis.position + [300, 500, -150][printer.dice.below(3)],
                _ => range.start + printer.dice.below((range.end - range.start) as usize) as i64,
            };
            let steps = (target - axis.position).unsigned_abs() as u32;
            axis.next = axis.next.max(now + LEAD);
            if steps < 100 {
                axis.next += 100 * MS;
                continue;
            }
            let speed = speed * (0.2 + 0.2 * printer.dice.below(5) as f64);
            let profile = Profile::trapezoid(steps, speed, acceleration, SECOND as f64).unwrap();
            axis.runs = profile.runs.into();
            let Some(first) = axis.runs.pop_front() else { return };
            let forward = target > axis.position;
            if axis.direction != Some(forward) {
                axis.direction = Some(forward);
                let dir = forward == (MOTIONS[number].3 > 0);
                printer.send("set_next_step_dir", &[oid(number as u8), ("dir", dir.into())]);
            }
            // The first step comes after a pause, so it is alone. The interval may wrap: only its 32-bit clock counts.
            let at = axis.next.max(axis.last) + u64::from(first.interval);
            let interval = printer.wire(at).wrapping_sub(printer.wire(axis.last));
            queue_step(printer, number as u8, Run { interval, count: 1, add: 0 });
            axis.position += if forward { 1 } else { -1 };
            axis.last = at;
            axis.queued.push_back(at);
            let interval = first.interval.wrapping_add_signed(first.add.into());
            if first.count > 1 {
                axis.runs.push_front(Run { interval, count: first.count - 1, add: first.add });
            }
            axis.next = at + profile.ticks + printer.dice.below((SECOND / 4) as usize) as u64;
            if printer.dice.below(40) == 0 {
                axis.next += 3 * SECOND;
            }
        }
    }

    fn is_at_rest(&self, now: u64) -> bool {
        self.axes.iter().all(|axis| axis.runs.is_empty() && axis.last < now)
    }

    /// An axis that has no steps to make.
    pub fn idle_axis(&self, now: u64) -> Option<usize> {
        self.axes.iter().position(|axis| axis.runs.is_empty() && axis.last < now)
    }

    /// Ends all moves, compares every position, and homes an axis.
    pub fn rest(&mut self, printer: &mut Printer) {
        self.rests = true;
        while !self.is_at_rest(printer.rig.now()) && self.stopped.is_none() {
            self.turn(printer);
        }
        if self.stopped.is_none() {
            self.compare(printer);
            let commanded = [0, 1, 2, 3].map(|axis| self.axes[axis].position);
            assert_eq!(printer.positions(), commanded, "what the printer did, and what the host commanded");
            let axis = printer.dice.below(3);
            self.home(printer, axis);
        }
        let now = printer.rig.now();
        self.axes.iter_mut().for_each(|axis| axis.next = axis.next.max(now + LEAD));
        self.rests = false;
    }

    /// Compares the positions that the MCU reports with the printer's.
    pub fn compare(&mut self, printer: &mut Printer) {
        for (axis, (name, _)) in AXES.iter().enumerate() {
            let known = self.position(printer, axis);
            assert_eq!(printer.steps_of(axis), known, "{name}: the printer's position, and the MCU's");
        }
        let lost: u64 = printer.probe.axes().map(|axis| axis.lost_steps).sum();
        assert_eq!(lost, 0, "steps against the end of an axis");
        printer.tally.comparisons += 1;
    }

    /// The position of an axis in the printer's steps, as the MCU counts.
    fn position(&self, printer: &mut Printer, axis: usize) -> i64 {
        let state = printer.ask("stepper_get_position", &[oid(axis as u8)], "stepper_position");
        self.axes[axis].base + MOTIONS[axis].3 * state.int("pos").unwrap()
    }

    fn home(&mut self, printer: &mut Printer, number: usize) {
        printer.note(format!("homes {}", AXES[number].0));
        let way = self.axes[number].position + HOMING_BEYOND;
        let start = printer.rig.now() + LEAD;
        let clock = |printer: &Printer, at: u64| ("clock", printer.wire(at).into());
        self.homing = Some(Homing::Waits);
        let (stepper, endstop) = (oid(number as u8), oid(ENDSTOPS[number]));
        let report = [("report_clock", printer.wire(start).into()), ("report_ticks", (SECOND as u32 / 4).into())];
        printer.send("trsync_start", &[&[oid(TRSYNC), ("expire_reason", 4.into())], &report[..]].concat());
        printer.send("stepper_stop_on_trigger", &[stepper, ("trsync_oid", TRSYNC.into())]);
        let samples = [("sample_ticks", 750.into()), ("sample_count", 4.into()), ("pin_value", 1.into())];
        let trigger = [("trsync_oid", TRSYNC.into()), ("trigger_reason", 1.into())];
        let times = [endstop, clock(printer, start), ("rest_ticks", HOMING_INTERVAL.into())];
        printer.send("endstop_home", &[&times[..], &samples, &trigger].concat());
        printer.send("set_next_step_dir", &[stepper, ("dir", (MOTIONS[number].3 < 0).into())]);
        printer.send("reset_step_clock", &[stepper, clock(printer, start)]);
        queue_step(printer, number as u8, Run { interval: HOMING_INTERVAL, count: way as u16, add: 0 });
        while self.homing == Some(Homing::Waits) && self.stopped.is_none() {
            let timeout = clock(printer, printer.rig.now() + SECOND / 2);
            printer.send("trsync_set_timeout", &[oid(TRSYNC), timeout]);
            self.turn(printer);
        }
        if self.stopped.is_some() {
            return;
        }
        assert!(self.homing.take() == Some(Homing::Over(1)), "homing ends by the endstop");
        printer.send("trsync_trigger", &[oid(TRSYNC), ("reason", 2.into())]);
        self.compare(printer);
        let position = printer.steps_of(number);
        assert!((-1..=0).contains(&position), "homed at step {position}");
        let now = printer.rig.now();
        printer.send("reset_step_clock", &[stepper, clock(printer, now)]);
        printer.tally.homings += 1;
        self.axes[number] = Axis { base: self.axes[number].base, position, last: now, ..Axis::default() };
    }
}

fn output(printer: &mut Printer, number: u8, pin: &str, idle: bool, max_duration: u32) {
    let levels = [("value", idle.into()), ("default_value", idle.into()), ("max_duration", max_duration.into())];
    printer.send("config_digital_out", &[&[oid(number), ("pin", pin.into())], &levels[..]].concat());
}

fn queue_step(printer: &mut Printer, stepper: u8, run: Run) {
    let count = [("count", run.count.into()), ("add", run.add.into())];
    printer.send("queue_step", &[&[oid(stepper), ("interval", run.interval.into())], &count[..]].concat());
}
