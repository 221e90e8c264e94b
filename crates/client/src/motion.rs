// SPDX-License-Identifier: GPL-3.0-or-later
//! Moves as step sequences, paced into the MCU's move queue, and homing against an endstop with klippy's commands.

#![forbid(unsafe_code)]

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::time::{Duration, Instant};

use super::config::Config;
use super::{Client, Error};
use pinion_protocol::clock::Clock;

/// How long before its due time a step is sent, in seconds.
const LOOKAHEAD_S: f64 = 1.0;
/// How long after the present a move starts, in seconds. This leaves time to send its first steps.
const LEAD_S: f64 = 0.25;
/// How often position and endstop are queried during a move.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// How many times they are queried after homing, with the axis at rest.
const LOOKS_AT_REST: u32 = 5;
/// Longest wait for a response before the next check for steps to send.
const FEED_EVERY: Duration = Duration::from_millis(5);
/// Highest share by which the interval may shrink within one chord of a ramp. A tenth keeps the chord within half a
/// hundredth of the curve.
const CHORD: f64 = 0.1;
/// The same limit where intervals shrink by fewer than [`ADD_COARSE`] ticks per step. `add` is a whole number of ticks,
/// so its rounding matters there.
const CHORD_FINE: f64 = 0.02;
const ADD_COARSE: i64 = -8;
/// Longest interval between two steps, in ticks. With a much longer interval, the MCU would take the 32-bit clock of
/// the next step for a past one.
const INTERVAL_MAX: f64 = (1u32 << 30) as f64;

/// Number of entries of the move queue that are left for heaters and other outputs.
const RESERVED_MOVES: usize = 16;

/// The MCU ends homing by itself after this many seconds without a message from the host. It is klippy's value for a
/// printer with one MCU.
const TRSYNC_TIMEOUT_S: f64 = 5.0;
/// How long after the end of the move the trsync's report may come.
const NEWS_TIMEOUT: Duration = Duration::from_secs(6);
const ENDSTOP_SAMPLE_S: f64 = 0.000_015;
const ENDSTOP_SAMPLES: u8 = 4;

/// The reason for the end of homing, with klippy's numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HomingEnd {
    /// The endstop closed.
    Endstop,
    /// The host gave up.
    Host,
    /// The move ended.
    PastEnd,
    /// The MCU received no message from the host in time.
    Silence,
    /// A reason that klippy does not define.
    Other(i64),
}

impl HomingEnd {
    fn code(self) -> i64 {
        match self {
            HomingEnd::Endstop => 1,
            HomingEnd::Host => 2,
            HomingEnd::PastEnd => 3,
            HomingEnd::Silence => 4,
            HomingEnd::Other(code) => code,
        }
    }

    fn of(code: i64) -> HomingEnd {
        [HomingEnd::Endstop, HomingEnd::Host, HomingEnd::PastEnd, HomingEnd::Silence]
            .into_iter()
            .find(|reason| reason.code() == code)
            .unwrap_or(HomingEnd::Other(code))
    }
}

/// The content of one `queue_step`: `count` steps. The first is `interval` ticks after the step before. Each later
/// interval is longer by `add`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    /// Ticks to the first step.
    pub interval: u32,
    /// Number of steps, at least one.
    pub count: u16,
    /// Ticks by which each interval is longer than the one before.
    pub add: i16,
}

impl Run {
    /// Ticks from the step before the run to its last step.
    pub fn ticks(&self) -> u64 {
        let count = i64::from(self.count);
        let ramp = i64::from(self.add) * (count * (count - 1) / 2);
        (count * i64::from(self.interval) + ramp).max(0) as u64
    }

    /// The interval before the last step, in ticks.
    fn last_interval(&self) -> u32 {
        let last = i64::from(self.interval) + i64::from(self.add) * (i64::from(self.count) - 1);
        last.max(0) as u32
    }

    fn reversed(&self) -> Run {
        Run { interval: self.last_interval(), count: self.count, add: -self.add }
    }
}

/// A move of one stepper. It accelerates, keeps its speed, and decelerates.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Profile {
    /// The move, in order.
    pub runs: Vec<Run>,
    /// Number of steps of all runs.
    pub steps: u32,
    /// Ticks from the start to the last step.
    pub ticks: u64,
}

