// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add` without a device: what can be added here.

use std::path::PathBuf;

use serde_json::{Value, json};

use crate::page::aligned;
use pinion_system::board::{Board, NAMES};

use super::PINS;
use super::catalog::{Catalog, Device};
use super::report::Report;

/// Lists the devices.
pub(super) fn list(
    catalog: &Catalog,
    board: Option<&Board>,
    model: &str,
    lacks: &dyn Fn(&Device) -> Option<PathBuf>,
    report: &mut Report,
) -> Result<(), String> {
    let fits = |device: &Device| board.is_some_and(|board| device.way.iter().any(|way| way.fits(board)));
    let buses = |device: &Device| {
        let ways = device.way.iter().filter(|way| board.is_none_or(|board| way.fits(board)));
        ways.map(|way| way.bus.name()).collect::<Vec<_>>().join(" or ")
    };
    let host = |device: &Device| lacks(device).map_or("", |_| "not in your version of the host");
    let entries = catalog.devices.iter().map(|device| {
        let is_in_host = host(device).is_empty();
        json!({ "name": device.name, "title": device.title, "buses": buses(device), "fits": fits(device),
            "in_host": is_in_host })
    });
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
        .map(|device| vec![format!("  {}", device.name), device.title.clone(), buses(device), host(device).to_owned()])
        .collect();
    aligned(&rows).iter().for_each(|row| report.line(row));
    report.line("");
    report.line("sudo pinion add DEVICE connects one. With --dry-run it only shows what it would do.");
    Ok(())
}

pub(super) fn unknown_board(model: &str) -> String {
    let this = match model {
        "" => "this computer has no device tree, so its board is not known".to_owned(),
        model if model.contains("Compute Module") => {
            format!("the pins of a {model} are where its carrier board has them, so its header is not known")
        }
        model => format!("{model} is not among the known boards"),
    };
    format!(
        "{this}: name it with --board ({}) if it has the header of one of them. Or look up in its manual which pins have SPI \
         (MOSI, MISO, SCLK, CS) or I2C (SDA, SCL) and which overlay enables them, then see {PINS}",
        NAMES.join(", ")
    )
}
