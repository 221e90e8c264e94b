// SPDX-License-Identifier: GPL-3.0-or-later
//! Writing events into a ring, all of them or with a quota.

use pinion_firmware::time::{Clock, Ticks};
use pinion_shm::ring::{Pen, Ring};

use super::event::Event;

/// How long a [`Writer`] with a quota makes its ring last at least: ten seconds, and a second more for the reader.
const LASTS: Ticks = Ticks::from_ms(11_000);
/// A quota is for this span.
pub(super) const WINDOW: Ticks = Ticks::from_ms(100);
/// Number of windows in [`LASTS`].
const WINDOWS: usize = (LASTS.0 / WINDOW.0) as usize;

/// The one thread that writes a ring.
pub struct Writer {
    pen: Pen<'static>,
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
    /// A writer with this name, if the ring has none. Each of its events is kept until newer ones need the room.
    pub fn new(ring: Ring<'static>, name: &str) -> Option<Writer> {
        Some(Writer { pen: ring.pen(name)?, quota: None })
    }

    /// The same with a quota: the ring lasts ten seconds. It leaves out events that come faster, and counts them.
    pub fn lasting(ring: Ring<'static>, name: &str) -> Option<Writer> {
        // Each window may have one more event, the number of omitted events.
        let each = (ring.capacity() / WINDOWS).saturating_sub(1).max(1);
        let quota = Quota { each: each as u32, until: Clock::from_bits(0), left: 0, omitted: 0 };
        let mut writer = Writer::new(ring, name)?;
        writer.quota = Some(quota);
        Some(writer)
    }

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
        self.pen.push(event.encode(at));
    }
}

#[cfg(test)]
fn ring(events: usize) -> Ring<'static> {
    let words = pinion_shm::ring::words(events);
    Ring::new(Box::leak((0..words).map(|_| std::sync::atomic::AtomicU64::new(0)).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lasting_ring_has_the_last_ten_seconds_of_any_flood() {
        let ring = ring(16_384);
        let mut writer = Writer::lasting(ring, "core").unwrap();
        // 50,000 events a second, for a minute.
        let at = |number: u32| Clock::from_ticks(1000 * u64::from(number));
        for number in 0..3_000_000 {
            writer.write(at(number), Event::Block(number));
        }
        let events: Vec<(Clock, Event)> = ring.newest().into_iter().filter_map(Event::decode).collect();
        let (first, _) = events[0];
        assert!(at(2_999_999).since(first) > i64::from(Ticks::from_ms(10_000).0), "{first:?}");
        // Each window begins with its events, and the next one has the number of missing events.
        let omitted: u32 =
            events.iter().map(|(_, event)| if let Event::Omitted(count) = event { *count } else { 0 }).sum();
        let kept = events.iter().filter(|(_, event)| matches!(event, Event::Block(_))).count();
        let counted = kept + omitted as usize;
        let span = at(2_999_999).since(first) as usize / 1000;
        assert!(counted.abs_diff(span) <= 2 * 5000, "{counted} of {span}");
    }
}
