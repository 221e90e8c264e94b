// SPDX-License-Identifier: GPL-3.0-or-later
//! The interface between a part and the rest of the printer, and the place where the printer is assembled.

use std::sync::{Arc, Mutex, PoisonError};

use super::uart::{PortUart, Role, Selected, Uart, UartChip, UartPin};
use crate::description::check::Trouble;
use crate::description::pin::PinName;
use crate::description::printer::{Kinematics, Printer};
use crate::engine::bed::{Bed, BedShape, Hanging, Head, Plane};
use crate::engine::dock::Dock;
use crate::engine::i2c::{I2cBus, I2cChip};
use crate::engine::motion::Axis;
use crate::engine::noise::Noise;
use crate::engine::physics::Heater;
use crate::engine::rail::Rail;
use crate::engine::serial::{SerialChip, SerialWire};
use crate::engine::spi::{MosiListener, SpiBus, SpiChip};
use crate::engine::wire::{ControllerPin, Kind, LevelLine, Wire, WiredPin};
use crate::engine::world::{Sight, World};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::TimeSource;

/// A part's connection to a bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Socket<'a> {
    /// A chip on an SPI bus. Low on the pin selects it. Without a pin it is the only chip there.
    Spi { bus: &'a str, select_pin: Option<&'a PinName> },
    /// A chip on an I2C bus.
    I2c { bus: &'a str, address: u8 },
    /// A listener on the data output of an SPI bus alone.
    Mosi { bus: &'a str },
    /// A chip on the wire of a serial port. The port is there because a chip names it.
    Serial { port: &'a PinName, address: u8 },
}

/// A part's description.
pub(crate) trait Part {
    /// Its name for people. No other part has this name.
    fn name(&self) -> String;

    /// Its bus, if it is a chip on one.
    fn socket(&self) -> Option<Socket<'_>> {
        None
    }

    /// The pins of UARTs by their keys. Several chips with a UART may share them.
    fn uart_pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        Vec::new()
    }

    /// Its place in a chain of chips at its select pin, counted from 0, and the chain's length.
    fn chain(&self) -> Option<(usize, usize)> {
        None
    }

    /// The lines that connect its UART, each at its level. Several chips may share a line.
    fn select_pins(&self) -> &[PinName] {
        &[]
    }

    /// The pins of its wires by their keys, without the pin that selects it on its bus.
    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        Vec::new()
    }

    /// Checks the part's own values. `whose` begins an error's line.
    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        let _ = (whose, printer);
        Ok(())
    }

    /// Makes the part and wires it. It is called only after `validate` has accepted the part.
    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble>;

    /// Adds its sections, if klippy has sections for it.
    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        let _ = (cfg, layout);
    }
}

/// The place where a printer is assembled.
pub(crate) struct Workshop<'a> {
    pub(crate) printer: Printer<'a>,
    pub(crate) clock: Arc<dyn TimeSource>,
    pub(crate) world: World,
    pub(crate) pins: Vec<WiredPin>,
    pub(crate) spi_buses: Vec<SpiBus>,
    pub(crate) i2c_buses: Vec<I2cBus>,
    pub(crate) serial_wires: Vec<SerialWire>,
    /// The lines that connect UARTs, by their names.
    pub(crate) levels: Vec<(String, Arc<LevelLine>)>,
    /// The wires of UARTs on lines, by the name of the line.
    pub(crate) uarts: Vec<(String, Arc<Mutex<Uart>>)>,
}

