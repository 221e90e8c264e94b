// SPDX-License-Identifier: GPL-3.0-or-later
//! The webcam: a small HTTP server with a thread for each connection.
//!
//! | URL | |
//! |---|---|
//! | `/stream`, `/?action=stream` | the picture in motion (MJPEG): `multipart/x-mixed-replace` |
//! | `/snapshot`, `/?action=snapshot` | the picture now, as a JPEG |
//! | `/` | a page with the picture in motion |
//!
//! With `layout=tall` in the query, the texts are below the printer instead of beside it.
//!
//! A connection waits for nobody but its own viewer. A slow viewer gets fewer frames. All is bounded: connections,
//! streams, the size of a request, and the time for each request, answer and frame.

use std::io::{self, Read, Write};
use std::net::{IpAddr, Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant, UNIX_EPOCH};

use nix::sys::socket::{setsockopt, sockopt};

use crate::picture::{Layout, Picture};
use crate::scene::{Printer, Scene};
use crate::studio::{Frame, Studio};

/// Highest number of streams.
pub const STREAMS_MAX: usize = 16;
/// Highest number of connections. Further ones wait in the kernel until one of these ends.
const CONNECTIONS_MAX: usize = 64;
/// Longest request, in bytes, and most headers in it.
const REQUEST_MAX: usize = 8 * 1024;
const HEADERS_MAX: usize = 64;
/// How much of what a client still sends is read after an answer.
const FAREWELL_MAX: usize = 256 * 1024;
/// How much the kernel keeps for a slow viewer: some frames. A larger buffer would show old pictures.
const SEND_BUFFER: usize = 128 * 1024;
/// How long to wait if the computer has no room for a further connection.
const PAUSE: Duration = Duration::from_millis(100);
/// How long a request may take while no place is free for another client.
const HASTE: Duration = Duration::from_millis(200);
/// A thread for a connection needs little.
const STACK: usize = 256 * 1024;
/// A line between two frames. mjpg-streamer has the same, and some programs look for it.
const BOUNDARY: &str = "boundarydonotcross";
/// Nobody keeps a picture.
const NO_CACHE: &str = "Cache-Control: no-store, no-cache, must-revalidate, max-age=0\r\nPragma: no-cache\r\n";
/// Domains that the internet does not have.
const NEAR: [&str; 5] = [".localhost", ".local", ".lan", ".internal", ".home.arpa"];
/// Where Mainsail and Fluidd are hosted for everybody.
const HOSTED: [&str; 2] = ["my.mainsail.xyz", "app.fluidd.xyz"];

const PAGE: &str = "<!doctype html>
<html lang=\"en\">
<meta charset=\"utf-8\">
<meta name=\"viewport\" content=\"width=device-width\">
<title>Simulated printer</title>
<style>
body { margin: 0; background: #0e1014 }
img { display: block; width: 100vw; height: 100vh; height: 100dvh; object-fit: contain }
</style>
<picture>
<source media=\"(max-aspect-ratio: 1/1)\" srcset=\"stream?layout=tall\">
<img src=\"stream\" alt=\"The simulated printer\">
</picture>
</html>
";

/// How long a client may keep a connection waiting.
#[derive(Clone, Copy)]
pub struct Limits {
    /// Longest time until a request has arrived.
    pub request: Duration,
    /// Longest time until a viewer has taken an answer or a frame.
    pub answer: Duration,
    /// Longest time for which the server reads after an answer.
    pub farewell: Duration,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits { request: Duration::from_secs(5), answer: Duration::from_secs(5), farewell: Duration::from_millis(500) }
    }
}

