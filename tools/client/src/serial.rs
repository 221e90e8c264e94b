// SPDX-License-Identifier: GPL-3.0-or-later
//! Blocks over a tty. A [`Port`] carries bytes and finds blocks in them. A [`BlockLink`] delivers payloads in order,
//! each once.
//!
//! Blocks are sent again by klippy's rules (chelper/serialqueue.c). At most [`WINDOW`] blocks are sent without an
//! acknowledgement. After the retransmission timeout, or at once after a NAK, all of them are sent again, after a sync
//! byte. An empty block that repeats the last acknowledgement is a NAK.

use std::collections::VecDeque;
use std::path::Path;
use std::time::{Duration, Instant};

use super::Error;
use pinion_protocol::block::{BLOCK_MAX, BLOCK_MIN, PAYLOAD_MAX, Sequence};

mod port;

pub use port::Port;

/// Highest number of blocks without an acknowledgement.
pub const WINDOW: usize = 12;
/// How long to wait for any acknowledgement before sending fails.
pub const SILENCE: Duration = Duration::from_secs(15);

/// Highest number of payloads kept until they are received. The oldest are dropped first.
const RECEIVED_MAX: usize = 65_536;
const SYNC: u8 = 0x7e;
const RTO_MIN: Duration = Duration::from_millis(25);
/// klippy has 5 s. The first round trip counts tenfold: one of 0.5 s on a slow computer, and a lost block after it, was
/// a silence of 5 s.
const RTO_MAX: Duration = Duration::from_secs(1);

/// A payload that arrived.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    /// The payload, not empty.
    pub payload: Vec<u8>,
    /// When it was read.
    pub at: Instant,
}

/// The traffic of a link so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Number of blocks sent, each counted once.
    pub blocks_sent: u64,
    /// Number of blocks sent again.
    pub blocks_again: u64,
    /// Number of blocks received, including acknowledgements.
    pub blocks_received: u64,
    /// Number of NAKs among them.
    pub naks: u64,
    /// Number of received bytes outside intact blocks.
    pub garbage_bytes: u64,
}

#[derive(Debug)]
struct Sent {
    payload: Vec<u8>,
    at: Instant,
}

/// What is known of the number that a session begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Beginning {
    /// Nothing: no acknowledgement has come.
    Unknown,
    /// An acknowledgement had it, but no response has come. It may have answered a block of an earlier session, which
    /// the other end had not finished.
    Assumed,
    /// A response has come: it is right.
    Known,
}

/// Delivers payloads in order, each once.
///
/// Numbers count blocks from the session's start. The wire carries them modulo 16.
#[derive(Debug)]
pub struct BlockLink {
    port: Port,
    beginning: Beginning,
    /// The number of the next new block.
    send: u64,
    /// The number of the oldest block without an acknowledgement.
    receive: u64,
    last_ack: u64,
    /// NAKs up to this number are ignored: they answer blocks that have been sent again since.
    ignore_nak: u64,
    /// Blocks below this number were sent more than once.
    retransmitted: u64,
    rtt_sample: Option<u64>,
    sent: VecDeque<Sent>,
    sent_bytes: usize,
    window_bytes: usize,
    round_trip: Option<(Duration, Duration)>,
    rto: Duration,
    retransmit_at: Instant,
    heard_at: Instant,
    received: VecDeque<Received>,
    /// Number of payloads that arrived; the next field counts those that were received or dropped.
    arrived: u64,
    taken: u64,
    /// The value of `arrived` when the last sent block was acknowledged.
    settled: Option<u64>,
    traffic: Traffic,
}

impl BlockLink {
    /// Opens a tty, and finds out which block the other end expects next.
    pub fn open(path: &Path, timeout: Duration) -> Result<BlockLink, Error> {
        BlockLink::new(Port::open(path)?, timeout)
    }

    /// Makes a link from a port, and finds out which block the other end expects next.
    pub fn new(port: Port, timeout: Duration) -> Result<BlockLink, Error> {
        let now = Instant::now();
        let mut link = BlockLink {
            port,
            beginning: Beginning::Unknown,
            send: 0,
            receive: 0,
            last_ack: 0,
            ignore_nak: 0,
            retransmitted: 0,
            rtt_sample: None,
            sent: VecDeque::new(),
            sent_bytes: 0,
            window_bytes: usize::MAX,
            round_trip: None,
            rto: RTO_MIN,
            retransmit_at: now,
            heard_at: now,
            received: VecDeque::new(),
            arrived: 0,
            taken: 0,
            settled: Some(0),
            traffic: Traffic::default(),
        };
        link.synchronise(timeout)?;
        Ok(link)
    }

