// SPDX-License-Identifier: GPL-3.0-or-later
//! Behavior of every MCU: identify, clock, configuration, shutdown, bad input.

use pinion_firmware::board::{Pin, Range};
use pinion_firmware::mcu::MOVE_COUNT;
use pinion_firmware::time::Ticks;
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_protocol::dictionary::Dictionary;

use pinion_testbench::rig::{Rig, hex};

const STEPPER: &str = "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100";

fn expect_shutdown(rig: &Rig, text: &str) {
    assert_eq!(rig.shutdown().as_deref(), Some(text));
}

// ---- identify, clock, statistics

#[test]
fn the_pieces_of_identify_are_the_dictionary() {
    let mut rig = Rig::new();
    for count in [1, 40, 52, 255] {
        let mut compressed = String::new();
        let total = loop {
            let offset = compressed.len() / 2;
            let answer = rig.ask(&format!("identify offset={offset} count={count}"));
            let data = answer.strip_prefix(&format!("identify_response offset={offset} data=")).unwrap();
            if data.is_empty() {
                break offset;
            }
            assert!(data.len() / 2 <= count);
            compressed += data;
        };
        assert_eq!(compressed, hex(rig.dialect().compressed()));
        assert_eq!(
            rig.ask(&format!("identify offset={} count=40", total + 1)),
            format!("identify_response offset={} data=", total + 1)
        );
        assert_eq!(rig.ask("identify offset=4294967295 count=40"), "identify_response offset=4294967295 data=");
    }
    let dictionary = Dictionary::decompress(rig.dialect().compressed()).unwrap();
    for (constant, value) in [
        ("CLOCK_FREQ", 50_000_000),
        ("ADC_MAX", 4095),
        ("PWM_MAX", 32_768),
        ("STATS_SUMSQ_BASE", 256),
        ("STEPPER_STEP_BOTH_EDGE", 1),
    ] {
        assert_eq!(dictionary.config[constant], value, "{constant}");
    }
    assert_eq!(dictionary.config["MCU"], "linux");
    assert!(dictionary.config["RECEIVE_WINDOW"].as_u64().unwrap() >= 64);
    assert_eq!(dictionary.enumerations["pin"]["gpio0"][1], 300);
    assert_eq!(dictionary.commands["identify offset=%u count=%c"], 1);
    assert_eq!(dictionary.responses["identify_response offset=%u data=%.*s"], 0);
}

#[test]
fn the_clock_and_the_uptime_go_on_past_32_bits() {
    for turns in [0u64, 1, 5] {
        let mut rig = Rig::at((turns << 32) + u64::from(u32::MAX) - 9);
        assert_eq!(rig.ask("get_uptime"), format!("uptime high={turns} clock=@0"));
        rig.run_until(9);
        assert_eq!(rig.ask("get_uptime"), format!("uptime high={turns} clock=@9"));
        assert_eq!(rig.ask("get_clock"), "clock clock=@9");
        rig.run_until(10);
        assert_eq!(rig.ask("get_uptime"), format!("uptime high={} clock=@10", turns + 1));
        assert_eq!(rig.ask("get_clock"), "clock clock=@10");
    }
}

#[test]
fn statistics_come_every_five_seconds_shut_down_or_not() {
    let mut rig = Rig::new();
    rig.run_until(249_999_999);
    assert_eq!(rig.everything(), [""; 0]);
    rig.mcu.account(pinion_firmware::time::Ticks(1000));
    rig.mcu.account(pinion_firmware::time::Ticks(24));
    rig.run_until(250_000_000);
    assert_eq!(rig.everything(), ["stats count=2 sum=1024 sumsq=3910"]);
    rig.send("emergency_stop");
    rig.everything();
    rig.run_until(750_000_000);
    assert_eq!(rig.everything(), ["stats count=1 sum=0 sumsq=0"; 2], "klippy divides by the count");
}

#[test]
fn pings_are_answered() {
    let mut rig = Rig::new();
    let data = "5a".repeat(57);
    assert_eq!(rig.ask(&format!("debug_ping data={data}")), format!("pong data={data}"));
    assert_eq!(rig.ask("debug_ping data="), "pong data=");
    assert_eq!(rig.ask("debug_nop"), "");
}

