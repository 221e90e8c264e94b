// SPDX-License-Identifier: GPL-3.0-or-later
//! The wire is cut, with outputs on: the MCU without its host, and with the next host. (On a CAN bus:
//! `tests/kernel/guest/pinion/can.rs`.)

use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pinion_client::Client;
use pinion_testkit::wait;
use serde_json::Value;

use crate::links::{client, plug_in, plugged, pull_out};
use crate::process::{Pinion, WAIT_MAX};
use crate::search::search_of;
use crate::ssh::{attached, near, pair};
use crate::status::{line, status};

/// When the motors start, from the configuration on: a busy computer also has their steps queued by then.
const START_S: f64 = 2.0;
/// How long a heater stays on that the host does not refresh: until the motors have stopped, and not until a silent host
/// counts as gone, which takes 5 seconds.
const HEAT_S: f64 = START_S + 2.0;
/// The move that the host has queued: 150 steps, 10 ms apart.
const STEPS: u32 = 150;
const STEP_S: f64 = 0.01;
/// When klippy's time for the other MCU is over, during homing. The 50th step was 5 ms before.
const TRSYNC_S: f64 = 0.505;
/// klippy's `MCU_trsync.REASON_COMMS_TIMEOUT`.
const COMMS_TIMEOUT: u32 = 4;

/// An MCU and its host, with a wire between them.
struct Wire {
    mcu: Pinion,
    host: Client,
    cut: Cut,
    /// The verdict, if it stops a heater.
    verdict: &'static str,
}

/// Cuts the wire.
type Cut = Box<dyn FnOnce(&Pinion, Client) -> Whole>;
/// Makes the wire whole again, and returns the next host. It keeps the wire.
type Whole = Box<dyn FnMut(&Pinion) -> Client>;

/// The host switches everything on and starts two motors: one moves, and one homes with an endstop of another MCU. The
/// heater may stay on for `heat_s` without its host; zero is for ever.
pub fn begin(host: &mut Client, heat_s: f64) {
    let ticks = |host: &Client, seconds| host.ticks(seconds);
    let longest = ticks(host, heat_s);
    for command in [
        "allocate_oids count=5",
        &format!("config_digital_out oid=0 pin=bed_heater value=0 default_value=0 max_duration={longest}"),
        "config_digital_out oid=1 pin=fan value=0 default_value=0 max_duration=0",
        "config_stepper oid=2 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100",
        "config_stepper oid=3 step_pin=y_step dir_pin=y_dir invert_step=0 step_pulse_ticks=100",
        "config_trsync oid=4",
        "finalize_config crc=1",
    ] {
        host.send_line(command).unwrap();
    }
    let start = host.clock_in(START_S).unwrap().wire();
    let expires = start.wrapping_add(ticks(host, TRSYNC_S));
    let interval = ticks(host, STEP_S);
    for command in [
        &*format!("trsync_start oid=4 report_clock={start} report_ticks=0 expire_reason={COMMS_TIMEOUT}"),
        &format!("trsync_set_timeout oid=4 clock={expires}"),
        "stepper_stop_on_trigger oid=3 trsync_oid=4",
        &format!("reset_step_clock oid=2 clock={start}"),
        &format!("reset_step_clock oid=3 clock={start}"),
        "set_next_step_dir oid=2 dir=1",
        "set_next_step_dir oid=3 dir=1",
        &format!("queue_step oid=2 interval={interval} count={STEPS} add=0"),
        &format!("queue_step oid=3 interval={interval} count={STEPS} add=0"),
        "update_digital_out oid=0 value=1",
        "update_digital_out oid=1 value=1",
    ] {
        host.send_line(command).unwrap();
    }
    assert!(host.status().unwrap().is_config);
    host.check().unwrap();
}

fn steps(status: &Value, oid: usize) -> &Value {
    &status["objects"][oid]["value"]["steps"]
}

fn levels(status: &Value) -> [&Value; 2] {
    ["bed_heater", "fan"].map(|pin| &line(status, pin)["level"])
}

fn is_cut_with(start: &dyn Fn() -> Wire, has_heater: bool) {
    wait::in_time(|_| {
        let Wire { mcu, mut host, cut, verdict } = start();
        begin(&mut host, if has_heater { HEAT_S } else { 0.0 });
        let mut whole = cut(&mcu, host);
        mcu.logged("host gone");
        mcu.until("the end of the move", || *steps(&status(&mcu), 2) == STEPS);
        if has_heater {
            mcu.logged("shutdown: Missed scheduling of next digital out event");
            let after = status(&mcu);
            assert_eq!(after["state"], "shutdown");
            assert_eq!(levels(&after), [0, 0], "all its outputs");
            mcu.logged(verdict);
        } else {
            // Nothing else stops.
            thread::sleep(Duration::from_secs_f64(HEAT_S));
            let after = status(&mcu);
            assert_eq!(after["state"], "configured", "{}", mcu.log());
            assert_eq!(levels(&after), [1, 1], "they have no time");
        }
        // The motor that homes was stopped, because the trsync has expired. The other one has made its move.
        let after = status(&mcu);
        assert_eq!((steps(&after, 2), steps(&after, 3)), (&STEPS.into(), &50.into()));

        let mut host = whole(&mcu);
        let found = host.status().unwrap();
        assert_eq!((found.is_config, found.is_shutdown), (true, has_heater), "klippy asks for this first");
        if has_heater {
            host.reset().unwrap();
            assert!(!host.status().unwrap().is_config);
        } else {
            host.send_line("trsync_trigger oid=4 reason=2").unwrap();
            let state = host.wait("trsync_state", Some(4), Instant::now() + WAIT_MAX).unwrap().unwrap();
            assert_eq!(state.int("trigger_reason").unwrap(), i64::from(COMMS_TIMEOUT), "the first reason stays");
        }
    });
}

