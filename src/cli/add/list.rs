// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add` without a device: what can be added here.

use serde_json::{Value, json};

use crate::cli::page::aligned;

use super::board::KnownBoard;
use super::catalog::{Catalog, Device};
use super::report::Report;

/// Lists the devices.
pub(super) fn list(
    catalog: &Catalog,
    board: Option<&KnownBoard>,
    model: &str,
    report: &mut Report,
) -> Result<(), String> {
    let fits = |device: &Device| board.is_some_and(|board| device.way.iter().any(|way| board.has(way)));
    let buses = |device: &Device| {
        let names: Vec<&str> = device.way.iter().map(|way| way.bus.name()).collect();
        names.join(" or ")
    };
    let entries = catalog.devices.iter().map(
        |device| json!({ "name": device.name, "title": device.title, "buses": buses(device), "fits": fits(device) }),
    );
    report.set("devices", Value::Array(entries.collect()));
    match board {
        Some(board) => report.line(format_args!("This is a {} ({model}). You can add:", board.name)),
        None => {
            report.line(unknown_board(model));
            report.line("On a known board you can add:");
        }
    }
    let rows: Vec<Vec<String>> = catalog
        .devices
        .iter()
        .filter(|device| board.is_none() || fits(device))
        .map(|device| vec![format!("  {}", device.name), device.title.clone(), buses(device)])
        .collect();
    aligned(&rows).iter().for_each(|row| report.line(row));
    report.line("");
    report.line("sudo pinion add DEVICE connects one. With --dry-run it only shows what it would do.");
    Ok(())
}

pub(super) fn unknown_board(model: &str) -> String {
    let this = if model.is_empty() { "this computer (it has no device tree)" } else { model };
    format!(
        "{this} is not among the known boards: look up in its manual which pins have SPI (MOSI, MISO, SCLK, CS) or I2C \
         (SDA, SCL) and which overlay enables them, then see docs/guide/pins.md"
    )
}

pub(super) fn unknown_device(catalog: &Catalog, name: &str) -> String {
    let near = catalog.devices.iter().map(|device| (strsim::damerau_levenshtein(device.name, name), device.name)).min();
    match near.filter(|(distance, _)| *distance <= 2) {
        Some((_, near)) => format!("there is no device \"{name}\": did you mean {near}?"),
        None => format!("there is no device \"{name}\": pinion add lists them"),
    }
}
