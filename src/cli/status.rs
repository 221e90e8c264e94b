// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion status`: asks a running Pinion how it is.

#![forbid(unsafe_code)]

use std::io::{self, IsTerminal, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::signal::{Signal, raise};
use nix::sys::termios::{LocalFlags, SetArg, SpecialCharacterIndices, Termios, tcgetattr, tcsetattr};
use serde_json::Value;
use signal_hook::consts::{SIGINT, SIGQUIT, SIGTERM};

use crate::runtime::status::connect;
use crate::runtime::{hang_up, socket_paths};
use crate::sys;

use super::page::{Page, draw, print};
use super::{failed, not_permitted};

/// How long the answer may take. The program gives its core a second.
const PATIENCE: Duration = Duration::from_secs(5);
/// Between two looks of `--watch`.
const PERIOD: Duration = Duration::from_secs(1);
/// No answer is longer.
const ANSWER_MAX: usize = 4 << 20;

/// Options of `pinion status`.
#[derive(Args, Clone, Debug)]
pub(super) struct StatusArgs {
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Print metrics for a Prometheus scraper
    #[arg(long, conflicts_with = "json")]
    prometheus: bool,
    /// Print it anew each second: in place on a terminal, where arrows and page keys scroll, until q or Ctrl-C;
    /// elsewhere one after the other
    #[arg(long)]
    watch: bool,
    /// The link of the instance to ask
    #[arg(short = 'I', value_name = "PATH", default_value = "/tmp/klipper_host_mcu")]
    symlink: PathBuf,
    /// Its socket, if that is not where the link's name says
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

/// Prints what the instance tells.
pub(super) fn run(args: &StatusArgs) -> ExitCode {
    let done = match args.watch {
        true => watch(args),
        false => ask(args).and_then(|status| print(&show(args, &status))),
    };
    done.map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn show(args: &StatusArgs, status: &Value) -> Page {
    if args.json {
        return Page::json(&format!("{status:#}\n"));
    }
    if args.prometheus { metrics(status) } else { text(status) }
}

/// Asks the first of the sockets that answers.
fn ask(args: &StatusArgs) -> Result<Value, String> {
    let paths = args.socket.clone().map_or_else(|| socket_paths(&args.symlink), |path| vec![path]);
    let mut missing = Vec::new();
    for path in &paths {
        match ask_at(path) {
            Ok(status) => return Ok(status),
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused) => {
                missing.push(path.display().to_string());
            }
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
                return Err(not_permitted(path, path));
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                return Err(format!(
                    "{} is asked by too many at once: end those who ask it again and again (sudo ss -xp tells who they are)",
                    path.display()
                ));
            }
            Err(error) => {
                return Err(format!("{} gives no answer: {error}; does Pinion hang? (its log)", path.display()));
            }
        }
    }
    Err(format!(
        "no Pinion answers on {}: is it running (systemctl status pinion-mcu), and with the link {}?",
        missing.join(" or "),
        args.symlink.display()
    ))
}

fn ask_at(path: &Path) -> io::Result<Value> {
    let until = Instant::now() + PATIENCE;
    // Others may ask as well: then it takes a while until there is room for one more.
    let mut socket = loop {
        match connect(path) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock && Instant::now() < until => {
                thread::sleep(Duration::from_millis(10));
            }
            connected => break connected?,
        }
    };
    let (mut answer, mut piece) = (Vec::new(), [0; 16384]);
    loop {
        match socket.read(&mut piece) {
            Ok(0) => break,
            Ok(read) if answer.len() + read <= ANSWER_MAX => answer.extend_from_slice(&piece[..read]),
            Ok(_) => return Err(io::Error::other("what it says has no end")),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                let left = until.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return Err(io::ErrorKind::TimedOut.into());
                }
                let mut fds = [PollFd::new(socket.as_fd(), PollFlags::POLLIN)];
                let _ = poll(&mut fds, PollTimeout::try_from(left).unwrap_or(PollTimeout::MAX));
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    serde_json::from_slice(&answer).map_err(|error| io::Error::other(format!("that is no status ({error})")))
}

// ---- for people

/// A text of the status, or what else stands in its place.
fn word(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

fn rows<'a>(status: &'a Value, key: &str) -> &'a [Value] {
    status[key].as_array().map_or(&[], Vec::as_slice)
}

