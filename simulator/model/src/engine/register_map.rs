// SPDX-License-Identifier: GPL-3.0-or-later
//! Chips with registers: a map of their registers, and messages of a register's address and data bytes on SPI and I2C.

use std::ops::{BitAnd, BitOr, Not};

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

    /// A chip of which this many addresses hold what a host writes. The registers of the table differ.
    pub(crate) fn holding(addresses: usize, table: &[Register<V>]) -> RegisterMap<V> {
        let plain = (Access::ReadWrite, !V::default(), V::default());
        let mut map = RegisterMap { registers: vec![Some(plain); addresses] };
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

/// The state of a message.
#[derive(Clone, Copy, PartialEq)]
enum Message {
    /// Waits for the first byte.
    Start,
    Read(u8),
    Write(u8),
}

/// A chip with registers behind its bus.
pub(crate) struct OnBus<C> {
    pub(crate) chip: C,
    message: Message,
    many: bool,
}

impl<C: RegisterChip> OnBus<C> {
    pub(crate) fn new(chip: C) -> OnBus<C> {
        OnBus { chip, message: Message::Read(0), many: true }
    }

    fn next(&mut self, register: u8) -> u8 {
        if self.many { self.chip.next(register) } else { register }
    }

    fn get(&mut self, register: u8) -> u8 {
        let value = self.chip.read(register);
        self.message = Message::Read(self.next(register));
        value
    }

    fn set(&mut self, register: u8, value: u8) {
        self.chip.write(register, value);
        self.message = Message::Write(self.next(register));
    }
}

impl<C: RegisterChip> SpiChip for OnBus<C> {
    fn knows_mode(&self, mode: u8) -> bool {
        C::SPI_MODES.contains(&mode)
    }

    fn select(&mut self, _rate_hz: u32) {
        self.chip.begin();
        self.message = Message::Start;
    }

    fn exchange(&mut self, byte: u8) -> u8 {
        match self.message {
            Message::Start => {
                let register;
                (register, self.many) = self.chip.register(byte & !READ, true);
                self.message = if byte & READ == 0 { Message::Write(register) } else { Message::Read(register) };
                0
            }
            Message::Read(register) => self.get(register),
            Message::Write(register) => {
                self.set(register, byte);
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
        // A read goes on at the register that was written before.
        self.message = match self.message {
            Message::Read(register) | Message::Write(register) if read => Message::Read(register),
            _ => Message::Start,
        };
        true
    }

    fn write(&mut self, byte: u8) -> bool {
        match self.message {
            Message::Write(register) => self.set(register, byte),
            _ => {
                let register;
                (register, self.many) = self.chip.register(byte, false);
                self.message = Message::Write(register);
            }
        }
        true
    }

    fn read(&mut self) -> u8 {
        match self.message {
            Message::Read(register) => self.get(register),
            _ => 0xff,
        }
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
        let mut map = RegisterMap::holding(7, TABLE);
        map.write(6, 0xf3);
        map.write(7, 0xf3);
        map.write(0, 0xf3);
        assert_eq!([map.read(6), map.read(7), map.read(0)], [0xf3, 0, 0x5a]);
    }
}
