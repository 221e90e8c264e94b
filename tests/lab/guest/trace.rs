// SPDX-License-Identifier: GPL-3.0-or-later
//! What really happened on the lines, and when: the kernel's own trace points.

use nix::unistd::Pid;

use super::sysfs;

const TRACEFS: &str = "/sys/kernel/tracing";

/// A level being written to a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Write {
    /// The kernel's number of the line.
    pub line: u32,
    pub level: bool,
    /// CLOCK_MONOTONIC.
    pub at_us: u64,
}

/// A system call being entered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Call {
    /// As in `libc::SYS_ioctl`.
    pub number: i64,
    /// CLOCK_MONOTONIC.
    pub at_us: u64,
}

/// Records every write to every GPIO line until it is dropped. There is one
/// recorder in a guest.
pub struct Trace(());

impl Trace {
    pub fn start() -> Trace {
        Trace::prepare();
        set("tracing_on", "1");
        Trace(())
    }

    /// Records the system calls of a thread, too.
    pub fn with_calls_of(thread: Pid) -> Trace {
        Trace::prepare();
        set("events/raw_syscalls/sys_enter/filter", &format!("common_pid == {thread}"));
        set("events/raw_syscalls/sys_enter/enable", "1");
        set("tracing_on", "1");
        Trace(())
    }

    fn prepare() {
        set("tracing_on", "0");
        set("trace", "");
        set("trace_clock", "mono");
        set("buffer_size_kb", "4096");
        set("events/gpio/gpio_value/enable", "1");
    }

    /// The writes so far, oldest first.
    pub fn writes(&self) -> Vec<Write> {
        entries(write)
    }

    /// Those to one line, by the kernel's number of it.
    pub fn writes_to(&self, line: u32) -> Vec<Write> {
        let mut writes = self.writes();
        writes.retain(|write| write.line == line);
        writes
    }

    /// The system calls so far, oldest first.
    pub fn calls(&self) -> Vec<Call> {
        entries(call)
    }
}

impl Drop for Trace {
    fn drop(&mut self) {
        for name in ["tracing_on", "events/gpio/gpio_value/enable", "events/raw_syscalls/sys_enter/enable"] {
            let _ = sysfs::try_write(format!("{TRACEFS}/{name}"), "0");
        }
    }
}

fn set(name: &str, value: &str) {
    sysfs::write(format!("{TRACEFS}/{name}"), value);
}

fn entries<T>(parse: impl Fn(&str) -> Option<T>) -> Vec<T> {
    let trace = sysfs::read(format!("{TRACEFS}/trace"));
    assert!(!trace.contains("LOST"), "the trace is not complete");
    trace.lines().filter_map(parse).collect()
}

/// `guest-123 [000] d..1. 12.345678: gpio_value: 507 set 1`
fn write(entry: &str) -> Option<Write> {
    let (head, event) = entry.split_once(": gpio_value: ")?;
    let mut words = event.split(' ');
    let line = words.next()?.parse().ok()?;
    if words.next()? != "set" {
        return None;
    }
    Some(Write { line, level: words.next()? == "1", at_us: microseconds(head)? })
}

/// `core-123 [000] d..1. 12.345678: sys_enter: NR 16 (5, c018b409, 7f, 0, 0, 0)`
fn call(entry: &str) -> Option<Call> {
    let (head, event) = entry.split_once(": sys_enter: NR ")?;
    Some(Call { number: event.split(' ').next()?.parse().ok()?, at_us: microseconds(head)? })
}

/// The time at the end of an entry's head.
fn microseconds(head: &str) -> Option<u64> {
    let (seconds, microseconds) = head.rsplit(' ').next()?.split_once('.')?;
    Some(seconds.parse::<u64>().ok()? * 1_000_000 + microseconds.parse::<u64>().ok()?)
}
