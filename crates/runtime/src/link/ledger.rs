// SPDX-License-Identifier: GPL-3.0-or-later
//! The sequence numbers of the blocks to the host. Each says how many of the host's blocks were received and are done.
//!
//! A number acknowledges all blocks before it. So a block counts only when all blocks before it are done too. This
//! matters for blocks that the link answers at once, while the core is still busy with earlier blocks.

use std::collections::VecDeque;

/// Highest number of blocks that the link has answered and that do not count yet. klippy sends at most 12 blocks before
/// it waits for an acknowledgement (`MAX_PENDING_BLOCKS` in chelper/serialqueue.c).
const EARLY_MAX: usize = 32;

/// The account of the host's blocks. All numbers count blocks since the start and wrap around.
#[derive(Debug, Default)]
pub(crate) struct Ledger {
    /// Blocks handed to the core.
    handed: u32,
    /// How many of those blocks the core had finished when the link last looked.
    core_done: u32,
    /// The blocks that the link has answered and that do not count yet. For each: how many blocks had been handed to
    /// the core before it.
    early: VecDeque<u32>,
    /// How many of the blocks that the link has answered count.
    settled: u32,
    /// The highest number that was sent. No lower one may follow: klippy would treat it as a line error and drop the
    /// block.
    said: u32,
    /// The number of the last empty block that was sent.
    acknowledged: u32,
    /// The host does not know yet that a block was refused.
    nak_owed: bool,
}

impl Ledger {
    /// Notes that a block is handed to the core.
    pub(crate) fn hand(&mut self) {
        self.handed = self.handed.wrapping_add(1);
    }

    /// How many blocks were handed to the core.
    pub(crate) fn handed(&self) -> u32 {
        self.handed
    }

    /// Notes that a block was refused because it was out of order, or that garbage came.
    pub(crate) fn refuse(&mut self) {
        self.nak_owed = true;
    }

    /// Notes that the link answers a block itself, and returns the number of its answer. `None` if too many of these
    /// blocks do not count yet. Then this block has to go to the core too.
    ///
    /// `core_done` is how many blocks the core has finished. All responses to them must have gone through
    /// [`Ledger::respond`] before. Otherwise they would get too high a number.
    pub(crate) fn answer(&mut self, core_done: u32) -> Option<u32> {
        self.settle(core_done);
        if self.early.len() >= EARLY_MAX {
            return None;
        }
        self.early.push_back(self.handed);
        self.settle(core_done);
        Some(self.say(self.done()))
    }

    /// The number of a response of the core. The core had begun `core_begun` blocks when it sent the response. The
    /// number is the one just after the block that it was running.
    pub(crate) fn respond(&mut self, core_begun: u32) -> u32 {
        self.settle(core_begun.wrapping_sub(1));
        self.say(core_begun.wrapping_add(self.settled))
    }

    /// The numbers of the empty blocks to send now. The core has finished `core_done` blocks; the condition in
    /// [`Ledger::answer`] holds here too.
    ///
    /// The first number acknowledges the blocks that were finished since the last empty block. The second is a NAK: the
    /// host takes an empty block that repeats the last number as a NAK. So it is sent only if a block was refused, and
    /// only when all blocks before that one are done.
    pub(crate) fn acknowledge(&mut self, core_done: u32) -> [Option<u32>; 2] {
        self.settle(core_done);
        let done = self.done();
        // A response to the block that the core is running may have carried a higher number already. Then no
        // acknowledgement is needed.
        let news = done != self.acknowledged && !is_after(self.said, done);
        self.acknowledged = done;
        let all_done = self.core_done == self.handed;
        let nak = all_done && std::mem::take(&mut self.nak_owed);
        [news.then(|| self.say(done)), nak.then_some(done)]
    }

    /// Whether the core is done with more blocks than at the last [`Ledger::acknowledge`].
    pub(crate) fn is_behind(&self, core_done: u32) -> bool {
        is_after(core_done, self.core_done) || self.done() != self.acknowledged
    }

