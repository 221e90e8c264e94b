// SPDX-License-Identifier: GPL-3.0-or-later
//! The display controller SSD1306 with a panel of 128 x 64, on I2C or SPI, after its data sheet (Solomon
//! Systech SSD1306, rev. 1.1: "MCU Interface", "Command Table", "Graphic Display Data RAM"). Also the SH1106 (Sino Wealth),
//! which has 132 columns: a module's panel is at the middle ones.
//!
//! The panel is mounted as on the usual modules. The picture is upright if the segments are remapped (A1) and the COM
//! outputs are scanned downward (C8). The COM outputs are wired alternately (DA 12).
//!
//! Simulated: every command with its arguments, the three addressing modes, the mapping of the memory to segments and
//! COM outputs, offset, start line, multiplex ratio, inversion, all pixels on, display and charge pump off, the reset
//! line, the status byte. Not simulated: scrolling, contrast, oscillator and voltages, other wirings of the COM
//! outputs. The memory starts as noise, as in a real chip.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Trouble, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::i2c::I2cChip;
use crate::engine::look::Look;
use crate::engine::noise::Noise;
use crate::engine::spi::SpiChip;
use crate::engine::wire::{Wire, output};
use crate::engine::world::Sight;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::Clock;

const COLUMNS: u8 = 128;
const PAGES: u8 = 8;
const ROWS: u8 = 64;
/// The address of a module with SA0 low.
const ADDRESS: u8 = 0x3c;

/// The columns of the SH1106.
const MORE_COLUMNS: u8 = 132;

/// A display controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DisplayChip {
    /// 128 columns.
    #[default]
    Ssd1306,
    /// It addresses by pages only, and its converter is on after a reset.
    Sh1106,
}

impl DisplayChip {
    fn columns(self) -> u8 {
        match self {
            DisplayChip::Ssd1306 => COLUMNS,
            DisplayChip::Sh1106 => MORE_COLUMNS,
        }
    }
}

/// The display's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ssd1306Config {
    /// For example `display`.
    pub name: String,
    /// The controller.
    #[serde(default)]
    pub chip: DisplayChip,
    /// Its bus: I2C, or SPI if it has a `dc_pin`.
    pub bus: String,
    /// Its address on I2C.
    #[serde(default = "default_address")]
    pub address: u8,
    /// High while SPI sends data, low while it sends commands.
    pub dc_pin: Option<PinName>,
    /// Low selects the chip on SPI. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// Low resets it.
    pub reset_pin: Option<PinName>,
}

fn default_address() -> u8 {
    ADDRESS
}

impl Part for Ssd1306Config {
    fn name(&self) -> String {
        format!("ssd1306 {}", self.name)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(match self.dc_pin {
            Some(_) => Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() },
            None => Socket::I2c { bus: &self.bus, address: self.address },
        })
    }

    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        vec![("dc_pin", self.dc_pin.as_ref()), ("reset_pin", self.reset_pin.as_ref())]
    }

    fn validate(&self, whose: &str, _printer: &Printer<'_>) -> Result<(), Trouble> {
        if self.dc_pin.is_none() && self.select_pin.is_some() {
            return wrong(whose, "select_pin", "a chip on I2C has none", "remove it, or add `dc_pin` for SPI");
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let panel = Arc::new(Panel::new(&self.name, self.chip, workshop.noise(self)));
        workshop.wire(self.dc_pin.as_ref(), mode_pin(panel.clone()));
        workshop.wire(self.reset_pin.as_ref(), reset_pin(panel.clone()));
        match self.dc_pin {
            Some(_) => workshop.solder_spi(self, OnSpi(panel.clone())),
            None => workshop.solder_i2c(self, OnI2c { panel: panel.clone(), control: None }),
        }
        workshop.show(panel);
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, _layout: &Layout<'_>) {
        // klippy uses the word `display` for the first one.
        match self.name.as_str() {
            "display" => cfg.section("display"),
            name => cfg.section(format_args!("display {name}")),
        }
        match self.chip {
            DisplayChip::Ssd1306 => cfg.key("lcd_type", "ssd1306"),
            DisplayChip::Sh1106 => {
                cfg.key("lcd_type", "sh1106");
                cfg.key("x_offset", (MORE_COLUMNS - COLUMNS) / 2);
            }
        }
        match &self.dc_pin {
            Some(pin) => {
                cfg.spi(&self.bus, self.select_pin.as_ref());
                cfg.key("dc_pin", pin);
            }
            None => {
                cfg.key("i2c_bus", &self.bus);
                cfg.key("i2c_address", self.address);
            }
        }
        cfg.key_if("reset_pin", self.reset_pin.as_ref());
    }
}

