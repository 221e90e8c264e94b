// SPDX-License-Identifier: GPL-3.0-or-later
//! The terminal: how this program changes it, and how it is restored at the end.
//!
//! Three things change it: `pinion status --watch`, `pinion sim --show` and the console's line editor. Their changes
//! are remembered here. They are undone when they are dropped, when the program panics, and when a signal ends it. The
//! escape sequences and the names of keys are termina's.

use std::fmt::Display;
use std::io::{self, IsTerminal};
use std::os::fd::AsFd;
use std::panic;
use std::sync::{Mutex, MutexGuard, Once, PoisonError};
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::termios::{LocalFlags, SetArg, SpecialCharacterIndices, Termios, tcgetattr, tcsetattr};
use nix::unistd::{getpgrp, read, tcgetpgrp, write};
use signal_hook::iterator::Signals;
use signal_hook::low_level::emulate_default_handler;
use termina::escape::csi::{Csi, Cursor, DecPrivateMode, DecPrivateModeCode, Edit, EraseInDisplay, EraseInLine, Mode};
use termina::event::{KeyCode, Modifiers};
use termina::{Event, OneBased, Parser};
use terminal_size::{Height, Width, terminal_size_of};

use pinion_runtime::started;

use super::page::draw;

/// The size of a terminal that does not report it: that of the VT100.
const VT100: Size = Size { rows: 24, columns: 80 };
/// Longest wait for a terminal that takes no output, as after Ctrl-S, in milliseconds.
const FAREWELL_MS: u16 = 1000;
/// A row below the last one of any terminal. A terminal takes it for its last row.
const LAST_ROW: usize = 999;
const FIRST: OneBased = OneBased::from_zero_based(0);

/// Erases the rest of a line.
pub const ERASE_LINE: Csi = Csi::Edit(Edit::EraseInLine(EraseInLine::EraseToEndOfLine));
/// Erases the rest of the screen.
pub const ERASE_BELOW: Csi = Csi::Edit(Edit::EraseInDisplay(EraseInDisplay::EraseToEndOfDisplay));
/// Deletes the cursor's row and all rows below it.
pub const DELETE_BELOW: Csi = Csi::Edit(Edit::DeleteLine(LAST_ROW as u32));
/// Saves the cursor. Not all terminals know the sequence that termina has for it.
pub const SAVE_CURSOR: &str = "\x1b7";
/// Restores the cursor.
pub const RESTORE_CURSOR: &str = "\x1b8";

/// Switches something on.
pub fn on(code: DecPrivateModeCode) -> Csi {
    Csi::Mode(Mode::SetDecPrivateMode(DecPrivateMode::Code(code)))
}

/// Switches something off.
pub fn off(code: DecPrivateModeCode) -> Csi {
    Csi::Mode(Mode::ResetDecPrivateMode(DecPrivateMode::Code(code)))
}

/// Moves the cursor to the beginning of a row, counted from 1.
pub fn to_row(row: usize) -> Csi {
    Csi::Cursor(Cursor::Position { line: row_number(row), col: FIRST })
}

/// Makes the rows down to this one scroll, and no others.
pub fn scrolling(bottom: usize) -> Csi {
    Csi::Cursor(Cursor::SetTopAndBottomMargins { top: FIRST, bottom: row_number(bottom) })
}

/// Makes all rows scroll again, and moves the cursor below everything that is shown.
pub fn all_scrolls() -> String {
    format!("{}{}\n", scrolling(usize::MAX), to_row(LAST_ROW))
}

fn row_number(row: usize) -> OneBased {
    // termina leaves out the largest number, which stands for the last row.
    OneBased::new(u16::try_from(row).unwrap_or(u16::MAX)).unwrap_or(FIRST)
}

/// Moves the cursor up by this many rows, at least one.
pub fn up(rows: usize) -> Csi {
    Csi::Cursor(Cursor::Up(u32::try_from(rows).unwrap_or(u32::MAX)))
}

/// The size of a terminal in characters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    /// The number of rows.
    pub rows: usize,
    /// The number of columns.
    pub columns: usize,
}

/// The size of the terminal on stdout.
pub fn size() -> Size {
    terminal_size_of(io::stdout())
        .map_or(VT100, |(Width(columns), Height(rows))| Size { rows: rows.into(), columns: columns.into() })
}

/// How to undo the changes.
struct Before {
    /// The settings of the terminal on stdin.
    settings: Option<Termios>,
    /// The text to write on stdout.
    undo: String,
    /// Whether the line editor changes it from time to time, and undoes that.
    is_lent: bool,
}

