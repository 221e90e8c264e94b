// SPDX-License-Identifier: GPL-3.0-or-later
//! Threads that drive the outputs of a program that died or hangs.

use std::io;
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use pinion_linux::clock::monotonic;

use super::outputs::{Drive, Outcome, Output};
use super::program::Program;

/// Pause between two attempts to drive an output.
const TRY_EVERY: Duration = Duration::from_millis(50);

/// A thread's report after each attempt to drive an output: the output's number, and the result.
type Attempt = (usize, io::Result<()>);

/// Threads that each drive a group of outputs. So a driver that hangs delays neither the other groups nor this process.
pub(super) struct RescueThreads {
    sender: Sender<Attempt>,
    attempts: Receiver<Attempt>,
    /// Indexed by the outputs' numbers.
    outcomes: Vec<Outcome>,
    /// Work without a thread: none could be started because memory is short.
    left: Vec<Work>,
}

impl Default for RescueThreads {
    fn default() -> RescueThreads {
        let (sender, attempts) = mpsc::channel();
        RescueThreads { sender, attempts, outcomes: Vec::new(), left: Vec::new() }
    }
}

impl RescueThreads {
    /// Starts a thread that drives these outputs, and retries those that fail until `try_for` is over. With `survivor`,
    /// the program still lives and may drive them too. Then they are driven at once, and again when it has ended.
    pub(super) fn employ(&mut self, outputs: Vec<Output>, survivor: Option<Arc<Program>>, try_for: Duration) {
        let mut drives = Vec::new();
        for Output { drive, outcome } in outputs {
            drives.push((self.outcomes.len(), drive));
            self.outcomes.push(Outcome { result: None, ..outcome });
        }
        // If the thread cannot be started, its closure is dropped with all that it owns. So it shares the work with
        // this function, which can then take the work back.
        let work = Arc::new(Mutex::new(Some(Work { drives, survivor, try_for })));
        let (theirs, sender) = (work.clone(), self.sender.clone());
        let run = move || {
            if let Some(work) = take(&theirs) {
                // Sending fails once `wait` has returned. Nobody needs the result then.
                work.run(|report| drop(sender.send(report)));
            }
        };
        if thread::Builder::new().spawn(run).is_err() {
            self.left.extend(take(&work));
        }
    }

    /// Waits until all outputs are driven, or `limit` is over, and returns the outcomes. It calls `complain` once for
    /// each output whose first attempt fails.
    pub(super) fn wait(self, limit: Duration, mut complain: impl FnMut(&Outcome)) -> Vec<Outcome> {
        let RescueThreads { sender, attempts, mut outcomes, left } = self;
        // Without this sender the channel closes when the last thread is done, and ends the wait.
        drop(sender);
        let mut note = |(number, result): Attempt| {
            let outcome: &mut Outcome = &mut outcomes[number];
            let first = outcome.result.is_none();
            outcome.result = Some(result);
            if first && !outcome.is_driven() {
                complain(outcome);
            }
        };
        let until = monotonic() + limit;
        while let Ok(report) = attempts.recv_timeout(until.saturating_sub(monotonic())) {
            note(report);
        }
        // This comes last, because a driver that hangs would block this thread.
        for work in left {
            work.run(&mut note);
        }
        outcomes
    }
}

/// The work of one thread: see [`RescueThreads::employ`].
struct Work {
    drives: Vec<(usize, Drive)>,
    survivor: Option<Arc<Program>>,
    try_for: Duration,
}

impl Work {
    fn run(self, mut report: impl FnMut(Attempt)) {
        let Work { mut drives, survivor, try_for } = self;
        if let Some(program) = survivor {
            for (_, drive) in &drives {
                // Not reported: they are driven again below.
                let _ = drive();
            }
            program.wait_for_end();
        }
        let until = monotonic() + try_for;
        loop {
            drives.retain(|(number, drive)| {
                let result = drive();
                let failed = result.is_err();
                report((*number, result));
                failed
            });
            if drives.is_empty() || monotonic() >= until {
                return;
            }
            thread::sleep(TRY_EVERY);
        }
    }
}

fn take<T>(from: &Mutex<Option<T>>) -> Option<T> {
    from.lock().unwrap_or_else(PoisonError::into_inner).take()
}

