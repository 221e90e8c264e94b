// SPDX-License-Identifier: GPL-3.0-or-later
//! A Klipper micro-controller as a Linux process: its threads, its links to the host, its guardian and recorder, and its
//! knowledge about a host from outside ([`klippy`]).
//!
//! ```text
//! host <-way-> link ==ring of blocks==> core ==ring of jobs==> one worker per bus
//!                   <==ring of bytes===      <==ring of answers==
//! ```

#![forbid(unsafe_code)]
// Printing panics when nobody reads. The others panic when an assumption is wrong. Tests may use all of them.
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;

use log::{debug, error, info, warn};

use pinion_firmware::board::Board;
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{DialectName, Firmware, Tolerances, Wire};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::Timing;
use pinion_firmware::trouble::Trouble;
use pinion_linux::{LOOK_AT_LOG, sys};

mod bridge;
mod core;
pub mod guardian;
mod host;
pub mod latency;
mod link;
pub mod logging;
mod process;
mod recorder;
pub mod status;
mod transport;
mod trouble;

/// The functions for the targets in `fuzz/`.
#[cfg(fuzzing)]
pub mod fuzz {
    pub use super::guardian::fuzz::guardian;
    pub use super::host::search::fuzz::search;
    pub use super::link::thread::fuzz::link;
}

pub use bridge::attach::attach;
pub use bridge::near::link as link_over_ssh;
pub use bridge::ssh::Target;
pub use core::wakeup;
pub use guardian::Guardian;
pub use host::klippy;
pub use host::search::HostSearch;
pub use process::helpers::{self, Helpers};
pub use process::realtime;
pub use process::signals::hang_up;
pub use recorder::Recording;
pub use status::{socket_paths, trace_socket_paths};
pub use transport::LinkName;
pub use transport::can::{CanbusUuid, can_open, uuid as can_uuid};
pub use transport::place::Place;
pub use transport::pty::Access;
pub use transport::served::{Served, served};
pub use transport::stdio::{can_use as stdio_can_use, give_back};
pub use transport::terminal_group::{CLOSED, TerminalGroup};
pub use trouble::started;

use self::core::heartbeat::Heartbeat;
use self::core::responses::LinkWake;
use self::core::start::{CoreThread, REQUESTS};
use self::core::wakeup::MarginLimits;
use self::core::{OutputState, Request};
use link::handshake::Handshake;
use link::host_end::HostEnd;
use link::oversight::Oversight;
use link::thread::{End, LinkThread};
use process::notify::{self, Notify};
use process::realtime::{Processors, Role};
use process::signals::Signals;
use process::watchdog::{Vigil, Watchdog};
use recorder::Recorder;
use status::{Facts, HostStatus, StatusSocket};
use trouble::{no_room, refused};

/// Version of the build.
pub const VERSION: &str = env!("PINION_VERSION");

/// The program's description as an MCU.
pub const FIRMWARE: Firmware = Firmware {
    features: FEATURES,
    app: "Pinion",
    version: concat!("pinion-", env!("PINION_VERSION")),
    build_versions: concat!("rustc: ", env!("PINION_COMPILER")),
    license: "GNU GPLv3",
    wire: Wire::Terminal,
};

/// How the program runs.
#[derive(Clone, Debug)]
pub struct Options {
    /// The way to the host.
    pub link: LinkName,
    /// Who may open a pseudo terminal.
    pub access: Access,
    /// Whether to ask for real-time scheduling.
    pub realtime: bool,
    /// How early the core may wake for a timer.
    pub margin: MarginLimits,
    /// The dialect to speak. `None`: the dialect of the host that comes.
    pub dialect: Option<DialectName>,
    /// The hardware watchdog to feed.
    pub watchdog: Option<PathBuf>,
    /// The only processor that the core runs on.
    pub cpu: Option<usize>,
    /// The devices whose failures are tolerated, and for how long.
    pub tolerances: Tolerances,
    /// Whether the flight recorder notes each edge of each output.
    pub trace_edges: bool,
    /// Possible paths of the status socket: the first one that works is used. Without any there is no socket.
    pub sockets: Vec<PathBuf>,
}

