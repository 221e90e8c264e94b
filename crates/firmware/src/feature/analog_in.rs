// SPDX-License-Identifier: GPL-3.0-or-later
//! Analog inputs: oversampling, range check, reports of several readings, homing by their values.
//!
//! A worker takes the readings, because each may block. If the ADC is slower than the host wants, samples are skipped.
//! Timers and steps do not wait for it. A failed reading drops its sum.

use super::ds18b20::CONFIG_DS18B20_OF_KALICO;
use crate::board::{ADC_MAX, Adc, OnWorker, Pin};
use crate::mcu::DialectName::{Kalico, Master, V0_11, V0_12, V0_13};
use crate::mcu::{
    Back, BusCounts, Calls, Command, Constant, Context, DeviceId, Feature, Finished, Hosts, Job, JobSlot, Next, Object,
    Oid, Present, Report, Response, Timer, Unread, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::trigger_analog::Attached;

pub(super) const FEATURE: Feature = Feature {
    serves: "thermistors and other analog inputs",

    commands: &[CONFIG_ANALOG_IN, QUERY_ANALOG_IN, QUERY_ANALOG_IN_FOR_BATCHES, ANALOG_IN_ATTACH_TRIGGER_ANALOG],
    responses: &[State::FORM, Batch::FORM],
    constants: &[Constant::number("ADC_MAX", ADC_MAX as u32)],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `bytes_per_report` above 48.
    INVALID_BYTES_PER_REPORT = "Invalid analog_in bytes_per_report";
    /// A value was outside its range, `range_check_count` times in a row.
    ADC_RANGE = "ADC out of range";
}

response! {
    /// A sum of readings.
    "analog_in_state oid=%c next_clock=%u value=%hu" => Hosts::of(&[V0_11, V0_12, V0_13, Kalico]).with(QUERY_ANALOG_IN.format);
    pub(super) struct State { oid: Oid, next_clock: Clock, value: u16 }
}

response! {
    /// Sums of readings, two bytes each, low byte first.
    "analog_in_state oid=%c next_clock=%u values=%*s" => Hosts::of(&[Master]).with(QUERY_ANALOG_IN_FOR_BATCHES.format);
    pub(super) struct Batch<'a> { oid: Oid, next_clock: Clock, values: &'a [u8] }
}

/// Highest number of bytes of readings in a report.
const REPORT_BYTES: usize = 48;
const SAMPLE_BYTES: usize = 2;

const TIMER: Timer = Timer::sampling(0);

/// A channel, on the worker of its chip.
struct Channel {
    adc: Box<dyn Adc>,
    calls: Calls,
}

/// One reading of a channel.
struct Read;

impl Job for Read {
    type Device = Channel;
    type Out = u16;
    type Failure = Shutdown;

    fn run(&mut self, channel: &mut Channel) -> Result<u16, Shutdown> {
        channel.calls.repeat(|| channel.adc.read())
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
                format_args!("the host asks for {bytes} bytes, but a report has {REPORT_BYTES}"),
            ));
        }
        Ok(BytesPerReport(bytes))
    }

    /// Whether a report of `len` bytes has room for one more sum.
    fn has_room(self, len: usize) -> bool {
        len + SAMPLE_BYTES <= usize::from(self.0)
    }
}

/// The host's settings for the samples.
#[derive(Clone, Copy, Default)]
struct Query {
    sample_ticks: Ticks,
    sample_count: u8,
    rest_ticks: Ticks,
    min_value: u16,
    max_value: u16,
    range_check_count: u8,
    /// `None`: each sum is its own report.
    bytes_per_report: Option<BytesPerReport>,
}

struct AnalogIn {
    channel: DeviceId<Channel>,
    reading: JobSlot<Read>,
    calls: Calls,
    unread: Unread,
    /// Whether a sample waits until the ADC has finished a reading of an earlier query.
    waiting: bool,
    query: Query,
    /// When the first sample of the next sum is due.
    next_begin: Clock,
    /// When the current sample was due.
    sample_at: Clock,
    /// How many samples the current sum has.
    taken: u8,
    /// The sum of the samples. It wraps around, as Klipper's does.
    sum: u16,
    /// The last sample.
    last: Option<u16>,
    invalid_count: u8,
    report: [u8; REPORT_BYTES],
    report_len: usize,
    attached: Attached,
}

impl AnalogIn {
    fn restart(&mut self) {
        self.taken = 0;
        self.sum = 0;
        self.waiting = false;
        self.reading.drop_pending();
    }

    /// Makes the worker read the ADC. If a reading is still under way, the next one follows when it returns.
    fn sample(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        if !self.reading.is_here() {
            self.waiting = true;
            return Ok(());
        }
        self.unread.asked(context.now());
        self.reading.send(context, self.channel)
    }

    /// Moves `next_begin` ahead by one `rest_ticks`, or by as many as it takes to reach the future. Sums that were due
    /// before are skipped, because the ADC was too slow for them.
    fn skip_missed(&mut self, now: Clock) {
        self.next_begin = self.next_begin + self.query.rest_ticks;
        let behind = now.since(self.next_begin);
        if behind <= 0 {
            return;
        }
        self.next_begin = match u64::from(self.query.rest_ticks.0) {
            // Without a pause the next sum begins now.
            0 => now,
            rest => Clock::from_ticks(self.next_begin.ticks() + (behind as u64 / rest + 1) * rest),
        };
    }

