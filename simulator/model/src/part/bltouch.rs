// SPDX-License-Identifier: GPL-3.0-or-later
//! The probe BLTouch Smart V3 (ANTCLABS, "BLTouch Smart V3.1" manual). On command it lowers a push-pin. The pin
//! retracts by itself when it touches the bed.
//!
//! Servo pulses on the control line give the commands by their widths. Repeated pulses of one width are one command.
//! The sensor line gives a pulse of 10 ms at a touch. In touch mode it follows the pin instead: it is high while the
//! pin is up. A pin that cannot reach its target raises the alarm. In the alarm the line is high until a command
//! releases it.
//!
//! Simulated: pin down, touch mode, pin up, self-test, reset, the pin's time to move, the touch, the alarm. Not
//! simulated: the modes of the output's voltage, the heat of a pin that is held for long, the lights.
//!
//! A touch is noticed only when the sensor line is read. A host reads it at each step of a probing move.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Workshop};
use crate::description::check::{Bound, Trouble, check, check_offsets};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::bed::Bed;
use crate::engine::look::Look;
use crate::engine::seqlock::Seqlock;
use crate::engine::time::seconds;
use crate::engine::wire::{Wire, input, output};
use crate::engine::world::Sight;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::Clock;

/// How long the sensor line is high after a touch.
const TOUCH_PULSE_S: f64 = 0.010;
/// How far a pulse may be from a command's width: less than half of the distance between the two closest widths.
const WIDTH_TOLERANCE_US: f64 = 45.0;
/// Longest time between two pulses of one command. A servo's pulses come every 20 ms. The same pulse after a longer
/// pause is a new command.
const TRAIN_S: f64 = 0.050;
/// How many times the pin goes down and up in the self-test.
const SELF_TEST_ROUNDS: f64 = 10.0;

/// The probe's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BltouchConfig {
    /// The input for the servo's pulses.
    pub control_pin: PinName,
    /// Reports a touch.
    pub sensor_pin: PinName,
    /// How far the probe is from the nozzle along the x axis.
    #[serde(default)]
    pub x_offset_mm: f64,
    /// How far the probe is from the nozzle along the y axis.
    #[serde(default)]
    pub y_offset_mm: f64,
    /// How far below the nozzle the pin touches the bed.
    pub z_offset_mm: f64,
    /// How long the pin takes to go down or up.
    #[serde(default = "default_move_s")]
    pub move_s: f64,
    /// Where the pin is stuck, if it is stuck.
    pub jams: Option<Jam>,
}

fn default_move_s() -> f64 {
    0.3
}

/// The place where a pin is stuck.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Jam {
    /// The pin does not go down.
    Up,
    /// The pin does not go up.
    Down,
}

impl Part for BltouchConfig {
    fn name(&self) -> String {
        "bltouch".into()
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("control_pin", Some(&self.control_pin)), ("sensor_pin", Some(&self.sensor_pin))]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        check_offsets(whose, [self.x_offset_mm, self.y_offset_mm, self.z_offset_mm])?;
        check(whose, "move_s", self.move_s, Bound::AboveZero)
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let probe = Arc::new(Bltouch::new(self, workshop.bed()));
        workshop.wire(Some(&self.control_pin), control_pin(probe.clone()));
        workshop.wire(Some(&self.sensor_pin), sensor_pin(probe.clone()));
        workshop.show(probe);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.probe(layout, |cfg| {
            cfg.section("bltouch");
            cfg.key("control_pin", &self.control_pin);
            cfg.key("sensor_pin", &self.sensor_pin);
            cfg.offsets([self.x_offset_mm, self.y_offset_mm, self.z_offset_mm]);
        });
    }
}

/// The manual's commands.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Command {
    PinDown,
    /// Also releases the alarm.
    TouchMode,
    PinUp,
    SelfTest,
    /// The voltage of the output and its memory. They have no visible effect here.
    OutputMode,
    /// Releases the alarm, and raises the pin.
    Reset,
}

/// The widths of the commands' pulses.
const COMMANDS: [(f64, Command); 8] = [
    (650.0, Command::PinDown),
    (1165.0, Command::TouchMode),
    (1475.0, Command::PinUp),
    (1780.0, Command::SelfTest),
    (1884.0, Command::OutputMode),
    (1988.0, Command::OutputMode),
    (2091.0, Command::OutputMode),
    (2190.0, Command::Reset),
];

/// The pin's target.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Target {
    Up,
    Down,
    SelfTest,
}

