// SPDX-License-Identifier: GPL-3.0-or-later
//! An error, in one shape from the place where it happens to the place where it is printed.

use std::fmt;

/// Something that went wrong. Only [`fmt::Display`] makes a sentence of it: `subject: cause: remedy`.
///
/// A text alone is a cause. The caller that knows its subject adds it with [`Trouble::of`].
///
/// ```
/// use pinion_firmware::trouble::Trouble;
/// let trouble = Trouble::new("no chip acknowledges the address").remedy("check its wiring").of("/dev/i2c-1");
/// assert_eq!(trouble.to_string(), "/dev/i2c-1: no chip acknowledges the address: check its wiring");
/// assert_eq!(trouble.found(), "/dev/i2c-1: no chip acknowledges the address");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trouble {
    /// The object, device or file; `None` if the cause names it.
    pub subject: Option<Box<str>>,
    /// The event and its cause.
    pub cause: Box<str>,
    /// The remedy.
    pub remedy: Option<Box<str>>,
}

impl Trouble {
    /// A trouble with this cause.
    pub fn new(cause: impl Into<Box<str>>) -> Trouble {
        Trouble { subject: None, cause: cause.into(), remedy: None }
    }

    /// The same, with this remedy.
    pub fn remedy(self, remedy: impl Into<Box<str>>) -> Trouble {
        Trouble { remedy: Some(remedy.into()), ..self }
    }

    /// The same, with this subject in front of the present one.
    pub fn of(self, subject: impl fmt::Display) -> Trouble {
        let subject = self.subject.map_or_else(|| subject.to_string(), |inner| format!("{subject}: {inner}"));
        Trouble { subject: Some(subject.into()), ..self }
    }

    /// The same, with a place in a file as its subject: `byte` of the file's `text`. The subject is `file:line:column`,
    /// counted from 1.
    pub fn at(self, file: impl fmt::Display, text: &str, byte: usize) -> Trouble {
        let before = text.get(..byte).unwrap_or(text);
        let line = before.matches('\n').count() + 1;
        let column = before.rsplit('\n').next().unwrap_or_default().chars().count() + 1;
        self.of(format_args!("{file}:{line}:{column}"))
    }

    /// Subject and cause. The caller prints the remedy in a separate line.
    pub fn found(&self) -> String {
        match &self.subject {
            Some(subject) => format!("{subject}: {}", self.cause),
            None => self.cause.to_string(),
        }
    }
}

impl<T: Into<Box<str>>> From<T> for Trouble {
    fn from(cause: T) -> Trouble {
        Trouble::new(cause)
    }
}

impl std::error::Error for Trouble {}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(subject) = &self.subject {
            write!(f, "{subject}: ")?;
        }
        f.write_str(&self.cause)?;
        match &self.remedy {
            Some(remedy) => write!(f, ": {remedy}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_in_a_file_is_counted_from_one() {
        let text = "first\nsecönd here\n";
        for (byte, place) in [(0, "1:1"), (4, "1:5"), (6, "2:1"), (text.find("here").unwrap(), "2:8"), (99, "3:1")] {
            let trouble = Trouble::new("wrong").at("a.toml", text, byte);
            assert_eq!(trouble.to_string(), format!("a.toml:{place}: wrong"));
        }
    }
}