/// Shows this printer to everybody who connects. `look` returns the scene to draw; it is called for each frame, and
/// only while somebody waits for one. All threads get the calling thread's priority.
///
/// # Errors
///
/// The computer has no memory or no thread for it. Otherwise it never returns.
pub fn serve(
    listener: &TcpListener,
    printer: Printer,
    limits: Limits,
    look: impl FnMut() -> Scene + Send + 'static,
) -> io::Result<std::convert::Infallible> {
    // [::ffff:127.0.0.1] is 127.0.0.1.
    let is_local = listener.local_addr()?.ip().to_canonical().is_loopback();
    let picture = Picture::new(printer).ok_or(io::ErrorKind::OutOfMemory)?;
    let studio = Arc::new(Studio::default());
    let pen = studio.clone();
    thread::Builder::new().name("camera pen".into()).spawn(move || pen.draw(picture, look))?;
    let (connections, streams) = (Places::new(CONNECTIONS_MAX), Places::new(STREAMS_MAX));
    loop {
        let place = connections.wait();
        let Ok((stream, _)) = listener.accept() else {
            thread::sleep(PAUSE);
            continue;
        };
        let (studio, connections, streams) = (studio.clone(), connections.clone(), streams.clone());
        let connection = Connection { stream, studio, connections, streams, is_local, limits };
        let viewer = move || {
            // Nobody misses an answer to a viewer that is gone.
            let _ = connection.answer();
            drop(place);
        };
        if let Err(error) = thread::Builder::new().name("camera viewer".into()).stack_size(STACK).spawn(viewer) {
            log::warn!("a viewer of the camera is turned away: {error}: raise ulimit -u");
            thread::sleep(PAUSE);
        }
    }
}

/// A number of places. Each is free again when it is dropped.
struct Places {
    free: Mutex<usize>,
    freed: Condvar,
}

struct Place(Arc<Places>);

impl Places {
    fn new(count: usize) -> Arc<Places> {
        Arc::new(Places { free: Mutex::new(count), freed: Condvar::new() })
    }

    /// A place, as soon as one is free.
    fn wait(self: &Arc<Places>) -> Place {
        let free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let mut free = self.freed.wait_while(free, |free| *free == 0).unwrap_or_else(PoisonError::into_inner);
        *free -= 1;
        Place(self.clone())
    }

    fn are_taken(&self) -> bool {
        *self.free.lock().unwrap_or_else(PoisonError::into_inner) == 0
    }

    /// A place, if one is free.
    fn take(self: &Arc<Places>) -> Option<Place> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        *free = free.checked_sub(1)?;
        Some(Place(self.clone()))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        *self.0.free.lock().unwrap_or_else(PoisonError::into_inner) += 1;
        self.0.freed.notify_one();
    }
}

/// A client's request.
struct Request {
    method: String,
    /// The path, without what follows a question mark.
    path: String,
    query: String,
    host: Option<String>,
    origin: Option<String>,
}

/// Why a request is refused: the status, and a line for a person.
struct Refusal(&'static str, &'static str);

const BAD_REQUEST: Refusal = Refusal("400 Bad Request", "This is not an HTTP request.");
const FORBIDDEN: Refusal = Refusal(
    "403 Forbidden",
    "The camera is not served under this name. Use localhost or an IP address in the URL. For other names start it with an address of your network: --camera ADDR:PORT.",
);
const NOT_FOUND: Refusal = Refusal("404 Not Found", "There are /stream, /snapshot and / here.");
const NOT_ALLOWED: Refusal = Refusal("405 Method Not Allowed", "The camera only answers GET and HEAD.");
const TIMEOUT: Refusal = Refusal("408 Request Timeout", "The request took too long.");
const TOO_LARGE: Refusal = Refusal("431 Request Header Fields Too Large", "The request is too long.");
const TOO_MANY: Refusal = Refusal(
    "503 Service Unavailable",
    "Too many viewers watch already. Close another page with the camera, and try again.",
);

struct Connection {
    stream: TcpStream,
    studio: Arc<Studio>,
    connections: Arc<Places>,
    streams: Arc<Places>,
    /// Whether only this computer can connect.
    is_local: bool,
    limits: Limits,
}

impl Connection {
    fn answer(&self) -> io::Result<()> {
        self.stream.set_nodelay(true)?;
        setsockopt(&self.stream, sockopt::SndBuf, &SEND_BUFFER)?;
        match self.request()? {
            None => Ok(()),
            Some(Err(refusal)) => self.refuse(&refusal, false, ""),
            Some(Ok(request)) => self.reply(&request),
        }
    }

