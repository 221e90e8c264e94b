// SPDX-License-Identifier: GPL-3.0-or-later
//! Analog inputs: oversampling, range check, reports of several readings, homing by their values.
//!
//! A worker takes the readings, as each may block for a while. If the ADC is slower than the host
//! wants, samples are left out; timers and steps do not wait for it. A reading that fails leaves its sum out.

#![forbid(unsafe_code)]

use crate::board::{ADC_MAX, Adc, OnWorker, Pin};
use crate::mcu::{
    BusCounts, Calls, Command, Constant, Done, Errand, Feature, Generation::Kalico, Generation::Master,
    Generation::V0_13, Mcu, Next, Object, Oid, Present, Report, Response, Ticket, TimerId, Unread, WireClock, WorkerId,
    command, response, since, until,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::trigger_analog::Attached;

pub(super) const FEATURE: Feature = Feature {
    name: "analog_in",
    commands: &[CONFIG_ANALOG_IN, QUERY_ANALOG_IN, QUERY_ANALOG_IN_FOR_BATCHES, ANALOG_IN_ATTACH_TRIGGER_ANALOG],
    responses: &[State::FORM, Batch::FORM],
    constants: &[Constant::number("ADC_MAX", ADC_MAX as u32)],
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
    /// A sum of readings.
    "analog_in_state oid=%c next_clock=%u value=%hu" => until(V0_13).and(Kalico);
    pub(super) struct State { oid: Oid, next_clock: Clock, value: u16 }
}

response! {
    /// Sums of readings, two bytes each, low byte first.
    "analog_in_state oid=%c next_clock=%u values=%*s" => since(Master);
    pub(super) struct Batch<'a> { oid: Oid, next_clock: Clock, values: &'a [u8] }
}

/// How many bytes of readings a report holds at most.
const REPORT_BYTES: usize = 48;
const SAMPLE_BYTES: usize = 2;

/// One reading of a channel. Each input has one box of these, which is used again and again.
struct Reading {
    adc: Box<dyn Adc>,
    calls: Calls,
    counts: Result<u16, Shutdown>,
}

impl Errand for Reading {
    fn run(&mut self) {
        self.counts = self.calls.repeat(|| self.adc.read());
    }
}

/// How many bytes of sums are reported together: at most [`REPORT_BYTES`].
#[derive(Clone, Copy)]
struct BytesPerReport(u8);

impl BytesPerReport {
    /// # Errors
    ///
    /// "Invalid analog_in bytes_per_report".
    fn of(bytes: u8) -> Result<BytesPerReport, Shutdown> {
        if usize::from(bytes) > REPORT_BYTES {
            return Err(Shutdown::by_host(
                INVALID_BYTES_PER_REPORT,
                format_args!("{bytes} bytes are asked for where a report has {REPORT_BYTES}"),
            ));
        }
        Ok(BytesPerReport(bytes))
    }

    /// Whether a report of `len` bytes has room for one more sum.
    fn has_room(self, len: usize) -> bool {
        len + SAMPLE_BYTES <= usize::from(self.0)
    }
}

/// What the host asks for.
#[derive(Clone, Copy, Default)]
struct Query {
    sample_ticks: Ticks,
    sample_count: u8,
    rest_ticks: Ticks,
    min_value: u16,
    max_value: u16,
    range_check_count: u8,
    /// Of a batch; none if each sum is a report of its own.
    bytes_per_report: Option<BytesPerReport>,
}

struct AnalogIn {
    worker: WorkerId,
    /// None while the ADC is being read: then the worker has the box.
    reading: Option<Box<Reading>>,
    calls: Calls,
    unread: Unread,
    /// Whether a sample waits until the ADC is done with one of an earlier query.
    waiting: bool,
    query: Query,
    /// When the first sample of the next sum is due.
    next_begin: Clock,
    /// When the present sample was due.
    sample_at: Clock,
    /// How many samples the present sum has.
    taken: u8,
    /// The sum of the samples. It wraps around, as the firmware's does.
    sum: u16,
    /// The sample that was taken last.
    last: Option<u16>,
    invalid_count: u8,
    report: [u8; REPORT_BYTES],
    report_len: usize,
    /// Changes with every [`AnalogIn::restart`]: a reading with another tag was begun before it, and
    /// does not count.
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

