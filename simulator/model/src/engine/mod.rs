// SPDX-License-Identifier: GPL-3.0-or-later
//! The elements of every printer: motion and heat, wires and buses, time. It names no part.

pub(crate) mod assemble;
pub(crate) mod bed;
pub(crate) mod crc;
pub(crate) mod dock;
pub(crate) mod follower;
pub(crate) mod i2c;
pub(crate) mod led;
pub(crate) mod linkage;
pub(crate) mod look;
pub(crate) mod motion;
pub(crate) mod noise;
pub(crate) mod pace;
pub(crate) mod physics;
pub(crate) mod rail;
pub(crate) mod recorder;
pub(crate) mod register_map;
pub(crate) mod ring;
pub(crate) mod seqlock;
pub(crate) mod serial;
pub(crate) mod spi;
pub(crate) mod time;
pub(crate) mod track;
pub(crate) mod wire;
pub(crate) mod world;
