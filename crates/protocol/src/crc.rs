// SPDX-License-Identifier: GPL-3.0-or-later
//! The checksum of a message block: CRC-16/MCRF4XX (polynomial 0x1021 reflected, initial value 0xffff). Klipper calls
//! it `crc16_ccitt`.

const TABLE: [u16; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut crc = byte as u16;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 != 0 { (crc >> 1) ^ 0x8408 } else { crc >> 1 };
            bit += 1;
        }
        table[byte] = crc;
        byte += 1;
    }
    table
};

/// The checksum of `bytes`.
pub(crate) fn crc16_ccitt(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xffff, |crc, byte| (crc >> 8) ^ TABLE[usize::from((crc ^ u16::from(*byte)) & 0xff)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_catalogue_check_value() {
        // CRC-16/MCRF4XX of "123456789", from the catalogue of parametrised CRC algorithms.
        assert_eq!(crc16_ccitt(b"123456789"), 0x6f91);
    }
}
