// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices through the kernel's spidev driver.

#![forbid(unsafe_code)]

use std::collections::HashMap;
use std::fmt;
use std::fs;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use linux_embedded_hal::spidev::{SpiModeFlags, Spidev, SpidevOptions, SpidevTransfer};

use crate::LOOK_AT_LOG;
use crate::gpio::not_permitted;
use pinion_firmware::board::{BusDevice, BusError, BusStatus, ChipSelect, Range, SpiConfig};
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::trouble::Trouble;

/// How many buses the C program has names for.
const BUSES: u32 = 8;
/// How many chip selects of each bus have names.
const BUS_NODES: u32 = 16;

/// A device node `/dev/spidev<bus>.<select>`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Node {
    /// The controller.
    pub bus: u32,
    /// Its chip select.
    pub select: u32,
}

impl Node {
    /// The node for a bus number on the wire. Klipper's C has the same numbers.
    pub fn of(number: u32) -> Node {
        Node { bus: number >> 8, select: number & 0xff }
    }

    /// The number on the wire. `None` for a chip select above 255: the number has no room for it.
    pub fn number(self) -> Option<u32> {
        let fits = self.select <= 0xff && self.bus <= u32::MAX >> 8;
        fits.then_some(self.bus << 8 | self.select)
    }

    fn parse(name: &str) -> Option<Node> {
        let (bus, select) = name.strip_prefix("spidev")?.split_once('.')?;
        Some(Node { bus: bus.parse().ok()?, select: select.parse().ok()? })
    }
}

impl fmt::Display for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "spidev{}.{}", self.bus, self.select)
    }
}

/// The nodes in `dev`, in order.
pub(super) fn scan(dev: &Path) -> Vec<Node> {
    let mut nodes: Vec<Node> = fs::read_dir(dev)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| Node::parse(entry.file_name().to_str()?))
        .collect();
    nodes.sort_unstable();
    nodes
}

/// The dictionary's enumeration `spi_bus`: the nodes of the C program, and the nodes beyond them.
pub(super) fn ranges(nodes: &[Node]) -> Vec<Range> {
    let c_program = (0..BUSES).map(|bus| Range { name: format!("spidev{bus}.0"), first: bus << 8, count: BUS_NODES });
    let further = nodes
        .iter()
        .filter(|node| node.bus >= BUSES || node.select >= BUS_NODES)
        .filter_map(|node| Some(Range { name: node.to_string(), first: node.number()?, count: 1 }));
    c_program.chain(further).collect()
}

/// The longest transfer that the driver accepts: its parameter `bufsiz`.
pub(super) fn message_max() -> usize {
    let read = fs::read_to_string("/sys/module/spidev/parameters/bufsiz").ok();
    read.and_then(|text| text.trim().parse().ok()).unwrap_or(4096)
}

/// SPI_CPOL of a mode: the clock idles high.
const CPOL: u32 = SpiModeFlags::SPI_CPOL.bits();
/// SPI_MOSI_IDLE_LOW of a mode: the data output is low between two messages. Few kernels and controllers support it.
const MOSI_IDLE_LOW: u32 = 1 << 17;

/// The shared state of one controller's chips. One worker makes the transfers of all of them, one
/// after the other.
#[derive(Default)]
pub(super) struct Controller {
    /// The current mode of each node, by its chip select. Chips with GPIO lines as chip selects may share a node and
    /// need different modes. The kernel keeps only one mode for the node.
    modes: HashMap<u32, u32>,
    /// The clock's level since the last transfer. `None`: unknown.
    idles_high: Option<bool>,
}

