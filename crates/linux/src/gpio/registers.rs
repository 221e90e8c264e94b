// SPDX-License-Identifier: GPL-3.0-or-later
//! The registers of a Raspberry Pi's GPIO chip. A store to them is an edge in some 20 ns. An ioctl takes 1 to 2 us.
//!
//! A line is still claimed through the character device, and only the kernel changes its direction. Registers write and
//! read the level of a claimed line. They are used after a check ([`LineRegisters::check`]): what they say about the
//! line must be what the kernel says.
//!
//! The RP1 of a Raspberry Pi 5 is behind PCIe, which takes a store and delivers it later. If the link sleeps, that may be
//! microseconds later, and several stores come together (raspberrypi/linux pull request 6279). So its registers are used
//! only if the kernel never lets the link sleep, and each edge with a time is read back ([`RegisterBank::flush`]).
//!
//! The device tree names the chip. A chip that is not listed here has no registers.

#![forbid(unsafe_code)]

use std::collections::HashMap;
use std::fs::{self, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::str::FromStr;

use super::HeldLine;
use super::refusal::{Subject, not_permitted};
use crate::{ASPM_POLICY, LOOK_AT_LOG, sys};
use pinion_firmware::board::{Bank, Direction};
use pinion_firmware::trouble::Trouble;

/// When lines are written and read through registers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FastGpio {
    /// Never.
    Off,
    /// On chips whose registers are tested, if it is possible.
    #[default]
    Auto,
    /// On every chip that has known registers. If it is not possible, that is a warning.
    On,
    /// The same, through `/dev/mem`.
    DevMem,
}

impl FastGpio {
    /// The words for it on the command line, in this order.
    pub const WORDS: [&str; 4] = ["off", "auto", "on", DEV_MEM];
}

impl FromStr for FastGpio {
    type Err = String;

    fn from_str(text: &str) -> Result<FastGpio, String> {
        match text {
            "off" => Ok(FastGpio::Off),
            "auto" => Ok(FastGpio::Auto),
            "on" => Ok(FastGpio::On),
            DEV_MEM => Ok(FastGpio::DevMem),
            _ => Err(format!("there are {}", FastGpio::WORDS.join(", "))),
        }
    }
}

const DEV_MEM: &str = "/dev/mem";
/// Highest number of comparisons of a level with the kernel's. A level may change between two reads.
const LOOKS_MAX: u32 = 100;

/// The arrangement of a chip's registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Layout {
    /// BCM2835 to BCM2711, in every Raspberry Pi before the 5: "BCM2835 ARM Peripherals", section 6.1, and
    /// drivers/pinctrl/bcm/pinctrl-bcm2835.c (GPFSEL0, GPSET0, GPCLR0, GPLEV0). Each line has 3 bits in a function
    /// select register of ten lines. The other registers have 32 lines each.
    Bcm2835,
    /// RP1, in the Raspberry Pi 5: "RP1 Peripherals", section 3.1, and drivers/pinctrl/pinctrl-rp1.c of the Raspberry
    /// Pi's kernel (`rp1_iobanks`, RP1_GPIO_CTRL, RP1_RIO_*, RP1_SET_OFFSET, RP1_CLR_OFFSET). Its gpiomem0 is io_bank,
    /// sys_rio and pads, one after the other.
    Rp1,
}

impl Layout {
    /// The layout of a chip with this `compatible` property of the device tree: strings that each end in a zero.
    fn of(compatible: &[u8]) -> Option<Layout> {
        compatible.split(|byte| *byte == 0).find_map(|name| match name {
            b"brcm,bcm2835-gpio" | b"brcm,bcm2711-gpio" => Some(Layout::Bcm2835),
            b"raspberrypi,rp1-gpio" => Some(Layout::Rp1),
            _ => None,
        })
    }

    /// The node whose driver maps the registers, and their length in bytes. The driver is bcm2835-gpiomem.c, or
    /// raspberrypi-gpiomem.c on newer kernels. Both are only in the Raspberry Pi's own kernel.
    fn node(self) -> (&'static str, usize) {
        match self {
            Layout::Bcm2835 => ("gpiomem", 0x1000),
            Layout::Rp1 => ("gpiomem0", 0x30000),
        }
    }

    /// Whether the chip is behind a bus that holds stores back.
    fn is_posted(self) -> bool {
        self == Layout::Rp1
    }

    /// Whether an emulated computer has tested it (tests/raspberry_pi). No emulator has an RP1.
    fn is_tested(self) -> bool {
        self == Layout::Bcm2835
    }

