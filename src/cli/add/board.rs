// SPDX-License-Identifier: GPL-3.0-or-later
//! A board that is known: its header, its buses, and how its boot loader enables them.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::catalog::{Kind, Way};
use crate::cli::computer::Computer;

/// A board.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct KnownBoard {
    pub(super) name: String,
    /// How the device tree's model begins.
    models: Vec<String>,
    /// A text in a file that a board with the same model does not have.
    marker: Option<Marker>,
    pub(super) boot: Boot,
    /// The files with the boot loader's settings. The first one that is there counts.
    pub(super) files: Vec<String>,
    /// Sections of config.txt that apply to each of the models.
    #[serde(default)]
    pub(super) sections: Vec<String>,
    /// The voltage of the lines.
    pub(super) level: String,
    /// The labels of the header's pins, from pin 1 on.
    pub(super) pins: Vec<String>,
    /// The name of a connector that is no header with numbered pins.
    pub(super) connector: Option<String>,
    /// The lines in printer.cfg by their pin.
    pub(super) lines: BTreeMap<String, String>,
    /// The pins for lines that nothing else needs, the best one first.
    pub(super) free: Vec<usize>,
    /// The functions on the header.
    pub(super) bus: BTreeMap<Kind, Bus>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Marker {
    file: String,
    text: String,
}

/// The way to enable something in a board's boot loader.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
pub(super) enum Boot {
    /// A Raspberry Pi's config.txt.
    #[serde(rename = "config.txt")]
    ConfigTxt,
    /// `overlays=` in armbianEnv.txt, BoardEnv.txt or orangepiEnv.txt.
    #[serde(rename = "overlays")]
    Overlays,
}

/// A bus of a board.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Bus {
    /// Its name: a node in /dev, a 1-Wire bus, a PWM channel of printer.cfg, or a serial port.
    pub(super) node: String,
    /// Its pins.
    pub(super) pins: BTreeMap<String, usize>,
    /// The lines of config.txt that enable it.
    #[serde(default)]
    pub(super) enable: Vec<String>,
    /// The overlays that enable it on different images, each with its parameters. The first one that the image has
    /// counts.
    #[serde(default)]
    pub(super) overlays: Vec<Vec<String>>,
    /// Another chip select of the same controller.
    pub(super) also: Option<Spot>,
    /// Overlays that use the same pins.
    #[serde(default)]
    pub(super) excludes: Vec<String>,
}

/// A place on a bus for one device.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Spot {
    pub(super) node: String,
    pub(super) pins: BTreeMap<String, usize>,
}

impl Bus {
    /// Its places for devices, the best one first.
    pub(super) fn spots(&self) -> impl Iterator<Item = Spot> {
        [Spot { node: self.node.clone(), pins: self.pins.clone() }].into_iter().chain(self.also.clone())
    }
}

/// A wire to make.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Wire {
    /// The device's pin.
    pub(super) chip: String,
    /// Its role, as in [`Way::wires`].
    pub(super) role: String,
    /// The pin of the board's header, from 1 on.
    pub(super) pin: usize,
}

/// Whether a line of the header is among these. Each of its names counts: GPIO17, gpio17, gpiochip0/gpio17,
/// pinctrl-bcm2711/gpio17.
fn is_among(taken: &BTreeSet<String>, line: &str) -> bool {
    let name_of = |line: &str| line.rsplit('/').next().unwrap_or(line).to_ascii_lowercase();
    let is_of_header =
        |other: &str| !other.contains('/') || other.starts_with("gpiochip") || other.starts_with("pinctrl-");
    taken.iter().any(|other| other == line || is_of_header(other) && name_of(other) == name_of(line))
}

impl KnownBoard {
    /// Whether a computer with this model is this board.
    pub(super) fn is_here(&self, model: &str, computer: &Computer) -> bool {
        let is_marked = self.marker.as_ref().is_none_or(|marker| {
            let text = computer.text(&marker.file).unwrap_or_default();
            text.lines().any(|line| line.split('#').next().unwrap_or_default().trim() == marker.text)
        });
        is_marked && self.models.iter().any(|name| model.starts_with(name.as_str()))
    }

    /// Whether a device can be connected in this way.
    pub(super) fn has(&self, way: &Way) -> bool {
        let roles = way.wires.iter().filter(|(_, role)| role.starts_with("line")).count();
        let has_bus = way.bus == Kind::Line || self.bus.contains_key(&way.bus);
        has_bus && self.free.len() >= roles && (way.driver.is_none() || self.boot == Boot::ConfigTxt)
    }

    /// The line of a pin, as printer.cfg writes it.
    pub(super) fn line(&self, pin: usize) -> Option<&str> {
        self.lines.get(&pin.to_string()).map(String::as_str)
    }

