// SPDX-License-Identifier: GPL-3.0-or-later
//! Moves as step sequences, paced into the MCU's move queue, and homing against an endstop with klippy's commands.

mod endstop;
mod homing;
mod profile;
mod queue;

pub use endstop::{Endstop, HomingEnd};
pub use homing::Homed;
pub use profile::{Profile, Run};
pub use queue::{MoveQueue, Sight, Stepper, Watch};
