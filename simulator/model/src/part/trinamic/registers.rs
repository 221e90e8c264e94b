// SPDX-License-Identifier: GPL-3.0-or-later
//! The registers of Trinamic's stepper drivers, as the register maps of their data sheets list them: TMC2208 (rev.
//! 1.13), TMC2209 (rev. 1.09), TMC5160A (rev. 1.14), TMC2130 (rev. 1.15), TMC2240 (Analog Devices, rev. 2).

use super::Wave;
use crate::engine::register_map::Access::{ClearOnRead, ClearOnWrite as C, Read as R, ReadWrite as RW, Write as W};
use crate::engine::register_map::{Register, RegisterMap};

pub(crate) const GCONF: u8 = 0x00;
pub(crate) const GSTAT: u8 = 0x01;
pub(crate) const IFCNT: u8 = 0x02;
pub(crate) const SLAVECONF: u8 = 0x03;
pub(crate) const IHOLD_IRUN: u8 = 0x10;
const TPOWERDOWN: u8 = 0x11;
pub(crate) const TSTEP: u8 = 0x12;
pub(crate) const TPWMTHRS: u8 = 0x13;
pub(crate) const TCOOLTHRS: u8 = 0x14;
pub(crate) const SGTHRS: u8 = 0x40;
pub(crate) const SG_RESULT: u8 = 0x41;
pub(crate) const MSLUT: u8 = 0x60;
pub(crate) const MSLUTSEL: u8 = 0x68;
pub(crate) const MSLUTSTART: u8 = 0x69;
pub(crate) const MSCNT: u8 = 0x6a;
pub(crate) const MSCURACT: u8 = 0x6b;
pub(crate) const CHOPCONF: u8 = 0x6c;
pub(crate) const COOLCONF: u8 = 0x6d;
pub(crate) const DRV_STATUS: u8 = 0x6f;
pub(crate) const PWMCONF: u8 = 0x70;
const PWM_SCALE: u8 = 0x71;
pub(crate) const PWM_AUTO: u8 = 0x72;

/// IOIN of a driver on a UART, and of one on SPI.
pub(crate) const UART_IOIN: u8 = 0x06;
pub(crate) const SPI_IOIN: u8 = 0x04;

/// FCLKTRIM as the factory wrote it to the chip.
pub(crate) const OTP: u32 = 0x0f;
/// ADC_VSUPPLY: 9.732 mV for each count.
const ADC_24_V: u32 = 2466;
/// ADC_TEMP: (count - 2038) / 7.7 degrees Celsius.
pub(crate) const ADC_35_C: u32 = 2308;

/// Of every model. The driver computes those that are only read.
const ALL: &[Register<u32>] = &[
    Register(GSTAT, C, 0x7, 0x0000_0001),
    Register(TSTEP, R, 0xf_ffff, 0),
    Register(TPWMTHRS, W, 0xf_ffff, 0),
    Register(MSCNT, R, 0x3ff, 0),
    Register(MSCURACT, R, 0x1ff_ffff, 0),
    Register(DRV_STATUS, R, 0xffff_ffff, 0),
    Register(PWM_SCALE, R, 0x1ff_ffff, 0),
    Register(PWM_AUTO, R, 0xff_ffff, 0),
];

/// Of the models with a UART.
const UART: &[Register<u32>] = &[
    Register(GCONF, RW, 0x3ff, 0x0000_0101),
    Register(IFCNT, R, 0xff, 0),
    Register(SLAVECONF, W, 0xfff, 0),
    Register(0x04, W, 0xffff, 0),      // OTP_PROG: is done in a factory, not here
    Register(0x05, R, 0xff_ffff, OTP), // OTP_READ
    Register(UART_IOIN, R, 0xffff_ffff, 0),
    Register(0x07, RW, 0x3ff, OTP), // FACTORY_CONF: starts as the OTP has it
    Register(IHOLD_IRUN, W, 0xf_ffff, 0x0001_1f10),
    Register(TPOWERDOWN, W, 0xff, 20),
    Register(0x22, W, 0xff_ffff, 0), // VACTUAL
    Register(CHOPCONF, RW, 0xffff_ffff, 0x1000_0053),
    Register(PWMCONF, RW, 0xffff_ffff, 0xc10d_0024),
];

/// Of a TMC2209 only.
const STALLGUARD4: &[Register<u32>] = &[
    Register(TCOOLTHRS, W, 0xf_ffff, 0),
    Register(SGTHRS, W, 0xff, 0),
    Register(SG_RESULT, R, 0x3ff, 0),
    Register(0x42, W, 0xffff, 0), // COOLCONF
];

