// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices on spidev.

use nix::errno::Errno;
use pinion_client::Client;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, refusal, run, shutdown_of};
use crate::sysfs;
use crate::trace::Trace;

const MOCK: &str = "/sys/devices/platform/mock-spi";

fn transfer(client: &mut Client, oid: u8, data: &[u8]) -> Vec<u8> {
    let args = [("oid", oid.into()), ("data", data.into())];
    let response = client.query("spi_transfer", &args, "spi_transfer_response", Some(oid)).expect("a response");
    response.bytes("response").expect("bytes").to_vec()
}

fn sent() -> Vec<String> {
    sysfs::read(format!("{MOCK}/sent")).lines().map(str::to_owned).collect()
}

fn plain(oid: u8, bus: &str, mode: u8) -> [String; 2] {
    [
        format!("config_spi_without_cs oid={oid}"),
        format!("spi_set_bus oid={oid} spi_bus={bus} mode={mode} rate=4000000"),
    ]
}

#[test]
fn transfers_come_back_in_order_from_two_devices_of_a_bus() {
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 2, &[plain(0, "spidev0.0", 0), plain(1, "spidev0.1", 3)].concat());
    sysfs::write(format!("{MOCK}/sent"), "0");
    assert_eq!(transfer(client, 0, &[0xde, 0xad]), [0xde, 0xad]);
    sysfs::write(format!("{MOCK}/replies"), "0102");
    assert_eq!(transfer(client, 1, &[0xbe, 0xef]), [1, 2]);
    // Many transfers at once.
    for number in 0..40_u8 {
        let data = [number, 1, 2, 3];
        let args = [("oid", (number % 2).into()), ("data", data[..].into())];
        client.send("spi_transfer", &args).expect("a session");
    }
    let replies = [0_u8, 1].map(|oid| {
        let until = std::time::Instant::now() + std::time::Duration::from_secs(5);
        let mut reply = || client.wait("spi_transfer_response", Some(oid), until).expect("a session").expect("a reply");
        (0..20).map(|_| reply().bytes("response").expect("bytes")[0]).collect::<Vec<_>>()
    });
    let numbers = |first: u8| (first..40).step_by(2).collect::<Vec<_>>();
    assert_eq!(replies, [numbers(0), numbers(1)]);
    let mut expected = vec!["cs0 0 4000000 de ad".to_owned(), "cs1 3 4000000 be ef".to_owned()];
    expected.extend((0..40).map(|number| format!("cs{} {} 4000000 {number:02x} 01 02 03", number % 2, number % 2 * 3)));
    assert_eq!(sent(), expected);
}

#[test]
fn chip_selects_of_either_sense_and_modes_of_chips_on_one_node() {
    let sim = GpioSim::builder("lab", 8).name(2, "CS_LOW").name(3, "CS_HIGH").build();
    let program = Program::start();
    let client = &mut program.connect();
    let bus = |oid, mode| format!("spi_set_bus oid={oid} spi_bus=spidev0.0 mode={mode} rate=1000000");
    configure(
        client,
        3,
        &[
            "config_spi oid=0 pin=CS_LOW cs_active_high=0".into(),
            bus(0, 1),
            "config_spi oid=1 pin=CS_HIGH cs_active_high=1".into(),
            bus(1, 2),
            "config_spi_shutdown oid=2 spi_oid=1 shutdown_msg=55aa".into(),
        ],
    );
    assert_eq!([2, 3].map(|offset| sim.level(offset)), [true, false], "nobody is selected");
    sysfs::write(format!("{MOCK}/sent"), "0");
    let trace = Trace::start();
    for (oid, byte) in [(0, 1), (1, 2), (0, 3)] {
        assert_eq!(transfer(client, oid, &[byte]), [byte]);
    }
    run(client, "spi_send oid=1 data=04");
    client.emergency_stop().expect("a session");
    let [low, high] = [2, 3].map(|offset| sim.kernel_number(offset));
    let selected = [[(low, false), (low, true)], [(high, true), (high, false)]];
    let expected = [0, 1, 0, 1, 1].map(|oid: usize| selected[oid]).concat();
    let writes = || trace.writes().iter().map(|write| (write.line, write.level)).collect::<Vec<_>>();
    sysfs::wait_until("five transfers are over", || writes().len() == expected.len());
    assert_eq!(writes(), expected);
    // Before a chip of the other polarity is selected, a byte without a chip select moves the clock.
    let expected = [
        "cs0 1 1000000 00",
        "cs0 1 1000000 01",
        "cs0 2 1000000 00",
        "cs0 2 1000000 02",
        "cs0 1 1000000 00",
        "cs0 1 1000000 03",
        "cs0 2 1000000 00",
        "cs0 2 1000000 04",
        "cs0 2 1000000 55 aa",
    ];
    assert_eq!(sent(), expected);
}

