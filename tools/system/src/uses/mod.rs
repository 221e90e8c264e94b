// SPDX-License-Identifier: GPL-3.0-or-later
//! Who uses what: every line, bus, chip select, address, PWM channel and serial port of the computer that something uses,
//! with its user and the place that says so.
//!
//! It is built once, from the kernel, the boot loader's settings, the configurations of all klippys, and Moonraker's. It is
//! a module beside [`Computer`], not a crate: it needs the computer's files, units and processes, which are here.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use indexmap::IndexSet;
use pinion_linux::Inventory;
use pinion_linux::sysfs::Sysfs;
use pinion_printer_config::Section;
use serde_json::{Value, json};

use super::Computer;
use super::board::{self, Board, Kind, Slot};
use super::klippy::configs;
use super::printer::{self, Printer};

pub mod boot;
mod lines;
mod services;

pub use lines::Names;

/// The user of a PWM channel that a program has exported.
pub const A_PROGRAM: &str = "a program";
/// Highest number of uses. A hostile file could name many.
const USES_MAX: usize = 4_000;

/// A part of the computer.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Resource {
    /// A GPIO line, by its one name.
    Line(String),
    /// A chip select of an SPI controller: `spidev0.1`.
    Select(u32, u32),
    /// All of an SPI controller: `spi0`. Its user takes every transfer for its own.
    Controller(u32),
    /// An I2C bus, and the address of a chip.
    I2c(u32, Option<u16>),
    /// A PWM channel: `fe20c000.pwm/pwm0`.
    Pwm(String),
    /// A serial port: `ttyAMA3`.
    Port(String),
    /// A sensor on 1-Wire.
    Sensor(String),
    /// Another device in /dev, such as a camera.
    Device(String),
    /// Anything: nobody knows what this overlay or this configuration takes.
    Unknown(String),
}

impl Resource {
    /// The function of a board that has it, as [`board::function`] names it.
    pub fn function(&self) -> Option<String> {
        match self {
            Resource::Select(bus, _) | Resource::Controller(bus) => Some(format!("spi{bus}")),
            Resource::I2c(bus, _) => Some(format!("i2c{bus}")),
            Resource::Sensor(_) => Some("w1".to_owned()),
            Resource::Pwm(name) | Resource::Port(name) => Some(board::function(name)),
            Resource::Line(_) | Resource::Device(_) | Resource::Unknown(_) => None,
        }
    }
}

impl std::fmt::Display for Resource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Resource::Line(name) | Resource::Pwm(name) | Resource::Port(name) | Resource::Sensor(name) => {
                f.write_str(name)
            }
            Resource::Device(name) => f.write_str(name),
            Resource::Select(bus, select) => write!(f, "spidev{bus}.{select}"),
            Resource::Controller(bus) => write!(f, "spi{bus}"),
            Resource::I2c(bus, None) => write!(f, "i2c.{bus}"),
            Resource::I2c(bus, Some(address)) => write!(f, "i2c.{bus} {address:#04x}"),
            Resource::Unknown(_) => f.write_str("anything"),
        }
    }
}

/// The evidence that something is used.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Source {
    /// The kernel: a driver, or a consumer of a line.
    Kernel,
    /// A file of the boot loader.
    Boot,
    /// This configuration of a klippy.
    Printer(PathBuf),
    /// Moonraker, or a camera server.
    Service,
}

/// A use of a part.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Use {
    /// The part.
    pub what: Resource,
    /// The user: a section, an overlay, a driver.
    pub user: String,
    /// The file and line, or the kernel's folder.
    pub place: String,
    /// The evidence.
    pub source: Source,
    /// The bus to which a line is switched. Another user of this bus is no conflict.
    pub function: Option<String>,
}

/// A pin in a configuration that is no line of this computer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NoLine {
    /// The pin, as it is written.
    pub pin: String,
    /// The section with the pin.
    pub section: String,
    /// The file and line.
    pub place: String,
    /// The line that is probably meant.
    pub meant: Option<String>,
}

/// All uses.
pub struct Uses {
    /// The names of its lines.
    pub names: Names,
    /// The board, if it is known.
    pub board: Option<Board>,
    /// The uses, each once, in the order in which they were found.
    pub all: IndexSet<Use>,
    /// The config.txt, if the board has one.
    pub config_txt: boot::ConfigTxt,
    /// The pins that are no lines.
    pub no_lines: Vec<NoLine>,
    /// The configurations of klippys that can be read, with this computer's MCUs in each.
    pub printers: BTreeMap<PathBuf, (Printer, BTreeMap<String, PathBuf>)>,
}

