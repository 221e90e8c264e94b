// SPDX-License-Identifier: GPL-3.0-or-later
//! Why the kernel refuses a chip or a line, and the remedy.

#![forbid(unsafe_code)]

use std::error::Error as _;
use std::fmt;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use nix::unistd::{Gid, Group, User, geteuid};

use pinion_firmware::board::Bias;
use pinion_firmware::trouble::Trouble;

use crate::LOOK_AT_LOG;

/// A driver's answer to a request that it does not support (include/linux/errno.h).
const ENOTSUPP: i32 = 524;

/// The line that an error is about.
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
    pub(super) fn beyond(&self, lines: u32) -> Trouble {
        let Subject { chip, label, offset, .. } = self;
        let last = lines.saturating_sub(1);
        Trouble::new(format!("{chip} ({label}) has no line {offset}, its lines are 0 to {last}"))
            .remedy("choose another pin (pinion pins lists them)")
    }

    pub(super) fn no_bias(&self, bias: Bias) -> Trouble {
        let (pull, sign) = pull(bias);
        Trouble::new(format!("{self} has no {pull} resistor ({} offers none)", self.label))
            .remedy(format!("solder one and write the pin without the {sign}, or choose another pin"))
    }

    /// `what` is "read" or "written". `sleeping` says whether the chip is on a bus.
    pub(super) fn lost(&self, what: &str, code: i32, sleeping: bool) -> Trouble {
        let (why, remedy) = match sleeping {
            true => (
                "its chip does not answer, or is gone",
                "check its power and wiring, look at the kernel's log (dmesg), then FIRMWARE_RESTART",
            ),
            false => ("its chip or driver is gone", "look at the kernel's log (dmesg), then FIRMWARE_RESTART"),
        };
        Trouble::new(format!("{self} can no longer be {what}: {}: {why}", text(code))).remedy(remedy)
    }

    /// `consumer` is the line's holder, if the kernel knows it.
    pub(super) fn refusal(
        &self,
        action: &str,
        code: i32,
        bias: Bias,
        consumer: Option<&str>,
        release: &str,
    ) -> Trouble {
        let (pull, _) = pull(bias);
        let label = &self.label;
        match code {
            libc::EBUSY => {
                let holder = consumer.map_or_else(|| "the kernel".to_owned(), |consumer| format!("\"{consumer}\""));
                Trouble::new(format!("{self} is in use by {holder}"))
                    .remedy("free it or choose another pin (pinion pins lists them)")
            }
            libc::EINVAL if bias != Bias::None && is_before(release, BIAS_SINCE) => Trouble::new(format!(
                "{self} cannot have a {pull} resistor: Linux {} knows none before 5.5",
                release.trim_end()
            ))
            .remedy("update the kernel, or solder one"),
            ENOTSUPP | libc::EOPNOTSUPP | libc::ENOSYS if bias != Bias::None => self.no_bias(bias),
            libc::EINVAL => Trouble::new(format!(
                "{self} is refused as {action} by the driver of {label}: the pin has another function or is reserved"
            ))
            .remedy("free it in the device tree, or choose another pin"),
            libc::EIO | libc::EPERM | ENOTSUPP | libc::EOPNOTSUPP => {
                Trouble::new(format!("{self} cannot be {action}: {}: the chip {label} does not offer it", text(code)))
                    .remedy("choose another pin")
            }
            _ => Trouble::new(format!("the kernel refuses {self} as {action}: {}", text(code)))
                .remedy("look at the kernel's log (dmesg), or choose another pin"),
        }
    }
}

/// A resistor's name, and the sign that requests it in front of a pin in printer.cfg.
fn pull(bias: Bias) -> (&'static str, char) {
    match bias {
        Bias::PullDown => ("pull-down", '~'),
        Bias::PullUp | Bias::None => ("pull-up", '^'),
    }
}

/// The first Linux version that switches resistors on.
pub const BIAS_SINCE: (u32, u32) = (5, 5);
/// The first Linux version with the request that Pinion uses for a line's edges.
pub const EDGES_SINCE: (u32, u32) = (5, 10);

/// Whether a kernel's release, such as `5.4.0-rpi`, comes before a version.
pub fn is_before(release: &str, version: (u32, u32)) -> bool {
    let mut numbers = release.split(|c: char| !c.is_ascii_digit()).map_while(|n| n.parse::<u32>().ok());
    match (numbers.next(), numbers.next()) {
        (Some(major), Some(minor)) => (major, minor) < version,
        _ => false,
    }
}

pub(super) fn cannot_open(path: &Path, code: i32) -> Trouble {
    let shown = path.display();
    match code {
        libc::EACCES | libc::EPERM => not_permitted(path, code),
        libc::ENOTTY => {
            Trouble::new(format!("{shown} is not a GPIO chip")).remedy("remove it and let the kernel make the node")
        }
        _ => Trouble::new(format!("{shown} cannot be opened: {}", text(code))).remedy(LOOK_AT_LOG),
    }
}

/// Who forbids to open a device node, and how to get permission. `code` is the error number, EACCES or EPERM.
pub(crate) fn not_permitted(path: &Path, code: i32) -> Trouble {
    match code {
        libc::EPERM => forbidden_by_service(path, &Opener::of(path)),
        _ => forbidden(path, &Opener::of(path)),
    }
}

/// The user that opens a file, and the group whose members may open it, if there is one.
pub struct Opener {
    who: String,
    group: Option<String>,
}

