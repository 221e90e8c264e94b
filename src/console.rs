// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion console`: a host for people, in place of klippy.

use std::fs;
use std::io::{self, BufRead, BufReader, IsTerminal, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use clap::Args;
use log::LevelFilter;
use nix::fcntl::OFlag;
use rustyline::completion::Completer;
use rustyline::config::CompletionType;
use rustyline::error::ReadlineError;
use rustyline::highlight::Highlighter;
use rustyline::hint::Hinter;
use rustyline::history::FileHistory;
use rustyline::validate::Validator;
use rustyline::{Config, Context, Editor, ExternalPrinter, Helper};
use signal_hook::consts::{SIGINT, SIGQUIT, SIGTERM};
use signal_hook::low_level::emulate_default_handler;
use termina::escape::csi::DecPrivateModeCode;

use pinion_client::console::{Console, Next, Vocabulary};
use pinion_client::{self, Client};
use pinion_linux::clock::Monotonic;
use pinion_linux::own_folder::OwnFolder;
use pinion_runtime::klippy::process::Process;
use pinion_runtime::klippy::terminal::{Search, Terminal as Device, find};
use pinion_runtime::wakeup::MarginLimits;
use pinion_runtime::{Access, Helpers, LinkName, Options, Recording};
use pinion_trace::folder::user_state;

use super::page::{Page, print};
use super::simulator::Open;
use super::terminal::{Terminal, give_back_at, off};
use super::{end, failed, logging, not_permitted};
use pinion_system::complete::{SIMULATED, offering};
use pinion_system::files;
use pinion_system::settings::BoardName;

/// Longest wait for the first answer of the MCU, which learns before that who its host is: in up to three seconds.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(5);
/// How often a console that waits for a line checks for messages of the MCU.
const LOOK: Duration = Duration::from_millis(20);
/// How many lines are remembered.
const HISTORY_LINES: usize = 1000;
/// Longest file of commands.
const SCRIPT_MIB: u64 = 64;
/// Longest line of commands that come from a file or a pipe, in bytes.
const LINE_MAX: u64 = 1 << 20;
/// The file of the remembered lines.
const HISTORY: &str = "console_history";
const PROMPT: &str = "> ";

/// Options of `pinion console`.
#[derive(Args, Clone, Debug)]
pub struct ConsoleArgs {
    /// The MCU's terminal
    #[arg(value_name = "PTY", default_value = "/tmp/klipper_host_mcu")]
    pty: PathBuf,
    /// Run the lines of FILE until one fails, and end
    #[arg(short = 'f', value_name = "FILE")]
    file: Option<PathBuf>,
    /// Start a simulated MCU and talk to it: sim, or sim:FILE.toml
    #[arg(long, value_name = "BOARD", conflicts_with = "pty", value_parser = offering::<BoardName>(SIMULATED),
        hide_possible_values = true)]
    board: Option<BoardName>,
}

/// Talks to an MCU until there are no more lines. A simulated board is made by `simulated`.
pub fn run(args: &ConsoleArgs, simulated: Open) -> ExitCode {
    let done = match &args.board {
        None => {
            let ready = free(&args.pty).and_then(|()| {
                let hang_up = pinion_runtime::hang_up().map_err(|error| error.to_string())?;
                let signals: Vec<i32> = [SIGQUIT, SIGTERM].into_iter().chain(hang_up).collect();
                lend_terminal(&signals)
            });
            ready.and_then(|_terminal| speak(args, &args.pty))
        }
        Some(BoardName::Sim(file)) => simulate(args, file.as_deref(), simulated),
        Some(BoardName::Linux) => Err("--board is sim or sim:FILE.toml here; for this computer's pins start pinion run, then give pinion console its link".into()),
    };
    done.map_or_else(failed, |()| ExitCode::SUCCESS)
}

/// Fails if a host has the terminal open. Two hosts would take each other's answers.
fn free(pty: &Path) -> Result<(), String> {
    match &hosts(pty)?[..] {
        [] => Ok(()),
        hidden => Err(format!(
            "{} may have {} open, but this user may not inspect that process: stop it first, or use sudo",
            names(hidden),
            pty.display()
        )),
    }
}

