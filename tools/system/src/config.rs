// SPDX-License-Identifier: GPL-3.0-or-later
//! The configuration file of `pinion run`: the options of the command line, by name.

use std::fmt;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;

use toml::de::{DeTable, DeValue};

use pinion_firmware::mcu::Tolerances;
use pinion_firmware::trouble::Trouble;

use super::files;
use super::settings::{Given, MARGIN_MAX_US, mode};

/// The file that the service reads.
pub const SYSTEM_FILE: &str = "/etc/pinion/pinion.toml";
/// Longest configuration.
const CONFIG_MIB: u64 = 1;

/// The remedy for a line that is no TOML.
const LINE: &str = "write a key, = and its value, such as realtime = true";

/// A key of the file.
struct Key {
    name: &'static str,
    /// An example of its value, for error messages.
    example: &'static str,
    /// Takes the value in. The error says what is wrong with it, if the example does not make that clear.
    set: fn(&mut Given, &DeValue<'_>) -> Result<(), Option<String>>,
}

impl Key {
    /// The error about its value, and how to write it.
    fn wrong(&self, why: Option<String>) -> Trouble {
        let Key { name, example, .. } = self;
        let form = format!("write it such as {name} = {example}");
        match why {
            Some(why) => Trouble::new(why).remedy(form),
            None => Trouble::new(form),
        }
        .of(name)
    }
}

/// The key whose value is not TOML, such as `mode = 0660`. This says more than the parser.
fn key_at(text: &str, mistake: Option<Range<usize>>) -> Option<&'static Key> {
    let before = text.get(..mistake?.start)?;
    let (name, _) = before.rsplit('\n').next()?.split_once('=')?;
    KEYS.iter().find(|key| key.name == name.trim())
}

/// Every option of `pinion run`, in the order of its `--help`.
const KEYS: [Key; 15] = [
    Key {
        name: "symlink",
        example: "\"/tmp/klipper_host_mcu\"",
        set: |given, value| put(&mut given.symlink, text(value)?.into()),
    },
    Key { name: "link", example: "\"serial:/dev/ttyGS0\"", set: |given, value| put(&mut given.link, word(value)?) },
    Key { name: "realtime", example: "true", set: |given, value| put(&mut given.realtime, flag(value)?) },
    Key { name: "cpu", example: "3", set: |given, value| put(&mut given.cpu, number(value)?) },
    Key {
        name: "margin_us",
        example: "200",
        set: |given, value| match number(value)? {
            margin if margin <= MARGIN_MAX_US => put(&mut given.margin, margin),
            _ => Err(Some(format!("{MARGIN_MAX_US} is the most"))),
        },
    },
    Key { name: "watchdog", example: "true", set: |given, value| put(&mut given.watchdog, flag(value)?) },
    Key {
        name: "mode",
        example: "\"0660\"",
        set: |given, value| put(&mut given.mode, mode(text(value)?).map_err(Some)?),
    },
    Key { name: "group", example: "\"tty\"", set: |given, value| put(&mut given.group, text(value)?.to_owned()) },
    Key { name: "board", example: "\"linux\"", set: |given, value| put(&mut given.board, word(value)?) },
    Key { name: "dialect", example: "\"auto\"", set: |given, value| put(&mut given.dialect, word(value)?) },
    Key { name: "fast_gpio", example: "\"auto\"", set: |given, value| put(&mut given.fast_gpio, word(value)?) },
    Key {
        name: "tolerate",
        example: "{ \"i2c.1/0x76\" = \"30s\" }",
        set: |given, value| put(&mut given.tolerances, tolerances(value)?),
    },
    Key { name: "trace_edges", example: "true", set: |given, value| put(&mut given.trace_edges, flag(value)?) },
    Key {
        name: "socket",
        example: "\"/run/pinion/mcu.sock\"",
        set: |given, value| put(&mut given.socket, text(value)?.into()),
    },
    Key {
        name: "log_level",
        example: "\"info\"",
        set: |given, value| {
            let level = text(value)?.parse();
            put(
                &mut given.log_level,
                level.map_err(|_| Some("there are error, warn, info, debug, trace and off".into()))?,
            )
        },
    },
];

fn put<T>(place: &mut Option<T>, value: T) -> Result<(), Option<String>> {
    *place = Some(value);
    Ok(())
}

fn text<'a>(value: &'a DeValue<'_>) -> Result<&'a str, Option<String>> {
    value.as_str().filter(|text| !text.is_empty()).ok_or(None)
}

fn flag(value: &DeValue<'_>) -> Result<bool, Option<String>> {
    value.as_bool().ok_or(None)
}

fn number<N: FromStr>(value: &DeValue<'_>) -> Result<N, Option<String>> {
    let number = value.as_integer().filter(|number| number.radix() == 10);
    number.and_then(|number| number.as_str().parse().ok()).ok_or(None)
}

