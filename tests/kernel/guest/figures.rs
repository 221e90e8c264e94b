// SPDX-License-Identifier: GPL-3.0-or-later
//! The costs and the lateness of an MCU program. `--program` runs these tests with another program too. Each figure is
//! a line for the table on the computer's side.
//!
//! Only Pinion's figures are asserted.

mod print;
mod uart;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use pinion_client::config::Config;
use pinion_client::motion::Stepper;
use pinion_client::{Arg, Client, Error};
use pinion_firmware::time::{CLOCK_FREQ, Clock, NS_PER_TICK, Ticks};

use crate::gpio_sim::GpioSim;
use crate::program::{self, Program};
use crate::register_file::RegisterFile;
use crate::sysfs;
use crate::trace::{Calls, Trace};

/// The VM's value: see `TIME` in `tests/kernel/vm.rs`.
const NS_PER_INSTRUCTION: f64 = 1.0;
/// Approximate time of a move's steps, as with klippy.
const MOVE: Ticks = Ticks::from_ms(25);
/// Number of moves that are queued before the first step, and that the queue stays ahead by.
const MOVES_AHEAD: u32 = 20;
/// Time from the first moves to the first step.
const LEAD_S: f64 = 0.2;
/// Each further stepper steps a little slower. So their edges meet the edges of the others at every distance.
const SLOWER: [f64; 6] = [1.0, 1.003, 1.011, 1.017, 1.024, 1.029];
/// Steppers of a session, if the case does not say.
const STEPPERS: usize = 3;
/// klippy's value for a driver that steps on both edges: 100 ns.
const PULSE_TICKS: u32 = 5;
/// Settings of spidev.
const DELAY_MS: &str = "/sys/devices/platform/mock-spi/delay_ms";
const DELAY_US: &str = "/sys/devices/platform/mock-spi/delay_us";
const SPI_DATA: Arg<'_> = Arg::Bytes(&[0x5a; 8]);

/// Thousands of steps per second, number of moves, and number of steppers. (The figures of a debug build are not used.
/// This is enough to test the tests themselves.)
const CASES: &[(u32, u32, usize)] = match cfg!(debug_assertions) {
    true => &[(10, 8, 1)],
    false => &[(1, 120, 1), (10, 40, 1), (50, 24, 1), (1, 120, 3), (10, 40, 3), (50, 24, 3)],
};

/// Numbers of motors whose highest rate is looked for.
const MOTORS: &[usize] = if cfg!(debug_assertions) { &[1] } else { &[1, 2, 3, 4, 6] };

/// A figure of the program for the table: see `tests/kernel/table.rs`.
fn figure(of: &str, case: &str, value: &str) {
    println!("figure\t{of}\t{case}\t{value}");
}

fn is_pinion() -> bool {
    program::other().is_none()
}

fn instructions(time: Duration) -> f64 {
    time.as_nanos() as f64 / NS_PER_INSTRUCTION
}

/// Steppers that move evenly, with a step on each edge.
struct Load {
    /// The interval of each stepper, in ticks.
    intervals: Vec<u32>,
    moves: u32,
    moves_ahead: u32,
    /// Whether an SPI transfer begins in the middle of each move. (A transfer that keeps a program busy beyond the end
    /// of a move may end in "Stepper too far in past".)
    transfers: bool,
}

impl Load {
    fn steady(thousands: u32, moves: u32, steppers: usize, transfers: bool) -> Load {
        Load { transfers, ..Load::at(f64::from(1000 * thousands), moves, steppers) }
    }

    /// `rate`: steps per second of the first stepper.
    fn at(rate: f64, moves: u32, steppers: usize) -> Load {
        let interval = f64::from(CLOCK_FREQ) / rate;
        let intervals = SLOWER[..steppers].iter().map(|slower| (interval * slower).round() as u32).collect();
        Load { intervals, moves, moves_ahead: MOVES_AHEAD, transfers: false }
    }

    /// The whole load is queued before it begins.
    fn fast(interval: u32, steppers: usize) -> Load {
        Load { intervals: vec![interval; steppers], moves: 12, moves_ahead: 12, transfers: false }
    }

    fn steps_a_move(interval: u32) -> u32 {
        (MOVE.0 / interval).max(1)
    }

