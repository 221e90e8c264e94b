// SPDX-License-Identifier: GPL-3.0-or-later
//! The real events on the lines with their times, and the system calls of a program. Both come from the kernel's own
//! trace points.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io::{ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;

use nix::fcntl::OFlag;
use nix::unistd::Pid;

use super::sysfs;

const TRACEFS: &str = "/sys/kernel/tracing";

/// A write of a level to a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Write {
    /// The kernel's number of the line.
    pub line: u32,
    pub level: bool,
    /// CLOCK_MONOTONIC.
    pub at_ns: u64,
}

/// Records every write to every GPIO line until it is dropped. A guest has one recorder.
///
/// It reads the ring buffer's pages instead of the file `trace`. That text has only microseconds, and an emulated
/// processor needs a long time to make it.
pub struct Trace {
    event: Event,
    writes: RefCell<Vec<Write>>,
}

/// The places of the fields in the pages, from the event's `id` and `format`.
struct Event {
    id: u64,
    gpio: usize,
    get: usize,
    value: usize,
}

impl Trace {
    pub fn start() -> Trace {
        Trace::with_filter("0")
    }

    /// Records the writes to one line, by the kernel's number of the line.
    pub fn of_line(line: u32) -> Trace {
        Trace::with_filter(&format!("gpio == {line}"))
    }

    /// The kernel records everything with the filter 0.
    fn with_filter(filter: &str) -> Trace {
        set("tracing_on", "0");
        set("trace", "");
        set("trace_clock", "mono");
        set("buffer_size_kb", "8192");
        set("events/gpio/gpio_value/filter", filter);
        set("events/gpio/gpio_value/enable", "1");
        let format = get("events/gpio/gpio_value/format");
        let offset = |field: &str| {
            // field:unsigned gpio;	offset:8;	size:4;	signed:0;
            let rest = format.split_once(&format!(" {field};\toffset:")).map(|(_, rest)| rest);
            let offset = rest.and_then(|rest| rest.split_once(';')?.0.parse().ok());
            offset.unwrap_or_else(|| panic!("no {field} in this:\n{format}"))
        };
        let id = get("events/gpio/gpio_value/id").parse().expect("a number");
        let event = Event { id, gpio: offset("gpio"), get: offset("get"), value: offset("value") };
        set("tracing_on", "1");
        Trace { event, writes: RefCell::default() }
    }

    /// The writes so far, oldest first.
    pub fn writes(&self) -> Vec<Write> {
        let mut writes = self.writes.borrow_mut();
        for processor in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            self.read(processor, &mut writes);
        }
        writes.sort_by_key(|write| write.at_ns);
        writes.clone()
    }

    /// The writes to one line, by the kernel's number of the line.
    pub fn writes_to(&self, line: u32) -> Vec<Write> {
        let mut writes = self.writes();
        writes.retain(|write| write.line == line);
        writes
    }

    /// Reads one processor's records from the ring buffer.
    fn read(&self, processor: usize, writes: &mut Vec<Write>) {
        let path = format!("{TRACEFS}/per_cpu/cpu{processor}/trace_pipe_raw");
        let mut pages = OpenOptions::new()
            .read(true)
            .custom_flags(OFlag::O_NONBLOCK.bits())
            .open(&path)
            .unwrap_or_else(|error| panic!("{path}: {error}"));
        let mut page = [0; 4096];
        loop {
            match pages.read(&mut page) {
                Ok(0) => return,
                Ok(len) => self.event.find(&page[..len], writes),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                Err(error) => panic!("{path}: {error}"),
            }
        }
    }
}

impl Drop for Trace {
    fn drop(&mut self) {
        for name in ["tracing_on", "events/gpio/gpio_value/enable"] {
            let _ = sysfs::try_write(format!("{TRACEFS}/{name}"), "0");
        }
    }
}

impl Event {
    /// Appends the writes of a page. `events/header_page`, `events/header_event` and the kernel's
    /// include/linux/ring_buffer.h describe its format.
    fn find(&self, page: &[u8], writes: &mut Vec<Write>) {
        const MISSED_EVENTS: u64 = 1 << 31;
        const LENGTH: u64 = 0xf_ffff;
        const WORD: usize = 4;
        let word = |at: usize| u32::from_ne_bytes(page[at..at + WORD].try_into().expect("four bytes"));
        let long = |at: usize| u64::from_ne_bytes(page[at..at + 8].try_into().expect("eight bytes"));
        let (mut at_ns, commit) = (long(0), long(8));
        assert!(commit & MISSED_EVENTS == 0, "the trace is not complete");
        let mut at = 16;
        let end = at + (commit & LENGTH) as usize;
        while at < end {
            let head = word(at);
            let (kind, delta) = (head & 0x1f, u64::from(head >> 5));
            let extended = |at: usize| (u64::from(word(at + WORD)) << 27) + delta;
            let len = match kind {
                // Padding up to the page's end.
                29 if delta == 0 => return,
                30 => {
                    at_ns += extended(at);
                    WORD
                }
                31 => {
                    at_ns = extended(at);
                    WORD
                }
                _ => {
                    at_ns += delta;
                    // The first word of a long event is its length. The same is true for a dropped event.
                    if kind == 0 || kind == 29 { word(at + WORD) as usize } else { kind as usize * WORD }
                }
            };
            let data = at + WORD;
            at = data + len;
            let is_small = (1..=28).contains(&kind);
            // The event's id is the first field of each event.
            if is_small && word(data) as u64 & 0xffff == self.id && word(data + self.get) == 0 {
                let (line, level) = (word(data + self.gpio), word(data + self.value) != 0);
                writes.push(Write { line, level, at_ns });
            }
        }
    }
}

/// Counts the system calls of threads until it is dropped. The kernel itself counts, which takes less time than a
/// record of each call.
pub struct Calls {
    trigger: String,
}

const CALLS: &str = "events/raw_syscalls/sys_enter";

impl Calls {
    pub fn of(threads: &[Pid]) -> Calls {
        let pids: Vec<String> = threads.iter().map(|thread| format!("common_pid == {thread}")).collect();
        let calls = Calls { trigger: format!("hist:keys=id if {}", pids.join(" || ")) };
        set(&format!("{CALLS}/trigger"), &calls.trigger);
        calls
    }

    /// The number of calls so far, by system call number as in `libc::SYS_ioctl`.
    pub fn so_far(&self) -> BTreeMap<i64, u64> {
        // { id:         16 } hitcount:       1000
        let count = |line: &str| {
            let (id, hits) = line.strip_prefix("{ id:")?.split_once("} hitcount:")?;
            Some((id.trim().parse().ok()?, hits.trim().parse().ok()?))
        };
        get(&format!("{CALLS}/hist")).lines().filter_map(count).collect()
    }
}

impl Drop for Calls {
    fn drop(&mut self) {
        let _ = sysfs::try_write(format!("{TRACEFS}/{CALLS}/trigger"), format!("!{}", self.trigger));
    }
}

fn set(name: &str, value: &str) {
    sysfs::write(format!("{TRACEFS}/{name}"), value);
}

fn get(name: &str) -> String {
    sysfs::read(format!("{TRACEFS}/{name}"))
}
