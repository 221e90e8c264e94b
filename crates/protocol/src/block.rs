// SPDX-License-Identifier: GPL-3.0-or-later
//! Message blocks: length, sequence, payload, CRC, sync (docs/Protocol.md, "Message blocks").

use super::crc::crc16_ccitt;

/// Bytes of an empty block.
pub const BLOCK_MIN: usize = 5;
/// Bytes of the longest block.
pub const BLOCK_MAX: usize = 64;
/// Payload bytes of the longest block.
pub const PAYLOAD_MAX: usize = BLOCK_MAX - BLOCK_MIN;

const HEADER_BYTES: usize = 2;
const TRAILER_BYTES: usize = 3;
/// The last byte of each block. More of them may come between blocks.
pub const SYNC: u8 = 0x7e;
/// The high half of the sequence byte, both ways.
const DESTINATION: u8 = 0x10;
const SEQUENCE_MASK: u8 = 0x0f;

/// A block's place in the order of blocks, modulo 16.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Sequence(u8);

impl Sequence {
    /// The sequence number after `count` blocks.
    pub const fn after(count: u32) -> Sequence {
        Sequence(count as u8 & SEQUENCE_MASK)
    }

    /// The block after this one.
    pub const fn next(self) -> Sequence {
        Sequence((self.0 + 1) & SEQUENCE_MASK)
    }
}

/// Appends a block with `payload` to `out`. It appends nothing for a payload over [`PAYLOAD_MAX`] bytes.
pub fn frame(payload: &[u8], sequence: Sequence, out: &mut Vec<u8>) {
    if payload.len() > PAYLOAD_MAX {
        return;
    }
    let start = out.len();
    out.push((payload.len() + BLOCK_MIN) as u8);
    out.push(DESTINATION | sequence.0);
    out.extend_from_slice(payload);
    let crc = crc16_ccitt(&out[start..]);
    out.extend_from_slice(&crc.to_be_bytes());
    out.push(SYNC);
}

/// The beginning of some bytes.
#[derive(Debug, PartialEq, Eq)]
enum Front<'a> {
    Incomplete,
    Block(Sequence, &'a [u8]),
    Garbage,
}

fn front(bytes: &[u8]) -> Front<'_> {
    if bytes.len() < BLOCK_MIN {
        return Front::Incomplete;
    }
    let len = usize::from(bytes[0]);
    if !(BLOCK_MIN..=BLOCK_MAX).contains(&len) || bytes[1] & !SEQUENCE_MASK != DESTINATION {
        return Front::Garbage;
    }
    let Some(block) = bytes.get(..len) else {
        return Front::Incomplete;
    };
    let (checked, trailer) = block.split_at(len - TRAILER_BYTES);
    let crc = u16::from_be_bytes([trailer[0], trailer[1]]);
    if trailer[2] != SYNC || crc16_ccitt(checked) != crc {
        return Front::Garbage;
    }
    Front::Block(Sequence(bytes[1] & SEQUENCE_MASK), &checked[HEADER_BYTES..])
}

/// The result of [`Resync::next`].
#[derive(Debug, PartialEq, Eq)]
pub enum Resynced<'a> {
    /// The bytes end before a block does.
    Nothing,
    /// An intact block.
    Block(Sequence, &'a [u8]),
    /// Bytes that belong to no block. A run of them has `first` only once.
    Garbage {
        /// Whether an intact block came since the last garbage.
        first: bool,
    },
}

/// Finds blocks in a stream, also after garbage.
#[derive(Debug, Default)]
pub struct Resync {
    need_sync: bool,
    need_valid: bool,
}

impl Resync {
    /// How many bytes to remove from the front of `bytes`, and their content.
    pub fn next<'a>(&mut self, bytes: &'a [u8]) -> (usize, Resynced<'a>) {
        if !self.need_sync {
            match front(bytes) {
                Front::Incomplete => return (0, Resynced::Nothing),
                Front::Block(sequence, payload) => {
                    self.need_valid = false;
                    return (payload.len() + BLOCK_MIN, Resynced::Block(sequence, payload));
                }
                // Sync bytes between blocks do not mean that bytes were lost.
                Front::Garbage if bytes[0] == SYNC => return (1, Resynced::Garbage { first: false }),
                Front::Garbage => self.need_sync = true,
            }
        } else if bytes.is_empty() {
            return (0, Resynced::Nothing);
        }
        let taken = match bytes.iter().position(|byte| *byte == SYNC) {
            Some(at) => {
                self.need_sync = false;
                at + 1
            }
            None => bytes.len(),
        };
        let first = !self.need_valid;
        self.need_valid = true;
        (taken, Resynced::Garbage { first })
    }
}

