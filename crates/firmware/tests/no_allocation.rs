// SPDX-License-Identifier: GPL-3.0-or-later
//! After configuration, the core allocates nothing in a whole print. An allocation may wait for a lock or for the
//! kernel, and a step would wait with it.

use pinion_firmware::mcu::DialectName::{Kalico, V0_12};
use pinion_firmware::mcu::Snapshot;
use pinion_testbench::board::ANALOG;
use pinion_testbench::memory::{Counting, allocations};
use pinion_testbench::rig::Rig;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Sends commands ahead of their time, as a host does.
struct Print {
    rig: Rig,
    counted: u64,
}

impl Print {
    fn send(&mut self, command: &str) {
        let payload = self.rig.encode(command);
        self.counted += allocations(|| self.rig.execute(&payload));
    }

    fn run_until(&mut self, ticks: u64) {
        self.counted += allocations(|| self.rig.run_until(ticks));
        // The bench has room for a limited number of edges.
        self.rig.bench.forget_edges();
    }
}

const STEPPERS: [u8; 3] = [0, 1, 2];

const OBJECTS: &[&str] = &[
    "config_stepper oid=0 step_pin=0 dir_pin=1 invert_step=0 step_pulse_ticks=100",
    "config_stepper oid=1 step_pin=2 dir_pin=3 invert_step=1 step_pulse_ticks=100",
    "config_stepper oid=2 step_pin=4 dir_pin=5 invert_step=-1 step_pulse_ticks=0",
    "config_endstop oid=3 pin=6 pull_up=1",
    "config_trsync oid=4",
    "config_digital_out oid=5 pin=7 value=0 default_value=0 max_duration=150000000",
    "set_digital_out_pwm_cycle oid=5 cycle_ticks=500000",
    "config_analog_in oid=6 pin=400",
    "config_spi oid=7 pin=8 cs_active_high=0",
    "spi_set_bus oid=7 spi_bus=0 mode=0 rate=1000000",
    "config_pwm_out oid=8 pin=500 cycle_ticks=50000 value=0 default_value=0 max_duration=0",
    "set_pwm_out pin=501 cycle_ticks=50000 value=0",
    "set_digital_out pin=9 value=0",
    "config_adxl345 oid=14 spi_oid=7",
    "config_buttons oid=9 button_count=2",
    "config_counter oid=10 pin=12 pull_up=1",
    "config_counter oid=15 pin=13 pull_up=1",
    "config_thermocouple oid=11 spi_oid=7 thermocouple_type=3",
    "config_ds18b20 oid=12 serial=3238 max_error_count=4",
    "config_neopixel oid=13 pin=701 data_size=6 bit_max_ticks=200 reset_min_ticks=2500",
];

/// klippy's commands after the configuration, before anything moves.
const BEGINNINGS: &[&str] = &[
    "buttons_add oid=9 pos=0 pin=10 pull_up=1",
    "buttons_add oid=9 pos=1 pin=11 pull_up=1",
    "buttons_query oid=9 clock=@100000 rest_ticks=100000 retransmit_count=50 invert=0",
    "query_counter oid=10 clock=@100000 poll_ticks=75000 sample_ticks=50000000",
    "query_counter oid=15 clock=@100000 poll_ticks=75000 sample_ticks=50000000",
    "query_thermocouple oid=11 clock=@100000 rest_ticks=50000000 min_value=0 max_value=65535 max_invalid_count=255",
    "query_ds18b20 oid=12 clock=@100000 rest_ticks=150000000 min_value=-55000 max_value=125000",
];

