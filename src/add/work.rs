// SPDX-License-Identifier: GPL-3.0-or-later
//! The steps of one device: the wires, the bus, the chip's answer, the sections, the first value.

use std::io;
use std::path::Path;
use std::process::{Command, ExitStatus};

use serde_json::json;

use super::catalog::{Catalog, Device, Wiring, is_line};
use super::edit::Editor;
use super::place::{Search, Wire};
use super::printer::Target;
use super::report::Report;
use super::{AddArgs, beside, command, make, moonraker_of, picture, refuse_while_printing};
use pinion_system::Computer;
use pinion_system::board::{Board, Slot};
use pinion_system::files::Output;
use pinion_system::instance::instances;
use pinion_system::klippy::configs;

/// A device on its way into a printer.
pub(super) struct Work<'a> {
    pub(super) args: &'a AddArgs,
    pub(super) computer: &'a Computer,
    pub(super) catalog: &'a Catalog,
    pub(super) board: &'a Board,
    pub(super) device: &'a Device,
    pub(super) way: &'a Wiring,
    /// The place on the bus.
    pub(super) spot: Slot,
    pub(super) search: Search<'a>,
    pub(super) report: &'a mut Report,
}

/// Whether a bus is there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    There,
    /// After a reboot.
    Due,
    /// After its driver is loaded.
    NotLoaded,
}

impl State {
    pub(super) fn name(self) -> &'static str {
        match self {
            State::There => "there",
            State::Due => "missing",
            State::NotLoaded => "not loaded",
        }
    }
}

