// SPDX-License-Identifier: GPL-3.0-or-later
//! A trace as the signals of a logic analyzer: VCD (IEEE 1364) for PulseView and GTKWave.

use std::collections::{BTreeMap, HashSet};
use std::io::{self, Write};

use pinion_firmware::time::Ticks;

use super::event::Event;
use super::file::Trace;
use super::history::{Deed, History, short};

/// The signals begin this long before the end of the recording, or with it. PulseView makes a sample of each unit of
/// time, even if nothing changes.
const SPAN: i64 = Ticks::from_ms(10_000).0 as i64;
/// Longest part after the end of the recording. A stop takes some ms.
const AFTER_MAX: i64 = Ticks::from_ms(1_000).0 as i64;
/// Ticks in a unit of time.
const UNIT: i64 = Ticks::from_us(1).0 as i64;
/// The same with edges of outputs. Their pulses may be shorter than 1 µs.
const UNIT_OF_EDGES: i64 = UNIT / 10;
/// Highest number of outputs.
const OUTPUTS_MAX: usize = 64;

/// Writes the signals of the last ten seconds and of the stop.
///
/// - `core_awake`: the core does not sleep
/// - `core_held`: commands wait for a bus
/// - `host_block`, `core_block`: a pulse when a block comes from the host, and when the core begins it
/// - `command`: a pulse for each command, or for several that ran at once
/// - `timer_late`, `late_us`: from the due time of a late timer until it ran, and how late it was
/// - `mcu_stopped`, `host_there`, `power_fault`
/// - `busy_BUS` for each worker
/// - each output whose edges are recorded
///
/// # Errors
///
/// Those of `out`.
pub fn write(trace: &Trace, out: &mut impl Write) -> io::Result<()> {
    let history = History::of(trace);
    let first = history.deeds().map(|(_, deed)| deed.from).min().unwrap_or(0);
    let edges = history.deeds().any(|(_, deed)| matches!(deed.event, Event::Edge { .. }));
    let scale = Scale {
        start: first.clamp(-SPAN, 0),
        end: history.last.min(AFTER_MAX),
        unit: if edges { UNIT_OF_EDGES } else { UNIT },
    };
    let signals = signals(&history);
    writeln!(out, "$comment {} $end", word(&trace.head.version))?;
    writeln!(out, "$timescale {} $end", if edges { "100 ns" } else { "1 us" })?;
    writeln!(out, "$scope module pinion $end")?;
    let mut names = HashSet::new();
    for (number, signal) in signals.iter().enumerate() {
        let mut name = word(&signal.name);
        while !names.insert(name.clone()) {
            name = format!("{name}_{number}");
        }
        let kind = if signal.real { "real 64" } else { "wire 1" };
        writeln!(out, "$var {kind} {} {name} $end", identifier(number))?;
    }
    writeln!(out, "$upscope $end\n$enddefinitions $end")?;

    let mut changes: Vec<(i64, usize, Option<u32>)> = Vec::new();
    for (number, signal) in signals.iter().enumerate() {
        changes.extend(signal.changes(scale).into_iter().map(|(at, value)| (at, number, value)));
    }
    changes.sort_by_key(|(at, number, _)| (*at, *number));
    writeln!(out, "#0\n$dumpvars")?;
    let mut now = 0;
    let start_ends = changes.partition_point(|(at, ..)| *at <= 0);
    for (index, (at, number, value)) in changes.into_iter().enumerate() {
        if index == start_ends {
            writeln!(out, "$end")?;
        }
        if at > now {
            writeln!(out, "#{at}")?;
            now = at;
        }
        match (value, signals[number].real) {
            (Some(value), true) => writeln!(out, "r{value} {}", identifier(number))?,
            (None, true) => writeln!(out, "r0 {}", identifier(number))?,
            (Some(value), false) => writeln!(out, "{}{}", u8::from(value > 0), identifier(number))?,
            (None, false) => writeln!(out, "x{}", identifier(number))?,
        }
    }
    // Every signal has a value at 0. So the list ends there only if nothing changed after it.
    if now == 0 {
        writeln!(out, "$end")?;
    }
    if now < scale.last() {
        writeln!(out, "#{}", scale.last())?;
    }
    Ok(())
}

