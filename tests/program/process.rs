// SPDX-License-Identifier: GPL-3.0-or-later
//! The program as a separate process, with a pty and a log.

use std::fs::{self, File};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};
use std::{mem, thread};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::Client;
use pinion_client::serial::Port;
use pinion_testkit::process::{Running, run_first};
pub use pinion_testkit::wait::WAIT_MAX;
use pinion_testkit::{simulator, wait};
use tempfile::TempDir;

/// A running `pinion`.
pub struct Pinion {
    child: Running,
    folder: TempDir,
}

impl Pinion {
    /// `pinion run` on the simulated printer.
    pub fn simulated(args: &[&str]) -> Pinion {
        let pinion = Pinion::start(&[&["run", "--board", "sim"], args].concat());
        pinion.wait_for_link();
        pinion
    }

    /// The same, in a prepared folder.
    pub fn simulated_in(folder: TempDir) -> Pinion {
        let pinion = Pinion::start_in(folder, &["run", "--board", "sim"]);
        pinion.logged("serving on");
        pinion
    }

    /// `pinion` with these arguments, and `-I` with its own path.
    pub fn start(args: &[&str]) -> Pinion {
        let folder = tempfile::tempdir().unwrap();
        Pinion::start_in(folder, args)
    }

    /// The same, in a prepared folder.
    pub fn start_in(folder: TempDir, args: &[&str]) -> Pinion {
        let out = File::create(folder.path().join("out")).unwrap();
        let log = File::create(folder.path().join("log")).unwrap();
        Pinion::start_to(folder, args, out, log)
    }

    /// The same, with the test's own stdout and stderr.
    pub fn start_to(folder: TempDir, args: &[&str], out: impl Into<Stdio>, log: impl Into<Stdio>) -> Pinion {
        let child = program()
            .args(args)
            .arg("-I")
            .arg(folder.path().join("tty"))
            .env_remove("JOURNAL_STREAM")
            .env("STATE_DIRECTORY", folder.path().join("state"))
            .stdout(out)
            .stderr(log)
            .spawn()
            .unwrap();
        Pinion { child: Running(child), folder }
    }

