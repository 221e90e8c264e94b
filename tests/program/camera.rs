// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim --camera`: the simulated printer as a webcam, while a host drives it.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::Duration;

use nix::sys::signal::Signal;
use pinion_client::Client;
use pinion_testkit::{browser, wait};

use crate::process::{Pinion, WAIT_MAX, exists, output, printed};

/// The x axis is oid 1, the extruder oid 3.
const MOTORS: &[&str] = &[
    "config_digital_out oid=0 pin=x_enable value=0 default_value=0 max_duration=0",
    "config_stepper oid=1 step_pin=x_step dir_pin=x_dir invert_step=0 step_pulse_ticks=100",
    "config_digital_out oid=2 pin=e_enable value=0 default_value=0 max_duration=0",
    "config_stepper oid=3 step_pin=e_step dir_pin=e_dir invert_step=0 step_pulse_ticks=100",
];

/// A printer with a camera at a free port. It says where that is.
fn start(args: &[&str]) -> (Pinion, SocketAddr) {
    let pinion = Pinion::start(&[&["sim", "--camera", "127.0.0.1:0"], args].concat());
    let line = pinion.logged("camera: http://");
    let address = line.split("http://").nth(1).unwrap().split('/').next().unwrap().parse().unwrap();
    pinion.wait_for_link();
    (pinion, address)
}

fn request(address: SocketAddr, target: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(WAIT_MAX)).unwrap();
    stream.write_all(format!("GET {target} HTTP/1.1\r\nHost: {address}\r\n\r\n").as_bytes()).unwrap();
    stream
}

fn snapshot(address: SocketAddr) -> Vec<u8> {
    snapshot_of(address, "/snapshot")
}

fn snapshot_of(address: SocketAddr, target: &str) -> Vec<u8> {
    let mut answer = Vec::new();
    request(address, target).read_to_end(&mut answer).unwrap();
    assert!(answer.starts_with(b"HTTP/1.1 200 OK\r\n"), "{}", String::from_utf8_lossy(&answer));
    let body = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap() + 4;
    let jpeg = answer.split_off(body);
    assert!(jpeg.starts_with(&[0xff, 0xd8]) && jpeg.ends_with(&[0xff, 0xd9]));
    jpeg
}

/// 800 steps of these motors after some seconds: 10 mm of x, 8 mm of filament.
fn turn(client: &mut Client, seconds: f64, motors: &[u8], dir: u8) {
    let clock = client.clock_in(seconds).unwrap().wire();
    for oid in motors {
        for line in [
            format!("reset_step_clock oid={oid} clock={clock}"),
            format!("set_next_step_dir oid={oid} dir={dir}"),
            format!("queue_step oid={oid} interval=25000 count=800 add=0"),
        ] {
            client.send_line(&line).unwrap();
        }
    }
}

#[test]
fn the_picture_follows_an_axis_and_keeps_what_was_laid() {
    wait::in_time(|seconds| {
        let (mut pinion, camera) = start(&["-r", "--show"]);
        let mut client = pinion.configured(MOTORS);
        // The push-pin of the built-in printer's probe goes up at the start.
        pinion.until("the pin", || pinion.out().contains("bltouch: pin up\n"));
        let before = snapshot(camera);
        assert!(snapshot(camera) == before, "nothing has moved");
        // Where x was last. Other lines may follow.
        let x = || {
            let out = pinion.out();
            out.lines().rev().find_map(|line| Some(line[line.find(" x: ")? + 1..].to_owned())).unwrap_or_default()
        };
        turn(&mut client, seconds, &[1], 1);
        pinion.until("the move", || pinion.out().contains("x: 70.00 mm"));
        assert!(snapshot(camera) != before, "x has moved");
        turn(&mut client, seconds, &[1], 0);
        pinion.until("the way back", || x() == "x: 60.00 mm");
        pinion.until("the picture of before", || snapshot(camera) == before);
        // With the extruder it lays filament, which stays when the head is back.
        turn(&mut client, seconds, &[1, 3], 1);
        pinion.until("the piece", || pinion.out().contains("axis extruder: 8.00 mm\n"));
        turn(&mut client, seconds, &[1], 0);
        pinion.until("the way back", || x() == "x: 60.00 mm");
        pinion.until("the filament", || snapshot(camera) != before);
        assert!(!client.status().unwrap().is_shutdown, "{}", pinion.log());
        drop(client);
        // A viewer keeps nobody.
        let _viewer = request(camera, "/stream");
        pinion.signal(Signal::SIGTERM);
        assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
        assert!(!exists(&pinion.link()));
    });
}

#[test]
fn a_shutdown_is_in_the_picture() {
    let (pinion, camera) = start(&["--show"]);
    let mut client = pinion.configured(MOTORS);
    pinion.until("the pin", || pinion.out().contains("bltouch: pin up\n"));
    let before = snapshot(camera);
    client.emergency_stop().unwrap();
    pinion.until("the word", || snapshot(camera) != before);
    // The page chooses the other layout in a narrow window.
    assert_ne!(snapshot_of(camera, "/snapshot?layout=tall"), snapshot(camera));
    client.reset().unwrap();
    pinion.until("the picture of before", || snapshot(camera) == before);
}