#[test]
fn the_idle_clock_moves_while_no_chip_is_selected() {
    let sim = GpioSim::builder("lab", 8).name(2, "CS_A").name(3, "CS_B").name(4, "CS_C").build();
    let program = Program::start();
    let client = &mut program.connect();
    // Two chips on one node, and one on another node of its controller.
    let chips = [("CS_A", "spidev0.0", 0), ("CS_B", "spidev0.0", 3), ("CS_C", "spidev0.1", 2)];
    let config = chips.iter().enumerate().flat_map(|(oid, (line, bus, mode))| {
        [
            format!("config_spi oid={oid} pin={line} cs_active_high=0"),
            format!("spi_set_bus oid={oid} spi_bus={bus} mode={mode} rate=1000000"),
        ]
    });
    configure(client, 3, &config.collect::<Vec<_>>());
    sysfs::write(format!("{MOCK}/clock"), "0");
    let trace = Trace::start();
    for (oid, byte) in [(1, 1), (0, 2), (2, 3), (1, 4), (0, 5), (2, 6), (0, 7)] {
        assert_eq!(transfer(client, oid, &[byte]), [byte]);
    }
    let record = sysfs::read(format!("{MOCK}/clock"));
    let moves: Vec<u64> = record.lines().map(|line| line.split(' ').next().unwrap().parse().unwrap()).collect();
    assert!(moves.len() >= 5, "{record}");
    let lines = [2, 3, 4].map(|offset| sim.kernel_number(offset));
    let writes: Vec<_> = trace.writes().into_iter().filter(|write| lines.contains(&write.line)).collect();
    assert_eq!(writes.len(), 14);
    for selected in writes.chunks(2) {
        let (from, until) = (selected[0].at_ns, selected[1].at_ns);
        assert!(!selected[0].level && selected[1].level && selected[0].line == selected[1].line);
        assert!(!moves.iter().any(|at| (from..=until).contains(at)), "{from} to {until}: {record}");
    }
}

#[test]
fn a_controller_of_one_data_line_takes_what_is_only_sent() {
    sysfs::write(format!("{MOCK}/half_duplex"), "1");
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 1, &plain(0, "spidev0.0", 0));
    sysfs::write(format!("{MOCK}/sent"), "0");
    run(client, "spi_send oid=0 data=0102");
    assert_eq!(sent(), ["cs0 0 4000000 01 02"]);
    client.send("spi_transfer", &[("oid", 0_u8.into()), ("data", [3][..].into())]).expect("a session");
    assert_eq!(shutdown_of(client), "Unable to issue spi ioctl");
    sysfs::write(format!("{MOCK}/half_duplex"), "0");
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn what_goes_wrong_names_the_device() {
        let program = Program::start();
        let client = &mut program.connect();
        configure(client, 1, &plain(0, "spidev0.1", 0));
        sysfs::write(format!("{MOCK}/fail"), format!("{} 1", Errno::EIO as i32));
        run(client, "spi_send oid=0 data=01");
        assert_eq!(shutdown_of(client), "Unable to issue spi ioctl");
        program.wait_for_line(&["Unable to issue spi ioctl", "/dev/spidev0.1", "1 bytes at 4000000 Hz"]);
        configure(client, 1, &plain(0, "spidev0.1", 0));
        assert_eq!(transfer(client, 0, &[7]), [7]);

        assert_eq!(refusal(client, 1, &plain(0, "spidev3.2", 0)), "Unable to open spi device");
        program.wait_for_line(&["there is no /dev/spidev3.2", "spidev0.0, spidev0.1"]);
        assert_eq!(refusal(client, 1, &plain(0, "spidev0.0", 4)), "Invalid spi config");
        configure(client, 1, &plain(0, "spidev0.0", 0));
        assert_eq!(transfer(client, 0, &[8]), [8]);
    }
}
