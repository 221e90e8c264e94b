// SPDX-License-Identifier: GPL-3.0-or-later
//! Who uses what, from outside: for each source a planted user, which `pinion add` avoids, `pinion doctor` names and
//! `pinion pins --used` shows. Also the cases of people whose setup `pinion add` once broke.

use std::fs;

use std::os::unix::fs::{PermissionsExt, lchown, symlink};
use std::process::{Command, Output};

use pinion_testkit::here;
use serde_json::Value;

use crate::add::{CONFIG_TXT, Card, PRINTER, PRINTER_CFG, end, moonraker};
use crate::process::{output, pinion_path};

/// This computer's MCU.
const HOST: &str = "[mcu host]\nserial: /tmp/klipper_host_mcu\n";

impl Card {
    fn root(&self) -> String {
        self.0.path().to_str().unwrap().to_owned()
    }

    /// A file beside printer.cfg.
    fn beside(&self, name: &str) -> String {
        PRINTER.replace("printer.cfg", name)
    }

    fn with_printer(self, more: &str) -> Card {
        self.put(PRINTER, &format!("{PRINTER_CFG}{more}"));
        self
    }

    fn with_config_txt(self, more: &str) -> Card {
        self.put("boot/firmware/config.txt", &format!("{CONFIG_TXT}{more}"));
        self
    }

    /// The lines that `pinion add --dry-run` would add.
    #[track_caller]
    fn planned(&self, args: &[&str]) -> String {
        let printed = self.added(&[args, &["--dry-run"]].concat());
        printed.lines().filter_map(|line| line.strip_prefix("+ ")).map(|line| format!("{line}\n")).collect()
    }

    fn pins(&self, more: &[&str]) -> String {
        let root = self.root();
        let shown = output(&[&["pins", "--used", "--root", &root], more].concat());
        assert!(shown.status.success(), "{shown:?}");
        String::from_utf8(shown.stdout).unwrap()
    }

    fn doctor(&self) -> String {
        let root = self.root();
        String::from_utf8(output(&["doctor", "--root", &root]).stdout).unwrap()
    }
}

/// A user in each source, on the line that a relay would get.
#[test]
fn a_line_that_something_uses_is_avoided_named_and_shown() {
    let printer_2 = "home/pi/printer_2_data/config/printer.cfg";
    let enabled = "etc/systemd/system/multi-user.target.wants/pinion-mcu@second.service";
    let cards: [(&str, Card); 5] = [
        ("overlay w1-gpio", Card::pi().with_config_txt("dtoverlay=w1-gpio,gpiopin=17\n")),
        ("overlay gpio-fan", Card::pi().with_config_txt("dtoverlay=gpio-fan\ndtparam=gpiopin=17\n")),
        ("Moonraker's [power psu]", {
            let card = Card::pi();
            card.put(&card.beside("moonraker.conf"), "[power psu]\ntype: gpio\npin: gpiochip0/gpio17\n");
            card
        }),
        ("[output_pin other]", {
            let card = Card::pi();
            card.put(printer_2, "[mcu p]\nserial: /tmp/klipper_host_second\n[output_pin other]\npin: p:gpio17\n");
            card.put("lib/systemd/system/pinion-mcu@.service", "[Service]\nExecStart=/usr/bin/pinion run\n");
            fs::create_dir_all(card.path(enabled).parent().unwrap()).unwrap();
            symlink("/lib/systemd/system/pinion-mcu@.service", card.path(enabled)).unwrap();
            card
        }),
        (
            "[output_pin mine]",
            Card::pi()
                .with_printer("[board_pins x]\nmcu: host\naliases: LAMP=GPIO17\n[output_pin mine]\npin: host:LAMP\n"),
        ),
    ];
    let own = format!("/{PRINTER}");
    for (user, card) in cards {
        let has_own = user == "[output_pin mine]";
        let text = card.read(PRINTER);
        card.put(PRINTER, &format!("{text}{HOST}"));
        let config = ["--config", &own];
        let planned = card.planned(&[&["relay"], &config[..]].concat());
        assert!(planned.contains("pin: host:GPIO27\n"), "{user}: {planned}");
        let shown = card.pins(&[]);
        let row = shown.lines().find(|line| line.starts_with("GPIO17 ")).unwrap_or_else(|| panic!("{user}: {shown}"));
        assert!(row.contains("pin 11") && row.contains(user), "{row}");
        let value: Value = serde_json::from_str(&card.pins(&["--json"])).unwrap();
        let entry = value.as_array().unwrap().iter().find(|entry| entry["name"] == "GPIO17").unwrap();
        assert_eq!((entry["user"].as_str(), entry["pin"].as_u64()), (Some(user), Some(11)), "{entry}");
        // Somebody has written the pin into printer.cfg all the same.
        if !has_own {
            let text = card.read(PRINTER);
            card.put(PRINTER, &format!("{text}[output_pin clash]\npin: host:gpio17\n"));
            let told = card.doctor();
            let line = told
                .lines()
                .find(|line| line.contains("GPIO17 (pin 11) is used twice"))
                .unwrap_or_else(|| panic!("{user}: {told}"));
            assert!(line.contains("[output_pin clash]") && line.contains(user), "{line}");
        }
    }
}

