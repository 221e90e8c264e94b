// SPDX-License-Identifier: GPL-3.0-or-later
//! A trace as text for a person: one line for each thing of note. Between them, one line for all else that a thread did.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::time::Duration;

use pinion_firmware::time::{NS_PER_TICK, Ticks};

use super::event::Event;
use super::file::Trace;
use super::history::{Deed, History, at_ms, ms, short};

/// Highest number of lines below the title.
const LINES_MAX: usize = 60;
/// A wait at least this long is of note.
const LONG_WAIT: Ticks = Ticks::from_ms(1);
/// Work of a bus at least this long is of note. A transfer to a display takes some ms.
const LONG_WORK: Ticks = Ticks::from_ms(5);
/// Highest number of kinds of commands that a line names.
const COMMANDS_MAX: usize = 4;
/// Widest name of a thread that moves its column.
const THREAD_WIDTH_MAX: usize = 12;

/// Writes the timeline of the recording's last part, at most about 60 lines. Times are in ms, relative to the end of
/// the recording. If there is too much of note, the most important things have lines of their own.
///
/// # Errors
///
/// Those of `out`.
pub fn write(trace: &Trace, last: Duration, out: &mut impl Write) -> io::Result<()> {
    let history = History::of(trace);
    let start = i64::try_from(last.as_nanos() / u128::from(NS_PER_TICK)).map_or(i64::MIN, |ticks| -ticks);
    let mut deeds: Vec<(usize, Deed)> =
        history.deeds().filter(|(_, deed)| deed.to >= start).map(|(lane, deed)| (lane, *deed)).collect();
    deeds.sort_by_key(|(_, deed)| place(deed));
    let mut of_note: Vec<usize> = (0..deeds.len()).filter(|index| weight(&deeds[*index].1) > 0).collect();
    of_note.sort_by_key(|index| Reverse((weight(&deeds[*index].1), *index)));
    let mut chosen = LINES_MAX;
    let rows = loop {
        let mut alone = vec![false; deeds.len()];
        of_note.iter().take(chosen).for_each(|index| alone[*index] = true);
        let rows = rows(&history, &deeds, &alone);
        if rows.len() <= LINES_MAX || chosen == 0 {
            break rows;
        }
        chosen = chosen * 3 / 4;
    };
    let widest = |texts: &mut dyn Iterator<Item = &String>| texts.map(|text| text.chars().count()).max().unwrap_or(0);
    let from_width = widest(&mut rows.iter().map(|row| &row.from));
    let to_width = widest(&mut rows.iter().map(|row| &row.to));
    let thread_width = widest(&mut rows.iter().map(|row| &row.thread)).min(THREAD_WIDTH_MAX);
    writeln!(out, "Times are in ms. Zero is when {}.", history.end())?;
    for Row { from, to, thread, text } in rows.iter().take(LINES_MAX) {
        let dots = if to.is_empty() { "  " } else { ".." };
        writeln!(out, "{from:>from_width$} {dots} {to:>to_width$}  {thread:thread_width$}  {text}")?;
    }
    if rows.is_empty() {
        writeln!(out, "Nothing is recorded.")?;
    }
    Ok(())
}

/// Where a deed stands in the timeline: those with their end in the same line stand at their beginning.
fn place(deed: &Deed) -> i64 {
    if is_range(deed) { deed.from } else { deed.to }
}

fn is_range(deed: &Deed) -> bool {
    matches!(deed.event, Event::Held | Event::Released | Event::JobBegan { .. } | Event::JobEnded { .. })
}

/// How much a deed is of note; zero if it is routine. Being late weighs more than waiting, which weighs more than work.
fn weight(deed: &Deed) -> u64 {
    let over = |ticks: u64, limit: Ticks, factor: u64| {
        if ticks >= limit.0.into() { ticks.saturating_mul(factor) } else { 0 }
    };
    match deed.event {
        Event::Stopped { .. } | Event::Due(_) => u64::MAX,
        Event::Held | Event::JobBegan { .. } => over(deed.ticks(), LONG_WAIT, 1000),
        Event::Configured
        | Event::Reset
        | Event::HostCame
        | Event::HostGone
        | Event::Scheduling { .. }
        | Event::Power(_) => 1 << 40,
        Event::Refused(_) | Event::Full | Event::Omitted(_) => 1 << 32,
        Event::Late { late, .. } => u64::from(late.0.max(1)) * 100,
        Event::Woke { late, .. } => over(late.0.into(), LONG_WAIT, 100),
        Event::Processor { waited, .. } => over(waited.0.into(), LONG_WAIT, 100),
        Event::Stolen(ticks) => over(ticks.0.into(), LONG_WAIT, 100),
        Event::Released => over(deed.ticks(), LONG_WAIT, 10),
        Event::JobEnded { .. } => over(deed.ticks(), LONG_WORK, 1),
        Event::Pace { .. }
        | Event::Block(_)
        | Event::Command { .. }
        | Event::BlockIn(_)
        | Event::Out(_)
        | Event::Nak
        | Event::Answered { .. }
        | Event::Alive
        | Event::Looked { .. }
        | Event::Frequency { .. }
        | Event::Listened
        | Event::Edge { .. } => 0,
    }
}

