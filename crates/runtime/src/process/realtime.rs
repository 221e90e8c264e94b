// SPDX-License-Identifier: GPL-3.0-or-later
//! Real time: scheduling class, locked memory, timer slack, processor. Steps that the kernel does not permit are left
//! out. The log then names the limit and the remedy.

use std::fs;
use std::hint;
use std::io;
use std::path::Path;
use std::thread;

use log::{debug, info, warn};
use nix::errno::Errno;
use nix::sched::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::sys::prctl;
use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit, rlim_t};
use nix::unistd::Pid;

use pinion_firmware::trouble::Trouble;
use pinion_linux::foreign;
use pinion_linux::{LOOK_AT_LOG, sys};

use pinion_linux::proc::status_field;

use crate::core::budget::Class;

/// The purpose of a thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Owns the MCU.
    Core,
    /// Talks to the host.
    Link,
    /// Talks to a bus.
    Worker,
}

/// The SCHED_FIFO priority of a thread. The core has half of the highest one, as in the C program. The other threads
/// have less.
fn priority(role: Role) -> i32 {
    match role {
        Role::Core => 49,
        Role::Link => 45,
        Role::Worker => 40,
    }
}

/// The core's nice value while it runs as SCHED_OTHER: the most favorable one.
const NICE: i32 = -20;
/// The guardian stands above the core, so that it still runs if the core takes all of the processor.
const GUARDIAN_PRIORITY: i32 = 50;
/// Which pages are locked: the touched ones, and others when they are touched (MCL_ONFAULT, linux/mman.h). Without that
/// flag all pages of the libraries that libiio needs would be locked: 40 MB.
const LOCKED: MlockAllFlags =
    MlockAllFlags::MCL_CURRENT.union(MlockAllFlags::MCL_FUTURE).union(MlockAllFlags::from_bits_retain(4));
/// How much stack is touched: more than our threads use. With all parts of the simulated printer, in a debug build, the
/// core used 28 kB and a worker 12 kB (the `Rss` of their stacks in /proc/PID/smaps, when nothing was touched).
const STACK_BYTES: usize = 32 * 1024;
/// The calling thread, for the scheduling calls.
const MYSELF: Pid = Pid::from_raw(0);
/// Numbers of capabilities (linux/capability.h).
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

/// Locks every page in memory that was touched, or is touched from now on. If that is not permitted, the log says so.
pub fn lock_memory() {
    let limit = limit(Resource::RLIMIT_MEMLOCK);
    // With a limit, locking may succeed now. But later mappings would fail at the limit, and no thread could be started
    // any more. So memory is locked only where there is no limit.
    let locked = match limit != RLIM_INFINITY && !has_capability(CAP_IPC_LOCK) {
        true => Err(memory_refusal(limit)),
        false => mlockall(LOCKED).map_err(|error| Trouble::new(error.to_string())),
    };
    if let Err(why) = locked {
        warn!("memory is not locked, so steps may be late when memory is short: {why}");
    }
}

fn memory_refusal(limit: rlim_t) -> Trouble {
    Trouble::new(format!("the limit is {} KiB", limit / 1024))
        .remedy("set LimitMEMLOCK=infinity in the service (ulimit -l unlimited in a shell), or grant CAP_IPC_LOCK")
}

/// How a thread is scheduled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheduling {
    /// SCHED_FIFO.
    RealTime,
    /// SCHED_OTHER, as every program.
    Ordinary,
}

/// Gives the calling thread its real-time priority, if that is permitted. Returns how the thread is scheduled now.
pub fn enter(role: Role) -> Scheduling {
    touch_stack();
    // Before Linux 6.13 a futex wait ends up to 50 us late (the default timer slack), even under SCHED_FIFO. Setting
    // the slack prevents that.
    if let Err(error) = prctl::set_timerslack(1) {
        warn!("the timer slack cannot be set, so steps may be 50 us later before Linux 6.13: {error}");
    }
    match sys::set_fifo(priority(role)) {
        Ok(()) => {
            if role == Role::Core {
                info!("real time: SCHED_FIFO, priority {}", priority(role));
                // It counts while the budget makes the core run as SCHED_OTHER.
                if let Err(error) = sys::set_nice(NICE) {
                    debug!("nice {NICE}: {error}");
                }
            }
            Scheduling::RealTime
        }
        Err(error) => {
            // The other threads are refused for the same reason: one warning is enough.
            if role == Role::Core {
                warn!("no real-time scheduling, so steps may be late: {}", refusal(&error));
            }
            Scheduling::Ordinary
        }
    }
}

/// Whether this process may have SCHED_FIFO.
///
/// # Errors
///
/// The obstacle, and the remedy.
pub fn is_permitted() -> Result<(), Trouble> {
    // A scheduling class belongs to one thread, and this thread ends at once.
    let tried = thread::spawn(|| sys::set_fifo(priority(Role::Core)).map_err(|error| refusal(&error)));
    tried.join().unwrap_or_else(|_| Err(Trouble::new("it could not be tried").remedy(LOOK_AT_LOG)))
}

