// SPDX-License-Identifier: GPL-3.0-or-later
//! The outputs that the guardian holds, and how it drives them.

use std::io;
use std::iter;
use std::os::fd::OwnedFd;

use nix::sys::uio::pwrite;

use pinion_linux::sys;

/// Drives an output to its shutdown value.
pub(super) type Drive = Box<dyn Fn() -> io::Result<()> + Send>;

/// Whether an output could be driven.
pub(super) struct Outcome {
    pub(super) name: String,
    /// The result of the last attempt. `None` until the first attempt has returned.
    pub(super) result: Option<io::Result<()>>,
}

impl Outcome {
    pub(super) fn is_driven(&self) -> bool {
        matches!(self.result, Some(Ok(())))
    }

    /// For the log: the output's name and its fault.
    pub(super) fn complaint(&self) -> String {
        match &self.result {
            Some(Err(error)) => format!("{}: {error}", self.name),
            _ => format!("{}: its driver hangs (dmesg)", self.name),
        }
    }
}

/// An output that the guardian holds.
pub(super) struct Output {
    pub(super) drive: Drive,
    pub(super) outcome: Outcome,
}

impl Output {
    pub(super) fn new(name: &str, drive: Drive) -> Output {
        Output { drive, outcome: Outcome { name: name.into(), result: None } }
    }

    pub(super) fn line(name: &str, line: OwnedFd, value: bool) -> Output {
        Output::new(name, Box::new(move || sys::set_line(&line, value)))
    }

    /// A line of a chip that may sleep. It is driven in a way that reports whether the chip has answered.
    pub(super) fn sleeping_line(name: &str, line: OwnedFd, value: bool) -> Output {
        Output::new(name, Box::new(move || sys::set_line_checked(&line, sys::OUTPUT, value)))
    }

    /// An output that is set by files, such as a PWM. Each file has the bytes to write at its beginning.
    pub(super) fn files(name: &str, files: Vec<(OwnedFd, Box<[u8]>)>) -> Output {
        let drive = move || {
            files.iter().try_for_each(|(file, bytes)| match pwrite(file, bytes, 0)? {
                written if written == bytes.len() => Ok(()),
                _ => Err(io::ErrorKind::WriteZero.into()),
            })
        };
        Output::new(name, Box::new(drive))
    }
}

/// Drives every output, even if others fail. Does not allocate.
pub(super) fn drive(outputs: &mut [Output]) {
    for Output { drive, outcome } in outputs {
        outcome.result = Some(drive());
    }
}

/// Outputs that one thread drives: a PWM, or the lines of a chip whose driver may sleep.
pub(super) struct Group {
    chip: String,
    pub(super) outputs: Vec<Output>,
}

/// The outputs that the guardian holds.
#[derive(Default)]
pub(super) struct HeldOutputs {
    /// Lines of chips whose drivers never sleep.
    pub(super) native: Vec<Output>,
    pub(super) apart: Vec<Group>,
}

impl HeldOutputs {
    pub(super) fn is_empty(&self) -> bool {
        self.native.is_empty() && self.apart.is_empty()
    }

    /// Holds an output, in place of one with the same name. With `chip` that chip's thread drives it. Without a chip it
    /// is driven with the native lines.
    pub(super) fn hold(&mut self, chip: Option<&str>, output: Output) {
        self.forget(&output.outcome.name);
        match chip {
            None => self.native.push(output),
            Some(chip) => match self.apart.iter_mut().find(|group| group.chip == chip) {
                Some(group) => group.outputs.push(output),
                None => self.apart.push(Group { chip: chip.into(), outputs: vec![output] }),
            },
        }
    }

    /// Drops the output of this name.
    pub(super) fn forget(&mut self, name: &str) {
        let others = self.apart.iter_mut().map(|group| &mut group.outputs);
        for outputs in iter::once(&mut self.native).chain(others) {
            outputs.retain(|held| *held.outcome.name != *name);
        }
        self.apart.retain(|group| !group.outputs.is_empty());
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    fn output(name: &str, drive: impl Fn() -> io::Result<()> + Send + 'static) -> Output {
        Output::new(name, Box::new(drive))
    }

    #[test]
    fn an_output_that_is_given_again_replaces_itself() {
        let value = Arc::new(AtomicU32::new(0));
        let set = |to| {
            let value = value.clone();
            output("gpiochip0 line 5", move || {
                value.store(to, Ordering::SeqCst);
                Ok(())
            })
        };
        let mut held = HeldOutputs::default();
        held.hold(None, set(1));
        held.hold(None, output("gpiochip0 line 6", || Ok(())));
        held.hold(None, set(2));
        held.hold(Some("gpiochip3"), output("gpiochip3 line 5", || Ok(())));
        held.hold(Some("gpiochip3"), output("gpiochip3 line 6", || Ok(())));
        held.hold(Some("gpiochip3"), output("gpiochip3 line 5", || Ok(())));
        assert_eq!((held.native.len(), held.apart.len(), held.apart[0].outputs.len()), (2, 1, 2));
        drive(&mut held.native);
        assert_eq!(value.load(Ordering::SeqCst), 2);
    }
}
