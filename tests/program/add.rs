// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion add` from outside, on folders that look like the cards of boards.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::{MetadataExt, PermissionsExt, chown, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread;

use nix::sys::ptrace;
use nix::sys::wait::{WaitStatus, waitpid};
use nix::unistd::Pid;
use pinion_testkit::here;
use serde_json::Value;
use tempfile::TempDir;

use crate::process::{output, pinion_path};

pub(crate) const PRINTER: &str = "home/pi/printer_data/config/printer.cfg";
pub(crate) const PRINTER_CFG: &str = "# my printer\n[include mainsail.cfg]\n\n[printer]\nkinematics: corexy\n[stepper_x]\nposition_max: 300\n\
                           [stepper_y]\nposition_min: -5\nposition_max: 310\n\
                           #*# <---------------------- SAVE_CONFIG ---------------------->\n#*# [input_shaper]\n";
/// The config.txt of Raspberry Pi OS 12.
pub(crate) const CONFIG_TXT: &str = "\
# For more options and information see
# http://rptl.io/configtxt
# Some settings may impact device functionality. See link above for details

# Uncomment some or all of these to enable the optional hardware interfaces
#dtparam=i2c_arm=on
#dtparam=i2s=on
#dtparam=spi=on

# Enable audio (loads snd_bcm2835)
dtparam=audio=on

# Additional overlays and parameters are documented
# /boot/firmware/overlays/README

# Automatically load overlays for detected cameras
camera_auto_detect=1

# Automatically load overlays for detected DSI displays
display_auto_detect=1

# Automatically load initramfs files, if found
auto_initramfs=1

# Enable DRM VC4 V3D driver
dtoverlay=vc4-kms-v3d
max_framebuffers=2

# Don't have the firmware create an initial video= setting in cmdline.txt.
# Use the kernel's default instead.
disable_fw_kms_setup=1

# Run in 64-bit mode
arm_64bit=1

# Disable compensation for displays with overscan
disable_overscan=1

# Run as fast as firmware / board allows
arm_boost=1

[cm4]
# Enable host mode on the 2711 built-in XHCI USB controller.
# This line should be removed if the legacy DWC2 controller is required
# (e.g. for USB device mode) or if USB support is not required.
otg_mode=1

[cm5]
dtoverlay=dwc2,dr_mode=host

[all]
";
/// The file of BigTreeTech's image for the CB1.
const BOARD_ENV: &str = "bootlogo=true\noverlay_prefix=sun50i-h616\nfdtfile=sun50i-h616-biqu-sd\nconsole=display\n\
                         #overlays=tft35_spi\noverlays=ws2812 light\nrootdev=UUID=795df55f\nrootfstype=ext4\n";
/// The file of Armbian.
const ARMBIAN_ENV: &str =
    "verbosity=1\nbootlogo=false\nconsole=both\noverlay_prefix=PREFIX\nrootdev=UUID=88c29f81\nrootfstype=ext4\n";

/// A card with a board's system.
pub(crate) struct Card(pub(crate) TempDir);

impl Card {
    pub(crate) fn of(model: &str, files: &[(&str, &str)]) -> Card {
        let card = Card(tempfile::tempdir().unwrap());
        card.put("proc/device-tree/model", &format!("{model}\0"));
        card.put(PRINTER, PRINTER_CFG);
        card.put(&PRINTER.replace("printer.cfg", "mainsail.cfg"), "[virtual_sdcard]\npath: ~/gcodes\n");
        files.iter().for_each(|(path, text)| card.put(path, text));
        card
    }

    pub(crate) fn pi() -> Card {
        Card::of("Raspberry Pi 4 Model B Rev 1.4", &[("boot/firmware/config.txt", CONFIG_TXT)])
    }

    /// Another card with the same files.
    fn copy(&self) -> Card {
        let card = Card(tempfile::tempdir().unwrap());
        let copied = Command::new("cp").arg("-a").arg(self.0.path().join(".")).arg(card.0.path()).status();
        assert!(copied.unwrap().success());
        card
    }

    pub(crate) fn path(&self, path: &str) -> PathBuf {
        self.0.path().join(path)
    }

