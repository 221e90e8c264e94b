// SPDX-License-Identifier: GPL-3.0-or-later
//! Buttons: debounced, reported until they are acknowledged, also on expanders.

use pinion_firmware::board::{Bias, Direction};

use pinion_testbench::rig::Rig;

const A: u32 = 30;
const B: u32 = 31;

/// klippy adds the pins and starts the query only after `finalize_config`.
fn start(rig: &mut Rig, retransmit_count: u8, invert: u8) {
    rig.send_all(&["buttons_add oid=0 pos=0 pin=30 pull_up=1", "buttons_add oid=0 pos=1 pin=31 pull_up=0"]);
    rig.send(&format!(
        "buttons_query oid=0 clock=@1000 rest_ticks=1000 retransmit_count={retransmit_count} invert={invert}"
    ));
}

fn buttons() -> Rig {
    let mut rig = Rig::configured(&["config_buttons oid=0 button_count=2"]);
    start(&mut rig, 50, 0);
    rig
}

#[test]
fn a_level_counts_once_two_samples_in_a_row_have_it() {
    let mut rig = buttons();
    // One sample is high, at 3000. From 6000 on all samples are high.
    rig.bench.script_input(A, &[(2500, 1), (3500, 0), (5500, 1)]);
    rig.sends_until(6999, &[]);
    rig.sends_until(7000, &["buttons_state oid=0 ack_count=0 state=01"]);
    rig.send("buttons_ack oid=0 count=1");
    rig.sends_until(1_000_000, &[]);
}

#[test]
fn a_button_that_bounces_does_not_hold_up_another() {
    let mut rig = buttons();
    rig.bench.script_input(A, &[(1500, 1), (2500, 0), (3500, 1), (4500, 0)]);
    rig.bench.script_input(B, &[(2500, 1)]);
    rig.sends_until(10_000, &["buttons_state oid=0 ack_count=0 state=02"]);
}

#[test]
fn a_button_that_rests_high_is_not_pressed_from_the_start() {
    let mut rig = Rig::configured(&["config_buttons oid=0 button_count=2"]);
    rig.bench.script_input(A, &[(0, 1), (5500, 0)]);
    start(&mut rig, 50, 1);
    rig.sends_until(6999, &[]);
    rig.sends_until(7000, &["buttons_state oid=0 ack_count=0 state=00"]);
}

#[test]
fn presses_that_are_not_acknowledged_are_sent_again() {
    for count in [0_u8, 3] {
        let mut rig = Rig::configured(&["config_buttons oid=0 button_count=2"]);
        rig.bench.script_input(A, &[(500, 1)]);
        start(&mut rig, count, 0);
        // The samples at 1000 and 2000 are high. The report is repeated `count` + 1 samples later.
        let again = 2000 + 1000 * (u64::from(count) + 1);
        rig.sends_until(again - 1, &["buttons_state oid=0 ack_count=0 state=01"]);
        rig.sends_until(again, &["buttons_state oid=0 ack_count=0 state=01"]);
        rig.send("buttons_ack oid=0 count=1");
        rig.sends_until(100_000, &[]);
    }
}

#[test]
fn reports_pile_up_in_order_and_leave_as_they_are_acknowledged() {
    let mut rig = buttons();
    rig.bench.script_input(A, &[(1500, 1), (5500, 0)]);
    rig.bench.script_input(B, &[(9500, 1)]);
    rig.run_until(20_000);
    let reports: Vec<String> =
        ["01", "0100", "010002"].iter().map(|s| format!("buttons_state oid=0 ack_count=0 state={s}")).collect();
    assert_eq!(rig.responses(), reports);
    rig.send("buttons_ack oid=0 count=1");
    // The last report was at 11000. The rest comes 51 samples later.
    rig.sends_until(11_000 + 51_000 - 1, &[]);
    rig.sends_until(11_000 + 51_000, &["buttons_state oid=0 ack_count=1 state=0002"]);
    // This acknowledges more than there are. The MCU keeps klippy's count.
    rig.send("buttons_ack oid=0 count=255");
    rig.bench.script_input(B, &[(70_500, 0)]);
    rig.sends_until(80_000, &["buttons_state oid=0 ack_count=0 state=00"]);
}

