// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion run`, or another MCU program, as a child of the test, and the host's messages to it.

use std::env;
use std::fs::{self, DirEntry, File};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::signal::{Signal, kill};
use nix::time::{clock_getcpuclockid, clock_gettime};
use nix::unistd::Pid;
use pinion_client::config::Config;
use pinion_client::{Client, Error};

use super::mock::adc::Adcs;
use super::{sysfs, uapi};

/// Timeout of a test: far longer than any operation takes.
const WAIT_MAX: Duration = Duration::from_secs(10);

/// The running program. It is killed when dropped. If the test fails, its log is shown.
pub struct Program {
    child: Child,
    link: PathBuf,
    log: PathBuf,
    _adcs: Option<Adcs>,
}

impl Program {
    /// Starts it in real time, as a printer's service does.
    pub fn start() -> Program {
        Program::with(&["-r"], &[])
    }

    /// Starts it with these arguments to `pinion run` and this environment. Returns when a host may connect.
    pub fn with(args: &[&str], environment: &[(&str, &str)]) -> Program {
        let mut command = Command::new("pinion");
        command.args(["run", "-g", "0"]).args(args).envs(environment.iter().copied());
        Program::spawn(command).ready()
    }

    /// Starts it with another link than a pty.
    pub fn on_link(link: &str) -> Program {
        let mut command = Command::new("pinion");
        command.args(["run", "-r", "--link", link]);
        Program::spawn(command)
    }

    /// Starts it with a host on its standard input and output.
    pub fn on_stdio(host: UnixStream) -> Program {
        let mut command = Command::new("pinion");
        let input = OwnedFd::from(host.try_clone().expect("a socket"));
        command.args(["run", "-r", "--link", "stdio"]).stdin(input).stdout(OwnedFd::from(host));
        Program::spawn(command)
    }

    /// Starts it as on a kernel that answers an ioctl with this error.
    pub fn without_ioctl(request: u32, errno: Errno) -> Program {
        let mut command = Command::new("pinion");
        command.args(["run", "-g", "0", "-r"]);
        uapi::without_ioctl(&mut command, request, errno as i32);
        Program::spawn(command).ready()
    }

    /// The measured program, in real time: Pinion, or the program from the computer's `--program`, which takes the
    /// options of Klipper's program.
    pub fn measured() -> Program {
        Program::measured_with(&["-r"])
    }

    /// The same without `-r`.
    pub fn measured_in_ordinary_time() -> Program {
        Program::measured_with(&[])
    }

    fn measured_with(args: &[&str]) -> Program {
        // A printer's computer has some.
        let adcs = Adcs::new();
        let mut program = match other() {
            Some(words) => {
                let mut words = words.split_whitespace();
                let mut command = Command::new(words.next().expect("a program"));
                command.args(words).args(args);
                Program::spawn(command).ready()
            }
            None => Program::with(args, &[]),
        };
        program._adcs = Some(adcs);
        program
    }

    fn spawn(mut command: Command) -> Program {
        sysfs::assert_in_guest();
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let instance = format!("{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let link = PathBuf::from(format!("/tmp/pinion-{instance}"));
        let log = link.with_extension("log");
        let child = command
            .arg("-I")
            .arg(&link)
            .stderr(File::create(&log).expect("a log"))
            .spawn()
            .unwrap_or_else(|error| panic!("{command:?}: {error}"));
        Program { child, link, log, _adcs: None }
    }

    /// Waits until a host may connect to its pty.
    fn ready(self) -> Program {
        sysfs::wait_until("the link to the pty stands", || self.link.exists());
        self
    }

    /// A host on its pty.
    pub fn connect(&self) -> Client {
        Client::connect(&self.link, WAIT_MAX).expect("a session")
    }

    pub fn link(&self) -> &Path {
        &self.link
    }

    pub fn pid(&self) -> Pid {
        Pid::from_raw(self.child.id().try_into().expect("a process id"))
    }

    /// The process that watches its outputs.
    pub fn guardian(&self) -> Pid {
        self.find_guardian().expect("a guardian")
    }

    fn find_guardian(&self) -> Option<Pid> {
        let name = |pid: &Pid| fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
        self.children().into_iter().find(|pid| name(pid) == "pinion-guardian\n")
    }

    /// The processes that it forked.
    fn children(&self) -> Vec<Pid> {
        let pid = self.pid();
        let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
        children.split_whitespace().filter_map(|pid| pid.parse().ok()).map(Pid::from_raw).collect()
    }

    /// The program and the processes that it forked.
    fn processes(&self) -> impl Iterator<Item = Pid> {
        [self.pid()].into_iter().chain(self.children())
    }

    /// All of its threads.
    pub fn threads(&self) -> Vec<Pid> {
        self.processes().flat_map(threads).collect()
    }

    /// The processor time of all its threads so far.
    pub fn cpu_time(&self) -> Duration {
        let of = |process| clock_getcpuclockid(process).and_then(clock_gettime).expect("a running program");
        self.processes().map(|process| Duration::from(of(process))).sum()
    }

    /// Its memory in RAM. Processes that share a page each count their part of the page.
    pub fn memory_kb(&self) -> u64 {
        let of = |process: Pid| {
            let text = sysfs::read(format!("/proc/{process}/smaps_rollup"));
            let share = text.lines().find_map(|line| line.strip_prefix("Pss:")?.trim().strip_suffix(" kB"));
            share.and_then(|number| number.trim().parse::<u64>().ok()).expect("a share of the memory")
        };
        self.processes().map(of).sum()
    }

    /// How often its threads have gone to sleep so far. Each time, another thread or an interrupt wakes them.
    pub fn sleeps(&self) -> u64 {
        let of = |thread: Pid| {
            let status = sysfs::read(format!("/proc/{thread}/status"));
            let sleeps = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
            sleeps.and_then(|number| number.trim().parse::<u64>().ok()).expect("a number of switches")
        };
        self.threads().into_iter().map(of).sum()
    }

    pub fn signal(&self, signal: Signal) {
        kill(self.pid(), signal).expect("a running program");
    }

    /// Its log so far.
    pub fn log(&self) -> String {
        fs::read_to_string(&self.log).expect("its log")
    }

    /// Waits until a line of the log contains all of these, and returns the line.
    pub fn wait_for_line(&self, parts: &[&str]) -> String {
        let find = || {
            let log = self.log();
            log.lines().find(|line| parts.iter().all(|part| line.contains(part))).map(str::to_owned)
        };
        sysfs::wait_until(&format!("the log says {parts:?}"), || find().is_some());
        find().expect("a line that was there")
    }

    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("our child").is_none()
    }

