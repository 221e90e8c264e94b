// SPDX-License-Identifier: GPL-3.0-or-later
//! The line of the configuration that klippy's words are about.

use pinion_printer_config::pins::Aliases;
use pinion_printer_config::{Config, Place, Section};

/// The texts between single or double quotes.
fn quoted(message: &str) -> Vec<&str> {
    let parts = |quote: char| -> Vec<&str> { message.split(quote).skip(1).step_by(2).collect() };
    [parts('\''), parts('"')].concat()
}

/// The last option with this pin.
fn pin(config: &Config, name: &str) -> Option<Place> {
    let aliases = Aliases::read(config).unwrap_or_default();
    let is_it = |text: &str| {
        let parsed = pinion_printer_config::pins::Pin::parse(text, true, true);
        parsed.is_ok_and(|pin| pin.name == name || aliases.resolve(&pin).name == name)
    };
    let uses = config.sections().iter().filter(|section| section.kind() != "board_pins").flat_map(Section::settings);
    let mut uses = uses.filter(|setting| setting.key.contains("pin") && setting.value.split(',').any(is_it));
    uses.next_back().map(|setting| setting.place.clone())
}

/// The line that a message of klippy is about.
pub(crate) fn place_of(config: &Config, message: &str) -> Option<Place> {
    let words: Vec<&str> = message.split_whitespace().collect();
    let texts = quoted(message);
    let lower = message.to_lowercase();
    let section = |name: &str| config.section(name.trim_matches(['[', ']']));
    // "MCU 'mcu' shutdown: ..." is about no line of its own.
    let texts: Vec<&str> =
        texts.into_iter().filter(|text| !lower.contains(&format!("mcu '{}'", text.to_lowercase()))).collect();
    // "Option 'x' in section 'y' ...", "Choice 'c' for option 'o' in section 's' ..."
    if lower.contains("section")
        && let Some(found) = texts.iter().rev().find_map(|text| section(text))
    {
        let key = texts.iter().find_map(|text| found.setting(&text.to_lowercase()));
        return Some(key.map_or_else(|| found.place.clone(), |setting| setting.place.clone()));
    }
    if let Some(at) = words.iter().position(|word| word.eq_ignore_ascii_case("pin"))
        && let Some(found) = words.get(at + 1).and_then(|name| pin(config, name.trim_matches(['\'', '"', ','])))
    {
        return Some(found);
    }
    // "Unable to read tmc uart 'stepper_x' register"
    let clean: Vec<&str> = words.iter().map(|word| word.trim_matches(['\'', '"', ',', '.', ':'])).collect();
    if lower.contains("tmc")
        && let Some(found) = config.sections().iter().find(|section| {
            section.kind().starts_with("tmc") && clean.iter().any(|word| section.own_name() == Some(word))
        })
    {
        return Some(found.place.clone());
    }
    // "Error evaluating 'gcode_macro START_PRINT:gcode'"
    let named = |text: &&str| section(text.split(':').next().unwrap_or(text)).map(|found| found.place.clone());
    if let Some(found) = texts.iter().find_map(named) {
        return Some(found);
    }
    // "Heater extruder not heating", "No trigger on x after full movement"
    let is_about = |section: &&Section, word: &str| {
        section.own_name() == Some(word) || section.name == word || section.name == format!("stepper_{word}")
    };
    if lower.contains("endstop") || lower.contains("trigger") {
        let found = config
            .sections()
            .iter()
            .find(|section| section.text("endstop_pin").is_some() && clean.iter().any(|word| is_about(section, word)));
        if let Some(found) = found {
            return Some(found.place_of("endstop_pin").clone());
        }
        if lower.contains("probe") {
            let kinds = ["probe", "bltouch", "smart_effector", "dockable_probe"];
            return kinds.iter().find_map(|kind| config.section(kind)).map(|section| section.place.clone());
        }
    }
    // "Unknown command:"FOO"": the macro that calls it.
    if lower.contains("unknown command") {
        let command = texts.first()?;
        return config.sections().iter().flat_map(Section::settings).find_map(|setting| {
            let line = setting.value.lines().position(|line| line.split_whitespace().next() == Some(command))?;
            Some(Place { file: setting.place.file.clone(), line: setting.place.line + line })
        });
    }
    let heaters = config.sections().iter().filter(|section| section.text("sensor_type").is_some());
    heaters
        .into_iter()
        .find(|section| clean.iter().any(|word| is_about(section, word)))
        .map(|found| found.place.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_printer_config::{Disk, Files};

    struct One(&'static str);
    impl Files for One {
        fn text(&self, _: &std::path::Path) -> std::io::Result<String> {
            Ok(self.0.to_owned())
        }
        fn names(&self, _: &std::path::Path, _: usize) -> Vec<String> {
            Vec::new()
        }
        fn is_there(&self, _: &std::path::Path) -> bool {
            false
        }
        fn whole(&self, path: &std::path::Path) -> std::path::PathBuf {
            Disk.whole(path)
        }
    }

    #[test]
    fn klippys_words_lead_to_a_line() {
        let text = "[stepper_x]\nstep_pin: PA1\nendstop_pin: ^PA2\n[extruder]\nsensor_type: x\nheater_pin: PA1\n[gcode_macro START_PRINT]\ngcode:\n  G28\n  MY_LEVEL A=1\n[tmc2209 stepper_x]\nuart_pin: PB1\n";
        let config = Config::read_from(&One(text), std::path::Path::new("p.cfg")).unwrap();
        for (message, line) in [
            ("Option 'heater_pin' in section 'extruder' must be specified", 6),
            ("Option 'step_pinn' is not valid in section 'stepper_x'", 1),
            ("Section 'tmc2209 stepper_x' is not a valid config section", 11),
            ("pin PA1 used multiple times in config", 6),
            ("Pin 'PB1' is not a valid pin name on mcu 'mcu'", 12),
            ("Error evaluating 'gcode_macro START_PRINT:gcode': x is undefined", 7),
            ("Unknown command:\"MY_LEVEL\"", 10),
            ("No trigger on x after full movement", 3),
            ("Endstop x still triggered after retract", 3),
            ("Unable to read tmc uart 'stepper_x' register IFCNT", 11),
            ("Heater extruder not heating at expected rate", 4),
            ("MCU 'mcu' shutdown: Heater extruder", 4),
        ] {
            assert_eq!(place_of(&config, message).map(|place| place.line), Some(line), "{message}");
        }
        assert_eq!(place_of(&config, "Move out of range: 0 0 -5"), None);
    }
}
