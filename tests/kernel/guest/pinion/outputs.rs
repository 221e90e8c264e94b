// SPDX-License-Identifier: GPL-3.0-or-later
//! Outputs of every kind, switched on: their values after a failure.

use std::path::Path;

use pinion_client::Client;

use crate::gpio_sim::GpioSim;
use crate::mock::pwm;
use crate::program::{configure, run};
use crate::sysfs;
use crate::trace::Trace;

const PWM_CHIP: &str = "/sys/class/pwm/pwmchip0";
/// A duty cycle of a quarter, of 32768.
const QUARTER: u16 = 8192;

/// A GPIO output: its object, its shutdown value, and its cycle in milliseconds if it is pulsed.
struct Line {
    offset: u32,
    default: bool,
    cycle_ms: Option<u32>,
}

/// A heater and its inverted twin, both pulsed at half power; a fan and an inverted motor
/// driver, both on.
const LINES: [Line; 4] = [
    Line { offset: 0, default: false, cycle_ms: Some(20) },
    Line { offset: 1, default: true, cycle_ms: Some(30) },
    Line { offset: 2, default: false, cycle_ms: None },
    Line { offset: 3, default: true, cycle_ms: None },
];

/// Hardware PWM: a channel of the mocked chip, and its shutdown value.
const CHANNELS: [(usize, u16); 2] = [(4, 0), (5, 2 * QUARTER)];

/// The outputs' hardware.
pub struct Outputs {
    sim: GpioSim,
}

impl Outputs {
    pub fn new() -> Outputs {
        Outputs { sim: GpioSim::new("lab", 8) }
    }

    /// Configures the outputs, and switches them on. The host must refresh each of them within `max_duration_ms`,
    /// unless that is 0.
    pub fn switch_on(&self, client: &mut Client, max_duration_ms: u32) {
        let max_duration = 50_000 * max_duration_ms;
        let mut config = Vec::new();
        for (oid, Line { offset, default, cycle_ms }) in LINES.iter().enumerate() {
            let default = u8::from(*default);
            config.push(format!(
                "config_digital_out oid={oid} pin=lab/gpio{offset} value={default} default_value={default} max_duration={max_duration}"
            ));
            let cycle_ticks = 50_000 * cycle_ms.unwrap_or(1);
            config.push(format!("set_digital_out_pwm_cycle oid={oid} cycle_ticks={cycle_ticks}"));
        }
        for (oid, (channel, default)) in (LINES.len()..).zip(CHANNELS) {
            config.push(format!(
                "config_pwm_out oid={oid} pin=pwmchip0/pwm{channel} cycle_ticks=50000 value={default} default_value={default} max_duration={max_duration}"
            ));
        }
        configure(client, (LINES.len() + CHANNELS.len()) as u8, &config);
        assert_eq!(CHANNELS.map(|(channel, _)| pwm::output(channel)), Self::safe_channels());

        let at = client.clock_in(0.05).expect("the clock").wire();
        for (oid, line) in LINES.iter().enumerate() {
            let on_ticks = line.cycle_ms.map_or(if line.default { 0 } else { 50_000 }, |cycle_ms| 25_000 * cycle_ms);
            run(client, &format!("queue_digital_out oid={oid} clock={at} on_ticks={on_ticks}"));
        }
        for oid in (LINES.len()..).take(CHANNELS.len()) {
            run(client, &format!("queue_pwm_out oid={oid} clock={at} value={QUARTER}"));
        }
        let on = CHANNELS.map(|(channel, _)| format!("{channel} 1000000 250000 1"));
        sysfs::wait_until("hardware PWM is on", || CHANNELS.map(|(channel, _)| pwm::output(channel)) == on);
        self.wait_until_on();
    }

    /// Waits until no line is at its shutdown value. The pulsed lines are there half of the time. So a stop now must
    /// drive all lines.
    pub fn wait_until_on(&self) {
        sysfs::wait_until("the lines are on", || LINES.iter().all(|line| self.sim.level(line.offset) != line.default));
    }

    fn safe_channels() -> [String; 2] {
        // A channel with the value zero is switched off, whatever its duty cycle.
        CHANNELS.map(|(channel, default)| match default {
            0 => {
                let present = pwm::output(channel);
                let (duty, _) = present.rsplit_once(' ').expect("a channel's state");
                format!("{duty} 0")
            }
            _ => format!("{channel} 1000000 500000 1"),
        })
    }

    /// Waits until every output was driven to its shutdown value and stayed there. Returns the time (CLOCK_MONOTONIC,
    /// microseconds) of the last line. It uses the trace of writes, because a released line falls back by itself.
    pub fn assert_safe(&self, trace: &Trace) -> u64 {
        let last = |line: &Line| trace.writes_to(self.sim.kernel_number(line.offset)).pop();
        let is_safe = || LINES.iter().all(|line| last(line).is_some_and(|write| write.level == line.default));
        sysfs::wait_until("every line is at its shutdown value", is_safe);
        sysfs::wait_until("hardware PWM is at its shutdown value", || {
            CHANNELS.map(|(channel, _)| pwm::output(channel)) == Self::safe_channels()
        });
        // Longer than any cycle.
        std::thread::sleep(std::time::Duration::from_millis(100));
        assert!(is_safe(), "an output is still pulsed");
        LINES.iter().filter_map(last).map(|write| write.at_ns).max().expect("lines") / 1000
    }
}

impl Drop for Outputs {
    fn drop(&mut self) {
        for (channel, _) in CHANNELS {
            if Path::new(PWM_CHIP).join(format!("pwm{channel}")).exists() {
                let _ = sysfs::try_write(format!("{PWM_CHIP}/unexport"), channel.to_string());
            }
        }
    }
}
