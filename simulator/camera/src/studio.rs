// SPDX-License-Identifier: GPL-3.0-or-later
//! Frames on demand. One thread draws, and only while somebody waits for a frame. Everybody who waits for a layout gets
//! the same frame.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use crate::picture::{Layout, Picture};
use crate::scene::Scene;

/// Time from a frame to the next: 15 frames a second.
pub const PERIOD: Duration = Duration::from_micros(1_000_000 / 15);
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

/// The frames of a layout.
#[derive(Default)]
struct Reel {
    last: Option<Arc<Frame>>,
    /// Whether somebody waits for the next frame.
    is_wanted: bool,
}

impl Reel {
    fn after(&self, number: u64) -> Option<Arc<Frame>> {
        self.last.clone().filter(|newest| newest.number > number)
    }
}

#[derive(Default)]
struct State {
    /// Indexed by the layout.
    reels: [Reel; 2],
    /// When the last frame was drawn.
    drawn: Option<Instant>,
}

impl State {
    fn is_wanted(&self) -> bool {
        self.reels.iter().any(|reel| reel.is_wanted)
    }
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

    /// The first frame after `last`. Without `last` it is the newest one, unless that is old. A frame takes milliseconds,
    /// and any time on a busy computer.
    pub fn next(&self, layout: Layout, last: Option<&Frame>) -> Arc<Frame> {
        let mut state = self.state();
        let after = match (last, &state.reels[layout as usize].last) {
            (Some(last), _) => last.number,
            (None, Some(newest)) if newest.drawn.elapsed() > PERIOD => newest.number,
            (None, _) => 0,
        };
        loop {
            let reel = &mut state.reels[layout as usize];
            if let Some(frame) = reel.after(after) {
                return frame;
            }
            reel.is_wanted = true;
            self.wanted.notify_one();
            state = self.drawn.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Draws each frame that somebody waits for. `look` returns the scene to draw.
    pub fn draw(&self, mut picture: Picture, mut look: impl FnMut() -> Scene) {
        for number in 1.. {
            let next = loop {
                let waited = self.wanted.wait_timeout_while(self.state(), LAYING_PERIOD, |state| !state.is_wanted());
                let (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
                if state.is_wanted() {
                    break state.drawn.map(|drawn| drawn + PERIOD);
                }
                drop(state);
                picture.take(&look());
            };
            if let Some(wait) = next.and_then(|next| next.checked_duration_since(Instant::now())) {
                thread::sleep(wait);
            }
            let (drawn, time) = (Instant::now(), SystemTime::now());
            let wanted = {
                let mut state = self.state();
                state.drawn = Some(drawn);
                Layout::ALL.map(|layout| std::mem::take(&mut state.reels[layout as usize].is_wanted))
            };
            let scene = look();
            picture.take(&scene);
            for layout in Layout::ALL.into_iter().filter(|layout| wanted[*layout as usize]) {
                picture.draw(&scene, layout);
                let frame = Frame { number, drawn, time, jpeg: picture.jpeg(layout) };
                self.state().reels[layout as usize].last = Some(Arc::new(frame));
            }
            self.drawn.notify_all();
        }
    }
}
