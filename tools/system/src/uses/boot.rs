// SPDX-License-Identifier: GPL-3.0-or-later
//! The boot loader's settings, and what they take: config.txt of a Raspberry Pi, and the files with `overlays=`.

use std::collections::BTreeMap;
use std::path::Path;

use super::super::Computer;
use super::super::board::{Board, Boot, is_pi, is_pi5, model, pi_config};
use super::lines::Names;
use super::{Resource, Source, Use, Uses};

/// The resources of each overlay.
const OVERLAYS: &str = include_str!("overlays.txt");
/// Highest number of files that a config.txt includes. Raspberry Pi's firmware reads ten levels.
const INCLUDES_MAX: usize = 10;
/// Highest number of lines. A config.txt has some hundred.
const LINES_MAX: usize = 10_000;

/// A line of a config.txt.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// The line.
    pub text: String,
    /// The file and the line, such as `/boot/firmware/config.txt:12`.
    pub place: String,
    /// Whether it applies to this computer. `None` if that depends on something else, such as the monitor.
    pub applies: Option<bool>,
}

/// An overlay that is loaded, with its parameters.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// Its name. The file itself has none.
    pub name: String,
    /// Names and values.
    pub parameters: Vec<(String, String)>,
    /// The file and the line.
    pub place: String,
    /// Whether it applies to this computer for sure.
    pub is_sure: bool,
    /// Its resources, from the table. `None` if it is not known.
    takes: Option<&'static str>,
}

impl Loaded {
    fn set(&self, key: &str) -> Option<&str> {
        self.parameters.iter().rev().find(|(own, _)| own == key).map(|(_, value)| value.as_str())
    }

    /// Whether it is this one, such as `anyspi:spi0-0,dev="microchip,mcp3208"`, with all its parameters. Its user may have
    /// added others.
    pub fn is(&self, wanted: &str) -> bool {
        let (name, wanted) = wanted.split_at(wanted.find([',', ':']).unwrap_or(wanted.len()));
        self.name == name
            && parameters(wanted.get(1..).unwrap_or_default()).iter().all(|one| self.parameters.contains(one))
    }
}

/// A Raspberry Pi's config.txt, with the files that it includes. Other computers have an empty one.
#[derive(Clone, Debug, Default)]
pub struct ConfigTxt {
    /// The sections that apply to this model.
    pub sections: &'static [&'static str],
    lines: Vec<Line>,
    /// The overlays, and the file's own parameters as those of an overlay without a name.
    pub loaded: Vec<Loaded>,
}

impl ConfigTxt {
    /// Reads the board's config.txt, with the files that it includes.
    pub fn read(computer: &Computer, board: Option<&Board>) -> ConfigTxt {
        let is_there = board.map_or_else(|| is_pi(computer), |board| board.boot == Boot::ConfigTxt);
        let Some(file) = pi_config(computer).filter(|_| is_there) else { return ConfigTxt::default() };
        let sections = sections(computer);
        let mut lines = Vec::new();
        read(computer, sections, Path::new(file), 0, &mut State::default(), &mut lines);
        let loaded = loaded(&lines, is_pi5(computer));
        ConfigTxt { sections, lines, loaded }
    }

    /// The value of a key that is no overlay and no parameter. The last line counts.
    pub fn value(&self, key: &str) -> Option<&str> {
        let sure = self.lines.iter().filter(|line| line.applies == Some(true));
        let mut settings = sure.filter_map(|line| line.text.split_once('='));
        settings.rfind(|(own, _)| own.trim() == key).map(|(_, value)| value.trim())
    }

    /// The value of a parameter of the file's own.
    fn parameter(&self, key: &str) -> Option<&str> {
        let base = self.loaded.iter().filter(|loaded| loaded.name.is_empty() && loaded.is_sure);
        let mut all = base.flat_map(|loaded| &loaded.parameters);
        all.rfind(|(own, _)| parameter(own) == parameter(key)).map(|(_, value)| value.as_str())
    }

