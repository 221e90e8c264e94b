// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add`: from wires to a working device.
//!
//! It finds out the board, draws the wires, enables the bus, asks the chip, writes the sections of printer.cfg, has klippy
//! restart, and measures. A call that ends at a reboot or at a wrong wire goes on when it is repeated: each step first
//! checks if it is done.

#![forbid(unsafe_code)]

use std::collections::BTreeSet;
use std::fmt::Display;
use std::io::{self, BufRead as _, IsTerminal as _};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::thread;
use std::time::{Duration, Instant};

use clap::{Args, ValueHint};
use nix::unistd::geteuid;
use serde_json::{Value, json};

use super::computer::{Access, Computer};
use super::files::Output;
use super::finding::Finding;
use super::page::{Page, aligned, print};
use super::{failed, quietly};
use pinion_linux::foreign::word;
use pinion_runtime::klippy::process::Process;

mod boot;
mod catalog;
mod change;
mod moonraker;
mod picture;
mod printer;
mod probe;

use catalog::{Boot, Catalog, Check, Device, Kind, KnownBoard, Spot, Way, Wire};
use change::{Change, Record, Side, Splice, copy_of};
use moonraker::{Host, Moonraker};
use printer::Printer;

/// The folder of the records of root's files.
const STATE: &str = "/var/lib/pinion-mcu/add";
/// Where Moonraker answers, if nobody says otherwise.
const MOONRAKER: &str = "127.0.0.1:7125";
/// The file that loads the driver of /dev/i2c-*.
const MODULES: &str = "/etc/modules-load.d/pinion-i2c-dev.conf";
/// How long a fan may take until its tachometer counts. klippy reports a speed each second.
const SPIN_UP: Duration = Duration::from_secs(6);
/// How long a sensor may take until the host has its first value. A DS18B20 takes 3 s.
const FIRST_VALUE: Duration = Duration::from_secs(8);
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

/// The finding of `pinion doctor`: the devices of these configurations whose bus is not there, and how to get it.
pub(super) fn missing(computer: &Computer, configs: &BTreeSet<PathBuf>) -> Vec<Finding> {
    let Ok(catalog) = Catalog::read() else { return Vec::new() };
    let printers = configs.iter().filter_map(|config| Printer::read(computer, config).ok());
    let finding = |printer: Printer| -> Vec<Finding> {
        let of = |(section, sensor, file): (&str, Option<&str>, String)| {
            let found = format!("[{section}] in printer.cfg needs {file}, which is not there");
            let kind = section.split(' ').next().unwrap_or_default();
            let is_it = |device: &&Device| match sensor {
                Some(sensor) => device.way.iter().any(|way| way.config.contains(&format!("sensor_type: {sensor}\n"))),
                None => device.section.split(' ').next() == Some(kind),
            };
            match catalog.devices.iter().find(is_it) {
                Some(device) => Finding::error("device", found, format!("sudo pinion add {}", device.name)),
                None => Finding::error("device", found, "enable its bus: pinion add lists what it knows"),
            }
        };
        printer.absent(computer).into_iter().map(of).collect()
    };
    printers.flat_map(finding).collect()
}

fn added(args: &AddArgs, computer: &Computer, report: &mut Report) -> Result<(), String> {
    let catalog = Catalog::read()?;
    let board = catalog.board(computer);
    let model = catalog::model(computer);
    report.set("model", json!(model));
    report.set("board", json!(board.map(|board| &board.name)));
    let Some(name) = &args.device else {
        return list(&catalog, board, &model, report);
    };
    let device = catalog.device(name).ok_or_else(|| unknown_device(&catalog, name))?;
    report.set("device", json!(device.name));
    if args.undo {
        return undo(args, computer, &catalog, device, report);
    }
    let board = board.ok_or_else(|| unknown_board(&model))?;
    let way = chosen(board, device, args.bus.as_deref())?;
    let mut work = Work { args, computer, catalog: &catalog, board, device, way, spot: Spot::default(), report };
    work.run()
}

