// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add --undo`: removes the device's own files, and takes its lines at boot back if nothing else needs them.

use std::path::{Path, PathBuf};

use nix::unistd::geteuid;
use serde_json::json;

use pinion_printer_config::Section;
use pinion_runtime::klippy::process::Process;
use pinion_system::Computer;
use pinion_system::board::{Board, Boot, Kind, function};
use pinion_system::klippy::configs;
use pinion_system::uses::{Resource, Source, Use, Uses};

use super::catalog::{Catalog, Device};
use super::edit::{Edit, Editor};
use super::moonraker::{LEAVE_TIMEOUT, Moonraker};
use super::plan::{I2C_DEV, MODULES};
use super::printer::Target;
use super::report::Report;
use super::{AddArgs, ask, beside, boot, command, make, moonraker_of, refuse_while_printing};

/// Takes a device back.
pub(super) fn undo(
    args: &AddArgs,
    computer: &Computer,
    catalog: &Catalog,
    device: &Device,
    target: Result<Target, String>,
    uses: &Uses,
    report: &mut Report,
) -> Result<(), String> {
    let name = args.name.as_deref();
    let mut left = Vec::new();
    let root = Editor::new(computer, None);
    let mut host = None;
    let mut own = Vec::new();
    match &target {
        Ok(target) => {
            let editor = Editor::new(computer, Some(target.owner));
            target.files().for_each(|file| editor.sweep(&file));
            editor.sweep(&target.file(&device.file(name)));
            own = beside::plan_undo(target, &editor, catalog, device, name, &mut left)?;
            host = Some((editor, target));
        }
        // Without its sections, nobody knows what is still needed.
        Err(why) if args.config.is_some() || !configs(computer).is_empty() => return Err(why.clone()),
        Err(why) => report.line(why),
    }
    let needs = Needs { uses, catalog, device, name, target: target.as_ref().ok() };
    let boot = needs.plan(&root, &mut left)?;
    report.set("changes", json!([]));
    report.set("left", json!(left));
    if own.is_empty() && boot.is_empty() && left.is_empty() {
        report.line(format_args!("{}: nothing was added, so nothing is changed", device.file(name)));
        return Ok(());
    }
    let moonraker = moonraker_of(args, computer, target.as_ref())?;
    if !args.dry_run {
        refuse_while_printing(computer, moonraker.as_deref())?;
    }
    let dry = AddArgs { dry_run: true, ..args.clone() };
    if let Some((editor, _)) = &host {
        make(&dry, None, editor, &own, "", report)?;
    }
    make(&dry, None, &root, &boot, "", report)?;
    left.iter().for_each(|line| report.line(line));
    if args.dry_run {
        report.line("Nothing was changed (--dry-run).");
        return Ok(());
    }
    if computer.is_this() && !boot.is_empty() && !geteuid().is_root() {
        return Err(format!("root owns some of these files: {}", command(args, true)));
    }
    // Change nothing before both owners' files can be changed.
    root.probe(boot.iter().map(|edit| edit.file.clone()))?;
    if let Some((editor, _)) = &host {
        editor.probe(own.iter().map(|edit| edit.file.clone()))?;
    }
    if !own.is_empty() || !boot.is_empty() {
        ask(args, computer, moonraker.as_deref(), report, "Take this back?")?;
    }
    let mut told = Vec::new();
    if let Some((editor, target)) = &host {
        told.extend(editor.make(&own)?);
        report.changed.extend(own.iter().map(|edit| edit.file.display().to_string()));
        editor.tidy(&target.folder());
    }
    told.extend(root.make(&boot)?);
    told.iter().for_each(|line| report.line(line));
    left.extend(told);
    report.set("left", json!(left));
    report.set("reboot", json!(!boot.is_empty()));
    if !boot.is_empty() {
        report.line("The bus is off after a reboot, unless another device needs it.");
    }
    // Without klippy, nothing has to restart.
    let is_named = args.moonraker.is_some();
    if let Some(address) = moonraker.filter(|_| is_named || computer.processes(Process::is_klippy).next().is_some()) {
        let restarted = Moonraker(&address).restart(LEAVE_TIMEOUT);
        report.set("warning", json!(restarted.as_ref().err()));
        report.line(match restarted {
            Ok(()) => "The host has restarted without the device.".to_owned(),
            Err(why) => format!("{why}: run FIRMWARE_RESTART in the host"),
        });
    }
    Ok(())
}

/// The needs of the remaining sections from the boot loader.
struct Needs<'a> {
    uses: &'a Uses,
    catalog: &'a Catalog,
    device: &'a Device,
    name: Option<&'a str>,
    target: Option<&'a Target>,
}

