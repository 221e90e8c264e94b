// SPDX-License-Identifier: GPL-3.0-or-later
//! Files of klippy that include each other, as `pinion doctor` reads them. A byte 0 separates them.

use std::fs;
use std::path::Path;

use pinion_system::Computer;
use pinion_system::printer::{Printer, line_of};

pub fn run(bytes: &[u8]) {
    let folder = std::env::temp_dir().join(format!("pinion-fuzz-{}", std::process::id()));
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder");
    let names = ["printer.cfg", "a.cfg", "b.cfg", "c.txt", "d", "e.cfg"];
    for (text, name) in bytes.split(|byte| *byte == 0).zip(names) {
        fs::write(folder.join(name), text).expect("a file");
    }
    let computer = Computer::at(&folder);
    if let Ok(printer) = Printer::read(&computer, Path::new("/printer.cfg")) {
        assert!(printer.spi_leds().iter().all(|pin| pin.contains("spidev")));
        let (numbered, own) = (printer.numbered(), printer.own_mcus(&computer, None));
        assert!(numbered.iter().all(|(_, pin)| line_of(pin).is_some()) && own.len() <= printer.serials().len());
    }
}
