// SPDX-License-Identifier: GPL-3.0-or-later
//! The memory of a recording: a ring for each thread, and the names that the events' numbers stand for. The program and
//! the guardian share it, so that the guardian has it when the program is gone.

use std::io;
use std::iter;
use std::sync::atomic::{AtomicU64, Ordering};

use log::debug;

use pinion_linux::sys;
use pinion_shm::ring::{self, Ring};
use pinion_shm::seqlock::{self, Seqlock};

use pinion_trace::event::Watched;
use pinion_trace::file::Names;
use pinion_trace::ring::Writer;

/// Numbers of events of the rings. The lasting ones hold the last ten seconds (`Writer::lasting`).
const SIZES: [usize; RINGS] = {
    let mut sizes = [1 << 14; RINGS];
    sizes[CORE_RECENT] = 1 << 16;
    sizes[LINK] = 1 << 16;
    sizes[EDGES] = 1 << 17;
    sizes[SAMPLER] = 1 << 11;
    sizes[GUARDIAN] = 1 << 11;
    sizes
};
/// The last events of the core.
const CORE_RECENT: usize = 0;
/// The important events of the core.
const CORE: usize = 1;
const LINK: usize = 2;
const SAMPLER: usize = 3;
const GUARDIAN: usize = 4;
const EDGES: usize = 5;
/// The first worker.
const WORKERS: usize = 6;
/// Highest number of workers that record.
const WORKERS_MAX: usize = 24;
const RINGS: usize = WORKERS + WORKERS_MAX;

/// Bytes for the names.
const NAMES_BYTES: usize = 1 << 16;
/// Words of the names: their length in bytes, and the bytes.
const NAMES_WORDS: usize = 1 + NAMES_BYTES / 8;
/// Words before the rings. A program that is killed while it stores new names leaves the present ones.
const HEAD_WORDS: usize = seqlock::words(NAMES_WORDS);
/// Words of a page. A store to one of them makes the kernel provide the page.
const PAGE_WORDS: usize = 4096 / 8;

/// The first word of a ring.
const fn start(ring: usize) -> usize {
    let (mut at, mut before) = (HEAD_WORDS, 0);
    while before < ring {
        at += ring::words(SIZES[before]);
        before += 1;
    }
    at
}

