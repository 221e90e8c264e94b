// SPDX-License-Identifier: GPL-3.0-or-later
//! Message formats, for example `queue_step oid=%c interval=%u count=%hu add=%hi`: how to parse them, and the Rust
//! types for their parameters.

use super::Malformed;
use super::clock::Clock;
use super::vlq::{Reader, Writer};

/// How a parameter is written on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Conversion {
    /// `%u`
    U32,
    /// `%i`
    I32,
    /// `%hu`
    U16,
    /// `%hi`
    I16,
    /// `%c`
    Byte,
    /// `%*s`, `%.*s` or `%s`
    Bytes,
}

impl Conversion {
    /// Parses a printf conversion.
    pub fn parse(text: &str) -> Option<Conversion> {
        Some(match text {
            "%u" => Conversion::U32,
            "%i" => Conversion::I32,
            "%hu" => Conversion::U16,
            "%hi" => Conversion::I16,
            "%c" => Conversion::Byte,
            "%*s" | "%.*s" | "%s" => Conversion::Bytes,
            _ => return None,
        })
    }

    /// Reads past a value of this kind.
    pub fn skip(self, reader: &mut Reader<'_>) -> Result<(), Malformed> {
        match self {
            Conversion::Bytes => reader.bytes().map(drop),
            _ => reader.int().map(drop),
        }
    }
}

/// The name of a message: the first word of its format.
pub fn name(format: &str) -> &str {
    format.split(' ').next().unwrap_or(format)
}

/// The parameters of a message; `None` if the format is not valid.
pub fn parameters(format: &str) -> Option<Vec<(&str, Conversion)>> {
    format
        .split(' ')
        .skip(1)
        .map(|word| {
            let (name, conversion) = word.split_once('=')?;
            Some((name, Conversion::parse(conversion)?))
        })
        .collect()
}

/// A Rust type for a command's parameter.
pub trait Arg<'m>: Sized {
    /// The conversions that this type may have.
    const CONVERSIONS: &'static [&'static str];
    /// Reads a value.
    fn decode(reader: &mut Reader<'m>) -> Result<Self, Malformed>;
}

/// A Rust type for a response's parameter.
pub trait Field {
    /// The conversions that this type may have.
    const CONVERSIONS: &'static [&'static str];
    /// Appends the value.
    fn encode(&self, writer: &mut Writer);
}

macro_rules! integers {
    ($($t:ty: $($conversion:literal)|+;)*) => {$(
        // Klipper's C uses an integer's low bits, for every conversion.
        impl Arg<'_> for $t {
            const CONVERSIONS: &'static [&'static str] = &[$($conversion),+];
            #[inline]
            fn decode(reader: &mut Reader<'_>) -> Result<$t, Malformed> {
                reader.int().map(|value| value as $t)
            }
        }
        impl Field for $t {
            const CONVERSIONS: &'static [&'static str] = &[$($conversion),+];
            fn encode(&self, writer: &mut Writer) {
                writer.int(*self as u32);
            }
        }
    )*};
}

integers! {
    u8: "%c";
    i8: "%c";
    u16: "%hu";
    i16: "%hi";
    u32: "%u";
    i32: "%i";
}

impl Arg<'_> for bool {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    fn decode(reader: &mut Reader<'_>) -> Result<bool, Malformed> {
        reader.int().map(|value| value != 0)
    }
}

impl Field for bool {
    const CONVERSIONS: &'static [&'static str] = &["%c"];
    fn encode(&self, writer: &mut Writer) {
        writer.int(u32::from(*self));
    }
}

impl<'m> Arg<'m> for &'m [u8] {
    const CONVERSIONS: &'static [&'static str] = &["%*s", "%.*s"];
    fn decode(reader: &mut Reader<'m>) -> Result<&'m [u8], Malformed> {
        reader.bytes()
    }
}

impl Field for &[u8] {
    const CONVERSIONS: &'static [&'static str] = &["%*s", "%.*s"];
    fn encode(&self, writer: &mut Writer) {
        writer.string(self);
    }
}

/// Writes the low 32 bits.
impl Field for Clock {
    const CONVERSIONS: &'static [&'static str] = &["%u"];
    fn encode(&self, writer: &mut Writer) {
        writer.int(self.wire());
    }
}

/// A parameter as a handler declares it: its name and its type's conversions.
pub struct Spec {
    /// The parameter's name.
    pub name: &'static str,
    /// The conversions of its type.
    pub conversions: &'static [&'static str],
}

/// Whether `format` has exactly these parameters, in this order, with conversions that their types accept. The compiler
/// evaluates it.
pub const fn agrees(format: &str, specs: &[Spec]) -> bool {
    let format = format.as_bytes();
    let mut at = 0;
    while at < format.len() && format[at] != b' ' {
        at += 1;
    }
    let mut n = 0;
    while n < specs.len() {
        if !starts(format, at, b" ") {
            return false;
        }
        at += 1;
        let name = specs[n].name.as_bytes();
        if !starts(format, at, name) || !starts(format, at + name.len(), b"=") {
            return false;
        }
        at += name.len() + 1;
        let mut c = 0;
        let mut hit = 0;
        while c < specs[n].conversions.len() {
            let conversion = specs[n].conversions[c].as_bytes();
            let end = at + conversion.len();
            if starts(format, at, conversion) && (end == format.len() || format[end] == b' ') {
                hit = conversion.len();
            }
            c += 1;
        }
        if hit == 0 {
            return false;
        }
        at += hit;
        n += 1;
    }
    at == format.len()
}

