// SPDX-License-Identifier: GPL-3.0-or-later
//! The webcam over real sockets.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use pinion_camera::scene::{Bed, Gantry, Printer, Scene};
use pinion_camera::{Limits, STREAMS_MAX, serve};

/// Timeout of a test: long enough for any computer.
const WAIT_MAX: Duration = Duration::from_secs(60);

/// A camera, and how many frames were drawn.
struct Camera {
    address: SocketAddr,
    drawn: Arc<AtomicUsize>,
}

impl Camera {
    fn start() -> Camera {
        // A busy computer makes no client too slow.
        Camera::start_at("127.0.0.1:0", Limits { request: WAIT_MAX, answer: WAIT_MAX, ..Limits::default() })
    }

    /// A camera that waits for no client.
    fn impatient() -> Camera {
        let short = Duration::from_millis(100);
        Camera::start_at("127.0.0.1:0", Limits { request: short, answer: short, farewell: short })
    }

    fn start_at(address: &str, limits: Limits) -> Camera {
        let listener = TcpListener::bind(address).unwrap();
        let address = listener.local_addr().unwrap();
        let drawn = Arc::new(AtomicUsize::new(0));
        let looks = drawn.clone();
        let look = move || {
            let frame = looks.fetch_add(1, Ordering::SeqCst);
            Scene { nozzle_mm: [(frame % 220) as f64, 110.0, 20.0], ..Scene::default() }
        };
        let bed = Bed::Rectangle { x_mm: [0.0, 220.0], y_mm: [0.0, 220.0] };
        let printer = Printer { bed, height_mm: 240.0, gantry: Gantry::Cartesian };
        thread::spawn(move || serve(&listener, printer, limits, look));
        Camera { address, drawn }
    }

    fn drawn(&self) -> usize {
        self.drawn.load(Ordering::SeqCst)
    }

    /// A connection that has sent this.
    fn sent(&self, text: &str) -> TcpStream {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(WAIT_MAX)).unwrap();
        stream.write_all(text.as_bytes()).unwrap();
        stream
    }

    /// The answer to these bytes: its head, and its body.
    fn answer(&self, text: &str) -> (String, Vec<u8>) {
        let mut bytes = Vec::new();
        self.sent(text).read_to_end(&mut bytes).unwrap();
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").unwrap() + 4;
        (String::from_utf8(bytes[..end].to_vec()).unwrap(), bytes.split_off(end))
    }

    fn get(&self, target: &str) -> (String, Vec<u8>) {
        self.answer(&get(target))
    }

    /// A viewer of the stream.
    fn watch(&self) -> Viewer {
        self.try_watch().expect("a place for a viewer")
    }

    /// The same. `None` if there are too many.
    fn try_watch(&self) -> Option<Viewer> {
        let mut viewer = Viewer { stream: self.sent(&get("/stream")), bytes: Vec::new() };
        viewer.until("\r\n\r\n").starts_with("HTTP/1.1 200 OK\r\n").then_some(viewer)
    }

    fn watch_when_free(&self) -> Viewer {
        let end = Instant::now() + WAIT_MAX;
        loop {
            if let Some(viewer) = self.try_watch() {
                return viewer;
            }
            assert!(Instant::now() < end, "no place gets free");
            thread::sleep(Duration::from_millis(50));
        }
    }
}

fn get(target: &str) -> String {
    format!("GET {target} HTTP/1.1\r\nHost: localhost:8410\r\nUser-Agent: test\r\n\r\n")
}

struct Viewer {
    stream: TcpStream,
    /// Bytes read beyond the end of the picture.
    bytes: Vec<u8>,
}

impl Viewer {
    fn read_more(&mut self) {
        let mut bytes = [0; 65536];
        let count = self.stream.read(&mut bytes).unwrap();
        assert!(count > 0, "the stream has ended");
        self.bytes.extend(&bytes[..count]);
    }

    /// Reads up to the end of this text.
    fn until(&mut self, text: &str) -> String {
        loop {
            if let Some(at) = self.bytes.windows(text.len()).position(|part| part == text.as_bytes()) {
                let rest = self.bytes.split_off(at + text.len());
                return String::from_utf8(std::mem::replace(&mut self.bytes, rest)).unwrap();
            }
            self.read_more();
        }
    }

