// SPDX-License-Identifier: GPL-3.0-or-later
//! The dock of a probe that the head takes up and leaves there, as a Klicky.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::rail::Rail;

/// How near the head has to come.
const NEAR_MM: f64 = 0.6;
/// How far the head has to go before it can come again.
const AWAY_MM: f64 = 3.0;

/// The head takes the probe up when it comes there, and leaves it there when it comes the next time.
#[derive(Debug)]
pub(crate) struct Dock {
    pub(crate) x: Arc<Rail>,
    pub(crate) y: Arc<Rail>,
    /// Where the nozzle is then.
    pub(crate) place_mm: [f64; 2],
    is_there: AtomicBool,
    has_probe: AtomicBool,
}

impl Dock {
    pub(crate) fn new(x: Arc<Rail>, y: Arc<Rail>, place_mm: [f64; 2]) -> Dock {
        Dock { x, y, place_mm, is_there: AtomicBool::new(false), has_probe: AtomicBool::new(true) }
    }

    /// Whether the probe is in the dock.
    pub(crate) fn has_probe(&self) -> bool {
        self.has_probe.load(Ordering::Relaxed)
    }

    /// Whether the head is there.
    pub(crate) fn is_there(&self) -> bool {
        self.is_there.load(Ordering::Relaxed)
    }

    /// The head has moved.
    pub(crate) fn passed(&self) {
        let [x_mm, y_mm] = self.place_mm;
        let far_mm = (self.x.position_mm() - x_mm).hypot(self.y.position_mm() - y_mm);
        let was_there = self.is_there();
        if !was_there && far_mm <= NEAR_MM {
            self.is_there.store(true, Ordering::Relaxed);
            self.has_probe.fetch_xor(true, Ordering::Relaxed);
        } else if was_there && far_mm >= AWAY_MM {
            self.is_there.store(false, Ordering::Relaxed);
        }
    }
}
