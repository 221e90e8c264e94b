// SPDX-License-Identifier: GPL-3.0-or-later
//! Hardware PWM through sysfs (Documentation/ABI/testing/sysfs-class-pwm).

#![forbid(unsafe_code)]

use std::fmt::Write as _;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use super::attributes::{names, target, text};
use super::guard::SharedGuard;
use pinion_firmware::board::{self, PWM_MAX, PwmConfig};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::time::{NS_PER_TICK, Ticks};
use pinion_firmware::trouble::Trouble;

/// Highest number of channels of a chip. No chip has as many.
const CHANNELS_MAX: u32 = 256;
/// The files of a newly exported channel belong to root until udev has given them to the group.
const UDEV_TRIES: u32 = 50;
const UDEV_PAUSE: Duration = Duration::from_millis(10);

/// A PWM chip as it was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chip {
    /// The number of `pwmchip<n>`.
    pub number: u32,
    /// The device, such as `fe20c000.pwm`. Its name stays where a kernel numbers the chips differently.
    pub device: Option<String>,
    /// How many channels it has.
    pub channels: u32,
}

/// The chips of this computer by number. `class` is `/sys/class/pwm`.
pub(super) fn scan(class: &Path) -> Vec<Chip> {
    let chip = |name: &String| {
        let number = name.strip_prefix("pwmchip")?.parse().ok()?;
        let folder = class.join(name);
        let channels = text(&folder.join("npwm")).and_then(|count| count.parse().ok()).unwrap_or(0);
        Some(Chip { number, device: target(&folder.join("device")), channels: CHANNELS_MAX.min(channels) })
    };
    let mut chips: Vec<Chip> = names(class).iter().filter_map(chip).collect();
    chips.sort_by_key(|chip| chip.number);
    chips
}

/// A channel: `pwmchip<chip>/pwm<channel>`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Channel {
    pub(super) chip: u32,
    pub(super) channel: u32,
}

impl std::fmt::Display for Channel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "pwmchip{}/pwm{}", self.chip, self.channel)
    }
}

/// An exported channel, enabled unless its value is zero.
pub(super) struct Pwm {
    channel: Channel,
    period_ns: u64,
    period: File,
    duty: File,
    enable: File,
    guard: SharedGuard,
}

impl Pwm {
    /// Exports the channel if necessary, sets its period, gives it to the guardian, and sets its value. `class` is
    /// `/sys/class/pwm`.
    ///
    /// # Errors
    ///
    /// "Unable to config pwm device", "Guardian process lost".
    pub(super) fn open(
        class: &Path,
        channel: Channel,
        config: &PwmConfig,
        guard: SharedGuard,
    ) -> Result<Pwm, Shutdown> {
        let refused = |what: &str, error: io::Error| {
            Shutdown::because(reason::PWM_CONFIG, trouble(&error, format!("{what}: {error}")).of(channel))
        };
        if let Some(missing) = missing(class, channel) {
            return Err(Shutdown::because(reason::PWM_CONFIG, missing.of(channel)));
        }
        let folder = export(class, channel).map_err(|error| refused("exporting it", error))?;
        let open = |name: &str| {
            let file = OpenOptions::new().read(name == "period").write(true).open(folder.join(name));
            file.map_err(|error| refused(&format!("opening {name}"), error))
        };
        let (duty, enable, period) = (open("duty_cycle")?, open("enable")?, open("period")?);
        let mut pwm = Pwm { channel, period_ns: 0, period, duty, enable, guard };
        pwm.set_period(config.cycle, config.value)?;
        pwm.watch_over(config.shutdown_value.get())?;
        pwm.write(config.value).map_err(|error| refused("its first value", error))?;
        Ok(pwm)
    }

    /// Sets the period, on the way to a value. An output that is on stays on. Between the two writes it is on for a
    /// smaller part of the time than before or after. A longer period is written before its duty cycle, a shorter one
    /// after it. So the duty cycle is never longer than the period, which the kernel would refuse.
    fn set_period(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        self.period_ns = u64::from(cycle.0) * NS_PER_TICK;
        if self.period_ns < self.present_period_ns() {
            let duty = self.duty_ns(value);
            self.duty.write_all_at(duty.to_string().as_bytes(), 0).map_err(|error| self.not_configured(&error))?;
        }
        let written = self.period.write_all_at(self.period_ns.to_string().as_bytes(), 0);
        written.map_err(|error| self.not_configured(&error))
    }

    /// The channel's period so far, perhaps from another object or program. 0 if it has none.
    fn present_period_ns(&self) -> u64 {
        let mut text = [0; 24];
        let read = self.period.read_at(&mut text, 0).unwrap_or_default();
        str::from_utf8(&text[..read]).ok().and_then(|text| text.trim().parse().ok()).unwrap_or_default()
    }

    fn not_configured(&self, error: &io::Error) -> Shutdown {
        let cause = format!("a period of {} ns: {error}", self.period_ns);
        Shutdown::because(reason::PWM_CONFIG, trouble(error, cause).of(self.channel))
    }

