// SPDX-License-Identifier: GPL-3.0-or-later
//! What the parameters of commands and responses may be, beside plain numbers and bytes.

#![forbid(unsafe_code)]

use std::fmt;

use crate::board::Pin;
use crate::time::{Clock, Ticks};
use crate::wire::Malformed;
use crate::wire::format::{Arg, Field};
use crate::wire::vlq::{Reader, Writer};

#[cfg(doc)]
use super::Mcu;

/// An object's id: that of the wire, or that of an object that belongs to a feature
/// ([`Mcu::own`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Oid(u16);

impl Oid {
    /// The ids of the wire are below this one; those from here on are of features' own objects.
    pub(super) const FIRST_OWN: usize = 256;

    /// The id that the host calls by this number.
    pub const fn new(oid: u8) -> Oid {
        Oid(oid as u16)
    }

    /// The id of the object at a place of the table.
    pub(super) fn at(index: usize) -> Oid {
        Oid(u16::try_from(index).unwrap_or(u16::MAX))
    }

    /// The object's place in the table.
    #[inline]
    pub(super) fn index(self) -> usize {
        usize::from(self.0)
    }
}

impl Arg<'_> for Oid {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    #[inline]
    fn decode(reader: &mut Reader<'_>) -> Result<Oid, Malformed> {
        u8::decode(reader).map(Oid::new)
    }
}

impl Field for Oid {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    fn encode(&self, writer: &mut Writer) {
        writer.int(self.0.into());
    }
}

impl Arg<'_> for Pin {
    // A pin under `%c` exceeds 255: the host writes every integer whole.
    const CONVERSIONS: &'static [&'static str] = &["%u", "%c"];
    fn decode(reader: &mut Reader<'_>) -> Result<Pin, Malformed> {
        reader.int().map(Pin)
    }
}

impl Arg<'_> for Ticks {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    #[inline]
    fn decode(reader: &mut Reader<'_>) -> Result<Ticks, Malformed> {
        reader.int().map(Ticks)
    }
}

/// An instant as the host sent it, to be widened by [`Mcu::instant`].
#[derive(Clone, Copy, Debug)]
pub struct WireClock(pub u32);

impl Arg<'_> for WireClock {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    fn decode(reader: &mut Reader<'_>) -> Result<WireClock, Malformed> {
        reader.int().map(WireClock)
    }
}

impl Field for Clock {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    fn encode(&self, writer: &mut Writer) {
        writer.int(self.wire());
    }
}

impl fmt::Display for Oid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
