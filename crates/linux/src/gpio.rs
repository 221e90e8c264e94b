// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO lines through the kernel's character device.
//!
//! Pinion cannot see whether a chip has really switched a pull resistor on. If the driver answers `ENOTSUPP`, the
//! kernel takes this for success. The kernel's information about a line only repeats the request. So a resistor is
//! refused if the kernel refuses it. It is also refused on the chips in [`WITHOUT_BIAS`], which are known to have none.
//! On any other chip Pinion trusts the driver.

#![forbid(unsafe_code)]

use std::fs;
use std::io;
use std::os::fd::AsRawFd;
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use gpio_cdev::{LineHandle, LineRequestFlags};

use super::guard::{GuardedLine, SharedGuard};
use crate::places::GPIO;
use crate::sys;
use pinion_firmware::board::{Bank, Bias, Direction, Line};
use pinion_firmware::shutdown::{Shutdown, ShutdownReason, reason};

mod chip;
mod edges;
mod refusal;
mod registers;

pub use chip::{Chip, LineInfo};
use chip::{look_at, missing, node};
pub(super) use chip::{may_sleep, number_behind, scan, vacant};
pub(super) use refusal::not_permitted;
pub use refusal::{BIAS_SINCE, EDGES_SINCE, Opener, is_before};
use refusal::{Subject, cannot_open, errno};
pub(super) use registers::FastChips;
pub use registers::{ChipRegisters, FastGpio, LINK_REMEDY, never_sleeps};
use registers::{LineRegisters, RegisterBank};

/// The name that the kernel shows as the consumer of our lines.
const CONSUMER: &str = "pinion";
/// GPIOHANDLE_REQUEST_BIAS_PULL_UP and _DOWN (Linux 5.5), which gpio-cdev does not name.
const PULL_UP: LineRequestFlags = LineRequestFlags::from_bits_retain(1 << 5);
const PULL_DOWN: LineRequestFlags = LineRequestFlags::from_bits_retain(1 << 6);
/// In [`HeldLine::flags`], next to the kernel's: the line's registers may be used.
const FAST: u32 = 1 << 31;
/// The flags that decide if a line is written through registers. The kernel turns an open drain with each level. User
/// space cannot: ten lines share a direction's register.
const FAST_MASK: u32 = FAST | LineRequestFlags::OUTPUT.bits() | LineRequestFlags::OPEN_DRAIN.bits();
const FAST_OUTPUT: u32 = FAST | LineRequestFlags::OUTPUT.bits();
/// The beginnings of the labels of chips without certain resistors, and the resistors that these chips lack.
const WITHOUT_BIAS: [(&str, &[Bias]); 4] = [
    ("raspberrypi-exp-gpio", &[Bias::PullUp, Bias::PullDown]),
    ("brcmvirt-gpio", &[Bias::PullUp, Bias::PullDown]),
    ("pcf857", &[Bias::PullUp, Bias::PullDown]),
    ("mcp23", &[Bias::PullDown]),
];

/// A line of an open chip, not yet requested.
pub(super) struct Handle {
    line: gpio_cdev::Line,
    subject: Subject,
}

/// Opens `/dev/gpiochip<number>` and picks a line.
///
/// # Errors
///
/// "GPIO chip device not found", "Unable to open GPIO chip device"; `refused` if the chip does not have this line.
pub(super) fn open(dev: &Path, number: u32, offset: u32, refused: ShutdownReason) -> Result<Handle, Shutdown> {
    let path = node(dev, number);
    let mut chip = gpio_cdev::Chip::new(&path).map_err(|error| match errno(&error) {
        libc::ENOENT => Shutdown::because(reason::CHIP_MISSING, missing(&path, &scan(dev, Path::new(GPIO)).0)),
        code => Shutdown::because(reason::CHIP_OPEN, cannot_open(&path, code)),
    })?;
    let subject = Subject { chip: chip.name().to_owned(), label: chip.label().to_owned(), offset, name: None };
    let lines = chip.num_lines();
    let line = chip.get_line(offset).map_err(|_| Shutdown::because(refused, subject.beyond(lines)))?;
    let name = look_at(&line).name;
    Ok(Handle { line, subject: Subject { name, ..subject } })
}