/// Homes, heats, prints for half a minute and homes again.
fn print(rig: Rig) -> Print {
    let mut print = Print { rig, counted: 0 };
    print.rig.bench.script_adc(ANALOG, &[500]);
    print.rig.bench.script_input(6, &[(9_000_000, 1), (30_000_000, 0), (1_470_000_000, 1)]);
    print.rig.bench.script_input(11, &[(50_000_000, 1), (900_000_000, 0)]);
    print.rig.bench.script_input(12, &[(50_000_000, 1), (60_000_000, 0)]);
    print.rig.bench.script_input(13, &[(50_000_000, 1), (60_000_000, 0)]);
    print.rig.send_all(BEGINNINGS);
    print.send("query_analog_in oid=6 clock=@100000 sample_ticks=50000 sample_count=8 rest_ticks=15000000 bytes_per_report=48 min_value=0 max_value=65535 range_check_count=4");
    // The bench has room for only 256 transfers.
    print.send("query_adxl345 oid=14 rest_ticks=20000000");
    print.home(5_000_000);
    assert_eq!(print.rig.ask("endstop_query_state oid=3").split(' ').nth(2), Some("homing=1"));
    let mut at = 40_000_000;
    for oid in STEPPERS {
        print.send(&format!("reset_step_clock oid={oid} clock=@{at}"));
    }
    for n in 0..2000u64 {
        for oid in STEPPERS {
            print.send(&format!("set_next_step_dir oid={oid} dir={}", n / 7 % 2));
            print.send(&format!("queue_step oid={oid} interval=20000 count=10 add={}", n % 10));
            print.send(&format!("queue_step oid={oid} interval=25000 count=20 add=-{}", n % 10));
        }
        if n % 50 == 0 {
            print.send(&format!("queue_digital_out oid=5 clock=@{at} on_ticks={}", 100 * n));
            print.send(&format!("queue_pwm_out oid=8 clock=@{at} value={n}"));
            print.send("spi_transfer oid=7 data=0102030405");
            print.send("query_adxl345_status oid=14");
            print.send(&format!("set_pwm_out pin=501 cycle_ticks=50000 value={n}"));
            print.send(&format!("set_digital_out pin=9 value={}", n / 50 % 2));
            print.send("neopixel_update oid=13 pos=1 data=ff00ff");
            print.send("neopixel_send oid=13");
            print.send("buttons_ack oid=9 count=1");
            for command in ["get_clock", "get_uptime", "get_config", "debug_ping data=01", "stepper_get_position oid=0"]
            {
                print.send(command);
            }
            print.rig.everything();
        }
        at += 700_000;
        print.run_until(at - 10_000_000);
    }
    print.send(&format!("queue_digital_out oid=5 clock=@{at} on_ticks=0"));
    print.run_until(at + 10_000_000);
    print.home(at + 20_000_000);
    print
}

impl Print {
    fn home(&mut self, at: u64) {
        self.send(&format!("trsync_start oid=4 report_clock=@{at} report_ticks=1000000 expire_reason=4"));
        self.send(&format!("trsync_set_timeout oid=4 clock=@{}", at + 500_000_000));
        for oid in STEPPERS {
            self.send(&format!("stepper_stop_on_trigger oid={oid} trsync_oid=4"));
            self.send(&format!("reset_step_clock oid={oid} clock=@{at}"));
            self.send(&format!("queue_step oid={oid} interval=10000 count=65535 add=0"));
        }
        self.send(&format!(
            "endstop_home oid=3 clock=@{at} sample_ticks=750 sample_count=4 rest_ticks=20000 pin_value=1 trsync_oid=4 trigger_reason=1"
        ));
        self.run_until(at + 20_000_000);
        self.send("trsync_trigger oid=4 reason=2");
        let reports = self.rig.everything();
        assert!(reports.iter().any(|report| report.contains("can_trigger=0 trigger_reason=1")), "{reports:?}");
        for oid in STEPPERS {
            self.send(&format!("stepper_get_position oid={oid}"));
        }
    }
}

#[test]
fn a_print_allocates_nothing_once_configured() {
    for (answer_ticks, has_bank) in [(0, false), (40_000, true)] {
        let mut rig = Rig::new();
        rig.bench.state().answer_ticks = answer_ticks;
        rig.bench.state().has_bank = has_bank;
        rig.bench.script_ds18b20("28", &[Some(20_000)]);
        rig.bench.state().counted.insert(13);
        rig.configure(OBJECTS);
        let print = print(rig);
        assert_eq!(print.rig.notes().len(), 2, "a counter is polled; configured; and nothing else");
        assert_eq!(print.counted, 0);
        assert_eq!(print.rig.bench.state().stores.is_empty(), !has_bank);
    }
}

