// SPDX-License-Identifier: GPL-3.0-or-later
//! Klipper's own regression cases (`test/klippy/*.test` of the checkout, run as by scripts/test_klippy.py). Each runs
//! with our dictionary and with the firmware's.
//!
//! In these cases klippy has no MCU: it takes a dictionary and writes its messages to a file. All cases except one are
//! for printers with other MCUs. The linux process does not have the pins and buses of those MCUs. They are added to
//! both dictionaries here, with the same numbers. What remains is each command, constant and enumeration that any of
//! these configurations and their G-code need. klippy must end in the same way with both dictionaries. It must also
//! configure each MCU with the same messages. (Its later messages depend on real time: how much of its queues is sent
//! when the file ends, and what a display shows.)
//! display shows.)

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use pinion_protocol::block::{Resync, Resynced};
use pinion_protocol::format;
use pinion_protocol::vlq::Reader;
use serde_json::{Map, Value, json};

use crate::checkout;
use crate::klippy::{pinion_path, python};

/// The dictionary of Klipper's own linux process.
const FIRMWARE: &str = include_str!("../dictionaries/klipper-master.json");
/// Messages that klippy sends as real time passes.
const BY_REAL_TIME: [&str; 2] = ["get_clock", "get_uptime"];
/// The last message of a configuration.
const LAST: &str = "finalize_config";
/// First number for additions, far from the numbers of the linux process.
const FOREIGN: u32 = 1_000_000;

/// One run of klippy.
struct Case {
    file: PathBuf,
    config: PathBuf,
    gcode: Gcode,
    /// The names of its MCUs. The main one's name is empty.
    mcus: Vec<String>,
    should_fail: bool,
}

enum Gcode {
    File(PathBuf),
    Text(String),
}

impl Case {
    fn name(&self) -> String {
        let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        format!("{}/{}", stem(&self.file), stem(&self.config))
    }
}

/// The cases of a `.test` file: one for each CONFIG, with the dictionaries that precede it. In a file with one case the
/// dictionaries may be anywhere.
fn cases(file: &Path) -> Vec<Case> {
    let folder = file.parent().unwrap();
    let text = fs::read_to_string(file).unwrap();
    let mut found: Vec<(PathBuf, Vec<String>)> = Vec::new();
    let (mut mcus, mut gcode_file, mut commands, mut should_fail) = (Vec::new(), None, String::new(), false);
    for line in text.lines() {
        let line = line.split('#').next().unwrap_or_default().trim();
        let (word, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        match word {
            "" => {}
            "CONFIG" => found.push((folder.join(rest.trim()), mcus.clone())),
            "DICTIONARY" => {
                let names = rest.split_whitespace().map(|word| word.split_once('=').map_or("", |(name, _)| name));
                mcus = names.map(str::to_owned).collect();
                found.iter_mut().filter(|(_, mcus)| mcus.is_empty()).for_each(|(_, before)| before.clone_from(&mcus));
            }
            "GCODE" => gcode_file = Some(folder.join(rest.trim())),
            "SHOULD_FAIL" => should_fail = true,
            _ => commands += &format!("{line}\n"),
        }
    }
    let case = |(config, mcus)| {
        let gcode = gcode_file.clone().map_or_else(|| Gcode::Text(commands.clone()), Gcode::File);
        Case { file: file.into(), config, gcode, mcus, should_fail }
    };
    found.into_iter().map(case).collect()
}

/// Every case of the checkout.
fn all_cases(checkout: &Path) -> Vec<Case> {
    let mut files: Vec<PathBuf> =
        fs::read_dir(checkout.join("test/klippy")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "test"));
    files.sort();
    files.iter().flat_map(|file| cases(file)).collect()
}

/// The buses that the configurations name, by their enumeration.
fn named_buses(cases: &[Case]) -> BTreeMap<&'static str, BTreeSet<String>> {
    let mut buses: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    let configs: BTreeSet<&Path> = cases.iter().map(|case| &*case.config).collect();
    for config in configs {
        for line in fs::read_to_string(config).unwrap().lines() {
            let Some((key, value)) = line.split_once([':', '=']) else { continue };
            let kind = ["spi_bus", "i2c_bus"].into_iter().find(|kind| *kind == key.trim());
            let Some((kind, name)) = kind.zip(value.split_whitespace().next()) else { continue };
            buses.entry(kind).or_default().insert(name.to_owned());
        }
    }
    buses
}

