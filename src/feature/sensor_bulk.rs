// SPDX-License-Identifier: GPL-3.0-or-later
//! Measurements in bulk: samples are packed into messages that are counted, and the host learns at
//! which instant how many samples there were.
//!
//! klippy (`extras/bulk_sensor.py`) computes the time of each sample from that: it knows from
//! `next_sequence` and `buffered` how many samples the sensor has taken, and fits a line through
//! those counts and the instants of `sensor_bulk_status`. So a sample must never be counted twice or
//! be left out, and the instants are those at which the bus was busy with the question, not those at
//! which the core asked it.

#![forbid(unsafe_code)]

use crate::mcu::{Feature, Mcu, Oid, Response, response};
use crate::time::Clock;

pub(super) const FEATURE: Feature =
    Feature { name: "sensor_bulk", responses: &[BulkData::FORM, BulkStatus::FORM], ..Feature::EMPTY };

response! {
    /// Samples, packed as the sensor's module of klippy expects them.
    "sensor_bulk_data oid=%c sequence=%hu data=%*s"
    pub(super) struct BulkData<'a> { oid: Oid, sequence: u16, data: &'a [u8] }
}

response! {
    /// How many samples there were at `clock` to `clock + query_ticks`: `next_sequence` messages, and
    /// `buffered` bytes that are not sent yet.
    "sensor_bulk_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%u possible_overflows=%hu"
    pub(super) struct BulkStatus {
        oid: Oid,
        clock: Clock,
        query_ticks: u32,
        next_sequence: u16,
        buffered: u32,
        possible_overflows: u16
    }
}

/// Bytes of samples that a message holds (`MAX_BULK_MSG_SIZE` of klippy, which computes from it how
/// many samples each message has).
pub(super) const DATA_MAX: usize = 51;

/// The samples of one sensor on their way to the host.
pub(super) struct SensorBulk {
    sequence: u16,
    possible_overflows: u16,
    data: [u8; DATA_MAX],
    len: usize,
}

impl SensorBulk {
    /// Nothing measured yet.
    pub(super) const fn new() -> SensorBulk {
        SensorBulk { sequence: 0, possible_overflows: 0, data: [0; DATA_MAX], len: 0 }
    }

    /// Begins to count anew.
    pub(super) fn reset(&mut self) {
        *self = SensorBulk::new();
    }

    /// Appends one sample, and sends the message once another sample of its size has no room.
    pub(super) fn add(&mut self, mcu: &mut Mcu, oid: Oid, sample: &[u8]) {
        let end = self.len + sample.len();
        self.data[self.len..end].copy_from_slice(sample);
        self.len = end;
        if self.room() < sample.len() {
            mcu.send(BulkData { oid, sequence: self.sequence, data: &self.data[..self.len] });
            self.sequence = self.sequence.wrapping_add(1);
            self.len = 0;
        }
    }

    /// Bytes that the message has room for.
    pub(super) fn room(&self) -> usize {
        DATA_MAX - self.len
    }

    /// Counts signs that the sensor may have dropped samples.
    pub(super) fn count_overflows(&mut self, times: u16) {
        self.possible_overflows = self.possible_overflows.wrapping_add(times);
    }

    /// Tells the host how many samples there are: `fifo_bytes` of them are still in the sensor, as it
    /// said between `began` and `ended`.
    pub(super) fn send_status(&self, mcu: &mut Mcu, oid: Oid, (began, ended): (Clock, Clock), fifo_bytes: u32) {
        mcu.send(BulkStatus {
            oid,
            clock: began,
            query_ticks: ended.wire().wrapping_sub(began.wire()),
            next_sequence: self.sequence,
            buffered: self.len as u32 + fifo_bytes,
            possible_overflows: self.possible_overflows,
        });
    }
}