/// The operations of a node.
pub(super) trait SpiNode: Send {
    fn set_rate(&mut self, hz: u32) -> io::Result<()>;
    fn set_mode(&mut self, mode: u32) -> io::Result<()>;
    fn transfer(&mut self, rate_hz: u32, bytes: Bytes<'_>) -> io::Result<()>;
}

/// The bytes on the wires. Without a buffer for the reply, a controller with one data line also accepts them.
pub(super) enum Bytes<'a> {
    Exchanged(&'a mut [u8]),
    Sent(&'a [u8]),
}

impl Bytes<'_> {
    fn len(&self) -> usize {
        match self {
            Bytes::Exchanged(bytes) => bytes.len(),
            Bytes::Sent(bytes) => bytes.len(),
        }
    }
}

impl SpiNode for Spidev {
    fn set_rate(&mut self, hz: u32) -> io::Result<()> {
        self.configure(SpidevOptions::new().max_speed_hz(hz))
    }

    fn set_mode(&mut self, mode: u32) -> io::Result<()> {
        let flags = SpiModeFlags::from_bits_retain(mode);
        self.configure(SpidevOptions::new().mode(flags))
    }

    fn transfer(&mut self, rate_hz: u32, bytes: Bytes<'_>) -> io::Result<()> {
        let mut transfer = match bytes {
            Bytes::Exchanged(bytes) => SpidevTransfer::read_write_in_place(bytes),
            Bytes::Sent(bytes) => SpidevTransfer::write(bytes),
        };
        transfer.speed_hz = rate_hz;
        transfer.bits_per_word = 8;
        Spidev::transfer(self, &mut transfer)
    }
}

/// An open SPI device.
pub(super) struct Spi<N = Spidev> {
    device: N,
    node: Node,
    mode: u32,
    rate_hz: u32,
    chip_select: Option<ChipSelect>,
    controller: Arc<Mutex<Controller>>,
}

impl Spi {
    /// Opens a node and sets its rate and mode. All devices on its controller share `controller`.
    ///
    /// # Errors
    ///
    /// "Unable to open spi device", "Unable to set SPI speed", "Unable to set SPI mode".
    pub(super) fn open(dev: &Path, config: SpiConfig, controller: Arc<Mutex<Controller>>) -> Result<Spi, Shutdown> {
        let SpiConfig { bus, mode, rate_hz, chip_select } = config;
        let node = Node::of(bus);
        let path = dev.join(node.to_string());
        let device = Spidev::open(&path)
            .map_err(|error| Shutdown::because(reason::SPI_OPEN, cannot_open(&path, &error, &scan(dev))))?;
        let mut spi = Spi { device, node, mode: mode.into(), rate_hz, chip_select, controller };
        spi.device.set_rate(rate_hz).map_err(|error| {
            let cause = format!("/dev/{node} refuses {rate_hz} Hz: {error}");
            Shutdown::because(reason::SPI_SPEED, cause).remedy("choose another spi_speed")
        })?;
        spi.set_mode().map_err(|trouble| Shutdown::because(reason::SPI_MODE, trouble))?;
        Ok(spi)
    }

    /// The name of its worker.
    pub(super) fn worker(&self) -> String {
        format!("spi{}", self.node.bus)
    }
}

impl<N: SpiNode> Spi<N> {
    /// Keeps the data output low between two messages, if the controller can do that.
    pub(super) fn with_mosi_idle_low(mut self) -> Spi<N> {
        let plain = self.mode;
        self.mode |= MOSI_IDLE_LOW;
        if self.set_mode().is_err() {
            self.mode = plain;
        }
        self
    }

    fn controller(&self) -> MutexGuard<'_, Controller> {
        self.controller.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets all mode bits of the node, as the C program does. This also clears SPI_CS_HIGH. But the kernel itself keeps
    /// the polarity of a chip select that the device tree describes.
    fn set_mode(&mut self) -> Result<(), Trouble> {
        self.device.set_mode(self.mode).map_err(|error| {
            Trouble::new(format!(
                "/dev/{} refuses SPI mode {}: {error}: its controller cannot serve this chip",
                self.node, self.mode
            ))
            .remedy("choose another bus")
        })?;
        self.controller().modes.insert(self.node.select, self.mode);
        Ok(())
    }

