// SPDX-License-Identifier: GPL-3.0-or-later
//! The features of docs/develop/add-a-feature.md, which shows parts of these files. Only tests compile them.

use crate::mcu::{Feature, place_of_response};

mod bell;
mod ear;

const FEATURES: &[Feature] = &[bell::FEATURE, ear::FEATURE];

const fn response_index(format: &str) -> usize {
    place_of_response(FEATURES, format)
}

#[test]
fn each_message_of_the_example_is_listed() {
    let responses: Vec<_> = FEATURES.iter().flat_map(|feature| feature.responses).map(|form| form.format).collect();
    assert_eq!(responses, ["bell_rung oid=%c clock=%u", "ear_heard oid=%c loudness=%c"]);
    assert_eq!(FEATURES.iter().map(|feature| feature.commands.len()).sum::<usize>(), 4);
}
