// SPDX-License-Identifier: GPL-3.0-or-later
//! The far end: carries bytes between standard input and output and the terminal of a running Pinion.

use std::fs::{File, OpenOptions};
use std::io::{self, IsTerminal};
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg, OFlag};
use nix::poll::{PollFd, PollFlags, poll};
use nix::sys::termios::{FlushArg, SetArg, cfmakeraw, tcflush, tcgetattr, tcsetattr};
use signal_hook::consts::{SIGINT, SIGTERM};

use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::{monotonic, poll_timeout};

use super::{Flow, Incoming, SILENCE_MAX, SYNC, Wire, read_some, write_some};
use crate::process::signals::hang_up;
use crate::transport::stdio::StdioGuard;
use crate::trouble::refused;

/// How long the host's last bytes may wait for the MCU. A stop may be among them.
const FAREWELL: Duration = Duration::from_secs(1);
/// The remedy for a terminal that is gone.
const START: &str = "start Pinion there, or name its link with --remote";

/// Carries bytes between a host's connection and the terminal behind `link`, until one of them ends.
///
/// # Errors
///
/// The terminal cannot be opened or is another host's; it is gone; the other end is silent.
pub fn attach(link: &Path) -> Result<(), Trouble> {
    let broken = |error: io::Error| refused("the connection to the host's computer", error).remedy("connect again");
    let (stdin, stdout) = (io::stdin(), io::stdout());
    if stdin.is_terminal() || stdout.is_terminal() {
        return Err(Trouble::new("pinion attach is the far end of pinion link, and standard input is a terminal")
            .remedy("run pinion link on the host's computer, or pinion console here"));
    }
    let terminal = open(link)?;
    let lost = |error: io::Error| refused(link.display(), error).remedy(START);
    // Other programs may use them afterwards, with the same flags.
    let ends: Vec<i32> = hang_up().map_err(broken)?.into_iter().chain([SIGINT, SIGTERM]).collect();
    let _lent = StdioGuard::take(&ends)?;
    let own = |fd: &dyn AsFd| fd.as_fd().try_clone_to_owned();
    let mut wire = own(&stdin).and_then(|stdin| Wire::new(stdin, own(&stdout)?)).map_err(broken)?;
    let mut inward = Flow::new();
    // This says that the terminal is open.
    wire.outward.push(&[SYNC]);
    let mut is_host_there = false;
    let mut ends_at = None;
    loop {
        wire.give_sign().map_err(broken)?;
        inward.drain(|bytes| write_some(&*terminal, bytes)).map_err(lost)?;
        if wire.is_silent() && ends_at.is_none() && inward.has_room() {
            let cause = format!("the host's computer has said nothing for {} s", SILENCE_MAX.as_secs());
            return Err(Trouble::new(cause).remedy("look at the network"));
        }
        if ends_at.is_some_and(|at| inward.is_empty() || monotonic() >= at) {
            return Ok(());
        }
        let reads = |is_wanted: bool| if is_wanted { PollFlags::POLLIN } else { PollFlags::empty() };
        let writes = if inward.is_empty() { PollFlags::empty() } else { PollFlags::POLLOUT };
        let mut fds = [
            PollFd::new(terminal.as_fd(), reads(wire.outward.has_room()) | writes),
            PollFd::new(wire.output.as_fd(), wire.output_events()),
            PollFd::new(wire.input.as_fd(), reads(true)),
        ];
        // The MCU does not read, or the end of the input has been seen: an output that has hung up would end each wait.
        let count = ends_at.map_or(if inward.has_room() { 3 } else { 2 }, |_| 1);
        let due = ends_at.unwrap_or_else(|| wire.due()).saturating_sub(monotonic());
        match poll(&mut fds[..count], poll_timeout(due)) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(error) => return Err(broken(error.into())),
        }
        let [from_mcu, output, from_host] = fds.map(|fd| fd.revents().unwrap_or(PollFlags::empty()));
        if from_mcu.intersects(PollFlags::POLLIN | PollFlags::POLLHUP)
            && wire.outward.has_room()
            && wire.outward.fill(|buffer| read_some(&*terminal, buffer)).map_err(lost)?.0 == Incoming::Over
        {
            return Err(Trouble::new("Pinion has ended").of(link.display()).remedy(START));
        }
        // Nobody reads any more. The host's last bytes may still be in the input: a stop may be among them.
        if output.contains(PollFlags::POLLERR) && from_host.is_empty() {
            ends_at = Some(monotonic() + FAREWELL);
        }
        if count < 3 {
            wire.forgive_silence();
        } else if !from_host.is_empty() {
            let (heard, bytes) = wire.read(&mut inward).map_err(broken)?;
            // A keepalive is no host.
            is_host_there |= bytes.iter().any(|byte| *byte != SYNC);
            if !is_host_there {
                inward.clear();
            }
            if heard == Incoming::Over {
                ends_at = Some(monotonic() + FAREWELL);
            }
        }
    }
}

/// Opens a terminal like a host does. Another `pinion attach` cannot open it until this one ends.
fn open(link: &Path) -> Result<Flock<File>, Trouble> {
    let flags = OFlag::O_NOCTTY | OFlag::O_NONBLOCK;
    let opened = OpenOptions::new().read(true).write(true).custom_flags(flags.bits()).open(link);
    let file = opened.map_err(|error| refused(link.display(), error).remedy(START))?;
    let file = Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, error)| match error {
        Errno::EWOULDBLOCK => Trouble::new("another host has it open").of(link.display()).remedy("stop that one first"),
        error => refused(link.display(), error).remedy(START),
    })?;
    let make_raw = || {
        let mut raw = tcgetattr(&*file)?;
        cfmakeraw(&mut raw);
        tcsetattr(&*file, SetArg::TCSANOW, &raw)?;
        // Leftovers of an earlier host.
        tcflush(&*file, FlushArg::TCIFLUSH)
    };
    make_raw().map_err(|error| refused(link.display(), error).remedy(START))?;
    Ok(file)
}
