// SPDX-License-Identifier: GPL-3.0-or-later
//! Heartbeats in words that processes share. A beat is the time at which it was given, as a stamp: a count that wraps.

use crate::atomic::{AtomicU32, Ordering};

// The words of a heartbeat.
/// When the last beat was given.
const BEAT_AT: usize = 0;
/// Longest time until the next beat.
const SILENCE_MAX_MS: usize = 1;
/// Whether a pending shutdown value stops the heartbeat.
const PENDING: usize = 2;
/// The name of the output with that value: a text.
const SUBJECT: usize = 3;

/// A heartbeat. One thread beats, and any thread listens.
#[derive(Clone, Copy, Debug)]
pub struct SharedHeartbeat<'a>(&'a [AtomicU32]);

/// The state that a monitor reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LastBeat {
    /// How long the next beat may take. `None`: a shutdown value is pending.
    pub silence_max_ms: Option<u32>,
    /// When its last beat was. It is at least as new as the limit.
    pub beat_at: u32,
}

impl<'a> SharedHeartbeat<'a> {
    /// A view of these words, more than three.
    pub fn new(words: &'a [AtomicU32]) -> SharedHeartbeat<'a> {
        SharedHeartbeat(words)
    }

    /// Beats. The next beat comes before `silence_max_ms` are over. While a shutdown value is pending, no beat counts.
    #[inline]
    pub fn beat(self, at: u32, silence_max_ms: u32) {
        if self.0[PENDING].load(Ordering::Relaxed) == 0 {
            self.0[BEAT_AT].store(at, Ordering::Relaxed);
        }
        // A listener that reads this limit also reads this beat, and no older one.
        self.0[SILENCE_MAX_MS].store(silence_max_ms, Ordering::Release);
    }

    /// When the last beat was, for the thread that beats.
    #[inline]
    pub fn own_beat(self) -> u32 {
        self.0[BEAT_AT].load(Ordering::Relaxed)
    }

    /// The limit of that beat, for the thread that beats.
    pub fn own_limit_ms(self) -> u32 {
        self.0[SILENCE_MAX_MS].load(Ordering::Relaxed)
    }

    /// From now on the shutdown value of `subject` is pending. The first call is a beat, and a further one only replaces
    /// the subject. It does not allocate. Only the thread that beats calls this.
    pub fn set_pending(self, subject: &str, at: u32) {
        if self.0[PENDING].load(Ordering::Relaxed) == 0 {
            self.0[BEAT_AT].store(at, Ordering::Relaxed);
        }
        self.subject().set(subject);
        self.0[PENDING].store(1, Ordering::Release);
    }

    /// No shutdown value is pending any more. This is a beat. Only the thread that beats calls this.
    pub fn clear_pending(self, at: u32) {
        self.0[BEAT_AT].store(at, Ordering::Relaxed);
        // A listener that no longer sees the pending value also reads this beat. The last one may be as old as the pending
        // value, and too old for the limit without one.
        self.0[PENDING].store(0, Ordering::Release);
    }

    /// The present state.
    pub fn listen(self) -> LastBeat {
        // The beat is read last.
        let silence_max_ms = match self.0[PENDING].load(Ordering::Acquire) {
            0 => Some(self.0[SILENCE_MAX_MS].load(Ordering::Acquire)),
            _ => None,
        };
        LastBeat { silence_max_ms, beat_at: self.0[BEAT_AT].load(Ordering::Relaxed) }
    }

    /// Its pending shutdown value.
    pub fn subject(self) -> Text<'a> {
        Text(&self.0[SUBJECT..])
    }
}

/// Words that hold a text, or as much of it as fits. One thread sets it.
#[derive(Clone, Copy, Debug)]
pub struct Text<'a>(&'a [AtomicU32]);

impl Text<'_> {
    /// Whether there is one.
    pub fn is_set(self) -> bool {
        self.0[0].load(Ordering::Acquire) != 0
    }

    /// Does not allocate.
    pub fn set(self, text: &str) {
        let mut bytes = text.bytes();
        let mut word = || u32::from_le_bytes(std::array::from_fn(|_| bytes.next().unwrap_or(0)));
        let first = word();
        for place in &self.0[1..] {
            place.store(word(), Ordering::Relaxed);
        }
        // The first word is written last, because `is_set` looks at it. A reader that sees it also sees the others.
        self.0[0].store(first, Ordering::Release);
    }

    /// The text. While it is replaced by another one, it may be a mixture of both.
    pub fn get(self) -> String {
        let bytes = self.0.iter().flat_map(|word| word.load(Ordering::Acquire).to_le_bytes());
        let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

/// Words that show since when a worker is at its present job (0 without one), and the worker's name.
#[derive(Clone, Copy, Debug)]
pub struct WorkerSlot<'a>(&'a [AtomicU32]);

impl<'a> WorkerSlot<'a> {
    /// A view of these words, more than one.
    pub fn new(words: &'a [AtomicU32]) -> WorkerSlot<'a> {
        WorkerSlot(words)
    }

    /// A slot without a name is free. Only one thread gives slots to workers.
    pub fn name(self) -> Text<'a> {
        Text(&self.0[1..])
    }

    /// The worker begins a job. Only the worker calls this.
    pub fn begin(self, at: u32) {
        self.0[0].store(at.max(1), Ordering::Relaxed);
    }

    /// The worker has ended its job. Only the worker calls this.
    pub fn end(self) {
        self.0[0].store(0, Ordering::Relaxed);
    }

    /// The worker has ended. The next worker in this slot is at no job.
    pub fn free(self) {
        self.end();
        self.name().set("");
    }

    /// The start of the present job, if the slot has a worker.
    pub fn busy_since(self) -> Option<u32> {
        if !self.name().is_set() {
            return None;
        }
        Some(self.0[0].load(Ordering::Relaxed)).filter(|since| *since != 0)
    }
}
