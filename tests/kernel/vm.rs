// SPDX-License-Identifier: GPL-3.0-or-later
//! One VM under QEMU, from its snapshot to the last result.

use std::env;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use serde_json::json;

use super::cache_lines::CacheLines;
use super::emulator::Emulator;
use super::guest_program::OtherProgram;
use super::programs::{self, Programs};
use super::report::{Outcome, Report};
use super::snapshot::Snapshot;
use pinion_testkit::cache::Cache;
use pinion_testkit::kernel::{Flavour, Kernel};

pub const EMULATOR: &str = "qemu-system-x86_64";

/// init.sh ends a test after this time of the guest, and a print's time.
const TEST_S: u32 = 90;

const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Longest processor time of the emulator for a second of a busy guest.
const SECOND: Duration = Duration::from_secs(10);
/// Longest silence by the computer's clock, beyond that time, for an emulator that uses no processor time.
const STALL_MAX: Duration = Duration::from_secs(3600);

/// QEMU's exit code from init after all tests of the plan.
const EXIT_PLAN_DONE: i32 = 33;

/// The start of a console line with the name of the next test.
const MARK: &str = "test: ";

/// The guest's time: an instruction takes 1 ns. It is the same on every computer, to the nanosecond. It passes at once
/// when the guest is idle. By the computer's clock an emulated processor would be slow, and would stop when the
/// computer stops.
const TIME: [&str; 6] = ["-icount", "shift=0,sleep=off", "-rtc", "base=2026-01-01T00:00:00,clock=vm", "-seed", "1"];

/// A panic reboots, which ends the emulator. The other options save an emulated processor work that no test needs:
/// guards against the faults of real processors, the ciphers' self-tests, security modules, auditing, clearing of
/// memory, lockup detection.
const COMMAND_LINE: &str = "console=ttyS0 quiet panic=-1 mitigations=off cryptomgr.notests lsm= audit=0 \
     init_on_alloc=0 nowatchdog psi=0";

/// The plainest processor is emulated fastest. Random numbers must not wait for a boot with little entropy.
const PROCESSOR: &str = "qemu64,+rdrand";

/// The tests that one VM runs.
pub struct Run<'a> {
    pub flavour: Flavour,
    /// The measured program, if it is not Pinion.
    pub program: Option<&'a OtherProgram>,
    pub print_seconds: u32,
    pub tests: Vec<String>,
}

impl Run<'_> {
    /// A test's name in the report.
    pub fn name_of(&self, test: &str) -> String {
        match self.program {
            Some(program) => format!("{}::{}::{test}", self.flavour.name(), program.name),
            None => format!("{}::{test}", self.flavour.name()),
        }
    }

    /// The column for the tests' figures.
    pub fn column(&self) -> String {
        let program = self.program.map_or("pinion", |program| &program.name);
        format!("{} {program}", self.flavour.name())
    }

    /// Runs the tests and reports them. An error is a failure of the suite. An error of the guest counts for the tests
    /// that it left out.
    pub fn perform(
        &self,
        snapshot: &Snapshot,
        programs: &Programs,
        cache: &Cache,
        report: &Mutex<&mut Report>,
    ) -> Result<(), String> {
        let folder = cache.run_folder()?;
        let folder = folder.path();
        let plan = folder.join("plan");
        let program = self.program.map(OtherProgram::command).unwrap_or_default();
        let text: String = self.tests.iter().map(|test| format!("{test} {} {program}\n", self.print_seconds)).collect();
        fs::write(&plan, text).map_err(|error| format!("cannot write {}: {error}", plan.display()))?;
        let mut vm = vm(folder)?;
        vm.args(TIME)
            // The file that `-kernel` put into the VM that was booted.
            .args(["-option-rom", "pvh.bin", "-incoming", &snapshot.source(), "-fw_cfg"])
            .arg(format!("name=opt/pinion/plan,file={}", plan.display()));
        let lines = CacheLines::of(&self.tests, folder)?;
        if let Some(lines) = &lines {
            vm.arg("-plugin").arg(lines.option());
        }
        let mut emulator = Emulator::start(vm, folder)?;
        emulator.wait_until(|status| status != "inmigrate")?;
        programs.put_into(folder)?;
        emulator.ask(json!({"execute": "cont"}))?;

        let cause = follow(&mut emulator, SECOND * (TEST_S + self.print_seconds))?;
        let share = folder.join("share");
        let count = self.report_results(&share, lines.as_ref(), report)?;
        keep_profiles(&share)?;
        if count < self.tests.len() {
            let console = emulator.console();
            let named = console.lines().rev().find_map(|line| line.strip_prefix(MARK));
            let last = named.filter(|name| self.tests[count..].iter().any(|test| test == name));
            let culprit = last.unwrap_or(&self.tests[count]);
            for test in &self.tests[count..] {
                let output = match test == culprit {
                    true => format!("{cause}\n{}", emulator.said()),
                    false => format!("no result: see {}", self.name_of(culprit)),
                };
                report.lock().expect("no VM panics").test(self, test, Outcome::Failed, &output);
            }
        }
        Ok(())
    }

    /// Reports the guest's results from the folder, and returns their number.
    fn report_results(
        &self,
        share: &Path,
        lines: Option<&CacheLines>,
        report: &Mutex<&mut Report>,
    ) -> Result<usize, String> {
        let results = fs::read_to_string(share.join("results")).unwrap_or_default();
        let mut reported = 0;
        // A line without an end was still being written.
        for line in results.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n')) {
            let (test, status) = line.split_once(' ').unwrap_or((line, ""));
            if self.tests.get(reported).is_none_or(|planned| planned != test) {
                return Err(format!("the guest reported {line:?}, which was not its next test"));
            }
            let output = fs::read(share.join("output").join(test)).unwrap_or_default();
            let mut output = String::from_utf8_lossy(&output).into_owned();
            // libtest reports success for a name that the program does not know.
            let mut passed = status == "0" && output.contains("test result: ok. 1 passed;");
            if let Some(lines) = lines {
                match lines.figures() {
                    Ok(figures) => output += &figures,
                    Err(cause) => {
                        output += &cause;
                        passed = false;
                    }
                }
            }
            let outcome = if passed { Outcome::Passed } else { Outcome::Failed };
            report.lock().expect("no VM panics").test(self, test, outcome, &output);
            reported += 1;
        }
        Ok(reported)
    }
}

