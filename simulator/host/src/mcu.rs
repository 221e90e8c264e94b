// SPDX-License-Identifier: GPL-3.0-or-later
//! An MCU of a simulated board in one clock: without threads, and with a socket in place of a terminal.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use pinion_firmware::mcu::{DeviceWarning, Dialect, Forms, Mcu, Note, Outbox};
use pinion_firmware::time::{Clock, Ticks, TimeSource};
use pinion_firmware::trouble::Trouble;
use pinion_model::SimBoard;
use pinion_protocol::block::{Received, Receiver, frame};
use pinion_protocol::vlq;
use pinion_runtime::FIRMWARE;

use crate::workers::Buses;

/// Highest number of bytes that wait for an MCU that is busy.
const INPUT_BYTES_MAX: usize = 1 << 16;
/// Highest number of bytes for a klippy that does not read.
const OUTPUT_BYTES_MAX: usize = 1 << 20;

/// How long the MCU takes no commands behind `finalize_config`. klippy counts on the time that its start takes: it sets each
/// output for 0.2 s later, and `[controller_fan]` sets one again 0.1 s after that start, for 0.1 s later. klippy sends that
/// only after the first time has come, which is too late if the start takes no time at all.
const CONFIGURES: Ticks = Ticks::from_ms(50);

/// How long bytes are under way to an MCU. klippy counts on some time: it estimates the clock of a TLE5012B from two
/// answers in a row, and that estimate leads astray if they are less than 0.1 ms apart.
const LINK: Ticks = Ticks::from_us(500);

/// The bytes from the MCU.
#[derive(Clone, Default)]
struct Responses(Arc<Mutex<VecDeque<Vec<u8>>>>);

impl Responses {
    fn all(&self) -> MutexGuard<'_, VecDeque<Vec<u8>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Outbox for Responses {
    fn send(&mut self, payload: &[u8]) {
        self.all().push_back(payload.to_vec());
    }

    fn note(&mut self, note: Note<'_>) {
        match note {
            Note::Shutdown(shutdown) => log::info!("shutdown: {shutdown}"),
            Note::Warning(trouble) | Note::Trouble(trouble) => log::warn!("{trouble}"),
            Note::Device(DeviceWarning { trouble, .. }) => log::warn!("{trouble}"),
            Note::Safe(_) | Note::Configured(_) | Note::Lateness(..) | Note::Reset | Note::Renewed => {}
        }
    }
}

/// The connection of a klippy.
struct Connection {
    stream: UnixStream,
    receiver: Receiver,
    /// The bytes from klippy, and when they arrive.
    under_way: VecDeque<(Clock, Vec<u8>)>,
    input: Vec<u8>,
    /// The block that is under way, and the offset of its next command.
    block: Option<(Vec<u8>, usize)>,
    output: Vec<u8>,
    /// klippy has closed its end.
    is_over: bool,
}

/// An MCU and its klippy.
pub(crate) struct BoardMcu {
    mcu: Mcu,
    clock: Arc<dyn TimeSource>,
    buses: Buses,
    responses: Responses,
    listener: UnixListener,
    connection: Option<Connection>,
    /// No command runs before this time.
    rests_until: Clock,
}

impl BoardMcu {
    /// The MCU of a board, for a klippy whose sources look up these forms. klippy connects to `socket`.
    pub(crate) fn new(board: SimBoard, forms: Forms, socket: &Path) -> Result<BoardMcu, Trouble> {
        let failed = |cause: String| Trouble::new(cause).of(format_args!("the MCU {}", board.name()));
        let dialect = Dialect::new(&FIRMWARE, &board, forms).map_err(|error| failed(error.to_string()))?;
        let listener = UnixListener::bind(socket)
            .and_then(|listener| listener.set_nonblocking(true).map(|()| listener))
            .map_err(|error| failed(format!("{} cannot be made: {error}", socket.display())))?;
        let timing = board.timing();
        let (clock, responses) = (timing.clock.clone(), Responses::default());
        let buses = Buses::new(clock.clone());
        let (workers, outbox) = (Box::new(buses.clone()), Box::new(responses.clone()));
        let mcu = Mcu::new(Arc::new(dialect), Box::new(board), timing, workers, outbox);
        Ok(BoardMcu { mcu, clock, buses, responses, listener, connection: None, rests_until: Clock::EPOCH })
    }

    /// Another process of klippy comes.
    pub(crate) fn renew(&mut self) {
        self.connection = None;
        self.mcu.renew();
    }

