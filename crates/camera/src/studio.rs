// SPDX-License-Identifier: GPL-3.0-or-later
//! Frames on demand. One thread draws, and only while somebody waits for a frame. Everybody who waits gets the same one.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use crate::picture::Picture;
use crate::scene::Scene;

/// Time from a frame to the next: 15 frames a second.
pub const PERIOD: Duration = Duration::from_micros(1_000_000 / 15);
/// Longest wait for a frame. A frame takes milliseconds.
const WAIT_MAX: Duration = Duration::from_secs(10);
/// While nobody looks, what was laid is drawn after this time, and nothing else. So it never becomes much.
const LAYING_PERIOD: Duration = Duration::from_secs(60);

/// A picture at one instant.
pub struct Frame {
    number: u64,
    drawn: Instant,
    /// When it was drawn.
    pub time: SystemTime,
    /// The picture.
    pub jpeg: Vec<u8>,
}

#[derive(Default)]
struct State {
    last: Option<Arc<Frame>>,
    /// Whether somebody waits for the next frame.
    is_wanted: bool,
}

/// Where viewers wait for frames.
#[derive(Default)]
pub struct Studio {
    state: Mutex<State>,
    wanted: Condvar,
    drawn: Condvar,
}

impl Studio {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The first frame after `last`. Without `last` it is the newest one, unless that is old. `None` if no frame comes.
    pub fn next(&self, last: Option<&Frame>) -> Option<Arc<Frame>> {
        let mut state = self.state();
        let after = match (last, &state.last) {
            (Some(last), _) => last.number,
            (None, Some(newest)) if newest.drawn.elapsed() > PERIOD => newest.number,
            (None, _) => 0,
        };
        let is_old = |state: &State| state.last.as_ref().is_none_or(|newest| newest.number <= after);
        if is_old(&state) {
            state.is_wanted = true;
            self.wanted.notify_one();
        }
        let waited = self.drawn.wait_timeout_while(state, WAIT_MAX, |state| is_old(state));
        let (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        state.last.clone().filter(|newest| newest.number > after)
    }

    /// Draws each frame that somebody waits for. `look` tells what there is to draw.
    pub fn draw(&self, mut picture: Picture, mut look: impl FnMut() -> Scene) {
        for number in 1.. {
            let next = loop {
                let waited = self.wanted.wait_timeout_while(self.state(), LAYING_PERIOD, |state| !state.is_wanted);
                let (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
                if state.is_wanted {
                    break state.last.as_ref().map(|last| last.drawn + PERIOD);
                }
                drop(state);
                picture.lay(&look());
            };
            if let Some(wait) = next.and_then(|next| next.checked_duration_since(Instant::now())) {
                thread::sleep(wait);
            }
            self.state().is_wanted = false;
            let (drawn, time) = (Instant::now(), SystemTime::now());
            picture.draw(&look());
            let frame = Frame { number, drawn, time, jpeg: picture.jpeg() };
            self.state().last = Some(Arc::new(frame));
            self.drawn.notify_all();
        }
    }
}