    pub(crate) fn put(&self, path: &str, text: &str) {
        let path = self.path(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    pub(crate) fn read(&self, path: &str) -> String {
        fs::read_to_string(self.path(path)).unwrap()
    }

    fn arguments(&self, args: &[&str]) -> Vec<String> {
        let root = self.0.path().to_str().unwrap().to_owned();
        ["add".to_owned()]
            .into_iter()
            .chain(args.iter().map(|arg| (*arg).to_owned()))
            .chain(["--root".to_owned(), root])
            .collect()
    }

    pub(crate) fn add(&self, args: &[&str]) -> Output {
        let arguments = self.arguments(args);
        output(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
    }

    #[track_caller]
    pub(crate) fn added(&self, args: &[&str]) -> String {
        let output = self.add(args);
        let (out, log) =
            (String::from_utf8(output.stdout).unwrap(), String::from_utf8_lossy(&output.stderr).into_owned());
        assert_eq!(output.status.code(), Some(0), "{out}{log}");
        out
    }

    #[track_caller]
    pub(crate) fn refused(&self, args: &[&str]) -> String {
        let output = self.add(args);
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    }

    /// All files, with their bytes and modes, and the folders.
    pub(crate) fn snapshot(&self) -> Vec<(PathBuf, Vec<u8>, u32)> {
        let mut found = Vec::new();
        let mut folders = vec![self.0.path().to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let about = fs::symlink_metadata(&path).unwrap();
                if about.is_dir() {
                    folders.push(path.clone());
                }
                let bytes = if about.is_file() { fs::read(&path).unwrap() } else { Vec::new() };
                found.push((path.strip_prefix(self.0.path()).unwrap().to_owned(), bytes, about.mode()));
            }
        }
        found.sort();
        found
    }
}

#[test]
fn each_board_gets_its_own_line_and_back() {
    let dtbo = |name: &'static str| (name, "");
    let armbian = |prefix: &str| ARMBIAN_ENV.replace("PREFIX", prefix);
    let (h616, h6, rk35) = (armbian("sun50i-h616"), armbian("sun50i-h6"), armbian("rk35xx"));
    let pi = |file: &'static str| vec![(file, CONFIG_TXT)];
    for (model, files, file, line, node) in [
        ("Raspberry Pi 2 Model B Rev 1.1", pi("boot/config.txt"), "boot/config.txt", "dtparam=spi=on", "spidev0.0"),
        (
            "Raspberry Pi 3 Model B Plus Rev 1.3",
            pi("boot/firmware/config.txt"),
            "boot/firmware/config.txt",
            "dtparam=spi=on",
            "spidev0.0",
        ),
        (
            "Raspberry Pi Zero 2 W Rev 1.0",
            pi("boot/firmware/config.txt"),
            "boot/firmware/config.txt",
            "dtparam=spi=on",
            "spidev0.0",
        ),
        (
            "Raspberry Pi 4 Model B Rev 1.4",
            pi("boot/firmware/config.txt"),
            "boot/firmware/config.txt",
            "dtparam=spi=on",
            "spidev0.0",
        ),
        (
            "Raspberry Pi 5 Model B Rev 1.0",
            pi("boot/firmware/config.txt"),
            "boot/firmware/config.txt",
            "dtparam=spi=on",
            "spidev0.0",
        ),
        (
            "BigTreeTech CB1",
            vec![("boot/BoardEnv.txt", BOARD_ENV), dtbo("boot/dtb/allwinner/overlay/sun50i-h616-spidev1_1.dtbo")],
            "boot/BoardEnv.txt",
            "overlays=ws2812 light spidev1_1",
            "spidev1.1",
        ),
        (
            "BigTreeTech CB1",
            vec![
                ("boot/BoardEnv.txt", BOARD_ENV),
                ("boot/system.cfg", "BTT_PAD7=\"ON\"\n"),
                dtbo("boot/dtb/allwinner/overlay/sun50i-h616-spidev1_1.dtbo"),
            ],
            "boot/BoardEnv.txt",
            "overlays=ws2812 light spidev1_1",
            "spidev1.1",
        ),
        (
            "OrangePi Zero3",
            vec![("boot/armbianEnv.txt", &*h616), dtbo("boot/dtb/allwinner/overlay/sun50i-h616-spidev1_1.dtbo")],
            "boot/armbianEnv.txt",
            "overlays=spidev1_1",
            "spidev1.1",
        ),
        (
            "OrangePi 3 LTS",
            vec![("boot/armbianEnv.txt", &*h6), dtbo("boot/dtb/allwinner/overlay/sun50i-h6-spi-spidev.dtbo")],
            "boot/armbianEnv.txt",
            "param_spidev_spi_bus=1",
            "spidev1.0",
        ),
        (
            "Radxa ZERO 3W",
            vec![("boot/armbianEnv.txt", &*rk35), dtbo("boot/dtb/rockchip/overlay/rk3568-spi3-m1-cs0-spidev.dtbo")],
            "boot/armbianEnv.txt",
            "overlays=rk3568-spi3-m1-cs0-spidev",
            "spidev3.0",
        ),
    ] {
        let card = Card::of(model, &files);
        let before = card.snapshot();
        let shown = card.added(&["adxl345", "--dry-run"]);
        assert_eq!(card.snapshot(), before, "{model}: --dry-run");
        assert!(shown.contains(&format!("\n+ {line}\n")) && shown.contains("SDA"), "{shown}");
        card.added(&["adxl345", "--yes"]);
        assert!(card.read(file).lines().any(|own| own == line), "{model}: {}", card.read(file));
        let own = card.read(&PRINTER.replace("printer.cfg", "pinion/adxl345.cfg"));
        assert!(own.contains(&format!("[adxl345]\ncs_pin: host:None\nspi_bus: {node}\n")), "{own}");
        let tester = card.read(&PRINTER.replace("printer.cfg", "pinion/resonance_tester.cfg"));
        assert!(
            tester.ends_with(
                "accel_chip: adxl345\n# The middle of the bed, and 20 mm above it\nprobe_points: 150, 155, 20\n"
            ),
            "{tester}"
        );
        assert!(
            card.read(PRINTER).starts_with(
                "# my printer\n[include mainsail.cfg]\n[include pinion/*.cfg] # by pinion add\n\n[printer]"
            )
        );
        assert_eq!(card.read(&format!("{PRINTER}.before-pinion")), PRINTER_CFG);
        let once = card.snapshot();
        let printed = card.added(&["adxl345", "--yes"]);
        assert_eq!(card.snapshot(), once, "{model}: twice");
        assert!(printed.contains("Nothing is left to change."), "{printed}");
        card.added(&["adxl345", "--undo", "--yes"]);
        assert_eq!(card.snapshot(), before, "{model}: --undo");
    }
}

/// All devices after each other, and back in another order.
#[test]
fn all_devices_of_a_board_and_back() {
    let card = Card::pi();
    fs::set_permissions(card.path(PRINTER), fs::Permissions::from_mode(0o640)).unwrap();
    card.put("sys/bus/w1/devices/28-0316a4f1ff27/w1_slave", "");
    card.put("etc/modules-load.d/cups-filters.conf", "lp\n");
    let before = card.snapshot();
    let list: Value = serde_json::from_slice(&card.add(&["--json"]).stdout).unwrap();
    let devices = list["devices"].as_array().unwrap().iter().filter(|device| device["fits"] == true);
    let devices: Vec<&str> = devices.map(|device| device["name"].as_str().unwrap()).collect();
    assert_eq!(devices.len(), 28);
    let mut added = Vec::new();
    for device in &devices {
        // Not all of them have room beside each other.
        if card.add(&[device, "--yes"]).status.success() {
            added.push(*device);
        }
    }
    assert!(added.len() >= 17, "{added:?}");
    let relay = card.read(&PRINTER.replace("printer.cfg", "pinion/relay.cfg"));
    let light = card.read(&PRINTER.replace("printer.cfg", "pinion/light.cfg"));
    let pin = |text: &str| text.lines().find(|line| line.starts_with("pin: ")).unwrap().to_owned();
    assert_ne!(pin(&relay), pin(&light));
    assert_eq!(card.read("boot/firmware/config.txt").matches("dtparam=spi=on").count(), 2, "one of them is a comment");
    let (even, odd): (Vec<_>, Vec<_>) = added.iter().enumerate().partition(|(number, _)| number % 2 == 0);
    for (_, device) in even.into_iter().chain(odd) {
        card.added(&[device, "--undo", "--yes"]);
    }
    assert_eq!(card.snapshot(), before);
}

/// An accelerometer that has both buses goes where there is room, and stays there.
#[test]
fn a_chip_with_two_buses_takes_the_free_one() {
    let card = Card::pi();
    card.added(&["adxl345", "--yes"]);
    card.added(&["lis3dh", "--yes"]);
    let printed = card.added(&["lis2dw", "--yes"]);
    assert!(printed.contains("by [adxl345] (") && printed.contains("): so it is connected by I2C."), "{printed}");
    let file = PRINTER.replace("printer.cfg", "pinion/lis2dw.cfg");
    assert!(card.read(&file).contains("\ni2c_bus: i2c.1\n"), "{}", card.read(&file));
    assert!(card.read("boot/firmware/config.txt").contains("\ndtparam=i2c_arm=on\n"));
    assert!(card.refused(&["bmi160", "--bus", "spi", "--yes"]).contains("spidev0.0 is used by [adxl345] ("));
    // The other place is free again, and the wires are made already.
    card.added(&["lis3dh", "--undo", "--yes"]);
    let before = card.snapshot();
    let printed = card.added(&["lis2dw", "--yes"]);
    assert!(printed.contains("by I2C\n") && printed.contains("Nothing is left to change."), "{printed}");
    assert_eq!(card.snapshot(), before);
}

/// The same where a section without a bus has a pin of it.
#[test]
fn a_chip_with_two_buses_avoids_a_pin_that_is_in_use() {
    let card = Card::pi();
    card.put(
        PRINTER,
        &(card.read(PRINTER) + "\n[mcu host]\nserial: /tmp/klipper_host_mcu\n[output_pin x]\npin: host:gpio10\n"),
    );
    let told = card.added(&["lis2dw", "--yes"]);
    let conflict = format!("GPIO10 (pin 19) is used by [output_pin x] (/{PRINTER}:17): so it is connected by I2C.");
    assert!(told.contains(&conflict), "{told}");
    assert!(card.refused(&["adxl345", "--yes"]).contains("GPIO10 (pin 19) is used by [output_pin x]"));
}

#[test]
fn programs_get_the_same_as_json() {
    let card = Card::pi();
    let value: Value = serde_json::from_slice(&card.add(&["adxl345", "--json", "--yes"]).stdout).unwrap();
    assert_eq!(value["device"], "adxl345");
    assert_eq!(value["board"], "Raspberry Pi 4");
    assert_eq!(value["wires"][2]["pin"], 24);
    let files: Vec<&str> =
        value["changes"].as_array().unwrap().iter().map(|change| change["file"].as_str().unwrap()).collect();
    assert_eq!(files[0], "/boot/firmware/config.txt");
    assert_eq!(files.len(), 5);
    assert!(value["error"].is_null() && value["next"][0] == "ACCELEROMETER_QUERY");
    // Nobody can be asked.
    let output = card.add(&["relay", "--json"]);
    let value: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(value["error"].as_str().unwrap().contains("use --yes"));
    assert_eq!(output.status.code(), Some(1));
}

#[test]
fn a_picture_of_the_wires() {
    let card = Card::pi();
    let picture = card.path("wires.svg");
    card.added(&["lis2dw", "--bus", "I2C", "--dry-run", "--picture", picture.to_str().unwrap()]);
    let svg = fs::read_to_string(picture).unwrap();
    let document = roxmltree::Document::parse(&svg).unwrap();
    assert_eq!(document.descendants().filter(|node| node.has_tag_name("path")).count(), 4);
    let shown = card.added(&["relay", "--pin", "40", "--dry-run"]);
    assert!(shown.contains("pin 40") && shown.contains("+ pin: host:GPIO21"), "{shown}");
    assert!(
        card.refused(&["relay", "--pin", "1", "--dry-run"])
            .contains("--pin: this pin has no free line: choose one of 11 (GPIO17), ")
    );
    assert!(card.refused(&["relay", "--bus", "spi"]).contains("--bus: relay is connected by GPIO lines"));
    assert!(card.refused(&["adxl354"]).contains("did you mean adxl345?"));
}

#[test]
fn the_user_of_an_unknown_board_reads_what_to_look_up() {
    for model in ["Pine64+", "", "\u{1b}[2J\u{202e}Raspberry\nPi 4", &"x".repeat(100_000)] {
        let card = Card::of(model, &[]);
        let before = card.snapshot();
        let list = card.added(&[]);
        assert!(list.contains("look up in its manual") && list.contains("adxl345"), "{list}");
        assert!(!list.contains(['\u{1b}', '\u{202e}']));
        assert!(card.refused(&["adxl345", "--yes"]).contains("look up in its manual which pins have SPI"));
        assert_eq!(card.snapshot(), before);
    }
    let card = Card::of("BigTreeTech CB1", &[("boot/BoardEnv.txt", BOARD_ENV)]);
    assert!(card.refused(&["adxl345", "--yes"]).contains("this image has no overlay for spidev1.1"));
    assert!(card.refused(&["bme280", "--yes"]).contains("Pinion knows no I2C on the header of a BigTreeTech CB1"));
    let card = Card::of("Raspberry Pi 4 Model B", &[]);
    assert!(card.refused(&["adxl345", "--yes"]).contains("there is no /boot/firmware/config.txt nor /boot/config.txt"));
}

#[test]
fn nothing_is_written_through_links_or_outside() {
    let card = Card::pi();
    card.put("etc/shadow", "secret\n");
    let elsewhere = card.path("etc/shadow");
    // The second one leads to the card's own file.
    let links = [PRINTER, "boot/firmware/config.txt"].into_iter();
    for (link, target) in links.flat_map(|link| [(link, elsewhere.as_path()), (link, Path::new("/etc/shadow"))]) {
        let path = card.path(link);
        let text = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        symlink(target, &path).unwrap();
        let before = card.snapshot();
        let log = card.refused(&["adxl345", "--yes", "--config", &format!("/{PRINTER}")]);
        assert!(log.contains("it is a link") || target == elsewhere && log.contains("there is no /boot"), "{log}");
        assert_eq!(card.snapshot(), before);
        fs::remove_file(&path).unwrap();
        fs::write(&path, text).unwrap();
    }
    // A link in the place of the folder of the devices: files go where the user has it, not through a file's link.
    let folder = PRINTER.replace("printer.cfg", "pinion");
    fs::create_dir(card.path(&folder)).unwrap();
    symlink(&elsewhere, card.path(&format!("{folder}/adxl345.cfg"))).unwrap();
    assert!(card.add(&["adxl345", "--yes"]).status.code() == Some(1));
    assert_eq!(card.read("etc/shadow"), "secret\n");
}

/// root's call. The rights are those of the whole process, so no unit test takes them.
#[test]
fn files_beside_printer_cfg_are_its_owner_s_and_written_with_their_rights() {
    if !here::is_root() {
        return;
    }
    let nobody = 65534;
    let card = Card::pi();
    fs::set_permissions(card.path(""), fs::Permissions::from_mode(0o755)).unwrap();
    let config = Path::new(PRINTER).parent().unwrap().to_str().unwrap();
    for path in ["home/pi", "home/pi/printer_data", config, PRINTER] {
        chown(card.path(path), Some(nobody), Some(nobody)).unwrap();
    }
    let before = card.snapshot();
    card.added(&["adxl345", "--yes"]);
    let owner = |path: &str| {
        let about = fs::symlink_metadata(card.path(path)).unwrap();
        (about.uid(), about.gid())
    };
    for name in ["printer.cfg", "printer.cfg.before-pinion", "pinion", "pinion/adxl345.cfg", "pinion/host-mcu.cfg"] {
        assert_eq!(owner(&format!("{config}/{name}")), (nobody, nobody), "{name}");
    }
    assert_eq!(owner("boot/firmware/config.txt"), (0, 0));
    card.added(&["adxl345", "--undo", "--yes"]);
    assert_eq!(card.snapshot(), before);
    // Whatever the owner puts in the way: root's folder is not theirs to write to.
    card.put("root/kept", "root's\n");
    symlink(card.path("root"), card.path(&format!("{config}/pinion"))).unwrap();
    let log = card.refused(&["relay", "--yes"]);
    assert!(log.contains("ermission denied"), "{log}");
    assert_eq!(fs::read_dir(card.path("root")).unwrap().count(), 1);
    // Nor are the files that a link of theirs names read with root's rights.
    fs::remove_file(card.path(&format!("{config}/pinion"))).unwrap();
    fs::set_permissions(card.path("root/kept"), fs::Permissions::from_mode(0o600)).unwrap();
    card.put(PRINTER, &format!("[include stolen.cfg]\n{PRINTER_CFG}"));
    symlink("/root/kept", card.path(&format!("{config}/stolen.cfg"))).unwrap();
    let log = card.refused(&["relay", "--yes"]);
    assert!(log.contains("ermission denied") && !log.contains("root's"), "{log}");
    assert_eq!(card.read("root/kept"), "root's\n");
}

#[test]
fn the_wires_are_those_of_the_board_s_settings() {
    let card = Card::pi();
    card.put("sys/bus/w1/devices/28-0316a4f1ff27/w1_slave", "");
    card.put("boot/firmware/config.txt", "dtoverlay=w1-gpio,gpiopin=27\n");
    let value: Value = serde_json::from_slice(&card.add(&["ds18b20", "--json", "--dry-run"]).stdout).unwrap();
    assert_eq!(value["wires"][2]["pin"], 13, "{value}");
    card.put("boot/firmware/config.txt", "dtoverlay=w1-gpio,gpiopin=40\n");
    let shown = card.added(&["ds18b20", "--dry-run"]);
    assert!(shown.contains("DQ (yellow)  pin 7"), "line 40 is not on the header: {shown}");
    // All kernels of a Raspberry Pi 5 know this name of the line.
    let card = Card::of("Raspberry Pi 5 Model B Rev 1.0", &[("boot/firmware/config.txt", CONFIG_TXT)]);
    card.put(PRINTER, &format!("{PRINTER_CFG}[mcu]\nserial: /tmp/klipper_host_mcu\n[fan]\npin: GPIO17\n"));
    assert!(card.added(&["relay", "--dry-run"]).contains("+ pin: mcu:pinctrl-rp1/gpio27"), "GPIO17 is taken");
    // Up to the Raspberry Pi 3 the audio output has the channels of the hardware PWM.
    let card = Card::of("Raspberry Pi 3 Model B Rev 1.2", &[("boot/firmware/config.txt", CONFIG_TXT)]);
    let shown = card.added(&["fan", "--dry-run"]);
    assert!(shown.contains("\n+ dtoverlay=pwm-2chan\n") && shown.contains("\n+ dtparam=audio=off\n"), "{shown}");
}

/// Line ends that editors of other systems write.
#[test]
fn ends_of_lines_stay_as_they_are() {
    for config_txt in ["dtparam=audio=on", "dtparam=audio=on\r\n[pi4]\r\nx=y", "dtparam=audio=on\r\n", "", "\n\n"] {
        for printer_cfg in [PRINTER_CFG.replace('\n', "\r\n"), PRINTER_CFG.trim_end().to_owned(), String::new()] {
            let card = Card::of(
                "Raspberry Pi 4 Model B",
                &[("boot/firmware/config.txt", config_txt), (PRINTER, &printer_cfg)],
            );
            let before = card.snapshot();
            card.added(&["adxl345", "--yes"]);
            for (path, old) in [("boot/firmware/config.txt", config_txt), (PRINTER, &*printer_cfg)] {
                let text = card.read(path);
                let (all, crlf) = (text.matches('\n').count(), text.matches("\r\n").count());
                let has_crlf = old.contains("\r\n");
                assert_eq!(crlf, if has_crlf { all } else { 0 }, "{text:?}");
            }
            assert!(card.read("boot/firmware/config.txt").lines().any(|line| line == "dtparam=spi=on"));
            card.added(&["adxl345", "--yes", "--undo"]);
            assert_eq!(card.snapshot(), before);
            assert!(!card.path("boot/firmware/config.txt.before-pinion").exists());
        }
    }
}

/// The first device has ended the last line, and the second one has written behind it.
#[test]
fn a_device_that_goes_leaves_the_lines_of_the_next_one() {
    let card = Card::of("Raspberry Pi 4 Model B", &[("boot/firmware/config.txt", "arm_boost=1")]);
    card.added(&["adxl345", "--yes"]);
    card.added(&["bme280", "--yes"]);
    card.added(&["adxl345", "--yes", "--undo"]);
    let config_txt = card.read("boot/firmware/config.txt");
    assert_eq!(config_txt, "arm_boost=1\n# pinion add bme280\n[all]\ndtparam=i2c_arm=on\n");
    card.added(&["bme280", "--yes", "--undo"]);
    assert_eq!(card.read("boot/firmware/config.txt"), "arm_boost=1", "byte for byte, from the copy");
}

/// All orders in which devices can go. The lines that other devices need stay. At the end all files are as before.
#[test]
fn a_device_that_goes_takes_nothing_from_the_others() {
    let armbian = ARMBIAN_ENV.replace("PREFIX", "sun50i-h616");
    let with_overlays = format!("{armbian}overlays=ws2812 light\n");
    let card_with = |env: &str| {
        if env.is_empty() {
            return Card::pi();
        }
        let overlay = |name: &str| format!("boot/dtb/allwinner/overlay/sun50i-h616-{name}.dtbo");
        let (spi, i2c) = (overlay("spidev1_1"), overlay("i2c3-ph"));
        Card::of("OrangePi Zero3", &[("boot/armbianEnv.txt", env), (&*spi, ""), (&*i2c, "")])
    };
    let kinds: [(&str, [&[&str]; 3]); 4] = [
        ("", [&["adxl345"], &["lis2dw"], &["bme280"]]),
        // The second one needs a faster bus than the first one.
        ("", [&["bme280"], &["lis2dw", "--bus", "i2c"], &["ssd1306"]]),
        (&armbian, [&["adxl345"], &["bme280"], &["sht"]]),
        (&with_overlays, [&["sht"], &["adxl345"], &["bme280"]]),
    ];
    for (env, devices) in kinds {
        let card = card_with(env);
        card.put("etc/modules-load.d/cups-filters.conf", "lp\n");
        let before = card.snapshot();
        devices.iter().for_each(|device| drop(card.added(&[*device, &["--yes"]].concat())));
        // Cards, and the devices on them.
        let mut cards = vec![(card, devices.to_vec())];
        while let Some((card, devices)) = cards.pop() {
            if devices.is_empty() {
                assert_eq!(card.snapshot(), before);
            }
            for gone in 0..devices.len() {
                let card = card.copy();
                let mut left = devices.clone();
                let gone = left.remove(gone)[0];
                let printed = card.added(&[gone, "--undo", "--yes"]);
                let now = card.snapshot();
                for device in &left {
                    let again = card.added(&[*device, &["--yes"]].concat());
                    assert!(again.contains("Nothing is left to change."), "{devices:?} {gone}: {printed}{again}");
                    assert_eq!(card.snapshot(), now, "{devices:?}: {gone} goes, {device:?} stays");
                }
                cards.push((card, left));
            }
        }
    }
}

/// pinion add did not write its section.
#[test]
fn a_bus_that_a_section_of_the_user_needs_stays() {
    let card = Card::pi();
    let before = card.snapshot();
    card.added(&["adxl345", "--yes"]);
    let printer_cfg = card.read(PRINTER);
    card.put(PRINTER, &format!("{printer_cfg}\n[lis2dw bed]\ncs_pin: host:None\nspi_bus: spidev0.1\n"));
    let printed = card.added(&["adxl345", "--undo", "--yes"]);
    let keeps = format!("/boot/firmware/config.txt keeps \"dtparam=spi=on\": [lis2dw bed] (/{PRINTER}) still needs it");
    assert!(printed.contains(&keeps), "{printed}");
    assert!(card.read("boot/firmware/config.txt").contains("\ndtparam=spi=on\n"));
    card.put(PRINTER, PRINTER_CFG);
    card.added(&["adxl345", "--undo", "--yes"]);
    assert_eq!(card.snapshot(), before);
}

#[test]
fn a_printer_cfg_that_may_not_be_changed_stays() {
    let card = Card::pi();
    fs::set_permissions(card.path(PRINTER), fs::Permissions::from_mode(0o444)).unwrap();
    let log = card.refused(&["relay", "--yes"]);
    let file = card.path(PRINTER);
    assert!(
        log.contains(&format!("/{PRINTER} is read-only: chmod u+w {}, then run this command again", file.display())),
        "{log}"
    );
    assert_eq!(card.read(PRINTER), PRINTER_CFG);
    assert!(!card.path(&PRINTER.replace("printer.cfg", "pinion")).exists());
    fs::set_permissions(card.path(PRINTER), fs::Permissions::from_mode(0o644)).unwrap();
    card.added(&["relay", "--yes"]);
    // Two users have a printer.
    card.put("home/other/printer_data/config/printer.cfg", "[printer]\n");
    let log = card.refused(&["light", "--yes"]);
    assert!(log.contains("there are several hosts, with /home/other/printer_data/config/printer.cfg and"), "{log}");
    card.added(&["light", "--yes", "--config", "/home/other/printer_data/config/printer.cfg"]);
    assert!(
        !card.read(PRINTER).contains("light") && card.path("home/other/printer_data/config/pinion/light.cfg").exists()
    );
}

/// A write to a disk without room: the kernel refuses it.
#[test]
fn a_full_disk_leaves_the_old_files() {
    let card = Card::pi();
    let before = card.snapshot();
    let full = Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f 0; exec \"$0\" \"$@\" 2>&1 | cat"])
        .arg(pinion_path())
        .args(card.arguments(&["adxl345", "--yes"]))
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&full.stdout);
    assert!(printed.contains("/boot/firmware/config.txt.before-pinion: File too large"), "{printed}");
    assert_eq!(card.snapshot(), before);
    card.added(&["adxl345", "--yes"]);
    card.added(&["adxl345", "--undo", "--yes"]);
    assert_eq!(card.snapshot(), before);
}

