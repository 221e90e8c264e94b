// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor --klipper DIR`: whether this Pinion serves the host of a checkout.

use std::collections::BTreeMap;
use std::path::Path;

use crate::page::Page;
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::Forms;
use pinion_runtime::klippy::{Checkout, Missing, parts_without};
use pinion_system::finding::Finding;

use super::UPGRADE;

/// Highest number of missing messages that the report names for a part of the printer.
const SHOWN: usize = 20;

/// Reads a checkout. `folder` is the checkout, or klippy's folder in it.
pub(super) fn read(folder: &Path) -> Result<Checkout, String> {
    let inside = folder.join("klippy");
    let klippy = if inside.join("klippy.py").exists() { inside } else { folder.to_owned() };
    Checkout::read(&klippy, FEATURES).map_err(|error| {
        format!(
            "{}: {error}: name a checkout of Klipper or Kalico that you may read, such as ~/klipper",
            folder.display()
        )
    })
}

/// The messages that the host of a checkout looks up and does not get from a Pinion that reads its sources.
pub(super) fn missing(checkout: &Checkout) -> Vec<Missing<'_>> {
    checkout.missing(&Forms::Host(checkout.forms.clone()), FEATURES)
}

/// The verdict in a line.
pub(super) fn finding(checkout: &Checkout) -> Finding {
    const CHECK: &str = "checkout";
    let host = format!("the host of {}", checkout.folder.display());
    let missing = missing(checkout);
    match missing.len() {
        0 => Finding::ok(CHECK, format!("{host} gets each message that it looks up")),
        count => Finding::error(
            CHECK,
            format!("{host} does not get {count} messages that it looks up{}", for_parts(&missing)),
            format!("before the host is restarted, {UPGRADE}"),
        ),
    }
}

/// The parts of the printer that these messages serve, as an addition to a sentence.
pub(super) fn for_parts(missing: &[Missing<'_>]) -> String {
    let parts = parts_without(missing);
    if parts.is_empty() { String::new() } else { format!(", for {parts}") }
}

/// The report: the messages that the host does not get, by part of the printer, and the verdict.
pub(super) fn report(checkout: &Checkout, page: &mut Page) {
    let commit = checkout.commit.as_ref().map_or(String::new(), |commit| format!(", commit {commit}"));
    page.line(format_args!("{}{commit}", checkout.folder.display()));
    page.line(format_args!("This host looks up {} forms of messages.", checkout.shapes.len()));
    page.line("");
    if let Some(unread) = &checkout.unread {
        page.line(format_args!("Some of the host's sources cannot be read, and their messages do not count: {unread}"));
        page.line("");
    }
    let missing = missing(checkout);
    if missing.is_empty() {
        page.line("ok: this host gets each message that it looks up, in a form that it looks up");
        return;
    }
    page.line("warning: this host looks up messages that Pinion does not have in this form. These parts do not work:");
    let mut by_part: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for Missing { shape, serves } in &missing {
        by_part.entry(serves).or_default().push(shape.as_str());
    }
    for (part, shapes) in by_part {
        page.line("");
        page.line(format_args!("  {}", if part.is_empty() { "parts that are new in this host" } else { part }));
        shapes.iter().take(SHOWN).for_each(|shape| page.line(format_args!("    {shape}")));
        if shapes.len() > SHOWN {
            page.line(format_args!("    and {} more", shapes.len() - SHOWN));
        }
    }
    page.line("");
    page.line("Update Pinion first (apt upgrade), or stay with the host's version.");
}