/// The same for a chip select, a PWM channel, an address and a serial port.
#[test]
fn a_bus_that_something_uses_is_avoided() {
    // A CAN HAT.
    let card = Card::pi().with_config_txt("dtparam=spi=on\ndtoverlay=mcp2515-can0,oscillator=12000000,interrupt=25\n");
    assert!(card.planned(&["adxl345"]).contains("spi_bus: spidev0.1\n"));
    // A display with a touch screen.
    let card = Card::pi().with_config_txt("dtparam=spi=on\ndtoverlay=tft35a:rotate=90\n");
    assert!(
        card.refused(&["adxl345", "--dry-run"]).contains("is used by overlay tft35a (/boot/firmware/config.txt:53)")
    );
    // Its lines are no place for LEDs or switches.
    assert!(card.planned(&["relay"]).contains("pin: host:GPIO27\n"), "GPIO17 is the touch screen's");
    let card = Card::pi().with_config_txt("dtoverlay=gpio-fan,gpiopin=18\n");
    assert!(card.refused(&["fan", "--dry-run"]).contains("GPIO18 (pin 12) is used by overlay gpio-fan"));
    // The wire goes where the PWM is.
    let card = Card::pi().with_config_txt("dtoverlay=pwm-2chan,pin=12,func=4,pin2=13,func2=4\n");
    let value: Value = serde_json::from_slice(&card.add(&["fan", "--dry-run", "--json"]).stdout).unwrap();
    assert_eq!(value["wires"][1]["pin"], 32, "{value}");
    // A clock has the address of an accelerometer.
    let card = Card::pi().with_config_txt("dtoverlay=i2c-rtc,ds3231\n");
    assert!(card.planned(&["mpu9250"]).contains("i2c_address: 105\n"));
    // The chip selects of a CB1's controller are held by the kernel.
    let env = "overlay_prefix=sun50i-h616\n";
    let card = Card::of(
        "BigTreeTech CB1",
        &[("boot/BoardEnv.txt", env), ("boot/dtb/allwinner/overlay/sun50i-h616-spidev1_1.dtbo", "")],
    );
    card.added(&["adxl345", "--yes"]);
    for (device, line) in [("relay", "gpio78"), ("light", "gpio76"), ("button", "gpio74"), ("filament", "gpio73")] {
        assert!(card.added(&[device, "--yes"]).contains(&format!("host:300b000.pinctrl/{line}\n")), "{device}");
    }
    // An overlay that nobody knows.
    let card = Card::pi().with_config_txt("dtoverlay=somebodys-hat\n");
    let told = card.added(&["relay", "--dry-run"]);
    assert!(
        told.contains("/boot/firmware/config.txt:52: Pinion does not know which pins the overlay somebodys-hat takes"),
        "{told}"
    );
}

/// The line that was moved for 1-Wire is not given to a relay, and the thermometer can be added again.
#[test]
fn a_thermometer_and_a_relay_keep_apart() {
    let card = Card::pi().with_config_txt("dtoverlay=w1-gpio,gpiopin=17\n");
    card.put("sys/bus/w1/devices/28-0316a4f1ff27/w1_slave", "");
    let value: Value = serde_json::from_slice(&card.add(&["ds18b20", "--yes", "--json"]).stdout).unwrap();
    assert_eq!(value["wires"][2]["pin"], 11, "{value}");
    assert!(card.added(&["relay", "--yes"]).contains("+ pin: host:GPIO27\n"));
    assert!(card.added(&["ds18b20", "--yes"]).contains("Nothing is left to change."));
}

