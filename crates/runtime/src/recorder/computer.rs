// SPDX-License-Identifier: GPL-3.0-or-later
//! The kernel's accounts of this computer: how long threads waited for a processor, and what else slows the
//! computer down. Not every computer has all of them.

use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::time::Duration;

use nix::unistd::{Pid, SysconfVar, sysconf};

use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks};
use pinion_shm::ring::Ring;

use pinion_linux::{foreign, throttled};
use pinion_trace::event::{Event, PowerFault, Watched};
use pinion_trace::ring::Writer;

/// Time between two samples while something happens. The verdict finds a standstill that is somewhat longer.
const OFTEN: Duration = Duration::from_millis(250);
/// Time between two samples while nothing happens. A hang of the core takes a second to be found: samples cover half of it.
const SELDOM: Duration = Duration::from_millis(500);
/// After this many samples without anything new, nothing happens. A host asks for the clock each second.
const CALM: u32 = 5;
/// One sample in this many reads everything. The kernel needs long for some of it.
const RARELY: u32 = 32;
/// Longest file of sysfs or procfs that is read.
const FILE_BYTES: u64 = 1 << 16;

/// Reads the accounts, and records their changes.
pub(super) struct Computer {
    root: PathBuf,
    writer: Writer,
    accounts: Vec<Account>,
    /// A Raspberry Pi's file with the firmware's bits.
    throttled: Option<PathBuf>,
    /// Number of samples so far, and since something happened.
    samples: u32,
    calm: u32,
    stolen: Option<u64>,
    power: Option<PowerFault>,
    /// Ticks of /proc/stat in a second.
    hz: u64,
}

/// The kernel's account of a thread.
struct Account {
    thread: Watched,
    file: File,
    /// The ring of the thread's events, and how many events it had at the last sample.
    ring: Ring<'static>,
    written: u64,
    before: Option<Times>,
}

/// The times of an account (Documentation/scheduler/sched-stats.rst), in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Times {
    ran: u64,
    waited: u64,
}

impl Computer {
    /// The computer with this root folder, `/` unless a test has made one.
    pub(super) fn new(root: PathBuf, writer: Writer) -> Computer {
        let hz = sysconf(SysconfVar::CLK_TCK).ok().flatten().and_then(|hz| u64::try_from(hz).ok()).unwrap_or(100);
        let pattern = root.join(throttled::FILES.trim_start_matches('/'));
        // The search goes through many folders, so it is done once.
        let throttled = glob::glob(&pattern.to_string_lossy()).ok().and_then(|files| files.flatten().next());
        Computer { root, writer, accounts: Vec::new(), throttled, samples: 0, calm: 0, stolen: None, power: None, hz }
    }

    /// Reads the kernel's account of this thread, too. The ring has the thread's events.
    pub(super) fn watch(&mut self, thread: Watched, tid: Pid, ring: Ring<'static>) {
        // The file stays open: opening it takes longer than reading it. A kernel without the account has no file.
        if let Ok(file) = File::open(self.root.join(format!("proc/self/task/{tid}/schedstat"))) {
            self.accounts.push(Account { thread, file, ring, written: 0, before: None });
        }
    }

    fn read(&self, path: &str) -> Option<String> {
        let bytes = foreign::read(&self.root.join(path.trim_start_matches('/')), FILE_BYTES).ok()?;
        String::from_utf8(bytes).ok()
    }

    /// Records the changes since the last call. It reads most things only if `all`, and at some other calls.
    /// Returns the time of the next sample.
    pub(super) fn sample(&mut self, at: Clock, all: bool) -> Duration {
        let all = all || self.samples.is_multiple_of(RARELY);
        self.samples = self.samples.wrapping_add(1);
        self.calm = if self.sample_threads(at, all) { 0 } else { self.calm.saturating_add(1) };
        if all {
            self.sample_all(at);
        }
        let again = if self.calm < CALM { OFTEN } else { SELDOM };
        self.writer.write(at, Event::Looked { again: ticks(again.as_nanos() as u64), all });
        again
    }

    fn sample_all(&mut self, at: Clock) {
        self.sample_stolen_time(at);
        let power = self.power_fault();
        // Repeat conditions that last: the ring overwrites old events.
        if power != self.power || power.is_some() {
            self.power = power;
            self.writer.write(at, Event::Power(power));
        }
        let (mhz, max_mhz) = self.frequency();
        if mhz > 0 {
            self.writer.write(at, Event::Frequency { mhz, max_mhz });
        }
    }