    /// Has the worker read the ADC, or remembers to once the reading under way is back.
    fn sample(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        match self.reading.take() {
            Some(reading) => {
                self.unread.asked(mcu.now());
                mcu.dispatch(self.worker, Ticket { oid, tag: self.tag }, reading)
            }
            None => {
                self.waiting = true;
                Ok(())
            }
        }
    }

    /// Moves `next_begin` on by `rest_ticks`, or by as many of them as it takes to lie in the future:
    /// what was due before is left out, as the ADC was too slow for it.
    fn skip_missed(&mut self, now: Clock) {
        self.next_begin = self.next_begin + self.query.rest_ticks;
        let behind = now.since(self.next_begin);
        if behind <= 0 {
            return;
        }
        self.next_begin = match u64::from(self.query.rest_ticks.0) {
            // Without a pause the next sum just begins now.
            0 => now,
            rest => Clock::from_ticks(self.next_begin.ticks() + (behind as u64 / rest + 1) * rest),
        };
    }

    fn check_range(&mut self, mcu: &Mcu) -> Result<(), Shutdown> {
        // So Kalico has limits ignored (`temp_ignore_limits`).
        if self.query.range_check_count == 0 && mcu.serves(since(Kalico)) {
            return Ok(());
        }
        if (self.query.min_value..=self.query.max_value).contains(&self.sum) {
            self.invalid_count = 0;
            return Ok(());
        }
        self.invalid_count = self.invalid_count.saturating_add(1);
        if self.invalid_count < self.query.range_check_count {
            return Ok(());
        }
        self.invalid_count = 0;
        mcu.try_shut_down(Shutdown::because(
            ADC_RANGE,
            format!(
                "it read {} where {} to {} is allowed (sum of {} samples): a heater past its limits, or a sensor that is broken or unplugged",
                self.sum, self.query.min_value, self.query.max_value, self.query.sample_count
            ),
        ))
    }

    fn query(&mut self, mcu: &mut Mcu, oid: Oid, at: Clock, query: Query) -> Result<(), Shutdown> {
        mcu.cancel(TimerId::sampling(oid, 0));
        self.restart();
        self.next_begin = at;
        self.query = query;
        self.report_len = 0;
        if query.sample_count == 0 {
            return Ok(());
        }
        mcu.schedule(TimerId::sampling(oid, 0), at)
    }