/// `None` while the terminal is as before.
static BEFORE: Mutex<Option<Before>> = Mutex::new(None);

fn before() -> MutexGuard<'static, Option<Before>> {
    BEFORE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Undoes the changes. It takes no lock that a painter holds while it waits for the terminal.
fn give_back() {
    let Some(Before { settings, undo, is_lent }) = before().take() else { return };
    let stdin = io::stdin();
    if let Some(settings) = settings {
        let is_changed = tcgetattr(&stdin).is_ok_and(|now| now.local_flags != settings.local_flags);
        if is_lent && !is_changed {
            return;
        }
        // Another program's terminal is not ours to set. A terminal that is gone needs nothing back.
        if is_ours() {
            let _ = tcsetattr(&stdin, SetArg::TCSANOW, &settings);
        }
    }
    let stdout = io::stdout();
    if undo.is_empty() || !stdout.is_terminal() {
        return;
    }
    let mut fds = [PollFd::new(stdout.as_fd(), PollFlags::POLLOUT)];
    if matches!(poll(&mut fds, FAREWELL_MS), Ok(1)) {
        let _ = write(&stdout, undo.as_bytes());
    }
}

/// Makes a panic in any thread give the terminal back before the panic is reported.
fn give_back_at_panic() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let hook = panic::take_hook();
        panic::set_hook(Box::new(move |panic| {
            give_back();
            hook(panic);
        }));
    });
}

/// Makes these signals give the terminal back, and then end the program as they do by themselves. The program has
/// `grace` to end in order.
pub fn give_back_at(signals: &[i32], grace: Duration) -> Result<(), String> {
    let mut signals = Signals::new(signals).map_err(|error| format!("signals cannot be received: {error}"))?;
    let wait = move || {
        for signal in signals.forever() {
            thread::sleep(grace);
            give_back();
            let _ = emulate_default_handler(signal);
        }
    };
    let waiting = thread::Builder::new().name("signals".into()).spawn(wait);
    started(waiting).map(drop).map_err(|trouble| trouble.to_string())
}

/// Whether the shell has this program in the foreground. Without job control this is unknown and counts as true.
fn is_ours() -> bool {
    tcgetpgrp(io::stdin()).map_or(true, |group| group == getpgrp())
}

/// Which keys come to the program one by one, without Enter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Keys {
    /// All keys.
    All,
    /// All keys except those that the kernel makes signals of, such as Ctrl-C.
    ButSignals,
}

/// A key that was pressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// Its signal ends a program: Ctrl-C and Ctrl-\.
    End,
    /// Its signal stops a program: Ctrl-Z.
    Stop,
    /// Any other key.
    Other(KeyCode),
}

/// The terminal on stdin and stdout while the program changes it. When this is dropped, the terminal is as before.
pub struct Terminal {
    /// Its settings before. `None` if no keys are read.
    before: Option<Termios>,
    parser: Parser,
}

impl Terminal {
    /// Takes the terminal. No keys are read if stdin is no terminal, or another program reads from it.
    pub fn take(keys: Keys) -> Terminal {
        give_back_at_panic();
        let stdin = io::stdin();
        // Taking all keys in the background stops the program until the shell puts it in the foreground.
        let settings = tcgetattr(&stdin).ok().filter(|_| keys == Keys::All || is_ours());
        *before() = Some(Before { settings: settings.clone(), undo: String::new(), is_lent: false });
        let keyed = settings.filter(|before| {
            let mut keyed = before.clone();
            keyed.local_flags.remove(LocalFlags::ICANON | LocalFlags::ECHO);
            if keys == Keys::All {
                keyed.local_flags.remove(LocalFlags::ISIG);
            }
            tcsetattr(&stdin, SetArg::TCSANOW, &keyed).is_ok()
        });
        Terminal { before: keyed, parser: Parser::default() }
    }

    /// Lends the terminal to a line editor, which has it while a person writes a line. `None` if stdin is no terminal.
    pub fn lend(undo: impl Display) -> Option<Terminal> {
        give_back_at_panic();
        let settings = tcgetattr(io::stdin()).ok()?;
        *before() = Some(Before { settings: Some(settings), undo: undo.to_string(), is_lent: true });
        Some(Terminal { before: None, parser: Parser::default() })
    }

    /// Writes `changes` to the terminal. `undo` undoes them.
    pub fn change(&self, changes: impl Display, undo: impl Display) -> io::Result<()> {
        if let Some(before) = &mut *before() {
            before.undo = undo.to_string();
        }
        draw(&changes.to_string())
    }

    /// Whether keys are read.
    pub fn has_keys(&self) -> bool {
        self.before.is_some()
    }