    /// Finds out which block the other end expects next. It sends an empty block. The answer has the expected number,
    /// whether or not the number of the empty block was right. The sync bytes before it end a block that an earlier
    /// host may have left incomplete.
    fn synchronise(&mut self, timeout: Duration) -> Result<(), Error> {
        let until = Instant::now() + timeout;
        while self.beginning == Beginning::Unknown {
            let now = Instant::now();
            if now >= until {
                return Err(Error::Timeout { waiting_for: format!("answer on {}", self.port.name), after: timeout });
            }
            if self.port.output.is_empty() {
                self.port.queue(&[SYNC; BLOCK_MAX]);
                self.port.queue_block(&[], Sequence::default());
            }
            let again = until.min(now + Duration::from_millis(100));
            while self.beginning == Beginning::Unknown && Instant::now() < again {
                self.exchange(again)?;
            }
        }
        Ok(())
    }

    /// Limits the unacknowledged bytes to the other end's buffer size, its constant `RECEIVE_WINDOW`.
    pub(super) fn set_window_bytes(&mut self, bytes: usize) {
        self.window_bytes = bytes.max(BLOCK_MAX);
    }

    /// Sends a payload as one block. Waits while the window is full.
    ///
    /// Fails if the payload does not fit into a block, if the other end closes, or if it acknowledges nothing for
    /// [`SILENCE`].
    pub fn send(&mut self, payload: &[u8]) -> Result<(), Error> {
        if payload.len() > PAYLOAD_MAX {
            return Err(Error::Message {
                message: format!("a payload of {} bytes", payload.len()),
                why: format!("a block takes {PAYLOAD_MAX}"),
            });
        }
        self.wait_while(|link| {
            link.sent.len() >= WINDOW || (!link.sent.is_empty() && link.sent_bytes + BLOCK_MAX > link.window_bytes)
        })?;
        let now = Instant::now();
        if self.sent.is_empty() {
            self.retransmit_at = now + self.rto;
            self.heard_at = now;
        }
        self.port.queue_block(payload, Sequence::after(self.send as u32));
        self.rtt_sample.get_or_insert(self.send);
        self.send += 1;
        self.sent_bytes += payload.len() + BLOCK_MIN;
        self.traffic.blocks_sent += 1;
        self.sent.push_back(Sent { payload: payload.to_vec(), at: now });
        self.settled = None;
        self.port.write_some()
    }

    /// Waits until everything sent is acknowledged.
    pub fn settle(&mut self) -> Result<(), Error> {
        self.wait_while(|link| !link.sent.is_empty())
    }

    /// Waits for the next payload; `None` if none arrives in time.
    pub fn receive(&mut self, until: Instant) -> Result<Option<Received>, Error> {
        loop {
            if let Some(received) = self.next_received() {
                return Ok(Some(received));
            }
            self.exchange(until)?;
            if self.received.is_empty() && Instant::now() >= until {
                return Ok(None);
            }
        }
    }

    /// The next payload that arrives before, or together with, the acknowledgement of everything sent. Waits for one;
    /// `None` when there are no more.
    pub(super) fn receive_unsettled(&mut self) -> Result<Option<Received>, Error> {
        self.wait_while(|link| link.received.is_empty() && link.settled.is_none())?;
        match self.settled {
            Some(before) if self.taken >= before => Ok(None),
            _ => Ok(self.next_received()),
        }
    }

    fn next_received(&mut self) -> Option<Received> {
        let received = self.received.pop_front();
        self.taken += u64::from(received.is_some());
        received
    }

    /// Number of sent blocks without an acknowledgement.
    pub fn unacknowledged(&self) -> usize {
        self.sent.len()
    }

    /// The traffic of the link so far.
    pub fn traffic(&self) -> Traffic {
        Traffic { garbage_bytes: self.port.garbage, ..self.traffic }
    }

    /// The underlying port, for sending bytes that a link would never send.
    pub fn port(&mut self) -> &mut Port {
        &mut self.port
    }

    fn wait_while(&mut self, busy: impl Fn(&BlockLink) -> bool) -> Result<(), Error> {
        while busy(self) {
            let until = self.heard_at + SILENCE;
            self.exchange(until)?;
            if Instant::now() >= until && self.heard_at + SILENCE == until && busy(self) {
                return Err(Error::Timeout {
                    waiting_for: format!("acknowledgement on {}", self.port.name),
                    after: SILENCE,
                });
            }
        }
        Ok(())
    }

