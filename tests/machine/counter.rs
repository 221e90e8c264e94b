// SPDX-License-Identifier: GPL-3.0-or-later
//! Counters of edges, by polling.

use crate::rig::Rig;

const TACHO: u32 = 30;
const COUNTER: &str = "config_counter oid=0 pin=30 pull_up=1";
const QUERY: &str = "query_counter oid=0 clock=@10000 poll_ticks=1000 sample_ticks=20000";

#[test]
fn edges_are_counted_and_told_in_intervals() {
    let mut rig = Rig::configured(&[COUNTER]);
    // High for 2500 ticks, low for 2500.
    let edges: Vec<(u64, u8)> = (0..100).map(|n| (12_500 + 2500 * n, (n % 2 == 0).into())).collect();
    rig.bench.script_input(TACHO, &edges);
    rig.send(QUERY);
    rig.run_until(10_999);
    assert_eq!(rig.responses(), [""; 0]);
    rig.run_until(60_000);
    assert_eq!(
        rig.responses(),
        [
            // The first after the second look, as in the firmware.
            "counter_state oid=0 next_clock=@12000 count=0 count_clock=@10000",
            // Edges at 12500, 15000, ..., 30000: eight.
            "counter_state oid=0 next_clock=@33000 count=8 count_clock=@30000",
            "counter_state oid=0 next_clock=@54000 count=17 count_clock=@53000",
        ]
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
    rig.run_until(25_000);
    assert_eq!(rig.responses(), ["counter_state oid=0 next_clock=@21000 count=1 count_clock=@13000"]);
    rig.send("emergency_stop");
    rig.responses();
    rig.run_until(1_000_000);
    assert_eq!(rig.responses(), [""; 0]);
}

#[test]
fn a_line_that_is_gone_stops_the_machine() {
    let mut rig = Rig::configured(&[COUNTER]);
    rig.bench.state().broken.insert(TACHO);
    rig.send(QUERY);
    rig.run_until(20_000);
    assert_eq!(rig.shutdown().as_deref(), Some("GPIO line read failed"));
}

#[test]
fn an_expander_s_pin_is_looked_at_as_often_as_its_worker_can() {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.insert(TACHO);
    rig.bench.state().answer_ticks = 1500;
    rig.configure(&[COUNTER]);
    rig.bench.script_input(TACHO, &[(14_000, 1)]);
    rig.send(QUERY);
    // Looks begin at 10000, 12000, 14000, ...
    rig.run_until(40_000);
    assert_eq!(
        rig.responses(),
        [
            "counter_state oid=0 next_clock=@13000 count=0 count_clock=@10000",
            "counter_state oid=0 next_clock=@35000 count=1 count_clock=@14000",
        ]
    );
    rig.bench.state().broken.insert(TACHO);
    rig.run_until(50_000);
    assert_eq!(rig.shutdown().as_deref(), Some("GPIO line read failed"));
}

#[test]
fn polling_without_rest_stops_the_machine_once_it_is_behind() {
    let mut rig = Rig::configured(&[COUNTER]);
    rig.send("query_counter oid=0 clock=@1000 poll_ticks=0 sample_ticks=1000");
    rig.run_until(2000);
    rig.stall_until(6_000_000);
    rig.run_turns(200);
    assert_eq!(rig.shutdown().as_deref(), Some("Rescheduled timer in the past"));
}
