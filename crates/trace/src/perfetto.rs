// SPDX-License-Identifier: GPL-3.0-or-later
//! A trace for ui.perfetto.dev, in Chrome's JSON format ("Trace Event Format").

use std::io::{self, Write};

use serde::Serialize;
use serde_json::{Value, json};

use super::event::Event;
use super::file::Trace;
use super::history::{Deed, History, short};
use pinion_linux::foreign::plain_json;

/// Our only process.
const PROCESS: u32 = 1;
/// Ticks in a microsecond, the format's unit.
const TICKS_PER_US: u64 = 50;

/// Writes the whole recording. Each thread is a track. Sleeps, waits and work are slices, the blocks of the host are
/// asynchronous slices from their arrival to their begin. Lateness, frequency, waits for a processor and
/// levels of outputs are counters.
///
/// # Errors
///
/// Those of `out`.
pub fn write(trace: &Trace, out: &mut impl Write) -> io::Result<()> {
    let history = History::of(trace);
    let start = history.deeds().map(|(_, deed)| deed.from).min().unwrap_or(0);
    let mut file = File { out, start, first: true };
    file.out.write_all(b"{\"displayTimeUnit\":\"ms\",\"traceEvents\":[\n")?;
    let process = format!("{} {}", short(&trace.head.version), short(&trace.head.link));
    file.name("process_name", 0, &process)?;
    let mut tracks = 0;
    for lane in &history.lanes {
        let name = short(lane.thread);
        // Slices of a track must not overlap: sleeps and waits have their own.
        for (suffix, has) in TRACKS {
            let deeds: Vec<&Deed> = lane.deeds.iter().filter(|deed| has(&deed.event)).collect();
            if deeds.is_empty() {
                continue;
            }
            tracks += 1;
            file.name("thread_name", tracks, &format!("{name}{suffix}"))?;
            file.put(&Item { args: json!({ "sort_index": tracks }), ..Item::new("M", "thread_sort_index", tracks) })?;
            let mut free = start;
            for deed in deeds {
                file.deed(&history, tracks, deed, &mut free)?;
            }
        }
    }
    file.out.write_all(b"\n]}\n")
}

/// A track of a thread: what it adds to the thread's name, and its events.
type Track = (&'static str, fn(&Event) -> bool);

const TRACKS: [Track; 4] = [
    ("", |event| {
        !matches!(
            event,
            Event::Command { .. } | Event::Held | Event::Released | Event::Late { .. } | Event::Pace { .. }
        )
    }),
    (": commands", |event| matches!(event, Event::Command { .. })),
    (": waits for a bus", |event| matches!(event, Event::Held | Event::Released)),
    (": timers", |event| matches!(event, Event::Late { .. } | Event::Pace { .. })),
];

/// An element of the format.
#[derive(Serialize)]
struct Item<'a> {
    /// Its kind: X a slice, i an instant, C a counter, b and e an asynchronous slice, M a name.
    ph: &'a str,
    name: &'a str,
    cat: &'a str,
    pid: u32,
    tid: u32,
    /// When, in µs.
    ts: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    dur: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<u32>,
    /// The scope of an instant.
    #[serde(skip_serializing_if = "Option::is_none")]
    s: Option<&'a str>,
    #[serde(skip_serializing_if = "Value::is_null")]
    args: Value,
}

impl<'a> Item<'a> {
    fn new(ph: &'a str, name: &'a str, tid: u32) -> Item<'a> {
        Item { ph, name, cat: "pinion", pid: PROCESS, tid, ts: 0.0, dur: None, id: None, s: None, args: Value::Null }
    }
}

struct File<'a, W> {
    out: &'a mut W,
    /// The time that is zero in the file.
    start: i64,
    first: bool,
}

