// SPDX-License-Identifier: GPL-3.0-or-later
//! The interface between a part and the rest of the printer, and the place where the printer is assembled.

#![forbid(unsafe_code)]

use std::sync::Arc;

use crate::description::axes::DeltaConfig;
use crate::description::check::Trouble;
use crate::description::pin::PinName;
use crate::description::printer::{Kinematics, Printer};
use crate::engine::bed::{Bed, Delta, Head, Plane};
use crate::engine::i2c::{I2cBus, I2cChip};
use crate::engine::noise::Noise;
use crate::engine::physics::{Axis, Heater};
use crate::engine::serial::{SerialChip, SerialWire};
use crate::engine::spi::{MosiListener, SelectLine, SpiBus, SpiChip};
use crate::engine::wire::{ControllerPin, Kind, Wire, WiredPin};
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

    /// The bed under the nozzle.
    pub(crate) fn bed(&self) -> Bed {
        Bed::new(self.printer.bed.clone(), self.delta().map_or_else(|| self.gantry(), Head::Delta))
    }

    /// The three arms of a delta printer.
    fn delta(&self) -> Option<Delta> {
        let Kinematics::Delta(delta) = self.printer.kinematics() else { return None };
        let [a, b, c] = DeltaConfig::TOWERS.map(|tower| self.axis(tower));
        Some(Delta::new(delta, [a?, b?, c?]))
    }

    /// The head of any other printer.
    fn gantry(&self) -> Head {
        let motors = self.printer.motors("z").filter_map(|motor| {
            let at_mm = motor.at_mm.unwrap_or_default();
            self.axis(&motor.name).map(|axis| (axis, at_mm))
        });
        Head::Cartesian { x: self.axis("x"), y: self.axis("y"), z: Plane::new(motors.collect()) }
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
        let select = select_pin.map(|_| Arc::new(SelectLine::new(&part.name())));
        if let Some(line) = &select {
            self.pins.extend(select_pin.map(|pin| WiredPin::new(pin, line.clone())));
        }
        if let Some(bus) = self.spi_buses.iter_mut().find(|other| other.name == bus) {
            bus.solder(part.name(), select, Box::new(chip));
        }
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

    /// Shows the part to a person.
    pub(crate) fn show(&mut self, sight: Arc<dyn Sight>) {
        self.world.sights.push(sight);
    }
}