    fn transfer(&mut self, bytes: Bytes<'_>) -> Result<(), Trouble> {
        let count = bytes.len();
        // A failed transfer may have moved the clock, or not.
        self.controller().idles_high = None;
        self.device.transfer(self.rate_hz, bytes).map_err(|error| {
            Trouble::new(format!("/dev/{} failed to transfer {count} bytes at {} Hz: {error}", self.node, self.rate_hz))
                .remedy("look at the kernel's log (dmesg), try a lower spi_speed")
        })?;
        self.controller().idles_high = Some(self.mode & CPOL != 0);
        Ok(())
    }

    /// Sets the node's mode, and puts the clock at its idle level, before a GPIO line selects the chip. A driver moves
    /// the clock only when a transfer begins (spi-bcm2835: in `prepare_message`). A chip that is already selected would
    /// count this as an edge. So a byte is first sent with no chip selected. If the controller itself selects the chip,
    /// the kernel takes care of this.
    fn prepare(&mut self) -> Result<(), Trouble> {
        let known = self.controller().modes.get(&self.node.select) == Some(&self.mode);
        if !known {
            self.set_mode()?;
        }
        let stands = self.controller().idles_high == Some(self.mode & CPOL != 0);
        if self.chip_select.is_none() || stands { Ok(()) } else { self.transfer(Bytes::Sent(&[0])) }
    }

    /// Drives the chip select line, if there is one.
    fn drive(&self, how: impl FnOnce(&ChipSelect) -> Result<(), Shutdown>) -> Result<(), Trouble> {
        self.chip_select.as_ref().map_or(Ok(()), how).map_err(Shutdown::into_trouble)
    }

    fn converse(&mut self, bytes: Bytes<'_>) -> Result<(), BusError> {
        let conversed = self.prepare().and_then(|()| match bytes.len() {
            0 => self.drive(ChipSelect::pulse),
            _ => {
                let transferred = self.drive(|line| line.select(true)).and_then(|()| self.transfer(bytes));
                // A chip that stayed selected after a failure would disturb the next transfer.
                let deselected = self.drive(|line| line.select(false));
                transferred.and(deselected)
            }
        });
        conversed.map_err(|trouble| BusError::new(BusStatus::Nack, trouble))
    }
}

impl<N: SpiNode> BusDevice for Spi<N> {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        self.converse(Bytes::Exchanged(bytes))
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.converse(Bytes::Sent(bytes))
    }
}

/// The driver of the node's controller, if it is known to have no DMA: its FIFO may run empty during a message.
pub(super) fn driver_without_dma(masters: &Path, node: Node) -> Option<String> {
    const WITHOUT_DMA: [&str; 2] = ["spi-bcm2835aux", "spi_gpio"];
    let driver = fs::read_link(masters.join(format!("spi{}/device/driver", node.bus))).ok()?;
    let driver = driver.file_name()?.to_str()?;
    WITHOUT_DMA.contains(&driver).then(|| driver.to_owned())
}

