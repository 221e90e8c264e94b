// SPDX-License-Identifier: GPL-3.0-or-later
//! The registers of Trinamic's stepper drivers, as the register maps of their data sheets list them: TMC2208 (rev.
//! 1.13), TMC2209 (rev. 1.09), TMC5160A (rev. 1.14), TMC2130 (rev. 1.15), TMC2240 (Analog Devices, rev. 2).

use super::Wave;

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

/// The host's access to a register.
#[derive(Clone, Copy, PartialEq)]
enum Access {
    /// It reads as zero.
    Write,
    Read,
    ReadWrite,
    /// A written one clears its bit.
    ReadClear,
}

use Access::{Read as R, ReadClear as C, ReadWrite as RW, Write as W};

/// A register: its address, access, bits, and value at power-up.
#[derive(Clone, Copy)]
struct Register(u8, Access, u32, u32);

/// Of every model. The driver computes those that are only read.
const ALL: &[Register] = &[
    Register(GSTAT, C, 3, 0x0000_0001),
    Register(TSTEP, R, 20, 0),
    Register(TPWMTHRS, W, 20, 0),
    Register(MSCNT, R, 10, 0),
    Register(MSCURACT, R, 25, 0),
    Register(DRV_STATUS, R, 32, 0),
    Register(PWM_SCALE, R, 25, 0),
    Register(PWM_AUTO, R, 24, 0),
];

/// Of the models with a UART.
const UART: &[Register] = &[
    Register(GCONF, RW, 10, 0x0000_0101),
    Register(IFCNT, R, 8, 0),
    Register(SLAVECONF, W, 12, 0),
    Register(0x04, W, 16, 0),   // OTP_PROG: is done in a factory, not here
    Register(0x05, R, 24, OTP), // OTP_READ
    Register(UART_IOIN, R, 32, 0),
    Register(0x07, RW, 10, OTP), // FACTORY_CONF: starts as the OTP has it
    Register(IHOLD_IRUN, W, 20, 0x0001_1f10),
    Register(TPOWERDOWN, W, 8, 20),
    Register(0x22, W, 24, 0), // VACTUAL
    Register(CHOPCONF, RW, 32, 0x1000_0053),
    Register(PWMCONF, RW, 32, 0xc10d_0024),
];

/// Of a TMC2209 only.
const STALLGUARD4: &[Register] = &[
    Register(TCOOLTHRS, W, 20, 0),
    Register(SGTHRS, W, 8, 0),
    Register(SG_RESULT, R, 10, 0),
    Register(0x42, W, 16, 0), // COOLCONF
];

/// Of the models on SPI.
const SPI: &[Register] = &[
    Register(GCONF, RW, 18, 0x0000_0008),
    Register(SPI_IOIN, R, 32, 0),
    Register(IHOLD_IRUN, W, 20, 0),
    Register(TPOWERDOWN, W, 8, 10),
    Register(TCOOLTHRS, W, 20, 0),
    Register(0x15, W, 20, 0), // THIGH
    Register(MSLUT, W, 32, Wave::DEFAULT.increments[0]),
    Register(MSLUT + 1, W, 32, Wave::DEFAULT.increments[1]),
    Register(MSLUT + 2, W, 32, Wave::DEFAULT.increments[2]),
    Register(MSLUT + 3, W, 32, Wave::DEFAULT.increments[3]),
    Register(MSLUT + 4, W, 32, Wave::DEFAULT.increments[4]),
    Register(MSLUT + 5, W, 32, Wave::DEFAULT.increments[5]),
    Register(MSLUT + 6, W, 32, Wave::DEFAULT.increments[6]),
    Register(MSLUT + 7, W, 32, Wave::DEFAULT.increments[7]),
    Register(MSLUTSEL, W, 32, Wave::DEFAULT.segments),
    Register(MSLUTSTART, W, 24, Wave::DEFAULT.start),
    Register(CHOPCONF, RW, 32, 0x1041_0150),
    Register(COOLCONF, W, 25, 0),
];

