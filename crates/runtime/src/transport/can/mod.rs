// SPDX-License-Identifier: GPL-3.0-or-later
//! A CAN bus, by the protocol of Klipper's C. The frames of a host carry the bytes of its blocks, eight in
//! each, and so do ours. `node.rs` has the protocol, and this file the socket.

use std::fs;
use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;
use std::time::Duration;

use log::{info, warn};
use nix::sys::socket::{AddressFamily, SockFlag, SockProtocol, SockType, setsockopt, socket, sockopt};
use socketcan::{
    CanDataFrame, CanErrorFrame, CanFilter, CanFrame, CanSocket, EmbeddedFrame as _, Id, Socket as _,
    SocketOptions as _, StandardId,
};

use pinion_firmware::feature::canbus::ID_CONFLICT;
use pinion_firmware::mcu::{CanNode, CanState, Wire};
use pinion_firmware::shutdown::Shutdown;
use pinion_firmware::trouble::Trouble;
use pinion_linux::can;
use pinion_linux::clock::monotonic;

use super::{Input, Transport};
use crate::trouble::refused;

mod node;

pub use node::CanbusUuid;
use node::{ADMIN_ANSWER_ID, FRAME_BYTES_MAX, Meaning, Node};

/// The identity of this computer (machine-id(5)).
const MACHINE_ID: &str = "/etc/machine-id";
/// When to try again if the interface's queue is full. Eight frames take a millisecond at 1 Mbit/s.
const FULL_PAUSE: Duration = Duration::from_millis(1);
/// How long to wait before an interface that is gone is looked for again.
const REOPEN: Duration = Duration::from_secs(1);
/// Highest number of frames that one read takes.
const FRAMES_MAX: usize = 256;
const NAME_ONE: &str = "name a CAN interface (ip link show type can)";
/// A frame of another kind than 11-bit data never fits this.
const FILTER_MASK: u32 = libc::CAN_SFF_MASK | libc::CAN_EFF_FLAG | libc::CAN_RTR_FLAG;
/// Which errors the interface shall report.
const ERRORS: u32 =
    libc::CAN_ERR_LOSTARB | CRTL | libc::CAN_ERR_ACK | BUSOFF | libc::CAN_ERR_BUSERROR | RESTARTED | CNT;
const CRTL: u32 = libc::CAN_ERR_CRTL;
const BUSOFF: u32 = libc::CAN_ERR_BUSOFF;
const RESTARTED: u32 = libc::CAN_ERR_RESTARTED;
/// Counters are in the bytes 6 and 7 (linux/can/error.h).
const CNT: u32 = 0x200;

/// A CAN bus.
pub(crate) struct CanBus {
    interface: String,
    node: Node,
    state: State,
    /// The interface is up, as far as we know.
    is_up: bool,
    /// Our answer to a query has to go out.
    owes_answer: bool,
    /// The interface's queue was full. When to try again.
    full_until: Option<Duration>,
    /// A host has our nodeid, and has said something.
    is_met: bool,
    /// A host has assigned the nodeid anew.
    is_renewed: bool,
    intrusion: Option<Shutdown>,
}

enum State {
    Open(CanSocket),
    /// It is not there. The time of the next try.
    Gone(Duration),
}

/// The UUID of this computer.
///
/// # Errors
///
/// It has no identity.
pub fn uuid() -> Result<CanbusUuid, Trouble> {
    let id = fs::read_to_string(MACHINE_ID).map_err(|error| refused(MACHINE_ID, error));
    let id = id.and_then(|id| match id.trim() {
        "" | "uninitialized" => Err(Trouble::new("it is empty").of(MACHINE_ID)),
        id => Ok(CanbusUuid::of(id.as_bytes())),
    });
    id.map_err(|trouble| trouble.remedy("sudo systemd-machine-id-setup, or name a UUID: can:can0,0123456789ab"))
}