    /// `pinion run` on the simulated printer, as an ordinary user. The service is one, and root may do more.
    pub fn start_as_nobody(args: &[&str]) -> Pinion {
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o1777)).unwrap();
        let log = File::create(folder.path().join("log")).unwrap();
        let mut command = Command::new(program_in(folder.path()));
        command.args(["run", "--board", "sim"]).args(args).arg("-I").arg(folder.path().join("tty"));
        let child = as_nobody(&mut command).env_remove("JOURNAL_STREAM").stderr(log).spawn().unwrap();
        let pinion = Pinion { child: Running(child), folder };
        pinion.logged("serving on");
        pinion
    }

    /// `pinion` with its own view of the file system. A shell prepares it, in the program's folder. Needs root.
    pub fn start_mounted(folder: TempDir, prepare: &str, args: &[&str]) -> Pinion {
        let log = File::create(folder.path().join("log")).unwrap();
        let script = format!("cd \"$1\"; {prepare}; shift; exec \"$@\"");
        let child = Command::new("unshare")
            .args(["--mount", "sh", "-ec", &script, "sh"])
            .arg(folder.path())
            .arg(pinion_path())
            .args(args)
            .env_remove("JOURNAL_STREAM")
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        Pinion { child: Running(child), folder }
    }

    /// Runs another `pinion` at the same link to its end. Returns its status and its log. `as_nobody` runs it as that
    /// user.
    pub fn beside(&self, args: &[&str], as_nobody: bool) -> (Option<i32>, String) {
        let folder = tempfile::tempdir().unwrap();
        let program = program_in(folder.path());
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let log = folder.path().join("log");
        let mut command = Command::new(&program);
        command.args(args).arg("-I").arg(self.link()).stdout(Stdio::null()).stderr(File::create(&log).unwrap());
        if as_nobody {
            command.uid(65534).gid(65534);
        }
        let child = command.env_remove("JOURNAL_STREAM").spawn().unwrap();
        let status = Pinion { child: Running(child), folder: tempfile::tempdir().unwrap() }.end();
        (status.code(), fs::read_to_string(log).unwrap())
    }

    /// The remains of a program that has ended: its folder, and its link there.
    pub fn into_folder(mut self) -> (TempDir, PathBuf) {
        let link = self.link();
        (mem::replace(&mut self.folder, tempfile::tempdir().unwrap()), link)
    }

    /// Its folder.
    pub fn folder(&self) -> &TempDir {
        &self.folder
    }

    pub fn link(&self) -> PathBuf {
        self.folder.path().join("tty")
    }

    pub fn log(&self) -> String {
        // There is no log file if the test has stderr.
        fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    pub fn out(&self) -> String {
        fs::read_to_string(self.folder.path().join("out")).unwrap()
    }

    /// Where it keeps its traces.
    pub fn state(&self) -> PathBuf {
        self.folder.path().join("state")
    }

    pub fn pid(&self) -> u32 {
        self.child.0.id()
    }

    /// The scheduling policy and the nice value of each of its threads with this name (proc_pid_stat(5), fields 41 and
    /// 19).
    pub fn scheduling(&self, thread: &str) -> Vec<(i64, i64)> {
        let folders = fs::read_dir(format!("/proc/{}/task", self.pid())).unwrap().map(|entry| entry.unwrap().path());
        let scheduling = |folder: PathBuf| {
            let name = fs::read_to_string(folder.join("comm")).ok()?;
            // The third field comes after the name, which is in parentheses.
            let stat = fs::read_to_string(folder.join("stat")).ok()?;
            let fields: Vec<&str> = stat.rsplit_once(") ")?.1.split_whitespace().collect();
            let field = |number: usize| fields[number - 3].parse().ok();
            (name.trim() == thread).then_some((field(41)?, field(19)?))
        };
        folders.filter_map(scheduling).collect()
    }

    pub fn wait_for_link(&self) {
        self.until("the link", || fs::read_link(self.link()).is_ok());
    }

    /// Waits until the log has a line with this text, and returns the last of these lines.
    #[track_caller]
    pub fn logged(&self, text: &str) -> String {
        let line = || self.log().lines().rfind(|line| line.contains(text)).map(str::to_owned);
        self.until_some(&format!("a log line with \"{text}\""), line)
    }

    #[track_caller]
    pub fn until(&self, what: &str, done: impl Fn() -> bool) {
        self.until_some(what, || done().then_some(()));
    }

    #[track_caller]
    fn until_some<T>(&self, what: &str, result: impl FnMut() -> Option<T>) -> T {
        wait::until_some(result, || format!("{what}; the log:\n{}", self.log()))
    }

    pub fn client(&self) -> Client {
        Client::connect(&self.link(), WAIT_MAX).unwrap()
    }

    /// A client that has configured the MCU: see [`configure`].
    pub fn configured(&self, lines: &[&str]) -> Client {
        let mut client = self.client();
        configure(&mut client, lines);
        client
    }

    pub fn port(&self) -> Port {
        Port::open(&self.link()).unwrap()
    }

    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.pid() as i32), signal).unwrap();
    }

    /// Waits for the program's end.
    pub fn end(&mut self) -> ExitStatus {
        let Pinion { child, folder } = self;
        let log = folder.path().join("log");
        wait::until_some(
            || child.0.try_wait().unwrap(),
            || format!("the program's end; the log:\n{}", fs::read_to_string(log).unwrap_or_default()),
        )
    }

    /// Memory of the process in KiB, by its name in `/proc/PID/status`. `RssAnon` is its own memory, without files. It
    /// counts pages shared with a forked process. Their number does not grow when that process writes to its copies or
    /// ends.
    pub fn memory_kib(&self, name: &str) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.pid())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':')).unwrap();
        line.split_whitespace().next().unwrap().parse().unwrap()
    }
}