impl Profile {
    /// A move of `steps` steps at up to `speed` steps/s with `acceleration` steps/s² (infinity for no limit). The clock
    /// runs at `frequency_hz`. Fails if a number is not positive. Also fails if the speed is below a step in about 20
    /// seconds or above a step per tick.
    pub fn trapezoid(steps: u32, speed: f64, acceleration: f64, frequency_hz: f64) -> Result<Profile, Error> {
        let cruise = (frequency_hz / speed).ceil();
        let positive = speed > 0.0 && acceleration > 0.0 && frequency_hz > 0.0;
        if steps == 0 || !positive || !(1.0..=INTERVAL_MAX).contains(&cruise) {
            return Err(Error::Plan {
                subject: format!("a move of {steps} steps at {speed} steps/s, {acceleration} steps/s²"),
                why: "choose at least one step, and a speed and acceleration that a clock of \
                      this frequency can express"
                    .to_owned(),
            });
        }
        let cruise = cruise as u32;
        // From rest, the ideal time of step i is sqrt(2 i / a).
        let tick_of = |step: u32| frequency_hz * (2.0 * f64::from(step) / acceleration).sqrt();
        let interval = |step: u32| {
            let ideal = (tick_of(step + 1) - tick_of(step)).min(INTERVAL_MAX);
            (ideal.round() as u32).max(cruise)
        };
        let ramp_steps = (speed * speed / (2.0 * acceleration)).min(f64::from(steps / 2)) as u32;
        let ramp = ramp(ramp_steps, interval);
        let peak = ramp.last().map_or(cruise, |run| run.last_interval());
        // A short move does not reach `speed`. Its middle keeps the highest speed that it reaches.
        let even = if ramp_steps < steps / 2 { cruise } else { peak };
        let mut runs = ramp.clone();
        let mut rest = steps - 2 * ramp_steps;
        while rest > 0 {
            let count = rest.min(u32::from(u16::MAX)) as u16;
            runs.push(Run { interval: even, count, add: 0 });
            rest -= u32::from(count);
        }
        runs.extend(ramp.iter().rev().map(Run::reversed));
        let ticks = runs.iter().map(Run::ticks).sum();
        Ok(Profile { runs, steps, ticks })
    }
}

/// Approximates the intervals of the steps `0..steps` by runs with evenly changing intervals (chords of the curve). The
/// intervals shrink ever more slowly. `add` is rounded toward zero, so no run ends with a shorter interval than the
/// next one begins with.
fn ramp(steps: u32, interval: impl Fn(u32) -> u32) -> Vec<Run> {
    let mut runs = Vec::new();
    let mut at = 0;
    while at < steps {
        let first = interval(at);
        // The end of the longest chord with intervals that shrink by at most `part`, found by bisection.
        let chord = |part: f64| {
            let least = f64::from(first) * (1.0 - part);
            let (mut count, mut beyond) = (1, (steps - at).min(u32::from(u16::MAX)) + 1);
            while beyond - count > 1 {
                let middle = count + (beyond - count) / 2;
                if f64::from(interval(at + middle)) >= least {
                    count = middle;
                } else {
                    beyond = middle;
                }
            }
            let fall = i64::from(interval(at + count)) - i64::from(first);
            (count, fall / i64::from(count))
        };
        let (mut count, mut add) = chord(CHORD);
        if add > ADD_COARSE {
            (count, add) = chord(CHORD_FINE);
        }
        let (count, add) = match i16::try_from(add) {
            Ok(add) if count > 1 => (count, add),
            _ => (1, 0),
        };
        runs.push(Run { interval: first, count: count as u16, add });
        at += count;
    }
    runs
}

/// A configured stepper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stepper {
    /// Its oid.
    pub oid: u8,
    /// Whether its direction pin is inverted.
    pub invert_dir: bool,
}

impl Stepper {
    /// Adds a stepper to a configuration: its pins by name, `invert_step` (-1: step on both edges), and the width of a
    /// step pulse in ticks. Fails if there are too many objects.
    pub fn configure(
        config: &mut Config,
        step_pin: &str,
        invert_step: i8,
        dir_pin: &str,
        invert_dir: bool,
        pulse_ticks: u32,
    ) -> Result<Stepper, Error> {
        let oid = config.oid()?;
        config.add(format!(
            "config_stepper oid={oid} step_pin={step_pin} dir_pin={dir_pin} \
             invert_step={invert_step} step_pulse_ticks={pulse_ticks}"
        ));
        Ok(Stepper { oid, invert_dir })
    }

