// SPDX-License-Identifier: GPL-3.0-or-later
//! The UART of stepper drivers, on one wire, on two, and on a serial port. The test plays the driver.

use pinion_firmware::board::{Bias, Direction};
use proptest::prelude::*;

use pinion_testbench::board::{Edge, SERIAL};
use pinion_testbench::rig::{Rig, hex};
use std::sync::{Arc, Mutex};

const TX: u32 = 10;
const RX: u32 = 11;
/// 40 kbaud.
const BIT: u64 = 1250;
/// Quiet time from the command to the first bit: 200 us.
const QUIET: u64 = 10_000;

const ONE_WIRE: &str = "config_tmcuart oid=0 rx_pin=10 pull_up=1 tx_pin=10 bit_time=1250";
const TWO_WIRES: &str = "config_tmcuart oid=0 rx_pin=11 pull_up=0 tx_pin=10 bit_time=1250";

/// Bytes with a start bit (0) and a stop bit (1) each, lowest bit first, like `_add_serial_bits` of klippy's
/// tmc_uart.py.
fn with_serial_bits(message: &[u8]) -> Vec<u8> {
    let mut bits = Vec::new();
    for byte in message {
        bits.push(false);
        bits.extend((0..8).map(|n| byte >> n & 1 != 0));
        bits.push(true);
    }
    bits.chunks(8).map(|bits| bits.iter().rev().fold(0, |byte, bit| byte << 1 | u8::from(*bit))).collect()
}

/// The bytes that a UART hears. This receiver waits for a falling edge and reads each bit in its middle.
fn hear(edges: &[Edge], bit: u64) -> Vec<u8> {
    let level = |at: u64| edges.iter().rev().find(|(from, _)| *from <= at).is_none_or(|(_, level)| *level != 0);
    let mut heard = Vec::new();
    let mut from = 0;
    while let Some((start, _)) = edges.iter().find(|(at, level)| *at >= from && *level == 0) {
        let middle = |n: u64| start + n * bit + bit / 2;
        assert!(level(middle(9)), "no stop bit after {heard:?}");
        heard.push((1..9).rev().fold(0, |byte, n| byte << 1 | u8::from(level(middle(n)))));
        from = middle(9);
    }
    heard
}

/// The levels of a driver that sends this message from a given time on, with bits of its own length.
fn speak(message: &[u8], from: u64, bit: f64) -> Vec<Edge> {
    let mut levels = vec![(0, 1)];
    for (byte, n) in message.iter().zip(0u32..) {
        let at = |bits: u32| from + (f64::from(10 * n + bits) * bit) as u64;
        levels.push((at(0), 0));
        levels.extend((0..8).map(|place| (at(1 + place), byte >> place & 1)));
        levels.push((at(9), 1));
    }
    levels
}

fn send(message: &[u8], read: u8) -> String {
    format!("tmcuart_send oid=0 write={} read={read}", hex(&with_serial_bits(message)))
}

fn response(bytes: &[u8]) -> String {
    format!("tmcuart_response oid=0 read={}", hex(bytes))
}

const READ_IFCNT: &[u8] = &[0xf5, 0x00, 0x02, 0xc8];
const IFCNT: &[u8] = &[0x05, 0xff, 0x02, 0x00, 0x00, 0x00, 0x07, 0xe2];