/// Of the models with DcStep.
const DCSTEP: &[Register] = &[
    Register(0x33, W, 23, 0), // VDCMIN
    Register(0x6e, W, 24, 0), // DCCTRL
    Register(0x73, R, 20, 0), // LOST_STEPS: counts in DcStep mode only
];

const ONLY_5160: &[Register] = &[
    Register(0x02, R, 8, 0),            // IFCNT: of the UART, which is not in use
    Register(0x03, W, 12, 0),           // SLAVECONF
    Register(0x05, W, 32, 0),           // X_COMPARE
    Register(0x06, W, 16, 0),           // OTP_PROG: is done in a factory, not here
    Register(0x07, R, 8, OTP),          // OTP_READ
    Register(0x08, RW, 5, OTP),         // FACTORY_CONF: starts as the OTP has it
    Register(0x09, W, 19, 0x0001_0606), // SHORT_CONF
    Register(0x0a, W, 22, 0x0008_0400), // DRV_CONF
    Register(0x0b, W, 8, 0),            // GLOBALSCALER
    Register(0x0c, R, 16, 0),           // OFFSET_READ
    Register(0x20, RW, 2, 0),           // RAMPMODE
    Register(0x21, RW, 32, 0),          // XACTUAL
    Register(0x22, R, 24, 0),           // VACTUAL
    Register(0x23, W, 18, 0),           // VSTART
    Register(0x24, W, 16, 0),           // A1
    Register(0x25, W, 20, 0),           // V1
    Register(0x26, W, 16, 0),           // AMAX
    Register(0x27, W, 23, 0),           // VMAX
    Register(0x28, W, 16, 0),           // DMAX
    Register(0x2a, W, 16, 0),           // D1
    Register(0x2b, W, 18, 1),           // VSTOP
    Register(0x2c, W, 16, 0),           // TZEROWAIT
    Register(0x2d, RW, 32, 0),          // XTARGET
    Register(0x34, RW, 12, 0),          // SW_MODE
    Register(0x35, C, 14, 0),           // RAMP_STAT
    Register(0x36, R, 32, 0),           // XLATCH
    Register(0x38, RW, 11, 0),          // ENCMODE
    Register(0x39, RW, 32, 0),          // X_ENC
    Register(0x3a, W, 32, 0x0001_0000), // ENC_CONST
    Register(0x3b, C, 2, 0),            // ENC_STATUS
    Register(0x3c, R, 32, 0),           // ENC_LATCH
    Register(0x3d, W, 20, 0),           // ENC_DEVIATION
    Register(PWMCONF, W, 32, 0xc40c_001e),
];

const ONLY_2130: &[Register] = &[
    Register(GCONF, RW, 18, 0),
    Register(TPOWERDOWN, W, 8, 0),
    Register(0x2d, RW, 32, 0), // XDIRECT
    Register(CHOPCONF, RW, 32, 0),
    Register(PWMCONF, W, 22, 0x0005_0480),
    Register(PWM_SCALE, R, 8, 0),
    Register(0x72, W, 2, 0), // ENCM_CTRL
];

const ONLY_2240: &[Register] = &[
    Register(GSTAT, C, 5, 0x0000_0001),
    Register(IFCNT, R, 8, 0),            // computed
    Register(SLAVECONF, W, 12, 0),       // NODECONF
    Register(0x0a, RW, 22, 0x0000_0020), // DRV_CONF
    Register(0x0b, RW, 8, 0),            // GLOBAL_SCALER
    Register(IHOLD_IRUN, RW, 28, 0x0407_0a03),
    Register(0x2d, RW, 32, 0),           // DIRECT_MODE
    Register(0x38, RW, 11, 0),           // ENCMODE
    Register(0x39, RW, 32, 0),           // X_ENC
    Register(0x3a, W, 32, 0x0001_0000),  // ENC_CONST
    Register(0x3b, C, 1, 0),             // ENC_STATUS
    Register(0x3c, R, 32, 0),            // ENC_LATCH
    Register(0x50, R, 29, ADC_24_V),     // ADC_VSUPPLY_AIN
    Register(0x51, R, 29, ADC_35_C),     // ADC_TEMP
    Register(0x52, RW, 29, 0x0b92_0f25), // OTW_OV_VTH
    Register(MSLUTSTART, RW, 32, Wave::DEFAULT.start),
    Register(PWMCONF, RW, 32, 0xc44c_001e),
    Register(0x74, RW, 10, 0), // SG4_THRS
    Register(0x75, R, 10, 0),  // SG4_RESULT
    Register(0x76, R, 32, 0),  // SG4_IND
];

