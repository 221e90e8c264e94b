// SPDX-License-Identifier: GPL-3.0-or-later
//! The move queue: a fixed number of moves, shared by all objects that queue something.

use std::collections::VecDeque;

use crate::shutdown::{Shutdown, reason};

/// Number of moves (`move_count`), as in Klipper's C on Linux.
pub const MOVE_COUNT: u16 = 1024;

/// Counts the free moves. There are none before `finalize_config`.
#[derive(Debug, Default)]
pub struct MovePool {
    free: u16,
    count: u16,
}

impl MovePool {
    pub(super) fn finalize(&mut self) {
        self.count = MOVE_COUNT;
        self.free = MOVE_COUNT;
    }

    /// How many moves there are.
    pub(super) fn count(&self) -> u16 {
        self.count
    }

    /// How many moves are queued, and how many there are in all.
    pub(super) fn used(&self) -> (u16, u16) {
        (self.count - self.free, self.count)
    }
}

/// One object's queued moves. It never holds more moves than the pool has. So it allocates only when it is created.
#[derive(Debug)]
pub struct MoveQueue<T>(VecDeque<T>);

impl<T> Default for MoveQueue<T> {
    fn default() -> MoveQueue<T> {
        MoveQueue(VecDeque::with_capacity(usize::from(MOVE_COUNT)))
    }
}

impl<T> MoveQueue<T> {
    /// Appends a move. It fails if no move is free.
    #[inline]
    pub fn push(&mut self, pool: &mut MovePool, item: T) -> Result<(), Shutdown> {
        pool.free = pool.free.checked_sub(1).ok_or_else(|| overflow(pool.count))?;
        self.0.push_back(item);
        Ok(())
    }

    /// Takes the oldest move and frees its place.
    #[inline]
    pub fn pop(&mut self, pool: &mut MovePool) -> Option<T> {
        let item = self.0.pop_front()?;
        pool.free += 1;
        Some(item)
    }

    /// The oldest move.
    pub fn first(&self) -> Option<&T> {
        self.0.front()
    }

    /// How many moves are queued.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether nothing is queued.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Removes all moves and frees their places.
    pub fn clear(&mut self, pool: &mut MovePool) {
        pool.free += self.0.len() as u16;
        self.0.clear();
    }
}

#[cold]
fn overflow(count: u16) -> Shutdown {
    Shutdown::by_host(reason::MOVE_QUEUE_OVERFLOW, format_args!("more than the {count} moves of move_count are queued"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_queues_share_one_pool() {
        let mut pool = MovePool::default();
        let (mut a, mut b) = (MoveQueue::default(), MoveQueue::default());
        assert_eq!(a.push(&mut pool, 0).unwrap_err().reason, reason::MOVE_QUEUE_OVERFLOW);
        pool.finalize();
        for i in 0..MOVE_COUNT - 1 {
            a.push(&mut pool, i).unwrap();
        }
        b.push(&mut pool, 7).unwrap();
        assert_eq!(b.push(&mut pool, 8).unwrap_err().reason, reason::MOVE_QUEUE_OVERFLOW);
        assert_eq!(a.pop(&mut pool), Some(0));
        b.push(&mut pool, 8).unwrap();
        a.clear(&mut pool);
        assert_eq!(pool.free, MOVE_COUNT - 2);
    }
}
