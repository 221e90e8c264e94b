// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion dict`: the data dictionary as a file.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Args;

use pinion_firmware::mcu::{Dialect, DialectName};
use pinion_linux::clock::Monotonic;
use pinion_runtime::FIRMWARE;

use super::board::open;
use super::failed;
use super::page::{Page, print};
use super::simulator::Open;
use pinion_system::complete::{BOARDS, DIALECTS, offering};
use pinion_system::files::Output;
use pinion_system::settings::BoardName;

/// Options of `pinion dict`.
#[derive(Args, Clone, Debug)]
pub struct DictArgs {
    /// Write to FILE instead of stdout
    #[arg(short = 'o', value_name = "FILE")]
    output: Option<PathBuf>,
    /// The board whose pins the dictionary names: linux, sim or sim:FILE.toml
    #[arg(long, value_name = "BOARD", default_value = "linux", value_parser = offering::<BoardName>(BOARDS),
        hide_possible_values = true)]
    board: BoardName,
    /// The hosts of the dictionary: v0.11, v0.12, v0.13 or master of Klipper, kalico, or union (what v0.13,
    /// master and kalico agree on)
    #[arg(long, value_name = "NAME", default_value = "master", value_parser = offering::<DialectName>(DIALECTS),
        hide_possible_values = true)]
    dialect: DialectName,
}

/// Prints the dictionary as JSON. A simulated board is made by `simulated`.
pub fn run(args: &DictArgs, simulated: Open) -> ExitCode {
    put(args, simulated).map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn dictionary(args: &DictArgs, simulated: Open) -> Result<Vec<u8>, String> {
    let (board, _) =
        open(&args.board, Arc::new(Monotonic::start()), simulated).map_err(|trouble| trouble.to_string())?;
    let dialect = Dialect::new(&FIRMWARE, &*board, args.dialect).map_err(|error| error.to_string())?;
    dialect.dictionary().json().map_err(|error| error.to_string())
}

fn put(args: &DictArgs, simulated: Open) -> Result<(), String> {
    let json = dictionary(args, simulated)?;
    match &args.output {
        Some(path) => Output::check(path, &args.board.files())?.write(|out| out.write_all(&json)),
        None => print(&Page::json(&String::from_utf8_lossy(&json))),
    }
}
