// SPDX-License-Identifier: GPL-3.0-or-later
//! The status of the MCU that this program serves, for what it shows to people. The program asks its own socket, as
//! `pinion status` does. So nothing of the MCU's runtime is shared, and the core is never made to wait.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use pinion_linux::foreign::plain;
use pinion_runtime::status::form::{State, Status};

use pinion::cli::status::ask_at;

/// Time between two questions.
const PERIOD: Duration = Duration::from_millis(300);

/// The facts of the last answer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Facts {
    stop: Option<String>,
    host: Option<u32>,
}

/// The status of this program's MCU, a moment ago.
#[derive(Clone, Default)]
pub(crate) struct OwnStatus(Arc<Mutex<Facts>>);

impl OwnStatus {
    /// Asks from now on at these paths. Call it before this thread runs in real time: a thread passes that on.
    pub(crate) fn start(paths: Vec<PathBuf>, link: &Path) -> io::Result<OwnStatus> {
        let own = OwnStatus::default();
        let (asker, link) = (own.clone(), link.to_owned());
        thread::Builder::new().name("own status".into()).spawn(move || {
            loop {
                // At the start and at the end nobody answers. A busy core does not change what is known.
                match ask_at(&paths, &link).map(|answer| answer.status) {
                    // Another instance has the socket.
                    Ok(status) if status.pid != std::process::id() => {}
                    Ok(status) if status.state == State::Unknown => {}
                    Ok(status) => asker.set(facts(status)),
                    Err(error) => log::debug!("the status for people: {error}"),
                }
                thread::sleep(PERIOD);
            }
        })?;
        Ok(own)
    }

    /// The host's process.
    pub(crate) fn set_host(&self, pid: u32) {
        self.set(Facts { stop: None, host: Some(pid) });
    }

    fn set(&self, facts: Facts) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = facts;
    }

    fn facts(&self) -> Facts {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The host's text for why the MCU is shut down. `None` while it is not.
    pub(crate) fn stop(&self) -> Option<String> {
        self.facts().stop
    }

    /// The host's process, if it is known.
    pub(crate) fn host(&self) -> Option<u32> {
        self.facts().host
    }
}

fn facts(status: Status) -> Facts {
    let stop = status.mcu.and_then(|mcu| mcu.shutdown).map(|stop| plain(&stop.reason).into_owned());
    Facts { stop, host: status.host.pid }
}
