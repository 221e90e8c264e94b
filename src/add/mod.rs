// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add`: from wires to a working device.
//!
//! It finds out the board, draws the wires, enables the bus, asks the chip, writes the sections of printer.cfg, has klippy
//! restart, and measures. A call that ends at a reboot or at a wrong wire goes on when it is repeated: each step first
//! checks if it is done.

use std::io::{self, BufRead as _, IsTerminal as _};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, ValueHint};
use nix::unistd::geteuid;
use serde_json::{Value, json};

use super::failed;
use pinion_linux::Inventory;
use pinion_linux::foreign::word;
use pinion_runtime::klippy::process::Process;
use pinion_system::Computer;
use pinion_system::board::{self, Board, Kind, Slot};
use pinion_system::complete::offering;
use pinion_system::uses::{Resource, Source, Uses};

mod beside;
mod boot;
mod catalog;
mod check;
mod edit;
mod list;
mod measure;
mod missing;
mod moonraker;
pub(super) mod picture;
mod place;
mod plan;
mod printer;
mod probe;
mod report;
mod undo;
mod work;

use catalog::{Catalog, Device, Wiring};
use edit::{Edit, Editor};
pub(super) use missing::missing;
use moonraker::{Host, Moonraker};
use place::Search;
pub(super) use place::Wire;
use printer::Target;
use report::Report;
use work::Work;

/// The buses that a user may choose between.
const BUSES: &[&str] = &["spi", "i2c"];

/// Options of `pinion add`.
#[derive(Args, Clone, Debug)]
pub(super) struct AddArgs {
    /// The device. Without it, list what can be added here
    #[arg(value_name = "DEVICE", value_parser = offering::<String>(&catalog::NAMES), hide_possible_values = true)]
    device: Option<String>,
    /// Give it this name, for a second device of the kind
    #[arg(long, value_name = "NAME", requires = "device", value_hint = ValueHint::Other)]
    name: Option<String>,
    /// Connect it in this way, if the device has several: spi or i2c
    #[arg(long, value_name = "BUS", value_parser = offering::<String>(BUSES), hide_possible_values = true)]
    bus: Option<String>,
    /// Use this pin of the header, such as 11 or GPIO17, for the device's line
    #[arg(long, value_name = "PIN", value_hint = ValueHint::Other)]
    pin: Option<String>,
    /// Write a picture of the wires to this SVG file
    #[arg(long, value_name = "FILE", requires = "device", conflicts_with = "undo", value_hint = ValueHint::FilePath)]
    picture: Option<PathBuf>,
    /// The host's configuration [default: that of the only klippy]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    config: Option<PathBuf>,
    /// This computer's MCU in the configuration, if its link does not say so
    #[arg(long, value_name = "NAME", value_hint = ValueHint::Other)]
    mcu: Option<String>,
    /// Where Moonraker answers [default: as moonraker.conf beside the configuration says]
    #[arg(long, value_name = "ADDRESS", value_hint = ValueHint::Other)]
    moonraker: Option<String>,
    /// The board, if its device tree is not there, as on a mounted card
    #[arg(long, value_name = "BOARD", value_parser = offering::<String>(&board::NAMES), hide_possible_values = true)]
    board: Option<String>,
    /// Show what would be done, and change nothing
    #[arg(long)]
    dry_run: bool,
    /// Take back what was changed for the device
    #[arg(long, requires = "device")]
    undo: bool,
    /// Do not ask before a change
    #[arg(long, short = 'y')]
    yes: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Change the system whose files are below DIR, for example a mounted card
    #[arg(long, value_name = "DIR", default_value = "/", value_hint = ValueHint::DirPath)]
    root: PathBuf,
}

/// Does it. Fails if something is wrong or left undone.
pub(super) fn run(args: &AddArgs) -> ExitCode {
    let (computer, board) = match Computer::named(&args.root, args.board.as_deref()) {
        Ok(found) => found,
        Err(why) => return failed(why),
    };
    let mut report = Report { json: args.json, ..Report::default() };
    let done = added(args, &computer, board, &mut report);
    let printed = report.print(done.as_ref().err());
    match (done, printed) {
        (Ok(()), Ok(())) => ExitCode::SUCCESS,
        (Err(why), Ok(())) if args.json => {
            drop(why);
            ExitCode::FAILURE
        }
        (Err(error), _) | (Ok(()), Err(error)) => failed(error),
    }
}