proptest! {
    /// A message at the rates of several drivers arrives. The answer comes when its last stop bit is over.
    #[test]
    fn any_bytes_arrive(message in proptest::collection::vec(any::<u8>(), 1..=8), one_wire: bool, bit in 100u64..6000) {
        let rx = if one_wire { TX } else { RX };
        let mut rig = Rig::configured(&[&format!("config_tmcuart oid=0 rx_pin={rx} pull_up=0 tx_pin={TX} bit_time={bit}")]);
        rig.bench.forget_edges();
        rig.send(&send(&message, 0));
        // The answer also waits for the padding of the last byte.
        let bits = with_serial_bits(&message).len() as u64 * 8;
        rig.run_until(QUIET + bits * bit - 1);
        prop_assert_eq!(rig.responses(), [""; 0]);
        rig.run_until(QUIET + bits * bit);
        prop_assert_eq!(rig.responses(), [response(&[])]);
        let edges = rig.edges(TX);
        prop_assert_eq!(edges[0], (QUIET, 0));
        prop_assert!(edges.iter().all(|(at, _)| (at - QUIET).is_multiple_of(bit)), "{:?}", edges);
        // Padding bits in the last byte are low, and a UART takes them for another byte.
        let heard = hear(&edges, bit);
        prop_assert_eq!(&heard[..message.len()], &message[..]);
        prop_assert!(rig.bench.level(TX));
    }

    /// A reply is read wherever its start bit lies, even if the driver's clock is off by 4 %.
    #[test]
    fn a_reply_arrives(
        message: [u8; 8], wait in 0u64..60 * BIT, off in 0.96..1.04f64, one_wire: bool,
    ) {
        let (config, rx) = if one_wire { (ONE_WIRE, TX) } else { (TWO_WIRES, RX) };
        let mut rig = Rig::configured(&[config]);
        // Four bits of silence: Klipper's C does not listen then.
        let from = QUIET + 44 * BIT + wait + 200;
        rig.bench.script_input(rx, &speak(&message, from, BIT as f64 * off));
        rig.send(&send(READ_IFCNT, 10));
        rig.run_until(10_000_000);
        prop_assert_eq!(rig.responses(), [response(&with_serial_bits(&message))]);
        prop_assert_eq!(hear(&rig.edges(TX), BIT), READ_IFCNT);
    }
}

proptest! {
    /// A glitch shorter than half a bit is no start bit. It may come before the reply, or in the stop bit between two
    /// bytes.
    #[test]
    fn a_glitch_starts_no_byte(
        message: [u8; 8], at in 20u64..60 * BIT, width in 100u64..BIT / 2 - 80, gap in 0u64..BIT / 16,
    ) {
        let mut rig = Rig::configured(&[TWO_WIRES]);
        let from = QUIET + 44 * BIT + 200;
        let reply = from + at + width + BIT;
        let mut levels = speak(&message, reply, BIT as f64);
        levels.extend([(from + at, 0), (from + at + width, 1)]);
        // In the stop bit of the third byte, after its middle. The driver pauses there for a moment.
        let stop = reply + 29 * BIT;
        let glitch = stop + 5 * BIT / 8 + gap;
        levels.retain(|(at, _)| *at <= stop);
        levels.extend([(glitch, 0), (glitch + width / 2, 1)]);
        levels.extend(speak(&message[3..], stop + 21 * BIT / 16, BIT as f64).drain(1..));
        levels.sort_by_key(|(at, _)| *at);
        rig.bench.script_input(RX, &levels);
        rig.send(&send(READ_IFCNT, 10));
        rig.run_until(10_000_000);
        prop_assert_eq!(rig.responses(), [response(&with_serial_bits(&message))]);
    }
}

#[test]
fn a_glitch_alone_is_no_reply() {
    let mut rig = Rig::configured(&[TWO_WIRES]);
    let at = QUIET + 60 * BIT;
    rig.bench.script_input(RX, &[(0, 1), (at, 0), (at + BIT / 3, 1)]);
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(1_000_000);
    assert_eq!(rig.responses(), [response(&[])]);
}

#[test]
fn serial_bits_are_klippys() {
    // The bytes of klippy's _encode_read(0xf5, 0, 2).
    assert_eq!(with_serial_bits(READ_IFCNT), [0xea, 0x03, 0x48, 0x20, 0xe4]);
}

#[test]
fn a_single_wire_is_driven_but_while_it_listens() {
    let mut rig = Rig::configured(&[ONE_WIRE]);
    let direction = |rig: &Rig| rig.bench.state().directions[&TX];
    let idle = Direction::at_rest(true);
    assert_eq!(direction(&rig), idle);
    rig.bench.state().turns.clear();
    rig.bench.script_input(TX, &speak(IFCNT, QUIET + 72 * BIT, 1250.0));
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(1_000_000);
    assert_eq!(direction(&rig), idle);
    assert_eq!(rig.bench.state().turns, [(TX, Direction::Input(Bias::PullUp)), (TX, idle)]);
    assert_eq!(rig.responses(), [response(&with_serial_bits(IFCNT))]);
}

