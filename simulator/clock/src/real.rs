// SPDX-License-Identifier: GPL-3.0-or-later
//! The functions of the C library behind ours.

use std::ffi::{CStr, c_void};
use std::sync::atomic::{AtomicPtr, Ordering};

/// A function that is looked up at its first call.
pub(crate) struct Function {
    name: &'static CStr,
    found: AtomicPtr<c_void>,
}

impl Function {
    pub(crate) const fn new(name: &'static CStr) -> Function {
        Function { name, found: AtomicPtr::new(std::ptr::null_mut()) }
    }

    /// The address of the function. A process without it does not go on: nothing could take its place.
    pub(crate) fn address(&self) -> *mut c_void {
        let found = self.found.load(Ordering::Relaxed);
        if !found.is_null() {
            return found;
        }
        // SAFETY: both strings end with a zero. A condition variable has two versions on some processors; the newer one
        // is the one that programs of today are linked with.
        let found = unsafe {
            let newer = libc::dlvsym(libc::RTLD_NEXT, self.name.as_ptr(), c"GLIBC_2.3.2".as_ptr());
            if newer.is_null() { libc::dlsym(libc::RTLD_NEXT, self.name.as_ptr()) } else { newer }
        };
        if found.is_null() {
            std::process::abort();
        }
        self.found.store(found, Ordering::Relaxed);
        found
    }
}

/// Calls the C library's function of this name: `real!(fn poll(fds: *mut pollfd, count: nfds_t, ms: c_int) -> c_int)`.
/// Invariants 1 and 2 of the library hold for each call.
macro_rules! real {
    (fn $name:ident($($argument:ident: $type:ty),*) -> $result:ty) => {{
        static FUNCTION: $crate::real::Function = $crate::real::Function::new(
            // SAFETY: the literal has one zero, at its end.
            unsafe { std::ffi::CStr::from_bytes_with_nul_unchecked(concat!(stringify!($name), "\0").as_bytes()) },
        );
        // SAFETY: invariants 1 and 2.
        unsafe {
            let function: unsafe extern "C" fn($($type),*) -> $result = std::mem::transmute(FUNCTION.address());
            function($($argument),*)
        }
    }};
}
pub(crate) use real;
