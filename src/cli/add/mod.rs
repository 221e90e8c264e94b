// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add`: from wires to a working device.
//!
//! It finds out the board, draws the wires, enables the bus, asks the chip, writes the sections of printer.cfg, has klippy
//! restart, and measures. A call that ends at a reboot or at a wrong wire goes on when it is repeated: each step first
//! checks if it is done.

use std::collections::BTreeSet;
use std::io::{self, BufRead as _, IsTerminal as _};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

use clap::{Args, ValueHint};
use nix::unistd::geteuid;
use serde_json::{Value, json};

use super::computer::Computer;
use super::failed;
use super::files::Output;
use pinion_linux::foreign::word;
use pinion_runtime::klippy::process::Process;

mod board;
mod boot;
mod bus;
mod catalog;
mod change;
mod check;
mod list;
mod measure;
mod missing;
mod moonraker;
mod picture;
mod printer;
mod probe;
mod report;
mod rights;
mod splice;
mod undo;

use board::{KnownBoard, Spot, Wire};
use bus::State;
use catalog::{Catalog, Device, Kind, Way};
use change::{Change, Record, Side, copy_of};
pub(super) use missing::missing;
use moonraker::{Host, Moonraker};
use printer::Printer;
use report::Report;

/// The folder of the records of root's files.
const STATE: &str = "/var/lib/pinion-mcu/add";
/// Where Moonraker answers, if nobody says otherwise.
const MOONRAKER: &str = "127.0.0.1:7125";
/// The key of the change of the boot loader's settings, with the bus behind it.
const BUS: &str = "bus";

/// Options of `pinion add`.
#[derive(Args, Clone, Debug)]
pub(super) struct AddArgs {
    /// The device. Without it, list what can be added here
    #[arg(value_name = "DEVICE", value_hint = ValueHint::Other)]
    device: Option<String>,
    /// Connect it in this way, if the device has several: spi or i2c
    #[arg(long, value_name = "BUS", value_hint = ValueHint::Other)]
    bus: Option<String>,
    /// Use this pin of the header, such as 11, for the device's line
    #[arg(long, value_name = "NUMBER")]
    pin: Option<usize>,
    /// Write a picture of the wires to this SVG file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    picture: Option<PathBuf>,
    /// The host's configuration [default: that of the only klippy]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    config: Option<PathBuf>,
    /// Where Moonraker answers
    #[arg(long, value_name = "ADDRESS", default_value = MOONRAKER, value_hint = ValueHint::Other)]
    moonraker: String,
    /// Show what would be done, and change nothing
    #[arg(long, conflicts_with = "undo")]
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
    // Changes are made below the folder's descriptor, and a path relative to it would mean another one.
    let root = match std::fs::canonicalize(&args.root) {
        Ok(root) if root.is_dir() => root,
        _ => return failed(format!("{}: there is no such folder", args.root.display())),
    };
    let computer = Computer::at(&root);
    let mut report = Report { json: args.json, ..Report::default() };
    let done = added(args, &computer, &mut report);
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

fn added(args: &AddArgs, computer: &Computer, report: &mut Report) -> Result<(), String> {
    let catalog = Catalog::read()?;
    let board = catalog.board(computer);
    let model = catalog::model(computer);
    report.set("model", json!(model));
    report.set("board", json!(board.map(|board| &board.name)));
    let Some(name) = &args.device else {
        return list::list(&catalog, board, &model, report);
    };
    let device = catalog.device(name).ok_or_else(|| list::unknown_device(&catalog, name))?;
    report.set("device", json!(device.name));
    if args.undo {
        return undo::undo(args, computer, &catalog, device, report);
    }
    let board = board.ok_or_else(|| list::unknown_board(&model))?;
    let ways = ways(board, device, args.bus.as_deref())?;
    let printer = Printer::find(computer, args.config.as_deref());
    if args.config.is_some() {
        printer.as_ref().map_err(String::clone)?;
    }
    let (way, spot) = place(board, device, &ways, printer.as_ref().ok(), report)?;
    let mut work = Work { args, computer, catalog: &catalog, board, device, way, spot, report };
    work.run(printer)
}

/// The ways to connect a device to this board, the best one first: all of them, or the one that is named.
fn ways<'a>(board: &KnownBoard, device: &'a Device, wanted: Option<&str>) -> Result<Vec<&'a Way>, String> {
    let wanted = wanted.map(str::to_ascii_lowercase);
    let is_wanted = |way: &&Way| match wanted.as_deref() {
        None => true,
        Some("spi") => way.bus == Kind::Spi,
        Some("i2c") => way.bus == Kind::I2c,
        Some(_) => false,
    };
    let kinds: Vec<&str> = device.way.iter().map(|way| way.bus.name()).collect();
    let ways: Vec<&Way> = device.way.iter().filter(is_wanted).collect();
    if ways.is_empty() {
        return Err(format!("--bus: {} is connected by {}", device.name, kinds.join(" or ")));
    }
    let ways: Vec<&Way> = ways.into_iter().filter(|way| board.has(way)).collect();
    match ways.is_empty() {
        false => Ok(ways),
        true => Err(format!(
            "{} has no known {} on its header: see docs/guide/pins.md for what you can do by hand",
            board.name,
            kinds.join(" or ")
        )),
    }
}