    /// Queries its position, in steps from its position at configuration.
    pub fn position(&self, client: &mut Client) -> Result<i64, Error> {
        let args = [("oid", self.oid.into())];
        let state = client.query("stepper_get_position", &args, "stepper_position", Some(self.oid))?;
        let position = state.int("pos")?;
        Ok(if self.invert_dir { -position } else { position })
    }
}

/// A configured endstop, and the trsync that it triggers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Endstop {
    /// The endstop's oid.
    pub oid: u8,
    /// The trsync's oid.
    pub trsync: u8,
    /// Whether the pin is low when the endstop is triggered.
    pub invert: bool,
}

impl Endstop {
    /// Adds an endstop and its trsync to a configuration. `pull` is 1 for up, -1 for down, 0
    /// for neither. Fails if there are too many objects.
    pub fn configure(config: &mut Config, pin: &str, pull: i8, invert: bool) -> Result<Endstop, Error> {
        let oid = config.oid()?;
        let trsync = config.oid()?;
        config.add(format!("config_endstop oid={oid} pin={pin} pull_up={pull}"));
        config.add(format!("config_trsync oid={trsync}"));
        Ok(Endstop { oid, trsync, invert })
    }

    /// Queries whether it is triggered.
    pub fn triggered(&self, client: &mut Client) -> Result<bool, Error> {
        Ok(self.state(client)?.0)
    }

    /// Makes the MCU sample the pin from `start` on, every `rest_ticks`. The endstop triggers after several triggered
    /// samples in a row, `sample_ticks` apart.
    fn search(&self, client: &mut Client, start: Clock, sample_ticks: u32, rest_ticks: u32) -> Result<(), Error> {
        client.send(
            "endstop_home",
            &[
                ("oid", self.oid.into()),
                ("clock", start.into()),
                ("sample_ticks", sample_ticks.into()),
                ("sample_count", ENDSTOP_SAMPLES.into()),
                ("rest_ticks", rest_ticks.into()),
                ("pin_value", (!self.invert).into()),
                ("trsync_oid", self.trsync.into()),
                ("trigger_reason", HomingEnd::Endstop.code().into()),
            ],
        )
    }

    /// Whether it is triggered, and the clock of the sample after the last sample of homing.
    fn state(&self, client: &mut Client) -> Result<(bool, Clock), Error> {
        let args = [("oid", self.oid.into())];
        let state = client.query("endstop_query_state", &args, "endstop_state", Some(self.oid))?;
        let next = client.widen(state.u32("next_clock")?);
        Ok((state.flag("pin_value")? != self.invert, next))
    }
}

/// The state at an instant of a move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sight {
    /// The instant.
    pub clock: Clock,
    /// The stepper's position in steps.
    pub position: i64,
    /// Whether the endstop was triggered.
    pub triggered: bool,
}

/// The watcher of a move.
pub struct Watch<'a> {
    /// The endstop to query.
    pub endstop: Endstop,
    /// Receives the state about fifty times a second.
    pub seen: &'a mut dyn FnMut(Sight),
}

/// The result of homing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Homed {
    /// Why it ended.
    pub reason: HomingEnd,
    /// When the move began.
    pub start: Clock,
    /// When the endstop was first seen triggered; `None` if it was not.
    pub trigger: Option<Clock>,
    /// The position where the stepper stopped, in steps.
    pub position: i64,
    /// Highest number of steps after the endstop closed, before its samples showed the trigger.
    pub slack_steps: u32,
}

/// Paces moves into the MCU's move queue, and counts its used entries.
#[derive(Debug)]
pub struct MoveQueue {
    room: usize,
    /// When each used entry becomes free again.
    releases: BinaryHeap<Reverse<Clock>>,
}

/// A move that is being sent to the queue.
#[derive(Debug)]
struct Moving {
    oid: u8,
    start: Clock,
    end: Clock,
    /// The due time of the step before the next run.
    next: Clock,
    runs: VecDeque<Run>,
}

impl MoveQueue {
    /// A queue with the number of entries from `get_config`. A few entries are left for other outputs.
    pub fn new(move_count: u16) -> MoveQueue {
        MoveQueue { room: usize::from(move_count).saturating_sub(RESERVED_MOVES).max(1), releases: BinaryHeap::new() }
    }