fn added(args: &AddArgs, computer: &Computer, board: Option<Board>, report: &mut Report) -> Result<(), String> {
    let catalog = Catalog::read()?;
    let model = board::model(computer);
    report.set("model", json!(model));
    report.set("board", json!(board.as_ref().map(|board| &board.name)));
    let target = Target::find(computer, args.config.as_deref(), args.mcu.as_deref());
    let lacks = |device: &Device| {
        let klippy = target.as_ref().ok()?.klippy(computer)?;
        klippy.folder_without(device.module())
    };
    let Some(name) = &args.device else {
        return list::list(&catalog, board.as_ref(), &model, &lacks, report);
    };
    let device = catalog.device(name)?;
    report.set("device", json!(device.name));
    if let Some(name) = args.name.as_deref()
        && !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    {
        return Err("--name: a name has letters, digits and _".into());
    }
    if args.name.is_some()
        && device.wants_first
        && target.as_ref().is_ok_and(|target| target.config().section(&device.section(None)).is_none())
    {
        return Err(format!("--name: the first device of its kind has no name: pinion add {}", device.name));
    }
    let driver = device.way.iter().find_map(|way| way.driver.as_deref()).filter(|_| args.name.is_some());
    if let Some(driver) = driver.filter(|_| !args.undo) {
        return Err(format!("--name: printer.cfg can name only one {driver}: its channels have the driver's name"));
    }
    if args.config.is_some()
        && let Err(why) = &target
    {
        return Err(why.clone());
    }
    let inventory = computer.is_this().then(Inventory::scan);
    let config = target.as_ref().ok().map(|target| (target.path.as_path(), args.mcu.as_deref()));
    let uses = Uses::find(computer, board.as_ref(), config, inventory.as_ref());
    if args.undo {
        return undo::undo(args, computer, &catalog, device, target, &uses, report);
    }
    let board = board.ok_or_else(|| list::unknown_board(&model))?;
    if let Some(folder) = lacks(device) {
        let folder = computer.name(&folder);
        return Err(format!(
            "the host in {} has no module {}: update it, or use another device",
            folder.display(),
            device.module()
        ));
    }
    let ways = ways(&board, device, args.bus.as_deref())?;
    let own = target.as_ref().ok().map(|target| target.file(&device.file(args.name.as_deref())));
    let there = target.as_ref().ok().map(|target| existing(target, device, args)).transpose()?.flatten();
    let search = Search { board: &board, uses: &uses, own: own.as_deref(), there };
    let (way, spot) = place(&search, device, &ways, args, report)?;
    let mut work = Work { args, computer, catalog: &catalog, board: &board, device, way, spot, search, report };
    work.run(target)
}

/// A section of printer.cfg, outside of the device's own file, that is this device on this computer.
///
/// # Errors
///
/// One line: the name is another device's, on another MCU.
fn existing(target: &Target, device: &Device, args: &AddArgs) -> Result<Option<String>, String> {
    let own = target.file(&device.file(args.name.as_deref()));
    let wanted = device.section(args.name.as_deref());
    let named = target.others(&own).find(|section| section.name == wanted);
    if let Some(section) = named.filter(|section| !target.is_here(section)) {
        return Err(format!(
            "[{wanted}] ({}) is on the MCU {}: give this device another name: pinion add {} --name NAME",
            section.place,
            target.mcu_of(section),
            device.name
        ));
    }
    let is_it = |section: &&pinion_printer_config::Section| {
        device.is_chip_of(section) && target.is_here(section) && !target.is_pinion_s(section)
    };
    let has_own = target.config().section(&wanted).is_some_and(|section| target.is_in(section, &own));
    let other = named.or_else(|| target.others(&own).find(is_it).filter(|_| args.name.is_none() && !has_own));
    Ok(other.map(|section| section.name.clone()))
}

