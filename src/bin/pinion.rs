// SPDX-License-Identifier: GPL-3.0-or-later
//! The program `pinion`.

#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    pinion::main()
}
