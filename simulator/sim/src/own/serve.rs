// SPDX-License-Identifier: GPL-3.0-or-later
//! A printer.cfg as it is served: read, translated, and copied to a folder of its own for klippy.
//!
//! The user's files are never changed. The copy differs in the way to each MCU and in the places where klippy writes.

use std::collections::BTreeSet;
use std::fs::{self, Metadata};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::unistd::geteuid;
use pinion_linux::foreign::{self, word};
use pinion_linux::own_folder::OwnFolder;
use pinion_model::SimConfig;
use pinion_printer_config::copy::{self, Change};
use pinion_printer_config::pins::{MAIN, section_of};
use pinion_printer_config::{Config, Section, Trouble};
use pinion_runtime::klippy::is_host_path;
use toml::{Table, Value};

use super::plugins::{LeftOut, StandIn, stand_in};
use super::translate::{Translated, check, translate};
use super::translator::{Pace, Pins};
use crate::boards::links_of;

/// The ways to an MCU in its section. Kalico opens the way to an MCU that is not critical as a serial port, to see whether
/// it is there. A simulated one always is.
const WAYS: [&str; 6] = ["serial", "canbus_uuid", "canbus_interface", "baud", "restart_method", "is_non_critical"];
/// The temperature of the printer's computer, as the kernel writes it.
const HOST_TEMPERATURE: &str = "45000\n";
/// Longest file of saved variables.
const VARIABLES_MAX: u64 = 1 << 20;

/// Somebody's printer.
pub(crate) struct Own {
    pub(crate) config: Config,
    pub(crate) sim: SimConfig,
    /// The description in TOML.
    pub(crate) description: String,
    /// The MCUs, the main one first.
    pub(crate) mcus: Vec<String>,
    pub(crate) notes: Vec<Trouble>,
    /// The steppers whose endstops have the phases that are saved for them.
    in_phase: BTreeSet<String>,
    /// The sections and options that klippy's copy is without.
    pub(super) left_out: LeftOut,
}

/// How a printer.cfg is read.
pub(super) struct Reading<'a> {
    /// The printer.cfg of the printer, if it is another one.
    pub(super) built_like: Option<&'a Path>,
    /// A description that lies over the one that comes out of it.
    pub(super) over: Option<Table>,
    pub(super) pace: Pace,
    /// Whether the sections of plugins are left out.
    pub(super) without_plugins: bool,
    /// The checkout of the klippy, if it is known.
    pub(super) klipper: Option<&'a Path>,
    /// Whether no klippy is asked later.
    pub(super) is_checked: bool,
}

impl Own {
    /// Reads a printer.cfg.
    ///
    /// # Errors
    ///
    /// It is no printer, or has a mistake.
    pub(super) fn read(path: &Path, reading: Reading<'_>) -> Result<Own, Trouble> {
        let (config, left_out, translated) = read(path, &reading)?;
        let Translated { mut description, mcus, pins, notes, mut in_phase } = translated;
        if let Some(built_like) = reading.built_like {
            let (_, _, mut built) = read(built_like, &reading)?;
            in_phase = std::mem::take(&mut built.in_phase);
            if built.mcus != mcus {
                let cause = format!("it has the MCUs {}, and {} has others", built.mcus.join(", "), path.display());
                return Err(Trouble::new(cause).of(built_like.display()).remedy("name a printer.cfg of this printer"));
            }
            description = with_places_of(built, &description, &pins);
        }
        if let Some(over) = reading.over {
            lay_over(&mut description, over);
        }
        let name = path.display();
        let description = toml::to_string(&description).map_err(|error| Trouble::new(error.to_string()).of(&name))?;
        let sim = SimConfig::parse(&description, &format!("the printer that {name} describes"))?;
        Ok(Own { config, sim, description, mcus, notes, in_phase, left_out })
    }

    /// Whether klippy's copy is without something of the user's.
    pub(crate) fn is_partial(&self) -> bool {
        self.left_out.files || !self.left_out.sections.is_empty()
    }
}

fn read(path: &Path, reading: &Reading<'_>) -> Result<(Config, LeftOut, Translated), Trouble> {
    let (mut config, missing) = match reading.without_plugins {
        true => Config::read_present(path, stand_in)?,
        false => (Config::read(path)?, Vec::new()),
    };
    config.put_constants_in();
    if reading.is_checked {
        check(&config)?;
    }
    let mut left_out = match reading.without_plugins {
        true => LeftOut::of(&config, reading.klipper)?,
        false => LeftOut::default(),
    };
    left_out.files = !missing.is_empty();
    let mut translated = translate(&config, reading.pace, &left_out)?;
    let gone = missing.into_iter().map(|trouble| trouble.remedy("klippy's copy is without its macros"));
    translated.notes.splice(0..0, gone);
    Ok((config, left_out, translated))
}

