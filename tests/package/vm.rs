// SPDX-License-Identifier: GPL-3.0-or-later
//! A Debian with systemd under QEMU. Its agent runs scripts.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use pinion_testkit::cache::{self, Cache};
use pinion_testkit::kernel::{Flavour, Kernel, Offers};
use pinion_testkit::{process, tools};

/// Longest duration of a script without a print, by the guest's clock.
const SCRIPT_MAX: Duration = Duration::from_secs(900);
/// How long a second of the guest's clock may take. The computer may be busy.
const SLOWNESS_MAX: u32 = 3;
/// After a script with this exit status the agent reboots the VM. The next script waits for the reboot.
const REBOOTS: i32 = 77;
/// The guest's time. While the guest works, an instruction takes 1 ns. While it sleeps, the time is the computer's. So
/// on a busy computer the VM is slow, but nothing in it is late. klippy and a watchdog would notice lateness.
const TIME: &str = "shift=0,sleep=on";
/// The same for a long print, whose steps a busy computer would wake for too late: the VM does not wait for time that it
/// sleeps. So half an hour takes minutes. (Time races while the VM waits for its disk. Other checks would notice.)
const TIME_OF_PRINT: &str = "shift=0,sleep=off";

/// Each process has a program at the same addresses. So the emulator translates it once, not for each process.
const COMMAND_LINE: &str = "console=ttyS0 quiet mitigations=off cryptomgr.notests lsm= audit=0 norandmaps panic=-1";

/// Programs with their Debian packages.
const TOOLS: [(&str, &str); 3] =
    [("mmdebstrap", "mmdebstrap"), ("dpkg-scanpackages", "dpkg-dev"), ("mke2fs", "e2fsprogs")];

/// The boot files of the VM.
pub struct Root {
    kernel: PathBuf,
    folder: PathBuf,
}

impl Root {
    /// Makes everything that the cache does not contain yet.
    pub fn prepare(cache: &Cache) -> Result<Root, String> {
        tools::ensure()?;
        tools::install(&TOOLS)?;
        let _lock = cache.lock()?;
        let offers = Offers::ask(cache)?;
        let kernel = Kernel::prepare(Flavour::Stock, &offers, cache)?;
        let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/package");
        let folder = cache::made(cache.root(), "system-", key(&kernel), |folder| {
            eprintln!("making a Debian 12 with Linux {}", kernel.release);
            fs::create_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
            let tree = kernel.folder().with_file_name("tree");
            process::run(
                Command::new("sh")
                    .arg(here.join("root.sh"))
                    .args([folder, &tree, &kernel.initramfs])
                    .arg(&kernel.release)
                    .arg(&here)
                    .arg(offers.sources()),
            )
        })?;
        Ok(Root { kernel: kernel.vmlinux, folder })
    }
}

/// Changes with everything that makes the root, except the versions of Debian's packages.
fn key(kernel: &Kernel) -> u64 {
    let mut hasher = DefaultHasher::new();
    kernel.vmlinux.hash(&mut hasher);
    for part in [
        include_str!("root.sh"),
        include_str!("guest/agent"),
        include_str!("guest/chips"),
        include_str!("guest/test-agent.service"),
        include_str!("guest/test-chips.service"),
    ] {
        part.hash(&mut hasher);
    }
    hasher.finish()
}

/// A running VM. It ends when this is dropped.
pub struct Vm {
    kernel: PathBuf,
    initrd: PathBuf,
    folder: PathBuf,
    share: PathBuf,
    qemu: Child,
    input: ChildStdin,
    lines: Receiver<String>,
    print: Option<Duration>,
    pub boot_took: Duration,
}

impl Vm {
    /// Boots a copy of the root in `folder`. The VM sees `share` as /share. `print`: how long a long print lasts.
    pub fn boot(root: &Root, folder: &Path, share: &Path, print: Option<Duration>) -> Result<Vm, String> {
        // Holes in the file stay holes.
        process::run(Command::new("cp").arg("--sparse=always").arg(root.folder.join("root.img")).arg(folder))?;
        let (kernel, initrd) = (root.kernel.clone(), root.folder.join("initrd"));
        let (qemu, input, lines) = start(&kernel, &initrd, folder, share, print.is_some())?;
        let (folder, share) = (folder.to_owned(), share.to_owned());
        let mut vm = Vm { kernel, initrd, folder, share, qemu, input, lines, print, boot_took: Duration::ZERO };
        vm.wait_until_up()?;
        Ok(vm)
    }

