// SPDX-License-Identifier: GPL-3.0-or-later
//! Full disks, read-only disks, and files that a power cut leaves. The program serves in spite of each, if a host can find
//! it at all.

use std::fs::{self, OpenOptions};
use std::os::unix::fs::chown;
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::signal::Signal;
use pinion_client::Client;
use pinion_testkit::here;

use crate::process::{Pinion, WAIT_MAX, folder_with, output};

/// Starts the program on the simulated printer, with a link at `disk/tty`. `prepare` makes the disk. `None` without
/// root.
fn on_a_disk(prepare: &str) -> Option<Pinion> {
    if !here::may_mount() {
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("disk")).unwrap();
    let link = folder.path().join("disk/tty");
    Some(Pinion::start_mounted(folder, prepare, &["run", "--board", "sim", "-I", link.to_str().unwrap()]))
}

/// The path of a file that the program sees.
fn seen(pinion: &Pinion, path: &Path) -> PathBuf {
    PathBuf::from(format!("/proc/{}/root{}", pinion.pid(), path.display()))
}

/// Checks that a host finds the program and is served.
fn serves(pinion: &Pinion) {
    pinion.logged("serving on");
    let link = pinion.link().with_file_name("disk").join("tty");
    Client::connect(&seen(pinion, &link), WAIT_MAX).unwrap().status().unwrap();
}

/// The status of a program that has ended, and its log.
fn refused(mut pinion: Pinion) -> String {
    assert_eq!(pinion.end().code(), Some(1), "{}", pinion.log());
    pinion.log()
}

#[test]
fn a_disk_without_free_space_has_room_for_the_link() {
    let fill = "mount -t tmpfs -o size=64k full disk; head -c 1M /dev/zero >disk/file || true";
    let Some(pinion) = on_a_disk(fill) else { return };
    serves(&pinion);
}

#[test]
fn a_disk_without_room_for_another_file_has_room_for_the_link_in_place_of_a_stale_one() {
    // The folder and the link take the two inodes.
    let fill = "mount -t tmpfs -o nr_inodes=2 full disk; ln -s /dev/pts/no-longer-there disk/tty";
    let Some(pinion) = on_a_disk(fill) else { return };
    serves(&pinion);
    pinion.logged("pinion status will not be answered");
}

/// The service's own link in /tmp, which root makes before the program starts.
#[test]
fn a_full_disk_has_room_for_the_link_of_the_service_in_place_of_a_stale_one() {
    if !here::may_mount() {
        return;
    }
    let link = concat!(env!("CARGO_MANIFEST_DIR"), "/systemd/link");
    // The sources may be below /tmp, so the script is opened first.
    let script = "exec 3<\"$1\"; mount -t tmpfs -o nr_inodes=2 full /tmp; \
                  ln -s /dev/pts/no-longer-there /tmp/klipper_host_full; \
                  sh /proc/self/fd/3 place full; readlink /tmp/klipper_host_full";
    let ended = Command::new("unshare").args(["--mount", "sh", "-ec", script, "sh", link]).output().unwrap();
    let (out, log) = (String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    assert_eq!(out, "/run/pinion/klipper_host_full\n", "{log}");
}

#[test]
fn a_disk_without_room_for_the_link_is_reported() {
    let Some(pinion) = on_a_disk("mount -t tmpfs -o nr_inodes=1 full disk") else { return };
    let log = refused(pinion);
    assert!(log.contains("disk/tty cannot be made: No space left on device"), "{log}");
    assert!(log.contains("free space or remove files there (df, df -i), or choose another path with -I"), "{log}");
}

#[test]
fn a_disk_that_can_only_be_read_is_reported() {
    let fill = "mount -t tmpfs full disk; ln -s /dev/pts/no-longer-there disk/tty; mount -o remount,ro disk";
    let Some(pinion) = on_a_disk(fill) else { return };
    let log = refused(pinion);
    assert!(log.contains("disk/tty cannot be made: Read-only file system"), "{log}");
    assert!(log.contains("or choose another path with -I"), "{log}");
}

#[test]
fn the_usual_folders_may_be_read_only_if_the_link_is_elsewhere() {
    // The sources and the programs may be there, or in a file system that is mounted there, so all stays to be seen.
    let make = "for usual in /run /var; do mount --rbind $usual $usual; mount -o remount,bind,ro $usual; done; \
                cd \"$PWD\"; mount -t tmpfs disk disk";
    let Some(pinion) = on_a_disk(make) else { return };
    serves(&pinion);
}

#[test]
fn a_status_socket_that_cannot_be_made_keeps_no_host_out() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("tty.sock")).unwrap();
    let pinion = Pinion::simulated_in(folder);
    pinion.logged("pinion status will not be answered");
    pinion.client().status().unwrap();
}

