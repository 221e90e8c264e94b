// SPDX-License-Identifier: GPL-3.0-or-later
//! Sleep flags: a thread wakes another only if it sleeps, and sleeps only if it has no work.

use crate::atomic::{AtomicBool, AtomicU32, Ordering, fence};

/// Whether a thread sleeps. Others put something where it looks, and then call it. A call costs a system call only if
/// it sleeps.
#[derive(Debug, Default)]
pub struct Doze(AtomicBool);

impl Doze {
    /// Whether the thread has to be woken. Others ask this after they have put something where the thread looks.
    pub fn is_to_be_woken(&self) -> bool {
        self.0.swap(false, Ordering::Release)
    }

    /// The thread calls this before it sleeps. After this it must look once more.
    ///
    /// Then no wake-up is lost. If this swap comes first, the swap in [`Doze::is_to_be_woken`] finds the thread asleep.
    /// Otherwise this swap reads the value that the other one left. So the look that follows sees all that was put there
    /// before. A plain store would read nothing, and the second case would not hold. The thread could then look before
    /// it can see what is there, and sleep although it was found awake.
    pub fn begin(&self) {
        self.0.swap(true, Ordering::Acquire);
    }

    /// The thread calls this after its sleep.
    ///
    /// This is a swap, too. After a store, the next [`Doze::begin`] would read the store's value. It would not see what
    /// was put there between the end of the sleep and the store.
    pub fn end(&self) {
        self.0.swap(false, Ordering::Relaxed);
    }
}

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
        // The ring that hands the request over also shows this count to whoever finds the request there.
        self.stops_handed.fetch_add(1, Ordering::Relaxed);
    }

    /// How many stop requests the link has handed to the core, or is about to. The core counts those that it has taken
    /// out of its ring. While its count is lower, one is still to come.
    pub fn stops_handed(&self) -> u32 {
        self.stops_handed.load(Ordering::Relaxed)
    }
}
