// SPDX-License-Identifier: GPL-3.0-or-later
//! This computer as a board.

#![forbid(unsafe_code)]

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use pinion_firmware::board::{
    Adc, Bias, Board, BusDevice, ClaimedLine, CountedLine, Direction, Edges, I2cConfig, Mosi, OnWorker, Pin, Pwm,
    PwmConfig, Range, SerialPort, SpiConfig, Thermometer,
};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::trouble::Trouble;

use crate::gpio::{FastChips, FastGpio};
use crate::guard::{Guard, SharedGuard};
use crate::inventory::Inventory;
use crate::pins::{Names, Target};
use crate::places::{DEV, GPIO, IIO, PWM, SPI_MASTERS, W1};
use crate::{adc, gpio, i2c, pins, pwm, spi, uart, w1};

/// The worker that reads the edges of all lines.
const EDGE_WORKER: &str = "edges";

/// The result of the last search.
#[derive(Default)]
struct Seen {
    inventory: Inventory,
    names: Names,
}

impl Seen {
    fn look() -> Seen {
        Seen::of(Inventory::scan())
    }

    fn of(inventory: Inventory) -> Seen {
        Seen { names: Names::of(&inventory), inventory }
    }

    /// Everything that a host learns from it, and the numbers that stand for the header.
    fn parts(&self) -> (String, [Vec<Range>; 3], &[u32]) {
        let Seen { inventory, names } = self;
        let ranges = [names.ranges(), spi::ranges(&inventory.spi), i2c::ranges(&inventory.i2c)];
        (inventory.describe(), ranges, &inventory.vacant)
    }

    /// The header's line that a pin with a [former](Inventory::renumbered) number means.
    fn renumbered(&self, chip: u32, offset: u32) -> Option<u32> {
        pins::line_number(self.inventory.renumbered(chip)?.number, offset)
    }

    /// Which line is taken for a pin with a former number, and what to write. `number` is the line's own.
    fn about_renumbered(&self, chip: u32, offset: u32, number: u32) -> Option<Trouble> {
        let header = self.inventory.renumbered(chip)?;
        let pin = if chip == 0 { format!("gpio{offset}") } else { format!("gpiochip{chip}/gpio{offset}") };
        let own = self.names.of_pin(number).first().map(ToString::to_string);
        let name = own.unwrap_or_else(|| format!("gpiochip{}/gpio{offset}", header.number));
        let cause = format!(
            "this kernel has no gpiochip{chip}, so this is line {offset} of the 40-pin header (gpiochip{}, {})",
            header.number, header.label
        );
        let remedy = format!("write {name} in printer.cfg, and each pin like it by its name (pinion pins lists them)");
        Some(Trouble::new(cause).remedy(remedy).of(pin))
    }
}

/// This computer as a board.
pub struct LinuxBoard {
    /// Shared with the thread that searches again. The core locks it only during configuration. The lock is always held
    /// only for a moment, never during a search.
    seen: Arc<Mutex<Seen>>,
    guard: SharedGuard,
    fast: FastChips,
    /// The SPI controllers in use.
    spi_controllers: HashMap<u32, Arc<Mutex<spi::Controller>>>,
    /// The numbers of IIO devices that do not report a resolution, and that the log has already named.
    assumed: BTreeSet<u32>,
    /// Whether the log has named a pin with a former number.
    named_renumbered: AtomicBool,
    dev: PathBuf,
    gpio: PathBuf,
    pwm: PathBuf,
}

impl LinuxBoard {
    /// Searches this computer and publishes the result. Every output is given to `guard`.
    pub fn new(guard: Option<Box<dyn Guard>>, fast: FastGpio) -> LinuxBoard {
        let seen = Seen::look();
        for problem in &seen.inventory.problems {
            log::warn!("{problem}");
        }
        LinuxBoard {
            fast: FastChips::new(fast),
            ..LinuxBoard::over(Arc::new(Mutex::new(seen)), SharedGuard::new(guard))
        }
    }

    /// The board of an MCU. As of the clock ([`crate::clock::Monotonic::shared`]), its functions are in this crate.
    pub fn boxed(guard: Option<Box<dyn Guard>>, fast: FastGpio) -> Box<dyn Board> {
        Box::new(LinuxBoard::new(guard, fast))
    }