/// How the micro-controller answers the bytes that it received.
#[derive(Debug, PartialEq, Eq)]
pub enum Received<'a> {
    /// The bytes end before a block does.
    Nothing,
    /// The expected block's payload. Run and acknowledge it.
    Payload(&'a [u8]),
    /// Something to refuse. Answer with a NAK: an empty block that repeats the expected sequence number.
    Nak(Refusal),
    /// Nothing to answer.
    Skip,
}

/// Why a NAK is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The first bytes that belong to no block.
    Garbage,
    /// An intact block that does not follow the garbage before it: what was expected got lost.
    Lost,
    /// An intact block that came before: the host sent it again, because it had no acknowledgement in time.
    Repeated,
}

/// The micro-controller's end of the wire. It accepts blocks in order only.
#[derive(Debug, Default)]
pub struct Receiver {
    resync: Resync,
    expected: Sequence,
    /// Garbage came since the last block in order, so that blocks may be lost.
    is_damaged: bool,
}

impl Receiver {
    /// How many bytes to remove from the front of `bytes`, and how to answer them.
    pub fn next<'a>(&mut self, bytes: &'a [u8]) -> (usize, Received<'a>) {
        let (taken, found) = self.resync.next(bytes);
        let received = match found {
            Resynced::Nothing => Received::Nothing,
            Resynced::Block(sequence, payload) if sequence == self.expected => {
                self.expected = sequence.next();
                self.is_damaged = false;
                Received::Payload(payload)
            }
            Resynced::Block(..) => Received::Nak(if self.is_damaged { Refusal::Lost } else { Refusal::Repeated }),
            Resynced::Garbage { first: false } => Received::Skip,
            Resynced::Garbage { first: true } => {
                self.is_damaged = true;
                Received::Nak(Refusal::Garbage)
            }
        };
        (taken, received)
    }

    /// The sequence number that the next block must have. Every block to the host carries it and so acknowledges all
    /// blocks before it.
    pub fn expected(&self) -> Sequence {
        self.expected
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn block(payload: &[u8], sequence: u8) -> Vec<u8> {
        let mut out = Vec::new();
        frame(payload, Sequence(sequence), &mut out);
        out
    }

    /// Feeds the stream in pieces of the given sizes, as a pty might deliver it.
    fn receive(receiver: &mut Receiver, stream: &[u8], pieces: &[usize]) -> (Vec<Vec<u8>>, usize) {
        let (mut buffer, mut payloads, mut naks) = (Vec::new(), Vec::new(), 0);
        let mut sizes = pieces.iter().copied().cycle();
        let mut stream = stream;
        while !stream.is_empty() {
            let (piece, rest) = stream.split_at(sizes.next().unwrap_or(64).clamp(1, stream.len()));
            buffer.extend_from_slice(piece);
            stream = rest;
            loop {
                let (taken, received) = receiver.next(&buffer);
                match received {
                    Received::Nothing => break,
                    Received::Payload(payload) => payloads.push(payload.to_vec()),
                    Received::Nak(_) => naks += 1,
                    Received::Skip => {}
                }
                buffer.drain(..taken);
            }
        }
        (payloads, naks)
    }

    fn payloads() -> impl Strategy<Value = Vec<Vec<u8>>> {
        proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..=PAYLOAD_MAX), 0..40)
    }

    proptest! {
        #[test]
        fn blocks_arrive_whole_however_they_are_cut(sent in payloads(), pieces in proptest::collection::vec(1usize..200, 1..20)) {
            let stream: Vec<u8> = sent.iter().enumerate().flat_map(|(i, p)| block(p, i as u8 & 15)).collect();
            let (got, naks) = receive(&mut Receiver::default(), &stream, &pieces);
            prop_assert_eq!(got, sent);
            prop_assert_eq!(naks, 0);
        }

        #[test]
        fn any_bytes_at_all_then_a_block_is_found_again(noise: Vec<u8>, payload in proptest::collection::vec(any::<u8>(), 0..=PAYLOAD_MAX)) {
            let mut receiver = Receiver::default();
            let mut stream = noise;
            // A block cut off by the noise swallows at most its own length.
            stream.extend_from_slice(&[SYNC; BLOCK_MAX]);
            receive(&mut receiver, &stream, &[7, 64]);
            let sequence = receiver.expected().0;
            let (got, _) = receive(&mut receiver, &block(&payload, sequence), &[64]);
            prop_assert_eq!(got, vec![payload]);
        }

        #[test]
        fn a_flipped_bit_is_never_taken_for_a_block(payload in proptest::collection::vec(any::<u8>(), 0..=PAYLOAD_MAX), bit in 0usize..BLOCK_MAX * 8) {
            let mut stream = block(&payload, 0);
            let bit = bit % (stream.len() * 8);
            stream[bit / 8] ^= 1 << (bit % 8);
            let mut receiver = Receiver::default();
            let (got, _) = receive(&mut receiver, &stream, &[64]);
            prop_assert!(got.is_empty());
        }
    }

    #[test]
    fn a_duplicate_and_a_gap_are_refused_with_a_nak() {
        let mut receiver = Receiver::default();
        let stream = [block(b"a", 0), block(b"a", 0), block(b"c", 2), block(b"b", 1)].concat();
        let (got, naks) = receive(&mut receiver, &stream, &[64]);
        assert_eq!(got, [b"a".to_vec(), b"b".to_vec()]);
        assert_eq!(naks, 2);
        assert_eq!(receiver.expected(), Sequence(2));
    }

    #[test]
    fn a_block_that_came_before_is_distinguished_from_one_behind_garbage() {
        let mut receiver = Receiver::default();
        let mut refused = |bytes: &[u8]| match receiver.next(bytes) {
            (_, Received::Nak(why)) => Some(why),
            (_, Received::Payload(_)) => None,
            (_, other) => panic!("{other:?}"),
        };
        assert_eq!(refused(&block(b"a", 0)), None);
        assert_eq!(refused(&block(b"a", 0)), Some(Refusal::Repeated));
        // The next block is damaged.
        assert_eq!(refused(b"damaged\x7e"), Some(Refusal::Garbage));
        assert_eq!(refused(&block(b"c", 2)), Some(Refusal::Lost));
        assert_eq!(refused(&block(b"b", 1)), None);
        assert_eq!(refused(&block(b"b", 1)), Some(Refusal::Repeated));
    }

    #[test]
    fn a_run_of_garbage_is_answered_once() {
        let mut receiver = Receiver::default();
        let (got, naks) = receive(&mut receiver, b"garbage\x7emore garbage\x7eand more\x7e", &[5]);
        assert!(got.is_empty());
        assert_eq!(naks, 1);
    }

    #[test]
    fn sync_bytes_between_blocks_are_no_garbage() {
        let stream = [vec![SYNC; 9], block(b"a", 0), vec![SYNC], block(b"b", 1)].concat();
        let (got, naks) = receive(&mut Receiver::default(), &stream, &[64]);
        assert_eq!((got.len(), naks), (2, 0));
    }

    #[test]
    fn an_acknowledgement_is_found_without_more_bytes() {
        assert_eq!(Resync::default().next(&block(&[], 3)), (BLOCK_MIN, Resynced::Block(Sequence(3), &[])));
    }

    #[test]
    fn a_block_for_another_destination_is_garbage() {
        let mut other = vec![BLOCK_MIN as u8, 0x20];
        other.extend_from_slice(&crc16_ccitt(&other).to_be_bytes());
        other.push(SYNC);
        assert_eq!(Resync::default().next(&other), (BLOCK_MIN, Resynced::Garbage { first: true }));
    }

    #[test]
    fn garbage_ends_with_the_next_sync_byte() {
        let mut resync = Resync::default();
        assert_eq!(resync.next(b"garbage\x7e\x7e"), (8, Resynced::Garbage { first: true }));
        assert_eq!(resync.next(b"\x7e\x10\0\0\0"), (1, Resynced::Garbage { first: false }));
        assert_eq!(resync.next(b"no end"), (6, Resynced::Garbage { first: false }));
        assert_eq!(resync.next(b""), (0, Resynced::Nothing));
        assert_eq!(resync.next(b"\x06\x10 of it\x7e"), (9, Resynced::Garbage { first: false }));
    }

    #[test]
    fn sequence_numbers_are_counted_modulo_16() {
        assert_eq!([0, 7, 16, 35].map(Sequence::after), [0, 7, 0, 3].map(Sequence));
    }

    #[test]
    fn the_bytes_of_a_block_are_those_of_klippy() {
        // An ack and `identify offset=0 count=40`, encoded by klippy's msgproto.
        assert_eq!(block(&[], 1), [0x05, 0x11, 0x8f, 0x08, 0x7e]);
        assert_eq!(block(&[1, 0, 40], 2), [0x08, 0x12, 0x01, 0x00, 0x28, 0x67, 0xe9, 0x7e]);
        assert_eq!(Sequence(15).next(), Sequence(0));
    }
}
