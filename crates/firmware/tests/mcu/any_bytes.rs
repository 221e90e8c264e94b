// SPDX-License-Identifier: GPL-3.0-or-later
//! No bytes from a host can break the MCU.

use pinion_firmware::mcu::DialectName::{self, Kalico, Master, Union, V0_11, V0_12, V0_13};
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_protocol::format::{self, Conversion};
use pinion_protocol::vlq::Writer;
use proptest::collection::vec;
use proptest::prelude::*;

use pinion_testbench::board::ANALOG;
use pinion_testbench::rig::Rig;

const OBJECTS: &[&str] = &[
    "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=0 step_pulse_ticks=100",
    "config_stepper oid=1 step_pin=3 dir_pin=4 invert_step=-1 step_pulse_ticks=0",
    "config_endstop oid=2 pin=5 pull_up=1",
    "config_trsync oid=3",
    "config_digital_out oid=4 pin=6 value=0 default_value=1 max_duration=100000",
    "set_digital_out_pwm_cycle oid=4 cycle_ticks=1000",
    "config_analog_in oid=5 pin=400",
    "config_spi oid=6 pin=7 cs_active_high=0",
    "spi_set_bus oid=6 spi_bus=0 mode=0 rate=1000000",
    "config_spi_shutdown oid=7 spi_oid=6 shutdown_msg=01",
    "set_digital_out pin=0 value=1",
    "config_buttons oid=8 button_count=3",
    "config_counter oid=9 pin=8 pull_up=1",
    "config_i2c oid=10",
    "i2c_set_bus oid=10 i2c_bus=0 rate=400000 address=64",
    "config_pca9685 oid=11 bus=0 addr=64 channel=0 cycle_ticks=1000000 value=1 default_value=0 max_duration=100000",
    "config_adxl345 oid=12 spi_oid=6",
    "config_spi_angle oid=13 spi_oid=6 spi_angle_type=2",
    "config_lis2dw oid=14 bus_oid=6 bus_oid_type=0 lis_chip_type=0",
    "config_thermocouple oid=15 spi_oid=6 thermocouple_type=1",
    "config_ds18b20 oid=16 serial=3238 max_error_count=2",
    "config_neopixel oid=17 pin=701 data_size=6 bit_max_ticks=200 reset_min_ticks=2500",
];

/// The same objects for a host of another dialect, in its forms, and some objects that only it has.
fn objects(dialect: DialectName) -> Vec<&'static str> {
    let mut objects = OBJECTS.to_vec();
    let mut replace = |name: &str, by: &[&'static str]| {
        let at = objects.iter().position(|command| command.starts_with(name)).unwrap();
        objects.splice(at..=at, by.iter().copied());
    };
    match dialect {
        V0_11 => {
            replace("config_i2c ", &["config_i2c oid=10 i2c_bus=0 rate=400000 address=64"]);
            replace("i2c_set_bus ", &[]);
            replace("config_lis2dw ", &["config_mpu9250 oid=14 i2c_oid=10"]);
        }
        V0_12 => replace("config_lis2dw ", &["config_lis2dw oid=14 spi_oid=6", "config_mpu9250 oid=18 i2c_oid=10"]),
        V0_13 | Union => objects.push("config_ldc1612 oid=18 i2c_oid=10"),
        Master => objects
            .extend(["config_sos_filter oid=18 max_sections=2", "config_trigger_analog oid=19 sos_filter_oid=18"]),
        Kalico => {
            replace("config_spi_angle ", &["config_ldc1612 oid=13 i2c_oid=10"]);
            replace("config_ds18b20 ", &["config_ds18b20 oid=16 serial=3238 max_error_count=2 ignore_limits=0"]);
            replace(
                "config_counter ",
                &["config_ads131m0x oid=9 spi_oid=6 data_ready_pin=8 sensor_channel_count=4 channel_mask=15"],
            );
            objects
                .extend(["config_sos_filter oid=18 max_sections=2", "config_load_cell_probe oid=19 sos_filter_oid=18"]);
        }
    }
    objects
}

