// SPDX-License-Identifier: GPL-3.0-or-later
//! A host on a CAN bus: the kernel's virtual one. A thread puts the host's bytes into frames, as klippy does, and can
//! be made to lose, double and swap them.

use std::io::{ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use pinion_client::serial::{BlockLink, Port};
use pinion_client::{Client, Error};
use pinion_protocol::block::{Sequence, frame};
use socketcan::{
    CanDataFrame, CanErrorFrame, CanFdFrame, CanFdSocket, CanFilter, CanFrame, CanRemoteFrame, CanSocket,
    EmbeddedFrame as _, ExtendedId, Frame as _, Socket as _, SocketOptions as _, StandardId,
};

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, run};
use crate::sysfs;

const INTERFACE: &str = "vcan0";
const UUID: &str = "0123456789ab";
const UUID_BYTES: [u8; 6] = [0x01, 0x23, 0x45, 0x67, 0x89, 0xab];
const ADMIN: u16 = 0x3f0;
const NODE_ID: u8 = 4;
const HOST_ID: u16 = 0x108;
const WAIT: Duration = Duration::from_secs(10);

fn ip(words: &str) {
    let status = Command::new("ip").args(words.split_whitespace()).status().expect("busybox");
    assert!(status.success(), "ip {words}");
}

/// The interface, until it is dropped.
struct Interface;

impl Interface {
    fn new() -> Interface {
        ip(&format!("link add {INTERFACE} type vcan"));
        ip(&format!("link set {INTERFACE} up"));
        Interface
    }
}

impl Drop for Interface {
    fn drop(&mut self) {
        ip(&format!("link del {INTERFACE}"));
    }
}

fn bus() -> CanSocket {
    let socket = CanSocket::open(INTERFACE).expect("an interface");
    socket.set_nonblocking(true).expect("a socket");
    socket
}

fn send(bus: &CanSocket, id: u16, data: &[u8]) {
    let frame = CanDataFrame::new(StandardId::new(id).expect("11 bits"), data).expect("eight bytes");
    bus.write_frame_insist(&frame).expect("a bus with room");
}

/// The next frame with this id.
fn next(bus: &CanSocket, id: u16) -> Vec<u8> {
    for _ in 0..1000 {
        match bus.read_frame() {
            Ok(CanFrame::Data(frame)) if frame.raw_id() == u32::from(id) => return frame.data().to_vec(),
            Ok(_) => {}
            Err(_) => thread::sleep(Duration::from_millis(10)),
        }
    }
    panic!("no frame {id:x} came");
}

fn assign(bus: &CanSocket, uuid: [u8; 6], node_id: u8) {
    let [a, b, c, d, e, f] = uuid;
    send(bus, ADMIN, &[1, a, b, c, d, e, f, node_id]);
}

/// The host's end of the bus.
struct Host {
    is_over: Arc<AtomicBool>,
    carrier: Option<JoinHandle<()>>,
}

impl Host {
    /// Assigns the nodeid, and connects. `faults`: frames in both directions are lost, doubled and swapped.
    fn connect(faults: bool) -> (Host, Client) {
        Host::try_connect(faults, WAIT).expect("an MCU")
    }

    /// Tries again and again, as klippy does: Pinion may have no room for the frames of the first try.
    fn insist() -> (Host, Client) {
        let mut tries = (0..10).filter_map(|_| Host::try_connect(false, Duration::from_secs(2)).ok());
        tries.next().expect("an MCU")
    }

    fn try_connect(faults: bool, wait: Duration) -> Result<(Host, Client), Error> {
        let bus = bus();
        // Frames of others take no room in its buffer.
        bus.set_filters(&[CanFilter::new(u32::from(HOST_ID) + 1, libc::CAN_SFF_MASK)]).expect("a socket");
        assign(&bus, UUID_BYTES, NODE_ID);
        let (ours, mut theirs) = UnixStream::pair().expect("sockets");
        theirs.set_nonblocking(true).expect("a socket");
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let carrier = thread::spawn(move || {
            let (mut out, mut back) = (Faults::new(faults), Faults::new(faults));
            while !over.load(Ordering::Relaxed) {
                let mut bytes = [0; 8];
                let mut idle = true;
                match theirs.read(&mut bytes) {
                    Ok(0) => return,
                    Ok(len) => {
                        idle = false;
                        // An interface that is down takes nothing.
                        out.pass(&bytes[..len], |data| {
                            let frame = CanDataFrame::new(StandardId::new(HOST_ID).expect("11 bits"), data);
                            let _ = bus.write_frame(&frame.expect("eight bytes"));
                        });
                    }
                    Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock),
                }
                if let Ok(CanFrame::Data(frame)) = bus.read_frame()
                    && frame.raw_id() == u32::from(HOST_ID + 1)
                {
                    idle = false;
                    back.pass(frame.data(), |data| drop(theirs.write(data)));
                }
                if idle {
                    thread::sleep(Duration::from_millis(1));
                }
            }
        });
        let port = Port::from_fd(OwnedFd::from(ours), "the host's end").expect("a socket");
        let host = Host { is_over, carrier: Some(carrier) };
        let client = BlockLink::new(port, wait).and_then(Client::new)?;
        Ok((host, client))
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        let _ = self.carrier.take().map(JoinHandle::join);
    }
}

