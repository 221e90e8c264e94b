// SPDX-License-Identifier: GPL-3.0-or-later
//! The library that gives klippy the printer's clock, in this computer's Python. Here the test is the printer.

use std::env;
use std::fs;
use std::io::{Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use tempfile::TempDir;

/// The printer's time at the start.
const START_NS: u64 = 1_000_000_000_000;
/// A wait without an end.
const NEVER: u64 = u64::MAX;

/// A folder with the library. The loader takes a space in the path of a target folder for the end of it.
fn library() -> (TempDir, PathBuf) {
    let built = Path::new(env!("CARGO_BIN_EXE_pinion-sim")).with_file_name("deps/libpinion_clock.so");
    // scripts/test-clock-arm64 has one for another processor.
    let built = env::var_os("PINION_CLOCK_LIBRARY").map_or(built, PathBuf::from);
    let folder = tempfile::tempdir().unwrap();
    let library = folder.path().join("clock.so");
    fs::copy(built, &library).unwrap();
    (folder, library)
}

/// A program with the library, and the printer's end of its turns.
struct Player {
    child: Child,
    socket: UnixStream,
    now_ns: u64,
    turns: u64,
    _folder: TempDir,
}

impl Player {
    fn start(program: &str, arguments: &[&str]) -> Player {
        let (socket, theirs) = UnixStream::pair().unwrap();
        fcntl(&theirs, FcntlArg::F_SETFD(FdFlag::empty())).unwrap();
        let (folder, library) = library();
        let child = Command::new(program)
            .args(arguments)
            .env("LD_PRELOAD", library)
            .env("PINION_CLOCK", format!("{}:0:/nonexistent", theirs.as_raw_fd()))
            .env("PYTHONHASHSEED", "0")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        Player { child, socket, now_ns: START_NS, turns: 0, _folder: folder }
    }

    /// The next two words, or nothing after its end.
    fn hear(&mut self) -> Option<[u64; 2]> {
        let mut bytes = [0; 16];
        self.socket.read_exact(&mut bytes).ok()?;
        let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        Some([word(0), word(8)])
    }

    fn pass(&mut self, has_news: bool) {
        let turn = [self.now_ns.to_le_bytes(), u64::from(has_news).to_le_bytes()].concat();
        self.turns += 1;
        // It may have ended.
        let _ = self.socket.write_all(&turn);
    }

    /// Plays to the end, and returns what the program printed.
    fn play(mut self) -> String {
        assert_eq!(self.hear().unwrap()[0].to_le_bytes(), *b"pinion1\0");
        self.pass(true);
        while let Some([now_ns, until_ns]) = self.hear() {
            if now_ns.to_le_bytes() == *b"pinion1\0" {
                // Another program in the same process.
                self.pass(true);
                continue;
            }
            assert!(now_ns >= self.now_ns, "the time goes back");
            assert_ne!(until_ns, NEVER, "everybody waits, and nobody would ever wake up");
            self.now_ns = now_ns.max(until_ns);
            self.pass(false);
        }
        let mut said = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut said).unwrap();
        assert!(self.child.wait().unwrap().success(), "{said}");
        said
    }
}

fn primitives() -> String {
    format!("{}/tests/klippy_clock/primitives.py", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn time_passes_only_while_all_threads_wait_and_each_run_is_the_same() {
    let said = Player::start("python3", &[&primitives()]).play();
    assert!(said.contains("\nsignal\n"), "{said}");
    assert!(said.contains("large child: 0.000 s, (0, (333332833333500000, 1000000))"), "{said}");
    assert_eq!(Player::start("python3", &[&primitives()]).play(), said);
}

#[test]
fn a_script_that_starts_python_in_its_own_place_takes_part() {
    let script = "test \"$(echo child)\" = child && exec python3 \"$0\"";
    let said = Player::start("sh", &["-c", script, &primitives()]).play();
    assert!(said.contains("all of it: "), "{said}");
}

#[test]
fn a_program_whose_printer_is_gone_ends() {
    let mut player = Player::start("python3", &["-c", "import time; time.sleep(1e6)"]);
    player.hear().unwrap();
    player.pass(true);
    player.hear().unwrap();
    drop(player.socket);
    assert!(player.child.wait().unwrap().success());
}

#[test]
fn a_program_without_a_printer_has_the_computers_clock() {
    let script = "import time, threading\nthreading.Event().wait(0.01)\nprint(time.time() > 1.7e9, time.monotonic())";
    let (_folder, library) = library();
    let done = Command::new("python3").args(["-c", script]).env("LD_PRELOAD", library).output().unwrap();
    assert!(String::from_utf8_lossy(&done.stdout).starts_with("True "), "{done:?}");
}