#[test]
fn the_ninth_change_is_dropped_and_the_next_report_has_the_state() {
    let mut rig = buttons();
    let edges: Vec<(u64, u8)> = (0..9).map(|n| (1500 + 2000 * n, (n % 2 == 0).into())).collect();
    rig.bench.script_input(A, &edges);
    rig.run_until(30_000);
    let reports = rig.responses();
    assert_eq!(reports.len(), 8);
    assert_eq!(reports[7], "buttons_state oid=0 ack_count=0 state=0100010001000100");
    rig.send("buttons_ack oid=0 count=8");
    rig.bench.script_input(B, &[(31_500, 1)]);
    rig.run_until(40_000);
    assert_eq!(rig.responses(), ["buttons_state oid=0 ack_count=8 state=03"], "A is pressed as well");
}

#[test]
fn a_query_begins_anew_and_one_without_rest_ends() {
    let mut rig = buttons();
    rig.bench.script_input(A, &[(500, 1)]);
    rig.run_until(5000);
    rig.send("buttons_ack oid=0 count=1");
    rig.responses();
    // A restarted klippy sends this while the MCU stays configured.
    rig.send_all(&["buttons_add oid=0 pos=0 pin=30 pull_up=1", "buttons_add oid=0 pos=1 pin=31 pull_up=0"]);
    rig.send("buttons_query oid=0 clock=@6000 rest_ticks=1000 retransmit_count=5 invert=0");
    rig.sends_until(7000, &["buttons_state oid=0 ack_count=0 state=01"]);
    rig.send("buttons_query oid=0 clock=@0 rest_ticks=0 retransmit_count=5 invert=0");
    rig.sends_until(100_000, &[]);
}

#[test]
fn what_can_not_be_configured() {
    let refusal = |commands: &[&str]| {
        let mut rig = Rig::new();
        rig.send("allocate_oids count=1");
        rig.send_all(commands);
        rig.shutdown().unwrap_or_default()
    };
    assert_eq!(refusal(&["config_buttons oid=0 button_count=9"]), "Max of 8 buttons");
    let two = "config_buttons oid=0 button_count=2";
    assert_eq!(refusal(&[two, "buttons_add oid=0 pos=2 pin=30 pull_up=0"]), "Set button past maximum button count");
    let query = "buttons_query oid=0 clock=@1000 rest_ticks=1000 retransmit_count=128 invert=0";
    assert_eq!(refusal(&[two, query]), "Invalid buttons retransmit count");
    assert_eq!(refusal(&[two, "buttons_add oid=0 pos=0 pin=999 pull_up=0"]), "Not an input pin");
    assert_eq!(refusal(&["buttons_ack oid=0 count=1"]), "Invalid oid type");
}

#[test]
fn resistors_reach_the_board_after_finalize_config() {
    let rig = buttons();
    assert_eq!(rig.bench.state().directions[&A], Direction::Input(Bias::PullUp));
    assert_eq!(rig.bench.state().directions[&B], Direction::Input(Bias::None));
}

#[test]
fn a_line_that_is_gone_stops_the_mcu_and_a_stopped_mcu_samples_no_more() {
    let mut rig = buttons();
    rig.bench.state().broken.insert(B);
    rig.stops_by(10_000, "GPIO line read failed");
    rig.bench.state().broken.clear();
    rig.bench.script_input(A, &[(11_000, 1)]);
    rig.sends_until(100_000, &[]);
    // It works after a new configuration.
    rig.send("config_reset");
    rig.configure(&["config_buttons oid=0 button_count=2"]);
    rig.send("buttons_add oid=0 pos=0 pin=30 pull_up=0");
    rig.send("buttons_query oid=0 clock=@101000 rest_ticks=1000 retransmit_count=5 invert=0");
    rig.sends_until(103_000, &["buttons_state oid=0 ack_count=0 state=01"]);
}