/// Makes the calling thread an ordinary one again.
pub fn leave() {
    // These cannot fail: a thread may always give up a priority.
    let _ = sys::set_other().and_then(|()| sys::set_nice(0));
}

/// Changes the scheduling class of the calling thread, the core. It was permitted at the start. If it no longer is, the
/// core continues in its present class.
pub(crate) fn change(class: Class) {
    let _ = match class {
        Class::Fifo => sys::set_fifo(priority(Role::Core)),
        Class::Other => sys::set_other(),
    };
}

/// Locks the memory of the calling process, the guardian, and puts it above the core. It does not log refusals: the
/// core meets the same ones, and the program logs those.
pub(crate) fn enter_guardian() {
    touch_stack();
    let _ = mlockall(LOCKED);
    let _ = sys::set_fifo(GUARDIAN_PRIORITY).or_else(|_| sys::set_fifo(priority(Role::Core)));
}

/// Writes to the stack, so that the kernel provides its pages now and not while a step is due.
#[inline(never)]
fn touch_stack() {
    hint::black_box(&mut [0u8; STACK_BYTES]);
}

/// For the log: the obstacle to real-time scheduling, and the remedy.
fn refusal(error: &io::Error) -> Trouble {
    scheduling_refusal(error, limit(Resource::RLIMIT_RTPRIO), has_capability(CAP_SYS_NICE), group_runtime_us())
}

fn scheduling_refusal(error: &io::Error, limit: rlim_t, capable: bool, group_runtime_us: Option<i64>) -> Trouble {
    let wanted = GUARDIAN_PRIORITY as rlim_t;
    if error.raw_os_error() != Some(libc::EPERM) {
        Trouble::new(error.to_string()).remedy(LOOK_AT_LOG)
    } else if group_runtime_us == Some(0) {
        Trouble::new(
            "this process's control group has no real-time budget (CONFIG_RT_GROUP_SCHED, cpu.rt_runtime_us is 0)",
        )
        .remedy(
            "write a budget such as 950000 there and into the groups above, or sysctl kernel.sched_rt_runtime_us=-1",
        )
    } else if !capable && limit < wanted {
        Trouble::new(format!("the limit of real-time priorities is {limit} and CAP_SYS_NICE is missing")).remedy(
            format!(
                "set LimitRTPRIO={wanted} in the service (rtprio in /etc/security/limits.conf for a shell), or grant \
                 CAP_SYS_NICE, or run as root"
            ),
        )
    } else {
        Trouble::new(format!("{error}: a container or a security module forbids it"))
            .remedy("allow sched_setscheduler there (CAP_SYS_NICE)")
    }
}

fn limit(resource: Resource) -> rlim_t {
    getrlimit(resource).map_or(0, |(soft, _)| soft)
}

fn has_capability(number: u32) -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    effective_capabilities(&status) >> number & 1 == 1
}

fn effective_capabilities(status: &str) -> u64 {
    status_field(status, "CapEff").and_then(|bits| u64::from_str_radix(bits, 16).ok()).unwrap_or(0)
}

/// The real-time budget of this process's control group in microseconds. `None` if the kernel is built without these
/// budgets (CONFIG_RT_GROUP_SCHED).
fn group_runtime_us() -> Option<i64> {
    let groups = fs::read_to_string("/proc/self/cgroup").ok()?;
    let group = cpu_group(&groups)?;
    let folders = ["/sys/fs/cgroup/cpu", "/sys/fs/cgroup/cpu,cpuacct"];
    folders
        .iter()
        .find_map(|folder| fs::read_to_string(format!("{folder}{group}/cpu.rt_runtime_us")).ok()?.trim().parse().ok())
}

/// The path of this process's group of the `cpu` controller (cgroup v1), from /proc/PID/cgroup.
fn cpu_group(groups: &str) -> Option<&str> {
    groups.lines().find_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        controllers.split(',').any(|name| name == "cpu").then_some(path.trim_end_matches('/'))
    })
}

/// The processors that this process may use, and the core's fixed processor, if any.
#[derive(Clone, Copy)]
pub struct Processors {
    present: CpuSet,
    core: Option<usize>,
}

impl Processors {
    /// The processors of the calling thread. `core` is the core's fixed processor.
    ///
    /// # Errors
    ///
    /// The process may not use that processor, or it does not exist.
    pub fn new(core: Option<usize>) -> Result<Processors, Trouble> {
        let unknown = |error: Errno| Trouble::new(error.to_string()).of("the processors of this process");
        let processors = Processors { present: sched_getaffinity(MYSELF).map_err(unknown)?, core };
        let Some(cpu) = core else { return Ok(processors) };
        let tried = processors.confine();
        sched_setaffinity(MYSELF, &processors.present).map_err(unknown)?;
        tried.map(|()| processors).map_err(|_| {
            let known = (0..CpuSet::count()).filter(|cpu| processors.present.is_set(*cpu) == Ok(true));
            let known: Vec<String> = known.map(|cpu| cpu.to_string()).collect();
            let trouble = Trouble::new("there is no such processor");
            trouble.remedy(format!("choose one of {}", known.join(", "))).of(format_args!("--cpu {cpu}"))
        })
    }

