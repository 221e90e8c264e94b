// SPDX-License-Identifier: GPL-3.0-or-later
//! The features of the machine, one file each, and the list of them all.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{Feature, Mcu, base};
use crate::shutdown::{Shutdown, ShutdownReason};
use crate::time::Ticks;
use crate::wire::format::same;

mod adxl345;
mod analog_in;
mod bmi160;
mod digital_out;
mod endstop;
mod fifo_sensor;
mod i2c;
mod icm20948;
mod lis2dw;
mod mpu9250;
mod pwm_out;
mod sensor_bulk;
mod spi;
mod spi_angle;
mod stepper;
mod trsync;

/// Every feature. What is not listed is not in the dictionary.
pub const FEATURES: &[Feature] = &[
    base::FEATURE,
    digital_out::FEATURE,
    pwm_out::FEATURE,
    stepper::FEATURE,
    endstop::FEATURE,
    trsync::FEATURE,
    analog_in::FEATURE,
    spi::FEATURE,
    adxl345::FEATURE,
    bmi160::FEATURE,
    fifo_sensor::FEATURE,
    i2c::FEATURE,
    icm20948::FEATURE,
    lis2dw::FEATURE,
    mpu9250::FEATURE,
    sensor_bulk::FEATURE,
    spi_angle::FEATURE,
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
