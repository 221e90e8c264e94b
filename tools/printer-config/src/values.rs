// SPDX-License-Identifier: GPL-3.0-or-later
//! The values of options, as klippy's `ConfigWrapper` reads them, in its words.

use std::fmt::Display;

use crate::{Config, Place, Section, Setting, Trouble};

/// The range of a number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Limit {
    /// Any number.
    Any,
    /// `minval` of klippy.
    Min(f64),
    /// `above` of klippy.
    Above(f64),
    /// `above` and `maxval` of klippy.
    AboveTo(f64, f64),
    /// `minval` and `maxval` of klippy.
    Between(f64, f64),
}

impl Section {
    /// The first word of its name.
    pub fn kind(&self) -> &str {
        self.name.split(' ').next().unwrap_or_default()
    }

    /// The last word of its name, if it has several. klippy calls a heater or a fan by it.
    pub fn own_name(&self) -> Option<&str> {
        self.name.split_once(' ').map(|(_, own)| own.rsplit(' ').next().unwrap_or_default())
    }

    /// All options.
    pub fn settings(&self) -> &[Setting] {
        &self.settings
    }

    /// An option.
    pub fn setting(&self, key: &str) -> Option<&Setting> {
        self.by_key.get(key).map(|place| &self.settings[*place])
    }

    /// The place of an option, or of the section.
    pub fn place_of(&self, key: &str) -> &Place {
        self.setting(key).map_or(&self.place, |setting| &setting.place)
    }

    /// A trouble with an option of this section.
    pub fn trouble(&self, key: &str, cause: impl Display) -> Trouble {
        Trouble::new(cause.to_string()).of(self.place_of(key))
    }

    /// A text.
    pub fn text(&self, key: &str) -> Option<&str> {
        self.setting(key).map(|setting| setting.value.as_str())
    }

    /// A text that must be there.
    ///
    /// # Errors
    ///
    /// It is not there.
    pub fn required(&self, key: &str) -> Result<&str, Trouble> {
        self.text(key).ok_or_else(|| {
            let cause = format!("Option '{key}' in section '{}' must be specified", self.name);
            self.trouble(key, cause).remedy("add it")
        })
    }

    fn parsed<T>(&self, key: &str, parse: impl Fn(&str) -> Option<T>) -> Result<Option<T>, Trouble> {
        let Some(text) = self.text(key) else { return Ok(None) };
        let parsed = parse(text.trim()).ok_or_else(|| {
            let cause = format!("Unable to parse option '{key}' in section '{}'", self.name);
            self.trouble(key, cause).remedy("correct its value")
        })?;
        Ok(Some(parsed))
    }

    fn bounded(&self, key: &str, value: f64, limit: Limit) -> Result<(), Trouble> {
        let (min, above, max) = match limit {
            Limit::Any => (None, None, None),
            Limit::Min(min) => (Some(min), None, None),
            Limit::Above(above) => (None, Some(above), None),
            Limit::AboveTo(above, max) => (None, Some(above), Some(max)),
            Limit::Between(min, max) => (Some(min), None, Some(max)),
        };
        let broken = [
            (min.filter(|min| value < *min), "have minimum of"),
            (max.filter(|max| value > *max), "have maximum of"),
            (above.filter(|above| value <= *above), "be above"),
        ];
        let Some((bound, rule)) = broken.into_iter().find_map(|(bound, rule)| Some((bound?, rule))) else {
            return Ok(());
        };
        let cause = format!("Option '{key}' in section '{}' must {rule} {bound:?}", self.name);
        Err(self.trouble(key, cause).remedy("correct its value"))
    }

    /// A number.
    ///
    /// # Errors
    ///
    /// It is not a number, or out of its range.
    pub fn number(&self, key: &str, limit: Limit) -> Result<Option<f64>, Trouble> {
        let number = self.parsed(key, python_float)?;
        number.map_or(Ok(()), |number| self.bounded(key, number, limit)).map(|()| number)
    }

