// SPDX-License-Identifier: GPL-3.0-or-later
//! All parts that a description may contain.

use serde::{Deserialize, Serialize};

use super::part::workshop::Part;
use super::part::{
    accelerometer, ads1220, angle, apa102, bltouch, ds18b20, hx71x, i2c_register, i2c_sensor, ldc1612, loopback, probe,
    pwm_channel, servo, spi_dac, spool, ssd1306, thermocouple, tmc2209, tmc2660, tmc5160, ws2812,
};

macro_rules! parts {
    ($($(#[$about:meta])* $kind:ident($config:ty),)+) => {
        /// A part in the description: a `[[part]]`. Its key `kind` selects one of these.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "kind", rename_all = "lowercase")]
        pub enum PartConfig {
            $($(#[$about])* $kind($config),)+
        }

        impl PartConfig {
            /// The common interface of all parts.
            pub(crate) fn part(&self) -> &dyn Part {
                match self {
                    $(PartConfig::$kind(config) => config,)+
                }
            }
        }
    };
}

parts! {
    /// An accelerometer.
    #[serde(alias = "adxl345")]
    Accelerometer(accelerometer::AccelerometerConfig),
    /// A thermometer on the one-wire bus.
    Ds18b20(ds18b20::Ds18b20Config),
    /// A hardware PWM channel.
    #[serde(rename = "pwm_channel")]
    PwmChannel(pwm_channel::PwmChannelConfig),
    /// Sends every byte back.
    Loopback(loopback::LoopbackConfig),
    /// A servo.
    Servo(servo::ServoConfig),
    /// Filament and its sensors.
    Spool(spool::SpoolConfig),
    /// An angle sensor on a motor's shaft.
    #[serde(rename = "angle_sensor")]
    Angle(angle::AngleConfig),
    /// A stepper driver on a UART.
    Tmc2209(tmc2209::Tmc2209Config),
    /// A stepper driver on a UART, without an address.
    Tmc2208(tmc2209::Tmc2208Config),
    /// A stepper driver.
    Tmc2660(tmc2660::Tmc2660Config),
    /// A thermometer on I2C.
    #[serde(rename = "i2c_sensor")]
    I2cSensor(i2c_sensor::I2cSensorConfig),
    /// A chip on I2C that takes values.
    #[serde(rename = "i2c_register")]
    I2cRegister(i2c_register::I2cRegisterConfig),
    /// A chip on SPI that takes values.
    #[serde(rename = "spi_dac")]
    SpiDac(spi_dac::SpiDacConfig),
    /// A stepper driver.
    Tmc2130(tmc5160::Tmc2130Config),
    /// A stepper driver.
    Tmc2240(tmc5160::Tmc2240Config),
    /// A stepper driver on a UART.
    #[serde(rename = "tmc2240_uart")]
    Tmc2240Uart(tmc5160::Tmc2240UartConfig),
    /// A stepper driver.
    Tmc5160(tmc5160::Tmc5160Config),
    /// A strip of lights on an SPI bus's data output.
    Ws2812(ws2812::Ws2812Config),
    /// A strip of lights on two lines.
    Apa102(apa102::Apa102Config),
    /// A display.
    Ssd1306(ssd1306::Ssd1306Config),
    /// A converter for a thermocouple or a platinum resistor.
    Thermocouple(thermocouple::ThermocoupleConfig),
    /// A switch beside the nozzle.
    Probe(probe::ProbeConfig),
    /// A probe with a push-pin.
    Bltouch(bltouch::BltouchConfig),
    /// The ADC of a load cell.
    Hx71x(hx71x::Hx71xConfig),
    /// Another ADC of a load cell.
    Ads1220(ads1220::Ads1220Config),
    /// A coil over the bed.
    Ldc1612(ldc1612::Ldc1612Config),
}