#[test]
fn what_a_section_of_the_user_needs_stays_at_an_undo() {
    let card = Card::pi();
    card.added(&["relay", "--yes"]);
    let text = card.read(PRINTER);
    card.put(PRINTER, &format!("{text}\n[output_pin mine]\npin: !host:GPIO5\n"));
    let told = card.added(&["relay", "--undo", "--yes"]);
    assert!(told.contains("pinion/host-mcu.cfg stays: [output_pin mine] uses [mcu host]"), "{told}");
    assert!(
        card.path(&card.beside("pinion/host-mcu.cfg")).exists()
            && card.read(PRINTER).contains("[include pinion/*.cfg]")
    );
    // A file of the user's own is read by the same include.
    let card = Card::pi();
    card.added(&["relay", "--yes"]);
    card.put(&card.beside("pinion/own.cfg"), "[gcode_macro A]\ngcode:\n");
    let told = card.added(&["relay", "--undo", "--yes"]);
    assert!(told.contains("keeps its include: ") && told.contains("pinion/own.cfg is there"), "{told}");
    assert!(card.read(PRINTER).contains("[include pinion/*.cfg]"));
}

/// The driver of the ADC takes the other chip select, in any order.
#[test]
fn an_adc_does_not_take_the_chip_select_of_an_accelerometer() {
    let card = Card::pi();
    card.added(&["adxl345", "--yes"]);
    let told = card.added(&["mcp3208", "--yes"]);
    assert!(told.contains("+ dtoverlay=anyspi:spi0-1,dev=\"microchip,mcp3208\",speed=1000000\n"), "{told}");
    assert!(told.lines().any(|line| line.contains("CS ") && line.contains("pin 26")), "{told}");
    assert!(card.added(&["mcp3208", "--yes"]).contains("Nothing is left to change."));
    let card = Card::pi();
    card.added(&["mcp3208", "--yes"]);
    assert!(card.read("boot/firmware/config.txt").contains("dtoverlay=anyspi:spi0-0,"));
    assert!(card.added(&["adxl345", "--yes"]).contains("+ spi_bus: spidev0.1\n"));
}

/// Each command that is printed has the options that lead to the same place.
#[test]
fn a_command_that_is_printed_is_whole() {
    let card = Card::pi();
    let config = format!("/{PRINTER}");
    let told = card.added(&["lis2dw", "--bus", "i2c", "--name", "bed", "--config", &config, "--yes"]);
    let last = told.lines().last().unwrap();
    let root = card.root();
    assert_eq!(
        last,
        format!("sudo pinion add lis2dw --name bed --config {config} --root {root} --undo takes all of it back.")
    );
    let (address, server) = moonraker("error");
    let log = card.refused(&["relay", "--pin", "16", "--moonraker", &address, "--yes"]);
    assert!(
        log.contains(&format!("sudo pinion add relay --moonraker {address} --root {root} --undo takes it back")),
        "{log}"
    );
    end(&address, server);
    let log = card.refused(&["light", "--pin", "GPIO24"]);
    assert!(log.contains("use --yes"), "{log}");
}

#[test]
fn the_mcu_of_another_computer_or_board_is_left_alone() {
    let bed = "[mcu bedpi]\nserial: /tmp/klipper_host_bedpi\n";
    let card = Card::pi().with_printer(&format!("{bed}{HOST}"));
    assert!(card.planned(&["relay"]).contains("pin: host:GPIO17\n"));
    let card = Card::pi().with_printer(bed);
    assert!(card.planned(&["adxl345"]).contains("[mcu host]\n"));
    let card = Card::pi().with_printer("[mcu host]\nserial: /dev/serial/by-id/usb-pico\n");
    let planned = card.planned(&["relay"]);
    assert!(
        planned.contains("[mcu host2]\nserial: /tmp/klipper_host_mcu\n") && planned.contains("pin: host2:GPIO17\n"),
        "{planned}"
    );
}

/// SAVE_CONFIG has written a section of the device.
#[test]
fn an_undo_takes_the_saved_lines_of_the_device_out() {
    let card = Card::pi();
    card.added(&["hx711", "--yes"]);
    let text = card.read(PRINTER);
    let head = "#*# <---------------------- SAVE_CONFIG ---------------------->\n#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n";
    let text = text.split("#*#").next().unwrap().to_owned();
    card.put(
        PRINTER,
        &format!("{text}\n{head}#*# [load_cell]\n#*# counts_per_gram = 73.2\n#*#\n#*# [probe]\n#*# z_offset = 1\n"),
    );
    let told = card.added(&["hx711", "--undo", "--yes"]);
    assert!(told.contains("the lines of [load_cell] in the SAVE_CONFIG block of"), "{told}");
    let left = card.read(PRINTER);
    assert!(
        !left.contains("load_cell") && left.contains(&format!("\n{head}#*# [probe]\n#*# z_offset = 1\n")),
        "{left}"
    );
}

