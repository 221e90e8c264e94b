// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated printer, described in TOML: axes that count steps and close endstops, heaters with a mass and a
//! thermistor, fans with a tachometer, lights.
//!
//! It runs under a real host in real time, and in tests in virtual time. The state between two writes is calculated
//! exactly from the clock.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]
#![cfg_attr(not(test), warn(clippy::unwrap_used, clippy::expect_used, clippy::todo))]

mod board;
mod catalog;
mod config;
mod description;
mod engine;
mod klippy;
mod part;
mod printer_cfg;
mod toolpath;
mod view;

pub use board::{SimBoard, SimWorld};
pub use catalog::PartConfig;
pub use config::SimConfig;
pub use description::axes::{AxisConfig, BedConfig, CarriageConfig, DeltaConfig, End, Limits};
pub use description::boards::{ConstantValue, MCUS_MAX, McuConfig};
pub use description::buses::{I2cBusConfig, SpiBusConfig};
pub use description::heater::{FanConfig, HeaterConfig};
pub use description::kinematics::{DeltesianConfig, KinematicsConfig, NoKeys, RotaryDeltaConfig, WinchConfig};
pub use description::outputs::{AnalogConfig, InputConfig, LedConfig, OutputConfig};
pub use description::pin::{PinName, is_klippy_name};
pub use description::thermistor::{NoThermistor, Thermistor};
pub use engine::bed::{BedShape, Space};
pub use engine::look::{Colour, Look};
pub use engine::pace::{Pace, PaceWatch};
pub use engine::recorder::{PathPoint, Recorder};
pub use engine::ring::{RingWatch, Ringing};
pub use part::accelerometer::{AccelerometerChip, AccelerometerConfig};
pub use part::ads1220::Ads1220Config;
pub use part::angle::{AngleChip, AngleConfig};
pub use part::apa102::Apa102Config;
pub use part::bltouch::{BltouchConfig, Jam};
pub use part::ds18b20::Ds18b20Config;
pub use part::hx71x::{Hx71xChip, Hx71xConfig};
pub use part::i2c_register::{I2cRegisterChip, I2cRegisterConfig};
pub use part::i2c_sensor::{I2cSensorChip, I2cSensorConfig};
pub use part::ldc1612::Ldc1612Config;
pub use part::load_cell::CellConfig;
pub use part::loopback::LoopbackConfig;
pub use part::probe::ProbeConfig;
pub use part::pwm_channel::PwmChannelConfig;
pub use part::servo::ServoConfig;
pub use part::spi_dac::{SpiDacChip, SpiDacConfig};
pub use part::spool::SpoolConfig;
pub use part::ssd1306::{DisplayChip, Ssd1306Config};
pub use part::thermocouple::{Converter, SensorFault, ThermocoupleConfig};
pub use part::tmc2209::{Tmc2208Config, Tmc2209Config, UartDriverConfig};
pub use part::tmc2660::Tmc2660Config;
pub use part::tmc5160::{SpiDriverConfig, Tmc2130Config, Tmc2240Config, Tmc2240UartConfig, Tmc5160Config};
pub use part::ws2812::Ws2812Config;
pub use printer_cfg::printer_cfg;
pub use toolpath::asked::AskedPath;
pub use toolpath::compare::{Comparison, Distances, compare};
pub use toolpath::drawing::write_svg;
pub use toolpath::moves::write_gcode;
pub use toolpath::solid::{Body, write_stl};
pub use view::{AxisView, FanView, HeaterView, OutputView, SimProbe};
