// SPDX-License-Identifier: GPL-3.0-or-later
//! GPIO lines through the kernel's character device.
//!
//! Whether a chip has really switched a pull resistor on can not be seen: if its driver answers
//! `ENOTSUPP`, the kernel takes that for success, and what the kernel tells of a line is what was
//! asked for. So a resistor is refused where the kernel refuses it, and on the chips in
//! [`WITHOUT_BIAS`], which are known to have none. On any other chip we have to trust the driver.

#![forbid(unsafe_code)]

use std::error::Error as _;
use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use gpio_cdev::{LineDirection, LineHandle, LineRequestFlags};
use nix::unistd::{Gid, Group, User, geteuid};

use super::GPIO;
use super::guard::SharedGuard;
use crate::board::{Bias, Direction, EdgeCount, Edges, Line};
use crate::shutdown::{Shutdown, ShutdownReason, reason};
use crate::sys;

/// The name that the kernel shows as the consumer of our lines.
const CONSUMER: &str = "pinion";
/// GPIOHANDLE_REQUEST_BIAS_PULL_UP and _DOWN (Linux 5.5), which gpio-cdev does not name.
const PULL_UP: LineRequestFlags = LineRequestFlags::from_bits_retain(1 << 5);
const PULL_DOWN: LineRequestFlags = LineRequestFlags::from_bits_retain(1 << 6);
/// What a driver answers if it does not support a request (include/linux/errno.h).
const ENOTSUPP: i32 = 524;
/// Subsystems whose drivers send their devices messages and sleep until these are answered.
const SLEEPING_BUSES: [&str; 7] = ["i2c", "spi", "usb", "hid", "serial", "virtio", "w1"];
/// Labels of chips that are on none of these buses, but whose drivers sleep all the same. That of the
/// Raspberry Pi 3 and 4 asks the firmware (drivers/gpio/gpio-raspberrypi-exp.c, `can_sleep`).
const SLEEPING_LABELS: [&str; 1] = ["raspberrypi-exp-gpio"];
/// How the labels of chips without certain resistors begin, and which resistors these chips lack.
const WITHOUT_BIAS: [(&str, &[Bias]); 4] = [
    ("raspberrypi-exp-gpio", &[Bias::PullUp, Bias::PullDown]),
    ("brcmvirt-gpio", &[Bias::PullUp, Bias::PullDown]),
    ("pcf857", &[Bias::PullUp, Bias::PullDown]),
    ("mcp23", &[Bias::PullDown]),
];

/// A GPIO chip as it was found.
#[derive(Clone, Debug)]
pub struct Chip {
    /// The number of `/dev/gpiochip<n>`.
    pub number: u32,
    /// The driver's label, such as `pinctrl-bcm2835`.
    pub label: String,
    /// Whether calls to it may block: an expander.
    pub sleeps: bool,
    /// Its lines by offset.
    pub lines: Vec<LineInfo>,
}

/// A line as it was found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LineInfo {
    /// The name that the device tree gives the line.
    pub name: Option<String>,
    /// Whether it is an output.
    pub output: bool,
    /// Whether the kernel or a program uses it.
    pub held: bool,
    /// Who uses it, as far as the kernel tells.
    pub consumer: Option<String>,
}

/// The chips of this machine by number, and a line for the log for each that can not be read.
///
/// A node that is a link to another chip's (`/dev/gpiochip4` on a Raspberry Pi 5) is left out, as
/// its lines are those of the other chip. Pins with its number work all the same.
pub(super) fn scan(dev: &Path, devices: &Path) -> (Vec<Chip>, Vec<String>) {
    let mut chips = Vec::new();
    let mut problems = Vec::new();
    for number in nodes(dev) {
        let path = node(dev, number);
        let chip = match gpio_cdev::Chip::new(&path) {
            Ok(chip) => chip,
            Err(error) => {
                problems.push(cannot_open(&path, errno(&error)));
                continue;
            }
        };
        if chip.name() != format!("gpiochip{number}") {
            continue;
        }
        let lines = chip.lines().map(|line| look_at(&line)).collect();
        let sleeps = may_sleep(devices, chip.name(), chip.label());
        chips.push(Chip { number, label: chip.label().to_owned(), sleeps, lines });
    }
    (chips, problems)
}

