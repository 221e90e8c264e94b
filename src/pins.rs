// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion pins`: the pins and buses of this computer, and how to write them in printer.cfg.
//!
//! The list is gathered first, then written as a table or as JSON.

mod gather;
mod text;
mod used;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use serde::Serialize;

use pinion_linux::Inventory;
use pinion_linux::gpio::{Chip, FastGpio};
use pinion_linux::sysfs::Sysfs;

use super::failed;
use super::page::{Page, print};
use pinion_system::board;
use pinion_system::complete::offering;

/// Options of `pinion pins`.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct PinsArgs {
    /// Show only GPIO lines that no program holds
    #[arg(long)]
    pub free: bool,
    /// Show who uses which line, bus, address or port, and where that is written
    #[arg(long, conflicts_with = "free")]
    pub used: bool,
    /// With --used: write a picture of the header to this SVG file
    #[arg(long, value_name = "FILE", requires = "used", value_hint = clap::ValueHint::FilePath)]
    pub picture: Option<PathBuf>,
    /// With --used: the board, if its device tree is not there, as on a mounted card
    #[arg(long, value_name = "BOARD", requires = "used", value_parser = offering::<String>(&board::NAMES), hide_possible_values = true)]
    pub board: Option<String>,
    /// With --used: the system whose files are below DIR, for example a mounted card
    #[arg(long, value_name = "DIR", requires = "used", default_value = "/", value_hint = clap::ValueHint::DirPath)]
    pub root: PathBuf,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
    /// Show only entries with this text in a name, in any case (for example gpio17, pinctrl, voltage)
    #[arg(value_name = "NAME", value_hint = clap::ValueHint::Other)]
    pub filter: Option<String>,
}

/// Prints the list.
pub(crate) fn run(args: &PinsArgs) -> ExitCode {
    if args.used {
        return used::run(args);
    }
    let inventory = Inventory::scan();
    let sysfs = Sysfs::scan(Path::new("/"));
    let fast = |chip: &Chip| chip.registers(FastGpio::Auto).ok().map(|registers| registers.node().to_owned());
    let list = List::new(&inventory, &sysfs, args, &|device, id| reading(&inventory, device, id), &fast);
    let page = list.page();
    let is_nothing = !args.json && page.is_empty();
    for problem in &inventory.problems {
        // If nothing is listed, this is the reason.
        log::log!(if is_nothing { log::Level::Error } else { log::Level::Warn }, "{problem}");
    }
    // Programs want JSON even if nothing is listed.
    if args.json {
        return print(&Page::json(&list.json())).map_or_else(failed, |()| ExitCode::SUCCESS);
    }
    if is_nothing {
        return match args.filter.is_none() && !inventory.problems.is_empty() {
            true => ExitCode::FAILURE,
            false => failed(nothing(args)),
        };
    }
    print(&page).map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn nothing(args: &PinsArgs) -> String {
    match &args.filter {
        Some(filter) => format!("nothing here has \"{filter}\" in a name: pinion pins lists all"),
        None if args.free => "no GPIO line is free: pinion pins lists who holds them".to_owned(),
        None => {
            "no GPIO chip, ADC, PWM, SPI, I2C, 1-Wire device or serial port was found: enable them in the device tree \
                 (pinion doctor says how), or try \"pinion run --board sim\""
                .to_owned()
        }
    }
}

/// The present reading of a channel.
#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
enum Reading {
    /// The driver's value, and the host's value in counts of 0 to 4095.
    Good {
        raw: i64,
        counts: u16,
    },
    Failed {
        error: String,
    },
}

impl std::fmt::Display for Reading {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Reading::Good { raw, counts } => write!(f, "{raw} ({counts} of 4095)"),
            Reading::Failed { error } => f.write_str(error),
        }
    }
}

fn reading(inventory: &Inventory, device: u32, id: &str) -> Reading {
    let Some(reader) = inventory.adc(device, id) else {
        return Reading::Failed { error: "gone".to_owned() };
    };
    match (reader.read_raw(), reader.read_counts()) {
        (Ok(raw), Ok(counts)) => Reading::Good { raw, counts },
        (Err(error), _) => Reading::Failed { error: error.to_string() },
        (_, Err(shutdown)) => Reading::Failed { error: shutdown.to_string() },
    }
}

/// The whole list. The field names are the keys of the JSON, and other programs rely on them.
#[derive(Debug, Serialize)]
struct List {
    gpio: Vec<GpioChip>,
    adc: Vec<AdcDevice>,
    pwm: Vec<PwmEntry>,
    spi: Vec<SpiDevice>,
    i2c: Vec<I2cEntry>,
    w1: Vec<W1Sensor>,
    serial: Vec<SerialEntry>,
    /// Devices that are there and cannot be used.
    problems: Vec<String>,
}