struct Panel {
    name: String,
    chip: Mutex<Chip>,
    /// The core drives these without a lock: D/C, the reset line, and whether the reset line was low since the last
    /// access to the chip.
    is_data: AtomicBool,
    held: AtomicBool,
    was_reset: AtomicBool,
}

/// How the place of the next byte follows from the place of this one.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Addressing {
    Horizontal,
    Vertical,
    Page,
}

#[derive(Clone)]
struct Chip {
    kind: DisplayChip,
    /// By page and segment; bit 0 is the page's topmost row.
    memory: [[u8; MORE_COLUMNS as usize]; PAGES as usize],
    settings: Settings,
    /// A command with incomplete arguments.
    command: Vec<u8>,
}

/// The settings that a reset changes.
#[derive(Clone)]
struct Settings {
    addressing: Addressing,
    column: u8,
    page: u8,
    columns: (u8, u8),
    pages: (u8, u8),
    segments_remapped: bool,
    com_downwards: bool,
    start_line: u8,
    offset: u8,
    /// Number of driven rows.
    multiplex: u8,
    inverted: bool,
    all_on: bool,
    on: bool,
    charge_pump: bool,
}

impl Settings {
    /// After a reset ("Reset Circuit", "Command Table").
    const RESET: Settings = Settings {
        addressing: Addressing::Page,
        column: 0,
        page: 0,
        columns: (0, COLUMNS - 1),
        pages: (0, PAGES - 1),
        segments_remapped: false,
        com_downwards: false,
        start_line: 0,
        offset: 0,
        multiplex: ROWS,
        inverted: false,
        all_on: false,
        on: false,
        charge_pump: false,
    };
}

impl Chip {
    fn command(&mut self, byte: u8) {
        self.command.push(byte);
        let arguments = match self.command[0] {
            0x20 | 0x81 | 0x8d | 0xa8 | 0xd3 | 0xd5 | 0xd9 | 0xda | 0xdb => 1,
            0x21 | 0x22 | 0xa3 => 2,
            0x29 | 0x2a => 5,
            0x26 | 0x27 => 6,
            _ => 0,
        };
        if self.command.len() > arguments {
            let command = std::mem::take(&mut self.command);
            self.carry_out(command[0], &command[1..]);
        }
    }

    fn carry_out(&mut self, command: u8, arguments: &[u8]) {
        let is = &mut self.settings;
        match (command, arguments) {
            // Column of the page addressing mode.
            (0x00..=0x0f, _) => is.column = is.column & 0xf0 | command & 0x0f,
            (0x10..=0x1f, _) => {
                let column = (command & 0x0f) << 4 | is.column & 0x0f;
                is.column =
                    if self.kind == DisplayChip::Ssd1306 { column & 0x7f } else { column.min(MORE_COLUMNS - 1) };
            }
            (0x20..=0x22, _) if self.kind == DisplayChip::Sh1106 => {}
            (0x20, [mode]) => {
                is.addressing = match mode & 3 {
                    0 => Addressing::Horizontal,
                    1 => Addressing::Vertical,
                    _ => Addressing::Page,
                }
            }
            (0x21, [start, end]) => {
                is.columns = (start & 0x7f, end & 0x7f);
                is.column = is.columns.0;
            }
            (0x22, [start, end]) => {
                is.pages = (start & 7, end & 7);
                is.page = is.pages.0;
            }
            (0x40..=0x7f, _) => is.start_line = command & 0x3f,
            (0x8d, [pump]) => is.charge_pump = pump & 4 != 0,
            (0xa0 | 0xa1, _) => is.segments_remapped = command & 1 != 0,
            (0xa4 | 0xa5, _) => is.all_on = command & 1 != 0,
            (0xa6 | 0xa7, _) => is.inverted = command & 1 != 0,
            // Ratios below 16 are invalid.
            (0xa8, [ratio]) if ratio & 0x3f >= 15 => is.multiplex = (ratio & 0x3f) + 1,
            (0xae | 0xaf, _) => is.on = command & 1 != 0,
            (0xb0..=0xb7, _) => is.page = command & 7,
            (0xc0..=0xcf, _) => is.com_downwards = command & 8 != 0,
            (0xd3, [offset]) => is.offset = offset & 0x3f,
            // Contrast, scrolling, oscillator, charging, wiring, no operation.
            _ => {}
        }
    }