/// A host over SSH.
fn over_ssh() -> (Pinion, Pinion, Client) {
    let (mcu, near) = pair();
    let host = near.client();
    (mcu, near, host)
}

/// With a heater, and without one.
fn is_cut(start: impl Fn() -> Wire + Sync) {
    thread::scope(|scope| {
        scope.spawn(|| is_cut_with(&start, true));
        scope.spawn(|| is_cut_with(&start, false));
    });
}

/// The next host over SSH. One that comes too early is carried by a connection that ends.
fn next_over(near: &Pinion) -> Client {
    let end = Instant::now() + WAIT_MAX;
    loop {
        let host = Client::connect(&near.link(), WAIT_MAX);
        if let Ok(mut host) = host
            && host.status().is_ok()
        {
            return host;
        }
        assert!(Instant::now() < end, "{}", near.log());
    }
}

fn serial() -> (Pinion, Client) {
    let (host, mcu) = plugged(&[]);
    mcu.logged("serving on");
    (mcu, client(host))
}

#[test]
#[ignore = "slow"]
fn a_serial_port_that_is_pulled_out() {
    is_cut(|| {
        let (mcu, host) = serial();
        let cut = |mcu: &Pinion, host: Client| -> Whole {
            // The line hangs up, and the port is gone.
            pull_out(mcu.folder(), host);
            mcu.logged("ttyPort is gone");
            Box::new(|mcu| {
                let host = plug_in(mcu.folder());
                mcu.logged("ttyPort is there");
                client(host)
            })
        };
        Wire { mcu, host, cut: Box::new(cut), verdict: "the host was gone from serial:" }
    });
}

#[test]
#[ignore = "slow"]
fn a_serial_line_on_which_nothing_comes_any_more() {
    is_cut(|| {
        let (mcu, host) = serial();
        let cut = |_: &Pinion, host: Client| -> Whole {
            let mut host = Some(host);
            Box::new(move |_| host.take().unwrap())
        };
        Wire { mcu, host, cut: Box::new(cut), verdict: "nothing came over serial:" }
    });
}

/// An SSH that will be killed.
fn killed((mcu, near, host): (Pinion, Pinion, Client)) -> Wire {
    let cut = |mcu: &Pinion, host: Client| -> Whole {
        let [pid] = attached(&mcu.link())[..] else { panic!("no attach, or several") };
        kill(Pid::from_raw(pid), Signal::SIGKILL).unwrap();
        drop(host);
        Box::new(move |_| next_over(&near))
    };
    Wire { mcu, host, cut: Box::new(cut), verdict: "the host was gone from SSH" }
}

#[test]
#[ignore = "slow"]
fn an_ssh_that_is_killed() {
    is_cut(|| killed(over_ssh()));
}

/// A busy computer finds out who the host is when the host has its dictionary.
#[test]
#[ignore = "slow"]
fn an_ssh_that_is_found_late_and_killed() {
    let start = || {
        let mcu = Pinion::simulated(&[]);
        let search = Pid::from_raw(search_of(mcu.pid()).unwrap().cast_signed());
        kill(search, Signal::SIGSTOP).unwrap();
        let near = near(&mcu.link(), "");
        near.logged("serving on");
        let host = near.client();
        mcu.logged("the host's messages were not found within 3s");
        kill(search, Signal::SIGCONT).unwrap();
        mcu.logged("the host is on another computer");
        killed((mcu, near, host))
    };
    is_cut_with(&start, true);
}

#[test]
#[ignore = "slow"]
fn an_ssh_that_carries_nothing_any_more() {
    is_cut(|| {
        let (mcu, near, host) = over_ssh();
        let cut = |_: &Pinion, host: Client| -> Whole {
            // The network is gone: neither side hears the other.
            near.signal(Signal::SIGSTOP);
            drop(host);
            Box::new(move |_| {
                near.signal(Signal::SIGCONT);
                next_over(&near)
            })
        };
        Wire { mcu, host, cut: Box::new(cut), verdict: "nothing came over SSH for" }
    });
}

#[test]
#[ignore = "slow"]
fn a_host_that_hangs_behind_ssh_is_no_cut() {
    wait::in_time(|_| {
        let (mcu, _near, mut host) = over_ssh();
        // `pinion link` sends a keepalive after two seconds of silence.
        begin(&mut host, 2.0 * HEAT_S);
        mcu.logged("shutdown: Missed scheduling of next digital out event");
        let verdict = mcu.logged("the host sent no commands for");
        assert!(verdict.contains("but its computer sent keepalives"), "{verdict}");
    });
}
