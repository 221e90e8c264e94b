// SPDX-License-Identifier: GPL-3.0-or-later
//! The parts. Each is a file with its description, its wires, its behavior and its sections of printer.cfg. A part uses
//! the engine and the types of descriptions. It uses no other part.

pub(crate) mod accelerometer;
pub(crate) mod ads1220;
pub(crate) mod angle;
pub(crate) mod apa102;
pub(crate) mod bltouch;
pub(crate) mod ds18b20;
pub(crate) mod hx71x;
pub(crate) mod i2c_register;
pub(crate) mod i2c_sensor;
pub(crate) mod ldc1612;
pub(crate) mod load_cell;
pub(crate) mod loopback;
pub(crate) mod probe;
pub(crate) mod pwm_channel;
pub(crate) mod ready;
pub(crate) mod servo;
pub(crate) mod spi_dac;
pub(crate) mod spool;
pub(crate) mod ssd1306;
pub(crate) mod thermocouple;
pub(crate) mod tmc2209;
pub(crate) mod tmc2660;
pub(crate) mod tmc5160;
pub(crate) mod trinamic;
pub(crate) mod uart;
pub(crate) mod workshop;
pub(crate) mod ws2812;
