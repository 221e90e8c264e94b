// SPDX-License-Identifier: GPL-3.0-or-later
//! Sleep flags: a thread wakes another only if it sleeps, and sleeps only if it has no work.

use crate::atomic::{AtomicBool, Ordering};

/// Whether a thread sleeps. Others put something into its rings, and then call it. A call costs a system call only if
/// it sleeps.
#[derive(Debug, Default)]
pub struct SleepFlag(AtomicBool);

impl SleepFlag {
    /// Whether the thread has to be woken. Others ask this after they have put something into the thread's rings.
    pub fn is_to_be_woken(&self) -> bool {
        self.0.swap(false, Ordering::Release)
    }

    /// The thread calls this before it sleeps. After this it must check its rings once more.
    ///
    /// Then no wake-up is lost. If this swap comes first, the swap in [`SleepFlag::is_to_be_woken`] finds the thread asleep.
    /// Otherwise this swap reads the value that the other one left. So the check that follows sees all that was put there
    /// before. A plain store would read nothing, and the second case would not hold. The thread could then check before
    /// it can see what is there, and sleep although it was found awake.
    pub fn begin(&self) {
        self.0.swap(true, Ordering::Acquire);
    }

    /// The thread calls this after its sleep.
    ///
    /// This is a swap, too. After a store, the next [`SleepFlag::begin`] would read the store's value. It would not see what
    /// was put there between the end of the sleep and the store.
    pub fn end(&self) {
        self.0.swap(false, Ordering::Relaxed);
    }
}
