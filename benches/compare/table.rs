// SPDX-License-Identifier: GPL-3.0-or-later
//! The figures of all runs.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io;
use std::path::Path;

/// The value that this share of sorted values does not exceed.
pub fn quantile(sorted: &[i64], share: f64) -> i64 {
    let rank = (sorted.len() as f64 * share).ceil() as usize;
    sorted.get(rank.clamp(1, sorted.len().max(1)) - 1).copied().unwrap_or(0)
}

/// The place of a figure in the table.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    group: String,
    case: String,
}

#[derive(Debug)]
struct Figure {
    place: Place,
    name: &'static str,
    unit: &'static str,
    program: usize,
    round: u32,
    value: f64,
}

#[derive(Debug)]
struct Remark {
    place: Place,
    program: usize,
    text: String,
}

/// Figures of programs.
#[derive(Debug)]
pub struct Table {
    programs: Vec<String>,
    figures: Vec<Figure>,
    notes: Vec<Remark>,
    others: Vec<f64>,
}

/// Takes the figures of one program in one round.
pub struct Run<'a> {
    table: &'a mut Table,
    program: usize,
    round: u32,
    summary: String,
}

impl<'a> Run<'a> {
    pub fn new(table: &'a mut Table, program: usize, round: u32) -> Run<'a> {
        Run { table, program, round, summary: String::new() }
    }

    pub fn add(&mut self, group: &str, case: &str, name: &'static str, unit: &'static str, value: f64) {
        let place = Place { group: group.into(), case: case.into() };
        let _ = write!(self.summary, "{} {group}, {case}: {name} {} {unit}", self.comma(), short(value));
        let (program, round) = (self.program, self.round);
        self.table.figures.push(Figure { place, name, unit, program, round, value });
    }

    /// Adds a note to a figure.
    pub fn note(&mut self, group: &str, case: &str, text: &str) {
        let _ = write!(self.summary, "; {text}");
        let place = Place { group: group.into(), case: case.into() };
        self.table.notes.push(Remark { place, program: self.program, text: text.into() });
    }

    /// CPUs that other processes used meanwhile.
    pub fn others(&mut self, cpus: f64) {
        let _ = write!(self.summary, "; others used {cpus:.2} CPUs");
        self.table.others.push(cpus);
    }

    pub fn summary(&self) -> &str {
        self.summary.trim_start()
    }

    fn comma(&self) -> &'static str {
        if self.summary.is_empty() { "" } else { ";" }
    }
}

impl Table {
    pub fn new(programs: Vec<String>) -> Table {
        Table { programs, figures: Vec::new(), notes: Vec::new(), others: Vec::new() }
    }

    pub fn write_csv(&self, file: &Path) -> io::Result<()> {
        let mut text = String::from("group,case,figure,unit,program,round,value\n");
        for figure in &self.figures {
            let Figure { place: Place { group, case }, name, unit, program, round, value } = figure;
            let program = &self.programs[*program];
            let _ = writeln!(text, "{group},\"{case}\",{name},{unit},{program},{round},{value}");
        }
        std::fs::write(file, text)
    }

    /// One line for each case: medians over all rounds. A single figure also gets its spread.
    pub fn render(&self, markdown: bool) -> String {
        let mut groups: Vec<&str> = Vec::new();
        for figure in &self.figures {
            if !groups.contains(&figure.place.group.as_str()) {
                groups.push(&figure.place.group);
            }
        }
        let mut text = String::new();
        let mut remarks = Vec::new();
        for group in groups {
            let rows = self.rows(group, &mut remarks);
            write_rows(&rows, markdown, &mut text);
        }
        for remark in remarks {
            let _ = writeln!(text, "{remark}\n");
        }
        if !self.others.is_empty() {
            let mean = self.others.iter().sum::<f64>() / self.others.len() as f64;
            let max = self.others.iter().copied().fold(0.0, f64::max);
            let _ = writeln!(text, "Others on this computer used {mean:.2} CPUs in the mean, {max:.2} at most.");
        }
        text
    }

