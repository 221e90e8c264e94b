// SPDX-License-Identifier: GPL-3.0-or-later
//! The status in Prometheus's text exposition format, version 0.0.4.

use crate::page::Page;
use pinion_runtime::status::form::{BusCounts, McuStatus, Present, State, Status};

/// How a metric reads the bus counts.
type Count = fn(&BusCounts) -> u32;
/// How a metric reads a present value; `None` if it is of another kind.
type Measure = fn(&Present) -> Option<f64>;

/// Writes the metrics.
pub(super) fn page(status: &Status) -> Page {
    let mut out = Metrics(Page::default());
    let mcu = status.mcu.as_ref();
    out.head("pinion_info", "gauge", "The program and the host that it serves");
    let dialect = mcu.and_then(|mcu| mcu.dialect.clone());
    out.sample(
        "pinion_info",
        &[("version", text(&status.version)), ("link", text(&status.link)), ("dialect", dialect)],
        1.0,
    );
    out.one("pinion_uptime_seconds", "gauge", "Time since the start", status.uptime_s);
    out.head("pinion_state", "gauge", "1 for the present state of the MCU");
    for state in State::ALL {
        out.sample("pinion_state", &[("state", text(state.name()))], yes(status.state == state));
    }
    if let Some(stop) = mcu.and_then(|mcu| mcu.shutdown.as_ref()) {
        out.head("pinion_shutdown_info", "gauge", "Why the MCU is shut down");
        out.sample("pinion_shutdown_info", &[("reason", text(&stop.reason))], 1.0);
    }
    out.one("pinion_host_attached", "gauge", "Whether a host is there", yes(status.host.attached));
    let guarded = yes(status.guardian.present);
    out.one("pinion_guardian_present", "gauge", "Whether a guardian holds the outputs", guarded);
    if let Some(mcu) = mcu {
        queues(&mut out, mcu);
    }
    objects(&mut out, mcu);
    out.0
}

fn queues(out: &mut Metrics, McuStatus { lateness: late, queues, .. }: &McuStatus) {
    let name = "pinion_timer_lateness_seconds";
    out.head(name, "summary", "How late timers ran, since the start");
    for (quantile, late_us) in
        [("0.5", late.p50_us), ("0.99", late.p99_us), ("0.999", late.p999_us), ("1", late.max_us)]
    {
        out.sample(name, &[("quantile", text(quantile))], late_us / 1e6);
    }
    out.sample("pinion_timer_lateness_seconds_count", &[], late.timers as f64);
    out.one("pinion_moves_queued", "gauge", "Moves in the move queue", queues.moves.waiting.into());
    out.one("pinion_moves_size", "gauge", "Moves that the queue has room for", queues.moves.size.into());
    let waiting = queues.commands.waiting as f64;
    out.one("pinion_commands_waiting", "gauge", "Blocks of commands that wait for the core", waiting);
    out.head("pinion_worker_jobs", "gauge", "Jobs that wait for a bus");
    for worker in &queues.workers {
        out.sample("pinion_worker_jobs", &[("bus", text(&worker.name))], worker.waiting as f64);
    }
}

fn objects(out: &mut Metrics, mcu: Option<&McuStatus>) {
    let (lines, objects) = mcu.map_or((&[][..], &[][..]), |mcu| (&mcu.lines, &mcu.objects));
    out.head("pinion_line_level", "gauge", "Level of a GPIO line, as last driven or sampled");
    for line in lines {
        if let Some(level) = line.level {
            out.sample("pinion_line_level", &[("pin", text(&line.pin)), ("use", text(line.use_.name()))], level.into());
        }
    }
    let counts: [(&str, &str, Count); 3] = [
        ("transfers", "Transfers to a chip", |bus| bus.transfers),
        ("errors", "Transfers to a chip that failed", |bus| bus.errors),
        ("retries", "Failed transfers that were tried again", |bus| bus.retries),
    ];
    for (key, help, count) in counts {
        let name = format!("pinion_bus_{key}_total");
        out.head(&name, "counter", help);
        for object in objects {
            if let Some(bus) = &object.bus {
                out.sample(&name, &[("oid", number(object.oid)), ("kind", text(&object.kind))], count(bus).into());
            }
        }
        for line in lines {
            if let Some(bus) = &line.bus {
                out.sample(&name, &[("kind", text("line")), ("pin", text(&line.pin))], count(bus).into());
            }
        }
    }
    let values: [(&str, &str, Measure); 3] = [
        ("pinion_pwm_duty_ratio", "For how much of each period an output is on", |value| match value {
            Present::Duty(share) => Some(*share),
            _ => None,
        }),
        ("pinion_adc_ratio", "An ADC's last sample, of full scale", |value| match value {
            Present::Adc(share) => Some(*share),
            _ => None,
        }),
        ("pinion_stepper_position_steps", "A stepper's position", |value| match value {
            Present::Steps(steps) => Some(f64::from(*steps)),
            _ => None,
        }),
    ];
    for (name, help, measure) in values {
        out.head(name, "gauge", help);
        for object in objects {
            if let Some(value) = object.value.as_ref().and_then(measure) {
                out.sample(name, &[("oid", number(object.oid)), ("pin", object.pin.clone())], value);
            }
        }
    }
}