/// The treatment of frames in one direction.
struct Faults {
    is_on: bool,
    count: u32,
    kept: Option<Vec<u8>>,
}

impl Faults {
    fn new(is_on: bool) -> Faults {
        Faults { is_on, count: 0, kept: None }
    }

    fn pass(&mut self, data: &[u8], mut send: impl FnMut(&[u8])) {
        self.count += 1;
        match self.count {
            // This one comes after the next.
            count if self.is_on && count % 211 == 0 => self.kept = Some(data.to_vec()),
            count if self.is_on && count % 149 == 0 => {}
            count => {
                send(data);
                if self.is_on && count % 101 == 0 {
                    send(data);
                }
                if let Some(kept) = self.kept.take() {
                    send(&kept);
                }
            }
        }
    }
}

fn start() -> Program {
    let program = Program::on_link(&format!("can:{INTERFACE},{UUID}"));
    program.wait_for_line(&["serving on vcan0 (canbus_uuid 0123456789ab)"]);
    program
}

#[test]
fn a_node_is_found_assigned_and_asked() {
    let _interface = Interface::new();
    let program = start();
    // As canbus_query.py does.
    let asking = bus();
    send(&asking, ADMIN, &[0]);
    assert_eq!(next(&asking, ADMIN + 1), [0x20, 0x01, 0x23, 0x45, 0x67, 0x89, 0xab, 0x01]);
    let (_host, mut client) = Host::connect(false);
    program.wait_for_line(&["host attached"]);
    let id = client.query("get_canbus_id", &[], "canbus_id", None).expect("an answer");
    assert_eq!(
        (id.bytes("canbus_uuid").expect("bytes"), id.int("canbus_nodeid").expect("a number")),
        (&UUID_BYTES[..], 4)
    );
    let status = client.query("get_canbus_status", &[], "canbus_status", None).expect("an answer");
    assert_eq!(status.text("canbus_bus_state").expect("a name"), "active");
    // It has a nodeid, so it does not answer.
    send(&asking, ADMIN, &[0]);
    client.query("get_uptime", &[], "uptime", None).expect("an answer");
    while let Ok(frame) = asking.read_frame() {
        assert_ne!(frame.raw_id(), u32::from(ADMIN + 1));
    }
}

/// A heater with pulses, which its host has to refresh within half a second.
const HEATER: [&str; 2] = [
    "config_digital_out oid=0 pin=lab/gpio1 value=0 default_value=0 max_duration=25000000",
    "set_digital_out_pwm_cycle oid=0 cycle_ticks=500000",
];

fn heat(client: &mut Client) {
    let at = client.clock_in(0.02).expect("the clock").wire();
    run(client, &format!("queue_digital_out oid=0 clock={at} on_ticks=250000"));
}

#[test]
fn outputs_go_to_their_shutdown_values_when_the_bus_is_cut() {
    let _interface = Interface::new();
    let sim = GpioSim::new("lab", 8);
    let program = start();
    let (host, mut client) = Host::connect(false);
    let heater = "config_digital_out oid=0 pin=lab/gpio1 value=0 default_value=0 max_duration=100000000";
    configure(&mut client, 1, &[heater]);
    run(&mut client, "update_digital_out oid=0 value=1");
    assert!(sim.level(1));
    // The wire is cut: no frame comes through any more.
    drop(host);
    program.wait_for_line(&["Missed scheduling of next digital out event"]);
    assert!(!sim.level(1));
    let (_host, mut client) = Host::connect(false);
    assert!(client.status().expect("an answer").is_shutdown);
}

/// Highest number of lines of a log that a hostile node may cause: some kinds of lines, each up to its limit.
const LINES_MAX: usize = 400;

fn id(id: u16) -> StandardId {
    StandardId::new(id).expect("11 bits")
}