/// Adds pins and buses with the names of other MCUs.
fn add_foreign(dictionary: &mut Value, buses: &BTreeMap<&str, BTreeSet<String>>) {
    let mut next = FOREIGN;
    let letters = ('A'..='L').map(|port| format!("P{port}0"));
    let dotted = (0..5).map(|port| format!("P{port}.0"));
    let banks = (0..4).map(|bank| format!("gpio{bank}_0"));
    for first in letters.chain(dotted).chain(banks).chain(["AIN0".into(), "ADC_TEMPERATURE0".into()]) {
        dictionary["enumerations"]["pin"][first] = json!([next, 32]);
        next += 32;
    }
    dictionary["enumerations"]["pin"]["ADC_TEMPERATURE"] = json!(next);
    for (kind, names) in buses {
        for (at, name) in (100..).zip(names) {
            dictionary["enumerations"][*kind].as_object_mut().unwrap().entry(name.as_str()).or_insert(json!(at));
        }
    }
}

/// The firmware's dictionary. Messages that are also in our dictionary get the same ids. So klippy's output can be
/// compared byte by byte.
fn firmware(ours: &Value) -> Value {
    let firmware: Value = serde_json::from_str(FIRMWARE).unwrap();
    let ids: Vec<&Map<String, Value>> =
        ["commands", "responses"].into_iter().filter_map(|kind| ours[kind].as_object()).collect();
    let mut free = 1 + ids.iter().flat_map(|ids| ids.values()).filter_map(Value::as_i64).max().unwrap_or_default();
    let mut numbered = |kind: &str| -> Map<String, Value> {
        let formats = firmware[kind].as_array().unwrap().iter().filter_map(Value::as_str);
        let with_id = |format: &str| {
            let id = ours[kind].get(format).and_then(Value::as_i64).unwrap_or_else(|| {
                free += 1;
                free
            });
            (format.to_owned(), json!(id))
        };
        formats.map(with_id).collect()
    };
    let (commands, responses) = (numbered("commands"), numbered("responses"));
    let mut enumerations = firmware["enumerations"].clone();
    enumerations["static_string_id"] = ours["enumerations"]["static_string_id"].clone();
    let mut config = firmware["config"].clone();
    config["RECEIVE_WINDOW"] = ours["config"]["RECEIVE_WINDOW"].clone();
    json!({
        "app": "Klipper", "version": "1", "build_versions": "1", "license": "GPL-3.0-or-later",
        "commands": commands, "responses": responses, "enumerations": enumerations, "config": config,
    })
}

/// The end of a run: whether it failed, the end of its log, and the messages that configured its MCUs, with their
/// parameters in bytes.
struct End {
    failed: bool,
    log: String,
    configuration: Vec<String>,
}

impl End {
    fn is_whole(&self) -> bool {
        self.failed || self.configuration.last().is_some_and(|last| last.starts_with(LAST))
    }
}

/// Runs a case with a dictionary for each of its MCUs.
fn run(checkout: &Path, folder: &Path, case: &Case, dictionary: &Path, formats: &BTreeMap<u32, String>) -> End {
    fs::create_dir_all(folder).unwrap();
    let gcode = match &case.gcode {
        Gcode::File(path) => path.clone(),
        Gcode::Text(text) => {
            fs::write(folder.join("gcode"), text).unwrap();
            folder.join("gcode")
        }
    };
    let sent = folder.join("sent");
    let mut command = Command::new(python());
    command.current_dir(checkout).args(["klippy/klippy.py"]).arg(&case.config).arg("-i").arg(gcode);
    command.arg("-o").arg(&sent).arg("-l").arg(folder.join("log"));
    for mcu in &case.mcus {
        let name = if mcu.is_empty() { String::new() } else { format!("{mcu}=") };
        command.arg("-d").arg(format!("{name}{}", dictionary.display()));
    }
    let status = command.stdout(Stdio::null()).stderr(Stdio::null()).status().unwrap();
    let mut configuration = Vec::new();
    for mcu in &case.mcus {
        let file = if mcu.is_empty() { sent.clone() } else { folder.join(format!("sent-{mcu}")) };
        configuration.extend(configured(&fs::read(file).unwrap_or_default(), formats));
    }
    let log = fs::read_to_string(folder.join("log")).unwrap_or_default();
    let lines: Vec<&str> = log.lines().collect();
    let log = lines[lines.len().saturating_sub(8)..].join("\n");
    fs::remove_dir_all(folder).unwrap();
    End { failed: !status.success(), log, configuration }
}