    /// Whether it has the effect of this line.
    pub fn has(&self, wanted: &str) -> bool {
        if let Some(wanted) = wanted.strip_prefix("dtparam=") {
            let (key, value) = wanted.split_once('=').unwrap_or((wanted, "on"));
            return self.parameter(key).is_some_and(|own| own == value || is_on(own) && is_on(value));
        }
        if let Some(overlay) = wanted.strip_prefix("dtoverlay=") {
            return self.loaded.iter().any(|loaded| loaded.is_sure && loaded.is(overlay));
        }
        wanted.split_once('=').is_some_and(|(key, value)| self.value(key) == Some(value))
    }

    /// Whether an overlay or a parameter whose name begins like this is on.
    pub fn enables(&self, beginning: &str) -> bool {
        self.loaded.iter().any(|loaded| match loaded.name.as_str() {
            "" => loaded
                .parameters
                .iter()
                .any(|(key, _)| parameter(key).starts_with(beginning) && self.parameter(key).is_some_and(is_on)),
            name => name.starts_with(beginning),
        })
    }
}

/// The conditions of the sections that are open.
#[derive(Default)]
struct State {
    model: Option<bool>,
    other: Option<bool>,
    is_conditional: bool,
    is_other: bool,
}

fn read(computer: &Computer, own: &[&str], file: &Path, depth: usize, state: &mut State, found: &mut Vec<Line>) {
    let text = computer.text(file).unwrap_or_default();
    for (number, text) in (1..).zip(text.lines()) {
        let text = text.trim();
        if found.len() == LINES_MAX {
            return;
        }
        if let Some(section) = text.strip_prefix('[').and_then(|text| text.strip_suffix(']')) {
            match section {
                "all" => *state = State::default(),
                // Filters of different kinds all have to apply.
                "none" => (state.is_other, state.other) = (true, Some(false)),
                section if is_model(section) => {
                    (state.is_conditional, state.model) = (true, Some(own.contains(&section)));
                }
                _ => (state.is_other, state.other) = (true, None),
            }
            continue;
        }
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        let conditions = [(state.is_conditional, state.model), (state.is_other, state.other)];
        let has = |wanted: Option<bool>| conditions.iter().any(|(is, applies)| *is && *applies == wanted);
        let applies = match (has(Some(false)), has(None)) {
            (true, _) => Some(false),
            (_, true) => None,
            _ => Some(true),
        };
        if let Some(name) = text.strip_prefix("include ").map(str::trim) {
            if depth < INCLUDES_MAX && applies != Some(false) && !name.contains("..") {
                let included = file.with_file_name(name.trim_start_matches('/'));
                read(computer, own, &included, depth + 1, state, found);
            }
            continue;
        }
        found.push(Line { text: text.to_owned(), place: format!("{}:{number}", file.display()), applies });
    }
}

/// Whether a section of config.txt names a model.
fn is_model(section: &str) -> bool {
    let rest = section.strip_prefix("pi").or_else(|| section.strip_prefix("cm"));
    rest.is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()))
}

/// The sections of config.txt that apply to a model. The first name that is part of the model's counts.
const SECTIONS: [(&str, &[&str]); 18] = [
    ("Pi 500", &["pi5", "pi500"]),
    ("Pi 5", &["pi5"]),
    ("Compute Module 5", &["pi5", "cm5"]),
    ("Pi 400", &["pi4", "pi400"]),
    ("Pi 4", &["pi4"]),
    ("Compute Module 4S", &["pi4", "cm4s"]),
    ("Compute Module 4", &["pi4", "cm4"]),
    ("Pi 3 Model B Plus", &["pi3", "pi3+"]),
    ("Pi 3 Model B+", &["pi3", "pi3+"]),
    ("Pi 3 Model A", &["pi3", "pi3+"]),
    ("Pi 3", &["pi3"]),
    ("Compute Module 3", &["pi3", "cm3"]),
    ("Pi 2 Model", &["pi2"]),
    ("Pi Zero 2", &["pi02", "pi0w", "pi0"]),
    ("Pi Zero W", &["pi0w", "pi0"]),
    ("Pi Zero", &["pi0"]),
    ("Compute Module", &["cm1", "pi1"]),
    ("Pi Model", &["pi1"]),
];