    fn steps(&self) -> impl Iterator<Item = u32> {
        self.intervals.iter().map(|interval| Self::steps_a_move(*interval) * self.moves)
    }

    /// Number of steps of all steppers in a time span within the load.
    fn steps_in(&self, span: Duration) -> f64 {
        let ticks = span.as_nanos() as f64 / NS_PER_TICK as f64;
        self.intervals.iter().map(|interval| ticks / f64::from(*interval)).sum()
    }
}

/// How the program writes lines.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Way {
    Kernel,
    /// Through a file in place of a chip's registers. No line changes.
    Registers,
}

/// A program that is configured for loads, and its host.
struct Session {
    // Dropped before the chip with its lines: the next chip must have the same number.
    program: Program,
    _registers: Option<RegisterFile>,
    sim: GpioSim,
    client: Client,
    steppers: Vec<Stepper>,
    spi_oid: u8,
}

impl Session {
    fn start(way: Way) -> Session {
        Session::of(way, STEPPERS, Program::measured)
    }

    fn of(way: Way, steppers: usize, program: fn() -> Program) -> Session {
        // The n-th stepper has the lines 2 n (step) and 2 n + 1 (direction).
        let lines = 2 * steppers as u32;
        let sim = GpioSim::new("lab", lines);
        let registers = (way == Way::Registers).then(|| RegisterFile::of(&sim));
        let program = program();
        let mut client = program.connect();
        let mut config = Config::default();
        let pin = |line| format!("{}/gpio{line}", sim.chip_name());
        let stepper =
            |line| Stepper::configure(&mut config, &pin(line), -1, &pin(line + 1), false, PULSE_TICKS).expect("few");
        let steppers = (0..lines).step_by(2).map(stepper).collect();
        let spi_oid = config.oid().expect("few objects");
        config.add(format!("config_spi_without_cs oid={spi_oid}"));
        config.add(format!("spi_set_bus oid={spi_oid} spi_bus=spidev0.0 mode=0 rate=4000000"));
        config.apply(&mut client).expect("a configuration that it takes");
        if registers.is_some() {
            program.wait_for_line(&["lines are written and read through /dev/gpiomem"]);
        }
        let log = if is_pinion() { program.log() } else { String::new() };
        assert_eq!(log.contains("lines are written and read through /dev/gpiomem"), registers.is_some(), "{log}");
        assert!(!log.contains("through the kernel, not through registers: line"), "{log}");
        Session { program, _registers: registers, sim, client, steppers, spi_oid }
    }

    /// Runs a load. `look` is called at the beginning and at the end of the part in which all steppers move. Returns
    /// the start of the first interval, or the reason for a shutdown of the MCU.
    fn run(&mut self, load: &Load, look: impl FnMut(&Program)) -> Result<Clock, String> {
        match self.try_run(load, look) {
            Ok(start) => Ok(start),
            Err(Error::Shutdown { reason }) => Err(reason),
            Err(error) => panic!("{error}"),
        }
    }

    fn try_run(&mut self, load: &Load, mut look: impl FnMut(&Program)) -> Result<Clock, Error> {
        let start = self.client.clock_in(LEAD_S)?;
        for stepper in &self.steppers[..load.intervals.len()] {
            self.client.send("reset_step_clock", &[("oid", stepper.oid.into()), ("clock", start.into())])?;
        }
        self.queue(load, load.moves_ahead.min(load.moves))?;
        for number in 0..load.moves {
            let middle = start + Ticks(MOVE.0 * number + MOVE.0 / 2);
            self.client.listen(self.client.instant_of(middle))?;
            drop(self.client.drain());
            if number == 1 || number == load.moves - 2 {
                look(&self.program);
            }
            self.queue(load, u32::from(number + load.moves_ahead < load.moves))?;
            if load.transfers {
                self.client.send("spi_transfer", &[("oid", self.spi_oid.into()), ("data", SPI_DATA)])?;
            }
        }
        // Late steps are also made before the positions are queried.
        self.client.listen(Instant::now() + Duration::from_millis(100))?;
        for (stepper, steps) in self.steppers.iter().zip(load.steps()) {
            let made = stepper.position(&mut self.client)?;
            if made.unsigned_abs() != u64::from(steps) {
                return Err(Error::Shutdown { reason: format!("{made} of {steps} steps") });
            }
        }
        self.client.check()?;
        Ok(start)
    }

