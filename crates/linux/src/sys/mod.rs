// SPDX-License-Identifier: GPL-3.0-or-later
//! All `unsafe` code of the project: system calls that none of our crates wraps.

use std::ffi::c_void;
use std::fs;
use std::io::{self, IoSliceMut};
use std::num::NonZeroUsize;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr::{self, NonNull};
use std::slice;
use std::sync::atomic::{AtomicU32, AtomicU64};
use std::time::Duration;

use nix::cmsg_space;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::mman::{MapFlags, ProtFlags, mmap_anonymous};
use nix::sys::signal::{SigHandler, Signal, signal};
use nix::sys::socket::{ControlMessageOwned, MsgFlags, recvmsg};
use nix::unistd::{ForkResult, Pid};

mod filter;
mod pages;
mod registers;

pub use filter::allow_only_reading;
pub use pages::{give_back_unused, trim_heap};
pub use registers::{Register, Registers};

/// Puts the calling thread into SCHED_FIFO at `priority` (1 to 99).
pub fn set_fifo(priority: i32) -> io::Result<()> {
    set_scheduler(libc::SCHED_FIFO, priority)
}

/// Puts the calling thread into SCHED_OTHER.
pub fn set_other() -> io::Result<()> {
    set_scheduler(libc::SCHED_OTHER, 0)
}

