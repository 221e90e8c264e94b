// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's children: git at its start, and processes that calculate for the input shaper. They run in real time. The
//! clock stands still until they have ended, as klippy looks now and then whether they are done. It goes on while a child
//! waits for klippy to read what it writes.

use std::ffi::c_void;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use crate::real::real;
use crate::turns;

/// Real time between two looks at children and descriptors.
pub(crate) const LOOK_MS: i32 = 5;
/// A child that is still there after this real time holds the clock no longer. A plugin's child may run for ever.
const HOLD: Duration = Duration::from_secs(60);
/// A new child that sleeps in so many looks in a row waits for something, for example for what klippy will write.
const RESTS: u32 = 3;

/// Highest number of children that are known at a time. Each has a word that klippy shares with it.
const WORDS: usize = 256;
/// No word of one's own.
const NONE: u32 = u32::MAX;

struct Child {
    pid: libc::pid_t,
    looks: u32,
    /// The place of its word.
    word: usize,
}

/// A word for each child: 1 while it waits for klippy.
static WAITS: OnceLock<&'static [AtomicU32; WORDS]> = OnceLock::new();
/// In a child, the place of its word.
static MINE: AtomicU32 = AtomicU32::new(NONE);

/// Makes the words.
pub(crate) fn begin() {
    let bytes = size_of::<[AtomicU32; WORDS]>();
    let (access, flags) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_SHARED | libc::MAP_ANONYMOUS);
    // SAFETY: a new mapping.
    let page = unsafe { libc::mmap(std::ptr::null_mut(), bytes, access, flags, -1, 0) };
    if page != libc::MAP_FAILED {
        // SAFETY: the mapping is large enough, is never removed, and zero is a valid value.
        let _ = WAITS.set(unsafe { &*page.cast() });
    }
}

static CHILDREN: Mutex<Vec<Child>> = Mutex::new(Vec::new());

/// Whether a child computes, so that no time passes.
pub(crate) fn hold_the_clock() -> bool {
    let mut children = CHILDREN.lock().unwrap_or_else(PoisonError::into_inner);
    children.retain_mut(|child| {
        child.looks += 1;
        child.looks < looks_max() && lives(child.pid)
    });
    children.iter().any(|child| !waits(child))
}

fn looks_max() -> u32 {
    (HOLD.as_millis() / LOOK_MS as u128) as u32
}

/// Whether a child waits for klippy to read.
fn waits(child: &Child) -> bool {
    WAITS.get().is_some_and(|words| words[child.word].load(Ordering::SeqCst) != 0)
}

/// A child that has ended counts as such, before klippy has waited for it.
fn lives(pid: libc::pid_t) -> bool {
    // SAFETY: the structure is plain data.
    let mut about: libc::siginfo_t = unsafe { std::mem::zeroed() };
    let flags = libc::WEXITED | libc::WNOHANG | libc::WNOWAIT;
    // SAFETY: the structure is ours.
    let status = unsafe { libc::waitid(libc::P_PID, pid as libc::id_t, &mut about, flags) };
    // SAFETY: waitid has filled it in.
    status == 0 && unsafe { about.si_pid() } == 0
}

/// The first free word.
pub(crate) fn free_word() -> usize {
    let children = CHILDREN.lock().unwrap_or_else(PoisonError::into_inner);
    let word = (0..WORDS).find(|word| children.iter().all(|child| child.word != *word)).unwrap_or_default();
    if let Some(words) = WAITS.get() {
        words[word].store(0, Ordering::SeqCst);
    }
    word
}

/// A child has started, or this is the child.
pub(crate) fn forked(pid: libc::pid_t, word: usize, is_main: bool) {
    match pid {
        0 => {
            turns::leave();
            // SAFETY: a fork has one thread. What it starts is no participant either.
            unsafe { libc::unsetenv(c"LD_PRELOAD".as_ptr()) };
            MINE.store(word as u32, Ordering::Relaxed);
            if is_main {
                // SAFETY: it has the arguments that prctl(2) names. The child ends with the thread that starts it, which
                // is klippy's end for this one only.
                unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) };
            }
        }
        pid if pid > 0 => {
            let mut child = Child { pid, looks: 0, word };
            await_rest(&mut child);
            CHILDREN.lock().unwrap_or_else(PoisonError::into_inner).push(child);
        }
        _ => {}
    }
}

/// Waits until a new child has ended, or waits for something. klippy may look at once whether it is done: the answer is the
/// same however fast this computer is.
fn await_rest(child: &mut Child) {
    let mut rests = 0;
    while child.looks < looks_max() {
        child.looks += 1;
        rests = if is_asleep(child.pid) { rests + 1 } else { 0 };
        if rests == RESTS || waits(child) || !lives(child.pid) {
            return;
        }
        let (none, count, ms) = (std::ptr::null_mut(), 0, LOOK_MS);
        real!(fn poll(none: *mut libc::pollfd, count: libc::nfds_t, ms: i32) -> i32);
    }
}

/// Whether a process sleeps in the kernel (proc_pid_stat(5), the third field).
fn is_asleep(pid: libc::pid_t) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit_once(") ").is_some_and(|(_, rest)| rest.starts_with('S'))
}

/// # Safety
///
/// That of write(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn write(fd: libc::c_int, bytes: *const c_void, count: usize) -> isize {
    let mine = MINE.load(Ordering::Relaxed);
    let waits = WAITS.get().filter(|_| mine != NONE).map(|words| &words[mine as usize]);
    // A descriptor that is ready has room for so much. So a write waits only where this sees it.
    let count = if waits.is_some() { count.min(libc::PIPE_BUF) } else { count };
    if let Some(waits) = waits {
        let mut room = libc::pollfd { fd, events: libc::POLLOUT, revents: 0 };
        let (fds, one, ms) = (&raw mut room, 1, 0);
        if real!(fn poll(fds: *mut libc::pollfd, one: libc::nfds_t, ms: libc::c_int) -> libc::c_int) == 0 {
            waits.store(1, Ordering::SeqCst);
        }
    }
    let written = real!(fn write(fd: libc::c_int, bytes: *const c_void, count: usize) -> isize);
    if let Some(waits) = waits {
        waits.store(0, Ordering::SeqCst);
    }
    written
}