/// The sections of config.txt that apply to this computer's model.
fn sections(computer: &Computer) -> &'static [&'static str] {
    let model = model(computer);
    SECTIONS.iter().find(|(name, _)| model.contains(name)).map_or(&[], |(_, sections)| sections)
}

/// The parameters of an overlay.
fn parameters(text: &str) -> Vec<(String, String)> {
    let parts = text.split(',').map(str::trim).filter(|part| !part.is_empty());
    let pairs = parts.map(|part| part.split_once('=').unwrap_or((part, "on")));
    pairs.map(|(key, value)| (key.trim().to_owned(), value.trim().to_owned())).collect()
}

fn loaded(lines: &[Line], is_pi5: bool) -> Vec<Loaded> {
    let mut all = vec![];
    // A parameter belongs to the overlay before it, if that has it.
    let mut open: Option<usize> = None;
    for Line { text, place, applies } in lines.iter().filter(|line| line.applies != Some(false)) {
        let is_sure = *applies == Some(true);
        let base = |parameters| Loaded { name: String::new(), parameters, place: place.clone(), is_sure, takes: None };
        if let Some(text) = text.strip_prefix("dtoverlay=") {
            open = None;
            let (name, rest) = text.split_at(text.find([',', ':']).unwrap_or(text.len()));
            if !name.trim().is_empty() {
                open = Some(all.len());
                let parameters = parameters(rest.get(1..).unwrap_or_default());
                let takes = entry(name.trim(), is_pi5);
                all.push(Loaded { name: name.trim().to_owned(), takes, ..base(parameters) });
            }
        } else if let Some(text) = text.strip_prefix("dtparam=") {
            for (key, value) in parameters(text) {
                let is_its = |loaded: &Loaded| loaded.takes.is_some_and(|entry| has_parameter(entry, &key));
                match open.filter(|at| is_its(&all[*at])) {
                    Some(at) => all[at].parameters.push((key, value)),
                    None => all.push(base(vec![(key, value)])),
                }
            }
        } else if let Some(value) = text.strip_prefix("enable_uart=") {
            all.push(base(vec![("enable_uart".into(), value.trim().into())]));
        }
    }
    all
}

/// The resources of an overlay, from the table. `None` if it is not known.
fn entry(name: &str, is_pi5: bool) -> Option<&'static str> {
    let of = |name: &str| {
        let mut entries = OVERLAYS.lines().filter(|line| !line.starts_with('#') && !line.is_empty());
        entries.find_map(|line| {
            let (own, takes) = line.split_once(' ').unwrap_or((line, ""));
            (own == name).then_some(takes)
        })
    };
    let pi5 = is_pi5.then(|| of(&format!("{name}-pi5"))).flatten();
    pi5.or_else(|| of(name))
}

fn has_parameter(entry: &str, key: &str) -> bool {
    let pins = key.starts_with("pins_") && entry.contains("pins_");
    let select = chip_select(key).is_some() && entry.contains("spi?");
    pins || select
        || entry.split(' ').any(|token| {
            let name = token.split(['=', '?', '@']).next().unwrap_or_default();
            name == key || name.strip_prefix("spi0.") == Some(key)
        })
}

/// The chip select of a parameter: `spi0-1` or `spi0-1-present`.
fn chip_select(key: &str) -> Option<(u32, u32)> {
    let key = key.strip_suffix("-present").unwrap_or(key);
    let (bus, select) = key.strip_prefix("spi")?.split_once('-')?;
    Some((bus.parse().ok()?, select.parse().ok()?))
}

/// The two lines of `pins_4_5`.
fn two_pins(key: &str) -> Option<[u32; 2]> {
    let (first, second) = key.strip_prefix("pins_")?.split_once('_')?;
    Some([first.parse().ok()?, second.parse().ok()?])
}

/// Whether config.txt switches something on with this value.
fn is_on(value: &str) -> bool {
    ["on", "true", "yes", "1", ""].contains(&value)
}

