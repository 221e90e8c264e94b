// SPDX-License-Identifier: GPL-3.0-or-later
//! Any commands to an MCU in virtual time, for hosts of each generation.
#![no_main]

use pinion_testbench::memory::Counting;
use pinion_testbench::trial;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

pinion_fuzz::target!(trial::play);