fn unknown_device(catalog: &Catalog, name: &str) -> String {
    let near = catalog.devices.iter().map(|device| (strsim::damerau_levenshtein(device.name, name), device.name)).min();
    match near.filter(|(distance, _)| *distance <= 2) {
        Some((_, near)) => format!("there is no device \"{name}\": did you mean {near}?"),
        None => format!("there is no device \"{name}\": pinion add lists them"),
    }
}

fn unknown_board(model: &str) -> String {
    let this = if model.is_empty() { "this computer (it has no device tree)" } else { model };
    format!(
        "{this} is not among the known boards: look up in its manual which pins have SPI (MOSI, MISO, SCLK, CS) or I2C \
         (SDA, SCL) and which overlay enables them, then see docs/guide/pins.md"
    )
}

/// The way to connect a device: the one that is named, or the first one that the board has.
fn chosen<'a>(board: &KnownBoard, device: &'a Device, wanted: Option<&str>) -> Result<&'a Way, String> {
    let mut ways = device.way.iter().filter(|way| match wanted.map(str::to_ascii_lowercase).as_deref() {
        None => true,
        Some("spi") => way.bus == Kind::Spi,
        Some("i2c") => way.bus == Kind::I2c,
        Some(_) => false,
    });
    let kinds: Vec<&str> = device.way.iter().map(|way| way.bus.name()).collect();
    if ways.clone().next().is_none() {
        return Err(format!("--bus: {} is connected by {}", device.name, kinds.join(" or ")));
    }
    ways.find(|way| board.has(way)).ok_or_else(|| {
        format!(
            "{} has no known {} on its header: see docs/guide/pins.md for what you can do by hand",
            board.name,
            kinds.join(" or ")
        )
    })
}

/// Lists the devices.
fn list(catalog: &Catalog, board: Option<&KnownBoard>, model: &str, report: &mut Report) -> Result<(), String> {
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

/// The output: lines for people as they come, or one JSON document at the end.
#[derive(Default)]
struct Report {
    json: bool,
    values: serde_json::Map<String, Value>,
    page: Page,
}

impl Report {
    fn line(&mut self, line: impl Display) {
        self.page.line(line);
    }

    fn set(&mut self, key: &str, value: Value) {
        self.values.insert(key.to_owned(), value);
    }

    /// Shows what was said until now.
    fn show(&mut self) -> Result<(), String> {
        let page = std::mem::take(&mut self.page);
        if self.json { Ok(()) } else { print(&page) }
    }

    fn print(&mut self, error: Option<&String>) -> Result<(), String> {
        if !self.json {
            return self.show();
        }
        self.set("error", json!(error));
        print(&Page::json(&format!("{:#}\n", Value::Object(std::mem::take(&mut self.values)))))
    }
}

/// The sides of the computer: root's files, and those of printer.cfg's owner.
fn system(computer: &Computer) -> Side<'_> {
    Side { computer, owner: None, records: STATE.into() }
}

fn host<'a>(computer: &'a Computer, printer: &Printer) -> Side<'a> {
    Side { computer, owner: Some(printer.owner), records: printer.folder() }
}

