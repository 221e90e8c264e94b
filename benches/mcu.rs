// SPDX-License-Identifier: GPL-3.0-or-later
//! Measures the cost of the MCU itself, in virtual time and with lines that do nothing: decoding and dispatch of
//! commands, a step's event, the dictionary.

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use pinion_firmware::board::{Board, ClaimedLine, Direction, Line};
use pinion_firmware::mcu::{Dialect, DialectName, MOVE_COUNT, Snapshot};
use pinion_firmware::shutdown::Shutdown;
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_testbench::board::{Bench, FakeBoard, PlainBoard};
use pinion_testbench::rig::{FIRMWARE, Rig};

struct QuietLine;

impl Line for QuietLine {
    fn write(&self, level: bool) -> Result<(), Shutdown> {
        black_box(level);
        Ok(())
    }
    fn read(&self) -> Result<bool, Shutdown> {
        Ok(false)
    }
    fn set_direction(&self, _: Direction) -> Result<(), Shutdown> {
        Ok(())
    }
}

/// The bench's board with outputs that do nothing, so that only the MCU's cost is left.
fn quiet(bench: Bench) -> impl Board {
    PlainBoard(FakeBoard(bench), |_: &mut FakeBoard, _, _| {
        Ok(ClaimedLine { line: Arc::new(QuietLine), sleeps_on: None })
    })
}

/// `steppers` steppers whose moves are queued by the caller.
fn rig_of(steppers: u8, invert_step: i8) -> Rig {
    let mut rig = Rig::on_board(10_000_000, quiet);
    let objects: Vec<String> = (0..steppers)
        .map(|oid| {
            format!("config_stepper oid={oid} step_pin=0 dir_pin=1 invert_step={invert_step} step_pulse_ticks=100")
        })
        .collect();
    rig.configure(&objects.iter().map(String::as_str).collect::<Vec<_>>());
    rig
}

/// As many copies of a command as a message block takes.
fn block(rig: &Rig, command: &str) -> (Vec<u8>, usize) {
    let command = rig.encode(command);
    let count = PAYLOAD_MAX / command.len();
    (command.repeat(count), count)
}

/// Decoding and dispatch, commands a second.
fn commands(c: &mut Criterion) {
    let mut group = c.benchmark_group("command");

    let mut rig = rig_of(1, -1);
    let (payload, count) = block(&rig, "debug_nop");
    group.throughput(Throughput::Elements(count as u64));
    group.bench_function("debug_nop, a block full", |b| b.iter(|| rig.execute(black_box(&payload))));

    let (payload, count) = block(&rig, "queue_step oid=0 interval=20000 count=1 add=3");
    let blocks = usize::from(MOVE_COUNT) / count;
    group.throughput(Throughput::Elements((blocks * count) as u64));
    // Another benchmark measures the steps that empty the queue again.
    group.bench_function("queue_step, a queue full", |b| {
        b.iter_custom(|iterations| {
            let mut spent = Duration::ZERO;
            for _ in 0..iterations {
                let now = rig.now();
                rig.send(&format!("reset_step_clock oid=0 clock=@{now}"));
                let begin = Instant::now();
                for _ in 0..blocks {
                    rig.execute(black_box(&payload));
                }
                spent += begin.elapsed();
                rig.run_until(now + 20_000 * (blocks * count) as u64);
                rig.forget_responses();
            }
            spent
        });
    });
    group.finish();
    assert!(!rig.mcu.is_shutdown());
}

/// An edge of a step pin, between the clock's reading and the next timer.
fn steps(c: &mut Criterion) {
    let mut group = c.benchmark_group("step edge");
    group.throughput(Throughput::Elements(1));
    for (name, steppers, invert_step) in [
        ("one stepper, both edges", 1, -1),
        ("one stepper, pulses", 1, 0),
        ("three steppers, both edges", 3, -1),
        ("eight steppers, both edges", 8, -1),
    ] {
        let mut rig = rig_of(steppers, invert_step);
        group.bench_function(name, |b| {
            b.iter_custom(|iterations| {
                let mut spent = Duration::ZERO;
                let mut left = iterations.div_ceil(u64::from(steppers)) as u32;
                while left > 0 {
                    let count = left.min(30_000);
                    let now = rig.now();
                    for oid in 0..steppers {
                        let interval = 1000 + u32::from(oid);
                        rig.send(&format!("reset_step_clock oid={oid} clock=@{now}"));
                        rig.send(&format!("queue_step oid={oid} interval={interval} count={count} add=0"));
                    }
                    let begin = Instant::now();
                    for _ in 0..count * u32::from(steppers) {
                        rig.mcu.run_timers();
                        if let Some(next) = rig.mcu.next_timer() {
                            rig.jump(next);
                        }
                    }
                    spent += begin.elapsed();
                    rig.run_until(now + 100_000_000);
                    rig.forget_responses();
                    left -= count;
                }
                spent
            });
        });
        assert!(!rig.mcu.is_shutdown());
    }
    group.finish();
}

/// The core's cost of reporting its status: a whole snapshot, and the share of their time that steps lose by a hundred
/// snapshots a second. The two are measured in turns, so that their ratio also holds on a busy computer.
fn status(c: &mut Criterion) {
    let mut rig = rig_of(8, -1);
    let mut snapshot = Snapshot::default();
    c.bench_function("status, eight steppers", |b| {
        b.iter(|| {
            snapshot.clear();
            while !rig.mcu.fill(black_box(&mut snapshot)) {}
        })
    });
    const ROUNDS: u32 = 200;
    let mut spent = [Vec::new(), Vec::new()];
    for round in 0..2 * ROUNDS {
        let asked = round % 2 == 1;
        let now = rig.now();
        for oid in 0..8 {
            rig.send(&format!("reset_step_clock oid={oid} clock=@{now}"));
            // 50,000 steps a second, for 20 ms.
            rig.send(&format!("queue_step oid={oid} interval={} count=1000 add=0", 1000 + oid));
        }
        let begin = Instant::now();
        for edge in 0..8000 {
            if asked && edge % 4000 == 0 {
                snapshot.clear();
                while !rig.mcu.fill(black_box(&mut snapshot)) {}
            }
            rig.mcu.run_timers();
            if let Some(next) = rig.mcu.next_timer() {
                rig.jump(next);
            }
        }
        spent[usize::from(asked)].push(begin.elapsed());
        rig.run_until(now + 100_000_000);
        rig.forget_responses();
    }
    let [without, with] = spent.map(|mut rounds| {
        rounds.sort();
        rounds[rounds.len() / 2].as_nanos() as f64 / 8000.0
    });
    println!(
        "a step edge: {without:.1} ns; with a status 100 times a second: {with:.1} ns, {:.3} times as long",
        with / without
    );
    assert!(!rig.mcu.is_shutdown());
}

/// The numbering of all messages, and their publication as compressed JSON.
fn dictionary(c: &mut Criterion) {
    let board = FakeBoard(Rig::new().bench);
    c.bench_function("dictionary", |b| {
        b.iter(|| Dialect::new(&FIRMWARE, black_box(&board), DialectName::Master).unwrap())
    });
}

criterion_group!(benches, commands, steps, status, dictionary);
criterion_main!(benches);