/// The probe's whole state.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    way: Target,
    /// When the pin started to move.
    since: Clock,
    touch_mode: bool,
    alarm: bool,
    /// Whether a touch has pushed the pin up, and no command has come since: it falls again where it has room.
    falls: bool,
    /// The end of the sensor line's pulse.
    touched: Option<Clock>,
    /// When the control line's pulse began.
    rise: Clock,
    /// The last command's index in [`COMMANDS`]; the next field is when it was last given.
    command: Option<usize>,
    commanded: Clock,
}

const NO_COMMAND: u64 = COMMANDS.len() as u64;

impl State {
    fn words(self) -> [u64; 5] {
        let command = self.command.map_or(NO_COMMAND, |place| place as u64);
        let flags = self.way as u64
            | u64::from(self.touch_mode) << 2
            | u64::from(self.alarm) << 3
            | u64::from(self.touched.is_some()) << 4
            | u64::from(self.falls) << 5
            | command << 6;
        let touched = self.touched.map_or(0, Clock::ticks);
        [flags, self.since.ticks(), touched, self.rise.ticks(), self.commanded.ticks()]
    }

    fn of([flags, since, touched, rise, commanded]: [u64; 5]) -> State {
        let command = flags >> 6;
        State {
            way: [Target::Up, Target::Down, Target::SelfTest, Target::Up][(flags & 3) as usize],
            since: Clock::from_ticks(since),
            touch_mode: flags & 4 != 0,
            alarm: flags & 8 != 0,
            falls: flags & 32 != 0,
            touched: (flags & 16 != 0).then(|| Clock::from_ticks(touched)),
            rise: Clock::from_ticks(rise),
            command: (command != NO_COMMAND).then_some(command as usize),
            commanded: Clock::from_ticks(commanded),
        }
    }
}

struct Bltouch {
    bed: Bed,
    /// The point where the lowered pin touches, relative to the nozzle.
    tip: [f64; 3],
    move_s: f64,
    jams: Option<Jam>,
    state: Seqlock<5>,
}

impl Bltouch {
    fn new(config: &BltouchConfig, bed: Bed) -> Bltouch {
        let start = Clock::from_ticks(0);
        let state = State {
            way: Target::Up,
            since: start,
            touch_mode: false,
            alarm: false,
            falls: false,
            touched: None,
            rise: start,
            command: None,
            commanded: start,
        };
        Bltouch {
            bed,
            tip: [config.x_offset_mm, config.y_offset_mm, -config.z_offset_mm],
            move_s: config.move_s,
            jams: config.jams,
            state: Seqlock::new(state.words()),
        }
    }

    fn is_against_the_bed(&self) -> bool {
        self.bed.clearance_mm(self.tip) <= 0.0
    }

    /// The state at this time.
    fn at(&self, now: Clock) -> State {
        let mut state = State::of(self.state.load());
        let elapsed_s = seconds(state.since, now);
        if state.alarm || elapsed_s < self.move_s {
            return state;
        }
        if state.falls && !self.is_against_the_bed() {
            (state.way, state.falls) = (Target::Down, false);
        }
        match state.way {
            Target::Up => state.alarm = self.jams == Some(Jam::Down) && !state.touch_mode,
            Target::SelfTest if elapsed_s >= 2.0 * SELF_TEST_ROUNDS * self.move_s => state.way = Target::Up,
            Target::SelfTest => state.alarm = self.jams.is_some(),
            Target::Down if self.jams == Some(Jam::Up) => {
                state.alarm = true;
                state.way = Target::Up;
            }
            Target::Down if self.is_against_the_bed() && !state.touch_mode => {
                state.way = Target::Up;
                state.since = now;
                state.touched = Some(now);
                state.falls = true;
            }
            Target::Down => {}
        }
        state
    }

    /// Whether the pin is up, or pushed up.
    fn is_up(&self, state: &State, now: Clock) -> bool {
        let moves = seconds(state.since, now) / self.move_s;
        match (self.jams, state.way) {
            (Some(Jam::Up), _) => true,
            (Some(Jam::Down), _) => false,
            (None, Target::Up) => moves >= 1.0,
            (None, Target::Down) => moves < 1.0 || self.is_against_the_bed(),
            (None, Target::SelfTest) => moves % 2.0 < 1.0,
        }
    }

    /// The sensor line.
    fn output(&self, state: &State, now: Clock) -> bool {
        let pulse = state.touched.is_some_and(|touched| seconds(touched, now) < TOUCH_PULSE_S);
        state.alarm || pulse || state.touch_mode && self.is_up(state, now)
    }

    /// An edge of the control line.
    fn control(&self, on: bool, at: Clock) {
        let mut state = self.at(at);
        if on {
            state.rise = at;
        } else {
            let width_us = seconds(state.rise, at) * 1e6;
            let is_it = |(width, _): &(f64, Command)| (width_us - width).abs() < WIDTH_TOLERANCE_US;
            let place = COMMANDS.iter().position(is_it);
            let again = place == state.command && seconds(state.commanded, at) < TRAIN_S;
            if let (Some(place), false) = (place, again) {
                self.obey(&mut state, COMMANDS[place].1, at);
            }
            state.command = place;
            state.commanded = at;
        }
        self.state.store(state.words());
    }

