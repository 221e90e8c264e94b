// SPDX-License-Identifier: GPL-3.0-or-later
//! A page as Chromium shows it.

use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

/// Width and height of the window.
const WINDOW: [u32; 2] = [1200, 900];
/// A page whose stream never ends is never loaded.
const PATIENCE: Duration = Duration::from_secs(3);

/// The pixels of the page at this URL, some time after its start: red, green and blue. `None`, after a line that says so,
/// on a computer without Chromium.
///
/// # Panics
///
/// If Chromium makes no picture.
pub fn screenshot(test: &str, url: &str, after: Duration) -> Option<Vec<[u8; 3]>> {
    let folder = tempfile::tempdir().unwrap();
    let picture = folder.path().join("page.png");
    let frame = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = frame.local_addr().unwrap();
    let page = format!(
        "<body style=\"margin:0\"><iframe src=\"{url}\" style=\"border:0;width:100vw;height:100vh\"></iframe><img src=\"/wait\">"
    );
    // Chromium takes the picture as soon as a page is loaded, and a program in the page may not have begun. So the page is
    // in a frame, beside an image that takes a while.
    thread::spawn(move || {
        frame.incoming().for_each(|stream| drop(stream.and_then(|stream| answer(stream, &page, after))))
    });
    let arg = |name: &str, value: &Path| format!("--{name}={}", value.display());
    let browser = Command::new("chromium")
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"])
        .arg(format!("--window-size={},{}", WINDOW[0], WINDOW[1]))
        .arg(format!("--timeout={}", (after + PATIENCE).as_millis()))
        .args([arg("user-data-dir", folder.path()), arg("screenshot", &picture)])
        .arg(format!("http://{address}/"))
        .stderr(Stdio::null())
        .status();
    if browser.is_err_and(|error| error.kind() == ErrorKind::NotFound) {
        // It bypasses the test harness, which captures the output of tests.
        let _ = writeln!(io::stderr(), "\nSKIPPED {test}: it needs chromium (apt install chromium)");
        return None;
    }
    let mut png = png::Decoder::new(BufReader::new(File::open(picture).unwrap()));
    png.set_transformations(png::Transformations::normalize_to_color8());
    let mut png = png.read_info().unwrap();
    let mut bytes = vec![0; png.output_buffer_size().unwrap()];
    let info = png.next_frame(&mut bytes).unwrap();
    bytes.truncate(info.buffer_size());
    Some(bytes.chunks_exact(info.color_type.samples()).map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect())
}

/// Answers a request, with the page or with nothing after a while. Each has a thread, because Chromium connects ahead.
fn answer(mut stream: std::net::TcpStream, page: &str, after: Duration) -> io::Result<()> {
    let page = page.to_owned();
    thread::spawn(move || {
        let mut request = [0; 4096];
        let length = stream.read(&mut request)?;
        let body = if request[..length].starts_with(b"GET /wait") {
            thread::sleep(after);
            String::new()
        } else {
            page
        };
        write!(
            stream,
            "HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Type: text/html\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        )
    });
    Ok(())
}
