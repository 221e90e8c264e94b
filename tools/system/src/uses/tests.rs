// SPDX-License-Identifier: GPL-3.0-or-later
//! One planted user for each source.

use super::*;
use crate::boards;
use crate::tree::Tree;

const CONFIG: &str = "home/pi/printer_data/config";

/// A Raspberry Pi 4 with these files.
fn pi4(files: &[(&str, &str)]) -> Tree {
    let tree = Tree::empty();
    tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
    tree.put("boot/firmware/config.txt", "");
    tree.put(&format!("{CONFIG}/printer.cfg"), "[mcu host]\nserial: /tmp/klipper_host_mcu\n");
    files.iter().for_each(|(path, text)| tree.put(&path.replace("CONFIG", CONFIG), text));
    tree
}

fn uses(tree: &Tree) -> Uses {
    let computer = tree.computer();
    let board = Board::of(&computer, None).unwrap();
    Uses::find(&computer, board.as_ref(), None, None)
}

/// All uses: the part, the user, the place and the function.
fn all(tree: &Tree) -> Vec<String> {
    let line = |one: &Use| {
        let function = one.function.as_ref().map_or(String::new(), |function| format!(" as {function}"));
        format!("{} by {} at {}{function}", one.what, one.user, one.place)
    };
    uses(tree).sorted().map(line).collect()
}

fn config_txt(text: &str) -> Vec<String> {
    all(&pi4(&[("boot/firmware/config.txt", text)]))
}

/// The lines that this config.txt takes.
fn lines_of(text: &str) -> Vec<String> {
    let uses = uses(&pi4(&[("boot/firmware/config.txt", text)]));
    uses.sorted().map(|one| one.what.to_string()).collect()
}

#[test]
fn overlays_take_their_pins_wherever_their_parameters_are() {
    let own = "/boot/firmware/config.txt";
    assert_eq!(
        config_txt("# x\ndtoverlay=w1-gpio,gpiopin=17\n"),
        [format!("GPIO17 by overlay w1-gpio at {own}:2 as w1")]
    );
    assert_eq!(lines_of("dtoverlay=w1-gpio\ndtparam=gpiopin=17\n"), ["GPIO17"], "behind it");
    assert_eq!(lines_of("dtoverlay=w1-gpio\ndtoverlay=\ndtparam=gpiopin=17\n"), ["GPIO4"], "it was closed");
    for (text, lines) in [
        ("dtoverlay=gpio-fan,gpiopin=18", &["GPIO18"][..]),
        ("dtoverlay=gpio-shutdown", &["GPIO3"]),
        ("dtoverlay=gpio-ir,gpio_pin=23", &["GPIO23"]),
        ("dtoverlay=gpio-poweroff", &["GPIO26"]),
        ("dtoverlay=pwm-2chan,pin=12,func=4,pin2=13,func2=4", &["GPIO12", "GPIO13"]),
        ("dtoverlay=spi1-2cs,cs1_pin=5", &["GPIO5", "GPIO18", "GPIO19", "GPIO20", "GPIO21"]),
        ("dtoverlay=i2c3", &["GPIO4", "GPIO5"]),
        ("dtoverlay=i2c3,pins_2_3", &["GPIO2", "GPIO3"]),
        ("dtoverlay=uart5,ctsrts", &["GPIO12", "GPIO13", "GPIO14", "GPIO15"]),
        ("dtoverlay=mcp2515-can0,oscillator=12000000,interrupt=22", &["GPIO22", "spidev0.0"]),
        ("dtoverlay=tft35a:rotate=90", &["GPIO17", "GPIO24", "GPIO25", "spidev0.0", "spidev0.1"]),
        ("dtoverlay=ads7846,cs=0,penirq=5", &["GPIO5", "spidev0.0"]),
        ("dtoverlay=anyspi:spi0-1,dev=\"microchip,mcp3208\"", &["spidev0.1"]),
        ("dtoverlay=hifiberry-dac", &["GPIO18", "GPIO19", "GPIO20", "GPIO21"]),
        ("dtoverlay=i2c-rtc,ds3231", &["i2c.1 0x68"]),
        ("dtoverlay=i2c-sensor,bme280,addr=0x77", &["i2c.1 0x77"]),
        ("dtoverlay=i2c-rtc,rv3028,i2c0", &["i2c.0 0x52"]),
        ("dtoverlay=vc4-kms-v3d", &[]),
        ("dtoverlay=a-hat-of-somebody,x=1", &["anything"]),
        ("dtparam=spi=on", &["GPIO7", "GPIO8", "GPIO9", "GPIO10", "GPIO11"]),
        ("dtparam=i2c_arm=on,i2c_arm_baudrate=400000", &["GPIO2", "GPIO3"]),
        ("dtparam=spi=on\ndtparam=spi=off", &[]),
        ("enable_uart=1", &["GPIO14", "GPIO15"]),
        ("#dtoverlay=gpio-fan", &[]),
        ("[pi5]\ndtoverlay=gpio-fan", &[]),
        ("[none]\ndtoverlay=gpio-fan", &[]),
        // It may apply.
        ("[EDID=x]\ndtoverlay=gpio-fan", &["GPIO12"]),
        ("[pi5]\n[all]\ndtoverlay=gpio-fan", &["GPIO12"]),
    ] {
        assert_eq!(lines_of(text), lines, "{text}");
    }
}