    /// The keys that were pressed, after a wait of up to `patience` for the first.
    ///
    /// # Errors
    ///
    /// The terminal is gone.
    pub fn keys(&mut self, patience: Duration) -> io::Result<Vec<Key>> {
        let Some(before) = self.before.as_ref().filter(|_| is_ours()) else {
            thread::sleep(patience);
            return Ok(vec![]);
        };
        let stdin = io::stdin();
        let mut fds = [PollFd::new(stdin.as_fd(), PollFlags::POLLIN)];
        if !matches!(poll(&mut fds, PollTimeout::try_from(patience).unwrap_or(PollTimeout::MAX)), Ok(1)) {
            return Ok(vec![]);
        }
        let mut bytes = [0; 64];
        let count = match read(&stdin, &mut bytes) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(count) => count,
            Err(Errno::EINTR) => return Ok(vec![]),
            Err(error) => return Err(error.into()),
        };
        let pressed = &bytes[..count];
        let mut keys: Vec<Key> = pressed.iter().filter_map(|byte| signal_key(before, *byte)).collect();
        self.parser.parse(pressed, count == bytes.len());
        while let Some(event) = self.parser.pop() {
            match event {
                Event::Key(key) if !key.modifiers.intersects(Modifiers::CONTROL | Modifiers::ALT) => {
                    keys.push(Key::Other(key.code));
                }
                _ => {}
            }
        }
        Ok(keys)
    }
}

/// The key of a byte that the kernel would make a signal of.
fn signal_key(settings: &Termios, byte: u8) -> Option<Key> {
    // 0 means that no key has this function.
    let is = |special: SpecialCharacterIndices| byte != 0 && settings.control_chars[special as usize] == byte;
    match () {
        () if is(SpecialCharacterIndices::VINTR) || is(SpecialCharacterIndices::VQUIT) => Some(Key::End),
        () => is(SpecialCharacterIndices::VSUSP).then_some(Key::Stop),
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        give_back();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::pty::openpty;
    use nix::sys::signal::{Signal, raise};
    use std::fs::File;
    use std::io::Read;
    use std::os::unix::process::ExitStatusExt;
    use std::process::{Command, Stdio};

    #[test]
    #[ignore = "started by the other test"]
    fn taking() {
        let Ok(end) = std::env::var("PINION_TEST_TERMINAL") else { return };
        let terminal = Terminal::take(Keys::All);
        give_back_at(&[libc::SIGTERM], Duration::ZERO).unwrap();
        terminal.change(off(DecPrivateModeCode::ShowCursor), on(DecPrivateModeCode::ShowCursor)).unwrap();
        assert!(!tcgetattr(io::stdin()).unwrap().local_flags.contains(LocalFlags::ICANON));
        match end.as_str() {
            "panic" => {
                let _ = thread::spawn(|| panic!("in a painter")).join();
                // Nothing is dropped.
                std::process::exit(3);
            }
            "signal" => {
                raise(Signal::SIGTERM).unwrap();
                thread::sleep(Duration::from_secs(20));
            }
            _ => drop(terminal),
        }
    }

    #[test]
    fn whatever_ends_the_program_the_terminal_is_as_before() {
        for (end, code, signal) in [("drop", Some(0), None), ("panic", Some(3), None), ("signal", None, Some(15))] {
            let pty = openpty(None, None).unwrap();
            // The master end has the slave's settings. It cannot be read when no slave end is open.
            let before = tcgetattr(&pty.master).unwrap();
            let mut child = Command::new(std::env::current_exe().unwrap())
                .args(["--ignored", "--exact", "--nocapture", "terminal::tests::taking"])
                .env("PINION_TEST_TERMINAL", end)
                .stdin(pty.slave.try_clone().unwrap())
                .stdout(pty.slave)
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            let (mut master, mut seen, mut piece) = (File::from(pty.master), String::new(), [0; 4096]);
            while !seen.contains("\x1b[?25h") {
                let read = master.read(&mut piece).unwrap();
                seen += &String::from_utf8_lossy(&piece[..read]);
            }
            let status = child.wait().unwrap();
            assert_eq!((status.code(), status.signal()), (code, signal), "{end}: {seen}");
            assert_eq!(tcgetattr(&master).unwrap(), before, "{end}");
            assert!(seen.contains("\x1b[?25l"), "{end}: {seen}");
        }
    }

    #[test]
    fn sequences_are_those_of_the_vt100() {
        assert_eq!(format!("{}{}", scrolling(7), to_row(3)), "\x1b[1;7r\x1b[3;1H");
        assert_eq!(all_scrolls(), "\x1b[r\x1b[999;1H\n");
    }
}