/// Seconds as people say them.
fn span(seconds: &Value) -> String {
    let seconds = seconds.as_f64().unwrap_or_default() as u64;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3600..86400 => format!("{} h {} min", seconds / 3600, seconds / 60 % 60),
        _ => format!("{} d {} h", seconds / 86400, seconds / 3600 % 24),
    }
}

/// The status as a page.
fn text(status: &Value) -> Page {
    let mut page = Page::default();
    let mut row = |head: &str, text: String| page.line(format_args!("{head:<10}{text}"));
    row(
        "pinion",
        format!("{}, process {}, up for {}", word(&status["version"]), status["pid"], span(&status["uptime_s"])),
    );
    row("link", format!("{} ({})", word(&status["link"]), word(&status["terminal"])));
    row("board", word(&status["board"]));
    let state = match status["state"].as_str().unwrap_or_default() {
        "waiting" => "waiting for a host's configuration".to_owned(),
        "configuring" => "a host has begun to configure it".to_owned(),
        "configured" => "configured".to_owned(),
        "shutdown" => {
            let stop = &status["shutdown"];
            format!("SHUT DOWN {} ago: {}: {}", span(&stop["ago_s"]), word(&stop["reason"]), word(&stop["detail"]))
        }
        _ => "unknown: the core has not answered within a second: it is busy with steps, or hangs".to_owned(),
    };
    row("state", state);
    if !status["owes"].is_null() {
        row("", format!("{} is not at its shutdown value yet", word(&status["owes"])));
    }
    row("host", host(status));
    row(
        "guardian",
        match &status["guardian"]["pid"] {
            Value::Null => "none, as this board needs none".to_owned(),
            pid => format!("process {pid}"),
        },
    );
    let late = &status["lateness"];
    if late["timers"].as_u64().is_some_and(|timers| timers > 0) {
        row(
            "timers",
            format!(
                "{} run, late by p50 {} us, p99 {} us, p99.9 {} us, at most {} us; the core wakes {} us early",
                late["timers"], late["p50_us"], late["p99_us"], late["p999_us"], late["max_us"], late["margin_us"]
            ),
        );
    }
    let queues = &status["queues"];
    if !queues.is_null() {
        let held = if queues["commands"]["held"] == true { " (they wait for a bus)" } else { "" };
        let workers: String = queues["workers"]
            .as_array()
            .into_iter()
            .flatten()
            .map(|worker| format!(", {} {}", word(&worker["name"]), worker["waiting"]))
            .collect();
        row(
            "queues",
            format!(
                "moves {} of {}, commands {}{held}{workers}",
                queues["moves"]["waiting"], queues["moves"]["size"], queues["commands"]["waiting"]
            ),
        );
    }
    let lines = rows(status, "lines").iter().map(|line| {
        let level = match line["level"].as_u64() {
            Some(1) => "high",
            Some(_) => "low",
            None => "not looked at yet",
        };
        vec![word(&line["pin"]), word(&line["use"]), level.to_owned(), transfers(&line["bus"]).unwrap_or_default()]
    });
    table(&mut page, "lines", lines.collect());
    let objects = rows(status, "objects").iter().map(|object| {
        let oid = if object["oid"].is_null() { String::new() } else { format!("oid {}", object["oid"]) };
        let pin = if object["pin"].is_null() { String::new() } else { word(&object["pin"]) };
        let mut facts = Vec::new();
        for (key, value) in object["value"].as_object().into_iter().flatten() {
            let share = |what: &str| format!("{what} {:.1} %", value.as_f64().unwrap_or_default() * 100.0);
            facts.push(match key.as_str() {
                "adc" => share("reads"),
                "duty" => share("on"),
                _ => format!("at {value} steps"),
            });
        }
        if object["queued"].as_u64().is_some_and(|queued| queued > 0) {
            facts.push(format!("{} queued", object["queued"]));
        }
        facts.extend(transfers(&object["bus"]));
        vec![oid, word(&object["kind"]), pin, facts.join(", ")]
    });
    table(&mut page, "objects", objects.collect());
    page
}