/// System calls that write, rename and remove.
const CHANGES: [i64; 5] =
    [libc::SYS_write, libc::SYS_renameat, libc::SYS_renameat2, libc::SYS_unlinkat, libc::SYS_ftruncate];
/// The same, on older architectures only.
#[cfg(target_arch = "x86_64")]
const OLD_CHANGES: [i64; 2] = [libc::SYS_rename, libc::SYS_unlink];
#[cfg(not(target_arch = "x86_64"))]
const OLD_CHANGES: [i64; 0] = [];

/// Runs `pinion`, and stops it before each of its changes for a look at them.
#[allow(clippy::zombie_processes)]
fn before_each_change(arguments: &[String], mut look: impl FnMut()) {
    // It begins when it is traced.
    let mut begin = Command::new("sh");
    begin.args(["-c", "read begin; exec \"$@\"", "sh"]).arg(pinion_path()).args(arguments);
    begin.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut child = begin.spawn().unwrap();
    let pid = Pid::from_raw(child.id().cast_signed());
    ptrace::seize(pid, ptrace::Options::PTRACE_O_TRACESYSGOOD | ptrace::Options::PTRACE_O_EXITKILL).unwrap();
    ptrace::interrupt(pid).unwrap();
    child.stdin.take().unwrap().write_all(b"begin\n").unwrap();
    let mut is_inside = false;
    loop {
        let signal = match waitpid(pid, None).unwrap() {
            WaitStatus::Exited(_, code) => return assert_eq!(code, 0),
            WaitStatus::PtraceSyscall(_) => {
                is_inside = !is_inside;
                let call = fs::read_to_string(format!("/proc/{pid}/syscall")).unwrap();
                let mut fields = call.split(' ');
                let number = fields.next().and_then(|number| number.parse().ok()).unwrap_or(-1);
                let is_change = CHANGES.contains(&number) || OLD_CHANGES.contains(&number);
                // Its own output changes no file.
                if is_inside && is_change && !matches!(fields.next(), Some("0x1" | "0x2")) {
                    look();
                }
                None
            }
            WaitStatus::Stopped(_, signal) => Some(signal),
            WaitStatus::Signaled(_, signal, _) => panic!("ended by {signal}"),
            _ => None,
        };
        ptrace::syscall(pid, signal).unwrap();
    }
}