/// The printer with the pins and buses that another configuration names, too. Nothing is at them.
fn with_places_of(built: Translated, other: &Table, pins: &Pins) -> Table {
    let Translated { mut description, pins: own, .. } = built;
    let tables = |description: &Table, kind: &str| -> Vec<Table> {
        let list = description.get(kind).and_then(Value::as_array).into_iter().flatten();
        list.filter_map(Value::as_table).cloned().collect()
    };
    let name = |table: &Table| table.get("name").and_then(Value::as_str).unwrap_or_default().to_owned();
    for kind in ["spi_bus", "i2c_bus"] {
        let known: Vec<String> = tables(&description, kind).iter().map(name).collect();
        // A bus on bare lines is no more than its pins.
        let new = tables(other, kind).into_iter().filter(|bus| bus.len() == 1 && !known.contains(&name(bus)));
        let new: Vec<Value> = new.map(Value::Table).collect();
        if let (false, Value::Array(list)) =
            (new.is_empty(), description.entry(kind).or_insert_with(|| Value::Array(Vec::new())))
        {
            list.extend(new);
        }
    }
    for board in description.get_mut("mcu").and_then(Value::as_array_mut).into_iter().flatten() {
        let Some(board) = board.as_table_mut() else { continue };
        let mcu = name(board);
        let new = pins.get(&mcu).into_iter().flatten();
        let new = new.filter(|pin| !own.get(&mcu).is_some_and(|own| own.contains(*pin)));
        let new: Vec<Value> = new.map(|pin| pin.as_str().into()).collect();
        if let Some(list) = board.get_mut("pins").and_then(Value::as_array_mut) {
            list.extend(new);
        }
    }
    description
}

/// Puts a description over another one. An entry with the name of another one changes its keys. All others are added.
fn lay_over(under: &mut Table, over: Table) {
    for (key, value) in over {
        match (under.get_mut(&key), value) {
            (Some(Value::Table(under)), Value::Table(over)) => lay_over(under, over),
            (Some(Value::Array(under)), Value::Array(over)) if over.iter().all(Value::is_table) => {
                for entry in over {
                    let its = |key: &str| entry.get(key).cloned();
                    let keys = ["kind", "name", "axis"].map(|key| (key, its(key)));
                    let known = under.iter_mut().find(|other| {
                        keys.iter().any(|(key, _)| *key != "kind" && its(key).is_some())
                            && keys.iter().all(|(key, value)| other.get(key) == value.as_ref())
                    });
                    match (known, entry) {
                        (Some(Value::Table(known)), Value::Table(entry)) => known.extend(entry),
                        (_, entry) => under.push(entry),
                    }
                }
            }
            (_, value) => _ = under.insert(key, value),
        }
    }
}

/// The folder for a klippy.
pub(crate) struct Folder {
    pub(crate) path: PathBuf,
    /// The copy of printer.cfg.
    pub(crate) printer_cfg: PathBuf,
    /// The links of all MCUs, the main one's first.
    pub(super) links: Vec<PathBuf>,
    /// The sections that the copy does not have.
    pub(crate) left_out: Vec<String>,
}

