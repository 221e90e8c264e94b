// SPDX-License-Identifier: GPL-3.0-or-later
//! The accelerometer ADXL345 on SPI, after its data sheet (Analog Devices, rev. G: "Serial
//! Communications", "FIFO", "Interrupts", "Register Map"), on a head that rings.
//!
//! Each axis of the chip feels a mass on a spring. A motor moves the other end of the spring step by step:
//! `x'' = w^2 (u - x) - 2 d w x'` with the motor's position `u`, the resonance `w` as an angular frequency and the
//! damping ratio `d`. Between two steps `u` is constant, so the solution is exact. A sample is the mean acceleration
//! since the sample before, which is the difference of two speeds. This simulates the chip's own low-pass. Without it
//! the steps, far above the sampling rate, would appear as beats.
//!
//! Simulated: all registers; rates by the chip's own clock, ranges, full resolution and justification, offsets, noise;
//! the FIFO in its modes with watermark and overrun, and how it is read. Not simulated: taps, activity and free fall,
//! sleep and self test, the trigger mode (it works like the stream mode) and the interrupt pins (INT_SOURCE has the
//! same bits).

use std::collections::VecDeque;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::workshop::{Part, Socket, Workshop};
use crate::description::check::{Bound, Trouble, check, wrong};
use crate::description::pin::PinName;
use crate::description::printer::Printer;
use crate::engine::noise::Noise;
use crate::engine::ring::{Ring, RingConfig};
use crate::engine::spi::SpiChip;
use crate::klippy::layout::Layout;
use crate::klippy::sections::Sections;
use pinion_firmware::time::{CLOCK_FREQ, Clock, Ticks, TimeSource};

/// CPOL and CPHA are 1.
const MODE: u8 = 3;
/// Bits of a transfer's first byte.
const READ: u8 = 0x80;
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

const DEVICE_ID: u8 = 0xe5;
/// 100 samples a second.
const BW_RATE_RESET: u8 = 0x0a;
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
/// The first sample comes this time and one period after the start of the measurement.
const TURN_ON_S: f64 = 0.0011;
/// LSB per g in full resolution, at a supply of 3.3 V. There the x and y axes differ from the 256 at 2.5 V.
const LSB_PER_G: [f64; 3] = [265.0, 265.0, 256.0];
/// An offset's LSB is 15.6 mg, a sample's 3.9 mg.
const LSB_PER_OFFSET: f64 = 4.0;
/// The noise of the z axis is this many times the noise of the others (1.1 to 0.75 LSB).
const Z_NOISE: f64 = 1.1 / 0.75;
/// The rate at which `noise_lsb` is specified. The noise grows with the square root of the bandwidth.
const NOISE_RATE_HZ: f64 = 100.0;
const G_MM_PER_S2: f64 = 9806.65;

/// How long after a step the chip feels it. A computer is rarely as late. So the chip feels a step as if it had come at
/// its due time.
const DELAY_TICKS: u64 = Ticks::from_ms(100).0 as u64;

/// The chip's description.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Adxl345Config {
    /// Its SPI bus.
    pub bus: String,
    /// Low selects the chip. Without this pin it is the only chip on its bus.
    pub select_pin: Option<PinName>,
    /// How much faster its clock runs than it should.
    #[serde(default)]
    pub rate_off_percent: f64,
    /// Standard deviation of x and y at 100 samples a second, in LSB of 3.9 mg.
    #[serde(default)]
    pub noise_lsb: f64,
    /// The motion that it feels along x.
    pub x: Option<RingConfig>,
    /// The motion that it feels along y.
    pub y: Option<RingConfig>,
    /// The motion that it feels along z, in addition to gravity.
    pub z: Option<RingConfig>,
}

impl Adxl345Config {
    fn rings(&self) -> [(&'static str, Option<&RingConfig>); 3] {
        [("x", self.x.as_ref()), ("y", self.y.as_ref()), ("z", self.z.as_ref())]
    }
}

impl Part for Adxl345Config {
    fn name(&self) -> String {
        "adxl345".into()
    }

    fn socket(&self) -> Option<Socket<'_>> {
        Some(Socket::Spi { bus: &self.bus, select_pin: self.select_pin.as_ref() })
    }

    fn validate(&self, whose: &str, printer: &Printer<'_>) -> Result<(), Trouble> {
        check(whose, "rate_off_percent", self.rate_off_percent, Bound::Any)?;
        if self.rate_off_percent.abs() > 10.0 {
            return wrong(whose, "rate_off_percent", "no chip is so far off", "stay between -10 and 10");
        }
        check(whose, "noise_lsb", self.noise_lsb, Bound::NotNegative)?;
        for (key, ring) in self.rings() {
            let Some(ring) = ring else { continue };
            printer.check_rail(whose, &ring.axis)?;
            check(whose, key, ring.hz, Bound::AboveZero)?;
            if !(1e-6..0.99).contains(&ring.damping_ratio) {
                let cause = format!("a damping_ratio of {} does not ring", ring.damping_ratio);
                return wrong(whose, key, &cause, "give one between 0 and 0.99");
            }
        }
        Ok(())
    }