    fn wait_until_up(&mut self) -> Result<(), String> {
        let began = Instant::now();
        while self.line()? != "READY" {}
        self.boot_took = began.elapsed();
        Ok(())
    }

    /// Runs a script with bash in the VM, and returns its exit status and its output.
    pub fn run(&mut self, script: &str) -> Result<(i32, String), String> {
        let line = format!("{} {}\n", self.script_max().as_secs(), base64(script.as_bytes()));
        self.input.write_all(line.as_bytes()).map_err(|error| self.failed(&error.to_string()))?;
        let (output, status) = loop {
            if let Some(answer) = self.line()?.strip_prefix('=') {
                let (output, status) = answer.rsplit_once(' ').unwrap_or((answer, ""));
                let status: i32 = status.parse().map_err(|_| self.failed("the agent sent no status"))?;
                break (from_base64(output), status);
            }
        };
        if status != REBOOTS {
            return Ok((status, output));
        }
        let began = Instant::now();
        while self.qemu.try_wait().map_err(|error| error.to_string())?.is_none() {
            if began.elapsed() > self.silence_max() {
                return Err(self.failed("it does not shut down"));
            }
            thread::sleep(Duration::from_millis(100));
        }
        (self.qemu, self.input, self.lines) =
            start(&self.kernel, &self.initrd, &self.folder, &self.share, self.print.is_some())?;
        self.wait_until_up()?;
        Ok((0, output))
    }

    fn script_max(&self) -> Duration {
        SCRIPT_MAX + self.print.unwrap_or_default()
    }

    fn silence_max(&self) -> Duration {
        self.script_max() * SLOWNESS_MAX
    }

    fn line(&mut self) -> Result<String, String> {
        self.lines
            .recv_timeout(self.silence_max())
            .map_err(|error| self.failed(&format!("the agent is silent: {error}")))
    }

    fn failed(&self, cause: &str) -> String {
        let said = |name: &str| {
            let said = fs::read(self.folder.join(name)).unwrap_or_default();
            let tail = said.len().saturating_sub(4000);
            String::from_utf8_lossy(&said[tail..]).into_owned()
        };
        format!("{cause}\n--- console\n{}\n--- emulator\n{}", said("console"), said("qemu"))
    }
}

impl Drop for Vm {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

fn start(
    kernel: &Path,
    initrd: &Path,
    folder: &Path,
    share: &Path,
    prints: bool,
) -> Result<(Child, ChildStdin, Receiver<String>), String> {
    let file = |name: &str| folder.join(name).display().to_string();
    let mut qemu = Command::new("qemu-system-x86_64");
    qemu.args(["-accel", "tcg", "-cpu", "qemu64,+rdrand", "-m", "768"])
        .args(["-rtc", "clock=vm", "-icount", if prints { TIME_OF_PRINT } else { TIME }])
        .args(["-nodefaults", "-display", "none", "-no-reboot", "-kernel"])
        .arg(kernel)
        .arg("-initrd")
        .arg(initrd)
        .args(["-append", COMMAND_LINE])
        .args(["-drive", &format!("file={},if=virtio,format=raw,cache=unsafe", file("root.img"))])
        .args(["-virtfs", &format!("local,path={},mount_tag=share,security_model=none,readonly=on", share.display())])
        .args(["-device", "virtio-serial-pci", "-chardev", "stdio,id=agent,signal=off"])
        .args(["-device", "virtserialport,chardev=agent,name=agent"])
        .args(["-serial", &format!("file:{}", file("console"))]);
    let (child, input, output) = process::start_emulator(&mut qemu, folder)?;
    // Late, it would add the time that it waited for a processor to the guest's.
    process::put_main_thread_first(&child)?;
    let (heard, lines) = channel();
    thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            if heard.send(line).is_err() {
                return;
            }
        }
    });
    Ok((child, input, lines))
}

const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

/// RFC 4648.
fn base64(bytes: &[u8]) -> String {
    let mut text = String::new();
    for group in bytes.chunks(3) {
        let bits = group.iter().chain(&[0; 2]).take(3).fold(0u32, |bits, byte| bits << 8 | u32::from(*byte));
        for at in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * at) & 63) as usize];
            text.push(if at <= group.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

fn from_base64(text: &str) -> String {
    let mut bytes = Vec::new();
    let (mut bits, mut count) = (0u32, 0);
    for value in text.bytes().filter_map(|digit| DIGITS.iter().position(|known| *known == digit)) {
        bits = bits << 6 | value as u32;
        count += 6;
        if count >= 8 {
            count -= 8;
            bytes.push((bits >> count) as u8);
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}