/// A node that sends as fast as it can, until it is dropped.
struct Flood {
    is_over: Arc<AtomicBool>,
    sender: Option<JoinHandle<u32>>,
}

impl Flood {
    /// `round` sends some frames. Its argument is the number of rounds so far.
    fn start(round: fn(&CanFdSocket, u32)) -> Flood {
        let bus = CanFdSocket::open(INTERFACE).expect("an interface");
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let sender = thread::spawn(move || {
            let mut rounds = 0;
            while !over.load(Ordering::Relaxed) {
                round(&bus, rounds);
                rounds += 1;
            }
            rounds
        });
        Flood { is_over, sender: Some(sender) }
    }

    /// Ends it. Returns the number of rounds.
    fn end(mut self) -> u32 {
        self.is_over.store(true, Ordering::Relaxed);
        self.sender.take().map_or(0, |sender| sender.join().expect("a bus that takes every frame"))
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        let _ = self.sender.take().map(JoinHandle::join);
    }
}

/// Sends a frame. It is lost if the bus has no room.
fn throw(bus: &CanFdSocket, frame: impl Into<CanFrame>) {
    let _ = bus.write_frame(&frame.into());
}

fn throw_data(bus: &CanFdSocket, id: u16, data: &[u8]) {
    throw(bus, CanDataFrame::new(self::id(id), data).expect("eight bytes"));
}

/// Frames of all kinds and lengths with the host's id and the admin id. None is a command of the host, and none makes
/// the node yield its id.
fn all_kinds(bus: &CanFdSocket, round: u32) {
    let bytes = [0x7e, 0x40, 0x10, 0xff, 0x00, 0x7e, 0x05, round as u8];
    // Half blocks that never end, of any length.
    throw_data(bus, HOST_ID, &[64, 0x10 | round as u8 & 0xf, 1, 2, 3, 4, 5, 6]);
    for len in 0..=8 {
        throw_data(bus, HOST_ID, &bytes[..len]);
    }
    // Whole blocks with numbers that jump, without a command.
    let mut block = Vec::new();
    frame(&[], Sequence::after(round.wrapping_mul(7)), &mut block);
    throw_data(bus, HOST_ID, &block);
    // Queries, commands for others, commands cut short, commands for a bootloader, and commands that do not exist.
    throw_data(bus, ADMIN, &[0]);
    throw_data(bus, ADMIN, &[1, 9, 9, 9, 9, 9, 9, NODE_ID + 1]);
    let [a, b, c, d, e, f] = UUID_BYTES;
    for len in 0..8 {
        throw_data(bus, ADMIN, &[1, a, b, c, d, e, f, NODE_ID][..len]);
    }
    throw_data(bus, ADMIN, &[2, a, b, c, d, e, f, NODE_ID]);
    throw_data(bus, ADMIN, &[round as u8 | 0x80; 8]);
    // 29 bits, remote, and FD. The first would be commands if they had 11 bits.
    for id in [0x3f0, 0x103f0, 0x108, 0x109] {
        let id = ExtendedId::new(id).expect("29 bits");
        throw(bus, CanDataFrame::new(id, &[1, a, b, c, d, e, f, NODE_ID + 1]).expect("eight bytes"));
    }
    for id in [ADMIN, HOST_ID, HOST_ID + 1] {
        throw(bus, CanRemoteFrame::new_remote(self::id(id), 8).expect("eight bytes"));
        let _ = bus.write_frame(&CanFdFrame::new(self::id(id), &[1; 64]).expect("64 bytes"));
    }
    // Errors: off the bus, back, and what the controller says.
    for bits in [0x40, 0x100, 0x04, 0x200, 0x1fff_ffff] {
        throw(bus, CanErrorFrame::new_error(bits, &[0, 1 << (round % 8), 0, 0, 0, 0, 255, 255]).expect("eight bytes"));
    }
}

/// Takes the id, gives it back, and gives it to others, and sends as the host and as the node itself.
fn all_ids(bus: &CanFdSocket, round: u32) {
    let [a, b, c, d, e, f] = UUID_BYTES;
    let node_id = (round % 200) as u8;
    throw_data(bus, ADMIN, &[0]);
    throw_data(bus, ADMIN, &[1, a, b, c, d, e, f, node_id]);
    throw_data(bus, 0x100 + 2 * u16::from(node_id), &[0x7e; 8]);
    match round % 3 {
        0 => throw_data(bus, 0x101 + 2 * u16::from(node_id), &[0x7e; 8]),
        1 => throw_data(bus, ADMIN, &[1, 9, 9, 9, 9, 9, 9, node_id]),
        _ => {}
    }
}

