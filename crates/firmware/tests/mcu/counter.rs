// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters of edges, by interrupts and by polling.

use pinion_testbench::rig::Rig;

const TACHO: u32 = 30;
const COUNTER: &str = "config_counter oid=0 pin=30 pull_up=1";
const QUERY: &str = "query_counter oid=0 clock=@10000 poll_ticks=1000 sample_ticks=20000";

#[test]
fn edges_are_counted_and_reported_in_intervals() {
    let mut rig = Rig::configured(&[COUNTER]);
    // High for 2500 ticks, then low for 2500.
    let edges: Vec<(u64, u8)> = (0..100).map(|n| (12_500 + 2500 * n, (n % 2 == 0).into())).collect();
    rig.bench.script_input(TACHO, &edges);
    rig.send(QUERY);
    rig.sends_until(10_999, &[]);
    rig.sends_until(
        60_000,
        &[
            // The first report comes after the second poll, as in Klipper's C.
            "counter_state oid=0 next_clock=@12000 count=0 count_clock=@10000",
            // Eight edges at 12500, 15000, ..., 30000.
            "counter_state oid=0 next_clock=@33000 count=8 count_clock=@30000",
            "counter_state oid=0 next_clock=@54000 count=17 count_clock=@53000",
        ],
    );
}

#[test]
fn pulses_shorter_than_the_polling_are_missed() {
    let mut rig = Rig::configured(&[COUNTER]);
    rig.bench.script_input(TACHO, &[(20_100, 1), (20_900, 0), (22_500, 1)]);
    rig.send(QUERY);
    rig.run_until(40_000);
    assert_eq!(rig.responses()[1], "counter_state oid=0 next_clock=@33000 count=1 count_clock=@23000");
}

#[test]
fn a_query_goes_on_counting_and_a_shutdown_ends_it() {
    let mut rig = Rig::configured(&[COUNTER]);
    rig.bench.script_input(TACHO, &[(12_500, 1)]);
    rig.send(QUERY);
    rig.run_until(15_000);
    rig.send("query_counter oid=0 clock=@20000 poll_ticks=500 sample_ticks=10000");
    rig.responses();
    rig.sends_until(25_000, &["counter_state oid=0 next_clock=@21000 count=1 count_clock=@13000"]);
    rig.send("emergency_stop");
    rig.responses();
    rig.sends_until(1_000_000, &[]);
}

#[test]
fn a_line_that_is_gone_stops_the_mcu() {
    let mut rig = Rig::configured(&[COUNTER]);
    rig.bench.state().broken.insert(TACHO);
    rig.send(QUERY);
    rig.stops_by(20_000, "GPIO line read failed");
}

#[test]
fn an_expander_s_pin_is_looked_at_as_often_as_its_worker_can() {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.insert(TACHO);
    rig.bench.state().answer_ticks = 1500;
    rig.configure(&[COUNTER]);
    rig.bench.script_input(TACHO, &[(14_000, 1)]);
    rig.send(QUERY);
    // Polls begin at 10000, 12000, 14000, ...
    rig.sends_until(
        40_000,
        &[
            // The times are the ends of the polls.
            "counter_state oid=0 next_clock=@12500 count=0 count_clock=@10000",
            "counter_state oid=0 next_clock=@34500 count=1 count_clock=@15500",
        ],
    );
    // While polls fail, the last level counts for 100 ms.
    rig.bench.state().broken.insert(TACHO);
    rig.run_until(40_000 + 5_000_000 - 1);
    let reported = reported(&rig);
    assert!(reported.len() > 200 && reported.iter().all(|state| *state == (1, 15_500)), "{reported:?}");
    rig.stops_by(50_000 + 5_000_000, "GPIO line read failed");
}

#[test]
fn polling_without_rest_stops_the_mcu_once_it_is_behind() {
    let mut rig = Rig::configured(&[COUNTER]);
    rig.send("query_counter oid=0 clock=@1000 poll_ticks=0 sample_ticks=1000");
    rig.run_until(2000);
    rig.stall_until(6_000_000);
    rig.run_turns(200);
    assert_eq!(rig.shutdown().as_deref(), Some("Rescheduled timer in the past"));
}