/// A parameter of config.txt by its usual name. The others are in overlays/README.
fn parameter(name: &str) -> &str {
    match name {
        "i2c" | "i2c1" => "i2c_arm",
        "i2c0" => "i2c_vc",
        "i2c_baudrate" | "i2c1_baudrate" => "i2c_arm_baudrate",
        name => name,
    }
}

/// The settings in an armbianEnv.txt or its like, with the numbers of their lines. The last one of a name counts.
pub struct Env<'a>(BTreeMap<&'a str, (usize, &'a str)>);

impl<'a> Env<'a> {
    /// Reads the settings in a text.
    pub fn of(text: &'a str) -> Env<'a> {
        let settings = (1..).zip(text.lines()).filter_map(|(number, line)| {
            let (key, value) = line.split_once('=').filter(|(key, _)| !key.starts_with('#'))?;
            Some((key.trim(), (number, value.trim())))
        });
        Env(settings.collect())
    }

    /// The value of a setting.
    pub fn value(&self, key: &str) -> Option<&'a str> {
        self.0.get(key).map(|(_, value)| *value)
    }

    /// An overlay's name without the prefix that the boot loader adds.
    pub fn short<'b>(&self, name: &'b str) -> &'b str {
        let prefix = self.value("overlay_prefix").unwrap_or_default();
        name.strip_prefix(prefix).and_then(|name| name.strip_prefix('-')).unwrap_or(name)
    }

    /// Whether this overlay is the one of a bus, with its parameters.
    pub fn is(&self, name: &str, way: &[String]) -> bool {
        let set = |line: &String| line.split_once('=').is_some_and(|(key, value)| self.value(key) == Some(value));
        way.split_first()
            .is_some_and(|(own, parameters)| self.short(own) == self.short(name) && parameters.iter().all(set))
    }
}

impl Uses {
    /// Adds what the boot loader's settings take.
    pub(super) fn add_boot(&mut self, computer: &Computer) {
        let loaded = self.config_txt.loaded.clone();
        for (at, one) in loaded.iter().enumerate() {
            match one.name.as_str() {
                "" => self.add_parameters(one, &loaded[at + 1..]),
                _ => self.add_overlay(one),
            }
        }
        let board = self.board.clone().filter(|board| board.boot == Boot::Overlays);
        if let Some((board, file)) = board.as_ref().and_then(|board| Some((board, board.file(computer)?))) {
            self.add_env(computer, board, file);
        }
    }

    fn add_parameters(&mut self, loaded: &Loaded, later: &[Loaded]) {
        for (key, value) in &loaded.parameters {
            let (lines, function): (&[u32], _) = match parameter(key) {
                "spi" => (&[7, 8, 9, 10, 11], "spi0"),
                "i2c_arm" => (&[2, 3], "i2c1"),
                "i2c_vc" => (&[0, 1], "i2c0"),
                "i2s" => (&[18, 19, 20, 21], "i2s"),
                "enable_uart" | "uart0" => (&[14, 15], "ttyAMA0"),
                _ => continue,
            };
            // The last one counts, so an earlier one is no user.
            let is_it = |(own, _): &(String, String)| parameter(own) == parameter(key);
            let is_later =
                later.iter().any(|other| other.is_sure && other.name.is_empty() && other.parameters.iter().any(is_it));
            if is_on(value) && !is_later {
                let user = if key == "enable_uart" { format!("{key}={value}") } else { format!("dtparam={key}") };
                self.add_lines(lines.iter().copied(), &user, &loaded.place, Some(function));
            }
        }
    }

    fn add_lines(&mut self, lines: impl Iterator<Item = u32>, user: &str, place: &str, function: Option<&str>) {
        for line in lines {
            self.add(Use {
                what: Resource::Line(format!("GPIO{line}")),
                user: user.to_owned(),
                place: place.to_owned(),
                source: Source::Boot,
                function: function.map(str::to_owned),
            });
        }
    }

