// SPDX-License-Identifier: GPL-3.0-or-later
//! CAN interfaces: their state as the kernel reports it over netlink (rtnetlink(7), linux/can/netlink.h).

#![forbid(unsafe_code)]

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;

use nix::sys::socket::{
    AddressFamily, MsgFlags, NetlinkAddr, SockFlag, SockProtocol, SockType, recv, sendto, setsockopt, socket, sockopt,
};
use nix::sys::time::{TimeVal, TimeValLike as _};

use crate::attributes;

/// Where the kernel lists network interfaces.
const NET: &str = "/sys/class/net";
/// The type of a CAN interface (`ARPHRD_CAN` in linux/if_arp.h).
const ARPHRD_CAN: &str = "280";
/// Longest answer.
const ANSWER_BYTES_MAX: usize = 16 * 1024;
/// Sizes of `struct nlmsghdr` and `struct ifinfomsg`.
const HEADER_BYTES: usize = 16;
const IFINFO_BYTES: usize = 16;

const RTM_NEWLINK: u16 = 16;
const RTM_GETLINK: u16 = 18;
const NLM_F_REQUEST: u16 = 1;
const IFF_UP: u32 = 1;
const IFLA_LINKINFO: u16 = 18;
const IFLA_INFO_KIND: u16 = 1;
const IFLA_INFO_DATA: u16 = 2;
const IFLA_CAN_BITTIMING: u16 = 1;
const IFLA_CAN_STATE: u16 = 4;
const IFLA_CAN_RESTART_MS: u16 = 6;
/// Bits of an attribute's type that are no type.
const NLA_FLAGS: u16 = 0xc000;

/// A CAN interface.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CanInterface {
    /// Whether it is up.
    pub is_up: bool,
    /// Bits per second. `None`: it has none, as a virtual one, or it is not set.
    pub bitrate: Option<u32>,
    /// How long it stays off the bus after too many errors, in milliseconds. `None`: until somebody restarts it.
    pub restart_ms: Option<u32>,
    /// Whether it is off the bus.
    pub is_off: bool,
    /// Whether it has no wire (vcan).
    pub is_virtual: bool,
}

/// Whether there is a network interface of this name that is no CAN interface.
pub fn is_other(name: &str) -> bool {
    attributes::text(&Path::new(NET).join(name).join("type")).is_some_and(|type_| type_ != ARPHRD_CAN)
}

/// Asks the kernel about an interface.
///
/// # Errors
///
/// There is no interface of this name (`NotFound`), or the kernel does not answer.
pub fn interface(name: &str) -> io::Result<CanInterface> {
    let index = attributes::text(&Path::new(NET).join(name).join("ifindex"));
    let index: i32 = index.and_then(|index| index.parse().ok()).ok_or(io::ErrorKind::NotFound)?;
    let mut answer = vec![0; ANSWER_BYTES_MAX];
    let socket = ask(index)?;
    let len = recv(socket.as_raw_fd(), &mut answer, MsgFlags::empty())?;
    decode(&answer[..len]).ok_or_else(|| io::Error::other("the kernel's answer is not understood"))
}

/// Sends the question about the interface with this number.
fn ask(index: i32) -> io::Result<OwnedFd> {
    let flags = SockFlag::SOCK_CLOEXEC;
    let socket = socket(AddressFamily::Netlink, SockType::Raw, flags, SockProtocol::NetlinkRoute)?;
    setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::seconds(1))?;
    let mut question = Vec::with_capacity(HEADER_BYTES + IFINFO_BYTES);
    question.extend(((HEADER_BYTES + IFINFO_BYTES) as u32).to_ne_bytes());
    question.extend(RTM_GETLINK.to_ne_bytes());
    question.extend(NLM_F_REQUEST.to_ne_bytes());
    question.extend([0; 8 + 4]);
    question.extend(index.to_ne_bytes());
    question.extend([0; 8]);
    sendto(socket.as_raw_fd(), &question, &NetlinkAddr::new(0, 0), MsgFlags::empty())?;
    Ok(socket)
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_ne_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_ne_bytes(*bytes.get(at..)?.first_chunk()?))
}