    /// The next frame, as Mainsail reads it: the length from its head, then the picture.
    fn frame(&mut self) -> Vec<u8> {
        let head = self.until("\r\n\r\n");
        let length = head.lines().find_map(|line| line.strip_prefix("Content-Length: ")).unwrap().parse().unwrap();
        while self.bytes.len() < length {
            self.read_more();
        }
        let rest = self.bytes.split_off(length);
        std::mem::replace(&mut self.bytes, rest)
    }
}

fn assert_jpeg(bytes: &[u8]) {
    assert!(bytes.starts_with(&[0xff, 0xd8]) && bytes.ends_with(&[0xff, 0xd9]), "{} bytes", bytes.len());
}

fn until(what: &str, done: impl Fn() -> bool) {
    let end = Instant::now() + WAIT_MAX;
    while !done() {
        assert!(Instant::now() < end, "waited in vain for {what}");
        thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn a_snapshot_is_a_jpeg_and_the_next_one_is_newer() {
    let camera = Camera::start();
    let (head, first) = camera.get("/snapshot");
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n") && head.contains("Content-Type: image/jpeg\r\n"), "{head}");
    assert!(head.contains(&format!("Content-Length: {}\r\n", first.len())) && head.contains("Cache-Control: no-store"));
    assert_jpeg(&first);
    thread::sleep(Duration::from_millis(100));
    let (_, second) = camera.get("/?action=snapshot&cacheBust=1234");
    assert_jpeg(&second);
    assert_ne!(first, second);
    let (head, body) = camera.answer("HEAD /snapshot HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n") && body.is_empty(), "{head}");
}

/// The width and the height of a JPEG, from its start of frame.
fn size(jpeg: &[u8]) -> [u16; 2] {
    let start = jpeg.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
    [7, 5].map(|at| u16::from_be_bytes([jpeg[start + at], jpeg[start + at + 1]]))
}

#[test]
fn a_viewer_with_a_narrow_window_gets_a_tall_picture() {
    let camera = Camera::start();
    let is_tall = |jpeg: &[u8]| size(jpeg)[1] > size(jpeg)[0];
    for (target, tall) in [
        ("/snapshot", false),
        ("/snapshot?layout=tall", true),
        ("/?action=snapshot&layout=tall", true),
        ("/snapshot?layout=wide", false),
    ] {
        assert_eq!(is_tall(&camera.get(target).1), tall, "{target}");
    }
    // Both at the same time.
    let mut wide = camera.watch();
    let mut tall = Viewer { stream: camera.sent(&get("/stream?layout=tall")), bytes: Vec::new() };
    tall.until("\r\n\r\n");
    for _ in 0..3 {
        assert!(!is_tall(&wide.frame()) && is_tall(&tall.frame()));
    }
}

#[test]
fn a_stream_has_frame_after_frame() {
    let camera = Camera::start();
    for target in ["/stream", "/?action=stream", "/stream?bypassCache=1"] {
        let mut viewer = Viewer { stream: camera.sent(&get(target)), bytes: Vec::new() };
        let head = viewer.until("\r\n\r\n");
        assert!(head.starts_with("HTTP/1.1 200 OK\r\n"), "{head}");
        let boundary = head.split_once("multipart/x-mixed-replace;boundary=").unwrap().1.lines().next().unwrap();
        viewer.until(&format!("--{boundary}\r\n"));
        let first = viewer.frame();
        // The next line is there before the next frame: a browser waits for it.
        viewer.until(&format!("\r\n--{boundary}\r\n"));
        let second = viewer.frame();
        assert_jpeg(&first);
        assert_jpeg(&second);
        assert_ne!(first, second);
    }
}

#[test]
fn no_more_than_fifteen_frames_a_second_for_all_viewers_together() {
    let camera = Camera::start();
    let mut viewers: Vec<Viewer> = (0..4).map(|_| camera.watch()).collect();
    let (start, before) = (Instant::now(), camera.drawn());
    for _ in 0..15 {
        viewers.iter_mut().for_each(|viewer| assert_jpeg(&viewer.frame()));
    }
    let frames = camera.drawn() - before;
    let most = 15.0 * start.elapsed().as_secs_f64() + 3.0;
    assert!((frames as f64) < most, "{frames} frames, at most {most}");
}

#[test]
fn nothing_is_drawn_while_nobody_looks() {
    let camera = Camera::start();
    thread::sleep(Duration::from_millis(200));
    assert_eq!(camera.drawn(), 0);
    // A page draws nothing either.
    let (head, page) = camera.get("/");
    assert!(head.contains("Content-Type: text/html"), "{head}");
    assert!(String::from_utf8(page).unwrap().contains("<img src=\"stream\""));
    assert_eq!(camera.drawn(), 0);
    let mut viewer = camera.watch();
    viewer.frame();
    viewer.frame();
    drop(viewer);
    let calm = || {
        let before = camera.drawn();
        thread::sleep(Duration::from_millis(400));
        camera.drawn() == before
    };
    until("the end of the drawing", calm);
    camera.get("/snapshot");
    until("the end of the drawing after a snapshot", calm);
}

#[test]
fn everything_else_is_refused_in_plain_words() {
    let camera = Camera::start();
    let long = format!("GET /{} HTTP/1.1\r\nHost: localhost\r\n\r\n", "x".repeat(20_000));
    let many = format!("GET / HTTP/1.1\r\n{}\r\n", "A: b\r\n".repeat(100));
    for (request, status) in [
        ("GET /else HTTP/1.1\r\nHost: localhost\r\n\r\n", "404 Not Found"),
        ("GET /?action=command HTTP/1.1\r\nHost: localhost\r\n\r\n", "404 Not Found"),
        ("POST /snapshot HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc", "405 Method Not Allowed"),
        ("DELETE / HTTP/1.1\r\nHost: localhost\r\n\r\n", "405 Method Not Allowed"),
        ("GET / HTTP/1.1\r\n\r\n", "400 Bad Request"),
        ("hello\r\n\r\n", "400 Bad Request"),
        ("\x16\x03\x01\x02\0\x01\0\x01\u{7f}\x03\x03", "400 Bad Request"),
        ("GET / HTTP/1.1\r\nHost: attacker.example:8410\r\n\r\n", "403 Forbidden"),
        ("GET /stream HTTP/1.1\r\nHost: attacker.example\r\n\r\n", "403 Forbidden"),
        (&long, "431 Request Header Fields Too Large"),
        (&many, "431 Request Header Fields Too Large"),
    ] {
        let (head, body) = camera.answer(request);
        assert!(head.starts_with(&format!("HTTP/1.1 {status}\r\n")), "{request:?}: {head}");
        let text = String::from_utf8(body).unwrap();
        assert!(text.ends_with(".\n") && text.lines().count() == 1, "{text:?}");
    }
    assert!(camera.answer("POST / HTTP/1.1\r\nHost: a\r\n\r\n").0.contains("Allow: GET, HEAD\r\n"));
    assert_eq!(camera.drawn(), 0);
    // HTTP/1.0 has no Host.
    assert!(camera.answer("GET /snapshot HTTP/1.0\r\n\r\n").0.starts_with("HTTP/1.1 200 OK\r\n"));
}

#[test]
fn a_request_without_an_end_is_given_up() {
    let camera = Camera::impatient();
    let (head, _) = camera.answer("GET / HTT");
    assert!(head.starts_with("HTTP/1.1 408 Request Timeout\r\n"), "{head}");
}

#[test]
fn a_request_that_comes_letter_by_letter_is_given_up() {
    let camera = Camera::impatient();
    let mut slow = camera.sent("GET /");
    let start = Instant::now();
    while slow.write_all(b"x").is_ok() {
        assert!(start.elapsed() < WAIT_MAX, "it is read for ever");
        thread::sleep(Duration::from_millis(10));
    }
}

/// Each may wait for longer than the picture's client, and they take more places than there are.
#[test]
fn slow_clients_keep_no_place_that_another_client_needs() {
    let camera = Camera::start_at("127.0.0.1:0", Limits { request: 10 * WAIT_MAX, ..Limits::default() });
    let slow: Vec<TcpStream> = (0..150).map(|_| camera.sent("GET /snap")).collect();
    assert_jpeg(&camera.get("/snapshot").1);
    drop(slow);
}

#[test]
fn pages_of_the_internet_cannot_read_what_is_for_this_computer() {
    let request = |origin: &str| format!("GET /snapshot HTTP/1.1\r\nHost: localhost\r\nOrigin: {origin}\r\n\r\n");
    let camera = Camera::start();
    for origin in ["http://localhost", "http://127.0.0.1:7125", "http://mainsail.local", "http://my.mainsail.xyz"] {
        let (head, _) = camera.answer(&request(origin));
        assert!(head.contains(&format!("Access-Control-Allow-Origin: {origin}\r\n")), "{head}");
    }
    for origin in ["https://attacker.example", "null", "http://my.mainsail.xyz.attacker.example"] {
        let (head, _) = camera.answer(&request(origin));
        assert!(head.starts_with("HTTP/1.1 200 OK") && !head.contains("Access-Control-Allow-Origin"), "{head}");
    }
    // The user has chosen to show it to others.
    let camera = Camera::start_at("0.0.0.0:0", Limits::default());
    let (head, _) = camera.answer(&request("https://printer.example"));
    assert!(head.contains("Access-Control-Allow-Origin: *\r\n"), "{head}");
    let (head, _) = camera.answer("GET /snapshot HTTP/1.1\r\nHost: printer.example\r\n\r\n");
    assert!(head.starts_with("HTTP/1.1 200 OK"), "{head}");
}

#[test]
fn a_slow_viewer_loses_frames_and_holds_nobody_up() {
    let camera = Camera::start();
    let mut slow = camera.watch();
    slow.frame();
    let mut quick = camera.watch();
    // The slow one takes nothing. While the quick one gets a frame, nobody waits for the slow one.
    for _ in 0..30 {
        assert_jpeg(&quick.frame());
    }
    // The slow one has some in the kernel's buffers. The pictures after these are new.
    let backlog = (0..1000).take_while(|_| {
        let start = Instant::now();
        assert_jpeg(&slow.frame());
        start.elapsed() < Duration::from_millis(20)
    });
    assert!(backlog.count() < 1000, "it is never up to date again");
}

#[test]
fn a_viewer_that_takes_nothing_is_given_up() {
    let answer = Duration::from_secs(2);
    let camera = Camera::start_at("127.0.0.1:0", Limits { request: WAIT_MAX, answer, ..Limits::default() });
    let _stuck: Vec<Viewer> = (0..STREAMS_MAX).map(|_| camera.watch()).collect();
    // There is no place for one more until one of them is given up.
    camera.watch_when_free();
}

#[test]
fn viewers_that_vanish_leave_their_places() {
    let camera = Camera::start();
    for _ in 0..4 {
        let viewers: Vec<Viewer> = (0..STREAMS_MAX).map(|_| camera.watch_when_free()).collect();
        drop(viewers);
    }
}

#[test]
fn a_hundred_viewers_at_once_get_a_picture_or_a_plain_refusal() {
    let camera = Camera::start();
    let mut streams: Vec<TcpStream> = (0..100).map(|_| camera.sent(&get("/stream"))).collect();
    let (mut served, mut refused) = (0, 0);
    for stream in &mut streams {
        let mut head = [0; 12];
        match stream.read_exact(&mut head) {
            Ok(()) if &head == b"HTTP/1.1 200" => served += 1,
            Ok(()) if &head == b"HTTP/1.1 503" => {
                let mut text = String::new();
                stream.read_to_string(&mut text).unwrap();
                assert!(text.contains("Too many viewers watch already."), "{text}");
                refused += 1;
            }
            other => panic!("{other:?} {:?}", String::from_utf8_lossy(&head)),
        }
    }
    assert_eq!((served, refused), (STREAMS_MAX, 100 - STREAMS_MAX));
    // A snapshot needs no place among the streams.
    assert_jpeg(&camera.get("/snapshot").1);
}

#[test]
fn what_is_for_this_computer_is_not_reachable_at_another_address() {
    let camera = Camera::start();
    // Each computer has all of these addresses.
    let other = SocketAddr::from(([127, 0, 0, 2], camera.address.port()));
    assert_eq!(TcpStream::connect(other).unwrap_err().kind(), ErrorKind::ConnectionRefused);
    assert!(TcpStream::connect(camera.address).is_ok());
}
