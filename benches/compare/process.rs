// SPDX-License-Identifier: GPL-3.0-or-later
//! CPU time and memory, from /proc.

use std::collections::VecDeque;
use std::fs;
use std::time::{Duration, Instant};

use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;

/// Memory of a process.
#[derive(Clone, Copy, Debug, Default)]
pub struct Memory {
    pub resident_kib: u64,
    pub private_kib: u64,
}

/// Memory of a program: its main process, and the processes that it forked.
#[derive(Debug)]
pub struct Memories {
    main: Memory,
    forked: Option<Memory>,
}

impl Memories {
    pub fn each(&self) -> impl Iterator<Item = (&'static str, Memory)> {
        [Some(("main process", self.main)), self.forked.map(|memory| ("second process", memory))].into_iter().flatten()
    }
}

/// A process and the processes that it forked.
fn family(pid: u32) -> Vec<u32> {
    let mut family = Vec::new();
    let mut left = VecDeque::from([pid]);
    while let Some(pid) = left.pop_front() {
        family.push(pid);
        for task in tasks(pid) {
            let children = fs::read_to_string(format!("/proc/{pid}/task/{task}/children")).unwrap_or_default();
            left.extend(children.split_whitespace().filter_map(|child| child.parse::<u32>().ok()));
        }
    }
    family
}

fn tasks(pid: u32) -> Vec<u32> {
    let entries = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect()
}

/// CPU time of a program's threads so far. (schedstat counts nanoseconds, stat centiseconds.)
pub fn cpu(pid: u32) -> Duration {
    let of_task = |pid: u32, task: u32| -> Option<u64> {
        fs::read_to_string(format!("/proc/{pid}/task/{task}/schedstat")).ok()?.split(' ').next()?.parse().ok()
    };
    let ns = family(pid).into_iter().flat_map(|pid| tasks(pid).into_iter().filter_map(move |task| of_task(pid, task)));
    Duration::from_nanos(ns.sum())
}

/// Memory of a program. Fails if it is gone.
pub fn memory(pid: u32) -> Result<Memories, String> {
    let of_process = |pid: u32| -> Result<Memory, String> {
        let file = format!("/proc/{pid}/smaps_rollup");
        let text = fs::read_to_string(&file).map_err(|error| format!("{file}: {error}"))?;
        let kib = |name: &str| -> u64 {
            let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
            line.and_then(|rest| rest.split_whitespace().next()?.parse().ok()).unwrap_or(0)
        };
        Ok(Memory { resident_kib: kib("Rss"), private_kib: kib("Private_Clean") + kib("Private_Dirty") })
    };
    let mut forked = None;
    for pid in family(pid).into_iter().skip(1) {
        let memory = of_process(pid)?;
        let sum = forked.get_or_insert(Memory::default());
        sum.resident_kib += memory.resident_kib;
        sum.private_kib += memory.private_kib;
    }
    Ok(Memories { main: of_process(pid)?, forked })
}

/// How busy other processes keep this computer: neither the program nor the bench.
pub struct Others {
    pid: u32,
    since: Instant,
    all: Duration,
    known: Duration,
}

impl Others {
    pub fn start(pid: u32) -> Others {
        Others { pid, since: Instant::now(), all: computer(), known: cpu(pid) + own() }
    }

    /// CPUs that other processes used since the start.
    pub fn cpus(&self) -> f64 {
        let known = (cpu(self.pid) + own()).saturating_sub(self.known);
        let all = computer().saturating_sub(self.all);
        all.saturating_sub(known).as_secs_f64() / self.since.elapsed().as_secs_f64()
    }
}

fn own() -> Duration {
    let Ok(usage) = getrusage(UsageWho::RUSAGE_SELF) else { return Duration::ZERO };
    let us = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
    Duration::from_micros(us.unsigned_abs())
}

/// CPU time of all processes and of the kernel; time that a hypervisor stole included.
fn computer() -> Duration {
    let text = fs::read_to_string("/proc/stat").unwrap_or_default();
    let fields = text.lines().next().unwrap_or_default().split_whitespace().skip(1);
    let times: Vec<u64> = fields.filter_map(|field| field.parse().ok()).collect();
    // user, nice, system, idle, iowait, irq, softirq, steal, in hundredths of a second
    let busy = times.iter().enumerate().filter(|(i, _)| !matches!(i, 3 | 4) && *i < 8).map(|(_, time)| time);
    Duration::from_millis(busy.sum::<u64>() * 10)
}
