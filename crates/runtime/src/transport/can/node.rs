// SPDX-License-Identifier: GPL-3.0-or-later
//! How a node gets its nodeid, and how it understands a frame (docs/CANBUS_protocol.md and src/generic/canserial.c of
//! Klipper). No socket is needed for that.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use pinion_firmware::mcu::{CANBUS_UUID_BYTES, CanNode};

/// The CAN id of a host's messages to all nodes.
pub(super) const ADMIN_ID: u16 = 0x3f0;
/// The CAN id of the answers.
pub(super) const ADMIN_ANSWER_ID: u16 = 0x3f1;
/// A node without a nodeid shall say so.
const QUERY_UNASSIGNED: u8 = 0x00;
/// The node with this UUID gets this nodeid.
const SET_KLIPPER_NODEID: u8 = 0x01;
/// A node says that it has no nodeid.
const NEED_NODEID: u8 = 0x20;
/// Longest frame.
pub(super) const FRAME_BYTES_MAX: usize = 8;
/// The seed of Klipper's hash.
const UUID_SEED: u64 = 0xa162_31a7;

/// The name of a node, as `canbus_uuid` in printer.cfg has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CanbusUuid(pub(super) [u8; CANBUS_UUID_BYTES]);

impl CanbusUuid {
    /// The hash of a computer's own identity, as Klipper's C hashes the number of a chip.
    pub fn of(identity: &[u8]) -> CanbusUuid {
        let [a, b, c, d, e, f, ..] = fasthash64(identity, UUID_SEED).to_le_bytes();
        CanbusUuid([a, b, c, d, e, f])
    }
}

impl fmt::Display for CanbusUuid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl FromStr for CanbusUuid {
    type Err = String;

    fn from_str(text: &str) -> Result<CanbusUuid, String> {
        let is_uuid = text.len() == 2 * CANBUS_UUID_BYTES && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let [_, _, uuid @ ..] = u64::from_str_radix(text, 16)
            .ok()
            .filter(|_| is_uuid)
            .ok_or("a canbus_uuid has 12 hexadecimal digits")?
            .to_be_bytes();
        Ok(CanbusUuid(uuid))
    }
}

/// Zilong Tan's fast-hash, as Klipper's C uses it.
fn fasthash64(bytes: &[u8], seed: u64) -> u64 {
    const M: u64 = 0x8803_55f2_1e6d_1965;
    let mix = |mut hash: u64| {
        hash ^= hash >> 23;
        hash = hash.wrapping_mul(0x2127_599b_f432_5c37);
        hash ^ hash >> 47
    };
    let start = seed ^ (bytes.len() as u64).wrapping_mul(M);
    mix(bytes.chunks(8).fold(start, |hash, chunk| {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        (hash ^ mix(u64::from_le_bytes(word))).wrapping_mul(M)
    }))
}

/// The effect of a frame on the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meaning {
    /// Nothing.
    Nothing,
    /// Bytes of the host for the MCU.
    Data,
    /// The host asks for nodes without a nodeid: send [`Node::need_nodeid`].
    Query,
    /// A host has begun to talk to this node, by this nodeid.
    Assigned,
    /// Another node has our CAN ids. Ours has none any more.
    Conflict,
}

/// A node.
pub(super) struct Node {
    /// Klipper's `assigned_id`: the id of the host's frames. The answers have the next one.
    assigned_id: Option<u16>,
    shared: Arc<CanNode>,
}

impl Node {
    /// A node without a nodeid.
    pub(super) fn new(shared: Arc<CanNode>) -> Node {
        Node { assigned_id: None, shared }
    }

    /// The node's state, for the core.
    pub(super) fn shared(&self) -> &Arc<CanNode> {
        &self.shared
    }

    /// The ids of the frames that concern the node.
    pub(super) fn ids(&self) -> impl Iterator<Item = u16> {
        [ADMIN_ID].into_iter().chain(self.assigned_id.into_iter().flat_map(|id| [id, id + 1]))
    }

    /// The id of our frames, if there is one.
    pub(super) fn answer_id(&self) -> Option<u16> {
        self.assigned_id.map(|id| id + 1)
    }

    /// Our answer to a query.
    pub(super) fn need_nodeid(&self) -> [u8; FRAME_BYTES_MAX] {
        let [a, b, c, d, e, f] = self.shared.uuid;
        [NEED_NODEID, a, b, c, d, e, f, SET_KLIPPER_NODEID]
    }