    fn obey(&self, state: &mut State, command: Command, at: Clock) {
        match command {
            Command::OutputMode => return,
            Command::TouchMode => {
                state.alarm = false;
                state.touch_mode = true;
                return;
            }
            Command::Reset => state.alarm = false,
            _ => {}
        }
        (state.touch_mode, state.falls) = (false, false);
        // The pin does not move during the alarm.
        if state.alarm {
            return;
        }
        let way = match command {
            Command::PinDown => Target::Down,
            Command::SelfTest => Target::SelfTest,
            _ => Target::Up,
        };
        if state.way != way || self.jams.is_some() {
            state.way = way;
            state.since = at;
        }
        // A pin against the bed has no room to go down.
        state.alarm = way == Target::Down && self.is_against_the_bed();
        if state.alarm {
            state.way = Target::Up;
        }
    }
}

impl Sight for Bltouch {
    fn name(&self) -> &str {
        "bltouch"
    }

    fn look(&self, now: Clock) -> Look {
        let state = self.at(now);
        Look::Pin { is_down: !self.is_up(&state, now), alarm: state.alarm }
    }
}

/// The control line, which takes the servo's pulses.
fn control_pin(probe: Arc<Bltouch>) -> impl Wire {
    output("control of bltouch".into(), move |on, at| probe.control(on, at))
}

