// SPDX-License-Identifier: GPL-3.0-or-later
//! The names that a shell offers for the value of an option. The option may take other values too.

use std::ffi::OsStr;
use std::fmt::Display;
use std::str::FromStr;

use clap::builder::{PossibleValue, TypedValueParser};
use clap::{Arg, Command};

use pinion_linux::gpio::FastGpio;

/// Names of boards.
pub const BOARDS: &[&str] = &["linux", "sim"];
/// The board that `pinion console` takes.
pub const SIMULATED: &[&str] = &["sim"];
/// Names of dialects.
pub const DIALECTS: &[&str] = &["v0.11", "v0.12", "v0.13", "master", "kalico", "union"];
/// The same, with the one that is found from the host.
pub const SPOKEN: &[&str] = &["auto", "v0.11", "v0.12", "v0.13", "master", "kalico", "union"];
/// Ways to write GPIO lines.
pub const FAST: &[&str] = &FastGpio::WORDS;
/// The levels of the log.
pub const LEVELS: &[&str] = &["error", "warn", "info", "debug", "trace", "off"];

/// Reads a value, and offers these names for it to a shell.
pub fn offering<T>(names: &'static [&'static str]) -> impl TypedValueParser<Value = T>
where
    T: FromStr<Err: Display> + Clone + Send + Sync + 'static,
{
    let parser = |text: &str| text.parse::<T>().map_err(|error| error.to_string());
    Offering { parser, names }
}

#[derive(Clone)]
struct Offering<P> {
    parser: P,
    names: &'static [&'static str],
}

impl<P: TypedValueParser> TypedValueParser for Offering<P> {
    type Value = P::Value;

    fn parse_ref(&self, command: &Command, arg: Option<&Arg>, value: &OsStr) -> Result<P::Value, clap::Error> {
        self.parser.parse_ref(command, arg, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(self.names.iter().map(PossibleValue::new)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{BoardName, Spoken};
    use pinion_firmware::mcu::DialectName;

    #[test]
    fn what_is_offered_is_taken_and_all_of_it() {
        assert!(BOARDS.iter().chain(SIMULATED).all(|name| name.parse::<BoardName>().is_ok()));
        assert!(SPOKEN.iter().all(|name| name.parse::<Spoken>().is_ok()));
        let mut dialects: Vec<String> = DialectName::ALL.into_iter().map(|name| name.to_string()).collect();
        dialects.sort();
        let mut offered = DIALECTS.to_vec();
        offered.sort_unstable();
        assert_eq!(offered, dialects);
        assert_eq!(&SPOKEN[1..], DIALECTS);
        assert!(FAST.iter().all(|name| name.parse::<FastGpio>().is_ok()));
        assert!(LEVELS.iter().all(|name| name.parse::<log::LevelFilter>().is_ok()));
        assert_eq!(LEVELS.len(), log::LevelFilter::iter().count());
    }
}