/// The memory of the program, in kB.
fn memory_kb(program: &Program) -> u64 {
    let status = sysfs::read(format!("/proc/{}/status", program.pid()));
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("its memory");
    line.split_whitespace().next().and_then(|kb| kb.parse().ok()).expect("a number")
}

/// Has a host connect, configure an output and switch it, and stop the MCU.
fn is_served(program: &mut Program, sim: &GpioSim) {
    let (_host, mut client) = Host::insist();
    configure(&mut client, 1, &["config_digital_out oid=0 pin=lab/gpio1 value=0 default_value=0 max_duration=0"]);
    run(&mut client, "update_digital_out oid=0 value=1");
    client.query("get_uptime", &[], "uptime", None).expect("an answer");
    assert!(sim.level(1));
    client.emergency_stop().expect("an answer");
    sysfs::wait_until("the output is off", || !sim.level(1));
    assert!(client.status().expect("an answer").is_shutdown);
    assert!(program.is_running());
    let log = program.log();
    assert!(log.lines().count() < LINES_MAX, "{} lines", log.lines().count());
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn lost_doubled_and_swapped_frames_cost_time_and_nothing_else() {
        let _interface = Interface::new();
        let _sim = GpioSim::new("lab", 8);
        let program = start();
        let (_host, mut client) = Host::connect(true);
        configure(&mut client, 1, &["config_digital_out oid=0 pin=lab/gpio1 value=0 default_value=0 max_duration=0"]);
        for count in 0..200_u32 {
            run(&mut client, &format!("update_digital_out oid=0 value={}", count % 2));
            client.query("get_uptime", &[], "uptime", None).expect("an answer");
        }
        client.check().expect("no shutdown");
        assert!(!program.log().contains("shutdown"), "{}", program.log());
    }

    #[test]
    fn a_second_host_that_assigns_another_nodeid_leaves_no_heater_on() {
        let _interface = Interface::new();
        let sim = GpioSim::new("lab", 8);
        let program = start();
        let (host, mut client) = Host::connect(false);
        configure(&mut client, 1, &HEATER);
        heat(&mut client);
        sysfs::wait_until("the heater is on", || sim.level(1));
        // The node now listens to the second host, and the first one refreshes in vain, each time for 0.2 s later.
        let first = client.clock_in(0.02).expect("the clock").wire();
        assign(&bus(), UUID_BYTES, NODE_ID + 1);
        for round in 1..=10 {
            let at = first.wrapping_add(round * 10_000_000);
            let _ = client.send_line(&format!("queue_digital_out oid=0 clock={at} on_ticks=250000"));
            thread::sleep(Duration::from_millis(200));
        }
        assert!(!sim.level(1));
        let log = program.log();
        assert!(log.contains("Missed scheduling of next digital out event"), "{log}");
        drop((host, client));
        // The first one assigns its own again, and hears why.
        let (_host, mut client) = Host::connect(false);
        assert!(client.status().expect("an answer").is_shutdown);
    }

    #[test]
    fn a_heater_stays_on_beside_nodes_that_fill_the_bus_and_errors_of_its_interface() {
        let _interface = Interface::new();
        let sim = GpioSim::new("lab", 8);
        let program = start();
        let (_host, mut client) = Host::connect(false);
        configure(&mut client, 1, &HEATER);
        heat(&mut client);
        sysfs::wait_until("the heater is on", || sim.level(1));
        // As many frames as a bus of 1 Mbit/s carries.
        let flood = Flood::start(|bus, round| {
            for count in 0..64 {
                let id = HOST_ID + 2 + (round.wrapping_mul(64) + count) as u16 % 0xf0;
                throw_data(bus, id, &[0x7e; 8]);
            }
            throw_data(bus, ADMIN, &[1, 9, 9, 9, 9, 9, 9, NODE_ID + 1]);
            // Off the bus, and back.
            for bits in [libc::CAN_ERR_BUSOFF, libc::CAN_ERR_RESTARTED] {
                throw(bus, CanErrorFrame::new_error(bits, &[0; 8]).expect("eight bytes"));
            }
            thread::sleep(Duration::from_millis(8));
        });
        for _ in 0..10 {
            thread::sleep(Duration::from_millis(200));
            heat(&mut client);
        }
        client.check().expect("no shutdown");
        sysfs::wait_until("the heater is on", || sim.level(1));
        let rounds = flood.end();
        assert!(rounds > 100, "{rounds} rounds are no flood");
        let status = client.query("get_canbus_status", &[], "canbus_status", None).expect("an answer");
        assert_eq!(status.text("canbus_bus_state").expect("a name"), "active");
        let log = program.log();
        assert!(log.contains("is off the bus after too many errors"), "{log}");
        assert!(log.lines().count() < LINES_MAX, "{} lines", log.lines().count());
    }

    #[test]
    fn a_host_that_begins_anew_gets_the_node_again() {
        let _interface = Interface::new();
        let program = start();
        let (host, client) = Host::connect(false);
        drop((host, client));
        // It does not wait for the first one's silence.
        let (_host, mut client) = Host::connect(false);
        program.wait_for_line(&["host gone"]);
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
        sysfs::wait_until("the second host is attached", || program.log().matches("host attached").count() == 2);
    }

    #[test]
    fn an_interface_that_goes_down_and_comes_back_is_used_again() {
        let interface = Interface::new();
        let program = start();
        let (host, mut client) = Host::connect(false);
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
        ip(&format!("link set {INTERFACE} down"));
        program.wait_for_line(&["vcan0 is down: sudo ip link set vcan0 up"]);
        ip(&format!("link set {INTERFACE} up"));
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
        program.wait_for_line(&["vcan0 is up"]);
        drop((host, client));
        // An adapter on USB that is pulled out, and plugged in again.
        drop(interface);
        program.wait_for_line(&["vcan0 is gone"]);
        let _interface = Interface::new();
        program.wait_for_line(&["vcan0 is there"]);
        let (_host, mut client) = Host::connect(false);
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
    }

    #[test]
    fn another_node_with_the_same_nodeid_stops_the_mcu() {
        let _interface = Interface::new();
        let program = start();
        let (_host, mut client) = Host::connect(false);
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
        assign(&bus(), [9; 6], NODE_ID);
        program.wait_for_line(&["Another CAN node assigned this ID", "give each node another canbus_uuid"]);
        // The host finds it again, and hears why.
        assign(&bus(), UUID_BYTES, NODE_ID);
        assert!(client.status().expect("an answer").is_shutdown);
    }

    #[test]
    fn an_interface_that_comes_later_is_waited_for() {
        let program = Program::on_link(&format!("can:{INTERFACE},{UUID}"));
        program.wait_for_line(&["there is no CAN interface vcan0"]);
        let _interface = Interface::new();
        program.wait_for_line(&["vcan0 is there"]);
        let (_host, mut client) = Host::connect(false);
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
    }
}

