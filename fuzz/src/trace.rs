// SPDX-License-Identifier: GPL-3.0-or-later
//! A file of the flight recorder: as it is, and as the contents of a file with a good check sum. What is read is judged,
//! shown and exported.

use std::io::{self, Write as _};
use std::time::Duration;

use flate2::Compression;
use flate2::write::GzEncoder;
use pinion_trace::file::Trace;
use pinion_trace::{perfetto, svg, timeline, vcd, verdict};

pub fn run(bytes: &[u8]) {
    let _ = Trace::read(bytes);
    let mut file = GzEncoder::new(Vec::new(), Compression::none());
    file.write_all(bytes).expect("room");
    let Ok(trace) = Trace::read(file.finish().expect("room").as_slice()) else { return };
    let timeline = trace.timeline();
    assert!(timeline.is_sorted_by_key(|(at, ..)| *at));
    let _ = verdict::verdict(&trace);
    let all = Duration::from_secs(3600);
    timeline::write(&trace, all, &mut io::sink()).expect("room");
    for write in [perfetto::write, svg::write, vcd::write] {
        write(&trace, &mut io::sink()).expect("room");
    }
    let mut again = Vec::new();
    trace.write(&mut again).expect("room");
    assert_eq!(Trace::read(again.as_slice()).ok(), Some(trace));
}
