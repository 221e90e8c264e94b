// SPDX-License-Identifier: GPL-3.0-or-later
//! A trace: the events of all threads, with the facts that explain them. It is kept in a file.
//!
//! The file is compressed by gzip. It begins with a line [`MAGIC`], and a line of JSON, the [`Head`]. Each thread
//! follows with a line of JSON ([`Part`]) and its events, 16 bytes each, as little-endian words.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use serde::{Deserialize, Serialize};

use pinion_firmware::time::Clock;

use super::event::{EVENT_WORDS, Event};

/// The first line of a file.
const MAGIC: &str = "pinion trace 1\n";
/// Bytes of an event.
const EVENT_BYTES: usize = EVENT_WORDS * 8;
/// Longest line of JSON.
const LINE_MAX: u64 = 1 << 20;
/// Highest number of events of all threads: more than all rings have.
const EVENTS_MAX: usize = 1 << 20;
/// Highest number of threads.
const THREADS_MAX: usize = 64;

/// The wire of a host that `pinion attach` carries.
pub const SSH: &str = "SSH";

/// The end of a recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    /// The MCU stopped.
    Shutdown {
        /// The text that the host shows.
        reason: String,
        /// The text of the log.
        trouble: String,
    },
    /// The program died. The guardian kept the recording.
    Died,
    /// The core had no heartbeat. The guardian kept the recording, and killed the program.
    Hung {
        /// The guardian's account of it.
        diagnosis: String,
    },
    /// Somebody asked for the recording of a program that works.
    Asked,
}

/// The names that the events' numbers stand for.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Names {
    /// The commands of the host's dialect by their ids.
    pub commands: BTreeMap<i16, String>,
    /// The objects of the MCU by their oids, such as `stepper oid 3`.
    pub objects: BTreeMap<u8, String>,
    /// The lines by their numbers on the wire.
    pub pins: BTreeMap<u32, String>,
    /// Whether the last host was on another computer, and `pinion attach` carried it.
    #[serde(default)]
    pub is_carried: bool,
}

/// The facts about a recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Head {
    /// The Pinion that made it.
    pub version: String,
    /// The path of its link.
    pub link: String,
    /// The wire to another computer, such as `can:can0` or [`SSH`], if there is one.
    #[serde(default)]
    pub wire: Option<String>,
    /// Its end.
    pub end: End,
    /// When it ended, in ticks of the MCU's clock ([`Clock::to_bits`]).
    pub ended_at: u64,
    /// The same instant as milliseconds since 1970 (UTC).
    pub utc_ms: u64,
    /// Whether the core was asked to run in real time.
    pub realtime: bool,
    /// Number of processors.
    pub processors: usize,
    /// The kernel's version.
    pub kernel: String,
    /// Names.
    pub names: Names,
}

/// The head of a thread's events.
#[derive(Serialize, Deserialize)]
struct Part {
    thread: String,
    events: usize,
}

/// The events of one thread, the oldest first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Thread {
    /// Its name: `core`, `link`, the bus of a worker, ...
    pub name: String,
    /// Its events.
    pub events: Vec<(Clock, Event)>,
}

/// A recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trace {
    /// The facts about it.
    pub head: Head,
    /// Its threads. A thread may come twice: all its latest events, and the important ones of a longer time.
    pub threads: Vec<Thread>,
}

impl Trace {
    /// When the recording ended.
    pub fn ended_at(&self) -> Clock {
        Clock::from_bits(self.head.ended_at)
    }

    /// The events of all threads with this name.
    pub fn of<'a>(&'a self, name: &'a str) -> impl Iterator<Item = (Clock, Event)> + 'a {
        self.threads.iter().filter(move |thread| thread.name == name).flat_map(|thread| thread.events.iter().copied())
    }

    /// All events with their threads, in the order of their times.
    pub fn timeline(&self) -> Vec<(Clock, &str, Event)> {
        let events = self
            .threads
            .iter()
            .flat_map(|thread| thread.events.iter().map(|(at, event)| (*at, thread.name.as_str(), *event)));
        let mut events: Vec<_> = events.collect();
        events.sort_by_key(|(at, ..)| *at);
        events
    }

    /// Writes the file.
    ///
    /// # Errors
    ///
    /// Those of `file`.
    pub fn write(&self, file: impl Write) -> io::Result<()> {
        // The encoder clears its whole output buffer at each write.
        let mut file = BufWriter::new(GzEncoder::new(file, Compression::fast()));
        file.write_all(MAGIC.as_bytes())?;
        serde_json::to_writer(&mut file, &self.head)?;
        file.write_all(b"\n")?;
        for Thread { name, events } in &self.threads {
            serde_json::to_writer(&mut file, &Part { thread: name.clone(), events: events.len() })?;
            file.write_all(b"\n")?;
            for (at, event) in events {
                for word in event.encode(*at) {
                    file.write_all(&word.to_le_bytes())?;
                }
            }
        }
        file.into_inner()?.finish()?.flush()
    }