    /// Whether a thread has written something.
    fn sample_threads(&mut self, at: Clock, all: bool) -> bool {
        let mut has_news = false;
        for Account { thread, file, ring, written, before } in &mut self.accounts {
            let old = std::mem::replace(written, ring.next());
            let is_new = *written != old;
            has_news |= is_new;
            // A link without events did nothing. A core without events may hang.
            if !is_new && !all && *thread == Watched::Link {
                continue;
            }
            let mut text = [0; 64];
            let length = file.read_at(&mut text, 0).unwrap_or(0);
            let Some(now) = str::from_utf8(&text[..length]).ok().and_then(times) else { continue };
            // The first one says since when.
            let Times { ran, waited } = before.replace(now).unwrap_or(now);
            let (ran, waited) = (ticks(now.ran.saturating_sub(ran)), ticks(now.waited.saturating_sub(waited)));
            self.writer.write(at, Event::Processor { thread: *thread, ran, waited });
        }
        has_news
    }

    fn sample_stolen_time(&mut self, at: Clock) {
        let Some(now) = self.read("/proc/stat").and_then(|stat| stolen(&stat)) else { return };
        if let Some(before) = self.stolen.replace(now).filter(|before| *before < now) {
            let seconds = u64::from(pinion_firmware::time::CLOCK_FREQ);
            let ticks = (now - before).saturating_mul(seconds) / self.hz.max(1);
            self.writer.write(at, Event::Stolen(Ticks(u32::try_from(ticks).unwrap_or(u32::MAX))));
        }
    }

    fn power_fault(&self) -> Option<PowerFault> {
        // The Pi's own kernel has the first file, Linux's own driver the second.
        let text = self.throttled.as_ref().and_then(|file| fs::read_to_string(file).ok());
        let bits = text.and_then(|text| throttled::bits(&text));
        let alarm = || {
            let alarms = fs::read_dir(self.root.join("sys/class/hwmon")).ok()?.filter_map(Result::ok);
            alarms
                .filter(|entry| {
                    fs::read_to_string(entry.path().join("name")).is_ok_and(|name| name.trim() == "rpi_volt")
                })
                .find_map(|entry| fs::read_to_string(entry.path().join("in0_lcrit_alarm")).ok())
        };
        match bits {
            Some(bits) if bits & throttled::UNDERVOLTAGE != 0 => Some(PowerFault::Undervoltage),
            Some(bits) if bits & throttled::HOT != 0 => Some(PowerFault::Hot),
            Some(_) => None,
            None => alarm().filter(|text| text.trim() == "1").map(|_| PowerFault::Undervoltage),
        }
    }

    /// The first processor's frequency, and its highest one, in MHz; 0 if it is unknown.
    fn frequency(&self) -> (u16, u16) {
        let mhz = |name: &str| {
            let khz = self.read(&format!("/sys/devices/system/cpu/cpu0/cpufreq/{name}"));
            khz.and_then(|khz| u16::try_from(khz.trim().parse::<u32>().ok()? / 1000).ok()).unwrap_or(0)
        };
        (mhz("scaling_cur_freq"), mhz("cpuinfo_max_freq"))
    }
}

fn ticks(ns: u64) -> Ticks {
    Ticks(u32::try_from(ns / NS_PER_TICK).unwrap_or(u32::MAX))
}

/// The first two fields of a schedstat.
fn times(text: &str) -> Option<Times> {
    let mut fields = text.split_whitespace().map_while(|field| field.parse().ok());
    Some(Times { ran: fields.next()?, waited: fields.next()? })
}

