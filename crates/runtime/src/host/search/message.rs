// SPDX-License-Identifier: GPL-3.0-or-later
//! The messages between the program and the search for the host. Their socket (SOCK_SEQPACKET) keeps each message in
//! one piece. Each is JSON.
//!
//! The search reads files that a host has written. So the program trusts none of its messages: [`Answer::decode`] takes
//! nothing that is too long or not an answer.

use serde::{Deserialize, Serialize};

use crate::host::klippy::terminal::Terminal;
use pinion_firmware::mcu::{DialectName, Forms, HostForms};
use pinion_linux::foreign::plain;

use crate::status::FoundHost;

#[cfg(any(test, fuzzing))]
#[path = "../../../tests/support/search_fuzz.rs"]
pub(crate) mod fuzz;

/// Longest message in either direction. The longest texts of an answer fit.
pub(super) const MESSAGE_BYTES_MAX: usize = 64 * 1024;
/// Highest number of lines in an answer, longest text of a line, and longest path.
const LINES_MAX: usize = 6;
const LINE_CHARS_MAX: usize = 1000;
const PATH_CHARS_MAX: usize = 1000;

/// The program's question: who has this terminal open?
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Question {
    /// The answer has the same number.
    pub(super) number: u32,
    pub(super) terminal: Terminal,
}

/// The first message of the search.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Hello {
    /// Why the kernel does not confine the search, if it does not.
    pub(super) unconfined: Option<String>,
}

/// A line for the log.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Line {
    pub(super) is_warning: bool,
    pub(super) text: String,
}

/// The search's answer.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Answer {
    pub(super) number: u32,
    /// The places of the forms that the host looks up. `None` if they are unknown.
    forms: Option<Vec<u16>>,
    /// The process of the host before is gone, and this is another one.
    pub(super) is_other: bool,
    pub(super) host: Option<FoundHost>,
    pub(super) lines: Vec<Line>,
}

/// A text without control characters that is not too long for the log.
fn bounded(text: &str, chars_max: usize) -> String {
    let text = plain(text);
    match text.chars().count() <= chars_max {
        true => text.into_owned(),
        false => text.chars().take(chars_max - 1).chain(['…']).collect(),
    }
}

impl Answer {
    pub(super) fn new(
        number: u32,
        forms: Option<&HostForms>,
        is_other: bool,
        host: Option<FoundHost>,
        lines: Vec<Line>,
    ) -> Answer {
        let forms = forms.map(|forms| forms.places().collect());
        Answer { number, forms, is_other, host, lines }.bounded()
    }

    /// The forms for the host. Unknown hosts get the union, which most hosts accept. Any places make a dictionary.
    pub(super) fn forms(&self) -> Forms {
        let places = self.forms.as_ref().map(|places| places.iter().copied().collect());
        places.map_or(Forms::Dialect(DialectName::Union), Forms::Host)
    }

    /// The same answer without anything that is too long or may not be shown.
    fn bounded(mut self) -> Answer {
        self.lines.truncate(LINES_MAX);
        for line in &mut self.lines {
            line.text = bounded(&line.text, LINE_CHARS_MAX);
        }
        if let Some(host) = &mut self.host {
            host.checkout = host.checkout.as_ref().map(|path| bounded(path, PATH_CHARS_MAX));
            host.commit.take_if(|commit| commit.len() > 40 || !commit.bytes().all(|byte| byte.is_ascii_hexdigit()));
        }
        self
    }

    /// The answer in these bytes, if they are one.
    pub(super) fn decode(bytes: &[u8]) -> Option<Answer> {
        serde_json::from_slice(bytes).ok().map(Answer::bounded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_testkit::names::any_name;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn an_answer_says_what_it_may_and_fits(
            name in any_name(), repeat in 1..2000usize, pid: u32, is_sure: bool, lines in 0..20usize,
        ) {
            let text = name.repeat(repeat);
            let host = FoundHost { pid, is_sure, is_attach: is_sure, checkout: Some(text.clone()), commit: Some(name.clone()) };
            let line = || Line { is_warning: is_sure, text: text.clone() };
            let lines = (0..lines).map(|_| line()).collect();
            let sent = Answer { number: pid, forms: None, is_other: is_sure, host: Some(host), lines };
            // Anything may come over the socket.
            let heard = Answer::decode(&serde_json::to_vec(&sent).unwrap()).unwrap();
            prop_assert_eq!(heard.forms(), Forms::Dialect(DialectName::Union));
            heard.assert_bounded();
        }

        #[test]
        fn bytes_that_are_no_answer_are_none(bytes: Vec<u8>) {
            prop_assert!(Answer::decode(&bytes).is_none());
        }
    }

    #[test]
    fn forms_are_those_that_the_host_looks_up() {
        let answer = |forms: &str| {
            Answer::decode(
                format!(r#"{{"number":1,"forms":{forms},"is_other":false,"host":null,"lines":[]}}"#).as_bytes(),
            )
        };
        assert_eq!(answer("[3,1,65535]").unwrap().forms(), Forms::Host([1, 3, 65535].into_iter().collect()));
        assert_eq!(answer("null").unwrap().forms(), Forms::Dialect(DialectName::Union));
        assert!(answer("[65536]").is_none() && answer("[-1]").is_none());
        assert!(Answer::decode(b"{}").is_none() && Answer::decode("[".repeat(10_000).as_bytes()).is_none());
    }
}
