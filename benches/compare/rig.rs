// SPDX-License-Identifier: GPL-3.0-or-later
//! The place where the programs run: a mount namespace with a /dev of null devices. Behind these the stand-in
//! (standin.c) plays the drivers.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::str::FromStr;
use std::time::{Duration, Instant};

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};
use nix::sys::signal::{Signal, kill};
use nix::sys::stat::{Mode, SFlag, makedev, mknod};
use nix::unistd::{Pid, geteuid};
use pinion_client::Client;

/// A program to measure.
#[derive(Clone, Debug)]
pub struct Program {
    pub name: String,
    command: Vec<String>,
}

impl Program {
    /// This project's own, as cargo built it for the bench.
    pub fn own() -> Program {
        Program { name: "pinion".into(), command: vec![env!("CARGO_BIN_EXE_pinion").into(), "run".into()] }
    }
}

impl FromStr for Program {
    type Err = String;

    fn from_str(text: &str) -> Result<Program, String> {
        match text.split_once('=') {
            None if text == "pinion" => Ok(Program::own()),
            Some((name, command)) if !command.trim().is_empty() => {
                Ok(Program { name: name.into(), command: command.split_whitespace().map(str::to_owned).collect() })
            }
            _ => Err("NAME=COMMAND is wanted, such as c=/usr/local/bin/klipper_mcu".into()),
        }
    }
}

/// How to start a program.
#[derive(Clone, Copy, Debug, Default)]
pub struct Launch {
    pub realtime: bool,
    /// How many edges to record.
    pub edges_max: usize,
    /// How long an SPI transfer takes.
    pub bus_us: u32,
}

/// The place where programs run. It ends with this process.
pub struct Rig {
    dir: PathBuf,
    standin: PathBuf,
    floor: PathBuf,
    syscall: bool,
}

impl Rig {
    /// Builds the C files, and gives this process a /dev and /sys of its own.
    pub fn new(syscall: bool) -> Result<Rig, String> {
        if !geteuid().is_root() {
            return Err("root is needed, for a /dev of our own and for real time: sudo -E cargo bench ...".into());
        }
        let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("compare");
        fs::create_dir_all(&dir).map_err(|error| format!("{}: {error}", dir.display()))?;
        let standin = build(&dir, "standin", &["-shared", "-fPIC"])?;
        let floor = build(&dir, "floor", &[])?;
        separate(&dir)?;
        Ok(Rig { dir: dir.join("run"), standin, floor, syscall })
    }

    /// How late, in ns, a loop that only waits is here, for this many seconds.
    pub fn floor_ns(&self, seconds: f64) -> Result<Vec<i64>, String> {
        let failed = |why: String| format!("{}: {why}", self.floor.display());
        let output = Command::new(&self.floor)
            .arg((seconds as u32).to_string())
            .output()
            .map_err(|error| failed(error.to_string()))?;
        if !output.status.success() {
            return Err(failed(String::from_utf8_lossy(&output.stderr).into_owned()));
        }
        let mut late: Vec<i64> =
            String::from_utf8_lossy(&output.stdout).lines().filter_map(|line| line.parse().ok()).collect();
        late.sort_unstable();
        Ok(late)
    }