    fn rows(&self, group: &str, remarks: &mut Vec<String>) -> Vec<Vec<String>> {
        let figures: Vec<&Figure> = self.figures.iter().filter(|figure| figure.place.group == group).collect();
        let (mut cases, mut names): (Vec<&Place>, Vec<&str>) = (Vec::new(), Vec::new());
        for figure in &figures {
            if !cases.contains(&&figure.place) {
                cases.push(&figure.place);
            }
            if !names.contains(&figure.name) {
                names.push(figure.name);
            }
        }
        let head = match names[..] {
            [""] => format!("{group}, {}", figures[0].unit),
            _ => format!("{group}, {}: {}", figures[0].unit, names.join(" / ")),
        };
        let mut rows = vec![[head].into_iter().chain(self.programs.iter().cloned()).collect::<Vec<_>>()];
        for place in cases {
            let mut row = vec![place.case.clone()];
            for program in 0..self.programs.len() {
                let values = names.iter().map(|name| {
                    let mine = figures.iter().filter(|f| f.place == *place && f.program == program && f.name == *name);
                    let mut values: Vec<f64> = mine.map(|figure| figure.value).collect();
                    values.sort_by(f64::total_cmp);
                    values
                });
                let mut cell = cell(&values.collect::<Vec<_>>());
                if let Some(remark) = self.remark(place, program) {
                    remarks.push(format!(
                        "{} {}: {}, {}: {remark}",
                        remarks.len() + 1,
                        self.programs[program],
                        group,
                        place.case
                    ));
                    let _ = write!(cell, " [{}]", remarks.len());
                }
                row.push(cell);
            }
            rows.push(row);
        }
        rows
    }

    /// The notes on a cell. A note of several rounds appears once.
    fn remark(&self, place: &Place, program: usize) -> Option<String> {
        let mut texts: BTreeMap<&str, u32> = BTreeMap::new();
        for note in self.notes.iter().filter(|note| note.place == *place && note.program == program) {
            *texts.entry(&note.text).or_default() += 1;
        }
        let texts: Vec<String> = texts.into_iter().map(|(text, times)| times_text(text, times)).collect();
        (!texts.is_empty()).then(|| texts.join("; "))
    }
}

fn times_text(text: &str, times: u32) -> String {
    if times == 1 { text.into() } else { format!("{text} ({times} times)") }
}

fn median(sorted: &[f64]) -> f64 {
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { (sorted[middle - 1] + sorted[middle]) / 2.0 }
}

fn cell(values: &[Vec<f64>]) -> String {
    match values {
        _ if values.iter().all(Vec::is_empty) => "-".into(),
        [one] if one.len() > 1 => {
            format!("{} ({} to {})", short(median(one)), short(one[0]), short(one[one.len() - 1]))
        }
        _ => {
            let each = values.iter().map(|values| if values.is_empty() { "-".into() } else { short(median(values)) });
            each.collect::<Vec<_>>().join(" / ")
        }
    }
}

/// A number with two or three significant digits.
fn short(value: f64) -> String {
    match value.abs() {
        size if size < 0.995 => format!("{value:.2}"),
        size if size < 99.5 => format!("{value:.1}"),
        _ => format!("{value:.0}"),
    }
}

fn write_rows(rows: &[Vec<String>], markdown: bool, text: &mut String) {
    let columns = rows[0].len();
    let widths: Vec<usize> = (0..columns).map(|at| rows.iter().map(|row| row[at].len()).max().unwrap_or(0)).collect();
    for (number, row) in rows.iter().enumerate() {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        let line = if markdown { format!("| {} |", cells.join(" | ")) } else { cells.join("  ") };
        let _ = writeln!(text, "{}", line.trim_end());
        if number == 0 && markdown {
            let _ = writeln!(text, "|{}|", vec!["---"; columns].join("|"));
        }
    }
    text.push('\n');
}
