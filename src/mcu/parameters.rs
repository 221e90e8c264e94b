// SPDX-License-Identifier: GPL-3.0-or-later
//! What the parameters of commands and responses may be, beside plain numbers and bytes.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::time::{Clock, Ticks};
use crate::wire::Malformed;
use crate::wire::format::{Arg, Field};
use crate::wire::vlq::{Reader, Writer};

#[cfg(doc)]
use super::Mcu;

/// An object's id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Oid(pub u8);

impl Oid {
    /// What `set_digital_out` and `set_pwm_out` set belongs to no object. `allocate_oids` counts
    /// to 255 at most, so none can have this.
    pub(super) const NOBODY: Oid = Oid(u8::MAX);
}

impl Arg<'_> for Oid {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    #[inline]
    fn decode(reader: &mut Reader<'_>) -> Result<Oid, Malformed> {
        u8::decode(reader).map(Oid)
    }
}

impl Field for Oid {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    fn encode(&self, writer: &mut Writer) {
        self.0.encode(writer);
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
