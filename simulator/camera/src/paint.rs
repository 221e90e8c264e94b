// SPDX-License-Identifier: GPL-3.0-or-later
//! Drawing: shapes and text on pixels.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use tiny_skia::{
    BlendMode, Color, FillRule, FilterQuality, GradientStop, LineCap, LinearGradient, Paint, Path, PathBuilder, Pixmap,
    PixmapPaint, Point as Pixel, PremultipliedColorU8, RadialGradient, Rect, Shader, SpreadMode, Stroke, Transform,
};

use crate::lens::{Lens, Point, Room};
use crate::scene::Rgb;

/// A color between two: `part` is 0 for the first and 1 for the second.
pub fn mix(from: Rgb, to: Rgb, part: f64) -> Rgb {
    let part = part.clamp(0.0, 1.0);
    [0, 1, 2].map(|i| (f64::from(from[i]) + (f64::from(to[i]) - f64::from(from[i])) * part).round() as u8)
}

/// A color in more or less light.
pub fn lit(color: Rgb, light: f64) -> Rgb {
    color.map(|part| (f64::from(part) * light).round().clamp(0.0, 255.0) as u8)
}

/// How bright the faces of a solid are: its top, its front and its sides.
const TOP: f64 = 1.0;
const FRONT: f64 = 0.74;
const SIDE: f64 = 0.5;

/// The size of a text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Font {
    Small,
    Large,
}

impl Font {
    fn weight_and_height(self) -> (FontWeight, RasterHeight) {
        match self {
            Font::Small => (FontWeight::Regular, RasterHeight::Size16),
            Font::Large => (FontWeight::Bold, RasterHeight::Size24),
        }
    }

    /// Pixels from a character to the next.
    pub fn advance(self) -> f64 {
        let (weight, height) = self.weight_and_height();
        get_raster_width(weight, height) as f64
    }
}

/// Pixels, and how shapes come onto them.
pub struct Canvas {
    pub pixmap: Pixmap,
    /// The remaining opacity of each shape, 0 to 1. Texts and rectangles keep theirs.
    pub opacity: f64,
}

fn paint(color: Rgb, alpha: f64) -> Paint<'static> {
    let [r, g, b] = color;
    let mut paint = Paint::default();
    paint.set_color_rgba8(r, g, b, (alpha.clamp(0.0, 1.0) * 255.0).round() as u8);
    paint
}

fn color(rgb: Rgb, alpha: f64) -> Color {
    let [r, g, b] = rgb;
    Color::from_rgba8(r, g, b, (alpha.clamp(0.0, 1.0) * 255.0).round() as u8)
}

fn pixel([x, y]: [f64; 2]) -> Pixel {
    Pixel::from_xy(x as f32, y as f32)
}

fn outline(points: impl IntoIterator<Item = [f64; 2]>, close: bool) -> Option<Path> {
    let mut path = PathBuilder::new();
    for point in points {
        let Pixel { x, y } = pixel(point);
        if path.is_empty() { path.move_to(x, y) } else { path.line_to(x, y) }
    }
    if close {
        path.close();
    }
    path.finish()
}

impl Canvas {
    /// `None` without a pixel.
    pub fn new(width: u32, height: u32) -> Option<Canvas> {
        Pixmap::new(width, height).map(|pixmap| Canvas { pixmap, opacity: 1.0 })
    }

    /// A convex or other outline, filled.
    pub fn polygon(&mut self, points: impl IntoIterator<Item = [f64; 2]>, rgb: Rgb, alpha: f64) {
        self.fill(outline(points, true), rgb, alpha);
    }

    /// A line through these points.
    pub fn line(&mut self, points: impl IntoIterator<Item = [f64; 2]>, width: f64, rgb: Rgb, alpha: f64) {
        if let Some(path) = outline(points, false) {
            let stroke = Stroke { width: width as f32, line_cap: LineCap::Round, ..Stroke::default() };
            self.pixmap.stroke_path(&path, &paint(rgb, alpha * self.opacity), &stroke, Transform::identity(), None);
        }
    }

    /// A filled circle.
    pub fn circle(&mut self, [x, y]: [f64; 2], radius: f64, rgb: Rgb, alpha: f64) {
        self.fill(PathBuilder::from_circle(x as f32, y as f32, radius as f32), rgb, alpha);
    }

    fn fill(&mut self, path: Option<Path>, rgb: Rgb, alpha: f64) {
        // tiny-skia fills no outline that is narrower, and logs a warning for it.
        const NARROWEST: f32 = 1.0 / 4096.0;
        let has_area = |path: &Path| path.bounds().width() > NARROWEST && path.bounds().height() > NARROWEST;
        if let Some(path) = path.filter(has_area) {
            let paint = paint(rgb, alpha * self.opacity);
            self.pixmap.fill_path(&path, &paint, FillRule::Winding, Transform::identity(), None);
        }
    }