    /// The registers of line `offset`. `at` has the register at an offset in bytes. `None` if there is no such line.
    fn line<R: Register>(self, offset: u32, at: impl Fn(usize) -> Option<R>) -> Option<LineRegisters<R>> {
        match self {
            Layout::Bcm2835 => {
                let word = |first: usize, of: u32| at(first + 4 * (offset / of) as usize);
                let shift = offset % 10 * 3;
                let function =
                    Field { register: word(0x00, 10)?, mask: 7 << shift, input: 0 << shift, output: 1 << shift };
                (offset < 58).then_some(())?;
                Some(LineRegisters {
                    mask: 1 << (offset % 32),
                    bank: RegisterBank { set: word(0x1c, 32)?, clear: word(0x28, 32)?, posted: None },
                    level: word(0x34, 32)?,
                    direction: vec![function],
                })
            }
            Layout::Rp1 => {
                let (bank, bit) = match offset {
                    0..28 => (0, offset),
                    28..34 => (1, offset - 28),
                    34..54 => (2, offset - 34),
                    _ => return None,
                };
                let mask = 1 << bit;
                let io = |register: usize| at(0x4000 * bank + register);
                let rio = |register: usize| at(0x10000 + 0x4000 * bank + register);
                // CTRL: FUNCSEL is 5 if RIO drives the line. OUTOVER and OEOVER must be 0: they override RIO.
                let control = Field { register: io(8 * bit as usize + 4)?, mask: 0xf01f, input: 5, output: 5 };
                let enable = Field { register: rio(0x04)?, mask, input: 0, output: mask };
                Some(LineRegisters {
                    mask,
                    // RIO_OUT, by the addresses that set and clear bits, and RIO_IN.
                    bank: RegisterBank { set: rio(0x2000)?, clear: rio(0x3000)?, posted: Some(rio(0x08)?) },
                    level: rio(0x08)?,
                    direction: vec![control, enable],
                })
            }
        }
    }
}

/// A 32-bit register.
pub(super) trait Register: Copy {
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
struct Field<R> {
    register: R,
    mask: u32,
    input: u32,
    output: u32,
}

/// The registers that drive the lines of a bank.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct RegisterBank<R = sys::Register> {
    /// A 1 makes its line high. A 0 changes nothing.
    set: R,
    /// A 1 makes its line low. A 0 changes nothing.
    clear: R,
    /// A register to read back, if the bus holds stores back. A load does not overtake them.
    posted: Option<R>,
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
pub(super) struct LineRegisters<R = sys::Register> {
    /// The line's bit in the registers of its bank, and in `level`.
    mask: u32,
    bank: RegisterBank<R>,
    level: R,
    direction: Vec<Field<R>>,
}

impl<R: Register> LineRegisters<R> {
    /// The line's bit in its bank.
    pub(super) fn mask(&self) -> u32 {
        self.mask
    }

    /// Drives the line, if it is an output. Otherwise this is its level when it becomes one.
    #[inline]
    pub(super) fn write(&self, level: bool) {
        if level { self.bank.set.store(self.mask) } else { self.bank.clear.store(self.mask) }
    }

    /// Whether a bus holds stores back on their way to the line.
    pub(super) fn is_posted(&self) -> bool {
        self.bank.posted.is_some()
    }

    /// Returns when the last store has reached the line.
    #[inline]
    pub(super) fn flush(&self)
    where
        R: Sync,
    {
        self.bank.flush();
    }

    /// The line's level, whoever drives it.
    #[inline]
    pub(super) fn read(&self) -> bool {
        self.level.load() & self.mask != 0
    }

