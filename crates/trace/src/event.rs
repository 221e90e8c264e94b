// SPDX-License-Identifier: GPL-3.0-or-later
//! Events of a recording: what happened, in 16 bytes with its time.

use std::fmt;

use pinion_firmware::time::{Clock, Ticks};
use pinion_protocol::block::Refusal;

/// Number of words of an encoded event.
pub const EVENT_WORDS: usize = 2;

/// Bits of the first word below the time. They hold the kind.
const KIND_BITS: u32 = 8;

/// One thing that happened in a thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The writer left out this many events, because its ring has to last.
    Omitted(u32),

    /// The core woke from a sleep of this span, this long after the time it wanted. Zero: something woke it earlier.
    Woke {
        /// How long it slept.
        slept: Ticks,
        /// How late it woke.
        late: Ticks,
    },
    /// A timer ran this late. `oid`: its object; `None` for the MCU's own.
    Late {
        /// The object.
        oid: Option<u8>,
        /// How late.
        late: Ticks,
    },
    /// The core ran timers since the last event of this kind.
    Pace {
        /// The latest one.
        worst: Ticks,
    },
    /// The core began a block of the host. Blocks are counted from the start of the program.
    Block(u32),
    /// The core ran this command. `more`: the number of commands that followed it at once.
    Command {
        /// Its id in the dictionary. It may be negative.
        id: i16,
        /// Commands of the same block behind it.
        more: u8,
    },
    /// Commands began to wait for a bus.
    Held,
    /// Commands no longer wait for a bus.
    Released,
    /// A host has configured the MCU.
    Configured,
    /// The MCU has no configuration.
    Reset,
    /// The MCU stopped while it ran this block of the host.
    Stopped {
        /// The block that the core had begun last.
        block: u32,
    },
    /// The time that the stop was about: a step or another event came too late for it.
    Due(Clock),
    /// The thread's scheduling is now this: SCHED_FIFO, or SCHED_OTHER to stay within the kernel's budget.
    Scheduling {
        /// Whether it is SCHED_FIFO.
        fifo: bool,
    },

    /// The link read this block from the host.
    BlockIn(u32),
    /// The link wrote this many bytes to the host.
    Out(u32),
    /// A host opened the terminal. On a wire: its first bytes came.
    HostCame,
    /// The last host closed the terminal. On a wire: it was silent for too long, or the port was gone.
    HostGone,
    /// The link refused bytes from the host.
    Refused(Refusal),
    /// The link refused a block, and asked the host to send again from a sequence number on.
    Nak,
    /// The link answered a block with this command by itself.
    Answered {
        /// Its id in the dictionary. It may be negative.
        id: i16,
    },
    /// The core has no room for the host's blocks.
    Full,
    /// A sync byte came between blocks: the host's computer is there, and its host says nothing.
    Alive,

    /// A worker began a job.
    JobBegan {
        /// The object that sent it; `None` for one without an oid.
        oid: Option<u8>,
        /// How long it waited for the worker.
        waited: Ticks,
    },
    /// A worker finished its job.
    JobEnded {
        /// The object that sent it; `None` for one without an oid.
        oid: Option<u8>,
        /// How long it took.
        took: Ticks,
    },

    /// The kernel's account of a thread since the last event of this kind (schedstat).
    Processor {
        /// Which thread.
        thread: Watched,
        /// How long it ran.
        ran: Ticks,
        /// How long it waited for a processor.
        waited: Ticks,
    },
    /// The recorder has looked at the kernel's accounts. It comes behind the events of its findings.
    Looked {
        /// The next sample comes within this time.
        again: Ticks,
        /// Whether it looked at everything, and not only at the threads.
        all: bool,
    },
    /// A hypervisor took this much processor time since the recorder last looked at everything.
    Stolen(Ticks),
    /// The computer's power supply or temperature has this fault; `None`: no more.
    Power(Option<PowerFault>),
    /// The fastest processor's frequency.
    Frequency {
        /// Now.
        mhz: u16,
        /// The highest possible one.
        max_mhz: u16,
    },

    /// The guardian listened to the core.
    Listened,

    /// An output's level changed.
    Edge {
        /// The line's number on the wire.
        pin: u32,
        /// Its level.
        level: bool,
    },
}

/// A thread that the kernel's account is read for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watched {
    /// The core.
    Core,
    /// The link.
    Link,
}

impl fmt::Display for Watched {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if *self == Watched::Core { "core" } else { "link" })
    }
}

/// A fault of the computer itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PowerFault {
    /// The supply's voltage is too low.
    Undervoltage,
    /// The processor is slowed down because it is too hot.
    Hot,
}

fn pair(low: u32, high: u32) -> u64 {
    u64::from(low) | u64::from(high) << 32
}

/// An oid, or no oid.
fn number(oid: Option<u8>) -> u32 {
    oid.map_or(u32::MAX, u32::from)
}

impl Event {
    /// The event at this time as words. Times need 56 bits: they last for 45 years.
    #[inline]
    pub fn encode(self, at: Clock) -> [u64; EVENT_WORDS] {
        let (kind, payload) = self.parts();
        [at.to_bits() << KIND_BITS | u64::from(kind), payload]
    }