#[derive(Clone, Debug)]
enum Action {
    /// Random bytes.
    Bytes(Vec<u8>),
    /// A command of the dictionary with these values.
    Command(usize, Vec<u32>, Vec<u8>),
    Turns(u32),
    Stall(u64),
}

/// Values at which something might break, and valid values.
fn value() -> impl Strategy<Value = u32> {
    prop_oneof![
        4 => 0u32..8,
        1 => prop::sample::select(vec![255, 256, 1000, 65535, 65536, 1 << 31, (1 << 31) - 1, u32::MAX, u32::MAX - 1]),
        // Clocks near the rig's creation.
        2 => 10_000_000u32..10_500_000,
        1 => any::<u32>(),
    ]
}

fn action() -> impl Strategy<Value = Action> {
    prop_oneof![
        2 => vec(any::<u8>(), 0..=PAYLOAD_MAX).prop_map(Action::Bytes),
        10 => (any::<usize>(), vec(value(), 9), vec(any::<u8>(), 0..40))
            .prop_map(|(which, values, bytes)| Action::Command(which, values, bytes)),
        5 => (1u32..30).prop_map(Action::Turns),
        1 => (0u64..10_000_000).prop_map(Action::Stall),
    ]
}

fn command(rig: &Rig, which: usize, values: &[u32], bytes: &[u8]) -> Vec<u8> {
    let commands = &rig.dictionary().commands;
    let format = commands.keys().nth(which % commands.len()).unwrap();
    let mut writer = Writer::default();
    writer.int(rig.dialect().command_id(format).unwrap());
    let parameters = format::parameters(format).unwrap();
    let strings = parameters.iter().filter(|(_, conversion)| *conversion == Conversion::Bytes).count();
    for ((name, conversion), value) in parameters.iter().zip(values) {
        match conversion {
            // All strings together fit a block.
            Conversion::Bytes => writer.string(&bytes[..bytes.len() / strings]),
            // Most of these oids have an object.
            _ if name.ends_with("oid") => writer.int(value % 21),
            _ => writer.int(*value),
        }
    }
    writer.payload().unwrap().to_vec()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 800, ..ProptestConfig::default() })]

    #[test]
    fn no_bytes_break_the_mcu(
        dialect in prop::sample::select(&DialectName::ALL[..]),
        answer_ticks in 0u32..50_000,
        actions in vec(action(), 1..60),
    ) {
        let mut rig = Rig::of(dialect);
        rig.bench.state().answer_ticks = answer_ticks;
        rig.bench.plug_i2c(0, 64, |_, _, _| Ok(()));
        rig.bench.script_adc(ANALOG, &[1000, 2000, 60_000, 0]);
        rig.bench.script_input(5, &[(100_000, 1), (100_700, 0), (200_000, 1)]);
        rig.bench.script_ds18b20("28", &[Some(20_000), None, Some(-5000), None]);
        rig.configure(&objects(dialect));
        for action in &actions {
            match action {
                Action::Bytes(bytes) => rig.execute(bytes),
                Action::Command(which, values, bytes) => {
                    let payload = command(&rig, *which, values, bytes);
                    rig.execute(&payload);
                }
                Action::Turns(turns) => rig.run_turns(*turns),
                Action::Stall(ticks) => rig.stall_until(rig.now() + ticks),
            }
            // This checks that every response has the form of the dictionary.
            rig.everything();
        }
        prop_assert!(rig.ask("get_config").starts_with("config is_config="));
        rig.send_all(&["emergency_stop", "config_reset"]);
        rig.everything();
        rig.configure(&objects(dialect));
        prop_assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024");
        // The MCU still works: a step comes on its tick.
        rig.edges(1);
        let now = rig.now();
        rig.send(&format!("reset_step_clock oid=0 clock=@{now}"));
        rig.send("queue_step oid=0 interval=1000 count=1 add=0");
        rig.run_until(now + 5000);
        prop_assert_eq!(rig.edges(1), [(now + 1000, 1), (now + 1100, 0)]);
    }
}
