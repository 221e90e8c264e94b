// SPDX-License-Identifier: GPL-3.0-or-later
//! Parameter types of commands and responses, besides plain numbers and bytes.

use std::fmt;

use crate::board::Pin;
use crate::time::Ticks;
use pinion_protocol::Malformed;
use pinion_protocol::format::{Arg, Field};
use pinion_protocol::vlq::{Reader, Writer};

#[cfg(doc)]
use super::Context;

/// An object's id. It is the host's oid, or the id of a feature's own object ([`Context::own`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Oid(u16);

impl Oid {
    /// Lower ids are the host's. Ids from here on belong to features' own objects.
    pub(super) const FIRST_OWN: usize = 256;

    /// No object: a command to the MCU runs.
    pub(super) const NONE: Oid = Oid(u16::MAX);

    /// The id with this number on the wire.
    pub const fn new(oid: u8) -> Oid {
        Oid(oid as u16)
    }

    /// The id of the object at this place in the table.
    pub(super) fn at(index: usize) -> Oid {
        Oid(u16::try_from(index).unwrap_or(u16::MAX))
    }

    /// The number on the wire; `None` for a feature's own object.
    pub fn number(self) -> Option<u8> {
        u8::try_from(self.0).ok()
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
    // `%c` suggests a byte, but the host encodes every integer whole, and a pin may exceed 255.
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

/// A time as the host sends it: the low 32 bits of a clock. [`Context::instant`] completes it.
#[derive(Clone, Copy, Debug)]
pub struct WireClock(pub u32);

impl Arg<'_> for WireClock {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    fn decode(reader: &mut Reader<'_>) -> Result<WireClock, Malformed> {
        reader.int().map(WireClock)
    }
}

impl fmt::Display for Oid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