#[test]
fn without_a_reply_the_answer_is_empty() {
    for (level, what) in [(1, "nobody speaks"), (0, "the wire has no supply")] {
        let mut rig = Rig::configured(&[TWO_WIRES]);
        rig.bench.script_input(RX, &[(0, level)]);
        rig.send(&send(READ_IFCNT, 10));
        let end = QUIET + (40 + 4 + 65) * BIT;
        rig.run_until(end - 1);
        assert_eq!(rig.responses(), [""; 0], "{what}");
        rig.run_until(end + BIT);
        assert_eq!(rig.responses(), [response(&[])], "{what}");
        // The UART can be asked again.
        rig.send(&send(READ_IFCNT, 10));
        rig.run_until(1_000_000);
        assert_eq!(rig.responses(), [response(&[])], "{what}");
    }
}

/// If only one write is slow, the driver takes a bit for longer. If all writes are equally slow, it does not.
#[test]
fn a_message_arrives_over_slow_lines() {
    for write_ticks in [50, 600] {
        let mut rig = Rig::configured(&[TWO_WIRES]);
        rig.bench.state().write_ticks = write_ticks;
        rig.send(&send(READ_IFCNT, 0));
        rig.run_until(1_000_000);
        assert_eq!(hear(&rig.edges(TX), BIT), READ_IFCNT);
        assert_eq!(rig.responses(), [response(&[])]);
    }
}

#[test]
fn rubbish_is_passed_on_for_klippy_to_refuse() {
    let mut rig = Rig::configured(&[TWO_WIRES]);
    rig.bench.script_input(RX, &[(0, 1), (QUIET + 50 * BIT, 0)]);
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(1_000_000);
    assert_eq!(rig.responses(), [response(&[0; 10])]);
}

#[test]
fn who_is_busy_does_not_listen() {
    let mut rig = Rig::configured(&[TWO_WIRES]);
    rig.send(&send(&[1, 2, 3], 0));
    // One before the first edge, one during the message.
    rig.send(&send(&[4], 0));
    rig.run_until(QUIET + 3 * BIT);
    rig.send(&send(&[5], 0));
    rig.run_until(1_000_000);
    assert_eq!(rig.responses(), [response(&[])]);
    assert_eq!(hear(&rig.edges(TX), BIT)[..3], [1, 2, 3]);
    rig.send(&send(&[6], 0));
    rig.run_until(2_000_000);
    assert_eq!(hear(&rig.edges(TX), BIT)[0], 6);
}

#[test]
fn commands_and_steps_do_not_wait_for_a_message() {
    let mut rig =
        Rig::configured(&[TWO_WIRES, "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100"]);
    rig.send_all(&["reset_step_clock oid=1 clock=@0", "queue_step oid=1 interval=1000 count=200 add=0"]);
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(QUIET + 5 * BIT);
    rig.begin("get_clock");
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.responses().len(), 1);
    rig.run_until(500_000);
    assert_eq!(rig.responses(), [response(&[])]);
    assert!(rig.edges(1).iter().step_by(2).zip(1..=200).all(|((at, _), n)| *at == 1000 * n));
}

#[test]
fn a_message_too_long_stops_the_mcu() {
    for command in ["tmcuart_send oid=0 write=0102030405060708090a0b read=0", "tmcuart_send oid=0 write=00 read=11"] {
        let mut rig = Rig::configured(&[TWO_WIRES]);
        rig.stops_on(command, "tmcuart data too large");
    }
}

#[test]
fn a_shutdown_leaves_the_line_high_and_says_nothing_more() {
    for at in [5_000, QUIET + 3 * BIT, QUIET + 60 * BIT] {
        let mut rig = Rig::configured(&[ONE_WIRE]);
        rig.send(&send(READ_IFCNT, 10));
        rig.run_until(at);
        rig.stops_on("emergency_stop", "Command request");
        rig.sends_until(1_000_000, &[]);
        assert!(rig.bench.level(TX) && !rig.mcu.has_pending_values());
        assert!(matches!(rig.bench.state().directions[&TX], Direction::Output { level: true, .. }));
        // The UART works in the next configuration.
        rig.send("config_reset");
        rig.configure(&[TWO_WIRES]);
        rig.edges(TX);
        rig.send(&send(&[0x55], 0));
        rig.run_until(2_000_000);
        assert_eq!(rig.responses(), [response(&[])]);
        assert_eq!(hear(&rig.edges(TX), BIT)[0], 0x55);
    }
}

