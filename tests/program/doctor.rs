// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor` from outside.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::path::PathBuf;
use std::process::Output;

use serde_json::Value;
use tempfile::TempDir;

use crate::process::output;

const GROUPS: [&str; 9] =
    ["last stop", "kernel", "service", "watchdog", "terminal", "host", "pins and buses", "permissions", "power"];

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// The names of the groups, and all findings.
fn parsed(output: &Output) -> (Value, Vec<String>, Vec<Value>) {
    let value: Value = serde_json::from_slice(&output.stdout).unwrap();
    let groups = value["groups"].as_array().unwrap();
    let names = groups.iter().map(|group| group["name"].as_str().unwrap().to_owned()).collect();
    let findings = groups.iter().flat_map(|group| group["findings"].as_array().unwrap().clone()).collect();
    (value, names, findings)
}

#[test]
fn of_a_system_without_files_all_is_unknown_and_nothing_wrong() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path().to_str().unwrap();
    let examined = output(&["doctor", "--root", root]);
    let text = stdout(&examined);
    assert_eq!(examined.status.code(), Some(0), "{text}");
    for group in GROUPS {
        assert!(text.contains(&format!("\n{group}\n")) || text.starts_with(&format!("{group}\n")), "{group}: {text}");
    }
    assert!(text.contains("\n0 errors, ") && text.contains("is unknown"), "{text}");
    let (_, names, findings) = parsed(&output(&["doctor", "--json", "--root", root]));
    assert_eq!(names, GROUPS);
    for finding in findings {
        let keys: Vec<&String> = finding.as_object().unwrap().keys().collect();
        assert_eq!(keys, ["check", "status", "found", "remedy"]);
    }
}

#[test]
fn what_does_not_work_is_told_with_the_command_that_mends_it_and_the_exit_status() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let wants = root.join("etc/systemd/system/multi-user.target.wants");
    fs::create_dir_all(&wants).unwrap();
    symlink("/lib/systemd/system/klipper-mcu.service", wants.join("klipper-mcu.service")).unwrap();
    fs::create_dir_all(root.join("etc/pinion")).unwrap();
    fs::write(root.join("etc/pinion/pinion.toml"), "watchdog = true\n\nmarginn_us = 3\n").unwrap();
    let examined = output(&["doctor", "--root", root.to_str().unwrap()]);
    let text = stdout(&examined);
    assert_eq!(examined.status.code(), Some(1), "{text}");
    assert!(
        text.contains("  error    klipper-mcu.service is enabled")
            && text.contains("\n           -> sudo systemctl disable --now klipper-mcu.service\n"),
        "{text}"
    );
    assert!(
        text.contains(
            "error    /etc/pinion/pinion.toml:3:1: marginn_us: there is no such key: did you mean margin_us?"
        )
    );
    assert!(text.contains("\n2 errors, "), "{text}");
    let examined = output(&["doctor", "--json", "--root", root.to_str().unwrap()]);
    let (value, _, findings) = parsed(&examined);
    let errors = findings.iter().filter(|finding| finding["status"] == "error").count();
    assert_eq!((examined.status.code(), errors, &value["errors"]), (Some(1), 2, &2.into()));
}

#[test]
fn a_root_that_is_not_there_is_no_system_without_mistakes() {
    let examined = output(&["doctor", "--root", "/no/such/folder"]);
    assert_eq!(examined.status.code(), Some(1));
    let log = String::from_utf8_lossy(&examined.stderr);
    assert!(log.contains("/no/such/folder: there is no such folder") && examined.stdout.is_empty(), "{log}");
}

/// A file tree below a root: files, links, and processes of users and units.
struct Tree(TempDir);

impl Tree {
    fn path(&self, path: &str) -> PathBuf {
        let path = self.0.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    }

    fn put(&self, path: &str, text: &str) {
        fs::write(self.path(path), text).unwrap();
    }

    fn link(&self, path: &str, target: &str) {
        symlink(target, self.path(path)).unwrap();
    }

    fn process(&self, pid: u32, unit: &str, uid: u32, groups: &str, command: &[&str]) {
        self.put(&format!("proc/{pid}/cmdline"), &(command.join("\0") + "\0"));
        self.put(&format!("proc/{pid}/stat"), &format!("{pid} (x) S {}", vec!["1"; 40].join(" ")));
        self.put(
            &format!("proc/{pid}/status"),
            &format!("Uid:\t{uid}\t{uid}\nGid:\t{uid}\t{uid}\nGroups:\t{groups}\n"),
        );
        self.put(&format!("proc/{pid}/cgroup"), &format!("0::/system.slice/{unit}.service\n"));
    }
}