fn word<T: FromStr<Err = String>>(value: &DeValue<'_>) -> Result<T, Option<String>> {
    text(value)?.parse().map_err(Some)
}

/// Devices, each with a time.
fn tolerances(value: &DeValue<'_>) -> Result<Tolerances, Option<String>> {
    let table = value.as_table().ok_or(None)?;
    let one = |(device, limit): (&toml::Spanned<std::borrow::Cow<'_, str>>, &toml::Spanned<DeValue<'_>>)| {
        let device = device.get_ref().parse().map_err(|why| Some(format!("{}: {why}", device.get_ref())))?;
        Ok((device, word(limit.get_ref())?))
    };
    table.iter().map(one).collect()
}

/// Reads the file.
///
/// # Errors
///
/// The file, the line and column, the key, and what to write.
pub fn load(path: &Path) -> Result<Given, Trouble> {
    load_foreign(path, &path.display().to_string())
}

/// The same for a file that another process names as `file`.
pub fn load_foreign(path: &Path, file: &str) -> Result<Given, Trouble> {
    let bytes = files::read(path, CONFIG_MIB).map_err(|error| {
        let trouble = Trouble::new(error.to_string()).of(file);
        trouble.remedy("name a configuration that can be read, or leave out --config")
    })?;
    read(&bytes, &file)
}

/// Reads the bytes of a file. Errors call it `file`.
///
/// # Errors
///
/// The line and column, the key, and what to write.
pub fn read(bytes: &[u8], file: &dyn fmt::Display) -> Result<Given, Trouble> {
    match std::str::from_utf8(bytes) {
        Ok(text) if text.contains('\0') => {
            let trouble =
                Trouble::new("there are zero bytes, as a power cut leaves them").remedy("write the file again");
            Err(trouble.at(file, text, text.find('\0').unwrap_or(0)))
        }
        Ok(text) => parse(text, file),
        Err(error) => {
            let good = String::from_utf8_lossy(&bytes[..error.valid_up_to()]);
            Err(Trouble::new("this is not UTF-8 text").remedy("write the file again").at(file, &good, good.len()))
        }
    }
}

/// Reads the text of a file. Errors call it `file`.
fn parse(text: &str, file: &dyn fmt::Display) -> Result<Given, Trouble> {
    let wrong = |span: Option<Range<usize>>, what: Trouble| what.at(file, text, span.map_or(0, |span| span.start));
    let table = DeTable::parse(text)
        .map_err(|error| {
            let what = match key_at(text, error.span()) {
                Some(key) => key.wrong(None),
                None => Trouble::new(error.message().trim().replace('\n', ": ")).remedy(LINE),
            };
            wrong(error.span(), what)
        })?
        .into_inner();
    // A map sorts its keys. People correct a file from its top.
    let mut entries: Vec<_> = table.iter().collect();
    entries.sort_by_key(|(key, _)| key.span().start);
    let mut given = Given::default();
    for (name, value) in entries {
        let Some(key) = KEYS.iter().find(|key| key.name == name.get_ref()) else {
            return Err(wrong(Some(name.span()), unknown(name.get_ref())));
        };
        (key.set)(&mut given, value.get_ref()).map_err(|why| wrong(Some(value.span()), key.wrong(why)))?;
    }
    Ok(given)
}

/// Highest number of wrong letters in a name for which another name is suggested.
const LETTERS_WRONG: usize = 3;

