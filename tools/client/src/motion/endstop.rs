// SPDX-License-Identifier: GPL-3.0-or-later
//! Endstops, and the trsync that each of them triggers.

use pinion_protocol::clock::Clock;

use crate::config::Config;
use crate::{Client, Error};

/// Number of triggered samples in a row that trigger an endstop.
pub(super) const ENDSTOP_SAMPLES: u8 = 4;

/// The reason for the end of homing, with klippy's numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HomingEnd {
    /// The endstop closed.
    Endstop,
    /// The host gave up.
    Host,
    /// The move ended.
    PastEnd,
    /// The MCU received no message from the host in time.
    Silence,
    /// A reason that klippy does not define.
    Other(i64),
}

impl HomingEnd {
    pub(super) fn code(self) -> i64 {
        match self {
            HomingEnd::Endstop => 1,
            HomingEnd::Host => 2,
            HomingEnd::PastEnd => 3,
            HomingEnd::Silence => 4,
            HomingEnd::Other(code) => code,
        }
    }

    pub(super) fn of(code: i64) -> HomingEnd {
        [HomingEnd::Endstop, HomingEnd::Host, HomingEnd::PastEnd, HomingEnd::Silence]
            .into_iter()
            .find(|reason| reason.code() == code)
            .unwrap_or(HomingEnd::Other(code))
    }
}

/// A configured endstop, and the trsync that it triggers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Endstop {
    /// The endstop's oid.
    pub oid: u8,
    /// The trsync's oid.
    pub trsync: u8,
    /// Whether the pin is low when the endstop is triggered.
    pub invert: bool,
}

impl Endstop {
    /// Adds an endstop and its trsync to a configuration. `pull` is 1 for up, -1 for down, 0
    /// for neither. Fails if there are too many objects.
    pub fn configure(config: &mut Config, pin: &str, pull: i8, invert: bool) -> Result<Endstop, Error> {
        let oid = config.oid()?;
        let trsync = config.oid()?;
        config.add(format!("config_endstop oid={oid} pin={pin} pull_up={pull}"));
        config.add(format!("config_trsync oid={trsync}"));
        Ok(Endstop { oid, trsync, invert })
    }

    /// Queries whether it is triggered.
    pub fn triggered(&self, client: &mut Client) -> Result<bool, Error> {
        Ok(self.state(client)?.0)
    }

    /// Makes the MCU sample the pin from `start` on, every `rest_ticks`. The endstop triggers after several triggered
    /// samples in a row, `sample_ticks` apart.
    pub(super) fn search(
        &self,
        client: &mut Client,
        start: Clock,
        sample_ticks: u32,
        rest_ticks: u32,
    ) -> Result<(), Error> {
        client.send(
            "endstop_home",
            &[
                ("oid", self.oid.into()),
                ("clock", start.into()),
                ("sample_ticks", sample_ticks.into()),
                ("sample_count", ENDSTOP_SAMPLES.into()),
                ("rest_ticks", rest_ticks.into()),
                ("pin_value", (!self.invert).into()),
                ("trsync_oid", self.trsync.into()),
                ("trigger_reason", HomingEnd::Endstop.code().into()),
            ],
        )
    }

    /// Whether it is triggered, and the clock of the sample after the last sample of homing.
    pub(super) fn state(&self, client: &mut Client) -> Result<(bool, Clock), Error> {
        let args = [("oid", self.oid.into())];
        let state = client.query("endstop_query_state", &args, "endstop_state", Some(self.oid))?;
        let next = client.widen(state.u32("next_clock")?);
        Ok((state.flag("pin_value")? != self.invert, next))
    }
}
