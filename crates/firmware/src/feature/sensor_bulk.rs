// SPDX-License-Identifier: GPL-3.0-or-later
//! Measurements in bulk. Samples are packed into numbered messages. The host also learns how many samples there were at
//! which time.
//!
//! klippy (`extras/bulk_sensor.py`) computes the time of each sample from this. It knows from `next_sequence` and
//! `buffered` how many samples the sensor has taken. It fits a line through these counts and the times of
//! `sensor_bulk_status`. So a sample must never be counted twice or left out. The times are when the bus was busy with
//! the question, not when the core asked it.
//!
//! Up to v0.12 each sensor had its own messages for this ([`Words`]). They are in the sensor's file.

use crate::mcu::DialectName::{Kalico, Master, V0_13};
use crate::mcu::{Context, Feature, Hosts, Oid, Response, response};
use crate::time::Clock;

pub(super) const FEATURE: Feature = Feature {
    serves: "accelerometers, angle sensors, load cells and eddy current probes",
    responses: &[BulkData::FORM, BulkStatus::FORM],
    ..Feature::EMPTY
};

response! {
    /// Samples, packed in the format of the sensor's klippy module.
    "sensor_bulk_data oid=%c sequence=%hu data=%*s" => BulkStatus::FORM.hosts.with(BulkStatus::FORM.format);
    pub(super) struct BulkData<'a> { oid: Oid, sequence: u16, data: &'a [u8] }
}

response! {
    /// How many samples there were between `clock` and `clock + query_ticks`: `next_sequence` messages, and `buffered`
    /// bytes that are not sent yet.
    "sensor_bulk_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%u possible_overflows=%hu" => Hosts::of(&[V0_13, Master, Kalico]);
    pub(super) struct BulkStatus {
        oid: Oid,
        clock: Clock,
        query_ticks: u32,
        next_sequence: u16,
        buffered: u32,
        possible_overflows: u16
    }
}

/// Highest number of bytes of samples in a message (`MAX_BULK_MSG_SIZE` of klippy). klippy computes from it how many
/// samples each message has.
pub(super) const DATA_MAX: usize = 51;

/// The messages for samples.
pub(super) struct Words {
    /// Highest number of bytes of samples in a message.
    pub(super) data_max: usize,
    /// Sends samples.
    pub(super) data: fn(&mut Context, BulkData<'_>),
    /// Sends how many samples there are.
    pub(super) status: fn(&mut Context, Status),
}

/// How many samples there were between `clock` and `clock + query_ticks`.
pub(super) struct Status {
    pub(super) oid: Oid,
    pub(super) clock: Clock,
    pub(super) query_ticks: u32,
    /// The number of the next message.
    pub(super) next_sequence: u16,
    /// Bytes that wait for the next message.
    pub(super) in_message: u8,
    /// Bytes in the sensor.
    pub(super) in_sensor: u32,
    pub(super) possible_overflows: u16,
}

/// Declares a sensor's own messages up to v0.12 as `OwnData`, `OwnStatus` and `OWN_WORDS`.
macro_rules! own_words {
    (
        $data:literal, $status:literal => $hosts:expr;
        data_max: $data_max:expr, sample_bytes: $sample_bytes:expr, fifo: $fifo:ty
    ) => {
        $crate::response! {
            /// Samples.
            $data => $hosts.with($status);
            pub(super) struct OwnData<'a> { oid: Oid, sequence: u16, data: &'a [u8] }
        }

        $crate::response! {
            /// How many samples there were. `fifo` of them are in the chip.
            $status => $hosts;
            pub(super) struct OwnStatus {
                oid: Oid,
                clock: $crate::time::Clock,
                query_ticks: u32,
                next_sequence: u16,
                buffered: u8,
                fifo: $fifo,
                limit_count: u16
            }
        }

        const OWN_WORDS: $crate::feature::sensor_bulk::Words = $crate::feature::sensor_bulk::Words {
            data_max: $data_max,
            data: |context, data| context.send(OwnData { oid: data.oid, sequence: data.sequence, data: data.data }),
            status: |context, status| {
                context.send(OwnStatus {
                    oid: status.oid,
                    clock: status.clock,
                    query_ticks: status.query_ticks,
                    next_sequence: status.next_sequence,
                    buffered: status.in_message,
                    fifo: (status.in_sensor / $sample_bytes as u32) as $fifo,
                    limit_count: status.possible_overflows,
                });
            },
        };
    };
}

pub(super) use own_words;

/// The messages of all sensors since v0.13.
const COMMON: Words = Words {
    data_max: DATA_MAX,
    data: |context, data| context.send(data),
    status: |context, status| {
        let Status { oid, clock, query_ticks, next_sequence, in_message, in_sensor, possible_overflows } = status;
        let buffered = u32::from(in_message) + in_sensor;
        context.send(BulkStatus { oid, clock, query_ticks, next_sequence, buffered, possible_overflows });
    },
};

/// The samples of one sensor on their way to the host.
pub(super) struct SensorBulk {
    words: &'static Words,
    sequence: u16,
    possible_overflows: u16,
    data: [u8; DATA_MAX],
    len: usize,
}

impl SensorBulk {
    /// No measurements yet.
    pub(super) const fn new() -> SensorBulk {
        SensorBulk::in_words(&COMMON)
    }

    /// No measurements yet. The sensor has its own messages for hosts up to v0.12.
    pub(super) fn with_own(context: &Context, own: &'static Words) -> SensorBulk {
        SensorBulk::in_words(if context.speaks::<BulkData<'_>>() { &COMMON } else { own })
    }

    const fn in_words(words: &'static Words) -> SensorBulk {
        SensorBulk { words, sequence: 0, possible_overflows: 0, data: [0; DATA_MAX], len: 0 }
    }

    /// Starts to count again.
    pub(super) fn reset(&mut self) {
        *self = SensorBulk::in_words(self.words);
    }

    /// Appends one sample. Sends the message when it has no room for another sample of this size.
    pub(super) fn add(&mut self, context: &mut Context, sample: &[u8]) {
        let end = self.len + sample.len();
        self.data[self.len..end].copy_from_slice(sample);
        self.len = end;
        if self.room() < sample.len() {
            self.send(context);
        }
    }

    /// Sends the waiting samples, if there are any. Hosts up to v0.12 expect this last message of a measurement.
    pub(super) fn flush(&mut self, context: &mut Context) {
        if self.len > 0 {
            self.send(context);
        }
    }

    fn send(&mut self, context: &mut Context) {
        let oid = context.oid();
        (self.words.data)(context, BulkData { oid, sequence: self.sequence, data: &self.data[..self.len] });
        self.sequence = self.sequence.wrapping_add(1);
        self.len = 0;
    }

    /// Free bytes in the message.
    pub(super) fn room(&self) -> usize {
        self.words.data_max - self.len
    }

    /// Counts signs that the sensor may have dropped samples.
    pub(super) fn count_overflows(&mut self, times: u16) {
        self.possible_overflows = self.possible_overflows.wrapping_add(times);
    }

    /// Reports to the host how many samples there are. `in_sensor` bytes are still in the sensor, as it said between
    /// `began` and `ended`.
    pub(super) fn send_status(&self, context: &mut Context, (began, ended): (Clock, Clock), in_sensor: u32) {
        let status = Status {
            oid: context.oid(),
            clock: began,
            query_ticks: ended.wire().wrapping_sub(began.wire()),
            next_sequence: self.sequence,
            in_message: self.len as u8,
            in_sensor,
            possible_overflows: self.possible_overflows,
        };
        (self.words.status)(context, status);
    }
}