    fn add_overlay(&mut self, loaded: &Loaded) {
        let user = format!("overlay {}", loaded.name);
        let mut push = |what, function: Option<&str>| {
            let (user, place, function) = (user.clone(), loaded.place.clone(), function.map(str::to_owned));
            self.add(Use { what, user, place, source: Source::Boot, function });
        };
        let Some(entry) = loaded.takes else {
            push(Resource::Unknown(loaded.name.clone()), None);
            return;
        };
        let tokens = || entry.split(' ').filter(|token| !token.is_empty());
        let function =
            tokens().find_map(|token| token.strip_prefix('@').filter(|name| u8::from_str_radix(name, 16).is_err()));
        let mut lines: Vec<u32> = Vec::new();
        for token in tokens() {
            if let Some(pins) = two_pins(token) {
                let chosen =
                    loaded.parameters.iter().rev().find_map(|(key, value)| two_pins(key).filter(|_| is_on(value)));
                lines.extend(chosen.unwrap_or(pins));
            } else if let Some((name, address)) = token.split_once('@') {
                let Ok(address) = u16::from_str_radix(address, 16) else { continue };
                let given =
                    loaded.set("addr").and_then(|text| u16::from_str_radix(text.trim_start_matches("0x"), 16).ok());
                // The bus of the header, unless another one is chosen.
                let bus = loaded.parameters.iter().find_map(|(key, _)| key.strip_prefix("i2c")?.parse::<u32>().ok());
                if name.is_empty() || loaded.set(name).is_some_and(is_on) {
                    push(Resource::I2c(bus.unwrap_or(1), Some(given.unwrap_or(address))), None);
                }
            } else if token == "spi?" {
                for (bus, select) in loaded.parameters.iter().filter_map(|(key, _)| chip_select(key)) {
                    push(Resource::Select(bus, select), None);
                }
            } else if let Some(rest) = token.strip_prefix("spi0.") {
                let (key, usual) = rest.split_once('=').unwrap_or(("", rest));
                let select = loaded.set(key).unwrap_or(usual);
                select.parse().into_iter().for_each(|select| push(Resource::Select(0, select), None));
            } else if let Some((key, usual)) = token.split_once('=') {
                lines.extend(loaded.set(key).unwrap_or(usual).parse::<u32>().ok());
            } else if let Some((key, more)) = token.split_once('?') {
                let more = more.split(',').filter_map(|line| line.parse::<u32>().ok());
                let own = loaded.set(key).map(|value| value.parse::<u32>());
                lines.extend(own.into_iter().flat_map(|own| more.clone().chain(own.ok())));
            } else {
                lines.extend(token.parse::<u32>().ok());
            }
        }
        lines.into_iter().for_each(|line| push(Resource::Line(format!("GPIO{line}")), function));
    }

    /// Adds the overlays of an armbianEnv.txt or its like. Only those that a board's file names are known.
    fn add_env(&mut self, computer: &Computer, board: &Board, file: &str) {
        let text = computer.text(file).unwrap_or_default();
        let env = Env::of(&text);
        for key in ["overlays", "user_overlays"] {
            let Some((number, names)) = env.0.get(key) else { continue };
            for name in names.split_whitespace() {
                let name = env.short(name);
                let one = |what, function| Use {
                    what,
                    user: format!("overlay {name}"),
                    place: format!("{file}:{number}"),
                    source: Source::Boot,
                    function,
                };
                let is_its = |way: &Vec<String>| env.is(name, way);
                let names = Names::of(computer, Some(board), None);
                if let Some(bus) = board.bus.values().find(|bus| bus.overlays.iter().any(is_its)) {
                    let function = super::super::board::function(&bus.node);
                    let lines = bus.all_pins().filter_map(|pin| names.of_pin(board, pin));
                    lines.for_each(|line| self.add(one(Resource::Line(line), Some(function.clone()))));
                } else if let ("w1-gpio", Some(line)) =
                    (name, names.meant(env.value("param_w1_pin").unwrap_or_default(), Some(board)))
                {
                    self.add(one(Resource::Line(line), Some("w1".to_owned())));
                } else if ["tft35_spi", "mcp2515"].contains(&name) {
                    // Both have the chip select of the header (BigTreeTech's docs/CB1.md).
                    self.add(one(Resource::Select(1, 1), None));
                } else {
                    self.add(one(Resource::Unknown(name.to_owned()), None));
                }
            }
        }
    }
}
