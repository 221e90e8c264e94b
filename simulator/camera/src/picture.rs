// SPDX-License-Identifier: GPL-3.0-or-later
//! The picture of a printer.

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

use crate::focus::Focus;
use crate::laid;
use crate::lens::{Lens, Room};
use crate::paint::Canvas;
use crate::panel::Panel;
use crate::scene::{Printer, Scene};

/// Width of the panel with texts beside the printer.
const PANEL: f64 = 272.0;
/// Height of the panel below the printer.
const PANEL_BELOW: f64 = 430.0;
/// Height of the line with the position.
const LINE: f64 = 44.0;
/// Free pixels around everything.
const BORDER: f64 = 8.0;
/// Longest edge of the plate in pixels. A view that is nearer shows older filament less sharp.
const PLATE_MAX: f64 = 2048.0;
/// 1 to 100.
const JPEG_QUALITY: u8 = 82;
/// A fan seems to turn this much slower than it does. Otherwise nobody would see it turn at 15 pictures a second.
const SLOW_MOTION: f64 = 30.0;

/// Where the texts are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Beside the printer: for a window that is wider than high.
    Wide,
    /// Below the printer.
    Tall,
}

impl Layout {
    /// All layouts, in the order of their numbers.
    pub const ALL: [Layout; 2] = [Layout::Wide, Layout::Tall];

    /// Pixels in a row, and rows.
    pub fn size(self) -> [u16; 2] {
        match self {
            Layout::Wide => [960, 540],
            Layout::Tall => [480, 960],
        }
    }

    /// The pixels of the printer: left, top, right and bottom.
    fn area(self) -> [f64; 4] {
        let [width, height] = self.size().map(f64::from);
        match self {
            Layout::Wide => [BORDER, BORDER, width - PANEL - BORDER, height - LINE],
            Layout::Tall => [BORDER, BORDER, width - BORDER, height - PANEL_BELOW - LINE],
        }
    }

    fn panel(self) -> Panel {
        let [width, bottom] = self.size().map(f64::from);
        let right = width - BORDER;
        match self {
            Layout::Wide => {
                let left = width - PANEL;
                Panel { left, top: 0.0, right, bottom, line_right: left - BORDER, line_bottom: bottom }
            }
            Layout::Tall => {
                let top = bottom - PANEL_BELOW;
                Panel { left: BORDER, top, right, bottom, line_right: right, line_bottom: top }
            }
        }
    }
}

/// Draws a printer.
pub struct Picture {
    printer: Printer,
    focus: Focus,
    /// All that was laid. A sheet with another view begins with a part of it.
    plate: Canvas,
    plate_lens: Lens,
    /// Indexed by the layout.
    sheets: [Sheet; 2],
    /// How far each fan has turned, in turns, and when.
    turns: Vec<f64>,
    seconds: f64,
}

/// The picture in one layout.
struct Sheet {
    layout: Layout,
    panel: Panel,
    /// The lens for the whole printer, and the present one.
    whole: Lens,
    lens: Lens,
    /// The part of the room that the present lens shows; `None` for the whole printer.
    view: Option<Room>,
    /// The parts that do not move.
    still: Canvas,
    laid: Canvas,
    canvas: Canvas,
}

impl Picture {
    /// A picture of this printer. `None` without memory for it.
    pub fn new(printer: Printer) -> Option<Picture> {
        let [one, other] = Layout::ALL.map(|layout| Sheet::new(layout, &printer));
        let (sheets, stage) = ([one?, other?], printer.stage());
        let plate_lens = sheets[0].whole.framing(&stage, [0.0, 0.0, PLATE_MAX, PLATE_MAX]);
        let plate = Canvas::new(PLATE_MAX as u32, PLATE_MAX as u32)?;
        Some(Picture { focus: Focus::new(stage), printer, plate, plate_lens, sheets, turns: Vec::new(), seconds: 0.0 })
    }

