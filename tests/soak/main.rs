// SPDX-License-Identifier: GPL-3.0-or-later
//! A day of printing in virtual time, with faults at random times: nothing leaks, no step is lost, and every stop has
//! its fault.
//!
//! A seed decides everything. `PINION_SOAK_SEED` and `PINION_SOAK_SECONDS` choose the seed and the length. A failure
//! prints them. `make soak` runs a day.

mod board;
mod host;
mod printer;

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::Instant;

use pinion_client::Arg;
use pinion_model::Look;
use pinion_protocol::vlq::Writer;
use pinion_testbench::memory::Counting;

use board::EXPANDED;
use host::{HEATERS, Host, LED};
use printer::{MS, Printer, SECOND};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The shortest day without another request, in seconds. Every fault comes at least once, however short the day is.
const SECONDS: u64 = 300;
/// How long a fault may take to stop the MCU.
const STOPS_WITHIN: u64 = 12 * SECOND;
/// How much more memory a reset MCU may have than the first one had: what its lists have grown to.
const GROWTH_BYTES: i64 = 1024;
/// How long a stopped MCU is watched. A chip that hangs answers within this time.
const AFTER_STOP: u64 = 4 * SECOND;

const MISSED_OUTPUT: &str = "Missed scheduling of next digital out event";
const MISSED_PWM: &str = "Missed scheduling of next hard pwm event";

/// The faults, and the list of all of them.
macro_rules! faults {
    ($($fault:ident,)*) => {
        /// Something that goes wrong.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        enum Fault {
            $($fault,)*
        }

        use Fault::*;

        const FAULTS: &[Fault] = &[$($fault,)*];
    };
}

faults! {
    LateOutput,
    LateSteps,
    SilentHost,
    KilledHost,
    EmergencyStop,
    UnknownCommand,
    WrongOid,
    TooManyMoves,
    AdcGone,
    AdcGlitch,
    SensorWireBroken,
    ExpanderGone,
    ExpanderGlitch,
    I2cChipGone,
    I2cChipHangs,
    SpiChipGone,
    PwmGone,
    ThermometerGone,
    ShortStall,
    LongStall,
}

/// The effect of a fault on the MCU.
enum Effect {
    /// It stops with one of these texts.
    Stops(&'static [&'static str]),
    /// It may stop with one of these texts.
    MayStop(&'static [&'static str]),
    GoesOn,
}

impl Fault {
    /// `i2c_has_status`: the host learns from an answer that a chip does not acknowledge.
    fn effect(self, i2c_has_status: bool) -> Effect {
        use Effect::*;
        match self {
            LateOutput | LateSteps => Stops(&["Timer too close"]),
            SilentHost => Stops(&[MISSED_OUTPUT, MISSED_PWM]),
            EmergencyStop => Stops(&["Command request"]),
            // The next host stops the MCU.
            KilledHost => GoesOn,
            UnknownCommand => Stops(&["Invalid command"]),
            WrongOid => Stops(&["Invalid oid type"]),
            TooManyMoves => Stops(&["Move queue overflow"]),
            AdcGone => Stops(&["Error on analog read"]),
            SensorWireBroken => Stops(&["ADC out of range"]),
            ExpanderGone => Stops(&["GPIO line write failed"]),
            I2cChipGone if i2c_has_status => GoesOn,
            I2cChipGone => Stops(&["I2C NACK", "Unable write i2c device"]),
            // Commands wait for the chip, so no output is refreshed meanwhile. Both limits are five seconds.
            I2cChipHangs => Stops(&["Bus does not answer", MISSED_OUTPUT, MISSED_PWM]),
            SpiChipGone => Stops(&["Unable to issue spi ioctl"]),
            PwmGone => Stops(&["PWM write failed"]),
            ThermometerGone => Stops(&["Error reading DS18B20 sensor"]),
            AdcGlitch | ExpanderGlitch => GoesOn,
            // Steps that come too late stop the MCU. Without steps the pause does no harm.
            ShortStall => MayStop(&["Stepper too far in past"]),
            LongStall => MayStop(&["Stepper too far in past", "Rescheduled timer in the past", "Timer too close"]),
        }
    }