/// The ways to connect a device to this board, the best one first: all of them, or the one that is named.
fn ways<'a>(board: &Board, device: &'a Device, wanted: Option<&str>) -> Result<Vec<&'a Wiring>, String> {
    let wanted = wanted.map(str::to_ascii_lowercase);
    let is_wanted = |way: &&Wiring| match wanted.as_deref() {
        None => true,
        Some("spi") => way.bus == Kind::Spi,
        Some("i2c") => way.bus == Kind::I2c,
        Some(_) => false,
    };
    let kinds: Vec<&str> = device.way.iter().map(|way| way.bus.name()).collect();
    let ways: Vec<&Wiring> = device.way.iter().filter(is_wanted).collect();
    if ways.is_empty() {
        return Err(format!("--bus: {} is connected by {}", device.name, kinds.join(" or ")));
    }
    let ways: Vec<&Wiring> = ways.into_iter().filter(|way| way.fits(board)).collect();
    match ways.is_empty() {
        false => Ok(ways),
        true => Err(format!(
            "Pinion knows no {} on the header of a {}: see {PINS} for what you can do by hand",
            kinds.join(" or "),
            board.name
        )),
    }
}

/// The page about pins, in the package.
const PINS: &str = "/usr/share/doc/pinion-mcu/guide/pins.md";

/// The way and the place of a device: those of an earlier call, or of a section that is there, or the first ones that are
/// free.
fn place<'a>(
    search: &Search,
    device: &Device,
    ways: &[&'a Wiring],
    args: &AddArgs,
    report: &mut Report,
) -> Result<(&'a Wiring, Slot), String> {
    let all = |ways: &[&'a Wiring]| -> Vec<(&'a Wiring, Slot)> {
        ways.iter().flat_map(|way| search.spots(way).into_iter().map(|spot| (*way, spot))).collect()
    };
    let section = search.there.as_ref().map(|name| format!("[{name}]"));
    let is_placed = |(way, spot): &(&Wiring, Slot)| {
        let mut own = search.uses.all.iter().filter(|one| match &section {
            Some(section) => one.user == *section && matches!(one.source, Source::Printer(_)),
            None => search.own.is_some_and(|own| Target::is_use_of(one, own)),
        });
        own.any(|one| match &one.what {
            Resource::I2c(bus, _) => spot.node == format!("i2c-{bus}"),
            Resource::Sensor(_) => way.bus == Kind::W1,
            Resource::Controller(bus) => board::function(&spot.node) == format!("spi{bus}"),
            // The driver of an ADC has its chip select in config.txt.
            other => spot.node == other.to_string(),
        })
    };
    if let Some(found) = all(ways).into_iter().find(is_placed) {
        return Ok(found);
    }
    if let Some((way, _)) =
        device.way.iter().flat_map(|way| search.spots(way).into_iter().map(move |spot| (way, spot))).find(is_placed)
        && args.bus.is_some()
    {
        return Err(format!(
            "--bus: {} is already connected by {}: take that back with --undo first, or add a second device with --name",
            device.name,
            way.bus.name()
        ));
    }
    let mut refusal = None;
    for way in ways {
        for spot in search.spots(way) {
            match search.conflict(way, &spot) {
                None => {
                    if let Some((why, _)) = refusal.filter(|(_, kind)| *kind != way.bus) {
                        report.set("conflict", json!(why));
                        report.line(format_args!("{why}: so it is connected by {}.", way.bus.name()));
                        report.line("");
                    }
                    return Ok((way, spot));
                }
                Some(why) => refusal = refusal.or(Some((why, way.bus))),
            }
        }
    }
    let why = refusal.map(|(why, _)| why).unwrap_or_default();
    Err(format!(
        "{why}, and nothing else is free for {}: see pinion pins --used, and {PINS} for how chips share a bus",
        device.name
    ))
}

/// The Moonraker of a printer. `None` for another computer's, unless it is named.
fn moonraker_of(
    args: &AddArgs,
    computer: &Computer,
    target: Result<&Target, &String>,
) -> Result<Option<String>, String> {
    match (&args.moonraker, target) {
        (Some(address), _) => Ok(Some(address.clone())),
        (None, Ok(target)) if computer.is_this() => target.moonraker(computer).map(Some),
        _ => Ok(None),
    }
}

