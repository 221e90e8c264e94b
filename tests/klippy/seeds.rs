// SPDX-License-Identifier: GPL-3.0-or-later
//! Records klippy's own bytes as seeds for the fuzz targets (docs/develop/fuzzing.md).

use std::fs;
use std::path::Path;

use super::checkout;
use super::klippy::batch;
use super::sections::pinion;

/// Longest seed of raw bytes: the configuration and some moves.
const BYTES_MAX: usize = 6000;
/// The steps of the target `link` (crates/runtime/tests/support/link_fuzz.rs): 31 raw bytes, the host reads, the core begins a block,
/// responds, and finishes.
const STEPS: [u8; 5] = [31 << 3, 3, 4, 5 | 5 << 3, 6];

#[test]
#[ignore = "writes files into fuzz/seeds"]
fn seeds_of_the_fuzz_targets() {
    let Some(checkout) = checkout("seeds_of_the_fuzz_targets") else { return };
    let folder = tempfile::tempdir().unwrap();
    let dictionary = folder.path().join("dict");
    fs::write(&dictionary, pinion(&["dict", "--board", "sim", "--dialect", "master"])).unwrap();
    let config = String::from_utf8(pinion(&["sim", "--print-config"])).unwrap();
    let mut sent = batch(&checkout, &dictionary, &config, "G28\nG1 X20 Y20 F6000\n").unwrap();
    sent.truncate(BYTES_MAX);
    let write = |target: &str, seed: &[u8]| {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds").join(target);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("klippy"), seed).unwrap();
    };
    // The first byte says how the stream is cut.
    write("blocks", &[&[64], &*sent].concat());
    let [raw, rest @ ..] = STEPS;
    let steps: Vec<u8> = sent.chunks_exact(31).flat_map(|piece| [&[raw], piece, &rest].concat()).collect();
    write("link", &steps);
}
