// SPDX-License-Identifier: GPL-3.0-or-later
//! The simulated board's buses in virtual time: which chips listen, and which answer.

use super::*;
use crate::catalog::PartConfig;
use crate::part::tmc2209::Tmc2209Config;
use crate::part::tmc5160::Tmc5160Config;
use pinion_firmware::board::SerialPort;
use std::time::Duration;

impl Bench {
    fn chip_select(&mut self, pin: &str) -> ChipSelect {
        ChipSelect { line: self.output(pin, true), active_high: false, clock: Arc::new(self.clock.clone()) }
    }

    fn spi(&mut self, bus: &str, select_pin: Option<&str>) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let bus = self.board.spi_buses().iter().find(|range| range.name == bus).map_or(99, |range| range.first);
        let chip_select = select_pin.map(|pin| self.chip_select(pin));
        self.board.spi(SpiConfig { bus, mode: 3, rate_hz: 1_000_000, chip_select })
    }
}

fn exchange(device: &mut OnWorker<dyn BusDevice>, bytes: &str) -> String {
    let byte = |at| u8::from_str_radix(&bytes[at..at + 2], 16).unwrap();
    let mut bytes: Vec<u8> = (0..bytes.len()).step_by(2).map(byte).collect();
    device.device.exchange(&mut bytes).unwrap();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn each_spi_bus_has_its_worker_and_the_first_one_sends_back_what_it_is_sent() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let mut loopback = bench.spi("spidev0.0", None).unwrap();
    assert_eq!(exchange(&mut loopback, "0070696e"), "0070696e");
    let driver = bench.spi("spidev1.0", Some("z_cs")).unwrap();
    assert_eq!((loopback.bus.as_str(), driver.bus.as_str()), ("spi0", "spi1"));
    let error = bench.spi("spidev7.0", None).err().unwrap();
    assert_eq!(error.reason, reason::SPI_OPEN);
    assert!(error.to_string().contains("use spidev0.0 or spidev1.0"), "{error}");
}

#[test]
fn a_chip_hears_what_is_said_while_its_pin_selects_it() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = SimConfig::default_printer();
    let driver = |axis: &str| {
        PartConfig::Tmc5160(Tmc5160Config {
            diag1_pin: None,
            diag0_pin: None,
            chain_position: None,
            chain_length: None,
            sg_free: 200,
            bus: "spidev1.0".into(),
            select_pin: PinName::try_from(format!("{axis}_cs")).ok(),
            axis: axis.into(),
        })
    };
    config.parts = vec![driver("x"), driver("y")];
    config.spi_buses[1].trace_pins = vec!["led".into(), "beeper".into()];
    let mut bench = Bench::new(config);
    bench.probe.record_spi(std::fs::File::create(folder.path().join("trace")).unwrap());
    let led = bench.output("led", true);
    let [mut x, mut y] = ["x_cs", "y_cs"].map(|pin| bench.spi("spidev1.0", Some(pin)).unwrap());
    assert_eq!(exchange(&mut x, "8000000004"), "0900000000");
    assert_eq!(exchange(&mut y, "0000000000"), "0900000000");
    led.write(false).unwrap();
    assert_eq!(exchange(&mut x, "0000000000"), "0900000004");
    assert_eq!(exchange(&mut y, "0000000000"), "0900000008", "the reset value");
    let mut nobody = bench.spi("spidev1.0", None).unwrap();
    assert_eq!(exchange(&mut nobody, "0000"), "ffff", "pulled up");
    assert_eq!(
        std::fs::read_to_string(folder.path().join("trace")).unwrap(),
        "bus=spidev1.0 chips=tmc5160 x sent=8000000004 received=0900000000 led=11111 beeper=00000\n\
         bus=spidev1.0 chips=tmc5160 y sent=0000000000 received=0900000000 led=11111 beeper=00000\n\
         bus=spidev1.0 chips=tmc5160 x sent=0000000000 received=0900000004 led=00000 beeper=00000\n\
         bus=spidev1.0 chips=tmc5160 y sent=0000000000 received=0900000008 led=00000 beeper=00000\n\
         bus=spidev1.0 chips= sent=0000 received=ffff led=00 beeper=00\n"
    );
}