    /// Checks that a busy program did not make its host wait too long.
    fn assert_within(&self, load: &Load, start: Clock, look: Instant) {
        let end = self.client.instant_of(start + Ticks(MOVE.0 * load.moves));
        assert!(look < end, "the load was over {:?} before the host looked", look - end);
    }

    /// Queues this number of moves for each stepper.
    fn queue(&mut self, load: &Load, moves: u32) -> Result<(), Error> {
        let mut commands = Vec::new();
        for _ in 0..moves {
            for (stepper, interval) in self.steppers.iter().zip(&load.intervals) {
                let count = Load::steps_a_move(*interval);
                let args = [
                    ("oid", stepper.oid.into()),
                    ("interval", (*interval).into()),
                    ("count", count.into()),
                    ("add", 0_u8.into()),
                ];
                commands.push(self.client.messages().encode("queue_step", &args)?);
            }
        }
        self.client.send_encoded(&commands)
    }

    /// How late each edge was, in nanoseconds, sorted.
    fn late_ns(&self, trace: &Trace, load: &Load, start: Clock) -> Vec<i64> {
        const SECOND: i64 = 1_000_000_000;
        let writes = trace.writes();
        let mut late = Vec::new();
        for (line, interval) in (0..).step_by(2).zip(&load.intervals) {
            let number = self.sim.kernel_number(line);
            let edges = writes.iter().filter(|write| write.line == number);
            // Tick 0 is a whole second of CLOCK_MONOTONIC. A program may start before it.
            let begin = i64::from(start.wire() as i32);
            let due_ns = |step: i64| (begin + step * i64::from(*interval)) * NS_PER_TICK as i64;
            late.extend((1..).zip(edges).map(|(step, edge)| {
                let late = edge.at_ns as i64 - due_ns(step);
                (late + SECOND / 2).rem_euclid(SECOND) - SECOND / 2
            }));
        }
        late.sort_unstable();
        late
    }
}

/// Prints a figure for every case, or the reason for a shutdown of the MCU. Pinion must not shut down.
fn figures(of: &str, way: Way, transfers: bool, measure: impl Fn(&mut Session, &Load, &str) -> Result<String, String>) {
    for &(thousands, moves, steppers) in CASES {
        let load = Load::steady(thousands, moves, steppers, transfers);
        let case = format!("{thousands} k/s, {}", count_of(steppers));
        let text = measure(&mut Session::start(way), &load, &case).unwrap_or_else(|reason| {
            assert!(!is_pinion(), "{case}: {reason}");
            format!("stops: {reason}")
        });
        figure(of, &case, &text);
    }
}

fn count_of(steppers: usize) -> String {
    format!("{steppers} stepper{}", if steppers == 1 { "" } else { "s" })
}

/// How late the edges of a load are: by a share of them, in microseconds.
fn late_us(session: &mut Session, load: &Load) -> Result<impl Fn(f64) -> f64 + use<>, String> {
    let trace = Trace::start();
    let start = session.run(load, |_| ())?;
    let late_ns = session.late_ns(&trace, load, start);
    assert_eq!(late_ns.len() as u32, load.steps().sum::<u32>(), "each step is an edge");
    Ok(move |share: f64| late_ns[((late_ns.len() - 1) as f64 * share) as usize] as f64 / 1000.0)
}

fn lateness(session: &mut Session, load: &Load, case: &str) -> Result<String, String> {
    let us = late_us(session, load)?;
    if is_pinion() {
        assert!(us(0.0) >= -0.1, "{case}: an edge came {} us early", -us(0.0));
        let late = format!("{case}: late by {}, {}, {} us", us(0.5), us(0.99), us(1.0));
        assert!(us(0.5) <= 5.0 && us(0.99) <= 10.0 && us(1.0) <= 50.0, "{late}");
    }
    Ok(format!("{:.2} / {:.2} / {:.2}", us(0.5), us(0.99), us(1.0)))
}

#[test]
fn edges_are_late() {
    figures("Edges late, us: p50 / p99 / max", Way::Kernel, false, lateness);
}