impl Work<'_> {
    pub(super) fn name(&self) -> Option<&str> {
        self.args.name.as_deref()
    }

    /// Its section of printer.cfg.
    pub(super) fn section(&self) -> String {
        self.search.there.clone().unwrap_or_else(|| self.device.section(self.name()))
    }

    /// Does it. Without a printer, all but its configuration.
    pub(super) fn run(&mut self, target: Result<Target, String>) -> Result<(), String> {
        let written =
            target.as_ref().map(|target| target.written_pins(self.device, self.way, self.name())).unwrap_or_default();
        let wires = match &self.search.there {
            Some(_) => self.search.wires(self.device, self.way, &self.spot, &written, None)?,
            None => self.search.wires(self.device, self.way, &self.spot, &written, self.args.pin.as_deref())?,
        };
        self.draw(&wires)?;
        let moonraker = moonraker_of(self.args, self.computer, target.as_ref());
        let rests = moonraker.clone().and_then(|address| refuse_while_printing(self.computer, address.as_deref()));
        let may_ask = rests.is_ok();
        if !self.args.dry_run {
            rests?;
        }
        let moonraker = moonraker.unwrap_or_default();
        let (boot, mut state) = self.plan_boot()?;
        self.report.set("bus", json!(state.name()));
        if !boot.is_empty() {
            if !self.args.dry_run {
                self.refuse_half(target.as_ref())?;
            }
            make(
                self.args,
                moonraker.as_deref(),
                &Editor::new(self.computer, None),
                &boot,
                "Change these files?",
                self.report,
            )?;
            let is_live = self.computer.is_this() && !self.args.dry_run;
            if is_live && state == State::NotLoaded {
                state = loaded(Command::new("modprobe").arg("i2c-dev").status())?;
            } else if is_live {
                self.report.set("reboot", json!(true));
                self.report.line("The bus is there after a reboot. Connect the wires while the power is off:");
                self.report.line("  sudo poweroff");
                self.report.line(format_args!("Then run \"{}\" again.", command(self.args, false)));
                return Ok(());
            }
        }
        if self.computer.is_this() && state == State::Due && boot.is_empty() {
            return Err(format!(
                "{} is enabled but does not exist yet: reboot, then run \"{}\" again",
                self.node(),
                command(self.args, false)
            ));
        }
        let address = match self.computer.is_this() && state == State::There && may_ask {
            true => self.check(target.as_ref().ok())?,
            false => None,
        };
        self.configure(&target?, &wires, address, moonraker.as_deref())
    }

    pub(super) fn node(&self) -> &str {
        &self.spot.node
    }

    /// Fails if the sections could not be written: then the boot loader's settings stay as they are, too. Without any
    /// printer.cfg, they are all that changes.
    fn refuse_half(&self, target: Result<&Target, &String>) -> Result<(), String> {
        match target {
            Ok(target) => {
                let own = target.file(&self.device.file(self.name()));
                Editor::new(self.computer, Some(target.owner)).probe(target.files().chain([target.path.clone(), own]))
            }
            Err(_) if configs(self.computer).is_empty() => Ok(()),
            Err(why) => Err(why.clone()),
        }
    }

    fn draw(&mut self, wires: &[Wire]) -> Result<(), String> {
        let (board, device) = (self.board, self.device);
        let entry = |wire: &Wire| {
            let label = board.label(wire.pin);
            json!({ "device": wire.chip, "pin": wire.pin, "label": label, "line": board.line(wire.pin) })
        };
        self.report.set("wires", wires.iter().map(entry).collect());
        self.report.set("trap", json!(device.trap));
        self.report.line(format_args!("{} on {}, by {}", device.title, board.name, self.way.bus.name()));
        self.report.line("");
        self.report.page.append(&picture::page(board, wires));
        self.report.line("");
        self.report.line(format_args!("  level: {}", board.level));
        self.report.line(format_args!("  note:  {}", device.trap));
        for one in self.search.uses.unknown() {
            self.report.line(format_args!(
                "  note:  {}: Pinion does not know which pins the {} takes: compare them with these wires",
                one.place, one.user
            ));
        }
        let unknown: Vec<&String> = self.search.uses.unknown().map(|one| &one.place).collect();
        self.report.set("unknown", json!(unknown));
        self.report.line("");
        if let Some(path) = &self.args.picture {
            // Another file has probably a name by mistake.
            if std::fs::read(path).is_ok_and(|bytes| !bytes.starts_with(b"<svg ")) {
                return Err(format!("{} exists but is not a picture: name another file", path.display()));
            }
            let svg = picture::svg(board, &device.title, wires);
            Output::check(path, &[])?.write(|out| io::Write::write_all(out, svg.as_bytes()))?;
        }
        self.report.show()
    }

    /// Writes the sections, and has the host read them.
    fn configure(
        &mut self,
        target: &Target,
        wires: &[Wire],
        address: Option<u8>,
        moonraker: Option<&str>,
    ) -> Result<(), String> {
        let editor = Editor::new(self.computer, Some(target.owner));
        let (mcu, link, is_missing) = target.mcu(self.args.mcu.as_deref())?;
        if self.computer.is_this() && !self.args.dry_run && !serves(self.computer, &link) {
            // Without its MCU, klippy would not start with the new sections.
            let link = link.display();
            return Err(format!(
                "Pinion does not serve at {link}: sudo systemctl enable --now pinion-mcu, then \"{}\"",
                command(self.args, false)
            ));
        }
        let mut is_changed = false;
        if let Some(section) = &self.search.there {
            let place = target.config().section(section).map_or(String::new(), |section| section.place.to_string());
            self.report.line(format_args!(
                "[{section}] is already in printer.cfg ({place}), and stays as it is. For a second device: {} --name NAME",
                command(&AddArgs { name: None, ..self.args.clone() }, false)
            ));
        } else {
            let sections = self.sections(target, &mcu, wires, address)?;
            let edits =
                beside::plan(target, &editor, self.device, self.name(), &sections, is_missing.then_some(&*mcu))?;
            is_changed = !edits.is_empty();
            make(self.args, moonraker, &editor, &edits, "Write this?", self.report)?;
        }
        if self.args.dry_run {
            self.report.line("Nothing was changed (--dry-run).");
            return Ok(());
        }
        if !is_changed {
            self.report.line("Nothing is left to change.");
        }
        if let Some(moonraker) = moonraker {
            let is_own = self.search.there.is_none();
            let undo = format!("{} takes it back", command(self.args, true));
            self.measure(moonraker, is_changed).map_err(|why| if is_own { format!("{why}: {undo}") } else { why })?;
        }
        let next: Vec<String> = self.device.next.iter().map(|line| self.device.named(line, self.name())).collect();
        self.report.set("next", json!(next));
        self.report.line("Next:");
        next.iter().for_each(|line| self.report.line(format_args!("  {line}")));
        if self.device.resonance
            && let Some(remedy) = target.klippy(self.computer).and_then(|klippy| klippy.install_numpy(self.computer))
        {
            self.report.line(format_args!("SHAPER_CALIBRATE needs numpy first: {remedy}"));
        }
        self.report.line(format_args!("{} takes all of it back.", command(self.args, true)));
        Ok(())
    }

    /// The sections of printer.cfg.
    fn sections(&self, target: &Target, mcu: &str, wires: &[Wire], address: Option<u8>) -> Result<String, String> {
        let node = self.node();
        let mut text = self.device.named(&self.way.config, self.name()).replace("{mcu}", mcu);
        let address =
            address.or_else(|| self.search.addresses(self.way, &self.spot).first().copied()).unwrap_or_default();
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
        for wire in wires.iter().filter(|wire| is_line(&wire.role)) {
            let line = self.board.line(wire.pin).unwrap_or_default();
            text = text.replace(&format!("{{{}}}", wire.role), line);
        }
        if text.contains("{serial_no}") {
            let serial = self.thermometer(Some(target)).ok_or(
                "the thermometer's number is not known before it answers: boot the board with the thermometer, then run this command again",
            )?;
            text = text.replace("{serial_no}", &serial);
        }
        Ok(text)
    }
}

/// The bus is there once its driver is loaded, and the chip can be asked for its address.
fn loaded(modprobe: io::Result<ExitStatus>) -> Result<State, String> {
    match modprobe {
        Ok(status) if status.success() => Ok(State::There),
        _ => Err("modprobe i2c-dev failed: reboot, then run this command again".into()),
    }
}

/// Whether a Pinion serves at this link. Klipper's own program may also have made it.
fn serves(computer: &Computer, link: &Path) -> bool {
    link.exists() && instances(computer).0.iter().any(|one| one.pid.is_some() && one.link.as_deref() == Some(link))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A chip at its second address was configured with the first one, because nobody asked it.
    #[test]
    fn a_bus_whose_driver_was_just_loaded_is_asked() {
        assert_eq!(loaded(Command::new("true").status()), Ok(State::There));
        assert!(loaded(Command::new("false").status()).unwrap_err().starts_with("modprobe i2c-dev failed"));
    }
}