#[test]
fn a_chip_that_is_spoken_to_in_another_mode_hears_nothing() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let chip_select = Some(bench.chip_select("z_cs"));
    let OnWorker { mut device, .. } =
        bench.board.spi(SpiConfig { bus: 1, mode: 0, rate_hz: 1_000_000, chip_select }).unwrap();
    let mut bytes = [0; 5];
    device.exchange(&mut bytes).unwrap();
    assert_eq!(bytes, [0xff; 5]);
}

#[test]
fn the_data_output_of_a_bus_drives_lights_and_nothing_else() {
    let mut bench = Bench::new(SimConfig::default_printer());
    let pin = bench.pin("spidev3.0");
    let mut mosi = bench.board.mosi(pin, 3_200_000).unwrap().unwrap();
    assert_eq!(mosi.line.bus, "spi2");
    // Green, in the encoding of `neopixel`, and 50 us low.
    let mut message = [[0xee; 4], [0x88; 4], [0x88; 4]].concat();
    message.extend([0; 20]);
    mosi.line.device.exchange(&mut message).unwrap();
    let strip = bench.probe.sights().find(|(name, _)| *name == "strip").unwrap();
    assert_eq!(strip.1.to_string(), "#00ff00 off off off off off off off");
    let error = bench.board.line(pin, Direction::at_rest(false)).err().unwrap();
    assert!(error.trouble.cause.contains("spidev3.0 of the simulated printer is an SPI bus's data output"), "{error}");
    let led = bench.pin("led");
    assert!(bench.board.mosi(led, 3_200_000).unwrap().is_none());
}

#[test]
fn a_thermometer_is_found_by_its_serial_and_reads_in_sixteenths() {
    let toml = SimConfig::default_toml().replace("conversion_ms = 750", "conversion_ms = 0");
    let mut config = SimConfig::parse(&toml, "test").unwrap();
    config.heaters[1].start_celsius = Some(30.7);
    let mut board = SimBoard::new(config, Arc::new(VirtualClock::at(Clock::EPOCH))).unwrap();
    let mut thermometer = board.ds18b20(b"28-0316b5f6a2ff").unwrap();
    assert_eq!(thermometer.device.read(), Ok(30_687), "30.6875 C, which the kernel cuts off");
    let error = board.ds18b20(b"28-000000000000").err().unwrap();
    assert_eq!(error.reason, reason::DS18B20_OPEN);
    assert!(error.to_string().contains("28-0316b5f6a2ff"), "{error}");
}

/// Everything that the port receives after a message, with its echo.
fn heard(port: &mut dyn SerialPort, message: &[u8]) -> Vec<u8> {
    port.send(message).unwrap();
    let mut bytes = [0; 32];
    let mut len = 0;
    while let count @ 1.. = port.receive(&mut bytes[len..], Duration::from_millis(1)).unwrap() {
        len += count;
    }
    bytes[..len].to_vec()
}

#[test]
fn drivers_in_a_chain_have_one_select_pin() {
    let mut config = SimConfig::default_printer();
    let driver = |axis: &str, place| {
        PartConfig::Tmc5160(Tmc5160Config {
            diag1_pin: None,
            diag0_pin: None,
            chain_position: Some(place),
            chain_length: Some(3),
            sg_free: 200,
            bus: "spidev1.0".into(),
            select_pin: PinName::try_from("cs".to_owned()).ok(),
            axis: axis.into(),
        })
    };
    // Nothing is described at the place in the middle.
    config.parts = vec![driver("y", 3), driver("x", 1)];
    let mut bench = Bench::new(config);
    let mut chain = bench.spi("spidev1.0", Some("cs")).unwrap();
    // The first bytes go to the last driver: GCONF of y gets 4, and GCONF of x gets 8.
    assert_eq!(&exchange(&mut chain, "800000000400000000008000000008")[..10], "0900000000", "the status of y");
    let read = exchange(&mut chain, "000000000000000000000000000000");
    assert_eq!((&read[..10], &read[20..]), ("0900000004", "0900000008"));
}