/// Of the models on SPI.
const SPI: &[Register<u32>] = &[
    Register(GCONF, RW, 0x3_ffff, 0x0000_0008),
    Register(SPI_IOIN, R, 0xffff_ffff, 0),
    Register(IHOLD_IRUN, W, 0xf_ffff, 0),
    Register(TPOWERDOWN, W, 0xff, 10),
    Register(TCOOLTHRS, W, 0xf_ffff, 0),
    Register(0x15, W, 0xf_ffff, 0), // THIGH
    Register(MSLUT, W, 0xffff_ffff, Wave::DEFAULT.increments[0]),
    Register(MSLUT + 1, W, 0xffff_ffff, Wave::DEFAULT.increments[1]),
    Register(MSLUT + 2, W, 0xffff_ffff, Wave::DEFAULT.increments[2]),
    Register(MSLUT + 3, W, 0xffff_ffff, Wave::DEFAULT.increments[3]),
    Register(MSLUT + 4, W, 0xffff_ffff, Wave::DEFAULT.increments[4]),
    Register(MSLUT + 5, W, 0xffff_ffff, Wave::DEFAULT.increments[5]),
    Register(MSLUT + 6, W, 0xffff_ffff, Wave::DEFAULT.increments[6]),
    Register(MSLUT + 7, W, 0xffff_ffff, Wave::DEFAULT.increments[7]),
    Register(MSLUTSEL, W, 0xffff_ffff, Wave::DEFAULT.segments),
    Register(MSLUTSTART, W, 0xff_ffff, Wave::DEFAULT.start),
    Register(CHOPCONF, RW, 0xffff_ffff, 0x1041_0150),
    Register(COOLCONF, W, 0x1ff_ffff, 0),
];

/// Of the models with DcStep.
const DCSTEP: &[Register<u32>] = &[
    Register(0x33, W, 0x7f_ffff, 0), // VDCMIN
    Register(0x6e, W, 0xff_ffff, 0), // DCCTRL
    Register(0x73, R, 0xf_ffff, 0),  // LOST_STEPS: counts in DcStep mode only
];

const ONLY_5160: &[Register<u32>] = &[
    Register(0x02, R, 0xff, 0),                  // IFCNT: of the UART, which is not in use
    Register(0x03, W, 0xfff, 0),                 // SLAVECONF
    Register(0x05, W, 0xffff_ffff, 0),           // X_COMPARE
    Register(0x06, W, 0xffff, 0),                // OTP_PROG: is done in a factory, not here
    Register(0x07, R, 0xff, OTP),                // OTP_READ
    Register(0x08, RW, 0x1f, OTP),               // FACTORY_CONF: starts as the OTP has it
    Register(0x09, W, 0x7_ffff, 0x0001_0606),    // SHORT_CONF
    Register(0x0a, W, 0x3f_ffff, 0x0008_0400),   // DRV_CONF
    Register(0x0b, W, 0xff, 0),                  // GLOBALSCALER
    Register(0x0c, R, 0xffff, 0),                // OFFSET_READ
    Register(0x20, RW, 0x3, 0),                  // RAMPMODE
    Register(0x21, RW, 0xffff_ffff, 0),          // XACTUAL
    Register(0x22, R, 0xff_ffff, 0),             // VACTUAL
    Register(0x23, W, 0x3_ffff, 0),              // VSTART
    Register(0x24, W, 0xffff, 0),                // A1
    Register(0x25, W, 0xf_ffff, 0),              // V1
    Register(0x26, W, 0xffff, 0),                // AMAX
    Register(0x27, W, 0x7f_ffff, 0),             // VMAX
    Register(0x28, W, 0xffff, 0),                // DMAX
    Register(0x2a, W, 0xffff, 0),                // D1
    Register(0x2b, W, 0x3_ffff, 1),              // VSTOP
    Register(0x2c, W, 0xffff, 0),                // TZEROWAIT
    Register(0x2d, RW, 0xffff_ffff, 0),          // XTARGET
    Register(0x34, RW, 0xfff, 0),                // SW_MODE
    Register(0x35, C, 0x3fff, 0),                // RAMP_STAT
    Register(0x36, R, 0xffff_ffff, 0),           // XLATCH
    Register(0x38, RW, 0x7ff, 0),                // ENCMODE
    Register(0x39, RW, 0xffff_ffff, 0),          // X_ENC
    Register(0x3a, W, 0xffff_ffff, 0x0001_0000), // ENC_CONST
    Register(0x3b, C, 0x3, 0),                   // ENC_STATUS
    Register(0x3c, R, 0xffff_ffff, 0),           // ENC_LATCH
    Register(0x3d, W, 0xf_ffff, 0),              // ENC_DEVIATION
    Register(PWMCONF, W, 0xffff_ffff, 0xc40c_001e),
];

