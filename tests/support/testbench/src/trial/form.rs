// SPDX-License-Identifier: GPL-3.0-or-later
//! A command with its arguments.

#![forbid(unsafe_code)]

use pinion_firmware::time::CLOCK_FREQ;
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::Writer;

use crate::board::{ANALOG, MOSI, PWM, SPI_CHIPS};
use crate::rig::Rig;

/// Values at which something might break.
#[rustfmt::skip]
pub(super) const EXTREMES: &[u32] = &[
    0, 1, u32::MAX, 2, 7, 8, 15, 16, 48, 49, 63, 64, 127, 128, 255, 256, 4096, 4097, 32767, 32768, 65535, 65536,
    (1 << 31) - 1, 1 << 31, (1 << 31) + 1, u32::MAX - 1,
];
/// Pins of every kind, also of an expander, and numbers that might break something.
#[rustfmt::skip]
pub(super) const PINS: &[u32] = &[
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24,
    EXPANDED, EXPANDED + 1, EXPANDED + 2, EXPANDED + 3, ANALOG, ANALOG + 1, ANALOG + 2, PWM, PWM + 1, MOSI, MOSI + 1,
    SPI_CHIPS, SPI_CHIPS + 1, 300, 255, u32::MAX,
];
/// Spans that a worker waits for between two edges. They are short here: the bench runs a job to its end at once
/// and cannot interrupt it, as a stop does.
const PACED: &[&str] = &["delay_ticks", "sync_delay_ticks", "cmd_delay_ticks", "pulse_ticks", "bit_time"];
const PACED_TICKS: u32 = 500;
/// The first line of the expander.
pub(super) const EXPANDED: u32 = 280;

/// An argument that can be sent at any time.
#[derive(Clone, Debug)]
pub(super) enum Value {
    Number(u32),
    /// A time, in ticks from now.
    Soon(u32),
    Bytes(Vec<u8>),
}

/// A command of the dictionary.
pub(super) struct Form {
    pub(super) format: String,
    pub(super) id: u32,
    pub(super) parameters: Vec<(String, Conversion)>,
}

impl Form {
    pub(super) fn name(&self) -> &str {
        format::name(&self.format)
    }

    pub(super) fn configures(&self) -> bool {
        self.name().starts_with("config_") && self.name() != "config_reset"
    }

    /// The message, without the bytes that do not fit.
    pub(super) fn encode(&self, rig: &Rig, values: &[Value]) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.int(self.id);
        // An integer takes at most five bytes, the length of a string one.
        let sizes = self.parameters.iter().map(|(_, conversion)| if *conversion == Conversion::Bytes { 1 } else { 5 });
        let mut room = PAYLOAD_MAX - 2 - sizes.sum::<usize>().min(PAYLOAD_MAX - 2);
        for (value, (name, _)) in values.iter().zip(&self.parameters) {
            match value {
                Value::Number(number) if PACED.contains(&name.as_str()) => writer.int(*number % PACED_TICKS),
                Value::Number(number) if name == "rate" => writer.int((*number).max(CLOCK_FREQ / PACED_TICKS)),
                Value::Number(number) => writer.int(*number),
                Value::Soon(ticks) => writer.int(rig.wire_clock().wrapping_add(*ticks)),
                Value::Bytes(bytes) => {
                    let len = bytes.len().min(room);
                    room -= len;
                    writer.string(&bytes[..len]);
                }
            }
        }
        writer.payload().unwrap().to_vec()
    }

    /// The pins in its arguments.
    pub(super) fn pins<'a>(&'a self, values: &'a [Value]) -> impl Iterator<Item = u32> + 'a {
        self.parameters.iter().zip(values).filter_map(|((name, _), value)| match value {
            Value::Number(number) if is_pin(name) => Some(*number),
            _ => None,
        })
    }

    pub(super) fn argument(&self, values: &[Value], name: &str) -> Option<u32> {
        let place = self.parameters.iter().position(|(parameter, _)| parameter == name)?;
        match values[place] {
            Value::Number(number) => Some(number),
            _ => None,
        }
    }
}

pub(super) fn is_pin(parameter: &str) -> bool {
    parameter == "pin" || parameter.ends_with("_pin")
}
