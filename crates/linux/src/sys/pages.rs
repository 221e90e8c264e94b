// SPDX-License-Identifier: GPL-3.0-or-later
//! Gives memory back to the kernel that only the start of the program needed.

use std::ffi::c_void;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::PathBuf;
use std::ptr::{self, NonNull};

use nix::sys::mman::{MmapAdvise, madvise};

/// Gives back the free memory of the allocator.
pub fn trim_heap() {
    // SAFETY: takes a number. The allocator gives back only what is free.
    unsafe { libc::malloc_trim(0) };
}

/// Sections of the program's file that a program that serves a host does not use any more: the functions and constants of
/// the other subcommands (`build.rs`), the addresses that the dynamic linker has relocated, and what a panic needs, which
/// ends the program.
const USED_UP: [&str; 6] =
    [".text.commands", ".rodata.commands", ".rela.dyn", ".eh_frame_hdr", ".eh_frame", ".gcc_except_table"];

/// Gives back the free memory of the allocator, the unchanged pages of the program's libraries, and [`USED_UP`]. The kernel
/// maps such a page again when it is used. Loading libraries touches thousands of pages that are never used again. Call it
/// before memory is locked.
///
/// The rest of the program's own file stays mapped: locked, its pages are there when the core needs them again, also if
/// memory is short.
pub fn give_back_unused() -> io::Result<()> {
    let program = fs::read_link("/proc/self/exe")?;
    let files = unchanged_files(&fs::read_to_string("/proc/self/smaps")?);
    let (own, libraries): (Vec<_>, Vec<_>) = files.into_iter().partition(|(_, path)| *path == program);
    let used_up =
        own.first().map_or(Ok(Vec::new()), |(first, _)| used_up(&File::open("/proc/self/exe")?, first.start))?;
    let is_own = |range: &Range<usize>| own.iter().any(|(own, _)| own.start <= range.start && range.end <= own.end);
    for range in libraries.into_iter().map(|(range, _)| range).chain(used_up.into_iter().filter(is_own)) {
        let Some(start) = NonNull::new(ptr::with_exposed_provenance_mut::<c_void>(range.start)) else { continue };
        // SAFETY: the range is in a mapping that cannot be written, and all its pages are those of its file. So a page that
        // is used again has the same content.
        unsafe { madvise(start, range.len(), MmapAdvise::MADV_DONTNEED) }?;
    }
    // It comes last, because reading the mappings takes memory, too.
    trim_heap();
    Ok(())
}

/// The whole pages in [`USED_UP`], by the program's file. It is mapped at `base`.
fn used_up(program: &File, base: usize) -> io::Result<Vec<Range<usize>>> {
    // SAFETY: takes a number.
    let page = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).map_err(io::Error::other)?;
    // In a header of the ELF file, the numbers before these have the same size in files of 32 and 64 bits (elf(5)).
    const WORD: usize = size_of::<usize>();
    const TABLE: usize = 24 + 2 * WORD;
    const ADDRESS: usize = 8 + WORD;
    // The search for the host may seek and read, but not pread(2).
    let part = |from: usize, length: usize| {
        let (mut program, mut bytes) = (program, vec![0; length]);
        program.seek(SeekFrom::Start(from as u64))?;
        program.read_exact(&mut bytes).map(|()| bytes)
    };
    let word = |bytes: &[u8], at| usize::from_ne_bytes(bytes[at..at + WORD].try_into().unwrap_or_default());
    let short = |bytes: &[u8], at| usize::from(u16::from_ne_bytes([bytes[at], bytes[at + 1]]));
    let head = part(0, TABLE + WORD + 16)?;
    let [size, count, names] = [10, 12, 14].map(|at| short(&head, TABLE + WORD + at));
    let section = |number: usize| part(word(&head, TABLE) + number * size, ADDRESS + 3 * WORD);
    let place = |section: &[u8]| [0, 1, 2].map(|at| word(section, ADDRESS + at * WORD));
    let [_, names, _] = place(&section(names)?);
    let mut found = Vec::new();
    for number in 1..count {
        let section = section(number)?;
        let [address, _, length] = place(&section);
        let name = part(names + u32::from_ne_bytes([section[0], section[1], section[2], section[3]]) as usize, 20)?;
        if USED_UP.iter().any(|used| name.starts_with(used.as_bytes()) && name.get(used.len()) == Some(&0)) {
            let (start, end) = ((base + address).next_multiple_of(page), (base + address + length) / page * page);
            found.extend((start < end).then_some(start..end));
        }
    }
    Ok(found)
}

