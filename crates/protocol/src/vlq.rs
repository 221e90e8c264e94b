// SPDX-License-Identifier: GPL-3.0-or-later
//! Variable length quantities: seven bits a byte, high bits first. The top bit is set on all bytes except the last. A
//! number is negative if bits 5 and 6 of the first byte are both set.

use super::Malformed;

/// Reads a message's values from the front of its bytes.
#[derive(Clone, Copy, Debug)]
pub struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    /// A reader at the start of `bytes`.
    pub fn new(bytes: &'a [u8]) -> Reader<'a> {
        Reader(bytes)
    }

    /// Whether all bytes are read.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The bytes not yet read.
    pub fn rest(&self) -> &'a [u8] {
        self.0
    }

    /// The next integer, modulo 2^32. A longer encoding wraps, as in Klipper's C.
    #[inline]
    pub fn int(&mut self) -> Result<u32, Malformed> {
        let mut byte = self.byte()?;
        let mut value = u32::from(byte & 0x7f);
        if byte & 0x60 == 0x60 {
            value |= 0x20u32.wrapping_neg();
        }
        while byte & 0x80 != 0 {
            byte = self.byte()?;
            value = value << 7 | u32::from(byte & 0x7f);
        }
        Ok(value)
    }

    /// The next byte string: a length byte and that many bytes.
    #[inline]
    pub fn bytes(&mut self) -> Result<&'a [u8], Malformed> {
        let len = usize::from(self.byte()?);
        let (bytes, rest) = self.0.split_at_checked(len).ok_or(Malformed)?;
        self.0 = rest;
        Ok(bytes)
    }

    #[inline]
    fn byte(&mut self) -> Result<u8, Malformed> {
        let (first, rest) = self.0.split_first().ok_or(Malformed)?;
        self.0 = rest;
        Ok(*first)
    }
}

/// Writes a message's values into a message block's payload.
#[derive(Clone, Copy, Debug)]
pub struct Writer {
    len: usize,
    overflow: bool,
    bytes: [u8; super::block::PAYLOAD_MAX],
}

impl Default for Writer {
    fn default() -> Writer {
        Writer { len: 0, overflow: false, bytes: [0; super::block::PAYLOAD_MAX] }
    }
}

impl Writer {
    /// Appends an integer.
    pub fn int(&mut self, value: u32) {
        let signed = value as i32;
        for shift in [28, 21, 14, 7] {
            // One byte less has room for values from -2^(shift-2) to 3 * 2^(shift-2) - 1.
            let reach = 1i32 << (shift - 2);
            if signed < -reach || i64::from(signed) >= 3 * i64::from(reach) {
                self.byte((value >> shift) as u8 & 0x7f | 0x80);
            }
        }
        self.byte(value as u8 & 0x7f);
    }

    /// Appends a byte string.
    pub fn string(&mut self, bytes: &[u8]) {
        match u8::try_from(bytes.len()) {
            Ok(len) => self.byte(len),
            Err(_) => self.overflow = true,
        }
        for byte in bytes {
            self.byte(*byte);
        }
    }

    /// The payload, or `None` if the values did not fit.
    pub fn payload(&self) -> Option<&[u8]> {
        (!self.overflow).then(|| &self.bytes[..self.len])
    }

    #[inline]
    fn byte(&mut self, byte: u8) {
        match self.bytes.get_mut(self.len) {
            Some(slot) => {
                *slot = byte;
                self.len += 1;
            }
            None => self.overflow = true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encoded(value: u32) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.int(value);
        writer.payload().unwrap().to_vec()
    }

    proptest! {
        #[test]
        fn integers_round_trip(value: u32) {
            let bytes = encoded(value);
            let mut reader = Reader::new(&bytes);
            prop_assert_eq!(reader.int(), Ok(value));
            prop_assert!(reader.is_empty());
        }

        #[test]
        fn strings_round_trip(value in proptest::collection::vec(any::<u8>(), 0..58)) {
            let mut writer = Writer::default();
            writer.string(&value);
            prop_assert_eq!(Reader::new(writer.payload().unwrap()).bytes(), Ok(&value[..]));
        }

        #[test]
        fn any_bytes_are_read_without_a_panic(bytes: Vec<u8>) {
            let mut reader = Reader::new(&bytes);
            while reader.int().is_ok() && reader.bytes().is_ok() {}
        }
    }

    #[test]
    fn lengths_are_those_of_the_protocol_document() {
        // docs/Protocol.md, "Variable length quantities".
        for (value, len) in [
            (-33i64, 2),
            (-32, 1),
            (95, 1),
            (96, 2),
            (-4097, 3),
            (-4096, 2),
            (12287, 2),
            (12288, 3),
            (-524289, 4),
            (-524288, 3),
            (1572863, 3),
            (1572864, 4),
            (-67108865, 5),
            (-67108864, 4),
            (201326591, 4),
            (201326592, 5),
            (-2147483648, 5),
            (4294967295, 1),
        ] {
            let bytes = encoded(value as u32);
            assert_eq!(bytes.len(), len, "{value}");
            assert_eq!(Reader::new(&bytes).int(), Ok(value as u32), "{value}");
        }
    }

    #[test]
    fn what_is_read_is_no_longer_there() {
        let mut reader = Reader::new(&[5, 2, 7, 8, 9]);
        assert_eq!((reader.int(), reader.rest()), (Ok(5), &[2, 7, 8, 9][..]));
        assert_eq!((reader.bytes(), reader.rest()), (Ok(&[7, 8][..]), &[9][..]));
        assert!(!reader.is_empty());
        assert_eq!((reader.bytes(), reader.is_empty()), (Err(Malformed), true));
    }

    #[test]
    fn a_value_over_32_bits_wraps() {
        // 2^35 + 5 and a leading run of padding.
        assert_eq!(Reader::new(&[0x81, 0x80, 0x80, 0x80, 0x80, 0x05]).int(), Ok(5));
        assert_eq!(Reader::new(&[0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x07]).int(), Ok(7));
    }

    #[test]
    fn a_string_longer_than_a_block_overflows() {
        let mut writer = Writer::default();
        writer.string(&[0; 60]);
        assert_eq!(writer.payload(), None);
    }
}
