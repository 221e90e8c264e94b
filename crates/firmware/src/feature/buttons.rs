// SPDX-License-Identifier: GPL-3.0-or-later
//! Buttons: up to eight inputs, sampled together and debounced. Each change is reported until the host acknowledges it.

use crate::board::Pin;
use crate::mcu::{
    Command, Context, Feature, Finished, InputLine, Next, Object, Oid, Response, Timer, WireClock, command, response,
};
use crate::shutdown::{Shutdown, shutdowns};
use crate::time::{Clock, Ticks};

use super::bias;

pub(super) const FEATURE: Feature = Feature {
    serves: "buttons and filament sensors",

    commands: &[CONFIG_BUTTONS, BUTTONS_ADD, BUTTONS_QUERY, BUTTONS_ACK],
    responses: &[State::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `config_buttons` with more than 8 buttons.
    MAX_BUTTONS = "Max of 8 buttons";
    /// `buttons_add` with a position beyond the count of `config_buttons`.
    PAST_COUNT = "Set button past maximum button count";
    /// `buttons_query` with a `retransmit_count` above 127.
    INVALID_RETRANSMIT = "Invalid buttons retransmit count";
}

response! {
    /// The unacknowledged states, the oldest first. `ack_count` counts the acknowledged ones, modulo 256.
    "buttons_state oid=%c ack_count=%c state=%*s"
    pub(super) struct State<'a> { oid: Oid, ack_count: u8, state: &'a [u8] }
}

/// Highest number of buttons of one object: a state has one bit for each.
const BUTTONS: usize = 8;
/// Highest number of states that wait for the host. Later changes are dropped.
const REPORTS: usize = 8;
/// Highest `retransmit_count`, as in Klipper's C.
const RETRANSMIT_MAX: u8 = 0x7f;

const TIMER: Timer = Timer::sampling(0);

/// How many samples pass before the same states are reported again.
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

/// A button's line. A line that replaces another one has a new number. So a read of the earlier one does not count.
struct Button {
    number: u8,
    line: InputLine,
}

struct Buttons {
    buttons: Vec<Option<Button>>,
    /// The number of the next line's reads.
    next_number: u8,
    rest_ticks: Ticks,
    /// The levels of the current sample.
    sample: u8,
    /// Buttons that workers of expanders could not read for this sample, one bit each.
    unread: u8,
    /// Whether the current sample counts. A sample of an earlier query does not.
    counts: bool,
    last_sample: u8,
    /// The debounced state.
    pressed: u8,
    reports: [u8; REPORTS],
    report_count: usize,
    ack_count: u8,
    retransmit_count: RetransmitCount,
    /// Samples until the states are sent again. `None`: the host has acknowledged all of them.
    retransmit: Option<u8>,
}

impl Buttons {
    fn new(count: usize) -> Buttons {
        Buttons {
            buttons: (0..count).map(|_| None).collect(),
            next_number: 0,
            rest_ticks: Ticks(0),
            sample: 0,
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

    fn add(&mut self, context: &mut Context, place: u8, pin: Pin, pull_up: i8) -> Result<(), Shutdown> {
        let count = self.buttons.len();
        let Some(slot) = self.buttons.get_mut(usize::from(place)) else {
            let what = format_args!("button {place} is set of {count}");
            return Err(Shutdown::by_host(PAST_COUNT, what));
        };
        let number = self.next_number;
        *slot = Some(Button { number, line: context.late_input(number, pin, bias(pull_up))? });
        self.next_number = number.wrapping_add(1);
        self.counts = false;
        Ok(())
    }

    /// Reads each button. A button that was not added reads low.
    fn take_sample(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        (self.sample, self.unread) = (0, 0);
        self.counts = true;
        for (place, button) in self.buttons.iter_mut().enumerate() {
            let Some(button) = button else { continue };
            if let Some(level) = button.line.read(context)? {
                self.sample |= u8::from(level) << place;
            }
        }
        Ok(())
    }

    /// Debounces a complete sample. A level counts if the sample before had it too. A button that could not be read
    /// keeps its last level, which confirms nothing. Returns true if there is a new state to report.
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

    /// Whether workers of expanders are still reading the last sample.
    fn is_awaited(&self) -> bool {
        self.buttons.iter().flatten().any(|button| button.line.is_looking())
    }

    /// Debounces a complete sample, and reports a new state.
    fn sampled(&mut self, context: &mut Context) -> bool {
        let news = !self.is_awaited() && std::mem::take(&mut self.counts) && self.debounce();
        if news {
            self.report(context);
        }
        news
    }

    fn report(&mut self, context: &mut Context) {
        self.retransmit = Some(self.retransmit_count.0);
        context.send(State {
            oid: context.oid(),
            ack_count: self.ack_count,
            state: &self.reports[..self.report_count],
        });
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

    fn event(&mut self, context: &mut Context, _timer: Timer, at: Clock) -> Result<Next, Shutdown> {
        // Expanders that are still being read for the last sample miss this one.
        let news = if self.is_awaited() {
            self.buttons.iter().flatten().try_for_each(|button| button.line.awaited(context))?;
            false
        } else {
            self.take_sample(context)?;
            self.sampled(context)
        };
        match self.retransmit {
            Some(0) if !news => self.report(context),
            Some(left) if !news => self.retransmit = Some(left - 1),
            _ => {}
        }
        Ok(Next::At(at + self.rest_ticks))
    }

    /// A worker has read a line of an expander.
    fn finished(&mut self, context: &mut Context, number: u8, finished: Finished) -> Result<(), Shutdown> {
        let mut buttons = self.buttons.iter_mut().enumerate();
        let read = buttons.find_map(|(place, button)| Some((place, button.as_mut().filter(|b| b.number == number)?)));
        if let Some((place, button)) = read
            && let Some(look) = button.line.sampled(context, finished)
        {
            match look?.level {
                Some(level) => self.sample |= u8::from(level) << place,
                None => self.unread |= 1 << place,
            }
        }
        self.sampled(context);
        Ok(())
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.counts = false;
    }
}

const CONFIG_BUTTONS: Command =
    command!("config_buttons oid=%c button_count=%c", |context, oid: Oid, button_count: u8| {
        let count = usize::from(button_count);
        if count > BUTTONS {
            return Err(Shutdown::by_host(MAX_BUTTONS, format_args!("the host asks for {count} buttons")));
        }
        context.assign(oid, Buttons::new(count))
    });

const BUTTONS_ADD: Command = command!(
    "buttons_add oid=%c pos=%c pin=%u pull_up=%c",
    Buttons,
    |buttons, context, pos: u8, pin: Pin, pull_up: i8| buttons.add(context, pos, pin, pull_up)
);

const BUTTONS_QUERY: Command = command!(
    "buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c",
    Buttons,
    |buttons, context, clock: WireClock, rest_ticks: Ticks, retransmit_count: u8, invert: u8| {
        let at = context.instant(clock);
        let retransmit_count = RetransmitCount::of(retransmit_count)?;
        context.cancel(TIMER);
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
        context.schedule(TIMER, at)
    }
);

const BUTTONS_ACK: Command = command!("buttons_ack oid=%c count=%c", Buttons, |buttons, _, count: u8| {
    buttons.acknowledge(count);
    Ok(())
});