/// Fails if the host prints, or if nobody says whether it does.
fn refuse_while_printing(computer: &Computer, moonraker: Option<&str>) -> Result<(), String> {
    let Some(address) = moonraker else { return Ok(()) };
    match Moonraker(address).host() {
        Host::Rests => Ok(()),
        Host::Prints => Err("the host prints: run this command again after the print".into()),
        Host::Unknown(_) if computer.processes(Process::is_klippy).next().is_none() => Ok(()),
        Host::Unknown(why) => Err(format!(
            "klippy runs, but whether it prints is unknown: {why}: start Moonraker, or stop klippy (sudo systemctl \
             stop klipper)"
        )),
    }
}

/// Asks before a change. `done` are the files that this call has changed already.
fn ask(
    args: &AddArgs,
    computer: &Computer,
    moonraker: Option<&str>,
    report: &mut Report,
    question: &str,
) -> Result<(), String> {
    let refused = match report.changed.is_empty() {
        true => "nothing is changed".to_owned(),
        false => format!("the rest is not changed, but {} is", report.changed.join(", ")),
    };
    if args.yes {
        return Ok(());
    }
    if args.json || !io::stdin().is_terminal() {
        return Err(format!("{refused}: there is no terminal to ask: use --yes"));
    }
    report.line(format_args!("{question} [y/N]"));
    report.show()?;
    let mut answer = String::new();
    io::stdin().lock().read_line(&mut answer).map_err(|error| format!("{refused}: {error}"))?;
    match answer.trim().to_ascii_lowercase().as_str() {
        // A print may have begun before the answer.
        "y" | "yes" => refuse_while_printing(computer, moonraker),
        _ => Err(match report.changed.is_empty() {
            true => refused,
            false => format!("{refused}: {} takes that back", command(args, true)),
        }),
    }
}

/// The command that continues, or that takes all of it back, with all options of this call.
fn command(args: &AddArgs, undo: bool) -> String {
    let mut words = vec!["sudo pinion add".to_owned()];
    words.extend(args.device.as_ref().map(word));
    let mut option = |name: &str, value: Option<String>| {
        words.extend(value.map(|value| format!("--{name} {}", word(value))));
    };
    option("name", args.name.clone());
    option("mcu", args.mcu.clone());
    if !undo {
        option("bus", args.bus.clone());
        option("pin", args.pin.clone());
    }
    let path = |path: &PathBuf| path.display().to_string();
    option("config", args.config.as_ref().map(path));
    option("moonraker", args.moonraker.clone());
    option("board", args.board.clone());
    option("root", Some(path(&args.root)).filter(|root| root != "/"));
    if undo {
        words.push("--undo".into());
    }
    words.join(" ")
}

/// Shows changes, asks, and makes them.
fn make(
    args: &AddArgs,
    moonraker: Option<&str>,
    editor: &Editor,
    edits: &[Edit],
    question: &str,
    report: &mut Report,
) -> Result<(), String> {
    let mut all = report.values.get("changes").and_then(Value::as_array).cloned().unwrap_or_default();
    for edit in edits {
        let (old, new) = edit.lines();
        all.push(json!({ "file": edit.file, "old": old.join("\n"), "new": new.join("\n") }));
        let how = match (&edit.old, &edit.new) {
            (None, _) => "new file ",
            (_, None) => "removed file ",
            _ => "",
        };
        report.line(format_args!("{how}{}", edit.file.display()));
        old.iter().for_each(|line| report.line(format_args!("- {line}")));
        new.iter().for_each(|line| report.line(format_args!("+ {line}")));
    }
    report.set("changes", Value::Array(all));
    if !edits.is_empty() {
        report.line("");
    }
    if args.dry_run || edits.is_empty() {
        return Ok(());
    }
    if editor.computer.is_this() && editor.is_root_s() && !geteuid().is_root() {
        return Err(format!("root owns these files: {}", command(args, args.undo)));
    }
    if !question.is_empty() {
        ask(args, editor.computer, moonraker, report, question)?;
    }
    for told in editor.make(edits)? {
        report.line(told);
    }
    report.changed.extend(edits.iter().map(|edit| edit.file.display().to_string()));
    Ok(())
}