impl Needs<'_> {
    /// The changes of root's files.
    fn plan(&self, editor: &Editor, left: &mut Vec<String>) -> Result<Vec<Edit>, String> {
        let mut edits = Vec::new();
        let own = self.device.file(self.name);
        let Some(board) = &self.uses.board else { return Ok(edits) };
        editor.sweep(Path::new(MODULES));
        if let Some(file) = board.file(editor.computer).map(Path::new) {
            editor.sweep(file);
            let old = editor.read(file)?.unwrap_or_default();
            let mut new = old.clone();
            let keeps = |what: &str, (user, place): &(String, PathBuf), left: &mut Vec<String>| {
                left.push(format!(
                    "{} keeps \"{what}\": {user} ({}) still needs it. Run this command again when it no longer does",
                    file.display(),
                    place.display()
                ));
            };
            match board.boot {
                Boot::ConfigTxt => {
                    if boot::has_changed_lines(&old, &own) {
                        left.push(format!(
                            "{} keeps lines below \"# pinion add {own}\": they were changed later",
                            file.display()
                        ));
                    }
                    for line in boot::own_lines(&old).into_iter().rev().filter(|line| line.device == own) {
                        match self.user(board, &line.line) {
                            None => new = boot::without(&new, &line),
                            Some(user) => match self.of_ours(&user) {
                                Some(other) => new = boot::handed_over(&new, &line, &other),
                                None => keeps(&line.line, &user, left),
                            },
                        }
                    }
                }
                Boot::Overlays => {
                    let kinds = self.device.way.iter().map(|way| way.bus);
                    let user = kinds.filter_map(|kind| self.user_of(board, kind)).next();
                    let settings = boot::own_settings(&old, &own);
                    match user.filter(|_| !settings.is_empty()) {
                        None => {
                            let mut changed = Vec::new();
                            new = boot::without_settings(&old, &own, &mut changed);
                            left.extend(changed.into_iter().map(|why| format!("{}: {why}", file.display())));
                        }
                        Some(user) => match self.of_ours(&user) {
                            Some(other) => new = boot::settings_handed_over(&old, &own, &other),
                            None => keeps(&settings.join("; "), &user, left),
                        },
                    }
                }
            }
            if new == old {
                edits.extend(editor.needless_copy(file, &old)?);
            } else {
                edits.push(Edit { file: file.to_owned(), old: Some(old), new: Some(new) });
            }
        }
        let is_i2c = self.device.way.iter().any(|way| way.bus == Kind::I2c);
        if is_i2c
            && self.others().all(|one| !matches!(one.what, Resource::I2c(..)))
            && let Some(text) = editor.read(Path::new(MODULES))?.filter(|text| text == I2C_DEV)
        {
            edits.push(Edit { file: MODULES.into(), old: Some(text), new: None });
        }
        Ok(edits)
    }

    /// The uses of other sections than the device's own.
    fn others(&self) -> impl Iterator<Item = &Use> {
        let own = self.target.map(|target| target.file(&self.device.file(self.name)));
        let is_own = move |one: &Use| own.as_deref().is_some_and(|own| Target::is_use_of(one, own));
        self.uses.all.iter().filter(move |one| matches!(one.source, Source::Printer(_)) && !is_own(one))
    }

    /// A section that needs a bus of this kind, with its file.
    fn user_of(&self, board: &Board, kind: Kind) -> Option<(String, PathBuf)> {
        let bus = board.bus.get(&kind)?;
        let is_user = |one: &&Use| one.what.function() == Some(function(&bus.node));
        let one = self.others().find(is_user)?;
        Some((one.user.clone(), one.place.rsplit_once(':').map_or_else(PathBuf::new, |(file, _)| file.into())))
    }

    /// A section that needs this line of config.txt, with its file.
    fn user(&self, board: &Board, line: &str) -> Option<(String, PathBuf)> {
        let buses = board.bus.iter().filter(|(_, bus)| bus.enable.iter().any(|own| own == line));
        let mut by_bus = buses.filter_map(|(kind, _)| {
            // The clock is held for LEDs only.
            let is_clock = *kind == Kind::Leds && !line.starts_with("dt");
            self.user_of(board, *kind).filter(|(user, _)| !is_clock || user.starts_with("[neopixel"))
        });
        by_bus.next().or_else(|| self.user_of_line(line))
    }

    /// A section of a device that has this line as its own: a faster bus, or the driver of a chip.
    fn user_of_line(&self, line: &str) -> Option<(String, PathBuf)> {
        let target = self.target?;
        let file = target.file(&self.device.file(self.name));
        // The place of an overlay is in its line.
        let is_line = |own: &String| {
            own.split("{select}").next().is_some_and(|head| own == line || head != own && line.starts_with(head))
        };
        let ways = || {
            let all = self.catalog.devices.iter().flat_map(|device| device.way.iter().map(move |way| (device, way)));
            all.filter(|(_, way)| way.config_txt.iter().any(is_line))
        };
        let needs = |section: &&Section| {
            ways().any(|(device, way)| match &way.driver {
                Some(driver) => section.text("sensor_pin").is_some_and(|pin| pin.contains(&format!("{driver}/"))),
                None => way.bus == Kind::I2c && section.text("i2c_bus").is_some() && device.is_chip_of(section),
            })
        };
        let section = target.others(&file).find(needs)?;
        Some((format!("[{}]", section.name), target.config().files_of(&section.name).next()?.to_owned()))
    }

    /// The name of the file in `pinion/` that has this section.
    fn of_ours(&self, (_, file): &(String, PathBuf)) -> Option<String> {
        file.starts_with(self.target?.folder()).then(|| Some(file.file_stem()?.to_str()?.to_owned()))?
    }
}
