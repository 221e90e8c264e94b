// SPDX-License-Identifier: GPL-3.0-or-later
//! A machine that is given the dialect of another host.

use pinion::mcu::{DialectName, Generation};

use crate::rig::{Rig, hex};

#[test]
fn a_machine_speaks_as_it_is_told_until_it_is_configured_and_again_after_a_reset() {
    let mut rig = Rig::of(Generation::Master);
    assert!(rig.speak(Generation::V0_12));
    assert_eq!(rig.dialect().name(), DialectName::Of(Generation::V0_12));
    // What identify serves is the new dictionary.
    let served = hex(&rig.dialect().compressed()[..40]);
    assert_eq!(rig.ask("identify offset=0 count=40"), format!("identify_response offset=0 data={served}"));
    rig.send("allocate_oids count=1");
    assert!(!rig.speak(Generation::Kalico), "a configuration is under way");
    rig.send_all(&["finalize_config crc=1", "emergency_stop"]);
    assert!(!rig.speak(Generation::Kalico), "a stopped machine is still configured");
    assert_eq!(rig.dialect().name(), DialectName::Of(Generation::V0_12));
    rig.send("config_reset");
    rig.responses();
    assert!(rig.speak(Generation::Kalico));
    rig.configure(&[]);
    assert_eq!(rig.ask("get_config"), "config is_config=1 crc=7 is_shutdown=0 move_count=1024");
}

#[test]
fn the_machines_own_messages_have_the_same_ids_in_every_dialect() {
    let own = ["emergency_stop", "get_config", "config_reset", "get_clock", "clear_shutdown"];
    let ids = |generation| own.map(|command| Rig::of(generation).dialect().command_id(command));
    for generation in Generation::ALL {
        assert_eq!(ids(generation), ids(Generation::Master), "{generation}");
    }
}
