// SPDX-License-Identifier: GPL-3.0-or-later
//! Watches a printer while klippy runs: the nozzle's path, the speed of the motors, and the line of progress.

use std::time::Duration;

use pinion_host::Watch;
use pinion_model::{PaceWatch, Recorder, SimProbe};

use super::report::{Form, Progress};

/// A klippy whose printer is looked at.
pub(crate) type Host = pinion_host::Host<Watching>;

/// Is called while the printer's time passes.
pub(crate) struct Watching {
    /// Records the nozzle's path.
    pub(super) recorder: Option<Recorder>,
    /// Watches how fast the motors are.
    pub(super) paces: Option<PaceWatch>,
    pub(super) progress: Progress,
    /// Reads the path for `--toolpath`.
    toolpath: Option<Box<dyn FnMut()>>,
    probe: SimProbe,
}

impl Watching {
    pub(crate) fn new(form: Form, probe: SimProbe, toolpath: Option<Box<dyn FnMut()>>) -> Watching {
        Watching { recorder: None, paces: None, progress: Progress::new(form), toolpath, probe }
    }
}

impl Watch for Watching {
    fn look(&mut self, now: Duration) {
        let of_probe = self.probe.now();
        self.recorder.iter_mut().for_each(|recorder| recorder.read(of_probe));
        self.paces.iter_mut().for_each(|paces| paces.read(of_probe));
        self.toolpath.iter_mut().for_each(|read| read());
        self.progress.show(now);
    }
}
