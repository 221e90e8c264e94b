// SPDX-License-Identifier: GPL-3.0-or-later
//! The figures of programs, side by side.

use std::collections::BTreeMap;

/// The start of a figure in a test's output (libtest may have begun the line). The rest follows after tabs: the subject
/// of the figure, the case and the value. See `guest/figures.rs`.
const MARK: &str = "figure\t";

/// Figures by kernel and program.
pub struct Table {
    columns: Vec<String>,
    /// By the subject of the figures.
    groups: Named<Named<Values>>,
}

/// In the order of arrival.
type Named<T> = Vec<(String, T)>;
/// By column.
type Values = BTreeMap<usize, String>;

impl Table {
    /// A column that is named twice exists once.
    pub fn new(names: impl Iterator<Item = String>) -> Table {
        let mut columns = Vec::new();
        for name in names {
            if !columns.contains(&name) {
                columns.push(name);
            }
        }
        Table { columns, groups: Vec::new() }
    }

    /// Takes the figures from a test's output.
    pub fn take(&mut self, column: &str, output: &str) {
        let column = self.columns.iter().position(|name| name == column).expect("a column of the runs");
        for figure in output.lines().filter_map(|line| Some(line.split_once(MARK)?.1)) {
            let mut parts = figure.split('\t').map(str::to_owned);
            let mut part = || parts.next().unwrap_or_default();
            let cases = entry(&mut self.groups, part());
            entry(cases, part()).insert(column, part());
        }
    }

    /// Prints the figures as Markdown, if there are any.
    pub fn print(&self) {
        if self.groups.is_empty() {
            return;
        }
        let with_figures = |column: &usize| {
            self.groups.iter().any(|(_, cases)| cases.iter().any(|(_, values)| values.contains_key(column)))
        };
        let columns: Vec<usize> = (0..self.columns.len()).filter(with_figures).collect();
        let row = |head: &str, cell: &dyn Fn(usize) -> String| {
            let cells: Vec<String> = columns.iter().map(|column| cell(*column)).collect();
            println!("| {head} | {} |", cells.join(" | "));
        };
        if cfg!(debug_assertions) {
            println!("\nFigures of a debug build:");
        }
        println!();
        row("", &|column| self.columns[column].clone());
        row("---", &|_| "---:".into());
        for (group, cases) in &self.groups {
            row(&format!("**{group}**"), &|_| String::new());
            for (case, values) in cases {
                row(case, &|column| values.get(&column).cloned().unwrap_or_else(|| "-".into()));
            }
        }
    }
}

/// The value with this name. It is appended if it does not exist.
fn entry<T: Default>(list: &mut Named<T>, name: String) -> &mut T {
    let at = list.iter().position(|(other, _)| *other == name).unwrap_or_else(|| {
        list.push((name, T::default()));
        list.len() - 1
    });
    &mut list[at].1
}
