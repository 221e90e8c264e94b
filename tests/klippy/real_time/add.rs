// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add` with a real klippy and a real Moonraker: from nothing to a measured resonance, and back.
//!
//! `MOONRAKER_PYTHON` names a Python that has Moonraker (`pip install moonraker`).

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use pinion_testkit::here;
use serde_json::Value;

use super::Printer;
use crate::checkout;
use crate::klippy::{UNHOMED, WHERE_IT_STANDS, pinion_path, without};
use crate::rings::{peak, sweep};

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
    let moonraker = Moonraker::start(Path::new(&python), &root.join("moonraker"), &printer.path("klippy.sock"));
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