/// A program that is killed leaves the files as they are at that moment. Before each of its changes, each file is the old
/// or the new one, and a later call finishes.
#[test]
fn a_kill_leaves_each_file_old_or_new() {
    let old = Card::pi();
    let before = old.snapshot();
    let new = old.copy();
    new.added(&["adxl345", "--yes"]);
    for (card, undo) in [(old.copy(), None), (new.copy(), Some("--undo"))] {
        let args: Vec<&str> = ["adxl345", "--yes"].into_iter().chain(undo).collect();
        let mut killed = Vec::new();
        before_each_change(&card.arguments(&args), || killed.push(card.copy()));
        assert_eq!(card.snapshot(), if undo.is_none() { new.snapshot() } else { before.clone() });
        assert!(killed.len() > 3, "killed {} times", killed.len());
        for (change, card) in killed.iter().enumerate() {
            for path in [PRINTER, "boot/firmware/config.txt"] {
                let now = card.read(path);
                assert!(now == old.read(path) || now == new.read(path), "before change {change}: {path}: {now}");
            }
            card.added(&["adxl345", "--yes"]);
            card.added(&["adxl345", "--undo", "--yes"]);
            assert!(card.snapshot() == before, "before change {change}: something is left");
        }
    }
}

/// Before each change of a call, another one looks for what killed programs have left, and takes nothing of the first one.
#[test]
fn a_call_takes_no_new_file_of_another_one_away() {
    let card = Card::pi();
    let new = card.copy();
    new.added(&["adxl345", "--yes"]);
    before_each_change(&card.arguments(&["adxl345", "--yes"]), || {
        card.added(&["bme280", "--undo", "--dry-run"]);
    });
    assert_eq!(card.snapshot(), new.snapshot());
}

