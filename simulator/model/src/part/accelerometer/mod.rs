// SPDX-License-Identifier: GPL-3.0-or-later
//! Accelerometers on a head that rings: their descriptions, and how a host's bytes reach their registers.

mod adxl345;
mod bmi160;
mod head;
mod lis2dw;
mod mpu9250;

use serde::{Deserialize, Serialize};

use self::head::Head;
use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Bound, Trouble, check, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::register_map::{OnBus, RegisterChip};
use crate::engine::ring::{Ring, RingConfig};
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;

/// A chip.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AccelerometerChip {
    /// On SPI.
    #[default]
    Adxl345,
    /// On SPI or I2C.
    Lis2dw,
    /// On SPI or I2C.
    Lis3dh,
    /// On I2C. The MPU-6050, MPU-6500 and MPU-9255 are the same with another id.
    Mpu9250,
    /// On I2C.
    Icm20948,
    /// On SPI or I2C.
    Bmi160,
}

impl AccelerometerChip {
    /// klippy's section.
    fn section(self) -> &'static str {
        match self {
            AccelerometerChip::Adxl345 => "adxl345",
            AccelerometerChip::Lis2dw => "lis2dw",
            AccelerometerChip::Lis3dh => "lis3dh",
            AccelerometerChip::Mpu9250 => "mpu9250",
            AccelerometerChip::Icm20948 => "icm20948",
            AccelerometerChip::Bmi160 => "bmi160",
        }
    }

    /// Whether klippy speaks to it on SPI, and on I2C.
    fn buses(self) -> (bool, bool) {
        match self {
            AccelerometerChip::Adxl345 => (true, false),
            AccelerometerChip::Lis2dw | AccelerometerChip::Lis3dh | AccelerometerChip::Bmi160 => (true, true),
            AccelerometerChip::Mpu9250 | AccelerometerChip::Icm20948 => (false, true),
        }
    }
}

/// The description of an accelerometer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AccelerometerConfig {
    /// The kind of chip.
    #[serde(default)]
    pub chip: AccelerometerChip,
    /// Distinguishes several of them.
    pub name: Option<String>,
    /// Its SPI or I2C bus.
    pub bus: String,
    /// Low selects it on SPI. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// Its address on I2C. Without this key it is on SPI.
    pub address: Option<u8>,
    /// How much faster its clock runs than it should.
    #[serde(default)]
    pub rate_off_percent: f64,
    /// Standard deviation of x and y at 100 samples a second, in LSB of an ADXL345: 3.9 mg.
    #[serde(default)]
    pub noise_lsb: f64,
    /// The motion that it feels along x.
    pub x: Option<RingConfig>,
    /// The motion that it feels along y.
    pub y: Option<RingConfig>,
    /// The motion that it feels along z, in addition to gravity.
    pub z: Option<RingConfig>,
}

impl AccelerometerConfig {
    fn rings(&self) -> [(&'static str, Option<&RingConfig>); 3] {
        [("x", self.x.as_ref()), ("y", self.y.as_ref()), ("z", self.z.as_ref())]
    }

    fn solder<C: RegisterChip + 'static>(&self, workshop: &mut Workshop<'_>, chip: C) {
        let chip = OnBus::new(chip);
        match self.address {
            None => workshop.solder_spi(self, chip),
            Some(_) => workshop.solder_i2c(self, chip),
        }
    }
}

