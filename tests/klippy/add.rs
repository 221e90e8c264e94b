// SPDX-License-Identifier: GPL-3.0-or-later
//! A real klippy reads what `pinion add` writes.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};

use serde_json::Value;

use super::checkout;
use super::klippy::pinion_path;

/// klippy reads what each device adds, in its batch mode: it starts with the sections, their pins and their buses.
#[test]
fn klippy_accepts_what_each_device_writes() {
    const NAME: &str = "klippy_accepts_what_each_device_writes";
    let Some(checkout) = checkout(NAME) else { return };
    let root = tempfile::tempdir().unwrap();
    let path = |name: &str| root.path().join(name);
    let put = |name: &str, text: &str| {
        fs::create_dir_all(path(name).parent().unwrap()).unwrap();
        fs::write(path(name), text).unwrap();
    };
    const PRINTER: &str = "[printer]\nkinematics: none\nmax_velocity: 300\nmax_accel: 3000\n\
                           [mcu]\nserial: /tmp/klipper_host_mcu\n[virtual_sdcard]\npath: /tmp\n[pause_resume]\n";
    let pinion = |arguments: &[&str]| {
        let output = Command::new(pinion_path()).args(["add"]).args(arguments).arg("--root").arg(root.path()).output();
        output.unwrap()
    };
    let start = || {
        let _ = fs::remove_dir_all(path("config"));
        put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
        put("boot/firmware/config.txt", "[all]\n");
        put("sys/bus/w1/devices/28-0316a4f1ff27/w1_slave", "");
        put("config/printer.cfg", PRINTER);
        // The list says which modules the host lacks, if it knows the host.
        let klippy = checkout.join("klippy");
        put("klipper/klippy/klippy.py", "");
        fs::create_dir_all(path("klipper/klippy/extras")).unwrap();
        for entry in fs::read_dir(klippy.join("extras")).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            put(&format!("klipper/klippy/extras/{}", if name.contains('.') { name } else { format!("{name}/x") }), "");
        }
        put(
            "lib/systemd/system/klipper.service",
            "[Service]\nExecStart=/usr/bin/python3 /klipper/klippy/klippy.py /config/printer.cfg\n",
        );
    };
    start();
    let list: Value = serde_json::from_slice(&pinion(&["--json"]).stdout).unwrap();
    let devices = list["devices"].as_array().unwrap().iter().filter(|device| device["in_host"] == true);
    let devices: Vec<&str> = devices.map(|device| device["name"].as_str().unwrap()).collect();
    assert!(devices.len() >= 20, "{devices:?}");
    let is_kalico = checkout.join("klippy/extras/danger_options.py").exists();
    let dialect = if is_kalico { "kalico" } else { "master" };
    let dictionary =
        Command::new(pinion_path()).args(["dict", "--board", "sim", "--dialect", dialect]).output().unwrap();
    let dictionary: Value = serde_json::from_slice(&dictionary.stdout).unwrap();
    for device in devices {
        start();
        let call = |more: &[&str]| pinion(&[&[device, "--yes", "--config", "/config/printer.cfg"], more].concat());
        let added = call(&[]);
        assert!(added.status.success(), "{device}: {added:?}");
        // A second one beside it, where the header has room.
        let second = call(&["--name", "second"]);
        let refusal = String::from_utf8_lossy(&second.stderr).into_owned();
        let is_full = ["nothing else is free", "has no free pin", "only one", "is not known"];
        assert!(second.status.success() || is_full.iter().any(|why| refusal.contains(why)), "{device}: {refusal}");
        // The simulated printer has other pins than a Raspberry Pi's header.
        let mut known = dictionary.clone();
        let files = fs::read_dir(path("config/pinion")).unwrap().map(|file| file.unwrap().path());
        let written = files.map(|file| fs::read_to_string(file).unwrap()).collect::<String>();
        for (number, line) in (100_000..).zip(written.lines()) {
            let Some((key, value)) = line.split_once(": ") else { continue };
            let name = value.trim_start_matches(['^', '!']).trim_start_matches("mcu:").to_owned();
            let kind = if ["spi_bus", "i2c_bus"].contains(&key) { key } else { "pin" };
            if !name.contains(' ') && known["enumerations"][kind][&name].is_null() {
                known["enumerations"][kind][&name] = number.into();
            }
        }
        put("dictionary", &known.to_string());
        put("gcode", "");
        let mut klippy = Command::new(super::klippy::python())
            // klippy fails if git has nothing to say of a checkout.
            .env("GIT_DIR", path("none"))
            .arg(checkout.join("klippy/klippy.py"))
            .arg(path("config/printer.cfg"))
            .arg("-i")
            .arg(path("gcode"))
            .arg("-o")
            .arg(path("output"))
            .arg("-d")
            .arg(path("dictionary"))
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        // Some chips are read at the start, and nobody answers in this mode: the configuration is done by then.
        let mut log = String::new();
        let lines = BufReader::new(klippy.stderr.take().unwrap()).lines().map_while(Result::ok);
        let is_done = |line: &String| line.contains("Configured MCU 'mcu'");
        let done = lines.inspect(|line| log += &format!("{line}\n")).find(is_done);
        let _ = klippy.kill();
        klippy.wait().unwrap();
        assert!(done.is_some(), "{device}:\n{written}\n{log}");
        for more in [&["--name", "second", "--undo"][..], &["--undo"]] {
            let undone = call(more);
            assert!(undone.status.success(), "{device}: {undone:?}");
        }
        assert_eq!(fs::read_to_string(path("config/printer.cfg")).unwrap(), PRINTER, "{device}");
    }
}