impl<W: Write> File<'_, W> {
    fn put(&mut self, item: &Item<'_>) -> io::Result<()> {
        if !std::mem::take(&mut self.first) {
            self.out.write_all(b",\n")?;
        }
        self.out.write_all(plain_json(&serde_json::to_string(item)?).as_bytes())
    }

    fn name(&mut self, what: &str, tid: u32, name: &str) -> io::Result<()> {
        self.put(&Item { args: json!({ "name": name }), ..Item::new("M", what, tid) })
    }

    fn us(&self, at: i64) -> f64 {
        us(at.abs_diff(self.start.min(at)))
    }

    /// Writes a deed. `free`: where the last slice of the track ended.
    fn deed(&mut self, history: &History<'_>, tid: u32, deed: &Deed, free: &mut i64) -> io::Result<()> {
        let words = history.words(deed);
        let counter = match deed.event {
            Event::Late { late, .. } => Some(("late".to_owned(), "us", us(late.0.into()))),
            Event::Processor { thread, waited, .. } => {
                Some((format!("{thread} waited for a processor"), "us", us(waited.0.into())))
            }
            Event::Stolen(ticks) => Some(("a hypervisor took".to_owned(), "us", us(ticks.0.into()))),
            Event::Frequency { mhz, .. } => Some(("processor".to_owned(), "MHz", mhz.into())),
            Event::Edge { pin, level } => Some((history.pin(pin), "level", u8::from(level).into())),
            _ => None,
        };
        if let Some((name, unit, value)) = counter {
            let at = |ts, value: f64| Item { ts, args: json!({ unit: value }), ..Item::new("C", &name, tid) };
            self.put(&at(self.us(deed.to), value))?;
            // A timer is late only once. The other values hold until the next ones.
            match deed.event {
                Event::Late { .. } => self.put(&at(self.us(deed.to) + 1.0, 0.0))?,
                Event::Edge { .. } => return Ok(()),
                _ => {}
            }
        }
        let slice = match deed.event {
            Event::Woke { .. } => Some("asleep".to_owned()),
            Event::Held | Event::Released => Some("commands wait for a bus".to_owned()),
            Event::JobBegan { oid, .. } | Event::JobEnded { oid, .. } => Some(history.object(oid)),
            _ => None,
        };
        if let Some(name) = slice {
            let from = deed.from.max(*free);
            *free = deed.to.max(*free);
            // Only a trace with times that cannot be has slices that overlap.
            if from > deed.to {
                return Ok(());
            }
            let (ts, dur) = (self.us(from), Some(us(deed.to.abs_diff(from))));
            return self.put(&Item { ts, dur, args: json!({ "what": words }), ..Item::new("X", &name, tid) });
        }
        if let Event::Block(number) = deed.event
            && deed.ticks() > 0
        {
            let name = format!("block {number} waits");
            let (ts, cat, id) = (self.us(deed.from), "block", Some(number));
            self.put(&Item { ts, cat, id, ..Item::new("b", &name, tid) })?;
            self.put(&Item { ts: self.us(deed.to), cat, id, ..Item::new("e", &name, tid) })?;
        }
        self.put(&Item { ts: self.us(deed.to), s: Some("t"), ..Item::new("i", &words, tid) })
    }
}

fn us(ticks: u64) -> f64 {
    ticks as f64 / TICKS_PER_US as f64
}

#[cfg(test)]
mod tests {
    use super::super::history::tests::{any_trace, late_host, text};
    use super::*;
    use proptest::prelude::*;
    use std::collections::{HashMap, HashSet};

    /// The keys that the "Trace Event Format" wants in an element of each kind.
    const REQUIRED: [(&str, &[&str]); 6] = [
        ("X", &["name", "cat", "ts", "dur", "pid", "tid"]),
        ("i", &["name", "cat", "ts", "pid", "tid", "s"]),
        ("C", &["name", "ts", "pid", "args"]),
        ("b", &["name", "cat", "ts", "pid", "tid", "id"]),
        ("e", &["name", "cat", "ts", "pid", "tid", "id"]),
        ("M", &["name", "pid", "tid", "args"]),
    ];
    /// Its names of metadata that are used.
    const NAMES: [&str; 3] = ["process_name", "thread_name", "thread_sort_index"];