const ONLY_2130: &[Register<u32>] = &[
    Register(GSTAT, ClearOnRead, 0x7, 0x0000_0001),
    Register(GCONF, RW, 0x3_ffff, 0),
    Register(TPOWERDOWN, W, 0xff, 0),
    Register(0x2d, RW, 0xffff_ffff, 0), // XDIRECT
    Register(CHOPCONF, RW, 0xffff_ffff, 0),
    Register(PWMCONF, W, 0x3f_ffff, 0x0005_0480),
    Register(PWM_SCALE, R, 0xff, 0),
    Register(0x72, W, 0x3, 0), // ENCM_CTRL
];

const ONLY_2240: &[Register<u32>] = &[
    Register(GSTAT, C, 0x1f, 0x0000_0001),
    Register(IFCNT, R, 0xff, 0),                // computed
    Register(SLAVECONF, W, 0xfff, 0),           // NODECONF
    Register(0x0a, RW, 0x3f_ffff, 0x0000_0020), // DRV_CONF
    Register(0x0b, RW, 0xff, 0),                // GLOBAL_SCALER
    Register(IHOLD_IRUN, RW, 0xfff_ffff, 0x0407_0a03),
    Register(0x2d, RW, 0xffff_ffff, 0),           // DIRECT_MODE
    Register(0x38, RW, 0x7ff, 0),                 // ENCMODE
    Register(0x39, RW, 0xffff_ffff, 0),           // X_ENC
    Register(0x3a, W, 0xffff_ffff, 0x0001_0000),  // ENC_CONST
    Register(0x3b, C, 0x1, 0),                    // ENC_STATUS
    Register(0x3c, R, 0xffff_ffff, 0),            // ENC_LATCH
    Register(0x50, R, 0x1fff_ffff, ADC_24_V),     // ADC_VSUPPLY_AIN
    Register(0x51, R, 0x1fff_ffff, ADC_35_C),     // ADC_TEMP
    Register(0x52, RW, 0x1fff_ffff, 0x0b92_0f25), // OTW_OV_VTH
    Register(MSLUTSTART, RW, 0xffff_ffff, Wave::DEFAULT.start),
    Register(PWMCONF, RW, 0xffff_ffff, 0xc44c_001e),
    Register(0x74, RW, 0x3ff, 0),      // SG4_THRS
    Register(0x75, R, 0x3ff, 0),       // SG4_RESULT
    Register(0x76, R, 0xffff_ffff, 0), // SG4_IND
];

/// The registers of a model at power-up.
pub(crate) fn of_model(model: u16) -> RegisterMap<u32> {
    let mut registers = RegisterMap::new(ALL);
    registers.add(if let 2208 | 2209 = model { UART } else { SPI });
    if let 2130 | 5160 = model {
        registers.add(DCSTEP);
    }
    match model {
        2209 => registers.add(STALLGUARD4),
        2130 => registers.add(ONLY_2130),
        2240 => {
            // It lets the host read what the others only take.
            registers.make_readable();
            registers.add(ONLY_2240);
        }
        5160 => registers.add(ONLY_5160),
        _ => {}
    }
    registers
}

/// The size of a step (MRES).
pub(crate) fn mres(registers: &RegisterMap<u32>) -> u32 {
    registers.get(CHOPCONF) >> 24 & 0xf
}

/// Whether each edge of the step pin is a step (DEDGE).
pub(crate) fn has_both_edges(registers: &RegisterMap<u32>) -> bool {
    registers.is_set(CHOPCONF, 1 << 29)
}

/// The current at standstill (IHOLD) or in motion (IRUN), of 31.
pub(crate) fn current(registers: &RegisterMap<u32>, stands: bool) -> u32 {
    registers.get(IHOLD_IRUN) >> if stands { 0 } else { 8 } & 0x1f
}

/// PWM_AUTO: PWM_GRAD and PWM_OFS, from which the tuning starts.
pub(crate) fn pwm_auto(registers: &RegisterMap<u32>) -> u32 {
    (registers.get(PWMCONF) >> 8 & 0xff) << 16 | registers.get(PWMCONF) & 0xff
}