fn set_scheduler(policy: i32, priority: i32) -> io::Result<()> {
    let param = libc::sched_param { sched_priority: priority };
    // SAFETY: `param` lives through the call, which only reads it; 0 is the calling thread.
    match unsafe { libc::sched_setscheduler(0, policy, &param) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

// The kernel's `struct timespec` of SYS_futex has two longs.
const _: () = assert!(size_of::<libc::timespec>() == 2 * size_of::<libc::c_long>());

/// Sleeps while `word` is `value`, until `end` (CLOCK_MONOTONIC) at most. It may end early.
pub fn futex_wait_until(word: &AtomicU32, value: u32, end: Duration) {
    let end = libc::timespec {
        tv_sec: end.as_secs().try_into().unwrap_or(libc::time_t::MAX),
        // It is below 10^9.
        tv_nsec: end.subsec_nanos() as libc::c_long,
    };
    // Unlike FUTEX_WAIT, it takes a time and not a span.
    let operation = libc::FUTEX_WAIT_BITSET | libc::FUTEX_PRIVATE_FLAG;
    let (other, any) = (ptr::null::<u32>(), u32::MAX);
    // SAFETY: the call reads `word` and `end`, which live through it.
    unsafe { libc::syscall(libc::SYS_futex, word.as_ptr(), operation, value, &end, other, any) };
}

/// Wakes a thread that sleeps in [`futex_wait_until`] with this word.
pub fn futex_wake(word: &AtomicU32) {
    let operation = libc::FUTEX_WAKE | libc::FUTEX_PRIVATE_FLAG;
    // SAFETY: the call takes the address only as a name.
    unsafe { libc::syscall(libc::SYS_futex, word.as_ptr(), operation, 1) };
}

/// Gives the calling thread a nice value (-20 to 19). It counts while the thread is SCHED_OTHER (setpriority(2), "C
/// library/kernel differences": per thread).
pub fn set_nice(value: i32) -> io::Result<()> {
    // SAFETY: takes no pointers; 0 is the calling thread.
    match unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, value) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// CAP_DAC_READ_SEARCH and CAP_SYS_PTRACE (linux/capability.h): to look into the processes and files of other users.
pub const LOOK_INTO_OTHERS: u32 = 1 << 2 | 1 << 19;

/// The capabilities that the program itself may need. CAP_IPC_LOCK and CAP_SYS_NICE are for real time. If root starts
/// the program, it may also need CAP_CHOWN, CAP_DAC_OVERRIDE and CAP_FOWNER. They are for the terminal's group, and for
/// links and sockets in folders of other users.
pub const SERVE: u32 = 1 << 14 | 1 << 23 | 1 << 0 | 1 << 1 | 1 << 3;

/// CAP_SYS_RAWIO: to open `/dev/mem`.
pub const RAW_MEMORY: u32 = 1 << 17;

/// Drops all capabilities except these. `capabilities` has a bit for each of the first 32. The calling thread loses the
/// others, and so do the threads that it starts from now on. Programs that it may become lose them as far as permitted.
pub fn keep_only(capabilities: u32) -> io::Result<()> {
    // _LINUX_CAPABILITY_VERSION_3, for the calling thread (capset(2)).
    let mut header = [0x2008_0522u32, 0];
    let dropped = (0..).filter(|number| *number >= u32::BITS || capabilities >> number & 1 == 0);
    for number in dropped {
        // SAFETY: takes a number. The loop ends after the last capability, or if CAP_SETPCAP is missing.
        if unsafe { libc::prctl(libc::PR_CAPBSET_DROP, libc::c_ulong::from(number)) } != 0 {
            break;
        }
    }
    // Linux before 4.3 has no ambient capabilities. The kernel compares all bits of these numbers with 0.
    let [all, none] = [libc::PR_CAP_AMBIENT_CLEAR_ALL as libc::c_ulong, 0];
    // SAFETY: takes numbers.
    unsafe { libc::prctl(libc::PR_CAP_AMBIENT, all, none, none, none) };
    // Effective, permitted and inheritable of the first 32 capabilities, then of the rest.
    let mut sets = [0u32; 6];
    // SAFETY: with this version the kernel writes two structures of three words. If it does not know the version, it
    // writes its own version into the header and fails.
    if unsafe { libc::syscall(libc::SYS_capget, header.as_mut_ptr(), sets.as_mut_ptr()) } != 0 {
        return Err(io::Error::last_os_error());
    }
    sets[..3].iter_mut().for_each(|set| *set &= capabilities);
    sets[3..].fill(0);
    // SAFETY: the kernel reads the same two structures. It may write into the header as above.
    match unsafe { libc::syscall(libc::SYS_capset, header.as_mut_ptr(), sets.as_ptr()) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// How many words this process shares with the processes that it forks.
pub const SHARED_WORDS: usize = 1024;

/// A page of zeros that this process shares with the processes that it forks. It is never given back.
pub fn shared_words() -> io::Result<&'static [AtomicU32; SHARED_WORDS]> {
    let page = shared(size_of::<[AtomicU32; SHARED_WORDS]>())?;
    // SAFETY: the mapping is long enough, aligned to a page, zeroed (a valid value of the
    // atomics) and never unmapped; other processes change it through atomics only.
    Ok(unsafe { page.cast::<[AtomicU32; SHARED_WORDS]>().as_ref() })
}

/// This many words of zeros that this process shares with the processes that it forks. They are never given back. The
/// kernel provides a page when it is first touched.
pub fn shared_memory(words: usize) -> io::Result<&'static [AtomicU64]> {
    let start = shared(words.checked_mul(size_of::<AtomicU64>()).ok_or(io::ErrorKind::OutOfMemory)?)?;
    // SAFETY: the mapping has this many words, and is aligned to a page, zeroed and never unmapped. Other processes
    // change it through atomics only.
    Ok(unsafe { slice::from_raw_parts(start.cast::<AtomicU64>().as_ptr(), words) })
}

/// A new mapping of zeros.
fn shared(bytes: usize) -> io::Result<NonNull<c_void>> {
    let length = NonZeroUsize::new(bytes).ok_or(io::ErrorKind::InvalidInput)?;
    // SAFETY: a new anonymous mapping at an address of the kernel's choice touches no memory
    // that is in use.
    Ok(unsafe { mmap_anonymous(None, length, ProtFlags::PROT_READ | ProtFlags::PROT_WRITE, MapFlags::MAP_SHARED) }?)
}

/// Has the allocator return each large block to the kernel when it is freed. By default it raises its limit with each
/// one (mallopt(3), M_MMAP_THRESHOLD), and what the flight recorder needs at a stop would stay with the program.
pub fn return_large_blocks() {
    // SAFETY: takes numbers.
    unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, 128 * 1024) };
}

