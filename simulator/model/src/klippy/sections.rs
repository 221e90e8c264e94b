// SPDX-License-Identifier: GPL-3.0-or-later
//! A printer.cfg while it is written.

use std::fmt::{self, Display, Write};

use super::layout::{CLEAR_MM, Layout, Place, WITHIN_REACH, rounded};
use crate::description::pin::PinName;
use crate::description::printer::Kinematics;

/// A printer.cfg that grows.
#[derive(Default)]
pub(crate) struct Sections {
    pub(crate) text: String,
    /// Whether the next lines are only offered: each of them begins with `#`.
    offered: bool,
    /// Whether there is a section of a probe already. klippy accepts one.
    pub(crate) has_probe: bool,
    /// Whether a chip is in `[resonance_tester]`. Its keys are of one chip.
    pub(crate) has_resonance_tester: bool,
}

impl Sections {
    /// Adds a line. Writing to a String cannot fail.
    pub(crate) fn line(&mut self, line: fmt::Arguments<'_>) {
        let mark = if self.offered { "#" } else { "" };
        let written = self.text.write_fmt(format_args!("{mark}{line}\n"));
        debug_assert!(written.is_ok());
    }

    /// Adds sections that replace others. A `#` before each of their lines keeps them out of use.
    pub(crate) fn offer(&mut self, sections: impl FnOnce(&mut Sections)) {
        self.offered = true;
        sections(self);
        self.offered = false;
    }

    /// Adds the section of a probe. klippy accepts one, so the first is in use, and the others are offered.
    pub(crate) fn probe(&mut self, layout: &Layout<'_>, section: impl FnOnce(&mut Sections)) {
        if !layout.has_head() {
            return;
        }
        if std::mem::replace(&mut self.has_probe, true) {
            self.section_break();
            self.comment("Another probe, in place of the one that is in use:");
            return self.offer(section);
        }
        section(self);
        self.section("bed_mesh");
        match layout.kinematics {
            Kinematics::Delta(delta) => {
                self.key("mesh_radius", rounded(WITHIN_REACH * delta.bed_radius_mm));
                self.key("round_probe_count", 5);
            }
            _ => {
                self.key("mesh_min", Place(layout.place_mm(1.0 - WITHIN_REACH, 1.0 - WITHIN_REACH)));
                self.key("mesh_max", Place(layout.place_mm(WITHIN_REACH, WITHIN_REACH)));
                self.key("probe_count", "5, 5");
            }
        }
        self.key("horizontal_move_z", CLEAR_MM);
        self.key("speed", layout.printer.limits.velocity_mm_per_s);
    }

    /// The keys of a probe with these offsets from the nozzle.
    pub(crate) fn offsets(&mut self, [x_mm, y_mm, z_mm]: [f64; 3]) {
        self.key("x_offset", x_mm);
        self.key("y_offset", y_mm);
        self.key("z_offset", z_mm);
    }

    /// The keys of a chip on an SPI bus.
    pub(crate) fn spi(&mut self, bus: &str, select_pin: Option<&PinName>) {
        match select_pin {
            Some(pin) => self.key("cs_pin", pin),
            None => self.key("cs_pin", "None"),
        }
        self.key("spi_bus", bus);
    }

    /// Adds a line for people.
    pub(crate) fn comment(&mut self, text: impl Display) {
        let text = text.to_string();
        self.line(format_args!("#{}{text}", if text.is_empty() { "" } else { " " }));
    }

    /// Says that klippy accepts this section only together with another one.
    pub(crate) fn needs(&mut self, section: impl Display) {
        self.comment(format_args!("Needs [{section}]."));
    }

    pub(crate) fn section_break(&mut self) {
        self.text.push('\n');
    }

    pub(crate) fn section(&mut self, name: impl Display) {
        self.section_break();
        self.line(format_args!("[{name}]"));
    }

    pub(crate) fn key(&mut self, key: impl Display, value: impl Display) {
        self.line(format_args!("{key}: {value}"));
    }

    pub(crate) fn key_if(&mut self, key: &str, value: Option<impl Display>) {
        if let Some(value) = value {
            self.key(key, value);
        }
    }

    /// A key with a line for each place.
    pub(crate) fn places(&mut self, key: &str, places: impl IntoIterator<Item = [f64; 2]>) {
        self.line(format_args!("{key}:"));
        places.into_iter().for_each(|place| self.line(format_args!("  {}", Place(place))));
    }
}
