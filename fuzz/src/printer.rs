// SPDX-License-Identifier: GPL-3.0-or-later
//! The description of a simulated printer: the printer that it makes, and its printer.cfg.

use std::sync::Arc;

use pinion_firmware::board::Board as _;
use pinion_firmware::time::{Clock, VirtualClock};
use pinion_model::{SimBoard, SimConfig, printer_cfg};

pub fn run(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    match SimConfig::parse(text, "f.toml") {
        Ok(config) => {
            let cfg = printer_cfg(&config, "/tmp/klipper_host_mcu");
            assert!(!cfg.contains(|c: char| c.is_control() && c != '\n'), "{cfg:?}");
            let clock = Arc::new(VirtualClock::at(Clock::from_ticks(0)));
            let board = SimBoard::new(config, clock).expect("a description that was checked");
            board.pins();
        }
        Err(trouble) => assert!(trouble.to_string().starts_with("f.toml:"), "{trouble}"),
    }
}