/// Serves a host until SIGTERM, SIGINT or SIGHUP. It calls `ready`, if anybody waits for it, once a host may come. The MCU
/// drives `board` by `timing`, and `timing` has the clock of the recording. `helpers` has the guardian of the board's
/// outputs.
///
/// It is not generic, so that it is in this crate's part of the program (`build.rs`).
#[inline(never)]
pub fn run(
    options: &Options,
    board: Box<dyn Board>,
    timing: Timing,
    recording: Recording,
    helpers: Helpers,
    ready: Option<Box<dyn FnOnce() + '_>>,
) -> Result<(), Trouble> {
    sys::return_large_blocks();
    let Helpers { guardian, search } = helpers;
    let heartbeat = guardian
        .as_ref()
        .map_or_else(|| Heartbeat::new(recording.clock()), |guardian| Ok(guardian.heartbeat()))
        .map_err(no_room)?;
    let processors = Processors::new(options.cpu)?;
    // This comes first: a process that sees the link may send a signal, and the signal must not leave the link behind.
    let signals = Signals::new().map_err(no_room)?;
    let link = options.link.open(&options.access)?;
    let notify = Notify::from_env()?;
    info!("board {}", board.describe());
    let (wake, shown) = (Arc::new(LinkWake::new().map_err(no_room)?), Arc::new(HostStatus::default()));
    shown.serve_on(link.detail());
    let dialect = options.dialect.or_else(|| (!options.link.is_local()).then_some(DialectName::Union));
    if options.dialect.is_none() && !options.link.is_local() {
        info!(
            "the host is on another computer, so its version cannot be found: it gets the union of v0.13, master and Kalico: for an older host set its dialect"
        );
    }
    let place = (link.wire(), link.terminal());
    let handshake = Handshake::start(dialect, &*board, search, place, &wake, &shown)?;
    let (snapshots, snapshot_reader) = status::ends();
    let facts = Facts {
        link: link.place(),
        board: board.describe(),
        pins: board.pins(),
        view: board.view(),
        guardian: guardian.as_ref().map(Guardian::pid),
        requests: REQUESTS,
        recorder: recording.status(),
    };
    let _status = StatusSocket::start(&options.sockets, link.terminal(), facts, shown.clone(), snapshot_reader);
    let (mut recorder, trace_writer) = Recorder::new(recording.clone()).map_err(no_room)?;
    let edges = if options.trace_edges { recorder.edges() } else { None };
    let trace_sockets = trace_socket_paths(&options.sockets);
    let trace_socket = status::open_socket(&trace_sockets, link.terminal(), |errors| {
        warn!("pinion trace --live will not be answered: {errors}");
    });
    let (realtime, margin) = (options.realtime, options.margin);
    // Later threads are in real time.
    started(pinion_linux::clock::watch_tick())?;
    if let Err(error) = sys::give_back_unused() {
        debug!("memory that only the start needed is kept: {error}");
    }
    if realtime {
        realtime::lock_memory();
    }
    let (clock, dialect) = (timing.clock.clone(), handshake.first_dialect());
    let core = CoreThread {
        board,
        edges,
        timing,
        dialect,
        tolerances: options.tolerances.clone(),
        wake,
        heartbeat,
        snapshots,
        recording,
        trace_writer,
        processors,
        margin,
        realtime,
    };
    let (core, core_end) = core.start()?;
    started(recorder.start(trace_socket))?;

    info!("{} {} ({})", transport::serving(link.event().is_some()), link.place(), link.detail());
    let vigil = Vigil::new(notify, notify::watchdog_interval(), heartbeat);
    let oversight = Oversight::new(signals, guardian.as_ref().map(Guardian::watch), vigil).map_err(no_room)?;
    let mut link = LinkThread::new(HostEnd::new(link, shown), core_end, handshake, oversight, clock, recorder);
    if realtime {
        realtime::enter(Role::Link);
    }
    // This comes last of all steps that may fail. Once open, the watchdog resets the computer unless Pinion ends in
    // order.
    let watched = match &options.watchdog {
        Some(path) => Watchdog::open(path).map(|watchdog| link.feed(watchdog)),
        None => Ok(()),
    };
    let served = watched.and_then(|()| {
        ready.into_iter().for_each(|ready| ready());
        link.run().map_err(|error| refused("the link failed, so Pinion ends", error).remedy(LOOK_AT_LOG))
    });
    end(link, core, guardian, served)
}

/// Ends the threads and processes in order. `served` is how the link ended.
fn end(
    mut link: LinkThread,
    core: JoinHandle<OutputState>,
    guardian: Option<Guardian>,
    served: Result<End, Trouble>,
) -> Result<(), Trouble> {
    link.stopping();
    link.request(Request::Quit(match served {
        Ok(End::HostOver) => Some(
            Shutdown::because(reason::HOST_LOST, "standard input has ended")
                .remedy("find out why the program that started Pinion closed it (ssh, socat)"),
        ),
        _ => None,
    }));
    let left = core.join();
    link.finish();
    let failure = match left {
        Ok(OutputState::Safe) => None,
        Ok(OutputState::Pending(output)) => Some(
            Trouble::new(format!("{output} cannot be driven to its shutdown value: the guardian tries that now"))
                .remedy("read its next line"),
        ),
        Err(_) => Some(Trouble::new("the core ended by a panic").remedy("please report it with the lines above")),
    };
    if let Some(failure) = failure {
        let _ = served.inspect_err(|trouble| error!("{trouble}"));
        // Without a goodbye the guardian drives the outputs.
        return Err(failure);
    }
    if let Some(guardian) = guardian {
        guardian.goodbye();
    }
    // After the loss of its guardian the link has already given the host time to read why.
    if matches!(served, Ok(End::Asked)) {
        link.farewell();
    }
    link.close();
    match served? {
        End::Asked | End::HostOver => Ok(()),
        End::GuardianLost => {
            Err(Trouble::new("the guardian is gone, so Pinion ends")
                .remedy("restart it (the service does so by itself)"))
        }
    }
}
