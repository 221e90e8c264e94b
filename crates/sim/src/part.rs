// SPDX-License-Identifier: GPL-3.0-or-later
//! The parts of the printer that stand in files of their own, each with its description, its wires,
//! its behaviour and its sections of printer.cfg.

#![forbid(unsafe_code)]

use std::sync::Arc;

use serde::Deserialize;

use super::World;
use super::bed::{Bed, Delta, Head, Plane};
use super::config::{DeltaConfig, Kinematics, PinName, SimConfig, SimError};
use super::i2c::{I2cBus, I2cChip};
use super::physics::{Axis, Heater, Noise};
use super::printer_cfg::{Layout, Sections};
use super::spi::{MosiListener, SelectLine, SpiBus, SpiChip};
use super::time::PrinterTime;
use super::wire::{Wire, WiredPin};
use super::{
    ads1220, adxl345, angle, apa102, bltouch, ds18b20, hx71x, ldc1612, loopback, probe, pwm_channel, servo, spool,
    ssd1306, thermocouple, tmc2209, tmc5160, ws2812,
};
use pinion_firmware::time::Clock;

/// A part as the description has it: a `[[part]]`, whose key `kind` tells which of these it is.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum PartConfig {
    /// An accelerometer.
    Adxl345(adxl345::Adxl345Config),
    /// A thermometer on the one-wire bus.
    Ds18b20(ds18b20::Ds18b20Config),
    /// A hardware PWM channel.
    #[serde(rename = "pwm_channel")]
    PwmChannel(pwm_channel::PwmChannelConfig),
    /// Sends back what it is sent.
    Loopback(loopback::LoopbackConfig),
    /// A servo.
    Servo(servo::ServoConfig),
    /// Filament and its sensors.
    Spool(spool::SpoolConfig),
    /// An angle sensor on a motor's shaft.
    #[serde(rename = "angle_sensor")]
    Angle(angle::AngleConfig),
    /// A stepper driver on a UART.
    Tmc2209(tmc2209::Tmc2209Config),
    /// A stepper driver.
    Tmc5160(tmc5160::Tmc5160Config),
    /// A strip of lights on an SPI bus's data output.
    Ws2812(ws2812::Ws2812Config),
    /// A strip of lights on two lines.
    Apa102(apa102::Apa102Config),
    /// A display.
    Ssd1306(ssd1306::Ssd1306Config),
    /// A thermocouple's or a platinum resistor's converter.
    Thermocouple(thermocouple::ThermocoupleConfig),
    /// A switch beside the nozzle.
    Probe(probe::ProbeConfig),
    /// A probe with a push-pin.
    Bltouch(bltouch::BltouchConfig),
    /// The ADC of a load cell.
    Hx71x(hx71x::Hx71xConfig),
    /// Another ADC of a load cell.
    Ads1220(ads1220::Ads1220Config),
    /// A coil over the bed.
    Ldc1612(ldc1612::Ldc1612Config),
}

impl PartConfig {
    /// What all of them can do.
    pub(super) fn part(&self) -> &dyn Part {
        match self {
            PartConfig::Adxl345(config) => config,
            PartConfig::Ds18b20(config) => config,
            PartConfig::PwmChannel(config) => config,
            PartConfig::Loopback(config) => config,
            PartConfig::Servo(config) => config,
            PartConfig::Spool(config) => config,
            PartConfig::Angle(config) => config,
            PartConfig::Tmc2209(config) => config,
            PartConfig::Tmc5160(config) => config,
            PartConfig::Ws2812(config) => config,
            PartConfig::Apa102(config) => config,
            PartConfig::Ssd1306(config) => config,
            PartConfig::Thermocouple(config) => config,
            PartConfig::Probe(config) => config,
            PartConfig::Bltouch(config) => config,
            PartConfig::Hx71x(config) => config,
            PartConfig::Ads1220(config) => config,
            PartConfig::Ldc1612(config) => config,
        }
    }
}