    /// A whole number.
    ///
    /// # Errors
    ///
    /// It is not a whole number, or below `min`.
    pub fn whole(&self, key: &str, min: i64) -> Result<Option<i64>, Trouble> {
        let number = self.parsed(key, python_int)?;
        match number {
            Some(number) if number < min => {
                let cause = format!("Option '{key}' in section '{}' must have minimum of {min}", self.name);
                Err(self.trouble(key, cause).remedy("correct its value"))
            }
            number => Ok(number),
        }
    }

    /// A truth value.
    ///
    /// # Errors
    ///
    /// It is another word.
    pub fn truth(&self, key: &str) -> Result<Option<bool>, Trouble> {
        self.parsed(key, |text| match text.to_lowercase().as_str() {
            "1" | "yes" | "true" | "on" => Some(true),
            "0" | "no" | "false" | "off" => Some(false),
            _ => None,
        })
    }

    /// The parts of a list between separators, without white space around them.
    pub fn list(&self, key: &str, separator: char) -> Vec<&str> {
        match self.text(key).map(str::trim) {
            None | Some("") => Vec::new(),
            Some(text) => text.split(separator).map(str::trim).collect(),
        }
    }

    /// A list of numbers.
    ///
    /// # Errors
    ///
    /// One of them is not a number.
    pub fn numbers(&self, key: &str) -> Result<Option<Vec<f64>>, Trouble> {
        self.parsed(key, |text| match text {
            "" => Some(Vec::new()),
            text => text.split(',').map(|part| python_float(part.trim())).collect(),
        })
    }

    /// Lines of numbers, as for `screw1` or `points`.
    ///
    /// # Errors
    ///
    /// One of them is not a number.
    pub fn rows(&self, key: &str) -> Result<Option<Vec<Vec<f64>>>, Trouble> {
        self.parsed(key, |text| {
            let rows = text.lines().map(str::trim).filter(|line| !line.is_empty());
            rows.map(|line| line.split(',').map(|part| python_float(part.trim())).collect()).collect()
        })
    }
}

/// Digits with Python's underscores between them.
fn without_underscores(text: &str) -> Option<String> {
    let bytes = text.as_bytes();
    let is_digit = |at: Option<usize>| at.and_then(|at| bytes.get(at)).is_some_and(u8::is_ascii_digit);
    let all_between = text.match_indices('_').all(|(at, _)| is_digit(at.checked_sub(1)) && is_digit(Some(at + 1)));
    all_between.then(|| text.replace('_', ""))
}

fn python_float(text: &str) -> Option<f64> {
    without_underscores(text)?.parse().ok()
}

fn python_int(text: &str) -> Option<i64> {
    without_underscores(text)?.parse().ok()
}

/// Longest value after its constants are put in.
const VALUE_MAX: usize = 1 << 20;
/// Highest number of constants in a value, as in Python's configparser.
const DEPTH_MAX: usize = 10;

impl Config {
    /// Puts Kalico's constants in: `${option}` of the same section and `${section.option}`. A name that is not there
    /// stays, because Klipper has no constants.
    pub fn put_constants_in(&mut self) {
        let mut changed = Vec::new();
        for (s, section) in self.sections.iter().enumerate() {
            for (n, setting) in section.settings.iter().enumerate().filter(|(_, setting)| setting.value.contains("${"))
            {
                let mut value = setting.value.clone();
                for _ in 0..DEPTH_MAX {
                    let Some(next) = self.one_constant(&section.name, &value).filter(|next| next.len() <= VALUE_MAX)
                    else {
                        break;
                    };
                    value = next;
                }
                changed.push((s, n, value));
            }
        }
        changed.into_iter().for_each(|(s, n, value)| self.sections[s].settings[n].value = value);
    }

    /// The value with its first constant put in.
    fn one_constant(&self, section: &str, value: &str) -> Option<String> {
        value.match_indices("${").filter(|(at, _)| !value[..*at].ends_with('\\')).find_map(|(start, _)| {
            let end = start + value[start..].find('}')?;
            let name = &value[start + 2..end];
            let (section, option) = name.split_once(['.', ':']).unwrap_or((section, name));
            let constant = self.section(section)?.text(&option.to_lowercase())?;
            Some(format!("{}{constant}{}", &value[..start], &value[end + 1..]))
        })
    }
}
