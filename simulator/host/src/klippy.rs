// SPDX-License-Identifier: GPL-3.0-or-later
//! A klippy that this program starts, and its API server.

use std::collections::HashMap;
use std::fmt::{self, Display};
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::AsRawFd as _;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};
use std::time::Duration;

use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use nix::sys::signal::{self, Signal};
use nix::unistd::Pid;
use serde_json::{Value, json};

use pinion_firmware::trouble::Trouble;

use crate::clock::{self, LIBRARY, Stop};
use crate::hang::{self, Hang};
use crate::process::await_end;
use crate::time::Time;

/// The file of klippy's output in its folder.
const OUTPUT: &str = "klippy.out";
/// The end of a message.
const END: u8 = 3;
/// Highest number of lines of klippy's output that are kept.
const SAID_MAX: usize = 10_000;
/// Longest message.
const MESSAGE_MAX: usize = 64 << 20;
/// How long klippy has to open its API.
const START: Duration = Duration::from_secs(60);
/// How long klippy has to answer a question about its state.
const ANSWER: Duration = Duration::from_secs(30);
/// Time between two reads of klippy's state while a command runs.
const LOOK: Duration = Duration::from_secs(5);
/// How long klippy is left alone when it is ready, as people do. It fills its display then: homing in the first second would
/// come behind that, too late.
const FIRST_MOMENTS: Duration = Duration::from_secs(3);
/// How long klippy has to end in order, in real time.
const END_TIME: Duration = Duration::from_secs(3);
/// Time between two looks at an API that is not there yet.
const LOOK_FOR_API: Duration = Duration::from_millis(50);
/// Time between two calls of a watch. The printer keeps half a second of an axis at 32,000 steps per second.
const WATCH: Duration = Duration::from_millis(50);

/// The result of a command.
#[derive(Debug)]
pub enum Refused {
    /// klippy refused it, in its words.
    Error(String),
    /// It took too long.
    Late,
    /// klippy is gone.
    Gone(String),
}

impl Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Refused::Error(words) => f.write_str(words),
            Refused::Late => f.write_str("it takes too long"),
            Refused::Gone(why) => write!(f, "klippy is gone: {why}"),
        }
    }
}

impl From<Stop> for Refused {
    fn from(stop: Stop) -> Refused {
        Refused::Gone(stop.to_string())
    }
}

/// Why klippy did not start.
pub enum NoStart {
    /// It takes no part in the printer's clock: its Python loads no library.
    Alone,
    /// Anything else.
    Trouble(Trouble),
}

impl From<Refused> for NoStart {
    fn from(refused: Refused) -> NoStart {
        NoStart::Trouble(Trouble::new(format!("klippy's API does not answer: {refused}")))
    }
}

impl From<Trouble> for NoStart {
    fn from(trouble: Trouble) -> NoStart {
        NoStart::Trouble(trouble)
    }
}

/// The number of the process that this program started, so that nothing of it stays when the program ends.
#[derive(Clone, Debug, Default)]
pub struct Running(Arc<AtomicI32>);

impl Running {
    /// Ends it, if it runs.
    pub fn end(&self) {
        // A process that nobody has waited for keeps its number.
        let pid = self.0.swap(0, Ordering::SeqCst);
        if pid != 0 {
            let _ = signal::kill(Pid::from_raw(pid), Signal::SIGTERM);
        }
    }
}

/// Is called now and then while time passes.
pub trait Watch {
    /// Looks at the printer, at this time of the clock.
    fn look(&mut self, now: Duration);
}

impl Watch for () {
    fn look(&mut self, _: Duration) {}
}

/// The klippy that is started.
pub struct Launch<'a> {
    /// A checkout of Klipper or Kalico.
    pub klipper: &'a Path,
    /// Its Python.
    pub python: &'a Path,
    /// Where its logs, its API and its terminal are.
    pub folder: &'a Path,
    /// Its configuration.
    pub printer_cfg: &'a Path,
    /// A command that runs the program of its arguments, with the rights that klippy shall have.
    pub command: Command,
    /// Gets klippy's process.
    pub running: Running,
}

/// A klippy.
pub struct Host<W> {
    child: Child,
    running: Running,
    socket: PathBuf,
    api: UnixStream,
    buffer: Vec<u8>,
    next_id: u64,
    /// Answers to other questions than the one that is waited for.
    answers: HashMap<u64, Value>,
    /// klippy's output since the last command.
    pub said: Vec<String>,
    time: Time,
    /// Looks at the printer while time passes.
    pub watch: W,
}