/// A user who may rename files there could have root give another file to the terminal's group.
#[test]
fn a_status_socket_is_not_made_in_a_folder_of_another_user() {
    if !here::is_root() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let theirs = folder.path().join("theirs");
    fs::create_dir(&theirs).unwrap();
    chown(&theirs, Some(65534), None).unwrap();
    let socket = theirs.join("s.sock");
    let pinion = Pinion::start_in(folder, &["run", "--board", "sim", "--socket", socket.to_str().unwrap()]);
    pinion.logged("serving on");
    assert_eq!(fs::read_dir(theirs).unwrap().count(), 0);
    pinion.logged("pinion trace --live will not be answered: ");
    let line = pinion.logged("pinion status will not be answered: ");
    assert!(line.contains("s.sock: the folder belongs to another user, nobody"), "{line}");
}

/// /run/pinion belongs to the service's user.
#[test]
fn root_beside_the_service_has_its_socket_elsewhere() {
    if !here::is_root() || !here::may_mount() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let name = format!("files{}", std::process::id());
    let link = format!("/tmp/klipper_host_{name}");
    let prepare = "unset XDG_RUNTIME_DIR; mount -t tmpfs run /run; mkdir /run/pinion; chown nobody /run/pinion";
    let mut pinion = Pinion::start_mounted(folder, prepare, &["run", "--board", "sim", "-I", &link]);
    let line = pinion.logged("status on ");
    pinion.logged("serving on");
    let asked = output(&["status", "-I", &link]);
    pinion.signal(Signal::SIGTERM);
    pinion.end();
    assert!(line.contains(&format!("status on /tmp/pinion-{name}.sock")), "{line}");
    assert!(asked.status.success(), "{}", String::from_utf8_lossy(&asked.stderr));
}

#[test]
fn a_log_on_a_full_disk_keeps_no_host_out() {
    let folder = tempfile::tempdir().unwrap();
    let full = || OpenOptions::new().write(true).open("/dev/full").unwrap();
    let pinion = Pinion::start_to(folder, &["run", "--board", "sim"], full(), full());
    pinion.wait_for_link();
    pinion.client().status().unwrap();
}

/// A program that guessed would serve at a link that no host opens. So it refuses, and says how to mend the file.
#[test]
fn a_configuration_that_a_power_cut_has_damaged_is_refused_with_its_remedy() {
    for (damaged, line) in [
        ("\0".repeat(300), ":1:1: there are zero bytes, as a power cut leaves them: write the file again"),
        (format!("board = \"sim\"\n{}", "\0".repeat(9)), ":2:1: there are zero bytes"),
        ("board = \"sim\"\nreal".to_owned(), ": write a key, = and its value, such as realtime = true"),
        ("board = \"si".to_owned(), ": board: write it such as board = \"linux\""),
        ("board = \"sim\"\nsymlink =".to_owned(), ": symlink: write it such as symlink = \"/tmp/klipper_host_mcu\""),
    ] {
        let (_folder, path) = folder_with("pinion.toml", &damaged);
        let ended = output(&["run", "--config", path.to_str().unwrap()]);
        let log = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(1), "{log}");
        assert!(log.contains(line), "{log}");
    }
}

/// The file sets nothing, so everything has its default.
#[test]
fn an_empty_configuration_is_served() {
    let (_folder, path) = folder_with("pinion.toml", "");
    let pinion = Pinion::start(&["run", "--board", "sim", "--config", path.to_str().unwrap()]);
    pinion.logged("serving on");
    pinion.client().status().unwrap();
}
