// SPDX-License-Identifier: GPL-3.0-or-later
//! The status as a page for people.

use crate::page::{Page, aligned};
use pinion_runtime::status::form::{
    BusCounts, Host, Lateness, Line, McuStatus, Object, Present, Queues, RecorderStatus, State, Status,
};

/// Width of the column with the heads of the lines.
pub(super) const HEAD: usize = 10;

/// Writes the page.
pub(super) fn page(status: &Status) -> Page {
    let mut page = Page::default();
    let mcu = status.mcu.as_ref();
    let mut row = |head: &str, text: String| page.line(format_args!("{head:<HEAD$}{text}"));
    row("pinion", format!("{}, process {}, up for {}", status.version, status.pid, span(status.uptime_s)));
    row("link", format!("{} ({})", status.link, status.terminal));
    row("board", status.board.clone());
    row("state", state(status));
    if let Some(owes) = mcu.and_then(|mcu| mcu.owes.as_ref()) {
        row("", format!("{owes} is not at its shutdown value yet"));
    }
    row("host", host(&status.host, mcu));
    row(
        "guardian",
        status.guardian.pid.map_or("none, because this board needs none".into(), |pid| format!("process {pid}")),
    );
    if let Some(RecorderStatus { bytes, folder }) = &status.recorder {
        let memory = format!("up to {:.1} MB for the last ten seconds", *bytes as f64 / 1e6);
        let traces = folder.as_ref().map_or(String::new(), |folder| format!("; traces of stops in {folder}"));
        row("recorder", memory + &traces);
    }
    let Some(mcu) = mcu else { return page };
    if mcu.lateness.timers > 0 {
        row("timers", lateness(&mcu.lateness));
    }
    row("queues", queues(&mcu.queues));
    // Measurements are read most, and pins are the most.
    let (measured, others): (Vec<&Object>, Vec<&Object>) =
        mcu.objects.iter().partition(|object| matches!(object.value, Some(Present::Adc(_))));
    table(&mut page, "objects", measured.into_iter().chain(others).map(object).collect());
    table(&mut page, "lines", mcu.lines.iter().map(line).collect());
    page
}

/// A span as people say it.
fn span(seconds: f64) -> String {
    let seconds = seconds as u64;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3600..86400 => format!("{} h {} min", seconds / 3600, seconds / 60 % 60),
        _ => format!("{} d {} h", seconds / 86400, seconds / 3600 % 24),
    }
}

fn state(status: &Status) -> String {
    match status.state {
        State::Unknown => "unknown: the core has not answered within a second: it is busy with steps, or hangs".into(),
        State::Waiting => "waiting for a host's configuration".into(),
        State::Configuring => "a host has begun to configure it".into(),
        State::Configured => "configured".into(),
        State::Shutdown => match status.mcu.as_ref().and_then(|mcu| mcu.shutdown.as_ref()) {
            Some(stop) => format!("SHUT DOWN {} ago: {}: {}", span(stop.ago_s), stop.reason, stop.detail),
            None => "SHUT DOWN".into(),
        },
    }
}

fn host(host: &Host, mcu: Option<&McuStatus>) -> String {
    let dialect = mcu.and_then(|mcu| mcu.dialect.as_ref()).map_or(String::new(), |name| match name.as_str() {
        "host" => "; its own messages".to_owned(),
        name => format!("; dialect {name}"),
    });
    if !host.attached {
        return format!("none is attached{dialect}");
    }
    let who = match host.pid {
        None => "attached".to_owned(),
        Some(pid) => format!("{}process {pid}", if host.sure == Some(true) { "" } else { "probably " }),
    };
    let commit = host.commit.as_ref().map_or(String::new(), |commit| format!(" ({commit})"));
    match &host.checkout {
        None => format!("{who}{dialect}"),
        Some(folder) => format!("{who}, klippy of {folder}{commit}{dialect}"),
    }
}

fn lateness(late: &Lateness) -> String {
    // Debug keeps the decimal point of a whole number, as JSON does.
    format!(
        "{} run, late by p50 {:?} us, p99 {:?} us, p99.9 {:?} us, at most {:?} us; the core wakes {:?} us early",
        late.timers, late.p50_us, late.p99_us, late.p999_us, late.max_us, late.margin_us
    )
}

fn queues(Queues { moves, commands, workers }: &Queues) -> String {
    let held = if commands.held { " (they wait for a bus)" } else { "" };
    let workers: String = workers.iter().map(|worker| format!(", {} {}", worker.name, worker.waiting)).collect();
    format!("moves {} of {}, commands {}{held}{workers}", moves.waiting, moves.size, commands.waiting)
}

fn line(line: &Line) -> Vec<String> {
    let level = match line.level {
        Some(0) => "low",
        Some(_) => "high",
        None => "not read yet",
    };
    let way = line.bus.map(transfers).or(line.fast.then(|| "fast".to_owned())).unwrap_or_default();
    vec![line.pin.clone(), line.use_.name().into(), level.into(), way]
}

fn object(object: &Object) -> Vec<String> {
    let mut facts = Vec::new();
    facts.extend(object.value.map(|value| match value {
        Present::Adc(share) => format!("reads {:.1} %", share * 100.0),
        Present::Duty(share) => format!("on {:.1} %", share * 100.0),
        Present::Steps(steps) => format!("at {steps} steps"),
    }));
    if object.repeats {
        facts.push("fails, and repeats its last answers".into());
    }
    if object.queued > 0 {
        facts.push(format!("{} queued", object.queued));
    }
    facts.extend(object.bus.map(transfers));
    let oid = object.oid.map_or(String::new(), |oid| format!("oid {oid}"));
    vec![oid, object.kind.clone(), object.pin.clone().unwrap_or_default(), facts.join(", ")]
}

fn transfers(BusCounts { transfers, errors, retries }: BusCounts) -> String {
    format!("{transfers} transfers, {errors} failed, {retries} of them tried again")
}

fn table(page: &mut Page, head: &str, rows: Vec<Vec<String>>) {
    for (n, line) in aligned(&rows).iter().enumerate() {
        page.line(format_args!("{:<HEAD$}{line}", if n == 0 { head } else { "" }));
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::stopped;
    use super::*;

    #[test]
    fn a_page_shows_all_and_obeys_nothing() {
        let page = page(&stopped()).to_string();
        for line in [
            "pinion    1, process 5, up for 1 h 1 min",
            "state     SHUT DOWN 1 min 1 s ago: ADC out of range: oid 3?[2J",
            "host      process 7, klippy of /home/pi/klipper (abc); dialect master",
            "guardian  process 6",
            "timers    10 run, late by p50 1.0 us, p99 2.0 us, p99.9 3.0 us, at most 4.0 us; the core wakes 50.0 us early",
            "queues    moves 3 of 1024, commands 0, spi0 1",
            "lines     gpio\"1  output  high",
            "          gpio2   input   not read yet  7 transfers, 3 failed, 2 of them tried again",
            "objects   oid 0  SPI device  gpio8  9 transfers, 2 failed, 1 of them tried again",
            "          oid 1  stepper     gpio9  at -5 steps, 3 queued",
        ] {
            assert!(page.lines().any(|shown| shown == line), "{line}\n{page}");
        }
        assert!(!page.contains('\x1b'));
    }

    #[test]
    fn fields_that_the_core_does_not_report_are_left_out() {
        let page = page(&Status { state: State::Unknown, mcu: None, ..stopped() }).to_string();
        assert!(page.contains("the core has not answered") && !page.contains("queues"), "{page}");
    }
}
