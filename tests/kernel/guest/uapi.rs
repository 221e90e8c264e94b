// SPDX-License-Identifier: GPL-3.0-or-later
//! The kernel's interfaces, used directly: a test's view does not depend on the code that it tests.
#![allow(unsafe_code)]

use std::fs::File;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

use super::sysfs;

pub const IS_OUT: u32 = 1 << 1;
pub const BIAS_PULL_UP: u32 = 1 << 5;
pub const BIAS_PULL_DOWN: u32 = 1 << 6;
pub const BIAS_DISABLE: u32 = 1 << 7;

/// `struct gpioline_info`.
#[repr(C)]
struct RawLineInfo {
    offset: u32,
    flags: u32,
    name: [u8; 32],
    consumer: [u8; 32],
}

nix::ioctl_readwrite!(gpio_get_lineinfo, 0xb4, 0x02, RawLineInfo);

/// The kernel's description of a GPIO line; `flags` is `GPIOLINE_FLAG_*`.
#[derive(Debug)]
pub struct LineInfo {
    pub flags: u32,
    pub name: String,
    pub consumer: String,
}

pub fn line_info(chip: &Path, offset: u32) -> LineInfo {
    let file = open(chip);
    let mut info = RawLineInfo { offset, flags: 0, name: [0; 32], consumer: [0; 32] };
    // SAFETY: this ioctl fills this structure.
    unsafe { gpio_get_lineinfo(file.as_raw_fd(), &mut info) }.expect("line information");
    LineInfo { flags: info.flags, name: text(&info.name), consumer: text(&info.consumer) }
}

/// `struct gpio_v2_line_attribute` with its mask.
#[repr(C)]
#[derive(Clone, Copy)]
struct RawLineAttribute {
    id: u32,
    padding: u32,
    value: u64,
    mask: u64,
}

/// `struct gpio_v2_line_request`.
#[repr(C)]
struct RawLineRequest {
    offsets: [u32; 64],
    consumer: [u8; 32],
    flags: u64,
    num_attrs: u32,
    padding: [u32; 5],
    attrs: [RawLineAttribute; 10],
    num_lines: u32,
    event_buffer_size: u32,
    more_padding: [u32; 5],
    fd: i32,
}

const V2_INPUT: u64 = 1 << 2;
const V2_BOTH_EDGES: u64 = 1 << 4 | 1 << 5;
const V2_DEBOUNCE: u32 = 3;

nix::ioctl_readwrite!(gpio_v2_get_line, 0xb4, 0x07, RawLineRequest);

/// An input with edges that the kernel debounces. Each event has 48 bytes.
pub fn debounced_input(chip: &Path, offset: u32, period_us: u64) -> File {
    let file = open(chip);
    let mut request = RawLineRequest {
        offsets: [0; 64],
        consumer: [0; 32],
        flags: V2_INPUT | V2_BOTH_EDGES,
        num_attrs: 1,
        padding: [0; 5],
        attrs: [RawLineAttribute { id: V2_DEBOUNCE, padding: 0, value: period_us, mask: 1 }; 10],
        num_lines: 1,
        event_buffer_size: 1024,
        more_padding: [0; 5],
        fd: -1,
    };
    request.offsets[0] = offset;
    request.attrs[1..].fill(RawLineAttribute { id: 0, padding: 0, value: 0, mask: 0 });
    // SAFETY: this ioctl takes this structure, and the descriptor that it makes is ours.
    unsafe {
        gpio_v2_get_line(file.as_raw_fd(), &mut request).expect("a line");
        File::from_raw_fd(request.fd)
    }
}

nix::ioctl_write_ptr_bad!(tiocmbis, libc::TIOCMBIS, libc::c_int);
nix::ioctl_write_ptr_bad!(tiocmbic, libc::TIOCMBIC, libc::c_int);

/// TIOCM_LOOP of asm-generic/termios.h: a serial port receives what it sends.
const TIOCM_LOOP: libc::c_int = 0x8000;

/// Makes a serial port receive what it sends, or ends that.
pub fn loop_back(port: &File, on: bool) {
    let change = if on { tiocmbis } else { tiocmbic };
    // SAFETY: this ioctl reads an int.
    unsafe { change(port.as_raw_fd(), &TIOCM_LOOP) }.expect("a serial port that can loop");
}

/// GPIOHANDLE_SET_CONFIG_IOCTL, which Linux has had since 5.5.
pub const GPIOHANDLE_SET_CONFIG: u32 = 0xc054_b40a;

