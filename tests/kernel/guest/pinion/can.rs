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

use pinion_client::Client;
use pinion_client::serial::{BlockLink, Port};
use socketcan::{CanDataFrame, CanFrame, CanSocket, EmbeddedFrame as _, Frame as _, Socket as _, StandardId};

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
        let bus = bus();
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
        let client = Client::new(BlockLink::new(port, WAIT).expect("a session")).expect("an MCU");
        (Host { is_over, carrier: Some(carrier) }, client)
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        let _ = self.carrier.take().map(JoinHandle::join);
    }
}

/// What happens to frames in one direction.
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
fn an_interface_that_comes_later_is_waited_for() {
    let program = Program::on_link(&format!("can:{INTERFACE},{UUID}"));
    program.wait_for_line(&["there is no CAN interface vcan0"]);
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
