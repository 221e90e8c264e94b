// SPDX-License-Identifier: GPL-3.0-or-later
//! What is about real time: a klippy on the program `pinion`, over a link. The tests use klippy's API socket.

mod add;
mod links;
mod mainsail;
mod non_critical;
mod program;
mod shown;
mod ssh;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill, raise};
use nix::unistd::Pid;
use pinion_host::{Host, Launch, NoStart, Refused, Running, Time};
use pinion_linux::clock::Monotonic;
use pinion_model::{SimBoard, SimConfig, SimProbe, SimWorld};
use pinion_runtime::wakeup::MarginLimits;
use pinion_runtime::{Access, Helpers, LinkName, Options, Recording};
use pinion_testkit::process::run_first;
use serde_json::Value;
use tempfile::TempDir;

use crate::klippy::{pinion_path, python};

/// Timeout for an answer of the host. Heating takes real time, and a computer under load takes more.
const HOST_TIMEOUT: Duration = Duration::from_secs(180);
/// Timeout for klippy's start, which takes seconds.
const START: Duration = Duration::from_secs(40);

/// The MCU that serves klippy.
enum Server {
    /// The program.
    Program(Child),
    /// This process, which can read its simulated printer.
    Here { running: Vec<JoinHandle<()>>, probe: SimProbe, _alone: MutexGuard<'static, ()> },
}

/// This process serves one printer at a time: the signal that ends one printer would end all.
static HERE: Mutex<()> = Mutex::new(());

pub struct Printer {
    checkout: PathBuf,
    folder: TempDir,
    server: Server,
    host: Option<Host<()>>,
}

impl Printer {
    /// A printer with a ready klippy.
    pub fn start(checkout: &Path) -> Printer {
        let mut printer = Printer::start_with(checkout, |config| config);
        printer.until_state("ready");
        printer
    }

    /// A printer with a changed configuration.
    pub fn start_with(checkout: &Path, change: impl FnOnce(String) -> String) -> Printer {
        Printer::start_on(checkout, |board, _| board, change)
    }

    /// The same with another description. `describe` also gets the path of a file for its use.
    pub fn start_on(
        checkout: &Path,
        describe: impl FnOnce(String, &Path) -> String,
        change: impl FnOnce(String) -> String,
    ) -> Printer {
        Printer::serve(checkout, describe, change, |folder| {
            let pinion = Command::new(pinion_path())
                .args(["run", "-r", "--board"])
                .arg(format!("sim:{}", folder.join("board.toml").display()))
                .arg("-I")
                .arg(folder.join("tty"))
                .stderr(File::create(folder.join("pinion.log")).unwrap())
                .spawn();
            Server::Program(pinion.unwrap())
        })
    }

    /// The built-in printer with `pinion sim --show`.
    pub fn start_shown(checkout: &Path) -> Printer {
        Printer::serve(
            checkout,
            |board, _| board,
            |config| config,
            |folder| {
                let pinion = Command::new(pinion_path())
                    .args(["sim", "-r", "--show"])
                    .arg(folder.join("board.toml"))
                    .arg("-I")
                    .arg(folder.join("tty"))
                    .stdout(File::create(folder.join("shown")).unwrap())
                    .stderr(File::create(folder.join("pinion.log")).unwrap())
                    .spawn();
                Server::Program(pinion.unwrap())
            },
        )
    }

    /// A printer that this process simulates, so tests can read its state. Its log goes to stderr with RUST_LOG=info. `link` puts the terminal at klippy's end of it where the pty would be.
    pub fn start_here_on(
        checkout: &Path,
        describe: impl FnOnce(String, &Path) -> String,
        change: impl FnOnce(String) -> String,
        link: impl FnOnce(&Path) -> LinkName,
    ) -> Printer {
        // Another test may have started the logger.
        let _ = env_logger::try_init();
        // A failed test poisons the lock.
        let alone = HERE.lock().unwrap_or_else(PoisonError::into_inner);
        let mut printer = Printer::serve(checkout, describe, change, |folder| {
            let clock = Monotonic::start();
            let config =
                SimConfig::parse(&fs::read_to_string(folder.join("board.toml")).unwrap(), "board.toml").unwrap();
            let SimWorld { boards, probe } = SimWorld::new(config, Arc::new(clock)).unwrap();
            let options = Options {
                link: link(folder),
                access: Access { mode: 0o660, group: None },
                realtime: true,
                cpu: None,
                margin: MarginLimits::default(),
                watchdog: None,
                tolerances: Vec::new(),
                trace_edges: false,
                sockets: Vec::new(),
                dialect: None,
            };
            let serve = |(place, board): (usize, SimBoard)| {
                // The first board has the link of the test.
                let path = match place {
                    0 => folder.join("tty"),
                    _ => folder.join(format!("tty_{}", board.name())),
                };
                let recording = Recording::new(clock, &path, true, Vec::new()).unwrap();
                let link = if place == 0 { options.link.clone() } else { LinkName::Pty(path) };
                let options = Options { link, ..options.clone() };
                thread::spawn(move || {
                    let timing = board.timing();
                    pinion_runtime::run(&options, Box::new(board), timing, recording, Helpers::default(), None)
                        .unwrap();
                })
            };
            let running = boards.into_iter().enumerate().map(serve).collect();
            Server::Here { running, probe, _alone: alone }
        });
        printer.until_state("ready");
        printer
    }

