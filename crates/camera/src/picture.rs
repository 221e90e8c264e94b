// SPDX-License-Identifier: GPL-3.0-or-later
//! The picture of a printer.

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

use crate::laid;
use crate::lens::Lens;
use crate::paint::Canvas;
use crate::panel::Panel;
use crate::scene::{Printer, Scene};

/// Pixels in a row, and rows.
pub const WIDTH: u16 = 736;
/// Rows of pixels.
pub const HEIGHT: u16 = 552;
/// Width of the panel with texts, on the right.
const PANEL: f64 = 272.0;
/// Free pixels around everything.
const BORDER: f64 = 8.0;
/// 1 to 100.
const JPEG_QUALITY: u8 = 82;
/// A fan seems to turn this much slower than it does. Otherwise nobody would see it turn at 15 pictures a second.
const SLOW_MOTION: f64 = 30.0;

/// Draws a printer.
pub struct Picture {
    printer: Printer,
    lens: Lens,
    panel: Panel,
    /// What stands still.
    still: Canvas,
    laid: Canvas,
    canvas: Canvas,
    /// How far each fan has turned, in turns, and when.
    turns: Vec<f64>,
    seconds: f64,
}

impl Picture {
    /// A picture of this printer. `None` without memory for it.
    pub fn new(printer: Printer) -> Option<Picture> {
        let (width, height) = (f64::from(WIDTH), f64::from(HEIGHT));
        let canvas = || Canvas::new(WIDTH.into(), HEIGHT.into());
        let lens = Lens::new(&printer.stage(), [BORDER, BORDER, width - PANEL - BORDER, height - 44.0]);
        let mut still = canvas()?;
        still.backdrop([30, 35, 44], [14, 16, 20]);
        printer.draw_still(&mut still, &lens);
        let panel = Panel { left: width - PANEL, right: width - BORDER, bottom: height };
        let (laid, canvas) = (canvas()?, canvas()?);
        Some(Picture { printer, lens, panel, still, laid, canvas, turns: Vec::new(), seconds: 0.0 })
    }

    /// Draws the scene over the last one.
    pub fn draw(&mut self, scene: &Scene) {
        let elapsed_s = (scene.seconds - self.seconds).clamp(0.0, 1.0);
        self.seconds = scene.seconds;
        self.turns.resize(scene.fans.len(), 0.0);
        for (turn, fan) in self.turns.iter_mut().zip(&scene.fans) {
            *turn = (*turn + fan.rpm / 60.0 / SLOW_MOTION * elapsed_s).fract();
        }
        self.lay(scene);
        let canvas = &mut self.canvas;
        canvas.pixmap.data_mut().copy_from_slice(self.still.pixmap.data());
        self.printer.draw_heat(canvas, &self.lens, scene);
        self.printer.draw_lights(canvas, &self.lens, scene);
        canvas.overlay(&self.laid);
        self.printer.draw_moving(canvas, &self.lens, scene, &self.turns);
        self.panel.draw(canvas, scene, &self.turns);
    }

    /// Draws only what was laid since the last scene. The next picture shows it.
    pub fn lay(&mut self, scene: &Scene) {
        laid::draw(&mut self.laid, &self.lens, &scene.laid);
    }

    /// The last scene: red, green, blue and 255 for each pixel, rows from the top.
    pub fn pixels(&self) -> &[u8] {
        self.canvas.pixmap.data()
    }

    /// The last scene as a JPEG.
    pub fn jpeg(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(128 * 1024);
        let mut encoder = Encoder::new(&mut bytes, JPEG_QUALITY);
        encoder.set_sampling_factor(SamplingFactor::F_2_2);
        // It fails only if the number of pixels is wrong, and a Vec takes all bytes.
        let _ = encoder.encode(self.pixels(), WIDTH, HEIGHT, ColorType::Rgba);
        bytes
    }
}

#[cfg(test)]
mod tests;