impl Opener {
    /// The user of this program, and the group of this file.
    pub fn of(path: &Path) -> Opener {
        let user = User::from_uid(geteuid()).ok().flatten();
        let who = user.map_or_else(|| format!("user {}", geteuid()), |user| user.name);
        let about = fs::metadata(path).ok().filter(|about| about.mode() & 0o060 == 0o060);
        let group = about.map(|about| {
            let gid = Gid::from_raw(about.gid());
            Group::from_gid(gid).ok().flatten().map_or_else(|| gid.to_string(), |group| group.name)
        });
        // Members of root's group may do more than open this file.
        Opener { who, group: group.filter(|group| group != "root") }
    }

    /// The command that lets the user open these files.
    pub fn command(&self) -> Option<String> {
        let Opener { who, group } = self;
        group.as_ref().map(|group| format!("sudo usermod -aG {group} {who}"))
    }
}

fn forbidden(path: &Path, opener: &Opener) -> Trouble {
    let (path, who) = (path.display(), &opener.who);
    match (&opener.group, opener.command()) {
        (Some(group), Some(command)) => {
            Trouble::new(format!("{who} may not open {path}, which belongs to group {group}"))
                .remedy(format!("\"{command}\", log in again, then restart Pinion"))
        }
        _ => Trouble::new(format!("{who} may not open {path}, which is root's alone")).remedy(
            "\"sudo udevadm trigger\" or a reboot puts Pinion's udev rules in force, where they are installed; or run \
             Pinion as root",
        ),
    }
}

/// The owner and the mode let the user in, and the device filter of the service's control group does not. systemd makes
/// this filter when it starts the service, from the drivers that it finds then.
fn forbidden_by_service(path: &Path, opener: &Opener) -> Trouble {
    let (path, who) = (path.display(), &opener.who);
    Trouble::new(format!("{who} may not open {path}, which the service's DeviceAllow= leaves out")).remedy(format!(
        "restart the service, because its driver may have come later; if that does not help, add [Service] and \
         DeviceAllow={path} rw with \"sudo systemctl edit\""
    ))
}

/// The error number of a call that has just failed.
///
/// gpio-cdev hides the number in an error type from another version of nix. But it makes no system call between the
/// failed one and its own return. So the thread's errno is still the failed call's.
pub(super) fn errno(error: &gpio_cdev::Error) -> i32 {
    let last = io::Error::last_os_error().raw_os_error();
    error
        .source()
        .and_then(|source| source.downcast_ref::<io::Error>())
        .and_then(io::Error::raw_os_error)
        .or(last)
        .unwrap_or_default()
}

/// The meaning of an error number, in lower case, for use in a sentence.
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
        gpio17().refusal("an input", code, bias, consumer, release).to_string()
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
            "gpiochip0 line 17 (GPIO17) cannot have a pull-up resistor: Linux 5.4.83-v7l+ knows \
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
        let own = gpio17().lost("written", libc::ENODEV, false).cause;
        assert!(own.contains("can no longer be written: No such device") && own.contains("its chip or driver is gone"));
        let expander = gpio17().lost("read", libc::ENXIO, true).to_string();
        assert!(expander.contains("does not answer") && expander.contains("power and wiring"), "{expander}");
    }

    #[test]
    fn kernel_releases() {
        assert!(is_before("5.4.0", (5, 5)) && is_before("4.19.0-rc1", (5, 5)));
        assert!(!is_before("5.5.0", (5, 5)) && !is_before("6.1-rpi", (5, 5)));
        assert!(!is_before("", (5, 5)) && !is_before("six.one", (5, 5)));
    }

    #[test]
    fn a_forbidden_node_names_its_group() {
        let path = Path::new("/dev/gpiochip0");
        let text = |group: Option<&str>| {
            forbidden(path, &Opener { who: "pi".into(), group: group.map(str::to_owned) }).to_string()
        };
        assert_eq!(
            text(Some("gpio")),
            "pi may not open /dev/gpiochip0, which belongs to group gpio: \"sudo usermod -aG gpio pi\", log in \
             again, then restart Pinion"
        );
        assert!(text(None).contains("udev"));
    }

    /// No group helps there.
    #[test]
    fn a_node_that_the_service_forbids_is_not_a_matter_of_groups() {
        let text = |code| not_permitted(Path::new("/dev/spidev0.0"), code).to_string();
        assert!(text(libc::EACCES).contains("udev"));
        let forbidden = text(libc::EPERM);
        assert!(
            forbidden.contains("may not open /dev/spidev0.0, which the service's DeviceAllow= leaves out: restart")
        );
        assert!(forbidden.ends_with("DeviceAllow=/dev/spidev0.0 rw with \"sudo systemctl edit\""), "{forbidden}");
        assert!(!forbidden.contains("usermod") && !forbidden.contains("udev"), "{forbidden}");
    }

    #[test]
    fn a_file_s_group_helps_where_it_may_open_the_file_and_is_not_root_s() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let command = |mode: u32| {
            fs::set_permissions(file.path(), fs::Permissions::from_mode(mode)).unwrap();
            Opener::of(file.path()).command()
        };
        assert_eq!(command(0o600), None);
        // The tests may run as root, with root's group.
        let gid = fs::metadata(file.path()).unwrap().gid();
        assert_eq!(command(0o660).is_some(), gid != 0);
    }

    #[test]
    fn a_line_beyond_the_chip() {
        assert!(gpio17().beyond(8).cause.contains("no line 17, its lines are 0 to 7"));
    }
}