/// What went over a bus, if anything can.
fn transfers(bus: &Value) -> Option<String> {
    let counts = bus.as_object()?;
    let count = |key: &str| counts.get(key).unwrap_or(&Value::Null);
    let (transfers, errors, retries) = (count("transfers"), count("errors"), count("retries"));
    Some(format!("{transfers} transfers, {errors} failed, {retries} of them tried again"))
}

fn host(status: &Value) -> String {
    let host = &status["host"];
    let dialect =
        if status["dialect"].is_null() { String::new() } else { format!("; dialect {}", word(&status["dialect"])) };
    if host["attached"] != true {
        return format!("none is attached{dialect}");
    }
    let who = match &host["pid"] {
        Value::Null => "attached".to_owned(),
        pid => format!("{}process {pid}", if host["sure"] == true { "" } else { "probably " }),
    };
    let commit = if host["commit"].is_null() { String::new() } else { format!(" ({})", word(&host["commit"])) };
    match &host["checkout"] {
        Value::Null => format!("{who}{dialect}"),
        folder => format!("{who}, klippy of {}{commit}{dialect}", word(folder)),
    }
}

fn table(page: &mut Page, head: &str, rows: Vec<Vec<String>>) {
    let columns = rows.first().map_or(0, Vec::len);
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    for (n, row) in rows.iter().enumerate() {
        let cells: String = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:<width$}  ")).collect();
        page.line(format_args!("{:<10}{}", if n == 0 { head } else { "" }, cells.trim_end()));
    }
}

// ---- for a scraper

/// The status in Prometheus's text exposition format, version 0.0.4.
fn metrics(status: &Value) -> Page {
    let mut out = Metrics(Page::default());
    let number = |value: &Value| value.as_f64().unwrap_or_default();
    out.head("pinion_info", "gauge", "The program and the host that it serves");
    out.sample(
        "pinion_info",
        &[("version", &status["version"]), ("link", &status["link"]), ("dialect", &status["dialect"])],
        1.0,
    );
    out.one("pinion_uptime_seconds", "gauge", "Time since the start", number(&status["uptime_s"]));
    out.head("pinion_state", "gauge", "1 for the state that the machine is in");
    for state in ["unknown", "waiting", "configuring", "configured", "shutdown"] {
        out.sample("pinion_state", &[("state", &state.into())], f64::from(u8::from(status["state"] == state)));
    }
    if !status["shutdown"].is_null() {
        out.head("pinion_shutdown_info", "gauge", "Why the machine is shut down");
        out.sample("pinion_shutdown_info", &[("reason", &status["shutdown"]["reason"])], 1.0);
    }
    out.one(
        "pinion_host_attached",
        "gauge",
        "Whether a host is there",
        f64::from(u8::from(status["host"]["attached"] == true)),
    );
    out.one(
        "pinion_guardian_present",
        "gauge",
        "Whether a guardian holds the outputs",
        f64::from(u8::from(status["guardian"]["present"] == true)),
    );
    let late = &status["lateness"];
    if !late.is_null() {
        let name = "pinion_timer_lateness_seconds";
        out.head(name, "summary", "How late timers ran, since the start");
        for (quantile, key) in [("0.5", "p50_us"), ("0.99", "p99_us"), ("0.999", "p999_us"), ("1", "max_us")] {
            out.sample(name, &[("quantile", &quantile.into())], number(&late[key]) / 1e6);
        }
        out.sample("pinion_timer_lateness_seconds_count", &[], number(&late["timers"]));
    }
    let queues = &status["queues"];
    if !queues.is_null() {
        out.one("pinion_moves_queued", "gauge", "Moves in the move queue", number(&queues["moves"]["waiting"]));
        out.one("pinion_moves_size", "gauge", "Moves that the queue has room for", number(&queues["moves"]["size"]));
        out.one(
            "pinion_commands_waiting",
            "gauge",
            "Blocks of commands that wait for the core",
            number(&queues["commands"]["waiting"]),
        );
        out.head("pinion_worker_jobs", "gauge", "Jobs that wait for a bus");
        for worker in queues["workers"].as_array().into_iter().flatten() {
            out.sample("pinion_worker_jobs", &[("bus", &worker["name"])], number(&worker["waiting"]));
        }
    }
    out.head("pinion_line_level", "gauge", "Level of a GPIO line, as last driven or sampled");
    for line in rows(status, "lines").iter().filter(|line| !line["level"].is_null()) {
        out.sample("pinion_line_level", &[("pin", &line["pin"]), ("use", &line["use"])], number(&line["level"]));
    }
    for (key, help) in [
        ("transfers", "Transfers to a chip"),
        ("errors", "Transfers to a chip that failed"),
        ("retries", "Failed transfers that were tried again"),
    ] {
        let name = format!("pinion_bus_{key}_total");
        out.head(&name, "counter", help);
        for object in rows(status, "objects").iter().filter(|object| !object["bus"].is_null()) {
            out.sample(&name, &[("oid", &object["oid"]), ("kind", &object["kind"])], number(&object["bus"][key]));
        }
        for line in rows(status, "lines").iter().filter(|line| !line["bus"].is_null()) {
            out.sample(&name, &[("kind", &"line".into()), ("pin", &line["pin"])], number(&line["bus"][key]));
        }
    }
    for (name, kind, help) in [
        ("pinion_pwm_duty_ratio", "duty", "For how much of each period an output is on"),
        ("pinion_adc_ratio", "adc", "An ADC's last sample, of full scale"),
        ("pinion_stepper_position_steps", "steps", "A stepper's position"),
    ] {
        out.head(name, "gauge", help);
        for object in rows(status, "objects").iter().filter(|object| !object["value"][kind].is_null()) {
            out.sample(name, &[("oid", &object["oid"]), ("pin", &object["pin"])], number(&object["value"][kind]));
        }
    }
    out.0
}

