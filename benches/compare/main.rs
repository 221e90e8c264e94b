// SPDX-License-Identifier: GPL-3.0-or-later
//! Runs MCU programs under the same load, in turn, and prints their figures side by side. docs/develop/performance.md
//! says what is measured and how.
//!
//! - [`rig`]: a /dev of null devices, the stand-in for their drivers, the program's start
//! - [`steps`]: step edges at a steady rate: how late, how much CPU, how fast at most
//! - [`talk`]: round trips, and commands a second
//! - [`process`]: CPU time and memory, of the program and of the others on this computer
//! - [`table`]: the figures of all runs

#![forbid(unsafe_code)]

use std::iter;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, ValueEnum};
use pinion_client::Arg;

mod process;
mod rig;
mod steps;
mod table;
mod talk;

use rig::{Launch, Program, Rig};
use steps::Load;
use table::{Run, Table};

/// Runs micro-controller programs under the same load, in turn, and prints their figures.
#[derive(Parser, Debug)]
#[command(name = "compare")]
struct Options {
    /// A program to measure: a command line that takes -r and -I PTY, or `pinion` for this
    /// project's own; again for each further program
    #[arg(long = "program", value_name = "NAME=COMMAND")]
    programs: Vec<Program>,
    /// Shorter runs: three seconds where ten are due
    #[arg(long)]
    quick: bool,
    /// What to measure [default: everything]
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    only: Vec<Measure>,
    /// How often to measure everything, the programs in turn
    #[arg(long, value_name = "N", default_value_t = 1)]
    repeat: u32,
    /// Also write every single figure to a file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print the table as Markdown
    #[arg(long)]
    markdown: bool,
    /// Spend a system call on each GPIO access, as a real chip does
    #[arg(long)]
    syscall: bool,
    /// Thousands of steps a second at which lateness is measured
    #[arg(long, value_name = "K", value_delimiter = ',', default_values_t = [1, 10, 50])]
    rates: Vec<u32>,
    /// Told by cargo
    #[arg(long, hide = true)]
    bench: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Measure {
    /// Lateness of step edges, and CPU time a step
    Lateness,
    /// The same beside 4 ms SPI transfers
    Transfers,
    /// Round trips of get_clock and get_uptime
    Roundtrip,
    /// SPI transfers of 30 us
    Spi,
    /// Commands a second
    Commands,
    /// The smallest step interval that survives
    Interval,
    /// CPU time of a configured MCU whose host is silent
    Idle,
    /// Resident and private memory
    Memory,
}

/// How many steppers move at once.
const STEPPERS: [usize; 2] = [1, 3];
/// How long the SPI driver takes for a transfer.
const BUS_US: u32 = 4_000;
/// How long it takes for a short transfer.
const SHORT_US: u32 = 30;

fn main() -> ExitCode {
    let options = Options::parse();
    if options.programs.is_empty() {
        // A plain `cargo bench` gets here too, without permission to take minutes.
        eprintln!("compare: name programs: cargo bench --bench compare -- --program pinion --program c=PATH");
        return ExitCode::SUCCESS;
    }
    match measure(&options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("compare: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<(), String> {
    let rig = Rig::new(options.syscall)?;
    let mut table = Table::new(options.programs.iter().map(|program| program.name.clone()).collect());
    for round in 0..options.repeat {
        for measure in Measure::value_variants() {
            if !options.only.is_empty() && !options.only.contains(measure) {
                continue;
            }
            for case in cases(*measure, options) {
                for (at, program) in options.programs.iter().enumerate() {
                    let mut run = Run::new(&mut table, at, round);
                    case.measure(&rig, program, options.quick, &mut run)
                        .map_err(|error| format!("{}: {case:?}: {error}", program.name))?;
                    eprintln!("{} {}: {}", round + 1, program.name, run.summary());
                }
            }
        }
    }
    if let Some(file) = &options.csv {
        table.write_csv(file).map_err(|error| format!("{}: {error}", file.display()))?;
    }
    print!("{}", table.render(options.markdown));
    Ok(())
}

/// One line of the table, measured in a program that is started for it.
#[derive(Debug)]
enum Case {
    Floor,
    Steps { rate_khz: u32, steppers: usize, transfers: bool },
    RoundTrip,
    Spi,
    Commands { realtime: bool },
    Interval { steppers: usize, realtime: bool },
    Idle,
    Memory,
}

fn cases(measure: Measure, options: &Options) -> Vec<Case> {
    let steps = |transfers| {
        let case = move |steppers, rate_khz| Case::Steps { rate_khz, steppers, transfers };
        STEPPERS.iter().flat_map(|s| options.rates.iter().map(move |rate| case(*s, *rate))).collect()
    };
    match measure {
        Measure::Lateness => iter::once(Case::Floor).chain(steps(false)).collect(),
        Measure::Transfers => steps(true),
        Measure::Roundtrip => vec![Case::RoundTrip],
        Measure::Spi => vec![Case::Spi],
        Measure::Commands => vec![Case::Commands { realtime: false }, Case::Commands { realtime: true }],
        Measure::Interval => [true, false]
            .into_iter()
            .flat_map(|realtime| STEPPERS.map(|steppers| Case::Interval { steppers, realtime }))
            .collect(),
        Measure::Idle => vec![Case::Idle],
        Measure::Memory => vec![Case::Memory],
    }
}

fn plural(steppers: usize) -> String {
    format!("{steppers} stepper{}", if steppers == 1 { "" } else { "s" })
}

impl Case {
    fn measure(&self, rig: &Rig, program: &Program, quick: bool, run: &mut Run<'_>) -> Result<(), String> {
        let seconds = if quick { 3.0 } else { 10.0 };
        let realtime = Launch { realtime: true, ..Launch::default() };
        let mut quantiles = |group: &str, case: &str, late: &dyn Fn(f64) -> f64| {
            for (name, share) in [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0)] {
                run.add(group, case, name, "us", late(share));
            }
        };
        match *self {
            Case::Floor => {
                let late_ns = rig.floor_ns(seconds)?;
                let group = "Lateness of a loop that only waits, measured before each program";
                quantiles(group, "50 k/s", &|share| table::quantile(&late_ns, share) as f64 / 1e3);
            }
            Case::Steps { rate_khz, steppers, transfers } => {
                let load = Load::steady(rate_khz * 1_000, steppers, transfers, seconds);
                let outcome = steps::run(rig, program, &load)?;
                let case = format!("{rate_khz} k/s, {}", plural(steppers));
                let beside = if transfers { " beside 4 ms SPI transfers" } else { "" };
                let group = format!("Lateness of step edges{beside}");
                quantiles(&group, &case, &|share| outcome.late_us(share));
                if let Some(reason) = &outcome.shutdown {
                    run.note(&group, &case, &format!("stopped after {:.1} s: {reason}", outcome.lasted_s));
                } else if !transfers {
                    run.add("CPU time a step", &case, "", "us", outcome.cpu_us_per_step);
                }
                run.others(outcome.others);
            }
            Case::RoundTrip => {
                let running = rig.start(program, &realtime)?;
                for command in ["get_clock", "get_uptime"] {
                    let times = talk::round_trips(&running, (command, &[]), if quick { 1_000 } else { 5_000 })?;
                    for (name, share) in [("p50", 0.5), ("p99", 0.99)] {
                        run.add("Round trip", command, name, "us", table::quantile(&times, share) as f64 / 1e3);
                    }
                }
            }
            Case::Spi => {
                let running = rig.start(program, &Launch { bus_us: SHORT_US, ..realtime })?;
                drop(steps::configured(&running, &Load::steady(1_000, 3, true, 0.0))?);
                let args = [("oid", steps::SPI_OID.into()), ("data", Arg::Bytes(&[0x5a]))];
                let count = if quick { 1_000 } else { 5_000 };
                let before = process::cpu(running.pid());
                let each = talk::each_alone(&running, ("spi_send", &args), count)?;
                let cpu = process::cpu(running.pid()).saturating_sub(before).div_f64(count as f64);
                let case = format!("{count} spi_send of 30 us, one a block");
                for (name, share) in [("p50", 0.5), ("p90", 0.9)] {
                    let us = table::quantile(&each, share) as f64 / 1e3;
                    run.add("Time for each SPI transfer, means of 100", &case, name, "us", us);
                }
                run.add("CPU time for each SPI transfer", &case, "", "us", cpu.as_secs_f64() * 1e6);
                let times = talk::round_trips(&running, ("spi_transfer", &args), count)?;
                for (name, share) in [("p50", 0.5), ("p99", 0.99)] {
                    let us = table::quantile(&times, share) as f64 / 1e3;
                    run.add("Round trip", "spi_transfer of 30 us", name, "us", us);
                }
            }
            Case::Commands { realtime } => {
                let running = rig.start(program, &Launch { realtime, ..Launch::default() })?;
                let rate = talk::commands_a_second(&running, Duration::from_secs_f64(seconds / 3.0))?;
                let case = if realtime { "debug_nop, -r" } else { "debug_nop" };
                run.add("Commands a second", case, "", "million", rate / 1e6);
            }
            Case::Interval { steppers, realtime } => {
                let smallest = steps::smallest_interval(rig, program, steppers, realtime, seconds)?;
                let mode = if realtime { ", -r" } else { "" };
                let case = format!("{}{mode}", plural(steppers));
                let group = "Smallest step interval that survives";
                run.add(group, &case, "", "ticks", smallest.ticks.map_or(f64::INFINITY, f64::from));
                run.note(group, &case, &format!("below it: {}", smallest.below));
            }
            Case::Idle => {
                let running = rig.start(program, &realtime)?;
                let _client = steps::configured(&running, &Load::steady(1_000, 3, false, 0.0))?;
                std::thread::sleep(Duration::from_secs(1));
                let before = process::cpu(running.pid());
                std::thread::sleep(Duration::from_secs_f64(seconds));
                let used = process::cpu(running.pid()).saturating_sub(before);
                run.add("CPU when idle", "3 steppers, silent host", "", "us/s", used.as_secs_f64() * 1e6 / seconds);
            }
            Case::Memory => {
                let running = rig.start(program, &realtime)?;
                let _client = steps::configured(&running, &Load::steady(1_000, 3, false, 0.0))?;
                std::thread::sleep(Duration::from_secs(1));
                for (name, memory) in process::memory(running.pid())?.each() {
                    run.add("Memory", name, "resident", "MiB", memory.resident_kib as f64 / 1024.0);
                    run.add("Memory", name, "private", "MiB", memory.private_kib as f64 / 1024.0);
                }
            }
        }
        Ok(())
    }
}
