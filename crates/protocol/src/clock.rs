// SPDX-License-Identifier: GPL-3.0-or-later
//! Instants of a micro-controller's clock.
//!
//! Inside, an instant is a `u64` that never wraps. It becomes 32 bits only on the wire, and a
//! 32-bit clock from the other end is widened to the instant nearest to a reference.

#![forbid(unsafe_code)]

use std::fmt;

/// An instant in ticks. Tick 0 of the wire is [`Clock::EPOCH`], a whole turn of the 32-bit
/// clock above zero, so that an instant before it can still be told.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Clock(u64);

impl Clock {
    /// Tick 0.
    pub const EPOCH: Clock = Clock(1 << 32);

    /// The instant `ticks` after tick 0.
    pub const fn from_ticks(ticks: u64) -> Clock {
        Clock(Clock::EPOCH.0 + ticks)
    }

    /// Ticks since tick 0; an instant before it counts as tick 0.
    pub const fn ticks(self) -> u64 {
        self.0.saturating_sub(Clock::EPOCH.0)
    }

    /// The instant as [`Clock::to_bits`] gave it.
    pub const fn from_bits(bits: u64) -> Clock {
        Clock(bits)
    }

    /// The instant as a number that an atomic can hold.
    pub const fn to_bits(self) -> u64 {
        self.0
    }

    /// The 32 bits that the host sees.
    pub const fn wire(self) -> u32 {
        self.0 as u32
    }

    /// The instant nearest to `near` whose 32 bits are `wire`.
    pub const fn widen(wire: u32, near: Clock) -> Clock {
        near.displaced(wire.wrapping_sub(near.wire()))
    }

    /// This instant displaced by a span that wraps as the firmware's 32-bit clocks do: from
    /// 2^31 ticks on it lies in the past.
    pub const fn displaced(self, ticks: u32) -> Clock {
        Clock(self.0.wrapping_add_signed(ticks as i32 as i64))
    }

    /// Ticks from `earlier` to this instant, negative if this one is before it.
    pub const fn since(self, earlier: Clock) -> i64 {
        self.0.wrapping_sub(earlier.0) as i64
    }

    /// The instant `ticks` after this one.
    pub const fn later(self, ticks: u64) -> Clock {
        Clock(self.0 + ticks)
    }

    /// The instant `ticks` before this one.
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
    }
}
