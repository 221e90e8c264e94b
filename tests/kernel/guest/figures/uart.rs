// SPDX-License-Identifier: GPL-3.0-or-later
//! Messages to TMC drivers at 40 kbaud on a line without a UART: how many are spoilt at the first try.

use std::iter::once;
use std::thread::sleep;
use std::time::{Duration, Instant};

use pinion_client::config::Config;
use pinion_client::motion::Stepper;

use super::{Others, PULSE_TICKS, figure, is_pinion};
use crate::gpio_sim::GpioSim;
use crate::program::Program;
use crate::trace::{Trace, Write};

const MESSAGES: u32 = if cfg!(debug_assertions) { 20 } else { 500 };
const WIRE: u32 = 6;
const BIT_TICKS: u32 = 1250;
const BIT_NS: u64 = 25_000;
/// More bits without an edge than a message has.
const PAUSE_NS: u64 = 20 * BIT_NS;
/// A write of a register (`_encode_write` of klippy's tmc_uart.py).
const MESSAGE: [u8; 8] = [0xf5, 0x00, 0x90, 0x00, 0x06, 0x1a, 0x08, 0x3c];
/// 10 k/s, for six seconds.
const STEP_TICKS: u32 = 5000;
const STEPS: u16 = 60_000;

/// The bits of these bytes on the wire, as klippy sends them: the lowest bit of the first byte is the first.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let bits = |byte: &u8| once(false).chain((0..8).map(|n| byte >> n & 1 != 0).collect::<Vec<_>>()).chain(once(true));
    let bits: Vec<bool> = bytes.iter().flat_map(bits).collect();
    bits.chunks(8).map(|byte| byte.iter().rev().fold(0, |value, bit| value << 1 | u8::from(*bit))).collect()
}

/// Whether a driver receives the message from these writes: after each start bit it samples the middle of each bit.
fn is_whole(writes: &[Write]) -> bool {
    let Some(first) = writes.iter().position(|write| !write.level) else { return false };
    let writes = &writes[first..];
    let ends = writes.windows(2).position(|pair| pair[1].at_ns - pair[0].at_ns > PAUSE_NS);
    let first_try = &writes[..ends.map_or(writes.len(), |last| last + 1)];
    let level = |at: u64| first_try.iter().rev().find(|write| write.at_ns <= at).is_none_or(|write| write.level);
    let mut from = first_try[0].at_ns;
    MESSAGE.iter().all(|byte| {
        let start = first_try.iter().find(|write| write.at_ns >= from && !write.level);
        let Some(start) = start.map(|write| write.at_ns) else { return false };
        let bit = |number: u64| level(start + number * BIT_NS + BIT_NS / 2);
        from = start + 9 * BIT_NS + BIT_NS / 2;
        *byte == (1..9).rev().fold(0, |value, number| value << 1 | u8::from(bit(number))) && !bit(0) && bit(9)
    })
}

/// The share of messages that are spoilt at the first try, in percent.
fn spoilt(steps: bool) -> f64 {
    let sim = GpioSim::new("lab", 8);
    let program = Program::measured();
    let client = &mut program.connect();
    let mut config = Config::default();
    let pin = |line: u32| format!("{}/gpio{line}", sim.chip_name());
    let mut stepper = |line| Stepper::configure(&mut config, &pin(line), -1, &pin(line + 1), false, PULSE_TICKS);
    let steppers: Vec<Stepper> = [0, 2, 4].map(|line| stepper(line).expect("few objects")).into();
    let uart = config.oid().expect("few objects");
    let wire = pin(WIRE);
    config.add(format!("config_tmcuart oid={uart} rx_pin={wire} pull_up=0 tx_pin={wire} bit_time={BIT_TICKS}"));
    config.apply(client).expect("a configuration");
    if steps {
        let start = client.clock_in(0.1).expect("a session");
        for stepper in &steppers {
            let args = [("oid", stepper.oid.into()), ("clock", start.into())];
            client.send("reset_step_clock", &args).expect("a session");
            let args = [
                ("oid", stepper.oid.into()),
                ("interval", STEP_TICKS.into()),
                ("count", STEPS.into()),
                ("add", 0_u8.into()),
            ];
            client.send("queue_step", &args).expect("a session");
        }
        sleep(Duration::from_millis(200));
    }
    let bits = framed(&MESSAGE);
    let trace = Trace::of_line(sim.kernel_number(WIRE));
    let (mut seen, mut spoilt) = (0, 0);
    for number in 0..MESSAGES {
        // At any time of the kernel's tick.
        sleep(Duration::from_micros(2000 + u64::from(number * 1301 % 4000)));
        let args = [("oid", uart.into()), ("write", bits[..].into()), ("read", 0_u8.into())];
        client.send("tmcuart_send", &args).expect("a session");
        let until = Instant::now() + Duration::from_secs(10);
        client.wait("tmcuart_response", Some(uart), until).expect("a session").expect("a response");
        let writes = trace.writes();
        spoilt += u32::from(!is_whole(&writes[seen..]));
        seen = writes.len();
    }
    100.0 * f64::from(spoilt) / f64::from(MESSAGES)
}

#[test]
fn messages_are_spoilt() {
    const OF: &str = "TMC UART on a line: messages of 80 bits that are spoilt at the first try, %";
    let measure = |case: &str, steps: bool| {
        let percent = spoilt(steps);
        figure(OF, case, &format!("{percent:.1}"));
        percent
    };
    // Core and worker share the only processor: steps interrupt a message.
    let within = |case: &str| {
        let percent = measure(case, false);
        assert!(!is_pinion() || percent <= 5.0, "{case}: {percent} %");
    };
    within("alone");
    measure("3 steppers, 10 k/s", true);
    let _others = Others::start();
    within("beside programs that copy and compress");
    measure("3 steppers, 10 k/s, beside them", true);
}
