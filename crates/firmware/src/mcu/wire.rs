// SPDX-License-Identifier: GPL-3.0-or-later
//! The wire between the host and the MCU, as the dictionary describes it to the host.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// The wire between a host and the MCU.
#[derive(Clone, Debug, Default)]
pub enum Wire {
    /// A pseudo terminal, or any other wire without a rate of its own.
    #[default]
    Terminal,
    /// A serial line with this rate in baud. klippy does not send faster (`SERIAL_BAUD`).
    Serial(u32),
    /// A CAN bus.
    Can(Arc<CanNode>),
}

impl Wire {
    /// The constant of the wire's rate, and its value.
    pub fn rate(&self) -> Option<(&'static str, u32)> {
        match self {
            Wire::Terminal => None,
            Wire::Serial(baud) => Some(("SERIAL_BAUD", *baud)),
            Wire::Can(node) => node.frequency().map(|frequency| ("CANBUS_FREQUENCY", frequency)),
        }
    }
}

/// Length of a `canbus_uuid`.
pub const CANBUS_UUID_BYTES: usize = 6;

/// The MCU as a node of a CAN bus. The link keeps it, and the host asks for it.
#[derive(Debug)]
pub struct CanNode {
    /// The `canbus_uuid`, by which klippy finds the MCU.
    pub uuid: [u8; CANBUS_UUID_BYTES],
    /// Bits per second, or 0.
    frequency: AtomicU32,
    /// The nodeid that a host has assigned, or 0.
    node_id: AtomicU32,
    health: [AtomicU32; 4],
}

/// The health of a CAN bus, as the interface sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CanHealth {
    /// The counter of receive errors.
    pub rx_error: u32,
    /// The counter of transmit errors.
    pub tx_error: u32,
    /// How many frames were sent again.
    pub tx_retries: u32,
    /// The state.
    pub state: CanState,
}

/// The state of a CAN node (ISO 11898-1). The numbers are Klipper's (`canbus_bus_state`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CanState {
    /// It sends and receives.
    #[default]
    Active,
    /// A counter of errors has reached 96.
    Warn,
    /// A counter of errors has reached 128. The node no longer marks the errors of others.
    Passive,
    /// It takes no part in the bus.
    Off,
}

impl CanState {
    /// All states with Klipper's names, in the order of their numbers.
    pub const ALL: [(CanState, &'static str); 4] = [
        (CanState::Active, "active"),
        (CanState::Warn, "warn"),
        (CanState::Passive, "passive"),
        (CanState::Off, "off"),
    ];
}

impl CanNode {
    /// A node without a nodeid, on a bus without errors.
    pub fn new(uuid: [u8; CANBUS_UUID_BYTES], frequency: Option<u32>) -> CanNode {
        let frequency = AtomicU32::new(frequency.unwrap_or(0));
        CanNode { uuid, frequency, node_id: AtomicU32::new(0), health: Default::default() }
    }

    /// Bits per second, if the interface has it. klippy does not send faster (`CANBUS_FREQUENCY`).
    pub fn frequency(&self) -> Option<u32> {
        Some(self.frequency.load(Ordering::Relaxed)).filter(|frequency| *frequency > 0)
    }

    /// The interface has this bitrate now.
    pub fn set_frequency(&self, frequency: Option<u32>) {
        self.frequency.store(frequency.unwrap_or(0), Ordering::Relaxed);
    }

    /// The assigned nodeid, or 0.
    pub fn node_id(&self) -> u8 {
        self.node_id.load(Ordering::Relaxed) as u8
    }

    /// A host has assigned this nodeid. 0: it is taken away.
    pub fn assign(&self, node_id: u8) {
        self.node_id.store(node_id.into(), Ordering::Relaxed);
    }

    /// The health of the bus.
    pub fn health(&self) -> CanHealth {
        let [rx_error, tx_error, tx_retries, state] = self.health.each_ref().map(|value| value.load(Ordering::Relaxed));
        let state = CanState::ALL.get(state as usize).map_or(CanState::Off, |(state, _)| *state);
        CanHealth { rx_error, tx_error, tx_retries, state }
    }

    /// The health of the bus has changed.
    pub fn report(&self, health: CanHealth) {
        let CanHealth { rx_error, tx_error, tx_retries, state } = health;
        for (place, value) in self.health.iter().zip([rx_error, tx_error, tx_retries, state as u32]) {
            place.store(value, Ordering::Relaxed);
        }
    }
}
