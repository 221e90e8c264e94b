// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor --klipper DIR`: whether this Pinion serves the host of a checkout.

use std::collections::BTreeSet;
use std::path::Path;

use crate::cli::finding::Finding;
use crate::cli::page::Page;
use pinion_firmware::feature::FEATURES;
use pinion_runtime::klippy::sources::Shape;
use pinion_runtime::klippy::{Checkout, DialectFit};

use super::UPGRADE;

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

/// The verdict in a line.
pub(super) fn finding(checkout: &Checkout) -> Finding {
    const CHECK: &str = "checkout";
    let host = format!("{} is served in the dialect {}", checkout.folder.display(), checkout.best().dialect);
    match checkout.unknown().count() {
        0 => Finding::ok(CHECK, host),
        forms => Finding::error(
            CHECK,
            format!("{host}, and looks up {forms} forms of messages that no dialect has"),
            format!("before the host is restarted, {UPGRADE}"),
        ),
    }
}

/// The report: each dialect, the forms in which they differ, the verdict.
pub(super) fn report(checkout: &Checkout, page: &mut Page) {
    let best = checkout.best();
    let all: BTreeSet<&Shape> = best.served.union(&best.other).collect();
    let commit = checkout.commit.as_ref().map_or(String::new(), |commit| format!(", commit {commit}"));
    page.line(format_args!("{}{commit}", checkout.folder.display()));
    page.line(format_args!(
        "This host looks up {} forms of messages that Pinion knows by name. Each dialect has of them:",
        all.len()
    ));
    page.line("");
    for fit in &checkout.fits {
        let mark = if fit.dialect == best.dialect { "  <- the one that it is served" } else { "" };
        page.line(format_args!("  {:<8}{:>4}{mark}", fit.dialect.name(), fit.served.len()));
    }
    if let Some(unread) = &checkout.unread {
        page.line("");
        page.line(format_args!("Not all of it can be read, and what is left out here does not count: {unread}"));
    }
    let differing: Vec<&Shape> =
        all.into_iter().filter(|shape| checkout.fits.iter().any(|fit| fit.other.contains(shape))).collect();
    if !differing.is_empty() {
        let columns = |of: &dyn Fn(&DialectFit) -> &'static str| -> String {
            checkout.fits.iter().map(|fit| format!("{:<8}", of(fit))).collect()
        };
        page.append(&Page::text("\nNot every dialect has these forms:\n\n"));
        page.line(format_args!("  {}", columns(&|fit| fit.dialect.name())));
        for shape in differing {
            let has = columns(&|fit| if fit.served.contains(shape) { "yes" } else { "-" });
            page.line(format_args!("  {has}{}", shape.as_str()));
        }
    }
    let unknown: Vec<&Shape> = checkout.unknown().collect();
    page.line("");
    if unknown.is_empty() {
        let other = match best.other.len() {
            0 => ", which has all that it looks up".to_owned(),
            other => format!(
                "; of the forms above it looks up {other} for other micro-controllers' sake, as its own firmware for \
                 Linux has no more than the dialect"
            ),
        };
        page.line(format_args!("ok: this host is served in the dialect {}{other}", best.dialect));
    } else {
        page.line(
            "warning: this host is newer than Pinion. No dialect has these forms, and what needs them will not work:",
        );
        page.line("");
        unknown.iter().for_each(|shape| page.line(format_args!("  {}", shape.as_str())));
        page.line("");
        page.line(format_args!(
            "It would be served in the dialect {}. Update Pinion first (apt upgrade), or stay with the host's version.",
            best.dialect
        ));
    }
}
