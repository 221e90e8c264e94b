// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer, shown at work by our own client.

use std::fmt::Display;
use std::io::{self, IsTerminal};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::demo::demonstrate;
use pinion_client::Client;
use pinion_firmware::time::Ticks;
use pinion_host::{OneClock, Time};
use pinion_linux::clock::Monotonic;
use pinion_model::{SimBoard, SimConfig, SimProbe, SimWorld, printer_cfg};
use pinion_printer_config::Trouble;
use pinion_runtime::wakeup::MarginLimits;
use pinion_runtime::{Access, Helpers, LinkName, Options, Recording, realtime};

use crate::attempt::{self, Attempt, Form, Task, Watching};
use crate::boards::{self, Others};
use crate::camera::{self, Camera};
use crate::description::read;
use crate::own;
use crate::own::args::OwnArgs;
use crate::own::run::{Place, is_printer_cfg};
use crate::own::serve::Own;
use crate::own_status::OwnStatus;
use crate::show::Show;
use crate::toolpath::{Files, PathArgs, PathRecord};
use pinion::page::{Page, print};
use pinion::{end, failed, logging};
use pinion_system::files::Output;
use pinion_trace::folder::folders;

/// Options of `pinion-sim`.
#[derive(Args, Clone, Debug)]
pub(crate) struct SimArgs {
    /// Somebody's printer.cfg, or a description of a printer (.toml); the built-in printer if left out
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    #[command(flatten)]
    own: OwnArgs,
    /// Print the printer.cfg that matches the printer, and end
    #[arg(long)]
    print_config: bool,
    /// Print the description of the built-in printer, or of the one in printer.cfg, and end. Start from it to write
    /// your own
    #[arg(long, conflicts_with = "print_config")]
    print_board: bool,
    /// End after the demonstration. The exit status is 0 if everything in it was right
    #[arg(long)]
    demo: bool,
    /// Show the printer while a host drives it, instead of the demonstration: a live picture on a terminal,
    /// one line for each change elsewhere
    #[arg(long, conflicts_with_all = ["demo", "print_config", "print_board"])]
    show: bool,
    /// Serve a picture of the printer as a webcam for Mainsail, Fluidd or a browser, by default on 127.0.0.1:8410
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = camera::ADDRESS,
          value_parser = camera::parse, conflicts_with_all = ["print_config", "print_board"])]
    camera: Option<String>,
    /// Write a line for each SPI transfer: the bus, the selected chips, the bytes in both directions. It serves a host,
    /// without the demonstration
    #[arg(long, value_name = "FILE", conflicts_with_all = ["demo", "print_config", "print_board"])]
    spi_trace: Option<PathBuf>,
    #[command(flatten)]
    path: PathArgs,
    /// Run in real time: SCHED_FIFO and locked memory
    #[arg(short = 'r')]
    realtime: bool,
    /// Let the flight recorder note each edge of each output, for `pinion trace --vcd`
    #[arg(long)]
    trace_edges: bool,
    /// Path of the symbolic link that the host opens; it leads to the pty. /tmp/klipper_host_mcu by default; with a
    /// printer.cfg, a place in the folder with klippy's copy
    #[arg(short = 'I', value_name = "PATH")]
    symlink: Option<PathBuf>,
}

/// The link of the main MCU if the command line names none.
const LINK: &str = "/tmp/klipper_host_mcu";

/// Somebody's printer while it is served.
struct Owner {
    own: Own,
    place: Place,
    printer_cfg: PathBuf,
    attempt: Option<Attempt>,
}

impl Owner {
    fn new(args: &SimArgs, own: Own) -> Result<Owner, Trouble> {
        let attempt = args.own.attempt()?;
        let is_in_one_clock = attempt.as_ref().is_some_and(|attempt| !attempt.real_time);
        let link = is_in_one_clock.then(|| PathBuf::from(format!("{}mcu", pinion_host::MCUS)));
        let place = Place::make(&own, &args.own, link.as_deref().or(args.symlink.as_deref()))?;
        Ok(Owner { own, place, printer_cfg: args.file.clone().unwrap_or_default(), attempt })
    }
}

