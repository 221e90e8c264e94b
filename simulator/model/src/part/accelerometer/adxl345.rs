// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer ADXL345 on SPI, after its data sheet (Analog Devices, rev. G: "Serial
//! Communications", "FIFO", "Interrupts", "Register Map").
//!
//! Simulated: all registers; rates by the chip's own clock, ranges, full resolution and justification, offsets, noise;
//! the FIFO in its modes with watermark and overrun, and how it is read. Not simulated: taps, activity and free fall,
//! sleep and self test, the trigger mode (it works like the stream mode) and the interrupt pins (INT_SOURCE has the
//! same bits).

use super::head::{Fifo, Head, Room};
use crate::engine::register_map::{Access, Register, RegisterChip, RegisterMap};

/// CPOL and CPHA are 1.
const MODE: u8 = 3;
/// Bits of a message's first byte.
const MULTIPLE_BYTES: u8 = 0x40;
const ADDRESS: u8 = 0x3f;

const DEVID: u8 = 0x00;
const THRESH_TAP: u8 = 0x1d;
const OFSX: u8 = 0x1e;
const ACT_TAP_STATUS: u8 = 0x2b;
const BW_RATE: u8 = 0x2c;
const POWER_CTL: u8 = 0x2d;
const INT_SOURCE: u8 = 0x30;
const DATA_FORMAT: u8 = 0x31;
const DATAX0: u8 = 0x32;
const DATAZ1: u8 = 0x37;
const FIFO_CTL: u8 = 0x38;
const FIFO_STATUS: u8 = 0x39;

/// The registers that do not only hold what is written. BW_RATE starts with 100 samples a second.
const REGISTERS: &[Register<u8>] = &[
    Register(DEVID, Access::Read, 0, 0xe5),
    Register(ACT_TAP_STATUS, Access::Read, 0, 0),
    Register(BW_RATE, Access::ReadWrite, 0xff, 0x0a),
];
const MEASURE: u8 = 0x08;
const FULL_RES: u8 = 0x08;
const JUSTIFY: u8 = 0x04;
const RANGE: u8 = 0x03;
const DATA_READY: u8 = 0x80;
const WATERMARK: u8 = 0x02;
const OVERRUN: u8 = 0x01;

/// Entries of the FIFO; one sample more waits at the output filter.
const FIFO: usize = 32;
/// The highest rate, of code 15; each code below halves it.
const TOP_RATE_HZ: f64 = 3200.0;
/// LSB per g in full resolution, at a supply of 3.3 V. There the x and y axes differ from the 256 at 2.5 V.
const LSB_PER_G: [f64; 3] = [265.0, 265.0, 256.0];
/// An offset's LSB is 15.6 mg, a sample's 3.9 mg.
const LSB_PER_OFFSET: f64 = 4.0;

/// The chip's registers and its FIFO.
pub(super) struct Adxl345 {
    head: Head,
    registers: RegisterMap<u8>,
    fifo: Fifo,
    /// Whether a data register was read. The sample leaves when the read moves beyond the data registers or ends.
    data_read: bool,
    /// FIFO_STATUS. It does not change for 5 us after a data read, which is longer than the rest of the message.
    status: u8,
}

impl Adxl345 {
    pub(super) fn new(head: Head) -> Adxl345 {
        Adxl345 {
            head,
            registers: RegisterMap::holding(THRESH_TAP.into()..0x3a, REGISTERS),
            fifo: Fifo::new(FIFO + 1),
            data_read: false,
            status: 0,
        }
    }

    fn rate_hz(&self) -> f64 {
        TOP_RATE_HZ / f64::from(1u32 << (15 - (self.registers.get(BW_RATE) & 0x0f)))
    }

    fn room(&self) -> Room {
        match self.registers.get(FIFO_CTL) >> 6 {
            0 => Room { samples: 1, replaces: true },
            1 => Room { samples: FIFO + 1, replaces: false },
            _ => Room { samples: FIFO + 1, replaces: true },
        }
    }

    /// Takes the samples that have become due.
    fn catch_up(&mut self) {
        let offsets = [0, 1, 2].map(|i| f64::from(self.registers.get(OFSX + i) as i8) * LSB_PER_OFFSET);
        let (format, room) = (self.registers.get(DATA_FORMAT), self.room());
        self.head.catch_up(&mut self.fifo, room, |g| digitize(format, offsets, g));
    }

