// SPDX-License-Identifier: GPL-3.0-or-later
//! The color of a light, as a person reads it.

#![forbid(unsafe_code)]

use std::fmt;

/// The brightness of each part of a light, 0 to 255.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Colour {
    pub(crate) red: u8,
    pub(crate) green: u8,
    pub(crate) blue: u8,
    /// For a light that has a white part.
    pub(crate) white: u8,
}

impl fmt::Display for Colour {
    /// `off`, `#rrggbb`, or `#rrggbb+ww` if the white part is on.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Colour { red, green, blue, white } = *self;
        if *self == Colour::default() {
            return f.write_str("off");
        }
        write!(f, "#{red:02x}{green:02x}{blue:02x}")?;
        if white > 0 { write!(f, "+{white:02x}") } else { Ok(()) }
    }
}

/// The colors of a strip, from its first light on.
pub(crate) fn list(colours: impl Iterator<Item = Colour>) -> String {
    let colours: Vec<String> = colours.map(|colour| colour.to_string()).collect();
    colours.join(" ")
}