/// By the program's own count: the time at which a timer runs. The store follows some 100 instructions later.
#[test]
fn timers_are_late_with_registers() {
    if !is_pinion() {
        return;
    }
    figures("Timers late with registers, us: p50 / p99", Way::Registers, false, |session, load, _| {
        session.run(load, |_| ())?;
        let us = timers_late_us(session);
        Ok(format!("{:.2} / {:.2}", us("p50_us"), us("p99_us")))
    });
}

/// How late Pinion's timers were so far, by a key of its status.
fn timers_late_us(session: &Session) -> impl Fn(&str) -> f64 + use<> {
    let link = session.program.link();
    let status = Command::new("pinion").args(["status", "--json", "-I"]).arg(link).output().expect("a status");
    let status: serde_json::Value = serde_json::from_slice(&status.stdout).expect("a status");
    move |key| status["lateness"][key].as_f64().expect("a time")
}

#[test]
fn edges_are_late_beside_transfers() {
    let _delay = sysfs::set(DELAY_MS, "4", "0");
    figures("Edges late beside SPI transfers of 4 ms, us: p50 / p99 / max", Way::Kernel, true, lateness);
}

/// Programs of a computer that is busy: one copies a file, one starts a compressor again and again, as a build starts a
/// compiler. They end when this is dropped.
struct Others(Vec<Child>);

impl Others {
    fn start() -> Others {
        const COPY: &str = "while :; do dd if=/bin/guest of=/tmp/copy bs=64k 2>/dev/null; sync; done";
        const BUILD: &str = "while :; do dd if=/bin/guest bs=64k count=4 2>/dev/null | gzip >/dev/null; done";
        let shell = |script| Command::new("busybox").args(["sh", "-c", script]).process_group(0).spawn();
        Others([COPY, BUILD].map(|script| shell(script).expect("a shell")).into())
    }
}

impl Drop for Others {
    fn drop(&mut self) {
        for shell in &mut self.0 {
            let group = Pid::from_raw(shell.id().try_into().expect("a process id"));
            let _ = killpg(group, Signal::SIGKILL);
            let _ = shell.wait();
        }
        let _ = fs::remove_file("/tmp/copy");
    }
}

#[test]
fn edges_are_late_beside_other_programs() {
    const OF: &str = "Edges late beside programs that copy and compress, us: p50 / p99.9 / max";
    let _others = Others::start();
    figures(OF, Way::Kernel, false, |session, load, case| {
        let us = late_us(session, load)?;
        assert!(!is_pinion() || us(0.999) <= 200.0, "{case}: late by {} us", us(0.999));
        Ok(format!("{:.2} / {:.2} / {:.2}", us(0.5), us(0.999), us(1.0)))
    });
}

/// Highest rate at which all of this many motors step and 999 of 1000 edges are at most 10 us late, to within 3 %.
fn most_steps_by(of: &str, way: Way) {
    const LATE_US: f64 = 10.0;
    // Few, as the trace has room for 300,000 edges. All are queued before the first step: the boards have a processor for
    // the host, and this VM has one for both.
    const MOVES: u32 = 8;
    for motors in MOTORS {
        let keeps = |rate: f64| {
            let mut session = Session::of(way, *motors, Program::measured);
            let load = Load { moves_ahead: MOVES, ..Load::at(rate, MOVES, *motors) };
            match way {
                Way::Kernel => late_us(&mut session, &load).is_ok_and(|us| us(0.999) <= LATE_US),
                Way::Registers => session.run(&load, |_| ()).is_ok() && timers_late_us(&session)("p999_us") <= LATE_US,
            }
        };
        let (mut most, mut fails) = (500.0, 1_000_000.0);
        let mut holds = false;
        while fails / most > 1.03 {
            let middle = f64::sqrt(most * fails);
            let keeps = keeps(middle);
            holds |= keeps;
            *if keeps { &mut most } else { &mut fails } = middle;
        }
        let case = format!("{motors} motor{}", if *motors == 1 { "" } else { "s" });
        figure(of, &case, &if holds { format!("{:.1}", most / 1000.0) } else { "below 0.5".into() });
        assert!(!is_pinion() || most >= 5000.0, "{case}");
    }
}

#[test]
fn most_steps() {
    most_steps_by("Most steps a second of each motor with 999 of 1000 edges within 10 us, thousands", Way::Kernel);
}