    /// One round of writing, waiting, reading, acknowledging and sending again.
    fn exchange(&mut self, until: Instant) -> Result<(), Error> {
        self.port.write_some()?;
        // The retransmission timeout starts only after everything has been written.
        let timed = !self.sent.is_empty() && self.port.output.is_empty();
        let until = if timed { until.min(self.retransmit_at) } else { until };
        if self.port.exchange(until)? {
            let at = Instant::now();
            while let Some((sequence, payload)) = self.port.next_block() {
                self.take(sequence, payload, at);
            }
        }
        let now = Instant::now();
        if !self.sent.is_empty() && self.port.output.is_empty() && now >= self.retransmit_at {
            self.rto = (self.rto * 2).min(RTO_MAX);
            self.ignore_nak = self.send;
            self.send_again(now);
        }
        Ok(())
    }

    fn take(&mut self, sequence: Sequence, payload: Vec<u8>, at: Instant) {
        let index = u64::from((0..16).find(|i| Sequence::after(*i) == sequence).unwrap_or(0));
        if self.beginning == Beginning::Unknown {
            if payload.is_empty() {
                self.begin(index);
            }
            return;
        }
        let acknowledged = index.wrapping_sub(self.receive) & 15;
        if acknowledged > self.send - self.receive {
            // It acknowledges a block that was never sent.
            if self.beginning == Beginning::Assumed {
                self.begin(index);
                self.send_again(at);
            }
            return;
        }
        self.traffic.blocks_received += 1;
        if acknowledged > 0 {
            self.acknowledge(acknowledged, at);
        }
        if !payload.is_empty() {
            self.beginning = Beginning::Known;
            if self.received.len() >= RECEIVED_MAX {
                self.next_received();
            }
            self.arrived += 1;
            self.received.push_back(Received { payload, at });
        } else if self.last_ack < self.receive {
            self.last_ack = self.receive;
        } else if self.receive > self.ignore_nak && !self.sent.is_empty() {
            self.traffic.naks += 1;
            // After the second NAK since the blocks were sent again, further ones are ignored.
            self.ignore_nak = self.receive.max(self.retransmitted);
            self.send_again(at);
        }
        if self.sent.is_empty() {
            self.settled.get_or_insert(self.arrived);
        }
    }

    /// Begins with the block that the other end expects next.
    fn begin(&mut self, index: u64) {
        self.beginning = Beginning::Assumed;
        self.receive = 16 + index;
        self.send = self.receive + self.sent.len() as u64;
        self.last_ack = self.receive;
        self.ignore_nak = 0;
        self.retransmitted = self.receive;
    }

    fn acknowledge(&mut self, count: u64, at: Instant) {
        self.heard_at = at;
        self.receive += count;
        let mut sent_at = at;
        for sent in self.sent.drain(..count as usize) {
            self.sent_bytes -= sent.payload.len() + BLOCK_MIN;
            sent_at = sent.at;
        }
        if self.rtt_sample.is_some_and(|sample| self.receive > sample) {
            self.rtt_sample = None;
            self.measure(at.saturating_duration_since(sent_at));
        }
        self.retransmit_at = at + self.rto;
    }

    /// Adapts the retransmission timeout to a round trip, after RFC 6298.
    fn measure(&mut self, sample: Duration) {
        let (smooth, variation) = match self.round_trip {
            None => (sample * 10, sample / 2),
            Some((smooth, variation)) => ((smooth * 7 + sample) / 8, (variation * 3 + smooth.abs_diff(sample)) / 4),
        };
        self.round_trip = Some((smooth, variation));
        let spread = (variation * 4).max(Duration::from_millis(1));
        self.rto = (smooth + spread).clamp(RTO_MIN, RTO_MAX);
    }

