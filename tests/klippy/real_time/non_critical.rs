// SPDX-License-Identifier: GPL-3.0-or-later
//! Kalico goes on while an MCU with `is_non_critical: True` is away. The checkout is `KLIPPER_DIR_KALICO`.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use pinion_firmware::mcu::DialectName;
use pinion_testkit::wait;

use super::Printer;
use crate::hosts;
use crate::klippy::{UNHOMED, WHERE_IT_STANDS, pinion_path, without};

/// Another Pinion, which is no part of the printer.
struct Room(Child);

impl Room {
    fn start(folder: &Path) -> Room {
        let pinion = Command::new(pinion_path())
            .args(["run", "--board", "sim", "-I"])
            .arg(folder.join("room"))
            .stdout(Stdio::null())
            .stderr(File::options().append(true).create(true).open(folder.join("room.log")).unwrap())
            .spawn();
        Room(pinion.unwrap())
    }

    /// kill -9.
    fn kill(mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

fn until_away(printer: &mut Printer) {
    printer.until_object("mcu room", "non_critical_disconnected", true);
}

/// Waits until the host has configured it this many times.
fn until_there(printer: &mut Printer, times: usize) {
    let log = printer.path("room.log");
    let configured = || fs::read_to_string(&log).unwrap().matches("configured: ").count();
    wait::until("the configuration", || configured() >= times);
    printer.until_object("mcu room", "non_critical_disconnected", false);
}

#[test]
fn kalico_prints_on_while_a_non_critical_mcu_is_away() {
    let Some(checkout) = hosts::checkout(DialectName::Kalico) else { return };
    let mut printer = Printer::start_on(
        &checkout,
        |board, _| board,
        |config| {
            let config = config.replace("[adxl345]\n", "[adxl345]\nrate: 400\n");
            let config = without(&without(&config, "load_cell ads1220"), "load_cell");
            let serial = config.lines().find_map(|line| line.strip_prefix("serial: ")).unwrap();
            let room = serial.strip_suffix("/tty").unwrap();
            config.clone()
                + &format!("\n[mcu room]\nserial: {room}/room\nis_non_critical: True\n")
                + "\n[output_pin lamp]\npin: room:beeper\n"
                + UNHOMED
        },
    );
    // klippy is there first.
    printer.until_state("ready");
    let folder = printer.path("");
    let mut room = Room::start(&folder);
    until_there(&mut printer, 1);
    printer.gcode(&format!("{WHERE_IT_STANDS}\nSET_PIN PIN=lamp VALUE=1"));
    for times in [2, 3] {
        room.kill();
        until_away(&mut printer);
        printer.gcode("G1 X40 Y30 Z8 F6000\nG1 X60 Y45\nM400");
        room = Room::start(&folder);
        until_there(&mut printer, times);
        printer.gcode("SET_PIN PIN=lamp VALUE=1\nG1 X50\nM400");
        assert_eq!(printer.state(), "ready");
    }
    room.kill();
}
