// SPDX-License-Identifier: GPL-3.0-or-later
//! The place of a device on the header: the bus, the chip select and the lines that nobody uses.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use pinion_system::board::{Board, Kind, Slot, function};
use pinion_system::uses::{Resource, Source, Use, Uses, spi_node};

use super::catalog::{Device, Wiring, is_line};
use super::printer::Target;

/// A wire to make.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Wire {
    /// The device's pin.
    pub(crate) chip: String,
    /// Its role, as in [`Wiring::wires`].
    pub(crate) role: String,
    /// The pin of the board's header, from 1 on.
    pub(crate) pin: usize,
}

/// Everything that decides where a device can go.
pub(super) struct Search<'a> {
    pub(super) board: &'a Board,
    pub(super) uses: &'a Uses,
    /// The device's own file. What it uses is the device's.
    pub(super) own: Option<&'a Path>,
    /// The user's own section for the device, which is the device, too.
    pub(super) there: Option<String>,
}

/// The lines of config.txt that a way needs at this place.
pub(super) fn config_lines(way: &Wiring, spot: &Slot) -> Vec<String> {
    let select = spot
        .node
        .strip_prefix("spidev")
        .map_or(String::new(), |numbers| format!("spi{}", numbers.replacen('.', "-", 1)));
    way.config_txt.iter().map(|line| line.replace("{select}", &select)).collect()
}