/// The numbers of the chips in `dev`, in ascending order.
fn nodes(dev: &Path) -> Vec<u32> {
    let mut numbers: Vec<u32> = fs::read_dir(dev)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.strip_prefix("gpiochip")?.parse().ok())
        .collect();
    numbers.sort_unstable();
    numbers
}

fn node(dev: &Path, number: u32) -> PathBuf {
    dev.join(format!("gpiochip{number}"))
}

fn look_at(line: &gpio_cdev::Line) -> LineInfo {
    // Without information the line still keeps its place in the list, which is its offset.
    line.info().map_or_else(
        |_| LineInfo::default(),
        |info| LineInfo {
            name: info.name().map(str::to_owned),
            output: info.direction() == LineDirection::Out,
            // Despite its name this flag means "in use", be it by the kernel or by a program.
            held: info.is_kernel(),
            consumer: info.consumer().map(str::to_owned),
        },
    )
}

/// The number of the chip that `/dev/gpiochip<number>` leads to, if it is a link to another.
pub(super) fn number_behind(dev: &Path, number: u32) -> Option<u32> {
    let target = fs::read_link(node(dev, number)).ok()?;
    target.file_name()?.to_str()?.strip_prefix("gpiochip")?.parse().ok()
}

/// A line of an open chip, not yet requested.
pub(super) struct Handle {
    line: gpio_cdev::Line,
    subject: Subject,
}

/// Opens `/dev/gpiochip<number>` and picks a line.
///
/// # Errors
///
/// "GPIO chip device not found", "Unable to open GPIO chip device"; `refused` if the chip has no
/// such line.
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

    /// Requests the line from the kernel; an output is given to the guardian. `sleeping` is the name
    /// of the line's chip if calls to that may block.
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
        let flags = AtomicU32::new(bits);
        let line = HeldLine { handle, line: self.line, subject: self.subject, flags, guard, sleeping };
        line.watch_over(direction, 0)?;
        Ok(line)
    }
}

/// What the kernel is asked for.
struct LineSetup {
    flags: LineRequestFlags,
    level: bool,
    /// The reason to stop with if the kernel refuses.
    refused: ShutdownReason,
}

/// A line that we have requested.
pub(super) struct HeldLine {
    handle: LineHandle,
    line: gpio_cdev::Line,
    subject: Subject,
    /// What its last set-up made it (`GPIOHANDLE_REQUEST_` flags).
    flags: AtomicU32,
    guard: SharedGuard,
    /// The name of its chip, if calls to that may block.
    sleeping: Option<String>,
}

impl HeldLine {
    /// The error for a call to the chip that failed with the error number `code`.
    #[cold]
    #[inline(never)]
    fn lost(&self, reason: ShutdownReason, what: &str, code: i32) -> Shutdown {
        Shutdown::because(reason, self.subject.lost(what, code, self.sleeping.is_some()))
    }

    /// Has the guardian hold the line if it is an output now, and let go of it if it no longer is.
    /// `before` are the flags of the set-up before this one.
    fn watch_over(&self, direction: Direction, before: u32) -> Result<(), Shutdown> {
        let name = format!("{} line {}", self.subject.chip, self.subject.offset);
        let before = LineRequestFlags::from_bits_retain(before);
        let was_watched = before.contains(LineRequestFlags::OUTPUT) && !before.contains(LineRequestFlags::OPEN_DRAIN);
        match direction {
            Direction::Output { shutdown_level, .. } => {
                self.guard.output(&name, self.handle.as_raw_fd(), shutdown_level, self.sleeping.as_deref())?;
            }
            Direction::Input(_) | Direction::OpenDrain if was_watched => self.guard.forget(&name)?,
            Direction::Input(_) | Direction::OpenDrain => {}
        }
        Ok(())
    }
}