/// The attribute of this type.
fn attribute(mut attributes: &[u8], type_: u16) -> Option<&[u8]> {
    loop {
        let len = usize::from(u16_at(attributes, 0)?);
        let value = attributes.get(4..len)?;
        if u16_at(attributes, 2)? & !NLA_FLAGS == type_ {
            return Some(value);
        }
        attributes = attributes.get(len.next_multiple_of(4)..)?;
    }
}

fn decode(answer: &[u8]) -> Option<CanInterface> {
    if u16_at(answer, 4)? != RTM_NEWLINK {
        return None;
    }
    let is_up = u32_at(answer, HEADER_BYTES + 8)? & IFF_UP != 0;
    let info = attribute(answer.get(HEADER_BYTES + IFINFO_BYTES..)?, IFLA_LINKINFO).unwrap_or_default();
    let kind = attribute(info, IFLA_INFO_KIND).unwrap_or_default();
    let data = attribute(info, IFLA_INFO_DATA).unwrap_or_default();
    let number = |type_| attribute(data, type_).and_then(|value| u32_at(value, 0));
    // Of `enum can_state`.
    const BUS_OFF: u32 = 3;
    Some(CanInterface {
        is_up,
        // The first member of `struct can_bittiming`.
        bitrate: number(IFLA_CAN_BITTIMING).filter(|bitrate| *bitrate > 0),
        restart_ms: number(IFLA_CAN_RESTART_MS).filter(|restart_ms| *restart_ms > 0),
        is_off: number(IFLA_CAN_STATE) == Some(BUS_OFF),
        is_virtual: kind.starts_with(b"vcan") || kind.starts_with(b"vxcan"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn nested(type_: u16, value: &[u8]) -> Vec<u8> {
        let mut bytes = ((value.len() + 4) as u16).to_ne_bytes().to_vec();
        bytes.extend(type_.to_ne_bytes());
        bytes.extend(value);
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        bytes
    }

    fn answer(flags: u32, attributes: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0; HEADER_BYTES + IFINFO_BYTES];
        bytes[4..6].copy_from_slice(&RTM_NEWLINK.to_ne_bytes());
        bytes[HEADER_BYTES + 8..HEADER_BYTES + 12].copy_from_slice(&flags.to_ne_bytes());
        bytes.extend(attributes);
        bytes
    }

    #[test]
    fn the_kernels_answer_is_read() {
        let number = |type_, value: u32| nested(type_, &value.to_ne_bytes());
        let data = [number(IFLA_CAN_BITTIMING, 1_000_000), number(IFLA_CAN_STATE, 3), number(IFLA_CAN_RESTART_MS, 100)];
        let info = [nested(IFLA_INFO_KIND, b"can\0"), nested(IFLA_INFO_DATA | 0x8000, &data.concat())];
        // Another attribute with a length that is no multiple of four comes first.
        let attributes = [nested(3, b"can0\0"), nested(IFLA_LINKINFO, &info.concat())].concat();
        let found = decode(&answer(IFF_UP, &attributes)).unwrap();
        let expected = CanInterface {
            is_up: true,
            bitrate: Some(1_000_000),
            restart_ms: Some(100),
            is_off: true,
            is_virtual: false,
        };
        assert_eq!(found, expected);
        let info = nested(IFLA_LINKINFO, &nested(IFLA_INFO_KIND, b"vcan\0"));
        assert_eq!(decode(&answer(0, &info)), Some(CanInterface { is_virtual: true, ..CanInterface::default() }));
    }

    #[test]
    fn the_kernel_answers_about_an_interface() {
        let found = interface("lo").unwrap();
        assert_eq!(found, CanInterface { is_up: found.is_up, ..CanInterface::default() });
        assert_eq!(interface("none").unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    proptest! {
        #[test]
        fn any_bytes_are_an_answer_or_none(mut bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            if let Some(type_) = bytes.get_mut(4..6) {
                type_.copy_from_slice(&RTM_NEWLINK.to_ne_bytes());
            }
            decode(&bytes);
        }
    }
}