#[test]
fn a_line_that_is_gone_stops_the_mcu() {
    for (pin, reason) in [(TX, "GPIO line write failed"), (RX, "GPIO line read failed")] {
        let mut rig = Rig::configured(&[TWO_WIRES]);
        rig.bench.state().broken.insert(pin);
        rig.send(&send(READ_IFCNT, 10));
        rig.stops_by(1_000_000, reason);
        rig.bench.state().broken.clear();
        rig.run_until(10_000_000);
        assert!(!rig.mcu.has_pending_values() && rig.bench.level(TX));
    }
}

#[test]
fn a_line_of_an_expander_is_refused() {
    for (config, sleeping) in [(ONE_WIRE, TX), (TWO_WIRES, TX), (TWO_WIRES, RX)] {
        let mut rig = Rig::new();
        rig.bench.state().sleeping.insert(sleeping);
        rig.send_all(&["allocate_oids count=1", config]);
        let text = rig.shutdown().unwrap();
        assert!(text.starts_with("Unable to open"), "{text}");
        assert!(rig.notes().iter().any(|note| note.contains("cannot be a UART pin")));
    }
}

/// How long a port waits for a byte: 79 bits and 50 ms.
const PORT_LIMIT: u64 = 79 * BIT + 2_500_000;

/// An MCU with a serial port, the messages that it sent, and the bytes that it receives after each of them.
fn port(mut answer: impl FnMut(&[u8]) -> Vec<u8> + Send + 'static) -> (Rig, Arc<Mutex<Vec<Vec<u8>>>>) {
    let mut rig = Rig::new();
    let sent: Arc<Mutex<Vec<Vec<u8>>>> = Arc::default();
    let log = sent.clone();
    rig.bench.plug_serial(SERIAL, move |_, bytes| {
        log.lock().unwrap().push(bytes.into());
        answer(bytes)
    });
    rig.configure(&["config_tmcuart oid=0 rx_pin=800 pull_up=1 tx_pin=800 bit_time=1250"]);
    (rig, sent)
}

proptest! {
    /// A reply arrives unchanged, with and without an echo. So does the message.
    #[test]
    fn any_bytes_arrive_over_a_port(
        message in proptest::collection::vec(any::<u8>(), 2..=8), data: [u8; 6], echoes: bool, replies: bool,
    ) {
        prop_assume!(message[1] != 0xff);
        let reply: Vec<u8> = if replies { [&[0x05, 0xff][..], &data].concat() } else { Vec::new() };
        let comes = reply.clone();
        let (mut rig, sent) = port(move |bytes| [if echoes { bytes } else { &[] }, &comes[..]].concat());
        // The second time it has learned whether there is an echo.
        for _ in 0..2 {
            rig.send(&send(&message, if replies { 10 } else { 0 }));
            rig.run_until(rig.now() + 10_000_000);
            prop_assert_eq!(rig.responses(), [response(&with_serial_bits(&reply))]);
            prop_assert_eq!(sent.lock().unwrap().pop(), Some(message.clone()));
        }
    }

    /// Whatever a port receives, the host gets an answer, and no more bytes than it wants.
    #[test]
    fn anything_may_come_from_a_port(comes in proptest::collection::vec(any::<u8>(), 0..200), echoes: bool, read in 0u8..=10) {
        let (mut rig, _) = port(move |bytes| [if echoes { bytes } else { &[] }, &comes[..]].concat());
        rig.send(&send(READ_IFCNT, read));
        rig.run_until(100_000_000);
        let responses = rig.responses();
        prop_assert_eq!(responses.len(), 1);
        let bytes = responses[0].strip_prefix("tmcuart_response oid=0 read=").unwrap().len() / 2;
        prop_assert!(bytes == 0 || bytes == usize::from(read), "{:?}", responses);
        prop_assert!(rig.shutdown().is_none());
    }
}