    fn strike(self, printer: &mut Printer, host: &mut Host) {
        let now = printer.rig.now();
        let faults = printer.faults.clone();
        match self {
            LateOutput => host.set(printer, LED, now - 50 * MS, 1),
            LateSteps => match host.idle_axis(now) {
                Some(axis) => {
                    let clock = printer.wire(now - 30 * MS).into();
                    printer.send("reset_step_clock", &[("oid", (axis as u8).into()), ("clock", clock)]);
                    let step = [("interval", 1000.into()), ("count", 1.into()), ("add", 0.into())];
                    printer.send("queue_step", &[&[("oid", Arg::from(axis as u8))], &step[..]].concat());
                }
                None => LateOutput.strike(printer, host),
            },
            SilentHost => {
                host.heat_up(printer);
                printer.pass(STOPS_WITHIN);
            }
            KilledHost => {
                let silent = printer.dice.below(1000) as u64 * MS;
                printer.pass(silent);
            }
            EmergencyStop => printer.send("emergency_stop", &[]),
            UnknownCommand => {
                let mut writer = Writer::default();
                writer.int(5000);
                printer.execute("an unknown command", writer.payload().unwrap());
            }
            WrongOid => printer.send("stepper_get_position", &[("oid", HEATERS[0].into())]),
            TooManyMoves => (0..1100).for_each(|n| host.set(printer, LED, now + 5 * SECOND + n * MS, 1)),
            AdcGone => faults.adc.set(u32::MAX),
            AdcGlitch => faults.adc.set(2),
            SensorWireBroken => faults.open_circuit.store(true, Ordering::Relaxed),
            ExpanderGone => faults.expander.set(u32::MAX),
            ExpanderGlitch => faults.expander.set(2),
            I2cChipGone => faults.i2c.set(u32::MAX),
            I2cChipHangs => faults.i2c_hangs.store(true, Ordering::Relaxed),
            SpiChipGone => faults.spi.set(u32::MAX),
            PwmGone => faults.pwm.set(u32::MAX),
            ThermometerGone => faults.thermometer.set(u32::MAX),
            ShortStall | LongStall => {
                let ms = if self == ShortStall { 1 + printer.dice.below(50) } else { 100 + printer.dice.below(900) };
                printer.rig.stall_until(now + ms as u64 * MS);
            }
        }
    }
}

/// A day, with the report of it.
struct Day {
    printer: Printer,
    /// How often each fault came, and how often the MCU stopped.
    faults: BTreeMap<Fault, (u32, u32)>,
    /// The faults of the deck that are still to come.
    deck: Vec<Fault>,
    /// The memory of the MCU after each reset.
    bytes: Vec<i64>,
}

impl Day {
    /// Draws the next fault: each comes once before one comes again.
    fn draw(&mut self) -> Fault {
        if self.deck.is_empty() {
            self.deck.extend(FAULTS);
        }
        let place = self.printer.dice.below(self.deck.len());
        self.deck.swap_remove(place)
    }

    /// A host's life, from its first word until the MCU stops or the day ends.
    fn session(&mut self, end: u64) {
        let printer = &mut self.printer;
        let dialect = printer.any_dialect();
        printer.meet(dialect);
        self.reset();
        if self.printer.dice.below(4) == 0 {
            self.miss_a_bus();
        }
        let mut host = Host::configure(&mut self.printer);
        while self.printer.rig.now() < end {
            // Most faults come soon. Some hosts live for several wraps of the clock.
            let dice = &mut self.printer.dice;
            let pause = if dice.below(16) == 0 { 60 + dice.below(300) } else { 2 + dice.below(15) } as u64 * SECOND;
            let until = (self.printer.rig.now() + pause).min(end);
            while self.printer.rig.now() < until && host.stopped.is_none() {
                let stretch = (5 + self.printer.dice.below(20) as u64) * SECOND;
                let stretch = stretch.min(until - self.printer.rig.now());
                host.work(&mut self.printer, stretch);
                if self.printer.dice.below(2) == 0 && host.stopped.is_none() {
                    host.rest(&mut self.printer);
                }
            }
            assert_eq!(host.stopped, None, "the MCU stops without a fault: {:?}", self.printer.rig.notes());
            let fault = self.draw();
            if self.suffer(fault, &mut host) {
                return;
            }
        }
    }

    /// A host comes while a bus is gone. Its configuration ends there, and nothing of it stays.
    fn miss_a_bus(&mut self) {
        let printer = &mut self.printer;
        printer.note("a bus is missing");
        printer.faults.spi.set(u32::MAX);
        let stopped = Host::configure_in_vain(printer);
        assert_eq!(stopped.as_deref(), Some("Unable to open spi device"));
        printer.faults.mend();
        printer.send("config_reset", &[]);
        self.reset();
    }

    /// Lets something go wrong. Returns whether the host ended, because the MCU stopped or somebody killed the host.
    fn suffer(&mut self, fault: Fault, host: &mut Host) -> bool {
        let printer = &mut self.printer;
        let i2c_has_status = printer.has_parameter("i2c_transfer", "write");
        printer.rig.notes();
        printer.note(format!("{fault:?}"));
        printer.is_strict = false;
        let since = printer.rig.now();
        fault.strike(printer, host);
        host.listen(printer);
        if fault != KilledHost {
            host.work(printer, (since + STOPS_WITHIN).saturating_sub(printer.rig.now()));
        }
        let notes = printer.rig.notes();
        let stopped = host.stopped.as_deref();
        let known = |texts: &[&str]| stopped.is_some_and(|text| texts.contains(&text));
        let is_explained = match fault.effect(i2c_has_status) {
            Effect::Stops(texts) => known(texts),
            Effect::MayStop(texts) => stopped.is_none() || known(texts),
            Effect::GoesOn => stopped.is_none(),
        };
        assert!(is_explained, "{fault:?} makes {stopped:?}: {notes:?}");
        let count = self.faults.entry(fault).or_default();
        count.0 += 1;
        count.1 += u32::from(stopped.is_some());
        if stopped.is_some() {
            self.recover(fault, host);
            return true;
        }
        if fault == KilledHost {
            return true;
        }
        printer.faults.mend();
        // The bench's workers run in this thread. They free their last failures now.
        host.work(printer, 2 * SECOND);
        printer.is_strict = true;
        false
    }

