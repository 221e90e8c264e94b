// SPDX-License-Identifier: GPL-3.0-or-later
//! Makes the status from the core's answer, the search for the host and the facts of the program's start.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::form::{self, Guardian, Host, McuStatus, State, Status};
use pinion_firmware::board::{ADC_MAX, Board, PWM_MAX, Range};
use pinion_firmware::lateness::{Lateness, us};
use pinion_firmware::mcu::{BusCounts, LineState, LineUse, ObjectState, Present, QueueState, Snapshot};
use pinion_firmware::time::{NS_PER_TICK, Ticks};

use super::{Answer, SnapshotReader};

/// Facts about the host, as the threads that find them leave them.
#[derive(Default)]
pub(crate) struct HostStatus {
    /// Whether a host has the terminal open. The link says so.
    attached: AtomicBool,
    /// The terminal, or more about the link's place.
    terminal: Mutex<String>,
    found: Mutex<Option<FoundHost>>,
}

/// The host that was found.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct FoundHost {
    pub(crate) pid: u32,
    /// Whether this process is the host for certain.
    pub(crate) is_sure: bool,
    /// Whether it is `pinion attach`, and the host is on another computer.
    pub(crate) is_attach: bool,
    /// The checkout that it runs from, if it is a klippy whose sources can be read.
    pub(crate) checkout: Option<String>,
    pub(crate) commit: Option<String>,
}

impl HostStatus {
    pub(crate) fn attach(&self, attached: bool) {
        self.attached.store(attached, Ordering::Relaxed);
    }

    pub(crate) fn serve_on(&self, terminal: String) {
        *self.terminal.lock().unwrap_or_else(PoisonError::into_inner) = terminal;
    }

    fn terminal(&self) -> String {
        self.terminal.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn found(&self, host: Option<FoundHost>) {
        *self.found.lock().unwrap_or_else(PoisonError::into_inner) = host;
    }

    /// Whether the host is on another computer, as far as was found out.
    pub(crate) fn is_carried(&self) -> bool {
        self.found.lock().unwrap_or_else(PoisonError::into_inner).as_ref().is_some_and(|host| host.is_attach)
    }

    fn host(&self) -> Host {
        if !self.attached.load(Ordering::Relaxed) {
            return Host::default();
        }
        match self.found.lock().unwrap_or_else(PoisonError::into_inner).clone() {
            Some(FoundHost { pid, is_sure, is_attach: _, checkout, commit }) => {
                Host { attached: true, pid: Some(pid), sure: Some(is_sure), checkout, commit }
            }
            None => Host { attached: true, ..Host::default() },
        }
    }
}

/// Facts that the program knows from its start.
pub(crate) struct Facts {
    /// Where the host finds the MCU.
    pub(crate) link: String,
    /// Description of the board.
    pub(crate) board: String,
    /// Names of its pins.
    pub(crate) pins: Vec<Range>,
    /// Where to ask for both again, because chips come and go. `None` if the board never changes.
    pub(crate) view: Option<Box<dyn Board>>,
    /// The guardian's process.
    pub(crate) guardian: Option<u32>,
    /// How many requests to the core there is room for.
    pub(crate) requests: usize,
    /// The flight recorder.
    pub(crate) recorder: form::RecorderStatus,
}

/// Writes the status.
pub(super) struct Reporter {
    snapshot_reader: SnapshotReader,
    facts: Facts,
    host: Arc<HostStatus>,
    started: Instant,
}

impl Reporter {
    pub(super) fn new(snapshot_reader: SnapshotReader, facts: Facts, host: Arc<HostStatus>) -> Reporter {
        Reporter { snapshot_reader, facts, host, started: Instant::now() }
    }