    /// Moves a stepper, and returns when it has arrived. Fails if the stepper does not arrive.
    pub fn run(
        &mut self,
        client: &mut Client,
        stepper: Stepper,
        positive: bool,
        profile: &Profile,
        mut watch: Option<Watch<'_>>,
    ) -> Result<(), Error> {
        let from = stepper.position(client)?;
        let start = client.clock_in(LEAD_S)?;
        let mut moving = self.begin(client, stepper, positive, profile, start)?;
        let mut look_at = Instant::now();
        // Wait 10 ms longer, because the last step may be a little late.
        let arrived = moving.end.displaced(client.ticks(0.01));
        while client.clock_in(0.0)? <= arrived {
            self.feed(client, &mut moving)?;
            look(client, stepper, &mut watch, &mut look_at)?;
            client.listen(Instant::now() + FEED_EVERY)?;
        }
        let went = (stepper.position(client)? - from).unsigned_abs();
        if went != u64::from(profile.steps) {
            return Err(Error::Plan {
                subject: format!("stepper oid {}", stepper.oid),
                why: format!("it went {went} steps instead of {}: look at the MCU's log", profile.steps),
            });
        }
        Ok(())
    }

    /// Moves a stepper toward an endstop. Returns when the stepper was stopped or the move is over.
    pub fn home(
        &mut self,
        client: &mut Client,
        stepper: Stepper,
        endstop: Endstop,
        positive: bool,
        profile: &Profile,
        seen: &mut dyn FnMut(Sight),
    ) -> Result<Homed, Error> {
        let fastest = profile.runs.iter().map(Run::last_interval).min();
        let rest_ticks = fastest.unwrap_or(1);
        let sample_ticks = client.ticks(ENDSTOP_SAMPLE_S);
        let sampling = rest_ticks + sample_ticks * u32::from(ENDSTOP_SAMPLES - 1);
        let trsync = endstop.trsync;
        let expire_ticks = client.ticks(TRSYNC_TIMEOUT_S);
        let report_ticks = expire_ticks * 3 / 10;
        let start = client.clock_in(LEAD_S)?;
        client.drain();
        let mut expire = start.displaced(expire_ticks);
        arm(client, stepper, trsync, start, report_ticks, expire)?;
        endstop.search(client, start, sample_ticks, rest_ticks)?;
        let mut moving = self.begin(client, stepper, positive, profile, start)?;
        let mut look_at = Instant::now();
        let mut watch = Some(Watch { endstop, seen });
        let over = client.instant_of(moving.end) + NEWS_TIMEOUT;
        loop {
            self.feed(client, &mut moving)?;
            look(client, stepper, &mut watch, &mut look_at)?;
            let until = Instant::now() + FEED_EVERY;
            let Some(state) = client.wait("trsync_state", Some(trsync), until)? else {
                if Instant::now() > over {
                    return Err(no_news());
                }
                continue;
            };
            if !state.flag("can_trigger")? {
                break;
            }
            let clock = client.widen(state.u32("clock")?);
            if clock >= moving.end {
                client
                    .send("trsync_trigger", &[("oid", trsync.into()), ("reason", HomingEnd::PastEnd.code().into())])?;
                break;
            }
            let later = clock.displaced(expire_ticks);
            if later.since(expire) >= i64::from(report_ticks) * 8 / 10 {
                expire = later;
                set_timeout(client, trsync, expire)?;
            }
        }
        let (reason, trigger, position) = self.end_homing(client, stepper, endstop, rest_ticks)?;
        for _ in 0..LOOKS_AT_REST {
            look_at = look_at.max(Instant::now());
            client.listen(look_at)?;
            look(client, stepper, &mut watch, &mut look_at)?;
        }
        Ok(Homed { reason, start, trigger, position, slack_steps: sampling.div_ceil(rest_ticks.max(1)) + 1 })
    }