/// The times of the file.
#[derive(Clone, Copy)]
struct Scale {
    /// The time of its zero, in ticks relative to the end of the recording.
    start: i64,
    /// The time of its last unit.
    end: i64,
    /// Ticks in a unit.
    unit: i64,
}

impl Scale {
    fn at(self, at: i64) -> i64 {
        at.saturating_sub(self.start).div_euclid(self.unit)
    }

    fn last(self) -> i64 {
        self.at(self.end)
    }
}

/// A signal as the spans in which it is not zero.
struct Signal {
    name: String,
    real: bool,
    /// Its value is unknown before this time.
    known: i64,
    /// Spans with the value. They may overlap: the highest value counts. One that nothing ends has no end in the file.
    spans: Vec<(i64, i64, u32)>,
}

impl Signal {
    fn new(name: &str, known: i64, spans: Vec<(i64, i64, u32)>) -> Signal {
        Signal { name: name.to_owned(), real: false, known, spans }
    }

    /// The values with their times in units after the start; `None` for an unknown one. The first is at 0.
    fn changes(&self, scale: Scale) -> Vec<(i64, Option<u32>)> {
        let last = scale.last();
        let known = scale.at(self.known).clamp(0, last);
        let mut turns: Vec<(i64, u32, bool)> = Vec::with_capacity(2 * self.spans.len());
        for (from, to, value) in &self.spans {
            let (from, to) = (scale.at(*from), scale.at(*to));
            if to < 0 || from > last {
                continue;
            }
            // A pulse without a length would not be seen.
            let from = from.max(0);
            turns.push((from, *value, true));
            turns.push((to.max(from + 1), *value, false));
        }
        turns.sort_unstable();
        let mut active: BTreeMap<u32, usize> = BTreeMap::new();
        let mut changes = vec![(0, (known == 0).then_some(0))];
        if known > 0 && self.known <= scale.end {
            changes.push((known, Some(0)));
        }
        let mut turns = turns.into_iter().peekable();
        while let Some((at, value, begins)) = turns.next() {
            let count = active.entry(value).or_default();
            *count = if begins { *count + 1 } else { count.saturating_sub(1) };
            if *count == 0 {
                active.remove(&value);
            }
            if turns.peek().is_some_and(|(next, ..)| *next == at) || at > last {
                continue;
            }
            let now = active.last_key_value().map_or(0, |(value, _)| *value);
            // The start and the time from which the signal is known have a value already: it gives way.
            while changes.last().is_some_and(|(before, _)| *before >= at && *before > 0) {
                changes.pop();
            }
            match changes.last_mut() {
                Some((before, value)) if *before == at => *value = Some(now),
                Some((_, Some(value))) if *value == now => {}
                _ => changes.push((at, Some(now))),
            }
        }
        changes
    }
}