impl Drop for Pinion {
    fn drop(&mut self) {
        if thread::panicking() {
            wait::failed_with(&self.log());
        }
    }
}

/// How long the program keeps the terminal at its end, for a host that still reads.
const FAREWELL: Duration = Duration::from_secs(1);

/// Repeats a part in [`wait::in_time`] in which a host did not read what a program said that ends since then: it was late.
pub fn late_for_the_farewell(since: Instant) {
    if since.elapsed() >= FAREWELL {
        wait::was_late("the terminal is closed");
    }
}

/// The last reason that a host reads from a program that ends since then.
pub fn last_reason(client: &mut Client, since: Instant) -> Option<String> {
    client.wait_shutdown(WAIT_MAX).unwrap_or_else(|error| {
        late_for_the_farewell(since);
        panic!("{error}")
    })
}

/// Configures an MCU with these objects.
pub fn configure(client: &mut Client, lines: &[&str]) {
    client.send_line("allocate_oids count=8").unwrap();
    lines.iter().for_each(|line| client.send_line(line).unwrap());
    client.send_line("finalize_config crc=1").unwrap();
    assert!(client.status().unwrap().is_config);
}

/// The program, with each signal at its default: `nohup make test &` would have it ignore some.
pub fn program() -> Command {
    let mut program = Command::new("env");
    program.arg("--default-signal").arg(pinion_path());
    program
}

/// The path of `pinion`, with `pinion-sim` beside it. The caller will start it.
pub fn pinion_path() -> &'static Path {
    run_first();
    let pinion = Path::new(env!("CARGO_BIN_EXE_pinion"));
    simulator::beside(pinion);
    pinion
}

/// The same command as an ordinary user.
pub fn as_nobody(command: &mut Command) -> &mut Command {
    if nix::unistd::geteuid().is_root() {
        command.uid(65534).gid(65534);
    }
    command
}

/// The program, where every user may run it: cargo's, or a copy in this folder. Another process copies it: a test that
/// starts a program at that moment would inherit our file, and the kernel runs no file that is open for writing.
pub fn program_in(folder: &Path) -> PathBuf {
    let pinion = pinion_path();
    let may_enter = |folder: &Path| fs::metadata(folder).is_ok_and(|about| about.permissions().mode() & 0o1 != 0);
    if pinion.ancestors().all(may_enter) {
        return pinion.to_owned();
    }
    assert!(Command::new("cp").args([pinion, simulator::beside(pinion), folder]).status().unwrap().success());
    let library = pinion.with_file_name("deps/libpinion_clock.so");
    assert!(
        Command::new("install").args(["-D", "-t"]).arg(folder.join("deps")).arg(library).status().unwrap().success()
    );
    folder.join("pinion")
}

/// A folder with a file in it.
pub fn folder_with(name: &str, text: &str) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, text).unwrap();
    (folder, path)
}

/// A stdout that its reader has closed, as `head` does.
pub fn closed_pipe() -> std::io::PipeWriter {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer
}

/// The status of a program that has ended, and all that it printed and logged.
pub fn texts(output: &std::process::Output) -> (Option<i32>, String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// The output of `pinion`.
pub fn printed(args: &[&str]) -> String {
    String::from_utf8(output(args).stdout).unwrap()
}

/// Runs `pinion` to its end.
pub fn output(args: &[&str]) -> std::process::Output {
    // A klippy of the user who runs the tests would judge each printer.cfg.
    Command::new(pinion_path()).args(args).env_remove("KLIPPER_DIR").output().unwrap()
}

/// The same with at most 3 GB of memory, and not forever. Returns its status and all that it printed.
pub fn limited(args: &[&str]) -> (Option<i32>, String) {
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -v 3000000; exec timeout 100 \"$0\" \"$@\""]).arg(pinion_path());
    let output = limited.args(args).output().unwrap();
    (output.status.code(), String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned())
}

pub fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}