    /// Binds the calling thread, the core, to its fixed processor, if there is one.
    pub(crate) fn confine(&self) -> io::Result<()> {
        let Some(cpu) = self.core else { return Ok(()) };
        let mut cpus = CpuSet::new();
        cpus.set(cpu)?;
        Ok(sched_setaffinity(MYSELF, &cpus)?)
    }

    /// Lets the calling thread run on any processor. The core has started it, so it has inherited the core's binding.
    pub(crate) fn free(&self) {
        // If this fails, the thread only shares the core's processor.
        let _ = sched_setaffinity(MYSELF, &self.present);
    }

    /// Moves the calling thread, the core, to another processor. False if there is no other, or if the core has a fixed
    /// one.
    pub(crate) fn change(&self) -> bool {
        let mut others = self.present;
        // With only one processor, the set of the others is empty, and the kernel refuses it.
        self.core.is_none()
            && sched_getcpu()
                .and_then(|cpu| others.unset(cpu))
                .and_then(|()| sched_setaffinity(MYSELF, &others))
                .is_ok()
    }
}

/// Whether a kernel is PREEMPT_RT; `None` if that is unknown. `root` is the root of its /proc and /sys.
pub fn is_preempt_rt(root: &Path) -> Option<bool> {
    const BYTES_MAX: u64 = 4096;
    let text = |file: &str| {
        let bytes = foreign::read(&root.join(file), BYTES_MAX).ok()?;
        Some(String::from_utf8_lossy(&bytes).trim().to_owned())
    };
    // Patched older kernels say it in /sys. The kernel itself (since 6.12) says it only in its version.
    if text("sys/kernel/realtime").is_some_and(|text| text == "1") {
        return Some(true);
    }
    let version = text("proc/version")?;
    Some(version.contains("PREEMPT_RT") || version.contains("PREEMPT RT"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_keeps_us_from_real_time() {
        let eperm = io::Error::from_raw_os_error(libc::EPERM);
        let text = scheduling_refusal(&eperm, 0, false, None).to_string();
        assert!(
            text.starts_with("the limit of real-time priorities is 0 and CAP_SYS_NICE is missing: set LimitRTPRIO=50"),
            "{text}"
        );
        let text = scheduling_refusal(&eperm, 99, true, Some(0));
        assert!(text.cause.contains("cpu.rt_runtime_us is 0"), "{text}");
        let text = scheduling_refusal(&eperm, 0, true, Some(950_000));
        assert!(text.cause.contains("a container or a security module"), "{text}");
        let einval = io::Error::from_raw_os_error(libc::EINVAL);
        assert!(scheduling_refusal(&einval, 0, false, None).to_string().contains("dmesg"));
    }

    #[test]
    fn what_keeps_memory_from_being_locked() {
        let text = memory_refusal(8 << 20).to_string();
        assert!(text.starts_with("the limit is 8192 KiB: set LimitMEMLOCK=infinity"), "{text}");
    }

    #[test]
    fn capabilities() {
        let status = "Name:\tpinion\nCapPrm:\t0\nCapEff:\t0000000000804000\n";
        let bits = effective_capabilities(status);
        assert_eq!(bits, 1 << CAP_SYS_NICE | 1 << CAP_IPC_LOCK);
        assert_eq!(effective_capabilities(""), 0);
    }

    #[test]
    fn control_groups() {
        let first = "12:pids:/\n4:cpu,cpuacct:/system.slice/pinion.service\n0::/init.scope\n";
        assert_eq!(cpu_group(first), Some("/system.slice/pinion.service"));
        assert_eq!(cpu_group("3:cpuset:/\n0::/system.slice\n"), None);
        assert_eq!(cpu_group("4:cpu:/\n"), Some(""));
    }

    #[test]
    fn processors() {
        let before = sched_getaffinity(MYSELF).unwrap();
        let present: Vec<usize> = (0..CpuSet::count()).filter(|cpu| before.is_set(*cpu) == Ok(true)).collect();
        let pinned = Processors::new(Some(present[0])).unwrap();
        assert_eq!(sched_getaffinity(MYSELF), Ok(before));
        pinned.confine().unwrap();
        assert!(!pinned.change());
        let inherited = std::thread::spawn(move || {
            pinned.free();
            sched_getaffinity(MYSELF)
        });
        assert_eq!(inherited.join().unwrap(), Ok(before));
        pinned.free();

        let any = Processors::new(None).unwrap();
        any.confine().unwrap();
        assert_eq!(sched_getaffinity(MYSELF), Ok(before));
        for _ in 0..10 {
            let cpu = sched_getcpu().unwrap();
            // The kernel may move the thread between sched_getcpu and the change, but only within the set.
            assert_eq!(any.change(), present.len() > 1);
            if present.len() == 2 {
                assert_ne!(sched_getaffinity(MYSELF).unwrap(), before, "left processor {cpu}");
            }
        }

        let error = Processors::new(Some(100_000)).err().unwrap().to_string();
        assert!(error.starts_with("--cpu 100000: there is no such processor: choose one of "), "{error}");
    }
}
