// SPDX-License-Identifier: GPL-3.0-or-later
//! The features of the MCU, one file each, and the list of all features.

use crate::board::{Bias, Pin, Range};
use crate::mcu::{Context, Feature, base, place_of_response};
use crate::shutdown::{Shutdown, ShutdownReason};
use crate::time::Ticks;

mod ads1220;
mod ads131m0x;
mod adxl345;
mod analog_in;
mod bmi160;
mod buttons;
pub mod canbus;
mod counter;
mod digital_out;
mod display;
mod ds18b20;
mod endstop;
#[cfg(test)]
#[path = "../../tests/example/mod.rs"]
mod example;
mod fifo_sensor;
mod hd44780;
mod hx71x;
mod i2c;
mod ldc1612;
mod lis2dw;
mod load_cell_probe;
mod mpu9250;
mod neopixel;
mod pace;
mod pca9685;
mod pwm_out;
mod ready_adc;
mod sensor_bulk;
mod sos_filter;
mod spi;
mod spi_angle;
mod st7920;
mod stepper;
mod thermocouple;
mod tmcuart;
mod trigger_analog;
mod trsync;
mod value_queue;

/// Every feature. A feature that is missing here is not in the dictionary. Features with frequent commands come first:
/// ids are given in this order, and there are more messages than ids of one byte.
pub const FEATURES: &[Feature] = &[
    base::FEATURE,
    stepper::FEATURE,
    trsync::FEATURE,
    digital_out::FEATURE,
    pwm_out::FEATURE,
    endstop::FEATURE,
    analog_in::FEATURE,
    spi::FEATURE,
    i2c::FEATURE,
    tmcuart::FEATURE,
    ads1220::FEATURE,
    ads131m0x::FEATURE,
    adxl345::FEATURE,
    bmi160::FEATURE,
    buttons::FEATURE,
    canbus::FEATURE,
    counter::FEATURE,
    ds18b20::FEATURE,
    fifo_sensor::FEATURE,
    hd44780::FEATURE,
    hx71x::FEATURE,
    mpu9250::ICM20948,
    ldc1612::FEATURE,
    lis2dw::FEATURE,
    load_cell_probe::FEATURE,
    mpu9250::FEATURE,
    neopixel::FEATURE,
    pca9685::FEATURE,
    sensor_bulk::FEATURE,
    sos_filter::FEATURE,
    spi_angle::FEATURE,
    st7920::FEATURE,
    thermocouple::FEATURE,
    trigger_analog::FEATURE,
];

/// The index of a response in the list of all responses, computed by the compiler.
const fn response_index(format: &str) -> usize {
    place_of_response(FEATURES, format)
}

/// The names of an enumeration that is the same on every board.
fn named(values: &[(&str, u8)]) -> Vec<Range> {
    values.iter().map(|&(name, value)| Range { name: name.into(), first: value.into(), count: 1 }).collect()
}

/// The resistor for a command's `pull_up`.
fn bias(pull_up: i8) -> Bias {
    match pull_up {
        1.. => Bias::PullUp,
        0 => Bias::None,
        _ => Bias::PullDown,
    }
}

/// The shutdown for an output whose `max_duration` ran out before the host changed it again.
#[cold]
fn not_refreshed(reason: ShutdownReason, max_duration: Ticks) -> Shutdown {
    let ms = max_duration.0 / Ticks::from_us(1000).0;
    Shutdown::because(
        reason,
        format!("it was not refreshed within its max_duration of {ms} ms: the host is overloaded or hangs"),
    )
}

/// The shutdown for an output whose next change is queued for later than its `max_duration` allows.
#[cold]
fn changes_too_late(reason: ShutdownReason, max_duration: Ticks) -> Shutdown {
    let ms = max_duration.0 / Ticks::from_us(1000).0;
    Shutdown::by_host(reason, format_args!("its next change is scheduled later than its max_duration of {ms} ms"))
}

/// The shutdown for a `set_digital_out` or `set_pwm_out` that names a new pin after `finalize_config`.
#[cold]
fn set_too_late(context: &Context, reason: ShutdownReason, command: &str, pin: Pin) -> Shutdown {
    let name = context.name(pin);
    Shutdown::by_host(reason, format_args!("{command} sets {name} after finalize_config, but must set it before"))
}
