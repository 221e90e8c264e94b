// SPDX-License-Identifier: GPL-3.0-or-later
//! The appearance of a part: as data for a picture, and as text.

use std::fmt;

/// The brightness of each part of a light, 0 to 255.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Colour {
    /// The red part.
    pub red: u8,
    /// The green part.
    pub green: u8,
    /// The blue part.
    pub blue: u8,
    /// The white part; 0 for a light without it.
    pub white: u8,
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

/// The appearance of a part at one instant. Its text is what `pinion sim --show` prints.
#[derive(Clone, Debug, PartialEq)]
pub enum Look {
    /// A light, or a strip from its first light on.
    Lights {
        /// The color of each light.
        colours: Vec<Colour>,
        /// Pulses so far that a data sheet does not allow.
        odd_pulses: u32,
    },
    /// A display.
    Pixels {
        /// Pixels in a row.
        width: usize,
        /// Number of rows.
        height: usize,
        /// Whether the display is on. All of it is dark otherwise, whatever `lit` says.
        is_on: bool,
        /// Whether each pixel shines: `width * height` of them, row by row from the upper left.
        lit: Vec<bool>,
    },
    /// A servo's arm.
    Angle {
        /// The angle from its first stop.
        degrees: f64,
    },
    /// A probe's push-pin.
    Pin {
        /// Whether the pin is out.
        is_down: bool,
        /// Whether the probe blinks because its pin was blocked.
        alarm: bool,
    },
    /// The power of a laser or another PWM output.
    Power {
        /// The part of its time that it is on, 0 to 1.
        share: f64,
    },
}

/// The dots of a Braille character by column and row, as bits of its code point from U+2800 on (Unicode, "Braille
/// Patterns").
const DOTS: [[u32; 4]; 2] = [[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]];

/// The Braille character of 2 x 4 pixels, from their upper left one on.
fn braille(lit: impl Fn(usize, usize) -> bool, x: usize, y: usize) -> char {
    let dots = (0..2).flat_map(|dx| (0..4).map(move |dy| (dx, dy)));
    let bits: u32 = dots.filter(|(dx, dy)| lit(x + dx, y + dy)).map(|(dx, dy)| DOTS[dx][dy]).sum();
    char::from_u32(0x2800 + bits).unwrap_or(' ')
}

impl fmt::Display for Look {
    /// A line, or several lines for a display. A color is written as `#rrggbb`, and `pinion sim --show` paints it where
    /// it can.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Look::Lights { colours, odd_pulses } => {
                let colours: Vec<String> = colours.iter().map(Colour::to_string).collect();
                f.write_str(&colours.join(" "))?;
                match odd_pulses {
                    0 => Ok(()),
                    count => write!(f, " ({count} pulses are not the data sheet's)"),
                }
            }
            Look::Pixels { is_on: false, .. } => f.write_str("dark"),
            Look::Pixels { width, height, lit, .. } => {
                let lit = |x: usize, y: usize| x < *width && lit.get(y * width + x) == Some(&true);
                let line = |y: usize| (0..*width).step_by(2).map(|x| braille(lit, x, y)).collect::<String>();
                f.write_str(&(0..*height).step_by(4).map(line).collect::<Vec<_>>().join("\n"))
            }
            Look::Angle { degrees } => write!(f, "{degrees:.1} degrees"),
            Look::Pin { is_down, alarm } => {
                let (pin, alarm) = (if *is_down { "down" } else { "up" }, if *alarm { ", alarm" } else { "" });
                write!(f, "pin {pin}{alarm}")
            }
            Look::Power { share } => write!(f, "{:.0} %", share * 100.0),
        }
    }
}