    /// Reads a file. Events of unknown kinds are left out: they are a later Pinion's. A file that was cut off has the
    /// events before the cut.
    ///
    /// # Errors
    ///
    /// It is no trace, or reading fails.
    pub fn read(file: impl Read) -> io::Result<Trace> {
        let mut file = BufReader::new(GzDecoder::new(file));
        let magic = line(&mut file).map_err(|error| match error.kind() {
            io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof => no_trace(),
            _ => error,
        })?;
        if magic != MAGIC.trim_end() {
            return Err(no_trace());
        }
        let head: Head = serde_json::from_str(&line(&mut file)?)
            .map_err(|error| io::Error::other(format!("its head does not fit this Pinion: {error}")))?;
        let (mut threads, mut room) = (Vec::new(), EVENTS_MAX);
        while threads.len() < THREADS_MAX {
            let Ok(part) = line(&mut file).and_then(|line| Ok(serde_json::from_str::<Part>(&line)?)) else { break };
            let mut events = Vec::new();
            let mut bytes = [0; EVENT_BYTES];
            for _ in 0..part.events {
                if room == 0 || file.read_exact(&mut bytes).is_err() {
                    break;
                }
                room -= 1;
                let word = |at: usize| u64::from_le_bytes(std::array::from_fn(|byte| bytes[at + byte]));
                events.extend(Event::decode([word(0), word(8)]));
            }
            threads.push(Thread { name: part.thread, events });
        }
        Ok(Trace { head, threads })
    }
}

fn no_trace() -> io::Error {
    io::Error::other("it is not a trace of Pinion")
}

/// A line without its end.
fn line(file: &mut impl BufRead) -> io::Result<String> {
    let mut bytes = Vec::new();
    file.take(LINE_MAX).read_until(b'\n', &mut bytes)?;
    if bytes.pop() != Some(b'\n') {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    String::from_utf8(bytes).map_err(|_| io::ErrorKind::InvalidData.into())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A trace with these threads.
    pub(crate) fn trace(end: End, threads: &[(&str, &[(u64, Event)])]) -> Trace {
        let events = |events: &[(u64, Event)]| {
            events.iter().map(|(us, event)| (Clock::from_ticks(us * 50), *event)).collect::<Vec<_>>()
        };
        let threads: Vec<Thread> =
            threads.iter().map(|(name, list)| Thread { name: (*name).to_owned(), events: events(list) }).collect();
        let last = threads.iter().flat_map(|thread| &thread.events).map(|(at, _)| *at).max();
        let head = Head {
            version: "pinion-test".into(),
            link: "/tmp/klipper_host_mcu".into(),
            wire: None,
            end,
            ended_at: last.unwrap_or(Clock::EPOCH).to_bits(),
            utc_ms: 1_795_348_800_000,
            realtime: true,
            processors: 4,
            kernel: "6.12.0".into(),
            names: Names {
                commands: [(5, "queue_step".to_owned())].into(),
                objects: [(3, "stepper oid 3".to_owned())].into(),
                pins: [(17, "gpio17".to_owned())].into(),
                is_carried: true,
            },
        };
        Trace { head, threads }
    }

    fn some() -> Trace {
        let core = [(1, Event::Block(1)), (2, Event::Command { id: 5, more: 3 }), (3, Event::Due(Clock::EPOCH))];
        trace(End::Died, &[("core", &core), ("link", &[]), ("core", &core)])
    }

    fn written(trace: &Trace) -> Vec<u8> {
        let mut file = Vec::new();
        trace.write(&mut file).unwrap();
        file
    }

    #[test]
    fn a_file_is_read_as_it_was_written() {
        let trace = some();
        assert_eq!(Trace::read(written(&trace).as_slice()).unwrap(), trace);
    }

    #[test]
    fn what_is_no_trace_is_refused_in_words() {
        for bytes in [&b""[..], b"pinion trace 1\n{}\n", &[0x1f, 0x8b, 8, 0]] {
            assert_eq!(Trace::read(bytes).unwrap_err().to_string(), "it is not a trace of Pinion");
        }
    }

    #[test]
    fn a_file_that_was_cut_off_has_the_events_before_the_cut() {
        let whole = written(&some());
        let cuts: Vec<Trace> = (0..whole.len()).filter_map(|len| Trace::read(&whole[..len]).ok()).collect();
        assert!(!cuts.is_empty());
        for cut in cuts {
            assert_eq!(cut.head, some().head);
            assert!(cut.threads.len() <= 3);
        }
    }

    #[test]
    fn a_file_without_end_takes_bounded_memory() {
        let events = vec![(1, Event::Held); EVENTS_MAX / 2 + 1];
        let endless = trace(End::Asked, &[("core", &events), ("link", &events), ("spi0", &events)]);
        let lengths: Vec<usize> = Trace::read(written(&endless).as_slice())
            .unwrap()
            .threads
            .iter()
            .map(|thread| thread.events.len())
            .collect();
        assert_eq!(lengths.iter().sum::<usize>(), EVENTS_MAX, "{lengths:?}");
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(place: prop::sample::Index, byte: u8, rest in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = Trace::read(rest.as_slice());
            // The contents of a file with a good check sum.
            let mut plain = Vec::new();
            GzDecoder::new(written(&some()).as_slice()).read_to_end(&mut plain).unwrap();
            *place.get_mut(&mut plain) = byte;
            let mut file = GzEncoder::new(Vec::new(), Compression::fast());
            file.write_all(&plain).unwrap();
            let _ = Trace::read(file.finish().unwrap().as_slice());
        }
    }
}
