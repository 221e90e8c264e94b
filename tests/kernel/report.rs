// SPDX-License-Identifier: GPL-3.0-or-later
//! The output of the run, in libtest's form.

use std::time::Instant;

use super::table::Table;
use super::vm::Run;

#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    Passed,
    Failed,
}

pub struct Report {
    started: Instant,
    planned: usize,
    passed: usize,
    /// Name and output.
    failures: Vec<(String, String)>,
    table: Table,
    filtered_out: usize,
    show_output: bool,
}

impl Report {
    pub fn new(runs: &[Run<'_>], filtered_out: usize, show_output: bool) -> Report {
        let planned = runs.iter().map(|run| run.tests.len()).sum();
        println!("\nrunning {planned} test{}", if planned == 1 { "" } else { "s" });
        let table = Table::new(runs.iter().map(Run::column));
        Report { started: Instant::now(), planned, passed: 0, failures: Vec::new(), table, filtered_out, show_output }
    }

    /// Takes a test's result.
    pub fn test(&mut self, run: &Run<'_>, test: &str, outcome: Outcome, output: &str) {
        let name = run.name_of(test);
        self.table.take(&run.column(), output);
        if self.show_output {
            println!("---- {name} ----\n{}", output.trim_end());
        }
        match outcome {
            Outcome::Passed => {
                println!("test {name} ... ok");
                self.passed += 1;
            }
            Outcome::Failed => {
                println!("test {name} ... FAILED");
                self.failures.push((name, output.to_owned()));
            }
        }
    }

    /// Prints the rest. Returns whether every planned test passed.
    pub fn finish(mut self) -> bool {
        self.table.print();
        if !self.failures.is_empty() {
            println!("\nfailures:\n");
            for (name, output) in &self.failures {
                println!("---- {name} ----\n{}\n", output.trim_end());
            }
            self.failures.sort();
            println!("\nfailures:");
            for (name, _) in &self.failures {
                println!("    {name}");
            }
        }
        let ok = self.passed == self.planned;
        println!(
            "\ntest result: {}. {} passed; {} failed; 0 ignored; 0 measured; {} filtered out; \
             finished in {:.2}s\n",
            if ok { "ok" } else { "FAILED" },
            self.passed,
            self.planned - self.passed,
            self.filtered_out,
            self.started.elapsed().as_secs_f64()
        );
        ok
    }
}