    /// The status now. It asks the core, and waits for the answer.
    pub(super) fn status(&mut self) -> Status {
        let answer = self.snapshot_reader.ask();
        let facts = &mut self.facts;
        if let Some(view) = &facts.view {
            (facts.board, facts.pins) = (view.describe(), view.pins());
        }
        Status {
            form: form::FORM,
            version: crate::VERSION.to_owned(),
            pid: std::process::id(),
            uptime_s: rounded(self.started.elapsed().as_secs_f64()),
            link: facts.link.clone(),
            terminal: self.host.terminal(),
            board: facts.board.clone(),
            state: answer.map_or(State::Unknown, |answer| state(&answer.mcu)),
            host: self.host.host(),
            // If the guardian is lost, the program ends.
            guardian: Guardian { present: facts.guardian.is_some(), pid: facts.guardian },
            recorder: Some(facts.recorder.clone()),
            mcu: answer.map(|answer| mcu(answer, facts)),
        }
    }
}

fn rounded(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

fn rounded_us(ticks: Ticks) -> f64 {
    rounded(us(ticks))
}

fn state(mcu: &Snapshot) -> State {
    match (mcu.stopped, mcu.is_configured, mcu.oids_allocated) {
        (Some(_), _, _) => State::Shutdown,
        (None, true, _) => State::Configured,
        (None, false, true) => State::Configuring,
        (None, false, false) => State::Waiting,
    }
}

fn mcu(Answer { mcu, waiting, margin }: &Answer, facts: &Facts) -> McuStatus {
    let shutdown = mcu.stopped.map(|(reason, at)| form::Stop {
        reason: reason.text().to_owned(),
        detail: mcu.detail.clone(),
        ago_s: rounded(mcu.at.since(at) as f64 * NS_PER_TICK as f64 / 1e9),
    });
    let (queued, room) = mcu.moves;
    McuStatus {
        shutdown,
        owes: (!mcu.pending.is_empty()).then(|| mcu.pending.clone()),
        dialect: mcu.dialect.map(|dialect| dialect.to_string()),
        lines: mcu.lines.iter().map(|state| line(state, &facts.pins)).collect(),
        objects: mcu.objects.iter().map(|state| object(state, &facts.pins)).collect(),
        lateness: lateness(&mcu.lateness, *margin),
        queues: form::Queues {
            moves: form::MoveQueue { waiting: queued, size: room },
            commands: form::CommandQueue { waiting: *waiting, size: facts.requests, held: mcu.is_held },
            workers: mcu.queues.iter().map(worker).collect(),
        },
    }
}

fn line(state: &LineState, pins: &[Range]) -> form::Line {
    form::Line {
        pin: state.pin.name_in(pins),
        use_: match state.use_ {
            LineUse::Output => form::Use::Output,
            LineUse::Input => form::Use::Input,
            LineUse::OpenDrain => form::Use::OpenDrain,
        },
        level: state.level.map(u8::from),
        fast: state.fast,
        bus: state.bus.map(bus),
    }
}

fn object(state: &ObjectState, pins: &[Range]) -> form::Object {
    form::Object {
        oid: state.oid,
        kind: state.kind.to_owned(),
        pin: state.pin.map(|pin| pin.name_in(pins)),
        queued: state.report.queued,
        value: state.report.value.map(|value| match value {
            Present::Adc(counts) => form::Present::Adc(rounded(f64::from(counts) / f64::from(ADC_MAX))),
            Present::Pwm(value) => form::Present::Duty(rounded(f64::from(value) / f64::from(PWM_MAX))),
            Present::Steps(steps) => form::Present::Steps(steps),
        }),
        repeats: state.report.repeats,
        bus: state.bus.map(bus),
    }
}

fn worker(queue: &QueueState) -> form::WorkerQueue {
    form::WorkerQueue { name: queue.name(), waiting: queue.waiting }
}

fn bus(BusCounts { transfers, errors, retries }: BusCounts) -> form::BusCounts {
    form::BusCounts { transfers, errors, retries }
}

fn lateness(lateness: &Lateness, margin: Ticks) -> form::Lateness {
    form::Lateness {
        timers: lateness.samples(),
        p50_us: rounded_us(lateness.quantile(0.5)),
        p99_us: rounded_us(lateness.quantile(0.99)),
        p999_us: rounded_us(lateness.quantile(0.999)),
        max_us: rounded_us(lateness.max()),
        margin_us: rounded_us(margin),
        buckets_us: lateness.buckets().map(|(upper, count)| (rounded_us(upper), count)).collect(),
    }
}
