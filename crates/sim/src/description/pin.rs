// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of pins.

#![forbid(unsafe_code)]

use std::fmt;

use serde::Deserialize;

/// A pin's name in the description: `x_step`, or `!x_step` for an inverted pin.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct PinName {
    /// The name that the board publishes.
    pub name: String,
    /// Whether a low level means on.
    pub inverted: bool,
}

impl TryFrom<String> for PinName {
    type Error = String;
    fn try_from(text: String) -> Result<PinName, String> {
        let (name, inverted) = match text.strip_prefix('!') {
            Some(name) => (name, true),
            None => (text.as_str(), false),
        };
        if is_word(name) {
            Ok(PinName { name: name.to_owned(), inverted })
        } else {
            Err(format!(
                "`{text}` is no pin name: use letters, digits, `_`, `-`, `.` and `/`, with `!` \
                 in front to invert"
            ))
        }
    }
}

impl fmt::Display for PinName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.inverted { "!" } else { "" })?;
        f.write_str(&self.name)
    }
}

/// Whether klippy accepts `text` as the name of a pin or of a section.
pub(crate) fn is_word(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c))
}