/// A trial runs the programs in a printer.cfg, so root's rights are left before it.
fn leave_root(args: &SimArgs, printer_cfg: &Path) -> Result<(), Trouble> {
    if !args.own.has_klippy() {
        return Ok(());
    }
    attempt::rights::leave_root(printer_cfg, args.own.folder.as_deref(), args.realtime)
}

/// Shows the printer at work and continues to serve it, or prints its configuration.
pub(crate) fn run(args: &SimArgs) -> ExitCode {
    let own = match args.file.as_deref().filter(|file| is_printer_cfg(file)) {
        Some(file) => match leave_root(args, file).and_then(|()| own::run::read(file, &args.own)) {
            Ok(own) => Some(own),
            Err(mistake) if args.own.attempt => return attempt::refused(file, mistake, args.own.form()),
            Err(mistake) if args.own.form() == Form::Json => return attempt::print::refused(file, &mistake),
            Err(mistake) => return failed(mistake),
        },
        None if args.own.is_used() => {
            return failed(
                "--try, --print, --speed, --built-like, --with, --folder and --in-place-pty need a printer.cfg: name yours before them",
            );
        }
        None => None,
    };
    let config = match own.as_ref().map_or_else(|| read(args.file.as_deref()), |own| Ok(own.sim.clone())) {
        Ok(config) => config,
        Err(error) => return failed(error),
    };
    if args.print_board {
        let description = own.as_ref().map_or(SimConfig::default_toml(), |own| &own.description);
        return print(&Page::text(description)).map_or_else(failed, |()| ExitCode::SUCCESS);
    }
    if args.print_config {
        if own.is_some() {
            return failed("--print-config needs a description: klippy gets a copy of your printer.cfg");
        }
        let printer_cfg = printer_cfg(&config, &args.symlink.as_deref().unwrap_or(Path::new(LINK)).to_string_lossy());
        return print(&Page::text(&printer_cfg)).map_or_else(failed, |()| ExitCode::SUCCESS);
    }
    let Checked { path, spi_trace } = match Checked::check(args) {
        Ok(checked) => checked,
        Err(error) => return failed(error),
    };
    let owner = match own.map(|own| Owner::new(args, own)).transpose() {
        Ok(owner) => owner,
        Err(error) => return failed(error),
    };
    if let Some((owner, attempt)) = owner.as_ref().and_then(|owner| Some((owner, owner.attempt.as_ref()?)))
        && !attempt.real_time
    {
        return run_in_one_clock(args, owner, attempt, config, (path, spi_trace));
    }
    let links = match &owner {
        Some(owner) => owner.place.links().to_vec(),
        None => boards::links(args.symlink.as_deref().unwrap_or(Path::new(LINK)), &config),
    };
    let symlink = links[0].clone();
    let clock = Monotonic::start();
    let folders = match owner.as_ref().map(|owner| &owner.place) {
        Some(Place::Folder(folder)) => vec![folder.path.clone()],
        _ => folders(),
    };
    let mut started = match boards::start(&links, clock, args.realtime, &folders) {
        Ok(started) => started,
        Err(error) => return failed(error),
    };
    let (_, recording, helpers) = started.remove(0);
    logging::detach();
    let camera = match args.camera.as_ref().map(|address| Camera::open(address, &config)).transpose() {
        Ok(camera) => camera,
        Err(error) => return failed(error),
    };
    let SimWorld { mut boards, probe } = match SimWorld::new(config.clone(), Arc::new(clock)) {
        Ok(world) => world,
        Err(error) => return failed(error),
    };
    let board = boards.remove(0);
    let sockets = pinion_runtime::socket_paths(&symlink);
    let own = match (args.show || camera.is_some()).then(|| OwnStatus::start(sockets.clone(), &symlink)).transpose() {
        Ok(own) => own.unwrap_or_default(),
        Err(error) => return failed(format!("the printer cannot be shown: {error}")),
    };
    if let Some(Err(error)) = camera.map(|camera| camera.start(probe.clone(), own.clone())) {
        return failed(error);
    }
    let path = match path.map(|files| PathRecord::record(files, probe.clone())).transpose() {
        Ok(path) => path,
        Err(error) => return failed(format!("the path cannot be recorded: {error}")),
    };
    // A program that waits for exact steps spins. A trial has time for a step that is 50 us late, and computers with two
    // processors have no time for several MCUs that spin.
    let is_tried = owner.as_ref().is_some_and(|owner| owner.attempt.is_some());
    let options = Options {
        link: LinkName::Pty(symlink.clone()),
        dialect: None,
        access: Access { mode: 0o660, group: None },
        realtime: args.realtime,
        cpu: None,
        margin: if is_tried { MarginLimits::always(Ticks(0)) } else { MarginLimits::default() },
        watchdog: None,
        tolerances: Vec::new(),
        trace_edges: args.trace_edges,
        sockets,
    };
    let several = !boards.is_empty();
    let others = match Others::serve(boards, started, &options) {
        Ok(others) => others,
        Err(error) => return failed(error),
    };
    if owner.is_some() || args.show || path.is_some() || spi_trace.is_some() || several {
        let served = serve(args, board, (probe, own), &options, (recording, helpers), (path, spi_trace), owner);
        return if others.end() { served } else { ExitCode::FAILURE };
    }
    let right = Arc::new(AtomicBool::new(false));
    // A demonstration that this interrupts has not failed.
    let ended = match asked_to_end() {
        Ok(ended) => ended,
        Err(error) => return failed(error),
    };
    let ready = {
        let (args, right, symlink) = (args.clone(), right.clone(), symlink.clone());
        move || {
            let demo = thread::Builder::new().name("demo".into()).spawn(move || {
                // The link's thread starts it, and passes its real-time priority on.
                realtime::leave();
                show((&args, &symlink), &config, &probe, (&right, &ended));
            });
            if let Err(trouble) = pinion_runtime::started(demo) {
                log::error!("the demonstration cannot be started: {trouble}");
            }
        }
    };
    let timing = board.timing();
    match pinion_runtime::run(&options, Box::new(board), timing, recording, helpers, Some(Box::new(ready))) {
        Ok(()) if args.demo && !right.load(Ordering::SeqCst) => ExitCode::FAILURE,
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(error),
    }
}

