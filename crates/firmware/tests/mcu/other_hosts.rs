// SPDX-License-Identifier: GPL-3.0-or-later
//! Forms that no dialect has: of hosts before November 2022, of single days, and of an open change of Kalico.

use pinion_firmware::board::BusStatus;
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{Entry, Forms, HostForms, entries};
use pinion_protocol::format;
use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::{Rig, hex};

const MS: u64 = 50_000;

const CONFIG: &str = "config is_config=%c crc=%u move_count=%hu is_shutdown=%c";
const STEPPER: &str = "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c";
const SPI: &str = "config_spi oid=%c pin=%u";
const THERMOCOUPLE: &str = "query_thermocouple oid=%c clock=%u rest_ticks=%u min_value=%u max_value=%u";
const DS18B20: &str = "config_ds18b20 oid=%c serial=%*s";
const SETUP_HOME: &str = "ldc1612_setup_home oid=%c clock=%u threshold=%u trsync_oid=%c trigger_reason=%c";
const HOME_STATE: &str = "ldc1612_home_state oid=%c homing=%c trigger_clock=%u";
const READ: &str = "i2c_read oid=%c reg=%*s read_len=%u";
const TRANSFER: &str = "i2c_transfer oid=%c write=%*s read_len=%u";
const TRIGGER_STATE: &str = "trigger_analog_state oid=%c homing=%c trigger_clock=%u";
const HX71X: &str = "config_hx71x oid=%c setting_pulses=%c dout_pin=%u sclk_pin=%u";

/// An MCU for a host that looks up these forms, and others of other names.
fn rig(formats: &[&str]) -> Rig {
    let entries = entries(FEATURES);
    for format in formats {
        assert!(entries.iter().any(|entry| entry.text == *format), "{format}");
    }
    // Hosts await this one by its name alone.
    let names: Vec<&str> = formats.iter().map(|format| format::name(format)).chain(["ds18b20_result"]).collect();
    let replaces = |entry: &Entry| formats.contains(&READ) && entry.text == TRANSFER;
    let looks_up = |entry: &Entry| {
        formats.contains(&entry.text) || entry.is_message() && !names.contains(&entry.name) && !replaces(entry)
    };
    Rig::of(Forms::Host(HostForms::new(&entries, looks_up)))
}

#[test]
fn the_answer_to_get_config_has_the_order_of_v0_10() {
    let mut rig = rig(&[CONFIG]);
    assert_eq!(rig.ask("get_config"), "config is_config=0 crc=0 move_count=0 is_shutdown=0");
    rig.send("emergency_stop");
    rig.responses();
    assert_eq!(rig.ask("get_config"), "config is_config=0 crc=0 move_count=0 is_shutdown=1");
    // Also while the MCU has the configuration of another host. The rig decodes it as that host.
    let mut rig = Rig::configured(&[]);
    rig.speak(Forms::Host(HostForms::new(&entries(FEATURES), |entry| entry.text == CONFIG)));
    assert!(rig.ask("get_config").ends_with(" is_shutdown=1024 move_count=0"));
}

#[test]
fn a_stepper_of_v0_10_pulses_for_two_microseconds() {
    let mut rig = rig(&[STEPPER]);
    rig.configure(&["config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=1"]);
    rig.send_all(&["reset_step_clock oid=0 clock=@0", "queue_step oid=0 interval=5000 count=2 add=0"]);
    rig.run_until(100_000);
    assert_eq!(rig.edges(1), [(5000, 0), (5100, 1), (10_000, 0), (10_100, 1)]);
}

#[test]
fn a_thermocouple_of_v0_10_stops_the_mcu_at_the_first_value_outside() {
    let mut rig = rig(&[SPI, THERMOCOUPLE]);
    rig.bench.plug_spi(0, |_, bytes| bytes.fill(0));
    rig.configure(&[
        "config_spi oid=0 pin=40",
        "config_thermocouple oid=1 spi_oid=0 thermocouple_type=0",
        "spi_set_bus oid=0 spi_bus=0 mode=0 rate=4000000",
    ]);
    assert!(rig.bench.level(40), "the chip is selected by low");
    rig.send("query_thermocouple oid=1 clock=@1000 rest_ticks=10000 min_value=100 max_value=4294967040");
    rig.stops_by(11_000, "Thermocouple reader fault");
}

#[test]
fn a_ds18b20_of_v0_10_has_no_fault_and_stops_the_mcu_at_the_first_failure() {
    const SERIAL: &str = "28-00000000100f";
    let mut rig = rig(&[DS18B20]);
    rig.bench.script_ds18b20(SERIAL, &[Some(20_000), None]);
    rig.bench.state().answer_ticks = 750 * MS as u32;
    rig.configure(&[&format!("config_ds18b20 oid=0 serial={}", hex(SERIAL.as_bytes()))]);
    let times = format!("clock=@{} rest_ticks={}", 100 * MS, 3000 * MS);
    rig.send(&format!("query_ds18b20 oid=0 {times} min_value=0 max_value=100000"));
    rig.run_until(1000 * MS);
    assert_eq!(rig.responses(), [format!("ds18b20_result oid=0 next_clock=@{} value=20000", 3100 * MS)]);
    rig.stops_by(4000 * MS, "Error reading DS18B20 sensor");
}

