// SPDX-License-Identifier: GPL-3.0-or-later
//! The fuzz targets, in one program. `PINION_FUZZ_TARGET` chooses the target. Without it the program prints their names.
//! docs/develop/fuzzing.md describes them.
#![no_main]

mod blocks;
mod dictionary;
mod printer;
mod printer_cfg;
mod printer_config;
mod status;
mod trace;

use std::cell::Cell;
use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use pinion_model::{SimBoard, SimConfig};
use pinion_system::config::read;
use pinion_testbench::memory::Counting;
use pinion_testbench::trial;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

type Target = (&'static str, fn(&[u8]));

const TARGETS: &[Target] = &[
    ("blocks", blocks::run),
    ("commands", commands),
    ("config", config),
    ("dictionary", dictionary::run),
    ("guardian", pinion_runtime::fuzz::guardian),
    ("link", link),
    ("printer", printer::run),
    ("printer_cfg", printer_cfg::run),
    ("printer_config", printer_config::run),
    ("search", pinion_runtime::fuzz::search),
    ("sources", pinion_runtime::klippy::sources::fuzz::sources),
    ("status", status::run),
    ("trace", trace::run),
];

/// Any commands to an MCU in virtual time, for hosts of each dialect.
fn commands(bytes: &[u8]) {
    trial::play(bytes);
}

/// Any bytes as the configuration of `pinion run`. An error is one that a person can read.
fn config(bytes: &[u8]) {
    if let Err(trouble) = read(bytes, &"f.toml") {
        assert!(trouble.to_string().starts_with("f.toml:"), "{trouble}");
    }
}

/// The link between any host and any core.
fn link(bytes: &[u8]) {
    let board = |clock| SimBoard::new(SimConfig::default_printer(), clock).expect("the built-in printer");
    pinion_runtime::fuzz::link(bytes, |clock| Box::new(board(clock)));
}

static TARGET: OnceLock<fn(&[u8])> = OnceLock::new();

fuzz_target!(init: choose(), |bytes: &[u8]| {
    FED.with(|fed| {
        fed.runs.set(fed.runs.get() + 1);
        fed.bytes.set(fed.bytes.get() + bytes.len() as u64);
    });
    if let Some(run) = TARGET.get() {
        run(bytes);
    }
});

fn choose() {
    let name = std::env::var("PINION_FUZZ_TARGET").unwrap_or_default();
    match TARGETS.iter().find(|(target, _)| *target == name) {
        Some((_, run)) => _ = TARGET.set(*run),
        None => {
            TARGETS.iter().for_each(|(target, _)| println!("{target}"));
            std::process::exit(i32::from(!name.is_empty()));
        }
    }
}

/// How much the target was fed. It is printed when the process exits in order.
#[derive(Default)]
struct Fed {
    runs: Cell<u64>,
    bytes: Cell<u64>,
}

impl Drop for Fed {
    fn drop(&mut self) {
        eprintln!("fed: {} runs, {} bytes", self.runs.get(), self.bytes.get());
    }
}

thread_local! {
    static FED: Fed = Fed::default();
}
