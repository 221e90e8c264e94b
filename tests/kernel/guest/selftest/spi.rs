// SPDX-License-Identifier: GPL-3.0-or-later
//! spidev on the mocked controller.

use nix::errno::Errno;

use crate::{sysfs, uapi};

const MOCK: &str = "/sys/devices/platform/mock-spi";

#[test]
fn what_is_sent_comes_back() {
    for device in ["/dev/spidev0.0", "/dev/spidev0.1"] {
        let sent = [0xde, 0xad, 0xbe, 0xef];
        assert_eq!(uapi::spi_transfer(device, 0, 1_000_000, &sent), Ok(sent.to_vec()));
    }
}

#[test]
fn replies_can_be_set() {
    sysfs::write(format!("{MOCK}/replies"), "01020304");
    let transfer = |sent: &[u8]| uapi::spi_transfer("/dev/spidev0.0", 0, 1_000_000, sent);
    assert_eq!(transfer(&[0xff; 3]), Ok(vec![1, 2, 3]));
    assert_eq!(transfer(&[0xaa; 2]), Ok(vec![4, 0xaa]));
}

#[test]
fn mode_speed_and_bytes_are_recorded() {
    sysfs::write(format!("{MOCK}/sent"), "0");
    for mode in 0..4 {
        uapi::spi_transfer("/dev/spidev0.1", mode, 4_000_000, &[0x32, mode]).expect("a transfer");
    }
    let expected: Vec<_> = (0..4).map(|mode| format!("cs1 {mode} 4000000 32 {mode:02x}")).collect();
    assert_eq!(sysfs::read(format!("{MOCK}/sent")).lines().collect::<Vec<_>>(), expected);
}

#[test]
fn a_transfer_fails_as_was_set() {
    let transfer = || uapi::spi_transfer("/dev/spidev0.0", 0, 1_000_000, &[1]);
    sysfs::write(format!("{MOCK}/fail"), format!("{} 2", Errno::EIO as i32));
    assert_eq!([transfer(), transfer()], [Err(Errno::EIO), Err(Errno::EIO)]);
    assert_eq!(transfer(), Ok(vec![1]));
}