#[derive(Debug, Serialize)]
struct GpioChip {
    chip: String,
    label: String,
    line_count: usize,
    /// An expander: its lines are not for steps or other timed edges.
    behind_bus: bool,
    /// The node of the registers by which its lines are written and read, unless fast_gpio is off.
    fast: Option<String>,
    lines: Vec<GpioLine>,
}

#[derive(Debug, Serialize)]
struct GpioLine {
    line: u32,
    /// The device tree's name.
    name: Option<String>,
    direction: &'static str,
    /// Whether a driver or a program has it.
    held: bool,
    /// Its holder, as far as the kernel knows.
    consumer: Option<String>,
    /// The device that the pin is switched to.
    device: Option<String>,
    /// How printer.cfg may write it: the line's own name first.
    pins: Vec<String>,
}

impl GpioLine {
    fn is_free(&self) -> bool {
        !self.held && self.device.is_none()
    }

    fn used_by(&self) -> &str {
        match (&self.consumer, &self.device) {
            (Some(consumer), _) if self.held => consumer,
            (_, Some(device)) => device,
            _ if self.held => "the kernel",
            _ => "free",
        }
    }
}

#[derive(Debug, Serialize)]
struct AdcDevice {
    device: String,
    name: String,
    channel_count: usize,
    channels: Vec<AdcChannel>,
}

#[derive(Debug, Serialize)]
struct AdcChannel {
    channel: String,
    /// `None` if the driver does not report it.
    resolution: Option<String>,
    reading: Reading,
    pins: Vec<String>,
}

#[derive(Debug, Serialize)]
struct PwmEntry {
    chip: String,
    device: Option<String>,
    channels: Vec<PwmLine>,
}

#[derive(Debug, Serialize)]
struct PwmLine {
    channel: u32,
    exported: bool,
    consumer: Option<String>,
    /// `None` if it is beyond the channels that have names.
    pin: Option<String>,
    /// How printer.cfg may write it: the name by the chip's device first.
    pins: Vec<String>,
}

#[derive(Debug, Serialize)]
struct SpiDevice {
    device: String,
    spi_bus: String,
}

#[derive(Debug, Serialize)]
struct I2cEntry {
    device: String,
    adapter: Option<String>,
    i2c_bus: String,
    /// Chips that the kernel knows. A chip with a driver is not for printer.cfg.
    chips: Vec<I2cDevice>,
}

#[derive(Debug, Serialize)]
struct I2cDevice {
    address: u16,
    name: String,
    driver: Option<String>,
}

#[derive(Debug, Serialize)]
struct W1Sensor {
    serial_no: String,
}

#[derive(Debug, Serialize)]
struct SerialEntry {
    device: String,
    /// Whether the kernel writes its messages there. Then it is of no use for printer.cfg.
    console: bool,
    uart_pin: String,
    /// Other names of the port, also for printer.cfg.
    links: Vec<String>,
}

