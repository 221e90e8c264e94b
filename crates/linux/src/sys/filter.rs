// SPDX-License-Identifier: GPL-3.0-or-later
//! The system calls that are left to a process that only reads files and answers on a socket (seccomp(2)).
//!
//! Anything else fails with EPERM. The crate seccompiler makes filters like this one, but does not know 32-bit ARM.

use std::io;

use libc::{
    BPF_ABS, BPF_JEQ, BPF_JMP, BPF_JSET, BPF_K, BPF_LD, BPF_RET, BPF_W, SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO, c_long,
    sock_filter, sock_fprog,
};

/// `AUDIT_ARCH_` of this processor (linux/audit.h). `None`: its system calls are not listed here.
const ARCHITECTURE: Option<u32> = if cfg!(target_arch = "x86_64") {
    Some(0xC000_003E)
} else if cfg!(target_arch = "aarch64") {
    Some(0xC000_00B7)
} else if cfg!(target_arch = "arm") {
    Some(0x4000_0028)
} else {
    None
};

/// Reading files and folders, memory, the socket that the process has, time, its own end.
const ALLOWED: &[c_long] = &[
    libc::SYS_read,
    libc::SYS_close,
    libc::SYS_statx,
    libc::SYS_readlinkat,
    libc::SYS_getdents64,
    libc::SYS_lseek,
    libc::SYS_fstat,
    libc::SYS_recvfrom,
    libc::SYS_sendto,
    libc::SYS_brk,
    libc::SYS_munmap,
    libc::SYS_mremap,
    libc::SYS_madvise,
    libc::SYS_futex,
    libc::SYS_rt_sigprocmask,
    libc::SYS_rt_sigreturn,
    libc::SYS_sigaltstack,
    libc::SYS_restart_syscall,
    libc::SYS_clock_gettime,
    libc::SYS_getrandom,
    libc::SYS_getpid,
    libc::SYS_gettid,
    libc::SYS_exit,
    libc::SYS_exit_group,
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    libc::SYS_newfstatat,
    #[cfg(any(target_arch = "x86_64", target_arch = "arm"))]
    libc::SYS_readlink,
    #[cfg(target_arch = "arm")]
    libc::SYS_fstat64,
    #[cfg(target_arch = "arm")]
    libc::SYS_fstatat64,
    #[cfg(target_arch = "arm")]
    libc::SYS__llseek,
    #[cfg(target_arch = "arm")]
    libc::SYS_recv,
    #[cfg(target_arch = "arm")]
    libc::SYS_send,
    #[cfg(target_arch = "arm")]
    libc::SYS_sigreturn,
    #[cfg(target_arch = "arm")]
    libc::SYS_gettimeofday,
    // clock_gettime64 and futex_time64: libc does not name them.
    #[cfg(target_arch = "arm")]
    403,
    #[cfg(target_arch = "arm")]
    422,
];

#[cfg(not(target_arch = "arm"))]
const SYS_MMAP: c_long = libc::SYS_mmap;
#[cfg(target_arch = "arm")]
const SYS_MMAP: c_long = libc::SYS_mmap2;

/// System calls that are allowed only if an argument has none of these bits: call, number of the argument, bits.
const ALLOWED_WITHOUT: &[(c_long, u32, i32)] = &[
    (libc::SYS_openat, 2, libc::O_ACCMODE | libc::O_CREAT | libc::O_TRUNC),
    (SYS_MMAP, 2, libc::PROT_EXEC),
    (libc::SYS_mprotect, 2, libc::PROT_EXEC),
];

/// Offsets in `struct seccomp_data` (linux/seccomp.h). Those of arguments are the offsets of their lower halves.
const NUMBER: u32 = 0;
const ARCH: u32 = 4;
const fn argument(number: u32) -> u32 {
    16 + 8 * number
}

const DENY: u32 = SECCOMP_RET_ERRNO | libc::EPERM as u32;

fn load(offset: u32) -> sock_filter {
    sock_filter { code: (BPF_LD | BPF_W | BPF_ABS) as u16, jt: 0, jf: 0, k: offset }
}

