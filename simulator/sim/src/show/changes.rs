// SPDX-License-Identifier: GPL-3.0-or-later
//! The changes since the last report, for a pipe or a file: a line for each thing, or a block for a picture.

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::time::Duration;

use super::{Item, Number, name_colours};

/// How many samples a number has to stand before that is reported, if something still moves it.
const STANDING_SAMPLES: usize = 10;

/// An item's name where its kind does not stand before it. Two items that share a name also get their kinds.
fn called(items: &[Item], item: &Item) -> String {
    let shared = items.iter().filter(|other| other.name == item.name).count() > 1;
    match item.kind.names().filter(|_| shared) {
        Some((_, kind)) => format!("{kind} {}", item.name),
        None => item.name.clone(),
    }
}

/// The last report of an item, and its number in the samples since then.
struct Reported {
    value: f64,
    text: String,
    seen: VecDeque<(f64, String)>,
}

impl Reported {
    /// Takes in a sample. True if there is news to report.
    fn is_news(&mut self, item: &Item) -> bool {
        let Some(Number { value, step, ripple }) = item.number else { return item.text != self.text };
        let last = self.seen.back().map(|(last, _)| *last);
        self.seen.push_back((value, item.text.clone()));
        if self.seen.len() > STANDING_SAMPLES {
            self.seen.pop_front();
        }
        if item.text == self.text {
            return false;
        }
        let way = (value - self.value).abs();
        if way < ripple {
            return false;
        }
        way >= step || last == Some(value) || self.seen.len() == STANDING_SAMPLES && self.stands(value, way, step)
    }

    /// Whether a number that is never twice the same ends up at this value, `way` from the last report.
    fn stands(&self, value: f64, way: f64, step: f64) -> bool {
        // A filter moves the number by less than is printed. A number that flickers between two prints is not reported
        // each time.
        if self.seen.iter().all(|(_, text)| self.seen[0].1 == *text) {
            return way >= step / 20.0;
        }
        // A ripple goes up and down around its middle.
        let values = || self.seen.iter().map(|(value, _)| *value);
        let (low, high) = values().fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
        let range = high - low;
        let rises = values().zip(values().skip(1)).filter(|(before, after)| before < after).count();
        let ripples = (2..=STANDING_SAMPLES - 3).contains(&rises);
        ripples && range < step && way > range && (value - (low + high) / 2.0).abs() <= range / 4.0
    }
}

/// The lines that report changes.
#[derive(Default)]
pub(super) struct Changes {
    /// In the order of the items.
    reported: Vec<Reported>,
}

