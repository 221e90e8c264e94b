// SPDX-License-Identifier: GPL-3.0-or-later
//! Chips with registers: a map of their registers, and messages of a register's address and data bytes on SPI and I2C.

use std::ops::{BitAnd, BitOr, Not, Range};

use super::i2c::I2cChip;
use super::spi::SpiChip;

/// The host's access to a register.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Access {
    Read,
    /// It reads as zero.
    Write,
    ReadWrite,
    /// A written one clears its bit.
    ClearOnWrite,
    /// A read clears the register.
    ClearOnRead,
}

/// A register: its address, access, the bits that a host changes, and its value at power-up.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Register<V>(pub(crate) u8, pub(crate) Access, pub(crate) V, pub(crate) V);

/// A chip's registers.
#[derive(Clone)]
pub(crate) struct RegisterMap<V> {
    /// By address: access, bits and value.
    registers: Vec<Option<(Access, V, V)>>,
}

impl<V: Copy + Default + PartialEq + BitAnd<Output = V> + BitOr<Output = V> + Not<Output = V>> RegisterMap<V> {
    /// The registers of a table at power-up. Any other address reads as zero, and a write to it has no effect.
    pub(crate) fn new(table: &[Register<V>]) -> RegisterMap<V> {
        let mut map = RegisterMap { registers: Vec::new() };
        map.add(table);
        map
    }

    /// Registers that hold what a host writes, at these addresses. The registers of the table differ.
    pub(crate) fn holding(addresses: Range<usize>, table: &[Register<V>]) -> RegisterMap<V> {
        let mut map = RegisterMap { registers: vec![None; addresses.end] };
        map.registers[addresses].fill(Some((Access::ReadWrite, !V::default(), V::default())));
        map.add(table);
        map
    }

    /// Adds registers. A register at the address of another takes its place.
    pub(crate) fn add(&mut self, table: &[Register<V>]) {
        for Register(address, access, bits, reset) in table {
            let address = usize::from(*address);
            self.registers.resize(self.registers.len().max(address + 1), None);
            self.registers[address] = Some((*access, *bits, *reset));
        }
    }

    /// The host can read the registers that it could only write.
    pub(crate) fn make_readable(&mut self) {
        for (access, ..) in self.registers.iter_mut().flatten() {
            if *access == Access::Write {
                *access = Access::ReadWrite;
            }
        }
    }

    /// The value, as the chip sees it.
    pub(crate) fn get(&self, address: u8) -> V {
        self.registers.get(usize::from(address)).copied().flatten().map_or(V::default(), |(_, _, value)| value)
    }

    /// Whether any of these bits is set.
    pub(crate) fn is_set(&self, address: u8, bits: V) -> bool {
        self.get(address) & bits != V::default()
    }

    /// The chip changes the value.
    pub(crate) fn set(&mut self, address: u8, new: V) {
        if let Some(Some((_, _, value))) = self.registers.get_mut(usize::from(address)) {
            *value = new;
        }
    }

    /// The host reads the value.
    pub(crate) fn read(&mut self, address: u8) -> V {
        match self.registers.get_mut(usize::from(address)) {
            None | Some(None | Some((Access::Write, ..))) => V::default(),
            Some(Some((Access::ClearOnRead, _, value))) => std::mem::take(value),
            Some(Some((_, _, value))) => *value,
        }
    }

    /// The host writes the value.
    pub(crate) fn write(&mut self, address: u8, data: V) {
        let Some(Some((access, bits, value))) = self.registers.get_mut(usize::from(address)) else { return };
        match access {
            Access::Read | Access::ClearOnRead => {}
            Access::Write | Access::ReadWrite => *value = *value & !*bits | data & *bits,
            Access::ClearOnWrite => *value = *value & !(data & *bits),
        }
    }
}

/// A chip whose messages are the address of a register and then data bytes.
pub(crate) trait RegisterChip: Send {
    /// Its SPI modes.
    const SPI_MODES: &'static [u8] = &[];

    /// The register that the first byte of a message names, and whether the next bytes are of the registers after it.
    fn register(&mut self, first: u8, is_spi: bool) -> (u8, bool) {
        let _ = is_spi;
        (first & !READ, true)
    }

    /// A message begins.
    fn begin(&mut self) {}

    /// The value that a host reads.
    fn read(&mut self, register: u8) -> u8;

    /// A host writes a value.
    fn write(&mut self, register: u8, value: u8);

    /// The register after this one.
    fn next(&mut self, register: u8) -> u8 {
        (register + 1) & !READ
    }

    /// The message is over.
    fn end(&mut self) {}
}

/// The first byte on SPI: the host reads.
const READ: u8 = 0x80;