    fn check_range(&mut self, context: &Context) -> Result<(), Shutdown> {
        // Kalico ignores limits this way (`temp_ignore_limits`).
        if self.query.range_check_count == 0 && context.takes(&CONFIG_DS18B20_OF_KALICO) {
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
        context.try_shut_down(Shutdown::because(
            ADC_RANGE,
            format!(
                "it read {} where {} to {} is allowed (sum of {} samples): a heater past its limits, or a sensor that is broken or unplugged",
                self.sum, self.query.min_value, self.query.max_value, self.query.sample_count
            ),
        ))
    }

    fn query(&mut self, context: &mut Context, at: Clock, query: Query) -> Result<(), Shutdown> {
        context.cancel(TIMER);
        self.restart();
        self.next_begin = at;
        self.query = query;
        self.report_len = 0;
        if query.sample_count == 0 {
            return Ok(());
        }
        context.schedule(TIMER, at)
    }

    fn report(&mut self, context: &mut Context) {
        let Some(bytes_per_report) = self.query.bytes_per_report else {
            return context.send(State { oid: context.oid(), next_clock: self.next_begin, value: self.sum });
        };
        let bytes = self.sum.to_le_bytes();
        self.report[self.report_len..self.report_len + SAMPLE_BYTES].copy_from_slice(&bytes);
        self.report_len += SAMPLE_BYTES;
        if !bytes_per_report.has_room(self.report_len) {
            context.send(Batch {
                oid: context.oid(),
                next_clock: self.next_begin,
                values: &self.report[..self.report_len],
            });
            self.report_len = 0;
        }
    }
}

impl Object for AnalogIn {
    fn kind(&self) -> &'static str {
        "analog input"
    }

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        self.sample_at = at;
        self.sample(context)?;
        Ok(Next::Done)
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, is_wanted, ended: read_at, .. }) = self.reading.back(finished) else { return Ok(()) };
        if result.is_ok() {
            self.unread.read();
        }
        if !is_wanted {
            return if std::mem::take(&mut self.waiting) { self.sample(context) } else { Ok(()) };
        }
        let sample = match result {
            Ok(sample) => sample,
            Err(failure) => {
                // A move may depend on an attached input.
                let at_once = !matches!(self.attached, Attached::Nothing);
                if at_once || self.unread.is_too_long(read_at) {
                    context.try_shut_down(failure.clone())?;
                }
                // Drop this sum. The next one begins at its due time.
                self.restart();
                self.skip_missed(context.now());
                context.go_on(TIMER, self.next_begin);
                return Ok(());
            }
        };
        self.last = Some(sample);
        self.sum = self.sum.wrapping_add(sample);
        self.taken += 1;
        let now = context.now();
        if self.taken < self.query.sample_count {
            context.go_on(TIMER, (self.sample_at + self.query.sample_ticks).max(now));
            return Ok(());
        }
        self.check_range(context)?;
        self.skip_missed(now);
        self.attached.update(context, self.sum.into(), read_at)?;
        self.report(context);
        self.restart();
        context.go_on(TIMER, self.next_begin);
        Ok(())
    }

    fn report(&self) -> Report {
        Report { value: self.last.map(Present::Adc), ..Report::default() }
    }

    fn counts(&self) -> Option<BusCounts> {
        Some(self.calls.counts())
    }

    fn shutdown(&mut self, context: &mut Context) {
        // A reading under way no longer counts.
        self.restart();
        self.attached = Attached::default();
        // Without a pause between sums, sampling would keep a stopped MCU busy forever.
        if self.query.sample_count == 0 || self.query.rest_ticks == Ticks(0) {
            return;
        }
        // Sampling continues, as in Klipper's C, so that the host also sees the temperatures of a stopped MCU.
        self.skip_missed(context.now());
        context.go_on(TIMER, self.next_begin);
    }
}

const CONFIG_ANALOG_IN: Command = command!("config_analog_in oid=%c pin=%u", |context, oid: Oid, pin: Pin| {
    context.vacant(oid)?;
    let OnWorker { bus, device: adc } = context.board()?.adc(pin)?;
    let calls = Calls::new(context.clock());
    let input = AnalogIn {
        channel: context.device(&bus, Box::new(Channel { adc, calls: calls.clone() }))?,
        reading: JobSlot::new(Read),
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
        attached: Attached::default(),
    };
    context.assign_on(pin, oid, input)
});

const QUERY_ANALOG_IN: Command = command!(
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u min_value=%hu max_value=%hu range_check_count=%c",
    AnalogIn,
    |input,
     context,
     clock: WireClock,
     sample_ticks: Ticks,
     sample_count: u8,
     rest_ticks: Ticks,
     min_value: u16,
     max_value: u16,
     range_check_count: u8| {
        let at = context.instant(clock);
        let bytes_per_report = None;
        let query =
            Query { sample_ticks, sample_count, rest_ticks, min_value, max_value, range_check_count, bytes_per_report };
        input.query(context, at, query)
    }
)
.of(&[V0_11, V0_12, V0_13, Kalico]);

const QUERY_ANALOG_IN_FOR_BATCHES: Command = command!(
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c min_value=%hu max_value=%hu range_check_count=%c",
    AnalogIn,
    |input,
     context,
     clock: WireClock,
     sample_ticks: Ticks,
     sample_count: u8,
     rest_ticks: Ticks,
     bytes_per_report: u8,
     min_value: u16,
     max_value: u16,
     range_check_count: u8| {
        let at = context.instant(clock);
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
        input.query(context, at, query)
    }
)
.of(&[Master]);

const ANALOG_IN_ATTACH_TRIGGER_ANALOG: Command = command!(
    "analog_in_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    AnalogIn,
    |input, context, trigger_analog_oid: Oid| input.attached.attach(context, trigger_analog_oid)
)
.hosts(Hosts::of(&[Master]).with(QUERY_ANALOG_IN_FOR_BATCHES.format));