/// Tries a printer whose klippy has the printer's clock, or prints on it, or serves it.
fn run_in_one_clock(
    args: &SimArgs,
    owner: &Owner,
    attempt: &Attempt,
    config: SimConfig,
    (path, spi_trace): (Option<Files>, Option<Output>),
) -> ExitCode {
    let Place::Folder(folder) = &owner.place else { return failed("--try needs a folder") };
    let ended = match asked_to_end() {
        Ok(ended) => ended,
        Err(error) => return failed(error),
    };
    let mut record = None;
    let tried = || {
        let clock = pinion_host::start();
        let camera = args.camera.as_ref().map(|address| Camera::open(address, &config)).transpose()?;
        let SimWorld { boards, probe } = SimWorld::new(config, Arc::new(clock.clone()))?;
        let probe = probe.in_one_clock();
        let forms = pinion_host::forms(&attempt.klipper);
        let shown = OwnStatus::default();
        camera.map_or(Ok(()), |camera| camera.start(probe.clone(), shown.clone()))?;
        let mut one = OneClock::new(clock, boards, (owner.place.links(), &folder.path), &forms, ended.clone())?;
        let own = (&owner.own, owner.printer_cfg.as_path());
        if let Task::Serve(speed) = attempt.task {
            one.keep_pace(speed);
        }
        if let Some(trace) = spi_trace {
            probe.record_spi(trace.make()?);
        }
        let mut toolpath = None;
        if let Some(files) = path {
            let path = PathRecord::new(files, probe.clone());
            toolpath = Some(Box::new(path.reader()) as Box<dyn FnMut()>);
            record = Some(path);
        }
        let watching = Watching::new(attempt.form, probe.clone(), toolpath);
        let time = Time::One(Box::new(one));
        let done = match &attempt.task {
            Task::Try => attempt::run(attempt, own, folder, &probe, (time, watching), &ended),
            Task::Print(print) => attempt::print::run(attempt, print, own, folder, &probe, (time, watching), &ended)?,
            Task::Serve(_) => {
                attempt::paced::run(attempt, (folder, &owner.printer_cfg), (time, watching), &shown, &ended)?
            }
        };
        match (done, &attempt.task) {
            (Some(passed), _) => Ok(passed),
            (None, Task::Try) => Err(in_real_time(&attempt.python)),
            (None, Task::Print(_) | Task::Serve(_)) => Err(alone(&attempt.python)),
        }
    };
    match tried() {
        Ok(true) => record.map_or(ExitCode::SUCCESS, PathRecord::end),
        Ok(false) => {
            record.map(PathRecord::end);
            ExitCode::FAILURE
        }
        Err(_) if ended.load(Ordering::SeqCst) => ExitCode::FAILURE,
        Err(trouble) => failed(trouble),
    }
}

