// SPDX-License-Identifier: GPL-3.0-or-later
//! A machine that is given the dialect of another host.

use pinion::mcu::{DialectName, Generation};

use crate::rig::{Rig, hex};

#[test]
fn a_machine_speaks_as_it_is_told_at_once_or_after_its_reset() {
    let mut rig = Rig::of(Generation::Master);
    rig.speak(Generation::V0_12);
    assert_eq!(rig.dialect().name(), DialectName::Of(Generation::V0_12));
    // What identify serves is the new dictionary.
    let served = hex(&rig.dialect().compressed()[..40]);
    assert_eq!(rig.ask("identify offset=0 count=40"), format!("identify_response offset=0 data={served}"));
    rig.configure(&[]);
    rig.speak(Generation::Kalico);
    assert_eq!(rig.dialect().name(), DialectName::Of(Generation::V0_12), "its objects speak the old dialect");
    let crc = !7u32;
    let config = format!("config is_config=1 crc={crc} is_shutdown=0 move_count=1024");
    assert_eq!(rig.ask("get_config"), config, "a check sum that no host has, so that this one resets");
    rig.speak(Generation::V0_12);
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024", "the first is back");
    rig.speak(Generation::Kalico);
    rig.send_all(&["emergency_stop", "config_reset"]);
    rig.responses();
    assert_eq!(rig.dialect().name(), DialectName::Of(Generation::Kalico));
    rig.configure(&[]);
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024");
}

#[test]
fn a_configured_machine_does_not_take_the_other_hosts_words_for_its_own() {
    let mut rig = Rig::of(Generation::V0_12);
    rig.configure(&["config_digital_out oid=0 pin=1 value=1 default_value=0 max_duration=0"]);
    rig.speak(Generation::Master);
    rig.send("update_digital_out oid=0 value=1");
    let stopped = rig.responses();
    assert!(stopped.iter().any(|response| response.starts_with("shutdown ")), "{stopped:?}");
    assert!(!rig.bench.level(1), "the output is at its shutdown value");
}

#[test]
fn the_machines_own_messages_have_the_same_ids_in_every_dialect() {
    let own = ["emergency_stop", "get_config", "config_reset", "get_clock", "clear_shutdown"];
    let ids = |generation| own.map(|command| Rig::of(generation).dialect().command_id(command));
    for generation in Generation::ALL {
        assert_eq!(ids(generation), ids(Generation::Master), "{generation}");
    }
}
