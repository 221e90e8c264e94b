// SPDX-License-Identifier: GPL-3.0-or-later
//! Tests that take long, because heaters, motors and silence of the real program take their real time. They are ignored:
//! `make test-slow` runs them, and so does `make test-all`.

pub mod cut;
mod demonstration;