    fn report(&mut self, mcu: &mut Mcu, oid: Oid) {
        let Some(bytes_per_report) = self.query.bytes_per_report else {
            return mcu.send(State { oid, next_clock: self.next_begin, value: self.sum });
        };
        let bytes = self.sum.to_le_bytes();
        self.report[self.report_len..self.report_len + SAMPLE_BYTES].copy_from_slice(&bytes);
        self.report_len += SAMPLE_BYTES;
        if !bytes_per_report.has_room(self.report_len) {
            mcu.send(Batch { oid, next_clock: self.next_begin, values: &self.report[..self.report_len] });
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
        let Some(reading) = done.errand::<Reading>() else { return Ok(()) };
        let reading = self.reading.insert(reading);
        if reading.counts.is_ok() {
            self.unread.read();
        }
        if tag != self.tag {
            return if std::mem::take(&mut self.waiting) { self.sample(mcu, oid) } else { Ok(()) };
        }
        let timer = TimerId::sampling(oid, 0);
        // A failure stays in its box, as the core would free it.
        let counts = match &reading.counts {
            Ok(counts) => *counts,
            Err(failure) => {
                // A move may depend on it.
                let at_once = !matches!(self.attached, Attached::Nothing);
                if at_once || self.unread.is_too_long(read_at) {
                    mcu.try_shut_down(failure.clone())?;
                }
                // This sum is given up, and the next one begins in its turn.
                self.restart();
                self.skip_missed(mcu.now());
                mcu.go_on(timer, self.next_begin);
                return Ok(());
            }
        };
        self.last = Some(counts);
        self.sum = self.sum.wrapping_add(counts);
        self.taken += 1;
        let now = mcu.now();
        if self.taken < self.query.sample_count {
            mcu.go_on(timer, (self.sample_at + self.query.sample_ticks).max(now));
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

    fn report(&self) -> Report {
        Report { queued: 0, value: self.last.map(Present::Adc) }
    }

    fn counts(&self) -> Option<BusCounts> {
        Some(self.calls.counts())
    }

    fn shutdown(&mut self, mcu: &mut Mcu, oid: Oid) {
        // A reading that is under way does not count any more.
        self.restart();
        self.attached = Attached::default();
        // Without a pause between sums a stopped machine would be busy with them for ever.
        if self.query.sample_count == 0 || self.query.rest_ticks == Ticks(0) {
            return;
        }
        // Sampling goes on, as in the firmware, so that the host sees the temperatures of a stopped
        // machine, too.
        self.skip_missed(mcu.now());
        mcu.go_on(TimerId::sampling(oid, 0), self.next_begin);
    }
}

const CONFIG_ANALOG_IN: Command = command!("config_analog_in oid=%c pin=%u", |mcu, oid: Oid, pin: Pin| {
    mcu.vacant(oid)?;
    let OnWorker { bus, device: adc } = mcu.board()?.adc(pin)?;
    let calls = Calls::new(mcu.clock());
    let input = AnalogIn {
        worker: mcu.worker(&bus)?,
        reading: Some(Box::new(Reading { adc, calls: calls.clone(), counts: Ok(0) })),
        calls,
        unread: Unread::default(),
        waiting: false,
        query: Query::default(),
        next_begin: Clock::EPOCH,
        sample_at: Clock::EPOCH,
        taken: 0,
        sum: 0,
        last: None,
        invalid_count: 0,
        report: [0; REPORT_BYTES],
        report_len: 0,
        tag: 0,
        attached: Attached::default(),
    };
    mcu.assign_on(pin, oid, input)
});

const QUERY_ANALOG_IN: Command = command!(
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u min_value=%hu max_value=%hu range_check_count=%c",
    |mcu,
     oid: Oid,
     clock: WireClock,
     sample_ticks: Ticks,
     sample_count: u8,
     rest_ticks: Ticks,
     min_value: u16,
     max_value: u16,
     range_check_count: u8| {
        let at = mcu.instant(clock);
        let bytes_per_report = None;
        let query =
            Query { sample_ticks, sample_count, rest_ticks, min_value, max_value, range_check_count, bytes_per_report };
        mcu.with::<AnalogIn, _>(oid, |input, mcu| input.query(mcu, oid, at, query))
    }
)
.of(until(V0_13).and(Kalico));

const QUERY_ANALOG_IN_FOR_BATCHES: Command = command!(
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
            let bytes_per_report = Some(BytesPerReport::of(bytes_per_report)?);
            let query = Query {
                sample_ticks,
                sample_count,
                rest_ticks,
                min_value,
                max_value,
                range_check_count,
                bytes_per_report,
            };
            input.query(mcu, oid, at, query)
        })
    }
)
.of(since(Master));

const ANALOG_IN_ATTACH_TRIGGER_ANALOG: Command = command!(
    "analog_in_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    |mcu, oid: Oid, trigger_analog_oid: Oid| {
        mcu.with::<AnalogIn, _>(oid, |input, mcu| input.attached.attach(mcu, trigger_analog_oid))
    }
)
.of(since(Master));
