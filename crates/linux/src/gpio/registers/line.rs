// SPDX-License-Identifier: GPL-3.0-or-later
//! The registers of one line and of its bank.

#![forbid(unsafe_code)]

use std::io;

use crate::sys;
use pinion_firmware::board::Bank;

/// Highest number of comparisons of a level with the kernel's. A level may change between two reads.
const LOOKS_MAX: u32 = 100;

/// A 32-bit register.
pub(in crate::gpio) trait Register: Copy {
    fn load(self) -> u32;
    fn store(self, value: u32);
    /// Returns when the loads and stores before have reached their device.
    fn wait();
}

impl Register for sys::Register {
    #[inline]
    fn load(self) -> u32 {
        sys::Register::load(self)
    }

    #[inline]
    fn store(self, value: u32) {
        sys::Register::store(self, value);
    }

    #[inline]
    fn wait() {
        sys::Register::wait();
    }
}

/// Bits of a register that say whether a line is an input or an output.
pub(super) struct Field<R> {
    pub(super) register: R,
    pub(super) mask: u32,
    pub(super) input: u32,
    pub(super) output: u32,
}

/// The registers that drive the lines of a bank.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(in crate::gpio) struct RegisterBank<R = sys::Register> {
    /// A 1 makes its line high. A 0 changes nothing.
    pub(super) set: R,
    /// A 1 makes its line low. A 0 changes nothing.
    pub(super) clear: R,
    /// A register to read back, if the bus holds stores back. A load does not overtake them.
    pub(super) posted: Option<R>,
}

impl<R: Register + Sync> Bank for RegisterBank<R> {
    #[inline]
    fn change(&self, high: u32, low: u32) {
        if high != 0 {
            self.set.store(high);
        }
        if low != 0 {
            self.clear.store(low);
        }
    }

    #[inline]
    fn flush(&self) {
        if let Some(register) = self.posted {
            register.load();
        }
        R::wait();
    }
}

/// The registers of one line.
pub(in crate::gpio) struct LineRegisters<R = sys::Register> {
    /// The line's bit in the registers of its bank, and in `level`.
    pub(super) mask: u32,
    pub(super) bank: RegisterBank<R>,
    pub(super) level: R,
    pub(super) direction: Vec<Field<R>>,
}

impl<R: Register> LineRegisters<R> {
    /// The line's bit in its bank.
    pub(in crate::gpio) fn mask(&self) -> u32 {
        self.mask
    }

    /// Drives the line, if it is an output. Otherwise this is its level when it becomes one.
    #[inline]
    pub(in crate::gpio) fn write(&self, level: bool) {
        if level { self.bank.set.store(self.mask) } else { self.bank.clear.store(self.mask) }
    }

    /// Whether a bus holds stores back on their way to the line.
    pub(in crate::gpio) fn is_posted(&self) -> bool {
        self.bank.posted.is_some()
    }

    /// Returns when the last store has reached the line.
    #[inline]
    pub(in crate::gpio) fn flush(&self)
    where
        R: Sync,
    {
        self.bank.flush();
    }

    /// The line's level, also if another device drives it.
    #[inline]
    pub(in crate::gpio) fn read(&self) -> bool {
        self.level.load() & self.mask != 0
    }

    /// Whether the chip itself has the line as an output, or else as an input.
    pub(in crate::gpio) fn is(&self, output: bool) -> bool {
        self.direction.iter().all(|Field { register, mask, input, output: out }| {
            register.load() & mask == if output { *out } else { *input }
        })
    }

    /// Compares the registers with the kernel, which has just set the line up. `output` is the level that an output was
    /// set to; `None` for an input. `kernel` reads the level through the kernel. The line does not change: an output
    /// is only set to its level once more.
    ///
    /// # Errors
    ///
    /// The difference.
    pub(in crate::gpio) fn check(
        &self,
        output: Option<bool>,
        kernel: impl Fn() -> io::Result<bool>,
    ) -> Result<(), &'static str> {
        self.compare(output.is_some(), &kernel)?;
        match output {
            Some(level) => {
                self.write(level);
                self.compare(true, &kernel)
            }
            None => Ok(()),
        }
    }

    fn compare(&self, output: bool, kernel: &impl Fn() -> io::Result<bool>) -> Result<(), &'static str> {
        if !self.is(output) {
            return Err("the direction in its registers is not the kernel's");
        }
        let agree = || {
            let before = self.read();
            kernel().is_ok_and(|level| level == before) && self.read() == before
        };
        match (0..LOOKS_MAX).any(|_| agree()) {
            true => Ok(()),
            false => Err("the level in its registers is not the kernel's"),
        }
    }
}
