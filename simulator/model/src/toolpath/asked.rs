// SPDX-License-Identifier: GPL-3.0-or-later
//! The path that a G-code file asks for, read as klippy reads it.

use std::f64::consts::TAU;
use std::io::{BufRead, Read};

use super::{PIECES_MAX, count_pieces};
use crate::description::check::Trouble;

/// Longest line of a file, in bytes.
const LINE_MAX: u64 = 1 << 20;
/// Highest number of a place. A larger one describes no printer, and could overflow a distance.
const NUMBER_MAX: f64 = 1e9;
/// Longest part of a wrong number that is shown.
const SHOWN_MAX: usize = 20;
/// Greatest distance of a chord from its arc.
const CHORD_MM: f64 = 0.002;
/// Least rise of the nozzle from one layer to the next.
const LAYER_MM: f64 = 0.05;

/// A place that a G-code file asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct AskedPoint {
    pub(crate) nozzle_mm: [f64; 3],
    /// The layer, counted from 1 in the file's order. Moves before the first layer belong to it.
    pub(crate) layer: u32,
    /// The line of the file, from 1 on.
    pub(crate) line: u32,
    /// Whether the way to it is unknown: it begins the file, or follows a G28 or a macro.
    pub(crate) is_start: bool,
}

/// The path that a G-code file asks for.
#[derive(Clone, Debug, Default)]
pub struct AskedPath {
    pub(crate) points: Vec<AskedPoint>,
    /// Filament that it pushes, without retractions.
    pub(crate) filament_mm: f64,
}

impl AskedPath {
    /// Reads a file line by line; `origin` is its name in an error.
    ///
    /// # Errors
    ///
    /// The file cannot be read, a number in it is none, it never asks for a place, or its path is too long.
    pub fn read(mut file: impl BufRead, origin: &str) -> Result<AskedPath, Trouble> {
        let mut reader = Reader::default();
        let mut line = Vec::new();
        for number in 1.. {
            line.clear();
            let read = file.by_ref().take(LINE_MAX).read_until(b'\n', &mut line);
            if read.map_err(|error| Trouble::new(error.to_string()).of(origin))? == 0 {
                break;
            }
            reader.line = number;
            let read = if line.len() as u64 == LINE_MAX && !line.ends_with(b"\n") {
                let trouble = Trouble::new(format!("the line is longer than {LINE_MAX} bytes"));
                Err(trouble.remedy("name a G-code file"))
            } else {
                reader.read(&String::from_utf8_lossy(&line))
            };
            read.map_err(|trouble| trouble.of(format_args!("{origin}:{number}")))?;
        }
        if reader.path.points.len() < 2 {
            let trouble = Trouble::new("it never moves the nozzle between two known places").of(origin);
            return Err(trouble.remedy("name a file with G1 moves along X, Y and Z"));
        }
        Ok(reader.path)
    }
}

/// The words of a line as klippy divides it: names of letters, each with the text up to the next name. `G1X10Y5` has no
/// spaces, and `XY` is one name.
struct Words<'a>(Vec<(&'a str, &'a str)>);