#[test]
fn most_steps_with_registers() {
    if is_pinion() {
        most_steps_by("Steps a second with registers, the same, thousands", Way::Registers);
    }
}

/// The computer's side counts: see `tests/kernel/cache_lines.rs`. The processor is idle before each edge.
#[test]
fn cache_lines() {
    let load = Load::steady(1, 40, 1, false);
    Session::start(Way::Kernel).run(&load, |_| ()).expect("steps");
}

fn instructions_an_edge(session: &mut Session, load: &Load, _: &str) -> Result<String, String> {
    let mut looks = Vec::new();
    let start = session.run(load, |program| looks.push((Instant::now(), program.cpu_time())))?;
    let [(from, cpu_from), (to, cpu_to)] = looks[..] else { panic!("{looks:?}") };
    session.assert_within(load, start, to);
    Ok(format!("{:.0}", instructions(cpu_to - cpu_from) / load.steps_in(to - from)))
}

#[test]
fn edges_cost_instructions() {
    figures("Instructions an edge", Way::Kernel, false, instructions_an_edge);
}

#[test]
fn edges_cost_instructions_with_registers() {
    if is_pinion() {
        figures("Instructions an edge, with registers", Way::Registers, false, instructions_an_edge);
    }
}

#[test]
fn edges_cost_system_calls() {
    figures("System calls an edge", Way::Kernel, false, |session, load, case| {
        let calls = Calls::of(&session.program.threads());
        let mut looks: Vec<(Instant, BTreeMap<i64, u64>)> = Vec::new();
        let start = session.run(load, |_| looks.push((Instant::now(), calls.so_far())))?;
        let [(from, before), (to, after)] = &looks[..] else { panic!("{looks:?}") };
        session.assert_within(load, start, *to);
        let steps = load.steps_in(*to - *from);
        let count = |number: i64| (after.get(&number).unwrap_or(&0) - before.get(&number).unwrap_or(&0)) as f64;
        let all = after.keys().map(|number| count(*number)).sum::<f64>();
        let by_number = after.keys().map(|number| format!("{number}: {:.3}", count(*number) / steps));
        println!("{case}, by number: {}", by_number.collect::<Vec<_>>().join(", "));
        if is_pinion() {
            let [writes, waits, looks] = [libc::SYS_ioctl, libc::SYS_futex, libc::SYS_clock_gettime].map(count);
            // (Another thread may have the processor between reading the clock and the count.)
            assert!((0.95..1.05).contains(&(writes / steps)) && waits <= 1.1 * steps, "{case}");
            // Reading the clock needs no system call. The core makes one call for its running time every 24 ms, unless
            // it has little of that time left. A few more calls are the link's.
            let span_ms = (*to - *from).as_secs_f64() * 1000.0;
            assert!(looks <= span_ms / 10.0 && all - writes - waits - looks <= span_ms / 2.0, "{case}");
        }
        // Each edge is one write. The number of steps in a span is not known as exactly.
        Ok(format!("{:.3}", all / count(libc::SYS_ioctl)))
    });
}

/// If the steps of a load take longer than their interval, the load ends in "Stepper too far in past" when a move
/// begins a millisecond late. That is within 0.3 seconds if the steps take 0.4 % longer. The interval is found to
/// within 0.5 %.
fn smallest_interval_by(of: &str, way: Way) {
    for steppers in [1, 3] {
        let holds = |interval: u32| Session::start(way).run(&Load::fast(interval, steppers), |_| ()).is_ok();
        // The pulse takes 5 ticks, and 1000 are more than a step takes.
        let (mut fails, mut least) = (PULSE_TICKS - 1, 1000);
        assert!(holds(least));
        while least - fails > least.div_ceil(200) {
            let middle = (f64::from(least * fails).sqrt() as u32).max(fails + 1);
            *if holds(middle) { &mut least } else { &mut fails } = middle;
        }
        figure(of, &count_of(steppers), &least.to_string());
        assert!(!is_pinion() || least <= 500);
    }
}

#[test]
fn smallest_interval() {
    smallest_interval_by("Smallest interval between edges that holds, ticks", Way::Kernel);
}

#[test]
fn smallest_interval_with_registers() {
    if is_pinion() {
        smallest_interval_by("Smallest interval with registers, ticks", Way::Registers);
    }
}

