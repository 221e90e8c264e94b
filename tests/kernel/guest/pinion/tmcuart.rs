// SPDX-License-Identifier: GPL-3.0-or-later
//! The UART of stepper drivers on one wire, which is an output only part of the time.

use std::time::{Duration, Instant};

use nix::errno::Errno;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure};
use crate::trace::{Trace, Write};
use crate::uapi;

const WIRE: u32 = 3;
/// 10 kbaud: the test is about the line's direction and levels, not about the accuracy of an emulated computer.
const BIT_NS: u64 = 100_000;
const CONFIG: &str = "config_tmcuart oid=0 rx_pin=lab/gpio3 pull_up=1 tx_pin=lab/gpio3 bit_time=5000";
/// A read of register 2 of driver 0 (f5 00 02 c8), with start and stop bits.
const SENT: [u8; 5] = [0xea, 0x03, 0x48, 0x20, 0xe4];
const HEARD: [u8; 4] = [0xf5, 0x00, 0x02, 0xc8];

/// The writes of the last message. Pinion breaks off a message that an interruption has spoilt, and sends it again after
/// a pause that is longer than any byte.
fn last_message(writes: &[Write]) -> &[Write] {
    let pauses = |pair: &[Write]| pair[1].at_ns - pair[0].at_ns > 20 * BIT_NS;
    &writes[writes.windows(2).rposition(pauses).map_or(0, |before| before + 1)..]
}

/// The bytes that a UART receives: after a falling edge it samples the middle of each bit.
fn hear(writes: &[Write]) -> Vec<u8> {
    let level = |at: u64| writes.iter().rev().find(|write| write.at_ns <= at).is_none_or(|write| write.level);
    let (mut heard, mut from) = (Vec::new(), 0);
    while let Some(start) = writes.iter().find(|write| write.at_ns >= from && !write.level) {
        let middle = |bit: u64| start.at_ns + bit * BIT_NS + BIT_NS / 2;
        assert!(level(middle(9)), "no stop bit after {heard:02x?}");
        heard.push((1..9).rev().fold(0, |byte, bit| byte << 1 | u8::from(level(middle(bit)))));
        from = middle(9);
    }
    heard
}

#[test]
fn a_single_wire_is_driven_for_the_message_and_let_go_for_the_reply() {
    message_and_reply(&Program::start());
}

fn message_and_reply(program: &Program) {
    let sim = GpioSim::new("lab", 8);
    let client = &mut program.connect();
    configure(client, 1, &[CONFIG]);
    let is_output = || uapi::line_info(&sim.path(), WIRE).flags & uapi::IS_OUT != 0;
    assert!(is_output() && sim.level(WIRE));
    // Twice: the second message finds the wire driven again.
    for _ in 0..2 {
        // An output ignores this. As an input it has the pull-up, which gpio-sim shows.
        sim.pull(WIRE, false);
        let trace = Trace::start();
        let args = [("oid", 0_u8.into()), ("write", SENT[..].into()), ("read", 10_u8.into())];
        client.send("tmcuart_send", &args).expect("a session");
        let until = Instant::now() + Duration::from_secs(10);
        let reply = client.wait("tmcuart_response", Some(0), until).expect("a session").expect("a response");
        assert_eq!(reply.bytes("read").expect("bytes"), [0_u8; 0], "nobody answers");
        let writes = trace.writes_to(sim.kernel_number(WIRE));
        // The last write makes it an output again, after the driver's time to answer.
        let [message @ .., last] = &writes[..] else { panic!("{writes:?}") };
        assert_eq!(hear(last_message(message)), HEARD, "{writes:?}");
        assert!(sim.is_pulled_up(WIRE), "it never was an input: {writes:?}");
        let pause_ns = last.at_ns - message[message.len() - 1].at_ns;
        assert!(last.level && pause_ns > 10 * BIT_NS, "{writes:?}");
        assert!(is_output() && sim.level(WIRE));
    }
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn a_single_wire_is_let_go_on_linux_before_5_5() {
        message_and_reply(&Program::without_ioctl(uapi::GPIOHANDLE_SET_CONFIG, Errno::EINVAL));
    }
}