/// Forks a process that runs `child` and ends with the status that it returns. Fails if this process has more than
/// `threads_max` threads: the child would miss them, and the locks that they hold. A program allows one. A test runs in
/// a second thread while the first one waits and holds no lock.
pub fn fork(threads_max: usize, child: impl FnOnce() -> i32) -> io::Result<Pid> {
    if fs::read_dir("/proc/self/task")?.count() > threads_max {
        return Err(io::Error::other("threads have been started already"));
    }
    // SAFETY: this is the only thread that does anything, so the child is a whole copy of the process.
    match unsafe { nix::unistd::fork() }? {
        ForkResult::Parent { child } => Ok(child),
        ForkResult::Child => {
            let status = catch_unwind(AssertUnwindSafe(child)).unwrap_or(101);
            // SAFETY: ends the process, without the parent's exit handlers.
            unsafe { libc::_exit(status) }
        }
    }
}

/// Closes all descriptors of this process except these. Call it only in a new process, and only if nothing that owns
/// another descriptor is used any more.
pub fn close_all_but(kept: &[RawFd]) -> io::Result<()> {
    let entries = fs::read_dir("/proc/self/fd")?;
    let open: Vec<RawFd> = entries.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok()).collect();
    for fd in open.into_iter().filter(|fd| !kept.contains(fd)) {
        // SAFETY: the caller promises that no owner uses it. The folder's own descriptor is already closed.
        unsafe { libc::close(fd) };
    }
    Ok(())
}

/// Makes this process ignore a signal.
pub fn ignore(ignored: Signal) -> io::Result<()> {
    // SAFETY: no handler is installed.
    unsafe { signal(ignored, SigHandler::SigIgn) }?;
    Ok(())
}

/// A descriptor that becomes readable when process `pid` has ended (Linux 5.3).
pub fn pidfd(pid: Pid) -> io::Result<OwnedFd> {
    // SAFETY: the call takes two numbers.
    match unsafe { libc::syscall(libc::SYS_pidfd_open, pid.as_raw(), 0) } {
        -1 => Err(io::Error::last_os_error()),
        // SAFETY: a new descriptor that nobody else knows. Descriptors fit an i32.
        fd => Ok(unsafe { OwnedFd::from_raw_fd(fd as i32) }),
    }
}

/// Receives a message, and the descriptor that may come with it. 0 bytes: the other end is closed.
pub fn receive(socket: BorrowedFd<'_>, buffer: &mut [u8]) -> io::Result<(usize, Option<OwnedFd>)> {
    let mut control = cmsg_space!([i32; 1]);
    let mut pieces = [IoSliceMut::new(buffer)];
    let message = recvmsg::<()>(socket.as_raw_fd(), &mut pieces, Some(&mut control), MsgFlags::MSG_CMSG_CLOEXEC)?;
    let mut received = None;
    for control in message.cmsgs()? {
        if let ControlMessageOwned::ScmRights(fds) = control {
            for fd in fds {
                // SAFETY: the kernel has just made this descriptor for us.
                received = Some(unsafe { OwnedFd::from_raw_fd(fd) });
            }
        }
    }
    Ok((message.bytes, received))
}

/// `struct gpiohandle_data` (linux/gpio.h): the values of a line handle's lines.
#[repr(C)]
pub struct LineValues([u8; 64]);

/// `struct gpiohandle_config` (linux/gpio.h, since Linux 5.5): flags and levels of a line handle's
/// lines.
#[repr(C)]
pub struct LineConfig {
    flags: u32,
    default_values: [u8; 64],
    padding: [u32; 4],
}

/// `struct gpio_v2_line_config` (linux/gpio.h, since Linux 5.10): flags and attributes of a line request's lines. An
/// attribute has 24 bytes.
#[repr(C)]
pub struct LineRequestConfig {
    flags: u64,
    num_attrs: u32,
    padding: [u32; 5],
    attrs: [[u64; 3]; 10],
}

