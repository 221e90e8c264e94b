// SPDX-License-Identifier: GPL-3.0-or-later
//! Filters of second-order sections in fixed point, for the samples of a sensor that triggers.
//!
//! klippy designs the filter (scipy's `sosfilt`) and sends its coefficients as integers. Each result equals
//! the result of Klipper's C to the bit, even if its 32-bit sums wrap.

use crate::mcu::DialectName::{Kalico, Master};
use crate::mcu::{Command, Feature, Object, Oid, command};
use crate::shutdown::{Shutdown, shutdowns};

pub(super) const FEATURE: Feature = Feature {
    serves: "load cell probes",

    commands: &[
        CONFIG_SOS_FILTER,
        SOS_FILTER_SET_SECTION,
        SOS_FILTER_SET_STATE,
        SOS_FILTER_SET_OFFSET_SCALE,
        SOS_FILTER_SET_ACTIVE,
        SOS_FILTER_SET_ACTIVE_OF_KALICO,
    ],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A section beyond the `max_sections` of its filter.
    SECTION_INDEX = "Filter section index larger than max_sections";
    /// Kalico: a sample for a filter that was not set active.
    NOT_ACTIVE = "sos_filter not property initialized";
    /// Kalico: a product does not fit 32 bits.
    FILTER_OVERFLOW = "fixed_mul: overflow";
}

/// A result does not fit 32 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Overflow;

/// The used bits of a count of fractional bits.
const FRAC_BITS_MASK: u8 = 0x3f;

/// The product of a coefficient with `frac_bits` fractional bits and a value, rounded half up.
fn fixed_mul(coefficient: i32, value: i32, frac_bits: u8) -> Result<i32, Overflow> {
    let mut product = i64::from(coefficient) * i64::from(value);
    if frac_bits > 0 {
        // Wraps for -2^31 times -2^31 with 63 fractional bits, as on the processors of Klipper's C.
        product = product.wrapping_add(1 << (frac_bits - 1)) >> frac_bits;
    }
    i32::try_from(product).map_err(|_| Overflow)
}

/// A second-order section in the transposed direct form II; a0 is 1.
#[derive(Clone, Copy, Default)]
struct Section {
    /// b0, b1, b2, a1, a2.
    coefficients: [i32; 5],
    state: [i32; 2],
}

impl Section {
    /// Filters a value. An overflow leaves the state unchanged.
    fn apply(&mut self, input: i32, frac_bits: u8) -> Result<i32, Overflow> {
        let [b0, b1, b2, a1, a2] = self.coefficients;
        let output = fixed_mul(b0, input, frac_bits)?.wrapping_add(self.state[0]);
        let forward = [fixed_mul(b1, input, frac_bits)?, fixed_mul(b2, input, frac_bits)?];
        let back = [fixed_mul(a1, output, frac_bits)?, fixed_mul(a2, output, frac_bits)?];
        self.state = [forward[0].wrapping_sub(back[0]).wrapping_add(self.state[1]), forward[1].wrapping_sub(back[1])];
        Ok(output)
    }
}

pub(super) struct SosFilter {
    /// There are `max_sections` of them.
    sections: Box<[Section]>,
    /// How many sections a value goes through, from the first one on.
    active: usize,
    /// Whether the filter was set active after the last change of a section.
    is_ready: bool,
    coeff_frac_bits: u8,
    offset: i32,
    scale: i32,
    scale_frac_bits: u8,
    /// Whether the next value becomes zero: its negative becomes the offset.
    auto_offset: bool,
}

impl SosFilter {
    fn new(max_sections: u8) -> SosFilter {
        SosFilter {
            sections: vec![Section::default(); usize::from(max_sections)].into(),
            active: 0,
            is_ready: false,
            coeff_frac_bits: 0,
            offset: 0,
            scale: 0,
            scale_frac_bits: 0,
            auto_offset: false,
        }
    }