    /// Starts a program and waits until its terminal is there.
    pub fn start(&self, program: &Program, launch: &Launch) -> Result<Running, String> {
        let tty = self.dir.join("tty");
        let (edges, log) = (self.dir.join("edges"), self.dir.join("log"));
        for stale in [&tty, &edges] {
            let _ = fs::remove_file(stale);
        }
        let failed = |error: io::Error| format!("{}: {error}", program.command[0]);
        let out = File::create(&log).map_err(failed)?;
        let mut command = Command::new(&program.command[0]);
        command.args(&program.command[1..]);
        if launch.realtime {
            command.arg("-r");
        }
        command.arg("-I").arg(&tty);
        command.env("LD_PRELOAD", &self.standin);
        command.env("BENCH_BUS_US", launch.bus_us.to_string());
        if launch.edges_max > 0 {
            command.env("BENCH_EDGES", &edges).env("BENCH_EDGES_MAX", launch.edges_max.to_string());
        }
        if self.syscall {
            command.env("BENCH_SYSCALL", "1");
        }
        command.stdin(Stdio::null()).stdout(out.try_clone().map_err(failed)?).stderr(out);
        let child = command.spawn().map_err(failed)?;
        let mut running = Running { child, tty, edges, log };
        let until = Instant::now() + Duration::from_secs(5);
        while !running.tty.exists() {
            if running.child.try_wait().map_err(failed)?.is_some() || Instant::now() > until {
                return Err(format!("it did not start: {}", running.log()));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(running)
    }
}

/// A program at work. It is ended when this is dropped.
pub struct Running {
    child: Child,
    tty: PathBuf,
    edges: PathBuf,
    log: PathBuf,
}

impl Running {
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn tty(&self) -> &Path {
        &self.tty
    }

    /// Connects a host.
    pub fn client(&self) -> Result<Client, String> {
        Client::connect(&self.tty, Duration::from_secs(10)).map_err(|error| format!("{error}: {}", self.log()))
    }

    /// The edges so far: nanoseconds of CLOCK_MONOTONIC, line, level.
    pub fn edges(&self) -> Result<Vec<(u64, u8, bool)>, String> {
        let bytes = fs::read(&self.edges).map_err(|error| format!("{}: {error}", self.edges.display()))?;
        let words = bytes.chunks_exact(8).map(|word| u64::from_ne_bytes(word.try_into().unwrap_or_default()));
        let edges = words.take_while(|word| *word != 0);
        Ok(edges.map(|word| (word >> 8, (word >> 1 & 0x7f) as u8, word & 1 != 0)).collect())
    }

    fn log(&self) -> String {
        let log = fs::read_to_string(&self.log).unwrap_or_default();
        log.lines().last().unwrap_or("it left nothing in its log").to_owned()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let pid = Pid::from_raw(self.child.id() as i32);
        let _ = kill(pid, Signal::SIGTERM);
        let until = Instant::now() + Duration::from_secs(2);
        while matches!(self.child.try_wait(), Ok(None)) {
            if Instant::now() > until {
                let _ = self.child.kill();
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Compiles one of this bench's C files.
fn build(dir: &Path, name: &str, flags: &[&str]) -> Result<PathBuf, String> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/compare").join(name).with_extension("c");
    let binary = dir.join(name);
    let built = Command::new("cc")
        .args(["-O2", "-Wall", "-Wextra", "-Werror"])
        .args(flags)
        .arg("-o")
        .args([&binary, &source])
        .status()
        .map_err(|error| format!("cc: {error}; install a C compiler"))?;
    if built.success() { Ok(binary) } else { Err(format!("{} does not compile", source.display())) }
}

/// Enters a mount namespace whose /dev and /sys have the files that the programs look for.
fn separate(dir: &Path) -> Result<(), String> {
    let done = || -> io::Result<()> {
        unshare(CloneFlags::CLONE_NEWNS)?;
        // Mounts from here on stay in this namespace.
        let none = None::<&str>;
        mount(none, "/", none, MsFlags::MS_REC | MsFlags::MS_PRIVATE, none)?;
        let run = dir.join("run");
        fs::create_dir_all(&run)?;
        mount(Some("compare"), &run, Some("tmpfs"), MsFlags::empty(), none)?;
        let (dev, sys) = (run.join("dev"), run.join("sys"));
        for sub in ["pts", "shm"] {
            fs::create_dir_all(dev.join(sub))?;
            mount(Some(&Path::new("/dev").join(sub)), &dev.join(sub), none, MsFlags::MS_BIND, none)?;
        }
        let all = Mode::from_bits_truncate(0o666);
        let (null, ptmx, zero, urandom) = (makedev(1, 3), makedev(5, 2), makedev(1, 5), makedev(1, 9));
        let nodes = [("null", null), ("zero", zero), ("urandom", urandom), ("ptmx", ptmx)];
        for (name, device) in nodes.into_iter().chain([("gpiochip0", null), ("spidev0.0", null)]) {
            mknod(&dev.join(name), SFlag::S_IFCHR, all, device)?;
        }
        let chip = sys.join("gpio/devices/gpiochip0");
        fs::create_dir_all(&chip)?;
        fs::write(chip.join("dev"), "1:3\n")?;
        fs::create_dir_all(sys.join("iio/devices"))?;
        mount(Some(&dev), "/dev", none, MsFlags::MS_BIND | MsFlags::MS_REC, none)?;
        mount(Some(&sys), "/sys/bus", none, MsFlags::MS_BIND, none)?;
        Ok(())
    };
    done().map_err(|error| format!("a private /dev and /sys cannot be made: {error}"))
}