/// A Moonraker whose host does this. It answers until it is dropped, and returns the requests.
pub(crate) fn moonraker(state: &'static str) -> (String, thread::JoinHandle<Vec<String>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let server = thread::spawn(move || {
        let mut requests = Vec::new();
        let (mut queried, mut is_warm) = (false, false);
        loop {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = Vec::new();
            let mut byte = [0];
            while !request.ends_with(b"\r\n\r\n") && stream.read(&mut byte).unwrap() == 1 {
                request.push(byte[0]);
            }
            let request = String::from_utf8(request).unwrap();
            let line = request.lines().next().unwrap_or_default().to_owned();
            let body = if line.contains("fan_generic") {
                "{\"result\":{\"status\":{\"fan_generic box\":{\"rpm\":1234.0}}}}".to_owned()
            } else if line.contains("temperature_sensor") {
                // klippy says 0 until it has a value.
                let degrees = if std::mem::replace(&mut is_warm, true) { "21.5" } else { "0.0" };
                format!("{{\"result\":{{\"status\":{{\"temperature_sensor bme280\":{{\"temperature\":{degrees}}}}}}}}}")
            } else if line.contains("objects/query") {
                format!("{{\"result\":{{\"status\":{{\"print_stats\":{{\"state\":\"{state}\"}}}}}}}}")
            } else if line.contains("printer/info") && state != "error" {
                "{\"result\":{\"state\":\"ready\"}}".to_owned()
            } else if line.contains("printer/info") {
                "{\"result\":{\"state\":\"error\",\"state_message\":\"mcu 'host': Unable to connect\\nmore\"}}"
                    .to_owned()
            } else if line.contains("gcode_store") && queried {
                "{\"result\":{\"gcode_store\":[{\"time\":2.0,\"type\":\"response\",\"message\":\
                 \"// accelerometer values (x, y, z): 470.0, 941.0, 9728.0\"}]}}"
                    .to_owned()
            } else {
                "{\"result\":{\"gcode_store\":[]}}".to_owned()
            };
            queried |= line.contains("ACCELEROMETER_QUERY");
            if line.is_empty() {
                return requests;
            }
            requests.push(line);
            stream.write_all(format!("HTTP/1.1 200 OK\r\n\r\n{body}").as_bytes()).unwrap();
        }
    });
    (address, server)
}