impl List {
    fn json(&self) -> String {
        match serde_json::to_string_pretty(self) {
            Ok(json) => json + "\n",
            Err(error) => unreachable!("maps of texts are JSON: {error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::boards::{self, TestBoard};
    use pinion_linux::adc::{Channel, Format, IioDevice};
    use pinion_linux::gpio::LineInfo;
    use pinion_linux::pins::{Names, line_number};
    use pinion_linux::pwm;
    use pinion_linux::spi::Node;
    use pinion_linux::sysfs::{I2cBus, I2cChip, PwmChannel, PwmChip};
    use pinion_linux::uart::Uart;
    use pinion_testkit::names::any_name;
    use pinion_testkit::names::assert_plain;
    use proptest::prelude::*;
    use serde_json::{Value, json};

    fn pi() -> Inventory {
        let line = |name: &str, consumer: Option<&str>, held| LineInfo {
            name: Some(name.into()),
            output: consumer.is_some(),
            held,
            consumer: consumer.map(str::to_owned),
        };
        Inventory {
            chips: vec![Chip {
                number: 0,
                label: "pinctrl-bcm2835".into(),
                sleeps: false,
                lines: vec![
                    line("ID_SDA", None, false),
                    line("-", None, false),
                    line("SPI_CE1_N", Some("spi0 CS1"), true),
                ],
            }],
            adcs: vec![IioDevice {
                number: 0,
                name: "ads1115".into(),
                label: None,
                channels: vec![
                    Channel { id: "voltage0".into(), format: Format::new(16, true) },
                    Channel { id: "voltage0-voltage1".into(), format: None },
                ],
            }],
            pwm: vec![pwm::Chip { number: 0, device: Some("fe20c000.pwm".into()), channels: 2 }],
            spi: vec![Node::of(1)],
            uarts: vec![
                Uart { name: "ttyAMA1".into(), device: (204, 65), links: vec!["serial0".into()], is_console: false },
                Uart { name: "ttyS0".into(), device: (4, 64), links: vec![], is_console: true },
            ],
            ..Inventory::default()
        }
    }

    fn sysfs() -> Sysfs {
        let fan = PwmChannel { exported: false, consumer: Some("pwm-fan".into()) };
        Sysfs {
            pwm: vec![PwmChip {
                number: 0,
                device: Some("fe20c000.pwm".into()),
                channels: vec![PwmChannel::default(), fan],
            }],
            i2c: vec![I2cBus {
                number: 1,
                adapter: Some("bcm2835 (i2c@7e804000)".into()),
                chips: vec![I2cChip { address: 0x48, name: "ads1115".into(), driver: Some("ads1015".into()) }],
            }],
            thermometers: vec!["28-0316a4f1ff27".into()],
            devices: [(("pinctrl-bcm2835".into(), 1), "fe804000.i2c (i2c1)".into())].into(),
        }
    }

    fn of(inventory: &Inventory, args: &PinsArgs) -> List {
        let fast = |chip: &Chip| (chip.label == "pinctrl-bcm2835").then(|| "/dev/gpiomem".to_owned());
        List::new(inventory, &sysfs(), args, &|_, _| Reading::Good { raw: 1200, counts: 150 }, &fast)
    }

    fn printed(args: &PinsArgs) -> String {
        of(&pi(), args).page().to_string()
    }

    fn filtered(filter: &str) -> String {
        printed(&PinsArgs { filter: Some(filter.into()), ..PinsArgs::default() })
    }

    #[test]
    fn everything_is_listed() {
        assert_eq!(
            printed(&PinsArgs::default()),
            "\
gpiochip0 pinctrl-bcm2835, 3 lines, fast (registers, /dev/gpiomem), for LEDs too
  line  name       dir  used by              in printer.cfg
  0     ID_SDA     in   free                 ID_SDA, gpio0
  1     -          in   fe804000.i2c (i2c1)  pinctrl-bcm2835/gpio1, gpio1
  2     SPI_CE1_N  out  spi0 CS1             SPI_CE1_N, gpio2

iio:device0 ads1115, 2 channels
  channel            resolution       reads               in printer.cfg
  voltage0           signed 16 bits   1200 (150 of 4095)  ads1115/voltage0, analog0
  voltage0-voltage1  12 bits assumed  1200 (150 of 4095)  ads1115/voltage0-voltage1

pwmchip0 fe20c000.pwm
  channel  used by  in printer.cfg
  0        free     pin: fe20c000.pwm/pwm0 or pwmchip0/pwm0, with hardware_pwm: True
  1        pwm-fan  pin: fe20c000.pwm/pwm1 or pwmchip0/pwm1, with hardware_pwm: True

SPI
  device          in printer.cfg
  /dev/spidev0.1  spi_bus: spidev0.1, for LEDs pin: spidev0.1, for an HX711 dout_pin: spidev0.1/miso

I2C
  device      adapter               used by the kernel       in printer.cfg
  /dev/i2c-1  bcm2835 (i2c@7e8040…  0x48 ads1115 by ads1015  i2c_bus: i2c.1

1-Wire
  sensor           in printer.cfg
  28-0316a4f1ff27  sensor_type: DS18B20, with serial_no: 28-0316a4f1ff27

Serial ports
  device        in printer.cfg
  /dev/ttyAMA1  for TMC drivers uart_pin: ttyAMA1, or serial0
  /dev/ttyS0    none: the kernel writes its messages there
"
        );
    }

    /// The lines of `pinion pins` on a board, for this filter, without their headings.
    fn on_board(board: &TestBoard, filter: &str) -> Vec<String> {
        let tree = board.tree();
        let (inventory, sysfs) = (board.inventory(&tree), Sysfs::scan(&tree.computer().path("/")));
        let args = PinsArgs { filter: Some(filter.into()), ..PinsArgs::default() };
        let none = |_: u32, _: &str| Reading::Failed { error: "there are no ADCs".into() };
        let page = List::new(&inventory, &sysfs, &args, &none, &|_| None).page().to_string();
        let rows = page.lines().filter(|line| line.starts_with("  ") && !line.contains("in printer.cfg"));
        rows.map(|row| row.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
    }

    #[test]
    fn boards_that_people_own() {
        let lines = |board: TestBoard, filter: &str| on_board(&board, filter);
        assert_eq!(lines(boards::pi4(), "gpio17"), ["17 GPIO17 in free GPIO17, gpio17"]);
        assert_eq!(lines(boards::pi4(), "gpio14"), ["14 TXD1 in free TXD1, gpio14"]);
        assert_eq!(
            lines(boards::pi4(), "gpiochip1/gpio7"),
            ["7 - in free raspberrypi-exp-gpio/gpio7, gpiochip1/gpio7"]
        );
        assert_eq!(
            lines(boards::pi4(), "pwm1"),
            [
                "41 PWM1_MOSI in free PWM1_MOSI, gpio41",
                "1 free pin: fe20c000.pwm/pwm1 or pwmchip0/pwm1, with hardware_pwm: True"
            ]
        );
        assert_eq!(lines(boards::zero2(), "gpio17"), ["17 GPIO17 in free GPIO17, gpio17"]);
        assert_eq!(lines(boards::zero2(), "gpio31"), ["31 NC in free pinctrl-bcm2835/gpio31, gpio31"], "many are NC");
        let renumbered = "17 GPIO17 in free GPIO17, gpiochip15/gpio17";
        assert!(lines(boards::pi5(), "gpio17").contains(&renumbered.into()));
        assert_eq!(lines(boards::pi5(), "gpiochip4/gpio17"), [renumbered], "it is found by its former numbers");
        assert_eq!(lines(boards::pi5(), "GPIO33"), ["33 - in free pinctrl-rp1/gpio33, gpiochip15/gpio33"]);
        assert_eq!(
            lines(boards::pi5(), "1f00098000.pwm/pwm2"),
            ["2 free pin: 1f00098000.pwm/pwm2 or pwmchip0/pwm2, with hardware_pwm: True"]
        );
        assert_eq!(lines(boards::pi5_debian(), "rp1/gpio17"), ["17 - in free pinctrl-rp1/gpio17, gpiochip4/gpio17"]);
        assert_eq!(lines(boards::cb1(), "gpio79"), ["79 - in free 300b000.pinctrl/gpio79, gpio79"]);
        assert_eq!(lines(boards::cb1(), "chip1/gpio31"), ["31 - in free 7022000.pinctrl/gpio31, gpiochip1/gpio31"]);
        assert_eq!(lines(boards::rk3566(), "gpio3_a1"), ["1 pin-11 [GPIO3_A1] in free gpio3/gpio1, gpiochip3/gpio1"]);
    }

    /// No board has a line without a name, or a name for two lines.
    #[test]
    fn each_line_of_a_board_has_names_of_its_own() {
        for board in boards::all() {
            let inventory = board.inventory(&board.tree());
            let names = Names::of(&inventory);
            let mut seen = std::collections::HashSet::new();
            for chip in &inventory.chips {
                for offset in (0..).take(chip.lines.len()) {
                    let own = names.of_pin(line_number(chip.number, offset).unwrap());
                    assert!(!own.is_empty(), "{} {offset}", chip.label);
                    own.iter().for_each(|name| assert!(seen.insert((*name).to_owned()), "{name}"));
                    for former in inventory.former_names(chip, offset) {
                        assert!(seen.insert(former.clone()), "{former}");
                    }
                }
            }
        }
    }

    proptest! {
        #[test]
        fn whatever_a_device_is_called_stays_in_its_line(name in any_name()) {
            let page = |name: &str| {
                let (mut inventory, mut sysfs) = (pi(), sysfs());
                let chip = &mut inventory.chips[0];
                sysfs.devices = [((name.to_owned(), 1), name.to_owned())].into();
                chip.label = name.to_owned();
                for line in &mut chip.lines {
                    (line.name, line.consumer) = (Some(name.to_owned()), Some(name.to_owned()));
                }
                inventory.adcs[0].name = name.to_owned();
                inventory.adcs[0].channels[0].id = name.to_owned();
                inventory.pwm[0].device = Some(name.to_owned());
                (sysfs.pwm[0].device, sysfs.i2c[0].adapter) = (Some(name.to_owned()), Some(name.to_owned()));
                sysfs.pwm[0].channels[1].consumer = Some(name.to_owned());
                let chip = &mut sysfs.i2c[0].chips[0];
                (chip.name, chip.driver) = (name.to_owned(), Some(name.to_owned()));
                sysfs.thermometers = vec![name.to_owned()];
                inventory.uarts[0].links = vec![name.to_owned()];
                let error = || Reading::Failed { error: name.to_owned() };
                let list = List::new(&inventory, &sysfs, &PinsArgs::default(), &|_, _| error(), &|_| None);
                (list.page().to_string(), Page::json(&list.json()).to_string())
            };
            let (text, json) = page(&name);
            assert_plain(&text, page("x").0.matches('\n').count());
            assert_plain(&json, json.matches('\n').count());
            serde_json::from_str::<Value>(&json).unwrap();
        }
    }

    #[test]
    fn a_chip_behind_a_bus_says_what_it_is_no_good_for() {
        let mut inventory = pi();
        inventory.chips[0].sleeps = true;
        let list = of(&inventory, &PinsArgs::default()).page().to_string();
        assert!(list.starts_with("gpiochip0 pinctrl-bcm2835, 3 lines, behind a bus: not for steps"), "{list}");
    }

    #[test]
    fn free_lines_only() {
        let free = printed(&PinsArgs { free: true, ..PinsArgs::default() });
        assert!(free.contains("ID_SDA") && !free.contains("SPI"), "{free}");
        assert!(!free.contains("i2c"), "a pin that a device has is not free: {free}");
    }

    #[test]
    fn a_filter_finds_any_of_the_names() {
        for filter in ["id_sda", "gpio0", "gpiochip0/gpio0", "bcm2835/gpio0"] {
            let list = filtered(filter);
            assert!(list.contains("ID_SDA") && !list.contains("SPI_CE1"), "{filter}: {list}");
        }
        assert!(filtered("analog0").contains("voltage0"));
        assert!(filtered("spidev0.1").starts_with("SPI"));
        assert!(filtered("PWM0").contains("pwmchip0/pwm0") && !filtered("pwm0").contains("pwm1"));
        assert!(filtered("i2c.1").starts_with("I2C") && filtered("28-03").starts_with("1-Wire"));
        assert!(filtered("serial0").starts_with("Serial ports") && !filtered("ttyama").contains("ttyS0"));
        assert_eq!(filtered("nonesuch"), "");
    }

    /// Programs rely on these keys, and the manual page names them.
    #[test]
    fn the_json_has_all_of_it_under_keys_that_stay() {
        let value: Value = serde_json::from_str(&of(&pi(), &PinsArgs::default()).json()).unwrap();
        assert_eq!(
            value["gpio"][0]["lines"][2],
            json!({
                "line": 2, "name": "SPI_CE1_N", "direction": "out", "held": true, "consumer": "spi0 CS1",
                "device": null, "pins": ["SPI_CE1_N", "gpio2", "pinctrl-bcm2835/gpio2"]
            })
        );
        assert_eq!(value["gpio"][0]["lines"][1]["device"], "fe804000.i2c (i2c1)");
        let chip = &value["gpio"][0];
        assert_eq!((&chip["chip"], &chip["label"]), (&json!("gpiochip0"), &json!("pinctrl-bcm2835")));
        assert_eq!((&chip["line_count"], &chip["behind_bus"]), (&json!(3), &json!(false)));
        assert_eq!(
            value["adc"][0]["channels"][0],
            json!({
                "channel": "voltage0", "resolution": "signed 16 bits", "reading": { "raw": 1200, "counts": 150 },
                "pins": ["ads1115/voltage0", "analog0"]
            })
        );
        assert_eq!(
            value["pwm"][0]["channels"][1],
            json!({
                "channel": 1, "exported": false, "consumer": "pwm-fan", "pin": "pwmchip0/pwm1",
                "pins": ["fe20c000.pwm/pwm1", "pwmchip0/pwm1"]
            })
        );
        assert_eq!(value["spi"], json!([{ "device": "/dev/spidev0.1", "spi_bus": "spidev0.1" }]));
        assert_eq!(
            value["i2c"][0],
            json!({
                "device": "/dev/i2c-1", "adapter": "bcm2835 (i2c@7e804000)", "i2c_bus": "i2c.1",
                "chips": [{ "address": 72, "name": "ads1115", "driver": "ads1015" }]
            })
        );
        assert_eq!(value["w1"], json!([{ "serial_no": "28-0316a4f1ff27" }]));
        assert_eq!(
            value["serial"][0],
            json!({ "device": "/dev/ttyAMA1", "console": false, "uart_pin": "ttyAMA1", "links": ["serial0"] })
        );
        assert_eq!(value["problems"], json!([]));
        let failed = serde_json::to_value(Reading::Failed { error: "EIO".into() }).unwrap();
        assert_eq!(failed, json!({ "error": "EIO" }));
    }
}