    fn build(&self, workshop: &mut Workshop<'_>) -> Result<(), Trouble> {
        let now = workshop.clock.now();
        let rings = self.rings().map(|(_, ring)| {
            let ring = ring?;
            Some(Ring::new(workshop.rail(&ring.axis)?, ring, now))
        });
        for ring in self.rings().into_iter().filter_map(|(_, ring)| ring) {
            let rail = workshop.rail(&ring.axis);
            workshop.world.rings.extend(rail.map(|rail| (rail, ring.clone())));
        }
        let noise = workshop.noise(self);
        workshop.solder_spi(self, Adxl345::new(self, rings, noise, workshop.clock.clone()));
        Ok(())
    }

    fn printer_cfg(&self, cfg: &mut Sections, layout: &Layout<'_>) {
        cfg.section("adxl345");
        cfg.spi(&self.bus, self.select_pin.as_ref());
        if !layout.has_head() {
            return;
        }
        // klippy shakes the head at this place.
        let [x_mm, y_mm] = layout.place_mm(0.5, 0.5);
        let z_mm = (layout.height_mm() / 2.0).min(20.0);
        cfg.section("resonance_tester");
        cfg.needs("adxl345");
        cfg.key("accel_chip", "adxl345");
        cfg.key("probe_points", format_args!("{x_mm}, {y_mm}, {z_mm}"));
        cfg.section("input_shaper");
    }
}

/// The chip's clock.
struct Sampling {
    /// When the first period began.
    start: Clock,
    period_ticks: f64,
    /// Number of samples taken.
    taken: u64,
}

impl Sampling {
    fn instant(&self, sample: u64) -> Clock {
        // A few years at most, far below 2^53 ticks.
        Clock::from_ticks(self.start.ticks() + (sample as f64 * self.period_ticks) as u64)
    }
}

/// The state of a transfer.
#[derive(Clone, Copy, PartialEq)]
enum Transfer {
    /// Waits for the first byte.
    Start,
    Read(u8),
    Write(u8),
}

struct Adxl345 {
    clock: Arc<dyn TimeSource>,
    rings: [Option<Ring>; 3],
    noise: Noise,
    noise_lsb: f64,
    rate_off: f64,
    /// By address; only the registers that hold what is written.
    registers: [u8; 0x40],
    sampling: Option<Sampling>,
    /// The speeds at the previous sample.
    speeds: [f64; 3],
    /// Unread samples, the oldest first; the next field is the last sample that was read.
    samples: VecDeque<[i16; 3]>,
    shown: [i16; 3],
    overrun: bool,
    transfer: Transfer,
    many: bool,
    /// Whether a data register was read. The sample leaves when the read moves beyond the data registers or ends.
    data_read: bool,
    /// FIFO_STATUS. It does not change for 5 us after a data read, which is longer than the rest of the transfer.
    status: u8,
}

impl Adxl345 {
    fn new(config: &Adxl345Config, rings: [Option<Ring>; 3], noise: Noise, clock: Arc<dyn TimeSource>) -> Adxl345 {
        let mut registers = [0; 0x40];
        registers[usize::from(DEVID)] = DEVICE_ID;
        registers[usize::from(BW_RATE)] = BW_RATE_RESET;
        Adxl345 {
            clock,
            rings,
            noise,
            noise_lsb: config.noise_lsb,
            rate_off: 1.0 + config.rate_off_percent / 100.0,
            registers,
            sampling: None,
            speeds: [0.0; 3],
            samples: VecDeque::with_capacity(FIFO + 1),
            shown: [0; 3],
            overrun: false,
            transfer: Transfer::Start,
            many: false,
            data_read: false,
            status: 0,
        }
    }

    fn get(&self, register: u8) -> u8 {
        self.registers[usize::from(register & ADDRESS)]
    }

    fn rate_hz(&self) -> f64 {
        TOP_RATE_HZ / f64::from(1u32 << (15 - (self.get(BW_RATE) & 0x0f)))
    }

    /// Number of samples that fit, and whether a new sample replaces the oldest.
    fn room(&self) -> (usize, bool) {
        match self.get(FIFO_CTL) >> 6 {
            0 => (1, true),
            1 => (FIFO + 1, false),
            _ => (FIFO + 1, true),
        }
    }