    /// An element, as the format's description has it.
    #[derive(serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Read {
        ph: String,
        name: String,
        cat: String,
        pid: u32,
        tid: u32,
        ts: f64,
        dur: Option<f64>,
        id: Option<u32>,
        s: Option<String>,
        args: Option<serde_json::Map<String, Value>>,
    }

    /// Reads the file by the rules of its format.
    fn read(trace: &Trace) -> Vec<Read> {
        let text = text(|out| write(trace, out));
        assert!(!text.contains(|c: char| c.is_control() && c != '\n'));
        let mut file: Value = serde_json::from_str(&text).unwrap();
        assert!(["ms", "ns"].contains(&file["displayTimeUnit"].as_str().unwrap()));
        for item in file["traceEvents"].as_array().unwrap() {
            let (_, required) = REQUIRED.iter().find(|(kind, _)| item["ph"] == *kind).unwrap();
            assert!(required.iter().all(|key| item.get(key).is_some()), "{item}");
            assert!(item["ph"] != "M" || NAMES.contains(&item["name"].as_str().unwrap()), "{item}");
        }
        let items: Vec<Read> = serde_json::from_value(file["traceEvents"].take()).unwrap();
        let mut free: HashMap<u32, f64> = HashMap::new();
        let mut open = HashMap::new();
        let mut last: HashMap<(u32, &str, &str), f64> = HashMap::new();
        let mut named = HashSet::new();
        for item in &items {
            assert!(item.ts >= 0.0 && !item.cat.is_empty() && !item.name.is_empty());
            assert_eq!(item.pid, PROCESS);
            assert!(item.ph == "M" || named.contains(&item.tid), "track {} has no name", item.tid);
            // Items of one kind come in the order of their times on each track. Counters are tracks by their names. A
            // late timer's value lasts a microsecond.
            let counter = if item.ph == "C" { item.name.as_str() } else { "" };
            let before = last.insert((item.tid, item.ph.as_str(), counter), item.ts).unwrap_or(0.0);
            assert!(
                ["b", "e", "M"].contains(&&*item.ph) || item.ts * (1.0 + 1e-9) + 1.01 >= before,
                "{} goes back",
                item.name
            );
            assert_eq!(item.s.as_deref(), (item.ph == "i").then_some("t"));
            assert_eq!(item.dur.is_some(), item.ph == "X");
            match item.ph.as_str() {
                "M" => {
                    assert!(item.args.is_some());
                    named.insert(item.tid);
                }
                "X" => {
                    let (dur, free) = (item.dur.unwrap(), free.entry(item.tid).or_default());
                    // 56 bits of ticks have no room in a number of JSON.
                    assert!(dur >= 0.0 && item.ts * (1.0 + 1e-9) + 0.01 >= *free, "{} overlaps", item.name);
                    *free = item.ts + dur;
                }
                "b" => assert!(open.insert((item.id.unwrap(), item.name.clone()), item.ts).is_none()),
                "e" => assert!(open.remove(&(item.id.unwrap(), item.name.clone())).unwrap() <= item.ts),
                "C" => assert!(item.args.as_ref().unwrap().values().all(Value::is_number)),
                "i" => {}
                kind => panic!("{kind}"),
            }
        }
        assert!(open.is_empty());
        items
    }

    #[test]
    fn each_thread_is_a_track_and_what_lasts_is_a_slice() {
        let items = read(&late_host());
        let tracks: Vec<&Value> = items
            .iter()
            .filter(|item| item.name == "thread_name")
            .map(|item| &item.args.as_ref().unwrap()["name"])
            .collect();
        let names = ["core", "core: commands", "core: waits for a bus", "core: timers"];
        assert_eq!(tracks, [&names[..], &["link", "spi0", "sampler", "guardian"]].concat());
        let long = items.iter().find(|item| item.name == "adxl345 oid 7" && item.dur > Some(1000.0)).unwrap();
        // The recording begins at 5 us.
        assert_eq!((long.ts, long.dur), (881_995.0, Some(12_000.0)));
        let late: Vec<&Value> =
            items.iter().filter(|item| item.name == "late").map(|item| &item.args.as_ref().unwrap()["us"]).collect();
        assert_eq!(late, [310.0, 0.0]);
        let waits = items.iter().filter(|item| item.name == "block 93 waits").map(|item| item.ts);
        assert_eq!(waits.collect::<Vec<_>>(), [994_995.0, 995_055.0]);
    }

    proptest! {
        #[test]
        fn any_trace_is_of_the_format(trace in any_trace()) {
            read(&trace);
        }
    }
}
