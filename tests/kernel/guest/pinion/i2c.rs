// SPDX-License-Identifier: GPL-3.0-or-later
//! I2C devices on i2c-dev, and on GPIO lines.

use nix::errno::Errno;
use pinion_client::Client;
use pinion_client::config::Config;
use pinion_client::motion::{MoveQueue, Profile, Stepper};

use crate::gpio_sim::GpioSim;
use crate::mock::i2c;
use crate::program::{Program, configure, refusal};
use crate::sysfs;
use crate::trace::Trace;

const MOCK: &str = "/sys/devices/platform/mock-i2c";

/// A transfer's status and the bytes read.
fn transfer(client: &mut Client, oid: u8, write: &[u8], read_len: u8) -> (String, Vec<u8>) {
    let args = [("oid", oid.into()), ("write", write.into()), ("read_len", read_len.into())];
    let response = client.query("i2c_transfer", &args, "i2c_response", Some(oid)).expect("a response");
    (response.text("i2c_bus_status").expect("a status"), response.bytes("response").expect("bytes").to_vec())
}

/// The mocked bus's name in the dictionary.
fn bus_name() -> String {
    let node = i2c::bus();
    let name = node.file_name().and_then(|name| name.to_str()).expect("a name");
    name.replace("i2c-", "i2c.")
}

fn device(oid: u8, bus: &str, address: u8) -> [String; 2] {
    [format!("config_i2c oid={oid}"), format!("i2c_set_bus oid={oid} i2c_bus={bus} rate=100000 address={address}")]
}

fn sent() -> Vec<String> {
    sysfs::read(format!("{MOCK}/sent")).lines().map(str::to_owned).collect()
}

#[test]
fn registers_are_written_and_read_with_one_message_each_way() {
    let program = Program::start();
    let client = &mut program.connect();
    let bus = bus_name();
    configure(client, 2, &[device(0, &bus, 0x51), device(1, &bus, 0x52)].concat());
    sysfs::write(format!("{MOCK}/sent"), "0");
    assert_eq!(transfer(client, 0, &[0x20, 0xde, 0xad], 0), ("SUCCESS".into(), vec![]));
    assert_eq!(transfer(client, 1, &[0x20, 0xbe], 0), ("SUCCESS".into(), vec![]));
    assert_eq!(transfer(client, 0, &[0x20], 2), ("SUCCESS".into(), vec![0xde, 0xad]));
    assert_eq!(transfer(client, 1, &[0x20], 1), ("SUCCESS".into(), vec![0xbe]));
    // Without a write it reads on.
    assert_eq!(transfer(client, 0, &[0x20], 1), ("SUCCESS".into(), vec![0xde]));
    assert_eq!(transfer(client, 0, &[], 1), ("SUCCESS".into(), vec![0xad]));
    assert_eq!(sent(), ["51 20 de ad", "52 20 be", "51 20", "52 20", "51 20"]);
}

#[test]
fn what_the_kernel_says_becomes_a_status_and_the_mcu_goes_on() {
    let program = Program::start();
    let client = &mut program.connect();
    let bus = bus_name();
    configure(client, 2, &[device(0, &bus, 0x51), device(1, &bus, 0x20)].concat());
    assert_eq!(transfer(client, 1, &[0], 1), ("START_NACK".into(), vec![0]));
    program.wait_for_line(&["WARN", "I2C START NACK", "address 0x20", "check its wiring"]);
    for (errno, status) in [
        (Errno::ENXIO, "START_NACK"),
        (Errno::EREMOTEIO, "NACK"),
        (Errno::EIO, "NACK"),
        (Errno::ETIMEDOUT, "BUS_TIMEOUT"),
        (Errno::EOPNOTSUPP, "NACK"),
    ] {
        sysfs::write(format!("{MOCK}/fail"), format!("{} 1", errno as i32));
        assert_eq!(transfer(client, 0, &[7, 1], 0), (status.to_owned(), vec![]), "{errno}");
        assert_eq!(transfer(client, 0, &[7, 1], 0), ("SUCCESS".into(), vec![]));
    }
    program.wait_for_line(&["I2C NACK", "refuses a transfer of 2 bytes written and 0 read"]);
    // A transfer that only reads is retried.
    sysfs::write(format!("{MOCK}/fail"), format!("{} 2", Errno::ENXIO as i32));
    assert_eq!(transfer(client, 0, &[], 1).0, "SUCCESS");
}

