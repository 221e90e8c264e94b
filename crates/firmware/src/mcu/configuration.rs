// SPDX-License-Identifier: GPL-3.0-or-later
//! The host's configuration, and how the MCU forgets it.

use crate::shutdown::{Shutdown, reason};

use super::base::Config;
use super::{Mcu, Note, TimerId};

impl Mcu {
    /// Whether the MCU is configured and not stopped.
    #[inline]
    pub fn is_running(&self) -> bool {
        self.state.phase.is_running()
    }

    /// Whether the configuration is complete.
    pub fn is_finalized(&self) -> bool {
        self.state.phase.is_finalized()
    }

    /// The answer to `get_config`.
    pub fn config(&self) -> Config {
        let state = &self.state;
        Config {
            is_config: self.is_finalized(),
            // klippy resets an MCU with another configuration before it sends anything else.
            crc: if state.wire.is_foreign() { !state.phase.crc() } else { state.phase.crc() },
            is_shutdown: self.is_shutdown(),
            move_count: state.moves.count(),
        }
    }

    pub(super) fn allocate_oids(&mut self, count: u8) -> Result<(), Shutdown> {
        let count = usize::from(count);
        self.state.phase.allocate(count)?;
        self.state.objects.allocate(count);
        Ok(())
    }

    pub(super) fn finalize(&mut self, crc: u32) -> Result<(), Shutdown> {
        let state = &mut self.state;
        state.phase.finalize(crc)?;
        state.moves.finalize();
        // The core does not allocate after this.
        state.scheduler.finalize(state.lines.has_banks());
        let mut kinds: Vec<(&'static str, usize)> = Vec::new();
        for object in state.objects.iter() {
            match kinds.iter_mut().find(|(kind, _)| *kind == object.kind()) {
                Some((_, count)) => *count += 1,
                None => kinds.push((object.kind(), 1)),
            }
        }
        state.wire.note(Note::Configured(&kinds));
        Ok(())
    }

    /// Forgets the configuration as soon as every output is at its shutdown value. After that, nothing would try to
    /// drive an output to it. No command runs until then.
    pub(super) fn reset(&mut self) -> Result<(), Shutdown> {
        self.state.phase.request_reset()?;
        self.reset_if_due();
        Ok(())
    }

    /// Makes the MCU ready for another process of the host. The process that configured it is gone.
    ///
    /// A running MCU stays as it is: the process may go on with its configuration, as in Klipper's C. An MCU that has
    /// stopped, or whose configuration has not been finished, is of no use to the process. It is reset as by
    /// `config_reset`, after a stop that drives every output to its shutdown value.
    pub fn renew(&mut self) {
        if self.is_running() || !self.state.phase.is_allocated() && !self.is_shutdown() {
            return;
        }
        self.state.wire.note(Note::Renewed);
        if !self.is_shutdown() {
            self.shut_down(Shutdown::because(
                reason::COMMAND_REQUEST,
                "the host ended in the middle of its configuration",
            ));
        }
        // It is stopped, which is all that a reset asks for.
        let _ = self.reset();
    }

    pub(super) fn reset_if_due(&mut self) {
        let state = &mut self.state;
        if !state.phase.is_reset_due() || state.pending.are_awaited() {
            return;
        }
        state.phase = Default::default();
        state.pending = Default::default();
        state.scheduler.clear();
        state.scheduler.cancel(TimerId::HOLD);
        state.workers.reset();
        state.barrier = Default::default();
        state.objects = Default::default();
        state.lines = Default::default();
        state.board.reset();
        state.moves = Default::default();
        state.wire.take_next();
        state.wire.note(Note::Reset);
    }
}