impl Uses {
    /// Finds all users. `also` is a configuration that klippy may not name, with the MCU in it that the user calls this
    /// computer's. The kernel's lines are those of `inventory`.
    pub fn find(
        computer: &Computer,
        board: Option<&Board>,
        also: Option<(&Path, Option<&str>)>,
        inventory: Option<&Inventory>,
    ) -> Uses {
        let names = Names::of(computer, board, inventory);
        let mut uses = Uses {
            names,
            board: board.cloned(),
            all: IndexSet::new(),
            config_txt: boot::ConfigTxt::read(computer, board),
            no_lines: Vec::new(),
            printers: BTreeMap::new(),
        };
        uses.add_boot(computer);
        // The number of uses is limited, so those that count most come first.
        if let Some((path, mcu)) = also {
            uses.add_host(computer, path, mcu);
        }
        uses.add_kernel(computer, inventory);
        for path in configs(computer).iter().filter(|path| also.is_none_or(|(also, _)| also != *path)) {
            uses.add_host(computer, path, None);
        }
        uses.add_other_services(computer);
        uses
    }

    /// Adds a klippy's configuration, and those of the services beside it.
    fn add_host(&mut self, computer: &Computer, path: &Path, mcu: Option<&str>) {
        match Printer::read(computer, path) {
            Ok(printer) => self.add_printer(computer, path, printer, mcu),
            Err(_) => self.add(Use {
                what: Resource::Unknown(path.display().to_string()),
                user: "unreadable configuration".to_owned(),
                place: path.display().to_string(),
                source: Source::Printer(path.to_owned()),
                function: None,
            }),
        }
        self.add_services(computer, path.parent().unwrap_or(Path::new("/")));
    }

    fn add(&mut self, one: Use) {
        if self.all.len() < USES_MAX {
            self.all.insert(one);
        }
    }

    /// Adds what a configuration uses on this computer's MCUs.
    fn add_printer(&mut self, computer: &Computer, path: &Path, printer: Printer, named: Option<&str>) {
        let own = printer.own_mcus(computer, named);
        let source = Source::Printer(path.to_owned());
        for section in printer.config.sections() {
            let user = format!("[{}]", section.name);
            let pins: Vec<_> = printer.pins_of(section).filter(|named| own.contains_key(&named.pin.chip)).collect();
            let place = |key: &str| section.place_of(key).to_string();
            let mut found: Vec<(Resource, String)> = Vec::new();
            let is_alone = ["neopixel", "dotstar", "load_cell", "load_cell_probe"].contains(&section.kind());
            for named in &pins {
                let name = named.pin.name.as_str();
                let at = named.setting.place.to_string();
                let what = match spi_node(name.split('/').next().unwrap_or_default()) {
                    Some((bus, _)) if is_alone => Resource::Controller(bus),
                    Some((bus, select)) => Resource::Select(bus, select),
                    None if name == "None" || name.starts_with("iio") || name.contains("voltage") => continue,
                    None if ["tty", "serial"].iter().any(|kind| name.starts_with(kind)) => {
                        Resource::Port(name.to_owned())
                    }
                    None if name.contains("/pwm") => Resource::Pwm(self.pwm_name(computer, name)),
                    None if name.starts_with("analog") => continue,
                    None => match self.names.line(name) {
                        Some(line) => Resource::Line(line),
                        None => {
                            let meant = self.names.meant(name, self.board.as_ref());
                            // The kernel may know a name of its own. Without the kernel, nobody can say.
                            if meant.is_none() && !self.names.knows_all() && printer::line_of(name).is_none() {
                                continue;
                            }
                            let section = section.name.clone();
                            self.no_lines.push(NoLine { pin: named.text.to_owned(), section, place: at, meant });
                            continue;
                        }
                    },
                };
                found.push((what, at));
            }
            if let Some((bus, select)) = section.text("spi_bus").and_then(spi_node).filter(|_| !pins.is_empty()) {
                found.push((Resource::Select(bus, select), place("spi_bus")));
            }
            let i2c_mcu = section.text("i2c_mcu").unwrap_or("mcu");
            if let Some(bus) = section.text("i2c_bus").and_then(i2c_number).filter(|_| own.contains_key(i2c_mcu)) {
                let address =
                    section.whole("i2c_address", 0).ok().flatten().and_then(|address| u16::try_from(address).ok());
                found.push((Resource::I2c(bus, address), place("i2c_bus")));
            }
            if let Some(serial) = section.text("serial_no") {
                found.push((Resource::Sensor(serial.to_owned()), place("serial_no")));
            }
            for (what, place) in found {
                self.add_with_pins(Use { what, user: user.clone(), place, source: source.clone(), function: None });
            }
        }
        self.printers.insert(path.to_owned(), (printer, own));
    }