    /// Light around a place, which fades with the distance.
    pub fn glow(&mut self, place: [f64; 2], radius: f64, rgb: Rgb, alpha: f64) {
        let stops =
            vec![GradientStop::new(0.0, color(rgb, alpha * self.opacity)), GradientStop::new(1.0, color(rgb, 0.0))];
        let (middle, radius) = (pixel(place), radius as f32);
        let shader = RadialGradient::new(middle, 0.0, middle, radius, stops, SpreadMode::Pad, Transform::identity());
        let square = Rect::from_xywh(middle.x - radius, middle.y - radius, 2.0 * radius, 2.0 * radius);
        if let (Some(shader), Some(square)) = (shader, square) {
            let paint = Paint { shader, blend_mode: BlendMode::Plus, ..Paint::default() };
            self.pixmap.fill_rect(square, &paint, Transform::identity(), None);
        }
    }

    /// A rectangle: left, top, width and height.
    pub fn rectangle(&mut self, [x, y, width, height]: [f64; 4], rgb: Rgb, alpha: f64) {
        if let Some(rect) = Rect::from_xywh(x as f32, y as f32, width as f32, height as f32) {
            let paint = Paint { anti_alias: false, ..paint(rgb, alpha) };
            self.pixmap.fill_rect(rect, &paint, Transform::identity(), None);
        }
    }

    /// A rectangle with round corners.
    pub fn card(&mut self, [x, y, width, height]: [f64; 4], radius: f64, rgb: Rgb, alpha: f64) {
        let (right, bottom) = (x + width, y + height);
        let corner = |[x, y]: [f64; 2], quarter: f64| {
            (0..=4).map(move |part| {
                let (sin, cos) = ((quarter + f64::from(part) / 4.0) * std::f64::consts::FRAC_PI_2).sin_cos();
                [x + radius * cos, y + radius * sin]
            })
        };
        let points = corner([right - radius, bottom - radius], 0.0)
            .chain(corner([x + radius, bottom - radius], 1.0))
            .chain(corner([x + radius, y + radius], 2.0))
            .chain(corner([right - radius, y + radius], 3.0));
        self.polygon(points, rgb, alpha);
    }

    /// A rectangle whose color changes from the left to the right.
    pub fn scale(&mut self, [x, y, width, height]: [f64; 4], colors: &[Rgb]) {
        let last = colors.len().saturating_sub(1).max(1) as f32;
        let stops = colors.iter().enumerate().map(|(i, rgb)| GradientStop::new(i as f32 / last, color(*rgb, 1.0)));
        let (from, to) = (pixel([x, y]), pixel([x + width, y]));
        let shader = LinearGradient::new(from, to, stops.collect(), SpreadMode::Pad, Transform::identity());
        let rect = Rect::from_xywh(x as f32, y as f32, width as f32, height as f32);
        if let (Some(shader), Some(rect)) = (shader, rect) {
            let paint = Paint { shader, anti_alias: false, ..Paint::default() };
            self.pixmap.fill_rect(rect, &paint, Transform::identity(), None);
        }
    }

    /// The whole canvas from one color at the top to another at the bottom.
    pub fn backdrop(&mut self, top: Rgb, bottom: Rgb) {
        let (width, height) = (self.pixmap.width() as f32, self.pixmap.height() as f32);
        let stops = vec![GradientStop::new(0.0, color(top, 1.0)), GradientStop::new(1.0, color(bottom, 1.0))];
        let (from, to) = (Pixel::from_xy(0.0, 0.0), Pixel::from_xy(0.0, height));
        let shader = LinearGradient::new(from, to, stops, SpreadMode::Pad, Transform::identity())
            .unwrap_or(Shader::SolidColor(color(bottom, 1.0)));
        if let Some(rect) = Rect::from_xywh(0.0, 0.0, width, height) {
            let paint = Paint { shader, ..Paint::default() };
            self.pixmap.fill_rect(rect, &paint, Transform::identity(), None);
        }
    }