/// A command of the doctor that is pasted into a shell.
#[test]
fn the_doctor_s_command_keeps_the_last_line_and_the_card() {
    let card = Card::pi();
    card.put("boot/firmware/config.txt", "dtoverlay=vc4-kms-v3d");
    let told = card.doctor();
    let command =
        told.lines().find_map(|line| line.split_once("if it is wanted: ")?.1.split_once(", and reboot")).unwrap().0;
    assert!(command.contains("dtoverlay=pwm-2chan"), "{command}");
    let pasted = Command::new("sh").args(["-c", &command.replace("sudo ", "")]).output().unwrap();
    assert!(pasted.status.success(), "{pasted:?}");
    assert_eq!(card.read("boot/firmware/config.txt"), "dtoverlay=vc4-kms-v3d\n[all]\ndtoverlay=pwm-2chan\n");
}

#[test]
fn the_doctor_names_pins_that_are_not_there_and_the_right_one() {
    let card = Card::of("BigTreeTech CB1", &[])
        .with_printer(&format!("{HOST}[output_pin a]\npin: host:PG19\n[output_pin b]\npin: host:gpio500\n"));
    let told = card.doctor();
    assert!(
        told.contains("[output_pin a] (/home/pi/printer_data/config/printer.cfg:16) names the pin host:PG19"),
        "{told}"
    );
    assert!(told.contains("-> write host:300b000.pinctrl/gpio211\n"), "{told}");
    assert!(told.contains("names the pin host:gpio500, which this computer does not have"), "{told}");
    // sysfs counts the lines from 512 on.
    let card = Card::pi().with_printer(&format!("{HOST}[output_pin a]\npin: !host:gpio529\n"));
    assert!(card.doctor().contains("-> write !host:GPIO17\n"), "{}", card.doctor());
    // The chip select of a bus.
    let card = Card::pi()
        .with_printer(&format!("{HOST}[adxl345]\ncs_pin: host:GPIO8\nspi_bus: spidev0.0\n"))
        .with_config_txt("dtparam=spi=on\n");
    let told = card.doctor();
    assert!(
        told.contains("GPIO8 (pin 24) is used twice: by [adxl345]")
            && told.contains("cs_pin: host:None and spi_bus: spidev0.0"),
        "{told}"
    );
}

#[test]
fn the_doctor_compares_klippy_s_python_and_the_clock_of_i2c() {
    let card = Card::pi().with_printer(&format!(
        "{HOST}[mpu9250]\ni2c_mcu: host\ni2c_bus: i2c.1\n[resonance_tester]\naccel_chip: mpu9250\n"
    ));
    card.put("etc/passwd", "pi:x:54321:54321::/home/pi:/bin/sh\n");
    let unit = format!(
        "[Service]\nUser=pi\nExecStart=/home/pi/klippy-env/bin/python /home/pi/klipper/klippy/klippy.py /{PRINTER}\n"
    );
    card.put("etc/systemd/system/klipper.service", &unit);
    card.put("home/pi/klippy-env/bin/python", "");
    card.put("home/pi/klippy-env/pyvenv.cfg", "include-system-site-packages = false\n");
    card.put("dev/i2c-1", "");
    fs::create_dir_all(card.path("sys/class/i2c-adapter/i2c-1/of_node")).unwrap();
    fs::write(card.path("sys/class/i2c-adapter/i2c-1/of_node/clock-frequency"), 100_000u32.to_be_bytes()).unwrap();
    let told = card.doctor();
    assert!(told.contains("SHAPER_CALIBRATE fails: klippy's Python has no numpy (klipper.service)"), "{told}");
    assert!(told.contains("-> sudo -u pi /home/pi/klippy-env/bin/pip install numpy\n"), "{told}");
    assert!(told.contains("[mpu9250] loses samples: the clock of i2c.1 is 100 kHz"), "{told}");
    fs::write(card.path("sys/class/i2c-adapter/i2c-1/of_node/clock-frequency"), 400_000u32.to_be_bytes()).unwrap();
    card.put("home/pi/klippy-env/lib/python3.11/site-packages/numpy/__init__.py", "");
    let told = card.doctor();
    assert!(!told.contains("numpy") && !told.contains("loses samples"), "{told}");
}

/// A card has no device tree.
#[test]
fn the_board_of_a_card_is_named() {
    let card = Card::pi();
    fs::remove_dir_all(card.path("proc")).unwrap();
    assert!(card.refused(&["adxl345", "--yes"]).contains("name it with --board (raspberry-pi-3, raspberry-pi-4, "));
    card.added(&["adxl345", "--yes", "--board", "raspberry-pi-4"]);
    assert!(card.read("boot/firmware/config.txt").ends_with("# pinion add adxl345\n[all]\ndtparam=spi=on\n"));
    assert!(card.refused(&["relay", "--board", "pi4"]).contains("--board: there is no board \"pi4\""));
}

