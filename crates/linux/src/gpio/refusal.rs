// SPDX-License-Identifier: GPL-3.0-or-later
//! Why the kernel refuses a chip or a line, in words that tell the remedy.

#![forbid(unsafe_code)]

use std::error::Error as _;
use std::fmt;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use nix::unistd::{Gid, Group, User, geteuid};

use super::chip::{Chip, LineInfo};
use pinion_firmware::board::Bias;

/// What a driver answers if it does not support a request (include/linux/errno.h).
const ENOTSUPP: i32 = 524;

/// What errors say of a line.
#[derive(Clone, Debug)]
pub(super) struct Subject {
    pub(super) chip: String,
    pub(super) label: String,
    pub(super) offset: u32,
    pub(super) name: Option<String>,
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
    pub(super) fn beyond(&self, lines: u32) -> String {
        let last = lines.saturating_sub(1);
        format!(
            "{} ({}) has no line {}, its lines are 0 to {last}: choose another pin (pinion pins \
             lists them)",
            self.chip, self.label, self.offset
        )
    }

    pub(super) fn no_bias(&self, bias: Bias) -> String {
        let (pull, sign) = pull(bias);
        format!(
            "{self} has no {pull} resistor ({} offers none): solder one and write the pin \
             without the {sign}, or choose another pin",
            self.label
        )
    }

    /// `what` is "read" or "written"; `sleeping` tells whether the chip is on a bus.
    pub(super) fn lost(&self, what: &str, code: i32, sleeping: bool) -> String {
        let why = match sleeping {
            true => "its chip does not answer, or is gone: check its power and wiring",
            false => "its chip or driver is gone",
        };
        format!(
            "{self} can no longer be {what}: {}: {why}, look at the kernel's log (dmesg), then FIRMWARE_RESTART",
            text(code)
        )
    }

    pub(super) fn refusal(&self, action: &str, code: i32, bias: Bias, found: &LineInfo, release: &str) -> String {
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
            libc::EINVAL if bias != Bias::None && is_before(release, BIAS_SINCE) => format!(
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

/// The first Linux that switches resistors on.
pub const BIAS_SINCE: (u32, u32) = (5, 5);
/// The first Linux that tells of a line's edges as Pinion asks for them.
pub const EDGES_SINCE: (u32, u32) = (5, 10);

/// Whether a kernel's release, such as `5.4.0-rpi`, comes before a version.
pub fn is_before(release: &str, version: (u32, u32)) -> bool {
    let mut numbers = release.split(|c: char| !c.is_ascii_digit()).map_while(|n| n.parse::<u32>().ok());
    match (numbers.next(), numbers.next()) {
        (Some(major), Some(minor)) => (major, minor) < version,
        _ => false,
    }
}

pub(super) fn missing(path: &Path, chips: &[Chip]) -> String {
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

pub(super) fn cannot_open(path: &Path, code: i32) -> String {
    match code {
        libc::EACCES | libc::EPERM => not_permitted(path),
        libc::ENOTTY => format!("{} is not a GPIO chip: remove it and let the kernel make the node", path.display()),
        _ => format!("{} can not be opened: {}: look at the kernel's log (dmesg)", path.display(), text(code)),
    }
}

/// For the log: to whom a device node belongs, and how to get permission to open it.
pub fn not_permitted(path: &Path) -> String {
    permission_text(path, &Opener::of(path))
}

/// Who asks for a file, and the group whose members may open it, if there is one.
pub struct Opener {
    who: String,
    group: Option<String>,
}

impl Opener {
    /// Who runs this program, for this file.
    pub fn of(path: &Path) -> Opener {
        let user = User::from_uid(geteuid()).ok().flatten();
        let who = user.map_or_else(|| format!("user {}", geteuid()), |user| user.name);
        let about = fs::metadata(path).ok().filter(|about| about.mode() & 0o060 == 0o060);
        let group = about.map(|about| {
            let gid = Gid::from_raw(about.gid());
            Group::from_gid(gid).ok().flatten().map_or_else(|| gid.to_string(), |group| group.name)
        });
        // Who is in root's group may do more than that.
        Opener { who, group: group.filter(|group| group != "root") }
    }

    /// The command that has the user open such files.
    pub fn command(&self) -> Option<String> {
        let Opener { who, group } = self;
        group.as_ref().map(|group| format!("sudo usermod -aG {group} {who}"))
    }
}

fn permission_text(path: &Path, opener: &Opener) -> String {
    let (path, who) = (path.display(), &opener.who);
    match (&opener.group, opener.command()) {
        (Some(group), Some(command)) => format!(
            "{who} may not open {path}, which belongs to group {group}: \"{command}\", log in anew and start Pinion again"
        ),
        _ => format!(
            "{who} may not open {path}, which is root's alone: \"sudo udevadm trigger\" or a reboot puts \
             Pinion's udev rules in force, where they are installed; or run Pinion as root"
        ),
    }
}

/// The error number of a call that has just failed.
///
/// gpio-cdev hides the number in an error type of another version of nix than ours. But it makes no
/// system call between the one that fails and its own return, so the thread's errno is still that.
pub(super) fn errno(error: &gpio_cdev::Error) -> i32 {
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
    use std::os::unix::fs::PermissionsExt;

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

    #[test]
    fn a_chip_that_no_longer_answers_says_what_to_look_at() {
        let own = gpio17().lost("written", libc::ENODEV, false);
        assert!(own.contains("can no longer be written: No such device") && own.contains("its chip or driver is gone"));
        let expander = gpio17().lost("read", libc::ENXIO, true);
        assert!(expander.contains("does not answer") && expander.contains("power and wiring"), "{expander}");
    }

    #[test]
    fn kernel_releases() {
        assert!(is_before("5.4.0", (5, 5)) && is_before("4.19.0-rc1", (5, 5)));
        assert!(!is_before("5.5.0", (5, 5)) && !is_before("6.1-rpi", (5, 5)));
        assert!(!is_before("", (5, 5)) && !is_before("six.one", (5, 5)));
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
        let text =
            |group: Option<&str>| permission_text(path, &Opener { who: "pi".into(), group: group.map(str::to_owned) });
        assert_eq!(
            text(Some("gpio")),
            "pi may not open /dev/gpiochip0, which belongs to group gpio: \"sudo usermod -aG gpio pi\", log in \
             anew and start Pinion again"
        );
        assert!(text(None).contains("udev"));
    }

    #[test]
    fn a_file_s_group_helps_where_it_may_open_the_file_and_is_not_root_s() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let command = |mode: u32| {
            fs::set_permissions(file.path(), fs::Permissions::from_mode(mode)).unwrap();
            Opener::of(file.path()).command()
        };
        assert_eq!(command(0o600), None);
        // Who runs the tests may be root, and have root's group.
        let gid = fs::metadata(file.path()).unwrap().gid();
        assert_eq!(command(0o660).is_some(), gid != 0);
    }

    #[test]
    fn a_line_beyond_the_chip() {
        assert!(gpio17().beyond(8).contains("no line 17, its lines are 0 to 7"));
    }
}
