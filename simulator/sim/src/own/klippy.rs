// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's own verdict: its batch mode reads the copy of a configuration, with dictionaries of the simulated MCUs.
//!
//! A batch run also runs the templates of a printer.cfg. So it has no more rights than the klippy of a trial, and it is
//! never root's.

use std::fs::{self, File};
use std::io;
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use nix::unistd::geteuid;
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{Dialect, Forms};
use pinion_linux::clock::Monotonic;
use pinion_linux::foreign;
use pinion_model::{SimConfig, SimWorld};
use pinion_printer_config::{Config, Place, Section, Trouble};
use pinion_runtime::FIRMWARE;
use pinion_runtime::klippy::Checkout;

use super::args::OwnArgs;
use super::known::near;
use super::serve::{Folder, Own};
use crate::attempt::place::place_of;
use crate::attempt::{self, rights};

/// How long klippy may take. It ends after some two seconds on a Raspberry Pi 3.
const TIMEOUT: Duration = Duration::from_secs(60);
/// How long it may take to end once it has read all of a configuration. Some modules then wait for a chip's answer, and
/// nobody answers.
const READY_TIME: Duration = Duration::from_secs(3);
/// Longest output that is read.
const OUTPUT_MAX: u64 = 4 << 20;
/// klippy's words when it has read all of a configuration.
const CONFIGURED: &str = "Configured MCU '";
/// The exceptions by which klippy refuses a configuration. Kalico's modules are in a package `klippy`.
const REFUSALS: [&str; 4] = ["configparser.Error", "configparser.ParsingError", "configfile.error", "pins.error"];
/// The exception of a command.
const OF_COMMAND: &str = "gcode.CommandError";

/// A klippy that can be asked.
pub(super) struct Klippy {
    /// The checkout.
    pub(super) folder: PathBuf,
    python: PathBuf,
}

impl Klippy {
    /// The klippy that the user has named, or that this computer has. `None` for root.
    pub(super) fn of(args: &OwnArgs) -> Option<Klippy> {
        let folder = args.klipper().filter(|folder| folder.join("klippy/klippy.py").is_file())?;
        let python = attempt::python(args.python(), &folder);
        let klippy = Klippy { folder, python };
        // Files that root can read are not for the user as whom klippy could run.
        if geteuid().is_root() {
            if args.names_klipper() {
                klippy.unasked("it never runs as root: call this as an ordinary user");
            }
            return None;
        }
        Some(klippy)
    }

    /// Asks it about a configuration. Returns whether it has judged.
    ///
    /// # Errors
    ///
    /// klippy refuses the configuration: its words, with the line.
    pub(super) fn judge(&self, own: &Own) -> Result<bool, Trouble> {
        match self.output(own) {
            Ok(output) => match refusal(&output) {
                // A module may ask for pins that no option names, and the simulated MCUs have none of these.
                Some(words) if words.contains("is not a valid pin name") => {
                    self.unasked(&words);
                    Ok(false)
                }
                Some(words) => Err(refused(&own.config, &words)),
                None if output.contains(CONFIGURED) => Ok(true),
                None => {
                    let last = output.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("it says nothing");
                    self.unasked(last);
                    Ok(false)
                }
            },
            Err(error) => {
                self.unasked(&error.to_string());
                Ok(false)
            }
        }
    }

    fn unasked(&self, why: &str) {
        log::warn!(
            "klippy of {} cannot be asked about this printer.cfg, so only some of its rules are checked: {why}",
            self.folder.display()
        );
    }

    /// klippy's verdict.
    fn output(&self, own: &Own) -> io::Result<String> {
        let folder = Folder::make(own, None, None).map_err(|trouble| io::Error::other(trouble.to_string()))?;
        let output = self.run(own, &folder);
        // The folder is in /tmp. Files that stay there do no harm.
        let _ = fs::remove_dir_all(&folder.path);
        output
    }

    fn run(&self, own: &Own, folder: &Folder) -> io::Result<String> {
        let checkout = Checkout::read(&self.folder.join("klippy"), FEATURES)?;
        let said = folder.path.join("klippy.out");
        let out = File::create(&said)?;
        let mut arguments = vec![self.folder.join("klippy/klippy.py").into_os_string()];
        arguments.push(folder.printer_cfg.clone().into());
        // klippy makes a file for each MCU beside the named one.
        let [input, sent] = ["gcode", "sent"].map(|name| folder.path.join(name));
        fs::write(&input, "")?;
        arguments.extend(["-i".into(), input.into(), "-o".into(), sent.into()]);
        for (number, (mcu, dictionary)) in dictionaries(&own.sim, &checkout)?.into_iter().enumerate() {
            let path = folder.path.join(format!("dictionary-{number}"));
            fs::write(&path, dictionary)?;
            arguments.push("-d".into());
            arguments.push(if number == 0 { path.into() } else { format!("{mcu}={}", path.display()).into() });
        }
        let mut command = rights::confined();
        command
            .arg(&self.python)
            .args(arguments)
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("GIT_DIR", folder.path.join("none"));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(out);
        let mut child = command.spawn()?;
        let output = || Ok::<_, io::Error>(String::from_utf8_lossy(&foreign::read(&said, OUTPUT_MAX)?).into_owned());
        let mut until = Instant::now() + TIMEOUT;
        let mut is_configured = false;
        while child.try_wait()?.is_none() {
            if !is_configured && output()?.contains(CONFIGURED) {
                (is_configured, until) = (true, Instant::now() + READY_TIME);
            }
            if Instant::now() > until {
                child.kill()?;
                child.wait()?;
                if is_configured {
                    break;
                }
                return Err(io::ErrorKind::TimedOut.into());
            }
            thread::sleep(Duration::from_millis(50));
        }
        output()
    }
}

