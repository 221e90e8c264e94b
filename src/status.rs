// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion status`: asks a running Pinion for its status.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use pinion_runtime::status::form::Status;

use super::failed;
use super::page::{Page, print};

mod ask;
mod prometheus;
mod text;
mod watch;

pub(crate) use ask::fetch;
pub use ask::{Answer, ask_at};

/// Options of `pinion status`.
#[derive(Args, Clone, Debug)]
pub(crate) struct StatusArgs {
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Print metrics for a Prometheus scraper
    #[arg(long, conflicts_with = "json")]
    prometheus: bool,
    /// Print the state every second, until q or Ctrl-C. On a terminal it stays in place, and arrows and page keys
    /// scroll
    #[arg(long)]
    watch: bool,
    /// The link of the instance to ask
    #[arg(short = 'I', value_name = "PATH", default_value = "/tmp/klipper_host_mcu")]
    symlink: PathBuf,
    /// The socket of the instance, if its path does not follow from the link's name
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

/// Prints the instance's status.
pub(crate) fn run(args: &StatusArgs) -> ExitCode {
    let done = match args.watch {
        true => watch::watch(args),
        false => ask::ask(args).and_then(|answer| {
            if let Some(notice) = answer.notice {
                log::warn!("{notice}");
            }
            print(&show(args, &answer.status))
        }),
    };
    done.map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn show(args: &StatusArgs, status: &Status) -> Page {
    match (args.json, args.prometheus) {
        (true, _) => json(status),
        (_, true) => prometheus::page(status),
        _ => text::page(status),
    }
}

fn json(status: &Status) -> Page {
    match serde_json::to_string_pretty(status) {
        Ok(json) => Page::json(&(json + "\n")),
        Err(error) => unreachable!("maps of texts are JSON: {error}"),
    }
}

/// For `fuzz/`: each form in which a status is printed. JSON is the last one.
#[cfg(fuzzing)]
pub const FORMS: [fn(&Status) -> Page; 3] = [text::page, prometheus::page, json];

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_testkit::names::any_name;
    use pinion_testkit::names::assert_plain;
    use proptest::prelude::*;
    use serde_json::{Value, json};

    /// The status of a Pinion that is shut down, with an example of everything.
    pub(crate) fn stopped() -> Status {
        let document = json!({
            "form": 1, "version": "1", "pid": 5, "uptime_s": 3700.0, "link": "/tmp/l", "terminal": "/dev/pts/1",
            "board": "b", "state": "shutdown",
            "shutdown": { "reason": "ADC out of range", "detail": "oid 3\u{1b}[2J", "ago_s": 61.0 },
            "dialect": "master", "owes": null,
            "host": { "attached": true, "pid": 7, "sure": true, "checkout": "/home/pi/klipper", "commit": "abc" },
            "guardian": { "present": true, "pid": 6 },
            "lines": [
                { "pin": "gpio\"1", "use": "output", "level": 1, "bus": null },
                { "pin": "gpio2", "use": "input", "level": null, "bus": { "transfers": 7, "errors": 3, "retries": 2 } },
            ],
            "objects": [
                { "oid": 0, "kind": "SPI device", "pin": "gpio8", "queued": 0, "value": null,
                  "bus": { "transfers": 9, "errors": 2, "retries": 1 } },
                { "oid": 1, "kind": "stepper", "pin": "gpio9", "queued": 3, "value": { "steps": -5 }, "bus": null },
            ],
            "lateness": { "timers": 10, "p50_us": 1.0, "p99_us": 2.0, "p999_us": 3.0, "max_us": 4.0, "margin_us": 50.0, "buckets_us": [] },
            "queues": { "moves": { "waiting": 3, "size": 1024 }, "commands": { "waiting": 0, "size": 256, "held": false },
                        "workers": [{ "name": "spi0", "waiting": 1 }] },
        });
        let (status, unknown) = pinion_runtime::status::form::read(document.to_string().as_bytes()).unwrap();
        assert_eq!(unknown, [""; 0]);
        status
    }

    /// Replaces each text that an instance chooses.
    fn rename(value: &mut Value, name: &str) {
        match value {
            Value::String(text) => *text = name.to_owned(),
            Value::Array(values) => values.iter_mut().for_each(|value| rename(value, name)),
            // These are our own words.
            Value::Object(values) => {
                let values = values.iter_mut().filter(|(key, _)| !["state", "use"].contains(&key.as_str()));
                values.for_each(|(_, value)| rename(value, name));
            }
            _ => {}
        }
    }

    proptest! {
        #[test]
        fn any_words_of_an_instance_stay_in_its_line(name in any_name()) {
            let called = |name: &str| {
                let mut document = json!(stopped());
                rename(&mut document, name);
                pinion_runtime::status::form::read(document.to_string().as_bytes()).unwrap().0
            };
            for show in [text::page, prometheus::page, json] {
                assert_plain(&show(&called(&name)).to_string(), show(&called("x")).lines().count());
            }
        }
    }
}
