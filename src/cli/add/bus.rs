// SPDX-License-Identifier: GPL-3.0-or-later
//! The bus of a device: whether it is there, and the changes at boot that enable it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::board::{Boot, Bus, KnownBoard};
use super::catalog::{Device, Kind};
use super::change::{Change, Record};
use super::printer::Printer;
use super::splice::Splice;
use super::{BUS, Work, boot, system};

/// The file that loads the driver of /dev/i2c-*.
const MODULES: &str = "/etc/modules-load.d/pinion-i2c-dev.conf";

/// The key of the change that loads this driver.
const I2C_DEV: &str = "i2c-dev";
/// The key of the line of overlays, which all of them share.
const OVERLAYS: &str = "overlays=";

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

/// The key of the change that makes this line of config.txt, or that loads the overlay of this node.
fn key(what: &str) -> String {
    format!("{BUS} {what}")
}

/// The keys of the changes that enable a bus.
fn keys(board: &KnownBoard, kind: Kind, bus: &Bus) -> Vec<String> {
    let mut keys: Vec<String> = match board.boot {
        Boot::ConfigTxt => bus.enable.iter().map(|line| key(line)).collect(),
        Boot::Overlays => vec![key(&bus.node), OVERLAYS.to_owned()],
    };
    if kind == Kind::I2c {
        keys.push(I2C_DEV.to_owned());
    }
    keys
}

/// The keys of the changes that enable buses for other sections of printer.cfg than the device's own, with the section.
pub(super) fn in_use(board: &KnownBoard, printer: &Printer, device: &Device) -> BTreeMap<String, String> {
    let users = board.bus.iter().filter_map(|(kind, bus)| {
        let user = bus.spots().find_map(|spot| printer.user(device, *kind, &spot.node))?;
        let user = format!("[{user}] in printer.cfg");
        Some(keys(board, *kind, bus).into_iter().map(move |key| (key, user.clone())))
    });
    users.flatten().collect()
}

impl Work<'_> {
    /// Puts the wire of 1-Wire at the line that config.txt names.
    pub(super) fn move_w1(&mut self) -> Result<(), String> {
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

    /// The changes that give the board the bus, and whether it is there.
    pub(super) fn plan_boot(&self) -> Result<(Record, State), String> {
        let mut record = Record::default();
        let Some(bus) = self.board.bus.get(&self.way.bus) else { return Ok((record, State::There)) };
        // The driver of a chip brings its bus in its own lines.
        let without_driver = self.way.driver.is_none();
        if without_driver {
            record.needs = keys(self.board, self.way.bus, bus);
        }
        record.needs.extend(self.way.config_txt.iter().map(|line| key(line)));
        let is_there = self.is_there(self.node());
        let file = self.computer.first(&self.board.files.iter().map(String::as_str).collect::<Vec<_>>());
        let side = system(self.computer);
        let mut wanted: Vec<&str> = Vec::new();
        // A bus that is there stays as it is: the user may have enabled it.
        // But LEDs also need a clock that stays.
        if without_driver && (!is_there || self.way.bus == Kind::Leds) {
            wanted.extend(bus.enable.iter().map(String::as_str));
        }
        if without_driver || !is_there {
            wanted.extend(self.way.config_txt.iter().map(String::as_str));
        }
        let splices: Vec<(String, Splice)> = match (self.board.boot, file) {
            (Boot::ConfigTxt, Some(file)) if !wanted.is_empty() => {
                let text = side.read(Path::new(file))?.unwrap_or_default();
                let lines = boot::config_txt(&text, &self.board.sections, self.device.name, &wanted);
                lines.into_iter().map(|(line, splice)| (key(&line), splice)).collect()
            }
            (Boot::Overlays, Some(file)) if !is_there => {
                let text = side.read(Path::new(file))?.unwrap_or_default();
                let splices = boot::overlays(&text, bus, &self.overlays()).map_err(|why| format!("{file}: {why}"))?;
                let is_line = |splice: &Splice| splice.new.trim() == OVERLAYS;
                let key_of = |splice: &Splice| if is_line(splice) { OVERLAYS.to_owned() } else { key(&bus.node) };
                splices.into_iter().map(|splice| (key_of(&splice), splice)).collect()
            }
            (_, None) if !is_there => {
                return Err(format!("none of {} is there: enable {} by hand", self.board.files.join(", "), bus.node));
            }
            _ => Vec::new(),
        };
        let change = |(key, splice)| Change { key, file: file.unwrap_or_default().into(), makes: false, splice };
        record.changes.extend(splices.into_iter().map(change));
        if is_there && record.changes.is_empty() {
            return Ok((record, State::There));
        }
        let mut state = State::Due;
        if self.way.bus == Kind::I2c && !is_there && self.needs_i2c_dev()? {
            let splice = Splice::insert(0, "# Written by pinion add: /dev/i2c-*\ni2c-dev\n".to_owned());
            if record.changes.is_empty() && self.computer.path(format!("/sys/bus/i2c/devices/{}", bus.node)).exists() {
                state = State::NotLoaded;
            }
            record.changes.push(Change { key: I2C_DEV.to_owned(), file: MODULES.into(), makes: true, splice });
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
}
