// SPDX-License-Identifier: GPL-3.0-or-later
//! Sections without hardware of their own, offered for trying their G-codes.

use crate::klippy::layout::{CLEAR_MM, Layout, Place, WITHIN_REACH, rounded};
use crate::klippy::sections::Sections;

/// Sections that any printer accepts, with their keys.
const ANYWHERE: [(&str, &[(&str, &str)]); 10] = [
    ("gcode_arcs", &[("resolution", "0.1")]),
    (
        "firmware_retraction",
        &[
            ("retract_length", "0.8"),
            ("retract_speed", "35"),
            ("unretract_extra_length", "0"),
            ("unretract_speed", "25"),
        ],
    ),
    ("force_move", &[("enable_force_move", "True")]),
    ("respond", &[]),
    ("pause_resume", &[]),
    ("exclude_object", &[]),
    ("display_status", &[]),
    ("skew_correction", &[]),
    ("endstop_phase", &[]),
    ("save_variables", &[("filename", "~/pinion_variables.cfg")]),
];

/// The corners of the bed, clockwise from the front left.
const CORNERS: [(&str, [f64; 2]); 4] = [
    ("front left", [1.0 - WITHIN_REACH, 1.0 - WITHIN_REACH]),
    ("rear left", [1.0 - WITHIN_REACH, WITHIN_REACH]),
    ("rear right", [WITHIN_REACH, WITHIN_REACH]),
    ("front right", [WITHIN_REACH, 1.0 - WITHIN_REACH]),
];

impl Sections {
    /// Offers the sections without hardware.
    pub(super) fn software(&mut self, layout: &Layout<'_>) {
        self.section_break();
        self.comment("Sections without hardware. Take the # away before each line of those that you want:");
        self.offer(|cfg| {
            for (name, keys) in ANYWHERE {
                cfg.section(name);
                keys.iter().for_each(|(key, value)| cfg.key(key, value));
            }
            cfg.section("sdcard_loop");
            cfg.needs("virtual_sdcard");
            if layout.has_rails() {
                cfg.screws(layout);
            }
        });
    }

    /// The sections for the bed of a cartesian printer.
    fn screws(&mut self, layout: &Layout<'_>) {
        let corners = CORNERS.map(|(name, [x, y])| (name, layout.place_mm(x, y)));
        for section in ["bed_screws", "screws_tilt_adjust"] {
            self.section(section);
            for (n, (name, at_mm)) in (1..).zip(corners) {
                self.key(format_args!("screw{n}"), Place(at_mm));
                self.key(format_args!("screw{n}_name"), name);
            }
        }
        self.key("screw_thread", "CW-M3");
        self.section("bed_tilt");
        self.comment("Takes the place of [bed_mesh].");
        self.places("points", corners.map(|(_, at_mm)| at_mm));
        self.section("safe_z_home");
        self.key("home_xy_position", Place(layout.place_mm(0.5, 0.5)));
        self.key("z_hop", CLEAR_MM);
        if self.has_probe {
            let [[start_mm, _], [end_mm, middle_mm]] =
                [[1.0 - WITHIN_REACH, 0.5], [WITHIN_REACH, 0.5]].map(|[x, y]| layout.place_mm(x, y));
            self.section("axis_twist_compensation");
            self.comment("Needs a probe beside the nozzle.");
            self.key("calibrate_start_x", rounded(start_mm));
            self.key("calibrate_end_x", rounded(end_mm));
            self.key("calibrate_y", rounded(middle_mm));
        }
    }
}