    /// The section of printer.cfg that is a user.
    pub fn section(&self, one: &Use) -> Option<&Section> {
        let Source::Printer(path) = &one.source else { return None };
        self.printers.get(path)?.0.config.section(one.user.strip_prefix('[')?.strip_suffix(']')?)
    }

    /// Adds a use, and the lines that its bus has on the header.
    fn add_with_pins(&mut self, one: Use) {
        let node = match &one.what {
            Resource::Line(_) => None,
            Resource::I2c(bus, _) => Some(format!("i2c-{bus}")),
            Resource::Controller(bus) => Some(format!("spidev{bus}.")),
            Resource::Sensor(_) => Some("w1_".to_owned()),
            other => Some(other.to_string()),
        };
        if let (Some(node), Some(board)) = (node, self.board.clone()) {
            let spots = board.bus.values().flat_map(board::Bus::spots);
            for spot in
                spots.filter(|spot| spot.node == node || node.ends_with(['.', '_']) && spot.node.starts_with(&node))
            {
                let pins = self.pins(&board, &spot);
                let lines: Vec<String> = pins.values().filter_map(|pin| self.names.of_pin(&board, *pin)).collect();
                for line in lines {
                    self.add(Use {
                        what: Resource::Line(line),
                        function: Some(board::function(&spot.node)),
                        ..one.clone()
                    });
                }
            }
        }
        self.add(one);
    }

    /// The pins of a place. 1-Wire and PWM are where config.txt has them.
    pub fn pins(&self, board: &Board, spot: &Slot) -> BTreeMap<String, usize> {
        let function = board::function(&spot.node);
        let own = self.all.iter().find(|one| one.source == Source::Boot && one.function.as_deref() == Some(&*function));
        match (function.as_str(), own.map(|one| &one.what)) {
            ("w1" | "pwm", Some(Resource::Line(line))) => match self.names.pin(board, line) {
                Some(pin) => spot.pins.keys().map(|role| (role.clone(), pin)).collect(),
                None => spot.pins.clone(),
            },
            _ => spot.pins.clone(),
        }
    }

    /// A PWM channel by its chip's device: `pwmchip0/pwm1` is `fe20c000.pwm/pwm1`.
    fn pwm_name(&self, computer: &Computer, name: &str) -> String {
        let Some((chip, channel)) = name.split_once('/').filter(|(chip, _)| chip.starts_with("pwmchip")) else {
            return name.to_owned();
        };
        let device = fs::read_link(computer.path(format!("/sys/class/pwm/{chip}/device"))).ok();
        let device = device.as_deref().and_then(Path::file_name).map(|device| device.to_string_lossy().into_owned());
        format!("{}/{channel}", device.as_deref().unwrap_or(chip))
    }

    /// Adds what the kernel and other programs hold now.
    fn add_kernel(&mut self, computer: &Computer, inventory: Option<&Inventory>) {
        let one =
            |what, user: String, place: String, function| Use { what, user, place, source: Source::Kernel, function };
        let sysfs = Sysfs::scan(&computer.path("/"));
        for chip in inventory.map(|inventory| &inventory.chips[..]).unwrap_or_default() {
            for (offset, line) in (0u32..).zip(&chip.lines) {
                let device = sysfs.devices.get(&(chip.label.clone(), offset));
                let user = match (line.held, &line.consumer, device) {
                    // The lines of an MCU are those of printer.cfg.
                    (true, Some(consumer), _) if ["pinion", "klipper"].contains(&consumer.as_str()) => continue,
                    (true, consumer, device) => consumer.as_ref().or(device).map_or("a driver", String::as_str),
                    (false, _, Some(device)) => device,
                    (false, ..) => continue,
                };
                let Some(name) = self.names.line(&format!("gpiochip{}/gpio{offset}", chip.number)) else { continue };
                let function = self.function_of(&name, user);
                self.add(one(Resource::Line(name), user.to_owned(), format!("gpiochip{}", chip.number), function));
            }
        }
        for path in computer.matching("/sys/bus/spi/devices/spi*/driver") {
            let driver = fs::read_link(&path).ok();
            let driver = driver.as_deref().and_then(Path::file_name).and_then(|name| name.to_str());
            let device = path.parent().and_then(Path::file_name).and_then(|name| name.to_str());
            let select = device
                .and_then(|device| device.strip_prefix("spi"))
                .and_then(|rest| spi_node(&format!("spidev{rest}")));
            if let (Some(driver), Some((bus, select))) = (driver.filter(|driver| *driver != "spidev"), select) {
                self.add(one(Resource::Select(bus, select), format!("driver {driver}"), "/sys/bus/spi".into(), None));
            }
        }
        for bus in &sysfs.i2c {
            for chip in bus.chips.iter().filter(|chip| chip.driver.is_some()) {
                let what = Resource::I2c(bus.number, Some(chip.address));
                self.add(one(
                    what,
                    format!("driver {}", chip.driver.as_deref().unwrap_or_default()),
                    "/sys/bus/i2c".into(),
                    None,
                ));
            }
        }
        for chip in &sysfs.pwm {
            for (number, channel) in chip.channels.iter().enumerate() {
                let name = format!("{}/pwm{number}", chip.device.as_deref().unwrap_or("pwmchip"));
                let is_printer_s = self.all.iter().any(|one| one.what == Resource::Pwm(name.clone()));
                let user = match &channel.consumer {
                    Some(consumer) if consumer != "sysfs" => format!("driver {consumer}"),
                    _ if channel.exported && !is_printer_s => A_PROGRAM.to_owned(),
                    _ => continue,
                };
                self.add(one(Resource::Pwm(name), user, format!("/sys/class/pwm/pwmchip{}", chip.number), None));
            }
        }
        for console in computer.text("/sys/class/tty/console/active").unwrap_or_default().split_whitespace() {
            if ["ttyAMA", "ttyS", "ttyUSB"].iter().any(|kind| console.starts_with(kind)) {
                self.add(one(Resource::Port(console.into()), "the kernel's messages".into(), "console".into(), None));
            }
        }
    }