/// A line.
struct Row {
    from: String,
    /// Empty: it is at one time.
    to: String,
    thread: String,
    text: String,
}

impl Row {
    fn new(history: &History<'_>, lane: usize, from: i64, to: Option<i64>, text: String) -> Row {
        let thread = short(history.lanes[lane].thread);
        Row { from: at_ms(from), to: to.map_or_else(String::new, at_ms), thread, text }
    }
}

/// The lines, with these deeds alone and the others folded.
fn rows(history: &History<'_>, deeds: &[(usize, Deed)], alone: &[bool]) -> Vec<Row> {
    let mut rows = Vec::new();
    let mut folds: BTreeMap<usize, Fold> = BTreeMap::new();
    for ((lane, deed), alone) in deeds.iter().zip(alone) {
        if !alone {
            folds.entry(*lane).or_insert_with(|| Fold::at(place(deed))).add(deed);
            continue;
        }
        flush(history, &mut folds, &mut rows);
        let to = (is_range(deed) && !deed.is_open()).then_some(deed.to);
        rows.push(Row::new(history, *lane, place(deed), to, history.words(deed)));
        if rows.len() > LINES_MAX {
            return rows;
        }
    }
    flush(history, &mut folds, &mut rows);
    rows
}

fn flush(history: &History<'_>, folds: &mut BTreeMap<usize, Fold>, rows: &mut Vec<Row>) {
    let mut folds: Vec<(usize, Fold)> = std::mem::take(folds).into_iter().collect();
    folds.sort_by_key(|(_, fold)| fold.from);
    for (lane, fold) in folds {
        let to = (at_ms(fold.to) != at_ms(fold.from)).then_some(fold.to);
        rows.push(Row::new(history, lane, fold.from, to, fold.words(history)));
    }
}

/// Deeds of a thread in one line.
#[derive(Default)]
struct Fold {
    from: i64,
    to: i64,
    /// By the places of their kinds in the line.
    kinds: BTreeMap<u8, (Sum, Words)>,
    /// How often each command came, and how many came right behind those.
    commands: BTreeMap<i16, u64>,
    behind: u64,
}

/// The words for the deeds of a kind.
type Words = fn(&Sum) -> String;

#[derive(Default)]
struct Sum {
    count: u64,
    /// The most ticks, bytes or MHz of one, and of all.
    most: u64,
    all: u64,
}

impl Sum {
    fn count(&self, thing: &str) -> String {
        count(self.count, thing)
    }

    fn most_ms(&self) -> String {
        ms(self.most)
    }
}

impl Fold {
    fn at(from: i64) -> Fold {
        Fold { from, to: from, ..Fold::default() }
    }

    fn add(&mut self, deed: &Deed) {
        self.to = self.to.max(deed.to);
        // The place of the kind in the line, the amount, and the words.
        let (place, amount, words): (u8, u64, Words) = match deed.event {
            Event::Command { id, more } => {
                *self.commands.entry(id).or_default() += 1;
                self.behind += u64::from(more);
                return;
            }
            Event::Woke { late, .. } => {
                (0, late.0.into(), |sum| format!("{}, latest {} ms", sum.count("wake-up"), sum.most_ms()))
            }
            Event::Pace { worst, .. } => (1, worst.0.into(), |sum| format!("no timer later than {} ms", sum.most_ms())),
            Event::Late { late, .. } => {
                (2, late.0.into(), |sum| format!("{}, at most {} ms", sum.count("late timer"), sum.most_ms()))
            }
            Event::Block(_) => (3, deed.ticks(), |sum| {
                format!("{} begun, longest in the queue {} ms", sum.count("block"), sum.most_ms())
            }),
            Event::Held | Event::Released => {
                (4, deed.ticks(), |sum| format!("{} for a bus, longest {} ms", sum.count("wait"), sum.most_ms()))
            }
            Event::BlockIn(_) => (5, 0, |sum| format!("{} from the host", sum.count("block"))),
            Event::Answered { .. } => (6, 0, |sum| format!("{} answered without the core", sum.count("block"))),
            Event::Alive => (7, 0, |sum| format!("{} of life of the host's computer", sum.count("sign"))),
            Event::Refused(_) => (8, 0, |sum| format!("{} of garbage or of blocks sent again", sum.count("refusal"))),
            Event::Nak => (9, 0, |sum| sum.count("NAK")),
            Event::Out(bytes) => (10, bytes.into(), |sum| format!("{} to the host", count(sum.all, "byte"))),
            Event::JobBegan { .. } | Event::JobEnded { .. } => {
                (11, deed.ticks(), |sum| format!("{}, longest {} ms", sum.count("transfer"), sum.most_ms()))
            }
            Event::Processor { waited, .. } => {
                (12, waited.0.into(), |sum| format!("threads waited {} ms for a processor", ms(sum.all)))
            }
            Event::Looked { .. } => (13, 0, |sum| format!("looked {} at the kernel's accounts", sum.count("time"))),
            Event::Stolen(ticks) => (14, ticks.0.into(), |sum| format!("a hypervisor took {} ms", ms(sum.all))),
            Event::Frequency { mhz, .. } => {
                (15, mhz.into(), |sum| format!("the processor runs at up to {} MHz", sum.most))
            }
            Event::Listened => (16, 0, |sum| format!("listened {}", sum.count("time"))),
            Event::Edge { .. } => (17, 0, |sum| sum.count("edge")),
            Event::Omitted(_)
            | Event::Configured
            | Event::Reset
            | Event::Stopped { .. }
            | Event::Due(_)
            | Event::Scheduling { .. }
            | Event::HostCame
            | Event::HostGone
            | Event::Full
            | Event::Power(_) => (18, 0, |sum| format!("{} of note", sum.count("other event"))),
        };
        let (sum, _) = self.kinds.entry(place).or_insert((Sum::default(), words));
        sum.count += 1;
        sum.most = sum.most.max(amount);
        sum.all = sum.all.saturating_add(amount);
    }