/// klippy's Python cannot have the printer's clock.
fn alone(python: &Path) -> Trouble {
    Trouble::new("it loads no library, like a static program or one with capabilities")
        .of(python.display())
        .remedy("name another Python with --python")
}

/// Starts this program again, for a trial in real time.
fn in_real_time(python: &Path) -> Trouble {
    log::warn!("the trial runs in real time: {} loads no library: name another Python with --python", python.display());
    logging::finish();
    let anew = std::env::current_exe()
        .map(|program| Command::new(program).args(std::env::args_os().skip(1)).arg("--real-time").exec());
    let error = anew.unwrap_or_else(|error| error);
    Trouble::new(format!("the trial cannot run in real time: {error}")).remedy("name another Python with --python")
}

/// A flag that is set when the program is asked to end.
fn asked_to_end() -> Result<Arc<AtomicBool>, String> {
    let asked = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, asked.clone())
            .map_err(|error| format!("signals cannot be received: {error}"))?;
    }
    Ok(asked)
}

/// The files of the options, checked before the printer starts.
struct Checked {
    path: Option<Files>,
    spi_trace: Option<Output>,
}

impl Checked {
    fn check(args: &SimArgs) -> Result<Checked, String> {
        let inputs: Vec<&Path> = args.file.iter().chain(&args.path.compare).map(PathBuf::as_path).collect();
        let spi_trace = args.spi_trace.as_deref().map(|path| Output::check(path, &inputs)).transpose()?;
        Ok(Checked { path: Files::check(&args.path, &inputs)?, spi_trace })
    }
}

/// Serves a host, without the demonstration. With `--show` it shows the effects on the printer.
fn serve(
    args: &SimArgs,
    board: SimBoard,
    (probe, own): (SimProbe, OwnStatus),
    options: &Options,
    (recording, helpers): (Recording, Helpers),
    (path, spi_trace): (Option<PathRecord>, Option<Output>),
    owner: Option<Owner>,
) -> ExitCode {
    let right = Arc::new(AtomicBool::new(owner.as_ref().is_none_or(|owner| owner.attempt.is_none())));
    let owner = owner.map(Arc::new);
    let show = match args.show.then(|| Show::prepare(probe.clone(), own)).transpose() {
        Ok(show) => show,
        Err(error) => return failed(format!("the printer cannot be shown: {error}")),
    };
    let link = match &options.link {
        LinkName::Pty(link) => link.clone(),
        _ => PathBuf::new(),
    };
    // A start that fails makes no file.
    let mut started = false;
    let ready = || {
        started = true;
        // No transfer comes before this.
        match spi_trace.map(|trace| trace.make()).transpose() {
            Ok(trace) => trace.into_iter().for_each(|file| probe.record_spi(file)),
            Err(error) => log::error!("{error}"),
        }
        match &owner {
            Some(owner) => begin(args, owner, &probe, &right),
            None if io::stdout().is_terminal() => {
                report_how_to_connect((args, &link), if args.show { "q or Ctrl-C" } else { "Ctrl-C" });
            }
            None => {}
        }
        if let Some(show) = &show {
            show.begin();
        }
    };
    let timing = board.timing();
    let ended = pinion_runtime::run(options, Box::new(board), timing, recording, helpers, Some(Box::new(ready)));
    // A trial that is interrupted ends with this process.
    if let Some(attempt) = owner.as_ref().and_then(|owner| owner.attempt.as_ref()) {
        attempt.running.end();
    }
    if !right.load(Ordering::SeqCst) && ended.is_ok() {
        return ExitCode::FAILURE;
    }
    if let Some(show) = show {
        show.end();
    }
    let written = path.filter(|_| started).map_or(ExitCode::SUCCESS, PathRecord::end);
    ended.map_or_else(failed, |()| written)
}