pub(crate) fn end(address: &str, server: thread::JoinHandle<Vec<String>>) -> Vec<String> {
    std::net::TcpStream::connect(address).unwrap().write_all(b"\r\n\r\n").unwrap();
    server.join().unwrap()
}

#[test]
fn the_host_restarts_and_measures_and_never_while_it_prints() {
    let card = Card::pi();
    let before = card.snapshot();
    for state in ["printing", "paused"] {
        let (address, server) = moonraker(state);
        for more in [&[][..], &["--undo"]] {
            let log = card.add(&[&["adxl345", "--yes", "--moonraker", &address], more].concat());
            let log = String::from_utf8_lossy(&log.stderr).into_owned();
            assert!(log.contains("the host prints") || more.contains(&"--undo") && log.is_empty(), "{log}");
        }
        assert_eq!(card.snapshot(), before);
        assert!(end(&address, server).iter().all(|request| request.starts_with("GET /printer/objects/query")));
    }
    let (address, server) = moonraker("standby");
    let printed = card.added(&["adxl345", "--yes", "--moonraker", &address]);
    assert!(printed.contains("it measures 470, 941, 9728 mm/s2: 1.00 of gravity"), "{printed}");
    assert!(printed.contains("SHAPER_CALIBRATE"), "{printed}");
    let requests = end(&address, server);
    assert!(requests.iter().any(|request| request.starts_with("POST /printer/firmware_restart ")), "{requests:?}");
    // Nothing is changed, so nothing restarts.
    let (address, server) = moonraker("standby");
    card.added(&["adxl345", "--yes", "--moonraker", &address]);
    assert!(!end(&address, server).iter().any(|request| request.contains("restart")));
}