impl Search<'_> {
    /// The user of a part other than the device itself.
    fn other<'a>(&'a self, what: &'a Resource, spot: &'a Slot, way: &'a Wiring) -> Option<&'a Use> {
        self.uses.of(what).find(|one| !self.is_own(one, spot, way))
    }

    /// Whether a use is the device's: its file, or the overlay that it needs.
    fn is_own(&self, one: &Use, spot: &Slot, way: &Wiring) -> bool {
        let is_overlay = || {
            let mut loaded = self.uses.config_txt.loaded.iter().filter(|loaded| loaded.place == one.place);
            loaded.any(|loaded| {
                let lines = config_lines(way, spot);
                lines.iter().filter_map(|line| line.strip_prefix("dtoverlay=")).any(|wanted| loaded.is(wanted))
            })
        };
        let is_section = self.there.as_ref().is_some_and(|section| one.user == format!("[{section}]"));
        let is_file = self.own.is_some_and(|own| Target::is_use_of(one, own));
        is_section || is_file || self.own.is_some() && one.source == Source::Boot && is_overlay()
    }

    /// The places for a device that is connected in this way, the best one first. PWM and 1-Wire are where the boot loader
    /// has them.
    pub(super) fn spots(&self, way: &Wiring) -> Vec<Slot> {
        let Some(bus) = self.board.bus.get(&way.bus) else { return vec![Slot::default()] };
        let spot = |mut spot: Slot| {
            spot.pins = self.uses.pins(self.board, &spot);
            let channel = spot.pins.get("pwm").and_then(|pin| self.board.pwm.get(&pin.to_string()));
            if let (Some(channel), Some((chip, _))) = (channel, spot.node.split_once('/')) {
                spot.node = format!("{chip}/pwm{channel}");
            }
            spot
        };
        bus.spots().map(spot).collect()
    }

    /// Why a device cannot be at this place.
    pub(super) fn conflict(&self, way: &Wiring, spot: &Slot) -> Option<String> {
        let told = |one: &Use, what: String| format!("{what} is used by {} ({})", one.user, one.place);
        let mut nodes = Vec::new();
        if let Some((bus, select)) = spi_node(&spot.node) {
            // LEDs and an HX711 take every transfer on the data output for theirs.
            let is_alone = way.bus == Kind::Leds || !way.wires.iter().any(|(_, role)| role == "cs");
            nodes.push(Resource::Controller(bus));
            match is_alone {
                true => nodes.extend(
                    self.uses
                        .all
                        .iter()
                        .map(|one| one.what.clone())
                        .filter(|what| matches!(what, Resource::Select(own, _) if *own == bus)),
                ),
                false => nodes.push(Resource::Select(bus, select)),
            }
        }
        match way.bus {
            Kind::Pwm => nodes.push(Resource::Pwm(spot.node.clone())),
            Kind::Uart => nodes.push(Resource::Port(spot.node.clone())),
            _ => {}
        }
        for node in &nodes {
            if let Some(one) = self.other(node, spot, way) {
                return Some(told(one, node.to_string()));
            }
        }
        let own = function(&spot.node);
        for pin in spot.pins.values() {
            let Some(line) = self.uses.names.of_pin(self.board, *pin) else { continue };
            let what = Resource::Line(line.clone());
            let mut others = self.uses.of(&what).filter(|one| one.function.as_deref() != Some(&*own));
            if let Some(one) = others.find(|one| !self.is_own(one, spot, way)) {
                return Some(told(one, format!("{line} (pin {pin})")));
            }
        }
        if way.bus == Kind::I2c && self.addresses(way, spot).is_empty() {
            let taken: Vec<String> = way.addresses.iter().map(|address| format!("{address:#04x}")).collect();
            return Some(format!("another chip has {} on {}", taken.join(" and "), spot.node));
        }
        None
    }

    /// The addresses that no other chip has on this bus.
    pub(super) fn addresses(&self, way: &Wiring, spot: &Slot) -> Vec<u8> {
        let bus = spot.node.strip_prefix("i2c-").and_then(|number| number.parse().ok()).unwrap_or_default();
        let is_free = |address: &&u8| self.other(&Resource::I2c(bus, Some(u16::from(**address))), spot, way).is_none();
        way.addresses.iter().filter(is_free).copied().collect()
    }

    /// Whether nothing else uses a line.
    fn is_free(&self, pin: usize, spot: &Slot, way: &Wiring) -> bool {
        let line = self.board.line(pin).and_then(|line| self.uses.names.line(line));
        line.is_some_and(|line| self.other(&Resource::Line(line), spot, way).is_none())
    }

    /// The pin that the user has named: `11`, or `GPIO17`.
    fn wanted(&self, text: &str) -> Option<usize> {
        text.parse().ok().or_else(|| {
            let line = self.uses.names.line(text).or_else(|| self.uses.names.meant(text, None))?;
            self.uses.names.pin(self.board, &line)
        })
    }

    /// The wires to make. `written` are the lines of an earlier call by their roles. `pin` is what the user has chosen for
    /// the first line.
    ///
    /// # Errors
    ///
    /// One line: no line is free, or the chosen pin has no line.
    pub(super) fn wires(
        &self,
        device: &Device,
        way: &Wiring,
        spot: &Slot,
        written: &BTreeMap<String, String>,
        pin: Option<&str>,
    ) -> Result<Vec<Wire>, String> {
        let board = self.board;
        let has_line = way.wires.iter().any(|(_, role)| role == "line");
        if pin.is_some() && !has_line {
            return Err(format!("--pin: {} needs no line here: leave out --pin", device.name));
        }
        let earlier = |role: &str| {
            let line = self.uses.names.line(written.get(role)?)?;
            self.uses.names.pin(board, &line)
        };
        let taken: BTreeSet<usize> =
            spot.pins.values().copied().chain(way.wires.iter().filter_map(|(_, role)| earlier(role))).collect();
        let is_free = |pin: usize| !taken.contains(&pin) && self.is_free(pin, spot, way);
        let chosen = match pin {
            None => None,
            Some(text) => {
                let named = self.wanted(text);
                if let (Some(there), Some(named)) = (earlier("line"), named)
                    && there != named
                {
                    return Err(format!(
                        "--pin: {} is already on {} (pin {there}): take that back with --undo first, or add a second device with --name",
                        device.name,
                        board.label(there)
                    ));
                }
                let usable = named.filter(|pin| is_free(*pin) || taken.contains(pin) && earlier("line") == Some(*pin));
                Some(usable.ok_or_else(|| {
                    let free = board.free.iter().filter(|pin| is_free(**pin));
                    let free: Vec<String> = free.map(|pin| format!("{pin} ({})", board.line_label(*pin))).collect();
                    format!("--pin: this pin has no free line: choose one of {}", free.join(", "))
                })?)
            }
        };
        let mut used: BTreeSet<usize> = chosen.into_iter().collect();
        let mut wires = Vec::new();
        for (chip, role) in &way.wires {
            let labeled = |label: &str| board.pins.iter().position(|pin| pin == label).map(|at| at + 1);
            let pin = match role.as_str() {
                "3v3" => labeled("3.3 V"),
                "5v" => labeled("5 V"),
                "gnd" => labeled("GND"),
                role if is_line(role) && earlier(role).is_some() => earlier(role),
                "line" if chosen.is_some() => chosen,
                role if is_line(role) => {
                    let first = if role == "up" { &board.up[..] } else { &[] };
                    first.iter().chain(&board.free).copied().find(|pin| is_free(*pin) && !used.contains(pin))
                }
                role => spot.pins.get(role).copied(),
            };
            let pin =
                pin.ok_or_else(|| format!("{} has no free pin for {chip}: see pinion pins --used", board.name))?;
            used.insert(pin);
            wires.push(Wire { chip: chip.clone(), role: role.clone(), pin });
        }
        Ok(wires)
    }
}
