// SPDX-License-Identifier: GPL-3.0-or-later
//! One order: a command's job holds back the commands behind it, and nothing else.

use pinion_testbench::board::SPI_CHIPS;
use pinion_testbench::rig::Rig;

const DISPLAY: &[&str] = &[
    "config_spi_without_cs oid=0",
    "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
    "config_digital_out oid=1 pin=30 value=0 default_value=0 max_duration=0",
];

/// klippy's SPI4wire (extras/display/uc1701.py): the D/C line, the bytes, the line back.
#[test]
fn a_display_sees_its_line_and_its_bytes_in_order() {
    let mut rig = Rig::with_workers(50_000, DISPLAY);
    for n in 0..20 {
        let block: Vec<u8> = [
            "update_digital_out oid=1 value=1".to_owned(),
            format!("spi_send oid=0 data={n:02x}"),
            "update_digital_out oid=1 value=0".to_owned(),
            format!("spi_send oid=0 data=ff{n:02x}"),
        ]
        .iter()
        .flat_map(|command| rig.encode(command))
        .collect();
        rig.execute(&block);
    }
    let edges = rig.edges(30);
    assert_eq!(edges.len(), 40);
    for (n, transfer) in rig.bench.transfers().iter().enumerate() {
        let level = edges.iter().rev().find(|(at, _)| *at < transfer.at).map(|(_, level)| *level);
        let wanted = u8::from(n % 2 == 0);
        assert_eq!((level, transfer.data.len()), (Some(wanted), 1 + n % 2), "message {n}");
    }
}

/// Adds a second device, and a message for the first one at a stop.
fn two_devices(answer_ticks: u32) -> Rig {
    let more = [
        "config_spi_without_cs oid=2",
        "spi_set_bus oid=2 spi_bus=0 mode=0 rate=1000000",
        "config_spi_shutdown oid=3 spi_oid=0 shutdown_msg=ee",
    ];
    Rig::with_workers(answer_ticks, &[DISPLAY, &more].concat())
}

fn sent(rig: &Rig) -> Vec<Vec<u8>> {
    rig.bench.transfers().into_iter().map(|transfer| transfer.data).collect()
}

#[test]
fn what_is_only_sent_does_not_wait_for_what_was_sent_before_to_the_same_device() {
    let mut rig = two_devices(1000);
    rig.begin("spi_send oid=0 data=00");
    assert!(!rig.mcu.keeps_block(), "nobody waits for an answer");
    for n in 1..8 {
        assert!(!rig.mcu.may_run(&[]));
        for other in ["spi_send oid=2 data=01", "spi_transfer oid=0 data=01", "update_digital_out oid=1 value=1"] {
            assert!(rig.mcu.is_held() && !rig.mcu.may_run(&rig.encode(other)), "{other}");
        }
        let next = format!("spi_send oid=0 data={n:02x}");
        assert!(rig.mcu.may_run(&rig.encode(&next)), "{next}");
        rig.begin(&next);
    }
    let next = rig.encode("spi_send oid=0 data=08");
    assert!(!rig.mcu.may_run(&next), "as many as can be are under way");
    rig.run_until(1000);
    assert!(rig.mcu.may_run(&next));
    rig.begin("spi_send oid=0 data=08");
    rig.run_until(8999);
    assert!(rig.mcu.is_held());
    rig.run_until(9000);
    assert!(!rig.mcu.is_held());
    assert_eq!(sent(&rig), (0..9).map(|n| vec![n]).collect::<Vec<_>>());
    // A command with an answer keeps its block, and nothing joins it.
    rig.begin("spi_transfer oid=0 data=01");
    assert!(rig.mcu.keeps_block() && !rig.mcu.may_run(&next));
}

#[test]
fn a_message_that_fails_is_the_last_one() {
    let mut rig = two_devices(1000);
    (0..4).for_each(|n| rig.begin(&format!("spi_send oid=0 data={n:02x}")));
    rig.run_until(1999);
    rig.bench.state().broken.insert(SPI_CHIPS);
    rig.stops_by(2000, "Unable to issue spi ioctl");
    rig.bench.state().broken.remove(&SPI_CHIPS);
    rig.run_until(50_000);
    assert_eq!(sent(&rig), [[0], [0xee]], "two were under way, and only the message of the stop comes");
    rig.send("clear_shutdown");
    rig.send("spi_send oid=0 data=05");
    assert_eq!(sent(&rig).last(), Some(&vec![5]));
}

#[test]
fn a_stop_ends_what_is_under_way() {
    let mut rig = two_devices(1000);
    (0..4).for_each(|n| rig.begin(&format!("spi_send oid=0 data={n:02x}")));
    rig.run_until(1000);
    rig.begin("emergency_stop");
    // The messages that wait belong to the round that ended, so they are not sent.
    rig.begin("clear_shutdown");
    rig.run_until(50_000);
    assert_eq!(sent(&rig), [[0], [0xee]]);
}

#[test]
fn an_answer_is_there_before_the_next_command_runs() {
    let mut rig = Rig::with_workers(200_000, DISPLAY);
    rig.begin("spi_transfer oid=0 data=0102");
    assert!(rig.mcu.is_held());
    rig.run_until(199_999);
    assert!(rig.mcu.is_held());
    assert_eq!(rig.responses(), [""; 0]);
    rig.run_until(200_000);
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.responses(), ["spi_transfer_response oid=0 response=fefd"]);
}