impl Line for HeldLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        let flags = self.flags.load(Ordering::Relaxed);
        if flags & LineRequestFlags::OUTPUT.bits() == 0 {
            return Ok(());
        }
        match &self.sleeping {
            None => self
                .handle
                .set_value(level.into())
                .map_err(|error| self.lost(reason::LINE_WRITE, "written", errno(&error))),
            Some(_) => sys::set_line_checked(&self.handle, flags, level)
                .map_err(|error| self.lost(reason::LINE_WRITE, "written", error.raw_os_error().unwrap_or_default())),
        }
    }

    fn read(&self) -> Result<bool, Shutdown> {
        match self.handle.get_value() {
            Ok(value) => Ok(value != 0),
            Err(error) => Err(self.lost(reason::LINE_READ, "read", errno(&error))),
        }
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let before = self.flags.load(Ordering::Relaxed);
        self.turn(direction)?;
        self.watch_over(direction, before)
    }

    fn turn(&self, direction: Direction) -> Result<(), Shutdown> {
        let LineSetup { flags, level, refused } = self.subject.setting(direction)?;
        sys::set_line_config(&self.handle, flags.bits(), level).map_err(|error| {
            self.subject.refused(refused, error.raw_os_error().unwrap_or_default(), direction, &self.line)
        })?;
        self.flags.store(flags.bits(), Ordering::Relaxed);
        Ok(())
    }
}

/// Whether calls to a chip may block, as its driver talks to it over a bus or asks a firmware: told
/// by the subsystems of the devices above the chip in `devices`, which is `/sys/bus/gpio/devices`.
pub(super) fn may_sleep(devices: &Path, chip: &str, label: &str) -> bool {
    if SLEEPING_LABELS.contains(&label) {
        return true;
    }
    let Ok(device) = devices.join(chip).canonicalize() else { return false };
    device.ancestors().skip(1).any(|parent| {
        let subsystem = fs::read_link(parent.join("subsystem")).ok();
        let subsystem = subsystem.as_deref().and_then(Path::file_name).and_then(|name| name.to_str());
        subsystem.is_some_and(|name| SLEEPING_BUSES.contains(&name))
    })
}

/// `GPIO_V2_LINE_FLAG_` flags.
mod flag {
    pub(super) const INPUT: u64 = 1 << 2;
    pub(super) const BOTH_EDGES: u64 = 1 << 4 | 1 << 5;
    pub(super) const PULL_UP: u64 = 1 << 8;
    pub(super) const PULL_DOWN: u64 = 1 << 9;
}

/// Edges that the kernel keeps for us, if we ask for no other number (gpiolib-cdev.c). Only the last one
/// matters, as each carries the number of those before it, so the fewer the better: so many are read at
/// a time, however many come.
const EVENTS: usize = 16;
/// `struct gpio_v2_line_event` (linux/gpio.h): `timestamp_ns` at 0, `line_seqno` at 20.
const EVENT_BYTES: usize = 48;

/// A request of the newer kind (`gpio_v2`), for a line with edges.
struct EdgeRequest {
    file: File,
    subject: Subject,
    /// `GPIO_V2_LINE_FLAG_` flags of its last set-up.
    flags: AtomicU64,
}

impl EdgeRequest {
    fn set(&self, flags: u64) -> Result<(), Shutdown> {
        if flags != self.flags.swap(flags, Ordering::Relaxed) {
            sys::set_line_flags(&self.file, flags).map_err(|error| {
                let code = error.raw_os_error().unwrap_or_default();
                let detail = self.subject.refusal("an input", code, Bias::None, &LineInfo::default(), "");
                Shutdown::because(reason::INPUT_LINE, detail)
            })?;
        }
        Ok(())
    }

    fn unreadable(&self, error: &io::Error) -> Shutdown {
        let code = error.raw_os_error().unwrap_or_default();
        Shutdown::because(reason::LINE_READ, self.subject.lost("read", code, false))
    }
}