fn signals(history: &History<'_>) -> Vec<Signal> {
    let core = history.core();
    let all: Vec<Deed> = history.deeds().map(|(_, deed)| *deed).collect();
    let first = |deeds: &[Deed]| deeds.iter().map(|deed| deed.from).min().unwrap_or(0);
    let when = |deeds: &[Deed], is: fn(&Event) -> bool| -> Vec<(i64, i64, u32)> {
        let to = |deed: &Deed| if deed.is_open() { i64::MAX } else { deed.to };
        deeds.iter().filter(|deed| is(&deed.event)).map(|deed| (deed.from, to(deed), 1)).collect()
    };
    let pulses = |is: fn(&Event) -> bool| -> Vec<(i64, i64, u32)> {
        all.iter().filter(|deed| is(&deed.event)).map(|deed| (deed.to, deed.to, 1)).collect()
    };
    let late: Vec<(i64, i64, u32)> = core
        .iter()
        .filter(|deed| matches!(deed.event, Event::Late { .. }))
        .map(|deed| (deed.from, deed.to, u32::try_from(deed.ticks() / UNIT as u64).unwrap_or(u32::MAX).max(1)))
        .collect();
    let known = first(core);
    let first_sleep =
        core.iter().find(|deed| matches!(deed.event, Event::Woke { .. })).map_or(i64::MAX, |deed| deed.from);
    let mut signals = vec![
        Signal::new("core_awake", first_sleep, history.awake().into_iter().map(|(from, to)| (from, to, 1)).collect()),
        Signal::new("core_held", known, when(core, |event| matches!(event, Event::Held | Event::Released))),
        Signal::new("host_block", first(&all), pulses(|event| matches!(event, Event::BlockIn(_)))),
        Signal::new("core_block", known, pulses(|event| matches!(event, Event::Block(_)))),
        Signal::new("command", known, pulses(|event| matches!(event, Event::Command { .. }))),
        Signal::new("timer_late", known, late.iter().map(|(from, to, _)| (*from, *to, 1)).collect()),
        Signal { real: true, ..Signal::new("late_us", i64::MIN, late) },
        levels("mcu_stopped", first(&all), core, |event| match event {
            Event::Stopped { .. } => Some(true),
            Event::Configured | Event::Reset => Some(false),
            _ => None,
        }),
        levels("host_there", i64::MAX, &all, |event| match event {
            Event::HostCame => Some(true),
            Event::HostGone => Some(false),
            _ => None,
        }),
        levels("power_fault", first(&all), &all, |event| match event {
            Event::Power(fault) => Some(fault.is_some()),
            _ => None,
        }),
    ];
    for lane in &history.lanes {
        let busy = when(&lane.deeds, |event| matches!(event, Event::JobBegan { .. } | Event::JobEnded { .. }));
        if !busy.is_empty() {
            signals.push(Signal::new(&format!("busy_{}", short(lane.thread)), first(&lane.deeds), busy));
        }
    }
    signals.extend(history.outputs().into_iter().take(OUTPUTS_MAX).map(|output| {
        let highs = output.highs.into_iter().map(|(from, to)| (from, to, 1)).collect();
        Signal::new(&history.pin(output.pin), output.known, highs)
    }));
    signals
}

/// A signal that keeps its level until the next one. It is known from `known` or the first level.
fn levels(name: &str, known: i64, deeds: &[Deed], level: fn(&Event) -> Option<bool>) -> Signal {
    let levels: Vec<(i64, bool)> =
        deeds.iter().filter_map(|deed| level(&deed.event).map(|level| (deed.to, level))).collect();
    let ends = levels.iter().skip(1).map(|(at, _)| *at).chain([i64::MAX]);
    let spans = levels.iter().zip(ends).filter(|((_, level), _)| *level);
    let spans = spans.map(|((at, _), end)| (*at, end.max(*at), 1)).collect();
    Signal::new(name, levels.first().map_or(known, |(first, _)| known.min(*first)), spans)
}

/// A name without spaces and brackets, which separate names and ranges of bits in the file.
fn word(name: &str) -> String {
    let word = |c: char| if c.is_ascii_alphanumeric() || "_-.+".contains(c) { c } else { '_' };
    short(name).chars().map(word).collect()
}

/// The short name of a signal.
fn identifier(number: usize) -> String {
    format!("s{number}")
}

#[cfg(test)]
mod tests {
    use super::super::history::tests::{any_trace, late_host, stopped_print, text};
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashMap;
    use std::process::Command;