impl Part for AccelerometerConfig {
    /// As klippy's section.
    fn name(&self) -> String {
        let section = self.chip.section();
        self.name.as_ref().map_or_else(|| section.to_owned(), |name| format!("{section} {name}"))
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(match self.address {
            None => Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() },
            Some(address) => Socket::I2c { bus: &self.bus, address },
        })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        match (self.chip.buses(), self.address) {
            ((true, _), None) | ((_, true), Some(_)) => {}
            (_, None) => return wrong(whose, "address", "klippy finds this chip on I2C only", "add its address"),
            _ => return wrong(whose, "address", "klippy finds this chip on SPI only", "remove it"),
        }
        if self.address.is_some() && self.select_pin.is_some() {
            return wrong(whose, "select_pin", "nothing selects a chip on I2C", "remove it, or the address");
        }
        check(whose, "rate_off_percent", self.rate_off_percent, Bound::Any)?;
        if self.rate_off_percent.abs() > 10.0 {
            return wrong(whose, "rate_off_percent", "no chip is so far off", "stay between -10 and 10");
        }
        check(whose, "noise_lsb", self.noise_lsb, Bound::NotNegative)?;
        for (key, ring) in self.rings() {
            let Some(ring) = ring else { continue };
            printer.check_rail(whose, &ring.axis)?;
            check(whose, key, ring.hz, Bound::AboveZero)?;
            if !(1e-6..0.99).contains(&ring.damping_ratio) {
                let cause = format!("a damping_ratio of {} does not ring", ring.damping_ratio);
                return wrong(whose, key, &cause, "give one between 0 and 0.99");
            }
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let now = workshop.clock.now();
        let rings = self.rings().map(|(_, ring)| {
            let ring = ring?;
            Some(Ring::new(workshop.rail(&ring.axis)?, ring, now))
        });
        for ring in self.rings().into_iter().filter_map(|(_, ring)| ring) {
            let rail = workshop.rail(&ring.axis);
            workshop.world.rings.extend(rail.map(|rail| (rail, ring.clone())));
        }
        let head = Head::new(self, rings, workshop.noise(self), workshop.clock.clone());
        match self.chip {
            AccelerometerChip::Adxl345 => self.solder(workshop, adxl345::Adxl345::new(head)),
            AccelerometerChip::Lis2dw => self.solder(workshop, lis2dw::Lis::new(&lis2dw::LIS2DW, head)),
            AccelerometerChip::Lis3dh => self.solder(workshop, lis2dw::Lis::new(&lis2dw::LIS3DH, head)),
            AccelerometerChip::Mpu9250 => self.solder(workshop, mpu9250::Mpu::new(&mpu9250::MPU9250, head)),
            AccelerometerChip::Icm20948 => self.solder(workshop, mpu9250::Mpu::new(&mpu9250::ICM20948, head)),
            AccelerometerChip::Bmi160 => self.solder(workshop, bmi160::Bmi160::new(head)),
        }
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        let section = self.name();
        cfg.section(&section);
        match self.address {
            None => cfg.spi(&self.bus, self.select_pin.as_ref()),
            Some(address) => {
                cfg.key("i2c_bus", &self.bus);
                cfg.key("i2c_address", address);
            }
        }
        if !layout.has_head() || std::mem::replace(&mut cfg.has_resonance_tester, true) {
            return;
        }
        // klippy shakes the head at this place.
        let [x_mm, y_mm] = layout.place_mm(0.5, 0.5);
        let z_mm = (layout.height_mm() / 2.0).min(20.0);
        cfg.section("resonance_tester");
        cfg.needs(&section);
        cfg.key("accel_chip", &section);
        cfg.key("probe_points", format_args!("{x_mm}, {y_mm}, {z_mm}"));
        cfg.section("input_shaper");
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::i2c::I2cChip;
    use crate::engine::motion::Axis;
    use crate::engine::noise::Noise;
    use crate::engine::spi::SpiChip;
    use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource as _, VirtualClock};

    pub(super) const X_HZ: f64 = 57.0;
    pub(super) const DAMPING: f64 = 0.1;
    /// The first byte on SPI: the host reads.
    pub(super) const READ: u8 = 0x80;

    /// A chip without noise. Its x axis rings.
    pub(super) struct Bench<C> {
        pub(super) axis: Arc<Axis>,
        pub(super) clock: VirtualClock,
        pub(super) chip: OnBus<C>,
    }

    impl<C: RegisterChip> Bench<C> {
        pub(super) fn new(rate_off_percent: f64, chip: impl FnOnce(Head) -> C) -> Bench<C> {
            let clock = VirtualClock::at(Clock::from_ticks(1_000_000_000));
            let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
            axis.set_enabled(true);
            axis.set_forward(true);
            let ring = RingConfig { axis: "x".into(), hz: X_HZ, damping_ratio: DAMPING };
            let rings = [Some(Ring::new(axis.rail().clone(), &ring, clock.now())), None, None];
            let config = AccelerometerConfig {
                chip: AccelerometerChip::Adxl345,
                name: None,
                bus: "spidev1.0".into(),
                select_pin: None,
                address: None,
                rate_off_percent,
                noise_lsb: 0.0,
                x: Some(ring),
                y: None,
                z: None,
            };
            let head = Head::new(&config, rings, Noise::of("accelerometer", 1), Arc::new(clock.clone()));
            Bench { axis, clock, chip: OnBus::new(chip(head)) }
        }

        pub(super) fn wait(&self, seconds: f64) {
            let ticks = (seconds * f64::from(CLOCK_FREQ)).round() as u64;
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + ticks));
        }

        /// A message on SPI.
        pub(super) fn exchange<const N: usize>(&mut self, mut bytes: [u8; N]) -> [u8; N] {
            self.chip.select(5_000_000);
            bytes.iter_mut().for_each(|byte| *byte = self.chip.exchange(*byte));
            self.chip.deselect();
            bytes
        }

        pub(super) fn read(&mut self, register: u8) -> u8 {
            self.exchange([register | READ, 0])[1]
        }

        pub(super) fn write(&mut self, register: u8, value: u8) {
            self.exchange([register, value]);
        }

        /// A message on I2C that reads from a register on.
        pub(super) fn i2c_read<const N: usize>(&mut self, register: u8) -> [u8; N] {
            assert!(self.chip.start(false) && I2cChip::write(&mut self.chip, register));
            assert!(self.chip.start(true));
            let bytes = [(); N].map(|()| I2cChip::read(&mut self.chip));
            self.chip.stop();
            bytes
        }

        /// A message on I2C that writes a register.
        pub(super) fn i2c_write(&mut self, register: u8, value: u8) {
            assert!(self.chip.start(false) && I2cChip::write(&mut self.chip, register));
            assert!(I2cChip::write(&mut self.chip, value));
            self.chip.stop();
        }

        pub(super) fn step(&self) {
            self.axis.edge(true, self.clock.now());
            self.axis.edge(false, self.clock.now());
        }
    }
}