#[test]
fn round_trip() {
    const ROUNDS: usize = 101;
    const PAUSE: Duration = Duration::from_millis(1);
    let mut session = Session::start(Way::Kernel);
    let (program, client, spi_oid) = (&session.program, &mut session.client, session.spi_oid);
    let transfer = [("oid", spi_oid.into()), ("data", SPI_DATA)];
    let none: &[(&str, Arg<'_>)] = &[];
    for (command, args, response) in [
        ("get_clock", none, "clock"),
        ("get_uptime", none, "uptime"),
        // In Pinion the link answers the two above, and the core answers this one.
        ("get_config", none, "config"),
        ("spi_transfer", &transfer, "spi_transfer_response"),
    ] {
        let round_trip = |_| {
            client.listen(Instant::now() + PAUSE).expect("a session");
            let sent = Instant::now();
            let answer = client.query(command, args, response, None).expect("an answer");
            answer.at.duration_since(sent)
        };
        let asleep = program.sleeps();
        let mut times: Vec<Duration> = (0..ROUNDS).map(round_trip).collect();
        let sleeps = (program.sleeps() - asleep) as f64 / ROUNDS as f64;
        times.sort_unstable();
        let median = instructions(times[ROUNDS / 2]);
        figure("Round trip of a command, instructions", command, &format!("{median:.0}"));
        figure("Round trip of a command, sleeps of all threads", command, &format!("{sleeps:.2}"));
        assert!(!is_pinion() || median <= 200_000.0);
    }
}

#[test]
fn transfers_one_a_block() {
    const COUNT: u32 = 500;
    let _delay = sysfs::set(DELAY_US, "30", "0");
    let mut session = Session::start(Way::Kernel);
    let (client, spi_oid) = (&mut session.client, session.spi_oid);
    let asleep = session.program.sleeps();
    let sent = Instant::now();
    for _ in 0..COUNT {
        client.send("spi_send", &[("oid", spi_oid.into()), ("data", Arg::Bytes(&[0x5a]))]).expect("a session");
    }
    client.query("get_uptime", &[], "uptime", None).expect("an answer");
    let each = instructions(sent.elapsed()) / f64::from(COUNT);
    figure("SPI transfers of 30 us, instructions for each", "spi_send, one a block", &format!("{each:.0}"));
    let sleeps = (session.program.sleeps() - asleep) as f64 / f64::from(COUNT);
    figure("SPI transfers of 30 us, sleeps of all threads for each", "spi_send, one a block", &format!("{sleeps:.2}"));
    assert!(!is_pinion() || each <= 200_000.0);
}

#[test]
fn idle() {
    const SPAN: Duration = Duration::from_secs(10);
    const CASE: &str = "3 steppers, silent host";
    let session = Session::start(Way::Kernel);
    std::thread::sleep(Duration::from_secs(1));
    let (from, cpu_from, asleep) = (Instant::now(), session.program.cpu_time(), session.program.sleeps());
    std::thread::sleep(SPAN);
    let (span, cpu) = (from.elapsed(), session.program.cpu_time() - cpu_from);
    let wakeups = (session.program.sleeps() - asleep) as f64 / span.as_secs_f64();
    let each = instructions(cpu) / span.as_secs_f64();
    figure("Idle, instructions a second", CASE, &format!("{each:.0}"));
    figure("Idle, wake-ups a second of all threads", CASE, &format!("{wakeups:.1}"));
    assert!(!is_pinion() || each <= 1_000_000.0 && wakeups <= 50.0);
}

#[test]
fn memory() {
    for (case, program) in
        [("without -r", Program::measured_in_ordinary_time as fn() -> Program), ("with -r", Program::measured)]
    {
        let mut session = Session::of(Way::Kernel, STEPPERS, program);
        // By then Pinion's search for the host is over.
        session.client.listen(Instant::now() + Duration::from_secs(1)).expect("a session");
        let kilobytes = session.program.memory_kb();
        figure("Memory of all processes, kB", case, &kilobytes.to_string());
        // A debug build is three times as large.
        let limit_kb = if cfg!(debug_assertions) { 64 << 10 } else { 7 << 10 };
        assert!(!is_pinion() || kilobytes <= limit_kb);
    }
}
