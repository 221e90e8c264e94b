// SPDX-License-Identifier: GPL-3.0-or-later
//! The other end of the wire for tests: a peer over a socket, and an MCU with a few commands. The peer loses and
//! corrupts the blocks that the test names.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use serde_json::json;

use super::serial::{BlockLink, Port};
use pinion_protocol::block::{Received, Receiver, Resync, Resynced, Sequence, frame};
use pinion_protocol::dictionary::Dictionary;
use pinion_protocol::vlq::{Reader, Writer};

/// The fault of a block on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// The block is lost.
    Drop,
    /// One bit of the block is flipped.
    Corrupt,
    /// The block arrives, but its acknowledgement does not.
    MuteAck,
    /// Its acknowledgement arrives twice.
    DoubleAck,
}

/// A peer that acknowledges blocks, and answers them with a function of the test.
pub(super) struct Peer;

impl Peer {
    /// Starts a peer that has received `before` blocks from an earlier host. It applies the faults to the blocks with
    /// these numbers (counted as sent, not as received). It ends when the link is dropped, and returns the payloads
    /// that it took.
    pub(super) fn start(
        before: u8,
        faults: &[(u64, Fault)],
        answer: impl FnMut(&[u8]) -> Vec<Vec<u8>> + Send + 'static,
    ) -> (JoinHandle<Vec<Vec<u8>>>, BlockLink) {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let faults = faults.to_vec();
        let peer = thread::spawn(move || serve(theirs, before, &faults, answer));
        let port = Port::from_fd(ours.into(), "fake").unwrap();
        (peer, BlockLink::new(port, Duration::from_secs(60)).unwrap())
    }
}

/// A peer's thread.
pub(super) fn serve(
    mut stream: UnixStream,
    before: u8,
    faults: &[(u64, Fault)],
    mut answer: impl FnMut(&[u8]) -> Vec<Vec<u8>>,
) -> Vec<Vec<u8>> {
    let mut receiver = Receiver::default();
    for _ in 0..before {
        let mut block = Vec::new();
        frame(&[], receiver.expected(), &mut block);
        receiver.next(&block);
    }
    let (mut resync, mut input, mut bytes) = (Resync::default(), Vec::new(), [0; 4096]);
    let (mut count, mut taken_payloads) = (0u64, Vec::new());
    loop {
        match stream.read(&mut bytes) {
            Ok(0) | Err(_) => return taken_payloads,
            Ok(read) => input.extend_from_slice(&bytes[..read]),
        }
        let mut output = Vec::new();
        loop {
            let (taken, found) = resync.next(&input);
            let block = match found {
                Resynced::Nothing => break,
                Resynced::Block(sequence, payload) => Some((sequence, payload.to_vec())),
                Resynced::Garbage { .. } => None,
            };
            input.drain(..taken);
            let Some((sequence, payload)) = block else {
                continue;
            };
            // The empty block at the start of a session has no number.
            let number = (!payload.is_empty()).then(|| {
                count += 1;
                count - 1
            });
            let hit = faults.iter().find(|(at, _)| Some(*at) == number);
            let fault = hit.map(|(_, fault)| *fault);
            let mut block = Vec::new();
            frame(&payload, sequence, &mut block);
            match fault {
                Some(Fault::Drop) => continue,
                Some(Fault::Corrupt) => block[2] ^= 0x10,
                _ => {}
            }
            let acknowledgements = match fault {
                Some(Fault::MuteAck) => 0,
                Some(Fault::DoubleAck) => 2,
                _ => 1,
            };
            receive(&mut receiver, block, acknowledgements, &mut output, |payload| {
                if !payload.is_empty() {
                    taken_payloads.push(payload.to_vec());
                }
                answer(payload)
            });
        }
        if stream.write_all(&output).is_err() {
            return taken_payloads;
        }
    }
}

