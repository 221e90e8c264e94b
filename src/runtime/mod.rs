// SPDX-License-Identifier: GPL-3.0-or-later
//! The program at work: threads, pty, real time, signals.
//!
//! ```text
//! host <-pty-> link ==ring of blocks==> core ==ring of jobs==> one worker per bus
//!                   <==ring of bytes===      <==ring of answers==
//! ```

#![forbid(unsafe_code)]

use std::io;
use std::iter;
use std::path::PathBuf;
use std::sync::Arc;
use std::thread;

use log::{error, info, warn};
use rtrb::RingBuffer;

use pinion_firmware::board::Board;
use pinion_firmware::mcu::{DialectName, Generation, Mcu};
use pinion_firmware::time::Timing;
use pinion_linux::clock::Monotonic;

mod budget;
mod core;
pub mod guardian;
pub(crate) mod helpers;
mod host;
mod ledger;
mod link;
mod lookout;
mod notify;
mod outlet;
mod pty;
mod pulse;
pub mod realtime;
mod served;
mod signals;
pub(crate) mod status;
mod survey;
pub mod wakeup;
mod watchdog;
mod workers;

pub use guardian::Guardian;
pub use helpers::Helpers;
pub use host::HostSearch;
pub use pty::Access;
pub use served::{Served, served};
pub(crate) use signals::hang_up;
pub use status::socket_paths;

use self::core::{Core, Left, Request};
use host::HostFinder;
use link::{End, Link, Parts};
use notify::Notify;
use outlet::{LinkWake, Progress};
use pty::Pty;
use pulse::Pulse;
use realtime::{Processors, Role, Scheduling};
use signals::Signals;
use status::{Facts, HostBoard, StatusSocket};
use survey::Surveyor;
use wakeup::{MarginLimits, Waiter};
use watchdog::{Vigil, Watchdog};
use workers::Threads;

/// Blocks between link and core: four times what a host may have under way.
const REQUESTS: usize = 256;

/// How the program runs.
#[derive(Clone, Debug)]
pub struct Options {
    /// Where the symbolic link to the pty stands.
    pub symlink: PathBuf,
    /// Who may open the pty.
    pub access: Access,
    /// Whether to ask for real-time scheduling.
    pub realtime: bool,
    /// How early the core may wake for a timer.
    pub margin: MarginLimits,
    /// The dialect to speak; none: that of the host that comes.
    pub dialect: Option<DialectName>,
    /// The hardware watchdog to feed.
    pub watchdog: Option<PathBuf>,
    /// The processor that the core runs on, and nowhere else.
    pub cpu: Option<usize>,
    /// Where the socket for the status stands: the first of these paths where that can be; without any there is none.
    pub sockets: Vec<PathBuf>,
}

