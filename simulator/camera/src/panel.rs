// SPDX-License-Identifier: GPL-3.0-or-later
//! The panel beside the printer: displays, temperatures, fans, lights, the position, lost steps.

use crate::laid::{FASTEST_MM_PER_S, SPEEDS};
use crate::machine::LOST;
use crate::paint::{Canvas, Font, mix};
use crate::scene::{Display, Pin, Probe, Rgb, Scene};

const TEXT: Rgb = [222, 228, 238];
const FAINT: Rgb = [138, 148, 166];
const CARD: Rgb = [14, 16, 21];
const HOT: Rgb = [255, 120, 56];
const COLD: Rgb = [86, 156, 255];
const PIXEL: Rgb = [140, 214, 255];
const GLASS: Rgb = [10, 14, 22];
/// The mark of a push-pin that is out.
pub const OUT: Rgb = [90, 240, 120];
const ROW: f64 = 21.0;
/// The hottest temperature that a bar shows.
const FULL_CELSIUS: f64 = 300.0;
/// The word for an MCU that is shut down.
const SHUTDOWN: &str = "SHUTDOWN";
/// Largest picture of a display, in pixels.
const DISPLAY_MAX: f64 = 256.0;

/// Where the texts are: the column of the cards, and the line with the position.
pub struct Panel {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
    /// The end of the line with the position, and its lower edge. It begins at the left of the picture.
    pub line_right: f64,
    pub line_bottom: f64,
}

impl Panel {
    /// Where a display's pixel is: its left upper corner, and its size. The first display is at the top.
    pub fn pixel(&self, display: &Display, x: usize, y: usize) -> ([f64; 2], f64) {
        let size = (DISPLAY_MAX / display.width.max(1) as f64).floor().max(1.0);
        let left = (self.left + self.right - size * display.width as f64) / 2.0;
        ([left + size * x as f64, self.top + 16.0 + size * y as f64], size)
    }

    pub fn draw(&self, canvas: &mut Canvas, scene: &Scene, turns: &[f64]) {
        let mut y = self.top + 8.0;
        if let Some(display) = scene.displays.first() {
            y = self.draw_display(canvas, display) + 10.0;
        }
        let mut rows = Rows { canvas, panel: self, y };
        rows.heaters(scene);
        rows.fans(scene, turns);
        rows.lamps(scene);
        rows.parts(scene);
        self.draw_position(canvas, scene);
    }

    fn draw_display(&self, canvas: &mut Canvas, display: &Display) -> f64 {
        let rows = display.pixels.len() / display.width.max(1);
        let ([left, top], size) = self.pixel(display, 0, 0);
        let (width, height) = (size * display.width as f64, size * rows as f64);
        canvas.card([left - 8.0, top - 8.0, width + 16.0, height + 16.0], 6.0, [36, 40, 48], 1.0);
        canvas.rectangle([left, top, width, height], GLASS, 1.0);
        for (row, pixels) in display.pixels.chunks(display.width.max(1)).enumerate() {
            // Bright pixels side by side are one rectangle.
            let mut column = 0;
            for run in pixels.chunk_by(|a, b| a == b) {
                if run[0] {
                    let ([x, y], _) = self.pixel(display, column, row);
                    canvas.rectangle([x, y, size * run.len() as f64, size], PIXEL, 1.0);
                }
                column += run.len();
            }
        }
        top + height + 8.0
    }

    fn draw_position(&self, canvas: &mut Canvas, scene: &Scene) {
        let [x, y, z] = scene.nozzle_mm;
        let mut at = [14.0, self.line_bottom - 38.0];
        let width = 30.0 * Font::Large.advance() + 20.0;
        canvas.card([6.0, at[1] - 5.0, width, 34.0], 6.0, CARD, 0.72);
        for (name, mm, color) in [("X", x, [236, 100, 90]), ("Y", y, [104, 214, 118]), ("Z", z, COLD)] {
            canvas.text(at, Font::Large, color, name);
            at[0] += 1.5 * Font::Large.advance();
            canvas.text(at, Font::Large, TEXT, &format!("{:>7}", two_digits(mm)));
            at[0] += 8.5 * Font::Large.advance();
        }
        // The colors of the filament.
        let (left, top, right) = (width + 24.0, self.line_bottom - 22.0, self.line_right);
        if right > left + 60.0 {
            canvas.scale([left, top + 8.0, right - left, 6.0], &SPEEDS);
            canvas.text([left, top - 10.0], Font::Small, FAINT, "0");
            let fastest = format!("{FASTEST_MM_PER_S:.0} mm/s");
            canvas.text(
                [right - fastest.len() as f64 * Font::Small.advance(), top - 10.0],
                Font::Small,
                FAINT,
                &fastest,
            );
        }
        let stop = scene.is_shut_down.then(|| SHUTDOWN.to_owned());
        let lost = scene.axes.iter().filter(|axis| axis.lost_steps > 0).take(6);
        let lost = lost.map(|axis| format!("{}: {} steps lost", axis.name, axis.lost_steps));
        let mut top = 14.0;
        for text in stop.into_iter().chain(lost) {
            canvas.card(
                [8.0, top - 5.0, 20.0 + text.chars().count() as f64 * Font::Large.advance(), 34.0],
                6.0,
                CARD,
                0.8,
            );
            canvas.text([16.0, top], Font::Large, LOST, &text);
            top += 38.0;
        }
    }
}

/// A number with two digits after the point, and never "-0.00".
fn two_digits(mm: f64) -> String {
    format!("{:.2}", (mm * 100.0).round() / 100.0 + 0.0)
}

