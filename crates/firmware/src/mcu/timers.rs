// SPDX-License-Identifier: GPL-3.0-or-later
//! The waiting timers: a queue ordered by due time, then by insertion order.

use std::{iter, mem};

use crate::time::Clock;

use super::Oid;

/// A timer of an object. The timers of an object have different numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timer(u8);

impl Timer {
    /// Set in an exact timer, next to the number.
    const EXACT: u8 = 1 << 7;

    /// A timer that finds the core awake when it is due. Numbers are below 128.
    pub const fn exact(number: u8) -> Timer {
        debug_assert!(number < Timer::EXACT);
        Timer(number | Timer::EXACT)
    }

    /// A timer that may be late by the time of a wake-up, because it takes samples at a steady pace. The core sleeps
    /// until it is due. Before an exact timer the core wakes earlier and spins.
    pub const fn sampling(number: u8) -> Timer {
        debug_assert!(number < Timer::EXACT);
        Timer(number)
    }
}

/// Identifies a timer of an object, or the MCU's own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct TimerId {
    /// The object; [`Oid::NONE`] for the MCU's own timers.
    oid: Oid,
    timer: Timer,
}

impl TimerId {
    /// The MCU's own timer that sends `stats`.
    pub(super) const STATS: TimerId = TimerId::own(0);

    /// The MCU's own timer that retries failed shutdown values.
    pub(super) const RETRY: TimerId = TimerId::own(1);
    /// The MCU's own timer that ends the wait for a bus that hangs.
    pub(super) const HOLD: TimerId = TimerId::own(2);

    const fn own(number: u8) -> TimerId {
        TimerId { oid: Oid::NONE, timer: Timer::sampling(number) }
    }

    /// A timer of an object.
    pub(super) const fn of(oid: Oid, timer: Timer) -> TimerId {
        TimerId { oid, timer }
    }

    /// Whether the core must be awake when it is due.
    pub(super) const fn is_exact(self) -> bool {
        self.timer.0 & Timer::EXACT != 0
    }

    /// The object that has the timer; [`Oid::NONE`] for the MCU's own timers.
    pub(super) const fn oid(self) -> Oid {
        self.oid
    }

    /// Which of the object's timers it is.
    pub(super) const fn timer(self) -> Timer {
        self.timer
    }
}

/// Only a few dozen timers run at once, so a sorted array is faster than a more complex queue.
#[derive(Debug)]
pub(super) struct Timers {
    /// The next timer; [`NONE`] without one. A timer that runs alone mostly becomes the next one again.
    next: Waiting,
    /// The others. The first of them is at the end, so taking it moves nothing.
    others: Vec<Waiting>,
    /// The next timer runs. It keeps its place until it is known when it runs again.
    is_running: bool,
}

/// A timer and its due time.
type Waiting = (Clock, TimerId);

/// A time that does not come. It is 11,000 years ahead.
pub(super) const NEVER: Clock = Clock::from_bits(u64::MAX);

/// Stands for the next timer if there is none.
const NONE: Waiting = (NEVER, TimerId::own(u8::MAX >> 1));

impl Timers {
    /// A queue for `capacity` timers without allocation.
    pub(super) fn with_capacity(capacity: usize) -> Timers {
        Timers { next: NONE, others: Vec::with_capacity(capacity), is_running: false }
    }

    pub(super) fn reserve(&mut self, capacity: usize) {
        self.others.reserve(capacity.saturating_sub(self.others.len()));
    }

    /// The due time of the next timer.
    #[inline]
    pub(super) fn next(&self) -> Option<Clock> {
        Some(self.next.0).filter(|at| *at != NEVER)
    }

    /// The due time of the next exact timer.
    #[inline]
    pub(super) fn next_exact(&self) -> Option<Clock> {
        self.in_order().find(|(_, timer)| timer.is_exact()).map(|(at, _)| at)
    }

    /// Whether the next timer has the due time of the one after it.
    #[inline]
    pub(super) fn has_several_next(&self) -> bool {
        self.others.last().is_some_and(|(other, _)| *other == self.next.0)
    }

    /// The timers with this due time, if they are the next ones, in their order.
    pub(super) fn of_instant(&self, at: Clock) -> impl Iterator<Item = TimerId> {
        self.in_order().take_while(move |(of, _)| *of == at).map(|(_, timer)| timer)
    }

    fn in_order(&self) -> impl Iterator<Item = Waiting> {
        iter::once(self.next).filter(|next| *next != NONE).chain(self.others.iter().rev().copied())
    }

    /// The next timer, if it is due at `now`, and its due time.
    #[inline]
    pub(super) fn due(&self, now: Clock) -> Option<(Clock, TimerId)> {
        Some(self.next).filter(|(at, _)| *at <= now)
    }