    /// The places on the header for a device that is connected in this way, the best one first.
    pub(super) fn spots(&self, way: &Way) -> impl Iterator<Item = Spot> {
        self.bus.get(&way.bus).into_iter().flat_map(Bus::spots)
    }

    /// A place on the header for a device that is connected in this way. `uses` says whether printer.cfg uses a node for
    /// another device. `taken` are lines that are in use.
    ///
    /// # Errors
    ///
    /// One line: another device is there.
    pub(super) fn spot(
        &self,
        way: &Way,
        uses: &dyn Fn(Kind, &str) -> Option<String>,
        taken: &BTreeSet<String>,
    ) -> Result<Spot, String> {
        if !self.bus.contains_key(&way.bus) {
            return Ok(Spot::default());
        }
        let controller = |node: &str| node.split('.').next().unwrap_or_default().to_owned();
        let is_shared = way.bus == Kind::I2c || way.bus == Kind::W1;
        // LEDs and an HX711 take every transfer on the data output for theirs.
        let is_alone = way.bus == Kind::Leds || way.bus == Kind::Spi && !way.wires.iter().any(|(_, role)| role == "cs");
        let mut refusal = String::new();
        for spot in self.spots(way) {
            let others = self.bus.iter().flat_map(|(kind, other)| other.spots().map(move |other| (*kind, other)));
            let mut others = others.filter(|(kind, _)| *kind != way.bus || !is_shared);
            let conflict = others.find_map(|(kind, other)| {
                let section = uses(kind, &other.node)?;
                let wants_all = is_alone || ["neopixel", "load_cell"].iter().any(|name| section.starts_with(name));
                let is_same = controller(&other.node) == controller(&spot.node);
                let crosses = other.pins.values().any(|pin| spot.pins.values().any(|own| own == pin));
                let conflicts = other.node == spot.node || if is_same { wants_all } else { crosses };
                conflicts.then(|| format!("[{section}] in printer.cfg uses {}, whose pins it would need", other.node))
            });
            // The wire of 1-Wire goes where config.txt has it.
            let conflict = conflict.or_else(|| self.taken_by_another(&spot, taken).filter(|_| way.bus != Kind::W1));
            match conflict {
                None => return Ok(spot),
                Some(conflict) => refusal = conflict,
            }
        }
        Err(refusal)
    }

    /// The pin of this place that printer.cfg uses for something else.
    fn taken_by_another(&self, spot: &Spot, taken: &BTreeSet<String>) -> Option<String> {
        // On a Raspberry Pi the label of a bus's pin begins with the line's name.
        let label = |pin: usize| self.pins.get(pin - 1).and_then(|label| label.split(' ').next()).unwrap_or_default();
        let is_taken = |pin: &&usize| label(**pin).starts_with("GPIO") && is_among(taken, label(**pin));
        let pin = *spot.pins.values().find(is_taken)?;
        Some(format!("printer.cfg uses {} (pin {pin}) for something else, and the bus needs it", label(pin)))
    }

    /// The wires to make. `taken` are lines that are in use. `wanted` is the pin that the user has chosen for the first
    /// line.
    ///
    /// # Errors
    ///
    /// One line: no line is free, or the chosen pin has no line.
    pub(super) fn wires(
        &self,
        way: &Way,
        spot: &Spot,
        taken: &BTreeSet<String>,
        wanted: Option<usize>,
    ) -> Result<Vec<Wire>, String> {
        if let Some(conflict) = self.taken_by_another(spot, taken) {
            return Err(conflict);
        }
        let own: BTreeSet<usize> = spot.pins.values().copied().collect();
        let is_taken = |line: &str| is_among(taken, line);
        let is_free = |pin: &usize| !own.contains(pin) && self.line(*pin).is_some_and(|line| !is_taken(line));
        let mut free = self.free.iter().copied().filter(is_free).filter(|pin| Some(*pin) != wanted);
        let mut wires = Vec::new();
        for (chip, role) in &way.wires {
            let labeled = |label: &str| self.pins.iter().position(|pin| pin == label).map(|at| at + 1);
            let pin = match role.as_str() {
                "3v3" => labeled("3.3 V"),
                "5v" => labeled("5 V"),
                "gnd" => labeled("GND"),
                "line" if wanted.is_some() => {
                    let usable = wanted.filter(is_free);
                    Some(usable.ok_or_else(|| {
                        let pins: Vec<String> =
                            self.free.iter().filter(|pin| is_free(pin)).map(usize::to_string).collect();
                        format!("--pin: this pin has no free line: choose one of {}", pins.join(", "))
                    })?)
                }
                role if role.starts_with("line") => free.next(),
                role => spot.pins.get(role).copied(),
            };
            let pin = pin.ok_or_else(|| format!("{} has no free pin for {chip}: see pinion pins --free", self.name))?;
            wires.push(Wire { chip: chip.clone(), role: role.clone(), pin });
        }
        Ok(wires)
    }
}