impl Handle {
    /// The kernel's name for the chip, such as `gpiochip0`, even if a link to it was opened.
    pub(super) fn chip(&self) -> &str {
        &self.subject.chip
    }

    /// The chip's label, such as `pinctrl-bcm2835`.
    pub(super) fn label(&self) -> &str {
        &self.subject.label
    }

    /// Requests the line from the kernel, and gives an output to the guardian. `sleeping` is the name of the line's
    /// chip, if calls to this chip may block.
    ///
    /// # Errors
    ///
    /// "Unable to open out GPIO chip line", "Unable to open in GPIO chip line", "Guardian process
    /// lost".
    pub(super) fn request(
        self,
        direction: Direction,
        guard: SharedGuard,
        sleeping: Option<String>,
    ) -> Result<HeldLine, Shutdown> {
        let LineSetup { flags, level, refused } = self.subject.setting(direction)?;
        let bits = flags.bits();
        let handle = self
            .line
            .request(flags, level.into(), CONSUMER)
            .map_err(|error| self.subject.refused(refused, errno(&error), direction, &self.line))?;
        let Handle { line, subject } = self;
        let guarded = GuardedLine::new(guard, format!("{} line {}", subject.chip, subject.offset), sleeping);
        // Without the guardian's copy the line is released here.
        guarded.hold(handle.as_raw_fd(), direction.shutdown_value())?;
        Ok(HeldLine { handle, line, subject, flags: AtomicU32::new(bits), registers: None, guarded })
    }
}

/// The settings for a request to the kernel.
struct LineSetup {
    flags: LineRequestFlags,
    level: bool,
    /// The shutdown reason if the kernel refuses.
    refused: ShutdownReason,
}

/// A line that we have requested.
pub(super) struct HeldLine {
    handle: LineHandle,
    line: gpio_cdev::Line,
    subject: Subject,
    /// The flags of the last setup (`GPIOHANDLE_REQUEST_`), and [`FAST`].
    flags: AtomicU32,
    registers: Option<(LineRegisters, &'static RegisterBank)>,
    guarded: GuardedLine,
}

impl HeldLine {
    /// The error for a call to the chip that failed with the error number `code`.
    #[cold]
    #[inline(never)]
    fn lost(&self, reason: ShutdownReason, what: &str, code: i32) -> Shutdown {
        Shutdown::because(reason, self.subject.lost(what, code, self.guarded.may_sleep()))
    }

    /// Writes a line of a chip that may block. It is apart, so that the core's writes need not save its registers.
    #[inline(never)]
    fn write_checked(&self, flags: u32, level: bool) -> Result<(), Shutdown> {
        let written = sys::set_line_checked(&self.handle, flags, level);
        written.map_err(|error| self.lost(reason::LINE_WRITE, "written", error.raw_os_error().unwrap_or_default()))
    }

    /// Lets the line go. Until it is held again, writes and reads of it fail.
    fn let_go(&self) -> io::Result<()> {
        let null = fs::File::open("/dev/null")?;
        self.flags.store(LineRequestFlags::OUTPUT.bits(), Ordering::Relaxed);
        sys::replace(&self.handle, &null)
    }

    /// Uses these registers from now on. The line has just been requested with `direction`.
    ///
    /// # Errors
    ///
    /// The registers and the kernel differ about the line. The line stays as it is.
    fn trust(
        &mut self,
        registers: LineRegisters,
        bank: &'static RegisterBank,
        direction: Direction,
    ) -> Result<(), &'static str> {
        let output = match direction {
            Direction::Output { level, .. } => Some(level),
            // The kernel makes an input of an open drain that is released.
            Direction::Input(_) | Direction::OpenDrain => None,
        };
        registers.check(output, || self.handle.get_value().map(|value| value != 0).map_err(io::Error::other))?;
        *self.flags.get_mut() |= FAST;
        self.registers = Some((registers, bank));
        Ok(())
    }

