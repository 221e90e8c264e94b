// SPDX-License-Identifier: GPL-3.0-or-later
//! Chips on I2C that only take values: digital potentiometers and drivers of lights. They acknowledge each byte and keep
//! it. A host may read the registers of an SX1509 back.

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::Trouble;
use crate::engine::register_map::{OnBus, RegisterChip, RegisterMap};

/// A chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum I2cRegisterChip {
    /// A potentiometer with one wiper.
    Mcp4018,
    /// A potentiometer with four wipers.
    Mcp4451,
    /// A DAC with four channels.
    Mcp4728,
    /// A driver of four lights.
    Pca9533,
    /// A driver of four lights.
    Pca9632,
    /// Sixteen pins.
    Sx1509,
}

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct I2cRegisterConfig {
    /// For example `digipot`.
    pub name: String,
    /// The kind of chip.
    pub chip: I2cRegisterChip,
    /// Its I2C bus.
    pub bus: String,
    /// Its address on the bus.
    pub address: u8,
}

impl Part for I2cRegisterConfig {
    fn name(&self) -> String {
        format!("i2c_register {}", self.name)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::I2c { bus: &self.bus, address: self.address })
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        workshop.solder_i2c(self, Chip::on_bus(self.chip));
        Ok(())
    }
}

struct Chip {
    chip: I2cRegisterChip,
    registers: RegisterMap<u8>,
}

impl Chip {
    fn on_bus(chip: I2cRegisterChip) -> OnBus<Chip> {
        OnBus::new(Chip { chip, registers: RegisterMap::holding(0..0x100, &[]) })
    }
}

impl RegisterChip for Chip {
    fn register(&mut self, first: u8, _is_spi: bool) -> (u8, bool) {
        let register = match self.chip {
            // It has one register, and a message has no address.
            I2cRegisterChip::Mcp4018 => {
                self.registers.write(0, first);
                0
            }
            // MCP4451: the address in the upper half; the lower half has the command and the ninth bit.
            I2cRegisterChip::Mcp4451 => first >> 4,
            // The upper bits say whether the register counts up.
            I2cRegisterChip::Pca9533 | I2cRegisterChip::Pca9632 => first & 0x0f,
            I2cRegisterChip::Mcp4728 | I2cRegisterChip::Sx1509 => first,
        };
        (register, true)
    }

    fn read(&mut self, register: u8) -> u8 {
        self.registers.read(register)
    }

    fn write(&mut self, register: u8, value: u8) {
        self.registers.write(register, value);
    }

    fn next(&mut self, register: u8) -> u8 {
        register.wrapping_add(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::i2c::I2cChip;

    fn written(chip: I2cRegisterChip, message: &[u8]) -> OnBus<Chip> {
        let mut chip = Chip::on_bus(chip);
        assert!(chip.start(false) && message.iter().all(|byte| chip.write(*byte)));
        chip.stop();
        chip
    }

    #[test]
    fn each_chip_keeps_what_it_gets_in_the_register_that_it_names() {
        assert_eq!(written(I2cRegisterChip::Mcp4018, &[0x55]).chip.registers.get(0), 0x55);
        assert_eq!(written(I2cRegisterChip::Mcp4451, &[0x60, 0x7f]).chip.registers.get(6), 0x7f);
        assert_eq!(written(I2cRegisterChip::Pca9533, &[0x15, 0xaa]).chip.registers.get(5), 0xaa);
        let mut sx1509 = written(I2cRegisterChip::Sx1509, &[0x0e, 0x12, 0x34]);
        assert!(sx1509.start(false) && sx1509.write(0x0e) && sx1509.start(true));
        assert_eq!([sx1509.read(), sx1509.read()], [0x12, 0x34]);
    }
}
