// SPDX-License-Identifier: GPL-3.0-or-later
//! The newest recording: why the MCU stopped, and who was late.

use std::fs;
use std::io;
use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::trace::read;
use pinion_linux::foreign::word;
use pinion_system::Computer;
use pinion_system::finding::Finding;
use pinion_trace::folder::{all, folders, utc_text};
use pinion_trace::verdict::{Culprit, verdict};

/// An older stop needs no warning.
const RECENT: Duration = Duration::from_secs(7 * 24 * 3600);

/// The verdict over the newest recording. A recent one that accuses somebody is a warning.
pub(super) fn finding(computer: &Computer, now: SystemTime) -> Finding {
    const CHECK: &str = "trace";
    let folders: Vec<PathBuf> = folders().iter().map(|folder| computer.path(folder)).collect();
    let Some(newest) = all(&folders).into_iter().next() else {
        let is_closed =
            |folder: &PathBuf| fs::read_dir(folder).is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied);
        return match folders.iter().find(|folder| is_closed(folder)) {
            Some(folder) => {
                let folder = computer.name(folder);
                Finding::ok(CHECK, format!("unknown: this user may not read {}", folder.display()))
            }
            None => Finding::ok(CHECK, "no stop of the MCU is recorded"),
        };
    };
    let name = computer.name(&newest);
    let trace = match read(&newest) {
        Ok(trace) => trace,
        Err(error) => return Finding::ok(CHECK, format!("unknown: {} cannot be read: {error}", name.display())),
    };
    let judged = verdict(&trace);
    let found = format!("{}: {}", utc_text(trace.head.utc_ms), judged.text);
    let at = UNIX_EPOCH + Duration::from_millis(trace.head.utc_ms);
    let is_recent = now.duration_since(at).is_ok_and(|age| age <= RECENT);
    let look = format!("pinion trace {}", word(name.display()));
    match judged.culprit {
        Culprit::Nobody => Finding::ok(CHECK, found),
        _ if is_recent => Finding::warning(CHECK, found, look),
        _ => Finding::ok(CHECK, found).or(look),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level;
    use pinion_trace::file::{End, Head, Names, Trace};

    #[test]
    fn the_newest_recording_is_judged() {
        let tree = Tree::empty();
        let finding = |at| finding(&tree.computer(), at);
        let hour = Duration::from_secs(3600);
        let names = Names { is_carried: true, ..Names::default() };
        let head = Head {
            version: "pinion-test".into(),
            link: "/tmp/klipper_host_mcu".into(),
            wire: None,
            end: End::Died,
            ended_at: 0,
            utc_ms: 1_795_348_800_000,
            realtime: true,
            processors: 4,
            kernel: "6.12.0".into(),
            names,
        };
        let mut newest = Trace { head, threads: Vec::new() };
        let ended = UNIX_EPOCH + Duration::from_millis(newest.head.utc_ms);
        assert_eq!(finding(ended).trouble.found(), "no stop of the MCU is recorded");
        let path = tree.computer().path("/var/lib/pinion/mcu-20261122T142614.000Z.trace");
        let put = |trace: &Trace| {
            let mut file = Vec::new();
            trace.write(&mut file).unwrap();
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, file).unwrap();
        };
        put(&newest);
        let found = finding(ended + hour);
        assert_eq!(found.status, Level::Warning);
        assert!(
            found.trouble.found().ends_with(
                " UTC: Pinion died: look for a panic in its log, and for who killed it (dmesg: out of memory)"
            ),
            "{found:?}"
        );
        assert_eq!(
            found.trouble.remedy.as_deref(),
            Some("pinion trace /var/lib/pinion/mcu-20261122T142614.000Z.trace")
        );
        assert_eq!(finding(ended + 8 * 24 * hour).status, Level::Ok, "it is old");
        newest.head.end = End::Shutdown { reason: "Command request".into(), trouble: "the host asked for it".into() };
        put(&newest);
        let found = finding(ended + hour);
        assert_eq!(found.status, Level::Ok);
        assert!(found.trouble.found().contains("nobody was late: the host asked for it"), "{found:?}");
        // A newer file, which cannot be read.
        tree.put("var/lib/pinion/mcu-20261123T142614.000Z.trace", "x");
        assert!(finding(ended).trouble.found().contains("unknown: "));
    }
}
