// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim PRINTER.CFG --speed N`: a klippy on the simulated printer in one clock, at N times the pace of real time, for
//! Mainsail, Fluidd and the camera. A computer that cannot keep that pace is slower, and nothing is late.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use pinion::page::Page;
use pinion_host::{NoStart, Stop, Time};
use pinion_printer_config::Trouble;

use super::report::show;
use super::{Attempt, Host, Watching};
use crate::own::serve::Folder;
use crate::own_status::OwnStatus;

/// Time between two looks whether klippy is still there.
const LOOK: Duration = Duration::from_millis(200);

/// Serves until the program is asked to end. Returns whether klippy stayed until then, or nothing if it takes no part in
/// the printer's clock. `shown` gets klippy's process, for the camera.
///
/// # Errors
///
/// klippy does not start.
pub(crate) fn run(
    attempt: &Attempt,
    (folder, printer): (&Folder, &Path),
    (time, watching): (Time, Watching),
    shown: &OwnStatus,
    ended: &AtomicBool,
) -> Result<Option<bool>, Trouble> {
    let mut host = match Host::start(attempt.launch(folder), time, watching) {
        Ok(host) => host,
        Err(NoStart::Alone) => return Ok(None),
        Err(NoStart::Trouble(trouble)) => return Err(trouble),
    };
    shown.set_host(host.pid());
    let mut page = Page::default();
    page.line(format_args!("klippy runs {}. Ctrl-C ends it.", printer.display()));
    page.line(format_args!("  its API, for Moonraker: {}", folder.path.join("klippy.sock").display()));
    page.line(format_args!("  its log: {}", folder.path.join("klippy.log").display()));
    show(&page);
    while !ended.load(Ordering::SeqCst) {
        let passed = host.sleep(LOOK);
        if ended.load(Ordering::SeqCst) {
            break;
        }
        if passed.is_err() || !host.is_there() {
            let why = passed.err().unwrap_or(Stop::Ended);
            log::error!("klippy takes no more turns: {why}: read {}", folder.path.join("klippy.log").display());
            return Ok(Some(false));
        }
    }
    Ok(Some(true))
}
