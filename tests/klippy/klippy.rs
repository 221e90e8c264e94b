// SPDX-License-Identifier: GPL-3.0-or-later
//! A simulated printer with a klippy. The tests use klippy's API socket.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, raise};
use nix::unistd::geteuid;
use pinion_linux::clock::Monotonic;
use pinion_model::{SimBoard, SimConfig, SimProbe, SimWorld};
use pinion_runtime::wakeup::MarginLimits;
use pinion_runtime::{Access, Helpers, LinkName, Options, Recording};
use pinion_testkit::simulator;
use serde_json::{Value, json};
use tempfile::TempDir;

/// Timeout for an answer of the host. Heating takes real time, and a computer under load takes more.
const HOST_TIMEOUT: Duration = Duration::from_secs(180);
/// Timeout for klippy's start, which takes seconds.
const START: Duration = Duration::from_secs(40);

/// The Python that runs klippy.
pub fn python() -> String {
    std::env::var("KLIPPER_PYTHON").unwrap_or_else(|_| "python3".into())
}

/// Lets klippy move without homing, for tests of other things. During homing klippy is at most 0.1 s ahead of the
/// motion, so a busy computer stops it.
pub const UNHOMED: &str = "\n[force_move]\nenable_force_move: True\n";
/// The initial position of the built-in printer.
pub const WHERE_IT_STANDS: &str = "SET_KINEMATIC_POSITION X=60 Y=45 Z=12";

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
    host: Option<Child>,
    api: Option<UnixStream>,
    next_id: u64,
}