// ---- configuration

#[test]
fn the_configuration_is_reported() {
    let mut rig = Rig::new();
    assert_eq!(rig.ask("get_config"), "config is_config=0 crc=0 is_shutdown=0 move_count=0");
    rig.configure(&[STEPPER, "config_trsync oid=3"]);
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024");
    assert_eq!(rig.notes(), [r#"configured: [("stepper", 1), ("trsync", 1)]"#]);
    rig.send("emergency_stop");
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=1 move_count=1024");
}

#[test]
fn a_crc_of_all_ones_comes_back() {
    let mut rig = Rig::new();
    rig.send_all(&["allocate_oids count=0", "finalize_config crc=4294967295"]);
    assert!(rig.ask("get_config").contains("crc=4294967295"));
}

#[test]
fn what_is_configured_twice_or_wrongly_stops_the_mcu() {
    for (commands, text) in [
        (&["allocate_oids count=1", "allocate_oids count=1"][..], "oids already allocated"),
        (&["allocate_oids count=0", "allocate_oids count=1"], "oids already allocated"),
        (&["finalize_config crc=1", "finalize_config crc=1"], "Already finalized"),
        (&["config_trsync oid=0"], "Can't assign oid"),
        (&["allocate_oids count=1", "config_trsync oid=1"], "Can't assign oid"),
        (&["allocate_oids count=1", "config_trsync oid=0", "config_trsync oid=0"], "Can't assign oid"),
        (&["allocate_oids count=1", "finalize_config crc=1", "config_trsync oid=0"], "Can't assign oid"),
        (&["trsync_set_timeout oid=0 clock=@0"], "Invalid oid type"),
        (&["allocate_oids count=2", "config_trsync oid=0", "stepper_get_position oid=0"], "Invalid oid type"),
        (&["allocate_oids count=2", "config_trsync oid=0", "stepper_get_position oid=1"], "Invalid oid type"),
        (&["allocate_oids count=2", "stepper_get_position oid=255"], "Invalid oid type"),
        (&["allocate_oids count=1", STEPPER, "queue_step oid=0 interval=1 count=1 add=0"], "Move queue overflow"),
    ] {
        let mut rig = Rig::new();
        rig.send_all(&commands[..commands.len() - 1]);
        assert_eq!(rig.shutdown(), None, "{commands:?}");
        rig.send(commands.last().unwrap());
        assert_eq!(rig.shutdown().as_deref(), Some(text), "{commands:?}");
    }
}

#[test]
fn a_configuration_that_is_refused_may_be_sent_anew() {
    let mut rig = Rig::new();
    rig.send_all(&["allocate_oids count=5", STEPPER, "config_endstop oid=1 pin=400 pull_up=0"]);
    expect_shutdown(&rig, "Not an input pin");
    rig.send("config_reset");
    rig.configure(&[STEPPER, "config_endstop oid=1 pin=3 pull_up=0"]);
}

// ---- shutdown

#[test]
fn a_stopped_mcu_says_so_to_every_command_and_answers_what_it_may() {
    let mut rig = Rig::configured(&[STEPPER]);
    rig.run_until(500);
    rig.send("emergency_stop");
    assert_eq!(rig.responses(), ["shutdown clock=@500 static_string_id=Command request"]);
    for command in [
        "queue_step oid=0 interval=1 count=1 add=0",
        "queue_step oid=99 interval=1 count=1 add=0",
        "allocate_oids count=3",
        "spi_transfer oid=0 data=0102",
        "set_digital_out pin=3 value=1",
    ] {
        assert_eq!(rig.ask(command), "is_shutdown static_string_id=Command request");
    }
    assert_eq!(rig.ask("get_clock"), "clock clock=@500");
    assert_eq!(rig.ask("debug_ping data=01"), "pong data=01");
    // Commands that may not run are skipped completely. The commands after them in the block do run.
    let block = [rig.encode("spi_transfer oid=0 data=0102"), rig.encode("get_clock")].concat();
    rig.execute(&block);
    assert_eq!(rig.responses(), ["is_shutdown static_string_id=Command request", "clock clock=@500"]);
}

#[test]
fn the_first_reason_stays() {
    let mut rig = Rig::configured(&[STEPPER]);
    rig.send("queue_step oid=0 interval=1 count=0 add=0");
    expect_shutdown(&rig, "Invalid count parameter");
    rig.send("emergency_stop");
    expect_shutdown(&rig, "Invalid count parameter");
    assert_eq!(
        rig.ask("debug_write order=0 addr=0 val=0"),
        "shutdown clock=@0 static_string_id=Invalid count parameter"
    );
    assert_eq!(rig.ask("allocate_oids count=1"), "is_shutdown static_string_id=Invalid count parameter");
}

#[test]
fn a_shutdown_drops_the_rest_of_its_block() {
    let mut rig = Rig::new();
    let block = [rig.encode("emergency_stop"), rig.encode("get_clock")].concat();
    rig.execute(&block);
    assert_eq!(rig.responses(), ["shutdown clock=@0 static_string_id=Command request"]);
}

#[test]
fn a_cleared_shutdown_lets_the_mcu_go_on() {
    let mut rig = Rig::configured(&[STEPPER]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=1000 count=9 add=0"]);
    rig.run_until(3500);
    rig.send_all(&["emergency_stop", "clear_shutdown"]);
    expect_shutdown(&rig, "Command request");
    assert_eq!(rig.ask("stepper_get_position oid=0"), "stepper_position oid=0 pos=-3");
    rig.run_until(10_000);
    rig.edges(1);
    rig.send_all(&["reset_step_clock oid=0 clock=@10000", "queue_step oid=0 interval=1000 count=1 add=0"]);
    rig.run_until(20_000);
    assert_eq!(rig.edges(1), [(11_000, 1), (11_100, 0)]);
    rig.send("clear_shutdown");
    expect_shutdown(&rig, "Shutdown cleared when not shutdown");
}

#[test]
fn a_running_mcu_does_not_forget_its_configuration() {
    let mut rig = Rig::configured(&[STEPPER]);
    rig.send("config_reset");
    expect_shutdown(&rig, "config_reset only available when shutdown");
    assert!(rig.ask("get_config").starts_with("config is_config=1 crc=7 is_shutdown=1"));
}

#[test]
fn after_config_reset_everything_is_free() {
    let mut rig = Rig::new();
    rig.bench.state().answer_ticks = 1000;
    let all = [
        STEPPER,
        "config_endstop oid=1 pin=3 pull_up=0",
        "config_trsync oid=2",
        "config_digital_out oid=3 pin=4 value=0 default_value=0 max_duration=0",
        "config_analog_in oid=4 pin=400",
        "config_spi oid=5 pin=5 cs_active_high=0",
        "spi_set_bus oid=5 spi_bus=0 mode=0 rate=1000000",
        "config_spi_shutdown oid=6 spi_oid=5 shutdown_msg=01",
        "set_digital_out pin=6 value=1",
    ];
    for round in 0..3 {
        rig.configure(&all);
        let now = rig.now();
        rig.send_all(&[
            &format!("query_analog_in oid=4 clock=@{} sample_ticks=0 sample_count=1 rest_ticks=100 bytes_per_report=1 min_value=0 max_value=65535 range_check_count=1", now + 100),
            &format!("reset_step_clock oid=0 clock=@{now}"),
            "queue_step oid=0 interval=1000 count=65535 add=0",
            "spi_transfer oid=5 data=00",
        ]);
        // During a step, a reading and a transfer.
        rig.run_until(now + 1050);
        assert_eq!(rig.ask("stepper_get_position oid=0"), "stepper_position oid=0 pos=-1", "round {round}");
        rig.send_all(&["emergency_stop", "config_reset"]);
        rig.responses();
        assert!(rig.bench.state().directions.is_empty());
        assert_eq!(rig.ask("get_config"), "config is_config=0 crc=0 is_shutdown=0 move_count=0");
        assert_eq!(rig.notes().last().unwrap(), "reset");
        rig.edges(1);
        rig.run_until(now + 100_000);
        assert_eq!((rig.responses(), rig.edges(1)), (vec![], vec![]), "round {round}");
    }
}

// ---- bad input

#[test]
fn a_host_does_not_poke_memory() {
    for command in ["debug_read order=2 addr=4096", "debug_write order=0 addr=4096 val=1"] {
        let mut rig = Rig::new();
        rig.send(command);
        expect_shutdown(&rig, "Memory access is not available on Linux");
    }
}

#[test]
fn an_unknown_command_stops_the_mcu() {
    // 1 is identify, 0 is a response. 0x9f 0x7f is far above all ids, and the last one is below all ids.
    for payload in [&[0][..], &[0x9f, 0x7f], &[0xe0, 0x00], &[0x8f, 0xff, 0xff, 0xff, 0x00]] {
        let mut rig = Rig::new();
        rig.execute(payload);
        assert_eq!(rig.shutdown().as_deref(), Some("Invalid command"), "{payload:?}");
    }
}

#[test]
fn a_command_that_ends_too_early_stops_the_mcu() {
    let rig = Rig::configured(&[STEPPER]);
    let whole = rig.encode("queue_step oid=0 interval=100000 count=1000 add=-1000");
    let transfer = rig.encode("spi_transfer oid=0 data=010203");
    for whole in [whole, transfer] {
        for len in 1..whole.len() {
            let mut rig = Rig::configured(&[STEPPER]);
            rig.execute(&whole[..len]);
            assert_eq!(rig.shutdown().as_deref(), Some("Command parser error"), "{:?}", &whole[..len]);
            // A stopped MCU neither hangs nor runs it.
            rig.execute(&whole[..len]);
            assert_eq!(rig.shutdown().as_deref(), Some("Command parser error"));
        }
    }
}

#[test]
fn integers_wrap_as_the_firmwares_do() {
    let mut rig = Rig::new();
    // oid 256 + 3 is oid 3, and a count of 65536 + 2 is 2.
    rig.send_all(&["allocate_oids count=10", "config_trsync oid=259", "finalize_config crc=1"]);
    assert!(rig.ask("trsync_trigger oid=3 reason=257").starts_with("trsync_state oid=3 can_trigger=0"));
    let mut rig = Rig::configured(&[STEPPER]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=1000 count=65538 add=65535"]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(1).iter().map(|(at, _)| *at).collect::<Vec<_>>(), [1000, 1100, 1999, 2099]);
}

#[test]
fn the_move_queue_takes_what_it_promises_and_no_more() {
    let mut rig = Rig::configured(&[STEPPER, "config_digital_out oid=1 pin=5 value=0 default_value=0 max_duration=0"]);
    rig.send("reset_step_clock oid=0 clock=@0");
    // The first move leaves the queue at once.
    for _ in 0..MOVE_COUNT {
        rig.send("queue_step oid=0 interval=1000 count=1 add=0");
    }
    rig.send("queue_digital_out oid=1 clock=@500000 on_ticks=1");
    assert_eq!(rig.shutdown(), None);
    rig.send("queue_digital_out oid=1 clock=@600000 on_ticks=0");
    expect_shutdown(&rig, "Move queue overflow");
    // A shutdown frees all moves.
    rig.send("clear_shutdown");
    rig.run_until(1000);
    for n in 0..MOVE_COUNT {
        rig.send(&format!("queue_digital_out oid=1 clock=@{} on_ticks=1", 5000 + u32::from(n)));
    }
    assert_eq!(rig.shutdown(), None);
    // The end of a move also frees it.
    rig.run_until(1_000_000);
    for n in 0..MOVE_COUNT {
        rig.send(&format!("queue_digital_out oid=1 clock=@{} on_ticks=1", 1_005_000 + u32::from(n)));
    }
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn a_timer_in_the_past_is_too_close_only_if_it_would_be_the_next() {
    const OUTPUT: &str = "config_digital_out oid=1 pin=5 value=0 default_value=0 max_duration=0";
    let mut rig = Rig::configured(&[STEPPER, OUTPUT]);
    rig.run_until(10_000);
    rig.send("queue_digital_out oid=1 clock=@10000 on_ticks=1");
    assert_eq!(rig.shutdown(), None, "now is not too late");
    rig.run_until(10_001);
    rig.send("queue_digital_out oid=1 clock=@10000 on_ticks=0");
    expect_shutdown(&rig, "Timer too close");

    // The MCU is late with a step. As in Klipper's C, later events wait.
    let mut rig = Rig::configured(&[STEPPER, OUTPUT]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=1000 count=1 add=0"]);
    rig.stall_until(3200);
    rig.send("queue_digital_out oid=1 clock=@3000 on_ticks=1");
    assert_eq!(rig.shutdown(), None);
    rig.run_until(6000);
    assert_eq!(rig.edges(5), [(3200, 1)]);
}

#[test]
fn the_latest_of_the_late_timers_is_kept_until_it_is_forgotten() {
    let output =
        |oid: u32| format!("config_digital_out oid={oid} pin={} value=0 default_value=0 max_duration=0", oid + 1);
    let mut rig = Rig::configured(&[&output(0), &output(1), &output(2)]);
    rig.send_all(&[
        "queue_digital_out oid=0 clock=@3000 on_ticks=1",
        "queue_digital_out oid=1 clock=@1000 on_ticks=1",
        "queue_digital_out oid=2 clock=@2000 on_ticks=1",
    ]);
    rig.stall_until(5000);
    rig.run_until(6000);
    let latest = rig.mcu.latest();
    assert_eq!((latest.late, latest.oid), (Ticks(4000), Some(1)));
    rig.mcu.forget_latest();
    assert_eq!((rig.mcu.latest().late, rig.mcu.latest().oid), (Ticks(0), None));
}

#[test]
fn a_name_counts_up_within_its_range_only() {
    let range = Range { name: "gpiochip1/gpio8".into(), first: 288, count: 3 };
    let names = [287, 288, 290, 291].map(|pin| Pin(pin).name_in(std::slice::from_ref(&range)));
    assert_eq!(names, ["pin number 287", "gpiochip1/gpio8", "gpiochip1/gpio10", "pin number 291"]);
}

#[test]
fn an_mcu_that_falls_far_behind_stops_itself() {
    for (behind, ends) in [(4_990_000, false), (5_100_000, true)] {
        let mut rig = Rig::configured(&[
            "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0",
            "config_digital_out oid=1 pin=5 value=0 default_value=0 max_duration=0",
            "set_digital_out_pwm_cycle oid=1 cycle_ticks=1000",
        ]);
        rig.send("queue_digital_out oid=1 clock=@1000 on_ticks=500");
        rig.run_until(100_000);
        rig.stall_until(100_000 + behind);
        // The MCU catches up within a second, unless it is 100 ms late.
        rig.run_until(10_000_000);
        assert_eq!(rig.shutdown().is_some(), ends, "{behind} ticks behind");
    }
}

#[test]
fn every_payload_length_fits_what_the_mcu_answers() {
    assert_eq!(PAYLOAD_MAX, 59);
    let mut rig = Rig::configured(&["config_spi_without_cs oid=19"]);
    let data = "ff".repeat(56);
    assert_eq!(
        rig.ask(&format!("spi_transfer oid=19 data={data}")),
        format!("spi_transfer_response oid=19 response={data}")
    );
}

/// Claiming a pin or opening a device takes time, so it is refused after `finalize_config`.
#[test]
fn a_configured_mcu_claims_and_opens_nothing() {
    for (command, text) in [
        ("config_stepper oid=1 step_pin=30 dir_pin=31 invert_step=0 step_pulse_ticks=100", "Can't assign oid"),
        ("config_endstop oid=1 pin=30 pull_up=0", "Can't assign oid"),
        ("config_digital_out oid=1 pin=30 value=0 default_value=0 max_duration=0", "Can't assign oid"),
        ("config_analog_in oid=1 pin=400", "Can't assign oid"),
        ("config_spi oid=1 pin=30 cs_active_high=0", "Can't assign oid"),
        ("config_pwm_out oid=1 pin=500 cycle_ticks=1 value=0 default_value=0 max_duration=0", "Can't assign oid"),
        ("spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000", "Invalid spi config"),
        ("set_digital_out pin=30 value=1", "Unable to open out GPIO chip line"),
        ("set_pwm_out pin=500 cycle_ticks=1 value=0", "Unable to config pwm device"),
    ] {
        let mut rig = Rig::configured(&["config_spi_without_cs oid=0"]);
        rig.send(command);
        assert_eq!(rig.shutdown().as_deref(), Some(text), "{command}");
        assert!(rig.bench.state().directions.is_empty(), "{command}");
    }
}
