// SPDX-License-Identifier: GPL-3.0-or-later
//! Has the linker put the functions and constants of the crates that only the start and the other subcommands use into
//! sections of their own. A program that serves a host gives their pages back (`crates/linux/src/sys/pages.rs`), and keeps
//! all others.

use std::path::Path;
use std::{env, fs};

/// No crate here may be a dependency of pinion-runtime: `tests/program/sections.rs` checks it.
const CRATES: [&str; 31] = [
    "anstream",
    "anstyle",
    "anstyle_parse",
    "anstyle_query",
    "buffer_redux",
    "clap_builder",
    "clap_complete",
    "clap_lex",
    "colorchoice",
    "lock_api",
    "parking_lot",
    "parking_lot_core",
    "pinion",
    "pinion_client",
    "pinion_printer_config",
    "pinion_system",
    "rustix",
    "rustyline",
    "scopeguard",
    "serde_spanned",
    "strsim",
    "termina",
    "terminal_size",
    "toml",
    "toml_datetime",
    "toml_parser",
    "toml_writer",
    "unicode_segmentation",
    "unicode_width",
    "utf8parse",
    "winnow",
];

/// The kernel maps up to 64 kB around a page that is used, so that much is empty at both ends of a section.
const BORDER: u32 = 0x1_0000;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=CARGO_ENCODED_RUSTFLAGS");
    let script = Path::new(&env::var_os("OUT_DIR").expect("cargo names it")).join("commands.ld");
    fs::write(&script, [".text", ".rodata"].map(section).concat()).expect("cargo has made the folder");
    // A linker of the user's choice may not know this. Then the program takes more memory.
    let flags = env::var("CARGO_ENCODED_RUSTFLAGS").unwrap_or_default();
    if !["fuse-ld", "linker"].iter().any(|choice| flags.contains(choice)) {
        println!("cargo::rustc-link-arg-bin=pinion=-Wl,-T,{}", script.display());
    }
}

/// The linker's command for the section `NAME.commands` behind the section `NAME`.
///
/// The first form of a file is that of a release build, the second that of others. A file that no longer has such a name
/// stays where it was, and its pages are kept.
fn section(name: &str) -> String {
    let files = CRATES.map(|crate_| {
        format!(
            "    *.{crate_}-????????????????.{crate_}.*({name} {name}.*)\n    \
             *lib{crate_}-????????????????.rlib:*({name} {name}.*)\n"
        )
    });
    format!(
        "SECTIONS\n{{\n  {name}.commands :\n  {{\n    . += {BORDER};\n{}    . += {BORDER};\n  }}\n}}\nINSERT AFTER {name};\n",
        files.concat()
    )
}