    /// Gives the guardian the values of the channel for a program that dies.
    fn watch_over(&self, shutdown_value: u16) -> Result<(), Shutdown> {
        let name = self.channel.to_string();
        if shutdown_value == 0 {
            return self.guard.files(&name, &[(self.enable.as_raw_fd(), b"0")]);
        }
        let duty = self.duty_ns(shutdown_value).to_string();
        self.guard.files(&name, &[(self.duty.as_raw_fd(), duty.as_bytes()), (self.enable.as_raw_fd(), b"1")])
    }

    fn duty_ns(&self, value: u16) -> u64 {
        self.period_ns * u64::from(value.min(PWM_MAX)) / u64::from(PWM_MAX)
    }

    fn write(&mut self, value: u16) -> io::Result<()> {
        if value == 0 {
            return self.enable.write_all_at(b"0", 0);
        }
        let mut text = String::with_capacity(20);
        // Writing to a String does not fail.
        let _ = write!(text, "{}", self.duty_ns(value));
        self.duty.write_all_at(text.as_bytes(), 0)?;
        self.enable.write_all_at(b"1", 0)
    }
}

impl board::Pwm for Pwm {
    fn set(&mut self, value: u16) -> Result<(), Shutdown> {
        self.write(value).map_err(|error| {
            let trouble =
                Trouble::new(error.to_string()).remedy("check that its driver is still there (ls /sys/class/pwm)");
            Shutdown::because(reason::PWM_WRITE, trouble.of(self.channel))
        })
    }

    /// An output of `set_pwm_out` keeps its value when the MCU stops. So the guardian gets this value, too.
    fn set_cycle(&mut self, cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        self.set_period(cycle, value)?;
        self.watch_over(value)?;
        self.set(value)
    }
}

/// The folder of a channel that BeagleBone kernels have exported.
fn beaglebone(class: &Path, channel: Channel) -> PathBuf {
    class.join(format!("pwm-{}:{}", channel.chip, channel.channel))
}

/// The channel's folder. It is made if it is missing.
fn export(class: &Path, channel: Channel) -> io::Result<PathBuf> {
    let chip = class.join(format!("pwmchip{}", channel.chip));
    let folder = chip.join(format!("pwm{}", channel.channel));
    let other = beaglebone(class, channel);
    if other.exists() {
        return Ok(other);
    }
    if !folder.exists() {
        fs::write(chip.join("export"), channel.channel.to_string())?;
    }
    for _ in 0..UDEV_TRIES {
        match OpenOptions::new().write(true).open(folder.join("duty_cycle")) {
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => thread::sleep(UDEV_PAUSE),
            _ => break,
        }
    }
    Ok(folder)
}

/// Says that the chip is missing, and names those that exist. A kernel update may have given them other numbers.
fn missing(class: &Path, channel: Channel) -> Option<Trouble> {
    let chips = scan(class);
    let (first, number) = (chips.first()?, channel.chip);
    if chips.iter().any(|chip| chip.number == number) || beaglebone(class, channel).exists() {
        return None;
    }
    let chip = |chip: &Chip| format!("pwmchip{} ({})", chip.number, chip.device.as_deref().unwrap_or("no device"));
    let known: Vec<String> = chips.iter().map(chip).collect();
    let cause = format!("there is no pwmchip{number}: this computer has {}", known.join(", "));
    let name = first.device.clone().unwrap_or_else(|| format!("pwmchip{}", first.number));
    Some(
        Trouble::new(cause)
            .remedy(format!("write the chip by its device, such as {name}/pwm0 (pinion pins lists them)")),
    )
}