impl Workshop<'_> {
    /// An axis by its name; `None` if there is no such axis.
    pub(crate) fn axis(&self, name: &str) -> Option<Arc<Axis>> {
        self.world.axes.iter().find(|axis| axis.name == name).cloned()
    }

    /// A heater by its name; `None` if there is no such heater.
    pub(crate) fn heater(&self, name: &str) -> Option<Arc<Heater>> {
        self.world.heaters.iter().find(|heater| heater.name == name).cloned()
    }

    /// A part's noise.
    pub(crate) fn noise(&self, part: &dyn Part) -> Noise {
        Noise::of(&part.name(), self.printer.seed)
    }

    /// A rail by its name: a carriage, or the rail of an axis.
    pub(crate) fn rail(&self, name: &str) -> Option<Arc<Rail>> {
        let carriage = self.world.carriages.iter().find(|rail| rail.name == name).cloned();
        carriage.or_else(|| self.axis(name).map(|axis| axis.rail().clone()))
    }

    /// The bed under the nozzle.
    pub(crate) fn bed(&self) -> Bed {
        Bed::new(self.printer.bed.clone(), self.hanging().map_or_else(|| self.gantry(), Head::Hanging))
    }

    /// The head of a printer without a gantry.
    fn hanging(&self) -> Option<Hanging> {
        let disc = |radius_mm| BedShape::Disc { radius_mm };
        let kinematics = self.printer.kinematics();
        let rails: Vec<Arc<Rail>> = kinematics.rails().iter().filter_map(|name| self.rail(name)).collect();
        let end_mm = |rail: usize| rails.get(rail).and_then(|rail| rail.travel_mm).unwrap_or_default();
        let bed = match kinematics {
            Kinematics::Delta(delta) => disc(delta.bed_radius_mm),
            Kinematics::RotaryDelta(rotary) => disc(rotary.bed_radius_mm),
            Kinematics::Polar => disc(end_mm(1).1),
            Kinematics::Winch(winch) => disc(winch.bed_radius_mm),
            Kinematics::Deltesian(deltesian) => {
                let (front_mm, back_mm) = end_mm(2);
                let [left_mm, right_mm] = deltesian.arm_x_mm;
                BedShape::Rectangle { min_mm: [-left_mm, front_mm], max_mm: [right_mm, back_mm] }
            }
            _ => return None,
        };
        let linkage = kinematics.linkage()?;
        Some(Hanging::new(linkage, rails, bed))
    }

    /// The head of any other printer.
    fn gantry(&self) -> Head {
        let placed = self.printer.axes.iter().filter(|motor| motor.at_mm.is_some());
        let placed = placed.filter_map(|motor| Some((self.axis(&motor.name)?.rail().clone(), motor.at_mm?)));
        let mut z: Vec<_> = placed.collect();
        if z.is_empty() {
            let motors = self.printer.motors("z").map(|motor| motor.name.as_str());
            let names =
                motors.chain(self.world.carriages.iter().map(|rail| rail.name.as_str()).filter(|name| *name == "z"));
            z.extend(names.filter_map(|name| self.rail(name)).map(|rail| (rail, [0.0; 2])));
        }
        Head::Cartesian { x: self.rail("x"), y: self.rail("y"), z: Plane::new(z) }
    }

    /// Has the head look at a dock where it passes.
    pub(crate) fn head_passes(&self, dock: &Arc<Dock>) {
        let motors = ["x", "y"].into_iter().flat_map(|rail| self.printer.motors(rail));
        motors.filter_map(|motor| self.axis(&motor.name)).for_each(|axis| axis.passes(dock.clone()));
    }

    /// Wires a pin, if the part has it.
    pub(crate) fn wire(&mut self, pin: Option<&PinName>, wire: impl Wire + 'static) {
        self.wire_shared(pin, Arc::new(wire));
    }

    /// Wires a pin, if the part has it, to an object that the part itself also reads.
    pub(crate) fn wire_shared(&mut self, pin: Option<&PinName>, wire: Arc<dyn Wire>) {
        self.pins.extend(pin.map(|pin| WiredPin::new(pin, wire)));
    }

    /// Puts a chip on its SPI bus.
    pub(crate) fn solder_spi(&mut self, part: &dyn Part, chip: impl SpiChip + 'static) {
        let Some(Socket::Spi { bus, select_pin }) = part.socket() else { return };
        if let (Some(place), Some(pin)) = (part.chain(), select_pin) {
            let name = format!("chain at {}", pin.name);
            let Some(bus) = self.spi_buses.iter_mut().find(|other| other.name == bus) else { return };
            if let Some(line) = bus.solder_in_chain(&name, place, Box::new(chip)) {
                self.wire_shared(Some(pin), line);
            }
            return;
        }
        let select = select_pin.map(|_| Arc::new(LevelLine::chip_select(&part.name())));
        if let Some(line) = &select {
            self.pins.extend(select_pin.map(|pin| WiredPin::new(pin, line.clone())));
        }
        if let Some(bus) = self.spi_buses.iter_mut().find(|other| other.name == bus) {
            bus.solder(part.name(), select, Box::new(chip));
        }
    }

    /// The levels of the lines that connect a part's UART, and the levels at which they do.
    pub(crate) fn selected_by(&mut self, part: &dyn Part) -> Vec<(Arc<LevelLine>, bool)> {
        let mut lines = Vec::new();
        for pin in part.select_pins() {
            let known = self.levels.iter().find(|(name, _)| *name == pin.name).map(|(_, line)| line.clone());
            let line = known.unwrap_or_else(|| {
                let line = Arc::new(LevelLine::uart_select());
                self.levels.push((pin.name.clone(), line.clone()));
                self.wire_shared(Some(&PinName { name: pin.name.clone(), inverted: false }), line.clone());
                line
            });
            lines.push((line, !pin.inverted));
        }
        lines
    }

    /// Puts a part on the data output of its SPI bus.
    pub(crate) fn listen(&mut self, part: &dyn Part, listener: impl MosiListener + 'static) {
        let Some(Socket::Mosi { bus }) = part.socket() else { return };
        if let Some(bus) = self.spi_buses.iter_mut().find(|other| other.name == bus) {
            bus.listen(Box::new(listener));
        }
    }

    /// Puts a chip on the wire of its serial port.
    pub(crate) fn solder_serial(&mut self, part: &dyn Part, chip: impl SerialChip + 'static) {
        let Some(Socket::Serial { port, .. }) = part.socket() else { return };
        let known = self.serial_wires.iter().position(|wire| wire.name == port.name);
        let place = known.unwrap_or_else(|| {
            self.wire(Some(port), ControllerPin { kind: Kind::Serial, of: port.name.clone() });
            self.serial_wires.push(SerialWire::new(&port.name));
            self.serial_wires.len() - 1
        });
        self.serial_wires[place].solder(Box::new(chip));
    }

    /// Puts a chip on its I2C bus.
    pub(crate) fn solder_i2c(&mut self, part: &dyn Part, chip: impl I2cChip + 'static) {
        let Some(Socket::I2c { bus, address }) = part.socket() else { return };
        if let Some(bus) = self.i2c_buses.iter_mut().find(|other| other.name == bus) {
            bus.solder(part.name(), address, Box::new(chip));
        }
    }

    /// Puts a chip on the wire of its UART: lines, or a serial port. Chips with the same `uart_pin` share the wire.
    pub(crate) fn solder_uart(&mut self, part: &dyn Part, chip: impl UartChip + 'static) {
        let chip = Box::new(Selected { chip, by: self.selected_by(part) });
        if let Some(Socket::Serial { .. }) = part.socket() {
            return self.solder_serial(part, PortUart(chip));
        }
        let pins = part.uart_pins();
        let pin = |key: &str| pins.iter().find(|(known, _)| *known == key).and_then(|(_, pin)| *pin);
        let (uart_pin, tx_pin) = (pin("uart_pin"), pin("tx_pin"));
        let line = uart_pin.map_or("", |pin| &pin.name);
        if let Some((_, uart)) = self.uarts.iter().find(|(name, _)| name == line) {
            return uart.lock().unwrap_or_else(PoisonError::into_inner).solder(chip);
        }
        let uart = Arc::new(Mutex::new(Uart::new(chip)));
        self.uarts.push((line.to_owned(), uart.clone()));
        let end = |role| UartPin { name: part.name(), role, uart: uart.clone() };
        match tx_pin {
            None => self.wire(uart_pin, end(Role::Both)),
            Some(_) => {
                self.wire(uart_pin, end(Role::Receiver));
                self.wire(tx_pin, end(Role::Sender));
            }
        }
    }

    /// Shows the part to a person.
    pub(crate) fn show(&mut self, sight: Arc<dyn Sight>) {
        self.world.sights.push(sight);
    }
}
