// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add` with a real klippy and a real Moonraker: from nothing to a measured resonance, and back.
//!
//! `MOONRAKER_PYTHON` names a Python that has Moonraker (`pip install moonraker`).

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use pinion_testkit::here;
use serde_json::Value;

use super::checkout;
use super::klippy::{Printer, UNHOMED, WHERE_IT_STANDS, pinion_path, without};
use super::rings::{peak, sweep};

/// How long Moonraker may take to start.
const START: Duration = Duration::from_secs(90);

/// A running Moonraker.
struct Moonraker {
    child: Child,
    address: String,
}

impl Moonraker {
    fn start(python: &Path, data: &Path, api: &Path) -> Moonraker {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let address = format!("127.0.0.1:{port}");
        fs::create_dir_all(data.join("config")).unwrap();
        let config = format!(
            "[server]\nhost: 127.0.0.1\nport: {port}\nklippy_uds_address: {}\n[authorization]\ntrusted_clients:\n    127.0.0.1\n\
             [machine]\nprovider: none\nvalidate_service: False\nvalidate_config: False\n",
            api.display()
        );
        fs::write(data.join("config/moonraker.conf"), config).unwrap();
        let child = Command::new(python)
            .args(["-m", "moonraker", "-d"])
            .arg(data)
            .stdout(fs::File::create(data.join("out")).unwrap())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let moonraker = Moonraker { child, address };
        let end = Instant::now() + START;
        while TcpStream::connect(&moonraker.address).is_err() {
            assert!(Instant::now() < end, "{}", fs::read_to_string(data.join("out")).unwrap_or_default());
            std::thread::sleep(Duration::from_millis(200));
        }
        moonraker
    }
}

impl Drop for Moonraker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn from_nothing_to_a_measured_resonance_and_back() {
    const NAME: &str = "from_nothing_to_a_measured_resonance_and_back";
    let Some(checkout) = checkout(NAME) else { return };
    let Some(python) = std::env::var_os("MOONRAKER_PYTHON") else {
        return here::not_run("it needs Moonraker: MOONRAKER_PYTHON=PYTHON, after PYTHON -m pip install moonraker");
    };
    // The chip has the bus of a Raspberry Pi's header, and printer.cfg knows nothing of it.
    let describe = |board: String, _: &Path| {
        board.replace("bus = \"spidev0.0\"", "bus = \"spidev9.0\"").replace(
            "kind = \"accelerometer\"\nbus = \"spidev1.0\"\nselect_pin = \"accel_cs\"",
            "kind = \"accelerometer\"\nbus = \"spidev0.0\"",
        ) + "\n[[spi_bus]]\nname = \"spidev9.0\"\n"
    };
    let change = |config: String| without(&without(&config, "adxl345"), "resonance_tester") + UNHOMED;
    let mut printer = Printer::start_on(&checkout, describe, change);
    printer.until_state("ready");
    let root = printer.path("");
    let moonraker = Moonraker::start(Path::new(&python), &root.join("moonraker"), &printer.path("api"));
    fs::create_dir_all(root.join("proc/device-tree")).unwrap();
    fs::write(root.join("proc/device-tree/model"), "Raspberry Pi 4 Model B Rev 1.4\0").unwrap();
    fs::create_dir_all(root.join("boot/firmware")).unwrap();
    fs::write(root.join("boot/firmware/config.txt"), "[all]\n").unwrap();
    let printer_cfg = root.join("printer.cfg");
    let before = fs::read(&printer_cfg).unwrap();
    let pinion = |more: &[&str]| -> Value {
        let output = Command::new(pinion_path())
            .args(["add", "adxl345", "--yes", "--json", "--config", "/printer.cfg", "--mcu", "mcu", "--root"])
            .arg(&root)
            .args(["--moonraker", &moonraker.address])
            .args(more)
            .output()
            .unwrap();
        assert!(output.status.success(), "{output:?}");
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let has_chip = |printer: &mut Printer| {
        printer.until_state("ready");
        printer.object("configfile")["settings"]["adxl345"].is_object()
    };
    assert!(!has_chip(&mut printer));

    let added = pinion(&[]);
    // The chip's noise is in it.
    let gravity = added["measured"].as_str().and_then(|told| told.strip_suffix(" of gravity")?.rsplit(' ').next());
    let gravity: f64 = gravity.and_then(|share| share.parse().ok()).unwrap_or_else(|| panic!("{added}"));
    assert!((gravity - 1.0).abs() < 0.05, "{added}");
    assert!(added["warning"].is_null(), "{added}");
    assert!(has_chip(&mut printer));
    printer.gcode(WHERE_IT_STANDS);
    // The command that it names next, around the resonance.
    assert_eq!(added["next"][1], "SHAPER_CALIBRATE");
    let name = format!("pinion_add_{}", std::process::id());
    printer.gcode(&format!("SHAPER_CALIBRATE AXIS=x NAME={name} {}", sweep(57.0)));
    let found_hz = peak(format!("/tmp/calibration_data_x_{name}.csv"), "psd_x");
    assert!((found_hz - 57.0).abs() < 1.0, "{found_hz} Hz");

    printer.until_object("idle_timeout", "state", "Ready");
    let undone = pinion(&["--undo"]);
    assert!(undone["warning"].is_null(), "{undone}");
    assert_eq!(fs::read(&printer_cfg).unwrap(), before);
    assert!(!root.join("pinion").exists());
    assert!(!has_chip(&mut printer));
}

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