#[test]
fn no_thread_of_the_camera_is_in_a_hurry() {
    let (pinion, camera) = start(&["-r", "--show"]);
    let mut viewer = request(camera, "/stream");
    viewer.read_exact(&mut [0; 1000]).unwrap();
    let threads = ["camera", "camera path", "camera pen", "camera targets", "camera viewer"];
    // A thread has the name of the one that started it until it runs.
    pinion.until("the threads", || threads.iter().all(|thread| pinion.scheduling(thread).len() == 1));
    for thread in threads {
        assert_eq!(pinion.scheduling(thread), [(0, 10)], "{thread}: SCHED_OTHER, and nice");
    }
    assert!(matches!(pinion.scheduling("own status")[..], [(0, _)]), "SCHED_OTHER");
}

#[test]
fn it_works_with_the_demonstration() {
    // The demonstration gives itself a quarter of a second, whenever it begins.
    wait::in_time(|_| {
        let (mut pinion, camera) = start(&["-r"]);
        pinion.until("the first move", || pinion.out().contains("home x"));
        let before = snapshot(camera);
        pinion.until("a picture of the move", || snapshot(camera) != before);
        pinion.signal(Signal::SIGTERM);
        assert_eq!(pinion.end().code(), Some(0), "{}", pinion.log());
    });
}

#[test]
fn nobody_else_reaches_it_by_default() {
    let (_pinion, camera) = start(&["--show"]);
    let elsewhere = SocketAddr::from(([127, 0, 0, 2], camera.port()));
    assert_eq!(TcpStream::connect(elsewhere).unwrap_err().kind(), ErrorKind::ConnectionRefused);
    let open = Pinion::start(&["sim", "--show", "--camera", "0.0.0.0:0"]);
    let line = open.logged("camera: http://");
    let port = line.split("http://").nth(1).unwrap().split('/').next().unwrap().rsplit(':').next().unwrap();
    snapshot(SocketAddr::from(([127, 0, 0, 2], port.parse().unwrap())));
    // Without an address it is this computer's own.
    let help = printed(&["sim", "--help"]);
    let words: Vec<&str> = help.split_whitespace().collect();
    assert!(words.join(" ").contains("by default on 127.0.0.1:8410"), "{help}");
}

#[test]
fn an_ipv4_address_in_the_form_of_ipv6_is_the_same_address() {
    if let Err(error) = TcpListener::bind("[::ffff:127.0.0.1]:0") {
        return eprintln!("an_ipv4_address_in_the_form_of_ipv6_is_the_same_address: skipped without IPv6: {error}");
    }
    for (address, answer) in [("[::ffff:127.0.0.1]:0", "HTTP/1.1 403 "), ("[::ffff:0.0.0.0]:0", "HTTP/1.1 200 ")] {
        let pinion = Pinion::start(&["sim", "--show", "--camera", address]);
        let line = pinion.logged("camera: http://");
        let port = line.split("http://").nth(1).unwrap().split('/').next().unwrap().rsplit(':').next().unwrap();
        let mut stream = TcpStream::connect(("127.0.0.1", port.parse().unwrap())).unwrap();
        stream.set_read_timeout(Some(WAIT_MAX)).unwrap();
        stream.write_all(b"GET /snapshot HTTP/1.1\r\nHost: evil.example\r\n\r\n").unwrap();
        let mut answered = [0; 13];
        stream.read_exact(&mut answered).unwrap();
        assert_eq!(String::from_utf8_lossy(&answered), answer, "{address}");
    }
}

#[test]
fn an_address_that_cannot_be_served_is_one_line_with_a_remedy() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    for (address, cause) in [
        (format!("127.0.0.1:{port}"), "another program uses the port: choose another port"),
        ("192.0.2.1:8410".into(), "this computer does not have the address: use one that"),
        ("no-such-name.invalid:8410".into(), "the name has no address: "),
    ] {
        let mut pinion = Pinion::start(&["sim", "--show", "--camera", &address]);
        assert_eq!(pinion.end().code(), Some(1), "{address}");
        let log = pinion.log();
        assert_eq!(log.lines().count(), 1, "{log}");
        assert!(log.contains(&format!("ERROR --camera {address}: {cause}")), "{log}");
        assert!(!exists(&pinion.link()) && pinion.out().is_empty());
    }
    for text in ["printer.toml", ":8410", "localhost:http", "127.0.0.1:70000"] {
        let refused = output(&["sim", "--camera", text]);
        assert_eq!(refused.status.code(), Some(2), "{text}");
        assert!(String::from_utf8_lossy(&refused.stderr).contains("give ADDR:PORT, such as 127.0.0.1:8410"));
    }
}

#[test]
fn a_browser_shows_it() {
    let (_pinion, camera) = start(&["--show"]);
    let page = format!("http://{camera}/");
    let Some(pixels) = browser::screenshot("a_browser_shows_it", &page, Duration::from_secs(1)) else { return };
    // A page without the picture has one color. The color of the cold bed is on a tenth of the picture.
    let is_bed = |pixel: &&[u8; 3]| pixel.iter().zip([58, 64, 76]).all(|(a, b): (&u8, u8)| a.abs_diff(b) < 5);
    let bed = pixels.iter().filter(is_bed).count();
    assert!(bed > 20_000, "{bed} of {} pixels are the bed's", pixels.len());
}
