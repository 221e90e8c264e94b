// SPDX-License-Identifier: GPL-3.0-or-later
//! Moves, paced into the MCU's move queue.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::time::{Duration, Instant};

use pinion_protocol::clock::Clock;

use super::endstop::Endstop;
use super::profile::{Profile, Run};
use crate::config::Config;
use crate::{Client, Error};

/// How long before its due time a step is sent, in seconds.
const LOOKAHEAD_S: f64 = 1.0;
/// How long after the present a move starts, in seconds. This leaves time to send its first steps.
pub(super) const LEAD_S: f64 = 0.25;
/// How often position and endstop are queried during a move.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Longest wait for a response before the next check for steps to send.
pub(super) const FEED_EVERY: Duration = Duration::from_millis(5);
/// Number of entries of the move queue that are left for heaters and other outputs.
const RESERVED_MOVES: usize = 16;

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

/// Paces moves into the MCU's move queue, and counts its used entries.
#[derive(Debug)]
pub struct MoveQueue {
    room: usize,
    /// When each used entry becomes free again.
    pub(super) releases: BinaryHeap<Reverse<Clock>>,
}

/// A move that is being sent to the queue.
#[derive(Debug)]
pub(super) struct Moving {
    oid: u8,
    start: Clock,
    pub(super) end: Clock,
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

    pub(super) fn begin(
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
    pub(super) fn feed(&mut self, client: &mut Client, moving: &mut Moving) -> Result<(), Error> {
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

pub(super) fn look(
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
