// SPDX-License-Identifier: GPL-3.0-or-later
//! Devices whose failures a user tolerates for a time.
//!
//! While such a device fails, its last answers are repeated. This is for a room's thermometer, whose one lost answer would
//! end a print. It is not for a sensor that a heater depends on (docs/guide/safety.md).

use std::fmt;
use std::str::FromStr;

use crate::shutdown::{Shutdown, ShutdownReason};
use crate::time::{CLOCK_FREQ, Clock};

use super::Context;

/// Longest time, in seconds.
const SECONDS_MAX: u32 = 600;

/// A device that the host reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Device {
    /// A chip on an I2C bus of this number, at this address.
    I2c(u32, u8),
    /// A sensor on the 1-Wire bus, by its serial number.
    OneWire(String),
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Device, String> {
        let wrong = || "name a device such as i2c.1/0x76 or 28-0316b5f6a2ff".to_owned();
        let Some((bus, address)) = text.split_once('/') else {
            let is_serial = text.len() > 3 && text.bytes().all(|c| c.is_ascii_hexdigit() || c == b'-');
            return if is_serial { Ok(Device::OneWire(text.to_owned())) } else { Err(wrong()) };
        };
        let bus = bus.strip_prefix("i2c.").and_then(|bus| bus.parse().ok()).ok_or_else(wrong)?;
        let address = match address.strip_prefix("0x") {
            Some(hex) => u8::from_str_radix(hex, 16).ok(),
            None => address.parse().ok(),
        };
        address.filter(|address| *address < 0x80).map(|address| Device::I2c(bus, address)).ok_or_else(wrong)
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Device::I2c(bus, address) => write!(f, "i2c.{bus}/{address:#04x}"),
            Device::OneWire(serial) => f.write_str(serial),
        }
    }
}

/// How long the failures of a device are tolerated, in seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limit(u32);

impl FromStr for Limit {
    type Err = String;

    fn from_str(text: &str) -> Result<Limit, String> {
        let seconds = text.strip_suffix('s').and_then(|seconds| seconds.parse().ok());
        let seconds = seconds.filter(|seconds| (1..=SECONDS_MAX).contains(seconds));
        seconds.map(Limit).ok_or_else(|| format!("give a time from 1s to {SECONDS_MAX}s"))
    }
}

/// The devices that the user names, and how long the failures of each are tolerated.
pub type Tolerances = Vec<(Device, Limit)>;

/// The tolerance for one device.
pub struct Tolerance {
    limit: Limit,
    /// When the first failure came that is not over.
    since: Option<Clock>,
}

impl Tolerance {
    /// Each question to the device is answered again. Logs the end of a tolerated failure.
    pub fn works(&mut self, context: &mut Context, kind: &str, reason: ShutdownReason) {
        let Some(since) = self.since.take() else { return };
        let ms = context.now().since(since) / i64::from(CLOCK_FREQ / 1000);
        context.warn(kind, Shutdown::because(reason, format!("it answers again, after {ms} ms")));
    }

    /// Whether this failure is tolerated. `since` is when its question first failed. Other questions may have answers,
    /// so each question has a time of its own. Logs the first failure of the device.
    pub fn bears(
        &mut self,
        context: &mut Context,
        kind: &str,
        since: Clock,
        failure: impl FnOnce(&Context) -> Shutdown,
    ) -> bool {
        if context.now().since(since) > i64::from(self.limit.0) * i64::from(CLOCK_FREQ) {
            return false;
        }
        if self.since.is_some() {
            return true;
        }
        self.since = Some(since);
        let failure = failure(context);
        let mut trouble = failure.trouble.clone();
        trouble.cause =
            format!("{}: its last answers are repeated for up to {} s (tolerate)", trouble.cause, self.limit.0).into();
        context.warn(kind, Shutdown::because(failure.reason, trouble));
        true
    }

    /// Whether last answers are repeated.
    pub fn is_used(&self) -> bool {
        self.since.is_some()
    }
}

impl Context<'_> {
    /// The user's tolerance for a device, if there is one.
    pub fn tolerance(&self, device: &Device) -> Option<Tolerance> {
        let found = self.state.tolerances.iter().find(|(named, _)| named == device);
        found.map(|(_, limit)| Tolerance { limit: *limit, since: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_an_address_or_a_serial_number() {
        for (text, device) in [
            ("i2c.1/0x76", Device::I2c(1, 0x76)),
            ("i2c.0/118", Device::I2c(0, 118)),
            ("28-0316b5f6a2ff", Device::OneWire("28-0316b5f6a2ff".into())),
        ] {
            assert_eq!(text.parse(), Ok(device));
        }
        assert_eq!(Device::I2c(1, 0x76).to_string(), "i2c.1/0x76");
        for wrong in ["i2c.1", "i2c.1/0x80", "i2c.x/1", "1/0x76", "28/0316", "", "BME280", "i2c.1/"] {
            assert!(wrong.parse::<Device>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_limit_is_in_seconds() {
        assert_eq!("30s".parse(), Ok(Limit(30)));
        for wrong in ["0s", "601s", "30", "-1s", "1m", "s", "1.5s"] {
            assert!(wrong.parse::<Limit>().is_err(), "{wrong}");
        }
    }
}