    fn entries(&self) -> u8 {
        self.fifo.samples.len().min(FIFO) as u8
    }

    /// The sample in the data registers has been read.
    fn pop(&mut self) {
        if std::mem::take(&mut self.data_read) {
            self.fifo.pop();
        }
    }
}

/// The register values for an acceleration in g.
fn digitize(format: u8, offsets: [f64; 3], g: [f64; 3]) -> [i16; 3] {
    let range = format & RANGE;
    let scale = if format & FULL_RES == 0 { 1u32 << range } else { 1 };
    let bits = 10 + if format & FULL_RES == 0 { 0 } else { range };
    let limit = f64::from(1u32 << (bits - 1));
    let shift = if format & JUSTIFY == 0 { 0 } else { 16 - bits };
    [0, 1, 2].map(|i| {
        let lsb = (g[i] * LSB_PER_G[i] + offsets[i]) / f64::from(scale);
        (lsb.round().clamp(-limit, limit - 1.0) as i16) << shift
    })
}

impl RegisterChip for Adxl345 {
    const SPI_MODES: &'static [u8] = &[MODE];

    fn register(&mut self, first: u8, _is_spi: bool) -> (u8, bool) {
        (first & ADDRESS, first & MULTIPLE_BYTES != 0)
    }

    fn begin(&mut self) {
        self.catch_up();
        self.status = self.entries();
    }

    fn read(&mut self, register: u8) -> u8 {
        match register {
            DATAX0..=DATAZ1 => {
                self.data_read = true;
                let sample = self.fifo.front();
                let place = usize::from(register - DATAX0);
                sample[place / 2].to_le_bytes()[place % 2]
            }
            INT_SOURCE => {
                let ready = if self.fifo.samples.is_empty() { 0 } else { DATA_READY };
                let watermark = if self.entries() >= self.registers.get(FIFO_CTL) & 0x1f { WATERMARK } else { 0 };
                ready | watermark | if self.fifo.overrun { OVERRUN } else { 0 }
            }
            FIFO_STATUS => self.status,
            _ => self.registers.read(register),
        }
    }

    fn write(&mut self, register: u8, value: u8) {
        self.registers.write(register, value);
        match register {
            POWER_CTL | BW_RATE => {
                let measures = self.registers.get(POWER_CTL) & MEASURE != 0;
                self.head.measure(measures.then(|| self.rate_hz()));
            }
            // The bypass mode empties the FIFO.
            FIFO_CTL if value >> 6 == 0 => self.fifo.clear(),
            _ => {}
        }
    }

    fn next(&mut self, register: u8) -> u8 {
        let next = (register + 1) & ADDRESS;
        if next == FIFO_CTL {
            self.pop();
        }
        next
    }

    fn end(&mut self) {
        self.pop();
    }
}

#[cfg(test)]
mod tests {
    use super::super::head::{DELAY_TICKS, G_MM_PER_S2, TURN_ON_S};
    use super::super::tests::{Bench, DAMPING, READ, X_HZ};
    use super::*;
    use pinion_firmware::time::{CLOCK_FREQ, Clock, TimeSource as _};
    use std::f64::consts::TAU;

    fn bench(rate_off_percent: f64) -> Bench<Adxl345> {
        Bench::new(rate_off_percent, Adxl345::new)
    }

    impl Bench<Adxl345> {
        /// The next sample, and the FIFO_STATUS read with it.
        fn sample(&mut self) -> ([i16; 3], u8) {
            let [_, x0, x1, y0, y1, z0, z1, _, status] =
                self.exchange([DATAX0 | READ | MULTIPLE_BYTES, 0, 0, 0, 0, 0, 0, 0, 0]);
            ([[x0, x1], [y0, y1], [z0, z1]].map(i16::from_le_bytes), status)
        }

        /// Measures at 3200 samples a second in full resolution of 16 g.
        fn measure(&mut self, fifo_ctl: u8) {
            for (register, value) in
                [(POWER_CTL, 0), (DATA_FORMAT, 0x0b), (FIFO_CTL, 0), (BW_RATE, 0x0f), (FIFO_CTL, fifo_ctl)]
            {
                self.write(register, value);
                assert_eq!(self.read(register), value, "{register:#04x}");
            }
            self.write(POWER_CTL, MEASURE);
        }
    }