/// Skips `if_so` instructions if the test holds, and `if_not` otherwise.
fn skip(how: u32, value: u32, if_so: u8, if_not: u8) -> sock_filter {
    sock_filter { code: (BPF_JMP | how | BPF_K) as u16, jt: if_so, jf: if_not, k: value }
}

fn answer(answer: u32) -> sock_filter {
    sock_filter { code: (BPF_RET | BPF_K) as u16, jt: 0, jf: 0, k: answer }
}

fn program(architecture: u32) -> Vec<sock_filter> {
    // A program for this processor's older instruction set would have other numbers.
    let mut program = vec![load(ARCH), skip(BPF_JEQ, architecture, 1, 0), answer(DENY), load(NUMBER)];
    for number in ALLOWED {
        program.extend([skip(BPF_JEQ, *number as u32, 0, 1), answer(SECCOMP_RET_ALLOW)]);
    }
    for (number, of, bits) in ALLOWED_WITHOUT {
        program.extend([
            skip(BPF_JEQ, *number as u32, 0, 4),
            load(argument(*of)),
            skip(BPF_JSET, *bits as u32, 0, 1),
            answer(DENY),
            answer(SECCOMP_RET_ALLOW),
        ]);
    }
    program.push(answer(DENY));
    program
}

/// Limits this process to reading files and to its open sockets. The process must have only one thread.
pub fn allow_only_reading() -> io::Result<()> {
    let architecture =
        ARCHITECTURE.ok_or_else(|| io::Error::other("Pinion has no list of this processor's system calls"))?;
    nix::sys::prctl::set_no_new_privs()?;
    let mut filter = program(architecture);
    let program = sock_fprog { len: filter.len() as u16, filter: filter.as_mut_ptr() };
    // SAFETY: the kernel reads the program, which lives through the call, and copies it.
    match unsafe {
        libc::prctl(libc::PR_SET_SECCOMP, libc::c_ulong::from(libc::SECCOMP_MODE_FILTER), &raw const program)
    } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{self, File};
    use std::net::TcpListener;
    use std::os::unix::net::UnixStream;
    use std::process::{self, Command};
    use std::thread;

    #[test]
    #[ignore = "started by the other test"]
    fn confined_process() {
        if std::env::var_os("PINION_TEST_CONFINED").is_none() {
            return;
        }
        let (one, _other) = UnixStream::pair().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "x").unwrap();
        allow_only_reading().unwrap();
        let is_refused = |done: io::Result<()>| done.is_err_and(|error| error.raw_os_error() == Some(libc::EPERM));
        let me = nix::unistd::getpid();
        let checks = [
            fs::read(&file).is_ok() && fs::read_dir("/proc/self/fd").is_ok_and(|names| names.count() > 3),
            fs::metadata("/proc/self/exe").is_ok() && fs::read_link("/proc/self/exe").is_ok(),
            nix::sys::socket::send(std::os::fd::AsRawFd::as_raw_fd(&one), b"x", nix::sys::socket::MsgFlags::empty())
                .is_ok(),
            is_refused(File::create(folder.path().join("other")).map(drop)),
            is_refused(File::options().append(true).open(&file).map(drop)),
            is_refused(fs::remove_file(&file)),
            is_refused(fs::set_permissions(&file, fs::metadata(&file).unwrap().permissions())),
            is_refused(UnixStream::pair().map(drop)),
            is_refused(TcpListener::bind("127.0.0.1:0").map(drop)),
            is_refused(Command::new("/bin/true").status().map(drop)),
            is_refused(thread::Builder::new().spawn(|| ()).map(drop)),
            is_refused(nix::sys::signal::kill(me, None).map_err(Into::into)),
        ];
        // The process can no longer print.
        process::exit(checks.iter().position(|is_right| !is_right).map_or(100, |number| number as i32));
    }

    #[test]
    fn a_confined_process_reads_and_answers_and_does_nothing_else() {
        let status = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "sys::filter::tests::confined_process", "--test-threads=1"])
            .env("PINION_TEST_CONFINED", "1")
            .status()
            .unwrap();
        assert_eq!(status.code(), Some(100), "the number of the check that failed");
    }
}