/// An input line whose edges the kernel counts. The kernel has no way from the requests of [`HeldLine`]
/// to one with edges, so this is another kind of line, and can not become an output.
pub(super) struct EdgeLine(Arc<EdgeRequest>);

/// The edges of an [`EdgeLine`].
pub(super) struct LineEdges {
    request: Arc<EdgeRequest>,
    so_far: EdgeCount,
}

impl Handle {
    /// Requests the line as an input, from the kernel, with its edges. An error for the log, if that can
    /// not be: the line may still be had without.
    pub(super) fn request_edges(self, dev: &Path, bias: Bias) -> Result<(EdgeLine, LineEdges), Box<str>> {
        if lacks(&self.subject.label, bias) {
            return Err(self.subject.no_bias(bias).into());
        }
        let flags = flag::INPUT | flag::BOTH_EDGES | bias_flag(bias);
        let file = File::open(dev.join(&self.subject.chip))
            .and_then(|chip| sys::request_line(&chip, self.subject.offset, flags, CONSUMER))
            .map_err(|error| no_edges(error.raw_os_error().unwrap_or_default()))?;
        let request = Arc::new(EdgeRequest { file, subject: self.subject, flags: AtomicU64::new(flags) });
        Ok((EdgeLine(request.clone()), LineEdges { request, so_far: EdgeCount::default() }))
    }
}

fn bias_flag(bias: Bias) -> u64 {
    match bias {
        Bias::None => 0,
        Bias::PullUp => flag::PULL_UP,
        Bias::PullDown => flag::PULL_DOWN,
    }
}

/// For the log: why the kernel does not tell of a line's edges.
fn no_edges(code: i32) -> Box<str> {
    let why = match code {
        libc::ENXIO => "its chip has no interrupts".to_owned(),
        libc::EBUSY => "its interrupt is in use".to_owned(),
        libc::EINVAL | libc::ENOTTY => "Linux before 5.10 does so for no line, and some drivers for none".to_owned(),
        _ => text(code),
    };
    format!("the kernel does not tell of its edges ({why})").into()
}

impl Line for EdgeLine {
    /// It is an input.
    fn write(&self, _level: bool) -> Result<(), Shutdown> {
        Ok(())
    }

    fn read(&self) -> Result<bool, Shutdown> {
        sys::line_level(&self.0.file).map_err(|error| self.0.unreadable(&error))
    }

    fn set_direction(&self, direction: Direction) -> Result<(), Shutdown> {
        let Direction::Input(bias) = direction else {
            let detail = format!(
                "{} counts pulses and can not be an output as well: choose another pin for one of the two",
                self.0.subject
            );
            return Err(Shutdown::because(reason::OUTPUT_LINE, detail));
        };
        self.0.subject.setting(direction)?;
        let before = self.0.flags.load(Ordering::Relaxed);
        self.0.set(before & !(flag::PULL_UP | flag::PULL_DOWN) | bias_flag(bias))
    }
}

impl Edges for LineEdges {
    /// One read takes all that the kernel keeps. It drops the oldest where there is no room, and has
    /// counted them before that.
    fn count(&mut self) -> Result<EdgeCount, Shutdown> {
        let mut events = [0; EVENTS * EVENT_BYTES];
        let bytes = match (&self.request.file).read(&mut events) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => 0,
            read => read.map_err(|error| self.request.unreadable(&error))?,
        };
        if let Some(last) = events[..bytes].chunks_exact(EVENT_BYTES).next_back() {
            self.so_far = edge_count(last);
        }
        Ok(self.so_far)
    }

    fn end(&mut self) -> Result<(), Shutdown> {
        self.request.set(self.request.flags.load(Ordering::Relaxed) & !flag::BOTH_EDGES)
    }
}

/// What a line's last event tells.
fn edge_count(event: &[u8]) -> EdgeCount {
    let (timestamp_ns, rest) = event.split_first_chunk().unwrap_or((&[0; 8], &[]));
    let line_seqno = rest.get(12..).and_then(|rest| rest.first_chunk()).unwrap_or(&[0; 4]);
    EdgeCount {
        count: u32::from_ne_bytes(*line_seqno),
        last: Some(Duration::from_nanos(u64::from_ne_bytes(*timestamp_ns))),
    }
}