/// RatOS has its configuration behind an absolute link.
#[test]
fn an_absolute_link_of_a_card_leads_to_the_card() {
    let card = Card::pi();
    card.put("home/ratos/config/printer.cfg", "[mcu rpi]\nserial: /tmp/klipper_host_mcu\n");
    fs::remove_dir_all(card.path("home/pi")).unwrap();
    fs::create_dir_all(card.path("home/pi/printer_data")).unwrap();
    symlink("/home/ratos/config", card.path("home/pi/printer_data/config")).unwrap();
    let told = card.added(&["relay", "--yes"]);
    assert!(told.contains("+ pin: rpi:GPIO17\n"), "{told}");
    assert!(card.path("home/ratos/config/pinion/relay.cfg").exists());
    // The boot file of this computer is not the card's.
    let outside = tempfile::tempdir().unwrap();
    fs::write(outside.path().join("config.txt"), "mine\n").unwrap();
    let card = Card::pi();
    fs::remove_dir_all(card.path("boot/firmware")).unwrap();
    symlink(outside.path(), card.path("boot/firmware")).unwrap();
    assert!(card.refused(&["adxl345", "--yes"]).contains("there is no /boot/firmware/config.txt"));
    assert_eq!(fs::read_to_string(outside.path().join("config.txt")).unwrap(), "mine\n");
}

/// A section that is there under another name only gets its bus.
#[test]
fn a_device_that_is_there_under_another_name_is_not_added_again() {
    let sections = "[lis2dw bed]\ncs_pin: host:None\nspi_bus: spidev0.0\n[temperature_sensor room]\nsensor_type: BME280\ni2c_mcu: host\ni2c_bus: i2c.1\ni2c_address: 118\n";
    let card = Card::pi().with_printer(&format!("{HOST}{sections}"));
    for (device, section, line) in
        [("lis2dw", "lis2dw bed", "dtparam=spi=on"), ("bme280", "temperature_sensor room", "dtparam=i2c_arm=on")]
    {
        let told = card.added(&[device, "--yes"]);
        assert!(told.contains(&format!("[{section}] is already in printer.cfg")), "{told}");
        assert!(card.read("boot/firmware/config.txt").contains(&format!("\n{line}\n")));
        assert!(!card.path(&card.beside(&format!("pinion/{device}.cfg"))).exists());
    }
    // A second one has a name.
    let told = card.added(&["lis2dw", "--name", "head", "--yes"]);
    assert!(told.contains("+ [lis2dw head]\n") && told.contains("+ spi_bus: spidev0.1\n"), "{told}");
}

/// The accelerometer of the toolhead's board is another one.
#[test]
fn a_second_device_has_a_name() {
    let card = Card::pi().with_printer("[mcu EBB]\nserial: /dev/serial/by-id/ebb\n[adxl345]\ncs_pin: EBB:PB12\n[resonance_tester]\naccel_chip: adxl345\n");
    let log = card.refused(&["adxl345", "--yes"]);
    assert!(log.contains("is on the MCU EBB: give this device another name: pinion add adxl345 --name NAME"), "{log}");
    assert!(!card.read("boot/firmware/config.txt").contains("\ndtparam=spi=on"));
    let told = card.added(&["adxl345", "--name", "bed", "--yes"]);
    assert!(told.contains("+ [adxl345 bed]\n") && told.contains("\n  ACCELEROMETER_QUERY CHIP=bed\n"), "{told}");
    // Two relays, on two lines, and each can go.
    let card = Card::pi();
    let before = card.snapshot();
    card.added(&["relay", "--yes"]);
    let told = card.added(&["relay", "--name", "lamp", "--yes"]);
    assert!(
        told.contains("+ [output_pin lamp]\n+ pin: host:GPIO27\n") && told.contains("SET_PIN PIN=lamp VALUE=1"),
        "{told}"
    );
    card.added(&["relay", "--undo", "--yes"]);
    assert!(card.path(&card.beside("pinion/relay-lamp.cfg")).exists());
    card.added(&["relay", "--name", "lamp", "--undo", "--yes"]);
    assert_eq!(card.snapshot(), before);
}