/// Whether an interface can be opened, now or when its adapter is there.
///
/// # Errors
///
/// The kernel has no CAN, this program may not use it, or the interface is of another kind.
pub fn can_open(interface: &str) -> Result<(), Trouble> {
    // In the service without its drop-in there are no interfaces either. This error says more.
    let opened = socket(AddressFamily::Can, SockType::Raw, SockFlag::SOCK_CLOEXEC, SockProtocol::CanRaw);
    opened.map_err(|error| refusal(interface, error.into()))?;
    if can::is_other(interface) {
        return Err(Trouble::new("it is not a CAN interface").of(interface).remedy(NAME_ONE));
    }
    Ok(())
}

fn refusal(interface: &str, error: io::Error) -> Trouble {
    let remedy = match error.raw_os_error() {
        Some(libc::EAFNOSUPPORT | libc::EPROTONOSUPPORT) => {
            "load the module can_raw; in the service install its drop-in for CAN (docs/guide/another-computer.md)"
        }
        _ => NAME_ONE,
    };
    refused(format_args!("the CAN interface {interface} cannot be opened"), error).remedy(remedy)
}

impl CanBus {
    /// Opens an interface. One that is not there is opened later. Without a `uuid` the node has this computer's.
    pub(crate) fn open(interface: &str, uuid: Option<CanbusUuid>) -> Result<CanBus, Trouble> {
        let CanbusUuid(uuid) = uuid.map_or_else(self::uuid, Ok)?;
        can_open(interface)?;
        let mut bus = CanBus::closed(interface, CanNode::new(uuid, bitrate(interface)));
        match bus.bind() {
            Ok(socket) => bus.state = State::Open(socket),
            Err(error) if error.raw_os_error() == Some(libc::ENODEV) => {
                warn!(
                    "there is no CAN interface {interface}: plug in its adapter, or load its overlay (Pinion opens it when it is there)"
                );
                bus.state = State::Gone(monotonic() + REOPEN);
            }
            Err(error) => return Err(refusal(interface, error)),
        }
        Ok(bus)
    }

    /// A bus whose interface is not opened yet.
    fn closed(interface: &str, node: CanNode) -> CanBus {
        CanBus {
            interface: interface.to_owned(),
            node: Node::new(Arc::new(node)),
            state: State::Gone(Duration::MAX),
            is_up: true,
            owes_answer: false,
            full_until: None,
            is_met: false,
            is_renewed: false,
            intrusion: None,
        }
    }

    fn bind(&self) -> io::Result<CanSocket> {
        let socket = CanSocket::open(&self.interface)?;
        socket.set_nonblocking(true)?;
        socket.set_error_filter(ERRORS)?;
        self.filter(&socket)?;
        // The kernel's smallest buffer holds fewer frames than an interface's queue. So the socket reports when there
        // is room for more, and the queue is never full of ours.
        setsockopt(&socket, sockopt::SndBuf, &0)?;
        Ok(socket)
    }

    /// Lets the kernel drop the frames that are not for us.
    fn filter(&self, socket: &CanSocket) -> io::Result<()> {
        let filters: Vec<CanFilter> = self.node.ids().map(|id| CanFilter::new(id.into(), FILTER_MASK)).collect();
        socket.set_filters(&filters)
    }

    /// Looks for the interface again.
    fn reopen(&mut self) {
        match self.bind() {
            Ok(socket) => {
                info!("the CAN interface {} is there", self.interface);
                self.state = State::Open(socket);
            }
            Err(_) => self.state = State::Gone(monotonic() + REOPEN),
        }
    }

    /// The socket has failed with this error.
    fn failed(&mut self, error: &io::Error) -> Input {
        match error.raw_os_error() {
            Some(libc::ENETDOWN) => {
                if self.is_up {
                    warn!("the CAN interface {} is down: sudo ip link set {} up", self.interface, self.interface);
                }
                self.is_up = false;
                // The socket works again when the interface is up.
                Input::Bytes(0)
            }
            _ => {
                warn!(
                    "the CAN interface {} is gone: {error}: plug its adapter in again (Pinion opens it when it is there)",
                    self.interface
                );
                self.state = State::Gone(monotonic() + REOPEN);
                Input::Gone
            }
        }
    }