struct Metrics(Page);

impl Metrics {
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        self.0.line(format_args!("# HELP {name} {help}"));
        self.0.line(format_args!("# TYPE {name} {kind}"));
    }

    fn sample(&mut self, name: &str, labels: &[(&str, &Value)], value: f64) {
        let labels = labels.iter().filter(|(_, value)| !value.is_null()).map(|(label, value)| {
            let value = word(value).replace('\\', "\\\\").replace('"', "\\\"");
            format!("{label}=\"{value}\"")
        });
        let labels = labels.collect::<Vec<_>>().join(",");
        let labels = if labels.is_empty() { labels } else { format!("{{{labels}}}") };
        self.0.line(format_args!("{name}{labels} {value}"));
    }

    fn one(&mut self, name: &str, kind: &str, help: &str, value: f64) {
        self.head(name, kind, help);
        self.sample(name, &[], value);
    }
}

// ---- again and again

/// Prints the status each second, until it is asked to end.
fn watch(args: &StatusArgs) -> Result<(), String> {
    let ended = Arc::new(AtomicBool::new(false));
    let hang_up = hang_up().map_err(|error| error.to_string())?;
    for signal in [SIGINT, SIGQUIT, SIGTERM].into_iter().chain(hang_up) {
        signal_hook::flag::register(signal, ended.clone())
            .map_err(|error| format!("signals can not be taken in: {error}"))?;
    }
    let (stdin, stdout) = (io::stdin(), io::stdout());
    let mut screen = stdout.is_terminal().then(|| Screen::enter(stdin.as_fd()));
    // An instance that can not be asked at the first time is a mistake, later one that is being restarted.
    let mut status = Some(ask(args)?);
    loop {
        let page = match status.take().map_or_else(|| ask(args), Ok) {
            Ok(status) => show(args, &status),
            Err(error) => Page::text(&error),
        };
        let shown = match &mut screen {
            Some(screen) => screen.show(page),
            None => draw(&format!("{page}\n")),
        };
        // A reader that is gone wants no more.
        if shown.is_err() {
            return Ok(());
        }
        let next = Instant::now() + PERIOD;
        while Instant::now() < next {
            let wish = match &mut screen {
                Some(screen) => screen.wish(stdin.as_fd()),
                None => {
                    thread::sleep(Duration::from_millis(20));
                    None
                }
            };
            if let (Some(Wish::Scroll(scroll)), Some(screen)) = (wish, &mut screen)
                && screen.scroll(scroll).is_err()
            {
                return Ok(());
            }
            if ended.load(Ordering::Relaxed) || wish == Some(Wish::End) {
                return Ok(());
            }
            if wish == Some(Wish::Stop) {
                drop(screen.take());
                // Where nobody could have it go on again, the kernel does not stop it.
                let _ = raise(Signal::SIGTSTP);
                screen = Some(Screen::enter(stdin.as_fd()));
                break;
            }
        }
    }
}