/// The way and the place of a device: those of an earlier call, or the first ones that are free.
fn place<'a>(
    board: &KnownBoard,
    device: &Device,
    ways: &[&'a Way],
    printer: Option<&Printer>,
    report: &mut Report,
) -> Result<(&'a Way, Spot), String> {
    let all = ways.iter().flat_map(|way| board.spots(way).map(move |spot| (*way, spot)));
    if let Some(printer) = printer
        && let Some(found) = all.into_iter().find(|(way, spot)| printer.has_placed(device, way.bus, &spot.node))
    {
        return Ok(found);
    }
    let uses = |kind: Kind, node: &str| printer?.user(device, kind, node);
    let taken = printer.map(|printer| printer.taken(device)).unwrap_or_default();
    let mut refusal = None;
    for way in ways {
        match board.spot(way, &uses, &taken) {
            Ok(spot) => {
                if let Some(why) = refusal {
                    report.set("conflict", json!(why));
                    report.line(format_args!("{why}: so it is connected by {}.", way.bus.name()));
                    report.line("");
                }
                return Ok((way, spot));
            }
            Err(why) => refusal = refusal.or(Some(why)),
        }
    }
    Err(format!("{}: pins.md says how chips share a bus (docs/guide/pins.md)", refusal.unwrap_or_default()))
}

/// The sides of the computer: root's files, and those of printer.cfg's owner.
fn system(computer: &Computer) -> Side<'_> {
    Side { computer, owner: None, records: STATE.into() }
}

fn host<'a>(computer: &'a Computer, printer: &Printer) -> Side<'a> {
    Side { computer, owner: Some(printer.owner), records: printer.folder() }
}

/// Fails if the host prints, or if nobody says whether it does.
fn refuse_while_printing(args: &AddArgs, computer: &Computer) -> Result<(), String> {
    if !computer.is_this() && args.moonraker == MOONRAKER {
        return Ok(());
    }
    match Moonraker(&args.moonraker).host() {
        Host::Rests => Ok(()),
        Host::Prints => Err("the host prints: call it again when the print has ended".into()),
        Host::Unknown(_) if computer.processes(Process::is_klippy).next().is_none() => Ok(()),
        Host::Unknown(why) => Err(format!(
            "klippy runs, and nobody says whether it prints: {why}: start Moonraker, or stop klippy (sudo systemctl \
             stop klipper)"
        )),
    }
}

/// Asks before a change.
fn ask(args: &AddArgs, computer: &Computer, report: &mut Report, question: &str) -> Result<(), String> {
    const REFUSED: &str = "nothing is changed";
    if args.yes {
        return Ok(());
    }
    if args.json || !io::stdin().is_terminal() {
        return Err(format!("{REFUSED}: nobody can be asked here: call it with --yes"));
    }
    report.line(format_args!("{question} [y/N]"));
    report.show()?;
    let mut answer = String::new();
    io::stdin().lock().read_line(&mut answer).map_err(|error| format!("{REFUSED}: {error}"))?;
    match answer.trim().to_ascii_lowercase().as_str() {
        // A print may have begun before the answer.
        "y" | "yes" => refuse_while_printing(args, computer),
        _ => Err(REFUSED.into()),
    }
}