/// What errors say of a line.
#[derive(Clone, Debug)]
struct Subject {
    chip: String,
    label: String,
    offset: u32,
    name: Option<String>,
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} line {}", self.chip, self.offset)?;
        match &self.name {
            Some(name) => write!(f, " ({name})"),
            None => Ok(()),
        }
    }
}

impl Subject {
    fn setting(&self, direction: Direction) -> Result<LineSetup, Shutdown> {
        match direction {
            Direction::Output { level, .. } => {
                Ok(LineSetup { flags: LineRequestFlags::OUTPUT, level, refused: reason::OUTPUT_LINE })
            }
            // The kernel never drives it high: where the chip has no open drain, it makes the line an
            // input instead.
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

    /// The error for a line that the kernel has refused with the error number `code`.
    fn refused(&self, reason: ShutdownReason, code: i32, direction: Direction, line: &gpio_cdev::Line) -> Shutdown {
        let release = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
        let (action, bias) = match direction {
            Direction::Output { .. } => ("an output", Bias::None),
            Direction::Input(bias) => ("an input", bias),
            Direction::OpenDrain => ("an open drain", Bias::PullUp),
        };
        Shutdown::because(reason, self.refusal(action, code, bias, &look_at(line), &release))
    }

    fn beyond(&self, lines: u32) -> String {
        let last = lines.saturating_sub(1);
        format!(
            "{} ({}) has no line {}, its lines are 0 to {last}: choose another pin (pinion pins \
             lists them)",
            self.chip, self.label, self.offset
        )
    }

    fn no_bias(&self, bias: Bias) -> String {
        let (pull, sign) = pull(bias);
        format!(
            "{self} has no {pull} resistor ({} offers none): solder one and write the pin \
             without the {sign}, or choose another pin",
            self.label
        )
    }

    /// `what` is "read" or "written"; `sleeping` tells whether the chip is on a bus.
    fn lost(&self, what: &str, code: i32, sleeping: bool) -> String {
        let why = match sleeping {
            true => "its chip does not answer, or is gone: check its power and wiring",
            false => "its chip or driver is gone",
        };
        format!(
            "{self} can no longer be {what}: {}: {why}, look at the kernel's log (dmesg), then FIRMWARE_RESTART",
            text(code)
        )
    }

    fn refusal(&self, action: &str, code: i32, bias: Bias, found: &LineInfo, release: &str) -> String {
        let (pull, _) = pull(bias);
        match code {
            libc::EBUSY => {
                let holder = match &found.consumer {
                    Some(consumer) => format!("\"{consumer}\""),
                    None => "the kernel".to_owned(),
                };
                format!(
                    "{self} is in use by {holder}: free it or choose another pin (pinion pins \
                     lists them)"
                )
            }
            libc::EINVAL if bias != Bias::None && before(release, (5, 5)) => format!(
                "{self} can not have a {pull} resistor: Linux {} knows none before 5.5: update \
                 the kernel, or solder one",
                release.trim_end()
            ),
            ENOTSUPP | libc::EOPNOTSUPP | libc::ENOSYS if bias != Bias::None => self.no_bias(bias),
            libc::EINVAL => format!(
                "{self} is refused as {action} by the driver of {}: the pin has another function \
                 or is reserved: free it in the device tree, or choose another pin",
                self.label
            ),
            libc::EIO | libc::EPERM | ENOTSUPP | libc::EOPNOTSUPP => format!(
                "{self} can not be {action}: {}: the chip {} does not offer it: choose another pin",
                text(code),
                self.label
            ),
            _ => format!(
                "{self} can not be had as {action}: {}: look at the kernel's log (dmesg), or \
                 choose another pin",
                text(code)
            ),
        }
    }
}

/// A resistor's name, and the sign in front of a pin that asks for it in printer.cfg.
fn pull(bias: Bias) -> (&'static str, char) {
    match bias {
        Bias::PullDown => ("pull-down", '~'),
        Bias::PullUp | Bias::None => ("pull-up", '^'),
    }
}

/// Whether the chip with this label is known not to have this resistor.
fn lacks(label: &str, bias: Bias) -> bool {
    WITHOUT_BIAS.iter().any(|(chip, lacking)| label.starts_with(chip) && lacking.contains(&bias))
}

/// Whether a kernel's release, such as `5.4.0-rpi`, comes before a version.
fn before(release: &str, version: (u32, u32)) -> bool {
    let mut numbers = release.split(|c: char| !c.is_ascii_digit()).map_while(|n| n.parse::<u32>().ok());
    match (numbers.next(), numbers.next()) {
        (Some(major), Some(minor)) => (major, minor) < version,
        _ => false,
    }
}

fn missing(path: &Path, chips: &[Chip]) -> String {
    let known: Vec<String> = chips.iter().map(|chip| format!("gpiochip{} ({})", chip.number, chip.label)).collect();
    let known = match known.is_empty() {
        true => "no GPIO chip that can be opened".to_owned(),
        false => known.join(", "),
    };
    format!(
        "there is no {}: this machine has {known}: write the pin with one of these (pinion pins \
         lists them)",
        path.display()
    )
}

fn cannot_open(path: &Path, code: i32) -> String {
    match code {
        libc::EACCES | libc::EPERM => not_permitted(path),
        libc::ENOTTY => format!("{} is not a GPIO chip: remove it and let the kernel make the node", path.display()),
        _ => format!("{} can not be opened: {}: look at the kernel's log (dmesg)", path.display(), text(code)),
    }
}

/// For the log: to whom a device node belongs, and how to get permission to open it.
pub(super) fn not_permitted(path: &Path) -> String {
    let who = User::from_uid(geteuid()).ok().flatten().map_or_else(|| format!("user {}", geteuid()), |user| user.name);
    let (mode, group) = match fs::metadata(path) {
        Ok(node) => {
            let gid = Gid::from_raw(node.gid());
            let group = Group::from_gid(gid).ok().flatten();
            (node.mode(), group.map_or_else(|| gid.to_string(), |g| g.name))
        }
        Err(_) => (0, String::new()),
    };
    permission_text(path, &who, mode, &group)
}

fn permission_text(path: &Path, who: &str, mode: u32, group: &str) -> String {
    let path = path.display();
    if mode & 0o060 == 0o060 && group != "root" {
        format!(
            "{who} may not open {path}, which belongs to group {group}: \"sudo usermod -aG \
             {group} {who}\" and start Pinion again"
        )
    } else {
        format!(
            "{who} may not open {path}, which is root's alone: \"sudo udevadm trigger\" or a reboot puts \
             Pinion's udev rules in force, where they are installed; or run Pinion as root"
        )
    }
}

/// The error number of a call that has just failed.
///
/// gpio-cdev hides the number in an error type of another version of nix than ours. But it makes no
/// system call between the one that fails and its own return, so the thread's errno is still that.
fn errno(error: &gpio_cdev::Error) -> i32 {
    let last = io::Error::last_os_error().raw_os_error();
    error
        .source()
        .and_then(|source| source.downcast_ref::<io::Error>())
        .and_then(io::Error::raw_os_error)
        .or(last)
        .unwrap_or_default()
}

/// The meaning of an error number, in lower case, as it stands in a sentence.
pub(super) fn text(code: i32) -> String {
    match code {
        ENOTSUPP => "not supported by the driver (error 524)".to_owned(),
        _ => io::Error::from_raw_os_error(code).to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn gpio17() -> Subject {
        Subject { chip: "gpiochip0".into(), label: "pinctrl-bcm2835".into(), offset: 17, name: Some("GPIO17".into()) }
    }

    fn refusal(code: i32, bias: Bias, consumer: Option<&str>, release: &str) -> String {
        let found = LineInfo { consumer: consumer.map(str::to_owned), ..LineInfo::default() };
        gpio17().refusal("an input", code, bias, &found, release)
    }

    #[test]
    fn a_held_line_names_its_holder() {
        assert_eq!(
            refusal(libc::EBUSY, Bias::None, Some("spi0 CS1"), "6.6.0"),
            "gpiochip0 line 17 (GPIO17) is in use by \"spi0 CS1\": free it or choose another pin \
             (pinion pins lists them)"
        );
        assert!(refusal(libc::EBUSY, Bias::PullUp, None, "6.6.0").contains("by the kernel:"));
    }

    #[test]
    fn an_edge_event_is_laid_out_as_the_kernel_has_it() {
        // timestamp_ns, id, offset, seqno, line_seqno and padding.
        let mut event = [0xee; EVENT_BYTES];
        event[..8].copy_from_slice(&5_000_000_007_u64.to_ne_bytes());
        event[20..24].copy_from_slice(&70_000_u32.to_ne_bytes());
        let last = Some(Duration::new(5, 7));
        assert_eq!(edge_count(&event), EdgeCount { count: 70_000, last });
    }

    #[test]
    fn a_line_without_edges_says_why() {
        for (code, why) in [
            (libc::ENXIO, "its chip has no interrupts"),
            (libc::EBUSY, "its interrupt is in use"),
            (libc::EINVAL, "before 5.10"),
        ] {
            assert!(no_edges(code).contains(why), "{}", no_edges(code));
        }
    }

    #[test]
    fn a_refused_resistor_says_why() {
        assert_eq!(
            refusal(libc::EINVAL, Bias::PullUp, None, "5.4.83-v7l+\n"),
            "gpiochip0 line 17 (GPIO17) can not have a pull-up resistor: Linux 5.4.83-v7l+ knows \
             none before 5.5: update the kernel, or solder one"
        );
        let driver = refusal(ENOTSUPP, Bias::PullDown, None, "6.6.0");
        assert!(driver.contains("no pull-down resistor"), "{driver}");
        assert!(driver.contains("without the ~"), "{driver}");
        let reserved = refusal(libc::EINVAL, Bias::PullUp, None, "6.6.0");
        assert!(reserved.contains("another function"), "{reserved}");
    }

    /// A made-up `/sys` of one GPIO chip, below devices of which each has its name and its subsystem.
    fn sleeps(devices: &[(&str, &str)], label: &str) -> bool {
        let sys = tempfile::tempdir().unwrap();
        let mut device = sys.path().join("devices");
        let mut add = |name: &str, subsystem: &str| {
            device.push(name);
            fs::create_dir_all(&device).unwrap();
            if !subsystem.is_empty() {
                symlink(format!("/sys/bus/{subsystem}"), device.join("subsystem")).unwrap();
            }
        };
        for (name, subsystem) in devices {
            add(name, subsystem);
        }
        add("gpiochip3", "gpio");
        let chips = sys.path().join("bus/gpio/devices");
        fs::create_dir_all(&chips).unwrap();
        symlink(&device, chips.join("gpiochip3")).unwrap();
        assert!(!may_sleep(&chips, "gpiochip4", "another"), "a chip that is not there");
        may_sleep(&chips, "gpiochip3", label)
    }

    #[test]
    fn a_chip_behind_a_bus_may_sleep() {
        let platform = [("platform", ""), ("soc", "platform"), ("fe804000.i2c", "platform")];
        let i2c = [&platform[..], &[("i2c-1", "i2c"), ("1-0020", "i2c")]].concat();
        assert!(sleeps(&i2c, "1-0020"));
        // The GPIO part of a chip with several functions: a platform device below an I2C device.
        assert!(sleeps(&[&i2c[..], &[("da9063-gpio", "platform")]].concat(), "da9063-gpio"));
        let usb = [("pci0000:00", ""), ("0000:00:14.0", "pci"), ("usb1", "usb"), ("1-2", "usb"), ("1-2:1.0", "usb")];
        assert!(sleeps(&[&usb[..], &[("0003:10C4:EA90.0001", "hid")]].concat(), "CP2112 GPIO"));
        assert!(sleeps(
            &[("platform", ""), ("fe204000.spi", "platform"), ("spi0", "spi_master"), ("spi0.0", "spi")],
            ""
        ));
        assert!(sleeps(&[("virtual", ""), ("misc", ""), ("uhid", "misc"), ("0003:04D8:00DD.0001", "hid")], "mcp2221"));
    }

    #[test]
    fn a_chip_of_the_computer_s_own_does_not_sleep() {
        let soc = [("platform", ""), ("soc", "platform"), ("fe200000.gpio", "platform")];
        assert!(!sleeps(&soc, "pinctrl-bcm2711"));
        let rp1 = [
            ("platform", ""),
            ("axi", "platform"),
            ("1000120000.pcie", "platform"),
            ("pci0002:00", ""),
            ("0002:00:00.0", "pci"),
            ("0002:01:00.0", "pci"),
            ("1f000d0000.gpio", "platform"),
        ];
        assert!(!sleeps(&rp1, "pinctrl-rp1"));
    }

    #[test]
    fn a_chip_that_asks_the_firmware_is_known_by_its_label() {
        let device =
            [("platform", ""), ("soc", "platform"), ("soc:firmware", "platform"), ("soc:firmware:gpio", "platform")];
        assert!(sleeps(&device, "raspberrypi-exp-gpio"));
        assert!(!sleeps(&device, "another"));
    }

    #[test]
    fn a_chip_that_no_longer_answers_says_what_to_look_at() {
        let own = gpio17().lost("written", libc::ENODEV, false);
        assert!(own.contains("can no longer be written: No such device") && own.contains("its chip or driver is gone"));
        let expander = gpio17().lost("read", libc::ENXIO, true);
        assert!(expander.contains("does not answer") && expander.contains("power and wiring"), "{expander}");
    }

    #[test]
    fn chips_known_to_ignore_a_resistor() {
        assert!(lacks("raspberrypi-exp-gpio", Bias::PullUp));
        assert!(lacks("mcp23017", Bias::PullDown));
        assert!(!lacks("mcp23017", Bias::PullUp));
        assert!(!lacks("raspberrypi-exp-gpio", Bias::None));
        assert!(!lacks("pinctrl-bcm2835", Bias::PullDown));
    }

    #[test]
    fn kernel_releases() {
        assert!(before("5.4.0", (5, 5)) && before("4.19.0-rc1", (5, 5)));
        assert!(!before("5.5.0", (5, 5)) && !before("6.1-rpi", (5, 5)));
        assert!(!before("", (5, 5)) && !before("six.one", (5, 5)));
    }

    #[test]
    fn a_missing_chip_lists_those_that_are_there() {
        let chip = |number, label: &str| Chip { number, label: label.into(), sleeps: false, lines: vec![] };
        let path = Path::new("/dev/gpiochip5");
        assert_eq!(
            missing(path, &[chip(0, "pinctrl-rp1"), chip(10, "gpio-brcmstb@107d508500")]),
            "there is no /dev/gpiochip5: this machine has gpiochip0 (pinctrl-rp1), gpiochip10 \
             (gpio-brcmstb@107d508500): write the pin with one of these (pinion pins lists them)"
        );
        assert!(missing(path, &[]).contains("no GPIO chip"));
    }

    #[test]
    fn a_forbidden_node_names_its_group() {
        let path = Path::new("/dev/gpiochip0");
        assert_eq!(
            permission_text(path, "pi", 0o660, "gpio"),
            "pi may not open /dev/gpiochip0, which belongs to group gpio: \"sudo usermod -aG gpio \
             pi\" and start Pinion again"
        );
        assert!(permission_text(path, "pi", 0o600, "root").contains("udev"));
    }

    #[test]
    fn a_line_beyond_the_chip() {
        assert!(gpio17().beyond(8).contains("no line 17, its lines are 0 to 7"));
    }

    #[test]
    fn a_missing_chip_is_told_from_one_that_is_none() {
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
