// SPDX-License-Identifier: GPL-3.0-or-later
//! Rings of records. One thread writes a ring and never waits. Anybody may read it at any time, even after its writer's
//! process has died. New records overwrite the oldest.

use crate::atomic::{AtomicU64, Ordering, fence};

/// Number of words of a record.
pub const RECORD_WORDS: usize = 2;
/// A record.
pub type Record = [u64; RECORD_WORDS];

/// Words of a ring before its records: the number of records written so far, whether it has a writer, and its name.
const HEAD_WORDS: usize = 8;
const WRITTEN: usize = 0;
const TAKEN: usize = 1;
const NAME: usize = 2;
const NAME_BYTES: usize = (HEAD_WORDS - NAME) * 8;

/// Number of words of a ring for this many records, a power of two.
pub const fn words(records: usize) -> usize {
    HEAD_WORDS + records * RECORD_WORDS
}

/// A ring: a view of its words.
#[derive(Clone, Copy, Debug)]
pub struct Ring<'a> {
    head: &'a [AtomicU64; HEAD_WORDS],
    records: &'a [[AtomicU64; RECORD_WORDS]],
    /// The capacity less one. The capacity is a power of two.
    mask: usize,
}

/// A ring's answer for one record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lookup {
    /// The record.
    Record(Record),
    /// It has not been written yet.
    NotYet,
    /// Newer records have its place.
    Overwritten,
}

impl<'a> Ring<'a> {
    /// A ring in these words. They are zero, or already a ring of the same size.
    ///
    /// # Panics
    ///
    /// There are fewer than `words(1)`.
    pub fn new(words: &'a [AtomicU64]) -> Ring<'a> {
        let Some((head, records)) = words.split_first_chunk() else { panic!("a ring in {} words", words.len()) };
        let (records, _) = records.as_chunks();
        let capacity = 1 << records.len().ilog2();
        Ring { head, records, mask: capacity - 1 }
    }

    /// How many records it has room for. A reader finds one less, because the oldest may be half overwritten.
    pub fn capacity(self) -> usize {
        self.mask + 1
    }

    #[inline]
    fn place(self, number: u64) -> &'a [AtomicU64; RECORD_WORDS] {
        &self.records[number as usize & self.mask]
    }

    /// Writes a record. Only one thread may push. It does not allocate, lock or call the kernel. A [`Pen`] is quicker.
    #[inline]
    pub fn push(self, record: Record) {
        self.put(self.head[WRITTEN].load(Ordering::Relaxed), record);
    }

    /// Writes the record with this number, the next one.
    #[inline]
    fn put(self, number: u64, record: Record) {
        let place = self.place(number);
        // A reader that sees one of the words below also sees the count above them, from the record before.
        fence(Ordering::Release);
        place[0].store(record[0], Ordering::Relaxed);
        place[1].store(record[1], Ordering::Relaxed);
        self.head[WRITTEN].store(number + 1, Ordering::Release);
    }

    /// The number of the next record.
    pub fn next(self) -> u64 {
        self.head[WRITTEN].load(Ordering::Acquire)
    }

    /// The bytes at the place of a record. They may be half of another record.
    fn copy(self, number: u64) -> Record {
        self.place(number).each_ref().map(|word| word.load(Ordering::Relaxed))
    }

    /// The oldest record whose copies so far are all whole.
    fn oldest_whole(self) -> u64 {
        // Pairs with the fence of the writer: a reader that saw a word of record N sees a count of N or above.
        fence(Ordering::Acquire);
        let now = self.head[WRITTEN].load(Ordering::Relaxed);
        // The record `now` may be half written over the record `now - capacity`.
        (now + 1).saturating_sub(self.capacity() as u64)
    }

    /// The record with this number.
    pub fn get(self, number: u64) -> Lookup {
        if number >= self.next() {
            return Lookup::NotYet;
        }
        let record = self.copy(number);
        if number < self.oldest_whole() { Lookup::Overwritten } else { Lookup::Record(record) }
    }

    /// The newest records, the oldest of them first. A record that its writer overwrites during the read is left out.
    pub fn newest(self) -> Vec<Record> {
        let end = self.next();
        let start = end.saturating_sub(self.capacity() as u64);
        let mut copied: Vec<_> = (start..end).map(|number| self.copy(number)).collect();
        let first = self.oldest_whole().clamp(start, end);
        copied.drain(..(first - start) as usize);
        copied
    }

