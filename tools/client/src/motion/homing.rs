// SPDX-License-Identifier: GPL-3.0-or-later
//! Homing against an endstop, with klippy's commands.

use std::time::{Duration, Instant};

use pinion_protocol::clock::Clock;

use super::endstop::{ENDSTOP_SAMPLES, Endstop, HomingEnd};
use super::profile::{Profile, Run};
use super::queue::{FEED_EVERY, LEAD_S, MoveQueue, Sight, Stepper, Watch, look};
use crate::{Client, Error};

/// How many times they are queried after homing, with the axis at rest.
const LOOKS_AT_REST: u32 = 5;
/// The MCU ends homing by itself after this many seconds without a message from the host. It is klippy's value for a
/// printer with one MCU.
const TRSYNC_TIMEOUT_S: f64 = 5.0;
/// How long after the end of the move the trsync's report may come.
const NEWS_TIMEOUT: Duration = Duration::from_secs(6);
const ENDSTOP_SAMPLE_S: f64 = 0.000_015;

/// The result of homing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Homed {
    /// Why it ended.
    pub reason: HomingEnd,
    /// When the move began.
    pub start: Clock,
    /// When the endstop was first seen triggered; `None` if it was not.
    pub trigger: Option<Clock>,
    /// The position where the stepper stopped, in steps.
    pub position: i64,
    /// Highest number of steps after the endstop closed, before its samples showed the trigger.
    pub slack_steps: u32,
}

impl MoveQueue {
    /// Moves a stepper toward an endstop. Returns when the stepper was stopped or the move is over.
    pub fn home(
        &mut self,
        client: &mut Client,
        stepper: Stepper,
        endstop: Endstop,
        positive: bool,
        profile: &Profile,
        seen: &mut dyn FnMut(Sight),
    ) -> Result<Homed, Error> {
        let fastest = profile.runs.iter().map(Run::last_interval).min();
        let rest_ticks = fastest.unwrap_or(1);
        let sample_ticks = client.ticks(ENDSTOP_SAMPLE_S);
        let sampling = rest_ticks + sample_ticks * u32::from(ENDSTOP_SAMPLES - 1);
        let trsync = endstop.trsync;
        let expire_ticks = client.ticks(TRSYNC_TIMEOUT_S);
        let report_ticks = expire_ticks * 3 / 10;
        let start = client.clock_in(LEAD_S)?;
        client.drain();
        let mut expire = start.displaced(expire_ticks);
        arm(client, stepper, trsync, start, report_ticks, expire)?;
        endstop.search(client, start, sample_ticks, rest_ticks)?;
        let mut moving = self.begin(client, stepper, positive, profile, start)?;
        let mut look_at = Instant::now();
        let mut watch = Some(Watch { endstop, seen });
        let over = client.instant_of(moving.end) + NEWS_TIMEOUT;
        loop {
            self.feed(client, &mut moving)?;
            look(client, stepper, &mut watch, &mut look_at)?;
            let until = Instant::now() + FEED_EVERY;
            let Some(state) = client.wait("trsync_state", Some(trsync), until)? else {
                if Instant::now() > over {
                    return Err(no_news());
                }
                continue;
            };
            if !state.flag("can_trigger")? {
                break;
            }
            let clock = client.widen(state.u32("clock")?);
            if clock >= moving.end {
                client
                    .send("trsync_trigger", &[("oid", trsync.into()), ("reason", HomingEnd::PastEnd.code().into())])?;
                break;
            }
            let later = clock.displaced(expire_ticks);
            if later.since(expire) >= i64::from(report_ticks) * 8 / 10 {
                expire = later;
                set_timeout(client, trsync, expire)?;
            }
        }
        let (reason, trigger, position) = self.end_homing(client, stepper, endstop, rest_ticks)?;
        for _ in 0..LOOKS_AT_REST {
            look_at = look_at.max(Instant::now());
            client.listen(look_at)?;
            look(client, stepper, &mut watch, &mut look_at)?;
        }
        Ok(Homed { reason, start, trigger, position, slack_steps: sampling.div_ceil(rest_ticks.max(1)) + 1 })
    }

    fn end_homing(
        &mut self,
        client: &mut Client,
        stepper: Stepper,
        endstop: Endstop,
        rest_ticks: u32,
    ) -> Result<(HomingEnd, Option<Clock>, i64), Error> {
        let nothing =
            ["clock", "sample_ticks", "sample_count", "rest_ticks", "pin_value", "trsync_oid", "trigger_reason"];
        let mut args = vec![("oid", endstop.oid.into())];
        args.extend(nothing.map(|name| (name, 0u8.into())));
        client.send("endstop_home", &args)?;
        // The last report may still be on its way. It has arrived when everything sent is acknowledged.
        client.link().settle()?;
        let mut state = client.query(
            "trsync_trigger",
            &[("oid", endstop.trsync.into()), ("reason", HomingEnd::Host.code().into())],
            "trsync_state",
            Some(endstop.trsync),
        )?;
        while state.flag("can_trigger")? {
            let until = Instant::now() + NEWS_TIMEOUT;
            let next = client.wait("trsync_state", Some(endstop.trsync), until)?;
            state = next.ok_or_else(no_news)?;
        }
        let reason = HomingEnd::of(state.int("trigger_reason")?);
        self.releases.clear();
        let trigger = if reason == HomingEnd::Endstop {
            let (_, next) = endstop.state(client)?;
            Some(next.displaced(rest_ticks.wrapping_neg()))
        } else {
            None
        };
        client.send("reset_step_clock", &[("oid", stepper.oid.into()), ("clock", 0u8.into())])?;
        Ok((reason, trigger, stepper.position(client)?))
    }
}

fn no_news() -> Error {
    Error::Timeout { waiting_for: "report `trsync_state` on homing".to_owned(), after: NEWS_TIMEOUT }
}

/// Starts a trsync that stops a stepper when it is triggered. It reports every `report_ticks` from `start` on. It
/// triggers by itself at `expire`, unless the host sets `expire` again.
fn arm(
    client: &mut Client,
    stepper: Stepper,
    trsync: u8,
    start: Clock,
    report_ticks: u32,
    expire: Clock,
) -> Result<(), Error> {
    client.send(
        "trsync_start",
        &[
            ("oid", trsync.into()),
            ("report_clock", start.into()),
            ("report_ticks", report_ticks.into()),
            ("expire_reason", HomingEnd::Silence.code().into()),
        ],
    )?;
    client.send("stepper_stop_on_trigger", &[("oid", stepper.oid.into()), ("trsync_oid", trsync.into())])?;
    set_timeout(client, trsync, expire)
}

fn set_timeout(client: &mut Client, trsync: u8, clock: Clock) -> Result<(), Error> {
    client.send("trsync_set_timeout", &[("oid", trsync.into()), ("clock", clock.into())])
}
