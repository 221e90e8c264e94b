// SPDX-License-Identifier: GPL-3.0-or-later
//! Buttons: up to eight inputs, sampled together and debounced; each change is told until the host
//! has acknowledged it.

#![forbid(unsafe_code)]

use crate::board::Pin;
use crate::mcu::{
    Command, Done, Feature, InputLine, Mcu, Next, Object, Oid, Response, Ticket, TimerId, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::bias;

pub(super) const FEATURE: Feature = Feature {
    name: "buttons",
    commands: &[CONFIG_BUTTONS, BUTTONS_ADD, BUTTONS_QUERY, BUTTONS_ACK],
    responses: &[State::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `config_buttons` with more than 8.
    MAX_BUTTONS = "Max of 8 buttons";
    /// `buttons_add` at a place that `config_buttons` did not count.
    PAST_COUNT = "Set button past maximum button count";
    /// `buttons_query` with a `retransmit_count` above 127.
    INVALID_RETRANSMIT = "Invalid buttons retransmit count";
}

response! {
    /// The states that the host has not acknowledged, the oldest first; `ack_count` is how many it
    /// has, modulo 256.
    "buttons_state oid=%c ack_count=%c state=%*s"
    pub(super) struct State<'a> { oid: Oid, ack_count: u8, state: &'a [u8] }
}

/// Buttons of one object, a bit of a state each.
const BUTTONS: usize = 8;
/// States that wait for the host; later changes are dropped.
const REPORTS: usize = 8;
/// The largest `retransmit_count`, as in the firmware.
const RETRANSMIT_MAX: u8 = 0x7f;

/// How many samples there are between two tellings of the same reports.
#[derive(Clone, Copy, Default)]
struct RetransmitCount(u8);

impl RetransmitCount {
    /// # Errors
    ///
    /// "Invalid buttons retransmit count".
    fn of(count: u8) -> Result<RetransmitCount, Shutdown> {
        if count > RETRANSMIT_MAX {
            let what = format_args!("a retransmit_count of {count} is above {RETRANSMIT_MAX}");
            return Err(Shutdown::by_host(INVALID_RETRANSMIT, what));
        }
        Ok(RetransmitCount(count))
    }
}

struct Button {
    line: InputLine,
    /// Tells a look at this line from one at the line that was here before.
    generation: u8,
}

impl Button {
    /// The place is in the low three bits of the tag.
    fn tag(&self, place: usize) -> u8 {
        self.generation << 3 | place as u8
    }
}

struct Buttons {
    buttons: Vec<Option<Button>>,
    rest_ticks: Ticks,
    /// The levels of the sample that is being taken.
    sample: u8,
    /// The buttons, a bit each, at which workers of expanders still look for this sample.
    awaited: u8,
    /// Those at which they could not look.
    unread: u8,
    /// Whether the sample that is being taken counts: not one of an earlier query.
    counts: bool,
    last_sample: u8,
    /// The debounced state.
    pressed: u8,
    reports: [u8; REPORTS],
    report_count: usize,
    ack_count: u8,
    retransmit_count: RetransmitCount,
    /// Samples until the reports are sent once more; none if the host has them all.
    retransmit: Option<u8>,
}

impl Buttons {
    fn new(count: usize) -> Buttons {
        Buttons {
            buttons: (0..count).map(|_| None).collect(),
            rest_ticks: Ticks(0),
            sample: 0,
            awaited: 0,
            unread: 0,
            counts: false,
            last_sample: 0,
            pressed: 0,
            reports: [0; REPORTS],
            report_count: 0,
            ack_count: 0,
            retransmit_count: RetransmitCount::default(),
            retransmit: None,
        }
    }

    fn add(&mut self, mcu: &mut Mcu, place: u8, pin: Pin, pull_up: i8) -> Result<(), Shutdown> {
        let count = self.buttons.len();
        let Some(slot) = self.buttons.get_mut(usize::from(place)) else {
            let what = format_args!("button {place} is set of {count}");
            return Err(Shutdown::by_host(PAST_COUNT, what));
        };
        let generation = slot.as_ref().map_or(0, |button| button.generation.wrapping_add(1));
        *slot = Some(Button { line: mcu.late_input(pin, bias(pull_up))?, generation });
        self.counts = false;
        Ok(())
    }

    /// Looks at each button. A button that was not added reads low.
    fn take_sample(&mut self, mcu: &mut Mcu, oid: Oid) -> Result<(), Shutdown> {
        (self.sample, self.unread) = (0, 0);
        self.counts = true;
        for (place, button) in self.buttons.iter_mut().enumerate() {
            let Some(button) = button else { continue };
            let tag = button.tag(place);
            match button.line.read(mcu, Ticket { oid, tag })? {
                Some(level) => self.sample |= u8::from(level) << place,
                None => self.awaited |= 1 << place,
            }
        }
        Ok(())
    }

    /// Debounces a sample that is complete: a level counts if the sample before had it too. A button that
    /// could not be looked at keeps its last level, which that does not confirm. True if there is something
    /// new to tell.
    fn debounce(&mut self) -> bool {
        let read = !self.unread;
        let steady = !(self.sample ^ self.last_sample) & read;
        self.last_sample = self.sample & read | self.last_sample & self.unread;
        let changed = (self.sample ^ self.pressed) & steady;
        if changed == 0 {
            return false;
        }
        self.pressed ^= changed;
        let Some(report) = self.reports.get_mut(self.report_count) else { return false };
        *report = self.pressed;
        self.report_count += 1;
        true
    }

    /// Expanders still look for the last sample: whether they take too long.
    fn wait(&self, mcu: &mut Mcu) -> Result<(), Shutdown> {
        let awaited = (0..).zip(&self.buttons).filter(|(place, _)| self.awaited >> place & 1 != 0);
        awaited.filter_map(|(_, button)| button.as_ref()).try_for_each(|button| button.line.awaited(mcu))
    }

    /// Takes in a complete sample, and tells what is new.
    fn sampled(&mut self, mcu: &mut Mcu, oid: Oid) -> bool {
        let news = self.awaited == 0 && std::mem::take(&mut self.counts) && self.debounce();
        if news {
            self.report(mcu, oid);
        }
        news
    }

    fn report(&mut self, mcu: &mut Mcu, oid: Oid) {
        self.retransmit = Some(self.retransmit_count.0);
        mcu.send(State { oid, ack_count: self.ack_count, state: &self.reports[..self.report_count] });
    }

    fn acknowledge(&mut self, count: u8) {
        self.ack_count = self.ack_count.wrapping_add(count);
        let done = usize::from(count).min(self.report_count);
        self.reports.copy_within(done..self.report_count, 0);
        self.report_count -= done;
        if self.report_count == 0 {
            self.retransmit = None;
        }
    }
}

impl Object for Buttons {
    fn kind(&self) -> &'static str {
        "buttons"
    }

    fn event(&mut self, mcu: &mut Mcu, timer: TimerId, at: Clock) -> Result<Next, Shutdown> {
        let Some(oid) = timer.oid() else { return Ok(Next::Done) };
        // Expanders that still look for the last sample miss this one.
        let news = if self.awaited == 0 {
            self.take_sample(mcu, oid)?;
            self.sampled(mcu, oid)
        } else {
            self.wait(mcu)?;
            false
        };
        match self.retransmit {
            Some(0) if !news => self.report(mcu, oid),
            Some(left) if !news => self.retransmit = Some(left - 1),
            _ => {}
        }
        Ok(Next::At(at + self.rest_ticks))
    }

    /// An expander's worker has looked.
    fn returned(&mut self, mcu: &mut Mcu, oid: Oid, done: Done) -> Result<(), Shutdown> {
        let tag = done.tag;
        let place = usize::from(tag) % BUTTONS;
        self.awaited &= !(1 << place);
        // Not if another line took the place meanwhile: that has a look of its own.
        if let Some(Some(button)) = self.buttons.get_mut(place)
            && button.tag(place) == tag
        {
            match button.line.sampled(mcu, done)? {
                Some(level) => self.sample |= u8::from(level) << place,
                None => self.unread |= 1 << place,
            }
        }
        self.sampled(mcu, oid);
        Ok(())
    }

    fn shutdown(&mut self, _mcu: &mut Mcu, _oid: Oid) {
        self.counts = false;
    }
}

