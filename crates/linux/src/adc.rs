// SPDX-License-Identifier: GPL-3.0-or-later
//! ADC channels of the Industrial I/O subsystem, through libiio.
//!
//! A worker for each IIO device takes the readings. A reading may take milliseconds, because the driver talks to its
//! chip.

#![forbid(unsafe_code)]

use std::fmt;
use std::fs;
use std::path::Path;

use industrial_io::{Backend, Context};

use crate::LOOK_AT_LOG;
use pinion_firmware::board::{self, ADC_MAX};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::trouble::Trouble;

/// The format that the C program assumes for every channel. Here it is for channels that do not report one.
const ASSUMED: Format = Format { bits: 12, signed: false };

/// An IIO device with voltage inputs.
#[derive(Clone, Debug)]
pub struct IioDevice {
    /// The number of `iio:device<n>`.
    pub number: u32,
    /// The driver's name, such as `mcp3208`.
    pub name: String,
    /// The device tree's label.
    pub label: Option<String>,
    /// Its voltage inputs.
    pub channels: Vec<Channel>,
}

/// A voltage input.
#[derive(Clone, Debug)]
pub struct Channel {
    /// The driver's name for it, such as `voltage3` or `voltage0-voltage1`.
    pub id: String,
    /// The resolution, if the driver reports it.
    pub format: Option<Format>,
}

/// The resolution of a channel's raw readings, and whether they have a sign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Format {
    bits: u32,
    signed: bool,
}

impl Format {
    /// A format of 1 to 64 bits (signed: 2 to 64). `None` for another number.
    pub fn new(bits: u32, signed: bool) -> Option<Format> {
        (1 + u32::from(signed)..=64).contains(&bits).then_some(Format { bits, signed })
    }

    /// Converts a raw reading to counts of 0 to [`ADC_MAX`], rounded to the nearest. A raw reading out of range is
    /// clamped, a negative one to 0.
    pub(super) fn scale(self, raw: i64) -> u16 {
        let full = (1i128 << (self.bits - u32::from(self.signed))) - 1;
        let raw = i128::from(raw).clamp(0, full);
        let scaled = (raw * i128::from(ADC_MAX) + full / 2) / full;
        u16::try_from(scaled).unwrap_or(ADC_MAX)
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = if self.signed { "signed " } else { "" };
        write!(f, "{sign}{} bits", self.bits)
    }
}

/// libiio's view of this computer. `None` without IIO devices: libiio would take memory for nothing.
pub(super) fn context(devices: &Path) -> Result<Option<Context>, Trouble> {
    let any = fs::read_dir(devices)
        .into_iter()
        .flatten()
        .flatten()
        .any(|entry| entry.file_name().to_string_lossy().starts_with("iio:device"));
    if !any {
        return Ok(None);
    }
    Context::with_backend(Backend::Local).map(Some).map_err(|error| {
        Trouble::new(format!("the IIO devices in {} cannot be read: {error}", devices.display())).remedy(LOOK_AT_LOG)
    })
}

/// The ADCs in the order of their numbers.
pub(super) fn scan(context: &Context) -> Vec<IioDevice> {
    let mut adcs: Vec<IioDevice> = context
        .devices()
        .filter_map(|device| {
            let number = number(&device)?;
            let mut channels: Vec<Channel> = device
                .channels()
                .filter_map(|channel| Some(Channel { id: input_id(&channel)?, format: format(&channel) }))
                .collect();
            channels.sort_by_cached_key(|channel| in_order(&channel.id));
            (!channels.is_empty()).then(|| IioDevice {
                number,
                name: device.name().unwrap_or_default(),
                label: device.label(),
                channels,
            })
        })
        .collect();
    adcs.sort_by_key(|adc| adc.number);
    adcs
}

/// A key that sorts `voltage10` after `voltage9`. A channel's position is part of its pin number, so it must always be
/// the same. libiio's own order is the order of the directory, which varies.
fn in_order(id: &str) -> (u32, String) {
    let digits = id.trim_start_matches(|c: char| !c.is_ascii_digit());
    let end = digits.find(|c: char| !c.is_ascii_digit()).unwrap_or(digits.len());
    (digits[..end].parse().unwrap_or(u32::MAX), id.to_owned())
}

fn number(device: &industrial_io::Device) -> Option<u32> {
    device.id()?.strip_prefix("iio:device")?.parse().ok()
}

/// The driver's name for a channel that is a voltage input and can be read one reading at a time. `None` for any other
/// channel.
fn input_id(channel: &industrial_io::Channel) -> Option<String> {
    let id = channel.id()?;
    (channel.is_input() && id.starts_with("voltage") && channel.has_attr("raw")).then_some(id)
}

fn format(channel: &industrial_io::Channel) -> Option<Format> {
    // Only a channel that can also be read through a buffer (a "scan element") reports its format.
    let format = channel.is_scan_element().then(|| channel.data_format())?;
    Format::new(format.bits(), format.is_signed())
}

/// An open channel.
pub struct ChannelReader {
    device: industrial_io::Device,
    index: usize,
    format: Option<Format>,
    subject: String,
}

impl ChannelReader {
    /// Opens the channel that the driver of `iio:device<number>` calls `id`, if it exists.
    pub(super) fn open(context: &Context, number: u32, id: &str) -> Option<ChannelReader> {
        let device = context.devices().find(|d| self::number(d) == Some(number))?;
        let (index, channel) =
            device.channels().enumerate().find(|(_, channel)| input_id(channel).as_deref() == Some(id))?;
        let name = device.name().unwrap_or_default();
        Some(ChannelReader {
            index,
            format: format(&channel),
            subject: format!("iio:device{number} ({name}) {id}"),
            device,
        })
    }

