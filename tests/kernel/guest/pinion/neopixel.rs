// SPDX-License-Identifier: GPL-3.0-or-later
//! LEDs on the data output of a controller of spidev.

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, refusal, run};
use crate::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-spi";

fn config(pin: &str, data_size: u16) -> String {
    format!("config_neopixel oid=0 pin={pin} data_size={data_size} bit_max_ticks=200 reset_min_ticks=2500")
}

#[test]
fn a_chain_is_sent_in_one_message() {
    let _sim = GpioSim::new("lab", 8);
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 1, &[config("spidev0.1", 3)]);
    sysfs::write(format!("{MOCK}/sent"), "0");
    run(client, "neopixel_update oid=0 pos=0 data=ff0093");
    let result = client.query("neopixel_send", &[("oid", 0_u8.into())], "neopixel_result", Some(0)).expect("a result");
    assert!(result.flag("success").expect("a flag"));
    // 300 us, because newer LEDs need more than the requested 50 us.
    let low = " 00".repeat(120);
    let colours = " ee ee ee ee 88 88 88 88 e8 8e 88 ee";
    assert_eq!(sysfs::read(format!("{MOCK}/sent")).trim(), format!("cs1 0 3200000{low}{colours}{low}"));

    assert_eq!(refusal(client, 1, &[config("lab/gpio1", 3)]), "Not an output pin");
    program.wait_for_line(&["cannot drive LEDs", "pin: spidev0.0"]);
    // klippy's longest chain fits. A message longer than the driver's buffer is refused.
    configure(client, 1, &[config("spidev0.1", 500)]);
    configure(client, 1, &[config("spidev0.1", 964)]);
    assert_eq!(refusal(client, 1, &[config("spidev0.1", 965)]), "Invalid neopixel data_size");
    program.wait_for_line(&["spidev.bufsiz"]);
}
