// SPDX-License-Identifier: GPL-3.0-or-later
//! The MCU's report about itself: levels, queues, bus counts, and why it stopped.

use pinion_firmware::board::{BusStatus, Pin};
use pinion_firmware::mcu::{BusCounts, LineUse, Present, Snapshot};

use pinion_testbench::rig::Rig;

fn snapshot(rig: &Rig) -> Snapshot {
    let mut snapshot = Snapshot::default();
    while !rig.mcu.fill(&mut snapshot) {}
    snapshot
}

fn level(rig: &Rig, pin: u32) -> (LineUse, Option<bool>) {
    let line = snapshot(rig).lines.into_iter().find(|line| line.pin == Pin(pin)).unwrap();
    (line.use_, line.level)
}

#[test]
fn levels_are_those_of_the_last_write_or_look() {
    for answer_ticks in [0, 4000] {
        let mut rig = Rig::new();
        rig.bench.state().answer_ticks = answer_ticks;
        rig.bench.state().sleeping.insert(200);
        rig.configure(&[
            "config_digital_out oid=0 pin=7 value=1 default_value=0 max_duration=0",
            "config_endstop oid=1 pin=6 pull_up=1",
            "set_digital_out pin=9 value=1",
            // A line of a chip that may sleep.
            "config_digital_out oid=2 pin=200 value=0 default_value=0 max_duration=0",
        ]);
        assert_eq!(level(&rig, 7), (LineUse::Output, Some(true)));
        assert_eq!(level(&rig, 9), (LineUse::Output, Some(true)));
        assert_eq!(level(&rig, 6), (LineUse::Input, None), "nobody has looked");
        rig.send("update_digital_out oid=0 value=0");
        rig.send("update_digital_out oid=2 value=1");
        assert_eq!((level(&rig, 7).1, level(&rig, 200).1), (Some(false), Some(true)));
        for is_high in [true, false] {
            rig.bench.script_input(6, &[(0, u8::from(is_high))]);
            rig.ask("endstop_query_state oid=1");
            assert_eq!(level(&rig, 6).1, Some(is_high));
        }
        rig.send("emergency_stop");
        let stopped = snapshot(&rig);
        assert!(stopped.stopped.is_some() && stopped.detail.starts_with("the host asked for it"));
        rig.run_until(rig.now() + u64::from(answer_ticks));
        assert_eq!(level(&rig, 200).1, Some(false), "the shutdown value, once it is written");
        rig.send("config_reset");
        let anew = snapshot(&rig);
        assert!(anew.stopped.is_none() && anew.detail.is_empty() && anew.lines.is_empty() && anew.objects.is_empty());
    }
}

#[test]
fn why_it_stopped_comes_with_what_helps() {
    let mut rig = Rig::new();
    rig.send("emergency_stop");
    // A FIRMWARE_RESTART begins this way.
    let detail = snapshot(&rig).detail.to_string();
    assert!(
        detail.starts_with("the host asked for it (FIRMWARE_RESTART, M112 or an error): see klippy.log"),
        "{detail}"
    );
    let mut rig = Rig::configured(&["config_counter oid=0 pin=5 pull_up=0"]);
    rig.send("query_counter oid=0 clock=@1000 poll_ticks=0 sample_ticks=1000");
    rig.run_until(2000);
    rig.stall_until(6_000_000);
    rig.run_turns(200);
    let detail = snapshot(&rig).detail.to_string();
    assert!(detail.starts_with("events are ") && detail.contains("real time (-r, as the service does)"), "{detail}");
}

#[test]
fn a_snapshot_begins_anew_where_objects_come_meanwhile() {
    let mut rig = Rig::new();
    rig.send("allocate_oids count=20");
    rig.send("config_endstop oid=0 pin=6 pull_up=1");
    let mut snapshot = Snapshot::default();
    assert!(!rig.mcu.fill(&mut snapshot), "the head");
    for oid in 1..18 {
        rig.send(&format!("config_endstop oid={oid} pin={} pull_up=1", 10 + oid));
        rig.mcu.fill(&mut snapshot);
    }
    while !rig.mcu.fill(&mut snapshot) {}
    assert_eq!((snapshot.lines.len(), snapshot.objects.len()), (18, 18));
    assert!(!snapshot.is_configured && snapshot.oids_allocated);
    let oids: Vec<_> = snapshot.objects.iter().filter_map(|object| object.oid).collect();
    assert_eq!(oids, (0..18).collect::<Vec<u8>>());
}

