// SPDX-License-Identifier: GPL-3.0-or-later
//! The board that the command line names.

use std::sync::Arc;

use pinion_firmware::board::Board;
use pinion_firmware::time::{TimeSource, Timing};
use pinion_firmware::trouble::Trouble;
use pinion_linux::gpio::FastGpio;
use pinion_linux::{Guard, LinuxBoard};
use pinion_system::settings::BoardName;

use crate::simulator::Open;

/// Opens a board, a simulated one by `simulated`, to see what it has. The timing is for its MCU.
pub(crate) fn open(
    board: &BoardName,
    clock: Arc<dyn TimeSource>,
    simulated: Open,
) -> Result<(Box<dyn Board>, Timing), Trouble> {
    match board {
        BoardName::Linux => Ok(linux(clock, None, FastGpio::Off)),
        BoardName::Sim(file) => simulated(file.as_deref(), clock),
    }
}

/// This computer's pins. Their outputs are given to `guard`. The timing is for the MCU.
pub(crate) fn linux(
    clock: Arc<dyn TimeSource>,
    guard: Option<Box<dyn Guard>>,
    fast_gpio: FastGpio,
) -> (Box<dyn Board>, Timing) {
    (LinuxBoard::boxed(guard, fast_gpio), Timing::of(clock))
}