    fn send_again(&mut self, now: Instant) {
        self.port.queue(&[SYNC]);
        for (i, sent) in (0..).zip(&self.sent) {
            let sequence = Sequence::after((self.receive as u32).wrapping_add(i));
            self.port.queue_block(&sent.payload, sequence);
        }
        self.traffic.blocks_again += self.sent.len() as u64;
        self.retransmitted = self.send;
        self.rtt_sample = None;
        self.retransmit_at = now + self.rto;
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::os::unix::net::UnixStream;
    use std::thread;

    use pinion_protocol::block::frame;
    use proptest::prelude::*;

    use super::super::fake::{Fault, Peer, serve};
    use super::*;

    fn numbered(count: u32) -> Vec<Vec<u8>> {
        (0..count).map(|i| i.to_be_bytes().to_vec()).collect()
    }

    fn deliver(faults: &[(u64, Fault)], count: u32) -> (Vec<Vec<u8>>, Traffic) {
        let (peer, mut link) = Peer::start(3, faults, |_| Vec::new());
        for payload in numbered(count) {
            link.send(&payload).unwrap();
        }
        link.settle().unwrap();
        let traffic = link.traffic();
        drop(link);
        (peer.join().unwrap(), traffic)
    }

    #[test]
    fn payloads_arrive_in_order_over_a_faultless_wire() {
        let (got, traffic) = deliver(&[], 100);
        assert_eq!(got, numbered(100));
        assert_eq!((traffic.blocks_sent, traffic.garbage_bytes), (100, 0));
    }

    #[test]
    fn a_lost_and_a_corrupted_block_are_sent_again() {
        let faults = [(5, Fault::Drop), (40, Fault::Corrupt), (99, Fault::Drop)];
        let (got, traffic) = deliver(&faults, 100);
        assert_eq!(got, numbered(100));
        assert!(traffic.naks > 0, "{traffic:?}");
        assert!(traffic.blocks_again >= 3, "{traffic:?}");
    }

    #[test]
    fn the_last_block_lost_twice_is_sent_a_third_time() {
        let (got, traffic) = deliver(&[(9, Fault::Drop), (10, Fault::Drop)], 10);
        assert_eq!(got, numbered(10));
        assert!(traffic.blocks_again >= 2, "{traffic:?}");
    }

    #[test]
    fn after_a_slow_round_trip_a_lost_block_is_sent_again_before_the_link_is_given_up() {
        let (_peer, mut link) = Peer::start(3, &[], |_| Vec::new());
        link.measure(Duration::from_secs(2));
        assert!(link.rto * 5 <= SILENCE, "{:?}", link.rto);
    }

    #[test]
    fn a_lost_acknowledgement_delivers_nothing_twice() {
        let (got, _) = deliver(&[(0, Fault::MuteAck), (19, Fault::MuteAck)], 20);
        assert_eq!(got, numbered(20));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn whatever_is_lost_arrives_once_and_in_order(
            faults in proptest::collection::vec((0u64..60, 0u8..4), 0..12),
        ) {
            let kinds = [Fault::Drop, Fault::Corrupt, Fault::MuteAck, Fault::DoubleAck];
            let faults: Vec<_> = faults.iter().map(|(at, kind)| (*at, kinds[usize::from(*kind)])).collect();
            prop_assert_eq!(deliver(&faults, 40).0, numbered(40));
        }
    }

    #[test]
    fn settling_waits_for_the_last_acknowledgement() {
        let (peer, mut link) = Peer::start(0, &[], |_| Vec::new());
        for _ in 0..5000 {
            link.send(b"nop").unwrap();
        }
        link.settle().unwrap();
        assert_eq!(link.unacknowledged(), 0);
        drop(link);
        assert_eq!(peer.join().unwrap().len(), 5000);
    }

    /// The other end had not finished blocks of an earlier session when this one began.
    #[test]
    fn acknowledgements_of_an_earlier_session_do_not_keep_a_session_from_its_beginning() {
        for earlier in 0..16 {
            let (ours, mut theirs) = UnixStream::pair().unwrap();
            let mut acknowledgement = Vec::new();
            frame(&[], Sequence::after(earlier), &mut acknowledgement);
            theirs.write_all(&acknowledgement).unwrap();
            let port = Port::from_fd(ours.into(), "busy").unwrap();
            let mut link = BlockLink::new(port, Duration::from_secs(60)).unwrap();
            link.send(b"first").unwrap();
            let peer = thread::spawn(move || serve(theirs, 5, &[], |payload| vec![payload.to_vec()]));
            while link.receive_unsettled().unwrap().is_none() {
                link.send(b"again").unwrap();
            }
            drop(link);
            assert_eq!(peer.join().unwrap().len(), 1, "{earlier}");
        }
    }

    #[test]
    fn a_narrow_receive_window_is_respected() {
        let (peer, mut link) = Peer::start(0, &[], |_| Vec::new());
        link.set_window_bytes(192);
        for _ in 0..50 {
            link.send(&[1; PAYLOAD_MAX]).unwrap();
            assert!(link.unacknowledged() <= 3);
        }
        drop(link);
        peer.join().unwrap();
    }

    #[test]
    fn silence_and_a_closed_end_are_reported() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let port = Port::from_fd(ours.into(), "mute").unwrap();
        let error = BlockLink::new(port, Duration::from_millis(50)).unwrap_err();
        assert!(error.to_string().starts_with("no answer on mute within 0.1 s"), "{error}");
        drop(theirs);
        let (ours, theirs) = UnixStream::pair().unwrap();
        drop(theirs);
        let port = Port::from_fd(ours.into(), "gone").unwrap();
        let error = BlockLink::new(port, Duration::from_secs(60)).unwrap_err();
        assert!(error.to_string().starts_with("gone was closed"), "{error}");
        let error = BlockLink::open(Path::new("/dev/no-such-tty"), Duration::ZERO).unwrap_err();
        assert!(error.to_string().starts_with("cannot open /dev/no-such-tty: No such file"), "{error}");
    }
}
