// SPDX-License-Identifier: GPL-3.0-or-later
//! CAN on a virtual interface.

use std::process::Command;

use crate::sysfs;
use crate::uapi::CanSocket;

fn ip(args: &str) {
    sysfs::assert_in_guest();
    let status = Command::new("ip").args(args.split(' ')).status().expect("ip");
    assert!(status.success(), "ip {args}");
}

#[test]
fn a_frame_reaches_another_socket() {
    ip("link add vcan0 type vcan");
    ip("link set vcan0 up");
    let [sender, receiver] = ["vcan0"; 2].map(CanSocket::open);
    sender.send(0x123, &[1, 2, 3]);
    assert_eq!(receiver.receive(), (0x123, vec![1, 2, 3]));
    ip("link del vcan0");
}