#[test]
fn steps_and_samples_go_on_beside_a_slow_bus() {
    let mut rig = Rig::with_workers(
        200_000,
        &[
            "config_spi_without_cs oid=0",
            "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
            "config_stepper oid=1 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0",
            "config_endstop oid=2 pin=3 pull_up=0",
            "config_trsync oid=3",
        ],
    );
    rig.bench.script_input(3, &[(650_000, 1)]);
    rig.send_all(&[
        "trsync_start oid=3 report_clock=@0 report_ticks=0 expire_reason=4",
        "stepper_stop_on_trigger oid=1 trsync_oid=3",
        "endstop_home oid=2 clock=@1000 sample_ticks=10 sample_count=4 rest_ticks=100 pin_value=1 trsync_oid=3 trigger_reason=1",
        "reset_step_clock oid=1 clock=@0",
        "queue_step oid=1 interval=1000 count=1000 add=0",
    ]);
    rig.send_all(&["spi_transfer oid=0 data=00"; 5]);
    assert_eq!(rig.now(), 1_000_000);
    let edges = rig.edges(1);
    assert_eq!(edges.len(), 650, "the endstop stops them in the middle of a transfer");
    assert!(edges.iter().zip(1..).all(|((at, _), n)| *at == 1000 * n));
    assert_eq!(rig.responses().iter().filter(|response| response.starts_with("spi_transfer_response")).count(), 5);
}

#[test]
fn a_reading_that_a_timer_began_holds_nothing() {
    let mut rig = Rig::with_workers(100_000, &["config_analog_in oid=0 pin=400"]);
    rig.send("query_analog_in oid=0 clock=@1000 sample_ticks=0 sample_count=1 rest_ticks=300000 bytes_per_report=1 min_value=0 max_value=65535 range_check_count=1");
    rig.run_until(50_000);
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.ask("get_clock"), "clock clock=@50000");
}

#[test]
fn a_stopped_mcu_is_held_by_nothing() {
    let mut rig = Rig::with_workers(200_000, DISPLAY);
    rig.begin("spi_transfer oid=0 data=01");
    rig.mcu.shut_down(pinion_firmware::shutdown::Shutdown::because(
        pinion_firmware::shutdown::reason::FORCE_SHUTDOWN,
        "a test",
    ));
    assert!(!rig.mcu.is_held());
    assert_eq!(rig.ask("get_clock"), "clock clock=@0");
    rig.run_until(1_000_000);
    assert!(!rig.mcu.is_held());
}

#[test]
fn a_bus_that_hangs_stops_the_mcu_when_the_host_has_given_up() {
    let mut rig = Rig::with_workers(4_000_000_000, DISPLAY);
    rig.begin("spi_transfer oid=0 data=01");
    rig.run_until(249_999_999);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(250_000_001, "Bus does not answer");
    let notes = rig.notes();
    assert!(notes.iter().any(|note| note.contains("SPI device oid 0 has not answered for 5 s")), "{notes:?}");
}

/// After a `clear_shutdown`, commands wait for this bus again, and no longer than before.
#[test]
fn a_bus_that_still_hangs_stops_the_mcu_again() {
    let mut rig = Rig::with_workers(4_000_000_000, DISPLAY);
    rig.begin("spi_transfer oid=0 data=01");
    rig.stops_by(260_000_000, "Bus does not answer");
    rig.begin("clear_shutdown");
    assert!(rig.mcu.is_held());
    rig.run_until(260_000_000 + 249_999_999);
    assert_eq!(rig.shutdown(), None);
    rig.stops_by(260_000_000 + 250_000_001, "Bus does not answer");
    assert!(!rig.mcu.is_held());
}

#[test]
fn transfers_that_end_in_time_never_add_up_to_one_that_hangs() {
    let mut rig = Rig::with_workers(200_000_000, DISPLAY);
    rig.send_all(&["spi_transfer oid=0 data=01"; 4]);
    assert_eq!(rig.responses().len(), 4);
    assert_eq!(rig.shutdown(), None);
}

#[test]
fn messages_that_end_in_time_never_add_up_to_one_that_hangs() {
    let mut rig = Rig::with_workers(200_000_000, DISPLAY);
    for _ in 0..3 {
        rig.begin("spi_send oid=0 data=00");
    }
    rig.run_until(600_000_001);
    assert_eq!((rig.shutdown(), rig.mcu.is_held()), (None, false));
}

#[test]
fn a_transfer_that_fails_stops_the_mcu_once_and_the_next_configuration_works() {
    let mut rig = Rig::with_workers(1000, DISPLAY);
    rig.bench.state().broken.insert(SPI_CHIPS);
    rig.send("spi_transfer oid=0 data=01");
    assert_eq!(rig.responses(), ["shutdown clock=@1000 static_string_id=Unable to issue spi ioctl"]);
    rig.bench.state().broken.clear();
    rig.send("config_reset");
    rig.configure(DISPLAY);
    assert_eq!(rig.ask("spi_transfer oid=0 data=01"), "spi_transfer_response oid=0 response=fe");
}
