// SPDX-License-Identifier: GPL-3.0-or-later
//! Shows the simulated printer as a person would see it, while it changes (`pinion sim --show`).
//!
//! On a terminal it is a picture in the lowest rows, drawn again in place. The log continues to scroll in the rows
//! above. Anywhere else each change is a line, or a block for a picture.

use std::io::{self, IsTerminal};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::thread;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::getpid;
use signal_hook::consts::SIGQUIT;
use termina::escape::csi::{Csi, DecPrivateModeCode, Sgr};
use termina::event::KeyCode;
use termina::style::RgbColor;

use pinion_linux::clock::monotonic;
use pinion_linux::foreign::plain;
use pinion_model::SimProbe;

use crate::own_status::OwnStatus;
use changes::Changes;
use pinion::page::draw;
use pinion::terminal::{
    DELETE_BELOW, ERASE_LINE, Key, Keys, RESTORE_CURSOR, SAVE_CURSOR, Size, Terminal, all_scrolls, give_back_at, off,
    on, scrolling, size, to_row, up,
};

mod changes;

/// Time between two pictures on a terminal, and between two looks for changes.
const DRAW_PERIOD: Duration = Duration::from_millis(100);
const LOOK_PERIOD: Duration = Duration::from_millis(200);
/// How long the program's end waits for a terminal that takes no output.
const FAREWELL: Duration = Duration::from_secs(1);
/// Longest name that stays in its column.
const HEAD_MAX: usize = 20;
/// Rows of a terminal that the log keeps.
const LOG_ROWS: usize = 3;

/// The kind of a thing. Things of one kind share a line on a terminal.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Axis,
    Heater,
    Fan,
    Output,
    /// A part has a line of its own.
    Part,
}

impl Kind {
    /// The names of many things of this kind, and of one. A part has a name of its own.
    fn names(self) -> Option<(&'static str, &'static str)> {
        match self {
            Kind::Axis => Some(("axes", "axis")),
            Kind::Heater => Some(("heaters", "heater")),
            Kind::Fan => Some(("fans", "fan")),
            Kind::Output => Some(("outputs", "output")),
            Kind::Part => None,
        }
    }
}

/// A visible thing.
struct Item {
    kind: Kind,
    name: String,
    /// The value that changes by small steps.
    number: Option<Number>,
    /// Everything about it, as text.
    text: String,
}

impl Item {
    /// The same without control characters in the names that a description gives.
    fn plain(self) -> Item {
        let lines: Vec<_> = self.text.lines().map(plain).collect();
        Item { name: plain(&self.name).into_owned(), text: lines.join("\n"), ..self }
    }
}

/// A number that moves. It is reported again when it has moved by a step, or when it stands.
#[derive(Clone, Copy, PartialEq)]
struct Number {
    value: f64,
    step: f64,
    /// The number stands while it goes up and down by less than this.
    ripple: f64,
}

/// All visible things now.
fn look(probe: &SimProbe, own: &OwnStatus) -> Vec<Item> {
    let state = own.stop().map_or("runs".into(), |stop| format!("SHUT DOWN: {stop}; the log says more"));
    let item = |kind, name: &str, number, text| Item { kind, name: name.into(), number, text }.plain();
    let moving = |value, step, ripple| Some(Number { value, step, ripple });
    // It is the first: a small terminal shows only the first lines.
    let mut items = vec![item(Kind::Part, "mcu", None, state)];
    items.extend(probe.axes().map(|axis| {
        let lost = if axis.lost_steps > 0 { format!(" ({} steps lost)", axis.lost_steps) } else { String::new() };
        // A value next to zero must not be "-0.00".
        let mm = (axis.position_mm * 100.0).round() / 100.0 + 0.0;
        item(Kind::Axis, axis.name, moving(axis.position_mm, 1.0, 0.0), format!("{mm:.2} mm{lost}"))
    }));
    items.extend(probe.heaters().map(|heater| {
        item(Kind::Heater, heater.name, moving(heater.celsius, 1.0, 0.0), format!("{:.1} C", heater.celsius))
    }));
    // klippy's cycle of 10 ms makes a fan at half speed go up and down by 28 rpm.
    items.extend(
        probe.fans().map(|fan| item(Kind::Fan, fan.name, moving(fan.rpm, 100.0, 30.0), format!("{:.0} rpm", fan.rpm))),
    );
    items.extend(probe.outputs().map(|output| {
        let text = match (output.brightness * 100.0).round() {
            percent if percent < 1.0 => "off".into(),
            percent if percent > 99.0 => "on".into(),
            percent => format!("{percent} %"),
        };
        item(Kind::Output, output.name, moving(output.brightness, 0.05, 0.0), text)
    }));
    items.extend(probe.sights().map(|(name, look)| item(Kind::Part, name, None, look.to_string())));
    items
}

