// SPDX-License-Identifier: GPL-3.0-or-later
//! The phase of the MCU.
//!
//! ```text
//!          allocate_oids              finalize_config
//! Empty ------------------> Configuring ------------------> Running
//!   |                            |                             |
//!   |   any failure,             |                             |
//!   |   emergency_stop           v                             |
//!   +----------------------> Stopped <-------------------------+
//! ```
//!
//! `config_reset` leads from `Stopped` to `Empty`. It waits until every output is at its shutdown value.
//! `clear_shutdown` leads from `Stopped` back to the phase before.

use crate::shutdown::{Shutdown, ShutdownReason, reason};
use crate::time::Clock;

/// The phase of the MCU.
#[derive(Default)]
pub(super) enum Phase {
    /// It has no configuration.
    #[default]
    Empty,
    /// A host configures it.
    Configuring {
        /// The count of `allocate_oids`.
        oids: usize,
    },
    /// Its configuration is complete.
    Running {
        /// The checksum of `finalize_config`.
        crc: u32,
    },
    /// It has stopped.
    Stopped {
        /// The phase before.
        before: Before,
        /// The reason.
        why: Shutdown,
        /// The time of the stop.
        at: Clock,
        /// Whether a `config_reset` waits for outputs to be at their shutdown values.
        reset_due: bool,
    },
}

/// A phase before a stop.
#[derive(Clone, Copy)]
pub(super) enum Before {
    Empty,
    Configuring { oids: usize },
    Running { crc: u32 },
}

impl Phase {
    /// How far the configuration is. A stop does not change it.
    fn configured(&self) -> Before {
        match self {
            Phase::Empty => Before::Empty,
            Phase::Configuring { oids } => Before::Configuring { oids: *oids },
            Phase::Running { crc } => Before::Running { crc: *crc },
            Phase::Stopped { before, .. } => *before,
        }
    }

    /// Whether the configuration is complete and the MCU is not stopped.
    #[inline]
    pub(super) fn is_running(&self) -> bool {
        matches!(self, Phase::Running { .. })
    }

    #[inline]
    pub(super) fn is_stopped(&self) -> bool {
        matches!(self, Phase::Stopped { .. })
    }

    /// Whether the configuration is complete.
    pub(super) fn is_finalized(&self) -> bool {
        matches!(self.configured(), Before::Running { .. })
    }

    /// Whether a host has begun to configure the MCU.
    pub(super) fn is_allocated(&self) -> bool {
        !matches!(self.configured(), Before::Empty)
    }

    /// The checksum of the configuration; 0 until it is complete.
    pub(super) fn crc(&self) -> u32 {
        if let Before::Running { crc } = self.configured() { crc } else { 0 }
    }

    /// How many oids the host has allocated, while it configures the MCU.
    pub(super) fn oids(&self) -> usize {
        if let Before::Configuring { oids } = self.configured() { oids } else { 0 }
    }

    /// Why the MCU is stopped; `None` while it is not.
    #[inline]
    pub(super) fn stop_reason(&self) -> Option<ShutdownReason> {
        if let Phase::Stopped { why, .. } = self { Some(why.reason) } else { None }
    }

    /// Why and when the MCU stopped; `None` while it is not stopped.
    pub(super) fn last_stop(&self) -> Option<(&Shutdown, Clock)> {
        if let Phase::Stopped { why, at, .. } = self { Some((why, *at)) } else { None }
    }

    /// Whether a `config_reset` waits for outputs to be at their shutdown values.
    #[inline]
    pub(super) fn is_reset_due(&self) -> bool {
        matches!(self, Phase::Stopped { reset_due: true, .. })
    }

    pub(super) fn allocate(&mut self, oids: usize) -> Result<(), Shutdown> {
        if self.is_allocated() {
            let cause = "allocate_oids came twice: a host before left its configuration unfinished, for a wrong pin or because it was killed";
            return Err(Shutdown::because(reason::OIDS_ALLOCATED, cause).remedy("FIRMWARE_RESTART"));
        }
        *self = Phase::Configuring { oids };
        Ok(())
    }

    pub(super) fn finalize(&mut self, crc: u32) -> Result<(), Shutdown> {
        if self.is_finalized() {
            return Err(Shutdown::by_host(reason::ALREADY_FINALIZED, "finalize_config came twice"));
        }
        *self = Phase::Running { crc };
        Ok(())
    }

    /// Stops the MCU. An MCU that is stopped keeps its first reason. It gives this one back.
    pub(super) fn stop(&mut self, why: Shutdown, at: Clock) -> Option<Shutdown> {
        if self.is_stopped() {
            return Some(why);
        }
        *self = Phase::Stopped { before: self.configured(), why, at, reset_due: false };
        None
    }

    /// Returns to the phase before the stop.
    pub(super) fn clear_shutdown(&mut self) -> Result<(), Shutdown> {
        let Phase::Stopped { before, .. } = self else {
            let what = "clear_shutdown came while the MCU was not stopped";
            return Err(Shutdown::by_host(reason::NOT_SHUTDOWN, what));
        };
        *self = match *before {
            Before::Empty => Phase::Empty,
            Before::Configuring { oids } => Phase::Configuring { oids },
            Before::Running { crc } => Phase::Running { crc },
        };
        Ok(())
    }

    /// Asks for the reset that follows when every output is at its shutdown value.
    pub(super) fn request_reset(&mut self) -> Result<(), Shutdown> {
        let Phase::Stopped { reset_due, .. } = self else {
            let what = "config_reset came without an emergency_stop before it";
            return Err(Shutdown::by_host(reason::CONFIG_RESET_RUNNING, what));
        };
        *reset_due = true;
        Ok(())
    }
}
