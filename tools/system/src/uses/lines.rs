// SPDX-License-Identifier: GPL-3.0-or-later
//! The names of a computer's lines: one name for each line, from every source and in every form.

use std::collections::BTreeMap;

use pinion_linux::Inventory;

use super::super::Computer;
use super::super::board::{Board, Maker, is_pi, is_pi5};
use super::super::printer::line_of;

/// The lines of an Allwinner's two pin controllers. The second one begins with the bank PL.
const ALLWINNER: [(&str, u32); 2] = [("300b000.pinctrl", 288), ("7022000.pinctrl", 64)];
/// The lines of a Rockchip's bank.
const ROCKCHIP_LINES: u32 = 32;
/// The lines of a Raspberry Pi's header chip.
const PI_LINES: u32 = 58;
/// The number of the first line in /sys/class/gpio.
const SYSFS_FIRST: u32 = 512;

/// The names of a computer's lines.
pub struct Names {
    maker: Option<Maker>,
    /// The numbers that mean the chip of a Raspberry Pi's header.
    header: Vec<u32>,
    /// The kernel's labels by the chip's number, and how many lines it has. Empty if the kernel was not asked.
    chips: BTreeMap<u32, (String, u32)>,
    /// The kernel's own names of lines.
    named: BTreeMap<String, (u32, u32)>,
}

impl Names {
    pub(super) fn of(computer: &Computer, board: Option<&Board>, inventory: Option<&Inventory>) -> Names {
        let maker = board.map(|board| board.maker).or_else(|| is_pi(computer).then_some(Maker::Raspberry));
        let found = inventory.map(|inventory| &inventory.chips[..]).unwrap_or_default();
        let count = |lines: usize| u32::try_from(lines).unwrap_or(u32::MAX);
        let chips = found.iter().map(|chip| (chip.number, (chip.label.clone(), count(chip.lines.len())))).collect();
        let lines =
            found.iter().flat_map(|chip| (0..).zip(&chip.lines).map(move |(line, about)| (chip.number, line, about)));
        let named = lines.filter_map(|(chip, line, about)| Some((about.name.clone()?, (chip, line)))).collect();
        let header = match inventory.and_then(|inventory| Some((inventory, inventory.header()?))) {
            Some((inventory, header)) => {
                (0..16).filter(|n| *n == header.number || inventory.renumbered(*n).is_some()).collect()
            }
            None if is_pi5(computer) => vec![0, 4],
            None => vec![0],
        };
        Names { maker, header, chips, named }
    }

    /// Whether the kernel has said which lines there are.
    pub(super) fn knows_all(&self) -> bool {
        !self.chips.is_empty()
    }

    /// The one name of the line that Pinion takes this name for. `None` if there is no such line.
    pub fn line(&self, name: &str) -> Option<String> {
        if let Some((chip, line)) = line_of(name) {
            return self.numbered(chip, line);
        }
        if let Some((label, line)) = name.split_once("/gpio") {
            let line: u32 = line.parse().ok()?;
            return match self.maker {
                Some(Maker::Raspberry) if label.starts_with("pinctrl-") => pi(line),
                _ => match self.chips.iter().find(|(_, (own, _))| own == label) {
                    Some((chip, _)) => self.numbered(*chip, line),
                    None => Some(format!("{label}/gpio{line}")),
                },
            };
        }
        if self.maker == Some(Maker::Raspberry)
            && let Some(line) = name.strip_prefix("GPIO").and_then(|line| line.parse().ok())
        {
            return pi(line);
        }
        self.named.get(name).and_then(|(chip, line)| self.numbered(*chip, *line))
    }

    fn numbered(&self, chip: u32, line: u32) -> Option<String> {
        let known = self.chips.get(&chip);
        match (self.maker, known) {
            (Some(Maker::Raspberry), _) if self.header.contains(&chip) => pi(line),
            (_, Some((label, count))) => (line < *count).then(|| format!("{label}/gpio{line}")),
            (Some(Maker::Allwinner), None) => {
                let (label, count) = ALLWINNER.get(usize::try_from(chip).ok()?)?;
                (line < *count).then(|| format!("{label}/gpio{line}"))
            }
            (Some(Maker::Rockchip), None) if line >= ROCKCHIP_LINES => None,
            _ => Some(format!("gpiochip{chip}/gpio{line}")),
        }
    }

    /// The line that a name of the maker, of a header's pin or of sysfs means: `PG19`, `GPIO4_B2`, `1-C7`, `11`, `gpio529`.
    /// Pinion does not know these names.
    pub fn meant(&self, name: &str, board: Option<&Board>) -> Option<String> {
        let pin = name.trim_start_matches(|c: char| c.is_ascii_alphabetic() || "_-".contains(c));
        let is_pin = name == pin || name.to_ascii_lowercase().starts_with("pin");
        if is_pin && let Some(line) = pin.parse().ok().and_then(|pin| board?.line(pin)) {
            return self.line(line);
        }
        if let Some(line) = line_of(name).map(|(_, line)| line).filter(|line| *line >= SYSFS_FIRST) {
            return self.numbered(0, line - SYSFS_FIRST);
        }
        match self.maker? {
            Maker::Raspberry => self.line(&name.to_ascii_uppercase()),
            Maker::Allwinner => {
                let mut letters = name.strip_prefix(['P', 'p'])?.chars();
                let bank = u32::from(letters.next()?.to_ascii_uppercase())
                    .checked_sub(u32::from('A'))
                    .filter(|bank| *bank < 26)?;
                let line: u32 = letters.as_str().parse().ok().filter(|line| *line < 32)?;
                let second = u32::from('L') - u32::from('A');
                match bank.checked_sub(second) {
                    Some(bank) => self.numbered(1, bank * 32 + line),
                    None => self.numbered(0, bank * 32 + line),
                }
            }
            Maker::Rockchip => {
                let name = name.to_ascii_uppercase();
                let (chip, line) = name.strip_prefix("GPIO").unwrap_or(&name).split_once(['_', '-'])?;
                let group = u32::from(line.chars().next()?).checked_sub(u32::from('A')).filter(|group| *group < 4)?;
                let line: u32 = line.get(1..)?.parse().ok().filter(|line| *line < 8)?;
                self.numbered(chip.parse().ok()?, group * 8 + line)
            }
        }
    }

    /// The header's pin of a line.
    pub fn pin(&self, board: &Board, line: &str) -> Option<usize> {
        (1..=board.pins.len()).find(|pin| self.of_pin(board, *pin).as_deref() == Some(line))
    }

    /// The line of a pin, of a bus's too.
    pub fn of_pin(&self, board: &Board, pin: usize) -> Option<String> {
        let label = board.line_label(pin);
        board.line(pin).and_then(|line| self.line(line)).or_else(|| match label.starts_with(['G', 'P']) {
            true => self.line(label).or_else(|| self.meant(label, None)),
            false => None,
        })
    }
}

fn pi(line: u32) -> Option<String> {
    (line < PI_LINES).then(|| format!("GPIO{line}"))
}