/// The firmware takes another overlay on a Raspberry Pi 5.
#[test]
fn overlays_of_a_raspberry_pi_5() {
    let tree = pi4(&[(
        "boot/firmware/config.txt",
        "dtoverlay=uart2\ndtparam=ctsrts\n[pi5]\ndtoverlay=spi3-1cs\n[pi4]\ndtoverlay=gpio-fan\n",
    )]);
    tree.put("proc/device-tree/model", "Raspberry Pi 5 Model B Rev 1.0\0");
    let lines: Vec<String> = uses(&tree).sorted().map(|one| one.what.to_string()).collect();
    assert_eq!(lines, ["GPIO4", "GPIO4", "GPIO5", "GPIO5", "GPIO6", "GPIO6", "GPIO7", "GPIO7"]);
}

/// An overlay of the table has names that a reader can find, once each.
#[test]
fn the_table_of_overlays_is_whole() {
    let table = include_str!("overlays.txt");
    let names: Vec<&str> = table
        .lines()
        .filter(|line| !line.starts_with('#') && !line.is_empty())
        .map(|line| line.split(' ').next().unwrap())
        .collect();
    let mut once = names.clone();
    once.sort_unstable();
    once.dedup();
    assert_eq!(once.len(), names.len());
    assert!(names.len() > 90, "{}", names.len());
    for name in names {
        assert!(!lines_of(&format!("dtoverlay={name}\n")).contains(&"anything".to_owned()), "{name}");
    }
}

#[test]
fn included_files_count_and_are_bounded() {
    let tree = pi4(&[
        ("boot/firmware/config.txt", "include extra.txt\n"),
        ("boot/firmware/extra.txt", "x=y\ndtoverlay=gpio-fan\n"),
    ]);
    assert_eq!(all(&tree), ["GPIO12 by overlay gpio-fan at /boot/firmware/extra.txt:2"]);
    tree.put("boot/firmware/extra.txt", "include config.txt\nx=y\n");
    assert!(all(&tree).is_empty());
    tree.put("etc/shadow", "dtoverlay=gpio-fan\n");
    tree.put("boot/firmware/config.txt", "include ../../etc/shadow\n");
    assert!(all(&tree).is_empty(), "not outside of its folder");
    tree.put("boot/firmware/config.txt", "dtoverlay=gpio-fan\n".repeat(100_000));
    assert_eq!(all(&tree).len(), USES_MAX, "a line each, and no more");
}

#[test]
fn overlays_of_other_boards() {
    let tree = Tree::empty();
    tree.put("proc/device-tree/model", "BigTreeTech CB1\0");
    let env = |text: &str| {
        tree.put("boot/armbianEnv.txt", format!("overlay_prefix=sun50i-h616\n{text}"));
        uses(&tree).sorted().map(|one| one.what.to_string()).collect::<Vec<_>>()
    };
    // The other chip selects are held, too.
    let spi =
        ["gpio71", "gpio75", "gpio77", "gpio230", "gpio231", "gpio232"].map(|line| format!("300b000.pinctrl/{line}"));
    assert_eq!(env("overlays=spidev1_1\n"), spi);
    assert_eq!(env("overlays=sun50i-h616-spidev1_1\n"), spi);
    assert_eq!(env("overlays=spi-spidev\nparam_spidev_spi_bus=1\nparam_spidev_spi_cs=1\n"), spi);
    assert_eq!(env("overlays=w1-gpio\nparam_w1_pin=PC9\n"), ["300b000.pinctrl/gpio73"]);
    assert_eq!(env("overlays=tft35_spi\n"), ["spidev1.1"]);
    assert_eq!(env("overlays=ws2812\n"), ["anything"]);
    assert!(env("#overlays=ws2812\n").is_empty());
}