#[test]
fn a_repeated_call_draws_what_was_written() {
    let card = Card::pi();
    card.added(&["relay", "--pin", "16", "--yes"]);
    let told = card.added(&["relay", "--yes"]);
    assert!(told.contains("pin 16  GPIO23") && told.contains("Nothing is left to change."), "{told}");
    assert!(
        card.refused(&["relay", "--pin", "18", "--yes"])
            .contains("relay is already on GPIO23 (pin 16): take that back")
    );
    card.added(&["lis2dw", "--bus", "i2c", "--yes"]);
    let told = card.added(&["lis2dw", "--yes"]);
    assert!(told.contains("by I2C\n") && told.contains("Nothing is left to change."), "{told}");
    assert!(card.refused(&["lis2dw", "--bus", "spi", "--yes"]).contains("lis2dw is already connected by I2C"));
    assert!(!card.read("boot/firmware/config.txt").contains("\ndtparam=spi=on"));
    assert!(card.refused(&["adxl345", "--pin", "11"]).contains("--pin: adxl345 needs no line here"));
}

/// The user has changed lines and files since.
#[test]
fn an_undo_leaves_what_was_changed_and_says_so() {
    let card = Card::pi();
    card.added(&["adxl345", "--yes"]);
    let config = card.read("boot/firmware/config.txt").replace("\ndtparam=spi=on\n", "\ndtparam=spi=on # accel\n");
    card.put("boot/firmware/config.txt", &config);
    let text = card.read(PRINTER).replace("# by pinion add", "# mine");
    card.put(PRINTER, &text);
    let own = card.beside("pinion/adxl345.cfg");
    card.put(&own, &card.read(&own).replace("[adxl345]\n", "[adxl345]\naxes_map: x,z,y\n"));
    let shown = card.added(&["adxl345", "--undo", "--dry-run"]);
    assert!(shown.contains("removed file") && shown.contains("Nothing was changed (--dry-run)."), "{shown}");
    assert!(card.path(&own).exists());
    let told = card.added(&["adxl345", "--undo", "--yes"]);
    assert!(
        told.contains("printer.cfg keeps its include: pinion add has not written this line")
            || told.contains("keeps its include"),
        "{told}"
    );
    assert!(told.contains("config.txt keeps lines below \"# pinion add adxl345\": they were changed later"), "{told}");
    assert_eq!(card.read("boot/firmware/config.txt"), config);
    assert_eq!(card.read(PRINTER), text);
    assert!(told.contains("adxl345.cfg was changed later"), "{told}");
    assert!(card.read(&format!("{own}.removed")).contains("axes_map: x,z,y"));
    // The copies of before are still there.
    assert_eq!(card.read(&format!("{PRINTER}.before-pinion")), PRINTER_CFG);
    assert_eq!(card.read("boot/firmware/config.txt.before-pinion"), CONFIG_TXT);
}

/// Without the folder, the include finds nothing.
#[test]
fn an_undo_after_the_folder_was_removed() {
    let card = Card::pi();
    card.added(&["adxl345", "--yes"]);
    fs::remove_dir_all(card.path(&card.beside("pinion"))).unwrap();
    card.added(&["adxl345", "--undo", "--yes"]);
    assert_eq!(card.read("boot/firmware/config.txt"), CONFIG_TXT);
    assert_eq!(card.read(PRINTER), PRINTER_CFG);
}

#[test]
fn the_other_accelerometer_goes_on_measuring_resonances() {
    let card = Card::pi();
    let before = card.snapshot();
    card.added(&["adxl345", "--yes"]);
    card.added(&["lis2dw", "--yes"]);
    card.added(&["adxl345", "--undo", "--yes"]);
    assert!(card.read(&card.beside("pinion/resonance_tester.cfg")).contains("accel_chip: lis2dw\n"));
    card.added(&["lis2dw", "--undo", "--yes"]);
    assert_eq!(card.snapshot(), before);
}

