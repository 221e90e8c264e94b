// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion pins --used`: who uses what, and where that is written.

use std::io::Write as _;
use std::process::ExitCode;

use pinion_linux::Inventory;

use super::PinsArgs;
use crate::add::{Wire, picture};
use crate::failed;
use crate::page::{Page, aligned, print};
use pinion_system::Computer;
use pinion_system::board::{Board, Kind};
use pinion_system::files::Output;
use pinion_system::uses::{Resource, Use, Uses};

/// Longest name of a user beside the header.
const NAME_MAX: usize = 40;

/// Prints all users.
pub(super) fn run(args: &PinsArgs) -> ExitCode {
    shown(args).map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn shown(args: &PinsArgs) -> Result<(), String> {
    let (computer, board) = Computer::named(&args.root, args.board.as_deref())?;
    let inventory = computer.is_this().then(Inventory::scan);
    let mut uses = Uses::find(&computer, board.as_ref(), None, inventory.as_ref());
    if let Some(filter) = &args.filter {
        let filter = filter.to_lowercase();
        uses.all.retain(|one| format!("{} {} {}", one.what, one.user, one.place).to_lowercase().contains(&filter));
    }
    if let (Some(path), Some(board)) = (&args.picture, &board) {
        let svg = picture::svg(board, "Users of the header", &wires(&uses, board));
        Output::check(path, &[])?.write(|out| out.write_all(svg.as_bytes()))?;
    }
    match args.json {
        true => print(&Page::json(&format!("{:#}\n", uses.json()))),
        false => print(&page(&uses)),
    }
}

/// The users of the header's pins. A pin may have several.
fn wires(uses: &Uses, board: &Board) -> Vec<Wire> {
    let wire = |pin: usize| {
        let line = Resource::Line(uses.names.of_pin(board, pin)?);
        let mut users: Vec<&str> = uses.of(&line).map(|one| one.user.as_str()).collect();
        users.dedup();
        let chip: String = users.join(", ").chars().take(NAME_MAX).collect();
        (!users.is_empty()).then(|| Wire { chip, role: Kind::Line.name().to_owned(), pin })
    };
    (1..=board.pins.len()).filter_map(wire).collect()
}

fn page(uses: &Uses) -> Page {
    let mut page = Page::default();
    if uses.all.is_empty() {
        page.line("Nothing is used, as far as the kernel, the boot files, printer.cfg and Moonraker say.");
        return page;
    }
    let pin = |one: &Use| match (&one.what, &uses.board) {
        (Resource::Line(line), Some(board)) => {
            uses.names.pin(board, line).map_or(String::new(), |pin| format!("pin {pin}"))
        }
        _ => String::new(),
    };
    let row = |one: &Use| vec![one.what.to_string(), pin(one), one.user.clone(), one.place.clone()];
    let mut rows = vec![["what", "where", "user", "source"].map(str::to_owned).to_vec()];
    rows.extend(uses.sorted().map(row));
    aligned(&rows).iter().for_each(|line| page.line(line));
    if let Some(board) = &uses.board {
        page.line("");
        page.append(&picture::header(board, &wires(uses, board)));
    }
    page
}
