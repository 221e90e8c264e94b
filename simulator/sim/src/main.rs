// SPDX-License-Identifier: GPL-3.0-or-later
//! The program `pinion-sim`: a simulated printer, and the commands of `pinion` on its board.
//!
//! `pinion sim` and `--board sim…` start it ([`pinion::simulator`]), so that the program that drives heaters contains
//! no simulator.

#![forbid(unsafe_code)]
// Printing panics when nobody reads. The others panic when an assumption is wrong. Tests may use all of them.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

use std::process::ExitCode;

use clap::{CommandFactory as _, Parser, Subcommand};

use pinion::console::{self, ConsoleArgs};
use pinion::dict::{self, DictArgs};
use pinion::run;
use pinion::{completions, logging, with_simulator};
use pinion_system::settings::{LogArgs, RunArgs};
use printer::SimArgs;

mod attempt;
mod boards;
mod camera;
mod demo;
mod description;
mod own;
mod own_status;
mod printer;
mod show;
mod toolpath;

/// A simulated printer for a Klipper host: shows it at work, then serves it. The same as `pinion sim`.
#[derive(Parser, Debug)]
#[command(name = "pinion-sim", version = pinion_runtime::VERSION, max_term_width = 100, args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    sim: SimArgs,
    #[command(flatten)]
    log: LogArgs,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// What `pinion run --board sim` does
    Run(RunArgs),
    /// What `pinion dict --board sim` does
    Dict(DictArgs),
    /// What `pinion console --board sim` does
    Console(ConsoleArgs),
    /// Print a script with which a shell completes pinion-sim's command lines
    Completions {
        /// The shell
        shell: clap_complete::Shell,
        /// Complete pinion's command lines, with those behind pinion sim
        #[arg(long, hide = true)]
        all: bool,
    },
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    logging::start(cli.log.level());
    let status = match cli.command {
        None => printer::run(&cli.sim),
        Some(Command::Run(args)) => run::run(&args, cli.log.log_level, description::open),
        Some(Command::Dict(args)) => dict::run(&args, description::open),
        Some(Command::Console(args)) => console::run(&args, description::open),
        Some(Command::Completions { shell, all }) => {
            let own = Cli::command();
            completions(&mut if all { with_simulator(own) } else { own }, shell)
        }
    };
    logging::finish();
    status
}