/// The path of `pinion`, with `pinion-sim` beside it.
pub fn pinion_path() -> &'static Path {
    let pinion = Path::new(env!("CARGO_BIN_EXE_pinion"));
    simulator::beside(pinion);
    pinion
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

    /// The same, with `pinion sim --show`.
    pub fn start_shown(
        checkout: &Path,
        describe: impl FnOnce(String, &Path) -> String,
        change: impl FnOnce(String) -> String,
    ) -> Printer {
        Printer::start_sim(checkout, &["--show"], describe, change)
    }

    /// The same, with `pinion sim` and other options. Its folder is the program's working directory.
    pub fn start_sim(
        checkout: &Path,
        options: &[&str],
        describe: impl FnOnce(String, &Path) -> String,
        change: impl FnOnce(String) -> String,
    ) -> Printer {
        Printer::serve(checkout, describe, change, |folder| {
            let pinion = Command::new(pinion_path())
                .current_dir(folder)
                .args(["sim", "-r"])
                .args(options)
                .arg(folder.join("board.toml"))
                .arg("-I")
                .arg(folder.join("tty"))
                .stdout(File::create(folder.join("shown")).unwrap())
                .stderr(File::create(folder.join("pinion.log")).unwrap())
                .spawn();
            Server::Program(pinion.unwrap())
        })
    }

    /// A printer that this process simulates, so tests can read its state. Its log goes to stderr with RUST_LOG=info.
    pub fn start_here(
        checkout: &Path,
        describe: impl FnOnce(String, &Path) -> String,
        change: impl FnOnce(String) -> String,
    ) -> Printer {
        Printer::start_here_on(checkout, describe, change, |folder| LinkName::Pty(folder.join("tty")))
    }

    /// The same on another link. `link` puts the terminal at klippy's end of it where the pty would be.
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
                    pinion_runtime::run(&options, Box::new(board), timing, recording, Helpers::default(), || {})
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
        let mut printer = Printer { checkout: checkout.into(), folder, server, host: None, api: None, next_id: 0 };
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

    /// Writes a file into the printer's folder, and returns its path.
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, text).unwrap();
        path
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

    pub fn start_host(&mut self) {
        let _ = fs::remove_file(self.path("api"));
        // While it homes, klippy is a tenth of a second ahead of the MCU. On a computer that builds and tests at the
        // same time it would often be late without this. Only root may request it.
        let nice = if geteuid().is_root() { "-15" } else { "0" };
        let host = Command::new("nice")
            .args(["-n", nice])
            .arg(python())
            .arg(self.checkout.join("klippy/klippy.py"))
            .arg(self.path("printer.cfg"))
            .arg("-a")
            .arg(self.path("api"))
            .arg("-l")
            .arg(self.path("klippy.log"))
            .arg("-I")
            .arg(self.path("input"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        self.host = Some(host);
        self.until("klippy's API", |printer| UnixStream::connect(printer.path("api")).is_ok());
        self.api = Some(UnixStream::connect(self.path("api")).unwrap());
    }

    /// kill -9.
    pub fn kill_host(&mut self) {
        let mut host = self.host.take().unwrap();
        host.kill().unwrap();
        host.wait().unwrap();
    }

    fn call(&mut self, method: &str, params: Value) -> Result<Value, String> {
        self.next_id += 1;
        let request = json!({ "id": self.next_id, "method": method, "params": params });
        let api = self.api.as_mut().unwrap();
        api.set_read_timeout(Some(HOST_TIMEOUT)).unwrap();
        api.write_all(format!("{request}\x03").as_bytes()).map_err(|error| error.to_string())?;
        loop {
            let answer = message(api)?;
            if answer["id"] == self.next_id {
                return match &answer["error"] {
                    Value::Null => Ok(answer["result"].clone()),
                    error => Err(error.to_string()),
                };
            }
        }
    }

    /// Ends the host and the program, and returns the program's exit code, its output and its log.
    pub fn ended(&mut self) -> (Option<i32>, String, String) {
        self.kill_host();
        let Server::Program(pinion) = &mut self.server else { panic!("not a program") };
        nix::sys::signal::kill(nix::unistd::Pid::from_raw(pinion.id() as i32), Signal::SIGINT).unwrap();
        let code = pinion.wait().unwrap().code();
        (code, fs::read_to_string(self.path("shown")).unwrap(), self.log())
    }

    /// Runs G-code to its end.
    #[track_caller]
    pub fn gcode(&mut self, script: &str) {
        if let Err(error) = self.call("gcode/script", json!({ "script": script })) {
            panic!("{script}: {error}\n{}\n{}", self.why(), self.log());
        }
    }

    /// Runs G-code to its end. Returns its answer, or klippy's reason for a refusal.
    pub fn try_gcode(&mut self, script: &str) -> Result<String, String> {
        // Answers come on a separate connection, before the result.
        let mut api = UnixStream::connect(self.path("api")).map_err(|error| error.to_string())?;
        api.set_read_timeout(Some(HOST_TIMEOUT)).unwrap();
        let mut ask = |id: u32, method: &str, params: Value| {
            let request = json!({ "id": id, "method": method, "params": params });
            api.write_all(format!("{request}\x03").as_bytes()).map_err(|error| error.to_string())?;
            let mut answers = String::new();
            loop {
                let message = message(&mut api)?;
                if let Some(line) = message["params"]["response"].as_str() {
                    answers += line;
                    answers.push('\n');
                }
                if message["id"] == id {
                    let error = &message["error"];
                    return if error.is_null() { Ok(answers) } else { Err(error.to_string()) };
                }
            }
        };
        ask(1, "gcode/subscribe_output", json!({ "response_template": {} }))?;
        ask(2, "gcode/script", json!({ "script": script }))
    }

    /// Runs G-code to its end, and returns its answer.
    #[track_caller]
    pub fn answer(&mut self, script: &str) -> String {
        self.try_gcode(script).unwrap_or_else(|error| panic!("{script}: {error}\n{}", self.log()))
    }

    /// Runs G-code that klippy refuses, and returns the error.
    #[track_caller]
    pub fn refused(&mut self, script: &str) -> String {
        match self.try_gcode(script) {
            Ok(_) => panic!("{script} was not refused\n{}", self.log()),
            Err(error) => error,
        }
    }

    /// A batch of an angle sensor's present measurements.
    #[track_caller]
    pub fn angles(&mut self, sensor: &str) -> Value {
        let template = json!({ "batch": sensor });
        self.call("angle/dump_angle", json!({ "sensor": sensor, "response_template": template })).unwrap();
        let api = self.api.as_mut().unwrap();
        // Other messages of klippy on this connection are no longer needed.
        let batch = loop {
            let message = message(api).unwrap();
            let has_data = message["params"]["data"].as_array().is_some_and(|data| !data.is_empty());
            if message["batch"] == sensor && has_data {
                break message["params"].clone();
            }
        };
        // klippy stops the measurements when the connection is closed.
        self.api = Some(UnixStream::connect(self.path("api")).unwrap());
        batch
    }

    /// Runs G-code that stops the printer.
    pub fn stop(&mut self, script: &str) {
        // klippy may or may not answer, because it is stopped.
        let _ = self.call("gcode/script", json!({ "script": script }));
        self.until_state("shutdown");
    }

    /// Runs FIRMWARE_RESTART or RESTART and waits until klippy is ready again.
    #[track_caller]
    pub fn restart(&mut self, command: &str) {
        let _ = self.call("gcode/script", json!({ "script": command }));
        // klippy disconnects first.
        thread::sleep(Duration::from_millis(500));
        self.until_state("ready");
    }

    pub fn state(&mut self) -> String {
        if let Ok(info) = self.call("info", json!({})) {
            return info["state"].as_str().unwrap_or_default().to_owned();
        }
        match UnixStream::connect(self.path("api")) {
            Ok(api) => self.api = Some(api),
            Err(_) => thread::sleep(Duration::from_millis(100)),
        }
        "startup".into()
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
        let info = self.call("info", json!({})).unwrap_or_default();
        info["state_message"].as_str().unwrap_or_default().to_owned()
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
        let answer = self.call("objects/query", json!({ "objects": { name: null } })).unwrap();
        answer["status"][name].clone()
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
    pub fn until_shown(&mut self, name: &str, is_it: impl Fn(&str) -> bool) {
        let end = Instant::now() + START;
        while !is_it(&self.shown(name)) {
            assert!(Instant::now() < end, "{name} shows\n{}\n{}", self.shown(name), self.log());
            thread::sleep(Duration::from_millis(50));
        }
    }

    /// The content of the description's own file.
    pub fn trace(&self) -> String {
        fs::read_to_string(self.path("trace")).unwrap()
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

/// An example of docs/guide/simulated-printer.md: alone, or appended to the built-in description as the example says.
pub fn example(built_in: &str, heading: &str) -> String {
    const PAGE: &str = include_str!("../../docs/guide/simulated-printer.md");
    let (_, section) = PAGE.split_once(&format!("\n### {heading}\n")).unwrap();
    let (example, _) = section.split_once("\n```toml\n").unwrap().1.split_once("```\n").unwrap();
    if example.starts_with("[delta]") {
        return example.to_owned();
    }
    if example.starts_with("corexy") {
        return format!("{example}{built_in}");
    }
    let rest = match built_in.split_once("[[axis]]\nname = \"z\"\n") {
        Some((before, z)) if example.contains("name = \"z\"\n") => {
            format!("{before}{}", z.split_once("\n\n").unwrap().1)
        }
        _ => built_in.to_owned(),
    };
    format!("{rest}\n{example}")
}

/// The configuration without a section.
pub fn without(config: &str, section: &str) -> String {
    let head = format!("[{section}]\n");
    let (before, after) = config.split_once(&head).unwrap_or_else(|| panic!("no [{section}] in\n{config}"));
    format!("{before}{}", after.split_once("\n\n").map_or("", |(_, after)| after))
}

/// The configuration with an offered section in use, with more keys.
pub fn with(config: &str, section: &str, keys: &str) -> String {
    let head = format!("#[{section}]\n");
    let at = config.find(&head).unwrap_or_else(|| panic!("no #[{section}] in\n{config}"));
    let (before, rest) = config.split_at(at);
    let (lines, after) = rest.split_once("\n\n").unwrap_or((rest, ""));
    let lines: Vec<&str> = lines.lines().map(|line| line.strip_prefix('#').unwrap_or(line)).collect();
    format!("{before}{}\n{keys}\n\n{after}", lines.join("\n"))
}

/// Runs klippy's batch mode with a dictionary, without an MCU. Returns the output, or the reason for a failure.
pub fn batch(checkout: &Path, dictionary: &Path, config: &str, gcode: &str) -> Result<Vec<u8>, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("printer.cfg"), config).unwrap();
    fs::write(path("gcode"), gcode).unwrap();
    let ended = Command::new(python())
        .arg(checkout.join("klippy/klippy.py"))
        .arg(path("printer.cfg"))
        .arg("-i")
        .arg(path("gcode"))
        .arg("-o")
        .arg(path("out"))
        .arg("-d")
        .arg(dictionary)
        .arg("-l")
        .arg(path("log"))
        // The home folder for anything that it stores there.
        .env("HOME", folder.path())
        .output()
        .unwrap();
    if ended.status.success() {
        return Ok(fs::read(path("out")).unwrap());
    }
    let log = fs::read_to_string(path("log")).unwrap_or_default();
    Err(format!(
        "{}{}",
        String::from_utf8_lossy(&ended.stderr),
        log.lines().rev().take(8).collect::<Vec<_>>().join("\n")
    ))
}

/// The next message of klippy's API.
fn message(api: &mut UnixStream) -> Result<Value, String> {
    let mut message = Vec::new();
    loop {
        let mut byte = [0];
        api.read_exact(&mut byte).map_err(|error| error.to_string())?;
        if byte[0] == 3 {
            return serde_json::from_slice(&message).map_err(|error| error.to_string());
        }
        message.push(byte[0]);
    }
}

impl Drop for Printer {
    fn drop(&mut self) {
        let end = |child: &mut Child| {
            let _ = child.kill();
            let _ = child.wait();
        };
        self.host.iter_mut().for_each(end);
        match &mut self.server {
            Server::Program(pinion) => end(pinion),
            // It handles the signal. The signal ends the printer and not this process.
            Server::Here { running, .. } => {
                let _ = raise(Signal::SIGTERM);
                running.drain(..).for_each(|board| drop(board.join()));
            }
        }
    }
}

/// The rest of the line with this start in klippy's answer.
#[track_caller]
pub fn rest<'a>(answer: &'a str, start: &str) -> &'a str {
    let found = answer.lines().find_map(|line| line.trim_start_matches("// ").strip_prefix(start));
    found.unwrap_or_else(|| panic!("no `{start}` in\n{answer}"))
}