/// Says how to start klippy on somebody's printer, or tries the printer and ends the program.
fn begin(args: &SimArgs, owner: &Arc<Owner>, probe: &SimProbe, right: &Arc<AtomicBool>) {
    let (Some(attempt), Place::Folder(_)) = (&owner.attempt, &owner.place) else {
        owner.place.next(&args.own).iter().for_each(say);
        return;
    };
    let ended = asked_to_end().unwrap_or_else(|error| {
        log::error!("{error}");
        Arc::default()
    });
    let (owner, probe, right) = (owner.clone(), probe.clone(), right.clone());
    let (attempt, realtime) = (attempt.clone(), args.realtime);
    let thread = thread::Builder::new().name("try".into()).spawn(move || {
        if realtime {
            // The link's thread starts it, and passes its real-time priority on. klippy does not get it.
            realtime::leave();
        }
        if let Place::Folder(folder) = &owner.place {
            let time = Time::Real(Instant::now(), ended.clone());
            let watching = Watching::new(attempt.form, probe.clone(), None);
            let of_owner = (&owner.own, owner.printer_cfg.as_path());
            let passed = attempt::run(&attempt, of_owner, folder, &probe, (time, watching), &ended);
            right.store(passed == Some(true), Ordering::SeqCst);
        }
        end();
    });
    if let Err(trouble) = pinion_runtime::started(thread) {
        log::error!("the printer cannot be tried: {trouble}");
    }
}

/// Shows the printer at work, then ends the program or says how to use it with klippy.
fn show(
    (args, link): (&SimArgs, &Path),
    config: &SimConfig,
    probe: &SimProbe,
    (right, ended): (&AtomicBool, &AtomicBool),
) {
    match demonstration(link, config, probe) {
        Err(_) if ended.load(Ordering::SeqCst) => return,
        Ok(all_right) => right.store(all_right, Ordering::SeqCst),
        Err(error) => log::error!("the demonstration: {error}"),
    }
    if args.demo {
        return end();
    }
    report_how_to_connect((args, link), "Ctrl-C");
}

fn report_how_to_connect((args, link): (&SimArgs, &Path), end: &str) {
    let file = args.file.as_ref().map_or(String::new(), |file| format!(" {}", file.display()));
    say("");
    say(format_args!("The simulated printer goes on until {end}. To connect a Klipper host:"));
    say(format_args!("  pinion sim{file} -I {} --print-config > printer.cfg", link.display()));
    say("  klippy.py printer.cfg");
}

fn demonstration(link: &Path, config: &SimConfig, probe: &SimProbe) -> Result<bool, String> {
    let mut client = Client::connect(link, Duration::from_secs(5)).map_err(|error| error.to_string())?;
    let passed = demonstrate(&mut client, config).map_err(|error| error.to_string())?;
    // Reset the MCU, so that the next host finds it as after a start.
    client.reset().map_err(|error| error.to_string())?;
    for axis in probe.axes().filter(|axis| axis.endstop.is_some()) {
        say(format_args!(
            "       the printer's {} axis stands at {:.3} mm, {} steps lost",
            axis.name, axis.position_mm, axis.lost_steps
        ));
    }
    for heater in probe.heaters() {
        say(format_args!("       the printer's {} is at {:.1} C", heater.name, heater.celsius));
    }
    let lost: u64 = probe.axes().map(|axis| axis.lost_steps).sum();
    let all_right = passed && lost == 0;
    say(if all_right { "all of it was right" } else { "NOT all of it was right" });
    Ok(all_right)
}

/// Prints a line about the demonstration. Errors are ignored: the printer serves its host even if nothing can be
/// printed.
fn say(line: impl Display) {
    let mut page = Page::default();
    page.line(line);
    if let Err(error) = print(&page) {
        log::warn!("{error}");
    }
}
