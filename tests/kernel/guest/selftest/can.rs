// SPDX-License-Identifier: GPL-3.0-or-later
//! CAN on a virtual interface.

use std::process::Command;

use socketcan::{CanDataFrame, CanFrame, CanSocket, EmbeddedFrame as _, Socket as _, StandardId};

use crate::sysfs;

fn ip(args: &str) {
    sysfs::assert_in_guest();
    let status = Command::new("ip").args(args.split(' ')).status().expect("ip");
    assert!(status.success(), "ip {args}");
}

#[test]
fn a_frame_reaches_another_socket() {
    ip("link add vcan0 type vcan");
    ip("link set vcan0 up");
    let [sender, receiver] = ["vcan0"; 2].map(|name| CanSocket::open(name).expect("an interface"));
    let sent = CanDataFrame::new(StandardId::new(0x123).expect("11 bits"), &[1, 2, 3]).expect("three bytes");
    sender.write_frame(&sent).expect("a bus with room");
    let CanFrame::Data(received) = receiver.read_frame().expect("a frame") else { panic!("it is no data") };
    assert_eq!((received.id(), received.data()), (sent.id(), sent.data()));
    ip("link del vcan0");
}
