// SPDX-License-Identifier: GPL-3.0-or-later
//! A klippy on a simulated printer, in one clock. The tests use klippy's API and see the printer.

use std::cell::RefCell;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Once};
use std::time::Duration;

use pinion_host::{Host, Launch, MCUS, NoStart, OneClock, Running, Time};
use pinion_model::{Look, SimConfig, SimProbe, SimWorld};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::klippy::{pinion_path, python};

/// The printer's time for an answer of the host. Leveling takes minutes.
const HOST_TIMEOUT: Duration = Duration::from_secs(1800);
/// The printer's time between two looks.
const LOOK: Duration = Duration::from_millis(50);

thread_local! {
    /// The log of the printer's MCUs, which run in the test's thread.
    static LOG: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Keeps the log of each test.
struct Log;

impl log::Log for Log {
    fn enabled(&self, about: &log::Metadata<'_>) -> bool {
        about.level() <= log::Level::Info
    }

    fn log(&self, record: &log::Record<'_>) {
        if self.enabled(record.metadata()) {
            LOG.with_borrow_mut(|log| *log += &format!("{} {}\n", record.level(), record.args()));
        }
    }

    fn flush(&self) {}
}

pub struct Printer {
    folder: TempDir,
    host: Host<()>,
    probe: SimProbe,
}

impl Printer {
    /// A printer with a ready klippy.
    #[track_caller]
    pub fn start(checkout: &Path) -> Printer {
        Printer::start_with(checkout, |config| config)
    }

    /// The same with a changed configuration.
    #[track_caller]
    pub fn start_with(checkout: &Path, change: impl FnOnce(String) -> String) -> Printer {
        Printer::start_on(checkout, |board| board, change)
    }

    /// The same with another description.
    #[track_caller]
    pub fn start_on(
        checkout: &Path,
        describe: impl FnOnce(String) -> String,
        change: impl FnOnce(String) -> String,
    ) -> Printer {
        let mut printer = Printer::launch(checkout, describe, change);
        printer.until_state("ready");
        printer
    }

    /// The same, but klippy may come to another state.
    #[track_caller]
    pub fn launch(
        checkout: &Path,
        describe: impl FnOnce(String) -> String,
        change: impl FnOnce(String) -> String,
    ) -> Printer {
        static ONCE: Once = Once::new();
        ONCE.call_once(|| {
            log::set_logger(&Log).unwrap();
            log::set_max_level(log::LevelFilter::Info);
        });
        LOG.with_borrow_mut(String::clear);
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let printed = Command::new(pinion_path()).args(["sim", "--print-board"]).output().unwrap();
        fs::write(path("board.toml"), describe(String::from_utf8(printed.stdout).unwrap())).unwrap();
        let config = SimConfig::parse(&fs::read_to_string(path("board.toml")).unwrap(), "board.toml").unwrap();
        let clock = pinion_host::start();
        let SimWorld { boards, probe } = SimWorld::new(config, Arc::new(clock.clone())).unwrap();
        let probe = probe.in_one_clock();
        probe.record_spi(File::create(path("spi")).unwrap());
        let links: Vec<PathBuf> = boards
            .iter()
            .enumerate()
            .map(|(place, board)| match place {
                0 => format!("{MCUS}mcu").into(),
                _ => format!("{MCUS}mcu_{}", board.name()).into(),
            })
            .collect();
        let forms = pinion_host::forms(checkout);
        let one = OneClock::new(clock, boards, (&links, folder.path()), &forms, Arc::default()).unwrap();
        let printed = Command::new(pinion_path())
            .arg("sim")
            .arg(path("board.toml"))
            .args(["--print-config", "-I"])
            .arg(&links[0])
            .output()
            .unwrap();
        fs::write(path("printer.cfg"), change(String::from_utf8(printed.stdout).unwrap())).unwrap();
        let python = python();
        // Relative paths of printer.cfg are in the printer's folder.
        let mut command = Command::new("env");
        command.current_dir(folder.path());
        let launch = Launch {
            klipper: checkout,
            python: Path::new(&python),
            folder: folder.path(),
            printer_cfg: &path("printer.cfg"),
            command,
            running: Running::default(),
        };
        match Host::start(launch, Time::One(Box::new(one)), ()) {
            Ok(host) => Printer { folder, host, probe },
            Err(NoStart::Alone) => panic!("klippy's Python takes no part in the clock"),
            Err(NoStart::Trouble(trouble)) => panic!("{trouble}"),
        }
    }

    /// The simulated printer.
    pub fn probe(&self) -> &SimProbe {
        &self.probe
    }

    /// Writes a file into the printer's folder, where `path: .` of printer.cfg is.
    pub fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    /// A path in the printer's folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes the changed configuration of the printer.
    pub fn configure(&mut self, change: impl FnOnce(String) -> String) {
        let config = fs::read_to_string(self.path("printer.cfg")).unwrap();
        fs::write(self.path("printer.cfg"), change(config)).unwrap();
    }

    /// Lets the printer's time pass.
    #[track_caller]
    pub fn sleep(&mut self, span: Duration) {
        self.host.sleep(span).unwrap();
    }

    /// Runs G-code to its end. Returns its answer, or klippy's reason for a refusal.
    pub fn try_gcode(&mut self, script: &str) -> Result<String, String> {
        let ran = self.host.gcode(script, HOST_TIMEOUT);
        ran.map(|()| self.host.said.join("\n")).map_err(|refused| refused.to_string())
    }

    /// Runs G-code to its end, and returns its answer.
    #[track_caller]
    pub fn gcode(&mut self, script: &str) -> String {
        self.try_gcode(script).unwrap_or_else(|error| panic!("{script}: {error}\n{}\n{}", self.why(), self.log()))
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
        let params = json!({ "sensor": sensor, "response_template": { "batch": sensor } });
        self.host.call("angle/dump_angle", params, HOST_TIMEOUT).unwrap();
        let has_data = |message: &Value| {
            message["batch"] == sensor && message["params"]["data"].as_array().is_some_and(|data| !data.is_empty())
        };
        let mut batch = self.host.until_message(has_data, HOST_TIMEOUT).unwrap();
        // klippy stops the measurements when the connection is closed.
        assert!(self.host.reconnect());
        batch["params"].take()
    }

    /// Runs G-code that stops the printer.
    #[track_caller]
    pub fn stop(&mut self, script: &str) {
        // klippy may or may not answer, because it is stopped.
        let _ = self.try_gcode(script);
        self.until_state("shutdown");
    }

    /// Runs FIRMWARE_RESTART or RESTART and waits until klippy is ready again.
    #[track_caller]
    pub fn restart(&mut self, command: &str) {
        self.host.restart(command);
        self.until_state("ready");
    }

    /// klippy's state.
    #[track_caller]
    pub fn state(&mut self) -> String {
        self.host.state().unwrap().0
    }

    /// klippy's message about its state.
    fn why(&mut self) -> String {
        self.host.state().map_or_else(|refused| refused.to_string(), |(_, words)| words)
    }

    #[track_caller]
    pub fn until_state(&mut self, wanted: &str) {
        let state = self.settled();
        assert_eq!(state, wanted, "{}\n{}", self.why(), self.log());
    }

    /// The final state of klippy's start.
    #[track_caller]
    fn settled(&mut self) -> String {
        let end = self.host.now() + HOST_TIMEOUT;
        loop {
            let state = self.state();
            if state != "startup" {
                // Display and sensors begin in the first moments.
                self.sleep(Duration::from_secs(3));
                return self.state();
            }
            assert!(self.host.now() < end, "klippy does not start: {}\n{}", self.why(), self.log());
            self.sleep(LOOK);
        }
    }

    /// The status of one of klippy's objects.
    #[track_caller]
    pub fn object(&mut self, name: &str) -> Value {
        self.host.query(&[name]).unwrap()[name].take()
    }

    /// Waits until one of klippy's objects has this value for a key.
    #[track_caller]
    pub fn until_object(&mut self, name: &str, key: &str, wanted: impl Into<Value>) {
        let wanted = wanted.into();
        let end = self.host.now() + HOST_TIMEOUT;
        loop {
            let object = self.object(name);
            if object[key] == wanted {
                return;
            }
            let stopped = self.state() == "shutdown";
            let is_late = self.host.now() >= end;
            assert!(!stopped && !is_late, "{name} stays {object}: {}\n{}", self.why(), self.log());
            self.sleep(LOOK);
        }
    }

    /// The appearance of a part, once klippy has written all of it.
    #[track_caller]
    pub fn sight(&mut self, name: &str) -> Look {
        self.sleep(Duration::from_secs(1));
        let sight = self.probe.sights().find(|(part, _)| *part == name);
        sight.unwrap_or_else(|| panic!("there is no {name}")).1
    }

    /// The log of the MCUs.
    pub fn log(&self) -> String {
        LOG.with_borrow(String::clone)
    }

    /// klippy's log. A thread of klippy writes it, some of its time after the event.
    pub fn host_log(&mut self) -> String {
        self.sleep(Duration::from_secs(1));
        fs::read_to_string(self.path("klippy.log")).unwrap()
    }

    /// A line for each SPI transfer so far.
    pub fn spi(&self) -> String {
        fs::read_to_string(self.path("spi")).unwrap()
    }
}