/// `struct gpio_v2_line_request` (linux/gpio.h, since Linux 5.10).
#[repr(C)]
pub struct LineRequest {
    offsets: [u32; 64],
    consumer: [u8; 32],
    config: LineRequestConfig,
    num_lines: u32,
    event_buffer_size: u32,
    padding: [u32; 5],
    fd: i32,
}

/// `struct gpio_v2_line_values` (linux/gpio.h, since Linux 5.10).
#[repr(C)]
pub struct LineRequestValues {
    bits: u64,
    mask: u64,
}

mod request {
    nix::ioctl_readwrite!(gpio_v2_get_line, 0xB4, 0x07, super::LineRequest);
    nix::ioctl_readwrite!(gpio_v2_line_set_config, 0xB4, 0x0d, super::LineRequestConfig);
    nix::ioctl_readwrite!(gpio_v2_line_get_values, 0xB4, 0x0e, super::LineRequestValues);
    nix::ioctl_readwrite!(gpiohandle_set_config, 0xB4, 0x0a, super::LineConfig);
    pub const GPIOHANDLE_SET_LINE_VALUES: nix::sys::ioctl::ioctl_num_type =
        nix::request_code_readwrite!(0xB4, 0x09, size_of::<super::LineValues>());
    nix::ioctl_read!(wdioc_gettimeout, b'W', 7, i32);
    nix::ioctl_none_bad!(tiocexcl, libc::TIOCEXCL);
    nix::ioctl_none_bad!(tiocnxcl, libc::TIOCNXCL);
    nix::ioctl_read_bad!(tiocgetd, libc::TIOCGETD, i32);
    nix::ioctl_write_ptr_bad!(tiocsetd, libc::TIOCSETD, i32);
    nix::ioctl_read_bad!(tcgets2, libc::TCGETS2, libc::termios2);
    nix::ioctl_write_ptr_bad!(tcsets2, libc::TCSETS2, libc::termios2);
    nix::ioctl_read_bad!(tiocgicount, libc::TIOCGICOUNT, super::LineCounts);
    // I2C_FUNCS (linux/i2c-dev.h).
    nix::ioctl_read_bad!(i2c_funcs, 0x0705, libc::c_ulong);
}

/// Makes every further open of a terminal fail, except by root.
pub fn make_exclusive(terminal: &impl AsFd) -> io::Result<()> {
    // SAFETY: the request takes nothing.
    unsafe { request::tiocexcl(terminal.as_fd().as_raw_fd()) }?;
    Ok(())
}

/// Takes back [`make_exclusive`], also that of another program.
pub fn make_shared(terminal: &impl AsFd) -> io::Result<()> {
    // SAFETY: the request takes nothing.
    unsafe { request::tiocnxcl(terminal.as_fd().as_raw_fd()) }?;
    Ok(())
}

/// Gives a terminal its usual line discipline (N_TTY of linux/tty.h).
pub fn use_usual_discipline(terminal: &impl AsFd) -> io::Result<()> {
    const USUAL: i32 = 0;
    let mut discipline = USUAL;
    // SAFETY: the request writes an int, which lives through the call.
    unsafe { request::tiocgetd(terminal.as_fd().as_raw_fd(), &mut discipline) }?;
    if discipline != USUAL {
        // SAFETY: the request reads an int, which lives through the call.
        unsafe { request::tiocsetd(terminal.as_fd().as_raw_fd(), &USUAL) }?;
    }
    Ok(())
}

/// The speed of CBAUD that stands for the number in `c_ospeed`, and the place of the same for input (CIBAUD).
const OTHER_SPEED: u32 = libc::BOTHER;
const INPUT_SPEED: u32 = libc::CBAUD << 16;

fn settings(terminal: &impl AsFd) -> io::Result<libc::termios2> {
    // SAFETY: all fields are numbers.
    let mut settings: libc::termios2 = unsafe { std::mem::zeroed() };
    // SAFETY: the request writes a `struct termios2`, which lives through the call.
    unsafe { request::tcgets2(terminal.as_fd().as_raw_fd(), &mut settings) }?;
    Ok(settings)
}

