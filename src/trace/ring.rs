// SPDX-License-Identifier: GPL-3.0-or-later
//! Rings of events in memory that several processes share. One thread writes a ring and never waits. Anybody may read
//! it at any time, even after its writer's process has died. New events overwrite the oldest.

#![forbid(unsafe_code)]

use std::sync::atomic::{AtomicU64, Ordering, fence};

use pinion_firmware::time::{Clock, Ticks};

use super::event::{EVENT_WORDS, Event};

/// How long a [`Writer`] with a quota makes its ring last at least: ten seconds, and a second more for the reader.
const LASTS: Ticks = Ticks::from_ms(11_000);
/// A quota is for this span.
pub(super) const WINDOW: Ticks = Ticks::from_ms(100);
/// Number of windows in [`LASTS`].
const WINDOWS: usize = (LASTS.0 / WINDOW.0) as usize;

/// Words of a ring before its events: the number of events written so far, whether it has a writer, and its name.
const HEAD_WORDS: usize = 8;
const WRITTEN: usize = 0;
const TAKEN: usize = 1;
const NAME: usize = 2;
const NAME_BYTES: usize = (HEAD_WORDS - NAME) * 8;

/// A ring.
#[derive(Clone, Copy)]
pub struct Ring {
    head: &'static [AtomicU64],
    events: &'static [[AtomicU64; EVENT_WORDS]],
    /// The capacity less one. The capacity is a power of two.
    mask: usize,
}

impl Ring {
    /// Number of words of a ring for this many events, a power of two.
    pub const fn words(events: usize) -> usize {
        HEAD_WORDS + events * EVENT_WORDS
    }

    /// A ring in these words. They are zero, or another process's ring of the same size.
    pub fn new(words: &'static [AtomicU64]) -> Ring {
        let (head, events) = words.split_at(HEAD_WORDS);
        let (events, _) = events.as_chunks();
        let capacity = 1 << events.len().ilog2();
        Ring { head, events, mask: capacity - 1 }
    }

    fn capacity(self) -> usize {
        self.mask + 1
    }

    #[inline]
    fn event(self, number: u64) -> &'static [AtomicU64; EVENT_WORDS] {
        &self.events[number as usize & self.mask]
    }

    /// How many events were written so far.
    pub fn written(self) -> u64 {
        self.head[WRITTEN].load(Ordering::Relaxed)
    }

    /// The name of its present or last writer. Empty without one.
    pub fn name(self) -> String {
        let bytes = self.head[NAME..].iter().flat_map(|word| word.load(Ordering::Acquire).to_le_bytes());
        let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn set_name(self, name: &str) {
        let mut bytes = name.bytes().take(NAME_BYTES - 1);
        for word in &self.head[NAME..] {
            word.store(u64::from_le_bytes(std::array::from_fn(|_| bytes.next().unwrap_or(0))), Ordering::Relaxed);
        }
    }

    /// A writer with this name, if the ring has none. Each of its events is kept until newer ones need the room.
    pub fn writer(self, name: &str) -> Option<Writer> {
        if self.head[TAKEN].swap(1, Ordering::AcqRel) != 0 {
            return None;
        }
        self.set_name(name);
        Some(Writer { ring: self, written: &self.head[WRITTEN], at: self.written(), quota: None })
    }

    /// The same with a quota: the ring lasts ten seconds. It leaves out events that come faster, and counts them.
    pub fn lasting_writer(self, name: &str) -> Option<Writer> {
        // Each window may have one more event, which tells how many were left out.
        let each = (self.capacity() / WINDOWS).saturating_sub(1).max(1);
        let quota = Quota { each: each as u32, until: Clock::from_bits(0), left: 0, omitted: 0 };
        let mut writer = self.writer(name)?;
        writer.quota = Some(quota);
        Some(writer)
    }

    /// The events, the oldest first. An event that its writer overwrites meanwhile is left out.
    pub fn events(self) -> Vec<[u64; EVENT_WORDS]> {
        let capacity = self.capacity() as u64;
        let end = self.head[WRITTEN].load(Ordering::Acquire);
        let start = end.saturating_sub(capacity);
        let copy = |number| self.event(number).each_ref().map(|word| word.load(Ordering::Relaxed));
        let mut copied: Vec<_> = (start..end).map(copy).collect();
        // Pairs with the fence of the writer: whoever saw a word of event N here sees `WRITTEN` at N or above.
        fence(Ordering::Acquire);
        let now = self.written();
        // The event `now` may be half written over the event `now - capacity`.
        let first_whole = (now + 1).saturating_sub(capacity).max(start).min(end);
        copied.drain(..(first_whole - start) as usize);
        copied
    }
}

/// The one thread that writes a ring.
pub struct Writer {
    ring: Ring,
    /// Where the ring counts its events.
    written: &'static AtomicU64,
    /// The number of the next event.
    at: u64,
    quota: Option<Quota>,
}