    #[test]
    fn registers_are_as_in_the_data_sheet() {
        let mut bench = bench(0.0);
        for (register, value) in
            [(DEVID, 0xe5), (0x01, 0), (BW_RATE, 0x0a), (POWER_CTL, 0), (INT_SOURCE, 2), (FIFO_STATUS, 0), (0x3a, 0)]
        {
            assert_eq!(bench.read(register), value, "{register:#04x}");
            bench.write(register, 0x55);
            let kept = matches!(register, BW_RATE | POWER_CTL);
            assert_eq!(bench.read(register) == 0x55, kept, "{register:#04x}");
        }
        // Several registers in one transfer: THRESH_TAP and the offsets.
        bench.exchange([THRESH_TAP | MULTIPLE_BYTES, 1, 2, 3, 4]);
        assert_eq!(bench.exchange([THRESH_TAP | READ | MULTIPLE_BYTES, 0, 0, 0, 0]), [0, 1, 2, 3, 4]);
        // Without that bit the register stays the same.
        assert_eq!(bench.exchange([OFSX | READ, 0, 0]), [0, 2, 2]);
    }

    #[test]
    fn samples_come_at_the_pace_of_the_chip_s_own_clock() {
        let mut bench = bench(0.4);
        bench.measure(0x90);
        bench.wait(TURN_ON_S);
        let mut samples = 0u32;
        for ms in 0..10_000 {
            bench.wait(0.001);
            // Between two samples, so that rounding decides nothing.
            while bench.read(FIFO_STATUS) != 0 {
                let (_, filled) = bench.sample();
                assert!(filled <= 5, "{filled} after {ms} ms");
                samples += 1;
            }
        }
        assert!(samples.abs_diff(32_128) <= 1, "{samples}");
        assert_eq!(bench.read(INT_SOURCE) & OVERRUN, 0);
    }

    #[test]
    fn the_fifo_keeps_the_newest_in_stream_mode_and_the_oldest_in_fifo_mode() {
        for (fifo_ctl, first) in [(0x80 | 8, 200 - 33 + 1), (0x40 | 8, 1)] {
            let mut bench = bench(0.0);
            bench.measure(fifo_ctl);
            // From the first sample on, the offset's register marks each sample with its number, four LSB each.
            bench.wait(TURN_ON_S + 0.5 / 3200.0);
            for n in 1..=200u8 {
                bench.write(OFSX + 1, n);
                bench.wait(1.0 / 3200.0);
                let source = bench.read(INT_SOURCE);
                assert_eq!(source & DATA_READY, DATA_READY, "{n}");
                assert_eq!(source & WATERMARK != 0, n >= 8, "{n}");
                assert_eq!(source & OVERRUN != 0, n > 33, "{n}");
                assert_eq!(bench.read(FIFO_STATUS), n.min(32), "{n}");
            }
            for n in 0..33u8 {
                let ([_, y, _], filled) = bench.sample();
                assert_eq!(y, i16::from((first + n) as i8) * 4, "{n}");
                assert_eq!(filled, (33 - n).min(32), "as it was before the sample left");
                assert_eq!(bench.read(INT_SOURCE) & OVERRUN, 0);
            }
            assert_eq!(bench.read(FIFO_STATUS), 0);
            // A further read returns the last sample again.
            let last = bench.sample();
            assert_eq!(last, bench.sample());
            // A read of a single data register also takes a sample out.
            bench.wait(3.0 / 3200.0);
            bench.read(DATAX0);
            assert_eq!(bench.read(FIFO_STATUS), 2);
            bench.write(FIFO_CTL, 0);
            assert_eq!(bench.read(FIFO_STATUS), 0, "emptied by the bypass mode");
        }
    }

    #[test]
    fn gravity_is_on_z_in_each_format() {
        for (format, z) in [
            // Ten bits: 256 LSB per g at 2 g, half of that at each doubling of the range.
            (0x00, 256),
            (0x01, 128),
            (0x02, 64),
            (0x03, 32),
            // Full resolution.
            (0x08, 256),
            (0x0b, 256),
            // Left-justified: 10 and 13 bits of 16.
            (0x04, 256 << 6),
            (0x0f, 256 << 3),
        ] {
            let mut bench = bench(0.0);
            bench.write(DATA_FORMAT, format);
            bench.write(POWER_CTL, MEASURE);
            bench.wait(0.1);
            assert_eq!(bench.sample().0, [0, 0, z], "{format:#04x}");
        }
    }

