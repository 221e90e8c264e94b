// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion trace`: why the MCU stopped and who was late, from a recording of its last seconds.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use clap::{Args, ValueHint};

use pinion_firmware::time::NS_PER_TICK;

use pinion_linux::foreign;
use pinion_runtime::{socket_paths, trace_socket_paths};
use pinion_trace::event::Event;
use pinion_trace::file::Trace;
use pinion_trace::folder::{all, folders, kept, name_of, utc_text};
use pinion_trace::verdict::verdict;
use pinion_trace::{perfetto, svg, timeline, vcd};

use super::failed;
use super::page::{Page, aligned, print};
use super::status::fetch;
use pinion_system::files::Output;

/// The link of an instance, if none is named.
const LINK: &str = "/tmp/klipper_host_mcu";
/// Longest recording that an instance sends.
const TRACE_MAX: usize = 64 << 20;
/// The part of a recording that is shown.
const SHOWN: Duration = Duration::from_secs(10);

/// Options of `pinion trace`.
#[derive(Args, Clone, Debug)]
pub(crate) struct TraceArgs {
    /// The recording [default: the newest one]
    #[arg(value_name = "FILE", value_hint = ValueHint::FilePath)]
    file: Option<PathBuf>,
    /// The newest recording (the default)
    #[arg(long, conflicts_with = "file")]
    last: bool,
    /// Record a running Pinion for this time, for example 5 or 5s
    #[arg(long, value_name = "SECONDS", value_hint = ValueHint::Other, value_parser = seconds,
        conflicts_with_all = ["file", "last"])]
    live: Option<Duration>,
    /// List the kept recordings with their verdicts
    #[arg(long, conflicts_with_all = ["file", "last", "live", "vcd", "perfetto", "svg"])]
    list: bool,
    /// Write the signals for PulseView or GTKWave
    #[arg(long, value_name = "OUT", value_hint = ValueHint::FilePath)]
    vcd: Option<PathBuf>,
    /// Write the events for ui.perfetto.dev
    #[arg(long, value_name = "OUT", value_hint = ValueHint::FilePath)]
    perfetto: Option<PathBuf>,
    /// Draw the verdict and 200 ms until 10 ms after the stop
    #[arg(long, value_name = "OUT", value_hint = ValueHint::FilePath)]
    svg: Option<PathBuf>,
    /// The link of the instance [default: any instance; with --live /tmp/klipper_host_mcu]
    #[arg(short = 'I', value_name = "PATH", conflicts_with = "file", value_hint = ValueHint::FilePath)]
    symlink: Option<PathBuf>,
    /// With --live, the socket of the instance's status, if its path does not follow from the link's name
    #[arg(long, value_name = "PATH", requires = "live")]
    socket: Option<PathBuf>,
}

/// Reads a number of seconds, with or without its unit.
fn seconds(text: &str) -> Result<Duration, String> {
    let number = text.strip_suffix('s').unwrap_or(text).parse().ok().filter(|seconds| (1..=10).contains(seconds));
    number.map(Duration::from_secs).ok_or_else(|| "a recording lasts 1 to 10 seconds".to_owned())
}