    /// The name of its present or last writer. Empty without one. While a writer takes the ring of another one, it may
    /// be a mixture of both names.
    pub fn name(self) -> String {
        let bytes = self.head[NAME..].iter().flat_map(|word| word.load(Ordering::Acquire).to_le_bytes());
        let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    /// A pen with this name, if nobody has one. It continues after the records of the last one.
    pub fn pen(self, name: &str) -> Option<Pen<'a>> {
        if self.head[TAKEN].swap(1, Ordering::Acquire) != 0 {
            return None;
        }
        let mut bytes = name.bytes().take(NAME_BYTES - 1);
        let mut word = || u64::from_le_bytes(std::array::from_fn(|_| bytes.next().unwrap_or(0)));
        let first = word();
        for place in &self.head[NAME + 1..] {
            place.store(word(), Ordering::Relaxed);
        }
        // The first word is written last. A reader that sees it also sees the others.
        self.head[NAME].store(first, Ordering::Release);
        Some(Pen { ring: self, at: self.head[WRITTEN].load(Ordering::Relaxed) })
    }
}

/// The one who writes a ring. It knows the number of its next record, so that writing loads nothing.
#[derive(Debug)]
pub struct Pen<'a> {
    ring: Ring<'a>,
    at: u64,
}

impl Pen<'_> {
    /// Writes a record. It does not allocate, lock or call the kernel.
    #[inline]
    pub fn push(&mut self, record: Record) {
        self.ring.put(self.at, record);
        self.at += 1;
    }
}

impl Drop for Pen<'_> {
    fn drop(&mut self) {
        self.ring.head[TAKEN].store(0, Ordering::Release);
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;
    use std::thread;

    fn zeros(records: usize) -> Box<[AtomicU64]> {
        (0..words(records)).map(|_| AtomicU64::new(0)).collect()
    }

    fn numbers(ring: Ring<'_>) -> Vec<u64> {
        ring.newest().iter().map(|[one, other]| if one == other { *one } else { panic!("{one} {other}") }).collect()
    }

    #[test]
    fn the_newest_records_are_kept() {
        let words = zeros(8);
        let ring = Ring::new(&words);
        assert!(numbers(ring).is_empty());
        assert_eq!(ring.get(0), Lookup::NotYet);
        (0..3).for_each(|number| ring.push([number; 2]));
        assert_eq!(numbers(ring), [0, 1, 2]);
        (3..21).for_each(|number| ring.push([number; 2]));
        // The oldest of eight is the one that the writer would overwrite next.
        assert_eq!(numbers(ring), (14..21).collect::<Vec<_>>());
        assert_eq!(
            [13, 14, 20, 21].map(|number| ring.get(number)),
            [Lookup::Overwritten, Lookup::Record([14; 2]), Lookup::Record([20; 2]), Lookup::NotYet]
        );
    }

    #[test]
    fn a_ring_has_one_writer_at_a_time_and_keeps_the_records_of_the_last() {
        let words = zeros(8);
        let ring = Ring::new(&words);
        let mut pen = ring.pen("spi0").unwrap();
        assert!(ring.pen("spi1").is_none());
        pen.push([1; 2]);
        drop(pen);
        assert_eq!(ring.name(), "spi0");
        let mut pen = ring.pen("a name that is longer than the room that a ring has for it").unwrap();
        assert_eq!(ring.name(), "a name that is longer than the room that a ring");
        pen.push([2; 2]);
        assert_eq!(numbers(ring), [1, 2]);
    }

    /// A reader beside a writer sees whole records in their order, however fast the writer is.
    #[test]
    fn no_record_is_torn() {
        let words = zeros(64);
        let ring = Ring::new(&words);
        let done = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut pen = ring.pen("core").unwrap();
                (0..2_000_000).for_each(|number| pen.push([number; 2]));
                drop(pen);
                // The last access: ThreadSanitizer does not see that a scope waits for its threads.
                done.store(true, Ordering::Release);
            });
            while !done.load(Ordering::Acquire) {
                let numbers = numbers(ring);
                assert!(numbers.windows(2).all(|two| two[0] + 1 == two[1]), "{numbers:?}");
                let next = ring.next();
                if let Lookup::Record(record) = ring.get(next.saturating_sub(60)) {
                    assert_eq!(record, [next.saturating_sub(60); 2]);
                }
            }
        });
    }
}