impl Folder {
    /// Makes the folder and the copy. `link` is the main MCU's link, if it is not in the folder.
    ///
    /// # Errors
    ///
    /// It cannot be written, or has files of somebody else.
    pub(super) fn make(own: &Own, named: Option<&Path>, link: Option<&Path>) -> Result<Folder, Trouble> {
        let path = match named {
            Some(named) => new_or_ours(named)?,
            None => nix::unistd::mkdtemp("/tmp/pinion-sim-XXXXXX").map_err(|error| {
                Trouble::new(format!("no folder can be made in /tmp: {error}")).remedy("free space")
            })?,
        };
        let gcodes = path.join("gcodes");
        let failed = |path: &Path, error: std::io::Error| {
            Trouble::new(format!("it cannot be written: {error}")).of(path.display()).remedy("name another folder")
        };
        fs::create_dir_all(&gcodes).map_err(|error| failed(&gcodes, error))?;
        fs::write(path.join(MARK), "").map_err(|error| failed(&path, error))?;
        let main = link.map_or_else(|| path.join(MAIN), Path::to_owned);
        let links = links_of(&main, own.mcus.iter().map(String::as_str));
        let served = |(mcu, link): (&String, &PathBuf)| {
            let mut with = vec![("serial".into(), link.display().to_string())];
            // klippy knows no other method at such a path, and no option for it.
            if !is_host_path(link) {
                with.push(("restart_method".into(), "command".into()));
            }
            let without = WAYS.map(str::to_owned).to_vec();
            Change { section: section_of(mcu), without, with, ..Change::default() }
        };
        let mut changes: Vec<Change> = own.mcus.iter().zip(&links).map(served).collect();
        let elsewhere = |section: &str, key: &str, value: &Path| Change {
            section: section.into(),
            without: vec![key.into()],
            with: vec![(key.into(), value.display().to_string())],
            ..Change::default()
        };
        // Without the option, klippy refuses the section, and so it does the copy.
        if own.config.section("virtual_sdcard").is_some_and(|section| section.text("path").is_some()) {
            changes.push(elsewhere("virtual_sdcard", "path", &gcodes));
        }
        let is_of_host = |section: &&Section| section.text("sensor_type") == Some("temperature_host");
        let of_host: Vec<&Section> = own.config.sections().iter().filter(is_of_host).collect();
        if !of_host.is_empty() {
            // This computer may have no thermometer, and has another temperature than the printer's one.
            let millidegrees = path.join("host_temperature");
            fs::write(&millidegrees, HOST_TEMPERATURE).map_err(|error| failed(&millidegrees, error))?;
            changes.extend(of_host.iter().map(|section| elsewhere(&section.name, "sensor_path", &millidegrees)));
        }
        if let Some(section) = own.config.section("save_variables").filter(|section| section.text("filename").is_some())
        {
            let variables = path.join("variables.cfg");
            let file = section.text("filename").map(at_home);
            if let Some(file) = file
                && let Ok(bytes) = foreign::read(&file, VARIABLES_MAX)
            {
                copy::write_like(&file, &variables, &bytes).map_err(|error| failed(&variables, error))?;
            }
            changes.push(elsewhere("save_variables", "filename", &variables));
        }
        // A motor that turns with others, or homes without a switch, has other phases than the real one.
        let has_phase = |section: &&Section| section.own_name().is_some_and(|stepper| own.in_phase.contains(stepper));
        let phases = own.config.of_kind("endstop_phase").filter(|section| !has_phase(section)).map(|section| Change {
            section: section.name.clone(),
            without: vec!["trigger_phase".into()],
            ..Change::default()
        });
        changes.extend(phases);
        let LeftOut { sections: left_out, stand_in, .. } = own.left_out.clone();
        changes.extend(left_out.iter().map(|section| Change {
            section: section.clone(),
            left_out: true,
            instead: stand_in.as_ref().filter(|stand_in| stand_in.section == *section).map(StandIn::text),
            ..Change::default()
        }));
        let printer_cfg = copy::write(&own.config, &changes, &path)?;
        Ok(Folder { path, printer_cfg, links, left_out })
    }

    /// The command that starts klippy on the copy.
    pub(crate) fn command(&self, klipper: Option<&Path>) -> String {
        let klipper = klipper.map_or_else(|| "~/klipper".to_owned(), |path| word(path.display()));
        let [cfg, log, socket] =
            [self.printer_cfg.clone(), self.path.join("klippy.log"), self.path.join("klippy.sock")]
                .map(|path| word(path.display()));
        format!("python3 {klipper}/klippy/klippy.py {cfg} -l {log} -a {socket}")
    }
}

/// A file in a folder that this program made.
const MARK: &str = ".pinion-sim";

/// A folder of our own that is new, empty, or made by an earlier run. In another user's folder, links of that user would
/// lead the copies to any file.
fn new_or_ours(path: &Path) -> Result<PathBuf, Trouble> {
    let refused =
        |cause: String| Trouble::new(cause).of(path.display()).remedy("name a new folder in a folder of yours");
    let folder = OwnFolder::make(path).map_err(|error| refused(error.to_string()))?;
    let mut names = fs::read_dir(folder.at(".")).map_err(|error| refused(error.to_string()))?;
    let is_ours = |about: Metadata| about.is_file() && about.uid() == geteuid().as_raw();
    if names.next().is_some() && !fs::symlink_metadata(folder.at(MARK)).is_ok_and(is_ours) {
        return Err(refused("it has files of somebody else".into()));
    }
    fs::canonicalize(folder.at(".")).map_err(|error| refused(error.to_string()))
}

/// A path whose `~` is the home folder.
fn at_home(path: &str) -> PathBuf {
    match (path.strip_prefix("~/"), std::env::var_os("HOME")) {
        (Some(rest), Some(home)) => Path::new(&home).join(rest),
        _ => path.into(),
    }
}