    fn words(&self, history: &History<'_>) -> String {
        let parts = self.kinds.values().map(|(sum, words)| words(sum));
        parts.chain(self.commands(history)).collect::<Vec<_>>().join("; ")
    }

    fn commands(&self, history: &History<'_>) -> Option<String> {
        let all = self.commands.values().sum::<u64>() + self.behind;
        let mut commands: Vec<(&i16, &u64)> = self.commands.iter().collect();
        commands.sort_by_key(|(_, count)| Reverse(**count));
        let named = commands.iter().take(COMMANDS_MAX);
        let mut names: Vec<String> = named.map(|(id, count)| format!("{} {count}", history.command(**id))).collect();
        let others = commands.iter().skip(COMMANDS_MAX).map(|(_, count)| **count).sum::<u64>() + self.behind;
        if others > 0 {
            names.push(format!("others {others}"));
        }
        (all > 0).then(|| format!("{} ({})", count(all, "command"), names.join(", ")))
    }
}

fn count(count: u64, thing: &str) -> String {
    format!("{count} {thing}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::super::file::End;
    use super::super::file::tests::trace;
    use super::super::history::tests::{any_trace, late_host, text};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_is_of_note_stands_alone_and_all_else_is_folded() {
        let text = text(|out| write(&late_host(), Duration::MAX, out));
        assert_eq!(text.lines().next(), Some("Times are in ms. Zero is when the MCU stopped: Timer too close."));
        for line in [
            "-1000.00             link      a host opened the terminal",
            " -998.00 .. -517.60  spi0      25 transfers, longest 0.400 ms",
            " -995.00 .. -504.91  link      50 blocks from the host; 350 bytes to the host",
            " -500.00             sampler   the core ran 9.0 ms and waited 3.0 ms for a processor",
            " -118.00 .. -106.00  core      commands waited 12.0 ms for a bus",
            " -118.00 .. -106.00  spi0      worked 12.0 ms for adxl345 oid 7, after 0.020 ms in the queue",
            "  -90.00             core      stepper oid 3 ran 0.310 ms late",
            "  -85.00 ..  -74.91  link      2 blocks from the host; 14 bytes to the host",
            "  -10.00             spi0      works for adxl345 oid 7. It did not end within 10.0 ms, when the recording ended",
            "   -4.90             core      the stop was about an event that was due at -43.00 ms",
        ] {
            assert!(text.contains(&format!("\n{line}\n")), "{line}\n{text}");
        }
        assert!(text.contains("8 commands (queue_step 2, set_next_step_dir 2, others 4)\n"), "{text}");
        assert_eq!(text.lines().count(), 28);
    }

    #[test]
    fn only_the_last_part_is_reported() {
        let text = text(|out| write(&late_host(), Duration::from_millis(20), out));
        assert_eq!(text.lines().nth(1).map(|line| &line[..6]), Some("-20.00"));
        assert!(text.contains("the MCU stopped in block 93"), "{text}");
    }

    /// The worst of many stand alone.
    #[test]
    fn a_flood_does_not_hide_the_worst() {
        let late = |number: u64| Event::Late { oid: Some(3), late: Ticks(if number == 777 { 90_000 } else { 500 }) };
        let flood: Vec<(u64, Event)> = (0..2000).map(|number| (number * 100, late(number))).collect();
        let trace = trace(End::Asked, &[("core", &flood)]);
        let text = text(|out| write(&trace, Duration::MAX, out));
        assert!(text.contains("stepper oid 3 ran 1.8 ms late\n"), "{text}");
        assert!(text.contains(" late timers, at most 0.010 ms\n"), "{text}");
    }

    proptest! {
        #[test]
        fn it_has_few_lines_whatever_happened(trace in any_trace(), last_ms: u64) {
            let text = text(|out| write(&trace, Duration::from_millis(last_ms), out));
            prop_assert!(text.lines().count() <= LINES_MAX + 1);
            prop_assert!(!text.contains(|c: char| c.is_control() && c != '\n'), "{text:?}");
        }
    }
}