    fn reply(&self, request: &Request) -> io::Result<()> {
        let head_only = request.method == "HEAD";
        let reader = self.reader(request);
        let refuse = |refusal: Refusal| self.refuse(&refusal, head_only, &reader);
        if self.is_local && !request.host.as_deref().is_none_or(is_near) {
            return refuse(FORBIDDEN);
        }
        if !["GET", "HEAD"].contains(&request.method.as_str()) {
            return refuse(NOT_ALLOWED);
        }
        let asked = |key: &str| request.query.split('&').find_map(|part| part.strip_prefix(key)?.strip_prefix('='));
        let action = asked("action");
        let layout = if asked("layout") == Some("tall") { Layout::Tall } else { Layout::Wide };
        match (request.path.as_str(), action) {
            ("/stream", _) | ("/", Some("stream")) => match self.streams.take() {
                None => refuse(TOO_MANY),
                Some(_place) => self.stream(layout, head_only, &reader),
            },
            ("/snapshot", _) | ("/", Some("snapshot")) => {
                let frame = self.studio.next(layout, None);
                self.send("200 OK", &format!("{reader}{NO_CACHE}"), "image/jpeg", &frame.jpeg, head_only)
            }
            ("/", None) => self.send("200 OK", "", "text/html; charset=utf-8", PAGE.as_bytes(), head_only),
            _ => refuse(NOT_FOUND),
        }
    }

    /// Who may read the answer in a browser, besides our own page: every page, as with mjpg-streamer. If only this
    /// computer can connect, a page of the internet may not.
    fn reader(&self, request: &Request) -> String {
        let Some(origin) = &request.origin else { return String::new() };
        if !self.is_local {
            return "Access-Control-Allow-Origin: *\r\n".into();
        }
        // A page without a place of its own has the origin `null`, wherever it comes from.
        let host = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        if host.is_some_and(|host| is_near(host) || HOSTED.contains(&host)) {
            format!("Access-Control-Allow-Origin: {origin}\r\nVary: Origin\r\n")
        } else {
            "Vary: Origin\r\n".into()
        }
    }

    /// Frame after frame, until the viewer goes.
    fn stream(&self, layout: Layout, head_only: bool, reader: &str) -> io::Result<()> {
        let head = format!(
            "HTTP/1.1 200 OK\r\nConnection: close\r\n{reader}{NO_CACHE}Content-Type: multipart/x-mixed-replace;boundary={BOUNDARY}\r\n\r\n"
        );
        self.write(head.as_bytes())?;
        if head_only {
            return self.farewell();
        }
        self.write(format!("--{BOUNDARY}\r\n").as_bytes())?;
        let mut last: Option<Arc<Frame>> = None;
        loop {
            let frame = self.studio.next(layout, last.as_deref());
            let time = frame.time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
            let length = frame.jpeg.len();
            let head =
                format!("Content-Type: image/jpeg\r\nContent-Length: {length}\r\nX-Timestamp: {time:.6}\r\n\r\n");
            // A browser shows a frame when the line after it has come.
            let parts = [head.as_bytes(), &frame.jpeg, b"\r\n--", BOUNDARY.as_bytes(), b"\r\n"];
            self.write(&parts.concat())?;
            last = Some(frame);
        }
    }

    fn refuse(&self, Refusal(status, text): &Refusal, head_only: bool, reader: &str) -> io::Result<()> {
        let allow = if status.starts_with("405") { "Allow: GET, HEAD\r\n" } else { "" };
        let body = format!("{text}\n");
        self.send(status, &format!("{reader}{allow}"), "text/plain; charset=utf-8", body.as_bytes(), head_only)
    }

    fn send(&self, status: &str, headers: &str, kind: &str, body: &[u8], head_only: bool) -> io::Result<()> {
        let length = body.len();
        let head = format!(
            "HTTP/1.1 {status}\r\nConnection: close\r\n{headers}Content-Type: {kind}\r\nContent-Length: {length}\r\n\r\n"
        );
        self.write(&[head.as_bytes(), if head_only { b"" } else { body }].concat())?;
        self.farewell()
    }