/// A hundred thousand frames each: `make test-kernel` has them.
mod floods {
    use super::*;

    #[test]
    fn a_node_that_floods_the_bus_keeps_no_output_on_and_no_later_host_away() {
        let _interface = Interface::new();
        // Without this the interface takes no FD frames.
        ip(&format!("link set {INTERFACE} mtu 72"));
        let sim = GpioSim::new("lab", 8);
        let mut program = start();
        let (host, mut client) = Host::connect(false);
        let heater = "config_digital_out oid=0 pin=lab/gpio1 value=0 default_value=0 max_duration=100000000";
        configure(&mut client, 1, &[heater]);
        run(&mut client, "update_digital_out oid=0 value=1");
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
        assert!(sim.level(1));
        let before_kb = memory_kb(&program);
        let flood = Flood::start(all_kinds);
        // The host is drowned.
        drop(host);
        program.wait_for_line(&["Missed scheduling of next digital out event"]);
        assert!(!sim.level(1));
        let rounds = flood.end();
        assert!(rounds > 100, "{rounds} rounds are no flood");
        assert!(memory_kb(&program) < before_kb + 8192, "from {before_kb} to {} kB", memory_kb(&program));
        is_served(&mut program, &sim);
    }

    #[test]
    fn a_node_that_takes_and_gives_ids_stops_the_mcu_and_keeps_no_later_host_away() {
        let _interface = Interface::new();
        let sim = GpioSim::new("lab", 8);
        let mut program = start();
        let (host, mut client) = Host::connect(false);
        let heater = "config_digital_out oid=0 pin=lab/gpio1 value=0 default_value=0 max_duration=0";
        configure(&mut client, 1, &[heater]);
        run(&mut client, "update_digital_out oid=0 value=1");
        client.query("get_uptime", &[], "uptime", None).expect("an answer");
        assert!(sim.level(1));
        let flood = Flood::start(all_ids);
        drop(host);
        program.wait_for_line(&["Another CAN node assigned this ID"]);
        sysfs::wait_until("the output is off", || !sim.level(1));
        thread::sleep(Duration::from_secs(2));
        let rounds = flood.end();
        assert!(rounds > 100, "{rounds} rounds are no flood");
        is_served(&mut program, &sim);
    }
}
