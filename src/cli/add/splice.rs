// SPDX-License-Identifier: GPL-3.0-or-later
//! A change of a text that can be taken back after others have changed the text elsewhere.

use serde::{Deserialize, Serialize};

/// A text that replaces another one at a place of a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Splice {
    /// The first byte.
    pub(super) at: usize,
    pub(super) old: String,
    pub(super) new: String,
    /// The word that `new`, a line of a key and words, has more than `old`. Only this word is taken back: others may
    /// have come since.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) word: Option<String>,
}

impl Splice {
    /// An insertion.
    pub(super) fn insert(at: usize, new: String) -> Splice {
        Splice { at, old: String::new(), new, word: None }
    }

    /// Makes the change in the text that it was planned for.
    pub(super) fn apply(&self, text: &mut String) {
        text.replace_range(self.at..self.at + self.old.len(), &self.new);
    }

    /// Takes the change back, also if the text has changed elsewhere. False if it is not in the text.
    ///
    /// # Errors
    ///
    /// The new text is there several times, and which one is ours cannot be known.
    pub(super) fn revert(&self, text: &mut String) -> Result<bool, String> {
        if let (Some(word), Some((key, _))) = (&self.word, self.new.split_once('=')) {
            return Ok(remove_word(text, key, word));
        }
        let is_whole_line = |at: usize| at == 0 || self.new.starts_with(['\r', '\n']) || text[..at].ends_with('\n');
        let at = if text.get(self.at..).is_some_and(|rest| rest.starts_with(&self.new)) {
            self.at
        } else {
            let mut found = text.match_indices(&self.new).map(|(at, _)| at).filter(|at| is_whole_line(*at));
            match (found.next(), found.next()) {
                (None, _) => return Ok(false),
                (Some(at), None) => at,
                _ => return Err(format!("\"{}\" is there several times: remove the right one", self.new.trim())),
            }
        };
        // The last line had no end, and others have written behind ours since: their line stays one of its own.
        let line_end = self.new.len() - self.new.trim_start_matches(['\r', '\n']).len();
        let has_more = at + self.new.len() < text.len();
        let kept = if has_more { line_end } else { 0 };
        text.replace_range(at + kept..at + self.new.len(), &self.old);
        Ok(true)
    }
}

/// Removes a word, with the space before it, from the last line with this key that has it. False if there is none.
fn remove_word(text: &mut String, key: &str, word: &str) -> bool {
    let mut line_at = 0;
    let mut found = None;
    for line in text.split_inclusive('\n') {
        if let Some(words) = line.strip_prefix(key).and_then(|rest| rest.strip_prefix('=')) {
            let is_end = |rest: Option<char>| rest.is_none_or(char::is_whitespace);
            let is_word = |at: &usize| {
                is_end(words[..*at].chars().next_back()) && is_end(words[*at + word.len()..].chars().next())
            };
            let at = words.match_indices(word).map(|(at, _)| at).find(is_word);
            found = at.map(|at| line_at + key.len() + 1 + at).or(found);
        }
        line_at += line.len();
    }
    let Some(at) = found else { return false };
    let end = at + word.len();
    let is_before_another =
        text[end..].strip_prefix(' ').is_some_and(|rest| rest.starts_with(|c: char| !c.is_whitespace()));
    let (at, end) = match (text[..at].ends_with(' '), is_before_another) {
        (true, _) => (at - 1, end),
        (false, true) => (at, end + 1),
        (false, false) => (at, end),
    };
    text.replace_range(at..end, "");
    true
}