    fn end_homing(
        &mut self,
        client: &mut Client,
        stepper: Stepper,
        endstop: Endstop,
        rest_ticks: u32,
    ) -> Result<(HomingEnd, Option<Clock>, i64), Error> {
        let nothing =
            ["clock", "sample_ticks", "sample_count", "rest_ticks", "pin_value", "trsync_oid", "trigger_reason"];
        let mut args = vec![("oid", endstop.oid.into())];
        args.extend(nothing.map(|name| (name, 0u8.into())));
        client.send("endstop_home", &args)?;
        // The last report may still be on its way. It has arrived when everything sent is acknowledged.
        client.link().settle()?;
        let mut state = client.query(
            "trsync_trigger",
            &[("oid", endstop.trsync.into()), ("reason", HomingEnd::Host.code().into())],
            "trsync_state",
            Some(endstop.trsync),
        )?;
        while state.flag("can_trigger")? {
            let until = Instant::now() + NEWS_TIMEOUT;
            let next = client.wait("trsync_state", Some(endstop.trsync), until)?;
            state = next.ok_or_else(no_news)?;
        }
        let reason = HomingEnd::of(state.int("trigger_reason")?);
        self.releases.clear();
        let trigger = if reason == HomingEnd::Endstop {
            let (_, next) = endstop.state(client)?;
            Some(next.displaced(rest_ticks.wrapping_neg()))
        } else {
            None
        };
        client.send("reset_step_clock", &[("oid", stepper.oid.into()), ("clock", 0u8.into())])?;
        Ok((reason, trigger, stepper.position(client)?))
    }

    fn begin(
        &mut self,
        client: &mut Client,
        stepper: Stepper,
        positive: bool,
        profile: &Profile,
        start: Clock,
    ) -> Result<Moving, Error> {
        let oid = stepper.oid;
        client.send("reset_step_clock", &[("oid", oid.into()), ("clock", start.into())])?;
        client.send("set_next_step_dir", &[("oid", oid.into()), ("dir", (positive != stepper.invert_dir).into())])?;
        let mut moving = Moving {
            oid,
            start,
            end: Clock::from_ticks(start.ticks() + profile.ticks),
            next: start,
            runs: profile.runs.iter().copied().collect(),
        };
        self.feed(client, &mut moving)?;
        Ok(moving)
    }

    /// Sends the runs that are due soon, as far as the queue has room.
    fn feed(&mut self, client: &mut Client, moving: &mut Moving) -> Result<(), Error> {
        let now = client.clock_in(0.0)?;
        let horizon = client.clock_in(LOOKAHEAD_S)?.max(moving.start);
        while self.releases.peek().is_some_and(|first| first.0 < now) {
            self.releases.pop();
        }
        let mut commands = Vec::new();
        while moving.next <= horizon && self.releases.len() < self.room {
            let Some(run) = moving.runs.pop_front() else {
                break;
            };
            commands.push(client.messages().encode(
                "queue_step",
                &[
                    ("oid", moving.oid.into()),
                    ("interval", run.interval.into()),
                    ("count", run.count.into()),
                    ("add", run.add.into()),
                ],
            )?);
            // The MCU removes a run from its queue when the run before it is over.
            self.releases.push(Reverse(moving.next));
            moving.next = Clock::from_ticks(moving.next.ticks() + run.ticks());
        }
        client.send_encoded(&commands)
    }
}

fn no_news() -> Error {
    Error::Timeout { waiting_for: "report `trsync_state` on homing".to_owned(), after: NEWS_TIMEOUT }
}

/// Starts a trsync that stops a stepper when it is triggered. It reports every `report_ticks` from `start` on. It
/// triggers by itself at `expire`, unless the host sets `expire` again.
fn arm(
    client: &mut Client,
    stepper: Stepper,
    trsync: u8,
    start: Clock,
    report_ticks: u32,
    expire: Clock,
) -> Result<(), Error> {
    client.send(
        "trsync_start",
        &[
            ("oid", trsync.into()),
            ("report_clock", start.into()),
            ("report_ticks", report_ticks.into()),
            ("expire_reason", HomingEnd::Silence.code().into()),
        ],
    )?;
    client.send("stepper_stop_on_trigger", &[("oid", stepper.oid.into()), ("trsync_oid", trsync.into())])?;
    set_timeout(client, trsync, expire)
}

fn set_timeout(client: &mut Client, trsync: u8, clock: Clock) -> Result<(), Error> {
    client.send("trsync_set_timeout", &[("oid", trsync.into()), ("clock", clock.into())])
}

