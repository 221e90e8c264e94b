// SPDX-License-Identifier: GPL-3.0-or-later
//! Steppers: queued moves, step pulses or both-edge steps, direction changes with their setup time, and a stop by a
//! trsync.

use std::ops::Range;

use crate::board::Pin;
use crate::mcu::DialectName::{Kalico, Master, V0_13};
use crate::mcu::{
    Batch, Command, Constant, Context, Feature, MoveQueue, Next, Object, Oid, Present, PromptLine, Report, Response,
    SPIN_MAX, Timer, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::trsync::Trsync;

pub(super) const FEATURE: Feature = Feature {
    serves: "steppers",

    commands: &[
        CONFIG_STEPPER_OF_V0_10,
        CONFIG_STEPPER,
        QUEUE_STEP,
        QUEUE_STEP_HP,
        SET_NEXT_STEP_DIR,
        RESET_STEP_CLOCK,
        STEPPER_GET_POSITION,
        STEPPER_STOP_ON_TRIGGER,
    ],
    responses: &[Position::FORM],
    constants: &[Constant::number("STEPPER_STEP_BOTH_EDGE", 1).of(&[V0_13, Master, Kalico])],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `reset_step_clock` while steps are queued.
    RESET_WHILE_STEPPING = "Can't reset time when stepper active";
    /// `queue_step` or `queue_step_hp` with a count of zero, or `queue_step_hp` with a number that is out of range.
    INVALID_COUNT = "Invalid count parameter";
    /// A step is over a millisecond late.
    STEPPER_PAST = "Stepper too far in past";
}

response! {
    /// Steps since the configuration: forward steps minus backward steps.
    "stepper_position oid=%c pos=%i"
    pub(super) struct Position { oid: Oid, pos: i32 }
}

const TIMER: Timer = Timer::exact(0);

/// `count` steps. The first one comes `interval` after the step before. Each interval is longer by `add` than the one
/// before, and `add` grows by `add2` with each. All three are in units of 2 to the power of `-shift` ticks.
struct Move {
    interval: u32,
    count: u16,
    add: i16,
    add2: i16,
    shift: i8,
    reverses: bool,
}

/// The intervals of a move, in 32 bits as in Klipper's C. A part of a tick that an interval has left over goes into the
/// next one.
#[derive(Default)]
struct Intervals {
    /// The next interval.
    interval: u32,
    add: i32,
    add2: i32,
    /// An interval has 2 to the power of `shift` units to a tick.
    shift: u8,
    /// The units that are left over. Klipper's C has 16 bits for them.
    left: u16,
}

impl Intervals {
    /// Highest number of bits to shift a 32-bit number by.
    const SHIFT_MAX: i8 = 31;

    fn of(&Move { interval, add, add2, shift, .. }: &Move) -> Intervals {
        let (add, add2) = (i32::from(add), i32::from(add2));
        match u8::try_from(shift) {
            // The times are rounded to the nearest tick.
            Ok(shift) => {
                let half = (1u32 << shift >> 1) as u16;
                Intervals { interval, add, add2, shift, left: half }
            }
            Err(_) => {
                let coarse = u32::from(shift.unsigned_abs());
                Intervals { interval: interval << coarse, add: add << coarse, add2: add2 << coarse, shift: 0, left: 0 }
            }
        }
    }

    /// Takes the next interval, in ticks.
    #[inline]
    fn next(&mut self) -> u32 {
        let ticks = if self.shift == 0 { self.interval } else { self.whole_ticks() };
        self.interval = self.interval.wrapping_add_signed(self.add);
        self.add = self.add.wrapping_add(self.add2);
        ticks
    }

    /// The whole ticks of the next interval. Keeps the rest.
    fn whole_ticks(&mut self) -> u32 {
        let units = self.interval.wrapping_add(u32::from(self.left));
        let ticks = units >> self.shift;
        self.left = (units - (ticks << self.shift)) as u16;
        ticks
    }
}

struct Stepper {
    step: PromptLine,
    dir: PromptLine,
    /// The step pin's idle level.
    idle_step: bool,
    /// How many edges back follow a step: one, or none if each edge is a step.
    edges_back: u32,
    /// The shortest time between two edges. Zero if it is shorter than a [`CALL`] that makes an edge.
    pulse_ticks: Ticks,
    late_limit: Ticks,
    queue: MoveQueue<Move>,
    /// Edges of the current move that are still to come. Zero while idle.
    edges: u32,
    intervals: Intervals,
    /// When the current or last step is due.
    next_step: Clock,
    /// Earliest time of the next edge. The pulse before it ends then, or the direction has had its setup time.
    earliest: Clock,
    /// A reversal waits for the next event, the end of the last step's pulse.
    reverse_pending: bool,
    /// The stepper's position after the current move. While the direction is reversed it counts down from zero, so that
    /// a step always adds one.
    position: u32,
    last_dir: bool,
    next_dir: bool,
    /// After a stop, steps are dropped until the host sets a new clock.
    need_reset: bool,
    /// The last trsync that was set to stop this stepper.
    stopper: Option<Oid>,
}

/// A homing stepper makes its steps in order if they are this many ticks late. An MCU that runs is not 50 us late. An
/// MCU that is 50 ms late has more steps to make than it can. Other timers must not wait for these.
const IN_ORDER: Range<i64> = Ticks::from_us(50).0 as i64..Ticks::from_us(50_000).0 as i64;

/// A call of the kernel takes longer than this, 100 ns. So a line that is not fast holds a pulse of 100 ns, and
/// the clock need not be read.
const CALL: Ticks = Ticks(5);

/// Keeps the position's top bit free for the direction.
const POSITION_BIAS: u32 = 0x4000_0000;

impl Stepper {
    /// Takes the next move. `earliest` is the earliest time of its first edge. `None`: the stepper is idle.
    ///
    /// It is not inlined, so that the edges before the last one of a move need not save registers for it.
    #[inline(never)]
    fn load(&mut self, context: &mut Context, earliest: Option<Clock>) -> Result<Next, Shutdown> {
        let Some(item) = self.queue.pop(context.moves()) else {
            self.edges = 0;
            return Ok(Next::Done);
        };
        let Move { count, reverses, .. } = item;
        self.intervals = Intervals::of(&item);
        let interval = self.intervals.next();
        self.position = if reverses { self.position.wrapping_neg() } else { self.position };
        self.position = self.position.wrapping_add(u32::from(count));
        self.edges = u32::from(count) << self.edges_back;
        let Some(earliest) = earliest else {
            // After a long pause the interval has wrapped, but the step's 32-bit clock is right.
            let clock = self.next_step.wire().wrapping_add(interval);
            self.next_step = context.instant(WireClock(clock));
            // Any earlier pulse is over, as for Klipper's C.
            self.earliest = self.next_step;
            if reverses {
                self.dir.toggle()?;
            }
            return Ok(Next::At(self.next_step));
        };
        self.advance(interval, earliest);
        let early = earliest.since(self.next_step);
        if early > i64::from(self.late_limit.0) {
            let cause = format!(
                "a step is {} us late: the host asks for more steps per second than the step pulse and this computer allow",
                early / i64::from(Ticks::from_us(1).0)
            );
            return Err(Shutdown::because(STEPPER_PAST, cause)
                .remedy("lower the speed, the microsteps or step_pulse_duration")
                .late_for(self.next_step));
        }
        if reverses {
            if self.edges_back == 0 {
                // The last step's pulse must end before the direction changes.
                self.reverse_pending = true;
                return Ok(self.edge_at(context, self.next_step.min(earliest), earliest));
            }
            return self.reverse(context);
        }
        Ok(self.edge_at(context, self.next_step, earliest))
    }

    /// Sets the time of the next edge: its due time, or `earliest` if that is later. `earliest` is the end of a pulse
    /// that begins now. An edge without a time of its own has the due time of its step: the end of a pulse, or a
    /// reversal.
    ///
    /// While a trsync may stop the stepper, late edges keep their place among the other timers. They stay in the order
    /// of their due times, and wait for `earliest` when it is their turn. Otherwise a paused MCU would take every
    /// sample of an endstop before the first of the steps between them. It would home at a wrong place. A stepper that
    /// nothing stops does not wait: the pulses of several steppers would add up, and none would catch up.
    #[inline]
    fn edge_at(&mut self, context: &mut Context, due: Clock, earliest: Clock) -> Next {
        self.earliest = earliest;
        let in_order = self.stopper.is_some_and(|trsync| {
            let behind = earliest.since(due) - i64::from(self.pulse_ticks.0);
            IN_ORDER.contains(&behind) && self.pulse_ticks <= SPIN_MAX && Trsync::may_stop(context, trsync)
        });
        Next::At(if in_order { due } else { due.max(earliest) })
    }

    /// Moves on to the next step, `interval` later on a 32-bit clock. A time that is 2^31 ticks or more after
    /// `earliest` counts as past, as in Klipper's comparisons.
    #[inline]
    fn advance(&mut self, interval: u32, earliest: Clock) {
        self.next_step = Clock::widen(self.next_step.wire().wrapping_add(interval), earliest);
    }

    /// Changes the direction. The next step waits for the setup time.
    #[inline(never)]
    fn reverse(&mut self, context: &mut Context) -> Result<Next, Shutdown> {
        self.dir.toggle()?;
        self.dir.flush();
        let earliest = context.now() + self.pulse_ticks;
        Ok(self.edge_at(context, self.next_step, earliest))
    }

    /// The position that the host knows: after the steps made so far.
    fn position(&self) -> u32 {
        let to_come = self.edges >> self.edges_back;
        let position = self.position.wrapping_sub(to_come);
        if position & 0x8000_0000 != 0 { position.wrapping_neg() } else { position }
    }

    fn stop(&mut self, context: &mut Context) {
        // Another stepper of the batch has stopped the MCU.
        self.edges = self.edges.saturating_sub(u32::from(self.step.was_batched()));
        self.position = self.position().wrapping_neg();
        self.edges = 0;
        self.reverse_pending = false;
        self.last_dir = false;
        self.next_dir = false;
        self.need_reset = true;
        self.stopper = None;
        self.queue.clear(context.moves());
    }

    /// Sets the lines to the levels of an idle motor.
    fn idle(&mut self) -> Result<(), Shutdown> {
        let dir = self.dir.write(false);
        if self.edges_back > 0 {
            self.step.write(self.idle_step)?;
        }
        dir
    }

    fn queue(&mut self, context: &mut Context, mut item: Move) -> Result<(), Shutdown> {
        if item.count == 0 {
            return Err(Shutdown::by_host(INVALID_COUNT, "a move has no steps"));
        }
        if self.edges == 0 && self.need_reset {
            return Ok(());
        }
        item.reverses = self.last_dir != self.next_dir;
        self.last_dir = self.next_dir;
        self.queue.push(context.moves(), item)?;
        if self.edges > 0 {
            return Ok(());
        }
        match self.load(context, None)? {
            Next::At(at) => context.schedule(TIMER, at),
            Next::Done => Ok(()),
        }
    }
}

impl Object for Stepper {
    fn kind(&self) -> &'static str {
        "stepper"
    }

    #[inline]
    fn event(&mut self, context: &mut Context, _timer: Timer, _at: Clock) -> Result<Next, Shutdown> {
        context.spin_until(self.earliest);
        if self.reverse_pending {
            self.reverse_pending = false;
            return self.reverse(context);
        }
        if !self.step.was_batched() {
            self.step.toggle()?;
            // A pulse begins when its edge has reached the line: a write may be slow, and a bus may hold it back.
            if self.pulse_ticks > Ticks(0) {
                self.step.flush();
                context.now();
            } else {
                context.made_edge();
            }
        }
        if self.edges <= 1 {
            // How late the next step is must be known well.
            let earliest = context.now() + self.pulse_ticks;
            return self.load(context, Some(earliest));
        }
        self.edges -= 1;
        let earliest = context.last_read() + self.pulse_ticks;
        if self.edges & self.edges_back != 0 {
            return Ok(self.edge_at(context, (self.next_step + self.pulse_ticks).min(earliest), earliest));
        }
        let interval = self.intervals.next();
        self.advance(interval, earliest);
        Ok(self.edge_at(context, self.next_step, earliest))
    }

    fn join(&mut self, batch: &mut Batch) -> bool {
        // Otherwise the event begins with a wait or a reversal.
        !self.reverse_pending && self.earliest <= batch.now() && self.step.join(batch)
    }

    fn triggered(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        context.cancel(TIMER);
        self.stop(context);
        self.idle()
    }

    fn shutdown(&mut self, context: &mut Context) {
        self.stop(context);
    }

    fn report(&self) -> Report {
        let position = self.position().wrapping_sub(POSITION_BIAS) as i32;
        Report { queued: self.queue.len(), value: Some(Present::Steps(position)), ..Report::default() }
    }
}

