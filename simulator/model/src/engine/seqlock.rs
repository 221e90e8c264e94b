// SPDX-License-Identifier: GPL-3.0-or-later
//! Words that one thread writes and any thread reads, without a lock.

use std::sync::atomic::AtomicU64;

use pinion_shm::seqlock;

/// A few words that belong together. One thread writes them, and any thread reads them whole.
#[derive(Debug)]
pub struct Seqlock<const N: usize>(seqlock::Seqlock<Box<[AtomicU64]>>);

impl<const N: usize> Seqlock<N> {
    pub fn new(words: [u64; N]) -> Seqlock<N> {
        Seqlock(seqlock::Seqlock::of(&words))
    }

    pub fn load(&self) -> [u64; N] {
        self.0.load(|words| std::array::from_fn(|_| words.next().unwrap_or_default()))
    }

    /// Only one thread may store.
    pub fn store(&self, words: [u64; N]) {
        self.0.store(words);
    }
}
