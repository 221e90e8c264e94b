// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion itself on these drivers: `pinion run`, and a host on its pty.

// Shared by the tests.
mod outputs;

mod analog;
mod buttons;
mod can;
mod counter;
mod displays;
mod ds18b20;
mod duplicate;
mod expander;
mod guardian;
mod hard_pwm;
mod homing;
mod hx71x;
mod i2c;
mod lines;
mod neopixel;
mod pca9685;
mod pins;
mod power;
mod renumbered;
mod safe_state;
mod serial;
mod spi;
mod steps;
mod tmcuart;
mod wall_clock;
mod watchdog;
