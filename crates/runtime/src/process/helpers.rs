// SPDX-License-Identifier: GPL-3.0-or-later
//! The program's other processes: the guardian, and the search for the host. Both are forked before the program has
//! threads, because a process with threads cannot be forked.

use std::ffi::CStr;
use std::fs;

use log::warn;

use pinion_firmware::trouble::Trouble;
use pinion_linux::sys;

use crate::guardian::{self, Guardian};
use crate::host::search::{self, HostSearch};
use crate::recorder::Recording;

/// When memory is short, the kernel kills the program before the guardian, and after every other process. The memory of
/// a killed program is locked and does not become free at once, so the kernel would kill the guardian, too.
const OOM_SCORE: i32 = -900;

/// The kernel's names of these processes. Their command lines are the program's.
pub const NAMES: [&CStr; 2] = [guardian::NAME, search::NAME];

/// The program's helper processes.
#[derive(Default)]
pub struct Helpers {
    /// It guards the board's outputs.
    pub guardian: Option<Guardian>,
    /// Without it every host is served in the dialect that most hosts accept.
    pub search: Option<HostSearch>,
}

impl Helpers {
    /// Forks them, then gives up the rights that this process does not need. Call it before any thread starts.
    /// `guarded` asks for a guardian. `rights` are the capabilities that this process keeps, if it has them.
    ///
    /// # Errors
    ///
    /// There are threads already, or the kernel has no room for a process, a socket or a page.
    pub fn start(recording: &Recording, guarded: bool, searches: bool, rights: u32) -> Result<Helpers, Trouble> {
        // Each of them would keep a copy. Pages of files are not copied.
        sys::trim_heap();
        // The search comes first, because it must share nothing with the guardian.
        let search = searches.then(HostSearch::start).transpose()?;
        let guardian = guarded.then(|| Guardian::start(recording)).transpose()?;
        rank_before_guardian();
        if let Err(error) = sys::keep_only(rights) {
            warn!(
                "CAP_SYS_PTRACE and CAP_DAC_READ_SEARCH cannot be given up: {error}: Pinion keeps more rights than it needs"
            );
        }
        Ok(Helpers { guardian, search })
    }
}

/// The service starts with the guardian's score, because only root may lower one. Without the service nothing changes.
fn rank_before_guardian() {
    const SCORE: &str = "/proc/self/oom_score_adj";
    let score = fs::read_to_string(SCORE).ok().and_then(|score| score.trim().parse::<i32>().ok());
    if score.is_some_and(|score| score < OOM_SCORE) {
        let _ = fs::write(SCORE, OOM_SCORE.to_string());
    }
}