    fn over(seen: Arc<Mutex<Seen>>, guard: SharedGuard) -> LinuxBoard {
        LinuxBoard {
            seen,
            guard,
            fast: FastChips::new(FastGpio::Off),
            spi_controllers: HashMap::new(),
            assumed: BTreeSet::new(),
            named_renumbered: AtomicBool::new(false),
            dev: DEV.into(),
            gpio: GPIO.into(),
            pwm: PWM.into(),
        }
    }

    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The line of a pin, not yet requested from the kernel. Errors are those of outputs or inputs.
    fn open_line(&self, pin: Pin, direction: Direction) -> Result<gpio::Handle, Shutdown> {
        let (wanted, no_line, refused) = match direction {
            Direction::Output { .. } | Direction::OpenDrain => ("an output", reason::NOT_OUTPUT, reason::OUTPUT_LINE),
            Direction::Input(_) => ("an input", reason::NOT_INPUT, reason::INPUT_LINE),
        };
        let Target::Line { chip, offset } = Target::of(pin) else {
            let cause = format!("{} cannot be {wanted}", Target::of(pin));
            return Err(Shutdown::because(no_line, cause).remedy("choose a GPIO pin (pinion pins lists them)"));
        };
        gpio::open(&self.dev, chip, offset, refused)
    }

    fn open_spi(&mut self, config: SpiConfig) -> Result<spi::Spi, Shutdown> {
        let controller = self.spi_controllers.entry(spi::Node::of(config.bus).bus).or_default().clone();
        spi::Spi::open(&self.dev, config, controller)
    }

    /// The number of a pin's IIO device, and the driver's name for the channel.
    fn channel(&self, pin: Pin) -> Result<(u32, String), Shutdown> {
        match Target::of(pin) {
            Target::Analog(n) => Ok((0, format!("voltage{n}"))),
            Target::Channel { device, position } => {
                let seen = self.seen();
                let adc = seen.inventory.adcs.iter().find(|adc| adc.number == device);
                let channel = adc.and_then(|adc| adc.channels.get(position as usize));
                channel.map(|channel| (device, channel.id.clone())).ok_or_else(|| {
                    let channel = format!("channel {position}");
                    Shutdown::because(reason::ADC_OPEN, adc::missing(device, &channel, &seen.inventory.adcs))
                })
            }
            other => {
                let stop = Shutdown::because(reason::ADC_OPEN, format!("{other} is not an ADC channel"));
                Err(stop.remedy("choose an analog pin (pinion pins lists them)"))
            }
        }
    }
}

impl Board for LinuxBoard {
    fn describe(&self) -> String {
        self.seen().inventory.describe()
    }

    fn pins(&self) -> Vec<Range> {
        self.seen().names.ranges()
    }

    fn spi_buses(&self) -> Vec<Range> {
        spi::ranges(&self.seen().inventory.spi)
    }

    fn view(&self) -> Option<Box<dyn Board>> {
        Some(Box::new(LinuxBoard::over(self.seen.clone(), SharedGuard::new(None))))
    }

    fn look_again(&mut self) -> bool {
        let now = Seen::look();
        let mut seen = self.seen();
        if now.parts() == seen.parts() {
            return false;
        }
        let before = std::mem::replace(&mut *seen, now);
        for problem in seen.inventory.problems.iter().filter(|problem| !before.inventory.problems.contains(problem)) {
            log::warn!("{problem}");
        }
        true
    }

    /// A chip may have several nodes in /dev: with some kernels of a Raspberry Pi 5, `gpiochip4` is a link to `gpiochip0`.
    /// With others it has neither number, and what was found says so until the next host: the line stays the same.
    fn canonical(&self, pin: Pin) -> Pin {
        let Target::Line { chip, offset } = Target::of(pin) else { return pin };
        let seen = self.seen();
        if let Some(number) = seen.renumbered(chip, offset) {
            if !self.named_renumbered.swap(true, Ordering::Relaxed)
                && let Some(about) = seen.about_renumbered(chip, offset, number)
            {
                log::warn!("{about}");
            }
            return Pin(number);
        }
        gpio::number_behind(&self.dev, chip).and_then(|chip| pins::line_number(chip, offset)).map_or(pin, Pin)
    }

