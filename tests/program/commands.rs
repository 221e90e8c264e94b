// SPDX-License-Identifier: GPL-3.0-or-later
//! The subcommands.

use std::collections::HashMap;
use std::fs;
use std::process::{Command, Stdio};

use nix::sys::signal::Signal;
use pinion_testkit::process::Running;
use pinion_testkit::{here, wait};
use serde_json::Value;

use crate::process::{Pinion, closed_pipe, folder_with, output, pinion_path, printed};

#[test]
fn a_demonstration_that_is_interrupted_ends_without_a_complaint() {
    wait::in_time(|_| {
        let mut pinion = Pinion::start(&["sim", "-r"]);
        pinion.until("the homing", || pinion.out().contains("home x"));
        assert!(matches!(pinion.scheduling("demo")[..], [(0, _)]), "its client is no part of the MCU (SCHED_OTHER)");
        pinion.signal(Signal::SIGINT);
        assert_eq!(pinion.end().code(), Some(0));
        assert!(!pinion.log().contains("ERROR"), "{}", pinion.log());
        assert!(!pinion.out().contains("until Ctrl-C"), "{}", pinion.out());
    });
}

#[test]
fn dict_prints_what_identify_serves() {
    for (dialect, args) in [("master", &[][..]), ("v0.13", &["--dialect", "v0.13"])] {
        let (_folder, file) = folder_with("dict", "");
        let dict = [&["dict", "--board", "sim"], args].concat();
        assert!(output(&[&dict[..], &["-o", file.to_str().unwrap()]].concat()).status.success());
        let pinion = Pinion::simulated(&["--dialect", dialect]);
        let served = pinion.client().dictionary().json().unwrap();
        // Not assert_eq, because it would print about ten thousand numbers.
        assert!(fs::read(&file).unwrap() == served, "{dialect}");
        assert!(output(&dict).stdout == served, "{dialect}");
    }
}

/// The dictionaries of the firmwares' own `linux` processes, with their dialect and their version.
const FIRMWARES: [(&str, &str); 5] = [
    // Klipper v0.11.0, v0.12.0, v0.13.0 and 84104bbbd (August 2026).
    ("v0.11", include_str!("../dictionaries/klipper-v0.11.json")),
    ("v0.12", include_str!("../dictionaries/klipper-v0.12.json")),
    ("v0.13", include_str!("../dictionaries/klipper-v0.13.json")),
    ("master", include_str!("../dictionaries/klipper-master.json")),
    // Kalico f2532ee34 (July 2026).
    ("kalico", include_str!("../dictionaries/kalico.json")),
];

/// Shutdown texts of the firmwares that cannot occur here: their threads, allocator, timers and limits are not ours. No
/// host matches on them (klippy/extras/error_mcu.py).
const NOT_OURS: [&str; 14] = [
    "Could not start DS18B20 reader thread",
    "Could not start DS18B20 reader thread (cond init)",
    "Could not start DS18B20 reader thread (mutex init)",
    "Error getting monotonic clock time",
    "Invalid move request size",
    "Message encode error",
    "Too many spi devices",
    "Unable to set non-blocking on spi device",
    "Unable to write to spi",
    "alloc_chunk failed",
    "alloc_chunks failed",
    "bus_type i2c unsupported",
    "bus_type spi unsupported",
    "sentinel timer called",
];

/// Kalico's firmware has this command only on its branch bleeding-edge-v2, built with CONFIG_HIGH_PREC_STEP.
const HIGH_PRECISION: &str = "queue_step_hp oid=%c interval=%u count=%hu add=%hi add2=%hi shift=%hi";

fn dictionary(dialect: &str) -> Value {
    serde_json::from_slice(&output(&["dict", "--dialect", dialect]).stdout).unwrap()
}

fn keys(object: &Value) -> Vec<&str> {
    let mut keys: Vec<&str> = object.as_object().unwrap().keys().map(String::as_str).collect();
    keys.sort_unstable();
    keys
}

fn strings(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().filter_map(Value::as_str).collect()
}

/// Each name of an enumeration with its value. A range stands for names with consecutive numbers.
fn expanded(enumeration: &Value) -> HashMap<String, u64> {
    let mut all = HashMap::new();
    for (name, value) in enumeration.as_object().unwrap() {
        let Some(range) = value.as_array() else {
            all.insert(name.clone(), value.as_u64().unwrap());
            continue;
        };
        let root = name.trim_end_matches(|c: char| c.is_ascii_digit());
        let begin: u64 = name[root.len()..].parse().unwrap_or(0);
        let (first, count) = (range[0].as_u64().unwrap(), range[1].as_u64().unwrap());
        all.extend((0..count).map(|n| (format!("{root}{}", begin + n), first + n)));
    }
    all
}