/// Prints the verdict and the timeline, or the list.
pub(crate) fn run(args: &TraceArgs) -> ExitCode {
    let done = if args.list { list(args) } else { show(args) };
    done.map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn show(args: &TraceArgs) -> Result<(), String> {
    let (from, trace, shown) = match (&args.file, args.live) {
        (_, Some(span)) => {
            let (socket, trace) = live(args, span)?;
            (socket, trace, span)
        }
        (Some(file), None) => (file.clone(), read(file).map_err(|error| unreadable(file, &error))?, SHOWN),
        (None, None) => {
            let newest = traces(args)?.into_iter().next().ok_or_else(none)?;
            let trace = read(&newest).map_err(|error| unreadable(&newest, &error))?;
            (newest, trace, SHOWN)
        }
    };
    let mut page = Page::default();
    page.line(format_args!("verdict: {}", verdict(&trace).text));
    let (at, head) = (utc_text(trace.head.utc_ms), &trace.head);
    page.line(format_args!("{}: {} at {}, until {at}", from.display(), head.version, head.link));
    export(&trace, &from, args.vcd.as_deref(), vcd::write)?;
    export(&trace, &from, args.perfetto.as_deref(), perfetto::write)?;
    export(&trace, &from, args.svg.as_deref(), svg::write)?;
    if args.vcd.is_none() && args.perfetto.is_none() && args.svg.is_none() {
        let mut text = Vec::new();
        timeline::write(&trace, shown, &mut text).map_err(|error| error.to_string())?;
        page.line("");
        page.append(&Page::text(&String::from_utf8_lossy(&text)));
    }
    print(&page)
}

/// Writes a file for another program, if it was asked for. The recording itself, in `from`, stays.
fn export(
    trace: &Trace,
    from: &Path,
    path: Option<&Path>,
    write: impl Fn(&Trace, &mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), String> {
    let Some(path) = path else { return Ok(()) };
    Output::check(path, &[from])?.write(|out| write(trace, out))
}

fn list(args: &TraceArgs) -> Result<(), String> {
    let rows: Vec<Vec<String>> = traces(args)?.iter().map(|path| row(path)).collect();
    if rows.is_empty() {
        return Err(none());
    }
    print(&Page::text(&aligned(&rows).join("\n")))
}

/// A line of the list. A path has no line feed, because `plain` could not distinguish it from ours.
fn row(path: &Path) -> Vec<String> {
    let cells = match read(path) {
        Ok(trace) => [utc_text(trace.head.utc_ms), verdict(&trace).text],
        Err(error) => ["cannot be read".to_owned(), error.to_string()],
    };
    let [at, about] = cells.map(|cell| foreign::plain(&cell).into_owned());
    vec![at, foreign::plain(&path.to_string_lossy()).into_owned(), about]
}

/// The kept traces, the newest first.
fn traces(args: &TraceArgs) -> Result<Vec<PathBuf>, String> {
    let folders = folders();
    let found = match &args.symlink {
        None => all(&folders),
        Some(link) => kept(&folders, &name_of(link)),
    };
    // The service's folder may be closed to this user.
    let closed = folders.iter().find_map(|folder| {
        let error = fs::read_dir(folder).err()?;
        (error.kind() == io::ErrorKind::PermissionDenied).then(|| format!("{}: {error}: use sudo", folder.display()))
    });
    if found.is_empty() { closed.map_or(Ok(found), Err) } else { Ok(found) }
}

fn none() -> String {
    let folders: Vec<String> = folders().iter().map(|folder| folder.display().to_string()).collect();
    format!(
        "there is no recording in {}: Pinion writes one when the MCU stops; --live records a running Pinion",
        folders.join(" or ")
    )
}

fn unreadable(path: &Path, error: &io::Error) -> String {
    let remedy = if error.kind() == io::ErrorKind::PermissionDenied { ": use sudo" } else { "" };
    format!("{}: {error}{remedy}", path.display())
}

/// Reads a trace from a file.
pub(crate) fn read(path: &Path) -> io::Result<Trace> {
    Trace::read(BufReader::new(foreign::open(path)?.0))
}

/// A recording of a running instance that lasts for `span`, and the socket that it came from.
fn live(args: &TraceArgs, span: Duration) -> Result<(PathBuf, Trace), String> {
    let link = args.symlink.as_deref().unwrap_or(Path::new(LINK));
    let status = args.socket.clone().map_or_else(|| socket_paths(link), |socket| vec![socket]);
    let sockets = trace_socket_paths(&status);
    // Without a Pinion, nobody has to wait for the message.
    if sockets.iter().any(|socket| socket.exists()) {
        thread::sleep(span);
    }
    let (socket, bytes) = fetch(&sockets, link, TRACE_MAX)?;
    let mut trace = Trace::read(bytes.as_slice()).map_err(|error| unreadable(&socket, &error))?;
    keep_last(&mut trace, span);
    Ok((socket, trace))
}

/// Leaves out the events before the last `span`, but not the states that began before it.
fn keep_last(trace: &mut Trace, span: Duration) {
    let ticks = i64::try_from(span.as_nanos() / u128::from(NS_PER_TICK)).unwrap_or(i64::MAX);
    let end = trace.ended_at();
    let is_state = |event: &Event| {
        matches!(
            event,
            Event::JobBegan { .. }
                | Event::JobEnded { .. }
                | Event::Held
                | Event::Released
                | Event::Scheduling { .. }
                | Event::HostCame
                | Event::HostGone
                | Event::Power(_)
                | Event::Frequency { .. }
        )
    };
    for thread in &mut trace.threads {
        thread.events.retain(|(at, event)| end.since(*at) <= ticks || is_state(event));
    }
}