    /// Takes in what is new in the scene: what was laid, and how far the fans have turned.
    pub fn take(&mut self, scene: &Scene) {
        let elapsed_s = (scene.seconds - self.seconds).clamp(0.0, 1.0);
        self.seconds = scene.seconds;
        self.turns.resize(scene.fans.len(), 0.0);
        for (turn, fan) in self.turns.iter_mut().zip(&scene.fans) {
            *turn = (*turn + fan.rpm / 60.0 / SLOW_MOTION * elapsed_s).fract();
        }
        // Leftovers of an earlier print are not worth drawing.
        let first = scene.laid.iter().rposition(|piece| piece.begins).unwrap_or(0);
        let pieces = &scene.laid[first..];
        laid::draw(&mut self.plate, &self.plate_lens, pieces);
        for sheet in &mut self.sheets {
            laid::draw(&mut sheet.laid, &sheet.lens, pieces);
        }
        self.focus.take(pieces, scene.seconds);
    }

    /// Draws a scene that was taken in.
    pub fn draw(&mut self, scene: &Scene, layout: Layout) {
        let sheet = &mut self.sheets[layout as usize];
        let view = self.focus.view(scene.seconds);
        if view != sheet.view {
            sheet.look_at(view, &self.printer);
            let (factor, offset) = self.plate_lens.to(&sheet.lens);
            sheet.laid.take_scaled(&self.plate, factor, offset);
        }
        let canvas = &mut sheet.canvas;
        canvas.pixmap.data_mut().copy_from_slice(sheet.still.pixmap.data());
        self.printer.draw_heat(canvas, &sheet.lens, scene);
        if view.is_none() {
            self.printer.draw_lights(canvas, &sheet.lens, scene, None);
        }
        canvas.overlay(&sheet.laid);
        self.printer.draw_moving(canvas, &sheet.lens, scene, &self.turns, view.is_some());
        if view.is_some() {
            self.printer.draw_lights(canvas, &sheet.lens, scene, Some(layout.area()));
        }
        sheet.panel.draw(canvas, scene, &self.turns);
    }

    /// The last scene in a layout: red, green, blue and 255 for each pixel, rows from the top.
    pub fn pixels(&self, layout: Layout) -> &[u8] {
        self.sheets[layout as usize].canvas.pixmap.data()
    }

    /// The last scene in a layout, as a JPEG.
    pub fn jpeg(&self, layout: Layout) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(128 * 1024);
        let mut encoder = Encoder::new(&mut bytes, JPEG_QUALITY);
        encoder.set_sampling_factor(SamplingFactor::F_2_2);
        let [width, height] = layout.size();
        // It fails only if the number of pixels is wrong, and a Vec takes all bytes.
        let _ = encoder.encode(self.pixels(layout), width, height, ColorType::Rgba);
        bytes
    }
}

impl Sheet {
    fn new(layout: Layout, printer: &Printer) -> Option<Sheet> {
        let canvas = || {
            let [width, height] = layout.size().map(u32::from);
            Canvas::new(width, height)
        };
        let whole = Lens::new(&printer.room(), layout.area());
        let (still, laid, canvas) = (canvas()?, canvas()?, canvas()?);
        let (lens, panel) = (whole.clone(), layout.panel());
        let mut sheet = Sheet { layout, panel, whole, lens, view: None, still, laid, canvas };
        sheet.look_at(None, printer);
        Some(sheet)
    }

    /// Shows another part of the room, without what was laid there.
    fn look_at(&mut self, view: Option<Room>, printer: &Printer) {
        let near = view.map(|view| self.whole.framing(&view, self.layout.area()));
        self.lens = near.unwrap_or_else(|| self.whole.clone());
        self.view = view;
        self.still.backdrop([30, 35, 44], [14, 16, 20]);
        printer.draw_still(&mut self.still, &self.lens);
    }
}

#[cfg(test)]
mod tests;
