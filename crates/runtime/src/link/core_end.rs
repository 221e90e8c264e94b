// SPDX-License-Identifier: GPL-3.0-or-later
//! The link's end of the core. Blocks and requests go in. Responses and log lines come out. It keeps an account of the
//! blocks.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use log::log;
use rtrb::{Producer, PushError};

use pinion_firmware::mcu::base::Config;
use pinion_linux::clock::monotonic;
use pinion_linux::parker::Parker;
use pinion_shm::progress::Progress;

use crate::core::responses::{LinkWake, ResponseReader};
use crate::core::{Payload, Request};
use crate::link::ledger::{Ledger, is_after};

/// How long to poll until the core has finished the blocks that it was handed.
const AWAIT_CORE: Duration = Duration::from_micros(100);
/// How long to wait for more once there is news for the host: one write covers many blocks.
const AWAIT_MORE: Duration = Duration::from_micros(20);
/// How long to wait for a core that has no room for requests.
pub(crate) const STALL: Duration = Duration::from_millis(1);
/// Room in the core's ring that blocks leave to requests. A stop request must find room while a slow bus holds the
/// blocks back.
const REQUESTS_KEPT: usize = 8;

/// The link's end of the core.
pub(crate) struct CoreEnd {
    pub(crate) requests: Producer<Request>,
    /// Wakes the core.
    pub(crate) parker: Arc<Parker>,
    pub(crate) reader: ResponseReader,
    pub(crate) progress: Arc<Progress>,
    pub(crate) wake: Arc<LinkWake>,
    pub(crate) ledger: Ledger,
    /// How many blocks the core had been handed at the last request of another kind.
    pub(crate) asked_at: Option<u32>,
    /// There is a processor beside the core's, on which the link may poll for the core.
    pub(crate) may_poll: bool,
}

/// How many blocks and requests the core had been handed at an instant.
#[derive(Clone, Copy)]
pub(crate) struct Handed {
    blocks: u32,
    stops: u32,
}

impl CoreEnd {
    /// Passes a request to the core. The core takes requests faster than a person or a signal makes them.
    pub(crate) fn request(&mut self, request: Request) {
        if matches!(request, Request::Shutdown(_) | Request::Quit(_)) {
            self.progress.stop_handed();
        }
        self.asked_at = Some(self.ledger.handed());
        let mut request = request;
        while let Err(PushError::Full(back)) = self.requests.push(request) {
            request = back;
            self.parker.unpark();
            thread::sleep(STALL);
        }
        self.parker.unpark();
    }

    /// Whether there is room for another block.
    pub(crate) fn has_room(&self) -> bool {
        self.requests.slots() > REQUESTS_KEPT
    }

    /// Hands a block to the core, if there is room. `stops`: the block asks for an emergency stop.
    pub(crate) fn hand(&mut self, payload: Payload, stops: bool) {
        if stops {
            self.progress.stop_handed();
        }
        let _ = self.requests.push(Request::Run(payload));
        self.ledger.hand();
    }

    /// The answer to `get_config`, if the core has nothing to do before it. `core_done` as in [`Ledger::answer`].
    pub(crate) fn config(&self, core_done: u32) -> Option<Config> {
        let is_idle = core_done == self.ledger.handed() && self.asked_at.is_none_or(|at| is_after(core_done, at));
        Config::of_word(self.progress.published()).filter(|_| is_idle)
    }

    /// The blocks that the core has got so far.
    pub(crate) fn handed(&self) -> Handed {
        Handed { blocks: self.ledger.handed(), stops: self.progress.stops_handed() }
    }

    /// Whether blocks were handed to the core since `before`.
    pub(crate) fn has_more_since(&self, before: Handed) -> bool {
        self.ledger.handed() != before.blocks
    }

    /// Wakes the core for the blocks that it was handed since `before`, if it can run one of them. A core that is woken
    /// without need keeps the link waiting.
    pub(crate) fn wake_for(&self, before: Handed) {
        let stops = self.progress.stops_handed() != before.stops;
        if self.has_more_since(before) && (stops || !self.progress.is_held()) {
            self.parker.unpark();
        }
    }

    /// Polls until the core has finished the blocks that it was handed since `before`: polling takes less time than
    /// sleeping and waking. It does not poll while a bus holds the core, which takes far longer.
    pub(crate) fn await_done(&self, before: Handed) {
        if !self.may_poll || !self.has_more_since(before) {
            return;
        }
        let handed = self.ledger.handed();
        let (start, mut done) = (monotonic(), self.progress.done());
        if self.progress.is_held() {
            return;
        }
        let (mut is_answering, mut until) = (false, start + AWAIT_CORE);
        while done != handed {
            let (now, done_now) = (monotonic(), self.progress.done());
            let progresses = done_now != done || !is_answering && self.reader.has_response();
            done = done_now;
            if progresses {
                is_answering = true;
                until = (start + AWAIT_CORE).min(now + AWAIT_MORE);
            }
            if now >= until {
                return;
            }
            thread::yield_now();
        }
    }

    /// Whether there is news for the host: responses or acknowledgements.
    pub(crate) fn has_news(&self) -> bool {
        self.reader.has_response() || self.ledger.is_behind(self.progress.done())
    }

