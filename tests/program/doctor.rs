// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor` from outside.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::Output;

use serde_json::Value;

use crate::process::output;

const GROUPS: [&str; 8] =
    ["kernel", "service", "watchdog", "terminal", "host", "pins and buses", "permissions", "power"];

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
fn this_machine_is_looked_at_whatever_it_is() {
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
