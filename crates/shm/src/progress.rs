// SPDX-License-Identifier: GPL-3.0-or-later
//! How far the core has come with the host's blocks.

use crate::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};

/// How many of the host's blocks the core has begun and finished. Also how many stop requests the link has handed to
/// it. The counts wrap around.
///
/// They give a response the sequence number of the block that it answers. klippy checks the number of a response before
/// it takes it for the answer to a query. The number must say that the query had been received (`#sent_time` in
/// serialhdl.py). Numbers must not run ahead of the core. Otherwise a late answer to an earlier query of the same name
/// would pass for the present answer.
#[derive(Debug, Default)]
pub struct Progress {
    begun: AtomicU32,
    done: AtomicU32,
    held: AtomicBool,
    /// Nonzero while it holds: see [`Progress::publish`].
    config: AtomicU64,
    stops_handed: AtomicU32,
}

impl Progress {
    /// The core begins the next block. Returns how many it has begun.
    pub fn begin(&self) -> u32 {
        self.begun.fetch_add(1, Ordering::Relaxed).wrapping_add(1)
    }

    /// How many blocks the core has begun. Only the core asks this.
    pub fn begun(&self) -> u32 {
        self.begun.load(Ordering::Relaxed)
    }

    /// The core has finished the block, and has sent all its responses to it.
    pub fn finish(&self) {
        self.done.fetch_add(1, Ordering::Release);
    }

    /// How many blocks are done. After this the link sees all responses to them.
    pub fn done(&self) -> u32 {
        self.done.load(Ordering::Acquire)
    }

    /// The core publishes its answer to `get_config`, before it finishes a block. 0: only the core can answer now. The word
    /// holds until the core sends its next response: a timer may have stopped the MCU by then.
    pub fn publish(&self, config: u64) {
        self.config.store(config, Ordering::Relaxed);
    }

    /// The core is about to send a response. A thread that sees the response does not see an older answer.
    pub fn withdraw(&self) {
        if self.config.load(Ordering::Relaxed) != 0 {
            self.config.store(0, Ordering::Relaxed);
        }
    }

    /// The core's published answer, or 0. The caller has seen with [`Progress::done`] that the core has no block, and
    /// then has taken all responses.
    pub fn published(&self) -> u64 {
        self.config.load(Ordering::Relaxed)
    }

    /// Notes whether a bus holds the core's block back from now on. After this the core looks for further blocks before
    /// it sleeps.
    pub fn hold(&self, held: bool) {
        // The core alone changes it, and calls this in each of its turns. Only a change needs the fence.
        if self.held.load(Ordering::Relaxed) != held {
            self.held.store(held, Ordering::Relaxed);
            fence(Ordering::SeqCst);
        }
    }

    /// Whether a bus holds the core's block back. Then the core need not be unparked for a block that it was handed
    /// before. One of the two fences comes first. So either this call sees that the core is no longer held, or the core
    /// sees the block.
    pub fn is_held(&self) -> bool {
        fence(Ordering::SeqCst);
        self.held.load(Ordering::Relaxed)
    }

    /// The link is about to hand the core a stop request, such as a block with `emergency_stop`.
    pub fn stop_handed(&self) {
        // The ring that hands the request over also shows this count to the thread that finds the request there.
        self.stops_handed.fetch_add(1, Ordering::Relaxed);
    }

    /// How many stop requests the link has handed to the core, or is about to. The core counts those that it has taken
    /// out of its ring. While its count is lower, one is still to come.
    pub fn stops_handed(&self) -> u32 {
        self.stops_handed.load(Ordering::Relaxed)
    }
}