/// The dictionary of each simulated MCU, in the form that this host looks up, with its name.
fn dictionaries(sim: &SimConfig, checkout: &Checkout) -> io::Result<Vec<(String, Vec<u8>)>> {
    let world = SimWorld::new(sim.clone(), Arc::new(Monotonic::start()));
    let world = world.map_err(|trouble| io::Error::other(trouble.to_string()))?;
    let dictionary = |board: &pinion_model::SimBoard| {
        let dialect = Dialect::new(&FIRMWARE, board, Forms::Host(checkout.forms.clone()))?;
        Ok((board.name().to_owned(), dialect.dictionary().json().map_err(io::Error::other)?))
    };
    world.boards.iter().map(dictionary).collect()
}

/// klippy's words when it refuses a configuration. A message may have a second line.
fn refusal(output: &str) -> Option<String> {
    // A macro that cannot be read is refused by the exception of a command, which the start of a macro may have, too.
    let is_early = output.contains("Unhandled exception during connect");
    let lines: Vec<&str> = output.lines().collect();
    let found = lines.iter().enumerate().rev().find_map(|(at, line)| {
        let (exception, words) = line.split_once(": ")?;
        let exception = exception.trim_start_matches("klippy.");
        (REFUSALS.contains(&exception) || is_early && exception == OF_COMMAND).then_some((at, words))
    });
    let (at, words) = found?;
    match &lines[at + 1..] {
        [second] if !second.trim().is_empty() => Some(format!("{words}: {}", second.trim())),
        _ => Some(words.to_owned()),
    }
}

/// A refusal, with the line that it is about.
fn refused(config: &Config, words: &str) -> Trouble {
    let trouble = Trouble::new(words.to_owned());
    let trouble = match place_of(config, words).or_else(|| place_of_value(config, words)) {
        Some(place) => trouble.of(place),
        None => trouble,
    };
    let section = words.strip_prefix("Section '").and_then(|rest| rest.split_once("' is not a valid config section"));
    match section {
        Some((section, _)) => trouble.remedy(match near(section.split(' ').next().unwrap_or(section)) {
            Some(near) => format!("did you mean [{near}]?"),
            None => "klippy needs its module, or give --without-plugins".to_owned(),
        }),
        None => trouble.remedy("correct it: klippy refuses it"),
    }
}

/// The first option with the value that klippy quotes, or with a pin of the chip that it quotes. Without a quote: the
/// section that its words name.
fn place_of_value(config: &Config, words: &str) -> Option<Place> {
    let settings = || config.sections().iter().flat_map(Section::settings);
    match words.split('\'').nth(1) {
        Some(quoted) => {
            let has = |value: &str| {
                let value = value.trim_start_matches(['^', '~', '!', ' ']);
                value == quoted || value.split_once(':').is_some_and(|(chip, _)| chip.trim() == quoted)
            };
            settings()
                .find(|setting| setting.value.split(',').any(|part| has(part.trim())))
                .map(|one| one.place.clone())
        }
        None => {
            // "tmc virtual endstop requires diag pin config"
            let is_its = |section: &Section, word: &str| {
                word == section.kind() || word == "tmc" && section.kind().starts_with(word)
            };
            let is_named = |section: &&Section| {
                section.kind() != "mcu" && words.split([' ', ':']).any(|word| is_its(section, word))
            };
            config.sections().iter().find(is_named).map(|section| section.place.clone())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn klippy_refuses_by_its_own_exceptions_only() {
        let words = |output: &str| refusal(output);
        let output = "Config error\nTraceback (most recent call last):\n  File \"x.py\", line 1\nconfigparser.Error: Option \
                      'a' in section 'b' must be specified\n\nStarting\n";
        assert_eq!(words(output).unwrap(), "Option 'a' in section 'b' must be specified");
        assert_eq!(words("x\npins.error: pin PA1 used twice\n").unwrap(), "pin PA1 used twice");
        let of_macro = "gcode.CommandError: Error loading template 'gcode_macro A:gcode'\nline 3: x\n";
        assert_eq!(words(of_macro), None, "a macro that runs at the start");
        let at_connect = format!("Unhandled exception during connect\n{of_macro}");
        assert_eq!(words(&at_connect).unwrap(), "Error loading template 'gcode_macro A:gcode': line 3: x");
        assert_eq!(words("Configured MCU 'mcu' (1024 moves)\nmcu.error: no answer\nOSError: x\n"), None);
    }
}
