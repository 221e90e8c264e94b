// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add --undo`: takes all changes of a device back.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde_json::json;

use crate::cli::computer::Computer;

use super::catalog::{Catalog, Device};
use super::moonraker::Moonraker;
use super::printer::Printer;
use super::report::Report;
use super::{AddArgs, BUS, MOONRAKER, ask, bus, host, refuse_while_printing, system};

/// Takes all changes of a device back.
pub(super) fn undo(
    args: &AddArgs,
    computer: &Computer,
    catalog: &Catalog,
    device: &Device,
    report: &mut Report,
) -> Result<(), String> {
    let mut sides = vec![system(computer)];
    let mut in_use = BTreeMap::new();
    match Printer::find(computer, args.config.as_deref()) {
        Ok(printer) => {
            sides.push(host(computer, &printer));
            if let Some(board) = catalog.board(computer) {
                in_use = bus::in_use(board, &printer, device);
            }
        }
        Err(why) if args.config.is_some() => return Err(why),
        Err(why) => report.line(why),
    }
    // The needs of a device are on both sides, and a bus that it needs is on root's.
    let mut heirs = Vec::new();
    for other in catalog.devices.iter().filter(|other| other.name != device.name) {
        let mut needs = BTreeSet::new();
        for side in &sides {
            needs.extend(side.record(other.name)?.unwrap_or_default().needs);
        }
        heirs.push((other.name, needs));
    }
    let mut records = Vec::new();
    for side in sides {
        if let Some(record) = side.record(device.name)? {
            records.push((side, record));
        }
    }
    if records.is_empty() {
        report.line(format_args!("{}: nothing was added, so nothing is changed", device.name));
        return Ok(());
    }
    refuse_while_printing(args, computer)?;
    report.line("These files are put back:");
    let files: BTreeSet<&Path> =
        records.iter().flat_map(|(_, record)| &record.changes).map(|change| change.file.as_path()).collect();
    files.iter().for_each(|file| report.line(format_args!("  {}", file.display())));
    report.set("changes", json!(files));
    ask(args, computer, report, "Put them back?")?;
    let mut reboots = false;
    let mut left = Vec::new();
    for (side, record) in &records {
        reboots |= record.changes.iter().any(|change| change.key.starts_with(BUS));
        left.extend(side.undo(device.name, &heirs, &in_use)?);
    }
    left.iter().for_each(|line| report.line(line));
    report.set("left", json!(left));
    report.set("reboot", json!(reboots));
    if reboots {
        report.line("The bus is off after a reboot, unless another device needs it.");
    }
    if computer.is_this() || args.moonraker != MOONRAKER {
        let restarted = Moonraker(&args.moonraker).restart();
        report.set("warning", json!(restarted.as_ref().err()));
        report.line(match restarted {
            Ok(()) => "The host has restarted without it.".to_owned(),
            Err(why) => format!("{why}: run FIRMWARE_RESTART in the host"),
        });
    }
    Ok(())
}