struct Rows<'a> {
    canvas: &'a mut Canvas,
    panel: &'a Panel,
    y: f64,
}

impl Rows<'_> {
    /// A card with this many rows, and the top of the first one. Rows below the picture are left out.
    fn card(&mut self, count: usize) -> Option<f64> {
        let height = ROW * count as f64 + 10.0;
        if count == 0 || self.y + height > self.panel.bottom {
            return None;
        }
        self.canvas.card([self.panel.left, self.y, self.panel.right - self.panel.left, height], 6.0, CARD, 0.72);
        let top = self.y + 5.0;
        self.y += height + 8.0;
        Some(top)
    }

    /// A name at the left and a value at the right. A name that is too long is cut off.
    fn text(&mut self, y: f64, name: &str, value: &str, color: Rgb) {
        let (left, advance) = (self.panel.left + 28.0, Font::Small.advance());
        let x = self.panel.right - 10.0 - value.chars().count() as f64 * advance;
        let name: String = name.chars().take(((x - left) / advance - 1.0).max(0.0) as usize).collect();
        self.canvas.text([left, y + 2.0], Font::Small, FAINT, &name);
        self.canvas.text([x, y + 2.0], Font::Small, color, value);
    }

    fn heaters(&mut self, scene: &Scene) {
        let Some(top) = self.card(scene.heaters.len().min(8)) else { return };
        for (heater, row) in scene.heaters.iter().take(8).zip(0i32..) {
            let y = top + ROW * f64::from(row);
            let part = (heater.celsius / FULL_CELSIUS).clamp(0.0, 1.0);
            let color = mix(COLD, HOT, part * 1.6);
            let left = self.panel.left;
            self.canvas.circle([left + 15.0, y + ROW / 2.0], 5.0, if heater.on { HOT } else { [58, 64, 76] }, 1.0);
            let target = heater.target_celsius.map_or(String::new(), |target| format!(" / {target:.0}"));
            self.text(y, &heater.name, &format!("{:.1}{target} \u{b0}C", heater.celsius), color);
            let width = self.panel.right - left - 38.0;
            self.canvas.rectangle([left + 28.0, y + ROW - 3.0, width, 2.0], [44, 49, 60], 1.0);
            self.canvas.rectangle([left + 28.0, y + ROW - 3.0, width * part, 2.0], color, 1.0);
        }
    }

    fn fans(&mut self, scene: &Scene, turns: &[f64]) {
        let Some(top) = self.card(scene.fans.len().min(6)) else { return };
        for ((fan, turn), row) in scene.fans.iter().zip(turns).take(6).zip(0i32..) {
            let y = top + ROW * f64::from(row);
            let [mx, my] = [self.panel.left + 15.0, y + ROW / 2.0];
            for blade in 0..4 {
                let at = |turn: f64, radius: f64| {
                    let (sin, cos) = (turn * std::f64::consts::TAU).sin_cos();
                    [mx + radius * cos, my + radius * sin]
                };
                let turn = turn + f64::from(blade) / 4.0;
                let color = if fan.rpm >= 1.0 { TEXT } else { FAINT };
                self.canvas.polygon([[mx, my], at(turn - 0.06, 8.0), at(turn + 0.08, 8.0)], color, 1.0);
            }
            self.text(y, &fan.name, &format!("{:.0} rpm", fan.rpm), TEXT);
        }
    }

    fn lamps(&mut self, scene: &Scene) {
        let Some(top) = self.card(scene.lamps.len().min(6)) else { return };
        for (lamp, row) in scene.lamps.iter().take(6).zip(0i32..) {
            let y = top + ROW * f64::from(row);
            let place = [self.panel.left + 15.0, y + ROW / 2.0];
            self.canvas.circle(place, 5.0, [40, 44, 54], 1.0);
            if lamp.brightness > 0.0 {
                self.canvas.glow(place, 16.0, lamp.color, 0.7 * lamp.brightness);
                self.canvas.circle(place, 5.0, lamp.color, lamp.brightness);
            }
            let text = if lamp.brightness > 0.0 { format!("{:.0} %", 100.0 * lamp.brightness) } else { "off".into() };
            self.text(y, &lamp.name, &text, TEXT);
        }
    }

    fn parts(&mut self, scene: &Scene) {
        let pins: Vec<(&Probe, Pin)> = scene.probes.iter().filter_map(|probe| Some((probe, probe.pin?))).collect();
        let Some(top) = self.card((scene.servos.len() + pins.len()).min(6)) else { return };
        let mut row = 0..6;
        for (servo, row) in scene.servos.iter().zip(&mut row) {
            let y = top + ROW * f64::from(row);
            let [mx, my] = [self.panel.left + 15.0, y + ROW / 2.0 + 3.0];
            let (sin, cos) = servo.degrees.to_radians().sin_cos();
            self.canvas.circle([mx, my], 4.0, [70, 76, 88], 1.0);
            self.canvas.line([[mx, my], [mx - 9.0 * cos, my - 9.0 * sin]], 2.5, TEXT, 1.0);
            self.text(y, &servo.name, &format!("{:.0}\u{b0}", servo.degrees), TEXT);
        }
        for ((probe, pin), row) in pins.into_iter().zip(&mut row) {
            let y = top + ROW * f64::from(row);
            let (color, text) = match pin {
                Pin::In => ([70, 76, 88], "in"),
                Pin::Out => (OUT, "out"),
                Pin::Alarm => (LOST, "alarm"),
            };
            self.canvas.circle([self.panel.left + 15.0, y + ROW / 2.0], 5.0, color, 1.0);
            self.text(y, &probe.name, text, TEXT);
        }
    }
}
