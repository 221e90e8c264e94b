// SPDX-License-Identifier: GPL-3.0-or-later
//! The board's connection to the guardian process, which gets every output.

#![forbid(unsafe_code)]

use std::io;
use std::mem;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use pinion_firmware::board::ShutdownValue;
use pinion_firmware::shutdown::{Shutdown, reason};

/// Holds copies of the outputs' descriptors. If the program dies, it sets the outputs to their shutdown values.
///
/// An output is known by its name, for example `gpiochip0 line 5` or `pwmchip0/pwm1`. The log uses the same name. A new
/// output with the same name replaces the earlier one.
///
/// Each call fails if the guardian refuses or does not answer.
pub trait Guard: Send {
    /// Copies an output line's descriptor (a GPIO line handle of the character device). `sleeping` is the name of the
    /// line's chip, if calls to this chip may block. The lines of this chip have a thread of their own, so that no
    /// other output waits for it.
    fn output(
        &mut self,
        name: &str,
        line: RawFd,
        shutdown_value: ShutdownValue<bool>,
        sleeping: Option<&str>,
    ) -> io::Result<()>;

    /// Copies the descriptors of the files that set one output, for example a PWM's `duty_cycle` and `enable`.
    /// `shutdown` has the text to write at the beginning of each file, in this order.
    fn files(&mut self, name: &str, shutdown: &[(RawFd, &[u8])]) -> io::Result<()>;

    /// Drops the copies of a line or channel that is no longer an output.
    fn forget(&mut self, name: &str) -> io::Result<()>;

    /// Drops all copies. When this returns, the lines can be requested again.
    fn release(&mut self) -> io::Result<()>;
}

/// The guard, if there is one, shared by the board and its workers. A call waits for the guardian's answer. So the core
/// calls it only until the MCU is configured. Later only workers call it.
#[derive(Clone)]
pub(super) struct SharedGuard(Option<Arc<Mutex<Box<dyn Guard>>>>);

impl SharedGuard {
    pub(super) fn new(guard: Option<Box<dyn Guard>>) -> SharedGuard {
        SharedGuard(guard.map(|guard| Arc::new(Mutex::new(guard))))
    }

    fn lock(&self) -> Option<MutexGuard<'_, Box<dyn Guard>>> {
        self.0.as_ref().map(|guard| guard.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// See [`Guard::output`].
    pub(super) fn output(
        &self,
        name: &str,
        line: RawFd,
        shutdown_value: ShutdownValue<bool>,
        sleeping: Option<&str>,
    ) -> Result<(), Shutdown> {
        match self.lock() {
            Some(mut guard) => {
                guard.output(name, line, shutdown_value, sleeping).map_err(|error| not_taken(name, &error))
            }
            None => Ok(()),
        }
    }

    /// See [`Guard::files`].
    pub(super) fn files(&self, name: &str, shutdown: &[(RawFd, &[u8])]) -> Result<(), Shutdown> {
        match self.lock() {
            Some(mut guard) => guard.files(name, shutdown).map_err(|error| not_taken(name, &error)),
            None => Ok(()),
        }
    }

    /// See [`Guard::forget`].
    pub(super) fn forget(&self, name: &str) -> Result<(), Shutdown> {
        match self.lock() {
            Some(mut guard) => guard.forget(name).map_err(|error| not_taken(name, &error)),
            None => Ok(()),
        }
    }

    /// See [`Guard::release`].
    pub(super) fn release(&self) -> io::Result<()> {
        self.lock().map_or(Ok(()), |mut guard| guard.release())
    }
}

/// A line and its shutdown value at the guardian, which has a copy of the line while it is an output.
pub(super) struct GuardedLine {
    guard: SharedGuard,
    name: String,
    /// The name of the line's chip, if calls to this chip may block.
    sleeping: Option<String>,
    /// The shutdown value that the guardian has. `None`: it has no copy.
    held: Mutex<Option<ShutdownValue<bool>>>,
}

impl GuardedLine {
    /// A line that the guardian does not have.
    pub(super) fn new(guard: SharedGuard, name: String, sleeping: Option<String>) -> GuardedLine {
        GuardedLine { guard, name, sleeping, held: Mutex::default() }
    }

    /// Whether calls to the line's chip may block.
    #[inline]
    pub(super) fn may_sleep(&self) -> bool {
        self.sleeping.is_some()
    }

    /// Gives the line with this shutdown value to the guardian, or takes it back. Returns what the guardian had.
    pub(super) fn hold(
        &self,
        line: RawFd,
        value: Option<ShutdownValue<bool>>,
    ) -> Result<Option<ShutdownValue<bool>>, Shutdown> {
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        match (value, *held) {
            (value, held) if value == held => {}
            (Some(value), _) => self.guard.output(&self.name, line, value, self.sleeping.as_deref())?,
            (None, _) => self.guard.forget(&self.name)?,
        }
        Ok(mem::replace(&mut *held, value))
    }