impl<'a> Words<'a> {
    fn new(mut line: &'a str) -> Words<'a> {
        let is_name = |character: char| character.is_ascii_alphabetic() || character == '_';
        let mut words = Vec::new();
        while !line.is_empty() {
            let (name, rest) = line.split_at(line.find(|c| !is_name(c)).unwrap_or(line.len()));
            let (value, next) = rest.split_at(rest.find(is_name).unwrap_or(rest.len()));
            words.push((name, value));
            line = next;
        }
        Words(words)
    }

    fn has(&self, name: &str) -> bool {
        self.0.iter().any(|(its, _)| *its == name)
    }

    /// The number with this name; of several the last.
    fn get(&self, name: &str) -> Result<Option<f64>, Trouble> {
        let Some((_, value)) = self.0.iter().rfind(|(its, _)| *its == name) else { return Ok(None) };
        let value = value.trim();
        let wrong = |what: &str| {
            let shown: String = value.chars().take(SHOWN_MAX).collect();
            Err(Trouble::new(format!("`{name}{shown}` {what}")).remedy("correct it"))
        };
        match value.parse::<f64>() {
            Ok(number) if number.abs() <= NUMBER_MAX => Ok(Some(number)),
            Ok(_) => wrong("is out of range"),
            Err(_) => wrong("has no number"),
        }
    }
}

struct Reader {
    path: AskedPath,
    line: u32,
    /// x, y, z and e of the machine; `None` until the file says where it is.
    at: [Option<f64>; 4],
    /// The offset that G92 has put between the machine's coordinates and the file's.
    base: [f64; 4],
    relative: bool,
    relative_filament: bool,
    /// Whether the next place begins another path.
    is_start: bool,
    layer: u32,
    layer_z: f64,
    pushed_mm: f64,
    /// How many pieces the path has for the comparison.
    pieces: f64,
}

impl Default for Reader {
    fn default() -> Reader {
        Reader {
            path: AskedPath::default(),
            line: 0,
            at: [None, None, None, Some(0.0)],
            base: [0.0; 4],
            relative: false,
            relative_filament: false,
            is_start: true,
            layer: 0,
            layer_z: f64::NEG_INFINITY,
            pushed_mm: 0.0,
            pieces: 0.0,
        }
    }
}

const AXES: [&str; 4] = ["X", "Y", "Z", "E"];

impl Reader {
    fn read(&mut self, line: &str) -> Result<(), Trouble> {
        let line = line.split([';', '*']).next().unwrap_or_default().trim().to_ascii_uppercase();
        let words = Words::new(&line);
        let has_number = words.0.first().is_some_and(|(name, _)| *name == "N");
        let Some((letter, value)) = words.0.get(usize::from(has_number)) else { return Ok(()) };
        // M117 and M118 may have a text of any characters.
        let number = value.split(char::is_whitespace).next().unwrap_or_default();
        let is_digit = |byte: u8| byte.is_ascii_digit() || byte == b'.';
        if letter.len() != 1 || number.is_empty() || !number.bytes().all(is_digit) {
            // A macro, or a command of klippy. It may move the head, and it comes back or says where to go next.
            self.is_start = true;
            return Ok(());
        }
        match (*letter, number) {
            ("G", "0" | "00" | "1" | "01") => {
                let to = self.target(&words)?;
                self.go(to)?;
            }
            ("G", "2" | "02") => self.arc(&words, true)?,
            ("G", "3" | "03") => self.arc(&words, false)?,
            ("G", "28") => {
                let all = !AXES[..3].iter().any(|axis| words.has(axis));
                for axis in (0..3).filter(|axis| all || words.has(AXES[*axis])) {
                    (self.at[axis], self.base[axis]) = (None, 0.0);
                }
                self.is_start = true;
            }
            ("G", "90") => self.relative = false,
            ("G", "91") => self.relative = true,
            ("M", "82") => self.relative_filament = false,
            ("M", "83") => self.relative_filament = true,
            ("G", "92") => {
                let any = AXES.iter().any(|axis| words.has(axis));
                for (axis, name) in AXES.into_iter().enumerate() {
                    let given = if any { words.get(name)? } else { Some(0.0) };
                    if let (Some(value), Some(at)) = (given, self.at[axis]) {
                        self.base[axis] = at - value;
                    }
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// The place that a move asks for.
    fn target(&self, words: &Words<'_>) -> Result<[Option<f64>; 4], Trouble> {
        let mut to = self.at;
        for axis in 0..4 {
            if let Some(value) = words.get(AXES[axis])? {
                let relative = self.relative || (axis == 3 && self.relative_filament);
                to[axis] = if relative { self.at[axis].map(|at| at + value) } else { Some(value + self.base[axis]) };
            }
        }
        Ok(to)
    }

    fn go(&mut self, to: [Option<f64>; 4]) -> Result<(), Trouble> {
        let filament_mm = to[3].unwrap_or(0.0);
        let is_laid = filament_mm > self.pushed_mm && to[..3] != self.at[..3];
        self.path.filament_mm += (filament_mm - self.pushed_mm).max(0.0);
        self.pushed_mm = self.pushed_mm.max(filament_mm);
        self.at = to;
        let [Some(x), Some(y), Some(z), _] = to else { return Ok(()) };
        if is_laid && (z - self.layer_z).abs() > LAYER_MM {
            self.layer += 1;
            self.layer_z = z;
        }
        let nozzle_mm = [x, y, z];
        let last = self.path.points.last();
        if self.is_start || last.is_none_or(|last| last.nozzle_mm != nozzle_mm) {
            self.pieces += last.filter(|_| !self.is_start).map_or(1.0, |last| count_pieces(last.nozzle_mm, nozzle_mm));
            if self.pieces > PIECES_MAX {
                let trouble = Trouble::new("the path up to here is too long to be compared");
                return Err(trouble.remedy("correct its places and arcs, or name a shorter file"));
            }
            let (layer, line) = (self.layer.max(1), self.line);
            self.path.points.push(AskedPoint { nozzle_mm, layer, line, is_start: self.is_start });
            self.is_start = false;
        }
        Ok(())
    }

    /// An arc around a center in the plane of x and y, as klippy's `[gcode_arcs]` takes it: I and J are relative.
    fn arc(&mut self, words: &Words<'_>, clockwise: bool) -> Result<(), Trouble> {
        let to = self.target(words)?;
        let offset = [words.get("I")?.unwrap_or(0.0), words.get("J")?.unwrap_or(0.0)];
        let from = self.at;
        // Without a known place at both ends, no place between them is known either.
        let ([Some(x0), Some(y0), Some(_), _], [Some(x), Some(y), Some(_), _]) = (from, to) else {
            return self.go(to);
        };
        let radius = offset[0].hypot(offset[1]);
        if radius == 0.0 {
            let trouble = Trouble::new("an arc has no center");
            return Err(trouble.remedy("give I or J; klippy knows no R, and no other plane here"));
        }
        let center = [x0 + offset[0], y0 + offset[1]];
        let start = (-offset[1]).atan2(-offset[0]);
        let end = (y - center[1]).atan2(x - center[0]);
        let turn = if clockwise { (start - end).rem_euclid(TAU) } else { (end - start).rem_euclid(TAU) };
        // The same place means a whole turn.
        let turn = if (x - x0).hypot(y - y0) < 1e-9 { TAU } else { turn };
        let chord = 2.0 * (1.0 - CHORD_MM / radius.max(CHORD_MM)).acos();
        let count = (turn / chord).ceil().clamp(1.0, 1e5);
        for n in 1..count as u32 {
            let share = f64::from(n) / count;
            let angle = start + if clockwise { -turn } else { turn } * share;
            let between = |axis: usize| Some(from[axis]? + (to[axis]? - from[axis]?) * share);
            let (sine, cosine) = angle.sin_cos();
            let [x, y] = [center[0] + radius * cosine, center[1] + radius * sine];
            self.go([Some(x), Some(y), between(2), between(3)])?;
        }
        self.go(to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<AskedPath, Trouble> {
        AskedPath::read(text.as_bytes(), "a.gcode")
    }

    fn places(text: &str) -> Vec<[f64; 3]> {
        parse(text).unwrap().points.iter().map(|point| point.nozzle_mm).collect()
    }

    #[test]
    fn absolute_and_relative_moves_and_g92() {
        let text = "G28\nG90\nM83\nN5 G1 X10 Y20 Z0.2 F3000 ; there\nG1 X15 E1*71\nG91\nG0 Y-5 Z1\nG90\n\
                    G92 X0\ng1 x5 y5\nG92 E0\nM82\nG1 E2\n";
        let expected = [[10.0, 20.0, 0.2], [15.0, 20.0, 0.2], [15.0, 15.0, 1.2], [20.0, 5.0, 1.2]];
        assert_eq!(places(text), expected);
        assert_eq!(parse(text).unwrap().filament_mm, 3.0);
    }

    #[test]
    fn a_line_is_divided_as_klippy_divides_it() {
        // The expected numbers are those that klippy's regular expression `args_r` finds.
        let text = "G28XY\nM83\nG1X10Y20Z0.2F3000\nN7G1X 15E1*71\nG1 Y 25 X20 X16\nG91\nG0Y-5Z+.5\nG90\nG1X1E5Y2\nG1XY9X3\n\
                    M117 50% 3/4\nG92X0\ng01x.5\n";
        let path = parse(text).unwrap();
        let found: Vec<_> = path.points.iter().map(|point| (point.nozzle_mm, point.is_start)).collect();
        let expected = [
            ([10.0, 20.0, 0.2], true),
            ([15.0, 20.0, 0.2], false),
            ([16.0, 25.0, 0.2], false),
            ([16.0, 20.0, 0.7], false),
            ([1.0, 2.0, 0.7], false),
            ([3.0, 2.0, 0.7], false),
            ([3.5, 2.0, 0.7], false),
        ];
        assert_eq!(found, expected);
        assert_eq!(path.filament_mm, 6.0);
        // A macro with a number, a macro of one letter, and lines that klippy refuses.
        for line in ["PARK2 X5", "Z", "G 1 X5", "1G1 X5", "_G1 X5"] {
            let path = parse(&format!("G1X1Y1Z1\n{line}\nG1X2")).unwrap();
            let last = path.points.last().map(|last| (last.nozzle_mm, last.is_start));
            assert_eq!((path.points.len(), last), (2, Some(([2.0, 1.0, 1.0], true))), "{line}");
        }
    }

    #[test]
    fn a_place_is_known_after_homing_when_the_file_names_it() {
        // X and Y alone leave the height unknown.
        let path = parse("G28\nG1 X1 Y1\nG1 X2\nG1 Z3\nG1 X4\nG28 X\nG1 Y9\nG1 X5\nM117 X\nPARK\nG1 X6");
        let points = path.unwrap().points;
        let found: Vec<_> = points.iter().map(|point| (point.nozzle_mm, point.is_start, point.line)).collect();
        let expected = [
            ([2.0, 1.0, 3.0], true, 4),
            ([4.0, 1.0, 3.0], false, 5),
            ([5.0, 9.0, 3.0], true, 8),
            ([6.0, 9.0, 3.0], true, 11),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn layers_begin_where_filament_is_laid_at_a_new_height() {
        let text =
            "M83\nG1 X0 Y0 Z5\nG1 Z.2\nG1 X9 E1\nG1 E-1\nG1 Z.6\nG1 X0\nG1 Z.2\nG1 E1\nG1 X3 E1\nG1 Z.4\nG1 X9 E1\n";
        let path = parse(text).unwrap();
        let layers: Vec<u32> = path.points.iter().map(|point| point.layer).collect();
        assert_eq!(layers, [1, 1, 1, 1, 1, 1, 1, 1, 2]);
        assert_eq!(path.filament_mm, 3.0);
    }

    #[test]
    fn an_arc_stays_on_its_circle() {
        for (command, middle) in [("G3", [10.0, 10.0]), ("G2", [10.0, -10.0])] {
            let points = places(&format!("G1 X20 Y0 Z1\n{command} X0 Y0 I-10 J0 E1\n"));
            let off = |point: &[f64; 3]| ((point[0] - 10.0).hypot(point[1]) - 10.0).abs();
            assert!(points.len() > 50 && points.iter().all(|point| off(point) < 1e-9), "{}", points.len());
            let near = |point: &&[f64; 3]| (point[0] - middle[0]).hypot(point[1] - middle[1]) < 0.3;
            assert!(points.iter().any(|point| near(&point)), "{command} goes the other way");
            let chords = points.windows(2).map(|two| {
                let middle = [(two[0][0] + two[1][0]) / 2.0, (two[0][1] + two[1][1]) / 2.0, 1.0];
                off(&middle)
            });
            assert!(chords.fold(0.0, f64::max) <= CHORD_MM + 1e-9);
        }
        let whole = places("G1 X20 Y0 Z1\nG2 I-10\n");
        assert!(whole.len() > 100 && whole.iter().any(|point| point[0] < 0.1), "a whole turn");
    }

    #[test]
    fn an_error_names_the_line_and_a_remedy() {
        for (text, part) in [
            ("G1 X1\nG1 X1.2.3Y2", "a.gcode:2: `X1.2.3` has no number: correct it"),
            ("G1 X1 Y1 Z1\nG2 X3 Y3 R2", "a.gcode:2: an arc has no center: give I or J"),
            ("; nothing", "a.gcode: it never moves the nozzle between two known places: name"),
            ("G1 X\u{e9}", "has no number"),
            ("G1 X1\nG91\nG1 X-1000000001", "a.gcode:3: `X-1000000001` is out of range: correct it"),
            (&format!("G1 X{}", "9".repeat(400)), "a.gcode:1: `X99999999999999999999` is out of range"),
            (&format!("G1 X1\n{}", "x".repeat(1 << 20)), "a.gcode:2: the line is longer than 1048576 bytes: name"),
        ] {
            let Err(error) = parse(text) else { panic!("accepted {text}") };
            assert!(error.to_string().contains(part), "{error}");
        }
    }
    #[test]
    fn a_path_is_not_longer_than_can_be_compared() {
        let start = "G1 X1 Y1 Z1\n";
        let arcs = format!("{start}{}", "G2 I999999999\n".repeat(2000));
        let lines = format!("{start}{}", "G1 X1000000\nG1 X1\n".repeat(1000));
        for (text, line) in [(&*arcs, 2), (&*lines, 18), ("G1 X1 Y1 Z1\nG1 X1000000000", 2)] {
            let Err(error) = parse(text) else { panic!("accepted {}", &text[..40]) };
            let expected = format!("a.gcode:{line}: the path up to here is too long to be compared: correct its");
            assert!(error.to_string().starts_with(&expected), "{error}");
        }
        // Where the height is not known, an arc has no places.
        assert_eq!(places(&format!("G1 X1 Y1\n{}G1 X2 Y2 Z2\nG1 X3", "G2 I999999999\n".repeat(2000))).len(), 2);
    }
}
