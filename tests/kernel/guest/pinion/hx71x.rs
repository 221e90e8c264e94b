// SPDX-License-Identifier: GPL-3.0-or-later
//! The load cell ADC HX711 on the data lines of a controller of spidev.

use std::time::{Duration, Instant};

use crate::program::{Program, configure, refusal, run};
use crate::sysfs;

const MOCK: &str = "/sys/devices/platform/mock-spi";
/// The bits on MISO for -5000 (ffec78), each bit twice, and for the pulse behind it.
const SAMPLE: &str = "fffffcf03fc0ff";

#[test]
fn a_sample_is_one_transfer_whose_bytes_end_low() {
    let program = Program::start();
    let client = &mut program.connect();
    let config = |sclk: &str| format!("config_hx71x oid=0 gain_channel=1 dout_pin=spidev0.1/miso sclk_pin={sclk}");
    configure(client, 1, &[config("spidev0.1")]);
    sysfs::write(format!("{MOCK}/sent"), "0");
    // During the start of the chip, a look that finds none, and twelve samples.
    let replies = format!("{}ff{}", "ff".repeat(9), format!("00{SAMPLE}").repeat(12));
    sysfs::write(format!("{MOCK}/replies"), replies);
    run(client, "query_hx71x oid=0 rest_ticks=62500");
    let until = Instant::now() + Duration::from_secs(10);
    let data = client.wait("sensor_bulk_data", Some(0), until).expect("a session").expect("samples");
    assert_eq!(data.bytes("data").expect("bytes"), (-5000_i32).to_le_bytes().repeat(12));
    run(client, "query_hx71x oid=0 rest_ticks=0");
    let sent = sysfs::read(format!("{MOCK}/sent"));
    let mut lines = sent.lines();
    let mut next = |bytes: &str| assert_eq!(lines.next(), Some(format!("cs1 0 500000{bytes}").as_str()));
    next(&(" ff".repeat(8) + " 00"));
    next(" 00");
    for _ in 0..12 {
        next(" 00");
        next(" aa aa aa aa aa aa 80");
    }
    assert_eq!(sent.lines().last(), Some("cs1 0 500000 ff ff ff ff ff ff ff ff"), "the chip is switched off");

    assert_eq!(refusal(client, 1, &[config("spidev0.0")]), "Not an output pin");
    program.wait_for_line(&["spidev0.1/miso has another clock than spidev0.0", "write sclk_pin: spidev0.1"]);
}