    #[test]
    fn the_head_rings_as_the_differential_equation_says() {
        let mut bench = bench(0.0);
        bench.measure(0x90);
        bench.wait(TURN_ON_S);
        let start = bench.clock.now().ticks();
        // Twenty steps at 4000 steps per second, a rest, and back.
        let steps: Vec<f64> = (0..40).map(|n| f64::from(n) / 4000.0 + if n < 20 { 0.01 } else { 0.1 }).collect();
        let delay_s = DELAY_TICKS as f64 / f64::from(CLOCK_FREQ);
        // Euler's method in small steps. The mean acceleration of each period is the difference of the speeds.
        let (mut x, mut v, mut before, mut u) = (0.0, 0.0, 0.0, 0.0);
        let omega = TAU * X_HZ;
        let (dt, each) = (1.0 / 3200.0 / 400.0, 400);
        let mut made = 0;
        let mut largest = 0;
        for sample in 1..=1000u32 {
            for fine in 0..each {
                let now = f64::from((sample - 1) * each + fine) * dt;
                let felt = steps.iter().filter(|at| **at + delay_s <= now);
                u = felt.enumerate().map(|(n, _)| if n < 20 { 1.0 } else { -1.0 }).sum::<f64>() / 80.0;
                v += (omega * omega * (u - x) - 2.0 * DAMPING * omega * v) * dt;
                x += v * dt;
            }
            let until = f64::from(sample) / 3200.0;
            while steps.get(made).is_some_and(|at| *at <= until) {
                bench.axis.set_forward(made < 20);
                bench.clock.set(Clock::from_ticks(start + (steps[made] * f64::from(CLOCK_FREQ)) as u64));
                bench.step();
                made += 1;
            }
            bench.clock.set(Clock::from_ticks(start + (until * f64::from(CLOCK_FREQ)) as u64 + 10));
            let ([measured, ..], filled) = bench.sample();
            assert_eq!(filled, 1);
            let expected = (v - before) * 3200.0 / G_MM_PER_S2 * LSB_PER_G[0];
            before = v;
            assert!((f64::from(measured) - expected).abs() < 3.0, "sample {sample}: {measured}, not {expected}");
            largest = largest.max(measured.abs());
        }
        assert_eq!((made, u), (40, 0.0));
        assert!(largest > 500, "{largest}");
    }

    #[test]
    fn who_reads_too_late_gets_the_newest_and_a_chip_in_standby_takes_none() {
        let mut bench = bench(0.0);
        bench.measure(0x90);
        for _ in 0..50_000 {
            bench.wait(0.0002);
            bench.step();
        }
        // Ten seconds: the axis's track has only the last part of them. The motion continues evenly.
        let drag_lsb = 40;
        for _ in 0..33 {
            let ([x, _, z], _) = bench.sample();
            assert!(x.abs() < drag_lsb && z == 256, "{x} {z}");
        }
        bench.write(POWER_CTL, 0);
        bench.wait(10.0);
        assert_eq!(bench.read(FIFO_STATUS), 0);
        // A read after weeks does not take long either.
        bench.measure(0x40);
        bench.wait(1e6);
        assert_eq!(bench.read(FIFO_STATUS), 32);
    }

    #[test]
    fn noise_grows_with_the_bandwidth_and_is_the_same_for_the_same_seed() {
        let deviation = |code: u8| {
            let mut bench = bench(0.0);
            bench.chip.chip.head.noise_lsb = 2.0;
            bench.measure(0x90);
            bench.write(BW_RATE, code);
            let mut samples = Vec::new();
            for _ in 0..4000 {
                bench.wait(1.0 / bench.chip.chip.rate_hz());
                let ([x, ..], filled) = bench.sample();
                samples.extend((filled > 0).then_some(f64::from(x)));
            }
            (samples.iter().map(|x| x * x).sum::<f64>() / samples.len() as f64).sqrt()
        };
        assert_eq!(deviation(0x0f), deviation(0x0f));
        assert!((deviation(0x0a) - 2.0).abs() < 0.15, "{}", deviation(0x0a));
        assert!((deviation(0x0c) - 4.0).abs() < 0.2, "{}", deviation(0x0c));
    }
}