    /// Repairs what is broken, checks the stopped MCU, and compares the positions.
    fn recover(&mut self, fault: Fault, host: &mut Host) {
        let printer = &mut self.printer;
        assert!(!printer.heats(), "a heater is on after {fault:?}");
        printer.pass(200 * MS);
        // An output that cannot be set is owed as long as its chip is gone.
        let is_owed = matches!(fault, ExpanderGone | PwmGone);
        assert_eq!(printer.rig.mcu.has_pending_values(), is_owed, "{:?}", printer.rig.mcu.pending_value());
        printer.faults.mend();
        self.check_stopped();
        let printer = &mut self.printer;
        printer.send("clear_shutdown", &[]);
        host.compare(printer);
    }

    /// A stopped MCU moves nothing, heats nothing and keeps nothing queued.
    fn check_stopped(&mut self) {
        let printer = &mut self.printer;
        printer.pass(100 * MS);
        assert!(!printer.rig.mcu.has_pending_values(), "{:?} is owed", printer.rig.mcu.pending_value());
        let positions = printer.positions();
        printer.pass(AFTER_STOP);
        assert_eq!(printer.positions(), positions, "a stopped MCU makes steps");
        assert!(!printer.heats(), "a heater is on in a stopped MCU");
        assert!(printer.probe.fan(EXPANDED).unwrap().rpm < 10.0, "the fan turns in a stopped MCU");
        assert!(printer.probe.axes().all(|axis| !axis.enabled), "a motor is on in a stopped MCU");
        assert!(!printer.probe.output("light").unwrap().on, "the light is on in a stopped MCU");
        assert!(printer.probe.sights().any(|sight| sight == ("laser", Look::Power { share: 0.0 })), "the laser is on");
        // The MCU still samples the thermistors.
        assert!(printer.rig.jobs() <= 2, "{} jobs are on their way in a stopped MCU", printer.rig.jobs());
        assert_eq!(printer.look().moves.0, 0, "moves are queued in a stopped MCU");
    }

    /// Makes the MCU forget its configuration, as a new host does. It keeps no memory of it.
    fn reset(&mut self) {
        let printer = &mut self.printer;
        printer.is_strict = false;
        let config = printer.ask("get_config", &[], "config");
        if config.int("is_config").unwrap() != 0 {
            printer.send("emergency_stop", &[]);
            self.check_stopped();
            let printer = &mut self.printer;
            printer.send("config_reset", &[]);
            let config = printer.ask("get_config", &[], "config");
            assert_eq!((config.int("is_config").unwrap(), config.int("is_shutdown").unwrap()), (0, 0));
        }
        let printer = &mut self.printer;
        let now = printer.look();
        assert_eq!((now.moves, now.lines.len(), now.objects.len()), ((0, 0), 0, 0));
        let bytes = printer.bytes();
        self.bytes.push(bytes);
        let more = bytes - self.bytes[0];
        assert!(more < GROWTH_BYTES, "a reset MCU has {more} bytes more than the first");
    }

    fn report(&self, took: std::time::Duration) {
        let now = self.printer.rig.now();
        println!(
            "{} s in {:.1} s, {} wraps of the clock: {:?}, at most {} bytes more after a reset",
            now / SECOND,
            took.as_secs_f64(),
            (now >> 32) + 1,
            self.printer.tally,
            self.bytes.iter().map(|bytes| bytes - self.bytes[0]).max().unwrap_or(0)
        );
        for (fault, (times, stops)) in &self.faults {
            println!("{fault:?}: {times} times, {stops} stops");
        }
    }
}

fn number(name: &str, default: u64) -> u64 {
    let text = std::env::var(name).ok();
    text.map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

#[test]
#[ignore = "slow"]
fn a_day_of_printing_with_faults_leaks_nothing_and_loses_no_step() {
    let seconds = number("PINION_SOAK_SECONDS", SECONDS);
    let end = seconds * SECOND;
    let printer = Printer::new(number("PINION_SOAK_SEED", 17), seconds);
    let mut day = Day { printer, faults: BTreeMap::new(), deck: Vec::new(), bytes: Vec::with_capacity(1 << 16) };
    let began = Instant::now();
    while day.printer.rig.now() < end || day.faults.len() < FAULTS.len() {
        let soon = day.printer.rig.now() + 60 * SECOND;
        day.session(end.max(soon));
    }
    day.report(began.elapsed());
}