/// The messages that configured an MCU, from everything that klippy sent.
fn configured(sent: &[u8], formats: &BTreeMap<u32, String>) -> Vec<String> {
    let (mut resync, mut rest, mut messages) = (Resync::default(), sent, Vec::new());
    loop {
        let (taken, found) = resync.next(rest);
        rest = &rest[taken..];
        let payload = match found {
            Resynced::Nothing => return messages,
            Resynced::Garbage { .. } => panic!("klippy wrote garbage"),
            Resynced::Block(_, payload) => payload,
        };
        let mut reader = Reader::new(payload);
        while !reader.is_empty() {
            let format = &formats[&reader.int().unwrap()];
            let before = reader.rest();
            for (_, conversion) in format::parameters(format).unwrap() {
                conversion.skip(&mut reader).unwrap();
            }
            let parameters = &before[..before.len() - reader.rest().len()];
            let name = format::name(format);
            if !BY_REAL_TIME.contains(&name) {
                messages.push(format!("{name} {parameters:02x?}"));
            }
            if name == LAST {
                return messages;
            }
        }
    }
}

/// The first message that differs.
fn difference(ours: &End, theirs: &End) -> String {
    let place = ours.configuration.iter().zip(&theirs.configuration).position(|(a, b)| a != b);
    let place = place.unwrap_or(ours.configuration.len().min(theirs.configuration.len()));
    format!("with ours {:?}, with the firmware's {:?}", ours.configuration.get(place), theirs.configuration.get(place))
}

#[test]
fn klippy_ends_its_regression_cases_as_with_the_firmware_s_dictionary() {
    let Some(checkout) = checkout("klippy_ends_its_regression_cases_as_with_the_firmware_s_dictionary") else {
        return;
    };
    let printed = Command::new(pinion_path()).arg("dict").output().unwrap().stdout;
    let mut ours: Value = serde_json::from_slice(&printed).unwrap();
    let mut theirs = firmware(&ours);
    let cases = all_cases(&checkout);
    let buses = named_buses(&cases);
    let folder = tempfile::tempdir().unwrap();
    let mut formats = BTreeMap::new();
    for (name, dictionary) in [("ours", &mut ours), ("theirs", &mut theirs)] {
        fs::write(folder.path().join(format!("{name}.plain")), dictionary.to_string()).unwrap();
        add_foreign(dictionary, &buses);
        fs::write(folder.path().join(name), dictionary.to_string()).unwrap();
        for (format, id) in dictionary["commands"].as_object().unwrap() {
            formats.insert(id.as_i64().unwrap() as u32, format.clone());
        }
    }

    let (next, wrong, neither) = (AtomicUsize::new(0), Mutex::new(Vec::new()), Mutex::new(Vec::new()));
    let work = || {
        while let Some((at, case)) =
            Some(next.fetch_add(1, Ordering::Relaxed)).and_then(|at| Some((at, cases.get(at)?)))
        {
            // A case for the linux process needs no additions.
            let kind = if case.file.ends_with("linuxtest.test") { ".plain" } else { "" };
            let once = |name: &str| {
                let dictionary = folder.path().join(format!("{name}{kind}"));
                run(&checkout, &folder.path().join(format!("{name}{at}")), case, &dictionary, &formats)
            };
            // A thread of klippy writes what it sends. On a busy computer klippy can end before that thread has run.
            let end = |name: &str| {
                let again = (0..9).map(|_| once(name)).find(End::is_whole);
                again.unwrap_or_else(|| once(name))
            };
            let (ours, theirs) = (end("ours"), end("theirs"));
            if ours.failed != theirs.failed {
                let (which, log) = if ours.failed { ("ours", &ours.log) } else { ("the firmware's", &theirs.log) };
                wrong.lock().unwrap().push(format!("{} fails with {which} only:\n{log}", case.name()));
            } else if ours.configuration != theirs.configuration {
                wrong.lock().unwrap().push(format!("{}: {}", case.name(), difference(&ours, &theirs)));
            } else if !ours.is_whole() {
                wrong.lock().unwrap().push(format!("{} does not configure the MCU", case.name()));
            } else if theirs.failed != case.should_fail {
                neither.lock().unwrap().push(format!("{}:\n{}", case.name(), theirs.log));
            }
        }
    };
    thread::scope(|scope| {
        (0..thread::available_parallelism().map_or(1, usize::from)).for_each(|_| drop(scope.spawn(work)));
    });
    let (wrong, neither) = (wrong.into_inner().unwrap(), neither.into_inner().unwrap());
    let counts = format!("{} cases, {} go with neither dictionary", cases.len(), neither.len());
    println!("{counts}:\n{}", neither.join("\n"));
    assert!(wrong.is_empty(), "{counts}, {} differ:\n{}", wrong.len(), wrong.join("\n"));
    // A Python without SciPy cannot run the load cell's cases. If more cases failed, nothing would have been tested.
    assert!(cases.len() > 200 && neither.len() < 5, "{counts}:\n{}", neither.join("\n"));
}