#[test]
fn each_dictionary_has_what_the_firmware_of_its_hosts_has() {
    for (dialect, theirs) in FIRMWARES {
        let ours = dictionary(dialect);
        let theirs: Value = serde_json::from_str(theirs).unwrap();
        for kind in ["commands", "responses"] {
            let mut expected = strings(&theirs[kind]);
            if (dialect, kind) == ("kalico", "commands") {
                expected.push(HIGH_PRECISION);
                expected.sort_unstable();
            }
            assert_eq!(keys(&ours[kind]), expected, "{dialect} {kind}");
        }
        let mut config = ours["config"].as_object().unwrap().clone();
        // Only ours: more than the 192 bytes that a host assumes.
        assert!(config.remove("RECEIVE_WINDOW").is_some_and(|window| window.as_u64() >= Some(512)));
        assert_eq!(Value::Object(config), theirs["config"], "{dialect}");
        for (name, values) in theirs["enumerations"].as_object().unwrap() {
            let ours = &ours["enumerations"][name];
            if !["pin", "spi_bus", "i2c_bus"].contains(&name.as_str()) {
                assert_eq!(ours, values, "{dialect} {name}");
                continue;
            }
            // The MCU's enumerations have at least the names of Klipper's C, with its numbers. v0.11 had other
            // numbers for the lines of GPIO chips. A host does not interpret these numbers.
            let ours = expanded(ours);
            for (entry, value) in expanded(values) {
                let found = ours.get(&entry).copied();
                let other_number = dialect == "v0.11" && entry.starts_with("gpiochip");
                assert_eq!(found, if other_number { found.or(Some(value)) } else { Some(value) }, "{dialect} {entry}");
                assert!(found.is_some(), "{dialect} {entry}");
            }
        }
        let mut known = keys(&theirs["enumerations"]);
        known.push("static_string_id");
        known.sort_unstable();
        assert_eq!(keys(&ours["enumerations"]), known, "{dialect}");
        let texts = keys(&ours["enumerations"]["static_string_id"]);
        let missing: Vec<&str> =
            strings(&theirs["static_strings"]).into_iter().filter(|text| !texts.contains(text)).collect();
        let expected: Vec<&str> =
            NOT_OURS.into_iter().filter(|text| strings(&theirs["static_strings"]).contains(text)).collect();
        assert_eq!(missing, expected, "{dialect}");
        let named = ["v0.11", "v0.12"].contains(&dialect);
        for (key, is_there) in [("version", true), ("build_versions", true), ("app", !named), ("license", !named)] {
            assert_eq!(ours[key].as_str().is_some_and(|text| !text.is_empty()), is_there, "{dialect} {key}");
        }
    }
}

#[test]
fn ids_are_as_the_hosts_can_take_them() {
    for dialect in ["v0.11", "v0.12", "v0.13", "master", "kalico", "union"] {
        let ours = dictionary(dialect);
        let ids = |kind: &str| -> HashMap<String, i64> {
            let messages = ours[kind].as_object().unwrap();
            messages
                .iter()
                .map(|(format, id)| (format.split(' ').next().unwrap().to_owned(), id.as_i64().unwrap()))
                .collect()
        };
        let (commands, responses) = (ids("commands"), ids("responses"));
        // A host finds a message by its name. So a name has one form, and an id one message.
        assert_eq!(commands.len(), ours["commands"].as_object().unwrap().len(), "{dialect}");
        assert_eq!(responses.len(), ours["responses"].as_object().unwrap().len(), "{dialect}");
        let mut all: Vec<i64> = commands.values().chain(responses.values()).copied().collect();
        all.sort_unstable();
        let count = all.len();
        all.dedup();
        assert_eq!(all.len(), count, "{dialect}");
        assert_eq!((commands["identify"], responses["identify_response"]), (1, 0));
        // Ids of one byte: all messages for hosts that know no others, and messages that are frequent or come in full
        // blocks.
        let short = |id: &i64| (-32..96).contains(id);
        if ["v0.11", "v0.12"].contains(&dialect) {
            assert!(all.iter().all(short), "{dialect}");
        }
        assert!(responses.values().all(short), "{dialect}");
        for often in ["queue_step", "set_next_step_dir", "queue_digital_out", "queue_pwm_out", "trsync_set_timeout"] {
            assert!(short(&commands[often]), "{dialect} {often}");
        }
        // klippy's C code requires nonnegative ids for these.
        for plain in ["queue_step", "set_next_step_dir", "trsync_set_timeout", "trsync_trigger"] {
            assert!(commands[plain] >= 0, "{dialect} {plain}");
        }
        assert!(responses["trsync_state"] >= 0, "{dialect}");
        if ["kalico", "union"].contains(&dialect) {
            assert!((0..96).contains(&commands["queue_step_hp"]), "{dialect}");
        }
    }
}