#[test]
fn a_port_has_its_answer_as_soon_as_the_last_byte_came() {
    let (mut rig, _) = port(|bytes| [bytes, IFCNT].concat());
    rig.send(&send(READ_IFCNT, 10));
    // Four bytes, their echo, and eight bytes.
    let end = QUIET + (4 + 4 + 8) * 10 * BIT;
    rig.sends_until(end - 1, &[]);
    rig.run_until(end);
    assert_eq!(rig.responses(), [response(&with_serial_bits(IFCNT))]);
    // A message without a reply has its answer with its echo.
    let (mut rig, _) = port(<[u8]>::to_vec);
    rig.send(&send(READ_IFCNT, 0));
    rig.run_until(QUIET + (4 + 4) * 10 * BIT);
    assert_eq!(rig.responses(), [response(&[])]);
}

/// Neither a silent driver, nor a missing wire, nor half of a reply is an answer. The next one is.
#[test]
fn without_a_whole_reply_a_port_answers_nothing() {
    for comes in [&[][..], READ_IFCNT, &[READ_IFCNT, &IFCNT[..7]].concat(), &IFCNT[..7], &READ_IFCNT[..3]] {
        let mut next = [comes.to_vec(), [READ_IFCNT, IFCNT].concat()].into_iter();
        let (mut rig, _) = port(move |_| next.next().unwrap());
        rig.send(&send(READ_IFCNT, 10));
        rig.sends_until(QUIET + PORT_LIMIT, &[]);
        rig.run_until(QUIET + 2 * PORT_LIMIT + 600 * BIT);
        assert_eq!(rig.responses(), [response(&[])], "{comes:x?}");
        rig.send(&send(READ_IFCNT, 10));
        rig.run_until(20_000_000);
        assert_eq!(rig.responses(), [response(&with_serial_bits(IFCNT))]);
    }
}

#[test]
fn a_wrong_check_sum_and_garbage_are_klippys_to_refuse() {
    let mut spoilt = IFCNT.to_vec();
    spoilt[6] ^= 1;
    for (comes, read) in [(spoilt.clone(), &spoilt[..]), ([0; 9].to_vec(), &[0; 8])] {
        let (mut rig, sent) = port(move |bytes| [bytes, &comes].concat());
        rig.send(&send(READ_IFCNT, 10));
        rig.run_until(20_000_000);
        assert_eq!(rig.responses(), [response(&with_serial_bits(read))]);
        assert_eq!(sent.lock().unwrap().len(), 1, "klippy asks again");
    }
}

#[test]
fn a_port_that_is_gone_does_not_answer_and_stops_nothing() {
    let (mut rig, _) = port(|bytes| [bytes, IFCNT].concat());
    rig.bench.state().broken.insert(SERIAL);
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(1_000_000);
    assert_eq!(rig.responses(), [response(&[])]);
    rig.bench.state().broken.clear();
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(2_000_000);
    assert_eq!(rig.responses(), [response(&with_serial_bits(IFCNT))]);
}

#[test]
fn a_shutdown_amid_a_message_of_a_port_says_nothing_more() {
    let (mut rig, _) = port(|bytes| [bytes, IFCNT].concat());
    rig.send(&send(READ_IFCNT, 10));
    rig.run_until(QUIET + 5 * BIT);
    rig.stops_on("emergency_stop", "Command request");
    rig.sends_until(10_000_000, &[]);
    assert!(!rig.mcu.has_pending_values());
}

#[test]
fn a_port_that_cannot_be_used_is_refused() {
    for (config, broken, reason, words) in [
        ("rx_pin=800 pull_up=1 tx_pin=800", true, "Unable to open serial port", "pin 800 is gone"),
        (
            "rx_pin=800 pull_up=1 tx_pin=10",
            false,
            "Unable to open serial port",
            "cannot receive on ttyS0 and send on gpio10",
        ),
        ("rx_pin=10 pull_up=1 tx_pin=800", false, "Not an output pin", "no pin 800"),
    ] {
        let mut rig = Rig::new();
        if broken {
            rig.bench.state().broken.insert(SERIAL);
        }
        rig.refuses(&[&format!("config_tmcuart oid=0 {config} bit_time=1250")], reason);
        let notes = rig.notes();
        assert!(notes.iter().any(|note| note.contains(words)), "{notes:?}");
    }
}
