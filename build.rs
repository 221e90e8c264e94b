// SPDX-License-Identifier: GPL-3.0-or-later
//! Has the linker put the functions that are of no use to a program that serves a host beside each other (`commands.ld`).

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=commands.ld");
    println!("cargo::rerun-if-env-changed=CARGO_ENCODED_RUSTFLAGS");
    // A linker of the user's choice may not know this. Then the program takes more memory.
    let flags = env::var("CARGO_ENCODED_RUSTFLAGS").unwrap_or_default();
    if !["fuse-ld", "linker"].iter().any(|choice| flags.contains(choice)) {
        println!("cargo::rustc-link-arg-bin=pinion=-Wl,-T,{}/commands.ld", env!("CARGO_MANIFEST_DIR"));
    }
}
