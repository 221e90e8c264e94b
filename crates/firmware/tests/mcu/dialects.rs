// SPDX-License-Identifier: GPL-3.0-or-later
//! An MCU that gets the dialect of another host.

use std::collections::BTreeMap;

use pinion_firmware::mcu::DialectName;
use pinion_protocol::vlq::Writer;

use pinion_testbench::rig::{Rig, hex};

#[test]
fn an_mcu_changes_its_dialect_at_once_or_after_its_reset() {
    let mut rig = Rig::of(DialectName::Master);
    rig.speak(DialectName::V0_12);
    assert_eq!(*rig.dialect().forms(), DialectName::V0_12.into());
    // identify serves the new dictionary.
    let served = hex(&rig.dialect().compressed()[..40]);
    assert_eq!(rig.ask("identify offset=0 count=40"), format!("identify_response offset=0 data={served}"));
    rig.configure(&[]);
    rig.speak(DialectName::Kalico);
    assert_eq!(*rig.dialect().forms(), DialectName::V0_12.into(), "its objects speak the old dialect");
    let crc = !7u32;
    let config = format!("config is_config=1 crc={crc} is_shutdown=0 move_count=1024");
    assert_eq!(rig.ask("get_config"), config, "a check sum that no host has, so that this one resets");
    let served = hex(&Rig::of(DialectName::Kalico).dialect().compressed()[400..440]);
    assert_eq!(rig.ask("identify offset=400 count=40"), format!("identify_response offset=400 data={served}"));
    rig.speak(DialectName::V0_12);
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024", "the first is back");
    rig.speak(DialectName::Kalico);
    rig.send_all(&["emergency_stop", "config_reset"]);
    rig.responses();
    assert_eq!(*rig.dialect().forms(), DialectName::Kalico.into());
    rig.configure(&[]);
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024");
}

/// While hosts change, the new one gets these of the MCU that still speaks with the former one.
#[test]
fn the_mcus_own_responses_have_one_id_in_every_dialect() {
    let own = |dialect| {
        let rig = Rig::of(dialect);
        let dialect = rig.dialect();
        let mut ids = BTreeMap::new();
        for (format, id) in &dialect.dictionary().responses {
            let id = id.as_i64().unwrap();
            let mut payload = Writer::default();
            payload.int(id as u32);
            if dialect.is_own_response(payload.payload().unwrap()) {
                ids.insert(format.split(' ').next().unwrap().to_owned(), id);
            }
        }
        ids
    };
    let of_master = own(DialectName::Master);
    let named = |name: &str| of_master.contains_key(name);
    assert!(["identify_response", "clock", "config", "shutdown"].iter().all(|name| named(name)), "{of_master:?}");
    assert!(!["stepper_position", "spi_transfer_response", "trsync_state"].iter().any(|name| named(name)));
    for dialect in DialectName::OF_HOSTS {
        assert_eq!(own(dialect), of_master, "{dialect:?}");
    }
}

#[test]
fn a_configured_mcu_does_not_take_the_other_hosts_words_for_its_own() {
    let mut rig = Rig::of(DialectName::V0_12);
    rig.configure(&["config_digital_out oid=0 pin=1 value=1 default_value=0 max_duration=0"]);
    rig.speak(DialectName::Master);
    rig.send("update_digital_out oid=0 value=1");
    let stopped = rig.responses();
    assert!(stopped.iter().any(|response| response.starts_with("shutdown ")), "{stopped:?}");
    assert!(!rig.bench.level(1), "the output is at its shutdown value");
    assert!(
        rig.notes().iter().any(|note| note.contains("a host that uses other forms of messages than the present one"))
    );
}

#[test]
fn a_stopped_mcu_reads_the_other_hosts_blocks_to_their_end() {
    let mut rig = Rig::of(DialectName::V0_12);
    rig.configure(&["config_digital_out oid=0 pin=1 value=1 default_value=0 max_duration=0"]);
    rig.send("emergency_stop");
    rig.responses();
    rig.speak(DialectName::Master);
    // In the earlier dialect, their ids mean something else and have other lengths.
    let commands = ["query_adxl345 oid=0 rest_ticks=0", "i2c_transfer oid=0 write=0011 read_len=2", "config_reset"];
    let block = commands.map(|command| rig.encode(command)).concat();
    assert!(rig.mcu.is_emergency(&[rig.encode(commands[1]), rig.encode("emergency_stop")].concat()));
    rig.execute(&block);
    assert_eq!(rig.responses(), ["is_shutdown static_string_id=Command request"; 2]);
    assert_eq!(*rig.dialect().forms(), DialectName::Master.into(), "the reset was read");
}

#[test]
fn another_host_does_not_get_what_the_objects_say() {
    let mut rig = Rig::of(DialectName::V0_12);
    rig.configure(&["config_analog_in oid=0 pin=400"]);
    rig.send("query_analog_in oid=0 clock=@20000 sample_ticks=1000 sample_count=2 rest_ticks=100000 min_value=0 max_value=4095 range_check_count=4");
    rig.run_until(100_000);
    assert_eq!(rig.responses().len(), 1);
    rig.speak(DialectName::Master);
    rig.sends_until(500_000, &[]);
    assert!(rig.ask("get_uptime").starts_with("uptime "));
    rig.speak(DialectName::V0_12);
    rig.run_until(600_000);
    assert_eq!(rig.responses().len(), 1, "the first host is back, and gets the readings that it asked for");
}

#[test]
fn the_mcus_own_messages_have_the_same_ids_in_every_dialect() {
    let own = ["emergency_stop", "get_config", "config_reset", "get_clock", "clear_shutdown"];
    let ids = |dialect| own.map(|command| Rig::of(dialect).dialect().command_id(command));
    for dialect in DialectName::OF_HOSTS {
        assert_eq!(ids(dialect), ids(DialectName::Master), "{dialect}");
    }
}

#[test]
fn an_emergency_stop_is_found_among_others_and_not_in_their_parameters() {
    let rig = Rig::of(DialectName::Master);
    let dialect = rig.dialect();
    let stop = dialect.command_id("emergency_stop").unwrap();
    let step = dialect.command_id("queue_step oid=%c interval=%u count=%hu add=%hi").unwrap();
    let contains = |ints: &[u32]| {
        let mut writer = Writer::default();
        ints.iter().for_each(|int| writer.int(*int));
        dialect.is_emergency(writer.payload().unwrap())
    };
    assert!(contains(&[stop]));
    assert!(contains(&[step, stop, stop, stop, stop, stop, step]));
    assert!(!contains(&[step, stop, stop, stop, stop]));
    assert!(!contains(&[step, 1, 2, 3, 4]));
    assert!(!contains(&[]));
    assert!(!contains(&[4711, stop]), "the MCU stops at an unknown command");
    assert!(!contains(&[step, stop]), "and at one that is cut short");
}
