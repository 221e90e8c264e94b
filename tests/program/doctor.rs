// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion doctor` from outside.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, Output};

use pinion_testkit::here;
use pinion_testkit::process::Running;
use serde_json::Value;
use tempfile::TempDir;

use crate::process::{output, program_in};

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
fn a_finding_has_the_command_that_mends_it_and_the_exit_status() {
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
        self.process_in(pid, &format!("/system.slice/{unit}.service"), uid, groups, command);
    }

    /// A process of this control group.
    fn process_in(&self, pid: u32, control_group: &str, uid: u32, groups: &str, command: &[&str]) {
        self.put(&format!("proc/{pid}/cmdline"), &(command.join("\0") + "\0"));
        self.put(&format!("proc/{pid}/stat"), &format!("{pid} (x) S {}", vec!["1"; 40].join(" ")));
        self.put(
            &format!("proc/{pid}/status"),
            &format!("Uid:\t{uid}\t{uid}\nGid:\t{uid}\t{uid}\nGroups:\t{groups}\n"),
        );
        self.put(&format!("proc/{pid}/cgroup"), &format!("0::{control_group}\n"));
        self.put(&format!("proc/{pid}/exe"), "");
    }

    /// The report about it.
    fn doctor(&self) -> String {
        stdout(&output(&["doctor", "--root", self.0.path().to_str().unwrap()]))
    }

    /// A computer with devices, a service and a klippy of the user pi. Only the groups may open the devices.
    fn printer() -> Tree {
        let tree = Tree(tempfile::tempdir().unwrap());
        let gid = fs::metadata(tree.0.path()).unwrap().gid();
        tree.put("etc/passwd", "root:x:0:0::/root:/bin/sh\npi:x:54321:54321::/home/pi:/bin/sh\npinion:x:990:990::/:/bin/false\nmallory:x:54322:54322::/home/mallory:/bin/sh\n");
        tree.put("etc/group", &format!("disk:x:{gid}:\n"));
        for file in ["dev/sda", "dev/ttyAMA0", "dev/serial/by-id/x", "run/docker.sock", "etc/shadow", "dev/pts/3"] {
            tree.put(file, "");
            fs::set_permissions(tree.0.path().join(file), fs::Permissions::from_mode(0o660)).unwrap();
        }
        for folder in ["tmp", "run/pinion", "dev/pts"] {
            fs::create_dir_all(tree.0.path().join(folder)).unwrap();
            fs::set_permissions(tree.0.path().join(folder), fs::Permissions::from_mode(0o755)).unwrap();
        }
        tree.put("etc/pinion/pinion.toml", "");
        tree.link("etc/systemd/system/multi-user.target.wants/pinion-mcu.service", "/x");
        tree.link("tmp/klipper_host_mcu", "/run/pinion/klipper_host_mcu");
        tree.link("run/pinion/klipper_host_mcu", "/dev/pts/3");
        let pinion =
            ["/usr/bin/pinion", "run", "-I", "/run/pinion/klipper_host_mcu", "--config", "/etc/pinion/pinion.toml"];
        tree.process(3, "pinion-mcu", 990, &gid.to_string(), &pinion);
        tree.put("home/pi/printer.cfg", "[mcu host]\nserial: /tmp/klipper_host_mcu\n");
        let klippy = ["/usr/bin/python3", "/home/pi/klipper/klippy/klippy.py", "/home/pi/printer.cfg"];
        tree.process(4, "klipper", 54321, &gid.to_string(), &klippy);
        tree
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
        "  error    Pinion does not run, although its service is enabled (pinion-mcu@second)\n",
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

/// A user can have processes of any name, and configurations of any text.
#[test]
fn false_processes_of_another_user_change_no_advice() {
    const MALLORY: u32 = 54_322;
    let tree = Tree::printer();
    let before = tree.doctor();
    tree.put(
        "home/mallory/printer.cfg",
        "[mcu host]\nserial: /tmp/klipper_host_mcu\n[tmc2209 a]\nuart_pin: host:serial/../sda\n[tmc2209 b]\nuart_pin: host:serial/../../run/docker.sock\n[tmc2209 c]\nuart_pin: host:ttyAMA0\n[neopixel d]\npin: host:gpio18\n",
    );
    tree.put("home/mallory/pins.toml", "watchdog = true\ncpu = 77\n");
    let commands: [&[&str]; 8] = [
        &["pinion", "1000"],
        &["pinion"],
        &["/tmp/pinion", "run", "-r", "-I", "/tmp/klipper_host_mcu"],
        &["pinion", "run", "--config", "/home/mallory/pins.toml"],
        &["python3", "/home/mallory/klippy.py", "/home/mallory/printer.cfg"],
        &["klipper_mcu", "-r"],
        &["agetty", "ttyAMA0"],
        &["hciattach", "/dev/ttyAMA0"],
    ];
    let slice = "/user.slice/user-54322.slice";
    // A login, a unit of the user's own manager, a group that the user has made there, and a job of cron's.
    let groups = [
        format!("{slice}/session-7.scope"),
        format!("{slice}/user@54322.service/app.slice/klipper.service"),
        format!("{slice}/user@54322.service/system.slice/pinion-mcu.service"),
        "/system.slice/cron.service".to_owned(),
    ];
    let mut pids = 100..;
    for (group, command) in groups.iter().flat_map(|group| commands.map(|command| (group, command))) {
        tree.process_in(pids.next().unwrap(), group, MALLORY, "", command);
    }
    let after = tree.doctor();
    let ignored = "processes of other users are called like a Pinion or a klippy, and do not count here: 100, 101, 102, 103, 104 and 15 more\n";
    let remedy = "           -> if one of them is yours, have a service start it\n";
    assert!(after.contains(ignored), "{after}");
    assert_eq!(after.replace(&format!("  ok       {ignored}{remedy}"), ""), before);
}

/// The host may have processes of any name, too, in its own unit. It gets no more groups by that.
#[test]
fn a_false_pinion_of_the_host_changes_no_advice() {
    let tree = Tree::printer();
    tree.put("home/pi/printer.cfg", "[mcu host]\nserial: /tmp/klipper_host_mcu\n[tmc2209 a]\nuart_pin: host:ttyAMA0\n");
    let before = tree.doctor();
    tree.put("home/pi/pins.toml", "watchdog = true\n");
    tree.process(5, "klipper", 54321, "", &["pinion", "run", "--config", "/home/pi/pins.toml"]);
    let after = tree.doctor();
    let ignored = "processes of other users are called like a Pinion or a klippy, and do not count here: 5\n";
    let remedy = "           -> if one of them is yours, have a service start it\n";
    assert_eq!(after.replace(&format!("  ok       {ignored}{remedy}"), ""), before);
    assert!(after.contains(ignored) && !after.contains("usermod"), "{after}");
}

/// klippy would refuse the configuration. So the doctor does not know its devices.
#[test]
fn checks_that_a_wrong_printer_cfg_leaves_out_are_named_with_its_line() {
    let tree = Tree::printer();
    let uart = "[mcu host]\nserial: /tmp/klipper_host_mcu\n[tmc2209 a]\nuart_pin: host:ttyAMA7\n";
    let doctor = |text: &str| {
        tree.put("home/pi/printer.cfg", text);
        tree.doctor()
    };
    let right = doctor(uart);
    assert!(right.contains("ttyAMA7") && !right.contains("not checked"), "{right}");
    let left_out = "so its LEDs, UARTs, pins and devices are not checked\n           -> ";
    for (wrong, cause, remedy) in [
        ("no value\n", "5: Source contains parsing errors: 'no value'", "write `option: value`"),
        ("[include printer.cfg]\n", "5: Recursive include of config file '/home/pi/printer.cfg'", "remove the line\n"),
        (
            "[include a.cfg]\n",
            "5: Include file '/home/pi/a.cfg' does not exist",
            "correct its name, or remove the line\n",
        ),
    ] {
        let text = doctor(&format!("{uart}{wrong}"));
        let line = format!("  warning  /home/pi/printer.cfg:{cause}, {left_out}{remedy}");
        assert!(text.contains(&line) && !text.contains("ttyAMA7"), "{line}\n{text}");
    }
    fs::remove_file(tree.path("home/pi/printer.cfg")).unwrap();
    let text = tree.doctor();
    assert!(text.contains("/home/pi/printer.cfg: Unable to open config file: ") && text.contains(left_out), "{text}");
}

#[test]
fn a_name_in_the_configuration_that_leads_out_of_dev_opens_nothing() {
    let tree = Tree::printer();
    let doctor = |pin: &str| {
        let config = format!("[mcu host]\nserial: /tmp/klipper_host_mcu\n[tmc2209 a]\nuart_pin: host:{pin}\n");
        tree.put("home/pi/printer.cfg", &config);
        tree.doctor()
    };
    // Nobody but the owner may open these.
    for (name, mode) in [("dev/ttyAMA0", 0o060), ("dev/sda", 0o060), ("run/docker.sock", 0o060)] {
        fs::set_permissions(tree.0.path().join(name), fs::Permissions::from_mode(mode)).unwrap();
    }
    tree.process(3, "pinion-mcu", 990, "", &["/usr/bin/pinion", "run"]);
    let text = doctor("ttyAMA0");
    assert!(text.contains("-> sudo usermod -aG disk pinion, then sudo systemctl restart pinion-mcu\n"), "{text}");
    tree.link("dev/ttyX", "sda");
    for pin in ["serial/../sda", "serial/../../run/docker.sock", "ttyX", "ttyAMA0;reboot", "serial/by-id/x"] {
        let text = doctor(pin);
        assert!(text.contains(&format!("  error    TMC UART: {pin} is not a serial port\n")), "{text}");
        assert!(!text.contains("usermod") && !text.contains("docker.sock,"), "{text}");
    }
}

#[test]
fn a_link_that_leads_to_another_file_makes_klippy_s_user_no_member_of_its_group() {
    let tree = Tree::printer();
    tree.process(4, "klipper", 54321, "", &["python3", "/home/pi/klipper/klippy/klippy.py", "/home/pi/printer.cfg"]);
    let text = tree.doctor();
    assert!(text.contains("-> sudo usermod -aG disk pi && sudo systemctl restart klipper\n"), "{text}");
    for target in ["/etc/shadow", "/dev/sda", "/dev/pts/../sda", "/home"] {
        fs::remove_file(tree.path("tmp/klipper_host_mcu")).unwrap();
        tree.link("tmp/klipper_host_mcu", target);
        let text = tree.doctor();
        assert!(
            text.contains(&format!("/tmp/klipper_host_mcu leads to {target}, which is not a pseudo terminal\n")),
            "{text}"
        );
        assert!(text.contains("-> sudo rm /tmp/klipper_host_mcu && sudo systemctl restart pinion-mcu\n"), "{text}");
        assert!(!text.contains("usermod") && !text.contains("chmod"), "{text}");
    }
}

#[test]
fn marks_that_turn_a_line_around_are_not_printed() {
    let tree = Tree::printer();
    let folder = "/home/pi/\u{202e}klipper\u{200b}/klippy";
    let script = format!("{folder}/klippy.py");
    tree.process(4, "klipper", 54321, "", &["python3", &script, "/home/pi/printer.cfg"]);
    let text = tree.doctor();
    assert!(text.contains("/home/pi/?klipper?/klippy"), "{text}");
    assert!(!text.contains(['\u{202e}', '\u{200b}']), "{text}");
    let json = stdout(&output(&["doctor", "--json", "--root", tree.0.path().to_str().unwrap()]));
    assert!(json.is_ascii() && json.contains("\\u202e"), "{json}");
}

/// A process of this user with another name, for an hour.
fn called(name: &str, uid: u32) -> Running {
    let process = Command::new("sleep").arg0(name).arg("3600").uid(uid).gid(uid).spawn();
    Running(process.unwrap())
}

#[test]
fn only_the_callers_own_processes_count_beside_those_of_services_and_root() {
    const TEST: &str = "doctor::only_the_callers_own_processes_count_beside_those_of_services_and_root";
    const MALLORY: u32 = 65_534;
    if !nix::unistd::geteuid().is_root() {
        return here::not_run("only root can start processes of other users");
    }
    here::among_own_processes(TEST, || {
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let program = program_in(folder.path());
        let doctor = |uid: u32, sudo_uid: Option<&str>| {
            let mut doctor = Command::new(&program);
            doctor.args(["doctor", "--json", "--no-latency"]).uid(uid).gid(uid).env_remove("SUDO_UID");
            // Traces of other programs change meanwhile.
            doctor.env("HOME", folder.path()).env_remove("XDG_STATE_HOME");
            sudo_uid.map(|uid| doctor.env("SUDO_UID", uid));
            parsed(&doctor.output().unwrap()).2
        };
        let is_told = |findings: &[Value], words: &str| {
            findings.iter().any(|finding| finding["found"].as_str().unwrap().contains(words))
        };
        let before = doctor(0, None);
        let falses = ["pinion", "/tmp/klippy.py", "klipper_mcu"].map(|name| called(name, MALLORY));
        let [pinion, klippy, _] = &falses;
        let mut after = doctor(0, None);
        let strangers = format!("and do not count here: {}, {}", pinion.0.id(), klippy.0.id());
        assert!(is_told(&after, &strangers), "{after:#?}");
        after.retain(|finding| finding["check"] != "strangers");
        assert_eq!(after, before);
        let counts = format!("Pinion runs as process {}", pinion.0.id());
        assert!(is_told(&doctor(0, Some("65534")), &counts), "root's caller");
        assert!(is_told(&doctor(MALLORY, None), &counts), "the user itself");
        for other in [doctor(0, Some("12345")), doctor(12_345, None), doctor(12_345, Some("65534"))] {
            assert!(!is_told(&other, &counts) && is_told(&other, &strangers), "{other:#?}");
        }
        let own = called("pinion", 0);
        assert!(is_told(&doctor(0, None), &format!("Pinion runs as process {}", own.0.id())), "root's own");
    });
}

#[test]
fn whoever_runs_it_gets_advice_about_no_other_user() {
    if !nix::unistd::geteuid().is_root() {
        return here::not_run("only root can run it as other users");
    }
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
    let program = program_in(folder.path());
    let tty = nix::unistd::Group::from_name("tty").unwrap().map_or(5, |group| group.gid.as_raw());
    // A member of no group, of tty, and of a group like gpio.
    for groups in ["--clear-groups".to_owned(), format!("--groups={tty}"), "--groups=54321".to_owned()] {
        let mut doctor = Command::new("setpriv");
        let json = ["doctor", "--json", "--no-latency"];
        doctor.args(["--reuid=12345", "--regid=12345", &groups]).arg(&program).args(json);
        let (_, _, findings) = parsed(&doctor.output().unwrap());
        for remedy in findings.iter().filter_map(|finding| finding["remedy"].as_str()) {
            if let Some((_, rest)) = remedy.split_once("usermod -aG ") {
                let user = rest.split([' ', ',']).nth(1);
                assert!(matches!(user, Some("12345" | "pinion")), "{remedy}");
            }
        }
    }
}
