// SPDX-License-Identifier: GPL-3.0-or-later
//! The output of `pinion add`.

use std::fmt::Display;

use serde_json::{Value, json};

use crate::page::{Page, print};

/// The output: lines for people as they come, or one JSON document at the end.
#[derive(Default)]
pub(super) struct Report {
    pub(super) json: bool,
    pub(super) values: serde_json::Map<String, Value>,
    pub(super) page: Page,
    /// The files that this call has changed.
    pub(super) changed: Vec<String>,
}

impl Report {
    pub(super) fn line(&mut self, line: impl Display) {
        self.page.line(line);
    }

    pub(super) fn set(&mut self, key: &str, value: Value) {
        self.values.insert(key.to_owned(), value);
    }

    /// Shows what was said until now.
    pub(super) fn show(&mut self) -> Result<(), String> {
        let page = std::mem::take(&mut self.page);
        if self.json { Ok(()) } else { print(&page) }
    }

    pub(super) fn print(&mut self, error: Option<&String>) -> Result<(), String> {
        if !self.json {
            return self.show();
        }
        self.set("error", json!(error));
        print(&Page::json(&format!("{:#}\n", Value::Object(std::mem::take(&mut self.values)))))
    }
}