impl Changes {
    /// The lines for a sample of all items. The last sample reports everything that was not reported yet.
    pub(super) fn lines(&mut self, items: &[Item], at: Duration, is_last: bool) -> String {
        let mut lines = String::new();
        for (n, item) in items.iter().enumerate() {
            if let Some(reported) = self.reported.get_mut(n) {
                let is_news = reported.is_news(item) || is_last && item.text != reported.text;
                if !is_news {
                    continue;
                }
            }
            let space = if item.text.contains('\n') { '\n' } else { ' ' };
            let name = called(items, item);
            // A String takes everything that is written to it.
            let _ = writeln!(lines, "[{:12.6}] {name}:{space}{}", at.as_secs_f64(), name_colours(&item.text));
            let value = item.number.map_or(0.0, |number| number.value);
            match self.reported.get_mut(n) {
                Some(reported) => (reported.value, reported.text) = (value, item.text.clone()),
                None => {
                    let seen = VecDeque::from([(value, item.text.clone())]);
                    self.reported.push(Reported { value, text: item.text.clone(), seen });
                }
            }
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Kind, tests::item};
    use super::*;

    /// The reports of a temperature that goes through these values, in C, without the time.
    fn reported(values: impl Iterator<Item = f64>) -> Vec<String> {
        let mut changes = Changes::default();
        let lines = values.map(|celsius| {
            let bed = item(Kind::Heater, "bed", Some(celsius), &format!("{celsius:.1} C"));
            changes.lines(&[bed], Duration::ZERO, false)
        });
        let lines: String = lines.collect();
        lines.lines().map(|line| line.split_once("bed: ").unwrap().1.to_owned()).collect()
    }

    #[test]
    fn a_number_that_a_filter_moves_is_reported_as_it_ends_up() {
        // It is never twice the same, and never reaches its end.
        let reported = reported((0..200).map(|look| 60.0 - 5.0 * (-f64::from(look) / 10.0).exp()));
        assert_eq!(reported[..3], ["55.0 C", "56.3 C", "57.5 C"]);
        assert_eq!(reported.last().unwrap(), "60.0 C");
        assert!(reported.len() < 10, "{reported:?}");
    }

    #[test]
    fn a_number_that_ripples_is_reported_once_by_about_its_middle() {
        let ripple = |look: i32| (f64::from(look) * 1.7).sin() * 0.3;
        let rise = |look: i32| 60.0 - 5.0 * (-f64::from(look) / 10.0).exp();
        let reported = reported((0..2000).map(|look| rise(look) + ripple(look)));
        let last: f64 = reported.last().unwrap().strip_suffix(" C").unwrap().parse().unwrap();
        assert!((last - 60.0).abs() <= 0.3, "{reported:?}");
        assert!(reported.len() < 12, "{reported:?}");
    }

    /// For a while, samples meet the ripple at one phase. They see the number stand, each time at another place.
    #[test]
    fn a_fan_that_is_read_in_step_with_its_ripple_is_reported_once() {
        let mut changes = Changes::default();
        let lines = (0..200).map(|look| {
            let rpm = if look / 10 % 2 == 0 { 2248.0 } else { 2270.0 };
            let number = Some(Number { value: rpm, step: 100.0, ripple: 30.0 });
            let fan = Item { number, ..item(Kind::Fan, "fan", None, &format!("{rpm} rpm")) };
            changes.lines(&[fan], Duration::ZERO, false)
        });
        assert_eq!(lines.collect::<String>().lines().count(), 1);
    }

    #[test]
    fn values_that_were_not_reported_yet_are_reported_at_the_end() {
        let mut changes = Changes::default();
        let mut reported = |mm: f64, is_last| {
            changes.lines(&[item(Kind::Axis, "x", Some(mm), &format!("{mm} mm"))], Duration::ZERO, is_last)
        };
        reported(1.0, false);
        assert_eq!((reported(1.5, false), reported(1.75, true)), (String::new(), "[    0.000000] x: 1.75 mm\n".into()));
    }

    #[test]
    fn two_that_share_a_name_are_distinguished() {
        let items = [
            item(Kind::Axis, "x", None, "1 mm"),
            item(Kind::Axis, "extruder", None, "2 mm"),
            item(Kind::Heater, "extruder", None, "25 C"),
        ];
        let lines = Changes::default().lines(&items, Duration::ZERO, false).replace("[    0.000000] ", "");
        assert_eq!(lines, "x: 1 mm\naxis extruder: 2 mm\nheater extruder: 25 C\n");
    }

    #[test]
    fn a_change_is_reported_once_and_a_number_by_steps_and_as_it_stands() {
        let mut changes = Changes::default();
        let mut reported = |mm: f64, strip: &str| {
            let x = item(Kind::Axis, "x", Some(mm), &format!("{mm} mm"));
            changes.lines(&[x, item(Kind::Part, "strip", None, strip)], Duration::from_millis(1500), false)
        };
        assert_eq!(reported(0.0, "off"), "[    1.500000] x: 0 mm\n[    1.500000] strip: off\n");
        assert_eq!(reported(0.0, "off"), "");
        assert_eq!(reported(0.5, "off"), "", "it moves, but not by a step yet");
        assert_eq!(
            reported(1.25, "#ff8000 #000010"),
            "[    1.500000] x: 1.25 mm\n[    1.500000] strip: yellow#ff8000 blue#000010\n"
        );
        assert_eq!(reported(1.5, "#ff8000 #000010"), "");
        assert_eq!(reported(1.5, "⠁\n⠂"), "[    1.500000] x: 1.5 mm\n[    1.500000] strip:\n⠁\n⠂\n");
    }
}