    /// Logs the core's lines.
    pub(crate) fn log_lines(&mut self) {
        while let Some((level, line, kind)) = self.reader.line() {
            log!(target: line.get(..kind).unwrap_or_default(), level, "{line}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::responses::ResponseWriter;
    use crate::core::responses::response_ring;
    use pinion_firmware::mcu::Outbox as _;
    use proptest::prelude::*;
    use rtrb::{Consumer, RingBuffer};

    /// Both ends, without threads.
    fn ends() -> (CoreEnd, ResponseWriter, Consumer<Request>) {
        let (wake, progress) = (Arc::new(LinkWake::new().unwrap()), Arc::new(Progress::default()));
        let (response_ring, reader) = response_ring(wake.clone(), progress.clone());
        let (requests, inbox) = RingBuffer::new(512);
        let (parker, ledger) = (Arc::default(), Ledger::default());
        let end = CoreEnd { requests, parker, reader, progress, wake, ledger, asked_at: None, may_poll: false };
        (end, response_ring, inbox)
    }

    #[test]
    fn a_response_is_news_and_so_is_a_finished_block() {
        let (mut end, mut response_ring, _inbox) = ends();
        let progress = end.progress.clone();
        assert!(!end.has_news());
        end.hand(Payload::new(b""), false);
        progress.begin();
        assert!(!end.has_news(), "the block is under way");
        progress.finish();
        assert!(end.has_news(), "the host waits for its acknowledgement");
        let done = progress.done();
        end.ledger.acknowledge(done);
        assert!(!end.has_news());
        response_ring.send(b"response");
        assert!(end.has_news());
    }

    /// The steps of link and core, in any order.
    #[derive(Clone, Copy, Debug)]
    enum Event {
        /// The link hands over a block.
        Block,
        /// The link hands over another request.
        Request,
        /// The core takes the next request, and its state changes.
        Take,
        /// The core finishes its block.
        Finish,
        /// A timer stops the MCU. The host does not know yet.
        Stop,
        /// The core sends a response.
        Respond,
        /// A `get_config` comes.
        Ask,
    }

    /// The core, whose state is a number that grows.
    struct Model {
        response_ring: ResponseWriter,
        inbox: Consumer<Request>,
        state: u32,
        is_busy: bool,
        /// A stop has not been reported.
        owes_report: bool,
    }

    impl Model {
        fn respond(&mut self) {
            self.owes_report = false;
            self.response_ring.send(&self.state.to_le_bytes());
        }

        /// The core does nothing else between a stop and its report.
        fn report(&mut self) {
            if self.owes_report {
                self.respond();
            }
        }
    }

    fn config(state: u32) -> Config {
        Config::of_word(1 << 63 | u64::from(state)).unwrap()
    }

    proptest! {
        #[test]
        fn the_link_answers_get_config_in_its_order(events in proptest::collection::vec(
            prop_oneof![
                Just(Event::Block), Just(Event::Request), Just(Event::Take), Just(Event::Finish), Just(Event::Stop),
                Just(Event::Respond), Just(Event::Ask), Just(Event::Ask)
            ],
            0..300,
        )) {
            let (mut end, response_ring, inbox) = ends();
            let mut core = Model { response_ring, inbox, state: 0, is_busy: false, owes_report: false };
            let mut heard = 0;
            for event in events {
                match event {
                    Event::Block => end.hand(Payload::new(b""), false),
                    Event::Request => end.request(Request::Report),
                    Event::Take if !core.is_busy => {
                        core.report();
                        if let Ok(request) = core.inbox.pop() {
                            core.state += 1;
                            core.is_busy = matches!(request, Request::Run(_));
                            if core.is_busy {
                                end.progress.begin();
                            }
                        }
                    }
                    Event::Take => {}
                    Event::Finish => {
                        core.report();
                        if std::mem::take(&mut core.is_busy) {
                            end.progress.publish(config(core.state).word());
                            end.progress.finish();
                        }
                    }
                    Event::Stop if !core.owes_report => (core.state, core.owes_report) = (core.state + 1, true),
                    Event::Stop => {}
                    Event::Respond => core.respond(),
                    Event::Ask => {
                        let core_done = end.progress.done();
                        while let Some((response, _)) = end.reader.response() {
                            heard = u32::from_le_bytes(response.try_into().unwrap());
                        }
                        if let Some(answer) = end.config(core_done) {
                            prop_assert!(core.inbox.is_empty() && !core.is_busy, "something is ahead of it");
                            let known = core.state - u32::from(core.owes_report);
                            prop_assert!(answer.word() as u32 >= heard.max(known), "it is stale");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_core_answers_the_first_get_config_after_a_request_or_a_response() {
        let (mut end, mut response_ring, _inbox) = ends();
        let progress = end.progress.clone();
        let answers = |end: &CoreEnd| end.config(progress.done()).map(|answer| answer.word());
        let run = |end: &mut CoreEnd| {
            end.hand(Payload::new(b""), false);
            progress.begin();
            progress.publish(config(7).word());
            progress.finish();
        };
        assert_eq!(answers(&end), None);
        run(&mut end);
        assert_eq!(answers(&end), Some(config(7).word()));
        end.request(Request::Report);
        assert_eq!(answers(&end), None);
        run(&mut end);
        assert_eq!(answers(&end), Some(config(7).word()));
        response_ring.send(b"response");
        assert_eq!(answers(&end), None);
    }
}