/// The caller provides the memory for the status.
#[test]
fn a_status_that_is_reported_amid_steps_allocates_nothing() {
    let mut rig = Rig::new();
    rig.bench.script_ds18b20("28", &[Some(20_000)]);
    rig.bench.state().counted.insert(13);
    rig.configure(OBJECTS);
    let mut print = Print { rig, counted: 0 };
    let mut snapshot = Snapshot::default();
    for at in (0..20u64).map(|n| 40_000_000 + 200_000 * n) {
        print.send(&format!("reset_step_clock oid=0 clock=@{at}"));
        print.send("queue_step oid=0 interval=10000 count=9 add=0");
        print.send("queue_step oid=0 interval=10000 count=1 add=0");
        print.run_until(at + 50_000);
        snapshot.clear();
        let mut parts = 1;
        print.counted += allocations(|| {
            while !print.rig.mcu.fill(&mut snapshot) {
                parts += 1;
            }
        });
        // The head is one part, and each further part has up to 16 lines or objects.
        assert!(parts > 2 && snapshot.lines.len() > 10 && snapshot.objects.len() > 15);
        let stepper = snapshot.objects[0].report;
        assert_eq!((snapshot.moves.0, stepper.queued), (1, 1), "it steps");
        print.run_until(at + 150_000);
    }
    // A status that contains the reason of the shutdown.
    print.rig.send("emergency_stop");
    snapshot.clear();
    print.counted += allocations(|| while !print.rig.mcu.fill(&mut snapshot) {});
    assert!(snapshot.detail.starts_with("the host asked for it") && snapshot.stopped.is_some());
    assert_eq!(print.counted, 0);
}

/// Probes with each kind of sensor. Their lines and chips answer anything.
#[test]
fn probing_allocates_nothing_once_configured() {
    let objects = [
        "config_trsync oid=0",
        "config_sos_filter oid=1 max_sections=4",
        "config_trigger_analog oid=2 sos_filter_oid=1",
        "config_analog_in oid=3 pin=400",
        "config_hx71x oid=4 gain_channel=1 dout_pin=10 sclk_pin=11",
        "config_spi_without_cs oid=5",
        "config_ads1220 oid=6 spi_oid=5 data_ready_pin=12",
        "config_ads131m0x oid=7 spi_oid=5 channel=0 num_channels=4 data_ready_pin=12",
        "spi_set_bus oid=5 spi_bus=0 mode=1 rate=512000",
    ];
    for rig in [Rig::configured(&objects), Rig::with_workers(4000, &objects)] {
        let mut print = Print { rig, counted: 0 };
        for (n, sensor) in ["analog_in oid=3", "hx71x oid=4", "ads1220 oid=6", "ads131m0x oid=7"].iter().enumerate() {
            let (name, oid) = sensor.split_once(' ').unwrap();
            let at = 10_000_000 * (n as u64 + 1);
            print.send(&format!("{name}_attach_trigger_analog {oid} trigger_analog_oid=2"));
            print.send("sos_filter_set_offset_scale oid=1 offset=0 scale=1 scale_frac_bits=0 auto_offset=1");
            print.send("sos_filter_set_active oid=1 n_sections=4 coeff_frac_bits=29");
            print.send("trigger_analog_set_raw_range oid=2 raw_min=-8388608 raw_max=8388607");
            print.send("trigger_analog_set_trigger oid=2 trigger_analog_type=1 trigger_value=1000");
            print.send("trsync_start oid=0 report_clock=@0 report_ticks=0 expire_reason=2");
            print.send(&format!("trigger_analog_home oid=2 trsync_oid=0 trigger_reason=1 error_reason=40 clock=@{at} monitor_ticks=1000000 monitor_max=3"));
            match name {
                "analog_in" => print.send(&format!("query_analog_in {oid} clock=@{at} sample_ticks=0 sample_count=1 rest_ticks=10000 bytes_per_report=48 min_value=0 max_value=65535 range_check_count=0")),
                _ => print.send(&format!("query_{name} {oid} rest_ticks=10000")),
            }
            print.run_until(at + 5_000_000);
            print.send("trigger_analog_query_state oid=2");
            print.send("trigger_analog_home oid=2 trsync_oid=0 trigger_reason=0 error_reason=0 clock=0 monitor_ticks=0 monitor_max=0");
            let reports = print.rig.everything();
            assert!(
                reports.iter().any(|it| it.starts_with("sensor_bulk_data") || it.starts_with("analog_in_state")),
                "{name}"
            );
            // The bench has room for a limited number of transfers.
            if name != "analog_in" {
                print.send(&format!("query_{name} {oid} rest_ticks=0"));
            }
        }
        assert_eq!(print.counted, 0);
    }
}