    /// Filters a sample. If a section overflows, the sections before it have already changed their state.
    pub(super) fn apply(&mut self, sample: i32) -> Result<i32, Overflow> {
        if std::mem::take(&mut self.auto_offset) {
            self.offset = sample.wrapping_neg();
        }
        let shifted = sample.checked_add(self.offset).ok_or(Overflow)?;
        self.filter(fixed_mul(self.scale, shifted, self.scale_frac_bits)?)
    }

    /// Filters a value that is already scaled.
    fn filter(&mut self, scaled: i32) -> Result<i32, Overflow> {
        self.sections[..self.active]
            .iter_mut()
            .try_fold(scaled, |value, section| section.apply(value, self.coeff_frac_bits))
    }

    /// Filters a value for Kalico. Its load cell probes scale the value themselves.
    ///
    /// # Errors
    ///
    /// "sos_filter not property initialized", "fixed_mul: overflow".
    pub(super) fn apply_scaled(&mut self, scaled: i32) -> Result<i32, Shutdown> {
        if !self.is_ready {
            return Err(Shutdown::by_host(NOT_ACTIVE, "a sample came before sos_filter_set_active"));
        }
        self.filter(scaled).map_err(|Overflow| {
            Shutdown::because(FILTER_OVERFLOW, "a filtered value does not fit 32 bits")
                .remedy("check the load cell's wires, calibration and filter settings")
        })
    }

    /// Returns a section for a change. The filter is off until `sos_filter_set_active`.
    fn section(&mut self, index: u8) -> Result<&mut Section, Shutdown> {
        let max_sections = self.sections.len();
        let section = self.sections.get_mut(usize::from(index)).ok_or_else(|| {
            Shutdown::by_host(SECTION_INDEX, format_args!("section {index} is set of a filter with {max_sections}"))
        })?;
        self.active = 0;
        self.is_ready = false;
        Ok(section)
    }

    fn activate(&mut self, n_sections: u8, coeff_frac_bits: u8) -> Result<(), Shutdown> {
        let max_sections = self.sections.len();
        if usize::from(n_sections) > max_sections {
            return Err(Shutdown::by_host(
                SECTION_INDEX,
                format_args!("{n_sections} sections are to be active of a filter with {max_sections}"),
            ));
        }
        self.active = usize::from(n_sections);
        self.is_ready = true;
        self.coeff_frac_bits = coeff_frac_bits & FRAC_BITS_MASK;
        Ok(())
    }
}

impl Object for SosFilter {
    fn kind(&self) -> &'static str {
        "SOS filter"
    }
}

const CONFIG_SOS_FILTER: Command =
    command!("config_sos_filter oid=%c max_sections=%c", |context, oid: Oid, max_sections: u8| {
        context.assign(oid, SosFilter::new(max_sections))
    })
    .of(&[Master, Kalico]);

const SOS_FILTER_SET_SECTION: Command = command!(
    "sos_filter_set_section oid=%c section_idx=%c sos0=%i sos1=%i sos2=%i sos3=%i sos4=%i",
    SosFilter,
    |filter, _, section_idx: u8, sos0: i32, sos1: i32, sos2: i32, sos3: i32, sos4: i32| {
        filter.section(section_idx)?.coefficients = [sos0, sos1, sos2, sos3, sos4];
        Ok(())
    }
)
.of(&[Master, Kalico]);

const SOS_FILTER_SET_STATE: Command = command!(
    "sos_filter_set_state oid=%c section_idx=%c state0=%i state1=%i",
    SosFilter,
    |filter, _, section_idx: u8, state0: i32, state1: i32| {
        filter.section(section_idx)?.state = [state0, state1];
        Ok(())
    }
)
.of(&[Master, Kalico]);

const SOS_FILTER_SET_OFFSET_SCALE: Command = command!(
    "sos_filter_set_offset_scale oid=%c offset=%i scale=%i scale_frac_bits=%c auto_offset=%c",
    SosFilter,
    |filter, _, offset: i32, scale: i32, scale_frac_bits: u8, auto_offset: bool| {
        filter.offset = offset;
        filter.scale = scale;
        filter.scale_frac_bits = scale_frac_bits & FRAC_BITS_MASK;
        filter.auto_offset = auto_offset;
        Ok(())
    }
)
.of(&[Master]);

