// SPDX-License-Identifier: GPL-3.0-or-later
//! A wire from the bus's output (MOSI) to its input (MISO): every byte comes back. klippy has no section for a wire.
//! Tests use their own commands for it.

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::Trouble;
use crate::description::pin::PinName;
use crate::engine::spi::SpiChip;

/// The wire's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LoopbackConfig {
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
}

impl Part for LoopbackConfig {
    fn name(&self) -> String {
        format!("loopback {}", self.bus)
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        workshop.solder_spi(self, Loopback);
        Ok(())
    }
}

struct Loopback;

impl SpiChip for Loopback {
    fn knows_mode(&self, _mode: u8) -> bool {
        true
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        byte
    }
}