    fn line(&mut self, pin: Pin, direction: Direction) -> Result<ClaimedLine, Shutdown> {
        let handle = self.open_line(pin, direction)?;
        let sleeps = gpio::may_sleep(&self.gpio, handle.chip(), handle.label());
        let sleeps_on = sleeps.then(|| handle.chip().to_owned());
        let mut line = handle.request(direction, self.guard.clone(), sleeps_on.clone())?;
        if !sleeps {
            self.fast.equip(&mut line, direction, &self.dev, &self.gpio);
        }
        Ok(ClaimedLine { line: Arc::new(line), sleeps_on })
    }

    /// A line of a chip on a bus is polled. At each interrupt its driver asks the chip which line changed. It then
    /// timestamps and counts only what it finds.
    fn counted_line(&mut self, pin: Pin, bias: Bias) -> Result<CountedLine, Shutdown> {
        let handle = self.open_line(pin, Direction::Input(bias))?;
        let edges = match gpio::may_sleep(&self.gpio, handle.chip(), handle.label()) {
            true => Err("its chip is behind a bus".into()),
            false => handle.request_edges(&self.dev, bias),
        };
        match edges {
            Ok((line, edges)) => {
                let edges = OnWorker { bus: EDGE_WORKER.to_owned(), device: Box::new(edges) as Box<dyn Edges> };
                Ok(CountedLine { line: ClaimedLine { line: Arc::new(line), sleeps_on: None }, edges: Ok(edges) })
            }
            Err(why) => Ok(CountedLine { line: self.line(pin, Direction::Input(bias))?, edges: Err(why) }),
        }
    }

    fn adc(&mut self, pin: Pin) -> Result<OnWorker<dyn Adc>, Shutdown> {
        let (device, id) = self.channel(pin)?;
        let mut seen = self.seen();
        if seen.inventory.adc(device, &id).is_none() {
            // The device's driver may have been loaded after the host came, so search again. The pin numbers stay as
            // they were published then.
            seen.inventory.context =
                adc::context(Path::new(IIO)).map_err(|problem| Shutdown::because(reason::ADC_OPEN, problem))?;
        }
        let reader = seen.inventory.adc(device, &id).ok_or_else(|| {
            let context = seen.inventory.context.as_ref();
            let present = context.map(adc::scan).unwrap_or_default();
            Shutdown::because(reason::ADC_OPEN, adc::missing(device, &id, &present))
        })?;
        drop(seen);
        if reader.format().is_none() && self.assumed.insert(device) {
            log::info!("iio:device{device} does not report its resolution: 12 bits are assumed");
        }
        Ok(OnWorker { bus: format!("iio:device{device}"), device: Box::new(reader) })
    }

    fn spi(&mut self, config: SpiConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let device = self.open_spi(config)?;
        Ok(OnWorker { bus: device.worker(), device: Box::new(device) })
    }

    fn i2c_buses(&self) -> Vec<Range> {
        i2c::ranges(&self.seen().inventory.i2c)
    }

    fn i2c(&mut self, config: I2cConfig) -> Result<OnWorker<dyn BusDevice>, Shutdown> {
        let device = i2c::I2c::open(&self.dev, config)?;
        Ok(OnWorker { bus: format!("i2c{}", config.bus), device: Box::new(device) })
    }

    fn pwm(&mut self, config: PwmConfig) -> Result<OnWorker<dyn Pwm>, Shutdown> {
        let Target::Pwm { chip, channel } = Target::of(config.pin) else {
            let cause = format!("{} has no hardware PWM", Target::of(config.pin));
            return Err(Shutdown::because(reason::PWM_CONFIG, cause).remedy("choose pwmchipC/pwmN"));
        };
        let channel = pwm::Channel { chip, channel };
        let device = pwm::Pwm::open(&self.pwm, channel, &config, self.guard.clone())?;
        // A write to one channel may block in the chip's driver. The chip's channels share this driver, so they share a
        // worker.
        Ok(OnWorker { bus: format!("pwmchip{chip}"), device: Box::new(device) })
    }

