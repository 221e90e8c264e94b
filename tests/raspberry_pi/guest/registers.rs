// SPDX-License-Identifier: GPL-3.0-or-later
//! Lines through the chip's registers: which ones are, beside the kernel's driver, and at what cost.

use std::process::Command;

use gpio_cdev::{Chip, LineRequestFlags};
use pinion_client::config::Config;

use super::homing::{STEP, axis, profile};
use super::outside::Outside;
use super::program::{LINK, Pinion, Way};

/// A line that no test gives to Pinion.
const OTHER: u32 = 27;

fn configure(pinion: &Pinion) {
    let mut client = pinion.client();
    let mut config = Config::default();
    let oid = config.oid().unwrap();
    config.add(format!("config_digital_out oid={oid} pin=gpio22 value=0 default_value=0 max_duration=0"));
    config.apply(&mut client).expect("a configuration");
}

/// What `pinion` with these words prints, and says on stderr.
fn printed(words: &[&str]) -> String {
    let output = Command::new("pinion").args(words).output().expect("pinion on the path");
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

#[test]
fn the_log_and_the_status_say_which_lines_are_fast() {
    let pinion = Pinion::start(Way::Registers);
    configure(&pinion);
    let log = pinion.log();
    assert!(log.contains("gpiochip0: lines are written and read through /dev/mem"), "{log}");
    let status = printed(&["status", "-I", LINK]);
    assert!(status.lines().any(|line| line.contains("gpio22") && line.ends_with("fast")), "{status}");
}

#[test]
fn without_the_node_lines_go_through_the_kernel_and_the_log_says_why() {
    for (wish, level) in [("auto", "INFO"), ("on", "WARN")] {
        let pinion = Pinion::with(wish);
        configure(&pinion);
        let log = pinion.log();
        let line = log.lines().find(|line| line.contains("gpiochip0: lines are written through the kernel")).unwrap();
        assert!(line.contains("/dev/gpiomem: No such file or directory"), "{line}");
        assert!(line.ends_with("only Raspberry Pi's own kernel has this node: install it"), "{line}");
        assert!(line.contains(level), "{line}");
        let status = printed(&["status", "-I", LINK]);
        assert!(!status.contains("fast"), "{status}");
    }
}

/// The kernel's driver writes a line of the same bank at the same time. Neither loses an edge.
#[test]
fn registers_and_the_driver_write_neighbours_of_one_bank() {
    const EDGES: usize = 2000;
    const STEPS: u32 = 100;
    let mut outside = Outside::new();
    let pinion = Pinion::start(Way::Registers);
    let mut client = pinion.client();
    let (stepper, _, mut queue) = axis(&mut client);
    let line = Chip::new("/dev/gpiochip0").and_then(|mut chip| chip.get_line(OTHER)).expect("a line");
    let line = line.request(LineRequestFlags::OUTPUT, 0, "test").expect("a free line");
    let steps = profile(&client, STEPS);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for edge in 0..EDGES {
                line.set_value(u8::from(edge % 2 == 0)).expect("an edge");
                // Over the whole move, which takes more than a second.
                std::thread::sleep(std::time::Duration::from_micros(500));
            }
        });
        queue.run(&mut client, stepper, true, &steps, None).expect("a move");
    });
    assert_eq!(outside.edges(STEP), "10".repeat(STEPS as usize));
    assert_eq!(outside.edges(OTHER), "10".repeat(EDGES / 2));
    assert_eq!(stepper.position(&mut client).unwrap(), i64::from(STEPS));
}

/// An instruction takes 4 ns of the guest's time.
#[test]
fn an_edge_through_registers_costs_a_tenth() {
    let text = printed(&["latency", "--pin", "GPIO27", "--fast-gpio", "/dev/mem"]);
    println!("{text}");
    let ns = |way: &str| -> f64 {
        let line = text.lines().find_map(|line| line.trim_start().strip_prefix(way)).expect("a cost");
        line.split_whitespace().next().and_then(|ns| ns.parse().ok()).expect("a number")
    };
    let (kernel, registers) = (ns("kernel"), ns("registers"));
    println!("instructions an edge: {:.0} through the kernel, {:.0} through registers", kernel / 4.0, registers / 4.0);
    assert!(registers < kernel / 10.0);
}

#[test]
fn the_cost_of_an_edge_is_not_measured_on_a_line_that_somebody_holds() {
    let line = Chip::new("/dev/gpiochip0").and_then(|mut chip| chip.get_line(OTHER)).expect("a line");
    let _held = line.request(LineRequestFlags::INPUT, 0, "heater").expect("a free line");
    let mut outside = Outside::new();
    let text = printed(&["latency", "--pin", "GPIO27", "--fast-gpio", "/dev/mem"]);
    assert!(text.contains("GPIO27 is in use by heater: choose a free line"), "{text}");
    assert!(printed(&["latency", "--pin", "GPIO99"]).contains("there is no line GPIO99"));
    assert_eq!(outside.edges(OTHER), "");
}