    /// The bus for which the kernel holds a line, if the bus has the line on the header.
    fn function_of(&self, line: &str, user: &str) -> Option<String> {
        let board = self.board.as_ref()?;
        let user = user.to_ascii_lowercase();
        let is_kind = |kind: Kind| match kind {
            Kind::Spi | Kind::Leds => user.contains("spi"),
            Kind::I2c => user.contains("i2c"),
            Kind::W1 => user.contains("onewire") || user.contains("w1"),
            Kind::Pwm => user.contains("pwm"),
            Kind::Uart => user.contains("serial") || user.contains("uart"),
            Kind::Line => false,
        };
        let pin = self.names.pin(board, line)?;
        let mut buses = board.bus.iter().filter(|(kind, _)| is_kind(**kind));
        let (_, bus) = buses.find(|(_, bus)| {
            bus.spots().any(|spot| self.pins(board, &spot).values().any(|own| *own == pin)) || bus.holds.contains(&pin)
        })?;
        Some(board::function(&bus.node))
    }

    /// The users of a part.
    pub fn of<'a>(&'a self, what: &'a Resource) -> impl Iterator<Item = &'a Use> {
        self.all.iter().filter(move |one| one.what == *what)
    }

    /// The overlays and configurations whose pins nobody knows.
    pub fn unknown(&self) -> impl Iterator<Item = &Use> {
        self.all.iter().filter(|one| matches!(one.what, Resource::Unknown(_)))
    }

    /// For programs.
    pub fn json(&self) -> Value {
        let kind = |what: &Resource| match what {
            Resource::Line(_) => "line",
            Resource::Select(..) => "spi",
            Resource::Controller(_) => "spi_controller",
            Resource::I2c(..) => "i2c",
            Resource::Pwm(_) => "pwm",
            Resource::Port(_) => "serial",
            Resource::Sensor(_) => "w1",
            Resource::Device(_) => "device",
            Resource::Unknown(_) => "unknown",
        };
        let entry = |one: &Use| {
            let pin = match (&one.what, &self.board) {
                (Resource::Line(line), Some(board)) => self.names.pin(board, line),
                _ => None,
            };
            json!({ "kind": kind(&one.what), "name": one.what.to_string(), "pin": pin, "user": one.user,
                "source": one.place, "function": one.function })
        };
        Value::Array(self.sorted().map(entry).collect())
    }

    /// In the order of the parts, lines first.
    pub fn sorted(&self) -> impl Iterator<Item = &Use> {
        let number = |name: &str| -> u32 {
            let digits: String = name.chars().rev().take_while(char::is_ascii_digit).collect();
            digits.chars().rev().collect::<String>().parse().unwrap_or(0)
        };
        let mut all: Vec<&Use> = self.all.iter().collect();
        all.sort_by_key(|one| match &one.what {
            Resource::Line(name) => (number(name), one.what.clone()),
            other => (u32::MAX, other.clone()),
        });
        all.into_iter()
    }
}

/// The numbers of an SPI device: `spidev0.1`.
pub fn spi_node(name: &str) -> Option<(u32, u32)> {
    let (bus, select) = name.strip_prefix("spidev")?.split_once('.')?;
    Some((bus.parse().ok()?, select.parse().ok()?))
}

/// The number of an I2C bus: `i2c.1`.
fn i2c_number(name: &str) -> Option<u32> {
    name.strip_prefix("i2c.").or_else(|| name.strip_prefix("i2c-"))?.parse().ok()
}

#[cfg(test)]
mod tests;