    /// Writes all of it, or fails when its time is over.
    fn write(&self, mut bytes: &[u8]) -> io::Result<()> {
        let end = Instant::now() + self.limits.answer;
        while !bytes.is_empty() {
            self.stream.set_write_timeout(Some(left_until(end)?))?;
            match (&self.stream).write(bytes) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(count) => bytes = &bytes[count..],
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Reads a request. `None` if the client goes without one, or if it is slow and others wait for its place.
    fn request(&self) -> io::Result<Option<Result<Request, Refusal>>> {
        let begin = Instant::now();
        let (mut bytes, mut length) = ([0; REQUEST_MAX], 0);
        loop {
            if begin.elapsed() >= HASTE && self.connections.are_taken() {
                return Ok(None);
            }
            let Ok(left) = left_until(begin + self.limits.request) else { return Ok(Some(Err(TIMEOUT))) };
            self.stream.set_read_timeout(Some(left.min(HASTE)))?;
            match (&self.stream).read(&mut bytes[length..]) {
                Ok(0) if length == 0 => return Ok(None),
                Ok(0) => return Ok(Some(Err(BAD_REQUEST))),
                Ok(count) => length += count,
                Err(error) if [io::ErrorKind::Interrupted, io::ErrorKind::WouldBlock].contains(&error.kind()) => {
                    continue;
                }
                Err(error) => return Err(error),
            }
            match parse(&bytes[..length]) {
                Ok(Some(request)) => return Ok(Some(Ok(request))),
                Ok(None) if length < REQUEST_MAX => {}
                Ok(None) => return Ok(Some(Err(TOO_LARGE))),
                Err(refusal) => return Ok(Some(Err(refusal))),
            }
        }
    }

    /// Waits for the client's end. Bytes that nobody reads would make the kernel reset the connection, and the client
    /// would lose the answer.
    fn farewell(&self) -> io::Result<()> {
        self.stream.shutdown(Shutdown::Write)?;
        let end = Instant::now() + self.limits.farewell;
        let (mut bytes, mut read) = ([0; 4096], 0);
        while read < FAREWELL_MAX {
            self.stream.set_read_timeout(Some(left_until(end)?))?;
            match (&self.stream).read(&mut bytes)? {
                0 => break,
                count => read += count,
            }
        }
        Ok(())
    }
}

/// The time that is left. It fails if there is none: no time would be no limit.
fn left_until(end: Instant) -> io::Result<Duration> {
    let left = end.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(io::ErrorKind::TimedOut.into()) } else { Ok(left) }
}

/// The request in these bytes. `None` if some of it is still to come.
fn parse(bytes: &[u8]) -> Result<Option<Request>, Refusal> {
    let mut headers = [httparse::EMPTY_HEADER; HEADERS_MAX];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Complete(_)) => {}
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(httparse::Error::TooManyHeaders) => return Err(TOO_LARGE),
        Err(_) => return Err(BAD_REQUEST),
    }
    let (Some(method), Some(target), Some(version)) = (request.method, request.path, request.version) else {
        return Err(BAD_REQUEST);
    };
    let header = |name: &str| {
        let mut found = request.headers.iter().filter(|header| header.name.eq_ignore_ascii_case(name));
        found.next().map(|header| String::from_utf8_lossy(header.value).into_owned())
    };
    let host = header("host");
    if host.is_none() && version > 0 {
        return Err(BAD_REQUEST);
    }
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    Ok(Some(Request {
        method: method.to_owned(),
        path: path.to_owned(),
        query: query.to_owned(),
        host,
        origin: header("origin"),
    }))
}

/// Whether a host in a URL cannot be a name of the internet, and so none that an attacker owns (DNS rebinding). A port
/// may follow. A proxy has a name of its own for us, mostly without a dot.
fn is_near(host: &str) -> bool {
    let host = host.trim();
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or(rest),
        None => host.split(':').next().unwrap_or(host),
    };
    let name = name.trim_end_matches('.').to_ascii_lowercase();
    name.parse::<IpAddr>().is_ok() || !name.contains('.') || NEAR.iter().any(|domain| name.ends_with(domain))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_an_attacker_cannot_own_are_near() {
        for near in [
            "localhost",
            "localhost:8410",
            "127.0.0.1:8410",
            "192.168.1.7",
            "[::1]:8410",
            "mjpgstreamer1",
            "printer.local",
            "PRINTER.LOCAL.",
            "a.localhost:1",
        ] {
            assert!(is_near(near), "{near}");
        }
        for far in
            ["evil.example", "evil.example:8410", "127.0.0.1.evil.example", "local.evil.com", "localhost.evil.com."]
        {
            assert!(!is_near(far), "{far}");
        }
    }
}