/// Button B is on an expander that needs 1500 ticks for a read.
fn with_expander() -> Rig {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.insert(B);
    rig.bench.state().answer_ticks = 1500;
    rig.configure(&["config_buttons oid=0 button_count=2"]);
    start(&mut rig, 50, 0);
    rig
}

#[test]
fn an_expander_s_button_is_sampled_as_often_as_its_worker_looks() {
    let mut rig = with_expander();
    rig.bench.script_input(A, &[(2500, 1)]);
    rig.bench.script_input(B, &[(4000, 1)]);
    // The samples at 1000, 3000, 5000 and 7000 are each complete 1500 later.
    rig.sends_until(6499, &[]);
    rig.sends_until(6500, &["buttons_state oid=0 ack_count=0 state=03"]);
    rig.send("buttons_ack oid=0 count=1");
    rig.sends_until(100_000, &[]);
}

#[test]
fn a_look_under_way_is_not_taken_for_one_of_a_later_query_or_line() {
    let mut rig = with_expander();
    rig.bench.script_input(B, &[(0, 1)]);
    rig.run_until(3000);
    // One sample is complete, and the second is on its way.
    rig.send_all(&[
        "buttons_add oid=0 pos=1 pin=30 pull_up=0",
        "buttons_query oid=0 clock=@3500 rest_ticks=1000 retransmit_count=50 invert=0",
    ]);
    rig.sends_until(100_000, &[]);
    rig.bench.script_input(A, &[(101_000, 1)]);
    rig.run_until(110_000);
    assert_eq!(rig.responses(), ["buttons_state oid=0 ack_count=0 state=03"], "both places are pin 30 now");
}

/// Ticks of 100 ms.
const UNREAD_LIMIT: u64 = 5_000_000;

#[test]
fn an_expander_that_fails_for_100_ms_stops_the_mcu() {
    let mut rig = with_expander();
    rig.bench.state().broken.insert(B);
    rig.bench.script_input(A, &[(8500, 1)]);
    rig.run_until(20_000);
    assert_eq!(rig.responses(), ["buttons_state oid=0 ack_count=0 state=01"], "others go on");
    rig.send("buttons_ack oid=0 count=1");
    // The first sample that fails is at 1000. Each sample is complete 1500 later.
    rig.sends_until(1000 + UNREAD_LIMIT - 1, &[]);
    rig.stops_by(1000 + UNREAD_LIMIT + 2000, "GPIO line read failed");
}

#[test]
fn a_look_that_fails_is_no_sample_and_changes_nothing() {
    let mut rig = with_expander();
    rig.bench.script_input(B, &[(2600, 1), (6000, 0)]);
    // Samples at 1000, 3000, 5000, 7000. It is high at 3000, but nothing confirms it because the read at 5000 fails.
    rig.run_until(5000);
    rig.bench.state().nacks.insert(B, 3);
    rig.sends_until(100_000, &[]);
    // It is high from then on. A read with failed tries is reported like one without.
    rig.bench.script_input(B, &[(100_600, 1)]);
    rig.run_until(102_000);
    rig.bench.state().nacks.insert(B, 2);
    rig.sends_until(104_500, &["buttons_state oid=0 ack_count=0 state=02"]);
}

#[test]
fn an_expander_that_hangs_for_100_ms_stops_the_mcu() {
    let mut rig = with_expander();
    rig.run_until(4000);
    rig.bench.state().answer_ticks = 500_000_000;
    rig.run_until(5000 + UNREAD_LIMIT - 1);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(5000 + UNREAD_LIMIT, "GPIO line read failed");
    let notes = rig.notes();
    assert!(notes.iter().any(|note| note.contains("buttons oid 0: gpio31 has not answered for 100 ms: ")), "{notes:?}");
}
