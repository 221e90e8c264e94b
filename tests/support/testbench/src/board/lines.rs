// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO lines, their bank and their interrupts.

use std::sync::PoisonError;
use std::time::Duration;

use pinion_firmware::board::{self, Bank, Direction, Edges, Line};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{NS_PER_TICK, Ticks, TimeSource};

use super::bench::Bench;
use crate::memory::uncounted;

pub(super) struct FakeLine {
    pub(super) bench: Bench,
    pub(super) pin: u32,
}

impl Drop for FakeLine {
    fn drop(&mut self) {
        // This also runs when a test panics.
        self.bench.state.lock().unwrap_or_else(PoisonError::into_inner).held.remove(&self.pin);
    }
}

impl FakeLine {
    fn drive(bench: &Bench, pin: u32, level: bool) {
        let at = bench.arrival();
        let mut state = bench.state();
        if state.levels.insert(pin, level) != Some(level) {
            uncounted(|| state.edges.push((pin, (at, level.into()))));
            for chip in state.line_chips.values_mut() {
                chip(at, Some((pin, level)));
            }
        }
    }
}

impl Line for FakeLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        self.bench.may_call(self.pin);
        self.bench.broken(self.pin, reason::LINE_WRITE)?;
        if matches!(self.bench.state().directions.get(&self.pin), Some(Direction::Input(_))) {
            return Ok(());
        }
        FakeLine::drive(&self.bench, self.pin, level);
        self.bench.clock.set(self.bench.clock.now() + Ticks(self.bench.state().write_ticks));
        Ok(())
    }

    fn bank(&self) -> Option<(&'static dyn Bank, u32)> {
        let state = self.bench.state();
        let is_output = matches!(state.directions.get(&self.pin), Some(Direction::Output { .. }));
        state.bank.filter(|_| is_output && self.pin < u32::BITS).map(|bank| (bank, 1 << self.pin))
    }

    fn read(&self) -> Result<bool, Shutdown> {
        self.bench.may_call(self.pin);
        self.bench.broken(self.pin, reason::LINE_READ)?;
        let now = self.bench.ticks();
        let mut state = self.bench.state();
        if let Some(chip) = state.line_chips.get_mut(&self.pin) {
            return Ok(chip(now, None));
        }
        let levels = state.inputs.get(&self.pin).map_or(&[][..], Vec::as_slice);
        Ok(levels.iter().rev().find(|(from, _)| *from <= now).is_some_and(|(_, level)| *level != 0))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let mut state = self.bench.state();
        let before = state.directions.insert(self.pin, direction);
        if let Direction::Output { level, .. } = direction {
            let was = state.levels.insert(self.pin, level);
            let at = self.bench.ticks();
            if before.is_some() && was != Some(level) {
                uncounted(|| state.edges.push((self.pin, (at, level.into()))));
            }
            for chip in state.line_chips.values_mut() {
                chip(at, Some((self.pin, level)));
            }
        }
        Ok(())
    }

    fn is_fast(&self) -> bool {
        self.bench.state().fast.contains(&self.pin)
    }

    fn flush(&self) {
        self.bench.flush();
    }

    fn is_posted(&self) -> bool {
        self.bench.state().link.is_some()
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        self.bench.may_call(self.pin);
        self.bench.broken(self.pin, reason::LINE_WRITE)?;
        uncounted(|| self.bench.state().turns.push((self.pin, direction)));
        self.set_direction(direction)
    }
}

/// The lines of pins 0 to 31.
pub(super) struct FakeBank(pub(super) Bench);

impl Bank for FakeBank {
    fn change(&self, high: u32, low: u32) {
        uncounted(|| self.0.state().stores.push((high, low)));
        for (lines, level) in [(high, true), (low, false)] {
            (0..u32::BITS).filter(|pin| lines >> pin & 1 != 0).for_each(|pin| FakeLine::drive(&self.0, pin, level));
        }
        self.0.clock.set(self.0.clock.now() + Ticks(self.0.state().write_ticks));
    }

    fn flush(&self) {
        self.0.flush();
    }
}

/// The changes of a scripted input.
pub(super) struct FakeEdges {
    pub(super) bench: Bench,
    pub(super) pin: u32,
    /// How many changes were read.
    pub(super) taken: usize,
}

impl Edges for FakeEdges {
    fn take(&mut self, see: &mut dyn FnMut(board::Edge)) -> Result<(), Shutdown> {
        self.bench.broken(self.pin, reason::LINE_READ)?;
        let now = self.bench.ticks();
        let state = self.bench.state();
        assert!(state.counted.contains(&self.pin), "the interrupts were ended");
        let levels = state.inputs.get(&self.pin).map_or(&[][..], Vec::as_slice);
        let monotonic = |at: u64| Duration::from_nanos((self.bench.origin.ticks() + at) * NS_PER_TICK);
        for (at, level) in levels[self.taken..].iter().take_while(|(at, _)| *at <= now) {
            self.taken += 1;
            see(board::Edge { at: monotonic(*at), level: *level != 0, dropped: 0 });
        }
        Ok(())
    }

    fn end(&mut self) -> Result<(), Shutdown> {
        self.bench.state().counted.remove(&self.pin);
        Ok(())
    }
}
