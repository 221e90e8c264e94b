// SPDX-License-Identifier: GPL-3.0-or-later
//! The boards that are known, one file in `boards` for each: the header, its lines and buses, and how the boot loader
//! enables the buses.
//!
//! To add one, write its file and name it in [`BOARDS`]. The tests check it.

use std::collections::BTreeMap;

use pinion_linux::foreign::word;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::Computer;

/// TOML files beside the calling file that become part of the program, by their names without the ending.
#[macro_export]
macro_rules! files {
    ($folder:literal: $($name:literal)*) => {
        [$(($name, include_str!(concat!($folder, "/", $name, ".toml")))),*]
    };
}

/// The names of such files.
pub const fn names<const COUNT: usize>(files: &[(&'static str, &'static str); COUNT]) -> [&'static str; COUNT] {
    let mut names = [""; COUNT];
    let mut at = 0;
    while at < COUNT {
        names[at] = files[at].0;
        at += 1;
    }
    names
}

/// Reads such a file.
///
/// # Errors
///
/// Its mistake. The tests find it before a user does.
pub fn parse<T: DeserializeOwned>(name: &str, text: &str) -> Result<T, String> {
    toml::from_str(text).map_err(|error| format!("this is a bug in Pinion: {name}.toml: {error}"))
}

/// Each board by its name on the command line. The first one that fits counts.
const BOARDS: [(&str, &str); 9] = files!("boards": "raspberry-pi-3" "raspberry-pi-4" "raspberry-pi-5" "btt-pad7" "btt-cb1" "btt-cb2"
    "orange-pi-3-lts" "orange-pi-zero-2" "radxa-zero-3");

/// A kind of connection.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq, PartialOrd, Ord)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// SPI, with the controller's own chip select.
    Spi,
    /// I2C.
    I2c,
    /// 1-Wire.
    W1,
    /// The data output of an SPI controller, for LEDs.
    Leds,
    /// A hardware PWM channel.
    Pwm,
    /// A serial port.
    Uart,
    /// GPIO lines only.
    Line,
}

impl Kind {
    /// Its name, for people.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Spi => "SPI",
            Kind::I2c => "I2C",
            Kind::W1 => "1-Wire",
            Kind::Leds => "SPI for LEDs",
            Kind::Pwm => "hardware PWM",
            Kind::Uart => "serial port",
            Kind::Line => "GPIO lines",
        }
    }
}

/// The maker of a board's processor. It decides the names of lines.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum Maker {
    /// Broadcom, and RP1: a Raspberry Pi.
    #[default]
    Raspberry,
    /// Allwinner.
    Allwinner,
    /// Rockchip.
    Rockchip,
}

/// A board.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Its name on the command line, and of its file.
    #[serde(skip)]
    pub id: &'static str,
    /// Its name, for people.
    pub name: String,
    /// The device tree's models, without the revision behind them.
    models: Vec<String>,
    /// A text in a file that a board with the same model does not have.
    marker: Option<Marker>,
    /// The maker of its processor.
    #[serde(default)]
    pub maker: Maker,
    /// How its boot loader is configured.
    pub boot: Boot,
    /// The files with the boot loader's settings. The first one that is there counts.
    pub files: Vec<String>,
    /// The voltage of the lines.
    pub level: String,
    /// The labels of the header's pins, from pin 1 on.
    pub pins: Vec<String>,
    /// The name of a connector that is no header with numbered pins.
    pub connector: Option<String>,
    /// The lines in printer.cfg by their pin.
    pub lines: BTreeMap<String, String>,
    /// The pins for lines that nothing else needs, the best one first.
    pub free: Vec<usize>,
    /// The pins for lines that are pulled up until Pinion starts, the best one first.
    #[serde(default)]
    pub up: Vec<usize>,
    /// The PWM channel of each pin that can have one.
    #[serde(default)]
    pub pwm: BTreeMap<String, u32>,
    /// The functions on the header.
    pub bus: BTreeMap<Kind, Bus>,
    /// The clock from which the processor makes that of SPI, if it changes.
    pub clock: Option<Clock>,
}

/// The VPU's clock of some Raspberry Pis.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Clock {
    /// The sections of config.txt that apply to the processors with this clock.
    pub sections: Vec<String>,
    /// `core_freq` and `core_freq_min`, if config.txt does not set them.
    pub usual_mhz: u32,
    /// `core_freq_min`, if config.txt does not set it.
    pub slowest_mhz: u32,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Marker {
    file: String,
    text: String,
}

/// The way to enable something in a board's boot loader.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
pub enum Boot {
    /// A Raspberry Pi's config.txt.
    #[serde(rename = "config.txt")]
    ConfigTxt,
    /// `overlays=` in armbianEnv.txt, BoardEnv.txt or orangepiEnv.txt.
    #[serde(rename = "overlays")]
    Overlays,
}

/// A bus of a board.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bus {
    /// Its name: a node in /dev, a 1-Wire bus, a PWM channel of printer.cfg, or a serial port.
    pub node: String,
    /// Its pins.
    pub pins: BTreeMap<String, usize>,
    /// Further pins that the controller holds once it is enabled, such as its other chip selects.
    #[serde(default)]
    pub holds: Vec<usize>,
    /// The lines of config.txt that enable it.
    #[serde(default)]
    pub enable: Vec<String>,
    /// The overlays that enable it on different images, each with its parameters. The first one that the image has
    /// counts.
    #[serde(default)]
    pub overlays: Vec<Vec<String>>,
    /// Another chip select of the same controller.
    also: Option<Slot>,
}