    fn serve(
        checkout: &Path,
        describe: impl FnOnce(String, &Path) -> String,
        change: impl FnOnce(String) -> String,
        serve: impl FnOnce(&Path) -> Server,
    ) -> Printer {
        // klippy recognizes a pseudo terminal by the start of its path.
        let folder = tempfile::Builder::new().prefix("klipper_host_").tempdir_in("/tmp").unwrap();
        let printed = Command::new(pinion_path()).args(["sim", "--print-board"]).output().unwrap();
        let board = describe(String::from_utf8(printed.stdout).unwrap(), &folder.path().join("trace"));
        fs::write(folder.path().join("board.toml"), board).unwrap();
        fs::write(folder.path().join("pinion.log"), "").unwrap();
        let server = serve(folder.path());
        let mut printer = Printer { checkout: checkout.into(), folder, server, host: None };
        printer.until("the pty", |printer| fs::read_link(printer.path("tty")).is_ok());
        printer.configure(change);
        printer.start_host();
        printer
    }

    /// The simulated printer of [`Printer::start_here`].
    pub fn probe(&self) -> &SimProbe {
        match &self.server {
            Server::Here { probe, .. } => probe,
            Server::Program(_) => panic!("the printer is another process'"),
        }
    }

    /// A path in the printer's folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes the changed configuration of the printer.
    pub fn configure(&mut self, change: impl FnOnce(String) -> String) {
        let printed = Command::new(pinion_path())
            .arg("sim")
            .arg(self.path("board.toml"))
            .args(["--print-config", "-I"])
            .arg(self.path("tty"))
            .output()
            .unwrap();
        let config = change(String::from_utf8(printed.stdout).unwrap());
        fs::write(self.path("printer.cfg"), config).unwrap();
    }

    #[track_caller]
    pub fn start_host(&mut self) {
        // While it homes, klippy is a tenth of a second ahead of the MCU.
        run_first();
        let python = python();
        let launch = Launch {
            klipper: &self.checkout,
            python: Path::new(&python),
            folder: self.folder.path(),
            printer_cfg: &self.path("printer.cfg"),
            command: Command::new("env"),
            running: Running::default(),
        };
        match Host::start(launch, Time::Real(Instant::now(), Arc::default()), ()) {
            Ok(host) => self.host = Some(host),
            Err(NoStart::Alone) => unreachable!("it has the computer's time"),
            Err(NoStart::Trouble(trouble)) => panic!("{trouble}"),
        }
    }

    /// kill -9.
    pub fn kill_host(&mut self) {
        let host = self.host.take().unwrap();
        kill(Pid::from_raw(host.pid().cast_signed()), Signal::SIGKILL).unwrap();
    }

    /// The running klippy.
    fn host(&mut self) -> &mut Host<()> {
        self.host.as_mut().unwrap()
    }

    /// Runs G-code to its end.
    #[track_caller]
    pub fn gcode(&mut self, script: &str) {
        if let Err(error) = self.try_gcode(script) {
            panic!("{script}: {error}\n{}\n{}", self.why(), self.log());
        }
    }

    /// Runs G-code to its end. Returns its answer, or klippy's reason for a refusal.
    pub fn try_gcode(&mut self, script: &str) -> Result<String, String> {
        let ran = self.host().gcode(script, HOST_TIMEOUT);
        ran.map(|()| self.host().said.join("\n")).map_err(|refused| refused.to_string())
    }

    /// Runs G-code that stops the printer.
    pub fn stop(&mut self, script: &str) {
        // klippy may or may not answer, because it is stopped.
        let _ = self.try_gcode(script);
        self.until_state("shutdown");
    }