/// A host of v0.13, of master or of Kalico finds all its messages in the union, except for these. The three have them
/// in different forms.
#[test]
fn the_union_is_what_three_dialects_have() {
    let union = dictionary("union");
    let mut other_forms = Vec::new();
    for (dialect, theirs) in FIRMWARES.iter().filter(|(dialect, _)| ["v0.13", "master", "kalico"].contains(dialect)) {
        let theirs: Value = serde_json::from_str(theirs).unwrap();
        for kind in ["commands", "responses"] {
            let ours = keys(&union[kind]);
            let missing = strings(&theirs[kind]).into_iter().filter(|format| !ours.contains(format));
            other_forms.extend(missing.map(|format| format!("{dialect} {}", format.split(' ').next().unwrap())));
        }
    }
    let expected = [
        // If it is v0.13's form, master's host accepts it as well (klippy/mcu.py, MCU_adc).
        "master query_analog_in",
        "master analog_in_state",
        "kalico config_ads131m0x",
        "kalico config_ds18b20",
        "kalico sos_filter_set_active",
    ];
    assert_eq!(other_forms, expected);
}

#[test]
fn a_dialect_that_is_none_is_explained() {
    for command in ["run", "dict"] {
        let refused = output(&[command, "--dialect", "v0.10"]);
        assert!(!refused.status.success());
        let text = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(text.contains("v0.11, v0.12, v0.13, master, kalico, union"), "{text}");
    }
}

#[test]
fn a_board_that_is_none_is_explained() {
    let (_folder, toml) = folder_with("bad.toml", "[[axis]]\nname = \"x\"\nstep_pin = \"s\"\nwheels = 4\n");
    let board = format!("sim:{}", toml.display());
    let mut pinion = Pinion::start(&["run", "--board", &board]);
    assert_eq!(pinion.end().code(), Some(1));
    assert!(pinion.log().contains("wheels"), "{}", pinion.log());
    let refused = output(&["run", "--board", "toaster"]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("linux, sim and sim:FILE.toml"));
}

#[test]
fn the_latency_is_not_measured_while_a_host_may_print() {
    here::among_own_processes("commands::the_latency_is_not_measured_while_a_host_may_print", || {
        // Not a simulated printer, even if this computer has no pins.
        let pinion = Pinion::start(&["run", "--dialect", "master"]);
        pinion.wait_for_link();
        let client = pinion.client();
        let refused = output(&["latency", "--seconds", "1"]);
        let text = String::from_utf8(refused.stderr).unwrap();
        assert_eq!((refused.status.code(), refused.stdout.len()), (Some(1), 0), "{text}");
        for part in [
            format!("a host (process {}) is attached to Pinion (process {}", std::process::id(), pinion.pid()),
            format!("wait until the print is done, then end process {}", std::process::id()),
        ] {
            assert!(text.contains(&part), "no \"{part}\" in: {text}");
        }
        drop(client);
        let measured = output(&["latency", "--seconds", "1"]);
        assert!(measured.status.success(), "{}", String::from_utf8_lossy(&measured.stderr));
    });
}

#[test]
fn latency_judges_the_computer() {
    here::among_own_processes("commands::latency_judges_the_computer", || {
        let (_folder, svg) = folder_with("latency.svg", "");
        let measured = output(&["latency", "--seconds", "1", "--svg", svg.to_str().unwrap()]);
        let text = String::from_utf8(measured.stdout).unwrap();
        assert!(measured.status.success(), "{text}");
        for part in ["idle:", "under load:", "wake-ups", "edges", "verdict: ", "to share: Pinion "] {
            assert!(text.contains(part), "no \"{part}\" in:\n{text}");
        }
        let measured = output(&["latency", "--seconds", "1", "--json"]);
        let figures: Value = serde_json::from_slice(&measured.stdout).unwrap();
        let latency = &figures["latency"];
        assert!(latency["fit_for_steppers"].is_boolean() && figures["computer"].is_string(), "{figures}");
        for half in ["idle", "under_load"] {
            let late = &latency[half]["edges"];
            assert!(late["p999"].as_f64() <= late["max"].as_f64() && late["events"].as_u64() > Some(0), "{figures}");
        }
    });
}

#[test]
fn a_reader_that_has_seen_enough_changes_nothing_but_what_is_printed() {
    here::among_own_processes("commands::a_reader_that_has_seen_enough_changes_nothing_but_what_is_printed", || {
        for args in [
            &["sim", "--print-config"][..],
            &["sim", "--print-board"],
            &["dict", "--board", "sim"],
            &["pins"],
            &["latency", "--seconds", "1"],
        ] {
            let child =
                Command::new(pinion_path()).args(args).stdout(closed_pipe()).stderr(Stdio::piped()).spawn().unwrap();
            let closed = child.wait_with_output().unwrap();
            let log = String::from_utf8(closed.stderr).unwrap();
            assert!(!log.contains("panicked"), "{args:?}: {log}");
            // A computer without pins cannot list any.
            let expected = if args == ["pins"] { output(args).status.code() } else { Some(0) };
            assert_eq!(closed.status.code(), expected, "{args:?}: {log}");
        }
    });
}

