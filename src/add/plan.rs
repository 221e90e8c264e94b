// SPDX-License-Identifier: GPL-3.0-or-later
//! The bus of a device: whether it is there, and the changes at boot that enable it.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::boot;
use super::edit::{Edit, Editor};
use super::place::config_lines;
use super::work::{State, Work};
use pinion_system::Computer;
use pinion_system::board::{Boot, Kind};

/// The file that loads the driver of /dev/i2c-*.
pub(super) const MODULES: &str = "/etc/modules-load.d/pinion-i2c-dev.conf";
/// Its text.
pub(super) const I2C_DEV: &str = "# Written by pinion add: /dev/i2c-*\ni2c-dev\n";

impl Work<'_> {
    /// The changes that give the board the bus, and whether it is there.
    pub(super) fn plan_boot(&self) -> Result<(Vec<Edit>, State), String> {
        let Some(bus) = self.board.bus.get(&self.way.bus) else { return Ok((Vec::new(), State::There)) };
        let is_there = self.is_there(self.node());
        let file = self.board.file(self.computer);
        let editor = Editor::new(self.computer, None);
        let own = config_lines(self.way, &self.spot);
        let device = self.device.file(self.name());
        let mut edits = Vec::new();
        // The driver of a chip brings its bus in its own lines.
        let without_driver = self.way.driver.is_none();
        let mut wanted: Vec<String> = Vec::new();
        // A bus that is there stays as it is: the user may have enabled it.
        // But LEDs also need a clock that stays.
        if without_driver && (!is_there || self.way.bus == Kind::Leds) {
            wanted.extend(bus.enable.iter().cloned());
        }
        if without_driver || !is_there {
            wanted.extend(own);
        }
        let new = match (self.board.boot, file) {
            (Boot::ConfigTxt, Some(file)) if !wanted.is_empty() => {
                let text = editor.read(Path::new(file))?.unwrap_or_default();
                let new = boot::config_txt(&text, &self.search.uses.config_txt, &device, &wanted);
                Some((file, text, new))
            }
            (Boot::Overlays, Some(file)) if !is_there => {
                let text = editor.read(Path::new(file))?.unwrap_or_default();
                let new = boot::overlays(&text, bus, &overlays(self.computer), &device);
                let new = new.map_err(|why| format!("{file}: {why}"))?;
                Some((file, text, new))
            }
            (_, None) if !is_there => {
                let files = self.board.files.join(" nor ");
                return Err(format!("there is no {files}: enable {} by hand", self.node()));
            }
            _ => None,
        };
        edits.extend(new.filter(|(_, old, new)| old != new).map(|(file, old, new)| Edit {
            file: file.into(),
            old: Some(old),
            new: Some(new),
        }));
        if is_there && edits.is_empty() {
            return Ok((edits, State::There));
        }
        let mut state = State::Due;
        if self.way.bus == Kind::I2c && !is_there && needs_i2c_dev(self.computer) {
            if edits.is_empty() && self.computer.exists(format!("/sys/bus/i2c/devices/{}", self.node())) {
                state = State::NotLoaded;
            }
            edits.push(Edit { file: MODULES.into(), old: None, new: Some(I2C_DEV.to_owned()) });
        }
        Ok((edits, state))
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
        self.computer.exists(path)
    }
}

/// Whether nothing loads i2c-dev at boot.
fn needs_i2c_dev(computer: &Computer) -> bool {
    let files = computer.matching("/etc/modules-load.d/*.conf");
    let files = files.iter().map(|file| computer.name(file)).chain([PathBuf::from("/etc/modules")]);
    let mut lines = files.filter_map(|file| computer.text(file));
    !lines.any(|text| text.lines().any(|line| ["i2c-dev", "i2c_dev"].contains(&line.trim())))
}

/// The names of the image's overlays.
fn overlays(computer: &Computer) -> BTreeSet<String> {
    let patterns = ["/boot/dtb*/overlay/*.dtbo", "/boot/dtb*/*/overlay/*.dtbo", "/boot/overlay-user/*.dtbo"];
    let files = patterns.iter().flat_map(|pattern| computer.matching(pattern));
    files.filter_map(|file| Some(file.file_stem()?.to_str()?.to_owned())).collect()
}
