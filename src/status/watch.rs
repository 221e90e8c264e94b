// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion status --watch`: the status again each second.

use std::io::{self, IsTerminal};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, raise};
use signal_hook::consts::{SIGINT, SIGQUIT, SIGTERM};
use termina::escape::csi::DecPrivateModeCode as Code;
use termina::event::KeyCode;

use crate::page::{Page, draw};
use crate::terminal::{ERASE_BELOW, ERASE_LINE, Key, Keys, Terminal, give_back_at, off, on, size, to_row};
use pinion_runtime::hang_up;

use super::ask::ask;
use super::text::HEAD;
use super::{StatusArgs, show};

/// Time between two questions.
const PERIOD: Duration = Duration::from_secs(1);
/// How long the loop may take to end after a signal: longer than an answer takes. A terminal that takes no output, as
/// after Ctrl-S, keeps the loop forever.
const GRACE: Duration = Duration::from_secs(6);
/// Longest wait for a key before the loop checks for a signal.
const KEY_WAIT: Duration = Duration::from_millis(50);

/// Prints the status each second, until it is asked to end.
pub(super) fn watch(args: &StatusArgs) -> Result<(), String> {
    let ended = Arc::new(AtomicBool::new(false));
    let hang_up = hang_up().map_err(|error| error.to_string())?;
    let signals: Vec<i32> = [SIGINT, SIGQUIT, SIGTERM].into_iter().chain(hang_up).collect();
    for signal in &signals {
        signal_hook::flag::register(*signal, ended.clone())
            .map_err(|error| format!("signals cannot be received: {error}"))?;
    }
    give_back_at(&signals, GRACE)?;
    // If the instance does not answer at first, the command was a mistake. Later the instance may be restarting.
    let first = ask(args)?;
    if let Some(notice) = &first.notice {
        log::warn!("{notice}");
    }
    let mut first = Some(first);
    let mut screen = io::stdout().is_terminal().then(Screen::enter).transpose().map_err(gone)?;
    loop {
        let page = match first.take().map_or_else(|| ask(args), Ok) {
            Ok(answer) => show(args, &answer.status),
            Err(error) => Page::text(&error),
        };
        let shown = match &mut screen {
            Some(screen) => screen.show(page),
            None => draw(&format!("{page}\n")),
        };
        // The reader is gone and wants no more.
        if shown.is_err() {
            return Ok(());
        }
        let mut next = Instant::now() + PERIOD;
        while Instant::now() < next {
            let wishes = match &mut screen {
                Some(screen) => screen.wishes(),
                None => {
                    thread::sleep(KEY_WAIT);
                    vec![]
                }
            };
            if ended.load(Ordering::Relaxed) {
                return Ok(());
            }
            for wish in wishes {
                match (wish, &mut screen) {
                    (Wish::End, _) => return Ok(()),
                    (Wish::Scroll(scroll), Some(screen)) => {
                        if screen.scroll(scroll).is_err() {
                            return Ok(());
                        }
                    }
                    (Wish::Scroll(_), None) => {}
                    (Wish::Stop, _) => {
                        drop(screen.take());
                        // The kernel does not stop it if nobody could continue it.
                        let _ = raise(Signal::SIGTSTP);
                        screen = Some(Screen::enter().map_err(gone)?);
                        next = Instant::now();
                    }
                }
            }
        }
    }
}

fn gone(error: io::Error) -> String {
    format!("the terminal cannot be written: {error}")
}

/// The wish behind a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wish {
    /// End.
    End,
    /// Stop until the shell continues the program.
    Stop,
    /// Show another part of the page.
    Scroll(Scroll),
}

/// A part of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scroll {
    /// This many lines further down.
    Lines(isize),
    /// This many screens further down.
    Screens(isize),
    Top,
    Bottom,
}