    /// The line's registers while `flags`, its own, let them be used.
    #[inline]
    fn registers(&self, flags: u32) -> Option<&LineRegisters> {
        self.registers.as_ref().filter(|_| flags & FAST != 0).map(|(registers, _)| registers)
    }

    /// [`FAST`], if the line has registers and they say that it has this direction now.
    fn fast_after(&self, setup: &LineSetup) -> u32 {
        let flags = &setup.flags;
        let output = flags.contains(LineRequestFlags::OUTPUT) && !flags.contains(LineRequestFlags::OPEN_DRAIN);
        if self.registers.as_ref().is_some_and(|(registers, _)| registers.is(output)) { FAST } else { 0 }
    }

    /// Releases the line and requests it again, because Linux before 5.5 cannot change a held line. Klipper's C program
    /// always does this. If the request is refused, the line stays what it was.
    fn request_anew(&self, setup: &LineSetup) -> Result<i32, Shutdown> {
        let before = LineRequestFlags::from_bits_retain(self.flags.load(Ordering::Relaxed) & !FAST);
        let level = self.handle.get_value().unwrap_or_default();
        // The kernel keeps a line as long as anybody has a copy.
        self.guarded.hold(self.handle.as_raw_fd(), None)?;
        let request = |flags: LineRequestFlags, level| {
            let bits = flags.bits();
            match self.line.request(flags, level, CONSUMER) {
                Ok(handle) => sys::replace(&self.handle, &handle).map_or_else(code_of, |()| {
                    self.flags.store(bits, Ordering::Relaxed);
                    0
                }),
                Err(error) => errno(&error),
            }
        };
        let refused = self.let_go().map_or_else(code_of, |()| request(setup.flags.clone(), setup.level.into()));
        if refused != 0 {
            request(before, level);
        }
        Ok(refused)
    }
}

fn code_of(error: io::Error) -> i32 {
    error.raw_os_error().unwrap_or(libc::EIO)
}

impl Line for HeldLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        let flags = self.flags.load(Ordering::Relaxed);
        if flags & LineRequestFlags::OUTPUT.bits() == 0 {
            return Ok(());
        }
        if let (FAST_OUTPUT, Some((registers, _))) = (flags & FAST_MASK, &self.registers) {
            registers.write(level);
            return Ok(());
        }
        if self.guarded.may_sleep() {
            return self.write_checked(flags, level);
        }
        let written = sys::set_line(&self.handle, level);
        written.map_err(|error| self.lost(reason::LINE_WRITE, "written", code_of(error)))
    }

    fn read(&self) -> Result<bool, Shutdown> {
        if let Some(registers) = self.registers(self.flags.load(Ordering::Relaxed)) {
            return Ok(registers.read());
        }
        match self.handle.get_value() {
            Ok(value) => Ok(value != 0),
            Err(error) => Err(self.lost(reason::LINE_READ, "read", errno(&error))),
        }
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let line = self.handle.as_raw_fd();
        // (If even this fails, the MCU stops because of what failed before.)
        let let_go = || drop(self.let_go());
        self.guarded.set_up(line, direction.shutdown_value(), || self.turn(direction), let_go)
    }

    fn is_fast(&self) -> bool {
        self.registers(self.flags.load(Ordering::Relaxed)).is_some()
    }

    fn flush(&self) {
        if let Some(registers) = self.registers(self.flags.load(Ordering::Relaxed)) {
            registers.flush();
        }
    }

    fn is_posted(&self) -> bool {
        self.registers.as_ref().is_some_and(|(registers, _)| registers.is_posted())
    }

    fn bank(&self) -> Option<(&'static dyn Bank, u32)> {
        match (self.flags.load(Ordering::Relaxed) & FAST_MASK, &self.registers) {
            (FAST_OUTPUT, Some((registers, bank))) => Some((*bank, registers.mask())),
            _ => None,
        }
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        let setup = self.subject.setting(direction)?;
        let code = match sys::set_line_config(&self.handle, setup.flags.bits(), setup.level).map_err(code_of) {
            Ok(()) => 0,
            Err(libc::EINVAL | libc::ENOTTY) => self.request_anew(&setup)?,
            Err(code) => code,
        };
        if code != 0 {
            return Err(self.subject.refused(setup.refused, code, direction, &self.line));
        }
        self.flags.store(setup.flags.bits() | self.fast_after(&setup), Ordering::Relaxed);
        Ok(())
    }
}