fn configure(
    context: &mut Context,
    oid: Oid,
    [step_pin, dir_pin]: [Pin; 2],
    invert_step: i8,
    step_pulse_ticks: Ticks,
) -> Result<(), Shutdown> {
    context.vacant(oid)?;
    let (idle_step, both_edges) = (invert_step > 0, invert_step < 0);
    // After a step on either edge, a stop leaves the level: another edge would be another step.
    let step = context.prompt_output(step_pin, "step", idle_step, both_edges)?;
    let dir = context.prompt_output(dir_pin, "dir", false, false)?;
    let pulse_ticks = if step_pulse_ticks <= CALL && !step.is_fast() { Ticks(0) } else { step_pulse_ticks };
    let stepper = Stepper {
        step,
        dir,
        idle_step,
        edges_back: u32::from(!both_edges),
        pulse_ticks,
        late_limit: context.step_late_limit(),
        queue: MoveQueue::default(),
        edges: 0,
        intervals: Intervals::default(),
        next_step: Clock::EPOCH,
        earliest: Clock::EPOCH,
        reverse_pending: false,
        position: POSITION_BIAS.wrapping_neg(),
        last_dir: false,
        next_dir: false,
        need_reset: false,
        stopper: None,
    };
    context.assign_on(step_pin, oid, stepper)
}