/// Takes a block in as an MCU does. `answer` gives the responses to its payload. Each payload is acknowledged
/// `acknowledgements` times.
fn receive(
    receiver: &mut Receiver,
    mut block: Vec<u8>,
    acknowledgements: usize,
    output: &mut Vec<u8>,
    mut answer: impl FnMut(&[u8]) -> Vec<Vec<u8>>,
) {
    while !block.is_empty() {
        let (taken, received) = receiver.next(&block);
        match received {
            Received::Nothing => break,
            Received::Skip => {}
            Received::Nak(_) => acknowledge(receiver.expected(), output),
            Received::Payload(payload) => {
                for response in answer(payload) {
                    frame(&response, receiver.expected(), output);
                }
                for _ in 0..acknowledgements {
                    acknowledge(receiver.expected(), output);
                }
            }
        }
        block.drain(..taken);
    }
}

fn acknowledge(expected: Sequence, output: &mut Vec<u8>) {
    frame(&[], expected, output);
}

/// The dictionary of the fake MCU.
pub(super) fn dictionary() -> Dictionary {
    let map = |json: serde_json::Value| json.as_object().unwrap().clone();
    Dictionary {
        app: "Fake".to_owned(),
        version: "fake".to_owned(),
        commands: map(json!({
            "identify offset=%u count=%c": 1,
            "get_clock": 2,
            "get_uptime": 3,
            "get_config": 4,
            "config_endstop oid=%c pin=%c pull_up=%c": 5,
            "debug_ping data=%*s": 6,
            "allocate_oids count=%c": 7,
            "finalize_config crc=%u": 8,
            "emergency_stop": 9,
            "config_reset": 10,
            "endstop_query_state oid=%c": 11,
        })),
        responses: map(json!({
            "identify_response offset=%u data=%.*s": 0,
            "clock clock=%u": 64,
            "uptime high=%u clock=%u": 65,
            "config is_config=%c crc=%u is_shutdown=%c move_count=%hu": 66,
            "shutdown clock=%u static_string_id=%hu": 67,
            "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c": 69,
            "stepper_position oid=%c pos=%i": 70,
            "pong data=%*s": 71,
        })),
        enumerations: map(json!({
            "pin": {"gpio0": [0, 288], "gpiochip1/gpio0": [288, 288], "GPIO17": 17},
            "static_string_id": {"Command request": 2},
        })),
        config: map(json!({"CLOCK_FREQ": 50_000_000})),
        ..Dictionary::default()
    }
}

/// An MCU that can be identified, configured, shut down and reset.
pub(super) struct FakeMcu {
    identify: Vec<u8>,
    crc: Option<u32>,
    is_shutdown: bool,
}

impl Default for FakeMcu {
    fn default() -> FakeMcu {
        FakeMcu { identify: dictionary().compress().unwrap(), crc: None, is_shutdown: false }
    }
}

impl FakeMcu {
    /// An MCU that serves these bytes as its compressed dictionary in `identify`.
    pub(super) fn identifying(identify: Vec<u8>) -> FakeMcu {
        FakeMcu { identify, ..FakeMcu::default() }
    }

    pub(super) fn start(mut self) -> (JoinHandle<Vec<Vec<u8>>>, BlockLink) {
        Peer::start(0, &[], move |payload| self.answer(payload))
    }

    fn answer(&mut self, payload: &[u8]) -> Vec<Vec<u8>> {
        let mut reader = Reader::new(payload);
        let mut next = || reader.int().unwrap_or(0);
        let response = match next() {
            1 => {
                let (offset, count) = (next(), next() as usize);
                let rest = self.identify.get(offset as usize..).unwrap_or(&[]);
                let mut writer = Writer::default();
                writer.int(0);
                writer.int(offset);
                writer.string(&rest[..count.min(rest.len())]);
                return vec![writer.payload().unwrap().to_vec()];
            }
            2 => vec![64, 5],
            3 => vec![65, 1, 5],
            4 => vec![66, u32::from(self.crc.is_some()), self.crc.unwrap_or(0), u32::from(self.is_shutdown), 1024],
            8 => {
                self.crc = Some(next());
                return Vec::new();
            }
            9 => {
                self.is_shutdown = true;
                vec![67, 5, 2]
            }
            10 => {
                (self.crc, self.is_shutdown) = (None, false);
                return Vec::new();
            }
            11 => vec![69, next(), 0, 0, 1],
            _ => return Vec::new(),
        };
        let mut writer = Writer::default();
        for value in response {
            writer.int(value);
        }
        vec![writer.payload().unwrap().to_vec()]
    }
}