/// Serves a host on a pty until SIGTERM, SIGINT or SIGHUP; calls `ready` once a host may come.
/// The MCU drives `board` by `timing`, whose instants are those of `clock`. `helpers` has the guardian of the board's
/// outputs.
pub fn run(
    options: &Options,
    board: Box<dyn Board>,
    timing: Timing,
    clock: Monotonic,
    helpers: Helpers,
    ready: impl FnOnce(),
) -> io::Result<()> {
    let Helpers { guardian, search } = helpers;
    let pulse = guardian.as_ref().map_or_else(|| Pulse::new(clock), |guardian| Ok(guardian.pulse()))?;
    let processors = Processors::new(options.cpu).map_err(io::Error::other)?;
    // First: who sees the link may send a signal, which must not leave the link behind.
    let signals = Signals::new()?;
    let pty = Pty::open(&options.symlink, &options.access)?;
    let notify = Notify::from_env()?;
    info!("board {}", board.describe());
    // All of them now, as the board's names are needed for them and the board becomes the core's.
    let names = match options.dialect {
        Some(name) => vec![name],
        None => iter::once(DialectName::Union).chain(Generation::ALL.map(DialectName::Of)).collect(),
    };
    let dialects = survey::dialects(&*board, &names)?;
    let clock = timing.clock.clone();
    let wake = Arc::new(LinkWake::new()?);
    let host = Arc::new(HostBoard::default());
    // Before the link is of real time, which its threads would inherit.
    let search = search.filter(|_| options.dialect.is_none());
    let finder = search.map(|search| HostFinder::start(search, pty.device(), wake.clone(), host.clone()));
    let finder = finder.map(started).transpose()?;
    let (teller, asker) = status::ends();
    let facts = Facts {
        link: options.symlink.clone(),
        device: pty.device().to_owned(),
        board: board.describe(),
        pins: board.pins(),
        view: board.view(),
        guardian: guardian.as_ref().map(Guardian::pid),
        requests: REQUESTS,
    };
    let _status = StatusSocket::start(&options.sockets, facts, host.clone(), asker);
    let surveyor = board.view().map(|view| started(Surveyor::start(view, names, wake.clone()))).transpose()?;
    let progress = Arc::new(Progress::default());
    let (outlet, inlet) = outlet::outlet(wake.clone(), progress.clone());
    let (requests, inbox) = RingBuffer::new(REQUESTS);

    // Before the core is confined to one of them.
    let may_poll = thread::available_parallelism().is_ok_and(|count| count.get() > 1);
    let (realtime, margin) = (options.realtime, options.margin);
    if realtime {
        realtime::lock_memory();
    }
    let (core_dialect, core_clock) = (dialects[0].clone(), clock.clone());
    let (core_progress, core_wake) = (progress.clone(), wake.clone());
    let core = started(thread::Builder::new().name("core".into()).spawn(move || {
        if let Err(error) = processors.confine() {
            warn!("--cpu: the core is not bound to its processor: {error}: it runs on any; choose another processor");
        }
        let scheduling = if realtime { realtime::enter(Role::Core) } else { Scheduling::Ordinary };
        let prepare = Arc::new(move || {
            // A thread inherits the processors of the one that starts it.
            processors.free();
            if realtime {
                realtime::enter(Role::Worker);
            }
        });
        let workers = Box::new(Threads::new(thread::current(), prepare, core_clock.clone(), pulse, may_poll));
        let mcu = Mcu::new(core_dialect, board, timing, workers, Box::new(outlet));
        let waiter = Waiter::new(core_clock.clone(), margin, scheduling, processors);
        Core::new(self::core::Parts {
            mcu,
            clock: core_clock,
            requests: inbox,
            waiter,
            pulse,
            progress: core_progress,
            wake: core_wake,
            teller,
            may_poll,
        })
        .run()
    }))?;

    info!("serving on {} ({})", options.symlink.display(), pty.device().display());
    let mut link = Link::new(Parts {
        pty,
        clock,
        dialects,
        finder,
        host,
        surveyor,
        requests,
        core: core.thread().clone(),
        inlet,
        progress,
        wake,
        signals,
        guardian: guardian.as_ref().map(Guardian::watch),
        vigil: Vigil::new(notify, notify::watchdog_interval(), pulse),
        may_poll,
    });
    if realtime {
        realtime::enter(Role::Link);
    }
    // Last of what may fail: once open it resets the machine, unless we end in order.
    let watched = match &options.watchdog {
        Some(path) => Watchdog::open(path).map(|watchdog| link.feed(watchdog)),
        None => Ok(()),
    };
    let served = watched.and_then(|()| {
        ready();
        link.run()
            .inspect_err(|error| error!("the terminal failed: {error}: Pinion ends; look at the kernel's log (dmesg)"))
    });
    link.stopping();
    link.request(Request::Quit);
    let left = core.join();
    link.finish();
    // Without a goodbye the guardian drives the outputs.
    match left {
        Ok(Left::Safe) => {}
        Ok(Left::Owing(debtor)) => {
            return Err(io::Error::other(format!(
                "{debtor} can not be driven to its shutdown value: the guardian tries that now"
            )));
        }
        Err(_) => return Err(io::Error::other("the core ended by a panic: please report it with the lines above")),
    }
    if let Some(guardian) = guardian {
        guardian.goodbye();
    }
    // With its guardian lost it has taken leave already.
    if matches!(served, Ok(End::Asked)) {
        link.farewell();
    }
    link.close().end();
    match served? {
        End::Asked => Ok(()),
        End::GuardianLost => {
            Err(io::Error::other("the guardian is gone: Pinion ends; start it anew, as the service does by itself"))
        }
    }
}

/// Says of a thread that can not be started what would permit one more.
fn started<T>(thread: io::Result<T>) -> io::Result<T> {
    thread.map_err(|error| {
        io::Error::new(error.kind(), format!("no thread can be started: {error}: raise TasksMax or ulimit -u"))
    })
}
