// SPDX-License-Identifier: GPL-3.0-or-later
//! Simulated GPIO chips: the kernel's gpio-sim, created through configfs.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use super::sysfs;

const CONFIGFS: &str = "/sys/kernel/config/gpio-sim";

/// The properties of a chip.
pub struct Builder {
    label: String,
    line_count: u32,
    names: Vec<(u32, String)>,
    hogs: Vec<(u32, String)>,
}

impl Builder {
    /// Names a line.
    pub fn name(mut self, offset: u32, name: &str) -> Builder {
        self.names.push((offset, name.to_owned()));
        self
    }

    /// Makes the kernel hold a line as an input, for this consumer.
    pub fn hog(mut self, offset: u32, consumer: &str) -> Builder {
        self.hogs.push((offset, consumer.to_owned()));
        self
    }

    /// Brings the chip up.
    pub fn build(self) -> GpioSim {
        sysfs::assert_in_guest();
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        // A killed test leaves its chips to the next tests.
        let instance = format!("{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let config = Path::new(CONFIGFS).join(instance);
        let bank = config.join("bank");
        create(&bank);
        sysfs::write(bank.join("num_lines"), self.line_count.to_string());
        sysfs::write(bank.join("label"), &self.label);
        for (offset, name) in &self.names {
            let line = bank.join(format!("line{offset}"));
            create(&line);
            sysfs::write(line.join("name"), name);
        }
        for (offset, consumer) in &self.hogs {
            let hog = bank.join(format!("line{offset}/hog"));
            create(&hog);
            sysfs::write(hog.join("name"), consumer);
            sysfs::write(hog.join("direction"), "input");
        }
        sysfs::write(config.join("live"), "1");
        let chip_name = sysfs::read(bank.join("chip_name"));
        let device = sysfs::read(config.join("dev_name"));
        GpioSim {
            device: Path::new("/sys/devices/platform").join(device).join(&chip_name),
            label: self.label,
            chip_name,
            config,
        }
    }
}

/// A chip, seen from the hardware. It is removed when dropped.
pub struct GpioSim {
    config: PathBuf,
    device: PathBuf,
    label: String,
    chip_name: String,
}

impl GpioSim {
    /// A chip with this number of lines.
    pub fn builder(label: &str, line_count: u32) -> Builder {
        Builder { label: label.to_owned(), line_count, names: Vec::new(), hogs: Vec::new() }
    }

    /// A chip with unnamed lines.
    pub fn new(label: &str, line_count: u32) -> GpioSim {
        GpioSim::builder(label, line_count).build()
    }

    /// The chip's name, for example `gpiochip0`.
    pub fn chip_name(&self) -> &str {
        &self.chip_name
    }

    pub fn label(&self) -> &str {
        &self.label
    }

    /// The character device.
    pub fn path(&self) -> PathBuf {
        Path::new("/dev").join(&self.chip_name)
    }

    /// The level of the line, whatever drives it.
    pub fn level(&self, offset: u32) -> bool {
        sysfs::read(self.line(offset).join("value")) == "1"
    }

    /// Drives the line from outside, as a switch and a resistor would. An output line ignores it.
    pub fn pull(&self, offset: u32, up: bool) {
        sysfs::write(self.line(offset).join("pull"), if up { "pull-up" } else { "pull-down" });
    }

    /// The file that [`GpioSim::pull`] writes, for tests that must be faster.
    pub fn pull_file(&self, offset: u32) -> fs::File {
        let file = fs::OpenOptions::new().write(true).open(self.line(offset).join("pull"));
        file.unwrap_or_else(|error| panic!("{}'s pull: {error}", self.label))
    }

    /// The direction in which the line is pulled: by [`GpioSim::pull`], or by its own bias.
    pub fn is_pulled_up(&self, offset: u32) -> bool {
        sysfs::read(self.line(offset).join("pull")) == "pull-up"
    }

    /// Removes the chip while it is in use.
    pub fn unplug(&self) {
        sysfs::write(self.config.join("live"), "0");
    }

    /// The kernel's own number of the line, as in its traces.
    pub fn kernel_number(&self, offset: u32) -> u32 {
        // gpiochip0: GPIOs 504-511, parent: platform/gpio-sim.0, label:
        // (Not always on a separate line: a removed chip that was held stays, without its newline.)
        let chips = sysfs::read("/sys/kernel/debug/gpio");
        let rest = chips.split(&format!("{}: GPIOs ", self.chip_name)).nth(1).and_then(|rest| rest.split('-').next());
        let first: Option<u32> = rest.and_then(|first| first.parse().ok());
        first.unwrap_or_else(|| panic!("{} is not among these:\n{chips}", self.chip_name)) + offset
    }

    fn line(&self, offset: u32) -> PathBuf {
        self.device.join(format!("sim_gpio{offset}"))
    }
}

impl Drop for GpioSim {
    fn drop(&mut self) {
        // Not through helpers that panic: the test may be panicking already.
        let _ = fs::write(self.config.join("live"), "0");
        // Configfs folders are removed from the inside out.
        for folder in ["bank", ""] {
            let _ = remove_folders(&self.config.join(folder));
        }
    }
}

fn create(folder: &Path) {
    fs::create_dir_all(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
}

fn remove_folders(folder: &Path) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            remove_folders(&path)?;
        }
    }
    fs::remove_dir(folder)
}
