// SPDX-License-Identifier: GPL-3.0-or-later
//! The actions of a trial, chosen by bytes.

#![forbid(unsafe_code)]

use pinion_protocol::block::PAYLOAD_MAX;

use super::form::{EXTREMES, PINS};

/// Highest number of parameters that a command has.
const PARAMETERS_MAX: usize = 9;

/// An action and what belongs to it.
#[derive(Clone, Debug)]
pub(super) enum Action {
    /// A command: its index, the index of arguments that it accepts, and the changes to them.
    Send(usize, usize, Vec<Option<Change>>),
    Turns(u32),
    Stall(u64),
    Stop,
    /// A pin or the chips of a bus fail until everything is repaired.
    Break(u32),
    Mend,
}

#[derive(Clone, Debug)]
pub(super) enum Change {
    Extreme(u32),
    Small(u32),
    Any(u32),
    Pin(u32),
    Bytes(u8, usize),
}

/// The next step after the MCU has stopped.
#[derive(Clone, Copy, Debug)]
pub(super) enum Recovery {
    Nothing,
    Clear,
    /// A reset; the next commands configure the MCU.
    Reset,
    Configure,
}

/// Bytes that choose what happens. When they are used up, they are zeros.
pub(super) struct Choices<'a>(pub(super) &'a [u8]);

impl Choices<'_> {
    pub(super) fn bytes<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.byte())
    }

    pub(super) fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    pub(super) fn below(&mut self, end: u8) -> u8 {
        self.byte() % end
    }

    pub(super) fn half(&mut self) -> u16 {
        u16::from_le_bytes(self.bytes())
    }

    pub(super) fn word(&mut self) -> u32 {
        u32::from_le_bytes(self.bytes())
    }

    pub(super) fn of<T: Copy>(&mut self, values: &[T]) -> T {
        values[usize::from(self.byte()) % values.len()]
    }

    pub(super) fn action(&mut self) -> Action {
        match self.below(30) {
            0..20 => {
                let (which, call, count) = (self.half(), self.byte(), PARAMETERS_MAX);
                Action::Send(which.into(), call.into(), (0..count).map(|_| self.change()).collect())
            }
            20..26 => Action::Turns(1 + u32::from(self.below(39))),
            26 => Action::Stall(u64::from(self.word()) % 10_000_000),
            27 => Action::Stop,
            28 => Action::Break(self.of(PINS)),
            _ => Action::Mend,
        }
    }

    pub(super) fn change(&mut self) -> Option<Change> {
        if self.below(6) != 1 {
            return None;
        }
        Some(match self.below(11) {
            0..4 => Change::Extreme(self.of(EXTREMES)),
            4..7 => Change::Small(self.below(10).into()),
            7 => Change::Any(self.word()),
            8 => Change::Pin(self.of(PINS)),
            _ => Change::Bytes(self.byte(), usize::from(self.byte()) % (PAYLOAD_MAX + 1)),
        })
    }

    pub(super) fn recovery(&mut self) -> Recovery {
        match self.below(12) {
            0 | 1 => Recovery::Nothing,
            2..8 => Recovery::Clear,
            8 => Recovery::Reset,
            _ => Recovery::Configure,
        }
    }
}
