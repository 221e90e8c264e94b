// SPDX-License-Identifier: GPL-3.0-or-later
//! Words that one thread writes and any thread reads, without a lock.

#![forbid(unsafe_code)]

use std::sync::atomic::{AtomicU64, Ordering, fence};

/// A few words that belong together. One thread writes them, and any thread reads them whole.
///
/// They alternate between two places. So a writer that was stopped in the middle of a store delays no reader: the words
/// before are still whole. The writer may be a worker that the core preempted. It continues only when the core is done.
/// A reader reads again only if a whole `store` happened during its read. The next store writes to the place that it
/// reads.
#[derive(Debug)]
pub struct Together<const N: usize> {
    /// How many times the words were stored. The lowest bit is the place of the last ones.
    stores: AtomicU64,
    places: [[AtomicU64; N]; 2],
}

impl<const N: usize> Together<N> {
    pub fn new(words: [u64; N]) -> Together<N> {
        let place = || words.map(AtomicU64::new);
        Together { stores: AtomicU64::new(0), places: [place(), place()] }
    }

    fn place(&self, stores: u64) -> &[AtomicU64; N] {
        &self.places[(stores & 1) as usize]
    }

    pub fn load(&self) -> [u64; N] {
        loop {
            let stores = self.stores.load(Ordering::Acquire);
            let words = self.place(stores).each_ref().map(|word| word.load(Ordering::Relaxed));
            fence(Ordering::Acquire);
            if stores == self.stores.load(Ordering::Relaxed) {
                return words;
            }
        }
    }

    /// Only one thread may store.
    pub fn store(&self, words: [u64; N]) {
        let stores = self.stores.load(Ordering::Relaxed).wrapping_add(1);
        // A reader that sees one of these words also sees that the former words in this place are outdated.
        fence(Ordering::Release);
        for (word, value) in self.place(stores).iter().zip(words) {
            word.store(value, Ordering::Relaxed);
        }
        self.stores.store(stores, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::AtomicBool;

    #[test]
    fn words_that_belong_together_are_never_seen_apart() {
        let words = Arc::new(Together::new([0; 4]));
        let done = Arc::new(AtomicBool::new(false));
        let reader = std::thread::spawn({
            let (words, done) = (words.clone(), done.clone());
            move || {
                let mut reads = 0;
                while !done.load(Ordering::Acquire) || reads == 0 {
                    let seen = words.load();
                    assert!(seen.iter().all(|&word| word == seen[0]), "{seen:?}");
                    reads += 1;
                }
            }
        });
        for i in 0..200_000 {
            words.store([i; 4]);
        }
        done.store(true, Ordering::Release);
        assert!(reader.join().is_ok());
    }

    #[test]
    fn who_reads_while_the_writer_is_stopped_amid_its_work_does_not_wait() {
        let words = Together::new([1; 3]);
        words.store([2; 3]);
        // The first word of the next store.
        words.place(2)[0].store(3, Ordering::Relaxed);
        assert_eq!(words.load(), [2; 3]);
    }
}
