// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's threads. One of them has the token and runs.

use std::cell::Cell;
use std::ffi::c_void;
use std::ops::{Deref, DerefMut};
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::children;
use crate::real::real;
use crate::turns::{self, NEVER};

/// The event that a thread waits for.
#[derive(Clone, Copy)]
pub(crate) enum Wait {
    /// A time only.
    Time,
    /// A call of [`wake`] with this address: a mutex, a condition variable, a semaphore, a thread.
    Address(usize),
    /// Descriptors: a `pollfd` array and its length.
    Descriptors(*mut libc::pollfd, usize),
}

// SAFETY: invariant 3.
unsafe impl Send for Wait {}

/// Why a thread goes on.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum WakeReason {
    ByEvent,
    ByTime,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    Free,
    Running,
    Ready,
    Waiting,
}

struct Thread {
    state: State,
    wait: Wait,
    deadline_ns: u64,
    woken: WakeReason,
    /// The order in which threads became ready or began to wait.
    order: u64,
    /// Set to 1 when the thread gets the token.
    token: &'static AtomicU32,
}

struct Threads {
    threads: Vec<Thread>,
    order: u64,
}

// SAFETY: invariant 3.
unsafe impl Send for Threads {}

static THREADS: Mutex<Threads> = Mutex::new(Threads { threads: Vec::new(), order: 0 });
/// How many threads wait for addresses. Most unlocks find none.
static AT_ADDRESSES: AtomicUsize = AtomicUsize::new(0);
/// Its destructor ends a thread.
static END: AtomicU32 = AtomicU32::new(0);

/// No thread of ours.
const NONE: usize = usize::MAX;
/// A thread yields after this many readings of the clock in a row: another may need the token.
const READINGS_MAX: u32 = 256;

thread_local! {
    static ME: Cell<usize> = const { Cell::new(NONE) };
    static READINGS: Cell<u32> = const { Cell::new(0) };
    /// This thread changes the table. A library for memory that is loaded, too, may use locks for what that needs.
    static CHANGES: Cell<bool> = const { Cell::new(false) };
}

/// Whether the calling thread takes turns.
pub(crate) fn is_one() -> bool {
    turns::is_on() && ME.get() != NONE && !CHANGES.get()
}

