// SPDX-License-Identifier: GPL-3.0-or-later
//! Analog inputs: oversampling, range check, reports of several readings, homing by their values.
//!
//! A reading may take its time on a worker. The samples keep their places in time as long as
//! the ADC keeps up; a slow one loses samples, never steps.

#![forbid(unsafe_code)]

use crate::board::{ADC_MAX, Adc, OnWorker, Pin};
use crate::mcu::{
    Command, Constant, Done, Errand, Feature, Mcu, Next, Object, Oid, Response, Ticket, TimerId, WireClock, WorkerId,
    command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::trigger_analog::Attached;

pub(super) const FEATURE: Feature = Feature {
    name: "analog_in",
    commands: &[CONFIG_ANALOG_IN, QUERY_ANALOG_IN, ANALOG_IN_ATTACH_TRIGGER_ANALOG],
    responses: &[State::FORMAT],
    constants: &[("ADC_MAX", Constant::Number(ADC_MAX as u32))],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `bytes_per_report` above 48.
    INVALID_BYTES_PER_REPORT = "Invalid analog_in bytes_per_report";
    /// A reading outside its range, `range_check_count` times in a row.
    ADC_RANGE = "ADC out of range";
}

response! {
    /// Sums of readings, two bytes each, low byte first.
    "analog_in_state oid=%c next_clock=%u values=%*s"
    pub(super) struct State<'a> { oid: Oid, next_clock: Clock, values: &'a [u8] }
}

/// Bytes of readings that a report holds.
const REPORT_BYTES: usize = 48;
const SAMPLE_BYTES: usize = 2;

/// One reading of a channel: there is one box for each input.
struct Reading {
    adc: Box<dyn Adc>,
    counts: Result<u16, Shutdown>,
}

impl Errand for Reading {
    fn run(&mut self) {
        self.counts = self.adc.read();
    }
}

struct AnalogIn {
    worker: WorkerId,
    /// Here while the ADC is not being read.
    reading: Option<Box<Reading>>,
    /// Whether a sample is due while the ADC is still busy with one of an earlier query.
    waiting: bool,
    sample_ticks: Ticks,
    sample_count: u8,
    rest_ticks: Ticks,
    min_value: u16,
    max_value: u16,
    range_check_count: u8,
    bytes_per_report: u8,
    /// The next first sample.
    next_begin: Clock,
    /// The sample under way.
    sample_at: Clock,
    taken: u8,
    /// Wraps as the firmware's does.
    sum: u16,
    invalid_count: u8,
    report: [u8; REPORT_BYTES],
    report_len: usize,
    /// Tells answers to an earlier query.
    tag: u8,
    attached: Attached,
}

impl AnalogIn {
    fn restart(&mut self) {
        self.taken = 0;
        self.sum = 0;
        self.waiting = false;
        self.tag = self.tag.wrapping_add(1);
    }

    /// Has the ADC read, as soon as it is free.
    fn sample(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        match self.reading.take() {
            Some(reading) => mcu.dispatch(self.worker, Ticket { oid, tag: self.tag }, reading),
            None => {
                self.waiting = true;
                Ok(())
            }
        }
    }

    /// The first sample after `self.next_begin`, past the ones that the ADC was too slow for.
    fn skip_missed(&mut self, now: Clock) {
        self.next_begin = self.next_begin + self.rest_ticks;
        let behind = now.since(self.next_begin);
        if behind <= 0 {
            return;
        }
        self.next_begin = match u64::from(self.rest_ticks.0) {
            // As fast as the ADC reads: nothing is missed.
            0 => now,
            rest => Clock::from_ticks(self.next_begin.ticks() + (behind as u64 / rest + 1) * rest),
        };
    }

    fn check_range(&mut self, mcu: &Mcu) -> Result<(), Shutdown> {
        if (self.min_value..=self.max_value).contains(&self.sum) {
            self.invalid_count = 0;
            return Ok(());
        }
        self.invalid_count = self.invalid_count.saturating_add(1);
        if self.invalid_count < self.range_check_count {
            return Ok(());
        }
        self.invalid_count = 0;
        mcu.try_shut_down(Shutdown::because(
            ADC_RANGE,
            format!(
                "it read {} where {} to {} is allowed (sum of {} samples): a heater past its limits, or a sensor that is broken or unplugged",
                self.sum, self.min_value, self.max_value, self.sample_count
            ),
        ))
    }

    fn report(&mut self, mcu: &mut Mcu, oid: Oid) {
        let bytes = self.sum.to_le_bytes();
        self.report[self.report_len..self.report_len + SAMPLE_BYTES].copy_from_slice(&bytes);
        self.report_len += SAMPLE_BYTES;
        if self.report_len + SAMPLE_BYTES > usize::from(self.bytes_per_report) {
            mcu.send(State { oid, next_clock: self.next_begin, values: &self.report[..self.report_len] });
            self.report_len = 0;
        }
    }
}

