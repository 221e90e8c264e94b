// SPDX-License-Identifier: GPL-3.0-or-later
//! The core runs the commands of blocks, and serves the link's other requests.

use std::thread;

use pinion_firmware::mcu::base;
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::Clock;
use pinion_protocol::vlq::Reader;

use super::calls::next_commands;
use super::{Core, NEAR, Request, Turn};

impl Core {
    /// How many commands fit before the next timer, if each takes [`NEAR`]. At least one.
    fn room(&self) -> i64 {
        let to_go = |next: Clock| next.since(self.mcu.last_read()) / i64::from(NEAR.0);
        self.mcu.next_timer().map_or(i64::MAX, to_go).max(1)
    }

    /// Stops the MCU ahead of a held block, because a stop request waits behind it. The MCU then refuses the requests
    /// before the stop request, as any stopped MCU does.
    #[cold]
    pub(super) fn stop_ahead(&mut self) {
        let Core { mcu, requests, block, .. } = self;
        let rest = block.as_ref().is_some_and(|(payload, at)| mcu.is_emergency(&payload.as_slice()[*at..]));
        let waiting = requests.slots();
        let stop = match requests.read_chunk(waiting) {
            _ if rest => Some(base::emergency()),
            Err(_) => None,
            Ok(waiting) => {
                let (first, second) = waiting.as_slices();
                let mut heard = mcu.heard();
                first.iter().chain(second).find_map(|request| match request {
                    Request::Run(payload) => heard.is_emergency(payload.as_slice()).then(base::emergency),
                    Request::Shutdown(shutdown) => Some(shutdown.clone()),
                    Request::Quit(why) => Some(why.clone().unwrap_or_else(program_ends)),
                    Request::Speak(dialect) => {
                        heard = dialect;
                        None
                    }
                    Request::Renew | Request::Report | Request::Hang => None,
                })
            }
        };
        // Without one, it is still on its way into the ring.
        if let Some(stop) = stop {
            self.mcu.shut_down(stop);
        }
    }

    /// Runs one command of a block, or as many as there is time for. If the next request is no block, it serves that
    /// request.
    #[inline]
    pub(super) fn run_commands(&mut self, one: bool) -> Turn {
        self.yielded = 0;
        if self.mcu.is_held() {
            match next_commands(self.block.as_ref(), &self.requests) {
                Some(commands) if self.mcu.may_run(commands) => {}
                next => {
                    // The blocks behind it can wait as well.
                    self.progress.hold(next.is_some());
                    return Turn::Idle;
                }
            }
        }
        self.progress.hold(false);
        let (payload, mut at) = match self.block.take() {
            Some(block) => block,
            None => match self.requests.pop() {
                Ok(Request::Run(payload)) => {
                    self.trace_writer.began(self.mcu.last_read(), self.progress.begin());
                    (payload, 0)
                }
                Ok(request) => return self.serve(request),
                Err(_) => return Turn::Idle,
            },
        };
        let bytes = payload.as_slice();
        let mut reader = Reader::new(&bytes[at..]);
        let (began, mut count) = (self.mcu.last_read(), 0);
        for _ in 0..if one { 1 } else { self.room() } {
            if reader.is_empty() || !self.mcu.may_run(reader.rest()) {
                break;
            }
            self.mcu.execute(&mut reader);
            count += 1;
        }
        self.trace_writer.ran(began, &bytes[at..], count);
        at = bytes.len() - reader.rest().len();
        if at < bytes.len() || self.mcu.keeps_block() {
            self.progress.hold(self.mcu.is_held());
            self.block = Some((payload, at));
            return Turn::Done;
        }
        if self.progress.stops_handed() != self.stops_taken && self.mcu.is_emergency(bytes) {
            self.stops_taken = self.stops_taken.wrapping_add(1);
        }
        // A send that is under way may still stop the MCU, and `get_config` comes after it.
        self.progress.publish(if self.mcu.is_held() { 0 } else { self.mcu.config().word() });
        self.progress.finish();
        // The end of the next block is early enough, if that block may begin. But an MCU that is being configured takes
        // its time for a block.
        self.untold = !self.requests.is_empty() && self.mcu.is_running();
        if !self.untold {
            self.wake.wake();
        }
        Turn::Done
    }

    /// Serves a request other than a block.
    fn serve(&mut self, request: Request) -> Turn {
        match request {
            Request::Shutdown(shutdown) => {
                self.stops_taken = self.stops_taken.wrapping_add(1);
                self.mcu.shut_down(shutdown);
            }
            Request::Speak(dialect) => self.mcu.speak(dialect),
            Request::Renew => self.mcu.renew(),
            Request::Report => self.mcu.report_lateness(self.waiter.margin()),
            Request::Quit(why) => {
                let is_last = |why: &Shutdown| self.mcu.last_stop().is_some_and(|(stop, _)| stop.reason == why.reason);
                let why = why.filter(|why| self.mcu.is_running() || is_last(why));
                let is_news = why.is_some();
                self.mcu.shut_down(why.unwrap_or_else(program_ends));
                if is_news {
                    self.record();
                }
                return Turn::Quit;
            }
            Request::Hang => loop {
                thread::park();
            },
            Request::Run(_) => {}
        }
        Turn::Done
    }
}

fn program_ends() -> Shutdown {
    Shutdown::because(reason::FORCE_SHUTDOWN, "the program ends; the host sees the connection close")
}