    fn mosi(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<Mosi>, Shutdown> {
        let Target::Mosi(node) = Target::of(pin) else { return Ok(None) };
        let bus = node.number().unwrap_or(u32::MAX);
        let device = self.open_spi(SpiConfig { bus, mode: 0, rate_hz, chip_select: None })?.with_mosi_idle_low();
        let pauses = spi::driver_without_dma(Path::new(SPI_MASTERS), node).map(|driver| {
            Trouble::new(format!(
                "its controller ({driver}) has no DMA and may pause within a frame, so LEDs may show wrong colors"
            ))
            .remedy("use another controller (on a Raspberry Pi SPI0)")
            .of(format_args!("/dev/{node}"))
        });
        let line = OnWorker { bus: device.worker(), device: Box::new(device) as Box<dyn BusDevice> };
        Ok(Some(Mosi { line, message_max: spi::message_max(), pauses }))
    }

    fn mosi_of(&self, miso: Pin) -> Option<Pin> {
        pins::mosi_of(miso)
    }

    /// Each port has its own worker.
    fn serial(&mut self, pin: Pin, rate_hz: u32) -> Result<Option<OnWorker<dyn SerialPort>>, Shutdown> {
        let Target::Serial(major, minor) = Target::of(pin) else { return Ok(None) };
        let found = self.seen().inventory.uarts.iter().find(|uart| uart.device == (major, minor)).cloned();
        let uart = found.ok_or_else(uart::gone)?;
        let port = uart::Port::open(&self.dev, &uart, rate_hz)?;
        Ok(Some(OnWorker { bus: uart.name, device: Box::new(port) }))
    }

    /// Each sensor has its own worker: the kernel lets others use the bus while one measures.
    fn ds18b20(&mut self, serial: &[u8]) -> Result<OnWorker<dyn Thermometer>, Shutdown> {
        let device = w1::Ds18b20::open(Path::new(W1), serial)?;
        Ok(OnWorker { bus: format!("w1 {}", String::from_utf8_lossy(serial)), device: Box::new(device) })
    }

    fn reset(&mut self) {
        if let Err(error) = self.guard.release() {
            log::error!("the guardian does not give the lines back: {error}: restart Pinion");
        }
        self.spi_controllers.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::board::ShutdownValue;
    use std::fs;

    const ON: Direction = Direction::at_rest(true);

    fn board(dev: &Path) -> LinuxBoard {
        LinuxBoard {
            dev: dev.into(),
            gpio: dev.join("gpio"),
            pwm: dev.join("pwm"),
            ..LinuxBoard::over(Arc::default(), SharedGuard::new(None))
        }
    }

    #[test]
    fn a_pin_of_another_kind() {
        let dev = tempfile::tempdir().unwrap();
        let mut board = board(dev.path());
        let error = board.line(Pin(4097), ON).err().unwrap();
        assert_eq!(
            error.to_string(),
            "Not an output pin: analog1 (an ADC channel) cannot be an output: choose a GPIO pin \
             (pinion pins lists them)"
        );
        let error = board.line(Pin(5000), Direction::Input(Bias::None)).err().unwrap();
        assert_eq!(error.reason, reason::NOT_INPUT);
        let error = board.adc(Pin(17)).err().unwrap();
        assert_eq!(error.reason, reason::ADC_OPEN);
        assert!(error.to_string().contains("gpiochip0 line 17 is not an ADC channel"), "{error}");
    }

    #[test]
    fn a_data_output_is_that_of_an_spi_device() {
        let dev = tempfile::tempdir().unwrap();
        let mut board = board(dev.path());
        assert!(board.mosi(Pin(17), 3_200_000).unwrap().is_none(), "it is a GPIO line");
        let names = Names::of(&Inventory { spi: vec![spi::Node::of(256), spi::Node::of(257)], ..Inventory::default() });
        let range = names.ranges().into_iter().find(|range| range.name == "spidev1.0").unwrap();
        assert_eq!(range.count, 2);
        // The error names the pin as an SPI device, and it is no GPIO line.
        let error = board.mosi(Pin(range.first + 1), 3_200_000).err().unwrap();
        assert_eq!(error.reason, reason::SPI_OPEN);
        assert!(error.trouble.cause.contains("spidev1.1"), "{error}");
        let error = board.line(Pin(range.first), ON).err().unwrap();
        assert!(
            error.trouble.cause.starts_with("spidev1.0 (an SPI device's data output) cannot be an output"),
            "{error}"
        );
    }

    #[test]
    fn nothing_is_there() {
        let dev = tempfile::tempdir().unwrap();
        let mut board = board(dev.path());
        let error = board.line(Pin(5 * 288), ON).err().unwrap();
        assert_eq!(error.reason, reason::CHIP_MISSING);
        assert!(error.to_string().contains("gpiochip5: this computer has no GPIO chip"), "{error}");
        assert_eq!(board.pins().len(), 28);
        assert_eq!(board.spi_buses().len(), 8);
        assert_eq!(board.i2c_buses().len(), 1);
        assert!(board.describe().starts_with("linux: no GPIO"));
    }

    /// A Raspberry Pi whose header and first other chip have these numbers. /dev has nodes with the numbers in `nodes`.
    fn pi(header: (u32, &str), other: (u32, &str), nodes: &[u32]) -> (tempfile::TempDir, LinuxBoard) {
        let dev = tempfile::tempdir().unwrap();
        nodes.iter().for_each(|node| fs::write(dev.path().join(format!("gpiochip{node}")), "").unwrap());
        let chip = |(number, label): (u32, &str), name: &str| gpio::Chip {
            number,
            label: label.into(),
            sleeps: false,
            lines: (0..54).map(|n| gpio::LineInfo { name: Some(format!("{name}{n}")), ..Default::default() }).collect(),
        };
        let chips = vec![chip(header, "GPIO"), chip(other, "OTHER")];
        let inventory = Inventory { chips, vacant: gpio::vacant(dev.path()), ..Inventory::default() };
        let mut board = board(dev.path());
        board.seen = Arc::new(Mutex::new(Seen::of(inventory)));
        (dev, board)
    }

    /// The line that a host's name leads to.
    fn meant(board: &LinuxBoard, name: &str) -> Target {
        let root = name.trim_end_matches(|c: char| c.is_ascii_digit());
        let number: u32 = name[root.len()..].parse().unwrap();
        let first = board.pins().into_iter().find(|range| range.name == format!("{root}0")).unwrap().first;
        Target::of(board.canonical(Pin(first + number)))
    }

    const BRCMSTB: &str = "gpio-brcmstb@107d508500";

    /// Raspberry Pi OS since Linux 6.12.96.
    #[test]
    fn numbers_that_no_chip_has_mean_the_header() {
        let (_dev, pi5) = pi((15, "pinctrl-rp1"), (11, BRCMSTB), &[11, 15]);
        for name in ["gpio17", "gpiochip0/gpio17", "gpiochip4/gpio17", "gpiochip15/gpio17"] {
            assert_eq!(meant(&pi5, name), Target::Line { chip: 15, offset: 17 }, "{name}");
        }
        assert_eq!(meant(&pi5, "gpiochip11/gpio17"), Target::Line { chip: 11, offset: 17 });
        assert_eq!(meant(&pi5, "gpiochip1/gpio17"), Target::Line { chip: 1, offset: 17 }, "it was never the header");
        // Only the header of a Pi 5 was ever gpiochip4.
        let (_dev, pi4) = pi((11, "pinctrl-bcm2711"), (12, "raspberrypi-exp-gpio"), &[11, 12]);
        assert_eq!(meant(&pi4, "gpio17"), Target::Line { chip: 11, offset: 17 });
        assert_eq!(meant(&pi4, "gpiochip4/gpio17"), Target::Line { chip: 4, offset: 17 });
        let (_dev, other) = pi((11, "300b000.pinctrl"), (12, "7022000.pinctrl"), &[11, 12]);
        assert_eq!(meant(&other, "gpio17"), Target::Line { chip: 0, offset: 17 }, "there is no header");
        let about = pi5.seen().about_renumbered(0, 17, 15 * 288 + 17).unwrap().to_string();
        assert_eq!(
            about,
            "gpio17: this kernel has no gpiochip0, so this is line 17 of the 40-pin header (gpiochip15, pinctrl-rp1): \
             write GPIO17 in printer.cfg, and each pin like it by its name (pinion pins lists them)"
        );
    }

    /// Raspberry Pi OS before. A chip that cannot be opened has its number, too.
    #[test]
    fn numbers_that_a_chip_has_mean_that_chip() {
        let (_dev, first_year) = pi((4, "pinctrl-rp1"), (0, BRCMSTB), &[0, 4]);
        assert_eq!(meant(&first_year, "gpio17"), Target::Line { chip: 0, offset: 17 });
        assert_eq!(meant(&first_year, "gpiochip4/gpio17"), Target::Line { chip: 4, offset: 17 });
        let (dev, later) = pi((0, "pinctrl-rp1"), (10, BRCMSTB), &[0, 10]);
        assert_eq!(meant(&later, "gpio17"), Target::Line { chip: 0, offset: 17 });
        std::os::unix::fs::symlink("gpiochip0", dev.path().join("gpiochip4")).unwrap();
        assert_eq!(meant(&later, "gpiochip4/gpio17"), Target::Line { chip: 0, offset: 17 });
        let (_dev, hidden) = pi((15, "pinctrl-rp1"), (11, BRCMSTB), &[0, 11, 15]);
        assert_eq!(meant(&hidden, "gpio17"), Target::Line { chip: 0, offset: 17 });
        assert_eq!(meant(&hidden, "gpiochip4/gpio17"), Target::Line { chip: 15, offset: 17 });
    }

    /// A line that is in use must not become another one because a chip comes.
    #[test]
    fn a_chip_that_comes_later_changes_nothing_for_this_host() {
        let (dev, board) = pi((15, "pinctrl-rp1"), (11, BRCMSTB), &[11, 15]);
        fs::write(dev.path().join("gpiochip0"), "").unwrap();
        assert_eq!(meant(&board, "gpio17"), Target::Line { chip: 15, offset: 17 });
    }

    #[test]
    fn a_line_of_the_header_has_its_former_names() {
        let (_dev, pi5) = pi((15, "pinctrl-rp1"), (11, BRCMSTB), &[11, 15]);
        let seen = pi5.seen();
        let former = |chip: usize| seen.inventory.former_names(&seen.inventory.chips[chip], 17);
        assert_eq!(former(0), ["gpio17", "gpiochip0/gpio17", "gpiochip4/gpio17"]);
        assert!(former(1).is_empty());
    }

    #[test]
    fn each_pwm_chip_has_a_worker_of_its_own() {
        let dev = tempfile::tempdir().unwrap();
        let mut board = board(dev.path());
        let mut bus = |chip: u32, channel: u32| {
            let folder = dev.path().join(format!("pwm/pwmchip{chip}/pwm{channel}"));
            std::fs::create_dir_all(&folder).unwrap();
            for name in ["period", "duty_cycle", "enable"] {
                std::fs::write(folder.join(name), "").unwrap();
            }
            let names = board.pins();
            let range = names.iter().find(|range| range.name == format!("pwmchip{chip}/pwm0")).unwrap();
            let pin = Pin(range.first + channel);
            let cycle = pinion_firmware::time::Ticks::from_us(100);
            let config = PwmConfig { pin, cycle, value: 0, shutdown_value: ShutdownValue::default() };
            board.pwm(config).unwrap().bus
        };
        assert_eq!((bus(0, 0), bus(0, 1), bus(1, 0)), ("pwmchip0".into(), "pwmchip0".into(), "pwmchip1".into()));
    }

    #[test]
    fn a_description_of_what_is_there() {
        let inventory = Inventory {
            chips: vec![gpio::Chip {
                number: 0,
                label: "pinctrl-bcm2835".into(),
                sleeps: false,
                lines: vec![gpio::LineInfo::default(); 54],
            }],
            adcs: vec![adc::IioDevice { number: 0, name: "ads1115".into(), label: None, channels: vec![] }],
            spi: vec![spi::Node::of(0), spi::Node::of(1)],
            i2c: vec![1],
            uarts: vec![uart::Uart {
                name: "ttyAMA1".into(),
                device: (204, 65),
                links: vec!["serial0".into()],
                is_console: false,
            }],
            ..Inventory::default()
        };
        assert_eq!(
            inventory.describe(),
            "linux: gpiochip0 pinctrl-bcm2835 (54 lines); iio ads1115 (0 channels); spidev0.0 \
             spidev0.1; i2c.1; ttyAMA1"
        );
    }
}