#[test]
fn a_multiplexer_connects_a_driver_to_the_wire() {
    let mut config = SimConfig::default_printer();
    let pin = |name: &str| PinName::try_from(name.to_owned()).ok();
    let driver = |axis: &str, address, select: &str| {
        PartConfig::Tmc2209(Tmc2209Config {
            uart_pin: None,
            uart_port: pin("ttyAMA1"),
            tx_pin: None,
            select_pins: pin(select).into_iter().collect(),
            address,
            axis: axis.into(),
            diag_pin: None,
            sg_free: 250,
        })
    };
    config.parts = vec![driver("x", 0, "mux"), driver("y", 3, "!mux")];
    let mut bench = Bench::new(config);
    let port = bench.pin("ttyAMA1");
    let mut port = bench.board.serial(port, 40_000).unwrap().unwrap();
    let mux = bench.output("mux", false);
    for (high, answers) in [(false, [false, true]), (true, [true, false])] {
        mux.write(high).unwrap();
        for (read, answers) in [[0xf5, 0, 2, 0xc8], [0xf5, 3, 2, 0x25]].iter().zip(answers) {
            // The port hears its own four bytes.
            assert_eq!(heard(&mut *port.device, read).len() > 4, answers, "{read:?} with the line at {high}");
        }
    }
}

#[test]
fn drivers_share_the_wire_of_a_serial_port() {
    let mut config = SimConfig::default_printer();
    let pin = |name: &str| PinName::try_from(name.to_owned()).ok();
    let driver = |axis: &str, address| {
        PartConfig::Tmc2209(Tmc2209Config {
            uart_pin: None,
            uart_port: pin("ttyAMA1"),
            tx_pin: None,
            select_pins: Vec::new(),
            address,
            axis: axis.into(),
            diag_pin: None,
            sg_free: 250,
        })
    };
    config.parts = vec![driver("x", 0), driver("y", 3)];
    let mut bench = Bench::new(config);
    let (port, led) = (bench.pin("ttyAMA1"), bench.pin("led"));
    assert!(bench.board.serial(led, 40_000).unwrap().is_none());
    let mut port = bench.board.serial(port, 40_000).unwrap().unwrap();
    assert_eq!(port.bus, "ttyAMA1");
    let port = &mut *port.device;
    // IFCNT of each, before and after a write to one of them (IHOLD_IRUN).
    let reads = [[0xf5, 0, 2, 0xc8], [0xf5, 3, 2, 0x25]];
    let write = [0xf5, 3, 0x90, 0, 0x08, 0x1f, 0x08, 0x5d];
    let count = |heard: &[u8], read: &[u8]| {
        assert_eq!((&heard[..4], &heard[4..7], heard.len()), (read, &[0x05, 0xff, 2][..], 12));
        heard[10]
    };
    assert_eq!(reads.map(|read| count(&heard(port, &read), &read)), [0, 0]);
    assert_eq!(heard(port, &write), write, "the echo alone");
    assert_eq!(reads.map(|read| count(&heard(port, &read), &read)), [0, 1]);
    // A wrong check sum, another address, no sync nibble, a half message.
    let faults = [&[0xf5, 0, 2, 0xc9][..], &[0xf5, 1, 2, 0x7e], &[0xf4, 0, 2, 0xc3], &[0xf5, 0, 2]];
    faults.iter().for_each(|fault| assert_eq!(heard(port, fault), *fault));
    let error = bench.board.line(bench.pin("ttyAMA1"), Direction::Input(Bias::None)).err().unwrap();
    assert!(error.trouble.cause.contains("ttyAMA1 of the simulated printer is a serial port"), "{error}");
}