/// The table of threads, for the time of a change.
struct Table(MutexGuard<'static, Threads>);

impl Deref for Table {
    type Target = Threads;

    fn deref(&self) -> &Threads {
        &self.0
    }
}

impl DerefMut for Table {
    fn deref_mut(&mut self) -> &mut Threads {
        &mut self.0
    }
}

impl Drop for Table {
    fn drop(&mut self) {
        CHANGES.set(false);
    }
}

fn lock() -> Table {
    let table = THREADS.lock().unwrap_or_else(PoisonError::into_inner);
    CHANGES.set(true);
    Table(table)
}

impl Threads {
    fn add(&mut self) -> usize {
        self.order += 1;
        let token: &'static AtomicU32 = Box::leak(Box::new(AtomicU32::new(0)));
        let mut new = Thread {
            state: State::Ready,
            wait: Wait::Time,
            deadline_ns: NEVER,
            woken: WakeReason::ByEvent,
            order: self.order,
            token,
        };
        match self.threads.iter().position(|thread| thread.state == State::Free) {
            Some(place) => {
                new.token = self.threads[place].token;
                new.token.store(0, Ordering::Relaxed);
                self.threads[place] = new;
                place
            }
            None => {
                self.threads.push(new);
                self.threads.len() - 1
            }
        }
    }

    fn ready(&mut self, place: usize, woken: WakeReason) {
        self.order += 1;
        let thread = &mut self.threads[place];
        if matches!(thread.wait, Wait::Address(_)) {
            AT_ADDRESSES.fetch_sub(1, Ordering::Relaxed);
        }
        (thread.state, thread.woken, thread.order) = (State::Ready, woken, self.order);
    }

    fn waiting(&self) -> impl Iterator<Item = (usize, &Thread)> {
        self.threads.iter().enumerate().filter(|(_, thread)| thread.state == State::Waiting)
    }

    /// Gives the token to the next thread. If none can go on, time passes.
    fn dispatch(&mut self) {
        loop {
            let ready = self.threads.iter().enumerate().filter(|(_, thread)| thread.state == State::Ready);
            if let Some((place, _)) = ready.min_by_key(|(_, thread)| thread.order) {
                self.threads[place].state = State::Running;
                let token = self.threads[place].token;
                token.store(1, Ordering::Release);
                futex(token, libc::FUTEX_WAKE, 1);
                return;
            }
            // In this order: what a child has written when it ended is there by now.
            let is_held = children::hold_the_clock();
            if self.look(if is_held { children::LOOK_MS } else { 0 }) || is_held {
                continue;
            }
            let deadline_ns = self.waiting().map(|(_, thread)| thread.deadline_ns).min().unwrap_or(NEVER);
            if turns::pass(deadline_ns) {
                self.look(0);
            }
            let now_ns = turns::now_ns();
            let due = |thread: &Thread| thread.deadline_ns <= now_ns;
            let mut due: Vec<(u64, u64, usize)> = self
                .waiting()
                .filter(|(_, thread)| due(thread))
                .map(|(place, thread)| (thread.deadline_ns, thread.order, place))
                .collect();
            due.sort_unstable();
            due.iter().for_each(|(_, _, place)| self.ready(*place, WakeReason::ByTime));
        }
    }

    /// Looks at the descriptors of all waiting threads, for up to `ms` of real time. Returns whether one is ready.
    fn look(&mut self, ms: i32) -> bool {
        let mut all: Vec<libc::pollfd> = Vec::new();
        let mut owners: Vec<usize> = Vec::new();
        for (place, thread) in self.waiting() {
            let Wait::Descriptors(fds, count) = thread.wait else { continue };
            // SAFETY: invariant 3.
            let fds = unsafe { std::slice::from_raw_parts(fds, count) };
            all.extend(fds);
            owners.extend(fds.iter().map(|_| place));
        }
        let (fds, count) = (all.as_mut_ptr(), all.len() as libc::nfds_t);
        if real!(fn poll(fds: *mut libc::pollfd, count: libc::nfds_t, ms: i32) -> i32) <= 0 {
            return false;
        }
        for (fd, owner) in all.iter().zip(owners) {
            if fd.revents != 0 && self.threads[owner].state == State::Waiting {
                self.ready(owner, WakeReason::ByEvent);
            }
        }
        true
    }
}

fn futex(word: &AtomicU32, operation: i32, value: u32) {
    let forever = std::ptr::null::<libc::timespec>();
    // SAFETY: the word lives for ever.
    unsafe { libc::syscall(libc::SYS_futex, word.as_ptr(), operation | libc::FUTEX_PRIVATE_FLAG, value, forever) };
}

fn await_token(token: &AtomicU32) {
    while token.swap(0, Ordering::Acquire) == 0 {
        futex(token, libc::FUTEX_WAIT, 0);
    }
}

/// Waits, and lets others run during the wait.
pub(crate) fn wait(wait: Wait, deadline_ns: u64) -> WakeReason {
    let me = ME.get();
    READINGS.set(0);
    let mut threads = lock();
    threads.order += 1;
    let order = threads.order;
    let thread = &mut threads.threads[me];
    (thread.state, thread.wait, thread.deadline_ns, thread.order) = (State::Waiting, wait, deadline_ns, order);
    if matches!(wait, Wait::Address(_)) {
        AT_ADDRESSES.fetch_add(1, Ordering::Relaxed);
    }
    go_on(me, threads)
}

/// Lets the others run that can.
pub(crate) fn yield_token() {
    let me = ME.get();
    READINGS.set(0);
    let mut threads = lock();
    if !threads.threads.iter().any(|thread| thread.state == State::Ready) {
        return;
    }
    threads.threads[me].wait = Wait::Time;
    threads.ready(me, WakeReason::ByEvent);
    go_on(me, threads);
}

fn go_on(me: usize, mut threads: Table) -> WakeReason {
    // SAFETY: the address of this thread's error number, which callers may still want.
    let error = unsafe { libc::__errno_location() };
    // SAFETY: the same.
    let before = unsafe { *error };
    let token = threads.threads[me].token;
    threads.dispatch();
    drop(threads);
    await_token(token);
    // SAFETY: the same.
    unsafe { *error = before };
    lock().threads[me].woken
}

/// The clock was read.
pub(crate) fn has_read() {
    let readings = READINGS.get() + 1;
    READINGS.set(readings);
    if readings >= READINGS_MAX {
        yield_token();
    }
}

/// Lets the first `most` threads that wait for an address go on, when their turn comes.
pub(crate) fn wake(address: usize, most: usize) {
    if AT_ADDRESSES.load(Ordering::Relaxed) == 0 || !turns::is_on() || CHANGES.get() {
        return;
    }
    let mut threads = lock();
    for _ in 0..most {
        let at = threads.waiting().filter(|(_, thread)| matches!(thread.wait, Wait::Address(at) if at == address));
        let Some((place, _)) = at.min_by_key(|(_, thread)| thread.order) else { return };
        threads.ready(place, WakeReason::ByEvent);
    }
}

// ---- begin and end

/// The main thread begins, with the token.
pub(crate) fn begin() {
    let mut key = 0;
    // SAFETY: the destructor has the signature that pthread_key_create(3) wants.
    unsafe { libc::pthread_key_create(&mut key, Some(ended)) };
    END.store(key, Ordering::Relaxed);
    let mut threads = lock();
    let me = threads.add();
    threads.threads[me].state = State::Running;
    drop(threads);
    become_one(me);
}

fn become_one(me: usize) {
    ME.set(me);
    // SAFETY: any address but zero has the destructor called.
    unsafe { libc::pthread_setspecific(END.load(Ordering::Relaxed), std::ptr::dangling()) };
}

/// The address at which others wait for the end of a thread.
fn end_of(thread: libc::pthread_t) -> usize {
    // A mutex never has an odd address.
    thread as usize | 1
}

/// A thread ends.
unsafe extern "C" fn ended(_: *mut c_void) {
    let me = ME.get();
    if !turns::is_on() || me == NONE {
        return;
    }
    // SAFETY: it has no arguments.
    let thread = unsafe { libc::pthread_self() };
    living().retain(|living| *living != thread);
    wake(end_of(thread), usize::MAX);
    ME.set(NONE);
    let mut threads = lock();
    threads.threads[me].state = State::Free;
    threads.dispatch();
}

type Start = extern "C" fn(*mut c_void) -> *mut c_void;

struct Begin {
    start: Start,
    argument: *mut c_void,
    me: usize,
    token: &'static AtomicU32,
}

extern "C" fn begin_thread(begin: *mut c_void) -> *mut c_void {
    // SAFETY: pthread_create below made it.
    let begin = unsafe { Box::from_raw(begin.cast::<Begin>()) };
    become_one(begin.me);
    await_token(begin.token);
    let Begin { start, argument, .. } = *begin;
    start(argument)
}

/// Starts a thread that takes turns.
///
/// # Safety
///
/// That of pthread_create(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_create(
    thread: *mut libc::pthread_t,
    attributes: *const libc::pthread_attr_t,
    start: Start,
    argument: *mut c_void,
) -> libc::c_int {
    let create = |start: Start, argument: *mut c_void| {
        real!(fn pthread_create(thread: *mut libc::pthread_t, attributes: *const libc::pthread_attr_t, start: Start,
            argument: *mut c_void) -> libc::c_int)
    };
    if !is_one() {
        return create(start, argument);
    }
    let (me, token) = {
        let mut threads = lock();
        let me = threads.add();
        (me, threads.threads[me].token)
    };
    let begin = Box::into_raw(Box::new(Begin { start, argument, me, token }));
    let status = create(begin_thread, begin.cast());
    if status != 0 {
        // SAFETY: no thread has it.
        drop(unsafe { Box::from_raw(begin) });
        lock().threads[me].state = State::Free;
        return status;
    }
    // SAFETY: the C library has stored it.
    let handle = unsafe { *thread };
    living().push(handle);
    status
}

/// The threads that take turns and have not ended.
static LIVING: Mutex<Vec<libc::pthread_t>> = Mutex::new(Vec::new());

fn living() -> MutexGuard<'static, Vec<libc::pthread_t>> {
    LIVING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for the end of a thread.
///
/// # Safety
///
/// That of pthread_join(3).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pthread_join(thread: libc::pthread_t, result: *mut *mut c_void) -> libc::c_int {
    while is_one() && living().contains(&thread) {
        wait(Wait::Address(end_of(thread)), NEVER);
    }
    // The rest of the thread's end needs no token.
    real!(fn pthread_join(thread: libc::pthread_t, result: *mut *mut c_void) -> libc::c_int)
}