    /// Waits until it has ended.
    pub fn wait(&mut self) -> ExitStatus {
        let pid = self.pid();
        sysfs::wait_until("the program ends", || !exists(pid));
        self.child.wait().expect("our child")
    }

    /// Kills it with a signal that nothing can block.
    pub fn kill(&mut self) {
        self.signal(Signal::SIGKILL);
        assert_eq!(self.wait().signal(), Some(Signal::SIGKILL as i32));
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // It may have ended. Its guardian holds the lines a moment longer.
        let guardian = self.find_guardian();
        let _ = self.child.kill();
        let _ = self.child.wait();
        let until = Instant::now() + WAIT_MAX;
        while guardian.is_some_and(exists) && Instant::now() < until {
            thread::sleep(sysfs::POLL_INTERVAL);
        }
        if thread::panicking() {
            println!("--- log of the program\n{}---", fs::read_to_string(&self.log).unwrap_or_default());
        }
    }
}

/// The command of the program that is measured instead of Pinion: see `init.sh`.
pub fn other() -> Option<String> {
    env::var("MEASURED_PROGRAM").ok().filter(|command| !command.is_empty())
}

/// The threads of a running process.
pub fn threads(process: Pid) -> impl Iterator<Item = Pid> {
    let id = |thread: DirEntry| thread.file_name().to_str().and_then(|id| id.parse().ok()).expect("a thread's id");
    let all = fs::read_dir(format!("/proc/{process}/task")).expect("a running program");
    all.map(move |thread| Pid::from_raw(id(thread.expect("a readable folder"))))
}

/// Whether the process exists and has not ended.
pub fn exists(pid: Pid) -> bool {
    fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| !stat.contains(") Z "))
}

/// A configuration with this number of objects, as commands in klippy's notation.
pub fn config<L: AsRef<str>>(oids: u8, lines: &[L]) -> Config {
    let mut config = Config::default();
    for _ in 0..oids {
        config.oid().expect("few objects");
    }
    for line in lines {
        config.add(line.as_ref().to_owned());
    }
    config
}

/// Resets and configures the MCU.
pub fn configure<L: AsRef<str>>(client: &mut Client, oids: u8, lines: &[L]) {
    config(oids, lines).apply(client).expect("a configuration that it takes");
}

/// Configures the MCU, and returns the text of its shutdown.
pub fn refusal<L: AsRef<str>>(client: &mut Client, oids: u8, lines: &[L]) -> String {
    match config(oids, lines).apply(client) {
        Err(Error::Shutdown { reason }) => reason,
        Err(error) => panic!("{error}"),
        Ok(_) => panic!("it takes a configuration that it should not take"),
    }
}

/// Waits until the MCU stops by itself, and returns the text on the wire.
pub fn shutdown_of(client: &mut Client) -> String {
    client.wait_shutdown(WAIT_MAX).expect("a session").expect("a shutdown")
}

/// Sends a command and waits until it has run.
pub fn run(client: &mut Client, line: &str) {
    client.send_line(line).expect("a command of the dictionary");
    client.status().expect("a session");
}