#[test]
fn sections_of_this_computer_s_mcus_with_aliases() {
    let head = "[mcu]\nserial: /dev/serial/by-id/board\n[mcu host]\nserial: /tmp/klipper_host_mcu\n[mcu bed]\nserial: /tmp/klipper_host_bed\n";
    let printed = |text: &str| all(&pi4(&[("CONFIG/printer.cfg", &format!("{head}{text}"))]));
    let place = format!("/{CONFIG}/printer.cfg");
    assert_eq!(printed("[output_pin a]\npin: !host:gpio17\n"), [format!("GPIO17 by [output_pin a] at {place}:8")]);
    assert_eq!(
        printed("[board_pins x]\nmcu: host\naliases: RELAY=GPIO22\n[output_pin a]\npin: host:RELAY\n"),
        [format!("GPIO22 by [output_pin a] at {place}:11")]
    );
    assert_eq!(
        printed("[stepper_x]\nenable_pin: !host:gpio17\nstep_pin: host:gpio1\n"),
        [format!("GPIO1 by [stepper_x] at {place}:9"), format!("GPIO17 by [stepper_x] at {place}:8")],
        "gpio17 has gpio1 in it"
    );
    // Other computers' MCUs, and boards.
    assert!(
        printed("[output_pin a]\npin: bed:GPIO17\n[output_pin b]\npin: gpio17\n[mcu x]\nserial: /dev/ttyS0\n")
            .is_empty()
    );
    for (text, what) in [
        ("[adxl345]\ncs_pin: host:None\nspi_bus: spidev0.1\n", "spidev0.1"),
        ("[neopixel a]\npin: host:spidev0.0\n", "spi0"),
        ("[load_cell]\nsclk_pin: host:spidev0.0\ndout_pin: host:spidev0.0/miso\n", "spi0"),
        ("[bme280]\ni2c_mcu: host\ni2c_bus: i2c.1\ni2c_address: 118\n", "i2c.1 0x76"),
        ("[temperature_sensor a]\nserial_no: 28-0316a4f1ff27\n", "28-0316a4f1ff27"),
        ("[fan]\npin: host:fe20c000.pwm/pwm0\n", "fe20c000.pwm/pwm0"),
        ("[tmc2209 a]\nuart_pin: host:ttyAMA3\n", "ttyAMA3"),
    ] {
        let printed = printed(text);
        assert!(printed.iter().any(|line| line.starts_with(&format!("{what} by ["))), "{what}: {printed:?}");
    }
    assert!(printed("[bme280]\ni2c_bus: i2c.1\n").is_empty(), "on the board");
    // Options and variables that only sound like pins.
    let alone = "[mcu]\nserial: /tmp/klipper_host_mcu\n[bltouch]\npin_move_time: 0.680\n[gcode_macro A]\nvariable_a_pin: gpio5\ngcode:\n  M117\n[fan]\npin: GPIO_GCLK\n";
    let tree = pi4(&[("CONFIG/printer.cfg", alone)]);
    assert!(all(&tree).is_empty() && uses(&tree).no_lines.is_empty(), "{:?}", uses(&tree).no_lines);
}

#[test]
fn a_second_instance_of_this_computer_counts_and_a_simulated_one_does_not() {
    let tree = pi4(&[
        (
            "home/pi/printer_2_data/config/printer.cfg",
            "[mcu p]\nserial: /tmp/klipper_host_second\n[output_pin a]\npin: p:GPIO27\n",
        ),
        ("usr/lib/systemd/system/pinion-mcu@.service", "[Service]\nExecStart=/usr/bin/pinion run\n"),
    ]);
    assert!(all(&tree).is_empty(), "it may be on another computer");
    tree.link(
        "etc/systemd/system/multi-user.target.wants/pinion-mcu@second.service",
        "/usr/lib/systemd/system/pinion-mcu@.service",
    );
    assert_eq!(all(&tree).len(), 1, "{:?}", all(&tree));
    tree.put("etc/pinion/second.toml", "board = \"sim\"\n");
    assert!(all(&tree).is_empty());
}

