// SPDX-License-Identifier: GPL-3.0-or-later
//! Shared by the fuzz targets. docs/develop/fuzzing.md describes them.

use std::cell::Cell;

pub use libfuzzer_sys::fuzz_target;

/// How much a target was fed. It is printed when the process exits in order.
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

/// Counts an input.
pub fn feed(bytes: &[u8]) {
    FED.with(|fed| {
        fed.runs.set(fed.runs.get() + 1);
        fed.bytes.set(fed.bytes.get() + bytes.len() as u64);
    });
}

/// Makes a program that feeds bytes to a function.
#[macro_export]
macro_rules! target {
    ($run:path) => {
        $crate::fuzz_target!(|bytes: &[u8]| {
            $crate::feed(bytes);
            $run(bytes);
        });
    };
}