/// Sets the rate of a terminal in baud, which need not be a standard one. Returns the rate that its driver then has.
pub fn set_rate(terminal: &impl AsFd, rate_hz: u32) -> io::Result<u32> {
    let mut settings = settings(terminal)?;
    // Input has the speed of output.
    settings.c_cflag = settings.c_cflag & !(libc::CBAUD | INPUT_SPEED) | OTHER_SPEED;
    (settings.c_ispeed, settings.c_ospeed) = (rate_hz, rate_hz);
    // SAFETY: the request reads a `struct termios2`, which lives through the call.
    unsafe { request::tcsets2(terminal.as_fd().as_raw_fd(), &settings) }?;
    rate(terminal)
}

/// The rate of a terminal in baud.
pub fn rate(terminal: &impl AsFd) -> io::Result<u32> {
    Ok(settings(terminal)?.c_ospeed)
}

/// `struct serial_icounter_struct` (linux/serial.h).
#[repr(C)]
pub struct LineCounts {
    modem_lines: [i32; 4],
    bytes: [i32; 2],
    frame: i32,
    overrun: i32,
    parity: i32,
    brk: i32,
    buf_overrun: i32,
    reserved: [i32; 9],
}

/// The faults that a serial port has counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineFaults {
    /// Bytes without a stop bit.
    pub framing: i32,
    /// Bytes that were lost, because the computer was too slow.
    pub overrun: i32,
    /// Times when the line was low for longer than a byte.
    pub breaks: i32,
}

/// The faults that a serial port has counted. Not every driver counts them.
pub fn line_faults(port: &impl AsFd) -> io::Result<LineFaults> {
    // SAFETY: all fields are numbers.
    let mut counts: LineCounts = unsafe { std::mem::zeroed() };
    // SAFETY: the request writes a `struct serial_icounter_struct`, which lives through the call.
    unsafe { request::tiocgicount(port.as_fd().as_raw_fd(), &mut counts) }?;
    let overrun = counts.overrun.wrapping_add(counts.buf_overrun);
    Ok(LineFaults { framing: counts.frame, overrun, breaks: counts.brk })
}