/// Two printers on one computer, with an instance and a klippy for each. Each klippy has its own user and unit.
#[test]
fn each_instance_and_each_klippy_is_judged() {
    let tree = Tree(tempfile::tempdir().unwrap());
    let gid = fs::metadata(tree.0.path()).unwrap().gid();
    tree.put("etc/passwd", "pi:x:54321:54321::/home/pi:/bin/sh\nother:x:54322:54322::/home/other:/bin/sh\n");
    tree.put("etc/group", &format!("tty:x:{gid}:pi\n"));
    for (n, name, unit, file) in [(3, "mcu", "pinion-mcu", "pinion"), (4, "second", "pinion-mcu@second", "second")] {
        tree.put(&format!("dev/pts/{n}"), "");
        fs::set_permissions(tree.path(&format!("dev/pts/{n}")), fs::Permissions::from_mode(0o660)).unwrap();
        tree.link(&format!("run/pinion/klipper_host_{name}"), &format!("/dev/pts/{n}"));
        tree.link(&format!("tmp/klipper_host_{name}"), &format!("/run/pinion/klipper_host_{name}"));
        tree.link(&format!("etc/systemd/system/multi-user.target.wants/{unit}.service"), "/x");
        tree.put(&format!("etc/pinion/{file}.toml"), "");
        let (link, config) = (format!("/run/pinion/klipper_host_{name}"), format!("/etc/pinion/{file}.toml"));
        tree.process(n, unit, 990, "", &["/usr/bin/pinion", "run", "-r", "-I", &link, "--config", &config]);
    }
    for folder in ["tmp", "run/pinion", "dev/pts"] {
        fs::set_permissions(tree.0.path().join(folder), fs::Permissions::from_mode(0o755)).unwrap();
    }
    for (user, uid, groups, unit, serial) in [
        ("pi", 54321, gid.to_string(), "klipper", "/tmp/klipper_host_mcu"),
        ("other", 54322, String::new(), "klipper-2", "/tmp/klipper_host_second"),
    ] {
        tree.put(&format!("home/{user}/printer.cfg"), "[include mcu.cfg]\n");
        tree.put(&format!("home/{user}/mcu.cfg"), &format!("[mcu host]\nserial: {serial}\n"));
        let (script, config) = (format!("/home/{user}/klipper/klippy/klippy.py"), format!("/home/{user}/printer.cfg"));
        tree.process(uid, unit, uid, &groups, &["/usr/bin/python3", &script, "-l", "/tmp/l", &config]);
    }
    let doctor = || {
        let examined = output(&["doctor", "--root", tree.0.path().to_str().unwrap()]);
        (examined.status.code(), stdout(&examined))
    };
    let (status, text) = doctor();
    assert_eq!(status, Some(1), "{text}");
    for line in [
        "  ok       Pinion runs as process 3 (pinion-mcu)\n",
        "  ok       Pinion runs as process 4 (pinion-mcu@second)\n",
        "for klippy's user pi (process 54321)\n",
        "  error    other, klippy's user (process 54322), may not open it: /tmp/klipper_host_second leads to /dev/pts/4",
        "\n           -> sudo usermod -aG tty other && sudo systemctl restart klipper-2\n",
        "klippy's sources in /home/pi/klipper/klippy (process 54321) cannot be read",
        "klippy's sources in /home/other/klipper/klippy (process 54322) cannot be read",
        "\n1 error, ",
    ] {
        assert!(text.contains(line), "{line}\n{text}");
    }
    // The second instance has ended, and its configuration has an error.
    fs::remove_dir_all(tree.0.path().join("proc/4")).unwrap();
    tree.put("etc/pinion/second.toml", "watchdogg = true\n");
    let (_, text) = doctor();
    for line in [
        "  error    /etc/pinion/second.toml:1:1: watchdogg: there is no such key: did you mean watchdog?\n",
        "-> sudo nano /etc/pinion/second.toml, then sudo systemctl restart pinion-mcu@second\n",
        "  error    Pinion does not run, though its service is enabled (pinion-mcu@second)\n",
    ] {
        assert!(text.contains(line), "{line}\n{text}");
    }
}

#[test]
fn this_computer_is_looked_at_whatever_it_is() {
    let examined = output(&["doctor", "--json"]);
    let (value, names, findings) = parsed(&examined);
    for group in GROUPS.iter().copied().chain(["latency"]) {
        assert!(names.iter().any(|name| name == group), "no {group} in {names:?}");
    }
    let kernel = findings.iter().find(|finding| finding["check"] == "preempt_rt").unwrap();
    let release = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap();
    assert!(kernel["found"].as_str().unwrap().contains(release.trim()), "{kernel}");
    let latency = findings.iter().find(|finding| finding["check"] == "latency").unwrap();
    assert!(latency["found"].as_str().unwrap().contains(" of 1000 "), "{latency}");
    let status = i32::from(value["errors"] != 0);
    assert_eq!(examined.status.code(), Some(status), "{value}");
    for finding in &findings {
        assert!(finding["status"] == "ok" || finding["remedy"].is_string(), "{finding}");
    }
}