/// Writes a text, and lets `with` write each `#rrggbb` in it.
fn each_colour(text: &str, with: impl Fn(&mut String, &str, [u8; 3])) -> String {
    let mut written = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('#') {
        written += before;
        let colour = after.get(..6).and_then(|digits| Some((digits, u32::from_str_radix(digits, 16).ok()?)));
        rest = after;
        match colour {
            Some((digits, colour)) => {
                let [_, red, green, blue] = colour.to_be_bytes();
                with(&mut written, digits, [red, green, blue]);
                rest = &after[6..];
            }
            None => written.push('#'),
        }
    }
    written + rest
}

/// Adds its name to each color.
fn name_colours(text: &str) -> String {
    each_colour(text, |written, digits, parts| {
        let strongest = parts.iter().copied().max().unwrap_or(0).max(1);
        let strong = parts.map(|part| u16::from(part) * 2 > u16::from(strongest));
        let name = match strong {
            [true, true, true] => "white",
            [true, true, false] => "yellow",
            [true, false, true] => "magenta",
            [true, false, false] => "red",
            [false, true, true] => "cyan",
            [false, true, false] => "green",
            [false, false, true] => "blue",
            [false, false, false] => "black",
        };
        *written += &format!("{name}#{digits}");
    })
}

/// Paints each color as a block.
fn paint_colours(text: &str) -> String {
    each_colour(text, |written, _, [red, green, blue]| {
        let background = Csi::Sgr(Sgr::Background(RgbColor::new(red, green, blue).into()));
        *written += &format!("{background}   {}", Csi::Sgr(Sgr::Reset));
    })
}

/// The picture's lines.
fn picture(items: &[Item], paint: bool) -> Vec<String> {
    let head = |item: &Item| item.kind.names().map_or(item.name.clone(), |(many, _)| many.to_owned());
    let widths = items.iter().map(|item| head(item).chars().count()).filter(|width| *width <= HEAD_MAX);
    let width = widths.max().unwrap_or(0);
    let begin = |item| {
        let head = head(item);
        let space = width.saturating_sub(head.chars().count()) + 2;
        head + &" ".repeat(space)
    };
    let mut lines: Vec<String> = Vec::new();
    let mut kind = Kind::Part;
    for item in items {
        let text = if paint { paint_colours(&item.text) } else { name_colours(&item.text) };
        match item.kind.names() {
            None if text.contains('\n') => {
                lines.push(item.name.clone());
                lines.extend(text.lines().map(str::to_owned));
            }
            None => lines.push(begin(item) + &text),
            // The last line is of the same kind.
            Some(_) if item.kind == kind => {
                if let Some(line) = lines.last_mut() {
                    *line += &format!("   {} {text}", item.name);
                }
            }
            Some(_) => lines.push(format!("{}{} {text}", begin(item), item.name)),
        }
        kind = item.kind;
    }
    lines
}

/// The lowest rows of a terminal, outside the part that scrolls. Every terminal of today has DECSTBM of the VT100 for
/// that.
#[derive(Default)]
struct Screen {
    /// The terminal's size, and how many of its rows are the picture's. `None` before the first picture.
    placed: Option<(Size, usize)>,
    /// The lines in the picture's rows.
    drawn: Vec<String>,
}