#[test]
fn moonraker_and_crowsnest() {
    let moonraker = "[server]\nport: 7125\n[power psu]\ntype: gpio\npin: !gpiochip0/gpio17\n[button stop]\npin: ^gpio26\n[power x]\ntype: tplink_smartplug\n";
    let tree =
        pi4(&[("CONFIG/moonraker.conf", moonraker), ("CONFIG/crowsnest.conf", "[cam 1]\ndevice: /dev/video0\n")]);
    assert_eq!(
        all(&tree),
        [
            format!("GPIO17 by Moonraker's [power psu] at /{CONFIG}/moonraker.conf:5"),
            format!("GPIO26 by Moonraker's [button stop] at /{CONFIG}/moonraker.conf:7"),
            format!("/dev/video0 by crowsnest's [cam 1] at /{CONFIG}/crowsnest.conf:2"),
        ]
    );
}

#[test]
fn the_kernel_s_drivers_and_consumers() {
    let board = boards::pi4();
    let tree = board.tree();
    tree.link("sys/bus/spi/devices/spi0.0/driver", "../../../bus/spi/drivers/mcp251x");
    tree.link("sys/bus/spi/devices/spi0.1/driver", "../../../bus/spi/drivers/spidev");
    tree.put("sys/bus/i2c/devices/1-0068/name", "ds3231");
    tree.link("sys/bus/i2c/devices/1-0068/driver", "../../drivers/rtc-ds1307");
    tree.put("sys/class/pwm/pwmchip0/pwm1/period", "0");
    tree.put("sys/class/tty/console/active", "tty1 ttyAMA0\n");
    let mut inventory = board.inventory(&tree);
    for (line, consumer) in [(17, "relay"), (8, "spi0 CS0"), (22, "pinion")] {
        let line = &mut inventory.chips[0].lines[line];
        (line.held, line.consumer) = (true, Some(consumer.to_owned()));
    }
    let computer = tree.computer();
    let board = Board::of(&computer, None).unwrap();
    let uses = Uses::find(&computer, board.as_ref(), None, Some(&inventory));
    let all: Vec<String> =
        uses.sorted().map(|one| format!("{} by {} {:?}", one.what, one.user, one.function)).collect();
    assert_eq!(
        all,
        [
            "GPIO8 by spi0 CS0 Some(\"spi0\")",
            "GPIO17 by relay None",
            "spidev0.0 by driver mcp251x None",
            "i2c.1 0x68 by driver rtc-ds1307 None",
            "fe20c000.pwm/pwm1 by a program None",
            "ttyAMA0 by the kernel's messages None",
        ]
    );
}

#[test]
fn a_line_has_one_name() {
    let names = |model: &str| {
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", format!("{model}\0"));
        let computer = tree.computer();
        let board = Board::of(&computer, None).unwrap();
        (Names::of(&computer, board.as_ref(), None), board)
    };
    let (pi, board) = names("Raspberry Pi 4 Model B Rev 1.4");
    for name in ["GPIO17", "gpio17", "gpiochip0/gpio17", "pinctrl-bcm2711/gpio17"] {
        assert_eq!(pi.line(name).as_deref(), Some("GPIO17"), "{name}");
    }
    assert_eq!(pi.line("gpiochip2/gpio8").as_deref(), Some("gpiochip2/gpio8"));
    assert_eq!([pi.line("GPIO99"), pi.line("gpio529"), pi.line("PC7"), pi.line("")], [const { None }; 4]);
    let meant = |name: &str| pi.meant(name, board.as_ref());
    assert_eq!(meant("gpio529").as_deref(), Some("GPIO17"), "sysfs begins at 512");
    assert_eq!(meant("11").as_deref(), Some("GPIO17"), "a pin of the header");
    assert_eq!(meant("pin40").as_deref(), Some("GPIO21"));
    let (pi5, _) = names("Raspberry Pi 5 Model B Rev 1.0");
    for name in ["GPIO17", "gpiochip4/gpio17", "gpiochip0/gpio17", "pinctrl-rp1/gpio17"] {
        assert_eq!(pi5.line(name).as_deref(), Some("GPIO17"), "{name}");
    }
    let (cb1, _) = names("BigTreeTech CB1");
    for (name, line) in
        [("PG19", "300b000.pinctrl/gpio211"), ("PC10", "300b000.pinctrl/gpio74"), ("PL2", "7022000.pinctrl/gpio2")]
    {
        assert_eq!((cb1.line(name), cb1.meant(name, None).as_deref()), (None, Some(line)), "{name}");
    }
    assert_eq!(cb1.line("gpio74"), cb1.line("300b000.pinctrl/gpio74"));
    assert_eq!(cb1.line("gpio288"), None, "it has fewer lines");
    let (cb2, _) = names("BigTreeTech CB2");
    for (name, line) in [("GPIO4_B2", "gpiochip4/gpio10"), ("1-C7", "gpiochip1/gpio23")] {
        assert_eq!((cb2.line(name), cb2.meant(name, None).as_deref()), (None, Some(line)), "{name}");
    }
    assert_eq!([cb2.line("gpiochip1/gpio32"), cb2.meant("GPIO9_Z9", None)], [const { None }; 2]);
}