/// The sensor line, which reports a touch.
fn sensor_pin(probe: Arc<Bltouch>) -> impl Wire {
    input("sensor of bltouch".into(), move |at| {
        let state = probe.at(at);
        probe.state.store(state.words());
        probe.output(&state, at)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::motion::Axis;
    use pinion_firmware::time::CLOCK_FREQ;

    /// The probe over a flat bed, with its nozzle at 12 mm.
    struct Bench {
        z: Arc<Axis>,
        probe: Arc<Bltouch>,
        now: Clock,
    }

    impl Bench {
        fn new(jams: Option<Jam>) -> Bench {
            let printer = DefaultPrinter::read();
            let z = Arc::new(Axis::new(&printer.axes[2]));
            z.set_enabled(true);
            let config = BltouchConfig {
                control_pin: "control".to_owned().try_into().unwrap(),
                sensor_pin: "sensor".to_owned().try_into().unwrap(),
                x_offset_mm: 0.0,
                y_offset_mm: 0.0,
                z_offset_mm: 2.0,
                move_s: 0.3,
                jams,
            };
            let bed = Bed::under(Default::default(), None, None, Some(z.clone()));
            Bench { z, probe: Arc::new(Bltouch::new(&config, bed)), now: Clock::from_ticks(0) }.after(1.0)
        }

        fn wait(&mut self, seconds: f64) {
            self.now = Clock::from_ticks(self.now.ticks() + (seconds * f64::from(CLOCK_FREQ)) as u64);
        }

        fn after(mut self, seconds: f64) -> Bench {
            self.wait(seconds);
            self
        }

        /// Ten pulses of a servo, in one second.
        fn send(&mut self, width_us: f64) {
            let control = control_pin(self.probe.clone());
            for _ in 0..10 {
                control.drive(true, self.now);
                self.wait(width_us * 1e-6);
                control.drive(false, self.now);
                self.wait(0.020 - width_us * 1e-6);
            }
            self.wait(0.8);
        }

        fn sensor(&self) -> bool {
            sensor_pin(self.probe.clone()).sense(false, self.now)
        }

        fn seen(&self) -> String {
            self.probe.look(self.now).to_string()
        }

        fn move_z(&mut self, mm: f64) {
            self.z.set_forward(mm > 0.0);
            for _ in 0..(mm.abs() * 400.0).round() as u32 {
                self.z.edge(true, self.now);
            }
        }
    }

    #[test]
    fn the_pin_goes_down_takes_its_time_and_goes_up_at_a_touch() {
        let mut bench = Bench::new(None);
        assert_eq!((bench.sensor(), bench.seen().as_str()), (false, "pin up"));
        bench.send(650.0);
        assert_eq!((bench.sensor(), bench.seen().as_str()), (false, "pin down"));
        bench.move_z(-9.9975);
        assert!(!bench.sensor());
        bench.move_z(-0.0025);
        assert!(bench.sensor());
        bench.wait(0.009);
        assert!(bench.sensor());
        bench.wait(0.002);
        assert!(!bench.sensor(), "a pulse");
        bench.wait(0.3);
        assert_eq!((bench.sensor(), bench.seen().as_str()), (false, "pin up"));
        // Without the pin there is no touch.
        bench.move_z(-1.0);
        assert!(!bench.sensor());
    }

    /// klippy's `stow_on_each_sample: False`, without touch mode.
    #[test]
    fn a_pin_that_nobody_stows_falls_again_after_a_touch() {
        let mut bench = Bench::new(None);
        bench.send(650.0);
        for _ in 0..3 {
            bench.move_z(-10.0);
            assert!(bench.sensor());
            bench.wait(0.4);
            assert_eq!((bench.sensor(), bench.seen().as_str()), (false, "pin up"));
            bench.move_z(10.0);
            bench.wait(0.4);
            assert_eq!((bench.sensor(), bench.seen().as_str()), (false, "pin down"));
        }
        bench.move_z(-10.0);
        assert!(bench.sensor());
        bench.send(1475.0);
        bench.move_z(10.0);
        assert_eq!(bench.seen(), "pin up", "it is stowed");
    }

    #[test]
    fn commands_are_known_by_their_widths() {
        let mut bench = Bench::new(None);
        for (width_us, seen) in
            [(600.0, "pin up"), (690.0, "pin down"), (1475.0, "pin up"), (610.0, "pin down"), (2190.0, "pin up")]
        {
            bench.send(width_us);
            assert_eq!(bench.seen(), seen, "{width_us}");
        }
        // The modes of the output's voltage move nothing.
        bench.send(650.0);
        for width_us in [1884.0, 1988.0, 2091.0] {
            bench.send(width_us);
            assert_eq!(bench.seen(), "pin down", "{width_us}");
        }
        let at = bench.now;
        bench.send(1475.0);
        bench.now = at;
        bench.wait(0.2);
        assert_eq!(bench.seen(), "pin down", "it takes its time");
    }

    #[test]
    fn in_touch_mode_the_sensor_line_follows_the_pin() {
        let mut bench = Bench::new(None);
        bench.send(1165.0);
        assert!(bench.sensor(), "up");
        bench.send(650.0);
        bench.send(1165.0);
        assert!(!bench.sensor(), "down");
        bench.move_z(-10.0);
        assert!(bench.sensor(), "pushed up");
        bench.wait(1.0);
        assert!(bench.sensor(), "and stays");
        bench.move_z(0.5);
        assert!(!bench.sensor());
        bench.send(1475.0);
        assert!(!bench.sensor(), "no longer in touch mode");
    }

    #[test]
    fn a_pin_without_room_ends_in_the_alarm_until_that_is_released() {
        let mut bench = Bench::new(None);
        bench.move_z(-11.0);
        bench.send(650.0);
        assert_eq!((bench.sensor(), bench.seen().as_str()), (true, "pin up, alarm"));
        bench.move_z(5.0);
        bench.send(650.0);
        assert!(bench.sensor(), "it does not go while in the alarm");
        bench.send(2190.0);
        assert!(!bench.sensor());
        bench.send(650.0);
        assert_eq!((bench.sensor(), bench.seen().as_str()), (false, "pin down"));
    }

    #[test]
    fn a_pin_that_is_stuck_ends_in_the_alarm() {
        let mut bench = Bench::new(Some(Jam::Up));
        assert!(!bench.sensor());
        bench.send(650.0);
        assert_eq!((bench.sensor(), bench.seen().as_str()), (true, "pin up, alarm"));
        bench.send(2190.0);
        assert!(!bench.sensor());

        let mut bench = Bench::new(Some(Jam::Down));
        assert_eq!((bench.sensor(), bench.seen().as_str()), (true, "pin down, alarm"));
        bench.send(1475.0);
        assert!(bench.sensor());
        bench.send(2190.0);
        assert!(bench.sensor(), "the alarm comes back");
    }

    #[test]
    fn the_self_test_moves_the_pin_ten_times() {
        let mut bench = Bench::new(None);
        bench.send(1780.0);
        let (mut was_up, mut went_down) = (true, 0);
        for _ in 0..1000 {
            let is_up = bench.seen() == "pin up";
            went_down += u32::from(was_up && !is_up);
            was_up = is_up;
            bench.wait(0.01);
        }
        // The first time is over when the command ends.
        assert_eq!(went_down, 9);
        assert_eq!((bench.sensor(), was_up), (false, true));
    }

    #[test]
    fn a_state_is_the_same_after_it_was_stored() {
        let bench = Bench::new(None);
        let state = State {
            touched: Some(bench.now),
            command: Some(7),
            way: Target::SelfTest,
            falls: true,
            ..bench.probe.at(bench.now)
        };
        assert_eq!(State::of(state.words()), state);
    }
}