#[test]
fn what_fails_on_a_bus_is_counted_and_what_is_tried_again() {
    let mut rig = Rig::new();
    let mut fails = 2;
    rig.bench.plug_i2c(0, 64, move |_, _, read| {
        if !read.is_empty() && fails > 0 {
            fails -= 1;
            return Err(BusStatus::Nack);
        }
        read.fill(7);
        Ok(())
    });
    rig.configure(&["config_i2c oid=0", "i2c_set_bus oid=0 i2c_bus=0 rate=400000 address=64"]);
    let counts = |rig: &Rig| snapshot(rig).objects[0].bus.unwrap();
    assert_eq!(counts(&rig), BusCounts::default());
    rig.ask("i2c_transfer oid=0 write= read_len=2");
    let BusCounts { transfers, errors, retries } = counts(&rig);
    assert_eq!(transfers - errors, 1, "it came through at last");
    assert_eq!((errors, retries), (2, 2));
}

#[test]
fn calls_to_lines_of_expanders_to_adcs_and_to_pwm_channels_are_counted() {
    let mut rig = Rig::new();
    rig.bench.state().sleeping.extend([200, 201]);
    rig.configure(&[
        "config_digital_out oid=0 pin=200 value=0 default_value=0 max_duration=0",
        "config_endstop oid=1 pin=201 pull_up=0",
        "config_endstop oid=2 pin=6 pull_up=0",
        "config_analog_in oid=3 pin=400",
        "config_pwm_out oid=4 pin=500 cycle_ticks=50000 value=100 default_value=0 max_duration=0",
    ]);
    rig.bench.state().nacks.extend([(200, 1), (201, 4), (400, 2), (500, 1)]);
    rig.send("update_digital_out oid=0 value=1");
    rig.ask("endstop_query_state oid=1");
    rig.ask("endstop_query_state oid=2");
    rig.send("query_analog_in oid=3 clock=@1000 sample_ticks=1 sample_count=1 rest_ticks=1000000 bytes_per_report=1 min_value=0 max_value=65535 range_check_count=0");
    rig.send("queue_pwm_out oid=4 clock=@2000 value=300");
    rig.run_until(10_000);
    assert_eq!(rig.shutdown(), None);
    let filled = snapshot(&rig);
    let counts = |transfers, errors, retries| Some(BusCounts { transfers, errors, retries });
    let line = |pin| filled.lines.iter().find(|line| line.pin == Pin(pin)).unwrap().bus;
    assert_eq!(line(200), counts(2, 1, 1));
    // There are two reads. Three tries fail in the first, and one in the second.
    assert_eq!(line(201), counts(5, 4, 3));
    assert_eq!(line(6), None, "the core reads it");
    assert_eq!((filled.objects[3].bus, filled.objects[4].bus), (counts(3, 2, 2), counts(2, 1, 1)));
}

#[test]
fn values_and_queues_are_reported() {
    let mut rig = Rig::configured(&[
        "config_pwm_out oid=0 pin=500 cycle_ticks=50000 value=100 default_value=0 max_duration=0",
        "config_stepper oid=1 step_pin=0 dir_pin=1 invert_step=-1 step_pulse_ticks=0",
    ]);
    rig.send("queue_pwm_out oid=0 clock=@20000 value=300");
    rig.send("queue_pwm_out oid=0 clock=@900000 value=400");
    rig.send("reset_step_clock oid=1 clock=@0");
    rig.send("queue_step oid=1 interval=20000 count=5 add=0");
    rig.send("queue_step oid=1 interval=20000 count=5 add=0");
    rig.run_until(50_000);
    let filled = snapshot(&rig);
    assert_eq!(filled.objects[0].report.value, Some(Present::Pwm(300)));
    assert_eq!(filled.objects[0].report.queued, 1);
    let position = rig.ask("stepper_get_position oid=1");
    assert!(position.ends_with(" pos=-2"), "{position}");
    assert_eq!(filled.objects[1].report.value, Some(Present::Steps(-2)));
    assert_eq!(filled.objects[1].report.queued, 1);
    assert_eq!(filled.moves.0, 2);
    assert!(filled.lateness.samples() > 0);
}