/// The meaning of an error beyond `cause`, and the remedy.
fn trouble(error: &io::Error, cause: String) -> Trouble {
    match (error.kind(), error.raw_os_error()) {
        (io::ErrorKind::NotFound, _) => Trouble::new(cause)
            .remedy("enable the PWM in the device tree (dtoverlay=pwm); ls /sys/class/pwm lists the chips"),
        (io::ErrorKind::PermissionDenied, _) => {
            Trouble::new(cause).remedy("run Pinion as root, or install its udev rules and join the group gpio")
        }
        (_, Some(libc::EBUSY)) => {
            Trouble::new(format!("{cause}: a driver of the kernel uses it")).remedy("choose another channel")
        }
        (_, Some(libc::EINVAL | libc::ERANGE)) => Trouble::new(format!("{cause}: the chip cannot do that"))
            .remedy("choose another cycle_time or another channel"),
        _ => Trouble::new(cause),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::guard::tests::{Fake, Seen};
    use pinion_firmware::board::{Pin, Pwm as _, ShutdownValue};
    use std::sync::{Arc, Mutex};

    const CHANNEL: Channel = Channel { chip: 0, channel: 1 };

    fn config(value: u16) -> PwmConfig {
        PwmConfig { pin: Pin(65537), cycle: Ticks::from_ms(1), value, shutdown_value: ShutdownValue::default() }
    }

    fn class(exported: bool) -> tempfile::TempDir {
        let class = tempfile::tempdir().unwrap();
        let folder = class.path().join("pwmchip0/pwm1");
        fs::create_dir_all(&folder).unwrap();
        fs::write(class.path().join("pwmchip0/export"), "").unwrap();
        for name in ["period", "duty_cycle", "enable"] {
            fs::write(folder.join(name), "").unwrap();
        }
        if !exported {
            fs::remove_dir_all(folder).unwrap();
        }
        class
    }

    fn open(class: &tempfile::TempDir, value: u16) -> Result<Pwm, Shutdown> {
        Pwm::open(class.path(), CHANNEL, &config(value), SharedGuard::new(None))
    }

    fn read(class: &tempfile::TempDir, name: &str) -> String {
        fs::read_to_string(class.path().join("pwmchip0/pwm1").join(name)).unwrap()
    }

    #[test]
    fn a_value_becomes_a_duty_cycle_and_zero_switches_off() {
        let class = class(true);
        let mut pwm = open(&class, 8192).unwrap();
        let state = |name| read(&class, name);
        assert_eq!(
            (state("period"), state("duty_cycle"), state("enable")),
            ("1000000".into(), "250000".into(), "1".into())
        );
        pwm.set(32768).unwrap();
        assert_eq!(state("duty_cycle"), "1000000");
        pwm.set(0).unwrap();
        assert_eq!(state("enable"), "0");
    }

    #[test]
    fn a_channel_that_the_guardian_does_not_take_is_not_switched_on() {
        let class = class(true);
        let lost = Fake(Arc::new(Mutex::new(Seen { refuses: true, ..Seen::default() })));
        let error = Pwm::open(class.path(), CHANNEL, &config(8192), SharedGuard::new(Some(Box::new(lost))));
        assert_eq!(error.err().unwrap().reason, reason::GUARDIAN_LOST);
        assert_eq!((read(&class, "duty_cycle"), read(&class, "enable")), (String::new(), String::new()));
    }

    #[test]
    fn a_value_may_come_with_a_new_period() {
        let class = class(true);
        let mut pwm = open(&class, 8192).unwrap();
        pwm.set_cycle(Ticks::from_ms(2), 16384).unwrap();
        assert_eq!((read(&class, "period"), read(&class, "duty_cycle")), ("2000000".into(), "1000000".into()));
    }

    /// The tests on kernel drivers show in which order the files are written.
    #[test]
    fn a_shorter_period_may_come_with_any_value() {
        for value in [0, 1, 8192, 32768] {
            let class = class(true);
            let mut pwm = open(&class, 32768).unwrap();
            assert_eq!(pwm.present_period_ns(), 1_000_000);
            pwm.set_cycle(Ticks::from_us(100), value).unwrap();
            let duty = (100_000 * u64::from(value) / 32768).to_string();
            // (A shorter number does not replace the rest of a file, so the rest stays.)
            assert!(read(&class, "duty_cycle").starts_with(&duty) && read(&class, "period").starts_with("100000"));
            assert!(read(&class, "enable").starts_with(if value == 0 { '0' } else { '1' }));
        }
    }

    #[test]
    fn a_channel_that_is_not_there_is_exported_and_its_absence_is_explained() {
        let class = class(false);
        let error = open(&class, 1).err().unwrap();
        assert_eq!(fs::read_to_string(class.path().join("pwmchip0/export")).unwrap(), "1");
        let text = error.to_string();
        assert!(text.contains("pwmchip0/pwm1") && text.contains("device tree"), "{text}");
    }

    /// A Raspberry Pi 5 whose header's PWM was pwmchip2 before Linux 6.12.
    #[test]
    fn a_chip_that_is_not_there_names_those_that_are() {
        let class = tempfile::tempdir().unwrap();
        let open = |chip| {
            let channel = Channel { chip, channel: 2 };
            Pwm::open(class.path(), channel, &config(0), SharedGuard::new(None)).err().unwrap().to_string()
        };
        assert!(open(2).contains("dtoverlay=pwm"), "there is none");
        fs::create_dir_all(class.path().join("pwmchip0")).unwrap();
        fs::write(class.path().join("pwmchip0/npwm"), "4\n").unwrap();
        std::os::unix::fs::symlink("../../../1f00098000.pwm", class.path().join("pwmchip0/device")).unwrap();
        assert_eq!(
            open(2),
            "Unable to config pwm device: pwmchip2/pwm2: there is no pwmchip2: this computer has pwmchip0 \
             (1f00098000.pwm): write the chip by its device, such as 1f00098000.pwm/pwm0 (pinion pins lists them)"
        );
        let found = scan(class.path());
        assert_eq!(found, [Chip { number: 0, device: Some("1f00098000.pwm".into()), channels: 4 }]);
    }
}