/// The meaning of a message's next byte.
enum Next {
    /// It names a register.
    Register,
    Read,
    Write,
}

/// A chip with registers behind its bus.
pub(crate) struct OnBus<C> {
    pub(crate) chip: C,
    next: Next,
    /// The register of the next data byte.
    register: u8,
    /// Whether the data bytes are those of registers in a row.
    in_a_row: bool,
}

impl<C: RegisterChip> OnBus<C> {
    pub(crate) fn new(chip: C) -> OnBus<C> {
        OnBus { chip, next: Next::Register, register: 0, in_a_row: true }
    }

    fn get(&mut self) -> u8 {
        let value = self.chip.read(self.register);
        self.go_on();
        value
    }

    fn set(&mut self, value: u8) {
        self.chip.write(self.register, value);
        self.go_on();
    }

    fn go_on(&mut self) {
        if self.in_a_row {
            self.register = self.chip.next(self.register);
        }
    }
}

impl<C: RegisterChip> SpiChip for OnBus<C> {
    fn knows_mode(&self, mode: u8) -> bool {
        C::SPI_MODES.contains(&mode)
    }

    fn select(&mut self, _rate_hz: u32) {
        self.chip.begin();
        self.next = Next::Register;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        match self.next {
            Next::Register => {
                (self.register, self.in_a_row) = self.chip.register(byte & !READ, true);
                self.next = if byte & READ == 0 { Next::Write } else { Next::Read };
                0
            }
            Next::Read => self.get(),
            Next::Write => {
                self.set(byte);
                0
            }
        }
    }

    fn deselect(&mut self) {
        self.chip.end();
    }
}

impl<C: RegisterChip> I2cChip for OnBus<C> {
    fn start(&mut self, read: bool) -> bool {
        self.chip.begin();
        // A read goes on at the register that was named last.
        self.next = if read { Next::Read } else { Next::Register };
        true
    }

    fn write(&mut self, byte: u8) -> bool {
        if let Next::Write = self.next {
            self.set(byte);
        } else {
            (self.register, self.in_a_row) = self.chip.register(byte, false);
            self.next = Next::Write;
        }
        true
    }

    fn read(&mut self) -> u8 {
        self.get()
    }

    fn stop(&mut self) {
        self.chip.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A register of each access, with four bits for the host, and one that holds what is written.
    const TABLE: &[Register<u8>] = &[
        Register(0, Access::Read, 0x0f, 0x5a),
        Register(1, Access::Write, 0x0f, 0x5a),
        Register(2, Access::ReadWrite, 0x0f, 0x5a),
        Register(3, Access::ClearOnWrite, 0x0f, 0x5a),
        Register(4, Access::ClearOnRead, 0x0f, 0x5a),
    ];

    #[test]
    fn each_access_gives_the_host_its_bits() {
        // The value at power-up as the host reads it, then after a write of 0xf3: as the chip and as the host sees it.
        for (address, values) in [
            (0, [0x5a, 0x5a, 0x5a]),
            (1, [0, 0x53, 0]),
            (2, [0x5a, 0x53, 0x53]),
            (3, [0x5a, 0x58, 0x58]),
            (4, [0x5a, 0, 0]),
            (5, [0, 0, 0]),
        ] {
            let mut map = RegisterMap::new(TABLE);
            let before = map.read(address);
            map.write(address, 0xf3);
            assert_eq!([before, map.get(address), map.read(address)], values, "{address}");
            map.set(address, 0xff);
            assert_eq!(map.get(address), if address < 5 { 0xff } else { 0 }, "the chip writes all bits");
        }
        let mut map = RegisterMap::holding(6..7, TABLE);
        (0..8).for_each(|address| map.write(address, 0xf3));
        assert_eq!([0, 5, 6, 7].map(|address| map.read(address)), [0x5a, 0, 0xf3, 0]);
    }

    /// A chip of nothing but its registers.
    impl RegisterChip for RegisterMap<u8> {
        fn read(&mut self, register: u8) -> u8 {
            RegisterMap::read(self, register)
        }

        fn write(&mut self, register: u8, value: u8) {
            RegisterMap::write(self, register, value);
        }
    }

    #[test]
    fn a_message_without_a_byte_leaves_the_named_register() {
        let mut chip = OnBus::new(RegisterMap::holding(0..0x80, &[]));
        for bytes in [&[0x10, 1, 2, 3][..], &[0x10], &[]] {
            assert!(chip.start(false) && bytes.iter().all(|byte| I2cChip::write(&mut chip, *byte)));
            chip.stop();
        }
        assert!(chip.start(true));
        assert_eq!([(); 3].map(|()| I2cChip::read(&mut chip)), [1, 2, 3]);
        chip.stop();
    }
}
