// SPDX-License-Identifier: GPL-3.0-or-later
//! Another process of the host comes than the one that configured the MCU.

use pinion_testbench::rig::Rig;

/// An output that is on until the MCU stops.
const HEATER: &str = "config_digital_out oid=0 pin=20 value=1 default_value=0 max_duration=0";

#[test]
fn a_stopped_mcu_is_fresh_for_a_new_process_and_everything_stays_off() {
    let mut rig = Rig::configured(&[HEATER]);
    rig.send("emergency_stop");
    rig.responses();
    rig.mcu.renew();
    assert!(!rig.bench.level(20));
    assert_eq!(rig.ask("get_config"), "config is_config=0 crc=0 is_shutdown=0 move_count=0");
    assert!(rig.notes().ends_with(&["renewed".into(), "reset".into()]), "{:?}", rig.notes());
    rig.send("allocate_oids count=1");
    rig.send(HEATER);
    assert!(rig.bench.level(20), "a new configuration is accepted");
}

#[test]
fn an_unfinished_configuration_is_stopped_and_dropped() {
    let mut rig = Rig::new();
    rig.send("allocate_oids count=1");
    rig.send(HEATER);
    assert!(rig.bench.level(20));
    rig.mcu.renew();
    assert!(!rig.bench.level(20), "its outputs are at their shutdown values");
    rig.responses();
    rig.send("allocate_oids count=1");
    assert_eq!(rig.responses(), [""; 0], "oids are not allocated twice");
    assert!(!rig.mcu.is_shutdown());
}

#[test]
fn a_running_mcu_and_an_empty_one_stay_as_they_are() {
    let mut rig = Rig::configured(&[HEATER]);
    rig.mcu.renew();
    assert!(rig.mcu.is_running() && rig.bench.level(20));
    let mut rig = Rig::new();
    rig.mcu.renew();
    assert_eq!((rig.notes().len(), rig.responses().len()), (0, 0));
}

#[test]
fn a_stopped_mcu_is_not_fresh_before_its_outputs_are_safe() {
    let mut rig = Rig::with_workers(1000, &[HEATER]);
    rig.bench.state().broken.insert(20);
    rig.send("emergency_stop");
    rig.mcu.renew();
    rig.run_until(1_000_000);
    assert!(rig.mcu.is_shutdown() && rig.mcu.has_pending_values());
    rig.bench.state().broken.clear();
    rig.run_until(16_000_000);
    assert!(!rig.mcu.is_shutdown() && !rig.bench.level(20));
}
