// SPDX-License-Identifier: GPL-3.0-or-later
//! SPI devices through the kernel's spidev driver.

#![forbid(unsafe_code)]

use std::fmt;
use std::fs;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use linux_embedded_hal::SpidevDevice;
use linux_embedded_hal::spidev::{SpiModeFlags, SpidevOptions, SpidevTransfer};

use super::gpio::not_permitted;
use pinion_firmware::board::{BusDevice, BusError, BusStatus, ChipSelect, Range};
use pinion_firmware::shutdown::{Shutdown, reason};

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
    /// The node of a bus number on the wire, which is the C program's.
    pub fn of(number: u32) -> Node {
        Node { bus: number >> 8, select: number & 0xff }
    }

    /// The number on the wire; none for a chip select above 255, which the number has no room for.
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

/// The dictionary's enumeration `spi_bus`: the C program's, and the nodes beyond it.
pub(super) fn ranges(nodes: &[Node]) -> Vec<Range> {
    let c_program = (0..BUSES).map(|bus| Range { name: format!("spidev{bus}.0"), first: bus << 8, count: BUS_NODES });
    let further = nodes
        .iter()
        .filter(|node| node.bus >= BUSES || node.select >= BUS_NODES)
        .filter_map(|node| Some(Range { name: node.to_string(), first: node.number()?, count: 1 }));
    c_program.chain(further).collect()
}

/// The longest transfer that the driver takes, which it tells as its parameter `bufsiz`.
pub(super) fn message_max() -> usize {
    let told = fs::read_to_string("/sys/module/spidev/parameters/bufsiz").ok();
    told.and_then(|text| text.trim().parse().ok()).unwrap_or(4096)
}

/// An open SPI device.
pub(super) struct Spi {
    device: SpidevDevice,
    node: Node,
    mode: u8,
    rate_hz: u32,
    chip_select: Option<ChipSelect>,
    /// The mode that the node is set to at present. Several chips may share a node, each selected by
    /// a GPIO line, and may need different modes; the kernel keeps only one for the node. As one
    /// worker speaks to all of them, the order of their accesses is clear.
    node_mode: Arc<AtomicU8>,
}

impl Spi {
    /// Opens a node and sets its rate and mode. All devices on the node share `node_mode`.
    ///
    /// # Errors
    ///
    /// "Unable to open spi device", "Unable to set SPI speed", "Unable to set SPI mode".
    pub(super) fn open(
        dev: &Path,
        node: Node,
        mode: u8,
        rate_hz: u32,
        chip_select: Option<ChipSelect>,
        node_mode: Arc<AtomicU8>,
    ) -> Result<Spi, Shutdown> {
        let path = dev.join(node.to_string());
        let device = SpidevDevice::open(&path).map_err(|error| {
            let detail = cannot_open(&path, error.inner(), &scan(dev));
            Shutdown::because(reason::SPI_OPEN, detail)
        })?;
        let mut spi = Spi { device, node, mode, rate_hz, chip_select, node_mode };
        spi.device.configure(SpidevOptions::new().max_speed_hz(rate_hz)).map_err(|error| {
            let detail = format!("/dev/{node} refuses {rate_hz} Hz: {error}: choose another spi_speed");
            Shutdown::because(reason::SPI_SPEED, detail)
        })?;
        spi.set_mode().map_err(|detail| Shutdown::because(reason::SPI_MODE, detail))?;
        Ok(spi)
    }

    /// Sets all mode bits of the node, as the C program does. That clears SPI_CS_HIGH, too, but the
    /// kernel itself keeps the polarity of a chip select that the device tree describes.
    fn set_mode(&mut self) -> Result<(), String> {
        let flags = SpiModeFlags::from_bits_retain(self.mode.into());
        self.device.configure(SpidevOptions::new().mode(flags)).map_err(|error| {
            format!(
                "/dev/{} refuses SPI mode {}: {error}: its controller can not serve this chip, choose another bus",
                self.node, self.mode
            )
        })?;
        self.node_mode.store(self.mode, Ordering::Relaxed);
        Ok(())
    }

    fn transfer(&mut self, bytes: &mut [u8]) -> Result<(), String> {
        if bytes.is_empty() {
            return Ok(());
        }
        if self.node_mode.load(Ordering::Relaxed) != self.mode {
            self.set_mode()?;
        }
        let count = bytes.len();
        let mut transfer = SpidevTransfer::read_write_in_place(bytes);
        transfer.speed_hz = self.rate_hz;
        transfer.bits_per_word = 8;
        self.device.transfer(&mut transfer).map_err(|error| {
            format!(
                "/dev/{} failed to transfer {count} bytes at {} Hz: {error}: look at the kernel's log (dmesg), try a \
                 lower spi_speed",
                self.node, self.rate_hz
            )
        })
    }

    fn select(&self, selected: bool) -> Result<(), String> {
        let chip_select = self.chip_select.as_ref();
        chip_select.map_or(Ok(()), |line| line.select(selected)).map_err(|failure| failure.detail.into())
    }
}

impl BusDevice for Spi {
    fn exchange(&mut self, bytes: &mut [u8]) -> Result<(), BusError> {
        let exchanged = self.select(true).and_then(|()| self.transfer(bytes));
        // A chip that stayed selected after a failure would disturb the next conversation.
        let deselected = self.select(false);
        exchanged.and(deselected).map_err(|detail| BusError { status: BusStatus::Nack, detail: detail.into() })
    }
}

fn cannot_open(path: &Path, error: &io::Error, nodes: &[Node]) -> String {
    match error.kind() {
        io::ErrorKind::NotFound => {
            let known: Vec<String> = nodes.iter().map(Node::to_string).collect();
            let known = match known.is_empty() {
                true => "this machine has no spidev node".to_owned(),
                false => format!("this machine has {}", known.join(", ")),
            };
            format!(
                "there is no {}: {known}: enable the bus (on a Raspberry Pi \"dtparam=spi=on\" in \
                 config.txt), or change spi_bus",
                path.display()
            )
        }
        io::ErrorKind::PermissionDenied => not_permitted(path),
        _ => format!("{} can not be opened: {error}: look at the kernel's log (dmesg)", path.display()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_firmware::board::{Direction, Line};
    use std::sync::Mutex;

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
        let node_mode = Arc::new(AtomicU8::new(0));
        Spi::open(dev, Node::of(0), 3, 1_000_000, chip_select, node_mode)
    }

    #[test]
    fn a_missing_node_lists_those_that_are_there() {
        let dev = tempfile::tempdir().unwrap();
        fs::write(dev.path().join("spidev1.2"), "").unwrap();
        let error = open(dev.path(), None).err().unwrap();
        assert_eq!(error.reason, reason::SPI_OPEN);
        assert!(error.to_string().contains("this machine has spidev1.2: enable"), "{error}");
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

    #[test]
    fn a_failed_transfer_still_deselects_the_chip() {
        let node = tempfile::NamedTempFile::new().unwrap();
        let line = Arc::new(Recorder(Mutex::default()));
        let mut spi = Spi {
            device: SpidevDevice::open(node.path()).unwrap(),
            node: Node::of(0),
            mode: 0,
            rate_hz: 1000,
            chip_select: Some(ChipSelect { line: line.clone(), active_high: false }),
            node_mode: Arc::new(AtomicU8::new(0)),
        };
        let error = spi.exchange(&mut [1, 2]).err().unwrap();
        assert_eq!(error.status, BusStatus::Nack);
        assert!(error.detail.contains("/dev/spidev0.0 failed to transfer 2 bytes"), "{error:?}");
        assert_eq!(*line.0.lock().unwrap(), [false, true]);
    }
}