    /// The next timer runs now, until [`Timers::pop`] or [`Timers::repeat`].
    #[inline]
    pub(super) fn run(&mut self) {
        self.is_running = true;
    }

    /// Takes the next timer.
    #[inline]
    pub(super) fn pop(&mut self) {
        self.is_running = false;
        self.next = self.others.pop().unwrap_or(NONE);
    }

    /// The running timer, which is this one, runs again at this time, after those with the same due time.
    #[inline(always)]
    pub(super) fn repeat(&mut self, at: Clock, timer: TimerId) {
        self.is_running = false;
        self.next = (at, timer);
        if let Some(other) = self.others.last().filter(|other| other.0 <= at) {
            self.next = *other;
            self.settle(at, timer);
        }
    }

    /// Inserts a timer after those with the same due time. A timer waits at most once, and the running one keeps its
    /// place. So there is at most one entry more than timers.
    pub(super) fn insert(&mut self, at: Clock, timer: TimerId) {
        debug_assert!(
            self.in_order().skip(self.is_running.into()).all(|(_, waiting)| waiting != timer),
            "{timer:?} already waits"
        );
        if !self.is_running && at < self.next.0 {
            let later = mem::replace(&mut self.next, (at, timer));
            self.others.extend(Some(later).filter(|later| *later != NONE));
        } else {
            self.others.push((at, timer));
            self.settle(at, timer);
        }
    }

    /// Puts a timer into its place among the others. Their last entry is free for that.
    #[inline(always)]
    fn settle(&mut self, at: Clock, timer: TimerId) {
        let mut others = self.others.as_mut_slice();
        // Its place is usually near the end, so moving entries one by one is faster than memmove.
        while let [earlier @ .., free] = others
            && let Some(before) = earlier.last()
            && before.0 <= at
        {
            *free = *before;
            others = earlier;
        }
        if let [.., free] = others {
            *free = (at, timer);
        }
    }

    /// Removes a timer, unless it runs.
    pub(super) fn remove(&mut self, timer: TimerId) {
        self.retain(|waiting| waiting != timer);
    }

    /// Removes the timers of objects, without the running one.
    pub(super) fn clear(&mut self) {
        self.retain(|timer| timer.oid == Oid::NONE);
    }

    fn retain(&mut self, keeps: impl Fn(TimerId) -> bool) {
        self.others.retain(|(_, timer)| keeps(*timer));
        if !self.is_running && !keeps(self.next.1) {
            self.pop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn timers_come_by_instant_and_then_by_insertion(instants in proptest::collection::vec(0u64..20, 0..100)) {
            let mut timers = Timers::with_capacity(0);
            let mut expected: Vec<(Clock, TimerId)> = instants
                .iter()
                .enumerate()
                .map(|(i, at)| (Clock::from_ticks(*at), TimerId::of(Oid::new(i as u8), Timer::exact(0))))
                .collect();
            for (at, timer) in &expected {
                timers.insert(*at, *timer);
            }
            expected.sort_by_key(|(at, _)| *at);
            let got: Vec<_> = iter::from_fn(|| timers.due(Clock::from_ticks(20)).inspect(|_| timers.pop())).collect();
            prop_assert_eq!(got, expected);
        }

        /// Each step runs the next timer. Its event starts a timer, removes one (perhaps itself), and it may run again.
        #[test]
        fn a_timer_that_runs_is_as_if_it_was_taken(
            steps in proptest::collection::vec((0u64..20, 0u8..40, proptest::option::of(0u64..20)), 0..40),
        ) {
            let (mut timers, mut taken) = (Timers::with_capacity(0), Timers::with_capacity(0));
            for queue in [&mut timers, &mut taken] {
                queue.insert(Clock::from_ticks(10), TimerId::of(Oid::new(255), Timer::exact(0)));
            }
            for (number, (starts, removes, again)) in (0..).zip(steps) {
                let Some((_, timer)) = timers.due(Clock::from_ticks(20)) else { break };
                timers.run();
                taken.pop();
                for queue in [&mut timers, &mut taken] {
                    queue.insert(Clock::from_ticks(starts), TimerId::of(Oid::new(number), Timer::exact(0)));
                    queue.remove(TimerId::of(Oid::new(removes), Timer::exact(0)));
                }
                match again.map(Clock::from_ticks) {
                    Some(at) => {
                        timers.repeat(at, timer);
                        taken.insert(at, timer);
                    }
                    None => timers.pop(),
                }
                prop_assert_eq!(timers.in_order().collect::<Vec<_>>(), taken.in_order().collect::<Vec<_>>());
            }
        }
    }
}
