// SPDX-License-Identifier: GPL-3.0-or-later
//! The services beside klippy that use lines and devices: Moonraker's `[power]`, `[button]` and `[sensor]`, and crowsnest's
//! cameras. Their files have klippy's syntax, and its bounds hold for them.

use std::path::Path;

use super::super::Computer;
use super::{Resource, Source, Use, Uses};

/// Where the configurations are, if they are not beside a printer.cfg.
const FOLDERS: [&str; 2] = ["/home/*/printer_data/config", "/home/*/printer_*_data/config"];

impl Uses {
    /// Adds the services that no known printer.cfg is beside.
    pub(super) fn add_other_services(&mut self, computer: &Computer) {
        for folder in FOLDERS.iter().flat_map(|pattern| computer.matching(pattern)) {
            self.add_services(computer, &computer.name(&folder));
        }
    }

    /// Adds the services that are configured in this folder.
    pub(super) fn add_services(&mut self, computer: &Computer, folder: &Path) {
        if let Ok(config) = computer.config(&folder.join("moonraker.conf")) {
            let kinds = ["power", "button", "sensor"];
            for section in config.sections().iter().filter(|section| kinds.contains(&section.kind())) {
                let Some(pin) = section.text("pin") else { continue };
                let name = pin.trim_start_matches(['^', '~', '!', '*', ' ']);
                if let Some(line) = self.names.line(name) {
                    self.add(Use {
                        what: Resource::Line(line),
                        user: format!("Moonraker's [{}]", section.name),
                        place: section.place_of("pin").to_string(),
                        source: Source::Service,
                        function: None,
                    });
                }
            }
        }
        if let Ok(config) = computer.config(&folder.join("crowsnest.conf")) {
            for section in config.of_kind("cam") {
                let Some(device) = section.text("device").filter(|device| device.starts_with("/dev/")) else {
                    continue;
                };
                self.add(Use {
                    what: Resource::Device(device.to_owned()),
                    user: format!("crowsnest's [{}]", section.name),
                    place: section.place_of("device").to_string(),
                    source: Source::Service,
                    function: None,
                });
            }
        }
    }
}