#[test]
fn the_version_names_the_state_of_the_sources_and_the_dictionary_has_the_same() {
    let version = printed(&["--version"]);
    let version = version.trim().strip_prefix("pinion ").unwrap();
    let (number, state) = version.split_once('-').unwrap_or((version, ""));
    assert_eq!(number, env!("CARGO_PKG_VERSION"));
    let head = Command::new("git").args(["rev-parse", "--verify", "HEAD"]).output();
    // Without git, for example in an unpacked archive, it reports no state.
    if head.is_ok_and(|head| head.status.success()) {
        let commit = state.strip_suffix("-dirty").unwrap_or(state).strip_prefix('g').unwrap();
        assert!(commit.len() >= 12 && commit.chars().all(|digit| digit.is_ascii_hexdigit()), "{version}");
    }
    let dictionary: Value = serde_json::from_slice(&output(&["dict", "--board", "sim"]).stdout).unwrap();
    assert_eq!(dictionary["version"], format!("pinion-{version}"));
    // As in the output of `rustc --version`, without the name `rustc`.
    let compiler = dictionary["build_versions"].as_str().unwrap().strip_prefix("rustc: ").unwrap();
    let number = compiler.split_whitespace().next().unwrap();
    assert!(number.split('.').count() == 3 && !compiler.contains("later"), "{compiler}");
}

#[test]
fn shells_get_completions_with_every_subcommand_and_option() {
    for shell in ["bash", "zsh", "fish"] {
        let script = output(&["completions", shell]);
        assert!(script.status.success());
        let script = String::from_utf8(script.stdout).unwrap();
        for word in ["doctor", "latency", "sim", "dialect"] {
            assert!(script.contains(word), "{shell} knows no {word}");
        }
        let of_the_simulator = output(&["sim", "completions", shell]);
        assert!(of_the_simulator.status.success());
        let of_the_simulator = String::from_utf8(of_the_simulator.stdout).unwrap();
        for word in ["pinion-sim", "print-config", "toolpath"] {
            assert!(of_the_simulator.contains(word), "{shell} knows no {word}");
        }
        // Values of the options that have fixed values instead of files.
        for word in ["linux", "auto", "kalico", "trace"] {
            assert!(script.contains(word), "{shell} offers no {word}");
        }
    }
    // bash's own result.
    let script = printed(&["completions", "bash"]);
    for (words, offered) in [
        ("--board ''", "linux sim"),
        ("run --dialect v0.1", "v0.11 v0.12 v0.13"),
        ("status --log-level de", "debug"),
        ("console --board ''", "sim"),
        ("run --cpu ''", ""),
        ("sim --print-b", "--print-board"),
        ("sim --compar", "--compare"),
    ] {
        let last = words.split(' ').count();
        let ask = format!(
            "COMP_WORDS=(pinion {words}); COMP_CWORD={last}; _pinion pinion \"${{COMP_WORDS[-1]}}\" \"${{COMP_WORDS[-2]}}\"; echo \"${{COMPREPLY[*]}}\""
        );
        let bash = Command::new("bash").args(["--norc", "-c", &format!("{script}\n{ask}")]).output().unwrap();
        assert_eq!(String::from_utf8_lossy(&bash.stdout).trim(), offered, "{words}");
    }
}

#[test]
fn the_recipe_for_ci_ends_if_the_simulated_printer_cannot_start() {
    const PAGE: &str = include_str!("../../docs/guide/simulated-printer.md");
    let mut blocks = PAGE.split("```sh\n").skip(1).filter_map(|block| block.split("```").next());
    let recipe = blocks.find(|block| block.contains("--compare part.gcode -I")).unwrap();
    let (folder, _) = folder_with("printer.toml", "no_such_key = 1\n");
    let recipe = recipe.replace("/tmp/printer", folder.path().join("tty").to_str().unwrap());
    let program = pinion_path().parent().unwrap();
    let log = folder.path().join("log");
    let shell = Command::new("sh")
        .args(["-c", &recipe])
        .current_dir(&folder)
        .env("PATH", format!("{}:{}", program.display(), std::env::var("PATH").unwrap()))
        .stderr(fs::File::create(&log).unwrap())
        .spawn();
    let mut shell = Running(shell.unwrap());
    let status = wait::until_some(|| shell.0.try_wait().unwrap(), || "its end".into());
    let log = fs::read_to_string(log).unwrap();
    assert_eq!(status.code(), Some(1), "{log}");
    assert!(log.contains("no_such_key"), "{log}");
}
