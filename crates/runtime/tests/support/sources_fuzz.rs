// SPDX-License-Identifier: GPL-3.0-or-later
//! Any bytes as a source of klippy, for `fuzz/`.

use super::*;

/// Each shape is one that its own text makes.
pub fn sources(bytes: &[u8]) {
    strings(bytes, |string| {
        if let Some(shape) = Shape::of(string) {
            let format: Vec<String> = shape.0.split(' ').skip(1).map(|name| format!("{name}=%u")).collect();
            assert_eq!(Shape::of(&format!("{} {}", shape.name(), format.join(" "))), Some(shape));
        }
    });
}