/// Covers the forms of commands that only hosts before master use.
#[test]
fn older_hosts_cost_no_allocation_either() {
    let sensors = [
        "config_spi oid=0 pin=8 cs_active_high=0",
        "spi_set_bus oid=0 spi_bus=0 mode=0 rate=1000000",
        "config_i2c oid=1",
        "i2c_set_bus oid=1 i2c_bus=0 rate=400000 address=64",
        "config_analog_in oid=2 pin=400",
        "config_adxl345 oid=3 spi_oid=0",
        "config_lis2dw oid=4 spi_oid=0",
        "config_mpu9250 oid=5 i2c_oid=1",
        "config_spi_angle oid=6 spi_oid=0 spi_angle_type=0",
    ];
    for answer_ticks in [0, 4000] {
        let mut rig = Rig::of(V0_12);
        rig.bench.state().answer_ticks = answer_ticks;
        rig.bench.plug_i2c(0, 64, |_, _, read| {
            read.fill(7);
            Ok(())
        });
        rig.configure(&sensors);
        let mut print = Print { rig, counted: 0 };
        print.send("query_analog_in oid=2 clock=@100000 sample_ticks=0 sample_count=1 rest_ticks=100000 min_value=0 max_value=65535 range_check_count=0");
        for sensor in ["adxl345 oid=3", "lis2dw oid=4", "mpu9250 oid=5"] {
            print.send(&format!("query_{sensor} clock=@100000 rest_ticks=100000"));
        }
        print.send("query_spi_angle oid=6 clock=@100000 rest_ticks=100000 time_shift=0");
        print.send("i2c_write oid=1 data=1020");
        print.send("i2c_read oid=1 reg=10 read_len=6");
        print.send("i2c_modify_bits oid=1 reg=10 clear_set_bits=0102");
        // The bench has room for only 256 transfers.
        print.run_until(2_000_000);
        for sensor in ["adxl345 oid=3", "lis2dw oid=4", "mpu9250 oid=5"] {
            let (name, oid) = sensor.split_once(' ').unwrap();
            print.send(&format!("query_{name}_status {oid}"));
            print.send(&format!("query_{sensor} clock=0 rest_ticks=0"));
        }
        print.send("query_spi_angle oid=6 clock=0 rest_ticks=0 time_shift=0");
        print.run_until(3_000_000);
        let reports = print.rig.everything();
        for kind in [
            "analog_in_state",
            "i2c_read_response",
            "adxl345_status",
            "lis2dw_status",
            "mpu9250_status",
            "spi_angle_end",
        ] {
            assert!(reports.iter().any(|report| report.starts_with(kind)), "{kind}");
        }
        assert_eq!(print.counted, 0);
    }
}

#[test]
fn a_probe_of_kalico_allocates_nothing_once_configured() {
    let mut rig = Rig::of(Kalico);
    rig.configure(&[
        "config_trsync oid=0",
        "config_sos_filter oid=1 max_sections=4",
        "config_load_cell_probe oid=2 sos_filter_oid=1",
        "config_spi_without_cs oid=3",
        "config_ads131m0x oid=4 spi_oid=3 data_ready_pin=12 sensor_channel_count=4 channel_mask=15",
        "config_ads1220 oid=5 spi_oid=3 data_ready_pin=12",
        "spi_set_bus oid=3 spi_bus=0 mode=1 rate=512000",
    ]);
    let mut print = Print { rig, counted: 0 };
    print.send("sos_filter_set_active oid=1 n_sections=4 coeff_int_bits=2");
    print.send("load_cell_probe_set_range oid=2 safety_counts_min=-8388608 safety_counts_max=8388607 tare_counts=0 trigger_grams=1 grams_per_count=1");
    print.send("trsync_start oid=0 report_clock=@0 report_ticks=0 expire_reason=2");
    for sensor in ["ads131m0x oid=4", "ads1220 oid=5"] {
        let (name, oid) = sensor.split_once(' ').unwrap();
        print.send(&format!("{name}_attach_load_cell_probe {oid} load_cell_probe_oid=2"));
        print.send(&format!("query_{sensor} rest_ticks=10000"));
    }
    print.send("load_cell_probe_home oid=2 trsync_oid=0 trigger_reason=1 error_reason=40 clock=@100000 rest_ticks=10000 timeout=3");
    print.run_until(5_000_000);
    print.send("load_cell_probe_query_state oid=2");
    let reports = print.rig.everything();
    assert!(reports.iter().any(|report| report.starts_with("sensor_bulk_data oid=5")));
    assert!(reports.iter().any(|report| report.starts_with("load_cell_probe_state")));
    assert_eq!(print.counted, 0);
}

#[test]
fn the_counter_counts() {
    // `black_box` keeps the optimizer from removing the pair.
    assert_eq!(allocations(|| drop(std::hint::black_box(Box::new(1)))), 2);
}
