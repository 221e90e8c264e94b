// SPDX-License-Identifier: GPL-3.0-or-later
//! Thermometers on 1-Wire buses, through the kernel's w1_therm.

#![forbid(unsafe_code)]

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use pinion_firmware::board::Thermometer;
use pinion_firmware::shutdown::{Shutdown, reason};
use pinion_firmware::trouble::Trouble;

/// The names of sensors in the DS18B20's family begin with this.
const FAMILY: &str = "28-";

/// The sensors in `devices`, in order.
pub(super) fn scan(devices: &Path) -> Vec<String> {
    let entries = fs::read_dir(devices).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut sensors: Vec<String> = names.filter(|name| name.starts_with(FAMILY)).collect();
    sensors.sort();
    sensors
}

/// A DS18B20.
#[derive(Debug)]
pub(super) struct Ds18b20 {
    file: PathBuf,
}

impl Ds18b20 {
    /// The sensor that the kernel calls `serial` in `devices`. A reading would take 750 ms, so this only checks whether
    /// the file can be opened.
    pub(super) fn open(devices: &Path, serial: &[u8]) -> Result<Ds18b20, Shutdown> {
        let file = devices.join(OsStr::from_bytes(serial)).join("w1_slave");
        match fs::File::open(&file) {
            Ok(_) => Ok(Ds18b20 { file }),
            Err(error) => Err(Shutdown::because(reason::DS18B20_OPEN, cannot_open(devices, &file, &error))),
        }
    }
}

impl Thermometer for Ds18b20 {
    fn read(&mut self) -> Result<i32, Trouble> {
        let path = self.file.display();
        // Opened each time, because a sensor that was unplugged and is back has a new file.
        let text = fs::read_to_string(&self.file).map_err(|error| {
            Trouble::new(format!("{path} cannot be read: {error}")).remedy("check that the sensor is plugged in")
        })?;
        parse(&text)
            .map_err(|what| Trouble::new(what).remedy("check the wires and the pull-up resistor (4.7 kOhm)").of(path))
    }
}

/// The temperature in thousandths of a degree, from a text like this
///
/// ```text
/// 31 00 4b 46 7f ff 0c 10 77 : crc=77 YES
/// 31 00 4b 46 7f ff 0c 10 77 t=3062
/// ```
///
/// The kernel checks the CRC. Zeros have a valid CRC, and a shorted bus reads as zeros.
fn parse(text: &str) -> Result<i32, &'static str> {
    let bytes = text.split(" : ").next().unwrap_or_default();
    if !text.contains("YES") {
        return Err("the sensor's answer has a wrong CRC");
    }
    if bytes.split_whitespace().all(|byte| byte == "00") {
        return Err("the sensor's answer is zeros only");
    }
    let value = text.rsplit_once("t=").and_then(|(_, value)| value.trim().parse().ok());
    value.ok_or("there is no temperature in the kernel's answer")
}

fn cannot_open(devices: &Path, file: &Path, error: &io::Error) -> Trouble {
    let path = file.display();
    if error.kind() != io::ErrorKind::NotFound {
        return Trouble::new(format!("{path} cannot be opened: {error}"))
            .remedy("look at its permissions and at the kernel's log (dmesg)");
    }
    let sensors = scan(devices);
    match sensors.is_empty() {
        true => Trouble::new(format!("there is no {path}: the kernel knows no DS18B20"))
            .remedy("enable the bus (on a Raspberry Pi \"dtoverlay=w1-gpio\" in config.txt) and check the wires"),
        false => Trouble::new(format!("there is no {path}: the kernel knows {}", sensors.join(", ")))
            .remedy("correct serial_no"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "31 00 4b 46 7f ff 0c 10 77 : crc=77 YES\n31 00 4b 46 7f ff 0c 10 77 t=3062\n";

    #[test]
    fn the_kernel_s_answers() {
        assert_eq!(parse(GOOD), Ok(3062));
        assert_eq!(parse(&GOOD.replace("t=3062", "t=-10250")), Ok(-10_250));
        assert_eq!(parse(&GOOD.replace("YES", "NO")), Err("the sensor's answer has a wrong CRC"));
        assert_eq!(parse(""), Err("the sensor's answer has a wrong CRC"));
        let zeros = "00 00 00 00 00 00 00 00 00 : crc=00 YES\n00 00 00 00 00 00 00 00 00 t=0\n";
        assert_eq!(parse(zeros), Err("the sensor's answer is zeros only"));
        for rest in ["", "t=", "t=warm"] {
            assert_eq!(parse(&GOOD.replace("t=3062", rest)), Err("there is no temperature in the kernel's answer"));
        }
    }

    fn with_sensor() -> tempfile::TempDir {
        let devices = tempfile::tempdir().unwrap();
        let folder = devices.path().join("28-00000000100f");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("w1_slave"), GOOD).unwrap();
        devices
    }

    #[test]
    fn a_sensor_is_read_whenever_it_is_there() {
        let devices = with_sensor();
        let mut sensor = Ds18b20::open(devices.path(), b"28-00000000100f").unwrap();
        assert_eq!(sensor.read(), Ok(3062));
        let folder = devices.path().join("28-00000000100f");
        fs::remove_dir_all(&folder).unwrap();
        let error = sensor.read().unwrap_err();
        assert!(error.cause.contains("28-00000000100f/w1_slave cannot be read: No such file"), "{error}");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("w1_slave"), GOOD.replace("3062", "4000")).unwrap();
        assert_eq!(sensor.read(), Ok(4000));
    }

    #[test]
    fn a_sensor_that_is_not_there() {
        let devices = with_sensor();
        let error = Ds18b20::open(devices.path(), b"28-1").unwrap_err();
        assert_eq!(error.reason, reason::DS18B20_OPEN);
        assert!(error.to_string().ends_with("the kernel knows 28-00000000100f: correct serial_no"), "{error}");
        let error = Ds18b20::open(&devices.path().join("none"), b"28-\xff").unwrap_err();
        assert!(error.to_string().contains("dtoverlay=w1-gpio"), "{error}");
    }
}