    /// Starts or stops the measurement according to the registers.
    fn restart(&mut self) {
        let now = self.clock.now();
        let ticks = f64::from(CLOCK_FREQ);
        let start = Clock::from_ticks(now.ticks() + (TURN_ON_S * ticks) as u64);
        self.sampling = (self.get(POWER_CTL) & MEASURE != 0).then(|| Sampling {
            start,
            period_ticks: ticks / (self.rate_hz() * self.rate_off),
            taken: 0,
        });
        self.feel(start);
    }

    /// The speeds at an instant.
    fn feel(&mut self, at: Clock) {
        let felt = Clock::from_ticks(at.ticks().saturating_sub(DELAY_TICKS));
        for (speed, ring) in self.speeds.iter_mut().zip(&mut self.rings) {
            *speed = ring.as_mut().map_or(0.0, |ring| ring.speed_at(felt));
        }
    }

    /// Takes the samples that have become due.
    fn catch_up(&mut self) {
        let now = self.clock.now();
        let Some(mut sampling) = self.sampling.take() else { return };
        let elapsed = now.since(sampling.start).max(0) as f64;
        let due = (elapsed / sampling.period_ticks) as u64;
        let (room, replaces) = self.room();
        if due - sampling.taken > 2 * room as u64 && replaces {
            // Skip the samples that the host will never read.
            sampling.taken = due - room as u64 - 1;
            self.overrun = true;
            self.feel(sampling.instant(sampling.taken));
        }
        while sampling.taken < due {
            sampling.taken += 1;
            let before = self.speeds;
            self.feel(sampling.instant(sampling.taken));
            let seconds = sampling.period_ticks / f64::from(CLOCK_FREQ);
            let accelerations = [0, 1, 2].map(|i| (self.speeds[i] - before[i]) / seconds / G_MM_PER_S2);
            let sample = self.digitize(accelerations);
            if self.samples.len() == room {
                self.overrun = true;
                if !replaces {
                    // The later samples do not fit either.
                    sampling.taken = due;
                    self.feel(sampling.instant(due));
                    break;
                }
                self.samples.pop_front();
            }
            self.samples.push_back(sample);
        }
        self.sampling = Some(sampling);
    }

    /// The register values for an acceleration in g.
    fn digitize(&mut self, [x, y, z]: [f64; 3]) -> [i16; 3] {
        let format = self.get(DATA_FORMAT);
        let range = format & RANGE;
        let scale = if format & FULL_RES == 0 { 1u32 << range } else { 1 };
        let bits = 10 + if format & FULL_RES == 0 { 0 } else { range };
        let limit = f64::from(1u32 << (bits - 1));
        let shift = if format & JUSTIFY == 0 { 0 } else { 16 - bits };
        let noise = self.noise_lsb * (self.rate_hz() / NOISE_RATE_HZ).sqrt();
        let g = [x, y, z + 1.0];
        [0, 1, 2].map(|i| {
            let noise = noise * self.noise.draw() * if i == 2 { Z_NOISE } else { 1.0 };
            let offset = f64::from(self.get(OFSX + i as u8) as i8) * LSB_PER_OFFSET;
            let lsb = (g[i] * LSB_PER_G[i] + offset + noise) / f64::from(scale);
            (lsb.round().clamp(-limit, limit - 1.0) as i16) << shift
        })
    }

    fn entries(&self) -> u8 {
        self.samples.len().min(FIFO) as u8
    }

    /// The sample in the data registers has been read.
    fn pop(&mut self) {
        if std::mem::take(&mut self.data_read)
            && let Some(sample) = self.samples.pop_front()
        {
            self.shown = sample;
            self.overrun = false;
        }
    }

    fn read(&mut self, register: u8) -> u8 {
        match register {
            DATAX0..=DATAZ1 => {
                self.data_read = true;
                let sample = self.samples.front().unwrap_or(&self.shown);
                let place = usize::from(register - DATAX0);
                sample[place / 2].to_le_bytes()[place % 2]
            }
            INT_SOURCE => {
                let ready = if self.samples.is_empty() { 0 } else { DATA_READY };
                let watermark = if self.entries() >= self.get(FIFO_CTL) & 0x1f { WATERMARK } else { 0 };
                ready | watermark | if self.overrun { OVERRUN } else { 0 }
            }
            FIFO_STATUS => self.status,
            _ => self.get(register),
        }
    }

    fn write(&mut self, register: u8, value: u8) {
        if matches!(register, THRESH_TAP..=FIFO_CTL)
            && !matches!(register, ACT_TAP_STATUS | INT_SOURCE | DATAX0..=DATAZ1)
        {
            self.registers[usize::from(register)] = value;
        }
        match register {
            POWER_CTL | BW_RATE => self.restart(),
            // The bypass mode empties the FIFO.
            FIFO_CTL if value >> 6 == 0 => {
                self.samples.clear();
                self.overrun = false;
            }
            _ => {}
        }
    }
}