    fn data(&mut self, byte: u8) {
        let is = &mut self.settings;
        let columns = self.kind.columns();
        let segment = if is.segments_remapped { columns - 1 - is.column } else { is.column };
        self.memory[usize::from(is.page)][usize::from(segment)] = byte;
        let last = is.column == columns - 1;
        let after = |at: u8, (start, end): (u8, u8), count: u8| {
            if at == end { (start, true) } else { ((at + 1) % count, false) }
        };
        match is.addressing {
            Addressing::Page => is.column = if last { is.columns.0 } else { is.column + 1 },
            Addressing::Horizontal => {
                let (column, wrapped) = after(is.column, is.columns, COLUMNS);
                is.column = column;
                if wrapped {
                    is.page = after(is.page, is.pages, PAGES).0;
                }
            }
            Addressing::Vertical => {
                let (page, wrapped) = after(is.page, is.pages, PAGES);
                is.page = page;
                if wrapped {
                    is.column = after(is.column, is.columns, COLUMNS).0;
                }
            }
        }
    }

    /// Whether any pixel can light up.
    fn is_lit(&self) -> bool {
        self.settings.on && (self.settings.charge_pump || self.kind == DisplayChip::Sh1106)
    }

    /// Whether the pixel at this place is bright; the origin is the panel's upper left corner.
    fn pixel(&self, x: u8, y: u8) -> bool {
        let is = &self.settings;
        // The panel's left column is the last segment. Its first row is the last COM output.
        let margin = (self.kind.columns() - COLUMNS) / 2;
        let (segment, com) = (margin + COLUMNS - 1 - x, ROWS - 1 - y);
        let shifted = (com + is.offset) % ROWS;
        if shifted >= is.multiplex {
            return false;
        }
        let line = if is.com_downwards { is.multiplex - 1 - shifted } else { shifted };
        let row = (line + is.start_line) % ROWS;
        let stored = self.memory[usize::from(row / 8)][usize::from(segment)] >> (row % 8) & 1 != 0;
        (stored || is.all_on) != is.inverted
    }
}

impl Panel {
    fn new(name: &str, kind: DisplayChip, mut noise: Noise) -> Panel {
        let memory = std::array::from_fn(|_| std::array::from_fn(|_| (noise.draw() * 1000.0) as i64 as u8));
        Panel {
            name: name.to_owned(),
            chip: Mutex::new(Chip { kind, memory, settings: Settings::RESET, command: Vec::new() }),
            is_data: AtomicBool::new(false),
            held: AtomicBool::new(false),
            was_reset: AtomicBool::new(false),
        }
    }

    /// The chip's present state. Only workers and viewers wait here.
    fn chip(&self) -> MutexGuard<'_, Chip> {
        let mut chip = self.chip.lock().unwrap_or_else(PoisonError::into_inner);
        if self.was_reset.swap(false, Ordering::Relaxed) || self.held.load(Ordering::Relaxed) {
            chip.settings = Settings::RESET;
            chip.command.clear();
        }
        chip
    }

    /// Executes a byte, unless the chip is held in reset.
    fn take(&self, is_data: bool, byte: u8) {
        let mut chip = self.chip();
        if self.held.load(Ordering::Relaxed) {
            return;
        }
        if is_data { chip.data(byte) } else { chip.command(byte) }
    }
}

impl Sight for Panel {
    fn name(&self) -> &str {
        &self.name
    }

    fn look(&self, _now: Clock) -> Look {
        // A copy: the drawing thread may lose the processor at any time, and the bus must not wait for it.
        let chip = self.chip().clone();
        let places = (0..ROWS).flat_map(|y| (0..COLUMNS).map(move |x| (x, y)));
        Look::Pixels {
            width: COLUMNS.into(),
            height: ROWS.into(),
            is_on: chip.is_lit(),
            lit: places.map(|(x, y)| chip.pixel(x, y)).collect(),
        }
    }
}

/// The chip on I2C. A control byte says whether commands or data follow.
struct OnI2c {
    panel: Arc<Panel>,
    /// Whether the next byte is data, and whether that is valid for one byte only. `None`: a control byte comes next.
    control: Option<(bool, bool)>,
}

impl I2cChip for OnI2c {
    fn start(&mut self, _read: bool) -> bool {
        self.control = None;
        true
    }

    fn write(&mut self, byte: u8) -> bool {
        match self.control {
            // Co, D/C.
            None => self.control = Some((byte & 0x40 != 0, byte & 0x80 != 0)),
            Some((is_data, one)) => {
                self.panel.take(is_data, byte);
                if one {
                    self.control = None;
                }
            }
        }
        true
    }