    #[inline]
    fn parts(self) -> (u8, u64) {
        match self {
            Event::Omitted(count) => (1, count.into()),
            Event::Woke { slept, late } => (2, pair(slept.0, late.0)),
            Event::Late { oid, late } => (3, pair(late.0, number(oid))),
            Event::Pace { worst } => (4, worst.0.into()),
            Event::Block(number) => (5, number.into()),
            Event::Command { id, more } => (6, pair(id.cast_unsigned().into(), more.into())),
            Event::Held => (7, 0),
            Event::Released => (8, 0),
            Event::Configured => (9, 0),
            Event::Reset => (10, 0),
            Event::Stopped { block } => (11, block.into()),
            Event::Due(at) => (12, at.to_bits()),
            Event::Scheduling { fifo } => (13, fifo.into()),
            Event::BlockIn(number) => (20, number.into()),
            Event::Out(bytes) => (21, bytes.into()),
            Event::HostCame => (22, 0),
            Event::HostGone => (23, 0),
            Event::Refused(Refusal::Garbage) => (24, 0),
            Event::Refused(Refusal::Lost) => (24, 1),
            Event::Refused(Refusal::Repeated) => (24, 2),
            Event::Full => (25, 0),
            Event::Nak => (26, 0),
            Event::Answered { id } => (27, id.cast_unsigned().into()),
            Event::Alive => (28, 0),
            Event::JobBegan { oid, waited } => (30, pair(waited.0, number(oid))),
            Event::JobEnded { oid, took } => (31, pair(took.0, number(oid))),
            Event::Processor { thread: Watched::Core, ran, waited } => (40, pair(ran.0, waited.0)),
            Event::Processor { thread: Watched::Link, ran, waited } => (41, pair(ran.0, waited.0)),
            Event::Stolen(ticks) => (42, ticks.0.into()),
            Event::Power(None) => (43, 0),
            Event::Power(Some(PowerFault::Undervoltage)) => (43, 1),
            Event::Power(Some(PowerFault::Hot)) => (43, 2),
            Event::Frequency { mhz, max_mhz } => (44, pair(mhz.into(), max_mhz.into())),
            Event::Looked { again, all } => (45, pair(again.0, all.into())),
            Event::Listened => (50, 0),
            Event::Edge { pin, level } => (60, pair(pin, level.into())),
        }
    }

    /// The event of these words, with its time; `None` for a kind that this version does not know.
    pub fn decode([first, payload]: [u64; EVENT_WORDS]) -> Option<(Clock, Event)> {
        let (low, high) = (payload as u32, (payload >> 32) as u32);
        let event = match first as u8 {
            1 => Event::Omitted(low),
            2 => Event::Woke { slept: Ticks(low), late: Ticks(high) },
            3 => Event::Late { oid: u8::try_from(high).ok(), late: Ticks(low) },
            4 => Event::Pace { worst: Ticks(low) },
            5 => Event::Block(low),
            6 => Event::Command { id: low as i16, more: high as u8 },
            7 => Event::Held,
            8 => Event::Released,
            9 => Event::Configured,
            10 => Event::Reset,
            11 => Event::Stopped { block: low },
            12 => Event::Due(Clock::from_bits(payload)),
            13 => Event::Scheduling { fifo: low != 0 },
            20 => Event::BlockIn(low),
            21 => Event::Out(low),
            22 => Event::HostCame,
            23 => Event::HostGone,
            24 => Event::Refused(match low {
                0 => Refusal::Garbage,
                1 => Refusal::Lost,
                2 => Refusal::Repeated,
                _ => return None,
            }),
            25 => Event::Full,
            26 => Event::Nak,
            27 => Event::Answered { id: low as i16 },
            28 => Event::Alive,
            30 => Event::JobBegan { oid: u8::try_from(high).ok(), waited: Ticks(low) },
            31 => Event::JobEnded { oid: u8::try_from(high).ok(), took: Ticks(low) },
            40 => Event::Processor { thread: Watched::Core, ran: Ticks(low), waited: Ticks(high) },
            41 => Event::Processor { thread: Watched::Link, ran: Ticks(low), waited: Ticks(high) },
            42 => Event::Stolen(Ticks(low)),
            43 => Event::Power(match low {
                0 => None,
                1 => Some(PowerFault::Undervoltage),
                2 => Some(PowerFault::Hot),
                _ => return None,
            }),
            44 => Event::Frequency { mhz: low as u16, max_mhz: high as u16 },
            45 => Event::Looked { again: Ticks(low), all: high != 0 },
            50 => Event::Listened,
            60 => Event::Edge { pin: low, level: high != 0 },
            _ => return None,
        };
        Some((Clock::from_bits(first >> KIND_BITS), event))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// The bits of all fields come back, and no bits make a panic.
        #[test]
        fn every_event_is_what_it_was(kind: u8, at in 0u64..1 << 56, payload: u64) {
            let words = [at << 8 | u64::from(kind), payload];
            if let Some((time, event)) = Event::decode(words) {
                prop_assert_eq!(time.to_bits(), at);
                let encoded = event.encode(time);
                prop_assert_eq!(Event::decode(encoded), Some((time, event)));
                prop_assert_eq!(encoded[0], words[0]);
            }
        }
    }
}
