// SPDX-License-Identifier: GPL-3.0-or-later
//! Blocks, messages and integers of the wire.

use pinion_protocol::block::{BLOCK_MAX, BLOCK_MIN, PAYLOAD_MAX, Received, Receiver, Resync, Resynced, frame};
use pinion_protocol::format;
use pinion_protocol::vlq::{Reader, Writer};

pub fn run(bytes: &[u8]) {
    let Some((piece, stream)) = bytes.split_first() else { return };
    let whole = blocks(stream, stream.len());
    assert_eq!(whole, blocks(stream, usize::from(*piece).max(1)), "the stream was cut elsewhere");
    assert_eq!(payloads(stream, stream.len()), payloads(stream, usize::from(*piece).max(1)));
    for block in whole {
        integers(&block);
    }
    integers(stream);
    if let Ok(text) = std::str::from_utf8(stream) {
        assert!(text.starts_with(format::name(text)));
        let _ = format::parameters(text);
    }
}

/// The payloads of all blocks in a stream that comes in pieces of this size. Each is framed as it came.
fn blocks(stream: &[u8], piece: usize) -> Vec<Vec<u8>> {
    let (mut resync, mut buffer, mut found) = (Resync::default(), Vec::new(), Vec::new());
    for piece in stream.chunks(piece.max(1)) {
        buffer.extend_from_slice(piece);
        loop {
            let (taken, what) = resync.next(&buffer);
            match what {
                Resynced::Nothing => break assert_eq!(taken, 0),
                Resynced::Garbage { .. } => assert!(taken > 0),
                Resynced::Block(sequence, payload) => {
                    let mut framed = Vec::new();
                    frame(payload, sequence, &mut framed);
                    assert_eq!(framed, buffer[..taken]);
                    found.push(payload.to_vec());
                }
            }
            buffer.drain(..taken);
        }
        assert!(buffer.len() < BLOCK_MAX, "more than a block is kept");
    }
    found
}

/// The payloads that an MCU takes, and how often it refuses.
fn payloads(stream: &[u8], piece: usize) -> (Vec<Vec<u8>>, u32) {
    let (mut receiver, mut buffer, mut taken, mut naks) = (Receiver::default(), Vec::new(), Vec::new(), 0);
    for piece in stream.chunks(piece.max(1)) {
        buffer.extend_from_slice(piece);
        loop {
            let expected = receiver.expected();
            let (len, received) = receiver.next(&buffer);
            match received {
                Received::Nothing => break,
                Received::Nak(_) => naks += 1,
                Received::Skip => {}
                Received::Payload(payload) => {
                    assert_eq!((payload.len() + BLOCK_MIN, receiver.expected()), (len, expected.next()));
                    taken.push(payload.to_vec());
                }
            }
            buffer.drain(..len);
        }
    }
    (taken, naks)
}

/// Each integer is written so that it is read as the same.
fn integers(bytes: &[u8]) {
    let mut reader = Reader::new(bytes);
    while let Ok(int) = reader.int() {
        let mut writer = Writer::default();
        writer.int(int);
        let written = writer.payload().expect("room");
        let mut again = Reader::new(written);
        assert_eq!((again.int(), again.is_empty()), (Ok(int), true));
    }
    let mut reader = Reader::new(bytes);
    while let Ok(string) = reader.bytes() {
        let mut writer = Writer::default();
        writer.string(string);
        assert_eq!(writer.payload().is_some(), string.len() < PAYLOAD_MAX);
    }
}
