// SPDX-License-Identifier: GPL-3.0-or-later
//! The features of the machine, one file each, and the list of them all.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{Feature, Mcu, base};
use crate::shutdown::{Shutdown, ShutdownReason};
use crate::time::Ticks;
use crate::wire::format::same;

mod analog_in;
mod digital_out;
mod display;
mod endstop;
mod hd44780;
mod pace;
mod pwm_out;
mod spi;
mod st7920;
mod stepper;
mod tmcuart;
mod trsync;

/// Every feature. What is not listed is not in the dictionary.
pub const FEATURES: &[Feature] = &[
    base::FEATURE,
    analog_in::FEATURE,
    digital_out::FEATURE,
    endstop::FEATURE,
    hd44780::FEATURE,
    pwm_out::FEATURE,
    spi::FEATURE,
    st7920::FEATURE,
    stepper::FEATURE,
    tmcuart::FEATURE,
    trsync::FEATURE,
];

/// The place of a response in the list of all, found by the compiler.
const fn response_index(format: &str) -> usize {
    let mut index = 0;
    let mut feature = 0;
    while feature < FEATURES.len() {
        let responses = FEATURES[feature].responses;
        let mut response = 0;
        while response < responses.len() {
            if same(responses[response], format) {
                return index;
            }
            index += 1;
            response += 1;
        }
        feature += 1;
    }
    panic!("the response is not listed by any feature")
}

/// An output with a `max_duration` got no change in time.
#[cold]
fn not_refreshed(reason: ShutdownReason, max_duration: Ticks) -> Shutdown {
    let ms = max_duration.0 / Ticks::from_us(1000).0;
    Shutdown::because(
        reason,
        format!("it was not refreshed within its max_duration of {ms} ms: the host is overloaded or hangs"),
    )
}

/// An output with a `max_duration` is to change after it only.
#[cold]
fn changes_too_late(reason: ShutdownReason, max_duration: Ticks) -> Shutdown {
    let ms = max_duration.0 / Ticks::from_us(1000).0;
    Shutdown::by_host(reason, format_args!("its next change is scheduled later than its max_duration of {ms} ms"))
}

/// A pin is set without an object after `finalize_config`, and was not before.
#[cold]
fn set_too_late(mcu: &Mcu, reason: ShutdownReason, command: &str, pin: Pin) -> Shutdown {
    let name = mcu.name(pin);
    Shutdown::by_host(reason, format_args!("{command} wants {name} after finalize_config, and did not set it before"))
}
