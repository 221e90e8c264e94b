// SPDX-License-Identifier: GPL-3.0-or-later
//! The services beside klippy that use lines and devices: Moonraker's `[power]`, `[button]` and `[sensor]`, and crowsnest's
//! cameras. Their files have klippy's syntax, and its bounds hold for them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use pinion_printer_config::Config;

use super::super::Computer;
use super::{Resource, Source, Use, Uses};

/// Where Moonraker's configuration is, if it is not beside a printer.cfg.
const MOONRAKERS: [&str; 2] =
    ["/home/*/printer_data/config/moonraker.conf", "/home/*/printer_*_data/config/moonraker.conf"];

/// The configurations of this name beside these files, and in the usual places.
fn beside(computer: &Computer, configs: &BTreeSet<PathBuf>, name: &str) -> BTreeSet<PathBuf> {
    let usual = MOONRAKERS.iter().flat_map(|pattern| computer.matching(Path::new(pattern).with_file_name(name)));
    let usual = usual.map(|path| computer.name(&path));
    configs.iter().map(|config| config.with_file_name(name)).chain(usual).filter(|path| computer.exists(path)).collect()
}

impl Uses {
    pub(super) fn add_services(&mut self, computer: &Computer, configs: &BTreeSet<PathBuf>) {
        for path in beside(computer, configs, "moonraker.conf") {
            let Ok(config) = Config::read_from(computer, &path) else { continue };
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
        for path in beside(computer, configs, "crowsnest.conf") {
            let Ok(config) = Config::read_from(computer, &path) else { continue };
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