/// Copies the counters of the guest's programs to those of this program, if it has some (`scripts/coverage`).
fn keep_profiles(share: &Path) -> Result<(), String> {
    let file = env::var_os("LLVM_PROFILE_FILE");
    let (Some(kept), Ok(outputs)) =
        (file.as_deref().map(Path::new).and_then(Path::parent), share.join("output").read_dir())
    else {
        return Ok(());
    };
    let run = share.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy();
    for path in outputs.flatten().map(|entry| entry.path()).filter(|path| path.extension() == Some("profraw".as_ref()))
    {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        fs::copy(&path, kept.join(format!("vm-{run}-{name}")))
            .map_err(|error| format!("cannot keep {}: {error}", path.display()))?;
    }
    Ok(())
}

/// Waits until the VM has ended. Returns how it ended, for the tests without a result. The silence is processor time of
/// the emulator: a busy computer stops it, and the guest.
fn follow(emulator: &mut Emulator, silence_max: Duration) -> Result<String, String> {
    let mut said = 0;
    let mut heard = (Instant::now(), emulator.processor_time()?);
    loop {
        if let Some(status) = emulator.ended()? {
            return Ok(match status.code() {
                Some(EXIT_PLAN_DONE) => "the guest ended and left no result".into(),
                _ => format!("the VM died: {status}"),
            });
        }
        // The console shows each test's name when it starts.
        let length = emulator.console().len();
        if length != said {
            (said, heard) = (length, (Instant::now(), emulator.processor_time()?));
        }
        let (since, spent) = heard;
        let silence = emulator.processor_time()?.saturating_sub(spent);
        if silence > silence_max || since.elapsed() > STALL_MAX + silence_max {
            return Ok(format!(
                "no result for {} s, with {} s of processor time: stopped",
                since.elapsed().as_secs(),
                silence.as_secs()
            ));
        }
        thread::sleep(POLL_INTERVAL);
    }
}

/// The VM for a snapshot.
pub fn booting(kernel: &Kernel, base: &[u8], folder: &Path) -> Result<Command, String> {
    let mut vm = vm(folder)?;
    vm.args(TIME);
    // Every run must start, and continue, with the same numbers.
    boot(&mut vm, kernel, base, folder, "nokaslr norandmaps random.trust_cpu=on")?;
    Ok(vm)
}

/// A shell in the guest, on this terminal.
pub fn shell(kernel: &Kernel, base: &[u8], programs: &Programs, cache: &Cache) -> Result<(), String> {
    let folder = cache.run_folder()?;
    let folder = folder.path();
    let mut vm = vm(folder)?;
    programs.put_into(folder)?;
    eprintln!("/tests/share in the guest is {}", folder.join("share").display());
    boot(&mut vm, kernel, base, folder, "GUEST_SHELL=1")?;
    vm.args(["-smp", "2", "-serial", "mon:stdio"]);
    vm.status().map(drop).map_err(|error| format!("cannot start the emulator: {error}"))
}

/// The common VM of all runs. It does not use KVM, even if there is one: the suite must be the same everywhere.
fn vm(folder: &Path) -> Result<Command, String> {
    let share = folder.join("share");
    fs::create_dir(&share).map_err(|error| format!("cannot create {}: {error}", share.display()))?;
    let mut vm = Command::new(EMULATOR);
    vm.args(["-accel", "tcg", "-cpu", PROCESSOR, "-m", "512", "-nodefaults", "-display", "none", "-no-reboot"])
        .args(["-device", "isa-debug-exit,iobase=0xf4,iosize=0x04", "-device", "pvpanic", "-action", "panic=pause"])
        .arg("-virtfs")
        .arg(format!("local,path={},mount_tag=tests,security_model=none", share.display()))
        .args(programs::device(folder)?);
    Ok(vm)
}

fn boot(vm: &mut Command, kernel: &Kernel, base: &[u8], folder: &Path, parameters: &str) -> Result<(), String> {
    let initramfs = folder.join("initramfs");
    let mut archives =
        fs::read(&kernel.initramfs).map_err(|error| format!("cannot read {}: {error}", kernel.initramfs.display()))?;
    archives.extend_from_slice(base);
    fs::write(&initramfs, archives).map_err(|error| format!("cannot write {}: {error}", initramfs.display()))?;
    vm.arg("-kernel")
        .arg(&kernel.vmlinux)
        .arg("-initrd")
        .arg(&initramfs)
        .arg("-append")
        .arg(format!("{COMMAND_LINE} {parameters}"));
    Ok(())
}