/// gpio-sim has no chip that answers. `crates/firmware/src/board/soft_i2c.rs` tests the bits on the wires.
#[test]
fn a_software_bus_pulls_low_or_lets_go_and_never_drives_high() {
    let sim = GpioSim::builder("lab", 8).name(2, "SDA").name(3, "SCL").build();
    let program = Program::start();
    let client = &mut program.connect();
    configure(
        client,
        1,
        &["config_i2c oid=0", "i2c_set_sw_bus oid=0 scl_pin=SCL sda_pin=SDA pulse_ticks=250 address=80"],
    );
    assert!([2, 3].iter().all(|offset| sim.is_pulled_up(*offset)));
    // As with a chip that hangs. A line that is driven high would read high.
    sim.pull(3, false);
    assert_eq!(transfer(client, 0, &[0x10], 0), ("BUS_TIMEOUT".into(), vec![]));
    program.wait_for_line(&["I2C Timeout", "SCL stays low", "check the wiring"]);
    assert_eq!(transfer(client, 0, &[0x10], 0).0, "BUS_TIMEOUT", "the MCU goes on");
}

#[test]
fn a_software_spi_clocks_its_bits_on_lines() {
    let sim = GpioSim::builder("lab", 8).name(2, "DATA").name(3, "CLOCK").name(4, "SELECT").build();
    let program = Program::start();
    let client = &mut program.connect();
    configure(
        client,
        1,
        &[
            "config_spi oid=0 pin=SELECT cs_active_high=0",
            // One line is both, as with a Dotstar.
            "spi_set_sw_bus oid=0 miso_pin=DATA mosi_pin=DATA sclk_pin=CLOCK mode=0 pulse_ticks=1000",
        ],
    );
    let trace = Trace::start();
    let args = [("oid", 0_u8.into()), ("data", [0xa5_u8, 0x3c][..].into())];
    let response = client.query("spi_transfer", &args, "spi_transfer_response", Some(0)).expect("a response");
    assert_eq!(response.bytes("response").expect("bytes"), [0xa5, 0x3c]);
    let [clock, select] = [3, 4].map(|offset| trace.writes_to(sim.kernel_number(offset)));
    // The clock idles first.
    let edges = &clock[1..];
    assert!(
        edges.len() == 32
            && edges.iter().zip([true, false].into_iter().cycle()).all(|(edge, level)| edge.level == level)
    );
    // A bit takes at least 20 us.
    assert!(edges.windows(3).all(|three| three[2].at_ns - three[0].at_ns >= 20_000), "{edges:?}");
    assert_eq!(select.iter().map(|write| write.level).collect::<Vec<_>>(), [false, true]);
    assert!(select[0].at_ns < edges[0].at_ns && edges[31].at_ns < select[1].at_ns);
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn a_slow_bus_keeps_no_step() {
        let sim = GpioSim::builder("lab", 8).name(3, "STEP").name(5, "DIR").build();
        let program = Program::start();
        let client = &mut program.connect();
        let mut config = Config::default();
        let stepper = Stepper::configure(&mut config, "STEP", 0, "DIR", false, 100).expect("few objects");
        let oid = config.oid().expect("few objects");
        for line in
            [format!("config_i2c oid={oid}"), format!("i2c_set_bus oid={oid} i2c_bus={} rate=1 address=81", bus_name())]
        {
            config.add(line);
        }
        let status = config.apply(client).expect("a configuration that it takes");
        let mut queue = MoveQueue::new(status.move_count);
        let profile = Profile::trapezoid(700, 4000.0, 40_000.0, 50e6).expect("a profile");
        let _slow = sysfs::set(format!("{MOCK}/delay_ms"), "60", "0");
        let trace = Trace::start();
        // A display that is refreshed at the same time. The test does not wait for the answers.
        let args = [("oid", oid.into()), ("write", [0_u8, 1][..].into()), ("read_len", 0_u8.into())];
        client.send("i2c_transfer", &args).expect("a session");
        queue.run(client, stepper, true, &profile, None).expect("a move");
        assert_eq!(trace.writes_to(sim.kernel_number(3)).len(), 2 * 700);
        assert_eq!(stepper.position(client).expect("a position"), 700);
        assert_eq!(transfer(client, oid, &[0], 1), ("SUCCESS".into(), vec![1]));
    }

    #[test]
    fn a_bus_or_an_address_that_can_not_be_had_is_named() {
        let program = Program::start();
        let client = &mut program.connect();
        assert_eq!(refusal(client, 1, &device(0, "i2c.13", 0x51)), "Unable to open i2c device");
        program.wait_for_line(&["there is no /dev/i2c-13", &bus_name(), "dtparam=i2c_arm=on"]);
        configure(client, 1, &device(0, &bus_name(), 0x51));
        assert_eq!(transfer(client, 0, &[0], 1).0, "SUCCESS");
    }
}
