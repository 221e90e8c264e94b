// SPDX-License-Identifier: GPL-3.0-or-later
//! One machine under QEMU, from boot to the last result.

use std::ffi::OsString;
use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use super::cache::Cache;
use super::kernel::{Flavour, Kernel};
use super::report::{Outcome, Report};

/// Longer than a test may take, and longer than a boot on a busy computer.
const SILENCE_MAX: Duration = Duration::from_secs(180);
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// What init makes QEMU exit with when every test of the plan has run.
const EXIT_PLAN_DONE: i32 = 33;

/// What time is, in the guest.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The host's. It says nothing of lateness: an emulated processor is slow,
    /// and stops whenever the host does.
    Host,
    /// An instruction takes 2 ns. The same on every host, to the nanosecond.
    Instructions,
}

impl Clock {
    /// Figures have to be the same everywhere, and Pinion in time on a busy host, too.
    pub fn of_test(test: &str) -> Clock {
        if ["timing::", "pinion::"].iter().any(|module| test.starts_with(module)) {
            Clock::Instructions
        } else {
            Clock::Host
        }
    }

    fn name(self) -> &'static str {
        match self {
            Clock::Host => "host",
            Clock::Instructions => "instructions",
        }
    }
}

/// The tests that one machine runs.
pub struct Run {
    pub flavour: Flavour,
    pub clock: Clock,
    pub tests: Vec<String>,
}

impl Run {
    /// Boots the machine and reports each test as its result comes. An error is
    /// a failure of the lab; one of the guest is that of the tests it left out.
    pub fn boot(
        &self,
        kernel: &Kernel,
        payload: &[u8],
        cache: &Cache,
        report: &Mutex<&mut Report>,
    ) -> Result<(), String> {
        let folder = cache.run_folder()?;
        let folder = folder.path();
        let share = folder.join("share");
        let console = folder.join("console");
        create(&share)?;
        let plan: String = self.tests.iter().map(|test| format!("{test}\n")).collect();
        let mut machine = machine(kernel, payload, folder, &plan)?;
        match self.clock {
            Clock::Host => machine.args(["-smp", "2"]),
            Clock::Instructions => machine.args(["-icount", "shift=1,sleep=off"]).args([
                "-rtc",
                "base=2026-01-01T00:00:00,clock=vm",
                "-seed",
                "1",
            ]),
        };
        machine
            .arg("-append")
            .arg(format!("{COMMAND_LINE} nokaslr norandmaps random.trust_cpu=on LAB_CLOCK={}", self.clock.name()));
        machine.arg("-serial").arg(concatenated("file:", &console));
        let log = File::create(folder.join("qemu")).map_err(|error| error.to_string())?;
        let mut qemu = machine
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .map_err(|error| format!("cannot start the emulator: {error}"))?;

        let reported = self.follow(&mut qemu, &share, report);
        // Already gone, unless following failed.
        let _ = qemu.kill();
        let status = qemu.wait().map_err(|error| error.to_string())?;
        let (count, cause) = reported?;
        if count < self.tests.len() {
            let cause = match (cause, status.code()) {
                (Some(cause), _) => cause,
                (None, Some(EXIT_PLAN_DONE)) => "the guest ended and left no result".into(),
                (None, _) => format!("the machine died: {status}"),
            };
            let read = |path: &Path| String::from_utf8_lossy(&fs::read(path).unwrap_or_default()).into_owned();
            for (index, test) in self.tests.iter().enumerate().skip(count) {
                let output = match index - count {
                    0 => format!(
                        "{cause}\n{}--- console\n{}\n--- emulator\n{}",
                        read(&share.join("output").join(test)),
                        read(&console),
                        read(&folder.join("qemu"))
                    ),
                    _ => "not run: see the test before".into(),
                };
                report.lock().expect("no machine panics").test(&self.flavour.name_of(test), Outcome::Failed, &output);
            }
        }
        Ok(())
    }

