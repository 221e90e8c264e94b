// SPDX-License-Identifier: GPL-3.0-or-later
//! The sections of the program whose pages a program that serves a host gives back (`build.rs`).

use std::fs::{self, File};
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::process::Command;

use nix::unistd::getgid;

use crate::process::{Pinion, pinion_path};

const SECTIONS: [&str; 2] = [".text.commands", ".rodata.commands"];

/// How much is empty at both ends of a section.
const BORDER: usize = 0x1_0000;

/// The addresses of a section in the program's file, without its borders.
fn section(name: &str) -> Range<usize> {
    let list = Command::new("readelf").arg("-SW").arg(pinion_path()).output().expect("readelf of binutils");
    let list = String::from_utf8_lossy(&list.stdout).into_owned();
    let line = list.lines().find_map(|line| line.split_once("] ")?.1.trim().strip_prefix(&format!("{name} ")));
    let words: Vec<&str> = line.unwrap_or_else(|| panic!("{name} in {list}")).split_whitespace().collect();
    // Type, address, offset, size.
    let [address, size] = [1, 3].map(|at| usize::from_str_radix(words[at], 16).expect("a number"));
    address + BORDER..address + size - BORDER
}

/// Those of these pages that a process has in its page tables, by their addresses in the program's file.
fn present(pid: u32, addresses: &Range<usize>) -> Vec<usize> {
    const PAGE: usize = 4096;
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).expect("a process");
    let program = fs::read_link(format!("/proc/{pid}/exe")).expect("a program");
    let first = maps.lines().find(|line| line.ends_with(program.to_str().expect("text"))).expect("its file");
    let base = usize::from_str_radix(first.split('-').next().expect("a range"), 16).expect("an address");
    let mut entries = vec![0; addresses.len() / PAGE * 8];
    let pages = File::open(format!("/proc/{pid}/pagemap")).expect("its pages");
    pages.read_exact_at(&mut entries, ((base + addresses.start) / PAGE * 8) as u64).expect("an entry for each page");
    // The last of a page's eight bytes has the bit.
    let here = entries.iter().skip(7).step_by(8).map(|byte| *byte & 1 << 7 != 0);
    let pages = (addresses.start / PAGE..).map(|page| page * PAGE);
    pages.zip(here).filter_map(|(page, is_here)| is_here.then_some(page)).collect()
}

/// A step and the guardian must not wait for the disk, so they use nothing of what is given back.
#[test]
fn a_program_that_serves_uses_nothing_that_it_gives_back() {
    let pinion = Pinion::start(&["run", "-g", &getgid().to_string()]);
    pinion.wait_for_link();
    let sections = SECTIONS.map(section);
    // A section has at least a page of each subcommand.
    assert!(sections.iter().all(|section| section.len() > 0x30_000), "{sections:x?}");
    let mut client = pinion.configured(&[]);
    client.send("emergency_stop", &[]).expect("a host");
    pinion.logged("shutdown: Command request");
    crate::status::status(&pinion);
    let children = fs::read_to_string(format!("/proc/{0}/task/{0}/children", pinion.pid())).expect("its processes");
    let mut pids: Vec<u32> = children.split_whitespace().map(|pid| pid.parse().expect("a number")).collect();
    assert_eq!(pids.len(), 2, "the guardian and the search");
    pids.push(pinion.pid());
    for (pid, section) in pids.iter().flat_map(|pid| sections.iter().map(move |section| (pid, section))) {
        let pages = present(*pid, section);
        let name = fs::read_to_string(format!("/proc/{pid}/comm")).expect("a process");
        assert!(pages.is_empty(), "{name} uses {pages:x?} of {section:x?}: readelf -sW names the functions");
    }
}

/// Otherwise the service could call a function of such a crate.
#[test]
fn no_crate_whose_functions_are_given_back_is_one_of_the_service() {
    let list = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--offline", "-p", "pinion-runtime", "-e", "normal", "--prefix", "none"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo");
    let list = String::from_utf8_lossy(&list.stdout).into_owned();
    let serve: Vec<String> = list.lines().filter_map(|line| Some(line.split(' ').next()?.replace('-', "_"))).collect();
    assert!(serve.iter().any(|name| name == "pinion_firmware"), "{list}");
    let script = include_str!(concat!(env!("OUT_DIR"), "/commands.ld"));
    // The crate's name stands before the mark of its hash.
    let names = script.lines().filter_map(|line| line.trim().strip_prefix("*.")?.split('-').next());
    let given_back: Vec<&str> = names.collect();
    assert!(given_back.contains(&"clap_builder"), "{given_back:?}");
    assert!(given_back.iter().all(|name| !serve.iter().any(|serves| serves == name)), "{given_back:?}");
}