    /// Runs FIRMWARE_RESTART or RESTART and waits until klippy is ready again.
    #[track_caller]
    pub fn restart(&mut self, command: &str) {
        self.host().restart(command);
        self.until_state("ready");
    }

    pub fn state(&mut self) -> String {
        match self.host().state() {
            Ok((state, _)) => state,
            // A klippy that finds its MCU shut down restarts both.
            Err(Refused::Gone(_)) if self.host().reconnect() => "startup".into(),
            Err(refused) => panic!("klippy does not answer: {refused}\n{}", self.log()),
        }
    }

    /// The final state of klippy's start.
    pub fn settled(&mut self) -> String {
        let end = Instant::now() + START;
        loop {
            let state = self.state();
            if state != "startup" || Instant::now() > end {
                return state;
            }
            thread::sleep(Duration::from_millis(100));
        }
    }

    /// klippy's message about its state.
    fn why(&mut self) -> String {
        self.host().state().map_or_else(|refused| refused.to_string(), |(_, words)| words)
    }

    #[track_caller]
    pub fn until_state(&mut self, wanted: &str) {
        let end = Instant::now() + START;
        loop {
            let state = self.state();
            if state == wanted {
                return;
            }
            assert!(Instant::now() < end, "klippy is in {state}, not in {wanted}: {}\n{}", self.why(), self.log());
            thread::sleep(Duration::from_millis(100));
        }
    }

    /// The status of one of klippy's objects.
    pub fn object(&mut self, name: &str) -> Value {
        self.host().query(&[name]).unwrap()[name].take()
    }

    /// Waits until a heater is warm.
    pub fn until_heating(&mut self, heater: &str) {
        let end = Instant::now() + HOST_TIMEOUT;
        while self.object(heater)["temperature"].as_f64().is_none_or(|celsius| celsius < 30.0) {
            assert!(Instant::now() < end, "{heater} stays cold\n{}", self.log());
            thread::sleep(Duration::from_millis(100));
        }
    }

    /// Pinion's log.
    pub fn log(&self) -> String {
        fs::read_to_string(self.path("pinion.log")).unwrap()
    }

    /// Waits until one of klippy's objects has this value for a key.
    #[track_caller]
    pub fn until_object(&mut self, name: &str, key: &str, wanted: impl Into<Value>) {
        let wanted = wanted.into();
        let end = Instant::now() + HOST_TIMEOUT;
        loop {
            let object = self.object(name);
            if object[key] == wanted {
                return;
            }
            let stopped = self.state() == "shutdown";
            assert!(!stopped && Instant::now() < end, "{name} stays {object}: {}\n{}", self.why(), self.log());
            thread::sleep(Duration::from_millis(100));
        }
    }

    /// klippy's log, once it contains this text `times` times. Use it for text that is in no command's answer: a thread
    /// of klippy writes the log.
    #[track_caller]
    pub fn host_log(&mut self, text: &str, times: usize) -> String {
        let log = |printer: &Printer| fs::read_to_string(printer.path("klippy.log")).unwrap();
        self.until(text, |printer| log(printer).matches(text).count() >= times);
        log(self)
    }

    /// Everything that `--show` has shown.
    pub fn all_shown(&self) -> String {
        fs::read_to_string(self.path("shown")).unwrap()
    }

    /// The last output of `--show` for a part: the rest of its line, or the lines below it.
    pub fn shown(&self, name: &str) -> String {
        let shown = self.all_shown();
        // An incomplete block is ignored.
        let whole = shown.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let head = format!("] {name}:");
        let Some((_, last)) = whole.rsplit_once(&head) else { return String::new() };
        let last = last.split("\n[").next().unwrap_or_default();
        last.trim_start_matches([' ', '\n']).to_owned()
    }

    #[track_caller]
    pub fn until_logged(&mut self, text: &str) {
        self.until(text, |printer| printer.log().contains(text));
    }

    #[track_caller]
    fn until(&mut self, what: &str, done: impl Fn(&Printer) -> bool) {
        let end = Instant::now() + HOST_TIMEOUT;
        while !done(self) {
            assert!(Instant::now() < end, "waited in vain for {what}\n{}", self.log());
            thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Printer {
    fn drop(&mut self) {
        self.host = None;
        match &mut self.server {
            Server::Program(pinion) => {
                let _ = pinion.kill();
                let _ = pinion.wait();
            }
            // It handles the signal. The signal ends the printer and not this process.
            Server::Here { running, .. } => {
                let _ = raise(Signal::SIGTERM);
                running.drain(..).for_each(|board| drop(board.join()));
            }
        }
    }
}
