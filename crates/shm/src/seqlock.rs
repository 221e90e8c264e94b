// SPDX-License-Identifier: GPL-3.0-or-later
//! Words that one thread writes and any thread reads, without a lock.

use std::ops::Deref;

use crate::atomic::{AtomicU64, Ordering, fence};

/// A few words that belong together. One thread writes them, and any thread reads them whole.
///
/// They alternate between two places. So a writer that was stopped in the middle of a store, or killed, delays no
/// reader: the words before are still whole. The writer may be a worker that the core preempted. It continues only when
/// the core is done. A reader reads again only if a whole `store` happened during its read. The next store writes to
/// the place that it reads.
///
/// The first word is how many times the words were stored. Its lowest bit is the place of the last ones.
#[derive(Clone, Copy, Debug)]
pub struct Seqlock<W = &'static [AtomicU64]>(W);

/// Number of words for this many that belong together.
pub const fn words(together: usize) -> usize {
    1 + 2 * together
}

impl Seqlock<Box<[AtomicU64]>> {
    /// Words of this process.
    pub fn of(words: &[u64]) -> Self {
        Seqlock([0].iter().chain(words).chain(words).map(|word| AtomicU64::new(*word)).collect())
    }
}

impl<W: Deref<Target = [AtomicU64]>> Seqlock<W> {
    /// A view of these words, an odd number. They are zero, or were already used for this.
    pub fn new(words: W) -> Seqlock<W> {
        Seqlock(words)
    }

    fn place(&self, stores: u64) -> &[AtomicU64] {
        let length = (self.0.len() - 1) / 2;
        &self.0[1 + (stores & 1) as usize * length..][..length]
    }

    /// Calls `copy` with the words until it has seen a consistent set. `copy` must tolerate torn data.
    pub fn load<T>(&self, mut copy: impl FnMut(&mut dyn Iterator<Item = u64>) -> T) -> T {
        loop {
            let stores = self.0[0].load(Ordering::Acquire);
            let copied = copy(&mut self.place(stores).iter().map(|word| word.load(Ordering::Relaxed)));
            fence(Ordering::Acquire);
            if stores == self.0[0].load(Ordering::Relaxed) {
                return copied;
            }
        }
    }

    /// Stores words. Words beyond these are unspecified. Only one thread may store.
    pub fn store(&self, words: impl IntoIterator<Item = u64>) {
        let stores = self.0[0].load(Ordering::Relaxed).wrapping_add(1);
        // A reader that sees one of these words also sees that the former words in this place are outdated.
        fence(Ordering::Release);
        for (word, value) in self.place(stores).iter().zip(words) {
            word.store(value, Ordering::Relaxed);
        }
        self.0[0].store(stores, Ordering::Release);
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;
    use std::thread;

    #[test]
    fn words_that_belong_together_are_never_seen_apart() {
        let words = Seqlock::of(&[0; 4]);
        let done = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                (0..200_000).for_each(|word| words.store([word; 4]));
                done.store(true, Ordering::Release);
            });
            while !done.load(Ordering::Acquire) {
                let seen: Vec<u64> = words.load(|words| words.collect());
                assert!(seen.len() == 4 && seen.iter().all(|word| *word == seen[0]), "{seen:?}");
            }
        });
    }

    #[test]
    fn who_reads_while_the_writer_is_stopped_amid_its_work_does_not_wait() {
        let words = Seqlock::of(&[1; 3]);
        words.store([2; 3]);
        // The first word of the next store.
        words.place(2)[0].store(3, Ordering::Relaxed);
        assert_eq!(words.load(|words| words.collect::<Vec<_>>()), [2; 3]);
    }
}