    /// The resolution, if the driver reports it.
    pub(super) fn format(&self) -> Option<Format> {
        self.format
    }

    /// A reading as the driver gives it, in the units of [`ChannelReader::format`].
    ///
    /// # Errors
    ///
    /// The errors of libiio.
    pub fn read_raw(&self) -> Result<i64, industrial_io::Error> {
        self.device.get_channel(self.index)?.attr_read_int("raw")
    }

    /// A reading in counts of 0 to [`ADC_MAX`].
    ///
    /// # Errors
    ///
    /// "Error on analog read".
    pub fn read_counts(&self) -> Result<u16, Shutdown> {
        match self.read_raw() {
            Ok(raw) => Ok(self.format.unwrap_or(ASSUMED).scale(raw)),
            Err(error) => Err(Shutdown::because(reason::ADC_READ, read_failure(&self.subject, &error.to_string()))),
        }
    }
}

impl board::Adc for ChannelReader {
    fn read(&mut self) -> Result<u16, Shutdown> {
        self.read_counts()
    }
}

fn read_failure(subject: &str, error: &str) -> Trouble {
    let remedy = if error.starts_with("EBUSY") {
        "another program has its buffer enabled, stop it"
    } else {
        "check the chip's wiring and supply, and the kernel's log (dmesg)"
    };
    Trouble::new(format!("{subject} cannot be read: {error}")).remedy(remedy)
}

/// Says that a channel is missing, and lists those that exist.
pub(super) fn missing(number: u32, id: &str, adcs: &[IioDevice]) -> Trouble {
    let known: Vec<String> = adcs
        .iter()
        .map(|adc| {
            let ids: Vec<&str> = adc.channels.iter().map(|c| c.id.as_str()).collect();
            format!("iio:device{} ({}: {})", adc.number, adc.name, ids.join(" "))
        })
        .collect();
    let known = match known.is_empty() {
        true => "no ADC that the kernel knows of".to_owned(),
        false => known.join(", "),
    };
    Trouble::new(format!("there is no {id} on iio:device{number}: this computer has {known}"))
        .remedy("load the driver (a device tree overlay, as a rule), or choose another pin (pinion pins lists them)")
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn scaled(bits: u32, signed: bool, raw: i64) -> u16 {
        Format::new(bits, signed).unwrap().scale(raw)
    }

    #[test]
    fn usual_resolutions() {
        assert_eq!(scaled(8, false, 255), 4095);
        assert_eq!(scaled(8, false, 128), 2056);
        assert_eq!(scaled(10, false, 1023), 4095);
        assert_eq!(scaled(16, false, 32768), 2048);
        assert_eq!(scaled(24, false, 1 << 23), 2048);
        assert_eq!(scaled(16, true, 32767), 4095);
        assert_eq!(scaled(16, true, -5), 0);
        assert_eq!(scaled(12, true, 2047), 4095);
        assert_eq!(scaled(64, false, i64::MAX), 2047);
        assert_eq!(scaled(64, true, i64::MAX), 4095);
    }

    #[test]
    fn formats_that_count_nothing() {
        assert_eq!(Format::new(0, false), None);
        assert_eq!(Format::new(1, true), None);
        assert_eq!(Format::new(65, false), None);
        assert_eq!(scaled(1, false, 1), 4095);
    }

    #[test]
    fn channels_in_order() {
        let mut ids = ["voltage10", "voltage0-voltage1", "voltage9", "voltage0", "voltage"];
        ids.sort_by_key(|id| in_order(id));
        let sorted = ["voltage0", "voltage0-voltage1", "voltage9", "voltage10", "voltage"];
        assert_eq!(ids, sorted);
    }

    #[test]
    fn texts() {
        assert_eq!(
            read_failure("iio:device0 (ads1115) voltage3", "EIO: I/O error").to_string(),
            "iio:device0 (ads1115) voltage3 cannot be read: EIO: I/O error: check the chip's \
             wiring and supply, and the kernel's log (dmesg)"
        );
        let adc = IioDevice {
            number: 1,
            name: "mcp3008".into(),
            label: None,
            channels: ["voltage0", "voltage1"].map(|id| Channel { id: id.into(), format: None }).into(),
        };
        let text = missing(0, "voltage2", &[adc]).cause;
        assert!(text.contains("iio:device1 (mcp3008: voltage0 voltage1)"), "{text}");
        assert!(missing(0, "voltage2", &[]).cause.contains("no ADC that the kernel knows of"));
    }

    proptest! {
        #[test]
        fn twelve_bits_stay_as_they_are(raw in 0i64..4096) {
            prop_assert_eq!(scaled(12, false, raw), raw as u16);
        }

        #[test]
        fn any_reading_is_within_range_and_in_order(
            bits in 2u32..=64, signed: bool, a: i64, b: i64
        ) {
            let format = Format::new(bits, signed).unwrap();
            let (low, high) = (a.min(b), a.max(b));
            prop_assert!(format.scale(low) <= format.scale(high));
            prop_assert!(format.scale(high) <= ADC_MAX);
        }

        #[test]
        fn the_share_of_full_scale_is_kept(bits in 8u32..=32, signed: bool, share in 0.0f64..=1.0) {
            let full = ((1u64 << (bits - u32::from(signed))) - 1) as f64;
            let raw = (full * share).round();
            let exact = raw / full * f64::from(ADC_MAX);
            prop_assert!((f64::from(scaled(bits, signed, raw as i64)) - exact).abs() <= 0.500_001);
        }
    }
}