/// Makes an ioctl fail in the program of `command`, as in a kernel that does not know the ioctl.
pub fn without_ioctl(command: &mut Command, request: u32, errno: i32) {
    let load = |at: u32| (libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, at);
    let is = |value: u32, otherwise: u8| (libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, 0, otherwise, value);
    let answer = |value: u32| (libc::BPF_RET | libc::BPF_K, 0, 0, value);
    // From `struct seccomp_data`: the number of the call, and the lower half of its second argument.
    let program = [
        load(0),
        is(libc::SYS_ioctl as u32, 3),
        load(24),
        is(request, 1),
        answer(libc::SECCOMP_RET_ERRNO | errno as u32),
        answer(libc::SECCOMP_RET_ALLOW),
    ];
    let filter = program.map(|(code, jt, jf, k)| libc::sock_filter { code: code as u16, jt, jf, k });
    // SAFETY: between fork and exec there are two system calls, on memory that the closure owns.
    unsafe {
        command.pre_exec(move || {
            let program = libc::sock_fprog { len: filter.len() as u16, filter: filter.as_ptr().cast_mut() };
            if libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_FILTER, &raw const program) != 0 {
                return Err(io::Error::last_os_error());
            }
            Ok(())
        });
    }
}

/// `struct spi_ioc_transfer`.
#[repr(C)]
#[derive(Default)]
struct RawSpiTransfer {
    tx_buf: u64,
    rx_buf: u64,
    len: u32,
    speed_hz: u32,
    delay_us: u16,
    bits_per_word: u8,
    cs_change: u8,
    tx_nbits: u8,
    rx_nbits: u8,
    word_delay_us: u8,
    pad: u8,
}

nix::ioctl_write_ptr!(spi_write_mode, b'k', 1, u8);
nix::ioctl_write_buf!(spi_message, b'k', 0, RawSpiTransfer);

/// Sends in this mode, and returns the bytes received at the same time.
pub fn spi_transfer(device: &str, mode: u8, speed_hz: u32, sent: &[u8]) -> nix::Result<Vec<u8>> {
    let file = open(device.as_ref());
    let mut received = vec![0; sent.len()];
    let transfer = RawSpiTransfer {
        tx_buf: sent.as_ptr().addr() as u64,
        rx_buf: received.as_mut_ptr().addr() as u64,
        len: u32::try_from(sent.len()).expect("a short transfer"),
        speed_hz,
        ..RawSpiTransfer::default()
    };
    // SAFETY: the mode outlives the call. The buffers have the transfer's length, and also outlive the call.
    unsafe {
        spi_write_mode(file.as_raw_fd(), &mode)?;
        spi_message(file.as_raw_fd(), &[transfer])?;
    }
    Ok(received)
}

/// `struct i2c_msg`.
#[repr(C)]
struct RawI2cMessage {
    address: u16,
    flags: u16,
    len: u16,
    buf: *mut u8,
}

/// `struct i2c_rdwr_ioctl_data`.
#[repr(C)]
struct RawI2cTransfer {
    messages: *mut RawI2cMessage,
    count: u32,
}

const I2C_READ: u16 = 1;

nix::ioctl_write_ptr_bad!(i2c_rdwr, 0x0707, RawI2cTransfer);

/// Writes, then reads this number of bytes after a repeated start.
pub fn i2c_transfer(device: &Path, address: u16, written: &[u8], read_len: usize) -> nix::Result<Vec<u8>> {
    let file = open(device);
    let mut written = written.to_vec();
    let mut read = vec![0; read_len];
    let message = |flags, bytes: &mut Vec<u8>| RawI2cMessage {
        address,
        flags,
        len: u16::try_from(bytes.len()).expect("a short transfer"),
        buf: bytes.as_mut_ptr(),
    };
    let mut messages = vec![message(0, &mut written)];
    if read_len > 0 {
        messages.push(message(I2C_READ, &mut read));
    }
    let transfer =
        RawI2cTransfer { messages: messages.as_mut_ptr(), count: u32::try_from(messages.len()).expect("two at most") };
    // SAFETY: the messages point into buffers of the stated length, which outlive the call.
    unsafe { i2c_rdwr(file.as_raw_fd(), &transfer) }?;
    Ok(read)
}

nix::ioctl_readwrite!(watchdog_settimeout, b'W', 6, i32);

/// Sets the watchdog's timeout.
pub fn set_watchdog_timeout(watchdog: &File, seconds: u32) {
    let mut seconds = seconds.try_into().expect("not a century");
    // SAFETY: this ioctl takes and fills this integer.
    unsafe { watchdog_settimeout(watchdog.as_raw_fd(), &mut seconds) }.expect("a timeout that it takes");
}

fn open(path: &Path) -> File {
    sysfs::assert_in_guest();
    File::options().read(true).write(true).open(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}