fn cannot_open(path: &Path, error: &io::Error, nodes: &[Node]) -> Trouble {
    let shown = path.display();
    match error.kind() {
        io::ErrorKind::NotFound => {
            let known: Vec<String> = nodes.iter().map(Node::to_string).collect();
            let known = match known.is_empty() {
                true => "this computer has no spidev node".to_owned(),
                false => format!("this computer has {}", known.join(", ")),
            };
            Trouble::new(format!("there is no {shown}: {known}"))
                .remedy("enable the bus (on a Raspberry Pi \"dtparam=spi=on\" in config.txt), or change spi_bus")
        }
        io::ErrorKind::PermissionDenied => not_permitted(path, error.raw_os_error().unwrap_or(libc::EACCES)),
        _ => Trouble::new(format!("{shown} cannot be opened: {error}")).remedy(LOOK_AT_LOG),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::board::{Direction, Line};
    use pinion_firmware::time::{Clock, TimeSource, VirtualClock};

    #[test]
    fn numbers_are_the_c_program_s() {
        assert_eq!(Node { bus: 1, select: 2 }.number(), Some(258));
        assert_eq!(Node::of(258), Node { bus: 1, select: 2 });
        assert_eq!(Node { bus: 0, select: 256 }.number(), None);
    }

    #[test]
    fn nodes_beyond_the_c_program_s_ranges_are_published() {
        let nodes = [Node { bus: 0, select: 0 }, Node { bus: 10, select: 0 }];
        let ranges = ranges(&nodes);
        assert_eq!(ranges.len(), 9);
        assert_eq!(ranges[8], Range { name: "spidev10.0".into(), first: 2560, count: 1 });
    }

    #[test]
    fn names_of_nodes() {
        assert_eq!(Node::parse("spidev10.1"), Some(Node { bus: 10, select: 1 }));
        for name in ["spidev", "spidev0", "spidev0.", "spidevx.0", "i2c-0"] {
            assert_eq!(Node::parse(name), None);
        }
    }

    fn open(dev: &Path, chip_select: Option<ChipSelect>) -> Result<Spi, Shutdown> {
        Spi::open(dev, SpiConfig { bus: 0, mode: 3, rate_hz: 1_000_000, chip_select }, Arc::default())
    }

    #[test]
    fn a_missing_node_lists_those_that_are_there() {
        let dev = tempfile::tempdir().unwrap();
        fs::write(dev.path().join("spidev1.2"), "").unwrap();
        let error = open(dev.path(), None).err().unwrap();
        assert_eq!(error.reason, reason::SPI_OPEN);
        assert!(error.to_string().contains("this computer has spidev1.2: enable"), "{error}");
    }

    #[test]
    fn a_node_that_is_no_spidev() {
        let dev = tempfile::tempdir().unwrap();
        fs::write(dev.path().join("spidev0.0"), "").unwrap();
        let error = open(dev.path(), None).err().unwrap();
        assert_eq!(error.reason, reason::SPI_SPEED);
        assert!(error.to_string().contains("/dev/spidev0.0 refuses 1000000 Hz"), "{error}");
    }

    struct Recorder(Mutex<Vec<bool>>);

    impl Line for Recorder {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            self.0.lock().unwrap().push(level);
            Ok(())
        }
        fn read(&self) -> Result<bool, Shutdown> {
            Ok(false)
        }
        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    fn clock() -> Arc<dyn TimeSource> {
        Arc::new(VirtualClock::at(Clock::EPOCH))
    }

    /// A controller like the one of spi-bcm2835, and the chip select lines. The clock moves only with a transfer.
    #[derive(Default)]
    struct Wires {
        clock: bool,
        /// The mode of each node.
        modes: HashMap<u32, u32>,
        /// The mode of each chip, by its chip select line, and whether this line is low.
        chips: HashMap<&'static str, (u32, bool)>,
        /// The edges that a chip saw while it was selected.
        seen: Vec<(&'static str, u32)>,
        /// How many bytes went over the wires, and whether there is only one data line.
        bytes: usize,
        half_duplex: bool,
        fails: bool,
        /// Bits of the mode that the controller refuses.
        refused: u32,
    }

    impl Wires {
        fn edges(&mut self, edges: u32) {
            let selected: Vec<_> = self.chips.iter().filter(|(_, (_, low))| *low).map(|(name, _)| *name).collect();
            self.seen.extend(selected.into_iter().filter(|_| edges > 0).map(|name| (name, edges)));
        }
    }

    #[derive(Clone)]
    struct FakeNode(u32, Arc<Mutex<Wires>>);

    impl SpiNode for FakeNode {
        fn set_rate(&mut self, _hz: u32) -> io::Result<()> {
            Ok(())
        }

        fn set_mode(&mut self, mode: u32) -> io::Result<()> {
            let mut wires = self.1.lock().unwrap();
            if mode & wires.refused != 0 {
                return Err(io::ErrorKind::InvalidInput.into());
            }
            wires.modes.insert(self.0, mode);
            Ok(())
        }

        fn transfer(&mut self, _rate_hz: u32, bytes: Bytes<'_>) -> io::Result<()> {
            let mut wires = self.1.lock().unwrap();
            if wires.half_duplex && matches!(bytes, Bytes::Exchanged(_)) {
                return Err(io::ErrorKind::InvalidInput.into());
            }
            let idle = wires.modes[&self.0] & CPOL != 0;
            let moved = std::mem::replace(&mut wires.clock, idle) != idle;
            if std::mem::take(&mut wires.fails) {
                return Err(io::ErrorKind::TimedOut.into());
            }
            wires.edges(u32::from(moved));
            wires.edges(16 * bytes.len() as u32);
            wires.bytes += bytes.len();
            Ok(())
        }
    }

    struct Select(&'static str, Arc<Mutex<Wires>>);

    impl Line for Select {
        fn write(&self, level: bool) -> Result<(), Shutdown> {
            let mut wires = self.1.lock().unwrap();
            let clock = wires.clock;
            let chip = wires.chips.get_mut(self.0).unwrap();
            chip.1 = !level;
            assert!(level || clock == (chip.0 & CPOL != 0), "{} is selected with the clock at its idle level", self.0);
            Ok(())
        }
        fn read(&self) -> Result<bool, Shutdown> {
            Ok(false)
        }
        fn set_direction(&self, _direction: Direction) -> Result<(), Shutdown> {
            Ok(())
        }
    }

    /// Chips with these names, nodes and modes, on one controller. The node selects a chip without a name.
    fn chips<const N: usize>(chips: [(&'static str, u32, u32); N]) -> (Arc<Mutex<Wires>>, [Spi<FakeNode>; N]) {
        let wires: Arc<Mutex<Wires>> = Arc::default();
        let controller: Arc<Mutex<Controller>> = Arc::default();
        let chips = chips.map(|(name, select, mode)| {
            wires.lock().unwrap().chips.insert(name, (mode, false));
            let line = Arc::new(Select(name, wires.clone()));
            let chip_select = ChipSelect { line, active_high: false, clock: clock() };
            let mut spi = Spi {
                device: FakeNode(select, wires.clone()),
                node: Node { bus: 0, select },
                mode,
                rate_hz: 1000,
                chip_select: (!name.is_empty()).then_some(chip_select),
                controller: controller.clone(),
            };
            spi.set_mode().unwrap();
            spi
        });
        (wires, chips)
    }

    #[test]
    fn the_clock_idles_at_a_chip_s_level_before_the_chip_is_selected() {
        // Two chips of one node and one of another node, all selected by lines, and one selected by its node.
        let all = [("a", 0, 0), ("b", 0, 3), ("c", 1, 2), ("", 2, 0)];
        for order in [[0, 1, 0, 2, 1], [1, 0, 3, 1, 2], [2, 3, 2, 1, 0], [3, 0, 1, 1, 3]] {
            let (wires, mut spis) = chips(all);
            for chip in order {
                wires.lock().unwrap().seen.clear();
                spis[chip].exchange(&mut [1, 2]).unwrap();
                let (name, ..) = all[chip];
                let expected = if name.is_empty() { vec![] } else { vec![(name, 32)] };
                assert_eq!(wires.lock().unwrap().seen, expected, "{order:?}: {name}");
            }
        }
    }

    #[test]
    fn a_byte_goes_to_nobody_only_where_the_clock_has_to_move() {
        let (wires, [mut low, mut high, mut other_high]) = chips([("a", 0, 0), ("b", 0, 3), ("c", 1, 2)]);
        let bytes = |spi: &mut Spi<FakeNode>| {
            spi.exchange(&mut [1, 2]).unwrap();
            std::mem::take(&mut wires.lock().unwrap().bytes)
        };
        // At the beginning the clock's level is unknown.
        assert_eq!((bytes(&mut low), bytes(&mut low)), (3, 2));
        assert_eq!((bytes(&mut high), bytes(&mut high), bytes(&mut other_high)), (3, 2, 2));
        assert_eq!((bytes(&mut high), bytes(&mut low)), (2, 3));
        // It is also unknown after a failure.
        wires.lock().unwrap().fails = true;
        assert!(high.exchange(&mut [1]).is_err());
        assert_eq!(bytes(&mut low), 3);
    }

    #[test]
    fn what_is_only_sent_goes_to_a_controller_of_one_data_line() {
        let (wires, [mut low, mut high]) = chips([("a", 0, 0), ("b", 0, 3)]);
        wires.lock().unwrap().half_duplex = true;
        low.send(&[1, 2]).unwrap();
        high.send(&[1, 2]).unwrap();
        assert_eq!(wires.lock().unwrap().seen, [("a", 32), ("b", 32)]);
        let error = low.exchange(&mut [1, 2]).err().unwrap();
        assert!(error.trouble.cause.contains("failed to transfer 2 bytes"), "{error:?}");
    }

    #[test]
    fn the_data_output_idles_low_where_the_controller_can_do_that() {
        for (refused, mode) in [(0, MOSI_IDLE_LOW), (MOSI_IDLE_LOW, 0)] {
            let (wires, [spi]) = chips([("", 0, 0)]);
            wires.lock().unwrap().refused = refused;
            let mut spi = spi.with_mosi_idle_low();
            assert_eq!(wires.lock().unwrap().modes[&0], mode);
            spi.send(&[1]).unwrap();
            assert_eq!(wires.lock().unwrap().modes[&0], mode);
        }
    }

    #[test]
    fn an_empty_exchange_selects_the_chip_for_a_microsecond_and_moves_no_clock() {
        let (wires, [mut spi]) = chips([("a", 0, 1)]);
        spi.exchange(&mut []).unwrap();
        assert_eq!(spi.chip_select.as_ref().unwrap().clock.now().since(Clock::EPOCH), 50);
        assert!(wires.lock().unwrap().seen.is_empty());
    }

    #[test]
    fn a_controller_without_dma_is_known_by_its_driver() {
        let masters = tempfile::tempdir().unwrap();
        for (bus, driver) in [(0, "spi-bcm2835"), (1, "spi-bcm2835aux")] {
            let device = masters.path().join(format!("spi{bus}/device"));
            fs::create_dir_all(&device).unwrap();
            std::os::unix::fs::symlink(format!("../../bus/platform/drivers/{driver}"), device.join("driver")).unwrap();
        }
        let driver = |bus| driver_without_dma(masters.path(), Node { bus, select: 0 });
        assert_eq!([0, 1, 2].map(driver), [None, Some("spi-bcm2835aux".into()), None]);
    }

    #[test]
    fn a_failed_transfer_still_deselects_the_chip() {
        let node = tempfile::NamedTempFile::new().unwrap();
        let line = Arc::new(Recorder(Mutex::default()));
        let mut spi = Spi {
            device: Spidev::open(node.path()).unwrap(),
            node: Node::of(0),
            mode: 0,
            rate_hz: 1000,
            chip_select: Some(ChipSelect { line: line.clone(), active_high: false, clock: clock() }),
            controller: Arc::new(Mutex::new(Controller { modes: [(0, 0)].into(), idles_high: Some(false) })),
        };
        let error = spi.exchange(&mut [1, 2]).err().unwrap();
        assert_eq!(error.status, BusStatus::Nack);
        assert!(error.trouble.cause.contains("/dev/spidev0.0 failed to transfer 2 bytes"), "{error:?}");
        assert_eq!(*line.0.lock().unwrap(), [false, true]);
    }
}