/// Whether the two texts are equal. (`==` does not work in a `const fn` yet.)
pub const fn same(a: &str, b: &str) -> bool {
    a.len() == b.len() && starts(a.as_bytes(), 0, b.as_bytes())
}

const fn starts(bytes: &[u8], at: usize, prefix: &[u8]) -> bool {
    let mut i = 0;
    while i < prefix.len() {
        if at + i >= bytes.len() || bytes[at + i] != prefix[i] {
            return false;
        }
        i += 1;
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    const OID: Spec = Spec { name: "oid", conversions: &["%c"] };
    const CLOCK: Spec = Spec { name: "clock", conversions: &["%u"] };

    #[test]
    fn a_declaration_that_disagrees_is_seen() {
        let format = "reset_step_clock oid=%c clock=%u";
        assert!(agrees(format, &[OID, CLOCK]));
        assert!(!agrees(format, &[CLOCK, OID]));
        assert!(!agrees(format, &[OID]));
        assert!(!agrees("reset_step_clock oid=%c clock=%hu", &[OID, CLOCK]));
        assert!(!agrees("reset_step_clock oid=%c clock=%u ", &[OID, CLOCK]));
        assert!(agrees("get_clock", &[]));
        const COUNT: Spec = Spec { name: "count", conversions: &["%c", "%hu"] };
        assert!(agrees("get count=%hu oid=%c", &[COUNT, OID]));
        assert!(agrees("get count=%c oid=%c", &[COUNT, OID]));
        for format in [
            "get",
            "get count",
            "get count=",
            "get count=%h",
            "get count=%cx",
            "get count=%c oid",
            "get_count=%c",
            "get total=%c",
        ] {
            assert!(!agrees(format, &[COUNT]), "{format}");
        }
    }

    #[test]
    fn texts_are_the_same_only_if_they_are_equal() {
        assert!(same("", "") && same("%c", "%c"));
        assert!(!same("%c", "%u") && !same("%c", "%cc") && !same("%cc", "%c"));
    }

    #[test]
    fn formats_are_taken_apart() {
        let format = "spi_transfer oid=%c data=%*s";
        assert_eq!(name(format), "spi_transfer");
        assert_eq!(parameters(format), Some(vec![("oid", Conversion::Byte), ("data", Conversion::Bytes)]));
        assert_eq!(parameters("get_clock"), Some(vec![]));
        assert_eq!(parameters("broken oid"), None);
        assert_eq!(parameters("broken oid=%d"), None);
    }

    #[test]
    fn every_conversion_is_known_and_skipped() {
        for (text, conversion, bytes) in [
            ("%u", Conversion::U32, &[0x81, 0x00][..]),
            ("%i", Conversion::I32, &[0x7f]),
            ("%hu", Conversion::U16, &[0x81, 0x00]),
            ("%hi", Conversion::I16, &[0x7f]),
            ("%c", Conversion::Byte, &[0x05]),
            ("%*s", Conversion::Bytes, &[2, 0x81, 0x82]),
            ("%.*s", Conversion::Bytes, &[0]),
            ("%s", Conversion::Bytes, &[1, 0x81]),
        ] {
            assert_eq!(Conversion::parse(text), Some(conversion));
            let bytes = [bytes, b"rest"].concat();
            let mut reader = Reader::new(&bytes);
            assert_eq!(conversion.skip(&mut reader), Ok(()), "{text}");
            assert_eq!(reader.rest(), b"rest", "{text}");
            assert_eq!(conversion.skip(&mut Reader::new(&[])), Err(Malformed), "{text}");
        }
    }

    #[test]
    fn values_are_written_as_the_types_of_their_parameters_and_read_back() {
        let mut writer = Writer::default();
        200u8.encode(&mut writer);
        (-100i8).encode(&mut writer);
        60_000u16.encode(&mut writer);
        (-30_000i16).encode(&mut writer);
        u32::MAX.encode(&mut writer);
        i32::MIN.encode(&mut writer);
        true.encode(&mut writer);
        b"bytes".as_slice().encode(&mut writer);
        Clock::from_ticks((1 << 32) + 9).encode(&mut writer);
        let mut reader = Reader::new(writer.payload().unwrap());
        assert_eq!(u8::decode(&mut reader), Ok(200));
        assert_eq!(i8::decode(&mut reader), Ok(-100));
        assert_eq!(u16::decode(&mut reader), Ok(60_000));
        assert_eq!(i16::decode(&mut reader), Ok(-30_000));
        assert_eq!(u32::decode(&mut reader), Ok(u32::MAX));
        assert_eq!(i32::decode(&mut reader), Ok(i32::MIN));
        assert_eq!(bool::decode(&mut reader), Ok(true));
        assert_eq!(<&[u8]>::decode(&mut reader), Ok(b"bytes".as_slice()));
        assert_eq!(u32::decode(&mut reader), Ok(9));
        assert!(reader.is_empty());
        assert_eq!(bool::decode(&mut Reader::new(&[0])), Ok(false));
        assert_eq!(u8::decode(&mut Reader::new(&[0x82, 0x01])), Ok(1), "the low bits");
    }
}
