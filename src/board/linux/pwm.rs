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

use crate::board::{Buffer, Device, Guard, PwmConfig};
use crate::shutdown::{Reason, Shutdown};
use crate::time::{NS_PER_TICK, Ticks};

/// Full scale of a PWM value (`PWM_MAX`), as the C program has it.
const PWM_MAX: u64 = 1 << 15;
/// udev needs a moment to hand the files of a new channel to the group.
const UDEV_TRIES: u32 = 50;
const UDEV_PAUSE: Duration = Duration::from_millis(10);

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
}

impl Pwm {
    /// Exports the channel if nobody did, sets its period and value. `class` is
    /// `/sys/class/pwm`.
    pub(super) fn open(class: &Path, channel: Channel, config: &PwmConfig) -> Result<Pwm, Shutdown> {
        let refused = |what: &str, error: io::Error| {
            Shutdown::because(Reason::PwmConfig, format!("{channel}: {what}: {error}{}", remedy(&error)))
        };
        let folder = export(class, channel).map_err(|error| refused("exporting it", error))?;
        let open = |name: &str| OpenOptions::new().write(true).open(folder.join(name));
        let duty = open("duty_cycle").map_err(|error| refused("opening duty_cycle", error))?;
        let enable = open("enable").map_err(|error| refused("opening enable", error))?;
        let period = open("period").map_err(|error| refused("opening period", error))?;
        let mut pwm = Pwm { channel, period_ns: 0, period, duty, enable };
        pwm.set_period(config.cycle)?;
        pwm.set(config.value).map_err(|error| refused("its first value", error))?;
        Ok(pwm)
    }

    fn set_period(&mut self, cycle: Ticks) -> Result<(), Shutdown> {
        self.period_ns = u64::from(cycle.0) * NS_PER_TICK;
        // A period below the present duty cycle is refused: zero that first.
        let _ = self.duty.write_at(b"0", 0);
        self.period.write_all_at(self.period_ns.to_string().as_bytes(), 0).map_err(|error| {
            let detail = format!("{}: a period of {} ns: {error}{}", self.channel, self.period_ns, remedy(&error));
            Shutdown::because(Reason::PwmConfig, detail)
        })
    }

    /// Lets the guardian know where the channel belongs if the program dies.
    pub(super) fn guard(&self, guard: &mut dyn Guard, shutdown_value: u16) -> io::Result<()> {
        let name = self.channel.to_string();
        if shutdown_value == 0 {
            return guard.files(&name, &[(self.enable.as_raw_fd(), b"0")]);
        }
        let duty = self.duty_ns(shutdown_value).to_string();
        guard.files(&name, &[(self.duty.as_raw_fd(), duty.as_bytes()), (self.enable.as_raw_fd(), b"1")])
    }

    fn duty_ns(&self, value: u16) -> u64 {
        self.period_ns * u64::from(value).min(PWM_MAX) / PWM_MAX
    }

    fn set(&mut self, value: u16) -> io::Result<()> {
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

impl Device for Pwm {
    fn run(&mut self, data: &mut Buffer) -> Result<(), Shutdown> {
        let (low, high) = match *data.as_slice() {
            [low, high] => (low, high),
            [low, high, c0, c1, c2, c3] => {
                self.set_period(Ticks(u32::from_le_bytes([c0, c1, c2, c3])))?;
                (low, high)
            }
            _ => return Ok(()),
        };
        self.set(u16::from_le_bytes([low, high])).map_err(|error| {
            let detail = format!("{}: {error}: did its driver go away? (ls /sys/class/pwm)", self.channel);
            Shutdown::because(Reason::PwmWrite, detail)
        })
    }
}

/// The channel's folder; BeagleBone kernels name it otherwise.
fn export(class: &Path, channel: Channel) -> io::Result<PathBuf> {
    let chip = class.join(format!("pwmchip{}", channel.chip));
    let folder = chip.join(format!("pwm{}", channel.channel));
    let other = class.join(format!("pwm-{}:{}", channel.chip, channel.channel));
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

fn remedy(error: &io::Error) -> &'static str {
    match (error.kind(), error.raw_os_error()) {
        (io::ErrorKind::NotFound, _) => {
            ": enable the PWM in the device tree (dtoverlay=pwm); ls /sys/class/pwm lists the chips"
        }
        (io::ErrorKind::PermissionDenied, _) => {
            ": run Pinion as root, or install its udev rules and join the group gpio"
        }
        (_, Some(libc::EBUSY)) => ": a driver of the kernel uses it; choose another channel",
        (_, Some(libc::EINVAL | libc::ERANGE)) => {
            ": the chip can not do that; choose another cycle_time or another channel"
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Pin;

    const CHANNEL: Channel = Channel { chip: 0, channel: 1 };

    fn config(value: u16) -> PwmConfig {
        PwmConfig { pin: Pin(65537), cycle: Ticks::from_us(1000), value, shutdown_value: 0 }
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

    fn read(class: &tempfile::TempDir, name: &str) -> String {
        fs::read_to_string(class.path().join("pwmchip0/pwm1").join(name)).unwrap()
    }

    #[test]
    fn a_value_becomes_a_duty_cycle_and_zero_switches_off() {
        let class = class(true);
        let mut pwm = Pwm::open(class.path(), CHANNEL, &config(8192)).unwrap();
        let state = |name| read(&class, name);
        assert_eq!(
            (state("period"), state("duty_cycle"), state("enable")),
            ("1000000".into(), "250000".into(), "1".into())
        );
        pwm.run(&mut Buffer::new(&32768u16.to_le_bytes())).unwrap();
        assert_eq!(state("duty_cycle"), "1000000");
        pwm.run(&mut Buffer::new(&0u16.to_le_bytes())).unwrap();
        assert_eq!(state("enable"), "0");
    }

    #[test]
    fn a_value_may_come_with_a_new_period() {
        let class = class(true);
        let mut pwm = Pwm::open(class.path(), CHANNEL, &config(8192)).unwrap();
        let [c0, c1, c2, c3] = Ticks::from_us(2000).0.to_le_bytes();
        pwm.run(&mut Buffer::new(&[0, 64, c0, c1, c2, c3])).unwrap();
        assert_eq!((read(&class, "period"), read(&class, "duty_cycle")), ("2000000".into(), "1000000".into()));
    }

    #[test]
    fn a_channel_that_is_not_there_is_exported_and_its_absence_is_explained() {
        let class = class(false);
        let error = Pwm::open(class.path(), CHANNEL, &config(1)).err().unwrap();
        assert_eq!(fs::read_to_string(class.path().join("pwmchip0/export")).unwrap(), "1");
        let text = error.to_string();
        assert!(text.contains("pwmchip0/pwm1") && text.contains("device tree"), "{text}");
    }
}
