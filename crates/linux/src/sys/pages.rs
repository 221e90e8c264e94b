// SPDX-License-Identifier: GPL-3.0-or-later
//! Gives memory back to the kernel that only the start of the program needed.

use std::ffi::c_void;
use std::fs;
use std::io;
use std::ops::Range;
use std::path::Path;
use std::ptr::{self, NonNull};

use nix::sys::mman::{MmapAdvise, madvise};

/// Gives back the free memory of the allocator.
pub fn trim_heap() {
    // SAFETY: takes a number. The allocator gives back only what is free.
    unsafe { libc::malloc_trim(0) };
}

/// Gives back the free memory of the allocator, and the unchanged pages of the program's libraries. The kernel maps such a
/// page again when it is used. Loading libraries touches thousands of pages that are never used again. Call it before
/// memory is locked.
///
/// The program's own file stays mapped: locked, its pages are there when the core needs them again, also if memory is
/// short.
pub fn give_back_unused() -> io::Result<()> {
    let program = fs::read_link("/proc/self/exe")?;
    for range in unchanged_files(&fs::read_to_string("/proc/self/smaps")?, &program) {
        let Some(start) = NonNull::new(ptr::with_exposed_provenance_mut::<c_void>(range.start)) else { continue };
        // SAFETY: the range is a mapping that cannot be written, and all its pages are those of its file. So a page that
        // is used again has the same content.
        unsafe { madvise(start, range.len(), MmapAdvise::MADV_DONTNEED) }?;
    }
    // It comes last, because reading the mappings takes memory, too.
    trim_heap();
    Ok(())
}

/// The private mappings of files, from /proc/PID/smaps, that cannot be written and that have no page of their own, without
/// those of `but`. A page of its own differs from the file: the dynamic linker wrote addresses to it. It may be swapped out.
fn unchanged_files(smaps: &str, but: &Path) -> Vec<Range<usize>> {
    let mut found = Vec::new();
    let mut mapping = None;
    let mut own_kb = Vec::new();
    // The last line of a mapping has its flags.
    for line in smaps.lines() {
        let mut words = line.split_ascii_whitespace();
        match (words.next(), words.next()) {
            (Some("Anonymous:" | "Swap:"), Some(kb)) => own_kb.push(kb.to_owned()),
            (Some("VmFlags:"), _) => {
                found.extend(mapping.take().filter(|_| own_kb == ["0", "0"]));
                own_kb.clear();
            }
            (Some(range), Some("r-xp" | "r--p")) => {
                // No other field has a slash, and a path may have spaces.
                let path = line.find('/').map(|at| Path::new(&line[at..]));
                mapping = path.filter(|path| *path != but).and_then(|_| parse_range(range));
            }
            _ => {}
        }
    }
    found
}

fn parse_range(range: &str) -> Option<Range<usize>> {
    let (start, end) = range.split_once('-')?;
    Some(usize::from_str_radix(start, 16).ok()?..usize::from_str_radix(end, 16).ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mapping as /proc/PID/smaps has it.
    fn mapping(first: &str, anonymous_kb: u32, swap_kb: u32) -> String {
        format!(
            "{first}\nSize:  8 kB\nRss:  8 kB\nAnonymous:  {anonymous_kb} kB\nAnonHugePages:  0 kB\nSwap:  {swap_kb} kB\n\
             SwapPss:  0 kB\nVmFlags: rd mr mw me\n"
        )
    }

    #[test]
    fn only_unchanged_pages_of_files_are_given_back() {
        let text = mapping("1000-3000 r-xp 00001000 08:01 42                 /usr/lib/a b.so", 0, 0);
        let found = |smaps: &str| {
            unchanged_files(smaps, Path::new("/usr/bin/a program"))
                .iter()
                .map(|range| (range.start, range.end))
                .collect::<Vec<_>>()
        };
        assert_eq!(found(&text), [(0x1000, 0x3000)]);
        let kept = [
            mapping("1000-3000 r--p 00001000 08:01 42 /usr/lib/relocated.so", 4, 0),
            mapping("1000-3000 r--p 00001000 08:01 42 /usr/lib/swapped.so", 0, 4),
            mapping("1000-3000 rw-p 00001000 08:01 42 /usr/lib/data.so", 0, 0),
            mapping("1000-3000 r--s 00001000 08:01 42 /usr/share/shared", 0, 0),
            mapping("1000-3000 r-xp 00001000 08:01 42    /usr/bin/a program", 0, 0),
            mapping("1000-3000 r--p 00000000 00:00 0", 0, 0),
            mapping("1000-3000 r-xp 00000000 00:00 0 [vdso]", 0, 0),
        ];
        for other in &kept {
            assert_eq!(found(other), [], "{other}");
            assert_eq!(found(&(other.clone() + &text + other)), [(0x1000, 0x3000)]);
        }
        // A kernel that does not say what is swapped out.
        assert_eq!(found(&text.replace("Swap:  0 kB\n", "")), []);
    }

    #[test]
    fn a_library_that_nobody_uses_takes_no_memory() {
        // libiio needs it, and these tests use neither.
        let rss_kb = || {
            let smaps = fs::read_to_string("/proc/self/smaps").unwrap();
            let text = smaps.lines().skip_while(|line| !(line.contains("r-xp") && line.contains("/libxml2.so")));
            let rss = text.skip(1).find_map(|line| line.strip_prefix("Rss:")).unwrap();
            rss.trim().trim_end_matches(" kB").parse::<u32>().unwrap()
        };
        assert!(rss_kb() > 0);
        give_back_unused().unwrap();
        assert_eq!(rss_kb(), 0);
    }
}