/// The private mappings of files, from /proc/PID/smaps, that cannot be written and that have no page of their own, and the
/// paths of the files. A page of its own differs from the file: the dynamic linker wrote addresses to it. It may be swapped
/// out.
fn unchanged_files(smaps: &str) -> Vec<(Range<usize>, PathBuf)> {
    let mut found = Vec::new();
    let mut mapping = None;
    let mut own_kb = Vec::new();
    // The last line of a mapping has its flags. Words are looked for in its first line only: each start reads thousands
    // of lines.
    for line in smaps.lines() {
        if let Some(kb) = line.strip_prefix("Anonymous:").or_else(|| line.strip_prefix("Swap:")) {
            own_kb.push(kb.trim());
        } else if line.starts_with("VmFlags:") {
            found.extend(mapping.take().filter(|_| own_kb == ["0 kB", "0 kB"]));
            own_kb.clear();
        } else if !line.starts_with(|letter: char| letter.is_ascii_uppercase()) {
            let mut words = line.split_ascii_whitespace();
            if let (Some(range), Some("r-xp" | "r--p")) = (words.next(), words.next()) {
                // No other field has a slash, and a path may have spaces.
                mapping = line.find('/').and_then(|at| Some((parse_range(range)?, PathBuf::from(&line[at..]))));
            }
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
    use std::os::unix::fs::FileExt;

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
        let found = unchanged_files;
        let unchanged = [(0x1000..0x3000, PathBuf::from("/usr/lib/a b.so"))];
        assert_eq!(found(&text), unchanged);
        let kept = [
            mapping("1000-3000 r--p 00001000 08:01 42 /usr/lib/relocated.so", 4, 0),
            mapping("1000-3000 r--p 00001000 08:01 42 /usr/lib/swapped.so", 0, 4),
            mapping("1000-3000 rw-p 00001000 08:01 42 /usr/lib/data.so", 0, 0),
            mapping("1000-3000 r--s 00001000 08:01 42 /usr/share/shared", 0, 0),
            mapping("1000-3000 r--p 00000000 00:00 0", 0, 0),
            mapping("1000-3000 r-xp 00000000 00:00 0 [vdso]", 0, 0),
        ];
        for other in &kept {
            assert_eq!(found(other), [], "{other}");
            assert_eq!(found(&(other.clone() + &text + other)), unchanged);
        }
        // A kernel that does not say what is swapped out.
        assert_eq!(found(&text.replace("Swap:  0 kB\n", "")), []);
    }

    /// The pages of this process that are in memory, by /proc/self/pagemap.
    fn present(range: &Range<usize>) -> usize {
        let mut entries = vec![0; range.len() / 4096 * 8];
        let pages = File::open("/proc/self/pagemap").unwrap();
        pages.read_exact_at(&mut entries, range.start as u64 / 4096 * 8).unwrap();
        // The last of a page's eight bytes has the bit.
        entries.iter().skip(7).step_by(8).filter(|byte| *byte & 1 << 7 != 0).count()
    }

    #[test]
    fn what_only_the_start_used_is_given_back_and_nothing_else_of_the_program() {
        let program = std::env::current_exe().unwrap();
        let smaps = fs::read_to_string("/proc/self/smaps").unwrap();
        let own = unchanged_files(&smaps).into_iter().find(|(_, path)| *path == program).unwrap();
        let ranges = used_up(&File::open(&program).unwrap(), own.0.start).unwrap();
        // `.rela.dyn` is the first one. The dynamic linker has read all of it.
        assert!(ranges.len() >= 3 && present(&ranges[0]) > 0, "{ranges:x?}");
        let (text, constant) = (used_up as *const () as usize, USED_UP.as_ptr().cast::<u8>() as usize);
        for other in [text, constant, USED_UP[0].as_ptr() as usize] {
            assert!(ranges.iter().all(|range| !range.contains(&other)), "{other:x} in {ranges:x?}");
        }
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
        assert_eq!(ranges.iter().map(present).sum::<usize>(), 0, "{ranges:x?}");
    }
}