impl SpiChip for Adxl345 {
    fn knows_mode(&self, mode: u8) -> bool {
        mode == MODE
    }

    fn select(&mut self, _rate_hz: u32) {
        self.catch_up();
        self.status = self.entries();
        self.transfer = Transfer::Start;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        let next = |register: u8, many: bool| if many { (register + 1) & ADDRESS } else { register };
        match self.transfer {
            Transfer::Start => {
                let register = byte & ADDRESS;
                self.many = byte & MULTIPLE_BYTES != 0;
                self.transfer = if byte & READ == 0 { Transfer::Write(register) } else { Transfer::Read(register) };
                0
            }
            Transfer::Read(register) => {
                let value = self.read(register);
                self.transfer = Transfer::Read(next(register, self.many));
                if self.transfer == Transfer::Read(FIFO_CTL) {
                    self.pop();
                }
                value
            }
            Transfer::Write(register) => {
                self.write(register, byte);
                self.transfer = Transfer::Write(next(register, self.many));
                0
            }
        }
    }

    fn deselect(&mut self) {
        self.pop();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::default::DefaultPrinter;
    use crate::engine::motion::Axis;
    use pinion_firmware::time::VirtualClock;
    use std::f64::consts::TAU;

    const X_HZ: f64 = 57.0;
    const DAMPING: f64 = 0.1;

    struct Bench {
        axis: Arc<Axis>,
        clock: VirtualClock,
        chip: Adxl345,
    }

    impl Bench {
        /// A chip without noise. Its x axis rings.
        fn new(rate_off_percent: f64) -> Bench {
            let clock = VirtualClock::at(Clock::from_ticks(1_000_000_000));
            let axis = Arc::new(Axis::new(&DefaultPrinter::read().axes[0]));
            axis.set_enabled(true);
            axis.set_forward(true);
            let ring = RingConfig { axis: "x".into(), hz: X_HZ, damping_ratio: DAMPING };
            let rings = [Some(Ring::new(axis.rail().clone(), &ring, clock.now())), None, None];
            let config = Adxl345Config {
                bus: "spidev1.0".into(),
                select_pin: None,
                rate_off_percent,
                noise_lsb: 0.0,
                x: Some(ring),
                y: None,
                z: None,
            };
            let chip = Adxl345::new(&config, rings, Noise::of("adxl345", 1), Arc::new(clock.clone()));
            Bench { axis, clock, chip }
        }

        fn wait(&self, seconds: f64) {
            let ticks = (seconds * f64::from(CLOCK_FREQ)).round() as u64;
            self.clock.set(Clock::from_ticks(self.clock.now().ticks() + ticks));
        }

        fn exchange<const N: usize>(&mut self, mut bytes: [u8; N]) -> [u8; N] {
            self.chip.select(5_000_000);
            bytes.iter_mut().for_each(|byte| *byte = self.chip.exchange(*byte));
            self.chip.deselect();
            bytes
        }

        fn read(&mut self, register: u8) -> u8 {
            self.exchange([register | READ, 0])[1]
        }

        fn write(&mut self, register: u8, value: u8) {
            self.exchange([register, value]);
        }

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

        fn step(&self) {
            self.axis.edge(true, self.clock.now());
            self.axis.edge(false, self.clock.now());
        }
    }

    #[test]
    fn registers_are_as_in_the_data_sheet() {
        let mut bench = Bench::new(0.0);
        for (register, value) in [(DEVID, 0xe5), (BW_RATE, 0x0a), (POWER_CTL, 0), (INT_SOURCE, 2), (FIFO_STATUS, 0)] {
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
        let mut bench = Bench::new(0.4);
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
            let mut bench = Bench::new(0.0);
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
            let mut bench = Bench::new(0.0);
            bench.write(DATA_FORMAT, format);
            bench.write(POWER_CTL, MEASURE);
            bench.wait(0.1);
            assert_eq!(bench.sample().0, [0, 0, z], "{format:#04x}");
        }
    }

    #[test]
    fn the_head_rings_as_the_differential_equation_says() {
        let mut bench = Bench::new(0.0);
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
        let mut bench = Bench::new(0.0);
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
            let mut bench = Bench::new(0.0);
            bench.chip.noise_lsb = 2.0;
            bench.measure(0x90);
            bench.write(BW_RATE, code);
            let mut samples = Vec::new();
            for _ in 0..4000 {
                bench.wait(1.0 / bench.chip.rate_hz());
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