impl Subject {
    fn setting(&self, direction: Direction) -> Result<LineSetup, Shutdown> {
        match direction {
            Direction::Output { level, .. } => {
                Ok(LineSetup { flags: LineRequestFlags::OUTPUT, level, refused: reason::OUTPUT_LINE })
            }
            // The kernel never drives it high. If the chip has no open drain, the kernel makes the line an input
            // instead.
            Direction::OpenDrain => {
                let pull = if lacks(&self.label, Bias::PullUp) { LineRequestFlags::empty() } else { PULL_UP };
                let flags = LineRequestFlags::OUTPUT | LineRequestFlags::OPEN_DRAIN | pull;
                Ok(LineSetup { flags, level: true, refused: reason::OUTPUT_LINE })
            }
            Direction::Input(bias) if lacks(&self.label, bias) => {
                Err(Shutdown::because(reason::INPUT_LINE, self.no_bias(bias)))
            }
            Direction::Input(bias) => {
                let pull = match bias {
                    Bias::None => LineRequestFlags::empty(),
                    Bias::PullUp => PULL_UP,
                    Bias::PullDown => PULL_DOWN,
                };
                Ok(LineSetup { flags: LineRequestFlags::INPUT | pull, level: false, refused: reason::INPUT_LINE })
            }
        }
    }

    /// The error for a line that the kernel refused with the error number `code`.
    fn refused(&self, reason: ShutdownReason, code: i32, direction: Direction, line: &gpio_cdev::Line) -> Shutdown {
        let release = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
        let (action, bias) = match direction {
            Direction::Output { .. } => ("an output", Bias::None),
            Direction::Input(bias) => ("an input", bias),
            Direction::OpenDrain => ("an open drain", Bias::PullUp),
        };
        Shutdown::because(reason, self.refusal(action, code, bias, look_at(line).consumer.as_deref(), &release))
    }
}

/// Whether the chip with this label is known to lack this resistor.
fn lacks(label: &str, bias: Bias) -> bool {
    WITHOUT_BIAS.iter().any(|(chip, lacking)| label.starts_with(chip) && lacking.contains(&bias))
}

#[cfg(test)]
mod tests {
    use super::chip::nodes;
    use super::*;

    #[test]
    fn chips_known_to_ignore_a_resistor() {
        assert!(lacks("raspberrypi-exp-gpio", Bias::PullUp));
        assert!(lacks("mcp23017", Bias::PullDown));
        assert!(!lacks("mcp23017", Bias::PullUp));
        assert!(!lacks("raspberrypi-exp-gpio", Bias::None));
        assert!(!lacks("pinctrl-bcm2835", Bias::PullDown));
    }

    #[test]
    fn a_missing_chip_is_distinguished_from_one_that_is_none() {
        let dev = tempfile::tempdir().unwrap();
        let open = |chip| open(dev.path(), chip, 0, reason::NOT_OUTPUT).err().unwrap();
        assert_eq!(open(3).reason, reason::CHIP_MISSING);
        fs::write(dev.path().join("gpiochip3"), "").unwrap();
        let none = open(3);
        assert_eq!(none.reason, reason::CHIP_OPEN);
        assert!(none.to_string().contains("is not a GPIO chip"), "{none}");
        assert_eq!(nodes(dev.path()), [3]);
        let (chips, problems) = scan(dev.path(), dev.path());
        assert!(chips.is_empty());
        assert_eq!(problems.len(), 1);
    }
}