/// How long a step pulse is at least with hosts that do not say it (`STEP_DELAY`).
const STEP_PULSE: Ticks = Ticks::from_us(2);

const CONFIG_STEPPER_OF_V0_10: Command = command!(
    "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c",
    |context, oid: Oid, step_pin: Pin, dir_pin: Pin, invert_step: bool| {
        configure(context, oid, [step_pin, dir_pin], invert_step.into(), STEP_PULSE)
    }
)
.of(&[]);

const CONFIG_STEPPER: Command = command!(
    "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u",
    |context, oid: Oid, step_pin: Pin, dir_pin: Pin, invert_step: i8, step_pulse_ticks: Ticks| {
        configure(context, oid, [step_pin, dir_pin], invert_step, step_pulse_ticks)
    }
);

const QUEUE_STEP: Command = command!(
    "queue_step oid=%c interval=%u count=%hu add=%hi",
    Stepper,
    |stepper, context, interval: u32, count: u16, add: i16| {
        let item = Move { interval, count, add, add2: 0, shift: 0, reverses: false };
        stepper.queue(context, item)
    }
);

/// `high_precision_step_compress` of Kalico's branch bleeding-edge-v2. Its firmware has this only if it was built with
/// CONFIG_HIGH_PREC_STEP. A host that does not use it ignores it.
const QUEUE_STEP_HP: Command = command!(
    "queue_step_hp oid=%c interval=%u count=%hu add=%hi add2=%hi shift=%hi",
    Stepper,
    |stepper, context, interval: u32, count: u16, add: i16, add2: i16, shift: i16| {
        let limits = -i16::from(Intervals::SHIFT_MAX)..=i16::from(Intervals::SHIFT_MAX);
        if i16::try_from(count).is_err() || !limits.contains(&shift) {
            let what = format_args!("queue_step_hp has a count of {count} and a shift of {shift}");
            return Err(Shutdown::by_host(INVALID_COUNT, what));
        }
        stepper.queue(context, Move { interval, count, add, add2, shift: shift as i8, reverses: false })
    }
)
.of(&[Kalico]);

const SET_NEXT_STEP_DIR: Command = command!("set_next_step_dir oid=%c dir=%c", Stepper, |stepper, _, dir: bool| {
    stepper.next_dir = dir;
    Ok(())
});

const RESET_STEP_CLOCK: Command =
    command!("reset_step_clock oid=%c clock=%u", Stepper, |stepper, context, clock: WireClock| {
        let clock = context.instant(clock);
        if stepper.edges > 0 {
            return Err(Shutdown::by_host(RESET_WHILE_STEPPING, "reset_step_clock came while steps are queued"));
        }
        stepper.next_step = clock;
        stepper.need_reset = false;
        Ok(())
    });

const STEPPER_GET_POSITION: Command = command!("stepper_get_position oid=%c", Stepper, |stepper, context| {
    context.send(Position { oid: context.oid(), pos: stepper.position().wrapping_sub(POSITION_BIAS) as i32 });
    Ok(())
});

const STEPPER_STOP_ON_TRIGGER: Command =
    command!("stepper_stop_on_trigger oid=%c trsync_oid=%c", Stepper, |stepper, context, trsync_oid: Oid| {
        Trsync::add_signal(context, trsync_oid)?;
        stepper.stopper = Some(trsync_oid);
        Ok(())
    });