fn unknown(name: &str) -> Trouble {
    let distance = |key: &Key| match key.name.starts_with(name) && !name.is_empty() {
        true => 1,
        false => strsim::damerau_levenshtein(&name.to_lowercase().replace('-', "_"), key.name),
    };
    // Two short names are as far apart as they are long, so the length counts too.
    let is_near = |key: &&Key| distance(key) <= LETTERS_WRONG.min(key.name.len() / 2);
    let meant = match KEYS.iter().filter(is_near).min_by_key(|key| distance(key)) {
        Some(key) => format!("did you mean {}?", key.name),
        None => format!("there are {}", KEYS.map(|key| key.name).join(", ")),
    };
    Trouble::new("there is no such key").remedy(meant).of(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::fs;

    fn error(text: &str) -> String {
        parse(text, &"f.toml").unwrap_err().to_string()
    }

    #[test]
    fn the_file_that_is_installed_says_every_key_with_its_default() {
        let installed = include_str!("../../../systemd/pinion.toml");
        assert_eq!(parse(installed, &"").unwrap(), Given::default(), "all of it is a comment");
        // A line such as `#cpu = 3` is a setting. The others are prose.
        let settings: Vec<&str> = installed
            .lines()
            .filter_map(|line| line.strip_prefix('#'))
            .filter(|line| {
                line.split_once(" = ").is_some_and(|(key, _)| key.chars().all(|c| c.is_ascii_lowercase() || c == '_'))
            })
            .collect();
        let names: Vec<&str> = settings.iter().map(|line| line.split(' ').next().unwrap()).collect();
        assert_eq!(names, KEYS.map(|key| key.name));
        let mut given = parse(&settings.join("\n"), &"").unwrap();
        // These have no default that could be written down: any processor, and "tty if that is permitted".
        assert_eq!((given.cpu.take(), given.group.take().as_deref()), (Some(3), Some("tty")));
        assert_eq!(given.tolerances.take().unwrap().len(), 2);
        // These are the service's own.
        assert_eq!(given.realtime.take(), Some(true));
        assert_eq!(given.link.take().unwrap().to_string(), "pty:/run/pinion/klipper_host_mcu");
        assert_eq!(given.symlink.take().unwrap(), Path::new("/run/pinion/klipper_host_mcu"));
        assert_eq!(given.socket.take().unwrap(), Path::new("/run/pinion/mcu.sock"));
        assert_eq!(given.log_level.take(), Some(log::LevelFilter::Info));
        assert_eq!(format!("{:?}", given.settings()), format!("{:?}", Given::default().settings()));
    }

    #[test]
    fn every_key_has_an_example_that_is_right() {
        for key in KEYS {
            let given = parse(&format!("{} = {}", key.name, key.example), &"").unwrap();
            assert_ne!(given, Given::default(), "{}", key.name);
        }
    }

    #[test]
    fn a_wrong_value_is_reported_with_its_place() {
        assert_eq!(error("realtme = true"), "f.toml:1:1: realtme: there is no such key: did you mean realtime?");
        assert_eq!(
            error("cpu = 1\n\n  Margin = 3"),
            "f.toml:3:3: Margin: there is no such key: did you mean margin_us?"
        );
        assert_eq!(
            error("log-level = \"info\""),
            "f.toml:1:1: log-level: there is no such key: did you mean log_level?"
        );
        let all = error("[printer]\nx = 1");
        assert!(
            all.starts_with("f.toml:1:2: printer: there is no such key: there are symlink, link, realtime, cpu"),
            "{all}"
        );
        assert_eq!(error("# größe\ncpu = \"3\""), "f.toml:2:7: cpu: write it such as cpu = 3");
        assert_eq!(error("cpu = -1"), "f.toml:1:7: cpu: write it such as cpu = 3");
        assert_eq!(
            error("margin_us = 20000"),
            "f.toml:1:13: margin_us: 10000 is the most: write it such as margin_us = 200"
        );
        assert_eq!(
            error("mode = \"0999\""),
            "f.toml:1:8: mode: this is not an octal number up to 0777: write it such as mode = \"0660\""
        );
        assert!(error("board = \"toaster\"").contains("f.toml:1:9: board: there are the boards linux, sim"));
        assert!(error("dialect = \"v0.10\"").contains("f.toml:1:11: dialect: there are the dialects "));
        assert!(error("log_level = \"loud\"").contains("there are error, warn, info, debug, trace and off"));
        // The first of two mistakes is reported, whatever their keys are.
        assert!(error("watchdog = 1\ncpu = true").starts_with("f.toml:1:12: watchdog: "));
    }

    #[test]
    fn text_that_is_no_toml_is_reported_with_its_place() {
        for (text, place) in [("cpu = ", "1:7: "), ("cpu = 3\ncpu = 4", "2:1: "), ("\nrealtime true", "2:10: ")] {
            let error = error(text);
            assert!(error.starts_with(&format!("f.toml:{place}")) && !error.contains('\n'), "{text}: {error}");
        }
    }

    #[test]
    fn text_that_is_no_toml_is_reported_with_the_way_to_write_it() {
        for (text, refusal) in [
            ("mode = 0660", "1:8: mode: write it such as mode = \"0660\""),
            ("mode = 0o660", "1:8: mode: write it such as mode = \"0660\""),
            ("cpu = 3\nmode=0660 # octal", "2:6: mode: write it such as mode = \"0660\""),
            ("symlink = /tmp/x", "1:11: symlink: write it such as symlink = \"/tmp/klipper_host_mcu\""),
        ] {
            assert_eq!(error(text), format!("f.toml:{refusal}"));
        }
        assert_eq!(parse("mode = \"0640\"", &"").unwrap().mode, Some(0o640));
    }

    #[test]
    fn a_file_that_is_not_there_or_no_text() {
        let error = load(Path::new("/nonexistent.toml")).unwrap_err().to_string();
        assert!(error.starts_with("/nonexistent.toml: No such file"), "{error}");
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), b"cpu = 3\n#\xff").unwrap();
        assert!(load(file.path()).unwrap_err().to_string().contains(":2:2: this is not UTF-8"));
    }

    proptest! {
        #[test]
        fn any_text_is_a_configuration_or_an_error_of_one_line(text in "[a-z_ =\"0-9\\[\\]\n#.é']{0,60}") {
            if let Err(error) = parse(&text, &"f") {
                prop_assert!(!error.to_string().contains('\n'), "{}", error);
            }
        }
    }
}