    /// Whether the chip itself has the line as an output, or else as an input.
    pub(super) fn is(&self, output: bool) -> bool {
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
    pub(super) fn check(
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

/// The mapped registers of a chip.
pub struct ChipRegisters {
    layout: Layout,
    mapped: sys::Registers,
    /// The node that they are mapped from.
    node: String,
    /// The banks whose lines are in use. They stay as long as the mapping: until the program ends.
    banks: Vec<&'static RegisterBank>,
}

impl ChipRegisters {
    /// Maps the registers of a chip such as `gpiochip0`.
    ///
    /// # Errors
    ///
    /// Why it is not possible, and what to do.
    pub(super) fn open(places: &Places, chip: &str, wish: FastGpio) -> Result<ChipRegisters, Trouble> {
        let Places { dev, devices, aspm_policy } = *places;
        let unknown = || Trouble::new("no registers of this chip are known").remedy("--fast-gpio off hides this line");
        let device = devices.join(chip).canonicalize().map_err(|_| unknown())?;
        // The chip's own link to the device tree. Older kernels have only that of its device.
        let tree = [Some(device.as_path()), device.parent()].into_iter().flatten().map(|place| place.join("of_node"));
        let layout = tree.into_iter().find_map(|node| Layout::of(&fs::read(node.join("compatible")).ok()?));
        let layout = layout.ok_or_else(unknown)?;
        if wish == FastGpio::Auto && !layout.is_tested() {
            return Err(Trouble::new("nobody has tested the registers of an RP1 with Pinion yet")
                .remedy("try --fast-gpio on, and tell the project what pinion latency --pin says"));
        }
        let (name, bytes) = layout.node();
        let (node, start) = match wish {
            FastGpio::DevMem if layout == Layout::Rp1 => {
                return Err(Trouble::new("/dev/mem is not for an RP1").remedy("choose --fast-gpio on"));
            }
            _ if layout.is_posted() && !never_sleeps(aspm_policy) => return Err(may_sleep(aspm_policy)),
            FastGpio::DevMem => (dev.join("mem"), physical_address(&device).ok_or_else(unknown)?),
            _ => (dev.join(name), 0),
        };
        // O_SYNC: the kernel then maps /dev/mem without a cache, whatever it takes the memory for.
        let file = OpenOptions::new().read(true).write(true).custom_flags(libc::O_SYNC).open(&node);
        let mapped = file.and_then(|file| sys::Registers::map(&file, start, bytes));
        let mapped = mapped.map_err(|error| refused(&node, wish, &error))?;
        Ok(ChipRegisters { layout, mapped, node: node.display().to_string(), banks: Vec::new() })
    }

    /// The node that they are mapped from, such as `/dev/gpiomem`.
    pub fn node(&self) -> &str {
        &self.node
    }

    /// Whether the chip is behind a bus that holds stores back. Its lines are not for pulses with a meaning of their
    /// width, as LEDs need them.
    pub fn is_posted(&self) -> bool {
        self.layout.is_posted()
    }

    /// The registers of one line.
    fn line(&self, offset: u32) -> Option<LineRegisters> {
        self.layout.line(offset, |at| self.mapped.at(at))
    }

    /// The bank of a line. The lines of one bank get the same.
    fn bank(&mut self, line: &LineRegisters) -> &'static RegisterBank {
        if let Some(bank) = self.banks.iter().find(|bank| ***bank == line.bank) {
            return bank;
        }
        let bank: &'static RegisterBank = Box::leak(Box::new(line.bank));
        self.banks.push(bank);
        bank
    }
}

/// The parts of a computer that are needed to find registers.
pub(super) struct Places<'a> {
    /// `/dev`
    pub(super) dev: &'a Path,
    /// `/sys/bus/gpio/devices`
    pub(super) devices: &'a Path,
    /// `/sys/module/pcie_aspm/parameters/policy`
    pub(super) aspm_policy: &'a Path,
}

/// Whether the kernel never lets a PCIe link sleep. The file lists the policies, with the chosen one in brackets
/// (drivers/pci/pcie/aspm.c, `pcie_aspm_get_policy`).
pub fn never_sleeps(aspm_policy: &Path) -> bool {
    fs::read_to_string(aspm_policy)
        .is_ok_and(|policies| policies.split_whitespace().any(|name| name == "[performance]"))
}

/// The remedy for a link that may sleep. `pcie_aspm=off` leaves each link as the firmware has set it.
pub const LINK_REMEDY: &str =
    "write pcie_aspm.policy=performance, and not pcie_aspm=off, into /boot/firmware/cmdline.txt, and reboot";

fn may_sleep(aspm_policy: &Path) -> Trouble {
    let chosen = fs::read_to_string(aspm_policy).unwrap_or_else(|error| error.to_string());
    Trouble::new(format!("the PCIe link of the RP1 may sleep, which delays edges ({})", chosen.trim()))
        .of(aspm_policy.display())
        .remedy(LINK_REMEDY)
}

/// Why a node cannot be opened or mapped.
fn refused(node: &Path, wish: FastGpio, error: &io::Error) -> Trouble {
    let remedy = match (wish, error.raw_os_error()) {
        (FastGpio::DevMem, _) => "run Pinion as root, on a kernel with iomem=relaxed on its command line",
        (_, Some(code @ (libc::EACCES | libc::EPERM))) => return not_permitted(node, code),
        (_, Some(libc::ENOENT)) => "only Raspberry Pi's own kernel has this node: install it",
        _ => LOOK_AT_LOG,
    };
    Trouble::new(error.to_string()).of(node.display()).remedy(remedy)
}

/// The physical address of a chip's registers. `device` is the chip below `/sys/devices`. The kernel names a device of
/// the device tree by the address that it has found for it, as in `3f200000.gpio` (of_device_make_bus_id in
/// drivers/of/platform.c). The address in `reg` is that of the bus: its last 24 bits are the same.
fn physical_address(device: &Path) -> Option<u64> {
    let parent = device.parent()?;
    let (address, _) = parent.file_name()?.to_str()?.split_once('.')?;
    let address = u64::from_str_radix(address, 16).ok()?;
    let reg = fs::read(parent.join("of_node/reg")).ok()?;
    let last = |address: u64| address & 0xff_ffff;
    let named = reg
        .chunks_exact(4)
        .take(2)
        .any(|cell| cell.try_into().is_ok_and(|cell| last(u32::from_be_bytes(cell).into()) == last(address)));
    (named && last(address) != 0).then_some(address)
}

/// The registers of the chips in use. Each chip is looked at once, and has at most two lines in the log.
#[derive(Default)]
pub(crate) struct FastChips {
    wish: FastGpio,
    chips: HashMap<String, Option<ChipRegisters>>,
}

impl FastChips {
    pub(crate) fn new(wish: FastGpio) -> FastChips {
        FastChips { wish, chips: HashMap::new() }
    }

