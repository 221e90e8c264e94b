// SPDX-License-Identifier: GPL-3.0-or-later
//! Step edges at a steady rate.

use std::time::{Duration, Instant};

use pinion_client::config::Config;
use pinion_client::{Arg, Client, Error};
use pinion_firmware::time::{Clock, NS_PER_TICK, Ticks};

use super::process::{self, Others};
use super::rig::{Launch, Program, Rig, Running};
use super::{BUS_US, table};

/// Step and direction pin of each stepper.
const PINS: [(u8, u8); 3] = [(17, 18), (22, 24), (23, 25)];
/// klippy's pulse for a driver of unknown needs: 2 us, then an unstep.
const PULSE: Ticks = Ticks::from_us(2);
/// klippy's pulse for a driver that steps on both edges: 100 ns.
const PULSE_BOTH_EDGES: Ticks = Ticks(5);
/// How long the steps of a move last, about, in seconds.
const MOVE_S: f64 = 0.025;
/// How long before the first step the first move is queued, and how far ahead the last one.
const AHEAD_S: f64 = 0.5;
/// Highest number of moves that are queued, of the 1,024 that there are.
const MOVES_MAX: u16 = 900;
/// How long the client sleeps between feeds. Each time it also sends an SPI transfer, if the load has them.
const FEED: Duration = Duration::from_millis(25);
/// The second and third stepper step a little slower. So their edges meet the others' edges at every distance.
const SLOWER: [f64; 3] = [1.0, 1.003, 1.011];
/// The SPI device of a load with transfers.
pub const SPI_OID: u8 = 3;

/// The steppers' work.
#[derive(Clone, Debug)]
pub struct Load {
    /// The interval of each stepper, in ticks.
    intervals: Vec<u32>,
    both_edges: bool,
    transfers: bool,
    realtime: bool,
    /// Whether edges are recorded.
    records: bool,
    seconds: f64,
    move_s: f64,
    ahead_s: f64,
}

impl Load {
    /// A load whose edges are recorded; every step is a pulse.
    pub fn steady(rate_hz: u32, steppers: usize, transfers: bool, seconds: f64) -> Load {
        let interval = f64::from(pinion_firmware::time::CLOCK_FREQ) / f64::from(rate_hz);
        let intervals = SLOWER.iter().take(steppers).map(|slower| (interval * slower).round() as u32).collect();
        Load {
            intervals,
            both_edges: false,
            transfers,
            realtime: true,
            records: true,
            seconds,
            move_s: MOVE_S,
            ahead_s: AHEAD_S,
        }
    }

    /// A load that queues at once as much as the move queue takes, in the longest moves. Only the steps count, not
    /// whether the program still finds time for commands.
    fn fast(ticks: u32, steppers: usize, realtime: bool, run_s: f64) -> Load {
        let intervals = vec![ticks; steppers];
        let move_s = seconds(ticks) * f64::from(u16::MAX);
        let ahead_s = move_s * f64::from(MOVES_MAX) / steppers as f64;
        let (both_edges, transfers, records) = (true, false, false);
        Load { intervals, both_edges, transfers, realtime, records, seconds: run_s, move_s, ahead_s }
    }

    fn steps(&self) -> f64 {
        self.intervals.iter().map(|interval| self.seconds / seconds(*interval)).sum()
    }
}

fn seconds(ticks: u32) -> f64 {
    f64::from(ticks) / f64::from(pinion_firmware::time::CLOCK_FREQ)
}

/// The result of a load.
#[derive(Debug)]
pub struct Outcome {
    /// The lateness of each step edge, in nanoseconds, sorted.
    late_ns: Vec<i64>,
    pub cpu_us_per_step: f64,
    /// Why the MCU stopped, if it did.
    pub shutdown: Option<String>,
    pub lasted_s: f64,
    /// CPUs that other processes used meanwhile.
    pub others: f64,
}

impl Outcome {
    /// The highest lateness of this share of the edges.
    pub fn late_us(&self, share: f64) -> f64 {
        table::quantile(&self.late_ns, share) as f64 / 1e3
    }
}