/// How many events may still come.
struct Quota {
    /// Number of events in a window.
    each: u32,
    /// The end of the present window.
    until: Clock,
    left: u32,
    omitted: u32,
}

impl Writer {
    /// Writes an event. It does not allocate, lock or call the kernel.
    #[inline]
    pub fn write(&mut self, at: Clock, event: Event) {
        if let Some(quota) = &mut self.quota {
            if at >= quota.until {
                let omitted = std::mem::take(&mut quota.omitted);
                (quota.left, quota.until) = (quota.each, at + WINDOW);
                if omitted > 0 {
                    self.put(at, Event::Omitted(omitted));
                }
            } else if quota.left == 0 {
                quota.omitted = quota.omitted.saturating_add(1);
                return;
            }
        }
        if let Some(quota) = &mut self.quota {
            quota.left -= 1;
        }
        self.put(at, event);
    }

    #[inline]
    fn put(&mut self, at: Clock, event: Event) {
        let words = event.encode(at);
        let place = self.ring.event(self.at);
        // A reader that sees one of the two words below also sees the count above it, from the event before.
        fence(Ordering::Release);
        place[0].store(words[0], Ordering::Relaxed);
        place[1].store(words[1], Ordering::Relaxed);
        self.at += 1;
        self.written.store(self.at, Ordering::Release);
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.ring.head[TAKEN].store(0, Ordering::Release);
    }
}

#[cfg(test)]
pub(crate) fn ring(events: usize) -> Ring {
    Ring::new(Box::leak((0..Ring::words(events)).map(|_| AtomicU64::new(0)).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;
    use std::thread;

    fn numbers(ring: Ring) -> Vec<u32> {
        let events = ring.events().into_iter().map(|words| Event::decode(words).unwrap().1);
        events.map(|event| if let Event::Block(number) = event { number } else { panic!("{event:?}") }).collect()
    }

    #[test]
    fn the_newest_events_are_kept() {
        let ring = ring(8);
        let mut writer = ring.writer("core").unwrap();
        assert!(numbers(ring).is_empty());
        for number in 0..3 {
            writer.write(Clock::from_ticks(number.into()), Event::Block(number));
        }
        assert_eq!(numbers(ring), [0, 1, 2]);
        for number in 3..21 {
            writer.write(Clock::from_ticks(number.into()), Event::Block(number));
        }
        // The oldest of eight is the one that the writer would overwrite next.
        assert_eq!(numbers(ring), (14..21).collect::<Vec<_>>());
    }

    #[test]
    fn a_ring_has_one_writer_at_a_time_and_keeps_the_events_of_the_last() {
        let ring = ring(8);
        let mut writer = ring.lasting_writer("spi0").unwrap();
        assert!(ring.writer("spi1").is_none());
        writer.write(Clock::EPOCH, Event::Block(1));
        drop(writer);
        assert_eq!(ring.name(), "spi0");
        ring.writer("a name that is longer than the room that a ring has for it").unwrap();
        assert_eq!(ring.name(), "a name that is longer than the room that a ring");
        assert_eq!(numbers(ring), [1]);
    }

    #[test]
    fn a_lasting_ring_has_the_last_ten_seconds_of_any_flood() {
        let ring = ring(16_384);
        let mut writer = ring.lasting_writer("core").unwrap();
        // 50,000 events a second, for a minute.
        let at = |number: u32| Clock::from_ticks(1000 * u64::from(number));
        for number in 0..3_000_000 {
            writer.write(at(number), Event::Block(number));
        }
        let events: Vec<(Clock, Event)> = ring.events().into_iter().filter_map(Event::decode).collect();
        let (first, _) = events[0];
        assert!(at(2_999_999).since(first) > i64::from(Ticks::from_ms(10_000).0), "{first:?}");
        // Each window begins with its events, and the next one tells how many are missing.
        let omitted: u32 =
            events.iter().map(|(_, event)| if let Event::Omitted(count) = event { *count } else { 0 }).sum();
        let kept = events.iter().filter(|(_, event)| matches!(event, Event::Block(_))).count();
        let told = kept + omitted as usize;
        let span = at(2_999_999).since(first) as usize / 1000;
        assert!(told.abs_diff(span) <= 2 * 5000, "{told} of {span}");
    }

    /// A reader beside a writer sees whole events in their order, however fast the writer is.
    #[test]
    fn no_event_is_torn() {
        let ring = ring(64);
        let done = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut writer = ring.writer("core").unwrap();
                for number in 0..2_000_000u32 {
                    writer.write(Clock::from_bits(number.into()), Event::Block(number));
                }
                done.store(true, Ordering::Release);
            });
            while !done.load(Ordering::Acquire) {
                let mut before: Option<u32> = None;
                for words in ring.events() {
                    let (at, event) = Event::decode(words).unwrap();
                    assert_eq!(event, Event::Block(at.to_bits() as u32));
                    let number = at.to_bits() as u32;
                    assert!(before.is_none_or(|before| before + 1 == number), "{before:?} {number}");
                    before = Some(number);
                }
            }
        });
    }
}
