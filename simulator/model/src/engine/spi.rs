// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer's SPI buses: the chips, their chip selects, and a record of the transfers, as a logic analyzer
//! would make it.

use std::fmt::Write as _;
use std::fs::File;
use std::io::Write as _;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use super::physics::Lamp;
use super::wire::LevelLine;
use crate::description::buses::SpiBusConfig;
use pinion_firmware::board::{BusDevice, BusError, BusStatus, ChipSelect};
use pinion_firmware::trouble::Trouble;

/// A chip as its data sheet describes it. The calls come in the order of the signals: selected, bytes, deselected.
pub(crate) trait SpiChip: Send {
    /// Whether the chip works in this SPI mode (0 to 3). In any other mode the chip does not answer.
    fn knows_mode(&self, mode: u8) -> bool;

    /// The chip is selected; the bus's clock has this rate.
    fn select(&mut self, rate_hz: u32) {
        let _ = rate_hz;
    }

    /// Takes a byte in, and returns the byte that leaves the chip at the same time.
    fn exchange(&mut self, byte: u8) -> u8;

    /// The chip is no longer selected. Many chips act only now.
    fn deselect(&mut self) {}
}

/// A listener on a bus's data output (MOSI) alone. Without clock and chip select it hears everything that is sent on
/// the bus.
pub(crate) trait MosiListener: Send {
    /// The output sends these bytes, the highest bit first, at this bit rate. Then it stays at the level of the last
    /// bit.
    fn hear(&mut self, rate_hz: u32, bytes: &[u8]);
}

/// The end of the name of a bus's data input as a pin.
pub(crate) const MISO: &str = "/miso";

/// A chip's place on its bus, or that of a chain of chips.
struct Socket {
    name: String,
    /// `None` for the only chip of a bus, which is always selected.
    select: Option<Arc<LevelLine>>,
    /// In a chain each chip gets the bytes that leave the one before it.
    chips: Vec<Box<dyn SpiChip>>,
}

impl Socket {
    fn knows_mode(&self, mode: u8) -> bool {
        self.chips.iter().all(|chip| chip.knows_mode(mode))
    }

    fn select(&mut self, rate_hz: u32) {
        self.chips.iter_mut().for_each(|chip| chip.select(rate_hz));
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.chips.iter_mut().fold(byte, |byte, chip| chip.exchange(byte))
    }

    fn deselect(&mut self) {
        self.chips.iter_mut().for_each(|chip| chip.deselect());
    }
}

/// The shift register of a chip: the answer leaves it while a message comes in.
pub(crate) struct ShiftRegister<const BYTES: usize> {
    bytes: [u8; BYTES],
    /// Number of bytes since the chip was selected.
    pub(crate) count: usize,
}

impl<const BYTES: usize> ShiftRegister<BYTES> {
    /// A message begins, and this is the answer.
    pub(crate) fn load(answer: [u8; BYTES]) -> ShiftRegister<BYTES> {
        ShiftRegister { bytes: answer, count: 0 }
    }

    /// The message: the last bytes of a longer one. `None` if it is shorter.
    pub(crate) fn message(&self) -> Option<[u8; BYTES]> {
        (self.count >= BYTES).then_some(self.bytes)
    }
}

/// A chip of a chain without a description has only this.
impl<const BYTES: usize> SpiChip for ShiftRegister<BYTES> {
    fn knows_mode(&self, _mode: u8) -> bool {
        true
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.count += 1;
        self.bytes.rotate_left(1);
        std::mem::replace(&mut self.bytes[BYTES - 1], byte)
    }
}

/// A record of transfers, one line each.
struct Trace {
    /// The name of the bus.
    bus: String,
    /// All buses write into one file, in the order of their transfers.
    file: Option<Arc<File>>,
    /// Outputs with levels that are recorded at each byte.
    pins: Vec<(String, Arc<Lamp>, bool)>,
}

impl Trace {
    fn record(&self, chips: &[&mut Socket], sent: &[u8], received: &[u8], levels: &[String]) -> Result<(), BusError> {
        let Some(mut file) = self.file.as_deref() else { return Ok(()) };
        let names: Vec<&str> = chips.iter().map(|socket| socket.name.as_str()).collect();
        let mut line = format!("bus={} chips={}", self.bus, names.join("+"));
        for (key, bytes) in [("sent", sent), ("received", received)] {
            line += &format!(" {key}=");
            for byte in bytes {
                // Writing to a String cannot fail.
                let _ = write!(line, "{byte:02x}");
            }
        }
        for ((name, ..), levels) in self.pins.iter().zip(levels) {
            line += &format!(" {name}={levels}");
        }
        line.push('\n');
        // In one write, so that a reader never sees half a line.
        file.write_all(line.as_bytes()).map_err(|error| {
            let trouble = Trouble::new(format!("the record of the SPI transfers cannot be written: {error}"));
            BusError::new(BusStatus::Nack, trouble.remedy("free space, or choose another file"))
        })
    }
}

struct Wires {
    sockets: Vec<Socket>,
    listeners: Vec<Box<dyn MosiListener>>,
    trace: Trace,
}

pub(crate) struct SpiBus {
    /// As in the dictionary.
    pub(crate) name: String,
    delay: Duration,
    /// One transfer at a time, as on any bus. Only workers wait here.
    wires: Mutex<Wires>,
}