/// For the log: how many outputs could be driven, and the faults of the others.
pub(super) fn summary(outcomes: &[&Outcome]) -> String {
    let all = outcomes.len();
    let complaints: Vec<_> =
        outcomes.iter().filter(|outcome| !outcome.is_driven()).map(|outcome| outcome.complaint()).collect();
    match complaints.len() {
        0 => format!("all {all} outputs are driven to their shutdown values, start Pinion again"),
        failed => format!(
            "only {} of {all} outputs are driven to their shutdown values ({}): switch the power off",
            all - failed,
            complaints.join(", ")
        ),
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::sync::atomic::{AtomicU32, Ordering};

    use nix::errno::Errno;

    use super::super::outputs::drive;
    use super::*;

    /// Far longer than anything takes.
    const LONG: Duration = Duration::from_secs(60);

    thread_local! {
        /// Dropped when the thread ends, and so after it has reported its results.
        static ALIVE: Cell<Option<Sender<()>>> = const { Cell::new(None) };
    }

    fn output(name: &str, drive: impl Fn() -> io::Result<()> + Send + 'static) -> Output {
        Output::new(name, Box::new(drive))
    }

    /// An output that notes when the thread that drove it ends.
    fn noted(name: &str, alive: &Sender<()>, errno: Option<Errno>) -> Output {
        let alive = alive.clone();
        output(name, move || {
            ALIVE.set(Some(alive.clone()));
            errno.map_or(Ok(()), |errno| Err(errno.into()))
        })
    }

    fn error_code(outcome: &Outcome) -> Option<i32> {
        outcome.result.as_ref()?.as_ref().err()?.raw_os_error()
    }

    /// Its first attempt was made before the program was killed, which nobody complained of.
    #[test]
    fn an_output_that_failed_before_is_complained_of_when_it_fails_again() {
        let mut failing = vec![output("gpiochip0 line 5", || Err(Errno::EIO.into()))];
        drive(&mut failing);
        let mut rescue = RescueThreads::default();
        rescue.employ(failing, None, Duration::ZERO);
        let mut complaints = Vec::new();
        rescue.wait(LONG, |outcome| complaints.push(outcome.complaint()));
        assert_eq!(complaints, ["gpiochip0 line 5: Input/output error (os error 5)"]);
    }

    #[test]
    fn a_driver_that_hangs_keeps_nobody_else() {
        let (_release, hangs) = mpsc::channel::<()>();
        let hangs = Mutex::new(hangs);
        let (alive, ended) = mpsc::channel();
        let stuck = output("gpiochip3 line 5", move || hangs.lock().unwrap().recv().map_err(io::Error::other));
        let mut rescue = RescueThreads::default();
        // A line behind the one that hangs, of the same chip, is lost with it.
        rescue.employ(vec![stuck, output("gpiochip3 line 6", || Ok(()))], None, Duration::ZERO);
        rescue.employ(vec![noted("pwmchip0/pwm0", &alive, Some(Errno::ENODEV))], None, Duration::ZERO);
        rescue.employ(vec![noted("pwmchip0/pwm1", &alive, None)], None, Duration::ZERO);
        drop(alive);
        assert!(ended.recv().is_err(), "both of the others are done");
        let mut complaints = Vec::new();
        let outcomes = rescue.wait(Duration::from_millis(1), |outcome| complaints.push(outcome.complaint()));
        assert!(outcomes[0].result.is_none() && outcomes[1].result.is_none());
        assert_eq!(error_code(&outcomes[2]), Some(libc::ENODEV));
        assert!(outcomes[3].is_driven());
        assert_eq!(complaints, ["pwmchip0/pwm0: No such device (os error 19)"]);
        let summary = summary(&outcomes.iter().collect::<Vec<_>>());
        let begin = "only 1 of 4 outputs are driven to their shutdown values (gpiochip3 line 5: its driver hangs";
        assert!(summary.starts_with(begin) && summary.ends_with("switch the power off"), "{summary}");
    }

    #[test]
    fn an_output_that_fails_is_tried_again_and_those_beside_it_wait_for_nothing() {
        let (tries, others) = (Arc::new(AtomicU32::new(0)), Arc::new(AtomicU32::new(0)));
        let (theirs, of_others) = (tries.clone(), others.clone());
        let failing = output("pwmchip0/pwm0", move || match theirs.fetch_add(1, Ordering::SeqCst) {
            0..3 => Err(Errno::EIO.into()),
            _ => Ok(()),
        });
        let other = output("pwmchip0/pwm1", move || {
            of_others.fetch_add(1, Ordering::SeqCst);
            Ok(())
        });
        let mut rescue = RescueThreads::default();
        rescue.employ(vec![failing, other], None, LONG);
        let mut complaints = 0;
        let outcomes = rescue.wait(LONG, |outcome| {
            assert_eq!(error_code(outcome), Some(libc::EIO));
            complaints += 1;
        });
        assert!(outcomes.iter().all(Outcome::is_driven));
        assert_eq!((complaints, tries.load(Ordering::SeqCst), others.load(Ordering::SeqCst)), (1, 4, 1));
    }

    #[test]
    fn an_output_that_keeps_failing_is_given_up() {
        let mut rescue = RescueThreads::default();
        rescue.employ(vec![output("pwmchip0/pwm0", || Err(Errno::EIO.into()))], None, Duration::from_millis(1));
        let outcomes = rescue.wait(LONG, |_| ());
        assert_eq!(error_code(&outcomes[0]), Some(libc::EIO));
    }
}