    /// Takes a frame in.
    pub(super) fn take(&mut self, id: u16, data: &[u8]) -> Meaning {
        if Some(id) == self.assigned_id {
            return Meaning::Data;
        }
        if Some(id) == self.answer_id() {
            return self.yield_id();
        }
        match data {
            [QUERY_UNASSIGNED, ..] if id == ADMIN_ID && self.assigned_id.is_none() => Meaning::Query,
            [SET_KLIPPER_NODEID, uuid @ .., node_id] if id == ADMIN_ID && uuid.len() == CANBUS_UUID_BYTES => {
                let new_id = 0x100 + 2 * u16::from(*node_id);
                if uuid == self.shared.uuid {
                    self.assigned_id = Some(new_id);
                    self.shared.assign(*node_id);
                    Meaning::Assigned
                } else if Some(new_id) == self.assigned_id {
                    self.yield_id()
                } else {
                    Meaning::Nothing
                }
            }
            _ => Meaning::Nothing,
        }
    }

    fn yield_id(&mut self) -> Meaning {
        self.assigned_id = None;
        self.shared.assign(0);
        Meaning::Conflict
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const UUID: [u8; 6] = [1, 2, 3, 4, 5, 6];
    const OTHER: [u8; 6] = [1, 2, 3, 4, 5, 7];

    fn node() -> Node {
        Node::new(Arc::new(CanNode::new(UUID, None)))
    }

    fn set(uuid: [u8; 6], node_id: u8) -> [u8; 8] {
        let [a, b, c, d, e, f] = uuid;
        [1, a, b, c, d, e, f, node_id]
    }

    #[test]
    fn a_node_answers_queries_until_it_has_a_nodeid() {
        let mut node = node();
        assert_eq!(node.ids().collect::<Vec<_>>(), [0x3f0]);
        assert_eq!(node.take(0x3f0, &[0]), Meaning::Query);
        assert_eq!(node.need_nodeid(), [0x20, 1, 2, 3, 4, 5, 6, 1]);
        assert_eq!(node.take(0x108, b"data"), Meaning::Nothing, "it has no nodeid");
        assert_eq!(node.take(0x3f0, &set(OTHER, 4)), Meaning::Nothing);
        assert_eq!(node.take(0x3f0, &set(UUID, 4)), Meaning::Assigned);
        assert_eq!((node.answer_id(), node.shared().node_id()), (Some(0x109), 4));
        assert_eq!(node.ids().collect::<Vec<_>>(), [0x3f0, 0x108, 0x109]);
        assert_eq!(node.take(0x3f0, &[0]), Meaning::Nothing, "it has one");
        assert_eq!(node.take(0x108, b"data"), Meaning::Data);
        // A restarted host may count anew.
        assert_eq!(node.take(0x3f0, &set(UUID, 5)), Meaning::Assigned);
        assert_eq!(node.answer_id(), Some(0x10b));
    }

    #[test]
    fn a_node_with_the_ids_of_another_gives_them_up() {
        for (id, frame) in [(0x3f0, &set(OTHER, 4)[..]), (0x109, b"data")] {
            let mut node = node();
            node.take(0x3f0, &set(UUID, 4));
            assert_eq!(node.take(id, frame), Meaning::Conflict, "{id:x}");
            assert_eq!((node.answer_id(), node.shared().node_id()), (None, 0));
            assert_eq!(node.take(0x108, b"data"), Meaning::Nothing);
        }
    }

    #[test]
    fn frames_that_are_cut_short_mean_nothing() {
        let mut node = node();
        for len in 0..8 {
            let data = &set(UUID, 4)[..len];
            assert_eq!(node.take(0x3f0, data), Meaning::Nothing, "{data:?}");
        }
        // For the bootloader of a chip.
        assert_eq!(node.take(0x3f0, &[2, 1, 2, 3, 4, 5, 6]), Meaning::Nothing);
    }

    #[test]
    fn a_uuid_is_the_firmwares_hash() {
        // Results of fasthash64 of Klipper's lib/fast-hash, with Klipper's seed.
        for (identity, uuid) in [
            ("", "bc1b64c6908d"),
            ("a", "bee6cb50dcb3"),
            ("12345678", "e1ecef1ecfe5"),
            ("0123456789abcdef0123456789abcdef", "15a566ad3038"),
            ("b08dfa6083e7567a1921a715000001fb\n", "980915199743"),
        ] {
            assert_eq!(CanbusUuid::of(identity.as_bytes()).to_string(), uuid, "{identity}");
        }
        assert_eq!("0102030405ff".parse(), Ok(CanbusUuid([1, 2, 3, 4, 5, 0xff])));
        for text in ["", "0102030405f", "0102030405fff", "0x1203040506", "+10203040506"] {
            assert!(text.parse::<CanbusUuid>().is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn no_frame_makes_a_node_answer_by_an_id_that_nobody_gave_it(
            frames in prop::collection::vec((0x3ee_u16..0x3f3, prop::collection::vec(0_u8..4, 0..9)), 0..40),
        ) {
            let mut node = node();
            for (id, data) in frames {
                node.take(id, &data);
                let expected = node.shared().node_id();
                prop_assert_eq!(node.answer_id().map(|id| id - 0x101), node.answer_id().map(|_| 2 * u16::from(expected)));
            }
        }
    }
}