/// The klippys that may have the terminal open, because this user may not look into them.
///
/// # Errors
///
/// A host has it open, or it cannot be used.
pub(crate) fn hosts(pty: &Path) -> Result<Vec<Process>, String> {
    let device =
        fs::canonicalize(pty).map_err(|error| format!("{}: {error}: start Pinion, or name its link", pty.display()))?;
    let flags = (OFlag::O_NOCTTY | OFlag::O_NONBLOCK).bits();
    match fs::OpenOptions::new().read(true).write(true).custom_flags(flags).open(&device) {
        // A file that is no terminal may be open in many processes.
        Ok(file) if !file.is_terminal() => {
            return Err(pinion_client::Error::NoTerminal { port: pty.display().to_string() }.to_string());
        }
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => return Err(not_permitted(pty, &device)),
        // Other errors are reported later.
        Ok(_) | Err(_) => {}
    }
    match Device::of(&device).and_then(|device| find(Path::new("/proc"), device)) {
        Ok(Search::Found(host)) => {
            let remedy = if host.is_klippy() { " (sudo systemctl stop klipper)" } else { "" };
            Err(format!("{} has {} open: stop it first{remedy}", names(&[host]), pty.display()))
        }
        Ok(Search::Hidden(hosts)) => Ok(hosts),
        Ok(Search::Nobody) => Ok(Vec::new()),
        Err(error) => Err(format!("the programs with {} open cannot be found: {error}: use sudo", pty.display())),
    }
}

fn names(processes: &[Process]) -> String {
    let names = processes.iter().map(|process| {
        let command: Vec<String> = process.arguments.iter().map(|word| word.display().to_string()).collect();
        format!("process {} ({})", process.pid, command.join(" "))
    });
    names.collect::<Vec<_>>().join(", ")
}

/// Runs a simulated MCU, and talks to it.
fn simulate(args: &ConsoleArgs, file: Option<&Path>, simulated: Open) -> Result<(), String> {
    // This comes first, because another program may take over for it.
    let clock = Monotonic::start();
    let (board, timing) = simulated(file, clock.shared()).map_err(|error| error.to_string())?;
    // The only host is this console, and it speaks every dialect.
    let helpers = Helpers::default();
    // The other signals end the MCU in order. Then `signal` says which one it was.
    let terminal = lend_terminal(&[SIGQUIT])?;
    let signal = Arc::new(AtomicUsize::new(0));
    let hang_up = pinion_runtime::hang_up().map_err(|error| error.to_string())?;
    for ending in [SIGINT, SIGTERM].into_iter().chain(hang_up) {
        signal_hook::flag::register_usize(ending, signal.clone(), ending.unsigned_abs() as usize)
            .map_err(|error| format!("signals cannot be received: {error}"))?;
    }
    // The lines about each event are for a service.
    log::set_max_level(log::max_level().min(LevelFilter::Warn));
    logging::detach();
    // A console that was killed left its link, and this process may have got its number.
    let name = |n: u32| std::env::temp_dir().join(format!("pinion_console_{}_{n}", std::process::id()));
    let free = (0..u32::MAX).map(name).find(|path| path.symlink_metadata().is_err());
    let symlink = free.ok_or("no name in the folder for temporary files is free")?;
    let recording = Recording::new(clock, &symlink, false, Vec::new()).map_err(|error| error.to_string())?;
    let options = Options {
        link: LinkName::Pty(symlink.clone()),
        dialect: None,
        access: Access { mode: 0o600, group: Some(nix::unistd::getegid().to_string()) },
        realtime: false,
        cpu: None,
        margin: MarginLimits::default(),
        watchdog: None,
        tolerances: Vec::new(),
        trace_edges: false,
        sockets: Vec::new(),
    };
    // The console's result. `None` until the console has ended.
    let said = Arc::new(Mutex::new(None));
    let ready = {
        let (args, said, signal) = (args.clone(), said.clone(), signal.clone());
        move || {
            let speaking = thread::Builder::new().name("console".into()).spawn(move || {
                let done = speak(&args, &symlink);
                // When a signal ends the MCU, the console loses it too. That is no error of the console.
                if signal.load(Ordering::Relaxed) != 0 {
                    return;
                }
                *said.lock().unwrap_or_else(PoisonError::into_inner) = Some(done);
                end();
            });
            if let Err(trouble) = pinion_runtime::started(speaking) {
                log::error!("the console cannot be started: {trouble}");
            }
        }
    };
    let ended = pinion_runtime::run(&options, board, timing, recording, helpers, Some(Box::new(ready)));
    drop(terminal);
    ended.map_err(|error| error.to_string())?;
    let said = said.lock().unwrap_or_else(PoisonError::into_inner).take();
    said.unwrap_or_else(|| {
        logging::finish();
        let signal = signal.load(Ordering::Relaxed).try_into().unwrap_or_default();
        Err(format!("a signal ended the console and cannot be passed on: {:?}", emulate_default_handler(signal)))
    })
}

