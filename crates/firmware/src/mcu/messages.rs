// SPDX-License-Identifier: GPL-3.0-or-later
//! The messages between host and MCU: commands, responses, and their dialect; notes for the log.

use std::sync::Arc;

use crate::shutdown::{Shutdown, reason};
use pinion_protocol::vlq::{Reader, Writer};

use super::dialect::READ_AGAIN;
use super::{Dialect, Mcu, Note, Outbox, Response, State, base};

/// The way to the host and to the log.
pub(super) struct HostWire {
    /// The dialect of the host that configured the MCU.
    dialect: Arc<Dialect>,
    /// The dialect of a host that came after the MCU was configured.
    next: Option<Arc<Dialect>>,
    outbox: Box<dyn Outbox>,
}

impl HostWire {
    pub(super) fn new(dialect: Arc<Dialect>, outbox: Box<dyn Outbox>) -> HostWire {
        HostWire { dialect, next: None, outbox }
    }

    /// The dialect that the MCU speaks.
    pub(super) fn dialect(&self) -> &Arc<Dialect> {
        &self.dialect
    }

    /// The dialect of the present host.
    #[inline]
    pub(super) fn heard(&self) -> &Arc<Dialect> {
        self.next.as_ref().unwrap_or(&self.dialect)
    }

    /// Whether the present host is not the one that configured the MCU.
    #[inline]
    pub(super) fn is_foreign(&self) -> bool {
        self.next.is_some()
    }

    /// Speaks the dialect of the present host from now on.
    pub(super) fn take_next(&mut self) {
        if let Some(dialect) = self.next.take() {
            self.dialect = dialect;
        }
    }

    /// Whether the host needs responses of type `R`.
    pub(super) fn speaks<R: Response>(&self) -> bool {
        self.dialect.needs(R::FORM.format)
    }

    /// Sends a response, if the host uses it.
    pub(super) fn send<R: Response>(&mut self, response: R) {
        if self.is_foreign() && !base::is_own_response(R::INDEX) {
            return;
        }
        // The MCU's own messages are in the form of the present host.
        let Some(id) = self.heard().response_id::<R>() else { return };
        let mut writer = Writer::default();
        writer.int(id);
        response.encode(&mut writer);
        if let Some(payload) = writer.payload() {
            self.outbox.send(payload);
        }
    }

    /// Leaves a note for the log.
    pub(super) fn note(&mut self, note: Note<'_>) {
        self.outbox.note(note);
    }
}

impl Mcu {
    /// Runs the first command of a block's payload. If it stops the MCU, the rest of the block is dropped, as in
    /// Klipper's C. Do not call this while the MCU [is held](Mcu::is_held).
    #[inline]
    pub fn execute(&mut self, payload: &mut Reader<'_>) {
        let command = *payload;
        self.state.scheduler.begin_command();
        self.state.barrier.begin_command();
        let done = self.try_execute(payload);
        self.state.barrier.end_command();
        if let Err(mut shutdown) = done {
            if shutdown.reason == reason::COMMAND_PARSER {
                shutdown = self.cut_short(command);
            }
            *payload = Reader::new(&[]);
            self.shut_down(shutdown);
        }
    }

    /// Whether a block asks for an emergency stop.
    pub fn is_emergency(&self, payload: &[u8]) -> bool {
        self.heard().is_emergency(payload)
    }

    /// The dialect of the present host. The MCU may not be able to serve it yet.
    pub fn heard(&self) -> &Arc<Dialect> {
        self.state.wire.heard()
    }

    /// The error for a command that ends before its parameters do.
    #[cold]
    fn cut_short(&self, mut command: Reader<'_>) -> Shutdown {
        let id = command.int().ok();
        let format = id.and_then(|id| self.heard().command(id).ok()).map_or("a command's id", |entry| entry.format);
        Shutdown::because(reason::COMMAND_PARSER, format!("a message ends in the middle of \"{format}\""))
            .remedy(READ_AGAIN)
    }

    #[inline]
    fn try_execute(&mut self, payload: &mut Reader<'_>) -> Result<(), Shutdown> {
        let id = payload.int()?;
        let command = self.heard().command(id)?;
        let is_foreign = self.state.wire.is_foreign() && !command.is_own;
        match self.state.phase.stop_reason() {
            // Without this, some commands of another dialect would run here, on objects of another host.
            Some(reason) if is_foreign || !command.in_shutdown => {
                command.skip(payload)?;
                let static_string_id = self.state.wire.dialect.static_string_id(reason);
                self.state.wire.send(base::IsShutdown { static_string_id });
                Ok(())
            }
            None if is_foreign => {
                let cause = "the MCU is configured by a host that uses other forms of messages than the present one";
                Err(Shutdown::because(reason::INVALID_COMMAND, cause).remedy("FIRMWARE_RESTART"))
            }
            _ => (command.handler)(self, payload),
        }
    }

    /// Changes the MCU's dialect, for another host. This happens at once, or after the reset if a host has begun to
    /// configure the MCU.
    ///
    /// Until the reset, host and MCU exchange only the MCU's own messages, which have the same ids in every dialect.
    /// The objects' messages would mean something else to the other host, or nothing. klippy's reader ends at the first
    /// message that it cannot decode. `get_config` gives a checksum that the other host cannot take for its own.
    ///
    /// If only the board has changed, the forms are the same and only the names of pins differ. Then the change is
    /// made at once.
    pub fn speak(&mut self, dialect: Arc<Dialect>) {
        let State { wire, phase, .. } = &mut self.state;
        let is_free = dialect.forms() == wire.dialect.forms() || !phase.is_allocated();
        wire.next = Some(dialect);
        if is_free {
            wire.take_next();
        }
    }

    /// The dialect that the MCU speaks.
    pub fn dialect(&self) -> &Arc<Dialect> {
        &self.state.wire.dialect
    }
}