fn look(
    client: &mut Client,
    stepper: Stepper,
    watch: &mut Option<Watch<'_>>,
    look_at: &mut Instant,
) -> Result<(), Error> {
    let Some(watch) = watch else { return Ok(()) };
    let before = Instant::now();
    if before < *look_at {
        return Ok(());
    }
    *look_at = before + LOOK_EVERY;
    let position = stepper.position(client)?;
    let clock = client.clock_at_instant(before + before.elapsed() / 2);
    let triggered = watch.endstop.triggered(client)?;
    (watch.seen)(Sight { clock, position, triggered });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const FREQUENCY_HZ: f64 = 50e6;

    /// The clocks of all steps, calculated with integers only, as in the firmware.
    fn step_clocks(profile: &Profile) -> Vec<u64> {
        let (mut clock, mut clocks) = (0u64, Vec::new());
        for run in &profile.runs {
            let mut interval = i64::from(run.interval);
            for _ in 0..run.count {
                assert!(interval > 0, "{run:?}");
                clock += interval as u64;
                clocks.push(clock);
                interval += i64::from(run.add);
            }
        }
        clocks
    }

    fn intervals(profile: &Profile) -> Vec<u64> {
        let clocks = step_clocks(profile);
        let before = std::iter::once(&0).chain(&clocks);
        clocks.iter().zip(before).map(|(clock, before)| clock - before).collect()
    }

    proptest! {
        #[test]
        fn a_profile_is_exact_and_never_too_fast(
            steps in 1u32..200_000,
            speed in 1.0f64..200_000.0,
            acceleration in 10.0f64..5e6,
        ) {
            let profile = Profile::trapezoid(steps, speed, acceleration, FREQUENCY_HZ).unwrap();
            let intervals = intervals(&profile);
            prop_assert_eq!(intervals.len() as u32, steps);
            prop_assert_eq!(profile.steps, steps);
            prop_assert_eq!(intervals.iter().sum::<u64>(), profile.ticks);
            let fastest = (FREQUENCY_HZ / speed) as u64;
            prop_assert!(intervals.iter().all(|interval| *interval >= fastest));
            // The intervals shrink, then grow, and are symmetric.
            let lowest = intervals.iter().min().unwrap();
            let bottom = intervals.iter().position(|i| i == lowest).unwrap();
            prop_assert!(intervals[..=bottom].is_sorted_by(|a, b| a >= b));
            prop_assert!(intervals[bottom..].is_sorted());
            prop_assert!(intervals.iter().eq(intervals.iter().rev()));
        }

        #[test]
        fn a_long_move_lasts_as_long_as_the_formula_says(
            speed in 500.0f64..50_000.0,
            acceleration in 5_000.0f64..1e6,
        ) {
            let ramp = speed * speed / (2.0 * acceleration);
            prop_assume!((50.0..40_000.0).contains(&ramp));
            let steps = (4.0 * ramp) as u32;
            let profile = Profile::trapezoid(steps, speed, acceleration, FREQUENCY_HZ).unwrap();
            let expected = 2.0 * speed / acceleration + 2.0 * ramp / speed;
            let seconds = profile.ticks as f64 / FREQUENCY_HZ;
            prop_assert!((seconds / expected - 1.0).abs() < 0.02, "{seconds} not {expected}");
            prop_assert!(profile.runs.len() < 400, "{} runs", profile.runs.len());
        }
    }

    #[test]
    fn a_run_counts_as_the_firmware_does() {
        let run = Run { interval: 1000, count: 4, add: -10 };
        assert_eq!(run.ticks(), 1000 + 990 + 980 + 970);
        assert_eq!(run.last_interval(), 970);
        assert_eq!(run.reversed(), Run { interval: 970, count: 4, add: 10 });
        assert_eq!(run.reversed().ticks(), run.ticks());
    }

    #[test]
    fn a_move_that_cannot_be_is_refused() {
        for (steps, speed, acceleration) in [
            (0, 100.0, 100.0),
            (1, 0.0, 100.0),
            (1, f64::NAN, 100.0),
            (1, 100.0, f64::NAN),
            (1, 100.0, -1.0),
            (1, 0.01, 100.0),
            (1, f64::INFINITY, 100.0),
        ] {
            assert!(Profile::trapezoid(steps, speed, acceleration, FREQUENCY_HZ).is_err());
        }
        let even = Profile::trapezoid(70_000, 1000.0, f64::INFINITY, FREQUENCY_HZ).unwrap();
        assert_eq!(even.runs.len(), 2);
    }
}