    /// Sets the line up with `turn`. The line is never an output without the guardian: it gets an output before, and
    /// returns an input after. If `turn` fails, it has what it had. If it does not take the line, `let_go` releases it.
    pub(super) fn set_up(
        &self,
        line: RawFd,
        wanted: Option<ShutdownValue<bool>>,
        turn: impl FnOnce() -> Result<(), Shutdown>,
        let_go: impl FnOnce(),
    ) -> Result<(), Shutdown> {
        let before = match wanted {
            Some(_) => self.hold(line, wanted)?,
            None => *self.held.lock().unwrap_or_else(PoisonError::into_inner),
        };
        let turned = turn();
        // `turn` may have taken the line back.
        let held = self.hold(line, if turned.is_ok() { wanted } else { before });
        if held.is_err() {
            let_go();
        }
        turned.and(held.map(drop))
    }
}

fn not_taken(name: &str, error: &io::Error) -> Shutdown {
    let cause = format!("the guardian does not take {name}: {error}");
    Shutdown::because(reason::GUARDIAN_LOST, cause).remedy("restart Pinion")
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use pinion_firmware::board::Direction;

    /// The calls to the guardian, and whether it refuses them from now on.
    #[derive(Default)]
    pub struct Seen {
        pub calls: Vec<String>,
        pub refuses: bool,
    }

    pub struct Fake(pub Arc<Mutex<Seen>>);

    impl Fake {
        fn did(&mut self, call: String) -> io::Result<()> {
            let mut seen = self.0.lock().unwrap();
            seen.calls.push(call);
            if seen.refuses { Err(io::Error::other("it is gone")) } else { Ok(()) }
        }
    }

    impl Guard for Fake {
        fn output(&mut self, name: &str, _: RawFd, value: ShutdownValue<bool>, _: Option<&str>) -> io::Result<()> {
            self.did(format!("{name}: {}", value.get()))
        }

        fn files(&mut self, name: &str, _: &[(RawFd, &[u8])]) -> io::Result<()> {
            self.did(format!("files of {name}"))
        }

        fn forget(&mut self, name: &str) -> io::Result<()> {
            self.did(format!("forget {name}"))
        }

        fn release(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn line() -> (GuardedLine, Arc<Mutex<Seen>>) {
        let seen = Arc::default();
        let guard = SharedGuard::new(Some(Box::new(Fake(Arc::clone(&seen)))));
        (GuardedLine::new(guard, "line 5".into(), None), seen)
    }

    fn output(level: bool) -> Option<ShutdownValue<bool>> {
        Direction::at_rest(level).shutdown_value()
    }

    fn calls(seen: &Mutex<Seen>) -> Vec<String> {
        mem::take(&mut seen.lock().unwrap().calls)
    }

    fn refused() -> Shutdown {
        Shutdown::because(reason::OUTPUT_LINE, "the kernel refuses it")
    }

    #[test]
    fn the_guardian_has_an_output_before_it_is_one_and_an_input_until_it_is_one() {
        let (line, seen) = line();
        let turn = |what: &str| {
            seen.lock().unwrap().calls.push(what.to_owned());
            Ok(())
        };
        let never = || panic!("the line stays");
        line.set_up(5, output(true), || turn("output"), never).unwrap();
        line.set_up(5, output(true), || turn("again"), never).unwrap();
        line.set_up(5, output(false), || turn("other"), never).unwrap();
        line.set_up(5, None, || turn("input"), never).unwrap();
        line.set_up(5, None, || turn("input"), never).unwrap();
        let expected = ["line 5: true", "output", "again", "line 5: false", "other", "input", "forget line 5", "input"];
        assert_eq!(calls(&seen), expected);
    }

    /// Linux before 5.5: a line is released and requested again, and the guardian gives its copy back before that.
    #[test]
    fn a_line_that_the_kernel_refuses_is_guarded_as_before() {
        for before in [output(true), None] {
            for wanted in [output(false), None] {
                let (line, seen) = line();
                line.hold(5, before).unwrap();
                let turn = || line.hold(5, None).and(Err(refused()));
                let error = line.set_up(5, wanted, turn, || panic!("the line stays")).unwrap_err();
                assert_eq!(error.reason, reason::OUTPUT_LINE);
                let expected = if before.is_some() { "line 5: true" } else { "forget line 5" };
                let last = calls(&seen).pop();
                assert!(last.is_none_or(|last| last == expected), "{before:?} {wanted:?}");
                assert_eq!(*line.held.lock().unwrap(), before);
            }
        }
    }

    #[test]
    fn a_line_that_the_guardian_does_not_take_is_no_output() {
        let (line, seen) = line();
        seen.lock().unwrap().refuses = true;
        let turn = || panic!("it must not become an output");
        let error = line.set_up(5, output(true), turn, || panic!("it is not one")).unwrap_err();
        assert_eq!(error.reason, reason::GUARDIAN_LOST);
        // It had a copy, gave it back for the kernel's sake, and is lost then.
        seen.lock().unwrap().refuses = false;
        let mut is_released = false;
        let turn = || {
            line.hold(5, None)?;
            seen.lock().unwrap().refuses = true;
            Ok(())
        };
        assert_eq!(
            line.set_up(5, output(true), turn, || is_released = true).unwrap_err().reason,
            reason::GUARDIAN_LOST
        );
        assert!(is_released);
    }
}