    /// The signals as sigrok reads them: the changes of each wire by its name, with their times in units of 100 ns.
    fn read_by_sigrok(vcd: &str) -> Option<HashMap<String, Vec<(u64, char)>>> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), vcd).unwrap();
        // It writes the signals that it has read as another VCD.
        let output = Command::new("sigrok-cli").args(["-I", "vcd", "-O", "vcd", "-i"]).arg(file.path()).output();
        let Ok(output) = output else {
            // Past the test harness, which captures the output of tests.
            let skipped = b"\nSKIPPED the signals as sigrok reads them: install sigrok-cli to test with it\n";
            io::stderr().write_all(skipped).unwrap();
            return None;
        };
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(text.contains("$timescale 100 ns $end"), "{text}");
        let mut names = HashMap::new();
        let mut signals: HashMap<String, Vec<(u64, char)>> = HashMap::new();
        for line in text.lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            if let ["$var", "wire", "1", id, name, "$end"] = words[..] {
                names.insert(id, name);
            }
            let Some(at) = words.first().and_then(|word| word.strip_prefix('#')) else { continue };
            for change in &words[1..] {
                let (value, id) = change.split_at(1);
                let change = (at.parse().unwrap(), value.chars().next().unwrap());
                signals.entry(names[id].to_owned()).or_default().push(change);
            }
        }
        Some(signals)
    }

    #[test]
    fn sigrok_reads_the_signals_as_they_were() {
        let Some(signals) = read_by_sigrok(&text(|out| write(&late_host(), out))) else { return };
        // The file begins with the first event, at 5 us.
        let at = |us: u64| (us - 5) * 10;
        for (signal, transitions, first, second) in [
            ("core_held", 90, 2000, 2400),
            ("busy_spi0", 91, 2000, 2400),
            ("timer_late", 2, 910_000 - 310, 910_000),
            ("gpio17", 2 * 93 * 8, 6000, 6002),
            ("core_awake", 2 * 1994, 500, 550),
            ("host_block", 2 * 94, 5000, 5000),
            ("command", 4 * 94, 5070, 5070),
        ] {
            // The first one is the value at the start. A pulse has one unit.
            let changes: Vec<_> = signals[signal].iter().copied().skip(1).collect();
            assert_eq!(changes[..2], [(at(first), '1'), (at(second) + u64::from(first == second), '0')], "{signal}");
            assert_eq!(changes.len(), transitions, "{signal}");
        }
        assert_eq!(signals["mcu_stopped"], [(0, '0'), (at(995_100), '1')]);
    }

    #[test]
    fn the_signals_go_on_after_the_stop() {
        let text = text(|out| write(&stopped_print(), out));
        // The file begins with the first event, at 5 us. The first edge is at 10 ms.
        let stop = 10 * (1_000_000 - 5);
        let changes = |name: &str| {
            let (before, _) = text.split_once(&format!(" {name} $end")).unwrap();
            let (_, id) = before.rsplit_once(' ').unwrap();
            let mut at = 0u64;
            let mut changes = Vec::new();
            for line in text.lines() {
                match line.strip_prefix('#') {
                    Some(now) => at = now.parse().unwrap(),
                    None if line.get(1..) == Some(id) => changes.push((at, &line[..1])),
                    None => {}
                }
            }
            changes
        };
        let edges = 10 * (10_000 - 5);
        assert_eq!(changes("fan"), [(0, "x"), (edges, "1"), (stop + 200, "0")]);
        assert_eq!(changes("x_enable"), [(0, "x"), (edges, "0"), (stop + 780, "1")]);
        assert_eq!(changes("mcu_stopped"), [(0, "0"), (stop, "1")]);
        assert!(text.ends_with(&format!("#{}\n", stop + 200_000)), "{text}");
    }

    #[test]
    fn the_value_of_a_late_timer_is_how_late_it_was() {
        let text = text(|out| write(&late_host(), out));
        let (_, id) = text.split_once("$var real 64 ").unwrap();
        let (id, _) = id.split_once(" late_us").unwrap();
        let changes: Vec<&str> = text.lines().filter(|line| line.ends_with(&format!(" {id}"))).collect();
        assert_eq!(changes, [format!("r0 {id}"), format!("r310 {id}"), format!("r0 {id}")]);
    }

    proptest! {
        /// Times rise, and each change is of a signal that the head declares under a name of its own.
        #[test]
        fn any_trace_has_the_syntax(trace in any_trace()) {
            let text = text(|out| write(&trace, out));
            let (head, changes) = text.split_once("$enddefinitions $end\n").unwrap();
            let mut names = HashSet::new();
            let mut declared = HashMap::new();
            for var in head.lines().filter_map(|line| line.strip_prefix("$var ")) {
                let [kind, _, id, name, "$end"] = var.split(' ').collect::<Vec<_>>()[..] else { panic!("{var}") };
                prop_assert!(names.insert(name), "{name}");
                declared.insert(id, kind);
            }
            let mut now = None;
            for line in changes.lines().filter(|line| !line.starts_with('$')) {
                match line.split_at(1) {
                    ("#", at) => {
                        let at = at.parse::<u64>().unwrap();
                        prop_assert!(now < Some(at) && at <= 110_000_000, "{line}");
                        now = Some(at);
                    }
                    ("0" | "1" | "x", id) => prop_assert_eq!(declared[id], "wire"),
                    ("r", change) => {
                        let (value, id) = change.split_once(' ').unwrap();
                        value.parse::<f64>().unwrap();
                        prop_assert_eq!(declared[id], "real");
                    }
                    _ => panic!("{line}"),
                }
            }
            prop_assert_eq!(changes.matches("$end").count(), 1);
        }
    }
}