#[test]
fn a_fan_turns_until_its_tachometer_counts_and_leds_light() {
    let card = Card::pi();
    let (address, server) = moonraker("standby");
    let printed = card.added(&["fan", "--yes", "--moonraker", &address]);
    assert!(printed.contains("the tachometer counts 1234 turns a minute at full speed"), "{printed}");
    let printed = card.added(&["ws2812", "--yes", "--moonraker", &address]);
    assert!(printed.contains("the strip should be red now"), "{printed}");
    let printed = card.added(&["fan", "--undo", "--yes", "--moonraker", &address]);
    assert!(printed.contains("The host has restarted without the device."), "{printed}");
    let requests = end(&address, server);
    let scripts: Vec<&str> = requests
        .iter()
        .filter_map(|line| line.strip_prefix("POST /printer/gcode/script?script=")?.split(' ').next())
        .collect();
    let fan = "SET_FAN_SPEED%20FAN=box%20SPEED=";
    assert_eq!(scripts[..2], [format!("{fan}1"), format!("{fan}0")]);
    assert_eq!(scripts[2..], ["SET_LED%20LED=strip%20RED=0.5%20GREEN=0%20BLUE=0"]);
}

#[test]
fn a_host_that_does_not_start_is_no_success() {
    let card = Card::pi();
    let (address, server) = moonraker("error");
    let log = card.refused(&["relay", "--yes", "--moonraker", &address]);
    assert!(
        log.contains("klippy says: mcu 'host': Unable to connect: sudo pinion add relay --moonraker ")
            && log.contains(" --undo takes it back"),
        "{log}"
    );
    card.added(&["relay", "--yes", "--undo", "--moonraker", &address]);
    end(&address, server);
    let (address, server) = moonraker("standby");
    let printed = card.added(&["bme280", "--yes", "--moonraker", &address]);
    assert!(printed.contains("the host reads 21.5 degrees"), "{printed}");
    end(&address, server);
}

