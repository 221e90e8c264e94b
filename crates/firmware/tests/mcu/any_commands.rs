// SPDX-License-Identifier: GPL-3.0-or-later
//! No commands from a host can break the MCU. Its outputs are at their shutdown values when it stops.

use std::sync::Mutex;

use pinion_testbench::memory::Counting;
use pinion_testbench::trial::{self, Tally};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn arguments_are_found_for_every_command() {
    assert_eq!(trial::commands_without_arguments(), [""; 0]);
}

#[test]
fn no_commands_break_the_mcu() {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(100);
    let config = ProptestConfig { cases, source_file: Some(file!()), ..ProptestConfig::default() };
    let tally = Mutex::new(Tally::default());
    let done = TestRunner::new(config).run(&vec(any::<u8>(), 3..1000), |bytes| {
        let played = trial::play(&bytes);
        *tally.lock().unwrap() += played;
        Ok(())
    });
    let tally = tally.into_inner().unwrap();
    println!("{tally:?}");
    done.unwrap();
    assert!(tally.accepted * 2 > tally.sent && tally.outputs > 0 && tally.frugal > 0, "{tally:?}");
}
