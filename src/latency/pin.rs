// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion latency --pin`: the cost of an edge of one line, through the kernel and through registers.

use std::path::Path;
use std::time::{Duration, Instant};

use pinion_firmware::board::{Bias, Board, Direction, Line, Pin};
use pinion_linux::gpio::{Chip, FastGpio};
use pinion_linux::pins::{Names, line_number};
use pinion_linux::sysfs::Sysfs;
use pinion_linux::{Inventory, LinuxBoard};

use super::{EdgeCost, computer_name};

/// How long each of the two ways is measured.
const SPAN: Duration = Duration::from_secs(1);
/// Edges between two readings of the clock. A reading costs about as much as an edge through registers.
const BATCH: u32 = 100;

/// The cost of an edge in nanoseconds.
struct Cost {
    edges: u64,
    /// The median and the 99th percentile of the batches' means.
    p50: f64,
    p99: f64,
}

/// Measures a free line and describes the result and the computer. `wish` is the way to the registers.
///
/// # Errors
///
/// There is no such line, or it is in use.
pub(super) fn measure(name: &str, wish: FastGpio) -> Result<(String, EdgeCost), String> {
    let line = find(name)?;
    let mut text = format!("{name}, {} s each way:\n", SPAN.as_secs());
    let mut way = |way: &str, wish: FastGpio| -> Result<Option<f64>, String> {
        let mut board = LinuxBoard::new(None, wish);
        let output = Direction::at_rest(false);
        let claimed = board.line(line, output).map_err(|stop| stop.to_string())?;
        let is_possible = wish == FastGpio::Off || claimed.line.is_fast();
        let cost = is_possible.then(|| cost(&*claimed.line)).transpose();
        // A line that nobody uses is an input.
        let _ = claimed.line.set_direction(Direction::Input(Bias::None));
        let cost = cost?;
        let said = cost.as_ref().map_or_else(|| "cannot be used: the line above says why".to_owned(), Cost::to_string);
        text += &format!("  {way:<9}  {said}\n{}", hidden(&*claimed.line));
        Ok(cost.map(|cost| cost.p50))
    };
    let (kernel_ns, registers_ns) = (way("kernel", FastGpio::Off)?, way("registers", wish)?);
    let edge = EdgeCost { line: name.to_owned(), kernel_ns, registers_ns };
    Ok((text + &format!("on {}\n", computer_name()), edge))
}

/// The limits of the measurement of this line.
fn hidden(line: &dyn Line) -> &'static str {
    match line.is_posted() {
        true => {
            "             this keeps the PCIe link awake: it cannot show edges that a sleeping link delays and joins\n"
        }
        false => "",
    }
}

impl std::fmt::Display for Cost {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.1} ns an edge, p99 {:.1} ns ({} edges)", self.p50, self.p99, self.edges)
    }
}

/// The board's number of a line that nobody has.
fn find(name: &str) -> Result<Pin, String> {
    let inventory = Inventory::scan();
    let (names, sysfs) = (Names::of(&inventory), Sysfs::scan(Path::new("/")));
    let lines =
        inventory.chips.iter().flat_map(|chip| (0..).zip(&chip.lines).map(move |(offset, line)| (chip, offset, line)));
    let is_it = |number: u32, chip: &Chip, offset: u32| {
        names.of_pin(number).contains(&name)
            || name == format!("gpiochip{}/gpio{offset}", chip.number)
            || chip.number == 0 && name == format!("gpio{offset}")
            || inventory.former_names(chip, offset).iter().any(|former| former == name)
    };
    let found = lines.filter_map(|(chip, offset, line)| Some((line_number(chip.number, offset)?, chip, offset, line)));
    let Some((number, chip, offset, line)) =
        found.into_iter().find(|(number, chip, offset, _)| is_it(*number, chip, *offset))
    else {
        return Err(format!("there is no line {name}: choose a free one (pinion pins --free lists them)"));
    };
    let device = sysfs.devices.get(&(chip.label.clone(), offset)).map(String::as_str);
    match line.consumer.as_deref().filter(|_| line.held).or(device).or(line.held.then_some("the kernel")) {
        Some(user) => Err(format!("{name} is in use by {user}: choose a free line (pinion pins --free lists them)")),
        None if chip.sleeps => Err(format!("{name} is behind a bus: choose a line of the computer's own chip")),
        None => Ok(Pin(number)),
    }
}

/// Toggles the line as fast as possible.
fn cost(line: &dyn Line) -> Result<Cost, String> {
    let mut means = Vec::new();
    let start = Instant::now();
    let mut at = Duration::ZERO;
    while at < SPAN {
        for edge in 0..BATCH {
            line.write(edge % 2 == 0).map_err(|stop| stop.to_string())?;
        }
        let now = start.elapsed();
        means.push((now - at).as_nanos() as f64 / f64::from(BATCH));
        at = now;
    }
    means.sort_by(f64::total_cmp);
    let quantile = |share: f64| means[((means.len() - 1) as f64 * share) as usize];
    Ok(Cost { edges: means.len() as u64 * u64::from(BATCH), p50: quantile(0.5), p99: quantile(0.99) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::shutdown::Shutdown;

    /// A line behind PCIe, or not.
    struct Wire(bool);

    impl Line for Wire {
        fn write(&self, _: bool) -> Result<(), Shutdown> {
            Ok(())
        }

        fn read(&self) -> Result<bool, Shutdown> {
            Ok(false)
        }

        fn set_direction(&self, _: Direction) -> Result<(), Shutdown> {
            Ok(())
        }

        fn is_posted(&self) -> bool {
            self.0
        }
    }

    #[test]
    fn a_measurement_behind_pcie_says_what_it_cannot_show() {
        assert!(hidden(&Wire(true)).contains("keeps the PCIe link awake"));
        assert_eq!(hidden(&Wire(false)), "");
    }
}