    /// Takes a frame in. The number of bytes for the MCU.
    fn take(&mut self, frame: &CanFrame, buffer: &mut [u8]) -> usize {
        let (id, data) = match frame {
            // A new socket takes all frames until it has its filter.
            CanFrame::Data(frame) => match frame.id() {
                Id::Standard(id) => (id.as_raw(), frame.data()),
                Id::Extended(_) => return 0,
            },
            CanFrame::Remote(_) => return 0,
            CanFrame::Error(error) => {
                self.note_error(error);
                return 0;
            }
        };
        if !self.is_up {
            self.is_up = true;
            info!("the CAN interface {} is up", self.interface);
        }
        match self.node.take(id, data) {
            Meaning::Nothing => {}
            Meaning::Query => self.owes_answer = true,
            Meaning::Data => {
                buffer[..data.len()].copy_from_slice(data);
                return data.len();
            }
            Meaning::Assigned => self.is_renewed = true,
            Meaning::Conflict => {
                let cause = format!("another node of {} sends with our nodeid", self.interface);
                let remedy = "give each node another canbus_uuid, and let one host only assign nodeids";
                self.intrusion = Some(Shutdown::because(ID_CONFLICT, cause).remedy(remedy));
            }
        }
        0
    }

    /// Frames about errors (linux/can/error.h).
    fn note_error(&self, error: &CanErrorFrame) {
        let (bits, data) = (error.error_bits(), error.data());
        let before = self.node.shared().health();
        let mut health = before;
        let byte = |index: usize| data.get(index).copied().unwrap_or(0);
        if bits & CNT != 0 {
            (health.tx_error, health.rx_error) = (byte(6).into(), byte(7).into());
        }
        if bits & (libc::CAN_ERR_LOSTARB | libc::CAN_ERR_ACK | libc::CAN_ERR_BUSERROR) != 0 {
            health.tx_retries = health.tx_retries.wrapping_add(1);
        }
        health.state = state(bits, byte(1), before.state);
        self.node.shared().report(health);
        if health.state == before.state {
            return;
        }
        let name = &self.interface;
        match health.state {
            CanState::Off => warn!(
                "the CAN interface {name} is off the bus after too many errors: look at its wiring, its two resistors of 120 ohms and its bitrate; let it come back by itself: sudo ip link set {name} type can restart-ms 100"
            ),
            CanState::Passive => warn!(
                "the CAN interface {name} sees many errors: look at its wiring, its two resistors of 120 ohms and its bitrate (ip -details -statistics link show {name})"
            ),
            _ => info!(
                "the CAN interface {name} is {}",
                if health.state == CanState::Active { "well" } else { "less well" }
            ),
        }
    }

    /// Sends our answer to a query.
    fn answer(&mut self) {
        let State::Open(socket) = &self.state else { return };
        let Some(frame) = frame(ADMIN_ANSWER_ID, &self.node.need_nodeid()) else { return };
        match socket.write_frame(&frame) {
            Err(error) if is_full(&error) => self.full_until = Some(monotonic() + FULL_PAUSE),
            // A read gives the cause. The host asks again.
            _ => self.owes_answer = false,
        }
    }
}

fn bitrate(interface: &str) -> Option<u32> {
    can::interface(interface).ok().and_then(|about| about.bitrate)
}

/// The state after an error frame.
fn state(bits: u32, controller: u8, before: CanState) -> CanState {
    const WARNING: u8 = 0x04 | 0x08;
    const PASSIVE: u8 = 0x10 | 0x20;
    const ACTIVE: u8 = 0x40;
    if bits & BUSOFF != 0 {
        CanState::Off
    } else if bits & RESTARTED != 0 {
        CanState::Active
    } else if bits & CRTL == 0 {
        before
    } else if controller & PASSIVE != 0 {
        CanState::Passive
    } else if controller & WARNING != 0 {
        CanState::Warn
    } else if controller & ACTIVE != 0 {
        CanState::Active
    } else {
        before
    }
}

fn frame(id: u16, data: &[u8]) -> Option<CanDataFrame> {
    CanDataFrame::new(StandardId::new(id)?, data)
}

/// Whether the interface, or the socket, has no room.
fn is_full(error: &io::Error) -> bool {
    error.kind() == ErrorKind::WouldBlock || error.raw_os_error() == Some(libc::ENOBUFS)
}

