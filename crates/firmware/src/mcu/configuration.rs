// SPDX-License-Identifier: GPL-3.0-or-later
//! The host's configuration, and how the MCU forgets it.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::shutdown::{Shutdown, reason};

use super::lines::Claim;
use super::stop::Stop;
use super::{Mcu, MovePool, Note, Object, Oid, TimerId};

/// Highest number of objects with an oid.
pub(super) const OBJECTS_MAX: usize = 256;

/// The host's configuration.
#[derive(Default)]
pub(super) struct Configuration {
    /// Indexed by oid; feature-owned objects follow.
    pub(super) objects: Vec<Option<Box<dyn Object>>>,
    /// The count of `allocate_oids`; `None` before that command.
    pub(super) oid_count: Option<usize>,
    /// The objects that the log names by a pin.
    pub(super) pins: Vec<(Oid, Pin)>,
    /// The GPIO lines in use.
    pub(super) claims: Vec<Claim>,
    /// The checksum of `finalize_config`.
    pub(super) crc: u32,
    /// Whether a `config_reset` waits for outputs to be at their shutdown values.
    pub(super) reset_due: bool,
}

impl Mcu {
    /// Whether the MCU is configured and not stopped.
    #[inline]
    pub fn is_running(&self) -> bool {
        self.is_finalized() && self.stop.reason.is_none()
    }

    /// Whether the configuration is complete.
    pub fn is_finalized(&self) -> bool {
        self.moves.count != 0
    }

    /// Whether a host has begun to configure the MCU.
    pub(super) fn is_allocated(&self) -> bool {
        self.configuration.oid_count.is_some()
    }

    pub(super) fn allocate_oids(&mut self, count: u8) -> Result<(), Shutdown> {
        if self.is_allocated() {
            let cause = "allocate_oids came twice: a host before left its configuration unfinished, for a wrong pin or because it was killed";
            return Err(Shutdown::because(reason::OIDS_ALLOCATED, cause).remedy("FIRMWARE_RESTART"));
        }
        let count = usize::from(count);
        self.configuration.oid_count = Some(count);
        let objects = &mut self.configuration.objects;
        if objects.len() < count {
            objects.resize_with(count, || None);
        }
        Ok(())
    }

    pub(super) fn finalize(&mut self, crc: u32) -> Result<(), Shutdown> {
        if self.is_finalized() {
            return Err(Shutdown::by_host(reason::ALREADY_FINALIZED, "finalize_config came twice"));
        }
        self.moves.finalize();
        self.configuration.crc = crc;
        // The core does not allocate after this.
        self.schedule.reserve();
        self.schedule.has_banks = self.configuration.claims.iter().any(Claim::is_in_bank);
        let mut kinds: Vec<(&'static str, usize)> = Vec::new();
        for object in self.configuration.objects.iter().flatten() {
            match kinds.iter_mut().find(|(kind, _)| *kind == object.kind()) {
                Some((_, count)) => *count += 1,
                None => kinds.push((object.kind(), 1)),
            }
        }
        self.outbox.note(Note::Configured(&kinds));
        Ok(())
    }

    /// Forgets the configuration as soon as every output is at its shutdown value. After that, nothing would try to
    /// drive an output to it. No command runs until then.
    pub(super) fn reset(&mut self) -> Result<(), Shutdown> {
        if !self.is_shutdown() {
            return Err(Shutdown::by_host(
                reason::CONFIG_RESET_RUNNING,
                "config_reset came without an emergency_stop before it",
            ));
        }
        self.configuration.reset_due = true;
        self.reset_if_due();
        Ok(())
    }

    pub(super) fn reset_if_due(&mut self) {
        if !self.configuration.reset_due || self.owes() {
            return;
        }
        self.stop = Stop::default();
        self.schedule.timers.clear();
        self.schedule.timers.remove(TimerId::HOLD);
        self.workers.reset();
        self.holds.count = 0;
        self.configuration = Configuration::default();
        self.board.reset();
        self.moves = MovePool::default();
        if let Some(dialect) = self.spoken.next.take() {
            self.spoken.dialect = dialect;
        }
        self.outbox.note(Note::Reset);
    }
}