    /// Another canvas of the same size over this one, which is opaque.
    pub fn overlay(&mut self, other: &Canvas) {
        // tiny-skia's draw_pixmap takes ten times as long: it does not pass over what is transparent.
        for (below, above) in self.pixmap.pixels_mut().iter_mut().zip(other.pixmap.pixels()) {
            if above.alpha() == 255 {
                *below = *above;
            } else if above.alpha() > 0 {
                let left = 255 - u32::from(above.alpha());
                let part = |below: u8, above: u8| (u32::from(above) + u32::from(below) * left / 255).min(255) as u8;
                let (red, green) = (part(below.red(), above.red()), part(below.green(), above.green()));
                let blue = part(below.blue(), above.blue());
                *below = PremultipliedColorU8::from_rgba(red, green, blue, 255).unwrap_or(*below);
            }
        }
    }

    /// Replaces everything by another canvas: each of its pixels is `factor` times as large, and then moved by `offset`.
    /// It leaves nothing without memory for the steps between.
    pub fn take_scaled(&mut self, other: &Canvas, mut factor: f64, [x, y]: [f64; 2]) {
        self.pixmap.fill(Color::TRANSPARENT);
        let smooth = PixmapPaint { quality: FilterQuality::Bilinear, ..PixmapPaint::default() };
        let scaled = |factor: f64, x: f64, y: f64| {
            Transform::from_row(factor as f32, 0.0, 0.0, factor as f32, x as f32, y as f32)
        };
        // The filter reads four pixels. With a smaller factor, thin walls would fall between them.
        let mut half: Option<Pixmap> = None;
        while factor < 0.5 {
            let from = half.as_ref().unwrap_or(&other.pixmap);
            let Some(mut next) = Pixmap::new(from.width().div_ceil(2), from.height().div_ceil(2)) else { return };
            next.draw_pixmap(0, 0, from.as_ref(), &smooth, scaled(0.5, 0.0, 0.0), None);
            half = Some(next);
            factor *= 2.0;
        }
        let from = half.as_ref().unwrap_or(&other.pixmap);
        self.pixmap.draw_pixmap(0, 0, from.as_ref(), &smooth, scaled(factor, x, y), None);
    }

    /// A text with its left upper corner here. A character that the font does not have is a question mark.
    pub fn text(&mut self, [x, y]: [f64; 2], font: Font, rgb: Rgb, text: &str) {
        let (weight, height) = font.weight_and_height();
        let (width, rows) = (self.pixmap.width() as usize, self.pixmap.height() as usize);
        let (mut left, top) = (x.max(0.0) as usize, y.max(0.0) as usize);
        let pixels = self.pixmap.data_mut();
        for character in text.chars() {
            let glyph = get_raster(character, weight, height).or_else(|| get_raster('?', weight, height));
            let Some(glyph) = glyph else { continue };
            for (row, line) in glyph.rows().enumerate().take_while(|(row, _)| top + row < rows) {
                for (column, ink) in line.iter().enumerate().take_while(|(column, _)| left + column < width) {
                    if *ink == 0 {
                        continue;
                    }
                    let at = 4 * ((top + row) * width + left + column);
                    // The canvas of a text is opaque.
                    for (part, ink_part) in pixels[at..at + 3].iter_mut().zip(rgb) {
                        let (below, above) = (i32::from(*part), i32::from(ink_part));
                        *part = (below + (above - below) * i32::from(*ink) / 255) as u8;
                    }
                }
            }
            left += glyph.width();
        }
    }

    /// The faces of a solid box that the eye sees.
    pub fn solid(&mut self, lens: &Lens, solid: &Room, rgb: Rgb, alpha: f64) {
        let Room { min, max } = *solid;
        // Each face: its axis, whether it is at the upper end, and its light.
        for (axis, upper, light) in
            [(0, false, SIDE), (0, true, SIDE), (1, true, FRONT), (2, false, SIDE), (1, false, FRONT), (2, true, TOP)]
        {
            let mut normal = [0.0; 3];
            normal[axis] = if upper { 1.0 } else { -1.0 };
            let level = if upper { max[axis] } else { min[axis] };
            let mut corner = min;
            corner[axis] = level;
            if !lens.sees(corner, normal) {
                continue;
            }
            let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
            let at = |a_end: f64, b_end: f64| {
                let mut point = corner;
                (point[a], point[b]) = (a_end, b_end);
                lens.place(point)
            };
            let points = [at(min[a], min[b]), at(max[a], min[b]), at(max[a], max[b]), at(min[a], max[b])];
            self.polygon(points, lit(rgb, light), alpha);
        }
    }

    /// A line in the room, as wide as a rod of this diameter.
    pub fn rod(&mut self, lens: &Lens, [from, to]: [Point; 2], diameter_mm: f64, rgb: Rgb, alpha: f64) {
        let width = diameter_mm * (lens.scale_at(from) + lens.scale_at(to)) / 2.0;
        self.line([lens.place(from), lens.place(to)], width, rgb, alpha);
    }
}