/// Lends the terminal, if stdin is one, to the line editor. The editor has it while a person writes a line. These
/// signals give it back.
fn lend_terminal(signals: &[i32]) -> Result<Option<Terminal>, String> {
    // The editor asks the terminal to mark pasted text.
    let terminal = Terminal::lend(format_args!("{}\r\n", off(DecPrivateModeCode::BracketedPaste)));
    if terminal.is_some() {
        give_back_at(signals, Duration::ZERO)?;
    }
    Ok(terminal)
}

/// Talks to the MCU of a terminal. The lines come from a file, from a pipe, or from a person.
fn speak(args: &ConsoleArgs, pty: &Path) -> Result<(), String> {
    let client = Client::connect(pty, ANSWER_WAIT_MAX).map_err(|error| error.to_string())?;
    let console = Console::new(client);
    match &args.file {
        Some(path) => {
            let about = |error| format!("{}: {error}", path.display());
            let file = files::open(path, SCRIPT_MIB)
                .map_err(|error| about(format!("{error}: name a file with commands, or leave out -f")))?;
            script(console, BufReader::new(file)).map_err(about)
        }
        None if !io::stdin().is_terminal() => script(console, io::stdin().lock()),
        None => converse(console),
    }
}

/// Carries the lines out, up to the first that fails.
fn script(mut console: Console, mut lines: impl BufRead) -> Result<(), String> {
    let mut line = String::new();
    for number in 1_u64.. {
        line.clear();
        match lines.by_ref().take(LINE_MAX).read_line(&mut line) {
            Ok(0) => break,
            Ok(_) if line.len() as u64 == LINE_MAX => return Err(format!("line {number} is too long: divide it")),
            Ok(_) => {}
            Err(error) => return Err(format!("line {number} cannot be read: {error}")),
        }
        let show = &mut |line: &str| drop(print(&one(line)));
        if !line.trim().is_empty() {
            show(&format!("{PROMPT}{}", line.trim()));
        }
        match console.line(line.trim_end_matches(['\r', '\n']), show) {
            Ok(Next::Line) => {}
            Ok(Next::End) => break,
            Err(error) => return Err(format!("line {number}: {error}")),
        }
    }
    Ok(())
}

/// A page of one line.
fn one(line: &str) -> Page {
    let mut page = Page::default();
    page.line(line);
    page
}

// ---- a person