impl Screen {
    /// The output that draws these lines on a terminal of this size. Empty if they are there already.
    fn draw(&mut self, mut lines: Vec<String>, size: Size) -> String {
        let rows = size.rows;
        let mut out = String::new();
        let room = rows.saturating_sub(LOG_ROWS).max(1);
        if lines.len() > room {
            let left_out = lines.len() - room + 1;
            lines.truncate(room - 1);
            lines.push(format!("... and {left_out} lines more, on a terminal with more rows"));
        }
        // The picture does not shrink, so that the rows above do not jump.
        let picture_rows = match self.placed {
            Some((before, picture_rows)) if before == size => lines.len().max(picture_rows),
            _ => lines.len(),
        };
        if self.placed != Some((size, picture_rows)) {
            // A terminal that changes its size moves its text, and wraps it again. Only the cursor still shows
            // where the log ends: the picture is below it, wherever that is. Its rows are deleted, because some
            // terminals keep erased ones in their history and show them again when they grow.
            out += &format!("{SAVE_CURSOR}{}{RESTORE_CURSOR}{DELETE_BELOW}", scrolling(usize::MAX));
            // This makes room, and the log goes on where it was.
            out += &format!("{}{}", "\n".repeat(picture_rows), up(picture_rows));
            let log_rows = rows.saturating_sub(picture_rows).max(1);
            out += &format!("{SAVE_CURSOR}{}{RESTORE_CURSOR}", scrolling(log_rows));
            self.placed = Some((size, picture_rows));
            self.drawn.clear();
        }
        let top = rows.saturating_sub(picture_rows) + 1;
        lines.resize(picture_rows, String::new());
        let changed = |(n, line): (usize, &String)| {
            (self.drawn.get(n) != Some(line)).then(|| format!("{}{line}{ERASE_LINE}", to_row(top + n)))
        };
        let changed: String = lines.iter().enumerate().filter_map(changed).collect();
        if !changed.is_empty() {
            // It is drawn without wrapping, which would reach into the next line. The cursor goes back to the log.
            let wrap = DecPrivateModeCode::AutoWrap;
            out += &format!("{SAVE_CURSOR}{}{changed}{}{RESTORE_CURSOR}", off(wrap), on(wrap));
            self.drawn = lines;
        }
        out
    }
}

/// The thread that shows the printer.
pub(crate) struct Show {
    /// Starts it. When this is dropped, the thread ends.
    go: Sender<()>,
    done: Receiver<()>,
}

impl Show {
    /// Makes a thread that will show the printer on stdout. Make it before the MCU runs. A real-time thread passes its
    /// scheduling on to the threads that it starts. Such a thread would keep a host from the processor.
    pub(crate) fn prepare(probe: SimProbe, own: OwnStatus) -> io::Result<Show> {
        let (go, went) = mpsc::channel();
        let (finished, done) = mpsc::channel();
        thread::Builder::new().name("show".into()).spawn(move || {
            let shown = went.recv().map_or(Ok(()), |()| show(|| look(&probe, &own), &went));
            if let Err(error) = shown {
                // A reader that went away, such as `head`, is no failure. The printer continues to serve.
                if error.kind() != io::ErrorKind::BrokenPipe {
                    log::warn!("the printer is shown no longer: stdout cannot be written: {error}");
                }
            }
            let _ = finished.send(());
        })?;
        Ok(Show { go, done })
    }

    /// Shows the printer from now on.
    pub(crate) fn begin(&self) {
        // It fails only if the thread is gone. Then nothing can be shown.
        let _ = self.go.send(());
    }

    /// Shows the final state and gives the terminal back, unless nobody reads there.
    pub(crate) fn end(self) {
        drop(self.go);
        let _ = self.done.recv_timeout(FAREWELL);
    }
}