/// The wish behind a key, if it has one.
fn wish(key: Key) -> Option<Wish> {
    Some(match key {
        Key::End | Key::Other(KeyCode::Char('q' | 'Q')) => Wish::End,
        Key::Stop => Wish::Stop,
        Key::Other(KeyCode::Up | KeyCode::Char('k')) => Wish::Scroll(Scroll::Lines(-1)),
        Key::Other(KeyCode::Down | KeyCode::Char('j')) => Wish::Scroll(Scroll::Lines(1)),
        Key::Other(KeyCode::PageUp | KeyCode::Char('b')) => Wish::Scroll(Scroll::Screens(-1)),
        Key::Other(KeyCode::PageDown | KeyCode::Char(' ')) => Wish::Scroll(Scroll::Screens(1)),
        Key::Other(KeyCode::Home | KeyCode::Char('g')) => Wish::Scroll(Scroll::Top),
        Key::Other(KeyCode::End | KeyCode::Char('G')) => Wish::Scroll(Scroll::Bottom),
        Key::Other(_) => return None,
    })
}

/// The visible lines of a page.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct View {
    /// How many lines are above.
    above: usize,
    /// How many lines there is room for.
    room: usize,
}

impl View {
    /// Moves over a page of `lines` lines.
    fn scroll(&mut self, scroll: Scroll, lines: usize) {
        let lowest = lines.saturating_sub(self.room);
        // The line at the edge stays in sight.
        let screen = self.room.saturating_sub(1).max(1) as isize;
        self.above = match scroll {
            Scroll::Lines(by) => self.above.saturating_add_signed(by),
            Scroll::Screens(by) => self.above.saturating_add_signed(by.saturating_mul(screen)),
            Scroll::Top => 0,
            Scroll::Bottom => lowest,
        }
        .min(lowest);
    }

    /// The visible ones of a page's lines, and the text below them, for this many columns.
    fn of<'a>(&mut self, lines: &'a [String], ends: &str, columns: usize) -> (&'a [String], String) {
        let count = lines.len();
        self.scroll(Scroll::Lines(0), count);
        let last = count.min(self.above + self.room);
        let shown = &lines[self.above..last];
        let place = format!("lines {} to {last} of {count}", self.above + 1);
        let feet = match count > self.room {
            true => vec![format!("{place}: arrows and page keys show others; {ends}"), format!("{place}; {ends}")],
            false => vec![],
        };
        let foot = feet.into_iter().find(|foot| foot.chars().count() <= columns).unwrap_or_else(|| ends.to_owned());
        (shown, foot)
    }
}

/// The lines of a page on a terminal with this many columns. A long line goes on in the next row, below its text.
fn wrapped(page: &Page, columns: usize) -> Vec<String> {
    let indent = " ".repeat(HEAD.min(columns / 2));
    let mut rows = Vec::new();
    for line in page.lines() {
        let (mut rest, mut before) = (line, "");
        while let Some((end, _)) = rest.char_indices().nth(columns.saturating_sub(before.len()).max(1)) {
            // A word that is longer than a row is cut.
            let cut = rest[..=end].rfind(' ').filter(|at| !rest[..*at].trim().is_empty()).unwrap_or(end);
            rows.push(format!("{before}{}", rest[..cut].trim_end()));
            (rest, before) = (rest[cut..].trim_start(), &indent);
        }
        rows.push(format!("{before}{rest}"));
    }
    rows
}

/// A terminal that is drawn on in place: its alternate screen, without a cursor. When this is dropped, the terminal is
/// as before.
struct Screen {
    terminal: Terminal,
    page: Page,
    view: View,
}

impl Screen {
    fn enter() -> io::Result<Screen> {
        let (alternate, cursor, wrap) = (Code::ClearAndEnableAlternateScreen, Code::ShowCursor, Code::AutoWrap);
        let terminal = Terminal::take(Keys::All);
        terminal.change(
            format_args!("{}{}{}", on(alternate), off(cursor), off(wrap)),
            format_args!("{}{}{}", on(wrap), on(cursor), off(alternate)),
        )?;
        Ok(Screen { terminal, page: Page::default(), view: View::default() })
    }

    /// Shows a new page, at the place of the last one.
    fn show(&mut self, page: Page) -> io::Result<()> {
        self.page = page;
        self.draw()
    }

    fn scroll(&mut self, scroll: Scroll) -> io::Result<()> {
        self.view.scroll(scroll, wrapped(&self.page, size().columns).len());
        self.draw()
    }