/// The time that a hypervisor took from all processors (proc_stat(5), the eighth number).
fn stolen(stat: &str) -> Option<u64> {
    stat.lines().next()?.strip_prefix("cpu ")?.split_whitespace().nth(7)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const PI_THROTTLED: &str = "/sys/devices/platform/soc/soc:firmware/get_throttled";

    fn put(root: &Path, path: &str, text: &str) {
        let path = root.join(path.trim_start_matches('/'));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn events(ring: Ring<'static>) -> Vec<Event> {
        ring.newest().into_iter().filter_map(Event::decode).map(|(_, event)| event).collect()
    }

    /// A ring in memory of its own.
    fn ring_of(events: usize) -> Ring<'static> {
        let words = pinion_shm::ring::words(events);
        Ring::new(Box::leak((0..words).map(|_| std::sync::atomic::AtomicU64::new(0)).collect()))
    }

    #[test]
    fn what_has_changed_is_recorded() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let ring = ring_of(256);
        put(root, PI_THROTTLED, "0\n");
        let mut computer = Computer::new(root.into(), Writer::new(ring, "sampler").unwrap());
        put(root, "/proc/self/task/7/schedstat", "");
        computer.watch(Watched::Core, Pid::from_raw(7), ring_of(8));
        let mut seen = 0;
        let mut sample = || {
            computer.sample(Clock::EPOCH, true);
            let mut events = events(ring);
            assert!(matches!(events.pop(), Some(Event::Looked { all: true, .. })));
            let new = events[seen..].to_vec();
            seen = events.len() + 1;
            new
        };
        assert_eq!(sample(), []);
        put(root, "/proc/self/task/7/schedstat", "1000000 5000 12\n");
        put(root, "/proc/stat", "cpu  1 2 3 4 5 6 7 100 0 0\ncpu0 1 2\n");
        put(root, "/sys/devices/system/cpu/cpu0/cpufreq/scaling_cur_freq", "600000\n");
        put(root, "/sys/devices/system/cpu/cpu0/cpufreq/cpuinfo_max_freq", "1500000\n");
        let still = Event::Processor { thread: Watched::Core, ran: Ticks(0), waited: Ticks(0) };
        let frequency = Event::Frequency { mhz: 600, max_mhz: 1500 };
        assert_eq!(sample(), [still, frequency]);
        put(root, "/proc/self/task/7/schedstat", "3000000 12005000 15\n");
        put(root, "/proc/stat", "cpu  1 2 3 4 5 6 7 103 0 0\n");
        put(root, PI_THROTTLED, "50005\n");
        let processor = Event::Processor { thread: Watched::Core, ran: Ticks::from_ms(2), waited: Ticks::from_ms(12) };
        let power = Event::Power(Some(PowerFault::Undervoltage));
        assert_eq!(sample(), [processor, Event::Stolen(Ticks(3 * 50_000_000 / 100)), power, frequency]);
        put(root, PI_THROTTLED, "50004\n");
        let hot = Event::Power(Some(PowerFault::Hot));
        assert_eq!(sample(), [still, hot, frequency]);
        assert_eq!(sample(), [still, hot, frequency], "the ring forgets");
        put(root, PI_THROTTLED, "50000\n");
        assert_eq!(sample(), [still, Event::Power(None), frequency]);
        assert_eq!(sample(), [still, frequency]);
        fs::remove_file(root.join(PI_THROTTLED.trim_start_matches('/'))).unwrap();
        put(root, "/sys/class/hwmon/hwmon1/name", "rpi_volt\n");
        put(root, "/sys/class/hwmon/hwmon1/in0_lcrit_alarm", "1\n");
        assert_eq!(sample(), [still, power, frequency]);
    }

    #[test]
    fn a_calm_program_is_looked_at_less_often() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let (ring, core, link) = (ring_of(256), ring_of(8), ring_of(8));
        let mut computer = Computer::new(root.into(), Writer::new(ring, "sampler").unwrap());
        for (thread, tid, of) in [(Watched::Core, 7, core), (Watched::Link, 8, link)] {
            put(root, &format!("/proc/self/task/{tid}/schedstat"), "1000000 5000 12\n");
            computer.watch(thread, Pid::from_raw(tid), of);
        }
        let (mut core, mut link) = (Writer::new(core, "core").unwrap(), Writer::new(link, "link").unwrap());
        let mut sample = |all| {
            let before = events(ring).len();
            let again = computer.sample(Clock::EPOCH, all);
            let looked = events(ring)[before..].to_vec();
            let is_of = |thread| {
                looked.iter().any(|event| matches!(event, Event::Processor { thread: of, .. } if *of == thread))
            };
            (again, is_of(Watched::Core), is_of(Watched::Link))
        };
        assert_eq!(sample(false), (OFTEN, true, true), "the first sample has everything");
        for _ in 2..CALM {
            // A core that hangs writes nothing.
            assert_eq!(sample(false), (OFTEN, true, false));
        }
        assert_eq!(sample(false), (SELDOM, true, false));
        link.write(Clock::EPOCH, Event::Out(1));
        assert_eq!(sample(false), (OFTEN, true, true));
        for _ in 1..CALM {
            sample(false);
        }
        assert_eq!(sample(false).0, SELDOM);
        core.write(Clock::EPOCH, Event::Pace { worst: Ticks(1) });
        assert_eq!(sample(false), (OFTEN, true, false));
        assert_eq!(sample(true), (OFTEN, true, true));
    }

    #[test]
    fn this_computer_reports_how_long_a_thread_ran() {
        let ring = ring_of(256);
        let mut computer = Computer::new("/".into(), Writer::new(ring, "sampler").unwrap());
        computer.watch(Watched::Core, nix::unistd::gettid(), ring_of(8));
        computer.sample(Clock::EPOCH, false);
        let until = std::time::Instant::now() + std::time::Duration::from_millis(20);
        while std::time::Instant::now() < until {}
        computer.sample(Clock::EPOCH, false);
        let events = events(ring).into_iter();
        let ran = events.filter_map(|event| if let Event::Processor { ran, .. } = event { Some(ran) } else { None });
        let ran: Vec<Ticks> = ran.collect();
        if Path::new("/proc/self/schedstat").exists() {
            assert!(ran.len() == 2 && ran[0] == Ticks(0) && ran[1] > Ticks(0), "{ran:?}");
        }
    }
}