/// An MCU with a counter that has interrupts.
fn counted(answer_ticks: u32) -> Rig {
    let mut rig = Rig::new();
    rig.bench.state().counted.insert(TACHO);
    rig.bench.state().answer_ticks = answer_ticks;
    rig.configure(&[COUNTER]);
    rig
}

/// Edges every `ticks`.
fn every(ticks: u64, count: u64) -> Vec<(u64, u8)> {
    (1..=count).map(|n| (n * ticks, (n % 2 == 1).into())).collect()
}

/// The count and time of each `counter_state`.
fn reported(rig: &Rig) -> Vec<(u32, i64)> {
    let number = |text: &str, name: &str| -> i64 {
        let rest = text.split_once(&format!(" {name}=")).unwrap().1;
        rest.trim_start_matches('@').split(' ').next().unwrap().parse().unwrap()
    };
    rig.responses().iter().map(|state| (number(state, "count") as u32, number(state, "count_clock"))).collect()
}

#[test]
fn the_kernel_s_count_is_reported_with_the_instant_of_its_last_edge() {
    let mut rig = counted(0);
    rig.bench.script_input(TACHO, &[(20_100, 1), (20_900, 0), (22_500, 1)]);
    rig.send(QUERY);
    rig.sends_until(
        49_999,
        &[
            "counter_state oid=0 next_clock=@11000 count=0 count_clock=@10000",
            // Polling would have missed the first two, because they are too close.
            "counter_state oid=0 next_clock=@31000 count=3 count_clock=@22500",
        ],
    );
}

/// Computes the frequency like klippy's FrequencyCounter, for a `[fan]` with a `tachometer_pin`.
#[test]
fn a_fan_of_20_000_rpm_is_measured_to_a_part_in_a_hundred_thousand() {
    // Two pulses per turn, so four edges: 37,500 ticks between edges. Samples of 1 s, polled every 1.5 ms.
    let mut rig = counted(3000);
    rig.bench.script_input(TACHO, &every(37_500, 20_000));
    rig.send("query_counter oid=0 clock=@1000000 poll_ticks=75000 sample_ticks=50000000");
    rig.run_until(500_000_000);
    let reported = reported(&rig);
    assert_eq!(reported.len(), 10);
    for pair in reported.windows(2) {
        let [(count, at), (next, then)] = pair else { unreachable!() };
        let rpm = f64::from(next - count) / 2.0 / (then - at) as f64 * 50e6 * 60.0 / 2.0;
        assert!((rpm - 20_000.0).abs() < 0.2, "{rpm}");
    }
}

#[test]
fn a_count_is_no_older_than_its_last_edge() {
    // A worker that is 0.1 s late sees edges from after the timer.
    let mut rig = counted(5_000_000);
    rig.bench.script_input(TACHO, &every(37_500, 2000));
    rig.send("query_counter oid=0 clock=@1000000 poll_ticks=75000 sample_ticks=50000000");
    rig.run_until(10_000_000);
    let state = rig.responses().pop().unwrap();
    assert_eq!(state, "counter_state oid=0 next_clock=@6075000 count=159 count_clock=@5962500");
}

#[test]
fn a_worker_that_is_slower_than_the_interval_misses_turns() {
    let mut rig = counted(30_000);
    rig.bench.script_input(TACHO, &[(12_000, 1), (45_000, 0)]);
    rig.send(QUERY);
    // The worker polls at 10000 and 50000, but not at 30000.
    rig.run_until(85_000);
    assert_eq!(reported(&rig), [(1, 12_000), (2, 45_000)]);
}

#[test]
fn a_query_begins_anew_where_the_count_stands() {
    let mut rig = counted(0);
    rig.bench.script_input(TACHO, &[(12_500, 1), (22_000, 0)]);
    rig.send(QUERY);
    rig.run_until(15_000);
    rig.responses();
    rig.send("query_counter oid=0 clock=@20000 poll_ticks=500 sample_ticks=5000");
    rig.run_until(29_999);
    assert_eq!(reported(&rig), [(1, 12_500), (2, 22_000)]);
}