/// Drives the only line of a handle of the GPIO character device.
pub fn set_line(line: &impl AsRawFd, value: bool) -> io::Result<()> {
    static LOW: LineValues = LineValues([0; 64]);
    static HIGH: LineValues = LineValues([1; 64]);
    let values: *const LineValues = if value { &HIGH } else { &LOW };
    // The C library's ioctl(2) takes 9 instructions more: it expects any number of arguments.
    // SAFETY: the request only reads a `struct gpiohandle_data`.
    match unsafe { libc::syscall(libc::SYS_ioctl, line.as_raw_fd(), request::GPIOHANDLE_SET_LINE_VALUES, values) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Sets direction and bias (`GPIOHANDLE_REQUEST_` flags) of the only line of a handle of the GPIO character device.
/// Also sets the level of an output.
pub fn set_line_config(line: &impl AsRawFd, flags: u32, level: bool) -> io::Result<()> {
    let mut config = LineConfig { flags, default_values: [0; 64], padding: [0; 4] };
    config.default_values[0] = level.into();
    // SAFETY: the request takes a `struct gpiohandle_config`, which lives through the call.
    unsafe { request::gpiohandle_set_config(line.as_raw_fd(), &mut config) }?;
    Ok(())
}

/// GPIOHANDLE_REQUEST_OUTPUT.
pub const OUTPUT: u32 = 1 << 1;

/// Drives the only line of a handle, for a chip on a bus. Reports whether the chip has accepted the level. `flags` are
/// the flags that made the line an output.
///
/// [`set_line`] does not report this. On many kernels, 6.1 among them, a driver's function that sets a level returns
/// nothing. A chip that does not answer goes unnoticed. The driver's function that makes a line an output does return
/// an error. Linux before 5.5 offers this only for new handles, and answers EINVAL.
pub fn set_line_checked(line: &impl AsRawFd, flags: u32, value: bool) -> io::Result<()> {
    match set_line_config(line, flags, value) {
        Err(error) if error.raw_os_error() == Some(libc::EINVAL) => set_line(line, value),
        set => set,
    }
}

/// Closes the file of `held` and puts a copy of another descriptor in its place, under the same number.
pub fn replace(held: &impl AsRawFd, by: &impl AsRawFd) -> io::Result<()> {
    // SAFETY: takes numbers. The number of `held` stays open, and still belongs to `held`.
    match unsafe { libc::dup3(by.as_raw_fd(), held.as_raw_fd(), libc::O_CLOEXEC) } {
        -1 => Err(io::Error::last_os_error()),
        _ => Ok(()),
    }
}

/// The configuration of a line with these flags (`GPIO_V2_LINE_FLAG_`), without attributes.
fn line_request_config(flags: u64) -> LineRequestConfig {
    LineRequestConfig { flags, num_attrs: 0, padding: [0; 5], attrs: [[0; 3]; 10] }
}

/// Requests one line of an open GPIO chip with `GPIO_V2_LINE_FLAG_` flags. If the flags ask for edges, the file reads
/// as the line's edges. A read without any does not wait. The kernel keeps `events` edges.
pub fn request_line(chip: impl AsFd, offset: u32, flags: u64, events: u32, consumer: &str) -> io::Result<fs::File> {
    let mut request = LineRequest {
        offsets: [0; 64],
        consumer: [0; 32],
        config: line_request_config(flags),
        num_lines: 1,
        event_buffer_size: events,
        padding: [0; 5],
        fd: -1,
    };
    request.offsets[0] = offset;
    // The last byte stays 0.
    request.consumer.iter_mut().zip(consumer.bytes().take(31)).for_each(|(to, from)| *to = from);
    // SAFETY: the request takes a `struct gpio_v2_line_request`, which lives through the call.
    unsafe { request::gpio_v2_get_line(chip.as_fd().as_raw_fd(), &mut request) }?;
    // SAFETY: the kernel has just made this descriptor for us.
    let line = unsafe { OwnedFd::from_raw_fd(request.fd) };
    fcntl(&line, FcntlArg::F_SETFL(OFlag::O_NONBLOCK))?;
    Ok(line.into())
}

/// Changes the flags of a line of [`request_line`].
pub fn set_line_flags(line: impl AsFd, flags: u64) -> io::Result<()> {
    let mut config = line_request_config(flags);
    // SAFETY: the request takes a `struct gpio_v2_line_config`, which lives through the call.
    unsafe { request::gpio_v2_line_set_config(line.as_fd().as_raw_fd(), &mut config) }?;
    Ok(())
}

/// The level of a line of [`request_line`].
pub fn line_level(line: impl AsFd) -> io::Result<bool> {
    let mut values = LineRequestValues { bits: 0, mask: 1 };
    // SAFETY: the request takes a `struct gpio_v2_line_values`, which lives through the call.
    unsafe { request::gpio_v2_line_get_values(line.as_fd().as_raw_fd(), &mut values) }?;
    Ok(values.bits & 1 != 0)
}

/// Whether the adapter of an I2C bus accepts plain messages (I2C_FUNC_I2C of linux/i2c.h). The adapters of many PC
/// chipsets know only SMBus.
pub fn is_plain_i2c(bus: &impl AsRawFd) -> io::Result<bool> {
    let mut functions: libc::c_ulong = 0;
    // SAFETY: the request writes an unsigned long, which lives through the call.
    unsafe { request::i2c_funcs(bus.as_raw_fd(), &mut functions) }?;
    Ok(functions & 1 != 0)
}

/// The timeout of a hardware watchdog, in seconds. Without food for this time, it resets the computer.
pub fn watchdog_timeout_s(watchdog: BorrowedFd<'_>) -> io::Result<i32> {
    let mut seconds = 0;
    // SAFETY: the request writes an int, which lives through the call.
    unsafe { request::wdioc_gettimeout(watchdog.as_raw_fd(), &mut seconds) }?;
    Ok(seconds)
}

/// Opens the other end of the pseudo terminal with this master, whatever its permissions are (Linux 4.13). It does not
/// become the process's controlling terminal.
pub fn pty_slave(master: BorrowedFd<'_>) -> io::Result<OwnedFd> {
    let flags = libc::O_RDWR | libc::O_NOCTTY | libc::O_CLOEXEC;
    // SAFETY: the request takes a number.
    match unsafe { libc::ioctl(master.as_raw_fd(), libc::TIOCGPTPEER, flags) } {
        -1 => Err(io::Error::last_os_error()),
        // SAFETY: a new descriptor that nobody else knows.
        fd => Ok(unsafe { OwnedFd::from_raw_fd(fd) }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_shared_memory_than_there_is_is_refused() {
        // So many words that their number of bytes wraps around to eight.
        let too_many = usize::MAX / size_of::<AtomicU64>() + 2;
        assert_eq!(shared_memory(too_many).unwrap_err().kind(), io::ErrorKind::OutOfMemory);
        assert!(shared_memory(0).is_err());
        assert_eq!(shared_memory(1000).unwrap().len(), 1000);
    }

    #[test]
    fn a_thread_that_serves_keeps_only_the_capabilities_that_it_may_need() {
        let effective = || {
            let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
            let bits = status.lines().find_map(|line| line.strip_prefix("CapEff:")).unwrap();
            u64::from_str_radix(bits.trim(), 16).unwrap()
        };
        std::thread::spawn(move || {
            let before = effective();
            keep_only(SERVE).unwrap();
            // linux/capability.h: chown, dac_override, fowner, ipc_lock and sys_nice.
            assert_eq!(effective(), before & 0x80_400b);
        })
        .join()
        .unwrap();
    }

    #[test]
    fn a_terminal_that_another_program_made_useless_is_usable_again() {
        let pty = nix::pty::openpty(None, None).unwrap();
        // N_NULL, for which no rights are needed. It reads and writes nothing.
        // SAFETY: the request reads an int, which lives through the call.
        unsafe { request::tiocsetd(pty.slave.as_raw_fd(), &27) }.unwrap();
        assert!(nix::unistd::write(&pty.slave, b"x").is_err());
        use_usual_discipline(&pty.slave).unwrap();
        assert_eq!(nix::unistd::write(&pty.slave, b"x"), Ok(1));
        use_usual_discipline(&pty.slave).unwrap();
    }

    #[test]
    fn line_values_are_laid_out_as_the_kernel_has_them() {
        assert_eq!(size_of::<LineValues>(), 64);
        assert_eq!(size_of::<LineCounts>(), 80);
        // GPIOHANDLE_SET_LINE_VALUES_IOCTL.
        assert_eq!(nix::request_code_readwrite!(0xB4, 0x09, size_of::<LineValues>()), 0xC040_B409);
        // GPIOHANDLE_SET_CONFIG_IOCTL.
        assert_eq!(nix::request_code_readwrite!(0xB4, 0x0a, size_of::<LineConfig>()), 0xC054_B40A);
        // GPIO_V2_GET_LINE_IOCTL, GPIO_V2_LINE_SET_CONFIG_IOCTL, GPIO_V2_LINE_GET_VALUES_IOCTL.
        assert_eq!(nix::request_code_readwrite!(0xB4, 0x07, size_of::<LineRequest>()), 0xC250_B407);
        assert_eq!(nix::request_code_readwrite!(0xB4, 0x0d, size_of::<LineRequestConfig>()), 0xC110_B40D);
        assert_eq!(nix::request_code_readwrite!(0xB4, 0x0e, size_of::<LineRequestValues>()), 0xC010_B40E);
        // WDIOC_GETTIMEOUT.
        assert_eq!(nix::request_code_read!(b'W', 7, size_of::<i32>()), 0x8004_5707);
    }
}