/// Runs a load in a program started for it.
pub fn run(rig: &Rig, program: &Program, load: &Load) -> Result<Outcome, String> {
    let edges_max = if load.records { (load.steps() * 2.2) as usize + 10_000 } else { 0 };
    let launch = Launch { realtime: load.realtime, edges_max, bus_us: if load.transfers { BUS_US } else { 0 } };
    let running = rig.start(program, &launch)?;
    let mut client = configured(&running, load)?;
    let mut feeder = Feeder::new(&mut client, load).map_err(|error| error.to_string())?;
    let start = feeder.start;
    let others = Others::start(running.pid());
    let mut busy = Busy::default();
    let fed = feeder.feed(&mut client, &running, &mut busy);
    let others = others.cpus();
    let shutdown = match fed.and_then(|()| feeder.verify(&mut client)) {
        Ok(()) => None,
        Err(Error::Shutdown { reason }) => Some(reason),
        Err(error) => Some(error.to_string()),
    };
    let lasted_s = busy.ended.map_or(load.seconds, |ended| ended.min(load.seconds));
    let late_ns = if load.records { lateness(&running.edges()?, start, load)? } else { Vec::new() };
    Ok(Outcome { late_ns, cpu_us_per_step: busy.cpu_us_per_step(load), shutdown, lasted_s, others })
}

/// Configures a program for a load.
pub fn configured(running: &Running, load: &Load) -> Result<Client, String> {
    let mut client = running.client()?;
    let mut config = Config::default();
    let (invert, pulse) = if load.both_edges { (-1, PULSE_BOTH_EDGES) } else { (0, PULSE) };
    for (step, dir) in PINS {
        let oid = config.oid().map_err(|error| error.to_string())?;
        config.add(format!(
            "config_stepper oid={oid} step_pin=gpio{step} dir_pin=gpio{dir} invert_step={invert} step_pulse_ticks={}",
            pulse.0
        ));
    }
    if load.transfers {
        let oid = config.oid().map_err(|error| error.to_string())?;
        config.add(format!("config_spi_without_cs oid={oid}"));
        config.add(format!("spi_set_bus oid={oid} spi_bus=spidev0.0 mode=0 rate=1000000"));
    }
    config.apply(&mut client).map_err(|error| format!("configuring: {error}"))?;
    Ok(client)
}

/// CPU time over the part of the run in which all steppers move.
#[derive(Default)]
struct Busy {
    from: Option<(Instant, Duration)>,
    to: Option<(Instant, Duration)>,
    /// When feeding ended, in seconds after the first step.
    ended: Option<f64>,
}

impl Busy {
    fn cpu_us_per_step(&self, load: &Load) -> f64 {
        let (Some((from, cpu_from)), Some((to, cpu_to))) = (self.from, self.to) else { return f64::NAN };
        let span = to.duration_since(from).as_secs_f64();
        let steps: f64 = load.intervals.iter().map(|interval| span / seconds(*interval)).sum();
        cpu_to.saturating_sub(cpu_from).as_secs_f64() * 1e6 / steps
    }
}

/// Keeps the move queue filled.
struct Feeder {
    start: Clock,
    queues: Vec<Queue>,
    transfer: Option<Vec<u8>>,
    seconds: f64,
    ahead_s: f64,
}

struct Queue {
    oid: u8,
    interval: u32,
    steps_a_move: u32,
    steps_queued: u64,
}

impl Feeder {
    fn new(client: &mut Client, load: &Load) -> Result<Feeder, Error> {
        let start = client.clock_in(AHEAD_S)?;
        let mut queues = Vec::new();
        for (oid, interval) in (0..).zip(&load.intervals) {
            client.send("reset_step_clock", &[("oid", oid.into()), ("clock", start.into())])?;
            let steps_a_move = (load.move_s / seconds(*interval)).round().clamp(1.0, 65_535.0) as u32;
            queues.push(Queue { oid, interval: *interval, steps_a_move, steps_queued: 0 });
        }
        let transfer = load.transfers.then(|| {
            client.messages().encode("spi_transfer", &[("oid", SPI_OID.into()), ("data", Arg::Bytes(&[0x5a; 8]))])
        });
        Ok(Feeder { start, queues, transfer: transfer.transpose()?, seconds: load.seconds, ahead_s: load.ahead_s })
    }

    /// Queues moves until all are queued, then waits until all steps are made.
    fn feed(&mut self, client: &mut Client, running: &Running, busy: &mut Busy) -> Result<(), Error> {
        let begin = client.instant_of(self.start);
        let since = |now: Instant| match now.checked_duration_since(begin) {
            Some(span) => span.as_secs_f64(),
            None => -begin.duration_since(now).as_secs_f64(),
        };
        let mut next = Instant::now();
        loop {
            let now = since(Instant::now());
            busy.ended = Some(now.max(0.0));
            if busy.from.is_none() && now > 0.2 {
                busy.from = Some((Instant::now(), process::cpu(running.pid())));
            }
            if now > self.seconds {
                break;
            }
            let mut commands = Vec::new();
            for queue in &mut self.queues {
                queue.fill((now + self.ahead_s).min(self.seconds), client, &mut commands)?;
            }
            commands.extend(self.transfer.clone());
            client.send_encoded(&commands)?;
            next += FEED;
            client.listen(next)?;
            drop(client.drain());
            if now < self.seconds - 0.1 && now > 0.2 {
                busy.to = Some((Instant::now(), process::cpu(running.pid())));
            }
        }
        client.listen(Instant::now() + Duration::from_millis(200))
    }

