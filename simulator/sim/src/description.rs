// SPDX-License-Identifier: GPL-3.0-or-later
//! The description of a simulated printer: from a file, or the built-in one.

use std::path::Path;
use std::sync::Arc;

use pinion_firmware::board::Board;
use pinion_firmware::time::{TimeSource, Timing};
use pinion_firmware::trouble::Trouble;
use pinion_model::{SimBoard, SimConfig};
use pinion_system::files;

/// Longest description.
const DESCRIPTION_MIB: u64 = 1;

/// Reads a description.
pub(crate) fn read(file: Option<&Path>) -> Result<SimConfig, Trouble> {
    let Some(path) = file else { return Ok(SimConfig::default_printer()) };
    SimConfig::parse(&text(path)?, &path.display().to_string())
}

/// The text of a description.
pub(crate) fn text(path: &Path) -> Result<String, Trouble> {
    let unreadable = |cause: String| {
        let trouble = Trouble::new(cause).of(path.display());
        trouble.remedy("name a readable TOML file, or take `--board sim` for the built-in printer")
    };
    let bytes = files::read(path, DESCRIPTION_MIB).map_err(|error| unreadable(error.to_string()))?;
    String::from_utf8(bytes).map_err(|_| unreadable("this is not UTF-8 text".into()))
}

/// Makes the board of a description, for the commands of `pinion` ([`pinion::simulator::Open`]).
pub(crate) fn open(file: Option<&Path>, clock: Arc<dyn TimeSource>) -> Result<(Box<dyn Board>, Timing), Trouble> {
    let board = SimBoard::new(read(file)?, clock)?;
    let timing = board.timing();
    Ok((Box::new(board), timing))
}
