// SPDX-License-Identifier: GPL-3.0-or-later
//! Lines through the chip's registers: which ones are, beside the kernel's driver, and at what cost.

use std::fs;
use std::process::Command;

use gpio_cdev::{Chip, LineRequestFlags};
use pinion_client::config::Config;
use pinion_firmware::time::CLOCK_FREQ;

use super::homing::{STEP, axis, profile};
use super::outside::Outside;
use super::program::{LINK, Pinion, Way, both_ways};

/// A line that no test gives to Pinion.
const OTHER: u32 = 27;
/// See `TIME` in `tests/raspberry_pi/vm.rs`.
const NS_PER_INSTRUCTION: f64 = 4.0;

fn configure(pinion: &Pinion) {
    let mut client = pinion.client();
    let mut config = Config::default();
    let oid = config.oid().unwrap();
    config.add(format!("config_digital_out oid={oid} pin=gpio22 value=0 default_value=0 max_duration=0"));
    config.apply(&mut client).expect("a configuration");
}

/// The output of `pinion` with these arguments, on stdout and stderr.
fn printed(words: &[&str]) -> String {
    let output = Command::new("pinion").args(words).output().expect("pinion on the path");
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

#[test]
fn the_log_and_the_status_say_which_lines_are_fast() {
    let pinion = Pinion::start(Way::Registers);
    configure(&pinion);
    pinion.wait_for_line("gpiochip0: lines are written and read through /dev/mem");
    let status = printed(&["status", "-I", LINK]);
    assert!(status.lines().any(|line| line.contains("gpio22") && line.ends_with("fast")), "{status}");
}

#[test]
fn without_the_node_lines_go_through_the_kernel_and_the_log_says_why() {
    for (wish, level) in [("auto", "INFO"), ("on", "WARN")] {
        let pinion = Pinion::with(wish);
        configure(&pinion);
        let line = pinion.wait_for_line("gpiochip0: lines are written through the kernel");
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

#[test]
fn an_edge_through_registers_costs_a_tenth() {
    let text = printed(&["latency", "--pin", "GPIO27", "--fast-gpio", "/dev/mem"]);
    println!("{text}");
    let ns = |way: &str| -> f64 {
        let line = text.lines().find_map(|line| line.trim_start().strip_prefix(way)).expect("a cost");
        line.split_whitespace().next().and_then(|ns| ns.parse().ok()).expect("a number")
    };
    let (kernel, registers) = (ns("kernel"), ns("registers"));
    println!(
        "instructions an edge: {:.0} through the kernel, {:.0} through registers",
        kernel / NS_PER_INSTRUCTION,
        registers / NS_PER_INSTRUCTION
    );
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

/// The core's cost of steps of three steppers.
struct Cost {
    /// Instructions of the core for each edge.
    instructions: f64,
    /// The status of its timers: how late they were, and the margin.
    lateness: serde_json::Value,
}

impl Cost {
    fn us(&self, key: &str) -> f64 {
        self.lateness[key].as_f64().expect("a time")
    }
}

/// For a second, each stepper makes a step on both edges every `interval` ticks.
fn cost_of_steps(way: Way, interval: u32) -> Cost {
    let steps = CLOCK_FREQ / interval;
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    let mut config = Config::default();
    let lines = [(5, 12), (6, 16), (13, 19)];
    for (step, dir) in lines {
        let oid = config.oid().unwrap();
        config.add(format!(
            "config_stepper oid={oid} step_pin=gpio{step} dir_pin=gpio{dir} invert_step=-1 step_pulse_ticks=100"
        ));
    }
    config.apply(&mut client).expect("a configuration");
    let start = client.clock_in(0.3).unwrap().wire();
    for oid in 0..lines.len() {
        client.send_line(&format!("reset_step_clock oid={oid} clock={start}")).unwrap();
        client.send_line(&format!("queue_step oid={oid} interval={interval} count={steps} add=0")).unwrap();
    }
    let before = pinion.core_ns();
    std::thread::sleep(std::time::Duration::from_millis(1500));
    let spent = pinion.core_ns() - before;
    let mut status: serde_json::Value =
        serde_json::from_str(&printed(&["status", "--json", "-I", LINK])).expect("a status");
    assert_eq!(status["shutdown"], serde_json::Value::Null);
    let edges = steps * lines.len() as u32;
    Cost { instructions: spent as f64 / NS_PER_INSTRUCTION / f64::from(edges), lateness: status["lateness"].take() }
}

/// The core sleeps and spins between steps, whatever way an edge goes.
#[test]
fn steps_through_registers_cost_less() {
    println!("k/s  way        instructions an edge   late by p50 / p99, us   margin, us");
    for interval in [50_000, 5_000] {
        let costs = [Way::Kernel, Way::Registers].map(|way| {
            let cost = cost_of_steps(way, interval);
            let (p50, p99, margin) = (cost.us("p50_us"), cost.us("p99_us"), cost.us("margin_us"));
            let rate = CLOCK_FREQ / interval / 1000;
            println!("{rate:3}  {way:<10?} {:20.0}   {p50:8.2} / {p99:.2} {margin:18.1}", cost.instructions);
            cost
        });
        assert!(costs[1].instructions < costs[0].instructions);
    }
}

/// The kernel's own writes and reads, by its tracepoint gpio_value: a "set" or a "get" for each call of any
/// program.
struct Calls;

impl Calls {
    const TRACE: &str = "/sys/kernel/tracing/trace";

    fn count() -> Calls {
        const ENABLE: &str = "/sys/kernel/tracing/events/gpio/gpio_value/enable";
        if fs::metadata(ENABLE).is_err() {
            Command::new("mount").args(["-t", "tracefs", "none", "/sys/kernel/tracing"]).status().expect("mount");
        }
        fs::write(ENABLE, "1").expect("the tracepoint");
        fs::write(Calls::TRACE, "").expect("an empty trace");
        Calls
    }

    /// How often the kernel has written lines, and read lines, since [`Calls::count`].
    fn so_far(&self) -> (usize, usize) {
        let trace = fs::read_to_string(Calls::TRACE).expect("the trace");
        let events = trace.lines().filter(|line| line.contains("gpio_value:"));
        let (set, get): (Vec<_>, Vec<_>) = events.partition(|line| line.contains(" set "));
        (set.len(), get.len())
    }
}

/// A software SPI reads its own bits here, an I2C bus has no chip, and an HX711 is always ready.
fn bit_banged_buses_and_an_hx711_use_the_registers_by_themselves(way: Way) {
    const CONFIG: [&str; 7] = [
        "allocate_oids count=3",
        "config_spi_without_cs oid=0",
        "spi_set_sw_bus oid=0 miso_pin=gpio22 mosi_pin=gpio22 sclk_pin=gpio23 mode=0 pulse_ticks=100",
        "config_i2c oid=1",
        "i2c_set_sw_bus oid=1 scl_pin=gpio5 sda_pin=gpio6 pulse_ticks=250 address=60",
        "config_hx71x oid=2 gain_channel=1 dout_pin=gpio12 sclk_pin=gpio13",
        "finalize_config crc=1",
    ];
    let mut outside = Outside::new();
    outside.drive(12, true);
    let pinion = Pinion::start(way);
    let mut client = pinion.client();
    CONFIG.iter().for_each(|line| client.send_line(line).expect(line));
    client.query("get_uptime", &[], "uptime", None).expect("a configured micro-controller");
    let check = |(set, get): (usize, usize), name: &str| {
        println!("{name}, {way:?}: the kernel wrote {set} times and read {get} times");
        match way {
            Way::Kernel => assert!(set > 30 && get > 15, "{name}"),
            Way::Registers => assert_eq!((set, get), (0, 0), "{name}"),
        }
    };

    let calls = Calls::count();
    let sent = [("oid", 0u8.into()), ("data", (&[0x3a_u8, 0xc5][..]).into())];
    client.query("spi_transfer", &sent, "spi_transfer_response", Some(0)).expect("an answer");
    check(calls.so_far(), "SPI");

    let calls = Calls::count();
    let asked = [("oid", 1u8.into()), ("write", (&[0_u8][..]).into()), ("read_len", 1u8.into())];
    client.query("i2c_transfer", &asked, "i2c_response", Some(1)).expect("an answer");
    let (set, get) = calls.so_far();
    println!("I2C, {way:?}: the kernel wrote {set} times and read {get} times");
    // Only the kernel turns an open drain.
    assert!(set > 0 && (get == 0) == matches!(way, Way::Registers), "I2C");

    client.send_line("query_hx71x oid=2 rest_ticks=500000").expect("a query");
    client.query("get_uptime", &[], "uptime", None).expect("it measures");
    let before = outside.edges(13).len();
    let calls = Calls::count();
    outside.drive(12, false);
    super::gpio::until("two samples are read", || outside.edges(13).len() >= before + 100);
    check(calls.so_far(), "HX711");
}
both_ways!(bit_banged_buses_and_an_hx711_use_the_registers_by_themselves);