/// Where a part hangs on a bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Socket<'a> {
    /// A chip on an SPI bus: low on the pin selects it; without a pin it is the only chip there.
    Spi { bus: &'a str, select_pin: Option<&'a PinName> },
    /// A chip on an I2C bus.
    I2c { bus: &'a str, address: u8 },
    /// Something on the data output of an SPI bus alone.
    Mosi { bus: &'a str },
}

/// A part's description.
pub(super) trait Part {
    /// Its name for people, which no other part has.
    fn name(&self) -> String;

    /// Its bus, if it is a chip on one.
    fn socket(&self) -> Option<Socket<'_>> {
        None
    }

    /// The pins that it is wired to by their keys, but for the one that selects it on its bus.
    fn pins(&self) -> Vec<(&'static str, Option<&PinName>)> {
        Vec::new()
    }

    /// Checks the values that are its own; `whose` begins an error's line.
    fn validate(&self, whose: &str, printer: &SimConfig) -> Result<(), SimError> {
        let _ = (whose, printer);
        Ok(())
    }

    /// Makes the part and wires it. What `validate` refuses does not come here.
    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), SimError>;

    /// Adds its sections, if klippy has one.
    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        let _ = (cfg, layout);
    }
}

/// What a person would see of a part.
pub(super) trait Sight: Send + Sync {
    /// Whose sight it is.
    fn name(&self) -> &str;

    /// What is to be seen at this instant: a line, or several for a picture. A colour is written as
    /// `#rrggbb`, and `pinion sim --show` paints it where it can.
    fn look(&self, now: Clock) -> String;
}

/// Where a printer is put together.
pub(super) struct Workshop<'a> {
    pub(super) config: &'a SimConfig,
    pub(super) time: Arc<PrinterTime>,
    pub(super) world: World,
    pub(super) pins: Vec<WiredPin>,
    pub(super) spi_buses: Vec<SpiBus>,
    pub(super) i2c_buses: Vec<I2cBus>,
}

impl Workshop<'_> {
    /// An axis by its name, if there is one.
    pub(super) fn axis(&self, name: &str) -> Option<Arc<Axis>> {
        self.world.axes.iter().find(|axis| axis.name == name).cloned()
    }

    /// A heater by its name, if there is one.
    pub(super) fn heater(&self, name: &str) -> Option<Arc<Heater>> {
        self.world.heaters.iter().find(|heater| heater.name == name).cloned()
    }

    /// A part's noise.
    pub(super) fn noise(&self, part: &dyn Part) -> Noise {
        Noise::of(&part.name(), self.config.seed)
    }

    /// The bed under the nozzle.
    pub(super) fn bed(&self) -> Bed {
        Bed::new(self.config.bed.clone(), self.delta().map_or_else(|| self.gantry(), Head::Delta))
    }

    /// The three arms of a delta printer.
    fn delta(&self) -> Option<Delta> {
        let Kinematics::Delta(delta) = self.config.kinematics() else { return None };
        let [a, b, c] = DeltaConfig::TOWERS.map(|tower| self.axis(tower));
        Some(Delta::new(delta, [a?, b?, c?]))
    }

    /// The head of any other printer.
    fn gantry(&self) -> Head {
        let motors = self.config.motors("z").filter_map(|motor| {
            let at_mm = motor.at_mm.unwrap_or_default();
            self.axis(&motor.name).map(|axis| (axis, at_mm))
        });
        Head::Cartesian { x: self.axis("x"), y: self.axis("y"), z: Plane::new(motors.collect()) }
    }

    /// Wires a pin, if the part has it.
    pub(super) fn wire(&mut self, pin: Option<&PinName>, wire: impl Wire + 'static) {
        self.wire_shared(pin, Arc::new(wire));
    }

    /// Wires a pin, if the part has it, to what the part itself looks at, too.
    pub(super) fn wire_shared(&mut self, pin: Option<&PinName>, wire: Arc<dyn Wire>) {
        self.pins.extend(pin.map(|pin| WiredPin::new(pin, wire)));
    }

    /// Puts a chip on its SPI bus.
    pub(super) fn solder_spi(&mut self, part: &dyn Part, chip: impl SpiChip + 'static) {
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
    pub(super) fn listen(&mut self, part: &dyn Part, listener: impl MosiListener + 'static) {
        let Some(Socket::Mosi { bus }) = part.socket() else { return };
        if let Some(bus) = self.spi_buses.iter_mut().find(|other| other.name == bus) {
            bus.listen(Box::new(listener));
        }
    }

    /// Puts a chip on its I2C bus.
    pub(super) fn solder_i2c(&mut self, part: &dyn Part, chip: impl I2cChip + 'static) {
        let Some(Socket::I2c { bus, address }) = part.socket() else { return };
        if let Some(bus) = self.i2c_buses.iter_mut().find(|other| other.name == bus) {
            bus.solder(part.name(), address, Box::new(chip));
        }
    }

    /// Lets a person see the part.
    pub(super) fn show(&mut self, sight: Arc<dyn Sight>) {
        self.world.sights.push(sight);
    }
}