    /// Gives a line of a chip that never sleeps its registers, if it may use them. The line has just been requested.
    pub(crate) fn equip(&mut self, line: &mut HeldLine, direction: Direction, dev: &Path, devices: &Path) {
        let places = Places { dev, devices, aspm_policy: Path::new(ASPM_POLICY) };
        let Subject { chip, offset, .. } = &line.subject;
        let (chip, offset) = (chip.clone(), *offset);
        let Some(registers) = self.of(&places, &chip) else { return };
        let Some(line_registers) = registers.line(offset) else { return };
        let bank = registers.bank(&line_registers);
        if let Err(why) = line.trust(line_registers, bank, direction) {
            self.distrust(&chip, offset, why);
        }
    }

    /// The registers of a chip. A chip without them is named in the log, with the reason.
    fn of(&mut self, places: &Places, chip: &str) -> Option<&mut ChipRegisters> {
        let wish = self.wish;
        if wish == FastGpio::Off {
            return None;
        }
        let opened =
            self.chips.entry(chip.to_owned()).or_insert_with(|| match ChipRegisters::open(places, chip, wish) {
                Ok(registers) => {
                    log::info!("{chip}: lines are written and read through {}", registers.node());
                    Some(registers)
                }
                Err(why) => {
                    log_slow(wish, chip, &why);
                    None
                }
            });
        opened.as_mut()
    }

    /// The registers of a chip cannot be trusted. The lines that were checked already keep theirs.
    fn distrust(&mut self, chip: &str, offset: u32, why: &str) {
        self.chips.insert(chip.to_owned(), None);
        let why = Trouble::new(why).of(format_args!("line {offset}")).remedy("report this to the project");
        log_slow(self.wish, chip, &why);
    }
}

fn log_slow(wish: FastGpio, chip: &str, why: &Trouble) {
    let level = if wish == FastGpio::Auto { log::Level::Info } else { log::Level::Warn };
    log::log!(level, "{chip}: lines are written through the kernel, not through registers: {why}");
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::cell::Cell;
    use std::os::unix::fs::symlink;
    use std::path::PathBuf;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicU32, Ordering::SeqCst};
    use std::thread;

    /// A chip as its data sheet has it, with the world outside its pins.
    struct Model {
        layout: Layout,
        /// Each word of the block. A register that sets or clears bits has none of its own.
        words: Vec<AtomicU32>,
        /// Levels from outside, by the bank of the level registers. They count where the chip drives nothing.
        outside: [AtomicU32; 3],
        /// As the kernel's driver has one for the directions.
        lock: Mutex<()>,
        /// The register that was read last.
        last_load: AtomicU32,
    }

    #[derive(Clone, Copy)]
    struct ModelRegister<'a>(&'a Model, usize);