#[test]
fn an_ldc1612_of_april_2024_takes_an_error_of_the_sensor_for_a_trigger() {
    let mut rig = rig(&[SETUP_HOME, HOME_STATE, READ, "query_ldc1612_status oid=%c"]);
    rig.bench.plug_i2c(0, 0x2a, |_, write, read| {
        let word: u16 = match write {
            [0x00] => 0x8000,
            [0x18] => 1 << 3,
            _ => 0,
        };
        read.copy_from_slice(&word.to_be_bytes());
        Ok::<(), BusStatus>(())
    });
    rig.configure(&[
        "config_i2c oid=0",
        "i2c_set_bus oid=0 i2c_bus=0 rate=400000 address=42",
        "config_ldc1612 oid=1 i2c_oid=0",
        "config_trsync oid=2",
    ]);
    assert!(rig.ask("query_ldc1612_status oid=1").starts_with("sensor_bulk_status oid=1 "));
    rig.send_all(&[
        "trsync_start oid=2 report_clock=@0 report_ticks=0 expire_reason=9",
        "ldc1612_setup_home oid=1 clock=@100000 threshold=1000 trsync_oid=2 trigger_reason=3",
        "query_ldc1612 oid=1 rest_ticks=62500",
    ]);
    // Not before the homing begins.
    rig.run_until(99_000);
    assert!(!rig.responses().iter().any(|response| response.starts_with("trsync_state")));
    rig.run_until(200_000);
    let responses = rig.responses();
    assert!(responses.iter().any(|response| response.contains("trigger_reason=3")), "{responses:?}");
    assert!(rig.ask("query_ldc1612_home_state oid=1").contains(" homing=0 "));
}

#[test]
fn an_analog_trigger_of_january_2026_reports_the_time_of_the_peak() {
    let mut rig = rig(&[TRIGGER_STATE]);
    rig.configure(&[
        "config_trsync oid=1",
        "config_analog_in oid=2 pin=400",
        "config_sos_filter oid=3 max_sections=1",
        "config_trigger_analog oid=4 sos_filter_oid=3",
    ]);
    rig.send_all(&[
        "analog_in_attach_trigger_analog oid=2 trigger_analog_oid=4",
        "sos_filter_set_offset_scale oid=3 offset=0 scale=1 scale_frac_bits=0 auto_offset=0",
        "trigger_analog_set_raw_range oid=4 raw_min=10 raw_max=4000",
        "trigger_analog_set_trigger oid=4 trigger_analog_type=2 trigger_value=50",
    ]);
    // The peak is the third sample, and the fifth pulls the trigger.
    rig.bench.script_adc(ANALOG, &[100, 200, 300, 290, 200]);
    rig.send("query_analog_in oid=2 clock=@100000 sample_ticks=0 sample_count=1 rest_ticks=10000 bytes_per_report=2 min_value=0 max_value=65535 range_check_count=0");
    rig.send("trsync_start oid=1 report_clock=@0 report_ticks=0 expire_reason=2");
    rig.send("trigger_analog_home oid=4 trsync_oid=1 trigger_reason=1 error_reason=40 clock=@95000 monitor_ticks=10000 monitor_max=3");
    rig.run_until(150_000);
    rig.responses();
    assert_eq!(
        rig.ask("trigger_analog_query_state oid=4"),
        "trigger_analog_state oid=4 homing=0 trigger_clock=@120000"
    );
}

#[test]
fn a_load_cell_may_be_set_up_by_its_pulses() {
    for (setting_pulses, is_right) in [(0, false), (1, true), (4, true), (5, false)] {
        let mut rig = rig(&[HX71X]);
        rig.send("allocate_oids count=1");
        rig.send(&format!("config_hx71x oid=0 setting_pulses={setting_pulses} dout_pin=10 sclk_pin=11"));
        let expected = (!is_right).then_some("HX71x setting_pulses out of range 1-4");
        assert_eq!(rig.shutdown().as_deref(), expected, "{setting_pulses}");
    }
}

#[test]
fn a_host_that_looks_up_an_older_message_only_for_older_firmware_does_not_get_it() {
    let commands = |formats: &[&str]| {
        let forms = HostForms::new(&entries(FEATURES), |entry| formats.contains(&entry.text));
        let rig = Rig::of(Forms::Host(forms));
        [READ, TRANSFER].map(|format| rig.dictionary().commands.contains_key(format))
    };
    assert_eq!(commands(&[READ, TRANSFER]), [false, true]);
    assert!(commands(&[READ])[0]);
    assert_eq!(commands(&[TRANSFER]), [false, true]);
}