/// A device on its way into a printer.
struct Work<'a> {
    args: &'a AddArgs,
    computer: &'a Computer,
    catalog: &'a Catalog,
    board: &'a KnownBoard,
    device: &'a Device,
    way: &'a Way,
    /// The place on the bus.
    spot: Spot,
    report: &'a mut Report,
}

impl Work<'_> {
    /// Does it. Without a printer, all but its configuration.
    fn run(&mut self, printer: Result<Printer, String>) -> Result<(), String> {
        let taken = printer.as_ref().map(|printer| printer.taken(self.device)).unwrap_or_default();
        self.move_w1()?;
        let wires = self.board.wires(self.way, &self.spot, &taken, self.args.pin)?;
        self.draw(&wires)?;
        let rests = refuse_while_printing(self.args, self.computer);
        let may_ask = rests.is_ok();
        if !self.args.dry_run {
            rests?;
        }
        let (boot, state) = self.plan_boot()?;
        self.report.set("bus", json!(state.name()));
        if !boot.changes.is_empty() {
            self.make(&system(self.computer), &boot, "Change these files?")?;
            let is_live = self.computer.is_this() && !self.args.dry_run;
            if is_live && state == State::NotLoaded {
                let loaded = Command::new("modprobe").arg("i2c-dev").status();
                if !loaded.is_ok_and(|status| status.success()) {
                    return Err("modprobe i2c-dev failed: reboot, then call this again".into());
                }
            } else if is_live {
                self.report.set("reboot", json!(true));
                self.report.line("The bus is there after a reboot. Connect the wires while the power is off:");
                self.report.line("  sudo poweroff");
                self.report.line(format_args!("Then call \"{}\" again.", self.command()));
                return Ok(());
            }
        }
        if self.computer.is_this() && state == State::Due && boot.changes.is_empty() {
            return Err(format!("{} is enabled and not there: sudo reboot, then call this again", self.node()));
        }
        let address = match self.computer.is_this() && state == State::There && may_ask {
            true => self.check(printer.as_ref().ok())?,
            false => None,
        };
        self.configure(&printer?, &wires, address, boot.needs)
    }

    /// The command that continues.
    fn command(&self) -> String {
        format!("sudo pinion add {}", self.device.name)
    }

    fn node(&self) -> &str {
        &self.spot.node
    }

    fn draw(&mut self, wires: &[Wire]) -> Result<(), String> {
        let (board, device) = (self.board, self.device);
        let entry = |wire: &Wire| {
            let label = board.pins.get(wire.pin - 1);
            json!({ "device": wire.chip, "pin": wire.pin, "label": label, "line": board.line(wire.pin) })
        };
        self.report.set("wires", wires.iter().map(entry).collect());
        self.report.set("trap", json!(device.trap));
        self.report.line(format_args!("{} on {}, by {}", device.title, board.name, self.way.bus.name()));
        self.report.line("");
        self.report.page.append(&picture::page(board, wires));
        self.report.line("");
        self.report.line(format_args!("  level: {}", board.level));
        self.report.line(format_args!("  mind:  {}", device.trap));
        self.report.line("");
        if let Some(path) = &self.args.picture {
            let svg = picture::svg(board, &device.title, wires);
            Output::check(path, &[])?.write(|out| io::Write::write_all(out, svg.as_bytes()))?;
        }
        self.report.show()
    }

    /// Writes the sections, and has the host read them. `boot` are the keys of what the device needs of the boot loader.
    fn configure(
        &mut self,
        printer: &Printer,
        wires: &[Wire],
        address: Option<u8>,
        boot: Vec<String>,
    ) -> Result<(), String> {
        let side = host(self.computer, printer);
        let link = printer.link();
        if self.computer.is_this() && !self.args.dry_run && !link.exists() {
            // Without its MCU, klippy would not start with the new sections.
            let link = link.display();
            return Err(format!(
                "Pinion does not serve at {link}: sudo systemctl enable --now pinion-mcu, then \"{}\"",
                self.command()
            ));
        }
        let is_own = printer.elsewhere(self.device).is_none();
        if let Some(file) = printer.elsewhere(self.device) {
            self.report.line(format_args!(
                "[{}] is in {} already, and stays as it is.",
                self.device.section,
                file.display()
            ));
        }
        let mut is_changed = false;
        if is_own {
            let sections = self.sections(printer, wires, address)?;
            let (changes, mut needs) = printer.plan(&side, self.device, &sections)?;
            // Recorded here, where no root is needed: another device may have made these changes.
            needs.extend(boot);
            let record = Record { changes, needs };
            is_changed = !record.changes.is_empty();
            if is_changed {
                self.make(&side, &record, "Write this?")?;
            }
        }
        if self.args.dry_run {
            self.report.line("Nothing was changed (--dry-run).");
            return Ok(());
        }
        if !is_changed {
            self.report.line("Nothing is left to change.");
        }
        if self.computer.is_this() || self.args.moonraker != MOONRAKER {
            let undo = format!("{} --undo takes it back", self.command());
            self.measure(is_changed).map_err(|why| if is_own { format!("{why}: {undo}") } else { why })?;
        }
        self.report.set("next", json!(self.device.next));
        self.report.line("Next:");
        self.device.next.iter().for_each(|line| self.report.line(format_args!("  {line}")));
        self.report.line(format_args!("pinion add --undo {} takes all of it back.", word(self.device.name)));
        Ok(())
    }

    /// The sections of printer.cfg.
    fn sections(&self, printer: &Printer, wires: &[Wire], address: Option<u8>) -> Result<String, String> {
        let (mcu, _) = printer.mcu();
        let node = self.node();
        let mut text = self.way.config.replace("{mcu}", &mcu);
        let address = address.or_else(|| self.way.addresses.first().copied()).unwrap_or_default();
        let values = [
            ("spi_bus", node.to_owned()),
            ("i2c_bus", node.replacen('-', ".", 1)),
            ("pwm", node.to_owned()),
            ("uart", node.to_owned()),
            ("address", address.to_string()),
        ];
        for (name, value) in values {
            text = text.replace(&format!("{{{name}}}"), &value);
        }
        for wire in wires.iter().filter(|wire| wire.role.starts_with("line")) {
            let line = self.board.line(wire.pin).unwrap_or_default();
            text = text.replace(&format!("{{{}}}", wire.role), line);
        }
        if text.contains("{serial_no}") {
            let serial = self.thermometer(Some(printer)).ok_or(
                "the thermometer's number is not known before it answers: boot the board with it, then call this again",
            )?;
            text = text.replace("{serial_no}", &serial);
        }
        Ok(text)
    }

    /// Shows changes, asks, and makes them.
    fn make(&mut self, side: &Side, record: &Record, question: &str) -> Result<(), String> {
        let entry =
            |change: &Change| json!({ "file": change.file, "old": change.splice.old, "new": change.splice.new });
        let mut all = self.report.values.get("changes").and_then(Value::as_array).cloned().unwrap_or_default();
        all.extend(record.changes.iter().map(entry));
        self.report.set("changes", Value::Array(all));
        let mut last = None;
        for change in &record.changes {
            if last != Some(&change.file) {
                let how = if change.makes { "new file " } else { "" };
                self.report.line(format_args!("{how}{}", change.file.display()));
                last = Some(&change.file);
            }
            let lines = |text: &str| text.trim_matches(['\r', '\n']).lines().map(str::to_owned).collect::<Vec<_>>();
            if !change.splice.old.is_empty() {
                lines(&change.splice.old).iter().for_each(|line| self.report.line(format_args!("- {line}")));
            }
            lines(&change.splice.new).iter().for_each(|line| self.report.line(format_args!("+ {line}")));
        }
        self.report.line("");
        if self.args.dry_run {
            return Ok(());
        }
        if self.computer.is_this() && side.owner.is_none() && !geteuid().is_root() {
            return Err(format!("these files are root's: {}", self.command()));
        }
        ask(self.args, self.computer, self.report, question)?;
        side.make(self.device.name, record)?;
        for file in
            record.changes.iter().filter(|change| !change.makes).map(|change| &change.file).collect::<BTreeSet<_>>()
        {
            let copy = copy_of(file, self.device.name);
            self.report.line(format_args!("{} is a copy of what was there.", copy.display()));
        }
        Ok(())
    }
}
