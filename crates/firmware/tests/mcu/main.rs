// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU in virtual time, through its public API. The tests check what a host can see, to the tick. The result is the
//! same each time.

mod adxl345;
mod analog_in;
mod any_bytes;
mod any_commands;
mod base;
mod batch;
mod buttons;
mod canbus;
mod counter;
mod dialects;
mod digital_out;
mod displays;
mod ds18b20;
mod endstop;
mod fifo_sensors;
mod hx71x;
mod i2c;
mod kalico;
mod ldc1612;
mod months;
mod neopixel;
mod older_hosts;
mod one_order;
mod other_hosts;
mod pca9685;
mod plain_board;
mod pwm_out;
mod ready_adc;
mod remedies;
mod renew;
mod safe_ends;
mod shutdown_values;
mod sleeping_lines;
mod snapshot;
mod software_buses;
mod sos_filter;
mod spi;
mod spi_angle;
mod stepper;
mod thermocouple;
mod tmcuart;
mod tolerance;
mod trigger_analog;