    /// The status: bit 6 is set while the display is off.
    fn read(&mut self) -> u8 {
        u8::from(!self.panel.chip().settings.on) << 6
    }
}

/// The chip on SPI with four wires. It never answers.
struct OnSpi(Arc<Panel>);

impl SpiChip for OnSpi {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == 0 || mode == 3
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.0.take(self.0.is_data.load(Ordering::Relaxed), byte);
        0xff
    }
}

/// D/C.
fn mode_pin(panel: Arc<Panel>) -> impl Wire {
    output(format!("D/C of {}", panel.name), move |on, _| panel.is_data.store(on, Ordering::Relaxed))
}

/// The reset line.
fn reset_pin(panel: Arc<Panel>) -> impl Wire {
    output(format!("reset of {}", panel.name), move |on, _| {
        panel.held.store(!on, Ordering::Relaxed);
        if !on {
            panel.was_reset.store(true, Ordering::Relaxed);
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Bench {
        panel: Arc<Panel>,
        i2c: OnI2c,
    }

    /// The first commands that a module's maker recommends.
    const START: &[u8] =
        &[0x00, 0xae, 0xa8, 0x3f, 0xd3, 0, 0x40, 0x8d, 0x14, 0x20, 0, 0xa1, 0xc8, 0xda, 0x12, 0xa4, 0xa6, 0xaf];

    impl Bench {
        fn new() -> Bench {
            Bench::of(DisplayChip::Ssd1306)
        }

        fn of(chip: DisplayChip) -> Bench {
            let panel = Arc::new(Panel::new("display", chip, Noise::of("display", 1)));
            Bench { i2c: OnI2c { panel: panel.clone(), control: None }, panel }
        }

        /// Configured and cleared, with the pointer at the start.
        fn started() -> Bench {
            let mut bench = Bench::new();
            bench.write(START);
            bench.write(&[&[0x40][..], &[0; 1024]].concat());
            bench
        }

        fn write(&mut self, bytes: &[u8]) {
            assert!(self.i2c.start(false) && bytes.iter().all(|byte| self.i2c.write(*byte)));
            self.i2c.stop();
        }

        fn bright(&self) -> Vec<(u8, u8)> {
            let chip = self.panel.chip();
            let places = (0..ROWS).flat_map(|y| (0..COLUMNS).map(move |x| (x, y)));
            places.filter(|(x, y)| chip.pixel(*x, *y)).collect()
        }

        fn look(&self) -> String {
            self.panel.look(Clock::from_ticks(0)).to_string()
        }
    }

    #[test]
    fn it_is_dark_until_it_is_on_and_shows_noise_before_it_is_cleared() {
        let mut bench = Bench::new();
        assert_eq!((bench.look().as_str(), bench.i2c.read()), ("dark", 0x40));
        bench.write(&[0x00, 0xaf]);
        assert_eq!((bench.look().as_str(), bench.i2c.read()), ("dark", 0), "without the charge pump");
        bench.write(START);
        assert!((2000..6000).contains(&bench.bright().len()), "{}", bench.bright().len());
        let bench = Bench::started();
        assert_eq!(bench.look().chars().filter(|c| *c == '\u{2800}').count(), 64 * 16);
    }

    #[test]
    fn upright_with_remapped_segments_and_com_outputs() {
        let mut bench = Bench::started();
        bench.write(&[0x40, 0x01, 0x80]);
        assert_eq!(bench.bright(), [(0, 0), (1, 7)]);
        let look = bench.look();
        let characters: Vec<char> = look.chars().collect();
        assert_eq!((characters[0], characters[65]), ('\u{2801}', '\u{2880}'));
        // A reversed scan of the COM outputs acts at once. Remapped segments affect only data written afterwards.
        bench.write(&[0x00, 0xc0, 0xa0]);
        assert_eq!(bench.bright(), [(1, 56), (0, 63)]);
        bench.write(&[0x00, 0xc8]);
        bench.write(&[0x40, 0x01]);
        assert_eq!(bench.bright(), [(0, 0), (125, 0), (1, 7)]);
    }

    #[test]
    fn an_sh1106_shows_its_middle_columns() {
        let mut bench = Bench::of(DisplayChip::Sh1106);
        // As klippy does it: by pages, each with all columns.
        bench.write(&[0x00, 0xa1, 0xc8, 0xda, 0x12, 0xa4, 0xa6, 0xaf]);
        for page in 0..PAGES {
            bench.write(&[0x00, 0xb0 | page, 0x10, 0x00]);
            bench.write(&[&[0x40][..], &[0; MORE_COLUMNS as usize]].concat());
        }
        assert_eq!(bench.bright(), []);
        for (column, x) in [(2, 0), (129, 127)] {
            bench.write(&[0x00, 0xb0, 0x10 | column >> 4, column & 0x0f]);
            bench.write(&[0x40, 1]);
            assert!(bench.bright().contains(&(x, 0)), "{column}: {:?}", bench.bright());
        }
        // The outer columns have no place on the panel.
        for column in [0, 1, 130, 131] {
            bench.write(&[0x00, 0xb0, 0x10 | column >> 4, column & 0x0f]);
            bench.write(&[0x40, 1]);
        }
        assert_eq!(bench.bright(), [(0, 0), (127, 0)]);
    }

    #[test]
    fn addressing_modes_and_windows() {
        let mut bench = Bench::started();
        // Horizontal, in a window of two columns and two pages. The data fills it and wraps around.
        bench.write(&[0x00, 0x21, 10, 11, 0x22, 2, 3]);
        bench.write(&[0x40, 1, 1, 1, 1, 2]);
        assert_eq!(bench.bright(), [(11, 16), (10, 17), (10, 24), (11, 24)]);
        let mut bench = Bench::started();
        bench.write(&[0x00, 0x20, 1, 0x21, 10, 11, 0x22, 2, 3]);
        bench.write(&[0x40, 1, 2, 4]);
        assert_eq!(bench.bright(), [(10, 16), (11, 18), (10, 25)]);
        // By pages: column 0x7f, and from there to the first column of the same page.
        let mut bench = Bench::started();
        bench.write(&[0x00, 0x20, 2, 0xb5, 0x0f, 0x17]);
        bench.write(&[0x40, 1, 2]);
        assert_eq!(bench.bright(), [(127, 40), (0, 41)]);
    }

    #[test]
    fn control_bytes_may_hold_for_one_byte_and_arguments_may_come_later() {
        let mut bench = Bench::started();
        bench.write(&[0x80, 0xb3, 0x80, 0x20]);
        bench.write(&[0x80, 0x02, 0xc0, 0x10, 0x40, 0x20]);
        assert_eq!(bench.bright(), [(0, 28), (1, 29)]);
    }

    #[test]
    fn lines_are_moved_left_out_inverted_and_all_lit() {
        let mut bench = Bench::started();
        bench.write(&[0x40, 0x01]);
        // Data sheet, "Set Display Start Line", "Set Display Offset".
        bench.write(&[0x00, 0x40 | 60]);
        assert_eq!(bench.bright(), [(0, 4)]);
        bench.write(&[0x00, 0x40, 0xd3, 10]);
        assert_eq!(bench.bright(), [(0, 10)]);
        bench.write(&[0x00, 0xd3, 0, 0xa8, 31]);
        assert_eq!(bench.bright(), [(0, 32)], "the upper half of the panel is not driven");
        bench.write(&[0x00, 0xa8, 63, 0xa7]);
        assert_eq!(bench.bright().len(), 128 * 64 - 1);
        bench.write(&[0x00, 0xa6, 0xa5]);
        assert_eq!(bench.bright().len(), 128 * 64);
        // The arguments of a scroll are not commands.
        bench.write(&[0x00, 0xa4, 0x26, 0xae, 0xae, 0xae, 0xae, 0xae, 0xae, 0x2e]);
        assert_eq!(bench.bright(), [(0, 0)]);
    }

    #[test]
    fn on_spi_a_line_separates_commands_from_data_and_the_reset_line_resets() {
        let mut bench = Bench::started();
        let at = Clock::from_ticks(0);
        let mut spi = OnSpi(bench.panel.clone());
        mode_pin(bench.panel.clone()).drive(false, at);
        for byte in [0xb1, 0x20, 2] {
            spi.exchange(byte);
        }
        mode_pin(bench.panel.clone()).drive(true, at);
        spi.exchange(0xb1);
        assert_eq!(bench.bright(), [(0, 8), (0, 12), (0, 13), (0, 15)]);
        let reset = reset_pin(bench.panel.clone());
        reset.drive(false, at);
        bench.write(START);
        assert_eq!(bench.look(), "dark", "held in its reset");
        reset.drive(true, at);
        assert_eq!(bench.look(), "dark");
        bench.write(START);
        assert_eq!(bench.bright(), [(0, 8), (0, 12), (0, 13), (0, 15)], "the memory stays");
    }
}