/// What a key asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wish {
    /// To end.
    End,
    /// To stop until the shell has it go on.
    Stop,
    /// To see another part of the page.
    Scroll(Scroll),
}

/// Which part of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scroll {
    /// So many lines further down.
    Lines(isize),
    /// So many screens further down.
    Screens(isize),
    Top,
    Bottom,
}

/// The keys that scroll, as terminals send them.
const SCROLL_KEYS: [(&[u8], Scroll); 18] = [
    (b"\x1b[A", Scroll::Lines(-1)),
    (b"\x1bOA", Scroll::Lines(-1)),
    (b"k", Scroll::Lines(-1)),
    (b"\x1b[B", Scroll::Lines(1)),
    (b"\x1bOB", Scroll::Lines(1)),
    (b"j", Scroll::Lines(1)),
    (b"\x1b[5~", Scroll::Screens(-1)),
    (b"b", Scroll::Screens(-1)),
    (b"\x1b[6~", Scroll::Screens(1)),
    (b" ", Scroll::Screens(1)),
    (b"\x1b[H", Scroll::Top),
    (b"\x1bOH", Scroll::Top),
    (b"\x1b[1~", Scroll::Top),
    (b"g", Scroll::Top),
    (b"\x1b[F", Scroll::Bottom),
    (b"\x1bOF", Scroll::Bottom),
    (b"\x1b[4~", Scroll::Bottom),
    (b"G", Scroll::Bottom),
];

/// The lines of a page that are to be seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct View {
    /// How many are above.
    above: usize,
    /// How many there is room for.
    room: usize,
}

impl View {
    /// Moves over a page of so many lines.
    fn scroll(&mut self, scroll: Scroll, lines: usize) {
        let lowest = lines.saturating_sub(self.room);
        // What is at the edge stays in sight.
        let screen = self.room.saturating_sub(1).max(1) as isize;
        self.above = match scroll {
            Scroll::Lines(by) => self.above.saturating_add_signed(by),
            Scroll::Screens(by) => self.above.saturating_add_signed(by.saturating_mul(screen)),
            Scroll::Top => 0,
            Scroll::Bottom => lowest,
        }
        .min(lowest);
    }

    /// The lines of a page that are to be seen, and what is said below them.
    fn of<'a>(&mut self, page: &'a Page, ends: &str) -> (Vec<&'a str>, String) {
        let lines = page.lines().count();
        self.scroll(Scroll::Lines(0), lines);
        let shown: Vec<&str> = page.lines().skip(self.above).take(self.room).collect();
        let last = self.above + shown.len();
        let foot = match lines > self.room {
            true => format!("lines {} to {last} of {lines}: arrows and page keys show others; {ends}", self.above + 1),
            false => ends.to_owned(),
        };
        (shown, foot)
    }
}

/// A terminal that is drawn on in place: its alternate screen, without a cursor, long
/// lines cut off. Dropped, it is as before.
struct Screen {
    /// The settings to give back, if keys can be read.
    before: Option<Termios>,
    page: Page,
    view: View,
}

impl Screen {
    fn enter(keys: BorrowedFd<'_>) -> Screen {
        let before = tcgetattr(keys).ok();
        if let Some(before) = &before {
            let mut keyed = before.clone();
            // Those that make signals are keys, too: the kernel's would leave the terminal as it is here.
            keyed.local_flags.remove(LocalFlags::ICANON | LocalFlags::ECHO | LocalFlags::ISIG);
            let _ = tcsetattr(keys, SetArg::TCSANOW, &keyed);
        }
        let _ = draw("\x1b[?1049h\x1b[?25l\x1b[?7l");
        Screen { before, page: Page::default(), view: View::default() }
    }

    /// Shows a new page, at the place that the last one was seen at.
    fn show(&mut self, page: Page) -> io::Result<()> {
        self.page = page;
        self.draw()
    }