/// Whether stdout is a terminal that can be drawn on.
fn is_screen() -> bool {
    io::stdout().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

fn show(look: impl Fn() -> Vec<Item>, stopped: &Receiver<()>) -> io::Result<()> {
    let is_over = |period| stopped.recv_timeout(period) != Err(RecvTimeoutError::Timeout);
    if !is_screen() {
        let mut changes = Changes::default();
        loop {
            let is_over = is_over(LOOK_PERIOD);
            let lines = changes.lines(&look(), monotonic(), is_over);
            if !lines.is_empty() {
                draw(&lines)?;
            }
            if is_over {
                return Ok(());
            }
        }
    }
    let paint = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let mut screen = Screen::default();
    let mut terminal = Terminal::take(Keys::ButSignals);
    if let Err(error) = give_back_at(&[SIGQUIT], Duration::ZERO) {
        log::warn!("the terminal is not given back if SIGQUIT ends the program: {error}");
    }
    loop {
        let is_over = is_over(DRAW_PERIOD);
        let quit = Key::Other(KeyCode::Char('q'));
        if !is_over && terminal.keys(Duration::ZERO).is_ok_and(|keys| keys.contains(&quit)) {
            // SIGTERM to ourselves: the program ends in order, as by Ctrl-C.
            kill(getpid(), Signal::SIGTERM)?;
        }
        let drawing = screen.draw(picture(&look(), paint), size());
        if !drawing.is_empty() {
            terminal.change(drawing, all_scrolls())?;
        }
        if is_over {
            return Ok(());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_testkit::names::any_name;
    use pinion_testkit::names::assert_plain;
    use proptest::prelude::*;

    pub(crate) fn item(kind: Kind, name: &str, value: Option<f64>, text: &str) -> Item {
        let number = value.map(|value| Number { value, step: 1.0, ripple: 0.0 });
        Item { kind, name: name.into(), number, text: text.into() }
    }

    proptest! {
        #[test]
        fn a_name_stays_in_its_line_and_moves_nothing(name in any_name()) {
            // The rows of a display have our own line feeds between them.
            let text = name.replace('\n', "");
            let items = || [Kind::Axis, Kind::Part].map(|kind| item(kind, &name, None, &text).plain());
            for line in picture(&items(), false) {
                assert_plain(&line, 0);
            }
            for line in picture(&items(), true) {
                assert_plain(&line.replace("\x1b[48;2;", "").replace("\x1b[m", ""), 0);
            }
            let lines = Changes::default().lines(&items(), Duration::ZERO, false);
            assert_plain(&lines, lines.matches('\n').count());
        }
    }

    #[test]
    fn colours_are_found_in_any_text() {
        assert_eq!(name_colours("#ff0000 off #00ff00+20"), "red#ff0000 off green#00ff00+20");
        assert_eq!(name_colours("# #12 #é12345 #zzzzzz"), "# #12 #é12345 #zzzzzz");
        assert_eq!(paint_colours("a #0a0b0c"), "a \x1b[48;2;10;11;12m   \x1b[m");
    }

    #[test]
    fn the_picture_has_a_line_for_each_kind() {
        let items = [
            item(Kind::Axis, "x", None, "1 mm"),
            item(Kind::Axis, "y", None, "2 mm"),
            item(Kind::Fan, "fan", None, "0 rpm"),
            item(Kind::Part, "strip", None, "off"),
            item(Kind::Part, "display", None, "⠁\n⠂"),
        ];
        let lines = ["axes     x 1 mm   y 2 mm", "fans     fan 0 rpm", "strip    off", "display", "⠁", "⠂"];
        assert_eq!(picture(&items, true), lines);
    }

    #[test]
    fn a_long_name_moves_only_its_own_line() {
        let long = "x".repeat(70_000);
        let items = [
            item(Kind::Fan, "fan", None, "0 rpm"),
            item(Kind::Part, "größer", None, "on"),
            item(Kind::Part, &long, None, "off"),
        ];
        assert_eq!(
            picture(&items, true),
            ["fans    fan 0 rpm".to_owned(), "größer  on".to_owned(), format!("{long}  off")]
        );
    }

    /// The display of a terminal of 10 rows, as far as the sequences here need it.
    #[derive(Default)]
    struct Terminal {
        screen: [String; 10],
        row: usize,
        saved: usize,
        /// The last row that scrolls, counted from 1.
        bottom: usize,
    }

    impl Terminal {
        fn take(&mut self, mut text: &str) {
            while let Some(first) = text.chars().next() {
                if let Some(rest) = text.strip_prefix("\x1b[") {
                    let end = rest.find(|c: char| c.is_ascii_alphabetic()).unwrap();
                    let numbers: Vec<usize> = rest[..end].split(';').filter_map(|n| n.parse().ok()).collect();
                    match (&rest[end..=end], &numbers[..]) {
                        ("H", [row, 1]) => self.row = row.min(&10) - 1,
                        ("A", [rows]) => self.row -= rows,
                        ("r", [1, bottom]) => (self.bottom, self.row) = (*bottom, 0),
                        ("r", []) => (self.bottom, self.row) = (10, 0),
                        ("M", [999]) => self.screen[self.row..].fill(String::new()),
                        ("K" | "l" | "h", _) => {}
                        other => panic!("{other:?}"),
                    }
                    text = &rest[end + 1..];
                    continue;
                }
                text = &text[first.len_utf8()..];
                match first {
                    '\x1b' if text.starts_with('7') => self.saved = self.row,
                    '\x1b' if text.starts_with('8') => self.row = self.saved,
                    '\n' if self.row + 1 == self.bottom => self.screen[..self.bottom].rotate_left(1),
                    '\n' if self.row < 9 => self.row += 1,
                    '\n' => {}
                    _ => {
                        let line = text.find(['\x1b', '\n']).unwrap_or(text.len());
                        self.screen[self.row] = format!("{first}{}", &text[..line]);
                        text = &text[line..];
                        continue;
                    }
                }
                if first == '\x1b' {
                    text = &text[1..];
                }
                if first == '\n' && self.row + 1 == self.bottom {
                    self.screen[self.row].clear();
                }
            }
        }

        fn rows(&self) -> Vec<&str> {
            self.screen.iter().map(String::as_str).collect()
        }
    }

    #[test]
    fn the_picture_stays_at_the_bottom_and_the_log_scrolls_above_it() {
        const SIZE: Size = Size { rows: 10, columns: 80 };
        let mut terminal = Terminal { bottom: 10, ..Terminal::default() };
        let mut screen = Screen::default();
        let lines = |lines: &[&str]| lines.iter().map(|line| (*line).to_owned()).collect::<Vec<_>>();
        terminal.take("shell\n");
        terminal.take(&screen.draw(lines(&["a", "b"]), SIZE));
        assert_eq!(terminal.rows()[8..], ["a", "b"]);
        terminal.take("log\n");
        assert_eq!(terminal.rows()[..3], ["shell", "log", ""], "the log goes on where the shell was");
        for n in 0..20 {
            terminal.take(&format!("log {n}\n"));
        }
        assert_eq!(terminal.rows()[5..], ["log 18", "log 19", "", "a", "b"]);
        assert_eq!(screen.draw(lines(&["a", "b"]), SIZE), "", "nothing changed");
        terminal.take(&screen.draw(lines(&["a", "c", "d"]), SIZE));
        assert_eq!(terminal.rows()[7..], ["a", "c", "d"]);
        terminal.take("log\n");
        assert_eq!(terminal.rows()[5..], ["log", "", "a", "c", "d"]);
        // A narrower terminal has moved the picture: a line of it is in two rows. The cursor still is where the log ends.
        terminal.screen[..].rotate_left(1);
        terminal.screen[9] = "d, wrapped".into();
        terminal.row -= 1;
        terminal.bottom = 10;
        terminal.take(&screen.draw(lines(&["a", "c", "d"]), Size { columns: 40, ..SIZE }));
        assert_eq!(terminal.rows()[3..], ["log 19", "log", "", "", "a", "c", "d"]);
        // This is too much for the terminal: three rows are the log's.
        let many = screen.draw((0..30).map(|n| n.to_string()).collect(), SIZE);
        terminal.take(&many);
        assert_eq!(terminal.rows()[8..], ["5", "... and 24 lines more, on a terminal with more rows"]);
        terminal.take(&all_scrolls());
        assert_eq!((terminal.bottom, terminal.row), (10, 9), "all of it scrolls again, and below the picture");
    }
}