impl Object for AnalogIn {
    fn kind(&self) -> &'static str {
        "analog input"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        self.sample_at = at;
        if let Some(oid) = timer.oid() {
            self.sample(mcu, oid)?;
        }
        Ok(Next::Done)
    }

    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let (tag, read_at) = (done.tag, done.ended);
        let Some(mut reading) = done.errand::<Reading>() else { return Ok(()) };
        let counts = std::mem::replace(&mut reading.counts, Ok(0));
        self.reading = Some(reading);
        if tag != self.tag {
            return if std::mem::take(&mut self.waiting) { self.sample(mcu, oid) } else { Ok(()) };
        }
        let timer = TimerId::new(oid, 0);
        let counts = match counts {
            Ok(counts) => counts,
            Err(failure) => {
                // A stopped machine goes on with the next reading.
                mcu.try_shut_down(failure)?;
                self.restart();
                self.skip_missed(mcu.now());
                mcu.go_on(timer, self.next_begin);
                return Ok(());
            }
        };
        self.sum = self.sum.wrapping_add(counts);
        self.taken += 1;
        let now = mcu.now();
        if self.taken < self.sample_count {
            mcu.go_on(timer, (self.sample_at + self.sample_ticks).max(now));
            return Ok(());
        }
        self.check_range(mcu)?;
        self.skip_missed(now);
        self.attached.update(mcu, self.sum.into(), read_at)?;
        self.report(mcu, oid);
        self.restart();
        mcu.go_on(timer, self.next_begin);
        Ok(())
    }

    fn shutdown(&mut self, mcu: &mut Mcu, oid: Oid) {
        // What is under way counts no more.
        self.restart();
        self.attached = Attached::default();
        // Readings without rest would keep a stopped machine busy for ever.
        if self.sample_count == 0 || self.rest_ticks == Ticks(0) {
            return;
        }
        // The host sees temperatures of a stopped machine too.
        self.skip_missed(mcu.now());
        mcu.go_on(TimerId::new(oid, 0), self.next_begin);
    }
}

const CONFIG_ANALOG_IN: Command = command!("config_analog_in oid=%c pin=%u", |mcu, oid: Oid, pin: Pin| {
    mcu.vacant(oid)?;
    let OnWorker { bus, device } = mcu.board()?.adc(pin)?;
    let input = AnalogIn {
        worker: mcu.worker(&bus)?,
        reading: Some(Box::new(Reading { adc: device, counts: Ok(0) })),
        waiting: false,
        sample_ticks: Ticks(0),
        sample_count: 0,
        rest_ticks: Ticks(0),
        min_value: 0,
        max_value: 0,
        range_check_count: 0,
        bytes_per_report: 0,
        next_begin: Clock::EPOCH,
        sample_at: Clock::EPOCH,
        taken: 0,
        sum: 0,
        invalid_count: 0,
        report: [0; REPORT_BYTES],
        report_len: 0,
        tag: 0,
        attached: Attached::default(),
    };
    mcu.assign_on(pin, oid, input)
});

const QUERY_ANALOG_IN: Command = command!(
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c min_value=%hu max_value=%hu range_check_count=%c",
    |mcu,
     oid: Oid,
     clock: WireClock,
     sample_ticks: Ticks,
     sample_count: u8,
     rest_ticks: Ticks,
     bytes_per_report: u8,
     min_value: u16,
     max_value: u16,
     range_check_count: u8| {
        let at = mcu.instant(clock);
        mcu.with::<AnalogIn, _>(oid, |input, mcu| {
            mcu.cancel(TimerId::new(oid, 0));
            input.restart();
            input.next_begin = at;
            input.sample_ticks = sample_ticks;
            input.sample_count = sample_count;
            input.rest_ticks = rest_ticks;
            input.bytes_per_report = bytes_per_report;
            input.report_len = 0;
            input.min_value = min_value;
            input.max_value = max_value;
            input.range_check_count = range_check_count;
            if sample_count == 0 {
                return Ok(());
            }
            if usize::from(bytes_per_report) > REPORT_BYTES {
                return Err(Shutdown::by_host(
                    INVALID_BYTES_PER_REPORT,
                    format_args!("{bytes_per_report} bytes are asked for where a report has {REPORT_BYTES}"),
                ));
            }
            mcu.schedule(TimerId::new(oid, 0), at)
        })
    }
);

const ANALOG_IN_ATTACH_TRIGGER_ANALOG: Command = command!(
    "analog_in_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    |mcu, oid: Oid, trigger_analog_oid: Oid| {
        mcu.with::<AnalogIn, _>(oid, |input, mcu| input.attached.attach(mcu, trigger_analog_oid))
    }
);
