// SPDX-License-Identifier: GPL-3.0-or-later
//! Hardware PWM outputs: queued values, and `max_duration`. `max_duration` limits how long an output may differ from
//! its shutdown value without news from the host.

use crate::board::{OnWorker, PWM_MAX, Pin, Pwm};
use crate::mcu::{
    BusCounts, Calls, Command, Constant, Context, Feature, Finished, Next, Object, Oid, Present, Remote, Report, Safe,
    Settable, Timer, WireClock, command,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{Clock, Ticks};

use super::set_too_late;
use super::value_queue::{Texts, ValueQueue};

pub(super) const FEATURE: Feature = Feature {
    serves: "hardware PWM",

    commands: &[CONFIG_PWM_OUT, QUEUE_PWM_OUT, SET_PWM_OUT],
    constants: &[Constant::number("PWM_MAX", PWM_MAX as u32)],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// A hardware PWM output would stay on for longer than its `max_duration`.
    PWM_MAX_DURATION = "Scheduled pwm event will exceed max_duration";
    /// The host did not refresh a hardware PWM output in time.
    MISSED_PWM = "Missed scheduling of next hard pwm event";
}

const KIND: &str = "PWM output";

/// A PWM channel, on the worker of its chip.
struct Channel {
    pwm: Box<dyn Pwm>,
    calls: Calls,
}

/// A channel's setting: a value of 0 to [`PWM_MAX`]. `set_pwm_out` also sets a new period.
#[derive(Clone, Copy)]
struct Setting {
    value: u16,
    cycle: Option<Ticks>,
}

impl Settable for Channel {
    type Value = Setting;

    fn set(&mut self, Setting { value, cycle }: Setting) -> Result<(), Shutdown> {
        self.calls.repeat(|| match cycle {
            Some(cycle) => self.pwm.set_cycle(cycle, value),
            None => self.pwm.set(value),
        })
    }
}

/// Lets a worker set a channel, which is at `value`.
fn on_worker(
    context: &mut Context,
    number: u8,
    OnWorker { bus, device: pwm }: OnWorker<dyn Pwm>,
    value: u16,
) -> Result<(Remote<Channel>, Calls), Shutdown> {
    let calls = Calls::new(context.clock());
    let channel = context.device(&bus, Box::new(Channel { pwm, calls: calls.clone() }))?;
    Ok((Remote::new(number, channel, Setting { value, cycle: None }), calls))
}

const TEXTS: Texts = Texts { max_duration: PWM_MAX_DURATION, missed: MISSED_PWM };

struct PwmOut {
    channel: Remote<Channel>,
    calls: Calls,
    /// The last value that was set.
    value: u16,
    queue: ValueQueue,
}

impl PwmOut {
    fn write(&mut self, context: &mut Context, value: u16) -> Result<(), Shutdown> {
        self.value = value;
        self.channel.set(context, Setting { value, cycle: None })
    }
}

impl Object for PwmOut {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        let value = self.queue.pop(context)?;
        self.write(context, value)?;
        self.queue.next(value, at)
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        self.channel.settle(context, KIND, finished)
    }

    fn report(&self) -> Report {
        Report { queued: self.queue.len(), value: Some(Present::Pwm(self.value)), ..Report::default() }
    }

    fn counts(&self) -> Option<BusCounts> {
        Some(self.calls.counts())
    }

    fn shutdown(&mut self, context: &mut Context) {
        self.queue.clear(context);
    }

    fn make_safe(&mut self, context: &mut Context) -> Result<Safe, Shutdown> {
        self.write(context, self.queue.shutdown_value())?;
        Ok(Safe::Later)
    }
}

/// The channels that `set_pwm_out` has set. They belong to no object of the host. They keep their values even when the
/// MCU stops.
#[derive(Default)]
struct SetChannels(Vec<(Pin, Remote<Channel>)>);

impl SetChannels {
    /// Sets a channel. The channel stays open. As with `set_digital_out`, an open channel may be set again at any time.
    /// A new one is refused after `finalize_config`.
    fn set(&mut self, context: &mut Context, pin: Pin, cycle: Ticks, value: u16) -> Result<(), Shutdown> {
        let known = self.0.iter().position(|(held, _)| *held == pin);
        match known {
            Some(place) if context.is_finalized() => {
                let setting = Setting { value, cycle: Some(cycle) };
                self.0[place].1.set(context, setting)
            }
            _ if context.is_finalized() => Err(set_too_late(context, reason::PWM_CONFIG, "set_pwm_out", pin)),
            None if self.0.len() > usize::from(u8::MAX) => {
                Err(Shutdown::by_host(reason::PWM_CONFIG, "set_pwm_out wants more than 256 channels"))
            }
            _ => {
                let (channel, _) = context.pwm(pin, cycle, value, value)?;
                let place = known.unwrap_or(self.0.len());
                let (channel, _) = on_worker(context, place as u8, channel, value)?;
                match self.0.get_mut(place) {
                    Some(known) => known.1 = channel,
                    None => self.0.push((pin, channel)),
                }
                Ok(())
            }
        }
    }
}

impl Object for SetChannels {
    fn kind(&self) -> &'static str {
        "set_pwm_out"
    }

    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let channel = self.0.get_mut(usize::from(number));
        channel.map_or(Ok(()), |(_, channel)| channel.settle(context, "set_pwm_out", finished))
    }
}

const CONFIG_PWM_OUT: Command = command!(
    "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u",
    |context, oid: Oid, pin: Pin, cycle_ticks: Ticks, value: u16, default_value: u16, max_duration: Ticks| {
        context.vacant(oid)?;
        let (channel, shutdown_value) = context.pwm(pin, cycle_ticks, value, default_value)?;
        let (channel, calls) = on_worker(context, 0, channel, value)?;
        let queue = ValueQueue::new(shutdown_value, max_duration, &TEXTS);
        context.assign_on(pin, oid, PwmOut { channel, calls, value, queue })
    }
);

const QUEUE_PWM_OUT: Command =
    command!("queue_pwm_out oid=%c clock=%u value=%hu", PwmOut, |output, context, clock: WireClock, value: u16| {
        let at = context.instant(clock);
        output.queue.queue(context, at, value)
    });

const SET_PWM_OUT: Command =
    command!("set_pwm_out pin=%u cycle_ticks=%u value=%hu", |context, pin: Pin, cycle_ticks: Ticks, value: u16| {
        let oid = context.own::<SetChannels>();
        context.with::<SetChannels, _>(oid, |channels, context| channels.set(context, pin, cycle_ticks, value))
    });