/// A chip's registers, as the host has set them. An address without a register reads as zero.
pub(crate) struct Registers {
    by_address: [Option<Register>; 128],
    values: [u32; 128],
}

impl Registers {
    /// The registers of a model at power-up.
    pub(crate) fn of(model: u16) -> Registers {
        let mut registers = Registers { by_address: [None; 128], values: [0; 128] };
        registers.add(ALL);
        if let 2208 | 2209 = model {
            registers.add(UART);
        } else {
            registers.add(SPI);
        }
        if let 2130 | 5160 = model {
            registers.add(DCSTEP);
        }
        match model {
            2209 => registers.add(STALLGUARD4),
            2130 => registers.add(ONLY_2130),
            2240 => {
                // It lets the host read what the others only take.
                for Register(_, access, ..) in registers.by_address.iter_mut().flatten().filter(|found| found.1 == W) {
                    *access = RW;
                }
                registers.add(ONLY_2240);
            }
            5160 => registers.add(ONLY_5160),
            _ => {}
        }
        registers
    }

    /// Adds registers. One at the address of another takes its place.
    fn add(&mut self, table: &[Register]) {
        for register in table {
            self.by_address[usize::from(register.0)] = Some(*register);
            self.values[usize::from(register.0)] = register.3;
        }
    }

    pub(crate) fn get(&self, address: u8) -> u32 {
        self.values[usize::from(address & 0x7f)]
    }

    pub(crate) fn is_set(&self, address: u8, bit: u32) -> bool {
        self.get(address) & bit != 0
    }

    /// The size of a step (MRES).
    pub(crate) fn mres(&self) -> u32 {
        self.get(CHOPCONF) >> 24 & 0xf
    }

    /// Whether each edge of the step pin is a step (DEDGE).
    pub(crate) fn has_both_edges(&self) -> bool {
        self.is_set(CHOPCONF, 1 << 29)
    }

    /// The current at standstill (IHOLD) or in motion (IRUN), of 31.
    pub(crate) fn current(&self, stands: bool) -> u32 {
        self.get(IHOLD_IRUN) >> if stands { 0 } else { 8 } & 0x1f
    }

    /// PWM_AUTO: PWM_GRAD and PWM_OFS, from which the tuning starts.
    pub(crate) fn pwm_auto(&self) -> u32 {
        (self.get(PWMCONF) >> 8 & 0xff) << 16 | self.get(PWMCONF) & 0xff
    }

    /// The value that the host reads, if it is the stored value.
    pub(crate) fn read(&self, address: u8) -> u32 {
        match self.by_address.get(usize::from(address)) {
            None | Some(None | Some(Register(_, Access::Write, ..))) => 0,
            Some(_) => self.get(address),
        }
    }

    pub(crate) fn write(&mut self, address: u8, data: u32) {
        let Some(Some(Register(_, access, bits, _))) = self.by_address.get(usize::from(address)) else { return };
        let value = &mut self.values[usize::from(address)];
        match access {
            Access::Read => {}
            Access::Write | Access::ReadWrite => *value = data & (u32::MAX >> (32 - bits)),
            Access::ReadClear => *value &= !data,
        }
    }
}
