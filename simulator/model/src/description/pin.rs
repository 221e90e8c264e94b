// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of pins.

use std::fmt;

use serde::{Deserialize, Serialize};

/// A pin's name in the description: `x_step`, or `!x_step` for an inverted pin. `toolhead:x_step` is a pin of the board
/// `toolhead`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct PinName {
    /// The name that the board publishes, behind the board's own name.
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
        if is_local(name) {
            Ok(PinName { name: name.to_owned(), inverted })
        } else {
            Err(format!(
                "`{text}` is not a pin name: use letters, digits, `_`, `-`, `.` and `/`, with `!` \
                 in front to invert, and `BOARD:` for a pin of another board"
            ))
        }
    }
}

impl From<PinName> for String {
    fn from(pin: PinName) -> String {
        pin.to_string()
    }
}

impl fmt::Display for PinName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.inverted { "!" } else { "" })?;
        f.write_str(&self.name)
    }
}

/// The board in the name of a pin or a bus, and its name there.
pub(crate) fn on_board(name: &str) -> (Option<&str>, &str) {
    name.split_once(':').map_or((None, name), |(board, local)| (Some(board), local))
}

/// Whether `text` is the name of a pin or a bus, perhaps with its board.
pub(crate) fn is_local(text: &str) -> bool {
    let (board, local) = on_board(text);
    board.is_none_or(is_klippy_name) && is_klippy_name(local)
}

/// Whether klippy accepts `text` as the name of a pin or of a section.
pub fn is_klippy_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c))
}
