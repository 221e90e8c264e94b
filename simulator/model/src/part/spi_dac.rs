// SPDX-License-Identifier: GPL-3.0-or-later
//! Digital potentiometers and DACs on SPI: AD5206 (Analog Devices, rev. D: 11 bits, the channel and its value) and
//! DAC084S085 (TI: 16 bits). They send nothing.

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::Trouble;
use crate::description::pin::PinName;
use crate::engine::spi::SpiChip;

/// A chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SpiDacChip {
    /// A potentiometer with six wipers.
    Ad5206,
    /// A DAC with four channels.
    Dac084s085,
}

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpiDacConfig {
    /// For example `digipot`.
    pub name: String,
    /// The kind of chip.
    pub chip: SpiDacChip,
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
}

impl Part for SpiDacConfig {
    fn name(&self) -> String {
        format!("spi_dac {}", self.name)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        workshop.solder_spi(self, Chip { chip: self.chip, shift: 0, outputs: [0; 8] });
        Ok(())
    }
}

struct Chip {
    chip: SpiDacChip,
    shift: u16,
    /// The values of the channels, in 256ths.
    outputs: [u8; 8],
}

impl SpiChip for Chip {
    fn knows_mode(&self, mode: u8) -> bool {
        match self.chip {
            SpiDacChip::Ad5206 => mode == 0,
            // Data is taken at the falling edge.
            SpiDacChip::Dac084s085 => matches!(mode, 1 | 2),
        }
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        self.shift = self.shift << 8 | u16::from(byte);
        0xff
    }

    fn deselect(&mut self) {
        let [high, low] = self.shift.to_be_bytes();
        match self.chip {
            SpiDacChip::Ad5206 => self.outputs[usize::from(high & 7)] = low,
            SpiDacChip::Dac084s085 => self.outputs[usize::from(high >> 6)] = (self.shift >> 4) as u8,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_sets_its_channel() {
        let mut chip = Chip { chip: SpiDacChip::Ad5206, shift: 0, outputs: [0; 8] };
        assert_eq!([0x05, 0x80].map(|byte| chip.exchange(byte)), [0xff; 2]);
        chip.deselect();
        assert_eq!(chip.outputs[5], 0x80);
        let mut chip = Chip { chip: SpiDacChip::Dac084s085, shift: 0, outputs: [0; 8] };
        // Channel C, written and updated: 0x40.
        assert_eq!([0x94, 0x00].map(|byte| chip.exchange(byte)), [0xff; 2]);
        chip.deselect();
        assert_eq!(chip.outputs[2], 0x40);
    }
}
