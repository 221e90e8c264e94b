// SPDX-License-Identifier: GPL-3.0-or-later
//! Reasons to end the core's wait: work that it can do now.

use rtrb::Consumer;

use pinion_firmware::mcu::Mcu;
use pinion_shm::progress::Progress;

use super::request::{Payload, Request};

/// Reasons to end the core's wait.
pub(super) struct Calls<'a> {
    pub(super) core: &'a Progress,
    pub(super) stops_taken: u32,
    pub(super) mcu: &'a Mcu,
    pub(super) block: Option<&'a (Payload, usize)>,
    pub(super) requests: &'a Consumer<Request>,
}

impl Calls<'_> {
    /// Whether there is work: a job is finished, or a command may run. A stop request behind a command that may not
    /// run is work too.
    #[inline]
    pub(super) fn any(&self) -> bool {
        self.mcu.has_completion()
            || match self.mcu.is_held() {
                false => self.block.is_some() || !self.requests.is_empty(),
                true => {
                    !self.mcu.is_shutdown() && self.core.stops_handed() != self.stops_taken
                        || next_commands(self.block, self.requests).is_some_and(|commands| self.mcu.may_run(commands))
                }
            }
    }
}

/// The commands that come next: the rest of the block that was begun, or the next block.
#[inline]
pub(super) fn next_commands<'a>(
    block: Option<&'a (Payload, usize)>,
    requests: &'a Consumer<Request>,
) -> Option<&'a [u8]> {
    match block {
        Some((payload, at)) => payload.as_slice().get(*at..),
        None => match requests.peek() {
            Ok(Request::Run(payload)) => Some(payload.as_slice()),
            _ => None,
        },
    }
}