#[test]
fn a_pin_that_storms_is_polled_from_then_on() {
    let mut rig = counted(0);
    // 25,000 edges a second, for 3 s.
    rig.bench.script_input(TACHO, &every(2000, 75_000));
    rig.send("query_counter oid=0 clock=@1000000 poll_ticks=75000 sample_ticks=50000000");
    // The time before the first poll is too short to judge.
    rig.run_until(5_999_999);
    assert!(rig.bench.state().counted.contains(&TACHO));
    rig.run_until(10_000_000);
    assert!(!rig.bench.state().counted.contains(&TACHO), "the interrupts were not ended");
    rig.run_until(250_000_000);
    // No level lasted long enough to count. After that, polling counts.
    let reported = reported(&rig);
    assert_eq!(reported[0], (0, 1_000_000));
    assert!(reported.len() > 2 && reported.last().unwrap().0 > 0, "{reported:?}");
    assert!(rig.shutdown().is_none());
}

/// The polls between reports send nothing.
#[test]
fn it_is_reported_once_in_each_sample_ticks() {
    let mut rig = counted(3000);
    rig.bench.script_input(TACHO, &every(1_000_000, 1000));
    rig.send("query_counter oid=0 clock=@1200000 poll_ticks=75000 sample_ticks=50000000");
    rig.run_until(152_000_000);
    assert_eq!(reported(&rig), [(1, 1_000_000), (51, 51_000_000), (101, 101_000_000), (151, 151_000_000)]);
}

#[test]
fn glitches_are_not_counted_and_pulses_are_exactly() {
    let mut rig = counted(3000);
    // 10,000 rpm: levels of 1.5 ms, the longest poll_ticks that klippy's documentation allows for it. There is a spike
    // of 3 us before each edge and one of 300 us in each level. Edges ring for 20 us.
    let mut edges = Vec::new();
    for n in 1..=4000 {
        let (at, before, after) = (75_000 * n, ((n + 1) % 2) as u8, (n % 2) as u8);
        edges.extend([(at - 10_000, after), (at - 9_850, before)]);
        edges.extend([(at - 1_000, after), (at - 500, before), (at, after)]);
        edges.extend([(at + 30_000, before), (at + 45_000, after)]);
    }
    rig.bench.script_input(TACHO, &edges);
    rig.send("query_counter oid=0 clock=@1040000 poll_ticks=75000 sample_ticks=50000000");
    rig.run_until(300_000_000);
    let reported = reported(&rig);
    assert_eq!(reported.len(), 6);
    for (n, (count, at)) in (0..).zip(&reported) {
        // A level of 0.375 ms counts, from the end of its edge's ringing.
        let edges = (1_043_000 + n * 50_000_000 - 18_750) / 75_000;
        assert_eq!((i64::from(*count), *at), (edges, edges * 75_000), "{reported:?}");
    }
}

#[test]
fn bouncing_contacts_are_no_storm() {
    let mut rig = counted(0);
    // A burst of 200 edges in 2 ms, then quiet, with samples every 5 ms.
    rig.bench.script_input(TACHO, &every(500, 200));
    rig.send("query_counter oid=0 clock=@100000 poll_ticks=75000 sample_ticks=250000");
    rig.run_until(50_000_000);
    assert!(rig.bench.state().counted.contains(&TACHO));
    assert_eq!(reported(&rig).pop(), Some((0, 100_000)));
}

#[test]
fn a_counted_line_that_is_gone_stops_the_mcu() {
    let mut rig = counted(0);
    rig.bench.state().broken.insert(TACHO);
    rig.send(QUERY);
    rig.stops_by(20_000, "GPIO line read failed");
    rig.sends_until(1_000_000, &[]);
}

#[test]
fn no_report_comes_of_a_query_that_a_shutdown_ended() {
    let mut rig = counted(30_000);
    rig.send(QUERY);
    rig.run_until(20_000);
    rig.send("emergency_stop");
    rig.responses();
    rig.sends_until(1_000_000, &[]);
}

#[test]
fn a_pin_with_another_use_is_polled() {
    let mut rig = Rig::new();
    rig.bench.state().counted.insert(TACHO);
    rig.configure(&["config_endstop oid=1 pin=30 pull_up=1", COUNTER]);
    rig.bench.script_input(TACHO, &[(20_100, 1), (20_900, 0), (22_500, 1)]);
    rig.send(QUERY);
    rig.run_until(40_000);
    assert_eq!(reported(&rig).pop(), Some((1, 23_000)));
}