/// A place on a bus for one device.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slot {
    /// Its name in /dev, or below /sys.
    pub node: String,
    /// The header pin of each of its signals.
    pub pins: BTreeMap<String, usize>,
}

impl Bus {
    /// Its places for devices, the best one first.
    pub fn spots(&self) -> impl Iterator<Item = Slot> {
        [Slot { node: self.node.clone(), pins: self.pins.clone() }].into_iter().chain(self.also.clone())
    }

    /// All pins that it has when it is enabled.
    pub fn all_pins(&self) -> impl Iterator<Item = usize> {
        self.spots().flat_map(|spot| spot.pins.into_values()).chain(self.holds.iter().copied())
    }
}

/// The function of a node, which all its users share: `spi0` of `spidev0.1`, `i2c1` of `i2c-1`.
pub fn function(node: &str) -> String {
    match (node.strip_prefix("spidev"), node.strip_prefix("i2c-")) {
        (Some(numbers), _) => format!("spi{}", numbers.split('.').next().unwrap_or_default()),
        (_, Some(number)) => format!("i2c{number}"),
        _ if node.starts_with("w1_") => "w1".to_owned(),
        _ if node.contains(".pwm/") => "pwm".to_owned(),
        _ => node.to_owned(),
    }
}

/// All known boards.
///
/// # Errors
///
/// The first file with a mistake. The tests find it before a user does.
pub fn all() -> Result<Vec<Board>, String> {
    let board = |(id, text): (&'static str, &str)| Ok(Board { id, ..parse(id, text)? });
    BOARDS.into_iter().map(board).collect()
}

/// The names of the boards on the command line.
pub const NAMES: [&str; BOARDS.len()] = names(&BOARDS);

impl Board {
    /// The board that this computer is, or the one that has this name.
    ///
    /// # Errors
    ///
    /// One line: no board has the name.
    pub fn of(computer: &Computer, named: Option<&str>) -> Result<Option<Board>, String> {
        let mut boards = all()?.into_iter();
        match named {
            Some(name) => match boards.find(|board| board.id == name) {
                Some(board) => Ok(Some(board)),
                None => Err(format!("--board: there is no board \"{name}\": choose one of {}", NAMES.join(", "))),
            },
            None => Ok(boards.find(|board| board.is_here(computer))),
        }
    }

    fn is_here(&self, computer: &Computer) -> bool {
        let is_marked = self.marker.as_ref().is_none_or(|marker| {
            let text = computer.text(&marker.file).unwrap_or_default();
            text.lines().any(|line| line.split('#').next().unwrap_or_default().trim() == marker.text)
        });
        let model = model(computer);
        // Raspberry Pi's firmware adds the revision. A name that only begins like this is another board's.
        let model = model.split(" Rev ").next().unwrap_or_default();
        is_marked && self.models.iter().any(|name| name == model)
    }

    /// The file with the boot loader's settings.
    pub fn file(&self, computer: &Computer) -> Option<&str> {
        self.files.iter().map(String::as_str).find(|file| computer.exists(file))
    }

    /// The line of a pin, as printer.cfg writes it.
    pub fn line(&self, pin: usize) -> Option<&str> {
        self.lines.get(&pin.to_string()).map(String::as_str)
    }

    /// The label of a pin.
    pub fn label(&self, pin: usize) -> &str {
        pin.checked_sub(1).and_then(|at| self.pins.get(at)).map_or("", String::as_str)
    }

    /// The first word of a pin's label: on a Raspberry Pi the line's name, and with others the maker's name.
    pub fn line_label(&self, pin: usize) -> &str {
        self.label(pin).split(' ').next().unwrap_or_default()
    }
}

/// The device tree's model, or the board that the user has named.
pub fn model(computer: &Computer) -> String {
    let model = computer.text("/proc/device-tree/model").map(|model| model.trim_end_matches('\0').to_owned());
    model.or_else(|| computer.board.clone()).unwrap_or_default()
}

/// Whether this is a Raspberry Pi.
pub fn is_pi(computer: &Computer) -> bool {
    model(computer).contains("Raspberry Pi")
}

/// Whether this is a Raspberry Pi 5, 500 or Compute Module 5.
pub fn is_pi5(computer: &Computer) -> bool {
    ["Raspberry Pi 5", "Raspberry Pi Compute Module 5"].iter().any(|name| model(computer).starts_with(name))
}

/// A Raspberry Pi's config.txt.
pub fn pi_config(computer: &Computer) -> Option<&'static str> {
    computer.first(&["/boot/firmware/config.txt", "/boot/config.txt"])
}

/// The command that adds these lines to a Raspberry Pi's config.txt. The file's last line may have no end.
pub fn append(computer: &Computer, lines: &str) -> String {
    let config = pi_config(computer).map_or_else(|| "/boot/firmware/config.txt".into(), |config| computer.path(config));
    format!("printf '\\n[all]\\n{lines}\\n' | sudo tee -a {}", word(config.display()))
}