const CONFIG_BUTTONS: Command = command!("config_buttons oid=%c button_count=%c", |mcu, oid: Oid, button_count: u8| {
    let count = usize::from(button_count);
    if count > BUTTONS {
        return Err(Shutdown::by_host(MAX_BUTTONS, format_args!("{count} buttons are asked for")));
    }
    mcu.assign(oid, Buttons::new(count))
});

const BUTTONS_ADD: Command =
    command!("buttons_add oid=%c pos=%c pin=%u pull_up=%c", |mcu, oid: Oid, pos: u8, pin: Pin, pull_up: i8| {
        mcu.with::<Buttons, _>(oid, |buttons, mcu| buttons.add(mcu, pos, pin, pull_up))
    });

const BUTTONS_QUERY: Command = command!(
    "buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c",
    |mcu, oid: Oid, clock: WireClock, rest_ticks: Ticks, retransmit_count: u8, invert: u8| {
        let at = mcu.instant(clock);
        mcu.with::<Buttons, _>(oid, |buttons, mcu| {
            let retransmit_count = RetransmitCount::of(retransmit_count)?;
            mcu.cancel(TimerId::sampling(oid, 0));
            buttons.rest_ticks = rest_ticks;
            buttons.retransmit_count = retransmit_count;
            buttons.pressed = invert;
            buttons.last_sample = invert;
            buttons.counts = false;
            buttons.ack_count = 0;
            buttons.report_count = 0;
            buttons.retransmit = None;
            if rest_ticks == Ticks(0) {
                return Ok(());
            }
            mcu.schedule(TimerId::sampling(oid, 0), at)
        })
    }
);

const BUTTONS_ACK: Command = command!("buttons_ack oid=%c count=%c", |mcu, oid: Oid, count: u8| {
    mcu.with::<Buttons, _>(oid, |buttons, _| {
        buttons.acknowledge(count);
        Ok(())
    })
});