fn text(label: &str) -> Option<String> {
    Some(label.to_owned())
}

fn number(label: Option<u8>) -> Option<String> {
    label.map(|label| label.to_string())
}

fn yes(is: bool) -> f64 {
    f64::from(u8::from(is))
}

struct Metrics(Page);

impl Metrics {
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        self.0.line(format_args!("# HELP {name} {help}"));
        self.0.line(format_args!("# TYPE {name} {kind}"));
    }

    /// A label without a value is left out.
    fn sample(&mut self, name: &str, labels: &[(&str, Option<String>)], value: f64) {
        let labels = labels.iter().filter_map(|(label, value)| {
            let value = value.as_ref()?.replace('\\', "\\\\").replace('"', "\\\"");
            Some(format!("{label}=\"{value}\""))
        });
        let labels = labels.collect::<Vec<_>>().join(",");
        let labels = if labels.is_empty() { labels } else { format!("{{{labels}}}") };
        self.0.line(format_args!("{name}{labels} {value}"));
    }

    fn one(&mut self, name: &str, kind: &str, help: &str, value: f64) {
        self.head(name, kind, help);
        self.sample(name, &[], value);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::stopped;
    use super::*;

    #[test]
    fn metrics_have_a_type_each_and_labels_that_end() {
        let metrics = page(&stopped()).to_string();
        for line in [
            "pinion_info{version=\"1\",link=\"/tmp/l\",dialect=\"master\"} 1",
            "pinion_state{state=\"shutdown\"} 1",
            "pinion_state{state=\"configured\"} 0",
            "pinion_line_level{pin=\"gpio\\\"1\",use=\"output\"} 1",
            "pinion_timer_lateness_seconds{quantile=\"0.99\"} 0.000002",
            "pinion_timer_lateness_seconds_count 10",
            "pinion_bus_errors_total{oid=\"0\",kind=\"SPI device\"} 2",
            "pinion_bus_errors_total{kind=\"line\",pin=\"gpio2\"} 3",
            "pinion_stepper_position_steps{oid=\"1\",pin=\"gpio9\"} -5",
            "pinion_worker_jobs{bus=\"spi0\"} 1",
        ] {
            assert!(metrics.lines().any(|shown| shown == line), "{line}\n{metrics}");
        }
        assert!(!metrics.contains("pinion_line_level{pin=\"gpio2"), "what was not looked at has no level");
        for sample in metrics.lines().filter(|line| !line.starts_with('#')) {
            let name = sample.split(['{', ' ']).next().unwrap().trim_end_matches("_count");
            assert_eq!(metrics.matches(&format!("# TYPE {name} ")).count(), 1, "{name}");
            sample.rsplit_once(' ').unwrap().1.parse::<f64>().unwrap();
        }
    }

    #[test]
    fn a_core_that_does_not_answer_has_no_queues() {
        let metrics = page(&Status { state: State::Unknown, mcu: None, ..stopped() }).to_string();
        assert!(metrics.contains("pinion_info{version=\"1\",link=\"/tmp/l\"} 1\n"), "{metrics}");
        assert!(metrics.contains("pinion_state{state=\"unknown\"} 1\n") && !metrics.contains("queued"), "{metrics}");
    }
}
