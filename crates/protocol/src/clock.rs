// SPDX-License-Identifier: GPL-3.0-or-later
//! Times of a micro-controller's clock.
//!
//! In a program, a time is a `u64` that never wraps. It has 32 bits only on the wire. A 32-bit clock from the other end
//! is widened to the time nearest to a reference.

use std::fmt;

/// A time in ticks. Tick 0 of the wire is [`Clock::EPOCH`], 2^32 ticks above zero. So times before tick 0 can also be
/// represented.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Clock(u64);

impl Clock {
    /// Tick 0.
    pub const EPOCH: Clock = Clock(1 << 32);

    /// The time `ticks` after tick 0.
    pub const fn from_ticks(ticks: u64) -> Clock {
        Clock(Clock::EPOCH.0 + ticks)
    }

    /// Ticks since tick 0; 0 for an earlier time.
    pub const fn ticks(self) -> u64 {
        self.0.saturating_sub(Clock::EPOCH.0)
    }

    /// The time that [`Clock::to_bits`] converted.
    pub const fn from_bits(bits: u64) -> Clock {
        Clock(bits)
    }

    /// The time as a number, for an atomic.
    pub const fn to_bits(self) -> u64 {
        self.0
    }

    /// The 32 bits that the host sees.
    pub const fn wire(self) -> u32 {
        self.0 as u32
    }

    /// The time nearest to `near` whose low 32 bits are `wire`.
    pub const fn widen(wire: u32, near: Clock) -> Clock {
        near.displaced(wire.wrapping_sub(near.wire()))
    }

    /// This time displaced by a span that wraps as in Klipper's 32-bit clocks. A span of 2^31 ticks or more leads
    /// into the past.
    pub const fn displaced(self, ticks: u32) -> Clock {
        Clock(self.0.wrapping_add_signed(ticks as i32 as i64))
    }

    /// Ticks from `earlier` to this time; negative if this time is before it.
    pub const fn since(self, earlier: Clock) -> i64 {
        self.0.wrapping_sub(earlier.0) as i64
    }

    /// The time `ticks` after this one.
    pub const fn later(self, ticks: u64) -> Clock {
        Clock(self.0 + ticks)
    }

    /// The time `ticks` before this one.
    pub const fn earlier(self, ticks: u64) -> Clock {
        Clock(self.0.wrapping_sub(ticks))
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Clock({})", self.0.wrapping_sub(Clock::EPOCH.0) as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_wire_clock_widens_to_the_nearest_instant(near in 1u64 << 33..1 << 62, wire: u32) {
            let near = Clock(near);
            let wide = Clock::widen(wire, near);
            prop_assert_eq!(wide.wire(), wire);
            prop_assert!((-(1 << 31)..1 << 31).contains(&wide.since(near)));
        }

        #[test]
        fn an_instant_comes_back_from_the_wire(near in 1u64 << 33..1 << 60, offset in -(1i64 << 31)..(1 << 31)) {
            let instant = Clock(near.wrapping_add_signed(offset));
            prop_assert_eq!(Clock::widen(instant.wire(), Clock(near)), instant);
        }

        #[test]
        fn a_span_is_the_distance_between_its_ends(start in 0u64..1 << 60, span in 0u64..1 << 60) {
            let start = Clock::from_ticks(start);
            let end = start.later(span);
            prop_assert_eq!(end.ticks() - start.ticks(), span);
            prop_assert_eq!(end.since(start), span as i64);
            prop_assert_eq!(start.since(end), -(span as i64));
            prop_assert_eq!(end.earlier(span), start);
            prop_assert_eq!(Clock::from_bits(end.to_bits()), end);
        }
    }

    #[test]
    fn times_before_tick_zero_have_no_ticks_but_a_distance() {
        assert_eq!((Clock::EPOCH.ticks(), Clock::EPOCH.wire(), Clock::EPOCH.to_bits()), (0, 0, 1 << 32));
        let before = Clock::EPOCH.earlier(3);
        assert_eq!((before.ticks(), before.wire(), before.since(Clock::EPOCH)), (0, u32::MAX - 2, -3));
        assert_eq!(format!("{before:?} {:?}", Clock::from_ticks(12)), "Clock(-3) Clock(12)");
    }
}