/// The memory.
#[derive(Clone, Copy)]
pub(super) struct Memory(&'static [AtomicU64]);

impl Memory {
    pub(super) fn new() -> io::Result<Memory> {
        Ok(Memory(sys::shared_memory(start(RINGS))?))
    }

    /// Has the kernel provide the pages that the core and the link write. A page that is touched first takes
    /// microseconds.
    pub(super) fn touch(self) {
        for word in self.0[..start(SAMPLER)].iter().step_by(PAGE_WORDS) {
            word.fetch_add(0, Ordering::Relaxed);
        }
    }

    /// Highest number of bytes that it takes.
    pub(super) fn bytes(self) -> usize {
        size_of_val(self.0)
    }

    fn ring(self, ring: usize) -> Ring<'static> {
        Ring::new(&self.0[start(ring)..start(ring + 1)])
    }

    /// The ring with the important events of a thread.
    pub(super) fn thread(self, thread: Watched) -> Ring<'static> {
        self.ring(match thread {
            Watched::Core => CORE,
            Watched::Link => LINK,
        })
    }

    /// The core's writers: of all its events, and of the important ones.
    pub(super) fn core(self) -> Option<(Writer, Writer)> {
        Some((Writer::new(self.ring(CORE_RECENT), "core")?, Writer::lasting(self.ring(CORE), "core")?))
    }

    pub(super) fn link(self) -> Option<Writer> {
        Writer::lasting(self.ring(LINK), "link")
    }

    pub(super) fn sampler(self) -> Option<Writer> {
        Writer::lasting(self.ring(SAMPLER), "sampler")
    }

    pub(super) fn guardian(self) -> Option<Writer> {
        Writer::lasting(self.ring(GUARDIAN), "guardian")
    }

    /// The writer of changes of outputs. They need room only if they are asked for.
    pub(super) fn edges(self) -> Option<Writer> {
        Writer::new(self.ring(EDGES), "edges")
    }

    /// The writer of a worker. A bus gets its earlier ring again. `None`: all rings are in use, and this worker's
    /// jobs are not recorded.
    pub(super) fn worker(self, bus: &str) -> Option<Writer> {
        let rings = || (WORKERS..RINGS).map(|ring| self.ring(ring));
        let (own, unused) = (rings().filter(|ring| ring.name() == bus), rings().filter(|ring| ring.name().is_empty()));
        let writer = own.chain(unused).chain(rings()).find_map(|ring| Writer::lasting(ring, bus));
        if writer.is_none() {
            debug!("the jobs of {bus} are not recorded: there is room for {WORKERS_MAX} buses");
        }
        writer
    }

    /// All rings that somebody has written.
    pub(super) fn rings(self) -> impl Iterator<Item = Ring<'static>> {
        (0..RINGS).map(move |ring| self.ring(ring)).filter(|ring| !ring.name().is_empty())
    }

    /// Keeps the names, as many as there is room for. Only one thread calls this.
    pub(super) fn set_names(self, names: &Names) {
        let json = [serde_json::to_string(names), serde_json::to_string(&Names::default())];
        let Some(json) = json.into_iter().flatten().find(|json| json.len() <= NAMES_BYTES) else { return };
        let word = |bytes: &[u8]| bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte));
        let words = json.as_bytes().chunks(8).map(word);
        self.kept_names().store(iter::once(json.len() as u64).chain(words));
    }

    fn kept_names(self) -> Seqlock {
        Seqlock::new(&self.0[..HEAD_WORDS])
    }

    pub(super) fn names(self) -> Names {
        let json: Vec<u8> = self.kept_names().load(|words| {
            let length = words.next().unwrap_or(0) as usize;
            words.flat_map(u64::to_le_bytes).take(length).collect()
        });
        serde_json::from_slice(&json).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::time::Clock;
    use pinion_trace::event::Event;

    #[test]
    fn each_thread_has_a_ring_of_its_own() {
        let memory = Memory::new().unwrap();
        memory.touch();
        assert_eq!(memory.rings().count(), 0);
        let (mut recent, mut lasting) = memory.core().unwrap();
        assert!(memory.core().is_none());
        let others = [memory.link(), memory.sampler(), memory.guardian(), memory.edges()];
        for writer in
            [&mut recent, &mut lasting].into_iter().chain(others.into_iter().flatten().collect::<Vec<_>>().iter_mut())
        {
            writer.write(Clock::EPOCH, Event::Held);
        }
        let names: Vec<String> = memory.rings().map(|ring| ring.name()).collect();
        assert_eq!(names, ["core", "core", "link", "sampler", "guardian", "edges"]);
        assert!(memory.rings().all(|ring| ring.newest().len() == 1));
    }

    #[test]
    fn a_bus_gets_its_ring_again_and_a_bus_too_many_gets_none() {
        let memory = Memory::new().unwrap();
        let mut first = memory.worker("spi0").unwrap();
        first.write(Clock::EPOCH, Event::Held);
        // One that hangs still has its ring.
        let second = memory.worker("spi0").unwrap();
        assert_eq!(memory.rings().count(), 2);
        drop((first, second));
        let again = memory.worker("spi0").unwrap();
        assert_eq!(memory.rings().next().unwrap().newest().len(), 1);
        let others: Vec<Writer> = (1..WORKERS_MAX).map(|bus| memory.worker(&format!("i2c{bus}")).unwrap()).collect();
        assert!(memory.worker("one more").is_none());
        drop((again, others));
        assert!(memory.worker("one more").is_some());
    }

    #[test]
    fn names_are_kept_as_far_as_there_is_room() {
        let memory = Memory::new().unwrap();
        assert_eq!(memory.names(), Names::default());
        let names = Names { objects: [(3, "stepper oid 3 (gpio17)".to_owned())].into(), ..Names::default() };
        memory.set_names(&names);
        assert_eq!(memory.names(), names);
        memory.set_names(&Names { objects: [(3, "x".repeat(NAMES_BYTES))].into(), ..Names::default() });
        assert_eq!(memory.names(), Names::default());
    }
}
