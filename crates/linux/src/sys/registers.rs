// SPDX-License-Identifier: GPL-3.0-or-later
//! The registers of a device, mapped into this process.

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::ptr::{self, NonNull};
use std::sync::atomic::{Ordering, fence};

/// The registers of a device, mapped into this process. They are never unmapped.
pub struct Registers {
    start: NonNull<u32>,
    bytes: usize,
}

// SAFETY: it is only an address. The mapping stays until the process ends, and [`Registers::at`] reads nothing.
unsafe impl Send for Registers {}
// SAFETY: as above.
unsafe impl Sync for Registers {}

impl Registers {
    /// Maps this many bytes of a device's file from `start` on.
    ///
    /// # Errors
    ///
    /// The kernel refuses, or the file is an ordinary one that is too short.
    pub fn map(device: &File, start: u64, bytes: usize) -> io::Result<Registers> {
        let about = device.metadata()?;
        if about.is_file() && about.len() < start.saturating_add(bytes as u64) {
            return Err(io::Error::other("it is too short"));
        }
        if bytes == 0 {
            return Err(io::ErrorKind::InvalidInput.into());
        }
        // Not nix's mmap: the offset of that has 32 bits on a computer of 32 bits, and the registers of a Raspberry Pi 4
        // are at 0xfe200000.
        let start = start.try_into().map_err(|_| io::ErrorKind::InvalidInput)?;
        let rights = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory that is in use.
        let mapped =
            unsafe { libc::mmap64(ptr::null_mut(), bytes, rights, libc::MAP_SHARED, device.as_raw_fd(), start) };
        if mapped == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        let start = NonNull::new(mapped.cast()).ok_or(io::ErrorKind::InvalidData)?;
        Ok(Registers { start, bytes })
    }

    /// The register at this offset in bytes. `None` if it is not a register's, or lies outside.
    pub fn at(&self, offset: usize) -> Option<Register> {
        let inside = offset.is_multiple_of(4) && offset.checked_add(4)? <= self.bytes;
        // SAFETY: the mapping is aligned to a page and longer than this.
        inside.then(|| Register(unsafe { self.start.byte_add(offset) }))
    }
}

/// A 32-bit register of [`Registers`].
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Register(NonNull<u32>);

// SAFETY: it is an address that stays mapped. Threads and other processes may use it at any time: a device's register
// is written and read at once.
unsafe impl Send for Register {}
// SAFETY: as above.
unsafe impl Sync for Register {}

impl Register {
    /// Its value.
    #[inline]
    pub fn load(self) -> u32 {
        // SAFETY: [`Registers::at`] has checked the address. A volatile access is one load.
        let value = unsafe { self.0.read_volatile() };
        // The BCM2835 may mix up the answers of two devices without a barrier between them ("BCM2835 ARM Peripherals",
        // section 1.3).
        fence(Ordering::Acquire);
        value
    }

    /// Writes it.
    #[inline]
    pub fn store(self, value: u32) {
        // SAFETY: as above.
        unsafe { self.0.write_volatile(value) };
    }

    /// Returns when the loads and stores before have reached their device. A read of the clock is no access to memory:
    /// without this the processor may read it before it stores.
    #[inline]
    pub fn wait() {
        #[cfg(any(target_arch = "aarch64", target_arch = "arm"))]
        // SAFETY: the instruction changes neither a register nor memory.
        unsafe {
            std::arch::asm!("dsb sy", options(nostack, preserves_flags));
        }
        #[cfg(not(any(target_arch = "aarch64", target_arch = "arm")))]
        fence(Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registers_lie_inside_the_mapping_and_are_words() {
        let file = tempfile::tempfile().unwrap();
        file.set_len(4096).unwrap();
        assert!(Registers::map(&file, 0, 4097).is_err(), "a file that is too short");
        assert!(Registers::map(&file, 4096, 4096).is_err());
        let registers = Registers::map(&file, 0, 4096).unwrap();
        for outside in [1, 2, 4094, 4096, usize::MAX - 3] {
            assert!(registers.at(outside).is_none(), "{outside}");
        }
        let (first, last) = (registers.at(0).unwrap(), registers.at(4092).unwrap());
        last.store(0x1234_5678);
        assert_eq!((first.load(), last.load()), (0, 0x1234_5678));
        let mut bytes = [0; 4];
        std::os::unix::fs::FileExt::read_exact_at(&file, &mut bytes, 4092).unwrap();
        assert_eq!(u32::from_ne_bytes(bytes), 0x1234_5678);
    }
}