    /// When something happens next, in nanoseconds of the printer's time.
    pub(crate) fn next_ns(&self) -> u64 {
        let rests = Some(self.rests_until).filter(|until| *until > self.clock.now());
        let arrives = self.connection.as_ref().and_then(|connection| connection.under_way.front());
        let arrives = arrives.map(|(at, _)| *at);
        let next = self.mcu.next_timer().into_iter().chain(self.buses.next_end()).chain(rests).chain(arrives).min();
        next.map_or(u64::MAX, |next| self.clock.duration_of(next).as_nanos() as u64)
    }

    /// Does everything that is due. Returns whether klippy has something to read.
    pub(crate) fn turn(&mut self) -> bool {
        if let Some(connection) = &mut self.connection {
            connection.arrive(self.clock.now());
        }
        loop {
            while self.mcu.run_timers() {}
            self.mcu.run_workers();
            let ran = self.run_commands();
            if !ran && !self.mcu.has_completion() {
                let has_sent = self.give_out();
                self.connection.take_if(|connection| {
                    connection.is_over && connection.block.is_none() && connection.under_way.is_empty()
                });
                return has_sent;
            }
        }
    }

    /// Takes in what klippy has sent.
    pub(crate) fn take_in(&mut self) {
        if let Ok((stream, _)) = self.listener.accept() {
            // It fails for no socket.
            let _ = stream.set_nonblocking(true);
            self.connection = Some(Connection {
                stream,
                receiver: Receiver::default(),
                under_way: VecDeque::new(),
                input: Vec::new(),
                block: None,
                output: Vec::new(),
                is_over: false,
            });
            self.responses.all().clear();
        }
        let Some(connection) = &mut self.connection else { return };
        let mut piece = [0; 4096];
        let arrives = self.clock.now() + LINK;
        while connection.under_way.len() * piece.len() + connection.input.len() < INPUT_BYTES_MAX {
            match connection.stream.read(&mut piece) {
                // Bytes that came before the end still count.
                Ok(0) => return connection.is_over = true,
                Ok(read) => connection.under_way.push_back((arrives, piece[..read].to_vec())),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => return self.connection = None,
            }
        }
    }

    /// Runs the commands that have come, as far as they may run. Returns whether one did.
    fn run_commands(&mut self) -> bool {
        let Some(connection) = &mut self.connection else { return false };
        let mut ran = false;
        while self.clock.now() >= self.rests_until {
            let (payload, mut at) = match connection.block.take() {
                Some(block) => block,
                None => {
                    let (taken, received) = connection.receiver.next(&connection.input);
                    let block = match received {
                        Received::Nothing => None,
                        Received::Payload(payload) => Some((payload.to_vec(), 0)),
                        Received::Skip => None,
                        Received::Nak(_) => {
                            frame(&[], connection.receiver.expected(), &mut connection.output);
                            None
                        }
                    };
                    let is_over = matches!(received, Received::Nothing);
                    connection.input.drain(..taken);
                    match block {
                        Some(block) => block,
                        None if is_over => return ran,
                        None => continue,
                    }
                }
            };
            let mut commands = vlq::Reader::new(&payload[at..]);
            while !commands.is_empty() && self.mcu.may_run(commands.rest()) {
                let was_finalized = self.mcu.is_finalized();
                self.mcu.execute(&mut commands);
                ran = true;
                if self.mcu.is_finalized() && !was_finalized {
                    self.rests_until = self.clock.now() + CONFIGURES;
                    break;
                }
            }
            at = payload.len() - commands.rest().len();
            if at < payload.len() || self.mcu.keeps_block() {
                connection.block = Some((payload, at));
                return ran;
            }
            // As in Klipper's C: a block is acknowledged behind the answers to it.
            connection.frame_all(&self.responses);
            frame(&[], connection.receiver.expected(), &mut connection.output);
        }
        ran
    }

    /// Sends what the MCU has to say. Returns whether something was sent.
    fn give_out(&mut self) -> bool {
        let Some(connection) = &mut self.connection else {
            self.responses.all().clear();
            return false;
        };
        connection.frame_all(&self.responses);
        if connection.output.is_empty() {
            return false;
        }
        match connection.stream.write(&connection.output) {
            Ok(written) => {
                connection.output.drain(..written);
                true
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock && connection.output.len() < OUTPUT_BYTES_MAX => true,
            Err(_) => {
                self.connection = None;
                false
            }
        }
    }
}

impl Connection {
    /// Takes in what has come by now.
    fn arrive(&mut self, now: Clock) {
        let count = self.under_way.iter().take_while(|(at, _)| *at <= now).count();
        self.under_way.drain(..count).for_each(|(_, bytes)| self.input.extend(bytes));
    }

    /// Frames responses. Each has the number after the block that is under way, or after the last one.
    fn frame_all(&mut self, responses: &Responses) {
        for payload in responses.all().drain(..) {
            frame(&payload, self.receiver.expected(), &mut self.output);
        }
    }
}