impl SpiBus {
    /// The bus of a description, without chips. `lamp` finds the output of a pin.
    pub(crate) fn new(config: &SpiBusConfig, lamp: impl Fn(&str) -> Option<(Arc<Lamp>, bool)>) -> SpiBus {
        let pins = config.trace_pins.iter();
        let pins = pins.filter_map(|name| lamp(name).map(|(lamp, inverted)| (name.clone(), lamp, inverted)));
        let trace = Trace { bus: config.name.clone(), file: None, pins: pins.collect() };
        let wires = Mutex::new(Wires { sockets: Vec::new(), listeners: Vec::new(), trace });
        SpiBus { name: config.name.clone(), delay: Duration::from_micros(config.delay_us), wires }
    }

    /// Writes a line for each transfer into this file from now on.
    pub(crate) fn record_to(&self, file: Arc<File>) {
        self.wires.lock().unwrap_or_else(PoisonError::into_inner).trace.file = Some(file);
    }

    /// Puts a chip on the bus.
    pub(crate) fn solder(&mut self, name: String, select: Option<Arc<LevelLine>>, chip: Box<dyn SpiChip>) {
        let wires = self.wires.get_mut().unwrap_or_else(PoisonError::into_inner);
        wires.sockets.push(Socket { name, select, chips: vec![chip] });
    }

    /// Puts a chip at a place of the chain with this name, counted from 0. Returns the select line of a new chain.
    pub(crate) fn solder_in_chain(
        &mut self,
        name: &str,
        (place, length): (usize, usize),
        chip: Box<dyn SpiChip>,
    ) -> Option<Arc<LevelLine>> {
        let wires = self.wires.get_mut().unwrap_or_else(PoisonError::into_inner);
        let known = wires.sockets.iter().position(|socket| socket.name == name);
        let new = known.is_none().then(|| Arc::new(LevelLine::chip_select(name)));
        let at = known.unwrap_or(wires.sockets.len());
        if new.is_some() {
            wires.sockets.push(Socket { name: name.to_owned(), select: new.clone(), chips: Vec::new() });
        }
        let chips = &mut wires.sockets[at].chips;
        while chips.len() < length {
            chips.push(Box::new(ShiftRegister::load([0; 5])));
        }
        chips[place] = chip;
        new
    }

    /// Puts a listener on the data output alone.
    pub(crate) fn listen(&mut self, listener: Box<dyn MosiListener>) {
        self.wires.get_mut().unwrap_or_else(PoisonError::into_inner).listeners.push(listener);
    }

    /// One transfer with all selected chips.
    fn transfer(&self, mode: u8, rate_hz: u32, bytes: &mut [u8]) -> Result<(), BusError> {
        let mut wires = self.wires.lock().unwrap_or_else(PoisonError::into_inner);
        let Wires { sockets, listeners, trace } = &mut *wires;
        let is_selected = |socket: &Socket| socket.select.as_ref().is_none_or(|line| !line.is_high());
        let mut chips: Vec<&mut Socket> =
            sockets.iter_mut().filter(|socket| is_selected(socket) && socket.knows_mode(mode)).collect();
        let sent = bytes.to_vec();
        let mut levels = vec![String::new(); trace.pins.len()];
        let pace = Pace { start: Instant::now(), delay: self.delay, bytes: bytes.len() };
        chips.iter_mut().for_each(|socket| socket.select(rate_hz));
        for (n, byte) in bytes.iter_mut().enumerate() {
            pace.wait(n + 1);
            for ((_, lamp, inverted), levels) in trace.pins.iter().zip(&mut levels) {
                levels.push(if lamp.is_on() != *inverted { '1' } else { '0' });
            }
            // An undriven wire is pulled up. A chip that drives it low wins.
            *byte = chips.iter_mut().fold(0xff, |wire, socket| wire & socket.exchange(*byte));
        }
        pace.wait(pace.bytes);
        chips.iter_mut().for_each(|socket| socket.deselect());
        listeners.iter_mut().for_each(|listener| listener.hear(rate_hz, &sent));
        trace.record(&chips, &sent, bytes, &levels)
    }
}

/// Spreads the bytes of a transfer over its time.
struct Pace {
    start: Instant,
    delay: Duration,
    bytes: usize,
}

impl Pace {
    /// Waits until this number of bytes is over.
    fn wait(&self, over: usize) {
        let share = over as f64 / self.bytes.max(1) as f64;
        let share = if self.bytes == 0 { 1.0 } else { share };
        thread::sleep(self.delay.mul_f64(share).saturating_sub(self.start.elapsed()));
    }
}

/// The MCU's end: one bus device on this bus.
pub(crate) struct SpiDevice {
    pub(crate) bus: Arc<SpiBus>,
    pub(crate) mode: u8,
    pub(crate) rate_hz: u32,
    pub(crate) chip_select: Option<ChipSelect>,
}

impl SpiDevice {
    fn select(&self, selected: bool) -> Result<(), BusError> {
        let chip_select = self.chip_select.as_ref();
        let driven = chip_select.map_or(Ok(()), |chip_select| chip_select.select(selected));
        driven.map_err(BusError::from)
    }
}

impl BusDevice for SpiDevice {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        self.select(true)?;
        let exchanged = self.bus.transfer(self.mode, self.rate_hz, bytes);
        self.select(false).and(exchanged)
    }
}