    /// How many tests were reported before the machine ended, and why it was
    /// stopped if it did not end by itself.
    fn follow(
        &self,
        qemu: &mut Child,
        share: &Path,
        report: &Mutex<&mut Report>,
    ) -> Result<(usize, Option<String>), String> {
        let mut reported = 0;
        let mut heard = Instant::now();
        loop {
            // Before the results are read: what comes later is read the next time.
            let ended = qemu.try_wait().map_err(|error| error.to_string())?.is_some();
            let results = fs::read_to_string(share.join("results")).unwrap_or_default();
            // A line without its end is still being written.
            let complete = results.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n'));
            for line in complete.skip(reported) {
                let (test, status) = line.split_once(' ').unwrap_or((line, ""));
                if self.tests.get(reported).is_none_or(|planned| planned != test) {
                    return Err(format!("the guest reported {line:?}, which was not its next test"));
                }
                let output = fs::read(share.join("output").join(test)).unwrap_or_default();
                let output = String::from_utf8_lossy(&output);
                // A name that the program does not know is a success to libtest.
                let passed = status == "0" && output.contains("test result: ok. 1 passed;");
                report.lock().expect("no machine panics").test(
                    &self.flavour.name_of(test),
                    if passed { Outcome::Passed } else { Outcome::Failed },
                    &output,
                );
                reported += 1;
                heard = Instant::now();
            }
            if ended {
                return Ok((reported, None));
            }
            if heard.elapsed() > SILENCE_MAX {
                let cause = format!("no result for {} s: stopped", SILENCE_MAX.as_secs());
                return Ok((reported, Some(cause)));
            }
            thread::sleep(POLL_INTERVAL);
        }
    }
}

/// A shell in the guest, on this terminal.
pub fn shell(kernel: &Kernel, payload: &[u8], cache: &Cache) -> Result<(), String> {
    let folder = cache.run_folder()?;
    let share = folder.path().join("share");
    create(&share)?;
    eprintln!("lab: /lab/share in the guest is {}", share.display());
    let mut qemu = machine(kernel, payload, folder.path(), "")?
        .args(["-smp", "2", "-serial", "mon:stdio"])
        .arg("-append")
        .arg(format!("{COMMAND_LINE} LAB_SHELL=1"))
        .spawn()
        .map_err(|error| format!("cannot start the emulator: {error}"))?;
    qemu.wait().map(drop).map_err(|error| error.to_string())
}

/// A panic reboots, which ends the emulator. Guards against the faults of real
/// processors, and the ciphers' self-tests, cost an emulated one a second.
const COMMAND_LINE: &str = "console=ttyS0 quiet panic=-1 mitigations=off cryptomgr.notests";

/// The plainest is emulated fastest; random numbers must not wait for a boot that
/// has little chance in it.
const PROCESSOR: &str = "qemu64,+rdrand";

/// The machine that every run has. KVM is left alone even where there is one:
/// the lab is to be the same everywhere.
fn machine(kernel: &Kernel, payload: &[u8], folder: &Path, plan: &str) -> Result<Command, String> {
    let initramfs = folder.join("initramfs");
    let mut archives =
        fs::read(&kernel.initramfs).map_err(|error| format!("cannot read {}: {error}", kernel.initramfs.display()))?;
    archives.extend_from_slice(payload);
    let mut last = super::initramfs::Archive::default();
    last.file("/lab/plan", plan.as_bytes());
    archives.extend(last.finish());
    fs::write(&initramfs, archives).map_err(|error| format!("cannot write {}: {error}", initramfs.display()))?;

    let mut machine = Command::new("qemu-system-x86_64");
    machine
        .args(["-accel", "tcg", "-cpu", PROCESSOR, "-m", "512", "-nodefaults", "-display", "none"])
        .args(["-no-reboot", "-device", "isa-debug-exit,iobase=0xf4,iosize=0x04"])
        .arg("-kernel")
        .arg(&kernel.vmlinux)
        .arg("-initrd")
        .arg(&initramfs)
        .arg("-virtfs");
    let mut share = concatenated("local,path=", &folder.join("share"));
    share.push(",mount_tag=lab,security_model=none");
    machine.arg(share);
    Ok(machine)
}

fn concatenated(prefix: &str, path: &Path) -> OsString {
    let mut text = OsString::from(prefix);
    text.push(path);
    text
}

fn create(folder: &Path) -> Result<(), String> {
    fs::create_dir(folder).map_err(|error| format!("cannot create {}: {error}", folder.display()))
}