#[test]
fn a_file_that_is_the_user_s_stays() {
    let card = Card::pi();
    let own = PRINTER.replace("printer.cfg", "pinion/relay.cfg");
    card.put(&own, "[output_pin relay]\npin: host:GPIO5\n");
    card.put(PRINTER, &format!("[include pinion/*.cfg]\n{PRINTER_CFG}[mcu rpi]\nserial: /tmp/klipper_host_mcu\n[adxl345]\ncs_pin: rpi:None\n"));
    let before = card.snapshot();
    let printed = card.added(&["relay", "--yes"]);
    assert!(printed.contains("Nothing is left to change."), "{printed}");
    assert_eq!(card.snapshot(), before);
    let printed = card.added(&["adxl345", "--yes"]);
    assert!(
        printed.contains(&format!("[adxl345] is already in printer.cfg (/{PRINTER}:16), and stays as it is.")),
        "{printed}"
    );
    assert!(!Path::new(&card.path(&PRINTER.replace("printer.cfg", "pinion/adxl345.cfg"))).exists());
    let printed = card.added(&["light", "--yes"]);
    assert!(printed.contains("+ pin: rpi:GPIO17"), "the MCU's own name: {printed}");
    card.added(&["light", "--undo", "--yes"]);
    card.added(&["adxl345", "--undo", "--yes"]);
    assert_eq!(card.snapshot(), before);
}