impl<W: Watch> Host<W> {
    /// Starts a klippy.
    ///
    /// # Errors
    ///
    /// It cannot be started, does not take part in the clock, or opens no API.
    pub fn start(launch: Launch<'_>, mut time: Time, watch: W) -> Result<Host<W>, NoStart> {
        let running = launch.running.clone();
        let Started { child, socket, api } = Started::new(launch, &mut time)?;
        let (buffer, answers, said) = (Vec::new(), HashMap::new(), Vec::new());
        let mut host = Host { child, running, socket, api, buffer, next_id: 0, answers, said, time, watch };
        host.subscribe()?;
        Ok(host)
    }

    /// Ends klippy and starts another one in the same clock.
    ///
    /// # Errors
    ///
    /// As of [`Host::start`].
    pub fn start_anew(&mut self, launch: Launch<'_>) -> Result<(), NoStart> {
        self.end();
        let Started { child, socket, api } = Started::new(launch, &mut self.time)?;
        (self.child, self.socket) = (child, socket);
        Ok(self.connect(api)?)
    }

    /// Uses another connection from now on.
    fn connect(&mut self, api: UnixStream) -> Result<(), Refused> {
        self.api = api;
        self.buffer.clear();
        self.answers.clear();
        self.subscribe()
    }

    /// klippy's process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Whether klippy runs.
    pub fn is_there(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// The time of the clock.
    pub fn now(&self) -> Duration {
        self.time.now()
    }

    /// Lets time pass.
    ///
    /// # Errors
    ///
    /// klippy takes no more turns.
    pub fn sleep(&mut self, span: Duration) -> Result<(), Stop> {
        let until = self.now() + span;
        while self.now() < until {
            let next = until.min(self.now() + WATCH);
            self.time.sleep(next.saturating_sub(self.now())).map_err(|stop| self.examined(stop))?;
            self.watch.look(self.time.now());
        }
        Ok(())
    }

    /// Adds to a stop where klippy hangs.
    fn examined(&mut self, stop: Stop) -> Stop {
        match stop {
            Stop::Hangs(None) => Stop::Hangs(Some(self.examine())),
            stop => stop,
        }
    }

    /// Finds out where a klippy hangs, and ends it.
    fn examine(&mut self) -> Hang {
        Hang::examine(&mut self.child, &self.socket.with_file_name(OUTPUT))
    }

    /// Has klippy send its output.
    fn subscribe(&mut self) -> Result<(), Refused> {
        self.ask("gcode/subscribe_output", json!({ "response_template": {} })).map(drop)
    }

    /// A call of the API.
    pub fn call(&mut self, method: &str, params: Value, limit: Duration) -> Result<Value, Refused> {
        let id = self.send(method, params)?;
        self.answer(id, self.now() + limit)
    }

    /// Sends a question, and returns its number.
    fn send(&mut self, method: &str, params: Value) -> Result<u64, Refused> {
        self.next_id += 1;
        let mut request = json!({ "id": self.next_id, "method": method, "params": params }).to_string().into_bytes();
        request.push(END);
        self.api.write_all(&request).map_err(|_| Refused::Gone(Stop::Ended.to_string()))?;
        self.time.poke();
        Ok(self.next_id)
    }

    /// Waits for the answer to a question.
    fn answer(&mut self, id: u64, until: Duration) -> Result<Value, Refused> {
        loop {
            let message = match self.answers.remove(&id) {
                Some(message) => message,
                None => self.message(until)?,
            };
            if let Some(line) = message["params"]["response"].as_str()
                && self.said.len() < SAID_MAX
            {
                self.said.push(line.to_owned());
            }
            match message["id"].as_u64() {
                Some(other) if other == id => {
                    return match &message["error"] {
                        Value::Null => Ok(message["result"].clone()),
                        error => {
                            let words = error["message"].as_str().map_or_else(|| error.to_string(), str::to_owned);
                            Err(Refused::Error(words))
                        }
                    };
                }
                Some(other) if other < id => _ = self.answers.insert(other, message),
                _ => {}
            }
        }
    }

    /// Waits until klippy sends a message like this. It drops all others.
    ///
    /// # Errors
    ///
    /// None comes.
    pub fn until_message(&mut self, is_it: impl Fn(&Value) -> bool, limit: Duration) -> Result<Value, Refused> {
        let until = self.now() + limit;
        loop {
            let message = self.message(until)?;
            if is_it(&message) {
                return Ok(message);
            }
        }
    }

    fn message(&mut self, until: Duration) -> Result<Value, Refused> {
        let mut piece = [0; 4096];
        loop {
            if let Some(end) = self.buffer.iter().position(|byte| *byte == END) {
                let message = serde_json::from_slice(&self.buffer[..end]).unwrap_or_default();
                self.buffer.drain(..=end);
                return Ok(message);
            }
            if self.now() >= until {
                return Err(Refused::Late);
            }
            let next = until.min(self.now() + WATCH);
            let is_there = self.time.await_bytes(&self.api, next).map_err(|stop| self.examined(stop))?;
            self.watch.look(self.time.now());
            if !is_there {
                continue;
            }
            let gone = |cause: &str| Refused::Gone(cause.to_owned());
            match self.api.read(&mut piece) {
                Ok(0) => return Err(Stop::Ended.into()),
                Ok(read) => self.buffer.extend_from_slice(&piece[..read]),
                Err(error) => return Err(gone(&error.to_string())),
            }
            if self.buffer.len() > MESSAGE_MAX {
                return Err(gone("its message has no end"));
            }
        }
    }

    /// Runs G-code to its end. A klippy that stopped may never answer, so its state is read now and then.
    pub fn gcode(&mut self, script: &str, limit: Duration) -> Result<(), Refused> {
        self.said.clear();
        let id = self.send("gcode/script", json!({ "script": script }))?;
        let until = self.now() + limit;
        let mut stopped = None;
        loop {
            match self.answer(id, until.min(self.now() + LOOK)) {
                Err(Refused::Late) if stopped.is_some() => return Err(Refused::Error(stopped.unwrap_or_default())),
                Err(Refused::Late) if self.now() < until => {
                    let (state, words) = self.state()?;
                    stopped = (state != "ready").then_some(words);
                }
                answer => return answer.map(drop),
            }
        }
    }

    /// Waits until klippy is ready. The error is its words.
    pub fn until_ready(&mut self, limit: Duration) -> Result<(), String> {
        let until = self.now() + limit;
        loop {
            match self.state() {
                Ok((state, _)) if state == "ready" => {
                    return self.sleep(FIRST_MOMENTS).map_err(|stop| stop.to_string());
                }
                Ok((state, words)) if state == "error" || state == "shutdown" => return Err(words),
                Ok((_, words)) if self.now() > until => return Err(format!("klippy is not ready: {words}")),
                Ok(_) => self.sleep(LOOK_FOR_API).map_err(|stop| stop.to_string())?,
                // A klippy that finds its MCU shut down restarts both.
                Err(Refused::Gone(_)) if self.now() < until && self.reconnect() => {}
                Err(refused) => return Err(format!("klippy does not answer: {refused}")),
            }
        }
    }

    /// Asks klippy about itself. In one clock, a klippy that does not answer hangs, and is ended.
    fn ask(&mut self, method: &str, params: Value) -> Result<Value, Refused> {
        match self.call(method, params, ANSWER) {
            Err(Refused::Late) if matches!(self.time, Time::One(_)) => {
                let hang = self.examine();
                let seconds = ANSWER.as_secs();
                Err(Refused::Gone(format!("it has not answered for {seconds} s of the printer: {hang}")))
            }
            answer => answer,
        }
    }

    /// klippy's state and its words about it.
    pub fn state(&mut self) -> Result<(String, String), Refused> {
        let info = self.ask("info", json!({}))?;
        let text = |key: &str| info[key].as_str().unwrap_or_default().to_owned();
        Ok((text("state"), text("state_message")))
    }

    /// The status of objects.
    pub fn query(&mut self, objects: &[&str]) -> Result<Value, Refused> {
        let objects: serde_json::Map<String, Value> =
            objects.iter().map(|name| ((*name).to_owned(), Value::Null)).collect();
        let answer = self.ask("objects/query", json!({ "objects": objects }))?;
        Ok(answer["status"].clone())
    }

    /// All objects of klippy.
    pub fn objects(&mut self) -> Result<Vec<String>, Refused> {
        Ok(texts(&self.ask("objects/list", json!({}))?["objects"]))
    }

    /// The names of klippy's heaters.
    pub fn heaters(&mut self) -> Result<Vec<String>, Refused> {
        Ok(texts(&self.query(&["heaters"])?["heaters"]["available_heaters"]))
    }

    /// Another connection, which stops the printer while a command runs.
    pub fn stop(&mut self) {
        if let Ok(mut api) = UnixStream::connect(&self.socket) {
            let _ = api.write_all(b"{\"id\":1,\"method\":\"emergency_stop\"}\x03");
            self.time.poke();
            // klippy must have read it before the connection closes.
            let _ = self.time.sleep(LOOK_FOR_API);
        }
    }

    /// Has klippy restart itself, by RESTART or FIRMWARE_RESTART.
    pub fn restart(&mut self, command: &str) {
        let until = self.now() + ANSWER;
        // The answer may come before the restart, or never.
        let _ = self.gcode(command, ANSWER);
        while self.state().is_ok() && self.now() < until {
            if self.sleep(LOOK_FOR_API).is_err() {
                break;
            }
        }
        self.reconnect();
    }

    /// Connects again: klippy opens another API when it restarts itself. Returns whether it did.
    pub fn reconnect(&mut self) -> bool {
        let until = self.now() + START;
        while matches!(self.child.try_wait(), Ok(None)) && self.now() < until {
            // klippy that takes no more turns answers no more.
            if self.sleep(LOOK_FOR_API).is_err() {
                return false;
            }
            if UnixStream::connect(&self.socket).is_ok_and(|api| self.connect(api).is_ok()) {
                return true;
            }
        }
        false
    }
}

/// A process that has opened its API.
struct Started {
    child: Child,
    socket: PathBuf,
    api: UnixStream,
}

impl Started {
    fn new(launch: Launch<'_>, time: &mut Time) -> Result<Started, NoStart> {
        let Launch { klipper, python, folder, printer_cfg, mut command, running } = launch;
        let program = klipper.join("klippy/klippy.py");
        let failed = |cause: String| Trouble::new(cause).of(program.display());
        if !program.is_file() {
            let trouble = failed("there is no klippy".into());
            return Err(trouble.remedy("name a checkout of Klipper or Kalico with --klipper DIR").into());
        }
        let socket = folder.join("klippy.sock");
        let _ = std::fs::remove_file(&socket);
        let output = File::create(folder.join(OUTPUT)).map_err(|error| failed(error.to_string()))?;
        let turns = match time {
            Time::Real(..) => None,
            // The library is for 64 bits.
            Time::One(_) if cfg!(target_pointer_width = "32") => return Err(NoStart::Alone),
            Time::One(clock) => {
                let (ours, theirs) = clock.invite().map_err(|error| failed(error.to_string()))?;
                // Only programs behind env have the library.
                let library = library()?;
                let opened = File::open(&library).and_then(|file| {
                    fcntl(&file, FcntlArg::F_SETFD(FdFlag::empty()))?;
                    Ok(file)
                });
                let file = opened.map_err(|error| failed(format!("{}: {error}", library.display())))?;
                // By its descriptor: the loader takes a space or a colon in a path for the end of it.
                command.arg("env").arg(format!("LD_PRELOAD=/proc/self/fd/{}", file.as_raw_fd()));
                command.arg(format!("{}={}", clock::WORD, clock::word(&theirs, folder)));
                // The same order of names in each run; one thread for numpy.
                command.args([hang::PRINTS, "PYTHONHASHSEED=0", "OPENBLAS_NUM_THREADS=1", "OMP_NUM_THREADS=1"]);
                Some((ours, theirs, file))
            }
        };
        command.arg(python).arg(&program).arg(printer_cfg).arg("-a").arg(&socket);
        command.arg("-l").arg(folder.join("klippy.log")).arg("-I").arg(folder.join("klippy.tty"));
        command.stdin(Stdio::null()).stdout(output.try_clone().map_err(|error| failed(error.to_string()))?);
        // A Ctrl-C ends this program, which ends klippy.
        let started = command.stderr(output).process_group(0).spawn();
        let mut child = started.map_err(|error| {
            failed(format!("{} cannot start it: {error}", python.display())).remedy("name its Python with --python")
        })?;
        running.0.store(child.id().cast_signed(), Ordering::SeqCst);
        let opened = await_api(&mut child, time, turns.map(|(ours, ..)| ours), &socket, folder);
        let api = opened.inspect_err(|_| {
            running.0.store(0, Ordering::SeqCst);
            let _ = child.kill();
            let _ = child.wait();
        });
        let api = api.map_err(|error| match error {
            NoStart::Trouble(trouble) => NoStart::Trouble(trouble.of(program.display())),
            NoStart::Alone => NoStart::Alone,
        })?;
        Ok(Started { child, socket, api })
    }
}

/// Waits until klippy takes part in the clock and has opened its API.
fn await_api(
    child: &mut Child,
    time: &mut Time,
    turns: Option<UnixStream>,
    socket: &Path,
    folder: &Path,
) -> Result<UnixStream, NoStart> {
    if let (Time::One(clock), Some(turns)) = (&mut *time, turns) {
        match clock.await_player(turns) {
            Ok(()) => {}
            Err(Stop::Hangs(_)) => return Err(NoStart::Alone),
            Err(_) => return Err(no_start(folder, true).into()),
        }
    }
    let until = time.now() + START;
    loop {
        if let Ok(api) = UnixStream::connect(socket) {
            return Ok(api);
        }
        let passed = time.sleep(LOOK_FOR_API);
        let ended = passed.is_err() || child.try_wait().ok().flatten().is_some();
        if ended || time.now() > until {
            return Err(no_start(folder, ended).into());
        }
    }
}

/// The texts of a list.
fn texts(list: &Value) -> Vec<String> {
    list.as_array().into_iter().flatten().filter_map(Value::as_str).map(str::to_owned).collect()
}

/// The library that gives klippy the printer's clock.
fn library() -> Result<PathBuf, Trouble> {
    let program = std::env::current_exe().and_then(std::fs::canonicalize).unwrap_or_default();
    let folder = program.parent().unwrap_or(Path::new("/"));
    // cargo's places for a program and for a test, and the package's.
    let places = ["deps", ".", "../lib/pinion-sim"].map(|place| folder.join(place).join(LIBRARY));
    places.into_iter().find(|place| place.is_file()).ok_or_else(|| {
        Trouble::new(format!("there is no {LIBRARY} beside {}", program.display()))
            .remedy("install the whole package, or add --real-time")
    })
}

/// The reason why klippy opened no API, in its last words, and what helps.
fn no_start(folder: &Path, ended: bool) -> Trouble {
    let last_of = |name: &str| {
        let said = std::fs::read_to_string(folder.join(name)).unwrap_or_default();
        said.lines().rev().find(|line| !line.trim().is_empty()).map(str::to_owned)
    };
    let (file, last) = match (last_of(OUTPUT), last_of("klippy.log")) {
        (Some(last), _) => (OUTPUT, last),
        (None, last) => ("klippy.log", last.unwrap_or_else(|| "it says nothing".into())),
    };
    let file = folder.join(file);
    let remedy = if ["ModuleNotFoundError", "ImportError"].iter().any(|error| last.starts_with(error)) {
        format!("install klippy's requirements, or name its Python with --python; {} has more", file.display())
    } else {
        format!("read {}", file.display())
    };
    // Threads of a klippy whose main thread has failed may keep it alive.
    let what = if ended { "does not start".into() } else { format!("opens no API within {} s", START.as_secs()) };
    Trouble::new(format!("klippy {what}: {last}")).remedy(remedy)
}

impl<W> Host<W> {
    /// Ends klippy. One that hangs is killed.
    pub fn end(&mut self) {
        let pid = self.child.id().cast_signed();
        // Another klippy may run already.
        let _ = self.running.0.compare_exchange(pid, 0, Ordering::SeqCst, Ordering::SeqCst);
        // It leads a group of its own, so what it has started ends, too.
        let group = || signal::killpg(Pid::from_raw(pid), Signal::SIGKILL);
        if matches!(self.child.try_wait(), Ok(Some(_))) {
            let _ = group();
            return;
        }
        let _ = signal::kill(Pid::from_raw(pid), Signal::SIGTERM);
        await_end(&mut self.child, END_TIME);
        let _ = group();
        let _ = self.child.wait();
    }
}

impl<W> Drop for Host<W> {
    fn drop(&mut self) {
        self.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_klippy_that_does_not_start_is_explained_by_its_last_words() {
        let folder = tempfile::tempdir().unwrap();
        let said = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        let reason = |ended| no_start(folder.path(), ended).to_string().replace(folder.path().to_str().unwrap(), "F");
        assert_eq!(reason(true), "klippy does not start: it says nothing: read F/klippy.log");
        said("klippy.log", "Starting Klippy...\n");
        assert_eq!(reason(false), "klippy opens no API within 60 s: Starting Klippy...: read F/klippy.log");
        said("klippy.out", "Traceback\nModuleNotFoundError: No module named 'greenlet'\n");
        let text = reason(true);
        assert!(text.starts_with("klippy does not start: ModuleNotFoundError: No module named 'greenlet'"), "{text}");
        assert!(text.contains("--python"), "{text}");
        said("klippy.out", "Traceback\nOSError: cannot find chelper.so\n");
        assert_eq!(reason(true), "klippy does not start: OSError: cannot find chelper.so: read F/klippy.out");
        let text = reason(false);
        assert_eq!(text, "klippy opens no API within 60 s: OSError: cannot find chelper.so: read F/klippy.out");
    }
}