    fn scroll(&mut self, scroll: Scroll) -> io::Result<()> {
        self.view.scroll(scroll, self.page.lines().count());
        self.draw()
    }

    /// Draws as much of the page as the terminal has rows for.
    fn draw(&mut self) -> io::Result<()> {
        self.view.room = sys::terminal_rows(&io::stdout()).unwrap_or(24).saturating_sub(1);
        let ends = if self.before.is_some() { "q ends" } else { "Ctrl-C ends" };
        let (lines, foot) = self.view.of(&self.page, ends);
        let lines: String = lines.iter().map(|line| format!("{line}\x1b[K\r\n")).collect();
        draw(&format!("\x1b[H{lines}\x1b[J{foot}"))
    }

    /// What somebody has pressed a key for; waits a little for that.
    fn wish(&self, keys: BorrowedFd<'_>) -> Option<Wish> {
        let Some(before) = &self.before else {
            thread::sleep(Duration::from_millis(20));
            return None;
        };
        let mut fds = [PollFd::new(keys, PollFlags::POLLIN)];
        if !matches!(poll(&mut fds, 50u16), Ok(1)) {
            return None;
        }
        let mut pressed = [0; 64];
        match nix::unistd::read(keys, &mut pressed) {
            Ok(read @ 1..)
                if let Some((_, scroll)) = SCROLL_KEYS.iter().find(|(key, _)| pressed[..read].starts_with(key)) =>
            {
                Some(Wish::Scroll(*scroll))
            }
            Ok(read @ 1..) => pressed[..read].iter().find_map(|key| {
                let is = |special: SpecialCharacterIndices| before.control_chars[special as usize] == *key;
                match key {
                    b'q' | b'Q' => Some(Wish::End),
                    _ if is(SpecialCharacterIndices::VINTR) || is(SpecialCharacterIndices::VQUIT) => Some(Wish::End),
                    _ => is(SpecialCharacterIndices::VSUSP).then_some(Wish::Stop),
                }
            }),
            Err(nix::errno::Errno::EINTR) => None,
            // Without a terminal any more there is nobody to show anything.
            Ok(_) | Err(_) => Some(Wish::End),
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = draw("\x1b[?7h\x1b[?25h\x1b[?1049l");
        if let Some(before) = &self.before {
            let _ = tcsetattr(io::stdin().as_fd(), SetArg::TCSANOW, before);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::page::tests::assert_plain;
    use crate::foreign::tests::any_name;
    use proptest::prelude::*;
    use serde_json::json;

    fn status() -> Value {
        json!({
            "version": "1", "pid": 5, "uptime_s": 3700.0, "link": "/tmp/l", "terminal": "/dev/pts/1", "board": "b",
            "state": "shutdown", "shutdown": { "reason": "ADC out of range", "detail": "oid 3\u{1b}[2J", "ago_s": 61.0 },
            "dialect": "master", "owes": null,
            "host": { "attached": true, "pid": 7, "sure": true, "checkout": "/home/pi/klipper", "commit": "abc" },
            "guardian": { "present": true, "pid": 6 },
            "lines": [
                { "pin": "gpio\"1", "use": "output", "level": 1, "bus": null },
                { "pin": "gpio2", "use": "input", "level": null, "bus": { "transfers": 7, "errors": 3, "retries": 2 } },
            ],
            "objects": [
                { "oid": 0, "kind": "SPI device", "pin": "gpio8", "queued": 0, "value": null,
                  "bus": { "transfers": 9, "errors": 2, "retries": 1 } },
                { "oid": 1, "kind": "stepper", "pin": "gpio9", "queued": 3, "value": { "steps": -5 }, "bus": null },
            ],
            "lateness": { "timers": 10, "p50_us": 1.0, "p99_us": 2.0, "p999_us": 3.0, "max_us": 4.0, "margin_us": 50.0, "buckets_us": [] },
            "queues": { "moves": { "waiting": 3, "size": 1024 }, "commands": { "waiting": 0, "size": 256, "held": false },
                        "workers": [{ "name": "spi0", "waiting": 1 }] },
        })
    }

    #[test]
    fn a_page_tells_all_and_obeys_nothing() {
        let page = text(&status()).to_string();
        for line in [
            "pinion    1, process 5, up for 1 h 1 min",
            "state     SHUT DOWN 1 min 1 s ago: ADC out of range: oid 3?[2J",
            "host      process 7, klippy of /home/pi/klipper (abc); dialect master",
            "guardian  process 6",
            "queues    moves 3 of 1024, commands 0, spi0 1",
            "lines     gpio\"1  output  high",
            "          gpio2   input   not looked at yet  7 transfers, 3 failed, 2 of them tried again",
            "objects   oid 0  SPI device  gpio8  9 transfers, 2 failed, 1 of them tried again",
            "          oid 1  stepper     gpio9  at -5 steps, 3 queued",
        ] {
            assert!(page.lines().any(|shown| shown == line), "{line}\n{page}");
        }
        assert!(!page.contains('\x1b'));
        // What an instance does not tell is left out.
        assert!(text(&json!({ "state": "unknown" })).to_string().contains("the core has not answered"));
    }

    /// Puts a text in the place of each text that an instance tells.
    fn rename(value: &mut Value, name: &str) {
        match value {
            Value::String(text) => *text = name.to_owned(),
            Value::Array(values) => values.iter_mut().for_each(|value| rename(value, name)),
            Value::Object(values) => values.values_mut().for_each(|value| rename(value, name)),
            _ => {}
        }
    }

    proptest! {
        #[test]
        fn whatever_an_instance_tells_stays_in_its_line(name in any_name()) {
            let (mut hostile, mut harmless) = (status(), status());
            rename(&mut hostile, &name);
            rename(&mut harmless, "x");
            // By the state the page is another.
            (hostile["state"], harmless["state"]) = (json!("shutdown"), json!("shutdown"));
            for show in [text, metrics, |status: &Value| Page::json(&format!("{status:#}\n"))] {
                assert_plain(&show(&hostile).to_string(), show(&harmless).lines().count());
            }
        }
    }

    #[test]
    fn a_page_that_is_longer_than_the_screen_is_scrolled() {
        let lines = |count: u32| Page::text(&(1..=count).map(|n| format!("line {n}\n")).collect::<String>());
        let page = lines(40);
        let mut view = View { above: 0, room: 23 };
        let mut seen = |scroll: Scroll| {
            view.scroll(scroll, 40);
            let (lines, foot) = view.of(&page, "q ends");
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
        // A page that has become shorter is seen whole, or from where its last line is the last.
        let mut view = View { above: 17, room: 23 };
        assert_eq!(view.of(&lines(25), "q ends").0[0], "line 3");
        assert_eq!(view.of(&lines(2), "q ends"), (vec!["line 1", "line 2"], "q ends".to_owned()));
        assert_eq!(View::default().of(&lines(1), "q ends").0.len(), 0, "there is no room");
    }

    #[test]
    fn metrics_have_a_type_each_and_labels_that_end() {
        let metrics = metrics(&status()).to_string();
        for line in [
            "pinion_state{state=\"shutdown\"} 1",
            "pinion_state{state=\"configured\"} 0",
            "pinion_line_level{pin=\"gpio\\\"1\",use=\"output\"} 1",
            "pinion_timer_lateness_seconds{quantile=\"0.99\"} 0.000002",
            "pinion_timer_lateness_seconds_count 10",
            "pinion_bus_errors_total{oid=\"0\",kind=\"SPI device\"} 2",
            "pinion_bus_errors_total{kind=\"line\",pin=\"gpio2\"} 3",
            "pinion_worker_jobs{bus=\"spi0\"} 1",
        ] {
            assert!(metrics.lines().any(|shown| shown == line), "{line}\n{metrics}");
        }
        assert!(!metrics.contains("pinion_line_level{pin=\"gpio2"), "what was not looked at has no level");
        for sample in metrics.lines().filter(|line| !line.starts_with('#')) {
            let name = sample.split(['{', ' ']).next().unwrap().trim_end_matches("_count");
            assert_eq!(metrics.matches(&format!("# TYPE {name} ")).count(), 1, "{name}");
            sample.rsplit_once(' ').unwrap().1.parse::<f64>().unwrap();
        }
    }
}