impl Transport for CanBus {
    fn place(&self) -> String {
        self.interface.clone()
    }

    fn detail(&self) -> String {
        format!("canbus_uuid {}", CanbusUuid(self.node.shared().uuid))
    }

    fn wire(&self) -> Wire {
        Wire::Can(self.node.shared().clone())
    }

    fn event(&self) -> Option<BorrowedFd<'_>> {
        match &self.state {
            State::Open(socket) => Some(socket.as_fd()),
            State::Gone(_) => None,
        }
    }

    fn due(&self) -> Option<Duration> {
        let reopen = match self.state {
            State::Open(_) => None,
            State::Gone(until) => Some(until),
        };
        let renewed = (self.is_renewed && self.is_met).then_some(Duration::ZERO);
        reopen.into_iter().chain(self.full_until).chain(renewed).min()
    }

    fn read(&mut self, buffer: &mut [u8], _hung_up: bool) -> io::Result<Input> {
        // The pause is over, even if there is nothing to write any more.
        self.full_until = None;
        if std::mem::take(&mut self.is_renewed) && self.is_met {
            return Ok(Input::Gone);
        }
        let (mut len, mut frames) = (0, 0);
        // A whole frame must fit. Frames without bytes for the MCU must not keep the link, however many there are.
        while buffer.len() - len >= FRAME_BYTES_MAX && !self.is_renewed && frames < FRAMES_MAX {
            frames += 1;
            let State::Open(socket) = &self.state else {
                if self.due().is_some_and(|due| monotonic() >= due) {
                    self.reopen();
                }
                break;
            };
            match socket.read_frame() {
                Ok(frame) => len += self.take(&frame, &mut buffer[len..]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if len == 0 => return Ok(self.failed(&error)),
                // The next read finds it again, or the interface is back.
                Err(error) => {
                    let _ = self.failed(&error);
                    break;
                }
            }
        }
        if self.is_renewed
            && let State::Open(socket) = &self.state
        {
            if let Err(error) = self.filter(socket) {
                // The interface is gone.
                return Ok(self.failed(&error));
            }
            // It may have been set since the start. The new host reads the dictionary after this.
            self.node.shared().set_frequency(bitrate(&self.interface));
            self.is_renewed = self.is_met;
        }
        if self.owes_answer {
            self.answer();
        }
        Ok(Input::Bytes(len))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.full_until = None;
        let (State::Open(socket), Some(id)) = (&self.state, self.node.answer_id()) else { return Ok(bytes.len()) };
        let mut written = 0;
        for data in bytes.chunks(FRAME_BYTES_MAX) {
            let Some(frame) = frame(id, data) else { break };
            match socket.write_frame(&frame) {
                Ok(()) => written += data.len(),
                Err(error) if error.raw_os_error() == Some(libc::ENOBUFS) => {
                    // Frames of other programs fill the queue. The socket does not report when there is room.
                    self.full_until = Some(monotonic() + FULL_PAUSE);
                    break;
                }
                // The next frame may not go before this one.
                Err(error) if is_full(&error) || error.kind() == ErrorKind::Interrupted => break,
                // A read reports that the interface is down or gone. The host asks again for lost answers.
                Err(_) => return Ok(bytes.len()),
            }
        }
        Ok(written)
    }

    fn meet_host(&mut self) -> bool {
        self.is_met = true;
        true
    }

    fn part_from_host(&mut self) {
        self.is_met = false;
    }

    fn intrusion(&mut self) -> Option<Shutdown> {
        self.intrusion.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use socketcan::{CanRemoteFrame, ExtendedId};

    #[test]
    fn error_frames_show_the_state_of_the_bus() {
        let active = CanState::Active;
        assert_eq!(state(CRTL, 0x08, active), CanState::Warn);
        assert_eq!(state(CRTL, 0x04 | 0x10, active), CanState::Passive);
        assert_eq!(state(CRTL, 0x40, CanState::Passive), CanState::Active);
        assert_eq!(state(CNT, 0x20, active), CanState::Active, "it is not about the controller");
        assert_eq!(state(BUSOFF, 0, active), CanState::Off);
        assert_eq!(state(RESTARTED, 0, CanState::Off), CanState::Active);
        // An overflow of the interface's buffer changes no state.
        assert_eq!(state(CRTL, 0x01, CanState::Warn), CanState::Warn);
    }

    /// A bus without an interface.
    fn closed() -> CanBus {
        CanBus::closed("can7", CanNode::new([1, 2, 3, 4, 5, 6], None))
    }

    /// Has the bus take a frame. The bytes for the MCU.
    fn taken(bus: &mut CanBus, frame: impl Into<CanFrame>) -> Vec<u8> {
        let mut buffer = [0; FRAME_BYTES_MAX];
        let len = bus.take(&frame.into(), &mut buffer);
        buffer[..len].to_vec()
    }

    #[test]
    fn only_data_frames_with_the_nodes_own_ids_of_11_bits_mean_something() {
        const SET: [u8; 8] = [1, 1, 2, 3, 4, 5, 6, 4];
        let mut bus = closed();
        // Its lower 11 bits, or its lower 16 bits, are the admin id.
        for id in [0x3f0, 0x103f0, 0x1fff_03f0] {
            taken(&mut bus, CanDataFrame::new(ExtendedId::new(id).unwrap(), &SET).unwrap());
        }
        let id = |id: u16| StandardId::new(id).unwrap();
        taken(&mut bus, CanRemoteFrame::new_remote(id(0x3f0), 8).unwrap());
        taken(&mut bus, CanErrorFrame::new_error(0x3f0, &SET).unwrap());
        assert_eq!(bus.node.answer_id(), None);
        taken(&mut bus, CanDataFrame::new(id(0x3f0), &SET).unwrap());
        assert!(bus.is_renewed && bus.node.answer_id() == Some(0x109));
        assert_eq!(taken(&mut bus, CanDataFrame::new(id(0x108), b"data").unwrap()), b"data");
        assert!(taken(&mut bus, CanDataFrame::new(ExtendedId::new(0x108).unwrap(), b"data").unwrap()).is_empty());
        assert!(taken(&mut bus, CanRemoteFrame::new_remote(id(0x108), 8).unwrap()).is_empty());
        // Nor does one of these look like another node with our id.
        taken(&mut bus, CanDataFrame::new(ExtendedId::new(0x109).unwrap(), b"data").unwrap());
        taken(&mut bus, CanRemoteFrame::new_remote(id(0x109), 8).unwrap());
        assert!(bus.intrusion.is_none());
    }

    proptest! {
        #[test]
        fn any_frames_are_taken(
            frames in prop::collection::vec(
                (any::<u32>(), 0x3ee_u32..0x3f2, 0_u8..5, prop::collection::vec(0_u8..8, 0..9)), 0..60,
            ),
        ) {
            let mut bus = closed();
            for (any, near, kind, data) in frames {
                let id = |id: u32| StandardId::new(id as u16).unwrap();
                let frame: CanFrame = match kind {
                    0 => CanErrorFrame::new_error(any & libc::CAN_ERR_MASK, &data).unwrap().into(),
                    1 => CanRemoteFrame::new_remote(id(near), data.len()).unwrap().into(),
                    2 => CanDataFrame::new(ExtendedId::new(any >> 3).unwrap(), &data).unwrap().into(),
                    // Ids below 0x110 are the node's, once it has one.
                    3 => CanDataFrame::new(id(0x100 + any % 0x10), &data).unwrap().into(),
                    _ => CanDataFrame::new(id(near), &data).unwrap().into(),
                };
                prop_assert!(taken(&mut bus, frame).len() <= data.len());
            }
        }
    }

    #[test]
    fn an_interface_that_is_not_there_is_waited_for() {
        // Without the kernel's CAN it is an error, and that is fine as well.
        match CanBus::open("nocan7", Some("0123456789ab".parse().unwrap())) {
            Ok(bus) => assert!(bus.event().is_none() && bus.due().is_some()),
            Err(trouble) => assert!(trouble.to_string().contains("nocan7 cannot be opened"), "{trouble}"),
        }
    }
}