const SOS_FILTER_SET_ACTIVE: Command = command!(
    "sos_filter_set_active oid=%c n_sections=%c coeff_frac_bits=%c",
    SosFilter,
    |filter, _, n_sections: u8, coeff_frac_bits: u8| filter.activate(n_sections, coeff_frac_bits)
)
.of(&[Master]);

const SOS_FILTER_SET_ACTIVE_OF_KALICO: Command = command!(
    "sos_filter_set_active oid=%c n_sections=%c coeff_int_bits=%c",
    SosFilter,
    |filter, _, n_sections: u8, coeff_int_bits: u8| {
        // One bit of the 32 is the sign.
        let coeff_frac_bits = 31u8.wrapping_sub(coeff_int_bits);
        filter.activate(n_sections, coeff_frac_bits)
    }
)
.of(&[Kalico]);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::collection::vec;
    use proptest::prelude::*;

    /// The part of a sum that a 32-bit register keeps.
    fn wrapped(sum: i128) -> i128 {
        (sum + (1 << 31)).rem_euclid(1 << 32) - (1 << 31)
    }

    /// A product in units of 2^-`frac_bits`, rounded half up. `None`: it does not fit.
    fn product(a: i128, b: i128, frac_bits: u32) -> Option<i128> {
        let unit = 1i128 << frac_bits;
        let rounded = (2 * a * b + unit).div_euclid(2 * unit);
        (wrapped(rounded) == rounded).then_some(rounded)
    }

    /// The filter in numbers wide enough to lose nothing.
    struct Wide {
        sections: Vec<([i128; 5], [i128; 2])>,
        frac_bits: u32,
    }

    impl Wide {
        fn apply(&mut self, sample: i128, offset: i128, scale: i128, scale_frac_bits: u32) -> Option<i128> {
            let shifted = sample + offset;
            if wrapped(shifted) != shifted {
                return None;
            }
            let mut x = product(scale, shifted, scale_frac_bits)?;
            for ([b0, b1, b2, a1, a2], state) in &mut self.sections {
                let y = wrapped(product(*b0, x, self.frac_bits)? + state[0]);
                let s0 = product(*b1, x, self.frac_bits)? - product(*a1, y, self.frac_bits)? + state[1];
                let s1 = product(*b2, x, self.frac_bits)? - product(*a2, y, self.frac_bits)?;
                *state = [wrapped(s0), wrapped(s1)];
                x = y;
            }
            Some(x)
        }
    }

    fn number() -> impl Strategy<Value = i32> {
        prop_oneof![
            any::<i32>(),
            -70_000..70_000i32,
            prop::sample::select(vec![i32::MIN, i32::MIN + 1, -1, 0, 1, i32::MAX - 1, i32::MAX]),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

        #[test]
        fn every_bit_is_that_of_wide_arithmetic(
            design in vec((vec(number(), 5), number(), number()), 0..5),
            samples in vec(number(), 1..40),
            // 63 is a separate case, below.
            frac_bits in 0u8..63,
            scale in number(),
            scale_frac_bits in 0u8..63,
            offset in number(),
            auto_offset: bool,
        ) {
            let mut filter = SosFilter::new(design.len() as u8);
            let mut wide = Wide { sections: Vec::new(), frac_bits: frac_bits.into() };
            for (index, (coefficients, state0, state1)) in design.iter().enumerate() {
                let section = filter.section(index as u8).unwrap();
                section.coefficients.copy_from_slice(coefficients);
                section.state = [*state0, *state1];
                let coefficients = coefficients.iter().map(|c| i128::from(*c)).collect::<Vec<_>>();
                wide.sections.push((coefficients.try_into().unwrap(), [i128::from(*state0), i128::from(*state1)]));
            }
            filter.activate(design.len() as u8, frac_bits).unwrap();
            (filter.offset, filter.scale) = (offset, scale);
            (filter.scale_frac_bits, filter.auto_offset) = (scale_frac_bits, auto_offset);
            let offset = if auto_offset { wrapped(-i128::from(samples[0])) } else { offset.into() };
            for sample in samples {
                let expected = wide.apply(sample.into(), offset, scale.into(), scale_frac_bits.into());
                prop_assert_eq!(filter.apply(sample).ok().map(i128::from), expected);
            }
        }
    }

    #[test]
    fn the_product_that_has_no_room_in_64_bits_wraps() {
        assert_eq!(fixed_mul(i32::MIN, i32::MIN, 63), Ok(-1));
        assert_eq!(fixed_mul(i32::MIN, i32::MIN, 62), Ok(1));
        assert_eq!(fixed_mul(i32::MAX, i32::MIN, 63), Ok(0));
    }

    #[test]
    fn a_half_is_rounded_up_on_either_side_of_zero() {
        let halves: Vec<i32> = (-5..=5).map(|value| fixed_mul(1, value, 1).unwrap()).collect();
        assert_eq!(halves, [-2, -2, -1, -1, 0, 0, 1, 1, 2, 2, 3]);
    }

    /// klippy's low pass of 25 Hz at 400 samples per second, with 29 fractional bits.
    fn low_pass() -> SosFilter {
        let mut filter = SosFilter::new(2);
        filter.section(0).unwrap().coefficients = [501_168, 1_002_337, 501_168, -732_891_736, 256_405_387];
        filter.section(1).unwrap().coefficients = [536_870_912, 1_073_741_824, 536_870_912, -865_289_396, 399_711_581];
        filter.activate(2, 29).unwrap();
        filter.scale = 1;
        filter
    }

    /// The results of Klipper's C program for these samples. They include an overflow of the offset and one of a
    /// section.
    #[test]
    fn a_low_pass_answers_as_the_firmware() {
        let mut filter = low_pass();
        filter.sections[0].state = [1000, -777];
        filter.sections[1].state = [2000, -1554];
        (filter.offset, filter.scale, filter.scale_frac_bits) = (-1234, 3 << 20, 21);
        let answers = [
            (0, Ok(2998)),
            (1_000_000, Ok(7255)),
            (-8_388_608, Ok(7695)),
            (8_388_607, Ok(-24_951)),
            (8_388_607, Ok(-94_893)),
            (123_456, Ok(-113_907)),
            (-1, Ok(44_746)),
            (i32::MAX, Err(Overflow)),
            (5, Ok(422_147)),
            (i32::MIN, Err(Overflow)),
            (77, Ok(946_232)),
            (8_388_607, Ok(1_504_382)),
            (1_000_000_000, Ok(3_425_305)),
            (-1_000_000_000, Ok(10_859_296)),
            (400_000_000, Ok(26_362_059)),
            (17, Ok(46_346_524)),
        ];
        for (sample, answer) in answers {
            assert_eq!(filter.apply(sample), answer, "{sample}");
        }
        let states: Vec<[i32; 2]> = filter.sections.iter().map(|section| section.state).collect();
        assert_eq!(states, [[2_255_696, -1_111_695], [62_829_287, -32_178_250]]);
    }

    #[test]
    fn a_low_pass_settles_at_its_input_with_the_delay_of_a_filter_in_real_numbers() {
        let mut filter = low_pass();
        let mut real = filter.sections.iter().map(|section| {
            let coefficients = section.coefficients.map(|coefficient| f64::from(coefficient) / f64::from(1 << 29));
            (coefficients, [0.0; 2])
        });
        let mut real: Vec<([f64; 5], [f64; 2])> = real.by_ref().collect();
        for n in 0..200 {
            let value = filter.apply(1_000_000).unwrap();
            let expected = real.iter_mut().fold(1e6, |x, ([b0, b1, b2, a1, a2], state)| {
                let y = *b0 * x + state[0];
                *state = [*b1 * x - *a1 * y + state[1], *b2 * x - *a2 * y];
                y
            });
            // Each section rounds its results to integers, and the next one amplifies the rounding.
            assert!(
                (f64::from(value) - expected).abs() < 2000.0,
                "sample {n}: {value}, and in real numbers {expected}"
            );
            assert!(n < 150 || (value - 1_000_000).abs() < 2000, "sample {n}: {value}");
        }
    }
}
