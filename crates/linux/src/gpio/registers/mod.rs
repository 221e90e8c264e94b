// SPDX-License-Identifier: GPL-3.0-or-later
//! The registers of a Raspberry Pi's GPIO chip. A store to them is an edge in some 20 ns. An ioctl takes 1 to 2 us.
//!
//! A line is still claimed through the character device, and only the kernel changes its direction. Registers write and
//! read the level of a claimed line. They are used after a check ([`LineRegisters::check`]): the registers and
//! the kernel must agree about the line.
//!
//! The RP1 of a Raspberry Pi 5 is behind PCIe, which takes a store and delivers it later. If the link sleeps, that may be
//! microseconds later, and several stores come together (raspberrypi/linux pull request 6279). So its registers are used
//! only if the kernel never lets the link sleep, and each edge with a time is read back ([`LineRegisters::flush`]).
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
use crate::places::ASPM_POLICY;
use crate::{LOOK_AT_LOG, sys};
use pinion_firmware::board::Direction;
use pinion_firmware::trouble::Trouble;

mod layout;
mod line;

use layout::Layout;
pub(super) use line::{LineRegisters, RegisterBank};

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
    use std::os::unix::fs::symlink;
    use std::path::PathBuf;

    use super::*;

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
    fn each_reason_to_go_through_the_kernel_has_its_remedy() {
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
            let reason = format!("may sleep, which delays edges ({})", policies.trim());
            assert!(why.contains(&reason) && why.ends_with(LINK_REMEDY), "{why}");
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