/// Files of somebody, which may be anything.
#[test]
fn hostile_files_end_at_once() {
    let tree = pi4(&[]);
    for name in ["moonraker.conf", "crowsnest.conf"] {
        tree.put(&format!("{CONFIG}/{name}"), "[include *.conf]\n[power a]\npin: \u{1b}[2J\n");
    }
    tree.put(
        "boot/firmware/config.txt",
        [b"dtoverlay=\xff,=,,=\ndtparam=\xff\n[\n[]\ninclude\n".as_slice(), &[0; 1000]].concat(),
    );
    let _ = all(&tree);
    // A link to a file of root's has no line that is shown.
    tree.put("etc/shadow", "root:secret\n");
    tree.link(&format!("{CONFIG}/../config/KlipperScreen.conf"), "/etc/shadow");
    assert!(!format!("{:?}", all(&tree)).contains("secret"));
}

/// Nobody knows what a configuration uses that cannot be read.
#[test]
fn a_configuration_with_a_mistake_may_use_anything() {
    let tree = pi4(&[("home/b/printer_data/config/printer.cfg", "no section\n")]);
    let told = "anything by unreadable configuration at /home/b/printer_data/config/printer.cfg";
    assert_eq!(all(&tree), [told]);
}

/// Somebody else's file cannot push the user's own out of the picture.
#[test]
fn the_uses_of_the_printer_itself_come_first() {
    let many: Vec<String> = (0..2 * USES_MAX).map(|n| format!("host:gpiochip9/gpio{n}")).collect();
    let many = format!("[multi_pin x]\npins: {}\n", many.join(", "));
    let head = "[mcu host]\nserial: /tmp/klipper_host_mcu\n";
    let tree = pi4(&[
        ("home/a/printer_data/config/printer.cfg", &format!("{head}{many}")),
        ("CONFIG/printer.cfg", &format!("{head}[output_pin heater]\npin: host:GPIO17\n")),
        ("CONFIG/moonraker.conf", "[power psu]\npin: gpio27\n"),
    ]);
    let computer = tree.computer();
    let board = Board::of(&computer, None).unwrap();
    let own = format!("/{CONFIG}/printer.cfg");
    let uses = Uses::find(&computer, board.as_ref(), Some((Path::new(&own), None)), None);
    assert_eq!(uses.all.len(), USES_MAX);
    for line in ["GPIO17", "GPIO27"] {
        assert_eq!(uses.of(&Resource::Line(line.into())).count(), 1, "{line}");
    }
}

/// An absolute link of a card leads to the card's file.
#[test]
fn links_stay_below_the_root() {
    let tree = pi4(&[(
        "srv/config/printer.cfg",
        "[mcu host]\nserial: /tmp/klipper_host_mcu\n[output_pin a]\npin: host:GPIO5\n",
    )]);
    tree.link("home/ratos/printer_data", "/srv");
    let own = all(&tree);
    assert_eq!(own.len(), 1, "{own:?}");
    assert!(own[0].starts_with("GPIO5 by [output_pin a]"));
    tree.link("home/x/printer.cfg", "/etc/../../../../etc/hostname");
    assert_eq!(all(&tree), own, "nothing of this computer");
}
