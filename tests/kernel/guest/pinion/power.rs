// SPDX-License-Identifier: GPL-3.0-or-later
//! The verdict over a stop, with Linux's driver for the voltage of a Raspberry Pi.

use std::process::Command;
use std::thread;
use std::time::Duration;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure};
use crate::sysfs;

/// The voltage is too low now, and was since the last question.
const UNDERVOLTAGE: &str = "0x10001";

/// The driver, and the firmware that it asks.
struct Firmware;

impl Firmware {
    fn load() -> Firmware {
        let loaded = Command::new("insmod").arg("/tests/firmware.ko").status().expect("busybox");
        assert!(loaded.success());
        Firmware
    }
}

impl Drop for Firmware {
    fn drop(&mut self) {
        let _ = Command::new("rmmod").arg("mock_firmware").status();
    }
}

/// A host that is late stops the MCU. Returns the verdict.
fn verdict_over_a_late_host() -> String {
    let _sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 1, &["config_digital_out oid=0 pin=lab/gpio5 value=0 default_value=0 max_duration=0"]);
    let late = client.clock_in(-1.0).expect("a clock").wire();
    client.send_line(&format!("queue_digital_out oid=0 clock={late} on_ticks=1")).expect("a session");
    program.wait_for_line(&["the host's block came"])
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_stop_at_a_low_voltage_is_reported_with_the_voltage() {
        let _firmware = Firmware::load();
        assert!(verdict_over_a_late_host().contains("look at the host's load"));
        sysfs::write("/sys/module/mock_firmware/parameters/throttled", UNDERVOLTAGE);
        // The driver asks every two seconds.
        thread::sleep(Duration::from_secs(3));
        let verdict = verdict_over_a_late_host();
        assert!(verdict.contains("the power supply's voltage was too low then"), "{verdict}");
        assert!(verdict.contains("use a better power supply"), "{verdict}");
    }
}