    impl PartialEq for ModelRegister<'_> {
        fn eq(&self, other: &Self) -> bool {
            self.1 == other.1
        }
    }

    impl Register for ModelRegister<'_> {
        fn load(self) -> u32 {
            self.0.last_load.store(self.1 as u32, SeqCst);
            self.0.load(self.1)
        }

        fn store(self, value: u32) {
            self.0.store(self.1, value);
        }

        fn wait() {
            WAITS.set(WAITS.get() + 1);
        }
    }

    thread_local! {
        /// How often this thread has waited until its stores and loads had reached their device.
        static WAITS: Cell<u32> = const { Cell::new(0) };
    }

    impl Model {
        fn new(layout: Layout) -> Model {
            let words = (0..layout.node().1 / 4).map(|_| AtomicU32::new(0)).collect();
            Model { layout, words, outside: Default::default(), lock: Mutex::new(()), last_load: AtomicU32::new(0) }
        }

        fn line(&self, offset: u32) -> LineRegisters<ModelRegister<'_>> {
            self.layout.line(offset, |at| self.at(at)).expect("a line")
        }

        fn at(&self, at: usize) -> Option<ModelRegister<'_>> {
            (at.is_multiple_of(4) && at < self.layout.node().1).then_some(ModelRegister(self, at))
        }

        fn word(&self, at: usize) -> &AtomicU32 {
            &self.words[at / 4]
        }

        fn load(&self, at: usize) -> u32 {
            match (self.layout, at) {
                (Layout::Bcm2835, 0x34 | 0x38) => {
                    let bank = (at - 0x34) / 4;
                    let drives = (0..32).filter(|bit| {
                        let line = 32 * bank + bit;
                        self.word(line / 10 * 4).load(SeqCst) >> (line % 10 * 3) & 7 == 1
                    });
                    let drives = drives.fold(0, |mask, bit| mask | 1 << bit);
                    self.word(0x1c + 4 * bank).load(SeqCst) & drives | self.outside[bank].load(SeqCst) & !drives
                }
                // "Write only": the data sheet promises nothing for reading.
                (Layout::Bcm2835, 0x1c | 0x20 | 0x28 | 0x2c) => 0xdead_beef,
                (Layout::Rp1, 0x10000..0x1c000) if at % 0x4000 == 8 => {
                    let bank = (at - 0x10000) / 0x4000;
                    let (out, enable) = (self.word(at - 8).load(SeqCst), self.word(at - 4).load(SeqCst));
                    out & enable | self.outside[bank].load(SeqCst) & !enable
                }
                _ => self.word(at).load(SeqCst),
            }
        }

        fn store(&self, at: usize, value: u32) {
            match (self.layout, at) {
                (Layout::Bcm2835, 0x1c | 0x20) => drop(self.word(at).fetch_or(value, SeqCst)),
                (Layout::Bcm2835, 0x28 | 0x2c) => drop(self.word(at - 0xc).fetch_and(!value, SeqCst)),
                (Layout::Bcm2835, 0x34 | 0x38) => (),
                (Layout::Rp1, 0x10000..0x1c000) => match at % 0x4000 {
                    alias @ 0x1000..0x2000 => drop(self.word(at - alias + alias % 0x1000).fetch_xor(value, SeqCst)),
                    alias @ 0x2000..0x3000 => drop(self.word(at - alias + alias % 0x1000).fetch_or(value, SeqCst)),
                    alias @ 0x3000.. => drop(self.word(at - alias + alias % 0x1000).fetch_and(!value, SeqCst)),
                    _ => self.word(at).store(value, SeqCst),
                },
                _ => self.word(at).store(value, SeqCst),
            }
        }

        /// As the driver's `direction_output` and `direction_input`.
        fn kernel_turns(&self, line: u32, output: Option<bool>) {
            if let Some(level) = output {
                self.kernel_sets(line, level);
            }
            let _lock = self.lock.lock().unwrap();
            for Field { register, mask, input, output: out } in self.line(line).direction {
                let value = if output.is_some() { out } else { input };
                register.store(register.load() & !mask | value);
            }
        }

        /// As the driver's `set`: by the addresses in the driver, written out.
        fn kernel_sets(&self, line: u32, level: bool) {
            let (at, bit) = match (self.layout, line) {
                (Layout::Bcm2835, _) => ((if level { 0x1c } else { 0x28 }) + line / 32 * 4, line % 32),
                (Layout::Rp1, 0..28) => (0x12000 + 0x1000 * u32::from(!level), line),
                (Layout::Rp1, 28..34) => (0x16000 + 0x1000 * u32::from(!level), line - 28),
                (Layout::Rp1, _) => (0x1a000 + 0x1000 * u32::from(!level), line - 34),
            };
            self.store(at as usize, 1 << bit);
        }

        /// The level of the pin, as a meter shows it.
        fn kernel_gets(&self, line: u32) -> bool {
            let (at, bit) = match (self.layout, line) {
                (Layout::Bcm2835, _) => (0x34 + line / 32 * 4, line % 32),
                (Layout::Rp1, 0..28) => (0x10008, line),
                (Layout::Rp1, 28..34) => (0x14008, line - 28),
                (Layout::Rp1, _) => (0x18008, line - 34),
            };
            self.load(at as usize) >> bit & 1 != 0
        }

        fn drive(&self, line: u32, level: bool) {
            let (bank, bit) = match (self.layout, line) {
                (Layout::Bcm2835, _) => (line / 32, line % 32),
                (Layout::Rp1, 0..28) => (0, line),
                (Layout::Rp1, 28..34) => (1, line - 28),
                (Layout::Rp1, _) => (2, line - 34),
            };
            let bank = &self.outside[bank as usize];
            if level {
                bank.fetch_or(1 << bit, SeqCst)
            } else {
                bank.fetch_and(!(1 << bit), SeqCst)
            };
        }
    }

    const LAYOUTS: [Layout; 2] = [Layout::Bcm2835, Layout::Rp1];
    const LINES: u32 = 54;

    #[test]
    fn a_line_is_written_and_read_and_no_other_line_changes() {
        for layout in LAYOUTS {
            let model = Model::new(layout);
            (0..LINES).for_each(|line| model.kernel_turns(line, Some(false)));
            for line in 0..LINES {
                let registers = model.line(line);
                assert!(registers.is(true) && !registers.is(false));
                registers.write(true);
                let high: Vec<u32> = (0..LINES).filter(|line| model.kernel_gets(*line)).collect();
                assert_eq!(high, [line], "{layout:?}");
                assert!(registers.read());
                registers.write(false);
                assert!(!registers.read() && !model.kernel_gets(line));
            }
        }
        let bcm2835 = Model::new(Layout::Bcm2835);
        assert!(Layout::Bcm2835.line(58, |at| bcm2835.at(at)).is_none());
        assert!(Layout::Rp1.line(54, |at| bcm2835.at(at)).is_none());
    }

    #[derive(Clone, Copy, Debug)]
    enum Op {
        Registers(u32, bool),
        /// One store for each level, if both lines are in one bank.
        Together([(u32, bool); 2]),
        Kernel(u32, bool),
        Output(u32, bool),
        Input(u32),
        Outside(u32, bool),
    }

    fn op() -> impl Strategy<Value = Op> {
        let line = 0..LINES;
        prop_oneof![
            4 => (line.clone(), any::<bool>()).prop_map(|(line, level)| Op::Registers(line, level)),
            4 => [(line.clone(), any::<bool>()), (line.clone(), any::<bool>())].prop_map(Op::Together),
            4 => (line.clone(), any::<bool>()).prop_map(|(line, level)| Op::Kernel(line, level)),
            1 => (line.clone(), any::<bool>()).prop_map(|(line, level)| Op::Output(line, level)),
            1 => line.clone().prop_map(Op::Input),
            1 => (line, any::<bool>()).prop_map(|(line, level)| Op::Outside(line, level)),
        ]
    }

    proptest! {
        #[test]
        fn a_line_is_as_the_last_one_said_whichever_way_it_was_said(
            layout in prop::sample::select(&LAYOUTS[..]),
            ops in prop::collection::vec(op(), 0..200),
        ) {
            let model = Model::new(layout);
            (0..LINES).for_each(|line| model.kernel_turns(line, None));
            // Whether it is an output, its set level, and the level outside.
            let mut lines = [(false, false, false); LINES as usize];
            for op in ops {
                match op {
                    Op::Registers(line, level) => { model.line(line).write(level); lines[line as usize].1 = level; }
                    Op::Together([(line, _), (other, _)])
                        if line == other || model.line(line).bank != model.line(other).bank => {}
                    Op::Together(edges) => {
                        let mask = |of| edges.iter().filter(|edge| edge.1 == of)
                            .fold(0, |mask, edge| mask | model.line(edge.0).mask());
                        model.line(edges[0].0).bank.change(mask(true), mask(false));
                        edges.iter().for_each(|(line, level)| lines[*line as usize].1 = *level);
                    }
                    Op::Kernel(line, level) => { model.kernel_sets(line, level); lines[line as usize].1 = level; }
                    Op::Output(line, level) => {
                        model.kernel_turns(line, Some(level));
                        let state = &mut lines[line as usize];
                        (state.0, state.1) = (true, level);
                    }
                    Op::Input(line) => { model.kernel_turns(line, None); lines[line as usize].0 = false; }
                    Op::Outside(line, level) => { model.drive(line, level); lines[line as usize].2 = level; }
                }
                for (line, (output, told, outside)) in (0..).zip(lines) {
                    let level = if output { told } else { outside };
                    prop_assert_eq!((model.line(line).read(), model.kernel_gets(line)), (level, level));
                    prop_assert!(model.line(line).is(output));
                }
            }
        }
    }

    #[test]
    fn two_threads_write_neighbours_of_one_bank_in_both_ways() {
        for layout in LAYOUTS {
            let model = &Model::new(layout);
            (16..19).for_each(|line| model.kernel_turns(line, Some(false)));
            thread::scope(|scope| {
                scope.spawn(move || {
                    let line = model.line(17);
                    for round in 0..20_000 {
                        line.write(round % 3 == 0);
                        assert_eq!(line.read(), round % 3 == 0, "the registers' line keeps what it was told");
                    }
                });
                scope.spawn(move || {
                    for round in 0..20_000 {
                        model.kernel_sets(18, round % 2 == 0);
                        assert_eq!(model.kernel_gets(18), round % 2 == 0, "and so does the kernel's");
                    }
                });
                // The driver turns a line of the same function register meanwhile.
                scope.spawn(move || {
                    (0..5_000).for_each(|_| {
                        model.kernel_turns(16, None);
                        model.kernel_turns(16, Some(true));
                    })
                });
            });
        }
    }

    #[test]
    fn a_store_behind_a_bus_that_holds_it_back_is_read_back() {
        for (layout, line, read_back) in [
            (Layout::Bcm2835, 17, None),
            (Layout::Rp1, 17, Some(0x10008)),
            (Layout::Rp1, 30, Some(0x14008)),
            (Layout::Rp1, 40, Some(0x18008)),
        ] {
            let model = Model::new(layout);
            let registers = model.line(line);
            assert_eq!(registers.is_posted(), read_back.is_some());
            registers.write(true);
            model.last_load.store(0, SeqCst);
            let waits = WAITS.get();
            registers.flush();
            assert_eq!(WAITS.get(), waits + 1, "a barrier is after the store and the load");
            assert_eq!(model.last_load.load(SeqCst), read_back.unwrap_or(0), "{layout:?} {line}");
        }
    }

    #[test]
    fn registers_that_agree_with_the_kernel_are_trusted() {
        for layout in LAYOUTS {
            let model = Model::new(layout);
            for (line, output) in [(17, Some(true)), (18, Some(false)), (33, None), (40, Some(true))] {
                model.kernel_turns(line, output);
                let before = model.words.iter().map(|word| word.load(SeqCst)).collect::<Vec<_>>();
                assert_eq!(model.line(line).check(output, || Ok(model.kernel_gets(line))), Ok(()), "{line}");
                let after = model.words.iter().map(|word| word.load(SeqCst)).collect::<Vec<_>>();
                assert_eq!(before, after, "the check changes nothing");
            }
        }
    }

    #[test]
    fn registers_of_another_line_or_function_are_not_trusted() {
        const DIRECTION: Result<(), &str> = Err("the direction in its registers is not the kernel's");
        const LEVEL: Result<(), &str> = Err("the level in its registers is not the kernel's");
        for layout in LAYOUTS {
            let model = Model::new(layout);
            model.kernel_turns(17, Some(true));
            model.kernel_turns(18, Some(false));
            model.kernel_turns(19, None);
            let kernel = |line| model.kernel_gets(line);
            assert_eq!(model.line(19).check(Some(true), || Ok(kernel(17))), DIRECTION);
            assert_eq!(model.line(17).check(None, || Ok(kernel(19))), DIRECTION);
            assert_eq!(model.line(18).check(Some(true), || Ok(kernel(17))), LEVEL);
            assert!(!kernel(18), "and nothing was written");
            assert_eq!(model.line(17).check(Some(true), || Err(io::Error::other("it is gone"))), LEVEL);
        }
        // RP1: another block drives the line, or an override does.
        let model = Model::new(Layout::Rp1);
        model.kernel_turns(17, Some(true));
        for control in [4, 0x1005, 0x4005] {
            model.store(17 * 8 + 4, control);
            assert_eq!(model.line(17).check(Some(true), || Ok(true)), DIRECTION);
        }
    }

    /// A level that changes between two looks is no reason to distrust them.
    #[test]
    fn an_input_may_change_during_the_check() {
        let model = Model::new(Layout::Bcm2835);
        model.kernel_turns(24, None);
        let looks = Cell::new(0);
        let kernel = || {
            looks.set(looks.get() + 1);
            model.drive(24, looks.get() % 2 == 1 || looks.get() > 10);
            Ok(model.kernel_gets(24))
        };
        assert_eq!(model.line(24).check(None, kernel), Ok(()));
        assert!(looks.get() > 10);
    }

    /// A made-up computer with one chip, and its `/dev` and `/sys/bus/gpio/devices`.
    struct Computer(tempfile::TempDir);

    impl Computer {
        fn new(compatible: &str) -> Computer {
            let computer = Computer(tempfile::tempdir().unwrap());
            let device = computer.0.path().join("soc/3f200000.gpio");
            fs::create_dir_all(device.join("gpiochip0")).unwrap();
            fs::create_dir_all(device.join("of_node")).unwrap();
            fs::write(device.join("of_node/compatible"), compatible).unwrap();
            fs::write(device.join("of_node/reg"), [0x7e, 0x20, 0, 0, 0, 0, 0, 0xb4]).unwrap();
            symlink("../of_node", device.join("gpiochip0/of_node")).unwrap();
            fs::create_dir_all(computer.0.path().join("devices")).unwrap();
            symlink(device.join("gpiochip0"), computer.0.path().join("devices/gpiochip0")).unwrap();
            computer.has_policy("default [performance] powersave powersupersave \n");
            computer
        }

        fn dev(&self, name: &str) -> PathBuf {
            self.0.path().join(name)
        }

        fn has_policy(&self, policies: &str) {
            fs::write(self.dev("policy"), policies).unwrap();
        }

        fn with_places<T>(&self, use_: impl FnOnce(&Places) -> T) -> T {
            let dev = self.0.path();
            use_(&Places { dev, devices: &dev.join("devices"), aspm_policy: &dev.join("policy") })
        }

        fn open(&self, wish: FastGpio) -> Result<ChipRegisters, String> {
            let dev = self.0.path();
            self.with_places(|places| ChipRegisters::open(places, "gpiochip0", wish))
                .map_err(|why| why.to_string().replace(&format!("{}/", dev.display()), "/dev/"))
        }
    }

    const PI3: &str = "brcm,bcm2835-gpio\0";
    const PI4: &str = "brcm,bcm2711-gpio\0brcm,bcm2835-gpio\0";
    const PI5: &str = "raspberrypi,rp1-gpio\0";

    #[test]
    fn the_device_tree_says_which_registers_there_are() {
        for (compatible, layout) in [
            (PI3, Some(Layout::Bcm2835)),
            (PI4, Some(Layout::Bcm2835)),
            (PI5, Some(Layout::Rp1)),
            ("brcm,bcm7445-gpio\0brcm,brcmstb-gpio\0", None),
            ("brcm,bcm2711-gpio\0", Some(Layout::Bcm2835)),
            ("raspberrypi,firmware-gpio\0", None),
            ("allwinner,sun50i-h616-pinctrl\0", None),
            ("rockchip,gpio-bank\0", None),
            ("brcm,bcm2835-gpio-and-more\0", None),
            ("", None),
        ] {
            assert_eq!(Layout::of(compatible.as_bytes()), layout, "{compatible}");
        }
    }

    #[test]
    fn each_reason_to_go_through_the_kernel_is_told_with_its_remedy() {
        let why = |compatible: &str, wish| Computer::new(compatible).open(wish).err().unwrap();
        assert_eq!(
            why("snps,dw-apb-gpio-port\0", FastGpio::On),
            "no registers of this chip are known: --fast-gpio off hides this line"
        );
        assert_eq!(
            why(PI3, FastGpio::Auto),
            "/dev/gpiomem: No such file or directory (os error 2): only Raspberry Pi's own kernel has this node: \
             install it"
        );
        assert_eq!(
            why(PI5, FastGpio::Auto),
            "nobody has tested the registers of an RP1 with Pinion yet: try --fast-gpio on, and tell the project what \
             pinion latency --pin says"
        );
        assert!(why(PI5, FastGpio::On).starts_with("/dev/gpiomem0: No such file"));
        assert_eq!(why(PI5, FastGpio::DevMem), "/dev/mem is not for an RP1: choose --fast-gpio on");
        let short = Computer::new(PI4);
        fs::write(short.dev("gpiomem"), [0; 100]).unwrap();
        let why = short.open(FastGpio::Auto).err().unwrap();
        assert_eq!(why, "/dev/gpiomem: it is too short: look at the kernel's log (dmesg)");
        let denied =
            |code, wish| refused(Path::new("/dev/gpiomem"), wish, &io::Error::from_raw_os_error(code)).to_string();
        assert!(denied(libc::EACCES, FastGpio::Auto).contains(" may not open /dev/gpiomem"));
        assert!(denied(libc::EPERM, FastGpio::On).contains("DeviceAllow=/dev/gpiomem rw"));
        assert!(denied(libc::EPERM, FastGpio::DevMem).contains("run Pinion as root"));
    }

    /// `pcie_aspm=off` leaves the links as the firmware has set them, and the policy is then `default`.
    #[test]
    fn an_rp1_needs_a_link_that_never_sleeps() {
        let computer = Computer::new(PI5);
        fs::File::create(computer.dev("gpiomem0")).unwrap().set_len(0x30000).unwrap();
        assert!(computer.open(FastGpio::On).unwrap().is_posted());
        for policies in ["[default] performance powersave powersupersave \n", "default performance [powersave]", ""] {
            computer.has_policy(policies);
            let why = computer.open(FastGpio::On).err().unwrap();
            let told = format!("may sleep, which delays edges ({})", policies.trim());
            assert!(why.contains(&told) && why.ends_with(LINK_REMEDY), "{why}");
        }
        fs::remove_file(computer.dev("policy")).unwrap();
        assert!(computer.open(FastGpio::On).err().unwrap().contains("No such file"));
        // The older chips are on the processor's own bus.
        let computer = Computer::new(PI4);
        computer.has_policy("[default] performance");
        fs::File::create(computer.dev("gpiomem")).unwrap().set_len(0x1000).unwrap();
        assert!(!computer.open(FastGpio::Auto).unwrap().is_posted());
    }

    #[test]
    fn the_node_of_the_chip_is_mapped_and_never_dev_mem_unless_it_is_named() {
        let computer = Computer::new(PI4);
        fs::write(computer.dev("mem"), "").unwrap();
        assert!(computer.open(FastGpio::Auto).err().unwrap().starts_with("/dev/gpiomem: "));
        assert!(computer.open(FastGpio::DevMem).err().unwrap().starts_with("/dev/mem: "));
        let node = fs::File::create(computer.dev("gpiomem")).unwrap();
        node.set_len(0x1000).unwrap();
        let chip = computer.open(FastGpio::Auto).unwrap();
        chip.line(40).unwrap().write(true);
        let block = fs::read(computer.dev("gpiomem")).unwrap();
        assert_eq!(block.iter().position(|byte| *byte != 0), Some(0x20 + 1), "line 40 is bit 8 of GPSET1");
        // Memory that only stores is not trusted: it does not say that the line is an output.
        assert!(chip.line(40).unwrap().check(Some(true), || Ok(true)).is_err());
        assert!(chip.line(58).is_none());
    }

    #[test]
    fn the_kernel_s_name_of_a_device_is_its_address() {
        let computer = Computer::new(PI3);
        let device = |name: &str| computer.dev("soc").join(name).join("gpiochip0");
        assert_eq!(physical_address(&device("3f200000.gpio")), Some(0x3f20_0000));
        // One whose address on the bus is another, or that has none.
        fs::rename(computer.dev("soc/3f200000.gpio"), computer.dev("soc/3f300000.gpio")).unwrap();
        assert_eq!(physical_address(&device("3f300000.gpio")), None);
        fs::rename(computer.dev("soc/3f300000.gpio"), computer.dev("soc/gpio")).unwrap();
        assert_eq!(physical_address(&device("gpio")), None);
    }

    #[test]
    fn a_chip_is_looked_at_once() {
        let computer = Computer::new(PI3);
        let are_there = |chips: &mut FastChips| computer.with_places(|places| chips.of(places, "gpiochip0").is_some());
        let mut chips = FastChips::new(FastGpio::Auto);
        assert!(!are_there(&mut chips));
        fs::File::create(computer.dev("gpiomem")).unwrap().set_len(0x1000).unwrap();
        assert!(!are_there(&mut chips), "it has been looked at");
        let mut chips = FastChips::new(FastGpio::Auto);
        assert!(are_there(&mut chips));
        chips.distrust("gpiochip0", 17, "the level in its registers is not the kernel's");
        assert!(!are_there(&mut chips));
        assert!(!are_there(&mut FastChips::new(FastGpio::Off)));
    }
}