    /// How many blocks count: these blocks and all before them are done.
    fn done(&self) -> u32 {
        self.core_done.wrapping_add(self.settled)
    }

    /// Notes how many blocks the core has finished. It counts the blocks that the link has answered, as far as all
    /// blocks before them are done.
    fn settle(&mut self, core_done: u32) {
        if is_after(core_done, self.core_done) {
            self.core_done = core_done;
        }
        while self.early.front().is_some_and(|handed| !is_after(*handed, self.core_done)) {
            self.early.pop_front();
            self.settled = self.settled.wrapping_add(1);
        }
    }

    fn say(&mut self, number: u32) -> u32 {
        if is_after(number, self.said) {
            self.said = number;
        }
        self.said
    }
}

/// Whether `number` is beyond `other`, for numbers less than 2^31 apart.
pub(crate) fn is_after(number: u32, other: u32) -> bool {
    number.wrapping_sub(other) as i32 > 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The steps of link and core, in any order.
    #[derive(Clone, Copy, Debug)]
    enum Event {
        /// A block for the core comes.
        Command,
        /// A block that the link can answer comes.
        Query,
        /// A block is refused.
        Refused,
        /// The core begins a block, or continues its present one.
        Begin,
        /// The core sends a response, for its block or from a timer.
        Respond,
        /// The core is done with its block.
        Finish,
        /// The link reads how far the core is.
        Look,
        /// The link frames the core's responses, and acknowledges the finished blocks that it saw.
        GiveOut,
    }

    /// The same account kept the slow way: a list of blocks, each done or not.
    #[derive(Default)]
    struct Model {
        /// Whether each block was answered by the link.
        blocks: Vec<bool>,
        /// How many blocks the core has begun, and how many it has finished.
        begun: usize,
        done: usize,
        /// The core's responses, each as the number of blocks begun at that time.
        responses: VecDeque<usize>,
        /// How many blocks the link saw done.
        seen: usize,
        sent: usize,
        refused: bool,
    }

    impl Model {
        fn handed(&self) -> usize {
            self.blocks.iter().filter(|early| !**early).count()
        }

        /// How many leading blocks are done when the core has finished `core_done` of its own.
        fn leading(&self, mut core_done: usize) -> usize {
            let is_done = |early: &&bool| {
                let done = **early || core_done > 0;
                core_done -= usize::from(done && !**early);
                done
            };
            self.blocks.iter().take_while(is_done).count()
        }

        /// The number just after block `core_begun` of the core, counted from 1.
        fn just_after(&self, core_begun: usize) -> usize {
            let mut own = (1..).zip(&self.blocks).filter(|(_, early)| !**early);
            core_begun.checked_sub(1).map_or(0, |before| own.nth(before).unwrap().0)
        }
    }

    fn events() -> impl Strategy<Value = Vec<Event>> {
        let event = prop_oneof![
            3 => Just(Event::Command),
            3 => Just(Event::Query),
            1 => Just(Event::Refused),
            3 => Just(Event::Begin),
            2 => Just(Event::Respond),
            3 => Just(Event::Finish),
            2 => Just(Event::Look),
            2 => Just(Event::GiveOut),
        ];
        proptest::collection::vec(event, 0..300)
    }

    /// A counter of the core that began at `start`, after `count` blocks.
    fn after(start: u32, count: usize) -> u32 {
        start.wrapping_add(count as u32)
    }

    fn give_out(model: &mut Model, ledger: &mut Ledger, start: u32) -> Result<(), TestCaseError> {
        while let Some(begun) = model.responses.pop_front() {
            let number = ledger.respond(after(start, begun)).wrapping_sub(start) as usize;
            let own = model.just_after(begun);
            model.seen = model.seen.max(begun.saturating_sub(1));
            prop_assert_eq!(number, own.max(model.sent));
            // If the number had to be raised above that, the link answered all blocks in between. So the number
            // acknowledges no block that the core still has.
            prop_assert!(model.blocks[own..number].iter().all(|early| *early));
            model.sent = number;
        }
        Ok(())
    }

    proptest! {
        #[test]
        fn numbers_are_those_of_a_list_of_blocks(events in events(), start: u32) {
            let mut model = Model::default();
            let mut ledger = Ledger { handed: start, core_done: start, said: start, acknowledged: start, ..Ledger::default() };
            let mut acknowledged = 0;
            for event in events {
                match event {
                    Event::Command => {
                        model.blocks.push(false);
                        ledger.hand();
                    }
                    Event::Query => {
                        model.seen = model.done;
                        give_out(&mut model, &mut ledger, start)?;
                        match ledger.answer(after(start, model.seen)) {
                            Some(number) => {
                                model.blocks.push(true);
                                model.sent = model.sent.max(model.leading(model.seen));
                                prop_assert_eq!(number.wrapping_sub(start) as usize, model.sent);
                            }
                            None => {
                                let ahead = model.blocks[model.leading(model.seen)..].iter().filter(|early| **early);
                                prop_assert_eq!(ahead.count(), EARLY_MAX);
                                model.blocks.push(false);
                                ledger.hand();
                            }
                        }
                    }
                    Event::Refused => {
                        model.refused = true;
                        ledger.refuse();
                    }
                    Event::Begin => model.begun = (model.done + 1).min(model.handed()),
                    Event::Respond => model.responses.push_back(model.begun),
                    Event::Finish => model.done = model.begun,
                    Event::Look => model.seen = model.done,
                    Event::GiveOut => {
                        give_out(&mut model, &mut ledger, start)?;
                        let leading = model.leading(model.seen);
                        prop_assert_eq!(ledger.is_behind(after(start, model.seen)), leading != acknowledged);
                        let sent = ledger.acknowledge(after(start, model.seen));
                        let [ack, nak] = sent.map(|number| number.map(|number| number.wrapping_sub(start) as usize));
                        let news = leading != acknowledged && leading >= model.sent;
                        prop_assert_eq!(ack, news.then_some(leading));
                        acknowledged = leading;
                        model.sent = model.sent.max(leading);
                        let owed = model.refused && leading == model.blocks.len();
                        prop_assert_eq!(nak, owed.then_some(leading));
                        model.refused &= !owed;
                    }
                }
                prop_assert!(ledger.early.len() <= EARLY_MAX);
                prop_assert!(model.sent <= model.blocks.len());
            }
        }
    }

    #[test]
    fn an_answer_ahead_of_a_slow_bus_is_counted_once_the_bus_is_done() {
        let mut ledger = Ledger::default();
        ledger.hand();
        assert_eq!(ledger.answer(0), Some(0), "the transfer before it is not done");
        assert_eq!(ledger.acknowledge(0), [None, None]);
        // The number of the answer to the transfer does not acknowledge the query behind it.
        assert_eq!(ledger.respond(1), 1);
        assert_eq!(ledger.acknowledge(1), [Some(2), None]);
    }

    #[test]
    fn no_host_makes_the_account_grow_without_end() {
        let mut ledger = Ledger::default();
        ledger.hand();
        let answered = (0..1000).filter(|_| ledger.answer(0).is_some()).count();
        assert_eq!((answered, ledger.early.len()), (EARLY_MAX, EARLY_MAX));
        assert_eq!(ledger.acknowledge(1), [Some(1 + EARLY_MAX as u32), None]);
    }

    #[test]
    fn blocks_that_klippy_sends_again_beside_a_slow_bus_are_answered_by_one_nak() {
        let mut ledger = Ledger::default();
        ledger.hand();
        for _ in 0..100 {
            ledger.refuse();
            assert_eq!(ledger.acknowledge(0), [None, None]);
        }
        assert_eq!(ledger.acknowledge(1), [Some(1), Some(1)]);
        assert_eq!(ledger.acknowledge(1), [None, None]);
    }
}