    /// Whether every step was made.
    fn verify(&self, client: &mut Client) -> Result<(), Error> {
        for queue in &self.queues {
            let oid = queue.oid;
            let answer = client.query("stepper_get_position", &[("oid", oid.into())], "stepper_position", Some(oid))?;
            let made = answer.int("pos")?.unsigned_abs();
            if made != queue.steps_queued {
                let why = format!("{made} of {} steps were made", queue.steps_queued);
                return Err(Error::Plan { subject: format!("stepper {oid}"), why });
            }
        }
        client.check()
    }
}

impl Queue {
    fn fill(&mut self, until_s: f64, client: &Client, commands: &mut Vec<Vec<u8>>) -> Result<(), Error> {
        while self.steps_queued as f64 * seconds(self.interval) < until_s {
            let args = [
                ("oid", self.oid.into()),
                ("interval", self.interval.into()),
                ("count", self.steps_a_move.into()),
                ("add", 0u8.into()),
            ];
            commands.push(client.messages().encode("queue_step", &args)?);
            self.steps_queued += u64::from(self.steps_a_move);
        }
        Ok(())
    }
}

/// How late each step's edge was. The n-th rising edge of a line is the n-th step. Tick 0 is a whole second of
/// CLOCK_MONOTONIC: the one that makes the first step the least late or early.
fn lateness(edges: &[(u64, u8, bool)], start: Clock, load: &Load) -> Result<Vec<i64>, String> {
    const SECOND: i64 = 1_000_000_000;
    let mut late = Vec::with_capacity(edges.len() / 2);
    for (interval, (line, _)) in load.intervals.iter().zip(PINS) {
        let stamps = edges.iter().filter(|(_, at, level)| *at == line && *level).map(|(ns, ..)| *ns as i64);
        // Klipper's own program starts a little before its tick 0.
        let ns = |ticks: i64| ticks * NS_PER_TICK as i64;
        let first = ns(i64::from((start + Ticks(*interval)).wire() as i32));
        let mut origin = None;
        for (n, stamp) in (0..).zip(stamps) {
            let origin = *origin.get_or_insert_with(|| (stamp - first + SECOND / 2).div_euclid(SECOND) * SECOND);
            late.push(stamp - origin - first - ns(n * i64::from(*interval)));
        }
    }
    if late.is_empty() {
        return Err("no step was made".into());
    }
    late.sort_unstable();
    Ok(late)
}

/// The smallest interval that survives, and what happens below it.
#[derive(Debug)]
pub struct Smallest {
    /// `None` if it survives none.
    pub ticks: Option<u32>,
    pub below: String,
}

/// Highest interval that is tried.
const TICKS_MAX: u32 = 20_000;
/// How often the MCU must die at an interval. One death may be the fault of other processes on this computer.
const DEATHS: u32 = 2;

/// Finds the smallest step interval at which the MCU continues for this many seconds, within some 3 %. The driver steps
/// on both edges: one edge a step.
pub fn smallest_interval(
    rig: &Rig,
    program: &Program,
    steppers: usize,
    realtime: bool,
    seconds: f64,
) -> Result<Smallest, String> {
    let (mut dies, mut lives) = (0, None);
    let mut below = String::new();
    let mut ticks = 100u32;
    loop {
        let mut deaths = 0;
        while deaths < DEATHS {
            match run(rig, program, &Load::fast(ticks, steppers, realtime, seconds))?.shutdown {
                None => break,
                Some(reason) => {
                    deaths += 1;
                    below = reason;
                }
            }
        }
        if deaths < DEATHS {
            lives = Some(ticks);
        } else {
            dies = ticks;
        }
        ticks = match lives {
            None if ticks > TICKS_MAX => return Ok(Smallest { ticks: None, below }),
            None => dies * 2,
            Some(lives) if dies == 0 => lives / 2,
            Some(lives) if f64::from(lives) / f64::from(dies) < 1.03 || lives - dies <= 1 => {
                return Ok(Smallest { ticks: Some(lives), below });
            }
            Some(lives) => (f64::from(lives) * f64::from(dies)).sqrt().round().max(f64::from(dies + 1)) as u32,
        };
        if ticks < 2 {
            return Ok(Smallest { ticks: lives, below });
        }
    }
}