/// Takes lines from a person. A thread of its own talks to the MCU. So the MCU's messages are printed above the line
/// that is being written.
fn converse(console: Console) -> Result<(), String> {
    let about = |error: ReadlineError| format!("the terminal: {error}");
    let config = Config::builder().completion_type(CompletionType::List).max_history_size(HISTORY_LINES);
    let config = config.map_err(about)?.auto_add_history(true).build();
    let mut editor: Editor<Words, FileHistory> = Editor::with_config(config).map_err(about)?;
    editor.set_helper(Some(Words(console.vocabulary().clone())));
    let state = user_state().map(|state| state.join("pinion"));
    let history = state.map(|path| (OwnFolder::make(&path), path));
    if let Some((Ok(folder), _)) = &history {
        // There is no history at the first time.
        let _ = editor.load_history(&folder.at(HISTORY));
    }
    // Nothing can be drawn if the output goes elsewhere or the terminal is too simple. Then lines come as they are.
    let Ok(printer) = editor.create_external_printer() else { return script(console, io::stdin().lock()) };
    let greeting = console.greeting();
    print(&one(&greeting))?;
    let (lines, inbox) = mpsc::channel();
    let (outbox, answers) = mpsc::channel();
    let gone = Arc::new(AtomicBool::new(false));
    let session = {
        let gone = gone.clone();
        thread::Builder::new().name("session".into()).spawn(move || attend(console, printer, &inbox, &outbox, &gone))
    };
    pinion_runtime::started(session).map_err(|trouble| trouble.to_string())?;
    let ended = read_lines(&mut editor, &lines, &answers, &gone);
    if let Some((folder, path)) = history {
        let kept = folder.map_err(|error| error.to_string());
        let kept = kept.and_then(|folder| editor.save_history(&folder.at(HISTORY)).map_err(|error| error.to_string()));
        if let Err(error) = kept {
            log::warn!("the history is not kept in {}: {error}", path.display());
        }
    }
    ended
}

fn read_lines(
    editor: &mut Editor<Words, FileHistory>,
    lines: &Sender<String>,
    answers: &Receiver<Option<Vocabulary>>,
    gone: &AtomicBool,
) -> Result<(), String> {
    loop {
        match editor.readline(PROMPT) {
            // A pasted text may have several lines.
            Ok(text) => {
                for line in text.lines() {
                    let is_gone = lines.send(line.to_owned()).is_err();
                    // Its answer comes before the next prompt. None: the session has ended.
                    match answers.recv() {
                        Ok(Some(vocabulary)) if !is_gone => editor.set_helper(Some(Words(vocabulary))),
                        _ if gone.load(Ordering::Relaxed) => return Err("the MCU is gone".into()),
                        _ => return Ok(()),
                    }
                }
            }
            Err(ReadlineError::Interrupted) => {}
            Err(ReadlineError::Eof) => return Ok(()),
            Err(error) => return Err(format!("the terminal: {error}")),
        }
    }
}

/// Talks to the MCU: carries out lines as they come, and prints the MCU's messages.
fn attend(
    mut console: Console,
    mut printer: impl ExternalPrinter,
    lines: &Receiver<String>,
    answers: &Sender<Option<Vocabulary>>,
    gone: &AtomicBool,
) {
    let mut show = |line: &str| drop(printer.print(one(line).to_string()));
    loop {
        match lines.recv_timeout(Duration::ZERO) {
            Ok(line) => {
                let next = console.line(&line, &mut show).unwrap_or_else(|error| {
                    show(&format!("!! {error}"));
                    Next::Line
                });
                let answer = (next == Next::Line).then(|| console.vocabulary().clone());
                if answers.send(answer).is_err() || next == Next::End {
                    return;
                }
            }
            Err(RecvTimeoutError::Timeout) => {
                if let Err(error) = console.listen(LOOK, &mut show) {
                    show(&format!("!! {error}"));
                    if console.is_gone() {
                        gone.store(true, Ordering::Relaxed);
                        return;
                    }
                }
            }
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}

/// Completes the words of the dictionary.
struct Words(Vocabulary);

impl Completer for Words {
    type Candidate = String;

    fn complete(&self, line: &str, at: usize, _: &Context<'_>) -> rustyline::Result<(usize, Vec<String>)> {
        let (start, mut words) = self.0.complete(&line[..at]);
        // The editor writes them as they are.
        words.retain(|word| !word.contains(char::is_control));
        Ok((start, words))
    }
}

impl Hinter for Words {
    type Hint = String;
}

impl Highlighter for Words {}
impl Validator for Words {}
impl Helper for Words {}
