// SPDX-License-Identifier: GPL-3.0-or-later
//! Words for a line with short pulses. One thread makes the pulses. If it is interrupted while the line is high, another
//! one ends the pulse.
//!
//! The second thread may be interrupted, too: between a read of the line and the store that ends the pulse. A late store
//! must not cut a later pulse short. So each pulse has a number. The first thread makes a pulse when the second one has
//! said that it watches this pulse. After that the second thread cannot end an earlier pulse.

use crate::atomic::{AtomicU32, Ordering, fence};

/// The words.
#[derive(Debug, Default)]
pub struct Watch {
    /// The next pulse, or the present one; 0 if there is none to watch.
    announced: AtomicU32,
    /// The pulse that is watched.
    watched: AtomicU32,
    /// The second thread's findings about the pulse before that one.
    known: AtomicU32,
}

impl Watch {
    /// The first thread is about to make this pulse, and is done with the one before. The number is not 0, and not that of
    /// the pulse before.
    pub fn announce(&self, pulse: u32) {
        self.announced.store(pulse, Ordering::Release);
    }

    /// Asks if the second thread watches this pulse. Then returns what it knows of the pulse before.
    pub fn known_before(&self, pulse: u32) -> Option<u32> {
        (self.watched.load(Ordering::Acquire) == pulse).then(|| self.known.load(Ordering::Relaxed))
    }

    /// There is no pulse to watch any more. The first thread may now make one that nobody watches, unless the second
    /// thread still watches one that was announced.
    pub fn close(&self) {
        self.announced.store(0, Ordering::Relaxed);
        // The second thread looks at the line, and then at the announcement. If it has seen a pulse that follows, it
        // also sees that nothing is announced.
        fence(Ordering::Release);
    }

    /// The pulse that is announced; 0 without one. The second thread asks this before each read of the line.
    pub fn announced(&self) -> u32 {
        // The read before comes first.
        fence(Ordering::Acquire);
        self.announced.load(Ordering::Acquire)
    }

    /// The second thread watches this pulse from now on, and reports on the one before. It ends a pulse if two
    /// of its reads after this call have found the line high.
    pub fn begin(&self, pulse: u32, known: u32) {
        self.known.store(known, Ordering::Relaxed);
        self.watched.store(pulse, Ordering::Release);
    }
}
