// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor`: what works and what does not, and what mends it.

#![forbid(unsafe_code)]

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;

use crate::feature::FEATURES;
use crate::klippy::Checkout;
use crate::klippy::sources::Shape;

use super::{failed, print};

/// Options of `pinion doctor`.
#[derive(Args, Clone, Debug)]
pub(super) struct DoctorArgs {
    /// A checkout of Klipper or Kalico: whether this Pinion serves that host, before you restart it
    #[arg(long, value_name = "DIR")]
    klipper: PathBuf,
}

/// Prints what was found; fails if something needs to be mended.
pub(super) fn run(args: &DoctorArgs) -> ExitCode {
    let checkout = match read(&args.klipper) {
        Ok(checkout) => checkout,
        Err(error) => return failed(error),
    };
    if let Err(error) = print(&report(&checkout)) {
        return failed(error);
    }
    if checkout.unknown().count() == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Reads a checkout, named by itself or by klippy's folder in it.
fn read(folder: &Path) -> Result<Checkout, String> {
    let inside = folder.join("klippy");
    let klippy = if inside.join("klippy.py").exists() { inside } else { folder.to_owned() };
    Checkout::read(&klippy, FEATURES).map_err(|error| {
        format!(
            "{}: {error}: name a checkout of Klipper or Kalico that you may read, such as ~/klipper",
            folder.display()
        )
    })
}

/// The report: each dialect, the forms in which they differ, the verdict.
fn report(checkout: &Checkout) -> String {
    let best = checkout.best();
    let all: BTreeSet<&Shape> = best.served.union(&best.other).collect();
    let commit = checkout.commit.as_ref().map_or(String::new(), |commit| format!(", commit {commit}"));
    let mut text = format!(
        "{}{commit}\nThis host looks up {} forms of messages that Pinion knows by name. Each dialect has of them:\n\n",
        checkout.folder.display(),
        all.len()
    );
    // Writing to a String does not fail.
    for verdict in &checkout.verdicts {
        let mark = if verdict.generation == best.generation { "  <- the one that it is served" } else { "" };
        let _ = writeln!(text, "  {:<8}{:>4}{mark}", verdict.generation.name(), verdict.served.len());
    }
    if let Some(unread) = &checkout.unread {
        let _ = writeln!(text, "\nNot all of it can be read, and what is left out here does not count: {unread}");
    }
    let differing: Vec<&Shape> =
        all.into_iter().filter(|shape| checkout.verdicts.iter().any(|verdict| verdict.other.contains(shape))).collect();
    if !differing.is_empty() {
        text += "\nNot every dialect has these forms:\n\n  ";
        for verdict in &checkout.verdicts {
            let _ = write!(text, "{:<8}", verdict.generation.name());
        }
        text += "\n";
        for shape in differing {
            text += "  ";
            for verdict in &checkout.verdicts {
                let _ = write!(text, "{:<8}", if verdict.served.contains(shape) { "yes" } else { "-" });
            }
            let _ = writeln!(text, "{}", shape.as_str());
        }
    }
    let unknown: Vec<&Shape> = checkout.unknown().collect();
    if unknown.is_empty() {
        let other = best.other.len();
        let _ = writeln!(
            text,
            "\nok: this host is served in the dialect {}{}",
            best.generation,
            match other {
                0 => ", which has all that it looks up".to_owned(),
                _ => format!(
                    "; of the forms above it looks up {other} for other micro-controllers' sake, as its own \
                     firmware for Linux has no more than the dialect"
                ),
            }
        );
    } else {
        text += "\nwarning: this host is newer than Pinion. No dialect has these forms, and what needs them will not work:\n\n";
        for shape in unknown {
            let _ = writeln!(text, "  {}", shape.as_str());
        }
        let _ = writeln!(
            text,
            "\nIt would be served in the dialect {}. Update Pinion first (apt upgrade), or stay with the host's version.",
            best.generation
        );
    }
    text
}