#[test]
fn a_picture_replaces_no_other_file() {
    let card = Card::pi();
    card.put("mine.cfg", "precious");
    let path = card.path("mine.cfg").display().to_string();
    assert!(card.refused(&["adxl345", "--dry-run", "--picture", &path]).contains("exists but is not a picture"));
    assert_eq!(card.read("mine.cfg"), "precious");
    let svg = card.path("users.svg").display().to_string();
    card.added(&["relay", "--yes"]);
    card.pins(&["--picture", &svg]);
    assert!(card.read("users.svg").contains("[output_pin relay]"));
    card.added(&["relay", "--yes", "--picture", &svg]);
    let refused = card.add(&["--picture", &svg]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
}

/// A byte of Latin-1 in a comment.
#[test]
fn a_config_txt_that_is_not_utf_8_keeps_its_bytes() {
    let card = Card::pi();
    let path = card.path("boot/firmware/config.txt");
    let bytes = b"# L\xfcfter\ndtparam=audio=on\n";
    fs::write(&path, bytes).unwrap();
    card.added(&["adxl345", "--yes"]);
    assert_eq!(fs::read(&path).unwrap(), [&bytes[..], b"# pinion add adxl345\n[all]\ndtparam=spi=on\n"].concat());
    card.added(&["adxl345", "--undo", "--yes"]);
    assert_eq!(fs::read(&path).unwrap(), bytes);
}

/// The checkout of the host says which devices it has.
#[test]
fn a_device_that_the_host_does_not_have_is_not_offered() {
    let card = Card::pi();
    card.put(
        "etc/systemd/system/klipper.service",
        &format!("[Service]\nExecStart=/usr/bin/python3 /home/pi/klipper/klippy/klippy.py /{PRINTER}\n"),
    );
    for module in ["bus", "adxl345", "output_pin"] {
        card.put(&format!("home/pi/klipper/klippy/extras/{module}.py"), "");
    }
    let log = card.refused(&["ads1115", "--yes"]);
    assert!(log.contains("the host in /home/pi/klipper/klippy has no module ads1x1x"), "{log}");
    let list = card.added(&[]);
    let row =
        |name: &str| list.lines().find(|line| line.starts_with(&format!("  {name} "))).unwrap_or_default().to_owned();
    assert!(
        row("ads1115").ends_with("not in your version of the host") && !row("adxl345").contains("not in"),
        "{list}"
    );
    card.added(&["relay", "--yes"]);
}

/// Moonraker listens on IPv4 only, and its name means IPv6 first.
#[test]
fn moonraker_is_asked_at_all_addresses_of_its_name() {
    let (address, server) = moonraker("standby");
    let port = address.rsplit(':').next().unwrap();
    let card = Card::pi();
    let told = card.added(&["adxl345", "--yes", "--moonraker", &format!("localhost:{port}")]);
    assert!(told.contains("1.00 of gravity"), "{told}");
    end(&address, server);
}

/// Two calls at once: none loses the other's lines.
#[test]
fn two_calls_at_once_lose_nothing() {
    for _ in 0..4 {
        let card = Card::pi();
        let root = card.root();
        let call = |device: &str| {
            Command::new(pinion_path()).args(["add", device, "--yes", "--root", &root]).output().unwrap()
        };
        let done: Vec<Output> = std::thread::scope(|scope| {
            let calls = ["adxl345", "bme280"].map(|device| scope.spawn(move || call(device)));
            calls.map(|call| call.join().unwrap()).into()
        });
        for (device, done) in ["adxl345", "bme280"].iter().zip(&done) {
            let log = String::from_utf8_lossy(&done.stderr);
            assert!(done.status.success() || log.contains("run this command again"), "{log}");
            card.added(&[device, "--yes"]);
        }
        let config = card.read("boot/firmware/config.txt");
        assert!(config.contains("\ndtparam=spi=on\n") && config.contains("\ndtparam=i2c_arm=on\n"), "{config}");
        assert_eq!(card.read(PRINTER).matches("[include pinion/*.cfg]").count(), 1);
    }
}

/// The other printer of this computer needs the bus.
#[test]
fn an_undo_for_one_printer_leaves_the_other_one_s_bus() {
    let card = Card::pi();
    let second = "home/pi/printer_2_data/config/printer.cfg";
    let config = format!("/{PRINTER}");
    card.put(second, &format!("{HOST}[lis2dw]\ncs_pin: host:None\nspi_bus: spidev0.1\n"));
    card.added(&["adxl345", "--yes", "--config", &config]);
    assert!(card.refused(&["adxl345", "--yes", "--undo"]).contains("there are several hosts"));
    let told = card.added(&["adxl345", "--yes", "--undo", "--config", &config]);
    assert!(told.contains(&format!("keeps \"dtparam=spi=on\": [lis2dw] (/{second}) still needs it")), "{told}");
    assert!(card.read("boot/firmware/config.txt").contains("\ndtparam=spi=on\n"));
}

/// The sections cannot be written, so the bus is not enabled, either.
#[test]
fn config_txt_stays_if_printer_cfg_cannot_change() {
    let card = Card::pi();
    fs::set_permissions(card.path(PRINTER), fs::Permissions::from_mode(0o444)).unwrap();
    let before = card.snapshot();
    let log = card.refused(&["adxl345", "--yes"]);
    assert!(log.contains("printer.cfg is read-only: chmod u+w "), "{log}");
    assert_eq!(card.snapshot(), before);
    // Nobody knows which printer is meant.
    card.put("home/other/printer_data/config/printer.cfg", PRINTER_CFG);
    let before = card.snapshot();
    let log = card.refused(&["adxl345", "--yes"]);
    assert!(log.contains("there are several hosts"), "{log}");
    assert_eq!(card.snapshot(), before);
}

/// An undo asks both sides first, too.
#[test]
fn an_undo_changes_no_file_if_another_one_cannot_change() {
    let card = Card::pi();
    card.added(&["adxl345", "--yes"]);
    fs::set_permissions(card.path("boot/firmware/config.txt"), fs::Permissions::from_mode(0o444)).unwrap();
    let before = card.snapshot();
    let log = card.refused(&["adxl345", "--undo", "--yes"]);
    assert!(log.contains("config.txt is read-only: chmod u+w "), "{log}");
    assert_eq!(card.snapshot(), before);
}

#[test]
fn a_link_that_leads_nowhere_is_found_before_the_bus_is_enabled() {
    let card = Card::pi();
    symlink("/home/pi/gone", card.path(&card.beside("pinion"))).unwrap();
    let log = card.refused(&["adxl345", "--yes"]);
    assert!(log.contains(&format!("/{} is a link that leads nowhere: remove it", card.beside("pinion"))), "{log}");
    assert_eq!(card.read("boot/firmware/config.txt"), CONFIG_TXT);
    assert!(!card.path("home/pi/gone").exists());
}

/// A mounted card has no device tree.
#[test]
fn the_doctor_is_told_the_board_of_a_card() {
    let card = Card::pi().with_config_txt("[pi4]\ndtoverlay=gpio-fan,gpiopin=17\n").with_printer(HOST);
    fs::remove_dir_all(card.path("proc")).unwrap();
    card.put(PRINTER, &format!("{PRINTER_CFG}{HOST}[output_pin lamp]\npin: host:GPIO17\n"));
    let root = card.root();
    let doctor = |board: &str| output(&["doctor", "--root", &root, "--board", board]);
    let found = String::from_utf8(doctor("raspberry-pi-4").stdout).unwrap();
    assert!(found.contains("GPIO17 (pin 11) is used twice: by [output_pin lamp]"), "{found}");
    assert!(found.contains("SPI: off") && found.contains("dtparam=spi=on"), "{found}");
    assert!(!String::from_utf8(doctor("raspberry-pi-5").stdout).unwrap().contains("used twice"));
    let refused = doctor("raspberry-pi-9");
    let log = String::from_utf8_lossy(&refused.stderr);
    assert!(log.starts_with("error: --board: there is no board \"raspberry-pi-9\": choose one of rasp"), "{log}");
}

/// The user's printer.cfg includes a file of root's. One line is no option, so klippy's error quotes it.
#[test]
fn root_s_commands_print_no_line_that_the_owner_of_printer_cfg_may_not_read() {
    if !here::is_root() {
        return;
    }
    let card = Card::pi().with_printer("[include /srv/secret.cfg]\n");
    card.put("srv/secret.cfg", "[x]\nwords of root\n");
    card.put(
        "etc/systemd/system/klipper.service",
        &format!("[Service]\nExecStart=/usr/bin/python3 /home/pi/klipper/klippy/klippy.py /{PRINTER}\n"),
    );
    fs::set_permissions(card.path(""), fs::Permissions::from_mode(0o755)).unwrap();
    fs::set_permissions(card.path("srv/secret.cfg"), fs::Permissions::from_mode(0o600)).unwrap();
    let told = card.doctor();
    assert!(told.contains("words of root"), "the owner is root: {told}");
    lchown(card.path(PRINTER), Some(65_534), Some(65_534)).unwrap();
    for told in [card.doctor(), card.pins(&[]), card.refused(&["relay", "--dry-run"])] {
        assert!(!told.contains("words of root"), "{told}");
    }
    assert!(card.doctor().contains("secret.cfg: Unable to open config file: Permission denied"));
}

#[test]
fn the_command_for_a_second_device_has_one_name() {
    let card = Card::pi().with_printer(&format!("{HOST}[lis2dw bed]\ncs_pin: host:None\nspi_bus: spidev0.0\n"));
    let told = card.added(&["lis2dw", "--name", "bed", "--dry-run"]);
    assert!(told.contains(&format!("sudo pinion add lis2dw --root {} --name NAME", card.root())), "{told}");
    // Without klippy's unit, the doctor looks in the usual places.
    let told = card.doctor();
    assert!(told.contains("[lis2dw bed] in printer.cfg needs /dev/spidev0.0"), "{told}");
}