    /// Draws as much of the page as the terminal has rows for.
    fn draw(&mut self) -> io::Result<()> {
        let size = size();
        self.view.room = size.rows.saturating_sub(1);
        let ends = if self.terminal.has_keys() { "q ends" } else { "Ctrl-C ends" };
        let lines = wrapped(&self.page, size.columns);
        let (lines, foot) = self.view.of(&lines, ends, size.columns);
        let lines: String = lines.iter().map(|line| format!("{line}{ERASE_LINE}\r\n")).collect();
        draw(&format!("{}{lines}{ERASE_BELOW}{foot}", to_row(1)))
    }

    /// The wishes behind the pressed keys. It waits a little for a key.
    fn wishes(&mut self) -> Vec<Wish> {
        match self.terminal.keys(KEY_WAIT) {
            Ok(keys) => keys.into_iter().filter_map(wish).collect(),
            // Without a terminal there is nobody to show anything to.
            Err(_) => vec![Wish::End],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_that_is_longer_than_the_screen_is_scrolled() {
        let lines = |count: u32| (1..=count).map(|n| format!("line {n}")).collect::<Vec<_>>();
        let page = lines(40);
        let mut view = View { above: 0, room: 23 };
        let mut seen = |scroll: Scroll| {
            view.scroll(scroll, 40);
            let (lines, foot) = view.of(&page, "q ends", 80);
            assert_eq!(lines.len(), 23);
            assert!(foot.chars().count() < 80 && foot.ends_with("; q ends"), "{foot}");
            let (first, last) = (lines[0].to_owned(), lines[22].to_owned());
            assert!(foot.starts_with(&format!("{first} to {}", &last[5..]).replacen("line", "lines", 1)), "{foot}");
            first
        };
        for (scroll, first) in [
            (Scroll::Lines(0), "line 1"),
            (Scroll::Lines(-1), "line 1"),
            (Scroll::Lines(1), "line 2"),
            (Scroll::Screens(1), "line 18"),
            (Scroll::Lines(1), "line 18"),
            (Scroll::Screens(-1), "line 1"),
            (Scroll::Bottom, "line 18"),
            (Scroll::Top, "line 1"),
        ] {
            assert_eq!(seen(scroll), first, "{scroll:?}");
        }
        // A page that has become shorter is shown whole, or so that its last line is the last one shown.
        let mut view = View { above: 17, room: 23 };
        assert_eq!(view.of(&lines(25), "q ends", 80).0[0], "line 3");
        assert_eq!(view.of(&lines(2), "q ends", 80), (&lines(2)[..], "q ends".to_owned()));
        assert_eq!(View::default().of(&lines(1), "q ends", 80).0.len(), 0, "there is no room");
    }

    #[test]
    fn the_text_below_a_page_fits_a_narrow_terminal() {
        let page: Vec<String> = (1..=40).map(|n| format!("line {n}")).collect();
        let foot = |columns| View { above: 0, room: 23 }.of(&page, "q ends", columns).1;
        assert_eq!(foot(61), "lines 1 to 23 of 40: arrows and page keys show others; q ends");
        assert_eq!(foot(60), "lines 1 to 23 of 40; q ends");
        assert_eq!(foot(20), "q ends");
    }

    #[test]
    fn a_long_line_goes_on_below_its_text() {
        let page =
            Page::text("state     SHUT DOWN: the ADC is out of range\nabcdefghijklmnopqrstuvwxyz0123456789\n\nshort\n");
        let rows = wrapped(&page, 24);
        let wanted = [
            "state     SHUT DOWN: the",
            "          ADC is out of",
            "          range",
            "abcdefghijklmnopqrstuvwx",
            "          yz0123456789",
            "",
            "short",
        ];
        assert_eq!(rows, wanted);
        assert_eq!(wrapped(&page, 200).len(), 4);
        for columns in 0..60 {
            let rows = wrapped(&page, columns);
            let letters = |text: &str| text.chars().filter(|c| *c != ' ').collect::<String>();
            assert_eq!(letters(&rows.concat()), letters(&page.lines().collect::<String>()), "{columns}");
            assert!(rows.iter().all(|row| row.chars().count() <= columns.max(1)), "{columns} {rows:?}");
        }
    }
}
