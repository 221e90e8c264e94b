// SPDX-License-Identifier: GPL-3.0-or-later
//! PCA9685 outputs on i2c-dev. A file of registers replaces the chip.

use std::thread;
use std::time::Duration;

use nix::errno::Errno;

use crate::mock::i2c;
use crate::program::{Program, configure, refusal, run};
use crate::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-i2c";

/// A 50 Hz output on channel 2 of the chip at 0x53, off at a shutdown.
fn output(value: u16) -> String {
    let node = i2c::bus();
    let bus = node.file_name().and_then(|name| name.to_str()).and_then(|name| name.strip_prefix("i2c-"));
    let bus = bus.expect("a number");
    format!(
        "config_pca9685 oid=0 bus={bus} addr=83 channel=2 cycle_ticks=1000000 value={value} default_value=0 max_duration=0"
    )
}

/// The messages to the chip since [`forget`]. It forgets none itself: a message that came between the two would be lost.
fn sent() -> Vec<String> {
    sysfs::read(format!("{MOCK}/sent")).lines().map(str::to_owned).collect()
}

fn forget() {
    sysfs::write(format!("{MOCK}/sent"), "0");
}

#[test]
fn a_chip_is_set_up_and_its_output_goes_off_at_a_shutdown() {
    let program = Program::start();
    let client = &mut program.connect();
    forget();
    configure(client, 1, &[output(2048)]);
    assert_eq!(sent(), ["53 00 31", "53 fe 79", "53 00 21", "53 fa 00 00 00 10", "53 0e 00 00 00 08"]);
    forget();
    let at = client.clock_in(0.05).expect("the clock").wire();
    run(client, &format!("queue_pca9685_out oid=0 clock={at} value=4096"));
    sysfs::wait_until("the output is on", || sent() == ["53 0e 00 10 00 00"]);
    forget();
    run(client, "emergency_stop");
    sysfs::wait_until("the output is off", || sent() == ["53 0e 00 00 00 10"]);
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_silent_chip_neither_ends_the_program_nor_keeps_it_from_the_next_configuration() {
        let mut program = Program::start();
        let client = &mut program.connect();
        configure(client, 1, &[output(2048)]);
        let silent = format!("{} 1000000", Errno::ENXIO as i32);
        let silent = sysfs::set(format!("{MOCK}/fail"), silent, "0 0");
        run(client, "emergency_stop");
        program.wait_for_line(&["PCA9685 has not accepted its shutdown values for 500 ms", "its outputs may be on"]);
        // The guardian ends a program that owes an output for a second.
        thread::sleep(Duration::from_secs(3));
        assert!(program.is_running(), "{}", program.log());
        assert_eq!(refusal(client, 1, &[output(0)]), "Unable to open and init PCA9685 device");
        configure::<&str>(client, 1, &[]);
        drop(silent);
        configure(client, 1, &[output(4096)]);
        assert_eq!(sent().last().map(String::as_str), Some("53 0e 00 10 00 00"));
    }
}