/// Takes all changes of a device back.
fn undo(
    args: &AddArgs,
    computer: &Computer,
    catalog: &Catalog,
    device: &Device,
    report: &mut Report,
) -> Result<(), String> {
    let names: Vec<&str> = catalog.devices.iter().map(|device| device.name).collect();
    let mut sides = vec![system(computer)];
    match Printer::find(computer, args.config.as_deref()) {
        Ok(printer) => sides.push(host(computer, &printer)),
        Err(why) if args.config.is_some() => return Err(why),
        Err(why) => report.line(why),
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
    for (side, record) in &records {
        reboots |= record.changes.iter().any(|change| change.key.starts_with(BUS));
        let left = side.undo(device.name, &names)?;
        left.iter().for_each(|line| report.line(line));
    }
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
    fn run(&mut self) -> Result<(), String> {
        let printer = Printer::find(self.computer, self.args.config.as_deref());
        let (printer, no_printer) = match printer {
            Ok(printer) => (Some(printer), None),
            Err(why) if self.args.config.is_some() => return Err(why),
            Err(why) => (None, Some(why)),
        };
        let taken = printer.as_ref().map(|printer| printer.taken(self.device)).unwrap_or_default();
        let uses = |kind: Kind, node: &str| printer.as_ref()?.user(self.device, kind, node);
        self.spot = self.board.spot(self.way, &uses)?;
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
        } else if !self.args.dry_run && !boot.needs.is_empty() && self.computer.is_this() {
            // It was there before, and another device's --undo must not take it away.
            self.note(&boot)?;
        }
        if self.computer.is_this() && state == State::Due && boot.changes.is_empty() {
            return Err(format!("{} is enabled and not there: sudo reboot, then call this again", self.node()));
        }
        let address = match self.computer.is_this() && state == State::There && may_ask {
            true => self.check(printer.as_ref())?,
            false => None,
        };
        let Some(printer) = printer else {
            return Err(no_printer.unwrap_or_default());
        };
        self.configure(&printer, &wires, address)
    }

    /// Puts the wire of 1-Wire at the line that config.txt names.
    fn move_w1(&mut self) -> Result<(), String> {
        let files: Vec<&str> = self.board.files.iter().map(String::as_str).collect();
        let (Kind::W1, Some(file)) = (self.way.bus, self.computer.first(&files)) else { return Ok(()) };
        let text = system(self.computer).read(Path::new(file))?.unwrap_or_default();
        let Some(line) = boot::w1_line(&text, &self.board.sections) else { return Ok(()) };
        let label = format!("GPIO{line}");
        let at = self.board.pins.iter().position(|pin| pin.split(' ').next() == Some(&*label));
        let pin = at.ok_or_else(|| format!("{file}: w1-gpio is on line {line}, which is not on the header"))? + 1;
        self.spot.pins.insert("data".into(), pin);
        Ok(())
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

    /// The changes that give the board the bus, and whether it is there.
    fn plan_boot(&self) -> Result<(Record, State), String> {
        let mut record = Record::default();
        let Some(bus) = self.board.bus.get(&self.way.bus) else { return Ok((record, State::There)) };
        let key = format!("{BUS} {}", bus.node);
        record.needs.push(key.clone());
        let is_there = self.is_there(self.node());
        let file = self.computer.first(&self.board.files.iter().map(String::as_str).collect::<Vec<_>>());
        let side = system(self.computer);
        let mut wanted: Vec<&str> = Vec::new();
        // A bus that is there stays as it is, whoever has enabled it.
        // But LEDs also need a clock that stays.
        if self.way.driver.is_none() && (!is_there || self.way.bus == Kind::Leds) {
            wanted.extend(bus.enable.iter().map(String::as_str));
        }
        if self.way.driver.is_none() || !is_there {
            wanted.extend(self.way.config_txt.iter().map(String::as_str));
        }
        let splices = match (self.board.boot, file) {
            (Boot::ConfigTxt, Some(file)) if !wanted.is_empty() => {
                let text = side.read(Path::new(file))?.unwrap_or_default();
                boot::config_txt(&text, &self.board.sections, self.device.name, &wanted).into_iter().collect()
            }
            (Boot::Overlays, Some(file)) if !is_there => {
                let text = side.read(Path::new(file))?.unwrap_or_default();
                boot::overlays(&text, bus, &self.overlays()).map_err(|why| format!("{file}: {why}"))?
            }
            (_, None) if !is_there => {
                return Err(format!("none of {} is there: enable {} by hand", self.board.files.join(", "), bus.node));
            }
            _ => Vec::new(),
        };
        let change = |splice| Change { key: key.clone(), file: file.unwrap_or_default().into(), makes: false, splice };
        record.changes.extend(splices.into_iter().map(change));
        if is_there && record.changes.is_empty() {
            return Ok((record, State::There));
        }
        let mut state = State::Due;
        if self.way.bus == Kind::I2c && !is_there && self.needs_i2c_dev()? {
            let new = "# Written by pinion add: /dev/i2c-*\ni2c-dev\n".to_owned();
            let splice = Splice { at: 0, old: String::new(), new };
            if record.changes.is_empty() && self.computer.path(format!("/sys/bus/i2c/devices/{}", bus.node)).exists() {
                state = State::NotLoaded;
            }
            record.changes.push(Change { key: "i2c-dev".into(), file: MODULES.into(), makes: true, splice });
        }
        if self.way.bus == Kind::I2c {
            record.needs.push("i2c-dev".into());
        }
        Ok((record, state))
    }

    /// Whether nothing loads i2c-dev at boot.
    fn needs_i2c_dev(&self) -> Result<bool, String> {
        let files = self.computer.matching("/etc/modules-load.d/*.conf");
        let files = files.iter().map(|file| self.computer.name(file)).chain([PathBuf::from("/etc/modules")]);
        let mut lines = files.filter_map(|file| self.computer.text(file));
        Ok(!lines.any(|text| text.lines().any(|line| ["i2c-dev", "i2c_dev"].contains(&line.trim()))))
    }

    /// The names of the image's overlays.
    fn overlays(&self) -> BTreeSet<String> {
        let patterns = ["/boot/dtb*/overlay/*.dtbo", "/boot/dtb*/*/overlay/*.dtbo", "/boot/overlay-user/*.dtbo"];
        let files = patterns.iter().flat_map(|pattern| self.computer.matching(pattern));
        files.filter_map(|file| Some(file.file_stem()?.to_str()?.to_owned())).collect()
    }

    /// Whether the bus, or the device of the chip's driver, is there.
    fn is_there(&self, node: &str) -> bool {
        if self.way.driver.is_some() {
            return self.iio().is_some();
        }
        let path = match self.way.bus {
            Kind::W1 => format!("/sys/bus/w1/devices/{node}"),
            Kind::Pwm => {
                let device = node.split('/').next().unwrap_or_default();
                let chips = self.computer.matching("/sys/class/pwm/pwmchip*/device");
                return chips.iter().any(|chip| {
                    std::fs::read_link(chip).is_ok_and(|target| target.file_name().is_some_and(|name| name == device))
                });
            }
            _ => format!("/dev/{node}"),
        };
        self.computer.path(path).exists()
    }

    /// Asks the device. Returns its I2C address.
    fn check(&mut self, printer: Option<&Printer>) -> Result<Option<u8>, String> {
        let node = self.node().to_owned();
        let mut checks = Vec::new();
        let path = format!("/dev/{node}");
        if let Ok(about) = std::fs::metadata(self.computer.path(&path)) {
            checks.push(format!("{path} is there"));
            if let Some(user) = self.computer.user("pinion")
                && !user.may(Access::READ_WRITE, &about)
            {
                checks.push(format!("Pinion's user may not open {path}: sudo pinion doctor says what is missing"));
            }
        }
        checks.extend(strays(self.computer, self.board, &self.spot));
        let asked = match (&self.way.check, self.way.driver.is_some()) {
            (Some(Check::W1), _) => match self.thermometer(printer) {
                Some(serial) => Ok(probe::Answer { text: format!("the thermometer {serial} answers"), address: None }),
                None => {
                    Err("no DS18B20 answers: check its wires and the resistor of 4.7 kOhm from data to 3.3 V".into())
                }
            },
            (Some(Check::Iio { file, highest }), _) => self.sample(file, *highest),
            (Some(_), false) => match probe::Live::of(&node) {
                Some(mut live) => quietly(|| probe::ask(self.catalog, self.way, &mut live)),
                None => Err(format!("{node} is no bus")),
            },
            _ => Ok(probe::Answer { text: "it cannot be asked: try it out".into(), address: None }),
        };
        checks.push(match &asked {
            Ok(answer) => format!("{}: {}", self.device.name, answer.text),
            Err(why) => format!("{}: {why}", self.device.name),
        });
        self.report.set("checks", json!(checks));
        checks.iter().for_each(|line| self.report.line(line));
        self.report.show()?;
        match asked {
            Ok(answer) => Ok(answer.address),
            Err(why) => Err(format!("{}: {why}: then call \"{}\" again", self.device.name, self.command())),
        }
    }

    /// Reads a value of the chip by its driver, which does not know whether the chip is there.
    fn sample(&self, file: &str, highest: u32) -> Result<probe::Answer, String> {
        let folder = self.iio().ok_or("its driver has gone: reboot")?;
        let value = self.computer.text(self.computer.name(&folder.join(file)));
        let value: u32 = value.and_then(|text| text.parse().ok()).ok_or_else(|| format!("{file} cannot be read"))?;
        match value {
            0 => Err(format!("{file} is 0: no power, DOUT is not connected, or the input touches ground")),
            _ if value >= highest => {
                Err(format!("{file} is {value}, the highest value: no ground, or nothing is connected at the input"))
            }
            _ => Ok(probe::Answer { text: format!("{file} is {value} of {highest}"), address: None }),
        }
    }

    /// The folder of the device of the chip's driver.
    fn iio(&self) -> Option<PathBuf> {
        let driver = self.way.driver.as_deref();
        let names = self.computer.matching("/sys/bus/iio/devices/iio:device*/name");
        let name = names.iter().find(|name| self.computer.text(self.computer.name(name)).as_deref() == driver)?;
        name.parent().map(Path::to_owned)
    }

    /// A thermometer that printer.cfg does not have yet.
    fn thermometer(&self, printer: Option<&Printer>) -> Option<String> {
        let known = printer.map(|printer| printer.serials(self.device)).unwrap_or_default();
        let found = self.computer.matching("/sys/bus/w1/devices/28-*");
        let names = found.iter().filter_map(|path| path.file_name()?.to_str());
        let is_serial = |name: &&str| name.chars().all(|c| c.is_ascii_hexdigit() || c == '-');
        names.filter(is_serial).find(|name| !known.contains(name)).map(str::to_owned)
    }

    /// Writes the sections, and has the host read them.
    fn configure(&mut self, printer: &Printer, wires: &[Wire], address: Option<u8>) -> Result<(), String> {
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
            let (changes, needs) = printer.plan(&side, self.device, &sections)?;
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

    /// Records what the device needs, if others have made it.
    fn note(&self, record: &Record) -> Result<(), String> {
        let side = system(self.computer);
        if !geteuid().is_root() {
            return Ok(());
        }
        let known = side.record(self.device.name)?.unwrap_or_default();
        let is_known = record.needs.iter().all(|need| known.needs.contains(need));
        // Nobody else's change is there to keep.
        let is_shared = self.catalog.devices.iter().any(|other| {
            let record = side.record(other.name).ok().flatten();
            other.name != self.device.name && record.is_some_and(|record| !record.changes.is_empty())
        });
        if is_known || !is_shared { Ok(()) } else { side.make(self.device.name, record) }
    }

    /// Restarts the host, and asks it for a first value.
    fn measure(&mut self, is_changed: bool) -> Result<(), String> {
        let moonraker = Moonraker(&self.args.moonraker);
        let left = match moonraker.host() {
            Host::Rests => None,
            Host::Prints => Some("the host prints: run FIRMWARE_RESTART after the print".to_owned()),
            Host::Unknown(why) => Some(format!("{why}: run FIRMWARE_RESTART in the host")),
        };
        self.report.set("warning", json!(left));
        if let Some(left) = left {
            self.report.line(left);
            return Ok(());
        }
        let restarted = if is_changed { moonraker.restart() } else { Ok(()) };
        let measured = restarted.and_then(|()| self.first_value(&moonraker))?;
        self.report.line(&measured);
        self.report.set("measured", json!(measured));
        Ok(())
    }

    /// The host's first measurement with the device, in words.
    fn first_value(&self, moonraker: &Moonraker) -> Result<String, String> {
        let section = &self.device.section;
        if self.device.resonance {
            let lines = moonraker.run(&format!("ACCELEROMETER_QUERY CHIP={section}"))?;
            let values = lines.iter().find_map(|line| acceleration(line));
            return values.ok_or_else(|| "ACCELEROMETER_QUERY answers no values: see klippy.log".to_owned())?;
        }
        if let Some(fan) = section.strip_prefix("fan_generic ") {
            return turns(moonraker, section, fan);
        }
        if let Some(strip) = section.strip_prefix("neopixel ") {
            moonraker.run(&format!("SET_LED LED={strip} RED=0.5 GREEN=0 BLUE=0"))?;
            let line = "the strip should be red now. If it is green, write color_order: RGB into its section. If it is \
                        dark, check its 5 V, its ground, and that the wire goes to DIN";
            return Ok(line.into());
        }
        if section.starts_with("temperature_sensor ") {
            let degrees = temperature(moonraker, section)?;
            return match (-40.0..=150.0).contains(&degrees) {
                true => Ok(format!("the host reads {degrees:.1} degrees")),
                false => Err(format!("the host reads {degrees:.1} degrees: check the sensor's wires and type")),
            };
        }
        if let Some(command) = &self.device.measure {
            let lines = moonraker.run(command)?;
            let lines: Vec<&str> = lines.iter().map(|line| line.trim_start_matches("// ")).collect();
            return Ok(format!("{command}: {}", lines.join("; ")));
        }
        Ok("the host has restarted with it".into())
    }
}

/// The pins of the bus that are GPIO lines now: another program has switched them. A Raspberry Pi shows this to root.
fn strays(computer: &Computer, board: &KnownBoard, spot: &Spot) -> Vec<String> {
    let controllers = computer.matching("/sys/kernel/debug/pinctrl/*-pinctrl-*/pins");
    let is_header = |path: &&PathBuf| {
        let name = path.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy();
        ["bcm2835", "bcm2711", "rp1"].iter().any(|chip| name.ends_with(chip))
    };
    let text = controllers.iter().find(is_header).and_then(|path| computer.text(computer.name(path)));
    let text = text.unwrap_or_default();
    // The driver selects a chip by a line, and 1-Wire is bits on a line.
    let pins = spot.pins.iter().filter(|(role, _)| !["cs", "data"].contains(&role.as_str()));
    let stray = |(_, pin): (&String, &usize)| {
        let label = board.pins.get(pin - 1)?;
        let line: u32 = label.strip_prefix("GPIO")?.split(' ').next()?.parse().ok()?;
        // For example "pin 10 (gpio10) function gpio_out in hi; irq 0 (none)".
        let is_it = |text: &&str| text.starts_with(&format!("pin {line} ("));
        let function = text.lines().find(is_it)?.split_once(" function ")?.1.split(' ').next()?;
        function.starts_with("gpio").then(|| {
            format!(
                "pin {pin} ({label}) is a GPIO line now: another program has switched it: end that program, or reboot"
            )
        })
    };
    pins.filter_map(stray).collect()
}

/// A sensor's first temperature. klippy says 0 until it has one.
fn temperature(moonraker: &Moonraker, section: &str) -> Result<f64, String> {
    let end = Instant::now() + FIRST_VALUE;
    loop {
        let degrees = moonraker.value(section, "temperature")?;
        if degrees != 0.0 {
            return Ok(degrees);
        }
        if Instant::now() >= end {
            return Err("the host has read no temperature yet: see klippy.log".into());
        }
        thread::sleep(Duration::from_millis(500));
    }
}

/// Lets a fan run at full speed until its tachometer counts.
fn turns(moonraker: &Moonraker, section: &str, fan: &str) -> Result<String, String> {
    let speed = |speed: &str| moonraker.run(&format!("SET_FAN_SPEED FAN={fan} SPEED={speed}"));
    let end = Instant::now() + SPIN_UP;
    speed("1")?;
    let counted = loop {
        let rpm = moonraker.value(section, "rpm");
        if rpm.as_ref().is_ok_and(|rpm| *rpm > 0.0) || Instant::now() >= end {
            break rpm;
        }
        thread::sleep(Duration::from_millis(500));
    };
    speed("0")?;
    match counted? {
        rpm if rpm > 0.0 => Ok(format!("the tachometer counts {rpm:.0} turns a minute at full speed")),
        _ => {
            Err("the tachometer counts nothing at full speed: check that the fan runs, and the wire of its tachometer"
                .into())
        }
    }
}

/// The acceleration in klippy's answer to ACCELEROMETER_QUERY, judged: at rest it is that of gravity.
fn acceleration(line: &str) -> Option<Result<String, String>> {
    const GRAVITY_MM_S2: f64 = 9806.65;
    let values = line.split_once("accelerometer values (x, y, z): ")?.1;
    let values: Vec<f64> = values.split(',').filter_map(|value| value.trim().parse().ok()).collect();
    let [x, y, z] = values[..] else { return None };
    let total = (x * x + y * y + z * z).sqrt();
    let found = format!("it measures {x:.0}, {y:.0}, {z:.0} mm/s2: {:.2} of gravity", total / GRAVITY_MM_S2);
    Some(match (0.7..=1.3).contains(&(total / GRAVITY_MM_S2)) {
        true => Ok(found),
        false => Err(format!("{found}: at rest it should be 1: check its wires, its power, and that nothing moves")),
    })
}

/// Whether a bus is there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    There,
    /// After a reboot.
    Due,
    /// After its driver is loaded.
    NotLoaded,
}

impl State {
    fn name(self) -> &'static str {
        match self {
            State::There => "there",
            State::Due => "missing",
            State::NotLoaded => "not loaded",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::computer::tests::Tree;

    #[test]
    fn a_configured_device_without_its_bus_is_named_with_the_command_that_adds_it() {
        let tree = Tree::new();
        tree.put("home/pi/printer.cfg", "[adxl345 bed]\ncs_pin: host:None\nspi_bus: spidev0.1\n[temperature_sensor room]\nsensor_type: BME280\ni2c_bus: i2c.1\n[lis2dw]\nspi_bus: spidev0.0\n[tmc5160 stepper_x]\nspi_bus: spi1\n[temperature_sensor out]\nsensor_type: DS18B20\nserial_no: 28-0316a4f1ff27\n[neopixel strip]\npin: host:spidev9.0\n[sx1509 x]\ni2c_bus: i2c.7\n");
        tree.put("dev/spidev0.0", "");
        let found = missing(&tree.computer(), &[PathBuf::from("/home/pi/printer.cfg"), "/none".into()].into());
        let remedies: Vec<(String, String)> = found
            .iter()
            .map(|finding| {
                let found = finding.trouble.found();
                (found.split(']').next().unwrap().to_owned(), finding.trouble.remedy.clone().unwrap_or_default().into())
            })
            .collect();
        let expected = [
            ("[adxl345 bed", "sudo pinion add adxl345"),
            ("[neopixel strip", "sudo pinion add ws2812"),
            ("[sx1509 x", "enable its bus: pinion add lists what it knows"),
            ("[temperature_sensor out", "sudo pinion add ds18b20"),
            ("[temperature_sensor room", "sudo pinion add bme280"),
        ];
        assert_eq!(remedies, expected.map(|(found, remedy)| (found.to_owned(), remedy.to_owned())));
    }

    #[test]
    fn a_pin_of_the_bus_that_another_program_has_switched_is_named() {
        let tree = Tree::new();
        tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B");
        // Pin controllers of other chips have pins of the same numbers.
        tree.put("sys/kernel/debug/pinctrl/107d504100.pinctrl-pinctrl-bcm2712/pins", "pin 11 (gpio11) function gpio\n");
        let pins = "registered pins: 58\n\
                    pin 8 (gpio8) function gpio_out in hi; irq 0 (none)\n\
                    pin 9 (gpio9) function alt0 in lo; irq 0 (none)\n\
                    pin 10 (gpio10) function gpio_in in lo; irq 0 (none)\n\
                    pin 11 (gpio11) function alt0 in lo; irq 0 (none)\n";
        tree.put("sys/kernel/debug/pinctrl/fe200000.gpio-pinctrl-bcm2711/pins", pins);
        let catalog = Catalog::read().unwrap();
        let computer = tree.computer();
        let board = catalog.board(&computer).unwrap();
        let spot = board.spot(&catalog.device("adxl345").unwrap().way[0], &|_, _| None).unwrap();
        let found = strays(&computer, board, &spot);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].starts_with("pin 19 (GPIO10 MOSI) is a GPIO line now"), "{found:?}");
    }

    #[test]
    fn a_measurement_at_rest_is_gravity() {
        let told = |line: &str| acceleration(line);
        assert_eq!(told("// ok"), None);
        assert_eq!(told("accelerometer values (x, y, z): a, b"), None);
        let good = told("accelerometer values (x, y, z): 470.719200, 941.438400, 9728.196800").unwrap().unwrap();
        assert_eq!(good, "it measures 471, 941, 9728 mm/s2: 1.00 of gravity");
        assert!(told("accelerometer values (x, y, z): 0.0, 0.0, 0.0").unwrap().unwrap_err().contains("at rest"));
    }
}
